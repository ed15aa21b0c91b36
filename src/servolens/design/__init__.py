"""From a spec to the least derivative gain."""

from servolens.design.comparison import compare
from servolens.design.found import Certificate, Comparison, Design, Relaxed, Response
from servolens.design.gain_plane import GainMap, gain_map, noise_gain
from servolens.design.least_kd import tune
from servolens.design.settle import evaluate, settling_time, step_response
from servolens.design.spec import PDSpec

__all__ = [
    "Certificate",
    "Comparison",
    "Design",
    "GainMap",
    "PDSpec",
    "Relaxed",
    "Response",
    "compare",
    "evaluate",
    "gain_map",
    "noise_gain",
    "settling_time",
    "step_response",
    "tune",
]
