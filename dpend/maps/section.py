"""A section of an energy surface: many motions of one energy, and where each crosses a plane."""

import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dpend._version import __version__
from dpend.checks import Scalar, function, integer, known_number, numbers, shown
from dpend.maps.lanes import launches
from dpend.mechanics.pendulum import Pendulum, State, hamiltonian, known_pendulum
from dpend.mechanics.surface import Plane, check_plane
from dpend.methods.scheme import Scheme, check_scheme, scheme_for
from dpend.motion.crossings import crossings
from dpend.places import file_path, unwritable
from dpend.status import Status

# Wanted error of the angles after two periods of the slow mode [rad]: chaos multiplies it by 1e5
# before a picture shows it, and regular motions stay on their curves for thousands of crossings.
_TOLERANCE = 1e-9
# The plastic number's powers: multiples of them modulo 1 fill a square evenly, each new point in
# the largest gap (the R2 sequence of Martin Roberts, The Unreasonable Effectiveness of
# Quasirandom Sequences, extremelearning.com.au, 2018).
_PLASTIC = 1.3247179572447460
# Points of that sequence that are tried at once, always as many: one compiled program.
_TRIED = 4096
# Crossings that a launch follows, always as many: one compiled program for sections of any length.
_PIECE = 20
# Steps from one crossing to the next: 20 at a tenth of the way from the bottom to the top, 38 with
# both bobs able to reach the pivot's height.
STEPS_A_CROSSING = 40
# A section is refused beyond so many crossings: at 2 million steps a second on each of two cores a
# day.
MOST_CROSSINGS = 1e10


@dataclass(frozen=True)
class _Lane:
    """The next crossings of one motion: a value, so that equal sections share their compiled
    code.
    """

    plane: Plane
    scheme: Scheme

    def __call__(self, pendulum: Pendulum, state: State) -> dict[str, Any]:
        found = crossings(self.plane, pendulum, state, _PIECE, self.scheme)
        side = jnp.nan_to_num(self.plane.side(pendulum, found.state))
        states = jnp.stack(jax.tree.leaves(found.state))
        return {"state": states, "time": found.time, "side": side, "steps": found.steps}


def section(
    pendulum: Pendulum | Any,
    energy: float | Any,
    *,
    plane: Plane | Any | None = None,
    starts: int | Any = 64,
    count: int | Any = 200,
    points: Any | None = None,
    scheme: Scheme | Any | None = None,
    store: str | os.PathLike[str] | Any | None = None,
    progress: Callable[[int, int, int], None] | Any | None = None,
) -> Any:
    """Motions of one energy, and each of their next `count` crossings of a plane.

    The starts fill what the energy allows on the plane evenly, in the measure dq dp that the return
    map preserves; they are on side 1 and do not count as crossings. A crossing at which the plane's
    angle falls (`side` -1) is the mirror image (-q, -p) of one at which it rises, if the plane is
    at 0 or pi. A motion that touches the plane within rounding does not cross it: such points are
    the edge of what is allowed, |p| = `plane.largest_momentum`.

    Arguments:
        pendulum: its parameters.
        energy: H [J], zero for both bobs at rest at the pivot's height.
        plane: which plane is crossed: theta1 = 0 by default.
        starts: how many motions; more of them refine the same ones.
        count: crossings of each.
        points: starts of one's own instead, (angle [rad], momentum [kg m^2/s]) on the plane, shape
            (n, 2).
        scheme: method and step; by default that of `scheme_for(pendulum, 1e-9)`.
        store: a new directory for a Zarr store of the result.
        progress: called with the crossings done, those in all, and the steps taken.
    Returns:
        xarray.Dataset with dimensions `start` and `crossing`: `angle` [rad], within half a turn,
        `momentum`, `time` [s] and `side`; for each start `status` (NONFINITE for one that is not
        allowed, MAX_ITERATIONS for one that crosses no more) and `energy_error`, |H - E| at its
        last crossing [J]; coordinates `start_angle`, `start_momentum`, and angles in degrees.
    Raises:
        ValueError: an energy below that of the plane's lowest state; a start that is no number; a
            store that is there already; more than 1e10 crossings; arguments of other classes.
    """
    pendulum = known_pendulum(pendulum)
    energy = known_number("energy", energy, unit="J")
    plane = known_plane(plane)
    count, starts = integer("count", count), integer("starts", starts)
    each = None if points is None else points_in("points", points)
    place = None if store is None else file_path("store", store)
    if place is not None:
        check_new("store", place)
    if progress is not None:
        function("progress", progress, "(crossings done, crossings in all, steps)", "print")
    _check_size(starts if each is None else len(each), count)
    lane = _Lane(plane, replace(scheme_or(pendulum, scheme, _TOLERANCE), written_out=True))
    if each is None:
        each = fill(pendulum, energy, plane, starts)
    found = _cross(pendulum, energy, lane, each, count, progress)
    dataset = _label(pendulum, energy, lane, each, found)
    if place is not None:
        _write(dataset, place)
    return dataset


