"""From a spec to the least derivative gain, and to the one to use."""

from servolens.design.command_noise import noise_gain
from servolens.design.comparison import Comparison, compare
from servolens.design.confidence import trust
from servolens.design.found import Certificate, Design, Light, Recommended, Relaxed
from servolens.design.gain_plane import GainMap, gain_map, map_axes
from servolens.design.gains_found import GainsFound
from servolens.design.least_kd import tune
from servolens.design.limit_cycle import Hunting, hunting
from servolens.design.plant_inverse import Tracking, feedforward, tracking
from servolens.design.recommended import recommend
from servolens.design.response import Response
from servolens.design.settle import evaluate, settling_time, step_response
from servolens.design.several_gains import tune_gains
from servolens.design.spec import PDSpec
from servolens.design.wishes import GainWishes

__all__ = [
    "Certificate",
    "Comparison",
    "Design",
    "GainMap",
    "GainWishes",
    "GainsFound",
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
    "map_axes",
    "noise_gain",
    "recommend",
    "settling_time",
    "step_response",
    "tracking",
    "trust",
    "tune",
    "tune_gains",
]
