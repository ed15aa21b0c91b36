"""The manners that fits, identifications, diagnoses, designs and predictions share."""

from __future__ import annotations

import json
import re
from functools import cache

import matplotlib as mpl
import numpy as np
import pytest

from servolens import (
    Design,
    Diagnosis,
    Fit,
    Identification,
    InputError,
    PDSpec,
    Plant,
    Prediction,
    diagnose,
    fit,
    identify,
    lab,
    predict,
    tune,
)
from servolens.results import to_text
from servolens.summary import Summary

mpl.use("Agg")

CART = lab.Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.3}})
RECORDS = tuple(lab.step_record(CART, kp=kp, noise=1e-5, seed=kp) for kp in (40, 80))
SPEC = PDSpec(kp=100, settling_time=0.5)
MADE = {
    Fit: lambda: fit("coulomb_friction", RECORDS),
    Identification: lambda: identify(RECORDS),
    Diagnosis: lambda: diagnose(RECORDS, effort="quick"),
    Design: lambda: tune(Plant(gain=1.9, damping=6.0), SPEC),
    Prediction: lambda: predict(Plant(gain=1.9, damping=6.0), RECORDS),
}
FITTED = (Fit, Identification, Diagnosis, Prediction)


@cache
def made(kind):
    return MADE[kind]()


def stored(result):
    return json.loads(to_text(result.to_json()))


@pytest.fixture(params=MADE, ids=lambda kind: kind.__name__)
def kind(request):
    return request.param


def test_every_result_has_a_plant_near_the_truth(kind):
    assert made(kind).plant.gain == pytest.approx(1.9, rel=0.25)


def test_repr_is_one_short_line_that_says_what_was_found(kind):
    text = repr(made(kind))
    assert text.startswith(f"<{kind.__name__}: ")
    assert "\n" not in text
    assert len(text) < 400


def test_summary_is_text_on_a_terminal_and_html_in_a_notebook(kind):
    summary = made(kind).summary()
    assert isinstance(summary, Summary)
    assert summary.sentences[0] in " ".join(str(summary).split())
    assert made(kind)._repr_html_().count("<table") == len(summary.tables) >= 1


def test_json_holds_the_whole_result(kind, tmp_path):
    body = made(kind).to_json()
    again = kind.from_json(body)
    assert stored(again) == stored(made(kind))
    path = tmp_path / "result.json"
    made(kind).save(path)
    assert stored(kind.from_json(path)) == stored(made(kind))


def test_summary_of_a_file_says_the_same(kind, tmp_path):
    path = tmp_path / "result.json"
    made(kind).save(path)
    ours, theirs = made(kind).summary(), kind.from_json(str(path)).summary()
    assert theirs.sentences == ours.sentences
    assert theirs.tables == ours.tables


def places(value, path=()):
    """Yield where everything stands in a file, of lists the first two."""
    if path:
        yield path
    inner = value.items() if isinstance(value, dict) else enumerate(value[:2]) if isinstance(value, list) else ()
    for key, one in inner:
        yield from places(one, (*path, key))


@pytest.mark.parametrize("other", [3, "x", None, [], {}, [[1]], True], ids=repr)
def test_a_damaged_file_is_refused_with_a_sentence_or_read(kind, other):
    body = stored(made(kind))
    found = []
    for path in places(body):
        owner = body
        for key in path[:-1]:
            owner = owner[key]
        kept, owner[path[-1]] = owner[path[-1]], other
        try:
            kind.from_json(body)
        except InputError as refusal:
            found.append(str(refusal))
        owner[path[-1]] = kept
    assert found
    assert not [sentence for sentence in found if "\n" in sentence]


def test_what_is_no_such_result_is_refused_with_a_sentence(kind, tmp_path):
    path = tmp_path / "other.json"
    path.write_text("[]")
    for source in (path, tmp_path / "nowhere.json"):
        with pytest.raises(InputError, match=r"(other|nowhere)\.json: "):
            kind.from_json(source)


@pytest.mark.parametrize("kind", [Fit, Identification, Diagnosis, Design])
def test_json_of_something_else_is_refused_with_a_sentence(kind):
    with pytest.raises(InputError, match=r"missing|must be"):
        kind.from_json({"kd": "five"})


@pytest.mark.parametrize("kind", FITTED)
def test_json_of_a_result_may_be_a_text(kind):
    text = json.dumps(made(kind).to_json())
    assert stored(kind.from_json(text)) == stored(made(kind))
    with pytest.raises(InputError) as refused:
        kind.from_json(text[:-1])
    assert str(refused.value) == "the text: is not JSON"


