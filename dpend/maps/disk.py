"""Files that are whole or not there, whenever the process is killed, and why one cannot be read."""

import json
import os
import secrets
import shutil
import stat
from pathlib import Path
from typing import Any

# Files of metadata have a few kilobytes; a quantity's settings may add to that. Larger ones are not
# read [bytes].
_LARGEST_DOCUMENT = 1 << 24
# Why a file that is not there cannot be read.
MISSING = "is missing"


def read(path: Path, most: int) -> bytes:
    """A file's bytes.

    Raises:
        ValueError: why it is not read, in words that follow its name.
    """
    try:
        found = os.stat(path)
        if not stat.S_ISREG(found.st_mode):
            raise ValueError("is no file")
        if found.st_size > most:
            raise ValueError(f"has {found.st_size} bytes")
        return path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        raise ValueError(MISSING) from None
    except OSError as error:
        raise ValueError(f"cannot be read ({error.strerror or error})") from None


def read_json(path: Path) -> Any:
    """A JSON file's value; raises as `read` does."""
    text = read(path, _LARGEST_DOCUMENT)
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        raise ValueError("is no JSON") from None


def read_attributes(name: str, path: Path) -> dict[str, Any]:
    """The attributes of a sweep's store.

    Raises:
        ValueError: there is none. `name` is the argument that is told.
    """
    try:
        document = read_json(path / "zarr.json")
        problem = "is no description of a sweep"
    except ValueError as error:
        document, problem = None, str(error)
    found = document.get("attributes") if isinstance(document, dict) else None
    if not isinstance(found, dict) or not isinstance(found.get("dpend_version"), str):
        raise ValueError(
            f"{name} must be a Zarr store of a sweep or a new name, got {path}: its zarr.json "
            f"{problem}; "
            "give another name"
        )
    return found


def canonical(value: Any) -> str:
    """A text that is the same for JSON values of the same content and types only."""
    return json.dumps(value, sort_keys=True)


def put(root: Path, name: str, text: bytes) -> None:
    """A file's bytes in one stroke, on the disk when this returns."""
    make_way(root, name)
    file = root / name
    if not os.path.isfile(file) or file.is_symlink():
        remove(file)
    file.parent.mkdir(parents=True, exist_ok=True)
    draft = file.with_name(f"{file.name}.{secrets.token_hex(4)}.partial")
    try:
        draft.write_bytes(text)
        sync(draft)
        os.replace(draft, file)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise
    _sync_above(root, name)


def clear(root: Path, name: str) -> None:
    """Removes what stands in a file's place, or in that of a directory above it."""
    make_way(root, name)
    remove(root / name)


def make_way(root: Path, name: str) -> None:
    for above in [*reversed((root / name).relative_to(root).parents)][1:]:
        if os.path.lexists(root / above) and not os.path.isdir(root / above):
            remove(root / above)


def remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _sync_above(root: Path, name: str) -> None:
    """Waits until the directories above a file are on the disk."""
    for above in Path(name).parents:
        sync(root / above)


def sync(place: Path) -> None:
    handle = os.open(place, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
