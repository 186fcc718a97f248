"""What the command line prints and writes: records, tables, files and figures of each result."""

import csv
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

import dpend
from dpend.catalogue.files import pendulum_record
from dpend.checks import check_place
from dpend.mechanics.pendulum import Pendulum
from dpend.motion.simulate import Trajectory
from dpend.orbits.orbit import PeriodicOrbit
from dpend.records import json_text, replacing
from dpend.status import Status

if TYPE_CHECKING:
    from rich.table import Table


def on_terminal() -> bool:
    return sys.stderr is not None and sys.stderr.isatty()


def orbit_record(orbit: PeriodicOrbit) -> dict[str, Any]:
    angle_error, period_error = orbit.error_estimate
    status = Status(int(orbit.status))
    return {
        "theta1_deg": _degrees(orbit.theta1),
        "theta2_deg": _degrees(orbit.theta2),
        "period_s": float(orbit.period),
        "energy_J": float(orbit.energy),
        "residual": float(orbit.residual),
        "iterations": int(orbit.iterations),
        "status": status.name.lower(),
        "message": dpend.message(status),
        "symmetry": orbit.symmetry,
        "kappa": float(orbit.kappa),
        "log_abs_kappa": float(orbit.log_abs_kappa),
        "stability": orbit.stability,
        "dual": {
            "theta1_deg": _degrees(orbit.dual.theta1),
            "theta2_deg": _degrees(orbit.dual.theta2),
        },
        "turns": [int(turn) for turn in orbit.turns],
        "error_estimate": {"theta2_deg": _degrees(angle_error), "period_s": float(period_error)},
        "pendulum": pendulum_record(orbit.pendulum),
    }


def family_record(family: dpend.Family, branch: str) -> dict[str, Any]:
    orbits, status = family.orbits, Status(int(family.status))
    columns = {
        "arclength": family.arclength,
        "theta1_deg": np.degrees(orbits.theta1),
        "theta2_deg": np.degrees(orbits.theta2),
        "period_s": orbits.period,
        "energy_J": orbits.energy,
        "kappa": orbits.kappa,
        "log_abs_kappa": orbits.log_abs_kappa,
        "theta2_error_deg": np.degrees(orbits.error_estimate[0]),
        "period_error_s": orbits.error_estimate[1],
    }
    rows = zip(*(np.asarray(column).tolist() for column in columns.values()), strict=True)
    return {
        "branch": branch,
        "points": [
            dict(zip(columns, row, strict=True)) | {"symmetry": family.symmetry} for row in rows
        ],
        "bifurcations": [
            {
                "kind": point.kind,
                "arclength": float(point.arclength),
                "theta1_deg": _degrees(point.orbit.theta1),
                "theta2_deg": _degrees(point.orbit.theta2),
                "period_s": float(point.orbit.period),
                "energy_J": float(point.orbit.energy),
                "kappa": float(point.orbit.kappa),
            }
            for point in family.special_points
        ],
        "ends": list(family.ends),
        "status": status.name.lower(),
        "message": family.message,
        "pendulum": pendulum_record(
            Pendulum(*(leaf[0] for leaf in jax.tree.leaves(orbits.pendulum)))
        ),
    }


def motion_record(motion: Trajectory) -> dict[str, Any]:
    status = Status(int(motion.status))
    assert motion.scheme is not None
    return {
        "final": {
            "theta1_deg": _degrees(motion.state.theta1[-1]),
            "theta2_deg": _degrees(motion.state.theta2[-1]),
            "p1": float(motion.state.p1[-1]),
            "p2": float(motion.state.p2[-1]),
        },
        "duration_s": float(motion.time[-1]),
        "energy_drift": float(motion.energy_drift),
        "error_estimate": float(motion.error_estimate),
        "steps": int(motion.steps),
        "method": motion.scheme.name,
        "step_s": abs(float(motion.time[-1])) / int(motion.steps),
        "status": status.name.lower(),
        "tolerance": float(motion.tolerance),
        "message": motion.message,
    }


def design_record(
    found: dpend.Design, start: Pendulum, branches: tuple[str, ...], equations: tuple[str, ...]
) -> dict[str, Any]:
    status = Status(int(found.status))
    units = {
        "theta2_deg": ("theta2", math.degrees(1.0)),
        "period_s": ("period", 1.0),
        "kappa": ("kappa", 1.0),
    }
    orbits = []
    for i, (name, orbit) in enumerate(zip(branches, found.orbits, strict=True)):
        slopes = {
            key: {
                parameter: unit * float(np.atleast_1d(row)[i])
                for parameter, row in found.sensitivities[of].items()
            }
            for key, (of, unit) in units.items()
        }
        orbits.append(orbit_record(orbit) | {"branch": name, "sensitivities": slopes})
    return {
        "pendulum": pendulum_record(found.pendulum),
        "orbits": orbits,
        "missed": dict(zip(equations, np.atleast_1d(found.loss).tolist(), strict=True)),
        "distance": float(found.distance),
        "at_bounds": list(found.at_bounds),
        "iterations": int(found.iterations),
        "looks": int(found.looks),
        "status": status.name.lower(),
        "message": found.message,
        "start": pendulum_record(start),
    }


