"""Logs slower than their loop: what it did between the samples, and when its reference jumped there."""

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from servolens import Controller, Plant, Record, diagnose, fit, lab, predict, read_record
from servolens.control_law import command_at, controller_voltage
from servolens.diagnosis import loop_rate
from servolens.diagnosis.effort import EFFORT
from servolens.diagnosis.loop_rate import decided_beside_loop
from servolens.effects import CoulombFriction, Delay
from servolens.errors import InputError
from servolens.findings import Finding
from servolens.identification.noise import NoiseModel
from servolens.identification.observer import observer_of
from servolens.inputs import as_records
from servolens.jump_times import with_timed_jumps
from servolens.quality import assess
from servolens.simulation import simulate, simulate_loop
from servolens.study.lights import data_light

H = 1e-3
AXIS = lab.Truth(gain=1.9, damping=6.0)
LOOPS = {
    "p": Controller(kp=60),
    "pd": Controller(kp=80, kd=3),
    "filtered": Controller(kp=80, kd=3, derivative_filter=0.3, derivative_window=2),
    "pid": Controller(kp=80, kd=3, ki=50),
}


def every(record: Record, count: int, first: int = 0) -> Record:
    """Return each `count`-th sample from the `first` on, whose loop ran at all."""
    signals = ("time", "position", "reference", "voltage", "feedforward")
    taken = {name: x[first::count].copy() for name in signals if (x := getattr(record, name)) is not None}
    return replace(record, controller=replace(record.controller, control_period=H), **taken)


def logged(truth, kp, kd, *, count, rest=0.1, noise=1e-5, seed=1):
    """Log steps of an axis at each tick, and return each `count`-th sample."""
    setup = lab.Setup(rest=rest)
    full = lab.step_record(
        truth, kp=kp, kd=kd, reference=(0.1, 0.0, 0.06), duration=1.2, noise=noise, seed=seed, setup=setup
    )
    return every(full, count)


def simulated(controller: Controller, jump: int, plant: Plant | None = None) -> Record:
    """Return a loop without noise that jumps at one of its ticks."""
    time = np.arange(1201) * H
    reference = np.where(np.arange(1201) >= jump, 0.1, 0.0)
    run = simulate_loop(plant or Plant(gain=1.9, damping=6.0), controller, time, reference)
    return Record(
        time=time, position=run.measured, reference=reference, voltage=run.voltage, controller=controller, name="run"
    )


@pytest.mark.parametrize("loop", LOOPS.values(), ids=LOOPS)
@pytest.mark.parametrize("jump", [100, 103], ids=["at a sample", "between two"])
def test_simulated_loop_runs_at_its_ticks(loop, jump):
    full = simulated(loop, jump)
    slow = every(full, 5)
    leads = np.zeros(len(slow))
    leads[slow.jumps()] = H * (-jump % 5)
    slow = replace(slow, jump_leads=leads)
    run = simulate(Plant(gain=1.9, damping=6.0), slow)
    assert run.time.tolist() == slow.time.tolist()
    assert run.measured == pytest.approx(slow.position, abs=1e-11)
    assert run.voltage == pytest.approx(slow.voltage, abs=1e-8)


@pytest.mark.parametrize("loop", LOOPS.values(), ids=LOOPS)
def test_law_and_voltage_between_samples_follow_from_the_motion(loop):
    full = simulated(loop, 100)
    slow = every(full, 5)
    largest = np.max(np.abs(full.voltage))
    assert controller_voltage(slow) == pytest.approx(
        slow.voltage, abs=5e-3 * largest
    )  # a spline bends where the motion sets out
    ticks = slow.loop_ticks()
    assert ticks.time == pytest.approx(full.time)
    assert command_at(slow, ticks) == pytest.approx(full.voltage, abs=4e-3 * largest)
    unknown = replace(slow, controller=None, control_period=H)
    assert command_at(unknown, unknown.loop_ticks()) == pytest.approx(full.voltage, abs=1e-2 * largest)


def test_voltage_that_goes_on_to_change_drives_the_axis():
    slow = every(simulated(LOOPS["pd"], 100), 5)
    held = replace(slow, controller=LOOPS["pd"])
    plant = Plant(gain=1.9, damping=6.0)
    errors = [np.max(np.abs(simulate(plant, r, voltage_driven=True).position - r.position)) for r in (slow, held)]
    assert errors[0] < 5e-5 < 1e-3 < errors[1]


