"""Measure what docs/speed.md claims: ``make bench`` prints a table and writes ``latest.json`` beside this file.

Every ratio is measured in one run, its two sides in turn. ``python benchmarks/run.py varying_fit`` measures one part
and writes nothing.
"""

from __future__ import annotations

import importlib
import os
import sys
import tempfile
from pathlib import Path

from harness import Figure, table, write

PARTS = (
    "varying_fit",
    "design",
    "closed_loop",
    "kernel",
    "long_record",
    "output_error",
    "diagnosis",
    "logs_and_pages",
    "start_up",
)


def main(wanted: list[str]) -> None:
    """Measure the `wanted` parts, or all."""
    os.environ.setdefault("SERVOLENS_CACHE", str(Path(tempfile.gettempdir()) / "servolens-bench"))
    found: list[Figure] = []
    for part in wanted or PARTS:
        print(f"{part} …", flush=True)
        found += importlib.import_module(part).figures()
    print(table(found))
    if not wanted:
        write(found, Path(__file__).with_name("latest.json"))


if __name__ == "__main__":
    main(sys.argv[1:])
