"""What public functions are given: records, plants and effects in any form, and a sentence for anything else."""

from __future__ import annotations

import inspect
from dataclasses import replace
from types import SimpleNamespace
from typing import get_type_hints

import control
import numpy as np
import pandas as pd
import pytest

import servolens
from servolens import (
    Controller,
    CoulombFriction,
    Fit,
    GainWishes,
    InputError,
    Model,
    PDSpec,
    Plant,
    Prior,
    Record,
    assess,
    bootstrap,
    check,
    check_response,
    closed_loop,
    compare,
    diagnose,
    digital_controller,
    feedforward,
    fit,
    gain_map,
    held_response,
    identify,
    lab,
    predict,
    profile,
    read_model,
    read_record,
    read_records,
    recommend,
    record_from_dataframe,
    simulate,
    simulate_continuous,
    simulate_loop,
    simulate_many,
    simulate_voltage,
    study_records,
    to_control,
    trust,
    tune,
    tune_gains,
    write_report,
)
from servolens.inputs import ARGUMENTS, RecordSettings, as_effects, as_groups, as_model, as_plant, as_records, is_model
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


def test_an_argument_of_another_function_is_not_offered_again():
    with pytest.raises(InputError, match=r"'driven' is no argument .*; did you mean 'voltage_driven'"):
        simulate(PLANT, RECORD, driven="voltage")


@pytest.mark.parametrize(
    ("written", "meant"),
    [("modle", "'model'"), ("Kp", "'kp'"), ("prior", "'priors'"), ("efort", "'effort'"), ("held_out", "'heldout'")],
)
def test_a_misspelt_argument_is_refused_with_the_one_that_may_be_meant(written, meant):
    with pytest.raises(
        InputError, match=f"'{written}' is no argument and no setting of a record; did you mean {meant}"
    ):
        identify(RECORD, **{written: "constant"})


def test_arguments_that_may_be_meant_are_those_of_the_public_functions():
    functions = [value for name in servolens.__all__ if inspect.isfunction(value := getattr(servolens, name))]
    signatures = [inspect.signature(function).parameters.values() for function in functions]
    # readers, whose settings may stand in a mapping too, tell misspelt ones themselves
    of_records = [one for one in signatures if any(p.kind is p.VAR_KEYWORD and p.name == "settings" for p in one)]
    assert {p.name for one in of_records for p in one if p.kind is p.KEYWORD_ONLY} == set(ARGUMENTS)


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
    ("given", "said"),
    [
        ("friction", "there is no effect 'friction'; did you mean 'asymmetric_friction' or 'coulomb_friction' or"),
        ("coulomb", r"there is no effect 'coulomb'; did you mean 'coulomb_friction'\?"),
        ("CoulombFriction", r"there is no effect 'CoulombFriction'; did you mean 'coulomb_friction'\?"),
        ("backlsh", r"there is no effect 'backlsh'; did you mean 'backlash'\?"),
        ("step.csv", "there is no effect 'step.csv'; the catalogue holds actuator_lag, "),
        (5, "got int 5"),
        (Plant, "got the class Plant"),
    ],
)
def test_what_is_no_effect_is_refused_with_a_sentence(given, said):
    with pytest.raises(InputError, match=said):
        as_effects(given)


# --- every public function that takes a plant or records


SPEC = PDSpec(kp=100, settling_time=0.5)


@pytest.fixture(scope="module")
def model_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("models") / "model.json"
    write_json(path, "model", Model(plant=PLANT).to_json())
    return path


OF_A_PLANT = {
    "simulate": lambda plant: simulate(plant, RECORD).position,
    "simulate_loop": lambda plant: simulate_loop(plant, Controller(kp=60.0), RECORD.time, RECORD.reference).position,
    "simulate_voltage": lambda plant: simulate_voltage(plant, RECORD.time, RECORD.voltage).position,
    "simulate_continuous": lambda plant: simulate_continuous(plant, 60.0, 1.0, RECORD.time, RECORD.reference).position,
    "simulate_many": lambda plant: simulate_many(plant, RECORD)[0][0].position,
    "predict": lambda plant: predict(plant, RECORD).positions[0][0],
    "to_control": lambda plant: to_control(plant).linearize([0.0, 0.0], 0.0).A,
    "closed_loop": lambda plant: closed_loop(plant, kp=60.0).linearize([0.0, 0.0], 0.0).A,
    "feedforward": lambda plant: feedforward(plant, RECORD.time, 0.1 * RECORD.time**2),
    "gain_map": lambda plant: gain_map(plant, SPEC, [100.0], [8.0]).settling_time,
    "tune": lambda plant: np.array(tune(plant, SPEC).intervals),
}


