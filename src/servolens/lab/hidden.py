"""Campaigns with a hidden truth: measured as an engineer would who wants to know what the axis lacks.

Axis, loops, references, sensor, and the shape of each effect are drawn from a seed. The size of an effect is then
turned until it stands out as asked: *visibility* is the r.m.s. error that the best model of gain and damping leaves in
the training records, beyond noise and in units of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import InputError, NumericalError, names_like
from servolens.lab.disturbances import Drawn
from servolens.lab.foreign import FOREIGN
from servolens.lab.loop import Bench, run_one
from servolens.lab.scene import NOISES, draw_scene
from servolens.lab.search import SizeSearch, heard, law, missed, sane_run
from servolens.lab.sizes import SIZES
from servolens.lab.truth import Truth
from servolens.lab.worlds import Usual, checked_world, draw_surroundings
from servolens.record import Record

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from servolens.lab.disturbances import Surroundings
    from servolens.lab.loop import BenchRun
    from servolens.lab.scene import Scene
    from servolens.lab.search import Found
    from servolens.lab.unmodelled import UnmodelledEffect
    from servolens.record import Controller, LengthUnit

__all__ = ["HiddenCampaign", "hidden_campaign"]

USUAL = (8.0, 150.0)
"""Visibility that is drawn from if none is asked for, in white noise."""
LEAST_SHAKEN, MOST_OF_STEP = 4.0, 0.015
"""Least visibility where the axis is shaken, which hides less than its size suggests; and the largest share of the step
that an effect costs where none is asked for: 150 times the loudest white noise."""
KEPT_OF_REPEATED = 2
"""Different training runs at most, where each is repeated and no number is asked for."""
NEAR_VISIBILITY = 0.17
"""Distance of the logarithm of visibility at which an axis will do."""
MOST_AXES = 5
"""Axes that are drawn until one shows the effects as asked."""


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HiddenCampaign:
    """Records of an axis whose truth is known to the laboratory alone.

    Attributes
    ----------
    records, heldout : tuple of Record
        To find the truth from; with other gains and levels, to test what was found.
    truth : Truth
        With every effect of the catalogue that was hidden.
    foreign : str or None
        Name of the law that is not in the catalogue, see :data:`servolens.lab.FOREIGN`.
    world : str
        Name of the world, see :data:`servolens.lab.WORLDS`.
    surroundings : Surroundings
        What disturbed the measurement.
    floor : float
        What that alone costs [m or rad]: in the white world the r.m.s. of noise and quantisation, in any other the
        r.m.s. error of the best model of gain and damping on a healthy axis.
    visibility : float
        R.m.s. error of the best model of gain and damping in the training records, without its part of noise, over
        `floor`; 0 for a healthy axis. Measured in white noise of the scene's usual level.
    shares : mapping of str to float
        The visibility of each effect, or foreign law, by itself.
    seed : int
        That it is made from.
    laws : callable
        Number of a run → the foreign law of a run, None without one.
    """

    records: tuple[Record, ...]
    heldout: tuple[Record, ...]
    truth: Truth
    foreign: str | None
    world: str
    surroundings: Surroundings
    floor: float
    visibility: float
    shares: Mapping[str, float]
    seed: int
    laws: Callable[[int], UnmodelledEffect | None] = field(repr=False)

    def tried(self, controller: Controller, levels: Sequence[float], duration: float, sample_time: float) -> BenchRun:
        """Run the hidden axis, foreign law included, in another loop: from rest at 0, without noise or encoder.

        Parameters
        ----------
        controller : Controller
            Of the loop.
        levels : sequence of float
            Reference, level by level [m or rad].
        duration, sample_time : float
            Of each level, of the loop [s].

        Raises
        ------
        NumericalError
            If the axis runs away.
        """
        samples = round(duration / sample_time)
        reference = np.repeat(np.asarray(levels, dtype=np.float64), samples)
        bench = Bench(
            controller=controller,
            time=sample_time * np.arange(reference.size, dtype=np.float64),
            reference=reference,
            feedforward=None,
            start=0.0,
            encoder=0.0,
            voltage_limit=None,
        )
        return run_one(self.truth, bench, Drawn(np.zeros(reference.size), None, None), self.laws(0))

    @property
    def noise(self) -> float:
        """Standard deviation of the sensor's random noise [m or rad]."""
        return self.surroundings.noise.deviation

    @property
    def encoder(self) -> float:
        """Resolution of the position sensor [m or rad]."""
        return self.surroundings.encoder


