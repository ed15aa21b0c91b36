"""The paper's own instrument: what damping, gain or a free force would have to do in time, and what that goes with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, final

import numpy as np

from servolens.diagnosis.evidence import Instrument, since_step

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.identification.segments import Segment
    from servolens.identification.starting import Screen
    from servolens.plant import Plant

__all__ = ["instruments"]

Varying = Literal["damping", "gain", "force"]

PIECES = 8
"""Of a stretch of motion."""
FEWEST_SAMPLES = 8
"""In a piece."""
FEWEST_PIECES = 5
"""On which anything is correlated."""
FREE = {"velocity", "voltage"}
"""A force that goes with one of these is damping or gain, which are free: hardly anything of it is left beside them."""
SAME = 0.9999
"""Correlation from which on two quantities are one: the time of the record, and since its only step."""
UNDETERMINED = 1e-6
"""Least share of the largest of a stretch's pieces that the data must tell of one."""
LOG_SPEED, SLOW = "logarithm of speed", 0.02
"""What acts at low speed follows speed on a curve; share of the top speed below which the logarithm is bent."""
EXACT = 1e-5
"""Share of the travel that voltages held between samples, positions rounded and times jittering leave of any axis."""


def instruments(screen: Screen, plant: Plant) -> tuple[Instrument, ...]:
    r"""Return what damping, gain and a free force would have to do in time, the most telling first.

    Each stretch of motion solves

    .. math:: y = y_0 + v_0 t + \beta \iint V - c \int (y - y_0) + \sum_k p_k \iint 1_k(t)\, \varphi

    for its own initial state and one value p of each of its pieces, by which damping or gain differ from those of
    `plant` (φ is −v or V), or a force acts (φ is −1). The values are then regressed on the pieces' means of each
    measured quantity, with the errors they have and share. What varies hides behind a wrong gain or damping: so these
    are free in the regression, and p is told for those that suit the best quantity. A force is not correlated with
    velocity and voltage: what goes with these is damping and gain. It needs no catalogue of effects.

    Parameters
    ----------
    screen : Screen
        Stretches of motion.
    plant : Plant
        Its gain and damping are the starting point; its effects are not looked at.

    Returns
    -------
    tuple of Instrument
        Empty where there are too few pieces. A significance holds for the best of all quantities and instruments.
    """
    stretches = [_cut(segment, v) for segment, v in zip(screen.segments, screen.velocity, strict=True)]
    if sum(len(s.edges) - 1 for s in stretches) < FEWEST_PIECES:
        return ()
    travel = float(np.ptp(np.concatenate([s.position for s in screen.segments])))
    kinds: tuple[Varying, ...] = ("damping", "gain", "force")
    found = []
    for kind in kinds:
        means = {name: np.concatenate([_means(kind, s, name) for s in stretches]) for name in stretches[0].seen}
        found.append(_read(_vary(kind, stretches, plant, EXACT * travel), _apart(kind, means), means["time"]))
    return tuple(sorted(found, key=lambda i: (i.significance, -abs(i.correlation))))


@final
@dataclass(frozen=True, slots=True, eq=False)
class _Stretch:
    """One stretch of motion, its pieces' edges, and measured quantities.

    `once` and `twice` are integrals of v, V and 1.
    """

    time: NDArray[np.float64]
    position: NDArray[np.float64]
    edges: NDArray[np.intp]
    seen: dict[str, NDArray[np.float64]]
    once: dict[Varying, NDArray[np.float64]]
    twice: dict[Varying, NDArray[np.float64]]


