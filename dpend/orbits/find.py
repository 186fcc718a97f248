"""Periodic orbits released from rest, at a wanted angle.

Shooting for a periodic orbit of a conservative system is singular by two. Released from rest it is
not: with theta1 given, theta2 and the period are two unknowns for two equations, without a phase or
an energy condition.

- brake: p(T/2) = 0, at rest again at the dual release;
- centred: theta(T/4) = 0 modulo pi, half the integration. The reversal (theta, p, t) -> (-theta, p,
  -t) about T/4 then gives x(T/2) = -x(0) up to full turns.

On a branch the orbit is solved in segments, as the points of a family are (`search`). A guess says
less, theta2 and the period, and its motion is all that is known: it is solved in one piece
(`single`). Everything is traceable; derivatives with respect to the pendulum and the release angle
come from the implicit function theorem at the root (`implicit`), never from Newton's iterations.
"""

import math
import sys
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from dpend._runtime import require_float64
from dpend.checks import (
    Scalar,
    at_most_one,
    flag,
    integer,
    is_traced,
    known_value,
    number,
    one_of,
    several,
    shown,
    single,
)
from dpend.executables import run_kept
from dpend.mechanics.pendulum import (
    Pendulum,
    State,
    check_pendulum,
    hamiltonian,
    known_pendulum,
    released,
)
from dpend.mechanics.units import natural
from dpend.orbits.arc import PARTS, RELEASED_SYMMETRIES
from dpend.orbits.implicit import (
    ArcGiven,
    Known,
    PieceGiven,
    arc_equations,
    implicit,
    know_solved,
    parameters_of,
    piece_equations,
)
from dpend.orbits.orbit import (
    BRANCHES,
    Outcome,
    PeriodicOrbit,
    mirrored,
    orbit_in_units,
    outcome_of,
)
from dpend.orbits.rest import reduce_to_minimal
from dpend.orbits.search import Wish, last_aim, search
from dpend.orbits.single import (
    FINE,
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
from dpend.orbits.through import orbit_through, request_of
from dpend.status import Status

# How near to an equilibrium a search may end, in units of the swing.
_AT_EQUILIBRIUM = 1e-6
# Two solves of one orbit: angles [rad] and periods, relative.
_SAME_ORBIT = 1e-8


@partial(jax.jit, static_argnames="error")
def _on_branch(
    pendulum: Pendulum, theta1: Scalar, slow: Scalar, wish: tuple, settings: tuple, error: bool
) -> PeriodicOrbit:
    """The orbit where a branch meets theta1 for the `crossing`-th time; if `ratio` is not zero,
    theta2 = ratio theta1 nearest to it.
    """
    crossing, ratio = wish
    fixed = lax.stop_gradient(pendulum)
    sign = jnp.where(theta1 < 0, -1.0, 1.0)
    wanted = Wish(lax.stop_gradient(jnp.abs(theta1)), crossing, ratio)
    found = search(natural(fixed), slow, wanted, last_aim(*settings))
    root = found.root
    outcome = outcome_of(root, found.status, jnp)._replace(iterations=found.iterations)
    if not error:
        outcome = outcome._replace(angle_error=jnp.nan, time_error=jnp.nan)
    side = sign * jnp.where(root.point[0] < 0, -1.0, 1.0)
    target = jnp.where(ratio == 0, side * theta1, 0.0)
    given = ArcGiven(found.aim.row, found.aim.steps.astype(float), jnp.zeros(2))
    values = root.point, know_solved(root, "centred", jnp)
    equations = arc_equations("centred")
    _, known = implicit(equations, values, parameters_of(pendulum, target), given)
    orbit = orbit_in_units(pendulum, Known(*known), jnp.zeros(2), "centred", outcome)
    return mirrored(orbit, side)


@partial(jax.jit, static_argnames=("symmetry", "error"))
def _near_guess(
    pendulum: Pendulum,
    theta1: Scalar,
    directions: tuple[Array, Array],
    start: tuple[Scalar, Scalar],
    symmetry: str,
    settings: tuple,
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


def find_orbit(
    pendulum: Pendulum | Any,
    theta1: Scalar | None = None,
    *,
    branch: str | Any | None = None,
    guess: tuple[Scalar, Scalar] | Any | None = None,
    state: State | Any | None = None,
    period: Scalar | Any | None = None,
    symmetry: str | Any | None = None,
    turns: tuple[int, int] | Any | None = None,
    keep: str | Any = "energy",
    ratio: int | Any | None = None,
    crossing: int | Any = 1,
    turn: float | Any = FINE,
    tolerance: float | Any = 1e-13,
    max_iterations: int | Any = 40,
    error: bool | Any = True,
) -> PeriodicOrbit:
    """The periodic orbit released from rest at `theta1`: its partner angle theta2 and its period;
    or the periodic orbit near the motion from any `state`.

    Solves theta(T/4) = 0 modulo pi (centred) or p(T/2) = 0 (brake) for (theta2, T) by damped Newton
    iterations whose Jacobian is forward-mode through the flow. Give one of:

    - `branch`: follow the family of a normal mode by arclength, turning points included, from small
      swings to the first orbit with |theta1|. An orbit released at (-theta1, -theta2) counts: it is
      the same one, half a period later.
    - `guess`: start from (theta2, period) and take what Newton's method finds, reduced to its
      minimal period. The orbit is solved in one piece, and two doubles do not determine a motion
      that grows by more than 1e16 on its way: beyond |kappa| = 1e30 or so this may fail where
      `branch` and `Family.at`, whose orbits are known at 16 places, do not.
    - `ratio` alone: of the orbits with theta2 = ratio theta1 on the in-phase (+1) or anti-phase
      (-1) branch, or on `branch`, the one nearest to `theta1`, which is then an unknown too; with
      `guess`, the one near it.
    - `state` and `period`, without theta1: start from this motion over that time and take what
      Newton's method finds, in segments (see `arc`), with the energy of the state (or with the
      period, if that is kept), reduced to its minimal period. Without a symmetry the closed motion
      x(T) = x(0) is solved for, unfolded by one parameter, and solved again with the symmetry that
      it turns out to have. The arguments from `crossing` to `error` are of the other ways.

    Many angles of one branch: `follow_family(pendulum, branch).at(angles)` walks along it once;
    `vmap` of this walks once an angle, and takes a hundred times as long for fifty.

    Negative `theta1` gives the mirror image. Derivatives of every result with respect to `theta1`
    and the pendulum are those of the root itself (implicit function theorem), second ones as
    `jax.hessian` takes them; with `jit`, `vmap` and `grad` all works, and what is wrong with a
    traced argument shows in `status`.

    Arguments:
        theta1: release angle of the upper rod [rad].
        branch: `in-phase` (slow mode) or `anti-phase` (fast mode).
        guess: theta2 [rad], period [s].
        state: a state on the orbit or near it, anywhere.
        period: [s], with `state`.
        symmetry: with `guess`, `centred` or `brake`. Without it the guess is solved as brake and
            solved again as centred if the orbit is that; under tracing it stays brake, of which
            every centred orbit is a case. With `state` also `passing`, `odd` or `none`: see
            `PeriodicOrbit`.
        turns: with `state`, the full turns of both rods in a period, of an orbit that is passing or
            has no symmetry; those of the motion if not given.
        keep: with `state`, what the orbit has in common with its motion: `energy` or `period`.
        ratio: +1 or -1.
        crossing: which of the branch's passages through `theta1`, in order of arclength.
        turn: how far the fastest motion may advance in one integration step [rad]; 0.1 leaves
            little but rounding.
        tolerance: on the Newton update after the last one made, of theta2 [rad] relative to an
            amplitude below 1, and of log T. 1e-13 is where rounding begins. On a branch that update
            is taken as the square of the last.
        max_iterations: Newton iterations at most, at least 1, which is to evaluate the guess.
        error: solve again at half the step for `error_estimate`; without it that is NaN.
    Returns:
        PeriodicOrbit. If its status is not `Status.CONVERGED` it holds the best iterate and its
        residual; if the branch does not reach `theta1` (`NO_SUCH_ORBIT`), the orbit where it came
        closest to upright in theta1.
    Raises:
        ValueError: theta1 not finite; none or more than one of branch, guess and state; theta1 a
            multiple of pi with `branch`; both angles at an equilibrium; g not positive; an unknown
            branch, symmetry or ratio; a period not positive; a state without a period or traced by
            `jit`; an argument of another way.
        RuntimeError: float64 is switched off in JAX.
    See also:
        Peeters et al., Nonlinear normal modes II, Mechanical Systems and Signal Processing 23
        (2009): families of normal modes by shooting and arclength; Hristov et al.,
        arXiv:2308.16159: the quarter period.
    """
    require_float64()
    if state is not None or period is not None:
        others = {"theta1": theta1, "branch": branch, "guess": guess, "ratio": ratio}
        settings = crossing, turn, tolerance, max_iterations, error
        others |= zip(_SETTINGS, settings, strict=True)
        return _through_state(pendulum, state, period, (symmetry, turns, keep), others)
    _leave_out("without state", {"turns": turns, "keep": keep}, {"keep": "energy"})
    theta1, crossing = number("theta1", theta1, unit="rad"), integer("crossing", crossing)
    _check_request(pendulum, theta1, branch, guess, symmetry, ratio, crossing)
    values = {
        "turn": number("turn", turn, positive=True, unit="rad"),
        "tolerance": number("tolerance", tolerance, positive=True),
        # This may be traced: it bounds a loop.
        "max_iterations": max_iterations
        if is_traced(max_iterations)
        else integer("max_iterations", max_iterations),
    }
    error = flag("error", error)
    for name, value in values.items():
        single(name, value)
    settings = tuple(values.values())
    theta1 = jnp.asarray(theta1, jnp.float64)
    if guess is None:
        slow = (branch or ("in-phase" if ratio == 1 else "anti-phase")) == "in-phase"
        given = pendulum, theta1, slow, (crossing, float(ratio or 0)), settings
        return run_kept(_on_branch, given, (error,))
    theta2, period = (jnp.asarray(value, jnp.float64) for value in _guess_of(guess))
    if ratio is None:
        directions, x = (jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0])), theta2
    else:
        directions, x = (jnp.zeros(2), jnp.array([1.0, ratio])), theta1

    def solve(x: Scalar, period: Scalar, symmetry: str) -> PeriodicOrbit:
        return _near_guess(pendulum, theta1, directions, (x, period), symmetry, settings, error)

    orbit = solve(x, period, symmetry or "brake")
    if symmetry is not None or known_value(orbit.status) != Status.CONVERGED:
        return orbit
    centred = solve(orbit.theta2 if ratio is None else orbit.theta1, orbit.period, "centred")
    if not _is_same(centred, orbit):
        return orbit
    return replace(centred, iterations=orbit.iterations + centred.iterations)


