"""The least squares of windows that meet: one banded linear problem an iteration, and the
descent.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from dpend.inverse.measurements import wrap
from dpend.inverse.windows import FARTHEST, Point, Settings, WindowedData, linearise, run
from dpend.status import Status

# Off-diagonals on either side of the banded matrix.
_BAND = 7
# Information below this share of its largest term is rounding error, not information.
ROUNDED = 1e-13
# The prices of a joint, one round of descent each, before the joints are closed. At price s, a miss
# of s [rad, and in rad/s times the slow frequency] costs as much as an angle's residual of 1 rad.
PRICES = (0.3, 0.03, 0.003)
# A weak prior: moving the logarithm of a field by this much costs as much as one residual of the
# size of the noise. It matters only for fields that the data do not determine, and the last
# iterations drop it.
_FAR = 0.5
# The most evaluations of a descent, and the most of Gauss and Newton's iterations.
_MOST_TRIALS, _MOST_ITERATIONS = 25, 25
# A descent ends when an iteration damped by at most `_FREELY` gains less than this share of the
# cost.
_LITTLE, _FREELY = 0.1, 1e-2
# The last iteration moves no field by more than this share of its standard error ...
_TOLERANCE = 1e-4
# ... or by rounding. Data without noise show rounding as moves below `_NOISE` that do not shrink.
_ROUNDING, _NOISE = 1e-12, 1e-8
# Joints are closed if they miss by less than this [rad, rad/s]. Rounding over a window makes some
# 1e-13 at tens of rad/s.
_CLOSED = 1e-9
# The integration error may move the fields by this share of a standard error. The step is halved
# for it at most so often.
_SMALL_SHARE, _HALVINGS = 0.1, 3


class _Misses(NamedTuple):
    angles: np.ndarray  # (2, intervals, K), fitted minus measured, 0 where nothing was
    first: np.ndarray  # (2,), the same at the first time
    joints: np.ndarray  # (4, K - 1), end of a window minus the next node

    @property
    def squares(self) -> float:
        return float(np.sum(self.angles**2) + np.sum(self.first**2))

    def cost(self, price: np.ndarray) -> float:
        cost = self.squares + float(np.sum(self.joints**2 / price))
        return cost if math.isfinite(cost) else math.inf


def misses_of(
    problem: WindowedData, nodes: np.ndarray, angles: np.ndarray, ends: np.ndarray
) -> _Misses:
    joints = ends[:, :-1] - nodes[:, 1:]
    joints[:2] = wrap(joints[:2])
    return _Misses(
        np.where(problem.seen, wrap(np.moveaxis(angles, 1, 0) - problem.measured), 0.0),
        np.where(problem.first_seen, wrap(nodes[:2, 0] - problem.first), 0.0),
        joints,
    )


class _Linear(NamedTuple):
    """The problem linearised about a point."""

    misses: _Misses
    extra: float  # what the fields themselves cost
    normal: np.ndarray  # (K, 7, 7), of a window's angles by its node and the three logarithms
    gradient: np.ndarray  # (K, 7)
    by_node: np.ndarray  # (K - 1, 4, 4), of the windows' ends
    by_logs: np.ndarray  # (K - 1, 4, 3)
    corner: np.ndarray  # (F, F), of the cost with respect to the fields
    slope: np.ndarray  # (F,)
    within: bool  # whether the fields are in the range that a pendulum is sought in

    def cost(self, price: np.ndarray) -> float:
        return self.misses.cost(price) + self.extra if self.within else math.inf


def _linear(problem: WindowedData, point: Point, steps: int, prior: float = 0.0) -> _Linear:
    """Arguments: prior: what the fields' distance from their start costs."""
    angles, ends, by_angles, by_ends = run(problem, point, steps, linearise)
    misses = misses_of(problem, point.nodes, angles, ends)
    rows = np.where(problem.seen, np.moveaxis(by_angles, 2, 1), 0.0)
    normal = np.einsum("icrk,jcrk->kij", rows, rows, optimize=True)
    gradient = np.einsum("icrk,crk->ki", rows, misses.angles)
    normal[0, :2, :2] += np.diag(problem.first_seen.astype(float))
    gradient[0, :2] += misses.first
    slopes = np.transpose(by_ends[..., :-1], (2, 1, 0))
    by_node, by_logs = slopes[..., :4].copy(), slopes[..., 4:]
    by_free, fields = problem.by_free, point.fields
    corner = by_free.T @ np.sum(normal[:, 4:, 4:], axis=0) @ by_free + prior * np.eye(fields.size)
    slope = by_free.T @ np.sum(gradient[:, 4:], axis=0) + prior * fields
    # A component that is held has no derivatives, and a unit on the diagonal in their place.
    free = (~problem.held).astype(float)
    by_node[:1] *= free
    normal[0, :4] *= free[:, None]
    normal[0, :, :4] *= free
    normal[0, :4, :4] += np.diag(1.0 - free)
    gradient[0, :4] *= free
    within = bool(np.all(np.abs(fields) <= FARTHEST))
    return _Linear(
        misses,
        prior * float(fields @ fields),
        normal,
        gradient,
        by_node,
        by_logs,
        corner,
        slope,
        within,
    )


