"""The numbers of the paper: its motions computed twice, and every printed value beside ours with a
verdict.

Iwao Yamaguchi, "On the periodical behavior of a double pendulum" (in Japanese): point masses on
massless rods, l = 0.2 m, m = 0.1 kg, g = 9.8 m/s^2, RK4 with a step of 1 ms, six periodic motions A
to F and a chaotic one. `as printed`: the printed angles, degrees times 3.14/180 as the paper's
program has it, RK4 at 1 ms. `true`: pi, order 8 at 1 ms, the partner angle solved for. Run by
paper.py.
"""

import csv
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from digits import round_up, show

import dpend

PAPER = dpend.Pendulum()
MODES = ("as printed", "true")
DEGREE = {"as printed": 3.14 / 180, "true": math.pi / 180}
STEP = 1e-3
# What is computed for most numbers: each mode, and for its error the true one at half the step.
RUNS = (("as printed",), ("true",), ("true", 2))


# --- motions --------------------------------------------------------------------------------------


class Case(NamedTuple):
    """A periodic motion of the paper: printed release [deg] and period [s], and its strobe's step
    [s].
    """

    theta1: str
    theta2: str
    period: str
    branch: str
    strobe: float


CASES = {
    "A": Case("64.3", "64.3", "1.25", "in-phase", 0.03),
    "B": Case("40", "49.1", "1.2", "in-phase", 0.03),
    "C": Case("10", "14.1", "1.17", "in-phase", 0.05),
    "D": Case("63.95", "-63.95", "0.92", "anti-phase", 0.015),
    "E": Case("40", "-51.2", "0.75", "anti-phase", 0.015),
    "F": Case("10", "-14.1", "0.49", "anti-phase", 0.03),
}


class Motion(NamedTuple):
    """A sampled motion, NumPy arrays: times [s], angles [rad], angular velocities [rad/s], energies
    of the bobs [J].
    """

    time: np.ndarray
    theta1: np.ndarray
    theta2: np.ndarray
    omega1: np.ndarray
    omega2: np.ndarray
    p1: np.ndarray
    p2: np.ndarray
    kinetic1: np.ndarray
    potential1: np.ndarray
    kinetic2: np.ndarray
    potential2: np.ndarray

    def until(self, time: float) -> "Motion":
        """Its part up to `time` [s]."""
        count = int(np.searchsorted(self.time, time + 1e-9))
        return Motion(*(values[:count] for values in self))

    def every(self, step: float) -> "Motion":
        """Every step-th second of it."""
        return Motion(*(values[:: round(step / (self.time[1] - self.time[0]))] for values in self))

    def at(self, name: str, time: float) -> float:
        """A value between samples."""
        return float(np.interp(time, self.time, getattr(self, name)))


def motion_from(theta1: float, theta2: float, duration: float, mode: str, finer: int = 1) -> Motion:
    """The motion from a release [rad]; `finer` divides the step."""
    method = "rk4" if mode == "as printed" else "rk8"
    found = dpend.simulate(
        PAPER,
        dpend.released(theta1, theta2),
        duration,
        step=STEP / finer,
        method=method,
        error=False,
    )
    omega = dpend.velocities(PAPER, found.state)
    state = found.state
    arrays = (found.time, state.theta1, state.theta2, *omega, state.p1, state.p2, *_bobs(state))
    return Motion(*(np.asarray(values) for values in arrays))


def _bobs(state: dpend.State) -> tuple:
    bobs = dpend.energies(PAPER, state)
    return bobs.kinetic1, bobs.potential1, bobs.kinetic2, bobs.potential2


@cache
def orbit_of(name: str, mode: str, finer: int = 1) -> dpend.PeriodicOrbit:
    """The periodic orbit released at the case's first angle, in that mode's degrees; `finer`
    divides the step.
    """
    case = CASES[name]
    return dpend.find_orbit(
        PAPER, float(case.theta1) * DEGREE[mode], branch=case.branch, turn=0.1 / finer
    )


@cache
def release_of(name: str, mode: str) -> tuple[float, float]:
    """Where the case starts [rad]: as printed, or with the partner that is solved for."""
    case, degree = CASES[name], DEGREE[mode]
    if mode == "as printed":
        return float(case.theta1) * degree, float(case.theta2) * degree
    return float(case.theta1) * degree, float(orbit_of(name, mode).theta2)


