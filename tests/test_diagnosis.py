"""The tests hide an effect in the data and require finding it. Larger studies: ``make confusion``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from servolens.diagnosis.remainder import remainder

from servolens import Plant, Prior, lab
from servolens.diagnosis import diagnose
from servolens.diagnosis import trials as trials_module
from servolens.diagnosis.case import Case
from servolens.diagnosis.errors import pooled, residual, rotated
from servolens.diagnosis.evidence import since_step
from servolens.diagnosis.search import _beam, _Explorer, search
from servolens.diagnosis.trials import MOST_SUBSTEPS, Hypothesis, Trials
from servolens.diagnosis.workflow import _stands_out, _twin
from servolens.effects import (
    ActuatorLag,
    Cogging,
    CoulombFriction,
    DeadZone,
    Delay,
    PendulumGravity,
    Presliding,
    ReturnSpring,
    Saturation,
    SensorLag,
    StribeckFriction,
)
from servolens.errors import InputError
from servolens.model import Quantity
from servolens.record import Controller, Record
from servolens.simulation import simulate_voltage
from servolens.simulation.rates import substeps_for
from servolens.summaries import diagnosis_summary

SEED = 9000
TWINS = {"actuator_lag": {"sensor_lag"}, "sensor_lag": {"actuator_lag"}}
SOME = (
    "delay",
    "backlash",
    "cogging",
    "dead_zone",
    "gain_drift",
    "presliding",
    "speed_servo",
    "stribeck_friction",
)
"""One of each kind; ``make confusion`` goes through them all."""
PAIRS = (("coulomb_friction", "delay"), ("return_spring", "quadratic_drag"))


def first_named(diagnosis, effect):
    cause = diagnosis.causes[0]
    return cause.effect == effect or (cause.effect in TWINS.get(effect, ()) and effect in cause.rivals)


def test_coulomb_friction_is_named_and_measured():
    campaign = lab.hidden_campaign(SEED, effects=["coulomb_friction"], visibility=30.0)
    diagnosis = diagnose(campaign.records, heldout=campaign.heldout)
    (cause,) = diagnosis.causes
    assert diagnosis.verdict == "explained"
    assert cause.effect == "coulomb_friction"
    assert cause.confidence > 0.95
    level = campaign.truth.effects["coulomb_friction"]["level"]
    found = cause.quantities["level"]
    assert abs(found.value - level) < 4.0 * found.stderr
    assert diagnosis.extended.heldout_rms_error < 1.2 * campaign.floor < diagnosis.baseline.heldout_rms_error
    assert cause.heldout == (diagnosis.baseline.heldout_rms_error, diagnosis.extended.heldout_rms_error)


@pytest.mark.slow
@pytest.mark.parametrize("effect", SOME)
def test_hidden_effect_is_named_first(effect):
    campaign = lab.hidden_campaign(SEED + 1, effects=[effect])
    diagnosis = diagnose(campaign.records, heldout=campaign.heldout)
    assert diagnosis.verdict in ("explained", "partly_explained")
    assert first_named(diagnosis, effect), [cause.effect for cause in diagnosis.causes]
    assert diagnosis.extended.heldout_rms_error < diagnosis.baseline.heldout_rms_error


@pytest.mark.slow
@pytest.mark.parametrize("effects", PAIRS, ids="+".join)
def test_hidden_pair_is_named(effects):
    campaign = lab.hidden_campaign(SEED + 2, effects=effects)
    diagnosis = diagnose(campaign.records, heldout=campaign.heldout)
    assert {cause.effect for cause in diagnosis.causes} == set(effects)


@pytest.mark.parametrize("seed", range(SEED, SEED + 8))
def test_healthy_axis_is_called_healthy(seed):
    campaign = lab.hidden_campaign(seed)
    diagnosis = diagnose(campaign.records, heldout=campaign.heldout)
    assert diagnosis.verdict == "healthy"
    assert diagnosis.causes == ()
    assert diagnosis.plant.effects == ()


@pytest.mark.slow
@pytest.mark.parametrize("foreign", ["even_gain", "random_knocks"])
def test_foreign_law_is_not_explained_by_a_member_of_the_catalogue(foreign):
    campaign = lab.hidden_campaign(SEED + 3, foreign=foreign)
    diagnosis = diagnose(campaign.records, heldout=campaign.heldout)
    assert diagnosis.verdict != "explained"
    assert diagnosis.remainder > 0.0
    if diagnosis.verdict == "healthy":  # so little that it does not matter, and said so
        assert diagnosis.causes == ()
        assert "small_remainder" in {finding.code for finding in diagnosis.findings}


@pytest.mark.parametrize(
    "lacking", [{"records": 1, "heldout": 1}, {"log_voltage": False}, {"log_reference": False}], ids=str
)
def test_little_is_logged_and_friction_is_named_all_the_same(lacking):
    campaign = lab.hidden_campaign(SEED + 4, effects=["coulomb_friction"], visibility=40.0, **lacking)
    diagnosis = diagnose(campaign.records)
    assert [cause.effect for cause in diagnosis.causes] == ["coulomb_friction"]


def test_without_held_out_records_each_record_is_left_out_in_turn():
    campaign = lab.hidden_campaign(SEED + 5, effects=["return_spring"], visibility=30.0)
    diagnosis = diagnose(campaign.records)
    heldout = [gain for gain in diagnosis.gains if gain.heldout]
    assert [gain.name for gain in heldout] == [record.name for record in campaign.records]
    assert all(gain.after < gain.before for gain in heldout)


def test_records_of_two_axes_are_said_to_contradict_each_other():
    light, heavy = (lab.Truth(gain=gain, damping=6.0) for gain in (1.9, 3.8))
    records = [
        lab.step_record(axis, 60.0, kd, reference=(0.1, 0.0), duration=0.8, noise=1e-5, seed=i, name=name)
        for i, (axis, kd, name) in enumerate([(light, 0.0, "a"), (light, 2.0, "b"), (heavy, 0.0, "c")])
    ]
    codes = {finding.code for finding in diagnose(records).findings}
    assert "records_contradict" in codes


def steps_of(axis, gains, reference=0.1, duration=1.5):
    return [
        lab.step_record(axis, kp, kd, reference=reference, duration=duration, noise=1e-5, seed=i, name=f"kp {kp:g}")
        for i, (kp, kd) in enumerate(gains)
    ]


def test_dry_friction_beside_a_constant_force_is_one_asymmetric_friction():
    axis = lab.Truth(
        gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.4}, "constant_force": {"acceleration": 0.15}}
    )
    diagnosis = diagnose(steps_of(axis, [(40, 0), (80, 0), (120, 4)], reference=(0.1, 0.0)))
    (cause,) = diagnosis.causes
    assert cause.effect == "asymmetric_friction"
    assert {"coulomb_friction", "constant_force"} <= set(cause.rivals)
    assert cause.quantities["level_positive"].value == pytest.approx(0.55, rel=0.01)
    assert cause.quantities["level_negative"].value == pytest.approx(0.25, rel=0.01)


@pytest.mark.slow
def test_lag_that_passes_for_damping_is_found_once_the_force_is_limited():
    effects = {"actuator_lag": {"time_constant": 0.16}, "force_limit": {"acceleration": 5.0}}
    axis = lab.Truth(gain=210.0, damping=300.0, effects=effects)
    diagnosis = diagnose(steps_of(axis, [(5, 0), (10, 0), (20, 0)], reference=(0.2, 0.0), duration=4.0))
    assert {cause.effect for cause in diagnosis.causes} == {"actuator_lag", "force_limit"}
    assert diagnosis.plant.effect("force_limit").acceleration == pytest.approx(5.0, rel=0.01)
    assert diagnosis.plant.effect("actuator_lag").time_constant == pytest.approx(0.16, rel=0.02)


def test_held_out_record_that_goes_beyond_the_training_is_called_an_extrapolation():
    near, beyond = steps_of(lab.LM1, [(40, 0), (80, 0)])
    found = diagnose(near, heldout=beyond).findings
    assert [finding.record for finding in found if finding.code == "extrapolation"] == ["kp 80"]
    assert "extrapolation" not in {finding.code for finding in diagnose(beyond, heldout=near).findings}


def test_record_beyond_all_others_is_parted_instead_of_left_out():
    seen = []

    def fit(records):
        seen.append([len(record) for record in records])
        return Plant(gain=1.9, damping=6.0)

    low, middle, high = steps_of(lab.LM1, [(40, 0), (45, 0), (120, 0)])
    errors = rotated([low, middle, high], fit)
    assert [error.size for error in errors[:2]] == [len(low), len(middle)]
    assert 0 < errors[2].size < len(high)
    assert seen[2] == [len(low), len(middle), len(high) - errors[2].size]


def test_axis_that_does_not_move_is_refused():
    record = lab.step_record(lab.LM1, 0.0, 0.0, reference=0.1, duration=0.5, seed=1)
    with pytest.raises(InputError, match="check the sensor, or log a step"):
        diagnose(record)


def test_search_returns_to_the_simpler_effect():
    campaign = lab.hidden_campaign(SEED + 6, effects=["coulomb_friction"], visibility=30.0)
    trials = Trials(campaign.records, {})
    found = search(trials, trials.fitted(trials.start), lambda h: h.error < 1.1 * trials.noise)
    assert found.chosen.causes == ("coulomb_friction",)
    assert {h.causes for h in found.tried} >= {("stribeck_friction",), ("asymmetric_friction",)}


@pytest.mark.slow
def test_play_whose_fit_ends_in_a_shallow_fold_needs_no_further_effect():
    campaign = lab.hidden_campaign(412, effects=["backlash"], records=2, visibility=30.0)
    trials = Trials(campaign.records, {})
    shallow = trials.judged(trials.fitted(trials.extended(trials.fitted(trials.start), "backlash").plant))
    assert shallow.error > 1.2 * trials.noise

    def judged(enough):
        return _Explorer(trials, enough, lambda _what, _share: None).judged([shallow])[0]

    assert judged(lambda _: True) is shallow
    deep = judged(lambda h: h.error < 1.05 * trials.noise)
    assert deep.error < trials.noise
    assert deep.plant.effect("backlash").gap == pytest.approx(campaign.truth.effects["backlash"]["gap"], rel=1e-3)


def test_smooth_remainder_is_seen_below_the_noise():
    rng = np.random.default_rng(5)
    noise = rng.normal(size=12_000)
    wave = 0.4 * np.sqrt(2.0) * np.sin(np.arange(12_000) / 100.0)
    assert remainder([noise]) == 0.0
    assert remainder([noise + wave]) == pytest.approx(0.4, rel=0.2)


def test_rounding_at_rest_is_no_remainder():
    rng = np.random.default_rng(6)
    moving = np.cumsum(rng.uniform(0.0, 2.0, size=6_000))
    position = np.concatenate([moving, np.full(6_000, moving[-1])])
    error = np.round(position) - position
    assert remainder([error]) > 0.1
    assert remainder([error], rounding=1.0) == 0.0


def test_diagnosis_survives_json():
    import json

    campaign = lab.hidden_campaign(SEED + 7, effects=["constant_force"], visibility=20.0)
    diagnosis = diagnose(campaign.records, heldout=campaign.heldout)
    data = json.loads(json.dumps(diagnosis.to_json()))
    assert data["verdict"] == diagnosis.verdict
    assert data["causes"][0]["effect"] == "constant_force"
    assert set(data["causes"][0]["gain"]) == {"train", "heldout", "unit"}
    assert data["model"]["effects"][0]["effect"] == "constant_force"
    assert isinstance(diagnosis.plant, Plant)


def test_prior_on_what_no_plant_has_is_refused():
    record = lab.step_record(lab.LM1, 60.0, 0.0, noise=1e-5, seed=1)
    with pytest.raises(InputError, match="a prior on 'level' is not possible"):
        diagnose(record, priors={"level": Prior(value=1.0, deviation=1.0)})


def test_reported_error_is_not_tied_to_the_measurement():
    record = lab.step_record(lab.LM1, 60.0, 0.0, reference=(0.1, 0.0), noise=1e-5, seed=2, log_reference=False)
    wrong = Plant(gain=1.2 * lab.LM1.gain, damping=lab.LM1.damping)
    driven = simulate_voltage(wrong, record.time, record.voltage).position - record.position
    assert pooled([residual(wrong, record)]) == pytest.approx(pooled([driven]), rel=0.1)


def test_single_effects_are_listed_once():
    campaign = lab.hidden_campaign(SEED + 8, effects=["return_spring"], visibility=30.0)
    names = [candidate.effects for candidate in diagnose(campaign.records, heldout=campaign.heldout).candidates]
    assert len(names) == len(set(names)) > 15


def test_what_swings_nearby_has_another_phase_in_every_record():
    def shaken(phase, kp):
        effects = {"periodic_disturbance": {"amplitude": 0.4, "frequency": 7.3, "phase": phase}}
        return lab.step_record(lab.Truth(gain=1.9, damping=6.0, effects=effects), kp, noise=1e-5, seed=kp)

    records = [shaken(phase, kp) for phase, kp in ((0.4, 40), (2.5, 80), (-1.9, 60))]
    diagnosis = diagnose(records[:2], heldout=records[2])
    (cause,) = diagnosis.causes
    assert (diagnosis.verdict, cause.effect) == ("explained", "periodic_disturbance")
    assert cause.quantities["amplitude"].value == pytest.approx(0.4, rel=0.01)
    assert cause.quantities["frequency"].value == pytest.approx(7.3, rel=0.001)
    assert cause.quantities["phase"].value == pytest.approx(0.4, abs=0.05)
    assert diagnosis.extended.heldout_rms_error < 1.2 * diagnosis.noise_floor


def test_held_out_record_of_another_axis_is_no_sign_of_health():
    near = steps_of(lab.LM1, [(40, 0), (80, 0)])
    stranger = lab.step_record(lab.Truth(gain=1.2, damping=9.0), 60, noise=1e-5, seed=1)
    diagnosis = diagnose(near, heldout=stranger)
    assert diagnosis.verdict == "unexplained"
    assert diagnosis.causes == ()
    (said,) = [finding for finding in diagnosis.findings if finding.code == "heldout_contradicts"]
    assert "is it of the same axis" in said.message
    assert "Records that were held out are much farther off" in " ".join(diagnosis_summary(diagnosis).sentences)


def test_single_samples_that_stick_out_are_said_and_spoil_nothing():
    axis = lab.Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.3}})
    sound = steps_of(axis, [(40, 0), (60, 0), (80, 0)])
    rng = np.random.default_rng(3)
    spiked = []
    for record in sound:
        position = record.position.copy()
        position[rng.choice(np.arange(5, len(record) - 5, 9), size=4, replace=False)] += 0.02
        spiked.append(record.with_({"position": position}))
    diagnosis, undisturbed = (diagnose(runs[:2], heldout=runs[2]) for runs in (spiked, sound))
    assert [finding.code for finding in diagnosis.findings[:3]] == 3 * ["position_spikes"]
    assert [finding.code for finding in diagnosis.findings[3:]] == [finding.code for finding in undisturbed.findings]
    assert diagnosis.verdict == "explained"
    assert diagnosis.noise_floor == pytest.approx(undisturbed.noise_floor, rel=0.05)
    level, truth = (d.causes[0].quantities["level"].value for d in (diagnosis, undisturbed))
    assert level == pytest.approx(truth, rel=1e-3)


def test_record_that_is_fitted_is_not_held_out_again():
    record = lab.step_record(lab.LM1, 60, noise=1e-5, seed=1)
    with pytest.raises(InputError, match="has the very samples of"):
        diagnose(record, heldout=record)


def test_wrong_sign_is_said_first():
    record = lab.step_record(lab.LM1, 60, noise=1e-5, seed=1)
    assert diagnose(record.with_({"voltage": -np.asarray(record.voltage)})).findings[0].code == "wrong_sign"


def test_records_whose_onset_is_missed_are_followed_from_where_they_begin():
    cart = lab.Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.4}})
    records = [lab.step_record(cart, kp, noise=1e-5, seed=kp).slice(0.025, 1.4) for kp in (40, 80, 60)]
    diagnosis = diagnose(records[:2], heldout=records[2])
    assert [cause.effect for cause in diagnosis.causes] == ["coulomb_friction"]
    assert diagnosis.extended.heldout_rms_error < 4 * diagnosis.noise_floor < 0.1 * diagnosis.baseline.heldout_rms_error
    assert diagnosis.findings[0].code == "onset_missed"


def test_cause_that_held_out_records_do_not_bear_out_is_part_of_the_truth_at_most():
    def rubbing(level, kp):
        cart = lab.Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": level}})
        return lab.step_record(cart, kp, reference=(0.1, 0.0), noise=1e-5, seed=kp)

    records, drier = [rubbing(0.4, 40), rubbing(0.4, 80)], rubbing(0.45, 60)
    diagnosis = diagnose(records, heldout=drier)
    assert diagnosis.verdict == "partly_explained"
    assert [cause.effect for cause in diagnosis.causes] == ["coulomb_friction"]
    assert "heldout_contradicts" in {finding.code for finding in diagnosis.findings}


def test_an_axis_that_the_sensors_noise_shakes_before_its_step_is_healthy():
    """The log begins while the loop works: what moves the axis before its step is in no voltage that was logged."""
    cart = lab.Truth(gain=0.55, damping=7.3)
    loops = {"reference": 0.05, "rest": 0.3, "duration": 1.2, "sample_time": 5e-4, "derivative_filter": 0.5}
    for seed in (20, 30, 40):
        runs = [
            lab.step_record(cart, kp, kd, encoder=1e-6, noise=6e-5, seed=seed + kp, **loops)
            for kp, kd in ((400, 36), (540, 42))
        ]
        diagnosis = diagnose([run.slice(run.time[500], run.time[-1]) for run in runs])
        assert diagnosis.verdict == "healthy"
        assert diagnosis.remainder < 0.2 * diagnosis.noise_floor


def test_records_cut_out_of_a_motion_are_followed_by_their_voltage_alone():
    """Cut where a sine turns round, the axis seems to rest, and does not."""
    time = np.arange(2000) * 1e-3
    swing = 0.1 * np.sin(2.0 * np.pi * time)
    runs = [lab.step_record(lab.LM1, kp, trajectory=swing, duration=1.999, noise=1e-4, seed=kp) for kp in (60, 100)]
    case = Case.of(tuple(run.slice(0.34, 2.0) for run in runs), (), {})
    assert case.is_explained(case.base)
    assert not case.base.tied


def test_late_start_is_no_motion_backward():
    """Cubics through the first samples of a record that begins at its step, some of a sample late, see a velocity."""
    axis = lab.Truth(gain=1.4, damping=1.1, effects={"delay": {"time": 0.0013}})
    runs = [
        lab.step_record(axis, kp, kd, reference=levels, duration=6.0, rest=0.1, sample_time=5e-3, encoder=0.0,
                        noise=1e-5, seed=int(kp), length_unit="rad")
        for kp, kd, levels in ((12.5, 1.2, (0.45, 0.1)), (9.8, 1.1, 0.6), (18.0, 1.4, 0.3))
    ]  # fmt: skip
    cut = [run.slice(run.time[run.edges()[0]], run.time[-1]).with_({"voltage_before": 0.0}) for run in runs]
    diagnosis = diagnose(cut[:2], heldout=cut[2])
    assert diagnosis.verdict == "explained"
    assert "delay" in (diagnosis.causes[0].effect, *diagnosis.causes[0].rivals)
    assert diagnosis.extended.heldout_rms_error < 1.2 * diagnosis.noise_floor


def test_record_that_no_simulation_follows_contradicts_nothing(monkeypatch):
    records = [lab.step_record(lab.LM1, kp=kp, noise=1e-5, seed=kp) for kp in (40, 80)]
    case = Case.of(tuple(records), (), {})
    monkeypatch.setattr(Trials, "judged", lambda _self, hypothesis: replace(hypothesis, residuals=()))
    assert case.apart(case.base) is None


@pytest.mark.slow
def test_delay_of_records_that_begin_with_their_step_from_rest_is_seen():
    axis = lab.Truth(gain=60.0, damping=12.0, effects={"delay": {"time": 0.012}})
    levels = ([1.0, 0.0, 0.5], [0.7, -0.2, 0.9], [1.0, 0.3, -0.5])
    whole = [
        lab.step_record(axis, kp=kp, kd=kd, reference=r, duration=0.8, rest=0.1, noise=1e-4, seed=i, length_unit="rad")
        for i, (kp, kd, r) in enumerate(zip((4.0, 8.0, 2.5), (0.02, 0.1, 0.0), levels, strict=True))
    ]
    cut = [record.slice(record.time[record.edges()[0]], record.time[-1]) for record in whole]
    for records, doubts in ((whole, 0), (cut, 1)):
        diagnosis = diagnose(records)
        (cause,) = diagnosis.causes
        assert cause.effect == "delay"
        assert cause.quantities["time"].value == pytest.approx(0.012, abs=1e-5)
        assert [finding.code for finding in diagnosis.findings].count("unpowered_before") == doubts


def test_wave_of_which_a_part_is_seen_is_no_candidate():
    axis = lab.Truth(gain=1.9, damping=6.0, effects={"return_spring": {"stiffness": 20.0}})
    trials = Trials([lab.step_record(axis, kp=kp, reference=[0.1, 0.02], noise=1e-5, seed=kp) for kp in (40, 80)], {})
    travel = trials.seen.travel
    assert trials.fitted(trials.start.with_effect(Cogging(amplitude=1.0, pitch=4.0 * travel, phase=0.0))) is None
    assert trials.fitted(trials.start.with_effect(Cogging(amplitude=0.01, pitch=0.2 * travel, phase=0.0))) is not None


def test_two_axes_contradict_each_other_though_one_of_them_has_friction():
    sticky = lab.Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.4}})
    other = lab.Truth(gain=1.2, damping=4.0)
    records = [lab.step_record(axis, kp=kp, noise=1e-5, seed=kp) for axis in (sticky, other) for kp in (40, 60)]
    diagnosis = diagnose(records)
    assert diagnosis.verdict == "unexplained"
    assert "records_contradict" in [finding.code for finding in diagnosis.findings]


def test_lag_far_below_the_sample_time_is_told_from_a_delay():
    axis = lab.Truth(gain=21.5, damping=16.9, effects={"actuator_lag": {"time_constant": 2e-4}})
    runs = [(8, 0.0, 0.0), (30, 1.4, 0.1)]
    records = [
        lab.step_record(axis, kp=kp, kd=kd, rest=rest, reference=[0.6, 0.2], noise=1e-6, seed=kp)
        for kp, kd, rest in runs
    ]
    cause = diagnose(records).causes[0]
    assert cause.effect == "actuator_lag"
    assert cause.quantities["time_constant"].value == pytest.approx(2e-4, rel=0.01)


def test_disturbance_is_found_behind_a_dead_zone():
    campaign = lab.hidden_campaign(SEED + 3, effects=["dead_zone", "periodic_disturbance"], visibility=20.0)
    trials = Trials(campaign.records, {})
    plant = trials.start.with_effect(DeadZone(width=campaign.truth.effects["dead_zone"]["width"]))
    beside = trials.fitted(plant)
    found = trials.extended(beside, "periodic_disturbance")
    wanted = campaign.truth.effects["periodic_disturbance"]["frequency"]
    assert found.plant.effect("periodic_disturbance").frequency == pytest.approx(wanted, rel=0.01)


def test_starts_too_stiff_to_be_fitted_are_not_simulated(monkeypatch):
    trials = Trials([lab.step_record(lab.NLM1, kp=60, noise=1e-5, seed=1)], {})
    tried, error_of = [], trials_module.error_of

    def counted(plant, runs, **how):
        tried.extend(substeps_for(plant, run.sample_time) for run in runs)
        return error_of(plant, runs, **how)

    monkeypatch.setattr(trials_module, "error_of", counted)
    for trials.most_substeps in (MOST_SUBSTEPS, 3):
        tried.clear()
        trials.extended(trials.fitted(trials.start), "presliding")
        assert (max(tried) > 3) == (trials.most_substeps > 3)


def test_generalising_step_does_not_upset_what_the_search_is_sure_of(monkeypatch):
    trials = Trials([lab.step_record(lab.NLM1, kp=60, noise=1e-5, seed=1)], {})
    noise, plant = trials.noise, trials.start
    coulomb, stribeck = CoulombFriction(level=0.1), StribeckFriction(level=0.1, static_excess=0.1, stribeck_speed=0.1)
    both = plant.with_effect(stribeck).with_effect(DeadZone(width=0.1))
    steps = iter(
        [
            Hypothesis(plant.with_effect(coulomb), 60.0 * noise),
            Hypothesis(plant.with_effect(stribeck), 40.0 * noise),
            Hypothesis(both, 19.0 * noise),
        ]
    )
    monkeypatch.setattr(
        "servolens.diagnosis.search._Explorer.explore", lambda *_: [h for h in (next(steps, None),) if h]
    )
    monkeypatch.setattr("servolens.diagnosis.search._reconsidered", lambda path, *_: (path, (), True))
    found = search(trials, Hypothesis(plant, 100.0 * noise), lambda _: False)
    assert found.chosen.causes == ("stribeck_friction", "dead_zone")


@pytest.mark.parametrize(("third", "rounds"), [(9.0, 3), (7.0, 4)])
def test_fourth_effect_is_looked_for_only_where_the_third_helps(monkeypatch, third, rounds):
    trials = Trials([lab.step_record(lab.NLM1, kp=60, noise=1e-5, seed=1)], {})
    effects = (CoulombFriction(level=0.1), DeadZone(width=0.1), Delay(time=1e-3))
    asked = []

    def explore(_explorer, jobs, _what):
        asked.append(jobs)
        if len(asked) > len(effects):
            return []
        plant = replace(trials.start, effects=effects[: len(asked)])
        return [Hypothesis(plant, (50.0, 10.0, third)[len(asked) - 1] * trials.noise)]

    monkeypatch.setattr("servolens.diagnosis.search._Explorer.explore", explore)
    monkeypatch.setattr("servolens.diagnosis.search._reconsidered", lambda path, *_: (path, (), True))
    search(trials, Hypothesis(trials.start, 100.0 * trials.noise), lambda _: False)
    assert len(asked) == rounds


@pytest.mark.parametrize("effect", ["flexible_coupling", "speed_servo"])
def test_what_remembers_is_explained_where_the_reference_never_jumps(effect):
    campaign = lab.hidden_campaign(SEED + 4, effects=[effect], visibility=20.0, smooth=True)
    diagnosis = diagnose(campaign.records, heldout=campaign.heldout)
    assert diagnosis.verdict == "explained"
    assert [cause.effect for cause in diagnosis.causes] == [effect]
    assert diagnosis.extended.heldout_rms_error < 1.15 * campaign.floor


def test_weight_within_a_small_angle_is_no_candidate_unless_it_stands():
    axis = lab.Truth(gain=1.9, damping=6.0, effects={"constant_force": {"acceleration": 0.5}})
    hangs, stands = PendulumGravity(amplitude=0.5, phase=1.5), PendulumGravity(amplitude=0.5, phase=3.0)
    for weight, travel, is_candidate in ((hangs, 0.05, False), (hangs, 0.8, True), (stands, 0.05, True)):
        records = [lab.step_record(axis, kp=kp, reference=[travel], noise=1e-5, seed=kp) for kp in (40, 80)]
        assert weight.is_whole(Trials(records, {}).seen) == is_candidate


def test_arm_that_stands_upright_is_found_in_a_small_travel():
    arm = lab.Truth(gain=20.0, damping=6.0, effects={"pendulum_gravity": {"amplitude": 8.0, "phase": 2.9}})
    runs = [lab.step_record(arm, kp=kp, kd=0.5, reference=[0.06], noise=1e-5, seed=kp) for kp in (10, 16)]
    trials = Trials(runs, {})
    found = trials.extended(trials.fitted(trials.start), "pendulum_gravity")
    assert found.error < 1.1 * trials.noise


def test_simplest_of_those_that_come_close_is_extended_too():
    bare = Plant(gain=2.0, damping=5.0)
    found = [
        Hypothesis(bare.with_effect(effect), error)
        for effect, error in (
            (Cogging(amplitude=1.0, pitch=0.1, phase=0.0), 2.0),
            (Presliding(stiffness=100.0, level=1.0), 2.2),
            (PendulumGravity(amplitude=1.0, phase=0.0), 2.21),
            (ReturnSpring(stiffness=10.0), 2.3),
            (DeadZone(width=0.1), 3.9),
        )
    ]
    assert [h.causes for h in _beam(found)] == [("cogging",), ("presliding",), ("return_spring",)]
    assert [h.causes for h in _beam(found[:3])] == [("cogging",), ("presliding",)]


@pytest.mark.parametrize(
    ("beside", "twins"),
    [(DeadZone(width=0.2), True), (Saturation(limit=2.0), True), (CoulombFriction(level=15.0), False)],
    ids=lambda case: getattr(case, "name", str(case)),
)
def test_lags_are_twins_as_long_as_all_between_them_is_linear(beside, twins):
    """What bends the command before the lag changes nothing; dry friction after it tells the two apart."""
    plant = Plant(gain=20.0, damping=10.0, effects=(beside, SensorLag(time_constant=0.01)))
    other = Plant(gain=20.0, damping=10.0, effects=(beside, ActuatorLag(time_constant=0.01)))
    assert (_twin(Hypothesis(plant, 1.0), "sensor_lag") == "actuator_lag") == twins
    assert (_twin(Hypothesis(other, 1.0), "actuator_lag") == "sensor_lag") == twins
    both = other.with_effect(SensorLag(time_constant=0.002))
    assert not _twin(Hypothesis(both, 1.0), "actuator_lag")
    time = np.arange(2000) * 1e-3
    voltage = np.where(time < 0.8, 4.0, -3.0)
    one, two = (simulate_voltage(p, time, voltage, before=0.0).measured for p in (plant, other))
    assert (np.max(np.abs(one - two)) < 1e-5 * np.ptp(one)) == twins


@pytest.mark.parametrize(
    ("value", "stderr", "sure"), [(0.6, 0.4, 0.866), (0.6, 0.06, 1.0), (0.6, None, 1.0), (0.0, None, 0.0)]
)
def test_cause_within_its_error_bar_is_not_trusted(value, stderr, sure):
    plant = Plant(gain=20.0, damping=10.0, effects=(CoulombFriction(level=value),))
    level = Quantity(value=value, unit="m/s^2", stderr=stderr)
    assert _stands_out(plant, "coulomb_friction", {"level": level}) == pytest.approx(sure, abs=1e-3)


def test_time_counts_from_where_the_reference_sets_out():
    time = np.arange(400) * 1e-3
    ramps = np.interp(time, [0.0, 0.1, 0.2, 0.3, 0.35, 0.4], [0.0, 0.0, 1.0, 1.0, 0.0, 0.0])
    record = Record(time=time, position=ramps, reference=ramps, controller=Controller(kp=10.0))
    found = since_step(record)
    held = record.with_({"reference": np.repeat(ramps[::4], 4)})
    np.testing.assert_allclose(since_step(held)[[299, 360]], found[[299, 360]], atol=5e-3)
    assert found[99] == pytest.approx(0.099)
    assert found[299] == pytest.approx(0.198, abs=2e-3)
    assert found[360] == pytest.approx(0.060, abs=2e-3)
