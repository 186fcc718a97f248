"""The layout of a sweep's store: its arrays, coordinates and attributes, made in memory."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from dpend.maps.grid import coordinates_of, units_of
from dpend.maps.store import Store
from dpend.maps.tiles import Work
from dpend.status import Status

# The attribute by which xarray knows a store's further coordinates.
_DEGREES = "coordinates"


def store_of(work: Work, path: Path, attributes: dict[str, Any]) -> Store:
    """What the store of a sweep should hold."""
    memory: dict[str, Any] = {}  # the files of an empty store, as Zarr writes them
    arrays = _lay(work, attributes, memory)
    files = _consolidate({name: buffer.to_bytes() for name, buffer in memory.items()})

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


def _lay(work: Work, attributes: dict[str, Any], memory: dict[str, Any]) -> dict[str, Any]:
    """An empty store in `memory`; the arrays that are computed. Each chunk ends in a checksum for
    any reader.
    """
    import zarr
    from zarr.codecs import Crc32cCodec, ZstdCodec
    from zarr.storage import MemoryStore

    grid = work.task.grid
    degrees = " ".join(key for key in coordinates_of(grid) if key not in grid.axes)
    group: Any = zarr.create_group(MemoryStore(memory), attributes=attributes | {_DEGREES: degrees})
    for key, (dim, values, units) in coordinates_of(grid).items():
        array = group.create_array(
            key,
            shape=values.shape,
            dtype=values.dtype,
            chunks=values.shape,
            dimension_names=[dim],
            attributes=units,
            compressors=[
                Crc32cCodec()
            ],  # not compressed: compressors of other versions may give other bytes
        )
        array[...] = values
    return {
        key: group.create_array(
            key,
            shape=grid.shape,
            dtype=kind,
            chunks=grid.tile(),
            dimension_names=list(grid.axes),
            fill_value=int(Status.NOT_COMPUTED)
            if key == "status"
            else (math.nan if kind.kind == "f" else 0),
            attributes=units_of(key),
            compressors=[ZstdCodec(level=0, checksum=False), Crc32cCodec()],
            # Chunks of nothing but fill values must be there too: a tile's files tell that it is
            # done.
            config={"write_empty_chunks": True},
        )
        for key, kind in work.kinds.items()
    }


def _consolidate(files: dict[str, bytes]) -> dict[str, bytes]:
    """The files with the metadata of all arrays in the group's too, where xarray looks for it
    first.
    """
    inside = {
        name.removesuffix("/zarr.json"): json.loads(text)
        for name, text in sorted(files.items())
        if name.endswith("/zarr.json")
    }
    group = json.loads(files["zarr.json"])
    group["consolidated_metadata"] = {
        "kind": "inline",
        "must_understand": False,
        "metadata": inside,
    }
    return files | {"zarr.json": json.dumps(group, indent=2).encode()}
