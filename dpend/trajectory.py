"""Motions in time: the end state (`flow`), anything accumulated on the way (`fold`), saved states (`simulate`), and an
independent solution by diffrax (`reference`). Also `Status`, the one vocabulary in which results say how they went.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import ArrayLike

from dpend._runtime import require_float64
from dpend.checks import (
    arrays,
    at_most_one,
    flag,
    function,
    integer,
    known_number,
    known_value,
    number,
    numbers,
    one_of,
    shown,
    single,
)
from dpend.pendulum import (
    Pendulum,
    Scalar,
    State,
    check_motion,
    check_state,
    energy_scale,
    fast_frequency,
    hamiltonian,
    vector_field,
)
from dpend.steppers import METHODS, Point, Scheme, check_scheme
from dpend.trig import LARGEST_ANGLE, unwound, wound

Carry = TypeVar("Carry")


class Status(IntEnum):
    """How a computation went: an int leaf of every result. `message` gives the sentence."""

    CONVERGED = 0
    MAX_ITERATIONS = 1
    SINGULAR = 2
    LEFT_BRANCH = 3
    NO_SUCH_ORBIT = 4
    TRIVIAL_ROOT = 5
    STEP_TOO_LARGE = 6
    DRIFT_ABOVE_TOLERANCE = 7
    NONFINITE = 8
    BEYOND_HORIZON = 9
    MISFIT = 10
    NO_SOLUTION = 11
    DISAGREEMENT = 12
    NOT_COMPUTED = 255


_MESSAGES = {
    Status.CONVERGED: "Converged.",
    Status.MAX_ITERATIONS: "Newton's method did not converge in the allowed iterations, or a motion did not come to "
    "its end in the allowed steps; try a closer guess, or a shorter motion.",
    Status.SINGULAR: "The equations are singular here, as at a fold of the family, or where data do not determine what "
    "is asked; try another release angle, or hold what has no finite standard error.",
    Status.LEFT_BRANCH: "The branch could not be followed to this release: no step was short enough to stay on it, or "
    "the orbit found is not on it; the best so far is returned.",
    Status.NO_SUCH_ORBIT: "The branch ends without reaching this release; its largest |theta1| is returned.",
    Status.TRIVIAL_ROOT: "Newton's method fell into an equilibrium or a period of zero; try another guess.",
    Status.STEP_TOO_LARGE: "In one step a rod turned, or the fast mode advanced, by more than 1 rad; use a smaller "
    "step.",
    Status.DRIFT_ABOVE_TOLERANCE: "The energy drifted by more than the tolerance; use a smaller step.",
    Status.NONFINITE: "A value is not finite.",
    Status.BEYOND_HORIZON: "The error estimate exceeds what was asked, or 0.1 rad: the end of this motion is not to be "
    "believed; shorten it, or use a smaller step while that still helps.",
    Status.NO_SOLUTION: "Nothing within the bounds satisfies the equations; what comes nearest is returned.",
    Status.DISAGREEMENT: "A derivative differs from the finite difference by more than their errors explain.",
    Status.MISFIT: "What is left of the data is far above their noise, or not noise: the fit is not to be believed; "
    "check units, times and what is held, or try a closer guess.",
    Status.NOT_COMPUTED: "Not computed.",
}


def message(status: Scalar) -> str:
    """The sentence that says what `status`, a value of `Status`, means.

    Raises:
        ValueError: no such value, or an array of them.
    """
    return _MESSAGES[Status(one_of("status", integer("status", status, least=0), tuple(Status)))]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Trajectory:
    """A motion at its saved times.

    Attributes:
        time: times [s], shape (n,).
        state: the states, leaves of shape (n,).
        energy_drift: the largest |H - H(0)| at a saved time, in units of `energy_scale`.
        error_estimate: of the larger angle, at the worst saved time [rad]; NaN where no second pass was made.
        steps: the number of steps taken.
        status: a value of `Status`.
        scheme: method and step; None for `reference`, which chooses its steps as it goes.
    """

    time: Scalar
    state: State
    energy_drift: Scalar
    error_estimate: Scalar
    steps: Scalar
    status: Scalar
    scheme: Scheme | None = field(default=None, metadata={"static": True})

    def to_xarray(self) -> Any:
        """The motion as an `xarray.Dataset` over `time`: radians and SI units, the angles in degrees as coordinates."""
        import xarray

        units = {"theta1": "rad", "theta2": "rad", "p1": "kg m^2/s", "p2": "kg m^2/s"}
        data = {name: ("time", np.asarray(getattr(self.state, name)), {"units": unit}) for name, unit in units.items()}
        degrees = {
            f"{name}_deg": ("time", np.degrees(np.asarray(getattr(self.state, name))), {"units": "degree"})
            for name in ("theta1", "theta2")
        }
        attributes = {
            "energy_drift": float(self.energy_drift),
            "error_estimate_rad": float(self.error_estimate),
            "steps": int(self.steps),
            "method": self.scheme.name if self.scheme else "diffrax Dopri8",
            "status": Status(int(self.status)).name.lower(),
        }
        time = ("time", np.asarray(self.time), {"units": "s"})
        return xarray.Dataset(data, {"time": time, **degrees}, attributes)


# --- the loop over steps ---------------------------------------------------------------------------------------------

# Reverse mode keeps what every step computed, some 5 kB at order 8. Beyond this many steps it keeps the states between
# blocks of sqrt(n) steps only and computes each block again.
_CHECKPOINT_ABOVE = 1024


def march(
    step: Callable[[Carry, Scalar, Scalar], Carry], carry: Carry, dt: Scalar, steps: Scalar, first: Scalar = 0
) -> Carry:
    """The loop under everything that takes even steps: `steps` times carry = step(carry, time, dt).

    Arguments:
        step: told the time [s] at the end of its step.
        steps: an int compiles to a scan, which has both derivatives; a tracer to a loop with forward mode only.
        first: the number of the first step, from which the time is counted.
    """

    def run(carry: Carry, first: Scalar, count: Scalar) -> Carry:
        return lax.fori_loop(0, count, lambda i, c: step(c, jnp.asarray(first + i + 1, jnp.float64) * dt, dt), carry)

    if not isinstance(steps, int) or steps <= _CHECKPOINT_ABOVE:
        return run(carry, first, steps)
    block = math.isqrt(steps)
    blocks, rest = divmod(steps, block)
    again = jax.checkpoint(lambda c, i: run(c, first + i * block, block))
    carry, _ = lax.scan(lambda c, i: (again(c, i), None), carry, jnp.arange(blocks))
    return run(carry, first + blocks * block, rest) if rest else carry


def moved(scheme: Scheme, pendulum: Pendulum, state: State, dt: Scalar, steps: Scalar) -> State:
    """The state after `steps` even steps of `dt` [s]: `flow` for counts that may be traced."""
    constants = scheme.constants(pendulum, dt)
    end = march(lambda point, time, dt: scheme.move(constants, point), scheme.enter(pendulum, state), dt, steps)
    return scheme.leave(constants, end)


def step_size(duration: Scalar, steps: Scalar) -> Scalar:
    """duration/steps [s], for counts that may be traced."""
    return duration / jnp.asarray(steps, jnp.float64)


def _float64(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.result_type(leaf, jnp.float64)), tree)


# A step of the rescaled method that is this much shorter than it may be belongs to a rod that turns ten thousand times
# as fast as any that gravity moves: the lane is given up as NaN, so that no other waits for it.
_SHORTEST_STEP = 1e-5


class _Along(NamedTuple):
    """What moves along a motion: the scheme's point, tangents (None without), and what `update` accumulates."""

    point: Point
    tangents: State | None
    carry: Any


