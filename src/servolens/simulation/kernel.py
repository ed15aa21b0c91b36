"""The stepping rule, one for all plants, in LLVM's language; what is compiled is kept on disk."""

from __future__ import annotations

import hashlib
import os
import platform
import re
import sys
import tempfile
from contextlib import suppress
from functools import lru_cache
from importlib import resources
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import platformdirs

from servolens import __version__
from servolens.simulation.contraction import fused
from servolens.simulation.machine import without_unused

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

SOURCES = ("elementary", "kalman", "digital", "plant_functions", "motion", "stepping", "kernel", "contraction")
__all__ = [
    "GAINS_ENTRY",
    "RUNS_ENTRY",
    "cache_folder",
    "elementary",
    "kept",
    "kept_before",
    "rule",
    "rule_mark",
]

RUN, RUNS_ENTRY, GAINS_ENTRY = "servolens_run", "servolens_runs", "servolens_gains"
"""Names of the functions in :func:`rule` that run one simulation, that run several, and that give an observer its
gains."""
POINTERS = 9
"""Arrays of one simulation."""
ELEMENTARY = ("servolens_exp", "servolens_sin", "servolens_cos")
"""Its functions that a plant's functions call."""
CALLED = "beyond_pd"
"""The function that is called where it is used, for it is rarely used."""


@lru_cache(maxsize=1)
def rule() -> str:
    """Return the LLVM assembly of :mod:`servolens.simulation.stepping`, from the cache folder if it is there."""
    folder = resources.files("servolens.simulation")
    sources = [folder.joinpath(f"{name}.py").read_text(encoding="utf-8") for name in SOURCES]
    versions = [__version__, version("numba"), version("llvmlite"), sys.version, platform.machine(), sys.platform]
    return kept("stepping", [*versions, *sources], lambda: _compiled().encode()).decode()


@lru_cache(maxsize=1)
def rule_mark() -> str:
    """Return a short text that is another one for another rule."""
    return hashlib.sha256(rule().encode()).hexdigest()


@lru_cache(maxsize=1)
def elementary() -> str:
    """Return the part of :func:`rule` that a plant's functions call, which is small."""
    return kept(
        "elementary", [version("llvmlite"), rule_mark()], lambda: without_unused(rule(), ELEMENTARY).encode()
    ).decode()


def kept(kind: str, depends_on: Sequence[str], make: Callable[[], bytes]) -> bytes:
    """Return what `make` returned for a `kind` that depends on these texts, from the cache folder if it is there.

    Where that cannot be written, it is made anew each time; a damaged file is replaced.
    """
    body = kept_before(kind, depends_on)
    if body is None:
        body = make()
        with suppress(OSError):  # a folder that cannot be written only costs time
            _write(_path(kind, depends_on), _mark(body) + b"\n" + body)
    return body


def kept_before(kind: str, depends_on: Sequence[str]) -> bytes | None:
    """Return what :func:`kept` would, if it is in the cache folder; else None."""
    with suppress(OSError):
        mark, _, body = _path(kind, depends_on).read_bytes().partition(b"\n")
        if mark == _mark(body):
            return body
    return None


def cache_folder() -> Path:
    """Return the folder of what is compiled: ``SERVOLENS_CACHE``, or the user's cache folder."""
    chosen = os.environ.get("SERVOLENS_CACHE")
    return Path(chosen) if chosen else Path(platformdirs.user_cache_dir("servolens", appauthor=False)) / "kernels"


def _path(kind: str, depends_on: Sequence[str]) -> Path:
    """Return the file of a `kind` that depends on these texts."""
    key = hashlib.sha256("\0".join(depends_on).encode()).hexdigest()[:24]
    return cache_folder() / f"{kind}-{key}"


def _mark(body: bytes) -> bytes:
    """Return the first line of the file, by which a damaged one is known."""
    return hashlib.sha256(body).hexdigest().encode()


def _write(path: Path, content: bytes) -> None:
    """Write a file at once; many processes may do so at the same time."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as file:
        try:
            file.write(content)
            file.close()
            Path(file.name).replace(path)
        except OSError:  # a full disk keeps no parts
            file.close()
            Path(file.name).unlink(missing_ok=True)
            raise


def _compiled() -> str:
    """Return what numba makes of the stepping rule, without all that only Python needs."""
    import llvmlite.binding as llvm

    from servolens.simulation import stepping

    whole = llvm.parse_assembly("")
    for name, compiled in stepping.compiled_rule().items():
        # numba wraps a function for C; of an entry the inner one is taken, whose result goes to its first argument
        is_entry = f"servolens_{name}" in (RUN, GAINS_ENTRY)
        wanted = compiled.native_name.removeprefix("cfunc.") if is_entry else compiled.native_name
        text = compiled.inspect_llvm().replace(" noinline ", " nounwind ")
        part = llvm.parse_assembly(re.sub(rf'@"?{re.escape(wanted)}"?\(', f"@servolens_{name}(", text))
        for function in part.functions:
            if function.is_declaration:
                continue
            if function.name != f"servolens_{name}":
                function.linkage = "internal"
            if not is_entry:
                called = function.name == f"servolens_{CALLED}"
                function.add_function_attribute("noinline" if called else "alwaysinline")
        for variable in part.global_variables:
            if not variable.is_declaration:
                variable.linkage = "internal"
        whole.link_in(part)
    whole.link_in(llvm.parse_assembly(_runs_text()))
    seen = [f.name for f in whole.functions if f.name.startswith("servolens_")]
    return fused(_promised(without_unused(str(whole), seen)))


def _runs_text() -> str:
    """Return assembly that runs several simulations of one structure, each with a row of pointers to its arrays."""
    places = [f"%p{j}" for j in range(POINTERS)]
    given = ", ".join(f"ptr {place}" for place in places)
    loads = [
        f"  {place}.at = getelementptr ptr, ptr %row, i64 {j}\n  {place} = load ptr, ptr {place}.at"
        for j, place in enumerate(places)
    ]
    return f"""
declare i32 @{RUN}(ptr, ptr, i64, i64, double{", ptr" * POINTERS})

define void @{RUNS_ENTRY}(i64 %count, i64 %n, i64 %substeps, ptr %delays, ptr %places, ptr %done) {{
begin:
  br label %next
next:
  %k = phi i64 [0, %begin], [%following, %one]
  %is_left = icmp slt i64 %k, %count
  br i1 %is_left, label %one, label %end
one:
  %delay.at = getelementptr double, ptr %delays, i64 %k
  %delay = load double, ptr %delay.at
  %first = mul i64 %k, {POINTERS}
  %row = getelementptr ptr, ptr %places, i64 %first
{chr(10).join(loads)}
  %done.at = getelementptr i64, ptr %done, i64 %k
  %failed = call i32 @{RUN}(ptr %done.at, ptr null, i64 %n, i64 %substeps, double %delay, {given}) noinline
  %following = add i64 %k, 1
  br label %next
end:
  ret void
}}
"""


def _promised(text: str) -> str:
    """Return assembly that says what a plant's functions leave alone, so that LLVM need not compile for the worst."""
    always = "nounwind willreturn memory"
    arrays = rf"\1(ptr readonly, ptr readonly, ptr writeonly) {always}(argmem: readwrite)"
    text = re.sub(r"(?m)^(declare i64 @servolens_\w+)\(ptr, ptr, ptr\).*$", arrays, text)
    return re.sub(r"(?m)^(declare i64 @servolens_\w+)\(\).*$", rf"\1() {always}(none)", text)
