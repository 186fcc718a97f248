"""Continuation: points of a family, the curve through them, its ends, and arcs for the families
that branch off.

Between the compiled walk (`walk`) and what users see (`family`). All in natural units and in NumPy:
what is done here between two calls of compiled code is done once in 32 points.
"""

import math
from dataclasses import dataclass, field

import jax
import numpy as np

from dpend.checks import Scalar
from dpend.executables import run_kept
from dpend.mechanics.pendulum import Pendulum
from dpend.orbits.arc import PARTS, SEGMENTS, UNKNOWNS, Arc, arc_of, lay_arc
from dpend.orbits.curve import (
    LEAVING,
    SAME_PLACE,
    Curve,
    concatenate,
    curve_of,
    cut_at_return,
    release_and_time,
    release_columns,
    select,
    way_to,
)
from dpend.orbits.newton import METRIC, Solved, linearise, unpack_table
from dpend.orbits.stability import OPPOSITE
from dpend.orbits.walk import CHUNK, FAST, NEARLY, Tasks, Walk, walk

# Resonances k:n are told, and followed, up to this k.
LARGEST_COVER = 6
# Steps in a segment where none were counted yet.
MANY_STEPS = 40
# Singular values below this share of the largest are zero.
_NO_RANK = 1e-3
# How far along the new direction the branch is looked for, and how much further to its side it may
# be.
_ONTO_BRANCH, _ASTRAY = (0.02, 0.005, 0.05, 0.001), 2.0


