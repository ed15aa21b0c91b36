"""Proof, for a smooth plant, of which gains meet a spec: enclosures of all steps of all gains of a cell.

A cell holds the gains kd = m + δ, |δ| ≤ w. At each instant the state of the loop is c + S δ + b: a point, its
sensitivity to the gain, and a remainder with ‖P b‖ ≤ ρ, the norm a quadratic Lyapunov function of the loop. Over a step
the state is a Taylor polynomial of second order and its remainder, x‴ over a box that provably holds the step (Picard).
By the mean value theorem the image of the enclosure under a map F is F(c) + J (S δ + b) with the Jacobian J over the
box: its middle carries S and b on, its half width adds to the remainder, which so grows with w².

The bounds are rounded outwards; the linear algebra that carries them on is not, and has a reserve instead.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.design.intervals import IntervalFunction
from servolens.design.rest import rest_of
from servolens.design.settle import FEASIBLE, horizon
from servolens.dynamics import dynamics, ideal_pd
from servolens.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servolens.design.spec import PDSpec
    from servolens.plant import Plant

    Array = NDArray[np.float64]

__all__ = ["FEASIBLE_CELL", "INFEASIBLE", "OPEN", "LoopMaps", "prove"]

OPEN, INFEASIBLE, FEASIBLE_CELL = 0, -1, 1
RESERVE = 1e-13
"""Relative rounding of the linear algebra, more than that of sums of a dozen terms."""
SLOWEST, DOUBLINGS = 0.999, 16
"""Slowest decay per sample for which a Lyapunov function is sought, and how often its sum is doubled."""
STEP_TIMES_RATE = 0.03
"""Largest product of a step and the fastest rate: a Taylor polynomial of second order is then right within 5e-6."""
PICARD = 2
"""How often, beyond the number of states, a box that holds a step is widened: what moves one state moves the next."""
FORGOTTEN = 1e4
"""How much less an error of what the next sample replaces counts."""
CLEARED = 50
"""After so many samples cells that are decided are left out."""


@final
class LoopMaps:
    """The loop from sample to sample as maps of [position, velocity, states, way, derivative, command, kd].

    The way is that of the shown position since the last sample: as a difference of two positions, its bounds would not
    know that they move together.

    Raises
    ------
    InputError
        If the plant is not smooth, has a delay or changes with time, or the spec limits the voltage.
    """

    def __init__(self, plant: Plant, spec: PDSpec) -> None:
        import casadi as ca

        self.plant, self.spec = plant, spec
        d = dynamics(plant.structure)
        x = ca.vertcat(d.position, d.velocity, d.states)
        self.states = x.numel()
        way, slope, command, kd = (ca.SX.sym(name) for name in ("way", "slope", "command", "kd"))
        self.z = ca.vertcat(x, way, slope, command, kd)
        values = ca.DM(plant.driven_values)
        flow = ca.vertcat(d.velocity, d.push, d.rates)
        asked = command
        if spec.control == "continuous":
            asked = ideal_pd(spec.kp, kd, spec.reference, d.shown, d.output_velocity)
        flow, shown, output, level, beginning = ca.substitute(
            [ca.substitute(flow, d.command, asked), d.shown, d.output, d.level, d.beginning], [d.parameters], [values]
        )
        self._refuse(plant, d, flow, level)
        self.direction, self.output = d.direction, self._index(output)
        self.substeps = int(np.ceil(spec.sample_time * self._fastest(flow, x) / STEP_TIMES_RATE))
        self.step = step = spec.sample_time / self.substeps
        first = ca.vertcat(flow, ca.jtimes(shown, x, flow) if spec.control == "sampled" else 0)
        second = ca.jtimes(first, x, flow)
        third = ca.jtimes(second, x, flow)
        after = ca.vertcat(x, way) + step * first + 0.5 * step**2 * second
        moved = ca.vertcat(after, slope, command, kd)
        new = slope + spec.derivative_filter * (way / spec.sample_time - slope)
        sampled = ca.vertcat(x, 0, new, spec.kp * (spec.reference - shown) - kd * new, kd)
        self.flow, self.third = self._function(first), self._function(third)
        self.move, self.sample = self._map(moved), self._map(sampled)
        rest = rest_of(plant, spec.loop(0.0), 0.0)
        start = ca.substitute(
            ca.vertcat(d.position, 0, beginning),
            ca.vertcat(d.position, d.command, d.time),
            ca.DM([rest.position, rest.applied, 0.0]),
        )
        self.start = np.array(ca.evalf(start)).ravel()

    def _fastest(self, flow: Any, x: Any) -> float:
        """Return the fastest rate of the plant, with the loop that acts within a step, at rest and at its speed."""
        import casadi as ca

        slopes = ca.Function("slopes", [self.z, self.direction], [ca.jacobian(flow, x)])
        speed = np.sqrt(abs(self.plant.gain) * self.spec.kp)
        rates = [float(speed)]
        for velocity in (0.0, speed * abs(self.spec.reference)):
            point = np.zeros(self.z.numel())
            point[1], point[-1] = velocity, 2.0 * speed / abs(self.plant.gain)
            rates.append(float(np.abs(np.linalg.eigvals(np.array(slopes(point, 1.0)))).max()))
        return max(rates)

    def _refuse(self, plant: Plant, d: Any, flow: Any, level: Any) -> None:
        import casadi as ca

        if not level.is_zero() or plant.delay > 0.0 or plant.has_contacts:
            raise InputError("an enclosure needs a smooth plant: no dry friction, no contacts and no delay")
        if ca.depends_on(flow, d.time) or self.spec.voltage_limit is not None:
            raise InputError("an enclosure needs a plant that does not change with time, and no limit of the voltage")
        jumps = ca.jacobian(flow, d.velocity)
        ends = [ca.substitute(jumps, ca.vertcat(d.velocity, d.direction), ca.DM([0.0, sign])) for sign in (-1.0, 1.0)]
        if not ca.cse(ca.simplify(ends[0] - ends[1])).is_zero():
            raise InputError("an enclosure needs a damping that is continuous where the velocity changes its sign")

    def _index(self, output: Any) -> int:
        found = [i for i in range(self.states) if self.z[i].__hash__() == output.__hash__()]
        if not found:
            raise InputError("an enclosure needs a load whose position is a state of the plant")
        return found[0]

    def _function(self, output: Any) -> IntervalFunction:
        import casadi as ca

        return IntervalFunction(ca.vertcat(self.z, self.direction), output)

    def _map(self, output: Any) -> tuple[IntervalFunction, IntervalFunction]:
        import casadi as ca

        return self._function(output), self._function(ca.jacobian(output, self.z))


@dataclass(slots=True, eq=False)
class _Cells:
    """Enclosures of many cells: states in columns; `carried` maps the remainder of the last sample to now."""

    centre: Array
    slope: Array
    radius: Array
    carried: Array
    added: Array
    norm: Array
    inverse: Array

    def kept(self, those: NDArray[np.bool_]) -> _Cells:
        return _Cells(
            self.centre[:, those],
            self.slope[:, those],
            self.radius[those],
            self.carried[those],
            self.added[:, those],
            self.norm[those],
            self.inverse[those],
        )

    @property
    def spread(self) -> Array:
        """How far the box reaches from the centre."""
        rows = np.zeros_like(self.slope)
        rows[:-1] = np.linalg.norm(self.carried @ self.inverse, axis=2).T
        return (np.abs(self.slope) + rows * self.radius + self.added) * (1.0 + 1e-9)


def prove(maps: LoopMaps, low: Array, high: Array) -> NDArray[np.int64]:
    """Return for each cell from `low` to `high` whether its gains meet the spec, fail, or neither is shown."""
    spec = maps.spec
    cells = _begin(maps, low, high)
    samples = int(np.ceil(horizon(maps.plant, spec) / spec.sample_time)) + 1
    verdict = np.zeros(low.size, dtype=np.int64)
    whole = np.ones(low.size, dtype=bool)
    places = np.arange(low.size)
    before = (np.full(low.size, -np.inf), np.full(low.size, np.inf))
    for k in range(samples + 1):
        spread = cells.spread[maps.output]
        error = [(spec.reference - cells.centre[maps.output] + s * spread) / abs(spec.reference) for s in (-1.0, 1.0)]
        within, outside = _judged(spec, k, (error[0], error[1]), before)
        before = (error[0], error[1])
        whole[places] &= within
        verdict[places[outside]] = INFEASIBLE
        if k % CLEARED == 0 or outside.any():
            going = (verdict[places] == OPEN) & np.isfinite(spread) & (spread < 10.0 * abs(spec.reference))
            whole[places[~going]] = False
            places, cells, before = places[going], cells.kept(going), (before[0][going], before[1][going])
            if places.size == 0:
                break
        _advance(maps, cells)
    verdict[whole & (verdict == OPEN)] = FEASIBLE_CELL
    return verdict


def _judged(spec: PDSpec, k: int, now: tuple[Array, Array], before: tuple[Array, Array]) -> tuple[Any, Any]:
    """Return which cells certainly keep the spec at this sample, and which certainly break it."""
    time = k * spec.sample_time
    low, high = now
    within, outside = np.ones(low.size, dtype=bool), np.zeros(low.size, dtype=bool)
    if time >= spec.settling_time * (1 - 1e-9):
        share = min(max((time - spec.settling_time) / spec.sample_time, 0.0), 1.0)
        if share < 1.0:  # at the settling time itself, between two samples
            bounds = [share * b + (1.0 - share) * n for b, n in zip(before, now, strict=True)] if share > 0.0 else now
            within &= (bounds[0] >= -spec.band) & (bounds[1] <= spec.band)
            outside |= (bounds[0] > spec.band + FEASIBLE) | (bounds[1] < -spec.band - FEASIBLE)
        within &= (low >= -spec.band) & (high <= spec.band)
        outside |= (low > spec.band + FEASIBLE) | (high < -spec.band - FEASIBLE)
    if spec.overshoot is not None:
        sign = np.sign(spec.reference)
        most, least = (-low, -high) if sign > 0 else (high, low)
        within &= most <= spec.overshoot
        outside |= least > spec.overshoot + FEASIBLE
    return within, outside


def _begin(maps: LoopMaps, low: Array, high: Array) -> _Cells:
    count, size = low.size, maps.z.numel()
    centre = np.zeros((size, count))
    centre[: maps.states] = maps.start[:, None]
    centre[-1] = 0.5 * (low + high)
    slope = np.zeros((size, count))
    slope[-1] = 0.5 * (high - low) * (1.0 + 1e-12)
    norm, inverse = _norms(maps, centre)
    return _Cells(
        centre,
        slope,
        np.zeros(count),
        np.broadcast_to(np.eye(size - 1), (count, size - 1, size - 1)).copy(),
        np.zeros((size, count)),
        norm,
        inverse,
    )


def _norms(maps: LoopMaps, centre: Array) -> tuple[Array, Array]:
    """Return P and its inverse for each cell: PᵀP is a Lyapunov function of the loop at its end, at rest."""
    rest = centre.copy()
    rest[maps.output] = maps.spec.reference
    rest[0] = maps.spec.reference
    size = centre.shape[0] - 1
    sampled, moved = (_middle(f[1], rest)[:, :size, :size] for f in (maps.sample, maps.move))
    loop = np.linalg.matrix_power(moved, maps.substeps)
    loop = loop @ sampled if maps.spec.control == "sampled" else loop
    speed = np.sqrt(abs(maps.plant.gain) * maps.spec.kp)
    scales = np.ones(size)
    scales[[1, -2]], scales[-3], scales[-1] = speed, speed * maps.spec.sample_time, maps.spec.kp
    scales[[-2, -1] if maps.spec.derivative_filter == 1.0 else [-1]] *= FORGOTTEN
    power = loop * scales / scales[:, None]
    if maps.spec.control == "continuous":
        power[:, maps.states :] = power[:, :, maps.states :] = 0.0
    fastest = np.abs(np.linalg.eigvals(power)).max(axis=1)
    power = power / np.maximum(1.0, fastest / SLOWEST)[:, None, None]
    total = np.broadcast_to(np.eye(size), power.shape)
    for _ in range(DOUBLINGS):
        total = total + power.transpose(0, 2, 1) @ total @ power
        power = power @ power
    found = np.linalg.cholesky(total).transpose(0, 2, 1) / scales
    inverse: Array = np.linalg.inv(found).astype(np.float64)
    return found, inverse


def _middle(jacobian: IntervalFunction, point: Array) -> Array:
    low, high = jacobian(*_with_direction(point, point))
    size = point.shape[0]
    return (0.5 * (low + high)).reshape(size, size, -1).transpose(2, 1, 0)


def _with_direction(low: Array, high: Array) -> tuple[Array, Array]:
    """Return the boxes with the directions of motion that they hold."""
    below, above = np.where(low[1] >= 0.0, 1.0, -1.0), np.where(high[1] <= 0.0, -1.0, 1.0)
    same = low[1] == high[1]
    above = np.where(same, below, above)
    return np.vstack([low, below]), np.vstack([high, above])


def _advance(maps: LoopMaps, cells: _Cells) -> None:
    """Carry the cells over one sample."""
    size = cells.centre.shape[0] - 1
    with np.errstate(over="ignore", invalid="ignore"):
        if maps.spec.control == "sampled":
            _carry(maps.sample, cells, None)
        for _ in range(maps.substeps):
            _carry(maps.move, cells, _remainder(maps, cells))
        growth = cells.norm @ cells.carried @ cells.inverse
        growth = np.clip(np.nan_to_num(growth, nan=1e100), -1e100, 1e100)
        largest = np.sqrt(np.linalg.eigvalsh(growth.transpose(0, 2, 1) @ growth)[:, -1]) * (1.0 + 1e-12)
        more = np.linalg.norm(np.abs(cells.norm) @ cells.added[:size].T[:, :, None], axis=(1, 2))
        cells.radius = cells.radius * largest + more
    cells.carried = np.broadcast_to(np.eye(size), cells.carried.shape).copy()
    cells.added = np.zeros_like(cells.added)


def _remainder(maps: LoopMaps, cells: _Cells) -> tuple[Array, Array]:
    """Return bounds of step³/6·x‴ over a box that holds the whole step; infinite where none was found."""
    spread = cells.spread
    low, high = cells.centre - spread, cells.centre + spread
    n, step = maps.states + 1, maps.step
    wide_low, wide_high = low.copy(), high.copy()
    rate = maps.flow(*_with_direction(low, high))
    for _ in range(n + PICARD):
        reach = step * np.maximum(np.abs(rate[0]), np.abs(rate[1])) * 1.1 + 1e-300
        wide_low[:n], wide_high[:n] = low[:n] - reach, high[:n] + reach
        rate = maps.flow(*_with_direction(wide_low, wide_high))
        holds = (step * np.maximum(np.abs(rate[0]), np.abs(rate[1])) <= reach).all(axis=0)
        if holds.all():
            break
    third = maps.third(*_with_direction(wide_low, wide_high))
    factor = step**3 / 6.0
    return np.where(holds, factor * third[0], -np.inf), np.where(holds, factor * third[1], np.inf)


def _carry(pair: tuple[IntervalFunction, IntervalFunction], cells: _Cells, extra: tuple[Array, Array] | None) -> None:
    """Replace the enclosures by those of their images under a map, plus what `extra` bounds."""
    value, jacobian = pair
    size = cells.centre.shape[0]
    spread = cells.spread
    low, high = value(*_with_direction(cells.centre, cells.centre))
    slopes = jacobian(*_with_direction(cells.centre - spread, cells.centre + spread))
    below, above = (s.reshape(size, size, -1).transpose(2, 1, 0) for s in slopes)
    middle, half = 0.5 * (below + above), 0.5 * (above - below)
    if extra is not None:
        low[: extra[0].shape[0]] += extra[0]
        high[: extra[1].shape[0]] += extra[1]
    centre = 0.5 * (low + high)
    size -= 1

    def times(matrix: Array, vectors: Array) -> Array:
        result: Array = np.einsum("kij,jk->ik", matrix, vectors)
        return result

    rounding = RESERVE * (times(np.abs(middle), np.abs(cells.slope)) + np.abs(centre))
    added = times(np.abs(middle), cells.added) + times(half, spread) + 0.5 * (high - low) + rounding
    cells.slope = times(middle, cells.slope)
    cells.carried = middle[:, :size, :size] @ cells.carried
    cells.centre, cells.added = centre, added
    cells.added[-1] = 0.0
