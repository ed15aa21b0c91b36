"""Where the error of a simulation lives, without any catalogue: by time, speed, position, direction and voltage."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.decoding import decoded, read_fields
from servolens.identification.segments import applied_voltage
from servolens.identification.smoothing import smooth

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from servolens.record import Record

__all__ = ["Instrument", "Share", "error_shares", "since_step"]

BINS = 12
WINDOW = 41
"""Samples of a smoothed velocity."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Share:
    """A range of a measured quantity and how much of the squared error arises there.

    Attributes
    ----------
    quantity : str
        ``"time_since_step"``, ``"speed"``, ``"position"``, ``"direction"``, ``"voltage"`` or ``"frequency"``.
    low, high : float
        The range.
    unit : str
        Of the range.
    share_of_error, share_of_samples : float
        Between 0 and 1.
    bins : tuple of (float, float, float, float)
        For a picture: low, high, share of error, share of samples of each bin.
    """

    quantity: str
    low: float
    high: float
    unit: str
    share_of_error: float
    share_of_samples: float
    bins: tuple[tuple[float, float, float, float], ...]

    def to_json(self) -> dict[str, Any]:
        """Return the fields of an entry of ``where``."""
        return {
            "quantity": self.quantity,
            "range": [self.low, self.high],
            "share_of_error": self.share_of_error,
            "share_of_samples": self.share_of_samples,
            "unit": self.unit,
            "bins": [list(b) for b in self.bins],
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Share:
        """Build the share from what :meth:`to_json` returned."""
        low, high = decoded(tuple[float, float], data["range"], "range")
        return read_fields(cls, {**data, "low": low, "high": high})


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Instrument:
    """What damping, gain or a free force would have to do in time, and with which measured quantity that goes.

    Attributes
    ----------
    varies : {"damping", "gain", "force"}
        What is let vary.
    goes_with : str
        The measured quantity it follows best: ``"speed"``, ``"velocity"``, ``"direction"``, ``"position"``,
        ``"distance"`` (of the position from 0), ``"voltage"``, ``"voltage_size"``, ``"time"`` (of the record),
        ``"time_since_step"``; or ``"constant"``: the free force stays the same.
    correlation : float
        Between −1 and 1, gain and damping being free.
    significance : float
        Probability that chance alone correlates so much, corrected for the number of quantities and instruments tried.
    abscissa, value, deviation : tuple of float
        For a picture: the quantity's mean over each piece (of a constant force: time), what varies there, and its
        standard error.
    """

    varies: str
    goes_with: str
    correlation: float
    significance: float
    abscissa: tuple[float, ...] = ()
    value: tuple[float, ...] = ()
    deviation: tuple[float, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return the fields without those for a picture."""
        return {
            "varies": self.varies,
            "goes_with": self.goes_with,
            "correlation": self.correlation,
            "significance": self.significance,
        }


def error_shares(records: Sequence[Record], residuals: Sequence[NDArray[np.float64]]) -> tuple[Share, ...]:
    """Return, for each measured quantity, the range in which the squared error exceeds its share of samples most.

    Parameters
    ----------
    records : sequence of Record
        Measurements.
    residuals : sequence of ndarray, shape (n,)
        Simulated minus measured position of each [m or rad].
    """
    squares = np.concatenate([r**2 for r in residuals])
    if not np.isfinite(squares).all() or squares.sum() <= 0.0:
        return ()
    shares = [_share(name, unit, values, squares) for name, unit, values in _quantities(records)]
    shares.append(_by_frequency(records, residuals))
    return tuple(sorted(shares, key=lambda s: s.share_of_samples - s.share_of_error))


def _quantities(records: Sequence[Record]) -> list[tuple[str, str, NDArray[np.float64]]]:
    x, u = records[0].length_unit, records[0].command_unit
    speeds = [smooth(r.time, r.position, min(WINDOW, len(r)))[1] for r in records]
    speed = np.concatenate(speeds)
    still = 0.01 * float(np.abs(speed).max())
    return [
        ("time_since_step", "s", np.concatenate([since_step(r) for r in records])),
        ("speed", f"{x}/s", np.abs(speed)),
        ("position", x, np.concatenate([r.position for r in records])),
        ("direction", "1", np.where(np.abs(speed) <= still, 0.0, np.sign(speed))),
        ("voltage", u, np.concatenate([applied_voltage(r) for r in records])),
    ]


def since_step(record: Record) -> NDArray[np.float64]:
    """Return the time since the reference last began to change, or since the record's beginning [s]."""
    edges = np.unique([0, *(move[0] for move in record.moves())])
    last = edges[np.searchsorted(edges, np.arange(len(record)), side="right") - 1]
    return np.asarray(record.time - record.time[last])


def _share(name: str, unit: str, values: NDArray[np.float64], squares: NDArray[np.float64]) -> Share:
    edges = np.unique(np.quantile(values, np.linspace(0.0, 1.0, BINS + 1)))
    if name == "direction":
        edges = np.array([-1.5, -0.5, 0.5, 1.5])
    elif edges.size < 2:
        edges = np.array([edges[0], edges[0] + 1e-300])
    index = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, edges.size - 2)
    error = np.bincount(index, squares, edges.size - 1) / squares.sum()
    samples = np.bincount(index, minlength=edges.size - 1) / squares.size
    return _worst(name, unit, edges, error, samples)


def _by_frequency(records: Sequence[Record], residuals: Sequence[NDArray[np.float64]]) -> Share:
    """Return the band that holds more of the error than its share of a white one."""
    top = 0.5 / max(r.sample_time for r in records)
    slowest = 1.0 / max(r.duration for r in records)
    edges = np.concatenate(([0.0], np.geomspace(slowest, top, BINS)))
    power, lines = np.zeros(BINS), np.zeros(BINS)
    for record, residual in zip(records, residuals, strict=True):
        spectrum = np.abs(np.fft.rfft(residual - residual.mean())) ** 2
        f = np.fft.rfftfreq(residual.size, record.sample_time)
        index = np.clip(np.searchsorted(edges, f, side="right") - 1, 0, BINS - 1)
        power += np.bincount(index, spectrum, BINS)
        lines += np.bincount(index, minlength=BINS)
    return _worst("frequency", "Hz", edges, power / max(float(power.sum()), 1e-300), lines / lines.sum())


def _worst(
    name: str, unit: str, edges: NDArray[np.float64], error: NDArray[np.float64], samples: NDArray[np.float64]
) -> Share:
    """Return the run of neighbouring bins whose share of error exceeds that of samples most."""
    sums = np.concatenate(([0.0], np.cumsum(error - samples)))
    gain = sums[None, :] - sums[:, None]
    first, last = np.unravel_index(int(np.argmax(np.triu(gain, 1))), gain.shape)
    last = max(last, first + 1)
    return Share(
        quantity=name,
        low=float(edges[first]),
        high=float(edges[last]),
        unit=unit,
        share_of_error=float(error[first:last].sum()),
        share_of_samples=float(samples[first:last].sum()),
        bins=tuple(
            (float(a), float(b), float(e), float(s))
            for a, b, e, s in zip(edges[:-1], edges[1:], error, samples, strict=True)
        ),
    )
