"""The map over both gains says of each pair what a simulation says, and its noise is that of a simulated controller."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from click.testing import CliRunner

from servolens.cli import group
from servolens.design import PDSpec, evaluate, gain_map, map_axes, noise_gain
from servolens.effects import CoulombFriction, VelocityDecayDamping
from servolens.errors import InputError
from servolens.model import Model
from servolens.plant import Plant
from servolens.report.plots_design import plot_gain_map
from servolens.results import write_json

if TYPE_CHECKING:
    from pathlib import Path

PAPER = Plant(gain=1.91, damping=3.799, effects=(VelocityDecayDamping(alpha1=15.2528, alpha2=5.9934),))
SPEC = PDSpec(kp=100.0, settling_time=0.5)


def test_each_pair_of_a_map_is_what_evaluate_says() -> None:
    sticky = PAPER.with_effect(CoulombFriction(level=0.1))
    kp, kd = np.linspace(40.0, 160.0, 7), np.linspace(0.0, 12.0, 9)
    found = gain_map([PAPER, sticky], SPEC, kp, kd)
    for i, one in enumerate(kp):
        for j, other in enumerate(kd):
            both = [evaluate(plant, replace(SPEC, kp=float(one)), float(other)) for plant in (PAPER, sticky)]
            assert found.feasible[i, j] == all(response.meets for response in both)
            if found.feasible[i, j]:
                assert found.settling_time[i, j] == max(r.settling_time or 0.0 for r in both)
    assert found.feasible.any()
    assert not found.feasible.all()
    pair = found.least_noise
    assert pair is not None
    least = noise_gain(replace(SPEC, kp=pair[0]), pair[1])
    assert least == found.noise[found.feasible].min()


@pytest.mark.parametrize(("share", "window"), [(1.0, 1), (0.3, 1), (0.3, 3), (1.0, 4)])
def test_noise_is_that_of_a_controller_run_on_white_noise(share: float, window: int) -> None:
    spec, kd = replace(SPEC, derivative_filter=share, derivative_window=window), 2.0
    noise = np.random.default_rng(1).normal(size=200_000)
    slope, voltage = 0.0, np.empty(noise.size)
    for k in range(noise.size):
        slope += share * ((noise[k] - noise[max(k - window, 0)]) / (window * spec.sample_time) - slope)
        voltage[k] = -spec.kp * noise[k] - kd * slope
    assert noise_gain(spec, kd) == pytest.approx(voltage.std(), rel=0.02)
    assert noise_gain(replace(spec, derivative="velocity", derivative_window=1), kd) == spec.kp


def test_an_unstable_pair_is_infeasible_and_a_map_without_gains_is_refused() -> None:
    found = gain_map(PAPER, SPEC, [100.0], [0.0, 5000.0])
    assert not found.feasible.any()
    assert found.least_noise is None
    with pytest.raises(InputError, match="at least one"):
        gain_map(PAPER, SPEC, [], [1.0])
    with pytest.raises(InputError, match="kd of a map"):
        gain_map(PAPER, SPEC, [100.0], [-1.0])


def test_the_map_is_drawn_with_its_feasible_region_and_the_pair_of_least_noise() -> None:
    found = gain_map(PAPER, SPEC, np.linspace(60.0, 140.0, 9), np.linspace(2.0, 10.0, 9))
    ax = plot_gain_map(found)
    assert ax.get_xlabel() == "Kp [V/m]"
    assert ax.get_ylabel() == "Kd [V s/m]"
    (mark,) = (line for line in ax.get_lines() if line.get_label() == "least noise")
    assert (mark.get_xdata()[0], mark.get_ydata()[0]) == found.least_noise  # type: ignore[index]  # arrays
    scale = ax.figure.axes[-1]
    assert [label.get_text() for label in scale.get_xticklabels()] == ["0", "0.3", "0.5", "0.75"]


def test_a_map_begins_and_ends_around_the_spec() -> None:
    kp, kd = map_axes(PAPER, SPEC, count=11)
    assert kp[0] < SPEC.kp < kp[-1]
    assert (kp.size, kd.size, kd[0]) == (11, 11, 0.0)
    assert np.isnan(gain_map(PAPER, SPEC, SPEC.kp, kd[-1]).settling_time).all()  # too slow: nothing is beyond
    assert map_axes(PAPER, replace(SPEC, kd_max=7.0), kp=(50.0, 60.0), count=3)[1][-1] == 7.0
    with pytest.raises(InputError, match="kp of a map must run from a positive number to a larger one, got 5 to 5"):
        map_axes(PAPER, SPEC, kp=(5.0, 5.0))
    with pytest.raises(InputError, match="at least 2 gains"):
        map_axes(PAPER, SPEC, count=1)


@pytest.mark.parametrize("quantity", ["settling_time", "overshoot", "noise"])
def test_the_recommended_pair_is_marked_on_each_quantity(quantity: str) -> None:
    found = gain_map(PAPER, SPEC, np.linspace(60.0, 140.0, 9), np.linspace(2.0, 10.0, 9))
    ax = plot_gain_map(found, quantity, recommended=(100.0, 8.5))  # type: ignore[arg-type]  # one of them
    marks = {line.get_label(): (line.get_xdata()[0], line.get_ydata()[0]) for line in ax.get_lines()}  # type: ignore[index]
    assert marks["recommended"] == (100.0, 8.5)
    assert marks["least noise"] == found.least_noise


@pytest.mark.parametrize("kind", ["png", "svg"])
def test_the_command_draws_the_map_and_writes_its_numbers(tmp_path: Path, kind: str) -> None:
    write_json(tmp_path / "model.json", "model", Model(plant=PAPER).to_json())
    wanted = ["--kp", "100", "--settling-time", "0.5", "--kp-range", "60", "140", "--kd-max", "10", "--count", "9"]
    files = [str(tmp_path / "model.json"), "--out", str(tmp_path / f"map.{kind}"), "--json", str(tmp_path / "map.json")]
    result = CliRunner().invoke(group, ["map", *files, *wanted])
    assert result.exit_code == 0, result.output
    begin = {"png": b"\x89PNG", "svg": b"<?xml"}[kind]
    assert (tmp_path / f"map.{kind}").read_bytes().startswith(begin)
    told = json.loads((tmp_path / "map.json").read_text())
    found = gain_map(PAPER, replace(SPEC, kd_max=10.0), np.linspace(60.0, 140.0, 9), np.linspace(0.0, 10.0, 9))
    assert f"{100 * found.feasible.mean():.3g} % of them meet the spec" in " ".join(result.output.split())
    assert told["schema"] == "servolens.map/1"
    assert told["feasible"] == found.feasible.tolist()
    assert (told["least_noise"]["kp"], told["least_noise"]["kd"]) == found.least_noise
    kd = told["recommended"]["kd"]
    assert evaluate(PAPER, SPEC, kd).meets
    assert np.isnan(found.settling_time).any()
    assert "does not settle" in told["reason"]


def test_the_command_refuses_a_picture_of_another_kind_and_says_when_nothing_is_feasible(tmp_path: Path) -> None:
    write_json(tmp_path / "model.json", "model", Model(plant=PAPER).to_json())
    call = ["map", str(tmp_path / "model.json"), "--kp", "100", "--count", "5", "--settling-time"]
    refused = CliRunner().invoke(group, [*call, "0.5", "--out", str(tmp_path / "map.pdf")])
    assert refused.exit_code == 2
    assert "written as .png or .svg" in refused.output
    hopeless = CliRunner().invoke(group, [*call, "0.01", "--out", str(tmp_path / "map.svg")])
    assert hopeless.exit_code == 1
    assert "Gain: red" in hopeless.output
