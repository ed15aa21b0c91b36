"""Hold designs for random plants against a dense scan: which gains are wrong, and which were missed.

    python benchmarks/design_scan.py [--plants 1000] [--first 0] [--gains 600] [--seed 1] [--minutes 10]

Gains of 1e-2 to 1e4, dry friction that stops the axis about the edge of the band, couplings, delays, lags, play, coarse
sampling, limits of overshoot and voltage. Each gain of the scan is simulated over ten settling times by
:func:`servolens.design.evaluate`.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from servolens.design import PDSpec, evaluate, tune
from servolens.effects import (
    ActuatorLag,
    Backlash,
    ConstantForce,
    CoulombFriction,
    Delay,
    FlexibleCoupling,
    Saturation,
    SensorLag,
    StribeckFriction,
    VelocityDecayDamping,
)
from servolens.plant import Plant

if TYPE_CHECKING:
    from collections.abc import Callable

    from servolens.design import Design
    from servolens.effects import Effect

KINDS = ("plain", "decay", "coulomb", "stribeck", "saturation", "coupling", "delay", "lag", "sensor", "force", "play")


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A plant and what is asked of its gain."""

    kind: str
    plant: Plant
    spec: PDSpec


def random_case(rng: np.random.Generator) -> Case:
    """Return a plant and a spec that its gain may or may not meet."""
    kind = str(rng.choice(KINDS))
    gain = float(10.0 ** rng.uniform(-2.0, 4.0))
    frequency = float(10.0 ** rng.uniform(0.3, 1.7))
    damping = float(frequency * rng.uniform(0.0, 1.0))
    settling_time = float(rng.uniform(3.0, 15.0) / frequency)
    reference = float(rng.choice([0.01, 0.1, 1.0]))
    band = float(rng.choice([0.005, 0.01, 0.02, 0.05]))
    spec = PDSpec(
        kp=frequency**2 / gain,
        settling_time=settling_time,
        band=band,
        reference=reference,
        overshoot=float(rng.uniform(0.0, 0.3)) if rng.random() < 0.2 else None,
        voltage_limit=None,
        kd_max=float(frequency / gain * 10.0 ** rng.uniform(0.3, 2.5)) if rng.random() < 0.5 else None,
        sample_time=settling_time / float(10.0 ** rng.uniform(1.0, 2.7)),
        derivative_filter=1.0 if rng.random() < 0.7 else float(rng.uniform(0.1, 1.0)),
    )
    if rng.random() < 0.15:
        spec = replace(spec, voltage_limit=spec.kp * reference * float(rng.uniform(0.9, 2.0)))
    effects = _effects(kind, rng, spec, frequency, gain)
    if "delay" not in (effect.name for effect in effects) and rng.random() < 0.2:
        spec = replace(spec, control="continuous")
    return Case(kind=kind, plant=Plant(gain=gain, damping=damping, effects=effects), spec=spec)


