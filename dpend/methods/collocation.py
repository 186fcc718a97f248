"""One step of collocation at eight nodes, one vector lane each, with a companion for its error.

With theta'' = f(theta, theta') (Lagrange's equations) a step of length h from (theta, w) solves

    f_i = f(theta + h c_i w + h^2 sum_j A2_ij f_j,  w + h sum_j A_ij f_j),   i = 1 ... 8,

by fixed-pair sweeps that evaluate all nodes at once; A and A2 integrate the polynomial through the
f_j once and twice. Row 0 of every array has Gauss's nodes, order 16, and is the solution. Row 1, in
the same vector instructions, is the companion: Lobatto's nodes, order 14, without a share of the
last sweep, from a start a fraction of a rounding away. Whatever magnifies errors magnifies the
difference of the rows too: it is the error estimate. The sums of angles and rates keep what
rounding takes from them (compensated summation).

Angles in rad; time in any unit in which the motion's rates are about one.
"""

from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from dpend.checks import Scalar
from dpend.mechanics.trig import sincos
from dpend.methods.nodes import NODES, TABLES

# Sweeps of one step: fewer than two leave the companion's guess in the estimate; a step that takes
# more than so many is too long, as the changes then fall by less than a factor of five each.
_LEAST_SWEEPS, _MOST_SWEEPS = 2, 16
# The turn of a rod in one step [rad], for which the polynomials below hold up to 2.
_LARGEST_TURN = 1.9
# The last coefficient of the accelerations is held at this power of the change at which sweeps end,
# times this factor: steps and sweeps then take about the same time at tolerances from 1e-3 to
# 1e-12.
_TAIL_POWER, _TAIL_FACTOR = 0.43, 6.0
# A step whose last coefficient is so many times larger is taken back.
_TOO_LARGE = 20.0
# From one step to the next the length changes by these factors at most.
_SHORTER, _LONGER = 0.5, 1.5
# No step is longer, in units in which the fastest motion at the start turns by 1 to 2 rad: a motion
# near rest has no last coefficient that would bound its steps.
_LONGEST_STEP = 2.0
# The companion goes without this share of its last sweep, the solution with all of it: what sweeps
# still lack is less, as long as each change is at most a sixth of the one before.
_LAG = np.array([[0.0], [0.2]])
# The rows' errors may have one sign and hide in their difference: the estimate is so many
# differences.
_CAUTION = 1.6
# Beyond this difference [rad] the companion tells nothing of the solution's next powers.
_PARTED = 1e-3
# What a saved state within the step lacks [rad], if the last coefficient of the accelerations is
# one: it falls like three powers more.
_MISSING = 2e-8

# sin(d)/d and cos(d) in powers of d^2 for |d| <= 2: Chebyshev interpolation, errors 1.6e-16 and
# 1.2e-16.
_SIN = (
    1.0, -0.16666666666666602, 0.00833333333332908, -0.00019841269840177272, 2.7557319083381837e-06,
    -2.505209821591484e-08, 1.6058611394867645e-10, -7.636428141277171e-13, 2.667127048441237e-15,
)  # fmt: skip
_COS = (
    1.0, -0.49999999999999994, 0.041666666666666345, -0.001388888888887849, 2.4801587299896475e-05,
    -2.755731906601836e-07, 2.0876747998956077e-09, -1.1470428756318817e-11, 4.7727170677565235e-14,
    -1.481728731207381e-16,
)  # fmt: skip
# Where changes are looked at, (row, node): the last nodes are the last to settle, and one alone may
# stand still by chance. At rest the solution stands still for ever, and a companion that never
# settled would grow.
_LOOKED_AT = ((0, NODES - 1), (1, NODES - 4))
_ONE = int(np.float64(1.0).view(np.int64))


class Field(NamedTuple):
    """The constants of Lagrange's equations."""

    mass: Scalar  # m2/m1
    length: Scalar  # l1/l2
    weight: Scalar  # g/l1, in units of the time squared


class Pair(NamedTuple):
    """The two solutions at the end of a step, arrays (angle, row), and what the next step needs."""

    time: Scalar
    h: Scalar  # the next step's length
    angles: Any
    rates: Any
    angle_rests: Any  # what rounding has taken from the sums
    rate_rests: Any
    guess: Any  # the next step's accelerations in powers of (t - its start)/h, (angle, power)


class Step(NamedTuple):
    """A step that was tried: the pair after it, and what the saved states and the estimate take
    from it.
    """

    pair: Pair
    good: Scalar  # where not, `pair` is the one before, with a shorter step
    h: Scalar  # the length that was tried
    values: Any  # accelerations at the nodes, (angle, row, node)
    series: Any  # their coefficients in powers of (t - end)/h, to the ninth, (angle, power)
    gap: Scalar  # the larger difference of the two solutions' angles at the end
    missing: Scalar  # what a saved state within the step lacks [rad]


