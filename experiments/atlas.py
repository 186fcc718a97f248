"""The atlas of the paper's pendulum: every family of orbits released from rest with a period of at
most 2 s.

It is saved beside this script as `atlas/brake_orbits.csv` and `.json` (columns and units: README.md
here). Two pictures: all families in the square of both release angles over the Lyapunov exponent of
the motions in between, and one orbit of each. Stopped and started again, the search goes on from a
store beside the catalogue, which is deleted at the end.

That nothing is missing is spoken for by counts that know nothing of families: how often the momenta
at the last time wind round zero as theta2 goes once round, which is the sum of the signs of all
returns to rest on a slice. That what is there is right, by `atlas_check.py`, which integrates every
row of the file by other means.
"""

import argparse
import tempfile
import time
from functools import partial
from pathlib import Path

import matplotlib.colors
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.patheffects import withStroke

import dpend
from dpend import chaos, plots

HERE = Path(__file__).parent
# Without its palest yellows, which would be lost on the grey.
PERIODS = matplotlib.colors.ListedColormap(
    matplotlib.colormaps["plasma"](np.linspace(0, 0.87, 256))
)
GREYS = matplotlib.colors.LinearSegmentedColormap.from_list("pale", ["#ffffff", "#c4c4c4"])
# Pixels between a name and its curve.
ROOM = 22.0


def found(max_period: float, folder: Path) -> dpend.Atlas:
    """The atlas, found and saved."""
    folder.mkdir(parents=True, exist_ok=True)
    store = folder / "brake_orbits.store.json"
    started = time.perf_counter()

    def told(done: int, planned: int, families: int) -> None:
        print(f"\r{done} of {planned} slices, {families} families", end="", flush=True)

    atlas = dpend.find_brake_families(
        dpend.Pendulum(), max_period=max_period, store=store, progress=told
    )
    print(f", {time.perf_counter() - started:.0f} s")
    for name in ("brake_orbits.csv", "brake_orbits.json"):
        atlas.save(folder / name)
    store.unlink()
    return atlas


def summary(atlas: dpend.Atlas) -> None:
    count = atlas.coverage
    print(f"{len(atlas)} orbits of {len(atlas.families)} families, T up to {atlas.max_period} s")
    print(
        f"  {count.slices} slices, {count.theta2_points} motions: {count.suspicious_cells} places "
        f"left undecided"
    )
    print(
        f"  the signs of all returns add up to {count.degree}, the momenta wind {count.winding} "
        f"times round zero"
    )
    for record in atlas.families:
        table = atlas.where(family=record["family"]).table
        stable = np.count_nonzero(np.abs(table["kappa"]) < 1)
        print(
            f"  {record['family']:3} {record['symmetry']:7} {len(table['period']):4} orbits, "
            f"{stable:3} stable, "
            f"T = {table['period'].min():.6f} to {table['period'].max():.6f} s, "
            f"kappa {table['kappa'].min():.4g} to {table['kappa'].max():.4g}, "
            f"{' to '.join(record['ends'])}"
        )
    errors = np.degrees(np.max(atlas.table["theta2_error"])), np.max(atlas.table["period_error"])
    print(f"  largest error estimates: theta2 {errors[0]:.0e} deg, T {errors[1]:.0e} s")


# --- the square -----------------------------------------------------------------------------------


def curve_of(atlas: dpend.Atlas, record: dict) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """A family's curves of releases [deg], shape (n, 2) each, and on their n - 1 pieces the period
    and the stability.

    Where stability changes, the special points cut pieces in two, so that stable windows between
    two rows are seen.
    """
    table = atlas.where(family=record["family"]).table
    changes = [point for point in record["special_points"] if point["kind"].startswith("stability")]
    places = [point["arclength"] for point in changes]
    arc = np.union1d(table["arclength"], places)

    def curve(*columns: str) -> np.ndarray:
        return np.degrees(
            np.column_stack([np.interp(arc, table["arclength"], table[key]) for key in columns])
        )

    own = curve("theta1", "theta2")
    for point in changes:
        own[np.searchsorted(arc, point["arclength"])] = point["theta1_deg"], point["theta2_deg"]
    curves = [own, -own]
    if record["symmetry"] == "brake":
        dual = curve("dual_theta1", "dual_theta2")
        curves += [dual, -dual]
    period = np.interp(0.5 * (arc[1:] + arc[:-1]), table["arclength"], table["period"])
    # Without a change the middle orbit tells: at an end that is a branch point kappa is 1 but for
    # rounding.
    always = np.median(np.abs(table["kappa"])) < 1
    stable = np.full(arc.size - 1, changes[0]["kind"] == "stability_lost" if changes else always)
    for place, point in zip(places, changes, strict=True):
        stable[arc[:-1] >= place] = point["kind"] == "stability_gained"
    return curves, period, stable


