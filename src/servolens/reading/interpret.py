"""From the tables of a file to the signals of a record: columns, units, one clock, and the evidence for each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import InputError
from servolens.findings import Finding
from servolens.reading.clock import unwrapped, with_clock
from servolens.reading.completed import held, length_by_error, referred, signed
from servolens.reading.contradictions import check_choices, check_units_of_names
from servolens.reading.files import quote
from servolens.reading.guess import Guess
from servolens.reading.roles import (
    MOST_SHOWN,
    NAMED,
    NONE,
    Choice,
    candidates,
    check_mapping,
    choose,
    moving_axis,
    typed,
    unknown,
)
from servolens.reading.scales import (
    FASTEST_AXIS,
    LONGEST_AXIS,
    check_own_length,
    command_unit,
    is_alike,
    is_counted,
    is_huge,
    length_unit,
    passing_speed,
    time_unit,
    travel_of,
    unrounded,
    velocity_unit,
)
from servolens.reading.words import BY_ARMATURE, BY_KIND, BY_NAME, BY_PROTOCOL, DUTY, allows, meaning
from servolens.units import parse_unit, split_number

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from servolens.reading.table import Table

    Values = NDArray[np.float64]

__all__ = ["Interpretation", "interpret"]

EPOCH = 1e6
"""Times beyond this [s] count from an epoch (11 days after switching on): they are taken from the first sample."""
SURE_UNITS = ("in brackets", "behind its name", "stated beside its name")
"""Where a unit is one, whatever the signal; letters at the end of a name may be something else."""
SMOOTH_SIGNALS = ("position", "velocity")
GAIN_NAMES = {"kp": ("kp", "k_p", "p_gain", "pgain", "pos_gain"), "kd": ("kd", "k_d", "d_gain", "dgain")}
GAINS_BESIDE = {"kd", "ki", "kv", "kiv"}
"""Gains that are refused without kp."""
BY_CALLER = "unit given by you"


@final
@dataclass(frozen=True, slots=True, eq=False)
class Interpretation:
    """The signals of a file as logged, on one clock, and how they were found.

    Parameters
    ----------
    signals : mapping of str to ndarray, shape (n,)
        In the units of `units`.
    units : mapping
        Of the signals; None is SI.
    comments : mapping
        Settings that the file states.
    guesses : tuple of Guess
        One for each signal and for each setting that was not stated as such.
    columns : mapping
        Signal to the address of its column.
    found_gains : bool
        Whether gains among the comments were found beside the columns rather than stated as settings.
    remarks : tuple of Finding
        What was done to the columns.
    """

    signals: Mapping[str, Values]
    units: Mapping[str, str | None]
    comments: Mapping[str, str]
    guesses: tuple[Guess, ...]
    columns: Mapping[str, str]
    found_gains: bool = False
    remarks: tuple[Finding, ...] = ()


def interpret(
    tables: Sequence[Table],
    *,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    settings: Mapping[str, object] | None = None,
) -> Interpretation:
    """Find the signals of a record in the tables of a file.

    Parameters
    ----------
    tables : sequence of Table
        Of the file.
    columns, units : mapping, optional
        From the caller: signal to column name or number, signal to unit; they win.
    settings : mapping, optional
        From the caller; a gain's unit tells metres from radians.

    Raises
    ------
    InputError
        With one sentence: what is missing, or both readings where two are plausible.
    """
    given = {key: value for key, value in (settings or {}).items() if value is not None}
    tables = [with_clock(table, given) for table in tables if table.columns]
    if not tables:
        raise InputError("holds no columns of numbers")
    chosen, remarks = held(choose(tables, columns))
    check_choices(tables, chosen, candidates(tables))
    comments = {key: value for table in tables for key, value in table.comments.items()}
    gains = _constant_gains(tables, chosen["position"].table, {**comments, **given})
    stated, known = check_mapping(units, "units", "mm"), {**comments, **gains, **given}
    with moving_axis(chosen["position"]):
        chosen, of_sign = signed(chosen, tables)
        found = _units(chosen, stated, tables, known)
    remarks += [*of_sign, *dict.fromkeys(remark for table in tables for remark in table.remarks)]
    chosen = {signal: choice for signal, choice in chosen.items() if signal in found}
    if "reference" not in {*chosen, *(columns or {})} and not _states_reference(known):
        remarks += _take_reference(chosen, found, tables, stated.get("reference"))
    _check_numbers(chosen)
    remarks += _about_length(chosen, found, known)
    if not {"reference", "voltage"} & set(chosen) and not _states_reference(known):
        _refuse_undriven(tables)
    if "voltage" not in {*chosen, *(columns or {})} and ("kp" in known or not GAINS_BESIDE & set(known)):
        remarks += _about_command(tables, chosen, knows_gains="kp" in known)
    signals, texts = _on_one_clock(chosen, tables, {signal: text for signal, (text, _) in found.items()})
    signals["time"], wrapped = unwrapped(signals["time"], _factor(texts["time"]))
    if wrapped:
        remarks.append(Finding(code="clock_wrapped", severity="note", message=wrapped))
    guesses = [
        choice.column.origin or _guess(signal, choice, found[signal], by_caller=signal in stated)
        for signal, choice in chosen.items()
    ]
    why = "a column that holds one value"
    guesses += [Guess(quantity=key, source=key, value=value, evidence=why) for key, value in gains.items()]
    return Interpretation(
        signals=signals,
        units=texts,
        comments={**gains, **comments},
        guesses=tuple(guesses),
        columns={signal: c.address for signal, c in chosen.items() if signal == "time" or not c.column.origin}
        | {signal: NONE for signal, name in (columns or {}).items() if name == NONE},
        remarks=tuple(remarks),
        found_gains=bool(gains) and not {"kp", "kd"} & {*comments, *given},
    )


def _take_reference(
    chosen: dict[str, Choice], found: dict[str, tuple[str | None, str]], tables: Sequence[Table], stated: str | None
) -> list[Finding]:
    """Add the reference that an error beside the position makes to the columns and their units; return remarks."""
    made, remarks = referred(chosen, found["position"][0], tables, stated)
    if made is not None:
        chosen["reference"], found["reference"] = made, (made.column.unit, "")
    return remarks


def _states_reference(settings: Mapping[str, object]) -> bool:
    return any(settings.get(key) is not None for key in ("reference", "reference_file"))


def _refuse_undriven(tables: Sequence[Table]) -> None:
    """Refuse a log without reference and command, of which none is stated."""
    names = quote(", ".join(column.name for table in tables for column in table.columns))
    raise InputError(
        f"neither reference nor voltage is given, and none of the columns {names} is named so; name one, e.g. --column"
        " voltage=NAME, or state a reference that was not logged, e.g. --reference-step 0.1@0.5 or"
        " --reference-file FILE"
    )


def _about_command(tables: Sequence[Table], chosen: Mapping[str, Choice], *, knows_gains: bool) -> list[Finding]:
    """Refuse a log without command and gains by the columns that may be the command; with gains, remark on volts."""
    left = unknown(tables, chosen)
    volts = [choice for choice in left if _is_voltage(choice.unit)]
    if not left or (knows_gains and not volts):
        return []
    shown = ", ".join(quote(choice.label) for choice in (volts or left)[:MOST_SHOWN])
    shown = f"one of {shown}" if len(volts or left) > 1 else shown
    answer = f"--column voltage={typed((volts or left)[0].address)}"
    which = f"{shown} (in volts)" if volts else shown
    if knows_gains:
        message = f"no column is known as the command; if it is {which}, name it, e.g. {answer}."
        return [Finding(code="command_not_known", severity="note", message=message)]
    raise InputError(
        f"the gains are unknown and no column is known as the command; if it is {which}, name it, e.g. {answer}, else"
        " give kp and kd (on the command line --record-kp and --record-kd)"
    )


def _is_voltage(text: str | None) -> bool:
    unit, volt = parse_unit(text or "1"), parse_unit("V")
    return unit is not None and volt is not None and unit.dimension == volt.dimension


def _constant_gains(tables: Sequence[Table], at: int, stated: Mapping[str, object]) -> dict[str, str]:
    """Return the gains that a file holds as columns of one value, or states in its preamble."""
    table = tables[at]
    found: dict[str, str] = {}
    for key, names in GAIN_NAMES.items():
        if stated.get(key) is not None:
            continue
        texts = [table.properties[name] for name in names if name in table.properties]
        for column in table.columns:
            values = column.values
            if column.name.strip().lower() in names and values.size and np.all(values == values[0]):
                texts.append(f"{float(values[0])!r} {column.unit or ''}".strip())
        if len(set(texts)) == 1 and _is_amount(texts[0]):
            found[key] = texts[0]
    return found if "kp" in found or stated.get("kp") is not None else {}


def _is_amount(text: str) -> bool:
    try:
        split_number(text)
    except InputError:
        return False
    return True


def _units(
    chosen: Mapping[str, Choice], stated: Mapping[str, str], tables: Sequence[Table], settings: Mapping[str, object]
) -> dict[str, tuple[str | None, str]]:
    """Return each signal's unit and where it is from; a velocity that cannot be used is left out."""
    names = [column.name for table in tables for column in table.columns]
    found: dict[str, tuple[str | None, str]] = {}
    for signal, choice in chosen.items():
        if signal in stated:
            found[signal] = stated[signal], BY_CALLER
            continue
        check_units_of_names(signal, choice, names)
        if choice.unit is not None and (choice.meaning.where in SURE_UNITS or _may_be(choice, signal)):
            found[signal] = choice.unit, f"unit {choice.meaning.where}" if choice.meaning.where else ""
    is_open = "position" not in found and "reference" not in chosen and not _is_record(chosen)
    if is_open and not (_has_counts(settings) or _states_length(settings)):
        found |= length_by_error(chosen, tables)
    for signal in ("time", "position", "reference", "voltage", "velocity", "feedforward", "enabled"):
        if signal in chosen and signal not in found:
            unit = _unstated(signal, chosen, found, settings)
            if unit is not None:
                found[signal] = unit
    return found


