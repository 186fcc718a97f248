"""A quantity over a grid, as a labelled dataset, in memory or streamed into a store that can be
resumed.
"""

import os
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dpend._runtime import require_float64
from dpend.checks import flag, function, known_number, shown, text
from dpend.maps.cluster import check_client, fill_by_workers
from dpend.maps.cost import COUNTABLE, MOST_SWEEP_STEPS, Cost
from dpend.maps.grid import PENDULUM, Grid, Keyed, Quantity, Task, coordinates_of, units_of
from dpend.maps.layout import store_of
from dpend.maps.store import Store, StoreWarning, check_store
from dpend.maps.tiles import Work, cells_of, find_parities, whole_tile
from dpend.mechanics.pendulum import Pendulum
from dpend.methods.scheme import Scheme, scheme_for
from dpend.places import file_path
from dpend.status import Status

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
    most_steps: float | Any = MOST_SWEEP_STEPS,
    client: Any | None = None,
) -> Any:
    """A quantity over one or two fields of `State` or `Pendulum`.

    Reflection takes theta and p to -theta and -p, and the arithmetic follows it to the last bit.
    Where the grid is symmetric and the values of a sample of cells are, to the last bit, those of
    their mirror images or their negatives, one half of the cells is computed and the other
    mirrored.

    Arguments:
        quantity: (pendulum, state, scheme) -> dict of scalars, traceable in the first two; settings
            by keyword, as functools.partial(dpend.chaos.lyapunov, duration=10.0).
        pendulum: the parameters that are no axis.
        axes: one or two fields of `State` [rad, kg m^2/s] or `Pendulum` [SI], each with its values,
            shape (n,); the dataset's dimensions are in this order.
        at: the other fields of the state; zero by default.
        tolerance: wanted error [rad] of the angles; the method and step are those of `scheme_for`.
            1e-6 by default.
        method, step: both, instead of a tolerance.
        error: "half-step" makes a second pass at half the step and adds |h - h/2| of each value as
            <name>_error.
        mirror: False computes every cell, also of symmetric maps.
        store: a directory for a Zarr store. One left unfinished by a run with the same settings is
            finished, one that is damaged is mended, with a `StoreWarning` that says what was wrong;
            what is returned is opened lazily.
        name: of the quantity in the store, needed where it is a lambda or a closure.
        progress: called with cells done, cells in all, and steps taken by this call, after every
            piece of work. An exception that it raises stops the sweep and is passed on; tiles that
            are done stay in the store.
        announce: called with the `Cost` of what is to be computed, before it is.
        most_steps: refuse what would take more steps in all, or more than a millionth of it in one
            motion, because these follow one another. The steps are known from the quantity's
            setting `duration`; of a quantity without one the first cells tell.
        client: a `dask.distributed.Client`: its workers compute the tiles and write them into the
            store, with the bytes that this process would write. They must see the store's directory
            by the same path. `progress` is then called after every tile, and twice a second.
    Returns:
        xarray.Dataset: the quantity's values, `status` (a value of `Status` for each cell:
        NONFINITE where a value is NaN), coordinates with units, angles also in degrees, and as
        attributes all that determines the values.
    Raises:
        ValueError: bad axes, tolerance or method; a store made with other settings, or a directory
            that is none; a store that another process is writing, or that cannot be written; more
            than `most_steps`, or than the memory holds; a client without a store.
        RuntimeError: a store made by another version of this package; float64 is switched off in
            JAX; workers of other versions, or lost for good; `distributed` is not installed.
    """
    require_float64()
    example = "functools.partial(dpend.chaos.lyapunov, duration=10.0)"
    function("quantity", quantity, "(pendulum, state, scheme)", example)
    keyed = Keyed.of(quantity)
    grid = Grid.of(pendulum, axes, {} if at is None else at)
    most = known_number("most_steps", most_steps, positive=True)
    if most > COUNTABLE:
        raise ValueError(f"most_steps must be at most {COUNTABLE:g}, got {most:g}: give fewer")
    scheme = _scheme(grid, tolerance, method, step)
    if not (error is None or (isinstance(error, str) and error == "half-step")):
        raise ValueError(f'error must be None or "half-step", got {shown(error)}: give one of them')
    mirror = flag("mirror", mirror)
    place = None if store is None else file_path("store", store)
    name = None if name is None else text("name", name)
    _check_listeners(progress, announce)
    if client is not None:
        check_client(client, place)
    work = Work(Task(keyed, grid, scheme, error is not None, mirror), most)
    work.tell, work.announce = progress, announce
    if place is None:
        return _label(work.task, compute(work), work.task.attributes(name, strict=False))
    return compute_in_store(work, place, work.task.attributes(name, strict=True), client)


