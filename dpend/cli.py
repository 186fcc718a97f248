"""The command line. Angles are in degrees here, and nowhere else but in CSV and JSON.

Exit status 0: done. 1: ran, but some solve failed, or the environment is wrong. 2: bad input, one
line on standard error. 130: interrupted. 141: nobody reads standard output any more.

A command takes the pendulum that `options.command` makes of the shared options, and one parameter
for each option of its own: these may be more than seven.
"""

import io
import math
import os
import sys
import time
import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import typer

import dpend
from dpend._runtime import catch_interrupts, leave_quietly
from dpend.catalogue import survey
from dpend.catalogue.atlas import MOST_SEARCH_STEPS, SECONDS_PER_STEP, expected_steps, known_period
from dpend.checks import check_place, number
from dpend.maps.cost import Cost
from dpend.maps.store import check_store
from dpend.mechanics.pendulum import Pendulum, State
from dpend.methods.scheme import METHODS
from dpend.motion.simulate import MOST_MOTION_STEPS
from dpend.options import (
    Report,
    bounds_in,
    cells_in,
    command,
    counted,
    equations_of,
    names_in,
    numeric,
    radians,
    size_in,
)
from dpend.orbits.find import swinging_pendulum
from dpend.orbits.orbit import BRANCHES, PeriodicOrbit
from dpend.records import replacing
from dpend.report import (
    design_record,
    draw,
    draw_fit,
    family_record,
    fit_record,
    motion_record,
    orbit_record,
    print_atlas,
    print_design,
    print_family,
    print_films,
    print_fit,
    print_json,
    print_map,
    print_motion,
    print_orbits,
    write_family_csv,
    write_json,
    writer,
)
from dpend.status import Status
from dpend.terminal import (
    bar,
    clock,
    complaints_of_stores,
    on_terminal,
    tell_cost,
    tell_error,
    work,
)

# Speed [steps/s] and memory [bytes/step] of a motion at order 8 with its second pass, all states
# saved, on two cores.
_STEPS_A_SECOND, _BYTES_A_STEP = 5e4, 250
# Rows of a map that are read at once, to be counted.
_ROWS = 256
_MAPS = {
    "lyapunov": dpend.chaos.lyapunov,
    "megno": dpend.chaos.megno,
    "flip": dpend.chaos.flip,
    "drift": dpend.chaos.drift,
}
_Theta1 = Annotated[float, numeric("--theta1", help="Release angle of the upper rod [deg].")]

app = typer.Typer(
    name="dpend",
    help="The motions of a double pendulum that come back. Angles in degrees, everything else in "
    "SI units.",
    add_completion=False,
    rich_markup_mode=None,  # square brackets are units here
    pretty_exceptions_enable=False,
)


@app.callback()
def _commands() -> None:
    """Keeps `dpend orbit` a subcommand."""


@command(app, print_json)
def orbit(
    pendulum: Pendulum,
    theta1: _Theta1,
    branch: Annotated[
        str | None,
        typer.Option(help="in-phase or anti-phase; both, if neither this nor a guess is given."),
    ] = None,
    theta2: Annotated[
        float | None, numeric(help="Guess of the lower rod's release angle [deg].")
    ] = None,
    period: Annotated[float | None, numeric(help="Guess of the period [s].")] = None,
    symmetry: Annotated[
        str | None, typer.Option(help="centred or brake, with a guess; found out if not given.")
    ] = None,
    ratio: Annotated[
        int | None,
        counted("1 or -1: theta2 = ratio theta1, the release nearest to THETA1."),
    ] = None,
    crossing: Annotated[
        int | None,
        counted("Which of the branch's passages through theta1; 1 if not given."),
    ] = None,
) -> Report:
    """The releases from rest at THETA1 that come back: partner angle, period, stability, error."""
    if (theta2 is None) != (period is None):
        given, missing = ("theta2", "period") if period is None else ("period", "theta2")
        raise ValueError(
            f"{missing} must be given with {given}, got {given} alone: a guess is both"
        )
    if crossing is not None and branch is None:
        raise ValueError(
            f"crossing must go with branch, got {crossing} alone: give --branch "
            f"{' or '.join(BRANCHES)}"
        )
    release, guess = radians("theta1", theta1), None
    if theta2 is not None:
        guess = radians("theta2", theta2), number("period", period, positive=True, unit="s")
    both = branch is None and guess is None and ratio is None
    find = partial(
        dpend.find_orbit,
        guess=guess,
        symmetry=symmetry,
        ratio=ratio,
        crossing=1 if crossing is None else crossing,
    )
    with clock("following the branch" if guess is None else "solving"):
        found = {
            name: find(pendulum, release, branch=name) for name in (BRANCHES if both else (branch,))
        }
    records = [
        orbit_record(orbit) | ({"branch": name} if name else {}) for name, orbit in found.items()
    ]
    record = {"orbits": records} if both else records[0]
    return record, partial(print_orbits, pendulum, records), _converged(*found.values())


