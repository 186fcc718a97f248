"""Families of periodic orbits: curves of releases, from small swings to the motions that take for ever.

`follow_family` walks along one by pseudo-arclength, its orbits cut into segments (see `shooting`), and finds where its
stability changes, where it turns back and where others branch off; given such a place, it follows the branch.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from dpend._runtime import require_float64
from dpend.checks import integer, known_number, known_real, known_value, numbers, real, single
from dpend.continuation import (
    LARGEST_COVER,
    Curve,
    Problem,
    Reach,
    begun,
    curve_of,
    half_of_closed,
    joined,
    laid_out,
    repeated,
    some_of,
    turned,
    way_to,
    without_its_image,
)
from dpend.orbits import BRANCHES, PeriodicOrbit, mirrored, swinging_pendulum
from dpend.pendulum import Pendulum, Scalar, State, check_pendulum, hamiltonian
from dpend.shooting import (
    CROSSING,
    FIRST_STEP,
    METRIC,
    PARTS,
    Corrected,
    beginning,
    natural,
    sensitivities,
)
from dpend.stability import LARGEST_C, growth_of, stability_of
from dpend.trajectory import Status

# The longest step: a hundred points or so for a family, close enough for cubics to show every turn.
_LONGEST_STEP = 0.1
_MOST_POINTS = 5000


class Slopes(NamedTuple):
    """Derivatives with respect to arclength: finite at folds too, where those with respect to theta1 are not.

    Attributes:
        theta1, theta2: of the release.
        period: [s].
        energy: [J].
    """

    theta1: Scalar
    theta2: Scalar
    period: Scalar
    energy: Scalar


@dataclass(frozen=True, eq=False)
class _Place:
    """A point of a curve, and what it solves."""

    problem: "Problem"
    rows: Corrected  # of one row


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SpecialPoint:
    """A place on a family where something changes.

    Attributes:
        kind: `stability_lost` or `stability_gained` on the way along the family; `fold_theta1`, `fold_energy`, where
            the curve turns back in it; `resonance_k:n`, where the multipliers are exp(+-2 pi i n/k) and orbits of k
            times the period branch off; `crossing`, where another curve runs through this one, or passes it by less
            than 2e-4. Of what lies within its error only folds and changes of stability are told, if they are not
            taken back there.
        arclength: where, in the family's.
        orbit: the orbit there.
        slopes: derivatives with respect to arclength.
        error_estimate: of arclength, and of the orbit's kappa. Rounding cannot hide on which side of the point a place
            further away lies; kappa is within its error of what the kind says.
    """

    arclength: Scalar
    orbit: PeriodicOrbit
    slopes: Slopes
    error_estimate: tuple[Scalar, Scalar]
    kind: str = field(metadata={"static": True})
    _place: Any = field(repr=False, metadata={"static": True})
    _branch: tuple[str, int] | None = field(repr=False, metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Family:
    """A curve of periodic orbits.

    Attributes:
        orbits: one `PeriodicOrbit` with a leading axis, in order of arclength; all of one symmetry.
        arclength: from the family's beginning, shape (n,). ds^2 is the mean of dtheta1^2 + dtheta2^2 over the nodes
            that cut the arc into segments, plus the square of d log Delta, Delta being the fastest motion's share in a
            segment: nearly d log(period).
        slopes: derivatives with respect to arclength, shape (n,).
        special_points: in order of arclength. Resonances where rounding leaves c (of brake orbits kappa) unknown to
            1e-4 are left out, and stable windows between two orbits with them: some 1e-8 wide, between orbits whose
            kappa is 1e10.
        status: `Status.CONVERGED` if the family was followed to its ends, `LEFT_BRANCH` if at one no step was short
            enough, `MAX_ITERATIONS` if it has more points than were allowed.
        ends: what its beginning and its end are: `normal mode` (of an equilibrium), `homoclinic` (the period grows
            without bound as the energy tends to that of an equilibrium with a rod upright), `closed` (it comes back to
            its beginning), `branch point`, `longest period` (if one was given), `lost` or `unfinished` (see status).
    """

    orbits: PeriodicOrbit
    arclength: Scalar
    slopes: Slopes
    special_points: tuple[SpecialPoint, ...]
    status: Scalar
    ends: tuple[str, str] = field(metadata={"static": True})
    _curve: "Curve" = field(repr=False, metadata={"static": True})
    _problem: "Problem" = field(repr=False)

    @property
    def symmetry(self) -> str:
        """The symmetry of all its orbits."""
        return self.orbits.symmetry

    @property
    def message(self) -> str:
        """The sentence that says what its status means."""
        return _MESSAGES[Status(int(self.status))]

    def at(self, theta1: Scalar, *, crossing: int | Any = 1) -> PeriodicOrbit:
        """The orbits of this family released at `theta1`: Newton's method from where its curve passes.

        An orbit released at (-theta1, -theta2) counts; where the curve has it, the mirror image is returned.
        Derivatives with respect to `theta1`, and to the pendulum that `follow_family` was given, are those of the root
        (implicit function theorem): one linear solve and no walk. The walk needs numbers, so that `jax.grad`,
        `jax.jacfwd` and their like work, and `jax.jit` around it does not.

        Arguments:
            theta1: release angles of the upper rod [rad], any shape.
            crossing: which of the curve's passages through `theta1`, in order of arclength.
        Returns:
            PeriodicOrbit with leaves of theta1's shape. Where the family does not get there, the status is
            `NO_SUCH_ORBIT` and the rest NaN.
        Raises:
            ValueError: theta1 not finite, below 1e-10 or traced by `jit`; a derivative asked for at a fold in theta1,
                where it is infinite: `slopes` has those with respect to arclength.
        """
        return _at(self, theta1, crossing)


_MESSAGES = {
    Status.CONVERGED: "Followed from end to end.",
    Status.LEFT_BRANCH: "At one end no step was short enough to stay on this curve: its orbits are as they are, but it "
    "goes on.",
    Status.MAX_ITERATIONS: "It has more points than were allowed: raise most_points.",
}


# --- from points to orbits -------------------------------------------------------------------------------------------


class _Known(NamedTuple):
    """What is known of orbits, in natural units: columns of the array that carries derivatives."""

    theta1: Any
    theta2: Any
    p1: Any
    p2: Any
    end1: Any  # the angles at the arc's end
    end2: Any
    time: Any
    kappa: Any
    log_abs_kappa: Any


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _implicit(symmetry: str, known: Any, parameters: Any, points: Any, rows: Any, steps: Any, turns: Any) -> Any:
    """`known`, shape (m, 9), as a function of (l2/l1, m2/m1, target), shape (m, 3): see `sensitivities`."""
    return known


@jax.custom_jvp
def _once(parameters: Any) -> Any:
    """Refuses to be differentiated: the points of `_implicit` would not know how they move."""
    return parameters


@_once.defjvp
def _once_jvp(primals, tangents):  # type: ignore[no-untyped-def]
    raise ValueError("theta1 must not be differentiated twice on a family: use find_orbit for second derivatives")


@_implicit.defjvp
def _implicit_jvp(symmetry, primals, tangents):  # type: ignore[no-untyped-def]
    _, parameters, points, rows, steps, turns = primals
    jacobian = sensitivities(_once(parameters)[0, :2], points, rows, steps, turns, symmetry)
    return _implicit(symmetry, *primals), jnp.einsum("mij,mj->mi", jacobian, tangents[1])


@partial(jax.jit, static_argnames="symmetry")
def _carried(pendulum, targets, known, points, rows, steps, turns, symmetry):  # type: ignore[no-untyped-def]
    """What is known in SI units, carrying the derivatives of the pendulum and the targets."""
    ratios = jnp.stack([pendulum.l2 / pendulum.l1, pendulum.m2 / pendulum.m1])
    parameters = jnp.column_stack([jnp.broadcast_to(ratios, (len(known), 2)), targets])
    known = _implicit(symmetry, known, parameters, points, rows, steps, turns)
    fields = _in_units(pendulum, _Known(*known.T), turns, symmetry, jnp)
    return fields | {"energy": hamiltonian(pendulum, fields["state"])}


def _in_units(pendulum: Pendulum, known: _Known, turns: Any, symmetry: str, xp: Any) -> dict[str, Any]:
    """The fields of an orbit that depend on the pendulum, but for the energy."""
    second = xp.sqrt(pendulum.l1 / pendulum.g)
    momentum = pendulum.m1 * pendulum.l1**2 / second
    state = State(known.theta1, known.theta2, momentum * known.p1, momentum * known.p2)
    dual = State(2 * np.pi * turns[0] - known.theta1, 2 * np.pi * turns[1] - known.theta2, -state.p1, -state.p2)
    if symmetry == "brake":
        dual = State(known.end1, known.end2, dual.p1, dual.p2)
    return {
        "pendulum": jax.tree.map(lambda leaf: leaf * xp.ones_like(known.time), pendulum),
        "state": state,
        "period": PARTS[symmetry] * second * known.time,
        "kappa": known.kappa,
        "log_abs_kappa": known.log_abs_kappa,
        "dual": dual,
    }


def _orbits(problem: Problem, rows: Corrected, targets: Any = None, along: Any = None) -> PeriodicOrbit:
    """Points as orbits, in NumPy: eager JAX would compile each operation for each number of points.

    With `targets`, the values of theta1 at which the rows `along` were solved, everything carries derivatives.
    """
    _, kappa, logarithm = stability_of(rows.matrices, problem.symmetry)
    time = rows.times.sum(axis=1)
    start = rows.point[:, :4] * ([1, 1, 1, 1] if problem.symmetry == "odd" else [1, 1, 0, 0])  # at rest, exactly
    known = np.column_stack([start, rows.end[:, :2], time, kappa, logarithm])
    turns = np.asarray(problem.turns)
    pendulum = jax.tree.map(known_value, problem.pendulum)
    if targets is None:
        fields = _in_units(pendulum, _Known(*known.T), turns, problem.symmetry, np)
        fields["energy"] = pendulum.m1 * pendulum.g * pendulum.l1 * rows.energy
    else:
        task = known, rows.point, along, rows.steps, turns
        fields = _carried(problem.pendulum, targets, *task, problem.symmetry)
    whole = np.broadcast_to(turns if problem.symmetry == "centred" else 0 * turns, (len(time), 2)).astype(int)
    period = PARTS[problem.symmetry] * math.sqrt(pendulum.l1 / pendulum.g) * time
    return PeriodicOrbit(
        **fields,
        residual=rows.residual,
        iterations=rows.iterations.astype(int),
        turns=(whole[:, 0], whole[:, 1]),
        error_estimate=(
            np.maximum(rows.theta2_error, np.finfo(float).eps * np.abs(rows.point[:, 1])),
            np.maximum(rows.time_error, np.finfo(float).eps) * period,
        ),
        status=np.where(rows.converged > 0, int(Status.CONVERGED), int(Status.MAX_ITERATIONS)),
        symmetry=problem.symmetry,
    )


def _slopes(problem: Problem, rows: Corrected) -> Slopes:
    pendulum = jax.tree.map(known_value, problem.pendulum)
    second = math.sqrt(pendulum.l1 / pendulum.g)
    return Slopes(
        rows.tangent[:, 0],
        rows.tangent[:, 1],
        PARTS[problem.symmetry] * second * rows.time_slope,
        pendulum.m1 * pendulum.g * pendulum.l1 * rows.energy_slope,
    )


# The derivative with respect to theta1 is refused where less than this share of a step along the curve goes into it,
# which is nearer to the fold than its square.
_AT_FOLD = 1e-5
# Below this angle [rad] rounding is what is left of an amplitude.
_TINIEST = 1e-10
# Each interval is looked at in this many pieces for passages through an angle.
_PIECES = 8


def _at(family: Family, theta1: Scalar, crossing: int | Any) -> PeriodicOrbit:
    """See `Family.at`."""
    crossing = integer("crossing", crossing)
    theta1 = real("theta1", theta1) if isinstance(theta1, jax.Array) else numbers("theta1", theta1, unit="rad")
    theta1 = jnp.asarray(theta1, jnp.float64)
    try:
        wanted = np.asarray(lax.stop_gradient(theta1))
    except jax.errors.TracerArrayConversionError:
        raise ValueError("theta1 must be a number here, not traced by jit: use find_orbit inside jit") from None
    if not wanted.size or not np.all(np.isfinite(wanted)) or np.any(np.abs(wanted) < _TINIEST):
        raise ValueError(
            f"theta1 must be finite and at least {_TINIEST:g} in size [rad], got {wanted}: give other angles"
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
    solved = problem.corrected(points, rows, curve.steps[np.maximum(index, 0) + 1])
    away = np.sqrt(np.sum(METRIC * (solved.point - points) ** 2, axis=1))
    strayed = away > np.maximum(_STRAYED * curve.lengths[np.maximum(index, 0)], 1e-9)
    traced = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((theta1, problem.pendulum)))
    folds = np.array([abs(float(p.orbit.theta1)) for p in family.special_points if p.kind == "fold_theta1"])
    near = np.any(np.abs(targets[:, None] - folds) < _AT_FOLD**2, axis=1)
    folded = near | (found & (np.abs(solved.tangent[:, 0]) < _AT_FOLD))
    if traced and np.any(folded):
        angle = wanted.ravel()[np.argmax(folded)]
        raise ValueError(
            f"theta1 must not be a fold of the family for a derivative, got {angle}: it is infinite there; the "
            "family's slopes are derivatives with respect to arclength"
        )
    along = jnp.ravel(theta1) * side if traced else None
    orbits = _orbits(problem, solved, along, rows)
    status = np.where(strayed & (orbits.status == Status.CONVERGED), Status.LEFT_BRANCH, orbits.status)
    status = np.where(found, status, Status.NO_SUCH_ORBIT)
    orbits = replace(mirrored(orbits, side), status=status)

    def shaped(leaf: Any) -> Any:
        xp = np if isinstance(leaf, np.ndarray) else jnp
        leaf = xp.where(found, leaf, np.nan) if np.issubdtype(leaf.dtype, np.floating) and not all(found) else leaf
        return jnp.asarray(xp.reshape(leaf, wanted.shape))

    wide = jax.tree.map(lambda leaf: jnp.reshape(leaf, wanted.shape), orbits.pendulum)
    return replace(jax.tree.map(shaped, orbits), pendulum=wide)


# The cubic is true to a few thousandths of its interval: a root further away than this share of it is another orbit.
_STRAYED = 0.1


def _passages(curve: Curve, targets: np.ndarray, crossing: int) -> tuple[np.ndarray, np.ndarray]:
    """The interval (-1 where there is none) and the share of it at which |theta1| meets each target."""
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


# --- special points --------------------------------------------------------------------------------------------------


class _Test(NamedTuple):
    """A function of the points that vanishes where something changes."""

    kind: str
    value: Callable[[Corrected, np.ndarray], np.ndarray]
    branch: tuple[str, int] | None  # symmetry of the orbits that branch off, and their period in units of this one's


def _tests(symmetry: str) -> list[_Test]:
    """What is looked for; the second argument of a test is c, of brake orbits kappa."""
    tests = [
        _Test("fold_theta1", lambda rows, c: rows.tangent[:, 0], None),
        _Test("fold_energy", lambda rows, c: rows.energy_slope, None),
    ]
    branches = {"centred": (("odd", 1), ("brake", 1)), "brake": (None, ("brake", 2)), "odd": (None, None)}[symmetry]
    tests.append(_Test("above", lambda rows, c: c - 1, branches[0]))
    tests.append(_Test("below", lambda rows, c: c + 1, branches[1]))
    for k in range(2, LARGEST_COVER + 1):
        for n in range(1, k):
            if math.gcd(n, k) > 1 or (symmetry == "brake" and 2 * n > k):
                continue
            target = math.cos((2 if symmetry == "brake" else 1) * math.pi * n / k)
            branch = "centred" if symmetry == "centred" and n % 2 == 0 else "brake"
            value = partial(lambda target, rows, c: c - target, target)
            tests.append(_Test(f"resonance_{k}:{n}", value, (branch, k) if symmetry != "odd" else None))
    return tests


def _measure(rows: Corrected, symmetry: str) -> np.ndarray:
    """What the tests are told: c, or kappa of brake orbits."""
    c, kappa, _ = stability_of(rows.matrices, symmetry)
    return np.asarray(kappa if symmetry == "brake" else c)


# What rounding leaves of c and of slopes, as bounds. About 306 places of 60 families, c scattered by 7 (median) to 1400
# times eps times its growth, and the tangent by up to 10 times the error estimate of the point.
_ROUNDING, _LEVERAGE, _WOBBLE = 2000 * np.finfo(float).eps, 4.0, 50.0


def _measure_error(rows: Corrected, symmetry: str) -> np.ndarray:
    """What c, of brake orbits kappa, is known to."""
    spread = np.maximum(rows.angle_error, rows.time_error)
    return np.asarray(growth_of(rows.matrices, symmetry) * np.maximum(_ROUNDING, _LEVERAGE * spread))


def _kappa_error(spot: "_Spot", symmetry: str) -> float:
    """What the kappa of a special point is known to: rounding, and what its place's error makes of it."""
    error = float(_measure_error(spot.row, symmetry)[0] + abs(spot.steepness) * spot.error)
    if symmetry == "brake":
        return error
    error = min(error, LARGEST_C)
    c = min(abs(float(_measure(spot.row, symmetry)[0])), LARGEST_C)
    return 4 * c * error + 2 * error**2 + np.finfo(float).eps * (1 + 2 * c**2)


