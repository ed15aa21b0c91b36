"""Identification by the integral method, and its refinement."""

from servolens.identify.identification import Identification, identify
from servolens.identify.integral import Prior

__all__ = ["Identification", "Prior", "identify"]
