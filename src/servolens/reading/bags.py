"""ROS bags (ROS 1, ROS 2 in SQLite or MCAP) and MCAP with JSON: a table for each topic, with its numbers as columns."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from servolens.errors import InputError
from servolens.reading import files
from servolens.reading.table import Column, Table

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

__all__ = ["read"]

LONGEST_ARRAY = 64
"""Elements of an array of a message that become columns; joints of a robot are fewer."""
DEEPEST_FIELD = 6
MCAP = b"\x89MCAP0\r\n"
OTHER = "is a damaged bag, or one of another kind than ROS 1, SQLite and MCAP with CDR or JSON"
SQLITE = b"SQLite format 3\x00"
NO_BAG = "is an SQLite database, and no ROS 2 bag; export its table as CSV"
STAMPS = (
    ("header.stamp.sec", "header.stamp.nanosec"),
    ("header.stamp.sec", "header.stamp.nsec"),
    ("timestamp.sec", "timestamp.nsec"),
)
"""Where messages keep their own time: those of ROS 2, those of ROS 1, and Foxglove's."""


def read(path: Path) -> list[Table]:
    """Return the topics of a bag whose messages hold numbers.

    The time is the messages' own stamp where they have one, else that of their recording. Arrays are named by the
    ``name`` (or ``joint_names``) of their message.

    Raises
    ------
    InputError
        If the bag is damaged, points outside its folder, or holds no numbers.
    """
    _check_inside(path)
    rows: dict[str, list[tuple[int, dict[str, float]]]] = {}
    count = 0
    for topic, recorded, message in _messages(path):
        row = dict(_numbers(message, "", 0))
        stamp = _stamp(row)
        count += len(row) + 1
        files.check_numbers(count)
        rows.setdefault(topic, []).append((recorded if stamp is None else stamp, row))
    start = min((instant for group in rows.values() for instant, _ in group), default=0)
    tables = [table for topic, group in rows.items() if (table := _table(topic, group, start)) is not None]
    if not tables:
        raise InputError("is a bag without messages that hold numbers")
    return tables


def _messages(path: Path) -> Iterator[tuple[str, int, Any]]:
    """Yield topic, time of recording [ns] and content of each message: ROS's serialisation, or JSON in MCAP."""
    if path.is_file() and files.read_start(path, len(MCAP)) == MCAP and not _is_ros(path):
        yield from _json(path)
        return
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            for connection, recorded, raw in reader.messages():
                yield connection.topic, recorded, reader.deserialize(raw, connection.msgtype)
    except Exception as error:
        raise InputError(OTHER if _may_be_bag(path) else NO_BAG) from error


def _may_be_bag(path: Path) -> bool:
    """Tell whether a file is no database, or one with the table of messages that ROS 2 gives it."""
    return not path.is_file() or files.read_start(path, len(SQLITE)) != SQLITE or b"messages" in path.read_bytes()


def _is_ros(path: Path) -> bool:
    """Tell whether an MCAP file says that ROS wrote it: the profile that its header begins with."""
    start = files.read_start(path, 64)[len(MCAP) + 9 :]
    size = int.from_bytes(start[:4], "little")
    return start[4 : 4 + size] in (b"ros1", b"ros2")


def _json(path: Path) -> Iterator[tuple[str, int, Any]]:
    from servolens.reading.mcap_json import json_messages

    found = False
    for message in json_messages(path):
        found = True
        yield message
    if not found:
        raise InputError("is MCAP without messages in JSON or by ROS; what else writes it (protobuf …) is not read")


def _check_inside(path: Path) -> None:
    """Refuse the folder of a bag that names or links files elsewhere."""
    if not path.is_dir():
        return
    root = path.resolve()
    text = (path / "metadata.yaml").read_text(encoding="utf-8", errors="replace")
    for line in text.splitlines():
        name = line.strip().removeprefix("-").strip().removeprefix("path:").strip().strip("'\"")
        if name.endswith((".db3", ".mcap", ".zstd")) and not (path / name).resolve().is_relative_to(root):
            raise InputError("is a bag that names a file outside its folder")
    if any(not item.resolve().is_relative_to(root) for item in path.iterdir()):
        raise InputError("is a bag that links to a file outside its folder")


def _numbers(message: Any, path: str, depth: int) -> Iterator[tuple[str, float]]:
    """Yield the numbers of a message with their paths."""
    if isinstance(message, bool | np.bool_ | int | float | np.number):
        yield path, float(message)
        return
    if depth > DEEPEST_FIELD:
        return
    if isinstance(message, np.ndarray | list | tuple):
        for k, item in enumerate(message[:LONGEST_ARRAY]):
            if not isinstance(item, str):
                yield from _numbers(item, f"{path}[{k}]", depth + 1)
        return
    fields = _fields(message)
    names: list[str] = next((fields[key] for key in ("name", "joint_names") if isinstance(fields.get(key), list)), [])
    for field, own in fields.items():
        for key, value in _numbers(own, f"{path}.{field}" if path else field, depth + 1):
            yield _titled(key, names), value


def _fields(message: Any) -> dict[str, Any]:
    """Return what a message of either kind consists of, by name."""
    if isinstance(message, dict):
        return {str(key): value for key, value in message.items()}
    names = getattr(message, "__dataclass_fields__", ())
    return {name: getattr(message, name) for name in names if not name.startswith("__")}


def _titled(key: str, names: list[str]) -> str:
    """Return ``position.elbow`` for ``position[2]`` where the message names its third joint so."""
    head, bracket, index = key.rpartition("[")
    if bracket and index[:-1].isdecimal() and int(index[:-1]) < len(names):
        return f"{head}.{names[int(index[:-1])]}"
    return key


def _stamp(row: dict[str, float]) -> int | None:
    """Take a message's own stamp [ns] out of its numbers; None without one or where it was not set."""
    for whole, part in STAMPS:
        if whole in row and part in row:
            seconds, rest = row.pop(whole), row.pop(part)
            return None if not seconds else int(seconds) * 10**9 + int(rest)
    return None


def _table(topic: str, rows: list[tuple[int, dict[str, float]]], start: int) -> Table | None:
    keys = [key for key in rows[0][1] if all(key in row for _, row in rows)]
    if not keys or len(rows) < 2:
        return None
    rows = sorted(rows, key=lambda item: item[0])
    columns = [Column("time", np.array([(instant - start) * 1e-9 for instant, _ in rows]), "s")]
    prefix = topic.strip("/").replace("/", ".")
    columns += [Column(f"{prefix}.{key}", np.array([row[key] for _, row in rows])) for key in keys]
    return Table(tuple(columns), topic.strip("/"))
