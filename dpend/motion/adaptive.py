"""A motion by collocation that chooses its steps: saved states with their error estimates.

`run` saves at given times, `run_steps` at the ends of steps. Both trace in every argument, and one
program makes all tries for a tolerance. Under `vmap` motions run one after the other, each with
its own steps: one step fills the vector lanes by itself.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap

from dpend.checks import Scalar
from dpend.methods.collocation import Field, Pair, Step, eighth_root, start, step, tail_of
from dpend.methods.nodes import NODES
from dpend.motion.estimate import EPS

# The companion starts this share of a rounding away from the solution, in angles and rates. The
# start counts as the number that it is; sums are compensated, so a step's own roundings are less.
# Half a rounding, for the same number of wrong motions among those passed, doubles the right ones
# among those refused (2400 releases on the whole square, 1e-12 to 1e-9 rad).
_AWAY = 0.25 * EPS * np.array([[1.0, -0.7], [0.6, -0.8]])
# The change at which sweeps of the first try end, for a tolerance of one.
_FIRST_STOP = 0.01
# Sweeps that end at a smaller change only shuffle roundings. Of the same releases 12 of 1977 passed
# are wrong, and 62 of 423 refused are right; at 3e-16 it is 20 and 60.
_FINEST = 1e-16
# The next try is finer than its error asks for by this factor.
_FINER = 0.3
# No estimate is less than so many roundings of the larger angle.
_LEAST = 4.0 * EPS
# Chaotic motions take two tries at most times; the last is made at `_FINEST`.
_MOST_TRIES = 6
# The first step in natural time, for a last coefficient of one.
_FIRST_STEP = 0.25
# A motion that takes shorter steps is lost [natural time].
_SHORTEST_STEP = 1e-9


def one_after_another(function: Any) -> Any:
    """Has `vmap` run a function in a loop over its batch, each call with loops of its own length.

    JAX's `sequential_vmap` refuses the batches that second derivatives make, in which nothing is
    batched.
    """
    mapped = custom_vmap(function)

    @mapped.def_vmap
    def rule(size: int, batched: list, *arguments: Any) -> tuple:
        flags, (leaves, tree) = jax.tree.leaves(batched), jax.tree.flatten(arguments)
        many = [leaf for leaf, flag in zip(leaves, flags, strict=True) if flag]

        def one(some: list) -> Any:
            rest = iter(some)
            picked = [
                next(rest) if flag else leaf for leaf, flag in zip(leaves, flags, strict=True)
            ]
            return mapped(*jax.tree.unflatten(tree, picked))

        out = lax.map(one, many) if many else function(*arguments)
        return out, jax.tree.map(lambda _: bool(many), out)

    return mapped


class _Along(NamedTuple):
    """What moves along a motion."""

    pair: Pair
    rows: Any  # theta1, theta2, theta1', theta2', estimate [, time]: a column for each saved state
    next: Scalar  # the first column not yet filled
    worst: Scalar
    steps: Scalar


Keep = Callable[[_Along, Step, Scalar], tuple[Any, Scalar]]


class _Try(NamedTuple):
    """A try that has come to its end, and what the next one takes."""

    rows: Any
    next: Scalar
    worst: Scalar
    reached: Scalar
    steps: Scalar
    stop: Scalar
    next_stop: Scalar
    count: Scalar
    done: Scalar


class Saved(NamedTuple):
    """The saved states of a motion in natural time."""

    angles: Any  # (2, n)
    rates: Any  # (2, n)
    error: Any  # estimate of the larger angle's error at each saved state, (n,)
    worst: Scalar  # the estimate at the worst step
    reached: Scalar  # the time until which the motion is known
    steps: Scalar
    stop: Scalar  # the change at which sweeps ended


class Steps(NamedTuple):
    """States at the ends of steps, in natural time."""

    saved: Saved
    times: Any  # (room,)
    count: Scalar  # how many there are: more than `room` where the table was too small


def start_pair(begin: Any, end: Scalar, stop: Scalar) -> Pair:
    angles, rates = begin[:2], begin[2:]
    sizes = jnp.stack([jnp.maximum(1.0, jnp.abs(angles)), jnp.abs(rates)])
    h = jnp.minimum(_FIRST_STEP * eighth_root(tail_of(stop)), end)
    return start(angles, rates, h, _AWAY * sizes)


def values_at(x: Any, h: Scalar, angles: Any, rates: Any, series: Any) -> Any:
    """Angles and rates at x = (t - end)/h <= 0 from a step's series, shape (2 m, times)."""
    power = np.arange(float(series.shape[-1]))
    twice, once = series / ((power + 1) * (power + 2)), series / (power + 1)
    second = first = jnp.zeros((*series.shape[:-1], x.size))
    for j in reversed(range(power.size)):
        second, first = second * x + twice[..., j, None], first * x + once[..., j, None]
    at = angles[..., None] + x * (h * rates[..., None] + (h * h) * x * second)
    return jnp.concatenate([at, rates[..., None] + (h * x) * first], axis=-2)


def save(times: Any, good: Scalar, h: Scalar, time: Scalar, values: Any, carried: tuple) -> tuple:
    """Rows and the next time after a step. It saves eight times at a go.

    What it writes beyond the step's end the next step writes again.
    """

    def some(carried: tuple) -> tuple:
        rows, following = carried
        x = (lax.dynamic_slice_in_dim(times, following, NODES) - time) / h
        new = values(jnp.minimum(x, 0.0))  # finite also at the infinities behind the last time
        zero = (jnp.asarray(0),) * (rows.ndim - 1)
        rows = lax.dynamic_update_slice(rows, new, (*zero, following))
        return rows, following + jnp.sum(x <= 0.0)

    def more(carried: tuple) -> Scalar:
        return good & (lax.dynamic_index_in_dim(times, carried[1], keepdims=False) <= time)

    return lax.while_loop(more, some, carried)


