"""From records to a gain: the whole chain, which command line, page, demo and scripts share."""

from servolens.study.held_out import diagnosed_prediction, held_out_prediction
from servolens.study.lights import diagnosis_lights
from servolens.study.result import Study
from servolens.study.spec import completed_spec, default_sentence, suggested_spec
from servolens.study.tuning import tune
from servolens.study.workflow import study_records

__all__ = [
    "Study",
    "completed_spec",
    "default_sentence",
    "diagnosed_prediction",
    "diagnosis_lights",
    "held_out_prediction",
    "study_records",
    "suggested_spec",
    "tune",
]
