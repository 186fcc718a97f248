"""Every return to rest of one release angle: all zeros of the momenta on the rectangle of theta2
and time.

With theta1 given, G(theta2, t) = p(t)/t of the motion released at (theta1, theta2) is a smooth map
of a rectangle to the plane, and its zeros are the brake orbits; the division takes away the line t
= 0, where every motion is at rest. Lanes of motions with their tangent in theta2 give G, both its
slopes and the mixed derivative on a grid, from which each cell has its bicubic; by the convex hull
of a bicubic's Bernstein coefficients a cell is told to be one of

- empty: the hull lies to one side of zero;
- simple: after multiplication with the inverse of its mean, the derivative is near enough to the
  unit matrix everywhere that the map is one to one: one zero at most, and Newton's method says
  whether it is there;
- neither: it is halved in time if it is bent more that way, else its interval of theta2 is.

All of it holds up to the error of the bicubic, which is measured wherever an interval is halved and
in every row, and kept clear of. What remains open at the narrowest interval is told as suspicious.
And there is a count that knows nothing of cells: G(theta2, 0) does not go round zero, so that the
signs of all zeros must add up to the winding number of p at the last time as theta2 goes once
round.

In natural units, and in NumPy but for the lanes.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from dpend.catalogue.bicubic import (
    SPLITS,
    Cells,
    Half,
    Intervals,
    bernstein_net,
    largest_nearby,
    turn_along,
)
from dpend.maps.lanes import over_lanes
from dpend.mechanics.pendulum import Pendulum, State, fast_frequency, vector_field
from dpend.methods.scheme import Scheme

# The stages as a loop: motions are few and of many kinds, and compiling would take longer than all
# of them.
_METHOD = Scheme("rk8-circle", 1.0, written_out=False)
# Rows that one launch computes.
_WINDOW = 64
# The first guess of the time between rows: the fast mode advances by this [rad].
_ROW = 0.05
# Where a cell that may hold a zero has an error along time above this share of its height, all rows
# are laid denser, so many at most; and what can be scanned at all: motions so long are known to no
# digit.
_COARSE, _MOST_ROWS, _LONGEST = 0.02, 8192, 2048
# Cells looked at together: as many as fit a cache.
_BATCH = 512 * 320
# What a search will take is told from motions on so many intervals. Each wave that p makes along
# theta2 costs about so many motions (8 to 46 over 30 slices of three pendulums), and there are so
# many returns to a wave (2 to 7). Waves are counted with and without the steepest intervals, this
# share of all, and the geometric mean is taken: alone the one is up to a hundred times too large,
# and the other four times too small.
_PROBES, MOTIONS_PER_WAVE, RETURNS_PER_WAVE, _STEEPEST = 128, 20, 3, 0.05
# Intervals [rad] narrower than this are not halved: rounding, magnified as the tangent is, would be
# all there is.
_NARROWEST = 1e-11
# The share of the measured error that is kept clear of: halving an interval takes a cubic's error
# down sixteen times.
_CLEARANCE = 0.25

# A zero this far outside its cell, as a share of it, still counts, for the bicubic's may be off.
# Two of the same sign that are nearer than the second to each other are one, found from both sides
# of an edge.
_EDGE, _SAME = 0.02, 0.1


@dataclass
class Budget:
    """What a search may spend, in time steps: one for each row of each motion, 2 to 8 microseconds
    on one core.

    Attributes:
        most: beyond, nothing new is begun.
        spent: so far.
        tell: called with what was spent, often.
    """

    most: int
    spent: int = 0
    tell: Callable[[int], None] | None = None

    def spend(self, steps: int) -> None:
        self.spent += steps
        if self.tell is not None:
            self.tell(self.spent)

    @property
    def exhausted(self) -> bool:
        return self.spent >= self.most


class Outlook(NamedTuple):
    """What a scan has before it: the rows of each motion, and the waves that p makes along
    theta2.
    """

    rows: int
    waves: float


class Zero(NamedTuple):
    """A return to rest: the release, the time, the sign of the Jacobian of (p1, p2) in (theta2, t),
    and the width in theta2 and the time between rows of the cell that it was found in.
    """

    theta2: float
    time: float
    sign: float
    width: float
    row: float


@dataclass(frozen=True)
class Scan:
    """All zeros on the rectangle.

    Attributes:
        zeros: in order of theta2.
        motions: how many were integrated.
        rows: how many times each was looked at.
        open_cells: (theta2, width) of intervals that were left undecided: too narrow to halve,
            beyond the budget, or not finite.
        winding: of p at the last time as theta2 goes round, clockwise: the way round the rectangle
            that keeps it left.
        exhausted: whether the budget ended the search.
    """

    zeros: tuple[Zero, ...]
    motions: int
    rows: int
    open_cells: tuple[tuple[float, float], ...]
    winding: int
    exhausted: bool

    @property
    def degree(self) -> int:
        """The sum of the zeros' signs, which is the winding number if none is missing."""
        return round(sum(zero.sign for zero in self.zeros))


