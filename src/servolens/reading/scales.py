"""The unit of a column that states none, by what is plausible for a servo axis; two plausible units are a question."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.errors import InputError
from servolens.reading.files import quote
from servolens.reading.roles import typed
from servolens.reading.words import BY_ARMATURE, DUTY
from servolens.units import parse_unit

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from servolens.reading.roles import Choice
    from servolens.reading.table import Column

    Values = NDArray[np.float64]

__all__ = [
    "FASTEST_AXIS",
    "LONGEST_AXIS",
    "VELOCITY_AGREES",
    "check_own_length",
    "command_unit",
    "length_unit",
    "passing_speed",
    "time_unit",
    "travel_of",
    "unrounded",
    "velocity_unit",
]

LONGEST_SAMPLE_TIME = 0.5
"""Sample time from which on no axis is controlled [s]; the same bound as in the checks of a record."""
SAMPLE_TIMES = (25e-6, 0.1)
"""Sample times that servo drives and hobby loops have [s]: 40 kHz current loops to 10 Hz loggers."""
DAY = 86400.0
TIMES = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "day": DAY}
"""Units of time beside seconds, and seconds of each."""
DATES = ((20000.0, 60000.0), (700000.0, 800000.0))
"""Dates as numbers [day]: 1954 to 2064 as spreadsheets count them, 1916 to 2190 as MATLAB does."""
MACHINES = (0.95e9, 4.1e9)
"""Instants that computers' clocks may have logged [s since 1970]: 2000 to 2099."""
EPOCHS = (
    ("s", 0.0, "seconds since 1970"),
    ("ms", 0.0, "milliseconds since 1970"),
    ("us", 0.0, "microseconds since 1970"),
    ("ns", 0.0, "nanoseconds since 1970"),
    ("100 ns", 11_644_473_600.0, "100 ns since 1601, FILETIME"),
    ("100 ns", 62_135_596_800.0, "100 ns since the year 1, ticks of .NET"),
)
"""How such clocks count: their unit, seconds from their beginning to 1970, and what that is called."""
SLOWEST = 10.0
"""Sample time of dated stamps up to which they are believable [s], however long the run is."""
LONGEST_UPTIME = 366 * DAY
"""Time since a computer was switched on that is believable [s]."""
ROUNDING = 1e-3
"""Of sample times from dates, which programs round to about 0.1 ms."""
FEWEST_SAMPLES = 20
"""Samples below which a rate and a travel say nothing, and levels above which a command is no hand-made pulse."""
LONGEST_AXIS = 10.0
"""Travel beyond which metres are doubtful [m]: gantries are shorter."""
FASTEST_AXIS = 10.0
"""Speed beyond which metres are doubtful [m/s]: linear motors reach less, and belts."""
MOST_TURNS = 4 * np.pi
"""Travel beyond which radians are doubtful where the name says angle [rad]: two turns, and 12.6 degrees."""
LARGEST_COMMAND = 1000.0
"""Beyond which volts, amperes and newton metres are doubtful where no unit is stated: drives have some hundred."""
FULL_SCALES = (100, 127, 255, 511, 512, 1000, 1023, 2047, 2048, 4095, 8191, 10000, 32767, 65535)
"""Largest counts of PWM registers."""
VELOCITY_AGREES = 0.05
"""Relative difference up to which the velocity agrees with the position's derivative, and share of samples at which a
direction may differ from its sign."""


