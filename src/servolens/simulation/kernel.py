"""The stepping rule, one for all plants, in LLVM's language: compiled once and kept on disk."""

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

import platformdirs

from servolens import __version__

SOURCES = ("elementary", "stepping", "kernel")
__all__ = ["ENTRY", "cache_folder", "rule"]

ENTRY = "servolens_run"
"""Name of the function in :func:`rule` that runs a simulation."""


@lru_cache(maxsize=1)
def rule() -> str:
    """Return the LLVM assembly of :mod:`servolens.simulation.stepping`, from the cache folder if it is there."""
    folder = resources.files("servolens.simulation")
    sources = [folder.joinpath(f"{name}.py").read_text(encoding="utf-8") for name in SOURCES]
    versions = [__version__, version("numba"), version("llvmlite"), sys.version, platform.machine(), sys.platform]
    key = "\0".join([*versions, *sources])
    path = cache_folder() / f"stepping-{hashlib.sha256(key.encode()).hexdigest()[:24]}.ll"
    with suppress(OSError, ValueError):
        text = path.read_text(encoding="utf-8")
        mark, _, body = text.partition("\n")
        if mark == _mark(body):
            return body
    body = _compiled()
    with suppress(OSError):  # a folder that cannot be written only costs time
        _write(path, f"{_mark(body)}\n{body}")
    return body


def cache_folder() -> Path:
    """Return the folder of the compiled rule: ``SERVOLENS_CACHE``, or the user's cache folder."""
    chosen = os.environ.get("SERVOLENS_CACHE")
    return Path(chosen) if chosen else Path(platformdirs.user_cache_dir("servolens", appauthor=False)) / "kernels"


def _mark(body: str) -> str:
    """Return the first line of the file, by which a damaged one is known."""
    return f"; sha256 {hashlib.sha256(body.encode()).hexdigest()}"


def _write(path: Path, text: str) -> None:
    """Write a file at once; many processes may do so at the same time."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile("w", dir=path.parent, suffix=".tmp", delete=False, encoding="utf-8") as file:
        file.write(text)
    Path(file.name).replace(path)


def _compiled() -> str:
    """Return what numba makes of the stepping rule, without all that only Python needs."""
    import llvmlite.binding as llvm

    from servolens.simulation import stepping

    whole = llvm.parse_assembly("")
    for name, compiled in stepping.compiled_rule().items():
        # numba wraps a function for C; of `run` the inner one is taken, whose result goes to its first argument
        wanted = compiled.native_name.removeprefix("cfunc.") if f"servolens_{name}" == ENTRY else compiled.native_name
        text = compiled.inspect_llvm().replace(" noinline ", " nounwind ")
        part = llvm.parse_assembly(re.sub(rf'@"?{re.escape(wanted)}"?\(', f"@servolens_{name}(", text))
        for function in part.functions:
            if function.is_declaration:
                continue
            if function.name != f"servolens_{name}":
                function.linkage = "internal"
            if f"servolens_{name}" != ENTRY:
                function.add_function_attribute("alwaysinline")
        for variable in part.global_variables:
            if not variable.is_declaration:
                variable.linkage = "internal"
        whole.link_in(part)
    passes = llvm.create_new_module_pass_manager()
    passes.add_global_dead_code_eliminate_pass()
    machine = llvm.Target.from_default_triple().create_target_machine()
    passes.run(whole, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options()))
    return str(whole)
