"""A quantity over a grid, as a labelled dataset, in memory or streamed into a Zarr store that can be resumed.

The grid is cut into tiles, one chunk of the store each. A tile is computed as a whole, its values are written and
synced to disk, then its status, then a digest of all: whatever moment the process is killed at, and whatever happens to
the files after, the same call finishes the map with the bytes that an uninterrupted run would have given.
"""

import hashlib
import inspect
import json
import math
import os
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from numbers import Real
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dpend._runtime import require_float64
from dpend.checks import file_path, flag, function, known_number, numbers, shown, text
from dpend.lanes import WIDTH, launches, over_lanes
from dpend.pendulum import Pendulum, Scalar, State, hamiltonian, known_pendulum
from dpend.steppers import Scheme, scheme_for
from dpend.stores import Store, StoreWarning, check_store
from dpend.trajectory import Status

# (pendulum, state, scheme) -> named scalars.
Quantity = Callable[[Pendulum, State, Scheme], Mapping[str, Scalar]]

# Cells along the side of a tile: 65536 cells make a file of some 500 kB for each value, and a second or so of work.
_TILE = 256
_UNITS = {
    "l1": "m",
    "l2": "m",
    "m1": "kg",
    "m2": "kg",
    "g": "m s-2",
    "theta1": "rad",
    "theta2": "rad",
    "p1": "kg m2 s-1",
    "p2": "kg m2 s-1",
    "lyapunov": "s-1",
    "exponent": "s-1",
    "uncertainty": "s-1",
    "flip_time": "s",
}
_STATE = tuple(field.name for field in fields(State))
_PENDULUM = tuple(field.name for field in fields(Pendulum))
# Cells whose mirror images are computed too, to see what the mirror does to a quantity.
_SAMPLES = 64
# A sweep is refused beyond so many steps of all cells, or beyond this share of them in one motion. A map of
# 4096 x 4096 cells takes 1e10 steps for 10 s at the default tolerance; 1e12 take a day on two cores. The steps
# of one motion follow one another on one core: a million take some five seconds.
_MOST_STEPS, _SHARE = 1e12, 1e-6
# What a user may ask for at most: JAX counts a loop's turns in 64 bits.
_COUNTABLE = 1e15
# Steps of methods with uneven steps, for each step that fits into the duration: the mean over the square of releases,
# 0.9 to 1.9 for four pendulums.
_UNEVEN = 1.4
# A motion whose steps would be so much shorter than the scheme's is given up as NaN at once.
_LOST = 1e5
# Steps that a core takes in a second, at order 8 with a tangent, for a first guess at how long a sweep takes.
_RATE = 5e6
# The default tolerance [rad]: a map's colours need no more.
_TOLERANCE = 1e-6