def _converged(*results: Any) -> bool:
    return all(int(result.status) == Status.CONVERGED for result in results)


@command(app, print_json)
def family(
    pendulum: Pendulum,
    branch: Annotated[str, typer.Option(help="in-phase (slow mode) or anti-phase (fast mode).")],
    out: Annotated[
        Path | None,
        typer.Option(help="Write all points to F.csv, or to F.json what --json prints."),
    ] = None,
) -> Report:
    """All orbits of a normal mode, from small swings to the upright pendulum, and where their
    stability changes.
    """
    if branch not in BRANCHES:
        raise ValueError(f"branch must be one of {', '.join(BRANCHES)}, got {branch!r}")
    formats = {".csv": write_family_csv, ".json": write_json}
    if out is not None:
        check_place("out", out, tuple(formats))
    with clock("following the family"):
        found = dpend.follow_family(pendulum, branch)
    record = family_record(found, branch)
    if out is not None:
        with replacing(out) as draft:
            formats[out.suffix](record, draft)
    return record, partial(print_family, record, out), _converged(found)


@command(app, print_json)
def atlas(
    pendulum: Pendulum,
    max_period: Annotated[float, numeric(help="The longest period [s].")],
    theta1: Annotated[
        float | None,
        numeric(
            "--theta1", help="Release angle of the upper rod [deg]; the whole square without it."
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Write the atlas to F.csv or F.json.")] = None,
    store: Annotated[
        Path | None,
        typer.Option(
            help="Of the whole square: F.json, from which a search that was stopped goes on."
        ),
    ] = None,
    most_steps: Annotated[
        float,
        numeric(
            help="Refuse a search that takes more time steps, or stop there: 1e9 take about an "
            "hour."
        ),
    ] = float(MOST_SEARCH_STEPS),
) -> Report:
    """Every orbit released from rest up to a period: of one release angle, or all families of the
    whole square.
    """
    if theta1 is not None and store is not None:
        raise ValueError(
            f"store goes with the whole square, got {store} with theta1: leave out either"
        )
    if out is not None:
        check_place("out", out, (".csv", ".json"))
        if store is not None and out.resolve() == store.resolve():
            raise ValueError(
                f"out must be another file than store, got {out} for both: give another name"
            )
    steps = _steps_of_search(swinging_pendulum(pendulum), max_period, theta1)
    if steps <= most_steps:
        tell_cost(steps, steps * SECONDS_PER_STEP)
    limits = {"max_period": max_period, "most_steps": most_steps}
    with work("slices" if theta1 is None else "million steps") as show:
        if theta1 is None:
            found = dpend.find_brake_families(
                pendulum,
                **limits,
                store=store,
                progress=lambda done, planned, families: show(done, planned),
            )
        else:
            found = dpend.find_brake_orbits(
                pendulum,
                **limits,
                theta1=radians("theta1", theta1),
                progress=lambda done, planned: show(done / 1e6, planned / 1e6),
            )
    if out is not None:
        found.save(out)
    families = all(family["status"] == "converged" for family in found.families)
    solved = families and bool(np.all(found.table["status"] == Status.CONVERGED))
    solved = solved and not (found.coverage.suspicious_cells or found.coverage.exhausted)
    return found.record(), partial(print_atlas, found, theta1, out), solved


def _steps_of_search(pendulum: Pendulum, max_period: float, theta1: float | None) -> int | float:
    known_period(pendulum, max_period)
    if theta1 is None:
        return survey.expected_steps(pendulum, max_period)
    return expected_steps(pendulum, max_period, radians("theta1", theta1))


@command(app, print_json)
def design(
    pendulum: Pendulum,
    theta1: _Theta1,
    branch: Annotated[
        str | None,
        typer.Option(help="in-phase or anti-phase: whose orbit --period and --kappa are about."),
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
    return record, partial(print_design, record, theta1), _converged(found)


@command(app, print_json)
def simulate(
    pendulum: Pendulum,
    theta1: _Theta1,
    theta2: Annotated[float, numeric(help="Release angle of the lower rod [deg].")],
    duration: Annotated[float, numeric(help="How long [s]; negative runs backwards.")],
    p1: Annotated[
        float, numeric("--p1", help="Canonical momentum of the upper angle [kg m^2/s].")
    ] = 0.0,
    p2: Annotated[
        float, numeric("--p2", help="Canonical momentum of the lower angle [kg m^2/s].")
    ] = 0.0,
    method: Annotated[
        str | None,
        typer.Option(
            help="rk4, rk8 (default for a step), gauss, rk4-circle or rk8-circle (for a tolerance)."
        ),
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
) -> Report:
    """The motion from a release, and how far its end may be believed."""
    state = State(
        radians("theta1", theta1), radians("theta2", theta2), number("p1", p1), number("p2", p2)
    )
    write = writer(out) if out is not None else None
    if step is not None and step > 0 and (steps := abs(duration / step)) <= most_steps:
        tell_cost(steps, steps / _STEPS_A_SECOND, steps * _BYTES_A_STEP)
    how = {"step": step, "method": method, "tolerance": tolerance, "most_steps": most_steps}
    with clock("integrating"):
        motion = dpend.simulate(pendulum, state, duration, **how)
    if write is not None:
        write(motion)
    record = motion_record(motion)
    return record, partial(print_motion, record, motion.time.size, out), _converged(motion)


@command(app, print_json, name="map")
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
        str | None, typer.Option(help=f"One of {', '.join(METHODS)}, with --step.")
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
    if figure is not None:
        check_place("figure", figure, (".png",))
    started, counts = time.perf_counter(), [0, 0, 0]
    with complaints_of_stores(), bar(on_terminal(), "cells") as show:

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


@command(app, print_json)
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
    animation.check_out(out)
    releases = [
        dpend.released(radians("theta1", one), radians("theta2", two))
        for one, two in zip(theta1, theta2, strict=True)
    ]
    motions = animation.motions_for(pendulum, releases, duration, speed=speed)
    with bar(on_terminal(), "frames") as show:
        frames = animation.film(pendulum, motions, out, progress=show)
    record = {
        "frames": frames,
        "frames_per_second": animation.FRAMES_PER_SECOND if out.suffix != ".png" else None,
        "out": str(out),
        "motions": [motion_record(motion) for motion in motions],
    }
    pairs = list(zip(theta1, theta2, strict=True))
    return record, partial(print_films, record, pairs), _converged(*motions)


@command(app, print_json)
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
    if figure is not None:
        check_place("figure", figure, (".png",))
        if figure.resolve() == data.resolve():
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
    return record, partial(print_fit, record, figure), _converged(found)


def _keep_compiled_code() -> None:
    """Has JAX keep compiled code in the user's cache directory, or where the user chose: later runs
    start warm.
    """
    if jax.config.jax_compilation_cache_dir is not None:  # type: ignore[attr-defined]
        return
    chosen = os.environ.get("XDG_CACHE_HOME", "")
    try:
        # A relative path is no place at all: the XDG specification has it ignored.
        base = Path(chosen if os.path.isabs(chosen) else Path.home() / ".cache") / "dpend"
        base.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # nowhere to write, or a user without a home
        return
    if os.access(base, os.W_OK):
        jax.config.update("jax_compilation_cache_dir", str(base))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


def main(arguments: Sequence[str] | None = None) -> None:
    """The entry point: runs one command and exits with its status."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(
                errors="backslashreplace"
            )  # names of files may be no text in the terminal's encoding
    os.environ.pop("MPLBACKEND", None)  # for windows, of which the program opens none
    warnings.filterwarnings(
        "ignore", message=".*persistent compilation cache"
    )  # a cache only saves time
    catch_interrupts()
    status = _run(sys.argv[1:] if arguments is None else list(arguments))
    leave_quietly()
    if _flush() is not None:  # Python would try once more when it ends, and say so with a traceback
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(status)


def _flush() -> OSError | None:
    """Writes what was printed; why it could not be, if so."""
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError as error:
        return error
    return None


def _run(arguments: list[str]) -> int:
    try:
        # The process is this program's own, so that float64 is ours to switch on even where JAX is
        # to be left plain.
        if "JAX_ENABLE_X64" not in os.environ:
            jax.config.update("jax_enable_x64", True)
        _keep_compiled_code()
        with np.errstate(
            all="ignore"
        ):  # what overflows is told by the status or by the line that refuses it
            status = int(app(arguments or ["--help"], standalone_mode=False) or 0)
        lost = _flush()
        if isinstance(lost, BrokenPipeError):
            return 141
        if lost is not None:
            return tell_error(lost)
        return status
    except (KeyboardInterrupt, typer.Abort):
        return 130
    except (
        BrokenPipeError,
        SystemExit,
    ):  # the latter is typer's answer to a closed pipe, and to nothing else here
        return 141
    except typer.Exit as stop:
        return stop.exit_code
    except Exception as error:
        return tell_error(error)


if __name__ == "__main__":
    main()
