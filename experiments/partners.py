"""The partners theta2 of fifty release angles on both branches, with their errors: a table and a
figure.

The paper found six such pairs by hand. Here each branch is followed once, and its orbits at the
wanted angles are a few Newton iterations away.
"""

import argparse
import csv
import time
from pathlib import Path

import numpy as np
from digits import round_up, show

import dpend
from dpend import plots

HERE = Path(__file__).parent


# How far two processors may differ in an angle [deg], a period [s] and kappa relative to its size:
# no bound is less.
ROUNDING = (1e-10, 1e-12, 1e-9)


def shown(
    values: tuple[float, float, float], errors: tuple[float, float]
) -> tuple[list[str], list[str]]:
    """Partner, period and kappa to the digits that are known, and the bounds of the first two."""
    bounds = [max(error, least) for error, least in zip(errors, ROUNDING, strict=False)]
    digits = [show(value, bound) for value, bound in zip(values, bounds, strict=False)]
    return [*digits, f"{values[2]:.8g}"], [f"{round_up(bound):g}" for bound in bounds]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="ten angles, no table written")
    parser.add_argument("--figure", type=Path, default=HERE / "figures" / "partners.png")
    options = parser.parse_args()
    import matplotlib.pyplot as plt

    pendulum = dpend.Pendulum()
    degrees = np.linspace(3.5, 175, 10 if options.quick else 50)
    fig, axes = plt.subplots(1, 2, figsize=(10.5, 4.2), layout="constrained")
    rows = []
    for branch, colour, style in (
        ("in-phase", plots.UPPER, "-"),
        ("anti-phase", plots.LOWER, "--"),
    ):
        started = time.perf_counter()
        family = dpend.follow_family(pendulum, branch)
        followed = time.perf_counter()
        orbits = family.at(np.radians(degrees))
        found = time.perf_counter()
        print(
            f"{branch}: {len(family.arclength)} orbits followed in {followed - started:.2f} s",
            end=", ",
        )
        print(f"{degrees.size} partners in {found - followed:.3f} s (compiling with them)")
        assert np.all(orbits.status == dpend.Status.CONVERGED)
        errors = [np.degrees(orbits.error_estimate[0]), np.asarray(orbits.error_estimate[1])]
        print(f"  largest error estimate: {np.max(errors[0]):.0e} deg, {np.max(errors[1]):.0e} s")
        single = dpend.find_orbit(pendulum, np.radians(degrees[-1]), branch=branch)
        print(
            f"  the last by shooting in one piece: "
            f"{abs(np.degrees(single.theta2 - orbits.theta2[-1])):.0e} deg apart"
        )
        partner = np.degrees(orbits.theta2)
        for i, theta1 in enumerate(degrees):
            stability = dpend.stability_class(float(orbits.kappa[i]))
            values = (float(partner[i]), float(orbits.period[i]), float(orbits.kappa[i]))
            digits, bounds = shown(values, (float(errors[0][i]), float(errors[1][i])))
            rows.append([branch, f"{theta1:.10g}", *digits, stability, *bounds])
        stable = np.asarray(orbits.log_abs_kappa) <= 0
        for ax, y in zip(axes, (partner, np.asarray(orbits.period)), strict=True):
            ax.plot(degrees, y, style, color=colour, linewidth=1.2)
            ax.plot(
                degrees[stable],
                y[stable],
                "o",
                color=colour,
                markersize=4,
                label=f"{branch}, stable",
            )
            ax.plot(
                degrees[~stable],
                y[~stable],
                "o",
                color=colour,
                markerfacecolor="white",
                markersize=4,
                label="unstable",
            )
    if not options.quick:
        with (HERE / "partners.csv").open("w", newline="") as file:
            table = csv.writer(file)
            names = (
                "branch theta1_deg theta2_deg period_s kappa stability theta2_error_deg "
                "period_error_s"
            )
            table.writerow(names.split())
            table.writerows(rows)
    for row in rows[:: max(1, len(rows) // 10)]:
        print("  {:10} theta1 {:>6} deg  theta2 {:>16} deg  T {} s  {}".format(*row[:4], row[5]))
    axes[0].set(
        xlabel="theta1 (deg)",
        ylabel="theta2 (deg)",
        xticks=range(0, 181, 45),
        yticks=range(-180, 181, 45),
    )
    axes[1].set(
        xlabel="theta1 (deg)", ylabel="period (s)", xticks=range(0, 181, 45), ylim=(0, None)
    )
    axes[1].legend(fontsize="small", frameon=False, loc="upper left")
    fig.savefig(options.figure, dpi=110)
    print(f"drawn in {options.figure.name}")


if __name__ == "__main__":
    main()
