"""Where no room is left on the disk: one sentence, nothing half written, and what was there stays as it was."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from servolens import lab
from servolens.errors import InputError
from servolens.reading import read_log
from servolens.report.printing import CHOSEN, printed

ROOM = 8192
"""Bytes that a file may have in these tests."""
START = (
    "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, ({room}, {room})); from servolens.cli import main"
)
needs_limits = pytest.mark.skipif(os.name != "posix", reason="files are limited by setrlimit")
needs_full = pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no device that is always full")


def converted(log, campaign):
    command = [sys.executable, "-c", START.format(room=ROOM) + "; main()", "convert", os.fspath(log), "--out"]
    return subprocess.run([*command, os.fspath(campaign)], capture_output=True, text=True, check=False)


def assert_old_campaign_is_left(done, folder, refused):
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"servolens: error: {folder / refused}: cannot be written (")
    assert [(path.name, path.read_text(encoding="utf-8")) for path in folder.iterdir()] == [("runs.toml", "old")]


@needs_limits
def test_a_log_that_does_not_fit_is_not_copied_in_part(tmp_path):
    """The part that fitted was left beside the campaign, and was read as a shorter run by the next command."""
    log, folder = tmp_path / "run.csv", tmp_path / "campaign"
    lab.step_record(lab.NLM1, kp=60).to_csv(log)
    folder.mkdir()
    (folder / "runs.toml").write_text("old", encoding="utf-8")
    done = converted(log, folder / "runs.toml")
    assert_old_campaign_is_left(done, folder, "run.csv")


@needs_limits
def test_a_campaign_that_does_not_fit_leaves_the_old_one(tmp_path):
    """It was emptied before the new one was written; copies that no campaign names were left too."""
    logs, folder = tmp_path / "logs", tmp_path / "campaign"
    logs.mkdir()
    folder.mkdir()
    for k in range(40):
        lab.step_record(lab.NLM1, kp=60, duration=0.08, seed=k).to_csv(logs / f"a rather long name of a run {k}.csv")
    (folder / "runs.toml").write_text("old", encoding="utf-8")
    done = converted(logs, folder / "runs.toml")
    assert_old_campaign_is_left(done, folder, "runs.toml")


@needs_full
def test_a_workbook_is_not_called_damaged_where_the_disk_is_full(tmp_path, monkeypatch):
    import openpyxl

    book = openpyxl.Workbook()
    book.active.append(["t", "pos", "ref", "u"])
    for k in range(60):
        book.active.append([0.001 * k, 0.001 * k, 0.1, 3.0])
    book.save(tmp_path / "run.xlsx")
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda: open("/dev/full", "r+b", buffering=0))  # noqa: SIM115, PTH123
    with pytest.raises(InputError, match=r"run\.xlsx: cannot be read: no space is left for temporary files in "):
        read_log(tmp_path / "run.xlsx")


def test_a_page_that_finds_no_room_for_temporary_files_is_refused_by_one_sentence(tmp_path, monkeypatch):
    """It was called a fault of the program."""
    monkeypatch.setenv(CHOSEN, sys.executable)
    monkeypatch.setattr(tempfile, "tempdir", os.fspath(tmp_path / "missing"))
    with pytest.raises(
        InputError, match=r"^the page cannot be printed: no such file or directory where temporary file"
    ):
        printed("<p>page</p>")


@needs_limits
def test_what_is_compiled_leaves_no_part_in_the_cache(tmp_path):
    """Parts were left for ever, one more at each start."""
    start = START.format(room=ROOM).rpartition("; ")[0]
    code = f"{start}; from servolens.simulation.kernel import kept"
    code += f"; print(len(kept('x', ['y'], lambda: bytes({3 * ROOM}))))"
    environment = {**os.environ, "SERVOLENS_CACHE": os.fspath(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout.strip() == str(3 * ROOM)
    assert [*tmp_path.iterdir()] == []
