"""The implicit function theorem: what is known of a root, as a function of its parameters.

A root of F(root, parameters) = 0 moves by d root = -(dF/d root)^-1 (dF/d parameters) d parameters.
One rule serves the equations of segments and those of shooting in one piece, and derivatives of
every order, forwards and backwards. The parameters are l2/l1, m2/m1 and the value of what is held
fixed at the release, in natural units.
"""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dpend.checks import Scalar
from dpend.mechanics.pendulum import Pendulum, State, hamiltonian, released
from dpend.motion.integrate import advance_state, step_size
from dpend.orbits.arc import (
    LOG_DELTA,
    METHOD,
    RELEASED_SYMMETRIES,
    SEGMENTS,
    UNFOLDING,
    arc_of,
    arc_times,
    end_conditions,
    shooting_equations,
    stack_state,
    state_halfway,
)
from dpend.orbits.newton import Solved
from dpend.orbits.single import RK8
from dpend.orbits.stability import stability_of, transition


class Known(NamedTuple):
    """What is known of an orbit, in natural units: the columns of an array that carries
    derivatives.
    """

    theta1: Any
    theta2: Any
    p1: Any
    p2: Any
    end1: Any  # the angles at the arc's end, without symmetry at half of it
    end2: Any
    end_p1: Any  # and the momenta
    end_p2: Any
    time: Any  # of the arc
    energy: Any
    kappa: Any
    log_abs_kappa: Any


class Equations(NamedTuple):
    """The equations of a root, for the implicit function theorem.

    Attributes:
        symmetry: of the orbit.
        linearise: (symmetry, root, parameters, given) -> dF/d root and dF/d parameters.
        known: (symmetry, root, parameters, given) -> the columns of `Known`.
    """

    symmetry: str
    linearise: Callable[..., tuple[Array, Array]]
    known: Callable[..., Array]


def implicit(equations: Equations, values: Any, parameters: Array, given: Any) -> Any:
    """`values`, a root and what is known of it, as a function of `parameters`, shape (3,).

    The values were found before and come back as they are.

    Arguments:
        given: an `ArcGiven` or `PieceGiven`: constants; as floats, since a rule's arguments need
            tangents.
    """
    return _differentiate(equations, 0, values, parameters, given)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _differentiate(
    equations: Equations, order: int, values: Any, parameters: Array, given: Any
) -> Any:
    """The derivative of this order of `values`, with one more axis of parameters for each order.

    JAX is told that the derivative of one order changes by the next order times a tangent. All
    orders are computed forwards, so that no rule transposes the flow's loop, which cannot be
    transposed, and `grad` of `grad` works as `hessian` does.
    """
    return _compute(equations, order, values, parameters, given)


@_differentiate.defjvp
def _differentiate_jvp(
    equations: Equations, order: int, primals: tuple, tangents: tuple
) -> tuple[Any, Any]:
    here, slopes = (_differentiate(equations, n, *primals) for n in (order, order + 1))
    return here, jax.tree.map(lambda slope: slope @ tangents[1], slopes)


def _compute(equations: Equations, order: int, values: Any, parameters: Array, given: Any) -> Any:
    """The derivative of this order, by the equations; from the second on of the one before it."""
    if order == 0:
        return values
    if order > 1:
        lower = partial(_compute, equations, order - 1, values, given=given)
        return jax.jacfwd(lower)(parameters)
    # By way of the rule, so that second derivatives know how the root moves.
    root, _ = implicit(equations, values, parameters, given)
    by_root, by_parameters = equations.linearise(equations.symmetry, root, parameters, given)
    moves = -jnp.linalg.solve(by_root, by_parameters)

    def along(move: Array, unit: Array) -> Array:
        def again(root: Array, parameters: Array) -> Array:
            return equations.known(equations.symmetry, root, parameters, given)

        return jax.jvp(again, (root, parameters), (move, unit))[1]

    return moves, jax.vmap(along, (1, 1), 1)(moves, jnp.eye(len(parameters)))


def _pendulum(parameters: Array) -> Pendulum:
    return Pendulum(1.0, parameters[0], 1.0, parameters[1], 1.0)


def parameters_of(pendulum: Pendulum, target: Scalar) -> Array:
    """The parameters of a root: they carry the derivatives of the pendulum and of `target`."""
    return jnp.stack(
        jnp.broadcast_arrays(pendulum.l2 / pendulum.l1, pendulum.m2 / pendulum.m1, target), axis=-1
    )


class ArcGiven(NamedTuple):
    """Of a root of segments: what row . point is, if that is held; steps of a segment; turns."""

    row: Float[Array, " D"]
    steps: Scalar
    turns: Float[Array, "2"]


