"""The catalogue of effects: each against a closed form written here, and what it says of itself."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import servolens
from servolens import effects
from servolens.dynamics import dynamics
from servolens.effects import CATALOGUE, DryFriction, Effect, Presliding, Seen, SpeedServo, StribeckFriction
from servolens.effects.backlash import LOAD_DRAG, Backlash
from servolens.errors import InputError
from servolens.plant import Plant
from servolens.report.svg import formula_svg
from servolens.report.wording import symbol_text
from servolens.units import parse_unit

if TYPE_CHECKING:
    from collections.abc import Callable

CONTACT_RATE = 2000.0  # usual, rad/s
INSTANTS = 60

# What users' files rely on: kind, and parameters with their units, in this order.
CONTRACT: dict[str, tuple[str, dict[str, str]]] = {
    "actuator_lag": ("Actuator", {"time_constant": "s"}),
    "asymmetric_damping": ("Force", {"damping_difference": "1/s"}),
    "asymmetric_friction": ("DryFriction", {"level_positive": "m/s^2", "level_negative": "m/s^2"}),
    "backlash": ("Transmission", {"gap": "m", "load_share": "1"}),
    "cogging": ("Force", {"amplitude": "m/s^2", "pitch": "m", "phase": "rad"}),
    "constant_force": ("Force", {"acceleration": "m/s^2"}),
    "coulomb_friction": ("DryFriction", {"level": "m/s^2"}),
    "dead_zone": ("Actuator", {"width": "V"}),
    "delay": ("TimeShift", {"time": "s"}),
    "end_stop": ("Force", {"low": "m", "high": "m"}),
    "flexible_coupling": ("Transmission", {"frequency": "Hz", "damping_ratio": "1", "load_ratio": "1"}),
    "force_limit": ("MotorForce", {"acceleration": "m/s^2"}),
    "friction_map": (
        "DryFriction",
        {f"{way}_{i}": "m/s^2" for way in ("positive", "negative") for i in range(5)} | {"low": "m", "high": "m"},
    ),
    "gain_drift": ("Actuator", {"rate": "1/s"}),
    "hardening_spring": ("Force", {"cubic_stiffness": "1/s^2/m^2"}),
    "load_friction": ("DryFriction", {"share": "1"}),
    "pendulum_gravity": ("Force", {"amplitude": "m/s^2", "phase": "rad"}),
    "periodic_disturbance": ("Force", {"amplitude": "m/s^2", "frequency": "Hz", "phase": "rad"}),
    "position_friction": ("DryFriction", {"level": "m/s^2", "centre": "m", "width": "m"}),
    "presliding": ("Force", {"stiffness": "1/s^2", "level": "m/s^2"}),
    "quadratic_drag": ("Force", {"drag": "1/m"}),
    "return_spring": ("Force", {"stiffness": "1/s^2"}),
    "saturation": ("Actuator", {"limit": "V"}),
    "sensor_lag": ("Sensor", {"time_constant": "s"}),
    "speed_servo": ("Drive", {"speed_per_volt": "m/s/V", "proportional": "1/s", "integral": "1/s^2"}),
    "stribeck_friction": ("DryFriction", {"level": "m/s^2", "static_excess": "m/s^2", "stribeck_speed": "m/s"}),
    "velocity_decay_damping": ("Force", {"alpha1": "1/s", "alpha2": "s/m"}),
}

TYPICAL = Seen(
    low=0.0,
    high=0.4,
    usual=(0.0, 0.3),
    speed=0.6,
    command=10.0,
    gain=1.9,
    damping=6.0,
    sample_time=1e-3,
    duration=10.0,
    noise=1e-5,
)
SEEN = {
    "cart": TYPICAL,
    "arm that falls": replace(TYPICAL, low=-9.0, high=-2.0, usual=(-8.0, -3.0), speed=30.0, gain=-45.0, command=3.0),
    "coarse encoder": replace(TYPICAL, high=1e-4, noise=1e-3),
    "nothing moves": replace(TYPICAL, high=0.0, usual=(0.0, 0.0), speed=0.0, command=0.0, damping=-1.0, noise=0.0),
    "nothing at all": Seen(
        low=0.0,
        high=0.0,
        usual=(0.0, 0.0),
        speed=0.0,
        command=0.0,
        gain=0.0,
        damping=0.0,
        sample_time=0.0,
        duration=0.0,
        noise=0.0,
    ),
    "huge": replace(
        TYPICAL,
        low=-1e9,
        high=1e9,
        usual=(-1e9, 1e9),
        speed=1e15,
        command=1e15,
        gain=1e12,
        sample_time=9.0,
        duration=1e9,
    ),
}

every_effect = pytest.mark.parametrize("cls", CATALOGUE.values(), ids=CATALOGUE)


@dataclass(frozen=True)
class Instant:
    """One instant of an axis, in numbers."""

    x: float
    v: float
    t: float
    u: float
    gain: float
    damping: float
    states: tuple[float, ...] = ()
    direction: float = 0.0

    @property
    def sign(self) -> float:
        return self.direction or float(np.sign(self.v))


def form(**parts: Any) -> dict[str, Any]:
    return parts


def contact(m: Instant, p: Any) -> float:
    """Force from motor to load through play: a spring and damper at either end that can only push."""
    load, load_speed = m.states
    ahead, closing = m.x - load, m.v - load_speed
    side = np.sign(ahead)
    depth = abs(ahead) - p.gap / 2
    reduced = 1 / (1 / p.load_share + 1 / (1 - p.load_share))
    w = 2 * np.pi * p.contact_frequency
    force = reduced * (w**2 * depth + 2 * p.contact_damping * w * side * closing)
    return side * force if depth > 0 and force > 0 else 0.0


def coupling(m: Instant, p: Any) -> float:
    load, load_speed = m.states
    w, reduced = 2 * np.pi * p.frequency, p.load_ratio - p.load_ratio**2
    return w**2 * reduced * (m.x - load) + 2 * p.damping_ratio * w * reduced * (m.v - load_speed)


def stop(m: Instant, p: Any) -> float:
    """Force of the stops: a spring and damper at either end that can only push back."""
    depth = m.x - p.high if m.x > p.high else min(m.x - p.low, 0.0)
    w = 2 * np.pi * p.contact_frequency
    force = w**2 * depth + 2 * p.contact_damping * w * m.v
    return force if depth * force > 0 else 0.0


def mapped(m: Instant, p: Any) -> float:
    levels = [getattr(p, f"{'positive' if m.sign > 0 else 'negative'}_{i}") for i in range(5)]
    return float(np.interp(m.x, np.linspace(p.low, p.high, 5), levels))


# Of an instant and parameters: what stands in place of the command ("a") or of the motor ("motor"), what the forces
# sum to, the level of dry friction, the rates of the states, the load's share and more; the rest is the bare plant's.
FORMS: dict[str, Callable[[Instant, Any], dict[str, Any]]] = {
    "actuator_lag": lambda m, p: form(a=m.states[0], rates=[(m.u - m.states[0]) / p.time_constant]),
    "asymmetric_damping": lambda m, p: form(
        motor=m.gain * m.u - (m.damping + np.sign(m.v) * p.damping_difference / 2) * m.v
    ),
    "asymmetric_friction": lambda m, p: form(level=p.level_positive if m.v > 0 else p.level_negative),
    "backlash": lambda m, p: form(
        forces=contact(m, p),
        share=p.load_share,
        rates=[m.states[1], contact(m, p) / p.load_share - 2.0 * m.states[1]],
        output=m.states[0],
        output_velocity=m.states[1],
    ),
    "cogging": lambda m, p: form(forces=p.amplitude * np.sin(2 * np.pi * m.x / p.pitch + p.phase)),
    "constant_force": lambda m, p: form(forces=p.acceleration),
    "coulomb_friction": lambda m, p: form(level=p.level),
    "dead_zone": lambda m, p: form(a=np.sign(m.u) * max(abs(m.u) - p.width, 0.0)),
    "delay": lambda m, p: form(delay=p.time),
    "end_stop": lambda m, p: form(forces=stop(m, p)),
    "flexible_coupling": lambda m, p: form(
        forces=coupling(m, p),
        share=p.load_ratio,
        rates=[m.states[1], coupling(m, p) / p.load_ratio],
        output=m.states[0],
        output_velocity=m.states[1],
    ),
    "force_limit": lambda m, p: form(motor=np.clip(m.gain * m.u - m.damping * m.v, -p.acceleration, p.acceleration)),
    "friction_map": lambda m, p: form(level=mapped(m, p)),
    "gain_drift": lambda m, p: form(a=m.u + m.u * p.rate * m.t),
    "hardening_spring": lambda m, p: form(forces=p.cubic_stiffness * m.x**3),
    "load_friction": lambda m, p: form(level=p.share * abs(m.gain * m.u)),
    "pendulum_gravity": lambda m, p: form(forces=p.amplitude * np.sin(m.x + p.phase)),
    "periodic_disturbance": lambda m, p: form(forces=p.amplitude * np.sin(2 * np.pi * p.frequency * m.t + p.phase)),
    "position_friction": lambda m, p: form(level=p.level * np.exp(-(((m.x - p.centre) / p.width) ** 2))),
    "presliding": lambda m, p: form(
        forces=m.states[0], rates=[p.stiffness * m.v * (1 - m.states[0] / p.level * np.sign(m.v))]
    ),
    "quadratic_drag": lambda m, p: form(forces=p.drag * m.v * abs(m.v)),
    "return_spring": lambda m, p: form(forces=p.stiffness * m.x),
    "saturation": lambda m, p: form(a=np.clip(m.u, -p.limit, p.limit)),
    "sensor_lag": lambda m, p: form(shown=m.x - m.states[0], rates=[m.v - m.states[0] / p.time_constant]),
    "speed_servo": lambda m, p: form(
        motor=p.proportional * (p.speed_per_volt * m.u - m.v) + p.integral * m.states[0] - m.damping * m.v,
        rates=[p.speed_per_volt * m.u - m.v],
    ),
    "stribeck_friction": lambda m, p: form(level=p.level + p.static_excess * np.exp(-abs(m.v) / p.stribeck_speed)),
    "velocity_decay_damping": lambda m, p: form(forces=p.alpha1 * np.exp(-p.alpha2 * abs(m.v)) * m.v),
}
OUTPUTS = ("push", "level", "rates", "delay", "output", "output_velocity", "shown")


def closed_form(name: str, m: Instant, p: Any) -> dict[str, Any]:
    given_parts = FORMS[name](m, p)
    motor = given_parts.get("motor", m.gain * given_parts.get("a", m.u) - m.damping * m.v)
    own_share = 1 - given_parts.get("share", 0.0)
    output = given_parts.get("output", m.x)
    return {
        "push": (motor - given_parts.get("forces", 0.0)) / own_share,
        "level": given_parts.get("level", 0.0) / own_share,
        "rates": given_parts.get("rates", []),
        "delay": given_parts.get("delay", 0.0),
        "output": output,
        "output_velocity": given_parts.get("output_velocity", m.v),
        "shown": given_parts.get("shown", output),
    }


@lru_cache(maxsize=64)
def composed(structure: tuple[type[Effect], ...]) -> ca.Function:
    d = dynamics(structure)
    return ca.Function("composed", d.inputs, [getattr(d, name) for name in OUTPUTS])


def evaluated(structure: tuple[type[Effect], ...], m: Instant, values: tuple[float, ...] = ()) -> dict[str, Any]:
    found = composed(structure)(m.x, m.v, m.t, m.u, m.sign, [m.gain, m.damping, *values], list(m.states))
    return {name: np.array(value).ravel() for name, value in zip(OUTPUTS, found, strict=True)}


def drawn(cls: type[Effect], rng: np.random.Generator) -> Effect:
    """Return an effect with random parameters of ordinary size, of either sign where the bounds let them."""
    values = {}
    for spec in cls.parameters():
        size = rng.uniform(0.02, 0.98) if spec.high <= 1.0 else np.exp(rng.normal())
        sign = rng.choice([-1.0, 1.0]) if spec.low < 0 else 1.0
        values[spec.name] = float(np.clip(sign * size, spec.low, spec.high))
    return cls(**allowed(values))


def allowed(values: dict[str, float]) -> dict[str, float]:
    """Return `values` changed so that they go together."""
    if "static_excess" in values:
        values["static_excess"] = max(values["static_excess"], -values["level"])
    if "low" in values and not values["low"] < values["high"]:
        ends = values["high"], values["low"]
        values["low"], values["high"] = ends if ends[0] < ends[1] else (-1.0, 1.0)
    return values


def instant(rng: np.random.Generator, states: int) -> Instant:
    x, v, u, gain = rng.normal(size=4) + np.array([0.0, 0.0, 0.0, 2.0])
    t, damping = rng.exponential(size=2)
    return Instant(x=x, v=v, t=t, u=u, gain=gain, damping=damping, states=tuple(rng.normal(size=states)))


@pytest.mark.parametrize("cls", [CATALOGUE[name] for name in FORMS], ids=FORMS)
def test_composed_physics_is_the_closed_form(cls):
    rng = np.random.default_rng(7)
    for _ in range(INSTANTS):
        effect, m = drawn(cls, rng), instant(rng, len(cls.states))
        found = evaluated((cls,), m, effect.values)
        expected = closed_form(cls.name, m, SimpleNamespace(**dict(zip(names_of(cls), effect.values, strict=True))))
        for part in OUTPUTS:
            np.testing.assert_allclose(found[part], np.atleast_1d(expected[part]), rtol=1e-11, atol=1e-11)


@every_effect
def test_random_instants_reach_both_directions_and_every_branch(cls):
    """The comparison above would say little if an effect never changed anything at its instants."""
    rng = np.random.default_rng(7)
    changed, signs = 0, set()
    for _ in range(INSTANTS):
        effect, m = drawn(cls, rng), instant(rng, len(cls.states))
        with_it, without = evaluated((cls,), m, effect.values), evaluated((), replace(m, states=()))
        changed += any(not np.array_equal(with_it[part], without[part]) for part in OUTPUTS)
        signs.add(m.sign)
    assert changed > INSTANTS / 4
    assert signs == {-1.0, 1.0}


@pytest.mark.parametrize("cls", [cls for cls in CATALOGUE.values() if cls.absent_at], ids=lambda cls: cls.name)
def test_absent_values_leave_the_bare_plant(cls):
    rng = np.random.default_rng(11)
    for _ in range(INSTANTS):
        effect = replace(drawn(cls, rng), **cls.absent_at)
        assert effect.absent
        m = instant(rng, len(cls.states))
        found = evaluated((cls,), replace(m, states=settled(cls, m, effect.values)), effect.values)
        bare = evaluated((), replace(m, states=()))
        for part in ("push", "level", "delay", "output", "output_velocity", "shown"):
            np.testing.assert_allclose(found[part], bare[part], rtol=1e-12, atol=1e-11)


def settled(cls: type[Effect], m: Instant, values: tuple[float, ...]) -> tuple[float, ...]:
    """Return what the states run after: their rates are linear in them."""
    at_zero = evaluated((cls,), replace(m, states=(0.0,) * len(cls.states)), values)["rates"]
    at_one = evaluated((cls,), replace(m, states=(1.0,) * len(cls.states)), values)["rates"]
    return tuple(at_zero / (at_zero - at_one))


@every_effect
def test_effect_that_is_there_is_not_absent(cls):
    assert not drawn(cls, np.random.default_rng(1)).absent


def test_only_two_masses_and_a_servo_always_change_something():
    always = [name for name in CONTRACT if not CATALOGUE[name].absent_at]
    assert always == ["backlash", "flexible_coupling", "speed_servo"]


def names_of(cls: type[Effect]) -> list[str]:
    return [spec.name for spec in cls.parameters()]


def test_every_effect_has_a_closed_form_here_or_a_test_of_its_own():
    own = {path.stem.removeprefix("test_effect_") for path in Path(__file__).parent.glob("test_effect_*.py")}
    assert set(CATALOGUE) - set(FORMS) <= own


@every_effect
def test_typical_values_are_admissible_and_change_the_axis(cls):
    assert set(cls.typical) == {spec.name for spec in cls.parameters() if spec.usual is None}
    assert not cls(**cls.typical).absent


def test_catalogue_keeps_the_contract():
    kinds = (getattr(effects, kind) for kind, _ in CONTRACT.values())
    assert list(CATALOGUE) == sorted(CATALOGUE)
    assert all(issubclass(CATALOGUE[name], kind) for name, kind in zip(CONTRACT, kinds, strict=True))
    for name, (_, units) in CONTRACT.items():
        needed = [spec for spec in CATALOGUE[name].parameters() if spec.usual is None]
        assert [(spec.name, spec.unit_for("m", "V")) for spec in needed] == list(units.items())


@every_effect
def test_units_are_units(cls):
    for spec in cls.parameters():
        assert spec.unit == "1" or parse_unit(spec.unit_for("m", "V")) is not None


@every_effect
def test_every_effect_is_importable_from_the_root(cls):
    assert getattr(servolens, cls.__name__) is cls
    assert cls.__name__ in servolens.__all__


@every_effect
def test_every_bound_is_refused_with_a_sentence(cls):
    good = drawn(cls, np.random.default_rng(2))
    for spec in cls.parameters():
        for wrong in (np.nextafter(spec.low, -np.inf), np.nextafter(spec.high, np.inf), np.nan, np.inf):
            with pytest.raises(InputError, match=rf"{cls.name}: {spec.name} must lie in \[.*\], got "):
                replace(good, **{spec.name: wrong})


def test_friction_at_rest_may_not_be_negative():
    with pytest.raises(InputError, match=r"stribeck_friction: level \+ static_excess .* got 1 \+ \(-1\.5\)"):
        StribeckFriction(level=1.0, static_excess=-1.5, stribeck_speed=0.1)
    assert StribeckFriction(level=1.0, static_excess=-1.0, stribeck_speed=0.1).static_excess == -1.0


def test_speed_servo_needs_a_speed_and_sets_the_gain():
    with pytest.raises(InputError, match="speed_servo: speed_per_volt must not be 0"):
        SpeedServo(speed_per_volt=0.0, proportional=20.0, integral=0.0)
    servo = SpeedServo(speed_per_volt=-0.3, proportional=20.0, integral=50.0)
    assert servo.gain == -0.3 * 20.0
    assert Plant(gain=1.0, damping=0.0, effects=(servo,)).gain == servo.gain


@every_effect
def test_every_effect_speaks_plainly(cls):
    for words in (cls.sentence, cls.looks_like, cls.remedy, cls.for_the_gain):
        assert words.endswith(".")
        assert words[0].isupper()
        assert len(words) < 300
        assert words.isprintable()
        assert "  " not in words


@every_effect
def test_every_formula_and_symbol_renders(cls):
    for latex in (cls.latex, *(spec.symbol for spec in cls.parameters())):
        assert "<path" in formula_svg(latex, "key")
    assert all("\\" not in symbol_text(spec.symbol) for spec in cls.parameters())


@every_effect
def test_every_formula_is_mathml(cls):
    converter = pytest.importorskip("latex2mathml.converter")
    for latex in (cls.latex, *(spec.symbol for spec in cls.parameters())):
        assert "\\" not in converter.convert(latex)


@pytest.mark.parametrize("seen", SEEN.values(), ids=SEEN)
@every_effect
def test_starts_are_admissible(cls, seen):
    found = list(cls.starts(seen))
    assert found
    assert len(set(found)) == len(found) or seen is not TYPICAL
    for effect in found:
        assert type(effect) is cls
        assert np.isfinite(effect.values).all()
        assert seen is not TYPICAL or not effect.absent


@pytest.mark.parametrize(
    ("name", "parameter", "low", "high", "count"),
    [
        ("position_friction", "centre", 0.04, 0.36, 9),
        ("stribeck_friction", "stribeck_speed", 0.006, 0.12, 3),
        ("velocity_decay_damping", "alpha2", 5.0, 50.0, 3),
        ("dead_zone", "width", 2e-3, 1.0, 5),
        ("saturation", "limit", 1.0, 9.0, 6),
        ("force_limit", "acceleration", 1.9, 17.1, 6),
        ("backlash", "gap", 4e-5, 1.2e-2, 6),
        ("speed_servo", "proportional", 3.0, 200.0, 5),
        ("load_friction", "share", 0.03, 0.3, 3),
        ("friction_map", "high", 0.3, 0.4, 2),
        ("end_stop", "high", 0.4 - 0.02 * 0.4 - 4e-5, 101 * 0.4, 3),
    ],
)
def test_starts_span_what_the_record_can_show(name, parameter, low, high, count):
    found = sorted({getattr(effect, parameter) for effect in CATALOGUE[name].starts(TYPICAL)})
    assert len(found) == count
    np.testing.assert_allclose([found[0], found[-1]], [low, high])


def test_pitches_and_frequencies_are_close_enough_to_lock_on():
    counts = [TYPICAL.travel / effect.pitch for effect in CATALOGUE["cogging"].starts(TYPICAL)]
    assert np.diff(counts).max() < 0.11  # ten in a peak
    assert min(counts) <= 0.5
    assert max(counts) > 50
    rates = [effect.frequency for effect in CATALOGUE["periodic_disturbance"].starts(TYPICAL)]
    assert np.diff(rates[:800]).max() * TYPICAL.duration < 0.11
    assert rates[-1] == pytest.approx(0.1 / TYPICAL.sample_time)


@pytest.mark.parametrize("times", [1e-2, 1.0, 1e2])
def test_a_resonance_is_sought_from_as_slow_as_the_axis_moves_to_what_a_log_shows(times):
    seen = replace(TYPICAL, speed=times * TYPICAL.speed, sample_time=TYPICAL.sample_time / times)
    found = np.array([effect.frequency for effect in CATALOGUE["flexible_coupling"].starts(seen)])
    assert found[0] <= max(0.25 * times, 0.1)  # 1.5 of the travel in a second
    assert found[-1] == pytest.approx(400.0 * times)
    assert np.all(found[1:] < 1.5 * found[:-1])


def test_no_pitch_is_sought_in_the_noise():
    noisy = replace(TYPICAL, noise=0.01)
    assert min(effect.pitch for effect in CATALOGUE["cogging"].starts(noisy)) >= 0.06


@every_effect
def test_names_and_numbers_survive_json(cls):
    effect = drawn(cls, np.random.default_rng(3))
    text = json.dumps({effect.name: dict(zip(names_of(cls), effect.values, strict=True))})
    [(name, parameters)] = json.loads(text).items()
    assert Plant.effect_from(name, parameters) == effect


dry_friction = st.sampled_from([cls for cls in CATALOGUE.values() if issubclass(cls, DryFriction)])


@st.composite
def frictions(draw: Any) -> Effect:
    """Dry friction with any parameters in bounds."""
    cls = draw(dry_friction)
    values = {spec.name: draw(st.floats(spec.low, spec.high)) for spec in cls.parameters()}
    return cls(**allowed(values))


@given(
    friction=frictions(),
    position=st.floats(-1e6, 1e6),
    velocity=st.floats(-1e6, 1e6),
    sharpness=st.floats(0.0, 1.0),
)
def test_friction_never_gives_energy(friction, position, velocity, sharpness):
    """Also where a consumer smooths the sign of the velocity to a number between -1 and 1."""
    m = Instant(x=position, v=velocity, t=0.0, u=0.0, gain=1.0, damping=0.0, direction=np.sign(velocity) * sharpness)
    [level] = evaluated((type(friction),), m, friction.values)["level"]
    assert np.isfinite(level)
    assert level >= 0
    assert level * m.direction * velocity >= 0


def test_load_is_the_force_of_the_motor_and_of_what_position_and_time_decide():
    """Not that of damping, of drag, or of bristles, which know how the axis moves."""
    parts = {
        "load_friction": (0.3,),
        "quadratic_drag": (2.0,),
        "presliding": (50.0, 0.4),
        "pendulum_gravity": (1.5, 0.2),
        "periodic_disturbance": (0.7, 3.0, 0.1),
        "dead_zone": (0.5,),
    }
    structure = tuple(CATALOGUE[name] for name in parts)
    m = Instant(x=0.4, v=-0.8, t=0.21, u=-2.0, gain=1.9, damping=6.0, states=(0.3,))
    found = evaluated(structure, m, tuple(value for values in parts.values() for value in values))
    outside = 1.5 * np.sin(0.4 + 0.2) + 0.7 * np.sin(2 * np.pi * 3.0 * 0.21 + 0.1)
    assert found["level"] == pytest.approx(0.3 * abs(1.9 * -1.5 + outside))


def test_effects_that_no_data_can_tell_apart_know_of_each_other():
    assert CATALOGUE["asymmetric_friction"].unites == ("coulomb_friction", "constant_force")
    assert (CATALOGUE["actuator_lag"].twin, CATALOGUE["sensor_lag"].twin) == ("sensor_lag", "actuator_lag")
    assert CATALOGUE["flexible_coupling"].same_structure == ("second_order_actuator",)
    assert CATALOGUE["load_friction"].generalises == ()
    assert set(CATALOGUE["friction_map"].generalises) == {
        "coulomb_friction",
        "asymmetric_friction",
        "position_friction",
    }


@every_effect
def test_what_a_fit_finds_last_are_parameters(cls):
    assert set(cls.found_last) <= set(names_of(cls))


def test_friction_map_takes_the_levels_of_the_friction_it_generalises():
    coulomb = CATALOGUE["coulomb_friction"](level=0.5)
    place = CATALOGUE["position_friction"](level=2.0, centre=0.2, width=0.1)
    found = [*CATALOGUE["friction_map"].generalised([coulomb, place], TYPICAL)]
    whole = next(one for one in found if one.high == 0.4)
    assert whole.positive_0 == whole.negative_0 == pytest.approx(0.5 + 2.0 * np.exp(-4.0))
    assert whole.positive_2 == whole.negative_2 == pytest.approx(2.5)
    uneven = CATALOGUE["asymmetric_friction"](level_positive=0.7, level_negative=0.1)
    for one in CATALOGUE["friction_map"].generalised([uneven], TYPICAL):
        np.testing.assert_allclose(one.values[:10], [0.7] * 5 + [0.1] * 5)


@pytest.mark.parametrize(("high", "whole"), [(0.399, True), (0.40003, True), (0.41, False)])
def test_end_stop_is_known_where_the_axis_reaches_it(high, whole):
    assert CATALOGUE["end_stop"](low=-1.0, high=high).is_whole(TYPICAL) == whole


@given(
    travels=st.lists(st.floats(-0.1, 0.1), min_size=1, max_size=40),
    stiffness=st.floats(1.0, 1e6),
    level=st.floats(1e-3, 1e2),
)
def test_presliding_stores_and_loses_energy_but_never_makes_any(travels, stiffness, level):
    """Along any path the work done is at least the gain of the stored energy f²/(2σ) (Dahl)."""
    force = work = 0.0
    for travel in travels:
        if travel == 0:
            continue
        v, duration = float(np.sign(travel)), abs(travel)
        moving = Instant(x=0.0, v=v, t=0.0, u=0.0, gain=1.0, damping=0.0)
        at_zero, at_level = (
            evaluated((Presliding,), replace(moving, states=(f,)), (stiffness, level))["rates"][0] for f in (0.0, level)
        )
        slope = (at_level - at_zero) / level
        target, decay = -at_zero / slope, slope * duration  # the rate is linear in the force: this step is exact
        work += v * (target * duration + (force - target) * np.expm1(decay) / slope)
        force = target + (force - target) * np.exp(decay)
        assert abs(force) <= level * (1 + 1e-9)
        assert work >= force**2 / (2 * stiffness) - 1e-9 * level * sum(map(abs, travels))


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_backlash_pushes_and_never_pulls(side):
    play = Backlash(gap=0.02, load_share=0.4)

    def force(ahead: float, closing: float) -> float:
        m = Instant(x=side * ahead, v=side * closing, t=0.0, u=0.0, gain=1.0, damping=0.0, states=(0.0, 0.0))
        return side * -0.6 * evaluated((Backlash,), m, play.values)["push"][0]

    reduced = 0.4 * 0.6
    assert force(0.0099, 5.0) == 0.0
    assert force(0.011, 0.0) == pytest.approx(reduced * CONTACT_RATE**2 * 0.001)
    assert force(0.011, 0.3) == pytest.approx(reduced * (CONTACT_RATE**2 * 0.001 + 2 * CONTACT_RATE * 0.3))
    assert force(0.011, -5.0) == 0.0


def test_load_in_contact_neither_rings_nor_floats():
    """In contact the relative motion has a double pole at the contact rate; between the flanks the load slows down."""
    play = Backlash(gap=0.0, load_share=0.3)

    def accelerations(ahead: float, closing: float) -> float:
        m = Instant(x=ahead, v=closing, t=0.0, u=0.0, gain=1.0, damping=0.0, states=(0.0, 0.0))
        found = evaluated((Backlash,), m, play.values)
        return found["push"][0] - found["rates"][1]

    spring, damper = -accelerations(1.0, 0.0), -(accelerations(1.0, 1.0) - accelerations(1.0, 0.0))
    np.testing.assert_allclose(np.roots([1.0, damper, spring]), [-CONTACT_RATE] * 2, rtol=1e-6)
    inside = Instant(x=0.0, v=0.0, t=0.0, u=0.0, gain=1.0, damping=0.0, states=(0.0, 0.7))
    assert evaluated((Backlash,), inside, Backlash(gap=0.1, load_share=0.3).values)["rates"][1] == pytest.approx(
        -LOAD_DRAG * 0.7
    )


def test_an_effect_that_the_records_cannot_show_is_not_whole():
    seen = effects.Seen(
        low=0.0, high=1.0, usual=(0.0, 1.0), speed=1.0, command=1.0, gain=1.0, damping=1.0, sample_time=1e-3,
        duration=10.0, noise=1e-5,
    )  # fmt: skip
    assert effects.Backlash(gap=1e-6, load_share=0.3).is_whole(seen)
    assert not effects.Backlash(gap=0.0, load_share=0.3).is_whole(seen)
    assert effects.GainDrift(rate=0.05).is_whole(seen)
    assert not effects.GainDrift(rate=0.2).is_whole(seen)
    assert not effects.GainDrift(rate=-0.2).is_whole(seen)
    assert effects.PositionFriction(level=1.0, centre=0.9, width=0.1).is_whole(seen)
    assert not effects.PositionFriction(level=1.0, centre=1.1, width=0.1).is_whole(seen)
    assert effects.Presliding(stiffness=1e4, level=0.2).is_whole(seen)
    assert not effects.Presliding(stiffness=1e5, level=0.2).is_whole(seen)  # gives way by 2 µm
    for noise in np.geomspace(1e-6, 3e-3, 40):
        noisy = replace(seen, noise=float(noise))
        assert all(effect.is_whole(noisy) for effect in effects.Presliding.starts(noisy))
