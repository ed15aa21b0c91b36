"""What real axes do and the catalogue does not know: a diagnosis must not give it the name of something else."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

from servolens.lab import _foreign_laws as laws

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np

    from servolens.lab.scene import Scene
    from servolens.lab.unmodelled import UnmodelledEffect

    Dice = np.random.Generator

__all__ = ["FOREIGN", "Foreign"]


class Foreign(NamedTuple):
    """One foreign law.

    Attributes
    ----------
    sentence : str
        What the axis does.
    low, high : float
        The smallest and largest size that make sense.
    per_mille : float
        Size at which the best linear model misses about a thousandth of the step.
    make : callable
        (scene, size, dice of the axis, dice of the run) → UnmodelledEffect.
    same_as : tuple of str
        Effects of the catalogue with the same structure: naming one of them is no mistake.
    """

    sentence: str
    low: float
    high: float
    per_mille: float
    make: Callable[[Scene, float, Dice, Dice], UnmodelledEffect]
    same_as: tuple[str, ...] = ()


FOREIGN = MappingProxyType(
    {
        "hysteretic_spring": Foreign(
            "A spring whose way back differs from its way there (Bouc–Wen).", 1e-4, 0.4, 0.0008, laws.hysteretic_spring
        ),
        "growing_friction": Foreign(
            "Dry friction grows with the distance travelled, as a belt or bearing warms.",
            1e-4,
            0.4,
            0.0011,
            laws.growing_friction,
        ),
        "even_gain": Foreign("The gain rises with the signed command: β(1 + εV).", 1e-4, 0.6, 0.019, laws.even_gain),
        "cubic_gain": Foreign("The gain rises with the square of the command.", 1e-4, 1.5, 0.053, laws.cubic_gain),
        "position_gain": Foreign(
            "The motor pulls harder at one end of the travel.", 1e-4, 0.6, 0.013, laws.position_gain
        ),
        "direction_gain": Foreign(
            "The gain differs with the sign of the command.", 1e-4, 0.5, 0.0059, laws.direction_gain
        ),
        "position_damping": Foreign("Viscous damping grows along the travel.", 1e-4, 0.9, 0.024, laws.position_damping),
        "random_knocks": Foreign("Something hits the axis a few times.", 1e-3, 2.0, 0.022, laws.random_knocks),
        "switching_friction": Foreign(
            "Dry friction comes and goes in time.", 1e-4, 0.4, 0.00077, laws.switching_friction
        ),
        "random_drift": Foreign("A slow random force, different in each run.", 1e-5, 0.2, 0.00038, laws.random_drift),
        "imbalance": Foreign(
            "A rotating imbalance: frequency and force follow the speed.", 1e-3, 1.0, 0.26, laws.imbalance
        ),
        "sweeping_force": Foreign(
            "A sinusoidal force that sweeps in frequency.", 1e-5, 0.2, 0.00094, laws.sweeping_force
        ),
        "changing_damping": Foreign("Viscous damping changes in time.", 1e-3, 1.5, 0.03, laws.changing_damping),
        "two_slope_spring": Foreign(
            "A spring acts beyond a point of the travel.", 1e-4, 0.8, 0.0025, laws.two_slope_spring
        ),
        "elastic_buffer": Foreign(
            "A spring without damping stands at the end of the travel.", 1e-3, 30.0, 0.021, laws.elastic_buffer
        ),
        "root_drag": Foreign("Drag grows with the root of the speed.", 1e-4, 0.3, 0.0053, laws.root_drag),
        "one_sided_dead_zone": Foreign(
            "Small commands of one sign only do nothing.", 1e-4, 0.3, 0.00053, laws.one_sided_dead_zone
        ),
        "slew_limit": Foreign("The amplifier changes its output at a limited rate.", 1e-3, 2.0, 0.039, laws.slew_limit),
        "coarse_command": Foreign("The command is put out in coarse steps.", 1e-4, 0.4, 0.0027, laws.coarse_command),
        "encoder_ripple": Foreign(
            "The encoder errs periodically along the travel.", 1e-5, 0.02, 0.0019, laws.encoder_ripple
        ),
        "missed_counts": Foreign("The encoder loses counts now and then.", 1e-5, 0.1, 0.0045, laws.missed_counts),
        "sample_jitter": Foreign("Samples are taken a little early or late.", 1e-2, 1.0, 0.25, laws.sample_jitter),
        "actuator_resonance": Foreign(
            "The actuator rings at a frequency of its own.",
            0.01,
            0.4,
            0.054,
            laws.actuator_resonance,
            ("flexible_coupling",),
        ),
        "second_order_actuator": Foreign(
            "The actuator follows its command with two poles, moderately damped.",
            1e-3,
            0.4,
            0.02,
            laws.second_order_actuator,
            ("flexible_coupling",),
        ),
        "step_force": Foreign("A constant force sets in during the run.", 1e-5, 0.2, 0.00062, laws.step_force),
        "lost_commands": Foreign("Some commands are lost, the last one is held.", 0.01, 0.8, 0.25, laws.lost_commands),
        "position_inertia": Foreign(
            "The moving mass changes along the travel.", 1e-4, 0.5, 0.013, laws.position_inertia
        ),
        "supply_ripple": Foreign("The supply's ripple modulates the gain.", 1e-4, 0.5, 0.017, laws.supply_ripple),
        "hanging_load": Foreign("A load swings below the axis, lightly damped.", 1e-4, 0.3, 0.011, laws.hanging_load),
    }
)
"""Every foreign law by its name."""
