"""From a diagnosis to its figures: simulates, scales, thins; :mod:`plots_diagnosis` draws."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.diagnosis.errors import residual
from servolens.report.content import Drawing
from servolens.report.curves import curve
from servolens.report.laws import law_along
from servolens.report.plots import plot_curves
from servolens.report.plots_diagnosis import plot_candidates, plot_pieces, plot_record_errors, plot_shares
from servolens.report.style import COLOURS, INK, new_figure, styled
from servolens.report.svg import svg
from servolens.report.wording import shown
from servolens.summaries.diagnosis import spoken
from servolens.summaries.wording import number, scale, unit

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from servolens.diagnosis import Diagnosis
    from servolens.diagnosis.evidence import Instrument, Share
    from servolens.record import Record
    from servolens.report.curves import Curve, Role

__all__ = [
    "candidates_figure",
    "gains_figure",
    "instrument_figure",
    "instrument_sentence",
    "residuals_figure",
    "shares_figure",
    "telling_instrument",
]

MOST_RECORDS, MOST_CANDIDATES, MOST_SHARES = 8, 12, 6
TELLING = 0.1
"""By how much the share of the error in a range must exceed that of the samples to be stressed."""
CLEAR = 1e-3
"""Significance from which on an instrument is drawn."""
SHOWS = 0.7
"""Correlation of the pieces with the causes' law from which on it is drawn."""
SAYS_LITTLE = 6.0
"""Times the median standard error from which on a piece is left out of the picture."""
QUANTITIES = {
    "constant": "time",
    "direction": "direction of motion",
    "distance": "distance from zero",
    "frequency": "frequency",
    "position": "position",
    "speed": "speed",
    "time": "time of the record",
    "time_since_step": "time since the step",
    "velocity": "velocity",
    "voltage": "command",
    "voltage_size": "size of the command",
}
VARIES = {"damping": "damping", "force": "free force", "gain": "gain"}


