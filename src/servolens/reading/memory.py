"""Records from what is in memory: pandas DataFrames and python-control's time responses, without importing either."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from servolens.errors import InputError
from servolens.reading.files import quote
from servolens.reading.interpret import interpret
from servolens.reading.reading import made
from servolens.reading.roles import check_mapping
from servolens.reading.settings import as_settings
from servolens.reading.table import Column, Fault, Table
from servolens.record import SIGNALS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from servolens.record import Record

__all__ = ["record_from_dataframe", "record_from_timeresponse"]


def record_from_dataframe(
    frame: Any,
    *,
    settings: Mapping[str, object] | None = None,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    **stated: object,
) -> Record:
    """Return the record that a pandas DataFrame holds.

    Parameters
    ----------
    frame : pandas.DataFrame
        Columns as in a CSV file: time, position, reference, voltage …, with units in brackets where they are not SI.
        Without a time column the index is the time, if it is named so or is made of times.
    settings, columns, units : mapping, optional
        As in :func:`~servolens.reading.read_record`.
    **stated
        The same as `settings`, as keywords: ``kp=60``.

    Raises
    ------
    InputError
        With one sentence, if the table does not make a record.

    Examples
    --------
    >>> import pandas as pd
    >>> frame = pd.DataFrame({"time [ms]": [0, 1, 2], "position": [0, 0, 1e-6], "reference": [0.1] * 3})
    >>> record_from_dataframe(frame, kp=60).sample_time
    0.001
    """
    settings = as_settings(settings, stated)
    if not hasattr(frame, "columns") or not hasattr(frame, "index"):
        raise InputError(f"a pandas DataFrame is needed, got {type(frame).__name__}")
    texts = [str(column) for column in frame.columns]
    values = [frame.iloc[:, i] for i in range(len(texts))]
    index = frame.index
    if str(index.name).partition(" [")[0] in ("time", "t") or np.asarray(index).dtype.kind in "mM":
        texts.append(str(index.name or "time"))
        values.append(index)
    table = Table(tuple(_column(text, column) for text, column in zip(texts, values, strict=True)))
    found = interpret([table], columns=columns, units=units, settings=settings)
    return made(found, settings=settings, units=units, source="DataFrame").record


def record_from_timeresponse(
    response: Any,
    *,
    settings: Mapping[str, object] | None = None,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    **stated: object,
) -> Record:
    """Return the record that a python-control time response holds.

    Signals are found by their labels. A single output with another label is the position; a single input with
    another label is the reference where `settings` give kp, else the voltage.

    Parameters
    ----------
    response : control.TimeResponseData
        With one trace.
    settings, columns, units : mapping, optional
        As in :func:`~servolens.reading.read_record`; `columns` maps signals to labels.
    **stated
        The same as `settings`, as keywords: ``kp=60``.

    Raises
    ------
    InputError
        With one sentence, if the response does not make a record.
    """
    missing = [part for part in ("time", "outputs", "inputs") if getattr(response, part, None) is None]
    if missing:
        raise InputError(f"a time response with time, outputs and inputs is needed; {', '.join(missing)} is missing")
    time = np.asarray(response.time, dtype=np.float64)
    outputs = _labelled(response, "outputs", "output_labels", time.size)
    inputs = _labelled(response, "inputs", "input_labels", time.size)
    settings, mapping = as_settings(settings, stated), check_mapping(columns, "columns", "qm")
    if not mapping:
        mapping = _guess(list(outputs), list(inputs), "kp" in settings)
    signals = {"time": time, **inputs, **outputs}
    table = Table(tuple(Column(label, values.copy()) for label, values in signals.items()))
    found = interpret([table], columns=mapping, units=units, settings=settings)
    name = str(getattr(response, "sysname", None) or "response")
    return made(found, settings=settings, units=units, name=name, source="TimeResponseData").record


def _column(name: str, column: Any) -> Column:
    array = np.asarray(column)
    if array.dtype.kind == "M":
        return Column(name, np.asarray((array - array[:1]) / np.timedelta64(1, "ns") * 1e-9, dtype=np.float64), "s")
    if array.dtype.kind == "m":
        return Column(name, np.asarray((array - array[:1]) / np.timedelta64(1, "ns") * 1e-9, dtype=np.float64), "s")
    if array.dtype.kind == "c":
        return Column(name, np.empty(0), fault=Fault("", f"column {quote(name)} is complex; a signal is real"))
    try:
        return Column(name, np.array(array, dtype=np.float64))
    except (TypeError, ValueError):
        reason = f"column {quote(name)} holds values that are not numbers"
        return Column(name, np.empty(0), fault=Fault("", reason))


def _labelled(response: Any, part: str, labels: str, samples: int) -> dict[str, NDArray[np.float64]]:
    array = np.asarray(getattr(response, part), dtype=np.float64)
    rows = array.reshape(-1, samples) if samples and array.size % samples == 0 else array[np.newaxis]
    names = getattr(response, labels, None) or [f"{part[:-1]}[{i}]" for i in range(len(rows))]
    if len(names) != len(rows):
        raise InputError(f"the response has {len(rows)} rows of {part} for {len(names)} labels; give one trace")
    return dict(zip(map(str, names), rows, strict=True))


def _guess(outputs: list[str], inputs: list[str], closed: bool) -> dict[str, str]:
    mapping: dict[str, str] = {}
    known = {*SIGNALS}
    if "position" not in {*outputs, *inputs}:
        if len(outputs) != 1:
            raise InputError(f"which output is the position; map it, e.g. columns={{'position': {quote(outputs[0])}}}")
        mapping["position"] = outputs[0]
    if len(inputs) == 1 and not known & {*inputs, "position"} - {"position"}:
        mapping["reference" if closed else "voltage"] = inputs[0]
    return mapping
