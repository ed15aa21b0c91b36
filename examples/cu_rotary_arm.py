"""CU rotary arm: identify on one gain, predict the others: the paper's Table I on measured data.

±0.1 rad square waves, 1 kHz, geared motor with heavy stiction; the loop used the rig's own rate signal. The course's
data sheet gives 45 rad/s²/V and 23.3 1/s.
"""

from __future__ import annotations

from _data import folder, show_plant, show_table

from servolens import CoulombFriction, Plant, Record, fit, identify, predict, read_record

RUNS = {"K1_7": (7, 0), "K1_8": (8, 0), "K1_9": (9, 0), "k1k3_7": (7, 0.271), "k1k3_9": (9, 0.377)}
COLUMNS = {
    "time": "t_ms",
    "position": "theta_rad",
    "velocity": "thetadot_rad_s",
    "reference": "ref_rad",
    "voltage": "voltage_V",
}
UNITS = {"time": "ms", "position": "rad", "reference": "rad", "velocity": "rad/s", "voltage": "V"}


def read() -> list[Record]:
    """Return the five runs."""
    data = folder("cu_rotary_arm")
    return [
        read_record(
            data / f"bh2017_rigidarm_{code}.csv",
            settings={
                "kp": kp,
                "kd": kd,
                "derivative": "velocity",
                "encoder_resolution": 1e-3,
                "name": f"K1 = {kp}, K3 = {kd}",
            },
            columns=COLUMNS,
            units=UNITS,
        )
        for code, (kp, kd) in RUNS.items()
    ]


def main() -> None:
    records = read()
    training = records[:1]
    found = identify(training)
    models = {
        "data sheet": Plant(gain=45.0, damping=23.3, length_unit="rad"),
        "constant": found.constant.plant,
        "velocity": found.velocity.plant,
        "Coulomb": fit([CoulombFriction(level=5.0)], training).plant,
    }
    for name, plant in models.items():
        show_plant(name, plant)
    table = predict(models, records)
    show_table(table, {record.name for record in training})
    for finding in found.findings:
        print(f"{finding.severity}: {finding.message}")
    stands = max(standing_error(record) for record in records)
    print(f"Where it fails: the arm stands still up to {stands:.3f} rad from its set point.")
    print(
        "Damping against speed makes it creep there; dry friction holds it, and still misses gains that were not used."
    )


def standing_error(record: Record) -> float:
    """Return the largest error at the end of a step [rad]."""
    return max(abs(float(step.reference[-1] - step.position[-1])) for step in record.steps())


if __name__ == "__main__":
    main()
