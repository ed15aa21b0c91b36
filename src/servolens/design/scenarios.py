"""What may be otherwise than a model says: parameters, what nothing explains, the sensor, the gain itself."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import pi, sqrt
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.design.settle import SensorNoise, evaluate
from servolens.effects import Force, parameter
from servolens.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.design.response import Response
    from servolens.design.spec import PDSpec
    from servolens.effects import Axis
    from servolens.model import Model
    from servolens.model_evidence import Remainder
    from servolens.plant import Plant

__all__ = [
    "TOLERANCE", "Scenario", "UnexplainedForce", "counted", "drawn", "is_pushed", "missed_share", "without_force",
]  # fmt: skip

TOLERANCE = 0.02
"""By how much the realised gain of loop and amplifier may differ from what was set, as a share."""
WAVES = 4
"""Sines of an unexplained force; its largest value is then √8 times its r.m.s., as of a Gaussian force in 200 draws."""
NARROWEST = 1e-9
"""Band that no step keeps, where the simulation may miss more than the whole band."""
TRIES = 100
"""Draws after which a model whose covariance allows hardly an admissible plant stands for itself."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class UnexplainedForce(Force):
    """A force of known size and correlation, and of no known cause: a sum of sines with random frequencies and phases.

    Where the frequencies are drawn from a normal distribution of deviation 1/(2πT), its autocorrelation over all draws
    is exp(−τ²/2T²): Bochner's theorem, as for random Fourier features (Rahimi and Recht, 2007).
    """

    name = "unexplained_force"
    sentence = "A force that no cause explains pushes the axis."
    latex = r"w(t)"

    size: float = parameter("w", "{x}/s^2", "r.m.s., per unit of moving mass", per_mass=1)
    frequency_0: float = parameter("f_0", "Hz", "of the first sine", per_mass=0)
    frequency_1: float = parameter("f_1", "Hz", "of the second sine", per_mass=0)
    frequency_2: float = parameter("f_2", "Hz", "of the third sine", per_mass=0)
    frequency_3: float = parameter("f_3", "Hz", "of the fourth sine", per_mass=0)
    phase_0: float = parameter(r"\phi_0", "rad", "of the first sine", per_mass=0)
    phase_1: float = parameter(r"\phi_1", "rad", "of the second sine", per_mass=0)
    phase_2: float = parameter(r"\phi_2", "rad", "of the third sine", per_mass=0)
    phase_3: float = parameter(r"\phi_3", "rad", "of the fourth sine", per_mass=0)

    @staticmethod
    def physics(axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.Force.physics`."""
        from casadi import sin

        waves = (
            sin(2 * pi * getattr(p, f"frequency_{i}") * axis.time + getattr(p, f"phase_{i}")) for i in range(WAVES)
        )
        return p.size * sqrt(2.0 / WAVES) * sum(waves)

    @classmethod
    def draw(cls, size: float, correlation_time: float, random: np.random.Generator) -> UnexplainedForce:
        """Return one such force."""
        frequencies = np.abs(random.normal(0.0, 1.0 / (2.0 * pi * correlation_time), WAVES))
        phases = random.uniform(0.0, 2.0 * pi, WAVES)
        values = {f"frequency_{i}": float(f) for i, f in enumerate(frequencies)}
        return cls(size=size, **values, **{f"phase_{i}": float(phase) for i, phase in enumerate(phases)})


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scenario:
    """One axis as it may be, and one step on it.

    Attributes
    ----------
    plant : Plant
        Drawn from what is known of the model, with a force that nothing explains.
    spec : PDSpec
        Of this step; its band is narrower by what the simulation may miss of the position.
    realised : float
        What the gains of the loop are multiplied by.
    back : bool
        Whether the step is the one back, from the reference to 0.
    model : int
        Which of the models the plant was drawn from, counted from 1.
    noise : SensorNoise or None
        What the loop measures beside the position, as the records showed it.
    parts : int
        Into how many each sample is divided at whose ends the axis is seen.
    """

    plant: Plant
    spec: PDSpec
    realised: float
    back: bool
    model: int = 1
    noise: SensorNoise | None = None
    parts: int = 1

    def in_loop(self, spec: PDSpec) -> Scenario:
        """Return the same axis and step in the loop of another spec."""
        return replace(self, spec=replace(spec.scaled(self.realised), band=self.spec.band))

    def response(self, kd: float, duration: float | None = None) -> Response:
        """Return the step with the derivative gain `kd`, which is realised as well as it can be."""
        kd = self.realised * kd
        return evaluate(
            self.plant, self.spec, kd, back=self.back, duration=duration, noise=self.noise, parts=self.parts
        )


def drawn(models: Sequence[Model], specs: Sequence[PDSpec], count: int, random: np.random.Generator) -> list[Scenario]:
    """Return scenarios: the models, the specs, and up and down in turn; all else drawn anew for each."""
    turns = [(which, spec, back) for back in (False, True) for spec in specs for which in range(len(models))]
    found = []
    for i in range(count):
        which, spec, back = turns[i % len(turns)]
        model = models[which]
        realised = 1.0 + float(random.uniform(-TOLERANCE, TOLERANCE))
        spec = _narrowed(spec.scaled(realised), model, random)
        plant = _pushed(_plant(model, random), model, random)
        noise = _noise(model, random)
        found.append(Scenario(plant=plant, spec=spec, realised=realised, back=back, model=which + 1, noise=noise))
    return found


def counted(responses: Sequence[Response]) -> tuple[float, tuple[float, float]]:
    """Return the share of steps that meet their spec, and the 95 % interval of its probability (Clopper, Pearson)."""
    from scipy.stats import binomtest

    count = sum(response.meets for response in responses)
    bounds = binomtest(count, len(responses)).proportion_ci(0.95, method="exact")
    return count / len(responses), (float(bounds.low), float(bounds.high))


def without_force(plant: Plant) -> Plant:
    """Return the plant of a scenario without what the model leaves unexplained."""
    return replace(plant, effects=tuple(e for e in plant.effects if not isinstance(e, UnexplainedForce)))


def _noise(model: Model, random: np.random.Generator) -> SensorNoise | None:
    """Draw the noise of the sensor, if the records showed some."""
    seed = int(random.integers(2**31))
    deviation = None if model.evidence is None else model.evidence.noise
    return SensorNoise(deviation, seed) if deviation else None


def _plant(model: Model, random: np.random.Generator) -> Plant:
    """Draw a plant, with phases anew of waves that do not know when a step begins."""
    from servolens.identification.phases import own_phases  # here, for it brings SciPy

    plant = _within_covariance(model, random)
    phases = {name: float(random.uniform(-pi, pi)) for name in own_phases(plant)}
    if not phases:
        return plant
    return plant.with_values([phases.get(name, v) for name, v in zip(plant.parameters, plant.values, strict=True)])


def _within_covariance(model: Model, random: np.random.Generator) -> Plant:
    """Draw a plant from the covariance, within the bounds of its parameters; what has no error is held."""
    if model.covariance is None:
        return model.plant
    free = np.isfinite(np.diag(model.covariance)) & (np.diag(model.covariance) > 0.0)
    among = np.nan_to_num(model.covariance[np.ix_(free, free)])
    spread, axes = np.linalg.eigh(0.5 * (among + among.T))
    values = np.array(model.plant.values)
    limits = list(model.plant.parameters.values())
    low, high = (np.array([getattr(limit, end) for limit in limits]) for end in ("low", "high"))
    for _ in range(TRIES):
        moved = values.copy()
        moved[free] += axes @ (np.sqrt(np.maximum(spread, 0.0)) * random.standard_normal(spread.size))
        try:
            return model.plant.with_values([float(v) for v in np.clip(moved, low, high)])
        except InputError:  # parameters that are admissible one by one, but not together
            continue
    return model.plant


def missed_share(model: Model) -> float:
    """Return the largest error of the simulated position that scenarios try, as a share of the step; 0 for none.

    Of what the inputs make and is immaterial: evenly distributed, with the r.m.s. of the records.
    """
    left = _left_by(model)
    return sqrt(3.0) * left.of_travel if left is not None and _returns(left) else 0.0


def is_pushed(model: Model) -> bool:
    """Tell whether scenarios try what a model leaves unexplained as a force."""
    left = _left_by(model)
    if left is None or _returns(left):
        return False
    return 0.0 < left.acceleration_rms < np.inf and left.correlation_time > 0.0


def _narrowed(spec: PDSpec, model: Model, random: np.random.Generator) -> PDSpec:
    """Return the spec with a band that leaves room for an error of the simulated position."""
    largest = missed_share(model)
    if not largest:
        return spec
    return replace(spec, band=max(spec.band - largest * float(random.uniform()), NARROWEST))


def _pushed(plant: Plant, model: Model, random: np.random.Generator) -> Plant:
    """Return the plant with what the model leaves unexplained, if that matters, and with what shakes the axis."""
    left = _left_by(model)
    if left is None or not is_pushed(model):
        return plant
    return plant.with_effect(UnexplainedForce.draw(left.acceleration_rms, left.correlation_time, random))


def _left_by(model: Model) -> Remainder | None:
    return None if model.evidence is None else model.evidence.remainder


def _returns(left: Remainder) -> bool:
    """Tell whether what is left is small and comes again with each step, unlike a force that goes on."""
    return left.depends_on_inputs and not left.material
