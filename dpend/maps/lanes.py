"""Many at once: a function of one state mapped over lanes, in blocks, on all CPU devices.

Not for users: `sweep` and the scans of `atlas` call it. It is the one place that knows what makes
many trajectories fast on a CPU, which is three things. Lanes go in blocks of a width at which XLA
makes vector code of every operation and a block's whole state stays in the first-level cache; each
block runs its time loop to the end before the next one starts; and the blocks are dealt to all CPU
devices. On any other backend the same call is one `jax.vmap`.

A launch is a fixed number of blocks, of which only as many run as there are lanes for, so that one
compiled program serves any number of lanes, and every lane's bits are the same whatever number of
lanes, launches or devices there are. (Devices from two on: for one alone XLA compiles another
program, of which the last bits may differ.)
"""

import math
from collections import deque
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as Spec
from jax.tree_util import PyTreeDef

from dpend.checks import Scalar

# Lanes in a block, for every method, with and without a tangent. Measured in million steps/s on one
# core with AVX-512, end states and (with one tangent): rk4-circle 45 (20) at 32 lanes, 125 (45) at
# 64, 110 (37) at 128; rk8-circle 14 (8), 26 (11), 18 (4). At 32 LLVM unrolls the loops over lanes
# before it looks for vectors in them; at 128 order 8 outgrows the cache.
WIDTH = 64
# Blocks a device takes in one launch: enough that the millisecond of starting one is lost, also for
# short motions; where each lane gives more than so many numbers, fewer.
_BLOCKS, _FEW_NUMBERS = 256, 64
# Steps that a device takes in one launch, at most, where a motion's are known: some five seconds at
# order 8. Results come, and an interruption is heard, between launches.
_LAUNCH_STEPS = 50_000_000
# Launches under way at once: one runs, one waits, so that no device stands still while results are
# collected.
_UNDER_WAY = 2


def over_lanes(function: Callable[[Any, Any], Any], shared: Any, each: Any) -> Any:
    """function(shared, one) for every lane `one` of `each`, in order.

    Arguments:
        function: traceable, from pytrees of float64 scalars to a pytree of scalars or arrays
            (integers below 2^53). One compiled program is kept for each function that equals none
            before.
        shared: a pytree of scalars, the same for all lanes.
        each: a pytree with leaves of shape (n,), n at least 1.
    Returns:
        The pytree of results, NumPy arrays of shape (..., n).
    """
    pieces = list(launches(function, shared, each))
    return jax.tree.map(lambda *parts: np.concatenate(parts, axis=-1), *pieces)


