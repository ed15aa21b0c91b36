"""Whether records are of one axis: two axes are told apart, and no effect of one axis is taken for another axis."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from servolens import Plant, assess, check, lab, read_records
from servolens.findings import Finding
from servolens.identification.one_axis import apart, contradiction
from servolens.identification.segments import motion_segments
from servolens.identification.starting import Screen
from servolens.study.lights import data_light

DATA = Path(os.environ.get("SERVOLENS_DATA", Path(__file__).parents[2] / "shared" / "data"))
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="measured data are not here (SERVOLENS_DATA)")


def run(gain, name, *, kp=40, damping=6.0, reference=0.1, noise=1e-5, inertia=None, **effects):
    truth = lab.Truth(gain=gain, damping=damping, effects=effects)
    record = lab.step_record(truth, kp=kp, reference=reference, noise=noise, seed=kp)
    return record.with_({"name": name, "inertia": inertia})


def linear_gain(record):
    return Screen.of(motion_segments([record])).solve(())[0].gain


def test_two_axes_are_told_apart_with_the_gain_of_each_and_its_error():
    (finding,) = check([run(12.0, "first"), run(12.0, "second", kp=60), run(60.0, "third", kp=50)])
    told = re.fullmatch(
        r"the records contradict each other: each by itself is explained, with a gain of (\S+) ± (\S+) m/s\^2/V in"
        r" (first|second) and of (\S+) ± (\S+) in third; are they of the same axis, load and units\?",
        finding.message,
    )
    assert told
    low, own, _, high, its = told.groups()
    assert abs(float(low) - 12.0) < 5 * float(own) + 5e-4  # four digits are told
    assert abs(float(high) - 60.0) < 5 * float(its) + 5e-3
    assert (finding.code, finding.severity, finding.record) == ("records_contradict", "warning", None)


def test_gains_that_the_records_hardly_determine_do_not_contradict_each_other():
    plants = [Plant(gain=gain, damping=6.0) for gain in (12.0, 16.0)]
    assert apart(plants, ["first", "second"], [0.1, 0.1]) is not None
    assert apart(plants, ["first", "second"], [1.0, 1.0]) is None
    assert apart([plants[0], Plant(gain=14.0, damping=6.0)], ["first", "second"], [0.1, 0.1]) is None


def test_another_load_that_is_stated_is_no_other_axis():
    heavy, light = run(2.0, "heavy", inertia=2.0), run(20.0, "light", damping=60.0, inertia=0.2)
    assert contradiction([heavy, light]) is None
    assert contradiction([heavy.with_({"inertia": None}), light]) is not None


def test_an_effect_that_changes_the_gain_is_no_other_axis():
    small, large = (run(12.0, f"{r} m", reference=r, dead_zone={"width": 0.8}) for r in (0.04, 0.4))
    assert linear_gain(large) > 1.3 * linear_gain(small)
    assert contradiction([small, large]) is None


@pytest.mark.parametrize(
    "effect", ["force_limit", "saturation", "position_friction", "backlash", "gain_drift", "end_stop"]
)
def test_records_of_one_axis_with_an_effect_do_not_contradict_each_other(effect):
    assert contradiction(lab.hidden_campaign(910001, effects=[effect], records=3, heldout=0).records) is None


@needs_data
@pytest.mark.parametrize("steps", ["cu_rotary_arm/*.csv"])
def test_measured_gains_that_friction_scatters_are_those_of_one_axis(steps):
    units = {"time": "ms", "position": "rad", "reference": "rad", "velocity": "rad/s", "voltage": "V"}
    columns = {"time": "t_ms", "position": "theta_rad", "reference": "ref_rad", "voltage": "voltage_V"}
    paths = sorted(DATA.glob(steps))
    records = read_records(paths, units=units, columns=columns, settings={"kp": 7, "kd": 0})
    gains = [linear_gain(record) for record in records]
    assert max(gains) > 1.5 * min(gains)
    assert contradiction(records) is None


def test_the_light_of_the_data_says_that_records_contradict_each_other():
    against = Finding(code="records_contradict", severity="warning", message="the records contradict each other; why?")
    other = replace(against, code="noise_model", message="noise 8 µm.")
    quality = assess(run(12.0, "first"))
    green = data_light([quality], [other])
    assert green.light == "green"
    assert green.sentence == "The record can be used, and nothing in the data speaks against it."
    light = data_light([quality], [other, against])
    assert (light.light, light.sentence) == ("amber", "The records contradict each other; why?")


def test_a_record_that_does_not_move_is_not_asked():
    moving = run(12.0, "moving")
    still = moving.with_({"position": np.zeros(len(moving)), "name": "still"})
    assert contradiction([moving, still]) is None


def test_a_wrong_sign_is_not_told_as_a_contradiction_too():
    record = lab.step_record(lab.Truth(gain=2.0, damping=6.0), 40, noise=1e-5, seed=720_901)
    mirrored = record.with_({"voltage": -record.voltage, "name": "mirrored"})
    assert [finding.code for finding in check([record, mirrored])] == ["wrong_sign"]


def test_gains_are_told_for_the_inertia_that_they_are_compared_at():
    heavy = lab.step_record(lab.Truth(gain=2.0, damping=6.0), 40, noise=1e-5, seed=720_902)
    light = lab.step_record(lab.Truth(gain=40.0, damping=6.0), 40, noise=1e-5, seed=720_903)
    heavy, light = (
        record.with_({"inertia": inertia, "name": name})
        for record, inertia, name in ((heavy, 2.0, "heavy"), (light, 0.2, "light"))
    )
    (found,) = (finding for finding in check([heavy, light]) if finding.code == "records_contradict")
    assert "in light (for the inertia of heavy)" in found.message
    assert re.search(r"gain of 2\.0\d+ ± 0\.0\d+ |gain of 1\.9\d+ ± 0\.0\d+ ", found.message)
