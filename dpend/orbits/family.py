"""Families of periodic orbits: curves of releases, from small swings to the motions that take for
ever.

A `Family` holds the points of its curve (`continuation` follows it), and solves for the orbits at
any release angle on it.
"""

from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from dpend.checks import (
    Scalar,
    integer,
    numbers,
    real,
)
from dpend.orbits.curve import (
    Curve,
)
from dpend.orbits.follow import FamilyProblem
from dpend.orbits.newton import METRIC, Solved
from dpend.orbits.orbit import PeriodicOrbit, Slopes, mirrored, orbits_of, slopes_of
from dpend.orbits.samples import SpecialPoint
from dpend.orbits.special import special_points
from dpend.orbits.walk import STRAYED
from dpend.status import Status, message

# The derivative with respect to theta1 is refused where less than this share of a step along the
# curve goes into it, which is nearer to the fold than its square.
_AT_FOLD = 1e-5
# Below this angle [rad] rounding is what is left of an amplitude.
_TINIEST = 1e-10
# Each interval is looked at in this many pieces for passages through an angle.
_PIECES = 8
# Halvings of a piece, down to the last place of a share.
_HALVINGS = 50


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
            upright), `closed` (it comes back to its beginning), `branch point`, `fast rotation`
            (the energy grows without bound), `longest period`
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


def _at(family: Family, theta1: Scalar, crossing: int | Any) -> PeriodicOrbit:
    """See `Family.at`."""
    crossing = integer("crossing", crossing)
    theta1, wanted = _known_angles(theta1)
    problem, curve = family._problem, family._curve
    targets = np.abs(wanted.ravel())
    index, share = _passages(curve, targets, crossing)
    found, start = index >= 0, np.maximum(index, 0)
    points = curve.between(start, share)
    side = np.where((points[:, 0] < 0) != (wanted.ravel() < 0), -1.0, 1.0)  # of the mirror image
    points[:, 0] = np.where(points[:, 0] < 0, -targets, targets)
    rows = np.zeros_like(points)
    rows[:, 0] = 1.0
    solved = problem.correct(points, rows, curve.steps[start + 1])
    traced = any(
        isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((theta1, problem.pendulum))
    )
    if traced:
        _refuse_folds(family, solved, found, wanted.ravel())
    along = jnp.ravel(theta1) * side if traced else None
    orbits = orbits_of(problem, solved, along, rows)
    away = np.sqrt(np.sum(METRIC * (solved.point - points) ** 2, axis=1))
    strayed = away > np.maximum(STRAYED * curve.lengths[start], 1e-9)
    status = np.where(
        strayed & (orbits.status == Status.CONVERGED), Status.LEFT_BRANCH, orbits.status
    )
    status = np.where(found, status, Status.NO_SUCH_ORBIT)
    return _shape(replace(mirrored(orbits, side), status=status), found, wanted.shape)


def _known_angles(theta1: Scalar) -> tuple[jax.Array, np.ndarray]:
    """The angles as they were given, which may carry derivatives, and as numbers."""
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
    return theta1, wanted


def _refuse_folds(family: Family, solved: Solved, found: np.ndarray, wanted: np.ndarray) -> None:
    """Refuses a derivative with respect to theta1 where it is infinite."""
    folds = np.array(
        [abs(float(p.orbit.theta1)) for p in family.special_points if p.kind == "fold_theta1"]
    )
    near = np.any(np.abs(np.abs(wanted)[:, None] - folds) < _AT_FOLD**2, axis=1)
    folded = near | (found & (np.abs(solved.tangent[:, 0]) < _AT_FOLD))
    if np.any(folded):
        raise ValueError(
            f"theta1 must not be a fold of the family for a derivative, got "
            f"{wanted[np.argmax(folded)]}: it is infinite there; the family's slopes are "
            f"derivatives with respect to arclength"
        )


def _shape(orbits: PeriodicOrbit, found: np.ndarray, shape: tuple[int, ...]) -> PeriodicOrbit:
    """Orbits in a row as an array of `shape`, NaN where none was found."""

    def leaf_of(leaf: Any) -> Any:
        xp = np if isinstance(leaf, np.ndarray) else jnp
        if np.issubdtype(leaf.dtype, np.floating) and not all(found):
            leaf = xp.where(found, leaf, np.nan)
        return jnp.asarray(xp.reshape(leaf, shape))

    wide = jax.tree.map(lambda leaf: jnp.reshape(leaf, shape), orbits.pendulum)
    return replace(jax.tree.map(leaf_of, orbits), pendulum=wide)


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
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        same = (np.abs(curve.between(index[piece], middle)[:, 0]) < targets) == starts_below
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return np.where(found, index[piece], -1), 0.5 * (low + high)


def family_of(problem: FamilyProblem, rows: Solved, curve: Curve, ends: tuple[str, str]) -> Family:
    """The family whose points these are, with its special points."""
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