def time_unit(choice: Choice) -> tuple[str | None, str]:
    """Return the unit of a time column that states none, and why; None where seconds are.

    Raises
    ------
    InputError
        If two units are plausible.
    """
    values = choice.column.values
    if values.size < FEWEST_SAMPLES or not np.isfinite(values).all():
        return None, "seconds are assumed"
    interval = float(np.median(np.diff(unrounded(values))))
    low, high = SAMPLE_TIMES
    if low <= interval <= high:
        return None, "seconds are assumed"
    fits = [unit for unit, factor in TIMES.items() if low <= interval * factor <= high]
    since = _since(values, interval)
    uptimes = [unit for unit in fits if since and unit != since[0] and values[0] * TIMES[unit] <= LONGEST_UPTIME]
    if since and not uptimes:
        return since
    if _is_date(values) and low <= interval * DAY <= (1 + ROUNDING) * LONGEST_SAMPLE_TIME:
        return "day", f"steps of {interval:.3g}, and values that are dates in days: {1 / (interval * DAY):.4g} Hz"
    fits = [since[0], *uptimes] if since else fits
    if fits and 0 < interval < LONGEST_SAMPLE_TIME:
        if choice.column.name == "time":
            return None, "seconds, as record files have them"
        fits = list(dict.fromkeys((*fits, "s")))
    if len(fits) > 1:
        readings = " or ".join(f"--unit time={unit}" for unit in fits)
        rates = [f"{unit} ({_rate(interval * TIMES.get(unit, 1.0))})" for unit in fits]
        raise InputError(
            f"column {quote(choice.address)} has steps of {interval:g}, which are plausible in"
            f" {' and in '.join(rates)}; say {readings}"
        )
    if not fits:
        return None, "seconds are assumed"
    rate = 1 / (interval * TIMES[fits[0]])
    return fits[0], f"steps of {interval:g}: {rate:g} Hz in {fits[0]}, {1 / interval:.2g} Hz in s"


def _rate(interval: float) -> str:
    rate = float(f"{1 / interval:.3g}")
    return f"{rate:g} Hz" if rate < 1000 else f"{rate / 1000:g} kHz"


def _since(values: Values, interval: float) -> tuple[str, str] | None:
    """Return the unit of stamps that count from an epoch, by the date that they then are, and why; None without.

    Of a slow log too; but samples that would be taken more seldom than any motion is logged are of a shorter unit.
    """
    first = float(values[0])
    for text, before, what in EPOCHS:
        unit = parse_unit(text)
        if unit is None or not MACHINES[0] <= first * unit.factor - before <= MACHINES[1]:
            continue
        if SAMPLE_TIMES[0] <= interval * unit.factor <= SLOWEST:
            rate = 1 / (interval * unit.factor)
            return text, f"steps of {interval:.6g}, and values that are dates in {what}: {rate:.4g} Hz"
    return None


def unrounded(time: Values) -> Values:
    """Return large time stamps from the first one on, even where all are so up to the rounding of such numbers.

    Those of nanoseconds since 1970 are rounded to 256 ns, those of 100 ns since the year 1 to 12.8 µs.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Finite.

    Examples
    --------
    >>> unrounded(1.7e18 + 1e6 * np.arange(1001))[:3].tolist()
    [0.0, 1000000.0, 2000000.0]
    """
    passed = time - time[0]
    even = np.linspace(0.0, float(passed[-1]), passed.size)
    rounding = float(np.spacing(np.max(np.abs(time))))
    return even if np.all(np.abs(even - passed) <= rounding) else passed


def _is_date(values: Values) -> bool:
    return any(first <= float(values[0]) <= last for first, last in DATES)


def length_unit(
    choice: Choice, settled: str | None, beside: Choice | None = None, *, speed: float = 0.0
) -> tuple[str | None, str]:
    """Return the unit of a position that states none, and why; None where SI is.

    Parameters
    ----------
    choice : Choice
        The column.
    settled : str or None
        Of the reference or of the gains, where they state one.
    beside : Choice, optional
        The reference, or the position, whose unit `settled` is.
    speed : float
        Largest of the column [per second], zero where it is not known.

    Raises
    ------
    InputError
        If metres or radians are not plausible: then other units are.
    """
    is_angle = choice.meaning.kind == "angle"
    si = "rad" if is_angle else "m"
    if settled:
        _check_alike(choice, beside, settled, si)
        return settled, "the unit of what belongs to it"
    values = choice.column.values
    if choice.column.name.strip().lower().endswith("_in"):
        raise InputError(
            f"column {quote(choice.address)} may be in inches, or an input; say --unit position=in or"
            f" --unit position={si}"
        )
    if values.size < FEWEST_SAMPLES or not np.isfinite(values).all():
        return (si if is_angle else None), f"{si} is assumed"
    travel = float(np.ptp(values))
    is_whole = choice.column.is_integer
    is_far = travel > (MOST_TURNS if is_angle else LONGEST_AXIS) or (is_whole and travel > 2)
    is_fast = speed > FASTEST_AXIS and not (is_angle or is_far)
    if not (is_far or is_fast):
        return (si if is_angle else None), f"{si} is assumed (it travels {travel:.3g})"
    units = ["deg", "rad"] if is_angle else ["mm", "deg", "rad"]
    if is_whole:
        units.append("counts")
    readings = " or ".join(f"--unit {{}}={unit}" for unit in units)
    raise InputError(
        f"column {quote(choice.address)} travels {travel:.4g}{f', at up to {speed:.3g} per second,' if is_fast else ''}"
        f" and states no unit: {', '.join(units[:-1])} and"
        f" {units[-1]} are plausible; say {readings.replace('{}', 'position')}"
    )


