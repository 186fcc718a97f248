"""The first time at which a function of the state crosses zero, exact to the integration method.

A function may cross zero inside a step where it changes sign, and where it heads for zero and turns
back: a parabola through its values at the ends of the last two steps comes near zero in the last
one. Only such steps are looked into. There the step is taken again from the state before it, as a
step of the same method of another length: no interpolant, whose own error would be another. A
bracket of the change of sign is kept all along, so that what comes out is a root, or nothing. Where
nothing comes out (the function jumps, has a pole, or turns back before zero) the search goes on
behind that step.

A function lies on zero where it is no larger than the rounding errors of the state make it. What
lies there at t = 0 has the sign that it takes when it leaves; what is still on its way there at the
end crosses at the end.
"""

from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from dpend.checks import Scalar, function, known_number, one_of
from dpend.mechanics.pendulum import Pendulum, State, check_motion, vector_field
from dpend.methods.scheme import Scheme, check_scheme
from dpend.motion.integrate import fold

# Newton's method takes three or four; a jump, which is bisected to the last bit, some 60.
_MOST_ITERATIONS = 120
_EPSILON = float(np.finfo(np.float64).eps)
# A value of so many rounding errors of the state counts as zero.
_ROUNDING = 8.0
# A bracket, a move of Newton's [steps] and a value of so few rounding errors are not bisected
# further: one more of Newton's iterations, which is the last, ends within one or two.
_CLOSE = 4.0
# A step is looked into where the parabola, inside the step or so many steps beside it, comes down
# to this share of the difference of its slopes at the step's ends; a swing is as deep there as 1/8.
# Its error is some (omega h)/2 of that for a swing of frequency omega: it is seen up to omega h =
# 0.8.
_MARGIN, _BESIDE = 0.05, 0.3
# A rise so many times the slopes at both ends of a bracket and at the root is a jump.
_STEEPEST = 4.0
# So near the end of a motion [steps] a crossing is asked whether it lies at the end within
# rounding.
_NEAR_END = 1e-3
# A step that crosses in the motion and not when taken again (the circle forms then begin on their
# circle) is lengthened by this share of itself.
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


class _Search(NamedTuple):
    """What is known along the way, in as few numbers as can be: every step copies them.

    `values` and `signs` are those of the functions after the last step, `rates` [1/s] their mean
    ones in it; a sign is zero as long as there is none. They are scalars: XLA computes those of
    many lanes side by side, and arrays of a few numbers not.

    `state` is the last one, until there is a step to look into. From then on it is the state before
    that step, `time` is its end and `dt` its length [s], and `marks` are the functions' signs at
    its start, doubled if they change in it, zero if there is nothing to look for. Until then `time`
    is zero.
    """

    values: tuple[Scalar, ...]
    rates: tuple[Scalar, ...]
    signs: tuple[Scalar, ...]
    state: State
    time: Scalar
    dt: Scalar
    marks: tuple[Scalar, ...]
    steps: Scalar


class _Pass(NamedTuple):
    """What one motion from start to end finds. Steps up to `floor` [s] are known to hold
    nothing.
    """

    floor: Scalar
    again: Scalar
    crossing: Crossing


class _Task(NamedTuple):
    """A function to follow, if it is `open`: its sign at the step's start, and whether the step
    changes it.
    """

    open: Scalar
    sign: Scalar
    crossed: Scalar


# What a probe does next: see whether it is at zero before the step, try the step's start, its end,
# look for a turn, close in on a root, judge it; or it is done.
_ARRIVE, _BEGIN, _END, _TURN, _ROOT, _LAST, _FOUND, _NONE = range(8)


class _Sample(NamedTuple):
    """A function inside a step: where [steps], its value, its change over a step at that rate."""

    share: Scalar
    value: Scalar
    change: Scalar


