"""Settings of a record: keys such as ``kp = 60 V/m``, from a file's comment lines or from the caller."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, final

from servolens.errors import InputError, as_text, by_name, described, names_like, unwrapped
from servolens.findings import Finding
from servolens.reading.files import quote
from servolens.units import Unit, parse_unit, split_number

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

__all__ = ["KEYS", "Amount", "Settings", "as_settings", "comment_settings", "parse_settings"]

DIMENSIONED = (
    "kp", "kd", "encoder_resolution", "voltage_limit", "voltage_before", "control_period", "counts_per_unit", "ki",
    "inertia", "mass", "supply_voltage", "sample_time", "kv", "kiv", "integral_before", "tracking_time",
    "current_limit", "velocity_feedforward",
)  # fmt: skip
PURE = (
    "derivative_filter", "derivative_window", "counts_per_rev", "pwm_full_scale", "setpoint_weight",
    "feedforward_speed",
)  # fmt: skip
TEXTS = ("reference", "reference_file")
WORDS = {
    "controller": ("pd", "pid", "cascade"),
    "anti_windup": ("none", "clamping", "back_calculation"),
    "derivative_on": ("measurement", "error"),
    "derivative": ("position", "velocity"),
    "time_step": ("cycle", "measured"),
}
KEYS = ("name", *DIMENSIONED, *PURE, *WORDS, *TEXTS)
"""Keys that are understood."""
_POSITIVE = (
    "encoder_resolution", "voltage_limit", "current_limit", "control_period", "tracking_time", "counts_per_unit",
    "inertia", "mass", "supply_voltage", "sample_time", "counts_per_rev", "pwm_full_scale",
)  # fmt: skip
_COMMENT = re.compile(r"#+\s*([A-Za-z_]\w*)\s*=\s*(.*?)\s*")


@final
@dataclass(frozen=True, slots=True)
class Amount:
    """A number and the unit that stood behind it; `unit` is None where SI is meant."""

    value: float
    unit: Unit | None = None
    text: str = ""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Settings as they were written, before the units of the record are known.

    Parameters
    ----------
    name : str
        The record's name, empty if not given.
    amounts : mapping
        Of the keys with a unit.
    numbers, words, texts : mapping
        Of the keys without.
    remarks : tuple of Finding
        What was not understood.
    """

    name: str = ""
    amounts: Mapping[str, Amount] = field(default_factory=dict)
    numbers: Mapping[str, float] = field(default_factory=dict)
    words: Mapping[str, str] = field(default_factory=dict)
    texts: Mapping[str, str] = field(default_factory=dict)
    remarks: tuple[Finding, ...] = ()


def comment_settings(lines: Iterable[str]) -> dict[str, str]:
    """Return the ``# key = value`` lines as a mapping; other comments are text for people.

    Raises
    ------
    InputError
        If a known key stands twice with different values.
    """
    found: dict[str, str] = {}
    for line in lines:
        match = _COMMENT.fullmatch(line.strip())
        if match is None:
            continue
        key, value = match[1], match[2]
        if key in KEYS and found.get(key, value) != value:
            raise InputError(f"the comment lines give {key} twice, with different values; keep one")
        found[key] = value
    return found


def as_settings(given: Mapping[str, object] | None, stated: Mapping[str, object] | None = None) -> dict[str, Any]:
    """Return the settings that a caller gave, with NumPy's numbers as Python's, and those `stated` as keywords.

    Raises
    ------
    InputError
        If they do not go by name.
    """
    settings = {**by_name("settings", given, {"kp": 60}), **(stated or {})}
    return {key: unwrapped(value) for key, value in settings.items()}


def parse_settings(comments: Mapping[str, object], given: Mapping[str, object] | None) -> Settings:
    """Read the settings of a file's comments, overridden by those of the caller.

    Unknown keys in comments become a remark; from the caller they are refused.

    Raises
    ------
    InputError
        Naming the key, what arrived and what is admissible.
    """
    override = dict(given or {})
    for key in override:
        if key not in KEYS:
            raise InputError(f"no setting is named {quote(key)}; {names_like(key, KEYS, 'known are')}")
    if "reference_file" in comments and override.get("reference_file") is None:
        raise InputError("the comment lines name a reference_file, which is not followed; give --reference-file")
    merged = {**comments, **{key: value for key, value in override.items() if value is not None}}
    remarks = _unknown(key for key in merged if key not in KEYS)
    amounts: dict[str, Amount] = {}
    for key in DIMENSIONED:
        if key in merged:
            amounts[key] = _amount(key, merged[key], remarks)
    if "reference" in merged and "reference_file" in merged:
        raise InputError("reference and reference_file are given both; keep one")
    if "inertia" in amounts and "mass" in amounts:
        raise InputError("inertia and mass are given both; keep the one that the axis moves")
    if "voltage_limit" in amounts and "current_limit" in amounts:
        raise InputError("voltage_limit and current_limit are given both; keep the one that limits the command")
    return Settings(
        name=_name(merged.get("name", "")),
        amounts=amounts,
        numbers={key: _pure(key, merged[key], remarks) for key in PURE if key in merged},
        words={key: _word(key, merged[key], allowed) for key, allowed in WORDS.items() if key in merged},
        texts={key: str(merged[key]) for key in TEXTS if key in merged},
        remarks=tuple(remarks),
    )


def _unknown(keys: Iterable[str]) -> list[Finding]:
    names = sorted(keys)
    if not names:
        return []
    message = f"comment keys that mean nothing here were left alone: {quote(', '.join(names))}."
    return [Finding(code="unknown_setting", severity="note", message=message)]


def _amount(key: str, value: object, remarks: list[Finding]) -> Amount:
    number, text = _number(key, value)
    if key in _POSITIVE and number <= 0:
        raise InputError(f"{key} must be positive, got {number:g}")
    unit = parse_unit(text) if text else None
    if text and unit is None:
        remarks.append(_no_unit(key, text))
    return Amount(number, unit, text)


def _pure(key: str, value: object, remarks: list[Finding]) -> float:
    number, text = _number(key, value)
    if key in _POSITIVE and number <= 0:
        raise InputError(f"{key} must be positive, got {number:g}")
    if text and parse_unit(text) is not None:
        raise InputError(f"{key} has no unit, got {quote(text)}")
    if text:
        remarks.append(_no_unit(key, text))
    if key == "derivative_window" and not (number >= 1 and number == int(number)):
        raise InputError(f"derivative_window must be a whole number of samples, at least 1, got {number:g}")
    return number


def _number(key: str, value: object) -> tuple[float, str]:
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise InputError(f"{key} must be a number, got {described(value)}")
    if not isinstance(value, str):
        return _finite(key, value), ""
    try:
        return split_number(value)
    except InputError as error:
        raise InputError(f"{key} must be a number, perhaps with a unit; {quote(value)} {error}") from error


def _finite(key: str, value: float) -> float:
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise InputError(f"{key} must be a finite number, got {number:g}")
    return number


def _no_unit(key: str, text: str) -> Finding:
    message = f"{key}: {quote(text)} is no unit; the number was taken as SI."
    return Finding(code="unit_not_understood", severity="note", message=message)


def _word(key: str, value: object, allowed: tuple[str, ...]) -> str:
    word = str(value).strip().lower()
    if word not in allowed:
        raise InputError(f"{key} must be {' or '.join(allowed)}, got {quote(value)}")
    return word


def _name(value: object) -> str:
    return "".join(c for c in as_text(value, "name").strip() if c.isprintable())[:80]
