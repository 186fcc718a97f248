"""The command line: the only module that prints. Angles are in degrees here, and nowhere else but in CSV and JSON.

Exit status 0: done. 1: ran, but some solve failed, or the environment is wrong. 2: bad input, one line on standard
error. 130: interrupted. 141: nobody reads standard output any more.
"""

import contextlib
import csv
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
from typing import TYPE_CHECKING, Annotated, Any

import jax
import numpy as np
import typer

import dpend
from dpend import survey
from dpend._runtime import catch_interrupts, leave_quietly
from dpend.atlas import MOST_STEPS as MOST_STEPS_OF_SEARCH
from dpend.atlas import SECONDS_PER_STEP, expected_steps, known_period
from dpend.catalogue import pendulum_record
from dpend.checks import number
from dpend.files import check_place, json_text, parse_decimal, replacing
from dpend.orbits import BRANCHES, PeriodicOrbit, swinging_pendulum
from dpend.pendulum import Pendulum, State
from dpend.steppers import METHODS
from dpend.stores import StoreWarning, check_store
from dpend.sweeps import Cost
from dpend.trajectory import MOST_STEPS, Status, Trajectory

if TYPE_CHECKING:
    from rich.table import Table


class _Command(typer.core.TyperCommand):
    """A command that refuses what no option can mean: one given twice, an empty text, a number that is not finite."""

    # Any: each version of typer has its own class of contexts.
    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        given, _, order = self.make_parser(ctx).parse_args(args=list(args))
        for option in self.params:
            name, times = max(option.opts, key=len), sum(option is one for one in order)
            if times > 1 and not option.multiple and option.nargs == 1:
                raise ValueError(f"{name} must be given once at most, got it {times} times: leave out all but one")
            if "" in _several(given.get(option.name or "")):
                raise ValueError(f"{name} must not be empty, got '': give a value, or leave {name} out")
        rest = super().parse_args(ctx, args)
        for option in self.params:
            unit = re.search(r"( \[[^]]+\]|)[^]]*$", getattr(option, "help", None) or "")
            for one in _several(ctx.params.get(option.name or "")):
                if isinstance(one, float) and not math.isfinite(one):
                    raise ValueError(
                        f"{option.name} must be a finite number{unit[1] if unit else ''}, got {one}: "
                        f"give another {option.name}"
                    )
        return rest


def _several(value: object) -> Sequence[object]:
    return value if isinstance(value, (list, tuple)) else (value,)


