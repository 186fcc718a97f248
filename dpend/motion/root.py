"""A zero of one function inside one step of a motion, to the last bit.

A probe tries the step at other lengths: `share` is the length in units of the step. At each try it
learns the function's value and slope there, and goes from phase to phase:

- ARRIVE, at the end of the motion: LAST where the function is at zero, within rounding, else NONE.
- BEGIN, at the step's start: its value and slope there. END follows.
- END, at the step's end: ROOT where the sign has changed, TURN where the function heads for zero at
  the start and away from it at the end, else NONE.
- TURN: the function turns back between two shares. ROOT once it is through zero by more than
  rounding, NONE once it can fall no further.
- ROOT: Newton's method or bisection makes a bracket of a change of sign smaller. LAST once it is as
  small as rounding.
- LAST: FOUND where it is a root, NONE where it is a jump or a pole.

All phases are computed and one is chosen, because lanes side by side are in different ones.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from dpend.checks import Scalar

EPSILON = float(np.finfo(np.float64).eps)
# A value of so many rounding errors of the state counts as zero.
ROUNDING = 8.0
# A function may turn through zero in a step where its parabola comes down to this share of the
# difference of its slopes at the step's ends; a swing is as deep there as 1/8. The parabola's error
# is some (omega h)/2 of that for a swing of frequency omega: it is seen up to omega h = 0.8.
_MARGIN = 0.05
# The parabola's bottom may lie so many steps beside the step.
_BESIDE = 0.3
# A bracket, a move of Newton's [steps] and a value of so few rounding errors are not bisected
# further: one more of Newton's iterations, which is the last, ends within one or two.
_CLOSE = 4.0
# A rise so many times the slopes at both ends of a bracket and at the root is a jump.
_STEEPEST = 4.0
# A step that crosses in the motion and not when taken again (the circle forms then begin on their
# circle) is lengthened by this share of itself.
_BEYOND = 1 / 64

ARRIVE, BEGIN, END, TURN, ROOT, LAST, FOUND, NONE = range(8)


class Sample(NamedTuple):
    """A function inside a step: where [steps], its value, its change over a step at that rate."""

    share: Scalar
    value: Scalar
    change: Scalar


class Probe(NamedTuple):
    """One function inside one step, with the share to try next.

    The function has `sign` at `low` and, in the phase of the root, the other one at `high`. `last`
    is the length of the last move, `largest` the larger value at the step's ends.
    """

    phase: Scalar
    share: Scalar
    low: Sample
    high: Sample
    sign: Scalar
    last: Scalar
    largest: Scalar
    count: Scalar

    def between(self, phase: Scalar, low: Sample, high: Sample) -> "Probe":
        return self._replace(
            phase=jnp.asarray(phase), low=low, high=high, last=high.share - low.share
        )


def choose(condition: Scalar, this: Any, other: Any) -> Any:
    return jax.tree.map(partial(jnp.where, condition), this, other)


def counts(direction: int, sign: Scalar) -> Scalar:
    """Whether a change from this sign is one that is asked for."""
    return sign != 0 if direction == 0 else sign * direction < 0


def goes_through(sign: Scalar, after: Sample) -> Scalar:
    """Whether the sign has changed; at zero itself the slope tells."""
    return (sign * after.value < 0) | ((after.value == 0) & (sign * after.change < 0))


def may_turn(start: Scalar, end: Scalar, bend: Scalar) -> Scalar:
    """Whether a function that keeps its sign, taken as positive, may be through zero between.

    A parabola tells, whose slope is less than its chord's by `bend` at the start, and more by as
    much at the end.

    Its bottom lies (bend - rise)^2/(4 bend) below the start, and 1/2 - rise/(2 bend) steps from it.
    """
    rise = end - start
    is_near = jnp.abs(rise) < (1 + 2 * _BESIDE) * bend
    is_low = 2 * bend * (start + end) <= (1 + 8 * _MARGIN) * bend * bend + rise * rise
    return is_near & is_low & (end > 0)


def first_probe(phase: Scalar, sign: Scalar) -> Probe:
    zero = jnp.zeros_like(sign)
    nothing = Sample(zero, zero, zero)
    return Probe(phase, zero, nothing, nothing, sign, zero + 1, zero, jnp.zeros_like(phase))


def follow(direction: int, probe: Probe, here: Sample, rounding: Scalar, crossed: Scalar) -> Probe:
    """The probe after one more try.

    Arguments:
        direction: of the changes of sign that count, as for `first_crossing`.
        here: the function at the probe's share.
        rounding: what rounding leaves uncertain of its value.
        crossed: whether the motion's own step changes the sign.
    """
    phases = {
        ARRIVE: _arrive(direction, probe, here, rounding),
        BEGIN: _begin(probe, here, rounding),
        END: _end(direction, probe, here, crossed),
        TURN: _descend(direction, probe, here, rounding),
        ROOT: _narrow(probe, here, rounding),
    }
    ahead = _judge(probe, here, rounding)
    for phase, other in phases.items():
        ahead = choose(probe.phase == phase, other, ahead)
    return ahead._replace(count=probe.count + 1)


def _arrive(direction: int, probe: Probe, here: Sample, rounding: Scalar) -> Probe:
    zero = ROUNDING * rounding
    arrives = (
        (jnp.abs(here.value) <= zero)
        & (probe.sign * here.change < -zero)
        & counts(direction, probe.sign)
    )
    share = here.share - here.value / jnp.where(arrives, here.change, 1.0)
    phase = jnp.where(arrives, LAST, NONE)
    return probe._replace(phase=phase, share=share, largest=jnp.full_like(zero, jnp.inf))


def _begin(probe: Probe, here: Sample, rounding: Scalar) -> Probe:
    largest = jnp.maximum(jnp.abs(here.value), rounding)
    phase, share = jnp.full_like(probe.phase, END), jnp.ones_like(probe.share)
    return probe._replace(phase=phase, share=share, low=here, largest=largest)


def _end(direction: int, probe: Probe, here: Sample, crossed: Scalar) -> Probe:
    probe = probe._replace(largest=jnp.maximum(probe.largest, jnp.abs(here.value)))
    further = probe._replace(
        share=jnp.ones_like(probe.share) + _BEYOND,
        phase=jnp.where(crossed & (here.share <= 1.0), END, NONE),
    )
    turn = probe.between(TURN, probe.low, here)
    turn = turn._replace(share=_bottom(turn.low, turn.high))
    dips = (probe.sign * probe.low.change < 0) & (probe.sign * here.change > 0)
    ahead = choose(dips, turn, further)
    root = probe.between(jnp.where(counts(direction, probe.sign), ROOT, NONE), probe.low, here)
    root = root._replace(share=_inverse(root.low, root.high))
    return choose(goes_through(probe.sign, here), root, ahead)


def _descend(direction: int, probe: Probe, here: Sample, rounding: Scalar) -> Probe:
    height = probe.sign * here.value
    falls = probe.sign * here.change < 0
    low, high = choose(falls, here, probe.low), choose(falls, probe.high, here)
    ahead = probe.between(TURN, low, high)
    middle = 0.5 * (low.share + high.share)
    slow = ahead.last > 0.5 * probe.last
    least = jnp.abs(here.change) * ahead.last  # no slope and width allow a deeper fall
    ahead = ahead._replace(
        share=jnp.where(slow, middle, _bottom(low, high)),
        phase=jnp.where(least > jnp.maximum(height, rounding), TURN, NONE),
    )
    before = probe.between(ROOT, probe.low, here)
    behind = probe.between(ROOT, here, probe.high)._replace(sign=-probe.sign)
    root = choose(counts(direction, probe.sign), before, behind)
    root = root._replace(share=_inverse(root.low, root.high))
    return choose(height < -rounding, root, ahead)


def _narrow(probe: Probe, here: Sample, rounding: Scalar) -> Probe:
    """One of Newton's iterations, or a bisection where Newton's leaves the bracket or does not
    halve the move.

    After the last, one more of Newton's, whose derivative is that of the root.
    """
    height, zero = probe.sign * here.value, jnp.abs(here.value) <= _CLOSE * rounding
    leaves = zero & (probe.sign * here.change > 0)  # the section on which the motion starts
    through = (height <= 0) & ~leaves
    low, high = choose(through, probe.low, here), choose(through, here, probe.high)
    flat = here.change == 0
    newton = here.share - here.value / jnp.where(flat, 1.0, here.change)
    last = jnp.abs(newton - here.share)
    inside = (newton >= low.share) & (newton <= high.share) & ~flat & (last <= 0.5 * probe.last)
    share = jnp.where(inside, newton, 0.5 * (low.share + high.share))
    width = high.share - low.share
    least = jnp.minimum(width, jnp.where(flat, width, last))
    close = (zero & ~leaves) | (least <= _CLOSE * EPSILON)
    end = newton + lax.stop_gradient(jnp.clip(newton, low.share, high.share) - newton)
    return probe._replace(
        phase=jnp.where(close, LAST, ROOT),
        share=jnp.where(close, end, share),
        low=low,
        high=high,
        last=jnp.abs(share - here.share),
    )


def _judge(probe: Probe, here: Sample, rounding: Scalar) -> Probe:
    """Whether it is a root.

    A root is as small as rounding. The function is larger elsewhere in the step, which rounding
    alone is not; beside a pole it is smaller elsewhere. A rise that no slope explains is a jump.
    """
    low, high = probe.low, probe.high
    slopes = jnp.abs(low.change) + jnp.abs(high.change) + jnp.abs(here.change)
    rise = jnp.abs(high.value - low.value)
    is_root = jnp.abs(here.value) <= ROUNDING * (rounding + EPSILON * jnp.abs(here.change))
    is_root &= (jnp.abs(here.value) <= probe.largest) & (probe.largest > ROUNDING * rounding)
    is_root &= rise <= _STEEPEST * slopes * (high.share - low.share) + ROUNDING * rounding
    return probe._replace(phase=jnp.where(is_root, FOUND, NONE))


def _bottom(low: Sample, high: Sample) -> Scalar:
    """Where the slope is zero if it changes evenly."""
    return low.share + (high.share - low.share) * low.change / (low.change - high.change)


def _inverse(low: Sample, high: Sample) -> Scalar:
    """Where a bracketed root lies by the cubic that gives the share as a function of the value;
    where that is not monotonic, by the chord, away from both ends.
    """
    width, rise = high.share - low.share, high.value - low.value
    chord = -low.value / rise
    first, second = rise / (low.change * width), rise / (high.change * width)
    cubic = chord * ((1 - chord) ** 2 * first + chord * (3 - 2 * chord + (chord - 1) * second))
    sound = (first > 0) & (first < 3) & (second > 0) & (second < 3) & (cubic > 0) & (cubic < 1)
    return low.share + width * jnp.where(sound, cubic, jnp.clip(chord, 0.01, 0.99))
