"""The recommended gain, run on the laboratory's own axes; its probability, against closed forms; the lights."""

from __future__ import annotations

import re
from dataclasses import replace
from math import sqrt

import numpy as np
import pytest

from servolens import Controller, lab, simulate_loop
from servolens.design import Design, PDSpec, compare, evaluate, recommend, settling_time, trust, tune
from servolens.design.scenarios import UnexplainedForce, drawn, missed_share
from servolens.effects import (
    ConstantForce,
    CoulombFriction,
    DeadZone,
    Delay,
    LoadFriction,
    PeriodicDisturbance,
    ReturnSpring,
    Saturation,
    VelocityDecayDamping,
)
from servolens.errors import InputError
from servolens.model import Model
from servolens.model_evidence import DataRange, Evidence, Missed, Remainder
from servolens.plant import Plant

NLM3 = Plant(gain=1.91, damping=3.799, effects=(VelocityDecayDamping(alpha1=15.2528, alpha2=5.9934),))
SPEC = PDSpec(kp=100.0, settling_time=0.5)
SHOWN = DataRange(voltage=10.0, speed=1.0, step=0.1)


def uncertain(plant, share, **fields):
    """Return a model each of whose parameters has a standard error of `share` of its value."""
    return Model(plant=plant, covariance=np.diag((share * np.array(plant.values)) ** 2), **fields)


def leaving(acceleration, correlation_time=0.05, **fields):
    left = {"rms": 1e-4, "times_noise": 3.0, "of_travel": 1e-3, "of_motor": 0.01, "depends_on_inputs": True}
    left |= {"material": False, **fields}
    return Remainder(acceleration_rms=acceleration, correlation_time=correlation_time, **left)


def on_the_bench(truth, spec, kd):
    """Return settling time and overshoot of the step and of the step back, on the laboratory's axis."""
    lasts = 6.0 * spec.settling_time
    levels = (spec.reference, 0.0)
    run = lab.step_record(
        truth, spec.kp, kd, reference=levels, duration=lasts, sample_time=spec.sample_time, encoder=0.0
    )
    error = (run.reference - run.position) / spec.reference
    half = len(run) // 2
    return [
        (settling_time(run.time[part], sign * error[part], spec.band), -float(np.min(sign * error[part])))
        for part, sign in ((slice(0, half), 1.0), (slice(half, None), -1.0))
    ]


@pytest.fixture(scope="module")
def least():
    return tune(NLM3, SPEC)


def test_recommended_gain_of_the_papers_cart_is_in_the_middle_of_the_second_interval(least):
    found = recommend(uncertain(NLM3, 0.01), least).recommended
    low, high = least.intervals[1]
    assert low < found.kd < high
    assert found.kd == pytest.approx(np.sqrt(low * high), rel=0.02)
    assert 0.26 < found.settling_time < 0.30
    assert found.overshoot < 0.005
    assert found.probability == 1.0
    for settled, overshoot in on_the_bench(lab.NLM3, SPEC, found.kd):
        assert settled == pytest.approx(found.settling_time, abs=0.01)
        assert overshoot < 0.01


def test_risk_of_the_least_gain_is_that_of_the_laboratory(least):
    """Half of the axes near the cart's miss the spec with it: on the bench, one whose gain is a percent larger."""
    found = recommend(NLM3, least).recommended
    share = float(found.risk.partition("meets the spec in ")[2].partition(" %")[0])
    assert 30.0 < share < 70.0
    heavier = lab.Truth(gain=1.01 * lab.NLM3.gain, damping=lab.NLM3.damping, effects=lab.NLM3.effects)
    settled = on_the_bench(heavier, SPEC, least.kd)[0][0]
    assert settled is None or settled > SPEC.settling_time


HIDDEN = {
    "coulomb_friction": {"level": 0.05},
    "asymmetric_friction": {"level_positive": 0.02, "level_negative": 0.08},
    "stribeck_friction": {"level": 0.04, "static_excess": 0.03, "stribeck_speed": 0.02},
    "velocity_decay_damping": {"alpha1": 10.0, "alpha2": 5.0},
    "asymmetric_damping": {"damping_difference": 3.0},
    "quadratic_drag": {"drag": 4.0},
    "return_spring": {"stiffness": 1.0},
    "constant_force": {"acceleration": 0.1},
    "cogging": {"amplitude": 0.1, "pitch": 0.02, "phase": 0.5},
    "dead_zone": {"width": 0.05},
    "delay": {"time": 0.004},
    "actuator_lag": {"time_constant": 0.006},
    "sensor_lag": {"time_constant": 0.004},
    "force_limit": {"acceleration": 12.0},
    "backlash": {"gap": 2e-4, "load_share": 0.3},
    "flexible_coupling": {"frequency": 30.0, "damping_ratio": 0.03, "load_ratio": 0.3},
}


