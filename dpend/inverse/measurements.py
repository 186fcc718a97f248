"""Measured angles: read from a file, refused where they cannot be what they are said to be, and
smoothed.

A series is theta1 and theta2 at increasing times; NaN where a camera lost a bob. Units are the
mistake that nothing else finds, so two questions are asked of the numbers. Do the rods turn by less
than a radian from sample to sample, as they must for anything to be seen of the motion? And do the
angles obey the lower rod's equation of motion,

    l2/l1 theta2'' + cos(delta) theta1'' - sin(delta) theta1'^2 + g/l1 sin(theta2) = 0,
                                                        delta = theta1 - theta2,

for any l2/l1 and g/l1 at all, or do they only when read in the other unit?
"""

import csv
import io
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dpend.checks import numbers
from dpend.places import file_path, read_text
from dpend.records import parse_decimal


class Angles(NamedTuple):
    """A checked series: times [s], shape (m,), and angles [rad], shape (2, m), NaN where nothing
    was measured.
    """

    times: np.ndarray
    values: np.ndarray


# A local cubic has four coefficients, and its noise is told from three samples more.
FEWEST = 7
_COLUMNS = ("theta1", "theta2")
# An angle beyond this [rad] keeps less of its turn than a camera sees.
_LARGEST = 1e6
# The median turn from sample to sample [rad]: beyond this nobody can tell which way a rod went.
_LARGEST_TURN = 1.0
# The unit may be wrong if the equation of motion is missed by more than this share of its own size,
# in squares. Swings in the right unit miss by 0.01 to 0.1 with half a degree of noise at 60 frames
# a second, and by 0.2 to 0.3 with 5 degrees or at 20 frames. Swings of 90 degrees and more miss by
# 0.5 to 1 in the wrong unit.
_DISOBEYED = 0.1
# It is wrong if another unit misses by less than this share of that. The right unit never missed by
# twice as much as a wrong one.
_BETTER = 0.4
# Half widths of local cubics, in samples; the one that predicts each sample best from the others is
# taken.
_HALF_WIDTHS = (3, 4, 5, 6, 8, 10, 13, 16, 20, 26, 33, 42, 55, 70, 90)


def check_angles(times: Any, theta1: Any, theta2: Any) -> Angles:
    """The series as arrays.

    Raises:
        ValueError: what is wrong, with the index.
    """
    when = _column("times", times, "s")
    given = [None if column is None else _column(name, column, "rad", gaps=True)
             for name, column in zip(_COLUMNS, (theta1, theta2), strict=True)]  # fmt: skip
    for name, column in zip(_COLUMNS, given, strict=True):
        if column is not None and column.size != when.size:
            raise ValueError(
                f"{name} must be as long as times, got {column.size} and {when.size}: give one for "
                f"each"
            )
    if all(column is None for column in given):
        raise ValueError(
            "theta1 or theta2 must be given, got None for both: give the angles of at least one rod"
        )
    values = np.stack(
        [np.full(when.size, np.nan) if column is None else column for column in given]
    )
    series = Angles(when, values)
    _check(
        series,
        [column is not None for column in given],
        lambda name, i: f"{name}[{i}]",
        "in radians",
    )
    return series


def _column(name: str, column: Any, unit: str, gaps: bool = False) -> np.ndarray:
    array = numbers(name, column, unit=unit, gaps=gaps)
    if array.ndim != 1:
        raise ValueError(
            f"{name} must have one dimension, got shape {array.shape}: give one number for each "
            f"time"
        )
    wrong = np.isinf(array) if gaps else ~np.isfinite(array)
    if np.any(wrong):
        i = int(np.argmax(wrong))
        fix = "give NaN where nothing was measured" if gaps else "leave the sample out"
        raise ValueError(f"{name}[{i}] must be finite [{unit}], got {array[i]}: {fix}")
    return array


