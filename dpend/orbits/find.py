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

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from dpend._runtime import require_float64
from dpend.checks import (
    Scalar,
    flag,
    integer,
    is_traced,
    known_value,
    number,
    single,
)
from dpend.executables import run_kept
from dpend.mechanics.pendulum import (
    Pendulum,
    State,
    check_pendulum,
    known_pendulum,
)
from dpend.mechanics.units import natural
from dpend.orbits.guess import find_near_guess
from dpend.orbits.implicit import (
    ArcGiven,
    Known,
    arc_equations,
    implicit,
    know_solved,
    parameters_of,
)
from dpend.orbits.orbit import (
    PeriodicOrbit,
    mirrored,
    orbit_in_units,
    outcome_of,
)
from dpend.orbits.request import check_request, guess_of, leave_out
from dpend.orbits.search import Wish, last_aim, search
from dpend.orbits.single import (
    FINE,
)
from dpend.orbits.through import orbit_through, request_of


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
        rest = crossing, turn, tolerance, max_iterations, error
        others |= zip(_SETTINGS, rest, strict=True)
        return _through_state(pendulum, state, period, (symmetry, turns, keep), others)
    leave_out("without state", {"turns": turns, "keep": keep}, {"keep": "energy"})
    theta1, crossing = number("theta1", theta1, unit="rad"), integer("crossing", crossing)
    check_request(pendulum, theta1, branch, guess, symmetry, ratio, crossing)
    settings, error = _settings_of(turn, tolerance, max_iterations), flag("error", error)
    theta1 = jnp.asarray(theta1, jnp.float64)
    if guess is None:
        slow = (branch or ("in-phase" if ratio == 1 else "anti-phase")) == "in-phase"
        given = pendulum, theta1, slow, (crossing, float(ratio or 0)), settings
        return run_kept(_on_branch, given, (error,))
    return find_near_guess(pendulum, theta1, guess_of(guess), symmetry, ratio, settings, error)


def _settings_of(turn: Any, tolerance: Any, max_iterations: Any) -> tuple[Any, Any, Any]:
    """The settings of Newton's method, checked; all may be traced, which for `max_iterations` means
    that it bounds a loop.
    """
    if not is_traced(max_iterations):
        max_iterations = integer("max_iterations", max_iterations)
    values = {
        "turn": number("turn", turn, positive=True, unit="rad"),
        "tolerance": number("tolerance", tolerance, positive=True),
        "max_iterations": max_iterations,
    }
    for name, value in values.items():
        single(name, value)
    return values["turn"], values["tolerance"], values["max_iterations"]


# What `find_orbit` takes from a state not, with its defaults.
_SETTINGS = {"crossing": 1, "turn": FINE, "tolerance": 1e-13, "max_iterations": 40, "error": True}


def _through_state(
    pendulum: Any, state: Any, period: Any, options: tuple[Any, Any, Any], others: dict[str, Any]
) -> PeriodicOrbit:
    """The orbit near a motion, once what is asked has been looked at."""
    leave_out("with state and period", others, _SETTINGS)
    return orbit_through(pendulum, swinging_numbers(pendulum), request_of(state, period, *options))


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
