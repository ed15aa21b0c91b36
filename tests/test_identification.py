"""Identification on the virtual laboratory's carts and against plain least squares."""

from __future__ import annotations

import pickle
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binom

from servolens import solving
from servolens.design import PDSpec, tune
from servolens.diagnosis import diagnose
from servolens.effects import CATALOGUE, CoulombFriction, VelocityDecayDamping
from servolens.errors import InputError, NumericalError
from servolens.identification import Prior, identify, velocity
from servolens.identification.explained import Explained
from servolens.identification.integral import Pieces, assemble, solve_integral
from servolens.identification.later import Later
from servolens.identification.options import FitOptions
from servolens.identification.refine import Refinement, minimise_error
from servolens.identification.regressors import regressor
from servolens.identification.runs import ClosedRun
from servolens.identification.segments import motion_segments, settled_steps
from servolens.identification.varying import fit_varying, piece_duration
from servolens.lab import (
    LM1,
    LM3,
    NLM1,
    NLM2,
    NLM3,
    WORLDS,
    Setup,
    Truth,
    step_record,
    step_records,
    surroundings,
    table_one,
)
from servolens.lab.laws import ARRAYS, LAWS, Instant
from servolens.plant import Plant
from servolens.prediction import predict
from servolens.record import Controller, Record
from servolens.report.figures import varying_position
from servolens.simulation import simulate
from servolens.simulation.rates import rate_of
from servolens.summaries import identification_summary


def plant_of(truth: Truth) -> Plant:
    effects = [Plant.effect_from(name, values) for name, values in truth.effects.items()]
    return Plant(gain=truth.gain, damping=truth.damping, effects=tuple(effects))


@pytest.mark.parametrize("free", [None, 2.0])
def test_samples_of_a_motor_that_is_off_do_not_bias_gain_and_damping(free):
    """The command goes on while the motor is off, and moves nothing."""
    truth = Plant(gain=1.9, damping=6.0, free_damping=free)
    time = 1e-3 * np.arange(1500.0)
    asked = Record(
        name="off",
        time=time,
        position=0.0 * time,
        reference=np.full(time.size, 0.1),
        controller=Controller(kp=60.0, kd=1.0),
        enabled=((time < 0.06) | (time >= 0.15)).astype(float),
    )
    run = simulate(truth, asked)
    noise = np.random.default_rng(3).normal(0.0, 1e-5, time.size)
    found = identify(asked.with_({"position": run.position + noise, "voltage": run.voltage}), model="constant").model
    for name, true in (("gain", 1.9), ("damping", 6.0)):
        quantity = found.quantities[name]
        assert quantity.value == pytest.approx(true, rel=0.01)
        assert abs(quantity.value - true) < 4.0 * quantity.stderr


@pytest.mark.parametrize(
    "law",
    [
        {"kd": 5.0, "velocity_feedforward": 8.0},
        {"kd": 5.0, "derivative_on": "error"},
        {"velocity_feedforward": 8.0},
    ],
    ids=["damped and fed forward", "derivative of the error", "fed forward alone"],
)
def test_an_axis_that_nothing_draws_to_its_reference_is_found(law):
    """Its law has no proportional part, of which the rate of a loop is known elsewhere."""
    turns = 2.0 * np.pi * 1e-3 * np.arange(1500.0)
    rig = Setup(trajectory=0.1 * np.sin(turns) + 0.03 * np.sin(2.7 * turns), controller=Controller(kp=0.0, **law))
    runs = [step_record(LM1, duration=1.5, noise=1e-5, seed=seed, setup=rig) for seed in (1, 2)]
    for model in (identify(runs, model="constant").model, diagnose(runs, effort="quick").model):
        for name, true in (("gain", LM1.gain), ("damping", LM1.damping)):
            quantity = model.quantities[name]
            assert quantity.value == pytest.approx(true, rel=1e-3)
            assert abs(quantity.value - true) < 4.0 * quantity.stderr