class _Step(NamedTuple):
    nodes: np.ndarray
    fields: np.ndarray
    information: np.ndarray  # (F, F), of the fields: inverse covariance times the noise's variance
    response: np.ndarray  # (F, 4, K), of the nodes to the fields
    alone: np.ndarray  # (4, 4), the first node's covariance at held fields, over that variance


def _band_matrix(linear: _Linear, price: np.ndarray, damping: float) -> np.ndarray:
    """The symmetric matrix of the unknowns x_0, y_0, x_1, y_1, ..., x_(K-1) by diagonals.

    x_k is the move of node k and y_k the multiplier of the joint behind window k, of which the
    price is the reciprocal weight: at price zero the joint is closed.
    """
    count = len(linear.normal)
    matrix = np.zeros((2 * _BAND + 1, 8 * count))
    k, i = 8 * np.arange(count)[:, None, None], np.arange(4)

    def put(row: Any, column: Any, value: Any) -> None:
        matrix[_BAND + row - column, column] = value

    blocks = linear.normal[:, :4, :4]
    typical = np.mean(np.diagonal(blocks, axis1=1, axis2=2), axis=0)
    put(k + i[:, None], k + i, blocks + damping * np.diag(typical))
    k, joint = k[:-1], 8 * np.arange(count - 1)[:, None] + i
    put(k + 4 + i[:, None], k + i, linear.by_node)
    put(k + i[:, None], k + 4 + i, np.swapaxes(linear.by_node, 1, 2))
    put(joint + 4, joint + 8, -1.0)
    put(joint + 8, joint + 4, -1.0)
    put(joint + 4, joint + 4, -price[:, : count - 1].T)
    return matrix[:, : 8 * count - 4]


def _step(
    problem: WindowedData, linear: _Linear, price: np.ndarray, least: float, damping: float = 0.0
) -> _Step:
    """The move that solves the linearised problem.

    Arguments:
        price: (4, K - 1), of the joints' misses: the squares of those that cost as much as 1 rad of
            an angle.
        least: the fields move only along axes with at least so much information.
        damping: Levenberg and Marquardt's.
    Raises:
        LinAlgError: the nodes are not determined.
    """
    from scipy.linalg import solve_banded

    by_free, count = problem.by_free, len(linear.normal)
    free = by_free.shape[1]
    sides = np.zeros((count, 8, free + 5))
    sides[:, :4, :free] = linear.normal[:, :4, 4:] @ by_free
    sides[:-1, 4:, :free] = linear.by_logs @ by_free
    sides[:, :4, free] = linear.gradient[:, :4]
    sides[:-1, 4:, free] = linear.misses.joints.T
    sides[0, :4, free + 1 :] = np.eye(4)
    sides = sides.reshape(8 * count, -1)[:-4]
    solved = solve_banded(
        (_BAND, _BAND), _band_matrix(linear, price, damping), sides, check_finite=False
    )
    if not np.all(np.isfinite(solved)):
        raise np.linalg.LinAlgError("the nodes are not determined")
    border, short = sides[:, :free], solved[:, free]
    information = linear.corner - border.T @ solved[:, :free]
    information = 0.5 * (information + information.T)
    weights, axes = np.linalg.eigh(information + damping * np.diag(np.diag(linear.corner)))
    known = weights > max(least, ROUNDED * float(np.max(np.abs(linear.corner), initial=0.0)))
    fields = axes[:, known] @ (
        (axes[:, known].T @ (border.T @ short - linear.slope)) / weights[known]
    )
    moves = (
        np.vstack([-solved[:, : free + 1], np.zeros((4, free + 1))])
        .reshape(count, 8, free + 1)[:, :4]
        .T
    )
    response = moves[:free]
    alone = solved[:4, free + 1 :] * np.outer(~problem.held, ~problem.held)
    return _Step(
        moves[free] + np.tensordot(fields, response, 1), fields, information, response, alone
    )