def _folded(update, init, pendulum, state, tangents, duration, steps, scheme):  # type: ignore[no-untyped-def]
    """The motion, its tangents and what `update` makes of it, over `duration`."""
    state, turns = _without_turns(state)
    along = _Along(scheme.enter(pendulum, state), tangents, init)
    shown = partial(_stepped, update, turns, scheme)
    if scheme.even:
        dt = step_size(duration, steps if not isinstance(steps, int) else max(steps, 1))
        constants = scheme.constants(pendulum, dt)
        along = march(partial(shown, constants), along, dt, steps)
        end = scheme.leave(constants, along.point)
    else:
        end, along = _unevenly(shown, pendulum, state, along, duration, scheme)
    return _with_turns(end, turns), along.tangents, along.carry


class _Turns(NamedTuple):
    """The full turns of both angles, as `unwound` gives them."""

    theta1: tuple[Scalar, Scalar]
    theta2: tuple[Scalar, Scalar]


def _without_turns(state: State) -> tuple[State, _Turns]:
    """A state whose angles are near enough to zero to be rounded finely, and what they are without."""
    (theta1, turns1), (theta2, turns2) = unwound(state.theta1), unwound(state.theta2)
    return State(theta1, theta2, state.p1, state.p2), _Turns(turns1, turns2)


