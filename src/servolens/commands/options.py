"""What commands have in common: records with their options, a design's specification, result files."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import wraps
from typing import TYPE_CHECKING, Any, final

import click

from servolens.commands.parsing import Documented, Paths, finite, named

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping

    Command = Callable[..., int]

__all__ = [
    "Documented",
    "Paths",
    "Recordings",
    "SpecOptions",
    "effort_option",
    "finite",
    "force_option",
    "heldout_option",
    "json_option",
    "prior_option",
    "recordings",
    "references_option",
    "several_gains",
    "specification",
    "stacked",
]

SPEC_FIELDS = (
    "kp",
    "settling_time",
    "band",
    "reference",
    "overshoot",
    "voltage_limit",
    "kd_max",
    "control",
    "sample_time",
    "derivative_filter",
    "derivative_window",
    "derivative",
    "controller",
    "ki",
    "setpoint_weight",
    "kiv",
    "anti_windup",
    "hunting",
    "peak_sensitivity",
    "peak_complementary",
    "delay_margin",
)
WISHES = (
    "free",
    "objective",
    "voltage_noise",
    "position_noise",
    "scenarios",
)
SIGNALS = ("time", "position", "reference", "voltage", "velocity", "feedforward", "enabled")


def _prior(value: str) -> tuple[str, float, float]:
    """Convert ``parameter=mean,deviation``."""
    name, mark, numbers = value.partition("=")
    mean, comma, deviation = numbers.partition(",")
    if not (mark and comma):
        raise click.BadParameter(f"{value[:40]!r} is not NAME=MEAN,SD, e.g. gain=45,2")
    return name.strip(), finite(mean), finite(deviation)


def _setting(value: str) -> str:
    """Check for a number, perhaps with a unit behind it that the reader converts."""
    finite(value.strip().partition(" ")[0])
    return value


def _mapped(value: str) -> tuple[str, str]:
    """Convert ``signal=text``."""
    signal, mark, text = (part.strip() for part in value.partition("="))
    if not mark or not text:
        raise click.BadParameter(f"{value[:40]!r} is not SIGNAL=NAME or SIGNAL=UNIT, e.g. position=qm or position=mm")
    if signal not in SIGNALS:
        raise click.BadParameter(f"{signal[:40]!r} is no signal; known are {', '.join(SIGNALS)}")
    return signal, text


def _ordered(value: str) -> dict[str, str]:
    """Convert signals in the order of the columns to their columns' numbers."""
    names = [name.strip() for name in value.split(",")]
    wrong = next((name for name in names if name not in (*SIGNALS, "-", "")), None)
    if wrong is not None:
        raise click.BadParameter(f"{wrong[:40]!r} is no signal; known are {', '.join(SIGNALS)}, and - for others")
    given = [name for name in names if name in SIGNALS]
    if len(set(given)) < len(given):
        raise click.BadParameter("a signal stands twice; keep one")
    absent = dict.fromkeys((name for name in SIGNALS if name not in ("time", "position")), "-")
    return absent | {name: str(k) for k, name in enumerate(names, start=1) if name in SIGNALS}


def _keyed(value: str) -> tuple[str, str]:
    """Convert ``key=value``."""
    key, mark, text = (part.strip() for part in value.partition("="))
    if not mark or not key or not text:
        raise click.BadParameter(f"{value[:40]!r} is not KEY=VALUE, e.g. supply_voltage=24")
    return key, text


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Recordings:
    """Records as they were named on the command line.

    Attributes
    ----------
    paths : tuple of str
        Files, folders, campaigns.
    settings : mapping
        ``kp``, ``kd``, ``reference`` and others where given.
    columns, units : mapping
        Signal to column name, signal to unit.
    data_root : str or None
        Folder that a campaign's files may not leave.
    """

    paths: tuple[str, ...]
    settings: Mapping[str, object]
    columns: Mapping[str, str]
    units: Mapping[str, str]
    data_root: str | None


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class SpecOptions:
    """A design's specification as it was given; the library checks it.

    Attributes
    ----------
    given : mapping
        Fields of ``PDSpec``.
    """

    given: Mapping[str, Any]


