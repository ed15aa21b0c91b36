"""Independent fits side by side: the compiled simulation leaves Python free."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

__all__ = ["in_parallel"]

Job = TypeVar("Job")
Result = TypeVar("Result")


def in_parallel(function: Callable[[Job], Result], jobs: Iterable[Job]) -> list[Result]:
    """Return what `function` makes of each of the `jobs`, in their order, with a thread for each processor."""
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        return list(pool.map(function, jobs))
