"""Campaigns with a hidden truth: reproducible, sane, and as visible as asked."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import StateSpace, cont2discrete, lsim

from servolens import lab
from servolens.effects import CATALOGUE
from servolens.errors import InputError
from servolens.lab.laws import LAWS, Instant
from servolens.lab.linear_view import LoggedLoop, linear_error, linear_response
from servolens.lab.scene import draw_scene
from servolens.lab.search import MOTION, REACH
from servolens.lab.sizes import SIZES
from servolens.record import Controller

ASKED = 30.0


def as_logged(records, *, closed=True):
    return [
        LoggedLoop(r.controller, r.sample_time, r.position, r.reference if closed else r.voltage, closed)
        for r in records
    ]


def misfit(campaign, *, closed=True):
    """R.m.s. error of the best linear model in the noisy records."""
    gain, damping = campaign.truth.gain, max(campaign.truth.damping, 1.0)
    return linear_error(as_logged(campaign.records, closed=closed), gain, damping)[0]


def is_sane(campaign):
    for record in (*campaign.records, *campaign.heldout):
        assert 1200 < len(record) < 4200
        assert np.abs(record.position).max() < REACH * record.step_size
        assert np.ptp(record.position) > MOTION * record.step_size
    return True


def same(one, other):
    return all(
        np.array_equal(a.position, b.position) and np.array_equal(a.voltage, b.voltage)
        for a, b in zip((*one.records, *one.heldout), (*other.records, *other.heldout), strict=True)
    )


def test_sizes_are_known_for_every_law_of_the_laboratory():
    assert set(SIZES) == set(LAWS)


@pytest.mark.parametrize("size", [0.05, 0.3])
def test_second_order_actuator_agrees_with_scipy(size):
    scene = draw_scene(np.random.default_rng(3), records=1, heldout=0, noise=None, length_unit="m")
    law = lab.FOREIGN["second_order_actuator"].make(scene, size, np.random.default_rng(4), np.random.default_rng(5))
    rate, ratio = scene.rate / size, np.random.default_rng(4).uniform(0.3, 0.9)
    system = StateSpace([[0, 1], [-(rate**2), -2 * ratio * rate]], [[0], [rate**2]], [[1, 0]], [[0]])
    h, levels = scene.sample_time, np.array([0.0, *np.repeat([2.0, -1.0, 0.5], 40)])
    time = h * np.arange(levels.size)
    felt = []
    for t, level in zip(time, levels, strict=True):
        assert law.turns(float(t), float(level), 0.0) == level
        # what is subtracted is the motor's acceleration by the command that has not arrived yet
        felt.append(level - law.force(Instant(0.0, 0.0, 0.0, 0.0, float(t) + 0.5 * h), None, None) / scene.gain)
    fine = np.repeat(levels, 2)
    _, expected, _ = lsim(system, fine, 0.5 * h * np.arange(fine.size), interp=False)
    np.testing.assert_allclose(felt, expected[1::2], rtol=0, atol=1e-10)


def test_foreign_laws_are_no_members_of_the_catalogue_and_have_a_sentence():
    assert len(lab.FOREIGN) >= 20
    assert not set(lab.FOREIGN) & set(CATALOGUE)
    assert all(law.sentence.endswith(".") for law in lab.FOREIGN.values())
    assert all(law.low < law.per_mille < law.high for law in lab.FOREIGN.values())


@pytest.mark.parametrize("name", sorted(SIZES))
def test_every_effect_is_as_visible_as_asked_in_a_sane_campaign(name):
    campaign = lab.hidden_campaign(11, effects=[name], visibility=ASKED, noise="medium", records=2, heldout=1)
    assert is_sane(campaign)
    assert list(campaign.truth.effects) == [name]
    assert campaign.visibility == pytest.approx(ASKED, rel=0.2)
    assert misfit(campaign) / campaign.floor == pytest.approx(np.hypot(campaign.visibility, 1.0), rel=1e-3)
    if name in CATALOGUE:
        effect = CATALOGUE[name](**campaign.truth.effects[name])  # refuses what is out of its range
        assert effect.name == name


@pytest.mark.parametrize("name", sorted(lab.FOREIGN))
def test_every_foreign_law_is_visible_in_a_sane_campaign(name):
    campaign = lab.hidden_campaign(12, foreign=name, visibility=ASKED, noise="medium", records=2, heldout=1)
    assert is_sane(campaign)
    assert campaign.foreign == name
    assert dict(campaign.truth.effects) == {}
    assert campaign.visibility == pytest.approx(ASKED, rel=0.2)
    assert misfit(campaign) / campaign.floor == pytest.approx(np.hypot(campaign.visibility, 1.0), rel=1e-3)


@pytest.mark.parametrize("wanted", [{"effects": ["coulomb_friction"]}, {"foreign": "random_knocks"}], ids=str)
def test_the_same_seed_gives_the_same_campaign_and_another_another(wanted):
    one, again, other = (lab.hidden_campaign(seed, records=1, heldout=1, **wanted) for seed in (5, 5, 6))
    assert same(one, again)
    assert one.truth == again.truth
    assert one.truth.gain != other.truth.gain


def test_a_healthy_axis_shows_noise_only():
    campaign = lab.hidden_campaign(4)
    assert dict(campaign.truth.effects) == {}
    assert campaign.foreign is None
    assert campaign.visibility == 0.0
    # r.m.s. of more than 5000 samples of noise is known to 1 %; rounding is not quite uniform
    assert misfit(campaign) / campaign.floor == pytest.approx(1.0, abs=0.05)


def test_each_of_two_effects_is_visible_by_itself():
    campaign = lab.hidden_campaign(7, effects=["coulomb_friction", "delay"], visibility=ASKED, records=2)
    assert set(campaign.truth.effects) == set(campaign.shares) == {"coulomb_friction", "delay"}
    assert list(campaign.shares.values()) == pytest.approx([ASKED, ASKED], rel=0.2)


def test_held_out_records_have_other_gains_and_levels():
    campaign = lab.hidden_campaign(8, records=3, heldout=2)
    assert (len(campaign.records), len(campaign.heldout)) == (3, 2)
    runs = (*campaign.records, *campaign.heldout)
    assert len({r.controller.kp for r in runs}) == len({r.step_size for r in runs}) == 5
    assert any(r.controller.kd == 0 for r in runs)
    assert any(r.controller.kd > 0 for r in runs)
    assert {np.sign(r.reference[np.argmax(np.abs(r.reference))]) for r in campaign.records} == {-1.0, 1.0}


def test_levels_of_noise_are_in_order():
    shares = []
    for noise in ("low", "medium", "high"):
        campaign = lab.hidden_campaign(9, noise=noise, records=1, heldout=0)
        shares.append(campaign.noise / campaign.records[0].step_size)
        assert 0.4 < campaign.encoder / campaign.noise < 2.5
    assert shares == sorted(shares)
    assert shares[-1] > 5 * shares[0]
    assert lab.hidden_campaign(9, noise=1e-6, records=1, heldout=0).noise == 1e-6


def test_visibility_without_a_reference_is_that_of_a_model_driven_by_the_voltage():
    campaign = lab.hidden_campaign(
        10, effects=["coulomb_friction"], visibility=ASKED, records=2, heldout=1, log_reference=False
    )
    assert all(r.reference is None and r.voltage is not None for r in (*campaign.records, *campaign.heldout))
    assert misfit(campaign, closed=False) / campaign.floor == pytest.approx(ASKED, rel=0.2)


def test_records_without_voltage():
    campaign = lab.hidden_campaign(10, records=1, heldout=1, log_voltage=False)
    assert all(r.voltage is None and r.reference is not None for r in (*campaign.records, *campaign.heldout))


def test_small_effects_are_small():
    campaign = lab.hidden_campaign(13, effects=["return_spring"], visibility=2.0, records=2)
    assert campaign.visibility == pytest.approx(2.0, rel=0.2)


def test_pendulums_swing_in_radians():
    campaign = lab.hidden_campaign(1, effects=["pendulum_gravity"], records=1, heldout=0, length_unit="m")
    assert campaign.records[0].length_unit == "rad"


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"effects": ["coulomb"]}, "no effect 'coulomb' to hide"),
        ({"foreign": "magic"}, "no foreign law 'magic'"),
        ({"visibility": 0.0}, "visibility must be positive, got 0.0"),
        ({"noise": "loud"}, "noise must be low, medium, high or a number, got 'loud'"),
        ({"noise": -1.0}, "noise must be positive, got -1.0"),
        ({"records": 0}, "a campaign needs at least 1 record"),
        ({"log_voltage": False, "log_reference": False}, "a record needs at least one of the two"),
    ],
    ids=lambda value: str(value)[:30],
)
def test_what_does_not_exist_is_refused(asked, message):
    with pytest.raises(InputError, match=message):
        lab.hidden_campaign(1, **asked)


@pytest.mark.parametrize("closed", [True, False], ids=["reference", "voltage"])
@pytest.mark.parametrize("damping", [6.0, 300.0], ids=["slow", "quick"])
def test_the_linear_view_agrees_with_a_state_space_loop(closed, damping):
    gain, h = 1.9, 1e-3
    loop = Controller(kp=60.0, kd=3.0, derivative_filter=0.4)
    a, b, *_ = cont2discrete(
        (np.array([[0, 1], [0, -damping]]), np.array([[0], [gain]]), np.eye(2), np.zeros((2, 1))), h
    )
    state, last, derivative = np.array([0.02, 0.0]), 0.02, 0.0
    reference = np.repeat([0.1, -0.05], 400)
    position, voltage = [], []
    for level in reference:
        derivative += 0.4 * ((state[0] - last) / h - derivative)
        last = state[0]
        position.append(last)
        voltage.append(60.0 * (level - last) - 3.0 * derivative)
        state = a @ state + b[:, 0] * voltage[-1]
    position = np.array(position)
    run = LoggedLoop(loop, h, position, reference if closed else np.array(voltage), closed)
    assert np.abs(linear_response(run, gain, damping) - position).max() < 1e-10
    rms, *found = linear_error([run], 0.8 * gain, 1.3 * damping)
    assert rms < 1e-8
    np.testing.assert_allclose(found, [gain, damping], rtol=1e-5)


@pytest.mark.parametrize("hidden", [{"effects": ["coulomb_friction"]}, {"foreign": "position_gain"}], ids=str)
def test_hidden_axis_tried_again_does_what_was_logged(hidden):
    campaign = lab.hidden_campaign(11, **hidden)
    record = campaign.records[0]
    first = int(np.argmax(np.diff(record.reference) != 0.0)) + 1 if np.ptp(record.reference) else 0
    level, h = float(record.reference[first]), record.sample_time
    samples = min(int(0.5 / h), len(record) - first)
    run = campaign.tried(record.controller, [level], samples * h, h)
    missed = run.position - (record.position[first : first + samples] - record.position[:1].mean())
    assert np.sqrt(np.mean(missed**2)) < 5.0 * campaign.floor + 0.01 * abs(level)


@pytest.mark.parametrize("seed", [913293, 913294, 913295])
def test_friction_does_not_hold_the_axis_off_a_stop_that_is_hidden_beside_it(seed):
    campaign = lab.hidden_campaign(seed, effects=["end_stop", "coulomb_friction"])
    stop = campaign.truth.effects["end_stop"]
    low = min(record.position.min() for record in campaign.records)
    high = max(record.position.max() for record in campaign.records)
    assert low < stop["low"] + campaign.floor or high > stop["high"] - campaign.floor
