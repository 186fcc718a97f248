"""A sweep's tiles as futures on a Dask cluster: who waits for them, and what is told where some
never come.

Dask schedules: it deals tiles to idle workers and deals them anew where a worker dies. Nothing
large passes through its scheduler: workers get the sweep's description once and write their tiles
into the one store themselves.
"""

import contextlib
import os
import queue
import secrets
import time
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax

from dpend._runtime import count_cores
from dpend.checks import integer
from dpend.maps.store import Store, StoreWarning
from dpend.maps.tiles import Work, cells_of

# Seconds between two calls of `progress` where no tile comes, so that a sweep can be stopped.
_BEAT = 0.5
# How often a tile that failed is tried again, on any worker: a disk that is full for one may have
# room for another.
_RETRIES = 2
# Seconds until the scheduler must have answered.
_ANSWER = 10.0
# Seconds until a file that a worker wrote must be seen here. NFS clients ask for a directory's
# entries again after at most 60 s (acdirmax of nfs(5)).
_SEEN = 70.0


def import_distributed() -> Any:
    """Dask's package for clusters.

    Raises:
        RuntimeError: it is not installed.
    """
    try:
        import distributed
    except ImportError:
        raise RuntimeError(
            "a cluster needs the package distributed: run `pip install 'dpend[cluster]'` or "
            "`pip install 'dask[distributed]'`"
        ) from None
    return distributed


def check_client(client: Any, store: Path | None) -> None:
    """Refuses what is no client of a cluster, and one whose workers have no store to write into.

    Raises:
        ValueError: it is none, or one for coroutines; no store.
        RuntimeError: `distributed` is not installed.
    """
    kind = import_distributed().Client
    if not isinstance(client, kind) or client.asynchronous:
        raise ValueError(
            f"client must be a dask.distributed.Client that is not asynchronous, got {client!r:.80}"
            ": give Client() or Client('tcp://host:8786')"
        )
    if store is None:
        raise ValueError(
            "store must be given with a client, got None: workers write their tiles into it"
        )


