"""An independent solution by diffrax (`reference`), to compare with."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import ArrayLike

from dpend._runtime import require_float64
from dpend.checks import Scalar, flag, integer, known_value, number, single
from dpend.mechanics.linear import fast_frequency
from dpend.mechanics.pendulum import Pendulum, State, check_motion, vector_field
from dpend.mechanics.trig import LARGEST_ANGLE
from dpend.motion.estimate import (
    EPS,
    angle_error,
    count_roundings,
    energy_drift,
    fastest_rod,
    growth_along,
)
from dpend.motion.integrate import float64
from dpend.motion.trajectory import Trajectory, check_times
from dpend.status import Status

# Steps, if nobody asks for more: at 20 microseconds each they take half a minute, as the most steps
# of `simulate` do.
_MOST_ADAPTIVE_STEPS = 1_000_000

# The change at ten times the tolerance is some eight times the error, but in two of a hundred
# random motions less, at the worst 0.31 of it, where a small swing takes 18 steps (tolerances 1e-7
# to 1e-13, against long double).
_CHANGES = 5.0
# Below this the rounding of a step is more than the error that its size is chosen by: all are taken
# back for ever.
_LEAST_TOLERANCE = 1e-13
# The shortest step [1/(fastest rate at the start)].
_LEAST_STEP = 1e-12


def reference(
    pendulum: Pendulum | Any,
    state: State | Any,
    times: ArrayLike | Sequence[float] | Any,
    *,
    tolerance: float | Any = 1e-13,
    error: bool | Any = True,
    most_steps: int | Any = _MOST_ADAPTIVE_STEPS,
) -> Trajectory:
    """The motion at `times` by diffrax's Dopri8 with adaptive steps: independent of this package's
    integrators.

    It takes as many steps as it needs, up to `most_steps`. The error estimate is five times the
    change when the tolerance is ten times larger, and what one rounding of the start grows to.

    Arguments:
        pendulum, state: leaves are scalars; `state` holds at t = 0.
        times: increasing from zero or more, or decreasing from zero or less [s], shape (n,).
        tolerance: relative and absolute, of angles [rad] and of momenta in units of the motion's
            own inertia and rate; 1e-13 is the least that rounding leaves room for.
        error: make the second solution. Without it `error_estimate` is NaN.
        most_steps: how many steps are taken at most; each number has a program of its own.
    Returns:
        Trajectory, its `steps` those of the better solution; status `MAX_ITERATIONS` where that
        would be more than `most_steps`, `NONFINITE` where diffrax gave up otherwise.
    Raises:
        ValueError: times empty, not finite, not monotonic or on both sides of zero; tolerance below
            1e-13.
        RuntimeError: float64 is switched off in JAX.
    """
    require_float64()
    check_motion(pendulum, state)
    error, tolerance = flag("error", error), number("tolerance", tolerance, positive=True)
    single("tolerance", tolerance)
    most_steps = integer("most_steps", most_steps)
    known = known_value(tolerance)
    if known is not None and not known >= _LEAST_TOLERANCE:
        raise ValueError(
            f"tolerance must be at least {_LEAST_TOLERANCE:g}, which rounding leaves room for, got "
            f"{known:g}: "
            "give a larger tolerance"
        )
    grid = jnp.asarray(check_times(times))
    state = float64(state)
    roundings = count_roundings(state) if error else None
    states, growth, steps, done = _dopri8(pendulum, state, roundings, grid, tolerance, most_steps)
    estimate = jnp.asarray(jnp.nan)
    if error:
        coarse, *_ = _dopri8(pendulum, state, roundings, grid, 10 * tolerance, most_steps)
        estimate = _CHANGES * angle_error(states, coarse) + jnp.fmin(EPS * growth, jnp.pi)
    with_start = jax.tree.map(lambda x, xs: jnp.concatenate([x[None], xs]), state, states)
    lost = jnp.where(steps < most_steps, Status.NONFINITE, Status.MAX_ITERATIONS)
    status = jnp.where(done, Status.CONVERGED, lost)
    drift = energy_drift(pendulum, with_start)
    return Trajectory(grid, states, drift, estimate, steps, status, method="diffrax Dopri8")


@partial(jax.jit, static_argnames="most_steps")
def _dopri8(
    pendulum: Pendulum,
    state: State,
    tangents: State | None,
    times: Scalar,
    tolerance: Scalar,
    most_steps: int,
) -> tuple[State, Scalar, Scalar, Scalar]:
    """States at `times`, what tangents of the angles grow to, steps taken, and whether diffrax
    succeeded.
    """
    import diffrax

    rate = jnp.fmax(fast_frequency(pendulum), fastest_rod(pendulum, state))
    inertias = (pendulum.m1 + pendulum.m2) * pendulum.l1**2, pendulum.m2 * pendulum.l2**2
    unit = State(1.0, 1.0, inertias[0] * rate, inertias[1] * rate)

    def field(scaled: State) -> State:
        here = jax.tree.map(jnp.multiply, scaled, unit)
        slopes = jax.tree.map(jnp.divide, vector_field(pendulum, here), unit)
        # A slope that is not a number would have its step retried for ever: stand still there, and
        # say so at the end.
        return jax.tree.map(lambda leaf: jnp.where(_in_reach(here), leaf, 0.0), slopes)

    def slope(time: Scalar, pair: Any, nothing: None) -> tuple[State, State | None]:
        scaled, tangents = pair
        slopes, push = jax.linearize(field, scaled)
        return slopes, None if tangents is None else jax.vmap(push)(tangents)

    sound = _in_reach(state)
    start = jax.tree.map(lambda leaf: jnp.where(sound, leaf, 0.0), state)
    tangents = jax.tree.map(lambda leaf: jnp.where(sound, leaf, 0.0), tangents)
    if tangents is not None:
        tangents = jax.tree.map(lambda leaf, one: leaf / one, tangents, unit)

    control = diffrax.PIDController(
        rtol=tolerance, atol=tolerance, dtmin=_LEAST_STEP / rate, norm=_size_of_state
    )
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(slope),
        diffrax.Dopri8(),
        t0=0.0,
        t1=times[-1],
        dt0=None,
        y0=(jax.tree.map(jnp.divide, start, unit), tangents),
        saveat=diffrax.SaveAt(ts=times),
        stepsize_controller=control,
        max_steps=most_steps,
        throw=False,
    )
    scaled, tangents = solution.ys
    states = jax.tree.map(jnp.multiply, scaled, unit)
    sound &= jnp.all(_in_reach(states))
    states = jax.tree.map(lambda leaf: jnp.where(sound, leaf, jnp.nan), states)
    done = sound & (solution.result == diffrax.RESULTS.successful)
    return states, growth_along(tangents), solution.stats["num_steps"], done


def _size_of_state(pair: tuple[State, State | None]) -> Scalar:
    """The root mean square of the first, so that tangents have no say in the steps."""
    leaves = jax.tree.leaves(pair[0])
    return jnp.sqrt(sum(jnp.square(leaf) for leaf in leaves) / len(leaves))


def _in_reach(state: State) -> Scalar:
    """Whether the vector field can be computed here: finite, and angles that sine and cosine can
    reduce.
    """
    angles = jnp.maximum(jnp.abs(state.theta1), jnp.abs(state.theta2))
    return (angles <= LARGEST_ANGLE) & jnp.isfinite(state.p1) & jnp.isfinite(state.p2)
