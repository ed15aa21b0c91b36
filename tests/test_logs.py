"""What a diagnosis says of its logs before it blames the axis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servolens import lab
from servolens.diagnosis.logs import is_blamed, log_findings

LEVELS = {"reference": (0.1, 0.02, 0.07), "duration": 0.6, "noise": 1e-5}
RUNS = [lab.step_record(lab.NLM2, kp, kd, **LEVELS, seed=kp) for kp, kd in ((60, 0), (100, 4))]


def late(record, column, samples):
    signal = getattr(record, column)
    return record.with_({column: signal[np.clip(np.arange(signal.size) - samples, 0, signal.size - 1)]})


def with_lost_samples(record):
    signals = {
        name: np.delete(getattr(record, name), np.arange(60, 70)) for name in ("position", "reference", "voltage")
    }
    return record.with_({**signals, "time": record.time[:-10].copy()})


@pytest.mark.parametrize(
    ("spoil", "code"),
    [
        (lambda record: late(record, "position", 3), "position_shifted"),
        (lambda record: late(record, "reference", 5), "reference_shifted"),
        (lambda record: late(record, "voltage", 4), "voltage_shifted"),
        (with_lost_samples, "position_jumps"),
    ],
    ids=["position late", "reference late", "voltage late", "lost samples"],
)
def test_faults_of_the_log_come_first_and_are_blamed(spoil, code):
    found = log_findings([RUNS[0].with_({"voltage": None}), spoil(RUNS[1])])
    assert [finding.code for finding in found] == [code, "voltage_reconstructed"]
    assert is_blamed(found[0])
    assert found[0].record == RUNS[1].name


def test_sound_logs_are_not_blamed():
    assert log_findings(RUNS) == []


@pytest.mark.parametrize("column", ["position", "voltage"])
def test_wrong_sign_is_blamed_and_does_not_stop(column):
    record = RUNS[1].with_({column: -getattr(RUNS[1], column)})
    (finding,) = log_findings([RUNS[0], record])
    assert (finding.code, finding.severity) == ("wrong_sign", "error")
    assert is_blamed(finding)


def test_setting_that_contradicts_the_log_is_blamed():
    stated = replace(RUNS[1].controller, derivative_filter=0.3)
    (finding,) = log_findings([RUNS[0], RUNS[1].with_({"controller": stated})])
    assert finding.code == "settings_contradict_log"
    assert is_blamed(finding)
