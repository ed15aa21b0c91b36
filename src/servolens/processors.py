"""The machine's processors: simulations side by side, and linear algebra that leaves them to these."""

from __future__ import annotations

import os
import signal
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import wait as all_done
from contextlib import contextmanager, suppress
from functools import cache, wraps
from math import prod
from mmap import mmap
from multiprocessing import Pipe
from multiprocessing.connection import wait
from threading import Lock, current_thread, local, main_thread
from time import monotonic
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar, final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from multiprocessing.connection import Connection

    from numpy.typing import NDArray
    from threadpoolctl import ThreadpoolController

__all__ = ["PROCESSORS", "Tally", "in_parallel", "in_processes", "shared_array", "single_threaded_blas"]

PROCESSORS = "SERVOLENS_PROCESSORS"
"""Environment variable: how many processors one process uses; all of the machine's where it is not set."""

PATIENCE = 10.0
"""Times as long as this process worked that it waits for an answer of another one: should that hang, its jobs are done
here."""
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
    threads = min(_free(workers), len(jobs))
    if threads <= 1:
        return [function(job) for job in jobs]
    started = [_pool(workers or _allowed()).submit(function, job) for job in jobs]
    all_done(started)  # none goes on where another one fails
    return [one.result() for one in started]


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Return the threads that share the work: to start them anew each time takes as long as a short job."""
    return ThreadPoolExecutor(threads, initializer=_be_busy)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a child has none of its parent's threads


def _be_busy() -> None:
    _WORKING.is_busy = True


def _free(workers: int | None = None) -> int:
    """Return how many processors there are for several jobs: one, where this thread does one of several itself."""
    return 1 if getattr(_WORKING, "is_busy", False) else workers or _allowed()


def _allowed() -> int:
    stated = os.environ.get(PROCESSORS, "")
    return int(stated) if stated.isascii() and stated.isdigit() and int(stated) else os.cpu_count() or 1


@final
class Tally:
    """A number to which jobs add, in whatever thread or process they run."""

    def __init__(self) -> None:
        self.value, self._adding = 0, Lock()

    def add(self, number: int) -> None:
        """Add `number`."""
        with self._adding:
            self.value += number


def shared_array(shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return an array into which jobs write wherever they run: what is written need not be sent."""
    size = prod(shape)
    return np.frombuffer(mmap(-1, max(8 * size, 1)), np.float64, size).reshape(shape)


def in_processes(
    function: Callable[[Job], Result],
    jobs: Iterable[Job],
    tally: Tally | None = None,
    cost: Callable[[Job], float] = lambda _: 0.0,
    told: Callable[[int], None] = lambda _: None,
) -> list[Result]:
    """Return what `function` makes of each of the `jobs`, in their order, with a process for each processor.

    For jobs with much Python in them, of which only one thread at a time can run. The other processes are copies of
    this one, so that they know all that it knows; of what a job does there only its answer comes back, and what it adds
    to the `tally`. Only Linux copies a process safely, and only from its main thread; elsewhere there are threads.

    Parameters
    ----------
    function : callable
        Makes an answer, which can be pickled, of a job.
    jobs : iterable
        What is done.
    tally : Tally, optional
        To which jobs add.
    cost : callable, optional
        Of a job, how long it takes beside the others: what takes longest is begun first. As they stand by default.
    told : callable, optional
        Told in this thread how many jobs are done, as often as that changes.
    """
    jobs = list(jobs)
    if sys.platform != "linux" or current_thread() is not main_thread() or min(_free(), len(jobs)) <= 1:
        count = Tally()

        def one(job: Job) -> Result:
            answer = function(job)
            count.add(1)
            told(count.value)
            return answer

        return in_parallel(one, jobs)
    batch = _Batch(function, jobs, tally or Tally(), told)
    return batch.answers(min(_free(), len(jobs)) - 1, sorted(range(len(jobs)), key=lambda i: -cost(jobs[i])))


