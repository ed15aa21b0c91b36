"""Fleets: which axes a folder holds, what is studied again, tables, pages, drift and unusual values."""

from __future__ import annotations

import copy
import csv
import dataclasses
import io
import json
import os
import re
import signal
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
from fleet_axes import children, results, studied, write_record
from scipy import stats

from servolens.errors import InputError
from servolens.fleet import (
    Axis,
    Fleet,
    Request,
    columns_of,
    find_axes,
    local_executor,
    row_of,
    run_fleet,
    table_file,
    to_csv,
    trend,
)
from servolens.fleet import axis_study as studying
from servolens.fleet.axes import inputs_digest
from servolens.fleet.pages import write_pages
from servolens.results import to_text

QUICK = Request(effort="quick", spec={"settling_time": 0.5})


def names(axes):
    return [(axis.name, axis.measured, axis.path.name) for axis in axes]


def make_unreadable(folder, *axes):
    """Write axes that are refused in an instant."""
    for name in axes:
        (folder / name).mkdir(parents=True)
        (folder / name / "log.csv").write_text("no numbers here\n", encoding="utf-8")
    return folder


# Axes of a folder


def test_sub_folders_and_campaigns_are_axes_and_other_files_are_not(tmp_path):
    for name in ("b", "a", ".hidden"):
        (tmp_path / name).mkdir()
    (tmp_path / "c.toml").write_text("[[records]]\nfile = 'x.csv'\n", encoding="utf-8")
    (tmp_path / "notes.txt").write_text("", encoding="utf-8")
    assert names(find_axes(tmp_path)) == [("a", "", "a"), ("b", "", "b"), ("c", "", "c.toml")]


@pytest.mark.parametrize(
    ("entry", "name", "measured"),
    [
        ("feed_2026-05-01", "feed", "2026-05-01"),
        ("feed 20260501", "feed", "2026-05-01"),
        ("feed@2026-05-01T13-45", "feed", "2026-05-01T13:45:00"),
        ("2026-05-01_feed", "2026-05-01_feed", ""),
        ("part 20269999", "part 20269999", ""),
        ("feed-7", "feed-7", ""),
    ],
)
def test_date_at_the_end_of_a_name_is_when_the_axis_was_measured(tmp_path, entry, name, measured):
    (tmp_path / entry).mkdir()
    assert names(find_axes(tmp_path)) == [(name, measured, entry)]


def test_dated_sub_folders_are_measurements_of_one_axis(tmp_path):
    for when in ("2026-05-02", "2026-05-01"):
        (tmp_path / "lift" / when).mkdir(parents=True)
    (tmp_path / "lift" / "2026-05-03.toml").write_text("", encoding="utf-8")
    assert [(axis.name, axis.measured) for axis in find_axes(tmp_path)] == [
        ("lift", "2026-05-01"),
        ("lift", "2026-05-02"),
        ("lift", "2026-05-03"),
    ]


def test_folder_that_a_campaign_beside_it_takes_its_files_from_is_no_axis_of_its_own(tmp_path):
    (tmp_path / "feed").mkdir()
    (tmp_path / "feed.toml").write_text("[[records]]\nfile = 'feed/kp60.csv'\n", encoding="utf-8")
    assert names(find_axes(tmp_path)) == [("feed", "", "feed.toml")]


def test_folder_of_results_is_no_axis(tmp_path):
    make_unreadable(tmp_path, "feed")
    run_fleet(tmp_path, tmp_path / "out", QUICK, cores=1)
    assert names(find_axes(tmp_path)) == [("feed", "", "feed")]


def test_two_axes_of_one_name_are_refused(tmp_path):
    (tmp_path / "feed").mkdir()
    (tmp_path / "feed.toml").write_text("[[records]]\nfile = 'other.csv'\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"feed and feed\.toml are both axis feed; rename one"):
        find_axes(tmp_path)


@pytest.mark.parametrize("folder", ["empty", "missing"])
def test_folder_without_an_axis_is_refused(tmp_path, folder):
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"holds no axis; give each a sub-folder|cannot be listed: no such file"):
        find_axes(tmp_path / folder)


