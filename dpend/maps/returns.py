"""The return map of a section: from a plane back to it, on the same side; and its periodic points.

The map takes a point (q, p) of the plane to the next one where the plane's angle moves in the same
sense. It preserves the area dq dp, so the two eigenvalues of its derivative are 1/x and x; half
their sum is kappa, the same as that of the periodic orbit through a fixed point.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from dpend.checks import Scalar, coordinate, function, integer, known_number, one_of, single
from dpend.maps.lanes import launches
from dpend.maps.section import (
    STEPS_A_CROSSING,
    attributes_of,
    fill,
    known_plane,
    points_in,
    scheme_or,
)
from dpend.mechanics.pendulum import (
    Pendulum,
    State,
    check_pendulum,
    known_pendulum,
    vector_field,
)
from dpend.mechanics.surface import Plane
from dpend.methods.scheme import Scheme
from dpend.motion.crossings import crossings, signed_count
from dpend.motion.integrate import fold
from dpend.status import Status

# Wanted error of the angles [rad]: that of the shortest step of `scheme_for`. It leaves fixed
# points of the paper's orbits at 40 degrees some 1e-13 from those that shooting finds.
_TOLERANCE = 2e-11
# Newton's iterations, each one motion with its derivative: four or five from near, some twenty from
# far, where steps are halved that lead away.
_MOST_ITERATIONS, _MOST_HALVINGS = 40, 8
# A step of Newton's method is at most so long. Here and below lengths are in angle [rad] and in
# units of the plane's largest momentum.
_LONGEST_MOVE = 0.3
# A point is found where Newton's next step is shorter than the first, and the map misses by less
# than the second, which the rounding of a motion that grows by 1e8 stays below.
_FOUND, _CLOSED = 1e-10, 1e-6
# Points that are nearer to each other are one.
_SAME = 1e-6


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
    *,
    returns: int | Any = 1,
    plane: Plane | Any | None = None,
    side: int | Any = 1,
    scheme: Scheme | Any | None = None,
) -> Return:
    """The point of a plane at which a motion of this energy is after so many returns.

    `jax.jacfwd` gives its derivative, that of the implicit function theorem, and `jax.vmap` maps it
    over many points. The map preserves area: det d(angle, momentum) = 1.

    Arguments:
        pendulum, energy [J]: numbers or traced.
        angle, momentum: the point (q [rad], p [kg m^2/s]); scalars.
        returns: how many; negative ones go backwards.
        plane: theta1 = 0 by default.
        side: 1 where the plane's angle rises at the point, -1 where it falls.
        scheme: by default that of `scheme_for(pendulum, 2e-11)`; to be given where the pendulum is
            traced.
    Returns:
        Return; NaN where the energy does not allow the point, or the motion does not return.
    Raises:
        ValueError: returns zero or no integer; side neither 1 nor -1; arrays; arguments of other
            classes.
    """
    check_pendulum(pendulum)
    values = {"energy": (energy, "J"), "angle": (angle, "rad"), "momentum": (momentum, "kg m^2/s")}
    energy, angle, momentum = (coordinate(k, v, unit=unit) for k, (v, unit) in values.items())
    for name, value in (("energy", energy), ("angle", angle), ("momentum", momentum)):
        single(name, value)
    plane, side = known_plane(plane), one_of("side", side, (-1, 1))
    returns = signed_count("returns", returns)
    scheme = scheme_or(
        pendulum if scheme is not None else known_pendulum(pendulum), scheme, _TOLERANCE
    )
    sense = 1 if returns > 0 else -1
    count = jnp.asarray(abs(returns), jnp.float64)
    return _come_back(pendulum, energy, angle, momentum, count, _Way(plane, side, sense, scheme))


class _Way(NamedTuple):
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
    way: _Way,
) -> Return:
    state = _start(pendulum, energy, (angle, momentum), way)
    return _go_back(pendulum, state, returns, way)[1]


def _start(pendulum: Pendulum, energy: Scalar, point: Any, way: _Way) -> State:
    start = way.plane.state(pendulum, energy, point[0], point[1], way.side)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), start)


def _go_back(pendulum: Pendulum, start: State, returns: Scalar, way: _Way) -> tuple[State, Return]:
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
    turns = _turns(getattr(end.state, plane.angle) - plane.at)
    return end.state, Return(*plane.point(end.state), end.time, turns)


def _turns(angle: Scalar) -> Scalar:
    return lax.stop_gradient(jnp.round(angle / (2 * jnp.pi)))


def _keep(
    carry: Scalar, time: Scalar, dt: Scalar, state: State, tangents: State
) -> tuple[Scalar, State]:
    """The `update` of a motion of which only the tangents are wanted."""
    return carry, tangents


def _slope(
    pendulum: Pendulum,
    energy: Scalar,
    point: Scalar,
    state: State,
    end: State,
    time: Scalar,
    way: _Way,
) -> Scalar:
    """The map's derivative [[dq'/dq, dq'/dp], [dp'/dq, dp'/dp]] over a motion of known length.

    Tangents of the surface on the plane are carried along by the flow; what they have of the flow's
    own direction at the end takes them back to the plane.
    """
    start = jax.jacfwd(lambda point: _start(pendulum, energy, point, way))
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


class _Newton(NamedTuple):
    """A search for a periodic point: the best so far, by how much the map misses it, the map's
    derivative there and the return; the step that is tried next and how often it was halved.
    """

    point: Scalar
    miss: Scalar
    matrix: Scalar
    back: Return
    step: Scalar
    halvings: Scalar
    count: Scalar


@dataclass(frozen=True)
class _Search:
    """Newton's method from one guess: a value, so that equal searches share their compiled code."""

    way: _Way

    def __call__(
        self, shared: tuple[Pendulum, Scalar, Scalar, Scalar, Scalar], guess: tuple[Scalar, Scalar]
    ) -> dict[str, Scalar]:
        pendulum, energy, scale, returns, most = shared

        def look(point: Scalar) -> tuple[Scalar, Scalar, Return]:
            units = jnp.stack([jnp.ones_like(scale), scale])
            state = _start(pendulum, energy, units * point, self.way)
            end, back = _go_back(pendulum, state, returns, self.way)
            slope = _slope(pendulum, energy, units * point, state, end, back.time, self.way)
            there = jnp.stack([back.angle, back.momentum]) / units
            ahead = (there - point).at[0].add(-2 * jnp.pi * _turns(back.angle - point[0]))
            return ahead, slope * units[None] / units[:, None] - jnp.eye(2), back

        start = jnp.stack([guess[0], guess[1] / scale])
        end = lax.while_loop(partial(_goes_on, most), partial(_improve, look), _begin(start))
        period = end.back.time
        far = jnp.max(jnp.abs(_step(end)))
        size = jnp.max(jnp.abs(end.miss))
        return {
            "angle": end.point[0],
            "momentum": scale * end.point[1],
            "next_angle": end.back.angle,
            "next_momentum": end.back.momentum,
            "time": period,
            "turns": end.back.turns,
            "turns_along": _turns(end.back.angle - end.point[0]),
            "kappa": 1.0 + 0.5 * jnp.trace(end.matrix),
            "residual": size,
            "found": (far <= _FOUND) & (size <= _CLOSED),
        }


