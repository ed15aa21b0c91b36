"""The machine's processors: simulations side by side, and linear algebra that leaves them to these."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache, wraps
from threading import local
from typing import TYPE_CHECKING, ParamSpec, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from threadpoolctl import ThreadpoolController

__all__ = ["PROCESSORS", "in_parallel", "single_threaded_blas"]

PROCESSORS = "SERVOLENS_PROCESSORS"
"""Environment variable: how many processors one process uses; all of the machine's where it is not set."""

_WORKING = local()
"""Of a thread: whether it does one of several jobs, and shall not share that in turn."""

Job = TypeVar("Job")
Result = TypeVar("Result")
Arguments = ParamSpec("Arguments")


def in_parallel(function: Callable[[Job], Result], jobs: Iterable[Job], workers: int | None = None) -> list[Result]:
    """Return what `function` makes of each of the `jobs`, in their order, with a thread for each processor.

    The compiled simulation leaves Python free meanwhile. A job that has jobs of its own does them one after the other:
    more threads than processors only wait for each other.
    """
    jobs = list(jobs)
    threads = 1 if getattr(_WORKING, "is_busy", False) else min(workers or _allowed(), len(jobs))
    if threads <= 1:
        return [function(job) for job in jobs]
    started = [_pool(workers or _allowed()).submit(function, job) for job in jobs]
    wait(started)  # none goes on where another one fails
    return [one.result() for one in started]


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Return the threads that share the work: to start them anew each time takes as long as a short job."""
    return ThreadPoolExecutor(threads, initializer=_be_busy)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a child has none of its parent's threads


def _be_busy() -> None:
    _WORKING.is_busy = True


def _allowed() -> int:
    stated = os.environ.get(PROCESSORS, "")
    return int(stated) if stated.isascii() and stated.isdigit() and int(stated) else os.cpu_count() or 1


def single_threaded_blas(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Let linear algebra within `function` run on one processor.

    Its matrices are long and narrow: threads of its own wait for each other, and for those of :func:`in_parallel`.
    """

    @wraps(function)
    def limited(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        with _libraries().limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited


@cache
def _libraries() -> ThreadpoolController:
    import scipy.linalg  # noqa: F401 - a controller knows the libraries that are loaded when it is made
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
