"""The record as a value: what it admits, what it offers, and that it cannot be changed."""

from __future__ import annotations

import csv
import dataclasses
import io
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servolens import PDSpec, Plant, read_record, simulate, units
from servolens.controller import NUMBERS
from servolens.errors import InputError
from servolens.lab import NLM1, step_record
from servolens.record import Controller, Record


def record(**changes):
    given = {
        "time": [0.0, 0.1, 0.2, 0.3],
        "position": [0.0, 1.0, 2.0, 3.0],
        "reference": [4.0, 4.0, 4.0, 4.0],
        "controller": Controller(kp=2.0),
    }
    return Record(**{**given, **changes})


RUN = step_record(NLM1, kp=60, kd=1 / 3, duration=0.5, seed=3)
NOISE = np.random.default_rng(720441).normal(size=(3, len(RUN)))


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"reference": None},
        {"voltage": None, "length_unit": "rad", "command_unit": "N m"},
        {"command_unit": "%", "name": "Wagen 3 = größer, #4"},
        {
            "velocity": NOISE[0],
            "feedforward": NOISE[1],
            "enabled": (NOISE[2] > 0).astype(float),
            "voltage_limit": 1 / 3,
            "voltage_before": 0.0,
            "inertia": 0.1 + 0.2,
        },
        {"controller": Controller(kp=1 / 7, ki=40, setpoint_weight=0.3, integral_before=0.7, control_period=0.002)},
        {"controller": Controller(kp=-6, kd=-1, derivative_filter=0.3, derivative_window=2, derivative_on="error")},
        {"controller": Controller(kp=60, kd=1, derivative="velocity"), "velocity": NOISE[0]},
        {"controller": Controller(kp=60, velocity_feedforward=1.0)},
        {
            "controller": Controller(
                kp=60, ki=3, setpoint_weight=0.3, velocity_feedforward=-1 / 3, derivative_on="error"
            )
        },
        *({"controller": Controller(kp=a, kd=b, velocity_feedforward=c)} for a, b, c in NOISE[:, 5:25].T.tolist()),
        {
            "controller": Controller(kp=60, ki=3, anti_windup="back_calculation", tracking_time=0.1),
            "voltage_limit": 9.0,
        },
        *(
            {
                "controller": Controller.cascade(kp=a, kv=b, kiv=abs(c) * np.sign(b), feedforward_speed=a * c),
                "voltage_limit": 9.0,
            }
            for a, b, c in NOISE[:, :5].T.tolist()
        ),
    ],
)
def test_record_is_read_as_it_was_written_to_the_last_bit(tmp_path, changes):
    written = RUN.with_(changes)
    written.to_csv(tmp_path / "run.csv")
    read = read_record(tmp_path / "run.csv")
    for field in dataclasses.fields(Record):
        if field.name not in ("source", "remarks"):
            np.testing.assert_array_equal(getattr(read, field.name), getattr(written, field.name), field.name)
    assert read.remarks == ()


MEANT = {
    "V": "V", "Volt": "V", "volt": "V", "Volts": "V", "volts": "V", "VOLT": "V", "VOLTS": "V",
    "A": "A", "N": "N", "newton": "N", "N m": "N m", "Nm": "N m", "N*m": "N m",
    "%": "%", "percent": "%", "pwm": "pwm",
}  # fmt: skip
"""Spellings of the units of commands, and which."""
OTHERS = {*units._ATOMS, *units._SPELLINGS, "rev/s", "A/m", "furlong", "no unit", ""} - {*MEANT}
"""All other units that are known, and none: no multiple of a unit is a command's."""


@pytest.mark.parametrize("text", MEANT)
def test_every_unit_that_a_record_may_have_is_read_as_it_was_written(tmp_path, text):
    written = RUN.with_({"command_unit": text, "feedforward": NOISE[1], "voltage_limit": 9.0})
    written.to_csv(tmp_path / "run.csv")
    read = read_record(tmp_path / "run.csv")
    assert read.command_unit == written.command_unit == MEANT[text]
    assert (read.controller, read.voltage_limit, read.remarks) == (RUN.controller, 9.0, ())
    np.testing.assert_array_equal(read.voltage, RUN.voltage)
    np.testing.assert_array_equal(read.feedforward, NOISE[1])


