"""The fit of given pieces alone: the same numbers as the whole fit, at a fraction of its time."""

from __future__ import annotations

import numpy as np
import pytest

from servolens import Controller, InputError, NumericalError, Record, identify, lab
from servolens.identification.factors import triangular_solution
from servolens.identification.integral import Pieces
from servolens.identification.segments import motion_segments
from servolens.identification.varying import fit_pieces, ordering

KP60 = lab.step_record(lab.NLM1, 60, duration=0.899, encoder=25e-6)
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
    assert [finding.code for finding in fit.findings] == ["not_all_data_used"]
    assert "the errors are those of its first" in fit.findings[0].message
    assert fit.errors["constant"][0].percent_error < 3