def sweep(
    quantity: Quantity | Any,
    pendulum: Pendulum | Any,
    axes: Mapping[str, Any] | Any,
    *,
    at: Mapping[str, float] | Any | None = None,
    tolerance: float | Any | None = None,
    method: str | Any | None = None,
    step: float | Any | None = None,
    error: str | Any | None = None,
    mirror: bool | Any = True,
    store: str | os.PathLike[str] | Any | None = None,
    name: str | Any | None = None,
    progress: Callable[[int, int, int], None] | Any | None = None,
    announce: Callable[["Cost"], None] | Any | None = None,
    most_steps: float | Any = _MOST_STEPS,
) -> Any:
    """A quantity over one or two fields of `State` or `Pendulum`.

    Reflection takes theta and p to -theta and -p, and the arithmetic follows it to the last bit. Where the grid is
    symmetric and the values of a sample of cells are, to the last bit, those of their mirror images or their negatives,
    one half of the cells is computed and the other mirrored.

    Arguments:
        quantity: (pendulum, state, scheme) -> dict of scalars, traceable in the first two; settings by keyword, as
            functools.partial(dpend.chaos.lyapunov, duration=10.0).
        pendulum: the parameters that are no axis.
        axes: one or two fields of `State` [rad, kg m^2/s] or `Pendulum` [SI], each with its values, shape (n,); the
            dataset's dimensions are in this order.
        at: the other fields of the state; zero by default.
        tolerance: wanted error [rad] of the angles; the method and step are those of `scheme_for`. 1e-6 by default.
        method, step: both, instead of a tolerance.
        error: "half-step" makes a second pass at half the step and adds |h - h/2| of each value as <name>_error.
        mirror: False computes every cell, also of symmetric maps.
        store: a directory for a Zarr store. One left unfinished by a run with the same settings is finished, one that
            is damaged is mended, with a `StoreWarning` that says what was wrong; what is returned is opened lazily.
        name: of the quantity in the store, needed where it is a lambda or a closure.
        progress: called with cells done, cells in all, and steps taken by this call, after every piece of work.
        announce: called with the `Cost` of what is to be computed, before it is.
        most_steps: refuse what would take more steps in all, or more than a millionth of it in one motion, because
            these follow one another. The steps are known from the quantity's setting `duration`; of a quantity without
            one the first cells tell.
    Returns:
        xarray.Dataset: the quantity's values, `status` (a value of `Status` for each cell: NONFINITE where a value is
        NaN), coordinates with units, angles also in degrees, and as attributes all that determines the values.
    Raises:
        ValueError: bad axes, tolerance or method; a store made with other settings, or a directory that is none; a
            store that another process is writing, or that cannot be written; more than `most_steps`, or than the
            memory holds.
        RuntimeError: a store made by another version of this package; float64 is switched off in JAX.
    """
    require_float64()
    example = "functools.partial(dpend.chaos.lyapunov, duration=10.0)"
    function("quantity", quantity, "(pendulum, state, scheme)", example)
    keyed = _Keyed.of(quantity)
    grid = _Grid.checked(pendulum, axes, {} if at is None else at)
    most = known_number("most_steps", most_steps, positive=True)
    if most > _COUNTABLE:
        raise ValueError(f"most_steps must be at most {_COUNTABLE:g}, got {most:g}: give fewer")
    scheme = _scheme(grid, tolerance, method, step)
    if not (error is None or (isinstance(error, str) and error == "half-step")):
        raise ValueError(f'error must be None or "half-step", got {shown(error)}: give one of them')
    mirror = flag("mirror", mirror)
    place = None if store is None else file_path("store", store)
    name = None if name is None else text("name", name)
    if progress is not None:
        function("progress", progress, "(cells done, cells in all, steps)", "print")
    if announce is not None:
        function("announce", announce, "a Cost", "print")
    work = _Work(_Task(keyed, grid, scheme, error is not None, mirror), most)
    work.tell, work.announce = progress, announce
    if place is None:
        return _labelled(work.task, _computed(work), work.task.attributes(name, strict=False))
    return _stored(work, place, work.task.attributes(name, strict=True))


# --- what is asked ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Keyed:
    """A quantity that equals any other of the same function and settings, so that compiled code is found again."""

    function: Quantity
    arguments: tuple[Any, ...]
    keywords: tuple[tuple[str, Any], ...]

    @staticmethod
    def of(quantity: Quantity) -> "_Keyed":
        if not callable(quantity):
            raise ValueError(f"quantity must be a function, got {quantity!r}: give one of dpend.chaos, or your own")
        if not isinstance(quantity, partial):
            return _Keyed(quantity, (), ())
        keyed = _Keyed(quantity.func, quantity.args, tuple(sorted(quantity.keywords.items())))
        try:
            hash(keyed)
        except TypeError:
            raise ValueError(
                f"quantity must have settings that can be hashed, got {shown(quantity.keywords)}: "
                "give a tuple for a list"
            ) from None
        return keyed

    def __call__(self, *args: Any) -> Mapping[str, Scalar]:
        return self.function(*self.arguments, *args, **dict(self.keywords))

    def identity(self, name: str | None, strict: bool) -> dict[str, str]:
        """Module, name, keywords and a hash of the source.

        Raises:
            ValueError: with `strict`, a lambda or closure without a name, or settings that text cannot hold.
        """
        inner = inspect.unwrap(self.function)
        own = getattr(inner, "__qualname__", type(inner).__qualname__)
        try:
            source = inspect.getsource(inner)
        except (OSError, TypeError):
            source = ""
        if strict and name is None:
            if "<" in own or getattr(inner, "__closure__", None):
                raise ValueError(f"name must be given to store a lambda or a closure, got {own}: say what it computes")
            if not inspect.isfunction(inner) or not source:  # two of them would look alike
                raise ValueError(
                    f"name must be given to store a quantity that is no function in a file, got {own}: say what it "
                    "computes"
                )
        try:
            settings = json.dumps([self.arguments, dict(self.keywords)], allow_nan=False)
        except (TypeError, ValueError):
            if strict and name is None:
                raise ValueError(
                    f"name must be given to store a quantity with settings that are no plain numbers or text, "
                    f"got {dict(self.keywords)}: say what it computes"
                ) from None
            settings = "see the name"
        return {
            "quantity": name or f"{getattr(inner, '__module__', '')}.{own}",
            "quantity_settings": settings,
            "quantity_source_sha256": hashlib.sha256(source.encode()).hexdigest(),
        }


