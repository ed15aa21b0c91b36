"""The command line in a terminal: widths, colours, progress, completion, and files that promise what they hold."""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
import time
from dataclasses import replace

import pytest
from click.testing import CliRunner

from servolens import lab
from servolens.cli import group
from servolens.commands import terminal
from servolens.findings import Finding
from servolens.report.printing import chromium
from servolens.summary import Summary, Table

WIDE = Summary(
    title="Title",
    sentences=("A sentence that is a good deal longer than a narrow terminal is wide, and so has to be broken.",),
    tables=(
        Table(
            title="Records",
            columns=("Record", *(f"Quantity {i} [unit]" for i in range(6))),
            rows=(("a record with a long name", *["1.2345 ± 0.0012 (0.1 %)"] * 6),),
        ),
    ),
    findings=(Finding(code="one", severity="warning", message="something is to be known.", record="a record"),),
)
COLOUR = re.compile(r"\x1b\[[\d;]*3[1-7][\d;]*m")


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self):
        return True


@pytest.mark.parametrize("width", [60, 120, 240])
def test_nothing_is_wider_than_the_terminal(width, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", str(width))
    terminal.show(WIDE)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= width
    assert sum("1.2345 ± 0.0012 (0.1 %)" in line for line in lines) == (1 if width == 240 else 6)


def test_a_unit_stays_whole_in_the_name_of_a_row(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "34")
    rows = (("Least kd [V s/m]", "3.103–14.33, 20–21"), ("Peak command there [V]", "8.8"))
    terminal.show(Summary(title="Title", tables=(Table(title="Side by side", columns=("", "Linear"), rows=rows),)))
    names = [line.split("   ")[0].strip() for line in capsys.readouterr().out.splitlines()]
    assert names[names.index("Least kd") + 1] == "[V s/m]"


def test_what_is_true_of_several_records_is_told_once(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "200")
    two = [Finding(code="g", severity="note", message="read by guess.", record=name) for name in ("a", "b")]
    many = [Finding(code="s", severity="note", message="shaken by 2 mm/s^2.", record=name) for name in "abcdef"]
    terminal.show(Summary(title="Title", findings=(*two, *many, replace(two[0], severity="error"))))
    assert capsys.readouterr().out.split("\n\n")[1].splitlines() == [
        "error: a: read by guess.",
        "note: a and b: read by guess.",
        "note: a, b, c and 3 more: shaken by 2 mm/s².",
    ]


@pytest.mark.parametrize(("value", "coloured"), [(None, True), ("1", False)])
def test_no_color_is_kept(value, coloured, monkeypatch):
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.delenv("NO_COLOR", raising=False)
    if value:
        monkeypatch.setenv("NO_COLOR", value)
    screen = Terminal()
    monkeypatch.setattr(sys, "stdout", screen)
    terminal.show(WIDE)
    assert bool(COLOUR.search(screen.getvalue())) == coloured


def test_progress_moves_while_nothing_is_reported(monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setattr(terminal, "DELAY", 0.01)
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    with terminal.progress_bar() as progress:
        progress("Designing on the model that the data support best, with three lights", 80, 100)
        time.sleep(0.8)
    frames = re.findall(r"[⠋⠙⠹⠸⠼⠴⠦⠧⠇⠏]", screen.getvalue())
    assert len(set(frames)) >= 3
    assert "Designing" in screen.getvalue()


def test_progress_is_silent_where_there_is_no_terminal(monkeypatch):
    screen = io.StringIO()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setattr(terminal, "DELAY", 0.0)
    with terminal.progress_bar() as progress:
        progress("Designing", 1, 2)
        time.sleep(0.05)
    assert screen.getvalue() == ""


@pytest.mark.parametrize(("shell", "says"), [("bash", "complete -o"), ("zsh", "compdef"), ("fish", "complete ")])
def test_shells_are_told_how_to_complete(shell, says):
    done = completed(f"{shell}_source")
    assert says in done.stdout
    assert done.returncode == 0


def completed(what, **environment):
    command = [sys.executable, "-c", "from servolens.cli import main; main()"]
    variables = {**os.environ, "_SERVOLENS_COMPLETE": what, **environment}
    return subprocess.run(command, capture_output=True, text=True, env=variables, check=False)


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("servolens dia", "diagnose"),
        ("servolens tune --sett", "--settling-time"),
        ("servolens report --eff", "--effort"),
    ],
)
def test_commands_and_options_are_completed(typed, offered):
    words = typed.split()
    done = completed("bash_complete", COMP_WORDS=typed, COMP_CWORD=str(len(words) - 1))
    assert offered in [line.partition(",")[2] for line in done.stdout.splitlines()]


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("logs") / "kp60.csv"
    run = lab.step_record(lab.NLM3, 60, 0, noise=1e-5, seed=1)
    rows = zip(run.time, run.reference, run.position, run.voltage, strict=True)
    text = "# kp = 60 V/m\n# kd = 0 V s/m\ntime [s],reference [m],position [m],voltage [V]\n"
    path.write_text(text + "".join(f"{','.join(f'{v:.9g}' for v in row)}\n" for row in rows), encoding="utf-8")
    return path


COMMANDS = {
    "report": ("report", "--out"),
    "tune": ("tune", "--kp", "80", "--settling-time", "0.5", "--report"),
    "diagnose": ("diagnose", "--report"),
}


@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS)
@pytest.mark.parametrize(
    ("name", "says"),
    [("x.docx", "written as .html or .pdf"), ("x.pdf", "needs Chromium or Chrome, and none was found")],
)
def test_no_html_in_disguise(command, name, says, log, tmp_path, monkeypatch):
    monkeypatch.setenv("SERVOLENS_CHROMIUM", str(tmp_path / "nothing"))
    target = tmp_path / name
    done = CliRunner().invoke(group, [command[0], str(log), *command[1:], str(target)], prog_name="servolens")
    assert done.exit_code == 2
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith(f"servolens: error: {target}: ")
    assert says in done.stderr
    assert not target.exists()


@pytest.mark.skipif(chromium() is None, reason="no Chromium or Chrome is here to print")
def test_report_is_printed_as_pdf(log, tmp_path):
    target = tmp_path / "x.pdf"
    done = CliRunner().invoke(group, ["diagnose", str(log), "--effort", "quick", "--report", str(target)])
    assert done.exit_code == 0, done.stderr
    assert target.read_bytes().startswith(b"%PDF-")


def test_a_fact_is_told_once(log, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "400")
    arguments = ["tune", str(log), "--kp", "60", "--settling-time", "0.6", "--effort", "quick"]
    lines = [
        line
        for line in CliRunner().invoke(group, arguments).stdout.splitlines()
        if len(line) > 30 and " " in line.strip()
    ]
    assert len(lines) > 6
    sentences = [s.rstrip(".") for line in lines for s in re.split(r"(?<=[a-z)])\. ", line)]
    repeated = [s for i, s in enumerate(sentences) if any(s in other for other in sentences[:i] + sentences[i + 1 :])]
    assert repeated == []
    assert sum("noise" in line and "(r.m.s." in line for line in lines) == 1
