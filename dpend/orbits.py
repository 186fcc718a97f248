"""Periodic orbits released from rest, by symmetric shooting with Newton's method.

Shooting for a periodic orbit of a conservative system is singular by two. Released from rest it is not: with theta1
given, theta2 and the period are two unknowns for two equations, without a phase or an energy condition.

- brake: p(T/2) = 0, at rest again at the dual release;
- centred: theta(T/4) = 0 modulo pi, half the integration. The reversal (theta, p, t) -> (-theta, p, -t) about T/4 then
  gives x(T/2) = -x(0) up to full turns.

A branch is followed from its normal mode by the walk that families take (`shooting`), turning points in theta1
included; the orbit that it leads to is solved in one piece. Everything is traceable; derivatives with respect to the
pendulum and the release angle come from the implicit function theorem at the root, never from Newton's iterations.
"""

import math
import sys
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from dpend._runtime import require_float64
from dpend.checks import at_most_one, flag, integer, is_traced, known_value, number, one_of, several, single
from dpend.pendulum import (
    Pendulum,
    Scalar,
    State,
    check_pendulum,
    hamiltonian,
    known_pendulum,
    normal_modes,
    released,
    vector_field,
)
from dpend.shooting import PARTS, Walk, arc_of, arc_times, beginning, fastest, hermite, natural, stride
from dpend.stability import stability_class, stability_of, transition
from dpend.steppers import Scheme
from dpend.trajectory import Status, march, moved, step_size

BRANCHES = ("in-phase", "anti-phase")
SYMMETRIES = ("centred", "brake")

_RK8 = Scheme("rk8", 1.0)  # only its method is used: the number of steps is settled orbit by orbit
# No number is better known than this, relative to itself.
_LAST_BIT = sys.float_info.epsilon
# How many units in the last place of its coordinates, times sqrt(1 + m2/m1), the rounding of a step amounts to.
# Measured against long double (experiments/orbit_errors.py), which shows the quantiles of estimate over error.
_ROUNDINGS = 2.0
# A state on the way whose rounding was a displacement of the start by more than so many units in the last place no
# longer matters to where the root is, and its square would drown what does.
_FORGOTTEN = 1e5
# rate times step [rad]: leaves errors of rounding in theta2 and T.
_FINE = 0.1
# A number of steps at which a motion cannot be what was meant: the search is lost.
_MOST_STEPS = 200_000


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PeriodicOrbit:
    """A periodic orbit, released from rest unless it is `odd`, or many of one shape.

    Attributes:
        pendulum: its pendulum.
        state: at t = 0, at rest; of an odd orbit where theta1 is at an extreme.
        period: the minimal one [s].
        energy: H [J], zero for both bobs at rest at the pivot's height.
        residual: of the equations solved: angles at T/4 [rad] if centred, else momenta at T/2 in units of
            m2 l2 sqrt(g l2); the larger of the two. On a family the largest of all its segments' equations, in units of
            l1, m1 and g.
        iterations: Newton iterations spent on it, each one integration with its Jacobian and one linear solve; on a
            branch those of the walk's last step and those at the wanted release.
        kappa: half the sum of the two non-trivial Floquet multipliers.
        log_abs_kappa: log |kappa|, natural.
        dual: the state at T/2, the other rest of the orbit.
        turns: theta(T/4)/pi of a centred orbit, two integers; zeros otherwise.
        error_estimate: of theta2 [rad] (of theta1 with `ratio`) and the period [s], theta1 taken as it is: the change
            on solving again at half the step, and what the rounding of the motion makes of them; NaN if that was not
            asked for.
        status: a value of `Status`.
        symmetry: `centred` (theta(T/4) in {0, pi}^2 modulo 2 pi), `brake` (any other released from rest), or `odd`
            (x(T/2) = -x(0) up to full turns, never at rest; found by `follow_family`).
    """

    pendulum: Pendulum
    state: State
    period: Scalar
    energy: Scalar
    residual: Scalar
    iterations: Scalar
    kappa: Scalar
    log_abs_kappa: Scalar
    dual: State
    turns: tuple[Scalar, Scalar]
    error_estimate: tuple[Scalar, Scalar]
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


# --- the equations ---------------------------------------------------------------------------------------------------


class _Line(NamedTuple):
    """The releases among which Newton's method searches: (theta1, theta2) = base + x direction."""

    base: Float[Array, "2"]
    direction: Float[Array, "2"]


class _Shot(NamedTuple):
    """The equations at one point: their value, and the Jacobian in (theta1, theta2, log of the shooting time).

    `by_start` is the derivative of the value with respect to the whole first state, momenta included; `rounding` is the
    covariance of that state which does to the end what a unit in the last place of every state on the way does.
    """

    value: Float[Array, "2"]
    jacobian: Float[Array, "2 3"]
    by_start: Float[Array, "2 4"]
    matrix: Float[Array, "4 4"]
    end: State
    rate: Scalar
    rounding: Float[Array, "4 4"]


def _clock(pendulum: Pendulum) -> Scalar:
    """The rate that a pendulum's linear motions never exceed [rad/s]."""
    return normal_modes(pendulum)[1].frequency


def _momentum_unit(pendulum: Pendulum) -> Scalar:
    return pendulum.m2 * pendulum.l2 * jnp.sqrt(pendulum.g * pendulum.l2)


def _steps_for(log_time: Scalar, rate: Scalar, turn: Scalar) -> Scalar:
    """How many steps a shooting time takes if the fastest motion may advance by `turn` [rad] in each."""
    wanted = jnp.ceil(jnp.exp(log_time) * rate / turn)
    return jnp.clip(jnp.nan_to_num(wanted, nan=8.0), 8, _MOST_STEPS).astype(int)