def _step(search: _Newton) -> Scalar:
    """Newton's step, of at most `_LONGEST_MOVE`; NaN where the derivative is singular."""
    (a, b), (c, d) = search.matrix
    x, y = search.miss
    full = jnp.stack([b * y - d * x, c * x - a * y]) / (a * d - b * c)
    return full * jnp.minimum(1.0, _LONGEST_MOVE / jnp.max(jnp.abs(full)))


def _begin(point: Scalar) -> _Newton:
    """A search that has not looked yet: its first step is none."""
    zero, far = jnp.zeros_like(point[0]), jnp.full_like(point, jnp.inf)
    nowhere = Return(zero, zero, zero + jnp.inf, zero)
    return _Newton(point, far, jnp.zeros((2, 2)), nowhere, 0.0 * point, zero, zero)


def _goes_on(most: Scalar, search: _Newton) -> Scalar:
    goes = (search.halvings < _MOST_HALVINGS) & (search.count < most)
    found = (search.halvings > 0) & (jnp.max(jnp.abs(search.step)) <= _FOUND)
    return goes & ~found & jnp.all(jnp.isfinite(search.step))


def _improve(look: Callable[[Scalar], tuple[Scalar, Scalar, Return]], search: _Newton) -> _Newton:
    """One more of Newton's iterations: a step that makes the miss no smaller is halved."""
    point = search.point + search.step
    miss, matrix, back = look(point)
    better = jnp.max(jnp.abs(miss)) < jnp.max(jnp.abs(search.miss))
    ahead = search._replace(point=point, miss=miss, matrix=matrix, back=back)
    ahead = ahead._replace(step=_step(ahead), halvings=jnp.zeros_like(search.halvings))
    halved = search._replace(step=0.5 * search.step, halvings=search.halvings + 1.0)
    chosen = jax.tree.map(partial(jnp.where, better), ahead, halved)
    return chosen._replace(count=search.count + 1.0)


