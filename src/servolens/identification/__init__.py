"""Identification by the integral method, and its refinement."""

from servolens.identification.effects_fit import fit_effects
from servolens.identification.integral import Prior
from servolens.identification.workflow import Identification, identify

__all__ = ["Identification", "Prior", "fit_effects", "identify"]
