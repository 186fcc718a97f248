"""The next crossings of a section, one after the other, each exact to the integration method.

The motion goes step by step. At each step's end the function and its rate are known exactly, and so
are they at its start. Two signs send the search into a step: the function changes its sign in it,
or it heads for zero at the start and away from zero at the end, and its tangents there meet near
zero. In such a step a probe (`root`) takes the step again at other lengths, until it has a root or
nothing. The motion goes on from the root, with the sign that the function has behind it: no
crossing is found twice, and a second one in the same step is found next.

One loop does all of it, and each of its rounds takes one step, which is the motion's own or a
probe's. So lanes side by side, of which some march and some probe, do not wait for each other
before each has its crossing.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from dpend.checks import Scalar, integer, one_of
from dpend.checks import function as check_function
from dpend.mechanics.pendulum import Pendulum, State, check_motion
from dpend.methods.runge_kutta import Constants, Point
from dpend.methods.scheme import Scheme, check_scheme
from dpend.motion.events import Watch
from dpend.motion.integrate import SHORTEST_STEP, Turns, step_for, with_turns, without_turns
from dpend.motion.root import (
    BEGIN,
    FOUND,
    Probe,
    Sample,
    choose,
    counts,
    first_probe,
    follow,
    goes_through,
)

# Newton's method takes three or four tries; a jump, which is bisected to the last bit, some 60.
_MOST_TRIES = 120
# A function that turns in a step may come down to zero where its tangents at the ends meet below
# this share of the difference of its slopes. A parabola's meet 1/8 below its bottom for a swing
# that turns in the middle; the share is for what is no parabola.
_MARGIN = 0.05
# Steps between two crossings: at 25 steps a swing four thousand swings.
MOST_STEPS_BETWEEN = 100_000

_MARCH, _PASS, _PROBE = range(3)


class Crossings(NamedTuple):
    """The next crossings on a motion, leaves of shape (|count|,) but for `steps`.

    Attributes:
        time: when [s], negative backwards; infinite from the first one that was not found.
        state: the states there; NaN where there is none.
        side: 1 where the function rises, as the motion is followed, -1 where it falls, 0 where
            there is none.
        steps: the number of steps taken, probes among them.
    """

    time: Scalar
    state: State
    side: Scalar
    steps: Scalar


class _Start(NamedTuple):
    """Where the motion to the next crossing starts: `sign` is what the function has from there on,
    zero as long as it has none, and `value` and `rate` [1/s] are its own.
    """

    state: State
    time: Scalar
    value: Scalar
    rate: Scalar
    sign: Scalar
    goes: Scalar


class _March(NamedTuple):
    """The motion between two crossings.

    `point`, `value`, `rate`, `sign` and `time` [s] are those of the last step's end, `dt` [s] the
    next step and `spin` what its length is made of. `mode` tells whether the step is new, is known
    to hold nothing, or is one that `probe` looks into; `state` and `change` are those of the last
    try.
    """

    point: Point
    value: Scalar
    rate: Scalar
    sign: Scalar
    time: Scalar
    dt: Scalar
    spin: Scalar
    mode: Scalar
    probe: Probe
    crossed: Scalar
    state: State
    change: Scalar
    steps: Scalar
    lost: Scalar


def crossings(
    function: Callable[[Pendulum, State], Any] | Any,
    pendulum: Pendulum | Any,
    state: State | Any,
    count: int | Any,
    scheme: Scheme | Any,
    *,
    direction: int | Any = 0,
    most_steps: int | Any = MOST_STEPS_BETWEEN,
) -> Crossings:
    """The next `count` times at which `function` changes its sign continuously.

    A state on the section, within rounding, leaves it first: the crossing that it is at does not
    count. None is counted twice. A function that touches zero without changing its sign does not
    cross it. Two crossings in one step are both found, as long as the function turns once between
    the step's ends; where it turns three times in one step some are missed, and a shorter step
    finds them. Two crossings nearer to each other than rounding tells apart are none.

    Forward derivatives of times and states, with respect to pendulum and state, are those of the
    implicit function theorem.

    Arguments:
        function: (pendulum, state) -> one scalar, smooth where it crosses. Compiled functions are
            kept by its identity, or by its equality: define it once, not in a loop.
        pendulum, state: leaves are scalars; `jax.vmap` maps over many.
        count: how many; negative goes backwards in time.
        scheme: method and step; all steps but those to a crossing are whole ones.
        direction: 1 counts crossings from below only, -1 from above only, 0 both; as the motion is
            followed, which for a negative count is backwards.
        most_steps: the search for each crossing ends after so many steps without one.
    Returns:
        Crossings.
    Raises:
        ValueError: count zero or no integer; direction none of these; arguments of other classes,
            arrays.
    """
    like = "lambda pendulum, state: state.theta2"
    check_function("function", function, "(pendulum, state)", like)
    check_motion(pendulum, state)
    check_scheme(scheme)
    count = signed_count("count", count)
    direction = one_of("direction", direction, (-1, 0, 1))
    most = jnp.asarray(integer("most_steps", most_steps), jnp.float64)
    return _crossings(function, pendulum, state, count, scheme, direction, most)


def signed_count(name: str, count: Any) -> int:
    """How many, as an integer of at least 1; negative ones backwards.

    Raises:
        ValueError: zero, or no integer.
    """
    try:
        return integer(name, count)
    except ValueError as refusal:
        try:
            return -integer(name, -count)
        except (ValueError, TypeError, ArithmeticError):
            raise refusal from None


@partial(jax.jit, static_argnames=("function", "count", "scheme", "direction"))
def _crossings(
    function: Callable[[Pendulum, State], Any],
    pendulum: Pendulum,
    state: State,
    count: int,
    scheme: Scheme,
    direction: int,
    most_steps: Scalar,
) -> Crossings:
    state = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), state)
    course = _Course(Watch(function, pendulum, scheme, direction), -1.0 if count < 0 else 1.0)
    start = course.begin(state)

    def follow_on(start: _Start, _: None) -> tuple[_Start, Crossings]:
        return course.seek(start, most_steps)

    _, found = lax.scan(follow_on, start, length=abs(count))
    return found._replace(steps=jnp.sum(found.steps).astype(int))


class _Course(NamedTuple):
    """A motion that is watched, and in which sense of time it goes."""

    watch: Watch
    sense: float

    def begin(self, state: State) -> _Start:
        """The start of the motion; what lies on zero has the sign of its rate."""
        search, _ = self.watch.start(state, self.sense * self.watch.scheme.step)
        zero = jnp.zeros_like(state.theta1)
        return _Start(state, zero, search.values[0], search.rates[0], search.signs[0], zero == 0)

    def seek(self, start: _Start, most_steps: Scalar) -> tuple[_Start, Crossings]:
        """The next crossing, and the start behind it."""
        pendulum, scheme = self.watch.pendulum, self.watch.scheme
        state, turns = without_turns(start.state)
        unit = scheme.constants(pendulum)
        longest = self.sense * scheme.step
        if not scheme.even:
            longest = longest * scheme.pace(pendulum, state)
        advance = partial(self._advance, unit, turns, longest)
        end = lax.while_loop(
            lambda march: (march.probe.phase != FOUND) & ~march.lost & (march.steps < most_steps),
            advance,
            self._set_out(start, unit, state, longest),
        )
        found = end.probe.phase == FOUND
        time = end.time + end.probe.share * end.dt
        behind = -end.probe.sign
        ahead = _Start(
            with_turns(end.state, turns), time, jnp.zeros_like(time), end.change / end.dt, behind,
            found,
        )  # fmt: skip
        missing = jax.tree.map(lambda leaf: jnp.full_like(leaf, jnp.nan), ahead.state)
        crossing = Crossings(
            jnp.where(found, time, self.sense * jnp.inf),
            choose(found, ahead.state, missing),
            jnp.where(found, behind, 0.0).astype(int),
            end.steps,
        )
        return ahead, crossing

    def _set_out(self, start: _Start, unit: Constants, state: State, longest: Scalar) -> _March:
        scheme = self.watch.scheme
        point = scheme.enter(self.watch.pendulum, state)
        spin = jnp.ones_like(start.time) if scheme.even else scheme.spin(unit, point)
        dt = longest if scheme.even else step_for(longest, spin, spin)
        return _March(
            point=point,
            value=start.value,
            rate=start.rate,
            sign=start.sign,
            time=start.time,
            dt=jnp.asarray(dt) + jnp.zeros_like(start.time),
            spin=spin,
            mode=jnp.full_like(start.time, _MARCH, int),
            probe=_probe_from(start.sign),
            crossed=start.time < -jnp.inf,
            state=state,
            change=jnp.zeros_like(start.time),
            steps=jnp.zeros_like(start.time),
            lost=~start.goes,
        )

    def _advance(self, unit: Constants, turns: Turns, longest: Scalar, march: _March) -> _March:
        """One step, of the motion or of the probe."""
        scheme, direction = self.watch.scheme, self.watch.direction
        probing = march.mode == _PROBE
        share = jnp.where(probing, march.probe.share, 1.0)
        there = scheme.move(scheme.with_step(unit, share * march.dt), march.point)
        # XLA would compute the step again for each of its uses.
        there, state = lax.optimization_barrier((there, scheme.leave(unit, there)))
        ((here, rounding),) = self.watch.measure(with_turns(state, turns), march.dt, share)
        tried = follow(direction, march.probe, here, rounding, march.crossed)
        fails = (tried.phase > FOUND) | (tried.count >= _MOST_TRIES)

        crossed, opens = self._looks(march, here)
        opens &= march.mode == _MARCH
        begin = Sample(jnp.zeros_like(share), march.value, march.rate * march.dt)
        fresh = follow(direction, _probe_from(march.sign), begin, rounding, crossed)
        fresh = follow(direction, fresh, here, rounding, crossed)
        opens &= fresh.phase < FOUND

        held = march._replace(
            mode=jnp.where(probing & fails, _PASS, jnp.where(opens, _PROBE, march.mode)),
            probe=choose(probing, tried, fresh),
            crossed=jnp.where(probing, march.crossed, crossed),
            state=state,
            change=here.change,
        )
        held = held._replace(probe=choose(probing & fails, _probe_from(march.sign), held.probe))
        ahead = self._accept(unit, longest, march, there, here)
        steps, lost = march.steps + 1.0, ~jnp.isfinite(state.theta1 + state.theta2)
        chosen = choose(probing | opens, held, ahead._replace(state=state))
        return chosen._replace(steps=steps, lost=lost | chosen.lost)

    def _looks(self, march: _March, here: Sample) -> tuple[Scalar, Scalar]:
        """Whether a step changes the sign, and whether a crossing that counts may be in it."""
        sign, slope = march.sign, march.rate * march.dt
        crossed = goes_through(sign, here)
        bend = here.change - slope
        # The height at which the tangents at both ends meet.
        turns = (sign * slope < 0) & (sign * here.change > 0)
        where = (march.value - here.value + here.change) / jnp.where(turns, bend, 1.0)
        meets = sign * (march.value + slope * where)
        dips = turns & (meets <= _MARGIN * sign * bend)
        return crossed, (crossed & counts(self.watch.direction, sign)) | (dips & (sign != 0))

    def _accept(
        self, unit: Constants, longest: Scalar, march: _March, there: Point, here: Sample
    ) -> _March:
        """The motion one step on."""
        scheme = self.watch.scheme
        at_zero = here.value == 0
        behind = jnp.where(goes_through(march.sign, here), -march.sign, march.sign)
        ahead = march._replace(
            point=there,
            value=here.value,
            rate=here.change / march.dt,
            sign=jnp.where(at_zero, behind, jnp.sign(here.value)),
            time=march.time + march.dt,
            mode=jnp.full_like(march.mode, _MARCH),
            probe=_probe_from(march.sign),
        )
        if scheme.even:
            return ahead
        spin = scheme.spin(unit, there)
        dt = step_for(longest, spin, march.spin)
        lost = ~(jnp.abs(dt) >= SHORTEST_STEP * jnp.abs(longest))
        return ahead._replace(dt=dt, spin=spin, lost=lost)


def _probe_from(sign: Scalar) -> Probe:
    return first_probe(jnp.full_like(sign, BEGIN, int), sign)
