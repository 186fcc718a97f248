"""The commands about motions: `simulate`, `map`, `animate` and `fit`.

A command takes the pendulum that `options.command` makes of the shared options, and a parameter for
each option of its own: these may be more than seven. It hands back a report, which is printed.
"""

import math
import time
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

import dpend
from dpend.checks import number
from dpend.maps.cluster import connect
from dpend.maps.cost import Cost
from dpend.maps.store import check_store
from dpend.mechanics.pendulum import Pendulum
from dpend.methods.scheme import METHODS
from dpend.motion.simulate import MOST_MOTION_STEPS
from dpend.options import (
    Omega1,
    Omega2,
    Report,
    Theta1,
    cells_in,
    command,
    counted,
    moving_state,
    names_in,
    numeric,
    radians,
    size_in,
)
from dpend.report import (
    converged,
    fit_record,
    motion_record,
    print_films,
    print_fit,
    print_map,
    print_motion,
)
from dpend.status import Status
from dpend.terminal import bar, clock, complaints_of_stores, on_terminal, tell_cost
from dpend.writing import check_figure, draw, draw_fit, draw_motion, writer

# Speed [steps/s] and memory [bytes/step] of a motion at order 8 with its second pass, all states
# saved, on two cores.
_STEPS_A_SECOND, _BYTES_A_STEP = 5e4, 250
# Rows of a map that are read at once, to be counted.
_ROWS = 256
# Methods of even steps, which can save states at any of them.
_EVEN = [name for name, method in METHODS.items() if method.even]
_MAPS = {
    "lyapunov": dpend.chaos.lyapunov,
    "megno": dpend.chaos.megno,
    "flip": dpend.chaos.flip,
    "drift": dpend.chaos.drift,
}


@command()
def simulate(
    pendulum: Pendulum,
    theta1: Theta1,
    theta2: Annotated[float, numeric(help="Release angle of the lower rod [deg].")],
    duration: Annotated[float, numeric(help="How long [s]; negative runs backwards.")],
    p1: Annotated[
        float | None,
        numeric("--p1", help="Canonical momentum of the upper angle [kg m^2/s]; 0 if not given."),
    ] = None,
    p2: Annotated[
        float | None, numeric("--p2", help="Canonical momentum of the lower angle [kg m^2/s].")
    ] = None,
    omega1: Omega1 = None,
    omega2: Omega2 = None,
    method: Annotated[
        str | None,
        typer.Option(metavar="|".join(_EVEN), help="With --step; rk8 if not given."),
    ] = None,
    step: Annotated[float | None, numeric(help="Largest step [s].")] = None,
    tolerance: Annotated[
        float | None,
        numeric(help="Wanted error of the angles [rad]; 1e-9 if no step is given either."),
    ] = None,
    most_steps: Annotated[
        int,
        counted("How many steps are taken at most."),
    ] = MOST_MOTION_STEPS,
    out: Annotated[
        Path | None, typer.Option(help="Write the motion to F.csv (degrees) or F.nc (radians).")
    ] = None,
    figure: Annotated[
        Path | None,
        typer.Option(help="Draw rods, path, angles and energies into P.png, P.pdf or P.svg."),
    ] = None,
) -> Report:
    """The motion from a release, and how far its end may be believed."""
    angles = radians("theta1", theta1), radians("theta2", theta2)
    state = moving_state(pendulum, angles, (p1, p2), (omega1, omega2))
    check_figure(figure)
    write = writer(out) if out is not None else None
    if step is not None and step > 0 and (steps := abs(duration / step)) <= most_steps:
        tell_cost(steps, steps / _STEPS_A_SECOND, steps * _BYTES_A_STEP)
    how = {"step": step, "method": method, "tolerance": tolerance, "most_steps": most_steps}
    with clock("integrating"):
        motion = dpend.simulate(pendulum, state, duration, **how)
    if write is not None:
        write(motion)
    draw_motion(pendulum, motion, figure)
    record = motion_record(motion)
    show = partial(print_motion, record, motion.time.size, out, figure)
    return record, show, converged(motion)