# How an estimate is shown: its name with its unit, and what it is multiplied by.
_SHOWN = {
    "l1": ("l1_m", 1.0),
    "l2": ("l2_m", 1.0),
    "m1": ("m1_kg", 1.0),
    "m2": ("m2_kg", 1.0),
    "g": ("g_m_s2", 1.0),
    "l2/l1": ("l2/l1", 1.0),
    "m2/m1": ("m2/m1", 1.0),
    "g/l1": ("g/l1_s-2", 1.0),
    "theta1": ("theta1_deg", math.degrees(1.0)),
    "theta2": ("theta2_deg", math.degrees(1.0)),
    "omega1": ("omega1_deg_s", math.degrees(1.0)),
    "omega2": ("omega2_deg_s", math.degrees(1.0)),
}


def fit_record(fit: dpend.Fit) -> dict[str, Any]:
    status = Status(int(fit.status))
    measured = np.sum(np.isfinite(fit.residual1)) + np.sum(np.isfinite(fit.residual2))

    def shown(values: dict[str, Any]) -> dict[str, float]:
        return {_SHOWN[name][0]: _SHOWN[name][1] * float(value) for name, value in values.items()}

    return {
        "estimates": shown(fit.estimates),
        "standard_errors": shown(fit.standard_errors),
        "free": list(fit.free),
        "noise_deg": _degrees(fit.noise),
        "expected_noise_deg": _degrees(fit.expected_noise),
        "angles": int(measured),
        "duration_s": float(fit.time[-1] - fit.time[0]),
        "windows": int(fit.windows),
        "iterations": int(fit.iterations),
        "gap": float(fit.gap),
        "error_estimate": float(fit.error_estimate),
        "status": status.name.lower(),
        "message": dpend.message(status),
        "pendulum": pendulum_record(fit.pendulum),
    }


def _degrees(radians: Any) -> float:
    return math.degrees(float(radians))


def print_json(record: dict[str, Any]) -> None:
    print(json_text(record))


# Wider than any table here: a number is never broken to fit a terminal.
_TABLE_WIDTH = 200


def _print_table(table: "Table") -> None:
    from rich.console import Console

    console = Console(width=_TABLE_WIDTH, highlight=False)
    with console.capture() as text:
        console.print(table)
    print(text.get(), end="")


def print_orbits(pendulum: Pendulum, found: dict[str | None, PeriodicOrbit]) -> None:
    from rich.table import Table

    table = Table(title=_described(pendulum), title_justify="left", title_style="")
    for heading in (
        "",
        "theta1 (deg)",
        "theta2 (deg)",
        "period (s)",
        "stability",
        "kappa",
        "error (deg, s)",
    ):
        table.add_column(heading, justify="left" if heading in ("", "stability") else "right")
    failures = []
    for name, orbit in found.items():
        record = orbit_record(orbit)
        error = record["error_estimate"]
        table.add_row(
            name or record["symmetry"],
            f"{record['theta1_deg']:.10g}",
            f"{record['theta2_deg']:.9f}",
            f"{record['period_s']:.11f}",
            record["stability"],
            f"{record['kappa']:.6g}",
            f"{error['theta2_deg']:.0e}, {error['period_s']:.0e}",
        )
        if record["status"] != "converged":
            failures.append(f"{name or 'guess'}: {record['status']}: {record['message']}")
    _print_table(table)
    for failure in failures:
        print(failure)


# Rows of the table that stand for a family.
_SHOWN_POINTS = 12


