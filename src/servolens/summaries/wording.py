"""How numbers are written for people: the digits that mean something, with their unit."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from servolens.findings import listed
from servolens.model import NOT_REACHED
from servolens.plant import ENDLESS
from servolens.units import prefixed, unit

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from servolens.model import Quantity

__all__ = [
    "capital",
    "inside",
    "interval",
    "length",
    "listed",
    "minus",
    "number",
    "number_down",
    "number_up",
    "percent",
    "percents",
    "plus_minus",
    "prefixed",
    "scale",
    "undetermined",
    "unit",
    "value_and_error",
]

DIGITS = 4
LARGEST_PLAIN, SMALLEST_PLAIN = 1e6, 1e-4


def number(value: float | None, digits: int = DIGITS) -> str:
    """Return `value` with `digits` significant digits; a dash for None.

    Examples
    --------
    >>> number(3.78812), number(0.0), number(1234567.0), number(None)
    ('3.788', '0', '1.235e+06', '–')
    """
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    if not SMALLEST_PLAIN <= abs(value) < LARGEST_PLAIN:
        return f"{value:.{digits - 1}e}"
    decimals = max(digits - 1 - math.floor(math.log10(abs(value))), 0)
    text = f"{value:.{decimals}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def number_up(value: float, digits: int = DIGITS) -> str:
    """Return `value` rounded towards +∞, so that a lowest admissible value stays admissible.

    Examples
    --------
    >>> number_up(3.78812), number_down(4.77583), number_up(3.5)
    ('3.789', '4.775', '3.5')
    """
    return number(_toward(value, digits, math.ceil), digits)


def number_down(value: float, digits: int = DIGITS) -> str:
    """Return `value` rounded towards −∞; see :func:`number_up`."""
    return number(_toward(value, digits, math.floor), digits)


def inside(low: float, high: float) -> tuple[str, str]:
    """Return the ends of an admissible interval, rounded inwards, with as many digits as keep them apart.

    Examples
    --------
    >>> inside(3.78812, 4.77583), inside(3.78812, 3.78831)
    (('3.789', '4.775'), ('3.7882', '3.7883'))
    """
    for digits in range(DIGITS, 12):
        first, last = number_up(low, digits), number_down(high, digits)
        if low == high or float(first) <= float(last):
            break
    return first, last


def percent(value: float | None) -> str:
    """Return a percentage with two or three significant digits; a dash for what is missing.

    Examples
    --------
    >>> percent(0.1234), percent(12.34), percent(1e-14), percent(None)
    ('0.12 %', '12.3 %', 'less than 0.0001 %', '–')
    """
    if value is None or not math.isfinite(value):
        return "–"
    if 0 < abs(value) < SMALLEST_PLAIN:
        return f"less than {SMALLEST_PLAIN:.4f} %"
    return f"{number(value, 2 if abs(value) < 10 else 3)} %"


def plus_minus(quantity: Quantity) -> str:
    """Return a quantity as value ± standard error (percent), without its unit.

    A share of a value that is smaller than its error says nothing and is left out; see :func:`undetermined`.

    Examples
    --------
    >>> from servolens.model import Quantity
    >>> plus_minus(Quantity(value=1.91647, stderr=0.00211, unit="m/s^2/V"))
    '1.9165 ± 0.0021 (0.11 %)'
    >>> plus_minus(Quantity(value=-3e-14, stderr=2160.0, unit="1/s"))
    '0 ± 2160'
    >>> plus_minus(Quantity(value=-7.609e-06, stderr=5.2e-06, unit="rad"))
    '-7.6e-06 ± 5.2e-06 (68.3 %)'
    """
    value, error = quantity.value, quantity.stderr
    if error is None:
        is_beyond = abs(value) >= ENDLESS or quantity.reason == NOT_REACHED
        return "none seen" if is_beyond else f"{number(value)} (error not known)"
    share = f" ({percent(100 * error / abs(value))})" if abs(value) > error else ""
    if error == 0 or not SMALLEST_PLAIN * 0.1 <= max(abs(value), error) < LARGEST_PLAIN:
        return f"{number(value, _digits(value, error))} ± {number(error, 2)}{share}"
    decimals = _decimals(error)
    return f"{_unsigned_zero(f'{value:.{decimals}f}')} ± {error:.{decimals}f}{share}"


def undetermined(quantities: Mapping[str, Quantity]) -> str:
    """Return a sentence on the quantities whose standard error exceeds their value; empty where there is none.

    Examples
    --------
    >>> from servolens.model import Quantity
    >>> undetermined({"gain": Quantity(value=1.9, stderr=0.1, unit="1"), "a": Quantity(value=0, stderr=9, unit="1")})
    'Not significantly different from zero: a.'
    """
    names = [name for name, q in quantities.items() if q.stderr is not None and q.stderr > abs(q.value)]
    return f"Not significantly different from zero: {listed(names, most=8)}." if names else ""


def percents(low: float, high: float) -> str:
    """Return a range of percentages, or one where both are written alike.

    Examples
    --------
    >>> percents(1.234, 5.678), percents(0.00871, 0.00874)
    ('1.2 % to 5.7 %', '0.0087 %')
    """
    ends = [percent(low), percent(high)]
    return ends[0] if ends[0] == ends[1] else " to ".join(ends)


def interval(quantity: Quantity) -> str:
    """Return the 95 % interval of a quantity, to the digits of its error; a dash if it is not known.

    Examples
    --------
    >>> from servolens.model import Quantity
    >>> interval(Quantity(value=1.3, stderr=3.5, unit="1/s"))
    '−5.6 to 8.2'
    """
    bounds = quantity.interval
    if bounds is None or not quantity.stderr:
        return "–"
    if not SMALLEST_PLAIN * 0.1 <= max(abs(b) for b in bounds) < LARGEST_PLAIN:
        return " to ".join(minus(number(bound)) for bound in bounds)
    decimals = _decimals(quantity.stderr)
    return " to ".join(minus(f"{bound:.{decimals}f}") for bound in bounds)


def scale(values: Iterable[float], length_unit: str) -> tuple[float, str]:
    """Return the factor and the unit in which the largest of `values` [m or rad] is easy to read.

    Examples
    --------
    >>> scale([0.0003, 0.0121], "m")
    (1000.0, 'mm')
    """
    largest = max((abs(v) for v in values if math.isfinite(v)), default=0.0)
    for factor, prefix in ((1.0, ""), (1e3, "m")):
        if largest * factor >= 0.5:
            return factor, prefix + length_unit
    return (1e3, "m" + length_unit) if largest == 0 or largest * 1e3 >= 0.05 else (1e6, "µ" + length_unit)


def length(value: float, length_unit: str, *, beside: float | None = None) -> str:
    """Return a length or angle with two digits and the prefix that suits it, or the one `beside` it.

    Examples
    --------
    >>> length(0.00183, "m"), length(1.1e-5, "m"), length(1.1e-5, "m", beside=0.00183)
    ('1.8 mm', '11 µm', '0.011 mm')
    """
    if not math.isfinite(value):
        return "not a finite number"
    factor, unit_ = scale([value if beside is None or not math.isfinite(beside) else beside], length_unit)
    return f"{number(float(f'{factor * value:.1e}'), 2)} {unit_}"


def value_and_error(quantity: Quantity, *, beside: Iterable[Quantity] = ()) -> str:
    """Return value ± error to the one digit of the error that matters, with a prefix where both are small.

    With the prefix of the largest of those of the same unit `beside` it: one sentence tells them in one unit.

    Examples
    --------
    >>> from servolens.model import Quantity
    >>> value_and_error(Quantity(value=0.00412, stderr=0.00003, unit="s"))
    '4.12 ± 0.03 ms'
    >>> value_and_error(Quantity(value=0.008, stderr=0.003, unit="m"), beside=[Quantity(value=1.2, unit="m")])
    '0.008 ± 0.003 m'
    """
    error = quantity.stderr or 0.0
    alike = [q for q in (quantity, *beside) if q.unit == quantity.unit]
    factor, unit_ = prefixed([size for q in alike for size in (q.value, q.stderr or 0.0)], quantity.unit)
    shown = "" if unit_ == "1" else f" {unit(unit_)}"
    value, error = factor * quantity.value, factor * error
    if error <= 0 or not math.isfinite(error):
        return minus(f"{number(value)}{shown}")
    leading, exponent = f"{error:.0e}".split("e")
    decimals = max((leading == "1") - int(exponent), 0)
    return minus(f"{value:.{decimals}f} ± {error:.{decimals}f}{shown}")


def minus(text: str) -> str:
    """Return `text`, a number, with the sign that people write.

    Examples
    --------
    >>> minus("-3.2 V"), minus("3.2 V")
    ('−3.2 V', '3.2 V')
    """
    return text.replace("-", "−", 1) if text.startswith("-") else text


def capital(text: str) -> str:
    """Return `text` with its first letter in upper case.

    Examples
    --------
    >>> capital("a dead zone"), capital("11 mm")
    ('A dead zone', '11 mm')
    """
    return text[:1].upper() + text[1:]


def _unsigned_zero(text: str) -> str:
    """Return a number; a zero without a sign."""
    return text.removeprefix("-") if float(text) == 0 else text


def _decimals(error: float) -> int:
    """Decimals that show two significant digits of `error`."""
    return min(max(1 - math.floor(math.log10(error)), 0), 12)


def _digits(value: float, error: float) -> int:
    """Digits of `value` that its `error` leaves, its second one included; as of any number where there is no error."""
    if error == 0 or value == 0 or not (math.isfinite(value) and math.isfinite(error)):
        return DIGITS
    return max(2 + math.floor(math.log10(abs(value))) - math.floor(math.log10(error)), 1)


def _toward(value: float, digits: int, rounding: Callable[[float], int]) -> float:
    if value == 0 or not math.isfinite(value):
        return value
    power = digits - 1 - math.floor(math.log10(abs(value)))
    shifted = value * 10.0**power
    near = round(shifted)
    whole = near if abs(shifted - near) < 1e-9 * abs(shifted) else rounding(shifted)
    return float(whole) / 10.0**power
