"""Regression problems with certified answers, solved by the minimiser of fits.

NIST's Statistical Reference Datasets, nonlinear regression (https://www.itl.nist.gov/div898/strd/nls/nls_main.shtml):
`nist_strd.json` holds data, starts, certified parameters and their standard deviations as published. A problem's curve
is written once, as the physics of an effect, from which the residuals are computed as well.
"""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass, make_dataclass
from math import pi
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from servolens.effects import Axis, Force, parameter
from servolens.identification.error_problem import Problem
from servolens.identification.minimiser import descend
from servolens.identification.options import FitOptions
from servolens.identification.refine import minimise_error
from servolens.identification.runs import OneByOne
from servolens.plant import Plant

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from servolens.identification.refine import Refinement

__all__ = ["PROBLEMS", "Certified", "Solution", "digits", "fitted", "solved"]

HELD = FitOptions(held=("gain", "damping"))
MOST_ITERATIONS, TO_THE_END = 5000, 1e-15
"""Until rounding lets no step gain anything; fits stop at a gain that no error bar shows, and after 60 iterations."""


def _three_decays(m, b, x):
    return b[1] * m.exp(-b[2] * x) + b[3] * m.exp(-b[4] * x) + b[5] * m.exp(-b[6] * x)


def _peaks(m, b, x):
    first, second = m.exp(-((x - b[4]) ** 2) / b[5] ** 2), m.exp(-((x - b[7]) ** 2) / b[8] ** 2)
    return b[1] * m.exp(-b[2] * x) + b[3] * first + b[6] * second


def _cubics(m, b, x):
    return (b[1] + b[2] * x + b[3] * x**2 + b[4] * x**3) / (1 + b[5] * x + b[6] * x**2 + b[7] * x**3)


def _waves(m, b, x):
    own, other = 2 * pi * x / b[4], 2 * pi * x / b[7]
    year = b[1] + b[2] * m.cos(2 * pi * x / 12) + b[3] * m.sin(2 * pi * x / 12)
    return year + b[5] * m.cos(own) + b[6] * m.sin(own) + b[8] * m.cos(other) + b[9] * m.sin(other)


CURVES: dict[str, Callable[..., Any]] = {
    "Misra1a": lambda m, b, x: b[1] * (1 - m.exp(-b[2] * x)),
    "Chwirut2": lambda m, b, x: m.exp(-b[1] * x) / (b[2] + b[3] * x),
    "Chwirut1": lambda m, b, x: m.exp(-b[1] * x) / (b[2] + b[3] * x),
    "Lanczos3": _three_decays,
    "Gauss1": _peaks,
    "Gauss2": _peaks,
    "DanWood": lambda m, b, x: b[1] * x ** b[2],
    "Misra1b": lambda m, b, x: b[1] * (1 - (1 + b[2] * x / 2) ** -2),
    "Kirby2": lambda m, b, x: (b[1] + b[2] * x + b[3] * x**2) / (1 + b[4] * x + b[5] * x**2),
    "Hahn1": _cubics,
    "Nelson": lambda m, b, x, z: b[1] - b[2] * x * m.exp(-b[3] * z),
    "MGH17": lambda m, b, x: b[1] + b[2] * m.exp(-x * b[4]) + b[3] * m.exp(-x * b[5]),
    "Lanczos1": _three_decays,
    "Lanczos2": _three_decays,
    "Gauss3": _peaks,
    "Misra1c": lambda m, b, x: b[1] * (1 - (1 + 2 * b[2] * x) ** -0.5),
    "Misra1d": lambda m, b, x: b[1] * b[2] * x / (1 + b[2] * x),
    "Roszman1": lambda m, b, x: b[1] - b[2] * x - m.arctan(b[3] / (x - b[4])) / pi,
    "ENSO": _waves,
    "MGH09": lambda m, b, x: b[1] * (x**2 + x * b[2]) / (x**2 + x * b[3] + b[4]),
    "Thurber": _cubics,
    "BoxBOD": lambda m, b, x: b[1] * (1 - m.exp(-b[2] * x)),
    "Rat42": lambda m, b, x: b[1] / (1 + m.exp(b[2] - b[3] * x)),
    "MGH10": lambda m, b, x: b[1] * m.exp(b[2] / (x + b[3])),
    "Eckerle4": lambda m, b, x: b[1] / b[2] * m.exp(-0.5 * ((x - b[3]) / b[2]) ** 2),
    "Rat43": lambda m, b, x: b[1] / (1 + m.exp(b[2] - b[3] * x)) ** (1 / b[4]),
    "Bennett5": lambda m, b, x: b[1] * (b[2] + x) ** (-1 / b[3]),
}
"""Of parameters b[1], b[2] … and predictors, with the functions of NumPy or CasADi; in the order of NIST."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Certified:
    """A problem: what NIST publishes of it, and its curve as an effect of the time x (and the position, if two)."""

    name: str
    difficulty: str
    starts: NDArray[np.float64]
    certified: NDArray[np.float64]
    deviations: NDArray[np.float64]
    residual_sum_of_squares: float
    x: NDArray[np.float64]
    y: NDArray[np.float64]

    def curve(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the curve of parameters `values` at the data's x."""
        with np.errstate(all="ignore"):  # on the way a minimiser tries what has no value
            return np.asarray(CURVES[self.name](np, [None, *values], *self.x))

    def plant(self, values: NDArray[np.float64]) -> Plant:
        """Return an axis whose one effect has these parameters."""
        names = [f"b{i}" for i in range(1, values.size + 1)]

        def physics(axis: Axis, p: Any) -> Any:
            import casadi

            predictors = (axis.time, axis.position)[: len(self.x)]
            return CURVES[self.name](casadi, [None, *(getattr(p, name) for name in names)], *predictors)

        told = {"name": self.name.lower(), "sentence": "It is a curve.", "latex": "f", "physics": staticmethod(physics)}
        fields = [(name, float, parameter("b", "1", "of the curve", low=-1e12, per_mass=0)) for name in names]
        effect = make_dataclass(
            self.name, fields, bases=(Force,), frozen=True, slots=True, kw_only=True, namespace=told
        )
        return Plant(gain=1.0, damping=0.0, effects=(effect(**dict(zip(names, values, strict=True))),))


