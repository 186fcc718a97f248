"""How sensitive a motion is to its start: Lyapunov exponents, MEGNO; and the time of the first
flip, and energy drift.

Each is a quantity, (pendulum, state, scheme) -> dict of scalars, built on `fold` and nothing that a
user's own cannot use; `sweep` maps it over a grid. All return `steps`, the number of steps taken.

Tangent vectors are measured in |d|^2 = d theta1^2 + d theta2^2 + (d p1/P1)^2 + (d p2/P2)^2, P1 =
(m1 + m2) l1^2 w and P2 = m2 l2^2 w with w the fast normal mode's frequency (1/s without gravity):
each momentum by that of its own rod turning at a rate that the pendulum has by itself, so that the
components are of one size for any masses and lengths. Exponents in the limit of long times do not
depend on the norm; finite-time ones do, by a constant over the time.
"""

import math
from collections.abc import Callable
from functools import partial, wraps
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from dpend.checks import Scalar, integer, known_number, number
from dpend.mechanics.pendulum import Pendulum, State, check_motion, energy_scale, hamiltonian
from dpend.mechanics.units import Norm, norm
from dpend.methods.scheme import Scheme, check_scheme
from dpend.motion.events import first_crossing
from dpend.motion.integrate import fold

# A tangent is scaled back by this once an angle of it exceeds the inverse: seldom, and exactly,
# being a power of two.
_SCALE_BACK = 2.0**-300

# A unit tangent in none of the directions that symmetry or the flow singles out.
GENERIC = (0.7, 0.5, 0.1, 0.5)


class _Count(NamedTuple):
    """How often a tangent has been scaled back, and the steps that have been taken."""

    turns: Scalar
    steps: Scalar


_NONE = _Count(np.float64(0.0), np.float64(0.0))


def _grow(
    count: _Count, time: Scalar, dt: Scalar, state: State, tangent: State
) -> tuple[_Count, State]:
    """The `update` that follows one tangent over any length of time."""
    large = jnp.abs(tangent.theta1) + jnp.abs(tangent.theta2) > 1 / _SCALE_BACK
    factor = jnp.where(large, _SCALE_BACK, 1.0)
    tangent = jax.tree.map(lambda x: x * factor, tangent)
    return _Count(count.turns + jnp.where(large, 1.0, 0.0), count.steps + 1.0), tangent


def _log(norm: Norm, tangent: State, count: _Count) -> Scalar:
    """ln |d| since the start, where |d| was one."""
    return 0.5 * jnp.log(norm.square(tangent)) - math.log(_SCALE_BACK) * count.turns


def _behind_checks(compiled: Callable[..., dict[str, Scalar]]) -> Callable[..., dict[str, Scalar]]:
    """A compiled quantity behind the checks of its arguments, which `jit` would refuse in words of
    its own.
    """

    @wraps(compiled)
    def quantity(pendulum: Any, state: Any, scheme: Any, **settings: Any) -> dict[str, Scalar]:
        check_motion(pendulum, state)
        check_scheme(scheme)
        if "duration" in settings:
            settings["duration"] = known_number("duration", settings["duration"], unit="s")
        if "windows" in settings:
            settings["windows"] = integer("windows", settings["windows"], least=4)
        return compiled(pendulum, state, scheme, **settings)

    return quantity


@_behind_checks
@partial(jax.jit, static_argnames=("scheme", "duration"))
def lyapunov(
    pendulum: Pendulum, state: State, scheme: Scheme, *, duration: float
) -> dict[str, Scalar]:
    """The finite-time Lyapunov exponent ln(|d(T)|/|d(0)|)/T of a generic tangent [1/s].

    It tends to the maximal exponent; of a regular motion it falls like ln(T)/T.

    Arguments:
        pendulum, state: leaves are scalars.
        scheme: method and step.
        duration: T [s], positive.
    Returns:
        `lyapunov` [1/s] and `steps`.
    Raises:
        ValueError: duration not positive; as `flow`.
    """
    duration = float(number("duration", duration, positive=True, unit="s"))

    size = norm(pendulum)
    count, tangent = fold(
        _grow, _NONE, pendulum, state, duration, scheme, tangents=size.vector(*GENERIC)
    )
    return {"lyapunov": _log(size, tangent, count) / duration, "steps": count.steps.astype(int)}