def _may_be(choice: Choice, signal: str) -> bool:
    """Tell whether a column may be in the unit that its name implies: a servo's protocol counts in whole numbers."""
    values = choice.column.values
    if choice.unit == DUTY and choice.meaning.where == BY_NAME and np.max(np.abs(values), initial=0.0) > 1:
        return False
    if choice.meaning.where == BY_KIND and (is_counted(choice.column) or is_huge(choice)):
        return False
    is_mark = choice.unit == "m" and choice.meaning.symbol and values.dtype.kind in "iuf" and values.size > 0
    if is_mark and np.ptp(values) > LONGEST_AXIS:
        return False  # the m of y_m may as well say that it was measured
    return allows(signal, choice.unit or "") and (BY_PROTOCOL not in choice.meaning.where or choice.column.is_integer)


def _unstated(
    signal: str,
    chosen: Mapping[str, Choice],
    found: Mapping[str, tuple[str | None, str]],
    settings: Mapping[str, object],
) -> tuple[str | None, str] | None:
    """Return the unit of a column that states none, and why; None for one that cannot be used."""
    choice = chosen[signal]
    is_own = choice.is_stated and (choice.evidence == NAMED or _is_record(chosen))
    if signal == "time":
        return time_unit(choice)
    if signal in ("position", "reference"):
        beside = "reference" if signal == "position" else "position"
        partner, other = chosen.get(beside), found.get(beside)
        if is_own and choice.evidence != NAMED and not _follows(choice, partner, other):
            if partner is not None and other is not None and other[0] and other[1] != BY_CALLER:
                check_own_length(signal, choice, partner, other[0])
            return None, ""
        speed = passing_speed(choice, chosen["time"], found["time"][0]) if signal == "position" else 0.0
        return _length(choice, partner, other, settings, speed)
    if signal == "voltage" and (not is_own or choice.unit or choice.meaning.where == BY_ARMATURE):
        return command_unit(choice)
    if signal == "velocity" and (not choice.is_stated or choice.evidence == NAMED):
        return velocity_unit(choice, chosen, {key: text for key, (text, _) in found.items()})
    return None, ""


