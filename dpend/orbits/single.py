"""Single shooting: an orbit released from rest in one piece, by Newton's method on a line of
releases.
"""

import sys
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from dpend.checks import Scalar
from dpend.mechanics.linear import fastest, normal_modes
from dpend.mechanics.pendulum import Pendulum, State, released, vector_field
from dpend.methods.scheme import Scheme
from dpend.motion.integrate import march, step_size
from dpend.status import Status

RK8 = Scheme("rk8", 1.0)  # only its method is used: the number of steps is settled orbit by orbit
# No number is better known than this, relative to itself.
_LAST_BIT = sys.float_info.epsilon
# How many units in the last place of its coordinates, times sqrt(1 + m2/m1), the rounding of a step
# amounts to. Measured against long double (experiments/orbit_errors.py), which shows the quantiles
# of estimate over error.
_ROUNDINGS = 2.0
# A state on the way whose rounding was a displacement of the start by more than so many units in
# the last place no longer matters to where the root is, and its square would drown what does.
_FORGOTTEN = 1e5
# rate times step [rad]: leaves errors of rounding in theta2 and T.
FINE = 0.1
# A number of steps at which a motion cannot be what was meant: the search is lost.
MOST_STEPS_IN_ONE_PIECE = 200_000


class Line(NamedTuple):
    """The releases among which Newton's method searches: (theta1, theta2) = base + x direction."""

    base: Float[Array, "2"]
    direction: Float[Array, "2"]


class _Shot(NamedTuple):
    """The equations at one point: their value, and the Jacobian in (theta1, theta2, log of the
    shooting time).

    `by_start` is the derivative of the value with respect to the whole first state, momenta
    included; `rounding` is the covariance of that state which does to the end what a unit in the
    last place of every state on the way does.
    """

    value: Float[Array, "2"]
    jacobian: Float[Array, "2 3"]
    by_start: Float[Array, "2 4"]
    matrix: Float[Array, "4 4"]
    end: State
    rate: Scalar
    rounding: Float[Array, "4 4"]


def clock(pendulum: Pendulum) -> Scalar:
    """The rate that a pendulum's linear motions never exceed [rad/s]."""
    return normal_modes(pendulum)[1].frequency


def _momentum_unit(pendulum: Pendulum) -> Scalar:
    return pendulum.m2 * pendulum.l2 * jnp.sqrt(pendulum.g * pendulum.l2)


def steps_for(log_time: Scalar, rate: Scalar, turn: Scalar) -> Scalar:
    """How many steps a shooting time takes if the fastest motion may advance by `turn` [rad] in
    each.
    """
    wanted = jnp.ceil(jnp.exp(log_time) * rate / turn)
    return jnp.clip(jnp.nan_to_num(wanted, nan=8.0), 8, MOST_STEPS_IN_ONE_PIECE).astype(int)


@partial(jax.jit, static_argnames="symmetry")  # traced once for the walk and for Newton's method
def _shoot(
    pendulum: Pendulum, angles: Array, log_time: Scalar, steps: Scalar, symmetry: str, turns: Array
) -> _Shot:
    """The equations of `symmetry` for a release at `angles`, after a time exp(log_time) in `steps`
    steps.

    The brake equations are divided by the time: p(t) = 0 has the root t = 0, and p(t)/t has not.
    """
    time = jnp.exp(log_time)
    state = released(*angles)

    def step(carry: Any, time: Scalar, dt: Scalar) -> Any:
        state, tangents = RK8.advance_tangents(pendulum, carry[0], carry[1], dt)
        back = _inverse(tangents) * (_LAST_BIT * jnp.stack(jax.tree.leaves(state)))
        back = jnp.where(jnp.max(jnp.abs(back[:2])) < _FORGOTTEN * _LAST_BIT, back, 0.0)
        rounding = carry[3] + jnp.sum(
            back[:, None, :] * back[None, :, :], axis=2
        )  # fuses, and a product does not
        return state, tangents, jnp.fmax(carry[2], fastest(pendulum, state)), rounding

    start = (state, State(*jnp.eye(4)), fastest(pendulum, state), jnp.zeros((4, 4)))
    end, tangents, rate, rounding = march(step, start, step_size(time, steps), steps)
    matrix = jnp.stack(jax.tree.leaves(tangents))
    slope = vector_field(pendulum, end)
    if symmetry == "centred":
        value = jnp.stack([end.theta1, end.theta2]) - jnp.pi * turns
        by_start, by_time = matrix[:2], time * jnp.stack([slope.theta1, slope.theta2])
    else:
        unit = _momentum_unit(pendulum) * time * clock(pendulum)
        value = jnp.stack([end.p1, end.p2]) / unit
        by_start, by_time = matrix[2:] / unit, time * jnp.stack([slope.p1, slope.p2]) / unit - value
    jacobian = jnp.column_stack([by_start[:, :2], by_time])
    return _Shot(value, jacobian, by_start, matrix, end, rate, rounding)