@pytest.mark.parametrize("truth", [LM1, LM3], ids=["Lm1", "Lm3"])
def test_noise_free_linear_cart_is_found_to_four_digits(truth: Truth) -> None:
    fit = identify(step_record(truth, 60.0, encoder=0.0), model="constant").model.plant
    assert fit.gain == pytest.approx(truth.gain, rel=1e-4)
    assert fit.damping == pytest.approx(truth.damping, rel=1e-4)


@pytest.mark.parametrize("kd", [0.0, 5.0])
@pytest.mark.parametrize("duration", [0.5, 0.9, 3.0])
def test_linear_cart_behind_a_coarse_encoder_is_found_to_three_permille(kd: float, duration: float) -> None:
    fit = identify(step_record(LM1, 60.0, kd, encoder=25e-6, duration=duration), model="constant").model.plant
    assert fit.gain == pytest.approx(LM1.gain, rel=3e-3)
    assert fit.damping == pytest.approx(LM1.damping, rel=3e-3)


def test_virtual_cart_at_kp_60_shows_the_paper_s_rising_damping() -> None:
    varying = identify(step_record(NLM1, 60.0, encoder=25e-6), model="varying").varying
    assert varying is not None
    assert varying.gain == pytest.approx(1.9165, rel=3e-3)
    assert np.all(np.diff(varying.damping) > 0)
    assert varying.damping[0] == pytest.approx(6.0, abs=0.3)
    assert varying.damping[-1] > 12.0
    assert np.diff(varying.edges)[0] == pytest.approx(0.15, abs=0.003)


def test_what_is_judged_when_asked_for_is_the_same_before_and_after_pickling() -> None:
    record = step_record(NLM3, 100.0, duration=0.8, encoder=1e-5, noise=1e-5, seed=1)
    found, again = (identify(record, model="varying") for _ in range(2))
    kept = pickle.loads(pickle.dumps(found))
    assert kept.findings == again.findings == found.findings
    assert kept.errors.keys() == again.errors.keys() == {"varying"}
    np.testing.assert_array_equal(kept.varying.covariance, again.varying.covariance)  # type: ignore[union-attr]  # asked
    assert (np.diag(kept.varying.covariance) > 0.0).all()


def test_what_is_made_later_is_made_once() -> None:
    made: list[int] = []
    later = Later(lambda: made.append(1) or len(made))
    assert not made
    assert (later.value, later.value, made) == (1, 1, [1])


@pytest.mark.parametrize("duration", [0.7, 0.9, 3.0])
def test_gain_of_the_varying_model_does_not_hang_on_noise_or_length(duration: float) -> None:
    records = step_records(NLM1, 60.0, repeats=6, seed=314, noise=1e-5, encoder=25e-6, duration=duration)
    gains = [identify(record, model="varying").varying.gain for record in records]  # type: ignore[union-attr]  # asked
    np.testing.assert_allclose(gains, 1.9165, rtol=3e-3)


@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_a_true_law_is_never_said_to_fall_short(noise: float) -> None:
    record = step_record(NLM1, 60.0, noise=noise, encoder=0.0, seed=24 if noise else None)
    fit = identify(record)
    assert "beyond_the_law" not in {finding.code for finding in fit.findings}
    assert len(fit.varying.damping) <= 10  # type: ignore[union-attr]  # model="all"


def test_a_short_record_without_room_for_pieces_still_gives_models() -> None:
    record = step_record(NLM1, 60.0, encoder=1e-5, duration=1.0).resample(0.02)
    fit = identify(record.slice(0.0, 0.3))
    assert fit.velocity is not None


def test_three_carts_of_the_paper_agree_on_the_gain() -> None:
    gains = [
        identify(step_record(truth, kp, encoder=25e-6), model="varying").varying.gain  # type: ignore[union-attr]  # asked for
        for truth, kp in ((NLM1, 60.0), (NLM2, 80.0), (NLM3, 100.0))
    ]
    assert max(gains) / min(gains) < 1.01


@pytest.fixture(scope="module")
def nlm3_fit():
    return identify(step_record(NLM3, 100.0, encoder=1e-5, noise=1e-5, seed=77))