def print_family(family: dpend.Family, record: dict[str, Any], out: Path | None) -> None:
    from rich.table import Table

    pendulum = Pendulum(*record["pendulum"].values())
    table = Table(title=_described(pendulum), title_justify="left", title_style="")
    headings = (
        "theta1 (deg)",
        "theta2 (deg)",
        "period (s)",
        "energy (J)",
        "stability",
        "log |kappa|",
        "",
    )
    for heading in headings:
        table.add_column(heading, justify="left" if heading in ("", "stability") else "right")
    points = record["points"]
    chosen = np.unique(np.linspace(0, len(points) - 1, _SHOWN_POINTS).round().astype(int))
    rows = [points[i] | {"kind": ""} for i in chosen]
    for special in record["bifurcations"]:
        logarithm = math.log(max(abs(special["kappa"]), sys.float_info.min))
        rows.append(special | {"log_abs_kappa": logarithm})
    for row in sorted(rows, key=lambda row: row["arclength"]):
        marginal = row["kind"].startswith("stability")
        table.add_row(
            f"{row['theta1_deg']:.9f}",
            f"{row['theta2_deg']:.9f}",
            f"{row['period_s']:.10f}",
            f"{row['energy_J']:.9f}",
            "" if marginal else dpend.stability_class(row["kappa"]),
            "0" if marginal else f"{row['log_abs_kappa']:.5g}",
            row["kind"],
        )
    _print_table(table)
    worst = max(point["theta2_error_deg"] for point in points)
    print(
        f"{len(points)} orbits from {family.ends[0]} to {family.ends[1]}; error of theta2 at most "
        f"{worst:.0e} deg"
    )
    if int(family.status) != Status.CONVERGED:
        print(f"{record['status']}: {record['message']}")
    if out is not None:
        print(f"written to {out}")


def print_atlas(atlas: dpend.Atlas, theta1: float | None, out: Path | None) -> None:
    from rich.table import Table

    table = Table(title=_described(atlas.pendulum), title_justify="left", title_style="")
    headings: tuple[str, ...] = ("family", "periods (s)", "from", "to", "orbits")
    rows = [_family_row(atlas, one) for one in atlas.families]
    what = f"{len(atlas.families)} families with {len(atlas)} orbits in the table"
    if theta1 is not None:
        headings = (
            "theta2 (deg)",
            "period (s)",
            "symmetry",
            "stability",
            "kappa",
            "dual (deg)",
            "error (deg)",
        )
        rows = [_atlas_row(orbit) for orbit in atlas.orbits]
        what = f"{len(atlas)} orbits with theta1 = {theta1:g} deg"
    for heading in headings:
        table.add_column(heading, justify="left" if heading in _WORDS else "right")
    for row in rows:
        table.add_row(*row)
    _print_table(table)
    seen = atlas.coverage
    print(f"{what} and periods of at most {atlas.max_period:g} s", end="; ")
    print(
        f"{seen.slices} slice{'s' * (seen.slices > 1)}, {seen.theta2_points} motions, "
        f"{seen.time_points} times"
    )
    agree = "agree" if seen.degree == seen.winding else "DISAGREE: a return is missing"
    if seen.exhausted:
        print(
            "STOPPED at the most time steps allowed: more is likely to be missing; raise "
            "--most-steps"
        )
    print(
        f"{seen.suspicious_cells} suspicious cells; the signs of all returns and the winding "
        f"number {agree}"
    )
    if out is not None:
        print(f"written to {out}")


_WORDS = ("symmetry", "stability", "family", "from", "to")


def _atlas_row(orbit: PeriodicOrbit) -> list[str]:
    dual = f"{_degrees(orbit.dual.theta1):.4f}, {_degrees(orbit.dual.theta2):.4f}"
    return [
        f"{_degrees(orbit.theta2):.9f}",
        f"{float(orbit.period):.9f}",
        orbit.symmetry,
        orbit.stability,
        f"{float(orbit.kappa):.6g}",
        dual,
        f"{_degrees(orbit.error_estimate[0]):.0e}",
    ]


def _family_row(atlas: dpend.Atlas, record: dict[str, Any]) -> list[str]:
    count = int(np.sum(atlas.table["family"] == record["family"]))
    periods = f"{record['shortest_period_s']:.6f} - {record['longest_period_s']:.6f}"
    return [record["family"], periods, *record["ends"], str(count)]


def print_fit(record: dict[str, Any], figure: Path | None) -> None:
    errors = record["standard_errors"]
    for name, value in record["estimates"].items():
        error = errors[name]
        known = (
            "held" if error == 0 else "not determined" if error == math.inf else f"+- {error:.2g}"
        )
        print(f"{name:14}{value:16.{_decimals(error)}f}  {known}")
    print(
        f"{record['angles']} angles over {record['duration_s']:g} s; noise "
        f"{record['noise_deg']:.3g} deg",
        end="",
    )
    print(f", of which {record['expected_noise_deg']:.3g} deg was expected")
    if record["status"] != "converged":
        print(f"{record['status']}: {record['message']}")
    if figure is not None:
        print(f"drawn in {figure}")


def _decimals(error: float) -> int:
    """As many as show two digits of the error, and six where there is none."""
    return 6 if not 0 < error < math.inf else min(max(1 - math.floor(math.log10(error)), 0), 12)


