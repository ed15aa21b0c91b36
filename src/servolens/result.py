"""What all results share: a plant, a summary, residuals, simulations, a figure, a table and a file."""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Self, Unpack

from servolens.decoding import json_of, whole
from servolens.errors import InputError
from servolens.results import write_json

if TYPE_CHECKING:
    import os

    import numpy as np
    import pandas as pd
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from servolens.inputs import Records, RecordSettings
    from servolens.plant import Plant
    from servolens.prediction import Prediction
    from servolens.summary import Summary

__all__ = ["Result", "late"]

MOST_SHOWN = 200
"""Letters of a path, or of a text, that a refusal quotes."""


class Result(ABC):
    """Base of fits, identifications, diagnoses, designs and predictions.

    What a result says to people is made in rooms above its own (:mod:`servolens.summaries`, :mod:`servolens.report`);
    they are called late, by the result's `kind`.

    Attributes
    ----------
    kind : str
        As in the schema of its file.
    """

    __slots__ = ()
    kind: ClassVar[str]

    @property
    @abstractmethod
    def plant(self) -> Plant:
        """The plant that was found, or that it is about."""

    @abstractmethod
    def to_json(self) -> dict[str, Any]:
        """Return the fields of its schema without the file's header."""

    @classmethod
    def from_json(cls, source: Mapping[str, Any] | str | os.PathLike[str]) -> Self:
        """Build the result from what :meth:`to_json` returned, from its text, or from a file that holds it.

        Files hold no records: what is simulated from them needs these again.

        Raises
        ------
        InputError
            If a field is missing or has the wrong type, or if the file is another result's.
        """
        with whole(f"not a whole {cls.kind}"):
            data = json_of(source)
            schema = data.get("schema")
            if schema is not None and schema != f"servolens.{cls.kind}/1":
                what = "it" if isinstance(source, Mapping) else str(source)[:MOST_SHOWN]
                raise InputError(
                    f"{what} is of schema {str(schema)[:40]!r}; {cls.__name__}.from_json reads 'servolens.{cls.kind}/1'"
                )
            return cls._read(data)

    @classmethod
    @abstractmethod
    def _read(cls, data: Mapping[str, Any]) -> Self:
        """Return the result whose file holds these `data`."""

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the JSON file that :meth:`from_json` reads, whole or not at all."""
        write_json(str(path), self.kind, self.to_json(), getattr(self, "findings", ()))

    def summary(self) -> Summary:
        """Return what the result says: sentences, tables and findings. ``print`` shows it, a notebook renders it."""
        summary: Summary = late("summaries.shown", "summary_of")(self)
        return summary

    def to_dataframe(self) -> pd.DataFrame:
        """Return the result's table; see :func:`servolens.summaries.frames.frame_of` for what each kind holds."""
        frame: pd.DataFrame = late("summaries.frames", "frame_of")(self)
        return frame

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the result's main figure and return its axes; on a new figure of pyplot's where `ax` is None."""
        axes: Axes = late("report.shown", "plot_result")(self, ax)
        return axes

    def simulate(self, records: Records = None, **settings: Unpack[RecordSettings]) -> Prediction:
        """Simulate the records, its own where none are given; see :func:`servolens.predict`."""
        own = getattr(self, "records", ())
        if records is None and not own:
            raise InputError(
                f"this {self.kind} holds no records: it was made from plants or models, or read from a file; pass the"
                " records to simulate"
            )
        found: Prediction = late("prediction", "predict")(self, own if records is None else records, **settings)
        return found

    def residuals(self, records: Records = None, **settings: Unpack[RecordSettings]) -> tuple[NDArray[np.float64], ...]:
        """Return simulated minus measured position [m or rad], an array for each of the records."""
        return self.simulate(records, **settings).residuals()

    def __repr__(self) -> str:
        """Return one line: the kind and the most important sentence."""
        summary = self.summary()
        return f"<{type(self).__name__}: {' '.join((*summary.sentences, summary.title)[:1])}>"

    def _repr_html_(self) -> str:
        """Return the summary for a notebook."""
        return self.summary()._repr_html_()


def late(room: str, name: str) -> Any:
    """Return a function of a room above, which is loaded now."""
    return getattr(importlib.import_module(f"servolens.{room}"), name)
