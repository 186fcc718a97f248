"""Tries to break the numerics: ten kinds of hard motions, each with an independent value or bound
and a verdict.

What is expected comes from elsewhere: linear theory and elliptic integrals, a quadrature,
symmetries of the equations, another integrator, or long double (`extended.py`). A row *holds* if
the number found is within its bound of the one expected, or if what cannot be computed says so; a
silent wrong answer *fails*. Writes `hard_cases.csv`, from it the table in README.md beside it, and
exits with 1 if a row fails. `--quick` takes shorter motions and writes nothing.
"""

import argparse
import csv
import math
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import extended
import jax
import jax.numpy as jnp
import numpy as np
from scipy import integrate, special

import dpend
from dpend import Pendulum, Scheme, State, Status

HERE = Path(__file__).parent
PAPER = Pendulum()
NUMBERS = (0.2, 0.2, 0.1, 0.1, 9.8)


@dataclass(frozen=True)
class Row:
    """One check: what was found against what is expected, and how far apart they may be."""

    case: int
    what: str
    expected: str
    found: str
    bound: str
    verdict: str


def near(
    case: int, what: str, expected: float, found: float, bound: float, unit: str, digits: int = 6
) -> Row:
    """A number within `bound` of the one expected."""
    verdict = "holds" if abs(found - expected) <= bound else "fails"
    words = (f"{value:.{digits}g} {unit}".strip() for value in (expected, found))
    return Row(case, what, *words, f"{bound:.1g} {unit}".strip(), verdict)


def below(case: int, what: str, source: str, found: float, bound: float, unit: str) -> Row:
    """A difference from `source` of at most `bound`."""
    verdict = "holds" if found <= bound else "fails"
    return Row(
        case, what, source, f"{found:.1e} {unit}".strip(), f"{bound:.1g} {unit}".strip(), verdict
    )


def says(case: int, what: str, expected: str, found: str) -> Row:
    """A status, or an error message that holds a word."""
    return Row(case, what, expected, found, "", "holds" if expected in found else "fails")


def refused(case: int, what: str, reason: str, job: Callable[[], object]) -> Row:
    """Bad input that must raise, naming what is wrong."""
    try:
        job()
    except (ValueError, RuntimeError) as error:
        return says(case, what, reason, str(error).splitlines()[0])
    return Row(case, what, reason, "no error", "", "fails")


def word(status: object) -> str:
    return Status(int(status)).name.lower()


def right_or_told(
    case: int, what: str, release: list[float], duration: float, tolerance: float
) -> Row:
    """`simulate` for a tolerance: right to it by long double, or it says that it cannot be."""
    ours = dpend.simulate(PAPER, dpend.released(*release), duration, tolerance=tolerance)
    truth = extended.motion(NUMBERS, (*release, 0.0, 0.0), [duration], longest=0.002)[-1]
    expected = f"right to {tolerance:g} rad by long double, or told"
    error = missed(ours.state, truth)
    if int(ours.status) == Status.CONVERGED:
        return Row(
            case,
            what,
            expected,
            f"{error:.1e} rad",
            f"{tolerance:g} rad",
            "holds" if error <= tolerance else "fails",
        )
    found = f"{word(ours.status)} ({error:.1e} rad)"
    return Row(
        case,
        what,
        expected,
        found,
        f"{tolerance:g} rad",
        "holds" if is_told(ours.status) else "fails",
    )


def is_told(status: object) -> bool:
    """Whether it says that the error may be above what was asked for."""
    return int(status) in (Status.BEYOND_HORIZON, Status.TOLERANCE_NOT_REACHED)


def missed(state: State, truth: np.ndarray) -> float:
    """The larger angle's difference at the last time from one in long double."""
    angles = (np.asarray(angle).ravel()[-1] for angle in (state.theta1, state.theta2))
    return float(
        max(
            abs(np.longdouble(angle) - exact)
            for angle, exact in zip(angles, truth[:2], strict=True)
        )
    )


def apart(a: State, b: State) -> float:
    """The larger angle's difference at the last times."""
    one, other = (jax.tree.map(lambda leaf: float(np.asarray(leaf).ravel()[-1]), x) for x in (a, b))
    return max(abs(one.theta1 - other.theta1), abs(one.theta2 - other.theta2))


