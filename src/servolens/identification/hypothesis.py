"""A plant fitted to records beside its own noise model."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from servolens.identification.noise import NoiseModel
    from servolens.plant import Plant

__all__ = ["LIKELIER", "NO_BETTER", "Hypothesis"]

NO_BETTER = 0.5
"""Fall of −2 log-likelihood that is none."""
LIKELIER = 13.8
"""Difference of −2 log-likelihood from which on records are seen to be otherwise than they were read, as of a faster
loop: odds of 1 to 1000."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A plant fitted to the training records beside its own noise model.

    Attributes
    ----------
    plant : Plant
        The best of its structure.
    noise : NoiseModel
        That makes what the plant leaves likeliest.
    starts : tuple of ndarray
        Initial state of each record.
    misfit : float
        −2 log-likelihood, priors included.
    total : float
        The same plus the price of its effects; the least is the best.
    unpowered : bool
        Whether nothing was applied before records that begin with their step.
    local : mapping of str to ndarray
        Parameters that each record has of its own.
    """

    plant: Plant
    noise: NoiseModel
    starts: tuple[NDArray[np.float64], ...]
    misfit: float
    total: float
    unpowered: bool
    local: Mapping[str, NDArray[np.float64]]

    @property
    def causes(self) -> tuple[str, ...]:
        """Names of the effects, in the order in which they were found."""
        return tuple(effect.name for effect in self.plant.effects)

    def plant_of(self, group: int) -> Plant:
        """Return the plant of one record, with the parameters of its own."""
        if not self.local:
            return self.plant
        return self.plant.with_named({name: float(found[group]) for name, found in self.local.items()})

    def of(self, groups: Sequence[int]) -> Hypothesis:
        """Return it with the initial states, and the parameters of their own, of some records only."""
        local = {name: found[list(groups)] for name, found in self.local.items()}
        return replace(self, starts=tuple(self.starts[group] for group in groups), local=local)