@pytest.mark.parametrize("name", HIDDEN)
def test_gain_recommended_on_an_estimate_meets_the_spec_on_the_true_axis(name):
    """The estimate is as wrong as it says it is: each parameter is off by a draw from its own standard error."""
    truth = lab.Truth(gain=1.9, damping=6.0, effects={name: HIDDEN[name]})
    exact = Plant(gain=1.9, damping=6.0, effects=(Plant.effect_from(name, HIDDEN[name]),))
    random = np.random.default_rng([1, list(HIDDEN).index(name)])
    off = np.array(exact.values) * (1.0 + 0.02 * random.standard_normal(len(exact.values)))
    model = uncertain(exact.with_values([float(v) for v in off]), 0.02)
    spec = PDSpec(kp=100.0, settling_time=0.5, band=0.02)
    design = recommend(model, tune(model.plant, spec))
    assert design.recommended.probability > 0.9
    for settled, overshoot in on_the_bench(truth, spec, design.recommended.kd):
        assert settled is not None
        assert settled < spec.settling_time
        assert overshoot < 0.06  # 5 % is kept by nine plants of ten, this one is off by up to 5 %


def test_limit_of_the_overshoot_does_not_drive_the_gain_to_where_the_spec_breaks():
    """A resonance that a large gain sets swinging: gains with little overshoot lie just before it."""
    coupled = {"flexible_coupling": HIDDEN["flexible_coupling"]}
    plant = Plant(gain=1.9, damping=6.0, effects=(Plant.effect_from("flexible_coupling", HIDDEN["flexible_coupling"]),))
    spec = PDSpec(kp=100.0, settling_time=0.5, band=0.02)
    model = uncertain(plant, 0.02)
    design = recommend(model, tune(plant, spec))
    found = design.recommended
    assert found.kd < 0.95 * design.intervals[0][1]
    assert found.probability > 0.9
    for share in (0.98, 1.0, 1.02):
        stiffer = {name: {**values, "frequency": share * values["frequency"]} for name, values in coupled.items()}
        truth = lab.Truth(gain=1.9, damping=6.0, effects=stiffer)
        assert all(settled < spec.settling_time for settled, _ in on_the_bench(truth, spec, found.kd))


def linear_share(model, spec, kd, count, random):
    """Return how many of the plants that `model` allows settle in time, by the closed form of the continuous loop."""
    time = np.arange(0.0, 10.0 * spec.settling_time, 5e-3)
    values = random.multivariate_normal(model.plant.values, model.covariance, count)
    realised = random.uniform(0.98, 1.02, count)
    met = 0
    for (gain, damping), share in zip(values, realised, strict=True):
        first, second = np.roots([1.0, damping + gain * share * kd, gain * share * spec.kp]).astype(complex)
        error = np.real((second * np.exp(first * time) - first * np.exp(second * time)) / (second - first))
        met += np.all(np.abs(error[time >= spec.settling_time]) <= spec.band)
    return met / count


def test_interval_of_the_probability_covers():
    """A plant that is known to 15 %: how many of its like settle is known from a closed form."""
    plant = Plant(gain=1.9, damping=6.0)
    model = uncertain(plant, 0.15)
    spec = PDSpec(kp=100.0, settling_time=0.38, band=0.02, control="continuous", sample_time=5e-3)
    design = tune(plant, spec)
    found = [recommend(model, design, scenarios=60, seed=seed).recommended for seed in range(20)]
    random = np.random.default_rng(5)
    shares = {one.kd: linear_share(model, spec, one.kd, 1000, random) for one in found}
    assert 0.3 < np.median(list(shares.values())) < 0.98
    covered = sum(one.interval[0] <= shares[one.kd] <= one.interval[1] for one in found)
    assert covered >= 17  # of 20 at 95 % or more: fewer happens in 1.6 % of all such studies


