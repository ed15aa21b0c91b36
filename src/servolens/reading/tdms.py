"""LabVIEW's TDMS files, by npTDMS: a table for each group, the time from the waveform's increment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from nptdms import TdmsFile

from servolens.errors import InputError
from servolens.reading import files
from servolens.reading.table import Column, Table

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["read"]


def read(path: Path) -> list[Table]:
    """Return the groups of a TDMS file; channels of one length and one clock stand in one table.

    Raises
    ------
    InputError
        If the file is damaged or too large.
    """
    try:
        with TdmsFile.open(path) as file:
            channels = [channel for group in file.groups() for channel in group.channels()]
            files.check_numbers(sum(map(len, channels)))
            properties = {str(key).lower(): str(value) for key, value in file.properties.items()}
            tables: dict[tuple[str, int], list[Column]] = {}
            for channel in channels:
                _add(tables, channel)
    except (ValueError, KeyError, OSError, EOFError, OverflowError, IndexError) as error:
        raise error if isinstance(error, InputError) else InputError("is a damaged TDMS file; save it again") from error
    return [Table(tuple(columns), name, properties=properties) for (name, _), columns in tables.items()]


def _add(tables: dict[tuple[str, int], list[Column]], channel: Any) -> None:
    values = channel[:]
    if values.dtype.kind == "M":
        array = (values - values[:1]) / np.timedelta64(1, "ns") * 1e-9
        unit: str | None = "s"
    elif values.dtype.kind in "biuf":
        array, unit = values, str(channel.properties.get("unit_string", "")) or None
    else:
        return
    group = tables.setdefault((channel.group_name, values.size), [])
    increment = channel.properties.get("wf_increment")
    if not group and isinstance(increment, float) and increment > 0:
        offset = float(channel.properties.get("wf_start_offset", 0.0))
        group.append(Column("time", offset + increment * np.arange(values.size), "s"))
    group.append(Column(channel.name, np.asarray(array, dtype=np.float64), unit))