def _inverse(tangents: State) -> Float[Array, "4 4"]:
    """The inverse of a symplectic matrix, of which these are the rows."""
    a, b = jnp.stack([tangents.theta1, tangents.theta2]), jnp.stack([tangents.p1, tangents.p2])
    above = jnp.concatenate([b[:, 2:].T, -a[:, 2:].T], axis=1)
    return jnp.concatenate([above, jnp.concatenate([-b[:, :2].T, a[:, :2].T], axis=1)])


# The largest update of x [rad] and of log T in one iteration.
_LARGEST_UPDATE = 0.5
_LEAST_DAMPING = 2.0**-12
# An update this small that is not shortened by this much damping is noise; the error estimate says
# how much.
_SMALL_UPDATE, _STALLED = 1e-6, 2.0**-4


class LineNewton(NamedTuple):
    x: Scalar
    log_time: Scalar
    size: Scalar  # of the next update, relative to the amplitude
    shot: _Shot
    update: Float[Array, "2"]
    damping: Scalar
    iterations: Scalar
    status: Scalar


def _newton_update(line: Line, jacobian: Array, value: Array) -> Array:
    """The change of (x, log of the shooting time) that the linear equations ask for; `value` may
    have columns.
    """
    square = jnp.column_stack([jacobian[:, :2] @ line.direction, jacobian[:, 2]])
    determinant = square[0, 0] * square[1, 1] - square[0, 1] * square[1, 0]
    adjugate = jnp.array([[square[1, 1], -square[0, 1]], [-square[1, 0], square[0, 0]]])
    return -(adjugate @ value) / determinant


def _rounding(pendulum: Pendulum, line: Line, shot: _Shot) -> Float[Array, "2"]:
    """What rounding on the way makes of (x, log of the shooting time).

    Each step's is independent of the others' and grows as the motion does from there; the root
    takes their sum as it takes any change of the equations.
    """
    by_start = _newton_update(line, shot.jacobian, shot.by_start)
    return (
        _ROUNDINGS
        * jnp.sqrt(1 + pendulum.m2 / pendulum.m1)
        * jnp.sqrt(jnp.maximum(jnp.diagonal(by_start @ shot.rounding @ by_start.T), 0.0))
    )


def newton_on_line(
    pendulum: Pendulum,
    line: Line,
    x: Scalar,
    log_time: Scalar,
    steps: Scalar,
    turns: Array,
    symmetry: str,
    tolerance: Scalar,
    max_iterations: Scalar,
) -> LineNewton:
    """Damped Newton for (x, log of the shooting time), the step count held fixed so that the
    equations are smooth.

    An update is halved until the next one, taken with the same Jacobian, is shorter: Deuflhard's
    natural monotonicity test, which does not depend on the conditioning of the equations. It has
    converged when the next update is below `tolerance` (relative to the amplitude, at most 1), or
    is small and no damping shortens it: that is rounding.
    """

    def shoot(x: Scalar, log_time: Scalar) -> _Shot:
        return _shoot(pendulum, line.base + x * line.direction, log_time, steps, symmetry, turns)

    newton_update = partial(_newton_update, line)

    def iterate(s: LineNewton) -> LineNewton:
        trial = jnp.stack([s.x, s.log_time]) + s.damping * s.update
        shot = shoot(*trial)
        amplitude = jnp.minimum(1.0, jnp.max(jnp.abs(line.base + trial[0] * line.direction)))
        unit = jnp.stack([amplitude, 1.0])
        same_jacobian = jnp.max(jnp.abs(newton_update(s.shot.jacobian, shot.value)) / unit)
        better = jnp.where(
            jnp.isinf(s.size), jnp.all(jnp.isfinite(shot.jacobian)), same_jacobian < s.size
        )
        stalled = ~better & (s.size <= _SMALL_UPDATE) & (s.damping <= _STALLED)
        update = newton_update(shot.jacobian, shot.value)
        size = jnp.max(jnp.abs(update) / unit)
        converged = (better & (size <= tolerance)) | stalled
        singular = better & ~jnp.all(jnp.isfinite(update))
        lost = ~better & (s.damping <= _LEAST_DAMPING)
        trivial = jnp.exp(trial[1]) * clock(pendulum) < _SHORTEST
        status = jnp.where(lost, Status.MAX_ITERATIONS, RUNNING)
        status = jnp.where(singular, Status.SINGULAR, status)
        status = jnp.where(better & trivial, Status.TRIVIAL_ROOT, status)
        status = jnp.where(converged, Status.CONVERGED, status)
        update = update * jnp.minimum(1.0, _LARGEST_UPDATE / jnp.max(jnp.abs(update)))
        keep = partial(jnp.where, better)
        return LineNewton(
            x=keep(trial[0], s.x),
            log_time=keep(trial[1], s.log_time),
            size=keep(size, s.size),
            shot=jax.tree.map(keep, shot, s.shot),
            update=jnp.where(better, update, s.update),
            damping=jnp.where(better, jnp.minimum(1.0, 2 * s.damping), s.damping / 2),
            iterations=s.iterations + 1,
            status=status,
        )

    nan = jnp.asarray(jnp.nan)
    blank = jax.tree.map(lambda leaf: jnp.full(leaf.shape, nan), jax.eval_shape(shoot, x, log_time))
    start = LineNewton(
        x,
        log_time,
        jnp.asarray(jnp.inf),
        blank,
        jnp.zeros(2),
        jnp.asarray(1.0),
        jnp.asarray(0),
        jnp.asarray(RUNNING),
    )
    end = lax.while_loop(
        lambda s: (s.status == RUNNING) & (s.iterations < max_iterations), iterate, start
    )
    status = jnp.where(end.status == RUNNING, Status.MAX_ITERATIONS, end.status)
    return end._replace(status=jnp.where(jnp.isfinite(end.size), status, Status.NONFINITE))


