"""What the command line reads: the file of an orbit."""

import math
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dpend.checks import number, one_of, several
from dpend.mechanics.pendulum import Pendulum, State
from dpend.orbits.arc import SYMMETRIES
from dpend.orbits.orbit import PeriodicOrbit
from dpend.places import read_text
from dpend.records import file_name, parse_json, units_of
from dpend.status import Status


def read_orbit(path: Path, pendulum: Pendulum) -> PeriodicOrbit:
    """The orbit that `dpend orbit --out F.json` wrote, as far as a family needs it to start from.

    Raises:
        ValueError: no such file; one that holds no orbit, or several; an orbit of another pendulum.
    """
    try:
        found = parse_json(read_text(path))
        orbit = _orbit_in(found)
    except OSError as error:
        raise ValueError(
            f"orbit must be a file that can be read, got {path} ({error.strerror}): give another "
            f"file"
        ) from None
    except ValueError as error:
        raise ValueError(
            f"orbit must be a file that dpend orbit --out wrote, got {path} ({error}): give "
            f"another file"
        ) from None
    own = orbit.pendulum
    if not np.allclose(jax.tree.leaves(own), jax.tree.leaves(pendulum), rtol=1e-12, atol=0):
        options = " ".join(f"--{name} {value:g}" for name, value in vars(own).items())
        raise ValueError(f"orbit must be one of this pendulum, got one of another: give {options}")
    return orbit


def _orbit_in(found: Any) -> PeriodicOrbit:
    """An orbit's record as an orbit; of what no family needs, nothing."""
    if isinstance(found, dict) and len(found.get("orbits") or ()) == 1:
        (found,) = found["orbits"]
    if not isinstance(found, dict) or "orbits" in found:
        raise ValueError("it must hold one orbit")
    own = _part(found, "pendulum")
    names = {name: file_name(name, unit) for name, unit in units_of(Pendulum).items()}
    pendulum = Pendulum(**{name: _number(own, key) for name, key in names.items()})
    if found.get("status") != Status.CONVERGED.name.lower():
        raise ValueError("its status is not converged")
    state, nothing = _state(found), math.nan
    turns = several("turns", found.get("turns"), "a pair of integers", 2)
    return PeriodicOrbit(
        pendulum=pendulum,
        state=state,
        period=number("period_s", found.get("period_s"), positive=True),
        energy=nothing,
        residual=nothing,
        iterations=0,
        kappa=nothing,
        log_abs_kappa=nothing,
        dual=_state(_part(found, "dual")),
        turns=(_whole(turns[0]), _whole(turns[1])),
        error_estimate=(nothing, nothing),
        status=int(Status.CONVERGED),
        symmetry=one_of("symmetry", found.get("symmetry"), SYMMETRIES),
    )


def _part(found: dict[str, Any], name: str) -> dict[str, Any]:
    if not isinstance(found.get(name), dict):
        raise ValueError(f"{name} must be an object")
    return dict(found[name])


def _state(found: dict[str, Any]) -> State:
    units = units_of(State)
    values = (_number(found, file_name(name, unit)) for name, unit in units.items())
    theta1, theta2, p1, p2 = values
    return State(math.radians(theta1), math.radians(theta2), p1, p2)


def _number(found: dict[str, Any], key: str) -> float:
    return float(number(key, found.get(key)))


def _whole(value: Any) -> int:
    if not isinstance(value, int):
        raise ValueError("turns must be integers")
    return value
