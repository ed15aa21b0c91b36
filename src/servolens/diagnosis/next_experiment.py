"""The experiment that best tells rivals apart."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

__all__ = ["Experiment"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """A step to log next.

    Attributes
    ----------
    kp, kd : float
        Gains.
    reference : float
        Height of the step [m or rad].
    separates : tuple of str
        The two effects whose responses differ most.
    separation : float
        R.m.s. difference of their responses in units of the noise.
    """

    kp: float
    kd: float
    reference: float
    separates: tuple[str, str]
    separation: float

    def to_json(self) -> dict[str, Any]:
        """Return the fields of ``next_experiment``."""
        return {
            "kp": self.kp,
            "kd": self.kd,
            "reference": self.reference,
            "separates": list(self.separates),
            "separation": self.separation,
        }
