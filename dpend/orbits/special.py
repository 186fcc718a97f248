"""Special points of a family: where stability changes, where it turns back, and where others branch
off.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from dpend.orbits.curve import Curve, select
from dpend.orbits.extrema import add_extrema
from dpend.orbits.follow import FamilyProblem
from dpend.orbits.newton import Solved
from dpend.orbits.orbit import orbits_of, slopes_of
from dpend.orbits.samples import (
    Place,
    Samples,
    SpecialPoint,
    Spot,
    Test,
    Track,
    kappa_error,
    measure_error,
    measure_of,
    test_functions,
    values_of_tests,
)
from dpend.orbits.walk import CROSSING
from dpend.orbits.zones import Zone, find_zones, outside, overlaps


def special_points(
    problem: FamilyProblem, rows: Solved, curve: Curve, arclength: np.ndarray
) -> list[SpecialPoint]:
    """Every place where another curve crosses, and every place where a test changes its sign by
    more than its error.
    """
    track = Track(problem, curve, arclength)
    samples = Samples(arclength[len(arclength) - len(rows.point) :], rows)
    zones = find_zones(track, samples)
    samples = outside(zones, add_extrema(track, outside(zones, samples, with_ends=True)))
    changes = _changes(problem, samples)
    places = [
        Spot("crossing", z.place, CROSSING, z.row_at(problem, z.place), z.steepness(problem), None)
        for z in zones
    ]
    if changes:
        places += _describe(changes, _locate(track, changes, zones), places, samples.where, problem)
    return [_special(problem, spot) for spot in sorted(places, key=lambda spot: spot.where)]


class _Change(NamedTuple):
    """A stretch of a curve, at both ends of which a test's sign is certain, and not the same."""

    test: Test
    low: float
    high: float
    at_low: float
    at_high: float


def _changes(problem: FamilyProblem, samples: Samples) -> list[_Change]:
    tests = test_functions(problem.symmetry)
    changes = []
    for test, value, error in zip(
        tests, *values_of_tests(tests, problem, samples.rows), strict=True
    ):
        (certain,) = np.nonzero((np.abs(value) > error) & (samples.rows.converged > 0))
        (turns,) = np.nonzero((value[certain][:-1] < 0) != (value[certain][1:] < 0))
        for i, j in zip(certain[turns], certain[turns + 1], strict=True):
            changes.append(_Change(test, *samples.where[[i, j]].tolist(), *value[[i, j]].tolist()))
    return changes


def _locate(track: Track, changes: Sequence[_Change], zones: Sequence[Zone]) -> list[Spot]:
    """Where the tests vanish; across a zone, by the secant through values that the other curve does
    not disturb.
    """
    across = [
        next((z for z in zones if z.holds(change.low, change.high)), None) for change in changes
    ]
    solved = [i for i, zone in enumerate(across) if zone is None]
    spots: list[Spot] = []
    if solved:
        mine = [changes[i] for i in solved]
        where, rows = _roots(track, mine)
        errors, slopes = _location_errors(track, mine, where, rows)
    for i, (change, zone) in enumerate(zip(changes, across, strict=True)):
        if zone is None:
            j = solved.index(i)
            place, error, row = float(where[j]), float(errors[j]), select(rows, slice(j, j + 1))
            slope = float(slopes[j])
        else:
            width = change.high - change.low
            place = change.low + width * change.at_low / (change.at_low - change.at_high)
            inside = min(max(place, float(zone.ends[0])), float(zone.ends[1]))
            place, row = inside, zone.row_at(track.problem, inside)
            error = max(place - change.low, change.high - place)
            slope = zone.steepness(track.problem)
        spots.append(Spot(change.test.kind, place, error, row, slope, change.test.branch))
    return spots


# A root is located when the value is below this share of its error, or below its error and the step
# below the second [arclength], or when there are no numbers between.
_ENOUGH, _LOCATED = 0.1, 1e-12
_ROUNDS = 60


def _own_values(
    track: Track, changes: Sequence[_Change], rows: Solved
) -> tuple[np.ndarray, np.ndarray]:
    """Of each change its test at its own point: the value, and what it is known to."""
    values, errors = values_of_tests([change.test for change in changes], track.problem, rows)
    return np.diagonal(values).copy(), np.diagonal(errors).copy()


def _roots(track: Track, changes: Sequence[_Change]) -> tuple[np.ndarray, Solved]:
    """Where the tests vanish, and the rows there.

    Newton's method on the family's equations together with the test's: each point is corrected onto
    the curve, and the step along it is the secant's, kept inside its bracket (Illinois).
    """
    low, high, at_low, at_high = (np.array([change[k] for change in changes]) for k in (1, 2, 3, 4))
    where, value, error, last = (
        np.full(len(changes), start) for start in (np.inf, np.inf, 0.0, 0.0)
    )
    positive = at_low > 0
    going = np.arange(len(changes))
    rows: Solved | None = None
    for _ in range(_ROUNDS):
        with np.errstate(invalid="ignore", over="ignore"):
            secant = (low * at_high - high * at_low) / (at_high - at_low)
        inside = np.isfinite(secant) & (secant > low) & (secant < high)
        secant = np.where(inside, secant, 0.5 * (low + high))
        step = np.abs(secant - where)
        where[going] = secant[going]
        if rows is None:
            rows = track.rows_at(where)
        else:
            new = track.rows_at(where[going], select(rows, going))
            for column, part in zip(rows, new, strict=True):
                column[going] = part
        mine = [changes[j] for j in going.tolist()]
        value[going], error[going] = _own_values(track, mine, select(rows, going))
        before = (value > 0) == positive
        # The weight of an end that stays for a second time is halved.
        after_high = np.where(before, np.where(last < 0, 0.5 * at_high, at_high), value)
        after_low = np.where(before, value, np.where(last > 0, 0.5 * at_low, at_low))
        for old, new_value in (
            (at_high, after_high),
            (at_low, after_low),
            (low, np.where(before, where, low)),
            (high, np.where(before, high, where)),
            (last, np.where(before, -1.0, 1.0)),
        ):
            old[going] = new_value[going]
        enough = np.where(step < _LOCATED, error, _ENOUGH * error)
        going = going[((np.abs(value) > enough) & (step > 4 * np.spacing(where)))[going]]
        if not going.size:
            break
    assert rows is not None
    return where, rows


