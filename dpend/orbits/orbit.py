"""`PeriodicOrbit`, and how it is made from a root: units, stability, derivatives by the implicit
function theorem.
"""

import math
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from dpend.checks import Scalar, known_value
from dpend.mechanics.pendulum import Pendulum, State, hamiltonian, released
from dpend.motion.integrate import moved, step_size
from dpend.orbits.arc import PARTS
from dpend.orbits.follow import Problem
from dpend.orbits.newton import Corrected, sensitivities
from dpend.orbits.single import FINE, RK8, Line, LineNewton, clock, rate_along, steps_for
from dpend.orbits.stability import stability_class, stability_of, transition
from dpend.status import Status

BRANCHES = ("in-phase", "anti-phase")
RELEASED_SYMMETRIES = ("centred", "brake")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PeriodicOrbit:
    """A periodic orbit, released from rest unless it is `odd`, or many of one shape.

    Attributes:
        pendulum: its pendulum.
        state: at t = 0, at rest; of an odd orbit where theta1 is at an extreme.
        period: the minimal one [s].
        energy: H [J], zero for both bobs at rest at the pivot's height.
        residual: of the equations solved: angles at T/4 [rad] if centred, else momenta at T/2 in
            units of m2 l2 sqrt(g l2); the larger of the two. On a family the largest of all its
            segments' equations, in units of l1, m1 and g.
        iterations: Newton iterations spent on it, each one integration with its Jacobian and one
            linear solve; on a branch those of the walk's last step and those at the wanted release.
        kappa: half the sum of the two non-trivial Floquet multipliers.
        log_abs_kappa: log |kappa|, natural.
        dual: the state at T/2, the other rest of the orbit.
        turns: theta(T/4)/pi of a centred orbit, two integers; zeros otherwise.
        error_estimate: of theta2 [rad] (of theta1 with `ratio`) and the period [s], theta1 taken as
            it is: the change on solving again at half the step, and what the rounding of the motion
            makes of them; NaN if that was not asked for.
        status: a value of `Status`.
        symmetry: `centred` (theta(T/4) in {0, pi}^2 modulo 2 pi), `brake` (any other released from
            rest), or `odd` (x(T/2) = -x(0) up to full turns, never at rest; found by
            `follow_family`).
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
    def stability(self) -> str:
        """`elliptic`, `hyperbolic` or `inverse hyperbolic`, of a single orbit."""
        return stability_class(float(self.kappa))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def implicit_root(
    symmetry: str, root: Array, parameters: Array, direction: Array, steps: Array
) -> Array:
    """`root` = (x, log of the shooting time), whose value is known already, as a function of the
    parameters.

    F(root, parameters) = 0 gives d root = -(dF/d root)^-1 (dF/d parameters) d parameters. Both
    Jacobians are taken forwards and do not depend on the tangent, so that the rule can be
    transposed although the flow's loop cannot.

    Arguments:
        parameters: l1, l2, m1, m2, g and the line's base, shape (7,).
        steps: how many, as a float, since a rule's arguments need tangents.
    """
    return root


@implicit_root.defjvp
def _implicit_root_jvp(symmetry, primals, tangents):  # type: ignore[no-untyped-def]
    _, parameters, direction, steps = primals
    root = implicit_root(
        symmetry, *primals
    )  # by way of this rule, so that second derivatives know how the root moves

    def equations(both: Array) -> Array:
        (x, log_time), parameters = both[:2], both[2:]
        pendulum, time, count = Pendulum(*parameters[:5]), jnp.exp(log_time), steps.astype(int)
        start = released(*(parameters[5:] + x * direction))
        end = moved(RK8, pendulum, start, step_size(time, count), count)
        # Momenta without their unit: at a root the factor does not matter.
        return jnp.stack([end.theta1, end.theta2] if symmetry == "centred" else [end.p1, end.p2])

    jacobian = jax.jacfwd(equations)(jnp.concatenate([root, parameters]))
    return root, -jnp.linalg.solve(jacobian[:, :2], jacobian[:, 2:] @ tangents[1])


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _kappas(symmetry: str, value: Array, orbit: Array, steps: Array) -> Array:
    """`value` = (kappa, log |kappa|), known from the root's own integration, as a function of the
    orbit.

    Arguments:
        orbit: l1, l2, m1, m2, g, theta1, theta2 and the log of the shooting time, shape (8,).
    """
    return value


@_kappas.defjvp
def _kappas_jvp(symmetry, primals, tangents):  # type: ignore[no-untyped-def]
    _, orbit, steps = primals

    def again(orbit: Array) -> Array:
        count = steps.astype(int)
        dt = step_size(jnp.exp(orbit[7]), count)
        _, matrix = transition(Pendulum(*orbit[:5]), released(*orbit[5:7]), dt, count, RK8)
        return _kappas_of(symmetry, matrix)

    return _kappas(symmetry, *primals), jax.jacfwd(again)(orbit) @ tangents[1]


def _kappas_of(symmetry: str, matrix: Array) -> Array:
    """kappa and log |kappa| from the transition matrix over the shooting time."""
    return jnp.stack(stability_of(matrix[None], symmetry, jnp)[1:])


def orbit_at_root(
    pendulum: Pendulum,
    line: Line,
    newton: LineNewton,
    steps: Scalar,
    change: Array,
    turns: Array,
    symmetry: str,
    status: Scalar,
) -> PeriodicOrbit:
    """The orbit at a root; `pendulum` and `line` carry derivatives, the root itself has none
    yet.
    """
    pack = [jnp.asarray(leaf, jnp.float64) for leaf in jax.tree.leaves(pendulum)]
    steps = steps.astype(jnp.float64)
    root = jnp.stack([newton.x, newton.log_time])
    x, log_time = implicit_root(
        symmetry, root, jnp.stack([*pack, *line.base]), line.direction, steps
    )
    theta1, theta2 = line.base + x * line.direction
    state = released(theta1, theta2)
    known = _kappas_of(symmetry, newton.shot.matrix)
    kappa, log_abs_kappa = _kappas(
        symmetry, known, jnp.stack([*pack, theta1, theta2, log_time]), steps
    )
    if symmetry == "centred":
        dual = released(2 * jnp.pi * turns[0] - theta1, 2 * jnp.pi * turns[1] - theta2)
        residual = jnp.max(jnp.abs(newton.shot.value))
    else:
        dual = released(newton.shot.end.theta1, newton.shot.end.theta2)
        residual = jnp.max(jnp.abs(newton.shot.value)) * jnp.exp(newton.log_time) * clock(pendulum)
    return PeriodicOrbit(
        pendulum=pendulum,
        state=state,
        period=PARTS[symmetry] * jnp.exp(log_time),
        energy=hamiltonian(pendulum, state),
        residual=lax.stop_gradient(residual),
        iterations=newton.iterations,
        kappa=kappa,
        log_abs_kappa=log_abs_kappa,
        dual=dual,
        turns=(turns[0].astype(int), turns[1].astype(int)),
        error_estimate=(change[0], change[1]),
        status=status,
        symmetry=symmetry,
    )


@jax.jit
def slopes(orbit: PeriodicOrbit) -> Float[Array, "4 6"]:
    """Derivatives of what is known of a centred orbit by the implicit function theorem, without
    solving it again.

    Returns:
        Of theta2, log T, kappa and log |kappa| (rows) with respect to l1, l2, m1, m2, g and theta1.
    """
    pendulum, theta1, theta2, log_time = (
        orbit.pendulum,
        orbit.theta1,
        orbit.theta2,
        jnp.log(0.25 * orbit.period),
    )
    line = Line(jnp.stack([theta1, 0.0]), jnp.array([0.0, 1.0]))
    rate, _ = rate_along(
        pendulum, line, theta2, log_time, steps_for(log_time, clock(pendulum), FINE)
    )
    steps = steps_for(log_time, rate, FINE).astype(jnp.float64)
    kappas = jnp.stack([orbit.kappa, orbit.log_abs_kappa])

    def known(parameters: Array) -> Array:
        base = jnp.append(parameters, 0.0)
        root = implicit_root("centred", jnp.stack([theta2, log_time]), base, line.direction, steps)
        return jnp.concatenate(
            [root, _kappas("centred", kappas, jnp.concatenate([parameters, root]), steps)]
        )

    return jax.jacfwd(known)(jnp.stack([*jax.tree.leaves(pendulum), theta1]))


def mirrored(orbit: PeriodicOrbit, sign: Scalar) -> PeriodicOrbit:
    """The mirror image x -> -x where `sign`, of the leaves' shape, is -1."""
    state, dual = (jax.tree.map(lambda leaf: sign * leaf, x) for x in (orbit.state, orbit.dual))
    turns = (sign.astype(int) * orbit.turns[0], sign.astype(int) * orbit.turns[1])
    return replace(orbit, state=state, dual=dual, turns=turns)


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
def implicit_points(
    symmetry: str, known: Any, parameters: Any, points: Any, rows: Any, steps: Any, turns: Any
) -> Any:
    """`known`, shape (m, 9), as a function of (l2/l1, m2/m1, target), shape (m, 3): see
    `sensitivities`.
    """
    return known


