"""Where the error lives, and what damping, gain or a free force would have to do: known from what was hidden."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servolens import lab
from servolens.controller import Controller
from servolens.diagnosis.errors import residual
from servolens.diagnosis.evidence import error_shares
from servolens.diagnosis.in_time import instruments
from servolens.effects import CoulombFriction
from servolens.errors import InputError
from servolens.identification import identify
from servolens.identification.segments import motion_segments
from servolens.identification.starting import Screen
from servolens.plant import Plant
from servolens.record import Record
from servolens.simulation import simulate

CART = {"gain": 1.9, "damping": 6.0}
QUANTITIES = {"time_since_step", "speed", "position", "direction", "voltage", "frequency"}
HIDDEN = {
    "friction": ({"coulomb_friction": {"level": 0.3}}, "force", "direction", 1),
    "spring": ({"return_spring": {"stiffness": 20.0}}, "force", "position", 1),
    "tilt": ({"constant_force": {"acceleration": 0.3}}, "force", "constant", 1),
    "warming motor": ({"gain_drift": {"rate": -0.05}}, "gain", "time", -1),
    "damping that decays": ({"velocity_decay_damping": {"alpha1": 5.0, "alpha2": 2.0}}, "damping", "speed", -1),
    "drag": ({"quadratic_drag": {"drag": 8.0}}, "damping", "speed", 1),
    "lopsided damping": ({"asymmetric_damping": {"damping_difference": 3.0}}, "damping", "direction", 1),
}


def strokes(effects, seed=0, noise=1e-5):
    """Return two records of steps to and fro."""
    cart, levels = lab.Truth(**CART, effects=effects), [0.1, -0.05, 0.1, -0.05]
    return [
        lab.step_record(cart, kp=kp, reference=levels, duration=0.6, noise=noise, seed=seed + kp) for kp in (40, 90)
    ]


def read(records):
    """Return the instruments by what they let vary."""
    return {found.varies: found for found in instruments(Screen.of(motion_segments(records)), Plant(**CART))}


@pytest.fixture(scope="module")
def rubbing():
    return strokes({"coulomb_friction": {"level": 0.3}})


@pytest.fixture(scope="module")
def shares(rubbing):
    plant = identify(rubbing, model="constant").constant.plant
    return error_shares(rubbing, [residual(plant, record) for record in rubbing])


def test_every_quantity_shares_out_the_whole_error(shares):
    assert {share.quantity for share in shares} == QUANTITIES
    for share in shares:
        bins = np.array(share.bins)
        assert bins[:, 2:].sum(axis=0) == pytest.approx([1.0, 1.0], abs=1e-12)
        assert (bins[:, 2:] >= 0).all()
        assert bins[1:, 0] == pytest.approx(bins[:-1, 1], abs=0)


def test_a_range_holds_what_its_bins_hold(shares):
    for share in shares:
        inside = [b for b in share.bins if b[0] >= share.low and b[1] <= share.high]
        assert share.share_of_error == pytest.approx(sum(b[2] for b in inside), abs=1e-12)
        assert share.share_of_samples == pytest.approx(sum(b[3] for b in inside), abs=1e-12)


def test_most_telling_range_comes_first(shares):
    excess = [share.share_of_error - share.share_of_samples for share in shares]
    assert excess == sorted(excess, reverse=True)
    assert excess[0] > 0


def test_error_made_at_one_speed_is_found_there(rubbing):
    record = rubbing[0]
    speed = np.abs(np.gradient(record.position, record.time))
    fast = speed > np.quantile(speed, 0.8)
    (found,) = [s for s in error_shares([record], [np.where(fast, 1e-3, 0.0)]) if s.quantity == "speed"]
    assert found.share_of_error > 0.9
    assert found.share_of_samples < 0.35
    assert found.low == pytest.approx(np.quantile(speed, 0.8), rel=0.3)


@pytest.mark.parametrize("value", [0.0, np.inf, np.nan], ids=["no error", "runaway", "undefined"])
def test_error_that_is_nowhere_or_everywhere_has_no_place(rubbing, value):
    assert error_shares(rubbing, [np.full(len(record), value) for record in rubbing]) == ()


@pytest.mark.parametrize(("effects", "varies", "goes_with", "sign"), HIDDEN.values(), ids=HIDDEN)
def test_what_varies_goes_with_what_it_depends_on(effects, varies, goes_with, sign):
    found = read(strokes(effects))
    own = found[varies]
    assert (own.goes_with, np.sign(own.correlation)) == (goes_with, sign)
    assert abs(own.correlation) > 0.9
    assert own.significance < 1e-10


def test_no_force_goes_with_what_damping_or_gain_would_be():
    """Of a spring that gives no force near its middle the missing force was said to go with the voltage."""
    stops = {"end_stop": {"low": -0.05, "high": 0.05, "contact_frequency": 3.0, "contact_damping": 0.01}}
    force = read(strokes(stops))["force"]
    assert force.goes_with == "position"
    assert force.correlation > 0.5


def test_free_force_of_friction_is_the_friction(rubbing):
    force = read(rubbing)["force"]
    whole = np.abs(force.abscissa) > 0.95
    value, deviation = np.array(force.value)[whole], np.array(force.deviation)[whole]
    weight = deviation**-2
    level = float(weight @ (value * np.sign(np.array(force.abscissa)[whole])) / weight.sum())
    assert level == pytest.approx(0.3, rel=0.1)


def test_damping_in_time_is_that_of_the_law():
    found = read(strokes(HIDDEN["drag"][0]))["damping"]
    speed, value, deviation = (np.array(x) for x in (found.abscissa, found.value, found.deviation))
    slope, level = np.polyfit(speed, value, 1, w=1.0 / deviation)
    assert slope == pytest.approx(8.0, rel=0.1)
    assert level == pytest.approx(6.0, rel=0.1)


def test_nothing_goes_with_anything_on_a_healthy_axis():
    chances = [min(found.significance for found in read(strokes({}, seed)).values()) for seed in range(20)]
    assert min(chances) > 0.01 / 20
    assert np.mean(np.array(chances) < 0.05) <= 0.2  # 1 of 20 by chance; 4 or more once in a hundred


@pytest.mark.parametrize("noise", [0.0, 1e-9])
def test_exact_records_of_a_healthy_axis_show_nothing_either(noise):
    assert min(found.significance for found in read(strokes({}, noise=noise)).values()) > 0.01


def test_values_of_a_healthy_axis_have_the_scatter_that_is_stated():
    scatter = []
    for seed in range(10):
        damping = read(strokes({}, seed))["damping"]
        scatter += ((np.array(damping.value) - 6.0) / np.array(damping.deviation)).tolist()
    assert np.std(scatter) == pytest.approx(1.0, rel=4 / np.sqrt(2 * len(scatter)))


def test_plant_that_is_far_off_is_set_right(rubbing):
    """Gain and damping are free in the regression, so that the plant they start from does not matter."""
    screen = Screen.of(motion_segments(rubbing))
    one, other = (
        {i.varies: i for i in instruments(screen, Plant(gain=gain, damping=damping))}["force"]
        for gain, damping in ((1.9, 6.0), (1.2, 1.0))
    )
    assert other.correlation == pytest.approx(one.correlation, abs=1e-6)
    assert other.value == pytest.approx(one.value, abs=1e-6)


def test_one_short_stretch_says_nothing():
    record = lab.step_record(lab.Truth(**CART), kp=40, noise=1e-5, seed=0)
    screen = Screen.of(motion_segments([record.slice(0.0, 0.03)]))
    assert instruments(screen, Plant(**CART)) == ()


def test_axis_that_rests_has_no_stretch(rubbing):
    still = rubbing[0].with_({"position": np.full(len(rubbing[0]), 0.02)})
    with pytest.raises(InputError, match="does not move"):
        Screen.of(motion_segments([still]))


def test_steady_force_on_a_ramp_is_shown_in_time():
    """A position that grows with time tells no more than time: what stayed the same could not be drawn."""
    axis = Plant(gain=30.0, damping=8.0, effects=(CoulombFriction(level=2.0),))
    time = np.arange(1000) * 2e-3
    asked = Record(time=time, position=0.0 * time, reference=0.5 * time, controller=Controller(kp=6.0, kd=0.1))
    run = simulate(axis, asked, sensor_error=1e-5 * np.random.default_rng(0).standard_normal(time.size))
    ramp = replace(asked, position=run.measured, voltage=run.voltage)
    screen = Screen.of(motion_segments([ramp]))
    force = {found.varies: found for found in instruments(screen, Plant(gain=30.0, damping=8.0))}["force"]
    assert force.goes_with == "constant"
    assert np.mean(force.value) == pytest.approx(2.0, rel=0.1)
    assert force.abscissa == tuple(sorted(force.abscissa))
    assert time[0] < force.abscissa[0] < force.abscissa[-1] < time[-1]
