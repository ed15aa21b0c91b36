"""ASAM measurement data (MDF 3 and 4), by asammdf: a table for each channel group with its master's time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from asammdf import MDF

from servolens.errors import InputError
from servolens.reading import files
from servolens.reading.table import Column, Table

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["read"]


def read(path: Path) -> list[Table]:
    """Return the channel groups of an MDF file; attachments stay where they are.

    Raises
    ------
    InputError
        If the file is damaged or too large.
    """
    try:
        with MDF(path) as file:
            counts = [group.channel_group.cycles_nr * len(group.channels) for group in file.groups]
            files.check_numbers(sum(counts))
            return [table for index in range(len(file.groups)) if (table := _group(file, index)) is not None]
    except InputError:
        raise
    except Exception as error:
        raise InputError("is a damaged MDF file; record or export it again") from error


def _group(file: MDF, index: int) -> Table | None:
    group = file.groups[index]
    master = file.masters_db.get(index)
    columns: list[Column] = []
    channels: Any = group.channels
    for at, channel in enumerate(channels):
        if at == master:
            continue
        signal = file.get(group=index, index=at, ignore_invalidation_bits=True)
        if signal.samples.ndim != 1 or signal.samples.dtype.kind not in "biuf":
            continue
        if not columns:
            columns.append(Column("time", np.asarray(signal.timestamps, dtype=np.float64), "s"))
        columns.append(Column(str(channel.name), np.asarray(signal.samples, dtype=np.float64), signal.unit or None))
    name = str(getattr(group.channel_group, "acq_name", "") or f"group {index + 1}")
    return Table(tuple(columns), name) if len(columns) > 1 else None
