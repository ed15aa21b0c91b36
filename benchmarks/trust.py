"""Digits that the fits' minimiser and the simulator get right where others know the answer, into docs/trust.md."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from pages import as_table, write_tables

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from certified import PROBLEMS, digits, fitted, solved
from closed_forms import CASES, MICROSECONDS, relative_error

PAGE = Path(__file__).parents[1] / "docs" / "trust.md"


def main() -> None:
    """Compute both tables and write them into the page."""
    write_tables(PAGE, {"regressions": regressions(), "friction": friction()})


def regressions() -> str:
    """Return the digits of each of NIST's problems, from both starts."""
    rows = []
    for name, problem in PROBLEMS.items():
        ends = [solved(problem, start) for start in (0, 1)]
        found = (f"{digits(end.values, problem.certified):.1f}" for end in ends)
        spread = (f"{digits(end.deviations, problem.deviations):.1f}" for end in ends)
        ended = (_as_it_ends(problem, start) for start in (0, 1))
        rows.append([name, problem.difficulty, problem.certified.size, *map(", ".join, (found, spread, ended))])
    heads = ("problem", "difficulty", "parameters", "their digits", "digits of deviations", "where a fit stops")
    return as_table(heads, rows)


def _as_it_ends(problem, start) -> str:
    found = fitted(problem, start)
    if found.undetermined:
        return "undetermined"
    if not found.converged:
        return "not converged"
    away = np.abs(np.array(found.plant.effects[0].values) - problem.certified) / problem.deviations
    return f"{away.max():.0e}"


def friction() -> str:
    """Return the errors of sticking and sliding, as shares of the travel."""
    rows = [[case.name, _share(relative_error(case, MICROSECONDS)), _share(relative_error(case))] for case in CASES]
    return as_table(("motion", "steps of 1 µs", "steps as the simulator chooses them"), rows)


def _share(error: float) -> str:
    return f"{error:.0e}" if error else "0"


if __name__ == "__main__":
    main()
