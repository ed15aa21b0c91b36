"""Files as spreadsheets, notebooks and hands leave them: read right, or refused by one sentence that says where."""

from __future__ import annotations

import json
import re

import pytest
from click.testing import CliRunner

from servolens import lab
from servolens.cli import group
from servolens.errors import InputError
from servolens.reading import read_log
from servolens.reading.lines import unbroken

TRUTH = lab.step_record(lab.NLM1, 60, 2, reference=(0.1, 0.02), duration=0.2, noise=1e-5, seed=3)
SIGNALS = TRUTH.time, TRUTH.reference, TRUTH.position, TRUTH.voltage
HEAD = "time [s],reference [m],position [m],voltage [V]\n"
ROWS = [",".join(f"{x:.9g}" for x in row) for row in zip(*SIGNALS, strict=True)]
BODY = "".join(row + "\n" for row in ROWS)
TEXTS = [{"t": a, "ref": b, "pos": c, "u": d} for a, b, c, d in (row.split(",") for row in ROWS)]
COMMAS = [row.replace(",", ";").replace(".", ",") for row in ROWS]
POINTS = [row.replace(",", ";") for row in ROWS]


def written(folder, content, name="run.csv"):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


READ = {
    "UTF-16 without a mark": (HEAD + BODY).encode("utf-16-le"),
    "UTF-16 of the other order": (HEAD + BODY).encode("utf-16-be"),
    "UTF-32": (HEAD + BODY).encode("utf-32"),
    "breaks in headings": '"time\n[s]","reference,\ndesired [m]","position\n[m]",voltage [V]\n' + BODY,
    "breaks of Windows": ('"time\n[s]",reference [m],"position\n\n[m]",voltage [V]\n' + BODY).replace("\n", "\r\n"),
    "a rule below the headings": "|" + HEAD.strip().replace(",", "|") + "|\n|---|:--|---|--:|\n"
    + "".join("|" + row.replace(",", "|") + "|\n" for row in ROWS),
    "headings separated otherwise": HEAD.replace(",", ";") + BODY,
    "JSON with numbers in quotation marks": "\n".join(json.dumps(row) for row in TEXTS),
}  # fmt: skip


@pytest.mark.parametrize("form", READ)
def test_what_is_plain_to_people_is_read(tmp_path, form):
    record = read_log(written(tmp_path, READ[form], "run.jsonl" if "JSON" in form else "run.csv")).record
    for signal, truth in zip(("time", "reference", "position", "voltage"), SIGNALS, strict=True):
        assert getattr(record, signal) == pytest.approx(truth, rel=1e-7, abs=1e-9), signal


REFUSED = {
    "another decimal sign further down": (
        HEAD.replace(",", ";") + "\n".join([*COMMAS[:60], *POINTS[60:]]),
        "line 61 holds '0,059', no number as those below it; write all numbers with one decimal sign and without",
    ),
    "a sign of money": (HEAD + "$0,0,0,0\n" + BODY, "line 2 holds '$0', no number as those below it; write all"),
    "a line of one text": (
        HEAD + "\n".join([*ROWS[:20], "; a note", *ROWS[20:]]),
        "line 22 has 1 value where the header row has 4",
    ),
    "a fault below broken headings": (
        '"time\n[s]",reference [m],position [m],voltage [V]\n' + "\n".join([*ROWS[:20], "x,0,0,0", *ROWS[20:]]),
        "line 23, time: 'x' is not a number; fill or leave out such rows",
    ),
    "two runs": (
        HEAD + BODY + BODY,
        f"time must increase; sample {len(TRUTH)} (0 s) lies before sample {len(TRUTH) - 1} (0.4 s); a record is one"
        " run in the order of its time: split or sort the rows",
    ),
    "JSON of two lengths": (
        json.dumps({"t": SIGNALS[0].tolist(), "pos": SIGNALS[2].tolist()[:-5], "u": SIGNALS[3].tolist()}),
        f"position (unnamed, {len(TRUTH) - 5} values) and time (unnamed, {len(TRUTH)} values) stand in different tables"
        " of different lengths; name columns of one table",
    ),
}


@pytest.mark.parametrize("form", REFUSED)
def test_what_cannot_be_read_is_refused_by_a_sentence_that_says_where(tmp_path, form):
    content, sentence = REFUSED[form]
    path = written(tmp_path, content, "run.json" if "JSON" in form else "run.csv")
    with pytest.raises(InputError) as refused:
        read_log(path)
    assert str(refused.value).removeprefix(f"{path}: ").startswith(sentence)
    for command in (["check"], ["convert", "--out", str(tmp_path / "axis.toml")]):
        done = CliRunner().invoke(group, [command[0], str(path), *command[1:]])
        assert done.exit_code == 2
        assert re.fullmatch(r"servolens: error: [^\n]+\n", done.stderr)


def test_marks_of_inches_break_no_lines():
    content = b'travel,5"\nstroke,6"\nt,y\n0,1\n'
    assert unbroken(content, 400) == (content, 0)
    assert unbroken(b'"a\nb,c\nd,e\n', 2) == (b'"a\nb,c\nd,e\n', 0)


@pytest.mark.parametrize("every", [1, 7], ids=["each row", "some rows"])
def test_a_mark_that_says_ditto_glues_no_rows(tmp_path, every):
    rows = "".join(f"{1e-3 * k:.3f},{k % 9},{k % 7},1,{chr(34) if k % every == 0 else 'a'}\n" for k in range(60))
    path = written(tmp_path, f"time,position,reference,voltage,note\n{rows}".encode())
    assert read_log(path).record.time.size == 60
