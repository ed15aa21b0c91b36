"""Plants with given effects, fitted to the virtual laboratory's records, whose numerics are its own."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, final

import numpy as np
import pytest
from scipy.stats import chi2

import servolens
from servolens import Controller, Plant, Prior, Record, bootstrap, profile, read_model
from servolens.control_law import controller_voltage, with_history
from servolens.effects import (
    CATALOGUE,
    ActuatorLag,
    Axis,
    Backlash,
    Cogging,
    ConstantForce,
    CoulombFriction,
    Delay,
    EndStop,
    FlexibleCoupling,
    Force,
    PendulumGravity,
    PeriodicDisturbance,
    QuadraticDrag,
    Saturation,
    SensorLag,
    SpeedServo,
    StribeckFriction,
    effect_class,
    parameter,
)
from servolens.effects import _offered as offered
from servolens.errors import InputError, NumericalError
from servolens.identification.fit_findings import findings_of
from servolens.identification.fitting import of_other_inertias
from servolens.identification.likelihood import Likelihood
from servolens.identification.noise import NoiseModel
from servolens.identification.options import FitOptions
from servolens.identification.refine import minimise_error
from servolens.identification.runs import OneByOne, closed_runs
from servolens.lab import LM1, Setup, Truth, hidden_campaign, step_record, step_records
from servolens.lab.laws import LAWS
from servolens.model import Model
from servolens.simulation.rates import MOST_SUBSTEPS, substeps_for
from servolens.summaries.wording import plus_minus

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servolens import Fit
    from servolens.effects import Effect

NOISE = ENCODER = 1e-5
SCATTER = float(np.hypot(NOISE, ENCODER / np.sqrt(12)))
"""Standard deviation of what is measured [m or rad]: of the sensor's noise and of its rounding."""
FAR = 3.5
"""Standard errors that an estimate may be off: by chance further once in two thousand."""
GAIN, DAMPING = 1.9, 6.0
TRUTHS = {name: cls.typical for name, cls in CATALOGUE.items() if name in LAWS and name != "end_stop"}
"""Of what the laboratory has a law of its own for. A stop is hit by other moves than these."""
RUNS: tuple[tuple[float, float, tuple[float, ...]], ...] = (
    (40.0, 0.0, (0.1, 0.0, 0.1)),
    (100.0, 5.0, (0.1, 0.0, -0.05)),
)
"""Kp, Kd, and the levels that are visited for 0.8 s each [m]."""


def axis(**effects: Mapping[str, float]) -> Truth:
    servo = effects.get("speed_servo")
    gain = servo["speed_per_volt"] * servo["proportional"] if servo else GAIN
    return Truth(gain=gain, damping=DAMPING, effects=effects)


def effects_of(truth: Truth, share: float = 1.0) -> list[Effect]:
    """Return the true effects, or with each parameter that many times as large, but for those that a fit holds."""
    return [
        Plant.effect_from(name, {k: v if k in CATALOGUE[name].found_last else share * v for k, v in values.items()})
        for name, values in truth.effects.items()
    ]


def plant_of(truth: Truth) -> Plant:
    return Plant(gain=truth.gain, damping=truth.damping, effects=tuple(effects_of(truth)))


def logged(truth: Truth, kp: float = 60.0, kd: float = 0.0, *, seed: int = 0, **bench: Any) -> Record:
    return step_record(truth, kp, kd, seed=seed, **{"noise": NOISE, "encoder": ENCODER, "duration": 0.8, **bench})


def campaign(truth: Truth, **bench: Any) -> list[Record]:
    return [
        logged(truth, kp, kd, reference=levels, seed=seed, **bench) for seed, (kp, kd, levels) in enumerate(RUNS, 30)
    ]


def miss(fit: Fit, name: str, true: float) -> float:
    """Return by how many standard errors a parameter is off; a phase may be off by whole turns."""
    quantity = fit.quantities[name]
    assert quantity.stderr is not None, f"{name}: {quantity.reason}"
    error = quantity.value - true
    if name.endswith(".phase"):
        error = (error + np.pi) % (2 * np.pi) - np.pi
    return abs(error) / quantity.stderr


def misses(fit: Fit, truth: Truth) -> dict[str, float]:
    """Return the parameters that are too far from the truth."""
    plant = plant_of(truth)
    values = {n: v for n, v in plant.named.items() if n not in (*plant.derived, *plant.usual)}
    values = {n: v for n, v in values.items() if n not in fit.options.held}
    off = {name: miss(fit, name, value) for name, value in values.items()}
    return {name: far for name, far in off.items() if far > FAR}


def assert_at_noise(fit: Fit) -> None:
    """The residual is the noise, which `n` samples show to 1/√(2n); four such, and what the parameters take off."""
    count = sum(residual.size for residual in fit.refinement.residuals)
    unknowns = len(fit.plant.values) + 2 * len(fit.refinement.residuals)
    assert fit.rms_error == pytest.approx(SCATTER, rel=4 / np.sqrt(2 * count) + unknowns / count)
    assert fit.at_noise


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n == "backlash" else n for n in TRUTHS])
def test_effect_is_found_from_values_half_as_large_again(name):
    truth = axis(**{name: TRUTHS[name]})
    fit = servolens.fit(effects_of(truth, 1.5), campaign(truth))
    assert misses(fit, truth) == {}
    assert_at_noise(fit)
    vague = {n: q for n, q in fit.quantities.items() if q.stderr is not None and q.stderr > 0.1 * abs(q.value)}
    assert vague == {}


def test_what_the_data_do_not_determine_costs_no_other_parameter_its_error_bar():
    """An end of the travel that the axis never meets; the other one it hits."""
    truth = axis(end_stop={"low": -0.5, "high": 0.09})
    fit = servolens.fit(effects_of(truth, 1.03), campaign(truth))
    assert fit.quantities["end_stop.low"].stderr is None
    assert fit.quantities["end_stop.low"].reason == "the records do not reach it"
    assert codes(fit)["not_determined"] == "end_stop.low is not seen by these records, which do not reach it."
    assert plus_minus(fit.quantities["end_stop.low"]) == "none seen"
    assert fit.quantities["end_stop.high"].value == pytest.approx(0.09, abs=2e-4)
    assert miss(fit, "gain", GAIN) < FAR
    assert miss(fit, "damping", DAMPING) < FAR


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("cogging.phase", {"amplitude": 0.5, "pitch": 0.03, "phase": 0.0}),
        ("position_friction.centre", {"level": 0.5, "centre": 0.0, "width": 0.02}),
    ],
)
def test_place_and_phase_that_happen_to_be_nearly_nothing_are_known_all_the_same(name, values):
    """A place of 0 ± 7 µm was said to be hardly determined, for its error bar is larger than its value."""
    truth = axis(**{name.partition(".")[0]: values})
    fit = servolens.fit(effects_of(truth, 1.02), campaign(truth))
    error = fit.quantities[name].stderr
    assert abs(fit.quantities[name].value) < 4.0 * error < 0.05
    nearer = replace(fit.refinement, plant=fit.plant.with_named({name: 0.1 * error}))
    assert "not_determined" not in {finding.code for finding in findings_of(nearer)}


def test_limit_that_is_reached_all_the_time_is_not_said_to_be_unseen():
    """Only its product with the gain is known."""
    time = np.arange(0.0, 3.0, 0.002)
    voltage = 10.0 * np.where(time % 1.0 < 0.5, 1.0, -1.0)
    limited = Plant(gain=GAIN, damping=DAMPING, effects=(Saturation(limit=5.0),))
    noise = 1e-5 * np.random.default_rng(1).standard_normal(time.size)
    position = servolens.simulate_voltage(limited, time, voltage).position + noise
    fit = servolens.fit(limited, Record(time=time, position=position, voltage=voltage))
    assert fit.quantities["saturation.limit"].reason == "the data do not determine it"
    assert "the data do not determine saturation.limit" in codes(fit)["not_determined"]


