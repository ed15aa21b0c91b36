"""Where axes are studied: the processors of this machine, or a Dask cluster."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TYPE_CHECKING

from servolens.errors import InputError
from servolens.fleet.keeper import keepers

if TYPE_CHECKING:
    from collections.abc import Iterator
    from concurrent.futures import Executor

__all__ = ["dask_executor", "local_executor"]

PATIENCE = 30
"""Seconds to wait for a scheduler."""


@contextmanager
def local_executor(cores: int | None = None) -> Iterator[Executor]:
    """Yield an executor with a process for each of `cores` processors, by default all.

    What is not finished when the block ends is given up.

    Raises
    ------
    InputError
        If `cores` is less than one.
    """
    if cores is not None and cores < 1:
        raise InputError(f"cores must be 1 or more, got {cores}")
    with keepers() as end:
        pool = ThreadPoolExecutor(cores or _processors())  # each thread waits for a process of its own
        try:
            yield pool
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            end()
            pool.shutdown(wait=True)


@contextmanager
def dask_executor(address: str) -> Iterator[Executor]:
    """Yield an executor on the Dask cluster whose scheduler is at `address`, such as ``tcp://10.0.0.5:8786``.

    Its workers need servolens, of this version, and the folder of the fleet under the same path.

    Raises
    ------
    InputError
        If Dask is not installed, or no scheduler answers.
    """
    try:
        from distributed import Client
    except ImportError:
        raise InputError("for --dask install Dask: pip install 'servolens[dask]'") from None
    try:
        client = Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        why = str(error).splitlines()[0][:80] if str(error) else type(error).__name__
        raise InputError(f"no Dask scheduler answers at {address} ({why}); start one, or check the address") from None
    with client, client.get_executor(pure=False) as executor:
        yield executor


def _processors() -> int:
    known = getattr(os, "sched_getaffinity", None)
    return len(known(0)) if known is not None else os.cpu_count() or 1
