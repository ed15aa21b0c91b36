"""Hostile input: good files of every kind, what damages them, and what every reader has to do with the result."""

from __future__ import annotations

import gzip
import io
import json
import resource
import tempfile
import time
import traceback
from pathlib import Path

import numpy as np
import scipy.io

from servolens import diagnose, lab
from servolens.campaign import read_logs
from servolens.diagnosis.proposal import propose
from servolens.errors import ServolensError
from servolens.fleet.axes import Axis, find_axes
from servolens.fleet.axis_page import axis_content
from servolens.fleet.pages import _environment
from servolens.fleet.rows import row_of
from servolens.fleet.store import Store
from servolens.model import read_model
from servolens.reading import read_log

LONGEST = 10.0
"""Seconds that one input may take."""
MEMORY = 1024.0
"""MiB that the process may have used in the end."""
SECRET = "s3cret-of-another-folder"
TOKENS = [
    *(b"\0", b"\xff\xfe", b"\xef\xbb\xbf", b"\r", b"\n", b"\t", b",", b";", b"'", b'"', b"#", b"[", b"]", b"{", b"}"),
    *(b"=", b"nan", b"inf", b"-1", b"1e309", b"1e-320", b"9" * 400, b"0x", b"True", b"null", b"\xed\xa0\x80"),
    *(b"\x1b[2J", b"../", b"/etc/passwd", b"../secret.csv", b"=cmd|' /C calc'!A0", b"<script>", b"{{7*7}}", b"%s%n"),
    *(b"${x}", b"time", b"position", b"kp", b"\xff\xff\xff\xff", b"\x80\0\0\0", b"\x7f" + 7 * b"\xff", b"e" * 70),
    *(b"[" * 2000, b"# kp = 1e999\n", b"10**9", b"V/m", b"m" * 50, b"(" * 60, b"**9**9**9", b"# sample_time = 0\n"),
    *(b"<!DOCTYPE a [", b"&#0;", b"&lt;", b"<Values>", b"; 1; 2\n", b"0.Data;\n"),
    *(b"# supply_voltage = 24\n", b"# reference = 0.1 m from 0.5 s\n", b"# counts_per_unit = 0\n", b"# kp = 1e300\n"),
]
COLUMNS = {"time": np.arange(40) / 1000, "reference": np.full(40, 0.1), "position": np.linspace(0, 0.1, 40) ** 2}
MODEL = {
    "schema": "servolens.model/1", "gain": {"value": 1.9, "stderr": 0.01, "unit": "m/s^2/V"},
    "damping": {"value": 6.0, "stderr": 0.1, "unit": "1/s"},
    "effects": [{"effect": "coulomb_friction", "parameters": {"level": {"value": 0.3, "unit": "m/s^2"}}}],
    "identified_from": ["a"], "covariance": {"names": ["gain", "damping", "coulomb_friction.level"],
    "matrix": [[1e-4, 0, 0], [0, 1e-2, 0], [0, 0, None]]}, "range": {"voltage": 6.0, "speed": 0.7, "step": 0.1},
    "verdict": "explained", "remainder": {"rms": 1e-6, "times_noise": 1.1, "of_travel": 1e-5, "acceleration_rms": 0.1,
                                          "correlation_time": 0.01, "of_motor": 0.1, "depends_on_inputs": False,
                                          "material": False},
    "model_error": {"frequency": [1.0, 9.0], "size": [0.1, 0.2], "loop": [1.0, 0.5]},
    "heldout_of_step": 1e-4, "fatal": [],
}  # fmt: skip
RESULT = {
    "schema": "servolens.fleet-axis/1", "findings": [{"code": "x", "severity": "note", "message": "m", "record": None}],
    "axis": "a", "measured": None, "status": "done", "sentence": None, "records": ["r"], "length_unit": "m",
    "command_unit": "V", "inputs": "0", "request": "0", "tuning": {
        "data": {"light": "green", "sentence": "s"}, "model": {"light": "green", "sentence": "s"},
        "gain": {"light": "red", "sentence": "s"}, "kp": 100, "kd": 5.0, "reason": "r",
        "recommended": {"kd": 6.0, "settling_time": 0.4, "probability": {"value": 0.9}},
        "diagnosis": {"verdict": "explained", "model": MODEL, "remainder": {"of_travel": 0.1, "material": True},
                      "causes": [{"effect": "coulomb_friction", "sentence": "s", "rivals": ["delay"]}]}},
}  # fmt: skip
CAMPAIGN = b"""[defaults]
kp = 60
[[records]]
file = "run.csv"
kd = 0
columns = {position = "position"}
units = {position = "m"}
[[records]]
file = "sub/run.csv"
"""


