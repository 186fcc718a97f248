"""Compiled motions for a tolerance: one table of numbers goes in, one comes out.

A result of seven arrays takes five times as long to come back to the host as one array.
"""

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from dpend.mechanics.pendulum import Pendulum, State
from dpend.methods.nodes import NODES
from dpend.motion.integrate import float64
from dpend.motion.saved import SavedMotion, save_at_steps, save_at_times
from dpend.motion.trajectory import Trajectory

# Columns of the smallest table. Larger ones are four times as large each, so that few programs
# serve all lengths.
_LEAST_ROOM = 1024
# The motions of a block have so many columns together: above one megabyte a motion takes 340 us
# instead of 96 (2 s to 1e-9 rad, 100 saved states).
_COLUMNS_OF_A_BLOCK = 7000
# Motions in a block at most; and the columns of the smallest table of one of them.
_LARGEST_BLOCK, _LEAST_BLOCK_ROOM = 64, 128
_STATE = jax.tree.structure(State(0.0, 0.0, 0.0, 0.0))


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
    """A motion in one array: rows are the state and the error; the last column tells how it
    went.
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
    return np.array([*jax.tree.leaves((pendulum, state)), *asked], dtype=float)


def _numbers_of_lanes(pendulum: Pendulum, state: State, asked: tuple, lanes: int) -> np.ndarray:
    leaves = [np.asarray(leaf, float) for leaf in (*jax.tree.leaves((pendulum, state)), *asked)]
    return np.stack([np.broadcast_to(leaf, lanes) for leaf in leaves], axis=-1)


def _make(times: Any, rows: Any, told: Any, tolerance: float, columns: slice) -> Trajectory:
    """The result from tables (..., row, column) and what their last columns tell (..., 4)."""
    drift, estimate, steps, status = (told[..., i] for i in range(4))
    leaves = [rows[..., i, columns] for i in range(5)]
    state = jax.tree.unflatten(_STATE, leaves[:4])  # not checked: a lost motion is NaN
    return Trajectory(
        times, state, drift, estimate, steps.astype(int), status.astype(int),
        tolerance=tolerance, error=leaves[4], method="collocation",
    )  # fmt: skip


def one_motion(pendulum: Pendulum, state: State, times: Any, asked: tuple) -> Trajectory:
    n = len(times)
    table = np.asarray(_compiled(_numbers(pendulum, state, asked), _pad(times, _room(n + NODES))))
    return _make(times, table, table[:4, -1], asked[1], slice(n))


def many_motions(
    pendulum: Pendulum, state: State, times: Any, asked: tuple, lanes: int
) -> Trajectory:
    """Blocks of motions in turn on all CPU devices."""
    n, devices = len(times), jax.local_devices()
    room = max(_LEAST_BLOCK_ROOM, 1 << (n + NODES - 1).bit_length())
    size = max(1, min(_LARGEST_BLOCK, _COLUMNS_OF_A_BLOCK // room))
    numbers, padded = _numbers_of_lanes(pendulum, state, asked, lanes), _pad(times, room)
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


def motion_at_steps(pendulum: Pendulum, state: State, asked: tuple, every: int) -> Trajectory:
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


def trace_motion(pendulum: Pendulum, state: State, times: Any, asked: tuple) -> Trajectory:
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
