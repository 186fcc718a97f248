"""The values of a tile's cells, those known from their mirror images left out."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from numbers import Real

import jax
import numpy as np

from dpend.maps.cost import COUNTABLE, SHARE, Cost, motion_steps
from dpend.maps.grid import STATE, TAKEN, Task, kinds_of, release_energy
from dpend.maps.lanes import WIDTH, launches, over_lanes
from dpend.status import Status

# Cells whose mirror images are computed too, to see what the mirror does to a quantity.
_SAMPLES = 64


class Work:
    """A sweep under way: what it may cost, and how far it is."""

    def __init__(self, task: Task, most_steps: float) -> None:
        self.task, self.most_steps = task, most_steps
        self.tell: Callable[[int, int, int], None] | None = None
        self.announce: Callable[[Cost], None] | None = None
        self.cells, self.steps, self.all = 0, 0, math.prod(task.grid.shape)
        self.cost = Cost(1, motion_steps(task), 0)
        self._check(most_steps)  # before the motion is traced: JAX cannot count so far
        self.kinds = kinds_of(
            task
        )  # refuses a quantity that cannot be mapped before anything is computed

    def price(self, done: int) -> None:
        """Refuses what costs too much where so many cells are done."""
        mirrored = self.task.mirror and self.task.grid.symmetric
        cells = max(-(-self.all // 2) - done, 0) if mirrored else self.all - done
        self.cost = Cost(
            cells, self.cost.each, self.all * sum(kind.itemsize for kind in self.kinds.values())
        )
        self._check(self.most_steps * SHARE)

    def begin(self, done: int) -> None:
        """Tells what it costs where so many cells are done."""
        self.price(done)
        if self.announce is not None:
            self.announce(self.cost)
        self.count(done, 0)

    def count(self, cells: int, steps: int) -> None:
        first, self.cells, self.steps = not self.steps, self.cells + cells, self.steps + steps
        if self.tell is not None:
            self.tell(self.cells, self.all, self.steps)
        if first and steps and self.cost.each is None:
            self.cost = replace(self.cost, each=steps / cells)
            self._check(self.most_steps * SHARE)

    def _check(self, longest: float) -> None:
        cost, most = self.cost, self.most_steps
        each = cost.each or 0.0
        if not cost.cells or (each <= longest and cost.steps <= most):
            return
        duration = dict(self.task.quantity.keywords).get("duration")
        told = f"duration {duration:g} s, step" if isinstance(duration, Real) else "step"
        needed = 1.01 * max(cost.steps, each / SHARE)
        more = f", or most_steps={needed:.3g}" if needed <= COUNTABLE else ""
        raise ValueError(
            f"duration and step must leave at most {most * SHARE:.3g} steps to one motion and "
            f"{most:.3g} to all, got "
            f"{told} {self.task.scheme.step:.3g} s, which make {each:.3g} and "
            f"{max(cost.cells, 1) * each:.3g}: give a "
            f"shorter duration, a larger step or fewer cells{more}"
        )


def find_parities(task: Task) -> dict[str, int] | None:
    """1 for values that a cell shares with its mirror image, -1 for its negative; None if any is
    neither.

    The reflection of a state follows the motion to the last bit, so a sample decides: values that
    do not keep the symmetry differ in some cell.
    """
    if not (task.mirror and task.grid.symmetric):
        return None
    cells = int(np.prod(task.grid.shape))
    picked = np.unique(np.linspace(0, cells - 1, _SAMPLES + 1).astype(int)[:-1] * 7919 % cells)
    index = np.unravel_index(picked, task.grid.shape)
    here = {key: array[i] for (key, array), i in zip(task.grid.axes.items(), index, strict=True)}
    there = {key: -array if key in STATE else array for key, array in here.items()}
    both = {key: np.concatenate([here[key], there[key]]) for key in here}
    values = over_lanes(task.cell, task.shared, both)
    values.pop(TAKEN)
    parities = {}
    for key, array in values.items():
        first, second = np.split(array, 2)
        nan = array.dtype.kind == "f"
        if np.array_equal(first, second, equal_nan=nan):
            parities[key] = 1
        elif array.dtype.kind != "b" and np.array_equal(first, -second, equal_nan=nan):
            parities[key] = -1
        else:
            return None
    return parities


def _tile_values(
    work: "Work",
    block: tuple[slice, ...],
    parities: dict[str, int] | None,
    done: Callable[[tuple[slice, ...]], dict[str, np.ndarray]],
) -> dict[str, np.ndarray]:
    """The values and status of a tile's cells; done(block) gives those of any block so far."""
    grid = work.task.grid
    shape = tuple(part.stop - part.start for part in block)
    if parities is None:
        return _lane_values(work, block, np.ones(shape, bool))
    known = {key: grid.flip(array) for key, array in done(grid.reflect(block)).items()}
    fresh = known["status"] == Status.NOT_COMPUTED
    places = np.meshgrid(*(np.arange(part.start, part.stop) for part in block), indexing="ij")
    images = [
        size - 1 - place if key in STATE else place
        for key, size, place in zip(grid.axes, grid.shape, places, strict=True)
    ]
    inside = np.all(
        [(part.start <= im) & (im < part.stop) for part, im in zip(block, images, strict=True)],
        axis=0,
    )
    later = np.ravel_multi_index(places, grid.shape) > np.ravel_multi_index(images, grid.shape)
    own_image = fresh & inside & later  # of a pair of images within the tile one is computed
    values = _lane_values(work, block, fresh & ~own_image)
    source = tuple(im[own_image] - part.start for im, part in zip(images, block, strict=True))
    for key, array in values.items():
        parity = np.asarray(parities.get(key, 1), array.dtype)  # the status is even
        array[~fresh] = parity * known[key][~fresh]
        array[own_image] = parity * array[source]
    return values


