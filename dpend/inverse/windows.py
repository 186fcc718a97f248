"""Windows: a motion cut into short pieces that pass through measured angles and meet at their
joints.

Each window is integrated from its own initial state, the node; all run side by side with their
derivatives. What is minimised over nodes and parameters is

    sum of (theta_model - theta_measured)^2 over all measured angles, modulo full turns,

subject to every window ending where the next begins (multiple shooting). While the joints are open,
a miss costs its square over a price; where they are closed, the price is zero. Either way the
linear problem of an iteration couples neighbours only: a band of width 15, bordered by at most
three columns for the parameters, is factorised once, which costs as much for each second of the
data. Nothing is condensed onto the first node, so that the growth of the motion over its whole
length, e^46 for a chaotic 20 s, never appears.

Inside, l1 = m1 = 1 and a pendulum is the logarithms of l2/l1, m2/m1 and g/l1, which so keep their
signs; the unknowns are those of the free fields over their start, and the nodes (theta1, theta2,
omega1, omega2).
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from dpend.checks import Scalar
from dpend.inverse.measurements import Angles, wrap
from dpend.mechanics.linear import fast_frequency, fastest, normal_modes
from dpend.mechanics.pendulum import Pendulum, State, momenta, velocities
from dpend.methods.scheme import Scheme
from dpend.motion.integrate import advance_state, step_size

# Order 8 in (theta, p) with its stages as a loop, which compiles in seconds together with its
# derivatives. Only its method is used.
_METHOD = Scheme("rk8", 1.0, written_out=False)
# Windows side by side in one call. At 128 the slopes of a step outgrow the cache, and a call takes
# ten times as long.
_LANES = 64
# The length of a window in units of 1/(the slow mode's frequency). The rods of a chaotic motion
# turn several times as fast; in this time they advance by less than a radian or two, so that the
# velocities of the cubics lead to the window's end.
_WINDOW = 0.375
# Intervals in a window: the fewest of these that the samples need. Each is one compiled program.
_INTERVALS = (4, 16, 64, 256)
# An interval is halved if it is longer than its share of a window by more than this much of it.
_NEARLY_FITS = 0.3
# The fastest motion advances by at most this in one integration step [rad] before the last
# iterations, and in them.
_ROUGH, _FINE = 0.6, 0.25
# A motion that needs more integration steps in an interval is not the one that was measured.
_MOST_STEPS = 200
# The fast mode at the start may advance by this in an interval [rad]: fifty steps. With them the
# search for a hidden rod takes half a minute; with `_MOST_STEPS` it took four times as long and
# found nothing.
_MOST_TURN = 50 * _FINE
# The farthest a field's logarithm goes from its start. A field a thousand million times its start
# is not what was measured.
FARTHEST = math.log(1e9)
# Rods may turn this many times as fast as the slow mode, in the median, as in a chaotic motion;
# faster rods shorten the windows.
_FASTER = 4.0
# The median time between samples, as an angle of the slow mode [rad]: a quarter of a period.
_COARSEST = math.pi / 2
# The longest series, as an angle of the slow mode [rad]: a longer one is a slip of the unit.
_LONGEST = 1e6


def _window(
    gravity: Scalar, logs: Array, nodes: Array, dts: Array, steps: Scalar
) -> tuple[Array, Array]:
    """Angles after each interval, shape (intervals, 2, lanes), and the end of each window, (4,
    lanes).
    """
    one = jnp.ones_like(nodes[0])
    pendulum = Pendulum(one, jnp.exp(logs[0]), one, jnp.exp(logs[1]), gravity * jnp.exp(logs[2]))

    def interval(state: State, dt: Array) -> tuple[State, Array]:
        state = advance_state(_METHOD, pendulum, state, step_size(dt, steps), steps)
        return state, jnp.stack([state.theta1, state.theta2])

    end, angles = lax.scan(interval, momenta(pendulum, *nodes), dts)
    return angles, jnp.stack([end.theta1, end.theta2, *velocities(pendulum, end)])


@jax.jit
def ends_of(
    gravity: Scalar, logs: Array, nodes: Array, dts: Array, steps: Scalar
) -> tuple[Array, Array]:
    """Angles and ends of windows, as `_window` gives them, with one pendulum for all."""
    return _window(gravity, jnp.broadcast_to(logs[:, None], (3, nodes.shape[1])), nodes, dts, steps)


@jax.jit
def linearise(gravity: Scalar, logs: Array, nodes: Array, dts: Array, steps: Scalar) -> Any:
    """The same with derivatives along the four components of the node and the three logarithms, in
    front.
    """
    lanes = nodes.shape[1]
    logs = jnp.broadcast_to(logs[:, None], (3, lanes))

    def along(direction: Array) -> Any:
        tangent = jnp.broadcast_to(direction[:, None], (7, lanes))
        return jax.jvp(
            lambda nodes, logs: _window(gravity, logs, nodes, dts, steps),
            (nodes, logs),
            (tangent[:4], tangent[4:]),
        )

    return jax.vmap(along, out_axes=(None, 0))(jnp.eye(7))


class WindowedData(NamedTuple):
    """Measured angles laid out in windows."""

    gravity: float  # g/l1 at the start [1/s^2]
    logs: np.ndarray  # log of l2/l1 and m2/m1 at the start, and 0
    by_free: np.ndarray  # (3, F), derivatives of the logarithms with respect to the free fields'
    times: np.ndarray  # of the nodes
    dts: np.ndarray  # (intervals, K)
    sample: np.ndarray  # the sample at the end of each interval, -1 where there is none
    measured: np.ndarray  # (2, intervals, K) [rad]
    seen: np.ndarray  # where
    first: np.ndarray  # (2,), at the first time
    first_seen: np.ndarray
    held: np.ndarray  # (4,), which components of the first node are given

    def part(self, start: int, stop: int) -> "WindowedData":
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
    """Where an iteration is: the nodes, shape (4, K), and the logarithms of the free fields over
    their start.
    """

    nodes: np.ndarray
    fields: np.ndarray


def run(problem: WindowedData, point: Point, steps: int, compiled: Any) -> list[np.ndarray]:
    """The windows' motions, `_LANES` at a time; the last lane is repeated where there are fewer."""
    logs = problem.logs + problem.by_free @ point.fields
    pieces = []
    for start in range(0, point.nodes.shape[1], _LANES):
        nodes, dts = (table[:, start : start + _LANES] for table in (point.nodes, problem.dts))
        lanes = nodes.shape[1]
        fill = ((0, 0), (0, _LANES - lanes))
        found = compiled(
            problem.gravity, logs, np.pad(nodes, fill, "edge"), np.pad(dts, fill, "edge"), steps
        )
        pieces.append([np.asarray(leaf)[..., :lanes] for leaf in jax.tree.leaves(found)])
    return [np.concatenate(piece, axis=-1) for piece in zip(*pieces, strict=True)]


