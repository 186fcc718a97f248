"""A section in points, one colour a motion, and its periodic orbits in marks."""

from typing import TYPE_CHECKING, Any

import numpy as np

from dpend.mechanics.pendulum import Pendulum
from dpend.mechanics.surface import Plane

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Marks of periodic points, by kappa: rings where the orbit is stable, crosses where it is not.
_STABLE: dict[str, Any] = {
    "marker": "o",
    "s": 22,
    "facecolors": "white",
    "edgecolors": "black",
    "linewidths": 0.9,
}
_UNSTABLE: dict[str, Any] = {"marker": "x", "s": 20, "c": "black", "linewidths": 1.0}
# Points of the line around what the energy allows.
_EDGE = 721
# Dots of a picture of so many points are of this area [pt^2]; of more points smaller.
_FEW, _DOT = 5000, 1.2


def plane_of(dataset: Any) -> Plane:
    """The plane of a section, from its attributes."""
    return Plane(dataset.attrs["plane"], float(dataset.attrs["plane_at"]))


def draw_section(ax: "Axes", dataset: Any, style: dict[str, Any]) -> None:
    """Draws the crossings of side 1; on a plane at 0 or pi those of side -1 in the mirror, where
    the same motions, run backwards, have theirs.
    """
    plane = plane_of(dataset)
    angle, momentum = dataset.angle.values, dataset.momentum.values
    side = dataset.side.values
    shown = side == 1
    if np.isclose(np.sin(plane.at), 0.0, atol=1e-12):
        angle, momentum = np.where(side < 0, -1, 1) * angle, np.where(side < 0, -1, 1) * momentum
        shown = side != 0
    which = np.broadcast_to(np.arange(angle.shape[0])[:, None] * 0.381966 % 1.0, angle.shape)
    size = _DOT * min(1.0, (_FEW / max(shown.sum(), 1)) ** 0.5)
    dots = {"s": size, "linewidths": 0, "rasterized": True}
    if not style.keys() & {"c", "color"}:
        dots |= {"c": which[shown], "cmap": "turbo", "vmin": 0.0, "vmax": 1.0}
    ax.scatter(np.degrees(angle[shown]), momentum[shown], **(dots | style))
    _draw_edge(ax, dataset, plane)
    other, own = plane.coordinates
    ax.set_xlabel(f"{other} (deg)")
    ax.set_ylabel(f"{own} (kg m$^2$/s)")
    ax.set_title(
        f"{plane.angle} = {np.degrees(plane.at):g} deg, E = {dataset.attrs['energy']:.4g} J",
        fontsize="medium",
    )


def _draw_edge(ax: "Axes", dataset: Any, plane: Plane) -> None:
    """The line around what the energy allows: there motions touch the plane."""
    pendulum = Pendulum(**{key: dataset.attrs[key] for key in ("l1", "l2", "m1", "m2", "g")})
    angle = np.linspace(-np.pi, np.pi, _EDGE)
    edge = np.asarray(plane.largest_momentum(pendulum, dataset.attrs["energy"], angle))
    for sign in (1, -1):
        ax.plot(np.degrees(angle), sign * edge, color="0.6", linewidth=0.8)


def draw_periodic(ax: "Axes", points: Any) -> None:
    """Marks the periodic points: rings where stable, crosses where not."""
    for stable, marks in ((True, _STABLE), (False, _UNSTABLE)):
        chosen = (np.abs(points.kappa.values) <= 1.0) == stable
        angle, momentum = points.angle.values[chosen], points.momentum.values[chosen]
        ax.scatter(np.degrees(angle).ravel(), momentum.ravel(), zorder=3, **marks)


def check_variables(name: str, dataset: Any, wanted: tuple[str, ...], source: str) -> None:
    missing = [key for key in wanted if key not in dataset]
    if missing:
        raise ValueError(
            f"{name} must hold {', '.join(wanted)}, got one without {missing[0]}: give what "
            f"{source} returns"
        )
