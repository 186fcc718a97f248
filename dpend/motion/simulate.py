"""Motions at saved times (`simulate`), each with an estimate of its own error."""

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from dpend._runtime import require_float64
from dpend.checks import (
    at_most_one,
    flag,
    integer,
    known_number,
    one_of,
    shown,
)
from dpend.mechanics.pendulum import Pendulum, State, check_mechanics, check_motion
from dpend.methods.nodes import NODES
from dpend.methods.scheme import METHODS, Scheme
from dpend.motion.estimate import fastest_of_all
from dpend.motion.integrate import float64, known_duration
from dpend.motion.saved import SavedMotion, save_at_steps, save_at_times
from dpend.motion.stepped import save_by_step
from dpend.motion.trajectory import TOLERANCE, Trajectory, check_times

# Steps of a motion, if nobody asks for more: half a minute at order 8 with the second pass and all
# states saved, and half a gigabyte.
MOST_MOTION_STEPS = 2_000_000
# Saved times in a radian of the fastest motion at the start, so that a curve through them is
# smooth; and how many where the pendulum or the state is traced, which tell of no rate.
_TIMES_A_RADIAN, _TIMES_UNKNOWN = 20, 1001
# Columns of the smallest table. Larger ones are four times as large each, so that few programs
# serve all lengths.
_LEAST_ROOM = 1024
# The motions of a block have so many columns together: above one megabyte a motion takes 340 us
# instead of 96 (2 s to 1e-9 rad, 100 saved states).
_COLUMNS_OF_A_BLOCK = 7000
# Motions in a block at most; and the columns of the smallest table of one of them.
_LARGEST_BLOCK, _LEAST_BLOCK_ROOM = 64, 128
_STATE = jax.tree.structure(State(0.0, 0.0, 0.0, 0.0))


def simulate(
    pendulum: Pendulum | Any,
    state: State | Any,
    duration: float | Any | None = None,
    *,
    times: Any | None = None,
    step: float | Any | None = None,
    method: str | Any | None = None,
    tolerance: float | Any | None = None,
    save_every: int | Any | None = None,
    error: bool | Any = True,
    most_steps: int | Any = MOST_MOTION_STEPS,
) -> Trajectory:
    """The motion from `state`, for a tolerance or at a given step, with an estimate of its error.

    For a tolerance the steps are chosen as the motion goes, by Gauss collocation at eight nodes
    (order 16) beside a companion at Lobatto's nodes that starts a quarter of a rounding away. Their
    difference is the estimate: it holds truncation, rounding and the growth of both. Where the
    estimate passes the tolerance the motion is computed again, with finer steps. Saved states come
    from the steps' own polynomials. First derivatives of the saved states, forward and reverse,
    solve the variational equation on the same steps; second ones are refused. It traces in the
    pendulum, the state and the times, under `jit` and `vmap`.

    At a step the estimate is Richardson's, |x_h - x_(h/2)|/(1 - 2^-p), at the worst step, in the
    larger angle. The second pass keeps the rounding errors of its sums, so that the difference is
    the rounding error of the first, too. Where there may be nothing else in it, more such passes
    are made, each from a start some roundings away, and the largest difference counts.

    Arguments:
        pendulum, state: leaves are scalars; for a tolerance, or arrays of one shape (m,): so many
            motions, each with its own steps.
        duration: time [s]; negative runs backwards. Without it the motion ends at the last of
            `times`.
        times: when the state is saved [s], shape (n,): increasing from zero or more, or decreasing
            from zero or less. By default evenly spaced, 20 a radian of the fast mode or of the
            faster rod at the start; 1001 where the pendulum or the state is traced.
        step: largest step [s].
        method: of the steps of a given size; the default is `rk8`, which needs ten times fewer
            evaluations than `rk4` at an error of 1e-9.
        tolerance: wanted error of the angles [rad] at the worst time; 1e-9 if neither it nor a step
            is given. If no steps bring the estimate below it, the status is `BEYOND_HORIZON` where
            the motion is chaotic and errors of rounding have grown so far, and
            `TOLERANCE_NOT_REACHED` where it is not. At a step the same is said of estimates above
            0.1 rad.
        save_every: every how many steps a state is saved; the last state always is. The default at
            a step is 1. For a tolerance it saves at the ends of steps in place of `times`.
        error: at a step, make the second pass. Without it `error_estimate` is NaN, at a third of
            the time. For a tolerance the estimate costs nothing.
        most_steps: how many steps are taken at most. A step that makes more is refused; for a
            tolerance the status is `MAX_ITERATIONS` then, and states beyond are NaN.
    Returns:
        Trajectory; its arrays are NumPy's for a tolerance, unless something is traced.
    Raises:
        ValueError: duration zero, not finite or not known, or neither it nor times given; times
            not in order or beyond the duration; step and tolerance, or times and save_every, both
            given; a method without a step; a step not positive or longer than the motion;
            save_every below 1; more steps than `most_steps`.
        RuntimeError: float64 is switched off in JAX.
    """
    require_float64()
    at_most_one(step=step, tolerance=tolerance)
    at_most_one(times=times, save_every=save_every)
    error, most_steps = flag("error", error), integer("most_steps", most_steps)
    every = None if save_every is None else integer("save_every", save_every)
    if step is not None:
        check_motion(pendulum, state)
        at_most_one(times=times, step=step)
        scheme = Scheme(_check_method(method), step)
        _check_duration(duration)
        return save_by_step(
            pendulum, float64(state), duration, scheme, every or 1, error, most_steps
        )
    if method is not None:
        raise ValueError(
            f"method must come with a step, got {shown(method)} without one: give a step, or no "
            f"method for a tolerance"
        )
    wish = TOLERANCE if tolerance is None else tolerance
    tolerance = known_number("tolerance", wish, positive=True, unit="rad")
    check_mechanics(pendulum, state)
    end, grid = _span(pendulum, state, duration, times, every)
    asked = end, tolerance, most_steps
    if any(
        isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((pendulum, state, end, grid))
    ):
        if every is not None:
            raise ValueError(
                "save_every must not be given where the motion is traced, whose steps are not "
                f"known, got {shown(save_every)}: give times"
            )
        return _traced(pendulum, state, grid, asked)
    lanes = np.broadcast_shapes(*(np.shape(leaf) for leaf in jax.tree.leaves((pendulum, state))))
    if len(lanes) > 1 or (lanes and every is not None):
        raise ValueError(
            f"state must have one dimension at most, and none with save_every, got shape {lanes}: "
            f"reshape it, or give times"
        )
    if every is not None:
        return _at_steps(pendulum, state, asked, every)
    return (
        _many(pendulum, state, grid, asked, lanes[0])
        if lanes
        else _one(pendulum, state, grid, asked)
    )


