"""The equations of motion of a structure as machine code, for the compiled stepping rule to call."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import lru_cache
from threading import Lock
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.simulation.codegen import function_text, number_text
from servolens.simulation.contraction import fused
from servolens.simulation.equations import Equations
from servolens.simulation.kernel import GAINS_ENTRY, RUN_ENTRY, kept, rule
from servolens.simulation.machine import loaded, object_code, platform_marks

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from servolens.effects import Effect

__all__ = ["Native", "native"]

_COMPILING = Lock()


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Native:
    """Machine code of a structure.

    Attributes
    ----------
    run : callable
        :func:`servolens.simulation.stepping.run` for plants of this structure.
    slopes : callable
        ``slopes(x, p, out)``: the Jacobian of [v, acceleration, rates], column by column, at ``x = [y, v, t, u, d,
        moving, shaking, smooth states, relaxing states, their ramps]`` and the plant's parameters `p`.
    gains : callable
        :func:`servolens.simulation.kalman.kalman`, the same for all structures.
    sizes : tuple of int
        Numbers of smooth and of relaxing states.
    order : ndarray of int64
        Where each state of ``Dynamics.states`` stands among [smooth, relaxing].
    """

    run: Callable[..., int]
    slopes: Callable[..., int]
    gains: Callable[..., int]
    sizes: tuple[int, int]
    order: NDArray[np.int64]
    keeper: Any


def native(structure: tuple[type[Effect], ...], *, continuous: bool = False) -> Native:
    """Return the machine code of a plant with the effects of `structure`; threads may ask at once.

    With `continuous` the input is the reference and an ideal PD acts inside the step, its kp and kd appended to the
    parameters.
    """
    with _COMPILING:
        return _native(structure, continuous)


@lru_cache(maxsize=1024)
def _native(structure: tuple[type[Effect], ...], continuous: bool) -> Native:
    equations = Equations(structure, continuous)
    texts = [function_text(f"servolens_{name}", equations.inputs, e) for name, e in equations.functions().items()]
    texts += [number_text(f"servolens_{name}", number) for name, number in equations.numbers().items()]
    engine = _engine(fused("\n".join(_merged(texts))))
    number, real, pointer = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p
    run = ctypes.CFUNCTYPE(ctypes.c_int32, pointer, pointer, number, number, real, *[pointer] * 9)
    gains = ctypes.CFUNCTYPE(ctypes.c_int32, pointer, pointer, number, *[pointer] * 5)
    slopes = ctypes.CFUNCTYPE(number, pointer, pointer, pointer)
    return Native(
        run=run(engine.get_function_address(RUN_ENTRY)),
        slopes=slopes(engine.get_function_address("servolens_slopes")),
        gains=gains(engine.get_function_address(GAINS_ENTRY)),
        sizes=(len(equations.smooth), len(equations.relaxing)),
        order=np.argsort([*equations.smooth, *equations.relaxing], kind="stable").astype(np.int64),
        keeper=engine,
    )


def _merged(texts: list[str]) -> list[str]:
    """Return the functions' texts with each declaration once."""
    lines = [line for text in texts for line in text.splitlines()]
    declared = dict.fromkeys(line for line in lines if line.startswith("declare"))
    return [*declared, *(line for line in lines if not line.startswith("declare"))]


def _engine(text: str) -> Any:
    """Load LLVM assembly, compiled together with the stepping rule; the engine returned owns the machine code."""
    seen = {RUN_ENTRY, GAINS_ENTRY, "servolens_slopes"}
    return loaded(kept("plant", [*platform_marks(), rule(), text], lambda: object_code([rule(), text], seen)))
