"""What the command line writes: files and figures of each result."""

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import dpend
from dpend.motion.trajectory import Trajectory
from dpend.places import check_place, replacing
from dpend.records import columns, json_text


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
