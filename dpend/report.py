"""What the command line prints and writes: records, tables, files and figures of each result."""

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

import dpend
from dpend.mechanics.pendulum import Pendulum
from dpend.motion.trajectory import Trajectory
from dpend.orbits.arc import RELEASED_SYMMETRIES
from dpend.orbits.files import orbit_record
from dpend.records import json_text, record
from dpend.status import Status
from dpend.tables import print_table

# Rows of the table that stand for a family.
_SHOWN_POINTS = 12
# What a design tells the derivatives of: its name, and what it is multiplied by.
_SLOPES = {
    "theta2_deg": ("theta2", math.degrees(1.0)),
    "period_s": ("period", 1.0),
    "kappa": ("kappa", 1.0),
}
# The same as columns of the table, with their headings.
_SLOPE_HEADINGS = {"period_s": "period (s)", "kappa": "kappa", "theta2_deg": "theta2 (deg)"}


def motion_record(motion: Trajectory) -> dict[str, Any]:
    end = jax.tree.map(lambda leaf: leaf[-1], motion.state)
    duration, steps = float(motion.time[-1]), int(motion.steps)
    return {
        "final": {**record(end, "theta1 theta2"), "p1": float(end.p1), "p2": float(end.p2)},
        "duration_s": duration,
        **record(motion, "energy_drift error_estimate steps"),
        "method": motion.method,
        "step_s": abs(duration) / max(1, steps),
        **record(motion, "status tolerance message"),
    }


def design_record(
    found: dpend.Design, start: Pendulum, branches: tuple[str, ...], equations: tuple[str, ...]
) -> dict[str, Any]:
    def slopes(key: str, i: int) -> dict[str, float]:
        of, scale = _SLOPES[key]
        rows = found.sensitivities[of].items()
        return {name: scale * float(np.atleast_1d(row)[i]) for name, row in rows}

    orbits = [
        orbit_record(orbit)
        | {"branch": name, "sensitivities": {key: slopes(key, i) for key in _SLOPES}}
        for i, (name, orbit) in enumerate(zip(branches, found.orbits, strict=True))
    ]
    return {
        **record(found, "pendulum"),
        "orbits": orbits,
        "missed": dict(zip(equations, np.atleast_1d(found.loss).tolist(), strict=True)),
        **record(found, "distance at_bounds iterations looks status message"),
        "start": record(start),
    }


def fit_record(fit: dpend.Fit) -> dict[str, Any]:
    measured = np.sum(np.isfinite(fit.residual1)) + np.sum(np.isfinite(fit.residual2))
    return {
        **record(fit, "estimates standard_errors free noise expected_noise"),
        "angles": int(measured),
        "duration_s": float(fit.time[-1] - fit.time[0]),
        **record(fit, "windows iterations gap error_estimate status message pendulum"),
    }


def converged(*results: Any) -> bool:
    return all(int(result.status) == Status.CONVERGED for result in results)


def print_text(text: str) -> None:
    print(text)


def print_json(found: dict[str, Any]) -> None:
    print(json_text(found))


def _print_failure(found: dict[str, Any], whose: str = "") -> None:
    if found["status"] != "converged":
        print(f"{whose}{found['status']}: {found['message']}")


def _describe(pendulum: Pendulum, symmetry: str = "") -> str:
    l1, l2, m1, m2, g = (f"{float(value):g}" for value in jax.tree.leaves(pendulum))
    bobs = f"l1 = {l1} m, l2 = {l2} m, m1 = {m1} kg, m2 = {m2} kg"
    rests = not symmetry or symmetry in RELEASED_SYMMETRIES
    return f"{bobs}, g = {g} m/s^2, {'released from' if rests else 'never at'} rest"


def print_orbits(
    pendulum: Pendulum, records: Sequence[dict[str, Any]], *written: Path | None
) -> None:
    symmetry = records[0]["symmetry"]
    rests = symmetry in RELEASED_SYMMETRIES
    moving = () if rests else ("p1 (kg m^2/s)", "p2 (kg m^2/s)", "turns")
    headings = ("", "theta1 (deg)", "theta2 (deg)", *moving, "period (s)", "stability", "kappa")
    rows = [
        (
            one.get("branch") or one["symmetry"],
            f"{one['theta1_deg']:.10g}",
            f"{one['theta2_deg']:.9f}",
            *(() if rests else (*_momenta(one), "{}, {}".format(*one["turns"]))),
            f"{one['period_s']:.11f}",
            one["stability"],
            f"{one['kappa']:.6g}",
            "{theta2_deg:.0e}, {period_s:.0e}".format(**one["error_estimate"]),
        )
        for one in records
    ]
    print_table(_describe(pendulum, symmetry), (*headings, "error (deg, s)"), rows)
    for one in records:
        _print_failure(one, f"{one.get('branch') or 'guess'}: ")
    _print_places(*written)


