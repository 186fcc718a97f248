"""The first time at which a function of the state crosses zero, exact to the integration method.

A crossing shows as a change of sign over a step. The step is then taken again from the state before it, as a step of
the same method whose length is found by Newton's method so that it lands on the crossing: no interpolant, whose own
error would be another. Two crossings inside one step cancel and are not seen.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from dpend.checks import function, known_number, one_of
from dpend.pendulum import Pendulum, Scalar, State, check_motion, vector_field
from dpend.steppers import Scheme, check_scheme
from dpend.trajectory import fold

# Newton's method from the end of a step needs five or six; each bisection of the bracket takes one more.
_MOST_ITERATIONS = 40
# Of the step: an update this small leaves, squared, nothing for the next.
_TIME_TOLERANCE = 1e-8


class Crossing(NamedTuple):
    """The first crossing on a motion.

    Attributes:
        time: when [s]; infinite if there is none.
        state: the state there; the last one of the motion if there is none.
        which: the index of the function that crosses zero; -1 if there is none.
        steps: the number of steps taken, whole motion.
    """

    time: Scalar
    state: State
    which: Scalar
    steps: Scalar


class _Search(NamedTuple):
    """What is known along the way. The state before the crossing, and when and how long the step was that crossed,
    stand still once it is found.
    """

    found: Scalar
    values: jax.Array
    before: State
    time: Scalar
    dt: Scalar
    steps: Scalar


def first_crossing(
    functions: Callable[[Pendulum, State], Any] | Any,
    pendulum: Pendulum | Any,
    state: State | Any,
    duration: float | Any,
    scheme: Scheme | Any,
    *,
    direction: int | Any = 0,
) -> Crossing:
    """The first time 0 < t <= duration at which one of `functions` crosses zero.

    A function that is zero at t = 0 starts with the sign it takes after the first step.

    Arguments:
        functions: (pendulum, state) -> one scalar, or a tuple of scalars each of which is watched; smooth where it
            crosses. Compiled functions are kept by its identity: define it once, not in a loop.
        pendulum, state, scheme: as for `flow`.
        duration: how long to look [s], a number; negative runs backwards.
        direction: 1 counts crossings from below only, -1 from above only, 0 both.
    Returns:
        Crossing.
    Raises:
        ValueError: direction is none of these; as `flow`.
    """
    function("functions", functions, "(pendulum, state)", "lambda pendulum, state: state.theta2")
    check_motion(pendulum, state)
    check_scheme(scheme)
    duration, direction = known_number("duration", duration, unit="s"), one_of("direction", direction, (-1, 0, 1))
    return _first_crossing(functions, pendulum, state, duration, scheme, direction)


class _Landing(NamedTuple):
    """Where the crossing lies inside its step: a bracket and Newton's latest time [s, from the step's start], the
    functions that cross before the bracket's end, which of them first, and the state at the time last tried.
    """

    low: Scalar
    high: Scalar
    tau: Scalar
    among: jax.Array
    which: Scalar
    state: State
    close: Scalar
    done: Scalar
    count: Scalar


@partial(jax.jit, static_argnames=("functions", "duration", "scheme", "direction"))
def _first_crossing(functions, pendulum, state, duration, scheme, direction):  # type: ignore[no-untyped-def]
    def look(search: _Search, time: Scalar, dt: Scalar, state: State) -> _Search:
        values = _values(functions, pendulum, state)
        found = search.found | jnp.any(_crossed(search.values, values, direction))
        before = jax.tree.map(partial(jnp.where, found), search.before, state)
        time, dt = jnp.where(search.found, search.time, time), jnp.where(search.found, search.dt, dt)
        return _Search(found, values, before, time, dt, search.steps + 1.0)

    state = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), state)
    zero = jnp.zeros_like(state.theta1)
    start = _Search(zero > 0, _values(functions, pendulum, state), state, zero, zero, zero)
    search = fold(look, start, pendulum, state, duration, scheme)
    return _landed(functions, pendulum, search, scheme, direction)


def _values(functions: Callable[[Pendulum, State], Any], pendulum: Pendulum, state: State) -> jax.Array:
    return jnp.stack([jnp.asarray(value, jnp.float64) for value in jax.tree.leaves(functions(pendulum, state))])


def _crossed(before: jax.Array, after: jax.Array, direction: int) -> jax.Array:
    """Where the sign has changed in the direction asked for; a start at zero and NaN are no change."""
    changed = (jnp.sign(before) * jnp.sign(after) <= 0) & (before != 0)  # the values' product may underflow
    return changed if direction == 0 else changed & (before * direction < 0)


def _landed(functions, pendulum, search, scheme, direction):  # type: ignore[no-untyped-def]
    """The crossing inside the step that starts at search.before: a bracket of the earliest change of sign of any
    function, and inside it Newton's method on the function that changes first.
    """
    unit, point = scheme.constants(pendulum), scheme.enter(pendulum, search.before)
    start, sense = _values(functions, pendulum, search.before), jnp.sign(search.dt)

    def values(state: State) -> tuple[jax.Array, jax.Array]:
        """The functions and their rates of change along the motion."""
        field = vector_field(pendulum, state)
        return jax.jvp(lambda x: _values(functions, pendulum, x), (state,), (field,))

    def newton(carry: _Landing) -> _Landing:
        tau = carry.tau
        state = scheme.leave(unit, scheme.move(scheme.lasting(unit, tau), point))
        here, slopes = values(state)
        crossed = _crossed(start, here, direction)
        late = jnp.any(crossed)
        low, high = jnp.where(late, carry.low, tau), jnp.where(late, tau, carry.high)
        among = jnp.where(late, crossed, carry.among)
        there = jnp.where(here == 0, tau, tau - here / slopes)
        aims = jnp.where(among, sense * there, jnp.inf)
        aims = jnp.where(aims >= sense * low, aims, jnp.inf)
        soonest = jnp.argmin(aims)
        which = jnp.where(aims[soonest] < jnp.inf, soonest, jnp.argmax(among))
        aim = jnp.where(aims[which] < jnp.inf, sense * jnp.minimum(aims[which], sense * high), 0.5 * (low + high))
        # One evaluation more than the updates need: the state belongs to the time.
        aim = jnp.where(carry.close, tau, aim)
        close = jnp.abs(aim - tau) <= _TIME_TOLERANCE * jnp.abs(search.dt)
        return _Landing(low, high, aim, among, which, state, close, carry.close, carry.count + 1)

    def goes_on(carry: _Landing) -> Scalar:
        return search.found & ~carry.done & (carry.count < _MOST_ITERATIONS)

    # The step's end is tried first: it tells which functions cross.
    tau = jnp.where(search.found, search.dt, 0.0)
    among, no = jnp.ones_like(start, bool), jnp.zeros_like(search.found)
    first = _Landing(0.0 * tau, search.dt, tau, among, jnp.asarray(0), search.before, no, no, jnp.asarray(0))
    landing = lax.while_loop(goes_on, newton, first)
    return Crossing(
        jnp.where(search.found, search.time - search.dt + landing.tau, jnp.inf),
        landing.state,
        jnp.where(search.found, landing.which, -1),
        search.steps,
    )
