"""What can go wrong, each with a sentence that says what to do.

Wrong use raises a :class:`ServolensError`; its ``exit_status`` is what the command line ends with.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable

__all__ = [
    "InputError",
    "NumericalError",
    "ServolensError",
    "described",
    "names_like",
    "needed",
    "number_within",
    "unwrapped",
]

MOST_NAMES = 6
"""Names that a message offers where many hold what was written."""


class ServolensError(Exception):
    """Base of every error servolens raises on purpose. The message is one sentence for people."""

    exit_status = 2


class InputError(ServolensError, ValueError):
    """What arrived cannot be used: a file, a value, an option."""


class NumericalError(ServolensError, ArithmeticError):
    """A computation that should have succeeded did not."""

    exit_status = 3


def described(value: Any) -> str:
    """Return what a value is, for a message, with at most 40 characters of it."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    text = " ".join(repr(value).split()) if isinstance(value, str | int | float | complex | list | tuple | dict) else ""
    kind = "None" if value is None else type(value).__name__
    return f"{kind} {text if len(text) <= 40 else f'{text[:39]}…'}".strip()


def needed(value: Any, kind: type, example: str) -> None:
    """Refuse a `value` that is not of the `kind` that is needed, of which there is an `example`.

    Raises
    ------
    InputError
        That says what it is.
    """
    if not isinstance(value, kind):
        raise InputError(f"a {kind.__name__} is needed, such as {example}; got {described(value)}")


def unwrapped(value: Any) -> Any:
    """Return the number of an array without dimensions, as NumPy makes of one, and anything else as it is.

    Examples
    --------
    >>> import numpy as np
    >>> unwrapped(np.array(60.0)), unwrapped(60), unwrapped(None)
    (60.0, 60, None)
    """
    return value.item() if getattr(value, "shape", None) == () and hasattr(value, "item") else value


def names_like(name: str, known: Iterable[str], otherwise: str) -> str:
    """Return the question for a misspelt `name`: which of the `known` was meant; where none is like it, all of them.

    Capitals, spaces, hyphens and underscores do not count, and a part of a name is enough.

    Parameters
    ----------
    name : str
        As written.
    known : iterable of str
        All that there are.
    otherwise : str
        What leads the list of all of them, e.g. "the catalogue holds".

    Examples
    --------
    >>> names_like("CoulombFriction", ["backlash", "coulomb_friction"], "there are")
    "did you mean 'coulomb_friction'?"
    >>> names_like("backlsh", ["backlash", "coulomb_friction"], "there are")
    "did you mean 'backlash'?"
    >>> names_like("?", ["backlash", "coulomb_friction"], "there are")
    'there are backlash, coulomb_friction'
    """
    from difflib import get_close_matches

    plain = {one: _plain(one) for one in known}
    wanted = _plain(name)
    near = [one for one, text in plain.items() if text == wanted]
    near = near or [one for one, text in plain.items() if len(wanted) > 2 and wanted in text]
    if not near:
        close = get_close_matches(wanted, plain.values(), 2)
        near = [one for one, text in plain.items() if text in close]
    if near and len(near) <= MOST_NAMES:
        return f"did you mean {' or '.join(repr(one) for one in near)}?"
    return f"{otherwise} {', '.join(plain)}"


def _plain(name: str) -> str:
    return re.sub(r"[\W_]+", "", name).lower()


def number_within(value: Any, low: float, high: float, what: str) -> float:
    """Return `value` as a float, if it is a finite number from `low` to `high`.

    Raises
    ------
    InputError
        If it is not.
    """
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = float("nan")
    is_number = not isinstance(value, str) and not getattr(value, "ndim", False) and math.isfinite(number)
    if not is_number or not low <= number <= high:
        wanted = f"number from {low:g} to {high:g}" if math.isfinite(high - low) else "finite number"
        raise InputError(f"{what} must be a {wanted}, got {value!r}")
    return number
