"""What one waits for: the import, the help text, and the demo with and without its compiled kernels.

Whole processes. Cold means that neither numba nor servolens finds anything compiled; Python's own bytecode is there.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from harness import Figure

SERVOLENS = str(Path(sys.executable).with_name("servolens"))


def figures() -> list[Figure]:
    """Measure."""
    found = [
        ("import servolens", median(seconds([sys.executable, "-c", "import servolens"]) for _ in range(9)), 0.35),
        ("servolens --help", median(seconds([SERVOLENS, "--help"]) for _ in range(9)), 0.5),
    ]
    with tempfile.TemporaryDirectory() as folder:
        place = {"SERVOLENS_CACHE": f"{folder}/kernels", "NUMBA_CACHE_DIR": f"{folder}/numba"}
        demo = [SERVOLENS, "demo", "--out", f"{folder}/demo"]
        found.append(("servolens demo, cold", seconds(demo, place), 30.0))
        found.append(("servolens demo, warm", median(seconds(demo, place) for _ in range(3)), 10.0))
    return [Figure(name=name, value=value, unit="s", target=target, better="lower") for name, value, target in found]


def seconds(command: list[str], changes: dict[str, str] | None = None) -> float:
    """Return how long the whole process takes [s]; end where it fails."""
    start = time.perf_counter()
    done = subprocess.run(command, env={**os.environ, **(changes or {})}, capture_output=True, text=True, check=False)
    seconds = time.perf_counter() - start
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(command)} failed:\n{done.stderr}")
    return seconds