def _with_turns(state: State, turns: _Turns) -> State:
    return State(wound(state.theta1, turns.theta1), wound(state.theta2, turns.theta2), state.p1, state.p2)


def _stepped(update, turns, scheme, constants, along, time, dt):  # type: ignore[no-untyped-def]
    """One step shown to `update`."""
    if along.tangents is None:
        point = scheme.move(constants, along.point)
        return _Along(point, None, update(along.carry, time, dt, _with_turns(scheme.leave(constants, point), turns)))
    point, tangents = scheme.move_tangents(constants, along.point, along.tangents)
    state = _with_turns(scheme.leave(constants, point), turns)
    carry, tangents = update(along.carry, time, dt, state, tangents)
    return _Along(point, tangents, carry)


@custom_vmap
def _any_lane(going: Scalar) -> Scalar:
    """Whether any lane goes on: a loop's condition that under `vmap` is one for all lanes, so that JAX does not select
    every array of every step by it.
    """
    return going


@_any_lane.def_vmap
def _any_of_many(size: int, batched: list[bool], going: Scalar) -> tuple[Scalar, bool]:
    return jnp.any(going), False


def _unevenly(shown, pendulum, state, along, duration, scheme):  # type: ignore[no-untyped-def]
    """Steps in the scheme's own time, the last one cut to end at `duration`.

    A lane that has arrived takes steps of length zero, which leave its point as it is to the bit, until all have.
    """
    sense = jnp.where(duration < 0, -1.0, 1.0)
    longest = scheme.step * scheme.pace(pendulum, state)
    unit = scheme.constants(pendulum)

    def goes(time: Scalar) -> Scalar:
        return sense * (duration - time) > 0

    def advance(carried):  # type: ignore[no-untyped-def]
        along, time, before = carried
        spin = scheme.spin(unit, along.point)
        # Between this step's start and its end u is not yet known: the last step's ratio tells where it goes.
        ahead = jnp.maximum(spin * (spin / before), 1.0)
        root = jnp.sqrt(ahead)
        dt = longest / (root * jnp.sqrt(jnp.sqrt(root)))
        lost = ~(dt >= _SHORTEST_STEP * longest)  # also where it is not a number
        rest, live = duration - time, goes(time)
        last = dt >= sense * rest
        dt = jnp.where(lost, jnp.nan, jnp.where(last, rest, sense * dt))
        dt = jnp.where(live, dt, 0.0)
        time = jnp.where(last & ~lost, duration, time + dt)
        ahead = shown(scheme.lasting(unit, dt), along, time, dt)
        kept = jax.tree.map(partial(jnp.where, live), ahead[1:], along[1:])
        return _Along(ahead.point, *kept), time, spin

    time = jnp.zeros_like(state.theta1)
    # A duration that is not finite leaves nothing of the start.
    point = jax.tree.map(lambda leaf: jnp.where(jnp.isfinite(duration), leaf, jnp.nan), along.point)
    along = along._replace(point=point)
    carried = along, time, scheme.spin(unit, along.point)
    along, _, _ = lax.while_loop(lambda carried: _any_lane(goes(carried[1])), advance, carried)
    return scheme.leave(unit, along.point), along


_fold = jax.jit(_folded, static_argnames=("update", "steps", "scheme"))
_fold_traced = jax.jit(_folded, static_argnames=("update", "scheme"))


def _nothing(carry: Any, time: Scalar, dt: Scalar, state: State) -> Any:
    """The `update` of a motion of which only the end is wanted."""
    return carry


def flow(pendulum: Pendulum | Any, state: State | Any, duration: Scalar, scheme: Scheme | Any) -> State:
    """The state after `duration`, no trajectory stored.

    Even methods take n = ceil(duration/step - 1e-9) steps of duration/n each; the rescaled one takes steps in its own
    time, the last one cut to end there.

    Arguments:
        pendulum, state: leaves are scalars; `jax.vmap` maps over many.
        duration: time [s]; negative runs backwards, zero returns the state. A number known at trace time, or a value
            being differentiated by eager `grad`, fixes n and allows reverse mode (checkpointed beyond 1024 steps); a
            traced one allows forward mode only, as does the rescaled method.
        scheme: method and step.
    Raises:
        ValueError: duration not finite, or shorter than one even step; arguments of other classes, arrays.
        RuntimeError: float64 is switched off in JAX.
    """
    end, _, _ = _accumulate(_nothing, None, pendulum, state, None, duration, scheme)
    return end


