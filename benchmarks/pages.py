"""Tables that a benchmark writes into a page of the documentation, between two marks."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

__all__ = ["as_table", "write_tables"]


def as_table(heads: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a table in Markdown."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


def write_tables(path: Path, tables: Mapping[str, str]) -> None:
    """Write each table between the marks of its name; print it too."""
    page = path.read_text(encoding="utf-8")
    for name, table in tables.items():
        begin, end = f"<!-- {name} begin -->", f"<!-- {name} end -->"
        if begin not in page or end not in page:
            raise SystemExit(f"{path} has no lines {begin} and {end} to write the table between")
        page = f"{page.partition(begin)[0]}{begin}\n\n{table}\n\n{end}{page.partition(end)[2]}"
        print(f"{table}\n")
    path.write_text(page, encoding="utf-8")
    print(f"Wrote {path}")
