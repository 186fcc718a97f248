"""Continuation: the family of an equilibrium, of an orbit, or of the branch at a special point.

`follow_family` walks along the curve by pseudo-arclength, its orbits cut into segments (see `arc`),
and finds where its stability changes, where it turns back and where others branch off; given such a
place, it follows the branch.
"""

import math
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from dpend._runtime import require_float64
from dpend.checks import integer, known_number, known_real, known_value
from dpend.mechanics.pendulum import Pendulum
from dpend.mechanics.units import natural
from dpend.orbits.arc import PARTS
from dpend.orbits.branching import branches_at
from dpend.orbits.curve import (
    Curve,
    concatenate,
    curve_of,
    drop_mirror_half,
    half_of_closed,
    release_columns,
    reversed_,
    way_to,
)
from dpend.orbits.family import Family, family_of
from dpend.orbits.find import swinging_numbers
from dpend.orbits.follow import FamilyProblem, Reach, guess_arc, start_at
from dpend.orbits.newton import METRIC, Solved
from dpend.orbits.orbit import BRANCHES, FAMILIES, PeriodicOrbit
from dpend.orbits.samples import SpecialPoint
from dpend.orbits.walk import FIRST_STEP, LONGEST_STEP, start_at_mode, start_at_saddle
from dpend.status import Status

_MOST_POINTS = 5000
# How far the corrected start may be from the orbit that was given [rad].
_SAME_ORBIT = 1e-5
# At a fold in energy stability changes, too, and no other family is there: slopes below this are
# zero.
_FLAT = 1e-5


def follow_family(
    pendulum: Pendulum | Any,
    start: "str | PeriodicOrbit | SpecialPoint | Any",
    *,
    longest_step: float | Any = LONGEST_STEP,
    longest_period: float | Any = math.inf,
    most_points: int | Any = _MOST_POINTS,
) -> Family:
    """The family of periodic orbits that `start` belongs to, from end to end.

    Pseudo-arclength continuation of orbits by multiple shooting, folds passed: a step is taken back
    if Newton's method contracts slowly, the tangent turns by more than 18 degrees, or the bordered
    Jacobian's determinant changes sign, which would be a jump to another curve. The family ends
    where the energy comes within 1e-8 of that of an equilibrium with a rod upright (in units of the
    weights' torques; the period then grows like its logarithm), where it is back at its beginning,
    at an equilibrium, or where a hundred times these torques let the rods turn over freely.

    Arguments:
        pendulum: the derivatives of its leaves, if they carry any, reach what `Family.at` returns;
            `jit` around this does not work.
        start: `in-phase` or `anti-phase`, the family of a normal mode; `down-up` or `up-down`, that
            of the saddle (0, pi) or (pi, 0), whose orbits swing about it and are unstable (the
            Lyapunov orbits); or an orbit, from which its family is followed in both directions; or
            a special point, for the branch that leaves there: at a loss or gain of stability of
            centred orbits with c = 1 the orbits with x(T/2) = -x(0) that are no longer released
            from rest, with c = -1 either those released from rest that are no longer centred or
            those through the same place of {0, pi}^2 that never rest, at a resonance the brake (of
            passing orbits the passing) orbits of k times the period.
        longest_step: in arclength; the default gives about a hundred points.
        longest_period: [s]; the family is followed to its first orbit of this period.
        most_points: on one side of the start.
    Raises:
        ValueError: an unknown name; g not positive; an orbit of another pendulum, or that has not
            converged; a special point where nothing branches off; longest_period below the period
            of the first orbit.
        RuntimeError: float64 is switched off in JAX.
    See also:
        Doedel, Keller and Kernevez, Numerical analysis and control of bifurcation problems (1991);
        Peeters et al., Nonlinear normal modes II, Mechanical Systems and Signal Processing 23
        (2009).
    """
    require_float64()
    fixed = swinging_numbers(pendulum)
    if not isinstance(start, (str, PeriodicOrbit, SpecialPoint)):
        raise ValueError(
            f"start must be one of {', '.join(FAMILIES)}, an orbit or a special point, got "
            f"{type(start).__name__}: "
            "give one of them"
        )
    step, most_points = (
        known_number("longest_step", longest_step, positive=True),
        integer("most_points", most_points, least=2),
    )
    period = known_real("longest_period", longest_period, unit="s")
    if period != math.inf:
        known_number("longest_period", period, positive=True, unit="s")
    scaled = jax.tree.map(np.float64, natural(fixed))
    reach = Reach(step, most_points, period / math.sqrt(fixed.l1 / fixed.g))
    if isinstance(start, str):
        if start not in FAMILIES:
            raise ValueError(
                f"start must be one of {', '.join(FAMILIES)}, or an orbit, got {start!r}: give one"
            )
        centre = _CENTRES.get(start, (0.0, 0.0))
        return _from_mode(FamilyProblem(pendulum, scaled, "centred", centre), start, reach)
    if isinstance(start, SpecialPoint):
        return _from_branch_point(pendulum, start, reach)
    return _from_orbit(pendulum, scaled, start, reach)