def _held_value(held: str, pendulum: Pendulum, point: Array, row: Array) -> Scalar:
    """What is held at the target: row . point, the energy, or the log of the arc's time."""
    if held == "energy":
        return hamiltonian(pendulum, State(*point[:4]))
    if held == "period":
        return jnp.log(jnp.sum(arc_times(pendulum, point)[0]))
    return row @ point


def _linearise_arc(
    held: str, symmetry: str, point: Array, parameters: Array, given: ArcGiven
) -> tuple[Array, Array]:
    arc, steps = arc_of(symmetry, given.turns), given.steps.astype(int)
    jacobian = shooting_equations(_pendulum(parameters), point, steps, arc).jacobian

    def closings(parameters: Array) -> Array:
        here, nodes = _pendulum(parameters), point[:LOG_DELTA].reshape(SEGMENTS, 4)
        time, _ = arc_times(here, point)
        end = stack_state(
            advance_state(METHOD, here, State(*nodes.T), step_size(time, steps), steps)
        ).T
        conditions, _ = end_conditions(here, nodes[0], end[-1], point[UNFOLDING], arc)
        border = _held_value(held, here, point, given.row) - parameters[2]
        return jnp.concatenate([(end[:-1] - nodes[1:]).ravel(), conditions, border[None]])

    border = jax.grad(_held_value, 2)(held, _pendulum(parameters), point, given.row)
    return jnp.concatenate([jacobian, border[None]]), jax.jacfwd(closings)(parameters)


def _know_arc(symmetry: str, point: Array, parameters: Array, given: ArcGiven) -> Array:
    here, steps = _pendulum(parameters), given.steps.astype(int)
    nodes = State(*point[:LOG_DELTA].reshape(SEGMENTS, 4).T)
    times, _ = arc_times(here, point)
    end, matrices = transition(here, nodes, step_size(times, steps), steps, METHOD)
    stability = stability_of(jnp.moveaxis(matrices, -1, 0), symmetry, jnp)[1:]
    energy = hamiltonian(here, State(*point[:4]))
    rest = jnp.stack([jnp.sum(times), energy, *stability])
    last = stack_state(end)[:, -1] if symmetry != "none" else state_halfway(here, point)
    return jnp.concatenate([point[:4], last, rest])


@cache
def arc_equations(symmetry: str, held: str = "theta1") -> Equations:
    """The equations of an orbit in segments, `held` being `energy`, `period`, or a row . point."""
    return Equations(symmetry, partial(_linearise_arc, held), _know_arc)


def know_solved(rows: Solved, symmetry: str, xp: Any) -> Any:
    """The columns of `Known` for points on a family, shape (..., 12), in NumPy or JAX.

    Orbits released from rest are at rest there exactly.
    """
    _, kappa, logarithm = stability_of(rows.matrices, symmetry, xp)
    moves = float(symmetry not in RELEASED_SYMMETRIES)
    start = rows.point[..., :4] * xp.asarray([1.0, 1.0, moves, moves])
    rest = [rows.times.sum(axis=-1), rows.energy, kappa, logarithm]
    return xp.concatenate([start, rows.end, xp.stack(rest, axis=-1)], axis=-1)


class PieceGiven(NamedTuple):
    """Of a root (x, log of the shooting time) in one piece: the release is target * origin +
    x * direction; steps of the piece.
    """

    origin: Float[Array, "2"]
    direction: Float[Array, "2"]
    steps: Scalar


def _linearise_piece(
    symmetry: str, root: Array, parameters: Array, given: PieceGiven
) -> tuple[Array, Array]:
    steps = given.steps.astype(int)

    def ends(both: Array) -> Array:
        start = released(*(both[4] * given.origin + both[0] * given.direction))
        end = advance_state(
            RK8, _pendulum(both[2:]), start, step_size(jnp.exp(both[1]), steps), steps
        )
        # Momenta without their unit: at a root the factor does not matter.
        return jnp.stack([end.theta1, end.theta2] if symmetry == "centred" else [end.p1, end.p2])

    jacobian = jax.jacfwd(ends)(jnp.concatenate([root, parameters]))
    return jacobian[:, :2], jacobian[:, 2:]


def know_piece(symmetry: str, root: Array, parameters: Array, given: PieceGiven) -> Array:
    """The columns of `Known` for an orbit in one piece."""
    here, steps, time = _pendulum(parameters), given.steps.astype(int), jnp.exp(root[1])
    start = released(*(parameters[2] * given.origin + root[0] * given.direction))
    end, matrix = transition(here, start, step_size(time, steps), steps, RK8)
    stability = stability_of(matrix[None], symmetry, jnp)[1:]
    rest = [time, hamiltonian(here, start), *stability]
    return jnp.stack([*jax.tree.leaves(start), *jax.tree.leaves(end), *rest])


def piece_equations(symmetry: str) -> Equations:
    """The equations of an orbit in one piece."""
    return Equations(symmetry, _linearise_piece, know_piece)
