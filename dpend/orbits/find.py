"""Periodic orbits released from rest, by symmetric shooting with Newton's method.

Shooting for a periodic orbit of a conservative system is singular by two. Released from rest it is
not: with theta1 given, theta2 and the period are two unknowns for two equations, without a phase or
an energy condition.

- brake: p(T/2) = 0, at rest again at the dual release;
- centred: theta(T/4) = 0 modulo pi, half the integration. The reversal (theta, p, t) -> (-theta, p,
  -t) about T/4 then gives x(T/2) = -x(0) up to full turns.

A branch is followed from its normal mode by the walk that families take (`walk`), turning points in
theta1 included; the orbit that it leads to is solved in one piece. Everything is traceable;
derivatives with respect to the pendulum and the release angle come from the implicit function
theorem at the root, never from Newton's iterations.
"""

import math
import sys
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

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
    single,
)
from dpend.mechanics.pendulum import (
    Pendulum,
    State,
    check_pendulum,
    known_pendulum,
    released,
    vector_field,
)
from dpend.mechanics.units import natural
from dpend.motion.integrate import step_size
from dpend.orbits.arc import PARTS, arc_of, arc_times
from dpend.orbits.orbit import BRANCHES, RELEASED_SYMMETRIES, PeriodicOrbit, mirrored, orbit_at_root
from dpend.orbits.single import (
    FINE,
    MOST_STEPS_IN_ONE_PIECE,
    RK8,
    RUNNING,
    Line,
    Settings,
    clock,
    newton_on_line,
    rate_along,
    solve_twice,
    steps_for,
)
from dpend.orbits.walk import Walk, beginning, hermite, stride
from dpend.status import Status

# The longest step in arclength: its cubic is true to a thousandth, from where Newton's method goes
# on.
_LONGEST_STEP = 0.25
_MOST_POINTS = 5000
# Each step is looked at in this many pieces for crossings: no step turns enough to cross twice
# within one of them.
_PIECES = 16


class _Search(NamedTuple):
    """A walk along a branch to where it meets the wanted release."""

    walk: Walk
    iterations: Scalar
    points: Scalar
    attempts: Scalar
    crossings: Scalar
    best: Float[Array, " D"]
    reach: Float[Array, " D"]
    found: Scalar
    status: Scalar


def _searched(
    pendulum: Pendulum, slow: Scalar, target: Scalar, crossing: Scalar, ratio: Scalar
) -> _Search:
    """Follows a centred family from its normal mode to where it meets the wanted release.

    With `ratio` zero that is the `crossing`-th time that |theta1| = target; the orbit released at
    (-theta1, -theta2) is the same one, half a period later. Otherwise it is the release with theta2
    = ratio theta1 nearest to `target`.
    """
    scaled = natural(pendulum)
    arc = arc_of("centred")

    def wanted(angles: Array) -> Array:
        return jnp.where(ratio == 0, jnp.abs(angles[0]) - target, angles[1] - ratio * angles[0])

    def advance(s: _Search) -> _Search:
        walk, new, taken, end = stride(scaled, s.walk, jnp.asarray(_LONGEST_STEP), arc)
        further = jnp.abs(new.point[0]) > jnp.abs(s.reach[0])
        after = s._replace(
            walk=walk,
            iterations=new.iterations,
            points=s.points + 1,
            reach=jnp.where(further, new.point, s.reach),
            status=jnp.where(
                end == 1, jnp.where(s.found, Status.CONVERGED, Status.NO_SUCH_ORBIT), RUNNING
            ),
        )
        after = _looked_at(after, wanted, target, crossing, ratio)
        before = s._replace(walk=walk, status=jnp.where(end == 2, Status.LEFT_BRANCH, RUNNING))
        s = jax.tree.map(partial(jnp.where, taken), after, before)
        gave_up = (s.points >= _MOST_POINTS) | (s.attempts >= 3 * _MOST_POINTS)
        status = jnp.where((s.status == RUNNING) & gave_up, Status.LEFT_BRANCH, s.status)
        return s._replace(attempts=s.attempts + 1, status=status)

    begin = beginning(scaled, slow)
    finite = jnp.isfinite(target + jnp.sum(begin.point) + jnp.sum(begin.tangent))
    zero = jnp.asarray(0)
    start = _Search(
        begin,
        iterations=zero,
        points=zero,
        attempts=zero,
        crossings=zero,
        best=begin.point,
        reach=begin.point,
        found=jnp.asarray(False),
        status=jnp.where(finite, RUNNING, Status.NONFINITE),
    )
    return lax.while_loop(lambda s: s.status == RUNNING, advance, start)