app = typer.Typer(
    name="dpend",
    help="The motions of a double pendulum that come back. Angles in degrees, everything else in SI units.",
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
        raise typer.BadParameter(f"{text!r:.60} is not a number: give one like 40 or 1e-3") from None


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
        str | None, typer.Option(help="in-phase or anti-phase; both, if neither this nor a guess is given.")
    ] = None,
    theta2: Annotated[float | None, _numeric(help="Guess of the lower rod's release angle [deg].")] = None,
    period: Annotated[float | None, _numeric(help="Guess of the period [s].")] = None,
    symmetry: Annotated[
        str | None, typer.Option(help="centred or brake, with a guess; found out if not given.")
    ] = None,
    ratio: Annotated[
        int | None,
        typer.Option(
            parser=_integer, metavar="INTEGER", help="1 or -1: theta2 = ratio theta1, the release nearest to THETA1."
        ),
    ] = None,
    crossing: Annotated[
        int | None,
        typer.Option(
            parser=_integer, metavar="INTEGER", help="Which of the branch's passages through theta1; 1 if not given."
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
        raise ValueError(f"{missing} must be given with {given}, got {given} alone: a guess is both")
    guess = None if theta2 is None else (_radians("theta2", theta2), number("period", period, positive=True, unit="s"))
    if crossing is not None and branch is None:
        raise ValueError(f"crossing must go with branch, got {crossing} alone: give --branch {' or '.join(BRANCHES)}")
    passage = 1 if crossing is None else crossing
    both = branch is None and guess is None and ratio is None
    with _clock("following the branch" if guess is None else "solving"):
        found = {
            name: dpend.find_orbit(
                pendulum, release, branch=name, guess=guess, symmetry=symmetry, ratio=ratio, crossing=passage
            )
            for name in (BRANCHES if both else (branch,))
        }
    records = [_orbit_record(orbit) | ({"branch": name} if name else {}) for name, orbit in found.items()]
    if as_json:
        _print_json({"orbits": records} if both else records[0])
    else:
        _print_orbits(pendulum, found)
    return 0 if all(int(orbit.status) == Status.CONVERGED for orbit in found.values()) else 1


@app.command(cls=_Command)
def family(
    branch: Annotated[str, typer.Option(help="in-phase (slow mode) or anti-phase (fast mode).")],
    out: Annotated[
        Path | None, typer.Option(help="Write all points to F.csv, or to F.json what --json prints.")
    ] = None,
    l1: _Length1 = 0.2,
    l2: _Length2 = 0.2,
    m1: _Mass1 = 0.1,
    m2: _Mass2 = 0.1,
    g: _Gravity = 9.8,
    as_json: _Json = False,
) -> int:
    """All orbits of a normal mode, from small swings to the upright pendulum, and where their stability changes."""
    if branch not in BRANCHES:
        raise ValueError(f"branch must be one of {', '.join(BRANCHES)}, got {branch!r}")
    formats = {".csv": _write_family_csv, ".json": _write_json}
    if out is not None:
        check_place("out", out, tuple(formats))
    with _clock("following the family"):
        found = dpend.follow_family(Pendulum(l1, l2, m1, m2, g), branch)
    record = _family_record(found, branch)
    if out is not None:
        with replacing(out) as draft:
            formats[out.suffix](record, draft)
    if as_json:
        _print_json(record)
    else:
        _print_family(found, record, out)
    return 0 if int(found.status) == Status.CONVERGED else 1


@app.command(cls=_Command)
def atlas(
    max_period: Annotated[float, _numeric(help="The longest period [s].")],
    theta1: Annotated[
        float | None, _numeric("--theta1", help="Release angle of the upper rod [deg]; the whole square without it.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Write the atlas to F.csv or F.json.")] = None,
    store: Annotated[
        Path | None, typer.Option(help="Of the whole square: F.json, from which a search that was stopped goes on.")
    ] = None,
    most_steps: Annotated[
        float, _numeric(help="Refuse a search that takes more time steps, or stop there: 1e9 take about an hour.")
    ] = float(MOST_STEPS_OF_SEARCH),
    l1: _Length1 = 0.2,
    l2: _Length2 = 0.2,
    m1: _Mass1 = 0.1,
    m2: _Mass2 = 0.1,
    g: _Gravity = 9.8,
    as_json: _Json = False,
) -> int:
    """Every orbit released from rest up to a period: of one release angle, or all families of the whole square."""
    if theta1 is not None and store is not None:
        raise ValueError(f"store goes with the whole square, got {store} with theta1: leave out either")
    if out is not None:
        check_place("out", out, (".csv", ".json"))
        if store is not None and out.resolve() == store.resolve():
            raise ValueError(f"out must be another file than store, got {out} for both: give another name")
    pendulum = Pendulum(l1, l2, m1, m2, g)
    _tell_cost(swinging_pendulum(pendulum), max_period, theta1, most_steps)
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
        _print_json(found.record())
    else:
        _print_atlas(found, theta1, out)
    families = all(family["status"] == Status.CONVERGED.name.lower() for family in found.families)
    solved = families and np.all(found.table["status"] == Status.CONVERGED)
    return 0 if solved and not (found.coverage.suspicious_cells or found.coverage.exhausted) else 1


# What is told before it is spent: more seconds, or bytes.
_LONG, _LARGE = 60.0, 1e9


def _tell_cost(pendulum: Pendulum, max_period: float, theta1: float | None, most_steps: float) -> None:
    known_period(pendulum, max_period)
    if theta1 is None:
        steps = survey.expected_steps(pendulum, max_period)
    else:
        steps = expected_steps(pendulum, max_period, _radians("theta1", theta1))
    if steps <= most_steps and steps * SECONDS_PER_STEP > _LONG:
        minutes = math.ceil(steps * SECONDS_PER_STEP / 60)
        print(f"dpend: this takes about {steps:.1g} time steps, some {minutes} minutes", file=sys.stderr)


# Seconds between two lines about a search whose standard error is no terminal.
_BETWEEN_LINES = 15.0


@contextlib.contextmanager
def _work(unit: str) -> Iterator[Callable[[float, float], None]]:
    """A progress bar on standard error; where that is no terminal a line now and then."""
    with _bar(_on_terminal(), unit) as show:
        started = last = time.perf_counter()

        def tell(done: float, planned: float) -> None:
            nonlocal last
            show(done, planned)
            if not _on_terminal() and time.perf_counter() - last > _BETWEEN_LINES:
                last = time.perf_counter()
                print(f"dpend: {done:.3g} of about {planned:.3g} {unit}, {last - started:.0f} s", file=sys.stderr)

        yield tell


@app.command(cls=_Command)
def design(
    theta1: _Theta1,
    branch: Annotated[
        str | None, typer.Option(help="in-phase or anti-phase: whose orbit --period and --kappa are about.")
    ] = None,
    period: Annotated[float | None, _numeric(help="Wanted period [s].")] = None,
    kappa: Annotated[float | None, _numeric(help="Wanted kappa: stable from -1 to 1, most so at 0.")] = None,
    ratio: Annotated[
        float | None, _numeric(help="Wanted period of the in-phase orbit over that of the anti-phase orbit.")
    ] = None,
    free: Annotated[str, typer.Option(metavar="NAMES", help="What may change, of l1,l2,m1,m2,g,theta1.")] = "l1,l2",
    bounds: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=A:B", help="Bounds of one of them (theta1 in degrees); once a name."),
    ] = None,
    l1: _Length1 = 0.2,
    l2: _Length2 = 0.2,
    m1: _Mass1 = 0.1,
    m2: _Mass2 = 0.1,
    g: _Gravity = 9.8,
    as_json: _Json = False,
) -> int:
    """The pendulum nearest to this one whose orbit released at THETA1 has a wanted period, stability, or both."""
    start = Pendulum(l1, l2, m1, m2, g)
    equations, branches = _asked(branch, period, kappa, ratio)
    if not 0 < number("theta1", theta1, unit="deg") < 180:
        raise ValueError(f"theta1 must be between 0 and 180 deg, got {theta1:g}: give another theta1")

    def loss(*orbits: PeriodicOrbit) -> Any:
        by_name = dict(zip(branches, orbits, strict=True))
        return jax.numpy.stack([equation(by_name) for equation in equations.values()])

    names, limits, angle = _names(free), _bounds(bounds or []), _radians("theta1", theta1)
    with _clock("designing"):
        found = dpend.design_pendulum(loss, start, names, branch=branches, theta1=angle, bounds=limits)
    record = _design_record(found, start, branches, tuple(equations))
    if as_json:
        _print_json(record)
    else:
        _print_design(found, record, start, theta1)
    return 0 if int(found.status) == Status.CONVERGED else 1


# Of a motion at order 8 with its second pass, all states saved, on two cores.
_STEPS_A_SECOND, _BYTES_A_STEP = 5e4, 250


@app.command(cls=_Command)
def simulate(
    theta1: _Theta1,
    theta2: Annotated[float, _numeric(help="Release angle of the lower rod [deg].")],
    duration: Annotated[float, _numeric(help="How long [s]; negative runs backwards.")],
    p1: Annotated[float, _numeric("--p1", help="Canonical momentum of the upper angle [kg m^2/s].")] = 0.0,
    p2: Annotated[float, _numeric("--p2", help="Canonical momentum of the lower angle [kg m^2/s].")] = 0.0,
    method: Annotated[
        str | None,
        typer.Option(help="rk4, rk8 (default for a step), gauss, rk4-circle or rk8-circle (for a tolerance)."),
    ] = None,
    step: Annotated[float | None, _numeric(help="Largest step [s].")] = None,
    tolerance: Annotated[
        float | None, _numeric(help="Wanted error of the angles [rad]; 1e-9 if no step is given either.")
    ] = None,
    most_steps: Annotated[
        int, typer.Option(parser=_integer, metavar="INTEGER", help="How many steps are taken at most.")
    ] = MOST_STEPS,
    out: Annotated[Path | None, typer.Option(help="Write the motion to F.csv (degrees) or F.nc (radians).")] = None,
    l1: _Length1 = 0.2,
    l2: _Length2 = 0.2,
    m1: _Mass1 = 0.1,
    m2: _Mass2 = 0.1,
    g: _Gravity = 9.8,
    as_json: _Json = False,
) -> int:
    """The motion from a release, and how far its end may be believed."""
    pendulum = Pendulum(l1, l2, m1, m2, g)
    state = State(_radians("theta1", theta1), _radians("theta2", theta2), number("p1", p1), number("p2", p2))
    write = _writer(out) if out is not None else None
    if step is not None and step > 0 and MOST_STEPS < abs(duration / step) <= most_steps:
        seconds = abs(duration / step) / _STEPS_A_SECOND
        _complain(f"{abs(duration / step):,.0f} steps take some {seconds / 60:.0f} minutes and "
                  f"{_BYTES_A_STEP * seconds * _STEPS_A_SECOND / 1e9:.0f} GB")  # fmt: skip
    with _clock("integrating"):
        motion = dpend.simulate(
            pendulum, state, duration, step=step, method=method, tolerance=tolerance, most_steps=most_steps
        )
    if write is not None:
        write(motion)
    record = _motion_record(motion)
    if as_json:
        _print_json(record)
    else:
        _print_motion(record, motion, out)
    return 0 if int(motion.status) == Status.CONVERGED else 1


@app.command(name="map", cls=_Command)
def map_command(
    quantity: Annotated[str, typer.Argument(help="lyapunov, megno, flip or drift.")],
    size: Annotated[str, typer.Option(metavar="N|NxM", help="Cells along theta1 and theta2.")],
    duration: Annotated[float, _numeric(help="How long each motion lasts [s].")],
    out: Annotated[Path, typer.Option(help="The Zarr store; one left unfinished by the same command is finished.")],
    theta1: Annotated[str, typer.Option(metavar="A:B", help="Range of theta1 [deg].")] = "-180:180",
    theta2: Annotated[str, typer.Option(metavar="A:B", help="Range of theta2 [deg].")] = "-180:180",
    tolerance: Annotated[
        float | None, _numeric(help="Wanted error of the angles [rad]; 1e-6 if no method is given either.")
    ] = None,
    method: Annotated[str | None, typer.Option(help=f"One of {', '.join(METHODS)}, with --step.")] = None,
    step: Annotated[float | None, _numeric(help="Step [s], with --method.")] = None,
    error: Annotated[
        str | None, typer.Option(help="half-step: a second pass at half the step, and an error for each cell.")
    ] = None,
    most_steps: Annotated[
        float, _numeric("--most-steps", help="Refuse a map of more steps, or a motion of more than a millionth of it.")
    ] = 1e12,
    figure: Annotated[Path | None, typer.Option(help="Draw the map into P.png.")] = None,
    l1: _Length1 = 0.2,
    l2: _Length2 = 0.2,
    m1: _Mass1 = 0.1,
    m2: _Mass2 = 0.1,
    g: _Gravity = 9.8,
    as_json: _Json = False,
) -> int:
    """A map of the square of releases from rest: chaos, first flips or energy drift, cell by cell."""
    if quantity not in _MAPS:
        raise ValueError(f"map must be one of {', '.join(_MAPS)}, got {quantity!r}")
    if method is not None and method not in METHODS:
        raise ValueError(f"method must be one of {', '.join(METHODS)}, got {method!r}")
    duration = number("duration", duration, positive=True, unit="s")
    axes = {
        key: _cells(key, text, count)
        for key, text, count in zip(("theta1", "theta2"), (theta1, theta2), _size(size), strict=True)
    }
    check_store("out", out)
    if figure is not None:
        check_place("figure", figure, (".png",))
    started, counts = time.perf_counter(), [0, 0, 0]
    with _complaints_of_stores(), _bar(_on_terminal(), "cells") as show:

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
        _draw(field, figure)
    if as_json:
        _print_json(record)
    else:
        print(f"{record['cells']} cells in {seconds:.1f} s, {record['failed']} failed", end="; ")
        print(f"{record['steps_per_second']:.3g} steps/s of {field.attrs['method']}, {field.attrs['step']:.4g} s")
        print(f"written to {out}" + (f", drawn in {figure}" if figure else ""))
    return 0


@app.command(cls=_Command)
def animate(
    theta1: Annotated[list[float], _numeric("--theta1", help="Release angle of the upper rod [deg]; once a release.")],
    theta2: Annotated[list[float], _numeric("--theta2", help="Release angle of the lower rod [deg]; once a release.")],
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
    """A film of a motion in real time; of several, in one picture, where --theta1 and --theta2 are given again."""
    from dpend import animate as animation

    if len(theta1) != len(theta2):
        raise ValueError(
            f"theta1 and theta2 must be given equally often, got {len(theta1)} and {len(theta2)}: a release is both"
        )
    animation.check_out(out)
    pendulum = Pendulum(l1, l2, m1, m2, g)
    releases = [
        dpend.released(_radians("theta1", one), _radians("theta2", two))
        for one, two in zip(theta1, theta2, strict=True)
    ]
    motions = animation.motions_for(pendulum, releases, duration, speed=speed)
    with _bar(_on_terminal(), "frames") as show:
        frames = animation.film(pendulum, motions, out, progress=show)
    records = [_motion_record(motion) for motion in motions]
    record = {
        "frames": frames,
        "frames_per_second": animation.FRAMES_PER_SECOND if out.suffix != ".png" else None,
        "out": str(out),
        "motions": records,
    }
    if as_json:
        _print_json(record)
    else:
        print(f"{frames} frames of {len(motions)} motion{'s' * (len(motions) > 1)} written to {out}")
        for one, two, motion in zip(theta1, theta2, records, strict=True):
            if motion["status"] != "converged":
                print(f"({one:g}, {two:g}) deg: {motion['status']}: {motion['message']}")
    return 0 if all(int(motion.status) == Status.CONVERGED for motion in motions) else 1


@app.command(cls=_Command)
def fit(
    data: Annotated[Path, typer.Argument(help="A CSV file with columns time_s, theta1_deg, theta2_deg.")],
    free: Annotated[str, typer.Option(help="What to estimate, of l1, l2, m1, m2, g; the rest is held.")] = "l2,m2,g",
    at_rest: Annotated[
        bool, typer.Option("--at-rest", help="The motion was released from rest at the first time.")
    ] = False,
    noise: Annotated[float | None, _numeric(help="Standard deviation of the angles [deg], if it is known.")] = None,
    figure: Annotated[Path | None, typer.Option(help="Draw data, fit and residuals into P.png.")] = None,
    l1: _Length1 = 0.2,
    l2: _Length2 = 0.2,
    m1: _Mass1 = 0.1,
    m2: _Mass2 = 0.1,
    g: _Gravity = 9.8,
    as_json: _Json = False,
) -> int:
    """The pendulum whose motion is nearest to measured angles, from a guess of it; one rod or single cells may lack."""
    if figure is not None:
        check_place("figure", figure, (".png",))
        if figure.resolve() == data.resolve():
            raise ValueError(f"figure must be another file than data, got {figure} for both: give another name")
    sigma = None if noise is None else math.radians(number("noise", noise, positive=True, unit="deg"))
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
        _draw_fit(found, figure)
    record = _fit_record(found)
    if as_json:
        _print_json(record)
    else:
        _print_fit(record, figure)
    return 0 if int(found.status) == Status.CONVERGED else 1


# --- what is read ----------------------------------------------------------------------------------------------------


def _radians(name: str, degrees: float) -> float:
    return math.radians(number(name, degrees, unit="deg"))


def _asked(
    branch: str | None, period: float | None, kappa: float | None, ratio: float | None
) -> tuple[dict[str, Callable[[dict[str, PeriodicOrbit]], Any]], tuple[str, ...]]:
    """The equations of a design, each a function of the orbits by branch, and the branches whose orbits it takes."""
    if period is None and kappa is None and ratio is None:
        raise ValueError("period, kappa or ratio must be given, got none of them: say what is wanted")
    if branch is None and (period is not None or kappa is not None):
        raise ValueError(f"branch must be given with period and kappa, got none: give {' or '.join(BRANCHES)}")
    if branch is not None and branch not in BRANCHES:
        raise ValueError(f"branch must be one of {', '.join(BRANCHES)}, got {branch!r}")
    if branch is not None and period is None and kappa is None:
        raise ValueError(f"branch must go with period or kappa, got {branch!r} with ratio alone, which is of both: "
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
        equations["ratio"] = lambda orbits: orbits["in-phase"].period / orbits["anti-phase"].period - wanted
    return equations, BRANCHES if ratio is not None else (str(branch),)


def _names(text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(","))
    if "" in names:
        raise ValueError(f"free must be names with commas between them, got {text!r}: give them like l2,m2")
    return names


def _bounds(texts: list[str]) -> dict[str, tuple[float, float]]:
    """Bounds by name, of theta1 in radians."""
    bounds = {}
    for text in texts:
        name, _, span = text.partition("=")
        try:
            low, high = (parse_decimal(part) for part in span.split(":"))
        except ValueError:
            raise ValueError(f"bounds must be NAME=A:B, got {text!r}: give one like l1=0.1:0.5") from None
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
    if cost.seconds > _LONG or cost.bytes > _LARGE:
        _complain(
            f"{cost.cells} cells to compute, about {cost.steps:.1e} steps, which may take {cost.seconds / 60:.0f} "
            f"minutes, and values of {cost.bytes / 1e9:.2g} GB; stopped and started again, it goes on"
        )


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
    if len(sides) > 2 or not all(re.fullmatch(r"[0-9]{1,99}", side) and int(side) for side in sides):
        raise ValueError(f"size must be N or NxM with whole numbers above zero, got {text!r}: give one like 512x256")
    cells = int(sides[0]), int(sides[-1])
    if max(cells) > _MOST_CELLS:
        raise ValueError(f"size must be at most {_MOST_CELLS} along a side, got {text!r}: map a smaller range")
    return cells


def _cells(name: str, text: str, count: int) -> np.ndarray:
    """The centres [rad] of `count` cells of a range A:B [deg]; a symmetric range is one half and its mirror image."""
    try:
        start, end = (float(part) for part in text.split(":"))
    except ValueError:
        raise ValueError(f"{name} must be a range A:B in degrees, got {text!r}: give one like -180:180") from None
    if not (math.isfinite(start) and math.isfinite(end) and start < end):
        raise ValueError(f"{name} must be a range A:B with A below B, got {text!r}: give one like -180:180")
    centres = np.radians(start + (np.arange(count) + 0.5) * ((end - start) / count))
    return 0.5 * (centres - centres[::-1]) if start == -end else centres


def _on_terminal() -> bool:
    return sys.stderr is not None and sys.stderr.isatty()


@contextlib.contextmanager
def _bar(shown: bool, unit: str) -> Iterator[Callable[..., None]]:
    """A progress bar on standard error with the time left, and the rate where steps are told too."""
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
            progress.update(task, completed=done, total=total, rate=f"{millions:.1f} M steps/s" if steps else "")

        yield show


@contextlib.contextmanager
def _clock(doing: str) -> Iterator[None]:
    """What is being done and for how long, on a terminal: for what cannot tell how far it is."""
    if not _on_terminal():
        yield
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = SpinnerColumn(), TextColumn(doing), TimeElapsedColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        progress.add_task("", total=None)
        yield


# --- what is printed -------------------------------------------------------------------------------------------------


def _orbit_record(orbit: PeriodicOrbit) -> dict[str, Any]:
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
        "dual": {"theta1_deg": _degrees(orbit.dual.theta1), "theta2_deg": _degrees(orbit.dual.theta2)},
        "turns": [int(turn) for turn in orbit.turns],
        "error_estimate": {"theta2_deg": _degrees(angle_error), "period_s": float(period_error)},
        "pendulum": pendulum_record(orbit.pendulum),
    }


def _family_record(family: dpend.Family, branch: str) -> dict[str, Any]:
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
        "points": [dict(zip(columns, row, strict=True)) | {"symmetry": family.symmetry} for row in rows],
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
        "pendulum": pendulum_record(Pendulum(*(leaf[0] for leaf in jax.tree.leaves(orbits.pendulum)))),
    }


def _motion_record(motion: Trajectory) -> dict[str, Any]:
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


def _design_record(
    found: dpend.Design, start: Pendulum, branches: tuple[str, ...], equations: tuple[str, ...]
) -> dict[str, Any]:
    status = Status(int(found.status))
    units = {"theta2_deg": ("theta2", math.degrees(1.0)), "period_s": ("period", 1.0), "kappa": ("kappa", 1.0)}
    orbits = []
    for i, (name, orbit) in enumerate(zip(branches, found.orbits, strict=True)):
        slopes = {
            key: {parameter: unit * float(np.atleast_1d(row)[i]) for parameter, row in found.sensitivities[of].items()}
            for key, (of, unit) in units.items()
        }
        orbits.append(_orbit_record(orbit) | {"branch": name, "sensitivities": slopes})
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
    "l1": ("l1_m", 1.0), "l2": ("l2_m", 1.0), "m1": ("m1_kg", 1.0), "m2": ("m2_kg", 1.0), "g": ("g_m_s2", 1.0),
    "l2/l1": ("l2/l1", 1.0), "m2/m1": ("m2/m1", 1.0), "g/l1": ("g/l1_s-2", 1.0),
    "theta1": ("theta1_deg", math.degrees(1.0)), "theta2": ("theta2_deg", math.degrees(1.0)),
    "omega1": ("omega1_deg_s", math.degrees(1.0)), "omega2": ("omega2_deg_s", math.degrees(1.0)),
}  # fmt: skip


