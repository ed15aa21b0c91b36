"""Damaged and hostile files: every reader takes them or refuses them with one sentence, soon and with little memory."""

from __future__ import annotations

import random
import re

import pytest
from fuzzing import MEMORY, Readers, hostile, judged, memory, seeds
from hypothesis import given, settings
from hypothesis import strategies as st

GOOD = seeds()


@pytest.fixture(scope="module")
def readers(tmp_path_factory):
    readers = Readers(tmp_path_factory.mktemp("fuzz"))
    readers.before = memory()  # the most that the tests before these have held
    return readers


@pytest.mark.parametrize("kind", GOOD)
def test_good_files_are_read(readers, kind):
    for content in GOOD[kind]:
        getattr(readers, kind)(content)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", GOOD)
@settings(max_examples=400, deadline=None)
@given(chance=st.randoms(use_true_random=False))
def test_damaged_files_are_read_or_refused(readers, kind, chance):
    content = hostile(kind, GOOD[kind], chance)
    assert judged(readers, kind, content) is None, content
    assert memory() < readers.before + MEMORY


@pytest.mark.parametrize(
    "wrong",
    [lambda _content: 1 / 0, lambda _content: [][1], lambda _content: {}["x"]],
    ids=["arithmetic", "index", "key"],
)
def test_fuzzing_finds_a_reader_that_breaks(readers, monkeypatch, wrong):
    monkeypatch.setattr(Readers, "text", staticmethod(wrong))
    assert "Error" in judged(readers, "text", random.Random(0).randbytes(10))


@pytest.mark.parametrize(
    ("kind", "before", "after"),
    [
        ("model", rb'"level": \{', b'"lev' + b"[" * 2000 + b'": {'),
        ("diagnosis", rb'"sample_time": [0-9.e-]+', b'"sample_time": 1e-310'),
    ],
    ids=["long name", "endless steps"],
)
def test_what_fuzzing_has_found_is_read_or_refused(readers, kind, before, after):
    content, number = re.subn(before, after, GOOD[kind][0])
    assert number
    assert judged(readers, kind, content) is None
