"""Every passing orbit of one energy up to a period.

`scan` finds all returns of the motions that leave the places of {0, pi}^2, `find_orbit` solves them
to rounding.
"""

import math
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from dpend._runtime import require_float64
from dpend.catalogue.atlas import Coverage
from dpend.catalogue.release import (
    MOST_SEARCH_STEPS,
    PERIOD_ROUNDING,
    STEPS_PER_ORBIT,
    are_returns,
    check_period,
    in_natural_units,
    make_budget,
    settle,
    steps_of,
)
from dpend.catalogue.rows import Passages
from dpend.catalogue.scan import Budget, Scan, Zero, foresee, scan_circle
from dpend.checks import known_number, one_of
from dpend.mechanics.pendulum import Pendulum, State
from dpend.orbits.find import find_orbit, swinging_pendulum
from dpend.orbits.orbit import PeriodicOrbit
from dpend.status import Status

# The places of {0, pi}^2, in units of pi.
_PLACES = ((0, 0), (0, 1), (1, 0), (1, 1))
# Two solves of one orbit: periods, relative.
_SAME_ORBIT = 1e-8


@dataclass(frozen=True, eq=False)
class Census:
    """All passing orbits of one energy.

    Attributes:
        pendulum: theirs.
        energy: theirs [J].
        max_period: how far was looked [s].
        orbits: in order of the period, each once, of mirror images one; `passing`, or `centred`
            where an orbit comes to rest as well.
        coverage: how they were found; its slices are the places of {0, pi}^2 that this energy
            reaches, its motions (`theta2_points`) and returns are told apart by the direction in
            which a motion leaves them.
    """

    pendulum: Pendulum
    energy: float
    max_period: float
    orbits: tuple[PeriodicOrbit, ...]
    coverage: Coverage

    def __len__(self) -> int:
        return len(self.orbits)


def find_orbits(
    pendulum: Pendulum | Any,
    *,
    energy: Any,
    max_period: Any,
    symmetry: Any,
    most_steps: Any = MOST_SEARCH_STEPS,
) -> Census:
    """Every orbit with this energy that passes {0, pi}^2 at two times, half its period apart, and
    whose period is at most `max_period`.

    At one energy the motions through such a place are a circle: p = sqrt(2 K) L (cos phi, sin phi),
    K being the kinetic energy and L L^T the inertia there. Those that come to such a place again
    are all zeros of (sin theta1, sin theta2) in (phi, t), found cell by cell (see `scan`), each
    place by itself, as `find_brake_orbits` finds the returns to rest.

    Arguments:
        pendulum: its fields are numbers; g positive.
        energy: [J], above that of the hanging pendulum; zero for both bobs at rest at the pivot's
            height.
        max_period: [s]. The number of orbits, and the time it takes, grows exponentially with it.
        symmetry: `passing`.
        most_steps: time steps of all motions, as of `find_brake_orbits`.
    Raises:
        ValueError: an energy at which nothing moves; max_period not positive, or so long that the
            fast normal mode would swing 32 times (of motions faster than all releases accordingly
            shorter), or that most_steps are not enough; another
            symmetry; g not positive; a traced argument; lengths, masses or g whose products leave
            the range of float64.
        RuntimeError: float64 is switched off in JAX.
    """
    require_float64()
    one_of("symmetry", symmetry, ("passing",))
    fixed = swinging_pendulum(pendulum)
    energy = float(known_number("energy", energy, unit="J"))
    most_steps = known_number("most_steps", most_steps, positive=True)
    max_period = check_period(fixed, max_period)
    scaled, half, second = in_natural_units(fixed, max_period)
    circles = _circles(scaled, energy, fixed)
    check_period(fixed, max_period, circles[0].faster)
    expected = sum(steps_of(foresee(circle, half)) for circle in circles)
    budget = make_budget(most_steps, expected, max_period)
    scans: list[Scan] = []
    unsettled, refinements = 0, 0
    for circle in circles:

        def scan(intervals: int, circle: Passages = circle) -> Scan:
            return scan_circle(circle, half, intervals, budget)

        result, refined, moved = settle(scan, budget)
        scans.append(result)
        unsettled, refinements = unsettled + moved, max(refinements, refined)
    orbits, lost = _Search(fixed, second, max_period, budget).solve(circles, scans)
    coverage = _cover(scans, refinements, lost + unsettled, budget.exhausted)
    return Census(fixed, energy, max_period, tuple(orbits), coverage)


def _cover(scans: list[Scan], refinements: int, doubtful: int, exhausted: bool) -> Coverage:
    """The sums over all places."""
    doubtful += sum(len(one.open_cells) + abs(one.winding - one.degree) for one in scans)
    return Coverage(
        theta2_points=sum(one.motions for one in scans),
        time_points=max(one.rows for one in scans),
        refinements=refinements,
        suspicious_cells=doubtful,
        winding=sum(one.winding for one in scans),
        degree=sum(one.degree for one in scans),
        slices=len(scans),
        exhausted=exhausted,
    )