@pytest.mark.parametrize("name", OF_A_PLANT)
def test_a_model_a_path_and_a_fit_do_wherever_a_plant_is_wanted(name, model_file):
    ask = OF_A_PLANT[name]
    wanted = ask(PLANT)
    for given in (Model(plant=PLANT), model_file, str(model_file), SimpleNamespace(plant=PLANT)):
        np.testing.assert_array_equal(ask(given), wanted)


@pytest.mark.parametrize("name", [name for name in OF_A_PLANT if name != "tune"])
def test_a_record_in_place_of_a_plant_is_refused_with_a_sentence(name):
    with pytest.raises(InputError, match=r"a Plant, a model, a fit, a diagnosis, .* is needed; got Record"):
        OF_A_PLANT[name](RECORD)


def test_an_identification_acts_as_its_velocity_model():
    found = identify(RECORD)
    wanted = predict(found.velocity, RECORD)
    np.testing.assert_array_equal(predict(found, RECORD).positions[0][0], wanted.positions[0][0])
    assert tune(found, SPEC).plants == (found.velocity.plant,)


OF_RECORDS = {
    "identify": lambda *given, **gains: identify(*given, model="constant", **gains).plant.gain,
    "fit": lambda *given, **gains: fit((), *given, **gains).plant.gain,
    "assess": lambda *given, **gains: assess(*given, **gains).samples,
    "check": lambda *given, **gains: len(check(*given, **gains)),
    "predict": lambda *given, **gains: predict(PLANT, *given, **gains).errors[0][0].percent_error,
    "simulate": lambda *given, **gains: simulate(PLANT, *given, **gains).position[-1],
}


@pytest.mark.parametrize("name", OF_RECORDS)
def test_a_table_a_response_and_a_path_do_wherever_a_record_is_wanted(name, csv):
    ask = OF_RECORDS[name]
    wanted = ask(RECORD.with_({"encoder_resolution": None}))
    for given in (table(), csv, str(csv), response() if name in ("identify", "simulate") else csv):
        assert ask(given, kp=60) == pytest.approx(wanted, rel=0.02)


@pytest.mark.parametrize("name", OF_RECORDS)
def test_a_plant_in_place_of_a_record_is_refused_with_a_sentence(name):
    with pytest.raises(InputError, match=r"a Record, a file's path, a DataFrame, .* is needed; got Plant"):
        OF_RECORDS[name](PLANT)


def test_a_number_in_place_of_a_spec_is_refused_with_a_sentence():
    with pytest.raises(InputError, match=r"a PDSpec is needed, such as .*; got float 0\.5"):
        tune(PLANT, 0.5)


def test_records_and_models_are_not_mixed():
    with pytest.raises(InputError, match="records and models cannot be mixed"):
        tune([RECORD, PLANT], SPEC)


def test_a_table_with_a_column_named_model_is_a_record_all_the_same():
    (found,) = as_records(table().assign(model=1.0), {"kp": 60})
    assert len(found) == len(RECORD)
    assert not is_model(table().assign(model=1.0))


def test_priors_are_pairs_by_name():
    near = identify(RECORD, model="constant", priors={"gain": (3.0, 1e-6)}).plant
    assert near.gain == pytest.approx(3.0, rel=1e-3)
    for ask in (identify, diagnose):
        with pytest.raises(InputError, match=r"the prior on gain must be a value and its standard deviation"):
            ask(RECORD, priors={"gain": 3.0})
        with pytest.raises(InputError, match=r"priors must go by name, such as"):
            ask(RECORD, priors=[3.0])


def test_profile_and_bootstrap_want_a_fit():
    for ask in (lambda given: profile(given, "gain"), lambda given: bootstrap(given, seed=1)):
        with pytest.raises(InputError, match=r"what servolens.fit returns is needed; got Plant"):
            ask(PLANT)


