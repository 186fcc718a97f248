"""The orbit to which Newton's method leads from a guess of two numbers, solved in one piece."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from dpend.checks import Scalar, known_value
from dpend.executables import run_kept
from dpend.mechanics.pendulum import Pendulum, hamiltonian, released
from dpend.mechanics.units import natural
from dpend.orbits.arc import PARTS
from dpend.orbits.implicit import Known, PieceGiven, implicit, parameters_of, piece_equations
from dpend.orbits.orbit import Outcome, PeriodicOrbit, orbit_in_units
from dpend.orbits.rest import reduce_to_minimal
from dpend.orbits.single import (
    MOST_STEPS_IN_ONE_PIECE,
    Line,
    LineNewton,
    Settings,
    clock,
    newton_on_line,
    rate_along,
    residual_of,
    solve_twice,
    steps_for,
)
from dpend.orbits.stability import stability_of
from dpend.status import Status

# How near to an equilibrium a search may end, in units of the swing.
_AT_EQUILIBRIUM = 1e-6
# Two solves of one orbit: angles [rad] and periods, relative.
_SAME_ORBIT = 1e-8


def find_near_guess(
    pendulum: Pendulum,
    theta1: Scalar,
    guess: tuple[Scalar, Scalar],
    symmetry: str | None,
    ratio: int | None,
    settings: tuple,
    error: bool,
) -> PeriodicOrbit:
    """The orbit near `guess` = (theta2, period), at theta1 or with theta2 = ratio theta1.

    Without a symmetry it is solved as brake, and solved again as centred if it is that; under
    tracing it stays brake.
    """
    theta2, period = (jnp.asarray(value, jnp.float64) for value in guess)
    if ratio is None:
        directions, x = (jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0])), theta2
    else:
        directions, x = (jnp.zeros(2), jnp.array([1.0, ratio])), theta1

    def solve(x: Scalar, period: Scalar, symmetry: str) -> PeriodicOrbit:
        given = pendulum, theta1, directions, (x, period), settings
        return run_kept(_near_guess, given, (symmetry, error))

    orbit = solve(x, period, symmetry or "brake")
    if symmetry is not None or known_value(orbit.status) != Status.CONVERGED:
        return orbit
    centred = solve(orbit.theta2 if ratio is None else orbit.theta1, orbit.period, "centred")
    if not _is_same(centred, orbit):
        return orbit
    return replace(centred, iterations=orbit.iterations + centred.iterations)


@partial(jax.jit, static_argnames=("symmetry", "error"))
def _near_guess(
    pendulum: Pendulum,
    theta1: Scalar,
    directions: tuple[Array, Array],
    start: tuple[Scalar, Scalar],
    settings: tuple,
    symmetry: str,
    error: bool,
) -> PeriodicOrbit:
    """The orbit to which Newton's method leads from `start` = (x, period), with its minimal period,
    among the releases at theta1 * origin + x * direction.
    """
    origin, direction = directions
    turn, tolerance, max_iterations = settings
    scaled = natural(lax.stop_gradient(pendulum))
    line = Line(lax.stop_gradient(theta1) * origin, direction)
    second = jnp.sqrt(pendulum.l1 / pendulum.g)
    x, period = start
    log_time = lax.stop_gradient(jnp.log(period / (PARTS[symmetry] * second)))
    x = lax.stop_gradient(x)
    rate = clock(scaled)
    for _ in range(2):  # the rate decides the steps, and the steps what rate is seen
        rate, end = rate_along(scaled, line, x, log_time, steps_for(log_time, rate, turn))
    turns = jnp.round(end / jnp.pi) if symmetry == "centred" else jnp.zeros(2)
    too_long = jnp.exp(log_time) * rate > turn * MOST_STEPS_IN_ONE_PIECE
    steps = jnp.where(too_long, 8, steps_for(log_time, rate, turn))
    most = jnp.where(too_long, 1, max_iterations)
    first = newton_on_line(scaled, line, x, log_time, steps, turns, symmetry, tolerance, most)
    angles = line.base + first.x * direction
    log_time, turns = reduce_to_minimal(scaled, angles, first.log_time, steps, turns, symmetry)
    reduced = log_time < first.log_time
    again = Settings(turn, tolerance, jnp.maximum(most - first.iterations, 1), error)
    newton, steps, change = solve_twice(
        scaled, line, first.x, log_time, first.shot.rate, turns, symmetry, again
    )
    # Many periods of an unstable orbit are too long for Newton's method, and one is not.
    status = jnp.where((first.status == Status.CONVERGED) | reduced, newton.status, first.status)
    status = jnp.where(too_long, Status.BEYOND_HORIZON, status)
    swing = jnp.minimum(1.0, _swing(line.base + x * direction))
    status = jnp.where(_swing(angles) < _AT_EQUILIBRIUM * swing, Status.TRIVIAL_ROOT, status)
    outcome = Outcome(
        residual_of(scaled, newton, symmetry),
        first.iterations + newton.iterations,
        change[0],
        change[1],
        status,
    )
    known = _know_newton(scaled, line, newton, symmetry)
    known = known.at[-2:].add(jnp.where(too_long, jnp.nan, 0.0))
    values = jnp.stack([newton.x, newton.log_time]), known
    given = PieceGiven(origin, direction, steps.astype(float))
    equations = piece_equations(symmetry)
    _, known = implicit(equations, values, parameters_of(pendulum, theta1), given)
    return orbit_in_units(pendulum, Known(*known), turns, symmetry, outcome)


def _know_newton(pendulum: Pendulum, line: Line, newton: LineNewton, symmetry: str) -> Array:
    """The columns of `Known` where Newton's method ended, from its own last integration."""
    start = released(*(line.base + newton.x * line.direction))
    kappas = stability_of(newton.shot.matrix[None], symmetry, jnp)[1:]
    states = [*jax.tree.leaves(start), *jax.tree.leaves(newton.shot.end)]
    return jnp.stack([*states, jnp.exp(newton.log_time), hamiltonian(pendulum, start), *kappas])


def _swing(angles: Array) -> Scalar:
    """How far a release is from the nearest equilibrium [rad, up to 1]: the scale of all that is
    small.
    """
    return jnp.max(jnp.abs(jnp.sin(angles)))


def _is_same(one: PeriodicOrbit, other: PeriodicOrbit) -> bool:
    """Whether two converged orbits are one: angles and periods agree to `_SAME_ORBIT`."""
    known = [
        float(known_value(leaf) or 0.0)
        for o in (one, other)
        for leaf in (o.theta1, o.theta2, o.period)
    ]
    apart = max(abs(known[0] - known[3]), abs(known[1] - known[4]))
    longer = abs(known[2] / known[5] - 1)
    return known_value(one.status) == Status.CONVERGED and max(apart, longer) < _SAME_ORBIT