def test_key_of_an_axis_is_a_safe_and_unique_file_name():
    odd = ["..", "a/b", "a b", "=1+1", "<b>", "x" * 500, "x" * 499 + "y", "Ü", "a\nb", ".x"]
    keys = [Axis(name=name, measured="", path=Path("x")).key for name in odd]
    assert all(re.fullmatch(r"[A-Za-z0-9%_~-][A-Za-z0-9%_.~@-]{0,119}", key) for key in keys), keys
    assert len(set(keys)) == len(keys)
    assert unquote(keys[0]) == ".."


# What is studied, and what is studied again


def test_axis_that_cannot_be_studied_is_a_row_with_its_sentence_and_others_go_on(tmp_path):
    axes = make_unreadable(tmp_path / "axes", "a", "b")
    (axes / "c").mkdir()
    found = run_fleet(axes, tmp_path / "out", QUICK, cores=2)
    assert [(row["axis"], row["status"]) for row in found.rows] == [
        ("a", "refused"),
        ("b", "refused"),
        ("c", "refused"),
    ]
    assert found.rows[2]["sentence"].endswith("c: is a folder without logs such as .csv, .mat or .xlsx.")
    assert found.studied_now == 3
    assert len(found.failed) == 3


def test_finished_axes_are_not_studied_again(tmp_path):
    axes = make_unreadable(tmp_path / "axes", "a", "b")
    run_fleet(axes, tmp_path / "out", QUICK, cores=1)
    before = {path: path.read_bytes() for path in (tmp_path / "out" / "results").iterdir()}
    assert run_fleet(axes, tmp_path / "out", QUICK, cores=1).studied_now == 0
    assert {path: path.read_bytes() for path in (tmp_path / "out" / "results").iterdir()} == before
    assert studied(tmp_path / "out") == ["a", "b"]


