"""Are the error estimates of orbits larger than their errors? Random pendulums, solved again in
long double.

    python experiments/orbit_errors.py [--quick]

Pendulums with l2/l1 and m2/m1 from 0.01 to 100 (log-uniform), their in-phase and anti-phase
families, and orbits of each by every call that tells an error: points of `follow_family`,
`Family.at`, `find_orbit` by branch, by guess (as centred and as brake orbits) and by ratio. Release
angles cover each family, a third of them close to its largest angle. The truth is Newton's method
in long double, the pendulum's and the release's doubles taken for the numbers that they are:
Lagrange's equations by heyoka's Taylor series, and the Jacobian by differences of the same. Nothing
of it is dpend's. Left out are orbits that long double cannot hold either: where its last update is
above 1e-14, or kappa above 1e52. Prints the quantiles of estimate over error and how many errors
are above ten times their estimate: none may be.
"""

import argparse
import time

import heyoka as hy
import numpy as np
from extended import accelerations

import dpend
from dpend import Pendulum, Status

FIELDS = ("l1", "l2", "m1", "m2", "g")
_L = np.longdouble
_PI = _L("3.14159265358979323846264338327950288")
# What is known of the truth: the last update of Newton's method, relative, and the growth that long
# double outlives.
_CONVERGED, _TOO_UNSTABLE = 1e-14, 1e52
_QUANTILES = (0.0, 0.01, 0.1, 0.5, 0.9, 1.0)


def taylor_integrator():
    """Lagrange's equations in long double, the pendulum as parameters."""
    state = hy.make_vars("theta1", "theta2", "omega1", "omega2")
    # heyoka's expressions stand in for numbers: the same equations as those of `extended`.
    sines = type("Sines", (), {"sin": hy.sin, "cos": hy.cos, "stack": list})
    slopes = accelerations([hy.par[i] for i in range(5)], state, sines)
    return hy.taylor_adaptive(list(zip(state, slopes, strict=True)), [_L(0)] * 4, fp_type=_L)


class Truth:
    """Orbits in long double."""

    def __init__(self):
        self.integrator = taylor_integrator()

    def end(self, pendulum, angles, duration):
        """The state (theta1, theta2, omega1, omega2) a time after the release."""
        self.integrator.time = _L(0)
        self.integrator.pars[:] = pendulum
        self.integrator.state[:] = [*angles, _L(0), _L(0)]
        self.integrator.propagate_until(duration)
        return self.integrator.state.copy()

    def orbit(self, orbit, ratio=None):
        """The unknown angle and the period of the orbit next to this one, and Newton's last update
        (relative).
        """
        pendulum = [_L(float(getattr(orbit.pendulum, name))) for name in FIELDS]
        part = 4 if orbit.symmetry == "centred" else 2
        rows = slice(0, 2) if part == 4 else slice(2, 4)
        goal = (
            _PI * np.array([int(turn) for turn in orbit.turns], _L)
            if part == 4
            else np.zeros(2, _L)
        )
        theta1, x, duration = (
            _L(float(v)) for v in (orbit.theta1, orbit.theta2, orbit.period / part)
        )
        x = theta1 if ratio else x
        unit = min(_L(1), max(abs(theta1), abs(x)))
        # Differences that the growth over the arc leaves small, and long double can resolve.
        nudge = (
            max(_L(2) ** -32 / max(_L(1), abs(_L(float(orbit.kappa)))) ** _L(0.25), _L(2) ** -54)
            * unit
        )

        def release(x):
            return (x, ratio * x) if ratio else (theta1, x)

        for _ in range(4):
            end = self.end(pendulum, release(x), duration)
            by_x = ((self.end(pendulum, release(x + nudge), duration) - end) / nudge)[rows]
            by_time, missed = accelerations(pendulum, end)[rows], end[rows] - goal
            determinant = by_x[0] * by_time[1] - by_x[1] * by_time[0]
            step = -(missed[0] * by_time[1] - missed[1] * by_time[0]) / determinant
            later = -(by_x[0] * missed[1] - by_x[1] * missed[0]) / determinant
            x, duration = x + step, duration + later
        return x, part * duration, float(max(abs(step) / unit, abs(later / duration)))


def random_pendulum(rng):
    """Lengths and masses of 0.1 to 2 times powers of ten from -2 to 2."""
    length, mass = rng.uniform(0.1, 2.0, 2)
    return Pendulum(
        length, length * 10 ** rng.uniform(-2, 2), mass, mass * 10 ** rng.uniform(-2, 2), 9.8
    )


