"""Files: a place is tried before anything is computed, and a new file takes the old one's place
only when whole.
"""

import contextlib
import json
import math
import os
import re
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

# The largest file that is read [bytes]: nearly half a million orbits as JSON, or five million
# measured samples. Parsing takes about ten times as much memory, 2.5 GB.
LARGEST_FILE = 1 << 28


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


def parse_json(text: str) -> Any:
    """What JSON says, as strictly as its standard: no key twice, no NaN, and no more levels than
    Python can follow.

    Raises:
        ValueError: what is wrong, with the line and column, or the key.
    """

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        record = dict(pairs)
        if len(record) < len(pairs):
            names = [name for name, _ in pairs]
            twice = next(name for name in names if names.count(name) > 1)
            raise ValueError(f"the key {twice!r:.60} stands twice in one object")
        return record

    def refuse(token: str) -> None:
        raise ValueError(f"{token} is no JSON number")

    try:
        return json.loads(text, object_pairs_hook=unique, parse_constant=refuse)
    except RecursionError:
        raise ValueError("its brackets are nested too deeply") from None


def json_text(record: dict[str, Any], indent: int | None = 2) -> str:
    """The text of a JSON object, on one line without `indent`; NaN and infinity become null."""

    def clean(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: clean(item) for key, item in value.items()}
        if isinstance(value, (list, tuple)):
            return [clean(item) for item in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return json.dumps(clean(record), indent=indent, allow_nan=False)


# Decimal numbers as people write them. Python reads more: 1_000, digits of other scripts, nan.
_DECIMAL = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


def parse_decimal(text: str) -> float:
    """The number that a text says in decimal digits; infinity where it is beyond the largest
    double.

    Raises:
        ValueError: any other text.
    """
    if not _DECIMAL.fullmatch(text):
        raise ValueError(f"{text!r:.60} is not a number")
    return float(text)
