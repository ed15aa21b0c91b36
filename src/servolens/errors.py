"""What can go wrong, each with a sentence that says what to do.

Wrong use raises a :class:`ServolensError`; its ``exit_status`` is what the command line ends with.
"""

from __future__ import annotations

import math
import re
from collections.abc import Hashable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

__all__ = [
    "InputError",
    "NumericalError",
    "ServolensError",
    "as_number",
    "as_progress",
    "as_text",
    "by_name",
    "described",
    "flags",
    "mapped",
    "names_like",
    "needed",
    "number_within",
    "one_of",
    "unwrapped",
    "whole_number",
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
    value = unwrapped(value)
    text = " ".join(repr(value).split()) if isinstance(value, str | int | float | complex | list | tuple | dict) else ""
    kind = "None" if value is None else type(value).__name__
    return f"{kind} {text if len(text) <= 40 else f'{text[:39]}…'}".strip()


def needed(value: Any, kind: type) -> None:
    """Refuse a `value` that is not of the `kind` that is needed, which has an ``example`` of itself.

    Raises
    ------
    InputError
        That says what it is.
    """
    if not isinstance(value, kind):
        example = getattr(kind, "example", kind.__name__)
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


def as_number(value: Any) -> float:
    """Return `value` as a float; what is no number, such as a text, a truth value or an array, as NaN.

    Examples
    --------
    >>> as_number(2), as_number("2"), as_number([2])
    (2.0, nan, nan)
    """
    try:
        value = unwrapped(value)
        return math.nan if isinstance(value, str | bytes | bool) or getattr(value, "ndim", False) else float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def number_within(value: Any, low: float, high: float, what: str, *, above: bool = False) -> float:
    """Return `value` as a float, if it is a finite number from `low`, or `above` it, to `high`.

    Raises
    ------
    InputError
        If it is not.
    """
    number = as_number(value)
    if not math.isfinite(number) or not low <= number <= high or (above and number == low):
        wanted = f"number from {low:g} to {high:g}" if math.isfinite(high - low) else "finite number"
        if low > -math.inf and high == math.inf:
            wanted += f" larger than {low:g}" if above else f" of at least {low:g}"
        raise InputError(f"{what} must be a {wanted}, got {described(value)}")
    return number


def whole_number(value: Any, least: int, what: str, most: float = math.inf) -> int:
    """Return `value` as an int, if it is a whole number of at least `least` and at most `most`.

    Raises
    ------
    InputError
        If it is not.
    """
    number = as_number(value)
    if not (most >= number >= least and number.is_integer()):
        at_most = f" and at most {most}" if most < math.inf else ""
        raise InputError(f"{what} must be a whole number of at least {least}{at_most}, got {described(value)}")
    return int(value)


def one_of(value: Any, choices: Iterable[Any], what: str) -> None:
    """Refuse a `value` that is none of the `choices`.

    Raises
    ------
    InputError
        With what there is to choose from.
    """
    known, value = list(choices), unwrapped(value)
    if not isinstance(value, Hashable) or value not in known:
        raise InputError(f"{what} must be one of {', '.join(map(str, known))}; got {described(value)}")


def flags(**given: Any) -> None:
    """Refuse what is neither True nor False.

    Raises
    ------
    InputError
        With its name.
    """
    for what, value in given.items():
        one_of(value, (True, False), what)


def as_text(value: Any, what: str, without: str = "") -> str:
    """Return `value`, if it is a text that holds no character of `without`.

    Raises
    ------
    InputError
        If it is not.
    """
    if not isinstance(value, str):
        raise InputError(f"{what} must be a text, got {described(value)}")
    if set(without) & set(value):
        raise InputError(f"{what} must be a text without {' or '.join(map(repr, without))}, got {described(value)}")
    return value


def mapped(value: Any) -> Any:
    """Return a `value` that holds others by name, as a pandas Series does, as a mapping; any other as it is."""
    convert = getattr(value, "to_dict", None)
    return convert() if not isinstance(value, Mapping) and callable(convert) else value


def by_name(what: str, given: Any, example: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return what is `given` by name, as by a pandas Series; nothing where it is None.

    Raises
    ------
    InputError
        If it is no mapping, or a key is no text.
    """
    given = mapped(given)
    if not isinstance(given, Mapping | None) or not all(isinstance(name, str) for name in given or ()):
        raise InputError(f"{what} must go by name, such as {example}; got {described(given)}")
    return given or {}


def as_progress(progress: Any) -> Callable[[str, int, int], None]:
    """Return what is told of the progress (what, done, total); nobody where it is None.

    Raises
    ------
    InputError
        If it cannot be called.
    """
    if progress is None:
        return lambda _what, _done, _total: None
    if not callable(progress):
        raise InputError(f"progress must be a function of (what, done, total), or None; got {described(progress)}")
    told: Callable[[str, int, int], None] = progress
    return told
