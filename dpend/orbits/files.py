"""Orbits in a file, F.json: what `dpend orbit --out` writes and `load_orbits` reads.

The file is one object. `format` is 1 and `dpend_version` tells who wrote it. A single orbit has its
keys beside these; of several `orbits` is a list of objects with the same keys. Angles are in
degrees, everything else is in SI units, as the names say; `status` is a name of `Status` in lower
case; null stands for NaN and infinity.
"""

import math
import os
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dpend._version import __version__
from dpend.checks import instance, is_traced, number, one_of, several
from dpend.mechanics.pendulum import Pendulum, State
from dpend.orbits.arc import SYMMETRIES
from dpend.orbits.orbit import PeriodicOrbit
from dpend.places import check_place, file_path, read_text, replacing
from dpend.records import file_name, json_text, parse_json, record, units_of
from dpend.status import Status

# Raised when a file of before could be read wrongly.
FORMAT = 1
_STATUSES = tuple(status.name.lower() for status in Status)


def orbit_record(orbit: PeriodicOrbit) -> dict[str, Any]:
    """A single orbit as plain numbers and text."""
    names = "period energy residual iterations status message symmetry kappa log_abs_kappa"
    return {
        **record(orbit.state),
        **record(orbit, f"{names} stability"),
        "dual": record(orbit.dual),
        **record(orbit, "turns error_estimate pendulum"),
    }


def orbits_record(records: list[dict[str, Any]], several: bool) -> dict[str, Any]:
    """What a file holds of one orbit's record, or of several."""
    head = {"format": FORMAT, "dpend_version": __version__}
    return head | ({"orbits": records} if several else records[0])


def save_orbits(orbits: PeriodicOrbit | Any, path: str | os.PathLike[str] | Any) -> None:
    """Writes one orbit, or many in a row, to F.json, for `load_orbits` and `dpend family --orbit`.

    The docstring of `dpend.orbits.files` has the format.

    Angles are written in degrees, which may cost their last bit, everything else as it is.

    Raises:
        ValueError: no orbit, or one traced by `jit`; another ending; no directory to write in.
    """
    instance("orbits", orbits, PeriodicOrbit, "what dpend.find_orbit returns")
    if any(is_traced(leaf) for leaf in jax.tree.leaves(orbits)):
        raise ValueError("orbits must be known, not traced by jit: save them outside")
    path = file_path("path", path)
    check_place("path", path, (".json",))
    shape = np.shape(orbits.period)
    flat = jax.tree.map(lambda leaf: np.broadcast_to(np.asarray(leaf), shape), orbits)
    if len(shape) > 1:
        flat = jax.tree.map(np.ravel, flat)
    records = [orbit_record(one) for one in (flat if shape else (flat,))]
    with replacing(path) as draft:
        draft.write_text(json_text(orbits_record(records, bool(shape))) + "\n")


def load_orbits(path: str | os.PathLike[str] | Any) -> PeriodicOrbit:
    """The orbit that `save_orbits` or `dpend orbit --out` wrote to F.json; of several one
    `PeriodicOrbit` with a leading axis.

    Raises:
        ValueError: no such file, or one that holds no orbits; several that differ in symmetry.
    """
    path = file_path("path", path)
    if path.suffix != ".json":
        raise ValueError(f"path must end in .json, got {path}: save_orbits writes no others")
    return read_orbits("path", path)


def read_orbits(name: str, path: Path) -> PeriodicOrbit:
    """See `load_orbits`; `name` is the argument that is told."""
    try:
        return _orbits_in(parse_json(read_text(path)))
    except OSError as error:
        raise ValueError(
            f"{name} must be a file that can be read, got {path} ({error.strerror}): give another "
            f"file"
        ) from None
    except ValueError as error:
        raise ValueError(
            f"{name} must be a file that save_orbits or dpend orbit --out wrote, got {path} "
            f"({error}): give another file"
        ) from None


def _orbits_in(found: Any) -> PeriodicOrbit:
    if not isinstance(found, dict):
        raise ValueError("it must hold an object")
    if found.get("format", FORMAT) != FORMAT:
        raise ValueError(f"its format is {found['format']!r:.60}, this version reads {FORMAT}")
    if "orbits" not in found:
        return _orbit_in(found)
    if not isinstance(found["orbits"], list) or not found["orbits"]:
        raise ValueError("orbits must be a list of objects")
    orbits = [_orbit_in(one) for one in found["orbits"]]
    if len({one.symmetry for one in orbits}) > 1:
        raise ValueError("its orbits differ in symmetry")
    whole: PeriodicOrbit = jax.tree.map(lambda *leaves: np.array(leaves), *orbits)
    return whole


def _orbit_in(found: Any) -> PeriodicOrbit:
    if not isinstance(found, dict):
        raise ValueError("an orbit must be an object")
    own, errors = _part(found, "pendulum"), _part(found, "error_estimate")
    names = {name: file_name(name, unit) for name, unit in units_of(Pendulum).items()}
    turns = several("turns", found.get("turns"), "a pair of integers", 2)
    status = one_of("status", found.get("status"), _STATUSES)
    scalars = {key: _number(found, key) for key in ("residual", "kappa", "log_abs_kappa")}
    if scalars["kappa"] == 0:
        scalars["log_abs_kappa"] = -math.inf  # which JSON cannot say
    return PeriodicOrbit(
        pendulum=Pendulum(**{name: _number(own, key) for name, key in names.items()}),
        state=_state(found),
        period=_number(found, "period_s", positive=True),
        energy=_number(found, "energy_J"),
        iterations=_whole("iterations", found.get("iterations")),
        dual=_state(_part(found, "dual")),
        turns=(_whole("turns", turns[0]), _whole("turns", turns[1])),
        error_estimate=(math.radians(_number(errors, "theta2_deg")), _number(errors, "period_s")),
        status=int(Status[status.upper()]),
        symmetry=one_of("symmetry", found.get("symmetry"), SYMMETRIES),
        **scalars,
    )


def _part(found: dict[str, Any], name: str) -> dict[str, Any]:
    if not isinstance(found.get(name), dict):
        raise ValueError(f"{name} must be an object")
    return dict(found[name])


def _state(found: dict[str, Any]) -> State:
    names = (file_name(name, unit) for name, unit in units_of(State).items())
    theta1, theta2, p1, p2 = (np.asarray(_number(found, name)) for name in names)
    # An orbit that was not found has no numbers, which a state refuses of people.
    return State(*(jax.numpy.asarray(x) for x in (np.radians(theta1), np.radians(theta2), p1, p2)))


def _number(found: dict[str, Any], key: str, positive: bool = False) -> float:
    if key not in found:
        raise ValueError(f"it has no {key}")
    return math.nan if found[key] is None else float(number(key, found[key], positive=positive))


def _whole(name: str, value: Any) -> int:
    if type(value) is not int:
        raise ValueError(f"{name} must be integers")
    return value
