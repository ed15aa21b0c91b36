"""Identification by the integral method, and its refinement."""

from servolens.identification.effects_fit import EffectsFit, fit_effects
from servolens.identification.integral import Prior
from servolens.identification.options import FitOptions
from servolens.identification.resampling import Bootstrap, Profile, bootstrap, profile
from servolens.identification.workflow import Identification, identify

__all__ = [
    "Bootstrap",
    "EffectsFit",
    "FitOptions",
    "Identification",
    "Prior",
    "Profile",
    "bootstrap",
    "fit_effects",
    "identify",
    "profile",
]
