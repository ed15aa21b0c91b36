"""Records of one axis with different loads: one estimate for all, of the axis with the inertia stated first."""

import math

import numpy as np
import pytest

from servolens import Controller, Identification, PDSpec, Record, diagnose, fit, identify, predict, tune
from servolens.identification.damping_law import law_from_pieces
from servolens.plant import Plant

GAIN, DAMPING, LEVEL = 2.0, 10.0, 0.6
STEP, SAMPLES = 1e-3, 900


def moved(y, v, push, damping, friction, left):
    """Return position and speed after `left` seconds under a constant push, by the closed form, stops included."""
    while left > 0.0:
        if v == 0.0 and abs(push) <= friction:
            return y, v
        rest = (push - math.copysign(friction, v or push)) / damping
        fades = math.exp(-damping * left)
        after = rest + (v - rest) * fades
        if v * after >= 0.0:
            return y + rest * left + (v - rest) * (1.0 - fades) / damping, after
        stops = math.log((v - rest) / -rest) / damping
        y += rest * stops + (v - rest) * (1.0 - math.exp(-damping * stops)) / damping
        v, left = 0.0, left - stops
    return y, v


def run(mass, kp, *, level=0.0, noise=1e-5):
    """Step an axis whose gain, damping and friction are `GAIN`, `DAMPING` and `level` where the mass is 1 kg."""
    random = np.random.default_rng(round(100 * mass + kp))
    controller, y, v, last = Controller(kp=kp, kd=1.0), 0.0, 0.0, None
    position, voltage = np.empty(SAMPLES), np.empty(SAMPLES)
    for k in range(SAMPLES):
        seen = y + noise * random.standard_normal()
        voltage[k] = kp * (0.1 - seen) - (0.0 if last is None else (seen - last) / STEP)
        position[k] = last = seen
        y, v = moved(y, v, GAIN * voltage[k] / mass, DAMPING / mass, level / mass, STEP)
    time, reference = STEP * np.arange(SAMPLES), np.full(SAMPLES, 0.1)
    return Record(
        time=time,
        position=position,
        voltage=voltage,
        reference=reference,
        controller=controller,
        inertia=mass,
        name=f"{mass} kg, kp {kp}",
    )


@pytest.fixture(scope="module")
def records():
    return [run(1.0, 60), run(2.0, 60), run(1.5, 90)]


@pytest.fixture(scope="module")
def rubbing():
    return [run(mass, kp, level=LEVEL) for mass, kp in ((1.0, 60), (2.0, 60), (1.5, 90))]


def near(quantity, true):
    return abs(quantity.value - true) < 4.0 * quantity.stderr < 0.01 * true


@pytest.mark.parametrize("mass", [1.0, 2.0])
def test_laws_of_the_paper_hold_for_the_inertia_stated_first(records, mass):
    ordered = sorted(records, key=lambda record: record.inertia != mass)
    found = identify(ordered)
    for model in (found.constant, found.velocity):
        assert model.plant.inertia == mass
        assert near(model.quantities["gain"], GAIN / mass)
    assert near(found.constant.quantities["damping"], DAMPING / mass)
    assert found.varying.gain == pytest.approx(GAIN / mass, rel=0.005)
    assert np.median(found.varying.damping) == pytest.approx(DAMPING / mass, rel=0.02)
    assert max(error.percent_error for errors in found.errors.values() for error in errors) < 0.05


@pytest.mark.parametrize("driven", ["voltage", "closed_loop"])
def test_fit_of_effects_holds_for_the_inertia_stated_first(rubbing, driven):
    found = fit(["coulomb_friction"], rubbing, driven=driven)
    assert found.plant.inertia == 1.0
    for name, true in (("gain", GAIN), ("damping", DAMPING), ("coulomb_friction.level", LEVEL)):
        assert near(found.quantities[name], true)


def test_fit_of_gain_and_damping_keeps_the_inertia_that_is_stated(records):
    for given in ([], Plant(gain=1.0, damping=5.0)):
        found = fit(given, records)
        assert found.plant.inertia == 1.0
        assert near(found.quantities["gain"], GAIN)


def test_file_of_all_laws_keeps_the_inertia(records):
    found = identify(records)
    again = Identification.from_json(found.to_json())
    assert found.to_json()["models"]["varying"]["inertia"] == 1.0
    assert (again.varying.inertia, again.velocity.plant.inertia) == (1.0, 1.0)
    assert law_from_pieces(found.varying).inertia == 1.0


def test_diagnosis_of_records_with_different_loads_names_what_they_share(records, rubbing):
    assert diagnose(records).verdict == "healthy"
    found = diagnose(rubbing[:2], heldout=rubbing[2])
    assert (found.verdict, [cause.effect for cause in found.causes]) == ("explained", ["coulomb_friction"])
    assert found.causes[0].quantities["level"].value == pytest.approx(LEVEL, rel=0.01)
    assert found.model.plant.inertia == 1.0
    assert predict(found.model, rubbing[2]).errors[0][0].percent_error < 0.05


def test_gain_is_for_the_inertia_stated_first(records):
    spec = PDSpec(kp=60, settling_time=0.5)
    least = tune(identify(records, model="constant"), spec).kd
    true = tune(Plant(gain=GAIN, damping=DAMPING), spec).kd
    assert least == pytest.approx(true, abs=0.02)
