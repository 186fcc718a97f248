"""Families of periodic orbits: curves of releases, from small swings to the motions that take for
ever.

`follow_family` walks along one by pseudo-arclength, its orbits cut into segments (see `arc`), and
finds where its stability changes, where it turns back and where others branch off; given such a
place, it follows the branch.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from dpend._runtime import require_float64
from dpend.checks import (
    Scalar,
    integer,
    known_number,
    known_real,
    known_value,
    numbers,
    real,
    single,
)
from dpend.mechanics.pendulum import Pendulum, check_pendulum
from dpend.mechanics.units import natural
from dpend.orbits.arc import PARTS
from dpend.orbits.curve import (
    Curve,
    concatenate,
    curve_of,
    drop_mirror_half,
    half_of_closed,
    reversed_,
    way_to,
)
from dpend.orbits.find import swinging_pendulum
from dpend.orbits.follow import FamilyProblem, Reach, guess_arc, repeated, start_at
from dpend.orbits.newton import METRIC, Solved
from dpend.orbits.orbit import BRANCHES, PeriodicOrbit, Slopes, mirrored, orbits_of, slopes_of
from dpend.orbits.samples import SpecialPoint
from dpend.orbits.special import special_points
from dpend.orbits.walk import FIRST_STEP, STRAYED, start_at_mode
from dpend.status import Status, message

# The longest step: a hundred points or so for a family, close enough for cubics to show every turn.
_LONGEST_STEP = 0.1
_MOST_POINTS = 5000


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Family:
    """A curve of periodic orbits.

    Attributes:
        orbits: one `PeriodicOrbit` with a leading axis, in order of arclength; all of one symmetry.
        arclength: from the family's beginning, shape (n,). ds^2 is the mean of dtheta1^2 +
            dtheta2^2 over the nodes that cut the arc into segments, plus the square of d log Delta,
            Delta being the fastest motion's share in a segment: nearly d log(period).
        slopes: derivatives with respect to arclength, shape (n,).
        special_points: in order of arclength. Resonances where rounding leaves c (of brake orbits
            kappa) unknown to 1e-4 are left out, and stable windows between two orbits with them:
            some 1e-8 wide, between orbits whose kappa is 1e10.
        status: `Status.CONVERGED` if the family was followed to its ends, `LEFT_BRANCH` if at one
            no step was short enough, `MAX_ITERATIONS` if it has more points than were allowed.
        ends: what its beginning and its end are: `normal mode` (of an equilibrium), `homoclinic`
            (the period grows without bound as the energy tends to that of an equilibrium with a rod
            upright), `closed` (it comes back to its beginning), `branch point`, `longest period`
            (if one was given), `lost` or `unfinished` (see status).
    """

    orbits: PeriodicOrbit
    arclength: Scalar
    slopes: Slopes
    special_points: tuple[SpecialPoint, ...]
    status: Scalar
    ends: tuple[str, str] = field(metadata={"static": True})
    _curve: "Curve" = field(repr=False, metadata={"static": True})
    _problem: "FamilyProblem" = field(repr=False)

    @property
    def symmetry(self) -> str:
        """The symmetry of all its orbits."""
        return self.orbits.symmetry

    @property
    def message(self) -> str:
        """The sentence that says what its status means."""
        return message(self.status)

    def at(self, theta1: Scalar, *, crossing: int | Any = 1) -> PeriodicOrbit:
        """The orbits of this family released at `theta1`: Newton's method from where its curve
        passes.

        An orbit released at (-theta1, -theta2) counts; where the curve has it, the mirror image is
        returned. Derivatives with respect to `theta1`, and to the pendulum that `follow_family` was
        given, are those of the root (implicit function theorem): one linear solve and no walk.
        Second ones are forward derivatives of these, as `jax.hessian` takes them. The walk needs
        numbers, so that `jax.grad`, `jax.jacfwd` and their like work, and `jax.jit` around it does
        not.

        Arguments:
            theta1: release angles of the upper rod [rad], any shape.
            crossing: which of the curve's passages through `theta1`, in order of arclength.
        Returns:
            PeriodicOrbit with leaves of theta1's shape. Where the family does not get there, the
            status is `NO_SUCH_ORBIT` and the rest NaN.
        Raises:
            ValueError: theta1 not finite, below 1e-10 or traced by `jit`; a derivative asked for at
                a fold in theta1, where it is infinite: `slopes` has those with respect to
                arclength.
        """
        return _at(self, theta1, crossing)


# The derivative with respect to theta1 is refused where less than this share of a step along the
# curve goes into it, which is nearer to the fold than its square.
_AT_FOLD = 1e-5
# Below this angle [rad] rounding is what is left of an amplitude.
_TINIEST = 1e-10
# Each interval is looked at in this many pieces for passages through an angle.
_PIECES = 8


def _at(family: Family, theta1: Scalar, crossing: int | Any) -> PeriodicOrbit:
    """See `Family.at`."""
    crossing = integer("crossing", crossing)
    theta1 = (
        real("theta1", theta1)
        if isinstance(theta1, jax.Array)
        else numbers("theta1", theta1, unit="rad")
    )
    theta1 = jnp.asarray(theta1, jnp.float64)
    try:
        wanted = np.asarray(lax.stop_gradient(theta1))
    except jax.errors.TracerArrayConversionError:
        raise ValueError(
            "theta1 must be a number here, not traced by jit: use find_orbit inside jit"
        ) from None
    if not wanted.size or not np.all(np.isfinite(wanted)) or np.any(np.abs(wanted) < _TINIEST):
        raise ValueError(
            f"theta1 must be finite and at least {_TINIEST:g} in size [rad], got {wanted}: give "
            f"other angles"
        )
    problem, curve = family._problem, family._curve
    targets = np.abs(wanted.ravel())
    index, share = _passages(curve, targets, crossing)
    found = index >= 0
    points = curve.between(np.maximum(index, 0), share)
    side = np.where((points[:, 0] < 0) != (wanted.ravel() < 0), -1.0, 1.0)  # of the mirror image
    points[:, 0] = np.where(points[:, 0] < 0, -targets, targets)
    rows = np.zeros_like(points)
    rows[:, 0] = 1.0
    solved = problem.correct(points, rows, curve.steps[np.maximum(index, 0) + 1])
    away = np.sqrt(np.sum(METRIC * (solved.point - points) ** 2, axis=1))
    strayed = away > np.maximum(STRAYED * curve.lengths[np.maximum(index, 0)], 1e-9)
    traced = any(
        isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((theta1, problem.pendulum))
    )
    folds = np.array(
        [abs(float(p.orbit.theta1)) for p in family.special_points if p.kind == "fold_theta1"]
    )
    near = np.any(np.abs(targets[:, None] - folds) < _AT_FOLD**2, axis=1)
    folded = near | (found & (np.abs(solved.tangent[:, 0]) < _AT_FOLD))
    if traced and np.any(folded):
        angle = wanted.ravel()[np.argmax(folded)]
        raise ValueError(
            f"theta1 must not be a fold of the family for a derivative, got {angle}: it is "
            f"infinite there; the "
            "family's slopes are derivatives with respect to arclength"
        )
    along = jnp.ravel(theta1) * side if traced else None
    orbits = orbits_of(problem, solved, along, rows)
    status = np.where(
        strayed & (orbits.status == Status.CONVERGED), Status.LEFT_BRANCH, orbits.status
    )
    status = np.where(found, status, Status.NO_SUCH_ORBIT)
    orbits = replace(mirrored(orbits, side), status=status)

    def shaped(leaf: Any) -> Any:
        xp = np if isinstance(leaf, np.ndarray) else jnp
        leaf = (
            xp.where(found, leaf, np.nan)
            if np.issubdtype(leaf.dtype, np.floating) and not all(found)
            else leaf
        )
        return jnp.asarray(xp.reshape(leaf, wanted.shape))

    wide = jax.tree.map(lambda leaf: jnp.reshape(leaf, wanted.shape), orbits.pendulum)
    return replace(jax.tree.map(shaped, orbits), pendulum=wide)


def _passages(curve: Curve, targets: np.ndarray, crossing: int) -> tuple[np.ndarray, np.ndarray]:
    """The interval (-1 where there is none) and the share of it at which |theta1| meets each
    target.
    """
    pieces = np.arange(_PIECES) / _PIECES
    index = np.repeat(np.arange(len(curve.points) - 1), _PIECES)
    shares = np.tile(pieces, len(curve.points) - 1)
    seen = np.append(np.abs(curve.between(index, shares)[:, 0]), np.abs(curve.points[-1, 0]))
    below = seen[None, :] < targets[:, None]
    passed = np.cumsum(below[:, 1:] != below[:, :-1], axis=1)
    piece = np.argmax(passed >= crossing, axis=1)
    found = passed[:, -1] >= crossing
    low, high = shares[piece], shares[piece] + 1 / _PIECES
    starts_below = below[np.arange(len(targets)), piece]
    for _ in range(50):
        middle = 0.5 * (low + high)
        same = (np.abs(curve.between(index[piece], middle)[:, 0]) < targets) == starts_below
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return np.where(found, index[piece], -1), 0.5 * (low + high)


def follow_family(
    pendulum: Pendulum | Any,
    start: "str | PeriodicOrbit | SpecialPoint | Any",
    *,
    longest_step: float | Any = _LONGEST_STEP,
    longest_period: float | Any = math.inf,
    most_points: int | Any = _MOST_POINTS,
) -> Family:
    """The family of periodic orbits that `start` belongs to, from end to end.

    Pseudo-arclength continuation of orbits by multiple shooting, folds passed: a step is taken back
    if Newton's method contracts slowly, the tangent turns by more than 18 degrees, or the bordered
    Jacobian's determinant changes sign, which would be a jump to another curve. The family ends
    where the energy comes within 1e-8 of that of an equilibrium with a rod upright (in units of the
    weights' torques; the period then grows like its logarithm), where it is back at its beginning,
    or at the hanging pendulum.

    Arguments:
        pendulum: the derivatives of its leaves, if they carry any, reach what `Family.at` returns;
            `jit` around this does not work.
        start: `in-phase` or `anti-phase`, the family of a normal mode; or an orbit, from which its
            family is followed in both directions; or a special point, for the branch that leaves
            there: at a loss or gain of stability of centred orbits with c = 1 the orbits with
            x(T/2) = -x(0) that are no longer released from rest, with c = -1 those released from
            rest that are no longer centred, at a resonance the brake orbits of k times the period.
        longest_step: in arclength; the default gives about a hundred points.
        longest_period: [s]; the family is followed to its first orbit of this period.
        most_points: on one side of the start.
    Raises:
        ValueError: an unknown name; g not positive; an orbit of another pendulum, or that has not
            converged; a special point where nothing branches off, or only orbits (c = -1 in half of
            the cases) that are centred no longer and never rest; longest_period below the period of
            the first orbit.
        RuntimeError: float64 is switched off in JAX.
    See also: Doedel, Keller and Kernevez, Numerical analysis and control of bifurcation problems
    (1991); Peeters et
        al., Nonlinear normal modes II, Mechanical Systems and Signal Processing 23 (2009).
    """
    require_float64()
    fixed = _primal(pendulum)
    if not isinstance(start, (str, PeriodicOrbit, SpecialPoint)):
        raise ValueError(
            f"start must be one of {', '.join(BRANCHES)}, an orbit or a special point, got "
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
        if start not in BRANCHES:
            raise ValueError(
                f"start must be one of {', '.join(BRANCHES)}, or an orbit, got {start!r}: give one"
            )
        return _from_mode(FamilyProblem(pendulum, scaled, "centred", (0.0, 0.0)), start, reach)
    if isinstance(start, SpecialPoint):
        return _from_branch_point(pendulum, start, reach)
    return _from_orbit(pendulum, scaled, start, reach)


def _primal(pendulum: Any) -> Pendulum:
    """The numbers behind a pendulum, also under eager differentiation, whose derivatives
    `Family.at` carries on.

    Raises:
        ValueError: no pendulum; a field that is an array or traced by `jit`; g not positive.
    """
    check_pendulum(pendulum)
    numbers = {}
    for name, leaf in vars(pendulum).items():
        single(name, leaf)
        known = known_value(leaf)
        numbers[name] = leaf if known is None else known
    return swinging_pendulum(Pendulum(**numbers))  # which refuses what `jit` traces


_beginning = jax.jit(start_at_mode)


def _from_mode(problem: FamilyProblem, branch: str, reach: Reach) -> Family:
    start = jax.tree.map(np.asarray, _beginning(problem.natural, branch == "in-phase"))
    rows, end = problem.followed(start, None, reach)
    if not len(rows.point):
        raise _too_short(reach)
    curve = curve_of(rows)
    points, tangents = (
        np.vstack([start.point, curve.points]),
        np.vstack([start.tangent, curve.tangents]),
    )
    curve = Curve(points, tangents, np.append(start.steps, curve.steps))
    return _family(problem, rows, curve, ("normal mode", end))


def _too_short(reach: Reach) -> ValueError:
    return ValueError(
        f"longest_period must be longer than the period of the first orbit, got {reach.period:g} "
        f"sqrt(l1/g): give a "
        "longer one"
    )


def _from_orbit(pendulum: Pendulum, scaled: Pendulum, orbit: PeriodicOrbit, reach: Reach) -> Family:
    fixed = _primal(pendulum)
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
    if not np.allclose(mine, jax.tree.leaves(fixed), rtol=1e-12):
        raise ValueError(f"start must be an orbit of this pendulum, got one of {orbit.pendulum}")
    second = math.sqrt(fixed.l1 / fixed.g)
    momentum = fixed.m1 * fixed.l1**2 / second
    state, dual = (
        np.array([x.theta1, x.theta2, x.p1 / momentum, x.p2 / momentum], np.float64)
        for x in (orbit.state, orbit.dual)
    )
    turns = {
        "centred": np.array(orbit.turns, np.float64),
        "odd": np.round((state + dual)[:2] / (2 * np.pi)),
    }
    symmetry = orbit.symmetry
    full = turns.get(symmetry, np.zeros(2))
    problem = FamilyProblem(pendulum, scaled, symmetry, (float(full[0]), float(full[1])))
    if orbit.period / second > reach.period * (1 + 1e-12):
        raise _too_short(reach)
    duration = float(orbit.period) / second / PARTS[symmetry]
    point = guess_arc(problem, np.zeros(1), state[None], duration)
    rows = problem.on_curve(point)
    if rows is None or np.linalg.norm(way_to(rows.point[0, :2], state[:2])) > _SAME_ORBIT:
        raise ValueError(
            "start must be an orbit whose motion is still known at the end of its arc: give "
            "another one"
        )
    return _both_ways(problem, rows, reach)


# How far the corrected start may be from the orbit that was given [rad].
_SAME_ORBIT = 1e-5


def _both_ways(problem: FamilyProblem, rows: Solved, reach: Reach) -> Family:
    """The family through a point, in both directions unless it is closed."""
    first = min(FIRST_STEP, reach.step)
    start = start_at(rows.point[0], rows.tangent[0], first, rows.steps[0])
    ahead, end = problem.followed(start, rows, reach)
    if end == "closed":
        return _closed(problem, rows, ahead)
    behind, begin = problem.followed(start._replace(tangent=-start.tangent), rows, reach)
    whole, ends, here = concatenate(reversed_(behind), rows, ahead), (begin, end), len(behind.point)
    if problem.symmetry == "brake":
        whole, ends = drop_mirror_half(whole, ends, here)
    return _family(problem, whole, curve_of(whole), ends)


def _closed(problem: FamilyProblem, start: Solved, ahead: Solved) -> Family:
    """A curve that comes back to its beginning: to the same rest, which is then its last point too,
    or to the other.
    """
    rows, ends = concatenate(start, ahead), ("closed", "closed")
    if problem.symmetry == "brake" and (half := half_of_closed(rows)) is not None:
        rows, ends = half, ("branch point", "branch point")
    elif (
        np.sqrt(np.sum(METRIC * (ahead.point[-1] - start.point[0]) ** 2))
        < 2 * curve_of(rows).lengths[-1]
    ):
        rows = concatenate(rows, start)
    return _family(problem, rows, curve_of(rows), ends)


def _family(problem: FamilyProblem, rows: Solved, curve: Curve, ends: tuple[str, str]) -> Family:
    arclength = np.concatenate([[0.0], np.cumsum(curve.lengths)])
    points = special_points(problem, rows, curve, arclength)
    status = Status.CONVERGED
    if "unfinished" in ends:
        status = Status.MAX_ITERATIONS
    if "lost" in ends:
        status = Status.LEFT_BRANCH
    return Family(
        orbits=jax.tree.map(jnp.asarray, orbits_of(problem, rows)),
        arclength=jnp.asarray(arclength[len(arclength) - len(rows.point) :]),
        slopes=jax.tree.map(jnp.asarray, slopes_of(problem, rows)),
        special_points=tuple(points),
        status=jnp.asarray(int(status)),
        ends=ends,
        _curve=curve,
        _problem=problem,
    )


# At a fold in energy stability changes, too, and no other family is there: slopes below this are
# zero.
_FLAT = 1e-5


def _from_branch_point(pendulum: Pendulum, special: SpecialPoint, reach: Reach) -> Family:
    if special._branch is None:
        raise ValueError(
            f"start must be a point where a family branches off, got {special.kind}: follow its "
            f"orbit"
        )
    symmetry, k = special._branch
    base = special._place
    if special.kind.startswith("stability") and abs(float(base.rows.energy_slope[0])) < _FLAT:
        raise ValueError(
            f"start must be a point where a family branches off, got {special.kind} at a fold in "
            f"energy"
        )
    half = float(base.rows.times[0].sum()) * PARTS[base.problem.symmetry] / 2
    duration = k * half * 2 / PARTS[symmetry]
    turns = base.problem.turns if symmetry != "brake" else (0.0, 0.0)
    problem = FamilyProblem(pendulum, base.problem.natural, symmetry, turns)
    point = guess_arc(problem, *repeated(base.problem, base.rows, k), duration)
    sides = []
    for sign in (1.0, -1.0):
        rows = problem.onto_branch(base.rows, point, sign)
        if rows is None:
            # At c = -1 either C loses rank, and orbits at rest branch off, or B vanishes, and they
            # pass through theta in {0, pi}^2 at T/4 and at 3 T/4 without ever resting.
            why = (
                "whose orbits are never at rest"
                if (symmetry, k) == ("brake", 1)
                else "without one nearby"
            )
            raise ValueError(
                f"start must be a point where a family that can be followed branches off, got "
                f"{special.kind} {why}"
            )
        if problem.period(rows)[0] > reach.period:
            raise _too_short(reach)
        start = start_at(rows.point[0], rows.tangent[0], min(FIRST_STEP, reach.step), rows.steps[0])
        ahead, end = problem.followed(start, rows, reach)
        if end == "closed":
            return _closed(problem, rows, ahead)
        sides.append((concatenate(rows, ahead), end))
        if symmetry != "centred":
            break  # the other side holds the same orbits, at their other rest or in the mirror
    (one, end), other = sides[0], sides[1:]
    if other:
        rows = concatenate(reversed_(other[0][0]), one)
        return _family(problem, rows, curve_of(rows), (other[0][1], end))
    return _family(problem, one, curve_of(one), ("branch point", end))
