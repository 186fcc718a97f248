"""Motions at saved times (`simulate`), each with an estimate of its own error."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dpend._runtime import require_float64
from dpend.checks import at_most_one, flag, integer, known_number, one_of, shown
from dpend.mechanics.pendulum import Pendulum, State, check_mechanics, check_motion
from dpend.methods.scheme import METHODS, Scheme
from dpend.motion.estimate import fastest_of_all
from dpend.motion.integrate import float64, known_duration
from dpend.motion.stepped import save_by_step
from dpend.motion.tables import many_motions, motion_at_steps, one_motion, trace_motion
from dpend.motion.trajectory import TOLERANCE, Trajectory, check_times

# Steps of a motion, if nobody asks for more: half a minute at order 8 with the second pass and all
# states saved, and half a gigabyte.
MOST_MOTION_STEPS = 2_000_000
# Saved times in a radian of the fastest motion at the start, so that a curve through them is
# smooth; and how many where the pendulum or the state is traced, which tell of no rate.
_TIMES_A_RADIAN, _TIMES_UNKNOWN = 20, 1001


def simulate(
    pendulum: Pendulum | Any,
    state: State | Any,
    duration: float | Any | None = None,
    *,
    times: Any | None = None,
    step: float | Any | None = None,
    method: str | Any | None = None,
    tolerance: float | Any | None = None,
    save_every: int | Any | None = None,
    error: bool | Any = True,
    most_steps: int | Any = MOST_MOTION_STEPS,
) -> Trajectory:
    """The motion from `state`, for a tolerance or at a given step, with an estimate of its error.

    For a tolerance the steps are chosen as the motion goes, by Gauss collocation at eight nodes
    (order 16) beside a companion at Lobatto's nodes that starts a quarter of a rounding away. Their
    difference is the estimate: it holds truncation, rounding and the growth of both. Where the
    estimate passes the tolerance the motion is computed again, with finer steps. Saved states come
    from the steps' own polynomials. First derivatives of the saved states, forward and reverse,
    solve the variational equation on the same steps; second ones are refused. It traces in the
    pendulum, the state and the times, under `jit` and `vmap`.

    At a step the estimate is Richardson's, |x_h - x_(h/2)|/(1 - 2^-p), at the worst step, in the
    larger angle. The second pass keeps the rounding errors of its sums, so that the difference is
    the rounding error of the first, too. Where there may be nothing else in it, more such passes
    are made, each from a start some roundings away, and the largest difference counts.

    Arguments:
        pendulum, state: leaves are scalars; for a tolerance, or arrays of one shape (m,): so many
            motions, each with its own steps.
        duration: time [s]; negative runs backwards. Without it the motion ends at the last of
            `times`.
        times: when the state is saved [s], shape (n,): increasing from zero or more, or decreasing
            from zero or less. By default evenly spaced, 20 a radian of the fast mode or of the
            faster rod at the start; 1001 where the pendulum or the state is traced.
        step: largest step [s].
        method: of the steps of a given size; the default is `rk8`, which needs ten times fewer
            evaluations than `rk4` at an error of 1e-9.
        tolerance: wanted error of the angles [rad] at the worst time; 1e-9 if neither it nor a step
            is given. If no steps bring the estimate below it, the status is `BEYOND_HORIZON` where
            the motion is chaotic and errors of rounding have grown so far, and
            `TOLERANCE_NOT_REACHED` where it is not. At a step the same is said of estimates above
            0.1 rad.
        save_every: every how many steps a state is saved; the last state always is. The default at
            a step is 1. For a tolerance it saves at the ends of steps in place of `times`.
        error: at a step, make the second pass. Without it `error_estimate` is NaN, at a third of
            the time. For a tolerance the estimate costs nothing.
        most_steps: how many steps are taken at most. A step that makes more is refused; for a
            tolerance the status is `MAX_ITERATIONS` then, and states beyond are NaN.
    Returns:
        Trajectory; its arrays are NumPy's for a tolerance, unless something is traced.
    Raises:
        ValueError: duration zero, not finite or not known, or neither it nor times given; times
            not in order or beyond the duration; step and tolerance, or times and save_every, both
            given; a method without a step; a step not positive or longer than the motion;
            save_every below 1; more steps than `most_steps`.
        RuntimeError: float64 is switched off in JAX.
    """
    require_float64()
    at_most_one(step=step, tolerance=tolerance)
    at_most_one(times=times, save_every=save_every)
    at_most_one(times=times, step=step)
    error, most_steps = flag("error", error), integer("most_steps", most_steps)
    every = None if save_every is None else integer("save_every", save_every)
    name = _check_method(method)
    if step is not None:
        check_motion(pendulum, state)
        scheme = Scheme(name, step)
        _check_duration(duration)
        return save_by_step(
            pendulum, float64(state), duration, scheme, every or 1, error, most_steps
        )
    if method is not None:
        raise ValueError(
            f"method must come with a step, got {shown(method)} without one: give a step, or no "
            f"method for a tolerance"
        )
    wish = TOLERANCE if tolerance is None else tolerance
    tolerance = known_number("tolerance", wish, positive=True, unit="rad")
    check_mechanics(pendulum, state)
    end, grid = _span(pendulum, state, duration, times, every)
    return _for_tolerance(pendulum, state, grid, every, (end, tolerance, most_steps))


def _for_tolerance(
    pendulum: Pendulum, state: State, grid: Any, every: int | None, asked: tuple
) -> Trajectory:
    """The motions at the times of `grid`, or at the ends of steps where that is None."""
    shapes = {np.shape(leaf) for leaf in jax.tree.leaves((pendulum, state))} - {()}
    lanes = np.broadcast_shapes(*shapes) if shapes else ()
    if _is_traced((pendulum, state, asked[0], grid)):
        if every is not None:
            raise ValueError(
                f"save_every must not be given where the motion is traced, whose steps are not "
                f"known, got {every}: give times"
            )
        return trace_motion(pendulum, state, grid, asked)
    if len(lanes) > 1 or (lanes and every is not None):
        raise ValueError(
            f"state must have one dimension at most, and none with save_every, got shape {lanes}: "
            f"reshape it, or give times"
        )
    if every is not None:
        return motion_at_steps(pendulum, state, asked, every)
    if lanes:
        return many_motions(pendulum, state, grid, asked, lanes[0])
    return one_motion(pendulum, state, grid, asked)


def _is_traced(tree: Any) -> bool:
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def _check_duration(duration: Any) -> float:
    known = known_duration(duration)
    if known is None or known == 0.0:
        raise ValueError(
            f"duration must be a finite number [s] other than zero, known before tracing, got "
            f"{shown(duration)}: give another duration"
        )
    return known


def _span(
    pendulum: Pendulum, state: State, duration: Any, times: Any, every: int | None
) -> tuple[Any, Any]:
    """The end of the motion [s], and its saved times; None for those with `every`."""
    if times is None:
        if duration is None:
            raise ValueError(
                "duration must be given where times are not, got None: give one of them"
            )
        known = _check_duration(duration)
        end = duration if isinstance(duration, jax.core.Tracer) else known
        if every is not None:
            return end, None
        return end, np.linspace(0.0, 1.0, _count_times(pendulum, state, known)) * end
    traced = isinstance(times, jax.core.Tracer)
    grid = jnp.atleast_1d(jnp.asarray(times, jnp.float64)) if traced else check_times(times)
    if duration is None:
        return grid[-1], grid
    known = _check_duration(duration)
    if not traced and (abs(grid[-1]) > abs(known) or grid[-1] * known < 0):
        raise ValueError(
            f"times must lie between zero and the duration of {known:g} s, got {shown(grid)}: "
            f"give a longer duration, or none"
        )
    return duration if isinstance(duration, jax.core.Tracer) else known, grid


def _count_times(pendulum: Pendulum, state: State, duration: float) -> int:
    if _is_traced((pendulum, state)):
        return _TIMES_UNKNOWN
    rate = float(np.max(np.nan_to_num(fastest_of_all(pendulum, state), posinf=0.0)))
    count = 2 + math.ceil(_TIMES_A_RADIAN * rate * abs(duration))
    if count > MOST_MOTION_STEPS:
        raise ValueError(
            f"duration must be at most some {MOST_MOTION_STEPS / rate / _TIMES_A_RADIAN:.1e} s "
            f"where all of a motion is saved, got {duration:g}: give a shorter one, or times"
        )
    return count


def _check_method(method: Any) -> str:
    name = "rk8" if method is None else one_of("method", method, tuple(METHODS))
    if not METHODS[name].even:
        raise ValueError(
            f"method must take even steps to save states at, got {name!r}: give rk8-circle, or use "
            f"flow"
        )
    return name