def test_refused_axes_are_not_refused_anew_where_the_folder_is_named_otherwise(tmp_path, monkeypatch):
    axes = make_unreadable(tmp_path / "axes", "a")
    (axes / "empty").mkdir()
    (axes / "lost.toml").write_text("[[records]]\nfile = 'none.csv'\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert run_fleet("axes", "out", QUICK, cores=1).studied_now == 3
    assert run_fleet("axes", "out", QUICK, cores=1).studied_now == 0
    assert run_fleet(axes, tmp_path / "out", QUICK, cores=1).studied_now == 0
    (axes / "empty" / "note.txt").write_text("later", encoding="utf-8")
    (axes / "lost.toml").write_text("[[records]]\nfile = 'other.csv'\n", encoding="utf-8")
    assert run_fleet("axes", "out", QUICK, cores=1).studied_now == 2


def test_half_written_results_and_those_of_other_files_or_requests_are_made_again(tmp_path):
    axes, out = make_unreadable(tmp_path / "axes", "a", "b"), tmp_path / "out"
    run_fleet(axes, out, QUICK, cores=1)
    whole = results(out)
    path = out / "results" / "a.json"
    path.write_bytes(path.read_bytes()[:-40])
    (out / "results" / ".b.json.1234.part").write_text("{", encoding="utf-8")
    assert run_fleet(axes, out, QUICK, cores=1).studied_now == 1
    assert results(out) == whole
    assert not list((out / "results").glob(".*"))
    (axes / "b" / "log.csv").write_text("other words\n", encoding="utf-8")
    assert run_fleet(axes, out, QUICK, cores=1).studied_now == 1
    assert run_fleet(axes, out, Request(effort="normal"), cores=1).studied_now == 2
    assert run_fleet(axes, out, Request(effort="normal"), cores=1, retry=True).studied_now == 2


LIGHTS = {part: {"light": "green", "sentence": "s"} for part in ("data", "model", "gain")}


@pytest.mark.parametrize(
    "change",
    [
        {"status": "well"},
        {"tuning": 3},
        {"tuning": {"diagnosis": [1]}},
        {"tuning": {**LIGHTS, "kp": 100, "kd": 10**400, "reason": None, "recommended": None}},
        {"findings": [1]},
        {"axis": "b"},
        {"records": None},
    ],
    ids=lambda change: str(change)[:60],
)
def test_result_that_somebody_changed_is_made_again(tmp_path, change):
    axes, out = make_unreadable(tmp_path / "axes", "a"), tmp_path / "out"
    run_fleet(axes, out, QUICK, cores=1)
    whole, path = results(out), out / "results" / "a.json"
    path.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8")) | change), encoding="utf-8")
    assert run_fleet(axes, out, QUICK, cores=1).studied_now == 1
    assert results(out) == whole


def test_limits_alone_are_no_reason_to_study_a_finished_axis_again(tmp_path):
    axes = make_unreadable(tmp_path / "axes", "a")
    run_fleet(axes, tmp_path / "out", QUICK, cores=1)
    assert run_fleet(axes, tmp_path / "out", dataclasses.replace(QUICK, time_limit=7.0), cores=1).studied_now == 0


def test_digest_of_the_inputs_follows_the_campaign_and_every_file_that_it_names(tmp_path):
    write_record(tmp_path / "a" / "kp60.csv")
    toml = tmp_path / "a" / "campaign.toml"
    toml.write_text("[[records]]\nfile = 'kp60.csv'\n", encoding="utf-8")
    digests = {inputs_digest(tmp_path / "a", None)}
    (tmp_path / "a" / "notes.txt").write_text("of no account", encoding="utf-8")
    assert {inputs_digest(tmp_path / "a", None)} == digests
    toml.write_text("[[records]]\nfile = 'kp60.csv'\nkp = 60\n", encoding="utf-8")
    digests.add(inputs_digest(tmp_path / "a", None))
    write_record(tmp_path / "a" / "kp60.csv", seed=2)
    digests.add(inputs_digest(tmp_path / "a", None))
    assert len(digests) == 3


def test_axis_outside_the_folder_is_not_read_unless_a_data_root_holds_it(tmp_path):
    write_record(tmp_path / "elsewhere" / "secret.csv")
    (tmp_path / "axes").mkdir()
    (tmp_path / "axes" / "link").symlink_to(tmp_path / "elsewhere")
    (row,) = run_fleet(tmp_path / "axes", tmp_path / "out", QUICK, cores=1).rows
    assert row["status"] == "refused"
    assert row["sentence"].startswith("the axis lies outside the folder of the fleet; name a data root")
    allowed = dataclasses.replace(QUICK, data_root=str(tmp_path))
    (row,) = run_fleet(tmp_path / "axes", tmp_path / "out", allowed, cores=1).rows
    assert row["status"] == "done"


def test_any_executor_gives_the_same_results(tmp_path):
    axes = make_unreadable(tmp_path / "axes", "a", "b")
    with ThreadPoolExecutor(2) as threads, ProcessPoolExecutor(1) as processes:
        run_fleet(axes, tmp_path / "threads", QUICK, executor=threads)
        run_fleet(axes, tmp_path / "processes", QUICK, executor=processes)
        assert threads.submit(int, "7").result() == processes.submit(int, "7").result() == 7
    assert results(tmp_path / "threads") == results(tmp_path / "processes")


def test_executor_that_breaks_ends_the_run_with_a_sentence(tmp_path):
    axes = make_unreadable(tmp_path / "axes", "a", "b")
    with ProcessPoolExecutor(1) as pool:
        os.kill(pool.submit(os.getpid).result(), signal.SIGKILL)
        with pytest.raises(InputError, match=r"takes no more work \(BrokenProcessPool: .*; 0 of 2 axes are finished"):
            run_fleet(axes, tmp_path / "out", QUICK, executor=pool)
    assert run_fleet(axes, tmp_path / "out", QUICK, cores=1).studied_now == 2


def test_no_process_is_left_behind(tmp_path):
    script = (
        "import os, sys; sys.path[:0] = sys.argv[3:]; from fleet_axes import children;"
        "from servolens.fleet import run_fleet; run_fleet(sys.argv[1], sys.argv[2]); print(children(os.getpid()))"
    )
    axes = make_unreadable(tmp_path / "axes", "a", "b")
    arguments = [str(axes), str(tmp_path / "out"), str(Path(__file__).parent)]
    done = subprocess.run([sys.executable, "-c", script, *arguments], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
    assert children(os.getpid()) == []


def test_progress_tells_count_failures_rate_and_time_left(tmp_path):
    told = []
    axes = make_unreadable(tmp_path / "axes", *(f"a{i}" for i in range(4)))
    run_fleet(axes, tmp_path / "out", QUICK, cores=1, progress=lambda *one: told.append(one))
    assert ("0 of 4 axes", 0, 4) in told
    texts = [what for what, _, _ in told]
    assert any(re.fullmatch(r"[123] of 4 axes, [123] failed, [\d.e+]+ a minute, \d+ s left", text) for text in texts), (
        texts
    )


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"effort": "lazy"}, "effort is 'lazy'; it must be one of quick, normal, thorough"),
        ({"time_limit": 0}, "time_limit must be a positive number, got 0"),
        ({"memory_limit": float("nan")}, "memory_limit must be a positive number, got nan"),
        ({"spec": {"kp": 3}}, "kp needs a settling time; give settling_time too"),
    ],
)
def test_request_that_cannot_be_is_refused(wrong, sentence):
    with pytest.raises(InputError, match=re.escape(sentence)):
        Request(**wrong)