@styled
def residuals_figure(key: str, diagnosis: Diagnosis) -> Drawing:
    """Draw what the simulation misses in each record, without and with the causes, two records abreast."""
    runs = [*((r, False) for r in diagnosis.records), *((r, True) for r in diagnosis.heldout)]
    drawn = runs if len(runs) <= MOST_RECORDS else [*runs[: MOST_RECORDS - 2], *runs[-2:]]
    columns = min(len(drawn), 2)
    rows = -(-len(drawn) // columns)
    figure = new_figure(1.75 * rows + 0.5)
    axes = figure.subplots(rows, columns, squeeze=False, sharey=True)
    before = [residual(diagnosis.linear.plant, record) for record, _ in drawn]
    factor, length = scale([float(np.abs(r).max()) for r in before], diagnosis.plant.length_unit)
    lost = []
    for i, (ax, (record, held)) in enumerate(zip(axes.flat, drawn, strict=False)):
        lost += [
            f"{label} on {shown(record.name)}" for label in _draw_residual(ax, record, before[i], factor, diagnosis)
        ]
        ax.set_title(f"{shown(record.name)}{' (held out)' if held else ''}")
        ax.set(xlabel="Time [s]" if i >= len(drawn) - columns else "")
    for spare in list(axes.flat)[len(drawn) :]:
        spare.remove()
    figure.supylabel(f"Simulated − measured [{length}]", fontsize=9.5)
    handles, labels = next((a.get_legend_handles_labels() for a in axes.flat if a.lines), ([], []))
    figure.legend(handles, labels, loc="outside upper center", ncols=3, handlelength=2.6)
    caption = "Simulated minus measured position"
    caption += ", without and with the causes" if diagnosis.causes else ", by the model of gain and damping"
    caption += "; in the green band it is noise. " + _which_are_held_out(diagnosis)
    if len(runs) > len(drawn):
        caption += f" {len(runs) - len(drawn)} more records are in the table only."
    if lost:
        caption += f" Not drawn, because the simulation leaves all bounds: {', '.join(lost)}."
    return Drawing(svg=svg(figure, key), caption=caption)


def _draw_residual(
    ax: Axes, record: Record, before: NDArray[np.float64], factor: float, diagnosis: Diagnosis
) -> list[str]:
    """Draw one record's panel; return the names of models whose simulation leaves all bounds."""
    models: list[tuple[str, Role, NDArray[np.float64]]] = [("gain and damping", "constant", before)]
    if diagnosis.causes:
        models.append(("with the causes", "velocity", residual(diagnosis.plant, record)))
    known = [(label, role, miss) for label, role, miss in models if np.isfinite(miss).all()]
    noise = 2.0 * factor * diagnosis.noise_floor
    ax.axhspan(-noise, noise, color=COLOURS["green"], alpha=0.22, linewidth=0, zorder=0, label="noise, ± 2 deviations")
    lines = [curve(label, record.time, factor * miss, role).thinned() for label, role, miss in known]
    plot_curves(lines, xlabel="", ylabel="", legend=False, zero_line=True, ax=ax)
    for line in ax.lines[1:]:  # errors are near noise, of which dashes make a blot
        line.set(linewidth=1.0, linestyle="-")
    return [label for label, *_ in models if label not in [name for name, *_ in known]]


@styled
def shares_figure(key: str, shares: Sequence[Share]) -> Drawing:
    """Draw of each measured quantity how error and samples are shared over its range."""
    drawn = shares[:MOST_SHARES]
    columns = min(len(drawn), 3)
    rows = -(-len(drawn) // columns)
    figure = new_figure(2.25 * rows + 0.35)
    axes = figure.subplots(rows, columns, squeeze=False)
    for i, (ax, share) in enumerate(zip(axes.flat, drawn, strict=False)):
        _draw_share(ax, share)
        if i % columns == 0:
            ax.set_ylabel("Share [%]")
    for spare in list(axes.flat)[len(drawn) :]:
        spare.remove()
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = [Patch(color=COLOURS["vermilion"]), Line2D([], [], color=INK)]
    figure.legend(handles, ["of the squared error", "of the samples"], loc="outside upper center", ncols=2)
    caption = (
        "Where the error of gain and damping alone arises. Of each quantity, bars are the share of the squared error in"
        " a part of its range, lines across them the share of the samples: were the error everywhere the same, bars"
        " would end at the lines. Full colour: the range whose bars exceed their lines most. From the training records."
    )
    return Drawing(svg=svg(figure, key), caption=caption)


def _draw_share(ax: Axes, share: Share) -> None:
    low, high, error, samples = np.array(share.bins).T
    worst = (low >= share.low) & (high <= share.high)
    name = QUANTITIES[share.quantity]
    title = f"{number(100 * share.share_of_error, 2)} % in {number(100 * share.share_of_samples, 2)} % of samples"
    if share.share_of_error - share.share_of_samples < TELLING:
        worst[:], title = False, "nowhere in particular"
    if share.quantity == "direction":
        names = {-1: "back", 0: "rest", 1: "forth"}
        ticks = [(i + 0.5, names[round(0.5 * (a + b))]) for i, (a, b) in enumerate(zip(low, high, strict=True))]
        xlabel = name.capitalize()
    else:
        factor, text = _scaled(high[-1] if abs(high[-1]) > abs(low[0]) else low[0], share.unit)
        edges = factor * np.append(low, high[-1])
        ends = np.flatnonzero(np.diff(worst, prepend=False, append=False)).tolist()
        ticks = [(float(place), _tick(edges, place)) for place in _apart([*ends, 0, worst.size], worst.size)]
        xlabel = f"{name.capitalize()} [{text}]"
    plot_shares(100 * error, 100 * samples, ticks, worst, xlabel=xlabel, title=title, ax=ax)
    ax.title.set_fontsize(9.0)


def _tick(edges: NDArray[np.float64], place: int) -> str:
    """Return an edge with the digits that the others leave it."""
    largest = float(np.abs(edges).max())
    return "0" if place == 0 and abs(edges[0]) < 1e-3 * largest else number(float(f"{edges[place]:.1e}"))


def _apart(places: Sequence[int], size: int) -> list[int]:
    """Return those of `places`, the first most welcome, whose numbers do not run into each other."""
    kept: list[int] = []
    for place in places:
        if all(abs(place - other) >= 0.2 * size for other in kept):
            kept.append(place)
    return sorted(kept)


def _scaled(largest: float, text: str) -> tuple[float, str]:
    """Return factor and unit in which lengths, angles and their speeds are easy to read."""
    length, slash, rest = text.partition("/")
    if length not in ("m", "rad"):
        return 1.0, text
    factor, name = scale([largest], length)
    return factor, f"{name}{slash}{rest}"


def telling_instrument(diagnosis: Diagnosis) -> tuple[Instrument | None, Curve | None]:
    """Return the instrument that shows the causes' law best, and that law; the clearest one where none shows it."""
    best = diagnosis.instruments[0] if diagnosis.instruments else None
    law, most = None, SHOWS
    for found in diagnosis.instruments if diagnosis.causes else ():
        said = law_along(diagnosis, found) if found.significance <= CLEAR else None
        if said is not None and (agreement := _agreement(found, said)) >= most:
            best, law, most = found, said, agreement
    return best, law


def _agreement(instrument: Instrument, law: Curve) -> float:
    """Return the correlation of the pieces with the law, those left out of which the data say little."""
    if instrument.goes_with == "constant":
        return abs(instrument.correlation)
    deviation = np.array(instrument.deviation)
    told = deviation <= SAYS_LITTLE * float(np.median(deviation))
    said = np.interp(np.array(instrument.abscissa)[told], law.x, law.y)
    return float(np.corrcoef(said, np.array(instrument.value)[told])[0, 1]) if np.ptp(said) > 0 else 0.0


def instrument_sentence(instrument: Instrument | None) -> str:
    """Say what the paper's own instrument shows."""
    if instrument is None:
        return "There are too few samples of motion to let damping, gain or a force vary in time."
    if instrument.significance > CLEAR:
        return (
            "Let vary in time, neither damping nor gain nor a free force goes with anything that was measured more than"
            " chance would have it."
        )
    if instrument.goes_with == "constant":
        start = "Without any catalogue: a constant force beside gain and damping"
        return f"{start} would make up for the error (correlation {_correlation(instrument)})."
    how = "rises" if instrument.correlation > 0 else "falls"
    if instrument.varies == "force":
        return (
            "Without any catalogue: a free force that would make up for the error"
            f" goes with the {QUANTITIES[instrument.goes_with]} (correlation {_correlation(instrument)})."
        )
    return (
        f"Without any catalogue: let vary in time, the {instrument.varies} {how} with the"
        f" {QUANTITIES[instrument.goes_with]} (correlation {_correlation(instrument)})."
    )


@styled
def instrument_figure(key: str, diagnosis: Diagnosis, instrument: Instrument, law: Curve | None) -> Drawing:
    """Draw what varies against the quantity it goes with, and the law that the causes say of it."""
    x, value, deviation = (np.array(values) for values in (instrument.abscissa, instrument.value, instrument.deviation))
    told = deviation <= SAYS_LITTLE * float(np.median(deviation))
    x, value, deviation = x[told], value[told], deviation[told]
    rest = int(np.count_nonzero(~told))
    factor, xlabel = _labelled(diagnosis, instrument, x)
    if law is not None:
        name = " and ".join(spoken(cause.effect) for cause in diagnosis.causes)
        law = curve(f"the model with {name}", factor * law.x, law.y, "velocity")
    held = {"damping": diagnosis.linear.plant.damping, "gain": diagnosis.linear.plant.gain, "force": 0.0}
    chance = f"{10.0 ** np.ceil(np.log10(max(instrument.significance, 1e-12))):.0e}".replace("e-0", "e-")
    title = f"correlation {_correlation(instrument)}, by chance less than once in {_times(float(chance))}"
    figure = new_figure(3.2)
    plot_pieces(
        factor * x,
        value,
        deviation,
        xlabel=xlabel,
        ylabel=_varying_label(diagnosis, instrument),
        law=law,
        held=held[instrument.varies],
        title=title[0].upper() + title[1:],
        ax=figure.add_subplot(),
    )
    caption = (
        f"The {VARIES[instrument.varies]} that each of a few pieces of every motion needs in the integral equation,"
        f" against the mean {QUANTITIES[instrument.goes_with]} there. No effect was assumed; gain and damping are those"
        " that suit it best. From the training records."
    )
    if rest:
        caption += f" {rest} pieces of which the data say little are left out."
    if law is not None:
        caption += " The blue line was not fitted to these points: it is what the model with its causes says."
    return Drawing(svg=svg(figure, key), caption=caption)


def _labelled(diagnosis: Diagnosis, instrument: Instrument, x: NDArray[np.float64]) -> tuple[float, str]:
    length, name = diagnosis.plant.length_unit, instrument.goes_with
    units = {"speed": f"{length}/s", "velocity": f"{length}/s", "position": length, "distance": length}
    units |= {"time": "s", "time_since_step": "s", "constant": "s"}
    units |= {"voltage": diagnosis.plant.command_unit, "voltage_size": diagnosis.plant.command_unit}
    title = QUANTITIES[name][0].upper() + QUANTITIES[name][1:]
    if name == "direction":
        return 1.0, f"{title}: back −1, forth 1"
    factor, text = _scaled(float(np.abs(x).max()), units[name])
    return factor, f"Mean {title.lower()} [{text}]"


def _varying_label(diagnosis: Diagnosis, instrument: Instrument) -> str:
    length = diagnosis.plant.length_unit
    if instrument.varies == "damping":
        return "Damping [1/s]"
    if instrument.varies == "gain":
        return f"Gain [{unit(diagnosis.plant.unit('gain'))}]"
    return f"Force against\npositive motion [{length}/s²]"


def _correlation(instrument: Instrument) -> str:
    """Return the correlation with two digits, or as many as keep it from 1."""
    r = instrument.correlation
    text = f"{r:.2f}" if abs(r) < 0.995 else f"{np.clip(r, -0.999, 0.999):.3f}"
    return text.replace("-", "−")


def _times(chance: float) -> str:
    """Return one over `chance` in words."""
    times = 1.0 / chance
    for size, word in ((1e12, "million million"), (1e9, "thousand million"), (1e6, "million"), (1e3, "thousand")):
        if times >= 0.999 * size:
            return f"{number(round(times / size), 3)} {word}".replace("1 ", "a ", 1)
    return number(times, 3)


@styled
def candidates_figure(key: str, diagnosis: Diagnosis) -> Drawing:
    """Draw what single effects leave, and the answer."""
    chosen = {cause.effect for cause in diagnosis.causes}
    best: dict[str, float] = {}
    for candidate in diagnosis.candidates:
        name = candidate.effects[-1]
        best[name] = min(candidate.error, best.get(name, np.inf))
    ranked = sorted(best.items(), key=lambda pair: pair[1])
    rows = [(spoken(name), error, chosen == {name}) for name, error in ranked[:MOST_CANDIDATES]]
    if len(chosen) > 1:
        together = " and ".join(spoken(cause.effect) for cause in diagnosis.causes)
        rows.insert(0, (shown(together, 60), diagnosis.extended.rms_error, True))
    rows = [row for row in rows if np.isfinite(row[1]) and row[1] > 0]
    factor, length = scale([max(error for _, error, _ in rows)], diagnosis.plant.length_unit)
    figure = new_figure(0.25 * len(rows) + 1.0)
    plot_candidates(
        [name[0].upper() + name[1:] for name, *_ in rows],
        np.array([factor * error for _, error, _ in rows]),
        [answer for *_, answer in rows],
        floor=factor * max(diagnosis.noise_floor, 1e-300),
        xlabel=f"R.m.s. error left in the training records [{length}], logarithmic",
        ax=figure.add_subplot(),
    )
    caption = "What is left when one effect is added to gain and damping, the best first; bold: the answer."
    rest = len(ranked) - MOST_CANDIDATES
    if rest > 0:
        caption += f" {rest} more effects leave more: those that do not help leave what gain and damping leave."
    caption += " Fitted to these very records, not held out; driven by their voltage."
    return Drawing(svg=svg(figure, key), caption=caption)


@styled
def gains_figure(key: str, diagnosis: Diagnosis) -> Drawing:
    """Draw each record's error without and with the causes."""
    gains = diagnosis.gains
    if len(gains) > 3 * MOST_RECORDS:  # those held out come last
        gains = (*gains[:MOST_RECORDS], *gains[-2 * MOST_RECORDS :])
    factor, length = scale([g.before for g in gains if np.isfinite(g.before)], diagnosis.plant.length_unit)
    figure = new_figure(0.3 * len(gains) + 1.2)
    before, after, noise = (
        _positive([factor * getattr(g, name) for g in gains]) for name in ("before", "after", "noise")
    )
    plot_record_errors(
        [f"{shown(g.name)}{', held out' if g.heldout else ''}" for g in gains],
        before,
        after,
        noise,
        np.array([g.heldout for g in gains]),
        xlabel=f"R.m.s. error [{length}], logarithmic",
        ax=figure.add_subplot(),
    )
    caption = "Error of each record without and with the causes, and its noise. Filled marks are of held-out data: "
    if diagnosis.heldout:
        caption += "the record took no part in fit and choice."
    elif len(diagnosis.records) > 1:
        caption += "the record by models that were fitted without it."
    else:
        caption += "the record's end by models that were fitted to its beginning."
    if len(diagnosis.gains) > len(gains):
        caption += f" {len(diagnosis.gains) - len(gains)} more are in the table only."
    return Drawing(svg=svg(figure, key), caption=caption)


def _positive(values: Sequence[float]) -> NDArray[np.float64]:
    found = np.array(values)
    return np.where(np.isfinite(found) & (found > 0), found, np.nan)


def _which_are_held_out(diagnosis: Diagnosis) -> str:
    if diagnosis.heldout:
        return "Records marked as held out took no part in fit and choice."
    return "Both models were fitted to these very records."
