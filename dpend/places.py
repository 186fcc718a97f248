"""Files on disk: where one may be written, how it is replaced whole, and how it is read."""

import contextlib
import os
import stat
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from dpend.checks import shown

# The largest file that is read [bytes]: nearly half a million orbits as JSON, or five million
# measured samples. Parsing takes about ten times as much memory, 2.5 GB.
LARGEST_FILE = 1 << 28


def file_path(name: str, value: Any) -> Path:
    """The path of a file or directory.

    Raises:
        ValueError: neither text nor a path, or one that no system has.
    """
    text = os.fspath(value) if isinstance(value, (str, os.PathLike)) else ""
    if not isinstance(text, str) or not text or "\0" in text:
        raise ValueError(f'{name} must be a path, got {shown(value)}: give one like "F.json"')
    return Path(text)


def unwritable(path: Path) -> str:
    """Why no new file can be put beside `path`, in the system's words; empty if one can.

    It is tried: permissions do not tell what the root user, a disk mounted for reading or the
    system's own directories allow, nor how long a name may be.
    """
    try:
        tempfile.NamedTemporaryFile(
            prefix=f".{path.name}.", suffix=path.suffix, dir=path.parent
        ).close()
    except OSError as error:
        return error.strerror or str(error)
    return ""


def check_place(name: str, path: Path, suffixes: Sequence[str]) -> None:
    """Refuses, before anything is computed, a file that could not be written after.

    Raises:
        ValueError: another suffix; no directory to write in. `name` is the argument that is told.
    """
    if path.suffix not in suffixes:
        raise ValueError(
            f"{name} must end in {' or '.join(suffixes)}, got {path}: give another name"
        )
    reason = "Is a directory" if os.path.isdir(path) else unwritable(path)
    if reason:
        raise ValueError(
            f"{name} must be a file in a directory that can be written to, got {path} ({reason}): "
            f"give another place"
        )


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary name beside `path`, which takes its place if all goes well: a file that is there,
    old or new, is always whole.
    """
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    try:
        yield Path(name)
        os.chmod(name, 0o644)
        os.replace(name, path)
    except BaseException:
        os.unlink(name)
        raise


def read_text(path: Path) -> str:
    """The text of a file that a user names, which is refused unread if it has no end.

    A pipe, a device, or a file that the system makes up while it is read has no size to check. The
    file is opened so that nothing waits for a writer, and no more is read than its size.

    Raises:
        OSError: it cannot be opened or read.
        ValueError: no regular file, one above `LARGEST_FILE`, one that changes meanwhile, or text
            that is not UTF-8.
    """
    _check_size(os.stat(path))
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    with open(handle, "rb") as file:
        size = _check_size(os.fstat(handle))
        data = file.read(size + 1)
    if len(data) != size:
        raise ValueError(
            f"it has {size} bytes and gives {'more' if len(data) > size else len(data)}"
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"byte {error.start} is no UTF-8 text") from None


def _check_size(status: os.stat_result) -> int:
    if not stat.S_ISREG(status.st_mode):
        raise ValueError("it is no regular file")
    if status.st_size > LARGEST_FILE:
        sizes = (f"{size / 1e6:.0f} MB" for size in (status.st_size, LARGEST_FILE))
        raise ValueError("it has {}, above the limit of {}".format(*sizes))
    return status.st_size
