"""The loop over steps: the end of a motion (`flow`), and anything accumulated along it (`fold`)."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap

from dpend._runtime import require_float64
from dpend.checks import Scalar, arrays, function, known_value, number, single
from dpend.mechanics.pendulum import Pendulum, State, check_motion, check_state
from dpend.mechanics.trig import unwound, wound
from dpend.methods.runge_kutta import Constants, Point
from dpend.methods.scheme import Scheme, check_scheme

Carry = TypeVar("Carry")

# Reverse mode keeps what every step computed, some 5 kB at order 8. Beyond this many steps it keeps
# the states between blocks of sqrt(n) steps only and computes each block again.
_CHECKPOINT_ABOVE = 1024
# A step of the rescaled method that is this much shorter than it may be belongs to a rod that turns
# ten thousand times as fast as any that gravity moves: the lane is given up as NaN, so that no
# other waits for it.
SHORTEST_STEP = 1e-5


def march(
    step: Callable[[Carry, Scalar, Scalar], Carry],
    carry: Carry,
    dt: Scalar,
    steps: Scalar,
    first: Scalar = 0,
) -> Carry:
    """The loop under everything that takes even steps: `steps` times carry = step(carry, time, dt).

    Arguments:
        step: told the time [s] at the end of its step.
        steps: an int compiles to a scan, which has both derivatives; a tracer to a loop with
            forward mode only.
        first: the number of the first step, from which the time is counted.
    """

    def run(carry: Carry, first: Scalar, count: Scalar) -> Carry:
        return lax.fori_loop(
            0, count, lambda i, c: step(c, jnp.asarray(first + i + 1, jnp.float64) * dt, dt), carry
        )

    if not isinstance(steps, int) or steps <= _CHECKPOINT_ABOVE:
        return run(carry, first, steps)
    block = math.isqrt(steps)
    blocks, rest = divmod(steps, block)
    again = jax.checkpoint(lambda c, i: run(c, first + i * block, block))
    carry, _ = lax.scan(lambda c, i: (again(c, i), None), carry, jnp.arange(blocks))
    return run(carry, first + blocks * block, rest) if rest else carry


def advance_state(
    scheme: Scheme, pendulum: Pendulum, state: State, dt: Scalar, steps: Scalar
) -> State:
    """The state after `steps` even steps of `dt` [s]: `flow` for counts that may be traced."""
    constants = scheme.constants(pendulum, dt)
    end = march(
        lambda point, time, dt: scheme.move(constants, point),
        scheme.enter(pendulum, state),
        dt,
        steps,
    )
    return scheme.leave(constants, end)


def step_size(duration: Scalar, steps: Scalar) -> Scalar:
    """duration/steps [s], for counts that may be traced."""
    return duration / jnp.asarray(steps, jnp.float64)


def float64(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.result_type(leaf, jnp.float64)), tree)


class Turns(NamedTuple):
    """The full turns of both angles, as `unwound` gives them."""

    theta1: tuple[Scalar, Scalar]
    theta2: tuple[Scalar, Scalar]


def without_turns(state: State) -> tuple[State, Turns]:
    """A state whose angles are near enough to zero to be rounded finely, and what they are
    without.
    """
    (theta1, turns1), (theta2, turns2) = unwound(state.theta1), unwound(state.theta2)
    return State(theta1, theta2, state.p1, state.p2), Turns(turns1, turns2)


def with_turns(state: State, turns: Turns) -> State:
    return State(
        wound(state.theta1, turns.theta1), wound(state.theta2, turns.theta2), state.p1, state.p2
    )


class _Along(NamedTuple):
    """What moves along a motion: the scheme's point, tangents (None without), and what `update`
    accumulates.
    """

    point: Point
    tangents: State | None
    carry: Any


def _accumulate(
    update: Callable[..., Any],
    start: tuple[State | None, Any],
    pendulum: Pendulum,
    state: State,
    duration: Scalar,
    steps: Scalar,
    scheme: Scheme,
) -> tuple[State, State | None, Any]:
    """The end of the motion, its tangents and what `update` makes of it; both begin at `start`."""
    state, turns = without_turns(state)
    along = _Along(scheme.enter(pendulum, state), *start)
    shown = partial(_show_step, update, turns, scheme)
    if scheme.even:
        dt = step_size(duration, steps if not isinstance(steps, int) else max(steps, 1))
        constants = scheme.constants(pendulum, dt)
        along = march(partial(shown, constants), along, dt, steps)
        end = scheme.leave(constants, along.point)
    else:
        end, along = _march_unevenly(shown, pendulum, state, along, duration, scheme)
    return with_turns(end, turns), along.tangents, along.carry


def _show_step(
    update: Callable[..., Any],
    turns: Turns,
    scheme: Scheme,
    constants: Constants,
    along: _Along,
    time: Scalar,
    dt: Scalar,
) -> _Along:
    """One step, shown to `update`."""
    if along.tangents is None:
        point = scheme.move(constants, along.point)
        state = with_turns(scheme.leave(constants, point), turns)
        return _Along(point, None, update(along.carry, time, dt, state))
    point, tangents = scheme.move_tangents(constants, along.point, along.tangents)
    state = with_turns(scheme.leave(constants, point), turns)
    carry, tangents = update(along.carry, time, dt, state, tangents)
    return _Along(point, tangents, carry)


def step_for(longest: Scalar, spin: Scalar, before: Scalar) -> Scalar:
    """The length [s] of the rescaled method's step from a point with u = `spin`.

    Between the step's start and its end u is not yet known: its ratio to the one `before`, a step
    ago, tells where it goes.
    """
    root = jnp.sqrt(jnp.maximum(spin * (spin / before), 1.0))
    return longest / (root * jnp.sqrt(jnp.sqrt(root)))


@custom_vmap
def _any_lane(going: Scalar) -> Scalar:
    """Whether any lane goes on: a loop's condition that under `vmap` is one for all lanes, so that
    JAX does not select every array of every step by it.
    """
    return going


@_any_lane.def_vmap
def _any_of_many(size: int, batched: list[bool], going: Scalar) -> tuple[Scalar, bool]:
    return jnp.any(going), False


def _march_unevenly(
    shown: Callable[[Constants, _Along, Scalar, Scalar], _Along],
    pendulum: Pendulum,
    state: State,
    along: _Along,
    duration: Scalar,
    scheme: Scheme,
) -> tuple[State, _Along]:
    """Steps in the scheme's own time, the last one cut to end at `duration`.

    A lane that has arrived takes steps of length zero, which leave its point as it is to the bit,
    until all have.
    """
    sense = jnp.where(duration < 0, -1.0, 1.0)
    longest = scheme.step * scheme.pace(pendulum, state)
    unit = scheme.constants(pendulum)

    def goes(time: Scalar) -> Scalar:
        return sense * (duration - time) > 0

    def advance(work: tuple[_Along, Scalar, Scalar]) -> tuple[_Along, Scalar, Scalar]:
        along, time, before = work
        spin = scheme.spin(unit, along.point)
        dt = step_for(longest, spin, before)
        lost = ~(dt >= SHORTEST_STEP * longest)  # also where it is not a number
        rest, live = duration - time, goes(time)
        last = dt >= sense * rest
        dt = jnp.where(lost, jnp.nan, jnp.where(last, rest, sense * dt))
        dt = jnp.where(live, dt, 0.0)
        time = jnp.where(last & ~lost, duration, time + dt)
        ahead = shown(scheme.with_step(unit, dt), along, time, dt)
        kept = jax.tree.map(partial(jnp.where, live), ahead[1:], along[1:])
        return _Along(ahead.point, *kept), time, spin

    time = jnp.zeros_like(state.theta1)
    # A duration that is not finite leaves nothing of the start.
    point = jax.tree.map(lambda leaf: jnp.where(jnp.isfinite(duration), leaf, jnp.nan), along.point)
    along = along._replace(point=point)
    start = along, time, scheme.spin(unit, along.point)
    along, _, _ = lax.while_loop(lambda work: _any_lane(goes(work[1])), advance, start)
    return scheme.leave(unit, along.point), along


# Numbers of steps that are known make a program each, which has both derivatives.
_fold = jax.jit(_accumulate, static_argnames=("update", "steps", "scheme"))
_fold_traced = jax.jit(_accumulate, static_argnames=("update", "scheme"))


def _nothing(carry: Any, time: Scalar, dt: Scalar, state: State) -> Any:
    """The `update` of a motion of which only the end is wanted."""
    return carry


def flow(
    pendulum: Pendulum | Any, state: State | Any, duration: Scalar, scheme: Scheme | Any
) -> State:
    """The state after `duration`, no trajectory stored.

    Even methods take n = ceil(duration/step - 1e-9) steps of duration/n each; the rescaled one
    takes steps in its own time, the last one cut to end there.

    Arguments:
        pendulum, state: leaves are scalars; `jax.vmap` maps over many.
        duration: time [s]; negative runs backwards, zero returns the state. A number known at trace
            time, or a value being differentiated by eager `grad`, fixes n and allows reverse mode
            (checkpointed beyond 1024 steps); a traced one allows forward mode only, as does the
            rescaled method.
        scheme: method and step.
    Raises:
        ValueError: duration not finite, or shorter than one even step; arguments of other classes,
            arrays.
        RuntimeError: float64 is switched off in JAX.
    """
    return _run(_nothing, (None, None), pendulum, state, duration, scheme)[0]


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
        update: (carry, time, dt, state) -> carry, called after each step with the time [s] at its
            end, its length and the state there. With `tangents`, (carry, time, dt, state, tangents)
            -> (carry, tangents): it sees them and may scale or replace them. Compiled functions are
            kept by its identity: define it once, not in a loop.
        init: any pytree; Python numbers in it become float64.
        pendulum, state, duration, scheme: as for `flow`.
        tangents: vectors (d theta1, d theta2, d p1, d p2) at t = 0 to carry along by the derivative
            of the flow: one, or several along a leading axis.
    Returns:
        What `update` made of `init`; with `tangents`, that and the tangents at the end.
    Raises:
        ValueError: duration not finite, or shorter than one even step; arguments of other classes,
            arrays.
        RuntimeError: float64 is switched off in JAX.
    """
    example = "lambda carry, time, dt, state: jnp.maximum(carry, state.theta1)"
    function("update", update, "(carry, time, dt, state)", example)
    arrays("init", init)
    if tangents is not None:
        check_state(tangents, "tangents")
    _, tangents, carry = _run(update, (tangents, init), pendulum, state, duration, scheme)
    return carry if tangents is None else (carry, tangents)