def text(separator=",", point="."):
    rows = zip(*COLUMNS.values(), strict=True)
    lines = [separator.join(f"{value:.6g}".replace(".", point) for value in row) for row in rows]
    return "\n".join(
        ["# kp = 60 V/m", "# kd = 0", "# encoder_resolution = 1e-5 m", separator.join(COLUMNS), *lines, ""]
    )


def diagnosed():
    """Return what a diagnosis of a short step keeps, with a rival for what it asks next."""
    runs = [
        lab.step_record(lab.LM1, kp, duration=0.3, noise=1e-5, seed=kp, setup=lab.Setup(name=f"kp {kp}"))
        for kp in (40, 80)
    ]
    found = diagnose(runs, effort="quick").to_json()
    return {**found, "rival_models": {"delay": [MODEL]}}


def traces():
    """Return traces of CODESYS V3: variables one after the other, in text and in XML."""
    names = {"position": "PLC_PRG.lrActPos", "reference": "PLC_PRG.lrSetPos"}
    ticks = [f"{t * 1e3:.0f}" for t in COLUMNS["time"]]
    plain, lists = "[key]; [value]\nName; Application.Trace\nFlags; 16\n", ""
    for k, (column, name) in enumerate(names.items()):
        cells = [f"{value:.6g}" for value in COLUMNS[column]]
        rows = "".join(f"; {tick}; {cell}\n" for tick, cell in zip(ticks, cells, strict=True))
        plain += f"{k}.Variable; {name}\n{k}.Class; 15\n{k}.Data; \n{rows}"
        lists += f'<TraceVariable VarName="{name}"><Values>{",".join(cells)}</Values>'
        lists += f"<Timestamps>{','.join(ticks)}</Timestamps></TraceVariable>"
    micro = '<Single Name="MicroSeconds" Type="bool">False</Single>'
    markup = f"<Trace><TraceConfiguration>{micro}</TraceConfiguration><TraceData>{lists}</TraceData></Trace>"
    return [plain.encode(), markup.encode(), markup.encode("utf-16")]


def seeds():
    """Return good files by kind."""
    lists = {name: values.tolist() for name, values in COLUMNS.items()}
    labview = "LabVIEW Measurement\t\nSeparator\tTab\n***End_of_Header***\n" + text("\t").partition("1e-5 m\n")[2]
    matlab = io.BytesIO()
    scipy.io.savemat(matlab, COLUMNS)
    return {
        "text": [text().encode(), text(";", ",").encode("latin-1"), labview.encode(), text("\t").encode("utf-16")],
        "json": [json.dumps(lists).encode(), json.dumps({"kp": 60, "data": [dict(zip(lists, r, strict=True)) for r in
                 zip(*lists.values(), strict=True)]}).encode()],
        "gzip": [gzip.compress(text().encode(), mtime=0)],
        "mat": [matlab.getvalue()],
        "codesys": traces(),
        "campaign": [CAMPAIGN],
        "model": [json.dumps(MODEL).encode()],
        "result": [json.dumps(RESULT).encode()],
        "diagnosis": [json.dumps({"schema": "servolens.diagnosis/1", **diagnosed()}).encode()],
        "names": [b"feed_2026-05-01", b"lift", "Ä b".encode()],
    }  # fmt: skip


def damaged(good, chance):
    """Return one of the good contents with one to six of its parts changed; `chance` is a random.Random."""
    content = bytearray(chance.choice(good))
    for _ in range(chance.randint(1, 6)):
        at = chance.randrange(len(content) + 1)
        length = min(chance.choice((1, 1, 2, 4, 8, 30, 200)), len(content) - at)
        match chance.randrange(7):
            case 0:
                content[at : at + length] = chance.randbytes(length)
            case 1:
                content[at:at] = chance.choice(TOKENS)
            case 2:
                del content[at : at + length]
            case 3:
                content[at:at] = content[at : at + length] * chance.choice((1, 2, 50))
            case 4:
                content[at : at + length] = chance.choice(TOKENS)
            case 5 if content:
                content[at % len(content)] ^= 1 << chance.randrange(8)
            case _:
                other = chance.choice(good)
                content[at:] = other[min(at, len(other)) :]
    return bytes(content[: 2**16])


ODD = (
    *(None, True, -1, 0, 1e308, -1e-308, 10**400, float("nan"), float("inf")),
    *("", "nan", "x" * 300, "=1+1", "\x1b[2J", "\ud800", "coulomb_friction", "delay", "rad", "done", "-"),
    *([], {}, [[]], [None], [1, 2, 3], {"value": None}, {"value": 1.0, "unit": "V"}),
)
JSON_KINDS = ("json", "model", "result", "diagnosis")