# --- 1 --------------------------------------------------------------------------------------------


def fallen(pendulum: Pendulum, state: State) -> object:
    return jnp.square(state.theta1 - np.pi) + jnp.square(state.theta2 - np.pi) - LITTLE**2


# How far [rad] counts as fallen: linear theory is right to its square.
LITTLE = 1e-3


def upright(quick: bool) -> Iterator[Row]:
    """Released close to the upright state: x(t) = sum a_i cosh(rate_i t) v_i, whatever digits pi
    has as a double.
    """
    rates, modes = np.linalg.eig(np.array([[2.0, -1.0], [-2.0, 2.0]]) * 9.8 / 0.2)
    rates = np.sqrt(rates)
    for degrees in (1e-3, 1e-6, 1e-9):
        theta = np.pi - np.radians(degrees)
        true_pi = 4 * np.arctan(np.longdouble(1))
        start = np.array([float(np.longdouble(theta) - true_pi)] * 2)
        shares = np.linalg.solve(modes, start)

        def distance(t, shares=shares):
            return np.linalg.norm(modes @ (shares * np.cosh(rates * t))) - LITTLE

        expected = bisected(distance, 0.0, 10.0)
        crossing = dpend.first_crossing(
            fallen, PAPER, dpend.released(theta, theta), 8.0, Scheme("rk8", 1e-3)
        )
        # Each step rounds an angle near pi by up to half a unit in its last place, 2.2e-16 rad;
        # those steps count that lie within 1/rate of the start.
        rounding = 2.2e-16 / (rates.max() * 1e-3) / np.radians(degrees)
        what = f"{degrees:g} deg off upright: time to fall {LITTLE:g} rad"
        yield near(
            1, what, expected, float(crossing.time), (LITTLE**2 + rounding) / rates.max(), "s", 8
        )
        yield right_or_told(
            1,
            f"{degrees:g} deg off upright, {expected + 0.7:.2f} s",
            [theta, theta],
            expected + 0.7,
            1e-6,
        )
    motion = dpend.simulate(PAPER, dpend.released(np.pi, np.pi), 4.0, tolerance=1e-6)
    what = (
        "released at the double next to pi, 4 s: it never moves in doubles, and falls after 2.3 "
        "s in truth"
    )
    yield says(1, what, "beyond_horizon", word(motion.status))
    motion = dpend.simulate(PAPER, dpend.released(0.0, 0.0), 100.0, step=1e-2)
    yield below(
        1, "hanging at rest, 100 s", "stays", float(np.max(np.abs(motion.state.theta1))), 0.0, "rad"
    )


def bisected(function: Callable[[float], float], low: float, high: float) -> float:
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if function(middle) < 0 else (low, middle)
    return low


# --- 2 --------------------------------------------------------------------------------------------


def ratios(quick: bool) -> Iterator[Row]:
    """Mass and length ratios from 1e-6 to 1e6."""
    worst = {}
    for exponent in (-2, -4, -6):
        ours = dpend.simulate(
            Pendulum(m2=0.1 * 10.0**exponent), dpend.released(1.0, 0.4), 1.0, tolerance=1e-10
        )
        time = np.asarray(ours.time)
        off = np.abs(np.asarray(ours.state.theta1) - simple_pendulum(1.0, np.sqrt(9.8 / 0.2), time))
        worst[exponent] = float(np.max(off))
        what = f"m2/m1 = 1e{exponent}: theta1 against a simple pendulum's, to a quarter period"
        yield below(
            2,
            what,
            "elliptic function",
            float(np.max(off[time < 0.25])),
            0.5 * 10.0**exponent,
            "rad",
        )
    what = "theta1 off a simple pendulum's in 1 s, at m2/m1 = 1e-4 over that at 1e-6"
    yield near(2, what, 100.0, worst[-4] / worst[-6], 1.0, "")
    powers = (-6, 0, 6) if quick else (-6, -4, -2, 0, 2, 4, 6)
    for mass in powers:
        for length in powers:
            yield two_integrators(mass, length, quick)