def load_angles(path: str | Path | Any) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
    """Times [s] and both angles [rad] of a CSV file with columns time_s, theta1_deg, theta2_deg, in
    any order.

    One of the angles may be absent (None is returned for it), and cells of both may be empty (NaN).
    Other columns are not looked at, so that what `dpend simulate --out F.csv` writes is read as
    well.

    Raises:
        ValueError: a file that cannot be read, a missing or repeated column, a cell that is no
            finite number, times that do not increase, fewer than 7 angles of a rod, angles that
            look like radians; with the row, counted from the header, which is row 1.
    """
    path = file_path("path", path)
    rows, lines = _rows(path)
    header = [name.strip() for name in rows[0]]
    present = _check_header(header, path)
    for row, line in zip(rows, lines, strict=True):
        if len(row) != len(header):
            raise ValueError(
                f"row {line} of {path} must have {len(header)} cells, got {len(row)}: mend the row"
            )

    def column(name: str, gaps: bool) -> np.ndarray:
        place, body = header.index(name), zip(rows[1:], lines[1:], strict=True)
        return np.array([_cell(row[place], name, line, path, gaps) for row, line in body])

    when = column("time_s", False)
    values = np.full((2, when.size), np.nan)
    for i, name in enumerate(_COLUMNS):
        if name in present:
            values[i] = np.radians(column(f"{name}_deg", True))
    there = [name in present for name in _COLUMNS]

    def where(name: str, i: int) -> str:
        return f"{'time_s' if name == 'times' else f'{name}_deg'} in row {lines[i + 1]} of {path}"

    _check(Angles(when, values), there, where, "in degrees")
    theta1, theta2 = (each if given else None for each, given in zip(values, there, strict=True))
    return when, theta1, theta2


def _check_header(header: list[str], path: Path) -> list[str]:
    """Which of the angles a file has; refuses one without times or angles, and repeated columns."""
    present = [name for name in _COLUMNS if f"{name}_deg" in header]
    missing = "time_s" if "time_s" not in header else "" if present else "theta1_deg or theta2_deg"
    if missing:
        raise ValueError(
            f"{path} must have a column {missing}, got {', '.join(header)}: rename or convert a "
            f"column"
        )
    for name in ("time_s", *(f"{name}_deg" for name in present)):
        if header.count(name) > 1:
            raise ValueError(
                f"{path} must have one column {name}, got {header.count(name)}: keep one of them"
            )
    return present