def fold(
    update: Callable[..., Any] | Any,
    init: Carry,
    pendulum: Pendulum | Any,
    state: State | Any,
    duration: Scalar,
    scheme: Scheme | Any,
    *,
    tangents: State | Any | None = None,
) -> Any:
    """Something accumulated along the motion: `init` after `update` has seen every step.

    Arguments:
        update: (carry, time, dt, state) -> carry, called after each step with the time [s] at its end, its length and
            the state there. With `tangents`, (carry, time, dt, state, tangents) -> (carry, tangents): it sees them and
            may scale or replace them. Compiled functions are kept by its identity: define it once, not in a loop.
        init: any pytree; Python numbers in it become float64.
        pendulum, state, duration, scheme: as for `flow`.
        tangents: vectors (d theta1, d theta2, d p1, d p2) at t = 0 to carry along by the derivative of the flow: one,
            or several along a leading axis.
    Returns:
        What `update` made of `init`; with `tangents`, that and the tangents at the end.
    Raises:
        ValueError: duration not finite, or shorter than one even step; arguments of other classes, arrays.
        RuntimeError: float64 is switched off in JAX.
    """
    example = "lambda carry, time, dt, state: jnp.maximum(carry, state.theta1)"
    function("update", update, "(carry, time, dt, state)", example)
    arrays("init", init)
    if tangents is not None:
        check_state(tangents, "tangents")
    _, tangents, carry = _accumulate(update, init, pendulum, state, tangents, duration, scheme)
    return carry if tangents is None else (carry, tangents)


def _accumulate(update, init, pendulum, state, tangents, duration, scheme):  # type: ignore[no-untyped-def]
    require_float64()
    check_motion(pendulum, state)
    check_scheme(scheme)
    known = _known_duration(duration)
    if not scheme.even:
        steps: Scalar = 0  # not known beforehand
    elif known is not None:
        steps = scheme.steps(known)
    else:
        # A duration that is not finite takes one step, into NaN.
        count = jnp.where(jnp.isfinite(duration), jnp.abs(duration), 0.0) / scheme.step
        steps = jnp.maximum(jnp.ceil(count - 1e-9), 1).astype(int)
    compiled = _fold if isinstance(steps, int) else _fold_traced
    init = jax.tree.map(_weakly_float64, init)
    time = jnp.asarray(duration, jnp.float64)
    return compiled(update, init, pendulum, _float64(state), _float64(tangents), time, steps, scheme)


def _known_duration(duration: Scalar) -> float | None:
    """The length of a motion [s], checked; None where it is traced."""
    single("duration", number("duration", duration, unit="s"))
    known = known_value(duration)
    if known is not None and not math.isfinite(known):  # under eager differentiation `number` does not see it
        raise ValueError(f"duration must be a finite number [s], got {known}: give another duration")
    return known


def _weakly_float64(leaf: Any) -> Any:
    return np.float64(leaf) if isinstance(leaf, float) else leaf


# --- saved motions ---------------------------------------------------------------------------------------------------

# In one step a rod may turn, and the fast mode advance, by this much [rad]: beyond it neither method resolves the
# motion, whatever the energy says.
_LARGEST_TURN = 1.0
# Steps of a motion, if nobody asks for more: half a minute at order 8 with the second pass and all states saved, and
# half a gigabyte.
MOST_STEPS = 2_000_000
# The same of `reference`, whose steps take 20 microseconds: half a minute.
_MOST_ADAPTIVE_STEPS = 1_000_000
# An error of this many radians is no small error: the computed motion has parted from the true one.
_PARTED = 0.1


def _fastest(pendulum: Pendulum, state: State) -> Scalar:
    """The largest angular velocity in the motion [rad/s] at this state."""
    rates = vector_field(pendulum, state)
    return jnp.maximum(jnp.abs(rates.theta1), jnp.abs(rates.theta2))