def _values(tests: Sequence[_Test], problem: Problem, rows: Corrected) -> tuple[np.ndarray, np.ndarray]:
    """Of each test at each point, shape (tests, points): the value, and what it is known to."""
    measure, error = _measure(rows, problem.symmetry), _measure_error(rows, problem.symmetry)
    eps = np.finfo(float).eps
    wobble = _WOBBLE * np.maximum(np.maximum(rows.angle_error, rows.time_error), 10 * eps)
    errors = {"fold_theta1": wobble, "fold_energy": wobble * _steepness(problem, rows)}
    values = np.array([test.value(rows, measure) for test in tests])
    return values, np.array([errors.get(test.kind, error) for test in tests])


def _steepness(problem: Problem, rows: Corrected) -> np.ndarray:
    """The size of the energy's gradient at the release, which multiplies the tangent's error; a bound if it moves."""
    if problem.symmetry == "odd":
        return np.full(len(rows.point), problem.levels[3])
    weights = np.array([1 + problem.natural.m2, problem.natural.m2 * problem.natural.l2])
    return np.asarray(np.linalg.norm(weights * np.sin(rows.point[:, :2]), axis=1))


class _Samples(NamedTuple):
    """Points of a curve in order of arclength."""

    where: np.ndarray
    rows: Corrected