# What `find_orbit` takes from a state not, with its defaults.
_SETTINGS = {"crossing": 1, "turn": FINE, "tolerance": 1e-13, "max_iterations": 40, "error": True}


def _through_state(
    pendulum: Any, state: Any, period: Any, options: tuple[Any, Any, Any], others: dict[str, Any]
) -> PeriodicOrbit:
    """The orbit near a motion, once what is asked has been looked at."""
    _leave_out("with state and period", others, _SETTINGS)
    return orbit_through(pendulum, swinging_numbers(pendulum), request_of(state, period, *options))


def _leave_out(when: str, given: dict[str, Any], defaults: dict[str, Any]) -> None:
    """Refuses arguments that mean nothing here; None where there is no default."""
    for name, value in given.items():
        default = defaults.get(name)
        plain = isinstance(value, (bool, int, float, str))
        if value is not default and not (plain and value == default):
            raise ValueError(f"{name} must not be given {when}, got {shown(value)}: leave it out")


def _check_request(
    pendulum: Pendulum | Any,
    theta1: Scalar,
    branch: Any,
    guess: Any,
    symmetry: Any,
    ratio: Any,
    crossing: int,
) -> None:
    """Refuses what cannot be asked, as far as the values are known before tracing."""
    check_pendulum(pendulum)
    words = ("branch", branch, BRANCHES), ("symmetry", symmetry, RELEASED_SYMMETRIES)
    for name, value, known in words:
        if value is not None:
            one_of(name, value, known)
    if ratio is not None:
        one_of("ratio", ratio, (1, -1))
    at_most_one(branch=branch, guess=guess)
    if branch is None and guess is None and ratio is None:
        raise ValueError(
            "branch must be given, or guess=(theta2, period), or ratio=1 or -1; got none of them"
        )
    if symmetry is not None and guess is None:
        raise ValueError(
            f"symmetry goes with guess, got {symmetry!r} alone: orbits on a branch are centred"
        )
    if crossing > 1 and (branch is None or ratio is not None):
        raise ValueError(f"crossing must be 1 but with branch alone, got {crossing}: leave it out")
    _check_release(pendulum, theta1)
    angle1 = known_value(theta1)
    if guess is not None:
        _check_guess(guess, angle1)
    elif angle1 is not None and _multiple_of_pi(angle1):
        raise ValueError(
            f"theta1 must not be a multiple of 180 degrees on a branch, got "
            f"{math.degrees(angle1):g} degrees: "
            "the branches pass there only in equilibrium"
        )


