"""Identification by the integral method, and its refinement."""

from servolens.identification.workflow import Identification, identify
from servolens.identification.integral import Prior

__all__ = ["Identification", "Prior", "identify"]
