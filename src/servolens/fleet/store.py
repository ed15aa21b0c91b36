"""The folder that a fleet's results go to: one writer at a time, whole files only."""

from __future__ import annotations

import json
import os
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, final

from servolens.errors import InputError
from servolens.fleet.axes import MARK_FILE, inputs_digest
from servolens.fleet.axis_page import axis_content
from servolens.fleet.axis_study import KIND
from servolens.fleet.rows import row_of
from servolens.reading.files import printable
from servolens.results import to_text, write_atomically

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from servolens.fleet.axes import Axis
    from servolens.fleet.request import Request

__all__ = ["Store", "opened_store"]

RESULTS, PAGES_FOLDER, LOG = "results", "axes", "log.jsonl"
TRIED_AGAIN = "stopped"
STATUSES = ("done", "refused", "failed", TRIED_AGAIN)


@contextmanager
def opened_store(folder: Path) -> Iterator[Store]:
    """Create a folder where it is missing and yield it as a store that nobody else writes to.

    A process that ends, however it does, leaves the folder free and its results whole.

    Raises
    ------
    InputError
        If the folder cannot be written, or another run writes there.
    """
    with _writable(folder):
        for part in (folder, folder / RESULTS, folder / PAGES_FOLDER):
            part.mkdir(parents=True, exist_ok=True)
        lock = (folder / MARK_FILE).open("a+", encoding="ascii")
    with lock:
        _lock(lock, folder)
        store = Store(folder)
        with _writable(folder):
            lock.truncate(0)
            lock.write(f"{os.getpid()}\n")
            lock.flush()
            store.sweep()
        yield store


@final
class Store:
    """Results of a fleet on disk.

    Parameters
    ----------
    folder : Path
        Where they are.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def sweep(self) -> None:
        """Remove what ended processes left half-written."""
        for part in (self.folder, self.folder / RESULTS, self.folder / PAGES_FOLDER):
            for left in part.glob(".*.part"):
                left.unlink()

    def path(self, axis: Axis) -> Path:
        """Return the result file of an axis."""
        return self.folder / RESULTS / f"{axis.key}.json"

    def page(self, axis: Axis) -> Path:
        """Return the page of an axis."""
        return self.folder / PAGES_FOLDER / f"{axis.key}.html"

    def read(self, axis: Axis) -> dict[str, Any] | None:
        """Return the result of an axis; None where there is none, or no whole one."""
        try:
            found = json.loads(self.path(axis).read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            return None
        if not isinstance(found, dict) or found.get("schema") != f"servolens.{KIND}/1":
            return None
        is_its_own = (found.get("axis"), found.get("measured")) == (axis.name, axis.measured or None)
        return found if is_its_own and _is_whole(found) else None

    def finished(self, axis: Axis, request: Request, *, retry: bool) -> dict[str, Any] | None:
        """Return the result of an axis that need not be studied again.

        None where the request, the version or the files of the axis are others, where an axis that was ended at its
        limits has others now, or, with `retry`, where the axis failed.
        """
        found = self.read(axis)
        if found is None or found.get("request") != request.digest or (retry and found["status"] != "done"):
            return None
        if found["status"] == TRIED_AGAIN and found.get("limits") != request.limits:
            return None
        root = None if request.data_root is None else Path(request.data_root)
        return found if found.get("inputs") == inputs_digest(axis.path, root) else None

    def write(self, axis: Axis, result: Mapping[str, Any], cost: Mapping[str, Any]) -> None:
        """Keep the result of an axis, on disk before this returns, and add its cost to the log.

        Raises
        ------
        InputError
            If it cannot be written.
        """
        write_atomically(self.path(axis), _bytes(result), durable=True)
        line = {"axis": axis.key, "status": result["status"], "created": result["created"], **cost}
        with _writable(self.folder / LOG), (self.folder / LOG).open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(line) + "\n")


def _is_whole(found: Mapping[str, Any]) -> bool:
    """Tell whether a row and a page can be made of a result; somebody may have changed it."""
    try:
        row_of(found)
        axis_content(found)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
        return False
    return found["status"] in STATUSES


def _bytes(result: Mapping[str, Any]) -> bytes:
    return to_text(dict(result)).encode("utf-8", "backslashreplace")


@contextmanager
def _writable(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        reason = (error.strerror or "unknown error").lower()
        raise InputError(f"{printable(str(path))}: cannot be written ({reason})") from None


def _lock(stream: IO[str], folder: Path) -> None:
    """Take the lock that ends with this process."""
    try:
        _take(stream)
    except BlockingIOError:
        stream.seek(0)
        holder = stream.read(20).strip()
        who = f" (process {holder})" if holder.isdigit() else ""
        raise InputError(
            f"{printable(str(folder))}: another run{who} is writing here; wait for it, or choose another --out"
        ) from None
    except OSError as error:
        reason = (error.strerror or "unknown error").lower()
        raise InputError(f"{printable(str(folder))}: cannot be locked ({reason}); choose a local disk") from None


def _take(stream: IO[str]) -> None:
    try:
        import fcntl
    except ImportError:
        import msvcrt

        stream.seek(0)
        with suppress(PermissionError):
            msvcrt.locking(stream.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined] # Windows only
            return
        raise BlockingIOError from None
    fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