def test_file_of_another_result_is_named(kind, tmp_path):
    path = tmp_path / "other.json"
    made(Fit if kind is not Fit else Design).save(path)
    held, wanted = "design" if kind is Fit else "fit", kind.__name__.lower()
    with pytest.raises(InputError) as refused:
        kind.from_json(path)
    assert str(refused.value) == (
        f"{path} is of schema 'servolens.{held}/1'; {kind.__name__}.from_json reads 'servolens.{wanted}/1'"
    )


@pytest.mark.parametrize("kind", FITTED)
def test_simulate_and_residuals_belong_to_each_other(kind):
    found = made(kind)
    simulated, residuals = found.simulate(), found.residuals()
    for record, row, residual in zip(RECORDS, simulated.positions, residuals, strict=True):
        np.testing.assert_allclose(row[0] - record.position, residual, atol=1e-15)
    (other,) = found.simulate(RECORDS[1]).records
    assert other is RECORDS[1]


def test_table_has_a_row_for_each_thing_and_numbers_in_its_columns(kind):
    frame = made(kind).to_dataframe()
    column = {Prediction: "percent_error", Design: "kd"}.get(kind, "value")
    assert np.isfinite(frame[column].to_numpy(dtype=float)).all()
    assert len(frame) >= 2


def test_table_of_a_fit_holds_its_quantities():
    frame = made(Fit).to_dataframe()
    quantity = made(Fit).quantities["coulomb_friction.level"]
    row = frame.loc["coulomb_friction.level"]
    assert (row["value"], row["stderr"], row["unit"]) == (quantity.value, quantity.stderr, "m/s^2")
    assert row["low"] < float(quantity) < row["high"]


def test_trajectories_hold_what_was_measured_and_what_was_simulated():
    frame = made(Prediction).trajectories()
    assert list(frame.columns) == ["record", "time", "measured", "the model"]
    first = frame[frame["record"] == RECORDS[0].name]
    np.testing.assert_array_equal(first["measured"], RECORDS[0].position)
    np.testing.assert_array_equal(first["the model"], made(Prediction).positions[0][0])


def test_plot_draws_on_the_axes_given_and_returns_them(kind):
    from matplotlib import pyplot as plt

    _, ax = plt.subplots()
    assert made(kind).plot(ax=ax) is ax
    labels = ax.get_legend_handles_labels()[1]
    told = {
        Fit: "fitted",
        Identification: "constant damping",
        Diagnosis: "with the causes",
        Prediction: "the model",
        Design: "least, kd = ",
    }[kind]
    assert any(label.startswith(told) for label in labels)
    assert ax.get_ylabel() == "Position [m]"
    new = made(kind).plot()
    assert new is not ax
    assert new.get_legend() is None  # it would stand on lines
    assert [text.get_text() for text in new.figure.legends[0].get_texts()] == labels
    plt.close("all")


@pytest.mark.parametrize("kind", FITTED)
def test_results_from_files_ask_for_records_to_simulate_and_to_draw(kind):
    stored = kind.from_json(made(kind).to_json())
    for ask in (stored.simulate, stored.residuals, stored.plot):
        with pytest.raises(InputError, match=r"holds? no (records|plants)"):
            ask()


@pytest.mark.parametrize("kind", [Fit, Identification, Diagnosis])
def test_results_from_files_predict_as_before(kind):
    stored = kind.from_json(made(kind).to_json())
    np.testing.assert_allclose(stored.residuals(RECORDS)[0], made(kind).residuals()[0], atol=1e-12)


def test_design_without_records_simulates_its_own_step():
    run = made(Design).step()
    assert run.position[-1] == pytest.approx(SPEC.reference, rel=SPEC.band)
    for ask in (made(Design).simulate, made(Design).residuals):
        with pytest.raises(InputError, match="this design holds no records: it was made from plants or models"):
            ask()
    assert len(made(Design).residuals(RECORDS)) == len(RECORDS)


def test_design_that_gives_no_gain_has_no_step_to_draw():
    none = tune(Plant(gain=1.9, damping=6.0), PDSpec(kp=100, settling_time=0.01))
    assert none.gain is None
    for ask in (none.step, none.plot):
        with pytest.raises(InputError, match="this design gives no gain"):
            ask()


