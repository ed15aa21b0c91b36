"""What public functions are given: records, plants and effects in any form, and a sentence for anything else."""

from __future__ import annotations

from typing import get_type_hints

import control
import numpy as np
import pandas as pd
import pytest

from servolens import CoulombFriction, InputError, Model, Plant, identify, lab
from servolens.inputs import RecordSettings, as_effects, as_groups, as_model, as_plant, as_records
from servolens.reading import KEYS
from servolens.results import write_json

RECORD = lab.step_record(lab.LM1, kp=60, noise=1e-5, seed=1)
PLANT = Plant(gain=1.9, damping=6.0)


def table():
    return pd.DataFrame({name: getattr(RECORD, name) for name in ("time", "reference", "position", "voltage")})


@pytest.fixture
def csv(tmp_path):
    path = tmp_path / "run.csv"
    table().to_csv(path, index=False)
    return path


def response():
    return control.TimeResponseData(
        RECORD.time,
        RECORD.position,
        inputs=RECORD.reference,
        issiso=True,
        output_labels=["position"],
        input_labels=["reference"],
    )


def test_every_setting_of_a_record_is_a_keyword():
    assert set(get_type_hints(RecordSettings)) == set(KEYS)


@pytest.mark.parametrize("kind", ["path", "text", "table", "response", "list of a table", "iterator"])
def test_records_in_any_form_are_the_same_samples(kind, csv):
    given = {
        "path": lambda: csv,
        "text": lambda: str(csv),
        "table": table,
        "response": response,
        "list of a table": lambda: [table()],
        "iterator": lambda: iter([table()]),
    }[kind]()
    (found,) = as_records(given, {"kp": 60})
    np.testing.assert_array_equal(found.position, RECORD.position)
    assert found.controller.kp == 60


def test_a_record_stays_itself_and_a_mixed_list_keeps_its_order(csv):
    found = as_records([RECORD, table()])
    assert found[0] is RECORD
    assert [r.name for r in as_records([table(), table()], {"kp": np.int64(60), "kd": None})] == [
        "record 1",
        "record 2",
    ]
    assert [r.name for r in as_records([csv, RECORD])] == ["run", RECORD.name]


def test_held_out_records_may_be_none_but_not_of_another_axis():
    assert as_groups(RECORD, ()) == ((RECORD,), ())
    with pytest.raises(InputError, match="records in A and V cannot be used together; convert one of them"):
        as_groups(RECORD, [RECORD.with_({"command_unit": "A"})])


@pytest.mark.parametrize(
    ("given", "settings", "said"),
    [
        (3, {}, "a Record, a file's path, a DataFrame, a TimeResponseData, or a list of these is needed; got int 3"),
        (PLANT, {}, "got Plant"),
        ([RECORD, None], {}, "got None"),
        ([], {}, "no record was given; at least one is needed"),
        ("nowhere.csv", {}, "nowhere.csv"),
        (RECORD, {"kp": 60}, "kp is for tables and files; .* is a Record: set it with"),
        (table(), {"kq": 60}, "'kq' is no argument and no setting of a record; settings are name, kp"),
    ],
)
def test_what_is_no_record_is_refused_with_a_sentence(given, settings, said):
    with pytest.raises(InputError, match=said):
        as_records(given, settings)


def test_a_misspelt_argument_is_refused_like_an_unknown_setting():
    with pytest.raises(InputError, match="'modle' is no argument and no setting of a record"):
        identify(RECORD, modle="constant")


def test_a_plant_is_what_any_result_holds(tmp_path):
    fit = identify(RECORD, model="constant")
    path = tmp_path / "model.json"
    write_json(path, "model", fit.model.to_json())
    assert as_plant(PLANT) is PLANT
    assert as_plant(Model(plant=PLANT)) is PLANT
    assert as_plant(fit) is fit.constant.plant
    assert as_plant(path) == as_plant(str(path)) == fit.constant.plant
    assert as_model(fit).evidence is not None


@pytest.mark.parametrize(
    ("given", "said"), [(1.9, "got float 1.9"), (Plant, "got the class Plant"), (RECORD, "got Record")]
)
def test_what_is_no_plant_is_refused_with_a_sentence(given, said):
    with pytest.raises(
        InputError, match=f"a Plant, a model, a fit, a diagnosis, or a model file's path is needed; {said}"
    ):
        as_plant(given)


def test_effects_are_instances_classes_or_names():
    friction = CoulombFriction(level=1.0)
    assert as_effects("coulomb_friction") == as_effects(CoulombFriction) == (CoulombFriction,)
    assert as_effects(friction) == (friction,)
    assert as_effects([friction, "delay"])[1].name == "delay"


@pytest.mark.parametrize(
    ("given", "said"), [("friction", "there is no effect 'friction'"), (5, "got int 5"), (Plant, "got the class Plant")]
)
def test_what_is_no_effect_is_refused_with_a_sentence(given, said):
    with pytest.raises(InputError, match=said):
        as_effects(given)
