"""What speaks against columns that were chosen by their names: their rows, their numbers, a second unit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.errors import InputError
from servolens.reading.files import quote
from servolens.reading.roles import NAMED, NONE, typed
from servolens.reading.words import PERHAPS_ODRIVE, at_the_end, meaning
from servolens.units import parse_unit

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from servolens.reading.roles import Choice
    from servolens.reading.table import Column, Table

    Values = NDArray[np.float64]

__all__ = ["check_choices", "check_units_of_names"]

LABELS = frozenset({"id", "joint", "axis", "achse", "gelenk", "node", "name"})
"""Last words of a column that says of which axis a row is."""
MOST_AXES = 12
"""Axes whose rows may come by turns: robots with two arms have fewer."""
BY_TURNS = 0.5
"""Share of the rows from which on a label changes by turns; of records one after the other it changes rarely."""
FEWEST_ROWS = 20
NEARER, STEADY = 0.5, 0.2
"""Share of its distance from the position, mean square, below which a set point that moves, and one that does not, may
be the speed's."""
TAKEN_TURNS = 0.1
"""Share of its steps by which a position differs some rows later, where rows of as many axes take turns."""
ODRIVE = frozenset({"pos_estimate", "input_pos", "iq_setpoint", "iq_measured", "vbus_voltage"})
"""Names of ODrive's of which two stand in a log of it."""


def check_choices(tables: Sequence[Table], chosen: Mapping[str, Choice], found: Sequence[Choice]) -> None:
    """Refuse rows of several axes by turns, and ask about a set point that the speed follows.

    Parameters
    ----------
    tables : sequence of Table
        Of the file.
    chosen : mapping of str to Choice
        The columns of the signals.
    found : sequence of Choice
        All columns.

    Raises
    ------
    InputError
        With one sentence.
    """
    for column in tables[chosen["position"].table].columns:
        if all(column is not choice.column for choice in chosen.values()) and _labels_rows(column, chosen["position"]):
            raise InputError(
                f"the rows seem to be of several axes by turns, as column {quote(column.name)} says; keep the rows of"
                " one axis"
            )
    _check_set_point(chosen, found)


def _labels_rows(column: Column, position: Choice) -> bool:
    """Tell whether a column says of which axis each row is, and says it of another in most rows."""
    words = [word for word in column.name.lower().replace(".", "_").replace(" ", "_").split("_") if word]
    if not words or words[-1] not in LABELS:
        return False
    values = column.values
    if column.fault is None and np.isfinite(values).all():
        is_one_of_few = 2 <= np.unique(values).size <= MOST_AXES and column.is_integer
        return is_one_of_few and float(np.mean(np.diff(values) != 0)) >= BY_TURNS
    return column.fault is not None and _comes_by_turns(position.column.values)


def _comes_by_turns(values: Values) -> bool:
    """Tell whether a position goes to and fro from row to row, as where rows of some axes take turns."""
    if values.dtype.kind not in "iuf" or values.size < FEWEST_ROWS * MOST_AXES or not np.isfinite(values).all():
        return False
    moved = [float(np.mean(np.abs(values[count:] - values[:-count]))) for count in range(1, MOST_AXES + 1)]
    return min(moved[1:]) < TAKEN_TURNS * moved[0]


def _check_set_point(chosen: Mapping[str, Choice], found: Sequence[Choice]) -> None:
    """Ask about a reference of which no word says that it is one of the position, and which a logged speed follows."""
    reference, position = chosen.get("reference"), chosen["position"]
    if reference is None or reference.meaning.kind or reference.unit or reference.evidence == NAMED:
        return
    speeds = [c for c in found if c.meaning.roles == ("velocity",) and c.table == position.table]
    columns = [c.column.values for c in (reference, position, *speeds)]
    if not speeds or len({values.size for values in columns}) > 1 or columns[0].size < FEWEST_ROWS:
        return
    if not all(values.dtype.kind in "iuf" and np.isfinite(values).all() for values in columns):
        return
    r, y, *others = columns
    for choice, speed in zip(speeds, others, strict=True):
        if _follows(r, speed, y):
            label = typed(reference.address)
            raise InputError(
                f"column {quote(reference.address)} seems to be the set point of the speed {quote(choice.address)}; say"
                f" --column reference={NONE} if the position has none, or --column reference={label}"
            )


def _follows(reference: Values, speed: Values, position: Values) -> bool:
    """Tell whether a speed rather than the position follows a set point, all in the same numbers."""
    nearer = float(np.mean((reference - speed) ** 2)) / max(float(np.mean((reference - position) ** 2)), 1e-300)
    if np.ptp(reference) == 0 or np.ptp(speed) == 0 or np.ptp(position) == 0:
        return bool(reference[0] != 0 and np.ptp(speed) > 0 and nearer < STEADY)
    likeness = np.asarray(np.corrcoef(np.stack([reference, speed, position])))[0]
    return nearer < NEARER and bool(likeness[1] > likeness[2])


def check_units_of_names(signal: str, choice: Choice, names: Iterable[str]) -> None:
    """Ask about a column with one unit in its name and another behind it, as ``pos_mm [m]``, or perhaps ODrive's.

    Parameters
    ----------
    signal : str
        What it is.
    choice : Choice
        The column.
    names : iterable of str
        Of all columns.

    Raises
    ------
    InputError
        With both units.
    """
    if choice.meaning.where == PERHAPS_ODRIVE and len(ODRIVE & {name.lower() for name in names}) < 2:
        raise InputError(
            f"column {quote(choice.address)} may be in revolutions, as ODrive's of that name, or in m; say"
            f" --unit {signal}=rev or --unit {signal}=m"
        )
    own, stated = at_the_end(choice.column.name), meaning(choice.column.name, choice.column.unit).unit
    one, other = (parse_unit(text) if text else None for text in (own, stated))
    if one is None or other is None or one.dimension != other.dimension or np.isclose(one.factor, other.factor):
        return
    answers = " or ".join("--unit " + typed(f"{signal}={text}") for text in (own, stated))
    raise InputError(
        f"column {quote(choice.column.name)} has {own} in its name and {stated} as its unit; say {answers}"
    )