@pytest.mark.parametrize("text", sorted(OTHERS))
def test_commands_in_other_units_are_no_record(text):
    sentence = f"record: command_unit must be 'V', 'A', 'N', 'N m', '%' or 'pwm', got {text!r}"
    with pytest.raises(InputError, match=f"^{re.escape(sentence)}$"):
        record(command_unit=text)


@pytest.mark.parametrize("text", ["mm", "deg", "ft", ""])
def test_positions_are_in_metres_or_radians(text):
    with pytest.raises(InputError, match=f"record: length_unit must be 'm' or 'rad', got '{text}'$"):
        record(length_unit=text)


def test_number_in_an_array_of_no_dimension_is_a_number():
    """What NumPy's functions give for a scalar was refused as `array(60.)`."""
    loop = Controller(
        kp=np.array(60.0), kd=np.float64(1.5), control_period=np.array(0.002), derivative_window=np.array(2)
    )
    assert loop == Controller(kp=60.0, kd=1.5, control_period=0.002, derivative_window=2)
    limited = {"voltage_limit": 10.0, "voltage_before": 0.5, "inertia": 0.1, "encoder_resolution": 1e-5}
    written = RUN.with_({**{name: np.array(value) for name, value in limited.items()}, "controller": loop})
    assert {name: getattr(written, name) for name in limited} == limited
    numbers = (*(getattr(loop, name) for name in NUMBERS), *(getattr(written, name) for name in limited))
    assert {type(number) for number in numbers if number is not None} == {float, int}
    assert PDSpec(kp=np.array(60.0), settling_time=np.array(0.5)) == PDSpec(kp=60.0, settling_time=0.5)
    for wrong in (np.array([60.0]), np.array(True), np.array("60")):
        with pytest.raises(InputError, match=r"^kp must be a number, got "):
            Controller(kp=wrong)


def as_cells(text, separator=","):
    return list(csv.reader(text.splitlines(), delimiter=separator))


def padded(text):
    """Cut at the commas and written again, as many cells in each row as in the widest."""
    rows = as_cells(text)
    width = max(map(len, rows))
    out = io.StringIO()
    csv.writer(out).writerows([*row, *[""] * (width - len(row))] for row in rows)
    return out.getvalue()


def one_cell(text):
    """Comment lines in one cell each, as where the columns are cut at another sign."""
    lines = text.splitlines()
    return "\n".join('"' + line.replace('"', '""') + '"' if line.startswith("#") else line for line in lines)


def german(text):
    """Semicolons and decimal commas."""
    out = io.StringIO()
    csv.writer(out, delimiter=";").writerows(
        [cell if cell.startswith("#") else cell.replace(".", ",") for cell in row] for row in as_cells(padded(text))
    )
    return out.getvalue()


@pytest.mark.parametrize("saved", [padded, one_cell, german])
@pytest.mark.parametrize("name", ["run", "cart, kp 60", 'cart, "kp" 60'])
def test_settings_outlive_a_spreadsheet_that_saves_the_file_again(tmp_path, saved, name):
    """The blank cells behind a comment were taken for a part of its unit, which then counted as none."""
    head = f"# name = {name}\n# kp = 0.06 V/mm\n# kd = 0.001 V s/mm\n# voltage_limit = 9 V\n"
    RUN.to_csv(tmp_path / "run.csv")
    rows = (tmp_path / "run.csv").read_text(encoding="utf-8")
    (tmp_path / "run.csv").write_text(saved(head + rows[rows.index("time") :]), encoding="utf-8")
    read = read_record(tmp_path / "run.csv")
    assert (read.name.replace("; ", ", "), read.voltage_limit) == (name, 9.0)
    assert (read.controller.kp, read.controller.kd) == pytest.approx((60.0, 1.0), rel=1e-12)
    assert read.remarks == ()