@dataclass(frozen=True)
class Reach:
    """How far a family is followed: the longest step in arclength, the most points, and the longest
    period.
    """

    step: float
    points: int
    period: float


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FamilyProblem:
    """What is followed: the pendulum as it was given, which may carry derivatives, and the same in
    natural units.
    """

    pendulum: Pendulum
    natural: Pendulum = field(metadata={"static": True})
    symmetry: str = field(metadata={"static": True})
    turns: tuple[float, float] = field(metadata={"static": True})

    @property
    def arc(self) -> Arc:
        return arc_of(self.symmetry, self.turns)

    def correct(self, points: np.ndarray, rows: np.ndarray, steps: np.ndarray) -> Solved:
        """The points of the family in the planes through `points` that `rows` are normal to."""
        tables = []
        for first in range(0, len(points), CHUNK):
            some = slice(first, first + CHUNK)
            count = len(points[some])
            tasks = Tasks(
                _pad(points[some]),
                _pad(rows[some]),
                _pad(steps[some]).astype(int),
                np.int64(count),
            )
            start = start_at(points[0], rows[0], 1.0, 1)
            given = self.natural, start, np.float64(1.0), tasks, self.arc
            _, table, _, _ = run_kept(walk, given)
            tables.append(np.asarray(table)[:count])
        return unpack_table(np.concatenate(tables))

    def follow_curve(self, start: Walk, origin: Solved | None, reach: Reach) -> tuple[Solved, str]:
        """The points after `start`, and what the family's end is; `origin` is the place it could
        come back to.
        """
        nothing = np.zeros((CHUNK, UNKNOWNS))
        tasks = Tasks(nothing, nothing, nothing[:, 0].astype(int), np.int64(0))
        tables: list[np.ndarray] = []
        count, end, begin = 0, "", start
        while not end and count < reach.points:
            given = self.natural, start, np.float64(reach.step), tasks, self.arc
            start, table, more, status = run_kept(walk, given)
            tables.append(np.asarray(table)[: int(more)])
            rows, count = unpack_table(np.concatenate(tables)), count + int(more)
            end = ("", "ended", "lost")[int(status)]
            if end == "lost" and len(rows.point) and self._near_limit(rows):
                end = "ended"
            (longer,) = np.nonzero(self.period(rows) > reach.period)
            if longer.size:
                rows = select(rows, slice(longer[0] + 1))
            back = None if origin is None else self._back(origin, rows, count - int(more))
            if back is not None:
                return cut_at_return(rows, back)
            if longer.size:
                return self._ending_at(reach.period, begin, rows), "longest period"
        if count > reach.points:
            return select(rows, slice(reach.points)), "unfinished"
        if end == "ended":
            end = self._end(rows)
        return rows, end or "unfinished"

    def period(self, rows: Solved) -> np.ndarray:
        return np.asarray(PARTS[self.symmetry] * rows.times.sum(axis=1))

    def _ending_at(self, period: float, begin: Walk, rows: Solved) -> Solved:
        """The rows, the last of which takes longer than `period`, with one of that period in its
        place; without, if the family was that long from its beginning.
        """
        last = curve_of(select(rows, slice(-2, None)))
        if len(rows.point) == 1:
            points, tangents = (
                np.vstack([begin.point, last.points]),
                np.vstack([begin.tangent, last.tangents]),
            )
            last = Curve(points, tangents, np.append(last.steps, last.steps))
        place, share = np.zeros(1, int), np.ones(1)
        end = select(rows, slice(-1, None))
        for _ in range(_APPROACH):
            rate = end.time_slope / end.times.sum(axis=1) * last.lengths
            share = np.clip(share - np.log(self.period(end) / period) / rate, 0.0, 1.0)
            tangent = last.tangents_between(place, share)
            end = self.correct(last.between(place, share), METRIC * tangent, last.steps[1:])
        found = end.converged[0] and abs(math.log(self.period(end)[0] / period)) < SAME_PLACE
        return concatenate(select(rows, slice(-1)), end) if found else select(rows, slice(-1))

    def on_curve(self, point: np.ndarray) -> Solved | None:
        """The point of the family near one that is nearly on it, its tangent not known; None if
        there is none.
        """
        row, steps = np.zeros(UNKNOWNS), np.array([MANY_STEPS])
        row[release_columns(self.symmetry)] = 0.6, 0.4  # crosses any curve but by accident
        row[-2] = 1.0
        for _ in range(3):
            rows = self.correct(point[None], row[None], steps)
            if not rows.converged[0]:
                return None
            point, row, steps = rows.point[0], METRIC * rows.tangent[0], rows.steps
        return rows

    def onto_branch(self, along: np.ndarray, point: np.ndarray, sign: float) -> Solved | None:
        """The first point of a branch that leaves a family, from its own orbit's point on this
        problem; None if nothing is met.

        Arguments:
            along: how the first state moves along the family.
        """
        for _ in range(
            3
            # onto the orbit, by the shortest ways: the equations have rank two less than unknowns
            # here
        ):
            value, jacobian = (
                np.asarray(x) for x in linearise(self.natural, point, MANY_STEPS, self.arc)
            )
            point = point - np.linalg.pinv(jacobian, rcond=_NO_RANK) @ value
        _, sizes, directions = np.linalg.svd(jacobian)
        if sizes[-1] > _NO_RANK * sizes[0]:
            return None
        kernel = directions[-2:] / np.sqrt(np.sum(METRIC * directions[-2:] ** 2, axis=1))[:, None]
        # The family's own direction is the one whose first node moves as the family's does.
        own = np.linalg.lstsq(kernel[:, :4].T, along, rcond=None)[0] @ kernel
        own /= np.sqrt(own @ (METRIC * own))
        new = kernel[np.argmin(np.abs(kernel @ (METRIC * own)))]
        new = new - (new @ (METRIC * own)) * own
        new *= np.sign(new[np.argmax(np.abs(new))]) / np.sqrt(new @ (METRIC * new))
        new *= sign
        for size in _ONTO_BRANCH:
            steps = np.array([MANY_STEPS])
            for _ in range(2):
                rows = self.correct((point + size * new)[None], (METRIC * new)[None], steps)
                steps = rows.steps
            strayed = rows.point[0] - point - size * new
            if rows.converged[0] and np.sqrt(strayed @ (METRIC * strayed)) < _ASTRAY * size:
                return rows
        return None

    @property
    def levels(self) -> np.ndarray:
        """The energies of the equilibria: hanging, with one rod upright, upright. In NumPy: eager
        JAX would compile.
        """
        upper, lower = float(1 + self.natural.m2), float(self.natural.m2 * self.natural.l2)
        return np.array([-upper - lower, lower - upper, upper - lower, upper + lower])

    def level_near(self, energy: float) -> float:
        """The energy of the equilibrium that is nearest in energy."""
        return float(self.levels[np.argmin(np.abs(self.levels - energy))])

    def _end(self, rows: Solved) -> str:
        """What a family has ended at: an equilibrium's energy, where the time grows like the
        logarithm of the distance from it, or an equilibrium, or rotation without end.
        """
        if rows.energy[-1] > FAST * self.levels[3]:
            return "fast rotation"
        gap = np.min(np.abs(rows.energy[-1] - self.levels))
        slows = abs(rows.time_slope[-1]) * gap > 1e-3 * abs(rows.energy_slope[-1])
        return "homoclinic" if slows else "normal mode"

    def _near_limit(self, rows: Solved) -> bool:
        """Whether a family was lost where rounding, magnified by the inverse distance, keeps it
        from its end.
        """
        gap = np.min(np.abs(rows.energy[-1] - self.levels[1:])) / self.levels[3]
        return bool(gap < NEARLY and abs(rows.energy_slope[-1]) < 1e3 * NEARLY * self.levels[3])

    def _back(self, origin: Solved, rows: Solved, since: int) -> int | None:
        """How many points it takes the curve to come back to `origin`, an orbit that it may meet at
        its other rest.
        """
        curve = curve_of(rows)
        own = release_and_time(origin, self.symmetry)[0]
        other = (
            2 * np.pi * np.asarray(self.turns) - own[:2]
            if self.symmetry in OPPOSITE
            else origin.end[0, release_columns(self.symmetry)]
        )
        where = release_and_time(rows, self.symmetry)
        for i in range(max(since - 1, LEAVING), len(where) - 1):
            chord = where[i + 1] - where[i]
            for release in (own, np.append(other, own[2])):
                apart = way_to(where[i], release)
                share = apart @ chord / (chord @ chord)
                near = np.linalg.norm(apart - share * chord) < 0.1 * np.linalg.norm(chord)
                if -0.1 < share < 1.1 and near and self._meets(curve, i, share, release):
                    return i + 1
        return None

    def _meets(self, curve: "Curve", i: int, share: float, release: np.ndarray) -> bool:
        """Whether the curve goes through the release, looked at on the curve itself."""
        for _ in range(4):
            index, shares = np.array([i]), np.array([share])
            tangent = curve.tangents_between(index, shares)
            rows = self.correct(
                curve.between(index, shares), METRIC * tangent, curve.steps[index + 1]
            )
            apart = way_to(release_and_time(rows, self.symmetry)[0], release)
            first = rows.tangent[0, release_columns(self.symmetry)]
            slope = np.append(first, rows.time_slope[0] / rows.times[0].sum())
            share += float(apart @ slope / (slope @ slope) / curve.lengths[i])
        return bool(np.linalg.norm(apart) < SAME_PLACE)


# Newton's iterations for the orbit of a period, from the end of a step.
_APPROACH = 6


def start_at(point: np.ndarray, tangent: np.ndarray, step: Scalar, steps: Scalar) -> Walk:
    # Always of these types: compiled code is keyed by them.
    length, size, side = np.array([0.0, step, 0.0])
    count, leap = np.array([steps, 0]).astype(int)
    return Walk(point, tangent, point, tangent, length, size, side, count, tangent, leap)


def _pad(array: np.ndarray) -> np.ndarray:
    missing = CHUNK - len(array)
    return np.concatenate([array, np.repeat(array[:1], missing, axis=0)])


def guess_arc(
    problem: FamilyProblem, times: np.ndarray, states: np.ndarray, duration: float
) -> np.ndarray:
    """A point to be corrected for an arc of `duration` on an orbit of which some states are
    known.
    """
    missing = _KNOWN - len(times)
    times = np.append(times, np.full(missing, np.inf))
    states = np.vstack([states, np.zeros((missing, 4))])
    return np.asarray(lay_arc(problem.natural, times, states, duration))


# Room for the known states of six periods of a centred orbit, so that the laying of arcs compiles
# once.
_KNOWN = 4 * SEGMENTS * LARGEST_COVER