def _fit_record(fit: dpend.Fit) -> dict[str, Any]:
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


def _print_json(record: dict[str, Any]) -> None:
    print(json_text(record))


# Wider than any table here: a number is never broken to fit a terminal.
_TABLE_WIDTH = 200


def _print_table(table: "Table") -> None:
    from rich.console import Console

    console = Console(width=_TABLE_WIDTH, highlight=False)
    with console.capture() as text:
        console.print(table)
    print(text.get(), end="")


def _print_orbits(pendulum: Pendulum, found: dict[str | None, PeriodicOrbit]) -> None:
    from rich.table import Table

    table = Table(title=_described(pendulum), title_justify="left", title_style="")
    for heading in ("", "theta1 (deg)", "theta2 (deg)", "period (s)", "stability", "kappa", "error (deg, s)"):
        table.add_column(heading, justify="left" if heading in ("", "stability") else "right")
    failures = []
    for name, orbit in found.items():
        record = _orbit_record(orbit)
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


def _print_family(family: dpend.Family, record: dict[str, Any], out: Path | None) -> None:
    from rich.table import Table

    pendulum = Pendulum(*record["pendulum"].values())
    table = Table(title=_described(pendulum), title_justify="left", title_style="")
    headings = ("theta1 (deg)", "theta2 (deg)", "period (s)", "energy (J)", "stability", "log |kappa|", "")
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
    print(f"{len(points)} orbits from {family.ends[0]} to {family.ends[1]}; error of theta2 at most {worst:.0e} deg")
    if int(family.status) != Status.CONVERGED:
        print(f"{record['status']}: {record['message']}")
    if out is not None:
        print(f"written to {out}")


