"""The bench: what is asked of a virtual axis, and the records that are logged there."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from servolens.errors import InputError
from servolens.lab.loop import Bench, run_many, run_one
from servolens.record import Controller, Record

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.lab.truth import Truth

    Seed = int | np.random.SeedSequence | np.random.Generator | None

__all__ = ["step_record", "step_records"]


def step_record(  # noqa: PLR0913 - the knobs of a test bench, all but the gains by keyword
    truth: Truth,
    kp: float,
    kd: float = 0.0,
    *,
    reference: float | Sequence[float] = 0.1,
    duration: float = 1.5,
    sample_time: float = 1e-3,
    rest: float = 0.0,
    encoder: float = 1e-5,
    noise: float = 0.0,
    seed: Seed = None,
    derivative_filter: float = 1.0,
    voltage_limit: float | None = None,
    log_voltage: bool = True,
    name: str | None = None,
) -> Record:
    """Log one closed-loop step, or several in a row, of a virtual axis that starts at rest at 0.

    The loop is digital: the noisy, quantised position feeds ``V[k] = kp (r[k] − y[k]) − kd d[k]`` with
    ``d[k] = d[k−1] + derivative_filter ((y[k] − y[k−1])/h − d[k−1])``, and V[k] is held until the next sample. The
    voltage logged is what the controller asked for.

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
    rest : float
        Time at reference 0 before the first step [s].
    encoder : float
        Resolution of the position sensor [m], 0 for none.
    noise : float
        Standard deviation of the sensor's white noise before quantisation [m].
    seed : int, SeedSequence or Generator
        Of the noise; needed when there is noise.
    derivative_filter : float
        Share of the new difference in the derivative, in (0, 1].
    voltage_limit : float, optional
        The amplifier clips at this [V], and the record says so. (A limit nobody knows of is an effect of the truth.)
    log_voltage : bool
        Whether the voltage is in the record.
    name : str, optional
        By default the gains.

    Returns
    -------
    Record
        With ``n = round((rest + levels·duration)/h) + 1`` samples from time 0.

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
    """
    bench = _bench(
        Controller(kp=kp, kd=kd, derivative_filter=derivative_filter),
        _staircase(reference, duration, sample_time, rest),
        sample_time,
        encoder=encoder,
        noise=noise,
        seed=seed,
        voltage_limit=voltage_limit,
        log_voltage=log_voltage,
        name=name,
    )
    noises = noise * np.random.default_rng(seed).standard_normal(bench.time.size) if noise else None
    position, voltage = run_one(truth, bench, noises)
    return _record(bench, position, voltage, bench.name)


def step_records(  # noqa: PLR0913 - as step_record
    truth: Truth,
    kp: float,
    kd: float = 0.0,
    *,
    repeats: int,
    seed: Seed,
    reference: float | Sequence[float] = 0.1,
    duration: float = 1.5,
    sample_time: float = 1e-3,
    rest: float = 0.0,
    encoder: float = 1e-5,
    noise: float = 1e-5,
    derivative_filter: float = 1.0,
    voltage_limit: float | None = None,
    log_voltage: bool = True,
    name: str | None = None,
) -> tuple[Record, ...]:
    """Log the same experiment `repeats` times with other noise, all runs simulated at once.

    Run i equals, to rounding, ``step_record(..., seed=np.random.default_rng(seed).spawn(repeats)[i])``, and does not
    change when more are asked for.

    Parameters
    ----------
    repeats : int
        Number of runs, at least 1.
    seed : int, SeedSequence or Generator
        Of the noise of all runs; each has a stream of its own.
    truth, kp, kd, reference, duration, sample_time, rest, encoder, noise, derivative_filter, voltage_limit, \
log_voltage, name
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
    bench = _bench(
        Controller(kp=kp, kd=kd, derivative_filter=derivative_filter),
        _staircase(reference, duration, sample_time, rest),
        sample_time,
        encoder=encoder,
        noise=noise,
        seed=seed,
        voltage_limit=voltage_limit,
        log_voltage=log_voltage,
        name=name,
    )
    streams = np.random.default_rng(seed).spawn(repeats)
    noises = noise * np.stack([stream.standard_normal(bench.time.size) for stream in streams], axis=1)
    positions, voltages = run_many(truth, bench, noises)
    names = [f"{bench.name}, run {i}" for i in range(1, repeats + 1)]
    return tuple(_record(bench, y, v, n) for y, v, n in zip(positions, voltages, names, strict=True))


def _staircase(
    reference: float | Sequence[float], duration: float, sample_time: float, rest: float
) -> NDArray[np.float64]:
    """Return the reference at each sample: 0 for the rest, then each level in turn."""
    _check("sample_time", sample_time, positive=True)
    _check("duration", duration, positive=True)
    _check("rest", rest)
    levels = np.atleast_1d(np.asarray(reference, dtype=np.float64))
    each, lead = round(duration / sample_time), round(rest / sample_time)
    if levels.ndim != 1 or levels.size == 0 or not np.isfinite(levels).all():
        raise InputError(f"reference must be one finite level or a sequence of them, got {reference!r}")
    if each < 1:
        raise InputError(f"duration must be at least one sample ({sample_time:g} s), got {duration:g} s")
    return np.concatenate([np.zeros(lead), np.repeat(levels, each), levels[-1:]])


def _bench(  # noqa: PLR0913 - hands the knobs on
    controller: Controller,
    reference: NDArray[np.float64],
    sample_time: float,
    *,
    encoder: float,
    noise: float,
    seed: Seed,
    voltage_limit: float | None,
    log_voltage: bool,
    name: str | None,
) -> Bench:
    _check("encoder", encoder)
    _check("noise", noise)
    if voltage_limit is not None:
        _check("voltage_limit", voltage_limit, positive=True)
    if noise and seed is None:
        raise InputError("noise needs a seed, so that the record can be made again")
    time = sample_time * np.arange(reference.size, dtype=np.float64)
    time.flags.writeable = reference.flags.writeable = False
    return Bench(
        controller=controller,
        time=time,
        reference=reference,
        encoder=encoder,
        noise=noise,
        voltage_limit=voltage_limit,
        log_voltage=log_voltage,
        name=f"kp {controller.kp:g}, kd {controller.kd:g}" if name is None else name,
    )


def _check(name: str, value: float, *, positive: bool = False) -> None:
    if not (math.isfinite(value) and value >= 0.0 and (value > 0.0 or not positive)):
        raise InputError(f"{name} must be {'positive' if positive else 'at least 0'} and finite, got {value!r}")


def _record(bench: Bench, position: NDArray[np.float64], voltage: NDArray[np.float64], name: str) -> Record:
    position.flags.writeable = voltage.flags.writeable = False
    return Record(
        time=bench.time,
        position=position,
        reference=bench.reference,
        voltage=voltage if bench.log_voltage else None,
        controller=bench.controller,
        encoder_resolution=bench.encoder or None,
        voltage_limit=bench.voltage_limit,
        name=name,
        source="virtual laboratory",
    )
