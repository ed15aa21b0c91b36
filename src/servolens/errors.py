"""What can go wrong, each with a sentence that says what to do.

Wrong use raises a :class:`ServolensError`; its ``exit_status`` is what the command line ends with.
"""

from __future__ import annotations

__all__ = ["InputError", "NumericalError", "ServolensError"]


class ServolensError(Exception):
    """Base of every error servolens raises on purpose. The message is one sentence for people."""

    exit_status = 2


class InputError(ServolensError, ValueError):
    """What arrived cannot be used: a file, a value, an option."""


class NumericalError(ServolensError, ArithmeticError):
    """A computation that should have succeeded did not."""

    exit_status = 3
