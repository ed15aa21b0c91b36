"""Identification by the integral method, and its refinement."""

from servolens.identification.options import Prior, Priors, as_priors
from servolens.identification.plant_fit import Fit, fit
from servolens.identification.resampling import Bootstrap, Profile, bootstrap, profile
from servolens.identification.workflow import Identification, identify

__all__ = [
    "Bootstrap",
    "Fit",
    "Identification",
    "Prior",
    "Priors",
    "Profile",
    "as_priors",
    "bootstrap",
    "fit",
    "identify",
    "profile",
]