def _described(pendulum: Pendulum) -> str:
    l1, l2, m1, m2, g = (f"{float(value):g}" for value in jax.tree.leaves(pendulum))
    bobs = f"l1 = {l1} m, l2 = {l2} m, m1 = {m1} kg, m2 = {m2} kg"
    return f"{bobs}, g = {g} m/s^2, released from rest"


def print_design(
    found: dpend.Design, record: dict[str, Any], start: Pendulum, theta1: float
) -> None:
    from rich.table import Table

    branches = (orbit["branch"] for orbit in record["orbits"])
    print_orbits(found.pendulum, dict(zip(branches, found.orbits, strict=True)))
    table = Table(
        title="derivatives with respect to the logarithms", title_justify="left", title_style=""
    )
    table.add_column("")
    for heading in ("start", "found"):
        table.add_column(heading, justify="right")
    for orbit in record["orbits"]:
        for heading in ("period (s)", "kappa", "theta2 (deg)"):
            table.add_column(f"{orbit['branch']}\n{heading}", justify="right")
    units = {"l1": "m", "l2": "m", "m1": "kg", "m2": "kg", "g": "m/s^2", "theta1": "deg"}
    angle = record["orbits"][0]["theta1_deg"]
    values = [*jax.tree.leaves(start), theta1], [*jax.tree.leaves(found.pendulum), angle]
    for (name, unit), before, after in zip(units.items(), *values, strict=True):
        slopes = [
            orbit["sensitivities"][key][name] for orbit in record["orbits"] for key in _SLOPES
        ]
        row = [f"{float(before):g}", f"{float(after):.10g}", *(f"{slope:.6g}" for slope in slopes)]
        table.add_row(f"{name} ({unit})", *row)
    _print_table(table)
    missed = ", ".join(f"{name} {value:.0e}" for name, value in record["missed"].items())
    print(
        f"{record['iterations']} steps, {record['looks']} solves; misses {missed}; logarithms "
        f"changed by",
        end=" ",
    )
    print(
        f"{record['distance']:.6g}"
        + (f"; at bounds: {', '.join(found.at_bounds)}" if found.at_bounds else "")
    )
    if record["status"] != "converged":
        print(f"{record['status']}: {record['message']}")


_SLOPES = ("period_s", "kappa", "theta2_deg")


def print_motion(record: dict[str, Any], motion: Trajectory, out: Path | None) -> None:
    final = record["final"]
    angles = f"theta1 = {final['theta1_deg']:.9f} deg, theta2 = {final['theta2_deg']:.9f} deg"
    print(f"after {record['duration_s']:g} s   {angles}")
    print(f"                p1 = {final['p1']:.12g}, p2 = {final['p2']:.12g} kg m^2/s")
    print(
        f"error estimate  {record['error_estimate']:.1e} rad, energy drift "
        f"{record['energy_drift']:.1e} of its scale"
    )
    print(
        f"integrated by   {record['method']}, {record['steps']} steps of {record['step_s']:.4g} s"
    )
    if record["status"] != "converged":
        print(f"{record['status']}: {record['message']}")
    if out is not None:
        print(f"written to      {out}: {motion.time.size} times")


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
    state = motion.state
    columns = (motion.time, np.degrees(state.theta1), np.degrees(state.theta2), state.p1, state.p2)
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["time_s", "theta1_deg", "theta2_deg", "p1_kg_m2_s", "p2_kg_m2_s"])
        rows.writerows(zip(*(np.asarray(column).tolist() for column in columns), strict=True))


def write_family_csv(record: dict[str, Any], path: Path) -> None:
    with path.open("w", newline="") as file:
        rows = csv.DictWriter(file, record["points"][0])
        rows.writeheader()
        rows.writerows(record["points"])


def write_json(record: dict[str, Any], path: Path) -> None:
    path.write_text(json_text(record) + "\n")


def _write_netcdf(motion: Trajectory, path: Path) -> None:
    motion.to_xarray().to_netcdf(path, engine="scipy")


def draw(field: Any, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from dpend import plots

    names = [name for name in field.data_vars if name not in ("steps", "status", "bob")]
    names = [name for name in names if name != "bob_error"]
    fig, axes = plt.subplots(
        1, len(names), figsize=(5.6 * len(names), 4.6), layout="constrained", squeeze=False
    )
    for name, ax in zip(names, axes[0], strict=True):
        plots.map_of(field, name, ax)
    with replacing(path) as draft:
        fig.savefig(draft, dpi=200)
    plt.close(fig)


def draw_fit(fit: dpend.Fit, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from dpend import plots

    fig = plots.residuals(fit)
    with replacing(path) as draft:
        fig.savefig(draft, dpi=150)
    plt.close(fig)
