"""What the demo says."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from servolens.summaries.names import spoken
from servolens.summaries.wording import listed, number, number_up, percent
from servolens.summary import Summary, Table

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["demo_summary", "hidden_summary"]


LIGHTS = ("data", "model", "gain")


def demo_summary(results: Mapping[str, Any], folder: str) -> Summary:
    """Tell the demo's main figures and where its page is.

    Parameters
    ----------
    results : mapping
        The fields of ``servolens.demo/1``.
    folder : str
        Where the page is.
    """
    table = results["table_one"]
    averages = [f"{m}: {percent(e)}" for m, e in zip(table["models"], table["average_percent_error"], strict=True)]
    return Summary(
        title="Demo on the virtual cart",
        sentences=(
            "A virtual copy of a paper's cart, which the page names, is measured with the paper's"
            f" {len(table['gains'])} pairs of gains. Each model, linear (Lm) or with varying damping (NLm), is"
            " identified from one of these runs; averaged over all, it misses this share of the step:"
            f" {'; '.join(averages)}.",
            f"The page: {folder}/report.html; its numbers: {folder}/results.json.",
        ),
        tables=(_designs(results["design"]["sampled"]),),
    )


def hidden_summary(results: Mapping[str, Any]) -> Summary:
    """Tell what was found of the axis whose lack was hidden, what the gains do on it, and the lights at the end.

    Parameters
    ----------
    results : mapping
        The fields of ``servolens.demo/1``.
    """
    found = results["hidden"]
    hidden = listed([spoken(name) for name in found["truth"]["effects"]])
    causes = [spoken(cause["effect"]) for cause in (found["diagnosis"] or {"causes": ()})["causes"]]
    sentences = [
        f"Hidden by the laboratory: {hidden}. Found from {len(found['records'])} records:"
        f" {listed(causes) if causes else 'nothing'}."
    ]
    if found["recommended"] is not None:
        asked = number(found["spec"]["settling_time"])
        sentences.append(f"Recommended: kp = {number(found['kp'])}, kd = {number(found['recommended']['kd'])}.")
        sentences += [
            f"On the true axis the {run['gain']} gain, kd = {number(run['kd'])},"
            f" {_settles(run['settling_time'])}; asked: {asked} s."
            for run in found["on_axis"]
        ]
    lights = (f"{name.capitalize()}: {found[name]['light']}. {found[name]['sentence']}" for name in LIGHTS)
    return Summary(title="A second axis with a hidden effect", sentences=(*sentences, *lights))


def _settles(time: float | None) -> str:
    return "does not settle" if time is None else f"settles in {number(time)} s"


def _designs(comparisons: Mapping[str, Any]) -> Table:
    rows = []
    for name, comparison in comparisons.items():
        linear, nonlinear = comparison["linear"], comparison["nonlinear"]
        on = linear["on_nonlinear"] or {"settling_time": None, "meets": False}
        rows.append(
            (
                name,
                _gain(linear["kd"]),
                number(on["settling_time"]),
                "yes" if on["meets"] else "no",
                _gain(nonlinear["kd"]),
                number(nonlinear["settling_time"]),
            )
        )
    return Table(
        title="Least kd for the demo's specification, from each record",
        columns=("Record", "Linear kd", "takes [s]", "Meets", "Nonlinear kd", "takes [s]"),
        rows=tuple(rows),
        note="Both gains are run on the nonlinear model.",
    )


def _gain(kd: float | None) -> str:
    return "–" if kd is None else number_up(kd)
