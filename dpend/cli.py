"""The command line: the only module that prints. Angles are in degrees here, and nowhere else but
in CSV and JSON.

Exit status 0: done. 1: ran, but some solve failed, or the environment is wrong. 2: bad input, one
line on standard error. 130: interrupted. 141: nobody reads standard output any more.
"""

import contextlib
import errno
import io
import math
import os
import re
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
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
from dpend.maps.store import StoreWarning, check_store
from dpend.mechanics.pendulum import Pendulum, State
from dpend.methods.scheme import METHODS
from dpend.motion.simulate import MOST_MOTION_STEPS
from dpend.orbits.find import swinging_pendulum
from dpend.orbits.orbit import BRANCHES, PeriodicOrbit
from dpend.records import parse_decimal, replacing
from dpend.report import (
    design_record,
    draw,
    draw_fit,
    family_record,
    fit_record,
    motion_record,
    on_terminal,
    orbit_record,
    print_atlas,
    print_design,
    print_family,
    print_fit,
    print_json,
    print_motion,
    print_orbits,
    write_family_csv,
    write_json,
    writer,
)
from dpend.status import Status


class _Command(typer.core.TyperCommand):
    """A command that refuses what no option can mean: one given twice, an empty text, a number that
    is not finite.
    """

    # Any: each version of typer has its own class of contexts.
    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        given, _, order = self.make_parser(ctx).parse_args(args=list(args))
        for option in self.params:
            name, times = max(option.opts, key=len), sum(option is one for one in order)
            if times > 1 and not option.multiple and option.nargs == 1:
                raise ValueError(
                    f"{name} must be given once at most, got it {times} times: leave out all but "
                    f"one"
                )
            if "" in _several(given.get(option.name or "")):
                raise ValueError(
                    f"{name} must not be empty, got '': give a value, or leave {name} out"
                )
        rest = super().parse_args(ctx, args)
        for option in self.params:
            unit = re.search(r"( \[[^]]+\]|)[^]]*$", getattr(option, "help", None) or "")
            for one in _several(ctx.params.get(option.name or "")):
                if isinstance(one, float) and not math.isfinite(one):
                    raise ValueError(
                        f"{option.name} must be a finite number{unit[1] if unit else ''}, got "
                        f"{one}: "
                        f"give another {option.name}"
                    )
        return rest


def _several(value: object) -> Sequence[object]:
    return value if isinstance(value, (list, tuple)) else (value,)


app = typer.Typer(
    name="dpend",
    help="The motions of a double pendulum that come back. Angles in degrees, everything else in "
    "SI units.",
    add_completion=False,
    rich_markup_mode=None,  # square brackets are units here
    pretty_exceptions_enable=False,
)


def _number(text: str | float | int) -> float:  # defaults come as what they are
    if not isinstance(text, str):
        return float(text)
    if text.lower().lstrip("+-") in ("nan", "inf", "infinity"):
        return float(text)  # the command refuses it by the name of its option
    try:
        return parse_decimal(text)
    except ValueError:
        raise typer.BadParameter(
            f"{text!r:.60} is not a number: give one like 40 or 1e-3"
        ) from None


# What a count fits in, here and in the compiled programs.
_LARGEST_INTEGER = 2**63 - 1


def _integer(text: str | int) -> int:
    if not isinstance(text, str):
        return text
    if not re.fullmatch(r"[+-]?\d+", text, re.ASCII):
        raise typer.BadParameter(f"{text!r:.60} is not an integer: give one like 1")
    if len(text) > 20 or abs(int(text)) > _LARGEST_INTEGER:
        raise typer.BadParameter(f"{text!r:.60} is beyond {_LARGEST_INTEGER}: give a smaller one")
    return int(text)


def _numeric(*names: str, help: str) -> Any:
    return typer.Option(*names, help=help, parser=_number, metavar="NUMBER")