class _TooCoarse(Exception):
    """The rows lie too far apart for the motion."""


def scanned(
    pendulum: Pendulum, theta1: float, duration: float, intervals: int, budget: Budget
) -> Scan:
    """All returns to rest up to `duration`, from so many intervals of theta2 to begin with.

    Arguments:
        pendulum: in natural units, its fields numbers; so is the duration, at most `longest`.
        theta1: [rad].
        budget: what the scan, and others, may spend.
    """
    rows = _rows_of(pendulum, duration)
    while 2 * rows <= _MOST_ROWS:
        try:
            return _Scanner(pendulum, theta1, duration / rows, rows, False, budget).run(intervals)
        except _TooCoarse:
            rows *= 2
    return _Scanner(pendulum, theta1, duration / rows, rows, True, budget).run(intervals)


def _rows_of(pendulum: Pendulum, duration: float) -> int:
    return _WINDOW * math.ceil(duration * float(fast_frequency(pendulum)) / _ROW / _WINDOW)


def foresee(pendulum: Pendulum, theta1: float, duration: float) -> Outlook:
    """What `scanned` will take: from the slopes of a few motions, without looking for returns.

    The slope's mean over theta2, against the usual size of p, is the number of waves. It grows like
    the distance of neighbouring motions, and intervals must be as narrow as the waves.
    """
    rows = _rows_of(pendulum, duration)
    scanner = _Scanner(pendulum, theta1, duration / rows, rows, True, Budget(0))
    value, _, slope, _ = scanner.motions(np.linspace(-np.pi, np.pi, _PROBES + 1))
    with np.errstate(all="ignore"):
        size, steep = (np.nan_to_num(np.hypot(*each)[1:], posinf=0.0) for each in (value, slope))
        steep = np.sort(steep / np.median(size, axis=1)[:, None], axis=1)
        usual = steep[:, : math.ceil((1 - _STEEPEST) * steep.shape[1])]
        waves = np.sqrt(np.mean(steep, axis=1) * np.mean(usual, axis=1))
    return Outlook(rows, float(np.max(waves[np.isfinite(waves)], initial=0.0)))


def longest(pendulum: Pendulum) -> float:
    """The longest duration that can be scanned: the fast mode advances by 100 radians."""
    return _LONGEST * _ROW / float(fast_frequency(pendulum))