@partial(jax.jit, static_argnames="symmetry")  # traced once for the walk and for Newton's method
def _shoot(pendulum: Pendulum, angles: Array, log_time: Scalar, steps: Scalar, symmetry: str, turns: Array) -> _Shot:
    """The equations of `symmetry` for a release at `angles`, after a time exp(log_time) in `steps` steps.

    The brake equations are divided by the time: p(t) = 0 has the root t = 0, and p(t)/t has not.
    """
    time = jnp.exp(log_time)
    state = released(*angles)

    def step(carry: Any, time: Scalar, dt: Scalar) -> Any:
        state, tangents = _RK8.advance_tangents(pendulum, carry[0], carry[1], dt)
        back = _inverse(tangents) * (_LAST_BIT * jnp.stack(jax.tree.leaves(state)))
        back = jnp.where(jnp.max(jnp.abs(back[:2])) < _FORGOTTEN * _LAST_BIT, back, 0.0)
        rounding = carry[3] + jnp.sum(back[:, None, :] * back[None, :, :], axis=2)  # fuses, and a product does not
        return state, tangents, jnp.fmax(carry[2], fastest(pendulum, state)), rounding

    start = (state, State(*jnp.eye(4)), fastest(pendulum, state), jnp.zeros((4, 4)))
    end, tangents, rate, rounding = march(step, start, step_size(time, steps), steps)
    matrix = jnp.stack(jax.tree.leaves(tangents))
    slope = vector_field(pendulum, end)
    if symmetry == "centred":
        value = jnp.stack([end.theta1, end.theta2]) - jnp.pi * turns
        by_start, by_time = matrix[:2], time * jnp.stack([slope.theta1, slope.theta2])
    else:
        unit = _momentum_unit(pendulum) * time * _clock(pendulum)
        value = jnp.stack([end.p1, end.p2]) / unit
        by_start, by_time = matrix[2:] / unit, time * jnp.stack([slope.p1, slope.p2]) / unit - value
    jacobian = jnp.column_stack([by_start[:, :2], by_time])
    return _Shot(value, jacobian, by_start, matrix, end, rate, rounding)


def _inverse(tangents: State) -> Float[Array, "4 4"]:
    """The inverse of a symplectic matrix, of which these are the rows."""
    a, b = jnp.stack([tangents.theta1, tangents.theta2]), jnp.stack([tangents.p1, tangents.p2])
    above = jnp.concatenate([b[:, 2:].T, -a[:, 2:].T], axis=1)
    return jnp.concatenate([above, jnp.concatenate([-b[:, :2].T, a[:, :2].T], axis=1)])


# --- Newton's method on a line ---------------------------------------------------------------------------------------

# The largest update of x [rad] and of log T in one iteration.
_LARGEST_UPDATE = 0.5
_LEAST_DAMPING = 2.0**-12
# An update this small that is not shortened by this much damping is noise; the error estimate says how much.
_SMALL, _STALLED = 1e-6, 2.0**-4


class _Newton(NamedTuple):
    x: Scalar
    log_time: Scalar
    size: Scalar  # of the next update, relative to the amplitude
    shot: _Shot
    update: Float[Array, "2"]
    damping: Scalar
    iterations: Scalar
    status: Scalar


def _newton_update(line: _Line, jacobian: Array, value: Array) -> Array:
    """The change of (x, log of the shooting time) that the linear equations ask for; `value` may have columns."""
    square = jnp.column_stack([jacobian[:, :2] @ line.direction, jacobian[:, 2]])
    determinant = square[0, 0] * square[1, 1] - square[0, 1] * square[1, 0]
    adjugate = jnp.array([[square[1, 1], -square[0, 1]], [-square[1, 0], square[0, 0]]])
    return -(adjugate @ value) / determinant


def _rounding(pendulum: Pendulum, line: _Line, shot: _Shot) -> Float[Array, "2"]:
    """What rounding on the way makes of (x, log of the shooting time).

    Each step's is independent of the others' and grows as the motion does from there; the root takes their sum as it
    takes any change of the equations.
    """
    by_start = _newton_update(line, shot.jacobian, shot.by_start)
    return (
        _ROUNDINGS
        * jnp.sqrt(1 + pendulum.m2 / pendulum.m1)
        * jnp.sqrt(jnp.maximum(jnp.diagonal(by_start @ shot.rounding @ by_start.T), 0.0))
    )


