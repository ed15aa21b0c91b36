"""JSON back into values: a frozen dataclass tells by its annotations what its fields are."""

from __future__ import annotations

import json
import math
import os
import sys
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from servolens.errors import InputError
from servolens.findings import Finding

__all__ = [
    "decoded", "encoded", "fields_of", "findings_in", "json_of", "listed", "part", "read_fields", "read_json", "whole",
]  # fmt: skip

T = TypeVar("T")
NOUNS = {list: "a list", dict: "an object", str: "a text", bool: "true or false", int: "a whole number"}
"""What types are called in refusals."""


def json_of(source: Mapping[str, Any] | str | os.PathLike[str]) -> Mapping[str, Any]:
    """Return the JSON object that `source` is, that it holds as a text, or that its file holds.

    Raises
    ------
    InputError
        If the file cannot be read or holds none.
    """
    if isinstance(source, Mapping):
        return source
    if not isinstance(source, str | os.PathLike):
        raise InputError(f"what to_json returned, or a file's path, is needed; got {type(source).__name__}")
    is_text = isinstance(source, str) and source.lstrip().startswith("{")
    label = "the text" if is_text else os.fspath(source)
    try:
        data = _parsed(str(source), "") if is_text else read_json(Path(source))
    except InputError as error:
        raise InputError(f"{label}: {error}") from None
    if not isinstance(data, dict):
        raise InputError(f"{label}: holds no JSON object")
    return data


def read_json(path: Path, needed: str = "") -> Any:
    """Return what a JSON file holds.

    Parameters
    ----------
    path : Path
        The file.
    needed : str
        What a refusal says of the file that is needed.

    Raises
    ------
    InputError
        If it is no file, cannot be read, is not JSON, or names a field twice.
    """
    try:
        if path.exists() and not path.is_file():
            raise InputError(f"is a folder or a device{needed}")
        text = path.read_text(encoding="utf-8-sig")  # Windows' editors begin with its mark
    except OSError as error:
        raise InputError(f"cannot be read ({(error.strerror or 'unknown error').lower()})") from None
    except UnicodeError:
        raise InputError(f"is not JSON{needed}") from None
    return _parsed(text, needed)


def _parsed(text: str, needed: str) -> Any:
    try:
        return json.loads(text, object_pairs_hook=_named_once)
    except InputError:
        raise
    except (ValueError, RecursionError):
        raise InputError(f"is not JSON{needed}") from None


def _named_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    names = [name for name, _ in pairs]
    twice = next((name for i, name in enumerate(names) if name in names[:i]), None)
    if twice is not None:
        raise InputError(f"names {twice[:40]!r} twice in one object; keep one")
    return dict(pairs)


@contextmanager
def whole(told: str) -> Iterator[None]:
    """Refuse data of another form than what is read within.

    Parameters
    ----------
    told : str
        How the refusal begins, e.g. "not a whole diagnosis".

    Raises
    ------
    InputError
        That says which field is missing, or that one has the wrong type.

    Examples
    --------
    >>> with whole("not a whole law"):
    ...     {"gain": 1.9}["damping"]
    Traceback (most recent call last):
    servolens.errors.InputError: not a whole law: 'damping' is missing
    """
    try:
        yield
    except InputError:
        raise
    except KeyError as error:
        raise InputError(f"{told}: {str(error.args[0])[:40]!r} is missing") from None
    except (TypeError, AttributeError, ValueError, IndexError, OverflowError):
        raise InputError(f"{told}: a field has the wrong type") from None