def test_cores_and_places_that_cannot_be_are_refused(tmp_path):
    with pytest.raises(InputError, match="cores must be 1 or more, got 0"), local_executor(0):
        pass
    with pytest.raises(InputError, match="the results cannot go to the folder of the axes"):
        run_fleet(make_unreadable(tmp_path / "axes", "a"), tmp_path / "axes")


# Rows, tables and pages


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """A real result: an axis with a cause, studied in this process."""
    folder = tmp_path_factory.mktemp("one")
    for kp in (60, 80):
        write_record(folder / "feed" / f"kp{kp}.csv", kp=kp, seed=kp)
    job = {"name": "feed", "measured": "", "path": str(folder / "feed"), "folder": str(folder)}
    return studying.studied({**job, "request": QUICK.to_json()})


def test_row_holds_lights_causes_gain_and_parameters_with_errors_and_units(result):
    row = row_of(result)
    assert (row["status"], row["verdict"], row["causes"]) == ("done", "explained", "velocity_decay_damping")
    assert row["gain"] == pytest.approx(1.9166, rel=0.002)
    assert row["gain:unit"] == "m/s^2/V"
    assert 0 < row["velocity_decay_damping.alpha1:stderr"] < 1
    assert row["recommended_kd"] == result["tuning"]["recommended"]["kd"]
    assert [row[f"{name}_light"] for name in ("data", "model")] == ["green", "green"]


def test_parquet_and_csv_hold_the_same_rows(result):
    parquet = pytest.importorskip("pyarrow.parquet")
    refused = studying.stopped(
        {"name": "b", "measured": "", "path": "/nowhere", "request": QUICK.to_json()}, "It takes too long"
    )
    rows = [row_of(result), row_of(refused)]
    name, content = table_file(rows)
    assert name == "summary.parquet"
    table = parquet.read_table(io.BytesIO(content))
    assert tuple(table.column_names) == columns_of(rows)
    assert table.to_pylist() == [{column: row.get(column) for column in columns_of(rows)} for row in rows]
    plain, text = table_file(rows, plain=True)
    assert plain == "summary.csv"
    read = list(csv.DictReader(io.StringIO(text.decode())))
    assert float(read[0]["gain"]) == rows[0]["gain"]
    assert (read[1]["sentence"], read[1]["gain"]) == ("It takes too long.", "")


