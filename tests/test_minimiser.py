"""The minimiser: slopes that follow from steps, promises that are kept, and the parabola of two unknowns."""

from __future__ import annotations

import certified
import numpy as np
import pytest

from servolens.effects import ConstantForce
from servolens.identification import minimiser
from servolens.identification.error_problem import Problem
from servolens.identification.linear_model import Block, Linearised, Slopes
from servolens.identification.options import FitOptions
from servolens.identification.parabola import Parabola
from servolens.identification.runs import OneByOne
from servolens.plant import Plant

RNG = np.random.default_rng(720440)


def linear(samples: int = 40) -> tuple[Slopes, np.ndarray, np.ndarray]:
    """Return a run that is linear in two parameters and two initial states, and how far its optimum is away."""
    jacobian, initial = RNG.normal(size=(samples, 2)), RNG.normal(size=(samples, 2))
    values, start = RNG.normal(size=2), RNG.normal(size=2)
    return Slopes(-(jacobian @ values + initial @ start), jacobian, initial), values, start


def linearised(slopes: Slopes) -> Linearised:
    block = Block.of(slopes, np.ones(slopes.residual.size))
    return Linearised([block], block.jacobian.T @ block.residual, block.jacobian.T @ block.jacobian)


def test_secant_slopes_agree_with_the_step_and_leave_what_it_did_not_touch():
    slopes, _, _ = linear()
    moved, started = np.array([0.3, 0.0]), np.array([0.0, -0.2])
    residual = RNG.normal(size=slopes.residual.size)
    found = slopes.moved(moved, started, residual)
    np.testing.assert_allclose(found.jacobian @ moved + found.initial @ started, residual - slopes.residual, atol=1e-12)
    np.testing.assert_allclose(found.jacobian[:, 1], slopes.jacobian[:, 1], atol=1e-12)
    np.testing.assert_allclose(found.initial[:, 0], slopes.initial[:, 0], atol=1e-12)


def test_a_step_of_a_linear_run_changes_none_of_its_slopes():
    slopes, _, _ = linear()
    moved, started = RNG.normal(size=2), RNG.normal(size=2)
    left = slopes.residual + slopes.jacobian @ moved + slopes.initial @ started
    found = slopes.moved(moved, started, left)
    np.testing.assert_allclose(found.jacobian, slopes.jacobian, atol=1e-12)
    np.testing.assert_allclose(found.initial, slopes.initial, atol=1e-12)


def test_promises_of_a_linear_run_are_kept():
    slopes, values, start = linear()
    found, cost = linearised(slopes), float(slopes.residual @ slopes.residual)
    assert found.promised(values, [start]) == pytest.approx(cost, rel=1e-10)
    assert found.most(np.array([True, True])) == pytest.approx(cost, rel=1e-10)
    half = slopes.residual + 0.5 * (slopes.jacobian @ values + slopes.initial @ start)
    assert found.promised(0.5 * values, [0.5 * start]) == pytest.approx(cost - float(half @ half), rel=1e-10)
    held = np.hstack([slopes.jacobian[:, :1], slopes.initial])  # the second parameter may not move
    left = slopes.residual - held @ np.linalg.lstsq(held, slopes.residual, rcond=None)[0]
    assert found.most(np.array([True, False])) == pytest.approx(cost - float(left @ left), rel=1e-10)


@pytest.mark.parametrize("name", ["Thurber", "Gauss1", "Misra1a"])
def test_most_steps_need_no_differences(name, monkeypatch):
    """Of problems whose answer is certified, the minimiser goes on from one linearisation for several steps."""
    problem = certified.PROBLEMS[name]
    counts = {"differences": 0, "steps": 0}

    def counting(method, what):
        def counted(self, *arguments):
            counts[what] += 1
            return method(self, *arguments)

        return counted

    monkeypatch.setattr(Problem, "differences", counting(Problem.differences, "differences"))
    monkeypatch.setattr(Problem, "step", counting(Problem.step, "steps"))
    search = Problem(problem.plant(problem.starts[1]), [certified.Curve(problem)], certified.HELD, 1.0)
    end, converged = minimiser.descend(search, search.start(), 60)
    assert converged
    np.testing.assert_allclose(end.values, problem.certified, rtol=1e-4)
    assert 1 < counts["differences"] <= 0.6 * counts["steps"]


