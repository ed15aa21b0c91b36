"""From CasADi expressions to LLVM's assembly language: the text that :mod:`servolens.simulation.native` compiles."""

from __future__ import annotations

import struct
from typing import Any

import casadi as ca

from servolens.errors import InputError

__all__ = ["SYMBOLS", "function_text", "number_text"]

COMPARE = {ca.OP_LT: "olt", ca.OP_LE: "ole", ca.OP_EQ: "oeq", ca.OP_NE: "une"}
ARITHMETIC = {ca.OP_ADD: "fadd", ca.OP_SUB: "fsub", ca.OP_MUL: "fmul", ca.OP_DIV: "fdiv"}
INTRINSICS = {
    ca.OP_SQRT: "llvm.sqrt.f64",
    ca.OP_EXP: "servolens_exp",
    ca.OP_LOG: "llvm.log.f64",
    ca.OP_SIN: "servolens_sin",
    ca.OP_COS: "servolens_cos",
    ca.OP_FABS: "llvm.fabs.f64",
    ca.OP_FLOOR: "llvm.floor.f64",
    ca.OP_CEIL: "llvm.ceil.f64",
    ca.OP_POW: "llvm.pow.f64",
    ca.OP_CONSTPOW: "llvm.pow.f64",
    ca.OP_COPYSIGN: "llvm.copysign.f64",
}
FUNCTIONS_OF_MATH = (
    "tan",
    "asin",
    "acos",
    "atan",
    "sinh",
    "cosh",
    "tanh",
    "asinh",
    "acosh",
    "atanh",
    "erf",
    "expm1",
    "log1p",
    "atan2",
    "hypot",
)
LIBRARY = {getattr(ca, f"OP_{name.upper()}"): name for name in FUNCTIONS_OF_MATH} | {ca.OP_FMOD: "fmod"}
SYMBOLS = (*sorted(LIBRARY.values()), "exp", "log", "sin", "cos", "pow")
"""Functions of the C library that compiled code may call."""


def function_text(name: str, inputs: list[Any], outputs: list[Any]) -> str:
    """Return LLVM assembly of ``int64_t name(const double *x, const double *p, double *out)``, which returns 0.

    Parameters
    ----------
    name : str
        Of the function.
    inputs : list of casadi.SX
        Two vectors, of which `x` and `p` hold the numbers.
    outputs : list of casadi.SX
        Vectors; `out` is filled with all their elements in turn.

    Raises
    ------
    InputError
        If an expression uses an operation that has no translation.
    """
    program = ca.Function(name, inputs, ca.cse([ca.densify(ca.vertcat(*outputs))]))
    writer = _Writer()
    held: dict[int, str] = {}
    known: dict[int, bool] = {}  # whether it is the same for a whole simulation
    for k in range(program.n_instructions()):
        operation = program.instruction_id(k)
        source, target = program.instruction_input(k), program.instruction_output(k)
        if operation == ca.OP_OUTPUT:
            writer.store(held[source[0]], target[1])
            continue
        if operation == ca.OP_INPUT:
            value, same = writer.load("xp"[source[0]], source[1]), source[0] == 1
        elif operation == ca.OP_CONST:
            value, same = _number(float(program.instruction_constant(k))), True
        elif operation == ca.OP_DIV and known[source[1]]:
            inverse = writer.operation(ca.OP_INV, [held[source[1]]])  # LLVM takes it out of the loop over the samples
            value, same = writer.operation(ca.OP_MUL, [held[source[0]], inverse]), known[source[0]]
        else:
            value, same = writer.operation(operation, [held[i] for i in source]), all(known[i] for i in source)
        held[target[0]], known[target[0]] = value, same
    body = "\n".join(writer.lines)
    declared = "\n".join(sorted(writer.declared))
    head = f"define i64 @{name}(ptr %x, ptr noalias readonly %p, ptr %out) alwaysinline nounwind {{"
    return f"{declared}\n{head}\n{body}\n  ret i64 0\n}}\n"


def number_text(name: str, number: int) -> str:
    """Return LLVM assembly of ``int64_t name(void)`` that returns `number`."""
    return f"define i64 @{name}() alwaysinline nounwind {{\n  ret i64 {number}\n}}\n"


def _number(value: float) -> str:
    """Return LLVM's exact notation of a double."""
    return f"0x{struct.unpack('>Q', struct.pack('>d', value))[0]:016X}"


class _Writer:
    """Lines of assembly in single static assignment, and the functions they call."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.declared: set[str] = set()
        self._count = 0

    def emit(self, text: str) -> str:
        self._count += 1
        self.lines.append(f"  %w{self._count} = {text}")
        return f"%w{self._count}"

    def load(self, array: str, index: int) -> str:
        place = self.emit(f"getelementptr double, ptr %{array}, i64 {index}")
        return self.emit(f"load double, ptr {place}")

    def store(self, value: str, index: int) -> None:
        place = self.emit(f"getelementptr double, ptr %out, i64 {index}")
        self.lines.append(f"  store double {value}, ptr {place}")

    def call(self, function: str, arguments: list[str]) -> str:
        types = ", ".join(["double"] * len(arguments))
        self.declared.add(f"declare double @{function}({types})")
        return self.emit(f"call double @{function}({', '.join(f'double {a}' for a in arguments)})")

    def test(self, kind: str, a: str, b: str) -> str:
        return self.emit(f"fcmp {kind} double {a}, {b}")

    def choose(self, condition: str, a: str, b: str) -> str:
        return self.emit(f"select i1 {condition}, double {a}, double {b}")

    def operation(self, code: int, given: list[str]) -> str:
        """Append one operation of CasADi's virtual machine and return where its value is."""
        a, b = given[0], given[-1]
        zero, one = _number(0.0), _number(1.0)
        if code in ARITHMETIC:
            return self.emit(f"{ARITHMETIC[code]} contract double {a}, {b}")
        if code in COMPARE:
            return self.choose(self.test(COMPARE[code], a, b), one, zero)
        if code in INTRINSICS or code in LIBRARY:
            return self.call(INTRINSICS.get(code) or LIBRARY[code], given)
        simple = {
            ca.OP_ASSIGN: lambda: a,
            ca.OP_NEG: lambda: self.emit(f"fneg contract double {a}"),
            ca.OP_SQ: lambda: self.emit(f"fmul contract double {a}, {a}"),
            ca.OP_TWICE: lambda: self.emit(f"fadd contract double {a}, {a}"),
            ca.OP_INV: lambda: self.emit(f"fdiv contract double {one}, {a}"),
            ca.OP_FMIN: lambda: self.choose(self.test("olt", a, b), a, b),
            ca.OP_FMAX: lambda: self.choose(self.test("ogt", a, b), a, b),
            ca.OP_NOT: lambda: self.choose(self.test("oeq", a, zero), one, zero),
            ca.OP_AND: lambda: self.choose(self.test("une", a, zero), self.operation(ca.OP_NE, [b, zero]), zero),
            ca.OP_OR: lambda: self.choose(self.test("une", a, zero), one, self.operation(ca.OP_NE, [b, zero])),
            ca.OP_IF_ELSE_ZERO: lambda: self.choose(self.test("une", a, zero), b, zero),
            ca.OP_SIGN: lambda: self.choose(self.test("oeq", a, zero), zero, self.call(COPYSIGN, [one, a])),
        }
        if code not in simple:
            raise InputError("an effect's physics uses a CasADi operation that the kernel does not know; rewrite it")
        return simple[code]()


COPYSIGN = INTRINSICS[ca.OP_COPYSIGN]