def test_one_record_gives_the_nonlinear_plant(nlm3_fit) -> None:
    plant = nlm3_fit.velocity.plant
    assert plant.gain == pytest.approx(NLM3.gain, rel=5e-4)
    assert plant.damping == pytest.approx(NLM3.damping, rel=3e-3)
    spec = PDSpec(kp=100.0, settling_time=0.5)
    assert tune(plant, spec).kd == pytest.approx(tune(plant_of(NLM3), spec).kd, abs=0.02)


def test_velocity_model_predicts_the_eight_gain_pairs_ten_times_better(nlm3_fit) -> None:
    table = predict(
        {"constant": nlm3_fit.constant.plant, "velocity": nlm3_fit.velocity.plant},
        table_one(NLM3, 5, noise=1e-5, encoder=1e-5),
    )
    constant, velocity = table.average_percent
    assert velocity <= 0.1 * constant


def test_the_route_through_pieces_costs_more_than_the_direct_fit(nlm3_fit) -> None:
    spec = PDSpec(kp=100.0, settling_time=0.5)
    true = tune(plant_of(NLM3), spec).kd
    pieces, direct = tune(nlm3_fit.law_from_pieces, spec).kd, tune(nlm3_fit.velocity.plant, spec).kd
    assert abs(pieces - true) > 10 * abs(direct - true)


def test_several_records_narrow_the_intervals() -> None:
    records = [step_record(NLM1, kp, noise=2e-5, seed=i) for i, kp in enumerate((60.0, 80.0, 100.0))]
    one, three = identify(records[0]).velocity, identify(records).velocity
    assert one is not None
    assert three is not None
    for name, quantity in three.quantities.items():
        assert quantity.stderr < one.quantities[name].stderr
        assert abs(quantity.value - dict(zip(three.plant.parameters, plant_of(NLM1).values, strict=True))[name]) < (
            5 * quantity.stderr
        )


def test_a_linear_cart_shows_no_velocity_dependence() -> None:
    fit = identify(step_record(LM1, 60.0, noise=1e-5, seed=3))
    assert "no_velocity_dependence" in {finding.code for finding in fit.findings}
    shape = fit.velocity.quantities["velocity_decay_damping.alpha2"]  # type: ignore[union-attr]  # model="all"
    assert shape.stderr is None
    assert shape.reason


# --- the machinery -------------------------------------------------------------------------------------------------


def plain_columns(segment, edges: list[int]) -> np.ndarray:
    """The global form of the equation, column by column, held voltage and trapezoids on a fine enough record."""
    t, y, v = segment.time, segment.position, segment.voltage
    h = np.diff(t)
    single = np.concatenate([[0.0], np.cumsum(h * v[:-1])])
    double = np.concatenate([[0.0], np.cumsum(h * single[:-1] + 0.5 * h**2 * v[:-1])])
    slope = np.gradient(y, t, edge_order=2)
    columns = [np.ones_like(t), t]
    for first, stop in pairwise(edges):
        last = min(stop, y.size - 1)
        rate = np.zeros_like(y)
        rate[first:last] = 0.5 * h[first:last] * (y[first:last] + y[first + 1 : last + 1] - 2 * y[first])
        rate[first:last] -= h[first:last] ** 2 / 12 * (slope[first + 1 : last + 1] - slope[first:last])
        area = np.concatenate([[0.0], np.cumsum(rate[:-1])])
        columns.append(-(area + np.where(t > t[last], (t - t[last]) * (y[last] - y[first]), 0.0)))
    return np.column_stack([*columns, double])


@pytest.mark.parametrize("edges", [[0], [0, 150, 300, 450, 600, 750], [0, 77, 401]], ids=["one", "six", "uneven"])
def test_factor_of_the_pieces_equals_plain_least_squares(edges: list[int]) -> None:
    segment = motion_segments([step_record(NLM1, 60.0, encoder=0.0, duration=0.9)])[0]
    edges = [*edges, segment.time.size]
    share = Pieces(edges=np.array(edges), groups=np.arange(len(edges) - 1))
    ours = solve_integral(assemble([segment], [share], window=1)).x
    columns = plain_columns(segment, edges)
    scale = np.abs(columns).max(axis=0)
    plain = np.linalg.lstsq(columns / scale, segment.position, rcond=None)[0] / scale
    np.testing.assert_allclose(ours, plain[2:], rtol=1e-8)


