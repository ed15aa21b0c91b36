"""The machine's processors: simulations side by side, and linear algebra that leaves them to these."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import wait as all_done
from contextlib import closing, contextmanager, suppress
from functools import cache, wraps
from math import prod
from mmap import mmap
from multiprocessing import Pipe
from multiprocessing.connection import wait
from pathlib import Path
from threading import Lock, current_thread, local, main_thread
from time import monotonic
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar, final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from multiprocessing.connection import Connection

    from numpy.typing import NDArray
    from threadpoolctl import ThreadpoolController

__all__ = [
    "PROCESSORS",
    "Tally",
    "die_with_parent",
    "in_parallel",
    "in_processes",
    "shared_array",
    "single_threaded_blas",
]

PROCESSORS = "SERVOLENS_PROCESSORS"
"""Environment variable: how many processors one process uses; all of the machine's where it is not set."""

PATIENCE = 5.0
"""Time [s] without any work after which another process is taken to hang: its jobs are done here."""
PR_SET_PDEATHSIG = 1
"""Of Linux: sets the signal that a process gets when its parent ends."""
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
    """Return an array into which jobs write wherever they run: what is written need not be sent.

    Raises
    ------
    MemoryError
        If there is no room for it.
    """
    size = prod(shape)
    try:
        return np.frombuffer(mmap(-1, max(8 * size, 1)), np.float64, size).reshape(shape)
    except OSError as failure:
        raise MemoryError(f"no room for an array of {8 * size} bytes") from failure


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
        Told how many jobs are done, as often as that changes; from any thread.
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
    order = sorted(range(len(jobs)), key=lambda i: -cost(jobs[i]))
    return _Batch(function, jobs, tally or Tally(), told).answers(min(_free(), len(jobs)) - 1, order)


@final
class _Batch:
    """Jobs that are shared among copies of this process: each takes the next one that is left.

    Numbers of jobs stand in a pipe, from which each reads one at a time; answers come back through a pipe of each copy.
    A job that fails in a copy, or whose answer is lost with it, is done again here.
    """

    def __init__(
        self, function: Callable[[Any], Any], jobs: Sequence[Any], tally: Tally, told: Callable[[int], None]
    ) -> None:
        self._function, self._jobs, self._tally, self._told = function, jobs, tally, told
        self._answers: dict[int, Any] = {}

    def answers(self, copies: int, order: Sequence[int]) -> list[Any]:
        """Return the answers of all jobs as they stand, begun in this order, or raise the first one's error."""
        with suppress(OSError), closing(_Numbers(order)) as left, self._copies(copies, left) as connections:
            for i in left:
                with suppress(Exception):
                    self._keep(i, self._done(i))
                self._read(connections)
            self._wait(connections)
        for i in range(len(self._jobs)):
            if i not in self._answers:
                self._keep(i, self._done(i))
        return [self._answers[i] for i in range(len(self._jobs))]

    def _done(self, i: int) -> Any:
        with _busy():
            return self._function(self._jobs[i])

    def _keep(self, i: int, answer: Any) -> None:
        self._answers[i] = answer
        self._told(len(self._answers))

    def _read(self, connections: dict[Connection, int], seconds: float = 0.0) -> bool:
        """Take up answers that have come, or come within so many seconds; tell whether there were any."""
        ready = [one for one in wait([*connections], seconds) if one in connections]
        for connection in ready:
            try:
                i, answer, added = connection.recv()
            except (EOFError, OSError):  # it has ended, perhaps amid an answer
                del connections[connection]
            else:
                self._tally.add(added)
                self._keep(i, answer)
        return bool(ready)

    def _wait(self, connections: dict[Connection, int]) -> None:
        """Take up answers as long as copies work."""
        worked, since = 0.0, monotonic()
        while connections and monotonic() - since < PATIENCE:
            before, worked = worked, sum(map(_worked, connections.values()))
            if self._read(connections, 1.0) or worked > before:
                since = monotonic()

    @contextmanager
    def _copies(self, count: int, left: _Numbers) -> Iterator[dict[Connection, int]]:
        """Yield connections to so many copies of this process and their numbers; fewer where there is no room."""
        found: dict[Connection, int] = {}
        try:
            for _ in range(count):
                with suppress(OSError), _uninterrupted(), warnings.catch_warnings():
                    here, there = Pipe(duplex=False)
                    warnings.simplefilter("ignore", DeprecationWarning)  # a copy has none of this process's threads
                    pid = os.fork()
                    if pid == 0:
                        for other in (here, *found):
                            other.close()
                        self._serve(left, there)
                    found[here] = pid
                    there.close()
            yield dict(found)
        finally:
            for connection, pid in found.items():
                with suppress(ProcessLookupError, ChildProcessError):
                    os.kill(pid, signal.SIGKILL)
                    os.waitpid(pid, 0)
                connection.close()

    def _serve(self, left: _Numbers, answers: Connection) -> None:
        """Do jobs in a copy until none is left; does not return."""
        try:
            die_with_parent()
            for number in signal.valid_signals():  # what the program does about them, it does itself
                if callable(signal.getsignal(number)):
                    signal.signal(number, signal.SIG_IGN if number == signal.SIGINT else signal.SIG_DFL)
            for i in left:
                before = self._tally.value
                with suppress(Exception):
                    answers.send((i, self._done(i), self._tally.value - before))
        finally:
            os._exit(0)


@final
class _Numbers:
    """Numbers in a pipe: each is given once, to whichever process asks first."""

    SIZE = 4
    """Bytes of a number."""

    def __init__(self, numbers: Sequence[int]) -> None:
        self._pipe, there = os.pipe()
        os.write(there, b"".join(i.to_bytes(self.SIZE) for i in numbers))
        os.close(there)

    def __iter__(self) -> Iterator[int]:
        while number := os.read(self._pipe, self.SIZE):
            yield int.from_bytes(number)

    def close(self) -> None:
        """Give the pipe back."""
        os.close(self._pipe)


def die_with_parent() -> None:
    """Let the system end this process when the thread that started it ends; on Linux only."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)


def _worked(pid: int) -> float:
    """Return the processor time of another process, in ticks; 0 where it is gone."""
    with suppress(OSError, IndexError, ValueError):
        return float(sum(map(int, Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13])))
    return 0.0


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Let Ctrl-C wait until the end: what is raised while a process is copied is lost."""
    noted: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: noted.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL if before is None else before)
        if noted:
            signal.raise_signal(signal.SIGINT)


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