@final
class _Batch:
    """Jobs that are shared among copies of this process: each takes the next one that is left.

    Numbers of jobs stand in a pipe, from which each reads one at a time; answers come back through a pipe of each copy.
    """

    NUMBER = 4
    """Bytes of a job's number."""

    def __init__(
        self, function: Callable[[Any], Any], jobs: Sequence[Any], tally: Tally, told: Callable[[int], None]
    ) -> None:
        self._function, self._jobs, self._tally, self._told = function, jobs, tally, told
        self._answers: dict[int, tuple[Any, BaseException | None]] = {}
        self._began, self._parent = monotonic(), os.getpid()
        self._left, self._numbers_in = os.pipe()

    def answers(self, copies: int, order: Sequence[int]) -> list[Any]:
        """Return the answers of all jobs as they stand, begun in this order, or raise the first one's error."""
        os.write(self._numbers_in, b"".join(i.to_bytes(self.NUMBER) for i in order))
        os.close(self._numbers_in)
        with self._copies(copies) as connections:
            for i in self._numbers():
                self._keep(i, *self._tried(i))
                self._read(connections, 0.0)
            self._read(connections, PATIENCE * (monotonic() - self._began))
        for i in range(len(self._jobs)):
            if i not in self._answers:
                self._keep(i, *self._tried(i))
        found = [self._answers[i] for i in range(len(self._jobs))]
        error = next((error for _, error in found if error), None)
        if error:
            raise error
        return [answer for answer, _ in found]

    def _numbers(self) -> Iterator[int]:
        while number := os.read(self._left, self.NUMBER):
            yield int.from_bytes(number)

    def _tried(self, i: int) -> tuple[Any, BaseException | None]:
        try:
            with _busy():
                return self._function(self._jobs[i]), None
        except Exception as error:
            return None, error

    def _keep(self, i: int, answer: Any, error: BaseException | None) -> None:
        self._answers[i] = answer, error
        self._told(len(self._answers))

    def _read(self, connections: list[Connection], seconds: float) -> None:
        """Take up answers that have come, and those that come within so many seconds of each other."""
        while connections and (ready := wait(connections, seconds)):
            for connection in [one for one in connections if one in ready]:
                try:
                    i, answer, error, added = connection.recv()
                except EOFError:
                    connections.remove(connection)
                else:
                    self._tally.add(added)
                    self._keep(i, answer, error)

    @contextmanager
    def _copies(self, count: int) -> Iterator[list[Connection]]:
        """Yield a connection to each of so many copies of this process, fewer where there is no room for them."""
        pids, connections = [], []
        try:
            for _ in range(count):
                here, there = Pipe(duplex=False)
                with suppress(OSError), warnings.catch_warnings():
                    warnings.simplefilter("ignore", DeprecationWarning)  # a copy has none of this process's threads
                    pid = os.fork()
                    if pid == 0:
                        self._serve(there)
                    pids.append(pid)
                    connections.append(here)
                there.close()
            yield [*connections]
        finally:
            os.close(self._left)
            for pid in pids:
                with suppress(ProcessLookupError, ChildProcessError):
                    os.kill(pid, signal.SIGKILL)
                    os.waitpid(pid, 0)
            for connection in connections:
                connection.close()

    def _serve(self, answers: Connection) -> None:
        """Do jobs in a copy, until none is left or nobody waits for their answers; does not return."""
        try:
            for i in self._numbers():
                before = self._tally.value
                answer, error = self._tried(i)
                if os.getppid() != self._parent:
                    break
                answers.send((i, answer, error, self._tally.value - before))
        finally:
            os._exit(0)


@contextmanager
def _busy() -> Iterator[None]:
    """Let this thread do one of several jobs, which has no processors to share."""
    was, _WORKING.is_busy = getattr(_WORKING, "is_busy", False), True
    try:
        yield
    finally:
        _WORKING.is_busy = was


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
