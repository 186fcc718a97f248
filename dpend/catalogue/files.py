"""The file of an atlas, F.csv or F.json: what it says, and where it is no such file.

A table that was damaged on its way is refused, with the row and the column: each cell and each
record must have its form, and all must agree (see `table`).
"""

import csv
import io
import math
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dpend.catalogue.table import (
    COLUMNS,
    LONGEST,
    SHORTEST,
    UNITS,
    Table,
    TableCheck,
    column_name,
)
from dpend.mechanics.pendulum import Pendulum
from dpend.orbits.arc import RELEASED_SYMMETRIES
from dpend.places import read_text
from dpend.records import file_name, parse_json, units_of
from dpend.status import Status

# Names of the pendulum's fields in a file.
_PENDULUM = {name: file_name(name, unit) for name, unit in units_of(Pendulum).items()}
# What a file says besides its orbits, and the types of it.
_ABOUT = {
    "dpend_version": str,
    "pendulum": dict,
    "max_period_s": float,
    "units": dict,
    "coverage": dict,
    "families": list,
    "rows": int,
}
_COVERAGE = {
    "theta2_points": int,
    "time_points": int,
    "refinements": int,
    "suspicious_cells": int,
    "winding": int,
    "degree": int,
    "slices": int,
    "exhausted": bool,
}
# Files of 0.1.0 say neither how many rows they have nor whether the search was broken off.
_MAY_MISS = ("rows", "exhausted")
_FAMILY = {
    "family": str,
    "symmetry": str,
    "ends": list,
    "status": str,
    "shortest_period_s": float,
    "longest_period_s": float,
    "special_points": list,
}
_SPECIAL = {
    "kind": str,
    "arclength": float,
    "theta1_deg": float,
    "theta2_deg": float,
    "period_s": float,
    "kappa": float,
}
_ENDS = (
    "normal mode",
    "homoclinic",
    "closed",
    "branch point",
    "longest period",
    "lost",
    "unfinished",
)
# Kinds of special points.
_KIND = re.compile(
    r"stability_lost|stability_gained|fold_theta1|fold_energy|crossing|resonance_[1-9]\d*:[1-9]\d*"
)
# Numbers as `Atlas.save` writes them in CSV. Python reads more: blanks, 1_000, other scripts.
_NUMBER = re.compile(r"-?(\d+(\.\d*)?([eE][-+]?\d+)?|inf)|nan", re.ASCII)
_INTEGER = re.compile(r"-?\d{1,18}", re.ASCII)
# Types as errors name them.
_TYPES = {
    str: "text",
    dict: "an object",
    list: "a list",
    float: "a finite number",
    int: "an integer",
    bool: "a boolean",
}


class Catalogue(NamedTuple):
    """What a file holds, its angles in radians."""

    pendulum: Pendulum
    max_period: float
    table: Table
    families: tuple[dict[str, Any], ...]
    coverage: dict[str, Any]


class _Rows(NamedTuple):
    """The cells of a table by column, as the file has them, and where each row stands in it."""

    cells: dict[str, Sequence[Any]]
    place: Callable[[int], str]


def read_catalogue(path: Path) -> Catalogue:
    """What F.csv or F.json holds. Errors count rows and lines from 1.

    Files of any `dpend_version` are read, because each is checked in full.

    Raises:
        OSError: it cannot be read.
        ValueError: what is wrong, and where.
    """
    text = read_text(path)
    about, rows = _csv_parts(text) if path.suffix == ".csv" else _json_parts(text)
    pendulum, max_period = _check_about(about)
    table = {key: _column(key, rows) for key in COLUMNS}
    count = len(table["period"])
    if about.get("rows", count) != count:
        raise ValueError(f"rows is {about['rows']}, and there are {count}")
    families = {one["family"]: one for one in about["families"]}
    TableCheck(table, rows.place).run(pendulum, max_period, families)
    return Catalogue(pendulum, max_period, table, tuple(about["families"]), about["coverage"])


def _csv_parts(text: str) -> tuple[Any, _Rows]:
    if not text.startswith("#"):
        raise ValueError("line 1 must be a comment, # and a JSON object")
    lines = io.StringIO(text, newline=None)
    about = parse_json(lines.readline()[1:])
    header, found = _csv_lines(lines)

    def place(i: int) -> str:
        return f"row {i + 1} in line {found[i][1]}"

    for i, (row, _) in enumerate(found):
        if len(row) != len(header):
            raise ValueError(f"{place(i)} has {len(row)} cells, the header has {len(header)}")
    columns = list(zip(*(row for row, _ in found), strict=True)) or [()] * len(header)
    by_name = dict(zip(header, columns, strict=True))
    return about, _Rows(
        {key: _parse_cells(key, by_name[column_name(key)], place) for key in COLUMNS}, place
    )