def test_long_records_are_cut_without_changing_the_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    segments = motion_segments([step_record(LM1, 60.0, noise=1e-5, seed=1)])
    whole = solve_integral(assemble(segments)).x
    monkeypatch.setattr("servolens.identification.integral.LONGEST_PIECE", 97)
    np.testing.assert_allclose(solve_integral(assemble(segments)).x, whole, rtol=1e-9)


@pytest.mark.parametrize("encoder", [0.039, 0.02, 1e-5])
def test_a_trajectory_turns_round_where_the_axis_moves_back_and_not_where_its_encoder_steps(encoder):
    """Each step of a coarse encoder was taken for a reversal, and each stretch was too short."""
    time = 2e-3 * np.arange(930)
    there_and_back, loop = 1.0 - np.abs(2.0 * time / time[-1] - 1.0), Controller(kp=1.66, kd=0.0247)
    setup = Setup(controller=loop, trajectory=there_and_back)
    axis, ways = Truth(gain=625.0, damping=16.8), {"sample_time": 2e-3, "noise": 1e-4, "duration": time[-1]}
    there, back = motion_segments([step_record(axis, encoder=encoder, seed=3, setup=setup, **ways)])
    assert there.stop == pytest.approx(465, rel=0.1) == back.first
    assert there.first < 60
    assert back.stop > 900


def test_constraint_of_the_paper_holds_and_is_named() -> None:
    segments = motion_segments([step_record(NLM3, 100.0, encoder=25e-6, duration=0.9)])
    free = fit_varying(segments, duration=0.05)
    assert np.min(np.diff(free.damping)) < -0.5
    held = fit_varying(segments, duration=0.05, delta=0.5)
    assert np.min(np.diff(held.damping)) >= -0.5 - 1e-9
    drops = np.flatnonzero(np.diff(held.damping) < -0.5 + 1e-9)
    assert held.active == tuple(f"c{i + 1} − c{i + 2} < 0.5" for i in drops)


@settings(max_examples=20, deadline=None)
@given(delta=st.floats(-1.0, 3.0), duration=st.floats(0.03, 0.2))
def test_ordering_holds_for_any_data_and_delta(delta: float, duration: float) -> None:
    segments = motion_segments([step_record(NLM2, 80.0, encoder=25e-6, duration=0.9)])
    held = fit_varying(segments, duration=duration, delta=delta)
    assert np.min(np.diff(held.damping), initial=np.inf) >= -delta - 1e-7 * np.abs(held.damping).max()


@pytest.mark.parametrize("plugin", ["daqp", "qrqp", "highs"])
def test_program_with_loose_constraints_equals_plain_least_squares(plugin: str) -> None:
    segments = motion_segments([step_record(NLM1, 60.0, encoder=25e-6)])
    factor = assemble(segments, [Pieces(edges=np.array([0, 300, segments[0].time.size]), groups=np.arange(2))])
    size = factor.shape[0] - 1
    rows, loose = np.eye(size), np.full(size, 1e6)
    free = np.linalg.solve(factor[:size, :size], factor[:size, size])
    white = rows @ np.linalg.inv(factor[:size, :size])
    solver = solving._conic(size, size, plugin)
    found = solver(h=np.eye(size), a=white, lba=-loose - free, uba=loose - free)
    moved = np.linalg.solve(factor[:size, :size], np.asarray(found["x"]).ravel())
    np.testing.assert_allclose(free + moved, solve_integral(factor).x, rtol=1e-8)


@pytest.mark.parametrize("dwell", [0.2, 0.3])
def test_steps_that_do_not_settle_are_not_taken_for_rests(dwell: float) -> None:
    record = step_record(LM1, 60.0, noise=1e-5, seed=1, reference=(0.1, 0.0, 0.1, 0.0), duration=dwell)
    start = Plant(gain=1.8, damping=6.0)
    runs = [ClosedRun(step, 0) for step in settled_steps(record)]
    found = minimise_error(start, runs, FitOptions(), noise=1e-5).plant
    assert found.gain == pytest.approx(LM1.gain, rel=1e-3)
    assert found.damping == pytest.approx(LM1.damping, rel=1e-3)


