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
    TOLERANCE_NOT_REACHED = 13
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
    Status.BEYOND_HORIZON: "The motion is chaotic, and errors of rounding have grown above the error that was asked "
    "for, or above 0.1 rad; shorten it, or ask for less.",
    Status.TOLERANCE_NOT_REACHED: "The error estimate is above the error that was asked for, or above 0.1 rad, though "
    "errors of rounding alone have not grown so far; ask for less, or use a smaller step while that still helps.",
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
        error_estimate: of the larger angle, at the worst step [rad]; NaN where no second pass was made. For
            `reference` at the worst of its times.
        steps: the number of steps taken.
        status: a value of `Status`.
        scheme: method and step; None for `reference`, which chooses its steps as it goes.
        tolerance: the error that was asked for [rad]; NaN where a step was given.
    """

    time: Scalar
    state: State
    energy_drift: Scalar
    error_estimate: Scalar
    steps: Scalar
    status: Scalar
    scheme: Scheme | None = field(default=None, metadata={"static": True})
    tolerance: Scalar = math.nan

    @property
    def message(self) -> str:
        """The sentence that says how this motion went, with its error estimate and the one asked for."""
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
        why = why or ("the step is too large" if math.isnan(tolerance) else "no step that was tried brings it lower")
        mend = " or ".join(mends or ["shorten it"])
        return f"The error estimate, {estimate:.1e} rad, is above {wish}: {why}; {mend}."

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


class _Comparison(NamedTuple):
    """What a second pass tells of a motion, at the worst step."""

    estimate: Scalar  # of the error of the larger angle [rad]
    floor: Scalar  # what one rounding of the start has grown to [rad]
    rate: Scalar  # the fastest [rad/s]
    drift: Scalar  # of the energy, in units of its scale
    end: State  # the motion's own last state, its turns taken off


def _simulated(pendulum, state, duration, steps, scheme, save_every, room, compared, tolerance, drift_tolerance):  # type: ignore[no-untyped-def]
    dt = step_size(duration, steps)
    reduced, turns = _without_turns(state)
    time, states, rate = _saved(pendulum, reduced, dt, steps, scheme, save_every, room)
    drift = _drift(pendulum, states)
    if compared is None:
        compared = _compared(*lax.stop_gradient((pendulum, state, dt)), steps, scheme)
    end = jax.tree.map(lambda leaf: leaf[-1], states)
    # Two programs may round otherwise; what that makes is an error, too.
    estimate = compared.estimate + _angle_error(end, compared.end)
    states = _with_turns(states, turns)
    finite = jax.tree.reduce(lambda ok, leaf: ok & jnp.all(jnp.isfinite(leaf)), states, jnp.asarray(True))
    wanted = jnp.where(jnp.isnan(tolerance), _PARTED, tolerance)
    growth = compared.floor / _EPS
    regular = _SHEAR * (1.0 + fast_frequency(pendulum) * jnp.abs(duration))
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


_EPS = float(np.finfo(float).eps)
# Errors of so many roundings of the start may be those of rounding, of more they are not. Those are of some 30, but in
# one of ten cases of more than 100 to 300 (order 8, releases from the whole square, 2 to 10 s).
_NEAR_ROUNDING = 1e4
# Tangents go along a motion of this method, the only one that carries them at little more than its own cost.
_GUIDE = "rk8-circle"
# Estimates of so many roundings of the start may be of rounding alone.
_SEEN = 64.0
# So many passes, started such roundings apart, tell rounding errors within a factor of two (99 in 100, rods whose
# lengths and masses differ by up to a thousand).
_PASSES = 4
_AWAY = np.random.default_rng(1).choice([-1.0, 1.0], (_PASSES, 8)) * (np.arange(_PASSES) > 0)[:, None]
# Errors of regular motions grow in proportion to time: at most by this much in 1/(fast mode's frequency).
_SHEAR = 10.0


def _compared(pendulum, state, dt, steps, scheme):  # type: ignore[no-untyped-def]
    """What second passes tell of a motion: one pass, or `_PASSES` of them where rounding may be what they see.

    Two sums of rounding errors may end close to each other by chance, far from the truth both; as many will not.
    """

    def goes(carried):  # type: ignore[no-untyped-def]
        count, seen = carried
        return (count < 1) | ((count < _PASSES) & (seen.estimate < _SEEN * seen.floor))

    def again(carried):  # type: ignore[no-untyped-def]
        count, before = carried
        seen = _one_comparison(pendulum, state, dt, steps, scheme, jnp.asarray(_AWAY)[count])
        return count + 1, seen._replace(estimate=jnp.maximum(before.estimate, seen.estimate))

    return lax.while_loop(goes, again, (0, _comparison_of(0.0)))[1]


def _comparison_of(value: float) -> _Comparison:
    """One number everywhere: zero before a comparison, NaN without."""
    numbers = (jnp.asarray(value),) * 4
    return _Comparison(*numbers, State(*numbers))


def _one_comparison(pendulum, state, dt, steps, scheme, away):  # type: ignore[no-untyped-def]
    """A motion beside one of half the step whose sums are compensated, and what its start's rounding grows to.

    The two passes differ by the truncation error (Richardson's estimate) and by the rounding errors of the first, those
    of the second being less. Rounding that both share, as that of the start, is seen by neither: hence the floor, from
    two tangents along the first.

    Arguments:
        away: where the second pass starts, in roundings of each number of the point.
    """
    whole, half = scheme.constants(pendulum, dt), scheme.constants(pendulum, dt / 2)
    guide = Scheme(_GUIDE, 1.0)
    known = guide.constants(pendulum, dt)
    state, turns = _without_turns(state)
    start, energy = scheme.enter(pendulum, state), hamiltonian(pendulum, state)

    def step(carry, time, dt):  # type: ignore[no-untyped-def]
        coarse, along, fine, rest, (worst, growth, rate, drift) = carry
        if scheme.name == _GUIDE:
            coarse, tangents = scheme.move_tangents(whole, coarse, along)
            along = tangents
        else:
            coarse, along = scheme.move(whole, coarse), guide.move_tangents(known, *along)
            tangents = along[1]
        fine, rest = lax.fori_loop(0, 2, lambda i, pair: scheme.move_compensated(half, *pair), (fine, rest))
        here = scheme.leave(whole, coarse)
        difference = _angle_error(here, scheme.leave(half, fine))
        seen = difference, _growth(tangents), _fastest(pendulum, here), jnp.abs(hamiltonian(pendulum, here) - energy)
        return coarse, along, fine, rest, tuple(map(jnp.fmax, (worst, growth, rate, drift), seen))

    leaves, tree = jax.tree.flatten(start)
    rest = jax.tree.unflatten(tree, [_EPS * away[i] * leaf for i, leaf in enumerate(leaves)])
    along = _roundings(state)
    along = along if scheme.name == _GUIDE else (guide.enter(pendulum, state), along)
    carry = start, along, start, rest, (jnp.zeros_like(energy),) * 4
    coarse, _, _, _, (worst, growth, rate, drift) = march(step, carry, dt, steps)
    end = scheme.leave(whole, coarse)
    # A tangent grows for ever, an error to half a turn.
    floor = jnp.fmin(_EPS * growth, jnp.pi)
    lost = ~jnp.isfinite(end.theta1 + end.theta2 + end.p1 + end.p2)
    estimate = jnp.hypot(worst / (1 - 2.0**-scheme.order), floor) + _last_place(turns)
    drift = drift / energy_scale(pendulum, state)
    return _Comparison(jnp.where(lost, jnp.inf, estimate), floor, rate, drift, end)


def _roundings(state: State) -> State:
    """Two tangents, each an angle's size and its momentum's: times `_EPS` the roundings of a start."""
    first, second = jnp.eye(2)
    sizes = jnp.maximum(1.0, jnp.abs(state.theta1)), jnp.maximum(1.0, jnp.abs(state.theta2))
    return State(sizes[0] * first, sizes[1] * second, state.p1 * first, state.p2 * second)


_compare = jax.jit(_compared, static_argnames="scheme")


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

    The estimate is Richardson's, |x_h - x_(h/2)|/(1 - 2^-p): of the returned solution, at the worst step, in the larger
    angle. The second pass keeps the rounding errors of its sums, so that the difference is the rounding error of the
    first, too. Where there may be nothing else in it, more such passes are made, each from a start some roundings away,
    and the largest difference counts. The estimate is never less than one rounding of the start, 2.2e-16, times what a
    displacement of the angles grows to. `Trajectory.message` tells the estimate beside the error that was asked for.

    Arguments:
        pendulum, state: leaves are scalars.
        duration: time [s]; negative runs backwards.
        step: largest step [s]. Without it the step is chosen for `tolerance`.
        method: any with even steps. The default is `rk8` for a step, which needs ten times fewer evaluations than `rk4`
            at an error of 1e-9, and `rk8-circle` for a tolerance: no other is faster at any error below 1e-3.
        tolerance: wanted error of the angles [rad] at the worst time; 1e-9 if neither it nor a step is given. The
            search for a step aims at 0.8 of it. If no step brings the estimate below the tolerance, the status is
            `BEYOND_HORIZON` where the motion is chaotic and errors of rounding have grown so far, and
            `TOLERANCE_NOT_REACHED` where it is not. For a step the same is said of estimates above 0.1 rad.
        save_every: every how many steps a state is saved; the last state always is.
        error: make the second pass at half the step. Without it `error_estimate` is NaN, at a third of the time. For a
            tolerance the search has made it.
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
    traced = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((pendulum, state)))
    compared = None  # is made beside the motion
    if step is None:
        if traced:
            raise ValueError("tolerance needs a state and a pendulum that are known, got traced ones: give a step")
        tolerance = known_number("tolerance", _TOLERANCE if tolerance is None else tolerance, positive=True, unit="rad")
        scheme, compared = _scheme_reaching(pendulum, state, known, method, tolerance, most_steps)
    else:
        tolerance, scheme = math.nan, Scheme(method, step)
        compared = None if error else _comparison_of(math.nan)
    steps = scheme.steps(known)
    if steps > most_steps:
        raise ValueError(
            f"step must make at most {most_steps:,} steps, got {scheme.step:g} s, which makes {steps:,}: "
            "give a larger step, a shorter duration, or more most_steps"
        )
    every = min(save_every, steps)
    time = jnp.asarray(duration, jnp.float64)
    if compared is None and not traced:  # by the one program for all numbers of steps
        compared = _compare(pendulum, state, step_size(known, steps), jnp.asarray(steps), _any_step(scheme))
    if step is not None:
        return _simulate(pendulum, state, time, steps, scheme, every, None, compared, tolerance, drift_tolerance)
    # The number of steps being this motion's own, a program that were compiled for it would be used once.
    rows = 1 + -(-steps // every)
    room = max(_LEAST_ROOM, 1 << (rows - 1).bit_length())
    counts = jnp.asarray(steps), jnp.asarray(every)
    motion = _simulate_traced(
        pendulum, state, time, counts[0], _any_step(scheme), counts[1], room, compared, tolerance, drift_tolerance
    )
    time, states = jax.tree.map(lambda rows_: jnp.asarray(np.asarray(rows_)[:rows]), (motion.time, motion.state))
    return replace(motion, time=time, state=states, scheme=scheme)


# Rows of the smallest table that a motion of unknown length is saved in; larger ones double.
_LEAST_ROOM = 1024
# The error that is asked for by default [rad].
_TOLERANCE = 1e-9
# The share of a tolerance that the search for a step aims at: an estimate may itself be off by a tenth.
_MARGIN = 0.8
# The first step that is tried when one is sought [rad of the fastest motion at the start].
_FIRST_TURN = 0.5
# Below (rate dt)^p of this the truncation of a step is lost in rounding: a smaller step only adds to that.
_ONLY_ROUNDING = 1e-18
# A motion that keeps its energy this well, in units of its scale, has steps that resolve it.
_RESOLVED = 1e-10
# What a rounding grows to is believed where two steps tell it within this factor.
_ALIKE = 10.0


def _scheme_reaching(
    pendulum: Pendulum, state: State, duration: float, method: str, tolerance: float, most_steps: int
) -> tuple[Scheme, _Comparison]:
    """The method with a step at which the error of this motion is below `tolerance`, or as small as rounding or
    `most_steps` allow, and what a second pass told of it.
    """
    rate = float(_fastest_of_all(pendulum, state))
    if not math.isfinite(rate):
        rate = 0.0  # whatever the step, the status will say so
    steps = max(1, math.ceil(abs(duration) * rate / _FIRST_TURN))
    if steps > most_steps:
        raise ValueError(
            f"duration must be at most some {_FIRST_TURN * most_steps / rate:.1e} s for a tolerance, got {duration:g}, "
            f"which takes {steps:.3g} steps or more: give a shorter one, a step, or more most_steps"
        )
    best, last, last_floor, fall, order = None, math.inf, math.inf, 1.0, Scheme(method, 1.0).order
    while True:
        scheme = Scheme(method, abs(duration) / steps)
        dt, count = step_size(duration, steps), jnp.asarray(steps)
        compared = _compare(pendulum, state, dt, count, _any_step(scheme))
        error, floor, fastest, drift = (float(value) for value in compared[:4])
        turn = scheme.step * np.fmax(rate, fastest)
        if turn <= _LARGEST_TURN and not (best and best[0] < error):
            best = error, scheme, compared
        near = error < _PARTED  # to the true motion all along, or else at least to its energy
        alike = last_floor / _ALIKE < floor < _ALIKE * last_floor  # too long a step makes growth of its own
        lost = alike and floor > tolerance and (near or drift < _RESOLVED)
        steady = alike and near and error < _NEAR_ROUNDING * floor and error > last * fall
        found = turn <= _LARGEST_TURN and (error <= _MARGIN * tolerance or lost or steady)
        missing = (2 * error / tolerance) ** (1 / order) if math.isfinite(error) else 4.0
        more = min(max(missing, turn, 1.2), 4.0)
        steps, last, last_floor, fall = math.ceil(steps * more), error, floor, more ** (-order / 2)
        if found or turn < _ONLY_ROUNDING ** (1 / order) or steps > most_steps:
            return (best or (error, scheme, compared))[1:]


@jax.jit
def _fastest_of_all(pendulum: Pendulum, state: State) -> Scalar:
    """What a step has to resolve at the start [rad/s]."""
    return jnp.maximum(fast_frequency(pendulum), _fastest(pendulum, state))


def _any_step(scheme: Scheme) -> Scheme:
    """The key of programs in which the step is traced: one for all steps."""
    return replace(scheme, step=1.0)


# --- an independent integrator ---------------------------------------------------------------------------------------


# The change at ten times the tolerance is some eight times the error, but in two of a hundred random motions less, at
# the worst 0.41 of it (tolerances 1e-7 to 1e-13, against long double).
_CHANGES = 2.5


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

    It takes as many steps as it needs, up to `most_steps`. The error estimate is 2.5 times the change when the
    tolerance is ten times larger, and what one rounding of the start grows to.

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
    roundings = _roundings(state) if error else None
    states, growth, steps, done = _dopri8(pendulum, state, roundings, jnp.asarray(grid), tolerance, most_steps)
    estimate = jnp.asarray(jnp.nan)
    if error:
        coarse = _dopri8(pendulum, state, roundings, jnp.asarray(grid), 10 * tolerance, most_steps)[0]
        estimate = _CHANGES * _angle_error(states, coarse) + jnp.fmin(_EPS * growth, jnp.pi)
    with_start = jax.tree.map(lambda x, xs: jnp.concatenate([x[None], xs]), state, states)
    lost = jnp.where(steps < most_steps, Status.NONFINITE, Status.MAX_ITERATIONS)
    status = jnp.where(done, Status.CONVERGED, lost)
    return Trajectory(jnp.asarray(grid), states, _drift(pendulum, with_start), estimate, steps, status)


# Below this the rounding of a step is more than the error that its size is chosen by: all are taken back for ever.
_LEAST_TOLERANCE = 1e-13


@partial(jax.jit, static_argnames="most_steps")
def _dopri8(pendulum, state, tangents, times, tolerance, most_steps):  # type: ignore[no-untyped-def]
    """States at `times`, what tangents of the angles grow to, steps taken, and whether diffrax succeeded."""
    import diffrax

    rate = jnp.fmax(fast_frequency(pendulum), _fastest(pendulum, state))
    unit = State(1.0, 1.0, (pendulum.m1 + pendulum.m2) * pendulum.l1**2 * rate, pendulum.m2 * pendulum.l2**2 * rate)

    def field(scaled: State) -> State:
        here = jax.tree.map(jnp.multiply, scaled, unit)
        slopes = jax.tree.map(jnp.divide, vector_field(pendulum, here), unit)
        # A slope that is not a number would have its step retried for ever: stand still there, and say so at the end.
        return jax.tree.map(lambda leaf: jnp.where(_in_reach(here), leaf, 0.0), slopes)

    def slope(time, pair, nothing):  # type: ignore[no-untyped-def]
        scaled, tangents = pair
        slopes, push = jax.linearize(field, scaled)
        return slopes, None if tangents is None else jax.vmap(push)(tangents)

    sound = _in_reach(state)
    start = jax.tree.map(lambda leaf: jnp.where(sound, leaf, 0.0), state)
    tangents = jax.tree.map(lambda leaf: jnp.where(sound, leaf, 0.0), tangents)
    if tangents is not None:
        tangents = jax.tree.map(lambda leaf, one: leaf / one, tangents, unit)

    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(slope),
        diffrax.Dopri8(),
        t0=0.0,
        t1=times[-1],
        dt0=None,
        y0=(jax.tree.map(jnp.divide, start, unit), tangents),
        saveat=diffrax.SaveAt(ts=times),
        stepsize_controller=diffrax.PIDController(
            rtol=tolerance, atol=tolerance, dtmin=1e-12 / rate, norm=_of_the_state
        ),
        max_steps=most_steps,
        throw=False,
    )
    scaled, tangents = solution.ys
    states = jax.tree.map(jnp.multiply, scaled, unit)
    sound &= jnp.all(_in_reach(states))
    states = jax.tree.map(lambda leaf: jnp.where(sound, leaf, jnp.nan), states)
    return (
        states,
        _growth(tangents),
        solution.stats["num_steps"],
        sound & (solution.result == diffrax.RESULTS.successful),
    )


def _of_the_state(pair: tuple[State, State | None]) -> Scalar:
    """The root mean square of the first, so that tangents have no say in the steps."""
    leaves = jax.tree.leaves(pair[0])
    return jnp.sqrt(sum(jnp.square(leaf) for leaf in leaves) / len(leaves))


def _growth(tangents: State | None) -> Scalar:
    """What two tangents along the last axis grow to: of the larger angle, at the worst time; one with none."""
    if tangents is None:
        return jnp.asarray(1.0)
    sizes = jnp.maximum(jnp.linalg.norm(tangents.theta1, axis=-1), jnp.linalg.norm(tangents.theta2, axis=-1))
    return jnp.max(sizes)


def _in_reach(state: State) -> Scalar:
    """Whether the vector field can be computed here: finite, and angles that sine and cosine can reduce."""
    angles = jnp.maximum(jnp.abs(state.theta1), jnp.abs(state.theta2))
    return (angles <= LARGEST_ANGLE) & jnp.isfinite(state.p1) & jnp.isfinite(state.p2)
