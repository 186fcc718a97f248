"""Families of periodic orbits: curves of releases, from small swings to the motions that take for
ever.

A `Family` holds the points of its curve (`continuation` follows it), and solves for the orbits at
any release angle on it.
"""

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from dpend.checks import Scalar, at_most_one, integer, known_value, numbers, real
from dpend.orbits.curve import Curve
from dpend.orbits.follow import FamilyProblem
from dpend.orbits.newton import METRIC, Solved
from dpend.orbits.orbit import (
    Held,
    PeriodicOrbit,
    Slopes,
    mirrored,
    orbit_quantities,
    orbits_of,
    slopes_of,
)
from dpend.orbits.passages import LEVELS, angle_passages, level_passages, onto_level
from dpend.orbits.samples import SpecialPoint
from dpend.orbits.special import special_points
from dpend.orbits.walk import STRAYED
from dpend.records import Quantities, frame, html, outcome, span, variables
from dpend.status import Status, message

# The derivative with respect to theta1 is refused where less than this share of a step along the
# curve goes into it, which is nearer to the fold than its square.
_AT_FOLD = 1e-5
# Below this angle [rad] rounding is what is left of an amplitude.
_TINIEST = 1e-10


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
            (the energy grows without bound), `longest period` (if one was given), `lost` or
            `unfinished` (see status).
    """

    orbits: PeriodicOrbit
    arclength: Scalar
    slopes: Slopes
    special_points: tuple[SpecialPoint, ...]
    status: Scalar
    ends: tuple[str, str] = field(metadata={"static": True})
    _curve: "Curve" = field(repr=False, metadata={"static": True})
    _rows: Solved = field(repr=False, metadata={"static": True})
    _problem: "FamilyProblem" = field(repr=False)

    @property
    def symmetry(self) -> str:
        """The symmetry of all its orbits."""
        return self.orbits.symmetry

    @property
    def message(self) -> str:
        """The sentence that says what its status means."""
        return message(self.status)

    def to_dataframe(self) -> Any:
        """A row for each of its orbits, with the names and the units of files: angles in
        degrees.
        """
        return frame(self._quantities())

    def to_xarray(self) -> Any:
        """Its orbits as an `xarray.Dataset` over `orbit`, with arclength and the angles in degrees
        as coordinates: radians and SI units.
        """
        import xarray

        data, degrees = variables(self._quantities(), "orbit")
        attributes = {"ends": " to ".join(self.ends), "status": outcome(self.status)}
        return xarray.Dataset(data, degrees, attributes).set_coords("arclength")

    def _quantities(self) -> Quantities:
        return {"arclength": (np.asarray(self.arclength), "")} | orbit_quantities(self.orbits)

    def __repr__(self) -> str:
        count = f"{np.size(self.arclength)} {self.symmetry} orbits"
        ends, special = " to ".join(self.ends), f"{len(self.special_points)} special points"
        period = span("period", self.orbits.period, "s")
        energy = span("energy", self.orbits.energy, "J")
        told = ", ".join((ends, special, period, energy, outcome(self.status)))
        return f"<Family: {count}, {told}>"

    _repr_html_ = html

    def at(
        self,
        theta1: Scalar | None = None,
        *,
        energy: Scalar | None = None,
        period: Scalar | None = None,
        crossing: int | Any = 1,
    ) -> PeriodicOrbit:
        """The orbits of this family released at `theta1`, or with this energy or period: Newton's
        method from where its curve passes. Give one of the three.

        An orbit released at (-theta1, -theta2) counts; where the curve has it, the mirror image is
        returned. Derivatives with respect to what is given, and to the pendulum that
        `follow_family` was given, are those of the root (implicit function theorem): one linear
        solve and no walk. Second ones are forward derivatives of these, as `jax.hessian` takes
        them. The walk needs numbers, so that `jax.grad`, `jax.jacfwd` and their like work, and
        `jax.jit` around it does not.

        Arguments:
            theta1: release angles of the upper rod [rad], any shape; not of `passing` orbits, which
                all start at 0 or 180 degrees.
            energy: [J], any shape; zero for both bobs at rest at the pivot's height.
            period: minimal periods [s], any shape.
            crossing: which of the curve's passages through the value, in order of arclength.
        Returns:
            PeriodicOrbit with leaves of the value's shape. Where the family does not get there, the
            status is `NO_SUCH_ORBIT` and the rest NaN.
        Raises:
            ValueError: none or several of theta1, energy and period; one that is not finite or
                traced by `jit`; theta1 below 1e-10, a period not positive; a derivative asked for
                where the family turns back in what is given, and it is infinite: `slopes` has those
                with respect to arclength.
        """
        given = {"theta1": theta1, "energy": energy, "period": period}
        at_most_one(**given)
        name = next((name for name, value in given.items() if value is not None), "theta1")
        return _at(self, name, given[name], crossing)


def _at(family: Family, name: str, value: Scalar | None, crossing: int | Any) -> PeriodicOrbit:
    """See `Family.at`."""
    crossing = integer("crossing", crossing)
    value, wanted = _known_values(name, value)
    problem, flat = family._problem, wanted.ravel()
    found = _points_at(family, name, flat, crossing)
    held = None
    leaves = jax.tree.leaves((value, problem.pendulum))
    if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        _refuse_folds(family, name, found, flat)
        targets = LEVELS[name].natural(jnp.ravel(value), problem) * found.side
        held = Held(name, targets, found.rows)
    orbits = orbits_of(problem, found.solved, held)
    astray = found.strayed & (orbits.status == Status.CONVERGED)
    status = np.where(astray, Status.LEFT_BRANCH, orbits.status)
    status = np.where(found.there, status, Status.NO_SUCH_ORBIT)
    orbits = replace(mirrored(orbits, found.side), status=status)
    return _shape(orbits, found.there, wanted.shape)


class _Found(NamedTuple):
    """Points where a curve passes values: whether it does, whether the root is another's, the sign
    of the mirror image that was asked for, and the covectors of theta1 in it.
    """

    solved: Solved
    there: np.ndarray
    strayed: np.ndarray
    side: np.ndarray
    rows: np.ndarray


def _points_at(family: Family, name: str, values: np.ndarray, crossing: int) -> _Found:
    problem, curve = family._problem, family._curve
    if name == "theta1" and problem.symmetry == "passing":
        raise ValueError(
            "theta1 must not be given for passing orbits, got one: they all start at 0 or 180 "
            "degrees; give energy or period"
        )
    if name == "theta1":
        targets = np.abs(values)
        index, share = angle_passages(curve, targets, crossing)
    else:
        known = replace(problem, pendulum=jax.tree.map(known_value, problem.pendulum))
        targets = np.asarray(LEVELS[name].natural(values, known))
        index, share = level_passages(problem, name, family._rows, curve, targets, crossing)
    start = np.maximum(index, 0)
    points = curve.between(start, share)
    side, rows = np.ones(len(values)), np.zeros_like(points)
    if name == "theta1":
        side = np.where((points[:, 0] < 0) != (values < 0), -1.0, 1.0)
        points[:, 0] = np.where(points[:, 0] < 0, -targets, targets)
        rows[:, 0] = 1.0
        solved = problem.correct(points, rows, curve.steps[start + 1])
    else:
        rows = METRIC * curve.tangents_between(start, share)
        near = problem.correct(points, rows, curve.steps[start + 1])
        solved, _ = onto_level(problem, name, targets, near, curve.lengths[start])
    away = np.sqrt(np.sum(METRIC * (solved.point - points) ** 2, axis=1))
    strayed = away > np.maximum(STRAYED * curve.lengths[start], 1e-9)
    return _Found(solved, index >= 0, strayed, side, rows)


def _known_values(name: str, value: Any) -> tuple[jax.Array, np.ndarray]:
    """The values as they were given, which may carry derivatives, and as numbers."""
    unit = LEVELS[name].unit
    value = real(name, value) if isinstance(value, jax.Array) else numbers(name, value, unit=unit)
    value = jnp.asarray(value, jnp.float64)
    try:
        wanted = np.asarray(lax.stop_gradient(value))
    except jax.errors.TracerArrayConversionError:
        raise ValueError(
            f"{name} must be a number here, not traced by jit: use find_orbit inside jit"
        ) from None
    least = {"theta1": f" and at least {_TINIEST:g} in size", "period": " and positive"}
    good = np.isfinite(wanted)
    if name != "energy":
        good &= (np.abs(wanted) if name == "theta1" else wanted) >= _TINIEST
    if not wanted.size or not np.all(good):
        raise ValueError(
            f"{name} must be finite{least.get(name, '')} [{unit}], got {wanted}: give other values"
        )
    return value, wanted


def _refuse_folds(family: Family, name: str, found: _Found, wanted: np.ndarray) -> None:
    """Refuses a derivative with respect to what is infinite at a fold."""
    folded = found.there & (np.abs(LEVELS[name].slope(found.solved)) < _AT_FOLD)
    if name == "theta1":
        points = family.special_points
        folds = np.array([abs(float(p.orbit.theta1)) for p in points if p.kind == "fold_theta1"])
        folded |= np.any(np.abs(np.abs(wanted)[:, None] - folds) < _AT_FOLD**2, axis=1)
    if np.any(folded):
        raise ValueError(
            f"{name} must not be a fold of the family for a derivative, got "
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
        _rows=rows,
        _problem=problem,
    )
