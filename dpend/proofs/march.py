"""The whole circle of theta2 marched through time, and what stays open.

Boxes take the steps of `sheet`, their cells are sifted by `rests`. A box that a bound fails on is
halved, or takes half the step; one that is too narrow, or whose error has grown too large, is
given up, and all its cells from there on stay open.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from dpend.proofs import chebyshev
from dpend.proofs.balls import UNIT, gamma
from dpend.proofs.lanes import UP
from dpend.proofs.rests import Known, cells_of, empty, rates_of, sift
from dpend.proofs.sheet import ANGLES, TIMES, Front, Sheet, Step

# The first boxes: so many of half width 2^-6 rad, dyadic numbers. They cover the circle with
# 0.03 rad to spare.
BOXES, FIRST_HALF = 202, 2.0**-6
# Half width of the boxes [rad] that march again where rests stay open, and the cuts of their steps:
# their errors grow a hundred times less, and near a rest at 40 degrees are below 1e-7.
AGAIN_HALF, AGAIN_CUTS = 2.0**-16, 4
# The first step [natural units]: over it the rates of the momenta must not change their direction.
FIRST_STEP = 0.1
# Boxes that step together: 256 to 1024 take the same time within a tenth.
BATCH = 512
# Boxes narrower [rad], or steps shorter than this, are given up.
NARROWEST, SHORTEST = 2.0**-26, 2.0**-12
# A box whose error is larger is given up: momenta are of order 1.
LARGEST_ERROR = 0.1

GROWN = "The bound of the motions' errors has grown too large."
FAILED = "No bound of the motions' errors was found."
RESTING = "The momenta may stay zero after the release: an equilibrium is there, or near."
OPEN = "A rest in it is not excluded."


class Rectangle(NamedTuple):
    """Where a rest is not excluded: theta2 [rad], time in natural units, and why."""

    low: float
    high: float
    early: float
    late: float
    reason: str


class Tally(NamedTuple):
    """What a march did.

    Attributes:
        boxes: of theta2 at the end; steps: that were bounded, those that failed included; cells:
            that were looked at; error: the largest bound of a motion's error at the end.
    """

    boxes: int
    steps: int
    cells: int
    error: float

    def add(self, other: "Tally") -> "Tally":
        boxes, steps, cells, error = other
        worst = max(self.error, error)
        return Tally(self.boxes + boxes, self.steps + steps, self.cells + cells, worst)


def release(sheet: Sheet, theta1: float, off: float, boxes: Any = None) -> Front:
    """All releases with a theta1 that is within `off` of a float64 number.

    Arguments:
        boxes: middles and half widths of theta2, dyadic numbers, shape (2, L); the whole circle, if
            not given.
    """
    if boxes is None:
        middle = FIRST_HALF * (2 * np.arange(BOXES) + 1 - BOXES)
        boxes = np.stack([middle, np.full(BOXES, FIRST_HALF)])
    middle, half = boxes
    edge = np.zeros((4, len(half), ANGLES))
    edge[0, :, 0], edge[1, :, 0], edge[1, :, 1] = theta1, middle, half
    bounds = np.zeros((4, len(half)))
    bounds[0] = off
    late = np.full(len(half), FIRST_STEP)
    return Front(middle, half, np.zeros(len(half)), edge, sheet.norm(bounds), late)


def again(found: list[Rectangle]) -> Any:
    """Narrow boxes that cover the rectangles' theta2, for `release`."""
    cells = {
        k
        for one in found
        for k in range(
            math.floor(one.low / (2 * AGAIN_HALF)), math.floor(one.high / (2 * AGAIN_HALF)) + 1
        )
    }
    middle = (2 * np.array(sorted(cells), float) + 1) * AGAIN_HALF
    return np.stack([middle, np.full(len(cells), AGAIN_HALF)])


def _join(parts: list[Front]) -> Front:
    return Front(*(np.concatenate(x, 1 if x[0].ndim > 1 else 0) for x in zip(*parts, strict=True)))


def halve(sheet: Sheet, front: Front) -> Front:
    """Each box cut into two."""
    rounding = chebyshev.halving_error(ANGLES) * np.abs(front.edge).sum(-1) * UP
    error, parts = (front.error + sheet.norm(rounding)) * UP, []
    for half, side in zip(chebyshev.halves(ANGLES), (-0.5, 0.5), strict=True):
        middle, edge = front.middle + side * front.half, front.edge @ half.T
        parts.append(front._replace(middle=middle, half=front.half / 2, edge=edge, error=error))
    return _join(parts)