def test_axes_without_known_gains_state_the_period_too(tmp_path):
    slow = replace(every(simulated(LOOPS["p"], 100), 5), controller=None, control_period=H)
    slow.to_csv(tmp_path / "slow.csv")
    assert "# control_period = 0.001" in (tmp_path / "slow.csv").read_text(encoding="utf-8")
    text = "# control_period = 1 ms\ntime,position,voltage\n" + "\n".join(
        f"{0.005 * k},{0.01 * k},1" for k in range(30)
    )
    (tmp_path / "bare.csv").write_text(text, encoding="utf-8")
    assert read_record(tmp_path / "bare.csv").ticks == 5


@pytest.mark.parametrize(
    ("period", "words"),
    [(7e-4, "whole multiple of the shorter"), (1e-6, "at most 1000 times as long")],
    ids=["no multiple", "far too fast"],
)
def test_period_that_does_not_fit_is_refused(period, words):
    slow = every(simulated(LOOPS["p"], 100), 5)
    odd = replace(slow, controller=replace(slow.controller, control_period=period))
    with pytest.raises(InputError, match=words):
        simulate(Plant(gain=1.9, damping=6.0), odd)


@pytest.mark.parametrize("lead", [-2e-3, 6e-3, 0.2])
def test_jump_that_does_not_come_between_two_samples_is_refused(lead):
    slow = every(simulated(LOOPS["p"], 100), 5)
    leads = np.where(np.arange(len(slow)) == 20, lead, 0.0)
    with pytest.raises(InputError, match=r"^run: jump_leads must lie in \[0, 0.005\) s, .*; sample 20 is "):
        replace(slow, jump_leads=leads)


def test_file_of_a_record_states_the_period_of_its_controller(tmp_path):
    slow = replace(every(simulated(LOOPS["p"], 100), 5), control_period=2e-4)
    assert slow.ticks == 5
    slow.to_csv(tmp_path / "slow.csv")
    assert read_record(tmp_path / "slow.csv").controller == slow.controller


def test_records_logged_at_different_rates_are_timed_each_by_itself():
    runs = [
        logged(lab.Truth(gain=1.9, damping=6.0, effects={"delay": {"time": 0.002}}), 60, 0, count=n, rest=0.1, seed=n)
        for n in (10, 3)
    ]
    alone = [with_timed_jumps([run])[0].jump_leads.tolist() for run in runs]
    for order in (runs, runs[::-1]):
        found = {record.ticks: record.jump_leads.tolist() for record in with_timed_jumps(order)}
        assert [found[n] for n in (10, 3)] == alone


def test_jump_in_a_gap_is_not_timed_by_what_lies_beyond():
    slow = logged(AXIS, 60, 0, count=5, rest=0.103)
    keep = ~np.isin(np.arange(len(slow)), [19, 20, 21])
    signals = {name: getattr(slow, name)[keep] for name in ("time", "position", "reference", "voltage")}
    (timed,) = with_timed_jumps([replace(slow, **signals)])
    assert timed.jump_leads[timed.jumps()[0]] == 0.0
    assert timed.jump_leads[timed.jumps()[1]] > 0.0


@pytest.mark.parametrize("on", ["measurement", "error"])
@pytest.mark.parametrize("noise", [1e-6, 5e-5])
def test_check_says_nothing_against_a_slow_log_whose_period_is_stated(on, noise):
    setup = lab.Setup(rest=0.1, controller=Controller(kp=80, kd=3, derivative_on=on))
    full = lab.step_record(AXIS, reference=(0.1, 0.0), duration=1.2, noise=noise, seed=4, setup=setup)
    for count in (3, 5):
        found = assess(every(full, count)).findings
        assert [finding.code for finding in found if finding.severity != "note"] == []
        assert "law_not_verified" in {finding.code for finding in found}


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (lambda r: replace(r, controller=replace(r.controller, kp=1000.0 * r.controller.kp)), "0.0007 times kp e"),
        (lambda r: replace(r, reference=-r.reference), "times kp e"),
    ],
    ids=["V/mm for V/m", "another reference"],
)
def test_kp_of_a_slow_log_that_its_voltage_contradicts_is_told(wrong, told):
    axis = lab.Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.3}})
    full = lab.step_record(axis, 80.0, 3.0, reference=(0.1, 0.0), duration=1.2, noise=1e-5, seed=4)
    assert "gains_contradict_log" not in {finding.code for finding in assess(every(full, 4)).findings}
    (finding,) = (f for f in assess(wrong(every(full, 4))).findings if f.code == "gains_contradict_log")
    assert finding.severity == "warning"
    assert told in finding.message


