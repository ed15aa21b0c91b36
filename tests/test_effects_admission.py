"""Effects of others: inadmissible ones are refused with one sentence, good ones stand in the catalogue."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pytest

from servolens.effects import (
    CATALOGUE,
    Actuator,
    DryFriction,
    Effect,
    Force,
    MotorForce,
    State,
    TimeShift,
    Transmission,
    catalogue,
    effect_class,
    parameter,
)
from servolens.effects._admission import check_admissible
from servolens.errors import InputError
from servolens.plant import Plant

if TYPE_CHECKING:
    from collections.abc import Callable

STRANGER = ca.SX.sym("temperature")


def made(kind: type[Effect], physics: Callable[..., Any], **others: Any) -> type[Effect]:
    """Return an effect of a user, with one parameter called size."""

    class Bare(kind):  # type: ignore[misc,valid-type]  # a kind that is chosen
        name = "own"
        sentence = "An effect of a user."
        latex = "s"
        size: float = parameter("s", "{x}/s^2", "its size")

    Bare.physics = staticmethod(physics)
    for key, value in others.items():
        setattr(Bare, key, value)
    return dataclass(frozen=True, kw_only=True)(Bare)


def own(kind: type[Effect], physics: Callable[..., Any], **others: Any) -> Callable[[], Plant]:
    return lambda: Plant(gain=1.9, damping=6.0, effects=(made(kind, physics, **others)(size=1.0),))


LEVEL_STATE = (State("level", "{x}/s^2", relaxes=True),)
REFUSED: dict[str, tuple[Callable[[], Plant], str]] = {
    "force by the acceleration": (
        own(Force, lambda axis, p: p.size * axis.acceleration),
        "physics asks for axis.acceleration, which no effect is told; there are position, velocity, speed,",
    ),
    "force by the command": (
        own(Force, lambda command, axis, p: p.size * command),
        r"physics takes \(command, axis, p\), that of a force takes \(axis, p\), a static method",
    ),
    "force by the load": (
        own(Force, lambda axis, p: p.size * axis.load),
        "physics depends on axis.load, which dry friction alone is given",
    ),
    "method": (
        own(DryFriction, lambda self, axis, p: p.size),
        r"physics takes \(self, axis, p\), that of dry friction takes \(axis, p\), a static method",
    ),
    "unknown parameter": (own(Force, lambda axis, p: p.strength), "physics asks for p.strength, which is no parameter"),
    "symbol of its own": (
        own(Force, lambda axis, p: p.size * STRANGER),
        "physics depends on temperature, which is none of its arguments",
    ),
    "negative friction": (
        own(DryFriction, lambda axis, p: -0.3),
        "the level of dry friction is -0.3; it must never be",
    ),
    "friction that turns negative": (
        own(DryFriction, lambda axis, p: p.size * axis.position),
        "the level of dry friction is -1 at position -1; it must never be negative",
    ),
    "nothing": (
        own(Force, lambda axis, p: None),
        r"physics gives NoneType; a force gives one CasADi expression \(SX\)",
    ),
    "numbers of NumPy": (own(Force, lambda axis, p: np.zeros(2)), "physics gives ndarray; a force gives one CasADi"),
    "two expressions": (
        own(Force, lambda axis, p: ca.vertcat(p.size, axis.position)),
        r"physics gives SX\[2, 1\]; a force gives one CasADi expression",
    ),
    "no number": (own(Force, lambda axis, p: float("nan")), "physics gives nan, which is no finite number"),
    "a question of symbols": (
        own(Force, lambda axis, p: p.size if axis.velocity > 0 else 0.0),
        "physics fails with CasADi symbols: ",
    ),
    "a state without a rate": (
        own(Force, lambda axis, p: axis.state.level, states=LEVEL_STATE),
        "rates gives 0 for 1 states; give a tuple with one for each",
    ),
    "a rate without a state": (
        own(Force, lambda axis, p: p.size, rates=staticmethod(lambda axis, p: (p.size,))),
        "rates gives 1 for 0 states",
    ),
    "a rate that is no tuple": (
        own(Force, lambda axis, p: p.size, states=LEVEL_STATE, rates=staticmethod(lambda axis, p: p.size)),
        "rates gives SX; give a tuple with one rate for each state",
    ),
    "a state that does not relax": (
        own(
            Force,
            lambda axis, p: axis.state.level,
            states=LEVEL_STATE,
            rates=staticmethod(lambda axis, p: (-(axis.state.level**3),)),
        ),
        "the state level is said to relax, but its rate is not linear in it",
    ),
    "friction with a memory": (
        own(DryFriction, lambda axis, p: p.size, states=LEVEL_STATE),
        "dry friction has no states; a force with states can remember",
    ),
    "an actuator without its place": (own(Actuator, lambda command, axis, p: command), "an actuator needs a stage"),
    "a load that goes by other names": (
        own(
            Transmission,
            lambda axis, p: axis.state.level,
            states=LEVEL_STATE,
            rates=staticmethod(lambda axis, p: (axis.velocity,)),
            share=staticmethod(lambda p: 0.5),
        ),
        r"a transmission has the states position and velocity, the load's; it has \['level'\]",
    ),
    "no kind": (own(Effect, lambda axis, p: p.size), "it must be of one kind, one of Actuator, Drive, DryFriction,"),
    "two kinds": (
        own(type("Both", (Force, MotorForce), {}), lambda axis, p: p.size),
        "it must be of one kind",
    ),
}


@pytest.mark.parametrize(("make", "sentence"), REFUSED.values(), ids=REFUSED)
def test_inadmissible_effect_is_refused_where_a_plant_is_made_of_it(make, sentence):
    with pytest.raises(InputError, match=f"^the effect 'own' cannot be used: {sentence}") as caught:
        make()
    assert "\n" not in str(caught.value)


def test_field_that_is_no_parameter_is_refused():
    @dataclass(frozen=True, kw_only=True)
    class Loose(Force):
        name = "loose"
        sentence = "A force."
        latex = "s"
        size: float = parameter("s", "{x}/s^2", "its size")
        note: float = field(default=0.0)

        @staticmethod
        def physics(axis: Any, p: Any) -> Any:
            return p.size

    with pytest.raises(InputError, match="the effect 'loose' cannot be used: note is no parameter; declare it with"):
        check_admissible(Loose)


GOOD = {
    "a number": own(Force, lambda axis, p: 0.5),
    "other names": own(Force, lambda seen, values: values.size * seen.velocity),
    "friction by the load": own(DryFriction, lambda axis, p: 0.1 * ca.fabs(axis.load)),
    "time": own(TimeShift, lambda p: p.size),
}


@pytest.mark.parametrize("make", GOOD.values(), ids=GOOD)
def test_admissible_effect_makes_a_plant(make):
    assert make().effects[0].name == "own"


@pytest.mark.parametrize("cls", CATALOGUE.values(), ids=CATALOGUE)
def test_catalogue_is_admissible(cls):
    check_admissible(cls)


PACKAGE = """
from dataclasses import dataclass
from servolens.effects import Force, parameter

