"""The stepping rule in JavaScript, translated from the Python text that numba compiles: one rule, two machines.

The rule uses a small part of Python (numbers, arrays, loops, tuples), and that part is all that is known here. What it
uses beside it is refused, so that a change of the rule cannot be lost in translation.
"""

from __future__ import annotations

import ast
from functools import lru_cache
from importlib import resources
from typing import Any, NoReturn

__all__ = ["RULE", "rule_places", "rule_script"]

RULE = "servolensRule"
"""Name of the function of a plant's part that returns ``run``."""
MODULES = ("digital", "plant_functions", "motion", "stepping")
LEFT_OUT = {"compiled_rule", "numbers"}
"""What only numba needs."""
RESERVED = {"new", "var", "let", "const", "function", "switch", "case", "default", "delete", "this", "void", "typeof"}
"""Words of JavaScript that are names in Python."""
CALLS = {
    "abs": "Math.abs",
    "max": "Math.max",
    "min": "Math.min",
    "int": "Math.trunc",
    "ceil": "Math.ceil",
    "floor": "Math.floor",
    "exponential": "Math.exp",
    "numbers": "new Float64Array",
    "beyond_pd": "law_beyond_pd",
}
OPERATORS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.USub: "-", ast.Not: "!"}
COMPARISONS = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "===", ast.NotEq: "!=="}


def rule_places() -> dict[str, int]:
    """Return where each setting of :mod:`servolens.simulation.digital` stands among those that ``run`` is told."""
    constants: dict[str, float] = {}
    _note_constants(_tree("digital"), constants)
    return {name: int(place) for name, place in constants.items() if name.isupper()}


@lru_cache(maxsize=1)
def rule_script() -> str:
    """Return the JavaScript of ``servolensRule(plant)``, a function that returns ``run``.

    ``plant`` is an object with the functions that :mod:`servolens.simulation.stepping` calls; ``run`` takes what
    :func:`servolens.simulation.stepping.run` takes, arrays as ``Float64Array``.
    """
    trees = [_tree(name) for name in MODULES]
    constants: dict[str, float] = {}
    for tree in trees:
        _note_constants(tree, constants)
    functions = [node for tree in trees for node in tree.body if isinstance(node, ast.FunctionDef)]
    wanted = [node for node in functions if node.name not in LEFT_OUT and not _is_intrinsic(node)]
    texts = [_Writer(constants).function(node) for node in wanted]
    taken = "parameters, smooth_states, relaxing_states, drifts, kinks, contacts, taylor, breakaway, relaxation"
    body = "\n".join(texts)
    head = f'function {RULE}(plant) {{\n"use strict";\nconst {{{taken}, kinked, shown, beginning}} = plant;'
    return f"{head}\n{body}\nreturn run;\n}}\n"


def _tree(name: str) -> ast.Module:
    text = resources.files("servolens.simulation").joinpath(f"{name}.py").read_text(encoding="utf-8")
    return ast.parse(text)


def _is_intrinsic(node: ast.FunctionDef) -> bool:
    """Whether a function is one of the module's own for numba: it begins with an underscore."""
    return node.name.startswith("_")


def _note_constants(tree: ast.Module, constants: dict[str, float]) -> None:
    """Note the numbers that a module gives names to."""
    for node in tree.body:
        if not isinstance(node, ast.Assign):
            continue
        (target,) = node.targets
        names = [e.id for e in target.elts if isinstance(e, ast.Name)] if isinstance(target, ast.Tuple) else []
        names = [target.id] if isinstance(target, ast.Name) else names
        values = _numbers_of(node.value)
        if len(values) == len(names):
            constants.update(zip(names, values, strict=True))


def _numbers_of(node: ast.expr) -> list[float]:
    """Return the numbers of an expression: one, several, or a range; empty where it is something else."""
    match node:
        case ast.Constant(value=int() | float() as value):
            return [value]
        case ast.BinOp(left=ast.Constant(value=a), op=ast.Div(), right=ast.Constant(value=b)):
            return [float(a) / float(b)]  # type: ignore[arg-type]  # numbers, as the rule's fractions are
        case ast.Tuple(elts=elements):
            found = [_numbers_of(element) for element in elements]
            return [one[0] for one in found if len(one) == 1]
        case ast.Call(func=ast.Name(id="range"), args=arguments):
            ends = [_numbers_of(argument)[0] for argument in arguments]
            return [*range(*(int(end) for end in ends))]
    return []


