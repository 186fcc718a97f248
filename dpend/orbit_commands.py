"""The commands about orbits: `orbit`, `family` and `atlas`.

A command takes the pendulum that `options.command` makes of the shared options, and a parameter for
each option of its own: these may be more than seven. It hands back a report, which is printed.
"""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import numpy as np
import typer

import dpend
from dpend.catalogue import survey
from dpend.catalogue.release import (
    MOST_SEARCH_STEPS,
    SECONDS_PER_STEP,
    check_period,
    foresee_steps,
)
from dpend.checks import at_most_one, one_of
from dpend.mechanics.pendulum import Pendulum
from dpend.options import (
    Omega1,
    Omega2,
    Report,
    Theta1,
    command,
    counted,
    guess_in,
    moving_state,
    numeric,
    radians,
)
from dpend.orbits.arc import SYMMETRIES
from dpend.orbits.family_files import family_record, file_record
from dpend.orbits.files import orbit_record, orbits_record
from dpend.orbits.find import swinging_pendulum
from dpend.orbits.orbit import BRANCHES, FAMILIES
from dpend.places import check_place, replacing
from dpend.reading import read_orbit
from dpend.report import converged, print_atlas, print_family, print_orbits
from dpend.status import Status
from dpend.terminal import clock, tell_cost, work
from dpend.writing import (
    check_figure,
    check_film,
    draw_atlas,
    draw_family,
    draw_orbits,
    film_orbit,
    write_family_csv,
    write_json,
)