def _circles(scaled: Pendulum, energy: float, fixed: Pendulum) -> list[Passages]:
    """The motions of this energy through each place that it reaches, in natural units."""
    unit = fixed.m1 * fixed.g * fixed.l1
    upper, lower = 1 + scaled.m2, scaled.m2 * scaled.l2
    levels = [
        -upper * math.cos(n1 * math.pi) - lower * math.cos(n2 * math.pi) for n1, n2 in _PLACES
    ]
    highest = (energy / unit - levels[0]) / (levels[-1] - levels[0])
    faster = math.sqrt(max(highest, 1.0))
    circles = [
        Passages(scaled, place, float(energy / unit - level), faster)
        for place, level in zip(_PLACES, levels, strict=True)
        if energy / unit > level
    ]
    if not circles:
        raise ValueError(
            f"energy must be above that of the hanging pendulum, {float(levels[0] * unit):g} J, "
            f"got {energy:g}: give a larger one"
        )
    return circles


def _in_time(circles: list[Passages], scans: list[Scan]) -> list[tuple[Zero, Passages]]:
    """The returns to all places, the earliest first: an orbit is met before its multiples."""
    pairs = zip(circles, scans, strict=True)
    returns = [(zero, circle) for circle, scan in pairs for zero in scan.zeros]
    return sorted(returns, key=lambda each: each[0].time)


@dataclass(frozen=True)
class _Search:
    """What the returns of a scan are solved with."""

    pendulum: Pendulum
    second: float
    max_period: float
    budget: Budget

    def solve(self, circles: list[Passages], scans: list[Scan]) -> tuple[list[PeriodicOrbit], int]:
        """The orbits to which the returns belong, in order of the period, and the number that
        Newton's method lost.
        """
        found: list[PeriodicOrbit] = []
        by_place = {circle.place: circle for circle in circles}
        known = {place: np.zeros((0, 2)) for place in by_place}
        lost = 0
        for zero, circle in _in_time(circles, scans):
            if np.any(are_returns(known[circle.place], zero)):
                continue
            orbit = None if self.budget.exhausted else self._orbit_of(zero, circle)
            own = {} if orbit is None else self._passages(orbit, by_place)
            if orbit is None or not np.any(are_returns(own[circle.place], zero)):
                lost += 1
                continue
            known = {place: np.vstack([known[place], own[place]]) for place in known}
            if float(orbit.period) <= self.max_period * (1 + PERIOD_ROUNDING):
                found.append(self._at_rest_too(orbit))
        return sorted(found, key=lambda orbit: float(orbit.period)), lost

    def _orbit_of(self, zero: Zero, circle: Passages) -> PeriodicOrbit | None:
        unit = self.pendulum.m1 * self.pendulum.l1**2 / self.second
        # Of mirror images the one whose angle is positive.
        p1, p2 = (float(p) for p in unit * circle.momenta(zero.angle % math.pi))
        theta1, theta2 = (math.pi * n for n in circle.place)
        state = State(theta1, theta2, p1, p2)
        period = 2 * zero.time * self.second
        self.budget.spend(2 * STEPS_PER_ORBIT)
        orbit = find_orbit(self.pendulum, state=state, period=period, symmetry="passing")
        return orbit if orbit.status == Status.CONVERGED else None

    def _passages(
        self, orbit: PeriodicOrbit, circles: dict[tuple[int, int], Passages]
    ) -> dict[tuple[int, int], np.ndarray]:
        """By place, the directions in which an orbit and its mirror image pass it, each beside half
        the period in natural units, shape (n, 2).
        """
        unit = self.pendulum.m1 * self.pendulum.l1**2 / self.second
        rows: dict[tuple[int, int], list[tuple[float, float]]] = {place: [] for place in circles}
        half = 0.5 * float(orbit.period) / self.second
        for state in (orbit.state, orbit.dual):
            theta1, theta2, p1, p2 = (float(x) for x in jax.tree.leaves(state))
            place = round(theta1 / math.pi) % 2, round(theta2 / math.pi) % 2
            angle = circles[place].angle(np.array([p1, p2]) / unit)
            rows[place] += [(angle, half), (angle + math.pi, half)]
        return {place: np.reshape(some, (-1, 2)) for place, some in rows.items()}

    def _at_rest_too(self, orbit: PeriodicOrbit) -> PeriodicOrbit:
        """The orbit as a centred one, if it is that."""
        state = State(*(float(x) for x in jax.tree.leaves(orbit.state)))
        period = float(orbit.period)
        centred = find_orbit(self.pendulum, state=state, period=period, symmetry="centred")
        same = abs(float(centred.period) / period - 1) < _SAME_ORBIT
        return centred if same and centred.status == Status.CONVERGED else orbit
