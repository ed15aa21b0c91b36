"""Identification by the integral method, and its refinement."""

from servolens.identification.options import Prior
from servolens.identification.plant_fit import Fit, fit
from servolens.identification.resampling import Bootstrap, Profile, bootstrap, profile
from servolens.identification.workflow import Identification, identify

__all__ = [
    "Bootstrap",
    "Fit",
    "Identification",
    "Prior",
    "Profile",
    "bootstrap",
    "fit",
    "identify",
    "profile",
]
