"""Where the measured logs are, and the tables that the examples print."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.io import loadmat

from servolens import Controller, Record

if TYPE_CHECKING:
    from servolens import Plant, Prediction


def folder(name: str) -> Path:
    """Return a folder of measured data: below SERVOLENS_DATA, or ../shared/data beside the repository."""
    default = Path(__file__).resolve().parents[1].parent / "shared" / "data"
    path = Path(os.environ.get("SERVOLENS_DATA", default)) / name
    if not path.is_dir():
        print(f"skipped: {path} is missing; set SERVOLENS_DATA to the folder that holds {name}")
        sys.exit(0)
    return path


def kawata_record(path: Path, kp: float, signal: str, step: float, name: str) -> Record:
    """Return one of Kawata's steps: the file holds time and position, the reference jumped by `step` at 1 s."""
    content = loadmat(path)
    time = content["t"].ravel()
    return Record(
        time=time,
        position=content[signal].ravel(),
        reference=np.where(time >= 1.0 - 1e-6, step, 0.0),
        controller=Controller(kp=kp),
        name=name,
        length_unit="m" if signal == "z" else "rad",
    )


def show_plant(title: str, plant: Plant) -> None:
    """Print the plant's parameters on a line."""
    numbers = ", ".join(f"{name} {value:.4g}" for name, value in zip(plant.parameters, plant.values, strict=True))
    print(f"{title}: {numbers}")


def show_table(table: Prediction, used: set[str]) -> None:
    """Print Table I: percent error of each model on each record, the records used for identification starred."""
    print(f"{'mean |error| in % of the step':34}" + "".join(f"{model:>12}" for model in table.models))
    for row in table.errors:
        star = " *" if row[0].name in used else ""
        print(f"{row[0].name + star:34}" + "".join(f"{cell.percent_error:12.2f}" for cell in row))
    unseen = [row for row in table.errors if row[0].name not in used]
    if unseen:
        averages = [sum(row[j].percent_error for row in unseen) / len(unseen) for j in range(len(table.models))]
        print(f"{'average, not used (held out)':34}" + "".join(f"{value:12.2f}" for value in averages))
    print("* used for identification")
