"""Multiple shooting: a symmetric orbit in segments, and the step from one orbit of a family to the next.

A quarter (centred) or half (brake, odd) of the period is cut into segments that are integrated side by side, each from
its own initial state, the node; Newton's method makes their ends meet. No segment is long enough for the motion to
forget where it began, so that orbits can be followed to where kappa is 1e40 and shooting in one piece would see noise.

The duration of a segment is Delta/rate(node): every segment is given the same share Delta of the fastest motion, and
that makes the mesh follow the orbit smoothly, without ever being laid anew. Delta is the last unknown: it takes the
place of the period, and grows only like its logarithm does where a motion lingers at an equilibrium.

Everything here is in natural units, l1 = m1 = g = 1: a pendulum is then (l2/l1, m2/m1), and the scaling laws hold to
the last digit.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from dpend.pendulum import (
    Pendulum,
    Scalar,
    State,
    equilibria,
    fast_frequency,
    hamiltonian,
    momenta,
    normal_modes,
    vector_field,
)
from dpend.stability import stability_of, transition
from dpend.steppers import Scheme
from dpend.trajectory import moved, step_size
from dpend.trig import sincos

# Two AVX-512 registers of lanes; the linear algebra grows with the third power of this number.
SEGMENTS = 16
UNKNOWNS = 4 * SEGMENTS + 2
# The conditions at the ends of the arc, by symmetry; the index is what compiled code is told.
SYMMETRIES = ("centred", "brake", "odd")
# What part of the period the arc is.
PARTS = {"centred": 4, "brake": 2, "odd": 2}

# Only its method is used: the number of steps is settled arc by arc. With its stages as a loop it takes twice the time,
# and a tenth of it to compile.
_METHOD = Scheme("rk8-circle", 1.0, written_out=False)
# The fastest motion may advance by this in one step [rad]: leaves little but rounding in the angles and the period.
_TURN = 0.14
_MOST_STEPS = 5_000

# Where the unknowns are: the nodes one after the other, log Delta, and the unfolding parameter of odd orbits, which is
# zero on every orbit.
_LOG_DELTA, _UNFOLDING = 4 * SEGMENTS, 4 * SEGMENTS + 1


class Arc(NamedTuple):
    """What is asked of an arc: the index of its symmetry, and the full turns of its end (theta/pi if centred, else
    theta(0) + theta(T/2) in units of 2 pi).
    """

    symmetry: Any
    turns: Any


def arc_of(symmetry: str, turns: Any = (0.0, 0.0)) -> Arc:
    """An arc of this symmetry, as compiled code is told of it."""
    return Arc(np.asarray(SYMMETRIES.index(symmetry)), jnp.asarray(turns))


class _Segments(NamedTuple):
    """All segments side by side."""

    end: Float[Array, "S 4"]
    matrix: Float[Array, "S 4 4"]  # derivative of the flow over the segment's time
    slope: Float[Array, "S 4"]  # at its end
    time: Float[Array, " S"]
    stretch: Float[Array, "S 4"]  # derivative of its time with respect to the node
    turn: Float[Array, " S"]  # the larger of the advances that the rates at both ends make of it [rad]


def natural(pendulum: Pendulum) -> Pendulum:
    """The pendulum in units of l1, m1 and sqrt(l1/g)."""
    return Pendulum(1.0, pendulum.l2 / pendulum.l1, 1.0, pendulum.m2 / pendulum.m1, 1.0)


def fastest(pendulum: Pendulum, state: State) -> Scalar:
    """The rate that decides the step [rad/s]: of the linear motion, of the rods, and of the inertia they share.

    The last is 1/(1 + mu sin^2 delta), which a heavy lower bob makes narrow: it changes when the angle delta between
    the rods does by sqrt(sin^2 delta + 1/mu). Near no equilibrium do motions part faster than the linear share.
    """
    rates = vector_field(pendulum, state)
    mu = pendulum.m2 / pendulum.m1
    sin_delta, _ = sincos(state.theta1 - state.theta2)
    narrow = (1 + mu) / (1 + mu * sin_delta**2)
    spin = rates.theta1**2 + rates.theta2**2 + narrow * (rates.theta1 - rates.theta2) ** 2
    return jnp.sqrt(fast_frequency(pendulum) ** 2 + spin)


def _stack(state: State) -> Array:
    return jnp.stack(jax.tree.leaves(state))


def _field(pendulum: Pendulum, state: State) -> Array:
    return _stack(vector_field(pendulum, state))


def _segments(pendulum: Pendulum, nodes: Array, delta: Scalar, steps: Scalar) -> _Segments:
    # States have leaves of shape (S,): the last axis, which is contiguous, is the one that is vectorised.
    states = State(*nodes.T)
    rate, pull = jax.vjp(lambda states: fastest(pendulum, states), states)
    (gradient,) = pull(jnp.ones(SEGMENTS))
    time = delta / rate
    end, matrix = transition(pendulum, states, step_size(time, steps), steps, _METHOD)
    return _Segments(
        end=_stack(end).T,
        matrix=jnp.moveaxis(matrix, -1, 0),
        slope=_field(pendulum, end).T,
        time=time,
        stretch=(-time / rate * _stack(gradient)).T,
        turn=jnp.maximum(delta, fastest(pendulum, end) * time),
    )


def arc_times(pendulum: Pendulum, point: Array) -> tuple[Array, Array]:
    """The durations of a point's segments and the rates at its nodes."""
    rates = fastest(pendulum, State(*point[:_LOG_DELTA].reshape(SEGMENTS, 4).T))
    return jnp.exp(point[_LOG_DELTA]) / rates, rates


