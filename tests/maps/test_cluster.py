"""A sweep on a Dask cluster: whatever happens to workers, scheduler, client or disk, the finished
store has the bytes of a serial run, or one line says what is missing.
"""

import errno
import sys
import threading
import time

import jax.numpy as jnp
import numpy as np
import pytest
from distributed import Client, LocalCluster

import dpend
from dpend import Pendulum, cli
from dpend.maps import cluster, disk, grid, worker

SIDE = np.linspace(-2.0, 2.0, 9)
AXES = {"theta1": SIDE, "theta2": SIDE}


def cheap(pendulum, state, scheme):
    """An even value that fails in two columns, and an odd one."""
    product = jnp.where(jnp.abs(state.theta1) > 1.5, jnp.nan, state.theta1 * state.theta2)
    return {"product": product, "sum": state.theta1 + 2 * state.theta2}


def contents(store):
    return {
        path.relative_to(store): path.read_bytes()
        for path in sorted(store.rglob("*"))
        if path.is_file()
    }


def sweep(store, client=None, **options):
    return dpend.sweep(cheap, Pendulum(), AXES, store=store, client=client, **options)


@pytest.fixture(scope="module", autouse=True)
def _small_tiles():
    before = grid._TILE, disk.sync
    grid._TILE, disk.sync = 2, lambda place: None
    yield
    grid._TILE, disk.sync = before


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """What a serial run writes: 25 tiles, whose mirror images lie across others' edges."""
    store = tmp_path_factory.mktemp("whole") / "m.zarr"
    sweep(store)
    return contents(store)


@pytest.fixture(scope="module")
def client():
    """Two workers in threads of this process."""
    quiet = {"processes": False, "dashboard_address": None, "memory_limit": 0}
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, **quiet) as here,
        Client(here, set_as_default=False) as client,
    ):
        yield client


def digests(store):
    return len([path for path in store.glob("status/sha256/*/*") if path.is_file()])


# --- what runs where ------------------------------------------------------------------------------


def test_the_bytes_of_a_serial_run(tmp_path, client, whole):
    counted = []
    field = sweep(tmp_path / "m.zarr", client, progress=lambda *now: counted.append(now))
    assert contents(tmp_path / "m.zarr") == whole
    assert field.sizes == {"theta1": 9, "theta2": 9}
    done = [cells for cells, _, _ in counted]
    assert (done[0], done[-1]) == (0, 81)
    assert done == sorted(done)
    assert len(set(done)) == 26  # once a tile
    sweep(tmp_path / "m.zarr", client)  # a finished one is only read
    assert contents(tmp_path / "m.zarr") == whole


