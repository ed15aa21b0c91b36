"""From columns and settings in whatever units to a record in SI."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING, Any, Literal, cast

from servolens.errors import InputError
from servolens.findings import Finding
from servolens.reading.counts import Scales
from servolens.reading.files import quote
from servolens.reading.reference_file import read_reference_file
from servolens.reading.roles import check_mapping
from servolens.reading.settings import Settings, parse_settings
from servolens.reading.stated import stated_reference
from servolens.record import Controller, Record
from servolens.units import COMMAND_UNITS, LENGTH_UNITS, Unit, parse_unit

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    import numpy as np
    from numpy.typing import NDArray

    from servolens.reading.reference_file import ReferenceFile

__all__ = ["assemble"]

Signals = dict[str, "NDArray[np.float64]"]
Stated = dict[str, tuple[str, Unit]]

SIGNAL_UNITS = {
    "position": "{length}",
    "reference": "{length}",
    "voltage": "{command}",
    "time": "s",
    "velocity": "{length}/s",
    "feedforward": "{command}",
    "encoder_resolution": "{length}",
    "kp": "{command}/{length}",
    "kd": "{command} s/{length}",
    "voltage_limit": "{command}",
    "voltage_before": "{command}",
    "control_period": "s",
    "counts_per_unit": "1/{length}",
    "inertia": "kg m^2",
    "mass": "kg",
    "supply_voltage": "V",
    "sample_time": "s",
    "ki": "{command}/({length} s)",
    "integral_before": "{command}",
    "tracking_time": "s",
    "current_limit": "{command}",
    "velocity_feedforward": "{command} s/{length}",
}
"""What each quantity is measured in; those that settle the units of the record stand first."""
CASCADE = {"kp": "1/s", "kv": "{command} s/{length}", "kiv": "{command}/{length}"}
"""The same of a cascade's gains."""
COUNTING = ("counts_per_rev", "pwm_full_scale")
"""Pure numbers that scale columns, and are no settings of the law."""
ONLY_PID = ("kd", "ki", "setpoint_weight", "derivative_on", "velocity_feedforward")
ONLY_CASCADE = ("kv", "kiv", "feedforward_speed")
"""Settings that only one of the two laws has."""
LARGEST_VALUE = 1e15
"""Nothing measured in SI units on an axis is larger; squares of larger numbers overflow."""
SMALLEST_VALUE = 1e-150
"""A column whose largest number is smaller is not measured in the unit stated; squares of its numbers vanish."""


def assemble(
    signals: Mapping[str, NDArray[np.float64]],
    header_units: Mapping[str, str | None],
    *,
    comments: Mapping[str, object] | None = None,
    settings: Mapping[str, object] | None = None,
    units: Mapping[str, str] | None = None,
    name: str = "record",
    source: str = "",
) -> Record:
    """Convert a table to SI and return it as a record.

    Parameters
    ----------
    signals : mapping of str to ndarray, shape (n,)
        Signal names to values as logged.
    header_units : mapping
        Units that the headings state.
    comments, settings : mapping, optional
        Settings of the file, and those of the caller, which win.
    units : mapping, optional
        Units from the caller, which win over those of the headings.
    name, source : str
        Of the record, where the settings give no name.

    Raises
    ------
    InputError
        With one sentence, if table and settings do not make a record.
    """
    parsed = parse_settings(comments or {}, settings)
    stated = _column_units(signals, {**header_units, **check_mapping(units, "units", "mm")})
    stated |= {key: (amount.text, amount.unit) for key, amount in parsed.amounts.items() if amount.unit is not None}
    beside = read_reference_file(parsed.texts["reference_file"]) if "reference_file" in parsed.texts else None
    if beside is not None and beside.unit is not None and "reference" not in signals:
        stated["reference"] = beside.unit
    scales = Scales.of(parsed, stated, signals)
    stated = {key: (text, scales.converted(unit)) for key, (text, unit) in stated.items()}
    length, command = _settle(stated, _kinds(parsed))
    values = _scaled(signals, stated)
    numbers = {key: amount.value * _factor(key, stated) for key, amount in parsed.amounts.items()}
    if "reference" in parsed.texts:
        values["reference"] = stated_reference(parsed.texts["reference"], values, stated, scales, length)
    if beside is not None:
        values["reference"] = _held(beside, values, stated)
    _check_size({**values, **numbers})
    controller, remarks = _controller(numbers, parsed)
    remarks += _unit_of_kp(parsed, stated, command, length, signals)
    title = parsed.name or name
    made = {
        "controller": controller,
        "encoder_resolution": numbers.get("encoder_resolution", scales.per_count),
        "voltage_limit": _limit(numbers, command),
        "voltage_before": numbers.get("voltage_before"),
        "control_period": numbers.get("control_period") if controller is None else None,
        "inertia": numbers.get("inertia", numbers.get("mass")),
        "remarks": tuple(replace(remark, record=title) for remark in (*parsed.remarks, *remarks)),
    }
    return _record(values, made, (length, command), title, source)