def _lane_values(
    work: "Work", block: tuple[slice, ...], compute: np.ndarray
) -> dict[str, np.ndarray]:
    """The values and status of the cells of a block that are to be computed, arrays of the block's
    shape.
    """
    task = work.task
    every = task.grid.lanes(block)
    chosen = np.flatnonzero(compute)
    if not task.scheme.even:
        # A block of lanes takes as long as its slowest: cells of like energy take like numbers of
        # steps.
        energy = np.asarray(release_energy(task.grid.pendulum, task.grid.at, every))
        chosen = chosen[np.argsort(energy[chosen], kind="stable")]
    values: dict[str, np.ndarray] = {}
    at = 0
    for piece in _pieces(work, {key: lanes[chosen] for key, lanes in every.items()}):
        taken = int(piece.pop(TAKEN).sum())
        own = piece.pop("status", None)
        bad = np.any(
            [np.isnan(array) for array in piece.values() if array.dtype.kind == "f"], axis=0
        )
        piece["status"] = np.where(
            bad, Status.NONFINITE, Status.CONVERGED if own is None else own
        ).astype(np.uint8)
        count = piece["status"].size
        for key, array in piece.items():
            values.setdefault(key, np.zeros(compute.shape, array.dtype)).ravel()[
                chosen[at : at + count]
            ] = array
        at += count
        work.count(count, taken)
    return values or {key: np.zeros(compute.shape, kind) for key, kind in kinds_of(task).items()}


def _pieces(work: "Work", lanes: dict[str, np.ndarray]) -> Iterator[dict[str, np.ndarray]]:
    """The results of lanes as they come, of the first few soon: they tell how long the rest
    takes.
    """
    task, first = work.task, WIDTH * jax.local_device_count()
    parts = [slice(None)] if work.steps else [slice(None, first), slice(first, None)]
    for part in parts:
        some = {key: array[part] for key, array in lanes.items()}
        if next(iter(some.values())).size:
            yield from launches(task.cell, task.shared, some, work.cost.each or 1.0)


def cells_of(block: tuple[slice, ...]) -> int:
    """How many cells a block has."""
    return math.prod(part.stop - part.start for part in block)


def whole_tile(
    work: Work,
    block: tuple[slice, ...],
    parities: dict[str, int] | None,
    done: Callable[[tuple[slice, ...]], dict[str, np.ndarray]],
) -> dict[str, np.ndarray]:
    """A tile's values, and its mirrored cells counted too."""
    before = work.cells
    tile = _tile_values(work, block, parities, done)
    work.count(tile["status"].size - (work.cells - before), 0)
    return tile
