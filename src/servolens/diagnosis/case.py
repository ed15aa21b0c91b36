"""The records of a diagnosis, and what its steps ask of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.diagnosis.errors import pooled, residual, rotated
from servolens.diagnosis.logs import apart
from servolens.diagnosis.remainder import remainder
from servolens.diagnosis.result import Errors, RecordGain
from servolens.diagnosis.threads import in_parallel
from servolens.diagnosis.trials import Hypothesis, Trials
from servolens.effects import CoulombFriction
from servolens.errors import InputError, NumericalError
from servolens.identification.effects_fit import EffectsFit, last_word
from servolens.identification.segments import noise_level

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from servolens.findings import Finding
    from servolens.identification.integral import Prior
    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["Case", "Gains"]

LEFT = 0.35
"""Smooth remainder, in units of the noise, up to which nothing is left to be explained."""
LEFT_OF_ERROR = 0.005
"""The same as a share of the error of gain and damping alone: no simulation is quite the axis."""
AT_REST = 0.9
"""Share of samples at rest that repeat the one before, from which on nothing smears the encoder's steps."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """Training and held-out records, prepared.

    Attributes
    ----------
    trials : Trials
        The training records, on which hypotheses are tried.
    base : Hypothesis
        Gain and damping alone.
    records, heldout : tuple of Record
        For training, and for the test alone.
    priors : mapping of str to Prior
        Knowledge from elsewhere.
    rounding : float
        Step of an encoder that no noise smears; else 0 [m or rad].
    """

    trials: Trials
    base: Hypothesis
    records: tuple[Record, ...]
    heldout: tuple[Record, ...]
    priors: Mapping[str, Prior]
    rounding: float

    @classmethod
    def of(cls, records: tuple[Record, ...], heldout: tuple[Record, ...], priors: Mapping[str, Prior]) -> Case:
        """Prepare the records.

        Raises
        ------
        InputError
            If the axis moves in none.
        NumericalError
            If gain and damping alone cannot be simulated on them.
        """
        trials = Trials(records, priors)
        base = trials.fitted(trials.start)
        if base is None:
            raise NumericalError("gain and damping alone cannot be simulated on these records; check sign and units")
        return cls(trials, trials.judged(base), records, heldout, priors, max(_rounding(r) for r in records))

    def left(self, hypothesis: Hypothesis) -> float:
        """Return what of the residual is smooth, and so no noise [m or rad]."""
        if not hypothesis.residuals:
            return hypothesis.error
        return remainder(hypothesis.residuals, self.rounding)

    def is_explained(self, hypothesis: Hypothesis) -> bool:
        """Tell whether what is left is noise, or so little of the error that no simulation is as exact."""
        return self.left(hypothesis) <= max(LEFT * self.trials.noise, LEFT_OF_ERROR * self.base.error)

    def fitted(self, plant: Plant) -> EffectsFit:
        """Return `plant` refined on the training records, with error bars."""
        return last_word(plant, self.records, self.trials.options(plant))

    def gains(self, plants: Sequence[Plant]) -> Gains:
        """Return the residuals of `plants` on training and held-out records."""
        trained = tuple(tuple(residual(plant, record) for record in self.records) for plant in plants)
        if self.heldout:
            tested = tuple(tuple(residual(plant, record) for record in self.heldout) for plant in plants)
        else:
            tested = tuple(tuple(rotated(self.records, partial(self._refit, plant))) for plant in plants)
        return Gains(self.records, self.heldout, trained, tested)

    def tested(self, plant: Plant) -> float:
        """Return the r.m.s. error of `plant` where it was not fitted [m or rad]."""
        return self.gains([plant]).tested(0)

    def contradiction(self) -> Finding | None:
        """Return a finding if each record by itself is explained, by friction at most, but by values of no one axis."""
        return None if self.is_explained(self.base) else self.apart(self.base, [CoulombFriction.name])

    def apart(self, hypothesis: Hypothesis, names: Sequence[str] = ()) -> Finding | None:
        """Return a finding if each record by itself is explained, but by values that no single axis has.

        Explained by `hypothesis`, or with the best of the effects `names` beside it.
        """
        if len(self.records) < 2:
            return None
        found = []
        for record in self.records:
            alone = self._alone(record, hypothesis.plant, names)
            if alone is None:
                return None
            found.append(alone)
        return apart(found, [record.name for record in self.records])

    def _alone(self, record: Record, plant: Plant, names: Sequence[str]) -> Plant | None:
        """Return `plant` fitted to one record, at need with the best of the effects; None if nothing explains it."""
        try:
            trials = Trials([record], self.priors)
        except (InputError, NumericalError):
            return None

        def is_explained(hypothesis: Hypothesis) -> bool:
            return bool(hypothesis.residuals) and remainder(hypothesis.residuals, self.rounding) <= LEFT * trials.noise

        fit = trials.fitted(plant)
        if fit is None:
            return None
        bare = trials.judged(fit)
        if is_explained(bare):
            return bare.plant
        begun = [h for h in in_parallel(partial(trials.extended, bare), names) if h]
        fits = [h for h in in_parallel(lambda h: trials.fitted(h.plant), begun) if h]
        explained = [h for h in map(trials.judged, fits) if is_explained(h)]
        return min(explained, key=trials.score).plant if explained else None

    def _refit(self, plant: Plant, records: Sequence[Record]) -> Plant:
        try:
            trials = Trials(records, self.priors, self.trials.seen)
        except (InputError, NumericalError):
            return plant
        found = trials.fitted(plant)
        return plant if found is None else trials.judged(found).plant


@final
@dataclass(frozen=True, slots=True, eq=False)
class Gains:
    """Residuals of several plants, the first of gain and damping alone.

    Attributes
    ----------
    records, heldout : tuple of Record
        ``heldout`` is empty where each training record in turn was left out of the fit.
    trained, held : tuple of tuple of ndarray
        Of each plant on each record.
    """

    records: tuple[Record, ...]
    heldout: tuple[Record, ...]
    trained: tuple[tuple[NDArray[np.float64], ...], ...]
    held: tuple[tuple[NDArray[np.float64], ...], ...]

    def train(self, i: int) -> float:
        """Return the r.m.s. error of plant `i` on the training records."""
        return pooled(self.trained[i])

    def tested(self, i: int) -> float:
        """Return the same where the plant was not fitted."""
        return pooled(self.held[i])

    def of_travel(self, i: int) -> float:
        """Return the error of plant `i` as a share of the travel, on training or other records, where it is larger."""
        return max(
            pooled([e / max(float(np.ptp(r.position)), 1e-300) for r, e in zip(runs, errors, strict=True)])
            for runs, errors in ((self.records, self.trained[i]), (self.heldout or self.records, self.held[i]))
        )

    def errors(self, i: int) -> Errors:
        """Return both errors of plant `i`."""
        return Errors(rms_error=self.train(i), heldout_rms_error=self.tested(i))

    def by_record(self) -> tuple[RecordGain, ...]:
        """Return the errors of the first and the last plant, record by record."""
        sets = [(self.records, self.trained, False), (self.heldout or self.records, self.held, True)]
        return tuple(
            RecordGain(
                name=record.name,
                heldout=heldout,
                before=pooled([residuals[0][k]]),
                after=pooled([residuals[-1][k]]),
                noise=noise_level(record),
            )
            for records, residuals, heldout in sets
            for k, record in enumerate(records)
        )


def _rounding(record: Record) -> float:
    """Return the encoder's step if nothing smears it: at rest the position then repeats itself."""
    step = record.encoder_resolution
    if step is None:
        return 0.0
    moved = np.abs(record.position[8:] - record.position[:-8])
    resting = moved[:-1] <= step
    same = np.diff(record.position[8:]) == 0.0
    return step if resting.any() and float(np.mean(same[resting])) > AT_REST else 0.0
