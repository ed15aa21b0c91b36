"""The stepping rule with the equations of motion of a structure, as machine code.

There are two forms. In *joined* code LLVM melts the rule and the plant's functions into one piece, which takes a fifth
of a second to compile. In *separate* code the rule, compiled once for all structures, calls the plant's functions; they
alone are compiled in a hundredth of a second, but a substep takes 1.1 to 3 times as long. Both give the same bits, for
:mod:`servolens.simulation.contraction` decides before which operations are rounded together. A structure begins with
separate code, unless its joined code is on disk, and goes over to joined code when it is simulated so much that this
pays.
"""

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
from servolens.simulation.kernel import GAINS_ENTRY, RUNS_ENTRY, elementary, kept, kept_before, rule, rule_mark
from servolens.simulation.machine import loaded, object_code, platform_marks

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from servolens.effects import Effect

__all__ = ["WORK_THAT_PAYS", "Native", "native"]

WORK_THAT_PAYS = 15_000_000
"""Substeps after which joined code is compiled. It costs 0.25 s, and a substep takes about 17 ns less with it (4 ns
with a flexible coupling, 33 ns with a lag): by then separate code has cost as much as the compilation, so that no
number of simulations costs more than twice what the better choice would have."""
SLOPES_ENTRY = "servolens_slopes"

_MAKING = Lock()


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Native:
    """Machine code of a structure; each function keeps it alive, whatever replaces it.

    Attributes
    ----------
    runs : callable
        ``runs(count, n, substeps, delays, places, done)``: :func:`servolens.simulation.stepping.run` for `count` plants
        of this structure, each with its delay, its row of nine pointers, and its answer.
    slopes : callable
        ``slopes(x, p, out)``: the Jacobian of [v, acceleration, rates], column by column, at ``x = [y, v, t, u, d,
        moving, shaking, smooth states, relaxing states, their ramps]`` and the plant's parameters `p`.
    gains : callable
        :func:`servolens.simulation.kalman.kalman`, the same for all structures.
    sizes : tuple of int
        Numbers of smooth and of relaxing states.
    order : ndarray of int64
        Where each state of ``Dynamics.states`` stands among [smooth, relaxing].
    is_joined : bool
        Whether the rule and the plant's functions are one piece, which runs faster.
    """

    runs: Callable[..., None]
    slopes: Callable[..., int]
    gains: Callable[..., int]
    sizes: tuple[int, int]
    order: NDArray[np.int64]
    is_joined: bool


def native(structure: tuple[type[Effect], ...], *, continuous: bool = False, work: int = 0) -> Native:
    """Return the machine code of a plant with the effects of `structure`; threads may ask at once.

    Parameters
    ----------
    structure : tuple of type of Effect
        Of the plant.
    continuous : bool
        Whether the input is the reference and an ideal PD acts inside the step, its kp and kd appended to the
        parameters.
    work : int
        Substeps that it is asked for; what one structure is asked for adds up, and decides when its code is joined.
    """
    with _MAKING:
        forms = _forms(structure, continuous)
    return forms.code(work)


@lru_cache(maxsize=1024)
def _forms(structure: tuple[type[Effect], ...], continuous: bool) -> _Forms:
    """Return the code of a structure, which is made the first time."""
    return _Forms(Equations(structure, continuous))


@final
class _Forms:
    """The machine code of one structure: separate at first, joined when it is simulated much."""

    def __init__(self, equations: Equations) -> None:
        functions = {f"servolens_{name}": outputs for name, outputs in equations.functions().items()}
        numbers = {f"servolens_{name}": number for name, number in equations.numbers().items()}
        texts = [function_text(name, equations.inputs, outputs) for name, outputs in functions.items()]
        texts += [number_text(name, number) for name, number in numbers.items()]
        self._names = {*functions, *numbers}
        self._text = fused("\n".join(_merged(texts)))
        self._sizes = len(equations.smooth), len(equations.relaxing)
        self._order = np.argsort([*equations.smooth, *equations.relaxing], kind="stable").astype(np.int64)
        self._depends_on = [*platform_marks(), rule_mark(), self._text]
        self._work, self._joining = 0, Lock()
        joined = kept_before("joined", self._depends_on)
        self._best = self._separate() if joined is None else self._native([joined], is_joined=True)

    def code(self, work: int) -> Native:
        """Return the best code there is; while one thread joins it, others go on with what there was."""
        self._work += work  # what a race loses only delays the joining
        is_hot = self._work >= WORK_THAT_PAYS and not self._best.is_joined
        if is_hot and self._joining.acquire(blocking=False):
            try:
                self._best = self._best if self._best.is_joined else self._joined()
            finally:
                self._joining.release()
        return self._best

    def _separate(self) -> Native:
        """Compile the plant's functions by themselves, for the rule to call."""
        own = kept("plant", self._depends_on, lambda: object_code([elementary(), self._text], self._names))
        return self._native([_rule_object(), own], is_joined=False)

    def _joined(self) -> Native:
        """Compile the rule and the plant's functions together."""
        seen = {RUNS_ENTRY, GAINS_ENTRY, SLOPES_ENTRY}
        whole = kept("joined", self._depends_on, lambda: object_code([rule(), self._text], seen))
        return self._native([whole], is_joined=True)

    def _native(self, objects: list[bytes], *, is_joined: bool) -> Native:
        """Load object code."""
        engine = loaded(*objects)
        number, pointer = ctypes.c_int64, ctypes.c_void_p
        runs = ctypes.CFUNCTYPE(None, number, number, number, pointer, pointer, pointer)
        gains = ctypes.CFUNCTYPE(ctypes.c_int32, pointer, pointer, number, *[pointer] * 6)
        slopes = ctypes.CFUNCTYPE(number, pointer, pointer, pointer)
        return Native(
            runs=_function(runs, engine, RUNS_ENTRY),
            slopes=_function(slopes, engine, SLOPES_ENTRY),
            gains=_function(gains, engine, GAINS_ENTRY),
            sizes=self._sizes,
            order=self._order,
            is_joined=is_joined,
        )


def _function(kind: Any, engine: Any, name: str) -> Any:
    """Return a function of a ctypes kind."""
    function = kind(engine.get_function_address(name))
    function.owner = engine  # which frees the machine code when nobody has it any more
    return function


@lru_cache(maxsize=1)
def _rule_object() -> bytes:
    """Return the object code of the stepping rule, which calls the functions of a plant."""
    return kept("rule", [*platform_marks(), rule_mark()], lambda: object_code([rule()], {RUNS_ENTRY, GAINS_ENTRY}))


def _merged(texts: list[str]) -> list[str]:
    """Return the functions' texts with each declaration once."""
    lines = [line for text in texts for line in text.splitlines()]
    declared = dict.fromkeys(line for line in lines if line.startswith("declare"))
    return [*declared, *(line for line in lines if not line.startswith("declare"))]
