"""Extrema between the points of a family that may reach a value that is tested."""

from collections.abc import Callable

import numpy as np

from dpend.orbits.curve import select
from dpend.orbits.newton import Solved
from dpend.orbits.samples import Samples, Track, measure_of, test_functions
from dpend.orbits.zones import merge_samples

# Rounds in which an extremum is looked for between points, by parabolas.
_VERTICES = 5


def add_extrema(track: Track, samples: Samples) -> Samples:
    """The samples, and more about every extremum between them that may reach beyond a value that is
    tested: two changes of sign within a step would else not be seen.
    """
    symmetry = track.problem.symmetry
    measure = measure_of(samples.rows, symmetry)
    tests = test_functions(symmetry)
    ranged = [test for test in tests if test.kind.startswith(("above", "below", "resonance"))]
    levels = np.arcsinh([-float(test.value(samples.rows, 0 * measure)[0]) for test in ranged])
    triples = []
    heights: list[tuple[Callable[[Solved], np.ndarray], np.ndarray]] = [
        (lambda rows: np.arcsinh(measure_of(rows, symmetry)), levels),
        (lambda rows: rows.energy_slope, np.zeros(1)),
    ]
    if any(test.kind == "fold_theta1" for test in tests):
        heights.insert(1, (lambda rows: rows.tangent[:, 0], np.zeros(1)))
    for function, targets in heights:
        h = function(samples.rows)
        before, here, after = h[:-2], h[1:-1], h[2:]
        highest, lowest = (here >= before) & (here >= after), (here <= before) & (here <= after)
        sense = np.where(highest, 1.0, np.where(lowest, -1.0, 0.0))
        with np.errstate(over="ignore"):  # the energy of fast rotation is steep
            wide = np.sinh(h)
        reach = _in_reach(h, sense, targets) | _in_reach(wide, sense, np.sinh(targets))
        (near,) = np.nonzero((sense != 0) & reach)
        triples += [
            (function, samples.where[i : i + 3].copy(), h[i : i + 3] * sense[i], sense[i])
            for i in near
        ]
    more = []
    for _ in range(_VERTICES if triples else 0):
        spots = np.array([_vertex(place, height) for _, place, height, _ in triples])
        rows = track.rows_at(spots)
        more.append(Samples(spots, rows))
        for j, (function, place, height, sense) in enumerate(triples):
            _narrow(place, height, spots[j], sense * function(select(rows, slice(j, j + 1)))[0])
    return merge_samples(samples, *more)


def _in_reach(h: np.ndarray, sense: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Of points between two others, the highest or lowest of the three: whether the function may
    get to a target.

    A parabola's vertex lies beyond the highest of three even points by an eighth of their range at
    most.
    """
    before, here, after = h[:-2], h[1:-1], h[2:]
    with np.errstate(invalid="ignore"):  # beyond any float
        room = 0.5 * np.maximum(np.abs(before - here), np.abs(after - here))
        beyond = sense[:, None] * (targets - here[:, None])
        return np.asarray(np.any((beyond >= 0) & (beyond <= room[:, None]), axis=1))


def _vertex(place: np.ndarray, height: np.ndarray) -> float:
    """Where the parabola through three points, the middle one the highest, is highest; not on one
    of them.
    """
    left, right = place[1] - place[0], place[2] - place[1]
    fall_left, fall_right = (height[1] - height[0]) / left, (height[1] - height[2]) / right
    total = fall_left + fall_right
    shift = 0.5 * (fall_left * right - fall_right * left) / total if total > 0 else 0.0
    if abs(shift) < 1e-3 * min(left, right):
        shift = 1e-3 * (right if right > left else -left)
    return float(np.clip(place[1] + shift, place[0] + 1e-3 * left, place[2] - 1e-3 * right))


def _narrow(place: np.ndarray, height: np.ndarray, spot: float, top: float) -> None:
    """The three points about the maximum, when `spot` is known too."""
    points = np.append(place, spot)
    heights = np.append(height, top)
    order = np.argsort(points)
    middle = int(np.clip(np.argmax(heights[order]), 1, 2))
    place[:], height[:] = (
        points[order][middle - 1 : middle + 2],
        heights[order][middle - 1 : middle + 2],
    )
