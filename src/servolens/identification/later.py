"""Parts of a result that take long, and that not everybody asks for."""

from __future__ import annotations

from threading import Lock
from typing import TYPE_CHECKING, Any, Generic, TypeVar, final

from servolens.processors import single_threaded_blas

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["Later", "known"]

Made = TypeVar("Made")


@final
class Later(Generic[Made]):
    """A value that is made when it is first asked for, and kept; threads may ask at once.

    Parameters
    ----------
    make : callable
        Returns the value.

    Examples
    --------
    >>> Later(lambda: 6 * 7).value
    42
    """

    __slots__ = ("_found", "_lock", "_make")

    def __init__(self, make: Callable[[], Made]) -> None:
        self._make: Callable[[], Made] | None = single_threaded_blas(make)
        self._found: list[Made] = []
        self._lock = Lock()

    @property
    def value(self) -> Made:
        """The value."""
        with self._lock:
            if self._make is not None:
                self._found, self._make = [self._make()], None
        return self._found[0]

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how to build it again: with its value, for what makes it need not be picklable."""
        return known, (self.value,)


def known(value: Made) -> Later[Made]:
    """Return a value that is there already."""
    return Later(lambda: value)
