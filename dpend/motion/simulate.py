"""Motions at saved times (`simulate`), each with an estimate of its own error."""

import math
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from dpend._runtime import require_float64
from dpend.checks import (
    Scalar,
    at_most_one,
    flag,
    integer,
    known_number,
    known_value,
    one_of,
    shown,
)
from dpend.mechanics.linear import fast_frequency
from dpend.mechanics.pendulum import Pendulum, State, check_motion
from dpend.methods.runge_kutta import Point
from dpend.methods.scheme import METHODS, Scheme
from dpend.motion.estimate import (
    EPS,
    LARGEST_TURN,
    MARGIN,
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
    find_scheme,
)
from dpend.motion.integrate import (
    float64,
    known_duration,
    march,
    step_size,
    with_turns,
    without_turns,
)
from dpend.records import variables
from dpend.status import Status, message

# Steps of a motion, if nobody asks for more: half a minute at order 8 with the second pass and all
# states saved, and half a gigabyte.
MOST_MOTION_STEPS = 2_000_000
# The largest energy drift that passes for a given step, in units of the energy scale: far above
# what a method loses at a sensible one.
_LARGEST_DRIFT = 1e-6
# Rows of the smallest table that a motion of unknown length is saved in; larger ones double.
_LEAST_ROOM = 1024
# The error that is asked for by default [rad].
_TOLERANCE = 1e-9


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Trajectory:
    """A motion at its saved times.

    Attributes:
        time: times [s], shape (n,).
        state: the states, leaves of shape (n,).
        energy_drift: the largest |H - H(0)| at a saved time, in units of `energy_scale`.
        error_estimate: of the larger angle, at the worst step [rad]; NaN where no second pass was
            made. For `reference` at the worst of its times.
        steps: the number of steps taken.
        status: a value of `Status`.
        scheme: method and step; None for `reference`, which chooses its steps as it goes.
        tolerance: the error that was asked for [rad]; NaN where a step was given.
    """

    time: Annotated[Scalar, "s"]
    state: State
    energy_drift: Scalar
    error_estimate: Scalar
    steps: Scalar
    status: Scalar
    scheme: Scheme | None = field(default=None, metadata={"static": True})
    tolerance: Scalar = math.nan

    @property
    def message(self) -> str:
        """The sentence that says how this motion went, with its error estimate and the one asked
        for.
        """
        status = Status(int(self.status))
        if status not in (Status.BEYOND_HORIZON, Status.TOLERANCE_NOT_REACHED):
            return message(status)
        chaotic = status == Status.BEYOND_HORIZON
        estimate, tolerance = float(self.error_estimate), float(self.tolerance)
        mends = ["shorten it"] if chaotic else []
        if math.isnan(tolerance):
            wish = f"{PARTED:g} rad, where it has parted from the true motion"
            mends += [] if chaotic else ["use a smaller step"]
        else:
            wish = f"the tolerance of {tolerance:.2g} rad"
            wish += ", which is the default" if tolerance == _TOLERANCE else ""
            if estimate < PARTED:
                mends += [f"ask for a tolerance of {1.05 * estimate / MARGIN:.1e} rad or more"]
        why = "the motion is chaotic, and errors of rounding have grown so far" if chaotic else ""
        why = why or (
            "the step is too large"
            if math.isnan(tolerance)
            else "no step that was tried brings it lower"
        )
        mend = " or ".join(mends or ["shorten it"])
        return f"The error estimate, {estimate:.1e} rad, is above {wish}: {why}; {mend}."

    def to_xarray(self) -> Any:
        """The motion as an `xarray.Dataset` over `time`: radians and SI units, the angles in
        degrees as coordinates.
        """
        import xarray

        data, degrees = variables(self.state, "time")
        attributes = {
            "energy_drift": float(self.energy_drift),
            "error_estimate_rad": float(self.error_estimate),
            "tolerance_rad": float(self.tolerance),
            "steps": int(self.steps),
            "method": self.scheme.name if self.scheme else "diffrax Dopri8",
            "status": Status(int(self.status)).name.lower(),
        }
        time = ("time", np.asarray(self.time), {"units": "s"})
        return xarray.Dataset(data, {"time": time, **degrees}, attributes)


class _Plan(NamedTuple):
    """What a program is compiled for."""

    scheme: Scheme
    # Numbers of steps, and of steps between saves: they make scans, which have both derivatives.
    counts: tuple[int, int] | None
    # Without them: how many rows are saved, those left over repeating the last one.
    room: int = 0


