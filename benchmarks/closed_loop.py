"""The sampled closed loop with Coulomb friction against python-control, and against a loop written by hand in C.

A cart (β 1.91, c 6, friction 0.4 m/s²) under a digital PD at 1 kHz visits 0.1, 0 and 0.1 m for a second each; it
reverses and sticks. The reference is the laboratory of servolens, which shares no equation with the simulator, by
Runge–Kutta steps of 20 µs.

python-control cannot run a sampled controller on a continuous plant, so its loop is the continuous one with smoothed
friction, simulated with its defaults, which put it a hundredth of the step off, and with the bridge's settings. Its
most faithful form holds the voltage by hand, one call of ``input_output_response`` a sample; that is measured once.

The C loop runs the same algorithm, its derivatives written by hand for this cart; compiled by ``gcc -O2``. Both kernels
fill arrays that exist already.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest import mock

import control as ct
import numpy as np
from harness import Figure, alternate

from servolens import lab
from servolens.bridge import SOLVER, closed_loop, to_control
from servolens.effects import CoulombFriction
from servolens.plant import Plant
from servolens.record import Controller
from servolens.simulation import simulate_loop
from servolens.simulation.native import WORK_THAT_PAYS, native
from servolens.simulation.rates import substeps_for
from servolens.simulation.settings import NO_LAW, NO_OBSERVER, known, loop_settings

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from servolens.record import Record

KP, KD, PERIOD, LEVELS = 100.0, 2.0, 1e-3, (0.1, 0.0, 0.1)
GAIN, DAMPING, FRICTION = 1.91, 6.0, 0.4
CART = Plant(gain=GAIN, damping=DAMPING, effects=(CoulombFriction(level=FRICTION),))
LOOP = Controller(kp=KP, kd=KD)


def figures() -> list[Figure]:
    """Measure."""
    fine = _reference()
    grid, levels = fine.time, fine.reference
    assert levels is not None
    system = closed_loop(CART, KP, KD)
    runs: list[Callable[[], Any]] = [
        lambda: simulate_loop(CART, LOOP, grid, levels).position,
        lambda: ct.input_output_response(system, grid, levels).states[0],
        lambda: ct.input_output_response(system, grid, levels, solve_ivp_kwargs=SOLVER).states[0],
    ]
    ours, plain, careful = alternate(runs, seconds=6.0)
    errors = [_distance(run(), fine) for run in runs]
    start = time.perf_counter()
    by_hand = _distance(_held_by_hand(grid, levels), fine)
    sample_by_sample = time.perf_counter() - start
    name = "sampled loop, 3 s with Coulomb friction"
    found = [
        Figure(
            name=f"{name}: faster than input_output_response, defaults",
            value=plain / ours,
            unit="times",
            target=1000,
            better="higher",
        ),
        Figure(
            name=f"{name}: faster than input_output_response, bridge's settings",
            value=careful / ours,
            unit="times",
            target=1000,
            better="higher",
        ),
        Figure(
            name=f"{name}: faster than input_output_response sample by sample",
            value=sample_by_sample / ours,
            unit="times",
            target=1000,
            better="higher",
        ),
        Figure(
            name=f"{name}: error relative to the best of these",
            value=errors[0] / min(*errors[1:], by_hand),
            unit="",
            target=1,
            better="lower",
        ),
        Figure(name=f"{name}: time", value=ours * 1e6, unit="µs", target=None, better="lower"),
    ]
    names = (
        "ours",
        "python-control, defaults",
        "python-control, bridge's settings",
        "python-control, sample by sample",
    )
    found += [
        Figure(name=f"{name}: largest error, {who}", value=e * 1e6, unit="µm", target=None, better="lower")
        for who, e in zip(names, (*errors, by_hand), strict=True)
    ]
    return found + _against_c(grid, levels, fine)


def _reference() -> Record:
    truth = lab.Truth(gain=GAIN, damping=DAMPING, effects={"coulomb_friction": {"level": FRICTION}})
    with mock.patch("servolens.lab.loop.SUBSTEP", 2e-5):
        return lab.step_record(truth, KP, KD, reference=LEVELS, duration=1.0, sample_time=PERIOD, encoder=0.0)


def _held_by_hand(grid: NDArray[np.float64], levels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Close the digital loop around python-control's plant: one response a sample, its voltage held."""
    plant = to_control(CART)
    state, before, position = np.zeros(2), 0.0, np.empty(grid.size)
    for k, level in enumerate(levels):
        position[k] = state[0]
        voltage = KP * (level - state[0]) - KD * (state[0] - before) / PERIOD
        before = state[0]
        if k + 1 < grid.size:
            response = ct.input_output_response(
                plant, grid[k : k + 2], [voltage, voltage], state, solve_ivp_kwargs=SOLVER
            )
            state = response.states[:, -1]
    return position


def _distance(position: NDArray[np.float64], fine: Record) -> float:
    return float(np.abs(position - fine.position).max())


def _against_c(grid: NDArray[np.float64], levels: NDArray[np.float64], fine: Record) -> list[Figure]:
    if shutil.which("gcc") is None:
        print("  no gcc here: the comparison with C is left out")
        return []
    substeps, n = substeps_for(CART, PERIOD), grid.size
    mine, theirs = [np.empty((3, n)), np.empty(n)], [np.empty(n) for _ in range(4)]
    law = [*loop_settings(LOOP, PERIOD), 0.0, 0.0, *known(None), *NO_OBSERVER, *NO_LAW]
    settings, corrections = np.array([1.0, *law]), np.zeros(3)
    start, held, numbers = np.zeros(2), np.zeros(n), np.array(CART.values)
    compiled, done, delay = native(CART.structure, work=WORK_THAT_PAYS).runs, ctypes.c_int64(), ctypes.c_double()
    given = (grid, held, levels, settings, start, numbers, corrections, *mine)
    places = (ctypes.c_int64 * len(given))(*(array.ctypes.data for array in given))
    own = (1, n, substeps, *(ctypes.addressof(one) for one in (delay, places, done)))
    with tempfile.TemporaryDirectory() as folder:
        by_hand = _c_loop(Path(folder))
        pointers = [ctypes.c_void_p(a.ctypes.data) for a in (grid, levels, *theirs)]
        scalars = [ctypes.c_double(x) for x in (KP, KD, PERIOD, 0.0, GAIN, DAMPING, FRICTION)]
        arguments = (ctypes.c_long(n), *pointers[:2], *scalars, ctypes.c_long(substeps), *pointers[2:])
        ours, c, whole = alternate(
            [
                lambda: compiled(*own),
                lambda: by_hand(*arguments),
                lambda: simulate_loop(CART, LOOP, grid, levels),
            ],
            seconds=3.0,
        )
    assert np.allclose(mine[0][0], theirs[0], atol=1e-12, rtol=0)
    assert _distance(theirs[0], fine) < 1e-6
    return [
        Figure(
            name="kernel: time relative to a C loop, gcc -O2", value=ours / c, unit="times", target=2, better="lower"
        ),
        Figure(
            name="simulate_loop, Python and all: time relative to that C loop",
            value=whole / c,
            unit="times",
            target=None,
            better="lower",
        ),
        Figure(name="C loop: time", value=c * 1e6, unit="µs", target=None, better="lower"),
    ]


def _c_loop(folder: Path) -> Any:
    source, library = Path(__file__).with_name("closed_loop.c"), folder / "closed_loop.so"
    subprocess.run(["gcc", "-O2", "-shared", "-fPIC", "-o", library, source, "-lm"], check=True)
    run = ctypes.CDLL(str(library)).run
    run.restype = None
    return run