def test_settings_outlive_a_workbook(tmp_path):
    import openpyxl

    RUN.with_({"name": "cart, kp 60", "voltage_limit": 9.0}).to_csv(tmp_path / "run.csv")
    book = openpyxl.Workbook()
    for row in as_cells((tmp_path / "run.csv").read_text(encoding="utf-8")):
        book.active.append(
            [
                cell if (k and row[0].startswith("#")) or not _is_number(cell) else float(cell)
                for k, cell in enumerate(row)
            ]
        )
    book.save(tmp_path / "run.xlsx")
    read = read_record(tmp_path / "run.xlsx")
    assert (read.name, read.voltage_limit, read.controller, read.remarks) == ("cart, kp 60", 9.0, RUN.controller, ())


def _is_number(cell):
    try:
        float(cell)
    except ValueError:
        return False
    return True


def test_name_of_several_lines_cannot_state_a_setting(tmp_path):
    RUN.with_({"name": "run\n# kp = 99"}).to_csv(tmp_path / "run.csv")
    read = read_record(tmp_path / "run.csv")
    assert (read.name, read.controller) == ("run# kp = 99", RUN.controller)


@pytest.mark.parametrize(
    ("law", "sentence"),
    [
        (
            {"law": "cascade"},
            "the controller has law = 'cascade' and kd = 0, but kd is the gain kv of a cascade; give kd or law = 'pd'",
        ),
        (
            {"integral_rate": 2.0},
            "the controller has integral_rate and kd = 0, but kd is the gain kv of a cascade; give kd",
        ),
        (
            {"integral_rate": 2.0, "kd": 1.0, "ki": 3.0},
            "the controller has integral_rate and ki = 3.0, which a cascade does not have; only with ki = 0.0 can it be"
            " written",
        ),
        (
            {"law": "cascade", "kd": 1.0, "derivative_on": "error"},
            "the controller has law = 'cascade' and derivative_on = 'error', which a cascade does not have; only with"
            " derivative_on = 'measurement' can it be written",
        ),
    ],
)
def test_loop_that_no_settings_state_is_not_written(tmp_path, law, sentence):
    odd = RUN.with_({"controller": Controller(kp=60, **law)})
    with pytest.raises(InputError, match=f"^{re.escape(sentence)}$"):
        odd.to_csv(tmp_path / "run.csv")
    assert not [*tmp_path.iterdir()]


def test_record_cannot_be_written_into_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match=r"nowhere.run\.csv: cannot be written"):
        RUN.to_csv(tmp_path / "nowhere" / "run.csv")


def test_signals_are_read_only_copies():
    position = np.zeros(4)
    made = record(position=position)
    position[0] = 7.0
    assert made.position[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        made.position[0] = 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        made.name = "other"


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"time": [0.0]}, "record: a record needs at least 2 samples, got 1"),
        ({"position": [1.0, 2.0]}, "record: position has 2 samples, time has 4"),
        ({"position": [[1.0] * 4]}, "record: position must be one-dimensional, got shape (1, 4)"),
        ({"position": [0, 1, np.nan, 3]}, "record: position must be finite; sample 2 is nan"),
        ({"reference": [0, np.inf, 0, 3]}, "record: reference must be finite; sample 1 is inf"),
        (
            {"time": [0, 0.1, 0.1, 0.3]},
            "record: time must increase; sample 2 (0.1 s) repeats sample 1 (0.1 s)"
            "; if the stamps were rounded, state the sample_time instead",
        ),
        (
            {"time": [0, 0.2, 0.1, 0.3]},
            "record: time must increase; sample 2 (0.1 s) lies before sample 1 (0.2 s)"
            "; a record is one run in the order of its time: split or sort the rows",
        ),
        (
            {"reference": None},
            "record: neither reference nor voltage is given; log at least one of the two",
        ),
        (
            {"controller": None},
            "record: no voltage is logged and the gains are unknown; give kp and kd (on the command"
            " line --record-kp and --record-kd)",
        ),
        ({"encoder_resolution": 0.0}, "record: encoder_resolution must be positive, got 0.0"),
        ({"encoder_resolution": -1.0}, "record: encoder_resolution must be positive, got -1.0"),
        ({"voltage_limit": float("nan")}, "record: voltage_limit must be positive, got nan"),
    ],
)
def test_what_does_not_fit_together_is_refused(changes, sentence):
    with pytest.raises(InputError) as refusal:
        record(**changes)
    assert str(refusal.value) == sentence


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"kp": float("nan")}, "kp must be finite, got nan"),
        ({"kd": float("inf")}, "kd must be finite, got inf"),
        ({"derivative_filter": 0.0}, "derivative_filter must lie in (0, 1], got 0.0"),
        ({"derivative_filter": 1.1}, "derivative_filter must lie in (0, 1], got 1.1"),
        ({"derivative_window": 0}, "derivative_window must be a whole number of samples, at least 1, got 0"),
        ({"derivative_on": "x"}, "derivative_on must be 'measurement' or 'error', got 'x'"),
        ({"derivative": "x"}, "derivative must be 'position' or 'velocity', got 'x'"),
        ({"control_period": 0.0}, "control_period must be positive, got 0.0"),
    ],
)
def test_controller_refuses_what_is_out_of_range(changes, sentence):
    with pytest.raises(InputError, match=f"^{re.escape(sentence)}$"):
        Controller(**{"kp": 1.0, **changes})