def hidden_campaign(  # noqa: PLR0913 - what may be asked of a campaign, all by keyword
    seed: int,
    *,
    effects: str | Sequence[str] = (),
    foreign: str | None = None,
    visibility: float | None = None,
    noise: str | float | None = None,
    records: int | None = None,
    heldout: int | None = None,
    log_voltage: bool = True,
    log_reference: bool = True,
    length_unit: LengthUnit | None = None,
    smooth: bool = False,
    world: str = "white",
) -> HiddenCampaign:
    """Measure an axis whose truth is hidden; all that is not asked for is drawn from the seed.

    Parameters
    ----------
    seed : int
        At least 0. The same call gives the same campaign.
    effects : str or sequence of str
        Effects of the catalogue to hide; none for a healthy axis.
    foreign : str, optional
        Name of a law that is not in the catalogue, to hide as well.
    visibility : float, optional
        Of each effect by itself, positive; log-uniform in 8 … 150 by default, less in loud worlds. Where no
        sensible size of the effect shows it so, the nearest; the campaign says how visible it is.
    noise : {"low", "medium", "high"} or float, optional
        1e-5, 3e-5 or 1e-4 of the step, roughly; or standard deviation [m or rad]. A coarse encoder is drawn apart.
    records, heldout : int, optional
        Training records, at least 1 (by default 2 to 4); held-out records (1 or 2).
    log_voltage, log_reference : bool
        Whether the records have these columns; one of them must be. Without a reference the visibility is that of a
        model driven by the voltage.
    length_unit : {"m", "rad"}, optional
        ``pendulum_gravity`` is always in rad.
    smooth : bool
        Whether the references are ramps, S-curves and sines instead of steps.
    world : str
        What disturbs the measurement, a name of :data:`servolens.lab.WORLDS`. The axis and its runs are the same in
        every world, the size of an effect follows from the visibility asked for.

    Returns
    -------
    HiddenCampaign

    Raises
    ------
    InputError
        If something asked for does not exist.

    Examples
    --------
    >>> from servolens import lab
    >>> campaign = lab.hidden_campaign(3, effects=["coulomb_friction"], visibility=20.0)
    >>> list(campaign.truth.effects), abs(campaign.visibility / 20 - 1) < 0.2
    (['coulomb_friction'], True)
    """
    names = _checked(effects, foreign, visibility, noise, records, heldout, log_voltage or log_reference)
    checked_world(world)
    unit: LengthUnit | None = "rad" if "pendulum_gravity" in names else length_unit
    logged = (log_voltage, log_reference)
    best: tuple[float, HiddenCampaign] | None = None
    for attempt in range(MOST_AXES):
        rng = np.random.default_rng([seed, attempt])
        shares = [float(rng.uniform()) if visibility is None else 0.0 for _ in names]
        scene = draw_scene(rng, records=records, heldout=heldout, noise=noise, length_unit=unit, smooth=smooth)
        site = _site(scene, world, (seed, attempt), logged, shortened=records is None)
        wanted = [site.wanted(share) if visibility is None else float(visibility) for share in shares]
        found = SizeSearch(site.scene, site.key, log_reference).hide(names, [one * site.loudness for one in wanted])
        if found is not None and (best is None or found.distance < best[0]):
            campaign = site.measured(found, foreign)
            best = best if campaign is None else (found.distance, campaign)
        if best is not None and best[0] <= NEAR_VISIBILITY:
            break
    if best is None:
        raise NumericalError(f"no axis of seed {seed} stays sane with {', '.join(names)}; take another seed")
    return best[1]


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Site:
    """A scene in a world: what is logged there of (voltage, reference), and what the world alone costs."""

    scene: Scene
    world: str
    surroundings: Surroundings
    key: tuple[int, int]
    logged: tuple[bool, bool]
    floor: float

    @property
    def loudness(self) -> float:
        """The floor over that of white noise."""
        return self.floor / self.scene.floor

    def wanted(self, share: float) -> float:
        """Return the visibility that belongs to a number between 0 and 1."""
        low, high = USUAL
        if self.world != "white":
            low = LEAST_SHAKEN if self.surroundings.shaking else low
            high = max(min(high, MOST_OF_STEP * self.scene.step / self.floor), 2.0 * low)
        return float(np.exp(math.log(low) + (math.log(high) - math.log(low)) * share))

    def measured(self, found: Found, foreign: str | None) -> HiddenCampaign | None:
        """Log the training runs and measure those that are held out; None if one of them is of no use."""
        truth, odd = law(self.scene, self.key, found.look.sizes)
        count, logs = len(self.scene.training), []
        for i, repeat in self.runs():
            bench, drawn = self.bench(i), self.drawn(i, repeat)
            number = _number(i, repeat)
            if self.world == "white" and i < count:
                run: BenchRun | None = found.look.runs[i]
            else:
                run = sane_run(heard(truth, self.key, number), bench, drawn, odd(number), self.scene.step)
            if run is None:
                return None
            logs.append(self.record(bench, run, drawn, (i, repeat)))
        kept = count * self.surroundings.repeats
        return HiddenCampaign(
            records=tuple(logs[:kept]),
            heldout=tuple(logs[kept:]),
            truth=truth,
            foreign=foreign,
            world=self.world,
            surroundings=self.surroundings,
            floor=self.floor,
            visibility=found.look.visibility / self.loudness if found.shares else 0.0,
            shares=MappingProxyType({name: share / self.loudness for name, share in found.shares.items()}),
            seed=self.key[0],
            laws=odd,
        )

    def runs(self) -> list[tuple[int, int]]:
        """Return number and repetition of each run; training runs first, those held out are done once."""
        training, heldout = len(self.scene.training), len(self.scene.heldout)
        repeated = [(i, repeat) for i in range(training) for repeat in range(self.surroundings.repeats)]
        return [*repeated, *((training + i, 0) for i in range(heldout))]

    def bench(self, i: int) -> Bench:
        """Return the bench of a run, with the world's encoder."""
        return replace((*self.scene.training, *self.scene.heldout)[i], encoder=self.surroundings.encoder)

    def drawn(self, i: int, repeat: int) -> Drawn:
        """Return what a run meets."""
        dice = np.random.default_rng([*self.key, 2, _number(i, repeat)])
        return self.surroundings.drawn(self.bench(i).time, dice)

    def record(self, bench: Bench, run: BenchRun, drawn: Drawn, which: tuple[int, int]) -> Record:
        """Return what is logged of a run."""
        for signal in run:
            signal.flags.writeable = False
        loop, (i, repeat) = bench.controller, which
        log_voltage, log_reference = self.logged
        again = f", repeat {repeat + 1}" if self.surroundings.repeats > 1 and i < len(self.scene.training) else ""
        return Record(
            time=self.surroundings.logged(bench.time, drawn),
            position=run.position,
            reference=bench.reference if log_reference else None,
            voltage=run.voltage if log_voltage else None,
            controller=loop,
            encoder_resolution=bench.encoder or None,
            name=f"run {i + 1}{again}, kp {loop.kp:g}, kd {loop.kd:g}",
            source="virtual laboratory",
            length_unit=self.scene.length_unit,
            command_unit=self.scene.command_unit,
        )


