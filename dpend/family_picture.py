"""Families of orbits as curves: solid where stable, dashed where not, special points marked; and an
atlas as points.
"""

from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from dpend.catalogue.atlas import Atlas
from dpend.mechanics.linear import equilibria
from dpend.motion_picture import COLORS
from dpend.orbits.family import Family
from dpend.orbits.orbit import PeriodicOrbit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# What a family may be drawn in, with the names of both axes.
PLANES = {
    "angles": ("theta1 (deg)", "theta2 (deg)"),
    "period": ("energy (J)", "period (s)"),
    "upright": ("energy below the upright state (J)", "period (s)"),
}
# The marks of a family's special points, by the beginning of their kind, and what they are.
_MARKS = {
    "stability": ("o", "stability changes"),
    "fold": ("^", "fold"),
    "resonance": ("|", "resonance"),
}
# Orbits are drawn as stable up to this log |kappa|, which is zero on stable ones but for rounding.
_STABLE = 1e-9


def _place(orbits: PeriodicOrbit, plane: str, side: float) -> tuple[Any, Any]:
    """Where orbits are drawn in a plane."""
    if plane == "angles":
        return side * np.degrees(orbits.theta1), side * np.degrees(orbits.theta2)
    energy, period = np.asarray(orbits.energy), np.asarray(orbits.period)
    if plane == "period":
        return energy, period
    one = jax.tree.map(lambda leaf: float(np.ravel(leaf)[0]), orbits.pendulum)
    return float(equilibria(one).energy[3]) - energy, period


def draw_family(ax: "Axes", curve: Family, plane: str, style: dict[str, Any]) -> None:
    """Draws one family, see `plots.family`."""
    side = float(np.sign(np.mean(curve.orbits.theta1))) or 1.0
    x, y = _place(curve.orbits, plane, side)
    stable = np.asarray(curve.orbits.log_abs_kappa) <= _STABLE
    # A piece between a stable and an unstable orbit is drawn as unstable, up to the point where
    # that changes.
    pieces = stable[:-1] & stable[1:]
    solid = np.append(pieces, False) | np.append(False, pieces)
    label = style.pop("label", None)
    dashed: dict[str, Any] = {"linestyle": (0, (4, 2)), "linewidth": 1.1}
    ax.plot(x, y, **(dashed | style))
    ax.plot(np.where(solid, x, np.nan), y, label=label, **({"linewidth": 1.8} | style))
    hollow: dict[str, Any] = {"color": style["color"], "mfc": "white", "ms": 6, "ls": "none"}
    for start, (mark, _) in _MARKS.items():
        points = [point.orbit for point in curve.special_points if point.kind.startswith(start)]
        if points:
            places = np.array([np.ravel(_place(orbit, plane, side)) for orbit in points])
            ax.plot(*places.T, mark, **hollow)
    label_plane(ax, plane)


def label_plane(ax: "Axes", plane: str) -> None:
    """Names the axes; the distance from the upright state is logarithmic and grows to the left."""
    from matplotlib.ticker import MultipleLocator

    ax.set_xlabel(PLANES[plane][0])
    ax.set_ylabel(PLANES[plane][1])
    if plane == "angles":
        ax.xaxis.set_major_locator(MultipleLocator(45))
        ax.yaxis.set_major_locator(MultipleLocator(45))
    if plane == "upright":
        ax.set_xscale("log")
        if not ax.xaxis_inverted():
            ax.invert_xaxis()


def draw_legend(ax: "Axes", curves: Any) -> None:
    """The names of families with their colours, and the marks that occur."""
    from matplotlib.lines import Line2D

    handles, _ = ax.get_legend_handles_labels()
    look: dict[str, Any] = {"color": "black", "markerfacecolor": "white", "linestyle": "none"}
    kinds = [point.kind for curve in curves for point in curve.special_points]
    for start, (mark, what) in _MARKS.items():
        if any(kind.startswith(start) for kind in kinds):
            handles.append(Line2D([], [], marker=mark, label=what, **look))
    handles.append(Line2D([], [], color="black", linestyle=(0, (4, 2)), label="unstable"))
    ax.legend(handles=handles, fontsize="small", frameon=False)


def draw_atlas(ax: "Axes", atlas: Atlas, style: dict[str, Any]) -> None:
    """Draws an atlas, see `plots.atlas`."""
    table = atlas.table
    stable = table["log_abs_kappa"] <= _STABLE
    names = [one["family"] for one in atlas.families]
    if names:
        x, y = np.degrees(table["theta1"]), np.degrees(table["theta2"])
    else:
        x, y = np.degrees(table["theta2"]), table["period"]
    for i, name in enumerate(names or [""]):
        own = table["family"] == name if names else np.ones(len(atlas), bool)
        look: dict[str, Any] = {"color": COLORS[i % len(COLORS)], "linestyle": "none"}
        look |= {"marker": "o", "markersize": 4} | style
        hollow: dict[str, Any] = {"markerfacecolor": "white", "label": "unstable"}
        if names:
            hollow = {"markersize": 1.5, "label": ""}
        ax.plot(x[own & ~stable], y[own & ~stable], **(look | hollow))
        ax.plot(x[own & stable], y[own & stable], **(look | {"label": name or "stable"}))
    ax.legend(fontsize="small", frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    ax.set_xlabel("theta1 (deg)" if names else "theta2 (deg)")
    ax.set_ylabel("theta2 (deg)" if names else "period (s)")
