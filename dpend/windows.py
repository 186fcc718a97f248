"""Windows: a motion cut into short pieces that pass through measured angles and meet at their joints.

Each window is integrated from its own initial state, the node; all run side by side with their derivatives. What is
minimised over nodes and parameters is

    sum of (theta_model - theta_measured)^2 over all measured angles, modulo full turns,

subject to every window ending where the next begins (multiple shooting). While the joints are open, a miss costs its
square over a price; where they are closed, the price is zero. Either way the linear problem of an iteration couples
neighbours only: a band of width 15, bordered by at most three columns for the parameters, is factorised once, which
costs as much for each second of the data. Nothing is condensed onto the first node, so that the growth of the motion
over its whole length, e^46 for a chaotic 20 s, never appears.

Inside, l1 = m1 = 1 and a pendulum is the logarithms of l2/l1, m2/m1 and g/l1, which so keep their signs; the unknowns
are those of the free fields over their start, and the nodes (theta1, theta2, omega1, omega2).
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from dpend.measurements import Angles, wrapped
from dpend.pendulum import Pendulum, Scalar, State, momenta, velocities
from dpend.shooting import fastest
from dpend.steppers import Scheme
from dpend.trajectory import Status, moved, step_size

# --- windows ---------------------------------------------------------------------------------------------------------

# Order 8 in (theta, p) with its stages as a loop, which compiles in seconds together with its derivatives. Only its
# method is used.
_METHOD = Scheme("rk8", 1.0, written_out=False)
# Windows side by side in one call; at 128 the slopes of a step outgrow the cache and it takes ten times as long.
_LANES = 64
# The length of a window in units of 1/(the slow mode's frequency): the rods of a chaotic motion, which turn several
# times as fast, advance by less than a radian or two, and the cubics' velocities lead to its end.
_WINDOW = 0.375
# Intervals in a window, the fewest of these that its samples need: one compiled program each.
_INTERVALS = (4, 16, 64, 256)
# The fastest motion may advance by this in one integration step [rad], before and in the last iterations.
_ROUGH, _FINE = 0.6, 0.25


def _window(gravity: Scalar, logs: Array, nodes: Array, dts: Array, steps: Scalar) -> tuple[Array, Array]:
    """Angles after each interval, shape (intervals, 2, lanes), and the end of each window, (4, lanes)."""
    one = jnp.ones_like(nodes[0])
    pendulum = Pendulum(one, jnp.exp(logs[0]), one, jnp.exp(logs[1]), gravity * jnp.exp(logs[2]))

    def interval(state: State, dt: Array) -> tuple[State, Array]:
        state = moved(_METHOD, pendulum, state, step_size(dt, steps), steps)
        return state, jnp.stack([state.theta1, state.theta2])

    end, angles = lax.scan(interval, momenta(pendulum, *nodes), dts)
    return angles, jnp.stack([end.theta1, end.theta2, *velocities(pendulum, end)])


@jax.jit
def ends_of(gravity, logs, nodes, dts, steps):  # type: ignore[no-untyped-def]
    return _window(gravity, jnp.broadcast_to(logs[:, None], (3, nodes.shape[1])), nodes, dts, steps)


@jax.jit
def _linearised(gravity, logs, nodes, dts, steps):  # type: ignore[no-untyped-def]
    """The same with derivatives along the four components of the node and the three logarithms, in front."""
    lanes = nodes.shape[1]
    logs = jnp.broadcast_to(logs[:, None], (3, lanes))

    def along(direction: Array) -> Any:
        tangent = jnp.broadcast_to(direction[:, None], (7, lanes))
        return jax.jvp(
            lambda nodes, logs: _window(gravity, logs, nodes, dts, steps), (nodes, logs), (tangent[:4], tangent[4:])
        )

    return jax.vmap(along, out_axes=(None, 0))(jnp.eye(7))


class Problem(NamedTuple):
    """Measured angles laid out in windows."""

    gravity: float  # g/l1 at the start [1/s^2]
    logs: np.ndarray  # log of l2/l1 and m2/m1 at the start, and 0
    by_free: np.ndarray  # derivative of the three logarithms with respect to those of the free fields
    times: np.ndarray  # of the nodes
    dts: np.ndarray  # (intervals, K)
    sample: np.ndarray  # the sample at the end of each interval, -1 where there is none
    measured: np.ndarray  # (2, intervals, K) [rad]
    seen: np.ndarray  # where
    first: np.ndarray  # (2,), at the first time
    first_seen: np.ndarray
    held: np.ndarray  # (4,), which components of the first node are given

    def part(self, start: int, stop: int) -> "Problem":
        """Some of the windows, as if the motion began with them."""
        some = slice(start, stop)
        return self._replace(
            times=self.times[some], dts=self.dts[:, some], sample=self.sample[:, some],
            measured=self.measured[..., some], seen=self.seen[..., some],
            first_seen=self.first_seen & (start == 0), held=self.held & (start == 0),
        )  # fmt: skip

    @property
    def observations(self) -> int:
        return int(np.sum(self.seen) + np.sum(self.first_seen))

    @property
    def freedom(self) -> int:
        return max(self.observations - int(np.sum(~self.held)) - self.by_free.shape[1], 1)


class Point(NamedTuple):
    """Where an iteration is: the nodes, shape (4, K), and the logarithms of the free fields over their start."""

    nodes: np.ndarray
    fields: np.ndarray


def run(problem: Problem, point: Point, steps: int, compiled: Any) -> list[np.ndarray]:
    """The windows' motions, `_LANES` at a time; the last lane is repeated where there are fewer."""
    logs = problem.logs + problem.by_free @ point.fields
    pieces = []
    for start in range(0, point.nodes.shape[1], _LANES):
        nodes, dts = (table[:, start : start + _LANES] for table in (point.nodes, problem.dts))
        lanes = nodes.shape[1]
        fill = ((0, 0), (0, _LANES - lanes))
        found = compiled(problem.gravity, logs, np.pad(nodes, fill, "edge"), np.pad(dts, fill, "edge"), steps)
        pieces.append([np.asarray(leaf)[..., :lanes] for leaf in jax.tree.leaves(found)])
    return [np.concatenate(piece, axis=-1) for piece in zip(*pieces, strict=True)]


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


