"""What results look like outside Python: units on their fields, records for JSON, columns for CSV
and xarray.

Degrees in files and on the command line, radians in Python and in xarray; the unit of a field says
which name and which number that makes.
"""

import dataclasses
import functools
import json
import math
import re
from typing import Any, TypeAlias

import numpy as np

from dpend.status import Status, message

# How a unit ends a name in files, where angles are in degrees.
_SUFFIXES = {
    "": "",
    "rad": "_deg",
    "rad/s": "_deg_s",
    "m": "_m",
    "kg": "_kg",
    "m/s^2": "_m_s2",
    "1/s^2": "_s-2",
    "kg m^2/s": "_kg_m2_s",
    "s": "_s",
    "J": "_J",
}

# Rows of a table in a notebook.
_SHOWN_ROWS = 10
# How files tell what the numbers of a status mean (the CF conventions, section 3.5): numbers up to
# 255, in a type that NetCDF 3 has, too.
_FLAGS = {
    "flag_values": np.array(list(Status), np.int16),
    "flag_meanings": " ".join(one.name.lower() for one in Status),
}


def units_of(kind: type) -> dict[str, Any]:
    """The fields of a data class with their units, as `period: Annotated[Scalar, "s"]` has them.

    A number without one has an empty unit; a tuple or a dictionary those of its parts by name.
    """
    return _units_of(kind)


@functools.cache
def _units_of(kind: type) -> dict[str, Any]:
    fields = dataclasses.fields(kind)
    return {field.name: getattr(field.type, "__metadata__", ("",))[0] for field in fields}


def file_name(name: str, unit: str) -> str:
    """A quantity's name in files: `theta1` in radians is `theta1_deg`."""
    return name + _SUFFIXES[unit]


def file_value(value: Any, unit: str) -> Any:
    """A number, or an array as a list, as files have it: angles in degrees."""
    return (np.degrees(value) if unit.startswith("rad") else np.asarray(value)).tolist()


def record(result: Any, names: str = "") -> dict[str, Any]:
    """What JSON says of a result: some fields and properties of it, or all fields.

    A number bears the name and the unit that files give it, the status is told by its name, and a
    part that is a result itself becomes a record.
    """
    units = units_of(type(result))
    found: dict[str, Any] = {}
    for name in names.split() or units:
        if name == "message":
            found[name] = getattr(result, name, None) or message(result.status)
            continue
        value, of = getattr(result, name), units.get(name, "")
        if name == "status":
            found[name] = Status(int(value)).name.lower()
        elif isinstance(of, dict):
            parts = value if isinstance(value, dict) else dict(zip(of, value, strict=True))
            found[name] = {file_name(k, of[k]): file_value(v, of[k]) for k, v in parts.items()}
        elif dataclasses.is_dataclass(value):
            found[name] = record(value)
        elif isinstance(value, tuple):
            found[name] = [file_value(one, of) for one in value]
        else:
            found[file_name(name, of)] = file_value(value, of)
    return found


def columns(result: Any, names: str = "") -> dict[str, list[Any]]:
    """The table of a result whose fields are arrays, by the names that files have; a field of
    several parts, as an error, is a column for each.
    """
    found: dict[str, list[Any]] = {}
    for name, column in record(result, names).items():
        kind = name.removesuffix("_estimate")
        if isinstance(column, dict):
            stems = {key: key.rpartition("_") for key in column}
            found |= {f"{a}_{kind}_{b}": column[key] for key, (a, _, b) in stems.items()}
        else:
            found[name] = column
    return found


# Values in SI by name, each with its unit.
Quantities: TypeAlias = dict[str, tuple[np.ndarray, str]]


def quantities(result: Any, names: str = "") -> Quantities:
    """Some fields and properties of a result as arrays, or all fields, each with its unit."""
    units = units_of(type(result))
    return {
        name: (np.asarray(getattr(result, name)), units.get(name, ""))
        for name in names.split() or units
    }


def frame(table: Quantities) -> Any:
    """Quantities of one shape (n,) as a `pandas.DataFrame` with the names and the units of files:
    angles in degrees, the status by its name.
    """
    import pandas

    columns = {file_name(name, unit): file_value(of, unit) for name, (of, unit) in table.items()}
    if "status" in columns:
        columns["status"] = [Status(int(one)).name.lower() for one in columns["status"]]
    return pandas.DataFrame(columns)


def variables(
    table: Quantities, dim: str | tuple[str, ...]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Quantities as xarray takes them, in SI over `dim`, and angles in degrees as coordinates
    beside.
    """
    data: dict[str, Any] = {}
    for name, (value, unit) in table.items():
        data[name] = (dim, value, {"units": unit} if unit else {})
        if name == "status":
            data[name] = (dim, value.astype(np.int16), _FLAGS)
    degrees = {
        f"{name}_deg": (dim, np.degrees(value), {"units": "degree"})
        for name, (value, unit) in table.items()
        if unit == "rad" and not name.endswith(("error", "noise"))
    }
    return data, degrees


def span(name: str, value: Any, unit: str = "") -> str:
    """A number as a `repr` shows it, of many the least and the greatest; of what is traced, or
    stands for a number, only its name.
    """
    try:
        known = np.asarray(value, float)
    except (TypeError, ValueError):
        return name
    known = known[np.isfinite(known)] if known.ndim else known
    if not known.size:
        return f"{name} unknown"
    ends = [f"{known.min():.6g}", f"{known.max():.6g}"]
    text = ends[0] if ends[0] == ends[1] else " to ".join(ends)
    return f"{name} {text} {unit}".rstrip()


def outcome(status: Any) -> str:
    """A status as a `repr` shows it, of many how often each."""
    try:
        values, counts = np.unique(np.asarray(status, int), return_counts=True)
        names = [Status(value).name.lower() for value in values.tolist()]
    except (TypeError, ValueError):
        return "status"
    if np.ndim(status) == 0:
        return names[0]
    return ", ".join(f"{count} {name}" for count, name in zip(counts, names, strict=True))


def html(result: Any) -> str:
    """A result as a notebook shows it: its `repr`, and the first and last rows of its table; of
    what is traced the former alone.
    """
    from html import escape

    told = f"<p><code>{escape(repr(result))}</code></p>"
    try:
        return told + str(result.to_dataframe().to_html(max_rows=_SHOWN_ROWS, border=0))
    except TypeError:  # of JAX, where a number is none yet
        return told


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
