"""Simulations to be compared with measurements: in closed loop, or of stretches of motion under the voltage."""

from __future__ import annotations

from copy import copy
from typing import TYPE_CHECKING, Any, Protocol, final

import numpy as np

from servolens.control_law import with_history
from servolens.errors import InputError, NumericalError
from servolens.identification.noise import NoiseModel, Whitener
from servolens.identification.segments import applied_before, applied_voltage, noise_level
from servolens.identification.smoothing import smooth
from servolens.simulation.circumstances import plant_in
from servolens.simulation.loop import simulate_voltage
from servolens.simulation.trial import Accuracy, Trial, closed_trial

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import ArrayLike, NDArray

    from servolens.identification.options import FitOptions
    from servolens.identification.segments import Segment
    from servolens.plant import Plant
    from servolens.record import Record
    from servolens.simulation.loop import Simulation

__all__ = [
    "AT_MOST",
    "IN_GAP",
    "ClosedLoop",
    "ClosedRun",
    "OneByOne",
    "Resampled",
    "Run",
    "VoltageRun",
    "as_simulated",
    "at_place",
    "begun",
    "closed_runs",
    "moved_start",
    "one_by_one",
    "place_of",
    "rest",
    "within_reach",
]

LONGEST_REST = 40
"""Most samples of rest before a step that are looked at."""
SHIFT = 1e-4
"""Share of the travel by which an initial state is moved for its sensitivity."""
IN_GAP = (0.0, -0.95, 0.95)
"""Places of the motor within a gap: its middle and next to its ends."""
AT_MOST = 0.5
"""Share of its scale by which one step of a search moves an unknown: of a place's, which is -1 and 1 at the ends, 1."""
AS_IT_IS = NoiseModel.white(1.0)
"""Whitens nothing."""


