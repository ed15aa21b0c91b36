"""Design for PID and cascade, hunting and feedforward, against python-control and the laboratory."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import control as ct
import numpy as np
import pytest
from click.testing import CliRunner

from servolens import lab
from servolens.cli import group
from servolens.design import (
    GainsFound,
    GainWishes,
    Hunting,
    Light,
    PDSpec,
    evaluate,
    feedforward,
    hunting,
    recommend,
    tracking,
    trust,
    tune,
)
from servolens.design.command_noise import command_noise, quiet
from servolens.design.margins import loop_margins
from servolens.design.plant_inverse import smooth_move
from servolens.effects import (
    Backlash,
    CoulombFriction,
    DeadZone,
    Delay,
    FlexibleCoupling,
    Presliding,
    Saturation,
    StribeckFriction,
)
from servolens.errors import InputError
from servolens.findings import Finding
from servolens.model import Model
from servolens.model_evidence import DataRange, Evidence, Remainder
from servolens.plant import Plant
from servolens.record import Controller
from servolens.study.lights import study_lights
from servolens.summaries import design_summary, gains_summary
from servolens.summaries.gains import asked_sentence

H = 1e-3
CART = Plant(gain=1.9, damping=6.0)
STRIBECK = {"level": 0.2, "static_excess": 0.3, "stribeck_speed": 0.01}
STICKY = CART.with_effect(StribeckFriction(**STRIBECK))
STICKY_TRUTH = lab.Truth(gain=1.9, damping=6.0, effects={"stribeck_friction": STRIBECK})
PID = PDSpec(kp=100, settling_time=0.6, ki=300, setpoint_weight=0.5, kd_max=30)
CASCADE = PDSpec(kp=20, settling_time=0.5, controller="cascade", kiv=60, kd_max=80)
SIGNAL = PDSpec(kp=100, settling_time=0.6, kd_max=30, derivative="velocity")


def closed_by_control(spec, gain):
    """The loop from reference to position as a state space of python-control."""
    total = ct.ss([[1.0]], [[1.0]], [[H]], [[H]], H)
    matrices = [[0.0, 1.0], [0.0, -6.0]], [[0.0], [1.9]]
    axis, speed = (ct.sample_system(ct.ss(*matrices, [row], [[0.0]]), H) for row in ([1.0, 0.0], [0.0, 1.0]))
    window, share = spec.derivative_window, spec.derivative_filter
    late = [1.0, *[0.0] * (window - 1), -1.0], [window * H, *[0.0] * window]
    filtered = ct.tf2ss([share, 0.0], [1.0, share - 1.0], dt=H)
    slope = filtered * ct.tf2ss(*late, dt=H)
    if spec.derivative == "velocity":
        answers = spec.kp * axis + gain * filtered * speed
        return axis * ct.feedback(ct.ss([], [], [], [[1.0]], H), answers) * spec.kp
    if spec.controller == "cascade":
        return ct.feedback(ct.feedback(axis * (gain + spec.kiv * total), slope) * spec.kp, 1)
    forward, back = spec.kp * spec.setpoint_weight + spec.ki * total, spec.kp + gain * slope + spec.ki * total
    return ct.feedback(axis, back) * forward


def meets_by_control(spec, gain):
    time = H * np.arange(round(10 * spec.settling_time / H))
    error = 1 - ct.forced_response(closed_by_control(spec, gain), time, np.ones(time.size)).outputs
    return np.abs(error[time >= spec.settling_time]).max() <= spec.band


@pytest.mark.parametrize(
    "spec",
    [PID, CASCADE, replace(PID, derivative_window=40, kd_max=25), replace(SIGNAL, derivative_filter=0.1)],
    ids=["pid", "cascade", "wide difference", "velocity signal"],
)
def test_intervals_are_those_of_a_scan_by_python_control(spec):
    design = tune(CART, spec)
    gains = np.linspace(0.2, spec.kd_max, 150)
    expected = np.array([meets_by_control(spec, gain) for gain in gains])
    assert expected.any()
    assert not expected.all()
    found = np.array([any(low <= gain <= high for low, high in design.intervals) for gain in gains])
    differs = np.flatnonzero(found != expected)
    edges = np.array(design.intervals).ravel()
    assert all(np.abs(edges - gains[i]).min() < 2 * design.certificate.gap for i in differs)
    below = design.kd - 2 * design.certificate.gap
    assert meets_by_control(spec, design.kd + design.certificate.gap)
    assert not meets_by_control(spec, below)


def test_gains_have_the_names_of_their_law():
    assert tune(CART, PID).to_json()["gains"].keys() == {"kp", "kd", "ki"}
    body = tune(CART, CASCADE).to_json()
    assert body["gains"] == {"kp": 20, "kv": body["kd"], "kiv": 60}
    assert body["free"] == "kv"


def test_search_of_a_cascade_ends_where_its_speed_loop_is_unstable():
    spec = PDSpec(kp=20, settling_time=0.5, controller="cascade", sample_time=0.01)
    top = tune(Plant(gain=1.9, damping=0.0), spec).spec.kd_max
    assert top == pytest.approx(2 / (1.9 * 0.01), rel=0.05)
    assert not evaluate(Plant(gain=1.9, damping=0.0), spec, 1.05 * top).stable


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"ki": -1.0}, "ki must be finite and not negative, got -1.0"),
        ({"ki": "x"}, "ki must be a number, got 'x'"),
        ({"kiv": 3.0}, "kiv is for a cascade only"),
        ({"controller": "cascade", "ki": 3.0}, "a cascade has no ki and no setpoint_weight"),
        ({"controller": "lqr"}, "controller must be 'pd' or 'cascade', got 'lqr'"),
        ({"anti_windup": "clamping"}, "anti_windup = clamping needs an integral"),
        ({"ki": 3.0, "control": "continuous"}, "control = continuous is the ideal PD"),
        ({"setpoint_weight": float("inf")}, "setpoint_weight must be finite"),
        ({"derivative": "speed"}, "derivative must be 'position' or 'velocity', got 'speed'"),
        ({"derivative_window": 1.5}, "derivative_window must be a whole number of samples, at least 1, got 1.5"),
        ({"derivative": "velocity", "control": "continuous"}, "control = continuous is the ideal PD"),
        (
            {"derivative": "velocity", "derivative_window": 3},
            "derivative_window = 3 is for differences of the position, and derivative = velocity has none",
        ),
    ],
)
def test_wrong_laws_of_a_spec_are_refused(fields, sentence):
    with pytest.raises(InputError) as refused:
        PDSpec(kp=100, settling_time=0.5, **fields)
    assert str(refused.value).startswith(sentence)


NO_SIGNAL_NOISE = "The noise of the velocity signal is not known and counts as none here."


def test_light_of_a_gain_on_a_velocity_signal_says_that_its_noise_counts_as_none():
    """The light was green, or named the noise of the position alone, and said nothing of it."""
    remainder = Remainder(
        rms=0.0,
        times_noise=1.0,
        of_travel=0.0,
        acceleration_rms=0.0,
        correlation_time=0.01,
        of_motor=0.0,
        depends_on_inputs=False,
        material=False,
    )
    evidence = Evidence(range=DataRange(voltage=12.0, speed=1.0, step=0.1), noise=1e-7, remainder=remainder)
    model = Model(plant=CART, covariance=np.diag([1e-8, 1e-8]), evidence=evidence)
    for spec, count in ((SIGNAL, 1), (replace(SIGNAL, derivative="position"), 0)):
        design = recommend(model, tune(CART, spec))
        light = trust(model, design)[1]
        assert light.sentence.count(NO_SIGNAL_NOISE) == count
        assert light.light == "green"
        told = design_summary(design, lights={"gain": light}).sentences
        assert sum(sentence.count(NO_SIGNAL_NOISE) for sentence in told) == count
        noisy = replace(model, evidence=replace(evidence, noise=0.02))
        assert command_noise([noisy], spec, 5.0).count(NO_SIGNAL_NOISE) == count


def test_asked_noise_gain_says_that_the_noise_of_a_velocity_signal_counts_as_none():
    assert NO_SIGNAL_NOISE in asked_sentence(replace(SIGNAL, noise_gain=200.0), "m", "V")
    assert NO_SIGNAL_NOISE not in asked_sentence(SIGNAL, "m", "V")


@pytest.mark.parametrize(
    ("fields", "phrase"),
    [
        ({}, "derivative_filter = 1"),
        ({"derivative_window": 3, "derivative_filter": 0.5}, "derivative_filter = 0.5, derivative_window = 3"),
        ({"derivative": "velocity"}, "derivative_filter = 1, derivative = velocity"),
    ],
)
def test_for_which_derivative_a_gain_is_computed_is_said_in_full(fields, phrase):
    """Window and signal were left out: a gain for a velocity signal seemed to be one for differences."""
    spec = PDSpec(kp=100, settling_time=0.6, kd_max=30, **fields)
    wrong = Finding(code="settings_contradict_log", severity="warning", message="another", record="run")
    good = Light(light="green", sentence="Good.")
    lights = study_lights(good, Model(plant=CART), tune(CART, spec), "", [wrong])
    assert f"kp = 100 V/m, {phrase} and a sample time of 1 ms" in lights["gain"].sentence
    found = GainsFound(
        spec=spec,
        wishes=GainWishes(),
        kd=5.0,
        margins=loop_margins([CART], spec, 5.0),
        voltage_noise=0.1,
        verified=(evaluate(CART, spec, 5.0),),
    )
    assert found.gains == {"kp": 100, "kd": 5.0, "derivative_filter": 1.0, **fields}
    told = gains_summary(found).sentences
    assert f"kd = 5 V s/m, {phrase}:" in told[0]
    assert (NO_SIGNAL_NOISE in told) == ("derivative" in fields)
    assert (phrase in asked_sentence(spec, "m", "V")) == bool(fields)


@pytest.mark.parametrize("spec", [PID, SIGNAL, PDSpec(kp=100, settling_time=0.6, derivative_window=2)])
def test_program_and_proof_are_for_pd_of_the_last_difference_only(spec):
    with pytest.raises(InputError, match="are for PD of the last difference only"):
        tune(CART, spec, certify=True)


def swing_of(record, seconds):
    """Amplitude and period of the last seconds of a log, by its extremes and its spectrum."""
    late = record.position[record.time > record.time[-1] - seconds]
    sides = np.sign(late - 0.5 * (late.max() + late.min()))
    rising = np.flatnonzero(np.diff(sides[sides != 0]) > 0)
    return 0.5 * np.ptp(late), float(np.mean(np.diff(rising))) * record.sample_time


def test_hunting_beside_stiction_has_the_amplitude_and_period_of_the_laboratory():
    spec = PDSpec(kp=100, settling_time=0.8, ki=400)
    found = hunting(STICKY, spec, 2.0)
    record = lab.step_record(
        STICKY_TRUTH, duration=25.0, encoder=0.0, setup=lab.Setup(controller=Controller(kp=100, kd=2, ki=400))
    )
    amplitude, period = swing_of(record, 15.0)
    assert found.share == 1.0
    assert found.amplitude == pytest.approx(amplitude, rel=0.02)
    assert found.period == pytest.approx(period, rel=0.02)


def test_a_wound_up_integral_hunts_as_in_the_laboratory_and_clamping_ends_it():
    spec = PDSpec(kp=100, settling_time=0.8, ki=800)
    limited = CART.with_effect(Saturation(limit=2.0))
    found = hunting(limited, spec, 3.0)
    truth = lab.Truth(gain=1.9, damping=6.0, effects={"saturation": {"limit": 2.0}})
    loop = Controller(kp=100, kd=3, ki=800)
    record = lab.step_record(
        truth, duration=40.0, encoder=0.0, setup=lab.Setup(controller=loop, start=0.1 + found.start)
    )
    swings = [np.ptp(part) / 2 for part in np.array_split(record.position, 5)]
    assert 0 < found.share < 1  # a small step does not show it
    assert swings == sorted(swings)  # it grows on, and so the longest run tells of the largest
    assert found.amplitude > swings[-1] > 0.5
    clamped = PDSpec(kp=100, settling_time=0.8, ki=800, anti_windup="clamping")
    assert hunting(limited, clamped, 3.0) is None


def test_hunting_of_lost_motion_is_that_of_the_laboratory():
    play = {"gap": 1e-3, "load_share": 0.3}
    found = hunting(CART.with_effect(Backlash(**play)), PDSpec(kp=100, settling_time=0.8), 0.5)
    truth = lab.Truth(gain=1.9, damping=6.0, effects={"backlash": play})
    record = lab.step_record(truth, duration=12.0, encoder=0.0, setup=lab.Setup(controller=Controller(kp=100, kd=0.5)))
    amplitude, period = swing_of(record, 6.0)
    assert found.amplitude == pytest.approx(amplitude, rel=0.05)
    assert found.period == pytest.approx(period, rel=0.05)


@pytest.mark.parametrize(
    ("plant", "spec"),
    [
        (CART, PDSpec(kp=100, settling_time=0.5)),
        (CART, PDSpec(kp=100, settling_time=0.5, ki=300)),
        (STICKY, PDSpec(kp=100, settling_time=0.5)),
        (CART.with_effect(CoulombFriction(level=0.2)), PDSpec(kp=100, settling_time=0.5, ki=400)),
    ],
    ids=["linear pd", "linear pid", "stiction without integral", "coulomb friction with integral"],
)
def test_what_comes_to_rest_does_not_hunt(plant, spec):
    assert hunting(plant, spec, 8.0) is None


def test_a_spec_that_forbids_hunting_is_given_gains_that_do_not():
    asked = {"kp": 100, "settling_time": 2.0, "ki": 400, "kd_max": 24}
    free, calm = (tune(STICKY, PDSpec(**asked, hunting=admitted)) for admitted in (True, False))
    assert free.hunting["least"] is not None
    assert calm.hunting["least"] is None
    assert calm.kd > free.kd
    assert all(any(a <= low and high <= b for a, b in free.intervals) for low, high in calm.intervals)

    def still_moves(kd):
        loop = Controller(kp=100, kd=kd, ki=400)
        record = lab.step_record(STICKY_TRUTH, duration=60.0, encoder=0.0, setup=lab.Setup(controller=loop))
        quarters = np.array_split(record.position, 4)
        return np.ptp(quarters[3]) > 0.9 * np.ptp(quarters[2]) > 1e-4

    assert still_moves(free.kd)
    assert not still_moves(calm.kd)


def test_a_spec_that_only_hunting_gains_meet_says_so():
    spec = PDSpec(kp=100, settling_time=0.8, ki=400, kd_max=10, hunting=False)
    design = tune(STICKY, spec)
    assert not design.feasible
    assert design.conflict == ("hunting",)
    assert "hunts from some starts" in design.reason
    assert re.search(r" by ±[\d.]+ [mµ]m\); choose less integral action, or admit hunting$", design.reason)


def test_a_loop_without_an_integral_that_hunts_is_not_told_to_integrate_less():
    """With half of the mass behind a play the loop hunts in it, whatever the derivative gain."""
    plant = Plant(gain=2.0, damping=12.0, effects=(Backlash(gap=1e-3, load_share=0.5),))
    design = tune(plant, PDSpec(kp=80, settling_time=0.4, band=0.02, kd_max=8, hunting=False))
    assert design.conflict == ("hunting",)
    assert re.search(r" by ±[\d.]+ [mµ]m\); choose a smaller kp, or admit hunting$", design.reason)


def test_a_gain_that_hunts_has_no_green_light():
    design = recommend(STICKY, tune(STICKY, PDSpec(kp=100, settling_time=0.8, ki=400, kd_max=10)), scenarios=20)
    assert design.hunting["recommended"] is not None
    _, light = trust(STICKY, design)
    assert light.light == "amber"
    assert "does not come to rest" in light.sentence
    assert "A spec with hunting=False seeks a gain with which it comes to rest." in design.summary().sentences


def test_feedforward_is_the_closed_form_of_gain_damping_and_friction():
    plant = CART.with_effect(CoulombFriction(level=0.4)).with_effect(DeadZone(width=0.2))
    time, reference = smooth_move(0.1, 0.5, H)
    s = np.clip((time + 0.5 * H) / 0.5, 0.0, 1.0)
    speed = 0.1 / 0.5 * 30 * s**2 * (1 - s) ** 2
    push = 0.1 / 0.25 * 60 * s * (1 - s) * (1 - 2 * s)
    moving = (s > 0.01) & (s < 0.99)
    force = (push + 6.0 * speed + 0.4) / 1.9
    expected = force + 0.2 * np.sign(force)
    found = feedforward(plant, time, reference)
    assert found[moving] == pytest.approx(expected[moving], abs=2e-3)
    frictionless = feedforward(plant, time, reference, friction=False, acceleration=False)
    assert frictionless[moving] == pytest.approx(6.0 * speed[moving] / 1.9 + 0.2, abs=2e-3)


@pytest.mark.parametrize(
    ("effects", "left"),
    [
        ({}, 1e-3),
        ({"stribeck_friction": STRIBECK, "dead_zone": {"width": 0.2}}, 1e-3),
        ({"delay": {"time": 0.004}}, 2e-3),
        ({"presliding": {"stiffness": 3000.0, "level": 0.3}}, 2e-2),
        ({"flexible_coupling": {"frequency": 20.0, "damping_ratio": 0.05, "load_ratio": 0.3}}, 2e-2),
    ],
    ids=["linear", "stiction and dead zone", "delay", "presliding", "coupling"],
)
def test_feedforward_takes_the_lag_from_the_axis_of_the_laboratory(effects, left):
    classes = {
        "stribeck_friction": StribeckFriction,
        "dead_zone": DeadZone,
        "delay": Delay,
        "presliding": Presliding,
        "flexible_coupling": FlexibleCoupling,
    }
    plant, truth = CART, lab.Truth(gain=1.9, damping=6.0, effects=effects)
    for name, values in effects.items():
        plant = plant.with_effect(classes[name](**values))
    loop = Controller(kp=100, kd=6)
    time, reference = smooth_move(0.1, 0.5, H)
    added = feedforward(plant, time, reference, controller=loop)

    def lag(voltage):
        record = lab.step_record(
            truth, encoder=0.0, setup=lab.Setup(controller=loop, trajectory=reference, feedforward=voltage)
        )
        return np.sqrt(np.mean((record.position - reference) ** 2))

    assert lag(added) < left * lag(None)
    found = tracking(plant, PDSpec(kp=100, settling_time=0.5), 6.0)
    assert found.without == pytest.approx(lag(None), rel=1e-3)
    assert found.with_it == pytest.approx(lag(added), rel=0.05, abs=5e-6)  # the delayed one began otherwise


def test_feedforward_keeps_the_limit_of_the_amplifier():
    time, reference = smooth_move(0.1, 0.1, H)
    limited = feedforward(CART.with_effect(Saturation(limit=5.0)), time, reference)
    assert np.abs(feedforward(CART, time, reference)).max() > 10
    assert np.abs(limited).max() == 5.0


def test_feedforward_of_a_cascade_tracks_too():
    found = tracking(CART, CASCADE, 8.0)
    assert found.with_it < 1e-3 * found.without


def test_feedforward_needs_a_trajectory():
    with pytest.raises(InputError, match="a reference of its size"):
        feedforward(CART, [0.0, 1.0], [0.0, 1.0])


def designed(folder, *options):
    done = CliRunner().invoke(group, ["design", model_file(folder), *options, "--json", "-"], prog_name="servolens")
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout), " ".join(done.stderr.split())


def model_file(folder):
    def quantity(value):
        return {"value": value}

    friction = {"effect": "stribeck_friction", "parameters": {k: quantity(v) for k, v in STRIBECK.items()}}
    body = {"schema": "servolens.model/1", "gain": quantity(1.9), "damping": quantity(6.0), "effects": [friction]}
    path = folder / "model.json"
    path.write_text(json.dumps(body), encoding="utf-8")
    return str(path)


def test_design_command_knows_pid_and_tells_of_hunting(tmp_path):
    options = ("--kp", "100", "--settling-time", "0.8", "--ki", "400", "--kd-max", "10")
    body, told = designed(tmp_path, *options)
    assert body["gains"] == {"kp": 100.0, "kd": body["kd"], "ki": 400.0}
    assert body["hunting"]["least"]["amplitude"] > 1e-4
    assert body["tracking"]["with_it"] < 0.01 * body["tracking"]["without"]
    assert "keeps swinging by" in told
    assert "Option --no-hunting seeks a gain" in told
    assert "a digital PID" in told


def test_design_command_knows_the_cascade_and_may_forbid_hunting(tmp_path):
    options = ("--cascade", "--kp", "20", "--settling-time", "0.8", "--kiv", "60", "--kd-max", "40", "--no-hunting")
    body, told = designed(tmp_path, *options)
    assert body["gains"].keys() == {"kp", "kv", "kiv"}
    assert body["hunting"] == {"least": None, "recommended": None}
    assert "kv = " in told


JOINT = Plant(
    gain=15.0,
    damping=2.0,
    effects=(FlexibleCoupling(frequency=14.0, damping_ratio=0.04, load_ratio=0.5), CoulombFriction(level=1.0)),
)


def test_a_gain_that_cannot_keep_the_overshoot_is_not_at_the_edge_of_what_is_stable():
    spec = PDSpec(kp=12, settling_time=0.9, band=0.05, reference=0.6)
    found = recommend(JOINT, tune(JOINT, spec), scenarios=20)
    (interval,) = found.intervals
    assert "no gain that is as safe keeps the overshoot" in found.recommended.why
    assert found.recommended.kd < 0.9 * interval[1]
    for size in (0.6, 1.2, 4.0):  # friction, which damps small swings, is little beside these
        larger = evaluate(JOINT.without_effect("coulomb_friction"), replace(spec, reference=size), found.recommended.kd)
        assert larger.stable
        assert abs(larger.final_error) < 0.05


@pytest.mark.parametrize(("start", "begun"), [(1.2, "1.2 m off the reference"), (0.0, "with a full integral")])
def test_a_gain_with_which_the_axis_runs_away_from_some_starts_is_withheld(start, begun):
    design = recommend(JOINT, tune(JOINT, PDSpec(kp=12, settling_time=0.9, band=0.05, reference=0.6)), scenarios=20)
    away = Hunting(amplitude=float("inf"), period=None, start=start, share=0.2)
    _, light = trust(JOINT, replace(design, hunting={"recommended": away}))
    assert light.light == "red"
    assert f"runs away if it begins {begun}" in light.sentence


RUBBED = Plant(gain=1.6, damping=1.0, effects=(Saturation(limit=6.0), CoulombFriction(level=0.4)))
SPEEDS = PDSpec(kp=14, settling_time=0.6, band=0.02, controller="cascade", kiv=120.0)


def known(plant, noise, voltage=28.0):
    """Return a model of records with so much noise, whose loops asked for so much voltage."""
    return Model(plant=plant, evidence=Evidence(range=DataRange(voltage=voltage, speed=5.0, step=0.1), noise=noise))


def swing(spec, gain, noise):
    """Return the r.m.s. of the command that white noise of the position makes of a loop at rest."""
    drawn = noise * np.random.default_rng(1).standard_normal(20_000)
    p = gain * spec.kp if spec.controller == "cascade" else spec.kp
    return float(np.std(p * drawn[1:] + gain * np.diff(drawn) / spec.sample_time))


def test_noise_does_not_fill_the_drive_where_another_gain_meets_the_spec():
    design = tune(RUBBED, SPEEDS)
    plain = recommend(RUBBED, design, scenarios=60)
    calm = recommend(known(RUBBED, 4e-6), design, scenarios=60).recommended
    assert swing(SPEEDS, plain.recommended.kd, 4e-6) > 2.0 > 0.6 > swing(SPEEDS, calm.kd, 4e-6)
    assert calm.worst.meets
    assert "no gain that is as safe, and with which noise leaves the command as quiet, keeps the overshoot" in calm.why
    _, light = trust(known(RUBBED, 4e-6), plain)
    assert light.light == "amber"
    assert "noise and rounding of the sensor, 4 µm, may move the command by" in light.sentence
    assert "% of what the drive gives; a filter" in light.sentence


def test_a_quiet_gain_that_overshoots_more_is_not_preferred_to_one_that_noise_moves_somewhat():
    axis, spec = Plant(gain=1.8, damping=4.0), PDSpec(kp=100, settling_time=0.5, band=0.1)
    design = tune(axis, spec)
    plain = recommend(known(axis, 1e-6), design, scenarios=60)
    noisy = recommend(known(axis, 5e-4), design, scenarios=60)
    assert 2.8 < swing(spec, plain.recommended.kd, 5e-4) < 28.0 / 3
    assert noisy.recommended.overshoot < 0.05
    assert [trust(known(axis, noise), one)[1].light for noise, one in ((1e-6, plain), (5e-4, noisy))] == [
        "green",
        "amber",
    ]


def test_an_ideal_continuous_loop_is_not_judged_by_white_noise():
    ideal, axis = replace(SPEEDS, controller="pd", kiv=0.0, control="continuous"), known(CART, 1.0)
    assert quiet([axis], ideal, [(0.0, 5.0)]) == [(0.0, 5.0)]
    assert quiet([axis], replace(ideal, control="sampled"), [(0.0, 5.0)]) == []


def test_noise_is_held_against_what_the_drive_gives_where_that_is_known():
    axis, spec = Plant(gain=1.8, damping=4.0), PDSpec(kp=100, settling_time=0.5, reference=0.01)
    limited = axis.with_effect(Saturation(limit=24.0))
    lights = [
        trust(known(plant, 2e-5, 1.05), recommend(known(plant, 2e-5, 1.05), tune(plant, spec), scenarios=60))[1]
        for plant in (axis, limited)
    ]
    assert [light.light for light in lights] == ["amber", "green"]
    assert "% of the largest of the records" in lights[0].sentence
