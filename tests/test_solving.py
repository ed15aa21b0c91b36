"""The constrained fit against SciPy and the optimality conditions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from servolens.errors import InputError, NumericalError
from servolens.solving import Constraint, constrained_least_squares


def problem(seed: int, p: int = 6) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    x, y = rng.standard_normal((40, p)) * np.geomspace(1e-3, 1e3, p), rng.standard_normal(40)
    return x, y, np.linalg.qr(np.column_stack([x, y]), mode="r")


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), low=st.floats(-1.0, 0.0), width=st.floats(0.0, 0.5))
def test_bounds_agree_with_scipy(seed: int, low: float, width: float) -> None:
    x, y, factor = problem(seed)
    scale = np.linalg.norm(x, axis=0)
    bounds = [
        Constraint(name=f"x{i}", coefficients={i: float(scale[i])}, lower=low, upper=low + width + 1e-3)
        for i in range(6)
    ]
    ours = constrained_least_squares(factor, bounds).x * scale
    theirs = lsq_linear(x / scale, y, bounds=(low, low + width + 1e-3), tol=1e-14, method="bvls").x
    np.testing.assert_allclose(ours, theirs, atol=1e-7)


def test_without_constraints_it_is_plain_least_squares() -> None:
    x, y, factor = problem(3)
    expected = np.linalg.lstsq(x, y, rcond=None)[0]
    np.testing.assert_allclose(constrained_least_squares(factor).x, expected, rtol=1e-10)
    loose = [Constraint(name="loose", coefficients={0: 1.0}, lower=-1e9, upper=1e9)]
    np.testing.assert_allclose(constrained_least_squares(factor, loose).x, expected, rtol=1e-10)


def test_active_set_and_multipliers_are_those_of_the_optimum() -> None:
    x, y, factor = problem(4)
    free = constrained_least_squares(factor).x
    held = constrained_least_squares(factor, [Constraint(name="half", coefficients={2: 1.0}, upper=free[2] - 0.3)])
    assert held.active == ("half",)
    gradient = x.T @ (x @ held.x - y)
    np.testing.assert_allclose(gradient[2], -held.multipliers[0], rtol=1e-7)
    np.testing.assert_allclose(gradient[[0, 1, 3, 4, 5]] / np.linalg.norm(x, axis=0)[[0, 1, 3, 4, 5]], 0.0, atol=1e-9)


def test_contradicting_constraints_are_named() -> None:
    _, _, factor = problem(5)
    constraints = [
        Constraint(name="damping above 3", coefficients={0: 1.0}, lower=3.0),
        Constraint(name="damping below 1", coefficients={0: 1.0}, upper=1.0),
        Constraint(name="gain below 2", coefficients={1: 1.0}, upper=2.0),
    ]
    with pytest.raises(InputError, match="contradict each other") as caught:
        constrained_least_squares(factor, constraints)
    assert "damping" in str(caught.value)
    assert "gain below 2" not in str(caught.value)


def test_dependent_columns_are_a_numerical_error() -> None:
    x, y, _ = problem(6)
    x[:, 3] = 2.0 * x[:, 1]
    with pytest.raises(NumericalError, match="proportional"):
        constrained_least_squares(np.linalg.qr(np.column_stack([x, y]), mode="r"))


def test_solvers_print_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    from servolens.design import PDSpec, tune
    from servolens.plant import Plant

    _, _, factor = problem(7)
    for plugin in ("daqp", "qrqp", "highs"):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("servolens.solving.SOLVERS", (plugin,))
            constrained_least_squares(factor, [Constraint(name="b", coefficients={0: 1.0}, upper=-1e3)])
    tune(Plant(gain=1.8, damping=5.0), PDSpec(kp=100.0, settling_time=0.5))
    assert capfd.readouterr() == ("", "")