def _check_listeners(progress: Any, announce: Any) -> None:
    if progress is not None:
        function("progress", progress, "(cells done, cells in all, steps)", "print")
    if announce is not None:
        function("announce", announce, "a Cost", "print")


def _scheme(grid: Grid, tolerance: Any, method: Any, step: Any) -> Scheme:
    if method is None and step is None:
        return _scheme_for_all(grid, _TOLERANCE if tolerance is None else tolerance)
    if tolerance is not None:
        raise ValueError(f"tolerance excludes method and step, got {shown(tolerance)}: give either")
    if method is None or step is None:
        given, missing = ("step", "method") if method is None else ("method", "step")
        raise ValueError(
            f"{missing} must be given with {given}, got {given} alone: or give a tolerance"
        )
    return Scheme(method, step)


def _scheme_for_all(grid: Grid, tolerance: Any) -> Scheme:
    """The scheme that reaches a tolerance at every corner of the axes."""
    wanted = known_number("tolerance", tolerance, positive=True, unit="rad")
    ends = {key: (array.min(), array.max()) for key, array in grid.axes.items() if key in PENDULUM}
    corners = np.array(np.meshgrid(*ends.values())).reshape(len(ends), -1).T if ends else [()]
    pendulums = [
        replace(grid.pendulum, **dict(zip(ends, map(float, corner), strict=True)))
        for corner in corners
    ]
    # Without gravity nothing sets a time: the others do, as they do where zero lies between the
    # ends.
    schemes = [scheme_for(one, wanted) for one in [one for one in pendulums if one.g] or pendulums]
    return min(schemes, key=lambda scheme: scheme.step)  # the fastest pendulum's


def compute(work: Work) -> dict[str, np.ndarray]:
    """All values in memory."""
    grid = work.task.grid
    work.price(0)
    _check_memory(work.cost.bytes)
    work.begin(0)
    values = {key: np.zeros(grid.shape, kind) for key, kind in work.kinds.items()}
    values["status"][...] = Status.NOT_COMPUTED
    parities = find_parities(work.task)
    for block in grid.tiles():
        tile = whole_tile(
            work,
            block,
            parities,
            lambda image: {key: array[image] for key, array in values.items()},
        )
        for key, array in tile.items():
            values[key][block] = array
    return values


def _check_memory(size: int) -> None:
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if size > memory:
        raise ValueError(
            f"axes must leave values that the memory holds, got {size / 1e9:.3g} GB for "
            f"{memory / 1e9:.3g} GB: give a "
            "store, or fewer cells"
        )


def _label(task: Task, values: dict[str, np.ndarray], attributes: dict[str, Any]) -> Any:
    import xarray

    dims = tuple(task.grid.axes)
    data = {key: (dims, array, units_of(key)) for key, array in values.items()}
    return xarray.Dataset(data, coordinates_of(task.grid), attributes)


def compute_in_store(
    work: Work, path: Path, attributes: dict[str, Any], client: Any | None = None
) -> Any:
    check_store("store", path)
    store, grid = store_of(work, path, attributes), work.task.grid
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
        done = work.all - sum(cells_of(block) for block in todo.values())
        work.begin(done)
        store.repair(findings)
        if client is None:
            _fill(work, store, todo)
        else:
            store.mark(unordered=True)
            fill_by_workers(work, store, todo, client)
        store.mark(unordered=False)
    return store.open()


def _fill(work: Work, store: Store, todo: dict[tuple[int, ...], tuple[slice, ...]]) -> None:
    """Computes tiles and writes each once it is whole."""
    parities = find_parities(work.task) if todo else None
    arrays = {key: store.array(key) for key in work.kinds}
    for tile, block in todo.items():
        values = whole_tile(
            work,
            block,
            parities,
            lambda image: {key: array[image] for key, array in arrays.items()},
        )
        store.write(tile, block, values)