class _Probe(NamedTuple):
    """One function inside one step.

    It has `sign` at `low` and, in the phase of the root, the other one at `high`; `share` is what
    is tried next, `last` the length of the last move, `largest` the larger value at the step's
    ends.
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
        return self._replace(
            phase=jnp.asarray(phase), low=low, high=high, last=high.share - low.share
        )


def first_crossing(
    functions: Callable[[Pendulum, State], Any] | Any,
    pendulum: Pendulum | Any,
    state: State | Any,
    duration: float | Any,
    scheme: Scheme | Any,
    *,
    direction: int | Any = 0,
) -> Crossing:
    """The first time 0 < t <= duration at which one of `functions` changes sign continuously.

    A state on the section, within rounding, leaves it first: the crossing that it is at does not
    count, the next does, however soon. A crossing within rounding of `duration` counts. A function
    that touches zero does not cross it, nor does one that jumps over it or is not a number there;
    what it does later counts.

    Two crossings in one step are seen where a parabola through the ends of two steps shows them,
    that is of functions that swing no faster than eight steps a swing resolve. Of three crossings
    in one step one is seen; two are not seen where the function turns once more in that step.

    All this costs: a map of first flips takes 1.11 to 1.15 times as long as with bare changes of
    sign.

    Forward derivatives, those of `time` and `state` with respect to pendulum and state, are those
    of the implicit function theorem.

    Arguments:
        functions: (pendulum, state) -> one scalar, or a tuple of scalars each of which is watched;
            smooth where it crosses. Compiled functions are kept by its identity: define it once,
            not in a loop.
        pendulum, state, scheme: as for `flow`.
        duration: how long to look [s], a number; negative runs backwards.
        direction: 1 counts crossings from below only, -1 from above only, 0 both; as the motion is
            followed, which for a negative duration is backwards.
    Returns:
        Crossing.
    Raises:
        ValueError: direction is none of these; as `flow`.
    """
    function("functions", functions, "(pendulum, state)", "lambda pendulum, state: state.theta2")
    check_motion(pendulum, state)
    check_scheme(scheme)
    duration, direction = (
        known_number("duration", duration, unit="s"),
        one_of("direction", direction, (-1, 0, 1)),
    )
    return _first_crossing(functions, pendulum, state, duration, scheme, direction)


@partial(jax.jit, static_argnames=("functions", "duration", "scheme", "direction"))
def _first_crossing(functions, pendulum, state, duration, scheme, direction):  # type: ignore[no-untyped-def]
    watch = _Watch(functions, pendulum, scheme, direction)
    state = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), state)
    step = -scheme.step if duration < 0 else scheme.step
    start, zeros = watch.start(state, step)

    def attempt(last: _Pass) -> _Pass:
        search = fold(
            partial(watch.look, last.floor, zeros), start, pendulum, state, duration, scheme
        )
        crossing = watch.settle(search, duration, step)
        # A step that disappoints leaves all that comes after it to the next pass.
        return _Pass(jnp.abs(search.time), (search.time != 0) & (crossing.which < 0), crossing)

    zero = jnp.zeros_like(state.theta1)
    first = _Pass(zero, zero == 0, Crossing(zero, state, jnp.asarray(-1), zero))
    return lax.while_loop(lambda last: last.again, attempt, first).crossing


def _choose(condition: Scalar, this: Any, other: Any) -> Any:
    return jax.tree.map(partial(jnp.where, condition), this, other)


def _pick(items: Sequence[Any], index: Scalar) -> Any:
    """items[index] by selections, which many lanes take side by side."""
    return reduce(
        lambda other, i: _choose(index == i, items[i], other), range(1, len(items)), items[0]
    )


class _Measure(NamedTuple):
    """A function at a state: its value, its change over one whole step at the rate there, and what
    rounding leaves uncertain of the value.
    """

    value: Scalar
    change: Scalar
    rounding: Scalar


class _Watch(NamedTuple):
    """What is asked for, and of which motion."""

    functions: Callable[[Pendulum, State], Any]
    pendulum: Pendulum
    scheme: Scheme
    direction: int

    def values(self, state: State) -> tuple[Scalar, ...]:
        leaves = jax.tree.leaves(self.functions(self.pendulum, state))
        return tuple(jnp.asarray(leaf, jnp.float64) for leaf in leaves)

    def measure(self, state: State, dt: Scalar) -> list[_Measure]:
        """The functions against a step of `dt` [s]."""
        moves = [dt * slope for slope in jax.tree.leaves(vector_field(self.pendulum, state))]
        sizes = [
            jnp.abs(x) + jnp.abs(move)
            for x, move in zip(jax.tree.leaves(state), moves, strict=True)
        ]
        measures = []
        for value, gradient in zip(self.values(state), jax.jacfwd(self.values)(state), strict=True):
            parts = jax.tree.leaves(gradient)
            change = sum(part * move for part, move in zip(parts, moves, strict=True))
            rounding = _EPSILON * sum(
                jnp.abs(part) * size for part, size in zip(parts, sizes, strict=True)
            )
            measures.append(_Measure(value, change, rounding))
        return measures

    def counts(self, sign: Scalar) -> Scalar:
        """Whether a change from this sign is one that is asked for."""
        return sign != 0 if self.direction == 0 else sign * self.direction < 0

    def start(self, state: State, step: float) -> tuple[_Search, tuple[Scalar, ...]]:
        """The search at its start, and up to what values the functions are zero there. What lies on
        zero has the sign of its rate.
        """
        values, rates, signs, zeros = [], [], [], []
        for here in self.measure(state, step):
            zero = _ROUNDING * here.rounding
            leaves = jnp.where(jnp.abs(here.change) > zero, jnp.sign(here.change), 0.0)
            signs.append(jnp.where(jnp.abs(here.value) > zero, jnp.sign(here.value), leaves))
            values.append(here.value)
            rates.append(here.change / step)
            zeros.append(zero)
        nothing = jnp.zeros_like(state.theta1)
        marks = (nothing,) * len(signs)
        search = _Search(
            tuple(values), tuple(rates), tuple(signs), state, nothing, nothing, marks, nothing
        )
        return search, tuple(zeros)

    def look(
        self,
        floor: Scalar,
        zeros: tuple[Scalar, ...],
        search: _Search,
        time: Scalar,
        dt: Scalar,
        state: State,
    ) -> _Search:
        """The `update` of `fold` that waits for a step to look into, one that ends behind
        `floor`.
        """
        values, marks, rates, signs = self.values(state), [], [], []
        # The rate at the start is known; later ones are those of the middle of a step about as long
        # as this one.
        weight, per_step = jnp.where(search.steps == 0, 1.0, 0.5), 1.0 / dt
        functions = zip(search.signs, search.values, search.rates, values, zeros, strict=True)
        for sign, before, rate, value, zero in functions:
            move = value - before
            # What the parabola adds to its chord's slope at the end, and takes from it at the
            # start.
            bend = weight * (move - dt * rate)
            crossed = _goes_through(sign, _Sample(1.0, value, move + bend))
            turns = _may_turn(sign * before, sign * value, sign * bend)
            marks.append(
                jnp.where(crossed & self.counts(sign), 2 * sign, jnp.where(turns, sign, 0.0))
            )
            rates.append(move * per_step)
            is_zero = jnp.abs(value) <= jnp.where(sign == 0, zero, 0.0)
            # What is not a number has no sign that could change: what it does next is a new start.
            signs.append(jnp.where(is_zero, jnp.where(crossed, -sign, sign), jnp.sign(value)))
        waits = search.time == 0
        take = (
            waits & reduce(jnp.logical_or, [mark != 0 for mark in marks]) & (jnp.abs(time) > floor)
        )
        end, length, kept = _choose(
            take, (time, dt, tuple(marks)), (search.time, search.dt, search.marks)
        )
        state = _choose(waits & ~take, state, search.state)
        return _Search(
            values, tuple(rates), tuple(signs), state, end, length, kept, search.steps + 1.0
        )

    def settle(self, search: _Search, duration: float, step: float) -> Crossing:
        """The earliest crossing in the step to look into, or, where there is none, at the end of
        the motion, from where a step of `step` [s] goes on. Each lane goes through its own
        functions, one after the other.
        """
        inside = search.time != 0
        end, dt = (
            jnp.where(inside, search.time, duration + step),
            jnp.where(inside, search.dt, step),
        )
        phase, tasks = jnp.where(inside, _BEGIN, _ARRIVE), _tasks(search, inside, step)
        unit, point = (
            self.scheme.constants(self.pendulum),
            self.scheme.enter(self.pendulum, search.state),
        )

        def after(index: Scalar) -> tuple[Scalar, _Probe]:
            """The next function to follow."""
            ahead = jnp.full_like(index, len(tasks))
            for i, task in reversed(list(enumerate(tasks))):
                ahead = jnp.where((i > index) & task.open, i, ahead)
            return ahead, _first_probe(phase, _pick(tasks, ahead).sign)

        def once(work: tuple[Scalar, _Probe, Crossing]) -> tuple[Scalar, _Probe, Crossing]:
            index, probe, crossing = work
            state = self.scheme.leave(
                unit, self.scheme.move(self.scheme.with_step(unit, probe.share * dt), point)
            )
            # XLA would compute the step again for each of its uses.
            state = lax.optimization_barrier(state)
            measure = lax.optimization_barrier(_pick(self.measure(state, dt), index))
            here = _Sample(probe.share, measure.value, measure.change)
            time = _within(duration, end + (probe.share - 1.0) * dt)
            probe = self._follow(probe, here, measure.rounding, _pick(tasks, index).crossed)
            earlier = (probe.phase == _FOUND) & (jnp.abs(time) < jnp.abs(crossing.time))
            crossing = _choose(earlier, Crossing(time, state, index, crossing.steps), crossing)
            is_done = (probe.phase >= _FOUND) | (probe.count >= _MOST_ITERATIONS)
            return *_choose(is_done, after(index), (index, probe)), crossing

        none = Crossing(
            jnp.full_like(search.steps, jnp.inf), search.state, jnp.asarray(-1), search.steps
        )
        first = after(jnp.full_like(phase, -1))
        return lax.while_loop(lambda work: work[0] < len(tasks), once, (*first, none))[2]

    def _follow(self, probe: _Probe, here: _Sample, rounding: Scalar, crossed: Scalar) -> _Probe:
        """The probe after one more try, which is `here`."""
        phases = {
            _ARRIVE: self._arrived(probe, here, rounding),
            _BEGIN: _begun(probe, here, rounding),
            _END: self._enclosed(probe, here, crossed),
            _TURN: self._descended(probe, here, rounding),
            _ROOT: _narrowed(probe, here, rounding),
        }
        ahead = _judged(probe, here, rounding)
        for phase, other in phases.items():
            ahead = _choose(probe.phase == phase, other, ahead)
        return ahead._replace(count=probe.count + 1)

    def _arrived(self, probe: _Probe, here: _Sample, rounding: Scalar) -> _Probe:
        """At the end of the motion: the root that is there, within rounding."""
        zero = _ROUNDING * rounding
        arrives = (
            (jnp.abs(here.value) <= zero)
            & (probe.sign * here.change < -zero)
            & self.counts(probe.sign)
        )
        share = here.share - here.value / jnp.where(arrives, here.change, 1.0)
        return probe._replace(
            phase=jnp.where(arrives, _LAST, _NONE),
            share=share,
            largest=jnp.full_like(zero, jnp.inf),
        )

    def _enclosed(self, probe: _Probe, here: _Sample, crossed: Scalar) -> _Probe:
        """After the step's end: a bracket of a change of sign, or of a turn before one, or the end
        of it.
        """
        largest = jnp.maximum(probe.largest, jnp.abs(here.value))
        probe = probe._replace(largest=largest)
        further = probe._replace(
            share=jnp.ones_like(probe.share) + _BEYOND,
            phase=jnp.where(crossed & (here.share <= 1.0), _END, _NONE),
        )
        turn = probe.between(_TURN, probe.low, here)
        turn = turn._replace(share=_bottom(turn.low, turn.high))
        dips = (probe.sign * probe.low.change < 0) & (probe.sign * here.change > 0)
        ahead = _choose(dips, turn, further)
        root = probe.between(jnp.where(self.counts(probe.sign), _ROOT, _NONE), probe.low, here)
        root = root._replace(share=_inverse(root.low, root.high))
        return _choose(_goes_through(probe.sign, here), root, ahead)

    def _descended(self, probe: _Probe, here: _Sample, rounding: Scalar) -> _Probe:
        """On the way to where a function turns back: a bracket as soon as it is through zero by
        more than rounding, or the end of it where the slope and the bracket's width leave too
        little to fall.
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


