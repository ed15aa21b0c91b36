"""Numbers of a diagnosis as its file holds them: finite, or null beside the reason."""

from __future__ import annotations

import math
from typing import Any

__all__ = ["LOST", "finite"]

LOST = "a record cannot be simulated with this model, or its simulation diverges"
"""Why an error is not finite."""


def finite(fields: dict[str, Any]) -> dict[str, Any]:
    """Return `fields` with null for numbers that are not finite, in lists too, and then with a ``reason``.

    Examples
    --------
    >>> finite({"train": [float("inf"), 0.1]})["train"]
    [None, 0.1]
    """
    found = {name: _finite(value) for name, value in fields.items()}
    return found if found == fields else {**found, "reason": LOST}


def _finite(value: Any) -> Any:
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