_Length1 = Annotated[float, _numeric("--l1", help="Length of the upper rod [m].")]
_Length2 = Annotated[float, _numeric("--l2", help="Length of the lower rod [m].")]
_Mass1 = Annotated[float, _numeric("--m1", help="Mass of the upper bob [kg].")]
_Mass2 = Annotated[float, _numeric("--m2", help="Mass of the lower bob [kg].")]
_Gravity = Annotated[float, _numeric("--g", help="Acceleration of gravity [m/s^2].")]
_Json = Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")]
_Theta1 = Annotated[float, _numeric("--theta1", help="Release angle of the upper rod [deg].")]


@app.callback()
def _commands() -> None:
    """Keeps `dpend orbit` a subcommand."""


@app.command(cls=_Command)
def orbit(
    theta1: _Theta1,
    branch: Annotated[
        str | None,
        typer.Option(help="in-phase or anti-phase; both, if neither this nor a guess is given."),
    ] = None,
    theta2: Annotated[
        float | None, _numeric(help="Guess of the lower rod's release angle [deg].")
    ] = None,
    period: Annotated[float | None, _numeric(help="Guess of the period [s].")] = None,
    symmetry: Annotated[
        str | None, typer.Option(help="centred or brake, with a guess; found out if not given.")
    ] = None,
    ratio: Annotated[
        int | None,
        typer.Option(
            parser=_integer,
            metavar="INTEGER",
            help="1 or -1: theta2 = ratio theta1, the release nearest to THETA1.",
        ),
    ] = None,
    crossing: Annotated[
        int | None,
        typer.Option(
            parser=_integer,
            metavar="INTEGER",
            help="Which of the branch's passages through theta1; 1 if not given.",
        ),
    ] = None,
    l1: _Length1 = 0.2,
    l2: _Length2 = 0.2,
    m1: _Mass1 = 0.1,
    m2: _Mass2 = 0.1,
    g: _Gravity = 9.8,
    as_json: _Json = False,
) -> int:
    """The releases from rest at THETA1 that come back: partner angle, period, stability, error."""
    pendulum = Pendulum(l1, l2, m1, m2, g)
    release = _radians("theta1", theta1)
    if (theta2 is None) != (period is None):
        given, missing = ("theta2", "period") if period is None else ("period", "theta2")
        raise ValueError(
            f"{missing} must be given with {given}, got {given} alone: a guess is both"
        )
    guess = (
        None
        if theta2 is None
        else (_radians("theta2", theta2), number("period", period, positive=True, unit="s"))
    )
    if crossing is not None and branch is None:
        raise ValueError(
            f"crossing must go with branch, got {crossing} alone: give --branch "
            f"{' or '.join(BRANCHES)}"
        )
    passage = 1 if crossing is None else crossing
    both = branch is None and guess is None and ratio is None
    with _clock("following the branch" if guess is None else "solving"):
        found = {
            name: dpend.find_orbit(
                pendulum,
                release,
                branch=name,
                guess=guess,
                symmetry=symmetry,
                ratio=ratio,
                crossing=passage,
            )
            for name in (BRANCHES if both else (branch,))
        }
    records = [
        orbit_record(orbit) | ({"branch": name} if name else {}) for name, orbit in found.items()
    ]
    if as_json:
        print_json({"orbits": records} if both else records[0])
    else:
        print_orbits(pendulum, found)
    return 0 if all(int(orbit.status) == Status.CONVERGED for orbit in found.values()) else 1