def test_varying_damping_needs_no_reference_and_survives_lost_samples() -> None:
    record = step_record(NLM1, 60.0, noise=1e-5, seed=2, encoder=25e-6)
    whole = identify(record, model="varying").varying
    silent = identify(record.with_({"reference": None, "controller": None}), model="varying").varying
    assert whole is not None
    assert silent is not None
    assert silent.gain == pytest.approx(whole.gain, rel=3e-3)
    keep = np.ones(len(record), dtype=bool)
    keep[300:330] = False
    signals = {name: getattr(record, name)[keep] for name in ("time", "position", "reference", "voltage")}
    gapped = identify(record.with_(signals), model="varying").varying
    assert gapped is not None
    assert gapped.gain == pytest.approx(whole.gain, rel=2e-2)


@pytest.mark.slow
def test_friction_and_an_unknown_limit_leave_a_passive_law() -> None:
    truth = Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.4}, "saturation": {"limit": 4.0}})
    for dwell in (0.25, 1.5):
        record = step_record(truth, 60.0, noise=1e-5, seed=1, reference=(0.1, 0.0, 0.1), duration=dwell)
        plant = identify(record, model="velocity").model.plant
        assert plant.gain > 0
        assert plant.damping >= 0


def test_a_law_that_cannot_be_simulated_on_whole_records_is_fitted_to_stretches(monkeypatch) -> None:
    """Beside an observer a law may be found, of a spring with play, whose simulation of a whole record diverges."""

    def unstable(self: Explained, records: tuple[Record, ...]) -> None:
        raise NumericalError("the plant to start from cannot be simulated on these records: its loop is unstable")

    record = step_record(LM1, kp=60, noise=1e-5, seed=1)
    gain = identify(record).velocity.plant.gain
    monkeypatch.setattr(Explained, "optimum", unstable)
    assert identify(record).velocity.plant.gain == pytest.approx(gain, rel=0.01)


def test_a_start_whose_loop_is_unstable_leaves_the_others(monkeypatch) -> None:
    begun = []

    def first_unstable(start: Plant, *args: Any, **options: Any) -> Refinement:
        begun.append(start)
        if len(begun) == 1:
            raise NumericalError("the plant to start from cannot be simulated on these records: its loop is unstable")
        return minimise_error(start, *args, **options)

    dry = Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.3}})
    monkeypatch.setattr(velocity, "minimise_error", first_unstable)
    model = identify(step_record(dry, kp=60, noise=1e-5, seed=1)).velocity
    assert len(begun) > 1
    assert model.plant.gain == pytest.approx(1.9, rel=0.1)


def test_a_prior_on_the_velocity_model_adds_its_information_once() -> None:
    record = step_record(NLM1, 60.0, noise=1e-4, encoder=0.0, seed=4)
    free = identify(record, model="velocity").model.quantities["gain"].stderr
    assert free is not None
    for ratio in (0.5, 0.1):
        held = identify(record, model="velocity", priors={"gain": Prior(value=1.9165, deviation=ratio * free)})
        expected = (1 / free**2 + 1 / (ratio * free) ** 2) ** -0.5
        assert held.model.quantities["gain"].stderr == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize("name", [name for name in LAWS if name in CATALOGUE and regressor(CATALOGUE[name]).sizes])
def test_columns_are_the_force_per_unit_of_each_size(name: str) -> None:
    random = np.random.default_rng(1)
    time, position, velocity = 3.0 * np.sort(random.random(2501)), *random.standard_normal((2, 2501))
    values = {spec.name: float(0.3 + random.random()) for spec in CATALOGUE[name].parameters()}
    law, effect = LAWS[name], regressor(CATALOGUE[name])
    instant = Instant(position, velocity, np.abs(velocity), np.sign(velocity), time)
    assert law.function is not None
    force = law.function(instant, SimpleNamespace(**values), ARRAYS) + np.zeros(2501)
    columns = effect.columns(time, position, velocity, *(values[shape] for shape in effect.shapes))
    assert columns.shape == (len(effect.sizes), 2501)
    found = np.array([values[size] for size in effect.sizes]) @ columns
    np.testing.assert_allclose(found, force * (np.sign(velocity) if law.kind == "friction" else 1.0), atol=1e-12)