def test_what_chooses_the_gain_does_not_tell_how_it_does():
    """With the same draws for both, the share of the chosen gain would be the best of all, not its own."""
    known = [uncertain(NLM3, 0.1)]
    two = [drawn(known, [SPEC], 40, np.random.default_rng([0, which])) for which in (0, 1)]
    values = [{scenario.plant.values for scenario in scenarios} for scenarios in two]
    assert len(values[0] | values[1]) == 80


def test_scenarios_hold_models_sizes_and_directions_alike():
    models = [uncertain(NLM3, 0.01), Model(plant=Plant(gain=2.0, damping=6.0))]
    found = drawn(models, [SPEC, replace(SPEC, reference=0.05)], 40, np.random.default_rng(0))
    kinds = [(len(one.plant.effects), one.spec.reference, one.back) for one in found]
    assert {kinds.count(kind) for kind in set(kinds)} == {5}
    assert len(set(kinds)) == 8
    assert all(0.98 <= one.realised <= 1.02 for one in found)
    assert np.ptp([one.realised for one in found]) > 0.03


def test_parameters_stay_within_their_bounds_and_without_an_error_they_are_held():
    rubbing = Plant(gain=1.9, damping=6.0, effects=(CoulombFriction(level=0.01),))
    covariance = np.diag([np.nan, 0.25, 1.0])
    found = drawn([Model(plant=rubbing, covariance=covariance)], [SPEC], 200, np.random.default_rng(0))
    levels, dampings = (np.array([one.plant.values[i] for one in found]) for i in (2, 1))
    assert levels.min() == 0.0
    assert levels.max() > 1.0
    assert np.std(dampings) == pytest.approx(0.5, rel=0.2)
    assert {one.plant.gain for one in found} == {1.9}


def test_swing_of_a_machine_nearby_does_not_know_when_a_step_begins():
    shaken = Plant(gain=1.9, damping=6.0, effects=(PeriodicDisturbance(amplitude=0.1, frequency=3.0, phase=0.0),))
    found = drawn([Model(plant=shaken)], [SPEC], 100, np.random.default_rng(0))
    phases = np.array([one.plant.effects[0].phase for one in found])
    assert abs(np.mean(np.exp(1j * phases))) < 0.3


def test_unexplained_force_has_the_size_and_the_correlation_it_is_asked_for():
    random = np.random.default_rng(0)
    forces = [UnexplainedForce.draw(0.3, 0.05, random) for _ in range(4000)]
    now, later = (
        np.array([float(force.physics(axis, force)) for force in forces])
        for axis in (type("Axis", (), {"time": t}) for t in (0.2, 0.25))
    )
    assert np.sqrt(np.mean(now**2)) == pytest.approx(0.3, rel=0.05)
    assert np.mean(now * later) / np.mean(now**2) == pytest.approx(np.exp(-0.5), abs=0.05)


def test_overshoot_that_no_gain_keeps_is_hardly_more_than_the_least_and_is_told():
    spec = replace(SPEC, kd_max=4.9)  # the first interval alone, of loops that swing
    design = recommend(uncertain(NLM3, 0.001), tune(NLM3, spec))
    found, (low, high) = design.recommended, design.intervals[0]
    assert "no gain that is as safe keeps the overshoot below 5 %" in found.why
    assert f"{100 * found.overshoot:.3g} %" in found.why
    overshoots = [on_the_bench(lab.NLM3, SPEC, kd)[0][1] for kd in (low, high, found.kd)]
    assert overshoots[2] < min(overshoots[:2]) + 0.055
    assert found.overshoot == pytest.approx(overshoots[2], abs=0.005)
    assert low + 0.2 * (high - low) < found.kd < high - 0.2 * (high - low)
    free = recommend(uncertain(NLM3, 0.001), tune(NLM3, spec), overshoot=None).recommended
    assert "overshoot" not in free.why


def test_design_that_finds_no_gain_recommends_none():
    design = tune(NLM3, replace(SPEC, settling_time=0.05))
    assert recommend(NLM3, design) is design


def test_recommending_needs_a_model_and_a_scenario(least):
    with pytest.raises(InputError, match="no model was given; at least one is needed"):
        recommend([], least)
    with pytest.raises(InputError, match="scenarios must be a whole number of at least 1, got int 0"):
        recommend(NLM3, least, scenarios=0)