@dataclass(frozen=True, eq=False)
class _Track:
    """A curve on which points are solved for at any arclength."""

    problem: Problem
    curve: Curve
    arclength: np.ndarray

    def rows_at(self, where: np.ndarray, near: Corrected | None = None) -> Corrected:
        """The points there: from the curve's cubics, or from points close by."""
        index = np.clip(np.searchsorted(self.arclength, where, side="right") - 1, 0, len(self.arclength) - 2)
        share = (where - self.arclength[index]) / (self.arclength[index + 1] - self.arclength[index])
        points, steps = self.curve.between(index, share), self.curve.steps[index + 1]
        normals = METRIC * self.curve.tangents_between(index, share)
        if near is not None:  # along its tangent into the new plane
            way = np.sum(normals * (points - near.point), axis=1) / np.sum(normals * near.tangent, axis=1)
            points, steps = near.point + way[:, None] * near.tangent, near.steps
        return self.problem.corrected(points, normals, steps)


def _special_points(problem: Problem, rows: Corrected, curve: Curve, arclength: np.ndarray) -> list[SpecialPoint]:
    """Every place where another curve crosses, and every place where a test changes its sign by more than its error."""
    track = _Track(problem, curve, arclength)
    samples = _Samples(arclength[len(arclength) - len(rows.point) :], rows)
    zones = _crossings(track, samples)
    samples = _outside(zones, _with_extrema(track, _outside(zones, samples, with_ends=True)))
    changes = _changes(problem, samples)
    places = [
        _Spot("crossing", z.place, CROSSING, z.row_at(problem, z.place), z.steepness(problem), None) for z in zones
    ]
    if changes:
        places += _told(changes, _located(track, changes, zones), places, samples.where, problem)
    return [_special(problem, spot) for spot in sorted(places, key=lambda spot: spot.where)]


