"""What a diagnosis, and the experiment it proposes, say."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from servolens.diagnosis.logs import is_blamed
from servolens.summaries.wording import listed, number, percent, plus_minus, scale, unit
from servolens.summary import Summary, Table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.diagnosis.evidence import Share
    from servolens.diagnosis.next_experiment import Experiment
    from servolens.diagnosis.result import Cause, Diagnosis
    from servolens.model import Quantity

__all__ = ["cause_phrase", "diagnosis_summary", "experiment_sentence", "experiment_summary", "spoken"]

TELLING = 0.2
"""By how much the share of the error in a range must exceed its share of the samples to be worth a sentence."""
CANDIDATES = 5
PLACES = ("speed", "direction", "position", "time_since_step", "voltage", "frequency")
"""Quantities by how much they tell people; the first is taken of those that come close to the best."""
CLOSE = 0.2
NAMES = {
    "gain_and_damping": "gain and damping alone",
    "coulomb_friction": "Coulomb friction",
    "stribeck_friction": "Stribeck friction",
    "presliding": "presliding friction",
    "asymmetric_friction": "friction that differs by direction",
    "asymmetric_damping": "damping that differs by direction",
    "position_friction": "a tight spot",
    "velocity_decay_damping": "damping that falls with speed",
    "pendulum_gravity": "gravity on a pendulum",
    "constant_force": "a constant force",
    "return_spring": "a spring",
    "hardening_spring": "a hardening spring",
    "periodic_disturbance": "a periodic disturbance",
    "gain_drift": "a gain that drifts",
    "dead_zone": "a dead zone",
    "delay": "a delay",
    "actuator_lag": "a lag of the actuator",
    "sensor_lag": "a lag of the sensor",
    "force_limit": "a limit of force",
    "speed_servo": "a speed loop in the drive",
    "flexible_coupling": "a flexible coupling",
}
"""Where the effect's name, with spaces for underscores, is not what people say."""
PREFIXED = ("s", "m", "rad", "m/s", "rad/s", "m/s^2", "rad/s^2")
"""Units of which people write thousandths with a prefix."""


def diagnosis_summary(diagnosis: Diagnosis) -> Summary:
    """Tell what is wrong, why and what knowing it is worth; then each cause, its remedy, and what is still open.

    Parameters
    ----------
    diagnosis : Diagnosis
        Of one axis.
    """
    sentences = [*_first_the_log(diagnosis), _verdict(diagnosis), *_left(diagnosis)]
    for cause in diagnosis.causes:
        sentences += _advice(cause, diagnosis)
    sentences += _next(diagnosis)
    tables = [_causes(diagnosis)] if diagnosis.causes else []
    names = listed([record.name for record in diagnosis.records])
    return Summary(
        title=f"Diagnosis of {names}: {diagnosis.verdict.replace('_', ' ')}",
        sentences=tuple(sentences),
        tables=(*tables, _records(diagnosis), *_candidates(diagnosis)),
        findings=diagnosis.findings,
    )


def experiment_summary(experiment: Experiment, *, length_unit: str, command_unit: str) -> Summary:
    """Tell the experiment to log next, in a sentence and as settings.

    Parameters
    ----------
    experiment : Experiment
        What was found.
    length_unit, command_unit : str
        Of the plant.
    """
    factor, length = scale([experiment.start, experiment.reference], length_unit)
    rows = (
        (f"kp [{command_unit}/{length_unit}]", number(experiment.kp)),
        (f"kd [{command_unit} s/{length_unit}]", number(experiment.kd)),
        (f"From [{length}]", number(factor * experiment.start)),
        (f"To [{length}]", number(factor * experiment.reference)),
        ("And back", "yes" if experiment.back else "no"),
        ("Time at each level [s]", number(experiment.duration)),
        ("Sample time [ms]", number(1e3 * experiment.sample_time)),
    )
    return Summary(
        title="Next experiment",
        sentences=(experiment_sentence(experiment, length_unit, command_unit),),
        tables=(Table(title="Settings", columns=("Setting", "Value"), rows=rows),),
    )


