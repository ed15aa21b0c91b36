"""Draw what each effect does to a step, for the page of effects (``make pictures``)."""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib as mpl
import numpy as np

from servolens import Controller, Plant, Record
from servolens.effects import CATALOGUE, Effect
from servolens.simulation import simulate

mpl.use("svg")
mpl.rcParams.update({"svg.hashsalt": "servolens", "svg.fonttype": "path", "font.size": 8})

FOLDER = Path(__file__).with_name("images") / "effects"
GAIN, DAMPING, STEP, DURATION, SAMPLE = 1.9, 6.0, 0.1, 1.5, 1e-3
"""The paper's axis, about: 0.1 m steps at kp 60, there at 0.05 s and back after half of the time."""
TYPICAL = {"end_stop": {"low": -0.05, "high": 0.115}, "gain_drift": {"rate": -0.25}}
"""Where the typical values of tests would not show in these steps."""


def main() -> None:
    """Write ``docs/images/effects/*.svg``."""
    from matplotlib import pyplot as plt

    FOLDER.mkdir(parents=True, exist_ok=True)
    time = np.arange(0.0, 2 * DURATION, SAMPLE)
    reference = np.where((time >= 0.05) & (time < DURATION), STEP, 0.0)
    record = Record(
        time=time, position=np.zeros_like(time), reference=reference, controller=Controller(kp=60.0), name="steps"
    )
    for name, cls in CATALOGUE.items():
        runs = [simulate(plant, record) for plant in (Plant(gain=GAIN, damping=DAMPING), axis(cls))]
        figure, (above, below) = plt.subplots(
            2, 1, figsize=(5.6, 2.7), sharex=True, layout="constrained", height_ratios=[3, 2]
        )
        above.plot(time, 1e3 * reference, color="0.7", lw=1, label="reference")
        for run, style, label in zip(
            runs, ({"color": "#1f5fa8", "ls": "--"}, {"color": "#c8501e"}), ("without", "with it"), strict=True
        ):
            above.plot(time, 1e3 * run.position, lw=1.2, label=label, **style)
        below.plot(time, 1e3 * (runs[1].position - runs[0].position), color="#c8501e", lw=1)
        above.set_ylabel("position [mm]")
        below.set_ylabel("change [mm]")
        below.set_xlabel("time [s]")
        above.legend(loc="upper right", frameon=False, ncols=3, bbox_to_anchor=(1.0, 1.26))
        for axes in (above, below):
            axes.spines[["top", "right"]].set_visible(False)
        figure.savefig(FOLDER / f"{name}.svg", metadata={"Date": None}, facecolor="white")
        plt.close(figure)
        slimmed(FOLDER / f"{name}.svg")


def axis(cls: type[Effect]) -> Plant:
    """Return the axis with an effect of typical size."""
    return Plant(gain=GAIN, damping=DAMPING, effects=(cls(**{**cls.typical, **TYPICAL.get(cls.name, {})}),))


def slimmed(path: Path) -> None:
    """Write the coordinates of paths with two decimals: a hundredth of a point is finer than a screen."""
    text = path.read_text(encoding="utf-8")
    short = re.sub(r' d="[^"]*"', lambda match: re.sub(r"(\d+\.\d\d)\d+", r"\1", match[0]), text)
    path.write_text(short, encoding="utf-8")


if __name__ == "__main__":
    main()
