"""Units of measured quantities: what a text such as ``V s/mm`` means in SI.

The units of ordinary logs stand in a table; pint, which costs a quarter of a second to import, is asked for the rest.
The radian, the percent of a command and the encoder count are dimensions of their own here, so that V/m, V/rad and V
can be told apart.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, final

from servolens.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

__all__ = [
    "COMMAND_UNITS", "LENGTH_UNITS", "Unit", "ordinary_unit", "parse_unit", "prefixed", "readable", "settled",
    "split_number", "unit",
]  # fmt: skip

Dimension = tuple[tuple[str, float], ...]

LONGEST_UNIT = 40
"""Longest text that is looked at as a unit."""
LENGTH_UNITS, COMMAND_UNITS = ("m", "rad"), ("V", "A", "N", "N m", "%", "pwm")
"""Of the positions and the commands of records and plants; files may have others, which are converted when read."""
PREFIXED = ("s", "m", "rad", "m/s", "rad/s", "m/s^2", "rad/s^2")
"""Units of which people write thousandths with a prefix."""
_VOLT = {"kg": 1, "m": 2, "s": -3, "A": -1}
_NEWTON = {"kg": 1, "m": 1, "s": -2}
_TORQUE = {"kg": 1, "m": 2, "s": -2}
_ATOMS: Mapping[str, tuple[float, Mapping[str, int]]] = {
    "1": (1.0, {}),
    "s": (1.0, {"s": 1}),
    "ms": (1e-3, {"s": 1}),
    "us": (1e-6, {"s": 1}),
    "ns": (1e-9, {"s": 1}),
    **dict.fromkeys(("sec", "seconds", "second"), (1.0, {"s": 1})),
    "m": (1.0, {"m": 1}),
    "cm": (1e-2, {"m": 1}),
    "mm": (1e-3, {"m": 1}),
    "um": (1e-6, {"m": 1}),
    "nm": (1e-9, {"m": 1}),
    "rad": (1.0, {"rad": 1}),
    "mrad": (1e-3, {"rad": 1}),
    "deg": (math.pi / 180, {"rad": 1}),
    "°": (math.pi / 180, {"rad": 1}),
    **dict.fromkeys(("degree", "degrees"), (math.pi / 180, {"rad": 1})),
    **dict.fromkeys(("rev", "revs", "turn", "turns"), (2 * math.pi, {"rad": 1})),
    "rpm": (2 * math.pi / 60, {"rad": 1, "s": -1}),
    "min": (60.0, {"s": 1}),
    "V": (1.0, _VOLT),
    "mV": (1e-3, _VOLT),
    "A": (1.0, {"A": 1}),
    "mA": (1e-3, {"A": 1}),
    "N": (1.0, _NEWTON),
    "mN": (1e-3, _NEWTON),
    "kN": (1e3, _NEWTON),
    "Nm": (1.0, _TORQUE),
    "mNm": (1e-3, _TORQUE),
    "%": (1.0, {"%": 1}),
    "percent": (1.0, {"%": 1}),
    "duty": (100.0, {"%": 1}),
    "pwm": (1.0, {"pwm": 1}),
    **dict.fromkeys(("volt", "volts"), (1.0, _VOLT)),
    **dict.fromkeys(("count", "counts", "cts", "cnt", "tick", "ticks"), (1.0, {"count": 1})),
}
_SPELLINGS = {
    **dict.fromkeys(("sek", "Sek", "Sekunden"), "s"),
    **dict.fromkeys(("Grad", "grad"), "deg"),
    **dict.fromkeys(("U", "Umdr", "Umdrehungen", "rot", "rotations", "revolutions"), "rev"),
    **dict.fromkeys(
        ("inc", "Ink", "Inkr", "Inkremente", "LU", "Cnt", "pulse", "pulses", "Pulse", "Pulses", "PUU"), "count"
    ),
    **dict.fromkeys(("Volt", "Volts", "VOLT", "VOLTS"), "V"),
    **dict.fromkeys(("Second", "Seconds", "Sec"), "s"),
    **dict.fromkeys(("RPM",), "rpm"),
}
"""What logs write for units; pint reads some of them as others (grad as gon) or not at all."""
_BASES = {
    "[length]": "m",
    "[mass]": "kg",
    "[time]": "s",
    "[current]": "A",
    "[angle]": "rad",
    "[percent]": "%",
    "[count]": "count",
    "[pwm]": "pwm",
}
_NO_UNITS = re.compile(r"\b(units?|position|per cent of)\b", re.IGNORECASE)  # pint reads "unit" as a micronit
_HARMLESS = re.compile(r"[A-Za-z0-9_°%·*/^(). ²³-]+")
_POWER = re.compile(r"(?:\*\*|\^)")
_SMALL_POWER = re.compile(r"(?:\*\*|\^)\s*\(?\s*-?\s*[1-4]\s*\)?(?!\s*(?:[0-9.eE]|\*\*|\^))")
_NUMBER = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,4})?)(.*)", re.DOTALL)


@final
@dataclass(frozen=True, slots=True)
class Unit:
    """A unit as a multiple of SI.

    Parameters
    ----------
    factor : float
        A value in this unit times `factor` is the value in SI.
    dimension : tuple of (str, float)
        Powers of kg, m, s, A, rad, %, count, sorted; two units measure the same kind of thing if these are equal.
    """

    factor: float
    dimension: Dimension


def parse_unit(text: str) -> Unit | None:
    """Return the unit that `text` names, or None if it is no unit.

    At most 40 characters and small powers are looked at, so that no text can keep the reader busy.

    Examples
    --------
    >>> parse_unit("mm").factor
    0.001
    >>> parse_unit("V/m") == parse_unit("V / rad")
    False
    >>> parse_unit("V per position unit") is None
    True
    """
    text = _plain(text)
    return (_from_table(text) or _from_pint(text)) if text else None


def ordinary_unit(text: str) -> Unit | None:
    """Return the unit of ordinary logs that `text` names, or None; unlike :func:`parse_unit` it asks no library.

    Examples
    --------
    >>> ordinary_unit("mm/s").factor, ordinary_unit("furlong")
    (0.001, None)
    """
    text = _plain(text)
    return _from_table(text) if text else None


def _plain(text: str) -> str:
    """Return a text that may be a unit in the letters of the table, empty for one that is none."""
    text = text.strip().replace("μ", "u").replace("µ", "u")
    return text if len(text) <= LONGEST_UNIT and _HARMLESS.fullmatch(text) else ""


def settled(text: str, admissible: Sequence[str], what: str) -> str:
    """Return which of the `admissible` units is meant, where a `text` may spell it in another way.

    Raises
    ------
    InputError
        That says `what` it must be, if it means none of them, or a multiple.

    Examples
    --------
    >>> settled("Nm", COMMAND_UNITS, "command_unit")
    'N m'
    """
    if text in admissible:
        return text
    meant = parse_unit(str(text)) or parse_unit(str(text).lower())
    for one in admissible:
        if meant is not None and meant == parse_unit(one):
            return one
    listed = f"{', '.join(map(repr, admissible[:-1]))} or {admissible[-1]!r}"
    raise InputError(f"{what} must be {listed}, got {str(text)[:LONGEST_UNIT]!r}")


def split_number(text: str) -> tuple[float, str]:
    """Split ``"60 V/m"`` into 60.0 and ``"V/m"``; brackets around the unit are dropped.

    Raises
    ------
    InputError
        If the text does not begin with a finite number.
    """
    match = _NUMBER.fullmatch(text.strip())
    if match is None:
        raise InputError("is not a number")
    value, rest = float(match[1]), match[2].strip()
    if re.match(r",\d", rest):
        raise InputError("has a decimal comma; write a point")
    if re.match(r"[\d._]", match[2]) or (re.match(r"\w", match[2]) and parse_unit(rest) is None):
        raise InputError("is not a number")
    if not math.isfinite(value):
        raise InputError("is not a finite number")
    if rest[:1] + rest[-1:] in ("[]", "()") and "(" not in rest[1:]:
        rest = rest[1:-1].strip()
    return value, rest


def prefixed(values: Iterable[float], text: str) -> tuple[float, str]:
    """Return factor and unit in which the largest of `values` is at least about 1, down to billionths.

    Examples
    --------
    >>> prefixed([0.004], "s"), prefixed([0.3], "m/s"), prefixed([0.004], "V")
    ((1000.0, 'ms'), (1.0, 'm/s'), (1.0, 'V'))
    """
    largest = max((abs(v) for v in values if math.isfinite(v)), default=0.0)
    if text not in PREFIXED or largest == 0:
        return 1.0, text
    for factor, prefix in ((1.0, ""), (1e3, "m"), (1e6, "µ"), (1e9, "n")):
        if largest * factor >= (0.1 if factor == 1.0 and text not in ("m", "rad", "s") else 0.5):
            return factor, prefix + text
    return 1e9, f"n{text}"


def readable(value: float, text: str, error: float | None = None) -> str:
    """Return `value` of unit `text` with two digits, or with its standard `error`, in the prefix that suits its size.

    Examples
    --------
    >>> readable(8.04e-6, "m"), readable(0.00123, "m/s^2"), readable(0.101, "s")
    ('8 µm', '1.2 mm/s^2', '100 ms')
    >>> readable(8.04e-6, "m", 1.2e-7)
    '8.04 ± 0.12 µm'
    """
    factor, unit = prefixed([value], text)
    if error is None or not 0.0 < error < value:
        return f"{float(f'{factor * value:.2g}'):g} {unit}"
    places = max(1 - math.floor(math.log10(factor * error)), 0)
    return f"{factor * value:.{places}f} ± {factor * error:.{places}f} {unit}"


@cache
def _from_table(text: str) -> Unit | None:
    """Read products of known units over at most one more, e.g. ``V s/mm``."""
    above, slash, below = text.partition("/")
    powers = [(atom, 1) for atom in re.split(r"[ *·]+", above.strip())]
    if slash:
        powers.append((below.strip(), -1))
    factor, dimension = 1.0, dict[str, float]()
    for written, power in powers:
        atom = _SPELLINGS.get(written, written)
        if atom not in _ATOMS:
            return None
        size, bases = _ATOMS[atom]
        factor *= size**power
        for base, exponent in bases.items():
            dimension[base] = dimension.get(base, 0) + power * exponent
    return Unit(factor, _sorted(dimension))


@cache
def _from_pint(text: str) -> Unit | None:
    powers = len(_POWER.findall(text))
    if powers > 3 or powers != len(_SMALL_POWER.findall(text)) or re.search(r"[²³]{2}|\d{7}", text):
        return None
    if _NO_UNITS.search(text):
        return None
    registry = _registry()
    try:
        quantity = registry.Quantity(registry.parse_expression(text)).to_base_units()
        factor = float(quantity.magnitude)
        dimension = {_BASES.get(base, base): float(power) for base, power in quantity.dimensionality.items()}
    except Exception:  # noqa: BLE001, RUF100 - pint raises many kinds on text that is no unit
        return None
    if not (math.isfinite(factor) and factor > 0):
        return None
    return Unit(factor, _sorted(dimension))


@cache
def _registry() -> Any:
    import pint

    registry: Any = pint.UnitRegistry(on_redefinition="ignore")
    registry.define("radian = [angle] = rad")
    registry.define("percent = [percent] = %")
    registry.define("pwm = [pwm]")
    registry.define("duty = 100 * percent")
    registry.define("count = [count] = counts = cts = cnt = tick = ticks")
    registry.define("rev = 2 * pi * radian")
    registry.define("Nm = newton * meter")
    registry._build_cache()
    return registry


def _sorted(dimension: Mapping[str, float]) -> Dimension:
    return tuple(sorted((base, float(power)) for base, power in dimension.items() if power))


def unit(text: str) -> str:
    """Return a unit as people write it.

    Examples
    --------
    >>> unit("m/s^2/V")
    'm/s²/V'
    """
    return text.replace("^2", "²").replace("^3", "³")
