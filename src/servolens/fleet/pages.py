"""The pages of a fleet: one of all axes, and a small one for each, a click away. They load nothing."""

from __future__ import annotations

import json
import math
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from servolens import __version__
from servolens.fleet.axis_page import axis_content
from servolens.fleet.drift import days
from servolens.fleet.rows import parameters_of
from servolens.fleet.store import PAGES_FOLDER, RESULTS
from servolens.model import NORMAL_95
from servolens.reading.files import printable
from servolens.results import write_atomically
from servolens.summaries.names import spoken, spoken_parameter
from servolens.summaries.wording import number

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from jinja2 import Environment

    from servolens.fleet.axes import Axis
    from servolens.fleet.drift import Drift
    from servolens.fleet.result import Fleet

    Progress = Callable[[str, int, int], None]

__all__ = ["write_pages"]

FOLDER = Path(__file__).parent
MOST_SPREADS, MOST_HISTORIES, MOST_OUTLIERS = 24, 12, 60
"""What a page shows of each; the rest stands in the tables."""
FEWEST_VALUES = 3
DAYS_A_YEAR = 365.25


def write_pages(fleet: Fleet, *, progress: Progress = lambda _what, _done, _total: None) -> Path:
    """Write ``fleet.html`` and a page for each axis into the folder of the results.

    Returns
    -------
    Path
        Of ``fleet.html``.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    environment = _environment()
    _write_axes(fleet, environment, progress)
    progress("Drawing the fleet", 0, 0)
    page = fleet.out / "fleet.html"
    drifts = fleet.drifts
    write_atomically(
        page,
        environment.get_template("fleet.html")
        .render(
            title=f"Fleet {printable(fleet.folder.resolve().name)}",
            made=_made(),
            lead=_lead(fleet),
            fleet=fleet,
            causes=_causes_figure(fleet),
            spreads=_spreads_figure(fleet),
            spread_note=_spread_note(fleet),
            drifting=[_drift_row(drift, fleet) for drift in drifts if drift.drifts],
            tested=len(drifts),
            histories=_histories_figure(drifts),
            outliers=[_outlier_row(one, fleet) for one in fleet.outliers[:MOST_OUTLIERS]],
            more_outliers=max(len(fleet.outliers) - MOST_OUTLIERS, 0),
            rows=[_axis_row(axis, row) for axis, row in zip(fleet.axes, fleet.rows, strict=True)],
        )
        .encode("utf-8", "replace"),
        durable=True,
    )
    return page


def _environment() -> Environment:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    return Environment(loader=FileSystemLoader(FOLDER), autoescape=True, undefined=StrictUndefined, trim_blocks=True)


def _write_axes(fleet: Fleet, environment: Environment, progress: Progress) -> None:
    template = environment.get_template("axis.html")
    others: dict[str, list[Axis]] = {}
    for axis in fleet.axes:
        others.setdefault(axis.name, []).append(axis)
    for done, axis in enumerate(fleet.axes):
        progress("Writing pages", done, len(fleet.axes))
        result = json.loads((fleet.out / RESULTS / f"{axis.key}.json").read_text(encoding="utf-8"))
        dates = [(one.measured, f"{quote(one.key)}.html") for one in others[axis.name] if one is not axis]
        text = template.render(
            title=axis.label, made=_made(), dates=dates, data=f"../{RESULTS}/{quote(axis.key)}.json",
            **axis_content(result),
        )  # fmt: skip
        write_atomically(fleet.out / PAGES_FOLDER / f"{axis.key}.html", text.encode("utf-8", "replace"))


def _made() -> str:
    return f"Made by servolens {__version__} on {datetime.now(UTC):%Y-%m-%d %H:%M} UTC."


def _lead(fleet: Fleet) -> str:
    """Return the most important sentence."""
    studies, axes = len(fleet.rows), len({axis.name for axis in fleet.axes})
    what = f"{axes} axes" if studies == axes else f"{studies} studies of {axes} axes"
    given = sum(row["recommended_kd"] is not None or row["kd"] is not None for row in fleet.rows)
    told = f"{what}: {given} with a gain"
    failed = len(fleet.failed)
    return f"{told}, {failed} could not be studied." if failed else f"{told}; every one could be studied."


def _causes_figure(fleet: Fleet) -> str:
    from servolens.report.plots_fleet import plot_counts
    from servolens.report.svg import svg

    named = {spoken(name): count for name, count in fleet.causes.items()}
    return svg(plot_counts(named).figure, "causes") if named else ""  # type: ignore[arg-type] # of no sub-figure


def _spreads_figure(fleet: Fleet) -> str:
    from servolens.report.plots_fleet import Spread, spreads_svg

    far = {(one.parameter, one.unit, one.value) for one in fleet.outliers}
    spreads = [
        Spread(
            label=_label(name, unit),
            values=tuple(value for _, value, _ in those),
            far=tuple(value for _, value, _ in those if (name, unit, value) in far),
        )
        for (name, unit), those in _shown_parameters(fleet)[:MOST_SPREADS]
    ]
    return spreads_svg(spreads, "spreads") if spreads else ""


def _spread_note(fleet: Fleet) -> str:
    left = len(_shown_parameters(fleet)) - MOST_SPREADS
    return f"{left} parameters more are in the table." if left > 0 else ""


def _shown_parameters(fleet: Fleet) -> list[tuple[tuple[str, str], Any]]:
    """Return parameters with enough values for a picture; those that most studies have first."""
    enough = [item for item in parameters_of(fleet.rows).items() if len(item[1]) >= FEWEST_VALUES]
    return sorted(enough, key=lambda item: -len(item[1]))


def _histories_figure(drifts: Sequence[Drift]) -> str:
    from servolens.report.plots_fleet import History, histories_svg

    histories = []
    for drift in [drift for drift in drifts if drift.drifts][:MOST_HISTORIES]:
        time = days(drift.measured)
        middle, line = float(time.mean()), drift.trend
        ends = (line.level + line.slope * (time[0] - middle), line.level + line.slope * (time[-1] - middle))
        histories.append(
            History(
                title=printable(drift.axis),
                label=_label(drift.parameter, drift.unit),
                days=tuple(time.tolist()),
                values=drift.values,
                errors=tuple(math.nan if e is None else NORMAL_95 * e for e in drift.errors),
                line=ends,
            )
        )
    return histories_svg(histories, "histories") if histories else ""


def _drift_row(drift: Drift, fleet: Fleet) -> tuple[str, ...]:
    """Return link, axis, parameter, change per year, relative change over the time, p."""
    last = max(zip(fleet.axes, strict=True), key=lambda one: (one[0].name == drift.axis, one[0].measured))[0]
    slope, error = drift.trend.slope * DAYS_A_YEAR, drift.trend.stderr * DAYS_A_YEAR
    span = float(days(drift.measured)[-1]) * drift.trend.slope
    share = f"{100 * span / abs(drift.trend.level):+.1f} %" if drift.trend.level else "–"
    p = "less than 1e-10" if drift.trend.p < 1e-10 else f"{drift.trend.p:.2g}"
    change = f"{number(slope)} ± {number(error, 2)} {drift.unit} per year"
    days_told = f"{len(drift.measured)} dates, {drift.measured[0][:10]} to {drift.measured[-1][:10]}"
    return (_link(last), printable(drift.axis), _label(drift.parameter), change, share, p, days_told)


def _outlier_row(one: Any, fleet: Fleet) -> tuple[str, ...]:
    axis = next(a for a in fleet.axes if (a.name, a.measured) == (one.axis, one.measured))
    distance = f"{one.distance:+.1f}" if math.isfinite(one.distance) else "all others are equal"
    value, median = f"{number(one.value)} {one.unit}", f"{number(one.median)} {one.unit}"
    return (_link(axis), axis.label, _label(one.parameter), value, median, distance)


def _axis_row(axis: Axis, row: Any) -> dict[str, Any]:
    causes = [spoken(name) for name in str(row["causes"] or "").split("; ") if name]
    unit = f"{row['command_unit']} s/{row['length_unit']}"
    kd = row["recommended_kd"]
    done = row["status"] == "done"
    return {
        "link": _link(axis),
        "label": axis.label,
        "status": row["status"],
        "lights": [row[f"{name}_light"] or "red" for name in ("data", "model", "gain")] if done else [],
        "verdict": str(row["verdict"] or "").replace("_", " "),
        "causes": ", ".join(causes),
        "kd": f"{number(kd)} {unit}" if kd is not None else "–",
        "sentence": printable(str(row["sentence"] or "")),
    }


def _link(axis: Axis) -> str:
    return f"{PAGES_FOLDER}/{quote(axis.key)}.html"


def _label(name: str, unit: str = "") -> str:
    """Return a parameter as people say it, with its unit in brackets."""
    effect, _, parameter = name.rpartition(".")
    text = f"{spoken(effect)}: {spoken_parameter(parameter)}" if effect else spoken_parameter(parameter)
    text = text[:1].upper() + text[1:]
    return f"{text} [{unit}]" if unit else text