@pytest.mark.slow
def test_contact_that_was_given_stays_within_its_bounds():
    """Where the first start does not reach the noise, others have the usual contact, which no bound holds."""
    truth = axis(end_stop={"low": -0.5, "high": 0.09, "contact_damping": 0.3}, coulomb_friction={"level": 0.4})
    given = EndStop(low=-0.5, high=0.093, contact_damping=0.35)
    fit = servolens.fit(given, campaign(truth), bounds={"end_stop.contact_damping": (0.2, 0.5)})
    assert 0.2 <= fit.plant.effects[0].contact_damping <= 0.5


@pytest.mark.slow
def test_stop_that_bounces_is_fitted_with_its_contact():
    truth = axis(end_stop={"low": -0.5, "high": 0.09, "contact_damping": 0.3})
    fit = servolens.fit([EndStop(low=-0.5, high=0.093)], campaign(truth))
    for name, true in (
        ("gain", GAIN),
        ("damping", DAMPING),
        ("end_stop.high", 0.09),
        ("end_stop.contact_damping", 0.3),
    ):
        assert miss(fit, name, true) < FAR
    assert_at_noise(fit)


@pytest.mark.slow
def test_play_with_a_soft_contact_is_fitted_with_it():
    own = {"gap": 0.002, "load_share": 0.35, "contact_frequency": 120.0, "contact_damping": 0.5}
    truth = axis(backlash=own)
    fit = servolens.fit(Backlash(gap=0.002, load_share=0.3), campaign(truth))
    for name, true in (
        ("gain", GAIN),
        ("damping", DAMPING),
        *((f"backlash.{key}", value) for key, value in own.items()),
    ):
        assert fit.quantities[name].value == pytest.approx(true, rel=0.02), name
    assert_at_noise(fit)


def test_usual_contact_is_no_parameter_of_a_fit():
    """It has no row and no place in a file, and nobody can ask something of it."""
    records = campaign(axis(end_stop={"low": -0.5, "high": 0.09}))
    fit = servolens.fit([EndStop(low=-0.5, high=0.093)], records)
    assert set(fit.quantities) == {"gain", "damping", "end_stop.low", "end_stop.high"}
    assert_at_noise(fit)
    again = Model.from_json(json.loads(json.dumps(fit.model.to_json())))
    assert again.plant == fit.plant
    np.testing.assert_array_equal(again.covariance, fit.model.covariance)
    with pytest.raises(InputError, match="contact_damping has its usual value, and is not fitted from there"):
        servolens.fit([EndStop(low=-0.5, high=0.093)], records, bounds={"end_stop.contact_damping": (0.1, 3.0)})


def test_limit_of_the_amplifier_closes_the_loop_with_it():
    truth = axis(coulomb_friction={"level": 0.35})
    records = [logged(truth, kp, 2.0, seed=int(kp), setup=Setup(voltage_limit=4.0)) for kp in (60.0, 100.0)]
    fit = servolens.fit([CoulombFriction(level=0.5)], records, driven="closed_loop")
    assert fit.driven == "closed_loop"
    assert fit.plant.gain == pytest.approx(GAIN, rel=2e-3)
    assert_at_noise(fit)
    blind = [record.with_({"voltage_limit": None}) for record in records]
    wrong = servolens.fit([CoulombFriction(level=0.5)], blind, driven="closed_loop")
    assert "above_noise" in codes(wrong)


def coloured(records: list[Record], kept: float = 0.95, deviation: float = 2e-5) -> list[Record]:
    """Return the records with slow noise of the sensor added, which the loop has not seen."""
    out = []
    for seed, record in enumerate(records):
        white = np.random.default_rng(100 + seed).standard_normal(len(record))
        slow = np.empty(white.size)
        slow[0] = white[0]
        for k in range(1, white.size):
            slow[k] = kept * slow[k - 1] + np.sqrt(1.0 - kept**2) * white[k]
        out.append(record.with_({"position": record.position + deviation * slow, "encoder_resolution": None}))
    return out


@pytest.mark.parametrize("driven", ["auto", "closed_loop", "voltage"])
def test_error_bars_allow_for_slow_noise_of_the_sensor(driven):
    """As many samples of white noise of this size would tell several times more."""
    records = coloured(campaign(STICKY))
    fit = servolens.fit([CoulombFriction(level=0.5)], records, driven=driven)
    assert fit.noise_model.order > 0
    assert fit.noise == pytest.approx(np.hypot(2e-5, SCATTER), rel=0.25)
    assert misses(fit, STICKY) == {}
    assert fit.at_noise


@pytest.mark.parametrize(
    ("effect", "parameter", "value"), [("coulomb_friction", "level", 0.3), ("dead_zone", "width", 0.3)]
)
def test_error_bars_allow_for_what_the_loop_makes_of_noise(effect, parameter, value):
    """Where friction lets the axis stop lasts, and a dead zone passes one half of the noise: neither is white."""
    cart = Truth(gain=1.9, damping=6.0, effects={effect: {parameter: value}})
    missed = []
    for seed in range(16):
        record = step_record(cart, kp=60, noise=3e-5, duration=1.2, sample_time=0.003, seed=seed)
        fit = servolens.fit(effect, record, driven="closed_loop")
        assert np.any(fit.refinement.usual[0] != 0.0)
        found = fit.quantities.values()
        missed.append([(q.value - true) / q.stderr for q, true in zip(found, (1.9, 6.0, value), strict=True)])
    squares = np.sum(np.square(missed), axis=0)
    assert np.all(squares < chi2.isf(1e-3, len(missed)))
    assert np.all(squares > chi2.isf(1.0 - 1e-3, len(missed)))


def behind_an_encoder(rng, kp, kd, to, noise, step=2e-5, samples=1200, h=1e-3):
    """Return the log of a loop that begins anywhere within a step of its encoder, of which each sample is exact."""
    place, decay = step * rng.uniform(-0.5, 0.5), np.exp(-6.0 * h)
    y = v = before = 0.0
    shown, asked = np.empty(samples), np.empty(samples)
    for k in range(samples):
        shown[k] = step * np.floor((y + place + noise * rng.standard_normal()) / step + 0.5)
        before = shown[0] if k == 0 else before
        asked[k] = kp * (to - shown[k]) - kd * (shown[k] - before) / h
        before, settled = shown[k], 1.9 * asked[k] / 6.0
        y += settled * h + (v - settled) * (1.0 - decay) / 6.0
        v = settled + (v - settled) * decay
    return Record(
        time=h * np.arange(samples),
        position=shown,
        voltage=asked,
        reference=np.full(samples, to),
        controller=Controller(kp=kp, kd=kd),
        encoder_resolution=step,
    )


@pytest.mark.parametrize("noise", [1e-6, 4e-6, 12e-6])
def test_error_bars_allow_for_a_coarse_encoder_in_the_loop(noise):
    """A fit takes up where within a step the axis begins; what the loop makes of the steps biases nothing."""
    missed, rng = [], np.random.default_rng(1)
    for _ in range(20):
        loops = ((60.0, 0.0, 0.1), (100.0, 3.0, 0.1), (40.0, 0.0, 0.05))
        records = [behind_an_encoder(rng, *loop, noise) for loop in loops]
        found = servolens.fit([], records, driven="closed_loop").quantities.values()
        missed.append([(q.value - true) / q.stderr for q, true in zip(found, (1.9, 6.0), strict=True)])
    assert np.all(np.abs(np.sum(missed, axis=0)) < 3.3 * np.sqrt(len(missed)))  # one in a thousand
    assert np.all(np.sum(np.square(missed), axis=0) < chi2.isf(1e-3, len(missed)))


