"""What a diagnosis makes of measured axes, whose truth nobody knows: Kawata's arm and cart, the CU arm, EMPS.

``python examples/diagnose_measured.py cart`` takes one of them; all together take some minutes. Structure and
parameters are found on the training records alone.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import cu_rotary_arm
import emps
import kawata_arm
import kawata_cart
import numpy as np
from _data import folder

from servolens import Prior, diagnose

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from servolens import Record

DATA_SHEET = {"gain": Prior(value=45.0, deviation=2.0), "damping": Prior(value=23.3, deviation=1.0)}
"""Of the CU arm, by the course's hand-out."""


def main(wanted: Sequence[str]) -> None:
    for name, show_axis in (("arm", arm), ("cart", cart), ("cu", cu), ("emps", screw)):
        if not wanted or name in wanted:
            show_axis()


def arm() -> None:
    records = kawata_arm.read()
    show("Kawata's arm, found on kP 1, 3 and 5", records[::2], records[1::2])


def cart() -> None:
    records = kawata_cart.read()
    show("Kawata's cart, found on all four gains", records)
    show("Kawata's cart, found on kP 2.5, 5 and 10", records[:3], records[3:])


def cu() -> None:
    records = cu_rotary_arm.read()
    show("CU arm, one record and the data sheet", records[:1], records[1:], DATA_SHEET)
    training, others = [records[i] for i in (0, 2, 3)], [records[i] for i in (1, 4)]
    show("CU arm, three records and the data sheet", training, others, DATA_SHEET)
    show("CU arm, three records alone", training, others)


def screw() -> None:
    show("EMPS, training file", [emps.record(folder("emps") / "DATA_EMPS.mat", "training")])


def show(
    title: str, records: Sequence[Record], heldout: Sequence[Record] = (), priors: Mapping[str, Prior] | None = None
) -> None:
    """Diagnose, and print verdict, causes, and each record's error as a share of its step."""
    found = diagnose(records, heldout=heldout, priors=priors)
    print(f"== {title}: {found.verdict}")
    for cause in found.causes:
        values = ", ".join(f"{name} {q.value:.4g} ± {q.stderr or np.nan:.2g}" for name, q in cause.quantities.items())
        rivals = f" (or {', '.join(cause.rivals)})" if cause.rivals else ""
        print(f"   {cause.effect}{rivals}: {values}")
    steps = {record.name: record.step_size for record in (*records, *heldout)}
    for gain in found.gains:
        before, after = (100.0 * error / steps[gain.name] for error in (gain.before, gain.after))
        what = gain.name + (", held out" if gain.heldout else "")
        print(f"   {what:28} {before:8.3g} → {after:.3g} % of the step")
    left = found.remainder
    print(f"   left: {100.0 * left.of_travel:.2g} % of the travel, {'material' if left.material else 'immaterial'}")
    for finding in found.findings:
        if finding.code in ("extrapolation", "small_remainder"):
            print(f"   {finding.record}: {finding.message}" if finding.record else f"   {finding.message}")


if __name__ == "__main__":
    main(sys.argv[1:])
