"""The gain to use: from the widest place where the spec holds, over all that may be otherwise than the model says.

The least gain stands on a cliff by definition. Scenarios (:mod:`servolens.design.scenarios`) choose the gain, and
others, each used once, tell how it does; as the set of feasible gains is not convex, nothing but a fresh count is a
bound.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.design.command_noise import fills_drive, quiet
from servolens.design.cover import gain_scale
from servolens.design.extrapolation import BEYOND, FAR, within
from servolens.design.found import Design, Recommended
from servolens.design.limit_cycle import hunting
from servolens.design.plant_inverse import tracking
from servolens.design.scenarios import TOLERANCE, counted, drawn
from servolens.design.settle import BETWEEN, evaluate
from servolens.errors import needed, number_within, whole_number
from servolens.inputs import as_models, listed
from servolens.processors import in_parallel
from servolens.record_signals import as_finite
from servolens.units import readable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.design.response import Response
    from servolens.design.scenarios import Scenario
    from servolens.design.spec import PDSpec
    from servolens.inputs import Plants
    from servolens.model import Model

__all__ = ["NINE_OF_TEN", "recommend"]

NINE_OF_TEN = 0.9
"""Share of the scenarios in which a gain has to meet the spec."""
CHOICE = 40
"""Scenarios by which the gain is chosen: one that fails in a tenth of all is noticed in 98 of 100 cases."""
GAINS, FEWEST = 40, 3
"""Gains that are tried in all intervals together, and in each at least."""
GLANCE = 3.0
"""Settling times for which steps are watched while gains are compared: most gains that fail do so soon. Some swing up
slowly; so the gain that is taken, and those half way to gains that are less safe, are watched for the whole horizon."""


def recommend(
    models: Plants,
    design: Design,
    *,
    scenarios: int = 200,
    seed: int = 0,
    overshoot: float | None = 0.05,
    references: float | Sequence[float] = (),
) -> Design:
    """Add the gain to use to a `design`: the one that keeps farthest from where the spec breaks.

    Plants are drawn from the parameters' covariance, with what the model leaves unexplained as a force of its size and
    correlation, or, where that is immaterial and depends on the inputs, as an error of the position. The sensor has the
    noise that the records showed, and the gains of the loop are realised within ±2 %; steps go up and back. Of the
    gains that meet the spec most often and keep the overshoot's limit, the one is taken that is farthest from where the
    spec breaks: as a ratio, for gains scale, or as a difference where a gain is small beside what the loop notices.
    Gains that go beyond what the records of the models showed are asked only where no other meets the spec in nine of
    ten scenarios. One with which the sensor's noise does not wear the drive comes first where it is as good, or where
    noise alone takes the other to the drive's end. Where plants break the spec between the samples of the loop, a gain
    is taken with which nine in ten keep it there too, if there is one.

    Parameters
    ----------
    models : Plant, model, fit, diagnosis, path of a model's file, or a sequence of these
        What the design was made for; a model brings its covariance, and what it leaves unexplained.
    design : Design
        From :func:`tune` on the plants of `models`.
    scenarios : int
        How many tell how the gain does; others, that choose it, are not among them.
    seed : int
        Of the draws.
    overshoot : float or None
        Largest overshoot as a fraction of the step, where the spec states none; None is no limit. Where no gain keeps
        it, `why` says so: then of those that overshoot by no more than the least and this together the one is taken
        that is farthest from where the spec breaks.
    references : float or sequence of float
        Sizes of further steps that have to meet the spec [m or rad].

    Returns
    -------
    Design
        With ``recommended``; as it was where no gain meets the spec.

    Raises
    ------
    InputError
        If no model is given, or fewer than one scenario.

    Examples
    --------
    >>> from servolens import PDSpec, Plant, tune
    >>> axis = Plant(gain=1.8, damping=6.0)
    >>> found = recommend(axis, tune(axis, PDSpec(kp=100, settling_time=0.5))).recommended
    >>> found.probability, found.worst.overshoot < 0.05
    (1.0, True)
    """
    known = as_models(models)
    needed(design, Design)
    scenarios, seed = whole_number(scenarios, 1, "scenarios"), whole_number(seed, 0, "seed")
    if overshoot is not None:
        overshoot = number_within(overshoot, 0.0, np.inf, "overshoot")
    if design.kd is None:
        return design
    sizes = np.ravel(as_finite(listed(references), "references (sizes of steps)")).tolist()
    specs = [design.spec, *(replace(design.spec, reference=size) for size in sizes)]
    limit = overshoot if design.spec.overshoot is None else design.spec.overshoot
    choosing, telling = (np.random.default_rng([seed, which]) for which in (0, 1))
    choice = _chosen(known, design, drawn(known, specs, CHOICE, choosing), limit)
    tests = [replace(one, parts=choice.parts) for one in drawn(known, specs, scenarios, telling)]
    own = [evaluate(model.plant, design.spec, choice.kd, parts=choice.parts) for model in known]
    found = in_parallel(lambda one: one.response(choice.kd), tests)
    least = in_parallel(lambda one: one.response(design.kd or 0.0), tests)
    swings = {**design.hunting, "recommended": hunting([model.plant for model in known], design.spec, choice.kd)}
    moves = tracking(known[0].plant, design.spec, choice.kd, tests[:CHOICE])
    return replace(design, recommended=_told(design, choice, own, tests, found, least), hunting=swings, tracking=moves)


@final
@dataclass(frozen=True, slots=True)
class Choice:
    """A gain to use.

    Attributes
    ----------
    kd : float
        The gain.
    failures : int
        How many scenarios fail with it.
    unkept : float or None
        The overshoot limit that no gain keeps.
    halfway : tuple of float
        Gains half way to those that are less safe.
    parts : int
        Into how many each sample was divided at whose ends the axis was seen.
    is_calm : bool
        Whether only gains were looked at with which noise does not wear the drive.
    """

    kd: float
    failures: int
    unkept: float | None
    halfway: tuple[float, float]
    parts: int = 1
    is_calm: bool = False


@final
class _Race:
    """Gains in a race for the fewest scenarios that fail: one that has lost is watched no further."""

    def __init__(self, scenarios: Sequence[Scenario], settling_times: float | None) -> None:
        self._scenarios, self._settling_times = scenarios, settling_times
        self._fewest = len(scenarios)

    def rows(self, gains: Sequence[float]) -> list[tuple[float, NDArray[np.float64]]]:
        """Return how many scenarios fail with each gain, infinitely many if it has lost, and the overshoot in each.

        The first gain is asked first, and the others in those scenarios first that are hardest with it: so who loses
        does soon.
        """
        first = in_parallel(lambda scenario: self._response(gains[0], scenario), self._scenarios)
        hardness = [(not response.meets, *_slowness(response)) for response in first]
        hardest = sorted(range(len(first)), key=hardness.__getitem__, reverse=True)
        self._scenarios = [self._scenarios[i] for i in hardest]
        self._fewest = sum(not response.meets for response in first)
        overshoots = np.array([response.overshoot for response in first])
        return [(self._fewest, overshoots), *in_parallel(self.row, gains[1:])]

    def row(self, kd: float) -> tuple[float, NDArray[np.float64]]:
        """Return the row of one gain beside those that were asked before."""
        failures, overshoots = 0, []
        for scenario in self._scenarios:
            response = self._response(kd, scenario)
            overshoots.append(response.overshoot)
            failures += not response.meets
            if failures > self._fewest:
                return np.inf, np.full(len(self._scenarios), np.inf)
        self._fewest = min(self._fewest, failures)
        return failures, np.array(overshoots)

    def _response(self, kd: float, scenario: Scenario) -> Response:
        times = self._settling_times
        return scenario.response(kd, None if times is None else times * scenario.spec.settling_time)


def _chosen(models: Sequence[Model], design: Design, scenarios: Sequence[Scenario], limit: float | None) -> Choice:
    """Return the gain to use: where plants break the spec between the samples with it, one with which few of them do.

    If there is none, the spec is kept at the samples.
    """
    choice = _borne_out(models, design, scenarios, limit)
    closer = [replace(scenario, parts=BETWEEN) for scenario in scenarios]
    failures = sum(not response.meets for response in in_parallel(lambda one: one.response(choice.kd), closer))
    if failures <= choice.failures or not _may_keep(models, design):
        return choice
    other = _borne_out(models, design, closer, limit)
    return replace(other, parts=BETWEEN) if other.failures < failures and _is_safe(other, closer) else choice


def _may_keep(models: Sequence[Model], design: Design) -> bool:
    """Tell whether with some gain the models keep the spec between the samples too."""
    gains = np.concatenate(_grids(design.intervals, _scale(models, design)))
    spec = design.spec
    return any(all(evaluate(m.plant, spec, float(kd), parts=BETWEEN).meets for m in models) for kd in gains)


def _borne_out(models: Sequence[Model], design: Design, scenarios: Sequence[Scenario], limit: float | None) -> Choice:
    """Return the gain to use, of those that the records bear out; of all where these meet the spec too seldom."""
    scale = _scale(models, design)
    everywhere = _grids(design.intervals, scale)
    for most in (BEYOND, FAR, np.inf):
        intervals = [*design.intervals] if np.isinf(most) else within(models, design.spec, everywhere, most)
        if intervals:
            choice = _watched(_grids(intervals, scale), scale, scenarios, limit)
            if _is_safe(choice, scenarios):
                break
    calm = quiet(models, design.spec, intervals)
    if calm not in ([], intervals):
        choice = _calmer(models, design, choice, _watched(_grids(calm, scale), scale, scenarios, limit), scenarios)
    return replace(choice, kd=_short(choice, design, scenarios))


def _calmer(
    models: Sequence[Model], design: Design, choice: Choice, calm: Choice, scenarios: Sequence[Scenario]
) -> Choice:
    """Return the gain to use of two, with the second of which noise does not wear the drive.

    It is taken where it is as good; and where it only overshoots more, if noise alone takes the other to its end.
    """
    if calm.failures <= choice.failures and (calm.unkept is None or choice.unkept is not None):
        return replace(calm, is_calm=True)
    takes_all = fills_drive(models, design.spec, choice.kd) and _is_safe(calm, scenarios)
    return replace(calm, is_calm=True) if takes_all else choice


def _scale(models: Sequence[Model], design: Design) -> float:
    return min(gain_scale(model.plant, design.spec) for model in models)


def _is_safe(choice: Choice, scenarios: Sequence[Scenario]) -> bool:
    return choice.failures <= (1.0 - NINE_OF_TEN) * len(scenarios)


def _watched(
    grids: Sequence[NDArray[np.float64]], scale: float, scenarios: Sequence[Scenario], limit: float | None
) -> Choice:
    choice = _best(grids, scale, _Race(scenarios, GLANCE), limit)
    some = sorted({choice.kd, *choice.halfway})
    soon, late = ([row[0] for row in map(_Race(scenarios, t).row, some)] for t in (GLANCE, None))
    return choice if soon == late else _best(grids, scale, _Race(scenarios, None), limit)


def _best(grids: Sequence[NDArray[np.float64]], scale: float, race: _Race, limit: float | None) -> Choice:
    """Return the gain of those that fail in the fewest scenarios that is farthest from the others.

    Where none keeps the overshoot's limit, of those with which the fewest plants run away and that stand their own
    tolerance the one farthest from the others, with no more overshoot than the least and that limit together.
    """
    gains = np.concatenate(grids)
    order = np.argsort(-_margins(grids, np.ones(gains.size, dtype=bool), scale), kind="stable")
    rows = dict(zip(order, race.rows([float(kd) for kd in gains[order]]), strict=True))
    failures = np.array([rows[i][0] for i in range(gains.size)])
    overshoots = np.array([rows[i][1] for i in range(gains.size)])
    safest = failures == failures.min()
    mild = np.mean(overshoots <= (np.inf if limit is None else limit), axis=1) >= NINE_OF_TEN
    if (safest & mild).any():
        best = int(np.argmax(np.where(safest & mild, _margins(grids, safest, scale), -1.0)))
        return Choice(float(gains[best]), int(failures[best]), None, _halfway(grids, safest, best))
    away = np.isinf(overshoots).sum(axis=1)
    safest &= away == away[safest].min()
    places = np.arcsinh(np.outer((1.0, 1.0 + TOLERANCE), gains) / scale)
    steady = safest & (_margins(grids, safest, scale) >= places[1] - places[0])
    among = np.flatnonzero(steady if steady.any() else safest)
    mean = np.where(np.isinf(overshoots[among]), 0.0, overshoots[among]).mean(axis=1)
    mildest = among[mean <= mean.min() + (limit or 0.0)]  # the least stands where the loop is about to run away
    best = int(mildest[np.argmax(_margins(grids, safest, scale)[mildest])])
    return Choice(float(gains[best]), int(failures[best]), limit, _halfway(grids, safest, best))


def _halfway(grids: Sequence[NDArray[np.float64]], safest: NDArray[np.bool_], index: int) -> tuple[float, float]:
    """Return the gains of a grid half way from that of `index` to those that are less safe, or to the grid's ends."""
    begin = 0
    for grid in grids:
        if index < begin + grid.size:
            break
        begin += grid.size
    others = np.flatnonzero(~safest[begin : begin + grid.size])
    place = index - begin
    low, high = others[others < place].max(initial=0), others[others > place].min(initial=grid.size - 1)
    return float(grid[(low + place + 1) // 2]), float(grid[(place + high) // 2])


def _short(choice: Choice, design: Design, scenarios: Sequence[Scenario]) -> float:
    """Return the gain with three digits, as it is written, or with four, where it then fails in no more scenarios."""
    race = _Race(scenarios, None)
    for digits in (3, 4):
        rounded = float(f"{choice.kd:.{digits}g}")
        inside = any(low <= rounded <= high for low, high in design.intervals)
        if inside and race.row(rounded)[0] <= choice.failures:
            return rounded
    return choice.kd


def _grids(intervals: Sequence[tuple[float, float]], scale: float) -> list[NDArray[np.float64]]:
    """Return the gains that are tried in each interval, evenly in asinh(kd / scale)."""
    ends = np.arcsinh(np.array(intervals) / scale)
    widths = ends[:, 1] - ends[:, 0]
    counts = np.maximum(np.ceil(GAINS * widths / max(widths.sum(), 1e-300)), FEWEST).astype(int)
    return [
        np.clip(scale * np.sinh(np.linspace(a, b, n)), *interval)
        for (a, b), n, interval in zip(ends, counts, intervals, strict=True)
    ]


def _margins(grids: Sequence[NDArray[np.float64]], safest: NDArray[np.bool_], scale: float) -> NDArray[np.float64]:
    """Return how far each gain is from the ends of its interval, and from gains that are less safe."""
    found, begin = [], 0
    for grid in grids:
        place, fails = np.arcsinh(grid / scale), ~safest[begin : begin + grid.size]
        fails[[0, -1]] = True
        found.append(np.abs(place[:, None] - place[fails]).min(axis=1))
        begin += grid.size
    return np.concatenate(found)


def _told(
    design: Design,
    choice: Choice,
    own: Sequence[Response],
    tests: Sequence[Scenario],
    found: Sequence[Response],
    least: Sequence[Response],
) -> Recommended:
    probability, interval = counted(found)
    result = Recommended(
        kp=design.spec.kp,
        kd=choice.kd,
        settling_time=None if any(r.settling_time is None for r in own) else max(r.settling_time or 0.0 for r in own),
        overshoot=max(response.overshoot for response in own),
        worst=max((*found, *own), key=_slowness),
        probability=probability,
        interval=interval,
        scenarios=len(found),
        why="",
        risk=_risk(design, least),
        hardest=_hardest(tests, found, design.plants[0].length_unit),
        fails=_fails(design.spec, found),
    )
    return replace(result, why=_why(result, choice))


def _hardest(tests: Sequence[Scenario], found: Sequence[Response], unit: str) -> str:
    """Return which steps meet the spec most seldom, where others of their kind meet it in nine of ten scenarios.

    Kinds are up and back, the sizes, and the models.
    """
    kinds = (
        [f"the steps {'back' if one.back else 'up'}" for one in tests],
        [f"the steps of {readable(abs(one.spec.reference), unit)}" for one in tests],
        [f"the steps of model {one.model}" for one in tests],
    )
    told = []
    for names in kinds:
        met = {name: [r.meets for r, other in zip(found, names, strict=True) if other == name] for name in set(names)}
        rates = sorted((sum(those) / len(those), name) for name, those in met.items())
        if rates[0][0] < NINE_OF_TEN <= rates[-1][0]:
            told.append(rates[0])
    return f"{100.0 * min(told)[0]:.3g} % of {min(told)[1]}" if told else ""


def _fails(spec: PDSpec, found: Sequence[Response]) -> str:
    """Return what most of the scenarios do that do not meet the spec, and what helps; empty where they do not do alike.

    Held against the band that was asked for, not against one that leaves room for what the model misses.
    """
    failed = [response for response in found if not response.meets]
    off = [abs(one.final_error) for one in failed if one.settling_time is None and abs(one.final_error) < 1.0]
    off = [size for size in off if size > spec.band]
    late = [one.settling_time for one in failed if (one.settling_time or 0.0) > spec.settling_time]
    if 2 * len(off) > len(failed):
        integral = "" if spec.ki or spec.controller == "cascade" else " an integral gain (ki)"
        helps = f": a larger kp,{integral} or a wider band helps" if integral else ""
        return f"most of those that miss it end up to {100.0 * max(off):.2g} % of the step off their target{helps}"
    if 2 * len(late) > len(failed):
        return f"most of those that miss it settle late, after up to {max(filter(None, late)):.3g} s"
    return ""


def _slowness(response: Response) -> tuple[float, float]:
    return (np.inf if response.settling_time is None else response.settling_time), response.overshoot


def _why(found: Recommended, choice: Choice) -> str:
    low, high = (100.0 * end for end in found.interval)
    text = (
        f"{_settles(found.settling_time)}, worst of {found.scenarios} plants {_time(found.worst.settling_time)};"
        f" {100.0 * found.probability:.3g} % meet it ({low:.3g} to {high:.3g} %), given the model"
    )
    if choice.unkept is None:
        return text
    alike = "as safe, and with which noise leaves the command as quiet," if choice.is_calm else "as safe"
    return (
        f"{text}; no gain that is {alike} keeps the overshoot below {100.0 * choice.unkept:.3g} %, with this one it is"
        f" {100.0 * found.overshoot:.3g} %"
    )


def _risk(design: Design, least: Sequence[Response]) -> str:
    share = sum(response.meets for response in least) / len(least)
    largest = max(response.overshoot for response in least)
    slowest = _time(max(least, key=_slowness).settling_time)
    worst = (
        f"worst {slowest}, overshoot up to {100.0 * largest:.3g} %" if np.isfinite(largest) else "the worst runs away"
    )
    return f"the least gain meets the spec in {100.0 * share:.3g} % of these plants ({worst})"


def _settles(time: float | None) -> str:
    return "does not settle" if time is None else f"settles in {time:.3g} s"


def _time(time: float | None) -> str:
    return "does not settle" if time is None else f"{time:.3g} s"
