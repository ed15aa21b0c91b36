"""An axis that is held where it would slide off by itself: a simulation runs away from it."""

import numpy as np
import pytest

from servolens import Plant, fit, lab


def away(truth, runs, **options):
    """Return how many standard errors what is fitted from the truth is away from it."""
    ((name, own),) = truth.effects.items()
    found = fit([Plant.effect_from(name, own)], runs, **options).quantities
    wanted = {f"{name}.{key}": value for key, value in own.items()} | {"gain": truth.gain, "damping": truth.damping}
    return np.array([(found[key].value - value) / found[key].stderr for key, value in wanted.items()])


@pytest.mark.parametrize("options", [{}, {"loss": "huber"}], ids=["squares", "huber"])
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_error_bars_of_an_arm_that_is_held_upright_hold_the_truth(seed, options):
    """Of its simulation, which falls over, they were many times too small."""
    arm = lab.Truth(gain=6.8, damping=3.0, effects={"pendulum_gravity": {"amplitude": 40.0, "phase": 3.0}})
    asked = {"duration": 0.6, "noise": 5e-6, "reference": (0.05, -0.05, 0.08), "setup": lab.Setup(length_unit="rad")}
    runs = [lab.step_record(arm, kp, seed=10 * seed + i, **asked) for i, kp in enumerate((30.0, 45.0))]
    assert np.abs(away(arm, runs, **options)).max() < 3.0


def test_error_bars_of_a_motor_that_is_held_between_two_teeth_hold_the_truth():
    """A hundred-thousandth of an amplitude decides in which tooth a simulation ends: errors were 600 of them."""
    campaign = lab.hidden_campaign(900483, effects=["cogging"])
    assert np.abs(away(campaign.truth, campaign.records)).max() < 3.0
