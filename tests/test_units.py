"""Units: the table against pint, the kinds that must not be mixed, and texts that mean harm."""

from __future__ import annotations

import math
import subprocess
import sys

import pytest

from servolens import units
from servolens.errors import InputError
from servolens.units import parse_unit, split_number


@pytest.mark.parametrize(
    ("text", "factor", "si"),
    [
        ("s", 1, "s"),
        ("ms", 1e-3, "s"),
        ("us", 1e-6, "s"),
        ("µs", 1e-6, "s"),
        ("min", 60, "s"),
        ("mm", 1e-3, "m"),
        ("cm", 1e-2, "m"),
        ("um", 1e-6, "m"),
        ("µm", 1e-6, "m"),
        ("μm", 1e-6, "m"),
        ("inch", 0.0254, "m"),
        ("deg", math.pi / 180, "rad"),
        ("°", math.pi / 180, "rad"),
        ("mrad", 1e-3, "rad"),
        ("rev", 2 * math.pi, "rad"),
        ("rpm", 2 * math.pi / 60, "rad/s"),
        ("mV", 1e-3, "V"),
        ("N*m", 1, "N m"),
        ("Nm", 1, "N m"),
        ("N·m", 1, "N m"),
        ("V/mm", 1e3, "V/m"),
        ("V/deg", 180 / math.pi, "V/rad"),
        ("V s/mm", 1e3, "V s/m"),
        ("V*s/mm", 1e3, "V s/m"),
        ("V/(mm/s)", 1e3, "V s/m"),
        ("%/mm", 1e3, "%/m"),
        ("mA/cm", 0.1, "A/m"),
        ("m^2/m", 1, "m"),
    ],
)
def test_unit_is_a_multiple_of_its_si_unit(text, factor, si):
    unit = parse_unit(text)
    assert unit.factor == pytest.approx(factor, rel=1e-12)
    assert unit.dimension == parse_unit(si).dimension


@pytest.mark.parametrize("text", [*units._ATOMS, "V/m", "V s/rad", "N m/rad", "1/mm", "counts/s"])
def test_table_agrees_with_pint(text):
    ours, theirs = units._from_table(text), units._from_pint(text.replace("mNm", "mN*m"))
    assert ours.dimension == theirs.dimension
    assert ours.factor == pytest.approx(theirs.factor, rel=1e-12)


def test_metre_radian_percent_and_count_are_different_things():
    texts = ("V", "V/m", "V/rad", "A/m", "N/m", "N m/m", "N m/rad", "%/m", "V/count")
    dimensions = [parse_unit(text).dimension for text in texts]
    assert len(set(dimensions)) == len(dimensions)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "  ",
        "V per position unit",
        "V per unit",
        "furlongish",
        "V/",
        "/m",
        "m)",
        "m**1e9",
        "m**999999999",
        "m^9^9",
        "9**9**9**9",
        "2**4**4**4",
        "((9**4)**4)**4)**4",
        "m²²²²²",
        "1e400 m",
        "0 m",
        "-1 m",
        "m" * 41,
        "__import__('os')",
        "lambda: 0",
        "m;s",
        "(" * 20 + ")" * 20,
        "\x00",
    ],
)
def test_text_that_is_no_unit_is_none(text):
    assert parse_unit(text) is None


@pytest.mark.parametrize(
    ("text", "value", "unit"),
    [
        ("60", 60, ""),
        (" 60 V/m ", 60, "V/m"),
        ("60V/m", 60, "V/m"),
        ("-1.5e-3 [m]", -1.5e-3, "m"),
        (".5(mm)", 0.5, "mm"),
        ("1 V/(m/s)", 1, "V/(m/s)"),
        ("60 V per position unit", 60, "V per position unit"),
    ],
)
def test_number_and_unit_are_split(text, value, unit):
    assert split_number(text) == (value, unit)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "is not a number"),
        ("nan", "is not a number"),
        ("inf V", "is not a number"),
        ("sixty", "is not a number"),
        ("1_000", "is not a number"),
        ("1.2.3", "is not a number"),
        ("0x10", "is not a number"),
        ("1,5 V/m", "has a decimal comma; write a point"),
        ("1e999", "is not a finite number"),
    ],
)
def test_what_is_no_number_is_said(text, sentence):
    with pytest.raises(InputError) as refusal:
        split_number(text)
    assert str(refusal.value) == sentence


def test_ordinary_units_do_not_import_pint():
    script = (
        "import sys\nfrom servolens.units import parse_unit\n"
        "[parse_unit(u) for u in ('s', 'ms', 'mm', 'deg', 'V', 'V/m', 'V s/mm', 'A/rad', '%/m', 'N m')]\n"
        "print('pint' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