# The distance at which a sign is asked for grows by this factor until it is certain.
_WIDER = 10.0


def _location_errors(
    track: Track, changes: Sequence[_Change], where: np.ndarray, rows: Solved
) -> tuple[np.ndarray, np.ndarray]:
    """How far from a root its test's sign is certain, on both sides, by looking; and the slope of c
    between.
    """
    low, high, at_low, at_high = (np.array([change[k] for change in changes]) for k in (1, 2, 3, 4))
    _, error = _own_values(track, changes, rows)
    with np.errstate(over="ignore", invalid="ignore"):
        width = np.fmax(4 * error * (high - low) / np.abs(at_high - at_low), _LOCATED)
    slope, going = np.zeros(len(changes)), np.arange(len(changes))
    while going.size:
        mine = [changes[j] for j in going.tolist()]
        certain, seen = np.ones(going.size, bool), []
        for side, end, sign in ((-1.0, low, np.sign(at_low)), (1.0, high, np.sign(at_high))):
            spot = np.clip(where[going] + side * width[going], low[going], high[going])
            beside = track.rows_at(spot, select(rows, going))
            value, noise = _own_values(track, mine, beside)
            certain &= (spot == end[going]) | (value * sign[going] > noise)
            seen.append((spot, measure_of(beside, track.problem.symmetry)))
        (left, before), (right, after) = seen
        slope[going] = (after - before) / (right - left)
        width[going] = np.where(certain, width[going], _WIDER * width[going])
        going = going[~certain]
    return np.minimum(width, np.maximum(where - low, high - where)), slope


# c, of brake orbits kappa, is known to this where a resonance, or a window of stability between two
# points, is told.
_KNOWN = 1e-4


def _describe(
    changes: Sequence[_Change],
    spots: Sequence[Spot],
    crossings: Sequence[Spot],
    where: np.ndarray,
    problem: FamilyProblem,
) -> list[Spot]:
    """The special points: what is too near to a crossing to be told from it is not, but for a
    change that lasts.
    """
    told, bounds = [], []
    folds = [spot for spot in spots if spot.kind == "fold_energy"]
    for change, spot in zip(changes, spots, strict=True):
        if spot.kind in ("above", "below"):
            kind = (
                "stability_lost"
                if (change.at_low < 0) == (spot.kind == "above")
                else "stability_gained"
            )
            anchors = [*(folds if spot.kind == "above" else ()), *crossings]
            bounds.append(_anchor(spot, anchors, problem.symmetry)._replace(kind=kind))
        elif spot.kind.startswith("fold") or (
            _is_known(spot, problem.symmetry) and not overlaps(spot, crossings)
        ):
            told.append(spot)
    return told + _known_windows(
        sorted(bounds, key=lambda spot: spot.where), where, problem.symmetry
    )


def _is_known(spot: Spot, symmetry: str) -> bool:
    return bool(measure_error(spot.row, symmetry)[0] < _KNOWN)


def _anchor(spot: Spot, anchors: Sequence[Spot], symmetry: str) -> Spot:
    """A change of stability, at the first place within its error that is known better and where c
    is as it says.

    Where the energy turns back along a family, c - 1 vanishes, too; at a crossing often with
    several derivatives, so that c alone would not tell where.
    """
    target = 1.0 if spot.kind == "above" else -1.0
    for other in anchors:
        off, error = (
            measure_of(other.row, symmetry)[0] - target,
            measure_error(other.row, symmetry)[0],
        )
        if (
            other.error <= spot.error
            and abs(other.where - spot.where) <= spot.error
            and abs(off) <= error
        ):
            return other._replace(kind=spot.kind, branch=spot.branch)
    return spot


def _known_windows(bounds: list[Spot], where: np.ndarray, symmetry: str) -> list[Spot]:
    """Changes of stability, without those that take each other back between two points if c is not
    known there.
    """
    kept: list[Spot] = []
    for spot in bounds:
        before = kept[-1] if kept and not _is_known(spot, symmetry) else None
        if before is not None and np.searchsorted(where, before.where) == np.searchsorted(
            where, spot.where
        ):
            kept.pop()
        else:
            kept.append(spot)
    return kept


def _special(problem: FamilyProblem, spot: Spot) -> SpecialPoint:
    both = orbits_of(problem, spot.row), slopes_of(problem, spot.row)
    orbit, slopes = jax.tree.map(lambda leaf: leaf[0], both)
    errors = spot.error, kappa_error(spot, problem.symmetry)
    return SpecialPoint(
        spot.where, orbit, slopes, errors, spot.kind, Place(problem, spot.row), spot.branch
    )