def periodic_points(
    pendulum: Pendulum | Any,
    energy: float | Any,
    *,
    returns: int | Any = 1,
    plane: Plane | Any | None = None,
    near: Any | None = None,
    starts: int | Any = 128,
    scheme: Scheme | Any | None = None,
    progress: Callable[[int, int], None] | Any | None = None,
) -> Any:
    """The periodic orbits of one energy that meet a plane so many times on side 1, by Newton's
    method on the return map.

    Without `near` the search starts from points that fill the plane, and every orbit it meets that
    closes after `returns` returns and not before is listed once, by its period. Nothing says that
    the list is complete: more starts may find more.

    Arguments:
        pendulum, energy [J], plane: as for `section`.
        returns: after how many returns the orbits close.
        near: guesses (angle [rad], momentum [kg m^2/s]) instead, shape (n, 2): one orbit for each,
            in their order, also where it is met twice, closes earlier or is not found.
        starts: how many points the search starts from, and as many mirror images (-q, p) of them:
            on the planes at 0 and pi these belong to the same motions backwards.
        scheme: by default that of `scheme_for(pendulum, 2e-11)`.
        progress: called with the starts done and those in all.
    Returns:
        xarray.Dataset with dimensions `orbit` and `return`: the points `angle` [rad], within half a
        turn, and `momentum`, in the order in which the orbit meets them; for each orbit `period`
        [s], `kappa` (half the trace of the map's derivative: elliptic below 1 in size, hyperbolic
        above), `returns` (the least number after which it closes; `period` and `kappa` are those of
        `returns` as asked for), `turns` and `turns_along` (full turns of the plane's angle and of
        the other one over the period), `residual` (what the map misses, in rad and in units of the
        plane's largest momentum) and `status`.
    Raises:
        ValueError: as `section`; returns no positive integer.
    """
    pendulum = known_pendulum(pendulum)
    energy = known_number("energy", energy, unit="J")
    plane = known_plane(plane)
    returns, starts = integer("returns", returns), integer("starts", starts)
    given = None if near is None else points_in("near", near)
    if progress is not None:
        function("progress", progress, "(starts done, starts in all)", "print")
    way = _Way(plane, 1, 1, scheme_or(pendulum, scheme, _TOLERANCE))
    spread = fill(pendulum, energy, plane, starts)
    scale = float(np.max(np.abs(spread[:, 1])))
    mirrored = np.concatenate([spread, spread * np.array([-1.0, 1.0])])
    guesses = mirrored if given is None else given
    search = _Searches(pendulum, energy, scale, way)
    rows = search.run(guesses, returns, _MOST_ITERATIONS, progress)
    if given is None:
        rows = {key: value[rows["found"] > 0] for key, value in rows.items()}
    points = search.points(rows, returns)
    least = _least(points, returns)
    if given is None:
        chosen = _distinct(points, rows["time"], least == returns)
        rows = {key: value[chosen] for key, value in rows.items()}
        points, least = points[chosen], least[chosen]
    points = points * np.array([1.0, scale])
    return _label(rows, points, least, attributes_of(pendulum, energy, plane, way.scheme))


