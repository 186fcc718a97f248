"""Pictures of a motion (path, angles and energies, the rods as a stroboscope sees them), of orbits
and families, of maps, sections and fits.

A function draws into the axes it is given, or into new ones, and returns them. It hands further
keywords (`color`, `linewidth`, `cmap` and their like) to the function of matplotlib that it draws
with. Colours are from Okabe and Ito's palette, told apart by the colour-blind: blue for the upper
rod and bob, vermilion for the lower.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from dpend.catalogue.atlas import Atlas
from dpend.checks import instance, integer, one_of, shown, single
from dpend.family_picture import PLANES, draw_atlas, draw_family, draw_legend
from dpend.fit_picture import draw_residuals
from dpend.inverse.estimates import Fit
from dpend.map_picture import LABELS, draw_map
from dpend.mechanics.pendulum import Pendulum, check_pendulum, energies
from dpend.motion.trajectory import Trajectory
from dpend.motion_picture import (
    COLORS,
    LOWER,
    NEUTRAL,
    UPPER,
    draw_strobe,
    joints_of,
    legend_above,
    line_style,
    pick_poses,
)
from dpend.orbits.family import Family
from dpend.orbits.orbit import PeriodicOrbit
from dpend.section_picture import check_variables, draw_periodic, draw_section

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Poses of half an orbit: each falls on a saved time, and both rests are among them.
_STROBES = 13


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


def path(motion: Trajectory | Any, ax: "Axes | Any | None" = None, **style: Any) -> "Axes":
    """The path in the plane of the two angles [deg], with a dot at the release.

    Arguments:
        style: of the line, for `Axes.plot`.
    """
    _check_motion(motion)
    ax = _axes(ax)
    theta1, theta2 = np.degrees(motion.state.theta1), np.degrees(motion.state.theta2)
    ax.plot(theta1, theta2, **line_style(style, color=NEUTRAL, linewidth=1.2))
    ax.plot(theta1[0], theta2[0], "o", color="black", markersize=4)
    ax.set_xlabel("theta1 (deg)")
    ax.set_ylabel("theta2 (deg)")
    return ax


def angles(motion: Trajectory | Any, ax: "Axes | Any | None" = None, **style: Any) -> "Axes":
    """Both angles [deg] against time [s].

    Arguments:
        style: of both lines, for `Axes.plot`.
    """
    _check_motion(motion)
    ax = _axes(ax)
    for name, color, dashes in (("theta1", UPPER, "-"), ("theta2", LOWER, "--")):
        look = line_style(style, color=color, linestyle=dashes, label=name)
        ax.plot(motion.time, np.degrees(getattr(motion.state, name)), **look)
    ax.set_xlabel("time (s)")
    ax.set_ylabel("angle (deg)")
    legend_above(ax, columns=2)
    return ax


def energy(
    pendulum: Pendulum | Any,
    motion: Trajectory | Any,
    ax: "Axes | Any | None" = None,
    **style: Any,
) -> "Axes":
    """Kinetic and potential energy of both bobs [J] against time [s], each bob's zero where it
    hangs at rest.

    Arguments:
        style: of all four lines, for `Axes.plot`.
    """
    check_pendulum(pendulum)
    _check_motion(motion)
    ax = _axes(ax)
    bobs = energies(pendulum, motion.state)
    for values, color, dashes, label in (
        (bobs.kinetic1, UPPER, "-", "kinetic, upper bob"),
        (bobs.potential1, UPPER, ":", "potential, upper bob"),
        (bobs.kinetic2, LOWER, "-", "kinetic, lower bob"),
        (bobs.potential2, LOWER, ":", "potential, lower bob"),
    ):
        ax.plot(
            motion.time, values, **line_style(style, color=color, linestyle=dashes, label=label)
        )
    ax.set_xlabel("time (s)")
    ax.set_ylabel("energy (J)")
    legend_above(ax, columns=2)
    return ax


def strobe(
    pendulum: Pendulum | Any,
    motion: Trajectory | Any,
    ax: "Axes | Any | None" = None,
    every: int | Any | None = None,
    **style: Any,
) -> "Axes":
    """The rods as a stroboscope sees them [positions in m], later ones darker, over the path of the
    lower bob.

    Arguments:
        every: shows every so many-th saved time; by default 15 of them, evenly spaced, or all if
            there are fewer.
        style: of the rods, for `Axes.plot`.
    """
    check_pendulum(pendulum)
    _check_motion(motion)
    every = None if every is None else integer("every", every)
    ax, joints = _axes(ax), joints_of(pendulum, motion.state)
    count = len(joints)
    chosen = pick_poses(count) if every is None else np.arange(0, count, every)
    draw_strobe(ax, joints, chosen, (UPPER, LOWER), line_style(style))
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
    **style: Any,
) -> "Axes":
    """A family of orbits: solid where they are stable (|kappa| <= 1), dashed where not, its special
    points marked.

    Circles are where that changes, triangles folds, ticks resonances. A family whose releases lie
    to the left is drawn in the mirror.

    Arguments:
        plane: `angles` for the releases (theta1, theta2) [deg], `period` for the period [s] against
            the energy [J], `upright` for the period against how far the energy lies below that of
            the upright state, on a logarithmic axis.
        style: of the curve, for `Axes.plot`: `color`, `label` and their like.
    Raises:
        ValueError: another plane; no family.
    """
    instance("curve", curve, Family, "what dpend.follow_family returns")
    plane = one_of("plane", plane, tuple(PLANES))
    ax = _axes(ax)
    draw_family(ax, curve, plane, line_style(style, color=UPPER))
    return ax


def families(
    curves: dict[str, Family] | Any,
    ax: "Axes | Any | None" = None,
    *,
    plane: str | Any = "angles",
    **style: Any,
) -> "Axes":
    """Several named families in one plot, each in a colour of its own, with a legend: see `family`.

    Raises:
        ValueError: another plane; no dictionary of families.
    """
    if not isinstance(curves, dict) or not curves:
        raise ValueError(
            f"curves must be a dictionary of families, got {shown(curves)}: give one like "
            f"{{'in-phase': family}}"
        )
    for name, curve in curves.items():
        instance(f"curves[{name!r}]", curve, Family, "what dpend.follow_family returns")
    plane = one_of("plane", plane, tuple(PLANES))
    ax = _axes(ax)
    for i, (name, curve) in enumerate(curves.items()):
        draw_family(ax, curve, plane, line_style(style, color=COLORS[i % len(COLORS)], label=name))
    draw_legend(ax, curves.values())
    return ax


def atlas(found: Atlas | Any, ax: "Axes | Any | None" = None, **style: Any) -> "Axes":
    """The orbits of an atlas: filled where they are stable, hollow where not.

    Of the whole square the releases [deg], a colour for each family; of a single release angle the
    period [s] against theta2 [deg].

    Arguments:
        style: of the marks, for `Axes.plot`.
    Raises:
        ValueError: no atlas.
    """
    instance("found", found, Atlas, "what dpend.find_brake_families returns")
    ax = _axes(ax)
    draw_atlas(ax, found, line_style(style))
    return ax


def map_of(
    dataset: Any,
    name: str | Any | None = None,
    ax: "Axes | Any | None" = None,
    **style: Any,
) -> "Axes":
    """One value of a two-dimensional sweep in colours, its first axis to the right, its second
    upwards.

    Angles are in degrees. Values over decades (errors, drifts, times) have a logarithmic scale.
    Cells without a finite value are white: failed ones, and on a flip map those that do not flip;
    there a line bounds the releases that lack the energy for it. The title tells the duration and
    the pendulum.

    Arguments:
        dataset: what `sweep` returned.
        name: which value; by default the first that this page knows, or the first.
        style: of the cells, for `Axes.pcolormesh`, such as `cmap`, `vmin` and `vmax`.
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
    draw_map(ax, dataset, name, style)
    return ax