def misses_of(problem: Problem, nodes: np.ndarray, angles: np.ndarray, ends: np.ndarray) -> _Misses:
    joints = ends[:, :-1] - nodes[:, 1:]
    joints[:2] = wrapped(joints[:2])
    return _Misses(
        np.where(problem.seen, wrapped(np.moveaxis(angles, 1, 0) - problem.measured), 0.0),
        np.where(problem.first_seen, wrapped(nodes[:2, 0] - problem.first), 0.0),
        joints,
    )


class _Linear(NamedTuple):
    """The problem linearised about a point."""

    misses: _Misses
    extra: float  # what the fields themselves cost
    normal: np.ndarray  # (K, 7, 7), of each window's angles with respect to its node and the three logarithms
    gradient: np.ndarray  # (K, 7)
    by_node: np.ndarray  # (K - 1, 4, 4), of the windows' ends
    by_logs: np.ndarray  # (K - 1, 4, 3)
    corner: np.ndarray  # (F, F), of the cost with respect to the fields
    slope: np.ndarray  # (F,)
    within: bool  # whether the fields are in the range that a pendulum is sought in

    def cost(self, price: np.ndarray) -> float:
        return self.misses.cost(price) + self.extra if self.within else math.inf


def _linear(problem: Problem, point: Point, steps: int, prior: float = 0.0) -> _Linear:
    """Arguments: prior: what the fields' distance from their start costs."""
    angles, ends, by_angles, by_ends = run(problem, point, steps, _linearised)
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
    within = bool(np.all(np.abs(fields) <= _FARTHEST))
    return _Linear(misses, prior * float(fields @ fields), normal, gradient, by_node, by_logs, corner, slope, within)


# --- one iteration ---------------------------------------------------------------------------------------------------


class _Step(NamedTuple):
    nodes: np.ndarray
    fields: np.ndarray
    information: np.ndarray  # of the fields, nodes eliminated: inverse of their covariance over the noise's variance
    response: np.ndarray  # (F, 4, K), of the nodes to the fields
    alone: np.ndarray  # (4, 4), covariance of the first node with the fields held, over the noise's variance


# Off-diagonals on either side of the banded matrix.
_BAND = 7
# What is left of information that cancels, in units of what it cancelled from.
ROUNDED = 1e-13


def _banded(linear: _Linear, price: np.ndarray, damping: float) -> np.ndarray:
    """The symmetric matrix of the unknowns x_0, y_0, x_1, y_1, ..., x_(K-1) by diagonals.

    x_k is the move of node k and y_k the multiplier of the joint behind window k, of which the price is the
    reciprocal weight: at price zero the joint is closed.
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


def _step(problem: Problem, linear: _Linear, price: np.ndarray, least: float, damping: float = 0.0) -> _Step:
    """The move that solves the linearised problem.

    Arguments:
        price: (4, K - 1), of the joints' misses: the squares of those that cost as much as 1 rad of an angle.
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
    solved = solve_banded((_BAND, _BAND), _banded(linear, price, damping), sides, check_finite=False)
    if not np.all(np.isfinite(solved)):
        raise np.linalg.LinAlgError("the nodes are not determined")
    border, short = sides[:, :free], solved[:, free]
    information = linear.corner - border.T @ solved[:, :free]
    information = 0.5 * (information + information.T)
    weights, axes = np.linalg.eigh(information + damping * np.diag(np.diag(linear.corner)))
    known = weights > max(least, ROUNDED * float(np.max(np.abs(linear.corner), initial=0.0)))
    fields = axes[:, known] @ ((axes[:, known].T @ (border.T @ short - linear.slope)) / weights[known])
    moves = np.vstack([-solved[:, : free + 1], np.zeros((4, free + 1))]).reshape(count, 8, free + 1)[:, :4].T
    response = moves[:free]
    alone = solved[:4, free + 1 :] * np.outer(~problem.held, ~problem.held)
    return _Step(moves[free] + np.tensordot(fields, response, 1), fields, information, response, alone)