@app.command(cls=_Command)
def family(
    branch: Annotated[str, typer.Option(help="in-phase (slow mode) or anti-phase (fast mode).")],
    out: Annotated[
        Path | None,
        typer.Option(help="Write all points to F.csv, or to F.json what --json prints."),
    ] = None,
    l1: _Length1 = 0.2,
    l2: _Length2 = 0.2,
    m1: _Mass1 = 0.1,
    m2: _Mass2 = 0.1,
    g: _Gravity = 9.8,
    as_json: _Json = False,
) -> int:
    """All orbits of a normal mode, from small swings to the upright pendulum, and where their
    stability changes.
    """
    if branch not in BRANCHES:
        raise ValueError(f"branch must be one of {', '.join(BRANCHES)}, got {branch!r}")
    formats = {".csv": write_family_csv, ".json": write_json}
    if out is not None:
        check_place("out", out, tuple(formats))
    with _clock("following the family"):
        found = dpend.follow_family(Pendulum(l1, l2, m1, m2, g), branch)
    record = family_record(found, branch)
    if out is not None:
        with replacing(out) as draft:
            formats[out.suffix](record, draft)
    if as_json:
        print_json(record)
    else:
        print_family(found, record, out)
    return 0 if int(found.status) == Status.CONVERGED else 1


