"""The file of an atlas: its columns and units, and what every row of a true one satisfies.

A table that was damaged on its way is refused, with the row and the column. The columns depend on
each other, and that tells most damages: the energy is that of either rest, `log_abs_kappa` is the
logarithm of kappa, the dual of a centred orbit follows from its release, and neighbours on a family
lie no further apart than arclength allows.
"""

import csv
import io
import math
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from dpend.mechanics.pendulum import Pendulum
from dpend.orbits.arc import SEGMENTS
from dpend.orbits.orbit import RELEASED_SYMMETRIES
from dpend.records import file_name, parse_json, read_text, units_of
from dpend.status import Status

# Energies are compared in units of the weights' torques. That of the release is rounding away
# (4e-16 in the published catalogue). The dual is the end of an integration, whose error grows like
# the root of kappa: 4e-13 in the catalogue.
_ENERGY, _ENERGY_OF_DUAL, _GROWTH = 1e-12, 1e-9, 1e-13
# What a degree loses on its way to radians and back, relative to the angle.
_DEGREES = 1e-15
# 2 pi turns - release against the dual of centred orbits [rad]: 4e-15 in the catalogue.
_HALF_TURNS = 1e-9
# kappa against its logarithm, and below -1: both are rounding, and zero in the catalogue.
_KAPPA = 1e-8
# Where kappa is above the first it is held to the largest that float64 can square, and its
# logarithm is above the second.
_CAPPED, _ITS_LOGARITHM = 1e290, 600.0
# Newton's methods stop at this residual at the latest; it grows like the root of kappa.
_RESIDUAL = 1e-6
# The longest period itself lies inside, to this share.
_LONGEST = 1e-11
# Along a family either rest moves no faster than the root of the number of nodes, whose mean square
# is arclength (2.1 in the catalogue), and log of the period not much faster than arclength (0.9
# there).
# Arclength itself is rounded.
_REST, _LOG_PERIOD, _ARCLENGTH = math.sqrt(SEGMENTS), 3.0, 1e-9
# Periods between two rows may be shorter than both, and the limit of shrinking orbits is
# extrapolated [relative].
_SHORTEST = 1e-3

Table: TypeAlias = dict[str, np.ndarray]
Families: TypeAlias = Mapping[str, dict[str, Any]]

UNITS = {
    "theta1": "deg",
    "theta2": "deg",
    "dual_theta1": "deg",
    "dual_theta2": "deg",
    "theta2_error": "deg",
    "period": "s",
    "period_error": "s",
    "energy": "J",
}
# Columns and their types; those without a unit here are as in `PeriodicOrbit` and `Family`.
COLUMNS: dict[str, type] = {
    "family": str,
    "arclength": float,
    "theta1": float,
    "theta2": float,
    "period": float,
    "energy": float,
    "kappa": float,
    "log_abs_kappa": float,
    "symmetry": str,
    "dual_theta1": float,
    "dual_theta2": float,
    "turns1": int,
    "turns2": int,
    "residual": float,
    "theta2_error": float,
    "period_error": float,
    "iterations": int,
    "status": int,
}
_PENDULUM = {name: file_name(name, unit) for name, unit in units_of(Pendulum).items()}
# What else the file says, and the types of it.
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
_KIND = re.compile(
    r"stability_lost|stability_gained|fold_theta1|fold_energy|crossing|resonance_[1-9]\d*:[1-9]\d*"
)
_NUMBER = re.compile(r"-?(\d+(\.\d*)?([eE][-+]?\d+)?|inf)|nan", re.ASCII)
_INTEGER = re.compile(r"-?\d{1,18}", re.ASCII)
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


def column_name(column: str) -> str:
    """A column's name in a file."""
    return f"{column}_{UNITS[column]}" if column in UNITS else column


def column_values(column: str, values: np.ndarray) -> list[Any]:
    """A column as a file has it: angles in degrees, the status by its name."""
    if column == "status":
        return [Status(value).name.lower() for value in values.tolist()]
    converted: list[Any] = (np.degrees(values) if UNITS.get(column) == "deg" else values).tolist()
    return converted


