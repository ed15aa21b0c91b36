"""Residuals of runs as linear functions of parameters and initial states, and the normal equations of those."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servolens.identification.conditioning import determined

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

__all__ = ["Block", "Linearised", "Slopes"]

UNFELT = 1e-4
"""Of an initial position's effect, the share up to which a velocity has none: an axis that sticks loses it at once."""


class Slopes(NamedTuple):
    """Residual of one run, shape (n,), and its slopes by the parameters, (n, k), and the initial state, (n, s)."""

    residual: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    initial: NDArray[np.float64]

    def moved(self, values: NDArray[np.float64], start: NDArray[np.float64], residual: NDArray[np.float64]) -> Slopes:
        """Return the slopes where parameters and initial state are so much away and leave this `residual`.

        The least change that makes them agree with it (Broyden 1965, doi:10.1090/S0025-5718-1965-0198670-6), each
        unknown measured by what it does.
        """
        slopes, moved = np.hstack([self.jacobian, self.initial]), np.concatenate([values, start])
        weighed = np.sum(slopes**2, axis=0) * moved
        length = float(weighed @ moved)
        if length > 0.0:
            slopes = slopes + np.outer(residual - self.residual - slopes @ moved, weighed / length)
        return Slopes(residual, slopes[:, : values.size], slopes[:, values.size :])


class Block(NamedTuple):
    """One run, its initial state eliminated: what the state did (R, Qᵀ J, Qᵀ r), and what is left (J, r).

    The leverage, shape (n,), is the share of each sample's noise that the state follows.
    """

    factor: NDArray[np.float64]
    along: NDArray[np.float64]
    missed: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    residual: NDArray[np.float64]
    leverage: NDArray[np.float64]

    @property
    def felt(self) -> float:
        """By how much the cost falls with the initial state, but for directions of which the run shows nothing."""
        if self.missed.size == 0:
            return 0.0
        directions, sizes, _ = np.linalg.svd(self.factor / self._scale)
        return float(np.sum((directions.T @ self.missed)[sizes > UNFELT * sizes[0]] ** 2))

    @property
    def _scale(self) -> NDArray[np.float64]:
        """Of each initial state, shape (s,): a place within a gap counts as much as the position, whatever its unit."""
        sizes = np.linalg.norm(self.factor, axis=0)
        scale = np.ones(sizes.size)
        scale[2:] = sizes[2:] / np.where(sizes[:1] > 0.0, sizes[:1], 1.0)
        return np.where(scale > 0.0, scale, 1.0)

    def best_change(self, values: NDArray[np.float64], damping: float) -> NDArray[np.float64]:
        """Return the change of the initial state that leaves least with this change of the parameters, shape (s,).

        A place within a gap is damped as the parameters are: what it does is far from linear.
        """
        if self.missed.size == 0:
            return self.missed
        scaled = self.factor / self._scale
        held = np.sqrt(damping) * np.diag(np.linalg.norm(scaled, axis=0))[2:]
        missed = np.concatenate([self.missed + self.along @ values, np.zeros(len(held))])
        return np.asarray(-np.linalg.lstsq(np.vstack([scaled, held]), missed, rcond=UNFELT)[0] / self._scale)

    @classmethod
    def of(cls, slopes: Slopes, weight: NDArray[np.float64]) -> Block:
        """Return the block of a run whose samples have these weights, shape (n,)."""
        residual, jacobian, initial = slopes
        q, r = np.linalg.qr(weight[:, None] * initial)
        x, y = weight[:, None] * jacobian, weight * residual
        along, missed = q.T @ x, q.T @ y
        return cls(r, along, missed, x - q @ along, y - q @ missed, np.sum(q**2, axis=1))


class Linearised(NamedTuple):
    """Each run's block, and gradient and information of the parameters."""

    blocks: list[Block]
    gradient: NDArray[np.float64]
    information: NDArray[np.float64]

    def most(self, free: NDArray[np.bool_]) -> float:
        """Return by how much the cost falls at most where these parameters are `free`, if it is as linear as this."""
        free = free & (np.diag(self.information) > 0.0)
        states = sum(block.felt for block in self.blocks)
        if not free.any():
            return states
        information = self.information[np.ix_(free, free)]
        basis = determined(information)
        along = basis.T @ self.gradient[free]
        return states + float(along @ np.linalg.solve(basis.T @ information @ basis, along))

    def promised(self, values: NDArray[np.float64], starts: Sequence[NDArray[np.float64]]) -> float:
        """Return by how much the cost falls with this change of the parameters and of each run's initial state."""
        fall = -float(2.0 * self.gradient @ values + values @ self.information @ values)
        for block, start in zip(self.blocks, starts, strict=True):
            left = block.missed + block.along @ values + block.factor @ start
            fall += float(block.missed @ block.missed) - float(left @ left)
        return fall