def wrapped(curve: np.ndarray) -> np.ndarray:
    """The pieces of a curve, shape (n - 1, 2, 2), each where its middle is on the square."""
    pieces = np.stack([curve[:-1], curve[1:]], axis=1)
    return pieces - 360 * np.round(np.mean(pieces, axis=1, keepdims=True) / 360)


def square(atlas: dpend.Atlas, cells: int, path: Path) -> None:
    fig, ax = plt.subplots(figsize=(9, 8.9), layout="constrained")
    angles = np.pi * (np.arange(cells) + 0.5 - cells / 2) / (cells / 2)
    field = dpend.sweep(
        partial(chaos.lyapunov, duration=10.0),
        atlas.pendulum,
        {"theta1": angles, "theta2": angles},
        tolerance=1e-6,
    )
    exponent = field.lyapunov.values.T
    shades = {"cmap": GREYS, "vmin": 0, "vmax": np.nanquantile(exponent, 0.98)}
    map_ = ax.imshow(
        exponent, origin="lower", extent=(-180, 180, -180, 180), interpolation="bilinear", **shades
    )
    norm = matplotlib.colors.Normalize(
        min(r["shortest_period_s"] for r in atlas.families), atlas.max_period
    )
    drawn = {}
    for record in atlas.families:
        curves, period, stable = curve_of(atlas, record)
        for curve in curves:
            pieces = wrapped(curve)
            for thick, colour in ((6.0, "black"), (3.6, None)):
                some = LineCollection(
                    pieces[stable], linewidths=thick, capstyle="round", zorder=2.5, color=colour
                )
                if colour is None:
                    some.set(array=period[stable], cmap=PERIODS, norm=norm, zorder=3)
                ax.add_collection(some)
            lines = LineCollection(
                pieces, linewidths=1.5, capstyle="round", cmap=PERIODS, norm=norm, zorder=3
            )
            lines.set_array(period)
            ax.add_collection(lines)
            drawn.setdefault(record["family"], []).append(pieces)
    ax.set(
        xlim=(-180, 180),
        ylim=(-180, 180),
        xlabel="theta1 (deg)",
        ylabel="theta2 (deg)",
        aspect="equal",
    )
    ax.set(xticks=range(-180, 181, 45), yticks=range(-180, 181, 45))
    fig.colorbar(lines, ax=ax, label="period (s)", pad=0.02, fraction=0.05)
    below = {"location": "bottom", "pad": 0.02, "fraction": 0.03, "aspect": 50}
    fig.colorbar(map_, ax=ax, label="Lyapunov exponent over 10 s (1/s)", extend="both", **below)
    outline = [withStroke(linewidth=6.0, foreground="black")]
    handles = [
        plt.Line2D([], [], linewidth=3.6, color=PERIODS(0.4), label="stable", path_effects=outline),
        plt.Line2D([], [], linewidth=1.5, color=PERIODS(0.4), label="unstable"),
    ]
    ax.legend(
        handles=handles,
        loc="lower center",
        bbox_to_anchor=(0.5, 1.0),
        ncols=2,
        frameon=False,
        handlelength=3,
    )
    fig.canvas.draw()
    named(ax, drawn)
    saved(fig, path)


def nearest(points: np.ndarray, others: np.ndarray, across: float) -> np.ndarray:
    """How far from each point the nearest of the others is, what is across shortened."""
    return np.min(np.linalg.norm((points[:, None] - others) * [across, 1.0], axis=-1), axis=1)


def named(ax: plt.Axes, drawn: dict[str, list[np.ndarray]]) -> None:
    """Each family's name once, where there is most room for it and its curve is far from all
    others.
    """
    pixels = {
        name: [
            ax.transData.transform(pieces.reshape(-1, 2)).reshape(-1, 2, 2).mean(axis=1)
            for pieces in curves
        ]
        for name, curves in drawn.items()
    }
    taken = np.concatenate([points for curves in pixels.values() for points in curves])
    (left, low), (right, high) = ax.transData.transform([(-180, -180), (180, 180)])
    # Short curves have the least choice.
    for name in sorted(pixels, key=lambda name: len(pixels[name][0])):
        points = pixels[name][0]
        way = np.gradient(points, axis=0)
        normal = (
            np.column_stack([-way[:, 1], way[:, 0]]) / np.maximum(np.hypot(*way.T), 1e-9)[:, None]
        )
        spots = np.concatenate([points + side * ROOM * normal for side in (-1, 1)])
        inside = np.all((spots > [left + 15, low + 10]) & (spots < [right - 15, high - 10]), axis=1)
        spots, feet = spots[inside], np.concatenate([points, points])[inside]
        others = np.concatenate(
            [points for other in pixels if other != name for points in pixels[other]]
        )
        # A name is wider than it is high.
        best = np.argmax(np.minimum(nearest(spots, taken, 0.7), nearest(feet, others, 1.0)))
        box = np.stack(np.meshgrid(np.linspace(-15, 15, 8), [-8, 0, 8]), axis=-1).reshape(-1, 2)
        taken = np.concatenate([taken, spots[best] + box])
        ax.annotate(
            name,
            ax.transData.inverted().transform(feet[best]),
            ax.transData.inverted().transform(spots[best]),
            ha="center",
            va="center",
            fontsize=11,
            fontweight="bold",
            zorder=5,
            arrowprops={"arrowstyle": "-", "linewidth": 0.9, "shrinkA": 0, "shrinkB": 0},
            path_effects=[withStroke(linewidth=3, foreground="white")],
        )