def _site(scene: Scene, world: str, key: tuple[int, int], logged: tuple[bool, bool], *, shortened: bool) -> _Site:
    """Put a scene into a world, and measure what that alone costs there."""
    loop = scene.training[0].controller
    usual = Usual(
        scene.noise,
        scene.encoder,
        scene.step,
        math.sqrt(scene.gain * loop.kp),
        scene.damping + scene.gain * loop.kd,
    )
    around = draw_surroundings(world, np.random.default_rng([*key, 6]), usual)
    if around.repeats > 1 and shortened:
        scene = replace(scene, training=scene.training[:KEPT_OF_REPEATED])
    site = _Site(scene=scene, world=world, surroundings=around, key=key, logged=logged, floor=scene.floor)
    return site if world == "white" else replace(site, floor=_floor(site))


def _floor(site: _Site) -> float:
    """Return what the best linear model misses on a healthy axis; instants that are stated are nobody's error."""
    around, scene = site.surroundings, site.scene
    if around.jitter is not None and around.jitter.stated:
        site = replace(site, surroundings=replace(around, jitter=None))
    healthy = Truth(gain=scene.gain, damping=scene.damping)
    benches = [site.bench(i) for i in range(len(scene.training))]
    measured = [(bench, run_one(healthy, bench, site.drawn(i, 0))) for i, bench in enumerate(benches)]
    return missed(scene, measured, site.logged[1])


def _number(i: int, repeat: int) -> int:
    """Return the number that chance knows a run by."""
    return i + 1000 * repeat


def _checked(
    effects: str | Sequence[str],
    foreign: str | None,
    visibility: float | None,
    noise: str | float | None,
    records: int | None,
    heldout: int | None,
    logged: bool,
) -> list[str]:
    """Return the names of all that is to be hidden."""
    names = [effects] if isinstance(effects, str) else [*effects]
    for name in names:
        if name not in SIZES:
            raise InputError(f"no effect {name[:40]!r} to hide; {names_like(name, sorted(SIZES), 'there are')}")
    if foreign is not None and foreign not in FOREIGN:
        raise InputError(f"no foreign law {foreign[:40]!r}; {names_like(foreign, FOREIGN, 'there are')}")
    if visibility is not None and not (math.isfinite(visibility) and visibility > 0):
        raise InputError(f"visibility must be positive, got {visibility!r}")
    if isinstance(noise, str) and noise not in NOISES:
        raise InputError(f"noise must be {', '.join(NOISES)} or a number, got {noise[:40]!r}")
    if not isinstance(noise, str) and noise is not None and not (math.isfinite(noise) and noise > 0):
        raise InputError(f"noise must be positive, got {noise!r}")
    if (records is not None and records < 1) or (heldout is not None and heldout < 0):
        raise InputError(f"a campaign needs at least 1 record and 0 held-out ones, got {records!r} and {heldout!r}")
    if not logged:
        raise InputError("log_reference and log_voltage are both False; a record needs at least one of the two")
    return [*names, *([foreign] if foreign else [])]