def _print_atlas(atlas: dpend.Atlas, theta1: float | None, out: Path | None) -> None:
    from rich.table import Table

    table = Table(title=_described(atlas.pendulum), title_justify="left", title_style="")
    headings: tuple[str, ...] = ("family", "periods (s)", "from", "to", "orbits")
    rows = [_family_row(atlas, one) for one in atlas.families]
    what = f"{len(atlas.families)} families with {len(atlas)} orbits in the table"
    if theta1 is not None:
        headings = ("theta2 (deg)", "period (s)", "symmetry", "stability", "kappa", "dual (deg)", "error (deg)")
        rows = [_atlas_row(orbit) for orbit in atlas.orbits]
        what = f"{len(atlas)} orbits with theta1 = {theta1:g} deg"
    for heading in headings:
        table.add_column(heading, justify="left" if heading in _WORDS else "right")
    for row in rows:
        table.add_row(*row)
    _print_table(table)
    seen = atlas.coverage
    print(f"{what} and periods of at most {atlas.max_period:g} s", end="; ")
    print(f"{seen.slices} slice{'s' * (seen.slices > 1)}, {seen.theta2_points} motions, {seen.time_points} times")
    agree = "agree" if seen.degree == seen.winding else "DISAGREE: a return is missing"
    if seen.exhausted:
        print("STOPPED at the most time steps allowed: more is likely to be missing; raise --most-steps")
    print(f"{seen.suspicious_cells} suspicious cells; the signs of all returns and the winding number {agree}")
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


