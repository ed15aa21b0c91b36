"""What the studies of a fleet say."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from servolens.reading.files import printable
from servolens.summaries.names import spoken, spoken_parameter
from servolens.summaries.wording import number
from servolens.summary import Summary, Table

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["fleet_summary"]

MOST_TABLE_ROWS = 10
"""Rows of each table."""


def fleet_summary(body: Mapping[str, Any]) -> Summary:
    """Tell of a fleet.

    Parameters
    ----------
    body : mapping
        Fields of ``servolens.fleet/1``.
    """
    tables = [one for one in (_causes(body), _drifts(body), _failures(body)) if one.rows]
    return Summary(title="Fleet", sentences=_sentences(body), tables=tuple(tables))


def _sentences(body: Mapping[str, Any]) -> tuple[str, ...]:
    studies, axes = body["studies"], body["axes"]
    kept = studies - body["studied_now"]
    what = f"{axes} axes" if studies == axes else f"{studies} studies of {axes} axes"
    told = [f"{what}; {kept} {'was' if kept == 1 else 'were'} finished before." if kept else f"{what}."]
    failed = studies - body["status"].get("done", 0)
    lights = body["lights"]["gain"]
    counted = ", ".join(f"{lights.get(name, 0)} {name}" for name in ("green", "amber", "red"))
    told.append(f"Light of the gain: {counted}." + (f" Not studied: {failed}." if failed else ""))
    drifting = sum(drift["drifts"] for drift in body["drifts"])
    if body["drifts"]:
        told.append(f"{drifting} of {len(body['drifts'])} parameters followed over dates drift significantly.")
    if body["outliers"]:
        told.append(f"{len(body['outliers'])} values lie far from those of the other axes.")
    return tuple(told)


def _causes(body: Mapping[str, Any]) -> Table:
    rows = [(spoken(name), str(count)) for name, count in list(body["causes"].items())[:MOST_TABLE_ROWS]]
    return Table(title="Causes", columns=("Cause", "Studies"), rows=tuple(rows))


def _drifts(body: Mapping[str, Any]) -> Table:
    rows = [
        (printable(one["axis"]), _parameter(one["parameter"]), f"{number(one['slope']['value'])}", one["slope"]["unit"],
         f"{one['p']:.1g}")
        for one in body["drifts"] if one["drifts"]
    ]  # fmt: skip
    return Table(title="Drift", columns=("Axis", "Parameter", "Slope", "Unit", "p"), rows=tuple(rows[:MOST_TABLE_ROWS]))


def _failures(body: Mapping[str, Any]) -> Table:
    rows = [
        (printable(_label(row)), printable(str(row["sentence"] or "")))
        for row in body["rows"]
        if row["status"] != "done"
    ]
    note = f"{len(rows) - MOST_TABLE_ROWS} more are on the page." if len(rows) > MOST_TABLE_ROWS else ""
    return Table(title="Not studied", columns=("Axis", "Why"), rows=tuple(rows[:MOST_TABLE_ROWS]), note=note)


def _label(row: Mapping[str, Any]) -> str:
    return f"{row['axis']}, {row['measured']}" if row["measured"] else str(row["axis"])


def _parameter(name: str) -> str:
    effect, _, parameter = name.rpartition(".")
    return f"{spoken(effect)}: {spoken_parameter(parameter)}" if effect else parameter
