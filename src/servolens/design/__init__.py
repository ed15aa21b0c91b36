"""From a spec to the least derivative gain."""

from servolens.design.comparison import compare
from servolens.design.least_kd import tune
from servolens.design.settle import evaluate, settling_time, step_response
from servolens.design.spec import Comparison, Design, PDSpec, Response

__all__ = [
    "Comparison",
    "Design",
    "PDSpec",
    "Response",
    "compare",
    "evaluate",
    "settling_time",
    "step_response",
    "tune",
]
