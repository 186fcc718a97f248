"""Both families of normal modes of the paper's pendulum, to the upright state, and what branches
off.

Left the releases in the plane of both angles, in the middle the period against the energy, right
against its logarithmic distance from that of the upright state: solid where orbits are stable,
dashed where not. The six releases that the paper found by hand lie on the two
curves. The script prints where stability and resonances are, checks orbits of every family with
diffrax, and compares how the period grows with the slow exponent of the upright equilibrium.
"""

import argparse
from pathlib import Path

import jax
import numpy as np

import dpend
from dpend import plots

HERE = Path(__file__).parent
# The paper's motions as printed [deg].
PAPER = {
    "A": (64.3, 64.3),
    "B": (40, 49.1),
    "C": (10, 14.1),
    "D": (63.95, -63.95),
    "E": (40, -51.2),
    "F": (10, -14.1),
}
PURPLE, GREEN = "#CC79A7", "#009E73"


def missed(family: dpend.Family) -> float:
    """By how much diffrax misses the state at T/2, on five orbits whose kappa leaves ten digits
    [rad].
    """
    known = np.flatnonzero(family.orbits.log_abs_kappa < np.log(1e5))
    worst = 0.0
    for i in known[:: max(1, known.size // 5)][:5]:
        orbit = jax.tree.map(lambda leaf, i=i: leaf[i], family.orbits)
        start = dpend.State(*(float(leaf) for leaf in jax.tree.leaves(orbit.state)))
        half = dpend.reference(orbit.pendulum, start, [float(orbit.period) / 2], error=False).state
        dual = orbit.dual
        worst = max(
            worst,
            float(abs(half.theta1[0] - dual.theta1)),
            float(abs(half.theta2[0] - dual.theta2)),
        )
    return worst


def growth(family: dpend.Family) -> tuple[float, float]:
    """-dT/d ln gap near the end, the gap being E_top - E, and 2/lambda of the upright equilibrium
    [s].
    """
    pendulum = jax.tree.map(lambda leaf: float(leaf[0]), family.orbits.pendulum)
    top = dpend.equilibria(pendulum)
    gap = np.asarray(top.energy[3] - family.orbits.energy)
    late = gap < 1e-6 * gap[0]
    slope = np.polyfit(np.log(gap[late]), np.asarray(family.orbits.period)[late], 1)[0]
    return -slope, 2 / float(np.min(np.abs(top.exponents[3].real)))


def told(name: str, family: dpend.Family) -> None:
    first, last = (float(family.orbits.period[i]) for i in (0, -1))
    print(
        f"{name}: {family.symmetry}, {len(family.arclength)} orbits, {' to '.join(family.ends)}",
        end=", ",
    )
    print(
        f"T = {first:.4f} to {last:.4f} s; diffrax misses T/2 by {missed(family):.0e} rad at most"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="longer steps, and no branches")
    parser.add_argument("--figure", type=Path, default=HERE / "figures" / "families.png")
    options = parser.parse_args()
    import matplotlib.pyplot as plt

    pendulum = dpend.Pendulum()
    fig, axes = plt.subplots(1, 3, figsize=(16, 5.4), layout="constrained")

    def draw(family: dpend.Family, colour: str, label: str) -> None:
        plots.family(family, axes[0], plane="angles", color=colour, label=label)
        plots.family(family, axes[1], plane="period", color=colour, label=label)
        plots.family(family, axes[2], plane="upright", color=colour, label=label)

    for branch, colour in (("in-phase", plots.UPPER), ("anti-phase", plots.LOWER)):
        family = dpend.follow_family(pendulum, branch, longest_step=0.25 if options.quick else 0.05)
        draw(family, colour, branch)
        told(branch, family)
        slope, expected = growth(family)
        print(f"  -dT/d ln(E_top - E) = {slope:.5f} s near the end, 2/lambda = {expected:.5f} s")
        print(
            f"  kappa from {np.min(family.orbits.kappa):.12f} to "
            f"exp({family.orbits.log_abs_kappa[-1]:.1f})"
        )
        for point in family.special_points:
            angles = np.degrees([point.orbit.theta1, point.orbit.theta2])
            print(
                f"  {point.kind:16} ({angles[0]:.8f}, {angles[1]:.8f}) deg, T = "
                f"{point.orbit.period:.10f} s"
            )
            kinds = ("stability_lost", "resonance_2:1", "resonance_3:1")
            if options.quick or point.kind not in kinds:
                continue
            offspring = dpend.follow_family(pendulum, point)
            odd = offspring.symmetry == "odd"
            draw(
                offspring,
                GREEN if odd else PURPLE,
                "x(T/2) = -x(0), never at rest" if odd else "brake orbits, 2 T and 3 T",
            )
            told(f"    branch at {point.kind}", offspring)
    for name, (theta1, theta2) in PAPER.items():
        axes[0].plot(theta1, theta2, "*", color="black", markersize=9, zorder=5)
        shift = (-4, 8) if theta2 > 0 else (7, 4)
        axes[0].annotate(
            name, (theta1, theta2), textcoords="offset points", xytext=shift, fontsize=9
        )
    for theta2 in (180, -180):
        axes[0].plot(180, theta2, "x", color="black", markersize=8)
    axes[0].set(
        xlim=(-8, 200), ylim=(-215, 200), xticks=range(0, 181, 45), yticks=range(-180, 181, 45)
    )
    axes[1].set(xlim=(-0.62, 0.63), ylim=(0, 8.5))
    axes[2].set(xlim=(2, 1e-9), ylim=(0, 20))
    axes[1].axvline(
        dpend.equilibria(pendulum).energy[3], color=plots.NEUTRAL, linewidth=0.8, linestyle=":"
    )
    axes[1].annotate(
        "upright", (0.588, 8.1), textcoords="offset points", xytext=(-4, 0), ha="right", fontsize=9
    )
    handles, labels = axes[1].get_legend_handles_labels()
    once = dict(zip(labels, handles, strict=True))
    for mark, label in (
        ("o", "stability changes"),
        ("^", "fold"),
        ("|", "resonance k:n, k up to 6"),
        ("*", "the paper's six"),
    ):
        white = "white" if mark in "o^" else "black"
        once[label] = plt.Line2D(
            [], [], color="black", marker=mark, markerfacecolor=white, linestyle="none"
        )
    axes[1].legend(once.values(), once.keys(), loc="upper left", fontsize="small", frameon=False)
    fig.savefig(options.figure, dpi=85)
    print(f"drawn in {options.figure.name}")


if __name__ == "__main__":
    main()