def known_plane(plane: Any) -> Plane:
    """The plane that was given, or theta1 = 0."""
    plane = Plane() if plane is None else plane
    check_plane(plane)
    return plane


def scheme_or(pendulum: Pendulum, scheme: Any, tolerance: float) -> Scheme:
    """The scheme that was given, or the one for a tolerance [rad]."""
    if scheme is None:
        return scheme_for(pendulum, tolerance)
    check_scheme(scheme)
    return scheme


def points_in(name: str, points: Any) -> np.ndarray:
    """Points (angle, momentum) of a plane, as an array of shape (n, 2).

    Raises:
        ValueError: another shape; none; a value that is no finite number.
    """
    array = numbers(name, points)
    if array.ndim != 2 or array.shape[1] != 2 or not array.size or not np.all(np.isfinite(array)):
        raise ValueError(
            f"{name} must be pairs of a finite angle and momentum, shape (n, 2), got "
            f"{shown(points)}: give one like [(0.1, 0.0)]"
        )
    return array


def _check_size(starts: int, count: int) -> None:
    if starts * count > MOST_CROSSINGS:
        name, value = ("starts", starts) if starts > count else ("count", count)
        raise ValueError(
            f"{name} must make at most {MOST_CROSSINGS:.0e} crossings, got {value}, which makes "
            f"{starts * count:.3g}: give fewer"
        )


@partial(jax.jit, static_argnums=0)
def _edge(plane: Plane, pendulum: Pendulum, energy: Scalar, angle: Scalar) -> Scalar:
    return plane.largest_momentum(pendulum, energy, angle)


@partial(jax.jit, static_argnums=0)
def _state(
    plane: Plane, pendulum: Pendulum, energy: Scalar, angle: Scalar, momentum: Scalar
) -> State:
    return plane.state(pendulum, energy, angle, momentum)


def fill(pendulum: Pendulum, energy: float, plane: Plane, starts: int) -> np.ndarray:
    """`starts` points that fill what is allowed on a plane evenly, the first ones of a sequence.

    Raises:
        ValueError: the energy allows none.
    """

    def edge(angle: np.ndarray) -> np.ndarray:
        return np.nan_to_num(np.asarray(_edge(plane, pendulum, energy, angle)))

    angles = np.linspace(-np.pi, np.pi, _TRIED)
    edges = edge(angles)
    if not edges.any():
        raise ValueError(
            f"energy must be above the lowest one on {plane}, got {energy:g} J: give a higher one"
        )
    inside = np.flatnonzero(edges)
    ends = angles[[max(inside[0] - 1, 0), min(inside[-1] + 1, angles.size - 1)]]
    found: list[np.ndarray] = []
    first, total = 1, 0
    while total < starts:
        index = first + np.arange(_TRIED)
        square = np.stack([(0.5 + index / _PLASTIC) % 1, (0.5 + index / _PLASTIC**2) % 1])
        angle = ends[0] + (ends[1] - ends[0]) * square[0]
        momentum = edges.max() * (2 * square[1] - 1)
        allowed = np.abs(momentum) < edge(angle)
        found.append(np.stack([angle, momentum], axis=1)[allowed])
        first, total = first + index.size, total + int(allowed.sum())
    return np.concatenate(found)[:starts]