@pytest.mark.parametrize("campaign", [0, 3, 5])
def test_what_only_a_sum_determines_has_no_narrow_error_bar(campaign):
    """An axis that moves one way shows its friction and a constant force together alone."""
    axis = Truth(
        gain=2.7, damping=21.7, effects={"coulomb_friction": {"level": 4.0}, "constant_force": {"acceleration": -3.5}}
    )
    records = [
        step_record(axis, kp, 13.8, reference=0.015, noise=2e-6, duration=0.8, encoder=0.0, seed=seed + 3 * campaign)
        for seed, kp in ((1, 871.0), (2, 0.8 * 871.0), (3, 1.2 * 871.0))
    ]
    fit = servolens.fit(["coulomb_friction", "constant_force"], records)
    assert fit.at_noise
    for name, true in (("coulomb_friction.level", 4.0), ("constant_force.acceleration", -3.5)):
        found = fit.quantities[name]
        assert found.stderr is None or abs(found.value - true) < 3.0 * found.stderr
        assert any(name in finding.message for finding in fit.findings)


@pytest.mark.slow
def test_sticking_and_delay_are_found_though_the_linear_gain_is_far_off():
    """An arm whose friction holds it on the way passes for one of several times the inertia."""
    arm = Truth(gain=45.0, damping=23.0, effects={"coulomb_friction": {"level": 22.0}, "delay": {"time": 0.03}})
    records = [
        logged(arm, kp, 0.0, reference=(0.1, -0.1, 0.1), seed=int(kp), setup=Setup(length_unit="rad"))
        for kp in (7.0, 9.0)
    ]
    bare = servolens.fit([], records)
    fit = servolens.fit([CoulombFriction(level=5.0), Delay(time=0.001)], records)
    assert misses(fit, arm) == {}
    assert_at_noise(fit)
    assert "above_noise" in codes(bare)
    assert codes(bare)["above_noise"].endswith(
        " noise. This model does not explain the data to noise level. Do not rely on the"
        " error bars: they hold only if it is right. Run servolens diagnose."
    )
    told = bare.summary()
    assert told.tables[0].note.endswith(codes(bare)["above_noise"][1:])
    assert "above_noise" not in {finding.code for finding in told.findings}
    assert fit.summary().tables[0].note == ""


PAIRS = {
    "friction and delay": ("coulomb_friction", "delay"),
    "Stribeck and cogging": ("stribeck_friction", "cogging"),
    "dead zone and friction": ("dead_zone", "coulomb_friction"),
    "spring and constant force": ("return_spring", "constant_force"),
    "cogging and spring": ("cogging", "return_spring"),
}


LONG = {"Stribeck and cogging", "cogging and spring"}


@pytest.mark.parametrize(
    "names",
    [pytest.param(names, marks=pytest.mark.slow if pair in LONG else (), id=pair) for pair, names in PAIRS.items()],
)
def test_two_effects_are_found_together(names):
    truth = axis(**{name: TRUTHS[name] for name in names})
    fit = servolens.fit(effects_of(truth, 1.5), campaign(truth))
    assert misses(fit, truth) == {}
    assert_at_noise(fit)


@pytest.mark.slow
def test_backlash_and_friction_are_found_together():
    """To two percent: contacts give the error many minima, and the search may end beside the lowest."""
    truth = axis(backlash=TRUTHS["backlash"], coulomb_friction=TRUTHS["coulomb_friction"])
    fit = servolens.fit(effects_of(truth, 1.5), campaign(truth))
    np.testing.assert_allclose(fit.plant.values, plant_of(truth).values, rtol=0.02)
    assert_at_noise(fit)


def test_an_axis_that_obeys_at_once_is_not_fitted_beyond_what_can_be_simulated():
    """Its damping has no end: the error falls, less and less, for ever."""
    time = np.arange(1500) * 1e-3
    voltage = np.where(time < 0.7, 2.0, -1.0)
    record = Record(time=time, position=0.1 * np.concatenate([[0.0], np.cumsum(voltage[:-1]) * 1e-3]), voltage=voltage)
    start = Plant(gain=10.0, damping=10.0)
    runs = Likelihood([record], start, FitOptions()).runs(NoiseModel.white(1e-6))
    found = minimise_error(start, runs, FitOptions(), noise=1.0)
    assert found.plant.gain / found.plant.damping == pytest.approx(0.1, rel=1e-3)
    assert found.plant.damping > 1e3
    assert substeps_for(found.plant, 1e-3) < MOST_SUBSTEPS
    assert not found.converged


def test_axis_that_sticks_at_its_beginning_is_followed_though_its_velocity_is_free():
    """The smoothed velocity of such a beginning is off, and that of an axis that sticks has no effect at all."""
    hidden = hidden_campaign(11206005, effects=["coulomb_friction"], smooth=True)
    truth = plant_of(hidden.truth)
    runs = Likelihood(hidden.records, truth, FitOptions()).runs(NoiseModel.white(hidden.floor))
    found = minimise_error(truth, runs, FitOptions(), noise=1.0)
    assert found.rms_error < 1.02 * hidden.floor
    assert found.plant.values == pytest.approx(truth.values, rel=5e-4)


@pytest.mark.slow
def test_lower_minima_are_found_where_contacts_give_the_error_many():
    """A small play that rattles: from starts 3 % off, minimisation alone ends in another place each time."""
    hidden = hidden_campaign(72, effects=["backlash"], visibility=2.0, records=1)
    truth, options = plant_of(hidden.truth), FitOptions()
    runs = Likelihood(hidden.records, truth, options).runs(NoiseModel.white(hidden.floor))
    share = list(truth.parameters).index("backlash.load_share")
    from_truth = minimise_error(truth, runs, options, noise=1.0).misfit
    ends: dict[bool, list[float]] = {False: [], True: []}
    said, lower = 0, []
    for seed in (1, 2, 3):
        shifts = np.ones(len(truth.values))
        shifts[:4] += 0.03 * np.random.default_rng(seed).standard_normal(4)  # the contact is the usual one
        start = truth.with_values((np.array(truth.values) * shifts).tolist())
        for looked, shares in ends.items():
            found = minimise_error(start, runs, options, noise=1.0, coarse=True, local_minima=looked)
            shares.append(found.plant.values[share])
            assert ("non_smooth_error" in [finding.code for finding in findings_of(found)]) != found.is_smooth
            said += not found.is_smooth
            lower.append(found.misfit)
    assert said
    assert all(looking <= alone for alone, looking in zip(lower[::2], lower[1::2], strict=True))
    assert max(lower[1::2]) <= from_truth
    assert np.ptp(ends[True]) < 0.1 * np.ptp(ends[False])


def test_search_that_is_stopped_among_local_minima_looks_beside_its_end():
    """It ended where the error is smooth about one minimum of many, five standard errors off."""
    hidden = hidden_campaign(72, effects=["backlash"], visibility=2.0, records=1)
    truth, options = plant_of(hidden.truth), FitOptions()
    runs = Likelihood(hidden.records, truth, options).runs(NoiseModel.white(hidden.floor))
    shifts = np.ones(len(truth.values))
    shifts[:4] += 0.03 * np.random.default_rng(1).standard_normal(4)  # the contact is the usual one
    start = truth.with_values((np.array(truth.values) * shifts).tolist())
    found = minimise_error(start, runs, options, noise=1.0, local_minima=True, allowance=1e6)
    errors = np.sqrt(np.diag(found.covariance))[:4]
    assert (np.abs(np.array(found.plant.values) - truth.values)[:4] < 3.0 * errors).all()
    assert (errors < 0.1 * np.array(truth.values)[:4]).all()


