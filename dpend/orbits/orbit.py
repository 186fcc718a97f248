"""`PeriodicOrbit`, and how one is made from a root: units, outcome, derivatives."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from dpend.checks import Scalar, known_value, shown
from dpend.mechanics.pendulum import Pendulum, State
from dpend.motion.trajectory import TOLERANCE, Trajectory
from dpend.orbits.arc import PARTS, state_halfway
from dpend.orbits.follow import FamilyProblem
from dpend.orbits.implicit import (
    ArcGiven,
    Known,
    arc_equations,
    implicit,
    know_solved,
    parameters_of,
)
from dpend.orbits.newton import Solved
from dpend.orbits.path import unfold
from dpend.orbits.stability import OPPOSITE, stability_class
from dpend.records import Quantities, frame, html, outcome, quantities, span, variables
from dpend.status import Status

_EPS = float(np.finfo(np.float64).eps)
BRANCHES = ("in-phase", "anti-phase")
# The families of the normal modes, and of the equilibria with one rod upright.
FAMILIES = (*BRANCHES, "down-up", "up-down")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PeriodicOrbit:
    """A periodic orbit, or many of one shape.

    Attributes:
        pendulum: its pendulum.
        state: at t = 0: at rest if centred or brake, where theta1 is at an extreme if odd, in {0,
            pi}^2 if passing, where the potential energy is at an extreme if without symmetry.
        period: the minimal one [s].
        energy: H [J], zero for both bobs at rest at the pivot's height.
        residual: the largest of the equations solved. From a guess: angles at T/4 [rad] if centred,
            else momenta at T/2 in units of m2 l2 sqrt(g l2). On a branch or a family: of all
            segments, in units of l1, m1 and g.
        iterations: Newton iterations spent on it, each one integration with its Jacobian and one
            linear solve; on a branch those of the walk's last step and those at the wanted release.
        kappa: half the sum of the two non-trivial Floquet multipliers.
        log_abs_kappa: log |kappa|, natural.
        dual: the state at T/2, the other rest of the orbit if it has one.
        turns: theta(T/4)/pi of a centred orbit, two integers; the full turns of both rods in a
            period of one that is passing or without symmetry; zeros otherwise.
        error_estimate: of theta2 [rad] (of theta1 with `ratio`) and the period [s], theta1 taken as
            it is: the change on solving again at half the step, and what the rounding of the motion
            makes of them; NaN if that was not asked for. Without symmetry, and of a passing orbit,
            the energy is taken as it is instead; of a passing orbit the first is of the direction
            in which it starts, the angle phi of p = L (cos phi, sin phi) sqrt(2 K), L L^T being the
            inertia and K the kinetic energy.
        status: a value of `Status`.
        symmetry: `centred` (theta(T/4) in {0, pi}^2 modulo 2 pi), `brake` (any other released from
            rest), `odd` (x(T/2) = -x(0) up to full turns, never at rest), `passing` (theta in {0,
            pi}^2 at 0 and T/2, never at rest) or `none`.
    """

    pendulum: Pendulum
    state: State
    period: Annotated[Scalar, "s"]
    energy: Annotated[Scalar, "J"]
    residual: Scalar
    iterations: Scalar
    kappa: Scalar
    log_abs_kappa: Scalar
    dual: State
    turns: tuple[Scalar, Scalar]
    error_estimate: Annotated[tuple[Scalar, Scalar], {"theta2": "rad", "period": "s"}]
    status: Scalar
    symmetry: str = field(metadata={"static": True})

    @property
    def theta1(self) -> Scalar:
        """The release angle of the upper rod [rad]."""
        return self.state.theta1

    @property
    def theta2(self) -> Scalar:
        """The release angle of the lower rod [rad], its partner."""
        return self.state.theta2

    @property
    def stability(self) -> Any:
        """`elliptic`, `hyperbolic` or `inverse hyperbolic`; of many orbits an array of these."""
        if not np.ndim(self.kappa):
            return stability_class(float(self.kappa))
        kappas = np.asarray(self.kappa)
        return np.array([stability_class(one) for one in kappas.ravel()]).reshape(kappas.shape)

    def trajectory(
        self, times: Any | None = None, *, tolerance: float | Any = TOLERANCE
    ) -> Trajectory:
        """The motion of a single orbit at `times`, any number of periods on or back.

        It never parts from the orbit, however unstable that is: it starts anew from the states at
        t = 0 and T/2, and each piece lasts a quarter of the period.

        Arguments:
            times: [s], shape (n,), in any order; by default 301 over one period, whose last state
                is the first (up to full turns).
            tolerance: wanted error of the angles in a quarter of the period [rad], the orbit's
                states and period taken as they are.
        Returns:
            Trajectory of NumPy arrays. Its status is that of the first piece that failed.
        Raises:
            ValueError: many orbits, or one that was not found; times not finite; tolerance not
                positive.
        """
        if np.ndim(self.period) or not np.isfinite(period := float(self.period)):
            raise ValueError(
                f"orbit must be a single one that was found, got a period of "
                f"{shown(self.period)}: take one of them"
            )
        pendulum, *starts = (
            jax.tree.map(float, each) for each in (self.pendulum, self.state, self.dual)
        )
        # Of a centred orbit `turns` tells of the quarter; it comes back without any.
        moving = self.symmetry in ("passing", "none")
        turns = [int(turn) * moving for turn in self.turns]
        return unfold(pendulum, (starts[0], starts[1]), period, turns, times, tolerance)

    def __len__(self) -> int:
        """How many orbits there are along the first axis."""
        if not np.ndim(self.period):
            raise TypeError("a single orbit has no length")
        return int(np.shape(self.period)[0])

    def __bool__(self) -> bool:
        return True

    def __getitem__(self, index: Any) -> "PeriodicOrbit":
        """Some of many orbits, as NumPy's indices choose them; `orbits[3]` is a single one."""
        shape = np.shape(self.period)
        if not shape:
            raise TypeError("a single orbit cannot be indexed")

        def choose(leaf: Any) -> Any:
            return (jnp if isinstance(leaf, jax.Array) else np).broadcast_to(leaf, shape)[index]

        return jax.tree.map(choose, self)

    def __iter__(self) -> Iterator["PeriodicOrbit"]:
        return (self[i] for i in range(len(self)))

    def to_dataframe(self) -> Any:
        """A row for each orbit, with the names and the units of files: angles in degrees."""
        return frame(orbit_quantities(self))

    def to_xarray(self) -> Any:
        """The orbits as an `xarray.Dataset` over `orbit`: radians and SI units, the angles in
        degrees as coordinates.
        """
        import xarray

        data, degrees = variables(orbit_quantities(self), "orbit")
        return xarray.Dataset(data, degrees)

    def __repr__(self) -> str:
        many = f"{'x'.join(map(str, np.shape(self.period)))} " if np.ndim(self.period) else ""
        angles = (span(name, getattr(self, name), "rad") for name in ("theta1", "theta2"))
        told = ", ".join((*angles, span("period", self.period, "s"), span("kappa", self.kappa)))
        return f"<PeriodicOrbit: {many}{self.symmetry}, {told}, {outcome(self.status)}>"

    _repr_html_ = html