def _csv_lines(lines: Iterable[str]) -> tuple[list[str], list[tuple[list[str], int]]]:
    """The header, and each row with the number of its line in a file with one line before."""
    try:
        reader = csv.reader(lines, strict=True)
        found = [(row, reader.line_num + 1) for row in reader if row]
    except csv.Error as error:
        raise ValueError(f"line {reader.line_num + 1}: {error}") from None
    header = [name.strip() for name in found[0][0]] if found else []
    if header and header[0].startswith("#"):
        raise ValueError("line 2 must be the header, and is another comment")
    _check_names("the header", header, [column_name(key) for key in COLUMNS])
    return header, found[1:]


def _parse_cells(column: str, cells: Sequence[str], place: Callable[[int], str]) -> Sequence[Any]:
    """The numbers of a column of CSV; text and the status stay text."""
    kind = str if column == "status" else COLUMNS[column]
    if kind is str:
        return cells
    pattern = _NUMBER if kind is float else _INTEGER
    for i, cell in enumerate(cells):
        if not pattern.fullmatch(cell):
            raise ValueError(
                f"{place(i)}: {column_name(column)} must be {_TYPES[kind]}, is {cell!r:.60}"
            )
    return [kind(cell) for cell in cells]


def _json_parts(text: str) -> tuple[Any, _Rows]:
    about = parse_json(text)
    if type(about) is not dict or type(about.get("orbits")) is not list:
        raise ValueError("it must be an object with a list called orbits")
    names = [column_name(key) for key in COLUMNS]
    angles = ("theta1_deg", "theta2_deg")
    own = [name for name in names if name[:5] not in ("dual_", "turns")] + ["dual", "turns"]
    rows = about.pop("orbits")
    for i, row in enumerate(rows):
        check_type(f"row {i + 1}", row, dict)
        _check_names(f"row {i + 1}", row, own)
        dual, turns = row.pop("dual"), row.pop("turns")
        check_type(f"row {i + 1}: dual", dual, dict)
        _check_names(f"row {i + 1}: dual", dual, angles)
        if type(turns) is not list or len(turns) != 2:
            raise ValueError(f"row {i + 1}: turns must be a list of two integers, is {turns!r:.60}")
        row |= {f"dual_{key}": value for key, value in dual.items()}
        row |= {"turns1": turns[0], "turns2": turns[1]}
    return about, _Rows(
        {key: [row[column_name(key)] for row in rows] for key in COLUMNS}, lambda i: f"row {i + 1}"
    )


def _column(column: str, rows: _Rows) -> np.ndarray:
    """A column in SI units. null becomes NaN, which `TableCheck` refuses where a number must be."""
    cells, kind = rows.cells[column], COLUMNS[column]
    if column == "status":
        return _statuses(rows)
    for i, cell in enumerate(cells):
        if kind is not float or not (cell is None or type(cell) is float):
            check_type(f"{rows.place(i)}: {column_name(column)}", cell, kind)
    if kind is not float:
        return np.array(cells, kind)
    values = np.array([math.nan if cell is None else cell for cell in cells], float)
    return np.radians(values) if UNITS.get(column) == "deg" else values


def _statuses(rows: _Rows) -> np.ndarray:
    cells = rows.cells["status"]
    known = {status.name.lower(): int(status) for status in Status}
    for i, cell in enumerate(cells):
        if type(cell) is not str or cell not in known:
            raise ValueError(
                f"{rows.place(i)}: status must be one of {', '.join(known)}, is {cell!r:.60}"
            )
    return np.array([known[cell] for cell in cells], int)


def _is_number(value: Any) -> bool:
    return (
        isinstance(value, (int, float))
        and not isinstance(value, bool)
        and abs(value) <= sys.float_info.max
    )


def check_type(place: str, value: Any, kind: type) -> None:
    """Refuses what is of another type: a boolean is no number, and an integer is below 2^53."""
    good = _is_number(value) if kind is float else type(value) is kind
    if kind is int and good:
        good = abs(int(value)) < 2**53
    if not good:
        raise ValueError(f"{place} must be {_TYPES[kind]}, is {value!r:.60}")


