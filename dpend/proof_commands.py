"""The command that proves orbits: `certify`.

A command takes the pendulum that `options.command` makes of the shared options, and a parameter for
each option of its own. It hands back a report, which is printed.
"""

import os
import textwrap
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import jax
import typer

import dpend
from dpend.checks import integer
from dpend.mechanics.pendulum import Pendulum
from dpend.options import Report, command, counted, guess_in, numeric, radians
from dpend.orbits.orbit import BRANCHES
from dpend.places import check_place
from dpend.proofs.certificate import Certificate
from dpend.proofs.certify import require_flint
from dpend.proofs.decimals import shortest
from dpend.proofs.ledger import SECONDS_PER_PROOF, summary
from dpend.report import print_text
from dpend.status import Status
from dpend.terminal import clock, tell_wait, work

# Columns of a statement in words.
_WIDTH = 100


@command()
def certify(
    pendulum: Pendulum,
    atlas: Annotated[
        Path | None,
        typer.Argument(
            metavar="ATLAS", help="F.csv or F.json of dpend atlas: each of its rows is proved."
        ),
    ] = None,
    theta1: Annotated[
        float | None,
        numeric("--theta1", help="Release angle of the upper rod [deg], taken as exact."),
    ] = None,
    branch: Annotated[
        str | None,
        typer.Option(help="in-phase or anti-phase; both, if neither this nor a guess is given."),
    ] = None,
    theta2: Annotated[
        float | None, numeric(help="Guess of the lower rod's release angle [deg].")
    ] = None,
    period: Annotated[float | None, numeric(help="Guess of the period [s].")] = None,
    max_period: Annotated[
        float | None,
        numeric(
            help="Of THETA1: prove all orbits with a period of at most so many seconds, and that "
            "they are all."
        ),
    ] = None,
    digits: Annotated[
        int | None, counted("Prove as many decimals of theta2 and the period; some 14 without it.")
    ] = None,
    store: Annotated[
        Path | None,
        typer.Option(
            help="Of an atlas: F.jsonl, a certificate a line, from which a run that was stopped "
            "goes on."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Of an atlas: write it with its certificates' names to F.csv or F.json."),
    ] = None,
    processes: Annotated[
        int | None, counted("Of an atlas: how many work at once; one a core, if not given.")
    ] = None,
) -> Report:
    """Proves releases from rest that come back: that they exist, their digits, period, stability.
    Of THETA1, or of each row of ATLAS.
    """
    _check_flint()
    if (atlas is None) == (theta1 is None):
        raise ValueError(
            f"theta1 or an atlas must be given, got {'neither' if atlas is None else 'both'}: give "
            "one, like --theta1 40"
        )
    if atlas is not None:
        _refuse("an atlas", branch=branch, theta2=theta2, period=period, max_period=max_period)
        return _certify_rows(pendulum, atlas, digits, store, out, processes)
    _refuse("theta1", store=store, out=out, processes=processes)
    angle = theta1 or 0.0
    if max_period is not None:
        _refuse("max_period", branch=branch, theta2=theta2, period=period, digits=digits)
        return _certify_all(pendulum, shortest(float(angle)), max_period)
    guess = guess_in(theta2, period)
    both = branch is None and guess is None
    find = partial(dpend.find_orbit, pendulum, radians("theta1", angle), guess=guess)
    wanted = None if digits is None else integer("digits", digits, least=1)
    with clock("solving and proving"):
        orbits = [find(branch=name) for name in (BRANCHES if both else (branch,))]
        text = shortest(float(angle))
        found = [dpend.certify(one, theta1_deg=text, digits=wanted) for one in orbits]
    words = "\n\n".join(textwrap.fill(one.statement(), _WIDTH) for one in found)
    return _record(found), partial(print_text, words), _proved(found)


def _check_flint() -> None:
    """Without it the command line was asked for what it cannot do: status 2."""
    try:
        require_flint()
    except RuntimeError as error:
        raise ValueError(str(error)) from None


def _refuse(given: str, **options: Any) -> None:
    for name, value in options.items():
        if value is not None:
            raise ValueError(f"{name} does not go with {given}, got {value}: leave it out")


def _certify_rows(
    pendulum: Pendulum,
    path: Path,
    digits: int | None,
    store: Path | None,
    out: Path | None,
    processes: int | None,
) -> Report:
    if store is None:
        raise ValueError(
            "store must be given with an atlas, got none: give a file like --store proofs.jsonl, "
            "which keeps what is proved"
        )
    if out is not None:
        check_place("out", out, (".csv", ".json"))
    atlas = dpend.load_atlas(path)
    own, asked = (jax.tree.leaves(one) for one in (atlas.pendulum, pendulum))
    if asked not in (own, jax.tree.leaves(Pendulum())):
        raise ValueError(
            f"l1, l2, m1, m2 and g must be those of the atlas, {own}, got {asked}: leave them out"
        )
    workers = (os.cpu_count() or 1) if processes is None else processes
    seconds = len(atlas) * SECONDS_PER_PROOF / max(workers, 1)
    tell_wait(f"{len(atlas)} orbits", seconds)
    with work("orbits") as show:
        rows, found = dpend.certify_atlas(
            atlas, store, digits=digits, processes=workers, progress=show
        )
    if out is not None:
        rows.save(out)
    return _record(found), partial(print_text, summary(found)), _proved(found)


def _certify_all(pendulum: Pendulum, theta1: str, max_period: float) -> Report:
    """All orbits of one release angle, and that they are all."""
    with work("rad of theta2 times time") as show:
        proof = dpend.prove_brake_orbits(
            pendulum, theta1_deg=theta1, max_period=max_period, progress=show
        )
    words = [*(one.statement() for one in proof.certificates), *proof.statement().split("\n")]
    text = "\n\n".join(textwrap.fill(one, _WIDTH) for one in words)
    return proof.record(), partial(print_text, text), proof.complete


def _record(found: list[Certificate] | tuple[Certificate, ...]) -> dict[str, Any]:
    return {"certificates": [one.record() for one in found]}


def _proved(found: list[Certificate] | tuple[Certificate, ...]) -> bool:
    return all(one.status == Status.PROVED for one in found)
