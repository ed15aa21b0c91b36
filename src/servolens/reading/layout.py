"""Where the numbers of a table of cells stand: its preamble, its row of names, its row of units, its first row."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, final

from servolens.reading.cells import is_value, number
from servolens.reading.words import meaning
from servolens.units import ordinary_unit, parse_unit

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

__all__ = ["Layout", "find_layout", "properties_of", "units_above"]

MOST_TYPED = 20
"""Rows at the end of the head that tell which columns hold numbers."""
_PROPERTY = re.compile(r"\W*([A-Za-z][\w .\-\[\]()]*?)\s*[=:]\s*(.*?)\s*")
_BRACKETED = re.compile(r"[\[(<{]\s*(.*?)\s*[\])>}]")
_COUNT = "sequence"
"""What stands for the unit of a column that counts samples."""
_LABVIEW_UNITS = "y_unit_label"
_SCOPE = ("data-type", "sampletime[ms]", "symbolcomment", "symbolname")
"""Labels of the header rows of a TwinCAT Scope export, of which each channel may have a column of labels."""


@final
@dataclass(frozen=True, slots=True)
class Layout:
    """How rows of cells are to be read.

    Parameters
    ----------
    names : tuple of str
        Of the columns; their numbers where no row names them.
    units : tuple of (str or None)
        From a row of units.
    first : int
        Index of the first row of numbers.
    typed : frozenset of int
        Columns that hold numbers or time stamps.
    properties : mapping
        ``key: value`` pairs above the numbers.
    has_names : bool
        Whether the file names its columns.
    other_width : int
        Cells of the row above the numbers, where that has texts and another number of cells than the rows; else 0.
    has_clocks : bool
        Whether columns named as the first one are times that belong to those behind them.
    """

    names: tuple[str, ...]
    units: tuple[str | None, ...]
    first: int
    typed: frozenset[int]
    properties: Mapping[str, str] = field(default_factory=dict)
    has_names: bool = True
    other_width: int = 0
    has_clocks: bool = False


def find_layout(rows: Sequence[Sequence[str]], decimal: str = ".") -> Layout | None:
    """Return the layout of a table by its first rows, or None if they hold no rows of numbers.

    The columns that hold numbers are learnt from the last rows; from there the rows are followed upwards until one is
    no row of numbers: that is the row of units or of names.

    Parameters
    ----------
    rows : sequence of sequence of str
        Cells, blank rows left out.
    decimal : {".", ","}
        Of the numbers.
    """
    kinds = [[is_value(cell, decimal) for cell in row] for row in rows]
    last = next((i for i in range(len(rows) - 1, -1, -1) if sum(kinds[i]) >= 2), None)
    if last is None:
        return None
    tail = kinds[max(last + 1 - MOST_TYPED, 0) : last + 1]
    tail = [row for row in tail if sum(row) > 1]
    width = Counter(len(row) for row in tail).most_common(1)[0][0]
    tail = [row for row in tail if len(row) == width]
    typed = [j for j in range(width) if 2 * sum(row[j] for row in tail) > len(tail)]
    if len(typed) < 2:
        return None
    first = _first(rows, kinds, typed, last)
    return _named(rows, first, width, frozenset(typed))


def _first(rows: Sequence[Sequence[str]], kinds: Sequence[Sequence[bool]], typed: Sequence[int], last: int) -> int:
    """Return the index of the first row of numbers; a row with a wrong cell between rows of numbers is one of them."""

    def holds(i: int) -> bool:
        row = kinds[i]
        found = sum(row[j] for j in typed if j < len(row))
        starts = typed[0] < len(row) and (row[typed[0]] or not rows[i][typed[0]].strip())
        return starts and 2 * found > len(typed)

    first = last
    while first > 0:
        if holds(first - 1):
            first -= 1
        elif first > 1 and holds(first - 2):
            first -= 2
        else:
            break
    return first


def _named(rows: Sequence[Sequence[str]], first: int, width: int, typed: frozenset[int]) -> Layout:
    above = [[cell.strip().strip('"').strip() for cell in row] for row in rows[:first]]
    above = [row for row in above if not _is_rule(row)]
    scope = _scope(above, width)
    if scope is not None:
        return Layout(*scope, first, typed, has_clocks=scope[0][0] == "time")
    above, stated = _beside(_without_mark(above, width))
    units: tuple[str | None, ...] = (None,) * width
    used = 0
    if len(above) > 1 and _is_names(above[-2], width) and _is_units(above[-1], above[-2], width):
        units = tuple(unit if parse_unit(unit or "") else None for unit in map(_unit, _padded(above[-1], width)))
        used = 1
    if len(above) > used and _is_names(above[-1 - used], width):
        names = tuple(_padded(above[-1 - used], width))
        properties = {**properties_of(above[: -1 - used]), **stated}
        has_clocks = names.count(names[0]) > 1 and meaning(names[0]).roles[:1] == ("time",)
        return Layout(names, units, first, typed, properties, has_clocks=has_clocks)
    numbered = tuple(str(j + 1) for j in range(width))
    last = above[-1] if above else []
    is_text = sum(bool(cell) for cell in last) > 1 and all(number(cell) is None for cell in last if cell)
    return Layout(numbered, units, first, typed, properties_of(above), False, len(last) if is_text else 0)


def _is_rule(row: Sequence[str]) -> bool:
    """Tell whether a row is a line below a heading, as ``|---|:--:|`` in notes; a row of units has single dashes."""
    given = [cell for cell in row if cell]
    return bool(given) and all(len(cell) > 1 and not cell.strip("-=:+_") for cell in given)


def _without_mark(above: list[list[str]], width: int) -> list[list[str]]:
    """Leave out a row of one text below one that names most columns, as ``trace_values`` of dSPACE: numbers follow."""
    if len(above) < 2 or not _is_names(above[-2], width) or 2 * sum(map(bool, above[-2])) <= width:
        return above
    given = [cell for cell in above[-1] if cell]
    is_mark = len(given) == 1 and number(given[0]) is None and not parse_unit(_unit(given[0]) or "")
    return above[:-1] if is_mark else above


def _beside(above: list[list[str]]) -> tuple[list[list[str]], dict[str, str]]:
    """Take out what an oscilloscope states beside its rows of names and units, and call its count of samples so.

    It is ``X,CH1,Start,Increment`` above ``Sequence,VOLT,-0.1,1e-3``, where no rows stand below start and increment.
    """
    if len(above) < 2 or _COUNT not in (labels := [cell.lower() for cell in above[-1]]):
        return above, {}
    names = ["X_Value" if label == _COUNT else name for name, label in zip(above[-2], labels, strict=False)]
    stated = {name.lower(): cell for name, cell in zip(names, labels, strict=False) if number(cell) is not None}
    kept = [j for j, cell in enumerate(labels[: len(names)]) if number(cell) is None]
    units = ["" if labels[j] == _COUNT else above[-1][j] for j in kept]
    return [*above[:-2], [names[j] for j in kept], units], stated


def _is_names(row: Sequence[str], width: int) -> bool:
    """Tell whether a row can name the columns: about as many cells, and texts rather than numbers."""
    given = [cell for cell in row if cell]
    return len(row) <= width + 1 and 2 * len(row) > width and any(number(cell) is None for cell in given)


def _is_units(row: Sequence[str], names: Sequence[str], width: int) -> bool:
    """Tell whether a row holds units: no words beside them, or more units than words below names that say more."""
    given = [unit for cell in row if cell and (unit := _unit(cell))]
    if len(row) > width + 1 or not given:
        return False
    is_mixed = 2 * sum(ordinary_unit(unit) is not None for unit in given) > len(given) and _said(names) > _said(row)
    return is_mixed or all(parse_unit(unit) for unit in given)


def _said(row: Sequence[str]) -> int:
    """Return how many cells say in words what a column holds."""
    return sum(bool(meaning(cell).roles) and ordinary_unit(cell) is None for cell in row if cell)


def _unit(cell: str) -> str | None:
    bracketed = _BRACKETED.fullmatch(cell)
    text = bracketed[1] if bracketed else cell
    return None if text in ("", "-") else text


def _padded(row: Sequence[str], width: int) -> list[str]:
    return [*row[:width], *[""] * (width - len(row))]


def properties_of(rows: Iterable[Sequence[str]]) -> dict[str, str]:
    """Return the ``key: value`` lines and the ``key, value`` rows of a preamble, keys in small letters."""
    found: dict[str, str] = {}
    for row in rows:
        cells = [cell for cell in row if cell]
        match = _PROPERTY.fullmatch(cells[0]) if cells else None
        if match and match[2]:
            found[match[1].strip().lower()] = match[2]
        elif len(cells) >= 2:
            found[cells[0].rstrip(":=").strip().lower()] = cells[1]
    return found


def units_above(head: Iterable[Sequence[str]], units: Sequence[str | None]) -> tuple[str | None, ...]:
    """Return the units of columns, with those of a LabVIEW measurement file's header where a column has none.

    Parameters
    ----------
    head : iterable of sequence of str
        Its rows; the one of the units begins with ``Y_Unit_Label``.
    units : sequence of (str or None)
        As the rows below state them.
    """
    row: Sequence[str] = next((row for row in head if row and row[0].strip().lower() == _LABVIEW_UNITS), ())
    labels = [None, *(cell.strip() for cell in row[1:])]
    known = [label if label and parse_unit(label) else None for label in labels]
    known += [None] * (len(units) - len(known))
    return tuple(unit or label for unit, label in zip(units, known, strict=False))


def _scope(above: Sequence[Sequence[str]], width: int) -> tuple[tuple[str, ...], tuple[str | None, ...]] | None:
    """Return names and units of a TwinCAT Scope export, whose header rows begin with what they tell.

    Where a time line begins, the label stands again: ``Name, a, b, Name, c`` above ``time, a, b, time, c``. Times are
    milliseconds from the beginning. A channel has a name for people and a symbol; the one that says more is taken.
    """
    labelled = {row[0].lower(): row for row in above if row and row[0]}
    if "name" not in labelled or not any(label in labelled for label in _SCOPE):
        return None
    spoken = _padded(labelled["name"], width)
    symbols = _padded(labelled.get("symbolname", labelled["name"]), width)
    names = [
        name if meaning(name).roles and not meaning(own).roles else own
        for name, own in zip(spoken, symbols, strict=True)
    ]
    units: list[str | None] = [_scope_unit(cell) for cell in _padded(labelled.get("unit", []), width)]
    for j, name in enumerate(spoken):
        if name == spoken[0]:
            names[j], units[j] = "time", "ms"
    return tuple(names), tuple(units)


def _scope_unit(cell: str) -> str | None:
    """Return ``mm`` of ``mm (Length)``, None of ``(None)``."""
    return _unit(cell if _BRACKETED.fullmatch(cell) and cell != "(None)" else cell.partition("(")[0].strip())