def _run(
    update: Callable[..., Any],
    start: tuple[State | None, Any],
    pendulum: Pendulum | Any,
    state: State | Any,
    duration: Scalar,
    scheme: Scheme | Any,
) -> tuple[State, State | None, Any]:
    """`_accumulate` behind the checks, compiled for a known number of steps or for any."""
    require_float64()
    check_motion(pendulum, state)
    check_scheme(scheme)
    known = known_duration(duration)
    if not scheme.even:
        steps: Scalar = 0  # not known beforehand
    elif known is not None:
        steps = scheme.steps(known)
    else:
        # A duration that is not finite takes one step, into NaN.
        count = jnp.where(jnp.isfinite(duration), jnp.abs(duration), 0.0) / scheme.step
        steps = jnp.maximum(jnp.ceil(count - 1e-9), 1).astype(int)
    compiled = _fold if isinstance(steps, int) else _fold_traced
    start = float64(start[0]), jax.tree.map(_weakly_float64, start[1])
    time = jnp.asarray(duration, jnp.float64)
    end: tuple[State, State | None, Any]
    end = compiled(update, start, pendulum, float64(state), time, steps, scheme)
    return end


def known_duration(duration: Scalar) -> float | None:
    """The length of a motion [s], checked; None where it is traced."""
    single("duration", number("duration", duration, unit="s"))
    known = known_value(duration)
    if known is not None and not math.isfinite(
        known
    ):  # under eager differentiation `number` does not see it
        raise ValueError(
            f"duration must be a finite number [s], got {known}: give another duration"
        )
    return known


def _weakly_float64(leaf: Any) -> Any:
    return np.float64(leaf) if isinstance(leaf, float) else leaf
