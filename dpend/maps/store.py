"""Maps in a Zarr store that can be resumed.

A tile is computed as a whole, its values are written and synced to disk, and only then its status:
whatever moment the process is killed at, the same call finishes the map with the bytes that an
uninterrupted run would have given.
"""

import contextlib
import errno
import functools
import hashlib
import itertools
import json
import os
import secrets
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dpend.maps import disk
from dpend.maps.disk import MISSING, canonical, clear, make_way, put, read, read_json, remove, sync
from dpend.places import unwritable

# Where the digests of tiles and the lock lie: inside an array, where Zarr's readers do not look.
# The lock is empty, but while tiles are written in any order.
_DIGESTS, _LOCK = "status/sha256", "status/lock"
# How many damaged files a warning names.
_NAMED = 3


class StoreWarning(UserWarning):
    """A store was damaged, and what is damaged is made again."""


@dataclass(frozen=True)
class Store:
    """What a store should hold.

    Attributes:
        path: the directory.
        attributes: of the group: all that determines the values.
        documents: metadata, by file name.
        coordinates: chunks of coordinates, by file name.
        arrays: the bytes of a chunk of every array that is computed, by name, in the order of
            writing.
        tiles: the indexes of all tiles, in the order of computing.
        encode: the bytes of a chunk, from the name of its file, the cells and their values.
    """

    path: Path
    attributes: Mapping[str, Any]
    documents: Mapping[str, bytes]
    coordinates: Mapping[str, bytes]
    arrays: Mapping[str, int]
    tiles: Sequence[tuple[int, ...]]
    encode: Callable[[str, tuple[slice, ...], np.ndarray], bytes]

    def create(self) -> None:
        """An empty store, under a temporary name until it is whole; nothing where another process
        is faster.
        """
        draft = self.path.with_name(f".{self.path.name}.{secrets.token_hex(4)}")
        try:
            draft.mkdir()
            for name, text in {**self.documents, **self.coordinates, _LOCK: b""}.items():
                put(draft, name, text)
            os.rename(draft, self.path)
            sync(self.path.parent)
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise self._unwritable(error) from None
        finally:
            shutil.rmtree(draft, ignore_errors=True)

    def check(self) -> None:
        """Refuses a store of another sweep.

        Raises:
            ValueError: it is none, or its attributes are others, or it holds what belongs to no
                sweep.
            RuntimeError: another version of this package made it.
        """
        found = disk.read_attributes("store", self.path)
        ours = self.attributes["dpend_version"]
        if found["dpend_version"] != ours:
            raise RuntimeError(
                f"store {self.path} was made by version {found['dpend_version']} of dpend, this is "
                f"{ours}: "
                "finish it with that version, or give another name"
            )
        wanted = self._wanted
        for key in {**wanted, **found}:
            if canonical(found.get(key)) != canonical(wanted.get(key)):
                raise ValueError(
                    f"store {self.path} holds another sweep, its {key} is {found.get(key)!r}, not "
                    f"{wanted.get(key)!r}: give another name"
                )
        members = {name.partition("/")[0] for name in self.documents}
        for name in sorted(os.listdir(self.path)):
            if name not in members and not name.endswith(".partial"):
                raise ValueError(
                    f"store {self.path} holds {name}, which is no part of this sweep: move it "
                    f"elsewhere"
                )

    def inspect(self) -> "Findings":
        """Every file beside what it should be, one tile at a time."""
        stale = self._find_stale()
        tiles = {tile: self.tile_problems(tile) for tile in self.tiles}
        todo = [tile for tile in self.tiles if tiles[tile]]
        # Tiles are computed in order: one that was never done has no digest, and none after it has.
        # Of tiles written in any order, no digest tells nothing.
        unordered = self._is_unordered()
        done = sum(1 for _ in itertools.dropwhile(tiles.get, reversed(self.tiles)))
        before = set(self.tiles[: done * (not unordered)])
        fresh = {tile for tile in todo if tiles[tile].get(self._digest_name(tile)) == MISSING}
        again = [tile for tile in todo if tile in before or tile not in fresh]
        damage = stale | {name: why for tile in again for name, why in tiles[tile].items()}
        leftovers = list(self.path.glob("*.partial"))
        return Findings(stale, todo, again, damage, leftovers, unordered)

    def _is_unordered(self) -> bool:
        return os.path.isfile(self.path / _LOCK) and os.path.getsize(self.path / _LOCK) > 0

    def _find_stale(self) -> dict[str, str]:
        """Metadata and coordinates that are not as they should be, and why."""
        problems = {
            name: self._document_problem(name, self.documents[name]) for name in self.documents
        }
        for name, text in self.coordinates.items():
            problems[name] = self._coordinate_problem(name, text)
        return {name: problem for name, problem in problems.items() if problem}

    def _document_problem(self, name: str, text: bytes) -> str:
        try:
            found = read_json(self.path / name)
        except ValueError as error:
            return str(error)
        return "" if canonical(found) == canonical(json.loads(text)) else "is another"

    def _coordinate_problem(self, name: str, text: bytes) -> str:
        try:
            found = read(self.path / name, 2 * len(text) + 1024)
        except ValueError as error:
            return str(error)
        return "" if found == text else "has other bytes"

    def tile_problems(self, tile: tuple[int, ...]) -> dict[str, str]:
        """What is wrong with a tile's files, by name; nothing with one that is done."""
        digest = self._digest_name(tile)
        try:
            lines = read(self.path / digest, 1024 * len(self.arrays)).split(b"\n")
        except ValueError as error:
            return {digest: str(error)}
        problems = {}
        for key in self.arrays:
            name = self.chunk(key, tile)
            try:
                text = read(self.path / name, self.arrays[key] + self.arrays[key] // 64 + 1024)
                if self._line(name, text) not in lines:
                    problems[name] = "has other bytes than were written"
            except ValueError as error:
                problems[name] = str(error)
        if not problems and len(lines) != len(self.arrays) + 1:
            problems[digest] = "has other lines"
        return problems

    def _line(self, name: str, text: bytes) -> bytes:
        """A chunk's line in the digest of its tile: of its bytes, its place, and the sweep that it
        belongs to.
        """
        digest = hashlib.sha256(f"{self._identity} {name} ".encode())
        digest.update(text)
        return f"{digest.hexdigest()} {name}".encode()

    @functools.cached_property
    def _identity(self) -> str:
        return hashlib.sha256(canonical(self._wanted).encode()).hexdigest()

    @functools.cached_property
    def _wanted(self) -> dict[str, Any]:
        """The group's attributes, as JSON gives them back."""
        return dict(json.loads(self.documents["zarr.json"])["attributes"])

    def chunk(self, key: str, tile: tuple[int, ...]) -> str:
        """The name of a chunk's file."""
        return "/".join([key, "c", *map(str, tile)])

    def _digest_name(self, tile: tuple[int, ...]) -> str:
        return "/".join([_DIGESTS, *map(str, tile)])

    def repair(self, findings: "Findings") -> None:
        """Writes metadata and coordinates again, and removes what is there of tiles that are not
        done.
        """
        try:
            for leftover in [*findings.leftovers, *self.path.rglob("*.partial")]:
                remove(leftover)  # of a process that was killed while it wrote
            for name in findings.stale:
                put(self.path, name, {**self.documents, **self.coordinates}[name])
            for tile in findings.todo:
                clear(self.path, self._digest_name(tile))
                for key in reversed(list(self.arrays)):
                    clear(self.path, self.chunk(key, tile))
        except OSError as error:
            raise self._unwritable(error) from None

    def write(
        self, tile: tuple[int, ...], block: tuple[slice, ...], values: Mapping[str, Any]
    ) -> None:
        """Writes a tile's values, the status after them, the digest last, each once the one before
        is on the disk.
        """
        try:
            lines = [self._write_chunk(key, tile, block, values[key]) for key in self.arrays]
            put(self.path, self._digest_name(tile), b"".join(line + b"\n" for line in lines))
        except OSError as error:
            raise self._unwritable(error) from None

    def _write_chunk(
        self, key: str, tile: tuple[int, ...], block: tuple[slice, ...], values: np.ndarray
    ) -> bytes:
        """Writes an array's chunk; its line in the digest."""
        name = self.chunk(key, tile)
        text = self.encode(name, block, values)
        put(self.path, name, text)
        return self._line(name, text)

    def mark(self, unordered: bool) -> None:
        """Says in the lock, which must be held, whether tiles are being written in any order."""
        try:
            (self.path / _LOCK).write_bytes(b"unordered" if unordered else b"")
        except OSError as error:
            raise self._unwritable(error) from None

    def array(self, key: str) -> Any:
        """An array of the store, to be read."""
        import zarr

        return zarr.open_array(self.path / key, mode="r")

    def open(self) -> Any:
        """The store as an `xarray.Dataset`, read when it is looked at."""
        import xarray

        return xarray.open_zarr(self.path, consolidated=False, chunks=None)

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Keeps others from writing; the system lets go of it when the process ends, however it
        ends.

        Raises:
            ValueError: another one writes, or the store cannot be written to.
        """
        import fcntl

        if not os.access(self.path, os.W_OK):
            raise ValueError(
                f"store must be finished or one that can be written to, got {self.path}: finish a "
                f"copy of it"
            )
        try:
            file = self.path / _LOCK
            make_way(self.path, _LOCK)
            if not os.path.isfile(file) or file.is_symlink():
                remove(file)
            file.parent.mkdir(exist_ok=True)
            handle = os.open(file, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
        except OSError as error:
            raise self._unwritable(error) from None
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(handle)
            if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
                raise self._unwritable(error) from None
            raise ValueError(
                f"store must not be written by two at once, got {self.path}, which another process "
                f"or thread is "
                "writing: wait for it, or give another name"
            ) from None
        try:
            yield
        finally:
            os.close(handle)

    def _unwritable(self, error: OSError) -> ValueError:
        return ValueError(
            f"store must be finished or one that can be written to, got {self.path} "
            f"({error.strerror or error}): give another place, or finish a copy of it"
        )


@dataclass(frozen=True)
class Findings:
    """What a store lacks.

    Attributes:
        stale: metadata and coordinates that are not as they should be, by file name, and why.
        todo: the tiles that are to be computed, in order.
        again: the tiles among them that were done once.
        damage: files that were once whole, by name, and why they are not.
        leftovers: of a process that was killed.
        unordered: tiles were being written in any order.
    """

    stale: dict[str, str]
    todo: list[tuple[int, ...]]
    again: list[tuple[int, ...]]
    damage: dict[str, str]
    leftovers: list[Path]
    unordered: bool

    @property
    def whole(self) -> bool:
        return not (self.stale or self.todo or self.leftovers or self.unordered)

    def sentence(self, store: Store) -> str:
        """The damage in one line."""
        named = [f"{name} {problem}" for name, problem in list(self.damage.items())[:_NAMED]]
        more = len(self.damage) - len(named)
        rest = f", and {more} more" if more else ""
        return (
            f"store {store.path} is damaged: {', '.join(named)}{rest}; what is damaged is made "
            f"again, "
            f"{len(self.again)} of {len(store.tiles)} tiles"
        )


def check_store(name: str, path: Path) -> None:
    """Refuses, before anything is computed, a path where there is no store and none could be made.

    Raises:
        ValueError: something else is there, or no directory to write in. `name` is the argument
            that is told.
    """
    if os.path.lexists(path):
        disk.read_attributes(name, path)
    elif reason := unwritable(path):
        raise ValueError(
            f"{name} must be a new name in a directory that can be written to, got {path} "
            f"({reason}): "
            "give another place"
        )
