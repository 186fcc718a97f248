"""Samples of a family with the test functions that vanish at its special points, and their
errors.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from dpend.checks import Scalar
from dpend.orbits.arc import RELEASED_SYMMETRIES
from dpend.orbits.curve import Curve
from dpend.orbits.follow import LARGEST_COVER, FamilyProblem
from dpend.orbits.newton import METRIC, Solved
from dpend.orbits.orbit import PeriodicOrbit, Slopes
from dpend.orbits.stability import LARGEST_C, OPPOSITE, growth_of, stability_of


@dataclass(frozen=True, eq=False)
class Place:
    """A point of a curve, and what it solves."""

    problem: "FamilyProblem"
    rows: Solved  # of one row


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SpecialPoint:
    """A place on a family where something changes.

    Attributes:
        kind: `stability_lost` or `stability_gained` on the way along the family; `fold_theta1`,
            `fold_energy`, where the curve turns back in it; `resonance_k:n`, where the multipliers
            are exp(+-2 pi i n/k) and orbits of k times the period branch off; `crossing`, where
            another curve runs through this one, or passes it by less than 2e-4. Of what lies within
            its error only folds and changes of stability are told, if they are not taken back
            there.
        arclength: where, in the family's.
        orbit: the orbit there.
        slopes: derivatives with respect to arclength.
        error_estimate: of arclength, and of the orbit's kappa. Rounding cannot hide on which side
            of the point a place further away lies; kappa is within its error of what the kind says.
    """

    arclength: Scalar
    orbit: PeriodicOrbit
    slopes: Slopes
    error_estimate: tuple[Scalar, Scalar]
    kind: str = field(metadata={"static": True})
    _place: Any = field(repr=False, metadata={"static": True})
    _branch: tuple[str, int] | None = field(repr=False, metadata={"static": True})


class Test(NamedTuple):
    """A function of the points that vanishes where something changes."""

    kind: str
    value: Callable[[Solved, np.ndarray], np.ndarray]
    branch: (
        tuple[str, int] | None
    )  # symmetry of the orbits that branch off, and their period in units of this one's


def test_functions(symmetry: str) -> list[Test]:
    """What is looked for; the second argument of a test is c, of other than `OPPOSITE` orbits
    kappa.
    """
    tests = [Test("fold_energy", lambda rows, c: rows.energy_slope, None)]
    if symmetry != "passing":  # these start at one theta1
        tests.insert(0, Test("fold_theta1", lambda rows, c: rows.tangent[:, 0], None))
    branches = {
        "centred": (("odd", 1), ("brake", 1)),
        "brake": (None, ("brake", 2)),
        "odd": (None, None),
        "passing": (None, ("passing", 2)),
        "none": (None, None),
    }[symmetry]
    squares = symmetry in OPPOSITE
    again = symmetry not in ("odd", "none")  # what branches off at a resonance is followed
    tests.append(Test("above", lambda rows, c: c - 1, branches[0]))
    tests.append(Test("below", lambda rows, c: c + 1, branches[1]))
    for k in range(2, LARGEST_COVER + 1):
        for n in range(1, k):
            if math.gcd(n, k) > 1 or (not squares and 2 * n > k):
                continue
            target = math.cos((1 if squares else 2) * math.pi * n / k)
            branch = "brake" if symmetry == "centred" and n % 2 == 1 else symmetry
            value = partial(lambda target, rows, c: c - target, target)
            tests.append(Test(f"resonance_{k}:{n}", value, (branch, k) if again else None))
    return tests


def measure_of(rows: Solved, symmetry: str) -> np.ndarray:
    """What the tests are told: c, or kappa of other than `OPPOSITE` orbits."""
    c, kappa, _ = stability_of(rows.matrices, symmetry)
    return np.asarray(c if symmetry in OPPOSITE else kappa)


# What rounding leaves of c and of slopes, as bounds. About 306 places of 60 families, c scattered
# by 7 (median) to 1400 times eps times its growth, and the tangent by up to 10 times the error
# estimate of the point.
_ROUNDING, _LEVERAGE, _WOBBLE = 2000 * np.finfo(float).eps, 4.0, 50.0


def measure_error(rows: Solved, symmetry: str) -> np.ndarray:
    """What c, or kappa, is known to."""
    spread = np.maximum(rows.release_change, rows.time_error)
    return np.asarray(
        growth_of(rows.matrices, symmetry) * np.maximum(_ROUNDING, _LEVERAGE * spread)
    )


def kappa_error(spot: "Spot", symmetry: str) -> float:
    """What the kappa of a special point is known to: rounding, and what its place's error makes of
    it.
    """
    error = float(measure_error(spot.row, symmetry)[0] + abs(spot.steepness) * spot.error)
    if symmetry not in OPPOSITE:
        return error
    error = min(error, LARGEST_C)
    c = min(abs(float(measure_of(spot.row, symmetry)[0])), LARGEST_C)
    return 4 * c * error + 2 * error**2 + np.finfo(float).eps * (1 + 2 * c**2)


def values_of_tests(
    tests: Sequence[Test], problem: FamilyProblem, rows: Solved
) -> tuple[np.ndarray, np.ndarray]:
    """Of each test at each point, shape (tests, points): the value, and what it is known to."""
    measure, error = measure_of(rows, problem.symmetry), measure_error(rows, problem.symmetry)
    eps = np.finfo(float).eps
    wobble = _WOBBLE * np.maximum(np.maximum(rows.release_change, rows.time_error), 10 * eps)
    errors = {"fold_theta1": wobble, "fold_energy": wobble * _steepness(problem, rows)}
    values = np.array([test.value(rows, measure) for test in tests])
    return values, np.array([errors.get(test.kind, error) for test in tests])


def _steepness(problem: FamilyProblem, rows: Solved) -> np.ndarray:
    """The size of the energy's gradient at the release, which multiplies the tangent's error; a
    bound if it moves.
    """
    if problem.symmetry in RELEASED_SYMMETRIES:
        weights = np.array([1 + problem.natural.m2, problem.natural.m2 * problem.natural.l2])
        return np.asarray(np.linalg.norm(weights * np.sin(rows.point[:, :2]), axis=1))
    if problem.symmetry == "odd":
        return np.full(len(rows.point), problem.levels[3])
    # Twice the kinetic energy, at most that above the lowest level.
    return np.asarray(2 * np.maximum(rows.energy - problem.levels[0], problem.levels[3]))


class Samples(NamedTuple):
    """Points of a curve in order of arclength."""

    where: np.ndarray
    rows: Solved


@dataclass(frozen=True, eq=False)
class Track:
    """A curve on which points are solved for at any arclength."""

    problem: FamilyProblem
    curve: Curve
    arclength: np.ndarray

    def rows_at(self, where: np.ndarray, near: Solved | None = None) -> Solved:
        """The points there: from the curve's cubics, or from points close by."""
        index = np.clip(
            np.searchsorted(self.arclength, where, side="right") - 1, 0, len(self.arclength) - 2
        )
        share = (where - self.arclength[index]) / (
            self.arclength[index + 1] - self.arclength[index]
        )
        points, steps = self.curve.between(index, share), self.curve.steps[index + 1]
        normals = METRIC * self.curve.tangents_between(index, share)
        if near is not None:  # along its tangent into the new plane
            way = np.sum(normals * (points - near.point), axis=1) / np.sum(
                normals * near.tangent, axis=1
            )
            points, steps = near.point + way[:, None] * near.tangent, near.steps
        return self.problem.correct(points, normals, steps)


class Spot(NamedTuple):
    """A special point to be: its kind, arclength, what that is known to, the row, the slope of c
    (of brake orbits kappa) with arclength, and what branches off.
    """

    kind: str
    where: float
    error: float
    row: Solved
    steepness: float
    branch: tuple[str, int] | None
