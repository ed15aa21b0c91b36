"""Campaigns with a hidden truth: measured as an engineer would who wants to know what the axis lacks.

Axis, loops, references, sensor, and the shape of each effect are drawn from a seed. The size of an effect is then
turned until it stands out as asked: *visibility* is the r.m.s. error that the best model of gain and damping leaves in
the training records, beyond noise and in units of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import InputError, NumericalError
from servolens.lab.foreign import FOREIGN
from servolens.lab.scene import NOISES, draw_scene, log_uniform
from servolens.lab.search import Search, heard, law, noises, sane_run
from servolens.lab.sizes import SIZES
from servolens.record import Record

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from servolens.lab.loop import Bench, Run
    from servolens.lab.scene import Scene
    from servolens.lab.search import Found
    from servolens.lab.truth import Truth
    from servolens.record import LengthUnit

__all__ = ["HiddenCampaign", "hidden_campaign"]

USUAL = (8.0, 150.0)
"""Visibility that is drawn from if none is asked for."""
NEAR = 0.17
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
    noise, encoder : float
        Standard deviation of the white noise and resolution of the position sensor [m or rad].
    visibility : float
        R.m.s. error of the best model of gain and damping in the training records, without its part of noise, over
        `floor`; 0 for a healthy axis.
    shares : mapping of str to float
        The visibility of each effect, or foreign law, by itself.
    seed : int
        That it is made from.
    """

    records: tuple[Record, ...]
    heldout: tuple[Record, ...]
    truth: Truth
    foreign: str | None
    noise: float
    encoder: float
    visibility: float
    shares: Mapping[str, float]
    seed: int

    @property
    def floor(self) -> float:
        """R.m.s. of noise and quantisation [m or rad]."""
        return math.hypot(self.noise, self.encoder / math.sqrt(12.0))


def hidden_campaign(  # noqa: PLR0913 - what may be asked of a campaign, all by keyword
    seed: int,
    *,
    effects: Sequence[str] = (),
    foreign: str | None = None,
    visibility: float | None = None,
    noise: str | float | None = None,
    records: int | None = None,
    heldout: int | None = None,
    log_voltage: bool = True,
    log_reference: bool = True,
    length_unit: LengthUnit | None = None,
    smooth: bool = False,
) -> HiddenCampaign:
    """Measure an axis whose truth is hidden; all that is not asked for is drawn from the seed.

    Parameters
    ----------
    seed : int
        At least 0. The same call gives the same campaign.
    effects : sequence of str
        Effects of the catalogue to hide; none for a healthy axis.
    foreign : str, optional
        Name of a law that is not in the catalogue, to hide as well.
    visibility : float, optional
        Of each effect by itself, positive; log-uniform in 8 … 150 by default. Where no sensible size of the effect
        shows it so, the nearest; the campaign says how visible it is.
    noise : {"low", "medium", "high"} or float, optional
        1e-5, 3e-5 or 1e-4 of the step, roughly; or standard deviation [m or rad].
    records, heldout : int, optional
        Training records, at least 1 (by default 2 to 4); held-out records (1 or 2).
    log_voltage, log_reference : bool
        Whether the records have these columns; one of them must be. Without a reference the visibility is that of a
        model driven by the voltage.
    length_unit : {"m", "rad"}, optional
        ``pendulum_gravity`` is always in rad.
    smooth : bool
        Whether the references are ramps, S-curves and sines instead of steps.

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
    unit: LengthUnit | None = "rad" if "pendulum_gravity" in names else length_unit
    best: tuple[float, HiddenCampaign] | None = None
    for attempt in range(MOST_AXES):
        rng = np.random.default_rng([seed, attempt])
        wanted = [log_uniform(rng, *USUAL) if visibility is None else float(visibility) for _ in names]
        scene = draw_scene(rng, records=records, heldout=heldout, noise=noise, length_unit=unit, smooth=smooth)
        found = Search(scene, (seed, attempt), log_reference).hide(names, wanted)
        if found is not None and (best is None or found.distance < best[0]):
            campaign = _measured(scene, (seed, attempt), found, foreign, (log_voltage, log_reference))
            best = best if campaign is None else (found.distance, campaign)
        if best is not None and best[0] <= NEAR:
            break
    if best is None:
        raise NumericalError(f"no axis of seed {seed} stays sane with {', '.join(names)}; take another seed")
    return best[1]


def _measured(
    scene: Scene, key: tuple[int, int], found: Found, foreign: str | None, logged: tuple[bool, bool]
) -> HiddenCampaign | None:
    """Log the training runs and measure those that are held out; None if one of them is of no use."""
    truth, odd = law(scene, key, found.look.sizes)
    count, runs = len(scene.training), list(found.look.runs)
    for i, bench in enumerate(scene.heldout, start=count):
        run = sane_run(heard(truth, key, i), bench, noises(scene, key, i), odd(i), scene.step)
        if run is None:
            return None
        runs.append(run)
    pairs = zip((*scene.training, *scene.heldout), runs, strict=True)
    records = [_record(scene, bench, run, i, *logged) for i, (bench, run) in enumerate(pairs)]
    return HiddenCampaign(
        records=tuple(records[:count]),
        heldout=tuple(records[count:]),
        truth=truth,
        foreign=foreign,
        noise=scene.noise,
        encoder=scene.encoder,
        visibility=found.look.visibility if found.shares else 0.0,
        shares=MappingProxyType(found.shares),
        seed=key[0],
    )


def _record(scene: Scene, bench: Bench, run: Run, i: int, log_voltage: bool, log_reference: bool) -> Record:
    for signal in run:
        signal.flags.writeable = False
    loop = bench.controller
    return Record(
        time=bench.time,
        position=run.position,
        reference=bench.reference if log_reference else None,
        voltage=run.voltage if log_voltage else None,
        controller=loop,
        encoder_resolution=scene.encoder or None,
        name=f"run {i + 1}, kp {loop.kp:g}, kd {loop.kd:g}",
        source="virtual laboratory",
        length_unit=scene.length_unit,
        command_unit=scene.command_unit,
    )


def _checked(
    effects: Sequence[str],
    foreign: str | None,
    visibility: float | None,
    noise: str | float | None,
    records: int | None,
    heldout: int | None,
    logged: bool,
) -> list[str]:
    """Return the names of all that is to be hidden."""
    for name in effects:
        if name not in SIZES:
            raise InputError(f"no effect {name[:40]!r} to hide; there are {', '.join(sorted(SIZES))}")
    if foreign is not None and foreign not in FOREIGN:
        raise InputError(f"no foreign law {foreign[:40]!r}; there are {', '.join(FOREIGN)}")
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
    return [*effects, *([foreign] if foreign else [])]
