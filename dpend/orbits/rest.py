"""The rests of a motion released from rest: what its minimal period is."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from dpend.checks import Scalar
from dpend.mechanics.pendulum import Pendulum, State, released, vector_field
from dpend.motion.integrate import step_size
from dpend.orbits.single import RK8

# How fast either rod may turn where the motion rests, in units of its fastest before: the root has
# 1e-12, and grows by no more than the root of 1e16 up to the first of several rests.
_AT_REST = 1e-6
# Secants for the place of a rest within a step of 0.1 rad: it is then known to 1e-12 of the step.
_TRIES = 5


class _Pass(NamedTuple):
    """Where a search for a rest stands: a step that began at `state` and is tried up to `ahead` [s]
    from there.
    """

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


def _first_rest(
    pendulum: Pendulum, angles: Array, log_time: Scalar, steps: Scalar
) -> tuple[Scalar, State, Scalar]:
    """The time of the first rest after the release, the state there, and whether there is one
    before exp(log_time).

    At a rest the kinetic energy has a minimum, whose place is where its slope vanishes: found by
    secants from the step in which the slope turns positive. All steps and tries are turns of one
    loop, each an integration step.
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
        here = RK8.advance(pendulum, s.state, s.ahead)
        slope = kinetic_slope(here)
        seen = (s.tries == 0) & (s.slope < 0) & (slope >= 0)
        trying = s.tries > 0
        over = s.tries == _TRIES
        rest = over & jnp.all(rates_of(here) < _AT_REST * s.fastest)
        onto_next = (~trying & ~seen) | (over & ~rest)
        after, after_slope = jax.tree.map(partial(jnp.where, trying), s.next, (here, slope))
        last_ahead, last_slope = jax.tree.map(
            partial(jnp.where, trying), s.before, (jnp.zeros(()), s.slope)
        )
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


def reduce_to_minimal(
    pendulum: Pendulum, angles: Array, log_time: Scalar, steps: Scalar, turns: Array, symmetry: str
) -> tuple[Scalar, Array]:
    """The log of the shooting time that belongs to a root's minimal period, and the turns at its
    quarter.

    The first rest after the release is the orbit's other one, half the minimal period later.
    """
    time, rest, found = _first_rest(pendulum, angles, log_time, steps)
    if symmetry == "centred":
        time = 0.5 * time
        turns = jnp.where(
            found, jnp.round((angles + jnp.stack([rest.theta1, rest.theta2])) / (2 * jnp.pi)), turns
        )
    covers = jnp.round(jnp.exp(log_time) / jnp.where(found, time, 1.0))
    return jnp.where(found & (covers > 1), jnp.log(jnp.where(found, time, 1.0)), log_time), turns