# --- one orbit of each ----------------------------------------------------------------------------


def example(atlas: dpend.Atlas, record: dict) -> dpend.PeriodicOrbit:
    """A family's orbit of the shortest period, or of the middle of its curve where that one is of
    no swing at all.

    So it is at a normal mode; at a branch point it is an orbit of another family.
    """
    family = atlas.where(family=record["family"])
    ends = set(record["ends"]) & {"normal mode", "branch point"}
    arc = family.table["arclength"]
    i = np.argmin(np.abs(arc - 0.5 * arc[-1])) if ends else np.argmin(family.table["period"])
    return family.orbits[int(i)]


def panel(ax: plt.Axes, name: str, orbit: dpend.PeriodicOrbit) -> None:
    pendulum, period = orbit.pendulum, float(orbit.period)
    motion = dpend.simulate(
        pendulum, orbit.state, period, step=period / 1200, method="rk8", save_every=2, error=False
    )
    for rest, style in ((orbit.state, "-"), (orbit.dual, "--")):
        x1, y1, x2, y2 = (float(value) for value in dpend.positions(pendulum, rest))
        ax.plot([0, x1, x2], [0, y1, y2], style, color=plots.NEUTRAL, linewidth=1.1, alpha=0.55)
        ax.plot([x1, x2], [y1, y2], "o", color=plots.NEUTRAL, markersize=4, alpha=0.55)
    places = dpend.positions(pendulum, motion.state)
    ax.plot(places.x2, places.y2, color=plots.LOWER, linewidth=1.5)
    ax.plot(0, 0, "s", color="black", markersize=3.5)
    reach = 1.06 * float(pendulum.l1 + pendulum.l2)
    ax.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", xticks=[], yticks=[])
    ax.spines[:].set_color("#cccccc")
    angles = np.degrees([orbit.theta1, orbit.theta2])
    ax.set_title(
        f"{name}   T = {period:.4f} s\n({angles[0]:.2f}, {angles[1]:.2f}) deg\n{orbit.stability}",
        fontsize=9,
    )


def sheet(atlas: dpend.Atlas, path: Path) -> None:
    groups = {
        kind: [record for record in atlas.families if record["symmetry"] == kind]
        for kind in ("centred", "brake")
    }
    groups = {kind: records for kind, records in groups.items() if records}
    rows = {kind: -(-len(records) // 4) for kind, records in groups.items()}
    fig = plt.figure(figsize=(9, 2.85 * sum(rows.values()) + 0.4 * len(rows)), layout="constrained")
    parts = np.atleast_1d(fig.subfigures(len(groups), 1, height_ratios=list(rows.values())))
    fig.get_layout_engine().set(h_pad=0.08)
    told = {
        "centred": "Centred: both rods vertical at T/4",
        "brake": "Brake: at rest at T/2, never vertical together",
    }
    for part, (kind, records) in zip(parts, groups.items(), strict=True):
        part.suptitle(told[kind], fontsize=11, fontweight="bold")
        axes = part.subplots(rows[kind], 4, squeeze=False).ravel()
        for ax, record in zip(axes, records, strict=False):
            panel(ax, record["family"], example(atlas, record))
        for ax in axes[len(records) :]:
            ax.axis("off")
    parts[-1].supxlabel(
        "path of the lower bob over one period; rods at the release (solid) and at the other rest "
        "(dashed)",
        fontsize=9,
    )
    saved(fig, path)


def saved(fig: plt.Figure, path: Path) -> None:
    from PIL import Image

    fig.savefig(path, dpi=100)
    # The picture is committed: a palette keeps it under 300 kB.
    Image.open(path).convert("RGB").quantize(256).save(path, optimize=True)
    print(f"drawn in {path.name}, {path.stat().st_size // 1000} kB")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="up to 1.2 s, on a coarse map")
    parser.add_argument(
        "--out",
        type=Path,
        help="where atlas/ and figures/ go; by default beside the script, if --quick a new "
        "directory",
    )
    options = parser.parse_args()
    plt.switch_backend("Agg")
    out = options.out or (Path(tempfile.mkdtemp()) if options.quick else HERE)
    (out / "figures").mkdir(parents=True, exist_ok=True)
    atlas = found(1.2 if options.quick else 2.0, out / "atlas")
    summary(atlas)
    square(atlas, 40 if options.quick else 200, out / "figures" / "atlas.png")
    sheet(atlas, out / "figures" / "atlas_sheet.png")
    print(f"all in {out}" if out != HERE else "")


if __name__ == "__main__":
    main()