def _is_record(chosen: Mapping[str, Choice]) -> bool:
    """Tell whether all columns have the names of record files, whose numbers are in SI where no unit stands."""
    return all(choice.is_stated for choice in chosen.values())


def _follows(choice: Choice, beside: Choice | None, other: tuple[str | None, str] | None) -> bool:
    """Tell whether a column is in the unit that the caller has given for its partner, as far as both travel."""
    if beside is None or other is None or other[1] != BY_CALLER:
        return False
    return is_alike(choice, beside, other[0] or "")


def _length(
    choice: Choice,
    beside: Choice | None,
    other: tuple[str | None, str] | None,
    settings: Mapping[str, object],
    speed: float,
) -> tuple[str | None, str]:
    """Return the unit of a position or a reference that states none."""
    if choice.evidence == NAMED and other is not None and other[1] == BY_CALLER:
        return other[0], "the unit of what belongs to it"
    if _has_counts(settings):
        return None, ""
    settled = other[0] if other else None
    is_settled = bool(settled and beside and is_alike(choice, beside, settled))
    if _states_length(settings) and not is_settled:
        return None, "" if choice.is_stated else "SI, as the gains are stated"
    if choice.is_stated and not is_settled:  # asks where SI is not plausible
        unit = length_unit(choice, settled if choice.evidence == NAMED else None, beside, speed=speed)
        return unit if choice.meaning.kind == "angle" and choice.evidence == NAMED else (None, "")
    return length_unit(choice, settled, beside, speed=speed)


