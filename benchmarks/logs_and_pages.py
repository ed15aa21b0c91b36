"""The time of a long log, and time and size of a page: CSV of a million rows; eleven records, all of the diagnosis.

Both in memory, after a first call. The page is that of ``servolens report``: eleven steps of the cart with another gain
each, 0.3 s long as the paper's.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np
from harness import Figure, median_time, processor_time

from servolens import PDSpec, lab, read_record
from servolens.report import write_report

ROWS = 1_000_000
GAINS = range(40, 95, 5)
SPEC = PDSpec(kp=100, settling_time=0.5)


def figures() -> list[Figure]:
    """Measure."""
    with tempfile.TemporaryDirectory() as folder:
        seconds = _read(Path(folder) / "long.csv")
        wall, processors, size = _page(Path(folder) / "report.html")
    page = f"page of {len(GAINS)} records, full diagnosis"
    return [
        Figure(name="CSV of 10⁶ rows, 4 columns: time", value=seconds, unit="s", target=0.6, better="lower"),
        Figure(name=f"{page}: time, warm", value=wall, unit="s", target=15.0, better="lower"),
        Figure(name=f"{page}: time of all processors", value=processors, unit="s", target=None, better="lower"),
        Figure(name=f"{page}: size", value=size, unit="MB", target=3.0, better="lower"),
    ]


def _read(path: Path) -> float:
    time_ = np.arange(ROWS) * 1e-3
    position = 0.05 * np.sin(time_)
    rows = np.column_stack([time_, 0.1 * np.sign(np.sin(time_ / 3)), position, 6.0 * np.cos(time_)])
    np.savetxt(path, rows, fmt=("%.3f", "%.1f", "%.5f", "%.3f"), delimiter=",", comments="",
               header="time [s],reference [m],position [m],voltage [V]")  # fmt: skip
    settings = {"kp": 60, "kd": 0}
    assert len(read_record(path, settings=settings)) == ROWS
    return median_time(lambda: read_record(path, settings=settings))


def _page(path: Path) -> tuple[float, float, float]:
    """Return the time that passes, that of all processors, and the size [MB]."""
    records = [lab.step_record(lab.NLM3, kp, duration=0.3, noise=1e-5, seed=kp) for kp in GAINS]
    write_report(path, records, spec=SPEC)
    wall, processors = time.perf_counter(), processor_time()
    write_report(path, records, spec=SPEC)
    return time.perf_counter() - wall, processor_time() - processors, path.stat().st_size / 1e6


if __name__ == "__main__":
    from harness import table

    print(table(figures()))
