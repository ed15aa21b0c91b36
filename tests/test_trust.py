"""Certified regressions, sticking and sliding in closed form, and the same bytes on one processor and on two."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from certified import PROBLEMS, digits, fitted, solved
from closed_forms import CASES, MICROSECONDS, exact, relative_error

from servolens import lab

ROUNDED = "Lanczos1"
"""Data computed to 13 digits: what is left is their rounding, and the certified standard deviations are of that."""
FAR = {("MGH17", 0), ("BoxBOD", 0), ("MGH10", 0)}
"""Starts from which the minimiser leaves for a parameter that the data then say nothing of."""
STARTS = [(name, start) for name in PROBLEMS for start in (0, 1)]
each_start = pytest.mark.parametrize(("name", "start"), STARTS, ids=[f"{name}-{start + 1}" for name, start in STARTS])
each_case = pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])


@pytest.mark.parametrize("name", PROBLEMS)
def test_data_of_a_certified_problem_are_those_that_were_certified(name):
    problem = PROBLEMS[name]
    residual = problem.curve(problem.certified) - problem.y
    squares = float(residual @ residual)
    if name == ROUNDED:  # certified to 1.4e-25, which parameters of 11 digits cannot give
        assert squares < 1e-20
    else:
        assert squares == pytest.approx(problem.residual_sum_of_squares, rel=2e-10)


@each_start
def test_the_minimiser_of_fits_reaches_certified_parameters_to_six_digits(name, start):
    problem = PROBLEMS[name]
    found = solved(problem, start)
    if (name, start) in FAR:
        assert found.squares > 1.1 * problem.residual_sum_of_squares
        times = 10.0 if name == "MGH17" else 1e3  # there two terms of the curve grow against each other
        assert not np.isfinite(found.deviations).all() or (found.deviations > times * np.abs(found.values)).any()
        return
    assert found.converged
    assert digits(found.values, problem.certified) >= 6.0
    if name != ROUNDED:
        assert digits(found.deviations, problem.deviations) >= 4.0


@each_start
def test_a_fit_that_claims_an_optimum_has_the_certified_one(name, start):
    problem = PROBLEMS[name]
    found = fitted(problem, start)
    if found.converged and not found.undetermined:
        away = np.abs(np.array(found.plant.effects[0].values) - problem.certified) / problem.deviations
        assert away.max() < 0.01  # of a standard error: what a fit neglects
    else:
        assert (name, start) in FAR or "stopped before" in found.status


@each_case
def test_sticking_and_sliding_follow_their_closed_form(case):
    assert relative_error(case, MICROSECONDS) < 1e-9


def test_a_released_mass_stops_where_its_manual_says():
    released = CASES[0]
    position, rests = exact(released, np.linspace(0.0, released.duration, 2001))
    turns = [0.85e-3 - 0.2e-3 * n for n in range(5)]  # less twice level / stiffness a half swing, until that holds it
    assert len(rests) == len(turns)
    assert position[-1] == pytest.approx(turns[-1], abs=1e-15)


def test_closed_forms_stick_and_slide_as_their_names_say():
    rests = {case.name: exact(case, np.array([0.0, case.duration]))[1] for case in CASES}
    plane = [rests[case.name] for case in CASES if "plane" in case.name]
    assert plane[0] == [2.0]
    assert min(plane[1][:-1]) > 0.05
    assert plane[2][1:] == [0.0] * (len(plane[2]) - 1)
    pulled = next(rests[case.name] for case in CASES if "weaker" in case.name)
    assert len(pulled) > 5
    assert np.ptp(pulled[1:-1]) < 1e-9  # stick-slip repeats itself


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    folder = tmp_path_factory.mktemp("records")
    truth = lab.Truth(
        gain=1.9,
        damping=6.0,
        effects={"stribeck_friction": {"level": 0.2, "static_excess": 0.3, "stribeck_speed": 0.03}},
    )
    paths = []
    for kp in (60, 90):
        run = lab.step_record(truth, kp, noise=1e-5, seed=kp, duration=2.0)
        columns = np.column_stack([run.time, run.reference, run.position, run.voltage])
        paths.append(folder / f"kp{kp}.csv")
        np.savetxt(paths[-1], columns, "%.17g", ",", header=f"kp = {kp}\n# kd = 0\ntime,reference,position,voltage")
        paths[-1].write_text(paths[-1].read_text(encoding="utf-8").replace("# time", "time"), encoding="utf-8")
    return paths


@pytest.mark.slow
def test_results_are_the_same_bytes_on_one_processor_and_on_two(records):
    alone = study(records, processors=1)
    assert alone.count(b"\n") > 100
    assert study(records, processors=2) == alone


def study(records, *, processors):
    """Return the JSON of the whole chain, but for `created`; one processor is bound to one, with its linear algebra."""
    threads = {name: str(processors) for name in ("SERVOLENS_PROCESSORS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    bind = (
        "import os; os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:1]); "
        if processors == 1 and hasattr(os, "sched_setaffinity")
        else ""
    )
    script = f"{bind}from servolens.cli import main; main()"
    arguments = ["tune", *records, "--settling-time", "0.5", "--kp", "80", "--effort", "quick", "--json", "-"]
    done = subprocess.run(
        [sys.executable, "-c", script, *map(str, arguments)], env={**os.environ, **threads}, capture_output=True
    )
    assert done.returncode == 0, done.stderr.decode()
    return b"\n".join(line for line in done.stdout.splitlines() if b'"created"' not in line)