def _print_fit(record: dict[str, Any], figure: Path | None) -> None:
    errors = record["standard_errors"]
    for name, value in record["estimates"].items():
        error = errors[name]
        known = "held" if error == 0 else "not determined" if error == math.inf else f"+- {error:.2g}"
        print(f"{name:14}{value:16.{_decimals(error)}f}  {known}")
    print(f"{record['angles']} angles over {record['duration_s']:g} s; noise {record['noise_deg']:.3g} deg", end="")
    print(f", of which {record['expected_noise_deg']:.3g} deg was expected")
    if record["status"] != "converged":
        print(f"{record['status']}: {record['message']}")
    if figure is not None:
        print(f"drawn in {figure}")


def _decimals(error: float) -> int:
    """As many as show two digits of the error, and six where there is none."""
    return 6 if not 0 < error < math.inf else min(max(1 - math.floor(math.log10(error)), 0), 12)


def _described(pendulum: Pendulum) -> str:
    values = (float(value) for value in jax.tree.leaves(pendulum))
    return "l1 = {:g} m, l2 = {:g} m, m1 = {:g} kg, m2 = {:g} kg, g = {:g} m/s^2, released from rest".format(*values)


def _print_design(found: dpend.Design, record: dict[str, Any], start: Pendulum, theta1: float) -> None:
    from rich.table import Table

    branches = (orbit["branch"] for orbit in record["orbits"])
    _print_orbits(found.pendulum, dict(zip(branches, found.orbits, strict=True)))
    table = Table(title="derivatives with respect to the logarithms", title_justify="left", title_style="")
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
        slopes = [orbit["sensitivities"][key][name] for orbit in record["orbits"] for key in _SLOPES]
        row = [f"{float(before):g}", f"{float(after):.10g}", *(f"{slope:.6g}" for slope in slopes)]
        table.add_row(f"{name} ({unit})", *row)
    _print_table(table)
    missed = ", ".join(f"{name} {value:.0e}" for name, value in record["missed"].items())
    print(f"{record['iterations']} steps, {record['looks']} solves; misses {missed}; logarithms changed by", end=" ")
    print(f"{record['distance']:.6g}" + (f"; at bounds: {', '.join(found.at_bounds)}" if found.at_bounds else ""))
    if record["status"] != "converged":
        print(f"{record['status']}: {record['message']}")


