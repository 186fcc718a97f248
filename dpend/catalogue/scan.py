"""Every return of the motions that start on a circle: all zeros of G over their angle and time.

G(theta2, t) = p(t)/t of the motion released at (theta1, theta2), or G(phi, t) = sin(theta(t))/t of
the motion that leaves a place of {0, pi}^2 in the direction phi (see `rows`), is a smooth map of a
rectangle to the plane, and its zeros are the brake orbits of theta1, or the passing orbits of an
energy; the division takes away the line t = 0, where every motion is at rest, or at its place.
Lanes of motions with their tangent in the angle give G, both its slopes and the mixed derivative on
a grid, from which each cell has its bicubic; the convex hull of a bicubic's Bernstein coefficients
tells what a cell is:

- empty: the hull lies to one side of zero;
- simple: after multiplication with the inverse of its mean, the derivative is near enough to the
  unit matrix everywhere that the map is one to one: one zero at most, and Newton's method says
  whether it is there;
- neither: it is halved in time if it is bent more that way, else its interval of the angle is.

All of it holds up to the error of the bicubic. The error is measured wherever an interval is halved
and in every row, and the tests keep clear of it. A cell that is open at the narrowest interval
counts as suspicious. A second count knows nothing of cells: how often G at t = 0 goes round zero is
known, so that the signs of all zeros must add up to the winding number of G at the last time as the
angle goes once round, but for that.

In natural units, and in NumPy but for the lanes.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from dpend.catalogue.bicubic import (
    SPLITS,
    Cells,
    Half,
    Intervals,
    bernstein_net,
    error_in_time,
    largest_nearby,
    turn_along,
)
from dpend.catalogue.rows import Circle, TooCoarse, rows_for
from dpend.mechanics.linear import fast_frequency
from dpend.mechanics.pendulum import Pendulum

# Cells that are looked at together: as many as fit a cache.
_BATCH = 512 * 320
# The longest duration that can be scanned: the fast mode advances by this [rad]. Longer motions are
# known to no digit.
_LONGEST = 102.4
# The densest rows that a scan goes on to, if the cells' error along time asks for denser ones.
_MOST_ROWS = 8192
# Rows are too coarse if a cell that may hold a zero has an error along time above this share of its
# height.
_COARSE = 0.02
# The intervals of the angle whose motions foretell the cost of a search.
_PROBES = 128
# The share of the steepest intervals. Waves are counted with and without them, and the geometric
# mean is taken: the first is up to a hundred times too large, the second four times too small.
_STEEPEST = 0.05
# The motions that a wave of G along the angle costs: 8 to 46 over 30 slices of three pendulums.
MOTIONS_PER_WAVE = 20
# The returns to a wave: 2 to 7 over the same slices.
RETURNS_PER_WAVE = 3
# Intervals narrower than this [rad] are not halved: magnified as the tangent is, rounding would be
# all that is left.
_NARROWEST = 1e-11
# The share of the measured error that is kept clear of: halving an interval takes a cubic's error
# down sixteen times.
_CLEARANCE = 0.25
# A zero counts if it lies outside of its cell by less than this share of it, for the bicubic may be
# off.
_EDGE = 0.02
# Two zeros of the same sign are one if they are nearer than this share of a cell: a zero on an edge
# is found from both sides.
_SAME = 0.1


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
    """What a scan has before it: rows of each motion, and waves that G makes along the angle."""

    rows: int
    waves: float


class Zero(NamedTuple):
    """A return: the start, the time, the sign of the Jacobian of G in (angle, t), and the width in
    the angle and the time between rows of the cell that it was found in.
    """

    angle: float
    time: float
    sign: float
    width: float
    row: float


@dataclass(frozen=True)
class Scan:
    """All zeros on the rectangle.

    Attributes:
        zeros: in order of the angle.
        motions: how many were integrated.
        rows: how many times each was looked at.
        open_cells: (angle, width) of intervals that were left undecided: too narrow to halve,
            beyond the budget, or not finite.
        winding: of G round the rectangle, which is kept left: clockwise at the last time as the
            angle goes round, and anticlockwise at t = 0.
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


def scan_circle(circle: Circle, duration: float, intervals: int, budget: Budget) -> Scan:
    """All returns up to `duration`, from so many intervals of the angle to begin with.

    Arguments:
        duration: in natural units, at most `longest`.
        budget: what the scan, and others, may spend.
    """
    rows = rows_for(circle, duration)
    while 2 * rows <= _MOST_ROWS:
        try:
            return _Scanner(circle, duration / rows, rows, False, budget).run(intervals)
        except TooCoarse:
            rows *= 2
    return _Scanner(circle, duration / rows, rows, True, budget).run(intervals)