def experiment_sentence(experiment: Experiment, length_unit: str, command_unit: str) -> str:
    """Return what to log next and what it tells apart."""
    factor, length = scale([experiment.start, experiment.reference], length_unit)
    first, second = (spoken(name) for name in experiment.separates)
    step = f"a step from {number(factor * experiment.start)} to {number(factor * experiment.reference)} {length}"
    gains = f"kp = {number(experiment.kp)} {command_unit}/{length_unit}"
    gains += f" and kd = {number(experiment.kd)} {command_unit} s/{length_unit}" if experiment.kd else " without kd"
    return (
        f"Log next {step}{' and back' if experiment.back else ''} with {gains}: there {first} and {second} differ by"
        f" {number(experiment.separation, 2)} times the noise."
    )


def spoken(name: str) -> str:
    """Return an effect's name as people say it.

    Examples
    --------
    >>> spoken("coulomb_friction"), spoken("backlash"), spoken("without delay")
    ('Coulomb friction', 'backlash', 'without delay')
    """
    return NAMES.get(name, name.replace("_", " "))


def cause_phrase(cause: Cause) -> str:
    """Return a cause with its parameters: name and value ± error, each with its unit."""
    values = [_value(quantity) for quantity in cause.quantities.values()]
    if len(values) == 1:
        return f"{spoken(cause.effect)}, {values[0]}"
    named = [f"{name.replace('_', ' ')} {value}" for name, value in zip(cause.quantities, values, strict=True)]
    return f"{spoken(cause.effect)} ({', '.join(named)})"


def _verdict(diagnosis: Diagnosis) -> str:
    """Return the sentence that matters most."""
    unit_ = diagnosis.plant.length_unit
    if diagnosis.verdict == "healthy" and any(finding.code == "small_remainder" for finding in diagnosis.findings):
        return (
            f"Gain and damping leave {_length(_error(diagnosis, after=False), unit_)}{_data(diagnosis)}, more than the"
            f" noise of {_length(diagnosis.noise_floor, unit_)} but little: nothing in the catalogue explains it."
        )
    if diagnosis.verdict == "healthy":
        return (
            f"Gain and damping explain these records down to their noise, {_length(diagnosis.noise_floor, unit_)}:"
            " nothing else is wrong that they could show."
        )
    if diagnosis.verdict == "unexplained":
        where = _where(diagnosis)
        return _capital(
            f"{where}nothing in the catalogue explains {'it' if where else 'the error'}: a model of gain and damping is"
            f" {_length(_error(diagnosis, after=False), unit_)} off{_data(diagnosis)}, and no effect that was tried"
            " makes that much better."
        )
    part = "" if diagnosis.verdict == "explained" else "part of "
    causes = [cause_phrase(cause) for cause in diagnosis.causes]
    what = "cause is" if len(causes) == 1 else "causes are"
    names = listed(causes) if len(causes) > 1 else causes[0]
    start = f"{_where(diagnosis)}the {what} " if not part else _part(diagnosis)
    before, after = (_error(diagnosis, after=flag) for flag in (False, True))
    held = "held-out " if diagnosis.extended.heldout_rms_error is not None else ""
    return _capital(
        f"{start}{names}; with {'it' if len(causes) == 1 else 'them'} the {held}error falls from"
        f" {_length(before, unit_)} to {_length(after, unit_)}."
    )


def _first_the_log(diagnosis: Diagnosis) -> list[str]:
    """Say what the logs themselves have wrong, before physics is blamed."""
    blamed = [finding for finding in diagnosis.findings if is_blamed(finding)]
    if not blamed:
        return []
    more = f" ({len(blamed) - 1} more such doubts below)" if len(blamed) > 1 else ""
    return [f"First the log: {blamed[0].record}: {blamed[0].message.rstrip('.')}{more}. What follows may come of it."]


def _part(diagnosis: Diagnosis) -> str:
    where = _where(diagnosis)
    return f"{where}part of it is explained by " if where else "part of the error is explained by "


