"""Logs in further languages, with an error in the place of a reference, of clocks of computers, and in small units."""

from __future__ import annotations

import numpy as np
import pytest

from servolens import lab
from servolens.campaign import read_logs, read_records
from servolens.conversion import write_campaign
from servolens.errors import InputError
from servolens.reading import read_log
from servolens.reading.words import meaning, unit_behind

TRUTH = lab.step_record(lab.NLM2, 60, 4, reference=(0.1, 0.02, 0.07), duration=0.6, noise=1e-5, seed=5)
T, Y, R, U = TRUTH.time, TRUTH.position, TRUTH.reference, TRUTH.voltage


def log(folder, heads, *columns, separator=","):
    """Write a log; cells that are texts stand as they are."""
    rows = zip(*columns, strict=True)
    body = "".join(separator.join(x if isinstance(x, str) else f"{x:.9g}" for x in row) + "\n" for row in rows)
    path = folder / "run.csv"
    path.write_text(separator.join(heads) + "\n" + body, encoding="utf-8")
    return path


def check(record, scale=1.0):
    for signal, truth in (("position", Y * scale), ("reference", R * scale), ("voltage", U)):
        assert getattr(record, signal) == pytest.approx(truth, abs=1e-5 * scale + 1e-6), signal


def evidence(reading, quantity):
    return next(guess for guess in reading.guesses if guess.quantity == quantity)


# ---- languages


@pytest.mark.parametrize(
    "heads",
    [
        ("temps (s)", "consigne (mm)", "position (mm)", "tension (V)"),
        ("Temps", "Position de consigne [mm]", "Position mesurée [mm]", "Tension moteur"),
        ("tempo [s]", "riferimento [mm]", "posizione [mm]", "tensione [V]"),
        ("Tempo", "Posizione di riferimento [mm]", "Posizione misurata [mm]", "Tensione motore"),
        ("tiempo [s]", "referencia [mm]", "posición [mm]", "tensión [V]"),
        ("Tempo (s)", "Posição desejada [mm]", "Posição [mm]", "Tensão"),
        ("Tiempo", "Posición de referencia [mm]", "Posicio\u0301n medida [mm]", "Tensión del motor"),
    ],
    ids=["French", "French compounds", "Italian", "Italian compounds", "Spanish", "Portuguese", "Spanish compounds"],
)
def test_headings_in_french_italian_and_spanish_are_read(tmp_path, heads):
    reading = read_log(log(tmp_path, heads, T, 1e3 * R, 1e3 * Y, U))
    check(reading.record)
    assert evidence(reading, "time").value == "s"


@pytest.mark.parametrize(
    ("name", "roles"),
    [
        *(
            (name, ())
            for name in ("tension", "Belt tension [V]", "tension [N]", "Tension d'alimentation", "velocity error")
        ),
        *((name, ()) for name in ("Temps de cycle", "Tempo di ciclo", "consigne de vitesse", "écart [mm]")),
        *((name, ("velocity",)) for name in ("Tempo [mm/s]", "Velocità", "vitesse")),
        ("Tempo", ("time", "velocity")),
        *((name, ("time",)) for name in ("tempo [ms]", "temps_ms")),
        *((name, ("voltage",)) for name in ("tension [V]", "tensione", "Courant moteur")),
    ],
)
def test_a_word_of_several_languages_is_what_its_unit_and_its_neighbours_say(name, roles):
    assert meaning(name).roles == roles


def test_an_english_tension_is_no_command(tmp_path):
    heads = ("time [s]", "position [mm]", "setpoint [mm]", "tension")
    with pytest.raises(InputError, match="the gains are unknown and no column is known as the command"):
        read_log(log(tmp_path, heads, T, 1e3 * Y, 1e3 * R, 5 + Y))


@pytest.mark.parametrize(
    ("heading", "name", "unit"),
    [
        ("Position (Millimeter)", "Position", "mm"),
        ("Position (millimètres)", "Position", "mm"),
        ("Position [MM]", "Position", "mm"),
        ("Weg (in mm)", "Weg", "mm"),
        ("Position [mm] filtered", "Position filtered", "mm"),
        ("Position (M)", "Position", "M"),
        ("x[in] meas", "x[in] meas", None),
        ("x [in] meas", "x [in] meas", None),
        ("pos [min] y", "pos [min] y", None),
        ("pos[mm] y", "pos[mm] y", None),
        ("x [rpm] filtered", "x [rpm] filtered", None),
        ("Zeit (Millisekunden)", "Zeit", "ms"),
        ("Time [mS]", "Time", "ms"),
        ("Zeit [Sek.]", "Zeit", "s"),
        ("Time [HH:MM:SS.fff]", "Time", None),
        ("y[10] x", "y[10] x", None),
        ("Supply [MV]", "Supply", "MV"),
    ],
)
def test_units_are_read_as_people_write_them(heading, name, unit):
    assert unit_behind(heading)[:2] == (name, unit)


