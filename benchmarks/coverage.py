"""How often the 95 % intervals of ``identify`` hold the truth, in every world (``make coverage``).

A step to 0.1 m, 1 s at 1 kHz, once a repetition. A share of n repetitions is itself uncertain by 22/√n percent (one
standard deviation). Of the time-varying damping all pieces count as one parameter; its axis has constant damping.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np
from coverage_study import Batch, Job, Step, campaign, carried_out

from servolens import identify
from servolens.errors import ServolensError
from servolens.lab import LM1, NLM1, NLM3, Truth

if TYPE_CHECKING:
    from collections.abc import Iterator

SETUPS: dict[str, tuple[Truth, Step, str]] = {
    "constant, Lm1, Kp 60": (LM1, Step(60.0, 0.0), "constant"),
    "varying, Lm1, Kp 60": (LM1, Step(60.0, 0.0), "varying"),
    "velocity, NLm3, Kp 100": (NLM3, Step(100.0, 0.0), "velocity"),
    "velocity, NLm1, Kp 80, Kd 5": (NLM1, Step(80.0, 5.0), "velocity"),
}
REPEATS = 200
DOUBTED = "beyond_the_law"
"""Finding that says not to rely on the intervals: they count as none."""


def study(job: Job) -> Batch:
    """Identify the repetitions of a batch."""
    truth, step, model = SETUPS[job.what]
    batch = Batch(job)
    seconds = 0.0
    for seed in job.seeds:
        records = campaign(truth, (step,), job.world, seed)
        begun = time.process_time()
        try:
            found = identify(records, model=model)  # type: ignore[arg-type]  # one of the names
        except ServolensError as failure:
            batch.failed.append(str(failure))
            continue
        finally:
            seconds += time.process_time() - begun
        is_doubted = any(finding.code == DOUBTED for finding in found.findings)
        for name, true, value, interval in _compared(truth, found, model):
            held = None if interval is None or is_doubted else bool(interval[0] <= true <= interval[1])
            batch.add(name, abs(value - true) / abs(true), held)
        batch.note(found.findings)
    return Batch(job, batch.held, batch.errors, batch.findings, batch.failed, round(seconds, 3))


def _compared(truth: Truth, found: Any, model: str) -> Iterator[tuple[str, float, float, tuple[float, float] | None]]:
    """Yield name, true value, value and interval of each parameter."""
    true = {"gain": truth.gain, "damping": truth.damping}
    if model == "varying":
        varying = found.varying
        values = [*((truth.damping, "damping", c) for c in varying.damping), (truth.gain, "gain", varying.gain)]
        for (right, name, value), variance in zip(values, np.diag(varying.covariance), strict=True):
            reach = 1.959964 * float(np.sqrt(variance)) if variance >= 0 else np.nan
            interval = (float(value) - reach, float(value) + reach) if np.isfinite(reach) else None
            yield name, right, float(value), interval
        return
    for effect, parameters in truth.effects.items():
        true |= {f"{effect}.{name}": value for name, value in parameters.items()}
    quantities = getattr(found, model).quantities
    for name, right in true.items():
        yield name, right, quantities[name].value, quantities[name].interval


if __name__ == "__main__":
    carried_out("identify", list(SETUPS), study, REPEATS, str(__doc__))