def encoded(value: Any) -> Any:
    """Return a value, with the dataclasses, arrays and mappings in it, as JSON holds it: :func:`read_fields` inverted.

    Numbers that are not finite are null.

    Examples
    --------
    >>> from servolens.record import Controller
    >>> encoded(Controller(kp=60))["kp"], encoded(np.array([1.0, np.nan]))
    (60, [1.0, None])
    """
    if hasattr(value, "to_json"):
        return encoded(value.to_json())
    if is_dataclass(value):
        return {field.name: encoded(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): encoded(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [encoded(one) for one in value]
    if isinstance(value, np.ndarray | np.generic):
        return encoded(value.tolist())
    return None if isinstance(value, float) and not np.isfinite(value) else value


def read_fields(cls: type[T], data: Any, known: Mapping[str, Any] | None = None) -> T:
    """Build the dataclass `cls` from an object with its fields; others are left alone.

    Parameters
    ----------
    cls : type
        A dataclass.
    data : mapping
        As JSON holds it. A number that is null was not finite: it becomes infinite, unless None is admissible; in an
        array it is not a number.
    known : mapping of str to type, optional
        Names in the annotations that its module does not import when it runs.

    Raises
    ------
    InputError
        If a field is missing or has the wrong type.

    Examples
    --------
    >>> from servolens.record import Controller
    >>> read_fields(Controller, {"kp": 60, "derivative": "position"}).kp
    60.0
    """
    return cls(**fields_of(cls, data, [field.name for field in fields(cls)], known))  # type: ignore[arg-type] # a dataclass


def fields_of(cls: type, data: Any, names: Sequence[str], known: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the named fields of the dataclass `cls` from an object; see :func:`read_fields`."""
    if not isinstance(data, Mapping):
        raise InputError(f"{cls.__name__} must be an object, got {str(data)[:40]!r}")
    local = {"Mapping": Mapping, "Sequence": Sequence, "NDArray": NDArray, **(known or {})}
    wanted = SimpleNamespace(__annotations__={name: cls.__annotations__[name] for name in names})
    hints = get_type_hints(wanted, globalns=vars(sys.modules[cls.__module__]), localns=local)
    found = {}
    for field in fields(cls):
        if field.name not in names:
            continue
        if field.name in data:
            found[field.name] = decoded(hints[field.name], data[field.name], field.name, local)
        elif field.default is MISSING and field.default_factory is MISSING:
            raise InputError(f"{cls.__name__}: {field.name!r} is missing")
    return found


def findings_in(data: Mapping[str, Any]) -> tuple[Finding, ...]:
    """Return the findings of a result's file; none where it has none."""
    return listed(data, "findings", lambda one: read_fields(Finding, one)) if data.get("findings") else ()


def listed(data: Mapping[str, Any], name: str, read: Callable[[Mapping[str, Any]], T]) -> tuple[T, ...]:
    """Return what `read` makes of each object of the list that is the field `name`.

    Raises
    ------
    InputError
        If the field is missing or no list of such objects; the object in question is named.

    Examples
    --------
    >>> listed({"causes": [{"effect": "delay"}]}, "causes", lambda cause: cause["effect"])
    ('delay',)
    """
    return tuple(_read_object(one, f"{name}[{i}]", read) for i, one in enumerate(_of_type(list, data[name], name)))


def part(data: Mapping[str, Any], name: str, read: Callable[[Mapping[str, Any]], T]) -> T:
    """Return what `read` makes of the object that is the field `name`.

    Raises
    ------
    InputError
        If the field is missing or no such object.
    """
    return _read_object(data[name], name, read)


def _read_object(value: Any, name: str, read: Callable[[Mapping[str, Any]], T]) -> T:
    with whole(name):
        return read(_of_type(dict, value, name))


def decoded(kind: Any, value: Any, name: str, known: Mapping[str, Any] | None = None) -> Any:  # noqa: C901 - a case each
    """Return `value` as the annotation `kind` has it; `name` is told in a refusal."""
    origin, parts = get_origin(kind), get_args(kind)
    if kind is float:
        return _number(value, name)
    if kind in (int, str, bool):
        return _of_type(kind, value, name)
    if origin in (Union, types.UnionType):
        others = [part for part in parts if part is not type(None)]
        return None if value is None and len(others) < len(parts) else decoded(others[0], value, name, known)
    if origin is Literal:
        if value not in parts:
            raise InputError(f"{name} must be one of {', '.join(map(str, parts))}; got {str(value)[:40]!r}")
        return value
    if origin is tuple:
        return _tuple(parts, value, name, known)
    if origin in (dict, Mapping):
        items = _of_type(dict, value, name).items()
        return {str(key): decoded(parts[1], one, f"{name}.{str(key)[:40]}", known) for key, one in items}
    if origin is np.ndarray:
        return _array(value, name)
    if hasattr(kind, "from_json"):
        return _read_object(value, name, kind.from_json)
    if is_dataclass(kind):
        return _read_object(value, name, lambda one: read_fields(kind, one, known))  # type: ignore[arg-type] # a class
    raise TypeError(f"{name}: no rule for {kind}")


def _tuple(parts: tuple[Any, ...], value: Any, name: str, known: Mapping[str, Any] | None) -> tuple[Any, ...]:
    items = _of_type(list, list(value) if isinstance(value, tuple) else value, name)
    kinds = parts[:1] * len(items) if parts[1:] == (Ellipsis,) else parts
    if len(kinds) != len(items):
        raise InputError(f"{name} must hold {len(kinds)} values, got {len(items)}")
    return tuple(
        decoded(kind, item, f"{name}[{i}]", known) for i, (kind, item) in enumerate(zip(kinds, items, strict=True))
    )


def _array(value: Any, name: str) -> NDArray[np.float64]:
    """Return lists of numbers as an array; what is null was not a number."""
    try:
        return np.array(_of_type(list, value, name), dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{name} must hold numbers, got {str(value)[:40]!r}") from None


def _number(value: Any, name: str) -> float:
    if value is None:
        return float("inf")
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{name} must be a number, got {str(value)[:40]!r}")
    if not math.isfinite(value):
        raise InputError(f"{name} must be finite, got {value}; write null for what is not known")
    return float(value)


def _of_type(kind: Any, value: Any, name: str) -> Any:
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise InputError(f"{name} must be {NOUNS[kind]}, got {str(value)[:40]!r}")
    return value
