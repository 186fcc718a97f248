"""Where the windows of a fit start: from the smoothed data, and window by window where a rod is not
seen.
"""

import math
from typing import NamedTuple

import numpy as np

from dpend.inverse.gauss_newton import PRICES, descent, misses_of, price_squares
from dpend.inverse.measurements import best_width, local_cubics, wrap
from dpend.inverse.windows import Point, Settings, WindowedData, ends_of, run

# A cubic is not trusted across a space of this many usual ones ...
_WIDE = 3.5
# ... unless the space is shorter than this, over the slow mode's frequency.
_SHORT = 0.1
# All windows are tried at once if more than this share of the nodes is known. Cubics through a gap
# may do; if not, the residuals show it.
MOSTLY = 0.9
# What is tried for a hidden rod: so many angles, and these velocities [of the slow mode's rate].
_ANGLES, _VELOCITIES = 24, np.linspace(-4.5, 4.5, 13)
# How many of these starts go on.
_STARTS = 24
# How many windows there are at first, tried in this order: some two thirds of a swing. Fewer leave
# a hidden rod free to go anywhere; a wrong pendulum does not lead through more.
FIRST = (12, 16, 8)
# How many windows are added at a time.
_ADDED = 4
# How many candidate starts survive each round.
_LEFT = (8, 5, 4, 3, 2, 2, 1)
# A candidate is dropped if it costs this many times the best.
_WORSE = 30.0
# The search gives up if even the best misses the data by this many times the noise, after the last
# round above.
_LOST = 5.0
# Added windows are at a wrong minimum if an angle costs more than this many variances of the noise.
_POOR = 3.0
# The prices of joints behind a gap in the data, where the motion may come out far from them.
_WIDE_OPEN = (1.0, 0.3, 0.03)
# Only so many windows are fitted again: what comes next depends on the last swings.
_LOOKED_BACK = 64


class _Start(NamedTuple):
    """What the data say of the nodes before anything is fitted."""

    nodes: np.ndarray  # (4, K), zero where unknown
    known: np.ndarray  # (2, K), of which rod's angle and velocity
    noise: float


def smooth_start(
    problem: WindowedData,
    times: np.ndarray,
    angles: np.ndarray,
    initial: tuple[float | None, ...],
    rate: float,
) -> _Start:
    """Nodes from local cubics through the samples about them, and from what is held."""
    count = problem.times.size
    nodes, known, variances = np.zeros((4, count)), np.zeros((2, count), bool), []
    for rod, column in enumerate(angles):
        there = np.isfinite(column)
        if not np.any(there):
            continue
        when, values = times[there], np.unwrap(column[there])
        half, noise = best_width(when, values)
        cubics = local_cubics(when, values, problem.times, half)
        spaces = np.diff(when)
        widest = np.max(spaces[cubics.samples[:, :-1]], axis=1)
        known[rod] = widest <= max(_WIDE * float(np.median(spaces)), _SHORT / rate)
        known[rod] &= (
            cubics.nearest <= widest
        )  # beyond the first and the last sample a cubic knows nothing
        nodes[rod], nodes[2 + rod] = cubics.value, cubics.slope
        variances.append(noise**2)
    known[:, 0] |= problem.held[:2] & problem.held[2:]
    nodes[:, 0] = [
        node if value is None else value for node, value in zip(nodes[:, 0], initial, strict=True)
    ]
    return _Start(nodes, known, math.sqrt(float(np.mean(variances))))


def all_at_once(
    problem: WindowedData, start: _Start, settings: Settings, first: int
) -> tuple[Point, int]:
    """All nodes from the smoothed data, where nearly all are known."""
    point, total = Point(start.nodes, np.zeros(problem.by_free.shape[1])), 0
    for price in PRICES:
        point, _, count = descent(problem, point, price, settings)
        total += count
    return point, total


def _predict(
    problem: WindowedData, start: _Start, point: Point, upto: int, settings: Settings
) -> Point:
    """The point with nodes up to `upto`: what is known of them from the data, the rest from the
    motion so far.
    """
    nodes = list(point.nodes.T)
    for k in range(len(nodes), upto):
        here = problem._replace(dts=problem.dts[:, k - 1 : k])
        _, ends = run(here, Point(nodes[-1][:, None], point.fields), settings.steps[0], ends_of)
        nodes.append(np.where(np.tile(start.known[:, k], 2), start.nodes[:, k], ends[:, 0]))
    return Point(np.stack(nodes, axis=1), point.fields)


