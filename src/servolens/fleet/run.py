"""The studies of a fleet: what is finished stays, what is not is done, and every axis gets its row."""

from __future__ import annotations

import json
import queue
import time
from collections import Counter, deque
from concurrent.futures import CancelledError
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from servolens.errors import InputError, ServolensError
from servolens.fleet.axes import find_axes
from servolens.fleet.axis_study import stopped
from servolens.fleet.executors import local_executor
from servolens.fleet.keeper import study_axis
from servolens.fleet.pages import write_pages
from servolens.fleet.request import Request
from servolens.fleet.result import Fleet
from servolens.fleet.rows import row_of
from servolens.fleet.store import opened_store
from servolens.fleet.tables import write_table

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Iterator, Sequence
    from concurrent.futures import Executor, Future

    from servolens.fleet.axes import Axis
    from servolens.fleet.rows import Row
    from servolens.fleet.store import Store

    Progress = Callable[[str, int, int], None]

__all__ = ["InterruptedRunError", "run_fleet"]

AHEAD = 1000
"""Axes that an executor is given at a time."""
TRIES = 3
"""How often an axis is given to an executor that loses it."""
TICK = 0.5
"""Seconds between two tellings of the progress."""
SEVERAL = 20
"""Axes after which the rate is that of the last ones."""


@final
class InterruptedRunError(ServolensError):
    """The run was interrupted; all finished axes are kept."""

    exit_status = 130


def run_fleet(
    folder: str | os.PathLike[str],
    out: str | os.PathLike[str],
    request: Request | None = None,
    *,
    executor: Executor | None = None,
    cores: int | None = None,
    retry: bool = False,
    plain_table: bool = False,
    progress: Progress = lambda _what, _done, _total: None,
) -> Fleet:
    """Study every axis of a folder, and keep each result as soon as it is there.

    A run that was interrupted, killed or stopped by a full disk goes on where it was: axes with a whole result of the
    same request, files and version are not studied again. The results do not depend on the executor, on the number of
    processors or on interruptions.

    Parameters
    ----------
    folder : path
        With a sub-folder or a campaign TOML for each axis, see :func:`~servolens.fleet.find_axes`.
    out : path
        Folder of the results; created if needed. ``results/`` holds a file of schema ``servolens.fleet-axis/1`` for
        each axis, ``log.jsonl`` what each cost; ``fleet.html`` and ``summary.parquet`` or ``summary.csv`` are written
        at the end.
    request : Request, optional
        What study each axis gets, and its limits.
    executor : concurrent.futures.Executor, optional
        Where axes are studied; by default on the processors of this machine. It stays open.
    cores : int, optional
        How many processors of this machine; by default all.
    retry : bool
        Whether axes that failed are studied again.
    plain_table : bool
        Whether the table is CSV even where Parquet is possible.
    progress : callable
        Is told (what, done, total).

    Returns
    -------
    Fleet
        A row for each axis. An axis that cannot be studied is a row with a sentence.

    Raises
    ------
    InputError
        If the folder holds no axis, or `out` cannot be written or is another run's.
    InterruptedRunError
        On KeyboardInterrupt; finished axes are kept.
    """
    source, target, wanted = Path(folder), Path(out), request or Request()
    if source.resolve() == target.resolve():
        raise InputError(f"{out}: the results cannot go to the folder of the axes; name another")
    axes = find_axes(source, leave_out=target)
    with opened_store(target) as store:
        run = _Run(store=store, request=wanted, folder=source.resolve(), total=len(axes), progress=progress)
        waiting = run.unfinished(axes, retry=retry)
        try:
            if waiting and executor is not None:
                run.go(executor, waiting)
            elif waiting:
                with local_executor(cores if cores is None else min(cores, max(len(waiting), 1))) as own:
                    run.go(own, waiting)
            rows = tuple(run.rows[axis.key] for axis in axes)
            found = Fleet(folder=source, out=target, axes=axes, rows=rows, studied_now=len(waiting))
            write_table(found, plain=plain_table)
            write_pages(found, progress=progress)
        except KeyboardInterrupt:
            raise InterruptedRunError(
                f"interrupted; {len(run.rows)} of {len(axes)} axes are finished and kept: run the same command to go on"
            ) from None
        return found


