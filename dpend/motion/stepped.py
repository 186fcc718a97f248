"""Motions at a given step, saved every so many steps, with a second pass for their error."""

import math
from functools import partial
from typing import cast

import jax
import jax.numpy as jnp
from jax import lax

from dpend.checks import Scalar, known_value
from dpend.mechanics.linear import fast_frequency
from dpend.mechanics.pendulum import Pendulum, State
from dpend.methods.runge_kutta import Point
from dpend.methods.scheme import Scheme
from dpend.motion.estimate import (
    EPS,
    LARGEST_TURN,
    NEAR_ROUNDING,
    PARTED,
    SHEAR,
    Comparison,
    angle_error,
    any_step,
    compare,
    compare_motions,
    comparison_of,
    energy_drift,
    fastest_rod,
)
from dpend.motion.integrate import march, step_size, with_turns, without_turns
from dpend.motion.trajectory import Trajectory
from dpend.status import Status

# The largest energy drift that passes, in units of the energy scale: far above what a method loses
# at a sensible step.
_LARGEST_DRIFT = 1e-6


def _save(
    pendulum: Pendulum, state: State, dt: Scalar, scheme: Scheme, counts: tuple[int, int]
) -> tuple[Scalar, State, Scalar]:
    """Times and states at steps 0, save_every, 2 save_every, ..., steps, and the largest rate met
    on the way.
    """
    steps, save_every = counts
    constants = scheme.constants(pendulum, dt)

    def step(carry: tuple[Point, Scalar], time: Scalar, dt: Scalar) -> tuple[Point, Scalar]:
        point = scheme.move(constants, carry[0])
        return point, jnp.fmax(carry[1], fastest_rod(pendulum, scheme.leave(constants, point)))

    def segment(
        carry: tuple[Point, Scalar], first: Scalar, count: int
    ) -> tuple[tuple[Point, Scalar], jax.Array]:
        carry = march(step, carry, dt, count, first)
        # One row to save, not four: XLA would copy four arrays whole at every save.
        return carry, jnp.stack(jax.tree.leaves(scheme.leave(constants, carry[0])))

    start = jnp.stack(jax.tree.leaves(state))[None]
    carry = (scheme.enter(pendulum, state), fastest_rod(pendulum, state))
    full, rest = divmod(steps, save_every)
    firsts = jnp.arange(full) * save_every
    carry, rows = lax.scan(lambda c, first: segment(c, first, save_every), carry, firsts)
    rows = jnp.concatenate([start, rows])
    if rest:
        carry, last = segment(carry, full * save_every, rest)
        rows = jnp.concatenate([rows, last[None]])
    at = jnp.minimum(jnp.arange(len(rows)) * save_every, steps)
    return at.astype(float) * dt, State(*rows.T), carry[1]


@partial(jax.jit, static_argnames=("scheme", "counts"))
def _simulate(
    pendulum: Pendulum,
    state: State,
    duration: Scalar,
    scheme: Scheme,
    counts: tuple[int, int],
    compared: Comparison | None,
) -> Trajectory:
    """The motion and its status."""
    steps, dt = counts[0], step_size(duration, counts[0])
    reduced, turns = without_turns(state)
    time, states, rate = _save(pendulum, reduced, dt, scheme, counts)
    drift = energy_drift(pendulum, states)
    if compared is None:
        compared = compare_motions(*lax.stop_gradient((pendulum, state, dt)), steps, scheme)
    end = jax.tree.map(lambda leaf: leaf[-1], states)
    # Two programs may round otherwise; what that makes is an error, too.
    estimate = compared.estimate + angle_error(end, compared.end)
    states = with_turns(states, turns)
    finite = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(states)]
    regular = SHEAR * (1.0 + fast_frequency(pendulum) * jnp.abs(duration))
    chaotic = compared.floor / EPS > regular
    chaotic &= estimate < NEAR_ROUNDING * compared.floor
    why = jnp.where(chaotic, Status.BEYOND_HORIZON, Status.TOLERANCE_NOT_REACHED)
    status = jnp.where(estimate > PARTED, why, Status.CONVERGED)
    status = jnp.where(drift > _LARGEST_DRIFT, Status.DRIFT_ABOVE_TOLERANCE, status)
    status = jnp.where(jnp.all(jnp.stack(finite)), status, Status.NONFINITE)
    turn = jnp.maximum(rate, fast_frequency(pendulum)) * jnp.abs(dt)
    status = jnp.where(turn > LARGEST_TURN, Status.STEP_TOO_LARGE, status)
    return Trajectory(
        time, states, drift, estimate, jnp.asarray(steps), status, scheme, method=scheme.name
    )


def save_by_step(
    pendulum: Pendulum,
    state: State,
    duration: Scalar,
    scheme: Scheme,
    save_every: int,
    error: bool,
    most_steps: int,
) -> Trajectory:
    """The motion over `duration` [s] at even steps of `scheme.step` at most, by a program of its
    own.

    Raises:
        ValueError: more than `most_steps` steps.
    """
    known = cast(float, known_value(duration))
    steps = scheme.steps(known)
    if steps > most_steps:
        raise ValueError(
            f"step must make at most {most_steps:,} steps, got {scheme.step:g} s, which makes "
            f"{steps:,}: "
            "give a larger step, a shorter duration, or more most_steps"
        )
    compared = None if error else comparison_of(math.nan)
    leaves = jax.tree.leaves((pendulum, state))
    if error and not any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        # By the one program for all numbers of steps.
        dt = step_size(known, steps)
        compared = compare(pendulum, state, dt, jnp.asarray(steps), any_step(scheme))
    time, counts = jnp.asarray(duration, jnp.float64), (steps, min(save_every, steps))
    return _simulate(pendulum, state, time, scheme, counts, compared)