@app.command(cls=_Command)
def atlas(
    max_period: Annotated[float, _numeric(help="The longest period [s].")],
    theta1: Annotated[
        float | None,
        _numeric(
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
        _numeric(
            help="Refuse a search that takes more time steps, or stop there: 1e9 take about an "
            "hour."
        ),
    ] = float(MOST_SEARCH_STEPS),
    l1: _Length1 = 0.2,
    l2: _Length2 = 0.2,
    m1: _Mass1 = 0.1,
    m2: _Mass2 = 0.1,
    g: _Gravity = 9.8,
    as_json: _Json = False,
) -> int:
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
    pendulum = Pendulum(l1, l2, m1, m2, g)
    steps = _steps_of_search(swinging_pendulum(pendulum), max_period, theta1)
    if steps <= most_steps:
        _tell_cost(steps, steps * SECONDS_PER_STEP)
    with _work("slices" if theta1 is None else "million steps") as show:
        if theta1 is not None:
            found = dpend.find_brake_orbits(
                pendulum,
                theta1=_radians("theta1", theta1),
                max_period=max_period,
                most_steps=most_steps,
                progress=lambda done, planned: show(done / 1e6, planned / 1e6),
            )
        else:
            found = dpend.find_brake_families(
                pendulum,
                max_period=max_period,
                store=store,
                most_steps=most_steps,
                progress=lambda done, planned, families: show(done, planned),
            )
    if out is not None:
        found.save(out)
    if as_json:
        print_json(found.record())
    else:
        print_atlas(found, theta1, out)
    families = all(family["status"] == Status.CONVERGED.name.lower() for family in found.families)
    solved = families and np.all(found.table["status"] == Status.CONVERGED)
    return 0 if solved and not (found.coverage.suspicious_cells or found.coverage.exhausted) else 1


# What is told before it is spent: more seconds, or bytes.
_LONG, _LARGE = 60.0, 1e9


def _tell_cost(steps: int | float, seconds: float, size: int | float = 0, more: str = "") -> None:
    """Says before it begins what takes more than a minute, or more than a gigabyte of `size`
    [bytes].
    """
    if seconds > _LONG or size > _LARGE:
        room = f" and {size / 1e9:.2g} GB" if size > _LARGE else ""
        _complain(
            f"about {steps:.1e} time steps, which may take {math.ceil(seconds / 60)} "
            f"minutes{room}{more}"
        )


def _steps_of_search(pendulum: Pendulum, max_period: float, theta1: float | None) -> int | float:
    known_period(pendulum, max_period)
    if theta1 is None:
        return survey.expected_steps(pendulum, max_period)
    return expected_steps(pendulum, max_period, _radians("theta1", theta1))


# Seconds between two lines about a search whose standard error is no terminal.
_BETWEEN_LINES = 15.0


@contextlib.contextmanager
def _work(unit: str) -> Iterator[Callable[[float, float], None]]:
    """A progress bar on standard error; where that is no terminal a line now and then."""
    with _bar(on_terminal(), unit) as show:
        started = last = time.perf_counter()

        def tell(done: int | float, planned: int | float) -> None:
            nonlocal last
            show(done, planned)
            if not on_terminal() and time.perf_counter() - last > _BETWEEN_LINES:
                last = time.perf_counter()
                print(
                    f"dpend: {done:.3g} of about {planned:.3g} {unit}, {last - started:.0f} s",
                    file=sys.stderr,
                )

        yield tell


@app.command(cls=_Command)
def design(
    theta1: _Theta1,
    branch: Annotated[
        str | None,
        typer.Option(help="in-phase or anti-phase: whose orbit --period and --kappa are about."),
    ] = None,
    period: Annotated[float | None, _numeric(help="Wanted period [s].")] = None,
    kappa: Annotated[
        float | None, _numeric(help="Wanted kappa: stable from -1 to 1, most so at 0.")
    ] = None,
    ratio: Annotated[
        float | None,
        _numeric(help="Wanted period of the in-phase orbit over that of the anti-phase orbit."),
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
    l1: _Length1 = 0.2,
    l2: _Length2 = 0.2,
    m1: _Mass1 = 0.1,
    m2: _Mass2 = 0.1,
    g: _Gravity = 9.8,
    as_json: _Json = False,
) -> int:
    """The pendulum nearest to this one whose orbit released at THETA1 has a wanted period,
    stability, or both.
    """
    start = Pendulum(l1, l2, m1, m2, g)
    equations, branches = _asked(branch, period, kappa, ratio)
    if not 0 < number("theta1", theta1, unit="deg") < 180:
        raise ValueError(
            f"theta1 must be between 0 and 180 deg, got {theta1:g}: give another theta1"
        )

    def loss(*orbits: PeriodicOrbit) -> Any:
        by_name = dict(zip(branches, orbits, strict=True))
        return jax.numpy.stack([equation(by_name) for equation in equations.values()])

    names, limits, angle = _names(free), _bounds(bounds or []), _radians("theta1", theta1)
    with _clock("designing"):
        found = dpend.design_pendulum(
            loss, start, names, branch=branches, theta1=angle, bounds=limits
        )
    record = design_record(found, start, branches, tuple(equations))
    if as_json:
        print_json(record)
    else:
        print_design(found, record, start, theta1)
    return 0 if int(found.status) == Status.CONVERGED else 1


# Of a motion at order 8 with its second pass, all states saved, on two cores.
_STEPS_A_SECOND, _BYTES_A_STEP = 5e4, 250


@app.command(cls=_Command)
def simulate(
    theta1: _Theta1,
    theta2: Annotated[float, _numeric(help="Release angle of the lower rod [deg].")],
    duration: Annotated[float, _numeric(help="How long [s]; negative runs backwards.")],
    p1: Annotated[
        float, _numeric("--p1", help="Canonical momentum of the upper angle [kg m^2/s].")
    ] = 0.0,
    p2: Annotated[
        float, _numeric("--p2", help="Canonical momentum of the lower angle [kg m^2/s].")
    ] = 0.0,
    method: Annotated[
        str | None,
        typer.Option(
            help="rk4, rk8 (default for a step), gauss, rk4-circle or rk8-circle (for a tolerance)."
        ),
    ] = None,
    step: Annotated[float | None, _numeric(help="Largest step [s].")] = None,
    tolerance: Annotated[
        float | None,
        _numeric(help="Wanted error of the angles [rad]; 1e-9 if no step is given either."),
    ] = None,
    most_steps: Annotated[
        int,
        typer.Option(parser=_integer, metavar="INTEGER", help="How many steps are taken at most."),
    ] = MOST_MOTION_STEPS,
    out: Annotated[
        Path | None, typer.Option(help="Write the motion to F.csv (degrees) or F.nc (radians).")
    ] = None,
    l1: _Length1 = 0.2,
    l2: _Length2 = 0.2,
    m1: _Mass1 = 0.1,
    m2: _Mass2 = 0.1,
    g: _Gravity = 9.8,
    as_json: _Json = False,
) -> int:
    """The motion from a release, and how far its end may be believed."""
    pendulum = Pendulum(l1, l2, m1, m2, g)
    state = State(
        _radians("theta1", theta1), _radians("theta2", theta2), number("p1", p1), number("p2", p2)
    )
    write = writer(out) if out is not None else None
    if step is not None and step > 0 and (steps := abs(duration / step)) <= most_steps:
        _tell_cost(steps, steps / _STEPS_A_SECOND, steps * _BYTES_A_STEP)
    with _clock("integrating"):
        motion = dpend.simulate(
            pendulum,
            state,
            duration,
            step=step,
            method=method,
            tolerance=tolerance,
            most_steps=most_steps,
        )
    if write is not None:
        write(motion)
    record = motion_record(motion)
    if as_json:
        print_json(record)
    else:
        print_motion(record, motion, out)
    return 0 if int(motion.status) == Status.CONVERGED else 1


@app.command(name="map", cls=_Command)
def map_command(
    quantity: Annotated[str, typer.Argument(help="lyapunov, megno, flip or drift.")],
    size: Annotated[str, typer.Option(metavar="N|NxM", help="Cells along theta1 and theta2.")],
    duration: Annotated[float, _numeric(help="How long each motion lasts [s].")],
    out: Annotated[
        Path,
        typer.Option(help="The Zarr store; one left unfinished by the same command is finished."),
    ],
    theta1: Annotated[str, typer.Option(metavar="A:B", help="Range of theta1 [deg].")] = "-180:180",
    theta2: Annotated[str, typer.Option(metavar="A:B", help="Range of theta2 [deg].")] = "-180:180",
    tolerance: Annotated[
        float | None,
        _numeric(help="Wanted error of the angles [rad]; 1e-6 if no method is given either."),
    ] = None,
    method: Annotated[
        str | None, typer.Option(help=f"One of {', '.join(METHODS)}, with --step.")
    ] = None,
    step: Annotated[float | None, _numeric(help="Step [s], with --method.")] = None,
    error: Annotated[
        str | None,
        typer.Option(help="half-step: a second pass at half the step, and an error for each cell."),
    ] = None,
    most_steps: Annotated[
        float,
        _numeric(
            "--most-steps",
            help="Refuse a map of more steps, or a motion of more than a millionth of it.",
        ),
    ] = 1e12,
    figure: Annotated[Path | None, typer.Option(help="Draw the map into P.png.")] = None,
    l1: _Length1 = 0.2,
    l2: _Length2 = 0.2,
    m1: _Mass1 = 0.1,
    m2: _Mass2 = 0.1,
    g: _Gravity = 9.8,
    as_json: _Json = False,
) -> int:
    """A map of the square of releases from rest: chaos, first flips or energy drift, cell by
    cell.
    """
    if quantity not in _MAPS:
        raise ValueError(f"map must be one of {', '.join(_MAPS)}, got {quantity!r}")
    if method is not None and method not in METHODS:
        raise ValueError(f"method must be one of {', '.join(METHODS)}, got {method!r}")
    duration = number("duration", duration, positive=True, unit="s")
    axes = {
        key: _cells(key, text, count)
        for key, text, count in zip(
            ("theta1", "theta2"), (theta1, theta2), _size(size), strict=True
        )
    }
    check_store("out", out)
    if figure is not None:
        check_place("figure", figure, (".png",))
    started, counts = time.perf_counter(), [0, 0, 0]
    with _complaints_of_stores(), _bar(on_terminal(), "cells") as show:

        def tell(*now: int) -> None:
            counts[:] = now
            show(*now)

        field = dpend.sweep(
            partial(_MAPS[quantity], duration=float(duration)),
            Pendulum(l1, l2, m1, m2, g),
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
    seconds = time.perf_counter() - started
    done, failed = _counts(field["status"])
    record = {
        "cells": int(field["status"].size),
        "done": done,
        "failed": failed,
        "seconds": seconds,
        "steps_per_second": counts[2] / seconds,
        "scheme": {"method": field.attrs["method"], "step_s": field.attrs["step"]},
        "out": str(out),
    }
    if figure is not None:
        draw(field, figure)
    if as_json:
        print_json(record)
    else:
        print(f"{record['cells']} cells in {seconds:.1f} s, {record['failed']} failed", end="; ")
        print(
            f"{record['steps_per_second']:.3g} steps/s of {field.attrs['method']}, "
            f"{field.attrs['step']:.4g} s"
        )
        print(f"written to {out}" + (f", drawn in {figure}" if figure else ""))
    return 0


@app.command(cls=_Command)
def animate(
    theta1: Annotated[
        list[float],
        _numeric("--theta1", help="Release angle of the upper rod [deg]; once a release."),
    ],
    theta2: Annotated[
        list[float],
        _numeric("--theta2", help="Release angle of the lower rod [deg]; once a release."),
    ],
    duration: Annotated[float, _numeric(help="How long the motion lasts [s].")],
    out: Annotated[Path, typer.Option(help="F.gif, F.mp4, or F.png with all pictures in one.")],
    speed: Annotated[float, _numeric(help="Seconds of the motion in a second of the film.")] = 1.0,
    l1: _Length1 = 0.2,
    l2: _Length2 = 0.2,
    m1: _Mass1 = 0.1,
    m2: _Mass2 = 0.1,
    g: _Gravity = 9.8,
    as_json: _Json = False,
) -> int:
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
    pendulum = Pendulum(l1, l2, m1, m2, g)
    releases = [
        dpend.released(_radians("theta1", one), _radians("theta2", two))
        for one, two in zip(theta1, theta2, strict=True)
    ]
    motions = animation.motions_for(pendulum, releases, duration, speed=speed)
    with _bar(on_terminal(), "frames") as show:
        frames = animation.film(pendulum, motions, out, progress=show)
    records = [motion_record(motion) for motion in motions]
    record = {
        "frames": frames,
        "frames_per_second": animation.FRAMES_PER_SECOND if out.suffix != ".png" else None,
        "out": str(out),
        "motions": records,
    }
    if as_json:
        print_json(record)
    else:
        print(
            f"{frames} frames of {len(motions)} motion{'s' * (len(motions) > 1)} written to {out}"
        )
        for one, two, motion in zip(theta1, theta2, records, strict=True):
            if motion["status"] != "converged":
                print(f"({one:g}, {two:g}) deg: {motion['status']}: {motion['message']}")
    return 0 if all(int(motion.status) == Status.CONVERGED for motion in motions) else 1


@app.command(cls=_Command)
def fit(
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
        float | None, _numeric(help="Standard deviation of the angles [deg], if it is known.")
    ] = None,
    figure: Annotated[
        Path | None, typer.Option(help="Draw data, fit and residuals into P.png.")
    ] = None,
    l1: _Length1 = 0.2,
    l2: _Length2 = 0.2,
    m1: _Mass1 = 0.1,
    m2: _Mass2 = 0.1,
    g: _Gravity = 9.8,
    as_json: _Json = False,
) -> int:
    """The pendulum whose motion is nearest to measured angles, from a guess of it; one rod or
    single cells may lack.
    """
    if figure is not None:
        check_place("figure", figure, (".png",))
        if figure.resolve() == data.resolve():
            raise ValueError(
                f"figure must be another file than data, got {figure} for both: give another name"
            )
    sigma = (
        None if noise is None else math.radians(number("noise", noise, positive=True, unit="deg"))
    )
    names = _names(free)
    times, theta1, theta2 = dpend.load_angles(data)
    with _clock("fitting"):
        found = dpend.fit_parameters(
            times,
            theta1,
            theta2,
            pendulum=Pendulum(l1, l2, m1, m2, g),
            free=names,
            initial=(None, None, 0.0, 0.0) if at_rest else (None,) * 4,
            noise=sigma,
        )
    if figure is not None:
        draw_fit(found, figure)
    record = fit_record(found)
    if as_json:
        print_json(record)
    else:
        print_fit(record, figure)
    return 0 if int(found.status) == Status.CONVERGED else 1


def _radians(name: str, degrees: float) -> float:
    return math.radians(number(name, degrees, unit="deg"))


def _asked(
    branch: str | None, period: float | None, kappa: float | None, ratio: float | None
) -> tuple[dict[str, Callable[[dict[str, PeriodicOrbit]], Any]], tuple[str, ...]]:
    """The equations of a design, each a function of the orbits by branch, and the branches whose
    orbits it takes.
    """
    if period is None and kappa is None and ratio is None:
        raise ValueError(
            "period, kappa or ratio must be given, got none of them: say what is wanted"
        )
    if branch is None and (period is not None or kappa is not None):
        raise ValueError(
            f"branch must be given with period and kappa, got none: give {' or '.join(BRANCHES)}"
        )
    if branch is not None and branch not in BRANCHES:
        raise ValueError(f"branch must be one of {', '.join(BRANCHES)}, got {branch!r}")
    if branch is not None and period is None and kappa is None:
        raise ValueError(f"branch must go with period or kappa, got {branch!r} with ratio alone, "
                         f"which is of both: "
                         "leave it out")  # fmt: skip
    equations: dict[str, Callable[[dict[str, PeriodicOrbit]], Any]] = {}
    if period is not None:
        seconds = float(number("period", period, positive=True, unit="s"))
        equations["period_s"] = lambda orbits: orbits[str(branch)].period - seconds
    if kappa is not None:
        middle = float(number("kappa", kappa))
        equations["kappa"] = lambda orbits: orbits[str(branch)].kappa - middle
    if ratio is not None:
        wanted = float(number("ratio", ratio, positive=True))
        equations["ratio"] = lambda orbits: (
            orbits["in-phase"].period / orbits["anti-phase"].period - wanted
        )
    return equations, BRANCHES if ratio is not None else (str(branch),)


def _names(text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(","))
    if "" in names:
        raise ValueError(
            f"free must be names with commas between them, got {text!r}: give them like l2,m2"
        )
    return names


def _bounds(texts: list[str]) -> dict[str, tuple[float, float]]:
    """Bounds by name, of theta1 in radians."""
    bounds = {}
    for text in texts:
        name, _, span = text.partition("=")
        try:
            low, high = (parse_decimal(part) for part in span.split(":"))
        except ValueError:
            raise ValueError(
                f"bounds must be NAME=A:B, got {text!r}: give one like l1=0.1:0.5"
            ) from None
        if name in bounds:
            raise ValueError(f"bounds must be given once a name, got {name} twice: leave one out")
        bounds[name] = (math.radians(low), math.radians(high)) if name == "theta1" else (low, high)
    return bounds


_MAPS = {
    "lyapunov": dpend.chaos.lyapunov,
    "megno": dpend.chaos.megno,
    "flip": dpend.chaos.flip,
    "drift": dpend.chaos.drift,
}


# Along a map's side: sixteen times what a large map has; beyond it lies a slip of the finger.
_MOST_CELLS = 65536


def _announce(cost: Cost) -> None:
    more = f", for {cost.cells} cells; stopped and started again, it goes on"
    _tell_cost(cost.steps, cost.seconds, cost.bytes, more)


@contextlib.contextmanager
def _complaints_of_stores() -> Iterator[None]:
    """Warnings about a store in one line each."""
    with warnings.catch_warnings():
        show = warnings.showwarning

        def tell(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
            if issubclass(category, StoreWarning):
                _complain(str(message))
            else:
                show(message, category, *where, **more)

        warnings.simplefilter("always", StoreWarning)
        warnings.showwarning = tell
        yield


# Rows of a map that are read at once, to be counted.
_ROWS = 256


def _counts(status: Any) -> tuple[int, int]:
    """How many cells are done, and how many of them failed."""
    done = failed = 0
    for start in range(0, status.shape[0], _ROWS):
        rows = status[start : start + _ROWS].values
        done += int(np.sum(rows != Status.NOT_COMPUTED))
        failed += int(np.sum((rows != Status.NOT_COMPUTED) & (rows != Status.CONVERGED)))
    return done, failed


def _size(text: str) -> tuple[int, int]:
    sides = text.lower().split("x")
    if len(sides) > 2 or not all(
        re.fullmatch(r"[0-9]{1,99}", side) and int(side) for side in sides
    ):
        raise ValueError(
            f"size must be N or NxM with whole numbers above zero, got {text!r}: give one like "
            f"512x256"
        )
    cells = int(sides[0]), int(sides[-1])
    if max(cells) > _MOST_CELLS:
        raise ValueError(
            f"size must be at most {_MOST_CELLS} along a side, got {text!r}: map a smaller range"
        )
    return cells


def _cells(name: str, text: str, count: int) -> np.ndarray:
    """The centres [rad] of `count` cells of a range A:B [deg]; a symmetric range is one half and
    its mirror image.
    """
    try:
        start, end = (float(part) for part in text.split(":"))
    except ValueError:
        raise ValueError(
            f"{name} must be a range A:B in degrees, got {text!r}: give one like -180:180"
        ) from None
    if not (math.isfinite(start) and math.isfinite(end) and start < end):
        raise ValueError(
            f"{name} must be a range A:B with A below B, got {text!r}: give one like -180:180"
        )
    centres = np.radians(start + (np.arange(count) + 0.5) * ((end - start) / count))
    return 0.5 * (centres - centres[::-1]) if start == -end else centres


@contextlib.contextmanager
def _bar(shown: bool, unit: str) -> Iterator[Callable[..., None]]:
    """A progress bar on standard error with the time left, and the rate where steps are told
    too.
    """
    if not shown:
        yield lambda done, total, steps=0: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.completed:.0f}/{task.total:.0f} " + unit),
        BarColumn(),
        TextColumn("{task.fields[rate]}"),
    )
    with Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True)) as progress:
        task, started = progress.add_task("", total=1, rate=""), time.perf_counter()

        def show(done: int, total: int, steps: int = 0) -> None:
            millions = steps / max(time.perf_counter() - started, 1e-9) / 1e6
            progress.update(
                task, completed=done, total=total, rate=f"{millions:.1f} M steps/s" if steps else ""
            )

        yield show


