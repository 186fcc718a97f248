"""Stores with every kind of damage: the map comes out as it was, or one line says why not; never
another map.
"""

import concurrent.futures
import contextlib
import errno
import fcntl
import json
import os
import shutil
import warnings

import jax.numpy as jnp
import numpy as np
import pytest

import dpend
from dpend import Pendulum, Status
from dpend.maps import disk, grid
from dpend.maps import store as stores

AXES = {"theta1": np.arange(-2.0, 3.0), "theta2": np.array([-1.5, -0.5, 0.5, 1.5])}
# A tile with all its files, no image of its own.
TILE = "1/0"


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


@pytest.fixture(scope="module", autouse=True)
def _small_tiles():
    before, grid._TILE = grid._TILE, 2
    yield
    grid._TILE = before


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    store = tmp_path_factory.mktemp("whole") / "m.zarr"
    dpend.sweep(cheap, Pendulum(), AXES, store=store)
    return store


@pytest.fixture(scope="module", autouse=True)
def _no_waiting_for_the_disk():
    before, disk.sync = disk.sync, lambda place: None
    yield
    disk.sync = before


def truth():
    product, total = np.multiply.outer(*AXES.values()), AXES["theta1"][:, None] + 2 * AXES["theta2"]
    failed = np.abs(AXES["theta1"]) > 1.5
    product[failed] = np.nan
    status = np.where(failed[:, None], Status.NONFINITE, Status.CONVERGED) * np.ones((1, 4), int)
    return {"product": product, "sum": total, "status": status} | AXES


def outcome(store, whole):
    """ "told" or "silent" where the map is right and the files are what they were; or the line that
    refuses it.
    """
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        line = ""
        try:
            field = dpend.sweep(cheap, Pendulum(), AXES, store=store).load()
        except (ValueError, RuntimeError) as error:
            line = str(error)
            kind = type(error)
    if line:
        assert kind in (ValueError, RuntimeError)  # nothing that they are the base of
        assert "\n" not in line
        assert str(store) in line
        assert line.startswith("store ")
        return line
    for key, values in truth().items():
        np.testing.assert_array_equal(field[key].values, values)
    assert set(field.variables) == {*truth(), "theta1_deg", "theta2_deg"}
    assert all(
        here == there
        for here, there in zip(contents(store).items(), contents(whole).items(), strict=True)
    )
    assert all(issubclass(one.category, stores.StoreWarning) for one in heard)
    assert all(str(one.message).startswith(f"store {store} is damaged: ") for one in heard)
    return "told" if heard else "silent"


# --- what happens to one file ---------------------------------------------------------------------


def truncate(share):
    def damage(file):
        text = file.read_bytes()
        file.write_bytes(text[: int(share * len(text))])

    return damage


def flip_bit(place):
    def damage(file):
        text = bytearray(file.read_bytes())
        text[int(place * (len(text) - 1))] ^= 4
        file.write_bytes(text)

    return damage


def replace_by_directory(file):
    file.unlink()
    file.mkdir()
    (file / "inside").write_text("x")


def replace_by_link(target):
    def damage(file):
        file.unlink()
        file.symlink_to(file if target is None else target)

    return damage


def replace_by_pipe(file):
    file.unlink()
    os.mkfifo(file)


def grow(file):
    with file.open("r+b") as there:
        there.truncate(10_000_000_000)  # a hole: it takes no place


ON_FILES = {
    "empty": truncate(0.0),
    "half": truncate(0.5),
    "short by little": truncate(0.99),
    "missing": lambda file: file.unlink(),
    "directory": replace_by_directory,
    "loop": replace_by_link(None),
    "zeros": replace_by_link("/dev/zero"),
    "pipe": replace_by_pipe,
    "10 GB": grow,
    "first bit": flip_bit(0.0),
    "middle bit": flip_bit(0.5),
    "last bit": flip_bit(1.0),
}
FILES = [
    "zarr.json",
    "product/zarr.json",
    "status/zarr.json",
    "theta1/zarr.json",
    "theta2_deg/zarr.json",
    "theta1/c/0",
    "theta2_deg/c/0",
    f"product/c/{TILE}",
    f"sum/c/{TILE}",
    f"status/c/{TILE}",
    f"status/sha256/{TILE}",
]