def test_fit_report_names_errors_correlations_and_what_was_fixed():
    found = fit("coulomb_friction", RECORDS, fixed={"damping": 6.0})
    parameters, correlations = found.summary().tables
    values = {row[0]: row[1] for row in parameters.rows}
    assert values["damping"] == "6 (fixed)"
    assert all("±" in values[name] for name in ("gain", "coulomb_friction.level"))
    assert correlations.rows[0][0] == "gain, coulomb_friction.level"
    assert float(correlations.rows[0][1]) == pytest.approx(next(iter(found.correlations.values())), abs=0.006)


@cache
def with_usual_values():
    truth = lab.Truth(gain=1.9, damping=6.0, effects={"backlash": {"gap": 1e-3, "load_share": 0.3}})
    return fit("backlash", [lab.step_record(truth, kp=kp, noise=1e-5, seed=kp) for kp in (40, 80)])


def named_by_nobody(body):
    del body["refinement"]["parameters"]


def of_before_the_contact_had_parameters(body):
    named_by_nobody(body)
    kept = len(body["model"]["covariance"]["names"])
    body["refinement"]["colour"] = body["refinement"]["colour"][:kept]
    body["refinement"]["correlation"] = [row[:kept] for row in body["refinement"]["correlation"][:kept]]


def in_another_order(body):
    told = body["refinement"]
    told["parameters"].reverse()
    told["colour"].reverse()
    told["correlation"] = [row[::-1] for row in told["correlation"][::-1]]


@pytest.mark.parametrize("change", [named_by_nobody, of_before_the_contact_had_parameters, in_another_order])
def test_correlations_belong_to_their_parameters_in_every_file_of_a_fit(change):
    found = with_usual_values()
    body = stored(found)
    change(body)
    again = Fit.from_json(body)
    assert again.correlations == found.correlations
    np.testing.assert_array_equal(again.refinement.colour, found.refinement.colour)
    assert again.summary().tables == found.summary().tables


@pytest.mark.parametrize(
    ("names", "sentence"),
    [
        (["gain", "damping"], r"correlation has shape \(6, 6\); it must have a place for each of gain, damping$"),
        (list("abcdef"), "correlation must name gain, damping, backlash.gap, backlash.load_share; got"),
        (7, "parameters must be a list, got '7'"),
    ],
)
def test_correlations_of_other_parameters_are_refused_with_a_sentence(names, sentence):
    body = stored(with_usual_values())
    body["refinement"]["parameters"] = names
    with pytest.raises(InputError, match=sentence):
        Fit.from_json(body)


def test_a_quantity_is_a_number_and_is_formatted_as_one():
    quantity = made(Fit).quantities["gain"]
    assert float(quantity) == quantity.value
    assert f"{quantity:.3f}" == f"{quantity.value:.3f}"
    assert f"{quantity}".endswith(" m/s^2/V")


def test_records_and_models_show_themselves_in_one_line():
    assert repr(RECORDS[0]) == "<Record kp 40, kd 0: 1501 samples in 1.5 s, position, reference, voltage; kp 40, kd 0>"
    assert re.match(r"<Model: gain [\d.]+ ± \S+ m/s\^2/V, damping ", repr(made(Fit).model))
    assert "\n" not in repr(made(Fit).model)


def test_the_law_of_identify_is_what_fit_finds():
    record = lab.step_record(lab.NLM3, kp=100, encoder=1e-5, noise=1e-5, seed=1)
    law, found = identify(record, model="velocity").velocity, fit("velocity_decay_damping", record)
    for name, quantity in found.quantities.items():
        assert law.quantities[name].value == pytest.approx(quantity.value, abs=0.1 * quantity.stderr)
        assert law.quantities[name].stderr == pytest.approx(quantity.stderr, rel=0.05)


def test_pieces_that_the_data_do_not_determine_are_a_sentence_and_no_rows():
    short = identify(RECORDS[0].slice(0.0, 0.06))
    rows = [
        row for table in short.summary().tables if table.title.startswith("Damping that varies") for row in table.rows
    ]
    errors = np.sqrt(np.diag(short.varying.covariance))[:-1]
    vague = int((errors > np.maximum(short.varying.damping, 1.0)).sum())
    assert vague > 0
    assert len(rows) == errors.size - vague
    told = [finding.message for finding in short.findings if finding.code == "pieces_not_determined"]
    assert told == [f"time-varying damping: the data hardly determine {vague} of its {errors.size} pieces."]
