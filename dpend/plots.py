"""Pictures of a motion (path, angles and energies, the rods as a stroboscope sees them), of maps
and of fits.

Each function draws into the axes it is given, or into new ones, and returns them. Colours are from
Okabe and Ito's palette, told apart by the colour-blind: blue for the upper rod and bob, vermilion
for the lower.
"""

from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from dpend.checks import instance, integer, one_of, shown, single
from dpend.inverse.estimates import Fit
from dpend.map_picture import LABELS, draw_map
from dpend.mechanics.pendulum import Pendulum, check_pendulum, energies, positions
from dpend.motion.trajectory import Trajectory
from dpend.orbits.family import Family
from dpend.orbits.orbit import PeriodicOrbit
from dpend.section_picture import draw_periodic, draw_section

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

UPPER, LOWER, NEUTRAL = "#0072B2", "#D55E00", "#555555"
# Marks along a path, and pictures of a strobe: enough to see the speed, few enough to see each.
_STROBES = 13
# The marks of a family's special points, by the beginning of their kind.
_MARKS = {"resonance": "|", "fold": "^", "stability": "o"}
# Orbits are drawn as stable up to this log |kappa|, which is zero on stable ones but for rounding.
_STABLE = 1e-9


def _axes(ax: Any) -> "Axes":
    """The axes that were given, or new ones.

    Raises:
        ValueError: something else was given.
    """
    import matplotlib.pyplot as plt
    from matplotlib.axes import Axes

    if ax is not None:
        instance("ax", ax, Axes, "those of matplotlib.pyplot.subplots()")
        return ax

    return plt.subplots(figsize=(4.5, 4.0), layout="constrained")[1]


def _check_motion(motion: Any) -> None:
    instance("motion", motion, Trajectory, "what dpend.simulate returns")


def _legend_above(ax: "Axes", columns: int) -> None:
    """A legend in room of its own above the curves, which fill the axes from side to side."""
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + 0.25 * (high - low))
    ax.legend(frameon=False, fontsize="small", loc="upper center", ncols=columns)


def path(motion: Trajectory | Any, ax: "Axes | Any | None" = None) -> "Axes":
    """The path in the plane of the two angles [deg], with a dot at the release."""
    _check_motion(motion)
    ax = _axes(ax)
    theta1, theta2 = np.degrees(motion.state.theta1), np.degrees(motion.state.theta2)
    ax.plot(theta1, theta2, color=NEUTRAL, linewidth=1.2)
    ax.plot(theta1[0], theta2[0], "o", color="black", markersize=4)
    ax.set_xlabel("theta1 (deg)")
    ax.set_ylabel("theta2 (deg)")
    return ax


def angles(motion: Trajectory | Any, ax: "Axes | Any | None" = None) -> "Axes":
    """Both angles [deg] against time [s]."""
    _check_motion(motion)
    ax = _axes(ax)
    ax.plot(motion.time, np.degrees(motion.state.theta1), color=UPPER, label="theta1")
    ax.plot(
        motion.time, np.degrees(motion.state.theta2), color=LOWER, label="theta2", linestyle="--"
    )
    ax.set_xlabel("time (s)")
    ax.set_ylabel("angle (deg)")
    _legend_above(ax, columns=2)
    return ax


def energy(
    pendulum: Pendulum | Any, motion: Trajectory | Any, ax: "Axes | Any | None" = None
) -> "Axes":
    """Kinetic and potential energy of both bobs [J] against time [s], each bob's zero where it
    hangs at rest.
    """
    check_pendulum(pendulum)
    _check_motion(motion)
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


def strobe(
    pendulum: Pendulum | Any,
    motion: Trajectory | Any,
    ax: "Axes | Any | None" = None,
    every: int | Any = 1,
) -> "Axes":
    """The rods at every `every`-th saved time [positions in m], later ones darker."""
    check_pendulum(pendulum)
    _check_motion(motion)
    every, ax = integer("every", every), _axes(ax)
    seen = jax.tree.map(lambda leaf: np.asarray(leaf)[::every], motion.state)
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