@pytest.mark.parametrize(
    "make",
    [
        lambda: identify(RECORD),
        lambda: identify(RECORD, model="constant"),
        lambda: fit((), RECORD),
        lambda: diagnose(RECORD, effort="quick"),
    ],
    ids=["identification", "constant", "fit", "diagnosis"],
)
def test_the_file_of_a_result_does_wherever_a_plant_is_wanted(make, tmp_path):
    found = make()
    found.save(tmp_path / "result.json")
    assert as_plant(tmp_path / "result.json") == found.plant


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        (lambda: read_model(5), "the path of a model's file is needed; got int"),
        (lambda: Fit.from_json(5), "what to_json returned, or a file's path, is needed; got int"),
        (lambda: recommend(PLANT, SPEC), "a Design is needed, such as what servolens.design.tune returns; got PDSpec"),
        (lambda: fit(RECORD, "coulomb_friction"), "an effect, its class or its name is needed, .*; got Record"),
        (lambda: fit("coulomb_friction", RECORD, bounds={"gain": 2}), r"the bounds of gain must be .*; got int 2"),
        (lambda: fit("coulomb_friction", RECORD, fixed="gain"), "gain has no value to be fixed at; write fixed="),
        (lambda: fit("coulomb_friction", RECORD, bounds=[1]), r"bounds must go by name, such as .*; got list \[1\]"),
        (lambda: fit("coulomb_friction", RECORD, bounds={3: (1, 2)}), "bounds must go by name, such as .*; got dict"),
        (lambda: fit("coulomb_friction", RECORD, fixed=3), "fixed must name parameters, such as 'damping'; got int 3"),
        (lambda: fit("coulomb_friction", RECORD, local=[3]), r"local must name parameters, such as .*; got list \[3\]"),
        (lambda: diagnose(RECORD, priors={3: (1, 2)}), "priors must go by name, such as .*; got dict"),
        (lambda: identify(b"run.csv"), "a Record, a file's path, .* is needed; got bytes$"),
        (lambda: compare(PLANT, PLANT, 3), "a PDSpec is needed, such as PDSpec.*; got int 3"),
        (lambda: gain_map(PLANT, 3, 100, 2), "a PDSpec is needed, such as PDSpec.*; got int 3"),
        (lambda: gain_map(PLANT, SPEC, "a", 2), "kp must hold numbers alone, got str 'a'"),
        (lambda: tune_gains(PLANT, 3), "a PDSpec is needed, such as PDSpec.*; got int 3"),
        (lambda: tune_gains(PLANT, SPEC, 3), "a GainWishes is needed, such as GainWishes.*; got int 3"),
        (lambda: study_records(RECORD, {"kp": 100}), "a PDSpec is needed, such as PDSpec.*; got dict"),
        (
            lambda: write_report(RECORD, "page.html"),
            "the path of the page is needed first, .*; got Record",
        ),
        (lambda: feedforward(PLANT, "a", [1]), "time must hold numbers alone, got str 'a'"),
        (lambda: simulate_voltage(PLANT, [0, 1], ["a", 1]), r"voltage must hold numbers alone, got list \['a', 1\]"),
        (lambda: RECORD.with_({"position": "a"}), ": position must hold numbers alone, got str 'a'"),
        (
            lambda: RECORD.with_({"controller": 60}),
            "a Controller is needed, such as .*; got int 60",
        ),
        (lambda: RECORD.with_({"encoder_resolution": "1 mm"}), "encoder_resolution must be positive, got '1 mm'"),
        (lambda: CoulombFriction(level="a"), "coulomb_friction: level must be a number, got str 'a'"),
        (
            lambda: Plant(gain=1, damping=1, effects="delay"),
            "effects with their numbers .*; got str 'delay'",
        ),
        (lambda: PLANT.with_effect(CoulombFriction), "effects with their numbers .*; got the class CoulombFriction"),
        (lambda: Plant(gain=1, damping=1, effects=3), "effects with their numbers are needed, .*; got int 3"),
        (lambda: read_record(table()), "the path of a log is needed; got DataFrame .*record_from_dataframe"),
        (lambda: read_records(3), "paths of files, folders or campaigns are needed; got int 3"),
        (lambda: closed_loop(PLANT, kp="60"), "kp must be a finite number, got str '60'"),
        (lambda: held_response(PLANT, [0, 1], [1, 1]), "a system of python-control is needed, .*; got Plant"),
        (lambda: lab.step_record(PLANT, kp=60), "an axis is a Truth of servolens.lab, .*; got Plant"),
        (lambda: lab.Truth(gain=1, damping=1, effects=["delay"]), r"effects must be names .*; got list \['delay'\]"),
        (lambda: lab.Truth(gain=1, damping=1, effects={"lag": {}}), "did you mean 'actuator_lag' or 'sensor_lag'"),
        (lambda: lab.hidden_campaign(1, effects="backlsh"), "no effect 'backlsh' to hide; did you mean 'backlash'"),
    ],
)
def test_what_cannot_be_used_is_said(ask, said):
    with pytest.raises(InputError, match=said):
        ask()