@contextlib.contextmanager
def _clock(doing: str) -> Iterator[None]:
    """What is being done and for how long, on a terminal: for what cannot tell how far it is."""
    if not on_terminal():
        yield
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = SpinnerColumn(), TextColumn(doing), TimeElapsedColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        progress.add_task("", total=None)
        yield


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


def _complain(text: str) -> None:
    if sys.stderr is not None:  # the shell may have closed it
        print("dpend: " + " ".join(text.split()), file=sys.stderr)


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
            return _tell(lost)
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
        return _tell(error)


def _tell(error: Exception) -> int:
    """One line about an error, and the exit status; a fault of this program is raised again."""
    # The command line's own errors know how to name the option they are about.
    usage = getattr(error, "format_message", None)
    if usage is not None:
        _complain(usage())
        return 2
    if isinstance(error, MemoryError):
        _complain(f"there is not enough memory ({error}): give fewer steps, cells or points")
        return 1
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EIO, errno.EBADF):
        _complain(
            f"{error.filename or 'standard output'} cannot be written ({error.strerror}): make "
            f"room for it"
        )
        return 1
    if not isinstance(error, (ValueError, OSError, RuntimeError)):
        raise error
    _complain(str(error))
    return 1 if isinstance(error, RuntimeError) else 2


if __name__ == "__main__":
    main()
