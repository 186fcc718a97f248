"""A motion as a stroboscope sees it: some poses of the rods, over the fading path of a bob."""

from typing import TYPE_CHECKING, Any

import numpy as np

from dpend.mechanics.pendulum import Pendulum, State, positions

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito's palette, told apart by the colour-blind: the upper rod and bob, and the lower.
UPPER, LOWER, NEUTRAL = "#0072B2", "#D55E00", "#555555"
# The same palette for many motions or families; its yellow is too pale for a line on white.
COLORS = (UPPER, LOWER, "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
# Poses of a stroboscopic picture: enough to see the speed, few enough to see each.
POSES = 15
# How strong the first pose and the beginning of the path are drawn, beside 1 for the last.
_FAINTEST = 0.15


def joints_of(pendulum: Pendulum, state: State) -> np.ndarray:
    """Pivot and both bobs [m], shape (times, 3, 2)."""
    x1, y1, x2, y2 = (np.asarray(leaf) for leaf in positions(pendulum, state))
    still = np.zeros_like(x1)
    return np.stack([np.stack([still, x1, x2], 1), np.stack([still, y1, y2], 1)], 2)


def pick_poses(count: int, poses: int = POSES) -> np.ndarray:
    """Which of `count` times are shown: at most so many, evenly spaced, the first and the last
    among them.
    """
    return np.unique(np.linspace(0, count - 1, min(poses, count)).round().astype(int))


def strength(count: int) -> np.ndarray:
    """How strong each of `count` poses is drawn, the last one fully."""
    return np.linspace(1.0, _FAINTEST, count)[::-1] if count > 1 else np.ones(1)


def draw_trail(ax: "Axes", way: np.ndarray, color: Any, width: float = 1.0) -> None:
    """A path [m], shape (times, 2), that fades into the past."""
    from matplotlib.collections import LineCollection

    pieces = np.stack([way[:-1], way[1:]], axis=1)
    fade = 0.6 * strength(len(pieces)) if len(pieces) else None
    ax.add_collection(
        LineCollection(list(pieces), colors=color, alpha=fade, linewidths=width, zorder=1)
    )
    ax.update_datalim(way)
    ax.autoscale_view()


def draw_pivot(ax: "Axes", size: float = 5.0) -> None:
    """The pivot: a black triangle that stands on it, unlike a bob."""
    ax.plot(0, 0, marker="v", color="black", markersize=size, zorder=6)


def draw_strobe(
    ax: "Axes", joints: np.ndarray, chosen: np.ndarray, colors: tuple[Any, Any], style: Any
) -> None:
    """The poses `chosen` of `joints`, later ones darker, over the path of the lower bob.

    Arguments:
        colors: of the upper rod and bob, and of the lower.
        style: keywords for the lines of the rods.
    """
    draw_trail(ax, joints[: chosen[-1] + 1, 2], colors[1])
    for where, fade in zip(joints[chosen], strength(len(chosen)), strict=True):
        for color, (x, y) in zip(colors, (where[:2].T, where[1:].T), strict=True):
            look = {"color": color, "alpha": fade, "linewidth": 1.2} | style
            ax.plot(x, y, **look)
            ax.plot(x[1], y[1], "o", color=color, alpha=fade, markersize=4)
    draw_pivot(ax)


def legend_above(ax: "Axes", columns: int) -> None:
    """A legend in room of its own above the curves, which fill the axes from side to side."""
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + 0.25 * (high - low))
    ax.legend(frameon=False, fontsize="small", loc="upper center", ncols=columns)


def line_style(given: dict[str, Any], **default: Any) -> dict[str, Any]:
    """The keywords for a line: the short names of matplotlib (`c`, `lw`) count, too."""
    from matplotlib import cbook
    from matplotlib.lines import Line2D

    return default | cbook.normalize_kwargs(given, Line2D)
