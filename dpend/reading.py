"""What the command line reads: the file of an orbit."""

from pathlib import Path

import jax
import numpy as np

from dpend.mechanics.pendulum import Pendulum
from dpend.orbits.files import read_orbits
from dpend.orbits.orbit import PeriodicOrbit
from dpend.status import Status


def read_orbit(path: Path, pendulum: Pendulum) -> PeriodicOrbit:
    """The orbit that `dpend orbit --out F.json` wrote.

    Raises:
        ValueError: no such file; one that holds no orbit, or several, or one that did not converge;
            an orbit of another pendulum.
    """
    orbit = read_orbits("orbit", path)
    if np.shape(orbit.period):
        if len(orbit) > 1:
            raise ValueError(f"orbit must be a file of one, got {path}: it must hold one orbit")
        orbit = orbit[0]
    if orbit.status != Status.CONVERGED:
        raise ValueError(
            f"orbit must be one that was found, got {path}: its status is not converged"
        )
    own = orbit.pendulum
    if not np.allclose(jax.tree.leaves(own), jax.tree.leaves(pendulum), rtol=1e-12, atol=0):
        options = " ".join(f"--{name} {value:g}" for name, value in vars(own).items())
        raise ValueError(f"orbit must be one of this pendulum, got one of another: give {options}")
    return orbit
