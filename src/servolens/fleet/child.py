"""The process that studies axes, one after the other, for a :class:`~servolens.fleet.keeper.Keeper`."""

from __future__ import annotations

import ctypes
import ctypes.util
import gc
import json
import os
import sys
import threading
import time
from contextlib import suppress
from typing import IO, Any

from servolens.processors import die_with_parent

__all__ = ["end_with_parent", "main", "memory_of"]

LOOK_INTERVAL = 1.0
"""Seconds between looks whether the parent is still there."""
PAGE = os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 4096


def main() -> None:
    """Answer each line of standard input, a job, with one line, its result; end when the input ends."""
    end_with_parent(int(sys.argv[1]))
    jobs = sys.stdin.buffer
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # libraries print
    from servolens.fleet.axis_study import studied

    for line in jobs:
        began = time.process_time()
        result = studied(json.loads(line))
        cost = {"cpu_seconds": time.process_time() - began, "memory": _tidy()}
        _answer(answers, {"result": result, "cost": cost})
    os._exit(0)  # a library's clean-up may crash or wait


def end_with_parent(parent: int) -> None:
    """Let this process end when its parent does, however and whenever that ends; on POSIX systems only.

    Parameters
    ----------
    parent : int
        Number of the process whose main thread started this one.
    """
    if os.name != "posix":
        return
    die_with_parent()
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def memory_of(process: int) -> float | None:
    """Return the resident memory of a process and its children [MiB]; None where the system does not tell."""
    try:
        with open(f"/proc/{process}/statm", encoding="ascii") as stream:  # noqa: PTH123 - five times a second
            own = int(stream.read().split()[1]) * PAGE / 2**20
    except (OSError, ValueError, IndexError):
        return None
    with suppress(OSError, ValueError):
        for task in os.listdir(f"/proc/{process}/task"):  # noqa: PTH208 - names are what is needed
            with open(f"/proc/{process}/task/{task}/children", encoding="ascii") as stream:  # noqa: PTH123 - as above
                own += sum(memory_of(int(child)) or 0.0 for child in stream.read().split())
    return own


def _answer(stream: IO[bytes], value: dict[str, Any]) -> None:
    stream.write(json.dumps(value, ensure_ascii=True, allow_nan=False).encode("ascii") + b"\n")
    stream.flush()


def _tidy() -> float:
    """Give memory that is free back to the system, and return what is still used [MiB]."""
    gc.collect()
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
    return memory_of(os.getpid()) or 0.0


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(LOOK_INTERVAL)
    os._exit(1)