class _Writer:
    """Writes one function."""

    def __init__(self, constants: dict[str, float]) -> None:
        self.constants, self.count = constants, 0

    def function(self, node: ast.FunctionDef) -> str:
        given = [argument.arg for argument in node.args.args]
        stored = [n.id for n in ast.walk(node) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)]
        own = [name for name in dict.fromkeys(stored) if name not in given]
        body = "\n".join(self.statement(one) for one in node.body)
        declared = f"let {', '.join(map(_named, own))};\n" if own else ""
        return f"function {node.name}({', '.join(given)}) {{\n{declared}{body}\n}}"

    def statement(self, node: ast.stmt) -> str:  # noqa: C901 - one case for each kind of statement
        match node:
            case ast.Expr(value=ast.Constant()):
                return ""
            case ast.Expr(value=value):
                return f"{self.value(value)};"
            case ast.Return(value=ast.Tuple(elts=parts)):
                return f"return [{', '.join(map(self.value, parts))}];"
            case ast.Return(value=ast.expr() as value):
                return f"return {self.value(value)};"
            case ast.Assign(targets=targets, value=value):
                return self.assignment(targets, value)
            case ast.AnnAssign(target=target, value=ast.expr() as value):
                return f"{self.value(target)} = {self.value(value)};"
            case ast.AugAssign(target=target, op=op, value=value):
                return f"{self.value(target)} {OPERATORS[type(op)]}= {self.value(value)};"
            case ast.If() | ast.For() | ast.While(orelse=[]):
                return self.block(node)
            case ast.Continue():
                return "continue;"
            case ast.Break():
                return "break;"
        return _unknown(node)

    def block(self, node: ast.If | ast.For | ast.While) -> str:
        body = "\n".join(map(self.statement, node.body))
        if isinstance(node, ast.For):
            return f"{self.loop(node)} {{\n{body}\n}}"
        if isinstance(node, ast.While):
            return f"while ({self.value(node.test)}) {{\n{body}\n}}"
        otherwise = "\n".join(map(self.statement, node.orelse))
        return f"if ({self.value(node.test)}) {{\n{body}\n}}" + (f" else {{\n{otherwise}\n}}" if otherwise else "")

    def loop(self, node: ast.For) -> str:
        match node:
            case ast.For(target=ast.Name(id=name), iter=ast.Call(func=ast.Name(id="range"), args=ends), orelse=[]) if (
                len(ends) <= 2
            ):
                first, last = ("0", self.value(ends[0])) if len(ends) == 1 else map(self.value, ends)
                self.count += 1
                end = f"end{self.count}"
                own = name if name != "_" else f"turn{self.count}"
                return f"for (let {own} = {first}, {end} = {last}; {own} < {end}; {own}++)"
        return _unknown(node)

    def assignment(self, targets: list[ast.expr], value: ast.expr) -> str:
        """Assign several values at once where the later ones may hang on the earlier targets."""
        match targets, value:
            case [ast.List(elts=names) | ast.Tuple(elts=names)], ast.Tuple(elts=values):
                self.count += 1
                kept = [f"kept{self.count}_{i}" for i in range(len(values))]
                first = ", ".join(f"{k} = {self.value(v)}" for k, v in zip(kept, values, strict=True))
                then = " ".join(f"{self.value(n)} = {k};" for n, k in zip(names, kept, strict=True))
                return f"{{ const {first}; {then} }}"
            case [ast.Tuple(elts=names)], _:
                return f"[{', '.join(map(self.value, names))}] = {self.value(value)};"
            case [ast.Name() | ast.Subscript() as target], _:
                return f"{self.value(target)} = {self.value(value)};"
        return _unknown(value)

    def value(self, node: ast.expr) -> str:  # noqa: C901 - one case for each kind of expression
        match node:
            case ast.Constant(value=bool() as value):
                return str(value).lower()
            case ast.Constant(value=int() | float() as value):
                return repr(value)
            case ast.Name(id=name):
                return repr(self.constants[name]) if name in self.constants else _named(name)
            case ast.BinOp(left=left, op=op, right=right) if type(op) in OPERATORS:
                return f"({self.value(left)} {OPERATORS[type(op)]} {self.value(right)})"
            case ast.UnaryOp(op=op, operand=operand):
                return f"({OPERATORS[type(op)]}{self.value(operand)})"
            case ast.BoolOp(op=op, values=values):
                return f"({(' && ' if isinstance(op, ast.And) else ' || ').join(map(self.value, values))})"
            case ast.Compare(left=left, ops=ops, comparators=others):
                terms = [self.value(left), *map(self.value, others)]
                parts = [f"{a} {COMPARISONS[type(op)]} {b}" for a, op, b in zip(terms, ops, terms[1:], strict=False)]
                return f"({' && '.join(parts)})"
            case ast.IfExp(test=test, body=body, orelse=orelse):
                return f"({self.value(test)} ? {self.value(body)} : {self.value(orelse)})"
            case ast.Subscript(value=array, slice=index):
                return f"{self.value(array)}[{self.value(index)}]"
            case ast.Tuple(elts=parts):
                return f"[{', '.join(map(self.value, parts))}]"
            case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name), args=arguments, keywords=[]):
                return self.call(name, arguments)
        return _unknown(node)

    def call(self, name: str, arguments: list[ast.expr]) -> str:
        return f"{CALLS.get(name, name)}({', '.join(map(self.value, arguments))})"


def _named(name: str) -> str:
    return f"{name}_" if name in RESERVED else name


def _unknown(node: Any) -> NoReturn:
    raise NotImplementedError(f"line {node.lineno}: the page's simulator has no word for {ast.unparse(node)!r}")