def test_a_unit_in_words_is_no_metre(tmp_path):
    heads = ("t", "Weg in Millimetern", "Sollweg in Millimetern", "u")
    check(read_log(log(tmp_path, heads, T, 1e3 * Y, 1e3 * R, U)).record)


# ---- an error in the place of the reference


@pytest.mark.parametrize("name", ["error", "e [m]", "Schleppfehler", "Schleppabstand", "following error", "lag error"])
@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["reference less position", "position less reference"])
def test_a_logged_error_makes_the_reference(tmp_path, name, sign):
    reading = read_log(log(tmp_path, ("time [s]", name, "position [m]", "voltage [V]"), T, sign * (R - Y), Y, U))
    check(reading.record)
    made = evidence(reading, "reference")
    assert made.source.startswith("position + " if sign > 0 else "position - ")
    assert made.evidence.startswith("no reference is logged; error and speed ")
    assert not made.is_stated
    assert (reading.record.controller.kp, reading.record.controller.kd) == pytest.approx((60, 4), rel=1e-2)


def test_an_error_in_another_unit_is_converted_and_the_campaign_reads_the_same(tmp_path):
    path = log(tmp_path, ("time [s]", "e [mm]", "position [cm]", "voltage [V]"), T, 1e3 * (R - Y), 1e2 * Y, U)
    check(read_log(path).record)
    write_campaign(read_logs([path]), tmp_path / "axis.toml")
    check(read_records(tmp_path / "axis.toml")[0])


@pytest.mark.parametrize(
    ("heads", "factors"),
    [
        (("t", "error", "pos [mm]", "u"), (1.0, 1e3)),
        (("t", "error", "pos [mm]", "u"), (1e3, 1e3)),
        (("t", "error", "pos", "u"), (1.0, 1.0)),
        (("t", "e [mm]", "pos", "u"), (1e3, 1.0)),
        (("t", "error", "angle [deg]", "u"), (1.0, 180 / np.pi)),
        (("t", "error", "angle [deg]", "u"), (180 / np.pi, 180 / np.pi)),
    ],
)
@pytest.mark.parametrize("scale", [1.0, 0.005], ids=["large", "small"])
@pytest.mark.parametrize("digits", [9, 4], ids=["noise", "rounded"])
def test_the_unit_of_an_error_is_the_one_in_which_the_position_s_noise_cancels(tmp_path, heads, factors, scale, digits):
    y, r = np.round(scale * Y, digits), scale * R
    path = log(tmp_path, heads, T, factors[0] * (r - y), factors[1] * y, U)
    record = read_log(path).record
    assert record.reference == pytest.approx(r, abs=1e-6)
    write_campaign(read_logs([path]), tmp_path / "axis.toml")
    assert read_records(tmp_path / "axis.toml")[0].reference == pytest.approx(r, abs=1e-6)


@pytest.mark.parametrize("heads", [("t", "error", "pos [m]", "u"), ("t", "error", "pos", "u")])
@pytest.mark.parametrize("factor", [1e3, 100.0, 57.3, 2.0, 1.4, 0.5, 0.01])
def test_an_error_in_an_unknown_unit_makes_no_reference(tmp_path, heads, factor):
    record = read_log(log(tmp_path, heads, T, factor * (R - Y), Y, U)).record
    assert record.reference is None
    (remark,) = (one for one in record.remarks if one.code == "error_not_used")
    assert "add up to more noise than a reference has" in remark.message


@pytest.mark.parametrize(
    ("own", "of_error", "of_position", "unit"),
    [
        ("mm", 5.0, 5.0, "mm"),
        ("mm", 5e3, 5e3, "mm"),
        ("m", 1.0, 1e3, "mm"),
        ("deg", 90.0, 90.0, "deg"),
        ("rad", 1.0, 180 / np.pi, "deg"),
    ],
)
@pytest.mark.parametrize("sign", [1, -1])
def test_a_position_s_unit_is_the_one_in_which_its_noise_is_that_of_an_error(
    tmp_path, own, of_error, of_position, unit, sign
):
    path = log(tmp_path, ("t", f"e [{own}]", "pos", "u"), T, sign * of_error * (R - Y), of_position * Y, U)
    reading = read_log(path)
    assert evidence(reading, "position").value == unit
    assert evidence(reading, "position").evidence == f"the word 'pos'; its noise is that of 'e' [{own}]"
    factor = of_error * {"mm": 1e-3, "deg": np.pi / 180}.get(own, 1.0)
    assert reading.record.reference == pytest.approx(factor * R, abs=1e-6 * max(factor, 1))


