"""What the demo does: measure the cart, identify it, predict, design. All numbers of the page come from here."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens import lab
from servolens.demo.hidden import study_hidden_axis
from servolens.design import PDSpec, compare, settling_time, tune
from servolens.identification import identify
from servolens.plant import Plant
from servolens.prediction import predict

if TYPE_CHECKING:
    from collections.abc import Callable

    from servolens.demo.hidden import HiddenAxis
    from servolens.design import Comparison, Design
    from servolens.findings import Finding
    from servolens.identification import Identification
    from servolens.identification.varying import VaryingDamping
    from servolens.prediction import Prediction
    from servolens.record import Record

__all__ = ["DELTA", "PAPER_ANSWERS", "PRINTED", "RECOMPUTED", "SHORT_PIECE", "TRUTH", "Demo", "run_experiment"]

TRUTH = lab.NLM1
"""The cart that is measured: the paper's own nonlinear model at Kp 60."""
SEED = 20_140_913
DELTA = 0.5
"""δ of eq. 18 [1/s], as in the paper."""
SHORT_PIECE = 0.05
"""Pieces [s] short enough to follow the damping through a reversal."""
SPEC: dict[str, Any] = {"kp": 100.0, "settling_time": 0.5, "band": 0.01, "reference": 0.1}
"""Eq. 36."""
LARGEST_LEAST = 6.0
"""Where only the least gain matters, the search ends here."""
PRINTED = {"Lm1": lab.LM1, "Lm2": lab.LM2, "Lm3": lab.LM3, "NLm1": lab.NLM1, "NLm2": lab.NLM2, "NLm3": lab.NLM3}
"""The models with the parameters that the paper prints."""
PAPER_ANSWERS = {"Lm3": 7.35, "NLm3": 3.55}
"""The gains that the paper gives for eq. 36."""
RECOMPUTED: dict[str, tuple[tuple[float, float], ...]] = {
    "Lm1": ((5.365, 11.542),),
    "Lm2": ((5.801, 11.958),),
    "Lm3": ((6.279, 12.443),),
    "NLm1": ((3.597, 4.598), (7.302, 9.694)),
    "NLm2": ((4.001, 4.917), (7.764, 9.988)),
    "NLm3": ((3.788, 4.775), (7.510, 9.869)),
}
"""Gains that meet eq. 36 on the printed models, from a scan in steps of 0.001 with a Runge–Kutta solver of its own."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class CartRun:
    """A gain tried on the virtual cart itself, without sensor noise.

    Attributes
    ----------
    label : str
        Where the gain comes from.
    kd : float
        [V s/m].
    settling_time : float or None
        [s].
    """

    label: str
    kd: float
    settling_time: float | None


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Demo:
    """All results of the demo.

    Attributes
    ----------
    records : tuple of Record
        The eight experiments of Table I.
    fits : tuple of Identification
        From the records with Kp 60, 80, 100 and Kd 0: what the paper calls Lm1…3 and NLm1…3.
    limited : tuple of VaryingDamping
        Their time-varying damping under eq. 18.
    short, short_limited : VaryingDamping
        Of the first, with short pieces.
    prediction : Prediction
        Table I.
    held_out : ndarray, shape (8, 6)
        Whether the model was not identified from the record.
    sampled : tuple of Comparison
        Eq. 36 from each pair of models, for the digital loop.
    continuous : Comparison
        From the last pair, for the paper's ideal continuous PD.
    by_pieces : tuple of Design
        From the damping laws that pass through the pieces, sampled.
    on_truth : Design
        From the true parameters, sampled.
    on_cart : tuple of CartRun
        Recommendations from Kp 100, tried on the cart.
    printed : dict of str to Design
        Eq. 36 on the paper's printed models, continuous.
    hidden : HiddenAxis
        Another axis, whose lack is found from its records.
    stages : int
        How many steps the work was reported in.
    """

    records: tuple[Record, ...]
    fits: tuple[Identification, ...]
    limited: tuple[VaryingDamping, ...]
    short: VaryingDamping
    short_limited: VaryingDamping
    prediction: Prediction
    held_out: np.ndarray[Any, np.dtype[np.bool_]]
    sampled: tuple[Comparison, ...]
    continuous: Comparison
    by_pieces: tuple[Design, ...]
    on_truth: Design
    on_cart: tuple[CartRun, ...]
    printed: dict[str, Design]
    hidden: HiddenAxis
    stages: int

    @property
    def training(self) -> tuple[Record, ...]:
        """The three records that models are identified from."""
        return tuple(fit.records[0] for fit in self.fits)

    @property
    def truth(self) -> Plant:
        """The cart's true parameters."""
        return plant_of(TRUTH)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings of all identifications."""
        return tuple(finding for fit in self.fits for finding in fit.findings)


def run_experiment(progress: Callable[[str, int, int], None] | None = None) -> Demo:
    """Measure the virtual cart and do everything with its records that the paper does.

    Parameters
    ----------
    progress : callable, optional
        Called with (description, done, total).
    """
    stage = _Stages(progress)
    stage("logging steps of the virtual cart")
    records = lab.table_one(TRUTH, SEED)
    training = [r for r in records if r.controller is not None and r.controller.kd == 0]
    fits = []
    for record in training:
        stage(f"identifying from {record.name}")
        fits.append(identify(record))
    stage("identifying time-varying damping")
    limited = tuple(_varying(record, delta=DELTA) for record in training)
    short, short_limited = _varying(training[0], piece=SHORT_PIECE), _varying(training[0], DELTA, SHORT_PIECE)
    stage("predicting the eight steps of Table I")
    models = _named(fits)
    prediction = predict({name: plant for name, (plant, _) in models.items()}, records)
    held_out = np.array([[record is not used for _, used in models.values()] for record in records])
    sampled = []
    for fit in fits:
        stage(f"designing on the model of {fit.records[0].name}")
        sampled.append(compare(_plant(fit, "constant"), _plant(fit, "velocity"), _spec("sampled")))
    stage("designing for the continuous loop")
    continuous = compare(_plant(fits[-1], "constant"), _plant(fits[-1], "velocity"), _spec("continuous"))
    stage("designing on the piecewise model and on the true axis")
    least = replace(_spec("sampled"), kd_max=LARGEST_LEAST)
    by_pieces = tuple(tune(fit.law_from_pieces, least) for fit in fits if fit.law_from_pieces is not None)
    on_truth = tune(plant_of(TRUTH), least)
    printed = {}
    for name, model in PRINTED.items():
        stage(f"designing for the paper's {name}")
        printed[name] = tune(plant_of(model), _spec("continuous"))
    stage("diagnosing an axis with a hidden effect")
    hidden = study_hidden_axis()
    stage("writing the page")
    return Demo(
        records=records,
        fits=tuple(fits),
        limited=limited,
        short=short,
        short_limited=short_limited,
        prediction=prediction,
        held_out=held_out,
        sampled=tuple(sampled),
        continuous=continuous,
        by_pieces=by_pieces,
        on_truth=on_truth,
        on_cart=_on_cart(sampled[-1]),
        printed=printed,
        hidden=hidden,
        stages=stage.total,
    )


def plant_of(truth: lab.Truth) -> Plant:
    """Return the plant with the numbers of `truth`."""
    effects = tuple(Plant.effect_from(name, values) for name, values in truth.effects.items())
    return Plant(gain=truth.gain, damping=truth.damping, effects=effects)


class _Stages:
    """Counts what is begun."""

    total = 19

    def __init__(self, progress: Callable[[str, int, int], None] | None) -> None:
        self.progress, self.done = progress, 0

    def __call__(self, description: str) -> None:
        if self.progress is not None:
            self.progress(description, self.done, self.total)
        self.done += 1


def _varying(record: Record, delta: float | None = None, piece: float | None = None) -> VaryingDamping:
    found = identify(record, model="varying", delta=delta, piece=piece).varying
    assert found is not None  # noqa: S101 - it was asked for
    return found


def _plant(fit: Identification, kind: str) -> Plant:
    plant: Plant = getattr(fit, kind).plant
    return plant


def _named(fits: list[Identification]) -> dict[str, tuple[Plant, Record]]:
    """Return Lm1…3 and NLm1…3, each with the record it was identified from."""
    linear = {f"Lm{i}": (_plant(fit, "constant"), fit.records[0]) for i, fit in enumerate(fits, start=1)}
    return linear | {f"NLm{i}": (_plant(fit, "velocity"), fit.records[0]) for i, fit in enumerate(fits, start=1)}


def _spec(control: str) -> PDSpec:
    return PDSpec(**SPEC, control=control)  # type: ignore[arg-type] # called with these two words only


def _on_cart(comparison: Comparison) -> tuple[CartRun, ...]:
    """Try the recommendations on the cart, the nonlinear one also with a little to spare."""
    runs = []
    linear, nonlinear = comparison.linear.kd, comparison.nonlinear.kd
    tried = [("linear recommendation", linear), ("nonlinear recommendation", nonlinear)]
    if nonlinear is not None:
        tried.append(("nonlinear recommendation and 2 % more", 1.02 * nonlinear))
    for label, kd in tried:
        if kd is not None:
            run = lab.step_record(TRUTH, kp=SPEC["kp"], kd=kd, reference=SPEC["reference"], encoder=0.0, duration=2.0)
            error = (SPEC["reference"] - run.position) / SPEC["reference"]
            runs.append(CartRun(label=label, kd=kd, settling_time=settling_time(run.time, error, SPEC["band"])))
    return tuple(runs)