_at_mode, _at_saddle = jax.jit(start_at_mode), jax.jit(start_at_saddle)
# Where the motions of the saddles' families pass, in units of pi.
_CENTRES = {"down-up": (0.0, 1.0), "up-down": (1.0, 0.0)}


def _from_mode(problem: FamilyProblem, branch: str, reach: Reach) -> Family:
    if branch in BRANCHES:
        begin = _at_mode(problem.natural, branch == "in-phase")
    else:
        begin = _at_saddle(problem.natural, branch == "up-down")
    start = jax.tree.map(np.asarray, begin)
    rows, end = problem.follow_curve(start, None, reach)
    if not len(rows.point):
        raise _too_short(reach)
    curve = curve_of(rows)
    points, tangents = (
        np.vstack([start.point, curve.points]),
        np.vstack([start.tangent, curve.tangents]),
    )
    curve = Curve(points, tangents, np.append(start.steps, curve.steps))
    return family_of(problem, rows, curve, ("normal mode", end))


def _too_short(reach: Reach) -> ValueError:
    return ValueError(
        f"longest_period must be longer than the period of the first orbit, got {reach.period:g} "
        f"sqrt(l1/g): give a "
        "longer one"
    )


def _from_orbit(pendulum: Pendulum, scaled: Pendulum, orbit: PeriodicOrbit, reach: Reach) -> Family:
    fixed = swinging_numbers(pendulum)
    orbit = _known_orbit(fixed, orbit)
    second = math.sqrt(fixed.l1 / fixed.g)
    momentum = fixed.m1 * fixed.l1**2 / second
    state, dual = (
        np.array([x.theta1, x.theta2, x.p1 / momentum, x.p2 / momentum], np.float64)
        for x in (orbit.state, orbit.dual)
    )
    own = np.array(orbit.turns, np.float64)
    turns = {
        "centred": own,
        "odd": np.round((state + dual)[:2] / (2 * np.pi)),
        "passing": np.round(dual[:2] / np.pi),
        "none": own,
    }
    symmetry = orbit.symmetry
    full = turns.get(symmetry, np.zeros(2))
    problem = FamilyProblem(pendulum, scaled, symmetry, (float(full[0]), float(full[1])))
    if orbit.period / second > reach.period * (1 + 1e-12):
        raise _too_short(reach)
    duration = float(orbit.period) / second / PARTS[symmetry]
    point = guess_arc(problem, np.zeros(1), state[None], duration)
    rows = problem.on_curve(point)
    first = release_columns(symmetry)
    if rows is None or np.linalg.norm(way_to(rows.point[0, first], state[first])) > _SAME_ORBIT:
        raise ValueError(
            "start must be an orbit whose motion is still known at the end of its arc: give "
            "another one"
        )
    return _both_ways(problem, rows, reach)


def _known_orbit(pendulum: Pendulum, orbit: PeriodicOrbit) -> PeriodicOrbit:
    """An orbit as numbers, if it is one of this pendulum from which a family can start."""
    if np.shape(orbit.period):
        raise ValueError(
            f"start must be a single orbit, got one with shape {np.shape(orbit.period)}: choose "
            f"one of them"
        )
    status = known_value(orbit.status)
    if status is None:
        raise ValueError("start must be known, not traced by jit: find it outside")
    if status != Status.CONVERGED:
        raise ValueError(
            f"start must have converged, got status {Status(int(status)).name.lower()}"
        )
    orbit = jax.tree.map(known_value, orbit)
    mine = jax.tree.leaves(orbit.pendulum)
    if not np.allclose(mine, jax.tree.leaves(pendulum), rtol=1e-12):
        raise ValueError(f"start must be an orbit of this pendulum, got one of {orbit.pendulum}")
    return orbit


