"""The equations of motion of a structure as machine code, for the compiled stepping rule to call."""

from __future__ import annotations

import ctypes
import os
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from threading import Lock
from typing import TYPE_CHECKING, Any, final

import casadi as ca
import numpy as np

from servolens.dynamics import dynamics, ideal_pd
from servolens.simulation.codegen import SYMBOLS, function_text, number_text
from servolens.simulation.kernel import ENTRY, GAINS, kept, rule

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from servolens.dynamics import Dynamics
    from servolens.effects import Effect

__all__ = ["Native", "native"]

SWITCHES = (ca.OP_LT, ca.OP_LE, ca.OP_FMIN, ca.OP_FMAX, ca.OP_FABS, ca.OP_SIGN)
"""Operations that have a kink where their arguments are equal, or their argument 0."""
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
    equations = _Equations(structure, continuous)
    texts = [function_text(f"servolens_{name}", equations.inputs, e) for name, e in equations.functions().items()]
    texts += [number_text(f"servolens_{name}", number) for name, number in equations.numbers().items()]
    engine = _engine("\n".join(_merged(texts)))
    number, real, pointer = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p
    run = ctypes.CFUNCTYPE(ctypes.c_int32, pointer, pointer, number, number, real, *[pointer] * 9)
    gains = ctypes.CFUNCTYPE(ctypes.c_int32, pointer, pointer, number, *[pointer] * 5)
    slopes = ctypes.CFUNCTYPE(number, pointer, pointer, pointer)
    return Native(
        run=run(engine.get_function_address(ENTRY)),
        slopes=slopes(engine.get_function_address("servolens_slopes")),
        gains=gains(engine.get_function_address(GAINS)),
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
        self.moving, self.shaking = ca.SX.sym("moving"), ca.SX.sym("shaking")
        self.ramps = ca.SX.sym("ramps", len(self.relaxing))
        states = [d.states[i] for i in (*self.smooth, *self.relaxing)]
        axis = [d.position, d.velocity, d.time, d.command, d.direction, self.moving, self.shaking]
        x = ca.vertcat(*axis, *states, self.ramps)
        gains = ca.SX.sym("gains", 2 if continuous else 0)
        self.inputs = [x, ca.vertcat(d.parameters, gains)]
        found, beginning = [d.push + self.shaking, d.level, d.rates], d.beginning
        if continuous:
            found = ca.substitute(found, [d.command], [_asked(d, gains, d.shown, d.output_velocity)])
            beginning = ca.substitute(beginning, d.command, _asked(d, gains, d.position, 0.0))
        self.push, self.level, self.rates = found
        self.beginning = beginning
        self.acceleration = self.push - self.level * d.direction
        self.motion = ca.vertcat(d.position, d.velocity, d.time, d.states)
        self.edges = self._edges()

    def functions(self) -> dict[str, list[Any]]:
        """Return what the stepping rule calls by these names, and ``slopes``."""
        d = self.d
        state = ca.vertcat(d.position, d.velocity, d.states)
        flow = ca.vertcat(d.velocity, self.acceleration, self.rates)
        return {
            "taylor": self._taylor(),
            "breakaway": [self.push, self.level],
            "relaxation": self._relaxation(),
            "kinked": self.edges,
            "shown": [d.shown, d.output_velocity, d.output],
            "beginning": [self.beginning[i] for i in (*self.smooth, *self.relaxing)],
            "slopes": [ca.vec(ca.densify(ca.jacobian(flow, state)))],
        }

    def numbers(self) -> dict[str, int]:
        """Return the constants that the stepping rule asks for by these names."""
        drifts = ca.depends_on(ca.vertcat(0, *self._relaxation()), self.motion)
        return {
            "parameters": self.inputs[1].numel(),
            "smooth": len(self.smooth),
            "relaxing": len(self.relaxing),
            "drifts": int(drifts),
            "kinks": len(self.edges),
        }

    def _edges(self) -> list[Any]:
        """Return functions of the motion whose changes of sign are kinks of the acceleration or of a rate."""
        found: dict[int, Any] = {}
        waiting = [*ca.vertsplit(ca.vertcat(self.acceleration, *(self.rates[i] for i in self.smooth)))]
        seen = set()
        while waiting:
            element = waiting.pop()
            if element.__hash__() in seen or element.is_constant() or element.is_symbolic():
                continue
            seen.add(element.__hash__())
            parts = [element.dep(i) for i in range(element.n_dep())]
            waiting += parts
            if element.op() in SWITCHES:
                edge = parts[0] - parts[1] if len(parts) > 1 else parts[0]
                if ca.depends_on(edge, self.motion):
                    found[element.__hash__()] = edge
        return list(found.values())

    def _taylor(self) -> list[Any]:
        """Return acceleration, jerk and snap, and the derivatives of the smooth states; relaxing ones are ramps.

        Jerk and snap come from the gradient and the Hessian, which do not wait for the acceleration: a processor
        works them out beside it.
        """
        d = self.d
        moving = self.moving if d.state_names else 1.0  # what remembers nothing is not stepped at rest
        smooth = [self.rates[i] for i in self.smooth]
        along = ca.vertcat(d.position, d.velocity, d.time, *(d.states[i] for i in (*self.smooth, *self.relaxing)))
        firsts = [moving * self.acceleration, *smooth]
        flow = ca.vertcat(d.velocity, firsts[0], 1.0, *smooth, self.ramps)
        gradients = [ca.gradient(first, along) for first in firsts]
        seconds = [ca.dot(gradient, flow) for gradient in gradients]
        bend = ca.vertcat(firsts[0], seconds[0], 0.0, *seconds[1:], ca.SX(len(self.relaxing), 1))
        thirds = [ca.dot(gradient, bend) + ca.bilin(ca.jacobian(gradient, along), flow, flow) for gradient in gradients]
        return [value for three in zip(firsts, seconds, thirds, strict=True) for value in three]

    def _relaxation(self) -> list[Any]:
        """Return A and B of each relaxing state's ż = A − B z."""
        found = []
        for i in self.relaxing:
            rate, state = self.rates[i], self.d.states[i]
            found += [ca.substitute(rate, state, 0.0), -ca.gradient(rate, state)]
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
    """Load LLVM assembly, compiled together with the stepping rule; the engine returned owns the machine code."""
    import llvmlite.binding as llvm

    machine = _machine()()
    depends_on = [version("llvmlite"), machine.triple, *_processor(), rule(), text]
    code = kept("plant", depends_on, lambda: _compiled(text))
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    return engine


def _compiled(text: str) -> bytes:
    """Return the object code of LLVM assembly together with the stepping rule."""
    import llvmlite.binding as llvm

    machine = _machine()()
    module = llvm.parse_assembly(rule())
    module.link_in(llvm.parse_assembly(text))
    for function in module.functions:
        if not function.is_declaration and function.name not in (ENTRY, GAINS, "servolens_slopes"):
            function.linkage = "internal"
    tuning = llvm.create_pipeline_tuning_options(speed_level=2)
    builder = llvm.create_pass_builder(machine, tuning)
    builder.getModulePassManager().run(module, builder)
    return bytes(machine.emit_object(module))


def _processor() -> tuple[str, str]:
    """Return name and features of the processor."""
    import llvmlite.binding as llvm

    return llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()


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
        cpu, features = _processor()
        return target.create_target_machine(opt=2, cpu=cpu, features=features, jit=True)

    return machine