def _tasks(search: _Search, inside: Scalar, step: float) -> list[_Task]:
    """What is to follow of each function `inside` the step to look into, and else at the end of the
    motion.
    """
    tasks = []
    for mark, sign, value, rate in zip(
        search.marks, search.signs, search.values, search.rates, strict=True
    ):
        is_near = (sign != 0) & (jnp.abs(value) <= _NEAR_END * jnp.abs(step * rate))
        is_open, sign = (
            jnp.where(inside, mark != 0, is_near),
            jnp.where(inside, jnp.sign(mark), sign),
        )
        tasks.append(_Task(is_open, sign, jnp.abs(mark) > 1))
    return tasks


def _first_probe(phase: Scalar, sign: Scalar) -> _Probe:
    zero = jnp.zeros_like(sign)
    nothing = _Sample(zero, zero, zero)
    return _Probe(phase, zero, nothing, nothing, sign, zero + 1, zero, jnp.zeros_like(phase))


def _begun(probe: _Probe, here: _Sample, rounding: Scalar) -> _Probe:
    largest = jnp.maximum(jnp.abs(here.value), rounding)
    phase, share = jnp.full_like(probe.phase, _END), jnp.ones_like(probe.share)
    return probe._replace(phase=phase, share=share, low=here, largest=largest)


