"""From a spec to the least derivative gain, and to the one to use."""

from servolens.design.comparison import compare
from servolens.design.found import Certificate, Comparison, Design, Light, Recommended, Relaxed, Response
from servolens.design.gain_plane import GainMap, gain_map, noise_gain
from servolens.design.least_kd import tune
from servolens.design.limit_cycle import Hunting, hunting
from servolens.design.plant_inverse import Tracking, feedforward, tracking
from servolens.design.recommended import recommend
from servolens.design.settle import evaluate, settling_time, step_response
from servolens.design.spec import PDSpec
from servolens.design.trust import trust

__all__ = [
    "Certificate",
    "Comparison",
    "Design",
    "GainMap",
    "Hunting",
    "Light",
    "PDSpec",
    "Recommended",
    "Relaxed",
    "Response",
    "Tracking",
    "compare",
    "evaluate",
    "feedforward",
    "gain_map",
    "hunting",
    "noise_gain",
    "recommend",
    "settling_time",
    "step_response",
    "tracking",
    "trust",
    "tune",
]
