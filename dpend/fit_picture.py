"""A fit over its data, and what is left."""

from typing import TYPE_CHECKING

import numpy as np

from dpend.inverse.estimates import Fit
from dpend.motion_picture import LOWER, NEUTRAL, UPPER, legend_above

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw_residuals(fit: Fit) -> "Figure":
    """Draws a fit, see `plots.residuals`."""
    import matplotlib.pyplot as plt

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
    legend_above(grid[0], columns=2)
    return fig
