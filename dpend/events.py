"""The first time at which a function of the state crosses zero, exact to the integration method.

Values and slopes at both ends of each step tell whether a function may cross zero inside it: it changes sign, or it
heads for zero, turns back, and a cubic through those four numbers comes near zero between. Only such steps are looked
into. There the step is taken again from the state before it, as a step of the same method of another length: no
interpolant, whose own error would be another. A bracket of the change of sign is kept all along, so that what comes out
is a root, or nothing. Where nothing comes out (the function jumps, has a pole, or turns back before zero) the search
goes on behind that step.

A function lies on zero where it is no larger than the rounding errors of the state make it. What lies there at t = 0
has the sign that it takes when it leaves; what is still on its way there at the end crosses at the end.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from dpend.pendulum import Pendulum, Scalar, State, vector_field
from dpend.steppers import Scheme
from dpend.trajectory import fold

# Newton's method takes three or four; a jump, which is bisected to the last bit, some 60.
_MOST_ITERATIONS = 120
_EPSILON = float(np.finfo(np.float64).eps)
# A value of so many rounding errors of the state counts as zero.
_ROUNDING = 8.0
# A step is looked into where the cubic's bottom lies above zero by this share of its depth below the step's ends. The
# cubic's error is (omega h)^2/12 of the depth for a swing of frequency omega: a swing is seen up to omega h = 1.2.
_MARGIN = 0.125
# Steps that are kept to be looked into in one pass. Where all of them disappoint, the next pass begins behind them: so
# seldom, with two, that a first-flip map does not feel it.
_SLOTS = 2
# A step that crosses in the motion and not when taken again (the circle forms then begin on their circle) is lengthened
# by this share of itself.
_BEYOND = 1 / 64


class Crossing(NamedTuple):
    """The first crossing on a motion.

    Attributes:
        time: when [s]; infinite if there is none.
        state: the state there; the last one of the motion if there is none.
        which: the index of the function that crosses zero; -1 if there is none.
        steps: the number of steps taken, whole motion.
    """

    time: Scalar
    state: State
    which: Scalar
    steps: Scalar


class _Step(NamedTuple):
    """A step to look into: the state before it, its end and length [s], and of each function the sign at its start and
    whether it changes.
    """

    before: State
    time: Scalar
    dt: Scalar
    signs: tuple[Scalar, ...]
    crossed: tuple[Scalar, ...]


class _Search(NamedTuple):
    """What is known along the way. `values`, `rates` [1/s] and `signs` are those of the functions after the last step,
    a sign zero as long as there is none; scalars, not arrays, which XLA would not compute side by side for many lanes.
    `closed` tells that the last of the steps to look into changes a sign, so that no later one is asked for.
    """

    values: tuple[Scalar, ...]
    rates: tuple[Scalar, ...]
    signs: tuple[Scalar, ...]
    state: State
    slots: tuple[_Step, ...]
    count: Scalar
    closed: Scalar
    steps: Scalar


class _Pass(NamedTuple):
    """What one motion from start to end has found. Steps up to `floor` [s] are known to hold nothing."""

    floor: Scalar
    again: Scalar
    crossing: Crossing


def first_crossing(
    functions: Callable[[Pendulum, State], Any],
    pendulum: Pendulum,
    state: State,
    duration: float,
    scheme: Scheme,
    *,
    direction: int = 0,
) -> Crossing:
    """The first time 0 < t <= duration at which one of `functions` changes sign continuously.

    A state on the section, within rounding, leaves it first: the crossing that it is at does not count, the next does,
    however soon. A crossing within rounding of `duration` counts. A function that touches zero does not cross it, nor
    does one that jumps over it or is not a number there; what it does later counts.

    Two crossings in one step are seen where a cubic through values and slopes at its ends shows them, that is of
    functions that swing no faster than five steps a swing resolve. Of three crossings in one step one is seen; two are
    not seen where the function turns once more in that step.

    Forward derivatives, those of `time` and `state` with respect to pendulum and state, are those of the implicit
    function theorem.

    Arguments:
        functions: (pendulum, state) -> one scalar, or a tuple of scalars each of which is watched; smooth where it
            crosses. Compiled functions are kept by its identity: define it once, not in a loop.
        pendulum, state, scheme: as for `flow`.
        duration: how long to look [s], a number; negative runs backwards.
        direction: 1 counts crossings from below only, -1 from above only, 0 both; as the motion is followed, which for
            a negative duration is backwards.
    Returns:
        Crossing.
    Raises:
        ValueError: direction is none of these; as `flow`.
    """
    if direction not in (-1, 0, 1):
        raise ValueError(f"direction must be -1, 0 or 1, got {direction!r}")
    return _first_crossing(functions, pendulum, state, float(duration), scheme, direction)


@partial(jax.jit, static_argnames=("functions", "duration", "scheme", "direction"))
def _first_crossing(functions, pendulum, state, duration, scheme, direction):  # type: ignore[no-untyped-def]
    watch = _Watch(functions, pendulum, scheme, direction)
    state = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), state)
    step = -scheme.step if duration < 0 else scheme.step
    start = watch.start(state, step)

    def attempt(last: _Pass) -> _Pass:
        search = fold(partial(watch.look, last.floor), start, pendulum, state, duration, scheme)
        end = watch.end(search, duration, step)
        slots = jax.tree.map(lambda *leaves: jnp.stack(leaves), *search.slots)
        found, _ = lax.scan(watch.settle, end._replace(which=jnp.full_like(end.which, -1)), slots)
        some = found.which >= 0
        # Only where the slots hold all that there was to look into is the search at its end.
        again = ~some & (search.closed | (search.count == _SLOTS))
        floor = jnp.max(jnp.where(jnp.arange(_SLOTS) < search.count, jnp.abs(slots.time), 0.0))
        return _Pass(floor, again, _choose(some, found, end))

    none = Crossing(jnp.full_like(state.theta1, jnp.inf), state, jnp.asarray(-1), jnp.zeros_like(state.theta1))
    first = _Pass(jnp.zeros_like(state.theta1), jnp.isinf(none.time), none)
    return lax.while_loop(lambda last: last.again, attempt, first).crossing


def _choose(condition: Scalar, this: Any, other: Any) -> Any:
    return jax.tree.map(partial(jnp.where, condition), this, other)


class _Measure(NamedTuple):
    """The functions at a state, shape (functions,): values, changes over one whole step at the rate there, and what
    rounding leaves uncertain of the values.
    """

    value: jax.Array
    change: jax.Array
    rounding: jax.Array


class _Watch(NamedTuple):
    """What is asked for, and of which motion."""

    functions: Callable[[Pendulum, State], Any]
    pendulum: Pendulum
    scheme: Scheme
    direction: int

    def values(self, state: State) -> tuple[Scalar, ...]:
        leaves = jax.tree.leaves(self.functions(self.pendulum, state))
        return tuple(jnp.asarray(leaf, jnp.float64) for leaf in leaves)

    def rates(self, state: State) -> tuple[tuple[Scalar, ...], tuple[Scalar, ...]]:
        """The functions and their rates of change along the motion [1/s]."""
        return jax.jvp(self.values, (state,), (vector_field(self.pendulum, state),))

    def measure(self, state: State, dt: Scalar) -> _Measure:
        """The functions against a step of `dt` [s]."""
        parts = [
            jnp.stack(values) for values in zip(*(jax.tree.leaves(x) for x in self._gradients(state)), strict=True)
        ]
        moves = [dt * slope for slope in jax.tree.leaves(vector_field(self.pendulum, state))]
        change = sum(part * move for part, move in zip(parts, moves, strict=True))
        sizes = [jnp.abs(x) + jnp.abs(move) for x, move in zip(jax.tree.leaves(state), moves, strict=True)]
        rounding = _EPSILON * sum(jnp.abs(part) * size for part, size in zip(parts, sizes, strict=True))
        return _Measure(jnp.stack(self.values(state)), change, rounding)

    def _gradients(self, state: State) -> tuple[State, ...]:
        return jax.jacfwd(self.values)(state)

    def counts(self, sign: Scalar) -> Scalar:
        """Whether a change from this sign is one that is asked for."""
        return sign != 0 if self.direction == 0 else sign * self.direction < 0

    def start(self, state: State, step: float) -> _Search:
        """The search at its start. What lies on zero has the sign of the first derivative that is not zero."""
        values, rates = self.rates(state)
        _, (_, bends) = jax.jvp(self.rates, (state,), (vector_field(self.pendulum, state),))
        zeros = _ROUNDING * self.measure(state, step).rounding
        terms = zip(values, rates, bends, zeros, strict=True)
        signs = tuple(_first_sign((value, step * rate, step**2 * bend), zero) for value, rate, bend, zero in terms)
        zero = jnp.zeros_like(state.theta1)
        slot = _Step(state, zero, zero, signs, tuple(sign > 2 for sign in signs))
        return _Search(values, rates, signs, state, (slot,) * _SLOTS, jnp.asarray(0), zero > 0, zero)

    def look(self, floor: Scalar, search: _Search, time: Scalar, dt: Scalar, state: State) -> _Search:
        """The `update` of `fold` that notes the steps to look into."""
        values, rates = self.rates(state)
        befores = [_Sample(0.0, value, dt * rate) for value, rate in zip(search.values, search.rates, strict=True)]
        afters = [_Sample(1.0, value, dt * rate) for value, rate in zip(values, rates, strict=True)]
        ends = list(zip(search.signs, befores, afters, strict=True))
        crossed = tuple(_goes_through(sign, after) for sign, _, after in ends)
        wanted = [through & self.counts(sign) for through, sign in zip(crossed, search.signs, strict=True)]
        changes = jnp.any(jnp.stack(wanted))
        turns = jnp.any(jnp.stack([_may_dip(*end) for end in ends]))
        take = (changes | turns) & ~search.closed & (search.count < _SLOTS) & (jnp.abs(time) > floor)
        step = _Step(search.state, time, dt, search.signs, crossed)
        slots = tuple(_choose(take & (search.count == i), step, slot) for i, slot in enumerate(search.slots))
        signs = tuple(_sign_after(*both) for both in zip(search.signs, crossed, values, strict=True))
        count, closed = search.count + take.astype(int), search.closed | (take & changes)
        return _Search(values, rates, signs, state, slots, count, closed, search.steps + 1.0)

    def end(self, search: _Search, duration: float, step: float) -> Crossing:
        """The end of the motion as a crossing, if it lies on zero and comes from the side asked for."""
        here, sign = self.measure(search.state, step), jnp.stack(search.signs)
        zero = _ROUNDING * here.rounding
        arrives = (jnp.abs(here.value) <= zero) & (sign * here.change < -zero) & self.counts(sign)
        some = jnp.any(arrives)
        time, which = jnp.where(some, duration, jnp.inf), jnp.where(some, jnp.argmax(arrives), -1)
        return Crossing(time, search.state, which, search.steps)

    def settle(self, crossing: Crossing, step: _Step) -> tuple[Crossing, None]:
        """The earliest crossing inside the step, unless there is one already."""
        begin, signs = self.measure(step.before, step.dt), jnp.stack(step.signs)
        asked = (crossing.which < 0) & (step.dt != 0)
        each = jnp.arange(len(signs)), begin, signs, jnp.stack(step.crossed)
        # One after the other, not `vmap`: lanes then stay side by side.
        share, state, found = lax.map(lambda one: self._probe(step, asked, *one), each)
        which = jnp.argmin(jnp.where(found, share, jnp.inf))
        share, state = jax.tree.map(lambda leaf: leaf[which], (share, state))
        time = step.time + (share - 1.0) * step.dt
        here = Crossing(time, state, which, crossing.steps)
        return _choose(jnp.any(found), here, crossing), None

    def _probe(self, step, asked, index, begin, sign, crossed):  # type: ignore[no-untyped-def]
        """Where in the step function `index` crosses [steps], the state there, and whether it does."""
        unit, point = self.scheme.constants(self.pendulum), self.scheme.enter(self.pendulum, step.before)

        def at(share: Scalar) -> tuple[State, _Measure]:
            state = self.scheme.leave(unit, self.scheme.move(self.scheme.lasting(unit, share * step.dt), point))
            measure = self.measure(state, step.dt)
            return state, jax.tree.map(lambda leaf: leaf[index], measure)

        def once(carry: tuple[_Probe, State]) -> tuple[_Probe, State]:
            probe, _ = carry
            state, measure = at(probe.share)
            here = _Sample(probe.share, measure.value, measure.change)
            phases = (
                (_END, self._enclosed(probe, here, crossed)),
                (_TURN, self._descended(probe, here, measure.rounding)),
                (_ROOT, _narrowed(probe, here, measure.rounding)),
            )
            ahead = _judged(probe, here, measure.rounding)
            for phase, other in phases:
                ahead = _choose(probe.phase == phase, other, ahead)
            return ahead._replace(count=probe.count + 1), state

        def goes_on(carry: tuple[_Probe, State]) -> Scalar:
            return (carry[0].phase < _FOUND) & (carry[0].count < _MOST_ITERATIONS)

        low = _Sample(jnp.zeros_like(begin.value), begin.value, begin.change)
        phase = jnp.where(asked & (sign != 0), _END, _NONE)
        largest = jnp.maximum(jnp.abs(begin.value), begin.rounding)
        one = jnp.ones_like(begin.value)
        first = _Probe(phase, one, low, low, sign, one, largest, jnp.asarray(0))
        probe, state = lax.while_loop(goes_on, once, (first, step.before))
        return probe.share, state, probe.phase == _FOUND

    def _enclosed(self, probe: "_Probe", here: "_Sample", crossed: Scalar) -> "_Probe":
        """After the step's end: a bracket of a change of sign, or of a turn before one, or the end of it."""
        largest = jnp.maximum(probe.largest, jnp.abs(here.value))
        probe = probe._replace(largest=largest)
        further = probe._replace(
            share=jnp.ones_like(probe.share) + _BEYOND,
            phase=jnp.where(crossed & (here.share <= 1.0), _END, _NONE),
        )
        turn = probe.between(_TURN, probe.low, here)
        turn = turn._replace(share=_bottom(turn.low, turn.high))
        ahead = _choose(_may_dip(probe.sign, probe.low, here), turn, further)
        root = probe.between(jnp.where(self.counts(probe.sign), _ROOT, _NONE), probe.low, here)
        root = root._replace(share=_inverse(root.low, root.high))
        return _choose(_goes_through(probe.sign, here), root, ahead)

    def _descended(self, probe: "_Probe", here: "_Sample", rounding: Scalar) -> "_Probe":
        """On the way to where a function turns back: a bracket as soon as it is through zero by more than rounding, or
        the end of it where the slope and the bracket's width leave too little to fall.
        """
        height = probe.sign * here.value
        falls = probe.sign * here.change < 0
        low, high = _choose(falls, here, probe.low), _choose(falls, probe.high, here)
        ahead = probe.between(_TURN, low, high)
        middle = 0.5 * (low.share + high.share)
        slow = ahead.last > 0.5 * probe.last
        least = jnp.abs(here.change) * ahead.last
        ahead = ahead._replace(
            share=jnp.where(slow, middle, _bottom(low, high)),
            phase=jnp.where(least > jnp.maximum(height, rounding), _TURN, _NONE),
        )
        before = probe.between(_ROOT, probe.low, here)
        behind = probe.between(_ROOT, here, probe.high)._replace(sign=-probe.sign)
        root = _choose(self.counts(probe.sign), before, behind)
        root = root._replace(share=_inverse(root.low, root.high))
        return _choose(height < -rounding, root, ahead)


