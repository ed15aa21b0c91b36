"""How often the 95 % intervals of ``fit_effects`` hold the truth, for each effect (``make coverage``).

A cart (β 1.9 m/s²/V, c 6 1/s) with one effect of moderate size visits three levels for 0.8 s each, once at Kp 40 and
once at Kp 100 with Kd 5, at 1 kHz with noise and encoder of 10 µm. Both records are fitted together from values half as
large again as the true ones and from those the effect proposes itself. A parameter without an interval counts as
missed, and so does a fit that fails.

A share of n repetitions is itself uncertain by 22/√n percent (one standard deviation). A parameter is marked if its
share would be so far from 95 % in one of a hundred such studies only: with 100 repetitions at 88 % and below.
Among all these parameters chance alone marks about one.

``python benchmarks/fit_coverage.py --repeats 400 backlash cogging`` looks closer at some.
"""

from __future__ import annotations

import argparse
import os
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import binomtest

from servolens import Plant
from servolens.errors import InputError, NumericalError
from servolens.identification.effects_fit import fit_effects
from servolens.lab import Truth, step_records

if TYPE_CHECKING:
    from servolens.model import Quantity

GAIN, DAMPING = 1.9, 6.0
TRUTHS: dict[str, dict[str, float]] = {
    "actuator_lag": {"time_constant": 0.005},
    "asymmetric_damping": {"damping_difference": 1.0},
    "asymmetric_friction": {"level_positive": 0.4, "level_negative": 0.2},
    "backlash": {"gap": 0.001, "load_share": 0.4},
    "cogging": {"amplitude": 0.2, "pitch": 0.02, "phase": 0.5},
    "constant_force": {"acceleration": 0.2},
    "coulomb_friction": {"level": 0.3},
    "dead_zone": {"width": 0.2},
    "delay": {"time": 0.003},
    "flexible_coupling": {"frequency": 15.0, "damping_ratio": 0.03, "load_ratio": 0.4},
    "force_limit": {"acceleration": 6.0},
    "gain_drift": {"rate": 0.02},
    "hardening_spring": {"cubic_stiffness": 500.0},
    "pendulum_gravity": {"amplitude": 1.0, "phase": 0.5},
    "periodic_disturbance": {"amplitude": 0.2, "frequency": 3.0, "phase": 0.5},
    "position_friction": {"level": 0.5, "centre": 0.05, "width": 0.02},
    "presliding": {"stiffness": 2000.0, "level": 0.3},
    "quadratic_drag": {"drag": 2.0},
    "return_spring": {"stiffness": 5.0},
    "saturation": {"limit": 3.0},
    "sensor_lag": {"time_constant": 0.005},
    "speed_servo": {"speed_per_volt": 0.1, "proportional": 40.0, "integral": 300.0},
    "stribeck_friction": {"level": 0.2, "static_excess": 0.2, "stribeck_speed": 0.02},
    "velocity_decay_damping": {"alpha1": 17.3264, "alpha2": 13.1068},
}
"""SI; the last is the paper's."""
GAINS = {"speed_servo": 4.0}
"""Where the effect sets the gain."""
RUNS = ((40.0, 0.0, (0.1, 0.0, 0.1)), (100.0, 5.0, (0.1, 0.0, -0.05)))
"""Kp, Kd, and the levels that are visited [m]."""
EACH, NOISE, ENCODER, SEED = 0.8, 1e-5, 1e-5, 20261122
REPEATS, AT_ONCE = 40, 10
CHANCE = 0.01
"""Probability of a share, were the truth 95 %, below which a parameter is marked."""


@dataclass(frozen=True, slots=True)
class Batch:
    """What some repetitions of one effect gave.

    Attributes
    ----------
    errors : dict of str to list of float
        Of each parameter, relative; of a phase in rad.
    held : dict of str to list of bool
        Whether the interval held the truth; False where there is none.
    bare : dict of str to int
        How many had no interval.
    failed : list of str
        What fits that failed said.
    seconds : float
        Time in fits.
    """

    errors: dict[str, list[float]]
    held: dict[str, list[bool]]
    bare: dict[str, int]
    failed: list[str]
    seconds: float


