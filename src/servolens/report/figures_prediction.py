"""The first picture: what was measured, and what models predict that never saw it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.report.curves import curve
from servolens.report.drawing import drawing, keys_of
from servolens.report.plots import plot_curves
from servolens.report.style import ALONE, HALF_WIDTH, stacked_figure, styled
from servolens.report.wording import shown
from servolens.summaries.diagnosis_tables import data_kinds, kinds_sentence
from servolens.summaries.wording import scale

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from servolens.diagnosis import Diagnosis
    from servolens.record import Record
    from servolens.report.content import Drawing, Key
    from servolens.report.curves import Role

__all__ = ["prediction_figure"]

MOST_RECORDS = 4
MODELS: tuple[tuple[str, Role], ...] = (("gain and damping", "constant"), ("with the causes", "velocity"))


@styled
def prediction_figure(key: str, diagnosis: Diagnosis) -> Drawing | None:
    """Draw records that were held out, or else each left out of a fit, as they were measured and as predicted.

    None where no simulation stays in bounds.
    """
    records = diagnosis.heldout or diagnosis.records
    kinds = data_kinds(diagnosis)[-len(records) :]
    found = [(r, k, m) for r, k, m in zip(records, kinds, diagnosis.missed, strict=True) if _known(diagnosis, m)]
    drawn = _most_telling(found)
    if not drawn:
        return None
    largest = [float(np.abs(miss).max()) for *_, own in drawn for miss in own if np.isfinite(miss).all()]
    factor, unit = scale(largest, diagnosis.plant.length_unit)
    figures, legend = [], dict[str, "Key"]()
    for record, kind, missed in drawn:
        alone = len(drawn) == 1
        figure, above, below = stacked_figure(3.7 if alone else 3.3, ALONE if alone else HALF_WIDTH, 1.9)
        _draw(diagnosis, record, missed, factor, (above, below))
        above.set_title(f"{shown(record.name)} ({kind})")
        below.set_ylabel(f"Predicted −\nmeasured [{unit}]")
        legend |= {own.label: own for own in keys_of(above)}
        figures.append(figure)
    return drawing(key, figures, _caption(diagnosis, len(records) - len(drawn)), legend=[*legend.values()])


def _known(diagnosis: Diagnosis, missed: tuple[NDArray[np.float64], ...]) -> bool:
    return any(np.isfinite(miss).all() for _, miss in _models(diagnosis, missed))


def _models(
    diagnosis: Diagnosis, missed: tuple[NDArray[np.float64], ...]
) -> list[tuple[tuple[str, Role], NDArray[np.float64]]]:
    """Return what each model misses; without causes there is one."""
    return [*zip(MODELS, missed if diagnosis.causes else missed[:1], strict=False)]


def _most_telling(
    found: list[tuple[Record, str, tuple[NDArray[np.float64], NDArray[np.float64]]]],
) -> list[tuple[Record, str, tuple[NDArray[np.float64], NDArray[np.float64]]]]:
    """Return those that the model of gain and damping misses most, in their order: what is drawn is not the best."""
    sizes = [float(np.sqrt(np.mean(missed[0] ** 2))) for *_, missed in found]
    chosen = sorted(range(len(found)), key=lambda i: -sizes[i])[:MOST_RECORDS]
    return [found[i] for i in sorted(chosen)]


def _draw(
    diagnosis: Diagnosis,
    record: Record,
    missed: tuple[NDArray[np.float64], ...],
    factor: float,
    axes: tuple[Axes, Axes],
) -> None:
    above, below = axes
    lines = [curve("measured", record.time, record.position, "measured")]
    if record.reference is not None:
        lines.insert(0, curve("reference", record.time, record.reference, "reference"))
    wrong = []
    for (name, role), miss in _models(diagnosis, missed):
        if np.isfinite(miss).all():
            late = slice(len(record) - miss.size, None)
            lines.append(curve(name, record.time[late], record.position[late] + miss, role).thinned())
            wrong.append(curve("", record.time[late], factor * miss, role).thinned())
    drawn = [line.thinned() for line in lines]
    plot_curves(drawn, xlabel="", ylabel=f"Position [{record.length_unit}]", legend=False, ax=above)
    plot_curves(wrong, xlabel="Time [s]", ylabel="", zero_line=True, ax=below)
    above.tick_params(labelbottom=False)
    below.set_xlim(above.get_xlim())


def _caption(diagnosis: Diagnosis, rest: int) -> str:
    told = ["Measured against predicted, on data that the models were not fitted to.", kinds_sentence(diagnosis)]
    if rest > 0:
        told.append(f"Drawn are those that gain and damping alone miss most; {rest} more are in the table.")
    return " ".join(part for part in told if part)