@final
@dataclass(kw_only=True)
class _Run:
    """What has been done so far."""

    store: Store
    request: Request
    folder: Path
    total: int
    progress: Progress
    rows: dict[str, Row] = field(default_factory=dict)
    finished: queue.SimpleQueue[tuple[Axis, Future[str]]] = field(default_factory=queue.SimpleQueue)
    lost: Counter[str] = field(default_factory=Counter)
    times: deque[float] = field(default_factory=lambda: deque(maxlen=SEVERAL))

    def unfinished(self, axes: Sequence[Axis], *, retry: bool) -> list[Axis]:
        """Take over what earlier runs finished, and return the others."""
        waiting = []
        for done, axis in enumerate(axes):
            self.progress("Looking for finished axes", done, self.total)
            found = self.store.finished(axis, self.request, retry=retry)
            if found is None:
                waiting.append(axis)
            else:
                self.rows[axis.key] = row_of(found)
        return waiting

    def go(self, executor: Executor, waiting: Sequence[Axis]) -> None:
        """Study axes on an executor until each has a result."""
        coming = iter(waiting)
        out: dict[str, Future[str]] = {}
        self.times.append(time.monotonic())
        try:
            self._give(executor, coming, out)
            while out:
                self.progress(self._told(), len(self.rows), self.total)
                try:
                    axis, future = self.finished.get(timeout=TICK)
                except queue.Empty:
                    continue
                del out[axis.key]
                if not self._take(axis, future):
                    out[axis.key] = self._submitted(executor, axis)
                self._give(executor, coming, out)
        finally:
            for future in out.values():
                future.cancel()

    def _give(self, executor: Executor, coming: Iterator[Axis], out: dict[str, Future[str]]) -> None:
        while len(out) < AHEAD and (axis := next(coming, None)) is not None:
            out[axis.key] = self._submitted(executor, axis)

    def _submitted(self, executor: Executor, axis: Axis) -> Future[str]:
        try:
            future = executor.submit(study_axis, json.dumps(self._job(axis)))
        except Exception as error:
            raise InputError(
                f"the executor takes no more work ({type(error).__name__}: {str(error)[:80]}); {len(self.rows)} of"
                f" {self.total} axes are finished and kept: run the same command to go on"
            ) from error
        future.add_done_callback(lambda done: self.finished.put((axis, done)))
        return future

    def _take(self, axis: Axis, future: Future[str]) -> bool:
        """Keep the result of an axis; false where the executor lost it and it is to be tried again."""
        try:
            answer = json.loads(future.result())
        except (CancelledError, Exception) as error:  # of a foreign executor, whatever it is
            self.lost[axis.key] += 1
            if self.lost[axis.key] < TRIES:
                return False
            why = f"The executor lost it {TRIES} times ({type(error).__name__})"
            answer = {"result": stopped(self._job(axis), why), "cost": {}}
        self.store.write(axis, answer["result"], answer["cost"])
        self.rows[axis.key] = row_of(answer["result"])
        self.times.append(time.monotonic())
        return True

    def _job(self, axis: Axis) -> dict[str, Any]:
        return {
            "name": axis.name,
            "measured": axis.measured,
            "path": str(axis.path.resolve() if axis.path.is_symlink() else axis.path.absolute()),
            "folder": str(self.folder),
            "request": self.request.to_json(),
        }

    def _told(self) -> str:
        """Return the state in words: count, rate, time left, failures."""
        count = f"{len(self.rows)} of {self.total} axes"
        failed = sum(row["status"] != "done" for row in self.rows.values())
        text = f"{count}, {failed} failed" if failed else count
        if len(self.times) < 2:
            return text
        rate = (len(self.times) - 1) / max(time.monotonic() - self.times[0], 1e-9)
        return f"{text}, {60 * rate:.3g} a minute, {_duration((self.total - len(self.rows)) / rate)} left"


def _duration(seconds: float) -> str:
    """Return a duration in words.

    Examples
    --------
    >>> _duration(42), _duration(600), _duration(9000), _duration(200000)
    ('42 s', '10 min', '2.5 h', '2.3 days')
    """
    for size, unit in ((86400, "days"), (3600, "h"), (60, "min")):
        if seconds >= 1.5 * size:
            return f"{seconds / size:.2g} {unit}"
    return f"{seconds:.0f} s"