def orbits_of(pendulum, branch, rng, most_points, long_ways):
    """(kind, orbit, ratio) of orbits on one family; with `long_ways` those that walk there anew,
    too.
    """
    family = dpend.follow_family(pendulum, branch, most_points=most_points)
    angles = np.abs(np.asarray(family.orbits.theta1))
    for i in [*rng.choice(len(angles), min(len(angles), 6), replace=False), len(angles) - 1]:
        yield "follow_family", pick(family.orbits, i), None
    reach = angles.max()
    wanted = np.append(
        reach * rng.uniform(1e-3, 1.0, 4), reach * (1 - 10 ** rng.uniform(-8, -2, 2))
    )
    there = family.at(wanted)
    for i, theta1 in enumerate(wanted):
        orbit = pick(there, i)
        yield "Family.at", orbit, None
        if orbit.status == Status.CONVERGED and i % 2:
            guess = float(orbit.theta2), float(orbit.period)
            for symmetry in ("centred", "brake"):
                found = dpend.find_orbit(pendulum, theta1, guess=guess, symmetry=symmetry)
                yield f"find_orbit(guess), {symmetry}", found, None
    if long_ways:
        yield "find_orbit(branch)", dpend.find_orbit(pendulum, wanted[0], branch=branch), None
    if (
        long_ways and family.status == Status.CONVERGED
    ):  # to the end, which of some pendulums takes thousands of points
        ratio = 1 if branch == "in-phase" else -1
        yield "find_orbit(ratio)", dpend.find_orbit(pendulum, 0.5 * reach, ratio=ratio), ratio


def pick(orbits, i):
    """One orbit out of many, as numbers."""
    import jax

    return jax.tree.map(lambda leaf: np.asarray(leaf)[i], orbits)


def measure(pendulums, seed=0, most_points=150, seconds=np.inf):
    """Rows (kind, error and estimate of the angle [rad], of the period [s], kappa), and how many
    were left out.
    """
    rng, truth, rows, left_out, begun = (
        np.random.default_rng(seed),
        Truth(),
        [],
        0,
        time.perf_counter(),
    )
    for i in range(pendulums):
        if time.perf_counter() - begun > seconds:
            print(f"stopped after {i} of {pendulums} pendulums")
            break
        pendulum, branch = random_pendulum(rng), ("in-phase", "anti-phase")[i % 2]
        for kind, orbit, ratio in orbits_of(pendulum, branch, rng, most_points, i % 8 < 2):
            if orbit.status != Status.CONVERGED:
                continue
            x, period, update = truth.orbit(orbit, ratio)
            if not update < _CONVERGED or abs(orbit.kappa) > _TOO_UNSTABLE:
                left_out += 1
                continue
            known = orbit.theta1 if ratio else orbit.theta2
            errors = abs(float(x - _L(float(known)))), abs(float(period - _L(float(orbit.period))))
            rows.append(
                (
                    kind,
                    *errors,
                    *(float(e) for e in orbit.error_estimate),
                    float(orbit.kappa),
                    pendulum,
                )
            )
    return rows, left_out


def ratios_of(rows):
    """Estimate over error of the angle and of the period, shape (n, 2)."""
    errors, estimates = np.array([row[1:3] for row in rows]), np.array([row[3:5] for row in rows])
    return estimates / np.maximum(errors, np.finfo(float).tiny)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="30 pendulums instead of 1000")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=np.inf, help="stop after so long")
    arguments = parser.parse_args()
    rows, left_out = measure(
        30 if arguments.quick else 1000, arguments.seed, seconds=arguments.seconds
    )
    print(
        f"{len(rows)} orbits, {left_out} left out: long double does not hold them. Estimate over "
        f"error:"
    )
    print(
        f"{'':32} orbits "
        + "".join(f"{f'{100 * q:g} %':>10}" for q in _QUANTILES)
        + "  error > 10 estimates"
    )
    for kind in sorted({row[0] for row in rows}):
        some = [row for row in rows if row[0] == kind]
        for name, ratios in zip(("angle", "period"), ratios_of(some).T, strict=True):
            shown = "".join(f"{value:10.2g}" for value in np.quantile(ratios, _QUANTILES))
            print(f"{kind:24} {name:7} {len(some):6} {shown}  {np.sum(~(ratios > 0.1))}")
    for row in sorted(rows, key=lambda row: np.min(ratios_of([row])))[:6]:
        print("worst:", *row[:6], row[6])


if __name__ == "__main__":
    main()
