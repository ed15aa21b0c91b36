"""Identification of ten million samples: linear in samples, quick, and modest in memory.

The cart NLm1 under a square wave at Kp 60, 1 kHz, 10 µm encoder: 10 000 s with 6667 steps of 0.1 m, by repeating 900 s
that the kernel simulates. ``identify(record, model="constant")`` runs in a process of its own; its memory is the peak
of that process over what it held before there was any data, and so includes the data (time, reference, position and
voltage). All samples enter the fit; the errors in the result are those of the first 200 000 samples, and it says so.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from statistics import median

import numpy as np
from harness import Figure

from servolens import Controller, Plant, Record, identify, simulate_loop
from servolens.effects import VelocityDecayDamping

LONG, SHORT, PIECE = 10_000_000, 1_000_000, 900_000
CART = Plant(gain=1.9165, damping=5.9986, effects=(VelocityDecayDamping(alpha1=17.3264, alpha2=13.1068),))
LOOP = Controller(kp=60.0)
ENCODER = 1e-5


def figures() -> list[Figure]:
    """Measure, each length three times in turn."""
    long, short = [], []
    for _ in range(3):
        long.append(_in_a_process(LONG))
        short.append(_in_a_process(SHORT))
    seconds = median(run["seconds"] for run in long)
    ratio = seconds / LONG / (median(run["seconds"] for run in short) / SHORT)
    memory = median(run["memory"] for run in long)
    name = "identify 10⁷ samples, constant model"
    return [
        Figure(name=f"{name}: time", value=seconds, unit="s", target=2, better="lower"),
        Figure(name=f"{name}: time a sample relative to 10⁶", value=ratio, unit="times", target=1.3, better="lower"),
        Figure(name=f"{name}: peak memory relative to the data", value=memory, unit="times", target=4, better="lower"),
    ]


def _in_a_process(samples: int) -> dict[str, float]:
    done = subprocess.run([sys.executable, __file__, str(samples)], check=True, capture_output=True, text=True)
    found: dict[str, float] = json.loads(done.stdout)
    return found


def _measure(samples: int) -> dict[str, float]:
    identify(_record(20_000), model="constant")
    before = _peak()
    record = _record(samples)
    start = time.perf_counter()
    fit = identify(record, model="constant")
    seconds = time.perf_counter() - start
    assert fit.constant is not None
    return {"seconds": seconds, "memory": (_peak() - before) / (4 * 8 * samples), "gain": fit.constant.plant.gain}


def _record(samples: int) -> Record:
    count = min(PIECE, samples)
    reference = np.where(np.arange(count) // 1500 % 2 == 0, 0.1, 0.0)
    run = simulate_loop(CART, LOOP, 1e-3 * np.arange(count), reference, resolution=ENCODER)
    grid = np.arange(samples, dtype=np.float64)
    grid *= 1e-3
    signals = {"time": grid}
    for name, part in (("reference", reference), ("position", run.measured), ("voltage", run.voltage)):
        signals[name] = np.resize(part, samples) if samples <= count else _repeated(part, samples)
    for signal in signals.values():
        signal.flags.writeable = False
    return Record(**signals, controller=LOOP, encoder_resolution=ENCODER)


def _repeated(part: np.ndarray, samples: int) -> np.ndarray:
    whole = np.empty(samples)
    for first in range(0, samples, part.size):
        stop = min(first + part.size, samples)
        whole[first:stop] = part[: stop - first]
    return whole


def _peak() -> int:
    """Return the most memory that this process has held [bytes]."""
    unit = 1 if sys.platform == "darwin" else 1024
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


if __name__ == "__main__":
    print(json.dumps(_measure(int(sys.argv[1]))))