@pytest.mark.parametrize("text", ["=1+1", "+1", "-1", "@SUM(A1)", "\t1", "\t=1", "\r=1", " =1", "＝1"])
def test_csv_holds_no_formula(result, text):
    row = {**row_of(result), "axis": text, "sentence": text, text: 1.0}
    cells = [cell for line in csv.reader(io.StringIO(to_csv([row]).decode(), newline="")) for cell in line]
    texts = [cell for cell in cells if not re.fullmatch(r"-?[\d.]+(e-?\d+)?", cell)]
    shown = text.replace("\t", r"\t").replace("\r", r"\r")
    assert sum(cell in (shown, f"'{shown}") for cell in texts) == 3
    assert not [cell for cell in texts if cell.lstrip().startswith(("=", "+", "-", "@", "＝"))]


class Page(HTMLParser):
    """What a browser would make of a page: its tags, links and text."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.links, self.attributes, self.text = [], [], set(), ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes |= {name for name, _ in attrs}
        self.links += [value for name, value in attrs if name in ("href", "src") and not value.startswith("#")]

    def handle_data(self, data):
        self.text += data


def fleet_of(folder, *made):
    """Write results as a run does, and return them as a fleet."""
    (folder / "results").mkdir(parents=True)
    (folder / "axes").mkdir()
    axes = [Axis(name=one["axis"], measured=one["measured"] or "", path=folder) for one in made]
    for axis, one in zip(axes, made, strict=True):
        (folder / "results" / f"{axis.key}.json").write_text(to_text(one), encoding="utf-8")
    return Fleet(folder=folder, out=folder, axes=tuple(axes), rows=tuple(map(row_of, made)), studied_now=len(made))


def varied(result, axis, measured=None, *, damping=None, error=None):
    """Return the result as if it were another axis's, measured at another time."""
    other = copy.deepcopy(result) | {"axis": axis, "measured": measured}
    quantity = other["tuning"]["diagnosis"]["model"]["damping"]
    quantity |= {"value": damping or quantity["value"], "stderr": error or quantity["stderr"]}
    return other


def test_page_links_every_axis_and_every_link_leads_somewhere(result, tmp_path):
    fleet = fleet_of(
        tmp_path, varied(result, "feed", "2026-05-01"), varied(result, "feed"), varied(result, "50 % /Ü#?")
    )
    page = Page(write_pages(fleet).read_text(encoding="utf-8"))
    assert sorted(Path(unquote(link)).name for link in page.links) == sorted(f"{axis.key}.html" for axis in fleet.axes)
    assert all((tmp_path / unquote(link)).is_file() for link in page.links)
    for link in page.links:
        for inner in Page((tmp_path / unquote(link)).read_text(encoding="utf-8")).links:
            assert (tmp_path / "axes" / unquote(inner)).is_file(), inner
    assert "link" not in page.tags
    assert page.text.count("damping that falls with speed") >= 3


def test_page_shows_names_and_messages_as_text_whatever_they_hold(result, tmp_path):
    attack = "<script>alert(1)</script><img src=x onerror=alert(1)>\"'&{{7919*6271}}"
    bad = varied(result, attack, None)
    bad["findings"] = [{"code": "x", "severity": "note", "message": attack, "record": attack}]
    bad["records"], bad["tuning"]["reason"] = [attack], attack
    refused = {**varied(result, f"b{attack}"), "status": "refused", "sentence": attack, "tuning": None}
    fleet = fleet_of(tmp_path, bad, refused)
    pages = [write_pages(fleet), *(tmp_path / "axes").iterdir()]
    for path in pages:
        page = Page(path.read_text(encoding="utf-8"))
        assert page.tags.count("script") == (path.name == "fleet.html")
        assert "img" not in page.tags
        assert not {name for name in page.attributes if name.startswith("on")}
        assert "onerror=alert(1)" in page.text
        assert "{{7919*6271}}" in page.text
        assert str(7919 * 6271) not in page.text