def _effects(kind: str, rng: np.random.Generator, spec: PDSpec, frequency: float, gain: float) -> tuple[Effect, ...]:
    edge = frequency**2 * spec.band * abs(spec.reference)  # the level that can hold the axis at the edge of the band
    speed = frequency * abs(spec.reference)
    made: dict[str, Callable[[], Effect]] = {
        "decay": lambda: VelocityDecayDamping(
            alpha1=frequency * rng.uniform(0.5, 2.0), alpha2=rng.uniform(0.5, 5.0) / speed
        ),
        "coulomb": lambda: CoulombFriction(level=edge * 10.0 ** rng.uniform(-0.5, 0.5)),
        "stribeck": lambda: StribeckFriction(
            level=edge * rng.uniform(0.3, 1.5), static_excess=edge * rng.uniform(0.1, 1.0), stribeck_speed=0.02 * speed
        ),
        "saturation": lambda: Saturation(limit=spec.kp * abs(spec.reference) * rng.uniform(0.2, 0.9)),
        "coupling": lambda: FlexibleCoupling(
            frequency=frequency * rng.uniform(1.0, 10.0) / 6.28,
            damping_ratio=10.0 ** rng.uniform(-2.5, -0.5),
            load_ratio=rng.uniform(0.1, 0.7),
        ),
        "delay": lambda: Delay(time=rng.uniform(0.01, 0.3) / frequency),
        "lag": lambda: ActuatorLag(time_constant=rng.uniform(0.01, 0.3) / frequency),
        "sensor": lambda: SensorLag(time_constant=rng.uniform(0.01, 0.3) / frequency),
        "force": lambda: ConstantForce(acceleration=edge * rng.uniform(-1.2, 1.2)),
        "play": lambda: Backlash(gap=spec.band * abs(spec.reference) * rng.uniform(0.1, 2.0), load_share=0.3),
    }
    found = [made[kind]()] if kind in made else []
    if kind in ("coupling", "delay", "decay") and rng.random() < 0.3:
        found.append(CoulombFriction(level=edge * rng.uniform(0.3, 1.5)))
    return tuple(found)


def mistakes(case: Case, design: Design, gains: int, rng: np.random.Generator) -> list[str]:
    """Return what a dense scan finds wrong about a design."""
    plant, spec, gap = case.plant, case.spec, design.certificate.gap
    top = design.certificate.searched[1]
    scale = float(np.sqrt(spec.kp / abs(plant.gain)))
    scan = scale * np.sinh(np.linspace(0.0, np.arcsinh(top / scale), gains))
    scan = np.clip(scan + rng.uniform(-0.5, 0.5, gains) * np.gradient(scan), 0.0, top)
    found = []
    if design.kd is not None and not evaluate(plant, spec, design.kd).meets:
        found.append(f"returned {design.kd:.8g}, which fails")

    def meets(kd: float) -> bool:
        return evaluate(plant, spec, float(np.clip(kd, 0.0, top))).meets

    for kd in (float(kd) for kd in scan):
        distance = min((max(low - kd, kd - high) for low, high in design.intervals), default=np.inf)
        does = meets(kd)
        if does and distance > gap and any(all(map(meets, (kd + s * gap, kd + s * gap / 2))) for s in (-1.0, 1.0)):
            found.append(f"missed {kd:.8g}")
        if not does and distance < -gap and not any(map(meets, (kd - gap / 2, kd + gap / 2))):
            found.append(f"hole at {kd:.8g}")
    return found


def main() -> None:
    """Scan."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plants", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0, help="the number of the first plant, to scan in pieces")
    parser.add_argument("--gains", type=int, default=600)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=np.inf, help="after which no further plant is begun")
    chosen = parser.parse_args()
    wrong, feasible, spent = 0, 0, []
    begun = time.perf_counter()
    for i in range(chosen.first, chosen.first + chosen.plants):
        if time.perf_counter() - begun > 60.0 * chosen.minutes:
            break
        rng = np.random.default_rng((chosen.seed, i))
        case = random_case(rng)
        start = time.process_time()
        design = tune(case.plant, case.spec)
        spent.append(time.process_time() - start)
        feasible += design.feasible
        found = mistakes(case, design, chosen.gains, rng)
        wrong += bool(found)
        for text in found[:3]:
            print(f"{i} ({case.kind}): {text}; {len(found)} mistakes; {design.intervals}")
        if spent[-1] > 5.0:
            print(f"{i} ({case.kind}): {spent[-1]:.1f} s, gap {design.certificate.gap:.3g}", flush=True)
    print(
        f"{len(spent)} plants, {feasible} feasible; {wrong} with a mistake; a design takes, on one processor, "
        f"{np.median(spent):.3f} s (median), {np.quantile(spent, 0.95):.3f} s (95 %), {max(spent):.1f} s (longest)"
    )
    raise SystemExit(wrong > 0)


if __name__ == "__main__":
    main()
