"""What chosen columns lack and others, or rows before, supply: a held value, a magnitude's sign, a reference."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servolens.encoder import SPAN, white_noise
from servolens.errors import InputError
from servolens.findings import Finding
from servolens.reading.files import quote
from servolens.reading.guess import Guess
from servolens.reading.narrowing import alike, near
from servolens.reading.roles import candidates, turns, typed
from servolens.reading.scales import VELOCITY_AGREES, is_counted, travel_of
from servolens.reading.words import allows, meaning
from servolens.units import parse_unit

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from servolens.reading.roles import Choice
    from servolens.reading.table import Column, Table

    Values = NDArray[np.float64]

__all__ = ["held", "length_by_error", "referred", "signed"]

PLAIN_LENGTHS = ("m", "rad", "mm", "deg")
"""Units of positions that are plausible where none is stated."""
WHOLE = "it holds whole numbers and states no unit: say what one is, e.g. --unit 'reference=0.01 mm'"
"""Why no reference is made of a counted error beside a position that is not."""
HELD = ("reference", "feedforward", "enabled")
"""Signals that keep their value until a new one is set."""
MOVING = 0.1
"""Share of the largest speed from which on an axis moves."""
WORK = 0.1
"""Correlation of a command, or an error, with the speed from which on it surely drives the axis; chosen: a few times
that of unrelated signals in short records, and less than that of the axes of the laboratory (0.15 to 0.8)."""


def held(chosen: Mapping[str, Choice]) -> tuple[dict[str, Choice], list[Finding]]:
    """Return the columns with blank cells filled where a signal holds its value, and what was done.

    Cells before the first value stay blank, as do all of a column with other texts.

    Parameters
    ----------
    chosen : mapping of str to Choice
        The columns of the signals.
    """
    filled, remarks = dict(chosen), list[Finding]()
    for signal in HELD:
        choice = chosen.get(signal)
        if choice is None or not _has_blanks(choice.column):
            continue
        values = choice.column.values
        known = np.isfinite(values)
        latest = np.maximum.accumulate(np.where(known, np.arange(values.size), 0))
        filled[signal] = replace(choice, column=replace(choice.column, values=values[latest], fault=None))
        message = (
            f"the {signal} is blank in {np.count_nonzero(~known)} of {values.size} rows; each value was held until the"
            " next one. If it moved in between, log it in each row."
        )
        remarks.append(Finding(code=f"{signal}_held", severity="note", message=message))
    return filled, remarks


def _has_blanks(column: Column) -> bool:
    values = column.values
    if column.fault is not None and not column.fault.is_blank:
        return False
    return bool(values.dtype.kind == "f" and values.size and np.isfinite(values[0]) and np.isnan(values).any())


def signed(chosen: Mapping[str, Choice], tables: Sequence[Table]) -> tuple[dict[str, Choice], list[Finding]]:
    """Return the columns with a command that was logged without its sign given that of the direction beside it.

    Which of two values is forward, the work tells: what drives an axis from rest does not take power out of it, so that
    command and speed correlate. Where it tells nothing, 1 is forward of 1 and -1. A direction that is just that of the
    motion tells no command's sign. Without a direction, nor a reference by which the control law tells, a command of
    one sign is remarked on where the axis goes both ways.

    Parameters
    ----------
    chosen : mapping of str to Choice
        The columns of the signals.
    tables : sequence of Table
        Of the file.

    Raises
    ------
    InputError
        If a direction stands beside the command and leaves open what it means.
    """
    choice, position = chosen.get("voltage"), chosen.get("position")
    if choice is None or position is None or not _is_magnitude(choice.column):
        return dict(chosen), []
    beside = [column for column in tables[choice.table].columns if _is_direction(column, choice.column)]
    if not beside:
        asks = "reference" not in chosen and turns(position.column.values)
        return dict(chosen), [_of_one_sign(choice)] if asks else []
    left = [column for column in beside if not _is_of_motion(column, position)]
    if not left:
        return dict(chosen), [_of_one_sign(choice, beside[0])]
    beside = left
    signs, why = _signs(beside[0], choice, position) if len(beside) == 1 else (None, "")
    if signs is None:
        raise InputError(
            f"column {quote(choice.label)} has one sign throughout, and what {quote(beside[0].name)} says of its"
            " direction is not clear; log the command with its sign, or the direction as 1 and -1"
        )
    column = replace(choice.column, values=choice.column.values * signs)
    message = f"the voltage, {quote(choice.label)}, was given the sign of {quote(beside[0].name)}{why}."
    remark = Finding(code="voltage_signed", severity="note", message=message)
    evidence = f"{choice.evidence}; its sign from {quote(beside[0].name)}{why}"
    return {**chosen, "voltage": replace(choice, column=column, evidence=evidence)}, [remark]


def _is_direction(column: Column, command: Column) -> bool:
    values = column.values
    stands = values.size > 0 and bool(np.isfinite(values).all() and np.ptp(values) == 0)
    is_one = meaning(column.name, column.unit).kind == "direction" and not stands
    return is_one and values.size == command.values.size


def _of_one_sign(choice: Choice, direction: Column | None = None) -> Finding:
    begin = f"the voltage, {quote(choice.label)}, has one sign throughout"
    if direction is None:
        message = (
            f"{begin} while the axis goes both ways; if it is a magnitude, log it with its sign, or beside it a column"
            " direction of 1 and -1."
        )
    else:
        message = (
            f"{begin}, and {quote(direction.name)} beside it is the direction of the motion, which does not tell the"
            " command's; if it is a magnitude, log it with its sign."
        )
    return Finding(code="voltage_of_one_sign", severity="warning", message=message)


def _is_magnitude(column: Column) -> bool:
    values = column.values
    return bool(column.fault is None and values.size and np.min(values) >= 0 and np.any(values))


def _levels(direction: Column, position: Choice) -> Values | None:
    """Return a direction as 1, -1 and perhaps 0, the larger of two values as 1; None where it is no such thing."""
    values = direction.values
    if direction.fault is not None or not np.isfinite(values).all():
        return None
    levels = np.unique(values)
    if set(levels.tolist()) <= {-1.0, 0.0, 1.0} and -1.0 in levels:
        return values
    y = position.column.values
    if levels.size != 2 or y.size != values.size or not np.isfinite(y).all():
        return None
    return np.where(values == levels[1], 1.0, -1.0)


def _is_of_motion(direction: Column, position: Choice) -> bool:
    """Tell whether a direction is that of the speed, or against it, at nearly all samples at which the axis moves.

    It may come late, as from a filter, but not early: a command turns round before the axis does, to brake it.
    """
    signs, found = _levels(direction, position), _speed(position)
    if signs is None or found is None or found[0].size != signs.size:
        return False
    speed, moving = found
    along = np.sign(signs * speed)[moving]
    odd = np.flatnonzero(along != (1.0 if np.sum(along) > 0 else -1.0))
    if not along.size or odd.size > VELOCITY_AGREES * along.size:
        return False
    turned = np.flatnonzero(np.diff(np.sign(speed[moving]))) + 1
    bounds = np.concatenate(([0], turned, [along.size]))
    following = np.searchsorted(bounds, odd, side="right")
    early = bounds[following] - odd < odd - bounds[following - 1]
    return int(np.count_nonzero(early)) <= turned.size  # one sample each, as differences of positions are


def _speed(position: Choice) -> tuple[Values, NDArray[np.bool_]] | None:
    """Return how far the axis goes within some samples around each, and where it moves; None where nothing tells.

    So many samples are taken that the motion stands out of the position's noise.
    """
    y = position.column.values
    if y.dtype.kind not in "iuf" or y.size <= 2 or not np.isfinite(y).all():
        return None
    y = y.astype(np.float64)
    noise, step = SPAN * white_noise(y), 1
    while True:
        speed = np.zeros(y.size)
        speed[step:-step] = y[2 * step :] - y[: -2 * step]
        largest = float(np.max(np.abs(speed)))
        if largest > noise or 4 * step >= y.size:
            break
        step *= 2
    moving = np.abs(speed) > max(MOVING * largest, noise)
    moving[:step] = moving[step]
    speed[:step] = speed[step]
    return speed, moving


def _signs(direction: Column, command: Choice, position: Choice) -> tuple[Values | None, str]:
    """Return 1 and -1 by sample, and how they were found; None where the direction leaves them open."""
    signs, y = _levels(direction, position), position.column.values
    if signs is None:
        return None, ""
    is_signed = signs is direction.values
    found = _speed(position)
    if found is None or y.size != signs.size or found[1][0]:  # an axis that moves already may be braked
        return (signs if is_signed else None), ""
    driven, speed = (signs * command.column.values)[1:-1], y[2:] - y[:-2]
    size = float(np.linalg.norm(driven) * np.linalg.norm(speed))
    work = float(driven @ speed) / size if size > 0 else 0.0
    if is_signed and work > -WORK:
        return signs, ""
    levels = np.unique(direction.values)
    forward = levels[-1] if work > 0 else levels[0]
    why = f" ({forward:g} is forward, as command and speed agree: r = {abs(work):.2f})"
    return (None if abs(work) < WORK else np.sign(work) * signs), why


def referred(
    chosen: Mapping[str, Choice], unit: str | None, tables: Sequence[Table], stated: str | None
) -> tuple[Choice | None, list[Finding]]:
    """Return the reference that the position and the logged error make where none is logged, and remarks.

    That the error is reference less position, and not the other way round, the motion tells: a loop drives its axis by
    the error, so that error and speed correlate. And the position's noise is in its error, but not in the reference,
    which tells the error's unit too: that of the position, or SI. Where one of the two does not hold, no reference is
    made of it: it may be another error.

    Parameters
    ----------
    chosen : mapping of str to Choice
        The columns of the signals.
    unit : str or None
        Of the position; None is SI.
    tables : sequence of Table
        Of the file.
    stated : str or None
        Unit of the error, where the caller gives it as that of the reference.

    Raises
    ------
    InputError
        If no reference can be made of the error, and no command is logged either.
    """
    position = chosen["position"]
    error, found = _error_beside(position, chosen, tables), _speed(position)
    if error is None or found is None:
        return None, []
    is_needed = "voltage" not in chosen
    moved, speed = error.column.values[found[1]], found[0][found[1]]
    size = float(np.linalg.norm(moved) * np.linalg.norm(speed))
    work = float(moved @ speed) / size if size > 0 else 0.0
    if abs(work) < WORK:
        return None, _not_used(error, "it does not go with the motion", is_needed=is_needed)
    sign, way = (1.0, "+") if work > 0 else (-1.0, "-")
    y, e = position.column.values, sign * error.column.values
    given = stated or error.unit
    scales = {own: _per_error(unit, own) for own in ((given,) if given else (unit, _si_of(unit)))}
    fitting = [(own, scale) for own, scale in scales.items() if scale is not None and _is_left_of(scale * y, e)]
    if not fitting:
        is_counted_alone = given is None and error.column.is_integer and not position.column.is_integer
        why = WHOLE if is_counted_alone else _why_not(unit, scales, y, e)
        return None, _not_used(error, why, is_needed=is_needed)
    own, scale = fitting[0]
    how = "go together" if work > 0 else "are opposed"
    evidence = f"no reference is logged; error and speed {how} (r = {abs(work):.2f})"
    source = f"{position.address} {way} {error.address}"
    origin = Guess(quantity="reference", source=source, value=own or "", evidence=evidence)
    column = replace(error.column, name=source, values=scale * y + e, unit=own, origin=origin)
    return replace(error, column=column), []


def length_by_error(chosen: Mapping[str, Choice], tables: Sequence[Table]) -> dict[str, tuple[str, str]]:
    """Return the position's unit, where it states none, by the error beside it that states one, and why.

    Empty where the error holds the position's noise in none of the units that an axis without one is asked about.

    Parameters
    ----------
    chosen : mapping of str to Choice
        The columns of the signals.
    tables : sequence of Table
        Of the file.
    """
    position = chosen["position"]
    error = _error_beside(position, chosen, tables)
    if error is None or error.unit is None:
        return {}
    y, e = position.column.values, error.column.values
    for unit in dict.fromkeys((error.unit, *PLAIN_LENGTHS)):
        scale = _per_error(unit, error.unit)
        if scale is not None and (_is_left_of(scale * y, e) or _is_left_of(scale * y, -e)):
            return {"position": (unit, f"its noise is that of {quote(error.address)} [{error.unit}]")}
    return {}


def _error_beside(position: Choice, chosen: Mapping[str, Choice], tables: Sequence[Table]) -> Choice | None:
    """Return the one column that is the position loop's error, by its name, and varies."""
    taken, size = {id(choice.column) for choice in chosen.values()}, position.column.values.size
    found = [
        replace(choice, meaning=replace(choice.meaning, roles=("reference",)))
        for choice in candidates(tables)
        if choice.meaning.kind == "error"
        and id(choice.column) not in taken
        and choice.column.values.size == size
        and travel_of(choice.column.values) > 0
        and (not choice.column.is_integer or position.column.is_integer or is_counted(choice.column))  # no flag
        and (choice.unit is None or allows("position", choice.unit))
    ]
    found = alike(near(found, position)) if found else []
    return found[0] if len(found) == 1 and found[0].table == position.table else None


