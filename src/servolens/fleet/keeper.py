"""A process for each worker, with limits: an axis that hangs, crashes or takes all memory ends that process only."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
import weakref
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from servolens.fleet.axis_study import stopped
from servolens.fleet.child import memory_of
from servolens.processors import PROCESSORS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

__all__ = ["Keeper", "keepers", "study_axis"]

TRIES = 3
"""How often an axis is begun whose process ends for no reason of its own."""
LOOK_INTERVAL = 0.2
"""Seconds between looks at the limits."""
LARGE_PROCESS = 1024.0
"""A process that holds more memory than this between two axes gives way to a new one [MiB]."""
SINGLE = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS", PROCESSORS)
"""Each worker has one processor."""
ARENAS = "MALLOC_ARENA_MAX"
_START = "import sys; sys.path.insert(0, {root!r}); from servolens.fleet.child import main; main()"
_mine = threading.local()
_all: weakref.WeakSet[Keeper] = weakref.WeakSet()
_closing = threading.Event()


def study_axis(job: str) -> str:
    """Study one axis in this worker's process: what an executor is given.

    Parameters
    ----------
    job : str
        JSON: ``name``, ``measured``, ``path``, ``folder`` and ``request``.

    Returns
    -------
    str
        JSON: ``result``, the content of the axis's file, and ``cost``: ``seconds``, ``cpu_seconds``, ``memory`` [MiB]
        after it, ``largest`` memory during it.
    """
    keeper = getattr(_mine, "keeper", None)
    if keeper is None:
        keeper = _mine.keeper = Keeper()
    return json.dumps(keeper.run(json.loads(job)))


@contextmanager
def keepers() -> Iterator[Callable[[], None]]:
    """Yield what ends all processes of this one at once; they end with the block too, and their work is lost."""
    _closing.clear()
    try:
        yield _close_all
    finally:
        _close_all()


def _close_all() -> None:
    _closing.set()
    for keeper in list(_all):
        keeper.close()


@final
class Keeper:
    """Owner of one process that studies axes."""

    def __init__(self) -> None:
        self._child: subprocess.Popen[bytes] | None = None
        _all.add(self)

    def run(self, job: Mapping[str, Any]) -> dict[str, Any]:
        """Return result and cost of one axis; if its process has to be ended, or ends, a result that says so."""
        began = time.monotonic()
        for _ in range(TRIES):
            watch = _Watch(self._ready(), job["request"])
            if _closing.is_set():
                self.close()
            answer = self._ask(job, watch)
            if answer is not None:
                cost = {"seconds": time.monotonic() - began, "largest": watch.largest, **answer["cost"]}
                if answer["cost"]["memory"] > LARGE_PROCESS:
                    self.close()
                return {"result": answer["result"], "cost": cost}
            code = self._ended()
            if _closing.is_set():
                raise InterruptedError("the fleet is closing")
            if watch.why:
                break
        sentence = watch.why or f"The process that studied it ended {TRIES} times ({_how(code)})"
        cost = {"seconds": time.monotonic() - began, "largest": watch.largest, "cpu_seconds": None, "memory": None}
        return {"result": stopped(job, sentence), "cost": cost}

    def close(self) -> None:
        """End the process, with all that it began."""
        child = self._child
        if child is not None:
            _kill(child)

    def _ready(self) -> subprocess.Popen[bytes]:
        """Return the process, a new one where there is none."""
        if self._child is None or self._child.poll() is not None:
            self._ended()
            self._child = _started()
        return self._child

    def _ask(self, job: Mapping[str, Any], watch: _Watch) -> dict[str, Any] | None:
        """Return the process's answer; None where it ended first."""
        child = watch.child
        assert child.stdin is not None and child.stdout is not None  # noqa: S101, PT018 - both are pipes
        with watch:
            try:
                child.stdin.write(json.dumps(job).encode() + b"\n")
                child.stdin.flush()
                line = child.stdout.readline()
            except (OSError, ValueError):
                return None
        if watch.why or not line.endswith(b"\n"):
            return None
        answer: dict[str, Any] = json.loads(line)
        return answer

    def _ended(self) -> int | None:
        """Return how the process ended, and forget it."""
        child, self._child = self._child, None
        if child is None:
            return None
        _kill(child)
        code = child.wait()
        for stream in (child.stdin, child.stdout):
            with suppress(OSError, ValueError):
                if stream is not None:
                    stream.close()
        return code

    def __del__(self) -> None:
        self._ended()


@final
class _Watch:
    """A look at a process every fifth of a second while it works on one axis."""

    def __init__(self, child: subprocess.Popen[bytes], request: Mapping[str, Any]) -> None:
        self.child = child
        self.why = ""
        self.largest = 0.0
        self._time, self._memory = request["time_limit"], request["memory_limit"]
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._thread.join()

    def _look(self) -> None:
        began = time.monotonic()
        while not self._done.wait(LOOK_INTERVAL):
            memory = memory_of(self.child.pid) or 0.0
            self.largest = max(self.largest, memory)
            if memory > self._memory:
                self.why = f"It needs more than the memory limit of {self._memory:g} MiB"
            elif time.monotonic() - began > self._time:
                self.why = f"It takes longer than the time limit of {self._time:g} s"
            if self.why:
                _kill(self.child)
                return


def _started() -> subprocess.Popen[bytes]:
    root = str(Path(__file__).parents[2])
    return subprocess.Popen(
        [sys.executable, "-P", "-c", _START.format(root=root), str(os.getpid())],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=None if os.environ.get("SERVOLENS_DEBUG") else subprocess.DEVNULL,
        env={**os.environ, **dict.fromkeys(SINGLE, "1"), ARENAS: os.environ.get(ARENAS, "2")},
        start_new_session=True,  # an interruption from the keyboard is the parent's business
    )


def _kill(child: subprocess.Popen[bytes]) -> None:
    """End a process and those that it began."""
    if child.returncode is not None:
        return  # its number may be another's by now
    with suppress(OSError):
        if hasattr(os, "killpg"):
            os.killpg(child.pid, signal.SIGKILL)
        else:
            child.kill()


def _how(code: int | None) -> str:
    if code is not None and code < 0:
        return f"signal {-code}: ended by the system or by somebody" if code == -9 else f"signal {-code}: it crashed"
    return f"exit status {code}"
