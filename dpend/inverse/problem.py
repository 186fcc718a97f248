"""What is asked of a pendulum that is designed, and one look at it: orbits, loss, derivatives."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dpend.checks import Scalar
from dpend.mechanics.pendulum import Pendulum, hamiltonian, released
from dpend.orbits.derivatives import slopes
from dpend.orbits.find import find_orbit
from dpend.orbits.orbit import PeriodicOrbit
from dpend.status import Status

Loss = Callable[..., Any]

# What may be free; the index is the place in every vector of unknowns.
PARAMETERS = ("l1", "l2", "m1", "m2", "g", "theta1")
_THETA1 = PARAMETERS.index("theta1")


class Look(NamedTuple):
    """What is known at one point; if an orbit is not to be had, its status and no more that
    counts.
    """

    x: np.ndarray  # (6,)
    value: np.ndarray  # (k,)
    jacobian: np.ndarray  # (k, 6), with respect to x
    orbits: tuple[PeriodicOrbit, ...]
    slopes: tuple[Any, ...]
    status: int

    @property
    def sound(self) -> bool:
        return self.status == Status.CONVERGED


@dataclass
class DesignProblem:
    """What is asked; counts the looks."""

    loss: Loss
    start: Pendulum
    branches: tuple[str, ...]
    angles: tuple[float, ...]
    low: np.ndarray  # bounds of x, both zero where it is not free
    high: np.ndarray
    equation: int | None = None  # the only one that is asked, if not all
    looks: int = 0

    @property
    def free(self) -> np.ndarray:
        return np.flatnonzero(self.low < self.high)

    def at(self, x: np.ndarray) -> Look:
        """The orbits at x, the loss there and its derivatives."""
        self.looks += 1
        values = np.array(jax.tree.leaves(self.start)) * np.exp(x[:_THETA1])
        pendulum, growth = Pendulum(*map(float, values)), math.exp(x[_THETA1])
        orbits = tuple(
            find_orbit(pendulum, angle * growth, branch=branch)
            for branch, angle in zip(self.branches, self.angles, strict=True)
        )
        lost = [int(orbit.status) for orbit in orbits if int(orbit.status) != Status.CONVERGED]
        rates = tuple(slopes(orbit) for orbit in orbits)
        value, jacobian = (np.asarray(part) for part in _measure_loss(self.loss, orbits, rates))
        if self.equation is not None:
            value, jacobian = value[[self.equation]], jacobian[[self.equation]]
        finite = np.all(np.isfinite(value)) and np.all(np.isfinite(jacobian))
        status = lost[0] if lost else int(Status.CONVERGED if finite else Status.NONFINITE)
        return Look(x, value, jacobian, orbits, rates, status)


@partial(jax.jit, static_argnames="loss")
def _measure_loss(
    loss: Loss, orbits: tuple[PeriodicOrbit, ...], rates: tuple[Any, ...]
) -> tuple[Scalar, Scalar]:
    """The loss as a vector, and its derivatives with respect to the logarithms of `PARAMETERS`."""

    def at(logs: Scalar) -> Scalar:
        shifted = (
            _shift_orbit(orbit, rate, logs) for orbit, rate in zip(orbits, rates, strict=True)
        )
        return jnp.ravel(jnp.asarray(loss(*shifted), jnp.float64))

    here = jnp.zeros(len(PARAMETERS))
    return at(here), jax.jacfwd(at)(here)


def _shift_orbit(orbit: PeriodicOrbit, rate: Scalar, logs: Scalar) -> PeriodicOrbit:
    """A centred orbit after a small change of ln parameters, to the first order, which is all that
    is asked of it.
    """
    parameters = jnp.stack([*jax.tree.leaves(orbit.pendulum), orbit.theta1])
    theta2, log_time, kappa, log_abs_kappa = rate @ (parameters * logs)
    theta1, *fields = (parameters * jnp.exp(logs))[jnp.array([_THETA1, 0, 1, 2, 3, 4])]
    pendulum, state = Pendulum(*fields), released(theta1, orbit.theta2 + theta2)
    turns = 2 * jnp.pi * jnp.asarray(orbit.turns, jnp.float64)
    return replace(
        orbit,
        pendulum=pendulum,
        state=state,
        period=orbit.period * jnp.exp(log_time),
        energy=hamiltonian(pendulum, state),
        kappa=orbit.kappa + kappa,
        log_abs_kappa=orbit.log_abs_kappa + log_abs_kappa,
        dual=released(turns[0] - state.theta1, turns[1] - state.theta2),
    )
