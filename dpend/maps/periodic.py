"""The periodic orbits of one energy, as periodic points of the return map of a section."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from dpend.checks import Scalar, function, integer, known_number
from dpend.maps.lanes import launches
from dpend.maps.returns import Return, Way, full_turns, go_back, slope_of, start_on
from dpend.maps.section import (
    STEPS_A_CROSSING,
    attributes_of,
    fill,
    known_plane,
    points_in,
    scheme_or,
)
from dpend.mechanics.pendulum import Pendulum, known_pendulum
from dpend.mechanics.surface import Plane
from dpend.methods.scheme import Scheme
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

    way: Way

    def __call__(
        self, shared: tuple[Pendulum, Scalar, Scalar, Scalar, Scalar], guess: tuple[Scalar, Scalar]
    ) -> dict[str, Scalar]:
        pendulum, energy, scale, returns, most = shared

        def look(point: Scalar) -> tuple[Scalar, Scalar, Return]:
            units = jnp.stack([jnp.ones_like(scale), scale])
            state = start_on(pendulum, energy, units * point, self.way)
            end, back = go_back(pendulum, state, returns, self.way)
            slope = slope_of(pendulum, energy, units * point, state, end, back.time, self.way)
            there = jnp.stack([back.angle, back.momentum]) / units
            ahead = (there - point).at[0].add(-2 * jnp.pi * full_turns(back.angle - point[0]))
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
            "turns_along": full_turns(end.back.angle - end.point[0]),
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
        starts: how many points that fill the plane the search starts from; as many each are their
            mirror images (-q, p) and on the lines q = 0 and q = pi, where on the planes at 0 and pi
            symmetric orbits cross.
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
    way = Way(plane, 1, 1, scheme_or(pendulum, scheme, _TOLERANCE))
    spread = fill(pendulum, energy, plane, starts)
    scale = float(np.max(np.abs(spread[:, 1])))
    guesses = _guesses(spread, scale) if given is None else given
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


def _guesses(spread: np.ndarray, scale: float) -> np.ndarray:
    """Points that fill the plane, their mirror images (-q, p), and as many on the lines q = 0 and
    q = pi: on the planes at 0 and pi these are the lines that mirror images share, and the orbits
    that are their own mirror images cross them.
    """
    heights = scale * np.linspace(-1.0, 1.0, len(spread) + 2)[1:-1]
    lines = [np.column_stack([np.full_like(heights, q), heights]) for q in (0.0, np.pi)]
    return np.concatenate([spread, spread * np.array([-1.0, 1.0]), *lines])


class _Searches(NamedTuple):
    """Newton's method from many guesses on one energy surface, lane by lane."""

    pendulum: Pendulum
    energy: float
    scale: float
    way: Way

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
