"""Derivatives of a motion by collocation: the variational equation on the motion's own steps.

Its solution is the matrix of each saved state's derivatives by the start and the pendulum. A
tangent is a product with that matrix. The product is linear in the tangent, so JAX transposes it:
reverse mode costs what forward mode costs. Second derivatives are refused.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from dpend.checks import Scalar
from dpend.mechanics.trig import sincos
from dpend.methods.collocation import Field, Pair, accelerations, integrate, over_step, step
from dpend.methods.nodes import NODES, TABLES
from dpend.motion.adaptive import (
    Saved,
    goes_on,
    one_after_another,
    run,
    save,
    start_pair,
    values_at,
)

# Sweeps of the variational equation end at this share of the largest derivative, or after so many.
_LINEAR_STOP, _MOST_LINEAR_SWEEPS = 1e-14, 60
_POWER = np.arange(float(NODES))
_UNKNOWNS = 7  # angles, rates, and the field's constants


class _Beside(NamedTuple):
    """A motion with its derivatives by the start and the field's constants along the first axis."""

    pair: Pair
    angles: Any  # (7, 2)
    rates: Any
    guess: Any  # (7, 2, power)
    rows: Any  # (7, 4, times)
    next: Scalar
    steps: Scalar


def _slopes(field: Field, angles: Any, rates: Any) -> Any:
    """Derivatives of both accelerations at the nodes, (unknown, acceleration, node); no part of the
    custom rule.
    """

    def at(th1: Any, th2: Any, w1: Any, w2: Any, *constants: Any) -> Any:
        (s1, c1), (s2, c2) = sincos(th1), sincos(th2)
        return jnp.stack(accelerations(Field(*constants), (s1, c1, w1), (s2, c2, w2)))

    ones = jnp.ones(NODES)
    spread = (*angles, *rates, *(ones * constant for constant in field))
    unit = jnp.eye(_UNKNOWNS)[:, :, None] * ones
    return jax.vmap(lambda *tangents: jax.jvp(at, spread, tangents)[1])(*unit.swapaxes(0, 1))


def _linear(slopes: Any, h: Scalar, beside: _Beside) -> Any:
    """The derivatives' accelerations at the nodes, (unknown, acceleration, node), by sweeps as of
    the motion's.
    """
    first, second = TABLES.first[:, 0], TABLES.second[:, 0]
    forced = jnp.concatenate([jnp.zeros((4, 2, NODES)), slopes[4:]])
    from_start = beside.angles[..., None] + h * TABLES.nodes[0] * beside.rates[..., None]

    def sweep(carried: tuple) -> tuple:
        old, _, count = carried
        angles = from_start + (h * h) * integrate(second, old)
        rates = beside.rates[..., None] + h * integrate(first, old)
        new = forced + (
            (slopes[0] * angles[:, :1] + slopes[1] * angles[:, 1:])
            + (slopes[2] * rates[:, :1] + slopes[3] * rates[:, 1:])
        )
        change = jnp.max(jnp.abs(new[..., -1] - old[..., -1]))
        return new, change / jnp.max(jnp.abs(new)), count + 1

    def on(carried: tuple) -> Scalar:
        return (carried[1] > _LINEAR_STOP) & (carried[2] < _MOST_LINEAR_SWEEPS)

    guess = integrate(TABLES.node_powers[:, 0], beside.guess)
    return lax.while_loop(on, sweep, (guess, jnp.asarray(jnp.inf), jnp.asarray(0)))[0]


def _beside(field: Field, times: Any, end: Scalar, stop: Scalar, beside: _Beside) -> _Beside:
    """One step of the motion and of its derivatives."""
    before = beside.pair
    taken = step(field, end, stop, before)
    h, good = taken.h, taken.good
    f, nodes = taken.values[:, 0], TABLES.nodes[0]
    first, second = TABLES.first[:, 0], TABLES.second[:, 0]
    at = before.angles[:, :1] + (h * nodes * before.rates[:, :1] + (h * h) * integrate(second, f))
    speed = before.rates[:, :1] + h * integrate(first, f)
    df = _linear(_slopes(field, at, speed), h, beside)
    weights = TABLES.ends[:, 0]
    angles = beside.angles + h * (beside.rates + h * over_step(weights[1], df))
    rates = beside.rates + h * over_step(weights[0], df)
    series = integrate(TABLES.powers[:, 0], df)

    def values(x: Any) -> Any:
        return values_at(x, h, angles, rates, series)

    rows, following = save(times, good, h, taken.pair.time, values, (beside.rows, beside.next))
    r = taken.pair.h / h
    angles, rates = jnp.where(good, angles, beside.angles), jnp.where(good, rates, beside.rates)
    guess = jnp.where(good, series, beside.guess) * r**_POWER
    return _Beside(
        taken.pair, angles, rates, guess, rows, following, beside.steps + good.astype(float)
    )


@one_after_another
def _sensitivities(
    begin: Any, constants: Any, times: Any, end: Scalar, stop: Scalar, most_steps: Scalar
) -> Any:
    field, none = Field(*constants), jnp.asarray(0)
    unit = jnp.eye(_UNKNOWNS)
    first = _Beside(
        start_pair(begin, end, stop), unit[:, :2], unit[:, 2:4], jnp.zeros((_UNKNOWNS, 2, NODES)),
        jnp.zeros((_UNKNOWNS, 4, times.size)), none, jnp.asarray(0.0),
    )  # fmt: skip
    last = lax.while_loop(
        lambda beside: goes_on(end, most_steps, beside.pair, beside.steps),
        partial(_beside, field, times, end, stop),
        first,
    )
    return last.rows


@jax.custom_jvp
def sensitivities(
    begin: Any, constants: Any, times: Any, end: Scalar, stop: Scalar, most_steps: Scalar
) -> Any:
    """Derivatives of angles and rates at all times by the start and the constants, (7, 4, n).

    Raises:
        ValueError: a derivative of the derivatives is asked for.
    """
    return _sensitivities(begin, constants, times, end, stop, most_steps)


@sensitivities.defjvp
def _refuse(primals: tuple, tangents: tuple) -> tuple[Any, Any]:
    raise ValueError(
        "tolerance must not be given where second derivatives are taken, got a second derivative "
        "of a motion for a tolerance: give a step"
    )


@jax.custom_jvp
def natural_motion(
    begin: Any, constants: Any, times: Any, end: Scalar, tolerance: Scalar, most_steps: Scalar
) -> Saved:
    """The motion in natural time, at times from zero upwards, eight infinities behind them.

    Arguments:
        begin: angles and rates, shape (4,).
        constants: those of `Field`, shape (3,).
        end: the last time.
    """
    return run(begin, constants, times, end, tolerance, most_steps)


@natural_motion.defjvp
def _natural_jvp(primals: tuple, tangents: tuple) -> tuple[Saved, Saved]:
    begin, constants, times, end, _, most_steps = primals
    saved = natural_motion(*primals)
    matrix = sensitivities(begin, constants, times, end, saved.stop, most_steps)
    along = jnp.concatenate([tangents[0], tangents[1]])
    sine, cosine = sincos(saved.angles)
    rods = [(sine[i], cosine[i], saved.rates[i]) for i in range(2)]
    slopes = jnp.stack([*saved.rates, *accelerations(Field(*constants), *rods)])
    later = jnp.where(jnp.isfinite(times), tangents[2], 0.0)
    change = jnp.einsum("ckn,c->kn", matrix, along) + slopes * later
    zeros = jax.tree.map(jnp.zeros_like, saved)
    return saved, zeros._replace(angles=change[:2], rates=change[2:])