LIMITED = Controller(kp=60.0, ki=5.0, anti_windup="clamping")
SYSTEM = to_control(PLANT)


def looped(**given):
    return simulate_loop(
        PLANT, given.pop("controller", LIMITED), RECORD.time, RECORD.reference, **{"limit": 10} | given
    )


def held(**given):
    return held_response(SYSTEM, given.pop("time", [0, 1, 2]), given.pop("inputs", [1, 1, 1]), **given)


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        (lambda: digital_controller(60, 0.001), "a Controller is needed, such as .*; got int 60"),
        (lambda: digital_controller(LIMITED, "a"), "sample_time must be a finite number larger than 0, got str 'a'"),
        (lambda: digital_controller(LIMITED, 0.1, limit=-1), "limit must be a finite number larger than 0, got int -1"),
        (lambda: digital_controller(LIMITED, 0.1, limit=1, name=5), "name must be a text, got int 5"),
        (lambda: to_control(PLANT, name=5), "name must be a text, got int 5"),
        (lambda: to_control(PLANT, prefix=None), "prefix must be a text, got None"),
        (lambda: to_control(PLANT, name="0.3"), "name must be a text without '.', got str '0.3'"),
        (
            lambda: to_control(PLANT, friction_width="a"),
            "friction_width must be a finite number larger than 0, got str",
        ),
        (lambda: held(inputs=[1, np.nan, 1]), "inputs must be finite; sample 1 is nan"),
        (lambda: held(time=[0, 1, np.nan]), "time must be finite; sample 2 is nan"),
        (lambda: held(time="a"), "time must hold numbers alone, got str 'a'"),
        (lambda: held(initial_state=np.nan), "initial_state must be finite; sample 0 is nan"),
        (lambda: held(params=5), "params must go by name, such as .*; got int 5"),
        (lambda: held(params={"gain": np.nan}), "gain must be a finite number, got float nan"),
        (lambda: held(check="no"), "check must be one of True, False; got str 'no'"),
        (lambda: check_response(SYSTEM, 5), "a response of python-control is needed, .*; got int 5"),
        (lambda: check_response(SYSTEM, held(), tolerance=np.nan), "tolerance must be a finite number of at least 0"),
        (lambda: looped(controller=(60, 1)), "a Controller is needed, such as .*; got tuple"),
        (lambda: looped(limit=np.nan), "limit must be a finite number larger than 0, got float nan"),
        (lambda: looped(resolution=-1), "resolution must be a finite number of at least 0, got int -1"),
        (lambda: looped(before="a"), "before must be a finite number, got str 'a'"),
        (lambda: looped(start=5), "start must be position and velocity, .*; got int 5"),
        (lambda: looped(start=("0", "0")), "start must hold numbers alone, got tuple"),
        (lambda: looped(start=(np.nan, 0)), "start must be finite; sample 0 is nan"),
        (lambda: looped(start=(0, 0, 5)), r"start must be position and velocity, .*; got tuple \(0, 0, 5\)"),
        (lambda: looped(substeps=-2), "substeps must be a whole number of at least 1 and at most .*, got int -2"),
        (
            lambda: simulate(PLANT, RECORD, substeps=2.5),
            "substeps must be a whole number of at least 1 .* got float 2.5",
        ),
        (lambda: simulate(PLANT, RECORD, substeps=1e20), "at most 1000000, got float 1e.20"),
        (
            lambda: simulate(PLANT, RECORD, voltage_driven="no"),
            "voltage_driven must be one of None, True, False; got str",
        ),
        (lambda: simulate_many(PLANT, RECORD, substeps=2.5), "substeps must be a whole number of at least 1"),
        (lambda: simulate_many(PLANT, RECORD, workers=1.5), "workers must be a whole number of at least 1"),
        (lambda: simulate_voltage(PLANT, [[0, 1]], [[1, 1]]), r"time must be one-dimensional, got shape \(1, 2\)"),
        (lambda: simulate_continuous(PLANT, "60", 1, [0, 1], [1, 1]), "kp must be a finite number, got str '60'"),
        (
            lambda: simulate_continuous(PLANT, 60, 1, [0, 1], [1, 1], reference_before=np.nan),
            "reference_before must be a finite number, got float nan",
        ),
        (lambda: Prior(value="2", deviation=1), "a prior needs a finite value and .*, got str '2' and int 1"),
        (lambda: identify(RECORD, delta="a"), "delta must be a number of at least 0, got str 'a'"),
        (lambda: identify(RECORD, piece="a"), "piece must be a finite number, got str 'a'"),
        (lambda: fit((), RECORD, bounds={"gain": "12"}), "the bounds of gain must be .*; got str '12'"),
        (lambda: fit((), RECORD, bounds={"gain": ("1", "2")}), "the bounds of gain must be .*; got tuple"),
        (lambda: fit((), RECORD, priors={"gain": {1, 2}}), "the prior on gain must be .*; got set"),
        (lambda: fit((), RECORD, fixed={"gain": "1.9"}), "gain must be fixed at a finite number, got str '1.9'"),
        (lambda: bootstrap(fit((), RECORD), seed="a"), "seed must be a whole number of at least 0, got str 'a'"),
        (lambda: bootstrap(fit((), RECORD), seed=1, repeats=2.5), "repeats must be a whole number of at least 2"),
        (lambda: trust(PLANT, 5), "a Design is needed, such as what servolens.design.tune returns; got int 5"),
        (lambda: trust([], None), "no model was given; at least one is needed"),
        (lambda: GainWishes(free=None), "free gains are kd and perhaps kp, .* got None"),
        (lambda: GainWishes(free=[5]), "free gains are kd and perhaps kp, .* got 5"),
        (lambda: GainWishes(voltage_noise="1"), "voltage_noise must be a finite number larger than 0, got str '1'"),
        (lambda: PDSpec(kp=100, settling_time=0.5, hunting="no"), "hunting must be one of True, False; got str 'no'"),
        (lambda: feedforward(PLANT, [0, 1, 2, 3], [0, np.nan, 1, 1]), "reference must be finite; sample 1 is nan"),
        (lambda: feedforward(PLANT, range(4), range(4), controller=5), "a Controller is needed, .*; got int 5"),
        (lambda: feedforward(PLANT, range(4), range(4), friction="no"), "friction must be one of True, False; got str"),
        (
            lambda: Plant(gain=1, damping=1, inertia="a"),
            "plant: inertia must be a finite number larger than 0, got str",
        ),
        (lambda: CoulombFriction(level="1"), "coulomb_friction: level must be a number, got str '1'"),
        (lambda: Model(plant=5), "a Plant is needed, such as .*; got int 5"),
        (lambda: Model(plant=PLANT, covariance=np.eye(3)), r"covariance must have shape \(2, 2\), got \(3, 3\)"),
        (lambda: Model(plant=PLANT, reasons=5), "reasons must go by name, such as .*; got int 5"),
        (lambda: RECORD.with_(5), "changes must go by name, such as .*; got int 5"),
        (lambda: RECORD.with_({"time": None}), "time must hold numbers alone, got None"),
        (
            lambda: RECORD.with_({"time": np.array(["0", "1", "2"], object)}),
            "time must hold numbers alone, got ndarray",
        ),
        (lambda: RECORD.with_({"name": 5}), "name must be a text, got int 5"),
        (lambda: RECORD.with_({"time": pd.date_range("2026", periods=3)}), "time must hold numbers alone"),
    ],
)
def test_what_is_of_a_wrong_kind_is_said_where_it_is_given(ask, said):
    with pytest.raises(InputError, match=said):
        ask()