class _Equations(NamedTuple):
    value: Float[Array, " E"]
    jacobian: Float[Array, "E D"]
    segments: _Segments


def _equations(pendulum: Pendulum, point: Array, steps: Scalar, arc: Arc) -> _Equations:
    """4 S + 1 equations: each segment ends where the next begins, and five conditions on the first node and the end."""
    nodes = point[:_LOG_DELTA].reshape(SEGMENTS, 4)
    s = _segments(pendulum, nodes, jnp.exp(point[_LOG_DELTA]), steps)
    by_node = s.matrix + s.slope[:, :, None] * s.stretch[:, None, :]
    by_delta = s.slope * s.time[:, None]
    ends, by_ends = _end_conditions(pendulum, nodes[0], s.end[-1], point[_UNFOLDING], arc)
    value = jnp.concatenate([(s.end[:-1] - nodes[1:]).ravel(), ends])
    # Written without indexed updates, which XLA makes loops of.
    inner = (by_node[:, :, None, :] * _DIAGONAL - _NEXT).reshape(4 * SEGMENTS, 4 * SEGMENTS)
    gap = jnp.zeros((5, 4 * SEGMENTS - 8))
    last = jnp.concatenate([by_ends[:, :4], gap, by_ends[:, 4:8] @ by_node[-1]], axis=1)
    delta = jnp.append(by_delta[:-1].ravel(), by_ends[:, 4:8] @ by_delta[-1])
    unfolding = jnp.append(jnp.zeros(4 * SEGMENTS - 4), by_ends[:, 8])
    columns = jnp.concatenate([inner[:-4], last]), delta[:, None], unfolding[:, None]
    return _Equations(value, jnp.concatenate(columns, axis=1), s)


# Where blocks (i, i) and (i, i + 1) of the Jacobian are.
_DIAGONAL = np.eye(SEGMENTS)[:, None, :, None]
_NEXT = np.einsum("ij,ab->iajb", np.eye(SEGMENTS, k=1), np.eye(4))


