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

from dpend.pendulum import Pendulum, Scalar, State, vector_field
from dpend.steppers import Scheme
from dpend.trajectory import fold

# Newton's method from the secant of a step needs four or five; each bisection of the bracket takes one more.
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
    functions: Callable[[Pendulum, State], Any],
    pendulum: Pendulum,
    state: State,
    duration: float,
    scheme: Scheme,
    *,
    direction: int = 0,
) -> Crossing:
    """The first time 0 < t <= duration at which one of `functions` crosses zero.

    A function that is zero at t = 0 starts with the sign it takes after the first step.

    Arguments:
        functions: (pendulum, state) -> one scalar, or a tuple of scalars each of which is watched; smooth where it
            crosses. Compiled functions are kept by its identity: define it once, not in a loop.
        pendulum, state, duration, scheme: as for `flow`.
        direction: 1 counts crossings from below only, -1 from above only, 0 both.
    Returns:
        Crossing.
    Raises:
        ValueError: direction is none of these; as `flow`.
    """
    if direction not in (-1, 0, 1):
        raise ValueError(f"direction must be -1, 0 or 1, got {direction!r}")
    return _first_crossing(functions, pendulum, state, float(duration), scheme, direction)


@partial(jax.jit, static_argnames=("functions", "duration", "scheme", "direction"))
def _first_crossing(functions, pendulum, state, duration, scheme, direction):  # type: ignore[no-untyped-def]
    def look(search: _Search, time: Scalar, dt: Scalar, state: State) -> _Search:
        values = _values(functions, pendulum, state)
        found = search.found | jnp.any(_crossed(search.values, values, direction))
        before = jax.tree.map(partial(jnp.where, found), search.before, state)
        time, dt = jnp.where(search.found, search.time, time), jnp.where(search.found, search.dt, dt)
        return _Search(found, values, before, time, dt, search.steps + 1.0)

    zero = jnp.zeros_like(state.theta1)
    start = _Search(zero > 0, _values(functions, pendulum, state), state, zero, zero, zero)
    search = fold(look, start, pendulum, state, duration, scheme)
    return _landed(functions, pendulum, search, scheme, direction)


def _values(functions: Callable[[Pendulum, State], Any], pendulum: Pendulum, state: State) -> jax.Array:
    return jnp.stack([jnp.asarray(value, jnp.float64) for value in jax.tree.leaves(functions(pendulum, state))])


def _crossed(before: jax.Array, after: jax.Array, direction: int) -> jax.Array:
    """Where the sign has changed in the direction asked for; a start at zero and NaN are no change."""
    changed = (before * after <= 0) & (before != 0)
    return changed if direction == 0 else changed & (before * direction < 0)


def _landed(functions, pendulum, search, scheme, direction):  # type: ignore[no-untyped-def]
    """The crossing inside the step that starts at search.before."""

    def at(tau: Scalar) -> State:
        return scheme.plain.advance(pendulum, search.before, tau)

    def values(state: State) -> tuple[jax.Array, jax.Array]:
        """The functions and their rates of change along the motion."""
        field = vector_field(pendulum, state)
        return jax.jvp(lambda x: _values(functions, pendulum, x), (state,), (field,))

    start, end = (_values(functions, pendulum, at(tau)) for tau in (jnp.zeros_like(search.dt), search.dt))
    crossed = search.found & _crossed(start, end, direction)
    # The step in time itself ends a method error away from the step taken: what crosses by less crosses at the end.
    crossed = jnp.where(jnp.any(crossed), crossed, search.found)
    guess = search.dt * jnp.abs(start) / (jnp.abs(start) + jnp.abs(end))

    def one(index: Scalar, sign: Scalar, tau: Scalar, crosses: Scalar) -> Scalar:
        def newton(carry: Any) -> Any:
            low, high, tau, _, count = carry
            value, slope = (both[index] for both in values(at(tau)))
            early = value * sign > 0
            low, high = jnp.where(early, tau, low), jnp.where(early, high, tau)
            step = -value / slope
            inside = (jnp.abs(tau + step - low) <= jnp.abs(high - low)) & (
                jnp.abs(high - tau - step) <= jnp.abs(high - low)
            )
            new = jnp.where(value == 0, tau, jnp.where(inside, tau + step, 0.5 * (low + high)))
            return low, high, new, jnp.abs(new - tau) > _TIME_TOLERANCE * jnp.abs(search.dt), count + 1

        def goes_on(carry: Any) -> Scalar:
            return carry[3] & (carry[4] < _MOST_ITERATIONS)

        first = (jnp.asarray(0.0), search.dt, tau, crosses, jnp.asarray(0))
        return lax.while_loop(goes_on, newton, first)[2]

    taus = jax.vmap(one)(jnp.arange(end.size), jnp.sign(start), guess, crossed)
    taus = jnp.where(crossed, taus, jnp.inf)
    which = jnp.argmin(jnp.abs(taus))
    tau = jnp.where(search.found, taus[which], 0.0)
    return Crossing(
        jnp.where(search.found, search.time - search.dt + tau, jnp.inf),
        at(tau),
        jnp.where(search.found, which, -1),
        search.steps,
    )