def test_law_that_needs_a_limit_is_answered_without_one():
    full = simulated(LOOPS["p"], 100)
    assert full.answer(Controller(kp=60, ki=3, anti_windup="clamping")).integral.size == len(full)


def test_lost_samples_of_a_slow_log_are_put_back():
    full = simulated(LOOPS["pd"], 100)
    slow = every(full, 5)
    keep = np.ones(len(slow), dtype=bool)
    keep[60:63] = False
    signals = {name: getattr(slow, name)[keep] for name in ("time", "position", "reference", "voltage")}
    run = simulate(Plant(gain=1.9, damping=6.0), replace(slow, **signals))
    assert run.measured == pytest.approx(slow.position[keep], abs=1e-11)


@pytest.mark.parametrize("count", [3, 10])
@pytest.mark.parametrize("late", [0, 1, 2])
def test_jumps_between_samples_are_timed(count, late):
    runs = [logged(AXIS, kp, kd, count=count, rest=0.1 + late * H, seed=kp) for kp, kd in ((60, 0), (100, 3))]
    before = -(100 + late) % count * H
    for record in with_timed_jumps(runs):
        assert record.jump_leads[record.jumps()] == pytest.approx(before, abs=1e-9 if count == 3 else H + 1e-9)
    assert all(record.jump_leads is not None for record in as_records(runs))


def test_delay_of_the_axis_is_no_late_jump():
    runs = [
        logged(lab.Truth(gain=1.9, damping=6.0, effects={"delay": {"time": 0.004}}), kp, kd, count=10, seed=kp)
        for kp, kd in ((60, 0), (100, 3), (40, 1))
    ]
    for record in with_timed_jumps(runs):
        assert record.jump_leads[record.jumps()] == pytest.approx(0.0, abs=H)


def test_jumps_stay_as_stated_and_follow_their_samples():
    slow = logged(AXIS, 60, 0, count=3, rest=0.101)
    leads = np.zeros(len(slow))
    leads[slow.jumps()] = 2e-3
    stated = replace(slow, jump_leads=leads)
    assert with_timed_jumps([stated])[0] is stated
    (timed,) = with_timed_jumps([slow])
    part = timed.slice(0.5, 2.0)
    assert part.jump_leads[part.jumps()] == pytest.approx(timed.jump_leads[timed.jumps()][:1])
    assert slow.with_ticks(1).ticks == 1


def test_fit_of_a_slow_log_is_that_of_the_axis():
    truth = lab.Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.3}})
    runs = [logged(truth, kp, kd, count=3, rest=0.101, seed=kp) for kp, kd in ((60, 0), (100, 3))]
    found = fit(CoulombFriction, runs)
    assert found.plant.gain == pytest.approx(1.9, rel=5e-3)
    assert found.plant.effects[0].level == pytest.approx(0.3, rel=0.03)
    held = fit(CoulombFriction, [replace(r, controller=replace(r.controller, control_period=None)) for r in runs])
    assert abs(held.plant.gain - 1.9) > 3.0 * abs(found.plant.gain - 1.9)
    percent = [row[0].percent_error for row in predict(found, runs).errors]
    assert max(percent) < 0.05


def test_prediction_times_jumps_to_the_tick():
    slow = logged(AXIS, 60, 0, count=5, rest=0.102, noise=1e-6)
    wrong = np.zeros(len(slow))
    wrong[slow.jumps()] = 2e-3  # one tick off
    found = predict(Plant(gain=1.9, damping=6.0), replace(slow, jump_leads=wrong))
    assert np.max(np.abs(found.residuals()[0])) < 3e-5