@pytest.mark.xfail(strict=True, reason="error bars of a rattling play are several times too small")
@pytest.mark.slow
def test_error_bars_hold_the_local_minima_that_explain_as_much():
    """A small play that rattles: with wide differences alone the truth lay eight standard errors off."""
    hidden = hidden_campaign(502, effects=["backlash"], visibility=9.0, records=3)
    truth = plant_of(hidden.truth)
    fit = servolens.fit(effects_of(hidden.truth, 1.3), hidden.records)
    assert not fit.refinement.is_smooth
    assert fit.rms_error < 1.05 * hidden.floor
    for name, quantity in fit.quantities.items():
        value = truth.named[name]
        assert abs(quantity.value - value) < 3.0 * quantity.stderr, name
        assert quantity.stderr < 0.05 * value
    assert np.nanmax(fit.refinement.colour) < 2.0, "local minima are no coloured residuals"
    again = servolens.fit(fit.model.plant.effects, hidden.records)
    for name, quantity in fit.model.quantities.items():
        assert 0.3 < again.model.quantities[name].stderr / quantity.stderr < 3.0, name


@pytest.mark.slow
def test_rattle_in_closed_loop_does_not_lead_the_fit_away_from_its_start():
    hidden = hidden_campaign(72, effects=["backlash"], visibility=8.9, records=2)
    truth = plant_of(hidden.truth)
    fit = servolens.fit(truth.effects, hidden.records)
    assert fit.driven == "voltage"
    gain, damping, *play = ((q, truth.named[name]) for name, q in fit.quantities.items())
    for found, true in (gain, damping):
        assert found.value == pytest.approx(true, rel=2e-3)
    for found, true in play:  # by a twentieth of a standard error local minima differ between processors
        assert abs(found.value - true) < found.stderr < 0.05 * true
    assert misses(fit, hidden.truth) == {}


@pytest.mark.slow
def test_large_clean_play_is_not_said_to_make_the_error_non_smooth():
    truth = axis(backlash={"gap": 0.01, "load_share": 0.35})
    records = [logged(truth, kp, 2.0, reference=[0.1, 0.0], duration=0.6, seed=int(kp)) for kp in (20.0, 30.0)]
    fit = servolens.fit(effects_of(truth, 1.2), records)
    assert fit.refinement.is_smooth
    assert_at_noise(fit)


@pytest.mark.parametrize(
    ("seeds", "places"),
    [((20, 30), (0.999, -0.6)), pytest.param((22, 32), (0.999, -0.999), marks=pytest.mark.slow)],
)
def test_motor_that_rests_anywhere_within_its_gap_leads_no_parameter_astray(seeds, places):
    truth = axis(backlash={"gap": 0.01, "load_share": 0.35})
    records = [
        logged(truth, kp, 2.0, seed=seed, setup=Setup(place=place), reference=[0.1, 0.0], duration=0.6)
        for kp, seed, place in zip((20.0, 30.0), seeds, places, strict=True)
    ]
    fit = servolens.fit(effects_of(truth, 1.2), records)
    assert misses(fit, truth) == {}
    assert_at_noise(fit)
    assert [np.sin(0.5 * np.pi * start[2]) for start in fit.refinement.starts] == pytest.approx(places, abs=0.01)


@pytest.mark.parametrize(("hertz", "noise"), [(1.0, 1e-4), (10.0, 1e-6)])
@pytest.mark.parametrize("phase", [0.0, 0.18, 0.6])
def test_log_cut_out_of_a_motion_begins_with_its_own_velocity(hertz, noise, phase):
    """Truth: the exact recursion of a linear axis whose voltage is held; the log begins within the motion."""
    beta, c, h, before = 1.9, 6.0, 1e-3, 3000 + round(phase * 1e3 / hertz)
    time = h * np.arange(before + 2000)
    voltage = 8.0 * np.sin(2.0 * np.pi * hertz * time)
    decay = np.exp(-c * h)
    y, v = np.zeros(time.size), np.zeros(time.size)
    for k in range(time.size - 1):
        steady = beta * voltage[k] / c
        v[k + 1] = steady + (v[k] - steady) * decay
        y[k + 1] = y[k] + steady * h + (v[k] - steady) * (1.0 - decay) / c
    rng = np.random.default_rng(round(1e3 * phase))
    record = Record(
        time=time[: time.size - before],
        position=y[before:] + rng.normal(scale=noise, size=2000),
        voltage=voltage[before:],
        reference=y[before:],
    )
    fit = servolens.fit([], record, driven="voltage")
    assert fit.rms_error < 1.1 * noise
    assert fit.plant.gain == pytest.approx(beta, rel=5e-3)
    assert fit.plant.damping == pytest.approx(c, rel=1e-2)


def test_effects_keep_the_order_in_which_they_were_asked_for():
    truth = axis(cogging=TRUTHS["cogging"], return_spring=TRUTHS["return_spring"])
    fit = servolens.fit(effects_of(truth, 1.5), campaign(truth))
    assert [effect.name for effect in fit.plant.effects] == ["cogging", "return_spring"]


def test_speed_servo_sets_the_gain_which_has_no_error_of_its_own():
    truth = axis(speed_servo=TRUTHS["speed_servo"])
    fit = servolens.fit(effects_of(truth, 1.5), campaign(truth))
    servo = fit.plant.effect("speed_servo")
    assert isinstance(servo, SpeedServo)
    assert fit.plant.gain == servo.speed_per_volt * servo.proportional
    assert fit.quantities["gain"].stderr is None
    assert fit.quantities["gain"].reason == "it follows from other parameters"


# --- parameters of each record's own, outliers, what is known beforehand


PHASES = (0.4, 1.9, -2.2, 2.9)


def disturbed() -> list[Record]:
    """Return runs of a machine whose neighbour was somewhere else in its turn each time."""
    hum = {"amplitude": 0.3, "frequency": 3.3}
    return [
        logged(axis(periodic_disturbance={**hum, "phase": phase}), 60.0, reference=(0.1, 0.0), seed=k)
        for k, phase in enumerate(PHASES)
    ]


def test_phase_may_differ_between_records():
    guess = [PeriodicDisturbance(amplitude=0.45, frequency=3.0, phase=0.0)]
    fit = servolens.fit(guess, disturbed(), local=("periodic_disturbance.phase",))
    assert miss(fit, "periodic_disturbance.amplitude", 0.3) < FAR
    assert miss(fit, "periodic_disturbance.frequency", 3.3) < FAR
    assert_at_noise(fit)
    found = fit.refinement.local["periodic_disturbance.phase"]
    width = fit.quantities["periodic_disturbance.phase"].stderr
    assert width is not None
    assert np.abs((found - PHASES + np.pi) % (2 * np.pi) - np.pi).max() < FAR * width


@pytest.mark.slow
def test_one_phase_for_records_that_differ_does_not_reach_the_noise():
    fit = servolens.fit([PeriodicDisturbance(amplitude=0.45, frequency=3.3, phase=0.4)], disturbed())
    assert not fit.at_noise


def test_lost_readings_spoil_squares_and_not_the_huber_loss():
    truth = axis(coulomb_friction={"level": 0.35})
    records = []
    for k, record in enumerate(campaign(truth)):
        lost = np.random.default_rng(k).random(len(record)) < 0.02
        records.append(record.with_({"position": np.where(lost, 0.0, record.position)}))
    squares, huber = (servolens.fit([CoulombFriction(level=0.5)], records, loss=loss) for loss in ("squares", "huber"))
    assert misses(huber, truth) == {}
    errors = [abs(fit.plant.effect("coulomb_friction").level - 0.35) for fit in (squares, huber)]
    widths = [fit.quantities["coulomb_friction.level"].stderr for fit in (squares, huber)]
    assert errors[0] > 5 * errors[1]
    assert widths[0] > 5 * widths[1]