def same_document(file, before):
    """Whether a file of metadata still says the same: a bit of white space says nothing."""
    with contextlib.suppress(OSError, ValueError):
        return (
            file.is_file()
            and file.stat().st_size < 1e6
            and json.loads(file.read_bytes()) == json.loads(before)
        )
    return False


def check_damage(store, whole, kind, name):
    """The map is mended, and that is told; only the description of the whole may be beyond
    mending.
    """
    shutil.copytree(whole, store)
    ON_FILES[kind](store / name)
    if name.endswith("zarr.json") and same_document(store / name, (whole / name).read_bytes()):
        return
    found = outcome(store, whole)
    if not (name == "zarr.json" and found.startswith("store ")):
        assert found == "told", f"{kind} of {name}: {found}"
        assert outcome(store, whole) == "silent", f"{kind} of {name}, once more"


def test_every_kind_of_damage(tmp_path, whole):
    """Each of another file."""
    for index, kind in enumerate(ON_FILES):
        check_damage(tmp_path / f"{index}.zarr", whole, kind, FILES[(index + 6) % len(FILES)])


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_every_kind_of_damage_to_every_file(tmp_path, whole, name):
    for index, kind in enumerate(ON_FILES):
        check_damage(tmp_path / f"{index}.zarr", whole, kind, name)


# --- what happens to a document -------------------------------------------------------------------

TEXTS = {
    "null": b"null",
    "list": b"[]",
    "number": b"3",
    "text": b'"zarr"',
    "nothing": b"{}",
    "not UTF-8": b"\xff\xfe{}",
    "deep": b"[" * 100_000,
    "NaN": b"NaN",
    "long number": b"1" * 10_000,
}
EDITS = {
    "data_type": "int8",
    "shape": [5, 5],
    "fill_value": 1,
    "codecs": [{"name": "bytes", "configuration": {"endian": "little"}}],
    "dimension_names": ["theta2", "theta1"],
    "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [5, 4]}},
    "attributes": {"units": "kg", "flag_values": [1, 0]},
    "zarr_format": 2,
    "node_type": "group",
    "storage_transformers": None,
}


DOCUMENTS = ["zarr.json", "sum/zarr.json", "theta2/zarr.json", "status/zarr.json"]


def test_a_document_is_another_thing(tmp_path, whole):
    for index, (kind, text) in enumerate(TEXTS.items()):
        for name in DOCUMENTS[:2]:
            store = shutil.copytree(whole, tmp_path / f"{index}{name[:3]}.zarr")
            (store / name).write_bytes(text)
            found = outcome(store, whole)
            wanted = (
                "told"
                if name != "zarr.json"
                else "store must be a Zarr store of a sweep or a new name"
            )
            assert found.startswith(wanted), f"{kind}: {found}"


@pytest.mark.slow
@pytest.mark.parametrize("name", DOCUMENTS)
def test_a_document_says_something_else(tmp_path, whole, name):
    document = json.loads((whole / name).read_bytes())
    texts = {}
    for key in document:
        texts[f"without {key}"] = json.dumps(
            {k: v for k, v in document.items() if k != key}
        ).encode()
    for key, value in EDITS.items():
        if document.get(key, EDITS) == value:
            continue
        texts[f"other {key}"] = json.dumps(document | {key: value}).encode()
    for index, (kind, text) in enumerate(texts.items()):
        store = shutil.copytree(whole, tmp_path / f"{index}.zarr")
        (store / name).write_bytes(text)
        found = outcome(store, whole)
        assert found == "told" or (name == "zarr.json" and found.startswith("store ")), (
            f"{kind}: {found}"
        )


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ("g", 9.7, "holds another sweep, its g is 9.7, not 9.8: give another name"),
        ("g", "9.8", "holds another sweep, its g is '9.8', not 9.8"),
        ("extra", 1, "holds another sweep, its extra is 1, not None"),
        ("dpend_version", "9.9", "was made by version 9.9 of dpend, this is"),
        ("dpend_version", None, "its zarr.json is no description of a sweep"),
        (
            "coordinates",
            "theta1_deg",
            "its coordinates is 'theta1_deg', not 'theta1_deg theta2_deg'",
        ),
    ],
)
def test_an_attribute_of_the_sweep_is_edited(tmp_path, whole, key, value, text):
    store = shutil.copytree(whole, tmp_path / "m.zarr")
    document = json.loads((store / "zarr.json").read_bytes())
    document["attributes"][key] = value
    (store / "zarr.json").write_text(json.dumps(document))
    assert text in outcome(store, whole)