# --- where other curves cross


@dataclass(frozen=True, eq=False)
class _Zone:
    """A stretch of a curve where another one is so close that points on it have the tangent of either."""

    place: float  # of the crossing
    ends: np.ndarray
    rows: Corrected  # at both ends

    def row_at(self, problem: Problem, where: float) -> Corrected:
        """The point at an arclength in it; slopes there are those between its ends.

        Where no Newton's iteration converges, on the crossing itself, a point next to it stands for it.
        """
        chord, index = curve_of(self.rows), np.zeros(len(_BESIDE), int)
        shares = (where + np.array(_BESIDE) - self.ends[0]) / (self.ends[1] - self.ends[0])
        tangents, steps = chord.tangents_between(index, shares), chord.steps[index + 1]
        rows = problem.corrected(chord.between(index, shares), METRIC * tangents, steps)
        best = int(np.argmax(rows.converged > 0))
        mixed = {
            name: np.einsum("i,i...->...", [1 - shares[0], shares[0]], getattr(self.rows, name))[None]
            for name in ("tangent", "time_slope", "energy_slope")
        }
        return some_of(rows, slice(best, best + 1))._replace(**mixed)

    def steepness(self, problem: Problem) -> float:
        """The slope of c, of brake orbits kappa, between its ends."""
        return float(np.diff(_measure(self.rows, problem.symmetry))[0] / (self.ends[1] - self.ends[0]))

    def holds(self, low: float, high: float) -> bool:
        """Whether a stretch of the curve contains it."""
        return bool(low <= self.ends[0] and self.ends[1] <= high)


# Crossings are located to this [arclength]: nearer to them the determinant's sign is noise.
_APART = 1e-6
# Where a point of a zone is looked for, from its own place [arclength].
_BESIDE = (0.0, 1e-5, -1e-5, 5e-5, -5e-5)