def main() -> None:
    """Print a table: effect, parameter, share of intervals that hold the truth, median relative error."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("effects", nargs="*", metavar="effect", help="effects to look at; all by default")
    parser.add_argument("--repeats", type=int, default=REPEATS, help="of each effect (default %(default)s)")
    asked = parser.parse_args()
    chosen = [name for name in asked.effects or TRUTHS if _known(name)]
    os.environ.update({"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"})  # a process for each core is enough
    print(
        f"{'effect':<24}{'parameter':<20}{'interval':>9}{'median':>10}{'none':>6}{'failed':>8}{'s a fit':>9}",
        flush=True,
    )
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        jobs = {
            name: [pool.submit(study, name, first, asked.repeats) for first in range(0, asked.repeats, AT_ONCE)]
            for name in chosen
        }
        marked = [line for name, parts in jobs.items() for line in _shown(name, [part.result() for part in parts])]
    print(f"not 95 %: {', '.join(marked) or 'none'}")


def study(name: str, first: int, repeats: int) -> Batch:
    """Fit the repetitions from `first` on, a batch of them."""
    values = TRUTHS[name]
    truth = _truth(name)
    plant = Plant(gain=truth.gain, damping=truth.damping, effects=(Plant.effect_from(name, values),))
    guess = Plant.effect_from(name, {key: 1.5 * value for key, value in values.items()})
    true = {key: value for key, value in zip(plant.parameters, plant.values, strict=True) if key not in plant.derived}
    count = min(AT_ONCE, repeats - first)
    seeds = np.random.SeedSequence([SEED, first]).spawn(len(RUNS))
    runs = [
        step_records(
            truth, kp, kd, repeats=count, seed=seed, reference=levels, duration=EACH, noise=NOISE, encoder=ENCODER
        )
        for (kp, kd, levels), seed in zip(RUNS, seeds, strict=True)
    ]
    found = Batch({key: [] for key in true}, {key: [] for key in true}, dict.fromkeys(true, 0), [], 0.0)
    begun = time.perf_counter()
    for records in zip(*runs, strict=True):
        try:
            quantities = fit_effects(records, [guess]).quantities
        except (InputError, NumericalError) as failure:
            found.failed.append(str(failure))
            continue
        for key, value in true.items():
            _judge(found, key, value, quantities[key])
    return Batch(found.errors, found.held, found.bare, found.failed, time.perf_counter() - begun)


def _judge(found: Batch, key: str, true: float, quantity: Quantity) -> None:
    error, unit = quantity.value - true, abs(true)
    if key.endswith(".phase"):
        error, unit = (error + np.pi) % (2 * np.pi) - np.pi, 1.0
    found.errors[key].append(abs(error) / unit)
    interval = quantity.interval
    found.bare[key] += interval is None
    found.held[key].append(interval is not None and abs(error) <= (interval[1] - interval[0]) / 2)


def _known(name: str) -> bool:
    """Tell whether the laboratory has the effect; say so if not."""
    if name not in TRUTHS:
        raise SystemExit(f"no truth is stated for {name}; known are {', '.join(TRUTHS)}")
    try:
        _truth(name)
    except InputError as failure:
        print(f"{name} is left out: {failure}")
        return False
    return True


def _truth(name: str) -> Truth:
    return Truth(gain=GAINS.get(name, GAIN), damping=DAMPING, effects={name: TRUTHS[name]})


def _shown(name: str, batches: list[Batch]) -> list[str]:
    """Print the lines of one effect, and return the parameters to be marked."""
    failed = [sentence for batch in batches for sentence in batch.failed]
    seconds, marked = sum(batch.seconds for batch in batches), []
    for key in batches[0].held:
        held, errors = ([x for batch in batches for x in getattr(batch, what)[key]] for what in ("held", "errors"))
        bare, total = sum(batch.bare[key] for batch in batches), len(held) + len(failed)
        share = 100.0 * sum(held) / total
        median = f"{np.median(errors):>10.1e}" if errors else f"{'–':>10}"
        outside = binomtest(sum(held), total, 0.95).pvalue < CHANCE
        tail = f"{bare:>6}{len(failed):>8}{seconds / total:>9.2f}{'  <' if outside else ''}"
        print(f"{name:<24}{key.rpartition('.')[2]:<20}{share:>7.1f} %{median}{tail}", flush=True)
        marked += [f"{name}: {key.rpartition('.')[2]} {share:.0f} %"] if outside else []
    if failed:
        print(f"  {name}, first failure: {failed[0]}")
    return marked


if __name__ == "__main__":
    main()
