"""How often 95 % intervals hold the truth: 1 000 noisy repetitions of three set-ups (``make coverage``)."""

from __future__ import annotations

import numpy as np

from servolens import Plant, identify
from servolens.lab import LM1, NLM1, NLM3, Truth, step_records

SETUPS: tuple[tuple[str, Truth, float, float, str], ...] = (
    ("Lm1, Kp 60, constant", LM1, 60.0, 0.0, "constant"),
    ("NLm3, Kp 100, velocity", NLM3, 100.0, 0.0, "velocity"),
    ("NLm1, Kp 80, Kd 5, velocity", NLM1, 80.0, 5.0, "velocity"),
)
REPEATS, SEED = 1000, 20261122


def main() -> None:
    """Print a table: the share of repetitions in which each parameter's interval holds its true value."""
    for title, truth, kp, kd, model in SETUPS:
        effects = tuple(Plant.effect_from(name, values) for name, values in truth.effects.items())
        plant = Plant(gain=truth.gain, damping=truth.damping, effects=effects)
        inside = np.zeros(len(plant.values))
        for record in step_records(truth, kp, kd, repeats=REPEATS, seed=SEED, noise=1e-5, encoder=1e-5, duration=1.0):
            found = identify(record, model=model).model  # type: ignore[arg-type]  # one of the names
            spread = np.sqrt(np.diag(found.covariance))
            inside += np.abs(np.array(found.plant.values) - plant.values) <= 1.959964 * spread
        shares = ", ".join(
            f"{name} {100 * n / REPEATS:.1f} %" for name, n in zip(plant.parameters, inside, strict=True)
        )
        print(f"{title}: {shares}")


if __name__ == "__main__":
    main()
