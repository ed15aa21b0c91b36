"""What the records say before any effect is assumed: where the error arises, and what a missing force depends on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.summaries.wording import listed, minus, number, prefixed

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.diagnosis.evidence import Instrument, Share

__all__ = [
    "CLEAR",
    "QUANTITIES",
    "correlation",
    "instrument_sentence",
    "reach_sentence",
    "where_phrase",
]

CLEAR = 1e-3
"""Significance from which on an instrument says something."""
SHARE_WORTH_A_SENTENCE = 0.2
"""By how much the share of the error in a range must exceed its share of the samples to be worth a sentence."""
MOST_SAMPLES = 0.5
"""Share of the samples in a range from which on it tells nobody where to look."""
NARROW, PEAK = 2, 0.7
"""Neighbouring bins in which so much of the error is one frequency; that it is slow, every error of a loop is."""
QUANTITY_ORDER = ("speed", "direction", "position", "time_since_step", "voltage")
"""Quantities by how much they tell people; the first is taken of those that come close to the best."""
CLOSE_TO_BEST = 0.2
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


def where_phrase(shares: Sequence[Share]) -> str:
    """Return what part of the error arises in which range of a measured quantity; empty if it arises everywhere."""
    places = [share for share in shares if share.quantity in QUANTITY_ORDER]
    narrow = [share for share in places if share.share_of_samples <= MOST_SAMPLES]
    telling = [share for share in narrow if share.share_of_error - share.share_of_samples >= SHARE_WORTH_A_SENTENCE]
    if not telling:
        return "".join(_peak(share) for share in shares if share.quantity == "frequency")
    most = max(share.share_of_error - share.share_of_samples for share in telling)
    close = [share for share in telling if share.share_of_error - share.share_of_samples >= most - CLOSE_TO_BEST]
    share = min(close, key=lambda share: QUANTITY_ORDER.index(share.quantity))
    return f"{number(100 * share.share_of_error, 2)} % of the error arises {_range(share)}"


def instrument_sentence(instrument: Instrument | None) -> str:
    """Say what the time-varying estimate shows."""
    if instrument is None:
        return "There are too few samples of motion to let damping, gain or a force vary in time."
    if instrument.significance > CLEAR:
        return (
            "Model-free check: neither a damping nor a gain that varies in time nor a missing force correlates"
            " significantly with anything that was measured."
        )
    start, how_much = "Model-free check:", f"(r = {correlation(instrument)})"
    if instrument.goes_with == "constant":
        return f"{start} the missing force is about the same everywhere."
    quantity = QUANTITIES[instrument.goes_with]
    if instrument.varies == "force":
        return f"{start} the missing force correlates with the {quantity} {how_much}."
    how = "rises" if instrument.correlation > 0 else "falls"
    return f"{start} the {instrument.varies}, estimated piece by piece in time, {how} with the {quantity} {how_much}."


def correlation(instrument: Instrument) -> str:
    """Return the correlation with two digits, or as many as keep it from 1."""
    r = instrument.correlation
    text = f"{r:.2f}" if abs(r) < 0.995 else f"{np.clip(r, -0.999, 0.999):.3f}"
    return minus(text)


def reach_sentence(shares: Sequence[Share]) -> str:
    """Say what the training records cover, beyond which nothing can have shown; empty if that is not known."""
    found = {share.quantity: share for share in shares}
    reached = []
    for name, text in (("speed", "speeds up to"), ("position", "positions"), ("voltage", "commands")):
        if name not in found:
            continue
        low, high = found[name].bins[0][0], found[name].bins[-1][1]
        factor, unit_ = prefixed([low, high], found[name].unit)
        ends = (
            [number(factor * high, 2)] if name == "speed" else [minus(number(factor * end, 2)) for end in (low, high)]
        )
        reached.append(f"{text} {' to '.join(ends)} {unit_}")
    if not reached:
        return ""
    return f"The records cover {listed(reached)}; what acts only beyond that was not observed."


def _range(share: Share) -> str:
    """Return a range of a measured quantity as people say it."""
    factor, unit_ = prefixed([share.low, share.high], share.unit)
    low, high = (minus(number(factor * end, 2)) for end in (share.low, share.high))
    is_next_to_none = share.quantity == "speed" and share.low < 0.01 * share.high
    from_start, to_end = share.low <= share.bins[0][0] or is_next_to_none, share.high >= share.bins[-1][1]
    if share.quantity == "direction":
        return _way(share)
    if share.quantity == "time_since_step":
        return (
            f"in the first {high} {unit_} after the step" if from_start else f"{low} to {high} {unit_} after the step"
        )
    at = "" if share.quantity == "speed" else f"at a {QUANTITIES[share.quantity]} "
    if from_start != to_end:
        return f"{at}below {high} {unit_}" if from_start else f"{at}above {low} {unit_}"
    return f"{at}between {low} and {high} {unit_}"


def _peak(share: Share) -> str:
    """Return the narrow band in which most of the error is; empty if there is none."""
    bins = np.array(share.bins)
    held = np.convolve(bins[:, 2], np.ones(NARROW), "valid")
    first = int(np.argmax(held))
    if held[first] < PEAK:
        return ""
    low, high = (number(float(end), 2) for end in (bins[first, 0], bins[first + NARROW - 1, 1]))
    return f"{number(100 * float(held[first]), 2)} % of the error has a frequency between {low} and {high} Hz"


def _way(share: Share) -> str:
    """Return which of backward, at rest and forward a range of directions holds."""
    ways = {-1: "in backward motion", 0: "at rest", 1: "in forward motion"}
    return " or ".join(text for way, text in ways.items() if share.low < way < share.high)