def _check_alike(choice: Choice, beside: Choice | None, settled: str, si: str) -> None:
    """Ask about a column whose travel is nearer to that of its partner in SI than in the partner's unit.

    What does not move says nothing.
    """
    unit = parse_unit(settled)
    si = "rad" if unit is not None and "rad" in dict(unit.dimension) else si
    sizes = [0.0 if one is None else travel_of(one.column.values) for one in (choice, beside)]
    nearness = _nearness(sizes, settled)
    if nearness is not None and nearness[1] < nearness[0]:
        signal = "reference" if "reference" in choice.meaning.roles else "position"
        readings = " or ".join(f"--unit {signal}={text}" for text in (settled, si))
        raise InputError(
            f"column {quote(choice.address)} travels {sizes[0]:.3g} and states no unit, beside {sizes[1]:.3g} {settled}"
            f" of {quote(beside.address if beside else '')}; say {readings}"
        )


def check_own_length(signal: str, choice: Choice, beside: Choice, settled: str) -> None:
    """Ask about a column of a record file, in SI as it states no unit, that travels as its partner does in its unit.

    Parameters
    ----------
    signal : str
        Position or reference.
    choice, beside : Choice
        The column and its partner.
    settled : str
        The partner's unit, as the file states it.

    Raises
    ------
    InputError
        With both units.
    """
    unit = parse_unit(settled)
    if unit is None or choice.column.values.size < FEWEST_SAMPLES or not is_alike(choice, beside, settled):
        return
    si = "rad" if "rad" in dict(unit.dimension) else "m"
    sizes = [float(np.max(np.abs(one.column.values))) for one in (choice, beside)]
    raise InputError(
        f"column {quote(choice.address)} states no unit, which is {si} in a record file, and reaches {sizes[0]:.4g}"
        f" beside {sizes[1]:.4g} {settled} of {quote(beside.address)}; say --unit {signal}={typed(settled)} or --unit"
        f" {signal}={si}"
    )


def is_alike(choice: Choice, beside: Choice, settled: str) -> bool:
    """Tell whether a column travels about as far as its partner in that one's unit, rather than in SI.

    Of one that rests it is how far from zero they reach: a step may have begun with the record.
    """
    both = [one.column.values for one in (choice, beside)]
    sizes = [travel_of(values) for values in both]
    if not all(sizes):
        sizes = [travel_of(np.append(values, 0.0)) for values in both]
    nearness = _nearness(sizes, settled)
    return nearness is not None and nearness[0] <= nearness[1]


def _nearness(sizes: list[float], settled: str) -> tuple[float, float] | None:
    """Return how far apart two travels are, as logarithms: both in the unit of the second, and the first in SI.

    None where that says nothing: one does not move, or the unit is SI.
    """
    unit = parse_unit(settled)
    if unit is None or not all(sizes) or unit.factor == 1.0:
        return None
    ratio = float(np.log(sizes[0] / sizes[1]))
    return abs(ratio), abs(ratio - float(np.log(unit.factor)))


def travel_of(values: Values) -> float:
    """Return the range of a column, zero where some value is none."""
    if values.dtype.kind not in "iuf" or not values.size or not np.isfinite(values).all():
        return 0.0
    return float(np.ptp(values))


