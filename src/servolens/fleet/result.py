"""What the studies of a fleet found."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

from servolens.fleet.drift import Drift, drifts_of
from servolens.fleet.outliers import Outlier, outliers_of

if TYPE_CHECKING:
    from pathlib import Path

    from servolens.fleet.axes import Axis
    from servolens.fleet.rows import Row

__all__ = ["Fleet"]


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fleet:
    """Rows of all axes.

    Attributes
    ----------
    folder, out : Path
        Of the axes and of the results.
    axes : tuple of Axis
        In the order of names and dates.
    rows : tuple of dict
        One for each, see :func:`~servolens.fleet.row_of`.
    studied_now : int
        How many were studied in this run; the others were finished before.
    """

    folder: Path
    out: Path
    axes: tuple[Axis, ...]
    rows: tuple[Row, ...]
    studied_now: int

    @property
    def failed(self) -> tuple[Row, ...]:
        """Rows of axes without a study."""
        return tuple(row for row in self.rows if row["status"] != "done")

    @property
    def drifts(self) -> tuple[Drift, ...]:
        """Parameters that were measured on several dates, tested for a trend; the most significant first."""
        return drifts_of(self.rows)

    @property
    def outliers(self) -> tuple[Outlier, ...]:
        """Parameters that lie far from those of the other axes; the farthest first."""
        return outliers_of(self.rows)

    @property
    def causes(self) -> dict[str, int]:
        """In how many studies each cause was named, the most frequent first."""
        named = Counter(cause for row in self.rows for cause in str(row["causes"] or "").split("; ") if cause)
        return dict(sorted(named.items(), key=lambda item: (-item[1], item[0])))

    def count(self, column: str) -> dict[str, int]:
        """Return how many rows hold each value of a column."""
        return dict(sorted(Counter(str(row.get(column) or "none") for row in self.rows).items()))

    def to_json(self) -> dict[str, Any]:
        """Return the fields of ``servolens.fleet/1`` without the file's header."""
        return {
            "axes": len({row["axis"] for row in self.rows}),
            "studies": len(self.rows),
            "studied_now": self.studied_now,
            "status": self.count("status"),
            "verdicts": self.count("verdict"),
            "lights": {name: self.count(f"{name}_light") for name in ("data", "model", "gain")},
            "causes": self.causes,
            "drifts": [drift.to_json() for drift in self.drifts],
            "outliers": [outlier.to_json() for outlier in self.outliers],
            "rows": [
                {**row, "result": f"results/{axis.key}.json"} for axis, row in zip(self.axes, self.rows, strict=True)
            ],
        }