def _both_ways(problem: FamilyProblem, rows: Solved, reach: Reach) -> Family:
    """The family through a point, in both directions unless it is closed."""
    first = min(FIRST_STEP, reach.step)
    start = start_at(rows.point[0], rows.tangent[0], first, rows.steps[0])
    ahead, end = problem.follow_curve(start, rows, reach)
    if end == "closed":
        return _closed(problem, rows, ahead)
    behind, begin = problem.follow_curve(start._replace(tangent=-start.tangent), rows, reach)
    whole, ends, here = concatenate(reversed_(behind), rows, ahead), (begin, end), len(behind.point)
    if problem.symmetry in ("brake", "passing"):
        whole, ends = drop_mirror_half(whole, ends, here, problem.symmetry)
    return family_of(problem, whole, curve_of(whole), ends)


def _closed(problem: FamilyProblem, start: Solved, ahead: Solved) -> Family:
    """A curve that comes back to its beginning: to the same rest, which is then its last point too,
    or to the other.
    """
    rows, ends, symmetry = concatenate(start, ahead), ("closed", "closed"), problem.symmetry
    half = half_of_closed(rows, symmetry) if symmetry in ("brake", "passing") else None
    if half is not None:
        rows, ends = half, ("branch point", "branch point")
    elif (
        np.sqrt(np.sum(METRIC * (ahead.point[-1] - start.point[0]) ** 2))
        < 2 * curve_of(rows).lengths[-1]
    ):
        rows = concatenate(rows, start)
    return family_of(problem, rows, curve_of(rows), ends)


def _from_branch_point(pendulum: Pendulum, special: SpecialPoint, reach: Reach) -> Family:
    base, (symmetry, k) = special._place, _branch_at(special)
    sides: list[tuple[Solved, str]] = []
    for problem, point, moving in branches_at(base, symmetry, k):
        problem = replace(problem, pendulum=pendulum)
        if problem.onto_branch(moving, point, 1.0) is not None:
            break
    else:
        raise _no_branch(special)
    for sign in (1.0, -1.0):
        rows = problem.onto_branch(moving, point, sign)
        if rows is None:
            raise _no_branch(special)
        if problem.period(rows)[0] > reach.period:
            raise _too_short(reach)
        start = start_at(rows.point[0], rows.tangent[0], min(FIRST_STEP, reach.step), rows.steps[0])
        ahead, end = problem.follow_curve(start, rows, reach)
        if end == "closed":
            return _closed(problem, rows, ahead)
        sides.append((concatenate(rows, ahead), end))
        if problem.symmetry != base.problem.symmetry or k % 2 == 0:
            break  # the other side holds the same orbits, half a period later or in the mirror
    (one, end), other = sides[0], sides[1:]
    if other:
        rows = concatenate(reversed_(other[0][0]), one)
        return family_of(problem, rows, curve_of(rows), (other[0][1], end))
    return family_of(problem, one, curve_of(one), ("branch point", end))


def _branch_at(special: SpecialPoint) -> tuple[str, int]:
    """The symmetry of the branch that leaves at a special point, and how many of the periods there
    are one of the branch's.
    """
    if special._branch is None:
        raise ValueError(
            f"start must be a point where a family branches off, got {special.kind}: follow its "
            f"orbit"
        )
    flat = abs(float(special._place.rows.energy_slope[0])) < _FLAT
    if special.kind.startswith("stability") and flat:
        raise ValueError(
            f"start must be a point where a family branches off, got {special.kind} at a fold in "
            f"energy"
        )
    return special._branch


def _no_branch(special: SpecialPoint) -> ValueError:
    return ValueError(
        f"start must be a point where a family that can be followed branches off, got "
        f"{special.kind} without one nearby"
    )