@pytest.mark.parametrize("shape", [(9, 9), (8, 6), (5, 1), (7,)])
def test_overlapping_tiles_are_those_that_share_cells(shape):
    axes = dict(zip(("theta1", "theta2"), (np.linspace(-1, 1, n) for n in shape), strict=False))
    cells = grid.Grid.of(Pendulum(), axes, {})
    blocks = {}
    for block in cells.tiles():
        sides = cells.tile()
        blocks[tuple(p.start // s for p, s in zip(block, sides, strict=True))] = block
    for block in blocks.values():
        image = np.zeros(shape, bool)
        image[cells.reflect(block)] = True
        wanted = [tile for tile, other in blocks.items() if image[other].any()]
        assert sorted(worker.overlapping(blocks, cells.reflect(block))) == sorted(wanted)


def test_half_of_the_cells_are_mirrored_by_workers_too(tmp_path, client, monkeypatch):
    """A tile waits for the tiles that hold its mirror images."""
    computed, lock = [], threading.Lock()
    launches = dpend.maps.tiles.launches

    def count(cell, shared, lanes, steps):
        with lock:
            computed.append(lanes["theta1"].size)
        return launches(cell, shared, lanes, steps)

    monkeypatch.setattr(dpend.maps.tiles, "launches", count)
    sweep(tmp_path / "m.zarr", client)
    assert sum(computed) == 41


def test_what_is_damaged_is_made_again(tmp_path, client, whole):
    store = tmp_path / "m.zarr"
    sweep(store, client)
    (store / "sum/c/0/0").unlink()
    (store / "status/c/3/3").write_bytes(b"x")
    with pytest.warns(dpend.StoreWarning, match="is damaged"):
        sweep(store, client)
    assert contents(store) == whole


def test_a_lambda_and_a_quantity_without_the_symmetry(tmp_path, client):
    for one in (None, client):
        dpend.sweep(
            lambda pendulum, state, scheme: {"sum": state.theta1 + 2 * state.theta2 + 1.0},
            Pendulum(),
            AXES,
            store=tmp_path / f"{one is None}.zarr",
            name="tilted",
            client=one,
        )
    assert contents(tmp_path / "True.zarr") == contents(tmp_path / "False.zarr")


# --- stopping -------------------------------------------------------------------------------------


class Enough(Exception):
    pass


@pytest.mark.parametrize("kind", [Enough, KeyboardInterrupt])
def test_progress_stops_it(tmp_path, client, whole, kind):
    """Between two tiles; what is done stays, and nothing is left running."""
    store = tmp_path / "m.zarr"

    def stop(done, cells, steps):
        if done > 8:
            raise kind

    for one in (client, None, client):
        with pytest.raises(kind):
            sweep(store, one, progress=stop)
        assert 0 < digests(store) < 25
    sweep(store, client)
    assert contents(store) == whole


def test_it_stops_while_no_tile_comes(tmp_path, client, whole, monkeypatch):
    """`progress` is called twice a second; a tile that nobody waits for is not written."""
    go_on, begun = threading.Event(), threading.Event()
    values = worker.whole_tile

    def wait(*arguments):
        begun.set()
        go_on.wait(60)
        return values(*arguments)

    def stop(*numbers):
        if begun.is_set():
            raise Enough

    store = tmp_path / "m.zarr"
    with monkeypatch.context() as patch:
        patch.setattr(worker, "whole_tile", wait)
        with pytest.raises(Enough):
            sweep(store, client, progress=stop)
        for _ in range(100):  # until the workers have heard of it
            if not any(client.processing().values()):
                break
            time.sleep(0.05)
        time.sleep(0.2)
        go_on.set()
    sweep(store, client)
    assert contents(store) == whole


# --- what goes wrong ------------------------------------------------------------------------------


def test_a_disk_that_is_full(tmp_path, client, whole, monkeypatch):
    """One line says so; what was done stays, and the same call finishes it."""
    store, written = tmp_path / "m.zarr", []
    put = disk.put

    def full(root, name, text):
        written.append(name)
        if len(written) > 30:
            raise OSError(errno.ENOSPC, "No space left on device")
        put(root, name, text)

    with monkeypatch.context() as patch:
        patch.setattr(dpend.maps.store, "put", full)
        with pytest.raises(ValueError, match=r"got .*m.zarr \(No space left on device\): give"):
            sweep(store, client)
    assert 0 < digests(store) < 25
    sweep(store, client)
    assert contents(store) == whole


def test_a_worker_of_another_version_is_refused(tmp_path, client, monkeypatch):
    ours = worker.find_versions()
    run = client.run

    def other(function, *arguments):
        found = run(function, *arguments)
        return {**found, next(iter(found)): ours | {"jax": "0.1"}}

    monkeypatch.setattr(client, "run", other)
    with pytest.raises(RuntimeError, match=r"^worker \S+ has jax 0.1 where this process has jax"):
        sweep(tmp_path / "m.zarr", client)
    assert digests(tmp_path / "m.zarr") == 0


def test_another_processor_is_told(tmp_path, client, whole, monkeypatch):
    here, main = worker.find_hardware, threading.get_ident()
    monkeypatch.setattr(
        worker, "find_hardware", lambda: here() if threading.get_ident() == main else "another"
    )
    with pytest.warns(dpend.StoreWarning, match="another processor.* last bits"):
        sweep(tmp_path / "m.zarr", client)
    assert contents(tmp_path / "m.zarr") == whole


def test_a_fault_of_the_quantity_is_passed_on(tmp_path, client, monkeypatch):
    def fail(*arguments):
        raise ZeroDivisionError("a fault")

    monkeypatch.setattr(worker, "whole_tile", fail)
    with pytest.raises(ZeroDivisionError, match="a fault"):
        sweep(tmp_path / "m.zarr", client)


def test_tiles_that_this_process_does_not_see(tmp_path, client, monkeypatch):
    monkeypatch.setattr(cluster, "_SEEN", 0.0)
    monkeypatch.setattr(dpend.maps.store.Store, "write", lambda *arguments: None)
    with pytest.raises(RuntimeError, match=r"lacks 25 of 25 tiles .* one file system"):
        sweep(tmp_path / "m.zarr", client)


def test_what_is_refused(tmp_path, client, monkeypatch, capsys):
    with pytest.raises(ValueError, match=r"^client must be a dask.distributed.Client"):
        sweep(tmp_path / "m.zarr", "tcp://127.0.0.1:8786")
    with pytest.raises(ValueError, match=r"^store must be given with a client, got None"):
        sweep(None, client)
    monkeypatch.setattr(cluster, "_ANSWER", 0.2)
    command = ["map", "flip", "--size", "4", "--duration", "1", "--out", str(tmp_path / "n.zarr")]
    for more, text in [
        (["--workers", "0"], "workers must be an integer of at least 1, got 0"),
        (["--workers", "2", "--cluster", "x"], "workers excludes cluster, got 2 and x"),
        (["--cluster", "tcp://127.0.0.1:9"], "cluster must be the address of a Dask scheduler"),
        (["--cluster", "nonsense://"], "cluster must be the address of a Dask scheduler"),
    ]:
        assert cli._run([*command, *more]) == 2
        heard = capsys.readouterr().err
        assert text in heard
        assert heard.count("\n") == 1
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert cli._run([*command, "--workers", "2"]) == 1
    assert "pip install 'dpend[cluster]'" in capsys.readouterr().err
    assert not (tmp_path / "n.zarr").exists()