def _roughness(values: Values) -> float:
    return float(np.sum(np.abs(np.diff(values, 2))))


def _is_left_of(position: Values, error: Values) -> bool:
    """Tell whether an error holds the position's noise just once: adding it takes it away, adding it twice not."""
    once, least = _roughness(position + error), 0.5 * _roughness(position)
    return _roughness(error) - once > least and _roughness(2 * position + error) - once > least


def _si_of(unit: str | None) -> str | None:
    """Return the SI unit of a position that is in `unit`; counts have none."""
    parsed = parse_unit(unit or "")
    return next((si for si in ("m", "rad") if parsed and dict(parsed.dimension) == {si: 1}), unit)


def _per_error(unit: str | None, own: str | None) -> float | None:
    """Return units of the error in one of the position, None where they are of different kinds."""
    if unit == own:
        return 1.0
    mine, errors = parse_unit(unit or ""), parse_unit(own or "")
    if errors is None:
        return None
    if mine is not None:
        return mine.factor / errors.factor if mine.dimension == errors.dimension else None
    return 1.0 / errors.factor if "count" not in dict(errors.dimension) else None


def _why_not(unit: str | None, scales: Mapping[str | None, float | None], position: Values, error: Values) -> str:
    """Return why an error in none of the units that were tried makes a reference."""
    given = next(iter(scales))
    if unit is None and given and _is_left_of(position, error):
        return f"it fits a position in {quote(given)}, which states no unit: say --unit {typed(f'position={given}')}"
    if not any(scales.values()):
        return f"it is in {quote(given or '')}, and the position in {quote(unit or 'SI')}"
    tried = f" (in {' and in '.join(own for own in scales if own)})" if given else ""
    return f"position and error{tried} add up to more noise than a reference has"


def _not_used(error: Choice, why: str, *, is_needed: bool) -> list[Finding]:
    """Remark on an error of which no reference was made.

    Raises
    ------
    InputError
        If there is no command either.
    """
    if is_needed:
        raise InputError(
            f"neither reference nor voltage is logged, and no reference could be made of {quote(error.address)}: {why};"
            " log the reference, or state it, e.g. --reference-step 0.1@0.5, or do without: --column reference=-"
        )
    message = (
        f"no reference was made of the column {quote(error.address)}: {why}. If it is reference less position, log the"
        " reference."
    )
    return [Finding(code="error_not_used", severity="note", message=message)]