def read_catalogue(path: Path) -> Catalogue:
    """What F.csv or F.json holds; rows are counted from 1, and lines too.

    Files of any `dpend_version` are read: what they must be like is said here, and a number is as
    true as before.

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
    _Check(table, rows.place).run(pendulum, max_period, families)
    return Catalogue(pendulum, max_period, table, tuple(about["families"]), about["coverage"])


def _csv_parts(text: str) -> tuple[Any, _Rows]:
    if not text.startswith("#"):
        raise ValueError("line 1 must be a comment, # and a JSON object")
    lines = io.StringIO(text, newline=None)
    about = parse_json(lines.readline()[1:])
    try:
        reader = csv.reader(lines, strict=True)
        found = [(row, reader.line_num + 1) for row in reader if row]
    except csv.Error as error:
        raise ValueError(f"line {reader.line_num + 1}: {error}") from None
    header = [name.strip() for name in found[0][0]] if found else []
    if header and header[0].startswith("#"):
        raise ValueError("line 2 must be the header, and is another comment")
    _check_names("the header", header, [column_name(key) for key in COLUMNS])
    for i, (row, line) in enumerate(found[1:]):
        if len(row) != len(header):
            raise ValueError(
                f"row {i + 1} in line {line} has {len(row)} cells, the header has {len(header)}"
            )
    columns = list(zip(*(row for row, _ in found[1:]), strict=True)) or [()] * len(header)
    by_name = dict(zip(header, columns, strict=True))

    def place(i: int) -> str:
        return f"row {i + 1} in line {found[i + 1][1]}"

    cells = {key: _parse_cells(key, by_name[column_name(key)], place) for key in COLUMNS}
    return about, _Rows(cells, place)


def _parse_cells(column: str, cells: Sequence[str], place: Callable[[int], str]) -> Sequence[Any]:
    """Text as what it says, but for the status; empty cells, blanks and `1_000` are no numbers."""
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
    """A column in SI units; null is NaN, and what that means is asked for later."""
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
    if value < least or (strict and value == least):
        raise ValueError(
            f"{place} must be {'above' if strict else 'at least'} {least:g}, is {value:.10g}"
        )


def _check_one_of(place: str, value: Any, known: Sequence[str]) -> None:
    if value not in known:
        raise ValueError(f"{place} must be one of {', '.join(known)}, is {value!r:.60}")


def _check_family(place: str, family: Any, max_period: float | int) -> None:
    """Refuses the record of a family that has another form, or special points beyond it."""
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
    shortest, longest, most = (
        family["shortest_period_s"],
        family["longest_period_s"],
        max_period * (1 + _LONGEST),
    )
    check_least(f"{place}.shortest_period_s", shortest, 0, strict=True)
    check_least(f"{place}.longest_period_s", longest, shortest * (1 - _SHORTEST))
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
        check_least(f"{where}.period_s", point["period_s"], shortest * (1 - _SHORTEST))
        if point["period_s"] > most:
            raise ValueError(
                f"{where}.period_s is {point['period_s']:.10g}, max_period_s is {max_period:.10g}"
            )
        last = point["arclength"]


class _Check(NamedTuple):
    """A table under examination."""

    table: Table
    place: Callable[[int], str]

    def refuse(
        self, wrong: np.ndarray, column: str, says: str, other: np.ndarray | None = None
    ) -> None:
        """Refuses the first wrong row, with what its column is and what speaks against it."""
        if not np.any(wrong):
            return
        i = int(np.argmax(wrong))
        value = self.table[column][i]
        if COLUMNS[column] is float:
            shown = f"{np.degrees(value) if UNITS.get(column) == 'deg' else value:.10g}"
        else:
            shown = repr(value.item())
        against = says if other is None else f"{says} {other[i]:.10g}"
        raise ValueError(f"{self.place(i)}: {column_name(column)} is {shown}, {against}")

    def run(self, pendulum: Pendulum, max_period: float, families: Families) -> None:
        """Refuses the first row that no orbit has: where a solve failed, numbers may be missing and
        need not agree.
        """
        table = self.table
        for column, kind in COLUMNS.items():
            if kind is float and column not in ("arclength", "log_abs_kappa"):
                self.refuse(~np.isfinite(table[column]) & self.sound, column, "and must be finite")
        zero = self.sound & (table["kappa"] == 0)
        table["log_abs_kappa"][zero] = -math.inf  # which JSON cannot say
        with np.errstate(all="ignore"):
            self.check_words(families)
            self.check_sizes(max_period)
            self.check_energies(pendulum)
            self.check_stability()
            self.check_centred()
            if families:
                self.check_families(families)
            else:
                self.check_releases()

    @property
    def sound(self) -> np.ndarray:
        """The rows that converged."""
        return np.asarray(self.table["status"] == Status.CONVERGED)

    def check_words(self, families: Families) -> None:
        """Symmetries and families are known ones, and belong together."""
        table = self.table
        self.refuse(
            ~np.isin(table["symmetry"], RELEASED_SYMMETRIES),
            "symmetry",
            "and must be centred or brake",
        )
        known = (
            f"the families are {', '.join(families)}" if families else "and there are no families"
        )
        self.refuse(~np.isin(table["family"], list(families) or [""]), "family", known)
        for name, family in families.items():
            wrong = (table["family"] == name) & (table["symmetry"] != family["symmetry"])
            self.refuse(wrong, "symmetry", f"its family {name} is {family['symmetry']}")

    def check_sizes(self, max_period: float) -> None:
        """Each number by itself."""
        table, sound = self.table, self.sound
        self.refuse(sound & ~(table["period"] > 0), "period", "and must be positive")
        most = max_period * (1 + _LONGEST)
        self.refuse(
            sound & ~(table["period"] <= most), "period", f"max_period_s is {max_period:.10g}"
        )
        for column in ("residual", "theta2_error", "period_error", "iterations"):
            self.refuse(table[column] < 0, column, "and must not be negative")
        most_left = _RESIDUAL + _GROWTH * np.sqrt(np.abs(table["kappa"]))
        wrong = sound & ~(table["residual"] <= most_left)
        self.refuse(wrong, "residual", "of a converged orbit it is at most", most_left)

    def check_energies(self, pendulum: Pendulum) -> None:
        """Both rests have the orbit's energy."""
        table = self.table
        upper = float((pendulum.m1 + pendulum.m2) * pendulum.g * pendulum.l1)
        lower = float(pendulum.m2 * pendulum.g * pendulum.l2)
        of_dual = _ENERGY_OF_DUAL + _GROWTH * np.sqrt(np.abs(table["kappa"]))
        for rest, whose, share in (("", "release", _ENERGY), ("dual_", "dual", of_dual)):
            theta1, theta2 = table[f"{rest}theta1"], table[f"{rest}theta2"]
            energy = -upper * np.cos(theta1) - lower * np.cos(theta2)
            most = (upper + lower) * (share + _DEGREES * (np.abs(theta1) + np.abs(theta2)))
            wrong = self.sound & ~(np.abs(energy - table["energy"]) <= most)
            self.refuse(wrong, "energy", f"its {whose} has", energy)

    def check_stability(self) -> None:
        """kappa and its logarithm, which is that of kappa - 1 where much has cancelled."""
        kappa, logarithm = self.table["kappa"], self.table["log_abs_kappa"]
        size = np.abs(kappa)
        near = np.minimum(
            np.abs(np.exp(logarithm) - size), np.abs(np.exp(logarithm) - np.abs(kappa - 1))
        )
        agree = (near <= _KAPPA * (1 + size)) | (
            (size > 1) & (np.abs(logarithm - np.log(size)) <= _KAPPA)
        )
        agree |= (size > _CAPPED) & (logarithm > _ITS_LOGARITHM)
        self.refuse(self.sound & ~agree, "log_abs_kappa", "kappa is", kappa)

    def check_centred(self) -> None:
        """A centred orbit is its own image, and never doubles its period; others have no turns."""
        table = self.table
        centred = self.sound & (table["symmetry"] == "centred")
        self.refuse(
            centred & ~(table["kappa"] >= -1 - _KAPPA), "kappa", "below -1 on a centred orbit"
        )
        for rod in "12":
            release, dual, turns = (
                table[f"{name}{rod}"] for name in ("theta", "dual_theta", "turns")
            )
            image = 2 * np.pi * turns - release
            wrong = centred & ~(
                np.abs(dual - image) <= _HALF_TURNS + _DEGREES * (np.abs(dual) + np.abs(release))
            )
            self.refuse(
                wrong, f"dual_theta{rod}", f"turns{rod} and its release say", np.degrees(image)
            )
            self.refuse(
                (table["symmetry"] == "brake") & (turns != 0),
                f"turns{rod}",
                "of an orbit that is not centred",
            )

    def check_releases(self) -> None:
        """Those of one angle are each there once, and have no arclength."""
        self.refuse(~np.isnan(self.table["arclength"]), "arclength", "and there are no families")
        whole = np.column_stack([self.table[key] for key in ("theta1", "theta2", "period")])
        _, first, which = np.unique(whole, axis=0, return_index=True, return_inverse=True)
        again = self.sound & (first[which.ravel()] != np.arange(len(whole)))
        self.refuse(again, "theta2", "and another row has the same orbit")

    def check_families(self, families: Families) -> None:
        """Each has its own range of periods, and neighbours."""
        table = self.table
        self.refuse(~(table["arclength"] >= 0), "arclength", "and must be a number of at least 0")
        for name, family in families.items():
            own = table["family"] == name
            shortest, longest = family["shortest_period_s"], family["longest_period_s"]
            low = own & self.sound & (table["period"] < shortest * (1 - _SHORTEST))
            self.refuse(low, "period", f"the shortest of its family is {shortest:.10g}")
            high = own & self.sound & (table["period"] > longest * (1 + _LONGEST))
            self.refuse(high, "period", f"the longest of its family is {longest:.10g}")
            self.refuse_neighbours(np.flatnonzero(own), "arclength", lambda way, step: way <= 0)
            rows = np.flatnonzero(own & self.sound)
            self.refuse_neighbours(
                rows, "log_period", lambda way, step: np.abs(way) > _LOG_PERIOD * step
            )
            for column in ("theta1", "theta2", "dual_theta1", "dual_theta2"):
                self.refuse_neighbours(rows, column, lambda way, step: np.abs(way) > _REST * step)

    def refuse_neighbours(
        self, rows: np.ndarray, column: str, leaps: Callable[..., np.ndarray]
    ) -> None:
        """Refuses a row too far from the one before, on its family."""
        values = np.log(self.table["period"]) if column == "log_period" else self.table[column]
        step = np.diff(self.table["arclength"][rows]) + _ARCLENGTH
        wrong = np.zeros(len(values), bool)
        wrong[rows[1:]] = leaps(np.diff(values[rows]), step)
        before = np.append(np.nan, values[:-1])
        before[rows[1:]] = values[rows[:-1]]
        shown = np.exp(before) if column == "log_period" else before
        shown = np.degrees(shown) if UNITS.get(column) == "deg" else shown
        column = "period" if column == "log_period" else column
        self.refuse(wrong, column, "which does not follow on", shown)