def foresee(circle: Circle, duration: float) -> Outlook:
    """What `scan_circle` will take: from the slopes of a few motions, without looking for returns.

    The slope's mean over the angle, against the usual size of G, is the number of waves. It grows
    like the distance of neighbouring motions, and intervals must be as narrow as the waves.
    """
    rows = rows_for(circle, duration)
    probes = np.linspace(-np.pi, np.pi, _PROBES + 1)
    value, _, slope, _ = circle.rows(duration / rows, rows, probes, True)
    with np.errstate(all="ignore"):
        size, steep = (np.nan_to_num(np.hypot(*each)[1:], posinf=0.0) for each in (value, slope))
        steep = np.sort(steep / np.median(size, axis=1)[:, None], axis=1)
        usual = steep[:, : math.ceil((1 - _STEEPEST) * steep.shape[1])]
        waves = np.sqrt(np.mean(steep, axis=1) * np.mean(usual, axis=1))
    return Outlook(rows, float(np.max(waves[np.isfinite(waves)], initial=0.0)))


def longest(pendulum: Pendulum) -> float:
    """The longest duration that can be scanned."""
    return _LONGEST / float(fast_frequency(pendulum))


@dataclass(frozen=True)
class _Scanner:
    """The rectangle and its rows."""

    circle: Circle
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
            some = self._next_batch(waiting, batch)
            if isinstance(some, np.ndarray):  # edges whose motions are not known yet
                known = self.motions(some)
                motions += len(some)
                some = Intervals(some[:-1], some[1:], known[..., :-1], known[..., 1:])
            if self.budget.exhausted:
                open_cells += _places(some)
                turned += turn_along(some)
                continue
            for half in self._halve(some):
                found, undecided = self._classify(half.intervals, half.error)
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
        winding += self.circle.turns
        spent = self.budget.exhausted
        return Scan(
            _distinct(zeros, self.dt), motions, self.rows + 1, tuple(open_cells), winding, spent
        )

    def _next_batch(self, waiting: list[Any], batch: int) -> Any:
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

    def motions(self, angles: np.ndarray) -> np.ndarray:
        """G of the motions that start at these angles, shape (4, 2, rows + 1, n)."""
        self.budget.spend(self.rows * angles.size)
        return self.circle.rows(self.dt, self.rows, angles, self.coarse)

    def _halve(self, some: Intervals) -> "tuple[Half, Half]":
        """Both halves of all intervals; their error is how far the cubics miss the middles."""
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

    def _classify(self, some: Intervals, error: np.ndarray) -> tuple[list[Zero], np.ndarray]:
        """The zeros in the cells of these intervals, and in which intervals a cell is undecided."""
        row, lane = np.nonzero(self._maybe(some, error))
        undecided = np.zeros(len(some.left), bool)
        if not row.size:
            return [], undecided
        net = bernstein_net(some, row, lane, self.dt)
        along_time = error_in_time(some, row, lane, self.dt)
        height = np.max(np.abs(net[:, -1] - net[:, 0]), axis=(0, 1))
        if not self.coarse and np.any(along_time > _COARSE * height):
            raise TooCoarse
        zeros: list[Zero] = []
        cells = Cells(net, error[row, lane] + along_time, np.arange(row.size), np.zeros(row.size))
        for split in range(SPLITS + 1):
            with np.errstate(all="ignore"):
                kind = cells.classify()
            whole = cells.whole[kind.simple]
            width = (some.right - some.left)[lane[whole]]
            angle = some.left[lane[whole]] + kind.where[0] * width
            time = self.dt * (row[whole] + cells.start[kind.simple] + kind.where[1] / 2**split)
            table = np.stack([angle, time, kind.sign, width, np.full_like(time, self.dt)], axis=1)
            inside = np.all((kind.where > -_EDGE) & (kind.where < 1 + _EDGE), axis=0) & (
                time <= self.dt * self.rows
            )
            zeros += [Zero(*each) for each in table[inside].tolist()]
            late = cells.bent_in_time(kind.open) & (split < SPLITS)
            undecided[lane[cells.whole[kind.open[~late]]]] = True
            again = kind.open[late]
            again = again[~undecided[lane[cells.whole[again]]]]
            if not again.size:
                break
            cells = cells.halve(again, split)
        return zeros, undecided

    def _maybe(self, some: Intervals, error: np.ndarray) -> np.ndarray:
        """The cells that a simple bound does not show to be empty, shape (rows, n)."""
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


def _places(some: Intervals) -> list[tuple[float, float]]:
    """Where intervals begin, and how wide they are."""
    return list(zip(some.left.tolist(), (some.right - some.left).tolist(), strict=True))


def _distinct(zeros: list[Zero], dt: float) -> tuple[Zero, ...]:
    """In order of the angle in (-pi, pi], each once."""
    kept: list[Zero] = []
    for zero in sorted(zeros, key=lambda zero: zero.time):
        angle = zero.angle - 2 * np.pi * math.ceil(zero.angle / (2 * np.pi) - 0.5 - 1e-12)
        zero = zero._replace(angle=angle)
        if not _is_among(kept, zero, dt):
            kept.append(zero)
    return tuple(sorted(kept))


def _is_among(kept: list[Zero], zero: Zero, dt: float) -> bool:
    """Whether a zero is one of those kept, which are in order of time and none later."""
    for other in reversed(kept):
        if zero.time - other.time >= _SAME * dt:
            return False
        apart = abs(math.remainder(other.angle - zero.angle, 2 * np.pi))
        if apart < _SAME * max(zero.width, other.width) and other.sign == zero.sign:
            return True
    return False