@command("map")
def map_command(
    pendulum: Pendulum,
    quantity: Annotated[str, typer.Argument(help="lyapunov, megno, flip or drift.")],
    size: Annotated[str, typer.Option(metavar="N|NxM", help="Cells along theta1 and theta2.")],
    duration: Annotated[float, numeric(help="How long each motion lasts [s].")],
    out: Annotated[
        Path,
        typer.Option(help="The Zarr store; one left unfinished by the same command is finished."),
    ],
    theta1: Annotated[str, typer.Option(metavar="A:B", help="Range of theta1 [deg].")] = "-180:180",
    theta2: Annotated[str, typer.Option(metavar="A:B", help="Range of theta2 [deg].")] = "-180:180",
    tolerance: Annotated[
        float | None,
        numeric(help="Wanted error of the angles [rad]; 1e-6 if no method is given either."),
    ] = None,
    method: Annotated[
        str | None, typer.Option(metavar="|".join(METHODS), help="With --step.")
    ] = None,
    step: Annotated[float | None, numeric(help="Step [s], with --method.")] = None,
    error: Annotated[
        str | None,
        typer.Option(help="half-step: a second pass at half the step, and an error for each cell."),
    ] = None,
    most_steps: Annotated[
        float,
        numeric(
            "--most-steps",
            help="Refuse a map of more steps, or a motion of more than a millionth of it.",
        ),
    ] = 1e12,
    workers: Annotated[
        int | None, counted("Compute by so many processes of Dask on this machine.")
    ] = None,
    cluster: Annotated[
        str | None,
        typer.Option(help="Compute on the Dask cluster at this address, as tcp://host:8786."),
    ] = None,
    figure: Annotated[Path | None, typer.Option(help="Draw the map into P.png.")] = None,
) -> Report:
    """A map of the square of releases from rest: chaos, first flips or energy drift, cell by
    cell.
    """
    if quantity not in _MAPS:
        raise ValueError(f"map must be one of {', '.join(_MAPS)}, got {quantity!r}")
    if method is not None and method not in METHODS:
        raise ValueError(f"method must be one of {', '.join(METHODS)}, got {method!r}")
    duration = number("duration", duration, positive=True, unit="s")
    across, up = size_in(size)
    axes = {"theta1": cells_in("theta1", theta1, across), "theta2": cells_in("theta2", theta2, up)}
    check_store("out", out)
    check_figure(figure)
    started, counts = time.perf_counter(), [0, 0, 0]
    with (
        complaints_of_stores(),
        connect(workers, cluster) as client,
        bar(on_terminal(), "cells") as show,
    ):

        def tell(*now: int) -> None:
            counts[:] = now
            show(*now)

        field = dpend.sweep(
            partial(_MAPS[quantity], duration=float(duration)),
            pendulum,
            axes,
            tolerance=tolerance,
            method=method,
            step=step,
            error=error,
            store=out,
            progress=tell,
            announce=_announce,
            most_steps=most_steps,
            client=client,
        )
    record = _map_record(field, time.perf_counter() - started, counts[2], out)
    if figure is not None:
        draw(field, figure)
    return record, partial(print_map, record, figure), True


def _announce(cost: Cost) -> None:
    more = f", for {cost.cells} cells; stopped and started again, it goes on"
    tell_cost(cost.steps, cost.seconds, cost.bytes, more)


def _map_record(field: Any, seconds: float, steps: int, out: Path) -> dict[str, Any]:
    done, failed = _counts(field["status"])
    return {
        "cells": int(field["status"].size),
        "done": done,
        "failed": failed,
        "seconds": seconds,
        "steps_per_second": steps / seconds,
        "scheme": {"method": field.attrs["method"], "step_s": field.attrs["step"]},
        "out": str(out),
    }