def _is_traced(tree: Any) -> bool:
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def _check_duration(duration: Any) -> float:
    known = known_duration(duration)
    if known is None or known == 0.0:
        raise ValueError(
            f"duration must be a finite number [s] other than zero, known before tracing, got "
            f"{shown(duration)}: "
            "give another duration"
        )
    return known


def _span(
    pendulum: Pendulum, state: State, duration: Any, times: Any, every: int | None
) -> tuple[Any, Any]:
    """The end of the motion [s], and its saved times; None for those with `every`."""
    if duration is None and times is None:
        raise ValueError("duration must be given where times are not, got None: give one of them")
    if times is None:
        known = _check_duration(duration)
        share = (
            None
            if every is not None
            else np.linspace(0.0, 1.0, _count_times(pendulum, state, known))
        )
        return duration, None if share is None else share * duration
    grid = (
        jnp.asarray(times, jnp.float64)
        if isinstance(times, jax.core.Tracer)
        else check_times(times)
    )
    if duration is None:
        return grid[-1], grid
    known = _check_duration(duration)
    if not isinstance(grid, jax.core.Tracer) and (
        abs(grid[-1]) > abs(known) or grid[-1] * known < 0
    ):
        raise ValueError(
            f"times must lie between zero and the duration of {known:g} s, got {shown(grid)}: "
            f"give a longer duration, or none"
        )
    return duration, grid


def _count_times(pendulum: Pendulum, state: State, duration: float) -> int:
    if _is_traced((pendulum, state)):
        return _TIMES_UNKNOWN
    rate = float(np.max(np.nan_to_num(fastest_of_all(pendulum, state), posinf=0.0)))
    count = 2 + math.ceil(_TIMES_A_RADIAN * rate * abs(duration))
    if count > MOST_MOTION_STEPS:
        raise ValueError(
            f"duration must be at most some {MOST_MOTION_STEPS / rate / _TIMES_A_RADIAN:.1e} s "
            f"where all of a motion is saved, got {duration:g}: give times"
        )
    return count


def _room(count: int) -> int:
    """The columns of a table: one program serves all counts up to the next of these."""
    room = _LEAST_ROOM
    while room < count:
        room *= 4
    return room


def _pad(times: Any, room: int) -> np.ndarray:
    padded = np.full(room, np.inf)
    padded[: len(times)] = times
    return padded


def _pack(told: SavedMotion, extra: Any) -> Any:
    """A motion in one array: rows are the state and the error, the last column tells how it went.

    One array comes back to the host in a fifth of the time that seven take.
    """
    rows = jnp.stack([*jax.tree.leaves(told.state), told.error, *extra])
    told_of = told.energy_drift, told.error_estimate, told.steps, told.status.astype(float)
    return lax.dynamic_update_slice(rows, jnp.stack(told_of)[:, None], (0, rows.shape[1] - 1))


def _table(numbers: Any, times: Any) -> Any:
    found = save_at_times(Pendulum(*numbers[:5]), State(*numbers[5:9]), times, *numbers[9:12])
    return _pack(found, ())


_compiled = jax.jit(_table)
_compiled_batch = jax.jit(lambda numbers, times: lax.map(lambda one: _table(one, times), numbers))