def _crossings(track: _Track, samples: _Samples) -> list[_Zone]:
    """The stretches of a curve where the determinant changes sign, found by bisection; those that overlap are one."""
    where, side = samples.where, samples.rows.side
    (changes,) = np.nonzero(side[:-1] * side[1:] < 0)
    if not changes.size:
        return []
    low, high = where[changes], where[changes + 1]
    while np.max(high - low) > _APART:
        middle = 0.5 * (low + high)
        before = track.rows_at(middle).side == side[changes]
        low, high = np.where(before, middle, low), np.where(before, high, middle)
    places = 0.5 * (low + high)
    # Where the walk had to leap, the curves turn into each other: ten times as far away by a twentieth at most.
    wide = np.where(where[changes + 1] - where[changes] > 4 * CROSSING, 10 * CROSSING, CROSSING)
    starts, ends = np.maximum(places - wide, where[0]), np.minimum(places + wide, where[-1])
    groups = np.cumsum(np.append(True, starts[1:] > ends[:-1]))
    zones = []
    for group in np.unique(groups):
        mine = np.flatnonzero(groups == group)
        edges = np.array([starts[mine[0]], ends[mine[-1]]])
        zones.append(_Zone(float(np.mean(places[mine])), edges, track.rows_at(edges)))
    return zones


def _outside(zones: Sequence[_Zone], samples: _Samples, *, with_ends: bool = False) -> _Samples:
    """The samples that are in no zone; the zones' ends themselves are."""
    apart = np.ones(len(samples.where), bool)
    for zone in zones:
        inside = (samples.where >= zone.ends[0]) & (samples.where <= zone.ends[1])
        apart &= ~inside if with_ends else ~inside | np.isin(samples.where, zone.ends)
    kept = _Samples(samples.where[apart], some_of(samples.rows, apart))
    return _merged(kept, *(_Samples(zone.ends, zone.rows) for zone in zones)) if with_ends else kept


def _merged(*parts: _Samples) -> _Samples:
    where = np.concatenate([part.where for part in parts])
    order = np.argsort(where, kind="stable")
    return _Samples(where[order], some_of(joined(*(part.rows for part in parts)), order))


# --- extrema between points

# Rounds in which an extremum is looked for between points, by parabolas.
_VERTICES = 5


def _with_extrema(track: _Track, samples: _Samples) -> _Samples:
    """The samples, and more about every extremum between them that may reach beyond a value that is tested: two changes
    of sign within a step would else not be seen.
    """
    symmetry = track.problem.symmetry
    measure = _measure(samples.rows, symmetry)
    ranged = [test for test in _tests(symmetry) if test.kind.startswith(("above", "below", "resonance"))]
    levels = np.arcsinh([-float(test.value(samples.rows, 0 * measure)[0]) for test in ranged])
    triples = []
    for function, targets in (
        (lambda rows: np.arcsinh(_measure(rows, symmetry)), levels),
        (lambda rows: rows.tangent[:, 0], np.zeros(1)),
        (lambda rows: rows.energy_slope, np.zeros(1)),
    ):
        h = function(samples.rows)
        before, here, after = h[:-2], h[1:-1], h[2:]
        highest, lowest = (here >= before) & (here >= after), (here <= before) & (here <= after)
        sense = np.where(highest, 1.0, np.where(lowest, -1.0, 0.0))
        (near,) = np.nonzero(
            (sense != 0) & (_in_reach(h, sense, targets) | _in_reach(np.sinh(h), sense, np.sinh(targets)))
        )
        triples += [(function, samples.where[i : i + 3].copy(), h[i : i + 3] * sense[i], sense[i]) for i in near]
    more = []
    for _ in range(_VERTICES if triples else 0):
        spots = np.array([_vertex(place, height) for _, place, height, _ in triples])
        rows = track.rows_at(spots)
        more.append(_Samples(spots, rows))
        for j, (function, place, height, sense) in enumerate(triples):
            _narrow(place, height, spots[j], sense * function(some_of(rows, slice(j, j + 1)))[0])
    return _merged(samples, *more)


