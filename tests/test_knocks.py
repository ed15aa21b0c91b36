"""Records in which something knocked the axis once."""

from dataclasses import replace

import numpy as np
import pytest

from servolens import diagnose, lab
from servolens.study.lights import diagnosis_lights

H, REST, LASTS = 1e-3, 0.2, 1.5


def run(truth, kp, kd, *, knock=None, seed):
    """Log a step up and down, knocked for 30 ms from a time on by what 6 V would do, which is not logged."""
    time = H * np.arange(round((REST + 2 * LASTS) / H) + 1)
    pushed = np.zeros(time.size) if knock is None else 6.0 * ((time >= knock) & (time < knock + 0.03))
    setup = lab.Setup(rest=REST, feedforward=pushed)
    found = lab.step_record(truth, kp, kd, reference=(0.1, 0.0), duration=LASTS, noise=5e-6, seed=seed, setup=setup)
    return replace(found, voltage=found.voltage - pushed, feedforward=None, name=f"run {seed}")


def campaign(truth, knock):
    """Return two records to fit, the second knocked, and one to hold out."""
    loops = ((100, 4, None), (160, 8, knock), (240, 10, None), (200, 9, None))
    records = [run(truth, kp, kd, knock=when, seed=i) for i, (kp, kd, when) in enumerate(loops, 1)]
    return records[:3], records[3:]


@pytest.mark.parametrize("knock", [0.75, pytest.param(0.1, marks=pytest.mark.slow)], ids=["after a step", "before any"])
def test_what_follows_a_knock_is_left_out(knock):
    truth = lab.Truth(gain=2.0, damping=5.0, effects={"coulomb_friction": {"level": 0.4}})
    records, heldout = campaign(truth, knock)
    found = diagnose(records, heldout=heldout)
    assert (found.verdict, [cause.effect for cause in found.causes]) == ("explained", ["coulomb_friction"])
    assert found.model.plant.effects[0].level == pytest.approx(0.4, rel=1e-3)
    (said,) = [finding for finding in found.findings if finding.code == "knocked_axis"]
    assert (said.severity, said.record) == ("warning", "run 2")
    left = [record.duration for record in found.records if record.name == "run 2"]
    assert left == ([pytest.approx(knock, abs=0.15)] if knock > REST else [])
    assert diagnosis_lights(found)["data"].light == "amber"


@pytest.mark.slow
def test_knock_beside_which_shaking_explains_all_the_rest_is_found_too():
    """Steady shaking leaves nothing that depends on the inputs here: only its bursts show that it is none."""
    truth = lab.Truth(gain=2.0, damping=5.0, effects={"coulomb_friction": {"level": 0.4}})
    loops = ((100, 4, (0.1,), 1.3), (160, 8, (0.1, 0.0), 0.9), (240, 10, (0.12,), 1.3), (200, 9, (0.1,), 1.3))
    records = []
    for i, (kp, kd, levels, lasts) in enumerate(loops):
        count = round((REST + lasts * len(levels)) / H) + 1
        pushed = 6.0 * ((H * np.arange(count) >= 0.75) & (H * np.arange(count) < 0.78) & (i == 1))
        setup = lab.Setup(rest=REST, feedforward=pushed)
        found = lab.step_record(
            truth, kp, kd, reference=levels, duration=lasts, encoder=0.0, noise=5e-6, seed=i, setup=setup
        )
        records.append(replace(found, voltage=found.voltage - pushed, feedforward=None, name=f"run {i + 1}"))
    found = diagnose(records[:3], heldout=records[3:])
    assert (found.verdict, [cause.effect for cause in found.causes]) == ("explained", ["coulomb_friction"])
    assert "knocked_axis" in {finding.code for finding in found.findings}


@pytest.mark.slow
def test_axis_that_is_knocked_is_healthy_but_for_that():
    records, heldout = campaign(lab.Truth(gain=2.0, damping=5.0), 1.9)
    found = diagnose(records, heldout=heldout)
    assert (found.verdict, found.causes) == ("healthy", ())
    assert "knocked_axis" in {finding.code for finding in found.findings}
