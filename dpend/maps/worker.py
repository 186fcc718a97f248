"""What runs on a worker of a Dask cluster: each writes its own tiles of a sweep's store.

Only `cluster` imports this file, and workers do, when they unpickle what they are sent.
"""

import contextlib
import functools
import importlib.metadata
import os
import pickle
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import distributed
import jax
import numpy as np

from dpend._runtime import PLAIN
from dpend._version import __version__
from dpend.executables import processor
from dpend.machine import configure
from dpend.maps.grid import Task
from dpend.maps.layout import store_of
from dpend.maps.store import Store
from dpend.maps.tiles import Work, find_parities, whole_tile
from dpend.status import Status

# The packages whose other versions give other bytes: JAX compiles the motions, numcodecs compresses
# the tiles. (NumPy only moves values.)
_PACKAGES = ("jax", "jaxlib", "zarr", "numcodecs")
# XLA compiles a program for one device alone in another way, with other last bits; from two devices
# on, their number changes none. Two on one core take as long as one.
_FEWEST_DEVICES = 2
# One tile at a time in a process: its lanes take all devices.
_one_at_a_time = threading.Lock()


def find_versions() -> dict[str, str]:
    """The versions on which a store's bytes depend."""
    others = {name: importlib.metadata.version(name) for name in _PACKAGES}
    return {"dpend": __version__, **others}


def find_hardware() -> str:
    """What else the last bits depend on: the processor, its compiler's options, one device or
    several.
    """
    devices = min(jax.local_device_count(), _FEWEST_DEVICES)
    options = os.environ.get("XLA_FLAGS", ""), os.environ.get(PLAIN, "")
    return " ".join([processor(), *options, str(devices)])


class Preparation(distributed.WorkerPlugin):
    """Sets JAX up on each worker before it starts there: float64, a device for each thread, two at
    least.

    A worker that comes later and has other versions is closed; its log says why.
    """

    name = "dpend"

    def __init__(self, versions: Mapping[str, str], cache: str | None) -> None:
        self.versions, self.cache = dict(versions), cache

    def setup(self, worker: Any) -> None:
        found = find_versions()
        if found != self.versions:
            worker.loop.add_callback(worker.close, nanny=True, reason="dpend-versions")
            raise RuntimeError(
                f"this worker has {found}, and the sweep was started by "
                f"{self.versions}: it takes no part"
            )
        # A worker that has computed by JAX before keeps its devices; `find_hardware` tells of one.
        with contextlib.suppress(RuntimeError):
            configure(devices=max(_FEWEST_DEVICES, worker.state.nthreads))
        if self.cache is not None:
            jax.config.update("jax_compilation_cache_dir", self.cache)
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


@dataclass(frozen=True)
class Job:
    """A sweep as it is sent to workers, once: what it computes, and where its store is.

    Attributes:
        task: what is computed.
        path: the store's, the same on all machines.
        attributes: the store's.
        most_steps: what it may cost.
        done: how many cells were done when it began.
    """

    task: Task
    path: Path
    attributes: dict[str, Any]
    most_steps: float
    done: int


@dataclass(frozen=True)
class _Sweep:
    """A job under way in this process."""

    work: Work
    store: Store
    arrays: dict[str, Any]
    blocks: dict[tuple[int, ...], tuple[slice, ...]]

    def done(self, block: tuple[slice, ...]) -> dict[str, np.ndarray]:
        """What is there of a block's cells; those of a tile that is not whole count as not
        computed.
        """
        values = {key: array[block] for key, array in self.arrays.items()}
        for tile in overlapping(self.blocks, block):
            if self.store.tile_problems(tile):
                part = (
                    slice(max(a.start - b.start, 0), a.stop - b.start)
                    for a, b in zip(self.blocks[tile], block, strict=True)
                )
                values["status"][tuple(part)] = Status.NOT_COMPUTED
        return values


def overlapping(
    blocks: Mapping[tuple[int, ...], tuple[slice, ...]], block: tuple[slice, ...]
) -> list[tuple[int, ...]]:
    """The tiles that share cells with a block; `blocks` are those of a grid of equal tiles."""
    sides = [part.stop - part.start for part in next(iter(blocks.values()))]
    ranges = [
        range(part.start // side, (part.stop - 1) // side + 1)
        for part, side in zip(block, sides, strict=True)
    ]
    corners = np.stack(np.meshgrid(*ranges, indexing="ij"), axis=-1).reshape(-1, len(ranges))
    return [tuple(map(int, corner)) for corner in corners]


@functools.lru_cache(maxsize=1)
def _begin(payload: bytes) -> _Sweep:
    job: Job = pickle.loads(payload)
    work = Work(job.task, job.most_steps)
    work.price(job.done)
    work.tell = _stop_if_unwanted
    store = store_of(work, job.path, job.attributes)
    if not os.path.isdir(job.path):
        raise ValueError(
            f"store {job.path} is not there for the worker {distributed.get_worker().address}: "
            f"give a directory that all workers and this process see by the same name"
        )
    store.check()
    arrays = {key: store.array(key) for key in work.kinds}
    blocks = dict(zip(store.tiles, job.task.grid.tiles(), strict=True))
    return _Sweep(work, store, arrays, blocks)


def _stop_if_unwanted(*counts: int) -> None:
    """Ends a tile, between two launches, that nobody waits for any more: its client was stopped, or
    another worker has it.
    """
    worker = distributed.get_worker()
    task = worker.state.tasks.get(worker.get_current_task())
    if task is None or task.state in ("cancelled", "resumed"):
        raise RuntimeError("this tile was cancelled")


def hold(payload: bytes) -> bytes:
    """A pickled `Job`, as a result: workers get it from one another, and the scheduler hands it out
    once.
    """
    return payload


def sample(payload: bytes) -> dict[str, int] | None:
    """What the mirror does to the values (`find_parities`)."""
    with _one_at_a_time:
        return find_parities(_begin(payload).work.task)


def write_tile(
    payload: bytes,
    tile: tuple[int, ...],
    parities: dict[str, int] | None,
    before: list[tuple[int, str]],
) -> tuple[int, str]:
    """Computes a tile and writes it, if it is not there already.

    Arguments:
        payload: of `hold`.
        tile: its index.
        parities: of `sample`.
        before: results of the tiles that hold mirror images of its cells, so that they come first.
    Returns:
        The steps taken, and the hardware (`find_hardware`).
    """
    with _one_at_a_time:
        sweep = _begin(payload)
        steps = sweep.work.steps
        if sweep.store.tile_problems(tile):  # else the worker died that wrote it
            _stop_if_unwanted()
            block = sweep.blocks[tile]
            values = whole_tile(sweep.work, block, parities, sweep.done)
            _stop_if_unwanted()
            sweep.store.write(tile, block, values)
        return sweep.work.steps - steps, find_hardware()