def recordings(
    *,
    kp: tuple[str, ...] = ("--record-kp", "--kp"),
    kd: tuple[str, ...] = ("--record-kd", "--kd"),
    folder: bool = False,
) -> Callable[[Command], Command]:
    """Give a command the argument ``RECORD…`` and its options, as one ``recordings``.

    Parameters
    ----------
    kp, kd : tuple of str
        How the gains of the loop that made the records are called: in every command ``--record-kp``; the short
        form too where nothing is designed.
    folder : bool
        Whether the argument is one ``FOLDER`` of them.
    """
    argument = ("FOLDER", 1) if folder else ("RECORD...", -1)
    decorators: tuple[Callable[[Command], Command], ...] = (
        click.argument("records", nargs=argument[1], required=True, metavar=argument[0]),
        *_record_options(kp, kd),
    )

    def decorate(command: Command) -> Command:
        @wraps(command)
        def run(**options: Any) -> int:
            gains = {
                "kp": options.pop("record_kp"),
                "kd": options.pop("record_kd"),
                "reference": options.pop("reference_step"),
                "reference_file": options.pop("reference_file"),
            }
            stated = {name: value for name, value in gains.items() if value is not None}
            ordered = options.pop("column_order") or {}
            chosen = Recordings(
                paths=named(_several(options.pop("records"))),
                settings=_once(options.pop("setting"), "--setting") | stated,
                columns=ordered | _once(options.pop("column"), "--column"),
                units=_once(options.pop("unit"), "--unit"),
                data_root=options.pop("data_root"),
            )
            return command(recordings=chosen, **options)

        return stacked(run, decorators)

    return decorate


def specification(
    *, required: Collection[str] = ("--kp", "--settling-time"), of_records: bool = False
) -> Callable[[Command], Command]:
    """Give a command the options of a design, as one ``spec``.

    Parameters
    ----------
    required : collection of str
        Options that must be given.
    of_records : bool
        Whether the loop of the records stands for what is not given.
    """
    records = "that of the records, else " if of_records else ""
    decorators: tuple[Callable[[Command], Command], ...] = (
        _number(
            "--kp", "Proportional gain to design for [V/m or V/rad]; of a cascade [1/s].", required="--kp" in required
        ),
        _number(
            "--settling-time",
            "Time from which on the position stays in the band [s].",
            required="--settling-time" in required,
        ),
        _number("--band", "Half width of the band as a fraction of the step.  [default: 0.01]"),
        _number("--reference", "Size of the step [m or rad].  [default: that of the records, else 0.1]"),
        _number("--overshoot", "Largest overshoot as a fraction of the step."),
        _number("--voltage-limit", "Largest voltage that the controller may ask for [V]."),
        _number("--kd-max", "End of the search, which begins at 0.  [default: from the plant]"),
        _choice("--control", ["sampled", "continuous"], "A digital loop, or an ideal PD.  [default: sampled]"),
        _number("--sample-time", f"Sample time of the digital loop [s].  [default: {records}0.001]"),
        _number("--derivative-filter", f"Filter of its derivative, up to 1, which is none.  [default: {records}1]"),
        _choice(
            "--derivative",
            ["position", "velocity"],
            f"Differences of the position, or a velocity signal.  [default: {records}position]",
        ),
        _number("--derivative-window", f"Samples that such a difference spans.  [default: {records}1]"),
        *_law(records),
        _number("--peak-sensitivity", "Largest peak of the sensitivity, Ms, of the linearised loop."),
        _number("--peak-complementary", "Largest peak of the complementary sensitivity, Mt, of the linearised loop."),
        _number("--delay-margin", "Least extra delay that the linearised loop must tolerate [s]."),
    )

    def decorate(command: Command) -> Command:
        @wraps(command)
        def run(**options: Any) -> int:
            given = {name: options.pop(name) for name in SPEC_FIELDS}
            return command(
                spec=SpecOptions(given={name: value for name, value in given.items() if value is not None}), **options
            )

        return stacked(run, decorators)

    return decorate


def several_gains() -> Callable[[Command], Command]:
    """Give a command the options of a design with several free gains, as one ``wishes``; None where none is given."""
    decorators = (
        click.option(
            "--free",
            cls=Paths,
            multiple=True,
            metavar="GAIN...",
            help="Gains to choose: kp, kd, derivative_filter, ki; of a cascade kp, kv, derivative_filter, kiv."
            "  [default with --objective: kp kd]",
        ),
        click.option(
            "--objective",
            type=click.Choice(["noise", "kd", "settling_time", "margin"]),
            help="What the free gains minimise or maximise.  [default with --free: noise]",
        ),
        _number("--voltage-noise", "With --free: largest r.m.s. noise of the command [V]."),
        click.option(
            "--scenarios",
            type=click.IntRange(min=0),
            metavar="NUMBER",
            help="With --free: number of uncertain plants that must meet the specification too.  [default: 100]",
        ),
        _number("--position-noise", "R.m.s. of the measurement noise [m or rad].  [default: that of the records]"),
    )

    def decorate(command: Command) -> Command:
        @wraps(command)
        def run(**options: Any) -> int:
            given = {name: options.pop(name) for name in WISHES}
            given = {name: value for name, value in given.items() if value is not None and value != ()}
            if given and not {"free", "objective"} & set(given):
                option = next(iter(given)).replace("_", "-")
                raise click.UsageError(f"--{option} is for free gains; add --free kp kd or --objective")
            return command(wishes=given or None, **options)

        return stacked(run, decorators)

    return decorate


