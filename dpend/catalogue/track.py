"""The track of a family over the square of releases, and which returns and passages belong
together.
"""

from dataclasses import dataclass

import numpy as np

from dpend.orbits.curve import away_from, way_to
from dpend.orbits.family import Family

# Spacing of the points of a family [arclength].
STEP = 0.02
# A release this near to a chord belongs to the family [rad, log period].
NEAR = 3e-3
# ... or within this share of the chord's length, where the curve bends.
_BENT = 0.05
# What a point of a family costs to follow, in time steps of a motion.
STEPS_PER_POINT = 2500
# What it costs to hold a return against a family, and one more for so many of its chords.
_STEPS_TO_HOLD, _CHORDS_PER_STEP = 5, 30
# In a slice, a return and a passage this near to each other are partners [rad, log period]. A curve
# that runs along the slice makes more of the error above.
_PARTNER = 0.03
# Two passages this near to each other may be one family that turns back there.
_PAIR = 0.1


@dataclass(frozen=True)
class Track:
    """A family, how it was found, and all its curves of releases: as it is, at the other rest, and
    in the mirror.

    Attributes:
        seed: the release (theta1, theta2) and period that it was followed from.
        level: of the slice that it was found on.
        chords: (theta1, theta2, log of the period) at their beginnings and ends, shape (n, 2, 3).
    """

    family: Family
    seed: tuple[float, float, float]
    level: int
    chords: np.ndarray

    @staticmethod
    def of(family: Family, seed: tuple[float, float, float], level: int) -> "Track":
        orbits = family.orbits
        time = np.log(np.asarray(orbits.period))
        own, other = (
            np.column_stack([np.asarray(x.theta1), np.asarray(x.theta2), time])
            for x in (orbits.state, orbits.dual)
        )
        flip = np.array([-1.0, -1.0, 1.0])
        curves = [own, own * flip] + ([other, other * flip] if family.symmetry == "brake" else [])
        chords = [np.stack([curve[:-1], curve[1:]], axis=1) for curve in curves]
        # Beyond a branch point a curve goes on with its own orbits at their other rests, in the
        # mirror or not; beyond an equilibrium with its own mirror image.
        for end, place in zip(family.ends, (0, -1), strict=True):
            if end in ("branch point", "normal mode"):
                images = [other[place], -other[place]] if end == "branch point" else [-own[place]]
                bridge = _bridge(own[place], np.stack(images))
                chords += [bridge, bridge * flip]
        return Track(family, seed, level, np.concatenate(chords))

    def holds(self, release: np.ndarray) -> bool:
        """Whether a point (theta1, theta2, log of the period) lies as near to a chord as the curve
        may be.
        """
        away, lengths = away_from(self.chords[:, 0], self.chords[:, 1], release)
        return bool(np.any(away < np.maximum(NEAR, _BENT * lengths)))

    def is_same(self, other: "Track") -> bool:
        """Whether two were followed along one family: most of the other's orbits lie on this one's
        curves.
        """
        orbits = other.family.orbits
        points = np.stack(
            [
                np.asarray(orbits.theta1),
                np.asarray(orbits.theta2),
                np.log(np.asarray(orbits.period)),
            ],
            axis=1,
        )
        return bool(np.mean([self.holds(point) for point in points]) > 0.5)

    @property
    def price(self) -> int:
        """What it takes to hold a return against it, in time steps of a motion."""
        return _STEPS_TO_HOLD + len(self.chords) // _CHORDS_PER_STEP

    def passages(self, theta1: float) -> np.ndarray:
        """(theta2, period) where it passes a slice, shape (n, 2)."""
        start, end = self.chords[:, 0], self.chords[:, 1]
        turns = np.round((start[:, 0] - theta1) / (2 * np.pi))
        before, after = (
            start[:, 0] - theta1 - 2 * np.pi * turns,
            end[:, 0] - theta1 - 2 * np.pi * turns,
        )
        (index,) = np.nonzero((before < 0) != (after < 0))
        share = before[index] / (before[index] - after[index])
        point = start[index] + share[:, None] * (end[index] - start[index])
        return np.column_stack([point[:, 1], np.exp(point[:, 2])])


def _bridge(point: np.ndarray, images: np.ndarray) -> np.ndarray:
    """The chord from a curve's end to the nearest of some images of it, shape (1, 2, 3)."""
    way = way_to(point, images) * [1, 1, 0]
    return np.stack([point, point + way[np.argmin(np.linalg.norm(way, axis=1))]])[None]


def _apart(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Distances between all pairs (theta2, period) [rad, and log of the period]."""
    one, other = (
        np.column_stack([0 * each[:, 0], each[:, 0], np.log(each[:, 1])]) for each in (one, other)
    )
    return np.asarray(np.linalg.norm(way_to(one[:, None], other), axis=-1))


def partnerless(returns: np.ndarray, passages: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Those of each kind that have no partner, the nearest having been matched first."""
    apart = _apart(returns, passages)
    free = np.ones(len(returns), bool), np.ones(len(passages), bool)
    for index in np.argsort(apart, axis=None):
        i, j = np.unravel_index(index, apart.shape)
        if apart[i, j] > _PARTNER:
            break
        if free[0][i] and free[1][j]:
            free[0][i] = free[1][j] = False
    return returns[free[0]], passages[free[1]]


def without_pairs(points: np.ndarray) -> np.ndarray:
    """Those that have no other close by."""
    apart = _apart(points, points) + np.diag(np.full(len(points), np.inf))
    return points[np.min(apart, axis=1, initial=np.inf) > _PAIR]