def simple_pendulum(theta: float, omega: float, times: np.ndarray) -> np.ndarray:
    """Released from rest: sin(theta/2) = k cd(omega t, k), k = sin(theta_0/2)."""
    k = math.sin(theta / 2)
    _, cn, dn, _ = special.ellipj(omega * times, k * k)
    return 2 * np.arcsin(k * cn / dn)


def two_integrators(mass: int, length: int, quick: bool) -> Row:
    """Our step for a tolerance against diffrax, for half a swing, or 2000 radians of the fast
    mode.
    """
    pendulum = Pendulum(m2=0.1 * 10.0**mass, l2=0.2 * 10.0**length)
    start = dpend.released(1.0, 0.4)
    slow, fast = (float(mode.frequency) for mode in dpend.normal_modes(pendulum))
    duration = min(math.pi / slow, (300 if quick else 2000) / fast)
    what = f"m2/m1 = 1e{mass}, l2/l1 = 1e{length}: {duration:.2g} s, to 1e-9 rad"
    return like_diffrax(2, what, pendulum, start, duration)


def like_diffrax(case: int, what: str, pendulum: Pendulum, state: State, duration: float) -> Row:
    """Ours to 1e-9 rad against diffrax, as far as diffrax knows its own error; or told."""
    ours = dpend.simulate(pendulum, state, duration, tolerance=1e-9)
    theirs = dpend.reference(pendulum, state, [duration])
    if int(ours.status) != Status.CONVERGED:
        verdict = "holds" if is_told(ours.status) else "fails"
        return Row(case, what, "right to 1e-09 rad, or told", word(ours.status), "", verdict)
    bound = 1e-9 + 2 * float(theirs.error_estimate)
    return below(case, what, "diffrax, 1e-13", apart(ours.state, theirs.state), bound, "rad")


# --- 3 --------------------------------------------------------------------------------------------


def folded(quick: bool) -> Iterator[Row]:
    """The rods at right angles and folded back onto each other, where cos and sin of their angle
    vanish.
    """
    for difference in (90.0, 180.0, 180.0 - 1e-6):
        for omega in (0.0, 20.0):
            theta1 = 0.7
            theta2 = theta1 - np.radians(difference)
            state = dpend.momenta(PAPER, theta1, theta2, omega, -omega)
            ours = dpend.simulate(PAPER, state, 0.5, tolerance=1e-10)
            truth = extended.motion(NUMBERS, (theta1, theta2, omega, -omega), [0.5])[-1]
            found = missed(ours.state, truth)
            what = (
                f"theta1 - theta2 = {difference:.7g} deg, turning at +-{omega:g} rad/s, 0.5 s, "
                f"to 1e-10 rad"
            )
            yield below(3, what, "long double", found, 1e-10, "rad")
    long = Pendulum(l1=0.2, l2=0.2, m1=1e-4, m2=0.1)
    what = "folded, the inner bob a thousandth of the outer: 0.5 s, to 1e-9 rad"
    yield like_diffrax(3, what, long, dpend.released(2.0, 2.0 - np.pi), 0.5)


# --- 4 --------------------------------------------------------------------------------------------


