"""Result files: JSON in UTF-8 with the same header, finite numbers only, never half written."""

from __future__ import annotations

import json
import math
import os
import shutil
import sys
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servolens import __version__
from servolens.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from servolens.findings import Finding

__all__ = [
    "STANDARD_OUTPUT", "check_writable", "copy_atomically", "envelope", "to_finite", "to_text", "with_reasons",
    "write_atomically", "write_json",
]  # fmt: skip

STANDARD_OUTPUT = "-"


def write_json(path: Path | str, kind: str, body: Mapping[str, Any], findings: Iterable[Finding] = ()) -> None:
    """Write a result of schema ``servolens.<kind>/1``, whole or not at all.

    Parameters
    ----------
    path : Path or str
        The file; ``"-"`` is standard output.
    kind : str
        ``"model"``, ``"identification"``, ``"design"`` …
    body : mapping
        The result's own fields.
    findings : iterable of Finding
        Warnings and notes, each told once.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    content = to_text(envelope(kind, body, findings)).encode("utf-8", "backslashreplace")
    if str(path) == STANDARD_OUTPUT:
        sys.stdout.flush()
        sys.stdout.buffer.write(content)
        sys.stdout.flush()
        return
    write_atomically(Path(path), content)


def envelope(kind: str, body: Mapping[str, Any], findings: Iterable[Finding] = ()) -> dict[str, Any]:
    """Return `body` with the header that every result has.

    Examples
    --------
    >>> envelope("design", {"kd": 3.79})["schema"]
    'servolens.design/1'
    """
    told = {(f.code, f.severity, f.message, f.record): f.to_json() for f in findings}
    header = {
        "schema": f"servolens.{kind}/1",
        "servolens": __version__,
        "created": datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z"),
        "findings": list(told.values()),
    }
    return {**header, **{name: value for name, value in body.items() if name not in header}}


def to_text(value: Any) -> str:
    """Return `value` as JSON text with finite numbers only; ends with a newline."""
    return json.dumps(to_finite(value), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def to_finite(value: Any) -> Any:
    """Return `value` as JSON knows it: arrays as lists, numbers that are not finite as null beside their reason.

    Examples
    --------
    >>> to_finite({"percent_error": float("nan")})
    {'percent_error': None, 'reason': 'percent_error is not a finite number'}
    """
    if isinstance(value, dict):
        result = {str(name): to_finite(item) for name, item in value.items()}
        lost = [str(name) for name, item in value.items() if _is_lost(item)]
        if lost and not result.get("reason"):
            result["reason"] = f"{', '.join(lost)} {'is' if len(lost) == 1 else 'are'} not a finite number"
        return result
    if isinstance(value, list | tuple):
        return [to_finite(item) for item in value]
    if isinstance(value, str | bool | int) or value is None:
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if hasattr(value, "tolist"):  # NumPy's arrays and scalars
        return to_finite(value.tolist())
    raise TypeError(f"{type(value).__name__} has no place in a result")


def with_reasons(fields: dict[str, Any], reasons: Mapping[str, str]) -> dict[str, Any]:
    """Return `fields` with a ``reason`` that says of each that is null why it is.

    Parameters
    ----------
    fields : dict
        Of an object of a result.
    reasons : mapping of str to str
        By the name of a field; those that are not null, or are not there, need none.

    Examples
    --------
    >>> with_reasons({"noise": None}, {"noise": "not estimated"})
    {'noise': None, 'reason': 'noise: not estimated'}
    """
    told = [f"{name}: {why}" for name, why in reasons.items() if fields.get(name, why) is None]
    if not told:
        return fields
    return {**fields, "reason": "; ".join([*([fields["reason"]] if fields.get("reason") else []), *told])}


def check_writable(path: Path) -> None:
    """Refuse, before anything is computed for it, a file that cannot be written.

    Raises
    ------
    InputError
        If its folder does not exist, or file or folder must not be written.
    """
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist; create it first")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise InputError(f"{path}: cannot be written (permission denied)")


def write_atomically(path: Path, content: bytes, *, durable: bool = False) -> None:
    """Write `content` beside `path` and move it there, so that no reader ever sees half of it.

    Parameters
    ----------
    path : Path
        The file.
    content : bytes
        All of it.
    durable : bool
        Whether to wait until the disk has it, so that it survives a loss of power.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    target = Path(os.path.realpath(path))
    if _is_device(target):
        with _told(path):
            target.write_bytes(content)  # a device such as /dev/null has no other place
        return
    with _part_of(path, target) as part:
        _write(part, content, durable=durable)


def copy_atomically(source: Path, path: Path) -> None:
    """Copy a file to `path` so that no reader ever sees half of it.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    with _part_of(path, Path(os.path.realpath(path))) as part:
        shutil.copyfile(source, part)


def _is_device(target: Path) -> bool:
    try:
        return target.exists() and not target.is_file()
    except OSError:
        return False  # told where it is written


@contextmanager
def _part_of(path: Path, target: Path) -> Iterator[Path]:
    """Yield a file beside `target` that takes its place where all went well, and is gone where not."""
    part = target.with_name(f".{target.name[:100]}.{os.getpid()}.part")
    with _told(path):
        try:
            yield part
            part.replace(target)
        except BaseException:
            with suppress(OSError):
                part.unlink()
            raise


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """Refuse by the name of the file that cannot be written."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({(error.strerror or 'unknown error').lower()})") from None


def _write(path: Path, content: bytes, *, durable: bool) -> None:
    path.write_bytes(content)
    if durable:
        with path.open("rb+") as stream:
            os.fsync(stream.fileno())


def _is_lost(value: Any) -> bool:
    """Tell whether a number in `value`, itself or in lists, is not finite."""
    if isinstance(value, float):
        return not math.isfinite(value)
    if isinstance(value, list | tuple):
        return any(_is_lost(item) for item in value)
    return _is_lost(value.tolist()) if hasattr(value, "tolist") else False