def test_held_parameter_stays_as_given_and_the_others_suffer_for_it():
    truth = axis(stribeck_friction=TRUTHS["stribeck_friction"])
    records = campaign(truth)
    right, wrong = (
        servolens.fit(
            [StribeckFriction(level=0.4, static_excess=0.3, stribeck_speed=speed)],
            records,
            fixed=("stribeck_friction.stribeck_speed",),
        )
        for speed in (0.025, 0.1)
    )
    for fit, speed in ((right, 0.025), (wrong, 0.1)):
        quantity = fit.quantities["stribeck_friction.stribeck_speed"]
        assert (quantity.value, quantity.stderr, quantity.reason) == (speed, None, "given, not estimated")
    assert miss(right, "stribeck_friction.level", 0.25) < FAR
    assert miss(right, "stribeck_friction.static_excess", 0.2) < FAR
    assert miss(wrong, "stribeck_friction.level", 0.25) > FAR
    assert wrong.rms_error > right.rms_error


@pytest.mark.parametrize("driven", ["voltage", "closed_loop"])
def test_fit_of_which_every_parameter_is_held_only_evaluates(driven):
    truth = axis(coulomb_friction={"level": 0.3})
    record, plant = logged(truth), plant_of(truth)
    held = servolens.fit(plant, record, fixed=tuple(plant.parameters), driven=driven)
    assert held.plant == plant
    assert {quantity.reason for quantity in held.quantities.values()} == {"given, not estimated"}
    assert held.at_noise
    assert not held.correlations
    wrong = servolens.fit(plant, record, fixed={name: 0.5 * value for name, value in plant.named.items()})
    assert wrong.rms_error > 100.0 * held.rms_error
    with pytest.raises(InputError, match=r"those are none$"):
        profile(held, "gain")


def test_profile_of_the_only_parameter_that_was_fitted_is_the_parabola_of_its_standard_error():
    truth = axis(coulomb_friction={"level": 0.3})
    plant = plant_of(truth)
    found = servolens.fit(plant, logged(truth), fixed=("gain", "damping"))
    quantity = found.quantities["coulomb_friction.level"]
    interval = profile(found, "coulomb_friction.level").interval
    assert interval == pytest.approx(quantity.interval, abs=0.3 * quantity.stderr)


def test_prior_as_good_as_the_data_pulls_half_of_the_way():
    record = logged(axis(coulomb_friction={"level": 0.35}))
    free = servolens.fit([CoulombFriction(level=0.5)], record).quantities["coulomb_friction.level"]
    known = Prior(value=free.value + 4 * free.stderr, deviation=free.stderr)
    both = servolens.fit([CoulombFriction(level=0.5)], record, priors={"coulomb_friction.level": known})
    found = both.quantities["coulomb_friction.level"]
    # error bars of the data are estimates, good to some percent
    assert found.value == pytest.approx(free.value + 2 * free.stderr, abs=0.4 * free.stderr)
    assert found.stderr == pytest.approx(free.stderr / np.sqrt(2), rel=0.2)


def test_tight_prior_holds():
    record = logged(axis(coulomb_friction={"level": 0.35}))
    tight = {"coulomb_friction.level": Prior(value=0.4, deviation=1e-7)}
    fit = servolens.fit([CoulombFriction(level=0.5)], record, priors=tight)
    assert fit.quantities["coulomb_friction.level"].value == pytest.approx(0.4, abs=1e-6)


LAGS = axis(actuator_lag={"time_constant": 0.006}, sensor_lag={"time_constant": 0.004})


LAG_GUESS = [ActuatorLag(time_constant=0.008), SensorLag(time_constant=0.002)]


def test_lags_of_actuator_and_sensor_are_not_told_apart_by_a_linear_axis():
    fit = servolens.fit(LAG_GUESS, campaign(LAGS, setup=Setup(rest=0.05)))
    assert_at_noise(fit)
    message = codes(fit)["strongly_correlated"]
    assert "actuator_lag.time_constant and sensor_lag.time_constant are correlated at -1.000" in message
    assert fit.quantities["actuator_lag.time_constant"].stderr > 5e-3 * 0.006


def test_prior_makes_separable_what_the_data_do_not_separate():
    known = {"sensor_lag.time_constant": Prior(value=0.004, deviation=1e-6)}
    fit = servolens.fit(LAG_GUESS, campaign(LAGS, setup=Setup(rest=0.05)), priors=known)
    assert misses(fit, LAGS) == {}
    assert fit.quantities["actuator_lag.time_constant"].stderr < 5e-4 * 0.006


# --- what is logged


STICKY = axis(coulomb_friction={"level": 0.35})


@pytest.mark.parametrize(
    ("changes", "options", "driven"),
    [
        ({}, {"driven": "closed_loop"}, "closed_loop"),
        ({}, {"driven": "voltage"}, "voltage"),
        ({"reference": None, "controller": None}, {}, "voltage"),
        ({"reference": None}, {}, "voltage"),
        ({"voltage": None}, {"driven": "closed_loop"}, "closed_loop"),
        ({"voltage": None}, {}, "voltage"),
    ],
    ids=[
        "all, in closed loop",
        "all, by the voltage",
        "voltage alone",
        "gains and voltage",
        "no voltage, in closed loop",
        "no voltage, reckoned from the law",
    ],
)
def test_friction_is_found_from_what_is_logged(changes, options, driven):
    """In closed loop to a permille: what the controller makes of the noise pushes the axis, unseen by the model."""
    fit = servolens.fit([CoulombFriction(level=0.5)], [r.with_(changes) for r in campaign(STICKY)], **options)
    assert fit.driven == driven
    np.testing.assert_allclose(fit.plant.values, plant_of(STICKY).values, rtol=1e-3)
    if driven == "voltage":
        assert misses(fit, STICKY) == {}


def test_arm_in_radians_is_fitted_in_radians():
    arm = Truth(gain=40.0, damping=8.0, effects={"pendulum_gravity": {"amplitude": 30.0, "phase": 0.5}})
    records = [
        logged(arm, kp, 0.5, reference=(1.0, -0.5), seed=k, setup=Setup(length_unit="rad"))
        for k, kp in enumerate((8.0, 16.0))
    ]
    fit = servolens.fit([PendulumGravity(amplitude=45.0, phase=0.75)], records)
    assert misses(fit, arm) == {}
    assert_at_noise(fit)
    units = {name: quantity.unit for name, quantity in fit.quantities.items()}
    assert units == {
        "gain": "rad/s^2/V",
        "damping": "1/s",
        "pendulum_gravity.amplitude": "rad/s^2",
        "pendulum_gravity.phase": "rad",
    }


def test_command_in_amperes_keeps_its_unit():
    fit = servolens.fit([CoulombFriction(level=0.5)], [logged(STICKY, setup=Setup(command_unit="A"))])
    assert fit.quantities["gain"].unit == "m/s^2/A"
    assert misses(fit, STICKY) == {}


def test_records_of_different_sample_rates_are_fitted_together():
    records = [logged(STICKY, 60.0, seed=k, sample_time=h) for k, h in enumerate((5e-4, 1e-3, 3e-3))]
    fit = servolens.fit([CoulombFriction(level=0.5)], records)
    assert misses(fit, STICKY) == {}
    assert_at_noise(fit)


def test_what_was_fitted_is_named():
    records = [record.with_({"name": f"run {k}"}) for k, record in enumerate(campaign(STICKY))]
    fit = servolens.fit([CoulombFriction(level=0.5)], records)
    assert fit.model.identified_from == ("run 0", "run 1")
    assert fit.noise == pytest.approx(SCATTER, rel=0.1)


# --- what is compared, and where the log begins