def test_observer_is_not_moved_between_samples_and_follows_a_mistimed_jump():
    noise = NoiseModel.white(1e-5)
    time, still = 1e-3 * np.arange(60), np.zeros(60)
    measured = np.arange(60) % 3 == 0
    kicks = np.where(np.arange(60) == 20, 0.01, 0.0)
    assert observer_of(noise, time, still, still) is None
    gains = observer_of(noise, time, still, still, measured, kicks).gains
    assert not gains[~measured].any()
    assert not gains[:21].any()
    # Kalman, written out: a velocity of unknown size since tick 20, seen at ticks 21, 24, …
    prior = np.array([[0.0, 0.0], [0.0, 0.01**2]])
    for tick in (21, 24, 27):
        step = np.array([[1.0, 1e-3 * (tick - (20 if tick == 21 else tick - 3))], [0.0, 1.0]])
        prior = step @ prior @ step.T
        gain = prior[:, 0] / (prior[0, 0] + 1e-10)
        assert gains[tick, :2] == pytest.approx(gain, rel=1e-6)
        prior = prior - np.outer(gain, prior[0])


def test_lost_samples_are_no_cause():
    """The axis is led along what was measured, for the voltage at a lost sample is not known."""
    truth = lab.Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.3}})
    stream, runs = np.random.default_rng(7), []
    for kp in (40, 80):
        full = lab.step_record(truth, kp=kp, kd=1, reference=(0.1, 0.0), duration=1.2, noise=1e-5, seed=kp)
        keep = stream.random(len(full)) > 0.05
        keep[:5] = True
        taken = {name: getattr(full, name)[keep] for name in ("time", "position", "reference", "voltage")}
        runs.append(replace(full, **taken))
    assert [cause.effect for cause in diagnose(runs, effort="quick").causes] == ["coulomb_friction"]


def test_spike_of_a_slow_log_is_told():
    slow = logged(AXIS, 60, 0, count=5, noise=1e-6)
    position = slow.position.copy()
    position[300] += 0.03
    found = diagnose(replace(slow, position=position), effort="quick")
    assert "position_spikes" in {finding.code for finding in found.findings}


@pytest.mark.slow
def test_only_the_slow_ones_of_several_logs_have_a_faster_loop():
    slow = [logged(AXIS, kp, 0, count=5, rest=0.1, seed=kp) for kp in (60, 40)]
    slow = [replace(run, controller=replace(run.controller, control_period=None)) for run in slow]
    full = lab.step_record(AXIS, kp=80, kd=2, reference=(0.1, 0.0), duration=1.2, noise=1e-5, seed=3)
    found = diagnose([full, *slow], effort="quick")
    assert [record.ticks for record in found.records] in ([1, 4, 4], [1, 5, 5], [1, 6, 6])
    (said,) = (finding for finding in found.findings if finding.code == "loop_faster_than_log")
    assert "times in 5 ms" in said.message


@pytest.mark.slow
@pytest.mark.parametrize("late", [0, 1])
def test_stated_loop_is_diagnosed_at_its_ticks(late):
    truth = lab.Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.3}})
    runs = [
        logged(truth, kp, kd, count=3, rest=0.1 + late * H, seed=10 + kp) for kp, kd in ((60, 0), (100, 3), (40, 1))
    ]
    found = diagnose(runs)
    assert (found.verdict, [cause.effect for cause in found.causes]) == ("explained", ["coulomb_friction"])
    assert found.model.quantities["gain"].value == pytest.approx(1.9, rel=5e-3)


@pytest.mark.slow
def test_shaking_of_a_slow_log_is_said_to_hold_noise_that_was_not_logged():
    truth = lab.Truth(gain=1.5, damping=5.0, effects={"coulomb_friction": {"level": 0.6}})
    loops = ((100, 4), (160, 8), (240, 12))
    found = diagnose(
        [logged(truth, kp, kd, count=4, rest=0.2, noise=5e-6, seed=kp) for kp, kd in loops], effort="quick"
    )
    assert (found.verdict, [cause.effect for cause in found.causes]) == ("explained", ["coulomb_friction"])
    (said,) = [finding.message for finding in found.findings if finding.code == "shaken_axis"]
    assert said.endswith("sensor noise that was not logged; that counts as shaking too.")