def _saved(pendulum, state, dt, steps, scheme, save_every, room):  # type: ignore[no-untyped-def]
    """Times and states at steps 0, save_every, 2 save_every, ..., steps, and the largest rate met on the way.

    Counts that are ints make a scan, which has both derivatives. Traced ones fill a table of `room` rows, those left
    over repeating the last, so that one program serves all counts.
    """
    constants = scheme.constants(pendulum, dt)

    def step(carry, time, dt):  # type: ignore[no-untyped-def]
        point = scheme.move(constants, carry[0])
        return point, jnp.fmax(carry[1], _fastest(pendulum, scheme.leave(constants, point)))

    def segment(carry, index, count):  # type: ignore[no-untyped-def]
        carry = march(step, carry, dt, count, index)
        # One row to save, not four: XLA would copy four arrays whole at every save.
        return carry, jnp.stack(jax.tree.leaves(scheme.leave(constants, carry[0])))

    first = jnp.stack(jax.tree.leaves(state))
    carry = (scheme.enter(pendulum, state), _fastest(pendulum, state))
    if room is not None:
        index = jnp.arange(room)
        last = -(-steps // save_every)

        def save(i, carried):  # type: ignore[no-untyped-def]
            carry, rows = carried
            carry, row = segment(carry, (i - 1) * save_every, jnp.minimum(save_every, steps - (i - 1) * save_every))
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


def _simulated(pendulum, state, duration, steps, scheme, save_every, room, estimate, wanted, drift_tolerance):  # type: ignore[no-untyped-def]
    dt = step_size(duration, steps)
    state, turns = _without_turns(state)
    time, states, rate = _saved(pendulum, state, dt, steps, scheme, save_every, room)
    drift = _drift(pendulum, states)
    if estimate is None:
        _, finer, _ = _saved(pendulum, _a_rounding_away(state), dt / 2, 2 * steps, scheme, 2 * save_every, room)
        estimate = _angle_error(states, finer) / (1 - 2.0**-scheme.order) + _last_place(turns)
    states = _with_turns(states, turns)
    finite = jax.tree.reduce(lambda ok, leaf: ok & jnp.all(jnp.isfinite(leaf)), states, jnp.asarray(True))
    status = jnp.where(estimate > wanted, Status.BEYOND_HORIZON, Status.CONVERGED)
    status = jnp.where(drift > drift_tolerance, Status.DRIFT_ABOVE_TOLERANCE, status)
    status = jnp.where(finite, status, Status.NONFINITE)
    turn = jnp.maximum(rate, fast_frequency(pendulum)) * jnp.abs(dt)
    status = jnp.where(turn > _LARGEST_TURN, Status.STEP_TOO_LARGE, status)
    return Trajectory(time, states, drift, estimate, jnp.asarray(steps), status, scheme)


_simulate = jax.jit(_simulated, static_argnames=("steps", "scheme", "save_every", "room"))
_simulate_traced = jax.jit(_simulated, static_argnames=("scheme", "room"))


# Rounding errors of a whole motion are some 30 units in the last place of its start, magnified as such a displacement
# is, but in one of ten cases more than 100 to 300 (order 8, releases from the whole square, 2 to 10 s). With 64 units
# here 97 in 100 of the motions of 5 s passed as right to 1e-9 rad were, with 256 units 99.
_ROUNDING = 256 * float(np.finfo(float).eps)


def _a_rounding_away(state: State) -> State:
    """Where the second pass starts: two passes from one state may round alike, and then tell less than their error."""
    away = [_ROUNDING * jnp.maximum(1.0, jnp.abs(angle)) for angle in (state.theta1, state.theta2)]
    return State(state.theta1 + away[0], state.theta2 - 0.7 * away[1], state.p1, state.p2)


def _last_place(turns: _Turns) -> Scalar:
    """What an angle far from zero is rounded by when its turns are added [rad]."""
    return 0.5 * float(np.finfo(float).eps) * jnp.maximum(jnp.abs(turns.theta1[0]), jnp.abs(turns.theta2[0]))


def _drift(pendulum: Pendulum, states: State) -> Scalar:
    """The largest |H - H(0)| along saved states, in units of the energy scale."""
    energy = hamiltonian(pendulum, states)
    start = jax.tree.map(lambda leaf: leaf[0], states)
    return jnp.max(jnp.abs(energy - energy[0])) / energy_scale(pendulum, start)


def _angle_error(a: State, b: State) -> Scalar:
    """The larger difference of the two angles [rad], at the worst of the saved times."""
    return jnp.max(jnp.maximum(jnp.abs(a.theta1 - b.theta1), jnp.abs(a.theta2 - b.theta2)))


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
    most_steps: int | Any = MOST_STEPS,
) -> Trajectory:
    """The motion from `state` over `duration`, with an estimate of its own error.

    The estimate is Richardson's, |x_h - x_(h/2)|/(1 - 2^-p): of the returned solution, at the worst saved time, in the
    larger angle. The second pass starts 6e-14 rad away, so that the estimate holds what the motion makes of rounding
    errors, too: of motions that it says are right to a tolerance, 99 in 100 are, wherever on the square of releases.

    Arguments:
        pendulum, state: leaves are scalars.
        duration: time [s]; negative runs backwards.
        step: largest step [s]. Without it the step is chosen for `tolerance`.
        method: any with even steps. The default is `rk8` for a step, which needs ten times fewer evaluations than `rk4`
            at an error of 1e-9, and `rk8-circle` for a tolerance: no other is faster at any error below 1e-3.
        tolerance: wanted error of the angles [rad] at the worst time; 1e-9 if neither it nor a step is given. The
            estimate is brought below 0.8 of it. If no step does that, because the motion is chaotic and too long, the
            status is `BEYOND_HORIZON`.
        save_every: every how many steps a state is saved; the last state always is.
        error: make the second pass at half the step. Without it `error_estimate` is NaN, at a third of the time. For a
            tolerance the search has made it: the estimate is the worst at any step, saved or not.
        drift_tolerance: largest energy drift, in units of the energy scale, that passes. By default 1e-6 for a step,
            far above what a method loses at a sensible one; for a tolerance any, the error itself being known.
        most_steps: how many steps are taken at most. A step that makes more is refused; for a tolerance no shorter one
            is tried then.
    Returns:
        Trajectory.
    Raises:
        ValueError: duration zero or not finite, both step and tolerance given, no step where the state or the pendulum
            is traced, a step not positive or longer than the motion, an unknown method, save_every below 1, more
            steps than `most_steps`.
        RuntimeError: float64 is switched off in JAX.
    """
    require_float64()
    check_motion(pendulum, state)
    known = _known_duration(duration)
    if known is None or known == 0.0:
        raise ValueError(
            f"duration must be a finite number [s] other than zero, known before tracing, got {shown(duration)}: "
            "give another duration"
        )
    at_most_one(step=step, tolerance=tolerance)
    save_every, error = integer("save_every", save_every), flag("error", error)
    most_steps = integer("most_steps", most_steps)
    method = ("rk8-circle" if step is None else "rk8") if method is None else one_of("method", method, tuple(METHODS))
    if drift_tolerance is None:
        drift_tolerance = math.inf if step is None else 1e-6
    else:
        drift_tolerance = number("drift_tolerance", drift_tolerance, positive=True)
        single("drift_tolerance", drift_tolerance)
    if not Scheme(method, 1.0).even:
        raise ValueError(f"method must take even steps to save states at, got {method!r}: give rk8-circle, or use flow")
    state = _float64(state)
    wanted = np.float64(_PARTED)
    estimate: float | None  # None is made by the second pass
    if step is None:
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((pendulum, state))):
            raise ValueError("tolerance needs a state and a pendulum that are known, got traced ones: give a step")
        tolerance = known_number("tolerance", 1e-9 if tolerance is None else tolerance, positive=True, unit="rad")
        wanted = np.float64(_MARGIN * tolerance)
        scheme, estimate = _scheme_reaching(pendulum, state, known, method, wanted, most_steps)
    else:
        scheme, estimate = Scheme(method, step), None if error else math.nan
    steps = scheme.steps(known)
    if steps > most_steps:
        raise ValueError(
            f"step must make at most {most_steps:,} steps, got {scheme.step:g} s, which makes {steps:,}: "
            "give a larger step, a shorter duration, or more most_steps"
        )
    every = min(save_every, steps)
    time = jnp.asarray(duration, jnp.float64)
    if step is not None:
        return _simulate(pendulum, state, time, steps, scheme, every, None, estimate, wanted, drift_tolerance)
    # The number of steps being this motion's own, a program that were compiled for it would be used once.
    rows = 1 + -(-steps // every)
    room = max(_LEAST_ROOM, 1 << (rows - 1).bit_length())
    counts = jnp.asarray(steps), jnp.asarray(every)
    motion = _simulate_traced(
        pendulum, state, time, counts[0], _any_step(scheme), counts[1], room, estimate, wanted, drift_tolerance
    )
    time, states = jax.tree.map(lambda rows_: jnp.asarray(np.asarray(rows_)[:rows]), (motion.time, motion.state))
    return replace(motion, time=time, state=states, scheme=scheme)


# Rows of the smallest table that a motion of unknown length is saved in; larger ones double.
_LEAST_ROOM = 1024
# The share of a tolerance that an estimate may reach: it may itself be off by a tenth.
_MARGIN = 0.8
# The first step that is tried when one is sought [rad of the fastest motion at the start].
_FIRST_TURN = 0.5
# Below (rate dt)^p of this the truncation of a step is lost in rounding: a smaller step only adds to that.
_ONLY_ROUNDING = 1e-18


def _scheme_reaching(
    pendulum: Pendulum, state: State, duration: float, method: str, tolerance: float, most_steps: int
) -> tuple[Scheme, float]:
    """The method with a step at which the error of this motion is below `tolerance`, or as small as rounding or
    `most_steps` allow, and that error.
    """
    rate = float(_fastest_of_all(pendulum, state))
    if not math.isfinite(rate):
        return Scheme(method, abs(duration)), math.nan  # whatever the step, the status will say so
    steps = max(1, math.ceil(abs(duration) * rate / _FIRST_TURN))
    if steps > most_steps:
        raise ValueError(
            f"duration must be at most some {_FIRST_TURN * most_steps / rate:.1e} s for a tolerance, got {duration:g}, "
            f"which takes {steps:.3g} steps or more: give a shorter one, a step, or more most_steps"
        )
    while True:
        scheme = Scheme(method, abs(duration) / steps)
        error = float(_error_of(pendulum, state, step_size(duration, steps), jnp.asarray(steps), _any_step(scheme)))
        if error <= tolerance or (rate * scheme.step) ** scheme.order < _ONLY_ROUNDING:
            return scheme, error
        missing = (2 * error / tolerance) ** (1 / scheme.order) if math.isfinite(error) else 4.0
        steps = math.ceil(steps * min(max(missing, 1.2), 4.0))
        if steps > most_steps:
            return scheme, error


@jax.jit
def _fastest_of_all(pendulum: Pendulum, state: State) -> Scalar:
    """What a step has to resolve at the start [rad/s]."""
    return jnp.maximum(fast_frequency(pendulum), _fastest(pendulum, state))


def _any_step(scheme: Scheme) -> Scheme:
    """The key of programs in which the step is traced: one for all steps."""
    return replace(scheme, step=1.0)


@partial(jax.jit, static_argnames="scheme")
def _error_of(pendulum, state, dt, steps, scheme):  # type: ignore[no-untyped-def]
    """Richardson's estimate for `steps` steps of `dt`, both traced: two motions side by side, no state saved."""

    whole, half = scheme.constants(pendulum, dt), scheme.constants(pendulum, dt / 2)

    def step(carry, time, dt):  # type: ignore[no-untyped-def]
        coarse, fine, worst = carry
        coarse = scheme.move(whole, coarse)
        fine = scheme.move(half, scheme.move(half, fine))
        states = scheme.leave(whole, coarse), scheme.leave(half, fine)
        return coarse, fine, jnp.fmax(worst, _angle_error(*states))

    state, turns = _without_turns(state)
    start, near = (scheme.enter(pendulum, x) for x in (state, _a_rounding_away(state)))
    end, _, worst = march(step, (start, near, jnp.asarray(0.0)), dt, steps)
    end = scheme.leave(whole, end)
    lost = ~jnp.isfinite(end.theta1 + end.theta2 + end.p1 + end.p2)
    return jnp.where(lost, jnp.inf, worst / (1 - 2.0**-scheme.order) + _last_place(turns))


# --- an independent integrator ---------------------------------------------------------------------------------------


def reference(
    pendulum: Pendulum | Any,
    state: State | Any,
    times: ArrayLike | Sequence[float] | Any,
    *,
    tolerance: float | Any = 1e-13,
    error: bool | Any = True,
    most_steps: int | Any = _MOST_ADAPTIVE_STEPS,
) -> Trajectory:
    """The motion at `times` by diffrax's Dopri8 with adaptive steps: independent of this package's integrators.

    It takes as many steps as it needs, up to `most_steps`. The error estimate is the change when the tolerance is ten
    times larger.

    Arguments:
        pendulum, state: leaves are scalars; `state` holds at t = 0.
        times: increasing from zero or more, or decreasing from zero or less [s], shape (n,).
        tolerance: relative and absolute, of angles [rad] and of momenta in units of the motion's own inertia and rate;
            1e-13 is the least that rounding leaves room for.
        error: make the second solution. Without it `error_estimate` is NaN.
        most_steps: how many steps are taken at most; each number has a program of its own.
    Returns:
        Trajectory, its `steps` those of the better solution; status `MAX_ITERATIONS` where that would be more than
            `most_steps`, `NONFINITE` where diffrax gave up otherwise.
    Raises:
        ValueError: times empty, not finite, not monotonic or on both sides of zero; tolerance below 1e-13.
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
            f"tolerance must be at least {_LEAST_TOLERANCE:g}, which rounding leaves room for, got {known:g}: "
            "give a larger tolerance"
        )
    grid = np.atleast_1d(numbers("times", times, unit="s"))
    if grid.ndim != 1:
        raise ValueError(f"times must have one dimension, got shape {grid.shape}: give one number for each time")
    moves = np.diff(grid, prepend=0.0)
    ordered = (
        np.all(moves[1:] > 0) and grid[0] >= 0
        if grid.size and grid[-1] > 0
        else np.all(moves[1:] < 0) and grid.size and grid[0] <= 0
    )
    if not grid.size or not np.all(np.isfinite(grid)) or not ordered:
        raise ValueError(f"times must be finite and move away from zero in one direction, got {shown(grid)}: sort them")
    state = _float64(state)
    states, steps, done = _dopri8(pendulum, state, jnp.asarray(grid), tolerance, most_steps)
    estimate = jnp.asarray(jnp.nan)
    if error:
        estimate = _angle_error(states, _dopri8(pendulum, state, jnp.asarray(grid), 10 * tolerance, most_steps)[0])
    with_start = jax.tree.map(lambda x, xs: jnp.concatenate([x[None], xs]), state, states)
    lost = jnp.where(steps < most_steps, Status.NONFINITE, Status.MAX_ITERATIONS)
    status = jnp.where(done, Status.CONVERGED, lost)
    return Trajectory(jnp.asarray(grid), states, _drift(pendulum, with_start), estimate, steps, status)


# Below this the rounding of a step is more than the error that its size is chosen by: all are taken back for ever.
_LEAST_TOLERANCE = 1e-13


@partial(jax.jit, static_argnames="most_steps")
def _dopri8(pendulum, state, times, tolerance, most_steps):  # type: ignore[no-untyped-def]
    """States at `times`, steps taken, and whether diffrax succeeded."""
    import diffrax

    rate = jnp.fmax(fast_frequency(pendulum), _fastest(pendulum, state))
    unit = State(1.0, 1.0, (pendulum.m1 + pendulum.m2) * pendulum.l1**2 * rate, pendulum.m2 * pendulum.l2**2 * rate)

    def slope(time, scaled, pendulum):  # type: ignore[no-untyped-def]
        here = jax.tree.map(jnp.multiply, scaled, unit)
        slopes = jax.tree.map(jnp.divide, vector_field(pendulum, here), unit)
        # A slope that is not a number would have its step retried for ever: stand still there, and say so at the end.
        return jax.tree.map(lambda leaf: jnp.where(_in_reach(here), leaf, 0.0), slopes)

    sound = _in_reach(state)
    start = jax.tree.map(lambda leaf: jnp.where(sound, leaf, 0.0), state)

    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(slope),
        diffrax.Dopri8(),
        t0=0.0,
        t1=times[-1],
        dt0=None,
        y0=jax.tree.map(jnp.divide, start, unit),
        args=pendulum,
        saveat=diffrax.SaveAt(ts=times),
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance, dtmin=1e-12 / rate),
        max_steps=most_steps,
        throw=False,
    )
    states = jax.tree.map(jnp.multiply, solution.ys, unit)
    sound &= jnp.all(_in_reach(states))
    states = jax.tree.map(lambda leaf: jnp.where(sound, leaf, jnp.nan), states)
    return states, solution.stats["num_steps"], sound & (solution.result == diffrax.RESULTS.successful)


def _in_reach(state: State) -> Scalar:
    """Whether the vector field can be computed here: finite, and angles that sine and cosine can reduce."""
    angles = jnp.maximum(jnp.abs(state.theta1), jnp.abs(state.theta2))
    return (angles <= LARGEST_ANGLE) & jnp.isfinite(state.p1) & jnp.isfinite(state.p2)