@pytest.mark.parametrize("counts", [1e5, 1e4])
def test_an_error_in_whole_numbers_is_asked_what_one_is(tmp_path, counts):
    path = log(tmp_path, ("t", "error", "pos_mm", "u"), T, np.round(counts * (R - Y)), 1e3 * Y, U)
    (remark,) = (one for one in read_log(path).record.remarks if one.code == "error_not_used")
    assert remark.message == (
        "no reference was made of the column 'error': it holds whole numbers and states no unit: say what one is, e.g."
        " --unit 'reference=0.01 mm'. If it is reference less position, log the reference."
    )


def test_an_error_in_whole_numbers_makes_the_reference_in_the_unit_that_is_stated(tmp_path):
    path = log(tmp_path, ("t", "error", "pos_mm", "u"), T, np.round(1e7 * (R - Y)), 1e3 * Y, U)
    reading = read_log(path, units={"reference": "0.0001 mm"})
    assert reading.record.reference == pytest.approx(R, abs=2e-6)


def test_a_record_file_whose_position_an_error_fits_in_its_unit_alone_is_told_to_state_it(tmp_path):
    heads = ("time", "e [mm]", "position", "voltage")
    path = log(tmp_path, heads, T, 5 * (R - Y), 5 * Y, U)
    (remark,) = (one for one in read_log(path).record.remarks if one.code == "error_not_used")
    assert "say --unit position=mm" in remark.message
    assert read_log(path, units={"position": "mm"}).record.reference == pytest.approx(0.005 * R, abs=1e-6)


def test_the_unit_that_is_given_for_a_made_reference_stays_in_the_campaign(tmp_path):
    path = log(tmp_path, ("t", "error", "pos [cm]", "u"), T, 1e3 * (R - Y), 1e2 * Y, U)
    logs = read_logs([path], units={"reference": "mm"})
    check(logs[0].reading.record)
    write_campaign(logs, tmp_path / "axis.toml")
    check(read_records(tmp_path / "axis.toml")[0])


@pytest.mark.parametrize("kind", ["noise", "of the speed", "flag"])
def test_an_error_that_is_another_one_makes_no_reference(tmp_path, kind):
    other = {
        "noise": 1e-3 * np.random.default_rng(1).standard_normal(T.size),
        "of the speed": np.gradient(R - Y, T),
        "flag": (np.abs(R - Y) > 0.02) * 1.0,
    }[kind]
    heads = ("time [s]", "error", "position [m]", "voltage [V]")
    record = read_log(log(tmp_path, heads, T, other, Y, U)).record
    assert record.reference is None
    assert ("error_not_used" in [remark.code for remark in record.remarks]) == (kind != "flag")


def test_an_error_that_does_not_go_with_the_motion_makes_no_reference(tmp_path):
    still = 1e-3 * np.random.default_rng(1).standard_normal(T.size)
    heads = ("time [s]", "error [m]", "position [m]", "voltage [V]")
    reading = read_log(log(tmp_path, heads, T, still, Y, U))
    assert reading.record.reference is None
    assert [remark.code for remark in reading.record.remarks] == ["error_not_used"]
    sentence = "no reference could be made of 'error': it does not go with the motion; .* --column reference=-"
    with pytest.raises(InputError, match=sentence):
        read_log(log(tmp_path, heads[:3], T, still, Y), settings={"kp": "60 V/m", "kd": "4 V s/m"})


def test_a_stated_reference_goes_before_an_error(tmp_path):
    path = log(tmp_path, ("time [s]", "error [m]", "position [m]", "voltage [V]"), T, R - Y, Y, U)
    assert np.ptp(read_log(path, settings={"reference": "0.1"}).record.reference) == 0
    assert read_log(path, columns={"reference": "-"}).record.reference is None


@pytest.mark.parametrize(
    "heads",
    [("time", "tempo", "riferimento", "posizione", "tensione"), ("tempo", "vel", "ref", "pos", "u")],
)
def test_of_a_tempo_the_numbers_tell_whether_it_is_a_time_or_a_speed(tmp_path, heads):
    speed = np.gradient(Y, T)
    reading = read_log(log(tmp_path, heads, T, speed, R, Y, U))
    check(reading.record)
    assert (reading.columns["time"], reading.columns["velocity"]) == heads[:2]
    assert reading.record.velocity == pytest.approx(speed, abs=1e-4)


