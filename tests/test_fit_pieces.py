"""The fit of given pieces alone: the same numbers as the whole fit, at a fraction of its time."""

from __future__ import annotations

import numpy as np
import pytest

from servolens import (
    Cogging,
    Controller,
    CoulombFriction,
    DeadZone,
    InputError,
    NumericalError,
    PeriodicDisturbance,
    Record,
    identify,
    lab,
)
from servolens.identification.factors import triangular_solution
from servolens.identification.integral import Pieces
from servolens.identification.ranking import by_peaks
from servolens.identification.segments import motion_segments, moving_parts
from servolens.identification.starting import Screen
from servolens.identification.uncertainty import apparent_noise
from servolens.identification.varying import fit_pieces, ordering

KP60 = lab.step_record(lab.NLM1, 60, duration=0.899, encoder=25e-6)
SWING = {"amplitude": 0.5, "frequency": 7.0, "phase": 0.0}
SIX = Pieces(edges=np.arange(7) * 150, groups=np.arange(6))


def test_constraints_that_do_not_bind_change_nothing():
    segments = motion_segments([KP60])
    free, bound = fit_pieces(segments, [SIX]), fit_pieces(segments, [SIX], ordering(6, 100.0))
    assert bound.active == ()
    assert bound.damping == pytest.approx(free.damping, rel=1e-8)
    assert bound.gain == pytest.approx(free.gain, rel=1e-8)
    assert bound.starts == pytest.approx(free.starts, abs=1e-10)


def test_one_piece_agrees_with_the_constant_model():
    segments = motion_segments([KP60])
    fit = fit_pieces(segments, [Pieces.whole(900)])
    constant = identify(KP60, model="constant").constant
    assert constant is not None
    assert (fit.gain, fit.damping[0]) == pytest.approx((constant.plant.gain, constant.plant.damping), rel=1e-9)


def test_initial_state_of_each_segment_is_found():
    start = KP60.with_({"position": KP60.position + 0.3, "reference": np.asarray(KP60.reference) + 0.3})
    fit = fit_pieces(motion_segments([KP60, start]), [SIX, SIX])
    assert fit.starts[1] - fit.starts[0] == pytest.approx([0.3, 0.0], abs=1e-9)


def test_a_voltage_that_never_acts_is_refused():
    time = 1e-3 * np.arange(900)
    record = Record(
        time=time, position=0.1 * (1 - np.exp(-5 * time)), voltage=np.zeros(900), controller=Controller(kp=1)
    )
    segments = motion_segments([record])
    with pytest.raises(NumericalError, match="do not determine"):
        fit_pieces(segments, [Pieces.whole(segments[0].time.size)])


def test_pieces_of_another_length_are_refused():
    with pytest.raises(InputError, match="cover 900 samples, the segment has 600"):
        fit_pieces(motion_segments([KP60.slice(0.0, 0.599)]), [SIX])


def test_triangular_solution_is_the_linear_solution():
    factor = np.triu(np.random.default_rng(1).standard_normal((6, 6)) + 4 * np.eye(6))
    x = np.empty(5)
    assert triangular_solution(factor, x) > 0.1
    assert x == pytest.approx(np.linalg.solve(factor[:5, :5], factor[:5, 5]), rel=1e-12)