def _check_release(pendulum: Pendulum, theta1: Scalar) -> None:
    """Refuses an angle that is none, and a pendulum that does not swing."""
    for name, value in {"theta1": theta1, **vars(pendulum)}.items():
        single(name, value)
    gravity, angle1 = known_value(pendulum.g), known_value(theta1)
    if angle1 is not None and not math.isfinite(angle1):
        raise ValueError(f"theta1 must be a finite number [rad], got {angle1}: give another theta1")
    if gravity is not None and not gravity > 0:
        raise ValueError(
            f"g must be positive for an orbit, got {gravity:g}: nothing swings back without gravity"
        )


def _check_guess(guess: Any, angle1: float | None) -> None:
    """Refuses a guess that is an equilibrium or has no period."""
    theta2, period = (known_value(value) for value in _guess_of(guess))
    if period is not None and not period > 0:
        raise ValueError(f"period must be positive [s], got {period:g}: give another guess")
    if angle1 is None or theta2 is None:
        return
    if _multiple_of_pi(angle1) and _multiple_of_pi(theta2):
        raise ValueError(
            f"theta2 must not be a multiple of 180 degrees with theta1 at {math.degrees(angle1):g} "
            f"degrees, "
            f"got {math.degrees(theta2):g} degrees: that is an equilibrium"
        )