def _left(diagnosis: Diagnosis) -> list[str]:
    """Say what remains, where something does."""
    if diagnosis.verdict not in ("partly_explained", "unexplained"):
        return []
    unit_, floor = diagnosis.plant.length_unit, diagnosis.noise_floor
    if any(finding.code == "heldout_contradicts" for finding in diagnosis.findings):
        return ["Records that were held out are much farther off than those that were fitted: see the doubts below."]
    if diagnosis.remainder == 0.0:
        return ["Driven by their voltage the records leave nothing but noise, but that is not borne out otherwise."]
    share = f", {number(diagnosis.remainder / floor, 2)} times the noise of {_length(floor, unit_)}" if floor else ""
    rest = f"What remains, {_length(diagnosis.remainder, unit_)}{share}, is no noise"
    if diagnosis.verdict == "partly_explained":
        return [f"{rest}: something else is wrong too, and the causes below may stand for it in part."]
    doubts = ", and at the doubts below about the logs," if diagnosis.findings else ""
    return [f"{rest}. Look at where the error arises{doubts} before tuning."]


def _advice(cause: Cause, diagnosis: Diagnosis) -> list[str]:
    """Return what the cause looks like, what to do, what it means for the gain, and what it may be instead."""
    kind = cause.kind
    name = _capital(spoken(cause.effect))
    told = [f"{name}: {kind.looks_like or kind.sentence}"]
    told += [f"What to do: {kind.remedy}"] if kind.remedy else []
    told += [f"For the PD gain: {kind.for_the_gain}"] if kind.for_the_gain else []
    if cause.rivals:
        others = listed([spoken(rival) for rival in cause.rivals])
        told.append(f"These data cannot tell {spoken(cause.effect)} from {others}.")
    return told


def _next(diagnosis: Diagnosis) -> list[str]:
    """Return what to log next where causes have rivals."""
    plant = diagnosis.plant
    if diagnosis.next_experiment is not None:
        return [experiment_sentence(diagnosis.next_experiment, plant.length_unit, plant.command_unit)]
    if any(cause.rivals for cause in diagnosis.causes):
        return ["No safe step like those logged would tell them apart; look at the machine, or measure something else."]
    return []


def _where(diagnosis: Diagnosis) -> str:
    """Return the beginning of a sentence about where the error arises; empty if it arises everywhere."""
    telling = [share for share in diagnosis.where if _is_telling(share)]
    if not telling:
        return ""
    most = max(share.share_of_error - share.share_of_samples for share in telling)
    close = [share for share in telling if share.share_of_error - share.share_of_samples >= most - CLOSE]
    share = min(close, key=lambda share: PLACES.index(share.quantity) if share.quantity in PLACES else len(PLACES))
    return f"{number(100 * share.share_of_error, 2)} % of the error arises {_range(share)}; "


def _is_telling(share: Share) -> bool:
    """Tell whether the range says something; that an error is slow, every error of a model is."""
    slow = share.quantity == "frequency" and share.low <= share.bins[0][0]
    return not slow and share.share_of_error - share.share_of_samples >= TELLING


def _range(share: Share) -> str:
    """Return a range of a measured quantity as people say it."""
    factor, unit_ = _scaled([share.low, share.high], share.unit)
    low, high = number(factor * share.low, 2), number(factor * share.high, 2)
    from_start, to_end = share.low <= share.bins[0][0], share.high >= share.bins[-1][1]
    if share.quantity == "direction":
        return "in forward motion" if to_end else "in backward motion" if from_start else "at rest"
    if share.quantity == "time_since_step":
        return (
            f"in the first {high} {unit_} after the step" if from_start else f"{low} to {high} {unit_} after the step"
        )
    at = {"speed": "", "frequency": ""}.get(share.quantity, f"at a {share.quantity} ")
    if from_start != to_end:
        return f"{at}below {high} {unit_}" if from_start else f"{at}above {low} {unit_}"
    return f"{at}between {low} and {high} {unit_}"


def _causes(diagnosis: Diagnosis) -> Table:
    rows = []
    for cause in diagnosis.causes:
        rivals = ", ".join(cause.rivals) or "none"
        for i, (name, quantity) in enumerate(cause.quantities.items()):
            first = i == 0
            rows.append(
                (
                    f"{cause.effect} {name}",
                    plus_minus(quantity),
                    unit(quantity.unit) if quantity.unit != "1" else "",
                    percent(100 * cause.confidence) if first else "",
                    rivals if first else "",
                )
            )
    return Table(
        title="Causes, in the order found",
        columns=("Parameter", "Value ± standard error", "Unit", "Confidence", "Rivals"),
        rows=tuple(rows),
        note="Confidence: how likely the cause is among what was tried. Rivals: what these data cannot tell from it.",
    )