def test_times_and_sizes():
    made = record()
    assert len(made) == 4
    assert made.sample_time == pytest.approx(0.1)
    assert made.duration == pytest.approx(0.3)
    assert made.step_size == 4.0
    assert record(reference=None, voltage=[0, 0, 0, 0]).step_size == 3.0


def test_slice_keeps_both_ends():
    part = record().slice(0.1, 0.2)
    assert part.time.tolist() == [0.1, 0.2]
    assert part.reference.tolist() == [4.0, 4.0]
    with pytest.raises(InputError) as refusal:
        record().slice(0.11, 0.19)
    assert str(refusal.value) == "record: only 0 samples lie between 0.11 and 0.19 s (the record spans 0 to 0.3 s)"


def test_steps_begin_at_the_edges_of_the_reference():
    n = 400
    reference = np.repeat([0.0, 0.1, 0.0, 0.1], 100)
    position = np.concatenate((np.zeros(100), np.linspace(0, 0.1, 100), np.linspace(0.1, 0, 100), np.full(100, 0.05)))
    made = record(time=np.arange(n) * 1e-3, reference=reference, position=position, name="run")
    steps = made.steps()
    assert made.edges().tolist() == [100, 200, 300]
    assert [step.name for step in steps] == ["run, step 1", "run, step 2", "run, step 3"]
    assert [float(step.time[0]) for step in steps] == pytest.approx([0.1, 0.2, 0.3])


def test_ramp_is_no_series_of_steps():
    made = record(reference=[0.0, 1.0, 2.0, 3.0])
    assert made.steps() == (made,)


def test_onset_is_the_last_sample_at_rest():
    position = np.concatenate((np.zeros(50), 1e-3 * np.arange(1, 51)))
    made = record(
        time=np.arange(100) * 1e-3, position=position, reference=np.repeat([0.0, 1.0], 50), encoder_resolution=1e-4
    )
    assert made.onset() == pytest.approx(0.049)
    still = record(position=[1, 1, 1, 1])
    assert still.onset() == pytest.approx(0.3)


def test_resample_interpolates_position_and_holds_voltage():
    made = record(voltage=[1.0, 2.0, 3.0, 4.0]).resample(0.05)
    assert made.time == pytest.approx([0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3])
    assert made.position == pytest.approx([0, 0.5, 1, 1.5, 2, 2.5, 3])
    assert made.voltage.tolist() == [1, 1, 2, 2, 3, 3, 4]
    with pytest.raises(InputError, match=r"^record: sample_time must lie in \(0, 0.3\] s, got -1$"):
        record().resample(-1)


