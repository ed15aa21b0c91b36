"""The study of one axis, as the body of its result file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from servolens.errors import InputError, ServolensError
from servolens.fleet.axes import inputs_digest, source_of
from servolens.fleet.request import Request
from servolens.results import envelope, to_finite

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servolens.study import Study

__all__ = ["KIND", "stopped", "studied"]

KIND = "fleet-axis"


def studied(job: Mapping[str, Any]) -> dict[str, Any]:
    """Return the result of one axis; whatever is wrong with it stands in its ``sentence``.

    Parameters
    ----------
    job : mapping
        ``name``, ``measured`` and ``path`` of the axis, ``folder`` of the fleet, and the ``request``'s fields.
    """
    request = Request(**job["request"])
    root = None if request.data_root is None else Path(request.data_root)
    known = {**_header(job, request), "inputs": inputs_digest(Path(job["path"]), root)}
    try:
        found = _study(job, request, root)
    except InputError as error:
        return _failed(known, "refused", f"{error}")
    except ServolensError as error:
        return _failed(known, "failed", f"{error}")
    except MemoryError:
        return _failed(known, "failed", "There is not enough memory for these records; give fewer or shorter ones")
    except Exception as error:  # one axis must not end the fleet
        return _failed(
            known, "failed", f"An unexpected {type(error).__name__}: this is a fault of servolens, not of the data"
        )
    record = found.records[0]
    body = {
        "status": "done",
        "sentence": None,
        "records": [one.name for one in found.records],
        "length_unit": record.length_unit,
        "command_unit": record.command_unit,
        "tuning": found.to_json(),
    }
    result: dict[str, Any] = to_finite(envelope(KIND, {**known, **body}, found.findings))
    return result


def stopped(job: Mapping[str, Any], sentence: str) -> dict[str, Any]:
    """Return the result of an axis whose process was ended."""
    request = Request(**job["request"])
    root = None if request.data_root is None else Path(request.data_root)
    known = {**_header(job, request), "inputs": inputs_digest(Path(job["path"]), root), "limits": request.limits}
    return _failed(known, "stopped", sentence)


def _study(job: Mapping[str, Any], request: Request, root: Path | None) -> Study:
    from servolens.campaign import read_records
    from servolens.identification import Prior
    from servolens.study import completed_spec, study_records

    source = source_of(Path(job["path"]), Path(job["folder"]), root)
    records = read_records(
        source, settings=request.settings, columns=request.columns, units=request.units, data_root=root
    )
    spec = completed_spec(records, request.spec) if request.spec else None
    priors = {name: Prior(value=mean, deviation=deviation) for name, (mean, deviation) in request.priors.items()}
    return study_records(records, spec, priors=priors, effort=request.effort)


def _header(job: Mapping[str, Any], request: Request) -> dict[str, Any]:
    return {"axis": job["name"], "measured": job["measured"] or None, "request": request.digest}


def _failed(known: Mapping[str, Any], status: str, sentence: str) -> dict[str, Any]:
    text = f"{sentence.rstrip('.')}."
    body: dict[str, Any] = {
        "status": status,
        "sentence": text,
        "records": [],
        "length_unit": None,
        "command_unit": None,
    }
    result: dict[str, Any] = to_finite(envelope(KIND, {**known, **body, "tuning": None}))
    return result
