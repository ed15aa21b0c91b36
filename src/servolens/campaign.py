"""Several records of the same axis: from files, folders, or a campaign TOML."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from servolens.errors import InputError, described
from servolens.reading import KEYS, read_log
from servolens.reading.files import is_folder, located, printable, quote, read_bytes
from servolens.reading.formats import SUFFIXES, is_bag
from servolens.reading.roles import check_mapping
from servolens.reading.settings import as_settings

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from servolens.reading import Reading
    from servolens.record import Record

__all__ = ["Log", "log_files", "read_logs", "read_records"]

StrPath = str | os.PathLike[str]
LARGEST_TOML = 2**20
TABLES = ("columns", "units")
BY_NAME_ONLY = (".txt", ".log", ".dat", ".asc")
"""Texts that may be logs; in a folder they may be notes as well, so each is read where it is named."""


def read_records(
    paths: StrPath | Iterable[StrPath],
    *,
    settings: Mapping[str, object] | None = None,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    data_root: StrPath | None = None,
    **stated: object,
) -> tuple[Record, ...]:
    """Read the records of one axis.

    Parameters
    ----------
    paths : path or iterable of paths
        Files; folders, of which every log is read in the order of their names; campaign files
        ``.toml`` with ``[[records]]`` entries (``file``, settings, ``columns``, ``units``) and a ``[defaults]`` table
        with what all entries share.
    settings, columns, units : mapping, optional
        For every record, as in :func:`~servolens.reading.read_record`; they win over the entries of a campaign.
    data_root : path, optional
        Files named by a campaign or found in a folder may lie anywhere below it; by default only below the
        campaign's own folder.
    **stated
        The same as `settings`, as keywords: ``kp=60``.

    Returns
    -------
    tuple of Record
        In the order given, all in the same units.

    Raises
    ------
    InputError
        With one sentence; a refused entry is named as ``campaign.toml: records[2] (run3.csv): …``.

    Examples
    --------
    >>> read_records([])
    Traceback (most recent call last):
        ...
    servolens.errors.InputError: no records are given; name files, folders or a campaign TOML
    """
    logs = read_logs(paths, settings=as_settings(settings, stated), columns=columns, units=units, data_root=data_root)
    return tuple(log.reading.record for log in logs)


def read_logs(
    paths: StrPath | Iterable[StrPath],
    *,
    settings: Mapping[str, object] | None = None,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    data_root: StrPath | None = None,
) -> tuple[Log, ...]:
    """Read the records of one axis and tell how each was read.

    Parameters
    ----------
    paths, settings, columns, units, data_root
        As in :func:`read_records`.

    Returns
    -------
    tuple of Log
        In the order given.

    Raises
    ------
    InputError
        As :func:`read_records` does.
    """
    named = [paths] if isinstance(paths, str | os.PathLike) or not isinstance(paths, Iterable) else list(paths)
    for path in named:
        if not isinstance(path, str | os.PathLike):
            raise InputError(f"paths of files, folders or campaigns are needed; got {described(path)}")
    root = _root(data_root)
    beside = (settings or {}).get("reference_file")
    own = None if beside is None else _real(Path(str(beside)))
    sources = [source for path in named for source in _sources(Path(path), root) if not _leads_to(source, own)]
    if not sources:
        raise InputError("no records are given; name files, folders or a campaign TOML")
    _check_distinct(sources)
    logs = tuple(Log(path=source.path, reading=_read(source, settings, columns, units)) for source in sources)
    _check_units([log.reading.record for log in logs], sources)
    return logs


def log_files(path: StrPath, *, data_root: StrPath | None = None) -> tuple[Path, ...]:
    """Return the files that a file, a folder or a campaign names, in order; a ROS bag is a folder.

    Parameters
    ----------
    path, data_root
        As in :func:`read_records`.

    Raises
    ------
    InputError
        If the folder or the campaign cannot be read, or names a file outside of what is allowed.
    """
    root = _root(data_root)
    return tuple(source.path for source in _sources(Path(path), root))


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Log:
    """A file and what was read from it.

    Parameters
    ----------
    path : Path
        Where the file really is.
    reading : Reading
        Its record, and how it was found.
    """

    path: Path
    reading: Reading


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class _Source:
    """One file to be read, what refusals call it, and what its campaign says about it."""

    path: Path
    label: str
    settings: Mapping[str, object] = field(default_factory=dict)
    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)


def _sources(path: Path, root: Path | None) -> Iterator[_Source]:
    if path.suffix.lower() == ".toml" and not is_folder(path):
        yield from _campaign(path, root)
    elif is_folder(path) and not is_bag(path):
        yield from _folder(path, root)
    else:
        yield _Source(path=path, label=str(path))


def _folder(folder: Path, root: Path | None) -> Iterator[_Source]:
    with located(str(folder)):
        try:
            entries = sorted(folder.iterdir())
            files = [path for path in entries if _is_log(path)]
        except OSError as error:
            raise InputError(f"cannot be listed: {(error.strerror or str(error)).lower()}") from error
        if not files:
            texts = [path.name for path in entries if path.suffix.lower() in BY_NAME_ONLY and path.is_file()]
            hint = f"; if a text in it is a log, name that file: {printable(str(folder / texts[0]))}" if texts else ""
            raise InputError(f"is a folder without logs such as .csv, .mat or .xlsx{hint}")
    for file in files:
        with located(str(file)):
            yield _Source(path=_inside(file, folder, root), label=str(file))


def _is_log(path: Path) -> bool:
    name = path.name.lower()
    return (name.endswith(SUFFIXES) and not name.startswith((".", "~$"))) or is_bag(path)


def _campaign(path: Path, root: Path | None) -> Iterator[_Source]:
    with located(str(path)):
        document = _toml(path)
        entries = _entries(document)
        defaults = document.get("defaults", {})
        _check_keys("defaults", defaults, (*KEYS, *TABLES))
    for index, entry in enumerate(entries):
        with located(f"{path}: records[{index}]"):
            file = entry.get("file")
            if not isinstance(file, str) or not file:
                raise InputError("file is missing; name the record's file, relative to the TOML")
            where = f"({printable(file)[:80]})"
        label = f"{path}: records[{index}] {where}"
        with located(label):
            if file.lower().endswith(".toml"):
                raise InputError("is a campaign, not a record; write its entries here, one for each record")
            _check_keys("the entry", entry, ("file", *KEYS, *TABLES))
            yield _Source(
                path=_inside(path.parent / file, path.parent, root),
                label=label,
                settings=_settings({**defaults, **entry}, path.parent, root),
                columns={**_table(defaults, "columns"), **_table(entry, "columns")},
                units={**_table(defaults, "units"), **_table(entry, "units")},
            )


def _settings(entry: Mapping[str, Any], folder: Path, root: Path | None) -> dict[str, object]:
    """Return the settings of an entry; a file that it names is found beside the campaign."""
    found = {key: value for key, value in entry.items() if key in KEYS}
    file = found.get("reference_file")
    if file is not None:
        if not isinstance(file, str) or not file:
            raise InputError("reference_file must be the name of a file, relative to the TOML")
        with located(f"reference_file ({printable(file)[:80]})"):
            found["reference_file"] = str(_inside(folder / file, folder, root))
    return found


def _toml(path: Path) -> dict[str, Any]:
    content = read_bytes(path, LARGEST_TOML)
    try:
        return tomllib.loads(content.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise InputError(f"is not UTF-8 text (byte {error.start})") from error
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"is not valid TOML: {quote(error)}") from error
    except (RecursionError, ValueError) as error:
        raise InputError("is not valid TOML: nested too deep, or a number too long") from error


def _entries(document: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    _check_keys("the campaign", document, ("records", "defaults"))
    entries = document.get("records")
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        raise InputError("holds no [[records]] entries; write one for each file")
    return entries


def _check_keys(what: str, table: object, known: Sequence[str]) -> None:
    if not isinstance(table, dict):
        raise InputError(f"{what} must be a table of keys and values")
    unknown = sorted(set(table) - set(known))
    if unknown:
        raise InputError(f"{what} has a key {quote(unknown[0])}; known are {', '.join(known)}")


def _table(entry: Mapping[str, Any], key: str) -> dict[str, str]:
    table = entry.get(key, {})
    if not isinstance(table, dict):
        raise InputError(f"{key} must be a table such as {{position = 'qm'}}")
    return table


def _inside(path: Path, folder: Path, root: Path | None) -> Path:
    """Return where the file really is, symbolic links followed, if that is below the folder or the data root."""
    real = _real(path)
    if not real.is_relative_to(_real(folder) if root is None else root):
        where = "its folder" if root is None else "the data root"
        raise InputError(f"the file lies outside {where}; name a data root (--data-root) that holds it")
    return real


def _root(data_root: StrPath | None) -> Path | None:
    """Return where the data root really is."""
    if not isinstance(data_root, str | os.PathLike | None):
        raise InputError(f"data_root must be the path of a folder; got {described(data_root)}")
    if data_root is not None and not is_folder(Path(data_root)):
        raise InputError(f"{printable(str(data_root))}: is no folder; the data root (--data-root) must be one")
    return None if data_root is None else _real(Path(data_root))


def _leads_to(source: _Source, file: Path | None) -> bool:
    with located(source.label):
        return file is not None and _real(source.path) == file


def _real(path: Path) -> Path:
    try:
        return path.resolve()
    except (OSError, RuntimeError, ValueError) as error:
        raise InputError("the path cannot be followed; check its symbolic links") from error


def _check_distinct(sources: Sequence[_Source]) -> None:
    seen: dict[tuple[int, int], str] = {}
    for source in sources:
        try:
            status = source.path.stat()
        except (OSError, ValueError):
            continue  # reading it will say why
        file = (status.st_dev, status.st_ino)
        if file in seen:
            first = f"first as {printable(seen[file])}"
            raise InputError(f"{printable(source.label)}: the same file is given twice, {first}")
        seen[file] = source.label


def _read(
    source: _Source,
    settings: Mapping[str, object] | None,
    columns: Mapping[str, str] | None,
    units: Mapping[str, str] | None,
) -> Reading:
    given = {key: value for key, value in (settings or {}).items() if value is not None}
    return read_log(
        source.path,
        settings={**source.settings, **given},
        columns={**source.columns, **check_mapping(columns, "columns", "qm")},
        units={**source.units, **check_mapping(units, "units", "mm")},
        label=source.label,
    )


def _check_units(records: Sequence[Record], sources: Sequence[_Source]) -> None:
    first = records[0]
    for record, source in zip(records, sources, strict=True):
        for what, mine, other in (
            ("position", record.length_unit, first.length_unit),
            ("the command", record.command_unit, first.command_unit),
        ):
            if mine != other:
                raise InputError(
                    f"{printable(source.label)}: {what} is in {mine}, in {printable(sources[0].label)} in {other};"
                    " records of one axis have the same units"
                )
