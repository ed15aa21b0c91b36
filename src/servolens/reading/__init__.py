"""Reading records: CSV and MAT v5 files, DataFrames, time responses.

A file is refused with one sentence, never with a traceback, and at most 40 characters of it are quoted.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from servolens.reading.assembly import assemble
from servolens.reading.csv_text import read_text
from servolens.reading.files import located, name_format, printable, read_bytes
from servolens.reading.mat import read_mat
from servolens.reading.memory import record_from_dataframe, record_from_timeresponse
from servolens.reading.settings import KEYS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servolens.record import Record

__all__ = ["KEYS", "read_record", "record_from_dataframe", "record_from_timeresponse"]


def read_record(
    path: str | os.PathLike[str],
    *,
    settings: Mapping[str, object] | None = None,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    label: str | None = None,
) -> Record:
    """Read one measured run from a CSV or MAT v5 file.

    Parameters
    ----------
    path : str or path
        A regular file; what it is, its content says.
    settings : mapping, optional
        ``kp``, ``kd``, ``encoder_resolution`` … (:data:`KEYS`): numbers in SI, or texts with a unit such as
        ``"0.06 V/mm"``; they win over the file's own comment lines.
    columns : mapping, optional
        Signal to column (variable) name, e.g. ``{"position": "qm"}``.
    units : mapping, optional
        Signal to unit, e.g. ``{"time": "ms"}``; wins over the headings.
    label : str, optional
        What refusals call the file; by default its path.

    Returns
    -------
    Record
        In SI; its `remarks` hold what was not understood.

    Raises
    ------
    InputError
        With one sentence: what arrived and where, what is admissible, what to do.
    """
    file = Path(path)
    with located(label or os.fspath(path)):
        content = read_bytes(file)
        read = read_mat if name_format(content, file.suffix) == "mat" else read_text
        table = read(content, columns)
        return assemble(
            table.signals,
            table.units,
            comments=table.comments,
            settings=settings,
            units=units,
            name=printable(file.stem)[:80] or "record",
            source=printable(os.fspath(path)),
        )
