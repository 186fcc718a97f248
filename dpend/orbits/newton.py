"""Newton's method for periodic orbits: in segments side by side, and in one piece on a line of
releases.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from dpend.checks import Scalar
from dpend.mechanics.pendulum import Pendulum, State, hamiltonian
from dpend.motion.integrate import moved, step_size
from dpend.orbits.arc import (
    LOG_DELTA,
    METHOD,
    MOST_SEGMENT_STEPS,
    SEGMENTS,
    TURN,
    UNFOLDING,
    UNKNOWNS,
    Arc,
    Equations,
    Factors,
    arc_of,
    arc_times,
    end_conditions,
    shooting_equations,
    solve,
    solve_transposed,
    stack_state,
)
from dpend.orbits.stability import stability_of, transition

# Arclength: ds^2 is the mean over the nodes of dtheta1^2 + dtheta2^2, plus (d log Delta)^2.
METRIC = np.concatenate([np.tile([1.0, 1.0, 0.0, 0.0], SEGMENTS) / SEGMENTS, [1.0, 0.0]])
# Newton's update is then below rounding: its error is the square of this.
_TOLERANCE = 1e-8
# Where an orbit passes close by an equilibrium on its way, rounding is magnified by the inverse
# square of the distance: below this an update that does not shrink is noise, and the error estimate
# tells of it.
_NOISE = 1e-6
_MOST_ITERATIONS = 8
# What rounding leaves of an equation, relative to the coordinates that it is made of: two units in
# the last place, times the fourth root of m2/m1 where that is above 1.
# Measured against long double (experiments/orbit_errors.py), which shows the quantiles of estimate
# over error.
_ROUNDINGS = 2.0 * float(np.finfo(np.float64).eps)


class Corrected(NamedTuple):
    """A point on a family.

    Attributes:
        point, tangent: the unknowns there, and the unit tangent in the direction of the row it was
            sought with.
        side: sign of the bordered Jacobian's determinant: constant along a curve, it changes where
            another crosses, and on a jump to another one close by.
        miss, contraction: the first Newton update, and the second over the first.
        steps: how many a segment should have been given.
        converged: whether Newton's method did.
        angle_error: the change of the release on solving at half the step [rad].
        theta2_error, time_error: of theta2 [rad] and of the time, relative, at this theta1: the
            change on solving at half the step, and what rounding on the way makes of them.
        iterations: of Newton's method.
        residual: of the equations, the largest.
        end: the state at the arc's end.
        times: of the segments.
        time_slope: derivative of their sum with respect to arclength.
        energy, energy_slope: H, and the same of it.
        matrices: of the segments, shape (S, 4, 4).
    """

    point: Any
    tangent: Any
    side: Any
    miss: Any
    contraction: Any
    steps: Any
    converged: Any
    angle_error: Any
    theta2_error: Any
    time_error: Any
    iterations: Any
    residual: Any
    end: Any
    times: Any
    time_slope: Any
    energy: Any
    energy_slope: Any
    matrices: Any


# How many numbers a `Corrected` is, and where each field is among them.
_SHAPES = {
    "point": (UNKNOWNS,),
    "tangent": (UNKNOWNS,),
    "end": (4,),
    "times": (SEGMENTS,),
    "matrices": (SEGMENTS, 4, 4),
}
_SIZES = [math.prod(_SHAPES.get(name, ())) for name in Corrected._fields]
ROW = sum(_SIZES)


def unpacked(table: np.ndarray) -> Corrected:
    """The rows of a table as one `Corrected` with a leading axis."""
    columns = np.split(table, np.cumsum(_SIZES)[:-1], axis=1)
    fields = zip(Corrected._fields, columns, strict=True)
    return Corrected(*(column.reshape(-1, *_SHAPES.get(name, ())) for name, column in fields))


class _Newton(NamedTuple):
    point: Array
    iterations: Scalar
    size: Scalar  # of the last update
    first: Scalar
    contraction: Scalar
    done: Scalar  # 0 while it runs, 1 when only the estimate is left, 2 after it
    update: Array
    null: Array
    side: Scalar
    equations: Equations
    factors: Factors  # of the bordered Jacobian


def _rounding(pendulum: Pendulum, point: Array, arc: Arc) -> Array:
    """By how much rounding on the way misses each of the equations, the border's included.

    A heavy lower bob makes the rods' inertia nearly singular where they are in line: rounding is
    then magnified.
    """
    sizes = jnp.max(jnp.abs(point[:LOG_DELTA].reshape(SEGMENTS, 4)), axis=0)
    none = jnp.zeros(2)
    ends = jnp.stack([jnp.append(none, sizes[:2]), jnp.append(none, sizes[2:]), sizes])[
        arc.symmetry
    ]
    unit = _ROUNDINGS * jnp.maximum(1.0, pendulum.m2 / pendulum.m1) ** 0.25
    return unit * jnp.concatenate([jnp.tile(sizes, SEGMENTS - 1), ends, none])


def _errors(pendulum: Pendulum, n: _Newton, tangent: Array, time: Array, arc: Arc) -> Array:
    """The errors of theta2 and of the log of the time, whose gradient is `time`, at the point's own
    theta1.

    The point is off the curve by the last update and by rounding, which the transposed equations
    carry to what is asked. Where it is off in theta1, the curve's slope tells what the others are
    off by; at a fold, where that is infinite, its curvature does.
    """
    wanted = jnp.stack([jnp.eye(UNKNOWNS)[0], jnp.eye(UNKNOWNS)[1], time])
    pulled = solve_transposed(n.factors, wanted.T).T * _rounding(pendulum, n.point, arc)
    off = jnp.sqrt(jnp.sum(pulled[0] ** 2))
    slope = jnp.maximum(jnp.maximum(jnp.abs(tangent[0]), jnp.sqrt(off)), jnp.finfo(float).tiny)
    along = (wanted[1:] @ tangent / slope * jnp.where(tangent[0] < 0, -1.0, 1.0))[:, None]
    change = wanted[1:] @ n.update - along[:, 0] * n.update[0]
    return jnp.abs(change) + jnp.sqrt(jnp.sum((pulled[1:] - along * pulled[:1]) ** 2, axis=1))


def _units(pendulum: Pendulum) -> Array:
    """What an update is measured in: radians, and the momenta that belong to the rate 1."""
    inertia = jnp.stack([1 + pendulum.m2, pendulum.m2 * pendulum.l2**1.5])
    nodes = jnp.tile(jnp.concatenate([jnp.ones(2), inertia]), SEGMENTS)
    return jnp.append(nodes, jnp.ones(2))


def corrected(pendulum: Pendulum, predicted: Any, row: Any, steps: Scalar, arc: Arc) -> Corrected:
    """The point of the family in the plane through `predicted` that `row` is normal to, by Newton's
    method.

    The last iteration takes half the step from where the others ended; its update, not made, is the
    error estimate.
    """
    unit = _units(pendulum)

    def iterate(n: _Newton) -> _Newton:
        estimating = n.done == 1
        equations = shooting_equations(
            pendulum, n.point, jnp.where(estimating, 2 * steps, steps), arc
        )
        bordered = jnp.concatenate([equations.jacobian, row[None]])
        short = jnp.append(equations.value, row @ (n.point - predicted))
        factors, pivots, order = lax.linalg.lu(bordered)
        one = jnp.zeros(UNKNOWNS).at[-1].set(1.0)
        update, null = solve((factors, order), jnp.stack([-short, one], axis=1)).T
        swaps = jnp.sum(pivots != jnp.arange(UNKNOWNS, dtype=pivots.dtype)) % 2
        side = jnp.prod(jnp.sign(jnp.diagonal(factors))) * jnp.where(swaps == 0, 1.0, -1.0)
        size = jnp.max(jnp.abs(update) / unit)
        iterations = n.iterations + 1
        contraction = jnp.where(iterations == 2, size / n.size, n.contraction)
        small = (size <= _TOLERANCE) | (
            (n.iterations > 0) & (size <= _NOISE) & (size > 0.1 * n.size)
        )
        hopeless = (
            ~(size < 2.0)
            | ((iterations > 1) & (size > n.size) & ~small)
            | (iterations >= _MOST_ITERATIONS)
        )
        done = jnp.where(estimating, 2, jnp.where(small, 1, jnp.where(hopeless, 3, 0)))
        return _Newton(
            jnp.where(estimating, n.point, n.point + update),
            iterations,
            jnp.where(estimating, n.size, size),
            jnp.where(n.iterations == 0, size, n.first),
            contraction,
            done,
            update,
            null,
            side,
            equations,
            (factors, order),
        )

    def running(n: _Newton) -> Scalar:
        return n.done < 2

    zero = jnp.zeros(())
    blank = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype),
        jax.eval_shape(shooting_equations, pendulum, predicted, steps, arc),
    )
    start = _Newton(
        predicted,
        jnp.asarray(0),
        jnp.asarray(jnp.inf),
        zero,
        zero,
        jnp.asarray(0),
        predicted,
        row,
        zero,
        blank,
        (jnp.eye(UNKNOWNS), jnp.zeros(UNKNOWNS, jnp.int32)),
    )
    n = lax.while_loop(running, iterate, start)
    tangent = n.null / jnp.sqrt(n.null @ (METRIC * n.null))
    s = n.equations.segments

    log_time = jnp.append(
        s.stretch.ravel() / jnp.sum(s.time), jnp.array([1.0, 0.0])
    )  # its gradient
    theta2_error, time_error = _errors(pendulum, n, tangent, log_time, arc)

    def energy(x: Array) -> Scalar:
        return hamiltonian(pendulum, State(*x))

    level, slope = jax.jvp(energy, (n.point[:4],), (tangent[:4],))
    wanted = jnp.ceil(jnp.nan_to_num(jnp.max(s.turn) / TURN, nan=1.0))
    return Corrected(
        point=n.point,
        tangent=tangent,
        side=n.side,
        miss=n.first,
        contraction=n.contraction,
        steps=jnp.clip(wanted, 1, MOST_SEGMENT_STEPS).astype(int),
        converged=n.done == 2,
        angle_error=jnp.max(jnp.abs(n.update[:2])),
        theta2_error=theta2_error,
        time_error=time_error,
        iterations=n.iterations,
        residual=jnp.max(jnp.abs(n.equations.value)),
        end=s.end[-1],
        times=s.time,
        time_slope=jnp.sum(s.time) * (log_time @ tangent),
        energy=level,
        energy_slope=slope,
        matrices=s.matrix,
    )


@partial(jax.jit, static_argnames="symmetry")
def sensitivities(
    ratios: Array, points: Array, rows: Array, steps: Array, turns: Array, symmetry: str
) -> Float[Array, "m 9 3"]:
    """Derivatives of what is known of orbits at row . point = target, by the implicit function
    theorem.

    Arguments:
        ratios: l2/l1 and m2/m1.
    Returns:
        Of the first node, the angles at the end, the arc's time, kappa and log |kappa| (natural
        units) with respect to the ratios and the target.
    """

    def one(task: tuple) -> Array:
        point, row, count = task
        return _sensitivity(ratios, point, row, count.astype(int), turns, symmetry)

    return lax.map(one, (points, rows, steps))


def _sensitivity(
    ratios: Array, point: Array, row: Array, steps: Scalar, turns: Array, symmetry: str
) -> Array:
    arc = arc_of(symmetry, turns)

    def ends(ratios: Array) -> Array:
        here = Pendulum(1.0, ratios[0], 1.0, ratios[1], 1.0)
        nodes = point[:LOG_DELTA].reshape(SEGMENTS, 4)
        time, _ = arc_times(here, point)
        end = stack_state(moved(METHOD, here, State(*nodes.T), step_size(time, steps), steps)).T
        conditions, _ = end_conditions(here, nodes[0], end[-1], point[UNFOLDING], arc)
        return jnp.concatenate([(end[:-1] - nodes[1:]).ravel(), conditions])

    def known(both: Array) -> Array:
        point, ratios = both[:-2], both[-2:]
        here = Pendulum(1.0, ratios[0], 1.0, ratios[1], 1.0)
        states = State(*point[:LOG_DELTA].reshape(SEGMENTS, 4).T)
        times, _ = arc_times(here, point)
        end, matrices = transition(here, states, step_size(times, steps), steps, METHOD)
        _, kappa, logarithm = stability_of(jnp.moveaxis(matrices, -1, 0), symmetry, jnp)
        last = jnp.stack([end.theta1[-1], end.theta2[-1], jnp.sum(times), kappa, logarithm])
        return jnp.concatenate([point[:4], last])

    jacobian = shooting_equations(
        Pendulum(1.0, ratios[0], 1.0, ratios[1], 1.0), point, steps, arc
    ).jacobian
    by_ratios = jax.jacfwd(ends)(ratios)
    right = jnp.zeros((UNKNOWNS, 3)).at[:-1, :2].set(-by_ratios).at[-1, 2].set(1.0)
    moves = jnp.linalg.solve(jnp.concatenate([jacobian, row[None]]), right)
    directions = jnp.concatenate([moves, jnp.eye(2, 3)]).T
    both = jnp.append(point, ratios)
    return jax.vmap(lambda direction: jax.jvp(known, (both,), (direction,))[1], out_axes=1)(
        directions
    )


@jax.jit
def linearised(pendulum: Pendulum, point: Array, steps: Scalar, arc: Arc) -> tuple[Array, Array]:
    """The equations at a point, one fewer than unknowns, and their Jacobian."""
    equations = shooting_equations(pendulum, point, steps, arc)
    return equations.value, equations.jacobian