def _save(
    pendulum: Pendulum, state: State, dt: Scalar, plan: _Plan, counts: tuple[Scalar, Scalar]
) -> tuple[Scalar, State, Scalar]:
    """Times and states at steps 0, save_every, 2 save_every, ..., steps, and the largest rate met
    on the way.
    """
    scheme, (steps, save_every) = plan.scheme, counts
    constants = scheme.constants(pendulum, dt)

    def step(carry: tuple[Point, Scalar], time: Scalar, dt: Scalar) -> tuple[Point, Scalar]:
        point = scheme.move(constants, carry[0])
        return point, jnp.fmax(carry[1], fastest_rod(pendulum, scheme.leave(constants, point)))

    def segment(
        carry: tuple[Point, Scalar], first: Scalar, count: Scalar
    ) -> tuple[tuple[Point, Scalar], jax.Array]:
        carry = march(step, carry, dt, count, first)
        # One row to save, not four: XLA would copy four arrays whole at every save.
        return carry, jnp.stack(jax.tree.leaves(scheme.leave(constants, carry[0])))

    def save(carry: tuple[Point, Scalar], index: Scalar) -> tuple[tuple[Point, Scalar], jax.Array]:
        first = index * save_every
        known = plan.counts is not None
        count = save_every if known else jnp.clip(steps - first, 0, save_every)
        return segment(carry, first, count)

    start = jnp.stack(jax.tree.leaves(state))[None]
    carry = (scheme.enter(pendulum, state), fastest_rod(pendulum, state))
    full, rest = (plan.room - 1, 0) if plan.counts is None else divmod(steps, save_every)
    carry, rows = lax.scan(save, carry, jnp.arange(full))
    rows = jnp.concatenate([start, rows])
    if rest:
        carry, last = segment(carry, full * save_every, rest)
        rows = jnp.concatenate([rows, last[None]])
    at = jnp.minimum(jnp.arange(len(rows)) * save_every, steps)
    return at.astype(float) * dt, State(*rows.T), carry[1]


@partial(jax.jit, static_argnames="plan")
def _simulate(
    pendulum: Pendulum,
    state: State,
    duration: Scalar,
    plan: _Plan,
    counts: tuple[Scalar, Scalar],
    compared: Comparison | None,
    tolerance: Scalar,
) -> Trajectory:
    """The motion and its status; `counts` count where `plan` has none."""
    steps, _ = counts = plan.counts or counts
    dt = step_size(duration, steps)
    reduced, turns = without_turns(state)
    time, states, rate = _save(pendulum, reduced, dt, plan, counts)
    drift = energy_drift(pendulum, states)
    if compared is None:
        compared = compare_motions(*lax.stop_gradient((pendulum, state, dt)), steps, plan.scheme)
    end = jax.tree.map(lambda leaf: leaf[-1], states)
    # Two programs may round otherwise; what that makes is an error, too.
    estimate = compared.estimate + angle_error(end, compared.end)
    states = with_turns(states, turns)
    finite = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(states)]
    regular = SHEAR * (1.0 + fast_frequency(pendulum) * jnp.abs(duration))
    chaotic = compared.floor / EPS > regular
    chaotic &= estimate < NEAR_ROUNDING * compared.floor
    by_step = jnp.isnan(tolerance)
    why = jnp.where(chaotic, Status.BEYOND_HORIZON, Status.TOLERANCE_NOT_REACHED)
    is_far = estimate > jnp.where(by_step, PARTED, tolerance)
    status = jnp.where(is_far, why, Status.CONVERGED)
    status = jnp.where(by_step & (drift > _LARGEST_DRIFT), Status.DRIFT_ABOVE_TOLERANCE, status)
    status = jnp.where(jnp.all(jnp.stack(finite)), status, Status.NONFINITE)
    turn = jnp.maximum(rate, fast_frequency(pendulum)) * jnp.abs(dt)
    status = jnp.where(turn > LARGEST_TURN, Status.STEP_TOO_LARGE, status)
    return Trajectory(
        time, states, drift, estimate, jnp.asarray(steps), status, plan.scheme, tolerance
    )


