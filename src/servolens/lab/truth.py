"""The truth about a virtual axis, and the carts of the paper."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import Any, final

from servolens.errors import InputError, described, names_like
from servolens.lab.laws import LAWS

__all__ = ["LM1", "LM2", "LM3", "NLM1", "NLM2", "NLM3", "Truth"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """What an axis really is: ``ÿ = gain·a(V) − damping·ẏ − Σ forces − level·sgn ẏ``, per unit of moving mass.

    Every effect of the toolbox, in any combination but two transmissions. With a load that moves apart (share μ of the
    mass) ``(1 − μ)ẍ = gain·a(V) − damping·ẋ − Σ forces − level·sgn ẋ − F`` and ``μÿ = F``; y is measured.

    Parameters
    ----------
    gain : float
        β [m/s²/V], not zero.
    damping : float
        c [1/s].
    effects : mapping of str to mapping of str to float
        Name of each effect to its parameters, all in SI; read-only once here.

    Raises
    ------
    InputError
        If an effect is unknown, a parameter is missing, too many or out of its range, or effects do not fit together.

    Examples
    --------
    >>> cart = Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.4}})
    >>> cart.effects["coulomb_friction"]["level"]
    0.4
    """

    gain: float
    damping: float
    effects: Mapping[str, Mapping[str, float]] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        for name, value in (("gain", self.gain), ("damping", self.damping)):
            object.__setattr__(self, name, _finite(value, f"truth: {name}"))
        if self.gain == 0:
            raise InputError("truth: gain must not be 0, the command would move nothing")
        if not isinstance(self.effects, Mapping):
            raise InputError(
                "truth: effects must be names with their parameters, such as {'coulomb_friction': {'level': 0.3}}; "
                f"got {described(self.effects)}"
            )
        checked = {name: MappingProxyType(_checked(name, values)) for name, values in self.effects.items()}
        _check_together(self.gain, checked)
        object.__setattr__(self, "effects", MappingProxyType(checked))

    def __reduce__(self) -> tuple[Any, tuple[()]]:
        effects = {name: dict(values) for name, values in self.effects.items()}
        return partial(Truth, gain=self.gain, damping=self.damping, effects=effects), ()


def _checked(name: str, values: Mapping[str, float]) -> dict[str, float]:
    if name not in LAWS:
        raise InputError(f"the laboratory has no effect {name[:40]!r}; {names_like(name, sorted(LAWS), 'it has')}")
    wanted, usual = LAWS[name].parameters, LAWS[name].usual
    if not wanted.keys() - usual.keys() <= set(values) <= set(wanted):
        raise InputError(f"truth: {name} needs {', '.join(wanted)}; got {', '.join(values) or 'none'}")
    numbers = {key: _finite(values[key], f"truth: {name}.{key}") for key in wanted if key in values}
    for key, number in numbers.items():
        if not wanted[key].holds(number):
            raise InputError(f"truth: {name}.{key} must {wanted[key]}, got {number:g}")
    return numbers


def _check_together(gain: float, effects: Mapping[str, Mapping[str, float]]) -> None:
    if "backlash" in effects and "flexible_coupling" in effects:
        raise InputError("truth: backlash and flexible_coupling cannot be combined, both move the load; keep one")
    stribeck = effects.get("stribeck_friction")
    if stribeck and stribeck["level"] + stribeck["static_excess"] < 0:
        raise InputError(
            f"truth: stribeck_friction.static_excess must be at least -level ({-stribeck['level']:g}),"
            f" got {stribeck['static_excess']:g}"
        )
    for name in ("friction_map", "end_stop"):
        own = effects.get(name)
        if own and not own["low"] < own["high"]:
            raise InputError(f"truth: {name}.low must be below high ({own['high']:g}), got {own['low']:g}")
    servo = effects.get("speed_servo")
    if servo:
        product = servo["proportional"] * servo["speed_per_volt"]
        if not math.isclose(gain, product, rel_tol=1e-6):
            raise InputError(
                f"truth: with speed_servo the gain is proportional times speed_per_volt, {product:g}, got {gain:g}"
            )


def _finite(value: float, what: str) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise InputError(f"{what} must be finite, got {number:g}")
    return number


def _paper_cart(gain: float, damping: float, alpha1: float, alpha2: float) -> Truth:
    return Truth(gain=gain, damping=damping, effects={"velocity_decay_damping": {"alpha1": alpha1, "alpha2": alpha2}})


LM1 = Truth(gain=1.8545, damping=6.1520)
"""Constant damping, identified at Kp 60 (eq. 17)."""
LM2 = Truth(gain=1.7482, damping=5.4916)
"""Constant damping, identified at Kp 80 (eq. 26)."""
LM3 = Truth(gain=1.7866, damping=4.5866)
"""Constant damping, identified at Kp 100 (eq. 27)."""
NLM1 = _paper_cart(gain=1.9165, damping=5.9986, alpha1=17.3264, alpha2=13.1068)
"""Damping that decays with speed, identified at Kp 60 (eq. 24)."""
NLM2 = _paper_cart(gain=1.9180, damping=5.6035, alpha1=22.1357, alpha2=18.2233)
"""Damping that decays with speed, identified at Kp 80 (eq. 28)."""
NLM3 = _paper_cart(gain=1.9100, damping=3.7990, alpha1=15.2528, alpha2=5.9934)
"""Damping that decays with speed, identified at Kp 100 (eq. 29)."""
