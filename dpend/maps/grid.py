"""A grid of states and pendulums, its tiles and coordinates, and the quantity that is computed in
each cell.
"""

import hashlib
import inspect
import json
import tokenize
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import jax
import numpy as np

from dpend.checks import Scalar, known_number, numbers, shown
from dpend.mechanics.pendulum import Pendulum, State, hamiltonian, known_pendulum
from dpend.methods.scheme import Scheme
from dpend.status import Status

# (pendulum, state, scheme) -> named scalars.
Quantity = Callable[[Pendulum, State, Scheme], Mapping[str, Scalar]]

# Cells along the side of a tile: 65536 cells make a file of some 500 kB for each value, and a
# second or so of work.
_TILE = 256
_UNITS = {
    **dict.fromkeys(("l1", "l2"), "m"),
    **dict.fromkeys(("m1", "m2"), "kg"),
    "g": "m s-2",
    **dict.fromkeys(("theta1", "theta2"), "rad"),
    **dict.fromkeys(("p1", "p2"), "kg m2 s-1"),
    **dict.fromkeys(("lyapunov", "exponent", "uncertainty"), "s-1"),
    "flip_time": "s",
}
# The name of the steps of both passes, for the rate: no part of the result.
TAKEN = "steps taken"
STATE = tuple(field.name for field in fields(State))
PENDULUM = tuple(field.name for field in fields(Pendulum))


@dataclass(frozen=True)
class Keyed:
    """A quantity that equals any other of the same function and settings, so that compiled code is
    found again.
    """

    function: Quantity
    arguments: tuple[Any, ...]
    keywords: tuple[tuple[str, Any], ...]

    @staticmethod
    def of(quantity: Quantity) -> "Keyed":
        if not callable(quantity):
            raise ValueError(
                f"quantity must be a function, got {quantity!r}: give one of dpend.chaos, or your "
                f"own"
            )
        if not isinstance(quantity, partial):
            return Keyed(quantity, (), ())
        keyed = Keyed(quantity.func, quantity.args, tuple(sorted(quantity.keywords.items())))
        try:
            hash(keyed)
        except TypeError:
            raise ValueError(
                f"quantity must have settings that can be hashed, got {shown(quantity.keywords)}: "
                "give a tuple for a list"
            ) from None
        return keyed

    def __call__(self, *args: Any) -> Mapping[str, Scalar]:
        return self.function(*self.arguments, *args, **dict(self.keywords))

    def identity(self, name: str | None, strict: bool) -> dict[str, str]:
        """Module, name, keywords and a hash of the source.

        Raises:
            ValueError: with `strict`, a lambda or closure without a name, or settings that text
                cannot hold.
        """
        inner = inspect.unwrap(self.function)
        own = getattr(inner, "__qualname__", type(inner).__qualname__)
        try:
            source = inspect.getsource(inner)
        except (OSError, TypeError, SyntaxError, tokenize.TokenError):
            source = ""  # another file stands where it was written
        if strict and name is None:
            if "<" in own or getattr(inner, "__closure__", None):
                raise ValueError(
                    f"name must be given to store a lambda or a closure, got {own}: say what it "
                    f"computes"
                )
            if not inspect.isfunction(inner) or not source:  # two of them would look alike
                raise ValueError(
                    f"name must be given to store a quantity that is no function in a file, got "
                    f"{own}: say what it "
                    "computes"
                )
        try:
            settings = json.dumps([self.arguments, dict(self.keywords)], allow_nan=False)
        except (TypeError, ValueError):
            if strict and name is None:
                raise ValueError(
                    f"name must be given to store a quantity with settings that are no plain "
                    f"numbers or text, "
                    f"got {dict(self.keywords)}: say what it computes"
                ) from None
            settings = "see the name"
        return {
            "quantity": name or f"{getattr(inner, '__module__', '')}.{own}",
            "quantity_settings": settings,
            "quantity_source_sha256": hashlib.sha256(source.encode()).hexdigest(),
        }