def _within(duration: float, time: Scalar) -> Scalar:
    """A time that rounding may have put behind the end, and its derivative."""
    nearest = jnp.sign(duration) * jnp.minimum(jnp.abs(time), abs(duration))
    return time + lax.stop_gradient(nearest - time)


def _narrowed(probe: _Probe, here: _Sample, rounding: Scalar) -> _Probe:
    """One of Newton's iterations, or where that leaves the bracket or does not halve the move, a
    bisection.

    After the last, one more of Newton's, whose derivative is that of the root.
    """
    height, zero = probe.sign * here.value, jnp.abs(here.value) <= _CLOSE * rounding
    leaves = zero & (probe.sign * here.change > 0)  # the section on which the motion starts
    through = (height <= 0) & ~leaves
    low, high = _choose(through, probe.low, here), _choose(through, here, probe.high)
    flat = here.change == 0
    newton = here.share - here.value / jnp.where(flat, 1.0, here.change)
    last = jnp.abs(newton - here.share)
    inside = (newton >= low.share) & (newton <= high.share) & ~flat & (last <= 0.5 * probe.last)
    share = jnp.where(inside, newton, 0.5 * (low.share + high.share))
    width = high.share - low.share
    close = (zero & ~leaves) | (
        jnp.minimum(width, jnp.where(flat, width, last)) <= _CLOSE * _EPSILON
    )
    end = newton + lax.stop_gradient(jnp.clip(newton, low.share, high.share) - newton)
    return probe._replace(
        phase=jnp.where(close, _LAST, _ROOT),
        share=jnp.where(close, end, share),
        low=low,
        high=high,
        last=jnp.abs(share - here.share),
    )


