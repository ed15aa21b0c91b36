"""The second half of the demo: an axis whose lack is hidden in the laboratory, found from its records, designed on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens import lab
from servolens.design import settling_time
from servolens.errors import NumericalError
from servolens.study import study_records

if TYPE_CHECKING:
    from collections.abc import Callable

    from servolens.design import PDSpec
    from servolens.lab import HiddenCampaign
    from servolens.study import Study

__all__ = ["HiddenAxis", "TriedGain", "study_hidden_axis"]

SEED, HIDDEN = 2, ("delay",)
"""An axis on which the least gain, off by the model's last error, settles a swing too late."""
WATCHED_SETTLING_TIMES = 10.0
"""Settling times for which a gain is tried."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class TriedGain:
    """A gain run on the true axis, without sensor noise.

    Attributes
    ----------
    name : str
        ``"least"`` or ``"recommended"``.
    kd : float
        [V s/m or V s/rad].
    settling_time : float or None
        [s]; None where it does not settle.
    meets : bool
        Whether it is what the spec asks for.
    """

    name: str
    kd: float
    settling_time: float | None
    meets: bool


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HiddenAxis:
    """What was hidden, what was found, and what the gains do on the truth.

    Attributes
    ----------
    campaign : HiddenCampaign
        Records and truth.
    study : Study
        Of the records alone.
    tried : tuple of TriedGain
        On the true axis.
    """

    campaign: HiddenCampaign
    study: Study
    tried: tuple[TriedGain, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the fields of ``hidden`` in ``servolens.demo/1``: those of ``servolens.tuning/1`` and the truth."""
        truth = self.campaign.truth
        effects = {name: dict(values) for name, values in truth.effects.items()}
        return {
            **self.study.to_json(),
            "truth": {"gain": truth.gain, "damping": truth.damping, "effects": effects},
            "records": [record.name for record in self.campaign.records],
            "on_axis": [
                {"gain": t.name, "kd": t.kd, "settling_time": t.settling_time, "meets": t.meets} for t in self.tried
            ],
        }


def study_hidden_axis(progress: Callable[[str, int, int], None] = lambda _what, _done, _total: None) -> HiddenAxis:
    """Measure an axis whose truth is hidden, study the records, and try the gains on the truth.

    Parameters
    ----------
    progress : callable
        Is told (what, done, total).
    """
    campaign = lab.hidden_campaign(SEED, effects=HIDDEN)
    study = study_records(campaign.records, heldout=campaign.heldout, effort="quick", progress=progress)
    gains: dict[str, float] = {}
    if study.design is not None and study.design.kd is not None and study.design.recommended is not None:
        gains = {"least": study.design.kd, "recommended": study.design.recommended.kd}
    spec = None if study.design is None else study.design.spec
    tried = tuple(_tried(campaign, name, kd, spec) for name, kd in gains.items() if spec is not None)
    return HiddenAxis(campaign=campaign, study=study, tried=tried)


def _tried(campaign: HiddenCampaign, name: str, kd: float, spec: PDSpec) -> TriedGain:
    controller = spec.loop(kd)
    try:
        run = campaign.tried(
            controller, [spec.reference], WATCHED_SETTLING_TIMES * spec.settling_time, spec.sample_time
        )
    except NumericalError:
        return TriedGain(name=name, kd=kd, settling_time=None, meets=False)
    error = (spec.reference - run.position) / spec.reference
    time = spec.sample_time * np.arange(error.size, dtype=np.float64)
    found = settling_time(time, error, spec.band)
    return TriedGain(name=name, kd=kd, settling_time=found, meets=found is not None and found <= spec.settling_time)