_SLOPES = ("period_s", "kappa", "theta2_deg")


def _print_motion(record: dict[str, Any], motion: Trajectory, out: Path | None) -> None:
    final = record["final"]
    angles = f"theta1 = {final['theta1_deg']:.9f} deg, theta2 = {final['theta2_deg']:.9f} deg"
    print(f"after {record['duration_s']:g} s   {angles}")
    print(f"                p1 = {final['p1']:.12g}, p2 = {final['p2']:.12g} kg m^2/s")
    print(f"error estimate  {record['error_estimate']:.1e} rad, energy drift {record['energy_drift']:.1e} of its scale")
    print(f"integrated by   {record['method']}, {record['steps']} steps of {record['step_s']:.4g} s")
    if record["status"] != "converged":
        print(f"{record['status']}: {record['message']}")
    if out is not None:
        print(f"written to      {out}: {motion.time.size} times")


# --- what is written -------------------------------------------------------------------------------------------------


def _writer(path: Path) -> Callable[[Trajectory], None]:
    """How to write a motion to `path`; refuses before anything is computed what could not be written after."""
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


def _write_family_csv(record: dict[str, Any], path: Path) -> None:
    with path.open("w", newline="") as file:
        rows = csv.DictWriter(file, record["points"][0])
        rows.writeheader()
        rows.writerows(record["points"])