def orbit_sheet(orbits: dict[str, PeriodicOrbit] | Any) -> "Figure":
    """One row for each named orbit: the rods over half a period, its path, and its angles over one
    period.

    Raises:
        ValueError: no dictionary of single orbits that are known.
    """
    import matplotlib.pyplot as plt

    if not isinstance(orbits, dict) or not orbits:
        raise ValueError(
            f"orbits must be a dictionary of orbits, got {shown(orbits)}: give one like "
            f"{{'A': orbit}}"
        )
    for name, orbit in orbits.items():
        instance(f"orbits[{name!r}]", orbit, PeriodicOrbit, "what dpend.find_orbit returns")
        single(f"orbits[{name!r}]", orbit.period)

    fig, grid = plt.subplots(
        len(orbits), 3, figsize=(10.5, 3.3 * len(orbits)), layout="constrained", squeeze=False
    )
    steps = 20 * (_STROBES - 1)  # over half a period, so that the strobes fall on both rests
    for (name, orbit), row in zip(orbits.items(), grid, strict=True):
        period = float(orbit.period)
        times = np.linspace(0.0, period, 2 * steps + 1)
        whole = orbit.trajectory(times)
        strobe(orbit.pendulum, orbit.trajectory(times[: steps + 1]), row[0], every=20)
        path(whole, row[1])
        angles(whole, row[2])
        row[0].set_title(f"{name}, {period / (2 * (_STROBES - 1)):.3f} s apart", fontsize="medium")
        row[1].set_title(
            f"({np.degrees(orbit.theta1):.4f}, {np.degrees(orbit.theta2):.4f}) deg",
            fontsize="medium",
        )
        row[2].set_title(f"T = {period:.6f} s, {orbit.stability}", fontsize="medium")
    return fig


def family(
    curve: Family | Any,
    ax: "Axes | Any | None" = None,
    *,
    plane: str | Any = "angles",
    colour: str | Any = UPPER,
    label: str | Any = "",
) -> "Axes":
    """A family of orbits: solid where they are stable (|kappa| <= 1), dashed where not, its special
    points marked.

    Circles are where that changes, triangles folds, ticks resonances. A family whose releases lie
    to the left is drawn in the mirror.

    Arguments:
        plane: `angles` for the releases (theta1, theta2) [deg], `period` for the period [s] against
            the energy [J].
    Raises:
        ValueError: another plane; no colour of matplotlib's.
    """
    from matplotlib.colors import is_color_like

    instance("curve", curve, Family, "what dpend.follow_family returns")
    plane = one_of("plane", plane, ("angles", "period"))
    if not is_color_like(colour):
        raise ValueError(
            f'colour must be one that matplotlib knows, got {shown(colour)}: give one like "black"'
        )
    if not isinstance(label, str):
        raise ValueError(f'label must be text, got {shown(label)}: give one like "in phase"')
    ax = _axes(ax)
    side = np.sign(np.mean(curve.orbits.theta1))

    def where(orbits: PeriodicOrbit) -> tuple[Any, Any]:
        if plane == "angles":
            return side * np.degrees(orbits.theta1), side * np.degrees(orbits.theta2)
        return np.asarray(orbits.energy), np.asarray(orbits.period)

    x, y = where(curve.orbits)
    stable = np.asarray(curve.orbits.log_abs_kappa) <= _STABLE
    # A piece between a stable and an unstable orbit is drawn as unstable, up to the point where
    # that changes.
    pieces = stable[:-1] & stable[1:]
    solid = np.append(pieces, False) | np.append(False, pieces)
    ax.plot(x, y, color=colour, linestyle=(0, (4, 2)), linewidth=1.1)
    ax.plot(np.where(solid, x, np.nan), y, color=colour, linewidth=1.8, label=label or None)
    hollow: dict[str, Any] = {"c": colour, "mfc": "white", "ms": 6, "ls": "none"}
    for start, mark in _MARKS.items():
        points = [point.orbit for point in curve.special_points if point.kind.startswith(start)]
        if points:
            ax.plot(*np.transpose([where(orbit) for orbit in points]), mark, **hollow)
    ax.set_xlabel("theta1 (deg)" if plane == "angles" else "energy (J)")
    ax.set_ylabel("theta2 (deg)" if plane == "angles" else "period (s)")
    return ax


