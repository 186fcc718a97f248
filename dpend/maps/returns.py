"""The return map of a section: from a plane back to it, on the same side.

The map takes a point (q, p) of the plane to the next one where the plane's angle moves in the same
sense. It preserves the area dq dp, so the two eigenvalues of its derivative are 1/x and x; half
their sum is kappa, the same as that of the periodic orbit through a fixed point.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from dpend.checks import Scalar, coordinate, one_of, single
from dpend.maps.section import known_plane
from dpend.mechanics.pendulum import Pendulum, State, check_pendulum, vector_field
from dpend.mechanics.surface import Plane
from dpend.methods.scheme import Scheme, check_scheme
from dpend.motion.crossings import crossings, signed_count
from dpend.motion.integrate import fold


class Return(NamedTuple):
    """Where a motion comes back to the plane on the side it left it.

    Attributes:
        angle: the coordinate q [rad], full turns counted.
        momentum: its momentum p [kg m^2/s].
        time: after which it is there [s], negative backwards; infinite if it is not.
        turns: full turns of the plane's own angle.
    """

    angle: Scalar
    momentum: Scalar
    time: Scalar
    turns: Scalar


def return_map(
    pendulum: Pendulum | Any,
    energy: Scalar,
    angle: Scalar,
    momentum: Scalar,
    scheme: Scheme | Any,
    *,
    returns: int | Any = 1,
    plane: Plane | Any | None = None,
    side: int | Any = 1,
) -> Return:
    """The point of a plane at which a motion of this energy is after so many returns.

    `jax.jacfwd` gives its derivative, that of the implicit function theorem, and `jax.vmap` maps it
    over many points. The map preserves area: det d(angle, momentum) = 1.

    Arguments:
        pendulum, energy [J]: numbers or traced.
        angle, momentum: the point (q [rad], p [kg m^2/s]); scalars.
        scheme: method and step.
        returns: how many; negative ones go backwards.
        plane: theta1 = 0 by default.
        side: 1 where the plane's angle rises at the point, -1 where it falls.
    Returns:
        Return; NaN where the energy does not allow the point, or the motion does not return.
    Raises:
        ValueError: returns zero or no integer; side neither 1 nor -1; arrays; arguments of other
            classes.
    """
    check_pendulum(pendulum)
    values = {"energy": (energy, "J"), "angle": (angle, "rad"), "momentum": (momentum, "kg m^2/s")}
    energy, angle, momentum = (coordinate(k, v, unit=unit) for k, (v, unit) in values.items())
    one = {**vars(pendulum), "energy": energy, "angle": angle, "momentum": momentum}
    for name, value in one.items():
        single(name, value)
    plane, side = known_plane(plane), one_of("side", side, (-1, 1))
    returns = signed_count("returns", returns)
    check_scheme(scheme)
    sense = 1 if returns > 0 else -1
    count = jnp.asarray(abs(returns), jnp.float64)
    return _come_back(pendulum, energy, angle, momentum, count, Way(plane, side, sense, scheme))


class Way(NamedTuple):
    """From which side of which plane, in which sense of time and how a motion comes back."""

    plane: Plane
    side: int
    sense: int
    scheme: Scheme


class _Passage(NamedTuple):
    """A motion on the plane, when, and how many returns are left."""

    state: State
    time: Scalar
    left: Scalar


@partial(jax.jit, static_argnums=5)
def _come_back(
    pendulum: Pendulum,
    energy: Scalar,
    angle: Scalar,
    momentum: Scalar,
    returns: Scalar,
    way: Way,
) -> Return:
    state = start_on(pendulum, energy, (angle, momentum), way)
    return go_back(pendulum, state, returns, way)[1]


def start_on(pendulum: Pendulum, energy: Scalar, point: Any, way: Way) -> State:
    start = way.plane.state(pendulum, energy, point[0], point[1], way.side)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), start)


def go_back(pendulum: Pendulum, start: State, returns: Scalar, way: Way) -> tuple[State, Return]:
    """The state after so many returns."""
    plane, side, sense, scheme = way

    def go_on(passage: _Passage) -> _Passage:
        found = crossings(plane, pendulum, passage.state, sense, scheme)
        state = jax.tree.map(lambda leaf: leaf[0], found.state)
        time = passage.time + found.time[0]
        home = plane.side(pendulum, state) == side
        left = jnp.where(jnp.isfinite(time), passage.left - jnp.where(home, 1.0, 0.0), 0.0)
        return _Passage(state, time, left)

    passage = _Passage(start, jnp.zeros_like(start.theta1), returns)
    end = lax.while_loop(lambda passage: passage.left > 0, go_on, passage)
    turns = full_turns(getattr(end.state, plane.angle) - plane.at)
    return end.state, Return(*plane.point(end.state), end.time, turns)


def full_turns(angle: Scalar) -> Scalar:
    return lax.stop_gradient(jnp.round(angle / (2 * jnp.pi)))


def _keep(
    carry: Scalar, time: Scalar, dt: Scalar, state: State, tangents: State
) -> tuple[Scalar, State]:
    """The `update` of a motion of which only the tangents are wanted."""
    return carry, tangents


def slope_of(
    pendulum: Pendulum,
    energy: Scalar,
    point: Scalar,
    state: State,
    end: State,
    time: Scalar,
    way: Way,
) -> Scalar:
    """The map's derivative [[dq'/dq, dq'/dp], [dp'/dq, dp'/dp]] over a motion of known length.

    Tangents of the surface on the plane are carried along by the flow; what they have of the flow's
    own direction at the end takes them back to the plane.
    """
    start = jax.jacfwd(lambda point: start_on(pendulum, energy, point, way))
    _, tangents = fold(
        _keep, jnp.zeros_like(time), pendulum, state, time, way.scheme,
        tangents=start(point),
    )  # fmt: skip
    field = vector_field(pendulum, end)
    late = getattr(tangents, way.plane.angle) / getattr(field, way.plane.angle)
    rows = [
        of - late * rate
        for of, rate in zip(way.plane.point(tangents), way.plane.point(field), strict=True)
    ]
    return jnp.stack(rows)