@pytest.mark.slow
def test_jumps_are_timed_anew_beside_the_causes():
    """Before there is a plant, friction looks like jumps that come a tick sooner and a delay that is a tick longer."""
    hidden = {"coulomb_friction": {"level": 0.7}, "delay": {"time": 0.002}}
    truth = lab.Truth(gain=1.8, damping=4.0, effects=hidden)
    loops = ((100, 4), (160, 8), (240, 10))
    runs = [logged(truth, kp, kd, count=2, rest=0.2, noise=2e-6, seed=kp) for kp, kd in loops]
    timed = with_timed_jumps(runs)
    assert any(run.jump_leads.any() for run in timed)  # they came at samples
    found = diagnose(runs)
    assert not any(run.jump_leads.any() for run in found.records)
    assert (found.verdict, {cause.effect for cause in found.causes}) == ("explained", set(hidden))
    assert found.model.plant.effects[0].time == pytest.approx(0.002, abs=5e-5)


@pytest.mark.slow
def test_loop_that_ran_faster_than_a_log_is_found():
    runs = [logged(AXIS, kp, kd, count=5, rest=0.103, seed=20 + kp) for kp, kd in ((60, 0), (100, 3))]
    held = [replace(run, controller=replace(run.controller, control_period=None)) for run in runs]
    found = diagnose(held, effort="quick")
    assert "loop_faster_than_log" in {finding.code for finding in found.findings}
    assert found.verdict == "healthy"
    assert found.model.plant.gain == pytest.approx(1.9, rel=0.01)


def test_slow_loop_that_was_logged_at_each_tick_is_no_faster_one():
    runs = [
        lab.step_record(
            lab.Truth(gain=1.9, damping=6.0, effects={"delay": {"time": 0.006}}),
            kp=kp,
            reference=(0.1, 0.0),
            duration=2.0,
            sample_time=4e-3,
            noise=2e-5,
            seed=kp,
            setup=lab.Setup(rest=0.2),
        )
        for kp in (30, 50)
    ]
    found = diagnose(runs, effort="quick")
    assert "loop_faster_than_log" not in {finding.code for finding in found.findings}
    assert [cause.effect for cause in found.causes] == [Delay.name]


class AskedError(Exception):
    """A faster loop is tried."""


def slow_log(count: int, step: float) -> Record:
    """Return a log at 5 ms, of a loop at every tick or `count` times as fast, whose voltage is rounded to a step."""
    full = lab.step_record(
        AXIS, 40, 2, reference=(0.1, 0.0, 0.06), sample_time=5e-3 / count, noise=1e-5, seed=1, setup=lab.Setup(rest=0.1)
    )
    slow = every(full, count)
    voltage = np.round(slow.voltage / step) * step if step else slow.voltage
    return replace(slow, controller=replace(slow.controller, control_period=None), voltage=voltage)


@pytest.mark.parametrize(
    ("count", "step", "asks"), [(1, 0.0, False), (1, 1e-3, False), (1, 1.0, True), (5, 0.0, True), (5, 0.05, True)]
)
def test_faster_loops_are_tried_unless_the_command_shows_each_tick(monkeypatch, count, step, asks):
    def with_ticks(_record: Record, _count: int) -> Record:
        raise AskedError

    nothing = SimpleNamespace(contradiction="nothing explains it")
    monkeypatch.setattr(loop_rate, "decided", lambda *_: nothing)
    monkeypatch.setattr(Record, "with_ticks", with_ticks)
    asked = pytest.raises(AskedError) if asks else nullcontext()
    with asked:
        decided_beside_loop((slow_log(count, step),), (), {}, 24, EFFORT["quick"], lambda *_: None)


def test_light_of_the_data_is_amber_beside_a_loop_that_was_not_stated():
    record = every(simulated(LOOPS["pd"], 100), 5)
    told = Finding(code="loop_faster_than_log", severity="warning", message="The loop ran faster.")
    assert [data_light([assess(record)], others).light for others in ((), (told,))] == ["green", "amber"]


@pytest.mark.slow
def test_findings_of_a_slow_log_stay_its_own_where_records_share_a_name():
    slow = replace(logged(AXIS, 60, 3, count=5, seed=1), name="run")
    fast = replace(lab.step_record(AXIS, 80, 2, duration=1.2, noise=1e-5, seed=2), name="run")
    told = [finding.code for finding in diagnose([slow, fast], effort="quick").findings]
    assert "law_not_verified" in told
    assert "gains_contradict_log" not in told