# What a probe does next: try the step's end, look for a turn, close in on a root, judge it; or it is done.
_END, _TURN, _ROOT, _LAST, _FOUND, _NONE = range(6)


class _Sample(NamedTuple):
    """A function inside a step: where [steps], its value, and its change over a step at the rate there."""

    share: Scalar
    value: Scalar
    change: Scalar


class _Probe(NamedTuple):
    """One function inside one step. It has `sign` at `low` and, in the phase of the root, the other one at `high`;
    `share` is what is tried next, `last` the length of the last move, `largest` the larger value at the step's ends.
    """

    phase: Scalar
    share: Scalar
    low: _Sample
    high: _Sample
    sign: Scalar
    last: Scalar
    largest: Scalar
    count: Scalar

    def between(self, phase: Scalar, low: _Sample, high: _Sample) -> "_Probe":
        return self._replace(phase=jnp.asarray(phase), low=low, high=high, last=high.share - low.share)


def _narrowed(probe: _Probe, here: _Sample, rounding: Scalar) -> _Probe:
    """One of Newton's iterations, or where that leaves the bracket or does not halve the move, a bisection.

    After the last, one more of Newton's, whose derivative is that of the root.
    """
    height, zero = probe.sign * here.value, jnp.abs(here.value) <= rounding
    leaves = zero & (probe.sign * here.change > 0)  # the section on which the motion starts
    through = (height <= 0) & ~leaves
    low, high = _choose(through, probe.low, here), _choose(through, here, probe.high)
    flat = here.change == 0
    newton = here.share - here.value / jnp.where(flat, 1.0, here.change)
    inside = (newton >= low.share) & (newton <= high.share) & ~flat
    inside &= jnp.abs(newton - here.share) <= 0.5 * probe.last
    share = jnp.where(inside, newton, 0.5 * (low.share + high.share))
    last = jnp.abs(share - here.share)
    narrow = high.share - low.share <= 4 * _EPSILON
    close = (zero & ~leaves) | (inside & (last <= 4 * _EPSILON)) | narrow
    end = newton + lax.stop_gradient(jnp.clip(newton, low.share, high.share) - newton)
    return probe._replace(
        phase=jnp.where(close, _LAST, _ROOT), share=jnp.where(close, end, share), low=low, high=high, last=last
    )