def test_errors_of_a_long_record_are_those_of_its_beginning_and_it_says_so():
    count = 300_000
    reference = np.where(np.arange(count) // 1500 % 2 == 0, 0.1, 0.0)
    one = lab.step_record(lab.NLM1, 60, reference=(0.1, 0.0), duration=1.5)
    record = Record(
        time=1e-3 * np.arange(count),
        position=np.resize(one.position[:3000], count),
        voltage=np.resize(np.asarray(one.voltage)[:3000], count),
        reference=reference,
        controller=Controller(kp=60),
    )
    fit = identify(record, model="constant")
    assert [finding.code for finding in fit.findings] == ["beyond_the_law", "not_all_data_used"]
    assert "the errors are those of its first" in fit.findings[1].message
    assert fit.errors["constant"][0].percent_error < 3


@pytest.mark.parametrize("kept", [0.0, 0.9])
def test_correlated_error_counts_once_over_its_correlation_time(kept):
    # first-order process: the mean of n scatters as that of white noise (1 + kept)/(1 - kept) times the variance
    drawn = np.random.default_rng(7).normal(size=400_000)
    error = np.empty(drawn.size)
    last = 0.0
    for i, value in enumerate(drawn):
        last = error[i] = kept * last + np.sqrt(1.0 - kept**2) * value
    assert apparent_noise([error[:200_000], error[200_000:]]) == pytest.approx(
        np.sqrt((1.0 + kept) / (1.0 - kept)), rel=0.05
    )


def test_axis_that_stands_on_its_way_is_identified_from_where_it_moves():
    time = np.arange(2000) * 1e-3
    rise = [np.clip((time - begin) / 0.3, 0.0, 1.0) for begin in (0.0, 1.5)]
    position = sum(0.05 * (3.0 * x**2 - 2.0 * x**3) for x in rise)
    record = Record(
        time=time,
        position=position,
        reference=0.1 + 0.0 * time,
        voltage=6.0 + 0.0 * time,
        controller=Controller(kp=60.0),
    )
    parts = moving_parts(motion_segments([record]))
    assert [(part.first, part.stop) for part in parts] == [
        (pytest.approx(0, abs=15), pytest.approx(300, abs=15)),
        (pytest.approx(1500, abs=15), pytest.approx(1800, abs=15)),
    ]
    assert all(np.array_equal(record.position[part.first : part.stop], part.position) for part in parts)
    assert parts[1].since_step == pytest.approx(parts[1].first * 1e-3)


def test_axis_that_moves_all_the_time_is_left_whole():
    segments = motion_segments([lab.step_record(lab.LM1, 60.0, noise=1e-5, seed=1)])
    assert moving_parts(segments) == segments


def test_faint_ripple_beside_strong_steps_ranks_its_pitch_first():
    """A voltage that jumps is held from sample to sample; trapezoids over its jumps would hide the ripple."""
    faint = {"coulomb_friction": {"level": 0.02}, "cogging": {"amplitude": 0.01, "pitch": 0.02, "phase": 0.5}}
    cart = lab.Truth(gain=1.9, damping=6.0, effects=faint)
    records = [lab.step_record(cart, kp=kp, encoder=1e-6, noise=1e-6, seed=kp) for kp in (60, 150)]
    screen = Screen.of(motion_segments(records))
    pitches = [Cogging(amplitude=0.1, pitch=0.02 * ratio, phase=0.0) for ratio in (0.5, 0.7, 0.9, 1.0, 1.1, 1.5, 2.0)]
    others = (CoulombFriction(level=0.1),)
    left = screen.thinned.left(others, screen.thinned.proposals(pitches))
    best = pitches[np.argmin(left)]
    assert best.pitch == 0.02
    assert np.sqrt(np.min(left) / screen.thinned.time.size) == pytest.approx(screen.solve((*others, best))[1], rel=0.1)


def test_disturbance_of_each_records_own_phase_ranks_its_frequency_first():
    records = [
        lab.step_record(
            lab.Truth(gain=1.9, damping=6.0, effects={"periodic_disturbance": {**SWING, "phase": phase}}),
            kp=60,
            encoder=0.0,
            noise=1e-5,
            seed=seed,
        )
        for seed, phase in enumerate((0.3, 2.0, 4.5))
    ]
    screen = Screen.of(motion_segments(records))
    swings = [PeriodicDisturbance(**{**SWING, "frequency": 7.0 * ratio}) for ratio in (0.7, 0.9, 1.0, 1.1, 1.4)]
    left = screen.thinned.left((), screen.thinned.proposals(swings))
    best = swings[np.argmin(left)]
    assert best.frequency == 7.0
    assert np.sqrt(np.min(left) / screen.thinned.time.size) == pytest.approx(screen.solve((best,))[1], rel=0.1)


def test_neighbours_on_one_peak_come_after_the_best_of_each_other_peak():
    assert by_peaks(np.array([9.0, 2.0, 1.0, 3.0, 8.0, 6.0, 7.0, 5.0])) == [2, 7, 5, 1, 3, 6, 4, 0]
    assert by_peaks(np.empty(0)) == []


def test_nothing_is_left_to_rank_of_no_proposal_and_of_effects_without_a_linear_size():
    screen = Screen.of(motion_segments([KP60]))
    assert screen.thinned.left((), screen.thinned.proposals([])).shape == (0,)
    zones = [DeadZone(width=0.1), DeadZone(width=0.2)]
    left = screen.thinned.left((), screen.thinned.proposals(zones))
    assert left[0] == left[1] > 0.0


def test_forces_are_ranked_behind_the_actuators_however_long_the_record():
    time = np.arange(20_001) * 0.05
    voltage = 8.0 + np.sin(0.3 * time)
    record = Record(time=time, position=np.cumsum(np.cumsum(voltage)) * 1e-6, voltage=voltage, controller=None)
    screen = Screen.of(motion_segments([record]))
    (segment,), _ = screen._behind((DeadZone(width=0.5), CoulombFriction(level=1.0)))
    (whole,), _ = screen._behind(())
    np.testing.assert_allclose(segment.voltage[:-1], whole.voltage[:-1] - 0.5, rtol=1e-6)