def test_compared_voltage_shows_what_a_stiff_loop_hides_in_its_position():
    truth = axis(cogging={"amplitude": 0.25, "pitch": 0.024, "phase": 0.7})
    ramp = 0.15 * np.clip(np.arange(1600) * 1e-3 - 0.1, 0.0, None)
    rig = Setup(controller=Controller(kp=3000.0, kd=40.0, derivative_filter=0.2), trajectory=ramp)
    records = [logged(truth, setup=rig)]
    guess = [Cogging(amplitude=0.4, pitch=0.024, phase=0.5)]
    fit = servolens.fit(guess, records, compared="voltage")
    assert misses(fit, truth) == {}
    assert fit.driven == "closed_loop"
    # the command is the noise times kp, and what the filtered derivative makes of it
    assert fit.rms_error > 3000.0 * SCATTER


def sliced() -> tuple[Record, ...]:
    """Return logs that begin in the middle of a motion."""
    loops = [Controller(kp=kp, kd=4.0, derivative_filter=0.1) for kp in (60.0, 90.0)]
    whole = [
        logged(STICKY, reference=(0.1, 0.0), seed=10 + k, setup=Setup(controller=loop)) for k, loop in enumerate(loops)
    ]
    return tuple(record.slice(0.85, 1.6) for record in whole)


def test_log_that_begins_in_motion_is_fitted_from_its_own_initial_state():
    options = {"begin": "motion", "driven": "closed_loop"}
    moving = servolens.fit([CoulombFriction(level=0.5)], sliced(), **options)
    assert misses(moving, STICKY) == {}
    assert moving.at_noise
    resting = servolens.fit([CoulombFriction(level=0.5)], sliced(), **{**options, "begin": "rest"})
    assert resting.rms_error > 10 * moving.rms_error


@pytest.mark.parametrize(
    "controller",
    [
        Controller(kp=60.0, kd=4.0, derivative_filter=0.1),
        Controller(kp=60.0, kd=4.0, derivative_window=5),
        Controller(kp=60.0, kd=4.0, derivative_filter=0.3, control_period=2e-3),
    ],
    ids=["filter", "window", "slower loop"],
)
def test_history_of_the_controller_is_read_off_the_logged_voltage(controller):
    record = logged(STICKY, setup=Setup(controller=controller)).slice(0.05, 0.5)
    without, with_it = controller_voltage(record), controller_voltage(with_history(record))
    np.testing.assert_allclose(with_it, record.voltage, rtol=0, atol=2e-3 * np.abs(without - record.voltage).max())
    assert np.abs(without - record.voltage).max() > 0.1
    assert np.array_equal(without[200:], with_it[200:])


def test_history_adds_to_a_feedforward_and_needs_a_voltage():
    dither = 0.1 * np.sin(np.arange(801))
    rig = Setup(controller=Controller(kp=60.0, kd=4.0, derivative_filter=0.5), feedforward=dither)
    record = logged(STICKY, setup=rig).slice(0.05, 0.5)
    np.testing.assert_allclose(controller_voltage(with_history(record)), record.voltage, atol=1e-3)
    silent = record.with_({"voltage": None})
    assert with_history(silent) is silent


# --- how well it is known


@pytest.fixture(scope="module")
def friction_fit() -> Fit:
    return servolens.fit([CoulombFriction(level=0.5)], campaign(STICKY))


@pytest.mark.parametrize("name", ["gain", "damping", "coulomb_friction.level"])
def test_profile_of_a_well_determined_fit_is_the_parabola_of_its_standard_error(friction_fit, name):
    found, quantity = profile(friction_fit, name), friction_fit.quantities[name]
    assert found.interval == pytest.approx(quantity.interval, abs=0.2 * quantity.stderr)
    off = (found.values - quantity.value) / quantity.stderr
    np.testing.assert_allclose(found.excess, off**2, rtol=0.15, atol=0.1)
    assert np.all(np.diff(found.values) > 0)


def test_profile_honours_priors():
    record = logged(STICKY)
    free = servolens.fit([CoulombFriction(level=0.5)], record).quantities["coulomb_friction.level"]
    known = {"coulomb_friction.level": Prior(value=free.value, deviation=0.5 * free.stderr)}
    both = servolens.fit([CoulombFriction(level=0.5)], record, priors=known)
    for name in both.quantities:
        quantity = both.quantities[name]
        assert profile(both, name).interval == pytest.approx(quantity.interval, abs=0.3 * quantity.stderr)
    low, high = profile(both, "coulomb_friction.level").interval
    assert high - low < 0.6 * (free.interval[1] - free.interval[0])


def test_profile_honours_the_robust_loss():
    """With squares, lost readings would widen it hundreds of times."""
    records = []
    for k, record in enumerate(campaign(STICKY)):
        lost = np.random.default_rng(k).random(len(record)) < 0.02
        records.append(record.with_({"position": np.where(lost, 0.0, record.position)}))
    fit = servolens.fit([CoulombFriction(level=0.5)], records, loss="huber")
    quantity = fit.quantities["coulomb_friction.level"]
    assert profile(fit, "coulomb_friction.level").interval == pytest.approx(
        quantity.interval, abs=0.4 * quantity.stderr
    )


def test_bootstrap_of_slow_noise_scatters_as_its_error_bars_say():
    fit = servolens.fit([CoulombFriction(level=0.5)], coloured(campaign(STICKY)))
    expected = [fit.quantities[name].stderr for name in ("gain", "damping", "coulomb_friction.level")]
    np.testing.assert_allclose(bootstrap(fit, repeats=40, seed=3).stderr, expected, rtol=4 / np.sqrt(2 * 40))


def test_bootstrap_of_a_well_determined_fit_agrees_with_its_standard_errors(friction_fit):
    found = bootstrap(friction_fit, repeats=80, seed=5)
    assert found.names == ("gain", "damping", "coulomb_friction.level")
    assert found.failed == 0
    expected = [friction_fit.quantities[name].stderr for name in found.names]
    np.testing.assert_allclose(found.stderr, expected, rtol=4 / np.sqrt(2 * 80))
    means = found.values.mean(axis=0)
    assert np.all(
        np.abs(means - [friction_fit.quantities[n].value for n in found.names]) < 4 * found.stderr / np.sqrt(80)
    )
    low, high = found.intervals.T
    np.testing.assert_allclose((high - low) / 2, 1.96 * np.array(expected), rtol=0.5)