@command()
def orbit(
    pendulum: Pendulum,
    theta1: Theta1,
    branch: Annotated[
        str | None,
        typer.Option(
            metavar="|".join(BRANCHES), help="Both, if neither this nor a guess is given."
        ),
    ] = None,
    theta2: Annotated[
        float | None, numeric(help="Guess of the lower rod's release angle [deg].")
    ] = None,
    period: Annotated[float | None, numeric(help="Guess of the period [s].")] = None,
    p1: Annotated[
        float | None,
        numeric(
            "--p1", help="Of a motion that is not released from rest: momentum [kg m^2/s], near it."
        ),
    ] = None,
    p2: Annotated[float | None, numeric("--p2", help="Of the lower angle, with --p1.")] = None,
    omega1: Omega1 = None,
    omega2: Omega2 = None,
    symmetry: Annotated[
        str | None,
        typer.Option(
            metavar="|".join(SYMMETRIES),
            help="centred or brake with a guess, any with momenta; found out if not given.",
        ),
    ] = None,
    ratio: Annotated[
        int | None,
        counted("1 or -1: theta2 = ratio theta1, the release nearest to THETA1."),
    ] = None,
    crossing: Annotated[
        int | None,
        counted("Which of the branch's passages through theta1; 1 if not given."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Write to F.json what --json prints, for dpend family.")
    ] = None,
    figure: Annotated[
        Path | None, typer.Option(help="Draw rods, path and angles into P.png, P.pdf or P.svg.")
    ] = None,
    film: Annotated[
        Path | None, typer.Option(help="One period as F.gif or F.mp4, which loops without a seam.")
    ] = None,
) -> Report:
    """The releases from rest at THETA1 that come back: partner angle, period, stability, error; or
    the orbit near any motion.
    """
    formats = _formats(out, {".json": write_json})
    check_figure(figure)
    guess, release = guess_in(theta2, period), radians("theta1", theta1)
    if crossing is not None and branch is None:
        raise ValueError(
            f"crossing must go with branch, got {crossing} alone: give --branch "
            f"{' or '.join(BRANCHES)}"
        )
    near = _near(pendulum, release, guess, (p1, p2), (omega1, omega2))
    both = branch is None and ratio is None and near == {"theta1": release}
    check_film(film, both)
    find = partial(
        dpend.find_orbit,
        pendulum,
        **near,
        symmetry=symmetry,
        ratio=ratio,
        crossing=1 if crossing is None else crossing,
    )
    with clock("following the branch" if guess is None else "solving"):
        found = {name: find(branch=name) for name in (BRANCHES if both else (branch,))}
    records = [
        orbit_record(orbit) | ({"branch": name} if name else {}) for name, orbit in found.items()
    ]
    record = orbits_record(records, both)
    _write(record, out, formats)
    drawn = draw_orbits(found, figure), film_orbit(next(iter(found.values())), film)
    show = partial(print_orbits, pendulum, records, out, *drawn)
    return record, show, converged(*found.values())


def _near(
    pendulum: Pendulum,
    theta1: float,
    guess: tuple[float, float] | None,
    momenta: tuple[float | None, float | None],
    rates: tuple[float | None, float | None],
) -> dict[str, Any]:
    """What `find_orbit` starts from: a release, a guess of one, or a motion with momenta or angular
    velocities.
    """
    if momenta == rates == (None, None):
        return {"theta1": theta1} | ({} if guess is None else {"guess": guess})
    names, given = ("p1", "p2"), momenta
    if momenta == (None, None):
        names, given = ("omega1", "omega2"), rates
    if guess is None or None in given:
        missing = names[given.index(None)] if None in given else "theta2"
        of = "a momentum" if names[0] == "p1" else "an angular velocity"
        raise ValueError(
            f"{missing} must be given with {of}, got none: a motion is theta1, theta2, "
            f"{', '.join(names)} and period"
        )
    state = moving_state(pendulum, (theta1, guess[0]), momenta, rates)
    return {"state": state, "period": guess[1]}


# How a record is written, by the suffix of its file.
_Formats: TypeAlias = Mapping[str, Callable[[dict[str, Any], Path], None]]


def _formats(out: Path | None, formats: _Formats) -> _Formats:
    """The formats, once it is known that `out` can be written in one of them."""
    if out is not None:
        check_place("out", out, tuple(formats))
    return formats


def _write(found: dict[str, Any], out: Path | None, formats: _Formats) -> None:
    if out is not None:
        with replacing(out) as draft:
            formats[out.suffix](found, draft)


@command()
def family(
    pendulum: Pendulum,
    branch: Annotated[
        str | None,
        typer.Option(
            "--branch",
            "--from",
            metavar="|".join(FAMILIES),
            help="in-phase (slow mode), anti-phase (fast mode), or of a saddle: down-up (lower rod "
            "upright), up-down (upper rod upright).",
        ),
    ] = None,
    orbit: Annotated[
        Path | None, typer.Option(help="Of the orbit in F.json, from dpend orbit --out.")
    ] = None,
    special: Annotated[
        int | None, counted("Go on to the branch that leaves there at this special point.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Write all points to F.csv, or to F.json what --json prints and "
            "dpend.load_family reads."
        ),
    ] = None,
    figure: Annotated[
        Path | None,
        typer.Option(help="Draw its angles, and its period by energy, into P.png, P.pdf or P.svg."),
    ] = None,
) -> Report:
    """All orbits of a family, as of a normal mode from small swings to the upright pendulum, and
    where their stability changes.
    """
    at_most_one(branch=branch, orbit=None if orbit is None else str(orbit))
    if orbit is None and branch is None:
        raise ValueError(f"branch must be given, or orbit, got neither: {', '.join(FAMILIES)}")
    start = one_of("branch", branch, FAMILIES) if orbit is None else read_orbit(orbit, pendulum)
    formats = _formats(out, {".csv": write_family_csv, ".json": write_json})
    check_figure(figure)
    with clock("following the family"):
        found = dpend.follow_family(pendulum, start)
        if special is not None:
            found = _branch_of(pendulum, found, special)
    record = family_record(found, branch)
    _write(file_record(found, branch), out, formats)
    draw_family(found, figure)
    return record, partial(print_family, record, out, figure), converged(found)


def _branch_of(pendulum: Pendulum, family: dpend.Family, special: int) -> dpend.Family:
    """The branch that leaves a family at the special point that tables give this number."""
    points = family.special_points
    if not 1 <= special <= len(points):
        raise ValueError(
            f"special must be the number of a special point, 1 to {len(points)}, got {special}: "
            f"the family's table has them"
        )
    try:
        return dpend.follow_family(pendulum, points[special - 1])
    except ValueError as error:
        raise ValueError(f"special must be where a branch leaves, got {special}: {error}") from None


@command()
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
    figure: Annotated[
        Path | None, typer.Option(help="Draw the orbits into P.png, P.pdf or P.svg.")
    ] = None,
) -> Report:
    """Every orbit released from rest up to a period: of one release angle, or all families of the
    whole square.
    """
    _check_places(theta1, out, store)
    check_figure(figure)
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
    draw_atlas(found, figure)
    families = all(family["status"] == "converged" for family in found.families)
    solved = families and bool(np.all(found.table["status"] == Status.CONVERGED))
    solved = solved and not (found.coverage.suspicious_cells or found.coverage.exhausted)
    return found.record(), partial(print_atlas, found, theta1, out, figure), solved


def _check_places(theta1: float | None, out: Path | None, store: Path | None) -> None:
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


def _steps_of_search(pendulum: Pendulum, max_period: float, theta1: float | None) -> int | float:
    check_period(pendulum, max_period)
    if theta1 is None:
        return survey.foresee_steps(pendulum, max_period)
    return foresee_steps(pendulum, max_period, radians("theta1", theta1))
