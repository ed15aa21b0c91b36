"""Kawata's rotary arm: identify on kP 1, 3 and 5, predict 2 and 4; measured, 1 kHz, pure P control, 1 rad steps.

The book gives a = 6.20 1/s and b = 15.8 rad/s²/V.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from _data import folder, kawata_record, show_plant, show_table

from servolens import identify, predict

if TYPE_CHECKING:
    from servolens import Record


def read() -> list[Record]:
    """Return the five runs."""
    data = folder("kawata_cart_arm")
    return [
        kawata_record(data / f"adip_arm_pcont_data_kP_{kp}_ref_1.mat", kp, "theta1", 1.0, f"arm, kP {kp}")
        for kp in (1, 2, 3, 4, 5)
    ]


def main() -> None:
    records = read()
    training = records[::2]
    fit = identify(training)
    models = {"constant": fit.constant.plant, "velocity": fit.velocity.plant}
    for name, plant in models.items():
        show_plant(name, plant)
    table = predict(models, records)
    show_table(table, {record.name for record in training})
    constant = max(row[0].percent_error for row in table.errors)
    print(
        f"The constant model is off by {constant:.2f} % of the step at worst: this arm is a linear plant for a P loop."
    )


if __name__ == "__main__":
    main()