def _held(beside: ReferenceFile, values: Signals, stated: Stated) -> NDArray[np.float64]:
    """Return the reference of a file beside the log, at the log's instants."""
    if "reference" in values:
        raise InputError("a reference is logged and a file of one is given too; keep one of the two")
    position = stated.get("position")
    if beside.unit is None and position is not None and position[1].factor != 1.0:
        raise InputError(
            f"{beside.label}: states no unit, and the position is logged in {quote(position[0])}; write the unit into"
            f" the heading, e.g. reference [{position[0]}]"
        )
    return beside.held(values["time"], _factor("reference", stated))


def _column_units(signals: Iterable[str], texts: Mapping[str, str | None]) -> Stated:
    stated: Stated = {}
    for signal in signals:
        text = texts.get(signal)
        if text is None:
            continue
        unit = parse_unit(text)
        if unit is None:
            raise InputError(f"column {signal}: {quote(text)} is no unit; write e.g. [s], [mm], [rad] or [V]")
        stated[signal] = (text, unit)
    return stated


def _kinds(settings: Settings) -> dict[str, str]:
    """Return what each quantity is measured in, with the gains of the stated controller."""
    return {**SIGNAL_UNITS, **CASCADE} if settings.words.get("controller") == "cascade" else SIGNAL_UNITS


def _limit(numbers: Mapping[str, float], command: str) -> float | None:
    """Return the limit of the command, by either of its names."""
    if "current_limit" in numbers and command != "A":
        raise InputError(f"current_limit is given and the command is in {command}; give voltage or gains in A")
    return numbers.get("voltage_limit", numbers.get("current_limit"))


def _settle(stated: Stated, kinds: Mapping[str, str]) -> tuple[Literal["m", "rad"], str]:
    """Return the units of length and command that agree with everything that is stated."""
    left = list(product(LENGTH_UNITS, COMMAND_UNITS))
    seen: list[str] = []
    for key, kind in kinds.items():
        if key not in stated:
            continue
        text, unit = stated[key]
        fits = [
            pair for pair in product(LENGTH_UNITS, COMMAND_UNITS) if _dimension(kind, pair) == _in_length(unit, pair[0])
        ]
        if not fits:
            raise InputError(f"{key} is in {quote(text)}, which is not a unit for it; {_admissible(key, kind, unit)}")
        agreed = [pair for pair in left if pair in fits]
        if not agreed:
            cure = f"correct that, or give {key} in {kind.format(length=left[0][0], command=left[0][1])}"
            raise InputError(f"{key} is in {quote(text)}, which contradicts the unit of {' and '.join(seen)}; {cure}")
        if len(agreed) < len(left):
            seen.append(key)
        left = agreed
    length, command = left[0]
    return cast("Literal['m', 'rad']", length), command


def _dimension(kind: str, pair: tuple[str, str]) -> tuple[tuple[str, float], ...]:
    unit = parse_unit(kind.format(length=pair[0], command=pair[1]))
    return () if unit is None else unit.dimension


def _in_length(unit: Unit, length: str) -> tuple[tuple[str, float], ...]:
    """Return a unit's dimension with the encoder counts, of which no unit is stated, as that length."""
    bases = dict(unit.dimension)
    power = bases.pop("count", 0.0)
    if power:
        bases[length] = bases.get(length, 0.0) + power
    return tuple(sorted((base, size) for base, size in bases.items() if size))


def _admissible(key: str, kind: str, unit: Unit) -> str:
    if kind == "{length}" and unit.dimension == _dimension("V", ("", "")):
        return f"a sensor's voltage needs its scale: state what one V is, e.g. --unit '{key}=0.01 m'"
    examples = [kind.format(length=length, command="V") for length in LENGTH_UNITS]
    command = ", or A, N, N m, %, pwm in place of V" if "{command}" in kind else ""
    return f"give it in {' or '.join(dict.fromkeys(examples))}{command}"


