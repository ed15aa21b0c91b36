"""Files as bytes: what may be opened, and how its content may be quoted."""

from __future__ import annotations

import os
import stat
from contextlib import contextmanager
from typing import TYPE_CHECKING, BinaryIO

from servolens.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

__all__ = ["MAX_BYTES", "check_numbers", "is_folder", "located", "printable", "quote", "read_bytes", "read_start"]

MAX_BYTES = 512 * 2**20
"""Largest file that is read [bytes]; about 10 million rows."""
QUOTED = 40


def read_bytes(path: Path, largest: int | None = None) -> bytes:
    """Return the content of a regular file of at most `largest` bytes.

    Raises
    ------
    InputError
        If the path is missing, a folder, a device or a pipe, unreadable, empty or too large.
    """
    limit = MAX_BYTES if largest is None else largest
    with _opened(path, limit) as stream:
        content = _read(stream, limit + 1)
    if len(content) > limit:
        raise InputError(f"is longer than {limit / 2**20:.0f} MiB, the longest file that is read")
    return content


def check_numbers(count: int) -> None:
    """Refuse a file that holds more than so many numbers of eight bytes as are read.

    Raises
    ------
    InputError
        If they are too many.
    """
    if 8 * count > MAX_BYTES:
        raise InputError(f"holds more than {MAX_BYTES / 2**20:.0f} MiB of numbers, the most that is read")


def read_start(path: Path, count: int) -> bytes:
    """Return the first `count` bytes of a regular file of at most the largest size.

    Raises
    ------
    InputError
        As :func:`read_bytes` does.
    """
    with _opened(path, MAX_BYTES) as stream:
        return _read(stream, count)


@contextmanager
def _opened(path: Path, limit: int) -> Iterator[BinaryIO]:
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except IsADirectoryError as error:
        raise InputError("is a folder, not a file") from error
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise InputError(f"cannot be opened: {why.lower()}") from error
    try:
        status = os.fstat(descriptor)
        _check_kind(status.st_mode)
    except InputError:
        os.close(descriptor)
        raise
    with os.fdopen(descriptor, "rb") as stream:
        if status.st_size > limit:
            raise InputError(f"has {status.st_size / 2**20:.0f} MiB; files up to {limit / 2**20:.0f} MiB are read")
        yield stream


def _read(stream: BinaryIO, count: int) -> bytes:
    try:
        content = stream.read(count)
    except OSError as error:
        raise InputError(f"cannot be read: {(error.strerror or str(error)).lower()}") from error
    if not content:
        raise InputError("is empty; check how it was written")
    return content


def is_folder(path: Path) -> bool:
    """Tell whether a path leads to a folder; one that the system does not understand does not."""
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


def quote(text: object) -> str:
    r"""Return text for a message: at most 40 characters, control characters escaped, in quotes.

    Examples
    --------
    >>> print(quote("a" + chr(27) + "b"))
    'a\x1bb'
    """
    whole = str(text)
    shown = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in whole[:QUOTED])
    return f"'{shown}…'" if len(whole) > QUOTED or len(shown) > QUOTED else f"'{shown}'"


@contextmanager
def located(label: str) -> Iterator[None]:
    """Let every refusal inside begin with where it was met."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{printable(label)}: {error}") from error


def printable(text: str) -> str:
    """Return the text with control characters escaped."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def _check_kind(mode: int) -> None:
    if stat.S_ISDIR(mode):
        raise InputError("is a folder, not a file")
    if not stat.S_ISREG(mode):
        raise InputError("is a device or a pipe; records are read from regular files")
