"""JSON: arrays by name, records, rows below named columns, one document a line, and streams as Klipper writes them."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from servolens.errors import InputError
from servolens.reading.klipper import stream_tree
from servolens.reading.nested import tables_of

if TYPE_CHECKING:
    from servolens.reading.table import Table

__all__ = ["read_json"]

LARGEST_TEXT = 128 * 2**20
"""Longest text that is parsed [bytes]: its values take about ten times as much memory."""


def read_json(content: bytes) -> tuple[Table, ...]:
    """Read the arrays of a JSON document, of one document a line, or of documents that a control character separates.

    Raises
    ------
    InputError
        If the text is no JSON, is too long, or holds no arrays of numbers.
    """
    if len(content) > LARGEST_TEXT:
        raise InputError(
            f"is JSON of more than {LARGEST_TEXT / 2**20:.0f} MiB, the longest that is read; export it as CSV"
        )
    try:
        tree = _documents(content.decode("utf-8-sig"))
    except InputError:
        raise
    except UnicodeDecodeError as error:
        raise InputError(f"is not valid UTF-8 text from byte {error.start} on; save it in UTF-8") from error
    except json.JSONDecodeError as error:
        raise InputError(
            f"is not valid JSON from line {error.lineno}, column {error.colno} on; export it again, or"
            " as a table in CSV"
        ) from error
    except (RecursionError, ValueError) as error:
        raise InputError(
            "is JSON that is nested too deep, or has a number that is too long; export it as CSV"
        ) from error
    schema = tree.get("schema") if isinstance(tree, dict) else None
    if isinstance(schema, str) and schema.startswith("servolens."):
        raise InputError(f"is a result that servolens wrote ({schema[:40]}); give the log that it was made from")
    try:
        tables = tables_of(tree)
    except RecursionError as error:
        raise InputError("is JSON that is nested too deep; export it as CSV") from error
    if not tables:
        raise InputError("is JSON without arrays of numbers; write one for each signal, as time and position")
    return tables


def _documents(text: str) -> Any:
    if "\x03" in text:
        return stream_tree([json.loads(part) for part in text.split("\x03") if part.strip()])
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        lines = [line for line in text.splitlines() if line.strip()]
        if len(lines) < 2:
            raise
        return [json.loads(line) for line in lines]
