"""What a search for causes does where gain and damping alone seem shaken, or noise is what makes a cause likely."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servolens import Plant, diagnose, lab, simulate
from servolens.diagnosis.case import Case
from servolens.diagnosis.effort import EFFORT, shared, work_for
from servolens.diagnosis.explorer import Explorer
from servolens.diagnosis.ordering import (
    beside_shaking,
    delays,
    late_otherwise,
    parted,
    simplified,
    with_lag_for_damping,
    with_lag_for_servo,
    with_twins,
    without,
)
from servolens.diagnosis.replacements import promising
from servolens.diagnosis.search import search
from servolens.diagnosis.trials import Start, Trials, special_first, starts_to_fit
from servolens.effects import (
    CATALOGUE,
    ActuatorLag,
    AsymmetricDamping,
    AsymmetricFriction,
    Backlash,
    Cogging,
    ConstantForce,
    CoulombFriction,
    Delay,
    FrictionMap,
    HardeningSpring,
    PendulumGravity,
    PositionFriction,
    QuadraticDrag,
    ReturnSpring,
    Seen,
    SensorLag,
    SpeedServo,
    StribeckFriction,
    catalogue,
)
from servolens.identification.hypothesis import Hypothesis
from servolens.identification.likelihood import FEW
from servolens.identification.lowest import lowest
from servolens.identification.noise import NoiseModel
from servolens.identification.noise_search import shaken
from servolens.identification.score import ScoreTest

HUNG = Seen(
    low=0.0, high=0.4, usual=(0.0, 0.3), speed=0.6, command=10.0, gain=1.9, damping=6.0,
    sample_time=1e-3, duration=10.0, noise=1e-5,
)  # fmt: skip


def causes_of(campaign, effort="normal"):
    found = diagnose(campaign.records, heldout=campaign.heldout, effort=effort)
    return found.verdict, {cause.effect for cause in found.causes}


@pytest.mark.slow
def test_friction_that_is_likelier_for_the_noise_beside_it_alone_is_no_cause():
    campaign = lab.hidden_campaign(941872, foreign="random_drift")
    verdict, causes = causes_of(campaign)
    assert verdict != "explained"
    assert not causes


def test_rounding_of_a_coarse_encoder_is_no_friction():
    campaign = lab.hidden_campaign(930078, world="coarse")
    assert causes_of(campaign) == ("healthy", set())


def test_force_that_shaking_may_hide_from_the_integral_equation_is_scored_as_a_slight_one():
    """Damping that fades with the speed is a drag of the wrong sign; as large as nothing it has no direction."""
    records = [lab.step_record(lab.NLM2, kp, 4.0, noise=1e-5, seed=kp) for kp in (40, 60, 80)]
    trials = Trials(records, {}, len(catalogue()))
    rubbing = trials.likelihood.judged(trials.base().plant.with_effect(CoulombFriction(level=0.1)))
    test = ScoreTest(trials.likelihood, rubbing)
    assert rubbing.noise.rate > 0.0
    (found, *_) = [start for start in trials.starts(test, "quadratic_drag") if not start.plant.effects[-1].absent]
    larger = rubbing.plant.with_effect(QuadraticDrag(drag=0.1))
    assert 0.0 < found.gain == pytest.approx(test.gain(larger), rel=0.02)


@pytest.mark.slow
def test_two_causes_of_a_shaken_axis_are_found_as_a_pair():
    campaign = lab.hidden_campaign(711280, effects=["coulomb_friction", "return_spring"], world="shaken")
    assert causes_of(campaign, "quick") == ("explained", {"coulomb_friction", "return_spring"})


@pytest.mark.slow
def test_no_work_is_spent_on_steps_of_a_rough_error_that_gain_nothing():
    campaign = lab.hidden_campaign(1900300, effects=["backlash"], world="shaken")
    case, truth = Case(campaign.records, (), {}, len(catalogue())), campaign.truth
    plant = Plant(gain=truth.gain, damping=truth.damping).with_effect(Backlash(gap=2.8e-3, load_share=0.3))
    before = case.likelihood.work
    found = case.likelihood.judged(plant, case.base)
    assert found.total < case.base.total - 9000.0
    assert case.likelihood.work - before < 50e6  # 110 million when descents went on, and from white noise as well


def test_pitch_that_only_shows_beside_friction_is_proposed_together_with_it():
    campaign = lab.hidden_campaign(610108, effects=["coulomb_friction", "cogging"], world="coloured")
    case = Case(campaign.records, (), {}, len(catalogue()))
    first, *_ = case.trials.pairs(3)
    truth = campaign.truth.effects
    friction, cogging = sorted(first.effects, key=lambda effect: effect.name == "cogging")
    assert friction.values == pytest.approx([truth["coulomb_friction"]["level"]] * len(friction.values), rel=0.05)
    assert cogging.pitch == pytest.approx(truth["cogging"]["pitch"], rel=0.01)
    assert not any(effect.absent for plant in case.trials.pairs(3) for effect in plant.effects)
    assert cogging.amplitude == pytest.approx(truth["cogging"]["amplitude"], rel=0.05)


@pytest.mark.slow
def test_friction_and_cogging_beside_slow_noise_are_found_together():
    campaign = lab.hidden_campaign(910977, effects=["coulomb_friction", "cogging"], world="coloured")
    assert causes_of(campaign, "quick") == ("explained", {"coulomb_friction", "cogging"})


def test_pairs_that_waited_are_looked_for_by_all_that_was_scored_before():
    """A search that comes back to its first cause scores nothing again, and pairs as many effects as at once."""
    campaign = lab.hidden_campaign(712_500, effects=["coulomb_friction", "return_spring"], records=2)
    trials = Case(campaign.records, (), {}, len(catalogue())).trials.unshaken()
    base, work = trials.base(), []
    for rounds in (1, 2):
        explorer = Explorer(trials, EFFORT["quick"], lambda _, __: None, (), lambda _: False, 1.0)
        single = [explorer.extended([base], 0)[0] for _ in range(rounds)][-1]
        before = trials.likelihood.work
        pairs = explorer.paired(base, single)
        work.append(trials.likelihood.work - before)
        assert {"coulomb_friction", "return_spring"} in [set(pair.causes) for pair in pairs]
    assert work[1] == work[0]


@pytest.fixture(scope="module")
def sprung():
    """Records of an axis that a spring holds behind a dead zone, in slow noise: its voltage seems to push it back."""
    around = lab.Surroundings(noise=lab.SensorNoise(deviation=2.9e-4, autoregression=(0.97,)), encoder=0.0)
    forces = {"dead_zone": {"width": 2.335}, "return_spring": {"stiffness": 11.0}}
    truth, setup = lab.Truth(gain=0.785, damping=16.8, effects=forces), lab.Setup(surroundings=around)
    runs = ((233.0, 4.6, (0.2, 0.0, 0.1)), (140.0, 4.6, (0.2, 0.05)), (349.0, 9.1, (0.1, 0.0, 0.2)))
    return [
        lab.step_record(truth, kp, kd, reference=r, duration=2.0, sample_time=3e-3, seed=i, setup=setup)
        for i, (kp, kd, r) in enumerate(runs)
    ]


def test_gain_of_an_axis_that_a_spring_holds_does_not_vanish(sprung):
    trials = Trials(sprung, {}, len(catalogue()))
    assert trials.bare.gain < 0.0  # of the integral equation without a force
    assert 0.4 < trials.base().plant.gain < 1.2


def test_gain_and_damping_that_ran_away_are_taken_as_an_observer_tells_them(sprung):
    trials = Trials(sprung, {}, len(catalogue()))
    observed, unshaken = trials.base(), trials.unshaken()
    away = unshaken.likelihood.judged(replace(trials.bare, gain=0.3, damping=5.0))
    assert not unshaken.shows_time_constant(away.plant)
    found = unshaken.observed(away)
    assert found.plant.values == observed.plant.values
    assert found.noise.rate == 0.0
    assert unshaken.observed(found) is found


def test_friction_is_begun_beside_a_constant_force_where_the_axis_moves_one_way():
    """The integral equation cannot solve for both: what pushes the axis all the time is their sum."""
    truth = lab.Truth(
        gain=2.7, damping=21.7, effects={"coulomb_friction": {"level": 4.0}, "constant_force": {"acceleration": -3.0}}
    )
    records = [
        lab.step_record(truth, kp, noise=3e-6, duration=0.8, encoder=0.0, seed=i) for i, kp in enumerate((150.0, 120.0))
    ]
    trials = Trials(records, {}, len(catalogue()))
    pushed = trials.likelihood.judged(trials.base().plant.with_effect(ConstantForce(acceleration=1.0)))
    (start, *_) = trials.starts(ScoreTest(trials.likelihood, pushed), "coulomb_friction")
    found = trials.likelihood.judged(start.plant)
    assert found.noise.rate == 0.0 < pushed.noise.rate  # nothing seems to shake the axis any more
    assert found.misfit < pushed.misfit - 1000.0
    assert found.plant.named["coulomb_friction.level"] > 0.0


def test_a_speed_loop_that_hardly_integrates_is_begun_where_it_does_what_gain_and_damping_do():
    """All its starts led away from the axis, farther than gain and damping alone, and gravity was named instead."""
    servo = {"speed_per_volt": 0.159, "proportional": 6.35, "integral": 0.02}
    truth = lab.Truth(gain=0.159 * 6.35, damping=1.28, effects={"speed_servo": servo})
    gains, setup = ((231.0, 1.8), (118.0, 13.0), (177.0, 3.4)), {"duration": 8.0, "sample_time": 2e-3}
    records = [
        lab.step_record(truth, *g, reference=1.0, encoder=0.0, noise=1.5e-5, seed=i, **setup)
        for i, g in enumerate(gains)
    ]
    trials = Trials(records, {}, len(catalogue())).unshaken()
    base = trials.base()
    starts = starts_to_fit(trials.starts(ScoreTest(trials.likelihood, base), "speed_servo"))
    assert trials.begun(starts, base, 1e9).total < base.total - 5e4


def test_damping_that_no_sample_shows_in_one_direction_is_no_damping_by_direction():
    """It holds the axis, as friction does."""
    assert AsymmetricDamping(damping_difference=-12.0).is_whole(HUNG)
    assert not AsymmetricDamping(damping_difference=-58156.0).is_whole(HUNG)
    assert AsymmetricDamping(damping_difference=3000.0).is_whole(replace(HUNG, damping=2000.0))


@pytest.mark.slow
def test_a_spring_behind_a_dead_zone_is_found_in_slow_noise(sprung):
    trials = Trials(sprung, {}, len(catalogue()))
    assert {"dead_zone", "return_spring"} in [{e.name for e in plant.effects} for plant in trials.pairs(10)]
    found = diagnose(sprung)
    assert (found.verdict, {c.effect for c in found.causes}) == ("explained", {"dead_zone", "return_spring"})
    width = found.model.quantities["dead_zone.width"]
    assert abs(width.value - 2.335) < 3.5 * width.stderr < 0.05


def test_axis_that_hunts_in_a_play_is_found_at_the_lowest_of_many_minima():
    """Each bounce multiplies a difference: a simulation is no guide, and another cause was named for what it left."""
    campaign = lab.hidden_campaign(700204, effects=("backlash",))
    trials, true = Trials(campaign.records, {}, len(catalogue())), campaign.truth.effects["backlash"]
    play = CATALOGUE["backlash"](gap=2.0 * true["gap"], load_share=0.6)
    near = trials.likelihood.judged(trials.base().plant.with_effect(play))
    found = lowest(trials.likelihood, near, 6e7)
    assert found.total < near.total - 100.0

    def away(hypothesis):
        (effect,) = hypothesis.plant.effects
        return abs(effect.load_share / true["load_share"] - 1.0)

    assert away(found) < 0.03 < away(near)


def test_starts_of_an_effect_are_followed_one_after_the_other_where_effort_is_short():
    campaign = lab.hidden_campaign(700203, effects=("backlash",))
    trials = Trials(campaign.records, {}, len(catalogue())).unshaken()
    base = trials.base()
    starts = starts_to_fit(trials.starts(ScoreTest(trials.likelihood, base), "backlash"))
    assert len(starts) > 1
    allowance = 2.0 * work_for(trials.likelihood, starts[0].plant, 1)
    before = trials.likelihood.work
    found = trials.begun(starts, base, allowance)
    assert trials.likelihood.work - before < 2.0 * allowance
    alone = trials.likelihood.tried(starts[0].plant, base.noise, FEW, like=base, allowance=allowance)
    assert found.total == alone.total < base.total - 1e5


def test_noise_of_a_shaken_axis_has_a_power_for_an_observer_to_follow():
    _, power = shaken(NoiseModel.white(1e-5), loops=30.0).shaking(1e-3)
    assert power > 0.0


def test_without_a_drive_its_loop_is_gain_and_damping():
    servo = SpeedServo(speed_per_volt=0.1, proportional=8.0, integral=0.0)
    plant = Plant(gain=1.0, damping=0.5).with_effect(CoulombFriction(level=0.1)).with_effect(servo)
    bare = without(plant, "speed_servo")
    assert (bare.gain, bare.damping, bare.effects) == (servo.gain, 8.5, (CoulombFriction(level=0.1),))
    assert without(plant, "coulomb_friction") == plant.without_effect("coulomb_friction")
    record = lab.step_record(lab.NLM1, 60, seed=1)
    moved = [
        simulate(p, record).position
        for p in (without(bare, "coulomb_friction"), plant.without_effect("coulomb_friction"))
    ]
    np.testing.assert_allclose(*moved, atol=1e-9)


def test_general_forms_of_an_effect_are_tried_after_it():
    """Where the simple one leaves white noise alone, they are not tried at all."""
    bare = Plant(gain=2.0, damping=5.0)
    every = [
        StribeckFriction(level=0.1, static_excess=0.2, stribeck_speed=0.05),
        Delay(time=0.003),
        CoulombFriction(level=0.3),
    ]
    starts = [[Start(bare.with_effect(effect), 1.0)] for effect in every]
    first, second = special_first(starts)
    assert [some[0].effect for some in first[1]] == ["delay", "coulomb_friction"]
    assert (first[0], second[0]) == (0, 2)
    assert [some[0].effect for some in second[1]] == ["stribeck_friction"]
    assert special_first(starts[:2]) == [(0, starts[:2]), (2, [])]


def test_work_goes_where_it_is_needed():
    assert shared(10.0, [1.0, 20.0, 3.0]) == [1.0, 6.0, 3.0]
    assert shared(9.0, [5.0, 5.0, 5.0]) == [3.0, 3.0, 3.0]
    assert shared(100.0, [5.0, 20.0]) == [20.0, 80.0]
    assert shared(1.0, []) == []


def test_work_of_a_fit_is_told_beforehand():
    record = lab.step_record(lab.NLM1, 60, noise=1e-5, seed=1)
    trials = Trials([record], {}, len(catalogue()))
    for effect in (ReturnSpring(stiffness=3.0), CATALOGUE["backlash"](gap=2e-3, load_share=0.3)):
        plant, likelihood = trials.bare.with_effect(effect), trials.unshaken().likelihood
        likelihood.tried(plant, likelihood.white, 4)
        told = work_for(likelihood, plant, 4)
        assert 0.1 * told < likelihood.work <= told


def test_friction_beside_what_it_hides_begins_where_it_can_be_found():
    """A free drive leaves the integral equation no friction, and from none a fit hardly finds it."""
    campaign = lab.hidden_campaign(711_791, effects=["coulomb_friction", "speed_servo"], world="white")
    trials = Trials(campaign.records, {}, len(catalogue()))
    hidden = trials.hidden_beside_friction(trials.bare)
    assert {cls.name for cls in hidden} >= {"speed_servo", "backlash", "flexible_coupling"}
    for starts in hidden.values():
        assert all(plant.effect("coulomb_friction").level > 0.0 for plant in starts)


def test_friction_by_direction_beside_stribeck_friction_is_that_and_a_constant_force():
    """Its levels may not be negative: a third cause made up for that, and the constant force was not found."""
    uneven = CATALOGUE["asymmetric_friction"](level_positive=0.0, level_negative=0.2)
    stribeck = CATALOGUE["stribeck_friction"](level=0.03, static_excess=0.02, stribeck_speed=0.04)
    drag = CATALOGUE["quadratic_drag"](drag=0.1)
    plant = Plant(gain=1.7, damping=6.6, effects=(uneven, drag, stribeck))
    whole, *others = parted(plant)
    assert {effect.name for effect in whole.effects} == {"constant_force", "stribeck_friction", "quadratic_drag"}
    assert whole.effect("constant_force").acceleration == pytest.approx(-0.1)
    assert whole.effect("stribeck_friction").level == pytest.approx(0.13)
    assert [{*whole.effects} - {*other.effects} for other in others] == [
        {whole.effect("quadratic_drag")}, {whole.effect("stribeck_friction")},
    ]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "hidden"), [(711_091, "backlash"), (711_791, "speed_servo")])
@pytest.mark.parametrize("world", ["white", "coloured"])
def test_friction_and_what_it_hides_are_found_together(seed, hidden, world):
    campaign = lab.hidden_campaign(seed, effects=["coulomb_friction", hidden], world=world)
    assert causes_of(campaign) == ("explained", {"coulomb_friction", hidden})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "effects", "world"),
    [
        (911_791, ("coulomb_friction", "speed_servo"), "white"),
        (911_979, ("dead_zone", "flexible_coupling"), "coloured"),
        (1_910_500, ("cogging", "actuator_lag"), "coloured"),
    ],
)
def test_second_cause_is_looked_for_where_pairs_spent_the_effort(seed, effects, world):
    campaign = lab.hidden_campaign(seed, effects=effects, world=world)
    assert causes_of(campaign) == ("explained", set(effects))


@pytest.mark.slow
def test_drive_with_a_loop_of_its_own_is_found_together_with_friction():
    campaign = lab.hidden_campaign(610212, effects=["coulomb_friction", "speed_servo"], world="coloured")
    assert causes_of(campaign, "quick") == ("explained", {"coulomb_friction", "speed_servo"})


@pytest.mark.slow
def test_dead_zone_and_delay_that_hide_each_other_in_a_loop_are_looked_for_together():
    axis = lab.Truth(gain=45.0, damping=23.0, effects={"dead_zone": {"width": 0.5}, "delay": {"time": 0.05}})
    runs = tuple(lab.step_record(axis, kp=kp, reference=0.3, noise=3e-4, seed=int(kp)) for kp in (7.0, 8.0, 9.0))
    case = Case(runs, (), {}, len(catalogue())).simulating()
    explorer = Explorer(case.trials, EFFORT["normal"], lambda _, __: None, (), lambda _: False, 1.0)
    alone = explorer.extended([case.base], 0)
    pairs = explorer.paired(case.base, alone[0])
    assert set(pairs[0].causes) == {"dead_zone", "delay"}
    assert pairs[0].total < alone[0].total
    assert pairs[0].plant.values == pytest.approx((45.0, 23.0, 0.5, 0.05), rel=0.05)


def test_a_slow_lag_that_seems_to_be_damping_is_found_beside_a_limit_of_force():
    effects = {"force_limit": {"acceleration": 8.7}, "actuator_lag": {"time_constant": 0.156}}
    axis = lab.Truth(gain=138.0, damping=200.0, effects=effects)
    setup = lab.Setup(rest=0.05)
    runs = tuple(
        lab.step_record(axis, kp=kp, reference=0.2, noise=1e-4, seed=int(kp), setup=setup) for kp in (5.0, 10.0, 20.0)
    )
    case = Case(runs, (), {}, len(catalogue())).simulating()
    explorer = Explorer(case.trials, EFFORT["normal"], lambda _, __: None, (), lambda _: False, 1.0)
    alone = explorer.extended([case.base], 0)
    best = explorer.paired(case.base, alone[0])[0]
    assert set(best.causes) == {"force_limit", "actuator_lag"}
    assert best.plant.effect("actuator_lag").time_constant == pytest.approx(0.156, rel=0.05)
    assert best.plant.effect("force_limit").acceleration == pytest.approx(8.7, rel=0.05)


def test_damping_and_a_lag_exchanged_are_the_same_where_nothing_nonlinear_stands_between():
    plant = Plant(gain=4.5, damping=6.0, effects=(ActuatorLag(time_constant=0.02), CoulombFriction(level=0.1)))
    (other,) = with_lag_for_damping(plant)
    s = 1j * np.logspace(-1, 3, 50)
    responses = [p.gain / (s * (s + p.damping) * (p.effects[0].time_constant * s + 1.0)) for p in
                 (plant, replace(other, effects=[e for e in other.effects if isinstance(e, ActuatorLag)]))]  # fmt: skip
    assert responses[1] == pytest.approx(responses[0], rel=1e-12)
    assert (other.damping, other.effect("coulomb_friction").level) == (50.0, 0.1)
    assert not list(with_lag_for_damping(plant.without_effect("coulomb_friction")))
    assert not list(with_lag_for_damping(Plant(gain=4.5, damping=6.0, effects=(plant.effects[0], Delay(time=0.01)))))
    assert not list(with_lag_for_damping(plant.without_effect("actuator_lag")))
    assert not list(with_lag_for_damping(replace(plant, damping=1e-9)))  # slower than any lag
    assert not list(
        with_lag_for_damping(plant.with_effect(SpeedServo(speed_per_volt=0.5, proportional=10.0, integral=1.0)))
    )


def test_a_speed_loop_without_proportional_part_is_a_lag():
    servo = SpeedServo(speed_per_volt=0.5, proportional=1e-3, integral=300.0)
    plant = Plant(gain=1.0, damping=40.0, effects=(servo, Delay(time=0.01)))
    (other,) = with_lag_for_servo(plant)
    lag, s = other.effect("actuator_lag").time_constant, 1j * np.logspace(-1, 2, 50)
    theirs = other.gain / (s * (s + other.damping) * (lag * s + 1.0))
    own = servo.speed_per_volt * (1e-3 * s + 300.0) / (s * (s * s + (40.0 + 1e-3) * s + 300.0))
    assert theirs == pytest.approx(own, rel=1e-3)
    assert [effect.name for effect in other.effects] == ["delay", "actuator_lag"]
    assert lag < 1.0 / other.damping  # the lag is the quicker
    resonant = SpeedServo(speed_per_volt=0.5, proportional=1e-3, integral=500.0)
    assert not list(with_lag_for_servo(replace(plant, effects=(resonant,))))
    assert not list(with_lag_for_servo(replace(plant, effects=())))


def test_a_lag_that_was_taken_for_a_speed_loop_is_exchanged_for_it():
    late = {"actuator_lag": {"time_constant": 0.03}, "delay": {"time": 0.006}}
    axis = lab.Truth(gain=200.0, damping=10.0, effects=late)
    tries = ((0.5, 0.0, 0.5), (1.2, 0.05, 0.5), (0.8, 0.02, -0.5))
    runs = tuple(
        lab.step_record(axis, kp=kp, kd=kd, reference=to, noise=3e-5, sample_time=2e-3, duration=3.0, seed=seed)
        for seed, (kp, kd, to) in enumerate(tries)
    )
    case = Case(runs, (), {}, len(catalogue()))
    servo = SpeedServo(speed_per_volt=20.9, proportional=8.6, integral=406.5)
    taken = case.likelihood.judged(Plant(gain=180.0, damping=47.8, effects=(servo, Delay(time=0.006))))
    explorer = Explorer(case.trials, EFFORT["normal"], lambda _, __: None, (), lambda _: False, 1.0)
    found = explorer.exchanged(taken).plant
    assert {effect.name for effect in found.effects} == set(late)
    assert found.effect("actuator_lag").time_constant == pytest.approx(0.03, rel=1e-3)
    assert found.damping == pytest.approx(10.0, rel=1e-3)


def test_a_lag_alone_that_was_taken_for_a_speed_loop_is_exchanged_for_it():
    """A score of it far behind that of the speed loop, which is the same with two parameters more, kept it out."""
    axis = lab.Truth(gain=0.73, damping=3.2, effects={"sensor_lag": {"time_constant": 0.00425}})
    runs = tuple(
        lab.step_record(axis, kp=kp, kd=kd, reference=0.3, noise=2e-5, sample_time=5e-4, duration=0.6, seed=seed)
        for seed, (kp, kd) in enumerate(((1800.0, 79.0), (1100.0, 100.0)))
    )
    case = Case(runs, (), {}, len(catalogue()))
    servo = SpeedServo(speed_per_volt=0.23, proportional=1e-3, integral=742.0)
    taken = case.likelihood.judged(Plant(gain=2e-4, damping=238.0, effects=(servo,)))
    explorer = Explorer(case.trials, EFFORT["normal"], lambda _, __: None, (), lambda _: False, 1.0)
    found = explorer.exchanged(taken)
    assert found.causes in (("sensor_lag",), ("actuator_lag",))
    assert found.plant.effects[0].time_constant == pytest.approx(0.00425, rel=1e-2)
    assert found.plant.damping == pytest.approx(3.2, rel=1e-2)


def test_what_is_thinned_for_the_search_is_simulated_all_the_same_and_counted():
    axis = lab.Truth(gain=2.0, damping=6.0, effects={})
    record = lab.step_record(axis, kp=60.0, reference=[0.1, 0.0] * 6, noise=1e-5, seed=1)
    likelihood = Case((record,), (), {}, len(catalogue())).likelihood
    (run,) = likelihood.runs(likelihood.white)
    assert likelihood.every == 2
    assert (run.samples, run.simulated) == (-(-len(record) // 2), len(record))
    before = likelihood.work
    likelihood.tried(Plant(gain=2.0, damping=6.0), likelihood.white, 0)
    assert likelihood.work - before >= len(record)


def test_a_delay_that_is_tried_stays_within_its_range():
    assert [effect.name for effect in delays(101.0)] == ["actuator_lag", "delay"]  # of a loop that is slower than any


@pytest.mark.slow
def test_search_as_if_nothing_shook_the_axis_leaves_effort_for_the_second():
    campaign = lab.hidden_campaign(702281, effects=["saturation"], world="shaken")
    assert causes_of(campaign) == ("explained", {"saturation"})


@pytest.mark.slow
def test_shaken_axis_is_not_taken_for_an_unshaken_one_again_and_again():
    campaign = lab.hidden_campaign(712380, effects=["presliding", "gain_drift"], world="shaken")
    assert causes_of(campaign) == ("explained", {"presliding", "gain_drift"})


@pytest.mark.parametrize(
    ("effect", "other"),
    [
        (ActuatorLag(time_constant=0.004), SensorLag(time_constant=0.004)),
        (SensorLag(time_constant=0.004), ActuatorLag(time_constant=0.004)),
    ],
    ids=["actuator", "sensor"],
)
def test_lag_is_tried_elsewhere_in_the_loop(effect, other):
    plant = Plant(gain=2.0, damping=5.0, effects=(effect, CoulombFriction(level=0.3)))
    (twin,) = with_twins(plant)
    assert set(twin.effects) == {other, CoulombFriction(level=0.3)}
    assert (twin.gain, twin.damping) == (2.0, 5.0)


def test_a_loop_may_be_late_for_other_reasons_by_as_long():
    friction = CoulombFriction(level=0.3)
    plant = Plant(gain=2.0, damping=5.0, effects=(Delay(time=0.004), friction))
    others = {other.effects for other in late_otherwise(plant)}
    assert others == {(friction, ActuatorLag(time_constant=0.004)), (friction, SensorLag(time_constant=0.004))}
    both = Plant(gain=2.0, damping=5.0, effects=(Delay(time=0.004), ActuatorLag(time_constant=0.002)))
    assert all(len(other.effects) == 2 for other in late_otherwise(both))
    assert not list(late_otherwise(Plant(gain=2.0, damping=5.0, effects=(friction,))))


def test_two_lags_are_not_exchanged():
    lags = (ActuatorLag(time_constant=0.004), SensorLag(time_constant=0.002))
    assert not list(with_twins(Plant(gain=2.0, damping=5.0, effects=lags)))


@pytest.mark.slow
def test_search_as_if_nothing_shook_the_axis_ends_where_shaking_explains_the_rest():
    campaign = lab.hidden_campaign(720462, effects=["return_spring"], world="shaken")
    case, other = (Case(campaign.records, campaign.heldout, {}, len(catalogue())) for _ in range(2))
    assert case.base.noise.rate > 0.0
    found = search(case.trials, case.base, EFFORT["normal"], is_enough=case.is_enough)
    assert found.chosen.causes == ("return_spring",)
    assert found.chosen.noise.rate > 0.0
    search(other.trials, other.base, EFFORT["normal"])  # what it takes where nothing is enough
    assert case.likelihood.work < 2 / 3 * other.likelihood.work
    assert case.likelihood.work < 0.8 * EFFORT["normal"].work


def test_search_goes_on_from_what_an_earlier_one_has_found_though_that_leaves_something():
    """Of friction and a spring the friction is known: what is looked for is a second cause, not the first one again."""
    cart = lab.Truth(
        gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.3}, "return_spring": {"stiffness": 8.0}}
    )
    records = tuple(lab.step_record(cart, kp, noise=1e-5, seed=kp, sample_time=5e-3) for kp in (40, 80))
    case = Case(records, (), {}, len(catalogue()))
    friction = case.likelihood.judged(case.base.plant.with_effect(CoulombFriction(level=0.3)), case.base)
    assert not case.is_enough(friction)
    told, effort = [], replace(EFFORT["quick"], work=4e6)
    found = search(case.trials, case.base, effort, lambda what, _: told.append(what), (), case.is_enough, [friction])
    assert told[0] == "Looking for a second cause"
    assert set(found.chosen.causes) == {"coulomb_friction", "return_spring"}


def test_special_forms_are_tried_of_the_likeliest_that_has_no_more_causes():
    """Of friction with two levels beside a spring, where the search had gone on with a spring that stiffens."""
    cart = lab.Truth(
        gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.3}, "return_spring": {"stiffness": 8.0}}
    )
    records = tuple(lab.step_record(cart, kp, noise=1e-5, seed=kp, sample_time=5e-3) for kp in (40, 80))
    case = Case(records, (), {}, len(catalogue()))
    friction = AsymmetricFriction(level_positive=0.3, level_negative=0.3)
    known = [
        case.likelihood.judged(Plant(gain=1.9, damping=6.0, effects=(friction, other)), case.base)
        for other in (ReturnSpring(stiffness=8.0), HardeningSpring(cubic_stiffness=600.0))
    ]
    assert known[0].total < known[1].total
    explorer = Explorer(case.trials, EFFORT["normal"], lambda _, __: None, known, case.is_enough, 1.0)
    assert set(explorer.settled(known[1]).causes) == {"coulomb_friction", "return_spring"}


def test_gravity_that_is_no_more_than_a_spring_has_one_as_its_simple_form():
    (spring,) = PendulumGravity(amplitude=2.0, phase=0.5).simplified(HUNG)
    assert isinstance(spring, ReturnSpring)
    moved = 1e-6
    pull = 2.0 * (np.sin(0.5 + moved) - np.sin(0.5 - moved)) / (2.0 * moved)
    assert spring.stiffness == pytest.approx(pull, rel=1e-6)
    assert not [*PendulumGravity(amplitude=2.0, phase=np.pi).simplified(HUNG)]  # that pushes away


def test_force_that_repeats_once_a_turn_has_gravity_as_its_simple_form():
    turned = Plant(gain=15.0, damping=18.0, length_unit="rad").with_effect(
        Cogging(amplitude=7.0, pitch=6.28, phase=-2.3)
    )
    (arm,) = simplified(turned, HUNG)
    assert arm.effects == (PendulumGravity(amplitude=7.0, phase=-2.3),)
    assert not [*simplified(replace(turned, length_unit="m"), HUNG)]
    assert not [*Cogging(amplitude=7.0, pitch=3.0, phase=-2.3).simplified(HUNG)]


def test_a_friction_map_with_one_high_knot_may_be_a_tight_spot():
    spot = PositionFriction(level=2.0, centre=0.11, width=0.06)
    places = np.linspace(0.0, 0.4, 5)
    levels = spot.level * np.exp(-(((places - spot.centre) / spot.width) ** 2))
    knots = {f"{way}_{i}": level for way in ("positive", "negative") for i, level in enumerate(levels.tolist())}
    (simple,) = FrictionMap(**knots, low=0.0, high=0.4).simplified(HUNG)
    assert isinstance(simple, PositionFriction)
    assert (simple.level, simple.centre, simple.width) == pytest.approx((2.0, 0.1, 0.06), rel=0.1)


def test_friction_map_is_parted_into_friction_and_a_spring():
    places = np.linspace(-0.1, 0.2, 5)
    levels = {f"positive_{i}": 2.0 + 6.0 * y for i, y in enumerate(places)}
    levels |= {f"negative_{i}": 2.0 - 6.0 * y for i, y in enumerate(places)}
    plant = Plant(gain=2.0, damping=4.0, effects=(Delay(time=1e-3), FrictionMap(**levels, low=-0.1, high=0.2)))
    whole, other = parted(plant)
    assert {effect.name for effect in whole.effects} == {"delay", "coulomb_friction", "return_spring"}
    assert {effect.name for effect in other.effects} == {"coulomb_friction", "return_spring"}
    assert other.effect("coulomb_friction").level == pytest.approx(2.0)
    assert other.effect("return_spring").stiffness == pytest.approx(6.0)
    assert not FrictionMap(**dict.fromkeys(levels, 0.3), low=-0.1, high=0.2).parts()  # no spring in it
    narrow = FrictionMap(**levels, low=0.1, high=float(np.nextafter(0.1, 1.0)))  # stiffer than any spring
    assert not [*parted(replace(plant, effects=(narrow,)))]


@pytest.mark.slow
def test_spring_with_friction_and_a_lag_is_no_friction_map_beside_shaking():
    """A friction map takes up spring and friction both, and a shaken axis what it does not."""
    hidden = {"return_spring": {"stiffness": 6.0}, "sensor_lag": {"time_constant": 6e-3}}
    axis = lab.Truth(gain=2.0, damping=4.0, effects=hidden | {"coulomb_friction": {"level": 0.3}})
    runs = ((100.0, 4.0, (0.1,)), (160.0, 6.0, (0.1, -0.1)), (220.0, 9.0, (0.15,)), (190.0, 8.0, (0.12,)))
    records = [
        lab.step_record(
            axis, kp, kd, reference=levels, duration=1.8 / len(levels), noise=1.9e-6, encoder=0.0, seed=100 + i,
            setup=lab.Setup(rest=0.2),
        )
        for i, (kp, kd, levels) in enumerate(runs)
    ]  # fmt: skip
    found = diagnose(records[:3], heldout=records[3:])
    assert (found.verdict, {cause.effect for cause in found.causes}) == ("explained", {*hidden, "coulomb_friction"})
    assert found.remainder.rms < 2e-6


def test_what_was_found_as_if_nothing_shook_the_axis_is_tried_beside_both_noises():
    still = Hypothesis(Plant(gain=1.0, damping=1.0), NoiseModel.white(1e-6), (), 0.0, 0.0, unpowered=False, local={})
    shaken = replace(still, noise=replace(still.noise, rate=30.0))
    tried = [h.noise.rate for h in beside_shaking([still, shaken], shaken.noise)]
    assert tried == [0.0, 30.0, 30.0]
    assert [*beside_shaking([still], still.noise)] == [still]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_two_causes_whose_true_pair_is_not_the_likeliest_beside_an_observer_are_found(seed):
    """Beside slow noise an axis seems shaken, and of what an observer helps an impostor is likelier."""
    around = lab.Surroundings(noise=lab.SensorNoise(deviation=2e-5, autoregression=(0.9,)), encoder=0.0)
    truth = lab.Truth(gain=15.0, damping=4.0, effects={"coulomb_friction": {"level": 0.6}, "dead_zone": {"width": 0.3}})
    setup, runs = lab.Setup(surroundings=around), ((60.0, 2.0, (0.05, 0.0)), (90.0, 3.0, (0.08, 0.02)))
    records = [
        lab.step_record(truth, kp, kd, reference=levels, duration=1.2, seed=100 * seed + i, setup=setup)
        for i, (kp, kd, levels) in enumerate(runs)
    ]
    found = diagnose(records)
    assert found.verdict == "explained"
    assert {cause.effect for cause in found.causes} == {"coulomb_friction", "dead_zone"}


@pytest.mark.parametrize(
    ("effect", "world", "seed", "work"),
    [("position_friction", "coloured", 721_205, 18e6), ("periodic_disturbance", "white", 721_206, 11e6)],
)
def test_a_single_cause_that_leaves_noise_alone_ends_the_search(effect, world, seed, work):
    """Neither beside an observer nor from an impostor that has fewer parameters is anything looked for."""
    campaign, effort = lab.hidden_campaign(seed, effects=[effect], world=world), EFFORT["normal"]
    case = Case(tuple(campaign.records), tuple(campaign.heldout), {}, len(catalogue()))
    found = search(case.trials, case.base, effort, is_enough=case.is_enough)
    assert found.chosen.causes == (effect,)
    assert case.likelihood.work < work


@pytest.mark.slow
def test_cause_beside_slow_noise_is_compared_with_fewer_causes_beside_shaking():
    """A wave took up what shakes the axis, as long as it was asked only whether both causes are likelier shaken."""
    campaign = lab.hidden_campaign(902377, effects=["sensor_lag"], world="shaken")
    verdict, causes = causes_of(campaign)
    assert verdict == "explained"
    assert causes in ({"sensor_lag"}, {"actuator_lag"})  # on a linear axis they are the same


@pytest.mark.slow
def test_cause_whose_size_may_as_well_be_nothing_is_left_out():
    """Beside it the likelihood was higher for another optimum of the gap."""
    campaign = lab.hidden_campaign(900377, effects=["backlash"], world="shaken")
    assert causes_of(campaign) == ("explained", {"backlash"})


@pytest.mark.parametrize(("frequency", "is_softer"), [(None, False), (60.0, True)])
def test_a_contact_is_freed_where_its_score_promises_something(frequency, is_softer):
    play = {"gap": 0.003, "load_share": 0.4} | ({"contact_frequency": frequency} if frequency else {})
    axis = lab.Truth(gain=1.9, damping=6.0, effects={"backlash": play})
    runs = [lab.step_record(axis, kp, noise=1e-5, seed=kp + 1, sample_time=2e-3) for kp in (40, 80)]
    likelihood = Trials(tuple(runs), {}, len(catalogue())).unshaken().likelihood
    start = Plant(gain=1.9, damping=6.0, effects=(Backlash(gap=0.003, load_share=0.4),))
    found = likelihood.judged(start)
    assert bool(promising(likelihood, found, [*found.plant.freed()], 0.5)) == is_softer
