"""How far the error estimates of `simulate` and `reference` are from the errors: random motions
against heyoka.

Two samples: releases from rest on the whole square of the paper's pendulum, over 2 and 5 s to 1e-3
... 1e-12 rad; and pendulums whose lengths and masses differ by up to a thousand, half of them in
motion at the start, over up to four slow periods to 1e-3 ... 1e-11 rad. The truth is heyoka's
Taylor method in long double, on Lagrange's equations. Prints a table for each: how many motions
passed, how many of them were wrong, how many were refused, how many of those were right, and
quantiles of estimate over error. `--quick` takes a few motions. Exits with 1 if of the passed
motions of both samples more than one in 100 is wrong, or of the refused more than one in five is
right.
"""

import argparse
import math
import sys
from collections.abc import Iterator
from types import SimpleNamespace
from typing import NamedTuple

import extended
import heyoka
import jax
import numpy as np

import dpend
from dpend import Pendulum, State, Status

# So many saved times of a motion are looked at.
_LOOKS = 200
# No motion lasts longer than so many radians of its fast mode.
_LONGEST = 300.0


class Motion(NamedTuple):
    """What is asked: a start, a duration [s] and a tolerance [rad]."""

    pendulum: Pendulum
    state: State
    duration: float
    tolerance: float


class Verdict(NamedTuple):
    """What came of it [rad]."""

    tolerance: float
    passed: bool
    estimate: float
    error: float


def on_the_square(random: np.random.Generator) -> Iterator[Motion]:
    """Releases of the paper's pendulum from rest."""
    while True:
        duration, tolerance = random.choice([2.0, 5.0]), 10.0 ** random.integers(-12, -2)
        yield Motion(
            Pendulum(), dpend.released(*random.uniform(-np.pi, np.pi, 2)), duration, tolerance
        )


def of_other_pendulums(random: np.random.Generator) -> Iterator[Motion]:
    """Lengths and masses as different as a thousand to one."""
    while True:
        pendulum = Pendulum(
            0.2, 0.2 * 10 ** random.uniform(-3, 3), 0.1, 0.1 * 10 ** random.uniform(-3, 3)
        )
        slow, fast = (float(mode.frequency) for mode in dpend.normal_modes(pendulum))
        rates = 2 * slow * random.normal(size=2) * random.integers(2)
        state = dpend.momenta(pendulum, *random.uniform(-np.pi, np.pi, 2), *rates)
        duration = min(2 * math.pi / slow * random.uniform(1, 4), _LONGEST / fast)
        yield Motion(pendulum, state, duration, 10 ** random.uniform(-11, -3))


def integrator() -> heyoka.taylor_adaptive:
    """Lagrange's equations in long double; the pendulum's fields are its parameters."""
    state = heyoka.make_vars("theta1", "theta2", "omega1", "omega2")
    numpy = SimpleNamespace(sin=heyoka.sin, cos=heyoka.cos, stack=list)
    slopes = extended.accelerations([heyoka.par[i] for i in range(5)], state, numpy)
    equations = list(zip(state, slopes, strict=True))
    zero = np.longdouble(0)
    return heyoka.taylor_adaptive(equations, [zero] * 4, fp_type=np.longdouble, pars=[zero] * 5)


def truth(taylor: heyoka.taylor_adaptive, motion: Motion, times: np.ndarray) -> np.ndarray:
    """Both angles at increasing times from above zero, shape (n, 2)."""
    l1, l2, m1, m2, g = (np.longdouble(float(leaf)) for leaf in jax.tree.leaves(motion.pendulum))
    theta1, theta2, p1, p2 = (np.longdouble(float(leaf)) for leaf in jax.tree.leaves(motion.state))
    coupling = m2 * l1 * l2 * np.cos(theta1 - theta2)
    inertia1, inertia2 = (m1 + m2) * l1 * l1, m2 * l2 * l2
    size = m2 * l1 * l1 * l2 * l2 * (m1 + m2 * np.sin(theta1 - theta2) ** 2)
    rates = (inertia2 * p1 - coupling * p2) / size, (inertia1 * p2 - coupling * p1) / size
    taylor.pars[:] = [l1, l2, m1, m2, g]
    taylor.time = np.longdouble(0)
    taylor.state[:] = [theta1, theta2, *rates]
    outcome, *_, states = taylor.propagate_grid(np.append(np.longdouble(0), np.longdouble(times)))
    if outcome != heyoka.taylor_outcome.time_limit:
        raise RuntimeError(f"heyoka stopped with {outcome}")
    return states[1:, :2]


def judge(taylor: heyoka.taylor_adaptive, motion: Motion) -> Verdict:
    """`simulate` against the truth, at the worst of the times looked at."""
    ours = dpend.simulate(
        motion.pendulum, motion.state, motion.duration, tolerance=motion.tolerance
    )
    last = ours.time.size - 1
    rows = np.unique(np.linspace(1, last, min(_LOOKS, last)).astype(int))
    exact = truth(taylor, motion, np.asarray(ours.time)[rows])
    found = np.stack(
        [np.asarray(ours.state.theta1)[rows], np.asarray(ours.state.theta2)[rows]], axis=1
    )
    error = float(np.max(np.abs(found - exact)))
    return Verdict(
        motion.tolerance, int(ours.status) == Status.CONVERGED, float(ours.error_estimate), error
    )


def print_row(name: str, verdicts: list[Verdict]) -> None:
    passed = [v for v in verdicts if v.passed]
    refused = [v for v in verdicts if not v.passed]
    # Beyond a tenth of a radian an error says no more than that.
    ratios = [v.estimate / max(v.error, 1e-18) for v in verdicts if v.estimate < 0.1]
    low, middle, high = np.quantile(ratios, [0.01, 0.5, 0.99])
    print(
        f"{name:22s} {len(passed):6d} {sum(v.error > v.tolerance for v in passed):6d} "
        f"{sum(v.error > 2 * v.tolerance for v in passed):6d} {len(refused):8d} "
        f"{sum(v.error <= v.tolerance for v in refused):6d}   {low:.2f} {middle:.2f} {high:.2f}",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args()
    taylor, count, verdicts = integrator(), 20 if options.quick else 1500, []
    print(f"{'':22s} passed  wrong    >2x  refused  right   estimate/error: 1 %, median, 99 %")
    for sample in (on_the_square, of_other_pendulums):
        motions = sample(np.random.default_rng(1))
        here = [judge(taylor, next(motions)) for _ in range(count)]
        print_row(sample.__name__, here)
        for power in range(-12, -2):
            if some := [v for v in here if round(math.log10(v.tolerance)) == power]:
                print_row(f"  to about 1e{power}", some)
        verdicts += here
    passed = [v for v in verdicts if v.passed]
    refused = [v for v in verdicts if not v.passed]
    wrong = sum(v.error > v.tolerance for v in passed)
    right = sum(v.error <= v.tolerance for v in refused)
    sys.exit(wrong > len(passed) / 100 or right > len(refused) / 5)


if __name__ == "__main__":
    main()