def spinning(quick: bool) -> Iterator[Row]:
    """Fast rods. Without gravity the angle between them obeys one equation of the first order: a
    quadrature.
    """
    free = Pendulum(g=0.0)
    for omega in (50.0, 500.0):
        state = dpend.momenta(free, 0.3, 0.1, omega, -omega)
        turn, rate = 2 * math.pi, relative_rate(free, state)
        duration = integrate.quad(
            lambda x, rate=rate: 1 / rate(x), 0.0, turn, epsabs=0, epsrel=1e-12, limit=200
        )[0]
        ours = dpend.simulate(free, state, duration, tolerance=1e-9)
        found = abs(
            float(
                (ours.state.theta1 - ours.state.theta2)[-1]
                - (ours.state.theta1 - ours.state.theta2)[0]
            )
        )
        what = f"no gravity, {omega:g} rad/s: theta2 - theta1 after the time of one turn"
        yield near(4, what, turn, found, 2e-9, "rad", 11)
    state = dpend.momenta(PAPER, 0.3, 0.1, 500.0, -500.0)
    ours = dpend.simulate(PAPER, state, 0.2, tolerance=1e-9)
    truth = extended.motion(NUMBERS, (0.3, 0.1, 500.0, -500.0), [0.2], longest=1e-4)[-1]
    yield below(
        4,
        "+-500 rad/s for 0.2 s, to 1e-9 rad",
        "long double",
        missed(ours.state, truth),
        1e-9,
        "rad",
    )
    for method in ("rk4", "rk8", "gauss", "rk4-circle", "rk8-circle"):
        motion = dpend.simulate(PAPER, state, 0.5, step=1e-2, method=method)
        yield says(4, f"{method}, a step of 5 rad", "step_too_large", word(motion.status))
    field = dpend.sweep(
        partial(dpend.chaos.drift, duration=0.2), PAPER, {"theta1": np.array([0.3])},
        at={"theta2": 0.1, "p1": float(state.p1), "p2": float(state.p2)}, tolerance=1e-6,
    )  # fmt: skip
    yield below(
        4,
        "+-500 rad/s in a sweep for 1e-6 rad: energy drift",
        "conserved",
        float(field.energy_drift[0]),
        1e-6,
        "",
    )


def relative_rate(pendulum: Pendulum, state: State) -> Callable[[float], float]:
    """delta' as a function of how far delta = theta2 - theta1 has come, from the two conserved
    quantities (g = 0).

    With u = delta', the angular momentum L = (A + 2B cos + C) w1 + (C + B cos) u and twice the
    energy 2E = (A + 2B cos + C) w1^2 + 2 (C + B cos) w1 u + C u^2, A = (m1 + m2) l1^2, B = m2 l1
    l2, C = m2 l2^2; without w1, u^2 = (2E I - L^2)/(C I - (C + B cos)^2), I = A + 2B cos + C.
    """
    l1, l2, m1, m2 = (float(getattr(pendulum, name)) for name in ("l1", "l2", "m1", "m2"))
    a, b, c = (m1 + m2) * l1**2, m2 * l1 * l2, m2 * l2**2
    total = float(state.p1 + state.p2)
    twice = 2 * float(dpend.hamiltonian(pendulum, state))
    omega1, omega2 = (float(value) for value in dpend.velocities(pendulum, state))
    start, sense = float(state.theta2 - state.theta1), math.copysign(1.0, omega2 - omega1)

    def rate(way: float) -> float:
        cosine = math.cos(start + sense * way)
        inertia = a + 2 * b * cosine + c
        return math.sqrt((twice * inertia - total**2) / (c * inertia - (c + b * cosine) ** 2))

    return rate


# --- 5 --------------------------------------------------------------------------------------------