def test_the_time_of_a_scan_does_not_stand_for_the_tempo(tmp_path):
    heads = ("tempo", "tempo scansione [ms]", "riferimento", "posizione", "tensione")
    assert read_log(log(tmp_path, heads, T, np.ones(T.size), R, Y, U)).columns["time"] == "tempo"


def test_a_slow_log_of_more_than_a_day_is_no_fast_one(tmp_path):
    """Of a clock in ms since 1970, 25 hours at 1 Hz were read at 1 kHz."""
    path = tmp_path / "day.csv"
    lines = (
        f"{1_700_000_000_000 + 1000 * k},{0.1 * np.sin(0.01 * k):.6f},{np.cos(0.01 * k):.6f}" for k in range(90_000)
    )
    path.write_text("\n".join(("timestamp,position,voltage", *lines)))
    with pytest.raises(InputError, match=r"plausible in ms \(1 Hz\) and in us \(1 kHz\)"):
        read_log(path)


def test_a_tempo_that_falls_back_is_no_time(tmp_path):
    path = log(tmp_path, ("tempo", "riferimento", "pos", "u"), np.gradient(Y, T), R, Y, U)
    with pytest.raises(InputError, match="no column named time; the columns are 'tempo, riferimento, pos, u'"):
        read_log(path)
    assert read_log(path, settings={"sample_time": "1 ms"}).columns["velocity"] == "tempo"


# ---- clocks of computers


@pytest.mark.parametrize(
    ("start", "ticks", "unit"),
    [
        (132_500_000_000_000_000, 1e7, "100 ns"),
        (638_000_000_000_000_000, 1e7, "100 ns"),
        (1_700_000_000_000_000_000, 1e9, "ns"),
        (1_700_000_000_000_000, 1e6, "us"),
        (1_700_000_000_000, 1e3, "ms"),
    ],
    ids=["FILETIME", "NET", "nanoseconds", "microseconds", "milliseconds"],
)
@pytest.mark.parametrize("form", ["{}", "{:.17e}"], ids=["whole", "float"])
@pytest.mark.parametrize("name", ["timestamp", "time"])
def test_stamps_of_computers_are_told_by_their_date(tmp_path, start, ticks, unit, form, name):
    cells = [form.format(start + round(t * ticks)) for t in T]
    reading = read_log(log(tmp_path, (name, "position [m]", "reference [m]", "voltage [V]"), cells, Y, R, U))
    assert evidence(reading, "time").value == unit
    assert np.diff(reading.record.time) == pytest.approx(np.diff(T), rel=1e-5)


def test_stamps_that_are_not_even_stay_as_they_are(tmp_path):
    late = np.round(1e9 * T) + np.where(np.arange(T.size) % 7 == 3, 200_000, 0)
    cells = [str(1_700_000_000_000_000_000 + int(x)) for x in late]
    record = read_log(log(tmp_path, ("stamp", "position [m]", "reference [m]", "voltage [V]"), cells, Y, R, U)).record
    assert record.time == pytest.approx(1e-9 * late, abs=0.3e-6)


@pytest.mark.parametrize(
    ("start", "step", "unit", "seconds"),
    [
        (1_200_000_000_000, 1_000_000, "ns", 1e-3),
        (1_200_000_000, 4000, "us", 4e-3),
        (1_600_000_000_000, 20, "ms", 0.02),
        (1_700_000_000_000_000_000, 50_000_000, "ns", 0.05),
        (1_700_000_000_000_000_000, 200_000_000, "ns", 0.2),
        (132_500_000_000_000_000, 500_000, "100 ns", 0.05),
    ],
)
def test_a_time_since_switching_on_of_which_a_date_would_make_weeks_is_no_date(tmp_path, start, step, unit, seconds):
    cells = [str(start + step * k) for k in range(T.size)]
    reading = read_log(log(tmp_path, ("timestamp", "position [m]", "reference [m]", "voltage [V]"), cells, Y, R, U))
    assert evidence(reading, "time").value == unit
    assert np.diff(reading.record.time) == pytest.approx(seconds, rel=1e-3)


