"""Streams of Klipper's data logger (``motan``): sensors beside the moves that were commanded."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from servolens.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Values = NDArray[np.float64]

__all__ = ["stream_tree"]

AXES = ("x", "y", "z")
MOVES_QUERY, STEPS_QUERY = "trapq:", "stepq:"
"""Queries of the moves (time, duration, speed, acceleration, position, direction), and of the motors' steps."""
ANGLE_COLUMN = {"angle": "angle [counts]"}
"""The magnetic sensor's angle is in counts, 65 536 a revolution."""


def stream_tree(messages: Sequence[Any]) -> dict[str, Any]:
    """Return the rows of each query of a stream below the header that its subscription was answered with.

    The commanded place of each axis that moves stands as a column beside what a sensor measured, at its instants: it
    follows from the moves, which begin at a time with a speed and have a constant acceleration.

    Raises
    ------
    InputError
        If the moves are damaged, or nothing was measured beside them.
    """
    found = _queries(messages)
    moves = [rows["data"] for name, rows in found.items() if name == f"{MOVES_QUERY}toolhead"]
    sensors = {name: rows for name, rows in found.items() if not name.startswith((MOVES_QUERY, STEPS_QUERY))}
    if found and not any(rows["data"] for rows in sensors.values()):
        raise InputError("is Klipper's log of commanded moves alone; log a sensor that measures the axis, as [angle]")
    for rows in sensors.values():
        header = [ANGLE_COLUMN.get(name, name) if isinstance(name, str) else name for name in rows.get("header", ())]
        if header:
            rows["header"] = header
        if moves and moves[0] and "time" in header:
            _add_targets(rows, header.index("time"), moves[0])
    return sensors


def _queries(messages: Sequence[Any]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for message in messages:
        if not isinstance(message, dict):
            continue
        result, query, params = message.get("result"), message.get("q"), message.get("params")
        if isinstance(result, dict) and isinstance(result.get("header"), list):
            found[str(message.get("id"))] = {"header": result["header"], "data": []}
        elif isinstance(params, dict) and isinstance(params.get("data"), list):
            found.setdefault(str(query), {"data": []})["data"] += params["data"]
    return found


def _add_targets(rows: dict[str, Any], clock: int, moves: Sequence[Any]) -> None:
    """Append the commanded places of the axes that move to the rows of a sensor."""
    try:
        time = np.array([row[clock] for row in rows["data"]], dtype=np.float64)
        places = _commanded(moves, time)
    except (TypeError, ValueError, LookupError, OverflowError) as error:
        raise InputError("is Klipper's log with damaged rows; log it again") from error
    moving = [k for k in range(len(AXES)) if np.ptp(places[:, k]) > 0]
    rows["header"] = [*rows["header"], *(f"target {AXES[k]} [mm]" for k in moving)]
    rows["data"] = [[*row, *place] for row, place in zip(rows["data"], places[:, moving].tolist(), strict=True)]


def _commanded(moves: Sequence[Any], time: Values) -> Values:
    """Return the commanded x, y and z [mm] at the instants of `time`, shape (n, 3)."""
    begin, duration, speed, acceleration = np.array([move[:4] for move in moves], dtype=np.float64).T
    start = np.array([move[4] for move in moves], dtype=np.float64)
    direction = np.array([move[5] for move in moves], dtype=np.float64)
    if start.shape != (begin.size, 3) or direction.shape != start.shape or np.any(np.diff(begin) < 0):
        raise ValueError
    now = np.clip(np.searchsorted(begin, time, side="right") - 1, 0, None)
    within = np.clip(time - begin[now], 0.0, duration[now])
    way = (speed[now] + 0.5 * acceleration[now] * within) * within
    return np.asarray(start[now] + way[:, np.newaxis] * direction[now], dtype=np.float64)