def orbit_quantities(orbits: PeriodicOrbit) -> Quantities:
    """All that is known of orbits, of each one a row: what a table of them has as columns."""
    shape, rows = np.shape(orbits.period), int(np.size(orbits.period))
    flat = jax.tree.map(lambda leaf: np.broadcast_to(np.asarray(leaf), shape).ravel(), orbits)
    names = "period energy kappa log_abs_kappa residual iterations status stability"
    dual = {f"dual_{name}": column for name, column in quantities(flat.dual).items()}
    parts = {
        "theta2_error": (flat.error_estimate[0], "rad"),
        "period_error": (flat.error_estimate[1], "s"),
        "turns1": (flat.turns[0], ""),
        "turns2": (flat.turns[1], ""),
        "symmetry": (np.full(rows, orbits.symmetry), ""),
    }
    return (
        quantities(flat.state) | quantities(flat, names) | parts | dual | quantities(flat.pendulum)
    )


def mirrored(orbit: PeriodicOrbit, sign: Scalar) -> PeriodicOrbit:
    """The mirror image x -> -x where `sign`, of the leaves' shape, is -1."""
    state, dual = (jax.tree.map(lambda leaf: sign * leaf, x) for x in (orbit.state, orbit.dual))
    turns = (sign.astype(int) * orbit.turns[0], sign.astype(int) * orbit.turns[1])
    return replace(orbit, state=state, dual=dual, turns=turns)


class Outcome(NamedTuple):
    """How a solve went.

    Attributes:
        residual, iterations, status: see `PeriodicOrbit`.
        angle_error, time_error: of the unknown angle [rad] and of the period, relative.
    """

    residual: Any
    iterations: Any
    angle_error: Any
    time_error: Any
    status: Any


def outcome_of(rows: Solved, status: Any, xp: Any) -> Outcome:
    """How points on a family were solved; no error is below the last place of its number."""
    return Outcome(
        residual=rows.residual,
        iterations=rows.iterations.astype(int),
        angle_error=xp.maximum(rows.angle_error, _EPS * xp.abs(rows.point[..., 1])),
        time_error=xp.maximum(rows.time_error, _EPS),
        status=status,
    )


