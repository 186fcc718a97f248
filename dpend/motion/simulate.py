"""Motions at saved times (`simulate`), each with an estimate of its own error."""

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

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
    number,
    one_of,
    shown,
    single,
)
from dpend.mechanics.pendulum import (
    Pendulum,
    State,
    check_motion,
    energy_scale,
    fast_frequency,
    hamiltonian,
)
from dpend.methods.scheme import METHODS, Scheme
from dpend.motion.estimate import (
    EPS,
    SHEAR,
    Comparison,
    angle_error,
    any_step,
    compare,
    compare_motions,
    comparison_of,
    fastest_of_all,
    fastest_rod,
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
            wish = f"{_PARTED:g} rad, where it has parted from the true motion"
            mends += [] if chaotic else ["use a smaller step"]
        else:
            wish = f"the tolerance of {tolerance:.2g} rad"
            wish += ", which is the default" if tolerance == _TOLERANCE else ""
            if estimate < _PARTED:
                mends += [f"ask for a tolerance of {1.05 * estimate / _MARGIN:.1e} rad or more"]
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


# In one step a rod may turn, and the fast mode advance, by this much [rad]: beyond it neither
# method resolves the motion, whatever the energy says.
_LARGEST_TURN = 1.0
# Steps of a motion, if nobody asks for more: half a minute at order 8 with the second pass and all
# states saved, and half a gigabyte.
MOST_MOTION_STEPS = 2_000_000

# An error of this many radians is no small error: the computed motion has parted from the true one.
_PARTED = 0.1


def _saved(pendulum, state, dt, steps, scheme, save_every, room):  # type: ignore[no-untyped-def]
    """Times and states at steps 0, save_every, 2 save_every, ..., steps, and the largest rate met
    on the way.

    Counts that are ints make a scan, which has both derivatives. Traced ones fill a table of `room`
    rows, those left over repeating the last, so that one program serves all counts.
    """
    constants = scheme.constants(pendulum, dt)

    def step(carry, time, dt):  # type: ignore[no-untyped-def]
        point = scheme.move(constants, carry[0])
        return point, jnp.fmax(carry[1], fastest_rod(pendulum, scheme.leave(constants, point)))

    def segment(carry, index, count):  # type: ignore[no-untyped-def]
        carry = march(step, carry, dt, count, index)
        # One row to save, not four: XLA would copy four arrays whole at every save.
        return carry, jnp.stack(jax.tree.leaves(scheme.leave(constants, carry[0])))

    first = jnp.stack(jax.tree.leaves(state))
    carry = (scheme.enter(pendulum, state), fastest_rod(pendulum, state))
    if room is not None:
        index = jnp.arange(room)
        last = -(-steps // save_every)

        def save(i, carried):  # type: ignore[no-untyped-def]
            carry, rows = carried
            carry, row = segment(
                carry, (i - 1) * save_every, jnp.minimum(save_every, steps - (i - 1) * save_every)
            )
            return carry, lax.dynamic_update_index_in_dim(rows, row, i, 0)

        carry, rows = lax.fori_loop(1, last + 1, save, (carry, jnp.broadcast_to(first, (room, 4))))
        rows = jnp.where(index[:, None] <= last, rows, rows[last])
        return jnp.minimum(index * save_every, steps).astype(float) * dt, State(*rows.T), carry[1]
    full, rest = divmod(steps, save_every)
    at = np.arange(full + 1) * save_every
    carry, rows = lax.scan(lambda c, i: segment(c, i, save_every), carry, jnp.asarray(at[:-1]))
    rows = jnp.concatenate([first[None], rows])
    if rest:
        at = np.append(at, steps)
        carry, last = segment(carry, full * save_every, rest)
        rows = jnp.concatenate([rows, last[None]])
    return jnp.asarray(at, jnp.float64) * dt, State(*rows.T), carry[1]


def _simulated(  # type: ignore[no-untyped-def]
    pendulum, state, duration, steps, scheme, save_every, room, compared, tolerance, drift_tolerance
):
    dt = step_size(duration, steps)
    reduced, turns = without_turns(state)
    time, states, rate = _saved(pendulum, reduced, dt, steps, scheme, save_every, room)
    drift = energy_drift(pendulum, states)
    if compared is None:
        compared = compare_motions(*lax.stop_gradient((pendulum, state, dt)), steps, scheme)
    end = jax.tree.map(lambda leaf: leaf[-1], states)
    # Two programs may round otherwise; what that makes is an error, too.
    estimate = compared.estimate + angle_error(end, compared.end)
    states = with_turns(states, turns)
    finite = jax.tree.reduce(
        lambda ok, leaf: ok & jnp.all(jnp.isfinite(leaf)), states, jnp.asarray(True)
    )
    wanted = jnp.where(jnp.isnan(tolerance), _PARTED, tolerance)
    growth = compared.floor / EPS
    regular = SHEAR * (1.0 + fast_frequency(pendulum) * jnp.abs(duration))
    chaotic = (growth > regular) & (estimate < _NEAR_ROUNDING * compared.floor)
    why = jnp.where(chaotic, Status.BEYOND_HORIZON, Status.TOLERANCE_NOT_REACHED)
    status = jnp.where(estimate > wanted, why, Status.CONVERGED)
    status = jnp.where(drift > drift_tolerance, Status.DRIFT_ABOVE_TOLERANCE, status)
    status = jnp.where(finite, status, Status.NONFINITE)
    turn = jnp.maximum(rate, fast_frequency(pendulum)) * jnp.abs(dt)
    status = jnp.where(turn > _LARGEST_TURN, Status.STEP_TOO_LARGE, status)
    return Trajectory(time, states, drift, estimate, jnp.asarray(steps), status, scheme, tolerance)


_simulate = jax.jit(_simulated, static_argnames=("steps", "scheme", "save_every", "room"))
_simulate_traced = jax.jit(_simulated, static_argnames=("scheme", "room"))

# Errors of so many roundings of the start may be those of rounding, of more they are not. Those are
# of some 30, but in one of ten cases of more than 100 to 300 (order 8, releases from the whole
# square, 2 to 10 s).
_NEAR_ROUNDING = 1e4


def energy_drift(pendulum: Pendulum, states: State) -> Scalar:
    """The largest |H - H(0)| along saved states, in units of the energy scale."""
    energy = hamiltonian(pendulum, states)
    start = jax.tree.map(lambda leaf: leaf[0], states)
    return jnp.max(jnp.abs(energy - energy[0])) / energy_scale(pendulum, start)


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
    drift_tolerance: float | Any | None = None,
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
        drift_tolerance: largest energy drift, in units of the energy scale, that passes. By default
            1e-6 for a step, far above what a method loses at a sensible one; for a tolerance any,
            the error itself being known.
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
    method = (
        ("rk8-circle" if step is None else "rk8")
        if method is None
        else one_of("method", method, tuple(METHODS))
    )
    if drift_tolerance is None:
        drift_tolerance = math.inf if step is None else 1e-6
    else:
        drift_tolerance = number("drift_tolerance", drift_tolerance, positive=True)
        single("drift_tolerance", drift_tolerance)
    if not Scheme(method, 1.0).even:
        raise ValueError(
            f"method must take even steps to save states at, got {method!r}: give rk8-circle, or "
            f"use flow"
        )
    state = float64(state)
    traced = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((pendulum, state)))
    compared = None  # is made beside the motion
    if step is None:
        if traced:
            raise ValueError(
                "tolerance needs a state and a pendulum that are known, got traced ones: give a "
                "step"
            )
        tolerance = known_number(
            "tolerance", _TOLERANCE if tolerance is None else tolerance, positive=True, unit="rad"
        )
        scheme, compared = _scheme_reaching(pendulum, state, known, method, tolerance, most_steps)
    else:
        tolerance, scheme = math.nan, Scheme(method, step)
        compared = None if error else comparison_of(math.nan)
    steps = scheme.steps(known)
    if steps > most_steps:
        raise ValueError(
            f"step must make at most {most_steps:,} steps, got {scheme.step:g} s, which makes "
            f"{steps:,}: "
            "give a larger step, a shorter duration, or more most_steps"
        )
    every = min(save_every, steps)
    time = jnp.asarray(duration, jnp.float64)
    if compared is None and not traced:  # by the one program for all numbers of steps
        compared = compare(
            pendulum, state, step_size(known, steps), jnp.asarray(steps), any_step(scheme)
        )
    if step is not None:
        return _simulate(
            pendulum, state, time, steps, scheme, every, None, compared, tolerance, drift_tolerance
        )
    # The number of steps being this motion's own, a program that were compiled for it would be used
    # once.
    rows = 1 + -(-steps // every)
    room = max(_LEAST_ROOM, 1 << (rows - 1).bit_length())
    counts = jnp.asarray(steps), jnp.asarray(every)
    motion = _simulate_traced(
        pendulum,
        state,
        time,
        counts[0],
        any_step(scheme),
        counts[1],
        room,
        compared,
        tolerance,
        drift_tolerance,
    )
    time, states = jax.tree.map(
        lambda rows_: jnp.asarray(np.asarray(rows_)[:rows]), (motion.time, motion.state)
    )
    return replace(motion, time=time, state=states, scheme=scheme)


# Rows of the smallest table that a motion of unknown length is saved in; larger ones double.
_LEAST_ROOM = 1024
# The error that is asked for by default [rad].
_TOLERANCE = 1e-9
# The share of a tolerance that the search for a step aims at: an estimate may itself be off by a
# tenth.
_MARGIN = 0.8
# The first step that is tried when one is sought [rad of the fastest motion at the start].
_FIRST_TURN = 0.5
# Below (rate dt)^p of this the truncation of a step is lost in rounding: a smaller step only adds
# to that.
_ONLY_ROUNDING = 1e-18
# A motion that keeps its energy this well, in units of its scale, has steps that resolve it.
_RESOLVED = 1e-10
# What a rounding grows to is believed where two steps tell it within this factor.
_ALIKE = 10.0


def _scheme_reaching(
    pendulum: Pendulum,
    state: State,
    duration: float,
    method: str,
    tolerance: float,
    most_steps: int,
) -> tuple[Scheme, Comparison]:
    """The method with a step at which the error of this motion is below `tolerance`, or as small as
    rounding or `most_steps` allow, and what a second pass told of it.
    """
    rate = float(fastest_of_all(pendulum, state))
    if not math.isfinite(rate):
        rate = 0.0  # whatever the step, the status will say so
    steps = max(1, math.ceil(abs(duration) * rate / _FIRST_TURN))
    if steps > most_steps:
        raise ValueError(
            f"duration must be at most some {_FIRST_TURN * most_steps / rate:.1e} s for a "
            f"tolerance, got {duration:g}, "
            f"which takes {steps:.3g} steps or more: give a shorter one, a step, or more most_steps"
        )
    best, last, last_floor, fall, order = None, math.inf, math.inf, 1.0, Scheme(method, 1.0).order
    while True:
        scheme = Scheme(method, abs(duration) / steps)
        dt, count = step_size(duration, steps), jnp.asarray(steps)
        compared = compare(pendulum, state, dt, count, any_step(scheme))
        error, floor, fastest, drift = (float(value) for value in compared[:4])
        turn = scheme.step * np.fmax(rate, fastest)
        if turn <= _LARGEST_TURN and not (best and best[0] < error):
            best = error, scheme, compared
        near = error < _PARTED  # to the true motion all along, or else at least to its energy
        alike = (
            last_floor / _ALIKE < floor < _ALIKE * last_floor
        )  # too long a step makes growth of its own
        lost = alike and floor > tolerance and (near or drift < _RESOLVED)
        steady = alike and near and error < _NEAR_ROUNDING * floor and error > last * fall
        found = turn <= _LARGEST_TURN and (error <= _MARGIN * tolerance or lost or steady)
        missing = (2 * error / tolerance) ** (1 / order) if math.isfinite(error) else 4.0
        more = min(max(missing, turn, 1.2), 4.0)
        steps, last, last_floor, fall = math.ceil(steps * more), error, floor, more ** (-order / 2)
        if found or turn < _ONLY_ROUNDING ** (1 / order) or steps > most_steps:
            return (best or (error, scheme, compared))[1:]