@pytest.mark.parametrize("read", [read_record, read_records, record_from_dataframe], ids=lambda read: read.__name__)
@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"units": "mm"}, "units must go by name, such as {'position': 'mm'}; got str 'mm'"),
        ({"columns": "position"}, "columns must go by name, such as {'position': 'qm'}; got str 'position'"),
        ({"settings": 5}, "settings must go by name, such as {'kp': 60}; got int 5"),
        ({"settings": {5: 1}}, "settings must go by name, such as {'kp': 60}; got dict"),
        ({"settings": {"kp": np.array([60.0])}}, "kp must be a number, got ndarray"),
    ],
)
def test_readers_say_what_goes_by_name(read, given, said, csv):
    with pytest.raises(InputError, match=said):
        read(table() if read is record_from_dataframe else csv, **given)


@pytest.mark.parametrize("number", [np.float64(60), np.int64(60), np.array(60.0)], ids=lambda number: str(number.dtype))
def test_numbers_of_numpy_are_numbers_in_settings(number, csv):
    found = [
        read_record(csv, settings={"kp": number}),
        *read_records(csv, kp=number),
        record_from_dataframe(table(), settings={"kp": number}),
        *as_records(csv, {"kp": number}),
    ]
    assert [record.controller.kp for record in found] == [60.0] * 4