@dataclass(frozen=True)
class Grid:
    """The cells: fields of the state or the pendulum along one or two axes, the rest fixed."""

    pendulum: Pendulum
    axes: dict[str, np.ndarray]
    at: dict[str, float]

    @staticmethod
    def of(
        pendulum: Pendulum | Any, axes: Mapping[str, Any] | Any, at: Mapping[str, float] | Any
    ) -> "Grid":
        """The grid that a person asks for; raises ValueError where it is none."""
        if isinstance(pendulum, Pendulum) and any(map(np.ndim, vars(pendulum).values())):
            raise ValueError(
                "pendulum must have numbers for fields, got arrays: name those that vary as axes"
            )
        pendulum = known_pendulum(pendulum)
        _check_names(axes, at)
        values = {key: _axis(key, given) for key, given in axes.items()}
        rest = {field: 0.0 for field in STATE if field not in values}
        rest |= {key: known_number(key, value) for key, value in at.items()}
        return Grid(pendulum, values, rest)

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(array.size for array in self.axes.values())

    @property
    def symmetric(self) -> bool:
        """Whether reflecting a cell's state gives another cell's: then that is the one at the other
        end of the axes.
        """
        moving = [array for key, array in self.axes.items() if key in STATE]
        mirrored = all(np.array_equal(array, -array[::-1]) for array in moving)
        return bool(moving) and mirrored and not any(self.at.values())

    def reflect(self, block: tuple[slice, ...]) -> tuple[slice, ...]:
        """The block of mirror images of a block of cells."""
        return tuple(
            slice(size - part.stop, size - part.start) if key in STATE else part
            for key, size, part in zip(self.axes, self.shape, block, strict=True)
        )

    def flip(self, values: np.ndarray) -> np.ndarray:
        """A block of values in the order of their mirror images."""
        return np.flip(values, tuple(axis for axis, key in enumerate(self.axes) if key in STATE))

    def tiles(self) -> Iterator[tuple[slice, ...]]:
        tile = self.tile()
        counts = [-(-size // side) for size, side in zip(self.shape, tile, strict=True)]
        for corner in np.ndindex(*counts):
            yield tuple(
                slice(index * side, min((index + 1) * side, size))
                for index, side, size in zip(corner, tile, self.shape, strict=True)
            )

    def tile(self) -> tuple[int, ...]:
        """A tile's shape: of symmetric axes an even number fits, so that whole tiles are mirror
        images of others.
        """
        side = _TILE if len(self.axes) == 2 else _TILE**2
        return tuple(min(side, -(-size // 2) if self.symmetric else size) for size in self.shape)

    def lanes(self, block: tuple[slice, ...]) -> dict[str, np.ndarray]:
        """The axes' values of every cell of a block, flat."""
        parts = [array[part] for array, part in zip(self.axes.values(), block, strict=True)]
        meshes = np.meshgrid(*parts, indexing="ij")
        return {key: mesh.ravel() for key, mesh in zip(self.axes, meshes, strict=True)}


def _check_names(axes: Mapping[str, Any] | Any, at: Mapping[str, Any] | Any) -> None:
    for name, given in (("axes", axes), ("at", at)):
        if not isinstance(given, Mapping):
            raise ValueError(
                f"{name} must be a dictionary by field, got {shown(given)}: give one like "
                f"{{'p1': 0.1}}"
            )
    if not 1 <= len(axes) <= 2:
        raise ValueError(
            f"axes must be one or two, got {len(axes)}: give one like {{'theta1': angles}}"
        )
    for key in [*axes, *at]:
        if key not in STATE + PENDULUM:
            known = ", ".join(STATE + PENDULUM)
            raise ValueError(
                f"axes and at must be fields of State or Pendulum, got {key!r}: give one of {known}"
            )
    twice = [key for key in at if key in axes or key in PENDULUM]
    if twice:
        raise ValueError(
            f"at must name fields of State that are no axis, got {twice[0]!r}: leave it out"
        )


def _axis(key: str, given: Any) -> np.ndarray:
    """An axis's values."""
    array = numbers(f"axis {key}", given)
    if array.ndim != 1 or not array.size or not np.all(np.isfinite(array)):
        raise ValueError(
            f"axis {key} must be a one-dimensional array of finite numbers, got {shown(given)}: "
            "give other values"
        )
    if key in ("l1", "l2", "m1", "m2") and np.any(array <= 0):
        raise ValueError(f"axis {key} must be positive, got {array.min():g}: leave that out")
    return array


def place(
    pendulum: Pendulum, at: Mapping[str, Scalar], cell: Mapping[str, Scalar]
) -> tuple[Pendulum, State]:
    pendulum = replace(pendulum, **{key: value for key, value in cell.items() if key in PENDULUM})
    return pendulum, State(**{key: cell.get(key, at.get(key)) for key in STATE})


@dataclass(frozen=True)
class _Cell:
    """What is computed in each lane: a value, so that equal sweeps share their compiled code."""

    quantity: Keyed
    scheme: Scheme
    twice: bool

    def __call__(
        self, shared: tuple[Pendulum, dict[str, Scalar]], cell: dict[str, Scalar]
    ) -> dict[str, Scalar]:
        pendulum, state = place(*shared, cell)
        values = dict(self.quantity(pendulum, state, self.scheme))
        taken = values.get("steps", 0)
        if self.twice:
            finer = self.quantity(pendulum, state, replace(self.scheme, step=self.scheme.step / 2))
            taken = taken + finer.get("steps", 0)
            for key, value in list(values.items()):
                if jax.numpy.issubdtype(value.dtype, np.floating):
                    difference = jax.numpy.abs(value - finer[key])
                    values[f"{key}_error"] = jax.numpy.where(value == finer[key], 0.0, difference)
        return values | {TAKEN: jax.numpy.asarray(taken)}


@jax.jit
def release_energy(pendulum: Pendulum, at: dict[str, Scalar], cell: dict[str, Scalar]) -> Scalar:
    return jax.vmap(lambda one: hamiltonian(*place(pendulum, at, one)))(cell)


@dataclass(frozen=True)
class Task:
    """All that determines a sweep's values."""

    quantity: Keyed
    grid: Grid
    scheme: Scheme
    twice: bool
    mirror: bool

    @property
    def cell(self) -> _Cell:
        return _Cell(self.quantity, replace(self.scheme, written_out=True), self.twice)

    @property
    def shared(self) -> tuple[Pendulum, dict[str, float]]:
        return self.grid.pendulum, self.grid.at

    def attributes(self, name: str | None, strict: bool) -> dict[str, Any]:
        """Provenance: nothing in it depends on when or on what machine the sweep runs."""
        from dpend._version import __version__

        axes = hashlib.sha256()
        for key, array in self.grid.axes.items():
            axes.update(key.encode() + array.tobytes())
        return {
            "dpend_version": __version__,
            **self.quantity.identity(name, strict),
            **{
                field: float(getattr(self.grid.pendulum, field))
                for field in PENDULUM
                if field not in self.grid.axes
            },
            **{f"at_{key}": value for key, value in self.grid.at.items()},
            "method": self.scheme.name,
            "step": self.scheme.step,
            "error": "half-step" if self.twice else "none",
            "mirror": "where it holds" if self.mirror else "never",
            "axes_sha256": axes.hexdigest(),
            "tile": list(self.grid.tile()),
            "digests": "sha256",
        }


def kinds_of(task: Task) -> dict[str, np.dtype]:
    """The names and types of a sweep's values, the status last."""
    scalar = jax.ShapeDtypeStruct((), np.float64)
    shared = jax.tree.map(lambda _: scalar, task.shared)
    kinds = dict(jax.eval_shape(task.cell, shared, dict.fromkeys(task.grid.axes, scalar)))
    for key, kind in kinds.items():
        if kind.shape != ():
            raise ValueError(
                f"each value of a quantity must be a scalar, got shape {kind.shape} for {key}: "
                f"return its components "
                "under names of their own"
            )
    del kinds[TAKEN]
    kinds.pop("status", None)
    names = {*STATE, *PENDULUM, *coordinates_of(task.grid)}
    taken = [key for key in kinds if key in names]
    if taken:
        raise ValueError(
            f"a quantity's value must not bear the name of a coordinate, got {taken[0]!r}: call it "
            f"another"
        )
    return {key: np.dtype(kind.dtype) for key, kind in kinds.items()} | {
        "status": np.dtype(np.uint8)
    }


def coordinates_of(grid: Grid) -> dict[str, tuple[str, np.ndarray, dict[str, str]]]:
    coordinates = {}
    for key, array in grid.axes.items():
        coordinates[key] = (key, array, {"units": _UNITS[key]})
        if key.startswith("theta"):
            coordinates[f"{key}_deg"] = (key, np.degrees(array), {"units": "degree"})
    return coordinates


def units_of(key: str) -> dict[str, Any]:
    unit = _UNITS.get(key.removesuffix("_error"))
    if key == "status":
        return {
            "flag_values": [int(s) for s in Status],
            "flag_meanings": " ".join(s.name.lower() for s in Status),
        }
    return {"units": unit} if unit else {}