def _factor(key: str, stated: Stated) -> float:
    return stated[key][1].factor if key in stated else 1.0


def _scaled(signals: Mapping[str, NDArray[np.float64]], stated: Stated) -> Signals:
    values: Signals = {}
    for signal, value in signals.items():
        factor = _factor(signal, stated)
        if signal == "time" and factor in (1e-3, 1e-6):
            values[signal] = value / round(1 / factor)  # 3 ms is 0.003 s to the last digit
        else:
            values[signal] = value if factor == 1.0 else value * factor
    return values


def _check_size(quantities: Mapping[str, NDArray[np.float64] | float]) -> None:
    for key, value in quantities.items():
        largest = abs(value) if isinstance(value, float) else float(abs(value).max(initial=0.0))
        if largest > LARGEST_VALUE:
            raise InputError(f"{key} reaches {largest:g} in SI units; up to {LARGEST_VALUE:g} is read, check its unit")
        if 0.0 < largest < SMALLEST_VALUE:
            least = f"{SMALLEST_VALUE:g} and more, or 0, is read"
            raise InputError(f"{key} reaches no more than {largest:g} in SI units; {least}, check its unit")


def _controller(numbers: Mapping[str, float], settings: Settings) -> tuple[Controller | None, list[Finding]]:
    shared = ("control_period", "tracking_time", "integral_before")
    own = ("kd", "ki", "kv", "kiv", "velocity_feedforward", *shared)
    stated = [key for key in settings.numbers if key not in COUNTING]
    loop = [key for key in (*own, *stated, *settings.words) if _given(key, settings)]
    if "kp" not in numbers:
        gains = [key for key in ("kd", "ki", "kv", "kiv") if numbers.get(key)]
        if gains or "kd" in numbers:
            raise InputError(f"{(gains or ['kd'])[0]} is given without kp; give both")
        what = [key for key in loop if key not in ("controller", "ki", "control_period")]
        message = f"kp is not given, so {', '.join(what)} says nothing."
        return None, [Finding(code="settings_without_gains", severity="note", message=message)] if what else []
    cascade = settings.words.get("controller") == "cascade"
    for key in ONLY_PID if cascade else ONLY_CASCADE:
        if _given(key, settings):
            law, others = ("cascade", "kp, kv, kiv") if cascade else ("pd", "kp, kd, ki")
            raise InputError(f"{key} is given and controller = {law} has none; its gains are {others}")
    if cascade and "kv" not in numbers:
        raise InputError("controller = cascade needs kv, the gain of its speed loop; give it")
    wanted = (*(CASCADE if cascade else ("kp", "kd", "ki", "velocity_feedforward")), *shared)
    fields: dict[str, Any] = {key: numbers[key] for key in wanted if key in numbers}
    fields |= {key: value for key, value in settings.numbers.items() if key not in COUNTING}
    fields |= {key: word for key, word in settings.words.items() if key != "controller"}
    if "derivative_window" in fields:
        fields["derivative_window"] = int(fields["derivative_window"])
    return (Controller.cascade if cascade else Controller)(**fields), []


def _unit_of_kp(settings: Settings, stated: Stated, command: str, length: str, signals: Iterable[str]) -> list[Finding]:
    """Say that a bare kp was taken as SI beside positions that are not, where no logged command can bear it out."""
    kp, position = settings.amounts.get("kp"), stated.get("position")
    is_odd = position is not None and position[1].factor != 1.0 and settings.words.get("controller") != "cascade"
    if kp is None or kp.unit is not None or position is None or not is_odd or "voltage" in signals:
        return []
    message = (
        f"kp = {kp.value:g} states no unit and was taken in {command}/{length}, while the position is logged in"
        f" {position[0]}; if it is meant so, write kp = {kp.value:g} {command}/{position[0]}."
    )
    return [Finding(code="unit_of_kp_assumed", severity="note", message=message)]


def _given(key: str, settings: Settings) -> bool:
    return key in settings.amounts or key in settings.numbers or key in settings.words


def _record(
    values: Signals, made: Mapping[str, object], units: tuple[Literal["m", "rad"], str], name: str, source: str
) -> Record:
    arguments: dict[str, Any] = {**values, **made}
    try:
        return Record(
            **arguments,
            name=name,
            source=source,
            length_unit=units[0],
            command_unit=units[1],
        )
    except InputError as error:
        raise InputError(str(error).removeprefix(f"{name}: ")) from error
