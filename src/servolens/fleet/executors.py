"""Where axes are studied: the processors of this machine, or a Dask cluster."""

from __future__ import annotations

import logging
import os
import threading
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, final

from servolens.errors import InputError
from servolens.fleet.keeper import keepers

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from concurrent.futures import Future

    from distributed import Client

__all__ = ["dask_executor", "local_executor"]

SCHEDULER_SECONDS = 30
"""Seconds to wait for a scheduler."""
LOOK_INTERVAL = 1.0
"""Seconds between looks whether it is there."""


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
    if not os.environ.get("SERVOLENS_DEBUG"):
        for name in [name for name in logging.root.manager.loggerDict if name.startswith("distributed")]:
            logging.getLogger(name).setLevel(logging.CRITICAL)  # the fleet says itself what is wrong
    try:
        client = Client(address, timeout=SCHEDULER_SECONDS, set_as_default=False)
    except (OSError, ValueError) as error:
        why = str(error).splitlines()[0][:80] if str(error) else type(error).__name__
        raise InputError(f"no Dask scheduler answers at {address} ({why}); start one, or check the address") from None
    with client, _Cluster(client) as executor:
        yield executor


@final
class _Cluster(Executor):
    """A Dask client that does not wait for ever for a scheduler that is gone."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._jobs = client.get_executor(pure=False)
        self._out: set[Future[Any]] = set()
        self._closed = threading.Event()
        threading.Thread(target=self._watch, daemon=True).start()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Give a call to the cluster."""
        if self._is_gone():
            raise RuntimeError("the connection to the Dask scheduler is lost")
        future: Future[Any] = self._jobs.submit(fn, *args, **kwargs)
        self._out.add(future)
        future.add_done_callback(self._out.discard)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Stop watching, and let the cluster forget what is not finished."""
        self._closed.set()
        for future in list(self._out):
            future.cancel()

    def _is_gone(self) -> bool:
        return self._client.status not in ("running", "connecting")

    def _watch(self) -> None:
        """Cancel what no scheduler knows any more."""
        while not self._closed.wait(LOOK_INTERVAL):
            if self._is_gone():
                for future in list(self._out):
                    future.cancel()
                return


def _processors() -> int:
    known = getattr(os, "sched_getaffinity", None)
    return len(known(0)) if known is not None else os.cpu_count() or 1