def _check_names(place: str, names: Sequence[str] | dict[str, Any], wanted: Sequence[str]) -> None:
    if list(names) == wanted:
        return
    given = list(names)
    twice = [name for name in given if given.count(name) > 1]
    missing = [name for name in wanted if name not in given and name not in _MAY_MISS]
    extra = [name for name in given if name not in wanted]
    for what, some in (("twice", twice), ("no", missing), ("unknown", extra)):
        if some:
            raise ValueError(f"{place} has {what} {some[0]:.60}")


def check_record(place: str, record: Any, fields: Mapping[str, type]) -> None:
    """Refuses what is no object with these fields."""
    check_type(place, record, dict)
    _check_names(place, record, list(fields))
    for name, value in record.items():
        check_type(f"{place}.{name}", value, fields[name])


def _check_about(about: Any) -> tuple[Pendulum, float]:
    """The pendulum and the longest period."""
    check_record("the head", about, _ABOUT)
    check_record("pendulum", about["pendulum"], dict.fromkeys(_PENDULUM.values(), float))
    for key, value in about["pendulum"].items():
        check_least(f"pendulum.{key}", value, 0, strict=True)
    check_least("max_period_s", about["max_period_s"], 0, strict=True)
    check_record("units", about["units"], dict.fromkeys(UNITS, str))
    for key, unit in UNITS.items():
        if about["units"][key] != unit:
            raise ValueError(f"units.{key} must be {unit}, is {about['units'][key]!r:.60}")
    check_record("coverage", about["coverage"], _COVERAGE)
    for key, value in about["coverage"].items():
        if key not in ("winding", "degree"):
            check_least(f"coverage.{key}", value, 0)
    for i, family in enumerate(about["families"]):
        _check_family(f"families[{i}]", family, about["max_period_s"])
    names = [family["family"] for family in about["families"]]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise ValueError(f"families[{i}].family is {name!r}, as another family is")
    values = {name: float(about["pendulum"][key]) for name, key in _PENDULUM.items()}
    return Pendulum(**values), float(about["max_period_s"])


def check_least(place: str, value: float | int, least: float | int, strict: bool = False) -> None:
    """Refuses a number below `least`, with `strict` also `least` itself."""
    if value < least or (strict and value == least):
        raise ValueError(
            f"{place} must be {'above' if strict else 'at least'} {least:g}, is {value:.10g}"
        )


def _check_one_of(place: str, value: Any, known: Sequence[str]) -> None:
    if value not in known:
        raise ValueError(f"{place} must be one of {', '.join(known)}, is {value!r:.60}")


def _check_family(place: str, family: Any, max_period: float | int) -> None:
    """Refuses a family's record of another form, and special points outside the family."""
    check_record(place, family, _FAMILY)
    _check_one_of(f"{place}.symmetry", family["symmetry"], RELEASED_SYMMETRIES)
    if not re.fullmatch(
        family["symmetry"][0].upper() + r"[1-9]\d{0,8}", family["family"], re.ASCII
    ):
        raise ValueError(
            f"{place}.family must be a {family['symmetry']} one's name, is {family['family']!r:.60}"
        )
    _check_one_of(f"{place}.status", family["status"], [status.name.lower() for status in Status])
    if len(family["ends"]) != 2:
        raise ValueError(f"{place}.ends must be a list of two, is {family['ends']!r:.60}")
    for i, end in enumerate(family["ends"]):
        _check_one_of(f"{place}.ends[{i}]", end, _ENDS)
    shortest, longest = family["shortest_period_s"], family["longest_period_s"]
    most = max_period * (1 + LONGEST)
    check_least(f"{place}.shortest_period_s", shortest, 0, strict=True)
    check_least(f"{place}.longest_period_s", longest, shortest * (1 - SHORTEST))
    if longest > most:
        raise ValueError(
            f"{place}.longest_period_s is {longest:.10g}, max_period_s is {max_period:.10g}"
        )
    last = 0.0
    for i, point in enumerate(family["special_points"]):
        where = f"{place}.special_points[{i}]"
        check_record(where, point, _SPECIAL)
        if not _KIND.fullmatch(point["kind"]):
            raise ValueError(f"{where}.kind is not known: {point['kind']!r:.60}")
        check_least(f"{where}.arclength", point["arclength"], last)
        check_least(f"{where}.period_s", point["period_s"], shortest * (1 - SHORTEST))
        if point["period_s"] > most:
            raise ValueError(
                f"{where}.period_s is {point['period_s']:.10g}, max_period_s is {max_period:.10g}"
            )
        last = point["arclength"]