class Ridge(OneByOne):
    """A run whose initial state promises a fall beside where it stands, and lets the residual rise farther away."""

    group, sample_time, samples, start, shifts = 0, 1.0, 2, np.zeros(1), (1e-3,)

    def missed(self, plant, start, substeps):
        (state,), (force,) = start, plant.effects[0].values
        return np.array([1.0 - state if abs(state) <= 1e-3 else 1.0 + abs(state), 1.0 + force])

    residual = missed


def test_descent_ends_where_a_parameter_at_zero_moves_by_ever_less_and_a_promise_is_never_kept():
    """No damping shortens the step of an initial state; that of a parameter at 0 never became nothing either."""
    plant = Plant(gain=1.0, damping=1.0, effects=(ConstantForce(acceleration=0.0),))
    search = Problem(plant, [Ridge()], FitOptions(held=("gain", "damping")), 1.0)
    begun = search.start()
    end, converged = minimiser.descend(search, begun, 60)
    assert converged
    assert (end.cost, end.values.tolist(), end.starts[0].tolist()) == (2.0, [0.0], [0.0])


def quadratic(lowest: np.ndarray, curvature: np.ndarray):
    return lambda place: 7.0 + 0.5 * float((place - lowest) @ curvature @ (place - lowest))


def test_parabola_finds_the_lowest_point_of_a_quadratic():
    lowest, curvature = np.array([0.4, -0.7]), np.array([[3.0, 1.2], [1.2, 0.8]])
    function = quadratic(lowest, curvature)
    place = np.array([0.1, 0.2])
    found = Parabola.of(function, place, 0.25)
    np.testing.assert_allclose(place + found.step(10.0), lowest, atol=1e-9)
    assert found.falls(10.0) == pytest.approx(function(place) - 7.0, rel=1e-9)


def test_parabola_that_bends_down_goes_as_far_as_it_may_and_downhill():
    function = quadratic(np.zeros(2), np.diag([-1.0, 2.0]))
    found = Parabola.of(function, np.array([0.1, 0.5]), 0.25)
    step = found.step(2.0)
    np.testing.assert_allclose(step, [2.0, -0.5], atol=1e-9)
    assert found.falls(2.0) == pytest.approx(function(np.array([0.1, 0.5])) - function(np.array([2.1, 0.0])), rel=1e-9)


@pytest.mark.parametrize("name", sorted(certified.PROBLEMS))
def test_what_is_found_on_the_way_is_no_end_that_steps_alone_suggest(name):
    """Slopes that follow from steps know nothing of a parameter that did not act: differences confirm each end."""
    problem = certified.PROBLEMS[name]
    search = Problem(problem.plant(problem.starts[1]), [certified.Curve(problem)], certified.HELD, 1.0)
    end, converged = minimiser.descend(search, search.start(), 200, 1e-6)
    least = problem.residual_sum_of_squares
    assert not converged or end.cost <= (1.0 + 1e-5) * least + 1e-12


@pytest.mark.parametrize(("side", "slope"), [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)])
def test_parabola_stays_where_a_neighbour_is_out_of_range(side, slope):
    """Nothing leads down on the side that is left: stay on this axis; or down there, as far as is allowed."""

    def function(place):
        out = side * place[1] > 0.1
        return np.inf if out else side * slope * 100.0 * place[1] + 5.0 * (place[0] - 0.3) ** 2

    found = Parabola.of(function, np.zeros(2), 0.25)
    step = found.step(1.0)
    assert step[0] == pytest.approx(0.3)
    assert side * step[1] == pytest.approx(-1.0 if slope > 0.0 else 0.0)
    assert found.falls(1.0) == pytest.approx(0.45 + (100.0 if slope > 0.0 else 0.0))
