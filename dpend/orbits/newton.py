"""Newton's method for periodic orbits cut into segments.

The equations of an arc (`shooting_equations`) are one fewer than the unknowns. A row and a value
for row . point complete them: a plane through a predicted point of a family, or a release that is
wanted.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from dpend.checks import Scalar
from dpend.mechanics.pendulum import Pendulum, State, hamiltonian, vector_field
from dpend.orbits.arc import (
    LOG_DELTA,
    MOST_SEGMENT_STEPS,
    SEGMENTS,
    TURN,
    UNKNOWNS,
    Arc,
    Equations,
    Factors,
    by_symmetry,
    no_equations,
    shooting_equations,
    solve,
    solve_transposed,
    stack_state,
)

# Arclength: ds^2 is the mean over the nodes of dtheta1^2 + dtheta2^2, plus (d log Delta)^2.
METRIC = np.concatenate([np.tile([1.0, 1.0, 0.0, 0.0], SEGMENTS) / SEGMENTS, [1.0, 0.0]])
# After an update of this size the next one, its square, is below rounding.
TOLERANCE = 1e-8
# An orbit that passes close by an equilibrium magnifies rounding by the inverse square of the
# distance: below this size an update that does not shrink is noise, which the error estimate tells.
_NOISE = 1e-6
# From a predicted point three or four iterations do; a point that takes more is tried nearer.
MOST_ITERATIONS = 8
# What rounding leaves of an equation, relative to the coordinates that it is made of: two units in
# the last place, times the fourth root of m2/m1 where that is above 1.
# Measured against long double (experiments/orbit_errors.py), which shows the quantiles of estimate
# over error.
_ROUNDINGS = 2.0 * float(np.finfo(np.float64).eps)

# The covectors of theta1 and theta2 at the release.
THETA1, THETA2 = np.eye(UNKNOWNS)[0], np.eye(UNKNOWNS)[1]


class Aim(NamedTuple):
    """Which point of a family is sought: where row . point has the value it has at `predicted`.

    Attributes:
        predicted, row: the first iterate, and the normal of the plane through it.
        steps: integration steps of a segment.
        tolerance: for the last update that is made; the one after is its square.
        amplitude: the unit of the nodes' updates, at most 1.
        most_iterations: the estimate not counted.
        fixed, asked: covectors: `angle_error` is what `asked` is known to where `fixed` is exact.
    """

    predicted: Any
    row: Any
    steps: Any
    tolerance: Any = TOLERANCE
    amplitude: Any = 1.0
    most_iterations: Any = MOST_ITERATIONS
    fixed: Any = THETA1
    asked: Any = THETA2


class Solved(NamedTuple):
    """A point on a family.

    Attributes:
        point, tangent: the unknowns there, and the unit tangent in the direction of the row it was
            sought with.
        side: sign of the bordered Jacobian's determinant: constant along a curve, it changes where
            another crosses, and on a jump to another one close by.
        miss, contraction: the first Newton update, and the second over the first.
        steps: how many a segment should have been given.
        converged: whether Newton's method did.
        release_change: the change of the release on solving at half the step [rad], of a passing
            orbit that of the first rates.
        angle_error, time_error: of theta2 [rad] and of the time, relative, at this theta1 (or of
            what else the aim asks; without symmetry, at this energy; of a passing orbit the first
            is of the direction phi, see `_of_moving`): the change on solving at half the step, and
            what rounding on the way makes of them.
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
    release_change: Any
    angle_error: Any
    time_error: Any
    iterations: Any
    residual: Any
    end: Any
    times: Any
    time_slope: Any
    energy: Any
    energy_slope: Any
    matrices: Any


# How many numbers a `Solved` is, and where each field is among them.
_SHAPES = {
    "point": (UNKNOWNS,),
    "tangent": (UNKNOWNS,),
    "end": (4,),
    "times": (SEGMENTS,),
    "matrices": (SEGMENTS, 4, 4),
}
_SIZES = [math.prod(_SHAPES.get(name, ())) for name in Solved._fields]
ROW = sum(_SIZES)


def no_point() -> Solved:
    """A `Solved` of NaN and zeros, of a point that was not sought yet."""
    kinds = {"steps": 0, "iterations": 0, "converged": False}
    return Solved(*(
        jnp.full(_SHAPES.get(name, ()), kinds.get(name, jnp.nan)) for name in Solved._fields
    ))  # fmt: skip