# --- what happens to several files, or through Zarr -----------------------------------------------


def write_values(key, values):
    """Values that a program wrote, with right checksums."""

    def damage(store):
        import zarr

        zarr.open_array(store / key, mode="r+")[2, 0] = values

    return damage


def swap(key):
    def damage(store):
        one, other = store / key / "c/0/0", store / key / "c" / TILE
        first, second = one.read_bytes(), other.read_bytes()
        one.write_bytes(second)
        other.write_bytes(first)

    return damage


def swap_tiles(store):
    for key in ("product/c", "sum/c", "status/c", "status/sha256"):
        one, other = store / key / "0/0", store / key / TILE
        first, second = one.read_bytes(), other.read_bytes()
        one.write_bytes(second)
        other.write_bytes(first)


def remove(*names):
    def damage(store):
        for name in names:
            shutil.rmtree(store / name)

    return damage


def replace_directory_by_file(name):
    def damage(store):
        shutil.rmtree(store / name)
        (store / name).write_text("no directory")

    return damage


def add(name, text="x"):
    def damage(store):
        (store / name).parent.mkdir(parents=True, exist_ok=True)
        (store / name).write_text(text)

    return damage


def leave(store):
    (store / "sum/c" / TILE).rename(store / "sum/c" / f"{TILE}.1f.partial")
    (store / "status/c/0/0.2f.partial").mkdir()


def link_lock(store):
    (store / "status/lock").unlink()
    (store / "status/lock").symlink_to("/dev/null")
    (store / "sum/c" / TILE).unlink()


ON_STORES = {
    "a value": (write_values("sum", 1.0), "told"),
    "a value that is none": (write_values("sum", np.nan), "told"),
    "status converged": (write_values("status", Status.NONFINITE), "told"),
    "status not computed": (write_values("status", Status.NOT_COMPUTED), "told"),
    "status unknown": (write_values("status", 77), "told"),
    "swapped chunks": (swap("sum"), "told"),
    "swapped tiles": (swap_tiles, "told"),
    "no coordinate": (remove("theta1"), "told"),
    "no array": (remove("sum"), "told"),
    "no status": (remove("status"), "told"),
    "no digests": (
        remove("status/sha256"),
        "silent",
    ),  # as of one that was stopped at its first tile
    "no chunks": (remove("sum/c", "product/c"), "told"),
    "a file for an array": (replace_directory_by_file("sum"), "told"),
    "a file for chunks": (replace_directory_by_file("status/c"), "told"),
    "a file for the status": (replace_directory_by_file("status"), "told"),
    "a leftover": (add("zarr.1f.partial"), "silent"),
    "leftovers": (leave, "told"),
    "the lock is a link": (link_lock, "told"),
    "an extra array": (
        add("more/zarr.json", "{}"),
        "holds more, which is no part of this sweep: move it elsewhere",
    ),
    "an extra file": (add("notes.txt"), "holds notes.txt, which is no part of this sweep"),
}


@pytest.mark.parametrize("kind", ON_STORES)
def test_a_store_is_damaged(tmp_path, whole, kind):
    damage, wanted = ON_STORES[kind]
    store = shutil.copytree(whole, tmp_path / "m.zarr")
    damage(store)
    found = outcome(store, whole)
    assert wanted in found