RUNNING = -1
# No brake orbit has a shooting time this short in units of the fast mode [rad]: the search ran into
# T = 0.
_SHORTEST = 0.02


def solve_twice(
    pendulum: Pendulum,
    line: Line,
    x: Scalar,
    log_time: Scalar,
    rate: Scalar,
    turns: Array,
    symmetry: str,
    settings: "Settings",
) -> tuple[LineNewton, Scalar, Array]:
    """Newton's root from a close guess, the number of steps it used, and the change of (x, log T)
    at half the step.
    """
    steps = steps_for(log_time, rate, settings.turn)

    def level(
        carry: tuple[Scalar, Scalar], factor: Scalar
    ) -> tuple[tuple[Scalar, Scalar], LineNewton]:
        newton = newton_on_line(
            pendulum,
            line,
            *carry,
            factor * steps,
            turns,
            symmetry,
            settings.tolerance,
            settings.max_iterations,
        )
        return (newton.x, newton.log_time), newton

    factors = jnp.array([1, 2] if settings.error else [1])
    _, both = lax.scan(level, (x, log_time), factors)
    newton = jax.tree.map(lambda leaf: leaf[0], both)
    change = jnp.full(2, jnp.nan)
    if settings.error:
        # With the finer root's last update, too small to be made: a change below the tolerance
        # would read zero.
        x, log_time = both.x[1] + both.update[1, 0], both.log_time[1] + both.update[1, 1]
        change = jnp.stack([jnp.abs(x - newton.x), jnp.abs(jnp.expm1(log_time - newton.log_time))])
        change = change + _rounding(pendulum, line, newton.shot)
        change = jnp.where(both.status[1] == Status.CONVERGED, change, jnp.nan)
    return newton, steps, change


class Settings(NamedTuple):
    """How a root is sought; `error` is static, the rest may be traced."""

    turn: Scalar
    tolerance: Scalar
    max_iterations: Scalar
    error: bool


def rate_along(
    pendulum: Pendulum, line: Line, x: Scalar, log_time: Scalar, steps: Scalar
) -> tuple[Scalar, Array]:
    """The largest rate on the way, and the angles at the end."""
    state = released(*(line.base + x * line.direction))

    def step(carry: Any, time: Scalar, dt: Scalar) -> Any:
        state = RK8.advance(pendulum, carry[0], dt)
        return state, jnp.fmax(carry[1], fastest(pendulum, state))

    dt = step_size(jnp.exp(log_time), steps)
    end, rate = march(step, (state, fastest(pendulum, state)), dt, steps)
    return rate, jnp.stack([end.theta1, end.theta2])


def residual_of(pendulum: Pendulum, newton: LineNewton, symmetry: str) -> Scalar:
    """The largest equation: an angle [rad] if centred, else a momentum in units of
    m2 l2 sqrt(g l2).
    """
    largest = jnp.max(jnp.abs(newton.shot.value))
    return (
        largest if symmetry == "centred" else largest * jnp.exp(newton.log_time) * clock(pendulum)
    )