# What it costs a window's end to miss the next node by this [rad, and in rad/s times the slow frequency] is what an
# angle's residual of the same size does; one round each, before the joints are closed.
PRICES = (0.3, 0.03, 0.003)
# In these rounds it costs as much as a residual of the noise's size to take a field's logarithm this far from its
# start: what the data say weighs more, where they do; the last iterations do without.
_FAR = 0.5
# A field that is a thousand million times its start is not what was measured; e^700 would be no double.
_FARTHEST = math.log(1e9)
_MOST_TRIALS, _MOST_ITERATIONS = 25, 25
# A round is over when an iteration that is damped by no more than the second gains less than the first, of the cost.
_LITTLE, _FREELY = 0.1, 1e-2
# The last iteration moves no parameter by more than this share of its standard error, or by rounding, which data
# without noise show as small moves that do not shrink.
_TOLERANCE, _ROUNDING, _NOISE = 1e-4, 1e-12, 1e-8
# Joints that miss by this [rad, rad/s] are closed: rounding over a window at tens of rad/s is some 1e-13.
_CLOSED = 1e-9


class Found(NamedTuple):
    point: Point
    step: _Step | None  # from that point; None where no iteration could be made
    misses: _Misses
    iterations: int
    status: Status


class Settings(NamedTuple):
    rate: float  # of the slow mode at the start [rad/s]
    noise: float  # expected [rad]
    steps: tuple[int, int]  # integration steps in an interval, rough and fine


def squared_price(price: float, rate: float) -> np.ndarray:
    """The price of a joint's misses by components, shape (4, 1)."""
    return (price * np.array([1.0, 1.0, rate, rate])[:, None]) ** 2


def _moved_by(point: Point, step: _Step) -> Point:
    return Point(point.nodes + step.nodes, point.fields + step.fields)


def descent(problem: Problem, point: Point, price: float, settings: Settings) -> tuple[Point, float, int]:
    """Levenberg and Marquardt's iteration with open joints at this price; the cost it came to, and its evaluations."""
    prices = np.broadcast_to(squared_price(price, settings.rate), (4, len(problem.times) - 1))
    prior, least = (settings.noise / _FAR) ** 2, settings.noise**2
    linear = _linear(problem, point, settings.steps[0], prior)
    before, damping, count = linear.cost(prices), 1e-4, 0
    while count < _MOST_TRIALS:
        count += 1
        try:
            trial = _moved_by(point, _step(problem, linear, prices, least, damping))
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


def solved(problem: Problem, point: Point, settings: Settings) -> Found:
    """Gauss and Newton's iteration with closed joints, at the fine step, from a point whose joints nearly are.

    Where no motion of this kind passes through the data it goes astray; the first point is returned then.
    """
    closed, least = np.zeros((4, len(problem.times) - 1)), settings.noise**2
    first = _linear(problem, point, settings.steps[1])
    linear, lost = first, Found(point, None, first.misses, 1, Status.MAX_ITERATIONS)
    move = math.inf
    for count in range(1, _MOST_ITERATIONS + 1):
        try:
            step = _step(problem, linear, closed, least)
        except np.linalg.LinAlgError:
            return lost._replace(iterations=count, status=Status.SINGULAR if count == 1 else lost.status)
        error = math.sqrt(linear.misses.squares / problem.freedom)
        size = math.sqrt(max(float(step.fields @ step.information @ step.fields), 0.0))
        gap = float(np.max(np.abs(linear.misses.joints), initial=0.0))
        before, move = move, float(np.max(np.abs(step.fields), initial=0.0))
        still = size <= _TOLERANCE * error or move < _ROUNDING or 0.3 * before < move < _NOISE
        if gap < _CLOSED and still:
            return Found(point, step, linear.misses, count, Status.CONVERGED)
        point = _moved_by(point, step)
        linear = _linear(problem, point, settings.steps[1])
        if not math.isfinite(linear.cost(closed + 1.0)):
            return lost._replace(iterations=count + 1)
    return lost._replace(iterations=_MOST_ITERATIONS + 1)


