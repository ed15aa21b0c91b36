"""What a person sees: how far plants are from records, and from records that took no part in the fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.diagnosis.result import Errors, RecordGain
from servolens.errors import InputError, NumericalError
from servolens.identification.phases import synchronised
from servolens.identification.score import FALSE_ALARM
from servolens.prediction import prediction_residual

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["KEPT", "Gains", "are_larger", "pooled", "residual", "residual_in_phase"]

KEPT = 0.6
"""Part of a record that is parted which is fitted; the rest is held out."""


def residual(plant: Plant, record: Record) -> NDArray[np.float64]:
    """Return simulated minus measured position as `predict` has it [m or rad]; infinite where it has none."""
    try:
        return prediction_residual(plant, record)
    except (InputError, NumericalError):
        return np.full(len(record), np.inf)


def residual_in_phase(plant: Plant, record: Record) -> NDArray[np.float64]:
    """Return the same with the phases that suit the record where each has its own, of a disturbance or a ripple."""
    return residual(synchronised(plant, lambda turned: pooled([residual(turned, record)])), record)


def pooled(residuals: Sequence[NDArray[np.float64]]) -> float:
    """Return the root mean square of all residuals together."""
    if not all(np.isfinite(r).all() for r in residuals):
        return float("inf")
    return float(np.sqrt(np.mean(np.concatenate(residuals) ** 2)))


def are_larger(
    these: Sequence[NDArray[np.float64]], others: Sequence[NDArray[np.float64]], blocks: Sequence[int]
) -> bool:
    """Tell whether residuals are larger than others of the same records by more than chance.

    A paired t test of the squares, summed over blocks that are as long as a loop remembers: what shakes the axis is in
    both.

    Parameters
    ----------
    these, others : sequence of ndarray
        Residuals of each record [m or rad].
    blocks : sequence of int
        Samples of a block of each record.
    """
    from scipy.stats import t

    if not all(np.isfinite(r).all() for r in these):
        return True
    differences = np.concatenate(
        [
            np.add.reduceat(a**2 - b**2, np.arange(0, a.size, block))
            for a, b, block in zip(these, others, blocks, strict=True)
        ]
    )
    mean, deviation = float(differences.mean()), float(differences.std(ddof=1)) if differences.size > 1 else np.inf
    limit = float(t.isf(FALSE_ALARM, differences.size - 1)) * deviation / float(np.sqrt(differences.size))
    return mean > limit


@final
@dataclass(frozen=True, slots=True, eq=False)
class Gains:
    """Residuals of several plants, the first of gain and damping alone.

    Attributes
    ----------
    records, heldout : tuple of Record
        ``heldout`` is empty where each training record in turn was left out of the fit.
    trained, held : tuple of tuple of ndarray
        Of each plant on each record, as `predict` has them.
    noise : float
        Standard deviation of the position's noise [m or rad].
    in_phase : tuple of tuple of ndarray
        Those of the training records with the phases that each has of its own, which `predict` does not know; where
        none are given, as `trained`.
    """

    records: tuple[Record, ...]
    heldout: tuple[Record, ...]
    trained: tuple[tuple[NDArray[np.float64], ...], ...]
    held: tuple[tuple[NDArray[np.float64], ...], ...]
    noise: float
    in_phase: tuple[tuple[NDArray[np.float64], ...], ...] = ()

    @property
    def fitted(self) -> tuple[tuple[NDArray[np.float64], ...], ...]:
        """What each plant leaves of the training records, in phase."""
        return self.in_phase or self.trained

    def train(self, i: int) -> float:
        """Return the r.m.s. error of plant `i` on the training records, with phases of their own."""
        return pooled(self.fitted[i])

    def tested(self, i: int) -> float:
        """Return the same where the plant was not fitted."""
        return pooled(self.held[i])

    def is_worse(self, i: int, j: int, rate: float, *, with_training: bool = False) -> bool:
        """Tell whether plant `i` misses by more than plant `j` where neither was fitted, beyond chance.

        Of loops whose time constants are 1/`rate` [s]. With the training records too if neither was fitted to what
        simulations miss of them.
        """
        is_whole = with_training and bool(self.heldout)
        records = (*self.records, *self.heldout) if is_whole else self.heldout or self.records
        blocks = [max(int(2.0 / (rate * record.sample_time)), 1) for record in records]
        these, others = ((*self.trained[k], *self.held[k]) if is_whole else self.held[k] for k in (i, j))
        return are_larger(these, others, blocks)

    def misses_less(self, i: int, j: int) -> bool:
        """Tell whether plant `i` has smaller errors, r.m.s., than `j`: in training, and where neither was fitted."""
        return pooled(self.trained[i]) < pooled(self.trained[j]) and self.tested(i) < self.tested(j)

    def with_others(self, other: Gains) -> Gains:
        """Return these with the plants of another, on the same records, after them."""
        return replace(
            self,
            trained=(*self.trained, *other.trained),
            held=(*self.held, *other.held),
            in_phase=(*self.fitted, *other.fitted),
        )

    def errors(self, i: int) -> Errors:
        """Return both errors of plant `i`."""
        return Errors(rms_error=self.train(i), heldout_rms_error=self.tested(i))

    def missed(self) -> tuple[tuple[NDArray[np.float64], NDArray[np.float64]], ...]:
        """Return the residuals of the first and the last plant where they were not fitted, record by record."""
        return tuple(zip(self.held[0], self.held[-1], strict=True))

    def by_record(self) -> tuple[RecordGain, ...]:
        """Return the errors of the first and the last plant, record by record."""
        sets = [(self.records, self.fitted, False), (self.heldout or self.records, self.held, True)]
        return tuple(
            RecordGain(
                name=record.name,
                heldout=heldout,
                before=pooled([residuals[0][k]]),
                after=pooled([residuals[-1][k]]),
                noise=self.noise,
            )
            for records, residuals, heldout in sets
            for k, record in enumerate(records)
        )
