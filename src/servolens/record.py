"""A measured run of one axis, as a frozen value.

Signals are ``(n,)`` float64 in SI units (seconds, metres or radians, volts) and read-only.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, final

import numpy as np

from servolens.clock import cycle_of
from servolens.control_arithmetic import Answer, LoopSignals, answer, ticks_a_sample
from servolens.controller import Controller
from servolens.errors import as_text, by_name, needed, unwrapped
from servolens.record_signals import as_signal, check_enabled, check_leads, check_time, is_number, require
from servolens.record_text import csv_text, loop_settings
from servolens.results import write_atomically
from servolens.ticks import Ticks
from servolens.units import COMMAND_UNITS, LENGTH_UNITS, settled

if TYPE_CHECKING:
    import os
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from servolens.findings import Finding

__all__ = ["Controller", "Record"]

LengthUnit = Literal["m", "rad"]
SIGNALS = ("time", "position", "reference", "voltage", "velocity", "feedforward", "enabled")
POSITIVE = ("encoder_resolution", "voltage_limit", "control_period", "inertia")
"""Quantities of a record that are positive where they are known."""
SETTINGS = (*POSITIVE, "voltage_before")
"""Numbers of a record that its file states."""
RESTS, STAIRS = 20, 20
"""Samples without a change after which a reference sets out anew; steps of less than this part of its range, one after
the other to the same side, are a slow ramp as a log with few digits shows it."""


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Record:
    """One measured run.

    Parameters
    ----------
    time : array_like, shape (n,)
        Strictly increasing [s].
    position : array_like, shape (n,)
        Measured position [m or rad].
    reference : array_like, shape (n,), optional
        Set point [m or rad]; then `controller` is needed unless `voltage` is logged.
    voltage : array_like, shape (n,), optional
        What the controller asked for [`command_unit`], held until the next sample.
    velocity, feedforward : array_like, shape (n,), optional
        Logged velocity [m/s or rad/s]; voltage added to the controller's [`command_unit`].
    enabled : array_like, shape (n,), optional
        1 while the motor is on, 0 while it is off and the axis runs free, until the next sample.
    controller : Controller, optional
        Settings of the loop.
    encoder_resolution : float, optional
        Smallest step of the position sensor [m or rad], positive.
    voltage_limit : float, optional
        The amplifier's limit [`command_unit`], positive.
    voltage_before : float, optional
        What was applied before the first sample [`command_unit`]; None takes the first voltage for it.
    control_period : float, optional
        Of a loop that ran faster than it was logged [s], where no `controller` says it: the command then changed
        between the samples too. None: it was held from each sample to the next.
    jump_leads : ndarray, shape (n,), optional
        Of such a loop: how long before the sample that first shows it each jump of the reference came [s], 0 at all
        other samples. None: at the sample.
    inertia : float, optional
        Moving inertia [kg m²] or mass [kg], positive, where records of one axis differ in it.
    name, source : str
        What people call the record; where it came from.
    length_unit : {"m", "rad"}
        Unit of position.
    command_unit : {"V", "A", "N", "N m", "%", "pwm"}
        Unit of the command, ``"V"`` unless the log says otherwise.
    remarks : tuple of Finding
        What the reader noticed.
    stamp_error : float, optional
        By how much, r.m.s., the log's time stamps were off the even instants at which its samples were taken, which
        `time` holds [s]; None where it holds the stamps.

    Attributes
    ----------
    sample_time : float
        Cycle of the log: its median interval, of a clock that jitters the mean one [s].

    Raises
    ------
    InputError
        With one sentence, if the signals do not fit together.
    """

    time: NDArray[np.float64]
    position: NDArray[np.float64]
    reference: NDArray[np.float64] | None = None
    voltage: NDArray[np.float64] | None = None
    velocity: NDArray[np.float64] | None = None
    feedforward: NDArray[np.float64] | None = None
    enabled: NDArray[np.float64] | None = None
    controller: Controller | None = None
    encoder_resolution: float | None = None
    voltage_limit: float | None = None
    voltage_before: float | None = None
    control_period: float | None = None
    jump_leads: NDArray[np.float64] | None = None
    inertia: float | None = None
    name: str = "record"
    source: str = ""
    length_unit: LengthUnit = "m"
    command_unit: str = "V"
    remarks: tuple[Finding, ...] = ()
    stamp_error: float | None = None
    sample_time: float = field(init=False)

    def __post_init__(self) -> None:
        for quantity in SETTINGS:
            object.__setattr__(self, quantity, unwrapped(getattr(self, quantity)))
        as_text(self.name, "name")
        for signal in (*SIGNALS, "jump_leads"):
            value = getattr(self, signal)
            if value is not None or signal in SIGNALS[:2]:
                object.__setattr__(self, signal, as_signal(signal, value, self.name))
        n = self.time.size
        require(n >= 2, f"{self.name}: a record needs at least 2 samples, got {n}")
        for signal in (*SIGNALS[1:], "jump_leads"):
            value = getattr(self, signal)
            if value is not None:
                require(value.size == n, f"{self.name}: {signal} has {value.size} samples, time has {n}")
        for unit, known in (("length_unit", LENGTH_UNITS), ("command_unit", COMMAND_UNITS)):
            object.__setattr__(self, unit, settled(getattr(self, unit), known, f"{self.name}: {unit}"))
        steps = np.diff(self.time)
        check_time(self.time, steps, self.name)
        object.__setattr__(self, "sample_time", cycle_of(self.time))
        require(
            self.reference is not None or self.voltage is not None,
            f"{self.name}: neither reference nor voltage is given; log at least one of the two",
        )
        require(
            self.voltage is not None or self.controller is not None,
            f"{self.name}: no voltage is logged and the gains are unknown; give kp and kd (on the command"
            " line --record-kp and --record-kd)",
        )
        for quantity in POSITIVE:
            value = getattr(self, quantity)
            require(
                value is None or (is_number(value) and value > 0),
                f"{self.name}: {quantity} must be positive, got {value!r}",
            )

        check_enabled(self.enabled, self.name)
        check_leads(self.jump_leads, steps, self.name)
        if self.controller is not None:
            needed(self.controller, Controller)
        require(
            self.controller is None or not self.controller.is_limited or self.voltage_limit is not None,
            f"{self.name}: anti_windup needs the limit of the command; give voltage_limit",
        )
        before = self.voltage_before
        require(before is None or is_number(before), f"{self.name}: voltage_before must be finite, got {before!r}")

    def __repr__(self) -> str:
        """Return one line: name, length, signals and the controller's gains."""
        signals = [name for name in SIGNALS[1:] if getattr(self, name) is not None]
        loop = (
            "no controller is known"
            if self.controller is None
            else f"kp {self.controller.kp:g}, kd {self.controller.kd:g}"
        )
        return f"<Record {self.name}: {len(self)} samples in {self.duration:g} s, {', '.join(signals)}; {loop}>"

    def __len__(self) -> int:
        return self.time.size

    @property
    def duration(self) -> float:
        """From the first to the last sample [s]."""
        return float(self.time[-1] - self.time[0])

    @property
    def has_loop(self) -> bool:
        """Whether reference and controller are known, so that the loop can be simulated."""
        return self.reference is not None and self.controller is not None

    @property
    def ticks(self) -> int:
        """How often the loop ran from one sample to the next: once, unless its period is shorter than the sample time.

        Raises
        ------
        InputError
            If that is no whole number of periods.
        """
        period = self.control_period if self.controller is None else self.controller.control_period
        return ticks_a_sample(period, self.sample_time)

    def with_ticks(self, count: int) -> Record:
        """Return the record as one whose loop ran `count` times from one sample to the next."""
        period = None if count == 1 else self.sample_time / count
        if self.controller is None:
            return replace(self, control_period=period, jump_leads=None)
        return replace(self, controller=replace(self.controller, control_period=period), jump_leads=None)

    @property
    def step_size(self) -> float:
        """Size of the step [m or rad]: max(r, y₀) − min(r, y₀), or the position's range without a reference.

        The denominator of the paper's percent error.
        """
        if self.reference is None:
            return float(np.ptp(self.position))
        first = float(self.position[0])
        return max(float(self.reference.max()), first) - min(float(self.reference.min()), first)

    @property
    def largest_step(self) -> float:
        """Largest way that the reference goes from one rest to the next [m or rad], the first from where the axis is.

        Without a reference the position's range.
        """
        if self.reference is None:
            return self.step_size
        ways = [float(np.ptp(self.reference[move[0] - 1 : move[-1] + 1])) for move in self.moves()]
        return max(abs(float(self.reference[0] - self.position[0])), *ways, 0.0)

    def slice(self, start: float, end: float) -> Record:
        """Return the samples with ``start <= time <= end`` [s].

        Raises
        ------
        InputError
            If fewer than two samples lie between.
        """
        first, last = np.searchsorted(self.time, [start, end + 1e-9 * max(1.0, abs(end))])
        require(
            last - first >= 2,
            f"{self.name}: only {max(last - first, 0)} samples lie between {start:g} and {end:g} s"
            f" (the record spans {self.time[0]:g} to {self.time[-1]:g} s)",
        )
        return self._take(int(first), int(last))

    def edges(self) -> NDArray[np.intp]:
        """Return the indices of the samples at which the reference first has a new value."""
        if self.reference is None:
            return np.empty(0, dtype=np.intp)
        return np.flatnonzero(np.diff(self.reference)) + 1

    def moves(self) -> list[NDArray[np.intp]]:
        """Return the edges of each motion of the reference from one rest to the next."""
        edges = self.edges()
        if self.reference is None or not edges.size:
            return []
        rests = np.diff(edges) > RESTS
        rises = np.diff(self.reference)[edges - 1]
        small = np.abs(rises) < float(np.ptp(self.reference)) / STAIRS
        is_ramp = small[1:] & small[:-1] & (rises[1:] * rises[:-1] > 0.0)
        return np.split(edges, np.flatnonzero(rests & ~is_ramp) + 1)

    def steps(self) -> tuple[Record, ...]:
        """Split at the reference's edges into single steps, each from its edge to the next.

        A rest before the first edge is left out. A reference that moves for several samples in a row (a ramp, a
        trajectory) is no step: then the record is returned whole.
        """
        edges = self.edges()
        if edges.size == 0 or (edges.size > 1 and np.min(np.diff(edges)) < 3):
            return (self,)
        ends = [*edges[1:].tolist(), len(self)]
        pieces = [(int(a), int(b)) for a, b in zip(edges, ends, strict=True) if b - a >= 2]
        lead = int(edges[0])
        if lead > 0 and self._moves(0, lead):
            pieces.insert(0, (0, lead))
        if len(pieces) <= 1:
            return tuple(self._take(a, b) for a, b in pieces) or (self,)
        return tuple(
            replace(self._take(a, b), name=f"{self.name}, step {i}") for i, (a, b) in enumerate(pieces, start=1)
        )

    def onset(self) -> float:
        """Time [s] at which the motion begins.

        The last sample before the position first leaves its initial value by more than four times the noise of the
        first samples (at least 1.5 encoder steps); the first sample if it moves at once, the last if it never does.
        """
        lead = self._lead()
        y = self.position
        rest = float(np.median(y[:lead]))
        spread = float(np.std(np.diff(y[:lead]))) / np.sqrt(2) if lead > 4 else 0.0
        threshold = max(4 * spread, 1.5 * (self.encoder_resolution or 0.0), 1e-12)
        away = np.flatnonzero(np.abs(y - rest) > threshold)
        if away.size == 0:
            return float(self.time[-1])
        return float(self.time[max(int(away[0]) - 1, 0)])

    def resample(self, sample_time: float) -> Record:
        """Return the record on a uniform grid of `sample_time` [s].

        Position and velocity are interpolated linearly; reference, voltage, feedforward and enabled are held.
        """
        require(
            np.isfinite(sample_time) and 0 < sample_time <= self.duration,
            f"{self.name}: sample_time must lie in (0, {self.duration:g}] s, got {sample_time!r}",
        )
        time = self.time[0] + sample_time * np.arange(int(self.duration / sample_time * (1 + 1e-12)) + 1)
        held = np.clip(np.searchsorted(self.time, time + 1e-9 * sample_time, side="right") - 1, 0, None)
        changes: dict[str, NDArray[np.float64] | None] = {"time": time, "jump_leads": None}
        for signal in SIGNALS[1:]:
            value = getattr(self, signal)
            if value is not None:
                smooth = signal in ("position", "velocity")
                changes[signal] = np.interp(time, self.time, value) if smooth else value[held]
        return replace(self, **changes)  # type: ignore[arg-type]  # the keys are field names

    def with_(self, changes: Mapping[str, object]) -> Record:
        """Return a copy with other settings, e.g. ``record.with_({"controller": Controller(kp=58.7)})``."""
        known = {item.name for item in fields(self) if item.init}
        changes = by_name("changes", changes, {"name": "run 1"})
        unknown = sorted(set(changes) - known)
        require(not unknown, f"{self.name}: no field named {', '.join(unknown)}; known are {', '.join(sorted(known))}")
        return replace(self, **changes)  # type: ignore[arg-type]  # the keys are field names

    def answer(self, controller: Controller) -> Answer:
        """Return what a `controller` makes of the signals, see :mod:`servolens.control_arithmetic`.

        Raises
        ------
        InputError
            If there is no reference, or a velocity is needed and not logged, or the period does not fit.
        """
        count = ticks_a_sample(controller.control_period, self.sample_time)
        if count == 1:
            return answer(controller, self.signals_seen())
        ticks = self._ticks(count)
        found = answer(controller, ticks.seen(self.signals_seen()))
        return Answer(**{name: ticks.logged(getattr(found, name)) for name in Answer.__slots__})

    def loop_ticks(self) -> Ticks:
        """Return when the loop ran: at each sample, at lost ones too, or several times between them."""
        return self._ticks(self.ticks)

    def _ticks(self, count: int) -> Ticks:
        if count == 1:
            return Ticks.of(self.time)
        jumps = self.jumps()
        return Ticks.of(self.time, count, jumps, None if self.jump_leads is None else self.jump_leads[jumps])

    def jumps(self) -> NDArray[np.intp]:
        """Return the samples that first show a jump of the reference, which does not just go on moving."""
        edges = self.edges()
        goes_on = np.diff(edges, prepend=-2, append=-2) == 1
        return np.asarray(edges[~(goes_on[1:] | goes_on[:-1])])

    def signals_seen(self) -> LoopSignals:
        """Return what its loop was given.

        Raises
        ------
        InputError
            If there is no reference.
        """
        require(self.reference is not None, "the control law needs the reference; log it")
        assert self.reference is not None  # noqa: S101 - required above
        return LoopSignals(
            time=self.time,
            reference=self.reference,
            position=self.position,
            sample_time=self.sample_time,
            velocity=self.velocity,
            added=self.feedforward,
            limit=self.voltage_limit,
        )

    def to_csv(self, path: str | os.PathLike[str]) -> None:
        """Write the record as a file that :func:`servolens.read_record` reads with the same numbers, to the last bit.

        What the file does not hold are `source`, `remarks` and `jump_leads`, which are its reader's. Where the loop is
        not known, who reads the file looks for gains in the logged command, as in every log.

        Parameters
        ----------
        path : path
            The file; what is there is replaced.

        Raises
        ------
        InputError
            If the file cannot be written, or no settings state such a loop.

        Examples
        --------
        >>> import tempfile
        >>> import servolens as sl
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     sl.lab.step_record(sl.lab.NLM1, kp=60).to_csv(f"{folder}/run.csv")
        ...     sl.read_record(f"{folder}/run.csv")
        <Record kp 60, kd 0: 1501 samples in 1.5 s, position, reference, voltage; kp 60, kd 0>
        """
        length, command = self.length_unit, self.command_unit
        settings: dict[str, object] = {"name": self.name}
        if self.controller is not None:
            settings |= loop_settings(self.controller, length, command)
        for key in SETTINGS:
            if getattr(self, key) is not None and key not in settings:
                settings[key] = float(getattr(self, key))
        units = {"time": "s", "velocity": f"{length}/s", "voltage": command, "feedforward": command}
        columns = {s if s == "enabled" else f"{s} [{units.get(s, length)}]": getattr(self, s) for s in SIGNALS}
        write_atomically(Path(path), csv_text(settings, columns).encode("utf-8"))

    def _take(self, first: int, last: int) -> Record:
        taken = self._signals(first, last)
        loop = self.controller
        if first == 0 or loop is None or not loop.integrates or self.reference is None:
            return taken
        begun = float(self._signals(0, first + 1).answer(loop).remembered[first - 1])
        return replace(taken, controller=replace(loop, integral_before=begun))

    def _signals(self, first: int, last: int) -> Record:
        parts = {s: v[first:last] for s in (*SIGNALS, "jump_leads") if (v := getattr(self, s)) is not None}
        return replace(self, **parts, voltage_before=self.voltage_before if first == 0 else None)

    def _lead(self) -> int:
        """Count the samples before the reference's first edge; without one, a twentieth of the record."""
        edges = self.edges()
        return max(int(edges[0]) if edges.size else len(self) // 20, 1)

    def _moves(self, first: int, last: int) -> bool:
        """Tell whether the position travels in the samples, more than a fiftieth of the whole range."""
        part = self.position[first:last]
        return bool(np.ptp(part) > 0.02 * np.ptp(self.position))