@dataclass(frozen=True, slots=True, kw_only=True)
class Wind(Force):
    name, sentence, latex = "wind_of_{tag}", "A sail drags.", "s v |v|"
    size: float = parameter("s", "1/{{x}}", "size")

    @staticmethod
    def physics(axis, p):
        return p.size * axis.{what} * axis.speed
"""


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Install a package that offers an effect, for the time of a test."""

    def installed(tag: str, what: str) -> None:
        (tmp_path / f"wind_{tag}.py").write_text(PACKAGE.format(tag=tag, what=what))
        info = tmp_path / f"wind_{tag}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: wind-{tag}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[servolens.effects]\nwind_of_{tag} = wind_{tag}:Wind\n")
        monkeypatch.syspath_prepend(tmp_path)

    return installed


def test_effects_of_installed_packages_stand_in_the_catalogue_behind_our_own(install):
    install("north", "velocity")
    found = catalogue()
    assert list(found) == [*CATALOGUE, "wind_of_north"]
    assert found["wind_of_north"] is effect_class("wind_of_north")
    assert "wind_of_north" not in CATALOGUE


def test_inadmissible_effect_of_a_package_is_refused_when_it_is_loaded(install):
    install("south", "acceleration")
    sentence = "the effect 'wind_of_south' cannot be used: physics asks for axis.acceleration"
    for load in (catalogue, lambda: effect_class("wind_of_south")):
        with pytest.raises(InputError, match=sentence):
            load()


def test_catalogue_without_packages_is_our_own():
    assert catalogue() == CATALOGUE
