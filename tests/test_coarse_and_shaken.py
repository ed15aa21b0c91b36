"""Axes with a coarse encoder that something shakes by far more than one of its steps."""

import pytest

from servolens import Plant, diagnose, fit, lab
from servolens.identification.fitting import likelihood_of
from servolens.identification.options import FitOptions

ENCODER = 2e-5
AROUND = lab.Surroundings(
    noise=lab.SensorNoise(deviation=2e-6), encoder=ENCODER, shaking=lab.Shaking(deviation=0.1, correlation_time=0.05)
)


def campaign(truth, seed):
    setup = lab.Setup(surroundings=AROUND, start=7e-6)
    runs = ((40.0, 0.0, (0.1, 0.0, 0.1)), (100.0, 5.0, (0.1, 0.0, -0.05)), (70.0, 2.0, (0.1, 0.03)))
    return [
        lab.step_record(truth, kp, kd, seed=seed + int(kp), reference=levels, duration=0.8, setup=setup)
        for kp, kd, levels in runs
    ]


def test_shaking_is_seen_beside_a_coarse_encoder():
    plant = Plant(gain=1.9, damping=6.0)
    records = campaign(lab.Truth(gain=1.9, damping=6.0), 720_710)
    noise = likelihood_of(records, plant, FitOptions()).judged(plant).noise
    left = 1.0 - 1e-3 / 0.05
    power = (0.1 / noise.floor) ** 2 * (1.0 + left) / (1.0 - left)
    assert noise.rate == pytest.approx(power**0.25, rel=0.15)


@pytest.mark.slow
def test_causes_are_named_beside_a_coarse_encoder_and_shaking():
    truth = lab.Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.3}})
    *training, heldout = campaign(truth, 720_741)
    found = diagnose(training, heldout=[heldout])
    assert found.verdict == "explained"
    assert [cause.effect for cause in found.causes] == ["coulomb_friction"]
    assert "shaken_axis" in {finding.code for finding in found.findings}


def test_rounding_alone_is_taken_for_no_shaking():
    around = lab.Surroundings(noise=lab.SensorNoise(deviation=2e-6), encoder=ENCODER)
    setup = lab.Setup(surroundings=around, start=7e-6)
    records = [
        lab.step_record(lab.Truth(gain=1.9, damping=6.0), kp, seed=720_730 + kp, setup=setup) for kp in (40, 100)
    ]
    assert fit((), records).noise_model.rate == 0.0