class _Round(NamedTuple):
    """Accelerations theta1'' + i theta2'' (row, node), those of the sweep before, the last change,
    and the count.

    They are complex because XLA fuses what has one result into one block of vector code.
    """

    values: Any
    before: Any
    change: Scalar
    count: Scalar


def _sum(terms: list[Any]) -> Any:
    """A sum of eight as a tree, whose chain of additions is three long."""
    a, b, c, d, e, f, g, h = terms
    return ((a + b) + (c + d)) + ((e + f) + (g + h))


def integrate(columns: Any, values: Any) -> Any:
    """The products of tables, given by columns (node, row, ...), with values (..., row, node)."""
    return _sum([columns[j] * values[..., j, None] for j in range(NODES)])


def over_step(weights: Any, values: Any) -> Any:
    products = weights * values
    return _sum([products[..., j] for j in range(NODES)])


def _sincos_near(d: Any) -> tuple[Any, Any]:
    """Sine and cosine for |d| <= 2, by Estrin's scheme."""
    z = d * d
    z2 = z * z
    z4 = z2 * z2

    def four(c: tuple[float, ...], k: int) -> Any:
        return (c[k] + c[k + 1] * z) + (c[k + 2] + c[k + 3] * z) * z2

    sine = (four(_SIN, 0) + four(_SIN, 4) * z4) + _SIN[8] * (z4 * z4)
    cosine = (four(_COS, 0) + four(_COS, 4) * z4) + (_COS[8] + _COS[9] * z) * (z4 * z4)
    return d * sine, cosine


def eighth_root(x: Scalar) -> Scalar:
    """x^(1/8) within one percent: an eighth of the exponent's bits, the mantissa following."""
    bits = lax.bitcast_convert_type(x, jnp.int64)
    return lax.bitcast_convert_type(_ONE + ((bits - _ONE) >> 3), jnp.float64)


def accelerations(field: Field, first: tuple, second: tuple) -> tuple[Any, Any]:
    """theta1'', theta2'' by Cramer's rule, from (sine, cosine, rate) of each rod.

    (1 + mu) a1 + (mu/lambda) c a2 = -(mu/lambda) s w2^2 - (1 + mu) k sin theta1
     lambda c a1 +            a2 = lambda (s w1^2 - k sin theta2),
    mu = m2/m1, lambda = l1/l2, k = g/l1, and c, s of theta1 - theta2.
    """
    (s1, c1, w1), (s2, c2, w2) = first, second
    heavy, pull = 1.0 + field.mass, field.mass / field.length
    sine, cosine = s1 * c2 - c1 * s2, c1 * c2 + s1 * s2
    right1 = -pull * (sine * (w2 * w2)) - heavy * field.weight * s1
    right2 = sine * (w1 * w1) - field.weight * s2
    inverse = 1.0 / (1.0 + field.mass * (sine * sine))
    a1 = (right1 - field.mass * (cosine * right2)) * inverse
    return a1, field.length * (heavy * right2 - cosine * right1) * inverse


def _sweep(field: Field, h: Scalar, rates: Any, trig: tuple, last: _Round) -> _Round:
    """The accelerations at all nodes from those before."""
    h2, old = h * h, last.values
    rods = []
    for i, f in enumerate((old.real, old.imag)):
        w, s0, c0 = rates[i, :, None], trig[0][i, :, None], trig[1][i, :, None]
        sine, cosine = _sincos_near(h * TABLES.nodes * w + h2 * integrate(TABLES.second, f))
        rate = w + h * integrate(TABLES.first, f)
        rods.append((s0 * cosine + c0 * sine, c0 * cosine - s0 * sine, rate))
    new = lax.complex(*accelerations(field, *rods))
    changes = [new[row, node] - old[row, node] for row, node in _LOOKED_AT]
    change = jnp.max(jnp.stack([jnp.abs(x) for c in changes for x in (c.real, c.imag)]))
    return _Round(new, old, change, last.count + 1)


def _summed(sums: Any, rests: Any, change: Any) -> tuple[Any, Any]:
    """Sums and rests after another term (Neumaier's compensated summation for small terms)."""
    change = change + rests
    total = sums + change
    return total, (sums - total) + change


def solve(field: Field, pair: Pair, stop: Scalar) -> _Round:
    """Sweeps until the angles would change by less than `stop` [rad]."""
    sine, cosine = sincos(pair.angles)
    trig = sine + cosine * pair.angle_rests, cosine - sine * pair.angle_rests
    enough = stop / (pair.h * pair.h)

    def goes_on(r: _Round) -> Scalar:
        return ((r.change > enough) & (r.count < _MOST_SWEEPS)) | (r.count < _LEAST_SWEEPS)

    # From the solution's own polynomial: at an equilibrium it stays there to the last bit.
    guess = lax.complex(
        *_sum([pair.guess[:, k, None, None] * TABLES.node_powers[k] for k in range(NODES)])
    )
    sweep = partial(_sweep, field, pair.h, pair.rates, trig)
    return lax.while_loop(
        goes_on, sweep, _Round(guess, guess, jnp.asarray(jnp.inf), jnp.asarray(0))
    )


