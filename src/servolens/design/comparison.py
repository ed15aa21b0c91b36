"""Linear, nonlinear and diagnosed recommendation, side by side."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

from servolens.design.least_kd import tune
from servolens.design.settle import evaluate
from servolens.inputs import as_plant
from servolens.results import with_reasons

if TYPE_CHECKING:
    from collections.abc import Callable

    from servolens.design.found import Design
    from servolens.design.response import Response
    from servolens.design.spec import PDSpec
    from servolens.inputs import Plants
    from servolens.plant import Plant

__all__ = ["Comparison", "compare"]

UNDIAGNOSED = "there is no model with causes"


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Linear, nonlinear and diagnosed recommendation side by side.

    Attributes
    ----------
    plants : tuple of Plant
        The linear, the nonlinear and, where there is one, the diagnosed plant.
    linear, nonlinear : Design
        Each designed on its own model.
    linear_on_nonlinear : Response or None
        The linear recommendation run on the nonlinear plant; None if there is none.
    diagnosed : Design or None
        Designed on the model with the causes that were found; None where none was looked for.
    linear_on_diagnosed, nonlinear_on_diagnosed : Response or None
        Recommendations run on the diagnosed plant; None where there is no such gain or plant.
    """

    plants: tuple[Plant, ...]
    linear: Design
    nonlinear: Design
    linear_on_nonlinear: Response | None
    diagnosed: Design | None = None
    linear_on_diagnosed: Response | None = None
    nonlinear_on_diagnosed: Response | None = None

    def __repr__(self) -> str:
        """Return one line: the least gain on each model."""
        names = ("linear", "nonlinear", "diagnosed")
        gains = (
            f"{name} {'none' if design.kd is None else f'{design.kd:.4g}'}"
            for name, design in zip(names, self.designs, strict=False)
        )
        return f"<Comparison: least {self.linear.spec.free} by model: {', '.join(gains)}>"

    @property
    def designs(self) -> tuple[Design, ...]:
        """The designs, that on the plant which the data support best last."""
        return (self.linear, self.nonlinear, *(() if self.diagnosed is None else (self.diagnosed,)))

    @property
    def on_best(self) -> tuple[Response | None, ...]:
        """Each recommendation, run on the plant that the data support best: the last one."""
        own = next(iter(self.designs[-1].verified), None)
        if self.diagnosed is None:
            return self.linear_on_nonlinear, own
        return self.linear_on_diagnosed, self.nonlinear_on_diagnosed, own

    def to_json(self) -> dict[str, Any]:
        """Return the fields of ``servolens.comparison/1`` without the file's header."""
        own = next(iter(self.nonlinear.verified), None)
        result = {
            "linear": self._with_runs(self.linear, self.linear_on_nonlinear, self.linear_on_diagnosed),
            "nonlinear": self._with_runs(self.nonlinear, own, self.nonlinear_on_diagnosed),
            "diagnosed": _optional(self.diagnosed),
        }
        return with_reasons(result, {"diagnosed": UNDIAGNOSED})

    def _with_runs(
        self, design: Design, on_nonlinear: Response | None, on_diagnosed: Response | None
    ) -> dict[str, Any]:
        """Return a design with what its gain does on other plants, and why what is null of that is missing."""
        runs = {"on_nonlinear": _optional(on_nonlinear), "on_diagnosed": _optional(on_diagnosed)}
        why = {} if self.diagnosed is not None or design.kd is None else {"on_diagnosed": UNDIAGNOSED}
        return with_reasons({**design.to_json(), **runs}, why)


def compare(
    linear: Plants,
    nonlinear: Plants,
    spec: PDSpec,
    *,
    diagnosed: Plants | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Comparison:
    """Design on each model, and run the simpler models' recommendations on the richer plants.

    Parameters
    ----------
    linear, nonlinear : Plant, model, fit, diagnosis, or path of a model's file
        Two models of the same axis.
    spec : PDSpec
        What to reach.
    diagnosed : the same, optional
        The model that the data support best, where causes were looked for.
    progress : callable, optional
        Called with (description, done, total).
    """
    linear, nonlinear = as_plant(linear), as_plant(nonlinear)
    diagnosed = None if diagnosed is None else as_plant(diagnosed)
    first = tune(linear, spec, progress=progress)
    second = tune(nonlinear, spec, progress=progress)
    on = _run(nonlinear, first)
    if diagnosed is None:
        return Comparison(plants=(linear, nonlinear), linear=first, nonlinear=second, linear_on_nonlinear=on)
    return Comparison(
        plants=(linear, nonlinear, diagnosed),
        linear=first,
        nonlinear=second,
        linear_on_nonlinear=on,
        diagnosed=tune(diagnosed, spec, progress=progress),
        linear_on_diagnosed=_run(diagnosed, first),
        nonlinear_on_diagnosed=_run(diagnosed, second),
    )


def _run(plant: Plant, design: Design) -> Response | None:
    return None if design.kd is None else evaluate(plant, design.spec, design.kd)


def _optional(value: Response | Design | None) -> dict[str, Any] | None:
    return None if value is None else value.to_json()
