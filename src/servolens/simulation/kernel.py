"""The compiled stepping rule, one for all plants, kept in memory and on disk."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import sys
import tempfile
from contextlib import suppress
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import platformdirs

from servolens import __version__

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["cache_folder", "kernel"]


@lru_cache(maxsize=1)
def kernel() -> Callable[..., int]:
    """Return the compiled ``run`` of :mod:`servolens.simulation.stepping`."""
    import numba

    source = resources.files("servolens.simulation").joinpath("stepping.py").read_text(encoding="utf-8")
    key = "\n".join([__version__, numba.__version__, sys.version, source])
    name = f"servolens_kernel_{hashlib.sha256(key.encode()).hexdigest()[:24]}"
    try:
        return _load(name, _write_once(name, source))
    except Exception:
        _forget(name)
        return _load(name, _write_once(name, source))


def _load(name: str, path: Path) -> Callable[..., int]:
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None  # noqa: PT018, S101 - a .py path always has a loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # numba looks it up when it loads the compiled form
    spec.loader.exec_module(module)
    run: Callable[..., int] = module.run
    return run


def _forget(name: str) -> None:
    """Remove a kernel's files, so that it is compiled anew."""
    sys.modules.pop(name, None)
    for folder in (cache_folder(), _session_folder()):
        for path in (*folder.glob(f"{name}*"), *(folder / "__pycache__").glob(f"{name}*")):
            with suppress(OSError):
                path.unlink()


def cache_folder() -> Path:
    """Return the folder of the compiled kernels: ``SERVOLENS_CACHE``, or the user's cache folder."""
    chosen = os.environ.get("SERVOLENS_CACHE")
    return Path(chosen) if chosen else Path(platformdirs.user_cache_dir("servolens", appauthor=False)) / "kernels"


def _write_once(name: str, source: str) -> Path:
    """Put the source where numba can keep its compiled form beside it; many processes may do so at once."""
    for folder in (cache_folder(), _session_folder()):
        path = folder / f"{name}.py"
        try:
            if path.is_file() and path.read_text(encoding="utf-8") == source and os.access(folder, os.W_OK):
                return path
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile("w", dir=folder, suffix=".tmp", delete=False, encoding="utf-8") as file:
                file.write(source)
            Path(file.name).replace(path)
        except OSError:
            continue
        else:
            return path
    raise OSError(f"neither {cache_folder()} nor {_session_folder()} can be written")


@lru_cache(maxsize=1)
def _keeper() -> Any:
    return tempfile.TemporaryDirectory(prefix="servolens-kernels-")


def _session_folder() -> Path:
    """Return a folder that lives as long as this process, for machines whose cache folder cannot be written."""
    return Path(_keeper().name)
