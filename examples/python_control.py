"""Plants inside python-control: linearise them, close loops, see what a coupling, a lag and a delay do to them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import control as ct
import numpy as np

from servolens import identify
from servolens.bridge import closed_loop, held_response, to_control
from servolens.effects import ActuatorLag, Delay, FlexibleCoupling
from servolens.lab import NLM1, step_record

if TYPE_CHECKING:
    from servolens.plant import Plant

TIME = np.linspace(0.0, 1.0, 1001)
STEP = np.full(TIME.size, 0.1)


def main() -> None:
    plant = identify(step_record(NLM1, kp=60, encoder=1e-5, noise=1e-5, seed=1)).velocity.plant
    identified(plant)
    coupled(plant)
    delayed(plant)


def identified(plant: Plant) -> None:
    """Join the identified plant to a controller by hand."""
    axis = to_control(plant, name="axis")
    at_rest = ct.linearize(axis, [0.0, 0.0], [0.0])
    print("poles at rest [1/s]:   ", np.round(np.sort(at_rest.poles().real), 3))
    moving = ct.linearize(axis, [0.0, 0.5], [0.0])
    print("poles at 0.5 m/s [1/s]:", np.round(np.sort(moving.poles().real), 3))

    inputs = ["reference", "position", "velocity"]
    controller = ct.ss([], [], [], [[60.0, -60.0, -3.0]], inputs=inputs, outputs=["voltage"], name="pd")
    loop = ct.interconnect([axis, controller], inputs=["reference"], outputs=["position"], name="loop")
    response = held_response(loop, TIME, STEP)
    print(f"position after 1 s: {response.outputs[-1]:.5f} m")
    gain, phase, _, crossover = ct.margin(ct.tf(at_rest[0, 0]) * ct.tf([3.0, 60.0], [1e-3, 1.0]))
    print(f"with kp = 60, kd = 3 at rest: phase margin {phase:.1f}° at {crossover:.1f} rad/s, gain margin {gain:.3g}")


def coupled(plant: Plant) -> None:
    """Hang the load on a spring, behind a slow amplifier: Bode data, and the loop, checked against the kernel."""
    spring = FlexibleCoupling(frequency=12.0, damping_ratio=0.03, load_ratio=0.3)
    plant = plant.with_effect(spring).with_effect(ActuatorLag(time_constant=0.003))
    axis = to_control(plant, name="axis")
    print("states:", ", ".join(axis.state_labels))
    linear = axis.linearize(axis.at_rest(), 0.0)[0, 0]
    hertz = np.array([1.0, 11.0, 12.0, 13.0, 30.0])
    data = ct.frequency_response(linear, 2 * np.pi * hertz)
    for f, magnitude, phase in zip(hertz, data.magnitude, np.unwrap(data.phase), strict=True):
        print(f"{f:5.0f} Hz: {20 * np.log10(magnitude):7.1f} dB {np.degrees(phase):7.1f}°")

    for kd in (0.0, 3.0, 6.0):
        loop = closed_loop(plant, kp=60.0, kd=kd)
        response = held_response(loop, TIME, STEP, initial_state="at rest", check=True)  # warns if it cannot be trusted
        at_rest, moving = (loop.linearize(np.array([0.1, v, 0.1, v, 0.0]), 0.1).poles().real.max() for v in (0.0, 0.3))
        swing = np.ptp(response.outputs[0][TIME > 0.8])
        print(
            f"kd = {kd:g}: slowest pole at rest {at_rest:.2f} 1/s, at 0.3 m/s {moving:.2f} 1/s; "
            f"after 0.8 s it swings by {1e3 * swing:.2f} mm"
        )


def delayed(plant: Plant) -> None:
    """Take a delay of 20 ms as states, and find the kd that the loop bears."""
    loop = closed_loop(plant.with_effect(Delay(time=0.02)), kp=60.0, delay_order=3)
    for speed in (0.0, 0.3):
        state = loop.at_rest(0.1, 0.1)
        state[1] = speed
        slowest = {kd: loop.linearize(state, 0.1, params={"kd": kd}).poles().real.max() for kd in np.arange(0, 60, 0.5)}
        stable = [kd for kd, pole in slowest.items() if pole < 0]
        print(f"with a delay of 20 ms, at {speed:g} m/s, kd from {stable[0]:g} to {stable[-1]:g} V s/m is stable")


if __name__ == "__main__":
    main()