def step(field: Field, end: Scalar, stop: Scalar, pair: Pair) -> Step:
    """One step, taken back where it was too long; `end` is the time at which the last one ends.

    Arguments:
        stop: the change of the angles [rad] at which sweeps end; the step's length follows from it.
    """
    h = pair.h
    rounds, tail = solve(field, pair, stop), tail_of(stop)
    values, before = (jnp.stack([z.real, z.imag]) for z in (rounds.values, rounds.before))
    f = values - _LAG * (values - before)
    within = h * h * over_step(TABLES.ends[1], f) + h * pair.rate_rests
    turned = within + h * pair.rates
    angles, angle_rests = _summed(pair.angles, pair.angle_rests, turned)
    rates, rate_rests = _summed(pair.rates, pair.rate_rests, h * over_step(TABLES.ends[0], f))
    series = integrate(TABLES.powers, f)
    sizes = jnp.maximum(jnp.abs(series[0, 0]), jnp.abs(series[1, 0])) * (h * h)
    few = (rounds.count < _MOST_SWEEPS) & (jnp.max(jnp.abs(turned)) < _LARGEST_TURN)
    good = few & (sizes[7] <= _TOO_LARGE * tail)
    ahead = jnp.maximum(sizes[7], jnp.maximum(0.6 * sizes[6], 0.36 * sizes[5]))
    time = jnp.where(h >= end - pair.time, end, pair.time + h)
    after = Pair(time, h, angles, rates, angle_rests, rate_rests, series[:, 0])
    chosen = Pair(*(jnp.where(good, new, old) for new, old in zip(after, pair, strict=True)))
    gap = _CAUTION * jnp.max(jnp.abs(angles[:, 0] - angles[:, 1]))
    return Step(
        _scaled(chosen, good, tail / ahead, end),
        good,
        h,
        f,
        _longer(series, gap),
        gap,
        _MISSING * ahead * eighth_root(ahead) ** 3,
    )


def _longer(series: Any, gap: Scalar) -> Any:
    """The series with two more powers, from how far the last coefficients of the rows are apart.

    About the step's middle the eighth power changes the sixth coefficient, and the ninth the
    seventh.
    """
    sixth, seventh = series[:, 1, 6] - series[:, 0, 6], series[:, 1, 7] - series[:, 0, 7]
    a8 = (sixth - 3.5 * seventh) * (1.0 / TABLES.apart[0])
    a9 = seventh * (1.0 / TABLES.apart[1])
    more = a8[:, None] * TABLES.lacking[0] + a9[:, None] * TABLES.lacking[1]
    more = jnp.where(gap < _PARTED, more, 0.0)
    return jnp.pad(series[:, 0], ((0, 0), (0, 2))) + more


def _scaled(pair: Pair, good: Scalar, room: Scalar, end: Scalar) -> Pair:
    """The pair with the next step's length, and the guess in its units."""
    factor = jnp.where(good, jnp.clip(eighth_root(room), _SHORTER, _LONGER), _SHORTER)
    left, wanted = end - pair.time, jnp.minimum(factor * pair.h, _LONGEST_STEP)
    last = wanted >= left * (1 - 1e-12)
    # The length that the sum of times makes of it: times then are exact.
    h = jnp.where(last, left, (pair.time + wanted) - pair.time)
    r = h / pair.h
    r2 = r * r
    r4 = r2 * r2
    powers = [jnp.ones_like(r), r, r2, r2 * r, r4, r4 * r, r4 * r2, r4 * (r2 * r)]
    return pair._replace(h=h, guess=pair.guess * jnp.stack(powers))


def tail_of(stop: Scalar) -> Scalar:
    """The size at which steps hold the last coefficient of the accelerations, times the step
    squared [rad].
    """
    return _TAIL_FACTOR * stop**_TAIL_POWER


def start(angles: Any, rates: Any, h: Scalar, away: Any) -> Pair:
    """The pair at t = 0, shape (2,) each; the companion's is moved by `away`, angles and rates (2,
    2).
    """
    both = (
        jnp.stack([angles, angles + away[0]], axis=1),
        jnp.stack([rates, rates + away[1]], axis=1),
    )
    none = jnp.zeros((2, 2))
    return Pair(jnp.asarray(0.0), h, *both, none, none, jnp.zeros((2, NODES)))