class Curve(OneByOne):
    """A problem's data as a run; see :class:`servolens.identification.runs.Run`."""

    group, sample_time, start, shifts = 0, 1.0, np.empty(0), ()

    def __init__(self, problem: Certified) -> None:
        self.samples, self._problem = problem.y.size, problem

    def missed(self, plant: Plant, start: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
        """Return curve minus data."""
        return self._problem.curve(np.array(plant.effects[0].values)) - self._problem.y

    residual = missed


class Solution(NamedTuple):
    """Parameters, their standard errors if the noise is white, the residual's squares, and whether it is an optimum."""

    values: NDArray[np.float64]
    deviations: NDArray[np.float64]
    squares: float
    converged: bool


def solved(problem: Certified, start: int) -> Solution:
    """Return where the minimiser ends from start 0 or 1 if it goes on as long as a step gains anything."""
    search = Problem(problem.plant(problem.starts[start]), [Curve(problem)], HELD, 1.0)
    point, converged = descend(search, search.start(), MOST_ITERATIONS, TO_THE_END)
    information = search.linearise(point).information
    scale, deviations = np.sqrt(np.diag(information)), np.full(point.values.size, np.inf)
    if (scale > 0.0).all():
        with suppress(np.linalg.LinAlgError):  # of parameters that the data do not tell apart there
            inverse = np.linalg.inv(information / np.outer(scale, scale))
            variances = np.diag(inverse)  # rounding may leave a negative one
            deviations = np.sqrt(search.variance(point) * np.where(variances > 0.0, variances, np.inf)) / scale
    return Solution(point.values, deviations, point.cost, converged)


def fitted(problem: Certified, start: int) -> Refinement:
    """Return what a fit makes of the problem, with its own rule when to stop."""
    return minimise_error(problem.plant(problem.starts[start]), [Curve(problem)], HELD, noise=1.0)


def digits(found: NDArray[np.float64], certified: NDArray[np.float64]) -> float:
    """Return to how many digits the worst of the values agrees, at most the 11 that are certified; 0 if to none."""
    error = float(np.max(np.abs(np.asarray(found) / certified - 1.0)))
    return 0.0 if not error < 1.0 else float(min(-np.log10(max(error, 1e-11)), 11.0))


def _read() -> dict[str, Certified]:
    stored = json.loads(Path(__file__).with_name("nist_strd.json").read_text(encoding="utf-8"))
    problems = {}
    for name in CURVES:
        known = {key: np.array(value) if isinstance(value, list) else value for key, value in stored[name].items()}
        if name == "Nelson":  # log y is modelled
            known["y"] = np.log(known["y"])
        problems[name] = Certified(name=name, **known)
    return problems


PROBLEMS = _read()