def arrive(sheet: Sheet, step: Step) -> Front:
    """The front at the end of a step."""
    first, later = step.series[:, :, 0], step.series[:, :, 1:]
    edge = first + later.sum(2)
    rounding = gamma(TIMES + 4) * np.abs(later).sum((2, 3)) + 2 * UNIT * np.abs(edge).sum(-1)
    error = (step.error + sheet.norm(rounding * UP)) * UP
    start, time = step.start, step.start.time + 2 * step.half
    return Front(start.middle, start.half, time, edge, error, np.full(len(time), np.inf))


def march(
    sheet: Sheet,
    front: Front,
    known: Known,
    end: float,
    progress: Callable[[float, float], None] | None = None,
) -> tuple[list[Rectangle], Tally]:
    """What stays open of all rests up to the time `end`, natural units.

    Arguments:
        progress: called with the area of (theta2, time) that is done, and with all of it.
    """
    found: list[Rectangle] = []
    boxes = steps = looked = 0
    error, area = 0.0, float(2 * front.half.sum() * end)
    while len(front.time):
        front = front.take(np.argsort(front.time, kind="stable"))
        batch, front = front.take(slice(BATCH)), front.take(slice(BATCH, None))
        # What is taken beyond the end is not looked at.
        step = sheet.step(batch._replace(longest=np.minimum(batch.longest, end - batch.time)))
        steps += len(batch.time)
        fine = np.isfinite(step.error) & (step.error < LARGEST_ERROR)
        begins = fine & (batch.time == 0)
        resting = np.zeros(len(fine), bool)
        resting[begins] = ~empty(rates_of(step.take(begins)))
        fine &= ~resting
        later = step.take(fine & ~begins)
        cells, count = sift(cells_of(later, sheet.components(later.error)[2:]), known, end)
        looked += count
        found += [Rectangle(*x, OPEN) for x in cells.edges()]
        next_front = arrive(sheet, step.take(fine))
        done = next_front.time >= end
        boxes += int(done.sum())
        error = max(error, float(next_front.error[done].max(initial=0.0)))
        retry, lost = _retry(sheet, step.take(~fine), resting[~fine], end)
        found += lost
        front = _join([front, next_front.take(~done), retry])
        if progress is not None:
            progress(area - float((2 * front.half * (end - front.time)).sum()), area)
    return found, Tally(boxes, steps, looked, error)


def _retry(sheet: Sheet, step: Step, resting: Any, end: float) -> tuple[Front, list[Rectangle]]:
    """Narrower boxes and shorter steps for what failed, and what is given up."""
    start = step.start
    narrow = (step.narrow | resting) & (start.half > NARROWEST)
    shorter = ~step.narrow & ~resting & (step.half > SHORTEST)
    grown = (start.error > LARGEST_ERROR / 2) | (np.isfinite(step.error) & ~resting)
    narrow, shorter = narrow & ~grown, shorter & ~grown
    lost = []
    for i in np.flatnonzero(~(narrow | shorter)):
        reason = RESTING if resting[i] else GROWN if grown[i] else FAILED
        middle, half = float(start.middle[i]), float(start.half[i])
        lost.append(Rectangle(middle - half, middle + half, float(start.time[i]), end, reason))
    again = start.take(shorter)._replace(longest=step.half[shorter])
    return _join([halve(sheet, start.take(narrow)), again]), lost


def merge(found: list[Rectangle]) -> list[Rectangle]:
    """Rectangles that touch, or nearly, and have the same reason, as one that holds them all."""
    out: list[Rectangle] = []
    for one in sorted(found):
        for i, other in enumerate(out):
            room = max(one.high - one.low, other.high - other.low)
            wait = max(one.late - one.early, other.late - other.early)
            if (
                one.reason == other.reason
                and one.low <= other.high + room
                and other.low <= one.high + room
                and one.early <= other.late + wait
                and other.early <= one.late + wait
            ):
                low, early = min(one.low, other.low), min(one.early, other.early)
                high, late = max(one.high, other.high), max(one.late, other.late)
                out[i] = Rectangle(low, high, early, late, one.reason)
                break
        else:
            out.append(one)
    return out if len(out) == len(found) else merge(out)


def distances(known: Known) -> Any:
    """How far the squares' middles are apart, shape (J, J); infinite on the diagonal."""
    apart = np.abs(known.theta2[:, None] - known.theta2)
    apart = np.abs(apart - 2 * math.pi * np.rint(apart / (2 * math.pi)))
    out = np.maximum(apart, np.abs(known.time[:, None] - known.time))
    np.fill_diagonal(out, np.inf)
    return out
