"""Every example that is written down runs: in docstrings, in the README, on the pages."""

from __future__ import annotations

import doctest
import importlib
import importlib.util
import os
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SOURCE = ROOT / "src"
MODULES = [
    ".".join(path.relative_to(SOURCE).with_suffix("").parts).removesuffix(".__init__")
    for path in sorted(SOURCE.rglob("*.py"))
    if ">>>" in path.read_text(encoding="utf-8")
]
PYTHON_BLOCK = re.compile(r"^ *```python\n(.*?)^ *```", flags=re.DOTALL | re.MULTILINE)
PAGES = [
    page
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
    if PYTHON_BLOCK.search(page.read_text(encoding="utf-8"))
]


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings_run(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    result = doctest.testmod(importlib.import_module(name), optionflags=flags)
    assert result.attempted > 0
    assert result.failed == 0


LONG = {"python.md", "quickstart.md", "diagnosis.md", "howto-teaching.md"}
"""Pages whose examples take half a minute each."""


@pytest.mark.parametrize(
    "page", [pytest.param(page, marks=pytest.mark.slow if page.name in LONG else (), id=page.name) for page in PAGES]
)
def test_python_on_the_pages_runs(page, tmp_path):
    script = "\n".join(map(textwrap.dedent, PYTHON_BLOCK.findall(page.read_text(encoding="utf-8"))))
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=tmp_path,
        env={**os.environ, "MPLBACKEND": "Agg"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr


def test_pages_link_only_to_files_that_exist():
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md"):
        targets = re.findall(r"\]\((?!https?://)([^)#]+)", page.read_text(encoding="utf-8"))
        assert [target for target in targets if not (ROOT / target).exists()] == []


def test_links_of_the_built_pages_are_checked_as_from_a_folder(tmp_path):
    check = _loaded(ROOT / "docs" / "check_links.py")
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "other.html").write_text('<h2 id="here">x</h2><a href="../index.html">up</a>', encoding="utf-8")
    good = '<a href="sub/other.html#here">a</a><a href="#top">b</a><a href="https://example.org/x">c</a>'
    (tmp_path / "index.html").write_text(good, encoding="utf-8")
    assert check.broken(tmp_path) == []
    wrong = ("sub/", "/sub/other.html", "none.html", "sub/other.html#there", "#there")
    (tmp_path / "index.html").write_text("".join(f'<a href="{link}">x</a>' for link in wrong), encoding="utf-8")
    assert [line.split(": ")[1] for line in check.broken(tmp_path)] == list(wrong)


def _loaded(script):
    found = importlib.util.spec_from_file_location(script.stem, script)
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_the_paper_s_numbers_are_those_that_the_code_gives(tmp_path, monkeypatch):
    module = _loaded(ROOT / "benchmarks" / "paper.py")
    page = ROOT / "docs" / "paper.md"
    monkeypatch.setattr(module, "PAGE", tmp_path / "paper.md")
    marks = re.compile(r"(<!-- [a-z ]+ begin -->).*?(<!-- [a-z ]+ end -->)", flags=re.DOTALL)
    text = page.read_text(encoding="utf-8")
    (tmp_path / "paper.md").write_text(marks.sub(r"\1\2", text), encoding="utf-8")
    module.main()
    numbers = re.compile(r"[−+]?\d+\.?\d*")
    ours, written = ((tmp_path / "paper.md").read_text(encoding="utf-8"), text)
    assert marks.sub("", numbers.sub("", ours)) == marks.sub("", numbers.sub("", written))
    for own, table in zip(_tables(marks, ours), _tables(marks, written), strict=True):
        assert [float(x.replace("−", "-")) for x in numbers.findall(own)] == pytest.approx(
            [float(x.replace("−", "-")) for x in numbers.findall(table)], rel=0.02, abs=0.021
        )


def _tables(marks, page):
    return [match.group() for match in marks.finditer(page) if "speed" not in match[1]]
