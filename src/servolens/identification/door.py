"""What every identification checks first."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servolens.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from servolens.identification.integral import Prior

__all__ = ["check_names", "check_priors"]


def check_priors(priors: Mapping[str, Prior], parameters: Iterable[str]) -> None:
    """Refuse a prior on what is no parameter of the model.

    Raises
    ------
    InputError
        With the names that are.
    """
    known = list(parameters)
    for name in priors:
        if name not in known:
            raise InputError(f"a prior on {name[:40]!r} is not possible; known are {', '.join(known)}")


def check_names(names: Iterable[str], parameters: Iterable[str]) -> None:
    """Refuse what is no parameter of the model.

    Raises
    ------
    InputError
        With the names that are.
    """
    known = list(parameters)
    for name in names:
        if name not in known:
            raise InputError(f"{name[:40]!r} is no parameter of this model; those are {', '.join(known)}")
