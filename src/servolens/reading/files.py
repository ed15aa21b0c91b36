"""Files as bytes: what may be opened, what a file is, and how its content may be quoted."""

from __future__ import annotations

import os
import stat
from contextlib import contextmanager
from typing import TYPE_CHECKING

from servolens.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

__all__ = ["LARGEST", "located", "name_format", "printable", "quote", "read_bytes"]

LARGEST = 512 * 2**20
"""Largest file that is read [bytes]; about 10 million rows."""
QUOTED = 40
_MAGIC = (
    (b"PAR1", "Parquet"),
    (b"TDSm", "TDMS (LabVIEW)"),
    (b"MDF     4", "MDF4 (ASAM measurement data)"),
    (b"MDF     3", "MDF3 (ASAM measurement data)"),
    (b"\x89HDF\r\n\x1a\n", "HDF5"),
    (b"PK\x03\x04", "ZIP (perhaps an Excel workbook)"),
    (b"\x1f\x8b", "gzip"),
)
_MAT5 = (b"\x00\x01IM", b"\x01\x00MI")
_MAT73 = (b"\x00\x02IM", b"\x02\x00MI")
_UTF16 = (b"\xff\xfe", b"\xfe\xff")


def read_bytes(path: Path, largest: int | None = None) -> bytes:
    """Return the content of a regular file of at most `largest` bytes.

    Raises
    ------
    InputError
        If the path is missing, a folder, a device or a pipe, unreadable, empty or too large.
    """
    limit = LARGEST if largest is None else largest
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
        try:
            content = stream.read(limit + 1)
        except OSError as error:
            raise InputError(f"cannot be read: {(error.strerror or str(error)).lower()}") from error
    if not content:
        raise InputError("is empty; check how it was written")
    if len(content) > limit:
        raise InputError(f"is longer than {limit / 2**20:.0f} MiB, the longest file that is read")
    return content


def name_format(content: bytes, suffix: str) -> str:
    """Return ``"mat"`` or ``"text"``, whatever the file's name says.

    Raises
    ------
    InputError
        If the content is of a known kind that is not read, named in the message.
    """
    version = content[124:128]
    if content.startswith(b"MATLAB 7.3") or version in _MAT73:
        raise InputError("is MAT v7.3 (HDF5), which is not read yet; save it with -v7 in MATLAB")
    for magic, kind in _MAGIC:
        if content.startswith(magic):
            raise InputError(f"is {kind}, which is not read yet; export it as CSV")
    if version in _MAT5:
        return "mat"
    if suffix.lower() == ".mat":
        raise InputError("is not a MAT v5 file (version 4, or damaged); save it with -v7 in MATLAB")
    if content.startswith(_UTF16):
        raise InputError("is UTF-16 text; save it as UTF-8")
    if b"\0" in content:
        raise InputError("is a binary file of an unknown kind; CSV and MAT v5 are read")
    return "text"


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
