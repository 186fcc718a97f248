"""The rows of a scan: p/t of many releases, and its slopes in time and theta2, at even times."""

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from dpend.maps.lanes import over_lanes
from dpend.mechanics.linear import fast_frequency
from dpend.mechanics.pendulum import Pendulum, State, vector_field
from dpend.methods.scheme import Scheme

# The stages as a loop: motions are few and of many kinds, and compiling would take longer than all
# of them.
_METHOD = Scheme("rk8-circle", 1.0, written_out=False)
# Rows that one launch computes.
_WINDOW = 64
# The fast mode advances by this between rows [rad], before a scan makes the rows denser.
_ROW = 0.05
# Releases with the upper rod upright or hanging to within this [rad] share a column of equilibria.
_AT_EQUILIBRIUM = 1e-12


class TooCoarse(Exception):
    """The rows lie too far apart for the motion."""


def rows_for(pendulum: Pendulum, duration: float) -> int:
    """How many rows a scan begins with, a whole number of launches."""
    return _WINDOW * math.ceil(duration * float(fast_frequency(pendulum)) / _ROW / _WINDOW)


def release_rows(
    pendulum: Pendulum, theta1: float, dt: float, rows: int, theta2: np.ndarray, coarse: bool
) -> np.ndarray:
    """G of the motions released at (theta1, theta2): value, slopes in time and theta2, and mixed,
    shape (4, 2, rows + 1, n).

    Raises:
        TooCoarse: a row is not finite, unless `coarse` allows it.
    """
    zero = np.zeros_like(theta2)
    each = State(zero + theta1, theta2, zero, zero), State(zero, zero + 1, zero, zero)
    shared = jax.tree.map(float, (pendulum, dt))
    parts = [_at_rest(pendulum, theta1, theta2)]
    for _ in range(rows // _WINDOW):
        each, launch = over_lanes(_window, shared, each)
        parts.append(np.swapaxes(launch, 0, 1))
    table = np.concatenate(parts, axis=1).reshape(4, 2, rows + 1, -1)
    if not (coarse or np.all(np.isfinite(table))):
        raise TooCoarse
    table /= np.array([1 + pendulum.m2, pendulum.m2 * pendulum.l2**1.5])[:, None, None]
    time = dt * np.arange(1, rows + 1)[:, None]
    for value, slope in ((0, 1), (2, 3)):
        table[value, :, 1:] /= time
        table[slope, :, 1:] = (table[slope, :, 1:] - table[value, :, 1:]) / time
    upright = abs(math.sin(theta1)) < _AT_EQUILIBRIUM
    return _without_equilibria(table, theta2) if upright else table


def _window(
    shared: tuple[Pendulum, Any], each: tuple[State, State]
) -> tuple[tuple[State, State], Any]:
    """A motion and its tangent after one launch, and its rows: p, p' and their tangents, shape
    (_WINDOW, 8).
    """
    pendulum, dt = shared
    constants = _METHOD.constants(pendulum, dt)

    def step(carry: Any, _: None) -> Any:
        point, tangent = _METHOD.move_tangents(constants, *carry)
        return (point, tangent), _row(pendulum, _METHOD.leave(constants, point), tangent)

    start = _METHOD.enter(pendulum, each[0]), each[1]
    (point, tangent), rows = lax.scan(step, start, None, length=_WINDOW)
    return (_METHOD.leave(constants, point), tangent), rows


def _row(pendulum: Pendulum, state: State, tangent: State) -> Any:
    rate, change = jax.jvp(partial(vector_field, pendulum), (state,), (tangent,))
    return jnp.stack(
        [state.p1, state.p2, rate.p1, rate.p2, tangent.p1, tangent.p2, change.p1, change.p2]
    )


def _at_rest(pendulum: Pendulum, theta1: float, theta2: np.ndarray) -> np.ndarray:
    """The rows at t = 0 as G has them there: p/t tends to p', whose slope in time vanishes; shape
    (8, 1, n).
    """
    force1 = -(pendulum.m1 + pendulum.m2) * pendulum.g * pendulum.l1 * math.sin(theta1)
    force2 = -pendulum.m2 * pendulum.g * pendulum.l2
    zero = np.zeros_like(theta2)
    rows = [
        zero + force1,
        force2 * np.sin(theta2),
        zero,
        zero,
        zero,
        force2 * np.cos(theta2),
        zero,
        zero,
    ]
    return np.stack(rows)[:, None]


def _without_equilibria(table: np.ndarray, theta2: np.ndarray) -> np.ndarray:
    """G/sin(theta2), for theta1 in {0, pi}: there G vanishes at both equilibria whatever the time,
    and is odd about them, so that its slope takes its place and the slope's vanishes.
    """
    sine, cosine = np.sin(theta2), np.cos(theta2)
    still = np.abs(sine) < _AT_EQUILIBRIUM
    divisor = np.where(still, 1.0, sine)
    values, slopes = table[:2], table[2:]
    with np.errstate(all="ignore"):
        new_values = np.where(still, slopes / cosine, values / divisor)
        new_slopes = np.where(still, 0.0, (slopes - new_values * cosine) / divisor)
    return np.concatenate([new_values, new_slopes])
