"""A map in colours: its scale, its axes, and the line inside which nothing can flip."""

import contextlib
import json
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# What a map's colour bar says, and whether its values span decades.
LABELS = {
    "lyapunov": ("Lyapunov exponent (1/s)", False),
    "exponent": ("Lyapunov exponent (1/s)", False),
    "megno": ("time-averaged MEGNO", False),
    "flip_time": ("time of the first flip (s)", True),
    "energy_drift": ("energy drift (of its scale)", True),
}
# Colours lie between these quantiles of a map's values.
_QUANTILES = (0.005, 0.995)
# Cells along a picture's side. Of larger maps every n-th cell is drawn: a screen shows no more.
_MOST_CELLS = 1500


def draw_map(ax: "Axes", dataset: Any, name: str, style: dict[str, Any]) -> None:
    """Draws the value `name` of a two-dimensional sweep, see `plots.map_of`."""
    field = dataset[name]
    every = -(-max(field.shape) // _MOST_CELLS)
    dataset = dataset.isel({dim: slice(None, None, every) for dim in field.dims})
    across, up = dataset[name].dims
    x, y = (_values_of(dataset, key) for key in (across, up))
    values, label, norm = _colours_of(dataset[name], name)
    if "norm" not in style:
        norm.vmin, norm.vmax = style.pop("vmin", norm.vmin), style.pop("vmax", norm.vmax)
    look = {"norm": norm, "cmap": "viridis", "shading": "nearest", "rasterized": True} | style
    mesh = ax.pcolormesh(x, y, values, **look)
    assert ax.figure is not None
    # In axes that hang on the map's own: as high as the map, whatever its shape.
    beside = ax.inset_axes((1.03, 0.0, 0.045, 1.0))
    ax.figure.colorbar(mesh, cax=beside, label=label, extend="both", extendfrac=0.03)
    ax.set_title(_title_of(dataset), fontsize="small", loc="left")
    _label_axis(ax.xaxis, dataset, across)
    _label_axis(ax.yaxis, dataset, up)
    if {across, up} == {"theta1", "theta2"}:
        if name == "flip_time":
            _draw_flip_bound(dataset, ax, across)
        ax.set_aspect("equal")


def _title_of(dataset: Any) -> str:
    """The duration, if the quantity has one, and the pendulum."""
    at = dataset.attrs
    told = []
    # A quantity need have no duration, and a dataset made by hand no settings.
    with contextlib.suppress(KeyError, IndexError, TypeError, ValueError):
        told.append(f"{json.loads(at['quantity_settings'])[1]['duration']:g} s")
    units = {"l1": "m", "l2": "m", "m1": "kg", "m2": "kg", "g": "m/s$^2$"}
    told += [f"{key} = {at[key]:g} {unit}" for key, unit in units.items() if key in at]
    return ", ".join(told)


def _colours_of(field: Any, name: str) -> tuple[np.ndarray, str, Any]:
    """The values to draw, upwards along the first axis, what the colour bar says, and its scale.

    The scale goes from one quantile to another: a few extreme cells would leave no colour to the
    others.
    """
    from matplotlib.colors import LogNorm, Normalize

    label, decades = LABELS.get(name.removesuffix("_error"), (name, False))
    if name.endswith("_error"):
        label, decades = f"error: {label}", True
    values = np.asarray(field.values, np.float64).T
    values = np.where(np.isfinite(values), values, np.nan)
    spread = values[np.isfinite(values) & ((values > 0) | (not decades))]
    low, high = np.quantile(spread, _QUANTILES) if spread.size else (0.1, 1.0)
    norm = (LogNorm if decades else Normalize)(low, max(high, low + 0.01 * abs(low)))
    return np.where(decades & (values <= 0), low, values), label, norm


def _label_axis(axis: Any, dataset: Any, key: str) -> None:
    """An axis's name and unit; a wide angle has its marks at parts of a full turn."""
    from matplotlib.ticker import MultipleLocator

    if not key.startswith("theta"):
        axis.set_label_text(f"{key} ({dataset[key].attrs.get('units', '')})")
        return
    axis.set_label_text(f"{key} (deg)")
    span = np.ptp(_values_of(dataset, key))
    if span > 180:
        axis.set_major_locator(MultipleLocator(90 if span > 270 else 45))


def _values_of(dataset: Any, key: str) -> np.ndarray:
    """A coordinate as it is drawn: angles in degrees."""
    values = np.asarray(dataset[key].values)
    return np.degrees(values) if key.startswith("theta") else values


def _draw_flip_bound(dataset: Any, ax: "Axes", across: str) -> None:
    """Draws the line inside which no release from rest has the energy to flip: it lies below both
    saddles, in which one rod points upwards.
    """
    at = dataset.attrs
    if at.get("at_p1") or at.get("at_p2") or not at["g"] > 0:
        return
    weight1, weight2 = (at["m1"] + at["m2"]) * at["l1"], at["m2"] * at["l2"]
    theta1, theta2 = (_values_of(dataset, key) for key in ("theta1", "theta2"))
    height = (
        -weight1 * np.cos(np.radians(theta1))[:, None]
        - weight2 * np.cos(np.radians(theta2))[None, :]
    )
    saddle = -abs(weight1 - weight2)
    arguments = (theta1, theta2, height.T) if across == "theta1" else (theta2, theta1, height)
    ax.contour(*arguments, levels=[saddle], colors="black", linewidths=1.0)
