"""The map over both gains says of each pair what a simulation says, and its noise is that of a simulated controller."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servolens.design import PDSpec, evaluate, gain_map, noise_gain
from servolens.effects import CoulombFriction, VelocityDecayDamping
from servolens.errors import InputError
from servolens.plant import Plant
from servolens.report.plots_design import plot_gain_map

PAPER = Plant(gain=1.91, damping=3.799, effects=(VelocityDecayDamping(alpha1=15.2528, alpha2=5.9934),))
SPEC = PDSpec(kp=100.0, settling_time=0.5)


def test_each_pair_of_a_map_is_what_evaluate_says() -> None:
    sticky = PAPER.with_effect(CoulombFriction(level=0.1))
    kp, kd = np.linspace(40.0, 160.0, 7), np.linspace(0.0, 12.0, 9)
    found = gain_map([PAPER, sticky], SPEC, kp, kd)
    for i, one in enumerate(kp):
        for j, other in enumerate(kd):
            both = [evaluate(plant, replace(SPEC, kp=float(one)), float(other)) for plant in (PAPER, sticky)]
            assert found.feasible[i, j] == all(response.meets for response in both)
            if found.feasible[i, j]:
                assert found.settling_time[i, j] == max(r.settling_time or 0.0 for r in both)
    assert found.feasible.any()
    assert not found.feasible.all()
    pair = found.least_noise
    assert pair is not None
    least = noise_gain(replace(SPEC, kp=pair[0]), pair[1])
    assert least == found.noise[found.feasible].min()


@pytest.mark.parametrize("share", [1.0, 0.3])
def test_noise_is_that_of_a_controller_run_on_white_noise(share: float) -> None:
    spec, kd = replace(SPEC, derivative_filter=share), 2.0
    noise = np.random.default_rng(1).normal(size=200_000)
    slope, voltage = 0.0, np.empty(noise.size)
    for k in range(noise.size):
        slope += share * ((noise[k] - noise[max(k - 1, 0)]) / spec.sample_time - slope)
        voltage[k] = -spec.kp * noise[k] - kd * slope
    assert noise_gain(spec, kd) == pytest.approx(voltage.std(), rel=0.02)


def test_an_unstable_pair_is_infeasible_and_a_map_without_gains_is_refused() -> None:
    found = gain_map(PAPER, SPEC, [100.0], [0.0, 5000.0])
    assert not found.feasible.any()
    assert found.least_noise is None
    with pytest.raises(InputError, match="at least one"):
        gain_map(PAPER, SPEC, [], [1.0])
    with pytest.raises(InputError, match="kd of a map"):
        gain_map(PAPER, SPEC, [100.0], [-1.0])


def test_the_map_is_drawn_with_its_feasible_region_and_the_pair_of_least_noise() -> None:
    found = gain_map(PAPER, SPEC, np.linspace(60.0, 140.0, 9), np.linspace(2.0, 10.0, 9))
    ax = plot_gain_map(found)
    assert ax.get_xlabel() == "Kp [V/m]"
    assert ax.get_ylabel() == "Kd [V s/m]"
    (mark,) = ax.get_lines()
    assert (mark.get_xdata()[0], mark.get_ydata()[0]) == found.least_noise  # type: ignore[index]  # arrays
