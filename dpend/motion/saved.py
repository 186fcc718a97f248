"""Motions for a tolerance in SI units: natural time and turns there and back, energy, status."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from dpend.checks import Scalar
from dpend.mechanics.linear import fast_frequency
from dpend.mechanics.pendulum import (
    Pendulum,
    State,
    energy_scale,
    hamiltonian,
    momenta,
    velocities,
)
from dpend.motion.adaptive import Saved, run_steps
from dpend.motion.estimate import EPS, SHEAR
from dpend.motion.integrate import Turns, with_turns, without_turns
from dpend.motion.variation import natural_motion
from dpend.status import Status

_MANTISSA = (1 << 52) - 1
# A try whose sweeps ended at this change or less could not be finer: rounding sets its error.
_FINE = 1e-15


class SavedMotion(NamedTuple):
    """A motion at its saved times, and how it went; leaves of `state` and `error` have shape
    (n,).
    """

    state: State
    error: Any  # estimate of the larger angle's error at each saved time [rad]
    energy_drift: Scalar
    error_estimate: Scalar  # at the worst step [rad]; infinite where the end was not reached
    steps: Scalar
    status: Scalar


class _Natural(NamedTuple):
    """A motion's start in natural time."""

    begin: Any  # angles and rates, (4,)
    constants: Any  # of the field, (3,)
    forth: Scalar  # natural time in a second, negative for a motion backwards
    state: State  # the start without its turns
    turns: Turns


def _natural(pendulum: Pendulum, state: State, end: Scalar) -> _Natural:
    """The equations are the same backwards, with rates of the other sign."""
    reduced, turns = without_turns(state)
    rates = jnp.stack(velocities(pendulum, reduced))
    rate = _natural_rate(pendulum, rates)
    forth = lax.stop_gradient(jnp.where(end < 0, -rate, rate))
    begin = jnp.concatenate([jnp.stack([reduced.theta1, reduced.theta2]), rates / forth])
    weight = pendulum.g / pendulum.l1 / (rate * rate)
    constants = jnp.stack([pendulum.m2 / pendulum.m1, pendulum.l1 / pendulum.l2, weight])
    return _Natural(begin, constants, forth, reduced, turns)


def _natural_rate(pendulum: Pendulum, rates: Any) -> Scalar:
    """The power of two below what moves fastest [1/s]: times and rates change unit without
    rounding.
    """
    fastest = jnp.maximum(fast_frequency(pendulum), jnp.max(jnp.abs(rates)))
    bits = lax.bitcast_convert_type(lax.stop_gradient(fastest), jnp.int64) & ~_MANTISSA
    rate = lax.bitcast_convert_type(bits, jnp.float64)
    return jnp.where((rate > 0) & jnp.isfinite(rate), rate, 1.0)


def save_at_times(
    pendulum: Pendulum, state: State, times: Any, end: Scalar, tolerance: Scalar, most_steps: Scalar
) -> SavedMotion:
    """States at `times` [s], which move away from zero towards `end`; eight infinities follow them.

    It traces in every argument, and has both first derivatives. Under `vmap` motions follow one
    another.
    """
    start = _natural(pendulum, state, end)
    ahead = jnp.where(jnp.isfinite(times), times * start.forth, jnp.inf)
    last = end * start.forth
    saved: Saved = natural_motion(start.begin, start.constants, ahead, last, tolerance, most_steps)
    moved = momenta(pendulum, *saved.angles, *(saved.rates * start.forth))
    # The start itself, to the last bit; the derivatives there are the motion's.
    at_start = lax.stop_gradient(times == 0.0)
    moved = jax.tree.map(
        lambda leaf, first: leaf + lax.stop_gradient(jnp.where(at_start, first - leaf, 0.0)),
        moved,
        start.state,
    )
    there = jnp.isfinite(times)
    return _tell(pendulum, start, moved, there, saved, (last, tolerance, most_steps))


def save_at_steps(
    pendulum: Pendulum,
    state: State,
    end: Scalar,
    wish: tuple[Scalar, Scalar],
    every: Scalar,
    room: int,
) -> tuple[SavedMotion, Any, Scalar]:
    """States at the ends of every `every`-th step and of the last one, in `room` columns; their
    times [s]; and how many they are, more than `room` where the table was too small.

    Arguments:
        wish: tolerance [rad], and how many steps a try takes at most.
    """
    start = _natural(pendulum, state, end)
    last = end * start.forth
    steps = run_steps(start.begin, start.constants, last, wish, every, room)
    moved = momenta(pendulum, *steps.saved.angles, *(steps.saved.rates * start.forth))
    there = jnp.arange(room) < steps.count
    told = _tell(pendulum, start, moved, there, steps.saved, (last, *wish))
    return told, jnp.where(steps.times == last, end, steps.times / start.forth), steps.count


def _tell(
    pendulum: Pendulum, start: _Natural, moved: State, there: Any, saved: Saved, asked: tuple
) -> SavedMotion:
    """How a motion went, from its saved states where they are `there`."""
    end, tolerance, most_steps = asked
    known, first, states = lax.stop_gradient((pendulum, start.state, moved))
    change = jnp.abs(hamiltonian(known, states) - hamiltonian(known, first))
    drift = jnp.max(jnp.where(there, change, 0.0)) / energy_scale(known, first)
    whole = saved.reached == end
    estimate = jnp.where(whole, saved.worst, jnp.inf)
    # Errors of regular motions grow in proportion to time.
    regular = SHEAR * (1.0 + jnp.abs(end) * fast_frequency(pendulum) / jnp.abs(start.forth))
    chaotic = (saved.stop <= _FINE) & (saved.worst > EPS * regular)
    far = jnp.where(chaotic, Status.BEYOND_HORIZON, Status.TOLERANCE_NOT_REACHED)
    lost = jnp.where(saved.steps >= most_steps, Status.MAX_ITERATIONS, Status.NONFINITE)
    status = jnp.where(saved.worst <= tolerance, Status.CONVERGED, far)
    status = jnp.where(whole, status, lost)
    moved = with_turns(moved, start.turns)
    return SavedMotion(moved, saved.error, drift, estimate, saved.steps, status)
