"""A survey's slices, and the store from which a search goes on."""

import hashlib
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dpend.catalogue.files import check_least, check_record, check_type
from dpend.catalogue.release import BEYOND
from dpend.catalogue.track import Track
from dpend.places import read_text, replacing
from dpend.records import json_text, parse_json

# Slices are odd multiples of pi/2^(level + 1), on so many levels at most.
MOST_LEVELS = 10
# The keys of a store, of a slice and of a family in it, and their types.
_STORE = {"settings": dict, "slices": list, "families": list, "checksum": str}
_SLICE = {
    "theta1": float,
    "motions": int,
    "rows": int,
    "open_cells": int,
    "winding": int,
    "degree": int,
    "returns": list,
    "lost": int,
}
_SEED = {"seed": list, "level": int}


@dataclass
class Slice:
    """What was found at one theta1."""

    motions: int
    rows: int
    open_cells: int
    winding: int
    degree: int
    returns: list[list[float]]
    lost: int = 0

    @property
    def doubts(self) -> int:
        return self.open_cells + self.lost + abs(self.winding - self.degree)


def slice_angles(level: int) -> list[float]:
    """The slices of a level."""
    angles: list[float] = (np.pi * (2 * np.arange(2**level) + 1) / 2 ** (level + 1)).tolist()
    return angles


def checksum(record: dict[str, Any]) -> str:
    """Of all else in a store: a search that went on from other numbers would be wrong and not show
    it.
    """
    rest = {key: value for key, value in record.items() if key != "checksum"}
    return hashlib.sha256(json_text(rest, indent=None).encode()).hexdigest()


def write_store(
    path: Path, settings: dict[str, Any], slices: dict[float, Slice], tracks: list[Track]
) -> None:
    record: dict[str, Any] = {
        "settings": settings,
        "slices": [{"theta1": theta1} | asdict(found) for theta1, found in slices.items()],
        "families": [{"seed": list(track.seed), "level": track.level} for track in tracks],
    }
    with replacing(path) as draft:
        draft.write_text(json_text(record | {"checksum": checksum(record)}) + "\n")


def read_store(path: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """What a store holds, refused unless it is of the same search and as it was written."""
    try:
        record: dict[str, Any] = parse_json(read_text(path))
        _check_store(record)
    except (OSError, ValueError) as error:
        raise no_store(path, getattr(error, "strerror", None) or str(error)) from None
    kept = record["settings"]
    if kept != settings:
        wrong = next(key for key in (*settings, *kept) if kept.get(key) != settings.get(key))
        raise ValueError(
            f"store must have been made with the same settings, got {path} with {wrong} "
            f"{kept.get(wrong)!r:.200}: "
            "give another name"
        )
    try:
        _check_search(record, settings["max_period"])
    except ValueError as error:
        raise no_store(path, str(error)) from None
    return record


def no_store(path: Path, reason: str) -> ValueError:
    return ValueError(
        f"store must be a file that find_brake_families wrote, got {path} ({reason}): give another "
        f"name"
    )


def _check_store(record: Any) -> None:
    """Refuses what has not the form of a store, or was changed since it was written."""
    check_record("the store", record, _STORE)
    for i, one in enumerate(record["slices"]):
        check_record(f"slices[{i}]", one, _SLICE)
        for k, pair in enumerate(one["returns"]):
            _check_numbers(f"slices[{i}].returns[{k}]", pair, 2)
    for i, one in enumerate(record["families"]):
        check_record(f"families[{i}]", one, _SEED)
        _check_numbers(f"families[{i}].seed", one["seed"], 3)
    if record["checksum"] != checksum(record):
        raise ValueError("it was changed since, or damaged: its checksum is another")


def _check_numbers(place: str, value: Any, count: int) -> None:
    check_type(place, value, list)
    if len(value) != count:
        raise ValueError(f"{place} must have {count} numbers, has {len(value)}")
    for number in value:
        check_type(place, number, float)


def _check_search(record: dict[str, Any], max_period: float) -> None:
    """Refuses slices that this search would not look at first, and families that none of their
    returns begins.
    """
    wanted = [angle for level in range(MOST_LEVELS) for angle in slice_angles(level)]
    returns = set()
    for i, one in enumerate(record["slices"]):
        if i >= len(wanted) or one["theta1"] != wanted[i]:
            raise ValueError(
                f"slices[{i}].theta1 is {one['theta1']:.10g}, which is not the next one"
            )
        _check_slice(i, one, max_period)
        returns |= {(one["theta1"], *pair) for pair in one["returns"]}
    for i, one in enumerate(record["families"]):
        if tuple(one["seed"]) not in returns or not 0 <= one["level"] < MOST_LEVELS:
            raise ValueError(f"families[{i}] begins at none of the returns")


def _check_slice(i: int, one: dict[str, Any], max_period: float) -> None:
    for name in ("motions", "rows", "open_cells", "lost"):
        check_least(f"slices[{i}].{name}", one[name], 0)
    for theta2, period in one["returns"]:
        if not (0 < period <= max_period * (1 + 2 * BEYOND) and abs(theta2) < 1.001 * math.pi):
            raise ValueError(
                f"slices[{i}].returns has ({theta2:.10g}, {period:.10g}), outside of the search"
            )