def section(
    dataset: Any,
    ax: "Axes | Any | None" = None,
    *,
    periodic: Any | None = None,
    **style: Any,
) -> "Axes":
    """A section: the crossings as dots, one colour a motion, inside the line that bounds what the
    energy allows.

    The angle is in degrees, the momentum in kg m^2/s. Crossings of side -1 are drawn at (-q, -p) on
    the planes at 0 and pi, as their mirror image crosses there on side 1; on other planes they are
    left out.

    Arguments:
        dataset: what `section` returned.
        periodic: what `periodic_points` returned on the same plane, or a list of such: rings where
            |kappa| <= 1, crosses where the orbit is unstable.
        style: of the dots, for `Axes.scatter`.
    Raises:
        ValueError: other datasets.
    """
    import xarray

    instance("dataset", dataset, xarray.Dataset, "what dpend.section returns")
    check_variables("dataset", dataset, ("angle", "momentum", "side"), "dpend.section")
    several = periodic if isinstance(periodic, (list, tuple)) else [periodic]
    marked = [] if periodic is None else several
    for one in marked:
        instance("periodic", one, xarray.Dataset, "what dpend.periodic_points returns")
        names = ("angle", "momentum", "kappa")
        check_variables("periodic", one, names, "dpend.periodic_points")
    ax = _axes(ax)
    draw_section(ax, dataset, style)
    for one in marked:
        draw_periodic(ax, one)
    return ax


def residuals(fit: Fit | Any) -> "Figure":
    """A fit over its data: the angles [deg], and what is left of them beside a band of twice the
    noise to either side.

    Measured angles are dots, shown in the turn in which the fitted motion is, which is drawn as a
    line; blue for the upper rod and vermilion for the lower.
    """
    instance("fit", fit, Fit, "what dpend.fit_parameters returns")
    return draw_residuals(fit)