def _save_times(times: Any, along: _Along, taken: Step, worst: Scalar) -> tuple:
    """Rows and the next column after a step, for saved times."""
    pair = taken.pair

    def values(x: Any) -> Any:
        at = values_at(x, taken.h, pair.angles[:, 0], pair.rates[:, 0], taken.series)
        return jnp.concatenate([at, jnp.where(x < 0.0, worst + taken.missing, worst)[None]])

    return save(times, taken.good, taken.h, pair.time, values, (along.rows, along.next))


def _save_step(every: Scalar, end: Scalar, along: _Along, taken: Step, worst: Scalar) -> tuple:
    """The same for the end of every `every`-th step, and of the last."""
    pair = taken.pair
    column = jnp.concatenate([pair.angles[:, 0], pair.rates[:, 0], jnp.stack([worst, pair.time])])
    rows = lax.dynamic_update_slice(along.rows, column[:, None], (jnp.asarray(0), along.next))
    wanted = ((along.steps + 1.0) % every == 0.0) | (pair.time >= end)
    return rows, along.next + (taken.good & wanted).astype(int)


def _advance(field: Field, end: Scalar, keep: Keep, stop: Scalar, along: _Along) -> _Along:
    taken = step(field, end, stop, along.pair)
    worst = jnp.where(taken.good, jnp.maximum(along.worst, taken.gap), along.worst)
    rows, following = keep(along, taken, worst)
    steps = along.steps + taken.good.astype(float)
    return _Along(taken.pair, rows, following, worst, steps)


def goes_on(end: Scalar, most_steps: Scalar, pair: Pair, steps: Scalar) -> Scalar:
    lost = (pair.h < _SHORTEST_STEP) & (pair.h < end - pair.time)
    return (pair.time < end) & ~lost & (steps < most_steps)


def _adapt(
    field: Field, begin: Any, end: Scalar, wish: tuple[Scalar, Scalar], keep: Keep, rows: Any
) -> _Try:
    """Tries with ever smaller changes until the estimate is below the tolerance.

    A try that passes the tolerance at a share of the way ends there. Its error has grown from that
    of a step, and is taken to grow at the same rate on the rest of the way. The last try goes on to
    the end.

    Arguments:
        wish: tolerance [rad], and how many steps a try takes at most.
        rows: the empty table.
    """
    tolerance, most_steps = wish
    none, zero = jnp.asarray(0), jnp.asarray(0.0)
    least = _LEAST * jnp.maximum(1.0, jnp.max(jnp.abs(begin[:2])))

    def again(last: _Try) -> _Try:
        stop, count = last.next_stop, last.count + 1
        final = (stop <= _FINEST) | (count >= _MOST_TRIES)
        limit = jnp.where(final, jnp.inf, tolerance)
        along = lax.while_loop(
            lambda a: goes_on(end, most_steps, a.pair, a.steps) & (a.worst <= limit),
            partial(_advance, field, end, keep, stop),
            _Along(start_pair(begin, end, stop), rows, none, least, zero),
        )
        reached = along.pair.time
        met = (reached == end) & (along.worst <= tolerance)
        full = (along.steps >= most_steps) & (along.worst <= limit)
        next_stop = tolerance * (_FINER * stop / tolerance) ** (end / reached)
        next_stop = jnp.fmax(_FINEST, next_stop)
        return _Try(
            along.rows, along.next, along.worst, reached, along.steps, stop, next_stop, count,
            met | final | full,
        )  # fmt: skip

    stop = jnp.maximum(_FIRST_STOP * tolerance, _FINEST)
    first = _Try(rows, none, zero, zero, zero, stop, stop, none, jnp.asarray(False))
    last: _Try = lax.while_loop(lambda t: ~t.done, again, first)
    return last


@one_after_another
def run(
    begin: Any, constants: Any, times: Any, end: Scalar, tolerance: Scalar, most_steps: Scalar
) -> Saved:
    """States at `times`, which increase from zero or more and have eight infinities behind them.

    Arguments:
        begin: angles and rates, shape (4,).
        constants: those of `Field`, shape (3,).
        end: the time at which the motion ends.
    """
    empty = jnp.full((5, times.size), jnp.nan)
    keep = partial(_save_times, times)
    best = _adapt(Field(*constants), begin, end, (tolerance, most_steps), keep, empty)
    # Behind the last state that was saved lie what its step wrote ahead.
    rows = jnp.where(jnp.arange(times.size) < best.next, best.rows, jnp.nan)
    # A motion of no duration takes no step that could save its beginning.
    beginning = jnp.append(begin, best.worst)[:, None]
    best = best._replace(rows=jnp.where((times == 0.0) & jnp.isnan(rows), beginning, rows))
    error = jnp.nan_to_num(best.rows[4], nan=0.0)
    worst = jnp.max(jnp.where(error > best.worst, error, best.worst))
    return _saved(best, worst)


def run_steps(
    begin: Any, constants: Any, end: Scalar, wish: tuple[Scalar, Scalar], every: Scalar, room: int
) -> Steps:
    """States at the ends of every `every`-th step and of the last one, in `room` columns."""
    keep = partial(_save_step, every, end)
    empty = jnp.full((6, room), jnp.nan)
    best = _adapt(Field(*constants), begin, end, wish, keep, empty)
    return Steps(_saved(best, best.worst), best.rows[5], best.next)


def _saved(best: _Try, worst: Scalar) -> Saved:
    rows = best.rows
    return Saved(rows[:2], rows[2:4], rows[4], worst, best.reached, best.steps, best.stop)