def lights(design, evidence):
    model = Model(plant=NLM3, evidence=evidence)
    return trust(model, recommend(model, design, scenarios=60))


def test_unexplained_but_immaterial_tunes_well(least):
    known = Evidence(range=SHOWN, verdict="unexplained", remainder=leaving(0.01), heldout_of_step=0.001)
    of_model, of_gain = lights(least, known)
    assert (of_model.light, of_gain.light) == ("green", "green")
    assert of_model.sentence.startswith("Unexplained, but what is left is immaterial: ")


def test_material_remainder_is_carried_by_the_scenarios(least):
    """What is left need not act as the random force of the scenarios, in which all of 200 plants may meet the spec."""
    known = Evidence(range=SHOWN, verdict="explained", remainder=leaving(0.01, material=True), heldout_of_step=0.001)
    of_model, of_gain = lights(least, known)
    assert (of_model.light, of_gain.light) == ("amber", "amber")
    assert of_gain.sentence.endswith(
        "can be tried as a random force only; on the axis it may act otherwise: confirm the gain there."
    )


def test_material_shaking_is_the_random_force_that_the_scenarios_try(least):
    shaken = replace(leaving(0.01, material=True), depends_on_inputs=False)
    known = Evidence(range=SHOWN, verdict="explained", remainder=shaken, heldout_of_step=0.001)
    assert lights(least, known)[1].light == "green"
    for other in (replace(known, verdict="partly_explained"), replace(known, remainder=replace(shaken, heldout=True))):
        assert lights(least, other)[1].light == "amber"


def test_remainder_that_breaks_the_spec_turns_the_gain_red(least):
    """A slow force of A moves the axis by A/(gain kp): three times the band, for r.m.s."""
    force = 3.0 * SPEC.band * SPEC.reference * NLM3.gain * SPEC.kp
    known = Evidence(range=SHOWN, remainder=leaving(force, 0.5, material=True), heldout_of_step=0.01)
    of_model, of_gain = lights(least, known)
    assert (of_model.light, of_gain.light) == ("amber", "red")
    assert "nine of ten" in of_gain.sentence


def test_what_an_immaterial_remainder_owes_to_the_inputs_is_no_force_that_goes_on(least):
    force = 3.0 * SPEC.band * SPEC.reference * NLM3.gain * SPEC.kp
    left = replace(leaving(force, 0.5), depends_on_inputs=True)
    _, of_gain = lights(least, Evidence(range=SHOWN, remainder=left, heldout_of_step=0.001))
    assert of_gain.light == "green"
    shaken = replace(left, depends_on_inputs=False)
    _, of_gain = lights(least, Evidence(range=SHOWN, remainder=shaken, heldout_of_step=0.001))
    assert of_gain.light == "red"


def test_immaterial_remainder_that_the_inputs_make_leaves_less_of_the_band(least):
    left = replace(leaving(1.0, 0.5), of_travel=0.004)
    known = Model(plant=NLM3, evidence=Evidence(range=SHOWN, remainder=left, heldout_of_step=0.004))
    assert missed_share(known) == pytest.approx(sqrt(3.0) * 0.004)
    scenarios = drawn([known], [SPEC], 400, np.random.default_rng(7))
    missed = np.array([SPEC.band - scenario.spec.band for scenario in scenarios])
    assert missed.min() >= 0.0
    assert missed.max() <= sqrt(3.0) * left.of_travel
    assert np.sqrt(np.mean(missed**2)) == pytest.approx(left.of_travel, rel=0.05)
    assert all(scenario.plant.effects == NLM3.effects for scenario in scenarios)
    other = replace(SPEC, kp=SPEC.kp / 2.0)
    assert scenarios[0].in_loop(other).spec.band == scenarios[0].spec.band
    shaken = replace(known, evidence=replace(known.evidence, remainder=replace(left, depends_on_inputs=False)))
    assert {one.spec.band for one in drawn([shaken], [SPEC], 20, np.random.default_rng(7))} == {SPEC.band}


def test_gain_is_withheld_where_an_immaterial_remainder_may_break_the_band(least):
    """In 71 % of the plants as much as the whole band is missed: 1 − 1/(2√3)."""
    left = replace(leaving(1.0, 0.5), of_travel=2.0 * SPEC.band)
    _, of_gain = lights(least, Evidence(range=SHOWN, remainder=left, heldout_of_step=0.001))
    assert of_gain.light == "red"
    assert (
        ", as simulations may miss up to 3.5 % of the step in a band of 1 %; most of those that miss it settle late"
        in (of_gain.sentence)
    )