def launches(
    function: Callable[[Any, Any], Any], shared: Any, each: Any, steps: float = 1.0
) -> Iterator[Any]:
    """The results of `over_lanes` piece by piece, as they come: smaller pieces where a lane takes
    many `steps`.
    """
    leaves, structure = jax.tree.flatten(each)
    table = np.stack([np.asarray(leaf, np.float64) for leaf in leaves])
    shared = jax.tree.map(partial(jnp.asarray, dtype=jnp.float64), shared)
    kinds = _kinds(function, jax.tree.structure(shared), structure)
    devices = tuple(jax.local_devices())
    if devices[0].platform != "cpu":
        yield _collect(np.asarray(_vmapped(function, shared, structure, table)), kinds)
        return
    mesh = Mesh(np.array(devices), ("devices",))
    blocks = max(1, _BLOCKS * _FEW_NUMBERS // max(_FEW_NUMBERS, _rows(kinds)))
    at_once = max(1, min(blocks, int(_LAUNCH_STEPS / (WIDTH * max(steps, 1.0)))))
    size = len(devices) * at_once * WIDTH
    under_way: deque[tuple[jax.Array, int]] = deque()
    for start in range(0, table.shape[1], size):
        piece = table[:, start : start + size]
        rows = _blocks(function, structure, mesh, shared, *_dealt(piece, mesh, blocks))
        under_way.append((rows, piece.shape[1]))
        if len(under_way) == _UNDER_WAY:
            yield _gather(*under_way.popleft(), kinds)
    while under_way:
        yield _gather(*under_way.popleft(), kinds)


def _dealt(piece: np.ndarray, mesh: Mesh, blocks: int) -> tuple[Any, Any]:
    """The blocks, dealt to the devices like cards so that all get alike, and how many of its own
    each has to run.
    """
    devices = mesh.devices.size
    values, lanes = piece.shape
    filled = np.empty((values, devices * blocks * WIDTH))
    filled[:, :lanes], filled[:, lanes:] = piece, piece[:, -1:]  # short blocks repeat the last lane
    counts = (-(-lanes // WIDTH) + devices - 1 - np.arange(devices)) // devices
    place = NamedSharding(mesh, Spec("devices"))
    hands = filled.reshape(values, blocks, devices, WIDTH).transpose(2, 1, 0, 3)
    return jax.device_put(hands, place), jax.device_put(counts, place)


def _gather(rows: jax.Array, lanes: int, kinds: Any) -> Any:
    shards = sorted(rows.addressable_shards, key=lambda shard: shard.index[0].start)
    used = -(-lanes // (len(shards) * WIDTH))
    hands = np.stack(
        [np.asarray(shard.data)[0, :used] for shard in shards]
    )  # devices, blocks, values, width
    table = hands.transpose(2, 1, 0, 3)
    return _collect(table.reshape(table.shape[0], -1)[:, :lanes], kinds)


def _collect(table: np.ndarray, kinds: Any) -> Any:
    """The table's rows as the tree that the function gives, each of its own kind."""
    leaves, structure = jax.tree.flatten(kinds)
    parts = np.split(table, np.cumsum([math.prod(kind.shape) for kind in leaves])[:-1])
    shaped = [
        part.reshape(*kind.shape, -1).astype(kind.dtype, copy=False)
        for part, kind in zip(parts, leaves, strict=True)
    ]
    return jax.tree.unflatten(structure, shaped)


def _rows(kinds: Any) -> int:
    """How many numbers a lane gives."""
    return sum(math.prod(kind.shape) for kind in jax.tree.leaves(kinds))


@lru_cache(maxsize=64)
def _kinds(function: Callable[[Any, Any], Any], shared: PyTreeDef, each: PyTreeDef) -> Any:
    """The tree of shapes and types that the function gives."""
    scalar = jax.ShapeDtypeStruct((), jnp.float64)
    trees = (jax.tree.unflatten(tree, [scalar] * tree.num_leaves) for tree in (shared, each))
    return jax.eval_shape(function, *trees)


def _row_by_row(
    function: Callable[[Any, Any], Any], shared: Any, each: PyTreeDef, table: jax.Array
) -> jax.Array:
    """Values in rows, lanes in columns, in and out: XLA copies several arrays whole where it
    updates one in place.
    """
    mapped = jax.vmap(function, in_axes=(None, 0), out_axes=-1)(
        shared, jax.tree.unflatten(each, list(table))
    )
    lanes = table.shape[1]
    return jnp.concatenate(
        [leaf.astype(jnp.float64).reshape(-1, lanes) for leaf in jax.tree.leaves(mapped)]
    )


_vmapped = jax.jit(_row_by_row, static_argnums=(0, 2))


@partial(jax.jit, static_argnums=(0, 1, 2))
def _blocks(
    function: Callable[[Any, Any], Any],
    each: PyTreeDef,
    mesh: Mesh,
    shared: Any,
    hands: jax.Array,
    counts: jax.Array,
) -> jax.Array:
    def on_one_device(shared: Any, hand: jax.Array, count: jax.Array) -> jax.Array:
        def block(index: Scalar, done: jax.Array) -> jax.Array:
            values = _row_by_row(function, shared, each, hand[0, index])
            return lax.dynamic_update_index_in_dim(done, values, index, 0)

        return lax.fori_loop(0, count[0], block, jnp.zeros((hand.shape[1], rows, WIDTH)))[None]

    rows = _rows(_kinds(function, jax.tree.structure(shared), each))
    spread = jax.shard_map(
        on_one_device,
        mesh=mesh,
        in_specs=(Spec(), Spec("devices"), Spec("devices")),
        out_specs=Spec("devices"),
        check_vma=False,
    )
    return spread(shared, hands, counts)