def _guess_of(guess: Any) -> tuple[Scalar, Scalar]:
    """theta2 [rad] and the period [s] of a guess, checked."""
    theta2, period = several("guess", guess, "a pair (theta2, period)", 2)
    for name, value in (("theta2", theta2), ("period", period)):
        single(f"guess of {name}", value)
    return number("guess of theta2", theta2, unit="rad"), number(
        "guess of period", period, unit="s"
    )


def swinging_pendulum(pendulum: Any) -> Pendulum:
    """A pendulum whose fields are plain numbers and that has orbits.

    Raises:
        ValueError: as `known_pendulum`; g not positive.
    """
    fixed = known_pendulum(pendulum)
    if not fixed.g > 0:
        raise ValueError(
            f"g must be positive for orbits, got {fixed.g:g}: nothing swings back without gravity"
        )
    return fixed


def swinging_numbers(pendulum: Any) -> Pendulum:
    """The numbers behind a pendulum, also under eager differentiation, whose derivatives orbits
    carry on.

    Raises:
        ValueError: no pendulum; a field that is an array or traced by `jit`; g not positive.
    """
    check_pendulum(pendulum)
    numbers = {}
    for name, leaf in vars(pendulum).items():
        single(name, leaf)
        known = known_value(leaf)
        numbers[name] = leaf if known is None else known
    return swinging_pendulum(Pendulum(**numbers))  # which refuses what `jit` traces


def _multiple_of_pi(angle: float) -> bool:
    nearest = math.pi * round(angle / math.pi)
    # Below 1e-100 the products of two amplitudes leave the range of float64: that is zero, too.
    return abs(angle - nearest) <= max(4 * sys.float_info.epsilon * abs(nearest), 1e-100)


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