def test_page_of_many_dates_tells_the_drift_and_the_unusual_axis(result, tmp_path):
    rng = np.random.default_rng(5)
    worn = [
        varied(result, "worn", f"2026-0{1 + i}-01", damping=6.0 + 0.3 * i + 0.02 * rng.normal(), error=0.02)
        for i in range(8)
    ]
    well = [
        varied(result, "well", f"2026-0{1 + i}-01", damping=6.0 + 0.02 * rng.normal(), error=0.02) for i in range(8)
    ]
    odd = [varied(result, "odd", damping=60.0)]
    fleet = fleet_of(tmp_path, *worn, *well, *odd)
    text = Page(write_pages(fleet).read_text(encoding="utf-8")).text
    body = fleet.to_json()
    assert [(one["axis"], one["parameter"]) for one in body["drifts"] if one["drifts"]] == [("worn", "damping")]
    (drift,) = (one for one in body["drifts"] if one["drifts"])
    assert drift["slope"]["value"] == pytest.approx(0.3 / 30.3, rel=0.05)
    assert ("odd", 60.0) in {(one["axis"], one["value"]) for one in body["outliers"]}
    assert "1 of 8 parameters with three dates or more drift significantly" in text
    assert "60 1/s" in text


# Drift and unusual values


def test_trend_without_error_bars_is_that_of_ordinary_least_squares():
    rng = np.random.default_rng(3)
    time, value = np.sort(rng.uniform(0, 300, 12)), rng.normal(5.0, 0.1, 12)
    found, known = trend(time, value, np.zeros(12)), stats.linregress(time, value)
    assert (found.slope, found.stderr, found.p) == pytest.approx((known.slope, known.stderr, known.pvalue), rel=1e-9)


def test_trend_with_true_error_bars_is_that_of_weighted_least_squares():
    time = np.array([0.0, 10.0, 20.0, 30.0, 40.0])
    error = np.array([0.1, 0.2, 0.1, 0.3, 0.1])
    value = 2.0 + 0.01 * time + error * np.array([0.3, -0.4, 0.1, 0.5, -0.2])
    found = trend(time, value, error)
    design = np.column_stack([np.ones(5), time])
    information = design.T @ (design / error[:, None] ** 2)
    expected = np.linalg.solve(information, design.T @ (value / error**2))
    assert found.scatter == 0.0
    assert found.slope == pytest.approx(expected[1], rel=1e-9)
    assert found.stderr == pytest.approx(np.sqrt(np.linalg.inv(information)[1, 1]), rel=1e-9)


@pytest.mark.parametrize(
    "scatter", [0.0, 0.03, pytest.param(0.3, marks=pytest.mark.slow)], ids=["none", "some", "most"]
)
def test_trend_raises_no_more_false_alarms_than_it_says(scatter):
    rng, count = np.random.default_rng(7), 3000
    time = np.arange(8.0) * 30.0
    alarms = 0
    for _ in range(count):
        error = rng.uniform(0.01, 0.05, 8)
        value = 5.0 + np.hypot(error, scatter) * rng.normal(size=8)
        alarms += trend(time, value, error).p < 0.05
    assert alarms / count < 0.05 + 3 * np.sqrt(0.05 * 0.95 / count)


def test_trend_scales_with_units_and_does_not_move_with_time():
    rng = np.random.default_rng(4)
    time, value, error = np.arange(6.0), rng.normal(size=6), np.full(6, 0.3)
    one, other = trend(time, value, error), trend(1000.0 + time / 24.0, 1e-6 * value, 1e-6 * error)
    assert other.slope == pytest.approx(24e-6 * one.slope, rel=1e-6)
    assert (other.p, other.scatter) == pytest.approx((one.p, 1e-6 * one.scatter), rel=1e-6)