def _counts(status: Any) -> tuple[int, int]:
    """How many cells are done, and how many of them failed."""
    done = failed = 0
    for start in range(0, status.shape[0], _ROWS):
        rows = status[start : start + _ROWS].values
        done += int(np.sum(rows != Status.NOT_COMPUTED))
        failed += int(np.sum((rows != Status.NOT_COMPUTED) & (rows != Status.CONVERGED)))
    return done, failed


@command()
def animate(
    pendulum: Pendulum,
    theta1: Annotated[
        list[float],
        numeric("--theta1", help="Release angle of the upper rod [deg]; once a release."),
    ],
    theta2: Annotated[
        list[float],
        numeric("--theta2", help="Release angle of the lower rod [deg]; once a release."),
    ],
    duration: Annotated[float, numeric(help="How long the motion lasts [s].")],
    out: Annotated[Path, typer.Option(help="F.gif, F.mp4, or F.png with all pictures in one.")],
    speed: Annotated[float, numeric(help="Seconds of the motion in a second of the film.")] = 1.0,
    size: Annotated[int, counted("Pixels of the longer side, without the clock.")] = 480,
) -> Report:
    """A film of a motion in real time; of several, in one picture, where --theta1 and --theta2 are
    given again.
    """
    from dpend import animate as animation

    if len(theta1) != len(theta2):
        raise ValueError(
            f"theta1 and theta2 must be given equally often, got {len(theta1)} and {len(theta2)}: "
            f"a release is both"
        )
    animation.check_request(out, size)
    releases = [
        dpend.released(radians("theta1", one), radians("theta2", two))
        for one, two in zip(theta1, theta2, strict=True)
    ]
    motions = animation.motions_for(pendulum, releases, duration, speed=speed)
    with bar(on_terminal(), "frames") as show:
        frames = animation.film(pendulum, motions, out, size=size, progress=show)
    record = {
        "frames": frames,
        "frames_per_second": animation.FRAMES_PER_SECOND if out.suffix != ".png" else None,
        "out": str(out),
        "motions": [motion_record(motion) for motion in motions],
    }
    pairs = list(zip(theta1, theta2, strict=True))
    return record, partial(print_films, record, pairs), converged(*motions)


@command()
def fit(
    pendulum: Pendulum,
    data: Annotated[
        Path, typer.Argument(help="A CSV file with columns time_s, theta1_deg, theta2_deg.")
    ],
    free: Annotated[
        str, typer.Option(help="What to estimate, of l1, l2, m1, m2, g; the rest is held.")
    ] = "l2,m2,g",
    at_rest: Annotated[
        bool, typer.Option("--at-rest", help="The motion was released from rest at the first time.")
    ] = False,
    noise: Annotated[
        float | None, numeric(help="Standard deviation of the angles [deg], if it is known.")
    ] = None,
    figure: Annotated[
        Path | None, typer.Option(help="Draw data, fit and residuals into P.png.")
    ] = None,
) -> Report:
    """The pendulum whose motion is nearest to measured angles, from a guess of it; one rod or
    single cells may lack.
    """
    check_figure(figure)
    if figure is not None and figure.resolve() == data.resolve():
        raise ValueError(
            f"figure must be another file than data, got {figure} for both: give another name"
        )
    sigma = None
    if noise is not None:
        sigma = math.radians(number("noise", noise, positive=True, unit="deg"))
    names = names_in(free)
    times, theta1, theta2 = dpend.load_angles(data)
    with clock("fitting"):
        found = dpend.fit_parameters(
            times,
            theta1,
            theta2,
            pendulum=pendulum,
            free=names,
            initial=(None, None, 0.0, 0.0) if at_rest else (None,) * 4,
            noise=sigma,
        )
    if figure is not None:
        draw_fit(found, figure)
    record = fit_record(found)
    return record, partial(print_fit, record, figure), converged(found)