def _judged(probe: _Probe, here: _Sample, rounding: Scalar) -> _Probe:
    """Whether it is a root: as small as rounding, where the function is larger elsewhere in the
    step, which rounding alone is not, but not smaller, which it is beside a pole; and no jump, that
    is a rise which no slope explains.
    """
    low, high = probe.low, probe.high
    slopes = jnp.abs(low.change) + jnp.abs(high.change) + jnp.abs(here.change)
    rise = jnp.abs(high.value - low.value)
    is_root = jnp.abs(here.value) <= _ROUNDING * (rounding + _EPSILON * jnp.abs(here.change))
    is_root &= (jnp.abs(here.value) <= probe.largest) & (probe.largest > _ROUNDING * rounding)
    is_root &= rise <= _STEEPEST * slopes * (high.share - low.share) + _ROUNDING * rounding
    return probe._replace(phase=jnp.where(is_root, _FOUND, _NONE))


def _goes_through(sign: Scalar, after: _Sample) -> Scalar:
    """Whether the sign has changed; at zero itself the slope tells."""
    return (sign * after.value < 0) | ((after.value == 0) & (sign * after.change < 0))


def _may_turn(start: Scalar, end: Scalar, bend: Scalar) -> Scalar:
    """Whether a function that keeps its sign, taken as positive, may be through zero between: by
    the parabola whose slope is less than its chord's by `bend` at the start and more by as much at
    the end.

    Its bottom lies (bend - rise)^2/(4 bend) below the start, and 1/2 - rise/(2 bend) steps from it.
    """
    rise = end - start
    is_near = jnp.abs(rise) < (1 + 2 * _BESIDE) * bend
    is_low = 2 * bend * (start + end) <= (1 + 8 * _MARGIN) * bend * bend + rise * rise
    return is_near & is_low & (end > 0)


def _bottom(low: _Sample, high: _Sample) -> Scalar:
    """Where the slope is zero if it changes evenly."""
    return low.share + (high.share - low.share) * low.change / (low.change - high.change)


def _inverse(low: _Sample, high: _Sample) -> Scalar:
    """Where a bracketed root lies by the cubic that gives the share as a function of the value;
    where that is not monotonic, by the chord, away from both ends.
    """
    width, rise = high.share - low.share, high.value - low.value
    chord = -low.value / rise
    first, second = rise / (low.change * width), rise / (high.change * width)
    cubic = chord * ((1 - chord) ** 2 * first + chord * (3 - 2 * chord + (chord - 1) * second))
    sound = (first > 0) & (first < 3) & (second > 0) & (second < 3) & (cubic > 0) & (cubic < 1)
    return low.share + width * jnp.where(sound, cubic, jnp.clip(chord, 0.01, 0.99))