@_behind_checks
@partial(jax.jit, static_argnames=("scheme", "duration", "windows"))
def maximal_lyapunov(
    pendulum: Pendulum, state: State, scheme: Scheme, *, duration: float, windows: int = 20
) -> dict[str, Scalar]:
    """The maximal Lyapunov exponent with an error estimate [1/s].

    The motion is cut into `windows` equal ones. The exponent is the mean growth rate over all but
    the first, in which the tangent turns into the direction that grows; the error adds the standard
    error of that mean, from the spread of the windows' rates, and half the change between the first
    and the second half of them, which shows a trend.

    Arguments:
        pendulum, state: leaves are scalars.
        scheme: method and step.
        duration: of all windows together [s], positive.
        windows: an even number of at least 4; 20 leave each long and their spread known to a sixth.
    Returns:
        `exponent` and `uncertainty` [1/s], `steps`.
    Raises:
        ValueError: windows odd or too few; as `flow`.
    """
    duration = float(number("duration", duration, positive=True, unit="s"))
    if windows % 2:
        raise ValueError(
            f"windows must be an even number of at least 4, got {windows}: give {windows + 1}"
        )
    size = norm(pendulum)

    def window(
        carry: tuple[State, State, Scalar], _: None
    ) -> tuple[tuple[State, State, Scalar], Scalar]:
        state, tangent, steps = carry
        both = fold(
            _follow, (state, _NONE), pendulum, state, duration / windows, scheme, tangents=tangent
        )
        (end, count), tangent = both
        length = jnp.sqrt(size.square(tangent))
        return (end, jax.tree.map(lambda x: x / length, tangent), steps + count.steps), _log(
            size, tangent, count
        )

    start = (jax.tree.map(jnp.asarray, state), size.vector(*GENERIC), jnp.asarray(0.0))
    (_, _, steps), logs = lax.scan(window, start, None, length=windows)
    rates = logs * (windows / duration)
    half = windows // 2
    spread = jnp.std(rates[1:], ddof=1) / math.sqrt(windows - 1)
    trend = 0.5 * jnp.abs(jnp.mean(rates[half:]) - jnp.mean(rates[1:half]))
    return {
        "exponent": jnp.mean(rates[1:]),
        "uncertainty": spread + trend,
        "steps": steps.astype(int),
    }


def _follow(
    both: tuple[State, _Count], time: Scalar, dt: Scalar, state: State, tangent: State
) -> tuple[tuple[State, _Count], State]:
    """The `update` that follows one tangent and keeps the state, so that the motion can go on from
    there.
    """
    count, tangent = _grow(both[1], time, dt, state, tangent)
    return (state, count), tangent


