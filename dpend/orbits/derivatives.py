"""Derivatives of a centred orbit with respect to its pendulum and its release."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dpend.mechanics.pendulum import Pendulum
from dpend.mechanics.units import natural
from dpend.orbits.arc import PARTS
from dpend.orbits.implicit import (
    Known,
    PieceGiven,
    implicit,
    know_piece,
    parameters_of,
    piece_equations,
)
from dpend.orbits.orbit import PeriodicOrbit
from dpend.orbits.single import FINE, Line, clock, rate_along, steps_for


@jax.jit
def slopes(orbit: PeriodicOrbit) -> Float[Array, "4 6"]:
    """Derivatives of what is known of a centred orbit by the implicit function theorem, without
    solving it again.

    Returns:
        Of theta2, log T, kappa and log |kappa| (rows) with respect to l1, l2, m1, m2, g and theta1.
    """
    pendulum, origin, direction = orbit.pendulum, jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0])
    second = jnp.sqrt(pendulum.l1 / pendulum.g)
    root = jnp.stack([orbit.theta2, jnp.log(orbit.period / (PARTS["centred"] * second))])
    scaled, line = natural(pendulum), Line(orbit.theta1 * origin, direction)
    rate, _ = rate_along(scaled, line, root[0], root[1], steps_for(root[1], clock(scaled), FINE))
    steps = steps_for(root[1], rate, FINE).astype(jnp.float64)
    given, equations = PieceGiven(origin, direction, steps), piece_equations("centred")
    found = know_piece("centred", root, parameters_of(pendulum, orbit.theta1), given)

    def known(parameters: Array) -> Array:
        here = Pendulum(*parameters[:5])
        _, columns = implicit(equations, (root, found), parameters_of(here, parameters[5]), given)
        of = Known(*columns)
        log_period = jnp.log(of.time) + 0.5 * jnp.log(here.l1 / here.g)
        return jnp.stack([of.theta2, log_period, of.kappa, of.log_abs_kappa])

    return jax.jacfwd(known)(jnp.stack([*jax.tree.leaves(pendulum), orbit.theta1]))
