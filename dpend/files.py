"""Files: a place is tried before anything is computed, and a new file takes the old one's place only when whole."""

import contextlib
import json
import math
import os
import re
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any


def unwritable(path: Path) -> str:
    """Why no new file can be put beside `path`, in the system's words; empty if one can.

    It is tried: permissions do not tell what the root user, a disk mounted for reading or the system's own directories
    allow, nor how long a name may be.
    """
    try:
        tempfile.NamedTemporaryFile(prefix=f".{path.name}.", suffix=path.suffix, dir=path.parent).close()
    except OSError as error:
        return error.strerror or str(error)
    return ""


def check_place(name: str, path: Path, suffixes: Sequence[str]) -> None:
    """Refuses, before anything is computed, a file that could not be written after.

    Raises:
        ValueError: another suffix; no directory to write in. `name` is the argument that is told.
    """
    if path.suffix not in suffixes:
        raise ValueError(f"{name} must end in {' or '.join(suffixes)}, got {path}: give another name")
    reason = "Is a directory" if os.path.isdir(path) else unwritable(path)
    if reason:
        raise ValueError(
            f"{name} must be a file in a directory that can be written to, got {path} ({reason}): give another place"
        )


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary name beside `path`, which takes its place if all goes well: a file that is there, old or new, is
    always whole.
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
    """The number that a text says in decimal digits; infinity where it is beyond the largest double.

    Raises:
        ValueError: any other text.
    """
    if not _DECIMAL.fullmatch(text):
        raise ValueError(f"{text!r:.60} is not a number")
    return float(text)
