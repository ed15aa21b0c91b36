"""Named constraints and CasADi's solvers, with an honest status: the only place where a solver is called.

A constrained least-squares problem arrives as the triangular factor R and right-hand side z of its residuals. With the
unknown w = R x − z it is the nearest point of a polyhedron to the origin: the Hessian is the identity whatever the
conditioning of the data, and without active constraints the answer is R⁻¹ z to the last digits.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.errors import InputError, NumericalError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

__all__ = [
    "ConstrainedLeastSquares",
    "Constraint",
    "NonlinearProgram",
    "NonlinearResult",
    "constrained_least_squares",
    "minimise",
]

SOLVERS = ("daqp", "qrqp", "highs")
"""Tried in turn until the answer satisfies the optimality conditions."""
QUIET: dict[str, dict[str, Any]] = {
    "qrqp": {"print_iter": False, "print_header": False, "print_info": False},
    "highs": {"highs": {"output_flag": False}},
}
IPOPT: dict[str, Any] = {
    "ipopt": {
        "print_level": 0,
        "sb": "yes",
        "tol": 1e-9,
        "constr_viol_tol": 1e-10,
        "max_iter": 200,
        "hessian_approximation": "limited-memory",
        "bound_relax_factor": 0.0,
    },
    "print_time": False,
    "error_on_fail": False,
}
ONE_AT_A_TIME = threading.Lock()
"""CasADi's solvers are kept and shared, and none of them may run twice at once."""
FEASIBLE = 1e-9
"""Largest admissible violation of a constraint whose row has unit length, relative to the size of the unknowns."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Constraint:
    """``lower ≤ Σ coefficients[name]·x[name] ≤ upper``, under a name that people understand.

    Parameters
    ----------
    name : str
        What the user asked for, e.g. ``"c2 − c3 < 0.5"``.
    coefficients : mapping of int to float
        Index of the unknown and its factor; at least one.
    lower, upper : float
        Bounds; infinite where there is none.
    """

    name: str
    coefficients: Mapping[int, float]
    lower: float = -np.inf
    upper: float = np.inf


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ConstrainedLeastSquares:
    """The solution and what held it.

    Attributes
    ----------
    x : ndarray, shape (p,)
        The minimiser.
    active : tuple of str
        Names of the constraints that hold with equality and push.
    multipliers : ndarray, shape (constraints,)
        Sensitivity of half the squared residual to each bound.
    """

    x: NDArray[np.float64]
    active: tuple[str, ...]
    multipliers: NDArray[np.float64]


def constrained_least_squares(
    factor: NDArray[np.float64], constraints: Sequence[Constraint] = ()
) -> ConstrainedLeastSquares:
    """Minimise ``‖R x − z‖`` under linear `constraints`.

    Parameters
    ----------
    factor : ndarray, shape (p + 1, p + 1)
        Upper triangular ``[[R, z], [0, ρ]]``.
    constraints : sequence of Constraint
        Named linear constraints.

    Returns
    -------
    ConstrainedLeastSquares

    Raises
    ------
    InputError
        If the constraints contradict each other; the message names those that do.
    NumericalError
        If the columns are linearly dependent or the solver's answer does not satisfy the optimality conditions.
    """
    p = factor.shape[0] - 1
    r, z = factor[:p, :p], factor[:p, p]
    if p == 0 or np.abs(r.diagonal()).min() <= 1e-14 * np.abs(r).max():
        raise NumericalError("the data do not determine all unknowns of the fit: two of its columns are proportional")
    inverse = np.asarray(np.linalg.inv(r), dtype=np.float64)
    free = inverse @ z
    if not constraints:
        return ConstrainedLeastSquares(x=free, active=(), multipliers=np.empty(0))
    rows = _rows(constraints, p)
    lower = np.array([c.lower for c in constraints])
    upper = np.array([c.upper for c in constraints])
    values = rows @ free
    if np.all((values >= lower) & (values <= upper)):
        return ConstrainedLeastSquares(x=free, active=(), multipliers=np.zeros(len(constraints)))
    return _nearest_point(inverse, free, rows, lower, upper, constraints)


def _rows(constraints: Sequence[Constraint], size: int) -> NDArray[np.float64]:
    """Return the constraints' coefficients, shape (constraints, size)."""
    rows = np.zeros((len(constraints), size))
    for i, constraint in enumerate(constraints):
        for index, factor in constraint.coefficients.items():
            rows[i, index] = factor
    return rows