def _in_reach(h: np.ndarray, sense: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Of points between two others, the highest or lowest of the three: whether the function may get to a target.

    A parabola's vertex lies beyond the highest of three even points by an eighth of their range at most.
    """
    before, here, after = h[:-2], h[1:-1], h[2:]
    with np.errstate(invalid="ignore"):  # beyond any float
        room = 0.5 * np.maximum(np.abs(before - here), np.abs(after - here))
        beyond = sense[:, None] * (targets - here[:, None])
        return np.asarray(np.any((beyond >= 0) & (beyond <= room[:, None]), axis=1))


def _vertex(place: np.ndarray, height: np.ndarray) -> float:
    """Where the parabola through three points, the middle one the highest, is highest; not on one of them."""
    left, right = place[1] - place[0], place[2] - place[1]
    fall_left, fall_right = (height[1] - height[0]) / left, (height[1] - height[2]) / right
    total = fall_left + fall_right
    shift = 0.5 * (fall_left * right - fall_right * left) / total if total > 0 else 0.0
    if abs(shift) < 1e-3 * min(left, right):
        shift = 1e-3 * (right if right > left else -left)
    return float(np.clip(place[1] + shift, place[0] + 1e-3 * left, place[2] - 1e-3 * right))


def _narrow(place: np.ndarray, height: np.ndarray, spot: float, top: float) -> None:
    """The three points about the maximum, when `spot` is known too."""
    points = np.append(place, spot)
    heights = np.append(height, top)
    order = np.argsort(points)
    middle = int(np.clip(np.argmax(heights[order]), 1, 2))
    place[:], height[:] = points[order][middle - 1 : middle + 2], heights[order][middle - 1 : middle + 2]


# --- where tests change sign


class _Change(NamedTuple):
    """A stretch of a curve, at both ends of which a test's sign is certain, and not the same."""

    test: _Test
    low: float
    high: float
    at_low: float
    at_high: float


def _changes(problem: Problem, samples: _Samples) -> list[_Change]:
    tests = _tests(problem.symmetry)
    changes = []
    for test, value, error in zip(tests, *_values(tests, problem, samples.rows), strict=True):
        (certain,) = np.nonzero((np.abs(value) > error) & (samples.rows.converged > 0))
        (turns,) = np.nonzero((value[certain][:-1] < 0) != (value[certain][1:] < 0))
        for i, j in zip(certain[turns], certain[turns + 1], strict=True):
            changes.append(_Change(test, *samples.where[[i, j]].tolist(), *value[[i, j]].tolist()))
    return changes


class _Spot(NamedTuple):
    """A special point to be: its kind, arclength, what that is known to, the row, the slope of c (of brake orbits
    kappa) with arclength, and what branches off.
    """

    kind: str
    where: float
    error: float
    row: Corrected
    steepness: float
    branch: tuple[str, int] | None


def _located(track: _Track, changes: Sequence[_Change], zones: Sequence[_Zone]) -> list[_Spot]:
    """Where the tests vanish; across a zone, by the secant through values that the other curve does not disturb."""
    across = [next((z for z in zones if z.holds(change.low, change.high)), None) for change in changes]
    solved = [i for i, zone in enumerate(across) if zone is None]
    spots: list[_Spot] = []
    if solved:
        mine = [changes[i] for i in solved]
        where, rows = _roots(track, mine)
        errors, slopes = _location_errors(track, mine, where, rows)
    for i, (change, zone) in enumerate(zip(changes, across, strict=True)):
        if zone is None:
            j = solved.index(i)
            place, error, row = float(where[j]), float(errors[j]), some_of(rows, slice(j, j + 1))
            slope = float(slopes[j])
        else:
            width = change.high - change.low
            place = change.low + width * change.at_low / (change.at_low - change.at_high)
            inside = min(max(place, float(zone.ends[0])), float(zone.ends[1]))
            place, row = inside, zone.row_at(track.problem, inside)
            error = max(place - change.low, change.high - place)
            slope = zone.steepness(track.problem)
        spots.append(_Spot(change.test.kind, place, error, row, slope, change.test.branch))
    return spots


# A root is located when the value is below this share of its error, or below its error and the step below the second
# [arclength], or when there are no numbers between.
_ENOUGH, _LOCATED = 0.1, 1e-12
_ROUNDS = 60


def _own_values(track: _Track, changes: Sequence[_Change], rows: Corrected) -> tuple[np.ndarray, np.ndarray]:
    """Of each change its test at its own point: the value, and what it is known to."""
    values, errors = _values([change.test for change in changes], track.problem, rows)
    return np.diagonal(values).copy(), np.diagonal(errors).copy()


def _roots(track: _Track, changes: Sequence[_Change]) -> tuple[np.ndarray, Corrected]:
    """Where the tests vanish, and the rows there.

    Newton's method on the family's equations together with the test's: each point is corrected onto the curve, and the
    step along it is the secant's, kept inside its bracket (Illinois).
    """
    low, high, at_low, at_high = (np.array([change[k] for change in changes]) for k in (1, 2, 3, 4))
    where, value, error, last = (np.full(len(changes), start) for start in (np.inf, np.inf, 0.0, 0.0))
    positive = at_low > 0
    going = np.arange(len(changes))
    rows: Corrected | None = None
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
            new = track.rows_at(where[going], some_of(rows, going))
            for column, part in zip(rows, new, strict=True):
                column[going] = part
        mine = [changes[j] for j in going.tolist()]
        value[going], error[going] = _own_values(track, mine, some_of(rows, going))
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
    track: _Track, changes: Sequence[_Change], where: np.ndarray, rows: Corrected
) -> tuple[np.ndarray, np.ndarray]:
    """How far from a root its test's sign is certain, on both sides, by looking; and the slope of c between."""
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
            beside = track.rows_at(spot, some_of(rows, going))
            value, noise = _own_values(track, mine, beside)
            certain &= (spot == end[going]) | (value * sign[going] > noise)
            seen.append((spot, _measure(beside, track.problem.symmetry)))
        (left, before), (right, after) = seen
        slope[going] = (after - before) / (right - left)
        width[going] = np.where(certain, width[going], _WIDER * width[going])
        going = going[~certain]
    return np.minimum(width, np.maximum(where - low, high - where)), slope


# --- what is told of them

# c, of brake orbits kappa, is known to this where a resonance, or a window of stability between two points, is told.
_KNOWN = 1e-4


def _told(
    changes: Sequence[_Change], spots: Sequence[_Spot], crossings: Sequence[_Spot], where: np.ndarray, problem: Problem
) -> list[_Spot]:
    """The special points: what is too near to a crossing to be told from it is not, but for a change that lasts."""
    told, bounds = [], []
    folds = [spot for spot in spots if spot.kind == "fold_energy"]
    for change, spot in zip(changes, spots, strict=True):
        if spot.kind in ("above", "below"):
            kind = "stability_lost" if (change.at_low < 0) == (spot.kind == "above") else "stability_gained"
            anchors = [*(folds if spot.kind == "above" else ()), *crossings]
            bounds.append(_anchored(spot, anchors, problem.symmetry)._replace(kind=kind))
        elif spot.kind.startswith("fold") or (_is_known(spot, problem.symmetry) and not _overlaps(spot, crossings)):
            told.append(spot)
    return told + _known_windows(sorted(bounds, key=lambda spot: spot.where), where, problem.symmetry)


def _is_known(spot: _Spot, symmetry: str) -> bool:
    return bool(_measure_error(spot.row, symmetry)[0] < _KNOWN)


def _overlaps(spot: _Spot, crossings: Sequence[_Spot]) -> bool:
    return any(abs(spot.where - other.where) <= spot.error + other.error for other in crossings)