def orbit_in_units(
    pendulum: Pendulum, known: Known, turns: Any, symmetry: str, outcome: Outcome, xp: Any = jnp
) -> PeriodicOrbit:
    """The orbit in SI units of which this is known in natural units.

    Arguments:
        xp: NumPy where many orbits are known as numbers: eager JAX would compile each operation for
            each number of orbits.
    """
    second = xp.sqrt(pendulum.l1 / pendulum.g)
    momentum = pendulum.m1 * pendulum.l1**2 / second
    state = State(known.theta1, known.theta2, momentum * known.p1, momentum * known.p2)
    dual = State(known.end1, known.end2, 0.0 - state.p1, 0.0 - state.p2)
    if symmetry in OPPOSITE:
        angles = 2 * np.pi * turns[0] - state.theta1, 2 * np.pi * turns[1] - state.theta2
        dual = replace(dual, theta1=angles[0], theta2=angles[1])
    elif symmetry != "brake":
        dual = replace(dual, p1=momentum * known.end_p1, p2=momentum * known.end_p2)
    whole = turns if symmetry in ("centred", "none") else 0 * turns
    if symmetry == "passing":
        centre = xp.nan_to_num(xp.round(xp.stack([state.theta1, state.theta2]) / np.pi))
        whole = [turns[0] - centre[0], turns[1] - centre[1]]
    one = xp.ones_like(known.time)
    period = PARTS[symmetry] * second * known.time
    return PeriodicOrbit(
        pendulum=jax.tree.map(lambda leaf: leaf * one, pendulum),
        state=state,
        period=period,
        energy=pendulum.m1 * pendulum.g * pendulum.l1 * known.energy,
        residual=outcome.residual,
        iterations=outcome.iterations,
        kappa=known.kappa,
        log_abs_kappa=known.log_abs_kappa,
        dual=dual,
        turns=((whole[0] * one).astype(int), (whole[1] * one).astype(int)),
        error_estimate=(outcome.angle_error, outcome.time_error * _constant(period)),
        status=outcome.status,
        symmetry=symmetry,
    )


def _constant(value: Any) -> Any:
    """The value without its derivatives."""
    return value if isinstance(value, np.ndarray) else lax.stop_gradient(value)


_halfway = jax.jit(state_halfway)


class Slopes(NamedTuple):
    """Derivatives with respect to arclength: finite at folds too, where those with respect to
    theta1 are not.

    Attributes:
        theta1, theta2: of the release.
        period: [s].
        energy: [J].
    """

    theta1: Scalar
    theta2: Scalar
    period: Scalar
    energy: Scalar


class Held(NamedTuple):
    """What orbits were solved for, which everything else of them is a function of.

    Attributes:
        name: `theta1`, `energy` or `period`.
        targets: its values in natural units (of the period the log of the arc's time), shape (n,).
        rows: of theta1 the covectors, shape (n, D).
    """

    name: str
    targets: Any
    rows: Any


@partial(jax.jit, static_argnames=("symmetry", "held"))
def _carry(
    pendulum: Pendulum, targets: Array, values: tuple, given: ArcGiven, symmetry: str, held: str
) -> Array:
    """What is known, as a function of the pendulum and the targets."""
    equations = arc_equations(symmetry, held)

    def one(values: tuple, parameters: Array, row: Array, steps: Array) -> Array:
        here = ArcGiven(row, steps, given.turns)
        return jnp.asarray(implicit(equations, values, parameters, here)[1])

    return jax.vmap(one)(values, parameters_of(pendulum, targets), given.row, given.steps)


def orbits_of(problem: FamilyProblem, rows: Solved, held: Held | None = None) -> PeriodicOrbit:
    """Points as orbits; where it is told what was held, everything carries derivatives."""
    known, turns = know_solved(rows, problem.symmetry, np), np.asarray(problem.turns)
    status = np.where(rows.converged > 0, int(Status.CONVERGED), int(Status.MAX_ITERATIONS))
    outcome = outcome_of(rows, status, np)
    if problem.symmetry == "none":
        known[:, 4:8] = [_halfway(problem.natural, point) for point in rows.point]
    if held is None:
        pendulum = jax.tree.map(known_value, problem.pendulum)
        return orbit_in_units(pendulum, Known(*known.T), turns, problem.symmetry, outcome, np)
    given, values = ArcGiven(held.rows, rows.steps, jnp.asarray(turns)), (rows.point, known)
    known = _carry(problem.pendulum, held.targets, values, given, problem.symmetry, held.name)
    return orbit_in_units(problem.pendulum, Known(*known.T), turns, problem.symmetry, outcome)


def slopes_of(problem: FamilyProblem, rows: Solved) -> Slopes:
    """The derivatives with respect to arclength of points as orbits."""
    pendulum = jax.tree.map(known_value, problem.pendulum)
    second = np.sqrt(pendulum.l1 / pendulum.g)
    return Slopes(
        rows.tangent[:, 0],
        rows.tangent[:, 1],
        PARTS[problem.symmetry] * second * rows.time_slope,
        pendulum.m1 * pendulum.g * pendulum.l1 * rows.energy_slope,
    )
