"""Readers of binary formats in a process of their own, with limits: a damaged or hostile file ends that one only."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import subprocess
import sys
import tempfile
from importlib import import_module
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from servolens.errors import InputError
from servolens.reading import files
from servolens.reading.table import Column, Fault, Table

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["main", "read_isolated"]

MEMORY = 4 * 2**30
"""Address space of a reader [bytes]: the longest file, its numbers twice, and what libraries map."""
PROCESSOR, WALL = 120, 180
"""Limits of a reader [s]; a file of the greatest size takes a tenth of that."""
NO_SPACE = 28
"""Exit status of a reader whose answer found no room on the disk."""
SINGLE = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
"""Threads reserve address space each."""
_START = "import sys; sys.path.insert(0, {root!r}); from servolens.reading.isolated import main; main(sys.argv[1:])"


def read_isolated(module: str, path: Path, kind: str) -> tuple[Table, ...]:
    """Return what ``read`` of a module of this package makes of a file, read by another process.

    Parameters
    ----------
    module : str
        Name of the module, which offers ``read(path) -> sequence of Table``.
    path : Path
        The file or folder.
    kind : str
        What refusals call the format.

    Raises
    ------
    InputError
        With the reader's sentence, or if it fails, takes too long or needs too much memory; and if its library is not
        installed.
    """
    root = str(Path(__file__).parents[2])
    command = [sys.executable, "-P", "-c", _START.format(root=root), module, os.fspath(path)]
    environment = {**os.environ, **dict.fromkeys(SINGLE, "1")}
    with tempfile.TemporaryFile() as output:
        try:
            done = subprocess.run(
                command, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.DEVNULL, env=environment,
                timeout=WALL, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired as error:
            raise InputError(f"takes more than {WALL} s to read as {kind}; export it as CSV") from error
        if done.returncode == NO_SPACE:
            raise InputError(f"cannot be read: no space is left for temporary files in {tempfile.gettempdir()}")
        output.seek(0)
        answer = _answer(output) if done.returncode == 0 else None
        if answer is None:
            raise InputError(f"is damaged, or more than can be read: the reader of {kind} gave up; export it as CSV")
        if "missing" in answer:
            raise InputError(
                f"is {kind}; to read it install {answer['missing']}, or all readers: pip install 'servolens[formats]'"
            )
        if "refused" in answer:
            raise InputError(str(answer["refused"]))
        return tuple(_unpacked(table, output) for table in answer["tables"])


def main(arguments: Sequence[str]) -> None:
    """Read one file in this process and write its tables to standard output."""
    module, path = arguments
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # libraries print
    _limit()
    try:
        _write(output, module, Path(path))
        output.flush()
    except OSError as error:
        os._exit(NO_SPACE if error.errno in (errno.ENOSPC, errno.EDQUOT) else 1)
    os._exit(0)  # a library's clean-up may crash or wait


def _write(output: IO[bytes], module: str, path: Path) -> None:
    try:
        tables = list(import_module(f"servolens.reading.{module}").read(path))
        files.check_numbers(sum(column.values.size for table in tables for column in table.columns))
    except ImportError as error:
        _say(output, {"missing": (error.name or "its reader").partition(".")[0]})
    except InputError as error:
        _say(output, {"refused": str(error)})
    else:
        _say(output, {"tables": [_packed(table) for table in tables]})
        for table in tables:
            for column in table.columns:
                output.write(np.ascontiguousarray(column.values, dtype="<f8").tobytes())


def _limit() -> None:
    """Limit memory, processor time and output where the system knows how."""
    with contextlib.suppress(ImportError):
        import resource

        largest = 2 * files.MAX_BYTES
        for what, value in (
            (resource.RLIMIT_AS, MEMORY),
            (resource.RLIMIT_CPU, PROCESSOR),
            (resource.RLIMIT_FSIZE, largest),
            (resource.RLIMIT_CORE, 0),
        ):
            with contextlib.suppress(ValueError, OSError):
                resource.setrlimit(what, (value, value))


def _say(output: IO[bytes], answer: dict[str, Any]) -> None:
    output.write(json.dumps(answer).encode() + b"\n")


def _packed(table: Table) -> dict[str, Any]:
    return {
        "name": table.name,
        "comments": dict(table.comments),
        "properties": dict(table.properties),
        "has_names": table.has_names,
        "columns": [
            [
                c.name,
                c.values.size,
                c.unit,
                *([f.where, f.what, f.remedy, f.is_blank] if f else None for f in (c.fault, c.switches)),
            ]
            for c in table.columns
        ],
    }


def _unpacked(table: dict[str, Any], output: IO[bytes]) -> Table:
    columns = []
    for name, size, unit, *faults in table["columns"]:
        values = np.frombuffer(output.read(8 * size), dtype="<f8").astype(np.float64)
        fault, switches = (Fault(*one) if one else None for one in faults)
        columns.append(Column(name, values, unit, fault, switches))
    return Table(tuple(columns), **{key: table[key] for key in ("name", "comments", "properties", "has_names")})


def _answer(output: IO[bytes]) -> dict[str, Any] | None:
    try:
        answer = json.loads(output.readline(2**26))
    except ValueError:
        return None
    return answer if isinstance(answer, dict) else None