def test_sizes_are_found_from_the_force_itself() -> None:
    assert regressor(CoulombFriction).sizes == ("level",)
    assert regressor(VelocityDecayDamping).sizes == ("alpha1",)
    assert regressor(VelocityDecayDamping).shapes == ("alpha2",)


def test_units_rescale_parameters_and_nothing_else() -> None:
    record = step_record(NLM1, 60.0, noise=1e-5, seed=4)
    scaled = record.with_({"position": record.position * 1e3, "reference": record.reference * 1e3})
    scaled = scaled.with_({"encoder_resolution": 1e-2, "controller": None})
    one, other = identify(record).velocity, identify(scaled).velocity
    assert one is not None
    assert other is not None
    assert other.plant.gain == pytest.approx(one.plant.gain * 1e3, rel=1e-6)
    assert other.plant.damping == pytest.approx(one.plant.damping, rel=1e-5)
    assert other.plant.effects[0].alpha2 == pytest.approx(one.plant.effects[0].alpha2 / 1e3, rel=1e-4)  # type: ignore[attr-defined]  # the law


def test_a_shift_of_time_changes_nothing() -> None:
    record = step_record(NLM1, 60.0, noise=1e-5, seed=4)
    later = record.with_({"time": record.time + 12.0})
    one, other = identify(record).model.plant.values, identify(later).model.plant.values
    np.testing.assert_allclose(other, one, rtol=1e-6)


def test_the_voltage_is_reconstructed_where_it_is_not_logged() -> None:
    logged = step_record(NLM1, 60.0, 2.0, noise=1e-5, seed=4)
    silent = step_record(NLM1, 60.0, 2.0, noise=1e-5, seed=4, setup=Setup(log_voltage=False))
    one, other = identify(logged), identify(silent)
    np.testing.assert_allclose(other.model.plant.values, one.model.plant.values, rtol=1e-7)
    assert "voltage_reconstructed" in {f.code for f in other.findings}


def test_a_rest_before_the_step_and_square_waves_do_not_disturb() -> None:
    record = step_record(NLM1, 60.0, noise=1e-5, seed=8, reference=(0.1, 0.0, 0.1), setup=Setup(rest=0.5))
    fit = identify(record).velocity
    assert fit is not None
    for value, stderr, true in zip(
        fit.plant.values, np.sqrt(np.diag(fit.covariance)), plant_of(NLM1).values, strict=True
    ):
        assert abs(value - true) < 4 * stderr


def test_a_prior_pulls_and_narrows() -> None:
    record = step_record(LM1, 60.0, noise=2e-4, seed=4, duration=0.2)
    free = identify(record, model="constant").model
    priors = {"gain": Prior(value=LM1.gain, deviation=1e-4)}
    held = identify(record, model="constant", priors=priors).model
    assert held.quantities["gain"].stderr <= 1e-4
    assert abs(held.plant.gain - LM1.gain) < abs(free.plant.gain - LM1.gain)