@jax.custom_jvp
def _once(parameters: Any) -> Any:
    """Refuses to be differentiated: the points of `implicit_points` would not know how they
    move.
    """
    return parameters


@_once.defjvp
def _once_jvp(primals, tangents):  # type: ignore[no-untyped-def]
    raise ValueError(
        "theta1 must not be differentiated twice on a family: use find_orbit for second derivatives"
    )


@implicit_points.defjvp
def _implicit_points_jvp(symmetry, primals, tangents):  # type: ignore[no-untyped-def]
    _, parameters, points, rows, steps, turns = primals
    jacobian = sensitivities(_once(parameters)[0, :2], points, rows, steps, turns, symmetry)
    return implicit_points(symmetry, *primals), jnp.einsum("mij,mj->mi", jacobian, tangents[1])


@partial(jax.jit, static_argnames="symmetry")
def _carried(pendulum, targets, known, points, rows, steps, turns, symmetry):  # type: ignore[no-untyped-def]
    """What is known in SI units, carrying the derivatives of the pendulum and the targets."""
    ratios = jnp.stack([pendulum.l2 / pendulum.l1, pendulum.m2 / pendulum.m1])
    parameters = jnp.column_stack([jnp.broadcast_to(ratios, (len(known), 2)), targets])
    known = implicit_points(symmetry, known, parameters, points, rows, steps, turns)
    fields = _in_units(pendulum, _Known(*known.T), turns, symmetry, jnp)
    return fields | {"energy": hamiltonian(pendulum, fields["state"])}


