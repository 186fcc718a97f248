"""The command about sections of an energy surface: `section`."""

import time
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import typer

import dpend
from dpend.checks import integer, number
from dpend.maps.section import STEPS_A_CROSSING, check_new
from dpend.mechanics.pendulum import Pendulum
from dpend.mechanics.surface import Plane
from dpend.options import Report, command, counted, numeric, radians
from dpend.report import print_section
from dpend.status import Status
from dpend.terminal import bar, on_terminal, tell_cost
from dpend.writing import check_figure, draw_section

# Steps that a core takes in a second, and memory of a crossing while it is computed [bytes].
_RATE, _BYTES = 2e6, 200


@command()
def section(
    pendulum: Pendulum,
    energy: Annotated[
        float, numeric(help="H [J], zero for both bobs at rest at the pivot's height.")
    ],
    angle: Annotated[
        str, typer.Option(metavar="theta1|theta2", help="Whose plane is crossed.")
    ] = "theta1",
    at: Annotated[float, numeric(help="The value of that angle on the plane [deg].")] = 0.0,
    starts: Annotated[int, counted("How many motions fill the energy surface.")] = 64,
    count: Annotated[int, counted("How many crossings each is followed for.")] = 200,
    periodic: Annotated[
        int, counted("Find periodic orbits of up to so many returns, too; 0 for none.")
    ] = 0,
    out: Annotated[Path | None, typer.Option(help="Write the crossings to a Zarr store.")] = None,
    figure: Annotated[Path | None, typer.Option(help="Draw the section into P.png.")] = None,
) -> Report:
    """A section of the motions of one energy, where they cross a plane, and its periodic orbits."""
    plane = Plane(angle, radians("at", at))
    starts, count = integer("starts", starts), integer("count", count)
    periodic = integer("periodic", periodic, least=0)
    if out is not None:
        check_new("out", out)
    check_figure(figure)
    steps = float(STEPS_A_CROSSING) * starts * count
    tell_cost(steps, steps / (_RATE * jax.local_device_count()), float(_BYTES) * starts * count)
    began = time.perf_counter()
    with bar(on_terminal(), "crossings") as show:
        found = dpend.section(
            pendulum, energy, plane=plane, starts=starts, count=count, store=out, progress=show
        )
    seconds = time.perf_counter() - began
    orbits = [_periodic(pendulum, energy, plane, k) for k in range(1, periodic + 1)]
    if figure is not None:
        draw_section(found, orbits, figure)
    record = _record(found, [row for rows in orbits for row in _rows(rows)], seconds, out)
    return record, partial(print_section, record, figure), record["failed"] == 0


def _periodic(pendulum: Pendulum, energy: float, plane: Plane, returns: int) -> Any:
    with bar(on_terminal(), f"searches of {returns} returns") as show:
        return dpend.periodic_points(pendulum, energy, returns=returns, plane=plane, progress=show)


def _record(found: Any, rows: list[dict[str, Any]], seconds: float, out: Path | None) -> Any:
    status = found.status.values
    return {
        "energy_J": float(number("energy", found.attrs["energy"])),
        "plane": {found.attrs["plane"] + "_deg": float(np.degrees(found.attrs["plane_at"]))},
        "starts": int(status.size),
        "crossings": int(np.sum(np.isfinite(found.time.values))),
        "failed": int(np.sum(status != Status.CONVERGED)),
        "largest_energy_error_J": float(found.energy_error.max()),
        "seconds": seconds,
        "scheme": {"method": found.attrs["method"], "step_s": found.attrs["step"]},
        "periodic_orbits": rows,
        "out": None if out is None else str(out),
    }


def _rows(orbits: Any) -> list[dict[str, Any]]:
    """The periodic orbits as JSON has them: the first point of each."""
    return [
        {
            "returns": int(one["returns"]),
            "angle_deg": float(np.degrees(one.angle[0])),
            "momentum_kg_m2_s": float(one.momentum[0]),
            "period_s": float(one.period),
            "kappa": float(one.kappa),
            "stability": dpend.stability_class(float(one.kappa)),
        }
        for one in (orbits.isel(orbit=i) for i in range(orbits.sizes["orbit"]))
    ]