def _candidates(
    problem: WindowedData, start: _Start, settings: Settings, windows: int
) -> list[Point]:
    """First nodes: the known one, or those of a grid for a hidden rod that do better than their
    neighbours.
    """
    fields = np.zeros(problem.by_free.shape[1])
    if np.all(start.known[:, 0]):
        return [Point(start.nodes[:, :1], fields)]
    grid = np.meshgrid(
        np.arange(_ANGLES) * (2 * np.pi / _ANGLES), settings.rate * _VELOCITIES, indexing="ij"
    )
    nodes = np.repeat(start.nodes[:, :1], grid[0].size, axis=1)
    hidden = int(np.argmin(start.known[:, 0]))
    nodes[hidden], nodes[2 + hidden] = grid[0].ravel(), grid[1].ravel()
    nodes = np.where(problem.held[:, None], start.nodes[:, :1], nodes)
    first, cost = nodes, np.zeros(nodes.shape[1])
    for k in range(min(windows, problem.times.size)):
        here = problem._replace(dts=np.repeat(problem.dts[:, k : k + 1], nodes.shape[1], axis=1))
        angles, nodes = run(here, Point(nodes, fields), settings.steps[0], ends_of)
        missed = wrap(np.moveaxis(angles, 1, 0) - problem.measured[..., k : k + 1])
        cost += np.sum(np.where(problem.seen[..., k : k + 1], missed**2, 0.0), axis=(0, 1))
    table = np.pad(
        np.pad(cost.reshape(grid[0].shape), ((1, 1), (0, 0)), "wrap"),
        ((0, 0), (1, 1)),
        constant_values=np.inf,
    )
    lowest = (
        np.min(np.lib.stride_tricks.sliding_window_view(table, (3, 3)), axis=(2, 3)).ravel() >= cost
    )
    order = np.argsort(np.where(lowest, cost, np.inf))[: min(_STARTS, max(int(np.sum(lowest)), 1))]
    return [Point(first[:, i : i + 1], fields) for i in order]


def window_by_window(
    problem: WindowedData, start: _Start, settings: Settings, first: int
) -> tuple[Point, int]:
    """Each node where the motion fitted so far leads, from `first` windows on: for rods and times
    without data.
    """
    points, total, upto, left = _candidates(problem, start, settings, first), 0, 0, list(_LEFT)
    while upto < problem.times.size:
        upto = min(upto + (_ADDED if upto else first), problem.times.size)
        found = []
        for point in points:
            cost, after, count = _extend(problem, start, point, upto, settings, len(points) == 1)
            total += count
            found.append((cost, after))
            if (
                upto == first
                and cost < _POOR * settings.noise**2 * problem.part(0, upto).observations
            ):
                break  # wrong ones cost ten times as much
        found.sort(key=lambda pair: pair[0])
        points = [
            point
            for cost, point in found[: left.pop(0) if left else 1]
            if cost <= _WORSE * found[0][0]
        ]
        seen = problem.part(max(0, upto - _LOOKED_BACK), upto).observations
        if not left and not found[0][0] < (_LOST * settings.noise) ** 2 * max(seen, 1):
            return _predict(problem, start, found[0][1], problem.times.size, settings), total
    for price in PRICES[1:]:
        points[0], _, count = descent(problem, points[0], price, settings)
        total += count
    return points[0], total


def _extend(
    problem: WindowedData, start: _Start, point: Point, upto: int, settings: Settings, alone: bool
) -> tuple[float, Point, int]:
    """The cost of the last windows up to `upto`, and the point with their nodes fitted.

    What was added may have gone to a wrong minimum. Then, unless there are other starts, one window
    at a time does better where a rod is hidden, and joints opened wide where the motion has come
    out of a gap in the data.
    """
    before = point.nodes.shape[1]
    if before == 1 or not alone:
        return _fit_up_to(problem, start, point, upto, PRICES[before > 1 : 2], settings)
    total, best = 0, (math.inf, math.inf, point)
    for sizes, prices in (
        ((upto,), PRICES[1:2]),
        (range(before + 1, upto + 1), PRICES[1:2]),
        ((upto,), _WIDE_OPEN),
    ):
        trial = point
        for size in sizes:
            cost, trial, count = _fit_up_to(problem, start, trial, size, prices, settings)
            total += count
        added = _cost_of_last(problem, trial, upto - before, settings)
        best = min(best, (added, cost, trial), key=lambda found: found[0])
        if added < 1.0:
            break
    return best[1], best[2], total


def _fit_up_to(
    problem: WindowedData,
    start: _Start,
    point: Point,
    upto: int,
    prices: tuple[float, ...],
    settings: Settings,
) -> tuple[float, Point, int]:
    point = _predict(problem, start, point, upto, settings)
    behind = max(0, upto - _LOOKED_BACK)
    part, total, cost = problem.part(behind, upto), 0, math.inf
    recent = Point(point.nodes[:, behind:], point.fields)
    for price in prices:
        recent, cost, count = descent(part, recent, price, settings)
        total += count
    return cost, Point(np.hstack([point.nodes[:, :behind], recent.nodes]), recent.fields), total


def _cost_of_last(problem: WindowedData, point: Point, count: int, settings: Settings) -> float:
    """What the last windows and the joints before them cost, over what noise may make it."""
    upto = point.nodes.shape[1]
    behind = max(0, upto - count - 1)
    part, recent = problem.part(behind, upto), Point(point.nodes[:, behind:], point.fields)
    angles, ends = run(part, recent, settings.steps[0], ends_of)
    cost = misses_of(part, recent.nodes, angles, ends).cost(price_squares(PRICES[1], settings.rate))
    return cost / (_POOR * settings.noise**2 * (part.observations + 4))
