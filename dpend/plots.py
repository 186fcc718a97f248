"""Pictures of a motion: its path, angles and energies against time, and the rods as a stroboscope sees them.

Each function draws into the axes it is given, or into new ones, and returns them; saving is the caller's. Colours are
from Okabe and Ito's palette, told apart by the colour-blind: blue for the upper rod and bob, vermilion for the lower.
"""

from typing import TYPE_CHECKING

import jax
import numpy as np

from dpend.orbits import PeriodicOrbit
from dpend.pendulum import Pendulum, State, energies, positions
from dpend.trajectory import Trajectory, simulate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

UPPER, LOWER, NEUTRAL = "#0072B2", "#D55E00", "#555555"
# Marks along a path, and pictures of a strobe: enough to see the speed, few enough to see each.
_STROBES = 13


def _axes(ax: "Axes | None") -> "Axes":
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.subplots(figsize=(4.5, 4.0), layout="constrained")[1]


def _legend_above(ax: "Axes", columns: int) -> None:
    """A legend in room of its own above the curves, which fill the axes from side to side."""
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + 0.25 * (high - low))
    ax.legend(frameon=False, fontsize="small", loc="upper center", ncols=columns)


def path(motion: Trajectory, ax: "Axes | None" = None) -> "Axes":
    """The path in the plane of the two angles [deg], with a dot at the release."""
    ax = _axes(ax)
    theta1, theta2 = np.degrees(motion.state.theta1), np.degrees(motion.state.theta2)
    ax.plot(theta1, theta2, color=NEUTRAL, linewidth=1.2)
    ax.plot(theta1[0], theta2[0], "o", color="black", markersize=4)
    ax.set_xlabel("theta1 (deg)")
    ax.set_ylabel("theta2 (deg)")
    return ax


def angles(motion: Trajectory, ax: "Axes | None" = None) -> "Axes":
    """Both angles [deg] against time [s]."""
    ax = _axes(ax)
    ax.plot(motion.time, np.degrees(motion.state.theta1), color=UPPER, label="theta1")
    ax.plot(motion.time, np.degrees(motion.state.theta2), color=LOWER, label="theta2", linestyle="--")
    ax.set_xlabel("time (s)")
    ax.set_ylabel("angle (deg)")
    _legend_above(ax, columns=2)
    return ax


def energy(pendulum: Pendulum, motion: Trajectory, ax: "Axes | None" = None) -> "Axes":
    """Kinetic and potential energy of both bobs [J] against time [s], each bob's zero where it hangs at rest."""
    ax = _axes(ax)
    bobs = energies(pendulum, motion.state)
    for values, colour, style, label in (
        (bobs.kinetic1, UPPER, "-", "kinetic, upper bob"),
        (bobs.potential1, UPPER, ":", "potential, upper bob"),
        (bobs.kinetic2, LOWER, "-", "kinetic, lower bob"),
        (bobs.potential2, LOWER, ":", "potential, lower bob"),
    ):
        ax.plot(motion.time, values, color=colour, linestyle=style, label=label)
    ax.set_xlabel("time (s)")
    ax.set_ylabel("energy (J)")
    _legend_above(ax, columns=2)
    return ax


def strobe(pendulum: Pendulum, motion: Trajectory, ax: "Axes | None" = None, every: int = 1) -> "Axes":
    """The rods at every `every`-th saved time [positions in m], later ones darker."""
    ax = _axes(ax)
    seen = State(*(np.asarray(leaf)[::every] for leaf in jax.tree.leaves(motion.state)))
    x1, y1, x2, y2 = (np.asarray(value) for value in positions(pendulum, seen))
    for i in range(x1.size):
        fade = 0.25 + 0.75 * (i + 1) / x1.size
        ax.plot([0, x1[i]], [0, y1[i]], color=UPPER, alpha=fade, linewidth=1)
        ax.plot([x1[i], x2[i]], [y1[i], y2[i]], color=LOWER, alpha=fade, linewidth=1)
        ax.plot(x1[i], y1[i], "o", color=UPPER, alpha=fade, markersize=4)
        ax.plot(x2[i], y2[i], "o", color=LOWER, alpha=fade, markersize=4)
    ax.plot(0, 0, "s", color="black", markersize=3)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel("x (m)")
    ax.set_ylabel("y (m)")
    return ax


def orbit_sheet(orbits: dict[str, PeriodicOrbit]) -> "Figure":
    """One row for each named orbit: the rods over half a period, its path, and its angles over one period."""
    import matplotlib.pyplot as plt

    fig, grid = plt.subplots(len(orbits), 3, figsize=(10.5, 3.3 * len(orbits)), layout="constrained", squeeze=False)
    for (name, orbit), row in zip(orbits.items(), grid, strict=True):
        period = float(orbit.period)
        steps = 20 * (_STROBES - 1)  # over half a period, so that the strobes fall on both rests
        whole = simulate(orbit.pendulum, orbit.state, period, step=period / (2 * steps), error=False)
        half = Trajectory(
            whole.time[: steps + 1],
            State(*(leaf[: steps + 1] for leaf in jax.tree.leaves(whole.state))),
            whole.energy_drift, whole.error_estimate, whole.steps, whole.status, whole.scheme,
        )  # fmt: skip
        strobe(orbit.pendulum, half, row[0], every=20)
        path(whole, row[1])
        angles(whole, row[2])
        row[0].set_title(f"{name}, {period / (2 * (_STROBES - 1)):.3f} s apart", fontsize="medium")
        row[1].set_title(f"({np.degrees(orbit.theta1):.4f}, {np.degrees(orbit.theta2):.4f}) deg", fontsize="medium")
        row[2].set_title(f"T = {period:.6f} s, {orbit.stability}", fontsize="medium")
    return fig
