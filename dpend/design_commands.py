"""The command about a pendulum for a wish: `design`."""

from functools import partial
from typing import Annotated, Any

import jax
import typer

import dpend
from dpend.checks import number
from dpend.mechanics.pendulum import Pendulum
from dpend.options import (
    Report,
    Theta1,
    bounds_in,
    command,
    equations_of,
    names_in,
    numeric,
    radians,
)
from dpend.orbits.orbit import BRANCHES, PeriodicOrbit
from dpend.report import converged, design_record, print_design
from dpend.terminal import clock


@command()
def design(
    pendulum: Pendulum,
    theta1: Theta1,
    branch: Annotated[
        str | None,
        typer.Option(metavar="|".join(BRANCHES), help="Whose --period and --kappa are meant."),
    ] = None,
    period: Annotated[float | None, numeric(help="Wanted period [s].")] = None,
    kappa: Annotated[
        float | None, numeric(help="Wanted kappa: stable from -1 to 1, most so at 0.")
    ] = None,
    ratio: Annotated[
        float | None,
        numeric(help="Wanted period of the in-phase orbit over that of the anti-phase orbit."),
    ] = None,
    free: Annotated[
        str, typer.Option(metavar="NAMES", help="What may change, of l1,l2,m1,m2,g,theta1.")
    ] = "l1,l2",
    bounds: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=A:B", help="Bounds of one of them (theta1 in degrees); once a name."
        ),
    ] = None,
) -> Report:
    """The pendulum nearest to this one whose orbit released at THETA1 has a wanted period,
    stability, or both.
    """
    equations, branches = equations_of(branch, period, kappa, ratio)
    if not 0 < number("theta1", theta1, unit="deg") < 180:
        raise ValueError(
            f"theta1 must be between 0 and 180 deg, got {theta1:g}: give another theta1"
        )

    def loss(*orbits: PeriodicOrbit) -> Any:
        by_name = dict(zip(branches, orbits, strict=True))
        return jax.numpy.stack([equation(by_name) for equation in equations.values()])

    names, limits, angle = names_in(free), bounds_in(bounds or []), radians("theta1", theta1)
    with clock("designing"):
        found = dpend.design_pendulum(
            loss, pendulum, names, branch=branches, theta1=angle, bounds=limits
        )
    record = design_record(found, pendulum, branches, tuple(equations))
    return record, partial(print_design, record, theta1), converged(found)
