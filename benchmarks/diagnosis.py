"""The time of a diagnosis: three records and one held out, 3 000 samples each, dry friction hidden, all the catalogue.

Whole processes of the command. Cold means that neither numba nor servolens finds anything compiled. And the time of the
whole chain from three clean records to a gain, in memory.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from statistics import median

import numpy as np
from harness import Figure, processor_time
from start_up import SERVOLENS, seconds

from servolens import PDSpec, Record, diagnose, lab, tune

AXIS = lab.Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.4}})
SPEC = PDSpec(kp=100, settling_time=0.5)
GAINS = ((40, 0), (60, 0), (80, 2), (100, 4))


def figures() -> list[Figure]:
    """Measure."""
    records = [
        lab.step_record(AXIS, kp, kd, reference=(0.1, 0.0), duration=1.5, noise=1e-5, seed=kp) for kp, kd in GAINS
    ]
    with tempfile.TemporaryDirectory() as folder:
        paths = [_logged(record, Path(folder) / f"run{i}.csv") for i, record in enumerate(records)]
        place = {"SERVOLENS_CACHE": f"{folder}/kernels", "NUMBA_CACHE_DIR": f"{folder}/numba"}
        command = [SERVOLENS, "diagnose", *paths[:3], "--heldout", paths[3]]
        cold = seconds(command, place)
        warm = median(seconds(command, place) for _ in range(3))
    diagnose(records[:3], heldout=records[3])
    again = median(_diagnosed(records) for _ in range(3))
    found = [("kernels on disk", warm, 4.0), ("in memory", again, None), ("cold", cold, 20.0)]
    what = "diagnose, 3 + 1 records × 3 000 samples"
    clean = [lab.step_record(lab.NLM3, kp, duration=3.0, noise=1e-5, seed=kp) for kp in (60, 80, 100)]
    tune(clean, SPEC)
    found_by_chain = np.median([_tuned(clean) for _ in range(3)], axis=0)
    chain = "tune, 3 clean records × 3 000 samples, in memory"
    figures = [
        Figure(name=f"{what}: time, {name}", value=value, unit="s", target=target, better="lower")
        for name, value, target in found
    ]
    clocks = zip(("time", "time of all processors"), found_by_chain, strict=True)
    return figures + [
        Figure(name=f"{chain}: {clock}", value=float(value), unit="s", target=6.0, better="lower")
        for clock, value in clocks
    ]


def _tuned(records: list[Record]) -> tuple[float, float]:
    """Return the time that passes, and that of all processors."""
    wall, processors = time.perf_counter(), processor_time()
    tune(records, SPEC)
    return time.perf_counter() - wall, processor_time() - processors


def _diagnosed(records: list[Record]) -> float:
    begun = time.perf_counter()
    diagnose(records[:3], heldout=records[3])
    return time.perf_counter() - begun


def _logged(record: Record, path: Path) -> str:
    loop, columns = record.controller, (record.time, record.reference, record.position, record.voltage)
    assert loop is not None
    head = f"# kp = {loop.kp} V/m\n# kd = {loop.kd} V s/m\ntime [s],reference [m],position [m],voltage [V]"
    np.savetxt(path, np.column_stack([column for column in columns if column is not None]), "%.9g", ",", header=head,
               comments="")  # fmt: skip
    return str(path)