def _write_json(record: dict[str, Any], path: Path) -> None:
    path.write_text(json_text(record) + "\n")


def _write_netcdf(motion: Trajectory, path: Path) -> None:
    motion.to_xarray().to_netcdf(path, engine="scipy")


def _draw(field: Any, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from dpend import plots

    names = [name for name in field.data_vars if name not in ("steps", "status", "bob")]
    names = [name for name in names if name != "bob_error"]
    fig, axes = plt.subplots(1, len(names), figsize=(5.6 * len(names), 4.6), layout="constrained", squeeze=False)
    for name, ax in zip(names, axes[0], strict=True):
        plots.map_of(field, name, ax)
    with replacing(path) as draft:
        fig.savefig(draft, dpi=200)
    plt.close(fig)


def _draw_fit(fit: dpend.Fit, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from dpend import plots

    fig = plots.residuals(fit)
    with replacing(path) as draft:
        fig.savefig(draft, dpi=150)
    plt.close(fig)


# --- the program -----------------------------------------------------------------------------------------------------


def _keep_compiled_code() -> None:
    """Has JAX keep compiled code in the user's cache directory, or where the user chose: later runs start warm."""
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
            stream.reconfigure(errors="backslashreplace")  # names of files may be no text in the terminal's encoding
    os.environ.pop("MPLBACKEND", None)  # for windows, of which the program opens none
    warnings.filterwarnings("ignore", message=".*persistent compilation cache")  # a cache only saves time
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
        # The process is this program's own, so that float64 is ours to switch on even where JAX is to be left plain.
        if "JAX_ENABLE_X64" not in os.environ:
            jax.config.update("jax_enable_x64", True)
        _keep_compiled_code()
        with np.errstate(all="ignore"):  # what overflows is told by the status or by the line that refuses it
            status = int(app(arguments or ["--help"], standalone_mode=False) or 0)
        lost = _flush()
        if isinstance(lost, BrokenPipeError):
            return 141
        if lost is not None:
            return _tell(lost)
        return status
    except (KeyboardInterrupt, typer.Abort):
        return 130
    except (BrokenPipeError, SystemExit):  # the latter is typer's answer to a closed pipe, and to nothing else here
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
        _complain(f"{error.filename or 'standard output'} cannot be written ({error.strerror}): make room for it")
        return 1
    if not isinstance(error, (ValueError, OSError, RuntimeError)):
        raise error
    _complain(str(error))
    return 1 if isinstance(error, RuntimeError) else 2


if __name__ == "__main__":
    main()