def test_node_rule_is_half_the_interval_between_velocity_zeros() -> None:
    segments = motion_segments([step_record(LM1, 60.0, encoder=1e-6)])
    half_period = np.pi / np.sqrt(LM1.gain * 60.0 - LM1.damping**2 / 4)
    assert piece_duration(segments) == pytest.approx(half_period / 2, rel=0.02)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"model": "cubic"}, "model must be 'all'"),
        (
            {"priors": {"mass": Prior(value=1.0, deviation=1.0)}},
            "'mass' is no parameter of this model; those are gain, damping",
        ),
        ({"delta": -1.0}, "delta must be a number of at least 0"),
        ({"piece": 9.0}, "a piece must last between"),
        ({"piece": 0.001}, "would be"),
    ],
)
def test_wrong_use_is_one_sentence(arguments: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        identify(step_record(LM1, 60.0), **arguments)


def test_a_prior_without_width_is_refused() -> None:
    with pytest.raises(InputError, match="positive standard deviation"):
        Prior(value=1.0, deviation=0.0)


def test_no_record_and_no_motion_are_refused() -> None:
    with pytest.raises(InputError, match="no record was given"):
        identify([])
    still = step_record(LM1, 60.0).with_({"position": np.zeros(1501)})
    with pytest.raises(InputError, match="does not move more than its noise"):
        identify(still)


def test_record_of_a_few_samples_is_refused_as_that() -> None:
    run = step_record(LM1, 60.0)
    short = [replace(run.slice(0.0, 0.001 * last), name=f"run {last}") for last in (4, 6)]
    with pytest.raises(InputError, match="run 4: the record has 5 samples; at least 20 are needed"):
        identify(short[0])
    with pytest.raises(InputError, match="run 4, run 6: none of the records has more than 7 samples; at least 20"):
        identify(short)


# --- coverage -------------------------------------------------------------------------------------------------------


REPEATS = 24
FEWEST = int(binom.ppf(1e-3, REPEATS, 0.9))
"""Intervals that hold the truth, at least, if nine of ten do; fewer in one of a thousand tests."""


@pytest.mark.parametrize(
    "world", [pytest.param(w, marks=pytest.mark.slow) if w in ("hum", "repeated") else w for w in WORLDS]
)
def test_intervals_hold_the_truth_in_every_world(world: str) -> None:
    rate = float(np.sqrt(LM1.gain * 60.0))
    true = np.array([LM1.gain, LM1.damping])
    inside = np.zeros(2)
    for seed in range(31_000, 31_000 + REPEATS):
        around = surroundings(world, seed, rate=rate, damping=LM1.damping)
        records = [step_record(LM1, 60.0, duration=1.0, seed=seed, setup=Setup(surroundings=around))]
        found = identify(records, model="constant").model
        inside += np.abs(np.array(found.plant.values) - true) <= 1.959964 * np.sqrt(np.diag(found.covariance))
    assert np.all(inside >= FEWEST)


@pytest.mark.parametrize("world", ["white", "coloured", "coarse"])
def test_intervals_of_the_pieces_hold_a_constant_damping(world: str) -> None:
    shares = []
    for seed in range(32_000, 32_000 + REPEATS):
        around = surroundings(world, seed)
        varying = identify(
            step_record(LM1, 60.0, duration=1.0, seed=seed, setup=Setup(surroundings=around)), model="varying"
        ).varying
        assert varying is not None
        reach = 1.959964 * np.sqrt(np.diag(varying.covariance))
        shares.append(np.mean(np.abs(np.append(varying.damping - LM1.damping, varying.gain - LM1.gain)) <= reach))
    assert np.mean(shares) >= FEWEST / REPEATS


@pytest.mark.slow
def test_intervals_of_the_pieces_are_about_what_the_fit_gives_without_noise() -> None:
    usual = {"duration": 1.0, "encoder": 0.0}
    clean = fit_varying(motion_segments([step_record(NLM1, 60.0, **usual)]), duration=0.15)
    shares = []
    for seed in range(REPEATS):
        noisy = identify(step_record(NLM1, 60.0, noise=1e-5, seed=seed, **usual), model="varying", piece=0.15).varying
        assert noisy is not None
        reach = 1.959964 * np.sqrt(np.diag(noisy.covariance))
        shares.append(np.mean(np.abs(np.append(noisy.damping - clean.damping, noisy.gain - clean.gain)) <= reach))
    assert np.mean(shares) >= FEWEST / REPEATS


def test_a_law_that_does_not_explain_the_records_says_so() -> None:
    rubbing = Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.4}})
    fit = identify(step_record(rubbing, 60.0, noise=1e-5, seed=1), model="velocity")
    finding = next(finding for finding in fit.findings if finding.code == "beyond_the_law")
    assert "do not rely on these intervals" in finding.message.lower()