def long_run(quick: bool) -> Iterator[Row]:
    """The elliptic in-phase orbit of 20 degrees for a million periods: 120 steps a period of gauss,
    beside RK4.

    Not a whole number of them: where every period rounds alike, so does the sum.
    """
    orbit = dpend.find_orbit(PAPER, np.radians(20.0), branch="in-phase")
    step, blocks, count = float(orbit.period) / 120.618, 20, 500 if quick else 50_000
    periods = np.arange(1, blocks + 1) * count
    worst, energy, lag = after_blocks(orbit, Scheme("gauss", step), blocks, count)
    total = f"{periods[-1]:,} periods"
    yield below(
        5,
        f"gauss, {total}: largest energy error at any step",
        "conserved",
        float(np.max(worst)),
        1e-11,
        "",
    )
    yield trend(f"gauss, {total}: trend of the energy at whole periods", energy, wanted=False)
    off = np.abs(lag - periods * (periods @ lag) / (periods @ periods))
    what = f"gauss, {total}: lag behind the orbit, {lag[-1]:.2e} s in all, off proportional to time"
    yield below(5, what, "proportional", float(off.max()), 1e-2 * abs(lag[-1]), "s")
    few = max(1, count // 5000)
    _, lost, _ = after_blocks(orbit, Scheme("rk4", step), blocks, few)
    yield trend(f"rk4 beside it, {blocks * few:,} periods: trend of the energy", lost, wanted=True)


def trend(what: str, energy: np.ndarray, *, wanted: bool) -> Row:
    """Whether the steps of the energy from block to block have a mean that chance does not explain:
    rounding makes a random walk, whose steps are independent.
    """
    steps = np.diff(energy, prepend=0.0)
    ratio = abs(float(np.mean(steps))) / (float(np.std(steps, ddof=1)) / math.sqrt(len(steps)))
    found = f"{energy[-1]:.1e} in all, {ratio:.1f} standard errors from none"
    expected, bound = ("a trend", "more than 3") if wanted else ("none", "3 standard errors")
    return Row(5, what, expected, found, bound, "holds" if (ratio > 3) == wanted else "fails")


def followed(carry: tuple, time: object, dt: object, state: State) -> tuple:
    """The largest energy error so far, and the latest state."""
    start, worst, _ = carry
    return start, jnp.maximum(worst, jnp.abs(dpend.hamiltonian(PAPER, state) - start)), state


def after_blocks(
    orbit: dpend.PeriodicOrbit, scheme: Scheme, blocks: int, count: int
) -> tuple[np.ndarray, ...]:
    """Of each of `blocks` times `count` periods the largest energy error at any step, that at its
    end, in units of the release's energy above the bottom, and the lag there [s].
    """
    bottom = dpend.hamiltonian(PAPER, dpend.released(0.0, 0.0))
    start, force = dpend.hamiltonian(PAPER, orbit.state), dpend.vector_field(PAPER, orbit.state)
    duration = count * float(orbit.period)
    state, rows = orbit.state, []

    @jax.jit
    def block(state: State) -> tuple[State, object]:
        _, worst, end = dpend.fold(followed, (start, 0.0, state), PAPER, state, duration, scheme)
        return end, worst

    for _ in range(blocks):
        state, worst = block(state)
        # Near the rest p = (t - lag) p'(0), and the angles stand still.
        lag = -(state.p1 * force.p1 + state.p2 * force.p2) / (force.p1**2 + force.p2**2)
        error = dpend.hamiltonian(PAPER, state) - start
        rows.append(
            [float(value) for value in (worst / (start - bottom), error / (start - bottom), lag)]
        )
    return tuple(np.array(rows).T)


# --- 6 --------------------------------------------------------------------------------------------


def chaotic(quick: bool) -> Iterator[Row]:
    """Released at (170, 180) deg: how long the motion can be believed."""
    start = np.radians([170.0, 180.0])
    state = dpend.released(*start)
    durations = np.arange(1.0, 5.1 if quick else 11.1, 0.5)
    truth = extended.motion(NUMBERS, (*start, 0.0, 0.0), durations, longest=0.002)
    found = dpend.chaos.maximal_lyapunov(
        PAPER, state, Scheme("rk8-circle", 4e-3), duration=200.0 if quick else 2000.0
    )
    exponent = float(found["exponent"])
    for tolerance in (1e-3, 1e-6, 1e-9):
        believed, wrong = 0.0, 0.0
        for duration, exact in zip(durations, truth, strict=True):
            motion = dpend.simulate(PAPER, state, float(duration), tolerance=tolerance)
            if int(motion.status) != Status.CONVERGED:
                break
            believed = float(duration)
            wrong = max(wrong, missed(motion.state, exact))
        law = math.log(tolerance / 2.2e-16) / exponent
        what = (
            f"(170, 180) deg to {tolerance:g} rad: believed for {believed:g} s; "
            f"ln(tol/eps)/lambda = {law:.1f} s"
        )
        yield below(6, what, "long double", wrong, tolerance, "rad")
        if not quick:
            yield near(
                6,
                f"(170, 180) deg to {tolerance:g} rad: time believed",
                law,
                believed,
                0.5 * law,
                "s",
                3,
            )


# --- 7 --------------------------------------------------------------------------------------------


def many_turns(quick: bool) -> Iterator[Row]:
    """A million turns away the motion is that of the reduced angles, but for what a double of 6e6
    rad can hold.
    """
    pi = 4 * np.arctan(np.longdouble(1))
    # A double of 6e6 rad is known to half a unit in its last place, 4.7e-10 rad.
    for turns in (1_000, 1_000_000):
        far = np.array([1.0 + 2 * math.pi * turns, 0.4 - 2 * math.pi * turns])
        reduced = np.array(np.longdouble(far) - 2 * pi * np.array([turns, -turns]), float)
        for method in ("rk8", "rk8-circle", "rk4"):
            scheme = Scheme(method, 1e-3)
            a = dpend.flow(PAPER, dpend.released(*far), 1.0, scheme)
            b = dpend.flow(PAPER, dpend.released(*reduced), 1.0, scheme)
            differences = np.longdouble([float(a.theta1), float(a.theta2)]) - 2 * pi * np.array(
                [turns, -turns]
            )
            found = float(np.abs(differences - np.array([float(b.theta1), float(b.theta2)])).max())
            yield below(
                7, f"{turns:,} turns away, {method}, 1 s", "the reduced start", found, 1e-9, "rad"
            )
    beyond = dpend.simulate(PAPER, dpend.released(1e12, 0.0), 1.0, step=1e-2)
    yield says(7, "1e12 rad, where sine is not computed", "nonfinite", word(beyond.status))


# --- 8 --------------------------------------------------------------------------------------------


def unstable(quick: bool) -> Iterator[Row]:
    """Orbits whose multipliers exceed 1e10: they return as well as the digits of their release
    allow.
    """
    for branch, angle in (("in-phase", 174.0), ("in-phase", 178.0), ("anti-phase", 179.9)):
        orbit = dpend.find_orbit(PAPER, np.radians(angle), branch=branch)
        period, theta1, theta2 = float(orbit.period), float(orbit.theta1), float(orbit.theta2)
        back = extended.motion(NUMBERS, (theta1, theta2, 0.0, 0.0), [period / 4])[-1]
        centre = np.pi * np.array([float(turn) for turn in orbit.turns])
        found = float(np.abs(np.array(back[:2], float) - centre).max())
        # A hundred units in the last place of the release, grown to the quarter period.
        grown = 4.4e-14 * math.exp(float(orbit.log_abs_kappa) / 4)
        what = (
            f"{branch}, {angle:g} deg, kappa = {float(orbit.kappa):.2g}: both rods vertical at T/4"
        )
        yield below(8, what, "long double", found, grown, "rad")
        family = dpend.follow_family(PAPER, branch).at(np.radians(angle))
        gap = abs(float(family.log_abs_kappa) - float(orbit.log_abs_kappa))
        yield below(
            8, f"{branch}, {angle:g} deg: log |kappa| by segments", "in one piece", gap, 1e-6, ""
        )
        yield says(8, f"{branch}, {angle:g} deg: status", "converged", word(orbit.status))


# --- 9 --------------------------------------------------------------------------------------------

_WITHOUT_FLOAT64 = """
import dpend
try:
    print({call})
except RuntimeError as error:
    print(error)
"""


def without_float64(quick: bool) -> Iterator[Row]:
    """float64 switched off by the user, and single precision given."""
    environment = os.environ | {"JAX_ENABLE_X64": "0", "DPEND_PLAIN_JAX": "1"}
    calls = [
        "dpend.flow(dpend.Pendulum(), dpend.released(1.0, 0.4), 1.0, dpend.Scheme('rk4', 1e-2))"
    ]
    if not quick:
        calls += [
            "dpend.simulate(dpend.Pendulum(), dpend.released(1.0, 0.4), 1.0)",
            "dpend.find_orbit(dpend.Pendulum(), 0.7, branch='in-phase')",
            "dpend.follow_family(dpend.Pendulum(), 'in-phase')",
            "dpend.find_brake_orbits(dpend.Pendulum(), theta1=0.7, max_period=1.0)",
            "dpend.sweep(dpend.chaos.drift, dpend.Pendulum(), {'theta1': [1.0]})",
        ]
    for call in calls:
        command = [sys.executable, "-c", _WITHOUT_FLOAT64.format(call=call)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        yield says(
            9,
            f"x64 switched off: {call.split('(')[0]}",
            "float64",
            (done.stdout + done.stderr).strip()[-200:],
        )
    single = dpend.released(np.float32(1.1), np.float32(0.4))
    double = dpend.released(float(np.float32(1.1)), float(np.float32(0.4)))
    scheme = Scheme("rk8", 5e-3)
    found = apart(dpend.flow(PAPER, single, 1.0, scheme), dpend.flow(PAPER, double, 1.0, scheme))
    yield below(
        9, "a release in single precision, 1 s", "the same number as a double", found, 0.0, "rad"
    )


# --- 10 -------------------------------------------------------------------------------------------


def gravity(quick: bool) -> Iterator[Row]:
    """None, or upwards: theta -> theta + pi turns the field round."""
    up = Pendulum(g=-9.8)
    theirs = dpend.simulate(PAPER, dpend.released(1.0 + np.pi, 0.4 + np.pi), 1.0, tolerance=1e-10)
    ours = dpend.simulate(up, dpend.released(1.0, 0.4), 1.0, tolerance=1e-10)
    turned = State(
        ours.state.theta1 + np.pi, ours.state.theta2 + np.pi, ours.state.p1, ours.state.p2
    )
    yield below(
        10,
        "g = -9.8, 1 s, to 1e-10 rad",
        "g = 9.8, half a turn on",
        apart(turned, theirs.state),
        2e-10,
        "rad",
    )
    free = Pendulum(g=0.0)
    rest = dpend.simulate(free, dpend.released(1.0, 0.4), 1.0, tolerance=1e-9)
    moved = float(jnp.max(jnp.abs(rest.state.theta1 - 1.0)))
    yield below(10, "g = 0, released from rest", "stays", moved, 1e-12, "rad")
    for g, pendulum in (("0", free), ("-9.8", up)):
        yield refused(
            10,
            f"g = {g}: find_orbit",
            "g must be positive",
            partial(dpend.find_orbit, pendulum, 0.7, branch="in-phase"),
        )
        yield refused(
            10,
            f"g = {g}: follow_family",
            "g must be positive",
            partial(dpend.follow_family, pendulum, "in-phase"),
        )
        yield refused(
            10,
            f"g = {g}: normal_modes",
            "g must be positive",
            partial(dpend.normal_modes, pendulum),
        )
        search = partial(dpend.find_brake_orbits, pendulum, theta1=0.7, max_period=1.0)
        yield refused(10, f"g = {g}: find_brake_orbits", "g must be positive", search)
    yield refused(
        10,
        "g = 0: a step for a tolerance of a sweep",
        "g must not be zero",
        partial(dpend.scheme_for, free, 1e-6),
    )


CASES = {
    1: upright,
    2: ratios,
    3: folded,
    4: spinning,
    5: long_run,
    6: chaotic,
    7: many_turns,
    8: unstable,
    9: without_float64,
    10: gravity,
}


def page(rows: list[Row]) -> str:
    """The table for README.md."""
    lines = ["| | what | expected | found | may differ by | verdict |", "|---|---|---|---|---|---|"]
    for row in rows:
        what, expected, found = (
            text.replace("|", "/") for text in (row.what, row.expected, row.found)
        )
        lines.append(
            f"| {row.case} | {what} | {expected} | {found} | {row.bound} | {row.verdict} |"
        )
    return "\n".join(lines)


def write(rows: list[Row]) -> None:
    with (HERE / "hard_cases.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, list(asdict(rows[0])), lineterminator="\n")
        table.writeheader()
        table.writerows(asdict(row) for row in rows)
    readme = HERE / "README.md"
    start, end = "<!-- hard cases -->\n", "\n<!-- end of hard cases -->"
    before, rest = readme.read_text().split(start)
    readme.write_text(before + start + page(rows) + end + rest.split(end)[1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--case", type=int, choices=CASES)
    options = parser.parse_args()
    rows = []
    for number, case in CASES.items():
        if options.case in (None, number):
            for row in case(options.quick):
                print(
                    f"{row.case:2d}  {row.verdict:5s}  {row.what}: {row.found}  ({row.expected}, "
                    f"{row.bound})",
                    flush=True,
                )
                rows.append(row)
    if not options.quick and options.case is None:
        write(rows)
    sys.exit(any(row.verdict != "holds" for row in rows))


if __name__ == "__main__":
    main()
