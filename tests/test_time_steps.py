"""Loops that divide by the time that they measured, where the voltage that would show it is not logged."""

from __future__ import annotations

from dataclasses import replace

import pytest

from servolens import diagnose, lab
from servolens.record import Controller

RUBBING = lab.Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.3}})


def run(kp, kd, seed, time_step):
    """Return a run of which neither the voltage nor the time step of the loop is known."""
    around = lab.Surroundings(noise=lab.SensorNoise(deviation=1e-5), encoder=0.0, jitter=lab.Jitter(share=0.15))
    rig = lab.Setup(controller=Controller(kp=kp, kd=kd, time_step=time_step), surroundings=around)
    logged = lab.step_record(RUBBING, sample_time=4e-3, reference=(0.1, 0.02, 0.07), duration=0.6, seed=seed, setup=rig)
    return logged.with_({"voltage": None, "controller": replace(logged.controller, time_step="cycle")})


@pytest.mark.parametrize("time_step", ["measured", "cycle"])
def test_time_steps_that_a_loop_measured_are_found_where_the_motion_shows_them(time_step):
    found = diagnose([run(60, 4, 1, time_step), run(120, 6, 2, time_step)], effort="quick")
    assert found.verdict == "explained"
    assert [cause.effect for cause in found.causes] == ["coulomb_friction"]
    told = [finding.severity for finding in found.findings if finding.code == "time_steps_assumed"]
    assert told == (["warning"] if time_step == "measured" else [])
    assert found.records[0].controller.time_step == time_step
