"""Traces of CODESYS V3: the CSV of its runtime system (``.trace.csv``) and the editor's own XML (``.trace``, ``.xml``).

Each variable stands by itself with time stamps of its own, whole numbers of milliseconds or microseconds. The CSV says
which by a bit of its ``Flags``, the XML by ``MicroSeconds`` in the configuration beside the samples. The text that the
editor writes (``.txt``) is a plain table.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import reduce
from typing import TYPE_CHECKING, final
from xml.parsers import expat

import numpy as np

from servolens.errors import InputError
from servolens.reading.cells import fault_of, numbers
from servolens.reading.files import quote
from servolens.reading.lines import unified
from servolens.reading.table import MOST_COLUMNS, Column, Fault, Table

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    Values = NDArray[np.float64]

__all__ = ["is_codesys", "read_codesys"]

LARGEST_TEXT = 24 * 2**20
"""Longest trace that is read [bytes]: while they are split, its cells take up to thirty times as much memory."""
DEEPEST = 100
"""Elements of XML within each other at most; a trace has about ten."""
LOOKED_AT = 4096
MILLISECONDS, MICROSECONDS = 16, 32
"""Bits of the flags in the CSV."""
SHARED = 0.9
"""Share of the samples from which on variables whose recordings began or ended apart stand in one table: a tenth of a
record may be lost to a late start, more is another trace."""
TRUTHS = {"true": "1", "false": "0"}
_CSV = re.compile(r"\s*\[key\];\s*\[value\]|\s*0\.Variable;")
_XML = re.compile(r"<Trace[\s>]")
_VARIABLE = re.compile(r"(?m)^\d+\.Variable;(.*)$")
_DATA = re.compile(r"(?m)^\d+\.Data;.*$")
_FLAGS = re.compile(r"(?m)^Flags;\s*(\d{1,9})\s*$")


@final
@dataclass(frozen=True, slots=True, eq=False)
class _Variable:
    """A variable of a trace, with its own time stamps; `fault` tells why it cannot be used."""

    name: str
    stamps: Values
    values: Values
    fault: Fault | None = None


def is_codesys(content: bytes) -> bool:
    """Tell whether a file begins as a trace of CODESYS V3 does, in either form."""
    encoding = "utf-16" if content.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig"
    start = content[:LOOKED_AT].decode(encoding, "replace")
    return bool(_CSV.match(start) or (start.lstrip().startswith("<") and _XML.search(start)))


def read_codesys(content: bytes) -> tuple[Table, ...]:
    """Read a trace of CODESYS V3.

    Variables that were sampled together stand in one table, at the instants that all of them have; such of other
    tasks or rates in tables of their own.

    Raises
    ------
    InputError
        If the trace holds no samples, is damaged or is too long.
    """
    if len(content) > LARGEST_TEXT:
        raise InputError(
            f"is a CODESYS trace of more than {LARGEST_TEXT / 2**20:.0f} MiB, the longest that is read; save a part"
        )
    content = unified(content)
    text = content.decode()
    variables, unit = _of_csv(text) if _CSV.match(text) else _of_xml(content)
    variables = [one for one in variables if one.stamps.size or one.fault]
    if not any(one.stamps.size for one in variables):
        why = next((f"{one.fault.what}; save it again" for one in variables if one.fault), "")
        raise InputError(f"is a CODESYS trace: {why or 'holds no samples; record, then save it again'}")
    return tuple(_table(group, unit) for group in _together(variables))


def _of_csv(text: str) -> tuple[list[_Variable], str | None]:
    """Return the variables of a ``.trace.csv`` and the unit of their time stamps."""
    found = _FLAGS.search(text)
    flags = int(found[1]) if found else 0
    unit = {MILLISECONDS: "ms", MICROSECONDS: "us"}.get(flags & (MILLISECONDS | MICROSECONDS))
    pieces = _VARIABLE.split(text, maxsplit=MOST_COLUMNS + 1)
    _refuse_many(len(pieces) // 2)
    return [_sampled(name.strip(), rows) for name, rows in zip(pieces[1::2], pieces[2::2], strict=True)], unit


def _sampled(name: str, text: str) -> _Variable:
    """Return a variable of a ``.trace.csv`` from the lines ``; time stamp; value`` below its data mark."""
    begin = _DATA.search(text)
    rows = text[begin.end() :].rstrip() if begin else ""
    cells = rows.replace("\n;", ";").removeprefix(";").split(";") if rows.strip() else []
    if len(cells) % 2 or rows.count("\n") != len(cells) // 2:
        what = f"column {quote(name)} holds more than one number a sample, or its lines are damaged"
        return _Variable(name, np.empty(0), np.empty(0), Fault("", what))
    return _variable(name, cells[::2], cells[1::2])


def _variable(name: str, stamps: Sequence[str], cells: Sequence[str]) -> _Variable:
    instants = numbers(stamps)
    if not np.isfinite(instants).all():
        return _Variable(name, np.empty(0), np.empty(0), Fault("", f"column {quote(name)} has damaged time stamps"))
    values = numbers(cells)
    odd = np.flatnonzero(~np.isfinite(values))
    if odd.size:
        cells = [TRUTHS.get(cell.strip().lower(), cell) for cell in cells]
        values = numbers(cells)
        odd = np.flatnonzero(~np.isfinite(values))
    fault = Fault(f"sample {odd[0] + 1}", fault_of(cells[odd[0]]) or "") if odd.size else None
    return _Variable(name, instants, values, fault)


@final
@dataclass(slots=True)
class _Parts:
    """What the parser of a trace's XML has met: samples by variable, and the resolutions of the configurations."""

    variables: list[dict[str, list[str]]] = field(default_factory=list)
    resolutions: list[list[str]] = field(default_factory=list)
    text: list[str] | None = None
    depth: int = 0

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        self.text, self.depth = None, self.depth + 1
        if self.depth > DEEPEST:
            raise InputError(f"is XML with more than {DEEPEST} elements within each other; it is not read")
        _refuse_many(len(self.variables))
        if tag == "TraceVariable":
            self.variables.append({"name": [attributes.get("VarName", "")]})
        elif tag in ("Values", "Timestamps") and self.variables:
            self.text = self.variables[-1].setdefault(tag, [])
        elif tag == "Single" and attributes.get("Name") == "MicroSeconds":
            self.text = []
            self.resolutions.append(self.text)

    def end(self, _tag: str) -> None:
        self.text, self.depth = None, self.depth - 1

    def characters(self, text: str) -> None:
        if self.text is not None:
            self.text.append(text)