def print_family(found: dict[str, Any], *written: Path | None) -> None:
    points, symmetry = found["points"], found["symmetry"]
    chosen = np.unique(np.linspace(0, len(points) - 1, _SHOWN_POINTS).round().astype(int))
    special = [row | {"number": str(i)} for i, row in enumerate(found["bifurcations"], start=1)]
    shown = [points[i] | {"kind": "", "number": ""} for i in chosen] + special
    moving = () if symmetry in RELEASED_SYMMETRIES else ("p1 (kg m^2/s)", "p2 (kg m^2/s)")
    headings = ("theta1 (deg)", "theta2 (deg)", *moving, "period (s)", "energy (J)", "stability")
    rows = [_family_point(row) for row in sorted(shown, key=lambda row: row["arclength"])]
    pendulum = Pendulum(*found["pendulum"].values())
    print_table(_describe(pendulum, symmetry), (*headings, "log |kappa|", "special", ""), rows)
    worst = max(point["theta2_error_deg"] for point in points)
    what = "the direction at the start" if symmetry == "passing" else "theta2"
    ends = "{} {} orbits from {} to {}".format(len(points), symmetry, *found["ends"])
    print(f"{ends}; error of {what} at most {worst:.0e} deg")
    _print_failure(found)
    _print_places(*written)


def _print_places(*written: Path | None) -> None:
    for place in written:
        if place is not None:
            print(f"written to {place}")


def _momenta(row: dict[str, Any]) -> tuple[str, str]:
    return f"{row['p1_kg_m2_s']:.10g}", f"{row['p2_kg_m2_s']:.10g}"


def _family_point(row: dict[str, Any]) -> tuple[str, ...]:
    """A row for one of the points, or for a special point, where kappa is what its kind says."""
    marginal = row["kind"].startswith("stability")
    logarithm = math.log(max(abs(row["kappa"]), sys.float_info.min))
    return (
        f"{row['theta1_deg']:z.9f}",
        f"{row['theta2_deg']:z.9f}",
        *(_momenta(row) if "p1_kg_m2_s" in row else ()),
        f"{row['period_s']:.10f}",
        f"{row['energy_J']:.9f}",
        "" if marginal else dpend.stability_class(row["kappa"]),
        "0" if marginal else f"{row.get('log_abs_kappa', logarithm):.5g}",
        row["number"],
        row["kind"],
    )


def print_atlas(atlas: dpend.Atlas, theta1: float | None, *written: Path | None) -> None:
    title = _describe(atlas.pendulum)
    if theta1 is None:
        families = [_family_row(atlas, one) for one in atlas.families]
        print_table(title, ("family", "periods (s)", "from", "to", "orbits"), families)
        what = f"{len(atlas.families)} families with {len(atlas)} orbits in the table"
    else:
        headings = ("theta2 (deg)", "period (s)", "symmetry", "stability", "kappa", "dual (deg)")
        orbits = [_atlas_row(orbit_record(orbit)) for orbit in atlas.orbits]
        print_table(title, (*headings, "error (deg)"), orbits)
        what = f"{len(atlas)} orbits with theta1 = {theta1:g} deg"
    seen = atlas.coverage
    print(
        f"{what} and periods of at most {atlas.max_period:g} s; "
        f"{seen.slices} slice{'s' * (seen.slices > 1)}, {seen.theta2_points} motions, "
        f"{seen.time_points} times"
    )
    if seen.exhausted:
        print(
            "STOPPED at the most time steps allowed: more is likely to be missing; raise "
            "--most-steps"
        )
    agree = "agree" if seen.degree == seen.winding else "DISAGREE: a return is missing"
    print(
        f"{seen.suspicious_cells} suspicious cells; the signs of all returns and the winding "
        f"number {agree}"
    )
    _print_places(*written)


def _atlas_row(row: dict[str, Any]) -> tuple[str, ...]:
    return (
        f"{row['theta2_deg']:.9f}",
        f"{row['period_s']:.9f}",
        row["symmetry"],
        row["stability"],
        f"{row['kappa']:.6g}",
        "{theta1_deg:.4f}, {theta2_deg:.4f}".format(**row["dual"]),
        f"{row['error_estimate']['theta2_deg']:.0e}",
    )


def _family_row(atlas: dpend.Atlas, family: dict[str, Any]) -> tuple[str, ...]:
    count = int(np.sum(atlas.table["family"] == family["family"]))
    periods = f"{family['shortest_period_s']:.6f} - {family['longest_period_s']:.6f}"
    return (family["family"], periods, *family["ends"], str(count))


