"""The virtual laboratory: axes whose truth is known, with any effects, on a bench with a digital PD loop.

Its physics and its numerics are written a second time, with NumPy alone: nothing here derives from the effects or the
simulator of servolens, so that agreement of the two means something. Used by the demo and by the tests.

>>> from servolens import lab
>>> record = lab.step_record(lab.NLM1, kp=60, noise=1e-5, seed=1)
>>> record.name, len(record)
('kp 60, kd 0', 1501)
"""

from servolens.lab.bench import Setup, step_record, step_records
from servolens.lab.campaigns import TABLE_ONE_GAINS, paper_campaign, table_one
from servolens.lab.disturbances import Jitter, SensorNoise, Shaking, Surroundings
from servolens.lab.foreign import FOREIGN
from servolens.lab.hidden import HiddenCampaign, hidden_campaign
from servolens.lab.truth import LM1, LM2, LM3, NLM1, NLM2, NLM3, Truth
from servolens.lab.worlds import WORLDS, surroundings

__all__ = [
    "FOREIGN",
    "LM1",
    "LM2",
    "LM3",
    "NLM1",
    "NLM2",
    "NLM3",
    "TABLE_ONE_GAINS",
    "WORLDS",
    "HiddenCampaign",
    "Jitter",
    "SensorNoise",
    "Setup",
    "Shaking",
    "Surroundings",
    "Truth",
    "hidden_campaign",
    "paper_campaign",
    "step_record",
    "step_records",
    "surroundings",
    "table_one",
]
