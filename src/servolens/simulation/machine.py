"""LLVM's assembly as machine code of this processor: compiled to object code, and loaded."""

from __future__ import annotations

import ctypes
import os
from functools import lru_cache
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from servolens.simulation.codegen import SYMBOLS

if TYPE_CHECKING:
    from collections.abc import Collection

__all__ = ["loaded", "object_code", "platform_marks", "without_unused"]


@lru_cache(maxsize=1)
def platform_marks() -> tuple[str, ...]:
    """Return what object code depends on beside its text: version of the compiler, system and processor."""
    return version("llvmlite"), _machine().triple, *_processor()


def object_code(texts: list[str], seen: Collection[str]) -> bytes:
    """Return the object code of LLVM assembly.

    Parameters
    ----------
    texts : list of str
        Compiled as one piece.
    seen : collection of str
        Names of the functions that are called from outside.
    """
    import llvmlite.binding as llvm

    machine = _machine()
    module = llvm.parse_assembly(texts[0])
    for text in texts[1:]:
        module.link_in(llvm.parse_assembly(text))
    _hide(module, seen)
    tuning = llvm.create_pipeline_tuning_options(speed_level=2)
    builder = llvm.create_pass_builder(machine, tuning)
    builder.getModulePassManager().run(module, builder)
    return bytes(machine.emit_object(module))


def without_unused(text: str, seen: Collection[str]) -> str:
    """Return LLVM assembly of the functions `seen` and of what they use."""
    import llvmlite.binding as llvm

    builder = llvm.create_pass_builder(_machine(), llvm.create_pipeline_tuning_options())
    module = llvm.parse_assembly(text)
    _hide(module, seen)
    passes = llvm.create_new_module_pass_manager()
    passes.add_global_dead_code_eliminate_pass()
    passes.run(module, builder)
    return str(module)


def loaded(*objects: bytes) -> Any:
    """Load object code, which may call one another's functions; the engine returned owns the machine code."""
    import llvmlite.binding as llvm

    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine())
    for code in objects:
        engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    return engine


def _hide(module: Any, seen: Collection[str]) -> None:
    """Let the functions of a module but `seen` be seen in it only."""
    for function in module.functions:
        if not function.is_declaration and function.name not in seen:
            function.linkage = "internal"


def _machine() -> Any:
    """Return a target machine; an engine keeps it."""
    cpu, features = _processor()
    return _target().create_target_machine(opt=2, cpu=cpu, features=features, jit=True)


@lru_cache(maxsize=1)
def _processor() -> tuple[str, str]:
    """Return name and features of the processor."""
    import llvmlite.binding as llvm

    return llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()


@lru_cache(maxsize=1)
def _target() -> Any:
    """Return LLVM's target, once this process can compile and call the C library."""
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    library = ctypes.CDLL("ucrtbase" if os.name == "nt" else None)
    for name in SYMBOLS:
        address = ctypes.cast(getattr(library, name), ctypes.c_void_p).value
        llvm.add_symbol(name, address)
    return llvm.Target.from_default_triple()
