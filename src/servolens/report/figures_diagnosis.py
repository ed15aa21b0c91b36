"""From a diagnosis to its figures: simulates, scales, thins; :mod:`plots_diagnosis` draws."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.report.curves import curve
from servolens.report.drawing import drawing, keys_from, legend_of
from servolens.report.figure_data import Numbers
from servolens.report.laws import law_along
from servolens.report.plots_diagnosis import plot_candidates, plot_pieces, plot_record_errors, plot_shares
from servolens.report.style import COLOURS, INK, NAMED, THIRD_WIDTH, WIDE, new_figure, panel_figure, styled
from servolens.report.wording import shown
from servolens.summaries.diagnosis_tables import data_kinds, kinds_sentence
from servolens.summaries.evidence import CLEAR, QUANTITIES, correlation
from servolens.summaries.names import spoken
from servolens.summaries.wording import capital, minus, number, scale, unit

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from servolens.diagnosis import Diagnosis
    from servolens.diagnosis.evidence import Instrument, Share
    from servolens.diagnosis.result import Candidate
    from servolens.report.content import Drawing
    from servolens.report.curves import Curve

__all__ = [
    "candidates_figure",
    "edge_text",
    "errors_figure",
    "instrument_figure",
    "shares_figure",
    "telling_instrument",
]

MOST_ROWS, MOST_CANDIDATES, MOST_SHARES = 24, 12, 6
SHARE_STRESSED = 0.1
"""By how much the share of the error in a range must exceed that of the samples to be stressed."""
SHOWS = 0.7
"""Correlation of the pieces with the causes' law from which on it is drawn."""
SAYS_LITTLE = 6.0
"""Times the median standard error from which on a piece is left out of the picture."""
VARIES = {"damping": "damping", "force": "free force", "gain": "gain"}


@styled
def shares_figure(key: str, shares: Sequence[Share]) -> Drawing:
    """Draw of each measured quantity how error and samples are shared over its range."""
    drawn = sorted(shares, key=lambda share: share.quantity == "frequency")[:MOST_SHARES]
    figures = []
    for share in drawn:
        figure, ax = panel_figure(2.2, THIRD_WIDTH, 0.55)
        _draw_share(ax, share)
        figures.append(figure)
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    caption = (
        "Where the error of gain and damping alone arises. Bars: share of the squared error in each part of a"
        " quantity's range; lines: share of the samples. Were the error the same everywhere, bars would end at the"
        " lines. Full colour: where they exceed them most. Training records, not held out."
    )
    handles = {"of the squared error": Patch(color=COLOURS["vermilion"]), "of the samples": Line2D([], [], color=INK)}
    rows = [
        (f"{capital(QUANTITIES[share.quantity])} [{share.unit}]", *(float(v) for v in row))
        for share in drawn
        for row in share.bins
    ]
    columns = ("Quantity", "From", "To", "Share of the squared error", "Share of the samples")
    return drawing(key, figures, caption, legend=keys_from(handles), table=Numbers(columns=columns, rows=rows))


def _draw_share(ax: Axes, share: Share) -> None:
    low, high, error, samples = np.array(share.bins).T
    worst = (low >= share.low) & (high <= share.high)
    name = QUANTITIES[share.quantity]
    of_error, of_samples = 100 * share.share_of_error, 100 * share.share_of_samples
    title = f"{number(of_error, 2)} % in {number(of_samples, 2 if of_samples >= 1 else 1)} % of samples"
    if share.share_of_error - share.share_of_samples < SHARE_STRESSED:
        worst[:], title = False, "nowhere in particular"
    if share.quantity == "direction":
        names = {-1: "backward", 0: "rest", 1: "forward"}
        ticks = [(i + 0.5, names[round(0.5 * (a + b))]) for i, (a, b) in enumerate(zip(low, high, strict=True))]
        xlabel = name.capitalize()
    else:
        factor, text = _scaled(high[-1] if abs(high[-1]) > abs(low[0]) else low[0], share.unit)
        edges = factor * np.append(low, high[-1])
        ends = np.flatnonzero(np.diff(worst, prepend=False, append=False)).tolist()
        welcome = dict.fromkeys([*ends, 0, worst.size])
        ticks = [(float(place), edge_text(edges, place)) for place in welcome]
        xlabel = f"{name.capitalize()} [{text}]"
    plot_shares(100 * error, 100 * samples, ticks, worst, xlabel=xlabel, title=title, ax=ax)
    ax.set_ylabel("Share [%]")
    ax.title.set_fontsize(8.0)