def _rows(path: Path) -> tuple[list[list[str]], list[int]]:
    """The rows of a CSV file that are not blank, and their numbers."""
    try:
        reader = csv.reader(io.StringIO(read_text(path), newline=""), strict=True)
        found = [(row, reader.line_num) for row in reader if any(cell.strip() for cell in row)]
    except (OSError, ValueError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ValueError(
            f"data must be a CSV file that can be read, got {path} ({reason}): give another file"
        ) from None
    if not found:
        raise ValueError(
            f"{path} must have a header and rows, got an empty file: give another file"
        )
    rows, lines = zip(*found, strict=True)
    return list(rows), list(lines)


def _cell(text: str, name: str, line: int, path: Path, gaps: bool) -> float:
    text = text.strip()
    if gaps and not text:
        return math.nan
    try:
        value = parse_decimal(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        fix = "leave the cell empty where nothing was measured" if gaps else "take the row out"
        raise ValueError(
            f"{name} in row {line} of {path} must be a finite number, got {text!r}: {fix}"
        )
    return value


def _check(series: Angles, there: list[bool], where: Callable[[str, int], str], unit: str) -> None:
    times, values = series
    if times.size < FEWEST:
        raise ValueError(f"times must be at least {FEWEST}, got {times.size}: give more samples")
    steps = np.diff(times)
    if np.any(steps <= 0):
        i = int(np.argmax(steps <= 0)) + 1
        raise ValueError(f"{where('times', i)} must be later than the one before it, "
                         f"{times[i - 1]:g} s, got "
                         f"{times[i]:g} s: sort the samples and drop repeated ones")  # fmt: skip
    for name, column, given in zip(_COLUMNS, values, there, strict=True):
        count = int(np.sum(np.isfinite(column)))
        if given and count < FEWEST:
            raise ValueError(
                f"{name} must be measured at least {FEWEST} times, got {count}: leave it out"
            )
        far = np.abs(column) > _LARGEST
        if np.any(far):
            i = int(np.argmax(far))
            raise ValueError(f"{where(name, i)} must be within {_LARGEST:g} rad of zero, got "
                             f"{column[i]:g} rad: "
                             "take off full turns, or the sample out")  # fmt: skip
        turns = np.abs(wrap(np.diff(column[np.isfinite(column)])))
        if given and np.median(turns) > _LARGEST_TURN:
            i = int(np.flatnonzero(np.isfinite(column))[1 + int(np.argmax(turns > _LARGEST_TURN))])
            raise ValueError(
                f"{where(name, i)} must be {unit} and sampled often enough to be followed, got "
                f"steps of "
                f"{np.median(turns):.2g} rad from sample to sample (median): check the unit and "
                f"the sampling rate"
            )
    if not np.any(np.isfinite(values[:, 0])):
        raise ValueError(
            f"{where('theta1', 0)} and {where('theta2', 0)} are both missing: begin where one is "
            f"measured"
        )
    if all(there):
        _check_unit(series, where, unit)


def _check_unit(series: Angles, where: Callable[[str, int], str], unit: str) -> None:
    missed = _disobedience(series, 1.0)
    if not missed > _DISOBEYED:
        return
    for factor, other in ((math.pi / 180, "in degrees"), (180 / math.pi, "in radians")):
        if _disobedience(series, factor) < _BETTER * missed:
            got = f"{other}, converted twice" if other == unit else other
            raise ValueError(
                f"{where('theta1', 0)} and what follows must be {unit}, got angles that obey the "
                f"equations of a double "
                f"pendulum only if they are {got}: convert them"
            )


def _disobedience(series: Angles, factor: float) -> float:
    """What share of itself the lower rod's equation is missed by, in squares, by the angles times
    `factor`.
    """
    times, values = series
    both = np.all(np.isfinite(values), axis=0)
    if np.sum(both) < 2 * FEWEST:
        return 0.0
    times, values = times[both], np.unwrap(factor * values[:, both])
    one, two = (
        local_cubics(times, column, times, best_width(times, column)[0]) for column in values
    )
    delta = one.value - two.value
    rest = np.cos(delta) * one.bend - np.sin(delta) * one.slope**2
    columns = np.stack([two.bend, np.sin(two.value)], axis=1)
    if not np.all(np.isfinite(np.append(columns, rest[:, None], axis=1))):
        # samples so near to each other that second derivatives overflow tell nothing of the unit
        return 0.0
    left = rest + columns @ np.linalg.lstsq(columns, -rest)[0]
    return float(np.sum(left**2) / max(np.sum(rest**2), 1e-300))


def wrap(angle: Any) -> Any:
    """The angle modulo full turns, in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


class Smooth(NamedTuple):
    """Local cubics at given times."""

    value: np.ndarray
    slope: np.ndarray
    bend: np.ndarray  # second derivative
    rows: np.ndarray  # (at, samples), the weights of the samples in the value
    samples: np.ndarray  # (at, samples), which these are
    nearest: np.ndarray  # how far the nearest is [s]


def local_cubics(times: np.ndarray, values: np.ndarray, at: np.ndarray, half: int) -> Smooth:
    """Cubics through the 2 half + 1 samples about each of the times `at`, by least squares, near
    ones weighing more.
    """
    count = min(2 * half + 1, times.size)
    first = np.clip(np.searchsorted(times, at) - count // 2, 0, times.size - count)
    index = first[:, None] + np.arange(count)
    offset = times[index] - at[:, None]
    reach = 1.02 * np.max(np.abs(offset), axis=1)  # the farthest keeps a little weight
    scaled = offset / reach[:, None]
    weight = (1 - np.abs(scaled) ** 3) ** 3
    powers = scaled[..., None] ** np.arange(4)
    weighted = np.swapaxes(weight[..., None] * powers, 1, 2)
    try:
        rows = np.linalg.solve(weighted @ powers, weighted)
    except np.linalg.LinAlgError:
        raise ValueError(
            f"times must be spaced evenly enough for cubics through {count} neighbours, got gaps "
            f"from {np.min(np.diff(times)):.3g} s to {np.max(np.diff(times)):.3g} s: drop samples "
            f"too near to others"
        ) from None
    c = (rows @ values[index][..., None])[..., 0]
    nearest = np.min(np.abs(offset), axis=1)
    return Smooth(c[:, 0], c[:, 1] / reach, 2 * c[:, 2] / reach**2, rows[:, 0], index, nearest)


def best_width(times: np.ndarray, values: np.ndarray) -> tuple[int, float]:
    """The half width at which leaving out a sample predicts it best, and the noise that the cubics
    leave [rad].

    The noise is 0 where the cubics pass through all samples.
    """
    best = (math.inf, _HALF_WIDTHS[0], math.nan)
    for half in _HALF_WIDTHS:
        if half > _HALF_WIDTHS[0] and 2 * half + 1 > times.size:
            break
        smooth = local_cubics(times, values, times, half)
        own = np.sum(
            np.where(smooth.samples == np.arange(times.size)[:, None], smooth.rows, 0.0), axis=1
        )
        left = values - smooth.value
        missed = float(np.mean((left / np.maximum(1 - own, 1e-3)) ** 2))
        freedom = float(np.sum(1 - 2 * own + np.sum(smooth.rows**2, axis=1)))
        noise = math.sqrt(float(np.sum(left**2)) / freedom) if freedom > 0 else 0.0
        best = min(best, (missed, half, noise))
        if missed > 2 * best[0]:
            break  # wider ones cut off more and more of the motion
    return best[1], best[2]
