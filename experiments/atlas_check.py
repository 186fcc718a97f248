"""An independent check of the catalogue of brake orbits: every row integrated again by other means.

It reads the text of the CSV file and shares no code with dpend: the equations are Lagrange's in
angles and angular velocities, solved for the accelerations by hand, and diffrax's Dopri8 integrates
each listed release over its period, with its variational equations, at a tolerance of 1e-13. Each
row is held to this:

- it returns after T, and at T/2 it rests at the listed dual release, full turns included: but for
  what an error of 1e-13 in the release becomes by then, the norm of its own monodromy matrix
  telling by how much it grows (its root, by half the period). The norm is at least the largest
  multiplier, |kappa| + sqrt(kappa^2 - 1), which is shown beside it;
- kappa is that of its monodromy matrix, and the energy that of its release;
- it moves at T/4 and at T/6, hence the period is the minimal one: rests of an orbit run through n
  times are T/(2n) apart, and n above 4 would need an orbit faster than the fast normal mode;
- at T/4 both rods are vertical, after the listed half turns, if it is listed as centred, and not
  else.

The exit status is 1 if any row is off.
"""

import argparse
import csv
import json
import sys
import time
from functools import partial
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from extended import accelerations

jax.config.update("jax_enable_x64", True)
HERE = Path(__file__).parent
TOLERANCE = 1e-13
# What is checked and how large it may be. The first two are in units of TOLERANCE times growth, and
# reach 2: digits and integrator both count. kappa is relative to 1 + |kappa|; its own growth is of
# the second order and not estimated. Half turns and speeds at T/4 [sqrt(g/l1)] are the integrator's
# interpolation, good to 1e-9.
LIMITS = {
    "return": 10.0,
    "dual": 10.0,
    "kappa": 1e-6,
    "energy": 1e-13,
    "minimal": 1.0,
    "symmetry": 1.0,
}
VERTICAL, AT_REST = 1e-7, 1e-6
NUMBERS = (
    "theta1_deg theta2_deg dual_theta1_deg dual_theta2_deg period_s energy_J kappa turns1 "
    "turns2".split()
)


def slope(pendulum, time, pair):
    """That of a state and of the matrix of its derivatives."""
    state, matrix = pair
    forward = jax.linearize(partial(accelerations, pendulum, numpy=jnp), state)
    return forward[0], jax.vmap(forward[1], -1, -1)(matrix)


def half_period(pendulum, pair, period):
    """From one rest to the next: the ends, and the states at T/6 and T/4 on the way."""
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, args: slope(pendulum, t, y)),
        diffrax.Dopri8(),
        0.0,
        period / 2,
        None,
        pair,
        stepsize_controller=diffrax.PIDController(rtol=TOLERANCE, atol=TOLERANCE),
        max_steps=20_000,
        throw=False,
        saveat=diffrax.SaveAt(
            subs=[
                diffrax.SubSaveAt(t1=True),
                diffrax.SubSaveAt(
                    ts=jnp.stack([period / 6, period / 4]), fn=lambda t, y, args: y[0]
                ),
            ]
        ),
    )
    (state, matrix), between = solution.ys
    good = solution.result == diffrax.RESULTS.successful
    return (jnp.where(good, state[0], jnp.nan), matrix[0]), between


@partial(jax.jit, static_argnums=0)
def around(pendulum, theta1, theta2, period):
    """State at T/6, T/4, T/2 and T, and the monodromy matrix, of each release."""

    def one(theta1, theta2, period):
        start = jnp.stack([theta1, theta2, jnp.zeros(()), jnp.zeros(())])
        half, between = half_period(pendulum, (start, jnp.eye(4)), period)
        whole, _ = half_period(pendulum, half, period)
        return between[0], between[1], half[0], *whole

    return jax.vmap(one)(theta1, theta2, period)


def read(path):
    """The pendulum (l1, l2, m1, m2, g) of the first line, and the rows."""
    with path.open(newline="") as file:
        about = json.loads(file.readline().removeprefix("#"))["pendulum"]
        rows = [row | {"line": line} for line, row in enumerate(csv.DictReader(file), 3)]
        return tuple(about[key] for key in ("l1_m", "l2_m", "m1_kg", "m2_kg", "g_m_s2")), rows


def apart(state, angles, rate):
    """From rest at some angles, the largest of angles [rad] and angular velocities [sqrt(g/l1)]."""
    return np.max(np.abs(np.column_stack([state[:, :2] - angles.T, state[:, 2:] / rate])), axis=1)