class Found(NamedTuple):
    point: Point
    step: _Step | None  # from that point; None where no iteration could be made
    misses: _Misses
    iterations: int
    status: Status


def price_squares(price: float, rate: float) -> np.ndarray:
    """The price of a joint's misses by components, shape (4, 1)."""
    return (price * np.array([1.0, 1.0, rate, rate])[:, None]) ** 2


def _apply(point: Point, step: _Step) -> Point:
    return Point(point.nodes + step.nodes, point.fields + step.fields)


def descent(
    problem: WindowedData, point: Point, price: float, settings: Settings
) -> tuple[Point, float, int]:
    """Levenberg and Marquardt's iteration with open joints at this price; the cost it came to, and
    its evaluations.
    """
    prices = np.broadcast_to(price_squares(price, settings.rate), (4, len(problem.times) - 1))
    prior, least = (settings.noise / _FAR) ** 2, settings.noise**2
    linear = _linear(problem, point, settings.steps[0], prior)
    before, damping, count = linear.cost(prices), 1e-4, 0
    while count < _MOST_TRIALS:
        count += 1
        try:
            trial = _apply(point, _step(problem, linear, prices, least, damping))
        except np.linalg.LinAlgError:
            damping *= 100
            continue
        ahead = _linear(problem, trial, settings.steps[0], prior)
        after = ahead.cost(prices)
        if not after < before:
            damping *= 30
            continue
        gained = before - after
        point, linear, before, damping = trial, ahead, after, damping / 10
        if gained < _LITTLE * after and damping < _FREELY:
            break
    return point, before, count + 1


def close_joints(problem: WindowedData, point: Point, settings: Settings) -> Found:
    """Gauss and Newton's iteration with closed joints, at the fine step, from a point whose joints
    nearly are.

    Where no motion of this kind passes through the data it goes astray; the first point is returned
    then.
    """
    closed, least = np.zeros((4, len(problem.times) - 1)), settings.noise**2
    first = _linear(problem, point, settings.steps[1])
    linear, lost = first, Found(point, None, first.misses, 1, Status.MAX_ITERATIONS)
    move = math.inf
    for count in range(1, _MOST_ITERATIONS + 1):
        try:
            step = _step(problem, linear, closed, least)
        except np.linalg.LinAlgError:
            return lost._replace(
                iterations=count, status=Status.SINGULAR if count == 1 else lost.status
            )
        error = math.sqrt(linear.misses.squares / problem.freedom)
        size = math.sqrt(max(float(step.fields @ step.information @ step.fields), 0.0))
        gap = float(np.max(np.abs(linear.misses.joints), initial=0.0))
        before, move = move, float(np.max(np.abs(step.fields), initial=0.0))
        still = size <= _TOLERANCE * error or move < _ROUNDING or 0.3 * before < move < _NOISE
        if gap < _CLOSED and still:
            return Found(point, step, linear.misses, count, Status.CONVERGED)
        point = _apply(point, step)
        linear = _linear(problem, point, settings.steps[1])
        if not math.isfinite(linear.cost(closed + 1.0)):
            return lost._replace(iterations=count + 1)
    return lost._replace(iterations=_MOST_ITERATIONS + 1)


def refine(
    problem: WindowedData, found: Found, settings: Settings
) -> tuple[Found, Settings, float]:
    """A solution whose integration steps are short enough for its noise, and how much half of them
    would move it.
    """
    for halving in range(_HALVINGS + 1):
        if found.step is None:
            return found, settings, math.nan
        finer = settings._replace(steps=(settings.steps[0], 2 * settings.steps[1]))
        linear = _linear(problem, found.point, finer.steps[1])
        try:
            step = _step(problem, linear, np.zeros_like(linear.misses.joints), settings.noise**2)
        except np.linalg.LinAlgError:
            return found, settings, math.nan
        moved_by = math.sqrt(max(float(step.fields @ step.information @ step.fields), 0.0))
        noise = math.sqrt(found.misses.squares / problem.freedom)
        if halving == _HALVINGS or moved_by <= _SMALL_SHARE * noise:
            break
        again = close_joints(problem, _apply(found.point, step), finer)
        if again.step is None:
            break
        found, settings = again._replace(iterations=found.iterations + again.iterations + 1), finer
    return found, settings, float(np.max(np.abs(step.fields), initial=0.0))
