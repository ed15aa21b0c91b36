"""Products fused into sums in LLVM's assembly, so that bits do not depend on what is compiled together.

LLVM fuses a ``contract`` product into a sum where both end up in one block of code, which it decides anew for each
piece that it compiles. Here the pairs are chosen once, in the text. ``llvm.fmuladd`` rounds once on every processor
that has such an instruction, and twice on the others.
"""

from __future__ import annotations

import re
from collections import Counter

__all__ = ["fused"]

NAME = re.compile(r'%(?:"[^"]*"|[\w.$-]+)')
OPERATION = re.compile(
    rf"^  (?P<name>{NAME.pattern}) = (?P<kind>fmul|fadd|fsub) contract double (?P<a>[^,]+), (?P<b>[^,\s]+)$",
    re.MULTILINE,
)
DECLARED = "declare double @llvm.fmuladd.f64(double, double, double)"


def fused(text: str) -> str:
    """Return LLVM assembly with each product that only a sum uses fused into it, and nothing left for LLVM to fuse."""
    result = "".join(map(_fused_function, re.split(r"^(?=define )", text, flags=re.MULTILINE)))
    declared = "" if DECLARED in result else f"{DECLARED}\n"
    return result.replace(" contract ", " ") + declared


def _fused_function(text: str) -> str:
    """Return one function with its products fused; those stay where they are, unused."""
    uses = Counter(NAME.findall(text))
    products = {m["name"]: m for m in OPERATION.finditer(text) if m["kind"] == "fmul" and uses[m["name"]] == 2}

    def written(sum_: re.Match[str]) -> str:
        a, b = sum_["a"], sum_["b"]
        if sum_["kind"] == "fmul" or not (a in products or b in products):
            return sum_[0]
        product, other = (products[a], b) if a in products else (products[b], a)
        first, second, lines = product["a"], product["b"], []
        if sum_["kind"] == "fsub":
            negated = f'%"{sum_["name"][1:].strip(chr(34))}.negated"'
            lines.append(f"  {negated} = fneg double {b if a in products else first}")
            first, other = (first, negated) if a in products else (negated, other)
        call = f"call double @llvm.fmuladd.f64(double {first}, double {second}, double {other})"
        return "\n".join([*lines, f"  {sum_['name']} = {call}"])

    return OPERATION.sub(written, text)