def _in_units(
    pendulum: Pendulum, known: _Known, turns: Any, symmetry: str, xp: Any
) -> dict[str, Any]:
    """The fields of an orbit that depend on the pendulum, but for the energy."""
    second = xp.sqrt(pendulum.l1 / pendulum.g)
    momentum = pendulum.m1 * pendulum.l1**2 / second
    state = State(known.theta1, known.theta2, momentum * known.p1, momentum * known.p2)
    dual = State(
        2 * np.pi * turns[0] - known.theta1,
        2 * np.pi * turns[1] - known.theta2,
        -state.p1,
        -state.p2,
    )
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


def orbits_of(
    problem: Problem, rows: Corrected, targets: Any = None, along: Any = None
) -> PeriodicOrbit:
    """Points as orbits, in NumPy: eager JAX would compile each operation for each number of points.

    With `targets`, the values of theta1 at which the rows `along` were solved, everything carries
    derivatives.
    """
    _, kappa, logarithm = stability_of(rows.matrices, problem.symmetry)
    time = rows.times.sum(axis=1)
    start = rows.point[:, :4] * (
        [1, 1, 1, 1] if problem.symmetry == "odd" else [1, 1, 0, 0]
    )  # at rest, exactly
    known = np.column_stack([start, rows.end[:, :2], time, kappa, logarithm])
    turns = np.asarray(problem.turns)
    pendulum = jax.tree.map(known_value, problem.pendulum)
    if targets is None:
        fields = _in_units(pendulum, _Known(*known.T), turns, problem.symmetry, np)
        fields["energy"] = pendulum.m1 * pendulum.g * pendulum.l1 * rows.energy
    else:
        task = known, rows.point, along, rows.steps, turns
        fields = _carried(problem.pendulum, targets, *task, problem.symmetry)
    whole = np.broadcast_to(
        turns if problem.symmetry == "centred" else 0 * turns, (len(time), 2)
    ).astype(int)
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


def slopes_of(problem: Problem, rows: Corrected) -> Slopes:
    pendulum = jax.tree.map(known_value, problem.pendulum)
    second = math.sqrt(pendulum.l1 / pendulum.g)
    return Slopes(
        rows.tangent[:, 0],
        rows.tangent[:, 1],
        PARTS[problem.symmetry] * second * rows.time_slope,
        pendulum.m1 * pendulum.g * pendulum.l1 * rows.energy_slope,
    )
