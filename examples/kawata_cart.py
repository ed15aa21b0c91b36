"""Kawata's cart: identify on kP 2.5, 5 and 10, predict 20; measured, 1 kHz, pure P control, 0.2 m steps.

The book gives a = 6.25 1/s and b = 4.36 m/s²/V. A pendulum hangs from the cart and swings along.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from _data import folder, kawata_record, show_plant, show_table

from servolens import identify, predict

if TYPE_CHECKING:
    from servolens import Record

GAINS = {"025": 2.5, "050": 5.0, "100": 10.0, "200": 20.0}


def read() -> list[Record]:
    """Return the four runs."""
    data = folder("kawata_cart_arm")
    return [
        kawata_record(data / f"cdip_cart_pcont_data_kP_{code}_ref_02.mat", kp, "z", 0.2, f"cart, kP {kp:g}")
        for code, kp in GAINS.items()
    ]


def main() -> None:
    records = read()
    training = records[:3]
    fit = identify(training)
    models = {"constant": fit.constant.plant, "velocity": fit.velocity.plant}
    for name, plant in models.items():
        show_plant(name, plant)
    table = predict(models, records)
    show_table(table, {record.name for record in training})
    known = max(cell.percent_error for row in table.errors[:3] for cell in row)
    unseen = min(cell.percent_error for cell in table.errors[3])
    print(
        f"Where it fails: at kP 20 both models are off by {unseen:.1f} % of the step, at the others by {known:.1f} %."
    )
    print("Damping that depends on speed does not mend it; the cause is another one: see diagnose_measured.py.")


if __name__ == "__main__":
    main()
