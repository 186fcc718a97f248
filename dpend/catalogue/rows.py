"""The rows of a scan: what many motions have to make zero, over time, and its slopes in time and in
the angle that tells the motions apart, at even times.

The motions start on a circle. `Releases` are those released from rest at one theta1, told apart by
theta2: p/t is zero where one comes to rest. `Passages` are those of one energy through a place of
{0, pi}^2, told apart by the direction in which they leave: (sin theta1, sin theta2)/t is zero where
one comes to such a place again. Both are odd in time, so that the quotient is smooth and not zero
at t = 0.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from dpend.maps.lanes import over_lanes
from dpend.mechanics.linear import fast_frequency
from dpend.mechanics.pendulum import Pendulum, State, vector_field
from dpend.mechanics.trig import sincos
from dpend.methods.scheme import Scheme

# The stages as a loop: motions are few and of many kinds, and compiling would take longer than all
# of them.
_METHOD = Scheme("rk8-circle", 1.0, written_out=False)
# Rows that one launch computes.
_WINDOW = 64
# The fast mode advances by this between rows [rad], less where motions are faster than releases,
# before a scan makes the rows denser.
_ROW = 0.05
# Releases with the upper rod upright or hanging to within this [rad] share a column of equilibria.
_AT_EQUILIBRIUM = 1e-12


class TooCoarse(Exception):
    """The rows lie too far apart for the motion."""


class Releases(NamedTuple):
    """The motions released from rest at (theta1, angle); all in natural units."""

    pendulum: Pendulum
    theta1: float

    @property
    def turns(self) -> int:
        """How often G goes round zero at t = 0, anticlockwise, as the angle goes round."""
        return 0

    @property
    def faster(self) -> float:
        """The largest speeds, over those of the fastest release."""
        return 1.0

    def rows(self, dt: float, rows: int, angles: np.ndarray, coarse: bool) -> np.ndarray:
        """G of these motions: value, slopes in time and in the angle, and mixed, shape (4, 2, rows
        + 1, n).

        Raises:
            TooCoarse: a row is not finite, unless `coarse` allows it.
        """
        pendulum, theta1 = self.pendulum, self.theta1
        zero = np.zeros_like(angles)
        each = State(zero + theta1, angles, zero, zero), State(zero, zero + 1, zero, zero)
        first = _at_rest(pendulum, theta1, angles)
        unit = np.array([1 + pendulum.m2, pendulum.m2 * pendulum.l2**1.5])
        table = _quotients(_release_window, pendulum, each, (first, unit), (dt, rows, coarse))
        upright = abs(math.sin(theta1)) < _AT_EQUILIBRIUM
        return _without_equilibria(table, angles) if upright else table


class Passages(NamedTuple):
    """The motions that start at pi (n1, n2) with this kinetic energy and the momenta p = sqrt(2 K)
    L (cos angle, sin angle), L L^T being the inertia there; all in natural units.

    `faster`: their largest speeds, over those of the fastest release, or one.
    """

    pendulum: Pendulum
    place: tuple[int, int]
    kinetic: float
    faster: float

    @property
    def turns(self) -> int:
        """As of releases: G is L^-T (cos angle, sin angle) there, but for the signs of the cosines
        of the place.
        """
        return 1 if sum(self.place) % 2 == 0 else -1

    def momenta(self, angles: Any) -> np.ndarray:
        """p by angle, shape (2, ...)."""
        unit = np.stack([np.cos(angles), np.sin(angles)])
        axes = np.linalg.cholesky(self._inertia())
        return np.asarray(math.sqrt(2 * self.kinetic) * np.tensordot(axes, unit, 1))

    def angle(self, momenta: np.ndarray) -> float:
        """The angle of the momenta."""
        x, y = np.linalg.solve(np.linalg.cholesky(self._inertia()), momenta)
        return math.atan2(y, x)

    def _inertia(self) -> np.ndarray:
        m2, l2 = self.pendulum.m2, self.pendulum.l2
        both = m2 * l2 * self.turns
        return np.array([[1 + m2, both], [both, m2 * l2**2]])

    def rows(self, dt: float, rows: int, angles: np.ndarray, coarse: bool) -> np.ndarray:
        """As of releases."""
        zero, (p, across) = np.zeros_like(angles), map(self.momenta, (angles, angles + np.pi / 2))
        place = np.pi * np.array(self.place)
        each = State(zero + place[0], zero + place[1], *p), State(zero, zero, *across)
        first = np.zeros((8, 1, angles.size))  # cos theta theta', and its tangent
        for rows_of, momenta in ((slice(0, 2), p), (slice(4, 6), across)):
            rates = np.linalg.solve(self._inertia(), momenta)
            first[rows_of, 0] = np.cos(place)[:, None] * rates
        start = first, np.ones(2)
        return _quotients(_passage_window, self.pendulum, each, start, (dt, rows, coarse))


# Where the motions of a scan start.
Circle: TypeAlias = Releases | Passages


def rows_for(circle: Circle, duration: float) -> int:
    """How many rows a scan begins with, a whole number of launches."""
    rate = circle.faster * float(fast_frequency(circle.pendulum))
    return _WINDOW * math.ceil(duration * rate / _ROW / _WINDOW)


def _quotients(
    window: Callable[[Any, Any], Any],
    pendulum: Pendulum,
    each: tuple[State, State],
    start: tuple[np.ndarray, np.ndarray],
    grid: tuple[float, int, bool],
) -> np.ndarray:
    """Rows divided by the time.

    Arguments:
        start: the first row, which is divided already, and the units of both components.
        grid: the time between rows, how many rows, and whether they need not be finite.
    """
    (first, unit), (dt, rows, coarse) = start, grid
    shared = jax.tree.map(float, (pendulum, dt))
    parts = [first]
    for _ in range(rows // _WINDOW):
        each, launch = over_lanes(window, shared, each)
        parts.append(np.swapaxes(launch, 0, 1))
    table = np.concatenate(parts, axis=1).reshape(4, 2, rows + 1, -1)
    if not (coarse or np.all(np.isfinite(table))):
        raise TooCoarse
    table /= unit[:, None, None]
    time = dt * np.arange(1, rows + 1)[:, None]
    for value, slope in ((0, 1), (2, 3)):
        table[value, :, 1:] /= time
        table[slope, :, 1:] = (table[slope, :, 1:] - table[value, :, 1:]) / time
    return table


def _release_window(shared: Any, each: Any) -> Any:
    return _window(_momenta, shared, each)


def _passage_window(shared: Any, each: Any) -> Any:
    return _window(_sines, shared, each)


def _momenta(state: State, rate: State) -> Any:
    return jnp.stack([state.p1, state.p2, rate.p1, rate.p2])


def _sines(state: State, rate: State) -> Any:
    (sine1, cosine1), (sine2, cosine2) = sincos(state.theta1), sincos(state.theta2)
    return jnp.stack([sine1, sine2, cosine1 * rate.theta1, cosine2 * rate.theta2])


def _window(
    watched: Callable[[State, State], Any],
    shared: tuple[Pendulum, Any],
    each: tuple[State, State],
) -> tuple[tuple[State, State], Any]:
    """A motion and its tangent after one launch, and its rows: what is watched, two values and
    their slopes in time, and its tangent, shape (_WINDOW, 8).
    """
    pendulum, dt = shared
    constants = _METHOD.constants(pendulum, dt)

    def row(state: State) -> Any:
        return watched(state, vector_field(pendulum, state))

    def step(carry: Any, _: None) -> Any:
        point, tangent = _METHOD.move_tangents(constants, *carry)
        state = _METHOD.leave(constants, point)
        return (point, tangent), jnp.concatenate(jax.jvp(row, (state,), (tangent,)))

    start = _METHOD.enter(pendulum, each[0]), each[1]
    (point, tangent), rows = lax.scan(step, start, None, length=_WINDOW)
    return (_METHOD.leave(constants, point), tangent), rows


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
