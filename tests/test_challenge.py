"""The open benchmark: records without their truth, and a scorer of anybody's answers."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

from servolens import read_record
from servolens.effects import CATALOGUE
from servolens.errors import InputError
from servolens.lab.challenge import CaseScore, challenge_case, score_answers, write_challenge

SEED, CASES = 31, 3
"""Two effects, one, none."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("challenge") / "made"
    write_challenge(path, SEED, CASES)
    return path


@pytest.fixture(scope="module")
def truths():
    return {f"case-{k:03d}": challenge_case(SEED, k).truth.effects for k in range(1, CASES + 1)}


def test_files_hold_the_records_to_the_last_bit(folder):
    for number in range(1, CASES + 1):
        campaign, own = challenge_case(SEED, number), folder / f"case-{number:03d}"
        for kind, records in (("run", campaign.records), ("heldout", campaign.heldout)):
            assert len(list(own.glob(f"{kind}-*.csv"))) == len(records)
            for i, record in enumerate(records, 1):
                read = read_record(own / f"{kind}-{i}.csv")
                for signal in ("time", "reference", "position", "voltage"):
                    np.testing.assert_array_equal(getattr(read, signal), getattr(record, signal))
                for told in ("controller", "encoder_resolution", "length_unit", "command_unit"):
                    assert getattr(read, told) == getattr(record, told)


def test_files_say_nothing_of_the_truth(folder):
    for path in folder.rglob("*.csv"):
        head = "".join(line for line in path.read_text(encoding="ascii").splitlines() if not line[0].isdigit())
        assert not any(name in head for name in CATALOGUE)
    told = json.loads((folder / "challenge.json").read_text(encoding="ascii"))
    assert set(told) == {"schema", "world", "cases", "effects"}
    assert set(told["effects"]) == set(CATALOGUE)
    assert told["effects"]["delay"] == ["time"]


def test_hidden_are_none_one_or_two_effects(truths):
    assert {len(own) for own in truths.values()} == {0, 1, 2}


def test_the_truth_scores_all_and_nothing_scores_the_healthy(truths):
    perfect = score_answers({name: {e: dict(p) for e, p in own.items()} for name, own in truths.items()}, SEED)
    told = perfect.to_json()
    assert told["right"] == CASES
    assert told["found"] == told["hidden"] == sum(map(len, truths.values())) > 0
    assert told["false"] == told["alarms"] == 0
    assert told["size_error"] == 0.0
    silent = score_answers({}, SEED, cases=CASES).to_json()
    assert silent["cases"] == CASES
    assert silent["right"] == silent["healthy"] == sum(not own for own in truths.values())
    assert silent["found"] == silent["false"] == 0
    assert silent["size_error"] is None


def test_a_wrong_name_costs_the_case_and_sizes_are_compared(truths):
    name, own = next((name, own) for name, own in truths.items() if own)
    other = next(effect for effect in CATALOGUE if effect not in own)
    told = score_answers({name: [*own, other]}, SEED).to_json()
    assert (told["right"], told["found"], told["false"]) == (0, len(own), 1)
    half = {effect: {key: 1.5 * value for key, value in values.items()} for effect, values in own.items()}
    assert score_answers({name: half}, SEED).to_json()["size_error"] == pytest.approx(0.5)


def test_what_no_record_tells_apart_counts_as_the_same():
    for hidden, named in (
        (("sensor_lag",), ("actuator_lag",)),
        (("asymmetric_friction",), ("constant_force", "coulomb_friction")),
    ):
        assert CaseScore(hidden=hidden, named=named).is_right
        assert CaseScore(hidden=named, named=hidden).is_right
        assert not CaseScore(hidden=hidden, named=()).is_right


@pytest.mark.parametrize(
    ("answers", "message"),
    [
        ({"case-001": ["columb_friction"]}, "case-001: no effect 'columb_friction'; there are actuator_lag"),
        ({"case-1": []}, "'case-1' names no case"),
        ({"case-000": []}, "'case-000' names no case"),
        ({"case-001": "delay"}, "case-001: the answer must be a list of effects"),
        ({"case-001": {"delay": 0.1}}, "case-001: delay needs an object of parameters and numbers"),
        ({"case-009": []}, "case-009: the challenge has 3 cases only"),
    ],
)
def test_answers_of_another_form_are_refused_with_a_sentence(answers, message):
    with pytest.raises(InputError, match=message):
        score_answers(answers, SEED, cases=CASES)


def test_a_folder_that_holds_something_and_odd_numbers_are_refused(folder, tmp_path):
    with pytest.raises(InputError, match="is not empty; give a new folder"):
        write_challenge(folder, SEED, 1)
    with pytest.raises(InputError, match="a challenge has 1 to 10000 cases, got 0"):
        write_challenge(tmp_path / "none", SEED, 0)
    with pytest.raises(InputError, match="the seed must be at least 0, got -1"):
        write_challenge(tmp_path / "none", -1, 1)


def test_the_commands_write_the_same_bytes_again_and_score(folder, tmp_path):
    made = call("challenge", "--out", tmp_path / "made", "--seed", SEED, "--cases", 1)
    assert (made.returncode, made.stdout) == (0, "")
    written = sorted((tmp_path / "made" / "case-001").iterdir())
    assert len(written) > 1
    for path in written:
        assert path.read_bytes() == (folder / "case-001" / path.name).read_bytes()
    answers = tmp_path / "answers.json"
    answers.write_text('{"case-001": []}', encoding="utf-8")
    scored = call("score", "--seed", SEED, answers)
    assert scored.returncode == 0
    assert json.loads(scored.stdout)["schema"] == "servolens.challenge-score/1"
    answers.write_text("[]", encoding="utf-8")
    refused = call("score", "--seed", SEED, answers)
    assert refused.returncode == 2
    assert refused.stderr == f"servolens.lab: error: {answers}: holds no JSON object\n"


def call(*arguments):
    command = [sys.executable, "-m", "servolens.lab", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True)