@dataclass(frozen=True)
class _Grid:
    """The cells: fields of the state or the pendulum along one or two axes, the rest fixed."""

    pendulum: Pendulum
    axes: dict[str, np.ndarray]
    at: dict[str, float]

    @staticmethod
    def checked(pendulum: Pendulum | Any, axes: Mapping[str, Any] | Any, at: Mapping[str, float] | Any) -> "_Grid":
        if isinstance(pendulum, Pendulum) and any(np.ndim(leaf) for leaf in vars(pendulum).values()):
            raise ValueError("pendulum must have numbers for fields, got arrays: name those that vary as axes")
        pendulum = known_pendulum(pendulum)
        for name, given in (("axes", axes), ("at", at)):
            if not isinstance(given, Mapping):
                raise ValueError(
                    f"{name} must be a dictionary by field, got {shown(given)}: give one like {{'p1': 0.1}}"
                )
        if not 1 <= len(axes) <= 2:
            raise ValueError(f"axes must be one or two, got {len(axes)}: give one like {{'theta1': angles}}")
        for key in [*axes, *at]:
            if key not in _STATE + _PENDULUM:
                known = ", ".join(_STATE + _PENDULUM)
                raise ValueError(f"axes and at must be fields of State or Pendulum, got {key!r}: give one of {known}")
        twice = [key for key in at if key in axes or key in _PENDULUM]
        if twice:
            raise ValueError(f"at must name fields of State that are no axis, got {twice[0]!r}: leave it out")
        values = {}
        for key, given in axes.items():
            array = numbers(f"axis {key}", given)
            if array.ndim != 1 or not array.size or not np.all(np.isfinite(array)):
                raise ValueError(
                    f"axis {key} must be a one-dimensional array of finite numbers, got {shown(given)}: "
                    "give other values"
                )
            if key in ("l1", "l2", "m1", "m2") and np.any(array <= 0):
                raise ValueError(f"axis {key} must be positive, got {array.min():g}: leave that out")
            values[key] = array
        rest = {field: 0.0 for field in _STATE if field not in values}
        return _Grid(pendulum, values, rest | {key: known_number(key, value) for key, value in at.items()})

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(array.size for array in self.axes.values())

    @property
    def symmetric(self) -> bool:
        """Whether reflecting a cell's state gives another cell's: then that is the one at the other end of the axes."""
        moving = [array for key, array in self.axes.items() if key in _STATE]
        still = all(value == 0.0 for value in self.at.values())
        return bool(moving) and still and all(np.array_equal(array, -array[::-1]) for array in moving)

    def reflected(self, block: tuple[slice, ...]) -> tuple[slice, ...]:
        """The block of mirror images of a block of cells."""
        return tuple(
            slice(size - part.stop, size - part.start) if key in _STATE else part
            for (key, size), part in zip(zip(self.axes, self.shape, strict=True), block, strict=True)
        )

    def turned(self, values: np.ndarray) -> np.ndarray:
        """A block of values in the order of their mirror images."""
        return np.flip(values, tuple(axis for axis, key in enumerate(self.axes) if key in _STATE))

    def tiles(self) -> Iterator[tuple[slice, ...]]:
        tile = self.tile()
        for corner in np.ndindex(*(-(-size // side) for size, side in zip(self.shape, tile, strict=True))):
            yield tuple(
                slice(index * side, min((index + 1) * side, size))
                for index, side, size in zip(corner, tile, self.shape, strict=True)
            )

    def tile(self) -> tuple[int, ...]:
        """A tile's shape: of symmetric axes an even number fits, so that whole tiles are mirror images of others."""
        side = _TILE if len(self.axes) == 2 else _TILE**2
        return tuple(min(side, max(1, -(-size // 2)) if self.symmetric else size) for size in self.shape)

    def lanes(self, block: tuple[slice, ...]) -> dict[str, np.ndarray]:
        """The axes' values of every cell of a block, flat."""
        parts = [array[part] for array, part in zip(self.axes.values(), block, strict=True)]
        return {key: mesh.ravel() for key, mesh in zip(self.axes, np.meshgrid(*parts, indexing="ij"), strict=True)}


def _placed(pendulum: Pendulum, at: Mapping[str, Scalar], cell: Mapping[str, Scalar]) -> tuple[Pendulum, State]:
    pendulum = replace(pendulum, **{key: value for key, value in cell.items() if key in _PENDULUM})
    return pendulum, State(**{key: cell.get(key, at.get(key)) for key in _STATE})


@dataclass(frozen=True)
class _Cell:
    """What is computed in each lane: a value, so that equal sweeps share their compiled code."""

    quantity: _Keyed
    scheme: Scheme
    twice: bool

    def __call__(self, shared: tuple[Pendulum, dict[str, Scalar]], cell: dict[str, Scalar]) -> dict[str, Scalar]:
        pendulum, state = _placed(*shared, cell)
        values = dict(self.quantity(pendulum, state, self.scheme))
        taken = values.get("steps", 0)
        if self.twice:
            finer = self.quantity(pendulum, state, replace(self.scheme, step=self.scheme.step / 2))
            taken = taken + finer.get("steps", 0)
            for key in [key for key, value in values.items() if jax.numpy.issubdtype(value.dtype, np.floating)]:
                difference = jax.numpy.abs(values[key] - finer[key])
                values[f"{key}_error"] = jax.numpy.where(values[key] == finer[key], 0.0, difference)
        return values | {_TAKEN: jax.numpy.asarray(taken)}


# The attribute by which xarray knows a store's further coordinates.
_DEGREES = "coordinates"
# The steps of both passes, for the rate; no part of the result.
_TAKEN = "steps taken"


@jax.jit
def _energy(pendulum: Pendulum, at: dict[str, Scalar], cell: dict[str, Scalar]) -> Scalar:
    shape = next(iter(cell.values())).shape
    pendulum, state = _placed(pendulum, {key: jax.numpy.full(shape, value) for key, value in at.items()}, cell)
    return hamiltonian(pendulum, state) * jax.numpy.ones(shape)


@dataclass(frozen=True)
class _Task:
    """All that determines a sweep's values."""

    quantity: _Keyed
    grid: _Grid
    scheme: Scheme
    twice: bool
    mirror: bool

    @property
    def cell(self) -> _Cell:
        return _Cell(self.quantity, replace(self.scheme, written_out=True), self.twice)

    @property
    def shared(self) -> tuple[Pendulum, dict[str, float]]:
        return self.grid.pendulum, self.grid.at

    def attributes(self, name: str | None, strict: bool) -> dict[str, Any]:
        """Provenance: nothing in it depends on when or on what machine the sweep runs."""
        import dpend

        axes = hashlib.sha256()
        for key, array in self.grid.axes.items():
            axes.update(key.encode() + array.tobytes())
        return {
            "dpend_version": dpend.__version__,
            **self.quantity.identity(name, strict),
            **{field: float(getattr(self.grid.pendulum, field)) for field in _PENDULUM if field not in self.grid.axes},
            **{f"at_{key}": value for key, value in self.grid.at.items()},
            "method": self.scheme.name,
            "step": self.scheme.step,
            "error": "half-step" if self.twice else "none",
            "mirror": "where it holds" if self.mirror else "never",
            "axes_sha256": axes.hexdigest(),
            "tile": list(self.grid.tile()),
            "digests": "sha256",
        }


def _scheme(grid: _Grid, tolerance: Any, method: Any, step: Any) -> Scheme:
    if method is None and step is None:
        wanted = known_number("tolerance", _TOLERANCE if tolerance is None else tolerance, positive=True, unit="rad")
        ends = {key: (array.min(), array.max()) for key, array in grid.axes.items() if key in _PENDULUM}
        corners = np.array(np.meshgrid(*ends.values())).reshape(len(ends), -1).T if ends else [()]
        pendulums = [replace(grid.pendulum, **dict(zip(ends, map(float, corner), strict=True))) for corner in corners]
        # Without gravity nothing sets a time: the others do, as they do where zero lies between the ends.
        schemes = [scheme_for(one, wanted) for one in [one for one in pendulums if one.g] or pendulums]
        return min(schemes, key=lambda scheme: scheme.step)  # the fastest pendulum's
    if tolerance is not None:
        raise ValueError(f"tolerance excludes method and step, got {shown(tolerance)}: give either")
    if method is None or step is None:
        given, missing = ("step", "method") if method is None else ("method", "step")
        raise ValueError(f"{missing} must be given with {given}, got {given} alone: or give a tolerance")
    return Scheme(method, step)


# --- what it costs ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Cost:
    """About what a sweep takes.

    Attributes:
        cells: to be computed, not mirrored.
        each: steps of one motion, both passes; the mean where steps are uneven, of which one motion may take five times
            as many; None where nothing is known of the motion.
        bytes: of the values of all cells, before they are compressed.
    """

    cells: int
    each: float | None
    bytes: int

    @property
    def steps(self) -> float:
        """Of all cells."""
        return self.cells * (self.each or 0.0)

    @property
    def seconds(self) -> float:
        """A first guess, at the speed of one machine's cores."""
        cores = jax.local_device_count()
        lanes = max(self.cells, WIDTH * cores) if self.cells else 0
        return lanes * (self.each or 0.0) / (cores * _RATE)


def _motion_steps(task: _Task) -> float | None:
    """About how many steps a motion takes, from the quantity's setting `duration`."""
    duration = dict(task.quantity.keywords).get("duration")
    if not isinstance(duration, Real) or isinstance(duration, bool) or not math.isfinite(duration):
        return None
    steps = max(1.0, abs(float(duration)) / task.scheme.step) * (3 if task.twice else 1)
    if not task.scheme.even:
        steps *= _UNEVEN
    momenta = any(key in task.grid.axes or task.grid.at.get(key) for key in ("p1", "p2"))
    # A release from rest gets hardly faster than the fast mode; a motion under way may start with short steps.
    return steps if task.scheme.even or not momenta else steps * _shortening(task)


def _shortening(task: _Task) -> float:
    """By how much the scheme's step is cut at the start of the fastest of some cells."""
    ends = [array[np.linspace(0, array.size - 1, 8).astype(int)] for array in task.grid.axes.values()]
    cells = {key: mesh.ravel() for key, mesh in zip(task.grid.axes, np.meshgrid(*ends), strict=True)}
    shorter = np.asarray(_cut(task.scheme, *task.shared, cells))
    return float(np.max(shorter[shorter < _LOST], initial=1.0))


@partial(jax.jit, static_argnums=0)
def _cut(scheme: Scheme, pendulum: Pendulum, at: dict[str, Scalar], cells: dict[str, Scalar]) -> Scalar:
    def one(cell: dict[str, Scalar]) -> Scalar:
        here, state = _placed(pendulum, at, cell)
        spin = scheme.spin(scheme.constants(here), scheme.enter(here, state))
        return jax.numpy.maximum(spin, 1.0) ** 0.75

    return jax.vmap(one)(cells)


class _Work:
    """A sweep under way: what it may cost, and how far it is."""

    def __init__(self, task: _Task, most_steps: float):
        self.task, self.most_steps = task, most_steps
        self.tell: Callable[[int, int, int], None] | None = None
        self.announce: Callable[[Cost], None] | None = None
        self.cells, self.steps, self.all = 0, 0, math.prod(task.grid.shape)
        self.cost = Cost(1, _motion_steps(task), 0)
        self._check(most_steps)  # before the motion is traced: JAX cannot count so far
        self.kinds = _kinds(task)  # refuses a quantity that cannot be mapped before anything is computed

    def price(self, done: int) -> None:
        """Refuses what costs too much where so many cells are done."""
        mirrored = self.task.mirror and self.task.grid.symmetric
        cells = max(-(-self.all // 2) - done, 0) if mirrored else self.all - done
        self.cost = Cost(cells, self.cost.each, self.all * sum(kind.itemsize for kind in self.kinds.values()))
        self._check(self.most_steps * _SHARE)

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
            self._check(self.most_steps * _SHARE)

    def _check(self, longest: float) -> None:
        cost, most = self.cost, self.most_steps
        each = cost.each or 0.0
        if not cost.cells or (each <= longest and cost.steps <= most):
            return
        duration = dict(self.task.quantity.keywords).get("duration")
        told = f"duration {duration:g} s, step" if isinstance(duration, Real) else "step"
        needed = 1.01 * max(cost.steps, each / _SHARE)
        more = f", or most_steps={needed:.3g}" if needed <= _COUNTABLE else ""
        raise ValueError(
            f"duration and step must leave at most {most * _SHARE:.3g} steps to one motion and {most:.3g} to all, got "
            f"{told} {self.task.scheme.step:.3g} s, which make {each:.3g} and {max(cost.cells, 1) * each:.3g}: give a "
            f"shorter duration, a larger step or fewer cells{more}"
        )


# --- computing -------------------------------------------------------------------------------------------------------


def _parities(task: _Task) -> dict[str, int] | None:
    """1 for values that a cell shares with its mirror image, -1 for its negative; None if any is neither.

    The reflection of a state follows the motion to the last bit, so a sample decides: values that do not keep the
    symmetry differ in some cell.
    """
    if not (task.mirror and task.grid.symmetric):
        return None
    cells = int(np.prod(task.grid.shape))
    picked = np.unique(np.linspace(0, cells - 1, _SAMPLES + 1).astype(int)[:-1] * 7919 % cells)
    index = np.unravel_index(picked, task.grid.shape)
    here = {key: array[i] for (key, array), i in zip(task.grid.axes.items(), index, strict=True)}
    there = {key: -array if key in _STATE else array for key, array in here.items()}
    both = {key: np.concatenate([here[key], there[key]]) for key in here}
    values = over_lanes(task.cell, task.shared, both)
    values.pop(_TAKEN)
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
    work: "_Work",
    block: tuple[slice, ...],
    parities: dict[str, int] | None,
    done: Callable[[tuple[slice, ...]], dict[str, np.ndarray]],
) -> dict[str, np.ndarray]:
    """The values and status of a tile's cells; done(block) gives those of any block so far."""
    grid = work.task.grid
    shape = tuple(part.stop - part.start for part in block)
    if parities is None:
        return _lane_values(work, block, np.ones(shape, bool))
    known = {key: grid.turned(array) for key, array in done(grid.reflected(block)).items()}
    fresh = known["status"] == Status.NOT_COMPUTED
    places = np.meshgrid(*(np.arange(part.start, part.stop) for part in block), indexing="ij")
    images = [
        size - 1 - place if key in _STATE else place
        for key, size, place in zip(grid.axes, grid.shape, places, strict=True)
    ]
    inside = np.all([(part.start <= im) & (im < part.stop) for part, im in zip(block, images, strict=True)], axis=0)
    later = np.ravel_multi_index(places, grid.shape) > np.ravel_multi_index(images, grid.shape)
    own_image = fresh & inside & later  # of a pair of images within the tile one is computed
    values = _lane_values(work, block, fresh & ~own_image)
    source = tuple(im[own_image] - part.start for im, part in zip(images, block, strict=True))
    for key, array in values.items():
        parity = np.asarray(parities.get(key, 1), array.dtype)  # the status is even
        array[~fresh] = parity * known[key][~fresh]
        array[own_image] = parity * array[source]
    return values


def _lane_values(work: "_Work", block: tuple[slice, ...], compute: np.ndarray) -> dict[str, np.ndarray]:
    """The values and status of the cells of a block that are to be computed, arrays of the block's shape."""
    task = work.task
    every = task.grid.lanes(block)
    chosen = np.flatnonzero(compute)
    if not task.scheme.even:
        # A block of lanes takes as long as its slowest: cells of like energy take like numbers of steps.
        energy = np.asarray(_energy(task.grid.pendulum, task.grid.at, every))
        chosen = chosen[np.argsort(energy[chosen], kind="stable")]
    values: dict[str, np.ndarray] = {}
    at = 0
    for piece in _pieces(work, {key: lanes[chosen] for key, lanes in every.items()}):
        taken = int(piece.pop(_TAKEN).sum())
        own = piece.pop("status", None)
        bad = np.any([np.isnan(array) for array in piece.values() if array.dtype.kind == "f"], axis=0)
        piece["status"] = np.where(bad, Status.NONFINITE, Status.CONVERGED if own is None else own).astype(np.uint8)
        count = piece["status"].size
        for key, array in piece.items():
            values.setdefault(key, np.zeros(compute.shape, array.dtype)).ravel()[chosen[at : at + count]] = array
        at += count
        work.count(count, taken)
    return values or {key: np.zeros(compute.shape, kind) for key, kind in _kinds(task).items()}


def _pieces(work: "_Work", lanes: dict[str, np.ndarray]) -> Iterator[dict[str, np.ndarray]]:
    """The results of lanes as they come, of the first few soon: they tell how long the rest takes."""
    task, first = work.task, WIDTH * jax.local_device_count()
    parts = [slice(None)] if work.steps else [slice(None, first), slice(first, None)]
    for part in parts:
        some = {key: array[part] for key, array in lanes.items()}
        if next(iter(some.values())).size:
            yield from launches(task.cell, task.shared, some, work.cost.each or 1.0)


def _kinds(task: _Task) -> dict[str, np.dtype]:
    """The names and types of a sweep's values, the status last."""
    scalar = jax.ShapeDtypeStruct((), np.float64)
    shared = jax.tree.map(lambda _: scalar, task.shared)
    kinds = dict(jax.eval_shape(task.cell, shared, dict.fromkeys(task.grid.axes, scalar)))
    for key, kind in kinds.items():
        if kind.shape != ():
            raise ValueError(
                f"each value of a quantity must be a scalar, got shape {kind.shape} for {key}: return its components "
                "under names of their own"
            )
    del kinds[_TAKEN]
    kinds.pop("status", None)
    taken = [key for key in kinds if key in _STATE + _PENDULUM or key in _coordinates(task.grid)]
    if taken:
        raise ValueError(
            f"a quantity's value must not bear the name of a coordinate, got {taken[0]!r}: call it another"
        )
    return {key: np.dtype(kind.dtype) for key, kind in kinds.items()} | {"status": np.dtype(np.uint8)}


def _computed(work: _Work) -> dict[str, np.ndarray]:
    """All values in memory."""
    grid = work.task.grid
    work.price(0)
    _check_memory(work.cost.bytes)
    work.begin(0)
    values = {key: np.zeros(grid.shape, kind) for key, kind in work.kinds.items()}
    values["status"][...] = Status.NOT_COMPUTED
    parities = _parities(work.task)
    for block in grid.tiles():
        tile = _whole_tile(work, block, parities, lambda image: {key: array[image] for key, array in values.items()})
        for key, array in tile.items():
            values[key][block] = array
    return values


def _check_memory(size: int) -> None:
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if size > memory:
        raise ValueError(
            f"axes must leave values that the memory holds, got {size / 1e9:.3g} GB for {memory / 1e9:.3g} GB: give a "
            "store, or fewer cells"
        )


def _whole_tile(
    work: _Work,
    block: tuple[slice, ...],
    parities: dict[str, int] | None,
    done: Callable[[tuple[slice, ...]], dict[str, np.ndarray]],
) -> dict[str, np.ndarray]:
    """A tile's values, and its mirrored cells counted too."""
    before = work.cells
    tile = _tile_values(work, block, parities, done)
    work.count(tile["status"].size - (work.cells - before), 0)
    return tile


def _coordinates(grid: _Grid) -> dict[str, tuple[str, np.ndarray, dict[str, str]]]:
    coordinates = {}
    for key, array in grid.axes.items():
        coordinates[key] = (key, array, {"units": _UNITS[key]})
        if key.startswith("theta"):
            coordinates[f"{key}_deg"] = (key, np.degrees(array), {"units": "degree"})
    return coordinates


def _units(key: str) -> dict[str, Any]:
    unit = _UNITS.get(key.removesuffix("_error"))
    if key == "status":
        return {"flag_values": [int(s) for s in Status], "flag_meanings": " ".join(s.name.lower() for s in Status)}
    return {"units": unit} if unit else {}


def _labelled(task: _Task, values: dict[str, np.ndarray], attributes: dict[str, Any]) -> Any:
    import xarray

    dims = tuple(task.grid.axes)
    data = {key: (dims, array, _units(key)) for key, array in values.items()}
    return xarray.Dataset(data, _coordinates(task.grid), attributes)


# --- the store -------------------------------------------------------------------------------------------------------


def _stored(work: _Work, path: Path, attributes: dict[str, Any]) -> Any:
    check_store("store", path)
    store, grid = _store(work, path, attributes), work.task.grid
    blocks = dict(zip(store.tiles, grid.tiles(), strict=True))
    if not os.path.lexists(path):
        work.price(0)
        store.create()
    store.check()
    if store.inspect().whole:  # a finished one is only read
        work.count(work.all, 0)
        return store.open()
    with store.lock():
        findings = store.inspect()  # once more: who held the lock may have gone on
        if findings.damage:
            warnings.warn(findings.sentence(store), StoreWarning, stacklevel=3)
        todo = {tile: blocks[tile] for tile in findings.todo}
        done = work.all - sum(_size(block) for block in todo.values())
        work.begin(done)
        store.repair(findings)
        _fill(work, store, todo)
    return store.open()


def _size(block: tuple[slice, ...]) -> int:
    return math.prod(part.stop - part.start for part in block)


def _fill(work: _Work, store: Store, todo: dict[tuple[int, ...], tuple[slice, ...]]) -> None:
    """Computes tiles and writes each once it is whole."""
    parities = _parities(work.task) if todo else None
    arrays = {key: store.array(key) for key in work.kinds}
    for tile, block in todo.items():
        values = _whole_tile(work, block, parities, lambda image: {key: array[image] for key, array in arrays.items()})
        store.write(tile, block, values)


def _store(work: _Work, path: Path, attributes: dict[str, Any]) -> Store:
    """What the store of a sweep should hold."""
    memory: dict[str, Any] = {}  # the files of an empty store, as Zarr writes them
    arrays = _lay(work, attributes, memory)
    files = _consolidated({name: buffer.to_bytes() for name, buffer in memory.items()})

    def encode(name: str, block: tuple[slice, ...], values: np.ndarray) -> bytes:
        arrays[name.partition("/")[0]][block] = values
        return bytes(memory.pop(name).to_bytes())

    sides = work.task.grid.tile()
    counts = [-(-size // side) for size, side in zip(work.task.grid.shape, sides, strict=True)]
    return Store(
        path=path,
        attributes=attributes,
        documents={name: text for name, text in files.items() if name.endswith("zarr.json")},
        coordinates={name: text for name, text in files.items() if not name.endswith("zarr.json")},
        arrays={key: math.prod(sides) * kind.itemsize for key, kind in work.kinds.items()},
        tiles=list(np.ndindex(*counts)),
        encode=encode,
    )


def _lay(work: _Work, attributes: dict[str, Any], memory: dict[str, Any]) -> dict[str, Any]:
    """An empty store in `memory`; the arrays that are computed. Each chunk ends in a checksum for any reader."""
    import zarr
    from zarr.codecs import Crc32cCodec, ZstdCodec
    from zarr.storage import MemoryStore

    grid = work.task.grid
    degrees = " ".join(key for key in _coordinates(grid) if key not in grid.axes)
    group: Any = zarr.create_group(MemoryStore(memory), attributes=attributes | {_DEGREES: degrees})
    for key, (dim, values, units) in _coordinates(grid).items():
        array = group.create_array(
            key,
            shape=values.shape,
            dtype=values.dtype,
            chunks=values.shape,
            dimension_names=[dim],
            attributes=units,
            compressors=[Crc32cCodec()],  # not compressed: compressors of other versions may give other bytes
        )
        array[...] = values
    return {
        key: group.create_array(
            key,
            shape=grid.shape,
            dtype=kind,
            chunks=grid.tile(),
            dimension_names=list(grid.axes),
            fill_value=int(Status.NOT_COMPUTED) if key == "status" else (math.nan if kind.kind == "f" else 0),
            attributes=_units(key),
            compressors=[ZstdCodec(level=0, checksum=False), Crc32cCodec()],
            # Chunks of nothing but fill values must be there too: a tile's files tell that it is done.
            config={"write_empty_chunks": True},
        )
        for key, kind in work.kinds.items()
    }


def _consolidated(files: dict[str, bytes]) -> dict[str, bytes]:
    """The files with the metadata of all arrays in the group's too, where xarray looks for it first."""
    inside = {
        name.removesuffix("/zarr.json"): json.loads(text)
        for name, text in sorted(files.items())
        if name.endswith("/zarr.json")
    }
    group = json.loads(files["zarr.json"])
    group["consolidated_metadata"] = {"kind": "inline", "must_understand": False, "metadata": inside}
    return files | {"zarr.json": json.dumps(group, indent=2).encode()}