@contextlib.contextmanager
def connect(workers: int | None, address: str | None) -> Iterator[Any]:
    """A client of so many workers on this machine, or of the cluster at an address; None of
    neither.

    Workers on this machine share its cores, at least one for each, and end with this context.

    Raises:
        ValueError: both; no scheduler at the address.
        RuntimeError: `distributed` is not installed.
    """
    if workers is not None and address is not None:
        raise ValueError(f"workers excludes cluster, got {workers} and {address}: give either")
    if workers is None and address is None:
        yield None
        return
    workers = None if workers is None else integer("workers", workers)
    distributed = import_distributed()
    if address is not None:
        try:
            client = distributed.Client(address, timeout=_ANSWER, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            raise ValueError(
                f"cluster must be the address of a Dask scheduler, got {address} "
                f"({str(error).splitlines()[0]:.100}): start one by `dask scheduler`, it tells its "
                "address"
            ) from None
        with client:
            yield client
        return
    cluster = distributed.LocalCluster(
        n_workers=workers,
        threads_per_worker=max(1, count_cores() // (workers or 1)),
        memory_limit=0,  # a tile's values are some megabytes; Dask would watch all of JAX's
        dashboard_address=None,
        silence_logs="CRITICAL",
    )
    with cluster, distributed.Client(cluster, set_as_default=False) as client:
        yield client


def fill_by_workers(
    work: Work,
    store: Store,
    todo: Mapping[tuple[int, ...], tuple[slice, ...]],
    client: Any,
) -> None:
    """Has the workers compute tiles and write each once it is whole.

    Raises:
        RuntimeError: workers of other versions; workers or the scheduler are lost for good; tiles
            that this process does not see.
        ValueError: the store cannot be written.
    """
    if not todo:
        return
    _prepare(client)
    futures: dict[tuple[int, ...], Any] = {}
    finished = False
    try:
        futures = _submit(work, store, todo, client)
        _collect(work, store, todo, futures)
        finished = True
    finally:
        if client.status == "running":
            with contextlib.suppress(Exception):  # the cluster went away: nothing to take back
                if not finished:
                    client.cancel(list(futures.values()))
                client.unregister_worker_plugin("dpend")
    _check_seen(store, todo)
    for leftover in store.path.rglob("*.partial"):  # of workers that were killed while they wrote
        leftover.unlink(missing_ok=True)


def _prepare(client: Any) -> None:
    """Sets JAX up on all workers, also on those to come; raises where one has other versions."""
    from dpend.maps.worker import Preparation, find_versions

    ours = find_versions()
    try:
        found = client.run(find_versions)
    except (ImportError, AttributeError) as error:
        raise RuntimeError(
            f"workers of the cluster lack what this process has ({error}): install the same "
            f"versions there, {_list(ours)}"
        ) from None
    for worker, theirs in found.items():
        if theirs != ours:
            raise RuntimeError(
                f"worker {worker} has {_list(theirs, ours)} where this process has "
                f"{_list(ours, theirs)}, and its tiles would have other bytes: start it again with "
                "the same versions, or stop it"
            )
    local = all(worker.split("//")[-1].startswith("127.0.0.1:") for worker in found)
    # Code compiled here runs on this machine's processor: on others' it may not.
    cache = jax.config.jax_compilation_cache_dir if local else None  # type: ignore[attr-defined]
    client.register_plugin(Preparation(ours, cache))


def _list(versions: Mapping[str, str], others: Mapping[str, str] | None = None) -> str:
    """Versions as text, only those that differ from others."""
    differ = {k: v for k, v in versions.items() if others is None or others.get(k) != v}
    return ", ".join(f"{name} {version}" for name, version in differ.items())


def _submit(
    work: Work, store: Store, todo: Mapping[tuple[int, ...], tuple[slice, ...]], client: Any
) -> dict[tuple[int, ...], Any]:
    """A future for each tile; it waits for those before it that hold mirror images of its cells."""
    import cloudpickle

    from dpend.maps.worker import Job, hold, overlapping, sample, write_tile

    grid, run = work.task.grid, secrets.token_hex(4)
    job = Job(work.task, store.path.absolute(), dict(store.attributes), work.most_steps, work.cells)
    payload = client.submit(hold, cloudpickle.dumps(job), key=f"sweep-{run}", pure=False)
    parities = client.submit(
        sample, payload, key=f"sweep-sample-{run}", pure=False, retries=_RETRIES
    )
    mirrored = work.task.mirror and grid.symmetric
    blocks = dict(zip(store.tiles, grid.tiles(), strict=True))
    futures: dict[tuple[int, ...], Any] = {}
    for tile, block in todo.items():
        images = overlapping(blocks, grid.reflect(block)) if mirrored else []
        before = [futures[image] for image in images if image in futures]
        key = "-".join(["sweep-tile", run, *map(str, tile)])
        futures[tile] = client.submit(
            write_tile, payload, tile, parities, before, key=key, pure=False, retries=_RETRIES
        )
    return futures


def _collect(
    work: Work,
    store: Store,
    todo: Mapping[tuple[int, ...], tuple[slice, ...]],
    futures: dict[tuple[int, ...], Any],
) -> None:
    """Counts tiles as they come, and waits for the last."""
    from dpend.maps.worker import find_hardware

    ours, told = find_hardware(), False
    come: queue.Queue[tuple[int, ...]] = queue.Queue()
    for tile, future in futures.items():
        future.add_done_callback(lambda _, tile=tile: come.put(tile))
    left = dict(futures)
    while left:
        try:
            tile = come.get(timeout=_BEAT)
        except queue.Empty:
            work.count(0, 0)
            continue
        steps, theirs = _result(store, left.pop(tile), len(left) + 1)
        if theirs != ours and not told:
            told = True
            warnings.warn(
                f"store {store.path} has tiles of a worker with another processor, other options "
                "of XLA, or one device where this process has several: the last bits of its values "
                "may differ from those of a run here",
                StoreWarning,
                stacklevel=5,
            )
        work.count(cells_of(todo[tile]), steps)


def _result(store: Store, future: Any, left: int) -> tuple[int, str]:
    """What a tile's future gives; where Dask gave it up, how to go on."""
    distributed = import_distributed()
    lost = (
        distributed.KilledWorker,
        distributed.CancelledError,
        distributed.comm.CommClosedError,
        TimeoutError,
        OSError,
    )
    try:
        steps, hardware = future.result()
    except lost as error:
        reason = " ".join(str(error).split())
        raise RuntimeError(
            f"the cluster lost {left} of {len(store.tiles)} tiles of store {store.path} "
            f"({type(error).__name__}: {reason:.200}): the same call again computes those that "
            "are missing"
        ) from None
    return int(steps), str(hardware)


def _check_seen(store: Store, todo: Mapping[tuple[int, ...], Any]) -> None:
    """Waits until this process sees all tiles that workers wrote."""
    begun, missing = time.monotonic(), [tile for tile in todo if store.tile_problems(tile)]
    while missing and time.monotonic() < begun + _SEEN:
        time.sleep(_BEAT)
        os.listdir(store.path)
        missing = [tile for tile in missing if store.tile_problems(tile)]
    if missing:
        raise RuntimeError(
            f"store {store.path} lacks {len(missing)} of {len(store.tiles)} tiles that workers "
            "wrote: they and this process must see one file system"
        )
