"""A campaign file that states how logs are read, so that nothing is guessed again."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING

from servolens.errors import InputError
from servolens.reading import KEYS
from servolens.reading.reading import units_of
from servolens.results import copy_atomically, write_atomically

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from servolens.campaign import Log

__all__ = ["write_campaign"]


def write_campaign(logs: Sequence[Log], path: Path) -> tuple[Path, ...]:
    """Write a campaign of logs with the settings, columns and units that they were read with.

    Parameters
    ----------
    logs : sequence of Log
        From :func:`~servolens.campaign.read_logs`.
    path : Path
        The TOML file. Logs, and files of references, that do not lie below its folder are copied into it.

    Returns
    -------
    tuple of Path
        The copies.

    Raises
    ------
    InputError
        If a ROS 2 bag, which is a folder, lies elsewhere, or a file cannot be written: then none is, and what was
        there before is as it was.
    """
    folder = path.resolve().parent
    taken: dict[Path, Path] = {}
    entries, copies = [], []
    for log in logs:
        beside = log.reading.settings.get("reference_file")
        places = []
        for source in [log.path.resolve(), *([Path(str(beside)).resolve()] if beside else [])]:
            target = taken.get(source) or _target(source, folder, {path.resolve(), *taken.values()})
            if target != source and source not in taken:
                if source.is_dir():
                    raise InputError(f"{log.path}: is a bag outside the campaign's folder; copy its folder there first")
                copies.append((source, target, target.exists()))  # an equal one stays
            taken[source] = target
            places.append(target.relative_to(folder))
        entries.append(_entry(log, *places))
    text = "# Written by servolens convert: change what was guessed wrong.\n\n" + "\n".join(entries)
    try:
        for source, target, is_there in copies:
            if not is_there:
                copy_atomically(source, target)
        write_atomically(path, text.encode("utf-8"))
    except BaseException:
        for _, target, is_there in copies:
            if not is_there:
                target.unlink(missing_ok=True)
        raise
    return tuple(target for _, target, _ in copies)


def _target(source: Path, folder: Path, taken: set[Path]) -> Path:
    """Return where the campaign finds a file: where it is, or a copy beside the campaign."""
    return source if source.is_relative_to(folder) else _free(folder / source.name, taken, source)


def _free(target: Path, taken: set[Path], source: Path) -> Path:
    """Return the target, or it with a number where another file has its name; an equal copy is taken again."""
    number, chosen = 1, target
    while chosen in taken or (chosen.exists() and not _equal(chosen, source)):
        number += 1
        chosen = target.with_name(f"{target.stem}-{number}{target.suffix}")
    return chosen


def _equal(first: Path, second: Path) -> bool:
    return (
        first.is_file() and first.stat().st_size == second.stat().st_size and first.read_bytes() == second.read_bytes()
    )


def _entry(log: Log, file: Path, beside: Path | None = None) -> str:
    reading = log.reading
    lines = ["[[records]]", f"file = {_text(file.as_posix())}"]
    if reading.record.name != file.name.removesuffix(".gz").rpartition(".")[0]:
        lines.append(f"name = {_text(reading.record.name)}")
    for key in KEYS:
        value = beside.as_posix() if key == "reference_file" and beside else reading.settings.get(key)
        if key != "name" and value is not None:
            lines.append(f"{key} = {_text(value) if isinstance(value, str | os.PathLike) else repr(value)}")
    lines.append(f"columns = {_table(reading.columns)}")
    lines.append(f"units = {_table(_units(log))}")
    return "\n".join(lines) + "\n"


def _units(log: Log) -> dict[str, str]:
    """Return the units of all columns, and of a made reference; those of counted columns follow from their scale."""
    reading = log.reading
    si = units_of(reading.record)
    if any(key in reading.settings for key in ("counts_per_unit", "counts_per_rev")):
        si = {"time": si["time"], "voltage": si["voltage"]}
    signals = dict.fromkeys((*reading.columns, *({"reference"} & set(reading.units))))
    return {signal: text for signal in signals if (text := reading.units.get(signal) or si.get(signal))}


def _table(entries: Mapping[str, str]) -> str:
    return "{" + ", ".join(f"{key} = {_text(value)}" for key, value in entries.items()) + "}"


def _text(value: object) -> str:
    """Return a TOML string: JSON's escapes are TOML's, but for one character."""
    return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")