def edge_text(edges: NDArray[np.float64], place: int) -> str:
    """Return an edge with the digits that the others leave it."""
    largest = float(np.abs(edges).max())
    nothing = 1e-3 if place == 0 else 1e-9  # inside, no more than rounding of the log
    text = "0" if abs(edges[place]) < nothing * largest else number(float(f"{edges[place]:.1e}"))
    return minus(text)


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
    level = f"{10.0 ** np.ceil(np.log10(max(instrument.significance, 1e-12))):.0e}".replace("e-0", "e-")
    title = f"correlation r = {correlation(instrument)}, p < {level}"
    figure = new_figure(3.0, WIDE)  # its numbers may have any width
    ax = figure.add_subplot()
    plot_pieces(
        factor * x,
        value,
        deviation,
        xlabel=xlabel,
        ylabel=_varying_label(diagnosis, instrument),
        law=law,
        held=held[instrument.varies],
        title=capital(title),
        ax=ax,
    )
    if instrument.goes_with == "direction":
        ax.set_xticks([-1, 0, 1], ["backward", "turns round", "forward"])
    caption = (
        f"Every motion is cut into pieces. Points: the {VARIES[instrument.varies]} that each piece needs to be as"
        f" measured, against the mean {QUANTITIES[instrument.goes_with]} there; no effect is assumed, and gain and"
        " damping are free. Training records, not held out."
    )
    if rest:
        caption += f" {rest} pieces of which the data say little are left out."
    if law is not None:
        caption += " The blue line was not fitted to these points: it is what the model with its causes says."
    columns = (ax.get_xlabel(), " ".join(ax.get_ylabel().split()), "Standard error")
    rows = [(float(a), float(b), float(c)) for a, b, c in zip(factor * x, value, deviation, strict=True)]
    return drawing(key, figure, caption, legend=legend_of(ax), table=Numbers(columns=columns, rows=rows))


def _labelled(diagnosis: Diagnosis, instrument: Instrument, x: NDArray[np.float64]) -> tuple[float, str]:
    length, name = diagnosis.plant.length_unit, instrument.goes_with
    units = {"speed": f"{length}/s", "velocity": f"{length}/s", "position": length, "distance": length}
    units |= {"time": "s", "time_since_step": "s", "constant": "s"}
    units |= {"voltage": diagnosis.plant.command_unit, "voltage_size": diagnosis.plant.command_unit}
    title = capital(QUANTITIES[name])
    if name == "direction":
        return 1.0, f"Mean {title.lower()}"
    factor, text = _scaled(float(np.abs(x).max()), units[name])
    return factor, f"Mean {title.lower()} [{text}]"


def _varying_label(diagnosis: Diagnosis, instrument: Instrument) -> str:
    length = diagnosis.plant.length_unit
    if instrument.varies == "damping":
        return "Damping [1/s]"
    if instrument.varies == "gain":
        return f"Gain [{unit(diagnosis.plant.unit('gain'))}]"
    return f"Force against forward\nmotion, by mass [{length}/s²]"