@partial(jax.jit, static_argnames="room")
def _compiled_steps(numbers: Any, every: Any, room: int) -> Any:
    pendulum, state = Pendulum(*numbers[:5]), State(*numbers[5:9])
    wish = numbers[10], numbers[11]
    told, times, count = save_at_steps(pendulum, state, numbers[9], wish, every, room - 1)
    rows = _pack(
        jax.tree.map(lambda x: jnp.pad(x, (0, 1)) if x.ndim else x, told), (jnp.pad(times, (0, 1)),)
    )
    return rows, count


def _numbers(pendulum: Pendulum, state: State, asked: tuple) -> np.ndarray:
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves((pendulum, state))]
    return np.stack(np.broadcast_arrays(*leaves, *asked), axis=-1)


def _make(times: Any, rows: Any, told: Any, tolerance: float, columns: slice) -> Trajectory:
    """The result from tables (..., row, column) and what their last columns tell (..., 4)."""
    drift, estimate, steps, status = np.moveaxis(told, -1, 0)
    leaves = [rows[..., i, columns] for i in range(5)]
    state = jax.tree.unflatten(_STATE, leaves[:4])  # not checked: a lost motion is NaN
    return Trajectory(
        times, state, drift, estimate, steps.astype(int), status.astype(int),
        tolerance=tolerance, error=leaves[4], method="collocation",
    )  # fmt: skip


def _one(pendulum: Pendulum, state: State, times: Any, asked: tuple) -> Trajectory:
    n = len(times)
    table = np.asarray(_compiled(_numbers(pendulum, state, asked), _pad(times, _room(n + NODES))))
    return _make(times, table, table[:4, -1], asked[1], slice(n))


def _many(pendulum: Pendulum, state: State, times: Any, asked: tuple, lanes: int) -> Trajectory:
    """Blocks of motions in turn on all CPU devices."""
    n, devices = len(times), jax.local_devices()
    room = max(_LEAST_BLOCK_ROOM, 1 << (n + NODES - 1).bit_length())
    size = max(1, min(_LARGEST_BLOCK, _COLUMNS_OF_A_BLOCK // room))
    numbers, padded = _numbers(pendulum, state, asked), _pad(times, room)
    blocks = -(-lanes // size)
    filled = np.concatenate([numbers, np.repeat(numbers[-1:], blocks * size - lanes, axis=0)])
    waiting: list[Any] = []
    done: list[np.ndarray] = []
    for i, block in enumerate(filled.reshape(blocks, size, -1)):
        here = jax.device_put((block, padded), devices[i % len(devices)])
        waiting.append(_compiled_batch(*here))
        if len(waiting) > len(devices):
            done.append(np.asarray(waiting.pop(0)))
    table = np.concatenate([*done, *(np.asarray(one) for one in waiting)])[:lanes]
    return _make(times, table, table[:, :4, -1], asked[1], slice(n))


def _at_steps(pendulum: Pendulum, state: State, asked: tuple, every: int) -> Trajectory:
    room, count, numbers = _LEAST_ROOM, math.inf, _numbers(pendulum, state, asked)
    while True:
        rows, count = _compiled_steps(numbers, float(every), room)
        if int(count) < room:
            break
        room = _room(int(count) + 1)
    table = np.asarray(rows)
    start = np.array([*(float(leaf) for leaf in jax.tree.leaves(state)), 0.0, 0.0])[:, None]
    whole = np.concatenate([start, table[:, : int(count)]], axis=1)
    return _make(whole[5], whole, table[:4, -1], asked[1], slice(None))


def _traced(pendulum: Pendulum, state: State, times: Any, asked: tuple) -> Trajectory:
    """The same in the midst of a trace, for `jit`, `vmap` and derivatives."""
    end, tolerance, most_steps = asked
    pendulum, state, times = float64((pendulum, state, times))
    padded = jnp.concatenate([times, jnp.full(NODES, jnp.inf)])

    def one(pendulum: Pendulum, state: State) -> SavedMotion:
        return save_at_times(
            pendulum, state, padded, jnp.asarray(end, float), tolerance, float(most_steps)
        )

    lanes = np.broadcast_shapes(*(np.shape(leaf) for leaf in jax.tree.leaves((pendulum, state))))
    if lanes:
        pendulum, state = jax.tree.map(lambda x: jnp.broadcast_to(x, lanes), (pendulum, state))
        one = jax.vmap(one)
    found = jax.jit(one)(pendulum, state)
    moved, error = jax.tree.map(lambda leaf: leaf[..., : times.size], (found.state, found.error))
    return Trajectory(
        times, moved, found.energy_drift, found.error_estimate, found.steps, found.status,
        tolerance=tolerance, error=error, method="collocation",
    )  # fmt: skip


def _check_method(method: Any) -> str:
    name = "rk8" if method is None else one_of("method", method, tuple(METHODS))
    if not METHODS[name].even:
        raise ValueError(
            f"method must take even steps to save states at, got {name!r}: give rk8-circle, or use "
            f"flow"
        )
    return name