def checked(pendulum, rows):
    """What LIMITS names, an array of a row each; with them the plain errors and growths that are
    printed.
    """
    column = {key: np.array([float(row[key]) for row in rows]) for key in NUMBERS}
    l1, l2, m1, m2, g = pendulum
    rate, kappa = np.sqrt(g / l1), column["kappa"]
    release = np.radians([column["theta1_deg"], column["theta2_deg"]])
    dual = np.radians([column["dual_theta1_deg"], column["dual_theta2_deg"]])
    sixth, quarter, half, end, matrix = (
        np.asarray(x) for x in around(pendulum, *release, column["period_s"])
    )
    scale = np.array([1, 1, 1 / rate, 1 / rate])
    growth = np.maximum(
        np.linalg.norm(np.nan_to_num(matrix * scale[:, None] / scale), 2, axis=(1, 2)), 1
    )
    error = apart(end, release, rate)
    trace = np.trace(matrix, axis1=1, axis2=2)
    energy = -(m1 + m2) * g * l1 * np.cos(release[0]) - m2 * g * l2 * np.cos(release[1])
    centred = np.array([row["symmetry"] == "centred" for row in rows])
    half_turns = quarter[:, :2] / np.pi
    turns = np.where(
        centred[:, None],
        np.column_stack([column["turns1"], column["turns2"]]),
        np.round(half_turns),
    )
    moving = np.minimum(
        *(np.max(np.abs(state[:, 2:]), axis=1) / rate for state in (sixth, quarter))
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        leaning = np.max(np.abs(half_turns - turns), axis=1)
        found = {
            "return": error / (TOLERANCE * growth),
            "dual": apart(half, dual, rate) / (TOLERANCE * np.sqrt(growth)),
            "kappa": np.abs(trace / 2 - 1 - kappa) / (1 + np.abs(kappa)),
            "energy": np.abs(energy - column["energy_J"]) / ((m1 + m2) * g * l1),
            "minimal": AT_REST / moving,
            "symmetry": np.where(centred, leaning / VERTICAL, VERTICAL / leaning),
        }
    multiplier = np.abs(kappa) + np.sqrt(np.maximum(kappa**2 - 1, 0))
    return found, {"|x(T)-x(0)|": error, "growth": growth, "multiplier": np.maximum(multiplier, 1)}


def told(row, i, found, plain):
    parts = [
        f"line {row['line']}, {row['family']} ({row['theta1_deg']}, {row['theta2_deg']}) deg, T = "
        f"{row['period_s']} s:"
    ]
    parts += [f"{name} {values[i]:.1e}" for name, values in (plain | found).items()]
    return " ".join(parts)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "file", nargs="?", type=Path, default=HERE / "atlas" / "brake_orbits.csv", metavar="F.csv"
    )
    parser.add_argument("--quick", action="store_true", help="every twentieth row")
    parser.add_argument("--rows", action="store_true", help="print every row")
    options = parser.parse_args()
    pendulum, rows = read(options.file)
    rows = rows[:: 20 if options.quick else 1]
    started = time.perf_counter()
    found, plain = checked(pendulum, rows)
    print(
        f"{len(rows)} orbits over one period in {time.perf_counter() - started:.0f} s (compiling "
        f"with them)"
    )
    # NaN is not below any limit.
    off = ~np.all([values <= LIMITS[name] for name, values in found.items()], axis=0)
    for i in range(len(rows)) if options.rows else np.flatnonzero(off):
        print(("OFF: " if off[i] else "") + told(rows[i], i, found, plain))
    for name, values in found.items():
        print(
            f"{name:9} at worst {np.max(values):.1e} of {LIMITS[name]:.0e} allowed, median "
            f"{np.median(values):.1e}"
        )
    relative = plain["|x(T)-x(0)|"] / plain["multiplier"]
    print(
        f"|x(T) - x(0)| over the multiplier: at worst {np.max(relative):.1e}, median "
        f"{np.median(relative):.1e}"
    )
    worst = int(np.argmax(np.where(np.isnan(found["return"]), np.inf, found["return"])))
    print("worst return:", told(rows[worst], worst, found, plain))
    print(f"{np.sum(off)} of {len(rows)} rows are off")
    return int(np.any(off) or not rows)


if __name__ == "__main__":
    sys.exit(main())