def test_one_further_step_is_a_number(least):
    known = Model(plant=NLM3)
    one, listed = (recommend(known, least, scenarios=4, references=r).recommended for r in (0.02, [0.02]))
    assert one == listed
    for wrong in (None, "0.02"):
        with pytest.raises(InputError, match=r"references \(sizes of steps\) must (hold numbers alone|be finite)"):
            recommend(known, least, references=wrong)


def test_gain_with_the_least_overshoot_stands_its_own_tolerance():
    """Overshoot falls towards the end of the interval: 1.5 % before it the least was taken."""
    rubbing = Plant(gain=0.0102, damping=1.984, effects=(LoadFriction(share=0.115),), command_unit="A")
    spec = PDSpec(
        kp=2180.0, settling_time=1.595, band=0.05, reference=1.0, sample_time=0.002, derivative_filter=0.14, ki=1776.0
    )
    chosen = recommend(rubbing, tune(rubbing, spec), scenarios=20).recommended
    assert "no gain that is as safe keeps the overshoot below 5 %" in chosen.why
    assert all(evaluate(rubbing, spec, share * chosen.kd).meets for share in (0.98, 1.02))


def peak_between_samples(axis, run):
    """Return the peak of the exact motion under a held voltage, v(t) = βV/c + (v₀ − βV/c) exp(−ct), at 100 instants."""
    force = axis.gain * run.voltage[:, None] / axis.damping
    after = np.linspace(0.0, run.time[1], 100)
    way = force * after + (run.velocity[:, None] - force) * (1.0 - np.exp(-axis.damping * after)) / axis.damping
    return (run.position[:, None] + way).max()


def test_axis_that_breaks_the_spec_between_samples_makes_the_gain_amber():
    """Held against the exact motion."""
    gain, damping, step = 1.9, 1.0, 0.1
    spec = PDSpec(kp=20.0, settling_time=1.0, band=0.05, overshoot=0.03, sample_time=0.1)
    axis = Plant(gain=gain, damping=damping)
    design = recommend(axis, tune(axis, spec), scenarios=40)
    run = design.step()
    peak = peak_between_samples(axis, run) / step - 1.0
    assert design.recommended.overshoot < 0.03 < peak
    light = trust(axis, design)[1]
    assert light.light == "amber"
    assert "Between the samples of its loop, 100 ms apart, the axis does not keep the spec" in light.sentence
    assert evaluate(axis, spec, design.recommended.kd, parts=8).overshoot == pytest.approx(peak, abs=2e-3)
    quick = replace(spec, sample_time=1e-3)
    assert trust(axis, recommend(axis, tune(axis, quick), scenarios=40))[1].light == "green"


def test_gain_is_taken_with_which_the_axis_keeps_the_spec_between_samples_too():
    """Of the gains that keep the overshoot at the samples, 5.5 to 7.4, those above 6.5 exceed it between them."""
    axis = Plant(gain=1.9, damping=2.72)
    spec = PDSpec(kp=25.0, settling_time=2.0, band=0.02, overshoot=0.02, sample_time=0.1)
    design = recommend(axis, tune(axis, spec), scenarios=40)
    chosen, peak = design.recommended, peak_between_samples(axis, design.step())
    assert peak < 1.02 * spec.reference
    assert chosen.overshoot == pytest.approx(peak / spec.reference - 1.0, abs=1e-3)
    assert chosen.probability >= 0.9
    assert trust(axis, design)[1].light == "green"


def test_rounding_does_not_take_the_gain_out_of_where_it_is_safe():
    """Within ±2 % the gains may be 4.18 and up, and 4.183 was written as 4.18: it failed in a tenth of all plants."""
    plant, spec = Plant(gain=1.9, damping=6.0), PDSpec(kp=37.4995, settling_time=0.5, band=0.01)
    design = recommend(plant, tune(plant, spec))
    least, most = design.intervals[0]
    assert most - least < 0.05
    assert design.recommended.probability > 0.98
    assert len(f"{design.recommended.kd:g}") == len("4.183")


