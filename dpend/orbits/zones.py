"""Where other curves cross a family: the stretches in which nothing finer can be told."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dpend.orbits.curve import concatenate, curve_of, select
from dpend.orbits.follow import FamilyProblem
from dpend.orbits.newton import METRIC, Solved
from dpend.orbits.samples import Samples, Spot, Track, measure_of
from dpend.orbits.walk import CROSSING


@dataclass(frozen=True, eq=False)
class Zone:
    """A stretch of a curve where another one is so close that points on it have the tangent of
    either.
    """

    place: float  # of the crossing
    ends: np.ndarray
    rows: Solved  # at both ends

    def row_at(self, problem: FamilyProblem, where: float) -> Solved:
        """The point at an arclength in it; slopes there are those between its ends.

        Where no Newton's iteration converges, on the crossing itself, a point next to it stands for
        it.
        """
        chord, index = curve_of(self.rows), np.zeros(len(_BESIDE), int)
        shares = (where + np.array(_BESIDE) - self.ends[0]) / (self.ends[1] - self.ends[0])
        tangents, steps = chord.tangents_between(index, shares), chord.steps[index + 1]
        rows = problem.correct(chord.between(index, shares), METRIC * tangents, steps)
        best = int(np.argmax(rows.converged > 0))
        mixed = {
            name: np.einsum("i,i...->...", [1 - shares[0], shares[0]], getattr(self.rows, name))[
                None
            ]
            for name in ("tangent", "time_slope", "energy_slope")
        }
        return select(rows, slice(best, best + 1))._replace(**mixed)

    def steepness(self, problem: FamilyProblem) -> float:
        """The slope of c, of brake orbits kappa, between its ends."""
        return float(
            np.diff(measure_of(self.rows, problem.symmetry))[0] / (self.ends[1] - self.ends[0])
        )

    def holds(self, low: float, high: float) -> bool:
        """Whether a stretch of the curve contains it."""
        return bool(low <= self.ends[0] and self.ends[1] <= high)


# Crossings are located to this [arclength]: nearer to them the determinant's sign is noise.
_APART = 1e-6
# Where a point of a zone is looked for, from its own place [arclength].
_BESIDE = (0.0, 1e-5, -1e-5, 5e-5, -5e-5)


def find_zones(track: Track, samples: Samples) -> list[Zone]:
    """The stretches of a curve where the determinant changes sign, found by bisection; those that
    overlap are one.
    """
    where, side = samples.where, samples.rows.side
    (changes,) = np.nonzero(side[:-1] * side[1:] < 0)
    if not changes.size:
        return []
    low, high = where[changes], where[changes + 1]
    while np.max(high - low) > _APART:
        middle = 0.5 * (low + high)
        before = track.rows_at(middle).side == side[changes]
        low, high = np.where(before, middle, low), np.where(before, high, middle)
    places = 0.5 * (low + high)
    # Where the walk had to leap, the curves turn into each other: ten times as far away by a
    # twentieth at most.
    wide = np.where(where[changes + 1] - where[changes] > 4 * CROSSING, 10 * CROSSING, CROSSING)
    starts, ends = np.maximum(places - wide, where[0]), np.minimum(places + wide, where[-1])
    groups = np.cumsum(np.append(True, starts[1:] > ends[:-1]))
    zones = []
    for group in np.unique(groups):
        mine = np.flatnonzero(groups == group)
        edges = np.array([starts[mine[0]], ends[mine[-1]]])
        zones.append(Zone(float(np.mean(places[mine])), edges, track.rows_at(edges)))
    return zones


def outside(zones: Sequence[Zone], samples: Samples, *, with_ends: bool = False) -> Samples:
    """The samples that are in no zone; the zones' ends themselves are."""
    apart = np.ones(len(samples.where), bool)
    for zone in zones:
        inside = (samples.where >= zone.ends[0]) & (samples.where <= zone.ends[1])
        apart &= ~inside if with_ends else ~inside | np.isin(samples.where, zone.ends)
    kept = Samples(samples.where[apart], select(samples.rows, apart))
    return (
        merge_samples(kept, *(Samples(zone.ends, zone.rows) for zone in zones))
        if with_ends
        else kept
    )


def merge_samples(*parts: Samples) -> Samples:
    where = np.concatenate([part.where for part in parts])
    order = np.argsort(where, kind="stable")
    return Samples(where[order], select(concatenate(*(part.rows for part in parts)), order))


def overlaps(spot: Spot, crossings: Sequence[Spot]) -> bool:
    return any(abs(spot.where - other.where) <= spot.error + other.error for other in crossings)