def _anchored(spot: _Spot, anchors: Sequence[_Spot], symmetry: str) -> _Spot:
    """A change of stability, at the first place within its error that is known better and where c is as it says.

    Where the energy turns back along a family, c - 1 vanishes, too; at a crossing often with several derivatives, so
    that c alone would not tell where.
    """
    target = 1.0 if spot.kind == "above" else -1.0
    for other in anchors:
        off, error = _measure(other.row, symmetry)[0] - target, _measure_error(other.row, symmetry)[0]
        if other.error <= spot.error and abs(other.where - spot.where) <= spot.error and abs(off) <= error:
            return other._replace(kind=spot.kind, branch=spot.branch)
    return spot


def _known_windows(bounds: list[_Spot], where: np.ndarray, symmetry: str) -> list[_Spot]:
    """Changes of stability, without those that take each other back between two points if c is not known there."""
    kept: list[_Spot] = []
    for spot in bounds:
        before = kept[-1] if kept and not _is_known(spot, symmetry) else None
        if before is not None and np.searchsorted(where, before.where) == np.searchsorted(where, spot.where):
            kept.pop()
        else:
            kept.append(spot)
    return kept


def _special(problem: Problem, spot: _Spot) -> SpecialPoint:
    both = _orbits(problem, spot.row), _slopes(problem, spot.row)
    orbit, slopes = jax.tree.map(lambda leaf: leaf[0], both)
    errors = spot.error, _kappa_error(spot, problem.symmetry)
    return SpecialPoint(spot.where, orbit, slopes, errors, spot.kind, _Place(problem, spot.row), spot.branch)


# --- where families begin --------------------------------------------------------------------------------------------


