"""What the command line writes: files and figures of each result."""

import csv
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import dpend
from dpend.motion.trajectory import Trajectory
from dpend.places import check_place, replacing
from dpend.records import columns, json_text
from dpend.status import Status
from dpend.terminal import bar, on_terminal

# What a picture is written as: pixels, or curves and letters.
_FIGURES = (".png", ".pdf", ".svg")
# What a family is drawn in.
_PLANES = ("angles", "period", "upright")


def writer(path: Path) -> Callable[[Trajectory], None]:
    """How to write a motion to `path`; refuses before anything is computed what could not be
    written after.
    """
    formats = {".csv": _write_csv, ".nc": _write_netcdf}
    check_place("out", path, tuple(formats))

    def write(motion: Trajectory) -> None:
        with replacing(path) as draft:
            formats[path.suffix](motion, draft)

    return write


def _write_csv(motion: Trajectory, path: Path) -> None:
    table = columns(motion, "time") | columns(motion.state)
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(table)
        rows.writerows(zip(*table.values(), strict=True))


def write_family_csv(found: dict[str, Any], path: Path) -> None:
    with path.open("w", newline="") as file:
        rows = csv.DictWriter(file, found["points"][0])
        rows.writeheader()
        rows.writerows(found["points"])


def write_json(found: dict[str, Any], path: Path) -> None:
    path.write_text(json_text(found) + "\n")


def _write_netcdf(motion: Trajectory, path: Path) -> None:
    motion.to_xarray().to_netcdf(path, engine="scipy")


def check_figure(path: Path | None) -> None:
    """Refuses, before anything is computed, a picture that could not be written after."""
    if path is not None:
        check_place("figure", path, _FIGURES)


def check_film(path: Path | None, both: bool) -> None:
    """The same of the film of an orbit, of which there must be one."""
    if path is None:
        return
    from dpend import animate

    if both:
        raise ValueError(f"film must be of one orbit, got {path} for two: give --branch")
    check_place("film", path, (".gif", ".mp4"))
    animate.check_out(path)


def film_orbit(orbit: dpend.PeriodicOrbit, path: Path | None) -> Path | None:
    """One period of an orbit, if it was found; the path, if it was written."""
    from dpend import animate

    if path is None or orbit.status != Status.CONVERGED:
        return None
    with bar(on_terminal(), "frames") as show:
        animate.film_orbit(orbit, path, progress=show)
    return path


def draw_orbits(orbits: dict[Any, dpend.PeriodicOrbit], path: Path | None) -> Path | None:
    """Those of the orbits that were found, a row each; the path, if there are any."""
    from dpend import plots

    found = {
        name or orbit.symmetry: orbit
        for name, orbit in orbits.items()
        if orbit.status == Status.CONVERGED
    }
    if path is None or not found:
        return None
    _save_figure(lambda: plots.orbit_sheet(found), path, dpi=150)
    return path


def draw_family(family: dpend.Family, path: Path | None) -> None:
    """The family in the plane of its release angles, and its period in two."""
    if path is not None:
        panels = [partial(_panel, "families", {"family": family}, plane=p) for p in _PLANES]
        _save_figure(lambda: _row_of(panels), path, dpi=150)


def draw_atlas(atlas: dpend.Atlas, path: Path | None) -> None:
    if path is not None:
        _save_figure(lambda: _row_of([partial(_panel, "atlas", atlas)]), path, dpi=150)


def draw_motion(pendulum: dpend.Pendulum, motion: Trajectory, path: Path | None) -> None:
    """The rods, the path, the angles and the energies of a motion."""
    if path is None:
        return
    panels = [
        partial(_panel, "strobe", pendulum, motion),
        partial(_panel, "path", motion),
        partial(_panel, "angles", motion),
        partial(_panel, "energy", pendulum, motion),
    ]
    _save_figure(lambda: _row_of(panels), path, dpi=150)


def _panel(name: str, *what: Any, ax: Any, **style: Any) -> None:
    from dpend import plots

    getattr(plots, name)(*what, ax=ax, **style)


def _row_of(panels: Sequence[Callable[..., None]]) -> Any:
    import matplotlib.pyplot as plt

    size = (max(6.4, 4.4 * len(panels)), 4.2)
    fig, axes = plt.subplots(1, len(panels), figsize=size, layout="constrained", squeeze=False)
    for panel, ax in zip(panels, axes[0], strict=True):
        panel(ax=ax)
    return fig


def draw(field: Any, path: Path) -> None:
    names = [
        name for name in field.data_vars if name not in ("steps", "status", "bob", "bob_error")
    ]

    def picture() -> Any:
        import matplotlib.pyplot as plt

        from dpend import plots

        size = (5.6 * len(names), 4.6)
        fig, axes = plt.subplots(1, len(names), figsize=size, layout="constrained", squeeze=False)
        for name, ax in zip(names, axes[0], strict=True):
            plots.map_of(field, name, ax)
        return fig

    _save_figure(picture, path, dpi=200)


def draw_section(found: Any, orbits: list[Any], path: Path) -> None:
    """A section, with the periodic orbits of each number of returns."""

    def picture() -> Any:
        import matplotlib.pyplot as plt

        from dpend import plots

        fig, ax = plt.subplots(figsize=(6.4, 5.2), layout="constrained")
        plots.section(found, ax, periodic=orbits)
        return fig

    _save_figure(picture, path, dpi=200)


def draw_fit(fit: dpend.Fit, path: Path) -> None:
    from dpend import plots

    _save_figure(lambda: plots.residuals(fit), path, dpi=150)


def _save_figure(picture: Callable[[], Any], path: Path, dpi: int) -> None:
    """Draws without a window, whatever the machine has."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    fig = picture()
    with replacing(path) as draft:
        fig.savefig(draft, dpi=dpi)
    plt.close(fig)
