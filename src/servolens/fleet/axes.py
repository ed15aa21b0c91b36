"""The axes of a folder: a sub-folder or a campaign TOML each, with a date where its name holds one."""

from __future__ import annotations

import hashlib
import os
import re
import tomllib
from contextlib import suppress
from dataclasses import dataclass
from datetime import date, datetime
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, final
from urllib.parse import quote

from servolens.campaign import LARGEST_TOML, log_files
from servolens.errors import InputError
from servolens.reading.files import printable
from servolens.reading.formats import is_bag

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["Axis", "find_axes", "inputs_digest"]

DATED = re.compile(r"(.*?)[@_ -]?(\d{4})-?(\d\d)-?(\d\d)(?:[T_ -]?(\d\d)[-.:]?(\d\d)(?:[-.:]?(\d\d))?)?")
"""``2026-05-01`` or ``20260501``, perhaps with a time of day, at the end of a name."""
LONGEST_NAME = 120
"""Characters of a result file's name; longer ones end in a digest."""
MARK_FILE = "fleet.lock"
"""A folder that holds this file is the output of a fleet."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Axis:
    """One measurement of one axis.

    Parameters
    ----------
    name : str
        Of the axis; measurements on several dates share it.
    measured : str
        When, as ISO text; empty where no name tells it.
    path : Path
        Folder of logs or campaign TOML.
    """

    name: str
    measured: str
    path: Path

    @property
    def key(self) -> str:
        """What names this measurement, also as a file: letters, digits, ``-``, ``_``, ``.``, ``%`` and ``@`` only."""
        when = self.measured.replace(":", "")
        text = quote(os.fsencode(self.name), safe="") + (f"@{when}" if when else "")
        if len(text) > LONGEST_NAME:
            text = f"{text[: LONGEST_NAME - 17]}-{hashlib.sha256(text.encode()).hexdigest()[:16]}"
        return f"%2E{text[1:]}" if text.startswith(".") else text

    @property
    def label(self) -> str:
        """What people read."""
        return printable(f"{self.name}, {self.measured}" if self.measured else self.name)


def find_axes(folder: Path, *, leave_out: Path | None = None) -> tuple[Axis, ...]:
    """Return the axes of a folder, in the order of their names and dates.

    Parameters
    ----------
    folder : Path
        Each sub-folder and each ``.toml`` in it is an axis. A sub-folder may hold logs, one campaign TOML, or
        sub-folders and TOMLs whose names begin or end with a date: measurements of the same axis. Names of axes may end
        with a date as well. A sub-folder that a TOML beside it takes its files from belongs to that TOML.
    leave_out : Path, optional
        A sub-folder that is no axis: where results go.

    Raises
    ------
    InputError
        If the folder cannot be listed, holds no axis, or two of its axes have one name.

    Examples
    --------
    >>> import tempfile
    >>> root = Path(tempfile.mkdtemp())
    >>> for name in ("lift", "feed_2026-05-01", "turn/2026-05-02"):
    ...     (root / name).mkdir(parents=True)
    >>> [(axis.name, axis.measured) for axis in find_axes(root)]
    [('feed', '2026-05-01'), ('lift', ''), ('turn', '2026-05-02')]
    """
    entries = _entries(folder)
    taken = {name for path in entries if path.suffix.lower() == ".toml" for name in _folders_of(path)}
    axes = []
    for path in entries:
        if path.is_dir() and (path.name in taken or (path / MARK_FILE).exists() or _same(path, leave_out)):
            continue
        axes += list(_measurements(path))
    if not axes:
        raise InputError(f"{printable(str(folder))}: holds no axis; give each a sub-folder of logs or a campaign TOML")
    axes.sort(key=lambda axis: (axis.name, axis.measured, axis.path.name))
    for one, other in pairwise(axes):
        if one.key == other.key:
            raise InputError(
                f"{printable(str(folder))}: {printable(one.path.name)} and {printable(other.path.name)} are both axis"
                f" {one.label}; rename one"
            )
    return tuple(axes)


def inputs_digest(path: Path, data_root: Path | None) -> str:
    """Return what tells whether the files of an axis have changed: a SHA-256 digest of their names and contents.

    Of an axis whose files are not known, as it is refused, all that lies in its folder counts. Where the axis lies does
    not: a refusal names that, in words that depend on the folder that a run begins in.
    """
    digest = hashlib.sha256()
    try:
        campaign = _campaign_of(path)
        files = [*([campaign] if campaign.suffix.lower() == ".toml" else []), *log_files(campaign, data_root=data_root)]
    except (InputError, OSError):
        digest.update(b"refused\0")
        files = [path] if path.is_dir() or path.is_file() else []
    for file in (inner for outer in files for inner in _all_files(outer)):
        digest.update(os.fsencode(file.name) + b"\0")
        try:
            digest.update(b"%d\0" % file.stat().st_size)
            with file.open("rb") as stream:
                digest.update(hashlib.file_digest(stream, "sha256").digest())
        except OSError as error:
            digest.update(b"unreadable %d\0" % (error.errno or 0))
    return digest.hexdigest()


def source_of(axis_path: Path, folder: Path, data_root: Path | None) -> Path:
    """Return what to read for an axis: its campaign or its folder.

    Raises
    ------
    InputError
        If it lies outside the fleet's folder and the data root, or holds several campaigns.
    """
    real, within = axis_path.resolve(), (data_root or folder).resolve()
    if not real.is_relative_to(within):
        raise InputError("the axis lies outside the folder of the fleet; name a data root (--data-root) that holds it")
    return _campaign_of(axis_path)


def _campaign_of(path: Path) -> Path:
    """Return the one campaign of a folder, else the folder itself."""
    if not path.is_dir():
        return path
    campaigns = sorted(p for p in path.iterdir() if p.suffix.lower() == ".toml" and not p.name.startswith("."))
    if len(campaigns) > 1:
        raise InputError("the folder holds several campaign TOMLs; leave one, or name each by its date")
    return campaigns[0] if campaigns else path


def _all_files(path: Path) -> list[Path]:
    return sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]


def _entries(folder: Path) -> list[Path]:
    try:
        found = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError as error:
        raise InputError(f"{printable(str(folder))}: cannot be listed: {(error.strerror or '').lower()}") from error
    return [path for path in found if path.suffix.lower() == ".toml" or (path.is_dir() and not is_bag(path))]


def _measurements(path: Path) -> Iterator[Axis]:
    """Yield the measurements of one entry."""
    within = []
    if path.is_dir():
        with suppress(InputError):
            within = [(inner, _dated(inner)) for inner in _entries(path)]
    dated = [(inner, found) for inner, found in within if found is not None and found[0] == ""]
    if dated:
        for inner, found in dated:
            yield Axis(name=path.name, measured=found[1], path=inner)
        return
    name, when = _dated(path) or (_stem(path), "")
    yield Axis(name=name or _stem(path), measured=when, path=path)


def _stem(path: Path) -> str:
    return path.stem if path.suffix.lower() == ".toml" and not path.is_dir() else path.name


def _dated(path: Path) -> tuple[str, str] | None:
    """Return what stands before the date in a name, and the date."""
    found = DATED.fullmatch(_stem(path))
    if found is None:
        return None
    name, year, month, day, hour, minute, second = found.groups()
    try:
        if hour is None:
            return name, date(int(year), int(month), int(day)).isoformat()
        moment = datetime(int(year), int(month), int(day), int(hour), int(minute), int(second or 0))
    except ValueError:
        return None
    return name, moment.isoformat()


def _folders_of(toml: Path) -> set[str]:
    """Return the folders beside a TOML that its files lie in."""
    try:
        if toml.stat().st_size > LARGEST_TOML:
            return set()
        entries = tomllib.loads(toml.read_text(encoding="utf-8-sig")).get("records", [])
    except (OSError, ValueError, RecursionError):
        return set()  # reading it will say why
    files = [entry.get("file") for entry in entries if isinstance(entry, dict)] if isinstance(entries, list) else []
    return {Path(file).parts[0] for file in files if isinstance(file, str) and len(Path(file).parts) > 1}


def _same(path: Path, other: Path | None) -> bool:
    return other is not None and path.resolve() == other.resolve()
