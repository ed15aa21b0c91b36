"""The equations of motion of a structure as machine code, for the compiled stepping rule to call."""

from __future__ import annotations

import ctypes
import os
from dataclasses import dataclass
from functools import lru_cache
from threading import Lock
from typing import TYPE_CHECKING, Any, final

import casadi as ca
import numpy as np

from servolens.dynamics import dynamics, ideal_pd
from servolens.simulation.codegen import SYMBOLS, function_text

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servolens.dynamics import Dynamics
    from servolens.effects import Effect

__all__ = ["Native", "native"]

_COMPILING = Lock()


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Native:
    """Machine code of a structure.

    All functions have the form ``f(x, p, out)``, with ``x = [y, v, t, u, d, moving, smooth states, relaxing states,
    their rates]`` and the plant's parameters in `p`.

    Attributes
    ----------
    addresses : ndarray of int64, shape (6,)
        * ``taylor``: acceleration, jerk, snap, then rate and its two derivatives of each smooth state;
        * ``breakaway``: push and friction level;
        * ``relaxation``: A and B of each relaxing state's ż = A − B z;
        * ``shown``: position shown by the sensor, velocity and position of the load (0 where that is y, v, y);
        * ``beginning``: the states of an axis at rest;
        * ``slopes``: the Jacobian of [v, acceleration, rates], column by column.
    sizes : tuple of int
        Numbers of smooth and of relaxing states.
    order : ndarray of int64
        Where each state of ``Dynamics.states`` stands among [smooth, relaxing].
    """

    addresses: NDArray[np.int64]
    sizes: tuple[int, int]
    order: NDArray[np.int64]
    keeper: Any


@lru_cache(maxsize=1024)
def native(structure: tuple[type[Effect], ...], *, continuous: bool = False) -> Native:
    """Return the machine code of a plant with the effects of `structure`.

    With `continuous` the input is the reference and an ideal PD acts inside the step, its kp and kd appended to the
    parameters.
    """
    equations = _Equations(structure, continuous)
    text = "\n".join(_merged([function_text(name, equations.inputs, e) for name, e in equations.functions().items()]))
    with _COMPILING:
        engine = _engine(text)
    names = ("taylor", "breakaway", "relaxation", "shown", "beginning", "slopes")
    absent = equations.absent()
    found = [0 if name in absent else engine.get_function_address(name) for name in names]
    return Native(
        addresses=np.array(found, dtype=np.int64),
        sizes=(len(equations.smooth), len(equations.relaxing)),
        order=np.argsort([*equations.smooth, *equations.relaxing], kind="stable").astype(np.int64),
        keeper=engine,
    )


@final
class _Equations:
    """The expressions behind each function, in the kernel's own layout of numbers."""

    def __init__(self, structure: tuple[type[Effect], ...], continuous: bool) -> None:
        self.d = d = dynamics(structure)
        self.smooth = [i for i, relaxes in enumerate(d.relaxing) if not relaxes]
        self.relaxing = [i for i, relaxes in enumerate(d.relaxing) if relaxes]
        self.moving, self.ramps = ca.SX.sym("moving"), ca.SX.sym("ramps", len(self.relaxing))
        states = [d.states[i] for i in (*self.smooth, *self.relaxing)]
        x = ca.vertcat(d.position, d.velocity, d.time, d.command, d.direction, self.moving, *states, self.ramps)
        gains = ca.SX.sym("gains", 2 if continuous else 0)
        self.inputs = [x, ca.vertcat(d.parameters, gains)]
        found, beginning = [d.push, d.level, d.rates], d.beginning
        if continuous:
            found = ca.substitute(found, [d.command], [_asked(d, gains, d.shown, d.output_velocity)])
            beginning = ca.substitute(beginning, d.command, _asked(d, gains, d.position, 0.0))
        self.push, self.level, self.rates = found
        self.beginning = beginning
        self.acceleration = self.push - self.level * d.direction

    def functions(self) -> dict[str, list[Any]]:
        d = self.d
        state = ca.vertcat(d.position, d.velocity, d.states)
        flow = ca.vertcat(d.velocity, self.acceleration, self.rates)
        return {
            "taylor": self._taylor(),
            "breakaway": [self.push, self.level],
            "relaxation": self._relaxation(),
            "shown": [d.shown, d.output_velocity, d.output],
            "beginning": [self.beginning[i] for i in (*self.smooth, *self.relaxing)],
            "slopes": [ca.vec(ca.densify(ca.jacobian(flow, state)))],
        }

    def absent(self) -> set[str]:
        """Return the names of the functions that would tell nothing."""
        d = self.d
        plain = ca.is_equal(d.shown, d.position) and ca.is_equal(d.output, d.position)
        names = {"shown"} if plain else set()
        if not self.relaxing:
            names.add("relaxation")
        return names if d.state_names else names | {"beginning"}

    def _taylor(self) -> list[Any]:
        """Return acceleration, jerk and snap, and the derivatives of the smooth states; relaxing ones are ramps."""
        d = self.d
        acceleration = self.moving * self.acceleration
        smooth = [self.rates[i] for i in self.smooth]
        along = ca.vertcat(d.position, d.velocity, d.time, *(d.states[i] for i in (*self.smooth, *self.relaxing)))
        flow = ca.vertcat(d.velocity, acceleration, 1.0, *smooth, self.ramps)
        series = []
        for first in (acceleration, *smooth):
            second = ca.jtimes(first, along, flow)
            series += [first, second, ca.jtimes(second, along, flow)]
        return series

    def _relaxation(self) -> list[Any]:
        found = []
        for i in self.relaxing:
            state = self.d.states[i]
            slope = -ca.gradient(self.rates[i], state)
            found += [self.rates[i] + slope * state, slope]
        return found


def _asked(d: Dynamics, gains: Any, position: Any, velocity: Any) -> Any:
    """Return what an ideal PD asks for; the input stands for its reference."""
    return ideal_pd(gains[0], gains[1], d.command, position, velocity)


def _merged(texts: list[str]) -> list[str]:
    """Return the functions' texts with each declaration once."""
    lines = [line for text in texts for line in text.splitlines()]
    declared = dict.fromkeys(line for line in lines if line.startswith("declare"))
    return [*declared, *(line for line in lines if not line.startswith("declare"))]


def _engine(text: str) -> Any:
    """Compile LLVM assembly; the engine that is returned owns the machine code."""
    import llvmlite.binding as llvm

    machine = _machine()
    module = llvm.parse_assembly(text)
    module.verify()
    engine = llvm.create_mcjit_compiler(module, machine())
    engine.finalize_object()
    return engine


@lru_cache(maxsize=1)
def _machine() -> Any:
    """Return a maker of target machines, once this process can compile and call the C library."""
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    library = ctypes.CDLL("ucrtbase" if os.name == "nt" else None)
    for name in SYMBOLS:
        address = ctypes.cast(getattr(library, name), ctypes.c_void_p).value
        llvm.add_symbol(name, address)
    target = llvm.Target.from_default_triple()

    def machine() -> Any:
        return target.create_target_machine(
            opt=2, cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), jit=True
        )

    return machine