def test_of_gains_with_which_some_plants_run_away_one_of_the_safest_is_chosen():
    """With each gain some plant was unstable, and the first gain at hand was taken: infinite overshoots are equal."""
    late = Plant(gain=1.9, damping=6.0, effects=(Delay(time=0.0077),))
    known = Model(plant=late, covariance=np.diag(np.square([1.0, 4.4, 0.0074])))
    spec = PDSpec(kp=1000.0, settling_time=0.98, band=0.02, sample_time=2e-3)
    design = recommend(known, tune(late, spec), scenarios=100)
    chosen = design.recommended
    assert not chosen.worst.stable
    assert 1.5 * design.kd < chosen.kd < 0.5 * design.intervals[-1][1]
    assert "(the worst runs away)" in chosen.risk
    tried = drawn([known], [spec], 100, np.random.default_rng(5))
    share = [np.mean([one.response(kd).meets for one in tried]) for kd in (design.kd, chosen.kd)]
    assert share[1] > share[0] + 0.2
    assert trust(known, design)[1].light == "red"


def test_steps_that_miss_the_spec_are_named_and_no_force_where_none_is_tried():
    """Weight and spring are in balance at the reference; at 0 the weight alone leaves 4.4 % of the step."""
    weight = Plant(gain=1.9, damping=6.0, effects=(ConstantForce(acceleration=-0.5), ReturnSpring(stiffness=5.0)))
    spec = PDSpec(kp=60.0, settling_time=0.6, band=0.02)
    design = recommend(weight, tune(weight, spec), scenarios=40)
    assert design.recommended.probability < 0.9
    assert design.recommended.hardest == "0 % of the steps back"
    sentence = trust(Model(plant=weight), design)[1].sentence
    told = r" % of 40, and in 0 % of the steps back; most of those that miss it end up to 4\.[2-5] % of the step off"
    assert re.search(told, sentence)
    assert sentence.endswith("a larger kp, an integral gain (ki) or a wider band helps.")


def test_model_and_size_whose_steps_miss_the_spec_are_named():
    """A force holds one of two models off its reference; the larger of two sizes needs more voltage than there is."""
    free, held = Plant(gain=1.9, damping=6.0), Plant(gain=1.9, damping=6.0, effects=(ConstantForce(acceleration=5.0),))
    spec = PDSpec(kp=60.0, settling_time=0.6)
    design = replace(tune(free, spec), plants=(free, held))
    assert recommend([free, held], design, scenarios=40).recommended.hardest == "0 % of the steps of model 2"
    weak = Plant(gain=1.9, damping=6.0, effects=(Saturation(limit=7.0),))
    assert (
        recommend(weak, tune(weak, spec), scenarios=40, references=2.0).recommended.hardest == "0 % of the steps of 2 m"
    )


def test_held_out_error_beyond_the_band_is_a_doubt(least):
    known = Evidence(range=SHOWN, verdict="unexplained", remainder=leaving(0.01), heldout_of_step=0.029)
    of_model, of_gain = lights(least, known)
    assert (of_model.light, of_gain.light) == ("amber", "amber")
    assert "2.9 %" in of_gain.sentence


def missing(how, rms, step):
    """Return the evidence of a model that misses so much of one record that it was not fitted to."""
    missed = (
        Missed(record="run 2", how=how, rms=rms, step=step),
        Missed(record="run 1", how=how, rms=1e-6, step=0.1),
    )
    worst = max(one.of_step for one in missed)
    return Evidence(range=SHOWN, remainder=leaving(0.01), heldout_of_step=worst, missed=missed)


@pytest.mark.parametrize(
    ("how", "who"),
    [
        pytest.param("held_out", "record run 2, which took no part in the fit", id="held out"),
        pytest.param("left_out", "record run 2, as predicted by a fit to the other records", id="left out"),
        pytest.param("end", "the end of run 2, as predicted by a fit without it", id="end"),
    ],
)
def test_error_where_a_record_was_not_fitted_is_told_as_what_it_is(least, how, who):
    """Whoever held a record out, or had each left out in turn, was told to fit it too: then nothing would be tested."""
    of_model, of_gain = lights(least, missing(how, 0.0029, 0.1))
    assert of_model.light == of_gain.light == "amber"
    assert of_model.sentence.endswith(f" but 2.9 % of the step of 100 mm of {who}: of another run it may miss as much.")
    assert of_gain.sentence == (
        f"{who[0].upper()}{who[1:]}, is missed by 2.9 mm (r.m.s.), 2.9 % of its step of 100 mm, more than the band of"
        " 1 %: when the axis settles is not certain."
    )
    assert lights(least, missing(how, 1e-4, 0.1))[0].light == "green"