def _looked_at(s: _Search, wanted: Any, target: Scalar, crossing: Scalar, ratio: Scalar) -> _Search:
    """The search after its newest step has been looked at for the wanted release."""
    w = s.walk

    def at(share: Scalar) -> Array:
        return hermite(w.behind, w.behind_tangent, w.point, w.tangent, w.length, share)

    points = jax.vmap(at)(jnp.arange(_PIECES + 1) / _PIECES)
    values = jax.vmap(wanted)(points)
    changes = values[:-1] * values[1:] < 0
    seen = s.crossings + jnp.cumsum(changes)
    nearness = jnp.where(changes, jnp.abs(jnp.abs(points[1:, 0]) - target), jnp.inf)
    closer = jnp.min(nearness) < jnp.where(s.found, jnp.abs(jnp.abs(s.best[0]) - target), jnp.inf)
    nearest = (jnp.arange(_PIECES) == jnp.argmin(nearness)) & closer
    here = jnp.where(ratio == 0, changes & (seen == crossing), nearest)
    hit = jnp.any(here)
    left = jnp.argmax(here) / _PIECES
    sign = jnp.sign(wanted(at(left)))

    def halve(_: Scalar, bounds: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
        low, high = bounds
        middle = 0.5 * (low + high)
        before = wanted(at(middle)[:2]) * sign > 0
        return jnp.where(before, middle, low), jnp.where(before, high, middle)

    low, high = lax.fori_loop(0, 50, halve, (left, left + 1 / _PIECES))
    best = jnp.where(hit, at(0.5 * (low + high)), s.best)
    found = s.found | hit
    # With a ratio, further on only a branch that turned back could come nearer to the target.
    beyond = found & (jnp.abs(w.point[0]) - target > jnp.abs(jnp.abs(best[0]) - target))
    over = jnp.where(ratio == 0, hit, beyond)
    status = jnp.where(over, Status.CONVERGED, s.status)
    return s._replace(crossings=seen[-1], best=best, found=found, status=status)


def _timed(pendulum: Pendulum, point: Array) -> tuple[Scalar, Scalar]:
    """The log of a point's shooting time [s], and the largest rate at its nodes [rad/s]."""
    second = jnp.sqrt(pendulum.l1 / pendulum.g)
    times, rates = arc_times(natural(pendulum), point)
    return jnp.log(jnp.sum(times) * second), jnp.max(rates) / second


@partial(jax.jit, static_argnames="error")
def _on_branch(pendulum, theta1, slow, crossing, ratio, error, turn, tolerance, max_iterations):  # type: ignore[no-untyped-def]
    """The orbit where a branch meets theta1 for the `crossing`-th time; if `ratio` is not zero,
    theta2 = ratio theta1 nearest to it.
    """
    fixed = lax.stop_gradient(pendulum)
    sign = jnp.where(theta1 < 0, -1.0, 1.0)
    target = jnp.abs(theta1)
    search = _searched(fixed, slow, lax.stop_gradient(target), crossing, ratio)
    found = search.found
    point = jnp.where(found, search.best, search.reach)
    log_time, rate = _timed(fixed, point)
    guess = point[:2] * jnp.where(point[0] < 0, -1.0, 1.0)  # the same orbit, from its other rest
    at_angle = ratio == 0
    release = jnp.where(found, target, guess[0])
    # The cubic's theta2 belongs to the cubic's theta1, which is off by rounding where the target is
    # tiny.
    x = jnp.where(at_angle, guess[1] * lax.stop_gradient(release) / guess[0], guess[0])
    zero = jnp.zeros(())
    base = jnp.stack([jnp.where(at_angle, release, zero), zero])
    line = Line(base, jnp.where(at_angle, jnp.array([0.0, 1.0]), jnp.stack([1.0 + zero, ratio])))
    # The nodes do not see how fast the rods fly between them.
    still = lax.stop_gradient(line)
    between, _ = rate_along(fixed, still, x, log_time, steps_for(log_time, rate, turn))
    rate = jnp.fmax(rate, between)
    settings = Settings(turn, tolerance, jnp.where(found, max_iterations, 1), error)
    turns = jnp.zeros(2)
    newton, steps, change = solve_twice(fixed, still, x, log_time, rate, turns, "centred", settings)
    moved = jnp.abs(newton.x - x) > _LEFT * jnp.maximum(search.walk.length, jnp.abs(x))
    status = jnp.where(
        (newton.status == Status.CONVERGED) & moved, Status.LEFT_BRANCH, newton.status
    )
    status = jnp.where(found, status, search.status)
    newton = newton._replace(iterations=newton.iterations + search.iterations)
    orbit = orbit_at_root(pendulum, line, newton, steps, change, turns, "centred", status)
    return mirrored(orbit, sign)


# The walk's cubic is true to a few thousandths of its step: a root further away than this share of
# it is another orbit.
_LEFT = 0.1


# How fast either rod may turn where the motion rests, in units of its fastest before: the root has
# 1e-12, and grows by no more than the root of 1e16 up to the first of several rests. And how near
# to an equilibrium a search may end, in units of the swing.
_SAME = 1e-6
# Secants for the place of a rest within a step of 0.1 rad: it is then known to 1e-12 of the step.
_TRIES = 5


@partial(jax.jit, static_argnames=("symmetry", "error"))
def _near_guess(pendulum, line, x, log_time, symmetry, error, turn, tolerance, max_iterations):  # type: ignore[no-untyped-def]
    """The orbit to which Newton's method leads from (x, log of the shooting time), with its minimal
    period.
    """
    fixed, still = lax.stop_gradient((pendulum, line))
    rate = clock(fixed)
    for _ in range(2):  # the rate decides the steps, and the steps what rate is seen
        rate, end = rate_along(fixed, still, x, log_time, steps_for(log_time, rate, turn))
    turns = jnp.round(end / jnp.pi) if symmetry == "centred" else jnp.zeros(2)
    too_long = jnp.exp(log_time) * rate > turn * MOST_STEPS_IN_ONE_PIECE
    steps = jnp.where(too_long, 8, steps_for(log_time, rate, turn))
    most = jnp.where(too_long, 1, max_iterations)
    first = newton_on_line(fixed, still, x, log_time, steps, turns, symmetry, tolerance, most)
    angles = still.base + first.x * still.direction
    log_time, turns = _minimal(fixed, angles, first.log_time, steps, turns, symmetry)
    reduced = log_time < first.log_time
    settings = Settings(turn, tolerance, jnp.maximum(most - first.iterations, 1), error)
    newton, steps, change = solve_twice(
        fixed, still, first.x, log_time, first.shot.rate, turns, symmetry, settings
    )
    at_equilibrium = _swing(angles) < _SAME * jnp.minimum(
        1.0, _swing(still.base + x * still.direction)
    )
    # Many periods of an unstable orbit are too long for Newton's method, and one is not.
    status = jnp.where((first.status == Status.CONVERGED) | reduced, newton.status, first.status)
    status = jnp.where(too_long, Status.BEYOND_HORIZON, status)
    status = jnp.where(at_equilibrium, Status.TRIVIAL_ROOT, status)
    newton = newton._replace(iterations=first.iterations + newton.iterations)
    orbit = orbit_at_root(pendulum, line, newton, steps, change, turns, symmetry, status)
    unknown = jnp.where(too_long, jnp.nan, 0.0)
    return replace(orbit, kappa=orbit.kappa + unknown, log_abs_kappa=orbit.log_abs_kappa + unknown)


def _swing(angles: Array) -> Scalar:
    """How far a release is from the nearest equilibrium [rad, up to 1]: the scale of all that is
    small.
    """
    return jnp.max(jnp.abs(jnp.sin(angles)))


class _Pass(NamedTuple):
    """Where a search for a rest stands: a step that began at `state` and is tried up to `ahead` [s]
    from there.
    """

    state: State
    slope: Scalar  # of the kinetic energy, at `state`
    time: Scalar
    ahead: Scalar
    tries: Scalar  # of the step's lowest point; 0 while nothing is seen
    before: tuple[Scalar, Scalar]  # the last try: how far ahead, and the slope there
    next: tuple[State, Scalar]  # the step's end, and the slope there
    fastest: Float[Array, "2"]  # the largest rates so far
    end: State
    found: Scalar


def _first_rest(
    pendulum: Pendulum, angles: Array, log_time: Scalar, steps: Scalar
) -> tuple[Scalar, State, Scalar]:
    """The time of the first rest after the release, the state there, and whether there is one
    before exp(log_time).

    At a rest the kinetic energy has a minimum, whose place is where its slope vanishes: found by
    secants from the step in which the slope turns positive. All steps and tries are turns of one
    loop, each an integration step.
    """
    duration = jnp.exp(log_time)
    dt = step_size(duration, steps)

    def kinetic_slope(state: State) -> Scalar:
        rates, still = vector_field(pendulum, state), released(state.theta1, state.theta2)
        force = vector_field(pendulum, still)  # minus the slope of the potential energy
        return rates.theta1 * force.p1 + rates.theta2 * force.p2

    def rates_of(state: State) -> Array:
        rates = vector_field(pendulum, state)
        return jnp.abs(jnp.stack([rates.theta1, rates.theta2]))

    def turn(s: _Pass) -> _Pass:
        here = RK8.advance(pendulum, s.state, s.ahead)
        slope = kinetic_slope(here)
        seen = (s.tries == 0) & (s.slope < 0) & (slope >= 0)
        trying = s.tries > 0
        over = s.tries == _TRIES
        rest = over & jnp.all(rates_of(here) < _SAME * s.fastest)
        onto_next = (~trying & ~seen) | (over & ~rest)
        after, after_slope = jax.tree.map(partial(jnp.where, trying), s.next, (here, slope))
        last_ahead, last_slope = jax.tree.map(
            partial(jnp.where, trying), s.before, (jnp.zeros(()), s.slope)
        )
        secant = s.ahead - slope * (s.ahead - last_ahead) / (slope - last_slope)
        secant = jnp.where(jnp.isfinite(secant), jnp.clip(secant, 0.0, dt), s.ahead)
        keep = partial(jnp.where, onto_next)
        return _Pass(
            state=jax.tree.map(keep, after, s.state),
            slope=keep(after_slope, s.slope),
            time=s.time + jnp.where(onto_next, dt, jnp.where(rest, s.ahead, 0.0)),
            ahead=keep(dt, jnp.where(rest, s.ahead, secant)),
            tries=keep(0, s.tries + 1),
            before=(s.ahead, slope),
            next=(after, after_slope),
            fastest=jnp.fmax(s.fastest, jnp.where(onto_next, rates_of(after), 0.0)),
            end=here,
            found=rest,
        )

    state, zero = released(*angles), jnp.zeros(())
    none = (zero, zero), (state, zero), jnp.zeros(2), state, jnp.asarray(False)
    start = _Pass(state, zero, zero, dt, jnp.asarray(0), *none)
    s = lax.while_loop(lambda s: ~s.found & (s.time < duration - 0.5 * dt), turn, start)
    return s.time, s.end, s.found


def _minimal(
    pendulum: Pendulum, angles: Array, log_time: Scalar, steps: Scalar, turns: Array, symmetry: str
) -> tuple[Scalar, Array]:
    """The log of the shooting time that belongs to a root's minimal period, and the turns at its
    quarter.

    The first rest after the release is the orbit's other one, half the minimal period later.
    """
    time, rest, found = _first_rest(pendulum, angles, log_time, steps)
    if symmetry == "centred":
        time = 0.5 * time
        turns = jnp.where(
            found, jnp.round((angles + jnp.stack([rest.theta1, rest.theta2])) / (2 * jnp.pi)), turns
        )
    covers = jnp.round(jnp.exp(log_time) / jnp.where(found, time, 1.0))
    return jnp.where(found & (covers > 1), jnp.log(jnp.where(found, time, 1.0)), log_time), turns


def find_orbit(
    pendulum: Pendulum | Any,
    theta1: Scalar,
    *,
    branch: str | Any | None = None,
    guess: tuple[Scalar, Scalar] | Any | None = None,
    symmetry: str | Any | None = None,
    ratio: int | Any | None = None,
    crossing: int | Any = 1,
    turn: float | Any = FINE,
    tolerance: float | Any = 1e-13,
    max_iterations: int | Any = 40,
    error: bool | Any = True,
) -> PeriodicOrbit:
    """The periodic orbit released from rest at `theta1`: its partner angle theta2 and its period.

    Solves theta(T/4) = 0 modulo pi (centred) or p(T/2) = 0 (brake) for (theta2, T) by damped Newton
    iterations whose Jacobian is forward-mode through the flow. Give one of:

    - `branch`: follow the family of a normal mode by arclength, turning points included, from small
      swings to the first orbit with |theta1|. An orbit released at (-theta1, -theta2) counts: it is
      the same one, half a period later.
    - `guess`: start from (theta2, period) and take what Newton's method finds, reduced to its
      minimal period.
    - `ratio` alone: of the orbits with theta2 = ratio theta1 on the in-phase (+1) or anti-phase
      (-1) branch, or on `branch`, the one nearest to `theta1`, which is then an unknown too; with
      `guess`, the one near it.

    Negative `theta1` gives the mirror image. Derivatives of every result with respect to `theta1`
    and the pendulum are those of the root itself (implicit function theorem); with `jit`, `vmap`
    and `grad` all works, and what is wrong with a traced argument shows in `status`.

    Arguments:
        theta1: release angle of the upper rod [rad].
        branch: `in-phase` (slow mode) or `anti-phase` (fast mode).
        guess: theta2 [rad], period [s].
        symmetry: with `guess`, `centred` or `brake`. Without it the guess is solved as brake and
            solved again as centred if the orbit is that; under tracing it stays brake, of which
            every centred orbit is a case.
        ratio: +1 or -1.
        crossing: which of the branch's passages through `theta1`, in order of arclength.
        turn: how far the fastest motion may advance in one integration step [rad]; 0.1 leaves
            little but rounding.
        tolerance: on the last Newton update, of theta2 [rad] relative to an amplitude below 1, and
            of log T. 1e-13 is where rounding begins.
        max_iterations: Newton iterations at most, at least 1, which is to evaluate the guess.
        error: solve again at half the step for `error_estimate`; without it that is NaN.
    Returns:
        PeriodicOrbit. If its status is not `Status.CONVERGED` it holds the best iterate and its
        residual; if the branch does not reach `theta1` (`NO_SUCH_ORBIT`), the orbit where it came
        closest to upright in theta1.
    Raises:
        ValueError: theta1 not finite; none or more than one of branch and guess; theta1 a multiple
            of pi with `branch`; both angles at an equilibrium; g not positive; an unknown branch,
            symmetry or ratio; a period not positive.
        RuntimeError: float64 is switched off in JAX.
    See also: Peeters et al., Nonlinear normal modes II, Mechanical Systems and Signal Processing 23
    (2009): families of
        normal modes by shooting and arclength; Hristov et al., arXiv:2308.16159: the quarter
        period.
    """
    require_float64()
    theta1, crossing = number("theta1", theta1, unit="rad"), integer("crossing", crossing)
    _check_request(pendulum, theta1, branch, guess, symmetry, ratio, crossing)
    settings = {
        "error": flag("error", error),
        "turn": number("turn", turn, positive=True, unit="rad"),
        "tolerance": number("tolerance", tolerance, positive=True),
        # This may be traced: it bounds a loop.
        "max_iterations": max_iterations
        if is_traced(max_iterations)
        else integer("max_iterations", max_iterations),
    }
    for name, value in settings.items():
        single(name, value)
    theta1 = jnp.asarray(theta1, jnp.float64)
    if guess is None:
        slow = (branch or ("in-phase" if ratio == 1 else "anti-phase")) == "in-phase"
        return _on_branch(pendulum, theta1, slow, crossing, float(ratio or 0), **settings)
    theta2, period = (jnp.asarray(value, jnp.float64) for value in _guessed(guess))
    if ratio is None:
        line, x = Line(jnp.stack([theta1, 0.0]), jnp.array([0.0, 1.0])), theta2
    else:
        line, x = Line(jnp.zeros(2), jnp.array([1.0, ratio])), theta1

    def solve(x: Scalar, period: Scalar, symmetry: str) -> PeriodicOrbit:
        x, log_time = lax.stop_gradient((x, jnp.log(period / PARTS[symmetry])))
        return _near_guess(pendulum, line, x, log_time, symmetry, **settings)

    orbit = solve(x, period, symmetry or "brake")
    if symmetry is not None or known_value(orbit.status) != Status.CONVERGED:
        return orbit
    centred = solve(orbit.theta2 if ratio is None else orbit.theta1, orbit.period, "centred")
    if not _is_same(centred, orbit):
        return orbit
    return replace(centred, iterations=orbit.iterations + centred.iterations)


def _check_request(  # type: ignore[no-untyped-def]
    pendulum: Pendulum | Any, theta1: Scalar, branch, guess, symmetry, ratio, crossing
) -> None:
    """Refuses what cannot be asked, as far as the values are known before tracing."""
    check_pendulum(pendulum)
    for name, value, words in (
        ("branch", branch, BRANCHES),
        ("symmetry", symmetry, RELEASED_SYMMETRIES),
    ):
        if value is not None:
            one_of(name, value, words)
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
    for name, value in {"theta1": theta1, **vars(pendulum)}.items():
        single(name, value)
    gravity, angle1 = known_value(pendulum.g), known_value(theta1)
    if angle1 is not None and not math.isfinite(angle1):
        raise ValueError(f"theta1 must be a finite number [rad], got {angle1}: give another theta1")
    if gravity is not None and not gravity > 0:
        raise ValueError(
            f"g must be positive for an orbit, got {gravity:g}: nothing swings back without gravity"
        )
    if guess is None:
        if angle1 is not None and _multiple_of_pi(angle1):
            raise ValueError(
                f"theta1 must not be a multiple of 180 degrees on a branch, got "
                f"{math.degrees(angle1):g} degrees: "
                "the branches pass there only in equilibrium"
            )
        return
    theta2, period = (known_value(value) for value in _guessed(guess))
    if period is not None and not period > 0:
        raise ValueError(f"period must be positive [s], got {period:g}: give another guess")
    if (
        angle1 is not None
        and theta2 is not None
        and _multiple_of_pi(angle1)
        and _multiple_of_pi(theta2)
    ):
        raise ValueError(
            f"theta2 must not be a multiple of 180 degrees with theta1 at {math.degrees(angle1):g} "
            f"degrees, "
            f"got {math.degrees(theta2):g} degrees: that is an equilibrium"
        )


def _guessed(guess: Any) -> tuple[Scalar, Scalar]:
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


def _multiple_of_pi(angle: float) -> bool:
    nearest = math.pi * round(angle / math.pi)
    # Below 1e-100 the products of two amplitudes leave the range of float64: that is zero, too.
    return abs(angle - nearest) <= max(4 * sys.float_info.epsilon * abs(nearest), 1e-100)


def _is_same(one: PeriodicOrbit, other: PeriodicOrbit) -> bool:
    """Whether two converged orbits are one: angles within 1e-8 rad and periods within 1e-8 of each
    other.
    """
    known = [
        float(known_value(leaf) or 0.0)
        for o in (one, other)
        for leaf in (o.theta1, o.theta2, o.period)
    ]
    apart = max(abs(known[0] - known[3]), abs(known[1] - known[4]))
    longer = abs(known[2] / known[5] - 1)
    return known_value(one.status) == Status.CONVERGED and max(apart, longer) < 1e-8