def test_a_table_without_rows_has_no_samples():
    with pytest.raises(InputError, match="a record needs at least 2 samples, got 0"):
        record_from_dataframe(table()[:0])


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"scenarios": 2.5}, "scenarios must be a whole number of at least 1, got float 2.5"),
        ({"seed": -1}, "seed must be a whole number of at least 0, got int -1"),
        ({"overshoot": np.nan}, "overshoot must be a finite number of at least 0, got float nan"),
        ({"references": ["a"]}, r"references \(sizes of steps\) must hold numbers alone"),
    ],
)
def test_what_is_asked_of_a_recommendation_is_checked(given, said):
    with pytest.raises(InputError, match=said):
        recommend(PLANT, tune(PLANT, SPEC), **given)


def test_sizes_of_steps_may_be_a_number_of_numpy():
    design = tune(PLANT, SPEC)
    kd = [recommend(PLANT, design, scenarios=2, references=size).recommended.kd for size in (0.2, np.array(0.2))]
    assert kd[0] == kd[1]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"effort": "normal"}, "effort cannot be given for plants and models; they are for records"),
        ({"heldout": RECORD, "priors": {"gain": (1, 2)}}, "heldout, priors cannot be given for plants and models"),
        ({"kp": 60}, "kp cannot be given for plants and models"),
        ({"efort": "quick"}, r"'efort' is no argument .*; did you mean 'effort'"),
        ({"force": "no"}, "force must be one of True, False; got str 'no'"),
        ({"certify": "no"}, "certify must be one of True, False; got str 'no'"),
    ],
)
def test_what_has_no_meaning_for_a_plant_is_refused(given, said):
    with pytest.raises(InputError, match=said):
        tune(PLANT, SPEC, **given)


TOLD_OF_PROGRESS = {
    "diagnose": lambda progress: diagnose(RECORD, effort="quick", progress=progress),
    "study_records": lambda progress: study_records(RECORD, SPEC, effort="quick", progress=progress),
    "tune": lambda progress: tune(PLANT, SPEC, progress=progress),
    "compare": lambda progress: compare(PLANT, PLANT, SPEC, progress=progress),
    "tune_gains": lambda progress: tune_gains(PLANT, SPEC, GainWishes(scenarios=0), progress=progress),
}


@pytest.mark.parametrize("name", TOLD_OF_PROGRESS)
def test_progress_is_a_function_or_none(name):
    assert TOLD_OF_PROGRESS[name](None) is not None
    with pytest.raises(InputError, match=r"progress must be a function of .*, or None; got int 5"):
        TOLD_OF_PROGRESS[name](5)