def _newton(
    pendulum: Pendulum, line: _Line, x: Scalar, log_time: Scalar, steps: Scalar, turns: Array, symmetry: str,
    tolerance: Scalar, max_iterations: Scalar,
) -> _Newton:  # fmt: skip
    """Damped Newton for (x, log of the shooting time), the step count held fixed so that the equations are smooth.

    An update is halved until the next one, taken with the same Jacobian, is shorter: Deuflhard's natural monotonicity
    test, which does not depend on the conditioning of the equations. It has converged when the next update is below
    `tolerance` (relative to the amplitude, at most 1), or is small and no damping shortens it: that is rounding.
    """

    def shoot(x: Scalar, log_time: Scalar) -> _Shot:
        return _shoot(pendulum, line.base + x * line.direction, log_time, steps, symmetry, turns)

    newton_update = partial(_newton_update, line)

    def iterate(s: _Newton) -> _Newton:
        trial = jnp.stack([s.x, s.log_time]) + s.damping * s.update
        shot = shoot(*trial)
        amplitude = jnp.minimum(1.0, jnp.max(jnp.abs(line.base + trial[0] * line.direction)))
        unit = jnp.stack([amplitude, 1.0])
        same_jacobian = jnp.max(jnp.abs(newton_update(s.shot.jacobian, shot.value)) / unit)
        better = jnp.where(jnp.isinf(s.size), jnp.all(jnp.isfinite(shot.jacobian)), same_jacobian < s.size)
        stalled = ~better & (s.size <= _SMALL) & (s.damping <= _STALLED)
        update = newton_update(shot.jacobian, shot.value)
        size = jnp.max(jnp.abs(update) / unit)
        converged = (better & (size <= tolerance)) | stalled
        singular = better & ~jnp.all(jnp.isfinite(update))
        lost = ~better & (s.damping <= _LEAST_DAMPING)
        trivial = jnp.exp(trial[1]) * _clock(pendulum) < _SHORTEST
        status = jnp.where(lost, Status.MAX_ITERATIONS, _RUNNING)
        status = jnp.where(singular, Status.SINGULAR, status)
        status = jnp.where(better & trivial, Status.TRIVIAL_ROOT, status)
        status = jnp.where(converged, Status.CONVERGED, status)
        update = update * jnp.minimum(1.0, _LARGEST_UPDATE / jnp.max(jnp.abs(update)))
        keep = partial(jnp.where, better)
        return _Newton(
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
    start = _Newton(
        x, log_time, jnp.asarray(jnp.inf), blank, jnp.zeros(2), jnp.asarray(1.0), jnp.asarray(0), jnp.asarray(_RUNNING)
    )
    end = lax.while_loop(lambda s: (s.status == _RUNNING) & (s.iterations < max_iterations), iterate, start)
    status = jnp.where(end.status == _RUNNING, Status.MAX_ITERATIONS, end.status)
    return end._replace(status=jnp.where(jnp.isfinite(end.size), status, Status.NONFINITE))


_RUNNING = -1
# No brake orbit has a shooting time this short in units of the fast mode [rad]: the search ran into T = 0.
_SHORTEST = 0.02


# --- following a branch ----------------------------------------------------------------------------------------------

# The longest step in arclength: its cubic is true to a thousandth, from where Newton's method goes on.
_LONGEST_STEP = 0.25
_MOST_POINTS = 5000
# Each step is looked at in this many pieces for crossings: no step turns enough to cross twice within one of them.
_PIECES = 16


class _Search(NamedTuple):
    """A walk along a branch to where it meets the wanted release."""

    walk: Walk
    iterations: Scalar
    points: Scalar
    attempts: Scalar
    crossings: Scalar
    best: Float[Array, " D"]
    reach: Float[Array, " D"]
    found: Scalar
    status: Scalar


def _searched(pendulum: Pendulum, slow: Scalar, target: Scalar, crossing: Scalar, ratio: Scalar) -> _Search:
    """Follows a centred family from its normal mode to where it meets the wanted release.

    With `ratio` zero that is the `crossing`-th time that |theta1| = target; the orbit released at (-theta1, -theta2) is
    the same one, half a period later. Otherwise it is the release with theta2 = ratio theta1 nearest to `target`.
    """
    scaled = natural(pendulum)
    arc = arc_of("centred")

    def wanted(angles: Array) -> Array:
        return jnp.where(ratio == 0, jnp.abs(angles[0]) - target, angles[1] - ratio * angles[0])

    def advance(s: _Search) -> _Search:
        walk, new, taken, end = stride(scaled, s.walk, jnp.asarray(_LONGEST_STEP), arc)
        further = jnp.abs(new.point[0]) > jnp.abs(s.reach[0])
        after = s._replace(
            walk=walk,
            iterations=new.iterations,
            points=s.points + 1,
            reach=jnp.where(further, new.point, s.reach),
            status=jnp.where(end == 1, jnp.where(s.found, Status.CONVERGED, Status.NO_SUCH_ORBIT), _RUNNING),
        )
        after = _looked_at(after, wanted, target, crossing, ratio)
        before = s._replace(walk=walk, status=jnp.where(end == 2, Status.LEFT_BRANCH, _RUNNING))
        s = jax.tree.map(partial(jnp.where, taken), after, before)
        gave_up = (s.points >= _MOST_POINTS) | (s.attempts >= 3 * _MOST_POINTS)
        status = jnp.where((s.status == _RUNNING) & gave_up, Status.LEFT_BRANCH, s.status)
        return s._replace(attempts=s.attempts + 1, status=status)

    begin = beginning(scaled, slow)
    finite = jnp.isfinite(target + jnp.sum(begin.point) + jnp.sum(begin.tangent))
    zero = jnp.asarray(0)
    start = _Search(
        begin, iterations=zero, points=zero, attempts=zero, crossings=zero, best=begin.point, reach=begin.point,
        found=jnp.asarray(False), status=jnp.where(finite, _RUNNING, Status.NONFINITE),
    )  # fmt: skip
    return lax.while_loop(lambda s: s.status == _RUNNING, advance, start)


def _looked_at(s: _Search, wanted: Any, target: Scalar, crossing: Scalar, ratio: Scalar) -> _Search:
    """The search after its newest step has been looked at for the wanted release."""
    w = s.walk

    def at(share: Scalar) -> Array:
        return hermite(w.behind, w.behind_tangent, w.point, w.tangent, w.length, share)

    points = jax.vmap(at)(jnp.arange(_PIECES + 1) / _PIECES)
    values = jax.vmap(wanted)(points)
    changes = values[:-1] * values[1:] < 0
    seen = s.crossings + jnp.cumsum(changes)
    nearness = jnp.where(changes, jnp.abs(jnp.abs(points[1:, 0]) - target), jnp.inf)
    closer = jnp.min(nearness) < jnp.where(s.found, jnp.abs(jnp.abs(s.best[0]) - target), jnp.inf)
    nearest = (jnp.arange(_PIECES) == jnp.argmin(nearness)) & closer
    here = jnp.where(ratio == 0, changes & (seen == crossing), nearest)
    hit = jnp.any(here)
    left = jnp.argmax(here) / _PIECES
    sign = jnp.sign(wanted(at(left)))

    def halve(_: Scalar, bounds: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
        low, high = bounds
        middle = 0.5 * (low + high)
        before = wanted(at(middle)[:2]) * sign > 0
        return jnp.where(before, middle, low), jnp.where(before, high, middle)

    low, high = lax.fori_loop(0, 50, halve, (left, left + 1 / _PIECES))
    best = jnp.where(hit, at(0.5 * (low + high)), s.best)
    found = s.found | hit
    # With a ratio, further on only a branch that turned back could come nearer to the target.
    beyond = found & (jnp.abs(w.point[0]) - target > jnp.abs(jnp.abs(best[0]) - target))
    over = jnp.where(ratio == 0, hit, beyond)
    status = jnp.where(over, Status.CONVERGED, s.status)
    return s._replace(crossings=seen[-1], best=best, found=found, status=status)


def _timed(pendulum: Pendulum, point: Array) -> tuple[Scalar, Scalar]:
    """The log of a point's shooting time [s], and the largest rate at its nodes [rad/s]."""
    second = jnp.sqrt(pendulum.l1 / pendulum.g)
    times, rates = arc_times(natural(pendulum), point)
    return jnp.log(jnp.sum(times) * second), jnp.max(rates) / second


# --- from a root to an orbit -----------------------------------------------------------------------------------------


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _implicit(symmetry: str, root: Array, parameters: Array, direction: Array, steps: Array) -> Array:
    """`root` = (x, log of the shooting time), whose value is known already, as a function of the parameters.

    F(root, parameters) = 0 gives d root = -(dF/d root)^-1 (dF/d parameters) d parameters. Both Jacobians are taken
    forwards and do not depend on the tangent, so that the rule can be transposed although the flow's loop cannot.

    Arguments:
        parameters: l1, l2, m1, m2, g and the line's base, shape (7,).
        steps: how many, as a float, since a rule's arguments need tangents.
    """
    return root


@_implicit.defjvp
def _implicit_jvp(symmetry, primals, tangents):  # type: ignore[no-untyped-def]
    _, parameters, direction, steps = primals
    root = _implicit(symmetry, *primals)  # by way of this rule, so that second derivatives know how the root moves

    def equations(both: Array) -> Array:
        (x, log_time), parameters = both[:2], both[2:]
        pendulum, time, count = Pendulum(*parameters[:5]), jnp.exp(log_time), steps.astype(int)
        start = released(*(parameters[5:] + x * direction))
        end = moved(_RK8, pendulum, start, step_size(time, count), count)
        # Momenta without their unit: at a root the factor does not matter.
        return jnp.stack([end.theta1, end.theta2] if symmetry == "centred" else [end.p1, end.p2])

    jacobian = jax.jacfwd(equations)(jnp.concatenate([root, parameters]))
    return root, -jnp.linalg.solve(jacobian[:, :2], jacobian[:, 2:] @ tangents[1])


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _kappas(symmetry: str, value: Array, orbit: Array, steps: Array) -> Array:
    """`value` = (kappa, log |kappa|), known from the root's own integration, as a function of the orbit.

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
        _, matrix = transition(Pendulum(*orbit[:5]), released(*orbit[5:7]), dt, count, _RK8)
        return _kappas_of(symmetry, matrix)

    return _kappas(symmetry, *primals), jax.jacfwd(again)(orbit) @ tangents[1]


def _kappas_of(symmetry: str, matrix: Array) -> Array:
    """kappa and log |kappa| from the transition matrix over the shooting time."""
    return jnp.stack(stability_of(matrix[None], symmetry, jnp)[1:])


def _solved(
    pendulum: Pendulum,
    line: _Line,
    x: Scalar,
    log_time: Scalar,
    rate: Scalar,
    turns: Array,
    symmetry: str,
    settings: "_Settings",
) -> tuple[_Newton, Scalar, Array]:
    """Newton's root from a close guess, the number of steps it used, and the change of (x, T) at half the step."""
    steps = _steps_for(log_time, rate, settings.turn)

    def level(carry: tuple[Scalar, Scalar], factor: Scalar) -> tuple[tuple[Scalar, Scalar], _Newton]:
        newton = _newton(
            pendulum, line, *carry, factor * steps, turns, symmetry, settings.tolerance, settings.max_iterations
        )
        return (newton.x, newton.log_time), newton

    factors = jnp.array([1, 2] if settings.error else [1])
    _, both = lax.scan(level, (x, log_time), factors)
    newton = jax.tree.map(lambda leaf: leaf[0], both)
    change = jnp.full(2, jnp.nan)
    if settings.error:
        # With the finer root's last update, too small to be made: a change below the tolerance would read zero.
        x, log_time = both.x[1] + both.update[1, 0], both.log_time[1] + both.update[1, 1]
        period = PARTS[symmetry] * jnp.exp(newton.log_time)
        change = jnp.stack([jnp.abs(x - newton.x), period * jnp.abs(jnp.expm1(log_time - newton.log_time))])
        change = change + _rounding(pendulum, line, newton.shot) * jnp.stack([1.0, period])
        change = jnp.where(both.status[1] == Status.CONVERGED, change, jnp.nan)
    return newton, steps, change


class _Settings(NamedTuple):
    """How a root is sought; `error` is static, the rest may be traced."""

    turn: Scalar
    tolerance: Scalar
    max_iterations: Scalar
    error: bool


def _orbit(
    pendulum: Pendulum,
    line: _Line,
    newton: _Newton,
    steps: Scalar,
    change: Array,
    turns: Array,
    symmetry: str,
    status: Scalar,
) -> PeriodicOrbit:
    """The orbit at a root; `pendulum` and `line` carry derivatives, the root itself has none yet."""
    pack = [jnp.asarray(leaf, jnp.float64) for leaf in jax.tree.leaves(pendulum)]
    steps = steps.astype(jnp.float64)
    root = jnp.stack([newton.x, newton.log_time])
    x, log_time = _implicit(symmetry, root, jnp.stack([*pack, *line.base]), line.direction, steps)
    theta1, theta2 = line.base + x * line.direction
    state = released(theta1, theta2)
    known = _kappas_of(symmetry, newton.shot.matrix)
    kappa, log_abs_kappa = _kappas(symmetry, known, jnp.stack([*pack, theta1, theta2, log_time]), steps)
    if symmetry == "centred":
        dual = released(2 * jnp.pi * turns[0] - theta1, 2 * jnp.pi * turns[1] - theta2)
        residual = jnp.max(jnp.abs(newton.shot.value))
    else:
        dual = released(newton.shot.end.theta1, newton.shot.end.theta2)
        residual = jnp.max(jnp.abs(newton.shot.value)) * jnp.exp(newton.log_time) * _clock(pendulum)
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
    """Derivatives of what is known of a centred orbit by the implicit function theorem, without solving it again.

    Returns:
        Of theta2, log T, kappa and log |kappa| (rows) with respect to l1, l2, m1, m2, g and theta1.
    """
    pendulum, theta1, theta2, log_time = orbit.pendulum, orbit.theta1, orbit.theta2, jnp.log(0.25 * orbit.period)
    line = _Line(jnp.stack([theta1, 0.0]), jnp.array([0.0, 1.0]))
    rate, _ = _rate_along(pendulum, line, theta2, log_time, _steps_for(log_time, _clock(pendulum), _FINE))
    steps = _steps_for(log_time, rate, _FINE).astype(jnp.float64)
    kappas = jnp.stack([orbit.kappa, orbit.log_abs_kappa])

    def known(parameters: Array) -> Array:
        base = jnp.append(parameters, 0.0)
        root = _implicit("centred", jnp.stack([theta2, log_time]), base, line.direction, steps)
        return jnp.concatenate([root, _kappas("centred", kappas, jnp.concatenate([parameters, root]), steps)])

    return jax.jacfwd(known)(jnp.stack([*jax.tree.leaves(pendulum), theta1]))


def mirrored(orbit: PeriodicOrbit, sign: Scalar) -> PeriodicOrbit:
    """The mirror image x -> -x where `sign`, of the leaves' shape, is -1."""
    state, dual = (jax.tree.map(lambda leaf: sign * leaf, x) for x in (orbit.state, orbit.dual))
    turns = (sign.astype(int) * orbit.turns[0], sign.astype(int) * orbit.turns[1])
    return replace(orbit, state=state, dual=dual, turns=turns)


@partial(jax.jit, static_argnames="error")
def _on_branch(pendulum, theta1, slow, crossing, ratio, error, turn, tolerance, max_iterations):  # type: ignore[no-untyped-def]
    """The orbit where a branch meets theta1 for the `crossing`-th time; if `ratio` is not zero, theta2 = ratio theta1
    nearest to it.
    """
    fixed = lax.stop_gradient(pendulum)
    sign = jnp.where(theta1 < 0, -1.0, 1.0)
    target = jnp.abs(theta1)
    search = _searched(fixed, slow, lax.stop_gradient(target), crossing, ratio)
    found = search.found
    point = jnp.where(found, search.best, search.reach)
    log_time, rate = _timed(fixed, point)
    guess = point[:2] * jnp.where(point[0] < 0, -1.0, 1.0)  # the same orbit, from its other rest
    at_angle = ratio == 0
    release = jnp.where(found, target, guess[0])
    # The cubic's theta2 belongs to the cubic's theta1, which is off by rounding where the target is tiny.
    x = jnp.where(at_angle, guess[1] * lax.stop_gradient(release) / guess[0], guess[0])
    zero = jnp.zeros(())
    base = jnp.stack([jnp.where(at_angle, release, zero), zero])
    line = _Line(base, jnp.where(at_angle, jnp.array([0.0, 1.0]), jnp.stack([1.0 + zero, ratio])))
    # The nodes do not see how fast the rods fly between them.
    still = lax.stop_gradient(line)
    between, _ = _rate_along(fixed, still, x, log_time, _steps_for(log_time, rate, turn))
    rate = jnp.fmax(rate, between)
    settings = _Settings(turn, tolerance, jnp.where(found, max_iterations, 1), error)
    turns = jnp.zeros(2)
    newton, steps, change = _solved(fixed, still, x, log_time, rate, turns, "centred", settings)
    moved = jnp.abs(newton.x - x) > _LEFT * jnp.maximum(search.walk.length, jnp.abs(x))
    status = jnp.where((newton.status == Status.CONVERGED) & moved, Status.LEFT_BRANCH, newton.status)
    status = jnp.where(found, status, search.status)
    newton = newton._replace(iterations=newton.iterations + search.iterations)
    orbit = _orbit(pendulum, line, newton, steps, change, turns, "centred", status)
    return mirrored(orbit, sign)


# The walk's cubic is true to a few thousandths of its step: a root further away than this share of it is another orbit.
_LEFT = 0.1


# --- from a guess ----------------------------------------------------------------------------------------------------

# How fast either rod may turn where the motion rests, in units of its fastest before: the root has 1e-12, and grows by
# no more than the root of 1e16 up to the first of several rests. And how near to an equilibrium a search may end, in
# units of the swing.
_SAME = 1e-6
# Secants for the place of a rest within a step of 0.1 rad: it is then known to 1e-12 of the step.
_TRIES = 5


@partial(jax.jit, static_argnames=("symmetry", "error"))
def _near_guess(pendulum, line, x, log_time, symmetry, error, turn, tolerance, max_iterations):  # type: ignore[no-untyped-def]
    """The orbit to which Newton's method leads from (x, log of the shooting time), with its minimal period."""
    fixed, still = lax.stop_gradient((pendulum, line))
    rate = _clock(fixed)
    for _ in range(2):  # the rate decides the steps, and the steps what rate is seen
        rate, end = _rate_along(fixed, still, x, log_time, _steps_for(log_time, rate, turn))
    turns = jnp.round(end / jnp.pi) if symmetry == "centred" else jnp.zeros(2)
    too_long = jnp.exp(log_time) * rate > turn * _MOST_STEPS
    steps = jnp.where(too_long, 8, _steps_for(log_time, rate, turn))
    most = jnp.where(too_long, 1, max_iterations)
    first = _newton(fixed, still, x, log_time, steps, turns, symmetry, tolerance, most)
    angles = still.base + first.x * still.direction
    log_time, turns = _minimal(fixed, angles, first.log_time, steps, turns, symmetry)
    reduced = log_time < first.log_time
    settings = _Settings(turn, tolerance, jnp.maximum(most - first.iterations, 1), error)
    newton, steps, change = _solved(fixed, still, first.x, log_time, first.shot.rate, turns, symmetry, settings)
    at_equilibrium = _swing(angles) < _SAME * jnp.minimum(1.0, _swing(still.base + x * still.direction))
    # Many periods of an unstable orbit are too long for Newton's method, and one is not.
    status = jnp.where((first.status == Status.CONVERGED) | reduced, newton.status, first.status)
    status = jnp.where(too_long, Status.BEYOND_HORIZON, status)
    status = jnp.where(at_equilibrium, Status.TRIVIAL_ROOT, status)
    newton = newton._replace(iterations=first.iterations + newton.iterations)
    orbit = _orbit(pendulum, line, newton, steps, change, turns, symmetry, status)
    unknown = jnp.where(too_long, jnp.nan, 0.0)
    return replace(orbit, kappa=orbit.kappa + unknown, log_abs_kappa=orbit.log_abs_kappa + unknown)


def _swing(angles: Array) -> Scalar:
    """How far a release is from the nearest equilibrium [rad, up to 1]: the scale of all that is small."""
    return jnp.max(jnp.abs(jnp.sin(angles)))


def _rate_along(pendulum: Pendulum, line: _Line, x: Scalar, log_time: Scalar, steps: Scalar) -> tuple[Scalar, Array]:
    """The largest rate on the way, and the angles at the end."""
    state = released(*(line.base + x * line.direction))

    def step(carry: Any, time: Scalar, dt: Scalar) -> Any:
        state = _RK8.advance(pendulum, carry[0], dt)
        return state, jnp.fmax(carry[1], fastest(pendulum, state))

    dt = step_size(jnp.exp(log_time), steps)
    end, rate = march(step, (state, fastest(pendulum, state)), dt, steps)
    return rate, jnp.stack([end.theta1, end.theta2])


class _Pass(NamedTuple):
    """Where a search for a rest stands: a step that began at `state` and is tried up to `ahead` [s] from there."""

    state: State
    slope: Scalar  # of the kinetic energy, at `state`
    time: Scalar
    ahead: Scalar
    tries: Scalar  # of the step's lowest point; 0 while nothing is seen
    before: tuple[Scalar, Scalar]  # the last try: how far ahead, and the slope there
    next: tuple[State, Scalar]  # the step's end, and the slope there
    fastest: Float[Array, "2"]  # the largest rates so far
    end: State
    found: Scalar


def _first_rest(pendulum: Pendulum, angles: Array, log_time: Scalar, steps: Scalar) -> tuple[Scalar, State, Scalar]:
    """The time of the first rest after the release, the state there, and whether there is one before exp(log_time).

    At a rest the kinetic energy has a minimum, whose place is where its slope vanishes: found by secants from the step
    in which the slope turns positive. All steps and tries are turns of one loop, each an integration step.
    """
    duration = jnp.exp(log_time)
    dt = step_size(duration, steps)

    def kinetic_slope(state: State) -> Scalar:
        rates, still = vector_field(pendulum, state), released(state.theta1, state.theta2)
        force = vector_field(pendulum, still)  # minus the slope of the potential energy
        return rates.theta1 * force.p1 + rates.theta2 * force.p2

    def rates_of(state: State) -> Array:
        rates = vector_field(pendulum, state)
        return jnp.abs(jnp.stack([rates.theta1, rates.theta2]))

    def turn(s: _Pass) -> _Pass:
        here = _RK8.advance(pendulum, s.state, s.ahead)
        slope = kinetic_slope(here)
        seen = (s.tries == 0) & (s.slope < 0) & (slope >= 0)
        trying = s.tries > 0
        over = s.tries == _TRIES
        rest = over & jnp.all(rates_of(here) < _SAME * s.fastest)
        onto_next = (~trying & ~seen) | (over & ~rest)
        after, after_slope = jax.tree.map(partial(jnp.where, trying), s.next, (here, slope))
        last_ahead, last_slope = jax.tree.map(partial(jnp.where, trying), s.before, (jnp.zeros(()), s.slope))
        secant = s.ahead - slope * (s.ahead - last_ahead) / (slope - last_slope)
        secant = jnp.where(jnp.isfinite(secant), jnp.clip(secant, 0.0, dt), s.ahead)
        keep = partial(jnp.where, onto_next)
        return _Pass(
            state=jax.tree.map(keep, after, s.state),
            slope=keep(after_slope, s.slope),
            time=s.time + jnp.where(onto_next, dt, jnp.where(rest, s.ahead, 0.0)),
            ahead=keep(dt, jnp.where(rest, s.ahead, secant)),
            tries=keep(0, s.tries + 1),
            before=(s.ahead, slope),
            next=(after, after_slope),
            fastest=jnp.fmax(s.fastest, jnp.where(onto_next, rates_of(after), 0.0)),
            end=here,
            found=rest,
        )

    state, zero = released(*angles), jnp.zeros(())
    none = (zero, zero), (state, zero), jnp.zeros(2), state, jnp.asarray(False)
    start = _Pass(state, zero, zero, dt, jnp.asarray(0), *none)
    s = lax.while_loop(lambda s: ~s.found & (s.time < duration - 0.5 * dt), turn, start)
    return s.time, s.end, s.found


def _minimal(
    pendulum: Pendulum, angles: Array, log_time: Scalar, steps: Scalar, turns: Array, symmetry: str
) -> tuple[Scalar, Array]:
    """The log of the shooting time that belongs to a root's minimal period, and the turns at its quarter.

    The first rest after the release is the orbit's other one, half the minimal period later.
    """
    time, rest, found = _first_rest(pendulum, angles, log_time, steps)
    if symmetry == "centred":
        time = 0.5 * time
        turns = jnp.where(found, jnp.round((angles + jnp.stack([rest.theta1, rest.theta2])) / (2 * jnp.pi)), turns)
    covers = jnp.round(jnp.exp(log_time) / jnp.where(found, time, 1.0))
    return jnp.where(found & (covers > 1), jnp.log(jnp.where(found, time, 1.0)), log_time), turns


# --- the friendly call -----------------------------------------------------------------------------------------------


def find_orbit(
    pendulum: Pendulum | Any,
    theta1: Scalar,
    *,
    branch: str | Any | None = None,
    guess: tuple[Scalar, Scalar] | Any | None = None,
    symmetry: str | Any | None = None,
    ratio: int | Any | None = None,
    crossing: int | Any = 1,
    turn: float | Any = _FINE,
    tolerance: float | Any = 1e-13,
    max_iterations: int | Any = 40,
    error: bool | Any = True,
) -> PeriodicOrbit:
    """The periodic orbit released from rest at `theta1`: its partner angle theta2 and its period.

    Solves theta(T/4) = 0 modulo pi (centred) or p(T/2) = 0 (brake) for (theta2, T) by damped Newton iterations whose
    Jacobian is forward-mode through the flow. Give one of:

    - `branch`: follow the family of a normal mode by arclength, turning points included, from small swings to the first
      orbit with |theta1|. An orbit released at (-theta1, -theta2) counts: it is the same one, half a period later.
    - `guess`: start from (theta2, period) and take what Newton's method finds, reduced to its minimal period.
    - `ratio` alone: of the orbits with theta2 = ratio theta1 on the in-phase (+1) or anti-phase (-1) branch, or on
      `branch`, the one nearest to `theta1`, which is then an unknown too; with `guess`, the one near it.

    Negative `theta1` gives the mirror image. Derivatives of every result with respect to `theta1` and the pendulum are
    those of the root itself (implicit function theorem); with `jit`, `vmap` and `grad` all works, and what is wrong
    with a traced argument shows in `status`.

    Arguments:
        theta1: release angle of the upper rod [rad].
        branch: `in-phase` (slow mode) or `anti-phase` (fast mode).
        guess: theta2 [rad], period [s].
        symmetry: with `guess`, `centred` or `brake`. Without it the guess is solved as brake and solved again as
            centred if the orbit is that; under tracing it stays brake, of which every centred orbit is a case.
        ratio: +1 or -1.
        crossing: which of the branch's passages through `theta1`, in order of arclength.
        turn: how far the fastest motion may advance in one integration step [rad]; 0.1 leaves little but rounding.
        tolerance: on the last Newton update, of theta2 [rad] relative to an amplitude below 1, and of log T. 1e-13 is
            where rounding begins.
        max_iterations: Newton iterations at most, at least 1, which is to evaluate the guess.
        error: solve again at half the step for `error_estimate`; without it that is NaN.
    Returns:
        PeriodicOrbit. If its status is not `Status.CONVERGED` it holds the best iterate and its residual; if the branch
        does not reach `theta1` (`NO_SUCH_ORBIT`), the orbit where it came closest to upright in theta1.
    Raises:
        ValueError: theta1 not finite; none or more than one of branch and guess; theta1 a multiple of pi with `branch`;
            both angles at an equilibrium; g not positive; an unknown branch, symmetry or ratio; a period not positive.
        RuntimeError: float64 is switched off in JAX.
    See also: Peeters et al., Nonlinear normal modes II, Mechanical Systems and Signal Processing 23 (2009): families of
        normal modes by shooting and arclength; Hristov et al., arXiv:2308.16159: the quarter period.
    """
    require_float64()
    theta1, crossing = number("theta1", theta1, unit="rad"), integer("crossing", crossing)
    _check_request(pendulum, theta1, branch, guess, symmetry, ratio, crossing)
    settings = {
        "error": flag("error", error),
        "turn": number("turn", turn, positive=True, unit="rad"),
        "tolerance": number("tolerance", tolerance, positive=True),
        # This may be traced: it bounds a loop.
        "max_iterations": max_iterations if is_traced(max_iterations) else integer("max_iterations", max_iterations),
    }
    for name, value in settings.items():
        single(name, value)
    theta1 = jnp.asarray(theta1, jnp.float64)
    if guess is None:
        slow = (branch or ("in-phase" if ratio == 1 else "anti-phase")) == "in-phase"
        return _on_branch(pendulum, theta1, slow, crossing, float(ratio or 0), **settings)
    theta2, period = (jnp.asarray(value, jnp.float64) for value in _guessed(guess))
    if ratio is None:
        line, x = _Line(jnp.stack([theta1, 0.0]), jnp.array([0.0, 1.0])), theta2
    else:
        line, x = _Line(jnp.zeros(2), jnp.array([1.0, ratio])), theta1

    def solve(x: Scalar, period: Scalar, symmetry: str) -> PeriodicOrbit:
        x, log_time = lax.stop_gradient((x, jnp.log(period / PARTS[symmetry])))
        return _near_guess(pendulum, line, x, log_time, symmetry, **settings)

    orbit = solve(x, period, symmetry or "brake")
    if symmetry is not None or known_value(orbit.status) != Status.CONVERGED:
        return orbit
    centred = solve(orbit.theta2 if ratio is None else orbit.theta1, orbit.period, "centred")
    if not _is_same(centred, orbit):
        return orbit
    return replace(centred, iterations=orbit.iterations + centred.iterations)


def _check_request(  # type: ignore[no-untyped-def]
    pendulum: Pendulum | Any, theta1: Scalar, branch, guess, symmetry, ratio, crossing
) -> None:
    """Refuses what cannot be asked, as far as the values are known before tracing."""
    check_pendulum(pendulum)
    for name, value, words in (("branch", branch, BRANCHES), ("symmetry", symmetry, SYMMETRIES)):
        if value is not None:
            one_of(name, value, words)
    if ratio is not None:
        one_of("ratio", ratio, (1, -1))
    at_most_one(branch=branch, guess=guess)
    if branch is None and guess is None and ratio is None:
        raise ValueError("branch must be given, or guess=(theta2, period), or ratio=1 or -1; got none of them")
    if symmetry is not None and guess is None:
        raise ValueError(f"symmetry goes with guess, got {symmetry!r} alone: orbits on a branch are centred")
    if crossing > 1 and (branch is None or ratio is not None):
        raise ValueError(f"crossing must be 1 but with branch alone, got {crossing}: leave it out")
    for name, value in {"theta1": theta1, **vars(pendulum)}.items():
        single(name, value)
    gravity, angle1 = known_value(pendulum.g), known_value(theta1)
    if angle1 is not None and not math.isfinite(angle1):
        raise ValueError(f"theta1 must be a finite number [rad], got {angle1}: give another theta1")
    if gravity is not None and not gravity > 0:
        raise ValueError(f"g must be positive for an orbit, got {gravity:g}: nothing swings back without gravity")
    if guess is None:
        if angle1 is not None and _multiple_of_pi(angle1):
            raise ValueError(
                f"theta1 must not be a multiple of 180 degrees on a branch, got {math.degrees(angle1):g} degrees: "
                "the branches pass there only in equilibrium"
            )
        return
    theta2, period = (known_value(value) for value in _guessed(guess))
    if period is not None and not period > 0:
        raise ValueError(f"period must be positive [s], got {period:g}: give another guess")
    if angle1 is not None and theta2 is not None and _multiple_of_pi(angle1) and _multiple_of_pi(theta2):
        raise ValueError(
            f"theta2 must not be a multiple of 180 degrees with theta1 at {math.degrees(angle1):g} degrees, "
            f"got {math.degrees(theta2):g} degrees: that is an equilibrium"
        )


def _guessed(guess: Any) -> tuple[Scalar, Scalar]:
    """theta2 [rad] and the period [s] of a guess, checked."""
    theta2, period = several("guess", guess, "a pair (theta2, period)", 2)
    for name, value in (("theta2", theta2), ("period", period)):
        single(f"guess of {name}", value)
    return number("guess of theta2", theta2, unit="rad"), number("guess of period", period, unit="s")


def swinging_pendulum(pendulum: Any) -> Pendulum:
    """A pendulum whose fields are plain numbers and that has orbits.

    Raises:
        ValueError: as `known_pendulum`; g not positive.
    """
    fixed = known_pendulum(pendulum)
    if not fixed.g > 0:
        raise ValueError(f"g must be positive for orbits, got {fixed.g:g}: nothing swings back without gravity")
    return fixed


def _multiple_of_pi(angle: float) -> bool:
    nearest = math.pi * round(angle / math.pi)
    # Below 1e-100 the products of two amplitudes leave the range of float64: that is zero, too.
    return abs(angle - nearest) <= max(4 * sys.float_info.epsilon * abs(nearest), 1e-100)


def _is_same(one: PeriodicOrbit, other: PeriodicOrbit) -> bool:
    """Whether two converged orbits are one: angles within 1e-8 rad and periods within 1e-8 of each other."""
    known = [float(known_value(leaf) or 0.0) for o in (one, other) for leaf in (o.theta1, o.theta2, o.period)]
    apart = max(abs(known[0] - known[3]), abs(known[1] - known[4]))
    longer = abs(known[2] / known[5] - 1)
    return known_value(one.status) == Status.CONVERGED and max(apart, longer) < 1e-8