class Run(Protocol):
    """A simulation and what it is compared with.

    Attributes
    ----------
    group : int
        Number of the record it stems from.
    samples : int
        How many samples are compared.
    simulated : int
        How many are simulated, those included that are not compared.
    sample_time : float
        Longest interval between samples [s].
    start : ndarray, shape (s,)
        Guess of the initial position and velocity that are free; of size 0 where they are known. An initial state
        of an axis with backlash has a third number, see :func:`begun`.
    shifts : tuple of float
        Their steps for finite differences; a third one where the place within a gap can be free as well.
    """

    @property
    def group(self) -> int: ...  # noqa: D102 - told above
    @property
    def samples(self) -> int: ...  # noqa: D102 - told above
    @property
    def simulated(self) -> int: ...  # noqa: D102 - told above
    @property
    def sample_time(self) -> float: ...  # noqa: D102 - told above
    @property
    def start(self) -> NDArray[np.float64]: ...  # noqa: D102 - told above
    @property
    def shifts(self) -> tuple[float, ...]: ...  # noqa: D102 - told above

    def missed(self, plant: Plant, start: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
        """Return simulated minus measured, shape (samples,)."""

    def residual(self, plant: Plant, start: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
        """Return what a fit minimises: the same whitened, and what is known of the initial state, if anything."""

    def residuals(
        self, plants: Sequence[Plant], starts: Sequence[NDArray[np.float64]], substeps: int
    ) -> NDArray[np.float64]:
        """Return those of several plants of one structure, a row each; NaN where one cannot be simulated."""


class OneByOne:
    """Residuals of several plants, one after the other."""

    residual: Callable[[Plant, NDArray[np.float64], int], NDArray[np.float64]]
    samples: int

    @property
    def simulated(self) -> int:
        """See :class:`Run`."""
        return self.samples

    def residuals(
        self, plants: Sequence[Plant], starts: Sequence[NDArray[np.float64]], substeps: int
    ) -> NDArray[np.float64]:
        """See :class:`Run`."""
        return one_by_one(self, plants, starts, substeps)


def begun(run: Run, plant: Plant) -> list[NDArray[np.float64]]:
    """Return initial states of `run` from which a search may begin, its guess first.

    Of an axis with backlash also with the motor near either end of the gap: it rests anywhere within. The third unknown
    is then 2/π times an angle whose sine is the place; see :func:`moved_start`.
    """
    start = run.start
    if not plant.has_contacts or len(run.shifts) <= start.size:
        return [start]
    return [np.append(start, at_place(place)) for place in IN_GAP]


def at_place(place: float) -> float:
    """Return the unknown that puts the motor at this `place` within the gap, from -1 to 1."""
    return float(np.arcsin(place)) / (0.5 * np.pi)


def within_reach(change: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the change of an initial state that one step of a search makes: of a place's unknown so much at most."""
    return np.concatenate([change[:2], np.clip(change[2:], -AT_MOST, AT_MOST)])


def moved_start(start: NDArray[np.float64], change: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return an initial state after such a change; the unknown of a place is reflected at -1 and 1.

    The place is a sine of it, and so goes on smoothly there. A place beyond the gap would press the contact.
    """
    moved = start + change
    moved[2:] = np.where(np.abs(moved[2:]) > 1.0, 2.0 * np.sign(moved[2:]) - moved[2:], moved[2:])
    return moved


def as_simulated(starts: ArrayLike) -> list[Any]:
    """Return initial states, shape (…, s), as simulations take them: the third is the motor's place within the gap."""
    found = np.array(starts, dtype=np.float64)
    found[..., 2:] = np.sin(0.5 * np.pi * found[..., 2:])
    return list(found.tolist())


def place_of(start: NDArray[np.float64]) -> float:
    """Return the motor's place within the gap of an initial state; 0 where it says none."""
    return float(as_simulated(start)[2]) if start.size > 2 else 0.0


def one_by_one(
    run: Run | OneByOne, plants: Sequence[Plant], starts: Sequence[NDArray[np.float64]], substeps: int
) -> NDArray[np.float64]:
    """Return the residuals of `plants`, a row each; NaN where one is no plant of the record or cannot be simulated."""
    found: list[NDArray[np.float64] | float] = []
    for plant, start in zip(plants, starts, strict=True):
        try:
            found.append(run.residual(plant, start, substeps))
        except (InputError, NumericalError):
            found.append(np.nan)
    return np.array(np.broadcast_arrays(*found))


@final
class ClosedLoop:
    """A record that is simulated from its reference, behind the amplifier's limit, on a grid without gaps.

    Parameters
    ----------
    record : Record
        With reference and controller.
    wrong : float
        Position [m or rad] by which a step to the next sample may be wrong beyond what other simulations allow.
    """

    def __init__(self, record: Record, wrong: float = 0.0) -> None:
        assert record.reference is not None and record.controller is not None  # noqa: S101, PT018 - callers see to it
        self.record, self.controller = record, record.controller
        self._ticks = record.loop_ticks()
        self.time = self._ticks.time
        self._reference = self._ticks.set_point(record.reference)
        self._added = None if record.feedforward is None else self._ticks.command(record.feedforward)
        self._before = applied_before(record)
        self.sample_time = float(np.max(np.diff(self.time)))
        self._coarse = wrong / self.sample_time

    def simulated(
        self, plant: Plant, start: Sequence[float], substeps: int, push: NDArray[np.float64] | None = None
    ) -> Simulation:
        """Return the loop from initial state `start`, with a voltage `push` added, if any."""
        added = self._added if push is None else push if self._added is None else self._added + push
        return self._trial(added).simulated(_as_it_was(plant, self.record), start, substeps)

    def measured(self, plants: Sequence[Plant], start: Sequence[float], substeps: int) -> NDArray[np.float64]:
        """Return the measured positions of `plants` at the record's own samples, shape (k, n); NaN where one fails."""
        those = [_as_it_was(plant, self.record) for plant in plants]
        return self.logged(self._trial(self._added).measured(those, [start] * len(those), substeps))

    def _trial(self, added: NDArray[np.float64] | None) -> Trial:
        return closed_trial(
            self.controller,
            self.time,
            self._reference,
            feedforward=added,
            before=self._before,
            limit=self.record.voltage_limit,
            accuracy=Accuracy(coarse=self._coarse),
        )

    def logged(self, signal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what of a simulated `signal` stands at the record's own samples."""
        return self._ticks.logged(signal)


@final
class ClosedRun(OneByOne):
    """A record in closed loop from the reference, behind the amplifier's limit.

    The sensor's rounding is left out, so that the response is smooth in the parameters. A record that begins at rest
    begins about where its first samples are; one that begins in motion, anywhere and with any velocity.

    Parameters
    ----------
    record : Record
        With reference and controller; with the voltage if that is compared.
    group : int
        Number of the record.
    compared : {"position", "voltage"}
        What is compared.
    in_motion : bool
        Whether the record begins in motion.
    noise : NoiseModel
        Whitens the residual.
    """

    def __init__(
        self,
        record: Record,
        group: int,
        *,
        compared: str = "position",
        in_motion: bool = False,
        noise: NoiseModel = AS_IT_IS,
    ) -> None:
        if in_motion:
            record = with_history(record)
        self.group, self.record, self._loop, self._compared = group, record, ClosedLoop(record), compared
        self.measured = applied_voltage(record) if compared == "voltage" else record.position
        self.samples = self.measured.size
        speed = np.abs(smooth(record.time, self.measured, min(21, self.samples))[1])
        self.whiten = Whitener(self.measured, speed, noise)
        self.sample_time = self._loop.sample_time
        self.start, self.shifts = _moving(record.time, record.position)
        self._deviation, self._still = np.inf, 1
        if not in_motion:
            self._still = rest(record)
            self.start, self.shifts = np.array([float(np.mean(record.position[: self._still]))]), self.shifts[:1]
            self._deviation = max(noise_level(record) / np.sqrt(self._still), self.shifts[0])
        self._begun = self.start
        self.usual = np.zeros(self.samples + self.start.size)

    def missed(self, plant: Plant, start: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
        """See :class:`Run`."""
        begin = float(start[0]), float(start[1]) if start.size > 1 else 0.0
        run, limit = self._loop.simulated(plant, begin, substeps), self._loop.record.voltage_limit
        seen = run.measured
        if self._compared == "voltage":
            seen = run.voltage if limit is None else np.clip(run.voltage, -limit, limit)
        return np.asarray(self._loop.logged(seen) - self.measured)

    def residual(self, plant: Plant, start: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
        """See :class:`Run`."""
        away = (start - self._begun) / self._deviation
        return np.concatenate([self.whiten(self.missed(plant, start, substeps)), away]) - self.usual

    def less(self, usual: NDArray[np.float64]) -> ClosedRun:
        """Return the same run, of whose residual so much is known beforehand, shape (m,)."""
        other = copy(self)
        other.usual = usual
        return other

    def added(self, errors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what errors of the measured position, shape (n, k), add to the residual, shape (m, k)."""
        away = np.broadcast_to(
            np.mean(errors[: self._still], axis=0) / self._deviation, (self.start.size, errors.shape[1])
        )
        return -np.concatenate([self.whiten(errors), away])


@final
class VoltageRun(OneByOne):
    """A stretch of motion driven by its voltage, from an initial state of its own."""

    def __init__(self, segment: Segment, group: int, window: int = 21) -> None:
        self.group, self.samples, self.segment = group, segment.time.size, segment
        self.sample_time = float(np.max(np.diff(segment.time)))
        self.start, self.shifts = _moving(segment.time, segment.position, window)

    def missed(self, plant: Plant, start: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
        """See :class:`Run`."""
        segment = self.segment
        before = applied_before(segment.record) if segment.first == 0 else None
        begin = (float(start[0]), float(start[1]))
        run = simulate_voltage(plant, segment.time, segment.voltage, start=begin, before=before, substeps=substeps)
        return run.measured - segment.position

    def residual(self, plant: Plant, start: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
        """See :class:`Run`."""
        return self.missed(plant, start, substeps)


@final
class Resampled(OneByOne):
    """A run with other noise: what `run` leaves at its best fit is replaced by `innovations`.

    Parameters
    ----------
    run : Run
        The run.
    left : ndarray
        Its residual at the best fit.
    innovations : ndarray
        Of the same size.
    """

    def __init__(self, run: Run, left: NDArray[np.float64], innovations: NDArray[np.float64]) -> None:
        self.group, self.samples, self.sample_time = run.group, run.samples, run.sample_time
        self.start, self.shifts, self.missed = run.start, run.shifts, run.missed
        self._run, self._added = run, innovations - left

    def residual(self, plant: Plant, start: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
        """See :class:`Run`."""
        return self._run.residual(plant, start, substeps) + self._added


def closed_runs(records: Sequence[Record], options: FitOptions, noise: NoiseModel = AS_IT_IS) -> list[ClosedRun]:
    """Return each record in closed loop, its residual whitened.

    Raises
    ------
    InputError
        If the voltage is to be compared and a record has none.
    """
    for record in records:
        if options.compared == "voltage" and record.voltage is None:
            raise InputError(f"{record.name}: no voltage is logged, so it cannot be compared; compare the position")
    in_motion = options.begin == "motion"
    return [
        ClosedRun(record, group, compared=options.compared, in_motion=in_motion, noise=noise)
        for group, record in enumerate(records)
    ]


def rest(record: Record) -> int:
    """Return how many samples the axis rests at the record's beginning before the reference changes, 1 to 40.

    At rest: the position stays within six standard deviations of its noise and two encoder steps.
    """
    edges = record.edges()
    count = min(int(edges[0]), LONGEST_REST) if edges.size else 1
    still = 6.0 * noise_level(record) + 2.0 * (record.encoder_resolution or 0.0)
    return count if float(np.ptp(record.position[:count])) <= still else 1


def _moving(
    time: NDArray[np.float64], position: NDArray[np.float64], window: int = 21
) -> tuple[NDArray[np.float64], tuple[float, ...]]:
    """Return initial position and velocity, and by how much to move them for their sensitivities."""
    value, slope = smooth(time, position, min(window, time.size))
    travel = SHIFT * max(float(np.ptp(position)), 1e-9)
    return np.array([value[0], slope[0]]), (travel, travel / max(float(time[-1] - time[0]), 1e-3))


def _as_it_was(plant: Plant, record: Record) -> Plant:
    """Return `plant` as it was in `record`: :func:`plant_in`, but for what costs time where nothing changes."""
    if record.inertia is None and record.enabled is None and record.voltage_limit is None:
        return plant
    return plant_in(plant, record)