class Settings(NamedTuple):
    rate: float  # of the slow mode at the start [rad/s]
    noise: float  # expected [rad]
    steps: tuple[int, int]  # integration steps in an interval, rough and fine


def angles_at_samples(
    problem: WindowedData, point: Point, steps: int, series: Angles
) -> np.ndarray:
    """The fitted angles at the samples, shape (2, m), in one piece: nodes may be full turns
    apart.
    """
    angles, ends = run(problem, point, steps, ends_of)
    turns = np.round((ends[:2, :-1] - point.nodes[:2, 1:]) / (2 * np.pi))
    turns = np.hstack([np.zeros((2, 1)), np.cumsum(turns, axis=1)])
    angles = np.moveaxis(angles, 1, 0) + 2 * np.pi * turns[:, None]
    fitted = np.empty_like(series.values)
    fitted[:, 0] = point.nodes[:2, 0]
    there = problem.sample >= 0
    fitted[:, problem.sample[there]] = angles[:, there]
    return fitted


def lay_windows(
    series: Angles, pendulum: Pendulum, by_free: np.ndarray, held: np.ndarray, rate: float
) -> WindowedData:
    """The samples in windows; where they are farther apart than an interval is long, there are
    intervals without.

    Arguments:
        rate: what time is measured by [rad/s].
    """
    times, values = series
    window, spaces = _WINDOW / rate, np.diff(times)
    intervals = next(
        (n for n in _INTERVALS if n * np.median(spaces) >= 0.7 * window), _INTERVALS[-1]
    )
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
    return WindowedData(
        gravity=float(pendulum.g / pendulum.l1),
        logs=np.array(
            [math.log(pendulum.l2 / pendulum.l1), math.log(pendulum.m2 / pendulum.m1), 0.0]
        ),
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


def settings_for(
    problem: WindowedData,
    nodes: np.ndarray,
    known: np.ndarray,
    rate: float,
    noise: float,
    fields: np.ndarray,
) -> Settings:
    """With integration steps for the fastest motion seen at the nodes; where they are unknown, for
    a fast one.
    """
    logs = problem.logs + problem.by_free @ fields
    pendulum = Pendulum(
        1.0, math.exp(logs[0]), 1.0, math.exp(logs[1]), problem.gravity * math.exp(logs[2])
    )
    blind = ~np.all(known, axis=0)
    nodes = np.where(blind, np.array([0.0, 0.5 * np.pi, 3 * rate, -3 * rate])[:, None], nodes)
    fast = float(np.max(np.asarray(fastest(pendulum, momenta(pendulum, *nodes)))))
    turn = float(np.max(problem.dts)) * fast
    turn = turn if math.isfinite(turn) else math.inf
    rough, fine = (math.ceil(min(max(turn / share, 1.0), _MOST_STEPS)) for share in (_ROUGH, _FINE))
    return Settings(rate, noise, (rough, fine))


def time_rate(series: Angles, pendulum: Pendulum) -> float:
    """What time is measured by [rad/s]: the slow mode, or rods that turn much faster."""
    times, values = series
    swing = (
        float(normal_modes(pendulum)[0].frequency)
        if pendulum.g > 0
        else math.sqrt(-float(pendulum.g / pendulum.l1))
    )
    turning = [
        np.median(np.abs(wrap(np.diff(column[there]))) / np.diff(times[there]))
        for column in values
        if np.any(there := np.isfinite(column))
    ]
    rate = max(swing, float(np.max(turning)) / _FASTER, 1 / (times[-1] - times[0]))
    if not math.isfinite(rate):
        raise ValueError(
            f"times and pendulum must give finite rates, got l1 = {pendulum.l1:g} m, "
            f"g = {pendulum.g:g} m/s^2 and times {times[-1] - times[0]:.3g} s long: give SI units"
        )
    spacing = float(np.median(np.diff(times)))
    if spacing * rate > _COARSEST:
        raise ValueError(
            f"times must be at most {_COARSEST / rate:.2g} s apart in the median to follow this "
            f"pendulum, "
            f"got {spacing:.3g} s: give seconds, more samples, or a pendulum nearer to it"
        )
    if (times[-1] - times[0]) * rate > _LONGEST:
        raise ValueError(
            f"times must last at most {_LONGEST / rate:.2g} s with this pendulum, got "
            f"{times[-1] - times[0]:.3g} s: "
            "give seconds, or fewer of them"
        )
    return rate


def check_fast_mode(pendulum: Pendulum, interval: float) -> None:
    """Refuses a start whose fast mode takes more integration steps from sample to sample than are
    ever made.
    """
    rate = float(fast_frequency(pendulum))
    if not rate * interval <= _MOST_TURN:
        raise ValueError(
            f"pendulum must have a fast mode of at most {_MOST_TURN / interval:.3g} rad/s to be "
            f"followed in intervals "
            f"of {interval:.3g} s, got {rate:.3g} rad/s: start nearer to what was measured, or "
            f"give more samples"
        )