def test_figure_and_number_of_the_varying_model_are_of_one_residual() -> None:
    record = step_record(NLM1, 60.0, noise=1e-5, seed=8, reference=(0.1, 0.0), setup=Setup(rest=0.3))
    fit = identify(record)
    drawn = varying_position(fit.varying, record) - record.position  # type: ignore[arg-type]  # model="all"
    assert fit.errors["varying"][0].rms_error == pytest.approx(np.sqrt(np.mean(drawn**2)), rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("truth", "kp", "kd", "model"),
    [(LM1, 60.0, 0.0, "constant"), (NLM3, 100.0, 0.0, "velocity"), (NLM1, 80.0, 5.0, "velocity")],
    ids=["linear cart", "NLm3", "NLm1 with derivative"],
)
def test_intervals_of_95_percent_cover_in_93_to_97_percent(truth: Truth, kp: float, kd: float, model: str) -> None:
    records = step_records(truth, kp, kd, repeats=1000, seed=20261121, noise=1e-5, encoder=1e-5, duration=1.0)
    true = np.array(plant_of(truth).values)
    inside = np.zeros(true.size)
    for record in records:
        found = identify(record, model=model).model  # type: ignore[arg-type]  # one of the names
        inside += np.abs(np.array(found.plant.values) - true) <= 1.959964 * np.sqrt(np.diag(found.covariance))
    assert np.all(inside / len(records) >= 0.93)
    assert np.all(inside / len(records) <= 0.97)


def test_a_prior_far_from_the_data_is_named() -> None:
    record = step_record(NLM1, 60.0, noise=1e-5, seed=4)
    wrong = identify(record, priors={"gain": Prior(value=2.5, deviation=1e-4)})
    assert "prior_contradicts_data" in {finding.code for finding in wrong.findings}
    right = identify(record, priors={"gain": Prior(value=1.9, deviation=0.05)})
    assert "prior_contradicts_data" not in {finding.code for finding in right.findings}


def test_law_that_the_data_do_not_determine_is_not_told_as_if_they_did() -> None:
    fit = identify(step_record(NLM3, kp=60, noise=1e-5, seed=1))
    assert any("the midpoint is at" in sentence for sentence in identification_summary(fit).sentences)
    assert fit.velocity is not None
    assert fit.velocity.covariance is not None
    vague = replace(fit, velocity=replace(fit.velocity, covariance=1e8 * fit.velocity.covariance))
    told = identification_summary(vague).sentences
    assert any("alpha1 is not significantly different from zero" in sentence for sentence in told)
    assert not any("the midpoint is at" in sentence for sentence in told)


def test_pieces_of_which_the_data_determine_none_make_no_table() -> None:
    fit = identify(step_record(NLM3, kp=60, noise=1e-5, seed=1))
    titles = [table.title for table in identification_summary(fit).tables]
    assert "Damping that varies in time" in titles
    assert fit.varying is not None
    vague = replace(fit.varying, spread=Later(lambda: 1e9 * np.eye(fit.varying.damping.size + 1)))
    titles = [table.title for table in identification_summary(replace(fit, varying=vague)).tables]
    assert "Damping that varies in time" not in titles


def test_prior_is_combined_with_records_on_which_no_law_of_damping_can_be_simulated() -> None:
    friction = {"asymmetric_friction": {"level_positive": 0.8, "level_negative": 0.3}}
    axis = Truth(gain=2.2, damping=5.0, effects=friction)
    record = step_record(
        axis,
        kp=50,
        kd=2,
        reference=[0.2, 0.0, -0.2, 0.1],
        duration=4.0,
        sample_time=4e-3,
        noise=5e-5,
        encoder=1e-4,
        seed=1,
    )
    model = identify(record, model="constant", priors={"gain": (2.2, 0.01)}).constant
    assert model.plant.gain == pytest.approx(2.2, abs=0.03)


def test_damping_at_rest_grows_no_faster_than_samples_show() -> None:
    """Beside a dead zone it grew until it died out in a twentieth of a sample, which took long to simulate."""
    axis = Truth(gain=1.9, damping=6.0, effects={"dead_zone": {"width": 0.2}})
    records = [
        step_record(axis, kp, 8.0, reference=[0.1, 0.0, 0.1], duration=0.8, noise=1e-6, seed=seed)
        for seed, kp in enumerate((60, 120))
    ]
    plant = identify(records, model="velocity").plant
    assert rate_of(plant) * 1e-3 < 4.0
