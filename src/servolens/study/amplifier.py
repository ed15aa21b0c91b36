"""What the records state of the amplifier, as a part of the model that a gain is designed on."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servolens.effects import Saturation

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.model import Model
    from servolens.record import Record

__all__ = ["with_amplifier"]


def with_amplifier(model: Model, records: Sequence[Record]) -> Model:
    """Return the model with the least voltage limit that the records state, which every fit took into account.

    A model that has a limit of its own keeps it where that is less.
    """
    stated = [record.voltage_limit for record in records if record.voltage_limit is not None]
    own = model.plant.effect(Saturation.name)
    if not stated or (isinstance(own, Saturation) and own.limit <= min(stated)):
        return model
    reasons = {**model.reasons, f"{Saturation.name}.limit": "stated with the records, not estimated"}
    plant = model.plant.with_effect(Saturation(limit=min(stated)))
    return replace(model, plant=plant, covariance=_extended(model, list(plant.parameters)), reasons=reasons)


def _extended(model: Model, names: Sequence[str]) -> NDArray[np.float64] | None:
    """Return the covariance for parameters of these names; that of what was not estimated is not known."""
    if model.covariance is None:
        return None
    before = list(model.plant.parameters)
    found = np.full((len(names), len(names)), np.nan)
    kept = [(i, before.index(name)) for i, name in enumerate(names) if name in before]
    for i, k in kept:
        for j, m in kept:
            found[i, j] = model.covariance[k, m]
    return found