def simulate(
    pendulum: Pendulum | Any,
    state: State | Any,
    duration: float | Any,
    *,
    step: float | Any | None = None,
    method: str | Any | None = None,
    tolerance: float | Any | None = None,
    save_every: int | Any = 1,
    error: bool | Any = True,
    most_steps: int | Any = MOST_MOTION_STEPS,
) -> Trajectory:
    """The motion from `state` over `duration`, with an estimate of its own error.

    The estimate is Richardson's, |x_h - x_(h/2)|/(1 - 2^-p): of the returned solution, at the worst
    step, in the larger angle. The second pass keeps the rounding errors of its sums, so that the
    difference is the rounding error of the first, too. Where there may be nothing else in it, more
    such passes are made, each from a start some roundings away, and the largest difference counts.
    The estimate is never less than one rounding of the start, 2.2e-16, times what a displacement of
    the angles grows to. `Trajectory.message` tells the estimate beside the error that was asked
    for.

    Arguments:
        pendulum, state: leaves are scalars.
        duration: time [s]; negative runs backwards.
        step: largest step [s]. Without it the step is chosen for `tolerance`.
        method: any with even steps. The default is `rk8` for a step, which needs ten times fewer
            evaluations than `rk4` at an error of 1e-9, and `rk8-circle` for a tolerance: no other
            is faster at any error below 1e-3.
        tolerance: wanted error of the angles [rad] at the worst time; 1e-9 if neither it nor a step
            is given. The search for a step aims at 0.8 of it. If no step brings the estimate below
            the tolerance, the status is `BEYOND_HORIZON` where the motion is chaotic and errors of
            rounding have grown so far, and `TOLERANCE_NOT_REACHED` where it is not. For a step the
            same is said of estimates above 0.1 rad.
        save_every: every how many steps a state is saved; the last state always is.
        error: make the second pass at half the step. Without it `error_estimate` is NaN, at a third
            of the time. For a tolerance the search has made it.
        most_steps: how many steps are taken at most. A step that makes more is refused; for a
            tolerance no shorter one is tried then.
    Returns:
        Trajectory.
    Raises:
        ValueError: duration zero or not finite, both step and tolerance given, no step where the
            state or the pendulum is traced, a step not positive or longer than the motion, an
            unknown method, save_every below 1, more steps than `most_steps`.
        RuntimeError: float64 is switched off in JAX.
    """
    require_float64()
    check_motion(pendulum, state)
    known = known_duration(duration)
    if known is None or known == 0.0:
        raise ValueError(
            f"duration must be a finite number [s] other than zero, known before tracing, got "
            f"{shown(duration)}: "
            "give another duration"
        )
    at_most_one(step=step, tolerance=tolerance)
    save_every, error = integer("save_every", save_every), flag("error", error)
    most_steps = integer("most_steps", most_steps)
    method = _check_method(method, "rk8-circle" if step is None else "rk8")
    state = float64(state)
    if step is not None:
        scheme = Scheme(method, step)
        return _by_step(pendulum, state, duration, scheme, save_every, error, most_steps)
    if _is_traced(pendulum, state):
        raise ValueError(
            "tolerance needs a state and a pendulum that are known, got traced ones: give a step"
        )
    wish = _TOLERANCE if tolerance is None else tolerance
    tolerance = known_number("tolerance", wish, positive=True, unit="rad")
    return _to_tolerance(pendulum, state, duration, method, tolerance, save_every, most_steps)


def _check_method(method: Any, default: str) -> str:
    name = default if method is None else one_of("method", method, tuple(METHODS))
    if not METHODS[name].even:
        raise ValueError(
            f"method must take even steps to save states at, got {name!r}: give rk8-circle, or use "
            f"flow"
        )
    return name


def _is_traced(pendulum: Pendulum, state: State) -> bool:
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((pendulum, state)))


def _known(duration: Scalar) -> float:
    return cast(float, known_value(duration))


def _count_steps(scheme: Scheme, duration: float, most_steps: int) -> int:
    steps = scheme.steps(duration)
    if steps > most_steps:
        raise ValueError(
            f"step must make at most {most_steps:,} steps, got {scheme.step:g} s, which makes "
            f"{steps:,}: "
            "give a larger step, a shorter duration, or more most_steps"
        )
    return steps


def _by_step(
    pendulum: Pendulum,
    state: State,
    duration: Scalar,
    scheme: Scheme,
    save_every: int,
    error: bool,
    most_steps: int,
) -> Trajectory:
    """The motion at a given step, by a program of its own."""
    known = _known(duration)
    steps = _count_steps(scheme, known, most_steps)
    compared = None if error else comparison_of(math.nan)
    if error and not _is_traced(pendulum, state):  # by the one program for all numbers of steps
        dt = step_size(known, steps)
        compared = compare(pendulum, state, dt, jnp.asarray(steps), any_step(scheme))
    counts = steps, min(save_every, steps)
    time = jnp.asarray(duration, jnp.float64)
    return _simulate(pendulum, state, time, _Plan(scheme, counts), counts, compared, math.nan)


def _to_tolerance(
    pendulum: Pendulum,
    state: State,
    duration: Scalar,
    method: str,
    tolerance: float,
    save_every: int,
    most_steps: int,
) -> Trajectory:
    """The motion at a step that reaches a tolerance.

    The number of steps is this motion's own: a program that were compiled for it would be used
    once.
    """
    known = _known(duration)
    scheme, compared = find_scheme(pendulum, state, known, method, tolerance, most_steps)
    steps = _count_steps(scheme, known, most_steps)
    every = min(save_every, steps)
    rows = 1 + -(-steps // every)
    plan = _Plan(any_step(scheme), None, max(_LEAST_ROOM, 1 << (rows - 1).bit_length()))
    counts = jnp.asarray(steps), jnp.asarray(every)
    time = jnp.asarray(duration, jnp.float64)
    motion = _simulate(pendulum, state, time, plan, counts, compared, tolerance)
    time, states = jax.tree.map(
        lambda table: jnp.asarray(np.asarray(table)[:rows]), (motion.time, motion.state)
    )
    return replace(motion, time=time, state=states, scheme=scheme)
