"""Which column of a table is which signal, and the unit its heading states."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, final

from servolens.errors import InputError
from servolens.reading.files import quote
from servolens.record import SIGNALS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

__all__ = ["Heading", "check_mapping", "heading", "select"]

ALIASES = {"time": ("t",)}
_UNIT = re.compile(r"(.*?)\s*\[([^\[\]]*)\]\s*", re.DOTALL)


@final
@dataclass(frozen=True, slots=True)
class Heading:
    """A column's name and the text of its unit; None where no unit is stated."""

    name: str
    unit: str | None = None


def heading(text: str) -> Heading:
    """Split ``"position [mm]"`` into name and unit.

    Examples
    --------
    >>> heading("position [mm]")
    Heading(name='position', unit='mm')
    """
    text = text.strip().strip('"').strip()
    match = _UNIT.fullmatch(text)
    if match is None or re.search(r"\S\[\d+\]$", text):  # y[0] is an index, not a unit
        return Heading(text)
    unit = match[2].strip()
    return Heading(match[1].strip(), None if unit in ("", "-") else unit)


def select(texts: Sequence[str], columns: Mapping[str, str] | None) -> dict[str, tuple[int, Heading]]:
    """Return for each signal that the table holds the index of its column and its heading.

    Parameters
    ----------
    texts : sequence of str
        The headings.
    columns : mapping, optional
        Signal to column name, for tables with names of their own.

    Raises
    ------
    InputError
        If time or position is missing, a mapped column is missing, or a needed name stands twice.
    """
    mapping = check_mapping(columns, "columns")
    headings = [heading(text) for text in texts]
    found: dict[str, tuple[int, Heading]] = {}
    for signal in SIGNALS:
        index = _mapped(mapping[signal], signal, texts, headings) if signal in mapping else _named(signal, headings)
        if index is not None:
            found[signal] = (index, headings[index])
    missing = [signal for signal in ("time", "position") if signal not in found]
    if missing:
        raise InputError(
            f"no column named {' and none named '.join(missing)}; {_offer(headings)}"
            f" (map names of your own, e.g. --column {missing[0]}=NAME)"
        )
    return found


def check_mapping(mapping: Mapping[str, str] | None, what: str) -> dict[str, str]:
    """Return a mapping from signals to texts, or refuse it.

    Raises
    ------
    InputError
        If a key is no signal or a value no text.
    """
    checked = dict(mapping or {})
    for signal, text in checked.items():
        if signal not in SIGNALS:
            raise InputError(f"{what}: no signal is named {quote(signal)}; known are {', '.join(SIGNALS)}")
        if not isinstance(text, str):
            raise InputError(f"{what}: {signal} must be a text, got {quote(text)}")
    return checked


def _mapped(name: str, signal: str, texts: Sequence[str], headings: Sequence[Heading]) -> int:
    hits = [i for i, h in enumerate(headings) if name in (h.name, texts[i].strip())]
    if not hits:
        raise InputError(f"no column named {quote(name)} for {signal}; {_offer(headings)}")
    return _single(hits, name)


def _named(signal: str, headings: Sequence[Heading]) -> int | None:
    """Look for the exact name, then for it in other letters, then for an alias."""
    for wanted in (signal, *ALIASES.get(signal, ())):
        exact = [i for i, h in enumerate(headings) if h.name == wanted]
        hits = exact or [i for i, h in enumerate(headings) if h.name.lower() == wanted]
        if hits:
            return _single(hits, wanted)
    return None


def _single(hits: Sequence[int], name: str) -> int:
    if len(hits) > 1:
        raise InputError(f"{len(hits)} columns are named {quote(name)}; names must differ")
    return hits[0]


def _offer(headings: Sequence[Heading]) -> str:
    names = ", ".join(h.name for h in headings if h.name)
    return f"the columns are {quote(names)}" if names else "the table has no named columns"
