"""A section of an energy surface: many motions of one energy, and where each crosses a plane."""

import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dpend.checks import Scalar, integer, known_number, numbers, shown
from dpend.maps.lanes import launches
from dpend.mechanics.pendulum import Pendulum, hamiltonian, known_pendulum
from dpend.mechanics.surface import Plane, check_plane
from dpend.methods.scheme import Scheme, check_scheme, scheme_for
from dpend.motion.crossings import crossings
from dpend.places import file_path, unwritable
from dpend.status import Status

# Wanted error of the angles after two periods of the slow mode [rad]: chaos multiplies it by 1e5
# before a picture shows it, and regular motions stay on their curves for thousands of crossings.
_TOLERANCE = 1e-9
# The plastic number's powers: multiples of them modulo 1 fill a square evenly, each new point in
# the largest gap (the R2 sequence, Roberts 2018).
_PLASTIC = 1.3247179572447460
# Steps from one crossing to the next, about: it tells how many motions a launch takes.
_STEPS_A_CROSSING = 50


@dataclass(frozen=True)
class _Lane:
    """The crossings of one motion: a value, so that equal sections share their compiled code."""

    plane: Plane
    count: int
    scheme: Scheme

    def __call__(
        self, shared: tuple[Pendulum, Scalar], start: tuple[Scalar, Scalar]
    ) -> dict[str, Scalar]:
        pendulum, energy = shared
        state = self.plane.state(pendulum, energy, *start)
        found = crossings(self.plane, pendulum, state, self.count, self.scheme)
        angle, momentum = self.plane.point(found.state)
        side = jnp.nan_to_num(self.plane.side(pendulum, found.state))
        last = jax.tree.map(lambda leaf: leaf[-1], found.state)
        drift = hamiltonian(pendulum, last) - energy
        return {
            "angle": angle,
            "momentum": momentum,
            "time": found.time,
            "side": side,
            "energy_error": jnp.abs(drift),
            "steps": found.steps.astype(jnp.float64),
        }


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

    The starts fill what the energy allows on the plane evenly: (q, p) is their measure, the one
    that the return map preserves. A crossing at which the angle's velocity is negative is the
    mirror image of one at which it is positive: `side` tells which. A motion that only touches the
    plane does not cross it; touching points are the edge of what is allowed, |p| =
    `plane.largest_momentum`.

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
        progress: called with the motions done, those in all, and the steps taken.
    Returns:
        xarray.Dataset with dimensions `start` and `crossing`: `angle` [rad], within half a turn,
        `momentum`, `time` [s] and `side`; for each start `status` (NONFINITE for one that is not
        allowed, MAX_ITERATIONS for one that crosses no more) and `energy_error`, |H - E| at its
        last crossing [J]; coordinates `start_angle`, `start_momentum`.
    Raises:
        ValueError: an energy below that of the plane's lowest state; a start that is no number; a
            store that is there already; arguments of other classes.
    """
    pendulum = known_pendulum(pendulum)
    energy = known_number("energy", energy, unit="J")
    plane = Plane() if plane is None else plane
    check_plane(plane)
    scheme = replace(_scheme(pendulum, scheme), written_out=True)
    lane = _Lane(plane, integer("count", count), scheme)
    place = None if store is None else file_path("store", store)
    if place is not None:
        _check_new(place)
    starts = integer("starts", starts)
    each = _fill(pendulum, energy, plane, starts) if points is None else _points(points)
    pieces, done, taken = [], 0, 0
    steps = float(_STEPS_A_CROSSING * lane.count)
    for piece in launches(lane, (pendulum, energy), tuple(each.T), steps=steps):
        pieces.append(piece)
        done, taken = done + piece["steps"].size, taken + int(piece["steps"].sum())
        if progress is not None:
            progress(done, len(each), taken)
    found = {key: np.concatenate([piece[key] for piece in pieces], -1).T for key in pieces[0]}
    dataset = _label(pendulum, energy, lane, each, found)
    if place is not None:
        _write(dataset, place)
    return dataset


def _scheme(pendulum: Pendulum, scheme: Any) -> Scheme:
    if scheme is None:
        return scheme_for(pendulum, _TOLERANCE)
    check_scheme(scheme)
    return scheme


def _points(points: Any) -> np.ndarray:
    array = numbers("points", points)
    if array.ndim != 2 or array.shape[1] != 2 or not array.size or not np.all(np.isfinite(array)):
        raise ValueError(
            f"points must be pairs of a finite angle and momentum, shape (n, 2), got "
            f"{shown(points)}: give one like [(0.1, 0.0)]"
        )
    return array


def _fill(pendulum: Pendulum, energy: float, plane: Plane, starts: int) -> np.ndarray:
    """`starts` points that fill what is allowed on a plane evenly, the first ones of a sequence."""
    edge = jax.jit(plane.largest_momentum)
    angles = np.linspace(-np.pi, np.pi, 1025)
    edges = np.nan_to_num(np.asarray(edge(pendulum, energy, angles)))
    if not edges.any():
        raise ValueError(
            f"energy must be above the lowest one on {plane}, got {energy:g} J: give a higher one"
        )
    inside = np.flatnonzero(edges)
    ends = angles[[max(inside[0] - 1, 0), min(inside[-1] + 1, angles.size - 1)]]
    found: list[np.ndarray] = []
    first, total = 1, 0
    while total < starts:
        index = first + np.arange(4 * starts)
        square = np.stack([(0.5 + index / _PLASTIC) % 1, (0.5 + index / _PLASTIC**2) % 1])
        angle = ends[0] + (ends[1] - ends[0]) * square[0]
        momentum = edges.max() * (2 * square[1] - 1)
        with np.errstate(invalid="ignore"):
            allowed = np.abs(momentum) < np.asarray(edge(pendulum, energy, angle))
        found.append(np.stack([angle, momentum], axis=1)[allowed])
        first, total = first + index.size, total + int(allowed.sum())
    return np.concatenate(found)[:starts]


def _label(
    pendulum: Pendulum, energy: float, lane: _Lane, each: np.ndarray, found: dict[str, np.ndarray]
) -> Any:
    import xarray

    from dpend._version import __version__

    ends = np.isinf(found["time"]).any(axis=1)
    edge = np.asarray(lane.plane.largest_momentum(pendulum, energy, each[:, 0]))
    status = np.where(ends, int(Status.MAX_ITERATIONS), int(Status.CONVERGED))
    status = np.where(np.abs(each[:, 1]) <= edge, status, int(Status.NONFINITE))
    both = ("start", "crossing")
    data = {
        "angle": (both, np.remainder(found["angle"] + np.pi, 2 * np.pi) - np.pi, {"units": "rad"}),
        "momentum": (both, found["momentum"], {"units": "kg m2 s-1"}),
        "time": (both, found["time"], {"units": "s"}),
        "side": (both, found["side"].astype(np.int8), {}),
        "energy_error": ("start", found["energy_error"], {"units": "J"}),
        "status": ("start", status.astype(np.uint8), {}),
    }
    coordinates = {
        "start_angle": ("start", each[:, 0], {"units": "rad"}),
        "start_momentum": ("start", each[:, 1], {"units": "kg m2 s-1"}),
    }
    attributes = {
        "dpend_version": __version__,
        **{name: float(value) for name, value in vars(pendulum).items()},
        "energy": energy,
        "plane": lane.plane.angle,
        "plane_at": lane.plane.at,
        "method": lane.scheme.name,
        "step": lane.scheme.step,
    }
    return xarray.Dataset(data, coordinates, attributes)


def _check_new(path: Path) -> None:
    """Refuses, before anything is computed, a store that could not be written after."""
    reason = "it is there already" if os.path.lexists(path) else unwritable(path)
    if reason:
        raise ValueError(
            f"store must be a new name in a directory that can be written to, got {path} "
            f"({reason}): give another place"
        )


def _write(dataset: Any, path: Path) -> None:
    """Writes a store beside its place, and puts it there whole."""
    draft = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        dataset.to_zarr(draft, mode="w", zarr_format=3, consolidated=False)
        draft.chmod(0o755)
        os.rename(draft, path)
    except BaseException:
        shutil.rmtree(draft, ignore_errors=True)
        raise