def follow_family(
    pendulum: Pendulum | Any,
    start: "str | PeriodicOrbit | SpecialPoint | Any",
    *,
    longest_step: float | Any = _LONGEST_STEP,
    longest_period: float | Any = math.inf,
    most_points: int | Any = _MOST_POINTS,
) -> Family:
    """The family of periodic orbits that `start` belongs to, from end to end.

    Pseudo-arclength continuation of orbits by multiple shooting, folds passed: a step is taken back if Newton's method
    contracts slowly, the tangent turns by more than 18 degrees, or the bordered Jacobian's determinant changes sign,
    which would be a jump to another curve. The family ends where the energy comes within 1e-8 of that of an equilibrium
    with a rod upright (in units of the weights' torques; the period then grows like its logarithm), where it is back at
    its beginning, or at the hanging pendulum.

    Arguments:
        pendulum: the derivatives of its leaves, if they carry any, reach what `Family.at` returns; `jit` around this
            does not work.
        start: `in-phase` or `anti-phase`, the family of a normal mode; or an orbit, from which its family is followed
            in both directions; or a special point, for the branch that leaves there: at a loss or gain of stability of
            centred orbits with c = 1 the orbits with x(T/2) = -x(0) that are no longer released from rest, with c = -1
            those released from rest that are no longer centred, at a resonance the brake orbits of k times the period.
        longest_step: in arclength; the default gives about a hundred points.
        longest_period: [s]; the family is followed to its first orbit of this period.
        most_points: on one side of the start.
    Raises:
        ValueError: an unknown name; g not positive; an orbit of another pendulum, or that has not converged; a special
            point where nothing branches off, or only orbits (c = -1 in half of the cases) that are centred no longer
            and never rest; longest_period below the period of the first orbit.
        RuntimeError: float64 is switched off in JAX.
    See also: Doedel, Keller and Kernevez, Numerical analysis and control of bifurcation problems (1991); Peeters et
        al., Nonlinear normal modes II, Mechanical Systems and Signal Processing 23 (2009).
    """
    require_float64()
    fixed = _primal(pendulum)
    if not isinstance(start, (str, PeriodicOrbit, SpecialPoint)):
        raise ValueError(
            f"start must be one of {', '.join(BRANCHES)}, an orbit or a special point, got {type(start).__name__}: "
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
            raise ValueError(f"start must be one of {', '.join(BRANCHES)}, or an orbit, got {start!r}: give one")
        return _from_mode(Problem(pendulum, scaled, "centred", (0.0, 0.0)), start, reach)
    if isinstance(start, SpecialPoint):
        return _from_branch_point(pendulum, start, reach)
    return _from_orbit(pendulum, scaled, start, reach)


def _primal(pendulum: Any) -> Pendulum:
    """The numbers behind a pendulum, also under eager differentiation, whose derivatives `Family.at` carries on.

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


_beginning = jax.jit(beginning)


def _from_mode(problem: Problem, branch: str, reach: Reach) -> Family:
    start = jax.tree.map(np.asarray, _beginning(problem.natural, branch == "in-phase"))
    rows, end = problem.followed(start, None, reach)
    if not len(rows.point):
        raise _too_short(reach)
    curve = curve_of(rows)
    points, tangents = np.vstack([start.point, curve.points]), np.vstack([start.tangent, curve.tangents])
    curve = Curve(points, tangents, np.append(start.steps, curve.steps))
    return _family(problem, rows, curve, ("normal mode", end))


def _too_short(reach: Reach) -> ValueError:
    return ValueError(
        f"longest_period must be longer than the period of the first orbit, got {reach.period:g} sqrt(l1/g): give a "
        "longer one"
    )


def _from_orbit(pendulum: Pendulum, scaled: Pendulum, orbit: PeriodicOrbit, reach: Reach) -> Family:
    fixed = _primal(pendulum)
    if np.shape(orbit.period):
        raise ValueError(
            f"start must be a single orbit, got one with shape {np.shape(orbit.period)}: choose one of them"
        )
    status = known_value(orbit.status)
    if status is None:
        raise ValueError("start must be known, not traced by jit: find it outside")
    if status != Status.CONVERGED:
        raise ValueError(f"start must have converged, got status {Status(int(status)).name.lower()}")
    orbit = jax.tree.map(known_value, orbit)
    mine = jax.tree.leaves(orbit.pendulum)
    if not np.allclose(mine, jax.tree.leaves(fixed), rtol=1e-12):
        raise ValueError(f"start must be an orbit of this pendulum, got one of {orbit.pendulum}")
    second = math.sqrt(fixed.l1 / fixed.g)
    momentum = fixed.m1 * fixed.l1**2 / second
    state, dual = (
        np.array([x.theta1, x.theta2, x.p1 / momentum, x.p2 / momentum], np.float64) for x in (orbit.state, orbit.dual)
    )
    turns = {"centred": np.array(orbit.turns, np.float64), "odd": np.round((state + dual)[:2] / (2 * np.pi))}
    symmetry = orbit.symmetry
    full = turns.get(symmetry, np.zeros(2))
    problem = Problem(pendulum, scaled, symmetry, (float(full[0]), float(full[1])))
    if orbit.period / second > reach.period * (1 + 1e-12):
        raise _too_short(reach)
    duration = float(orbit.period) / second / PARTS[symmetry]
    point = laid_out(problem, np.zeros(1), state[None], duration)
    rows = problem.on_curve(point)
    if rows is None or np.linalg.norm(way_to(rows.point[0, :2], state[:2])) > _SAME_ORBIT:
        raise ValueError("start must be an orbit whose motion is still known at the end of its arc: give another one")
    return _both_ways(problem, rows, reach)


# How far the corrected start may be from the orbit that was given [rad].
_SAME_ORBIT = 1e-5


def _both_ways(problem: Problem, rows: Corrected, reach: Reach) -> Family:
    """The family through a point, in both directions unless it is closed."""
    first = min(FIRST_STEP, reach.step)
    start = begun(rows.point[0], rows.tangent[0], first, rows.steps[0])
    ahead, end = problem.followed(start, rows, reach)
    if end == "closed":
        return _closed(problem, rows, ahead)
    behind, begin = problem.followed(start._replace(tangent=-start.tangent), rows, reach)
    whole, ends, here = joined(turned(behind), rows, ahead), (begin, end), len(behind.point)
    if problem.symmetry == "brake":
        whole, ends = without_its_image(whole, ends, here)
    return _family(problem, whole, curve_of(whole), ends)


def _closed(problem: Problem, start: Corrected, ahead: Corrected) -> Family:
    """A curve that comes back to its beginning: to the same rest, which is then its last point too, or to the other."""
    rows, ends = joined(start, ahead), ("closed", "closed")
    if problem.symmetry == "brake" and (half := half_of_closed(rows)) is not None:
        rows, ends = half, ("branch point", "branch point")
    elif np.sqrt(np.sum(METRIC * (ahead.point[-1] - start.point[0]) ** 2)) < 2 * curve_of(rows).lengths[-1]:
        rows = joined(rows, start)
    return _family(problem, rows, curve_of(rows), ends)


def _family(problem: Problem, rows: Corrected, curve: Curve, ends: tuple[str, str]) -> Family:
    arclength = np.concatenate([[0.0], np.cumsum(curve.lengths)])
    points = _special_points(problem, rows, curve, arclength)
    status = Status.CONVERGED
    if "unfinished" in ends:
        status = Status.MAX_ITERATIONS
    if "lost" in ends:
        status = Status.LEFT_BRANCH
    return Family(
        orbits=jax.tree.map(jnp.asarray, _orbits(problem, rows)),
        arclength=jnp.asarray(arclength[len(arclength) - len(rows.point) :]),
        slopes=jax.tree.map(jnp.asarray, _slopes(problem, rows)),
        special_points=tuple(points),
        status=jnp.asarray(int(status)),
        ends=ends,
        _curve=curve,
        _problem=problem,
    )


# At a fold in energy stability changes, too, and no other family is there: slopes below this are zero.
_FLAT = 1e-5


def _from_branch_point(pendulum: Pendulum, special: SpecialPoint, reach: Reach) -> Family:
    if special._branch is None:
        raise ValueError(f"start must be a point where a family branches off, got {special.kind}: follow its orbit")
    symmetry, k = special._branch
    base = special._place
    if special.kind.startswith("stability") and abs(float(base.rows.energy_slope[0])) < _FLAT:
        raise ValueError(f"start must be a point where a family branches off, got {special.kind} at a fold in energy")
    half = float(base.rows.times[0].sum()) * PARTS[base.problem.symmetry] / 2
    duration = k * half * 2 / PARTS[symmetry]
    turns = base.problem.turns if symmetry != "brake" else (0.0, 0.0)
    problem = Problem(pendulum, base.problem.natural, symmetry, turns)
    point = laid_out(problem, *repeated(base.problem, base.rows, k), duration)
    sides = []
    for sign in (1.0, -1.0):
        rows = problem.onto_branch(base.rows, point, sign)
        if rows is None:
            # At c = -1 either C loses rank, and orbits at rest branch off, or B vanishes, and they pass through
            # theta in {0, pi}^2 at T/4 and at 3 T/4 without ever resting.
            why = "whose orbits are never at rest" if (symmetry, k) == ("brake", 1) else "without one nearby"
            raise ValueError(
                f"start must be a point where a family that can be followed branches off, got {special.kind} {why}"
            )
        if problem.period(rows)[0] > reach.period:
            raise _too_short(reach)
        start = begun(rows.point[0], rows.tangent[0], min(FIRST_STEP, reach.step), rows.steps[0])
        ahead, end = problem.followed(start, rows, reach)
        if end == "closed":
            return _closed(problem, rows, ahead)
        sides.append((joined(rows, ahead), end))
        if symmetry != "centred":
            break  # the other side holds the same orbits, at their other rest or in the mirror
    (one, end), other = sides[0], sides[1:]
    if other:
        rows = joined(turned(other[0][0]), one)
        return _family(problem, rows, curve_of(rows), (other[0][1], end))
    return _family(problem, one, curve_of(one), ("branch point", end))