def test_equal_values_drift_nowhere():
    assert trend(np.arange(4.0), np.full(4, 2.0), np.zeros(4)).p == 1.0


def dated(count, values):
    """Return rows of `count` axes over as many dates as `values` gives each."""
    return [
        {"axis": f"a{i}", "measured": f"2026-01-{day + 1:02d}", "status": "done", "causes": "", "gain": float(value),
         "gain:stderr": 0.01, "gain:unit": "m/s^2/V"}
        for i in range(count) for day, value in enumerate(values(i))
    ]  # fmt: skip


def test_drifts_are_told_with_few_false_ones_among_many_axes():
    rng = np.random.default_rng(11)
    rows = dated(200, lambda i: 2.0 + 0.01 * rng.normal(size=10) + (0.02 * np.arange(10) if i < 20 else 0.0))
    found = Fleet(folder=Path(), out=Path(), axes=(), rows=tuple(rows), studied_now=0).drifts
    adjusted = stats.false_discovery_control([one.trend.p for one in found])
    assert [one.drifts for one in found] == (adjusted <= 0.05).tolist()
    told = {one.axis for one in found if one.drifts}
    assert {f"a{i}" for i in range(20)} <= told
    assert len(told) <= 24


def test_two_dates_are_no_drift():
    rows = dated(2, lambda _: [1.0, 2.0])
    assert Fleet(folder=Path(), out=Path(), axes=(), rows=tuple(rows), studied_now=0).drifts == ()


def test_unusual_value_is_found_and_its_own_error_bar_excuses_it():
    rng = np.random.default_rng(2)
    rows = dated(30, lambda _: 2.0 + 0.05 * rng.normal(size=1))
    rows[7] |= {"gain": 3.0}
    rows[8] |= {"gain": 3.0, "gain:stderr": 1.0}
    found = Fleet(folder=Path(), out=Path(), axes=(), rows=tuple(rows), studied_now=0).outliers
    assert [one.axis for one in found] == ["a7"]
    assert found[0].median == pytest.approx(2.0, abs=0.05)


def test_values_in_other_units_are_not_compared():
    rows = dated(9, lambda _: [2.0])
    rows.append({**rows[0], "axis": "turn", "gain": 500.0, "gain:unit": "rad/s^2/V"})
    assert Fleet(folder=Path(), out=Path(), axes=(), rows=tuple(rows), studied_now=0).outliers == ()


# The command


def run(*arguments):
    command = [sys.executable, "-m", "servolens", "fleet", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_command_writes_table_page_and_json_and_says_so(tmp_path):
    axes, out = make_unreadable(tmp_path / "axes", "a"), tmp_path / "out"
    done = run(axes, "--out", out, "--cores", "1", "--csv", "--json", tmp_path / "fleet.json")
    assert (done.returncode, done.stderr) == (1, "")
    assert f"Wrote {out}/fleet.html" in done.stdout
    body = json.loads((tmp_path / "fleet.json").read_text(encoding="utf-8"))
    assert (body["schema"], body["axes"], body["status"]) == ("servolens.fleet/1", 1, {"refused": 1})
    assert body["rows"][0]["result"] == "results/a.json"
    assert (out / "summary.csv").read_text(encoding="utf-8").startswith("axis,measured,status,")
    assert not (out / "summary.parquet").exists()


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (("--kp", "100"), "--kp needs --settling-time; see servolens fleet --help"),
        (("--cores", "2", "--dask", "tcp://x:1"), "--cores is for this machine; give --cores or --dask"),
        (("--time-limit", "-1"), "time_limit must be a positive number, got -1.0"),
    ],
)
def test_command_refuses_what_does_not_go_together(tmp_path, more, sentence):
    done = run(make_unreadable(tmp_path / "axes", "a"), "--out", tmp_path / "out", *more)
    assert done.returncode == 2
    assert done.stderr.startswith(f"servolens: error: {sentence}")
    assert not (tmp_path / "out").exists()