def _nearest_point(
    inverse: NDArray[np.float64],
    free: NDArray[np.float64],
    rows: NDArray[np.float64],
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
    constraints: Sequence[Constraint],
) -> ConstrainedLeastSquares:
    white = rows @ inverse
    scale = np.sqrt((white * white).sum(axis=1))
    white = white / scale[:, None]
    values = rows @ free
    low, high = (lower - values) / scale, (upper - values) / scale
    reach = max(float(low.max()), float(-high.min()), 1e-300)
    low, high = low / reach, high / reach
    guesses = (_solver_multipliers(plugin, white, low, high) for plugin in SOLVERS)
    for guess in chain(guesses, map(_least_distance_multipliers, [white], [low], [high])):
        found = _polish(white, low, high, guess)
        if found is not None:
            w, multipliers = found[0] * reach, found[1] * reach
            active = tuple(c.name for c, m in zip(constraints, multipliers, strict=True) if m != 0.0)
            return ConstrainedLeastSquares(x=free + inverse @ w, active=active, multipliers=multipliers / scale)
    raise _explain(white, low, high, constraints)


def _solver_multipliers(
    plugin: str, white: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Ask one of CasADi's solvers for the multipliers; NaN where it fails."""
    solver = _conic(white.shape[1], white.shape[0], plugin)
    with ONE_AT_A_TIME:
        return np.asarray(solver(h=np.eye(white.shape[1]), a=white, lba=low, uba=high)["lam_a"]).ravel()


def _least_distance_multipliers(
    white: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Solve the same problem as nonnegative least squares (Lawson and Hanson 1974, ch. 23.4): slow and sure."""
    from scipy.optimize import nnls

    rows, bounds = np.vstack([white, -white]), np.concatenate([low, -high])
    finite = np.isfinite(bounds)
    problem = np.vstack([rows[finite].T, bounds[finite]])
    target = np.append(np.zeros(white.shape[1]), 1.0)
    weights, _ = nnls(problem, target, maxiter=100 * problem.shape[1])
    share = 1.0 - problem[-1] @ weights
    if share <= 1e-14:
        return np.full(low.size, np.nan)
    multipliers = np.zeros(bounds.size)
    multipliers[finite] = weights / share
    return multipliers[low.size :] - multipliers[: low.size]


def _polish(
    white: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    multipliers: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Solve exactly on the active set that a solver found, and check optimality; None if it is not optimal.

    Constraints whose multiplier comes out with the wrong sign leave the set, violated ones enter it.
    """
    if not np.isfinite(multipliers).all():
        return None
    sign = np.where(np.abs(multipliers) > 1e-9, np.sign(multipliers), 0.0)
    for _ in range(3 * white.shape[0] + 3):
        on = sign != 0.0
        tight, target = white[on], np.where(sign > 0, high, low)[on]
        q, r = np.linalg.qr(tight.T)
        if on.any() and np.abs(r.diagonal()).min() <= 1e-12:
            return None
        along = np.linalg.solve(r.T, target)
        w = q @ along
        exact = np.zeros(sign.size)
        exact[on] = -np.linalg.solve(r, along)
        excess = np.maximum(low - white @ w, white @ w - high)
        wrong = exact * sign < -1e-12 * max(float(np.abs(exact).max()), 1.0)
        if not wrong.any() and excess.max() <= FEASIBLE:
            return w, exact
        if wrong.any():
            sign[int(np.argmin(exact * sign))] = 0.0
        else:
            worst = int(np.argmax(excess))
            if sign[worst] != 0.0:
                return None
            sign[worst] = 1.0 if (white @ w)[worst] > high[worst] else -1.0
    return None


def _explain(
    white: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64], constraints: Sequence[Constraint]
) -> Exception:
    """Relax every constraint by a slack, make the slacks' sum small, and say where they do not vanish."""
    m, p = white.shape
    relaxed = np.hstack([white, np.eye(m), -np.eye(m)])
    hessian = np.diag(np.concatenate([np.full(p, 1e-8), np.zeros(2 * m)]))
    bounds = np.concatenate([np.full(p, -np.inf), np.zeros(2 * m)])
    solver = _conic(p + 2 * m, m, "highs")
    cost, above = np.concatenate([np.zeros(p), np.ones(2 * m)]), np.full(p + 2 * m, np.inf)
    with ONE_AT_A_TIME:
        solution = solver(h=hessian, g=cost, a=relaxed, lba=low, uba=high, lbx=bounds, ubx=above)
    slack = np.abs(np.asarray(solution["x"]).ravel()[p:]).reshape(2, m).sum(axis=0)
    guilty = [c.name for c, s in zip(constraints, slack, strict=True) if s > 1e-6]
    if guilty:
        return InputError(f"the constraints contradict each other; relax {', '.join(guilty)}")
    return NumericalError("the solver of the constrained fit did not reach an optimum although one exists")


@lru_cache(maxsize=64)
def _conic(variables: int, rows: int, plugin: str = "daqp") -> Any:
    """Return a quadratic-programming solver of CasADi for a diagonal Hessian; it never prints."""
    import casadi as ca

    quiet: dict[str, Any] = {"error_on_fail": False, **QUIET.get(plugin, {})}
    problem = {"h": ca.Sparsity.diag(variables), "a": ca.Sparsity.dense(rows, variables)}
    return ca.conic("fit", plugin, problem, quiet)


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NonlinearResult:
    """Where a nonlinear program ended.

    Attributes
    ----------
    x : ndarray
        The last iterate.
    success : bool
        Whether the solver found a local optimum and the constraints hold there.
    violation : float
        Largest violation of a constraint.
    status : str
        The solver's own word.
    """

    x: NDArray[np.float64]
    success: bool
    violation: float
    status: str


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NonlinearProgram:
    """``min f(x, p)`` subject to bounds on ``g(x, p)``: CasADi expressions, compiled once.

    Attributes
    ----------
    x, f, g, p : casadi.MX
        Unknowns, cost, constraints, parameters.
    solver : casadi.Function
        IPOPT, silent.
    """

    x: Any
    f: Any
    g: Any
    p: Any
    solver: Any = None

    def __post_init__(self) -> None:
        import casadi as ca

        problem = {"x": self.x, "f": self.f, "g": self.g, "p": self.p}
        object.__setattr__(self, "solver", ca.nlpsol("program", "ipopt", problem, IPOPT))


def minimise(
    program: NonlinearProgram,
    start: NDArray[np.float64],
    *,
    bounds: tuple[Any, Any],
    constraint_bounds: tuple[Any, Any],
    parameters: Any = (),
) -> NonlinearResult:
    """Solve a nonlinear program by IPOPT and check what it says.

    Parameters
    ----------
    program : NonlinearProgram
        What to solve.
    start : ndarray
        First iterate.
    bounds, constraint_bounds : pair
        Lower and upper bounds of x and of g.
    parameters : array_like
        Values of p.
    """
    with ONE_AT_A_TIME:
        solution = program.solver(
            x0=start, lbx=bounds[0], ubx=bounds[1], lbg=constraint_bounds[0], ubg=constraint_bounds[1], p=parameters
        )
        stats = program.solver.stats()
    values = np.asarray(solution["g"]).ravel()
    low, high = np.broadcast_to(constraint_bounds[0], values.shape), np.broadcast_to(constraint_bounds[1], values.shape)
    violation = float(np.max(np.maximum(low - values, values - high), initial=0.0))
    return NonlinearResult(
        x=np.asarray(solution["x"]).ravel(),
        success=bool(stats["success"]) and violation <= 1e-6,
        violation=violation,
        status=str(stats["return_status"]),
    )