def print_fit(found: dict[str, Any], figure: Path | None) -> None:
    errors = found["standard_errors"]
    for name, value in found["estimates"].items():
        error = errors[name]
        known = f"+- {error:.2g}"
        known = {0.0: "held", math.inf: "not determined"}.get(error, known)
        print(f"{name:14}{value:16.{_decimals(error)}f}  {known}")
    print(
        f"{found['angles']} angles over {found['duration_s']:g} s; noise "
        f"{found['noise_deg']:.3g} deg, of which {found['expected_noise_deg']:.3g} deg was expected"
    )
    _print_failure(found)
    if figure is not None:
        print(f"drawn in {figure}")


def _decimals(error: float) -> int:
    """As many as show two digits of the error, and six where there is none."""
    return 6 if not 0 < error < math.inf else min(max(1 - math.floor(math.log10(error)), 0), 12)


def print_design(found: dict[str, Any], theta1: float) -> None:
    orbits = found["orbits"]
    start, end = (Pendulum(*found[key].values()) for key in ("start", "pendulum"))
    print_orbits(end, orbits)
    units = {"l1": "m", "l2": "m", "m1": "kg", "m2": "kg", "g": "m/s^2", "theta1": "deg"}
    before = [*jax.tree.leaves(start), theta1]
    after = [*jax.tree.leaves(end), orbits[0]["theta1_deg"]]
    rows = []
    for (name, unit), one, other in zip(units.items(), before, after, strict=True):
        slopes = [orbit["sensitivities"][key][name] for orbit in orbits for key in _SLOPE_HEADINGS]
        cells = (f"{slope:.6g}" for slope in slopes)
        rows.append((f"{name} ({unit})", f"{float(one):g}", f"{float(other):.10g}", *cells))
    headings = [
        f"{one['branch']}\n{heading}" for one in orbits for heading in _SLOPE_HEADINGS.values()
    ]
    title = "derivatives with respect to the logarithms"
    print_table(title, ("", "start", "found", *headings), rows)
    missed = ", ".join(f"{name} {value:.0e}" for name, value in found["missed"].items())
    bounds = f"; at bounds: {', '.join(found['at_bounds'])}" if found["at_bounds"] else ""
    print(
        f"{found['iterations']} steps, {found['looks']} solves; misses {missed}; logarithms "
        f"changed by {found['distance']:.6g}{bounds}"
    )
    _print_failure(found)


def print_motion(found: dict[str, Any], times: int, out: Path | None, figure: Path | None) -> None:
    final = found["final"]
    angles = f"theta1 = {final['theta1_deg']:.9f} deg, theta2 = {final['theta2_deg']:.9f} deg"
    print(f"after {found['duration_s']:g} s   {angles}")
    print(f"                p1 = {final['p1']:.12g}, p2 = {final['p2']:.12g} kg m^2/s")
    drift = f"{found['energy_drift']:.1e} of its scale"
    print(f"error estimate  {found['error_estimate']:.1e} rad, energy drift {drift}")
    of = "of about" if found["method"] == "collocation" else "of"
    print(f"integrated by   {found['method']}, {found['steps']} steps {of} {found['step_s']:.4g} s")
    _print_failure(found)
    if out is not None:
        print(f"written to      {out}: {times} times")
    if figure is not None:
        print(f"drawn in        {figure}")


def print_map(found: dict[str, Any], figure: Path | None) -> None:
    print(
        f"{found['cells']} cells in {found['seconds']:.1f} s, {found['failed']} failed; "
        f"{found['steps_per_second']:.3g} steps/s of {found['scheme']['method']}, "
        f"{found['scheme']['step_s']:.4g} s"
    )
    print(f"written to {found['out']}" + (f", drawn in {figure}" if figure else ""))


def print_section(found: dict[str, Any], figure: Path | None) -> None:
    print(
        f"{found['crossings']} crossings by {found['starts']} motions of {found['energy_J']:g} J, "
        f"right to {found['largest_energy_error_J']:.0e} J; {found['failed']} motions failed"
    )
    columns = "returns", "angle_deg", "momentum_kg_m2_s", "period_s", "stability", "kappa"
    forms = "{}", "{:.9f}", "{:.12f}", "{:.11f}", "{}", "{:.6g}"
    rows = [
        [form.format(row[key]) for form, key in zip(forms, columns, strict=True)]
        for row in found["periodic_orbits"]
    ]
    headings = "returns", "angle (deg)", "momentum (kg m^2/s)", "period (s)", "stability", "kappa"
    if rows:
        print_table("periodic orbits, the first point of each", headings, rows)
    written = {"written to": found["out"], "drawn in": figure}
    print(*(f"{how} {where}" for how, where in written.items() if where), sep=", ")


def print_films(found: dict[str, Any], releases: Sequence[tuple[float, float]]) -> None:
    count = len(releases)
    print(
        f"{found['frames']} frames of {count} motion{'s' * (count > 1)} written to {found['out']}"
    )
    for (one, two), motion in zip(releases, found["motions"], strict=True):
        _print_failure(motion, f"({one:g}, {two:g}) deg: ")