def _of_xml(content: bytes) -> tuple[list[_Variable], str | None]:
    """Return the variables of a trace in XML and the unit of their time stamps."""
    parts = _Parts()
    parser = expat.ParserCreate("utf-8")
    parser.buffer_text = True
    parser.StartDoctypeDeclHandler = _refuse_doctype
    parser.StartElementHandler, parser.EndElementHandler = parts.start, parts.end
    parser.CharacterDataHandler = parts.characters
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise InputError(f"is a damaged CODESYS trace (line {error.lineno}); save it again") from error
    stated = {"".join(text).strip().lower() for text in parts.resolutions}
    unit = {"true": "us", "false": "ms"}.get(stated.pop()) if len(stated) == 1 else None
    return [_listed(one) for one in parts.variables], unit


def _refuse_many(variables: int) -> None:
    if variables > MOST_COLUMNS:
        raise InputError(f"is a CODESYS trace of more than {MOST_COLUMNS} variables, the most that are read")


def _refuse_doctype(*_: object) -> None:
    raise InputError("is XML with a document type, which a CODESYS trace has not; it is not read")


def _listed(parts: dict[str, list[str]]) -> _Variable:
    """Return a variable of the XML, whose values and time stamps are lists with commas."""
    name = parts["name"][0].strip()
    stamps, cells = (_cells("".join(parts.get(key, ()))) for key in ("Timestamps", "Values"))
    if len(stamps) != len(cells):
        what = f"column {quote(name)} has {len(cells)} values for {len(stamps)} time stamps"
        return _Variable(name, np.empty(0), np.empty(0), Fault("", what))
    return _variable(name, stamps, cells)


def _cells(text: str) -> list[str]:
    return text.split(",") if text.strip() else []


def _together(variables: Sequence[_Variable]) -> list[list[_Variable]]:
    """Return the variables by the clock that they were sampled on; what cannot be used stands with the first."""
    whole = [one for one in variables if one.stamps.size]
    broken = [one for one in variables if not one.stamps.size]
    if all(np.all(np.diff(one.stamps) > 0) for one in whole):
        common = reduce(np.intersect1d, (one.stamps for one in whole))
        if common.size >= SHARED * max(one.stamps.size for one in whole):
            return [[*(_at(one, common) for one in whole), *broken]]
    groups: list[list[_Variable]] = []
    for one in whole:
        same = next((group for group in groups if np.array_equal(group[0].stamps, one.stamps)), None)
        if same is None:
            groups.append([one])
        else:
            same.append(one)
    return [[*groups[0], *broken], *groups[1:]]


def _at(variable: _Variable, instants: Values) -> _Variable:
    """Return a variable at some of its instants."""
    values = variable.values[np.searchsorted(variable.stamps, instants)]
    fault = None if np.isfinite(values).all() else variable.fault
    return _Variable(variable.name, instants, values, fault)


def _table(variables: Iterable[_Variable], unit: str | None) -> Table:
    group = list(variables)
    clock = Column("time", group[0].stamps, unit)
    return Table((clock, *(Column(one.name, one.values, fault=one.fault) for one in group)))
