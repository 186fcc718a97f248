"""The walk along a family: predictor, corrector and step control, compiled as one program.

`take_step` is one step, or an attempt. Two loops run it: `walk` lists the points of a family, and
`search` looks at each step for a release.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from dpend.checks import Scalar
from dpend.mechanics.linear import equilibria, fast_frequency, normal_modes
from dpend.mechanics.pendulum import Pendulum, momenta
from dpend.orbits.arc import LOG_DELTA, SEGMENTS, Arc
from dpend.orbits.newton import METRIC, ROW, Aim, Solved, correct


def hermite(start: Any, slope: Any, end: Any, end_slope: Any, length: Any, s: Any) -> Any:
    """The cubic through two points with unit tangents, `length` apart, at s in [0, 1]; beyond 1 it
    predicts.
    """
    s2, s3 = s * s, s * s * s
    return (
        (2 * s3 - 3 * s2 + 1) * start
        + (s3 - 2 * s2 + s) * length * slope
        + (3 * s2 - 2 * s3) * end
        + (s3 - s2) * length * end_slope
    )


# The longest step in arclength: a hundred points or so for a family, close enough for cubics to
# show every turn. Every walk takes it, so that a search for a release and a family that pass close
# by another curve go on along the same one.
LONGEST_STEP = 0.1
# The first step from a normal mode, where the linear motion is true to 1e-4.
FIRST_STEP = 0.02
# A step is taken back if the curve turned by more (cosine), or missed its prediction by more (of
# the step's length).
_LEAST_COSINE, _LARGEST_MISS, _WANTED_MISS = 0.95, 0.2, 0.02
# Newton's second update over its first (Deuflhard's contraction test), where they are not both
# small.
_LARGEST_CONTRACTION, _SMALL = 0.05, 1e-5
# Two curves that pass each other closer than this [arclength] count as crossing: the walk goes
# straight on, and tells. Where no step as short is taken, it leaps along the tangent from before
# the curve began to turn into the other; where that does not land either, it is a turn, however
# sharp, and is followed.
CROSSING, _LEAP = 2e-4, 0.01
_LARGEST_LEAP_MISS = 0.3
_SHORTEST_STEP = 1e-8
# The cubic through two points is true to a few thousandths of its length: a root further away than
# this share of it is another orbit.
STRAYED = 0.1
# Points in one call of the compiled walk.
CHUNK = 32


class Walk(NamedTuple):
    """Where a walk stands: its last point, the one before, and what it knows about the next
    step.
    """

    point: Any
    tangent: Any
    behind: Any
    behind_tangent: Any
    length: Any  # between the two, 0 at the start
    step: Any
    side: Any
    steps: Any
    straight: Any  # the last tangent that no curve close by had bent
    leap: Any  # 1 if the next step is one, 2 after one that did not land


def start_at_mode(pendulum: Pendulum, slow: Scalar) -> Walk:
    """A walk at zero amplitude, about to follow the slow or the fast normal mode (natural
    units).
    """
    modes = normal_modes(pendulum)
    mode = jax.tree.map(lambda a, b: jnp.where(slow, a, b), *modes)
    return _start_swinging(pendulum, np.zeros(2), mode.frequency, (1.0, mode.ratio))


def start_at_saddle(pendulum: Pendulum, upper: Scalar) -> Walk:
    """The same about the equilibrium with the upper or the lower rod upright, whose linear motion
    swings in one direction and escapes in the other: theta1 is between 0 and pi at first.
    """
    exponents = equilibria(pendulum).exponents
    frequencies = jnp.max(jnp.imag(exponents), axis=1)
    down_up, up_down = frequencies[1], frequencies[2]
    # theta2/theta1, positive and without cancellation in both.
    ratio = down_up**2 / (1 + down_up**2 * pendulum.l2)
    inverse = pendulum.m2 * up_down**2 * pendulum.l2 / ((1 + pendulum.m2) * (1 + up_down**2))
    direction = jnp.where(upper, -inverse, 1.0), jnp.where(upper, -1.0, ratio)
    centre = jnp.pi * jnp.where(upper, np.array([1.0, 0.0]), np.array([0.0, 1.0]))
    return _start_swinging(pendulum, centre, jnp.where(upper, up_down, down_up), direction)


def _start_swinging(
    pendulum: Pendulum, centre: Any, frequency: Scalar, direction: tuple[Any, Any]
) -> Walk:
    """A walk at an equilibrium, about to follow theta = centre + direction cos(frequency t)."""
    phase = 0.5 * jnp.pi / SEGMENTS * jnp.arange(SEGMENTS, dtype=jnp.float64)
    moving = momenta(pendulum, *centre, *(frequency * x for x in direction))  # at the bottom
    shape = [
        direction[0] * jnp.cos(phase),
        direction[1] * jnp.cos(phase),
        -moving.p1 * jnp.sin(phase),
        -moving.p2 * jnp.sin(phase),
    ]
    tangent = jnp.append(jnp.stack(shape, axis=1).ravel(), jnp.zeros(2))
    tangent = tangent / jnp.sqrt(tangent @ (METRIC * tangent))
    # There the fastest rate is that of the fast mode.
    delta = 0.5 * jnp.pi / frequency * fast_frequency(pendulum) / SEGMENTS
    nodes = jnp.tile(jnp.concatenate([centre, jnp.zeros(2)]), SEGMENTS)
    point = jnp.append(nodes, jnp.stack([jnp.log(delta), 0.0]))
    nothing = jnp.zeros(())
    first, steps = jnp.asarray(FIRST_STEP), jnp.asarray(4)
    return Walk(
        point, tangent, point, tangent, nothing, first, nothing, steps, tangent, jnp.asarray(0)
    )


class Tasks(NamedTuple):
    """Points to be corrected one by one, each in the plane that its row is normal to; `CHUNK` of
    them at most.
    """

    points: Any
    rows: Any
    steps: Any
    number: Any


# Where a family ends: this close to the energy of an equilibrium with a rod upright (in units of
# the weights' torques, the energy's slope in arclength as small), or where it has shrunk to this
# amplitude [rad] about an equilibrium.
HOMOCLINIC, _SMALLEST = 1e-8, 0.01
# ... or where gravity is this small a part of its energy, and the rods turn over freely.
FAST = 100.0
# Orbits that pass an equilibrium on their way are known no better than rounding over the distance
# from its energy: where that has come to the second number [rad], the family has ended at the
# first.
NEARLY, _BLURRED = 1e-6, 1e-8


@jax.jit
def walk(
    pendulum: Pendulum, start: Walk, longest: Scalar, tasks: Tasks, arc: Arc
) -> tuple[Walk, Array, Scalar, Scalar]:
    """Up to `CHUNK` more points of a family, or instead the `tasks`, if there are any.

    One program for both, and for all symmetries: it takes seconds to compile.

    Returns:
        Where the walk stands, a table whose rows are `Solved`, how many there are, and whether
        the family has ended (1), or no step is short enough (2).
    """
    given = tasks.number > 0
    most = jnp.where(given, tasks.number, CHUNK)

    def advance(carry: tuple) -> tuple:
        w, table, count, _ = carry
        task = Aim(tasks.points[count], tasks.rows[count], tasks.steps[count])
        after, new, taken, status = take_step(pendulum, w, longest, arc, (given, task))
        row = jnp.concatenate([jnp.ravel(jnp.asarray(leaf, jnp.float64)) for leaf in new])
        table = table.at[count].set(row)  # a point taken back is overwritten by the next
        return after, table, count + taken.astype(int), status

    def going(carry: tuple) -> Scalar:
        return (carry[2] < most) & (carry[3] == 0)

    begin = (start, jnp.zeros((CHUNK, ROW)), jnp.asarray(0), jnp.asarray(0))
    return lax.while_loop(going, advance, begin)


def take_step(
    pendulum: Pendulum, w: Walk, longest: Scalar, arc: Arc, task: tuple[Scalar, Aim]
) -> tuple[Walk, Solved, Scalar, Scalar]:
    """One step of a walk, or an attempt; or the correction of a task, which leaves the walk as it
    is.

    One corrector serves both: it takes seconds to compile.

    Arguments:
        task: whether there is one, and its aim.
    Returns:
        Where the walk stands then, the point, whether it was taken, and whether the family has
        ended there (1) or no step is short enough (2).
    """
    given, aim = task
    predicted, along = _predict(w)
    here = Aim(predicted, METRIC * along, w.steps)
    new = correct(pendulum, jax.tree.map(partial(jnp.where, given), aim, here), arc)
    after, taken, status = _accept(pendulum, w, new, longest)
    after = jax.tree.map(partial(jnp.where, given), w, after)
    return after, new, taken | given, jnp.where(given, 0, status)


def _predict(w: Walk) -> tuple[Array, Array]:
    """The predicted point, by the cubic if it is not much longer than the last step, and the
    direction it lies in.
    """
    near = (w.step <= 2.1 * w.length) & (w.length > 0) & (w.leap != 1)
    share = 1 + w.step / jnp.where(w.length > 0, w.length, 1.0)
    cubic = hermite(w.behind, w.behind_tangent, w.point, w.tangent, w.length, share)
    along = jnp.where(w.leap == 1, w.straight, w.tangent)
    return jnp.where(near, cubic, w.point + w.step * along), along


def _amplitude(point: Array) -> Scalar:
    """The largest angle from an equilibrium on the arc, as a sine."""
    return jnp.max(jnp.abs(jnp.sin(point[:LOG_DELTA].reshape(SEGMENTS, 4)[:, :2])))


def _accept(
    pendulum: Pendulum, w: Walk, new: Solved, longest: Scalar
) -> tuple[Walk, Scalar, Scalar]:
    """The walk after a step, whether that was taken or taken back, and how the family stands."""
    miss = new.miss / w.step
    leaping = w.leap == 1
    same_side = (new.side == w.side) | (w.side == 0) | (w.step < CROSSING)
    smooth = (new.contraction <= _LARGEST_CONTRACTION) | (new.miss <= _SMALL)
    smooth = jnp.where(
        leaping, miss <= _LARGEST_LEAP_MISS, same_side & smooth & (miss <= _LARGEST_MISS)
    )
    tangent = jnp.where(leaping, w.straight, w.tangent)
    good = new.converged & smooth & ((METRIC * new.tangent) @ tangent >= _LEAST_COSINE)
    taken = good & (2 * new.steps <= 3 * w.steps)
    growth = jnp.clip((_WANTED_MISS / jnp.fmax(miss, 1e-9)) ** 0.25, 0.5, 2.0)
    levels = equilibria(pendulum).energy
    unit = levels[3]  # upright: the weights' torques
    gaps = (new.energy - levels) / unit
    # Not past an equilibrium, where the curve goes on as its own mirror image.
    size, before_size = _amplitude(new.point), _amplitude(w.point)
    shrinking = size < before_size
    longest = jnp.where(shrinking, jnp.minimum(longest, 0.5 * size), longest)
    # A step that is taken back for want of integration steps is repeated with more.
    leap = jnp.where(leaping, 2, jnp.where((w.leap == 0) & (w.step < CROSSING), 1, w.leap))
    shorter = jnp.where(leaping, 0.5 * CROSSING, jnp.where(leap > w.leap, _LEAP, 0.5 * w.step))
    before = w._replace(
        step=jnp.where(good, w.step, shorter),
        steps=jnp.where(good, new.steps, w.steps),
        leap=jnp.where(good, w.leap, leap),
    )
    way = new.point - w.point
    bent = w.step < 10 * CROSSING
    after = Walk(
        point=new.point,
        tangent=new.tangent,
        behind=w.point,
        behind_tangent=w.tangent,
        length=jnp.sqrt(way @ (METRIC * way)),
        step=jnp.minimum(w.step * growth, longest),
        side=new.side,
        steps=new.steps,
        straight=jnp.where(bent, w.straight, new.tangent),
        leap=jnp.where(w.step < 2 * CROSSING, w.leap, 0),
    )
    close = jnp.where(new.release_change > _BLURRED, NEARLY, HOMOCLINIC)
    homoclinic = jnp.any(jnp.abs(gaps[1:]) < close) & (
        jnp.abs(new.energy_slope) < 1e3 * close * unit
    )
    ended = homoclinic | (shrinking & (size < _SMALLEST)) | (new.energy > FAST * unit)
    status = jnp.where(taken & ended, 1, jnp.where(w.step < _SHORTEST_STEP, 2, 0))
    return jax.tree.map(partial(jnp.where, taken), after, before), taken, status