@pytest.mark.parametrize(
    ("start", "step", "first", "second"),
    [
        (1_600_000_000_000, 50, "ms (20 Hz)", "us (20 kHz)"),
        (1_600_000_000_000_000, 50_000, "us (20 Hz)", "ns (20 kHz)"),
        (1_200_000_000_000, 500, "ms (2 Hz)", "us (2 kHz)"),
        (1_700_000_000_000, 1000, "ms (1 Hz)", "us (1 kHz)"),
        (1_200_000_000_000_000, 125_000, "us (8 Hz)", "ns (8 kHz)"),
        (1_700_000_000, 1, "s (1 Hz)", "ms (1 kHz)"),
    ],
)
@pytest.mark.parametrize("name", ["timestamp", "time"])
def test_a_time_that_is_a_date_or_a_time_since_switching_on_is_a_question(tmp_path, name, start, step, first, second):
    cells = [str(start + step * k) for k in range(T.size)]
    path = log(tmp_path, (name, "position [m]", "reference [m]", "voltage [V]"), cells, Y, R, U)
    units = [reading.partition(" ")[0] for reading in (first, second)]
    with pytest.raises(InputError) as refused:
        read_log(path)
    assert f"has steps of {step}, which are plausible in {first} and in {second}; say" in str(refused.value)
    assert str(refused.value).endswith(" or ".join(f"--unit time={unit}" for unit in units))


# ---- small units


@pytest.mark.parametrize("scale", [50.0, 30.0])
def test_a_position_too_fast_for_metres_is_a_question(tmp_path, scale):
    path = log(tmp_path, ("t", "pos", "ref", "u"), T, scale * Y + 0.01, scale * R + 0.01, U)
    with pytest.raises(InputError, match=r"at up to .* per second, and states no unit: mm, deg and rad are plausible"):
        read_log(path)
    record = read_log(path, units={"position": "mm"}).record
    assert np.ptp(record.reference) == pytest.approx(1e-3 * scale * np.ptp(R))


def test_a_record_file_too_fast_for_metres_is_read_with_a_warning(tmp_path):
    path = log(tmp_path, ("time", "position", "reference", "voltage"), T, 50 * Y, 50 * R, U)
    (warning,) = (one for one in read_log(path).record.remarks if one.code == "length_unit_assumed")
    assert "at up to" in warning.message


def test_spikes_make_no_speed(tmp_path):
    spiked = Y.copy()
    spiked[100:400:50] += 0.2
    record = read_log(log(tmp_path, ("t", "pos", "ref", "u"), T, spiked, R, U)).record
    assert np.max(record.position) == pytest.approx(np.max(spiked), abs=1e-6)


def test_an_axis_that_is_homed_makes_no_speed(tmp_path):
    homed = Y - np.where(np.arange(Y.size) > 300, 0.6, 0.0)
    record = read_log(log(tmp_path, ("t", "pos", "ref", "u"), T, homed, R, U)).record
    assert np.ptp(record.position) == pytest.approx(np.ptp(homed), abs=1e-6)


def test_temps_beside_a_time_are_temperatures(tmp_path):
    warm = 20.0 + np.sqrt(1.0 + T)
    reading = read_log(log(tmp_path, ("timestamp", "pos", "ref", "volt", "temps"), T, Y, R, U, warm))
    assert reading.record.time == pytest.approx(T, abs=1e-5)


# ---- a reference without a unit beside a position with one


@pytest.mark.parametrize(("unit", "scale"), [("mm", 1e3), ("rev", 2.0), ("deg", 500.0)])
def test_a_named_reference_is_in_the_unit_of_its_position(tmp_path, unit, scale):
    heads = ("time", f"position [{unit}]", "cmd1", "voltage")
    record = read_log(log(tmp_path, heads, T, scale * Y, scale * R, U), columns={"reference": "cmd1"}).record
    assert np.ptp(record.reference) / np.ptp(record.position) == pytest.approx(np.ptp(R) / np.ptp(Y), rel=1e-3)


@pytest.mark.parametrize(("unit", "si"), [("mm", "m"), ("rev", "rad")])
def test_a_record_file_s_reference_that_travels_as_its_position_s_unit_is_a_question(tmp_path, unit, si):
    path = log(tmp_path, ("time", f"position [{unit}]", "reference", "voltage"), T, 9 * Y, 9 * R, U)
    with pytest.raises(InputError, match=f"say --unit reference={unit} or --unit reference={si}$"):
        read_log(path)
    assert np.ptp(read_log(path, units={"reference": unit}).record.reference) > 0


def test_a_record_file_s_reference_in_si_beside_millimetres_is_none(tmp_path):
    path = log(tmp_path, ("time", "position [mm]", "reference", "voltage"), T, 1e3 * Y, R, U)
    check(read_log(path).record)