def _cross(
    pendulum: Pendulum,
    energy: float,
    lane: _Lane,
    each: np.ndarray,
    count: int,
    progress: Callable[[int, int, int], None] | None,
) -> dict[str, np.ndarray]:
    """The crossings of all starts, piece by piece, each array of shape (..., starts, count)."""
    start = _state(lane.plane, pendulum, energy, *each.T)
    state, time = jax.tree.map(np.asarray, start), np.zeros(len(each))
    pieces, done, taken = [], 0, 0
    for first in range(0, count, _PIECE):
        wanted = min(_PIECE, count - first)
        parts = []
        for part in launches(lane, pendulum, state, steps=float(STEPS_A_CROSSING * _PIECE)):
            parts.append(part)
            done, taken = done + wanted * part["steps"].size, taken + int(part["steps"].sum())
            if progress is not None:
                progress(done, count * len(each), taken)
        piece = {key: np.concatenate([part[key] for part in parts], -1) for key in parts[0]}
        del piece["steps"]
        state, ahead = State(*piece["state"][:, -1]), time + piece["time"][-1]
        piece["time"] = time + piece["time"]
        time = ahead
        pieces.append({key: np.moveaxis(v, -1, -2)[..., :wanted] for key, v in piece.items()})
    return {key: np.concatenate([piece[key] for piece in pieces], -1) for key in pieces[0]}


def _label(
    pendulum: Pendulum, energy: float, lane: _Lane, each: np.ndarray, found: dict[str, np.ndarray]
) -> Any:
    import xarray

    state, time = State(*found["state"]), found["time"]
    angle, momentum = lane.plane.point(state)
    last = jax.tree.map(lambda leaf: leaf[:, -1], state)
    drift = np.abs(np.asarray(hamiltonian(pendulum, last)) - energy)
    allowed = np.abs(each[:, 1]) <= np.asarray(_edge(lane.plane, pendulum, energy, each[:, 0]))
    ends = ~np.isfinite(time).all(axis=1)
    status = np.where(ends, int(Status.MAX_ITERATIONS), int(Status.CONVERGED))
    status = np.where(allowed, status, int(Status.NONFINITE))
    angle = np.remainder(angle + np.pi, 2 * np.pi) - np.pi
    both, units = ("start", "crossing"), "kg m2 s-1"
    data = {
        "angle": (both, angle, {"units": "rad"}),
        "momentum": (both, momentum, {"units": units}),
        "time": (both, time, {"units": "s"}),
        "side": (both, found["side"].astype(np.int8), {}),
        "energy_error": ("start", drift, {"units": "J"}),
        "status": ("start", status.astype(np.uint8), {}),
    }
    coordinates = {
        "start_angle": ("start", each[:, 0], {"units": "rad"}),
        "start_angle_deg": ("start", np.degrees(each[:, 0]), {"units": "degree"}),
        "start_momentum": ("start", each[:, 1], {"units": units}),
        "angle_deg": (both, np.degrees(angle), {"units": "degree"}),
    }
    return xarray.Dataset(
        data, coordinates, attributes_of(pendulum, energy, lane.plane, lane.scheme)
    )


def attributes_of(
    pendulum: Pendulum, energy: float, plane: Plane, scheme: Scheme
) -> dict[str, Any]:
    """What determines a section's values."""
    return {
        "dpend_version": __version__,
        **{name: float(value) for name, value in vars(pendulum).items()},
        "energy": energy,
        "plane": plane.angle,
        "plane_at": plane.at,
        "method": scheme.name,
        "step": scheme.step,
    }


def check_new(name: str, path: Path) -> None:
    """Refuses, before anything is computed, a store that could not be written after.

    Raises:
        ValueError: it is there already, or no directory to write in.
    """
    reason = "it is there already" if os.path.lexists(path) else unwritable(path)
    if reason:
        raise ValueError(
            f"{name} must be a new name in a directory that can be written to, got {path} "
            f"({reason}): give another place"
        )


def _write(dataset: Any, path: Path) -> None:
    """Writes a store beside its place, and puts it there whole."""
    draft = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        # Whole arrays: the oldest xarray leaves chunks open, and zarr then refuses them.
        whole = {name: {"chunks": one.shape} for name, one in dataset.variables.items() if one.ndim}
        dataset.to_zarr(draft, mode="w", zarr_format=3, consolidated=False, encoding=whole)
        draft.chmod(0o755)
        os.rename(draft, path)
    except BaseException:
        shutil.rmtree(draft, ignore_errors=True)
        raise