def _end_conditions(pendulum: Pendulum, start: Array, end: Array, unfolding: Scalar, arc: Arc) -> tuple[Array, Array]:
    """Five conditions on (start, end, unfolding), and their derivative, shape (5, 9).

    - centred: p(0) = 0, theta(T/4) = pi turns;
    - brake: p(0) = 0, p(T/2) = 0;
    - odd: x(T/2) = -x(0) up to full turns, where the upper rod is at its extreme, theta1' = 0. Energy is conserved, so
      that these are one too many for the period and the state; the unfolding parameter times grad H, added to them, is
      zero at every solution (Munoz-Almaraz et al., Physica D 181 (2003)).
    """
    full_turns = jnp.append(2 * jnp.pi * arc.turns, jnp.zeros(2))

    def gradient_and_rate(start: Array) -> Array:
        slope = _field(pendulum, State(*start))
        return jnp.concatenate([-slope[2:], slope[:2]])

    gradient, curvature = gradient_and_rate(start), jax.jacfwd(gradient_and_rate)(start)
    value = jnp.stack([
        jnp.concatenate([start[2:], end[:2] - jnp.pi * arc.turns, unfolding[None]]),
        jnp.concatenate([start[2:], end[2:], unfolding[None]]),
        jnp.append(end + start - full_turns + unfolding * gradient, gradient[2]),
    ])  # fmt: skip
    odd = jnp.column_stack([jnp.eye(4) + unfolding * curvature, jnp.eye(4), gradient])
    odd = jnp.concatenate([odd, jnp.append(curvature[2], jnp.zeros(5))[None]])
    derivative = jnp.stack([jnp.asarray(_AT_REST["centred"]), jnp.asarray(_AT_REST["brake"]), odd])
    return value[arc.symmetry], derivative[arc.symmetry]


def _rows(*columns: int) -> np.ndarray:
    return np.eye(9)[list(columns)]


# The derivatives of the conditions of orbits released from rest: of p(0), of theta or p at the end, of the unfolding.
_AT_REST = {"centred": _rows(2, 3, 4, 5, 8), "brake": _rows(2, 3, 6, 7, 8)}


# --- Newton's method and the walk along a family ---------------------------------------------------------------------

# Arclength: ds^2 is the mean over the nodes of dtheta1^2 + dtheta2^2, plus (d log Delta)^2.
METRIC = np.concatenate([np.tile([1.0, 1.0, 0.0, 0.0], SEGMENTS) / SEGMENTS, [1.0, 0.0]])
# Newton's update is then below rounding: its error is the square of this.
_TOLERANCE = 1e-8
# Where an orbit passes close by an equilibrium on its way, rounding is magnified by the inverse square of the distance:
# below this an update that does not shrink is noise, and the error estimate tells of it.
_NOISE = 1e-6
_MOST_ITERATIONS = 8
# What rounding leaves of an equation, relative to the coordinates that it is made of: two units in the last place.
# Measured against long double (experiments/orbit_errors.py), which shows the quantiles of estimate over error.
_ROUNDINGS = 2.0 * float(np.finfo(np.float64).eps)


class Corrected(NamedTuple):
    """A point on a family.

    Attributes:
        point, tangent: the unknowns there, and the unit tangent in the direction of the row it was sought with.
        side: sign of the bordered Jacobian's determinant: constant along a curve, it changes where another crosses, and
            on a jump to another one close by.
        miss, contraction: the first Newton update, and the second over the first.
        steps: how many a segment should have been given.
        converged: whether Newton's method did.
        angle_error: the change of the release on solving at half the step [rad].
        theta2_error, time_error: of theta2 [rad] and of the time, relative, at this theta1: the change on solving at
            half the step, and what rounding on the way makes of them.
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


# L and U in one matrix, and the order of the rows: what `lax.linalg.lu` has found already, and `lu_solve` finds anew.
_Factors = tuple[Array, Array]


def _solve(factors: _Factors, right: Array) -> Array:
    lu, order = factors
    half = lax.linalg.triangular_solve(lu, right[order], left_side=True, lower=True, unit_diagonal=True)
    return lax.linalg.triangular_solve(lu, half, left_side=True)


def _solve_transposed(factors: _Factors, right: Array) -> Array:
    lu, order = factors
    half = lax.linalg.triangular_solve(lu, right, left_side=True, transpose_a=True)
    whole = lax.linalg.triangular_solve(lu, half, left_side=True, lower=True, unit_diagonal=True, transpose_a=True)
    return jnp.zeros_like(right).at[order].set(whole)


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
    equations: _Equations
    factors: _Factors  # of the bordered Jacobian


def _rounding(point: Array, arc: Arc) -> Array:
    """By how much rounding on the way misses each of the equations, the border's included."""
    sizes = jnp.max(jnp.abs(point[:_LOG_DELTA].reshape(SEGMENTS, 4)), axis=0)
    none = jnp.zeros(2)
    ends = jnp.stack([jnp.append(none, sizes[:2]), jnp.append(none, sizes[2:]), sizes])[arc.symmetry]
    return _ROUNDINGS * jnp.concatenate([jnp.tile(sizes, SEGMENTS - 1), ends, none])


