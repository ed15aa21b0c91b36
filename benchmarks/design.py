"""The least gain of the paper's cart NLm3 (kp 100, 1 % in 0.5 s), the whole range of gains from 0 to 20 covered.

The rival is what a script with python-control would do: ``input_output_response`` and ``step_info`` for each gain of a
grid as fine as the gap of ours. A few gains are timed and the rest is counted. Beside it stand the times of CasADi's
program (in each interval, the search included) and of a proof by enclosures; and of the recommended gain over 200
scenarios of a model whose parameters are known to a percent, with a force that nothing explains, and over 200 of an
axis with play, whose steps take longer to simulate; and a map of 100 values of kp times 100 of kd.
"""

from __future__ import annotations

import time
from typing import Any

import control as ct
import numpy as np
from harness import Figure, alternate

from servolens.bridge import SOLVER, closed_loop
from servolens.design import PDSpec, gain_map, recommend, tune
from servolens.effects import Backlash, VelocityDecayDamping
from servolens.model import Model
from servolens.model_evidence import DataRange, Evidence, Remainder
from servolens.plant import Plant

CART = Plant(gain=1.91, damping=3.799, effects=(VelocityDecayDamping(alpha1=15.2528, alpha2=5.9934),))
SPEC = PDSpec(kp=100.0, settling_time=0.5, control="continuous", kd_max=20.0)
PLAY = Plant(gain=1.8, damping=6.0, effects=(Backlash(gap=1e-3, load_share=0.3),))
FEW = 5
DIGITAL = PDSpec(kp=100.0, settling_time=0.5)
LEFT = Remainder(
    rms=1e-5,
    times_noise=2.0,
    of_travel=1e-4,
    acceleration_rms=0.02,
    correlation_time=0.05,
    of_motor=1e-3,
    depends_on_inputs=True,
    material=False,
)
MODEL = Model(
    plant=CART,
    covariance=np.diag((0.01 * np.array(CART.values)) ** 2),
    evidence=Evidence(range=DataRange(voltage=10.0, speed=1.0, step=0.1), remainder=LEFT),
)


def figures() -> list[Figure]:
    """Measure."""
    found = tune(CART, SPEC)
    grid = np.arange(0.0, 10.0 * SPEC.settling_time, SPEC.sample_time)

    def rival() -> None:
        for kd in np.linspace(1.0, 15.0, FEW):
            loop = closed_loop(CART, SPEC.kp, float(kd))
            response: Any = ct.input_output_response(
                loop, grid, np.full(grid.size, SPEC.reference), solve_ivp_kwargs=SOLVER
            )
            ct.step_info(response.states[0], grid, SettlingTimeThreshold=SPEC.band)

    ours, program, theirs = alternate(
        [lambda: tune(CART, SPEC), lambda: tune(CART, SPEC, with_program=True), rival], seconds=6.0
    )
    digital = tune(CART, DIGITAL)
    (robust,) = alternate([lambda: recommend(MODEL, digital)], seconds=6.0)
    loose = tune(PLAY, DIGITAL)
    (rattling,) = alternate([lambda: recommend(PLAY, loose)], seconds=6.0)
    kp, kd = np.linspace(20.0, 200.0, 100), np.linspace(0.0, 15.0, 100)
    (mapped,) = alternate([lambda: gain_map(CART, DIGITAL, kp, kd)], seconds=6.0)
    gains = (found.certificate.searched[1] - found.certificate.searched[0]) / found.certificate.gap
    start = time.perf_counter()
    proven = tune(CART, SPEC, certify=True).certificate
    proof = time.perf_counter() - start
    name = "least kd of NLm3 over [0, 20]"
    return [
        Figure(name=f"{name}: time", value=ours, unit="s", target=0.1, better="lower"),
        Figure(name=f"{name}: gap", value=found.certificate.gap, unit="V s/m", target=1e-3, better="lower"),
        Figure(
            name=f"{name}: faster than a grid of python-control",
            value=theirs / FEW * gains / ours,
            unit="times",
            target=1000,
            better="higher",
        ),
        Figure(
            name="recommended kd of NLM3 over 200 scenarios: time", value=robust, unit="s", target=3.0, better="lower"
        ),
        Figure(
            name="recommended kd of an axis with play over 200 scenarios: time",
            value=rattling,
            unit="s",
            target=3.0,
            better="lower",
        ),
        Figure(name="map of NLm3, 100 kp times 100 kd: time", value=mapped, unit="s", target=1.5, better="lower"),
        Figure(name=f"{name}: time with CasADi's program", value=program, unit="s", target=None, better="lower"),
        Figure(name=f"{name}: time of a proof by enclosures", value=proof, unit="s", target=None, better="lower"),
        Figure(name=f"{name}: gap of the proof", value=proven.gap, unit="V s/m", target=None, better="lower"),
    ]
