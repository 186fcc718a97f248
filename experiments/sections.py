"""Sections of the paper's pendulum at five energies, from order to chaos, with periodic orbits.

Each picture shows the plane theta1 = 0, theta1 rising: one colour a motion, rings and crosses the
stable and unstable orbits of one to three returns. At the lowest energies curves surround the orbit
of the anti-phase mode. The curve on which the motion turns by the golden share (3 - sqrt 5)/2 of a
full turn a return is drawn black: of all curves around it, it should be among the last to break.
The last picture shows the rotation number against the momentum where the curves cross theta2 = 0;
steps are chains of islands, where it is a fraction.

The script prints the rotation number of the golden curve by two methods, and how far the periodic
orbits of one return are from what `find_orbit` or, integrated over a period, diffrax gives.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import brentq

import dpend
from dpend import plots

HERE = Path(__file__).parent
ENERGIES = (-0.5, -0.45, -0.4, -0.3, 0.0)  # J; at rest it is -0.588, at the lower saddle -0.196
GOLDEN = (3 - 5**0.5) / 2
# Energies at which the golden curve is looked for: lower down all curves turn faster.
GOLDEN_AT = (-0.45, -0.4)
# Rotation numbers that both methods give to so much are believed.
BELIEVED = 1e-7


def rotations(pendulum: dpend.Pendulum, energy: float, centre: Any, p2: Any, returns: int) -> Any:
    """The rotation numbers of the motions that start at theta2 = 0 with these momenta."""
    starts = np.column_stack([np.zeros(len(p2)), p2])
    section = dpend.section(pendulum, energy, points=starts, count=2 * returns)
    return section, dpend.rotation_numbers(section, centre)


def golden_curve(
    pendulum: dpend.Pendulum, energy: float, centre: Any, returns: int
) -> tuple[Any, Any, Any]:
    """The momenta along theta2 = 0 with their rotation numbers, and the momentum of the golden
    curve, None where there is none.
    """
    edge = float(dpend.Plane().largest_momentum(pendulum, energy, 0.0))
    p2 = centre[1] + (edge - centre[1]) * np.linspace(0.01, 0.8, 60)
    _, found = rotations(pendulum, energy, centre, p2, returns)
    sound = found.difference.values < BELIEVED
    above = found.rotation.values > GOLDEN
    ends = np.flatnonzero(sound[1:] & sound[:-1] & (above[1:] != above[:-1]))
    if not ends.size:
        return p2, found, None

    def away(momentum: float) -> float:
        _, one = rotations(pendulum, energy, centre, [momentum], returns)
        return float(one.rotation[0]) - GOLDEN

    return p2, found, brentq(away, *p2[ends[0] : ends[0] + 2], xtol=1e-15)


def draw_golden(
    pendulum: dpend.Pendulum, energy: float, orbits: Any, ax: Any, returns: int
) -> tuple[Any, Any]:
    """Draws and names the golden curve around the orbit of the anti-phase mode, the shortest; the
    momenta along theta2 = 0 with their rotation numbers.
    """
    first = int(np.argmin(orbits.period.values))
    centre = float(orbits.angle[first, 0]), float(orbits.momentum[first, 0])
    p2, found, where = golden_curve(pendulum, energy, centre, returns)
    if where is None:
        print("  no golden curve")
        return p2, found
    curve, number = rotations(pendulum, energy, centre, [where], returns)
    rising = curve.side.values[0] == 1
    angle, momentum = curve.angle.values[0, rising], curve.momentum.values[0, rising]
    order = np.argsort(np.arctan2((momentum - centre[1]) / 0.02, angle - centre[0]))
    closed = np.append(order, order[0])
    ax.plot(np.degrees(angle[closed]), momentum[closed], color="black", linewidth=1.8)
    ax.annotate(
        "golden", (0.0, where), xytext=(0.0, 3.0), textcoords="offset points", ha="center",
        va="bottom", fontsize="small", bbox={"fc": "white", "ec": "none", "pad": 0.6},
    )  # fmt: skip
    print(
        f"  golden curve through p2 = {where:.12f} kg m^2/s: rotation number "
        f"{float(number.rotation[0]):.11f} by mean turns, {float(number.frequency[0]):.11f} by the "
        f"spectrum; wanted {GOLDEN:.11f}"
    )
    return p2, found


def draw_rotations(golden: dict[float, Any], ax: Any) -> None:
    """The rotation number against the momentum, where both methods agree."""
    for (energy, (p2, found)), mark in zip(golden.items(), "osv", strict=False):
        sound = found.difference.values < BELIEVED
        ax.plot(p2[sound], found.rotation.values[sound], mark, ms=4, label=f"E = {energy:g} J")
    ax.axhline(GOLDEN, color="black", linewidth=1.2)
    ax.annotate(
        "golden, 0.381966", (1.0, GOLDEN), xycoords=("axes fraction", "data"), xytext=(-4, 3),
        textcoords="offset points", ha="right", fontsize="small",
    )  # fmt: skip
    ax.set_xlabel("p2 at theta2 = 0 (kg m$^2$/s)")
    ax.set_ylabel("rotation number (turns a return)")
    ax.set_title("around the anti-phase orbit", fontsize="medium")
    ax.locator_params(axis="x", nbins=6)
    ax.legend(frameon=False, fontsize="small", loc="lower right")


def missed(pendulum: dpend.Pendulum, energy: float, orbits: Any) -> float:
    """By how much diffrax misses the start after a period, over its growth [rad]."""
    worst = 0.0
    for i in range(orbits.sizes["orbit"]):
        angle, momentum = float(orbits.angle[i, 0]), float(orbits.momentum[i, 0])
        start = dpend.on_energy(pendulum, energy, 0.0, angle, p2=momentum)
        end = dpend.reference(pendulum, start, [float(orbits.period[i])]).state
        away = np.remainder(float(end.theta2[0]) - angle + np.pi, 2 * np.pi) - np.pi
        worst = max(worst, abs(away) / max(1.0, 2 * abs(float(orbits.kappa[i]))))
    return worst


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer motions and returns")
    parser.add_argument("--figure", type=Path, default=HERE / "figures" / "sections.png")
    options = parser.parse_args()
    starts, count, returns = (16, 60, 200) if options.quick else (96, 400, 1000)
    pendulum = dpend.Pendulum()

    import matplotlib.pyplot as plt
    from PIL import Image

    fig, grid = plt.subplots(2, 3, figsize=(12.6, 8.0), layout="constrained")
    golden: dict[float, Any] = {}
    for energy, ax in zip(ENERGIES, grid.ravel(), strict=False):
        section = dpend.section(pendulum, energy, starts=starts, count=count)
        orbits = [
            dpend.periodic_points(pendulum, energy, returns=k, starts=16 if options.quick else 128)
            for k in ((1,) if options.quick else (1, 2, 3))
        ]
        plots.section(section, ax, periodic=orbits)
        counts = " + ".join(str(one.sizes["orbit"]) for one in orbits)
        print(
            f"E = {energy:g} J: {counts} orbits of 1, 2, 3 returns; diffrax misses those of one by "
            f"{missed(pendulum, energy, orbits[0]):.0e} rad over their growth"
        )
        if energy in GOLDEN_AT:
            golden[energy] = draw_golden(pendulum, energy, orbits[0], ax, returns)
    draw_rotations(golden, grid[1, 2])
    fig.savefig(options.figure, dpi=95)
    Image.open(options.figure).convert("RGB").quantize(256).save(options.figure, optimize=True)


if __name__ == "__main__":
    main()