def map_of(dataset: Any, name: str | Any | None = None, ax: "Axes | Any | None" = None) -> "Axes":
    """One value of a two-dimensional sweep in colours, its first axis to the right, its second
    upwards.

    Angles are in degrees. Values over decades (errors, drifts, times) have a logarithmic scale.
    Cells without a finite value are white: failed ones, and on a flip map those that do not flip;
    there a line bounds the releases that lack the energy for it.

    Arguments:
        dataset: what `sweep` returned.
        name: which value; by default the first that this page knows, or the first.
    Raises:
        ValueError: the dataset has not two dimensions, or no such value.
    """
    import xarray

    instance("dataset", dataset, xarray.Dataset, "what dpend.sweep returns")
    names = [str(key) for key in dataset.data_vars]
    first = next((key for key in names if key in LABELS), names[0] if names else None)
    name = one_of("name", first if name is None else name, names)
    field = dataset[name]
    if field.ndim != 2:
        raise ValueError(
            f"dataset must have two dimensions to be a map, got {field.ndim}: plot it as a curve"
        )
    ax = _axes(ax)
    draw_map(ax, dataset, name)
    return ax


def section(dataset: Any, ax: "Axes | Any | None" = None, *, periodic: Any | None = None) -> "Axes":
    """A section: the crossings as dots, one colour a motion, inside the line that bounds what the
    energy allows.

    The angle is in degrees, the momentum in kg m^2/s. Crossings of side -1 are drawn at (-q, -p) on
    the planes at 0 and pi, as their mirror image crosses there on side 1; on other planes they are
    left out.

    Arguments:
        dataset: what `section` returned.
        periodic: what `periodic_points` returned on the same plane, or a list of such: rings where
            |kappa| <= 1, crosses where the orbit is unstable.
    Raises:
        ValueError: other datasets.
    """
    import xarray

    instance("dataset", dataset, xarray.Dataset, "what dpend.section returns")
    _check_variables("dataset", dataset, ("angle", "momentum", "side"), "dpend.section")
    several = periodic if isinstance(periodic, (list, tuple)) else [periodic]
    marked = [] if periodic is None else several
    for one in marked:
        instance("periodic", one, xarray.Dataset, "what dpend.periodic_points returns")
        names = ("angle", "momentum", "kappa")
        _check_variables("periodic", one, names, "dpend.periodic_points")
    ax = _axes(ax)
    draw_section(ax, dataset)
    for one in marked:
        draw_periodic(ax, one)
    return ax


def _check_variables(name: str, dataset: Any, wanted: tuple[str, ...], source: str) -> None:
    missing = [key for key in wanted if key not in dataset]
    if missing:
        raise ValueError(
            f"{name} must hold {', '.join(wanted)}, got one without {missing[0]}: give what "
            f"{source} returns"
        )


def residuals(fit: Fit | Any) -> "Figure":
    """A fit over its data: the angles [deg], and what is left of them beside a band of twice the
    noise to either side.

    Measured angles are dots, shown in the turn in which the fitted motion is, which is drawn as a
    line; blue for the upper rod and vermilion for the lower.
    """
    import matplotlib.pyplot as plt

    instance("fit", fit, Fit, "what dpend.fit_parameters returns")
    fig, grid = plt.subplots(
        3,
        1,
        figsize=(9.0, 6.6),
        sharex=True,
        layout="constrained",
        gridspec_kw={"height_ratios": [2.2, 1, 1]},
    )
    both = (
        ("theta1", fit.theta1, fit.residual1, UPPER, "-"),
        ("theta2", fit.theta2, fit.residual2, LOWER, "--"),
    )
    band = 2 * float(np.degrees(fit.noise))
    for (name, angle, left, colour, style), ax in zip(both, grid[1:], strict=True):
        grid[0].plot(fit.time, np.degrees(angle), style, c=colour, lw=1.0, label=f"{name}, fitted")
        measured = np.degrees(angle + left)
        grid[0].plot(fit.time, measured, ".", c=colour, ms=3, label=f"{name}, measured")
        ax.axhspan(-band, band, color=NEUTRAL, alpha=0.15, linewidth=0)
        ax.axhline(0, color=NEUTRAL, linewidth=0.8)
        ax.plot(fit.time, np.degrees(left), ".", color=colour, markersize=3)
        ax.set_ylabel(f"{name} residual (deg)", fontsize="small")
    grid[0].set_ylabel("angle (deg)")
    grid[2].set_xlabel("time (s)")
    _legend_above(grid[0], columns=2)
    return fig