# The error of the integration is to move the fields by no more than this share of a standard error; so often is the
# step halved for it.
_SMALL_SHARE, _HALVINGS = 0.1, 3


def refined(problem: Problem, found: Found, settings: Settings) -> tuple[Found, Settings, float]:
    """A solution whose integration steps are short enough for its noise, and how much half of them would move it."""
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
        again = solved(problem, _moved_by(found.point, step), finer)
        if again.step is None:
            break
        found, settings = again._replace(iterations=found.iterations + again.iterations + 1), finer
    return found, settings, float(np.max(np.abs(step.fields), initial=0.0))


def fitted_angles(problem: Problem, point: Point, steps: int, series: Angles) -> np.ndarray:
    """The fitted angles at the samples, shape (2, m), in one piece: nodes may be full turns apart."""
    angles, ends = run(problem, point, steps, ends_of)
    turns = np.round((ends[:2, :-1] - point.nodes[:2, 1:]) / (2 * np.pi))
    turns = np.hstack([np.zeros((2, 1)), np.cumsum(turns, axis=1)])
    angles = np.moveaxis(angles, 1, 0) + 2 * np.pi * turns[:, None]
    fitted = np.empty_like(series.values)
    fitted[:, 0] = point.nodes[:2, 0]
    there = problem.sample >= 0
    fitted[:, problem.sample[there]] = angles[:, there]
    return fitted


def laid_out(series: Angles, pendulum: Pendulum, by_free: np.ndarray, held: np.ndarray, rate: float) -> Problem:
    """The samples in windows; where they are farther apart than an interval is long, there are intervals without.

    Arguments:
        rate: what time is measured by [rad/s].
    """
    times, values = series
    window, spaces = _WINDOW / rate, np.diff(times)
    intervals = next((n for n in _INTERVALS if n * np.median(spaces) >= 0.7 * window), _INTERVALS[-1])
    pieces = np.maximum(1, np.ceil(spaces * (intervals / window) - _NEARLY_FITS).astype(int))
    sample = np.full(np.sum(pieces), -1)
    sample[np.cumsum(pieces) - 1] = np.arange(1, times.size)
    dts = np.repeat(spaces / pieces, pieces)
    count = -(-dts.size // intervals)
    fill = (0, count * intervals - dts.size)
    nodes = np.append(times[0], times[0] + np.cumsum(dts))[: dts.size : intervals]
    sample = np.pad(sample, fill, constant_values=-1).reshape(count, intervals).T
    there = np.isfinite(values)
    seen = (sample >= 0) & there[:, np.maximum(sample, 0)]
    return Problem(
        gravity=float(pendulum.g / pendulum.l1),
        logs=np.array([math.log(pendulum.l2 / pendulum.l1), math.log(pendulum.m2 / pendulum.m1), 0.0]),
        by_free=by_free,
        times=nodes,
        dts=np.pad(dts, fill).reshape(count, intervals).T,
        sample=sample,
        measured=np.where(seen, values[:, np.maximum(sample, 0)], 0.0),
        seen=seen,
        first=np.where(there[:, 0], values[:, 0], 0.0),
        first_seen=there[:, 0],
        held=held,
    )


# An interval may be longer than its share of a window by this much of it, rather than be halved.
_NEARLY_FITS = 0.3


def settings_for(
    problem: Problem, nodes: np.ndarray, known: np.ndarray, rate: float, noise: float, fields: np.ndarray
) -> Settings:
    """With integration steps for the fastest motion seen at the nodes; where they are unknown, for a fast one."""
    logs = problem.logs + problem.by_free @ fields
    pendulum = Pendulum(1.0, math.exp(logs[0]), 1.0, math.exp(logs[1]), problem.gravity * math.exp(logs[2]))
    blind = ~np.all(known, axis=0)
    nodes = np.where(blind, np.array([0.0, 0.5 * np.pi, 3 * rate, -3 * rate])[:, None], nodes)
    fast = float(np.max(np.asarray(fastest(pendulum, momenta(pendulum, *nodes)))))
    turn = float(np.max(problem.dts)) * fast
    turn = turn if math.isfinite(turn) else math.inf
    rough, fine = (math.ceil(min(max(turn / share, 1.0), _MOST_STEPS)) for share in (_ROUGH, _FINE))
    return Settings(rate, noise, (rough, fine))


# A motion that asks for more integration steps in an interval is not the one that was measured.
_MOST_STEPS = 200
# The fast mode at the start may advance by so much in an interval [rad], in fifty steps: the search for a hidden rod
# then takes half a minute, and with all of the steps above it took four times as long and found nothing.
MOST_TURN = 50 * _FINE
