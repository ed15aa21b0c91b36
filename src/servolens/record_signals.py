"""What the signals of a record have to be: numbers, finite, of one length, on a time that increases."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.errors import InputError, described

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = ["as_finite", "as_numbers", "as_signal", "check_enabled", "check_leads", "check_time", "is_number", "require"]


def as_numbers(values: ArrayLike, what: str) -> NDArray[np.float64]:
    """Return an array of `values`.

    Raises
    ------
    InputError
        If they are no numbers, with `what` they are.
    """
    try:
        given = np.asarray(values)
        is_text = given.dtype.kind == "O" and any(isinstance(value, str | bytes) for value in given.flat)
        if values is None or given.dtype.kind in "USmMc" or is_text:
            raise TypeError
        return given.astype(np.float64, copy=False)
    except (TypeError, ValueError):
        raise InputError(f"{what} must hold numbers alone, got {described(values)}") from None


def as_finite(values: ArrayLike, what: str) -> NDArray[np.float64]:
    """Return an array of `values`, the samples along its last axis.

    Raises
    ------
    InputError
        If they are no finite numbers.
    """
    array = as_numbers(values, what)
    if not np.isfinite(array).all():
        first = np.argwhere(~np.isfinite(np.atleast_1d(array)))[0]
        raise InputError(f"{what} must be finite; sample {first[-1]} is {np.atleast_1d(array)[tuple(first)]}")
    return array


def as_signal(name: str, value: ArrayLike, record: str) -> NDArray[np.float64]:
    """Return a read-only array of the `value` of a signal.

    Raises
    ------
    InputError
        If it is no finite one-dimensional array.
    """
    array = as_finite(value, f"{record}: {name}")
    require(array.ndim == 1, f"{record}: {name} must be one-dimensional, got shape {array.shape}")
    if _is_frozen(array) and array.flags.c_contiguous:
        return array
    own = isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and not np.may_share_memory(array, value))
    return _frozen(array if own else array.copy())


def _frozen(array: NDArray[np.float64]) -> NDArray[np.float64]:
    array.flags.writeable = False
    return array


def _is_frozen(array: NDArray[np.float64]) -> bool:
    """Tell whether nobody can write to the array's memory: it and all that it is a view of are read-only."""
    base: object = array
    while isinstance(base, np.ndarray):
        if base.flags.writeable:
            return False
        base = base.base
    return base is None


def check_time(time: NDArray[np.float64], steps: NDArray[np.float64], record: str) -> None:
    """Refuse a time that does not increase.

    Raises
    ------
    InputError
        With the first sample that is not after the one before.
    """
    if steps.min() <= 0:
        k = int(np.argmax(steps <= 0)) + 1
        same = time[k] == time[k - 1]
        verb = "repeats" if same else "lies before"
        rounded = "; if the stamps were rounded, state the sample_time instead"
        remedy = rounded if same else "; a record is one run in the order of its time: split or sort the rows"
        met = f"sample {k} ({time[k]:g} s) {verb} sample {k - 1} ({time[k - 1]:g} s)"
        raise InputError(f"{record}: time must increase; {met}{remedy}")


def check_enabled(enabled: NDArray[np.float64] | None, record: str) -> None:
    """Refuse a motor that is neither on nor off.

    Raises
    ------
    InputError
        With the first such sample.
    """
    if enabled is None:
        return
    odd = np.flatnonzero((enabled != 0) & (enabled != 1))
    if odd.size:
        k = int(odd[0])
        raise InputError(f"{record}: enabled must be 0 (motor off) or 1 (on); sample {k} is {enabled[k]:g}")


def check_leads(leads: NDArray[np.float64] | None, steps: NDArray[np.float64], record: str) -> None:
    """Refuse jumps that came after the sample that shows them, or not after the one before; `steps` lie between [s].

    Raises
    ------
    InputError
        With the first such sample.
    """
    if leads is None:
        return
    odd = np.flatnonzero((leads[1:] < 0.0) | (leads[1:] >= steps)) + 1
    if odd.size:
        k = int(odd[0])
        raise InputError(
            f"{record}: jump_leads must lie in [0, {steps[k - 1]:g}) s, the time since the sample before;"
            f" sample {k} is {leads[k]:g}"
        )


def is_number(value: object) -> bool:
    """Tell whether a `value` is a finite number."""
    return isinstance(value, int | float | np.number) and bool(np.isfinite(value))


def require(condition: object, message: str) -> None:
    """Refuse what does not meet a `condition`.

    Raises
    ------
    InputError
        With the `message`.
    """
    if not condition:
        raise InputError(message)
