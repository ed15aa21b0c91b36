"""The tables of a diagnosis: its parameters, its errors record by record, and what else was tried."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servolens.diagnosis.errors import KEPT
from servolens.diagnosis.logs import BEYOND
from servolens.model_evidence import UNRELIABLE
from servolens.summaries.names import spoken
from servolens.summaries.wording import capital, number, plus_minus, scale, undetermined, unit
from servolens.summary import Table

if TYPE_CHECKING:
    from servolens.diagnosis.result import Diagnosis
    from servolens.model import Quantity

__all__ = ["candidates_table", "data_kinds", "kinds_sentence", "parameters_table", "records_table", "reliance"]

OF_SHAKEN = " *"
"""Marks the error of what is likeliest beside something that shakes the axis: it is in it."""
CANDIDATES = 5
FITTED, HELD_OUT, LEFT_OUT, ITS_END = "fitted", "held out", "left out", "its end"


def parameters_table(diagnosis: Diagnosis) -> Table:
    """Return gain, damping and the causes' parameters with their errors, by the names that the files use."""
    rows = [
        (name.replace(".", " "), _value(quantity), unit(quantity.unit) if quantity.unit != "1" else "")
        for name, quantity in diagnosis.model.quantities.items()
    ]
    title = "Model with the causes" if diagnosis.causes else "Model of gain and damping"
    columns = ("Parameter", "Value ± standard error", "Unit")
    known = undetermined({name.replace(".", " "): quantity for name, quantity in diagnosis.model.quantities.items()})
    note = " ".join(part for part in (reliance(diagnosis), known) if part)
    return Table(title=title, columns=columns, rows=tuple(rows), note=note)


def reliance(diagnosis: Diagnosis) -> str:
    """Return what is to be known of the error bars of a model that leaves more than noise; empty of any other."""
    return UNRELIABLE if diagnosis.verdict in ("partly_explained", "unexplained") else ""


def records_table(diagnosis: Diagnosis) -> Table:
    """Return the error of each record, without and with the causes where there are any."""
    factor, length = scale([gain.before for gain in diagnosis.gains], diagnosis.plant.length_unit)
    rows = []
    for gain, kind in zip(diagnosis.gains, data_kinds(diagnosis), strict=True):
        errors = (gain.before, gain.after) if diagnosis.causes else (gain.before,)
        told = [number(factor * error, 3) for error in errors]
        rows.append((gain.name, kind, *told, number(factor * gain.noise, 2)))
    columns = ("Gain and damping", "With the causes") if diagnosis.causes else ("Error",)
    return Table(
        title=f"R.m.s. error [{length}]",
        columns=("Record", "Data", *columns, "Noise"),
        rows=tuple(rows),
        note=kinds_sentence(diagnosis),
    )


def data_kinds(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Return of each entry of ``gains`` what its model knew of the record."""
    fitted = [FITTED for gain in diagnosis.gains if not gain.heldout]
    return (*fitted, *(_held_out(diagnosis, i) for i in range(len(diagnosis.gains) - len(fitted))))


def kinds_sentence(diagnosis: Diagnosis) -> str:
    """Say what was held out, and from what."""
    kinds = data_kinds(diagnosis)
    told = []
    if HELD_OUT in kinds:
        told.append("Held out: the record took no part in fit and choice.")
    if LEFT_OUT in kinds:
        told.append(
            "Left out: each record in turn, by a model fitted to the others; causes were chosen on all of them."
            if diagnosis.causes
            else "Left out: each record in turn, by a model fitted to the others."
        )
    if ITS_END in kinds:
        end = f"Its end: the last {100 * (1 - KEPT):.0f} % of the record, by a model fitted to its beginning"
        alone = len(diagnosis.experiments) == 1
        told.append(f"{end}." if alone else f"{end} and to the others, whose commands are smaller.")
    return " ".join(told)


def candidates_table(diagnosis: Diagnosis) -> Table | None:
    """Return the best single effects and what each leaves; None where none was tried."""
    best = [*{candidate.effects: candidate for candidate in reversed(diagnosis.candidates)}.values()]
    best = sorted(best, key=lambda candidate: -candidate.likelihood)[:CANDIDATES]
    if not best:
        return None
    floor = max(diagnosis.noise_floor, 1e-300)
    factor, length = scale([candidate.error for candidate in best], diagnosis.plant.length_unit)
    rows = [
        (
            capital(" and ".join(spoken(name) for name in candidate.effects)),
            number(factor * candidate.error, 3) + (OF_SHAKEN if candidate.shaken else ""),
            number(candidate.error / floor, 3),
            number(candidate.likelihood, 3) if candidate.likelihood > 0.0 else "none",
        )
        for candidate in best
    ]
    shaken = any(candidate.shaken for candidate in best)
    return Table(
        title="Best single effects beside gain and damping",
        columns=("Effect", f"Leaves [{length}]", "Times the noise", "Evidence"),
        rows=tuple(rows),
        note="Leaves: r.m.s. error of the training records, simulated from their voltage, with the noise estimated anew"
        " for each effect; not held out. Evidence: increase of twice the log-likelihood, less a penalty for each"
        " parameter; none where gain and damping alone are as likely, if need be beside something that shakes the axis."
        " The answer need not have the most: of effects that leave nothing that depends on the inputs, it is the one"
        " with the fewest parameters."
        + (" *: likeliest beside something that shakes the axis; error of the simulated loop." if shaken else ""),
    )


def _value(quantity: Quantity) -> str:
    """Return value ± error without the percentage, which would break names on a narrow screen."""
    told = plus_minus(quantity)
    return told.partition(" (")[0] if quantity.stderr is not None else told


def _held_out(diagnosis: Diagnosis, i: int) -> str:
    """Return how record `i` of those held out was kept from the fit."""
    if diagnosis.tests:
        return HELD_OUT
    most = [max(abs(end) for end in logged.voltage_range) for logged in diagnosis.experiments]
    others = [most[k] for k in range(len(most)) if k != i]
    return LEFT_OUT if others and most[i] <= BEYOND * max(others) else ITS_END