# --- two at once ----------------------------------------------------------------------------------


def stop(*numbers):
    raise KeyboardInterrupt


def stopped(store):
    """A store of which one tile is done."""
    with contextlib.suppress(KeyboardInterrupt):
        dpend.sweep(
            cheap,
            Pendulum(),
            AXES,
            store=store,
            progress=lambda done, *more: stop() if done > 4 else None,
        )
    assert len(list(store.glob("status/c/*/*"))) == 1
    return store


def test_of_two_writers_one_is_refused(tmp_path, whole):
    """From another thread, while the first one works, once on a new store and once on a stopped
    one.
    """
    for store in (tmp_path / "new.zarr", stopped(tmp_path / "old.zarr")):
        refused = []

        def again(*numbers, store=store, refused=refused):
            if not refused:
                with concurrent.futures.ThreadPoolExecutor() as pool:
                    other = pool.submit(dpend.sweep, cheap, Pendulum(), AXES, store=store)
                    refused.append(str(other.exception(60)))

        dpend.sweep(cheap, Pendulum(), AXES, store=store, progress=again)
        wanted = (
            f"store must not be written by two at once, got {store}, which another process or "
            f"thread is writing"
        )
        assert refused[0].startswith(wanted)
        assert contents(store) == contents(whole)


def test_of_many_that_begin_at_once_one_goes_on(tmp_path, whole):
    store = tmp_path / "m.zarr"
    with concurrent.futures.ThreadPoolExecutor(6) as pool:
        jobs = [pool.submit(dpend.sweep, cheap, Pendulum(), AXES, store=store) for _ in range(6)]
        errors = [job.exception() for job in jobs]
    assert None in errors
    for error in errors:
        assert error is None or str(error).startswith("store must not be written by two at once")
    assert contents(store) == contents(whole)
    assert [path.name for path in tmp_path.iterdir()] == ["m.zarr"]


def test_a_reader_needs_no_lock(tmp_path, whole):
    store = shutil.copytree(whole, tmp_path / "m.zarr")
    with (store / "status/lock").open("r+") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert outcome(store, whole) == "silent"
        (store / "sum/c" / TILE).unlink()
        assert "must not be written by two at once" in outcome(store, whole)


def test_no_warning_from_what_a_user_types(tmp_path, whole):
    """Warnings are errors here; consolidated metadata is what xarray looks for first."""
    import xarray

    for store in (whole, stopped(tmp_path / "m.zarr")):
        field = xarray.open_zarr(store).load()
        assert field["sum"].dims == ("theta1", "theta2")
        assert {"theta1_deg", "theta2_deg"} <= set(field.coords)
    assert int(np.sum(field.status.values != Status.NOT_COMPUTED)) == 4


# --- where a store cannot be ----------------------------------------------------------------------


def test_places_that_are_none(tmp_path, whole):
    (tmp_path / "file").write_text("x")
    (tmp_path / "empty").mkdir()
    (tmp_path / "nowhere").symlink_to(tmp_path / "not there")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "link").symlink_to(shutil.copytree(whole, tmp_path / "m.zarr"))
    for name in ("file", "empty", "nowhere", "loop"):
        wanted = (
            f"store must be a Zarr store of a sweep or a new name, got {tmp_path / name}: its "
            f"zarr.json "
        )
        assert outcome(tmp_path / name, whole).startswith(wanted)
    assert outcome(tmp_path / "link", whole) == "silent"


def test_a_disk_that_is_full(tmp_path, whole, monkeypatch):
    """What was done stays; the next call finishes it."""
    store = stopped(tmp_path / "m.zarr")

    def full(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(stores.Store, "_write_chunk", full)
        assert outcome(store, whole).startswith(
            f"store must be finished or one that can be written to, got {store} (No space left on "
            f"device): give"
        )
    assert outcome(store, whole) == "silent"