@styled
def candidates_figure(key: str, diagnosis: Diagnosis) -> Drawing:
    """Draw what single effects leave, and the answer."""
    chosen = {cause.effect for cause in diagnosis.causes}
    best: dict[str, Candidate] = {}
    for candidate in sorted(diagnosis.candidates, key=lambda candidate: candidate.error):
        best.setdefault(candidate.effects[-1], candidate)
    order = [name for name in best if name not in chosen][: MOST_CANDIDATES - len(chosen & set(best))]
    shown = [(name, candidate) for name, candidate in best.items() if name in chosen or name in order]
    rows = [(capital(spoken(name)), c.error, name in chosen) for name, c in shown]
    rows = [row for row in rows if np.isfinite(row[1]) and row[1] > 0]
    names, errors, answers = zip(*rows, strict=True)
    factor, length = scale([max(errors)], diagnosis.plant.length_unit)
    figure = new_figure(0.25 * len(rows) + 0.7, NAMED)
    ax = figure.add_subplot()
    plot_candidates(
        names,
        factor * np.array(errors),
        answers,
        floor=factor * max(diagnosis.noise_floor, 1e-300),
        xlabel=f"R.m.s. error left [{length}], logarithmic",
        ax=ax,
    )
    caption = "What is left in the training records when one effect is added to gain and damping, the best first."
    caption += _answer_told(chosen)
    if len(chosen) == 1 and not rows[0][2]:
        caption += " Others leave a smaller error with more parameters, or follow the noise."
    rest = len(best) - len(shown)
    if rest > 0:
        caption += f" {rest} more effects were tried."
    caption += " Not held out. Driven by the logged voltage, with the noise estimated anew for each effect"
    caption += "; of a shaken axis, of the simulated loop." if any(c.shaken for _, c in shown) else "."
    left = [(name, float(factor * error)) for name, error in zip(names, errors, strict=True)]
    table = Numbers(columns=("Effect", f"R.m.s. error left [{length}]"), rows=left)
    return drawing(key, figure, caption, legend=legend_of(ax), table=table)


def _answer_told(causes: set[str]) -> str:
    """Say what stands in bold among the effects that were tried one by one."""
    if not causes:
        return " None reduces the error enough to be a cause."
    if len(causes) == 1:
        return " Bold: the answer."
    return " Bold: the causes, each by itself here; together they leave less."


@styled
def errors_figure(key: str, diagnosis: Diagnosis) -> Drawing:
    """Draw each record's error without and with the causes."""
    rows = [*zip(diagnosis.gains, data_kinds(diagnosis), strict=True)]
    if len(rows) > MOST_ROWS:  # those held out come last
        rows = [*rows[: MOST_ROWS // 3], *rows[-2 * MOST_ROWS // 3 :]]
    gains = [gain for gain, _ in rows]
    factor, length = scale([g.before for g in gains if np.isfinite(g.before)], diagnosis.plant.length_unit)
    figure = new_figure(0.3 * len(gains) + 0.8, NAMED)
    ax = figure.add_subplot()
    before, after, noise = (
        _positive([factor * getattr(g, name) for g in gains]) for name in ("before", "after", "noise")
    )
    plot_record_errors(
        [f"{shown(gain.name)}, {kind}" for gain, kind in rows],
        before,
        after,
        noise,
        np.array([g.heldout for g in gains]),
        xlabel=f"R.m.s. error [{length}], logarithmic",
        ax=ax,
    )
    caption = (
        "Error of each record without and with the causes, and its noise. Hollow: the model was fitted to these data."
    )
    caption += f" Filled: it was not. {kinds_sentence(diagnosis)}"
    if len(diagnosis.gains) > len(gains):
        caption += f" {len(diagnosis.gains) - len(gains)} more are in the table only."
    columns = ("Record", "Data", *(f"{what} [{length}]" for what in ("Gain and damping", "With the causes", "Noise")))
    numbers = zip(before, after, noise, strict=True)
    told = [(gain.name, kind, *map(float, row)) for (gain, kind), row in zip(rows, numbers, strict=True)]
    return drawing(key, figure, caption, legend=legend_of(ax), table=Numbers(columns=columns, rows=told))


def _positive(values: Sequence[float]) -> NDArray[np.float64]:
    found = np.array(values)
    return np.where(np.isfinite(found) & (found > 0), found, np.nan)