def test_copy_with_other_settings():
    assert record().with_({"controller": Controller(kp=58.7)}).controller.kp == 58.7
    with pytest.raises(InputError, match=r"^record: no field named gain; known are command_unit, control_period,"):
        record().with_({"gain": 1})


@given(st.integers(2, 60), st.floats(1e-5, 10.0), st.integers(1, 5))
def test_resampling_on_its_own_grid_changes_nothing(n, h, seed):
    rng = np.random.default_rng(seed)
    made = record(
        time=np.arange(n) * h, position=rng.normal(size=n), reference=rng.normal(size=n), voltage=rng.normal(size=n)
    )
    same = made.resample(made.sample_time)
    kept = len(same)
    assert kept >= n - 1
    assert same.position == pytest.approx(made.position[:kept], abs=1e-6)
    assert same.voltage == pytest.approx(made.voltage[:kept])


def test_what_was_applied_before_holds_for_the_first_sample_only():
    record = Record(time=[0, 1, 2, 3], position=[0, 0, 1, 2], voltage=[0, 5, 5, 5], voltage_before=1.0)
    assert record.slice(0, 2).voltage_before == 1.0
    assert record.slice(1, 3).voltage_before is None


@pytest.mark.parametrize(
    ("levels", "largest"),
    [((0.0, 0.6, 1.0, -0.2), 1.2), ((0.0, 0.6, 1.0, 0.4, -0.2), 0.6), ((0.5,), 0.5), ((0.0, 0.0), 0.0)],
)
def test_largest_step_is_that_from_one_rest_to_the_next(levels, largest):
    reference = np.repeat(levels, 50).astype(float)
    time = 1e-3 * np.arange(reference.size)
    made = Record(time=time, position=0.0 * time, reference=reference, controller=Controller(kp=1.0))
    assert made.largest_step == pytest.approx(largest)


def test_largest_step_of_a_trajectory_is_all_its_way():
    time = 1e-3 * np.arange(1000)
    ramp = 0.3 * np.clip((time - 0.1) / 0.5, 0.0, 1.0)
    made = Record(time=time, position=0.0 * time, reference=ramp, controller=Controller(kp=1.0))
    assert made.largest_step == pytest.approx(0.3)
    without = Record(time=time, position=ramp, voltage=0.0 * time)
    assert without.largest_step == pytest.approx(0.3)


def test_largest_step_of_a_slow_ramp_in_counts_is_all_its_way():
    time = 1e-3 * np.arange(5000)
    ramp = 2e-3 * np.clip(time - 0.5, 0.0, 3.5)
    counts = 1e-4 * np.round(ramp / 1e-4)  # one for 50 samples each
    made = Record(time=time, position=ramp, reference=counts, controller=Controller(kp=1.0))
    assert made.largest_step == pytest.approx(7e-3)


def test_steps_of_a_staircase_are_steps_however_long_the_record():
    levels = 0.02 * np.array([0, 1, 2, 3, 4, 5, 4, 3, 2, 1] * 6)
    reference = np.repeat(levels, 750)
    time = 2e-3 * np.arange(reference.size)
    made = Record(time=time, position=0.0 * time, reference=reference, controller=Controller(kp=1.0))
    assert made.largest_step == pytest.approx(0.02)


def test_loop_is_known_with_reference_and_gains():
    t = np.arange(20) * 1e-3
    whole = Record(time=t, position=0.0 * t, reference=0.0 * t + 0.1, controller=Controller(kp=60.0), voltage=0.0 * t)
    assert whole.has_loop
    assert not whole.with_({"controller": None}).has_loop
    assert not whole.with_({"reference": None}).has_loop


def test_columns_of_a_table_that_nobody_may_change_are_copied_into_arrays_of_their_own():
    table = np.column_stack([np.arange(50) * 1e-3, np.linspace(0.0, 1.0, 50), np.ones(50)])
    table.flags.writeable = False
    record = Record(time=table[::2, 0], position=table[::2, 1], voltage=table[::2, 2])
    assert all(signal.flags.c_contiguous for signal in (record.time, record.position, record.voltage))
    assert simulate(Plant(gain=1.0, damping=1.0), record).position.shape == (25,)