def passing_speed(position: Choice, time: Choice, unit: str | None) -> float:
    """Return at which speed a position passes a quarter of its travel [its unit per second], zero where none tells.

    Samples that stick out, and noise, make no such speed: each is the median of five. Nor does a jump of as much from
    one sample to the next, as of an axis that is homed or an angle that wraps.

    Parameters
    ----------
    position, time : Choice
        Of one table.
    unit : str or None
        Of the time.
    """
    y, t, parsed = position.column.values, time.column.values, parse_unit(unit or "s")
    if parsed is None or y.size != t.size or y.size < FEWEST_SAMPLES or not travel_of(y) or not travel_of(t):
        return 0.0
    smooth = np.median(np.lib.stride_tricks.sliding_window_view(y, 5), axis=1)
    steps = np.diff(smooth, prepend=smooth[0])
    smooth = np.cumsum(np.where(np.abs(steps) > np.ptp(smooth) / 4, 0.0, steps))
    instants, travel, span = t[2:-2] * parsed.factor, float(np.ptp(smooth)), 1
    while span < smooth.size:
        moved = np.abs(smooth[span:] - smooth[:-span])
        if np.max(moved) > travel / 4:
            at = int(np.argmax(moved))
            passed = float(instants[at + span] - instants[at])
            return float(moved[at]) / passed if passed > 0 else 0.0
        span *= 2
    return 0.0


def velocity_unit(
    choice: Choice, chosen: Mapping[str, Choice], units: Mapping[str, str | None]
) -> tuple[str | None, str] | None:
    """Return the unit of a velocity that states none, and why; None where it cannot be used.

    The derivative of the position tells: it is the velocity in the position's unit or in SI.
    """
    position, time = chosen["position"], chosen["time"]
    v, y, t = choice.column.values, position.column.values, time.column.values
    per_length, per_time = parse_unit(units.get("position") or "m"), parse_unit(units.get("time") or "s")
    if not v.size == y.size == t.size or v.size < FEWEST_SAMPLES or per_length is None or per_time is None:
        return None
    span = (t[2:] - t[:-2]) * per_time.factor
    slope = (y[2:] - y[:-2]) / np.where(span > 0, span, np.inf)
    power = float(slope @ slope)
    ratio = float(slope @ v[1:-1]) / power if power > 0 and np.isfinite(power) else 0.0
    if abs(ratio - 1) < VELOCITY_AGREES and units.get("position"):
        return f"{units['position']}/s", f"{ratio:.3g} times the derivative of the position"
    if abs(ratio - per_length.factor) < VELOCITY_AGREES * per_length.factor:
        return None, "SI, as the derivative of the position says"
    return None


def command_unit(choice: Choice) -> tuple[str | None, str]:
    """Return the unit of a command that states none, and why; None where volts are assumed.

    Raises
    ------
    InputError
        If it may be counts of a PWM register as well, or what its name says is a current or a voltage.
    """
    values = choice.column.values
    if choice.meaning.where == BY_ARMATURE:
        raise InputError(
            f"column {quote(choice.label)} may be the armature's voltage, or a command in A; say --unit voltage=V or"
            " --unit voltage=A"
        )
    if choice.unit == DUTY:
        raise InputError(
            f"column {quote(choice.label)} reaches {np.max(np.abs(values)):.4g}, and 1 is full duty: per cent and"
            " counts of a PWM are plausible; say --unit voltage=% or --unit voltage=pwm"
        )
    if is_counted(choice.column) or is_huge(choice):
        units = (choice.unit, f"m{choice.unit}") if choice.unit else ("V", "pwm")
        spoken = " and ".join(units) if choice.unit else "volts and counts of a PWM"
        answers = " or ".join("--unit " + typed(f"voltage={unit}") for unit in units)
        holds = "holds whole numbers up to" if is_counted(choice.column) else "reaches"
        raise InputError(
            f"column {quote(choice.address)} {holds} {np.max(np.abs(values)):g} and states no unit:"
            f" {spoken} are plausible; say {answers}"
        )
    return None, "volts are assumed"


def is_huge(choice: Choice) -> bool:
    """Tell whether a command is beyond what axes are driven with, in whole units of what its name says."""
    values = choice.column.values
    is_known = choice.meaning.kind != "force" and values.size >= FEWEST_SAMPLES and bool(np.isfinite(values).all())
    return is_known and float(np.max(np.abs(values))) > LARGEST_COMMAND


def is_counted(column: Column) -> bool:
    """Tell whether a command is in whole numbers of something small: up to a full scale, or of many levels."""
    values = column.values
    if values.size < FEWEST_SAMPLES or not column.is_integer:
        return False
    return float(np.max(np.abs(values))) in FULL_SCALES or np.unique(values).size > FEWEST_SAMPLES