@final
@dataclass(frozen=True, slots=True, eq=False)
class _Pieces:
    """What is known of the values p of all pieces: ``data = R p + others @ shifts``, R triangular for each stretch.

    Rows are independent and have the deviation 1. `shifts` are of that of gain and damping which does not vary itself.
    """

    kind: Varying
    held: float
    noise: float
    factors: tuple[NDArray[np.float64], ...]
    others: NDArray[np.float64]
    data: NDArray[np.float64]

    def times(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return R times `values`."""
        parts = np.split(values, np.cumsum([f.shape[0] for f in self.factors])[:-1])
        products = [factor @ part for factor, part in zip(self.factors, parts, strict=True)]
        return np.asarray(np.concatenate(products) / self.noise)


def _cut(segment: Segment, velocity: NDArray[np.float64]) -> _Stretch:
    t, y, voltage = segment.time, segment.position, segment.voltage
    count = max(min(PIECES, t.size // FEWEST_SAMPLES), 1)
    edges = np.linspace(0, t.size - 1, count + 1).astype(np.intp)
    own = slice(segment.first, segment.stop)
    direction = np.where(np.abs(velocity) <= 0.01 * np.abs(velocity).max(), 0.0, np.sign(velocity))
    speed = np.abs(velocity)
    seen = {
        "speed": speed,
        LOG_SPEED: np.log(speed + SLOW * float(speed.max()) + 1e-300),
        "velocity": velocity,
        "direction": direction,
        "position": y,
        "distance": np.abs(y),
        "voltage": voltage,
        "voltage_size": np.abs(voltage),
        "time": segment.record.time[own],
        "time_since_step": since_step(segment.record)[own],
    }
    step = np.diff(t)
    # held voltage integrates exactly; position by trapezoids with the next term of their error
    speed_gained = np.concatenate(([0.0], np.cumsum(voltage[:-1] * step)))
    way = np.cumsum(0.5 * step * (y[1:] + y[:-1] - 2 * y[0]) - step**2 * np.diff(velocity) / 12.0)
    return _Stretch(
        time=t,
        position=y,
        edges=edges,
        seen=seen,
        once={"damping": y - y[0], "gain": speed_gained, "force": t},
        twice={
            "damping": np.concatenate(([0.0], way)),
            "gain": np.concatenate(([0.0], np.cumsum(step * 0.5 * (speed_gained[1:] + speed_gained[:-1])))),
            "force": 0.5 * t**2,
        },
    )


def _vary(kind: Varying, stretches: Sequence[_Stretch], plant: Plant, exact: float) -> _Pieces:
    """Reduce each stretch to what it tells of the pieces' values."""
    factors, others, data, left, freedom = [], [], [], 0.0, 0
    for stretch in stretches:
        factor, count = _factor(kind, stretch, plant), stretch.edges.size - 1
        factors.append(factor[:count, :count])
        others.append(factor[:count, count:-1])
        data.append(factor[:count, -1])
        left += float(factor[-1, -1]) ** 2
        freedom += stretch.time.size - factor.shape[0] - 1
    noise = float(np.sqrt(left / max(freedom, 1) + exact**2))
    return _Pieces(
        kind=kind,
        held={"damping": plant.damping, "gain": plant.gain, "force": 0.0}[kind],
        noise=noise,
        factors=tuple(factors),
        others=np.vstack(others) / noise,
        data=np.concatenate(data) / noise,
    )


def _factor(kind: Varying, stretch: _Stretch, plant: Plant) -> NDArray[np.float64]:
    """Return the triangular factor of the pieces' columns, the others', and what they have to make up.

    The initial state is taken out.
    """
    t, once, twice = stretch.time, stretch.once[kind], stretch.twice[kind]
    begin, end = stretch.edges[:-1], stretch.edges[1:]
    i = np.clip(np.arange(t.size)[:, None], begin, end)
    columns = twice[i] - twice[begin] - once[begin] * (t[i] - t[begin]) + (once[i] - once[begin]) * (t[:, None] - t[i])
    pushed, swept = stretch.twice["gain"], stretch.twice["damping"]
    others = [other for name, other in (("gain", pushed), ("damping", swept)) if name != kind]
    missing = stretch.position - stretch.position[0] - plant.gain * pushed + plant.damping * swept
    rows = np.column_stack([np.ones(t.size), t, columns if kind == "gain" else -columns, *others, missing])
    return np.asarray(np.linalg.qr(rows, mode="r"))[2:, 2:]


def _read(pieces: _Pieces, seen: dict[str, NDArray[np.float64]], time: NDArray[np.float64]) -> Instrument:
    """Correlate the pieces' values with each quantity, and report the best; what is constant is shown in `time`."""
    level = pieces.times(np.ones(pieces.data.size))
    known = np.column_stack([pieces.others, level])
    correlations = {name: _partial(known, pieces.times(values), pieces.data) for name, values in seen.items()}
    if pieces.kind == "force":
        correlations["constant"] = _partial(pieces.others, level, pieces.data)
    best = max(correlations, key=lambda name: abs(correlations[name][0]))
    r, size = correlations[best]
    chance = _chance(r, level.size - known.shape[1] - 1, abs(r) * size)
    line = known if best == "constant" else np.column_stack([known, pieces.times(seen[best])])
    shifts = np.linalg.lstsq(line, pieces.data, rcond=1e-12)[0][: pieces.others.shape[1]]
    value, deviation = _values(pieces, pieces.data - pieces.others @ shifts)
    kept = np.isfinite(deviation)
    best = "speed" if best == LOG_SPEED else best
    abscissa = time if best == "constant" else seen[best]
    return Instrument(
        varies=pieces.kind,
        goes_with=best,
        correlation=r,
        significance=min((3.0 * len(seen) + 1.0) * chance, 1.0),
        abscissa=tuple(abscissa[kept].tolist()),
        value=tuple(value[kept].tolist()),
        deviation=tuple(deviation[kept].tolist()),
    )


def _partial(known: NDArray[np.float64], along: NDArray[np.float64], data: NDArray[np.float64]) -> tuple[float, float]:
    """Return the correlation of `data` with `along`, and the length of `data`, both beside what is `known`."""
    basis = np.linalg.qr(known)[0]
    own, about = (column - basis @ (basis.T @ column) for column in (along, data))
    lengths = float(np.linalg.norm(own)), float(np.linalg.norm(about))
    if lengths[0] <= 1e-9 * float(np.linalg.norm(along)) or lengths[1] == 0.0:
        return 0.0, lengths[1]
    return float(own @ about) / (lengths[0] * lengths[1]), lengths[1]


def _values(pieces: _Pieces, data: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return each piece's value and its standard error, infinite where the data say nothing of it."""
    values, deviations, at = [], [], 0
    for factor in pieces.factors:
        stop = at + factor.shape[0]
        inverse = np.linalg.pinv(factor, rcond=UNDETERMINED)
        lost = np.abs(np.diag(inverse @ factor) - 1.0) > UNDETERMINED
        values.append(pieces.held + inverse @ data[at:stop] * pieces.noise)
        deviations.append(np.where(lost, np.inf, pieces.noise * np.linalg.norm(inverse, axis=1)))
        at = stop
    return np.concatenate(values), np.concatenate(deviations)


def _chance(r: float, freedom: int, deviations: float) -> float:
    """Return the probability of a correlation `r`, and of a slope so many of its standard deviations from 0, by chance.

    The larger of the two: that pieces lie on a line says nothing while the line is level within the noise.
    """
    from scipy.special import betainc, erfc

    return max(float(betainc(0.5 * freedom, 0.5, max(1.0 - r * r, 0.0))), float(erfc(deviations / np.sqrt(2.0))))


def _apart(kind: Varying, means: dict[str, NDArray[np.float64]]) -> dict[str, NDArray[np.float64]]:
    """Return the quantities that tell the pieces apart: without those that do not vary, or only as one before."""
    kept: dict[str, NDArray[np.float64]] = {}
    for name, values in means.items():
        if kind == "force" and name in FREE:
            continue
        centred = values - values.mean()
        if np.linalg.norm(centred) <= 1e-9 * np.linalg.norm(values):
            continue
        if all(abs(np.corrcoef(centred, other)[0, 1]) < SAME for other in kept.values()):
            kept[name] = values
    return kept


def _means(kind: Varying, stretch: _Stretch, name: str) -> NDArray[np.float64]:
    """Return a quantity's mean over each piece, weighed by what the varying value multiplies there."""
    size = {"damping": stretch.seen["speed"], "gain": stretch.seen["voltage_size"], "force": np.ones(stretch.time.size)}
    weight = size[kind][:-1] + 1e-6 * size[kind].max() + 1e-300
    begin = stretch.edges[:-1]
    summed = np.add.reduceat(weight * stretch.seen[name][:-1], begin)
    return np.asarray(summed / np.add.reduceat(weight, begin))
