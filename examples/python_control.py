"""The identified plant inside python-control: linearise it, close the loop by hand, find its margins."""

from __future__ import annotations

import control as ct
import numpy as np

from servolens import identify, to_control
from servolens.bridge import SOLVER
from servolens.lab import NLM1, step_record


def main() -> None:
    plant = identify(step_record(NLM1, kp=60, encoder=1e-5, noise=1e-5, seed=1)).velocity.plant
    axis = to_control(plant, name="axis")

    at_rest = ct.linearize(axis, [0.0, 0.0], [0.0])
    print("poles at rest [1/s]:   ", np.round(np.sort(at_rest.poles().real), 3))
    moving = ct.linearize(axis, [0.0, 0.5], [0.0])
    print("poles at 0.5 m/s [1/s]:", np.round(np.sort(moving.poles().real), 3))

    controller = ct.ss([], [], [], [[60.0, -60.0, -3.0]], inputs=["r", "position", "velocity"], outputs=["voltage"])
    loop = ct.interconnect([axis, ct.ss(controller, name="pd")], inputs=["r"], outputs=["position"], name="loop")
    time = np.linspace(0.0, 1.0, 1001)
    response = ct.input_output_response(
        loop, time, np.full(time.size, 0.1), solve_ivp_method=SOLVER["method"], solve_ivp_kwargs=_rest(SOLVER)
    )
    print(f"position after 1 s: {response.outputs[-1]:.5f} m")
    gain, phase, _, crossover = ct.margin(ct.tf(at_rest[0, 0]) * ct.tf([3.0, 60.0], [1e-3, 1.0]))
    print(f"with kp = 60, kd = 3 at rest: phase margin {phase:.1f}° at {crossover:.1f} rad/s, gain margin {gain:.3g}")


def _rest(settings: dict) -> dict:
    return {name: value for name, value in settings.items() if name != "method"}


if __name__ == "__main__":
    main()