@dataclass(frozen=True)
class _Scanner:
    """The rectangle and its rows."""

    pendulum: Pendulum
    theta1: float
    dt: float
    rows: int
    coarse: bool  # whether rows too far apart are put up with
    budget: Budget

    def run(self, intervals: int) -> Scan:
        edges = np.linspace(-np.pi, np.pi, intervals + 1)
        batch = max(_BATCH // self.rows, 16)
        zeros: list[Zero] = []
        open_cells: list[tuple[float, float]] = []
        motions, turned = 0, 0.0
        waiting: list[Any] = [edges[i : i + batch + 1] for i in range(0, intervals, batch)][::-1]
        while waiting:
            some = self._taken(waiting, batch)
            if isinstance(some, np.ndarray):  # edges whose motions are not known yet
                known = self.motions(some)
                motions += len(some)
                some = Intervals(some[:-1], some[1:], known[..., :-1], known[..., 1:])
            if self.budget.exhausted:
                open_cells += _places(some)
                turned += turn_along(some)
                continue
            for half in self._halved(some):
                found, undecided = self._looked_at(half.intervals, half.error)
                wide = half.intervals.right - half.intervals.left > _NARROWEST
                wide &= np.all(np.isfinite(half.error), axis=0)
                zeros += found
                again = half.intervals.some(np.flatnonzero(undecided & wide))
                waiting += [
                    again.some(slice(i, i + batch)) for i in range(0, len(again.left), batch)
                ]
                open_cells += _places(half.intervals.some(np.flatnonzero(undecided & ~wide)))
                settled = half.intervals.some(np.flatnonzero(~(undecided & wide)))
                turned += turn_along(settled)
            motions += len(some.left)
        winding = round(turned / (2 * np.pi)) if math.isfinite(turned) else 0
        spent = self.budget.exhausted
        return Scan(
            _distinct(zeros, self.dt), motions, self.rows + 1, tuple(open_cells), winding, spent
        )

    def _taken(self, waiting: list[Any], batch: int) -> Any:
        """The next edges, or as many intervals as fit a batch."""
        if isinstance(waiting[-1], np.ndarray):
            return waiting.pop()
        parts = [waiting.pop()]
        while (
            waiting
            and isinstance(waiting[-1], Intervals)
            and sum(len(p.left) for p in parts) < batch // 2
        ):
            parts.append(waiting.pop())
        return Intervals(
            *(np.concatenate(columns, axis=-1) for columns in zip(*parts, strict=True))
        )

    def motions(self, theta2: np.ndarray) -> np.ndarray:
        """G of the motions released at (theta1, theta2), shape (4, 2, rows + 1, n)."""
        zero = np.zeros_like(theta2)
        each = State(zero + self.theta1, theta2, zero, zero), State(zero, zero + 1, zero, zero)
        shared = jax.tree.map(float, (self.pendulum, self.dt))
        parts = [_at_rest(self.pendulum, self.theta1, theta2)]
        for _ in range(self.rows // _WINDOW):
            each, rows = over_lanes(_window, shared, each)
            parts.append(np.swapaxes(rows, 0, 1))
        self.budget.spend(self.rows * theta2.size)
        table = np.concatenate(parts, axis=1).reshape(4, 2, self.rows + 1, -1)
        if not (self.coarse or np.all(np.isfinite(table))):
            raise _TooCoarse
        table /= np.array([1 + self.pendulum.m2, self.pendulum.m2 * self.pendulum.l2**1.5])[
            :, None, None
        ]
        time = self.dt * np.arange(1, self.rows + 1)[:, None]
        for value, slope in ((0, 1), (2, 3)):
            table[value, :, 1:] /= time
            table[slope, :, 1:] = (table[slope, :, 1:] - table[value, :, 1:]) / time
        return (
            _without_equilibria(table, theta2)
            if abs(math.sin(self.theta1)) < _AT_EQUILIBRIUM
            else table
        )

    def _halved(self, some: Intervals) -> "tuple[Half, Half]":
        """Both halves of all intervals, and how far the middles are from what the whole ones
        foretold.
        """
        middle = 0.5 * (some.left + some.right)
        there = self.motions(middle)
        width = some.right - some.left
        start, end = some.at_left, some.at_right
        value = 0.5 * (start[0] + end[0]) + width / 8 * (start[2] - end[2]) - there[0]
        slope = 1.5 * (end[0] - start[0]) / width - 0.25 * (start[2] + end[2]) - there[2]
        error = _CLEARANCE * largest_nearby(
            np.max(np.maximum(np.abs(value), width / 8 * np.abs(slope)), axis=0)
        )
        return (
            Half(Intervals(some.left, middle, some.at_left, there), error),
            Half(Intervals(middle, some.right, there, some.at_right), error),
        )

    def _looked_at(self, some: Intervals, error: np.ndarray) -> tuple[list[Zero], np.ndarray]:
        """The zeros in the cells of these intervals, and in which intervals a cell is undecided."""
        row, lane = np.nonzero(self._maybe(some, error))
        undecided = np.zeros(len(some.left), bool)
        if not row.size:
            return [], undecided
        net = bernstein_net(some, row, lane, self.dt)
        along_time = self._error_in_time(some, row, lane)
        height = np.max(np.abs(net[:, -1] - net[:, 0]), axis=(0, 1))
        if not self.coarse and np.any(along_time > _COARSE * height):
            raise _TooCoarse
        zeros: list[Zero] = []
        cells = Cells(net, error[row, lane] + along_time, np.arange(row.size), np.zeros(row.size))
        for split in range(SPLITS + 1):
            with np.errstate(all="ignore"):
                told = cells.told()
            whole = cells.whole[told.simple]
            width = (some.right - some.left)[lane[whole]]
            theta2 = some.left[lane[whole]] + told.where[0] * width
            time = self.dt * (row[whole] + cells.start[told.simple] + told.where[1] / 2**split)
            table = np.stack([theta2, time, told.sign, width, np.full_like(time, self.dt)], axis=1)
            inside = np.all((told.where > -_EDGE) & (told.where < 1 + _EDGE), axis=0) & (
                time <= self.dt * self.rows
            )
            zeros += [Zero(*each) for each in table[inside].tolist()]
            late = cells.bent_in_time(told.open) & (split < SPLITS)
            undecided[lane[cells.whole[told.open[~late]]]] = True
            again = told.open[late]
            again = again[~undecided[lane[cells.whole[again]]]]
            if not again.size:
                break
            cells = cells.halved(again, split)
        return zeros, undecided

    def _maybe(self, some: Intervals, error: np.ndarray) -> np.ndarray:
        """The cells that a bound too simple to be sharp cannot tell to be empty, shape (rows,
        n).
        """
        width, dt = (some.right - some.left) / 3, self.dt / 3
        corners = [
            end[:, :, rows]
            for end in (some.at_left, some.at_right)
            for rows in (slice(-1), slice(1, None))
        ]
        middle = sum(corner[0] for corner in corners)
        towards = middle / np.maximum(np.hypot(*middle), np.finfo(float).tiny)
        lowest = np.full(towards.shape[1:], np.inf)
        for corner in corners:
            value, by_time, by_angle, mixed = corner[:, 0] * towards[0] + corner[:, 1] * towards[1]
            reach = dt * np.abs(by_time) + width * np.abs(by_angle) + dt * width * np.abs(mixed)
            np.minimum(lowest, value - reach, out=lowest)
        return ~(lowest > 1.5 * error)

    def _error_in_time(self, some: Intervals, row: np.ndarray, lane: np.ndarray) -> np.ndarray:
        """What the cubics along time miss, from every other row."""
        missed = np.zeros(row.size)
        for middle in (row, row + 1):
            middle = np.clip(middle, 1, self.rows - 1)
            for end in (some.at_left, some.at_right):
                before, here, after = (end[:2, :, middle + k, lane] for k in (-1, 0, 1))
                foretold = 0.5 * (before[0] + after[0]) + self.dt / 4 * (before[1] - after[1])
                missed = np.maximum(missed, np.max(np.abs(foretold - here[0]), axis=0))
        return missed / 16


def _places(some: Intervals) -> list[tuple[float, float]]:
    """Where intervals begin, and how wide they are."""
    return list(zip(some.left.tolist(), (some.right - some.left).tolist(), strict=True))


def _window(
    shared: tuple[Pendulum, Any], each: tuple[State, State]
) -> tuple[tuple[State, State], Any]:
    """A motion and its tangent _WINDOW rows later, and on the way p, p', and their tangents, shape
    (_WINDOW, 8).
    """
    pendulum, dt = shared
    constants = _METHOD.constants(pendulum, dt)

    def step(carry: Any, _: None) -> Any:
        point, tangent = _METHOD.move_tangents(constants, *carry)
        return (point, tangent), _row(pendulum, _METHOD.leave(constants, point), tangent)

    start = _METHOD.enter(pendulum, each[0]), each[1]
    (point, tangent), rows = lax.scan(step, start, None, length=_WINDOW)
    return (_METHOD.leave(constants, point), tangent), rows


def _row(pendulum: Pendulum, state: State, tangent: State) -> Any:
    rate, change = jax.jvp(partial(vector_field, pendulum), (state,), (tangent,))
    return jnp.stack(
        [state.p1, state.p2, rate.p1, rate.p2, tangent.p1, tangent.p2, change.p1, change.p2]
    )


def _at_rest(pendulum: Pendulum, theta1: float, theta2: np.ndarray) -> np.ndarray:
    """The rows at t = 0 as G has them there: p/t tends to p', whose slope in time vanishes; shape
    (8, 1, n).
    """
    force1 = -(pendulum.m1 + pendulum.m2) * pendulum.g * pendulum.l1 * math.sin(theta1)
    force2 = -pendulum.m2 * pendulum.g * pendulum.l2
    zero = np.zeros_like(theta2)
    rows = [
        zero + force1,
        force2 * np.sin(theta2),
        zero,
        zero,
        zero,
        force2 * np.cos(theta2),
        zero,
        zero,
    ]
    return np.stack(rows)[:, None]


# Releases with the upper rod upright or hanging to within this [rad] share a column of equilibria.
_AT_EQUILIBRIUM = 1e-12


def _without_equilibria(table: np.ndarray, theta2: np.ndarray) -> np.ndarray:
    """G/sin(theta2), for theta1 in {0, pi}: there G vanishes at both equilibria whatever the time,
    and is odd about them, so that its slope takes its place and the slope's vanishes.
    """
    sine, cosine = np.sin(theta2), np.cos(theta2)
    still = np.abs(sine) < _AT_EQUILIBRIUM
    divisor = np.where(still, 1.0, sine)
    values, slopes = table[:2], table[2:]
    with np.errstate(all="ignore"):
        new_values = np.where(still, slopes / cosine, values / divisor)
        new_slopes = np.where(still, 0.0, (slopes - new_values * cosine) / divisor)
    return np.concatenate([new_values, new_slopes])


def _distinct(zeros: list[Zero], dt: float) -> tuple[Zero, ...]:
    """In order of theta2 in (-pi, pi], each once: those on an edge of their cell are found from
    both its sides.
    """
    kept: list[Zero] = []
    for zero in sorted(zeros, key=lambda zero: zero.time):
        theta2 = zero.theta2 - 2 * np.pi * math.ceil(zero.theta2 / (2 * np.pi) - 0.5 - 1e-12)
        zero = zero._replace(theta2=theta2)
        recent = itertools.takewhile(partial(_within, zero, _SAME * dt), reversed(kept))
        if not any(_one(zero, other) for other in recent):
            kept.append(zero)
    return tuple(sorted(kept))


def _within(later: Zero, time: float, earlier: Zero) -> bool:
    return later.time - earlier.time < time


def _one(zero: Zero, other: Zero) -> bool:
    apart = abs(math.remainder(other.theta2 - zero.theta2, 2 * np.pi))
    return apart < _SAME * max(zero.width, other.width) and other.sign == zero.sign