def test_one_effect_alone_makes_a_plant():
    friction = CoulombFriction(level=0.3)
    assert Plant(gain=1.9, damping=6, effects=friction) == Plant(gain=1.9, damping=6, effects=(friction,))


def test_a_misspelt_name_of_the_package_or_of_a_parameter_is_answered_with_the_right_one():
    with pytest.raises(AttributeError, match="did you mean 'CoulombFriction'"):
        _ = servolens.coulomb_friction
    with pytest.raises(KeyError, match="gian is no parameter of this model; did you mean 'gain'"):
        _ = Model(plant=PLANT).quantities["gian"]


def test_a_result_of_servolens_in_place_of_a_log_is_said(model_file):
    with pytest.raises(InputError, match=r"is a result that servolens wrote \(servolens.model/1\); give the log"):
        as_records(str(model_file))


@pytest.mark.parametrize(("noise", "seen"), [(2e-6, True), (2e-4, False)])
def test_coarse_encoder_is_seen_where_no_record_states_it(noise, seen):
    runs = [lab.step_record(lab.LM1, kp, encoder=1e-4, noise=noise, seed=kp) for kp in (40, 80)]
    silent = [replace(run, encoder_resolution=None) for run in runs]
    steps = [record.encoder_resolution for record in as_records(silent)]
    assert steps == ([pytest.approx(1e-4, rel=1e-3)] * 2 if seen else [None, None])
    train, held = as_groups(silent[:1], silent[1:])
    assert train[0].encoder_resolution == (pytest.approx(held[0].encoder_resolution) if seen else None)
    assert [record.encoder_resolution for record in as_records([runs[0], silent[1]])] == [1e-4, 1e-4]


def rounded(record, step):
    return replace(record, position=step * np.round(record.position / step), encoder_resolution=None)


def test_a_step_that_not_all_records_show_is_no_encoders():
    """A log that was rounded when it was written says nothing of the noise of the others."""
    runs = [lab.step_record(lab.LM1, kp, encoder=0, noise=1e-5, seed=kp) for kp in (40, 80, 120)]
    assert [r.encoder_resolution for r in as_records([runs[0], rounded(runs[1], 1e-3)])] == [None, None]
    train, held = as_groups(runs[:2], rounded(runs[2], 1e-3))
    assert [r.encoder_resolution for r in train] == [None, None]
    assert held[0].encoder_resolution == pytest.approx(1e-3, rel=1e-3)
    train, held = as_groups([rounded(run, 1e-3) for run in runs[:2]], runs[2])
    assert ([r.encoder_resolution for r in train], held[0].encoder_resolution) == (
        [pytest.approx(1e-3, rel=1e-3)] * 2,
        None,
    )


@pytest.mark.parametrize("noise", [0.0, 1e-7, 3e-6])
def test_constant_speed_is_no_encoder(noise):
    time = 1e-3 * np.arange(2000)
    path = 0.1 * np.abs((time + 0.25) % 1.0 - 0.5) + noise * np.random.default_rng(1).standard_normal(2000)
    record = Record(time=time, position=path, voltage=np.ones(2000), length_unit="m", command_unit="V")
    assert as_records(record)[0].encoder_resolution is None


def test_rounding_of_a_coarse_encoder_is_no_second_cause_where_it_is_not_stated():
    axis = lab.Truth(gain=2.0, damping=12.0, effects={"coulomb_friction": {"level": 0.4}})
    runs = [lab.step_record(axis, kp, encoder=1e-4, noise=1e-5, seed=kp) for kp in (60, 90, 120)]
    found = servolens.diagnose([replace(run, encoder_resolution=None) for run in runs[:2]], heldout=runs[2])
    assert (found.verdict, [cause.effect for cause in found.causes]) == ("explained", ["coulomb_friction"])
    assert found.causes[0].quantities["level"].value == pytest.approx(0.4, rel=0.01)


def test_series_names_what_is_fixed_and_its_bounds_as_a_dict_does():
    held = fit((), RECORD, fixed=pd.Series({"damping": 6.0}), bounds=pd.Series({"gain": (1.0, 3.0)}))
    same = fit((), RECORD, fixed={"damping": 6.0}, bounds={"gain": (1.0, 3.0)})
    assert held.plant == same.plant
    assert held.plant.damping == 6.0
