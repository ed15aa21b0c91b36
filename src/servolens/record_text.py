"""A record as text: the comment lines and columns of the file that :func:`servolens.read_record` reads."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from servolens.controller import Controller
from servolens.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    import numpy as np
    from numpy.typing import NDArray

__all__ = ["csv_text", "loop_settings"]

DEFAULT = Controller(kp=0.0)
SHARED = (
    "anti_windup", "tracking_time", "integral_before", "derivative_filter", "derivative_window", "derivative",
    "control_period", "time_step",
)  # fmt: skip
"""Settings that PID and cascade have in common."""
NEIGHBOURS = 4
"""Numbers to each side among which the one is looked for from which a product or quotient follows to the last bit."""


def csv_text(settings: Mapping[str, object], columns: Mapping[str, NDArray[np.float64] | None]) -> str:
    """Return comment lines ``# key = value``, a header row, and the numbers to the last bit.

    Parameters
    ----------
    settings : mapping of str to object
        By key; those that are None are left out.
    columns : mapping of str to ndarray or None, shape (n,)
        By heading, likewise.
    """
    head = [f"# {key} = {_shown(value)}" for key, value in settings.items() if value is not None]
    logged = {name: column.tolist() for name, column in columns.items() if column is not None}
    rows = (",".join(map(repr, row)) for row in zip(*logged.values(), strict=True))
    return "\n".join([*head, ",".join(logged), *rows, ""])


def loop_settings(loop: Controller, length_unit: str, command_unit: str) -> dict[str, object]:
    """Return the keys that state a loop, but for those that have their default.

    Parameters
    ----------
    loop : Controller
        The loop.
    length_unit, command_unit : str
        Of its record.

    Raises
    ------
    InputError
        If the law is that of a cascade, and a cascade's keys do not state it.
    """
    told = {name: getattr(loop, name) for name in SHARED if getattr(loop, name) != getattr(DEFAULT, name)}
    per_length = f"{command_unit}/{length_unit}"
    per_speed = f"{command_unit} s/{length_unit}"
    if not loop.is_cascade:
        own = {name: getattr(loop, name) for name in ("ki", "setpoint_weight", "derivative_on")}
        own = {name: value for name, value in own.items() if value != getattr(DEFAULT, name)}
        if loop.velocity_feedforward != 0:
            own["velocity_feedforward"] = f"{float(loop.velocity_feedforward)!r} {per_speed}"
        gains = {"kp": f"{float(loop.kp)!r} {per_length}", "kd": f"{float(loop.kd)!r} {per_speed}"}
        return {**gains, **own, **told}
    _check_cascade(loop)
    kv = float(loop.kd)
    return {
        "controller": "cascade",
        "kp": _inverted(lambda kp: kv * kp, loop.kp, loop.kp / kv),
        "kv": f"{kv!r} {per_speed}",
        "kiv": _inverted(lambda kiv: kiv / kv, loop.integral_rate, loop.integral_rate * kv),
        "feedforward_speed": _inverted(
            lambda share: kv * share, loop.velocity_feedforward, loop.velocity_feedforward / kv
        ),
        **told,
    }


def _check_cascade(loop: Controller) -> None:
    """Refuse a law that is a cascade by its `law` or its `integral_rate` and has what no cascade's keys state."""
    why = "law = 'cascade'" if loop.law == "cascade" else "integral_rate"
    if loop.kd == 0:
        cure = " or law = 'pd'" if loop.integral_rate == 0 else ""
        raise InputError(f"the controller has {why} and kd = 0, but kd is the gain kv of a cascade; give kd{cure}")
    others = {"ki": 0.0, "setpoint_weight": 1.0, "derivative_on": "measurement"}
    for name, value in others.items():
        if (found := getattr(loop, name)) != value:
            raise InputError(
                f"the controller has {why} and {name} = {found!r}, which a cascade does not have; only with"
                f" {name} = {value!r} can it be written"
            )


def _inverted(function: Callable[[float], float], wanted: float, near: float) -> float:
    """Return the number beside `near` of which the function is what is `wanted` to the last bit; `near` if none is."""
    below = above = float(near)
    for _ in range(NEIGHBOURS):
        for number in (below, above):
            if function(number) == wanted:
                return number
        below, above = math.nextafter(below, -math.inf), math.nextafter(above, math.inf)
    return float(near)


def _shown(value: object) -> str:
    """Return a setting as it stands in a comment: of one line, numbers to the last bit."""
    if isinstance(value, str):
        return "".join(character for character in value if character.isprintable())
    return repr(float(value)) if isinstance(value, float) else str(value)