@pytest.mark.parametrize(("rms", "light"), [(0.0009, "green"), (0.0011, "amber")])
def test_error_of_a_small_move_is_held_against_the_step_asked_for(least, rms, light):
    """A slow move of 40 mm was missed by 2.5 % of itself, which was held against 1 % of a step of 120 mm."""
    assert SPEC.reference == 0.1
    of_model, of_gain = lights(least, missing("left_out", rms, 0.04))
    assert of_gain.light == light
    assert f"{100 * rms / 0.04:.2g} % of the step of 40 mm" in of_model.sentence
    assert ("1.1 % of the step asked for, more than the band" in of_gain.sentence) == (light == "amber")


def test_model_that_misses_nothing_does_not_miss_0_percent(least):
    exact = {**{name: getattr(leaving(0.0), name) for name in Remainder.__slots__}, "rms": 0.0, "of_travel": 0.0}
    of_model, _ = lights(least, Evidence(range=SHOWN, verdict="healthy", remainder=Remainder(**exact)))
    assert of_model.sentence == "Healthy: the simulation misses nothing beyond the noise."


AGAINST = {
    "fatal finding": {"fatal": ("kp60: its voltage has the wrong sign.",)},
    "held-out error": {"heldout_of_step": 0.06},
}


@pytest.mark.parametrize("fields", AGAINST.values(), ids=AGAINST)
def test_model_that_is_known_to_be_wrong_gives_no_gain(least, fields):
    of_model, of_gain = lights(least, Evidence(range=SHOWN, remainder=leaving(0.01), **fields))
    assert (of_model.light, of_gain.light) == ("red", "red")


@pytest.mark.parametrize("quantity", ["voltage", "speed", "step"])
@pytest.mark.parametrize(("times", "light"), [(1.0, "green"), (1.4, "amber"), (1.6, "red")])
def test_answer_beyond_the_records_is_amber_and_then_red(least, quantity, times, light):
    design = recommend(NLM3, least, scenarios=60)
    reached = reached_with(design.recommended.kd)
    shown = DataRange(**{**reached, quantity: reached[quantity] / times})
    model = Model(plant=NLM3, evidence=Evidence(range=shown, remainder=leaving(0.01), heldout_of_step=0.001))
    of_gain = trust(model, design)[1]
    assert of_gain.light == light
    assert (quantity in of_gain.sentence) == (light != "green")


NOISY = [
    (1.0, 0.2, "green"),
    (1.04, 0.03, "amber"),
    (1.04, 0.2, "amber"),
    (1.5, 0.0, "amber"),
    (1.525, 0.0, "red"),
    (1.525, 0.01, "amber"),
    (1.56, 0.03, "red"),
    (2.25, 0.5, "red"),
]


@pytest.mark.parametrize("quantity", ["voltage", "speed", "step"])
@pytest.mark.parametrize(("times", "of_known", "light"), NOISY)
def test_noise_alone_gives_no_red_and_admits_nothing_more(least, quantity, times, of_known, light):
    """The noisier the records were, the farther beyond them a gain was given."""
    design = recommend(NLM3, least, scenarios=60)
    reached = reached_with(design.recommended.kd)
    known = reached[quantity] / times
    shown = DataRange(**{**reached, quantity: known, f"{quantity}_error": of_known * known})
    model = Model(plant=NLM3, evidence=Evidence(range=shown, remainder=leaving(0.01), heldout_of_step=0.001))
    of_gain = trust(model, design)[1]
    assert of_gain.light == light
    assert ("by noise" in of_gain.sentence) == (light == "amber" and times > 1.5)


def test_plant_that_never_settles_is_a_doubt_even_if_it_is_one_of_many(least):
    design = recommend(NLM3, least, scenarios=60)
    never = replace(design.recommended.worst, settling_time=None)
    doubtful = replace(design, recommended=replace(design.recommended, worst=never))
    of_gain = trust(NLM3, doubtful)[1]
    assert of_gain.light == "amber"
    assert "does not settle at all" in of_gain.sentence