def _records(diagnosis: Diagnosis) -> Table:
    factor, length = scale([gain.before for gain in diagnosis.gains], diagnosis.plant.length_unit)
    rows = [
        (
            gain.name,
            number(factor * gain.before, 3),
            number(factor * gain.after, 3),
            number(factor * gain.noise, 2),
            "held out" if gain.heldout else "used",
        )
        for gain in diagnosis.gains
    ]
    return Table(
        title=f"R.m.s. error without and with the causes [{length}]",
        columns=("Record", "Before", "After", "Noise", "Data"),
        rows=tuple(rows),
        note=_meaning_of_held_out(diagnosis),
    )


def _meaning_of_held_out(diagnosis: Diagnosis) -> str:
    if diagnosis.heldout:
        return "Held out: the record took no part in fit and choice."
    if len(diagnosis.records) > 1:
        return "Held out: each record by the model fitted without it."
    return "Held out: the end of the record, by the model fitted to its beginning."


def _candidates(diagnosis: Diagnosis) -> list[Table]:
    """Return the best single effects and what each leaves."""
    best = [*{candidate.effects: candidate for candidate in reversed(diagnosis.candidates)}.values()]
    best = sorted(best, key=lambda candidate: candidate.error)[:CANDIDATES]
    if not best:
        return []
    floor = max(diagnosis.noise_floor, 1e-300)
    factor, length = scale([candidate.error for candidate in best], diagnosis.plant.length_unit)
    rows = [
        (" + ".join(candidate.effects), number(factor * candidate.error, 3), number(candidate.error / floor, 3))
        for candidate in best
    ]
    return [
        Table(
            title="Best single effects beside gain and damping",
            columns=("Effect", f"Leaves [{length}]", "In units of the noise"),
            rows=tuple(rows),
            note="R.m.s. of what is left of the training records, driven by their voltage.",
        )
    ]


def _error(diagnosis: Diagnosis, *, after: bool) -> float:
    errors = diagnosis.extended if after else diagnosis.baseline
    return errors.rms_error if errors.heldout_rms_error is None else errors.heldout_rms_error


def _data(diagnosis: Diagnosis) -> str:
    return "" if diagnosis.baseline.heldout_rms_error is None else " on held-out data"


def _length(value: float, length_unit: str) -> str:
    """Return a length or angle with two digits and the prefix that suits it."""
    if not math.isfinite(value):
        return "more than can be said"
    factor, unit_ = scale([value], length_unit)
    return f"{number(float(f'{factor * value:.1e}'), 2)} {unit_}"


def _value(quantity: Quantity) -> str:
    """Return value ± error to the one digit of the error that matters, with a prefix where the value is small."""
    factor, unit_ = _scaled([quantity.value], quantity.unit)
    shown = "" if unit_ == "1" else f" {unit(unit_)}"
    value, error = factor * quantity.value, factor * (quantity.stderr or 0.0)
    if error <= 0 or not math.isfinite(error):
        return f"{number(value)}{shown}"
    leading, exponent = f"{error:.0e}".split("e")
    decimals = max((leading == "1") - int(exponent), 0)
    return f"{value:.{decimals}f} ± {error:.{decimals}f}{shown}"


def _scaled(values: Sequence[float], text: str) -> tuple[float, str]:
    """Return factor and unit in which the largest of `values` is at least about 1, down to billionths."""
    largest = max((abs(v) for v in values if math.isfinite(v)), default=0.0)
    if text not in PREFIXED or largest == 0:
        return 1.0, text
    for factor, prefix in ((1.0, ""), (1e3, "m"), (1e6, "µ"), (1e9, "n")):
        if largest * factor >= (0.1 if factor == 1.0 and text not in ("m", "rad", "s") else 0.5):
            return factor, prefix + text
    return 1e9, f"n{text}"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
