"""What a gain has to achieve, as far as the records tell what their owner did not."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from servolens.design import PDSpec, evaluate
from servolens.design.extrapolation import BEYOND
from servolens.errors import InputError
from servolens.findings import Finding
from servolens.identification.segments import noise_level
from servolens.inputs import as_it_ran

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["completed_spec", "default_sentence", "design_notes", "suggested_spec"]

SAMPLING = ("sample_time", "derivative_filter", "derivative_window", "derivative")
GAINS_TRIED = 41
DEFAULTS = {
    ("kp", "reference"): "By default, kp and the step are those of {record}; --kp and --reference ask for others.",
    ("kp",): "By default, kp is that of {record}; --kp asks for another.",
    ("reference",): "By default, the step is that of {record}; --reference asks for another.",
}
"""What is said of a spec of which these fields are not given."""
LONGER = 4.0
"""Times as long a step is watched where none settles."""
SETTLING_SLACK = 1.25
"""The settling time asked for is the shortest that any gain reaches, times this, rounded up to two digits."""


def completed_spec(records: Sequence[Record], given: Mapping[str, Any]) -> PDSpec:
    """Return the spec with the `given` fields; of the loop and the step, what is missing is one record's.

    It is that with the largest kp, of several the one with the largest step: a step that was run with that kp. With a
    step or a kp that is given, one that shows at least so much is preferred. Where records differ in their inertia, it
    is one with the first that is stated, for which the model is.

    Parameters
    ----------
    records : sequence of Record
        Runs of one axis.
    given : mapping
        Fields of ``PDSpec``, the settling time among them.

    Raises
    ------
    InputError
        If no kp is given and the records state none, or a field is outside its range.

    Examples
    --------
    >>> from servolens import lab
    >>> runs = [lab.step_record(lab.NLM1, kp=kp) for kp in (60, 80)]
    >>> spec = completed_spec(runs, {"settling_time": 0.5})
    >>> spec.kp, spec.reference, spec.sample_time
    (80, 0.1, 0.001)
    """
    record = _shown(records, given)
    if record is None and "kp" not in given:
        raise InputError(_no_kp(records))
    known = {} if record is None else _loop_of(record)
    plain: dict[str, Any] = {name: value for name, value in known.items() if name in SAMPLING}
    if "controller" in given and given["controller"] != known.get("controller", "pd"):
        if "kp" not in given:
            raise InputError(f"the records were made in another loop than a {given['controller']}; give its kp")
        known = plain
    elif given.get("control") == "continuous" and "controller" not in known:
        known = {name: known[name] for name in ("kp", "sample_time") if name in known}
    if given.get("derivative") == "velocity":
        known.pop("derivative_window", None)  # there are no differences any more
    elif "derivative_window" in given and "derivative" not in given:
        known.pop("derivative", None)  # a window is one of differences
    return PDSpec(**{**known, **_step_of(records if record is None else [record]), **given})


def default_sentence(records: Sequence[Record], given: Mapping[str, Any]) -> str:
    """Return whose kp and step stand for those that are not `given`, as options of commands; empty for none."""
    record = _shown(records, given)
    if record is None:
        return ""
    is_known = {"kp": "kp" in given, "reference": "reference" in given or record.largest_step <= 0}
    told = DEFAULTS.get(tuple(name for name, known in is_known.items() if not known), "")
    return told.format(record=record.name)


def design_notes(records: Sequence[Record]) -> tuple[Finding, ...]:
    """Return for which moving inertia a gain is designed that is based on these records, where they differ in it."""
    stated = [record for record in records if record.inertia is not None]
    if len({record.inertia for record in stated}) < 2:
        return ()
    first = stated[0]
    what, unit = ("mass", "kg") if first.length_unit == "m" else ("moving inertia", "kg m²")
    message = (
        f"model and gain are for a {what} of {first.inertia:g} {unit}, that of {first.name}, the first record that"
        " states one. For another put a record with it first."
    )
    return (Finding(code="inertias_differ", severity="note", message=message),)


def suggested_spec(records: Sequence[Record], plant: Plant) -> PDSpec | None:
    """Return a spec for records whose owner asked for none: a settling time that the plant can reach.

    With the loop and the step of the record with the largest kp, as :func:`completed_spec`. The band is 1 % of the
    step, or three encoder steps where that is more. None where no loop is known, or none settles.
    """
    record = _shown(records, {})
    if record is None or plant.gain <= 0:
        return None
    fields = {**_loop_of(record), **_step_of([record])}
    step, sample_time = fields.get("reference", 0.0), fields["sample_time"]
    band = max(0.01, _round_up(3.0 * (record.encoder_resolution or 0.0) / step)) if step > 0 else 1.0
    if band >= 1:
        return None
    spec = _possible(**fields, band=band, settling_time=4 * sample_time)
    if spec is None:
        return None
    shortest, watched = None, max(12.0 / spec.rate(plant.gain), 4 * sample_time)
    while shortest is None:  # a lag or a limit makes an axis slower than its gain says, but not than its records show
        spec = _possible(**{**spec.to_json(), "settling_time": watched})
        if spec is None:
            return None
        shortest = _shortest(plant, spec)
        if shortest is None and watched >= record.duration:
            return None
        watched *= LONGER
    return _possible(**{**spec.to_json(), "settling_time": max(_round_up(SETTLING_SLACK * shortest), 4 * sample_time)})


def _shown(records: Sequence[Record], given: Mapping[str, Any]) -> Record | None:
    """Return the record whose loop and step stand for what is not given; None where none states a loop.

    Kp and step of different records together may ask for a voltage that none has shown.
    """

    def rank(record: Record) -> tuple[bool, bool, float, float]:
        kp, step = 0.0 if record.controller is None else record.controller.kp, BEYOND * record.largest_step
        shows = step >= abs(given.get("reference", 0.0)) and BEYOND * kp >= given.get("kp", 0.0)
        by_step = "kp" in given if shows else "reference" in given
        return (step > 0, shows, *((step, kp) if by_step else (kp, step)))

    loops = [record for record in records if record.controller is not None and record.controller.kp > 0]
    first = next((record.inertia for record in records if record.inertia is not None), None)
    alike = [record for record in loops if record.inertia in (None, first)]  # a model is for the first one's inertia
    return max(alike or loops, key=rank, default=None)


def _no_kp(records: Sequence[Record]) -> str:
    """Return why none of the records says for which kp to design, and what to do."""
    names = ", ".join(record.name for record in records[:3]) + (" and others" if len(records) > 3 else "")
    asked = "give the one to design for (on the command line --kp)"
    stated = [(record.controller.kp, record.name) for record in records if record.controller is not None]
    if not stated:
        return f"{names}: the records state no kp; {asked}, or that of the loop that made them (--record-kp)"
    kp, name = min(stated)
    if kp == 0.0:
        return f"{names}: the records state kp = 0, with which a loop follows no step; {asked}"
    return (
        f"{names}: a gain is designed for a positive kp, but {name} states kp = {kp:g}; if the axis moves against its"
        " voltage, change the signs of voltage, kp and kd in the log"
    )


def _loop_of(record: Record) -> dict[str, Any]:
    """Return the fields of the law of a record, but for the gain that is sought."""
    assert record.controller is not None  # noqa: S101 - chosen so
    loop, ran = record.controller, as_it_ran(record)
    fields: dict[str, Any] = {
        "kp": loop.kp,
        "sample_time": float(f"{loop.control_period or ran.sample_time:.6g}"),
        "derivative_filter": loop.derivative_filter,
        "derivative_window": 1 if loop.derivative == "velocity" else loop.derivative_window,
        "derivative": loop.derivative,
    }
    if loop.is_cascade and loop.kd > 0:
        speed = {"kp": float(f"{loop.kp / loop.kd:.9g}"), "kiv": float(f"{loop.integral_rate * loop.kd:.9g}")}
        return {**fields, **speed, "controller": "cascade", "anti_windup": loop.anti_windup}
    if loop.ki > 0:
        fields |= {"ki": loop.ki, "setpoint_weight": loop.setpoint_weight, "anti_windup": loop.anti_windup}
    return fields


def _step_of(records: Sequence[Record]) -> dict[str, float]:
    """Return the largest step, to three digits as its owner may have set it.

    One sample tells where an axis was that begins with its step: within its noise of 0, that was at 0.
    """
    if not records:
        return {}
    record = max(records, key=lambda one: one.largest_step)
    step, first = record.largest_step, float(record.position[0])
    if record.reference is not None and abs(first) <= 2.0 * noise_level(record):
        begins_with = abs(float(record.reference[0]))
        step = begins_with if step == abs(float(record.reference[0]) - first) else step
    return {"reference": float(f"{step:.3g}")} if step > 0 else {}


def _possible(**fields: Any) -> PDSpec | None:
    """Return the spec, or None where the axis is so slow or fast that it would be none."""
    try:
        return PDSpec(**fields)
    except InputError:
        return None


def _shortest(plant: Plant, spec: PDSpec) -> float | None:
    """Return the shortest settling time of any gain [s]."""
    natural = spec.rate(plant.gain)
    last = max(6.0 * natural - plant.damping, natural) / plant.gain
    found = (evaluate(plant, spec, float(kd)).settling_time for kd in np.linspace(0.0, last, GAINS_TRIED))
    return min((time for time in found if time), default=None)


def _round_up(value: float) -> float:
    """Round up to two significant digits."""
    if value <= 0:
        return 0.0
    power = math.floor(math.log10(value)) - 1
    return float(f"{math.ceil(value / 10.0**power - 1e-9) * 10.0**power:.6g}")
