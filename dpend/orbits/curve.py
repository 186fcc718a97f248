"""The curve through the points of a family, in NumPy: parts of it, both ways of it, and its return
to itself.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from dpend.orbits.newton import METRIC, Solved
from dpend.orbits.walk import hermite


@dataclass(frozen=True, eq=False)
class Curve:
    """Points of a curve with unit tangents; of a family that begins in a normal mode, the mode
    itself is the first.
    """

    points: np.ndarray
    tangents: np.ndarray
    steps: np.ndarray

    @property
    def lengths(self) -> np.ndarray:
        ways = np.diff(self.points, axis=0)
        return np.sqrt(np.sum(METRIC * ways**2, axis=1))

    def between(self, index: np.ndarray, share: np.ndarray) -> np.ndarray:
        """Points at shares of the intervals `index`, by cubics."""
        start, end = self.points[index].T, self.points[index + 1].T
        slope, end_slope = self.tangents[index].T, self.tangents[index + 1].T
        return np.asarray(hermite(start, slope, end, end_slope, self.lengths[index], share)).T

    def tangents_between(self, index: np.ndarray, share: np.ndarray) -> np.ndarray:
        mixed = (1 - share)[:, None] * self.tangents[index] + share[:, None] * self.tangents[
            index + 1
        ]
        return mixed / np.sqrt(np.sum(METRIC * mixed**2, axis=1))[:, None]


# Points at the beginning that are not looked at for a return; and what counts as one [rad, and log
# of the time].
LEAVING, SAME_PLACE = 4, 1e-7


def cut_at_return(rows: Solved, count: int) -> tuple[Solved, str]:
    """A curve that has come back after `count` points: closed, unless it only turned round at a
    branch point.

    Where it meets a more symmetric family, a curve goes on through the same orbits, met at their
    other rests, as often as it took to get there.
    """
    rows = select(rows, slice(count))
    lengths = np.cumsum(curve_of(rows).lengths)
    (crossings,) = np.nonzero(rows.side[:-1] != rows.side[1:])
    half = [i for i in crossings if abs(lengths[i] - 0.5 * lengths[-1]) < _MIDDLE * lengths[-1]]
    return (select(rows, slice(half[0] + 1)), "branch point") if half else (rows, "closed")


def drop_mirror_half(
    rows: Solved, ends: tuple[str, str], here: int, symmetry: str
) -> tuple[Solved, tuple[str, str]]:
    """The part of a curve of brake or passing orbits with the point `here` that does not hold them
    a second time, and its ends.

    Through a branch point, where its orbits become more symmetric ones, a curve goes on with the
    same orbits, met half a period later.
    """
    (crossings,) = np.nonzero(rows.side[:-1] != rows.side[1:])
    for i in crossings.tolist():
        if not _reflects(rows, i, symmetry):
            continue
        if here <= i:
            before = select(rows, slice(i + 1))
            return drop_mirror_half(before, (ends[0], "branch point"), here, symmetry)
        after = select(rows, slice(i + 1, None))
        return drop_mirror_half(after, ("branch point", ends[1]), here - i - 1, symmetry)
    return rows, ends


def half_of_closed(rows: Solved, symmetry: str) -> Solved | None:
    """Of a closed curve that holds its orbits twice, from a branch point to another and back, the
    half it begins in.
    """
    (crossings,) = np.nonzero(rows.side[:-1] != rows.side[1:])
    if crossings.size < 2 or not _reflects(rows, crossings[0], symmetry):
        return None
    return concatenate(
        select(rows, slice(crossings[-1] + 1, None)), select(rows, slice(crossings[0] + 1))
    )


def _reflects(rows: Solved, crossing: Any, symmetry: str) -> bool:
    """Whether the points on both sides of a crossing are each other's images: their orbits half a
    period later, in the mirror or not.
    """
    shorter, longer = sorted(
        (select(rows, slice(crossing + 1)), select(rows, slice(crossing + 1, None))),
        key=lambda part: len(part.point),
    )
    if len(shorter.point) < LEAVING:
        return False
    at = len(shorter.point) // 2  # far from the branch point, where all is close to all
    curve = release_and_time(longer, symmetry)
    for sign in (1.0, -1.0):
        end = sign * shorter.end[at, release_columns(symmetry)]
        image = np.append(end, release_and_time(shorter, symmetry)[at, 2])
        away, lengths = away_from(curve[:-1], curve[1:], image)
        nearest = int(np.argmin(away))
        if away[nearest] < _IMAGE * lengths[nearest]:
            return True
    return False


# How near to a chord an image is, as a share of its length.
_IMAGE = 0.05
# How far from the middle of its way a curve may have turned round, as a share of it.
_MIDDLE = 0.1


def release_columns(symmetry: str) -> slice:
    """Which coordinates of a first state tell orbits of one symmetry apart: the angles, of passing
    orbits the momenta.
    """
    return slice(2, 4) if symmetry == "passing" else slice(2)


def release_and_time(rows: Solved, symmetry: str) -> np.ndarray:
    """(theta1, theta2, log of the time), with momenta in the place of angles if passing."""
    first = rows.point[:, release_columns(symmetry)]
    return np.concatenate([first, np.log(rows.times.sum(axis=1))[:, None]], axis=1)


def way_to(where: np.ndarray, release: np.ndarray) -> np.ndarray:
    """From one (theta1, theta2, log of the time) to the other, angles modulo 2 pi; shape (...,
    3).

    Momenta are taken modulo 2 pi too: where two curves then seem to meet, `Family` looks closer.
    """
    way = release - where
    way[..., :2] -= 2 * np.pi * np.round(way[..., :2] / (2 * np.pi))
    return way


def away_from(
    start: np.ndarray, end: np.ndarray, release: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """How far a release is from the chords between points, and how long these are, shape (n,)
    both.
    """
    chord, to = end - start, way_to(start, release)
    length = np.maximum(np.linalg.norm(chord, axis=1), np.finfo(float).tiny)
    share = np.clip(np.sum(to * chord, axis=1) / length**2, 0.0, 1.0)
    return np.linalg.norm(to - share[:, None] * chord, axis=1), length


def select(rows: Solved, which: Any) -> Solved:
    return Solved(*(column[which] for column in rows))


def concatenate(*parts: Solved) -> Solved:
    return Solved(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def reversed_(rows: Solved) -> Solved:
    """The same points, met in the opposite order."""
    back = select(rows, slice(None, None, -1))
    return back._replace(
        tangent=-back.tangent,
        time_slope=-back.time_slope,
        energy_slope=-back.energy_slope,
        side=-back.side,
    )


def curve_of(rows: Solved) -> Curve:
    return Curve(rows.point, rows.tangent, rows.steps)