def test_bootstrap_repeats_with_its_seed(friction_fit):
    first, again, other = (bootstrap(friction_fit, repeats=2, seed=seed).values for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


@pytest.mark.xfail(strict=True, reason="its lower end is 0.023 V off; before within 0.02 V")
def test_profile_shows_that_a_limit_never_reached_has_no_upper_end():
    """The voltage is 5 V at most: a limit below is refuted, one above is not."""
    truth = Truth(gain=GAIN, damping=DAMPING, effects={"saturation": {"limit": 5.0}})
    record = logged(truth, 50.0, setup=Setup(rest=0.05))
    fit = servolens.fit([Saturation(limit=6.0)], record)
    low, high = profile(fit, "saturation.limit").interval
    assert high is None
    assert low is not None
    assert low == pytest.approx(5.0, abs=0.02)
    assert codes(fit)["not_determined"] == "saturation.limit is not seen by these records, which do not reach it."
    assert fit.quantities["saturation.limit"].reason == "the records do not reach it"


# --- doubts


def codes(fit: Fit) -> dict[str, str]:
    return {finding.code: finding.message for finding in fit.findings}


def test_well_determined_fit_leaves_no_doubt(friction_fit):
    assert friction_fit.findings == ()


def test_parameter_at_its_bound_is_named_and_has_no_error_bar():
    """Damping that falls with speed pushes a drag that grows with it to 0."""
    truth = axis(velocity_decay_damping={"alpha1": 16.0, "alpha2": 12.0})
    fit = servolens.fit([QuadraticDrag(drag=1.0)], campaign(truth))
    assert fit.quantities["quadratic_drag.drag"].value == 0.0
    assert codes(fit)["at_bound"] == ("quadratic_drag.drag ended at the end of its range, 0; it has no error bar.")
    assert fit.quantities["quadratic_drag.drag"].stderr is None
    assert fit.quantities["quadratic_drag.drag"].reason == "it ended at the end of its range"


def test_parameter_is_said_to_be_undetermined_where_it_is_smaller_than_its_error():
    """A force that is not there is found to be 0, give or take its error."""
    smaller, said = [], []
    for seed in range(6):
        fit = servolens.fit([ConstantForce(acceleration=0.2)], logged(LM1, 60.0, seed=seed))
        quantity = fit.quantities["constant_force.acceleration"]
        smaller.append(abs(quantity.value) < quantity.stderr)
        said.append("the data hardly determine constant_force.acceleration" in codes(fit).get("not_determined", ""))
    assert said == smaller
    assert len({*said}) == 2


def test_two_of_which_only_the_sum_is_known_are_named():
    twins = [QuadraticDrag(drag=1.0), Windage(sail=2.0)]
    fit = servolens.fit(twins, campaign(axis(quadratic_drag={"drag": 2.5})))
    named = [finding.message for finding in fit.findings if finding.code == "not_determined"]
    assert len(named) == 2
    assert named[0].startswith("the data do not determine quadratic_drag.drag")
    assert named[1].startswith("the data do not determine windage.sail")
    assert fit.plant.values[2] + fit.plant.values[3] == pytest.approx(2.5, rel=0.01)


GRAVITY = ("pendulum_gravity.amplitude", "pendulum_gravity.phase")


def test_parameters_that_the_data_hardly_tell_apart_are_named():
    """Over 0.15 rad a pendulum's gravity is a spring and a constant force, which amplitude and phase share.

    Their estimates are as much correlated in little noise, where both are known to a part in ten thousand.
    """
    truth = axis(pendulum_gravity={"amplitude": 1.2, "phase": 0.4})
    sure, fit = (servolens.fit(effects_of(truth, 1.5), campaign(truth, noise=noise)) for noise in (NOISE, 300 * NOISE))
    assert all(sure.quantities[name].stderr < 2e-4 * sure.quantities[name].value for name in GRAVITY)
    assert sure.correlations[GRAVITY] < -0.98
    assert "strongly_correlated" not in codes(sure)
    message = codes(fit)["strongly_correlated"]
    assert "pendulum_gravity.amplitude and pendulum_gravity.phase are correlated at" in message
    assert message.endswith("fix one, give a prior, or log a run that moves them differently.")


def test_search_that_did_not_end_says_so():
    runs = closed_runs([logged(STICKY)], FitOptions())
    start = Plant(gain=1.0, damping=3.0, effects=(CoulombFriction(level=0.5),))
    stopped = minimise_error(start, runs, FitOptions(), noise=SCATTER, allowance=1.0)
    assert [finding.code for finding in findings_of(stopped)][:1] == ["not_converged"]
    assert "the refinement stopped before its optimum." in {finding.message for finding in findings_of(stopped)}


# --- effects of other people


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Windage(Force):
    """Drag by air, as a user would write it."""

    name = "windage"
    sentence = "A sail drags."
    latex = r"s\,v\,|v|"

    sail: float = parameter("s", "1/{x}", "drag of the sail")

    @staticmethod
    def physics(seen: Axis, p: Any) -> Any:
        return p.sail * seen.velocity * seen.speed


def test_effect_of_a_user_is_fitted_as_one_of_the_catalogue_and_read_back(tmp_path):
    truth = axis(quadratic_drag={"drag": 2.5})
    records = campaign(truth)
    fit, same = servolens.fit([Windage(sail=4.0)], records), servolens.fit([QuadraticDrag(drag=4.0)], records)
    assert miss(fit, "windage.sail", 2.5) < FAR
    assert_at_noise(fit)
    assert fit.quantities["windage.sail"].value == pytest.approx(same.quantities["quadratic_drag.drag"].value, rel=1e-6)
    path = tmp_path / "model.json"
    path.write_text(json.dumps({"schema": "servolens.model/1", **fit.model.to_json()}, allow_nan=False))
    assert read_model(path, effects=[Windage]).plant == fit.plant
    with pytest.raises(InputError, match="there is no effect 'windage'"):
        read_model(path)


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Install a package of a user, for the time of a test."""
    (tmp_path / "sails.py").write_text(
        "from dataclasses import dataclass\n"
        "from servolens.effects import Force, parameter\n"
        "@dataclass(frozen=True, slots=True, kw_only=True)\n"
        "class Sail(Force):\n"
        "    name, sentence, latex = 'sail', 'A sail drags.', 's v |v|'\n"
        "    size: float = parameter('s', '1/{x}', 'size')\n"
        "    @staticmethod\n"
        "    def physics(axis, p):\n"
        "        return p.size * axis.velocity * axis.speed\n"
    )
    info = tmp_path / "sails-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: sails\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[servolens.effects]\nsail = sails:Sail\nmast = sails:Sail\nkeel = sails:Keel\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    offered.cache_clear()
    yield
    offered.cache_clear()


@pytest.mark.usefixtures("installed")
def test_effect_of_an_installed_package_is_found_by_its_name(tmp_path):
    cls = effect_class("sail")
    record = logged(axis(quadratic_drag={"drag": 2.5}))
    fit = servolens.fit([cls(size=4.0)], record)
    assert miss(fit, "sail.size", 2.5) < FAR
    path = tmp_path / "model.json"
    path.write_text(json.dumps({"schema": "servolens.model/1", **fit.model.to_json()}, allow_nan=False))
    assert read_model(path).plant == fit.plant


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("mast", "sails:Sail is no effect called 'mast'"),
        ("keel", "the effect 'keel' of sails:Keel does not load: "),
    ],
)
def test_entry_point_that_keeps_no_promise_is_refused(name, sentence):
    with pytest.raises(InputError, match=sentence):
        effect_class(name)


# --- refusals


def still(**changes: Any) -> Record:
    return logged(LM1, 60.0).with_(changes)


REFUSED: dict[str, tuple[Any, str]] = {
    "nothing": (lambda: servolens.fit([], []), "no record was given; at least one is needed"),
    "metres and radians": (
        lambda: servolens.fit([], [still(), still(length_unit="rad")]),
        "records in m and rad cannot be used together; convert one of them",
    ),
    "volts and amperes": (
        lambda: servolens.fit([], [still(), still(command_unit="A")]),
        "records in A and V cannot be used together; convert one of them",
    ),
    "held stranger": (
        lambda: servolens.fit([Delay(time=1e-3)], still(), fixed=("mass",)),
        r"'mass' is no parameter of this model; those are gain, damping, delay\.time",
    ),
    "local stranger": (
        lambda: servolens.fit([], still(), local=("delay.time",)),
        r"'delay\.time' is no parameter of this model; those are gain, damping",
    ),
    "prior on a stranger": (
        lambda: servolens.fit([], still(), priors={"mass": Prior(value=1.0, deviation=1.0)}),
        "'mass' is no parameter of this model; those are gain, damping",
    ),
    "loop without reference": (
        lambda: servolens.fit([], still(reference=None, name="run 7"), driven="closed_loop"),
        "run 7: closing the loop needs reference, kp and kd",
    ),
    "loop without gains": (
        lambda: servolens.fit([], still(controller=None), driven="closed_loop"),
        "closing the loop needs reference, kp and kd",
    ),
    "voltages compared without a loop": (
        lambda: servolens.fit([], still(controller=None), compared="voltage"),
        "closing the loop needs reference, kp and kd",
    ),
    "voltages compared without any": (
        lambda: servolens.fit([], still(voltage=None), compared="voltage"),
        "no voltage is logged, so it cannot be compared; compare the position",
    ),
    "voltage driven and compared": (
        lambda: servolens.fit([], still(), driven="voltage", compared="voltage"),
        "a run that is driven by the voltage cannot be compared by it; choose driven='closed_loop'",
    ),
    "gain held": (
        lambda: servolens.fit([], still(), fixed=("gain",)),
        r"gain has no value to be fixed at; write fixed=\{'gain': value\}, or give a Plant",
    ),
    "prior on a gain that a servo sets": (
        lambda: servolens.fit(
            effects_of(axis(speed_servo=TRUTHS["speed_servo"])), still(), priors={"gain": Prior(value=1, deviation=1)}
        ),
        "gain follows from other parameters of this model; ask it of those",
    ),
    "unknown loss": (
        lambda: servolens.fit([], still(), loss="hubber"),
        "loss must be one of squares, huber; got 'hubber'",
    ),
    "unknown drive": (
        lambda: servolens.fit([], still(), driven="open"),
        "driven must be one of auto, closed_loop, voltage; got 'open'",
    ),
    "unknown comparison": (
        lambda: servolens.fit([], still(), compared="force"),
        "compared must be one of position, voltage; got 'force'",
    ),
    "unknown begin": (
        lambda: servolens.fit([], still(), begin="late"),
        "begin must be one of rest, motion; got 'late'",
    ),
    "no motion": (
        lambda: servolens.fit([], still(position=np.zeros(801))),
        "the axis does not move more than its noise; log a step that moves it by many encoder steps",
    ),
    "prior without a width": (
        lambda: Prior(value=1.0, deviation=0.0),
        "a prior needs a finite value and a positive standard deviation, got float 1.0 and float 0.0",
    ),
}


@pytest.mark.parametrize(("ask", "sentence"), REFUSED.values(), ids=REFUSED)
def test_bad_input_is_refused_with_a_sentence(ask, sentence):
    with pytest.raises(InputError, match=sentence):
        ask()


def test_profile_of_what_was_not_fitted_is_refused(friction_fit):
    sentence = (
        r"'mass' is no parameter that was fitted for all records; those are gain, damping, coulomb_friction\.level"
    )
    with pytest.raises(InputError, match=sentence):
        profile(friction_fit, "mass")
    held = servolens.fit([CoulombFriction(level=0.35)], friction_fit.records, fixed=("coulomb_friction.level",))
    with pytest.raises(InputError, match=r"'coulomb_friction\.level' is no parameter .* those are gain, damping$"):
        profile(held, "coulomb_friction.level")


def test_bootstrap_of_one_repeat_is_refused(friction_fit):
    with pytest.raises(InputError, match="repeats must be a whole number of at least 2, got int 1"):
        bootstrap(friction_fit, repeats=1, seed=0)


def test_start_that_cannot_be_simulated_is_a_numerical_failure():
    runs = closed_runs([logged(LM1, 60.0)], FitOptions())
    with pytest.raises(
        NumericalError, match="the plant to start from cannot be simulated on these records: its loop is"
    ):
        minimise_error(Plant(gain=1e9, damping=0.0), runs, FitOptions(), noise=SCATTER)


def test_start_that_is_not_worth_its_time_is_a_numerical_failure():
    stiff = FlexibleCoupling(frequency=300.0, damping_ratio=0.1, load_ratio=0.3)
    plant = Plant(gain=GAIN, damping=DAMPING, effects=(stiff,))
    likelihood = Likelihood([logged(LM1, 60.0)], plant, FitOptions())
    likelihood.most_substeps = 1.0
    with pytest.raises(NumericalError, match="the plant to start from cannot be simulated on these records"):
        likelihood.led(plant, likelihood.white, 1)


# --- coverage


REPEATS = 60


@pytest.mark.slow
def test_intervals_hold_the_truth_about_as_often_as_they_say():
    """Of 60 intervals of 95 % fewer than 88 %, 53, hold the truth once in fifty studies."""
    runs = [
        step_records(STICKY, kp, kd, repeats=REPEATS, seed=4711 + k, reference=levels, duration=0.8, noise=NOISE)
        for k, (kp, kd, levels) in enumerate(RUNS)
    ]
    held: dict[str, list[bool]] = {"gain": [], "damping": [], "coulomb_friction.level": []}
    for records in zip(*runs, strict=True):
        fit = servolens.fit([CoulombFriction(level=0.5)], records)
        for name, true in zip(held, plant_of(STICKY).values, strict=True):
            held[name].append(miss(fit, name, true) < 1.96)
    shares = {name: float(np.mean(inside)) for name, inside in held.items()}
    assert {name: share for name, share in shares.items() if not 0.88 <= share <= 1.0} == {}


def test_data_sheet_outweighs_what_a_model_gets_wrong():
    truth = Truth(gain=GAIN, damping=DAMPING, effects={"delay": {"time": 0.03}, "coulomb_friction": {"level": 0.3}})
    records = [step_record(truth, kp=kp, noise=NOISE, seed=kp) for kp in (40, 80)]
    known = Prior(value=DAMPING, deviation=0.1)
    free = servolens.fit([CoulombFriction(level=0.3)], records)
    led = servolens.fit([CoulombFriction(level=0.3)], records, priors={"damping": known})
    assert abs(free.plant.damping - DAMPING) > 5 * known.deviation
    assert abs(led.plant.damping - DAMPING) < 2 * known.deviation


def test_initial_state_that_shows_nowhere_stays_where_it_is():
    class Blind(OneByOne):
        """A run whose second initial state changes nothing."""

        group, samples, sample_time, start, shifts = 0, 50, 1e-3, np.zeros(2), (1e-6, 1e-6)

        def missed(self, plant, start, substeps):
            return plant.gain * np.linspace(0.0, 1.0, 50) + start[0] - np.linspace(0.1, 0.2, 50)

        residual = missed

    found = minimise_error(Plant(gain=1.0, damping=0.0), [Blind()], FitOptions(held=("damping",)), noise=1e-6)
    assert found.plant.gain == pytest.approx(0.1, abs=1e-9)
    assert found.starts[0][1] == 0.0


# --- bounds


def test_parameter_stays_within_its_bounds_and_says_that_it_ended_there():
    fit = servolens.fit([CoulombFriction(level=0.3)], logged(STICKY), bounds={"gain": (2.0, 3.0)})
    assert fit.plant.gain == pytest.approx(2.0)
    assert "gain ended at the end of its range" in " ".join(finding.message for finding in fit.findings)


def test_bounds_that_are_no_range_or_of_no_parameter_are_refused():
    with pytest.raises(InputError, match=r"bounds of gain must be a least and a larger value; got 3.0 and 2.0"):
        servolens.fit([], logged(STICKY), bounds={"gain": (3.0, 2.0)})
    with pytest.raises(InputError, match="mass"):
        servolens.fit([CoulombFriction(level=0.3)], logged(STICKY), bounds={"mass": (1.0, 2.0)})


def test_an_inertia_that_takes_a_parameter_out_of_its_range_is_no_start():
    """A fit from such a start ended in an error."""
    servo = SpeedServo(speed_per_volt=0.1, proportional=0.001, integral=1.0)
    others = list(of_other_inertias(Plant(gain=1.0, damping=6.0, effects=(servo,))))
    assert [plant.effects[0].proportional for plant in others] == [0.002, 0.004, 0.008]
    assert servolens.fit([servo], logged(STICKY)).plant.effects[0].proportional >= 0.001
