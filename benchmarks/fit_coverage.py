"""How often the 95 % intervals of ``fit`` hold the truth, for each effect, in every world (``make coverage``).

A cart (β 1.9 m/s²/V, c 6 1/s) with one effect of moderate size visits three levels for 0.8 s each, once at Kp 40 and
once at Kp 100 with Kd 5, at 1 kHz; the usual noise and encoder are 10 µm. Both records are fitted together from values
half as large again as the true ones and from those the effect proposes itself. A share of n repetitions is itself
uncertain by 22/√n percent (one standard deviation).

``python benchmarks/fit_coverage.py --repeats 400 --world white -- backlash cogging`` looks closer at some.
"""

from __future__ import annotations

import time

from coverage_study import Batch, Job, Step, campaign, carried_out
from judging import judged_parameters

from servolens import Plant, fit
from servolens.effects import CATALOGUE
from servolens.errors import ServolensError
from servolens.lab import Truth

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
    "end_stop": {"low": -0.045, "high": 0.096},
    "flexible_coupling": {"frequency": 15.0, "damping_ratio": 0.03, "load_ratio": 0.4},
    "force_limit": {"acceleration": 6.0},
    "friction_map": {
        **{f"positive_{i}": level for i, level in enumerate((0.3, 0.2, 0.4, 0.3, 0.2))},
        **{f"negative_{i}": level for i, level in enumerate((0.2, 0.4, 0.3, 0.2, 0.3))},
        "low": -0.05,
        "high": 0.12,
    },
    "gain_drift": {"rate": 0.02},
    "hardening_spring": {"cubic_stiffness": 500.0},
    "load_friction": {"share": 0.05},
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
RUNS = (Step(40.0, 0.0, (0.1, 0.0, 0.1), 0.8), Step(100.0, 5.0, (0.1, 0.0, -0.05), 0.8))
REPEATS = 40
STARTS_OFF = {"end_stop": 0.9, "friction_map": 1.0}
"""The guess over the truth, where it is not 1.5: a stop must lie within the travel, a map's ends are stated."""
STATED = {("friction_map", "low"), ("friction_map", "high")}
"""Parameters that a fit holds."""


def study(job: Job) -> Batch:
    """Fit the repetitions of a batch."""
    truth = Truth(gain=GAINS.get(job.what, GAIN), damping=DAMPING, effects={job.what: TRUTHS[job.what]})
    guess = Plant.effect_from(
        job.what, {key: STARTS_OFF.get(job.what, 1.5) * value for key, value in TRUTHS[job.what].items()}
    )
    batch, seconds = Batch(job), 0.0
    for seed in job.seeds:
        records = campaign(truth, RUNS, job.world, seed)
        begun = time.process_time()
        try:
            found = fit([guess], records)
        except ServolensError as failure:
            batch.failed.append(str(failure))
            continue
        finally:
            seconds += time.process_time() - begun
        own = {name: found.quantities[f"{job.what}.{name}"] for name in TRUTHS[job.what]}
        errors, held = judged_parameters(job.what, TRUTHS[job.what], own)
        for name, value in (("damping", DAMPING), ("gain", truth.gain)):
            if (name, job.what) != ("gain", "speed_servo"):  # which follows from the servo's own parameters
                error, inside = judged_parameters("", {name: value}, found.quantities)
                errors, held = {**error, **errors}, {**inside, **held}
        for name in held:
            if (job.what, name) not in STATED:
                batch.add(name, errors[name], held[name])
        batch.note(found.findings)
    return Batch(job, batch.held, batch.errors, batch.findings, batch.failed, round(seconds, 3))


if __name__ == "__main__":
    carried_out("effects", [name for name in TRUTHS if name in CATALOGUE], study, REPEATS, str(__doc__))