def _about_length(
    chosen: Mapping[str, Choice], found: Mapping[str, tuple[str | None, str]], settings: Mapping[str, object]
) -> list[Finding]:
    """Warn of a position of a record file that states no unit, nor do its gains, and is implausible in metres."""
    position = chosen["position"]
    travel, speed = travel_of(position.column.values), passing_speed(position, chosen["time"], found["time"][0])
    if found["position"] != (None, "") or (travel <= LONGEST_AXIS and speed <= FASTEST_AXIS):
        return []
    if _states_length(settings) or _has_counts(settings):
        return []
    how = f"it travels {travel:.4g} m" + (f", at up to {speed:.3g} m/s" if travel <= LONGEST_AXIS else "")
    message = (
        f"the column {quote(position.address)} states no unit and is taken in m, as record files have it: {how}; if"
        " that is mm, deg or rad, say so, e.g. --unit position=mm."
    )
    return [Finding(code="length_unit_assumed", severity="warning", message=message)]


def _has_counts(settings: Mapping[str, object]) -> bool:
    return settings.get("counts_per_unit") is not None or settings.get("counts_per_rev") is not None


def _states_length(settings: Mapping[str, object]) -> bool:
    """Tell whether a gain states metres or radians."""
    for key in ("kp", "kd", "encoder_resolution"):
        try:
            _, text = split_number(str(settings.get(key, "")))
        except InputError:
            continue
        unit = parse_unit(text) if text else None
        if unit and {"m", "rad"} & set(dict(unit.dimension)):
            return True
    return False


def _check_numbers(chosen: Mapping[str, Choice]) -> None:
    for signal, choice in chosen.items():
        if choice.column.switches is not None and signal != "enabled":
            raise InputError(choice.column.switches.sentence(signal))
        if choice.column.fault is not None:
            instead = f", or do without that column: --column {signal}={NONE}" if signal == "velocity" else ""
            raise InputError(choice.column.fault.sentence(signal) + instead)


def _guess(signal: str, choice: Choice, found: tuple[str | None, str], *, by_caller: bool) -> Guess:
    """Return how a signal was found."""
    return Guess(
        quantity=signal,
        source=choice.label,
        value=found[0] or "",
        evidence="; ".join(part for part in (choice.evidence, found[1]) if part),
        is_stated=choice.is_stated and (by_caller or found[0] is None or choice.unit is not None),
    )


def _on_one_clock(
    chosen: Mapping[str, Choice], tables: Sequence[Table], units: Mapping[str, str | None]
) -> tuple[dict[str, Values], dict[str, str | None]]:
    """Return the signals at the position's instants: what another clock has logged is held, a velocity interpolated."""
    time = chosen["time"].column.values
    home = chosen["position"].table
    if chosen["time"].table != home:
        own = _own_clock(tables, home)
        if own is None and chosen["position"].column.values.size != time.size:
            names = [quote(tables[k].name) if tables[k].name else "unnamed" for k in (home, chosen["time"].table)]
            raise InputError(
                f"position ({names[0]}, {chosen['position'].column.values.size} values) and time ({names[1]},"
                f" {time.size} values) stand in different tables of different lengths; name columns of one table"
            )
    first = float(time[0]) if time.size and np.isfinite(time[0]) else 0.0
    start = first if abs(first) * _factor(units.get("time")) > EPOCH else 0.0
    signals: dict[str, Values] = {}
    for signal, choice in chosen.items():
        values = choice.column.values
        other = None if choice.table == home or signal == "time" else _own_clock(tables, choice.table)
        if other is not None and not (other.size == time.size and np.array_equal(other, time)):
            values = _moved(values, other, time, smooth=signal in SMOOTH_SIGNALS, name=choice.address)
        signals[signal] = values
    if start:
        signals["time"] = unrounded(time) if np.isfinite(time).all() else time - start
    return signals, dict(units)


def _factor(text: str | None) -> float:
    unit = parse_unit(text) if text else None
    return unit.factor if unit else 1.0


def _own_clock(tables: Sequence[Table], index: int) -> Values | None:
    """Return the time of a table."""
    try:
        return choose([tables[index]], None)["time"].column.values
    except (InputError, KeyError):
        pass
    named = [c for c in tables[index].columns if meaning(c.name, c.unit).roles[:1] == ("time",)]
    return named[0].values if named else None


def _moved(values: Values, own: Values, time: Values, *, smooth: bool, name: str) -> Values:
    """Return a signal of another clock at the instants of `time`."""
    if own.size != values.size or own.size == 0 or not np.isfinite(own).all() or np.any(np.diff(own) < 0):
        raise InputError(f"column {quote(name)} has a clock of its own that does not increase; export it on one clock")
    if smooth:
        return np.interp(time, own, values)
    return values[np.clip(np.searchsorted(own, time, side="right") - 1, 0, None)]
