"""The bench: what is asked of a virtual axis, and the records that are logged there."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import InputError, described, number_within
from servolens.lab.disturbances import Drawn, SensorNoise, Surroundings
from servolens.lab.loop import Bench, BenchRun, run_many, run_one
from servolens.lab.truth import Truth
from servolens.record import Controller, Record

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

    from servolens.record import LengthUnit

    Seed = int | np.random.SeedSequence | np.random.Generator | None

__all__ = ["Setup", "step_record", "step_records"]


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Setup:
    """The rig of an experiment: all but the axis, the gains, the step and the sensor's noise and resolution.

    Parameters
    ----------
    controller : Controller, optional
        In place of `kp` and `kd`. A loop that uses a velocity of its own gets the load's true one, and that is logged.
    voltage_limit : float, optional
        The amplifier clips at this [V], and the record says so. (A limit nobody knows of is an effect of the truth.)
    surroundings : Surroundings, optional
        In place of `noise` and `encoder`: what else disturbs the measurement. Slow noise, a ripple of the mains, a
        shaken axis, samples that are not taken on time.
    start : float
        Where the axis rests at time 0 [m].
    place : float
        Where within the gap of a backlash its motor does: 0 is the middle, -1 and 1 are the ends.
    rest : float
        Time at the reference `start` before the first step [s].
    trajectory : array_like, shape (n,), optional
        The reference at each sample [m], in place of `reference`, `duration` and `rest`.
    feedforward : array_like, shape (n,), optional
        Added to the controller's voltage [V], and logged.
    log_reference, log_voltage : bool
        Whether reference and voltage are in the record; one of them must be.
    length_unit : {"m", "rad"}
        Unit of position; for "rad" read rad for m in all of this.
    command_unit : str
        Unit of the command; read it for V in all of this.
    name : str, optional
        Of the record; by default the gains.

    Raises
    ------
    InputError
        If a setting is outside its range.
    """

    controller: Controller | None = None
    voltage_limit: float | None = None
    surroundings: Surroundings | None = None
    start: float = 0.0
    place: float = 0.0
    rest: float = 0.0
    trajectory: ArrayLike | None = None
    feedforward: ArrayLike | None = None
    log_reference: bool = True
    log_voltage: bool = True
    length_unit: LengthUnit = "m"
    command_unit: str = "V"
    name: str | None = None

    def __post_init__(self) -> None:
        if not math.isfinite(self.start):
            raise InputError(f"start must be finite, got {self.start!r}")
        object.__setattr__(self, "place", number_within(self.place, -1.0, 1.0, "place"))
        _check("rest", self.rest)
        if self.voltage_limit is not None:
            _check("voltage_limit", self.voltage_limit, positive=True)
        for name in ("trajectory", "feedforward"):
            signal = getattr(self, name)
            if signal is not None:
                object.__setattr__(self, name, _signal(name, signal))
        if isinstance(self.trajectory, np.ndarray) and self.trajectory.size < 2:
            raise InputError(f"trajectory must have at least 2 samples, got {self.trajectory.size}")
        if not (self.log_reference or self.log_voltage):
            raise InputError("log_reference and log_voltage are both False; a record needs at least one of the two")


def step_record(  # noqa: PLR0913 - what is turned from one experiment to the next, all but the gains by keyword
    truth: Truth,
    kp: float = 0.0,
    kd: float = 0.0,
    *,
    reference: float | Sequence[float] = 0.1,
    duration: float = 1.5,
    sample_time: float = 1e-3,
    encoder: float = 1e-5,
    noise: float = 0.0,
    seed: Seed = None,
    setup: Setup | None = None,
) -> Record:
    """Log one closed-loop step, several in a row, or a whole trajectory of a virtual axis that starts at rest.

    The loop is digital: the position as the sensor shows it, noisy and quantised, feeds
    ``V[k] = kp (r[k] − y[k]) − kd (y[k] − y[k−1])/h``, or any other controller of the `setup`, and V[k] is held until
    the next sample. The voltage logged is what the controller asked for.
    What the sensor shows and what the actuator makes of the voltage are effects of the truth.

    Parameters
    ----------
    truth : Truth
        The axis.
    kp, kd : float
        Gains [V/m, V s/m].
    reference : float or sequence of float
        The level that is stepped to [m]; several are visited in turn (a square wave: ``(0.1, 0.0, 0.1)``).
    duration : float
        Time at each level [s], at least one sample.
    sample_time : float
        h [s], positive.
    encoder : float
        Resolution of the position sensor [m], 0 for none.
    noise : float
        Standard deviation of the sensor's white noise before quantisation [m].
    seed : int, SeedSequence or Generator
        Of all that is random; needed where something is.
    setup : Setup, optional
        The rest of the rig: another controller, an amplifier's limit, what disturbs, what is logged.

    Returns
    -------
    Record
        With ``n = round((rest + levels·duration)/h) + 1`` samples from time 0, or as many as the trajectory.

    Raises
    ------
    InputError
        If a setting is outside its range, or noise is asked for without a seed.

    Examples
    --------
    >>> from servolens.lab import NLM1, step_record
    >>> record = step_record(NLM1, kp=60, kd=5, noise=1e-5, seed=3)
    >>> len(record), float(record.time[-1]), record.encoder_resolution
    (1501, 1.5, 1e-05)
    >>> from servolens.lab import Setup, Shaking, Surroundings
    >>> shaken = Surroundings(shaking=Shaking(deviation=0.05, correlation_time=0.1))
    >>> record = step_record(NLM1, kp=60, seed=3, setup=Setup(surroundings=shaken, voltage_limit=5))
    >>> float(record.voltage[0]), record.voltage_limit
    (6.0, 5)
    """
    knobs = _Knobs(truth, kp, kd, reference, duration, sample_time, encoder, noise, seed, setup or Setup())
    bench = knobs.bench()
    drawn = knobs.around.drawn(bench.time, np.random.default_rng(seed))
    return knobs.record(bench, run_one(truth, bench, drawn), knobs.title, drawn)


def step_records(  # noqa: PLR0913 - as step_record
    truth: Truth,
    kp: float = 0.0,
    kd: float = 0.0,
    *,
    repeats: int,
    seed: Seed,
    reference: float | Sequence[float] = 0.1,
    duration: float = 1.5,
    sample_time: float = 1e-3,
    encoder: float = 1e-5,
    noise: float = 1e-5,
    setup: Setup | None = None,
) -> tuple[Record, ...]:
    """Log the same experiment `repeats` times with other noise, all runs simulated at once if they are on time.

    Run i equals, to rounding, ``step_record(..., seed=np.random.default_rng(seed).spawn(repeats)[i])``, and does not
    change when more are asked for.

    Parameters
    ----------
    repeats : int
        Number of runs, at least 1.
    seed : int, SeedSequence or Generator
        Of the noise of all runs; each has a stream of its own.
    truth, kp, kd, reference, duration, sample_time, encoder, noise, setup
        As in :func:`step_record`.

    Returns
    -------
    tuple of Record, length `repeats`

    Raises
    ------
    InputError
        If a setting is outside its range.

    Examples
    --------
    >>> from servolens.lab import NLM1, step_records
    >>> [record.name for record in step_records(NLM1, kp=60, repeats=2, seed=0)]
    ['kp 60, kd 0, run 1', 'kp 60, kd 0, run 2']
    """
    if repeats < 1:
        raise InputError(f"repeats must be at least 1, got {repeats}")
    knobs = _Knobs(truth, kp, kd, reference, duration, sample_time, encoder, noise, seed, setup or Setup())
    bench = knobs.bench()
    each = [knobs.around.drawn(bench.time, stream) for stream in np.random.default_rng(seed).spawn(repeats)]
    if knobs.around.jitter is None:
        runs = [BenchRun(*signals) for signals in zip(*run_many(truth, bench, _together(each)), strict=True)]
    else:  # every run has instants of its own
        runs = [run_one(truth, bench, drawn) for drawn in each]
    return tuple(
        knobs.record(bench, run, f"{knobs.title}, run {i}", drawn)
        for i, (run, drawn) in enumerate(zip(runs, each, strict=True), start=1)
    )


def _together(each: Sequence[Drawn]) -> Drawn:
    """Return what many runs meet, one a column."""
    shaking = [drawn.shaking for drawn in each if drawn.shaking is not None]
    return Drawn(np.stack([drawn.noise for drawn in each], axis=1), np.stack(shaking, axis=1) if shaking else None)


@final
@dataclass(frozen=True, slots=True, eq=False)
class _Knobs:
    """What was asked of :func:`step_record`."""

    truth: Truth
    kp: float
    kd: float
    reference: float | Sequence[float]
    duration: float
    sample_time: float
    encoder: float
    noise: float
    seed: Seed
    setup: Setup

    def __post_init__(self) -> None:
        if not isinstance(self.truth, Truth):
            raise InputError(f"an axis is a Truth of servolens.lab, such as lab.NLM3; got {described(self.truth)}")
        _check("sample_time", self.sample_time, positive=True)
        _check("encoder", self.encoder)
        _check("noise", self.noise)
        if self.around.is_random and self.seed is None:
            raise InputError("noise needs a seed, so that the record can be made again")

    @property
    def around(self) -> Surroundings:
        """What disturbs the measurement."""
        return self.setup.surroundings or Surroundings(noise=SensorNoise(deviation=self.noise), encoder=self.encoder)

    @property
    def loop(self) -> Controller:
        """The controller of the loop."""
        return self.setup.controller or Controller(kp=self.kp, kd=self.kd)

    @property
    def title(self) -> str:
        """Name of the record."""
        return f"kp {self.loop.kp:g}, kd {self.loop.kd:g}" if self.setup.name is None else self.setup.name

    def bench(self) -> Bench:
        """Return what the knobs mean, sample by sample."""
        reference = self._staircase() if self.setup.trajectory is None else np.array(self.setup.trajectory, np.float64)
        feedforward = None if self.setup.feedforward is None else np.asarray(self.setup.feedforward, np.float64)
        if feedforward is not None and feedforward.size != reference.size:
            raise InputError(f"feedforward has {feedforward.size} samples, the reference has {reference.size}")
        time = float(self.sample_time) * np.arange(reference.size, dtype=np.float64)
        time.flags.writeable = reference.flags.writeable = False
        return Bench(
            controller=self.loop,
            time=time,
            reference=reference,
            feedforward=feedforward,
            start=float(self.setup.start),
            place=float(self.setup.place),
            encoder=float(self.around.encoder),
            voltage_limit=self.setup.voltage_limit,
        )

    def record(self, bench: Bench, run: BenchRun, name: str, drawn: Drawn) -> Record:
        """Return what is logged of a run."""
        for signal in run:
            signal.flags.writeable = False
        return Record(
            time=self.around.logged(bench.time, drawn),
            position=run.position,
            reference=bench.reference if self.setup.log_reference else None,
            voltage=run.voltage if self.setup.log_voltage else None,
            velocity=run.velocity if bench.controller.derivative == "velocity" else None,
            feedforward=bench.feedforward,
            controller=bench.controller,
            encoder_resolution=self.around.encoder or None,
            voltage_limit=self.setup.voltage_limit,
            name=name,
            source="virtual laboratory",
            length_unit=self.setup.length_unit,
            command_unit=self.setup.command_unit,
        )

    def _staircase(self) -> NDArray[np.float64]:
        """Return the reference at each sample: where the axis starts for the rest, then each level in turn."""
        _check("duration", self.duration, positive=True)
        levels = np.atleast_1d(np.asarray(self.reference, dtype=np.float64))
        each, lead = round(self.duration / self.sample_time), round(self.setup.rest / self.sample_time)
        if levels.ndim != 1 or levels.size == 0 or not np.isfinite(levels).all():
            raise InputError(f"reference must be one finite level or a sequence of them, got {self.reference!r}")
        if each < 1:
            raise InputError(f"duration must be at least one sample ({self.sample_time:g} s), got {self.duration:g} s")
        return np.concatenate([np.full(lead, float(self.setup.start)), np.repeat(levels, each), levels[-1:]])


def _signal(name: str, value: ArrayLike) -> NDArray[np.float64]:
    signal = np.array(value, dtype=np.float64)
    if signal.ndim != 1 or not np.isfinite(signal).all():
        raise InputError(f"{name} must be a finite number at each sample, got an array of shape {signal.shape}")
    signal.flags.writeable = False
    return signal


def _check(name: str, value: float, *, positive: bool = False) -> None:
    if not (math.isfinite(value) and value >= 0.0 and (value > 0.0 or not positive)):
        raise InputError(f"{name} must be {'positive' if positive else 'at least 0'} and finite, got {value!r}")
