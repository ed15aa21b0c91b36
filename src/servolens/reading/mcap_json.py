"""MCAP whose messages are JSON, as Foxglove and others write it, by mcap: what ROS does not serialise."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from mcap.reader import make_reader

from servolens.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

__all__ = ["json_messages"]


def json_messages(path: Path) -> Iterator[tuple[str, int, dict[str, Any]]]:
    """Yield topic, time of recording [ns] and content of each message that is a JSON object, in their order.

    Messages in other encodings are left out.

    Raises
    ------
    InputError
        If the file is damaged or a message is no JSON object.
    """
    with path.open("rb") as stream:
        try:
            for _, channel, message in make_reader(stream).iter_messages():
                if channel.message_encoding == "json":
                    yield channel.topic, message.log_time, _parsed(message.data)
        except InputError:
            raise
        except Exception as error:  # of the library, and of those that unpack for it
            raise InputError("is a damaged MCAP file; record it again, or run `mcap recover`") from error


def _parsed(content: bytes) -> dict[str, Any]:
    try:
        message = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise InputError("is MCAP with a message that is declared as JSON but is not JSON") from error
    if not isinstance(message, dict):
        raise InputError("is MCAP with a JSON message that is no object of names and values")
    return message
