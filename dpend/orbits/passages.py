"""Where the curve of a family passes a wanted release angle, energy or period, and the points
there.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dpend.checks import Scalar
from dpend.orbits.arc import PARTS, arc_times
from dpend.orbits.curve import Curve
from dpend.orbits.follow import FamilyProblem
from dpend.orbits.newton import METRIC, Solved
from dpend.orbits.walk import hermite

# Each interval is looked at in this many pieces for passages.
_PIECES = 8
# Halvings of a piece, down to the last place of a share.
_HALVINGS = 50
# Rounds of Newton's method along the curve for a level: its square is below rounding after three.
_ROUNDS = 6
# A step along the curve below this [arclength] need not be made. Rounding leaves less than the
# second of an energy or the log of a period.
_ARRIVED, _MISSED = 1e-13, 1e-9


class Level(NamedTuple):
    """What orbits of a family can be asked by, and how it changes along the curve (natural units).

    Attributes:
        unit: of what users give.
        natural: (value in SI, problem) -> the target; it carries the derivatives of both.
        value, slope: of rows; the slope is with respect to arclength.
    """

    unit: str
    natural: Callable[[Any, FamilyProblem], Any]
    value: Callable[[Solved], np.ndarray]
    slope: Callable[[Solved], np.ndarray]


def _natural_energy(energy: Scalar, problem: FamilyProblem) -> Scalar:
    pendulum = problem.pendulum
    return energy / (pendulum.m1 * pendulum.g * pendulum.l1)


def _natural_period(period: Scalar, problem: FamilyProblem) -> Scalar:
    """The log of the arc's time."""
    pendulum = problem.pendulum
    return jnp.log(period / PARTS[problem.symmetry]) - 0.5 * jnp.log(pendulum.l1 / pendulum.g)


LEVELS = {
    "theta1": Level(
        "rad",
        lambda theta1, problem: theta1,
        lambda rows: rows.point[:, 0],
        lambda rows: rows.tangent[:, 0],
    ),
    "energy": Level("J", _natural_energy, lambda rows: rows.energy, lambda rows: rows.energy_slope),
    "period": Level(
        "s",
        _natural_period,
        lambda rows: np.log(rows.times.sum(axis=1)),
        lambda rows: rows.time_slope / rows.times.sum(axis=1),
    ),
}


def angle_passages(
    curve: Curve, targets: np.ndarray, crossing: int
) -> tuple[np.ndarray, np.ndarray]:
    """The interval (-1 where there is none) and the share of it at which |theta1| meets each
    target for the `crossing`-th time.
    """

    def angle(index: np.ndarray, share: np.ndarray) -> np.ndarray:
        return np.abs(curve.between(index, share)[:, 0])

    return _passages(angle, len(curve.points) - 1, targets, crossing)


def level_passages(
    problem: FamilyProblem,
    name: str,
    rows: Solved,
    curve: Curve,
    targets: np.ndarray,
    crossing: int,
) -> tuple[np.ndarray, np.ndarray]:
    """The same for the energy or the period, by cubics in arclength."""
    level, lengths = LEVELS[name], curve.lengths
    values, slopes = level.value(rows), level.slope(rows)
    if len(curve.points) > len(rows.point):  # the beginning at an equilibrium, where both are even
        start = curve.points[0]
        times, _ = _times(problem.natural, start)
        first = math.log(np.sum(times)) if name == "period" else problem.level_near(rows.energy[0])
        values, slopes = np.append(first, values), np.append(0.0, slopes)

    def value(index: np.ndarray, share: np.ndarray) -> np.ndarray:
        ends = values[index], slopes[index], values[index + 1], slopes[index + 1]
        return np.asarray(hermite(*ends, lengths[index], share))

    return _passages(value, len(lengths), targets, crossing)


_times = jax.jit(arc_times)


def _passages(
    value: Callable[[np.ndarray, np.ndarray], np.ndarray],
    intervals: int,
    targets: np.ndarray,
    crossing: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Where a function of (interval, share) meets each target for the `crossing`-th time."""
    pieces = np.arange(_PIECES) / _PIECES
    index, shares = np.repeat(np.arange(intervals), _PIECES), np.tile(pieces, intervals)
    seen = np.append(value(index, shares), value(np.array([intervals - 1]), np.ones(1)))
    below = seen[None, :] < targets[:, None]
    passed = np.cumsum(below[:, 1:] != below[:, :-1], axis=1)
    piece = np.argmax(passed >= crossing, axis=1)
    found = passed[:, -1] >= crossing
    low, high = shares[piece], shares[piece] + 1 / _PIECES
    starts_below = below[np.arange(len(targets)), piece]
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        same = (value(index[piece], middle) < targets) == starts_below
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return np.where(found, index[piece], -1), 0.5 * (low + high)


def onto_level(
    problem: FamilyProblem, name: str, targets: np.ndarray, rows: Solved, room: np.ndarray
) -> tuple[Solved, np.ndarray]:
    """The points of a family with the wanted energies or periods, by Newton's method along it from
    points close by, and whether they are met.

    Arguments:
        room: the longest step in arclength.
    """
    level = LEVELS[name]
    for _ in range(_ROUNDS):
        with np.errstate(divide="ignore", invalid="ignore"):
            way = (targets - level.value(rows)) / level.slope(rows)
        way = np.clip(np.nan_to_num(way), -room, room)
        if np.all(np.abs(way) < _ARRIVED):
            break
        points = rows.point + way[:, None] * rows.tangent
        rows = problem.correct(points, METRIC * rows.tangent, rows.steps)
    missed = np.abs(targets - level.value(rows)) > _MISSED * (1 + np.abs(targets))
    return rows, (rows.converged > 0) & ~missed