def _errors(n: _Newton, tangent: Array, time: Array, arc: Arc) -> Array:
    """The errors of theta2 and of the log of the time, whose gradient is `time`, at the point's own theta1.

    The point is off the curve by the last update and by rounding, which the transposed equations carry to what is
    asked. Where it is off in theta1, the curve's slope tells what the others are off by; at a fold, where that is
    infinite, its curvature does.
    """
    wanted = jnp.stack([jnp.eye(UNKNOWNS)[0], jnp.eye(UNKNOWNS)[1], time])
    pulled = _solve_transposed(n.factors, wanted.T).T * _rounding(n.point, arc)
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
    """The point of the family in the plane through `predicted` that `row` is normal to, by Newton's method.

    The last iteration takes half the step from where the others ended; its update, not made, is the error estimate.
    """
    unit = _units(pendulum)

    def iterate(n: _Newton) -> _Newton:
        estimating = n.done == 1
        equations = _equations(pendulum, n.point, jnp.where(estimating, 2 * steps, steps), arc)
        bordered = jnp.concatenate([equations.jacobian, row[None]])
        short = jnp.append(equations.value, row @ (n.point - predicted))
        factors, pivots, order = lax.linalg.lu(bordered)
        one = jnp.zeros(UNKNOWNS).at[-1].set(1.0)
        update, null = _solve((factors, order), jnp.stack([-short, one], axis=1)).T
        swaps = jnp.sum(pivots != jnp.arange(UNKNOWNS, dtype=pivots.dtype)) % 2
        side = jnp.prod(jnp.sign(jnp.diagonal(factors))) * jnp.where(swaps == 0, 1.0, -1.0)
        size = jnp.max(jnp.abs(update) / unit)
        iterations = n.iterations + 1
        contraction = jnp.where(iterations == 2, size / n.size, n.contraction)
        small = (size <= _TOLERANCE) | ((n.iterations > 0) & (size <= _NOISE) & (size > 0.1 * n.size))
        hopeless = ~(size < 2.0) | ((iterations > 1) & (size > n.size) & ~small) | (iterations >= _MOST_ITERATIONS)
        done = jnp.where(estimating, 2, jnp.where(small, 1, jnp.where(hopeless, 3, 0)))
        return _Newton(
            jnp.where(estimating, n.point, n.point + update), iterations, jnp.where(estimating, n.size, size),
            jnp.where(n.iterations == 0, size, n.first), contraction, done, update, null, side, equations,
            (factors, order),
        )  # fmt: skip

    def running(n: _Newton) -> Scalar:
        return n.done < 2

    zero = jnp.zeros(())
    blank = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(_equations, pendulum, predicted, steps, arc)
    )
    start = _Newton(
        predicted, jnp.asarray(0), jnp.asarray(jnp.inf), zero, zero, jnp.asarray(0), predicted, row, zero, blank,
        (jnp.eye(UNKNOWNS), jnp.zeros(UNKNOWNS, jnp.int32)),
    )  # fmt: skip
    n = lax.while_loop(running, iterate, start)
    tangent = n.null / jnp.sqrt(n.null @ (METRIC * n.null))
    s = n.equations.segments

    log_time = jnp.append(s.stretch.ravel() / jnp.sum(s.time), jnp.array([1.0, 0.0]))  # its gradient
    theta2_error, time_error = _errors(n, tangent, log_time, arc)

    def energy(x: Array) -> Scalar:
        return hamiltonian(pendulum, State(*x))

    level, slope = jax.jvp(energy, (n.point[:4],), (tangent[:4],))
    wanted = jnp.ceil(jnp.nan_to_num(jnp.max(s.turn) / _TURN, nan=1.0))
    return Corrected(
        point=n.point,
        tangent=tangent,
        side=n.side,
        miss=n.first,
        contraction=n.contraction,
        steps=jnp.clip(wanted, 1, _MOST_STEPS).astype(int),
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


def hermite(start: Any, slope: Any, end: Any, end_slope: Any, length: Any, s: Any) -> Any:
    """The cubic through two points with unit tangents, `length` apart, at s in [0, 1]; beyond 1 it predicts."""
    s2, s3 = s * s, s * s * s
    return (
        (2 * s3 - 3 * s2 + 1) * start
        + (s3 - 2 * s2 + s) * length * slope
        + (3 * s2 - 2 * s3) * end
        + (s3 - s2) * length * end_slope
    )


# The first step from a normal mode, where the linear motion is true to 1e-4.
FIRST_STEP = 0.02
# A step is taken back if the curve turned by more (cosine), or missed its prediction by more (of the step's length).
_LEAST_COSINE, _LARGEST_MISS, _WANTED_MISS = 0.95, 0.2, 0.02
# Newton's second update over its first (Deuflhard's contraction test), where they are not both small.
_LARGEST_CONTRACTION, _SMALL = 0.05, 1e-5
# Two curves that pass each other closer than this [arclength] count as crossing: the walk goes straight on, and tells.
# Where no step as short is taken, it leaps along the tangent from before the curve began to turn into the other; where
# that does not land either, it is a turn, however sharp, and is followed.
CROSSING, _LEAP = 2e-4, 0.01
_LARGEST_LEAP_MISS = 0.3
_SHORTEST_STEP = 1e-8
# Points in one call of the compiled walk.
CHUNK = 32


class Walk(NamedTuple):
    """Where a walk stands: its last point, the one before, and what it knows about the next step."""

    point: Any
    tangent: Any
    behind: Any
    behind_tangent: Any
    length: Any  # between the two, 0 at the start
    step: Any
    side: Any
    steps: Any
    straight: Any  # the last tangent that no curve close by had bent
    leap: Any  # 1 if the next step is one, 2 after one that did not land


def beginning(pendulum: Pendulum, slow: Scalar) -> Walk:
    """A walk at zero amplitude, about to follow the slow or the fast normal mode (natural units)."""
    modes = normal_modes(pendulum)
    mode = jax.tree.map(lambda a, b: jnp.where(slow, a, b), *modes)
    phase = 0.5 * jnp.pi / SEGMENTS * jnp.arange(SEGMENTS, dtype=jnp.float64)
    moving = momenta(pendulum, 0.0, 0.0, mode.frequency, mode.frequency * mode.ratio)  # at the bottom
    shape = [jnp.cos(phase), mode.ratio * jnp.cos(phase), -moving.p1 * jnp.sin(phase), -moving.p2 * jnp.sin(phase)]
    tangent = jnp.append(jnp.stack(shape, axis=1).ravel(), jnp.zeros(2))
    tangent = tangent / jnp.sqrt(tangent @ (METRIC * tangent))
    # There the fastest rate is that of the fast mode.
    delta = 0.5 * jnp.pi / mode.frequency * modes[1].frequency / SEGMENTS
    point = jnp.append(jnp.zeros(_LOG_DELTA), jnp.stack([jnp.log(delta), 0.0]))
    nothing = jnp.zeros(())
    first, steps = jnp.asarray(FIRST_STEP), jnp.asarray(4)
    return Walk(point, tangent, point, tangent, nothing, first, nothing, steps, tangent, jnp.asarray(0))


class Tasks(NamedTuple):
    """Points to be corrected one by one, each in the plane that its row is normal to; `CHUNK` of them at most."""

    points: Any
    rows: Any
    steps: Any
    number: Any


# Where a family ends: this close to the energy of an equilibrium with a rod upright (in units of the weights' torques,
# the energy's slope in arclength as small), or where it has shrunk to this amplitude [rad] about an equilibrium.
HOMOCLINIC, _SMALLEST = 1e-8, 0.01
# Orbits that pass an equilibrium on their way are known no better than rounding over the distance from its energy:
# where that has come to the second number [rad], the family has ended at the first.
NEARLY, _BLURRED = 1e-6, 1e-8


@jax.jit
def walk(
    pendulum: Pendulum, start: Walk, longest: Scalar, tasks: Tasks, arc: Arc
) -> tuple[Walk, Array, Scalar, Scalar]:
    """Up to `CHUNK` more points of a family, or instead the `tasks`, if there are any.

    One program for both, and for all symmetries: it takes seconds to compile.

    Returns:
        Where the walk stands, a table whose rows are `Corrected`, how many there are, and whether the family has ended
        (1), or no step is short enough (2).
    """
    given = tasks.number > 0
    most = jnp.where(given, tasks.number, CHUNK)

    def advance(carry: tuple) -> tuple:
        w, table, count, _ = carry
        ahead, along = _ahead(w)
        new = corrected(
            pendulum,
            jnp.where(given, tasks.points[count], ahead),
            jnp.where(given, tasks.rows[count], METRIC * along),
            jnp.where(given, tasks.steps[count], w.steps),
            arc,
        )
        row = jnp.concatenate([jnp.ravel(jnp.asarray(leaf, jnp.float64)) for leaf in new])
        table = table.at[count].set(row)  # a point taken back is overwritten by the next
        after, taken, status = _judged(pendulum, w, new, longest)
        after = jax.tree.map(partial(jnp.where, given), w, after)
        return after, table, count + (taken | given).astype(int), jnp.where(given, 0, status)

    def going(carry: tuple) -> Scalar:
        return (carry[2] < most) & (carry[3] == 0)

    begin = (start, jnp.zeros((CHUNK, ROW)), jnp.asarray(0), jnp.asarray(0))
    return lax.while_loop(going, advance, begin)


def stride(pendulum: Pendulum, w: Walk, longest: Scalar, arc: Arc) -> tuple[Walk, Corrected, Scalar, Scalar]:
    """One step of a walk, or an attempt: where it stands then, the point, whether it was taken, and the status that
    `walk` gives.
    """
    ahead, along = _ahead(w)
    new = corrected(pendulum, ahead, METRIC * along, w.steps, arc)
    after, taken, status = _judged(pendulum, w, new, longest)
    return after, new, taken, status


def _ahead(w: Walk) -> tuple[Array, Array]:
    """The predicted point, by the cubic if it is not much longer than the last step, and the direction it lies in."""
    near = (w.step <= 2.1 * w.length) & (w.length > 0) & (w.leap != 1)
    share = 1 + w.step / jnp.where(w.length > 0, w.length, 1.0)
    cubic = hermite(w.behind, w.behind_tangent, w.point, w.tangent, w.length, share)
    along = jnp.where(w.leap == 1, w.straight, w.tangent)
    return jnp.where(near, cubic, w.point + w.step * along), along


def _amplitude(point: Array) -> Scalar:
    """The largest angle from an equilibrium on the arc, as a sine."""
    return jnp.max(jnp.abs(jnp.sin(point[:_LOG_DELTA].reshape(SEGMENTS, 4)[:, :2])))


def _judged(pendulum: Pendulum, w: Walk, new: Corrected, longest: Scalar) -> tuple[Walk, Scalar, Scalar]:
    """The walk after a step, whether that was taken or taken back, and how the family stands."""
    miss = new.miss / w.step
    leaping = w.leap == 1
    same_side = (new.side == w.side) | (w.side == 0) | (w.step < CROSSING)
    smooth = (new.contraction <= _LARGEST_CONTRACTION) | (new.miss <= _SMALL)
    smooth = jnp.where(leaping, miss <= _LARGEST_LEAP_MISS, same_side & smooth & (miss <= _LARGEST_MISS))
    tangent = jnp.where(leaping, w.straight, w.tangent)
    good = new.converged & smooth & ((METRIC * new.tangent) @ tangent >= _LEAST_COSINE)
    taken = good & (2 * new.steps <= 3 * w.steps)
    growth = jnp.clip((_WANTED_MISS / jnp.fmax(miss, 1e-9)) ** 0.25, 0.5, 2.0)
    levels = equilibria(pendulum).energy
    unit = levels[3]  # upright: the weights' torques
    gaps = (new.energy - levels) / unit
    # Not past an equilibrium, where the curve goes on as its own mirror image.
    size, before_size = _amplitude(new.point), _amplitude(w.point)
    shrinking = size < before_size
    longest = jnp.where(shrinking, jnp.minimum(longest, 0.5 * size), longest)
    # A step that is taken back for want of integration steps is repeated with more.
    leap = jnp.where(leaping, 2, jnp.where((w.leap == 0) & (w.step < CROSSING), 1, w.leap))
    shorter = jnp.where(leaping, 0.5 * CROSSING, jnp.where(leap > w.leap, _LEAP, 0.5 * w.step))
    before = w._replace(
        step=jnp.where(good, w.step, shorter),
        steps=jnp.where(good, new.steps, w.steps),
        leap=jnp.where(good, w.leap, leap),
    )
    way = new.point - w.point
    bent = w.step < 10 * CROSSING
    after = Walk(
        point=new.point,
        tangent=new.tangent,
        behind=w.point,
        behind_tangent=w.tangent,
        length=jnp.sqrt(way @ (METRIC * way)),
        step=jnp.minimum(w.step * growth, longest),
        side=new.side,
        steps=new.steps,
        straight=jnp.where(bent, w.straight, new.tangent),
        leap=jnp.where(w.step < 2 * CROSSING, w.leap, 0),
    )
    close = jnp.where(new.angle_error > _BLURRED, NEARLY, HOMOCLINIC)
    homoclinic = jnp.any(jnp.abs(gaps[1:]) < close) & (jnp.abs(new.energy_slope) < 1e3 * close * unit)
    ended = homoclinic | (shrinking & (size < _SMALLEST))
    status = jnp.where(taken & ended, 1, jnp.where(w.step < _SHORTEST_STEP, 2, 0))
    return jax.tree.map(partial(jnp.where, taken), after, before), taken, status


# --- derivatives, and arcs of other orbits --------------------------------------------------------------------------


@partial(jax.jit, static_argnames="symmetry")
def sensitivities(
    ratios: Array, points: Array, rows: Array, steps: Array, turns: Array, symmetry: str
) -> Float[Array, "m 9 3"]:
    """Derivatives of what is known of orbits at row . point = target, by the implicit function theorem.

    Arguments:
        ratios: l2/l1 and m2/m1.
    Returns:
        Of the first node, the angles at the end, the arc's time, kappa and log |kappa| (natural units) with respect to
        the ratios and the target.
    """

    def one(task: tuple) -> Array:
        point, row, count = task
        return _sensitivity(ratios, point, row, count.astype(int), turns, symmetry)

    return lax.map(one, (points, rows, steps))


def _sensitivity(ratios: Array, point: Array, row: Array, steps: Scalar, turns: Array, symmetry: str) -> Array:
    arc = arc_of(symmetry, turns)

    def ends(ratios: Array) -> Array:
        here = Pendulum(1.0, ratios[0], 1.0, ratios[1], 1.0)
        nodes = point[:_LOG_DELTA].reshape(SEGMENTS, 4)
        time, _ = arc_times(here, point)
        end = _stack(moved(_METHOD, here, State(*nodes.T), step_size(time, steps), steps)).T
        conditions, _ = _end_conditions(here, nodes[0], end[-1], point[_UNFOLDING], arc)
        return jnp.concatenate([(end[:-1] - nodes[1:]).ravel(), conditions])

    def known(both: Array) -> Array:
        point, ratios = both[:-2], both[-2:]
        here = Pendulum(1.0, ratios[0], 1.0, ratios[1], 1.0)
        states = State(*point[:_LOG_DELTA].reshape(SEGMENTS, 4).T)
        times, _ = arc_times(here, point)
        end, matrices = transition(here, states, step_size(times, steps), steps, _METHOD)
        _, kappa, logarithm = stability_of(jnp.moveaxis(matrices, -1, 0), symmetry, jnp)
        last = jnp.stack([end.theta1[-1], end.theta2[-1], jnp.sum(times), kappa, logarithm])
        return jnp.concatenate([point[:4], last])

    jacobian = _equations(Pendulum(1.0, ratios[0], 1.0, ratios[1], 1.0), point, steps, arc).jacobian
    by_ratios = jax.jacfwd(ends)(ratios)
    right = jnp.zeros((UNKNOWNS, 3)).at[:-1, :2].set(-by_ratios).at[-1, 2].set(1.0)
    moves = jnp.linalg.solve(jnp.concatenate([jacobian, row[None]]), right)
    directions = jnp.concatenate([moves, jnp.eye(2, 3)]).T
    both = jnp.append(point, ratios)
    return jax.vmap(lambda direction: jax.jvp(known, (both,), (direction,))[1], out_axes=1)(directions)


@jax.jit
def linearised(pendulum: Pendulum, point: Array, steps: Scalar, arc: Arc) -> tuple[Array, Array]:
    """The equations at a point, one fewer than unknowns, and their Jacobian."""
    equations = _equations(pendulum, point, steps, arc)
    return equations.value, equations.jacobian


@jax.jit
def laid(pendulum: Pendulum, times: Array, states: Array, duration: Scalar) -> Array:
    """Nodes and log Delta of an arc of `duration` on an orbit of which some states are known.

    Arguments:
        times, states: known ones in order of time, beginning with (0, x(0)).
    """
    # As many as rates of four times the linear motion's need: what is laid will be corrected.
    rate = 4 * fast_frequency(pendulum) * jnp.sqrt(1 + pendulum.m2)

    def state_at(time: Scalar) -> Array:
        time = jnp.clip(time, 0.0, duration)
        nearest = jnp.searchsorted(times, time, side="right") - 1
        rest = time - times[nearest]
        steps = jnp.clip(jnp.ceil(rest * rate / _TURN), 1, 100 * _MOST_STEPS).astype(int)
        return _stack(moved(_METHOD, pendulum, State(*states[nearest]), step_size(rest, steps), steps))

    def nodes(delta: Scalar) -> tuple[Scalar, Array]:
        def step(time: Scalar, _: None) -> tuple[Scalar, Array]:
            x = state_at(time)
            return time + delta / fastest(pendulum, State(*x)), x

        return lax.scan(step, jnp.zeros(()), None, length=SEGMENTS)

    def halved(_: Scalar, bounds: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
        low, high = bounds
        middle = 0.5 * (low + high)
        short = nodes(jnp.exp(middle))[0] < duration
        return jnp.where(short, middle, low), jnp.where(short, high, middle)

    # The segments fill the arc the later, the larger Delta is.
    least = jnp.log(fast_frequency(pendulum) * duration / SEGMENTS)
    bounds = lax.fori_loop(0, _HALVINGS, halved, (least - 1.0, least + 5.0))
    middle = 0.5 * (bounds[0] + bounds[1])
    return jnp.concatenate([nodes(jnp.exp(middle))[1].ravel(), jnp.stack([middle, 0.0])])


# Newton's method does the rest.
_HALVINGS = 45