@cache
def motion_of(name: str, mode: str, finer: int = 1) -> Motion:
    """Three seconds of a case."""
    return motion_from(*release_of(name, mode), 3.0, mode, finer)


@cache
def chaos_of(mode: str, finer: int = 1, apart: float = 0.0) -> Motion:
    """Five seconds from (170 + apart, 180 - apart) deg."""
    degree = DEGREE[mode]
    return motion_from((170 + apart) * degree, (180 - apart) * degree, 5.0, mode, finer)


def parting_time() -> float:
    """When an angle of the chaotic motion as printed is first 0.1 rad from the true one [s]."""
    a, b = chaos_of("as printed"), chaos_of("true")
    gap = np.maximum(np.abs(a.theta1 - b.theta1), np.abs(a.theta2 - b.theta2))
    return float(a.time[np.argmax(gap > 0.1)])


# --- what is read off a motion --------------------------------------------------------------------


def crossings(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The times at which values change sign, by straight lines between samples."""
    i = np.flatnonzero(values[:-1] * values[1:] < 0)
    return time[i] + (time[i + 1] - time[i]) * values[i] / (values[i] - values[i + 1])


def peaks(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The times of local maxima, by parabolas through three samples."""
    i = np.flatnonzero((values[1:-1] > values[:-2]) & (values[1:-1] >= values[2:])) + 1
    before, here, after = values[i - 1], values[i], values[i + 1]
    return time[i] + 0.5 * (time[1] - time[0]) * (before - after) / (before - 2 * here + after)


def greatest(values: np.ndarray) -> float:
    """The greatest value, by a parabola through three samples unless it is at an end."""
    i = int(np.argmax(values))
    if i in (0, values.size - 1):
        return float(values[i])
    before, here, after = values[i - 1 : i + 2]
    return float(here - 0.125 * (before - after) ** 2 / (before - 2 * here + after))


def bound(value: float, finer: float) -> float:
    """The error of a value read off samples, told by the same at half the sampling step: twice the
    change.

    A straight line between samples is off by s (1 - s) in units that fall fourfold with half the
    step, s being where in its interval the instant lies. What half the step leaves is then at most
    half of it, whatever s.
    """
    return 2 * abs(finer - value)


def bottom(motion: Motion, rod: int) -> float:
    """When a rod first hangs straight down [s]."""
    return float(crossings(motion.time, motion.theta1 if rod == 1 else motion.theta2)[0])


def rest(motion: Motion, rod: int) -> float:
    """When a rod that was released comes to its first rest [s]."""
    return float(crossings(motion.time, motion.omega1 if rod == 1 else motion.omega2)[0])


def first_peak(motion: Motion, bob: int) -> float:
    """When a bob's kinetic energy has its first maximum [s]."""
    return float(peaks(motion.time, motion.kinetic1 if bob == 1 else motion.kinetic2)[0])


def return_time(motion: Motion) -> float:
    """When the upper rod, released, comes to rest for the second time [s]: the period, where the
    motion comes back.
    """
    return float(crossings(motion.time, motion.omega1)[1])


def bend(motion: Motion) -> float:
    """How far the path in the two angles, up to the first rest, lies from a straight line through
    its ends [deg].
    """
    end = rest(motion, 1)
    part = motion.until(end)
    chord = np.array(
        [motion.at("theta1", end) - part.theta1[0], motion.at("theta2", end) - part.theta2[0]]
    )
    away = chord[0] * (part.theta2 - part.theta2[0]) - chord[1] * (part.theta1 - part.theta1[0])
    return math.degrees(greatest(np.abs(away)) / np.hypot(*chord))


def together(motion: Motion) -> float:
    """By how much the rods miss hanging, and resting, at the same time; the larger [s]."""
    return max(abs(bottom(motion, 1) - bottom(motion, 2)), abs(rest(motion, 1) - rest(motion, 2)))


def early(motion: Motion, bob: int) -> float:
    """How long before its rod hangs straight down a bob's kinetic energy is greatest [s]."""
    return bottom(motion, bob) - first_peak(motion, bob)


def upper_somersaults(motion: Motion) -> np.ndarray:
    """When theta1 crosses pi, modulo 2 pi [s]."""
    return crossings(motion.time, np.cos(motion.theta1 / 2))


def lower_somersaults(motion: Motion) -> np.ndarray:
    """The paper's somersaults of bob 2: local maxima of its potential energy [s]."""
    return peaks(motion.time, motion.potential2)


def separation(mode: str, finer: int = 1) -> tuple[np.ndarray, np.ndarray, float]:
    """Times [s], ln(d/d(0)) and d(0) of the paper's separation: the norm of the differences, angles
    and SI momenta.
    """
    a, b = (chaos_of(mode, finer, apart).until(4.0) for apart in (0.0, 1e-6))
    d = np.sqrt(
        sum((getattr(a, key) - getattr(b, key)) ** 2 for key in ("theta1", "theta2", "p1", "p2"))
    )
    return a.time, np.log(d / d[0]), float(d[0])


def rough_slope(time: np.ndarray, logs: np.ndarray) -> float:
    """A line drawn by eye from the point at t = 0: the median slope to the points of the second
    half.
    """
    late = time > 0.5 * time[-1]
    return float(np.median(logs[late] / time[late]))


@cache
def running_exponent() -> tuple[np.ndarray, np.ndarray, dict]:
    """Times, the running exponent of the chaotic motion, and the converged one with its uncertainty
    [1/s].
    """
    state = dpend.released(170 * DEGREE["true"], 180 * DEGREE["true"])
    scheme = dpend.scheme_for(PAPER, 1e-6)
    size, seconds = dpend.chaos.norm(PAPER), 10_000

    def second(carry, _):  # type: ignore[no-untyped-def]
        (end, tangent) = dpend.fold(
            _last, carry[0], PAPER, carry[0], 1.0, scheme, tangents=carry[1]
        )
        length = jax.numpy.sqrt(size.square(tangent))
        return (end, jax.tree.map(lambda x: x / length, tangent)), jax.numpy.log(length)

    start = (jax.tree.map(jax.numpy.asarray, state), size.vector(*dpend.chaos.GENERIC))
    _, logs = jax.lax.scan(second, start, None, length=seconds)
    time = np.arange(1, seconds + 1.0)
    converged = dpend.chaos.maximal_lyapunov(PAPER, state, scheme, duration=float(seconds))
    return (
        time,
        np.cumsum(np.asarray(logs)) / time,
        {key: float(value) for key, value in converged.items()},
    )


def _last(carry, time, dt, state, tangent):  # type: ignore[no-untyped-def]
    return state, tangent


# --- the printed numbers --------------------------------------------------------------------------

CONFIRMED, ONLY_PRINTED, DIFFERS = "confirmed", "confirmed as printed only", "differs"


@dataclass(frozen=True)
class Claim:
    """A printed number beside ours.

    `error` bounds the true one and `rounding` is how far processors may differ in both; zero for
    counts. `verdict` begins with one of the three words.
    """

    section: str
    quantity: str
    printed: str
    as_printed: float
    true: float
    error: float
    unit: str
    verdict: str
    rounding: float = 0.0


# How far two processors may differ in a number, by its unit: a thousand times what they were seen
# to (with and without AVX-512, and the options of XLA that dpend sets). No error bound is less.
ROUNDING = {"deg": 1e-10, "rad": 1e-12, "s": 1e-12, "J": 1e-12, "rad/s": 1e-12, "": 1e-10}
# The same where a motion magnifies rounding: over eight periods of the unstable D (its miss was
# seen to differ by 1e-9 degrees), over 5 s of the chaotic one (somersaults 2e-11 s, the logarithms
# of distances of 1e-8 rad 2e-6/s), and over 10 000 s of it, where an exponent is one of many.
_UNSTABLE, _CHAOTIC, _PARTING, _LONG = 1e-7, 1e-8, 1e-4, 0.1


def rounds_to(value: float, printed: str) -> bool:
    """Whether a value, rounded to as many decimals as were printed, is the printed one."""
    decimals = len(printed.partition(".")[2])
    return abs(value - float(printed)) <= 0.5 * 10.0**-decimals * (1 + 1e-9)


def judged(printed: str, as_printed: float, true: float, reason: str) -> str:
    """The verdict on a printed number by its own digits, with what it would have to be, and
    `reason`.
    """
    both = rounds_to(as_printed, printed), rounds_to(true, printed)
    if all(both):
        return CONFIRMED
    decimals = len(printed.partition(".")[2])

    def told(value: float) -> str:
        return (
            f"{value:.{decimals + 2}f} rounds to {value:.{decimals}f}"
            if decimals
            else f"there are {value:g}"
        )

    said = (
        f"made with 3.14 it is another, {told(as_printed)}; with pi, {told(true)}"
        if both[1]
        else told(true)
    )
    return f"{ONLY_PRINTED if both[0] else DIFFERS}: {said}" + (f"; {reason}" if reason else "")


class Table:
    """The claims, as they are added."""

    def __init__(self) -> None:
        self.claims: list[Claim] = []

    def number(
        self, section, quantity, printed, as_printed, true, error, unit="", reason="", rounding=None
    ):  # type: ignore[no-untyped-def]
        """A printed number, judged by its own digits."""
        verdict = judged(printed, as_printed, true, reason)
        self._add(section, quantity, printed, as_printed, true, error, unit, verdict, rounding)

    def statement(
        self,
        section,
        quantity,
        printed,
        as_printed,
        true,
        error,
        unit,
        holds,
        reason="",
        rounding=None,
    ):  # type: ignore[no-untyped-def]
        """Something said in words, judged by a measure of it: `holds`, or not and why."""
        verdict = CONFIRMED if holds else f"{DIFFERS}: {reason}"
        self._add(section, quantity, printed, as_printed, true, error, unit, verdict, rounding)

    def _add(self, section, quantity, printed, as_printed, true, error, unit, verdict, rounding):  # type: ignore[no-untyped-def]
        if rounding is None:
            rounding = 0.0 if isinstance(true, int) else ROUNDING.get(unit, ROUNDING[""])
        error = round_up(max(error, rounding))
        self.claims.append(
            Claim(section, quantity, printed, as_printed, true, error, unit, verdict, rounding)
        )

    def read(self, section, quantity, printed, name, value, unit="", reason=""):  # type: ignore[no-untyped-def]
        """A number that `value` reads off the motion of a case; its error, by half the sampling
        step.
        """
        # Angles are read in radians, and told in the degrees of their mode.
        as_printed, true, finer = (
            value(motion_of(name, *which)) / (DEGREE[which[0]] if unit == "deg" else 1.0)
            for which in RUNS
        )
        self.number(section, quantity, printed, as_printed, true, bound(true, finer), unit, reason)


def claims() -> list[Claim]:
    """Every number printed in the paper, and what it says in words, with ours and a verdict."""
    table = Table()
    releases_and_periods(table)
    case_a(table)
    case_d(table)
    what_is_said(table)
    linear_theory(table)
    chaotic_motion(table)
    misprints(table)
    return table.claims


_WHY_PARTNER = {
    "C": "14.1 is 10 sqrt 2 of the linear theory",
    "D": f"63.95 of its degrees are {63.95 * 3.14 / math.pi:.4f} true ones, and there theta2 = "
    f"-theta1 comes back",
}
_WHY_PERIOD = {"A": "1.25 is cut off, not rounded", "C": "1.17 is the linear theory's, or cut off",
               "F": "0.49 is the linear theory's"}  # fmt: skip


def releases_and_periods(table: Table) -> None:
    """Section 4: the partner angles and periods of A to F, and the release of the book it cites."""
    on_line = dpend.find_orbit(dpend.Pendulum(1.0, 1.0, 1.0, 1.0), math.radians(63.3), ratio=1)
    angle = math.degrees(on_line.theta1)
    table.number(
        "4", "Schwalbe and Wagon (l = 1 m, m = 1 kg): theta1 = "
             "theta2", "63.3", angle * math.pi / 3.14, angle,
        math.degrees(on_line.error_estimate[0]), "deg", "the angle depends on neither length nor "
                                                        "mass",
    )  # fmt: skip
    for name, case in CASES.items():
        orbits = {mode: orbit_of(name, mode) for mode in MODES}
        partner = {mode: float(orbit.theta2) / DEGREE[mode] for mode, orbit in orbits.items()}
        angle_error, period_error = orbits["true"].error_estimate
        table.number(
            name, f"theta2 that belongs to theta1 = {case.theta1} "
                  f"deg", case.theta2, *partner.values(),
            math.degrees(angle_error), "deg", _WHY_PARTNER.get(name, ""),
        )  # fmt: skip
        period = return_time(motion_of(name, "as printed"))
        table.number(
            name,
            "period",
            case.period,
            period,
            float(orbits["true"].period),
            float(period_error),
            "s",
            _WHY_PERIOD.get(name, ""),
        )
    for name, ratio, printed in (("A", 1, "64.3"), ("D", -1, "63.95")):
        found = dpend.find_orbit(PAPER, math.radians(64), ratio=ratio)
        angle = math.degrees(found.theta1)
        table.number(
            name, f"release with theta2 = "
                  f"{'-' if ratio < 0 else ''}theta1", printed, angle * math.pi / 3.14, angle,
            math.degrees(found.error_estimate[0]), "deg", _WHY_PARTNER.get(name, ""),
        )  # fmt: skip
    for name, printed in (("A", "1.12"), ("D", "1.116")):
        angles = [float(CASES[name].theta1) * DEGREE[mode] for mode in MODES]
        table.number(name, "release", printed, *angles, 0.0, "rad")
    for name, sign in (("C", 1), ("F", -1)):
        partners = [float(orbit_of(name, mode).theta2) / DEGREE[mode] for mode in MODES]
        table.statement(
            name, "theta2 is exactly 10 sqrt 2 deg", f"{sign * 10 * math.sqrt(2):.4f}", *partners,
            math.degrees(orbit_of(name, "true").error_estimate[0]), "deg", False,
            "it is so in the linear theory only",
        )  # fmt: skip


def case_a(table: Table) -> None:
    """Energies, partial times and stages of A."""
    motion = motion_of("A", "true")
    when = float(crossings(motion.time, motion.potential1 - 0.032)[0])
    angles = ", ".join(
        f"{math.degrees(motion.at(name, when)):.1f}" for name in ("theta1", "theta2")
    )
    again = (
        f"the printed triple is not one instant: 0.032 J belongs to {when:.3f} s, ({angles}) deg"
    )

    def there(name: str) -> Callable[[Motion], float]:
        return lambda motion: motion.at(name, first_peak(motion, 1))

    def below(name: str) -> Callable[[Motion], float]:
        return lambda motion: motion.at(name, bottom(motion, 1 if name.endswith("1") else 2))

    read = partial(table.read, "A", name="A")
    points = [motion_of("A", mode).until(2.9905).every(0.01).time.size for mode in MODES]
    table.number("A", "points of figure 2", "300", *points, 0.0)
    read("PE1 at the release", "0.11", value=lambda m: m.potential1[0], unit="J")
    read("PE2 at the release", "0.22", value=lambda m: m.potential2[0], unit="J")
    read("KE1 at its peak", "0.053", value=there("kinetic1"), unit="J")
    read("PE1 at KE1's peak", "0.032", value=there("potential1"), unit="J", reason=again)
    read("KE1 at the bottom", "0.013", value=below("kinetic1"), unit="J")
    read("PE1 at the bottom", "0", value=below("potential1"), unit="J")
    read("KE2 at the bottom", "0.32", value=below("kinetic2"), unit="J")
    read("PE2 at the bottom", "0", value=below("potential2"), unit="J")
    read("time of KE1's peak", "0.17", value=lambda m: first_peak(m, 1), unit="s")
    read("time of the bottom, KE1 = 0.013 J", "0.31", value=lambda m: bottom(m, 1), unit="s")
    read(
        "time of KE1's second peak",
        "0.45",
        value=lambda m: float(peaks(m.time, m.kinetic1)[1]),
        unit="s",
    )
    read("time of the rest, KE1 = 0", "0.63", value=lambda m: rest(m, 1), unit="s")
    why = "at KE1's peak, where the upper rod starts to brake"
    read(
        "theta1 between the first two stages", "31.5", value=there("theta1"), unit="deg", reason=why
    )
    read(
        "theta2 between the first two stages", "57.3", value=there("theta2"), unit="deg", reason=why
    )
    read("theta1 between the first two stages", "0.55", value=there("theta1"), unit="rad")
    read(
        "theta2 between the first two stages", "1.00", value=there("theta2"), unit="rad", reason=why
    )

    def later(name: str) -> Callable[[Motion], float]:
        return lambda motion: motion.at(name, float(peaks(motion.time, motion.kinetic1)[1]))

    for name, printed, size in (("theta1", "-31.5", "-0.55"), ("theta2", "-57.3", "-1.00")):
        where = f"{name} between the last two stages"
        read(where, printed, value=later(name), unit="deg", reason=why)
        read(where, size, value=later(name), unit="rad", reason=why)
    for name in ("theta1", "theta2"):

        def turned(motion: Motion, name: str = name) -> float:
            return motion.at(name, rest(motion, int(name[-1])))

        read(f"{name} at the end of the half period", "-1.12", value=turned, unit="rad")
        read(f"{name} at the end of the half period", "-64.3", value=turned, unit="deg",
             reason="it swings to the mirror image of its own release")  # fmt: skip


def case_d(table: Table) -> None:
    """Energies of D."""
    read = partial(table.read, "D", name="D")
    by_pi = "the release made with 3.14 has less energy"

    def there(name: str) -> Callable[[Motion], float]:
        return lambda motion: motion.at(name, first_peak(motion, 2))

    def below(name: str, rod: int) -> Callable[[Motion], float]:
        return lambda motion: motion.at(name, bottom(motion, rod))

    read("PE1 at the release", "0.11", value=lambda m: m.potential1[0], unit="J")
    read("KE1 at the bottom", "0.31", value=below("kinetic1", 1), unit="J", reason=by_pi)
    read("PE1 at the bottom", "0", value=below("potential1", 1), unit="J")
    read("PE2 at the release", "0.22", value=lambda m: m.potential2[0], unit="J")
    read("KE2 at its peak", "0.13", value=there("kinetic2"), unit="J")
    read("PE2 at KE2's peak", "0.06", value=there("potential2"), unit="J")
    read("KE2 at the bottom", "0.015", value=below("kinetic2", 2), unit="J")
    read("PE2 at the bottom", "0", value=below("potential2", 2), unit="J")


def missed(theta1: float, theta2: float, period: float, count: int, finer: int = 1) -> float:
    """How far a release [rad] is from where it was after `count` periods; the larger angle
    [deg].
    """
    end = dpend.flow(
        PAPER, dpend.released(theta1, theta2), count * period, dpend.Scheme("rk8", 2 * STEP / finer)
    )
    return math.degrees(max(abs(float(end.theta1) - theta1), abs(float(end.theta2) - theta2)))


def what_is_said(table: Table) -> None:
    """Statements in words about A to F."""

    def measured(
        measure: Callable[[Motion], float], names: str, pick: Callable = max
    ) -> tuple[float, float, float]:
        """What is picked of a measure over some cases, as printed and true, and the latter's
        error.
        """
        as_printed, true, finer = (
            pick(measure(motion_of(name, *which)) for name in names) for which in RUNS
        )
        return as_printed, true, bound(true, finer)

    apart = measured(together, "ABCDEF")
    table.statement(
        "4", "angles hang, and rest, at the same time: worst miss of A to "
             "F", "together", *apart, "s", apart[1] < 1e-5,
    )  # fmt: skip
    for names, upper in (("AB", True), ("DEF", False)):
        first, second = (1, 2) if upper else (2, 1)
        rises = measured(lambda motion, bob=second: abs(early(motion, bob)), names)
        leads = measured(partial(early, bob=first), names, min)
        kind = "in-phase (A, B)" if upper else "anti-phase (D, E, F)"
        table.statement(
            "4", f"{kind}: bob {second} speeds up to the bottom; its peak's lead", "0", *rises, "s",
            rises[1] < 1e-5,
        )  # fmt: skip
        table.statement(
            "4",
            f"{kind}: bob {first} peaks before it; the least lead",
            "> 0",
            *leads,
            "s",
            leads[1] > 0.01,
        )
    both = measured(lambda motion: max(abs(early(motion, bob)) for bob in (1, 2)), "C")
    table.statement(
        "C", "both bobs speed up to the bottom; their peaks' lead", "0", *both, "s", both[1] < 1e-5
    )
    for name, printed, holds, reason in (
        (
            "C",
            "straight",
            lambda bend: bend < 0.05,
            "it bends by a hundredth of its length, less than the eye sees",
        ),
        ("E", "straight to the eye, strictly not", lambda bend: 0.01 < bend < 1, ""),
        ("F", "as E", lambda bend: 0.001 < bend < 1, ""),
    ):
        bends = measured(bend, name)
        table.statement(name, "the path's distance from a straight "
                              "line", printed, *bends, "deg", holds(bends[1]),
                        reason)  # fmt: skip
    angles = (1, 5, 20, 40, 60, 90, 120, 150, 170, 175)
    found = [
        sum(
            int(dpend.find_orbit(PAPER, angle * DEGREE[mode], branch=branch).status)
            == dpend.Status.CONVERGED
            for branch in ("in-phase", "anti-phase")
            for angle in angles
        )
        for mode in MODES
    ]
    table.statement("4", f"such pairs exist from small to large angles: of {2 * len(angles)} "
                         f"tried, 1 to 175 deg",
                    "all", *found, 0.0, "", found[1] == 2 * len(angles))  # fmt: skip
    stability(table)


def stability(table: Table) -> None:
    """Which of the motions would stay; the paper takes all for periodic."""
    for name in CASES:
        as_printed, true, finer = (float(orbit_of(name, *which).kappa) for which in RUNS)
        multiplier = true + math.sqrt(max(true**2 - 1, 0.0))
        table.statement(
            name, "stability index kappa: stable between -1 and 1", "a periodic "
                                                                    "motion", as_printed, true,
            bound(true, finer), "", abs(true) < 1, f"unstable: what is off grows {multiplier:.1f} "
                                                   f"times a period",
        )  # fmt: skip
    for count in (3, 5, 8):
        as_printed, true, finer = (
            missed(
                63.95 * DEGREE[mode],
                -63.95 * DEGREE[mode],
                float(orbit_of("D", mode).period),
                count,
                *finer,
            )
            for mode, *finer in RUNS
        )
        table.statement(
            "D",
            f"released at (63.95, -63.95) deg: miss after {count} periods",
            "comes back",
            as_printed,
            true,
            bound(true, finer),
            "deg",
            true < 0.1,
            "0.03 true degrees off an unstable motion",
            _UNSTABLE,
        )


def linear_theory(table: Table) -> None:
    """Its equations 6 to 9, and what C and F take from them."""
    for mode, name, omega, period in zip(
        dpend.normal_modes(PAPER), "CF", ("5.36", "12.93"), ("1.17", "0.49"), strict=True
    ):
        table.number(
            name, "linear theory: omega", omega, *2 * [float(mode.frequency)], 1e-14, "rad/s"
        )
        table.number(
            name,
            "linear theory: period",
            period,
            *2 * [2 * math.pi / float(mode.frequency)],
            1e-14,
            "s",
        )
        sign = 1 if name == "C" else -1
        ratio = float(mode.ratio)
        table.statement(
            name,
            "linear theory: c = theta2/theta1",
            f"{sign * math.sqrt(2):.6f}",
            ratio,
            ratio,
            1e-14,
            "",
            abs(ratio - sign * math.sqrt(2)) < 1e-12,
        )


def chaotic_motion(table: Table) -> None:
    """Section 5."""
    for angle, printed in ((170, "2.97"), (180, "3.14")):
        table.number(
            "5",
            f"release, {angle} deg",
            printed,
            *(angle * DEGREE[mode] for mode in MODES),
            0.0,
            "rad",
        )
    moves = {
        "as printed": chaos_of("as printed"),
        "true": chaos_of("true"),
        "finer": chaos_of("true", 2),
    }
    other = "the motions have parted: the paper's is made with 3.14 for pi"
    for bob, times, printed in (
        (1, upper_somersaults, ("1.56", "3.98")),
        (2, lower_somersaults, ("0.81", "1.40", "2.30", "3.12", "3.84", "4.48", "4.98")),
    ):
        found = {mode: times(motion) for mode, motion in moves.items()}
        counts = [found[mode].size for mode in MODES]
        table.number(
            "5", f"somersaults of bob {bob} in 5 s", str(len(printed)), *counts, 0.0, "", other
        )
        for index, text in enumerate(printed):
            as_printed, true, finer = (
                found[mode][index] for mode in ("as printed", "true", "finer")
            )
            table.number(
                "5", f"bob {bob}, somersault "
                     f"{index + 1}", text, as_printed, true, bound(true, finer), "s", other,
                _CHAOTIC,
            )  # fmt: skip
    total = [
        upper_somersaults(moves[mode]).size + lower_somersaults(moves[mode]).size for mode in MODES
    ]
    table.number("5", "somersaults of both bobs in 5 s", "9", *total, 0.0, "", other)
    as_printed, true, finer = (greatest(motion.potential1) for motion in moves.values())
    table.number("5", "greatest PE1, at bob 1's "
                      "somersaults", "0.39", as_printed, true, bound(true, finer), "J",
                 rounding=_CHAOTIC)  # fmt: skip
    exponents(table)
    parted = parting_time()
    table.statement(
        "5",
        "an angle as printed is 0.1 rad from the true one",
        "5 s of motion",
        parted,
        parted,
        STEP,
        "s",
        False,
        "all that is printed of later times belongs to the motion made with 3.14",
    )


def exponents(table: Table) -> None:
    """lambda of the separation, in three fits, and the exponent that it tends to."""
    logs = {mode: separation(mode)[:2] for mode in MODES}
    fits: dict[str, Callable] = {
        "rough line through t = 0 (median slope to the second half)": rough_slope,
        "least squares through t = 0": lambda t, y: float(t @ y / (t @ t)),
        "least squares, free line": lambda t, y: float(np.polyfit(t, y, 1)[0]),
        "end point": lambda t, y: float(y[-1] / t[-1]),
    }
    time, running, converged = running_exponent()
    settled = float(time[np.abs(running / converged["exponent"] - 1) > 0.1].max()) + 1.0
    settled = 10 ** math.ceil(math.log10(settled))
    wide = round_up(max(converged["uncertainty"], _LONG))
    said = f"{show(converged['exponent'], wide)} +- {wide:g}/s"
    why = f"a value of 4 s; the converged exponent is {said}"
    for name, fit in fits.items():
        slopes = [fit(*logs[mode]) for mode in MODES]
        finer = fit(*separation("true", 2)[:2])
        table.number(
            "5", f"lambda, {name}", "2.9", *slopes, bound(slopes[1], finer), "1/s", why, _PARTING
        )
    table.statement(
        "5",
        "lambda, converged",
        "2.9",
        *2 * [converged["exponent"]],
        converged["uncertainty"],
        "1/s",
        False,
        f"it is {said}; the running exponent stays within 10 % of it from {settled} s on",
        _LONG,
    )


def misprints(table: Table) -> None:
    """What can be told by computing with the equations as printed."""
    slower, faster = (
        dpend.find_orbit(pendulum, math.radians(40), branch="in-phase")
        for pendulum in (PAPER, dpend.Pendulum(g=PAPER.g / PAPER.l1))
    )
    ratio = float(faster.period / slower.period)
    error = ratio * sum(float(orbit.error_estimate[1] / orbit.period) for orbit in (slower, faster))
    table.statement(
        "listing", "gravity without the factor l: period of B over the one with "
                   "it", "1", ratio, ratio, error, "",
        False, "misprint: run as listed, periods are shorter by sqrt 5",
    )  # fmt: skip
    drifts = [energy_drift_of_field(sign) for sign in (1.0, -1.0)]
    error = bound(drifts[1], energy_drift_of_field(-1.0, 1e-11))
    table.statement(
        "2", "second momentum equation without its minus sign before F: energy drift of B in 1 "
             "s", "0", *drifts, error,
        "of the energy at release", False, "misprint: the listing has the sign, and with it the "
                                           "energy stays",
    )  # fmt: skip


def energy_drift_of_field(sign: float, tolerance: float = 1e-10) -> float:
    """|H - H(0)|/|H_release - H_bottom| after 1 s of B, the force in p2' = sign F - ... taken as
    printed or right.
    """
    import diffrax

    def slope(time, state, args):  # type: ignore[no-untyped-def]
        right = dpend.vector_field(PAPER, state)
        weight = PAPER.m2 * PAPER.g * PAPER.l2 * jax.numpy.sin(state.theta2)
        return dpend.State(
            right.theta1, right.theta2, right.p1, -sign * (right.p2 + weight) - weight
        )

    start = dpend.released(math.radians(40), math.radians(49.1))
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(slope),
        diffrax.Dopri8(),
        0.0,
        1.0,
        1e-3,
        start,
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=0.01 * tolerance),
        max_steps=100_000,
    )
    end = jax.tree.map(lambda leaf: leaf[0], solution.ys)
    scale = dpend.hamiltonian(PAPER, start) - dpend.hamiltonian(PAPER, dpend.released(0.0, 0.0))
    return float(abs(dpend.hamiltonian(PAPER, end) - dpend.hamiltonian(PAPER, start)) / scale)


def write_claims(path: Path) -> list[Claim]:
    """The table, into a temporary name first; returns it."""
    found = claims()
    draft = path.with_suffix(".partial")
    with draft.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow("section quantity printed as_printed true error_bound unit verdict".split())
        for c in found:
            rows.writerow(
                [
                    c.section,
                    c.quantity,
                    c.printed,
                    show(c.as_printed, c.rounding),
                    show(c.true, c.error),
                    f"{c.error:g}",
                    c.unit,
                    c.verdict,
                ]
            )
    draft.replace(path)
    return found