def unpack_table(table: np.ndarray) -> Solved:
    """The rows of a table as one `Solved` with a leading axis."""
    columns = np.split(table, np.cumsum(_SIZES)[:-1], axis=1)
    fields = zip(Solved._fields, columns, strict=True)
    return Solved(*(column.reshape(-1, *_SHAPES.get(name, ())) for name, column in fields))


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
    angles, rest = jnp.append(none, sizes[:2]), jnp.append(none, sizes[2:])
    ends = by_symmetry(
        arc, lambda: sizes, centred=lambda: angles, brake=lambda: rest, passing=lambda: angles
    )
    unit = _ROUNDINGS * jnp.maximum(1.0, pendulum.m2 / pendulum.m1) ** 0.25
    return unit * jnp.concatenate([jnp.tile(sizes, SEGMENTS - 1), ends, none])


def _errors(
    pendulum: Pendulum, n: _Newton, aim: Aim, tangent: Array, time: Array, arc: Arc
) -> Array:
    """The errors of the aim's `asked` and of the log of the time, whose gradient is `time`, at the
    point's own value of `fixed`.

    The point is off the curve by the last update and by rounding, which the transposed equations
    carry to what is asked. Where `fixed` is off, the curve's slope tells what the others are off
    by; at a fold, where that is infinite, its curvature does.
    """

    def at_aim() -> Array:
        return jnp.stack([jnp.asarray(aim.fixed), jnp.asarray(aim.asked)])

    def moving() -> Array:
        return _of_moving(pendulum, n.point)

    pair = by_symmetry(arc, at_aim, passing=moving, none=lambda: at_aim().at[0].set(moving()[0]))
    wanted = jnp.concatenate([pair, time[None]])
    pulled = solve_transposed(n.factors, wanted.T).T * _rounding(pendulum, n.point, arc)
    off, pace = jnp.sqrt(jnp.sum(pulled[0] ** 2)), wanted[0] @ tangent
    slope = jnp.maximum(jnp.maximum(jnp.abs(pace), jnp.sqrt(off)), jnp.finfo(float).tiny)
    along = (wanted[1:] @ tangent / slope * jnp.where(pace < 0, -1.0, 1.0))[:, None]
    change = wanted[1:] @ n.update - along[:, 0] * (wanted[0] @ n.update)
    return jnp.abs(change) + jnp.sqrt(jnp.sum((pulled[1:] - along * pulled[:1]) ** 2, axis=1))


def _of_moving(pendulum: Pendulum, point: Array) -> Array:
    """The covectors of the energy, and of the direction at a start in {0, pi}^2, shape (2, D).

    There the momenta of one energy are an ellipse, p = sqrt(2 K) L (cos phi, sin phi) with L L^T
    the inertia and K the kinetic energy; d phi = (p1 dp2 - p2 dp1)/(2 K det L), and dH = theta' dp.
    """
    slope = stack_state(vector_field(pendulum, State(*point[:4])))
    rates, (p1, p2) = slope[:2], point[2:4]
    # det L = sqrt(m1 m2) l1 l2 where the rods are in line.
    area = (p1 * rates[0] + p2 * rates[1]) * pendulum.l2 * jnp.sqrt(pendulum.m2)
    direction = jnp.concatenate([jnp.zeros(2), jnp.stack([-p2, p1]) / area])
    both = jnp.stack([jnp.concatenate([-slope[2:], rates]), direction])
    return jnp.pad(both, ((0, 0), (0, UNKNOWNS - 4)))


def _inertia(pendulum: Pendulum) -> Array:
    """The momenta that belong to a rate of one."""
    return jnp.stack([1 + pendulum.m2, pendulum.m2 * pendulum.l2**1.5])


def _units(pendulum: Pendulum, amplitude: Scalar) -> Array:
    """What an update is measured in: the amplitude, and the momenta that belong to as large a
    rate.
    """
    nodes = jnp.tile(jnp.concatenate([jnp.ones(2), _inertia(pendulum)]), SEGMENTS)
    return jnp.append(amplitude * nodes, jnp.ones(2))


