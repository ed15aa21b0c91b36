"""Which voltage moved the axis, where the log holds it in steps: these, or what the law of the loop says."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servolens.identification.fitting import likelihood_of
from servolens.identification.hypothesis import LIKELIER

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.identification.options import FitOptions
    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["are_steps_felt"]


def are_steps_felt(logged: Sequence[Record], exact: Sequence[Record], plant: Plant, options: FitOptions) -> bool:
    """Tell whether records are likelier as `logged` than with the `exact` voltage of their loop's law.

    Parameters
    ----------
    logged, exact : sequence of Record
        The same runs.
    plant : Plant
        Fitted to the latter.
    options : FitOptions
        How.
    """
    if tuple(logged) == tuple(exact):  # the same records, none of them in steps
        return False
    felt, unfelt = (likelihood_of(runs, plant, options).judged(plant) for runs in (logged, exact))
    return bool(felt and unfelt and felt.total < unfelt.total - LIKELIER)
