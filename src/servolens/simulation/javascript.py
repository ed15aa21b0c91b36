"""A plant's equations of motion in JavaScript, from the same expressions that are compiled for the kernel."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import casadi as ca

from servolens.errors import InputError
from servolens.simulation.equations import Equations

if TYPE_CHECKING:
    from servolens.effects import Effect

__all__ = ["plant_script"]

INFIX = {
    ca.OP_ADD: "{}+{}",
    ca.OP_SUB: "{}-{}",
    ca.OP_MUL: "{}*{}",
    ca.OP_DIV: "{}/{}",
    ca.OP_FMOD: "{}%{}",
    ca.OP_LT: "+({}<{})",
    ca.OP_LE: "+({}<={})",
    ca.OP_EQ: "+({}==={})",
    ca.OP_NE: "+({}!=={})",
    ca.OP_AND: "+({}!==0&&{}!==0)",
    ca.OP_OR: "+({}!==0||{}!==0)",
    ca.OP_IF_ELSE_ZERO: "({}!==0?{}:0)",
    ca.OP_FMIN: "({0}<{1}?{0}:{1})",
    ca.OP_FMAX: "({0}>{1}?{0}:{1})",
    ca.OP_COPYSIGN: "(({1}<0||1/{1}<0)?-Math.abs({0}):Math.abs({0}))",
    ca.OP_ASSIGN: "{}",
    ca.OP_NEG: "-{}",
    ca.OP_NOT: "+({}===0)",
    ca.OP_SQ: "{0}*{0}",
    ca.OP_TWICE: "2*{}",
    ca.OP_INV: "1/{}",
    ca.OP_FABS: "Math.abs({})",
    ca.OP_ERF: "servolensErf({})",
    ca.OP_CONSTPOW: "Math.pow({},{})",
}
MATH: tuple[str, ...] = (
    "sqrt",
    "exp",
    "log",
    "sin",
    "cos",
    "tan",
    "asin",
    "acos",
    "atan",
    "sinh",
    "cosh",
    "tanh",
    "asinh",
    "acosh",
)
MATH += ("atanh", "floor", "ceil", "pow", "expm1", "log1p", "atan2", "hypot", "sign")
OPERATIONS = INFIX | {getattr(ca, f"OP_{name.upper()}"): f"Math.{name}" for name in MATH}
ERF = """function servolensErf(x) {
const z = x * x, size = Math.abs(x);
if (!(size < 6)) return x !== x ? x : Math.sign(x);
let term = x, sum = x;
if (size < 3) {
for (let k = 1; k < 120; k++) { term *= -z / k; sum += term / (2 * k + 1); }
return 1.1283791670955126 * sum;
}
let tail = 0;
for (let k = 60; k > 0; k--) tail = k / 2 / (size + tail);
return Math.sign(x) * (1 - Math.exp(-z) / (1.7724538509055159 * (size + tail)));
}
"""
"""JavaScript has no erf: its series, and for large arguments its continued fraction."""


@lru_cache(maxsize=64)
def plant_script(structure: tuple[type[Effect], ...], *, continuous: bool = False) -> str:
    """Return a JavaScript expression: what ``servolensRule`` of :mod:`.translated` asks of plants of this structure.

    Parameters
    ----------
    structure : tuple of type of Effect
        Of the plant.
    continuous : bool
        Whether an ideal PD acts inside the step, as in :func:`servolens.simulation.native.native`.

    Raises
    ------
    InputError
        If an expression uses an operation that has no translation.
    """
    equations = Equations(structure, continuous)
    wanted = {name: parts for name, parts in equations.functions().items() if name != "slopes"}
    functions = [f"{name}(x, p, out) {{\n{_body(name, equations.inputs, parts)}\n}}" for name, parts in wanted.items()]
    renamed = {"smooth": "smooth_states", "relaxing": "relaxing_states"}
    counts = [f"{renamed.get(name, name)}: () => {number}" for name, number in equations.numbers().items()]
    return "{\n" + ",\n".join([*counts, *functions]) + "\n}"


def _body(name: str, inputs: list[Any], outputs: list[Any]) -> str:
    """Return the statements that fill ``out`` with all elements of `outputs` in turn."""
    program = ca.Function(name, inputs, ca.cse([ca.densify(ca.vertcat(*outputs))]))
    lines: list[str] = []
    held: dict[int, str] = {}
    for k in range(program.n_instructions()):
        operation = program.instruction_id(k)
        source, target = program.instruction_input(k), program.instruction_output(k)
        if operation == ca.OP_OUTPUT:
            lines.append(f"out[{target[1]}] = {held[source[0]]};")
        elif operation == ca.OP_INPUT:
            held[target[0]] = f"{'xp'[source[0]]}[{source[1]}]"
        elif operation == ca.OP_CONST:
            held[target[0]] = _number(float(program.instruction_constant(k)))
        else:
            lines.append(f"const w{k} = {_operation(operation, [held[i] for i in source])};")
            held[target[0]] = f"w{k}"
    return "\n".join(lines)


def _operation(code: int, given: list[str]) -> str:
    """Return one operation of CasADi's virtual machine."""
    form = OPERATIONS.get(code)
    if form is None:
        raise InputError("an effect's physics uses a CasADi operation that JavaScript does not know; rewrite it")
    return form.format(*given) if "{" in form else f"{form}({', '.join(given)})"


def _number(value: float) -> str:
    """Return a number in JavaScript; one that is negative in brackets, for −−1 is another word there."""
    text = {"inf": "Infinity", "nan": "NaN"}.get(repr(abs(value)), repr(abs(value)))
    return f"(-{text})" if value < 0 or repr(value) == "-0.0" else text