def _judged(probe: _Probe, here: _Sample, rounding: Scalar) -> _Probe:
    """Whether it is a root: as small as rounding, and smaller than at the ends of the step, which a pole is not."""
    small = jnp.abs(here.value) <= _ROUNDING * (rounding + _EPSILON * jnp.abs(here.change))
    small &= jnp.abs(here.value) <= probe.largest
    return probe._replace(phase=jnp.where(small, _FOUND, _NONE))


def _first_sign(terms: tuple[Scalar, ...], zero: Scalar) -> Scalar:
    """The sign of the first term that is larger than zero; none, zero."""
    sign = jnp.zeros_like(terms[0])
    for term in reversed(terms):
        sign = jnp.where(jnp.abs(term) > zero, jnp.sign(term), sign)
    return sign


def _goes_through(sign: Scalar, after: _Sample) -> Scalar:
    """Whether the sign has changed; at zero itself the slope tells."""
    return (sign * after.value < 0) | ((after.value == 0) & (sign * after.change < 0))


def _sign_after(sign: Scalar, crossed: Scalar, value: Scalar) -> Scalar:
    """A function that is not a number loses its sign: what it does next is a new start."""
    kept = jnp.where(crossed, -sign, sign)
    return jnp.where(jnp.isnan(value), 0.0, jnp.where(value == 0, kept, jnp.sign(value)))