def reached_with(kd):
    run = lab.step_record(lab.NLM3, SPEC.kp, kd, encoder=0.0)
    speed = float(np.abs(np.gradient(run.position, run.time)).max())
    return {"voltage": float(np.abs(run.voltage).max()), "speed": speed, "step": 0.1}


def test_recommended_gain_keeps_to_what_the_records_showed(least):
    """A larger kd is slower: of the gains that meet the spec, those are left that no record has to be exceeded for."""
    free = recommend(NLM3, least, scenarios=60).recommended.kd
    slower = reached_with(0.5 * (free + least.intervals[-1][1]))["speed"]
    shown = DataRange(**{**reached_with(free), "speed": slower})
    model = Model(plant=NLM3, evidence=Evidence(range=shown, remainder=leaving(0.01), heldout_of_step=0.001))
    kept = recommend(model, least, scenarios=60).recommended.kd
    assert kept > free
    assert reached_with(kept)["speed"] <= 1.011 * slower < reached_with(free)["speed"]


def test_nothing_is_known_of_a_plant_alone(least):
    of_model, of_gain = trust(NLM3, recommend(NLM3, least))
    assert (of_model.light, of_gain.light) == ("amber", "green")
    assert "Nothing is known" in of_model.sentence


def test_design_that_finds_no_gain_is_red():
    design = tune(NLM3, replace(SPEC, settling_time=0.05))
    assert trust(NLM3, design)[1].light == "red"


def test_withheld_design_keeps_its_intervals_alone(least):
    withheld = recommend(NLM3, least, scenarios=1).withhold("The model is wrong.")
    assert withheld.withheld
    assert withheld.feasible
    body = withheld.to_json()
    assert (body["kd"], body["recommended"], body["gains"]["kd"]) == (None, None, None)
    assert body["intervals"] == [list(interval) for interval in least.intervals]
    assert body["reason"] == "The model is wrong."


def test_file_says_why_nothing_is_recommended_or_tracked_and_is_read_without_that(least):
    told = least.to_json()
    assert told["recommended"] is told["tracking"] is None
    assert told["reason"] == "recommended: only the least gain was sought; tracking: only the least gain was sought"
    assert Design.from_json(told).reason is None
    ideal = tune(NLM3, replace(SPEC, control="continuous"))
    told = recommend(NLM3, ideal, scenarios=1).to_json()
    assert told["reason"] == "tracking: feedforward is simulated in loops that are sampled only"
    assert Design.from_json(told).to_json() == told


def test_comparison_without_causes_says_so():
    plain = Plant(gain=1.9, damping=6.0)
    told = compare(plain, NLM3, SPEC).to_json()
    assert told["diagnosed"] is told["linear"]["on_diagnosed"] is None
    assert told["reason"] == "diagnosed: there is no model with causes"
    assert told["linear"]["reason"].endswith("; on_diagnosed: there is no model with causes")


def test_gain_that_the_sensors_noise_spoils_is_not_recommended():
    """In a dead zone the axis coasts to a stop: how far is luck where the derivative of the noise drives it."""
    coasting = Plant(gain=5.0, damping=2.5, effects=(DeadZone(width=0.4),))
    spec = PDSpec(kp=30.0, settling_time=2.1, reference=0.2, sample_time=2e-3)
    noisy = Evidence(range=DataRange(voltage=10.0, speed=1.0, step=0.2), noise=2e-5)
    found = tune(coasting, spec)
    kds = [recommend(Model(plant=coasting, evidence=e), found).recommended.kd for e in (None, noisy)]

    def settles(kd):
        time = spec.sample_time * np.arange(4000)
        errors = 2e-5 * np.random.default_rng(3).standard_normal((20, time.size))
        runs = [
            simulate_loop(coasting, Controller(kp=30.0, kd=kd), time, np.full(time.size, 0.2), sensor_error=error)
            for error in errors
        ]
        left = [np.abs(run.position[time >= spec.settling_time] / 0.2 - 1.0).max() for run in runs]
        return sum(one <= spec.band for one in left)

    assert settles(kds[0]) < 16
    assert settles(kds[1]) == 20


def test_noise_of_a_models_records_stands_in_its_file():
    model = Model(plant=NLM3, evidence=Evidence(range=SHOWN, noise=2e-5))
    assert Model.from_json(model.to_json()).evidence.noise == 2e-5
    with pytest.raises(InputError, match="noise must be a number that is not negative"):
        Model.from_json({**model.to_json(), "noise": -1.0})
