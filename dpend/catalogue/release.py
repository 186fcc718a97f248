"""Every brake orbit of one release angle up to a period.

`scan` finds all returns to rest, `find_orbit` solves them to rounding.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from dpend._runtime import require_float64
from dpend.catalogue.atlas import Atlas, Coverage
from dpend.catalogue.rows import Releases
from dpend.catalogue.scan import (
    MOTIONS_PER_WAVE,
    RETURNS_PER_WAVE,
    Budget,
    Outlook,
    Scan,
    Zero,
    foresee,
    longest,
    scan_circle,
)
from dpend.catalogue.table import stack_tables, table_of
from dpend.checks import function, known_number
from dpend.mechanics.pendulum import Pendulum
from dpend.mechanics.trig import LARGEST_ANGLE
from dpend.mechanics.units import natural
from dpend.orbits.find import find_orbit, swinging_pendulum
from dpend.orbits.orbit import PeriodicOrbit
from dpend.status import Status

# Intervals of theta2 that the first scan begins with.
_INTERVALS = 128
# The most doublings of the intervals.
_MOST_REFINEMENTS = 6
# Time steps that a search may take by default: twenty minutes on one core.
MOST_SEARCH_STEPS = 300_000_000
# Time that a step takes [s]: 2 to 8 microseconds, by pendulum and machine.
SECONDS_PER_STEP = 4e-6
# `find_orbit` takes about as long for one return as so many time steps.
STEPS_PER_ORBIT = 10_000
# Larger numbers of steps are not counted.
COUNTABLE = 10**18
# The largest ratio of masses, as a power of ten. At 1e200 products of momenta fall below what
# float64 holds.
_FARTHEST_MASSES = 30
# The largest ratio of lengths, as a power of ten. At 1e28 the lower rod's momentum is lost in what
# the upper rod adds to it.
_FARTHEST_LENGTHS = 12
# The largest unit of time, energy or momentum in SI units, as a power of ten.
_FARTHEST_UNIT = 90
# A scan goes on for this share of the time asked for, so that an orbit of just the longest period
# lies inside.
BEYOND = 1e-3
# An orbit of the longest period is in the list although its period is rounded by this share.
PERIOD_ROUNDING = 1e-12
# A return is known to this share of its cell.
_LOCATED = 0.2
# A return is known to no better than this [rad], however narrow its cell.
_LEAST_LOCATED = 1e-12
# Below this |sin(theta1)| the release is at 0 or 180 degrees, which are their own mirror images.
_OWN_MIRROR = 1e-12


def find_brake_orbits(
    pendulum: Pendulum | Any,
    *,
    theta1: Any,
    max_period: Any,
    most_steps: Any = MOST_SEARCH_STEPS,
    progress: Callable[[int, int], None] | Any | None = None,
) -> Atlas:
    """Every orbit released from rest at `theta1` with a period of at most `max_period`: all its
    partners theta2.

    The returns to rest are all zeros of (p1, p2) in (theta2, t), found cell by cell (see `scan`).
    The scan is repeated from twice as many intervals of theta2 until the number of returns has
    stood through two repetitions; then each return is solved by `find_orbit`. An orbit run through
    several times is listed once with its minimal period; where theta1 is 0 or 180 degrees, so is
    one of each pair of mirror images (theta1, theta2) and (theta1, -theta2). Where both rests of an
    orbit, or one and the mirror image of the other, have theta1, both are listed, being two
    releases.

    Arguments:
        pendulum: its fields are numbers; g positive.
        theta1: release angle of the upper rod [rad].
        max_period: [s]. The number of orbits, and the time it takes, grows exponentially with it.
        most_steps: time steps of all motions, 2 to 8 microseconds each on one core. A search that
            will take more is refused before it begins; one that takes more after all ends there,
            and its coverage says `exhausted`.
        progress: called with the time steps so far, and with those that are expected in all.
    Returns:
        Atlas, in order of the period; theta2 in (-pi, pi].
    Raises:
        ValueError: theta1 not finite, or beyond 1.3e7 rad; max_period not positive, or so long that
            the fast normal mode would swing 32 times, or that most_steps are not enough; g not
            positive; a traced argument; lengths, masses or g whose products leave the range of
            float64.
        RuntimeError: float64 is switched off in JAX.
    """
    require_float64()
    fixed = swinging_pendulum(pendulum)
    theta1, most_steps = _check_angle(theta1), known_number("most_steps", most_steps, positive=True)
    if progress is not None:
        function("progress", progress, "(steps taken, steps expected)", "print")
    max_period = check_period(fixed, max_period)
    expected = foresee_steps(fixed, max_period, theta1)
    budget = make_budget(most_steps, expected, max_period)
    if progress is not None:
        progress(0, expected)
        budget.tell = lambda spent: progress(spent, max(spent, expected))

    def scan(intervals: int) -> Scan:
        return returns(fixed, theta1, max_period, intervals, budget)

    result, refinement, unsettled = settle(scan, budget)
    found, lost = _solve_returns(fixed, theta1, max_period, result, budget)
    coverage = Coverage(
        theta2_points=result.motions,
        time_points=result.rows,
        refinements=refinement,
        suspicious_cells=len(result.open_cells)
        + lost
        + abs(result.winding - result.degree)
        + unsettled,
        winding=result.winding,
        degree=result.degree,
        exhausted=budget.exhausted,
    )
    return Atlas(fixed, max_period, stack_tables([_row(orbit) for orbit in found]), (), coverage)


def settle(scan: Callable[[int], Scan], budget: Budget) -> tuple[Scan, int, int]:
    """The scan from so many intervals that the number of returns has stood through two doublings of
    them, how many doublings there were, and by how much the last ones changed the number.
    """
    counts: list[int] = []
    for refinement in range(_MOST_REFINEMENTS + 1):
        result = scan(_INTERVALS << refinement)
        counts.append(len(result.zeros))
        unsettled = max(counts[-3:]) - min(counts[-3:])
        if (len(counts) > 2 and not unsettled) or budget.exhausted:
            break
    return result, refinement, unsettled


def _check_angle(theta1: Any) -> float:
    value = known_number("theta1", theta1, unit="rad")
    if abs(value) > LARGEST_ANGLE:
        raise ValueError(
            f"theta1 must be at most {LARGEST_ANGLE:.2g} rad, beyond which its sine has no digits "
            f"left, got {value:g}: take off full turns"
        )
    return value


def check_period(pendulum: Pendulum, max_period: Any, faster: float = 1.0) -> float:
    """`max_period`, refused where no scan reaches, and pendulums that float64 cannot hold.

    `faster`: the speeds of the motions over those of releases.
    """
    value = known_number("max_period", max_period, positive=True, unit="s")
    _check_scales(pendulum)
    second = math.sqrt(pendulum.l1 / pendulum.g)
    most = 2 * longest(jax.tree.map(float, natural(pendulum))) * second / faster
    if value > most:
        raise ValueError(
            f"max_period must be at most {most:.4g} s for this pendulum, got {value:g}: ask for "
            f"less"
        )
    return value


def _check_scales(pendulum: Pendulum) -> None:
    """Refuses a pendulum whose numbers are so far apart that their products leave the range of
    float64.
    """
    l1, l2, m1, m2, g = (
        math.log10(float(getattr(pendulum, name))) for name in ("l1", "l2", "m1", "m2", "g")
    )
    for names, ratio, most in (
        ("l1 and l2", l2 - l1, _FARTHEST_LENGTHS),
        ("m1 and m2", m2 - m1, _FARTHEST_MASSES),
    ):
        if abs(ratio) > most:
            values = " and ".join(
                f"{float(getattr(pendulum, name)):g}" for name in names.split(" and ")
            )
            raise ValueError(
                f"{names} must be within a factor of 1e{most} of each other, beyond which float64 "
                f"loses the momenta, got {values}: give others"
            )
    units = {
        "sqrt(l1/g)": 0.5 * (l1 - g),
        "m1 g l1": m1 + g + l1,
        "m1 l1 sqrt(g l1)": m1 + 1.5 * l1 + 0.5 * g,
    }
    for name, size in units.items():
        if abs(size) > _FARTHEST_UNIT:
            raise ValueError(
                f"{name} must be within 1e-{_FARTHEST_UNIT} and 1e{_FARTHEST_UNIT} in SI units, "
                f"beyond which products leave the range of float64, got 1e{size:.0f}: use other "
                "units"
            )


def foresee_steps(pendulum: Pendulum, max_period: float, theta1: float) -> int:
    """The time steps that `find_brake_orbits` will take, roughly: three scans, and the returns
    solved.
    """
    return steps_of(foresee_returns(pendulum, theta1, max_period))


def steps_of(seen: Outlook) -> int:
    """The time steps of three scans, and of the returns solved."""
    motions = 2 * (_INTERVALS << 3) + 3 * MOTIONS_PER_WAVE * seen.waves
    return int(
        min(motions * seen.rows + RETURNS_PER_WAVE * seen.waves * STEPS_PER_ORBIT, COUNTABLE)
    )


def foresee_returns(pendulum: Pendulum, theta1: float, max_period: float) -> Outlook:
    """What `returns` has before it."""
    scaled, half, _ = in_natural_units(pendulum, max_period)
    return foresee(Releases(scaled, math.remainder(theta1, 2 * math.pi)), half)


def make_budget(most_steps: float, expected: int, max_period: float) -> Budget:
    """`most_steps`, refused if the search is expected to take more."""
    if most_steps < expected:
        raise ValueError(
            f"max_period must be so short that most_steps, {most_steps:g}, are enough, got "
            f"{max_period:g} s, which takes about {expected:.1g}, "
            f"{expected * SECONDS_PER_STEP:.1g} s of time: ask for less, or raise most_steps"
        )
    return Budget(int(min(most_steps, COUNTABLE)))


def in_natural_units(pendulum: Pendulum, max_period: float) -> tuple[Pendulum, float, float]:
    """The pendulum, the longest half period with a margin, and the second."""
    second = math.sqrt(pendulum.l1 / pendulum.g)
    return jax.tree.map(float, natural(pendulum)), 0.5 * max_period / second * (1 + BEYOND), second


def returns(
    pendulum: Pendulum, theta1: float, max_period: float, intervals: int, budget: Budget
) -> Scan:
    """All returns to rest within half of `max_period`, times in seconds."""
    scaled, half, second = in_natural_units(pendulum, max_period)
    circle = Releases(scaled, math.remainder(theta1, 2 * math.pi))
    result = scan_circle(circle, half, intervals, budget)
    zeros = tuple(
        zero._replace(time=zero.time * second, row=zero.row * second) for zero in result.zeros
    )
    return replace(result, zeros=zeros)


def _solve_returns(
    pendulum: Pendulum, theta1: float, max_period: float, result: Scan, budget: Budget
) -> tuple[list[PeriodicOrbit], int]:
    """The orbits to which the returns belong, in order of the period, and the number that Newton's
    method lost.
    """
    found: list[PeriodicOrbit] = []
    known = np.zeros((0, 2))
    lost = 0
    own_mirror = abs(math.sin(theta1)) < _OWN_MIRROR
    for zero in sorted(result.zeros, key=lambda zero: zero.time):
        if (own_mirror and zero.angle < 0) or np.any(are_returns(known, zero)):
            continue
        if budget.exhausted:
            lost += 1
            continue
        orbit = find_orbit(pendulum, theta1, guess=(zero.angle, 2 * zero.time))
        budget.spend(STEPS_PER_ORBIT)
        if int(orbit.status) != Status.CONVERGED or not is_return(orbit, zero):
            lost += 1
        elif float(orbit.period) <= max_period * (1 + PERIOD_ROUNDING):
            found.append(orbit)
            known = np.vstack([known, _place_of(orbit)])
    return sorted(found, key=lambda orbit: float(orbit.period)), lost


def is_return(orbit: PeriodicOrbit, zero: Zero) -> bool:
    """Whether a return to rest is that of an orbit, maybe run through several times."""
    return bool(are_returns(_place_of(orbit), zero)[0])


def _place_of(orbit: PeriodicOrbit) -> np.ndarray:
    return np.array([[float(orbit.theta2), 0.5 * float(orbit.period)]])


def are_returns(places: np.ndarray, zero: Zero) -> np.ndarray:
    """The same of many orbits' theta2 and half periods, shape (n, 2)."""
    apart = np.abs(places[:, 0] - zero.angle)
    apart = np.abs(apart - 2 * np.pi * np.round(apart / (2 * np.pi)))
    half = places[:, 1]
    late = np.abs(zero.time - half * np.maximum(1, np.round(zero.time / half)))
    near: np.ndarray = (apart < max(_LOCATED * zero.width, _LEAST_LOCATED)) & (
        late < _LOCATED * zero.row
    )
    return near


def _row(orbit: PeriodicOrbit) -> dict[str, np.ndarray]:
    return table_of(
        jax.tree.map(lambda leaf: np.asarray(leaf)[None], orbit), "", np.full(1, np.nan)
    )