def _may_dip(sign: Scalar, before: _Sample, after: _Sample) -> Scalar:
    """Whether a function that keeps its sign heads for zero, turns back, and may be through zero between."""
    start, end = sign * before.value, sign * after.value
    falls, rises = sign * before.change, sign * after.change
    share, rest = falls / (falls - rises), end - start
    bottom = start + share * (falls + share * (3 * rest - 2 * falls - rises + share * (falls + rises - 2 * rest)))
    depth = jnp.minimum(start, end) - bottom
    return (falls < 0) & (rises > 0) & (end > 0) & (bottom <= _MARGIN * depth)


def _bottom(low: _Sample, high: _Sample) -> Scalar:
    """Where the slope is zero if it changes evenly."""
    return low.share + (high.share - low.share) * low.change / (low.change - high.change)


def _inverse(low: _Sample, high: _Sample) -> Scalar:
    """Where a bracketed root lies by the cubic that gives the share as a function of the value; where that is not
    monotonic, by the chord, away from both ends.
    """
    width, rise = high.share - low.share, high.value - low.value
    chord = -low.value / rise
    first, second = rise / (low.change * width), rise / (high.change * width)
    cubic = chord * ((1 - chord) ** 2 * first + chord * (3 - 2 * chord + (chord - 1) * second))
    sound = (first > 0) & (first < 3) & (second > 0) & (second < 3) & (cubic > 0) & (cubic < 1)
    return low.share + width * jnp.where(sound, cubic, jnp.clip(chord, 0.01, 0.99))