def _law(records: str) -> tuple[Callable[[Command], Command], ...]:
    """Return the options of other loops than PD; `records` tells where what is not given comes from."""
    return (
        _number("--ki", f"Integral gain of a PID [V/(m s)].  [default: {records}0]"),
        _number("--setpoint-weight", f"Share of the reference in the proportional part.  [default: {records}1]"),
        click.option(
            "--cascade",
            "controller",
            flag_value="cascade",
            default=None,
            help="P control of the position (--kp), PI control of the speed; kv, the gain of the latter, is designed.",
        ),
        _number("--kiv", f"Integral gain of the speed loop [V/m].  [default: {records}0]"),
        _choice(
            "--anti-windup",
            ["none", "clamping", "back_calculation"],
            f"How the integral is stopped at the voltage limit.  [default: {records}none]",
        ),
        click.option(
            "--no-hunting",
            "hunting",
            flag_value=False,
            type=bool,
            default=None,
            help="Only gains with which the axis comes to rest from all starts that are tried.",
        ),
    )


json_option = click.option(
    "--json", "json_file", metavar="FILE", help="Write the machine-readable result; - is standard output."
)

prior_option = click.option(
    "--prior",
    "priors",
    multiple=True,
    type=_prior,
    metavar="NAME=MEAN,SD",
    help="Data-sheet knowledge: gain=45,2. May be repeated.",
)

heldout_option = click.option(
    "--heldout",
    cls=Paths,
    multiple=True,
    metavar="RECORD...",
    help="Records that only test what was found: every path up to the next option. May be repeated.",
)

effort_option = click.option(
    "--effort",
    type=click.Choice(["quick", "normal", "thorough"]),
    default="normal",
    show_default=True,
    help="How far the search for causes goes.",
)

references_option = click.option(
    "--also-reference",
    "references",
    multiple=True,
    type=finite,
    metavar="NUMBER",
    help="Another step that the recommended gain has to meet too [m or rad]. May be repeated.",
)

force_option = click.option(
    "--force", is_flag=True, help="Write the model although a sign or a unit in the records is wrong."
)


def _record_options(kp: tuple[str, ...], kd: tuple[str, ...]) -> tuple[Callable[[Command], Command], ...]:
    return (
        click.option(
            *kp,
            "record_kp",
            type=_setting,
            metavar="NUMBER",
            help="Proportional gain of the loop that made the records.",
        ),
        click.option(*kd, "record_kd", type=_setting, metavar="NUMBER", help="Its derivative gain."),
        click.option(
            "--column", multiple=True, type=_mapped, metavar="SIGNAL=NAME", help="Column of a signal: position=qm."
        ),
        click.option(
            "--unit", multiple=True, type=_mapped, metavar="SIGNAL=UNIT", help="Unit of a column: position=mm."
        ),
        click.option(
            "--columns",
            "column_order",
            type=_ordered,
            metavar="SIGNAL,...",
            help="Signals in the order of the columns, - for others: time,position,-,voltage.",
        ),
        click.option(
            "--reference-step",
            metavar="LEVEL[@TIME],...",
            help="A reference that was not logged: 0.1@0.5 is 0.1 from 0.5 s on, 0 before.",
        ),
        click.option(
            "--reference-file",
            metavar="FILE",
            type=os.path.abspath,
            help="The same from a file of two columns, time and reference; each value holds until the next.",
        ),
        click.option(
            "--setting",
            multiple=True,
            type=_keyed,
            metavar="KEY=VALUE",
            help="A setting of the records: supply_voltage=24, counts_per_rev=4096.",
        ),
        click.option("--data-root", metavar="FOLDER", help="Folder in which all files of a campaign must lie."),
    )


def _number(option: str, text: str, *, required: bool = False) -> Callable[[Command], Command]:
    return click.option(option, type=finite, metavar="NUMBER", required=required, help=text)


def _choice(option: str, words: list[str], text: str) -> Callable[[Command], Command]:
    return click.option(option, type=click.Choice(words), help=text)


def _several(paths: str | tuple[str, ...]) -> tuple[str, ...]:
    return (paths,) if isinstance(paths, str) else paths


def _once(pairs: tuple[tuple[str, str], ...], option: str) -> dict[str, str]:
    mapping = dict(pairs)
    if len(mapping) < len(pairs):
        raise click.UsageError(f"{option} names a signal twice; keep one")
    return mapping


def stacked(command: Command, decorators: tuple[Callable[[Command], Command], ...]) -> Command:
    """Give a command several options, the first of them first in its help."""
    for decorator in reversed(decorators):
        command = decorator(command)
    return command