@_behind_checks
@partial(jax.jit, static_argnames=("scheme", "duration"))
def spectrum(
    pendulum: Pendulum, state: State, scheme: Scheme, *, duration: float
) -> dict[str, Scalar]:
    """All four Lyapunov exponents over a finite time, largest first [1/s].

    Four tangents are carried along and made orthogonal after each step (Gram and Schmidt); the
    exponents are the mean growth rates of what is left of each. Of a Hamiltonian flow they come in
    pairs (+, 0, 0, -) and sum to zero.

    Arguments:
        pendulum, state: leaves are scalars. Meant for one trajectory: over lanes it works, slowly.
        scheme: method and step.
        duration: [s], positive.
    Returns:
        `exponent1` to `exponent4` [1/s] and `steps`.
    Raises:
        ValueError: duration not positive; as `flow`.
    """
    duration = float(number("duration", duration, positive=True, unit="s"))
    size = norm(pendulum)

    def orthogonal(index: Scalar, both: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        rows, lengths = both
        above = jnp.where(jnp.arange(4)[:, None] < index, rows, 0.0)
        row = rows[index] - (above @ rows[index]) @ above
        length = jnp.sqrt(row @ row)
        return rows.at[index].set(row / length), lengths.at[index].set(length)

    def update(carry: Any, time: Scalar, dt: Scalar, state: State, tangents: State) -> Any:
        logs, steps = carry
        rows = jnp.stack(
            [
                tangents.theta1,
                tangents.theta2,
                size.per_unit1 * tangents.p1,
                size.per_unit2 * tangents.p2,
            ],
            axis=1,
        )
        # A loop, although of four turns: written out, XLA computes the chain again for each of its
        # results.
        basis, lengths = lax.fori_loop(0, 4, orthogonal, (rows, jnp.zeros(4)))
        columns = basis.T
        tangents = State(
            columns[0], columns[1], columns[2] / size.per_unit1, columns[3] / size.per_unit2
        )
        return (logs + jnp.log(lengths), steps + 1.0), tangents

    basis = np.eye(4)
    start = State(basis[0], basis[1], basis[2] / size.per_unit1, basis[3] / size.per_unit2)
    (logs, steps), _ = fold(
        update, (jnp.zeros(4), jnp.asarray(0.0)), pendulum, state, duration, scheme, tangents=start
    )
    return {f"exponent{i + 1}": logs[i] / duration for i in range(4)} | {"steps": steps.astype(int)}


@_behind_checks
@partial(jax.jit, static_argnames=("scheme", "duration"))
def megno(
    pendulum: Pendulum, state: State, scheme: Scheme, *, duration: float
) -> dict[str, Scalar]:
    """The time-averaged MEGNO, mean exponential growth of nearby orbits.

    Y(t) = (2/t) int_0^t s d ln|d(s)|, and its mean over [0, T]: tends to 2 on tori and at stable
    periodic orbits for a generic tangent, to lambda T/2 in chaos with exponent lambda.

    Arguments:
        pendulum, state: leaves are scalars.
        scheme: method and step; a step's growth counts at the middle of the step, which is an error
            of the second order in the step, far below what tells order from chaos.
        duration: T [s], positive.
    Returns:
        `megno`, without dimension, and `steps`.
    Raises:
        ValueError: duration not positive; as `flow`.
    """
    duration = float(number("duration", duration, positive=True, unit="s"))
    size = norm(pendulum)

    def update(carry: Any, time: Scalar, dt: Scalar, state: State, tangent: State) -> Any:
        weighted, mean, before, steps = carry
        square = size.square(tangent)
        weighted = weighted + (time - 0.5 * dt) * jnp.log(square / before)
        mean = mean + weighted / time * dt
        large = square > 1 / _SCALE_BACK
        tangent = jax.tree.map(lambda x: x * jnp.where(large, _SCALE_BACK, 1.0), tangent)
        return (
            weighted,
            mean,
            square * jnp.where(large, _SCALE_BACK**2, 1.0),
            steps + 1.0,
        ), tangent

    start = size.vector(*GENERIC)
    zero = jnp.asarray(0.0)
    init = (zero, zero, size.square(start), zero)
    (_, mean, _, steps), _ = fold(update, init, pendulum, state, duration, scheme, tangents=start)
    return {"megno": mean / duration, "steps": steps.astype(int)}


def _upright(pendulum: Pendulum, state: State) -> tuple[Scalar, Scalar]:
    """Zero where a rod points upwards, of the sign of cos(theta/2): a triangle wave, which needs no
    cosine.
    """

    def wave(theta: Scalar) -> Scalar:
        turn = theta / (4 * math.pi)
        return 0.25 - jnp.abs(turn - jnp.round(turn))

    return wave(state.theta1), wave(state.theta2)


@_behind_checks
@partial(jax.jit, static_argnames=("scheme", "duration"))
def flip(pendulum: Pendulum, state: State, scheme: Scheme, *, duration: float) -> dict[str, Scalar]:
    """When a bob first goes over the top: the first t > 0 at which cos(theta1/2) or cos(theta2/2)
    changes sign.

    A release at exactly +-pi does not count at t = 0. Point masses of equal mass on rods of equal
    length, released from rest, cannot flip where 2 cos theta1 + cos theta2 > 1: they lack the
    energy.

    Arguments:
        pendulum, state: leaves are scalars.
        scheme: method and step.
        duration: how long to wait [s], positive.
    Returns:
        `flip_time` [s], infinite if there is none; `bob`, 1 or 2, or 0; and `steps`.
    Raises:
        ValueError: duration not positive; as `flow`.
    """
    duration = float(number("duration", duration, positive=True, unit="s"))
    crossing = first_crossing(_upright, pendulum, state, duration, scheme)
    lost = jnp.isnan(crossing.state.theta1 + crossing.state.theta2)
    time = jnp.where(lost, jnp.nan, crossing.time)
    return {"flip_time": time, "bob": crossing.which + 1, "steps": crossing.steps.astype(int)}


@_behind_checks
@partial(jax.jit, static_argnames=("scheme", "duration"))
def drift(
    pendulum: Pendulum, state: State, scheme: Scheme, *, duration: float
) -> dict[str, Scalar]:
    """The largest |H - H(0)| after any step, in units of `energy_scale`: how well the method keeps
    the energy.

    Arguments:
        pendulum, state: leaves are scalars.
        scheme: method and step.
        duration: [s].
    Returns:
        `energy_drift`, without dimension, and `steps`.
    Raises:
        ValueError: duration not positive; as `flow`.
    """
    start = hamiltonian(pendulum, state)

    def update(carry: Any, time: Scalar, dt: Scalar, state: State) -> Any:
        # NaN stays NaN: a motion that was lost has no drift.
        return jnp.maximum(carry[0], jnp.abs(hamiltonian(pendulum, state) - start)), carry[1] + 1.0

    init = (jnp.asarray(0.0), jnp.asarray(0.0))
    worst, steps = fold(update, init, pendulum, state, duration, scheme)
    return {"energy_drift": worst / energy_scale(pendulum, state), "steps": steps.astype(int)}
