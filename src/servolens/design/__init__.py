"""From a spec to the least derivative gain."""

from servolens.design.comparison import compare
from servolens.design.found import Certificate, Comparison, Design, Relaxed, Response
from servolens.design.least_kd import tune
from servolens.design.settle import evaluate, settling_time, step_response
from servolens.design.spec import PDSpec

__all__ = [
    "Certificate",
    "Comparison",
    "Design",
    "PDSpec",
    "Relaxed",
    "Response",
    "compare",
    "evaluate",
    "settling_time",
    "step_response",
    "tune",
]