class _Searches(NamedTuple):
    """Newton's method from many guesses on one energy surface, lane by lane."""

    pendulum: Pendulum
    energy: float
    scale: float
    way: _Way

    def run(
        self,
        guesses: np.ndarray,
        returns: int,
        most: int,
        progress: Callable[[int, int], None] | None = None,
    ) -> dict[str, np.ndarray]:
        """What comes of each guess in at most so many iterations."""
        shared = self.pendulum, self.energy, self.scale, returns, most
        steps = 6.0 * STEPS_A_CROSSING * returns * most
        pieces, done = [], 0
        for piece in launches(_Search(self.way), shared, tuple(guesses.T), steps=steps):
            pieces.append(piece)
            done += piece["angle"].size
            if progress is not None:
                progress(done, len(guesses))
        return {key: np.concatenate([piece[key] for piece in pieces]) for key in pieces[0]}

    def points(self, rows: dict[str, np.ndarray], returns: int) -> np.ndarray:
        """All points of each orbit in units of 1 rad and of `scale`, shape (orbits, returns, 2):
        a search of one iteration looks at the map, and goes nowhere.
        """
        found = [np.column_stack([rows["angle"], rows["momentum"]])]
        for _ in range(1, returns if len(found[0]) else 1):
            there = self.run(found[-1], 1, 1)
            found.append(np.column_stack([there["next_angle"], there["next_momentum"]]))
        points = np.stack(found, axis=1) / np.array([1.0, self.scale])
        points[..., 0] = _wrapped(points[..., 0])
        return points


def _wrapped(angle: np.ndarray) -> np.ndarray:
    return np.remainder(angle + np.pi, 2 * np.pi) - np.pi


def _apart(this: np.ndarray, other: np.ndarray) -> np.ndarray:
    """How far points are from each other, the larger of both coordinates."""
    ahead = this - other
    return np.maximum(np.abs(_wrapped(ahead[..., 0])), np.abs(ahead[..., 1]))


def _least(points: np.ndarray, returns: int) -> np.ndarray:
    """After how many returns each orbit closes first."""
    least = np.full(len(points), returns)
    for k in reversed(range(1, returns)):
        if returns % k == 0:
            least[_apart(points[:, k], points[:, 0]) < _SAME] = k
    return least


def _distinct(points: np.ndarray, period: np.ndarray, wanted: np.ndarray) -> list[int]:
    """Which orbits are wanted, each once, by their period."""
    chosen: list[int] = []
    for i in np.argsort(period, kind="stable"):
        known = any(np.min(_apart(points[j], points[i, 0])) < _SAME for j in chosen)
        if wanted[i] and not known:
            chosen.append(int(i))
    return chosen


def _label(
    rows: dict[str, np.ndarray],
    points: np.ndarray,
    least: np.ndarray,
    attributes: dict[str, Any],
) -> Any:
    import xarray

    status = np.where(rows["found"] > 0, int(Status.CONVERGED), int(Status.MAX_ITERATIONS))
    lost = ~np.isfinite(rows["residual"])
    status = np.where(lost, int(Status.NONFINITE), status).astype(np.uint8)
    both = ("orbit", "return")
    data = {
        "angle": (both, points[..., 0], {"units": "rad"}),
        "momentum": (both, points[..., 1], {"units": "kg m2 s-1"}),
        "period": ("orbit", rows["time"], {"units": "s"}),
        "kappa": ("orbit", rows["kappa"], {}),
        "returns": ("orbit", least, {}),
        "turns": ("orbit", rows["turns"], {}),
        "turns_along": ("orbit", rows["turns_along"], {}),
        "residual": ("orbit", rows["residual"], {}),
        "status": ("orbit", status, {}),
    }
    degrees = {"angle_deg": (both, np.degrees(points[..., 0]), {"units": "degree"})}
    return xarray.Dataset(data, degrees, attributes)