def hostile(kind, good, chance):
    """Return a content of a kind that its reader may not like."""
    if kind not in JSON_KINDS or chance.random() < 0.3:
        return damaged(good, chance)
    value = json.loads(chance.choice(good))
    for _ in range(chance.randint(1, 3)):
        value = bent(value, chance)
    return json.dumps(value).encode()


def bent(value, chance):
    """Return a JSON value with one of its parts odd, missing, doubled, or where another one was."""
    if not isinstance(value, dict | list) or not value or chance.random() < 0.12:
        return chance.choice(ODD)
    keys = list(value) if isinstance(value, dict) else list(range(len(value)))
    key, copy = chance.choice(keys), value.copy()
    match chance.randrange(8):
        case 0:
            del copy[key]
        case 1:
            copy[key] = copy[chance.choice(keys)]
        case 2 if isinstance(copy, list):
            copy.append(copy[key])
        case 2:
            copy[chance.choice(("effect", "value", "unit", "<b>", "x" * 100))] = copy[key]
        case _:
            copy[key] = bent(copy[key], chance)
    return copy


class Readers:
    """Each reads one content in a folder of its own; beside that lies a file that nobody may read."""

    def __init__(self, folder):
        self.folder = Path(folder) / "inside"
        (self.folder / "sub").mkdir(parents=True)
        secret = f"# name = {SECRET}\n" + text()
        (Path(folder) / "secret.csv").write_text(secret, encoding="utf-8")
        for name in ("run.csv", "sub/run.csv"):
            (self.folder / name).write_text(text(), encoding="utf-8")
        self.pages = _environment()

    def write(self, name, content):
        path = self.folder / name
        path.write_bytes(content)
        return path

    def log(self, name, content):
        try:
            record = read_log(self.write(name, content)).record
        except ServolensError:
            record = read_log(self.write(name, content), settings={"kp": 60, "kd": 0}).record
        assert np.isfinite(record.time).all()
        assert np.isfinite(record.position).all()
        assert (np.diff(record.time) > 0).all()

    def text(self, content):
        self.log("fuzz.csv", content)

    def json(self, content):
        self.log("fuzz.json", content)

    def gzip(self, content):
        self.log("fuzz.csv.gz", content)

    def mat(self, content):
        self.log("fuzz.mat", content)

    def codesys(self, content):
        self.log("fuzz.trace", content)

    def campaign(self, content):
        for log in read_logs(self.write("campaign.toml", content)):
            assert log.path.is_relative_to(self.folder.resolve())
            assert SECRET not in log.reading.record.name

    def model(self, content):
        model = read_model(self.write("model.json", content))
        assert np.isfinite(model.plant.gain)
        json.dumps(model.to_json(), default=str)

    def diagnosis(self, content):
        propose(str(self.write("diagnosis.json", content)))

    def result(self, content):
        store, axis = Store(self.folder.parent / "store"), Axis(name="a", measured="", path=self.folder)
        store.path(axis).parent.mkdir(parents=True, exist_ok=True)
        store.path(axis).write_bytes(content)
        found = store.read(axis)
        if found is None:
            raise ServolensError("made again")
        row_of(found)
        page = self.pages.get_template("axis.html").render(
            title="t", made="m", dates=[], data="d", **axis_content(found)
        )
        body = page.partition("<body>")[2]
        assert "<script" not in body
        assert "{{7*7}}" not in body.replace("{{7*7}}", "")

    def names(self, content):
        name = content.replace(b"/", b"").replace(b"\0", b"")[:200]
        place = Path(tempfile.mkdtemp(dir=self.folder.parent))
        odd = place / (name.decode("utf-8", "surrogateescape") or "x")
        try:
            odd.mkdir()
        except OSError:
            raise ServolensError("no name of a file") from None
        for axis in find_axes(place):
            assert "/" not in axis.key
            assert len(axis.key) <= 120
            assert axis.label.isprintable()


def judged(readers, kind, content):
    """Return what is wrong with how a content was taken; None where it was read or refused with one sentence."""
    began = time.process_time()
    try:
        getattr(readers, kind)(content)
    except ServolensError as error:
        sentence = str(error)
        if not sentence.isprintable() or len(sentence) > 600:
            return f"sentence is not one short line: {sentence[:200]!r}"
        if SECRET in sentence:
            return "tells what another folder holds"
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        return "".join(traceback.format_exception_only(error)) + "".join(traceback.format_tb(error.__traceback__)[-2:])
    took = time.process_time() - began
    return f"takes {took:.1f} s" if took > LONGEST else None


def memory():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