def _iterate(pendulum: Pendulum, aim: Aim, arc: Arc, n: _Newton) -> _Newton:
    """One iteration; where `n.done` is 1, the estimate: the update at half the step, not made."""
    estimating = n.done == 1
    steps = jnp.where(estimating, 2 * aim.steps, aim.steps)
    equations = shooting_equations(pendulum, n.point, steps, arc)
    short = jnp.append(equations.value, aim.row @ (n.point - aim.predicted))
    factors, pivots, order = lax.linalg.lu(jnp.concatenate([equations.jacobian, aim.row[None]]))
    one = jnp.zeros(UNKNOWNS).at[-1].set(1.0)
    update, null = solve((factors, order), jnp.stack([-short, one], axis=1)).T
    swaps = jnp.sum(pivots != jnp.arange(UNKNOWNS, dtype=pivots.dtype)) % 2
    size = jnp.max(jnp.abs(update) / _units(pendulum, aim.amplitude))
    iterations = n.iterations + 1
    noise = (n.iterations > 0) & (size <= _NOISE) & (size > 0.1 * n.size)
    small = (size <= aim.tolerance) | noise
    growing = (iterations > 1) & (size > n.size) & ~small
    hopeless = ~(size < 2.0) | growing | (iterations >= aim.most_iterations)
    return _Newton(
        point=jnp.where(estimating, n.point, n.point + update),
        iterations=iterations,
        size=jnp.where(estimating, n.size, size),
        first=jnp.where(n.iterations == 0, size, n.first),
        contraction=jnp.where(iterations == 2, size / n.size, n.contraction),
        done=jnp.where(estimating, 2, jnp.where(small, 1, jnp.where(hopeless, 3, 0))),
        update=update,
        null=null,
        side=jnp.prod(jnp.sign(jnp.diagonal(factors))) * jnp.where(swaps == 0, 1.0, -1.0),
        equations=equations,
        factors=(factors, order),
    )


def correct(pendulum: Pendulum, aim: Aim, arc: Arc) -> Solved:
    """The point of the family that `aim` tells of, by Newton's method.

    The last iteration takes half the step from where the others ended; its update, not made, is the
    error estimate.
    """
    zero = jnp.zeros(())
    start = _Newton(
        point=aim.predicted,
        iterations=jnp.asarray(0),
        size=jnp.asarray(jnp.inf),
        first=zero,
        contraction=zero,
        done=jnp.asarray(0),
        update=aim.predicted,
        null=aim.row,
        side=zero,
        equations=no_equations(),
        factors=(jnp.eye(UNKNOWNS), jnp.zeros(UNKNOWNS, jnp.int32)),
    )

    def running(n: _Newton) -> Scalar:
        return n.done < 2

    return _describe_root(
        pendulum,
        lax.while_loop(running, lambda n: _iterate(pendulum, aim, arc, n), start),
        aim,
        arc,
    )


def _describe_root(pendulum: Pendulum, n: _Newton, aim: Aim, arc: Arc) -> Solved:
    """What is told of the point where Newton's method ended."""
    tangent = n.null / jnp.sqrt(n.null @ (METRIC * n.null))
    s = n.equations.segments
    by_nodes = s.stretch.ravel() / jnp.sum(s.time)
    log_time = jnp.append(by_nodes, jnp.array([1.0, 0.0]))  # its gradient
    angle_error, time_error = _errors(pendulum, n, aim, tangent, log_time, arc)

    def energy(x: Array) -> Scalar:
        return hamiltonian(pendulum, State(*x))

    level, slope = jax.jvp(energy, (n.point[:4],), (tangent[:4],))
    wanted = jnp.ceil(jnp.nan_to_num(jnp.max(s.turn) / TURN, nan=1.0))
    change = by_symmetry(
        arc, lambda: n.update[:2], passing=lambda: n.update[2:4] / _inertia(pendulum)
    )
    return Solved(
        point=n.point,
        tangent=tangent,
        side=n.side,
        miss=n.first,
        contraction=n.contraction,
        steps=jnp.clip(wanted, 1, MOST_SEGMENT_STEPS).astype(int),
        converged=n.done == 2,
        release_change=jnp.max(jnp.abs(change)),
        angle_error=angle_error,
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


@jax.jit
def linearise(pendulum: Pendulum, point: Array, steps: Scalar, arc: Arc) -> tuple[Array, Array]:
    """The equations at a point, one fewer than unknowns, and their Jacobian."""
    equations = shooting_equations(pendulum, point, steps, arc)
    return equations.value, equations.jacobian
