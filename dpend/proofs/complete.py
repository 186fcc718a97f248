"""`prove_brake_orbits`: all orbits released from rest at one angle, and the proof of it.

The orbits of `find_brake_orbits` are proved one by one. A rest is a zero of (p1, p2) in
(theta2, t); an orbit run through k times rests at k T/2 too. Near each of these rests Krawczyk's
test gives a square in which it is the only one (`squares`). Everything else up to half of the
longest period is proved to hold no rest (`march`). What is not is listed.

Why it is complete: a brake orbit with a period of at most `max_period` has a rest at T/2, which is
in a cell. No cell that is proved empty holds it, hence it is in a square, hence it is the rest that
belongs to the square, and the orbit is one of those proved, run through once or several times.
Every periodic motion from rest is a brake orbit: it is at T/2 what it is at -T/2, which is the same
place with the velocities turned round.

It assumes what a `Certificate` assumes, and that NumPy's float64 quotients and square roots are
rounded to nearest.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dpend.catalogue.atlas import Atlas
from dpend.catalogue.release import check_period, find_brake_orbits
from dpend.checks import at_most_one, function, known_number
from dpend.mechanics.pendulum import Pendulum
from dpend.orbits.find import swinging_pendulum
from dpend.orbits.orbit import PeriodicOrbit
from dpend.proofs.certificate import Certificate, Question, Release
from dpend.proofs.certify import answer, problem_of, require_flint
from dpend.proofs.decimals import shortest
from dpend.proofs.question import decimals_of
from dpend.records import frame, parse_decimal

if TYPE_CHECKING:
    from dpend.proofs.march import Rectangle
    from dpend.proofs.squares import Rest

# Places that stay open march again in narrow boxes if they are no wider in all [rad].
WIDEST_AGAIN = 0.02
# Keys of the pendulum's numbers in the record.
PENDULUM = ("l1_m", "l2_m", "m1_kg", "m2_kg", "g_m_s2")
# More undecided places are not listed one by one in words.
MOST_IN_WORDS = 10


class Undecided(NamedTuple):
    """A rectangle in which a further orbit is not excluded.

    Attributes:
        theta2_deg: least and largest theta2 [deg]; period: least and largest [s], as far as it is
            below the longest period asked about; both for the reader, rounded.
        reason: a sentence.
    """

    theta2_deg: tuple[float, float]
    period: tuple[float, float]
    reason: str


@dataclass(frozen=True, eq=False)
class BrakeProof:
    """What is proved of all orbits released from rest at one angle up to a period.

    Attributes:
        pendulum: l1, l2 [m], m1, m2 [kg], g [m/s^2] as exact decimals; release: theta1, exactly.
        max_period: the longest period [s], as an exact decimal.
        atlas: the orbits as `find_brake_orbits` finds them; certificates: their proofs, in order.
        undecided: where a further orbit is not excluded.
        boxes: of theta2, when the proof ended; steps: that were bounded; cells: of (theta2, t) that
            were looked at; error: the largest bound of a motion's error, natural units.
        seconds: wall time, that of the search and of the proofs included; cpu_seconds: of it all.
    """

    pendulum: tuple[str, str, str, str, str]
    release: Release
    max_period: str
    atlas: Atlas
    certificates: tuple[Certificate, ...]
    undecided: tuple[Undecided, ...]
    boxes: int
    steps: int
    cells: int
    error: float
    seconds: float
    cpu_seconds: float

    def __len__(self) -> int:
        return len(self.certificates)

    def __repr__(self) -> str:
        proved = f"{sum(one.exists for one in self.certificates)} of {len(self)} orbits proved"
        return f"<BrakeProof: {proved}, {len(self.undecided)} places undecided>"

    @property
    def complete(self) -> bool:
        """Whether the orbits are proved to be all, each once."""
        return not self.undecided

    def statement(self) -> str:
        """What is proved, in words."""
        number = sum(one.exists for one in self.certificates)
        verb = "is" if number == 1 else "are"
        unit = "deg" if self.release.unit == "deg" else "rad (the float64 number)"
        values = zip(("l1", "l2", "m1", "m2", "g"), self.pendulum, strict=True)
        where = (
            f"{number} value{'s' * (number != 1)} of theta2, up to full turns, from which a "
            "pendulum with exactly "
            f"{', '.join(f'{name} = {x}' for name, x in values)} (SI units), released from rest at "
            f"theta1 = {self.release.text} {unit}, moves periodically with a period of at most "
            f"{self.max_period} s."
        )
        if self.complete:
            return f"Proved: there {verb} exactly {where}"
        lines = [
            f"Proved: there {verb} at least {where} Not decided: whether there are more. "
            f"{len(self.undecided)} places are open:"
        ]
        for one in self.undecided[:MOST_IN_WORDS]:
            (low, high), (early, late) = one.theta2_deg, one.period
            lines.append(
                f"theta2 {low:.9g} to {high:.9g} deg, period {early:.9g} to {late:.9g} s: "
                f"{one.reason}"
            )
        return "\n".join(lines)

    def record(self) -> dict[str, Any]:
        """One JSON object, degrees and seconds."""
        return {
            "pendulum": dict(zip(PENDULUM, self.pendulum, strict=True)),
            "theta1": self.release._asdict(),
            "max_period_s": self.max_period,
            "complete": self.complete,
            "certificates": [one.record() for one in self.certificates],
            "undecided": [
                {
                    "theta2_deg": list(one.theta2_deg),
                    "period_s": list(one.period),
                    "reason": one.reason,
                }
                for one in self.undecided
            ],
            "boxes": self.boxes,
            "steps": self.steps,
            "cells": self.cells,
            "error": self.error,
            "seconds": self.seconds,
            "cpu_seconds": self.cpu_seconds,
        }

    def to_dataframe(self) -> Any:
        """The orbits as a table: middles of what is proved, stability, and the certificates."""
        rows = self.certificates
        table: dict[str, tuple[list[Any], str]] = {
            "theta2_deg": ([_middle(one.theta2_deg) for one in rows], ""),
            "period": ([_middle(one.period) for one in rows], "s"),
            "kappa": ([_middle(one.kappa) for one in rows], ""),
            "stability": ([one.stability for one in rows], ""),
            "symmetry": ([one.symmetry for one in rows], ""),
            "certificate": ([one.identifier for one in rows], ""),
            "status": ([int(one.status) for one in rows], ""),
        }
        return frame({name: (np.array(column), unit) for name, (column, unit) in table.items()})


def _middle(enclosure: Any) -> float:
    return math.nan if enclosure is None else float(enclosure)


def prove_brake_orbits(
    pendulum: Pendulum | Any,
    *,
    theta1: Any = None,
    theta1_deg: str | float | Any | None = None,
    max_period: Any,
    progress: Callable[[float, float], None] | Any | None = None,
) -> BrakeProof:
    """All orbits released from rest at one angle with a period of at most `max_period`: found,
    proved, and proved to be all.

    The pendulum's parameters and `max_period` count as the shortest decimals that read back as
    their float64 numbers. The paper's pendulum at 40 degrees takes 40 s of one core up to 2 s.

    Arguments:
        pendulum: its fields are numbers; g positive.
        theta1: release angle of the upper rod [rad]: exactly that float64 number.
        theta1_deg: the release angle as an exact decimal of degrees instead.
        max_period: [s]. The time it takes grows exponentially with it.
        progress: called with the area of (theta2, t) that is done, and with all of it.
    Returns:
        BrakeProof; what is not proved is in its `undecided`, no exception. Where theta1 is 0 or 180
        degrees the neighbourhoods of the equilibria stay undecided, and the orbits' mirror images.
    Raises:
        ValueError: not exactly one of theta1 and theta1_deg; otherwise as `find_brake_orbits`.
        RuntimeError: python-flint is missing; float64 is switched off in JAX.
    """
    fixed = swinging_pendulum(pendulum)
    release, angle = _release(theta1, theta1_deg)
    check_period(fixed, max_period)
    if progress is not None:
        function("progress", progress, "(area done, area in all)", "print")
    require_flint()
    wall, cpu = time.perf_counter(), time.process_time()
    atlas = find_brake_orbits(fixed, theta1=angle, max_period=max_period)
    text = shortest(float(atlas.max_period))
    found = tuple(answer(_question(one, release)) for one in atlas.orbits)
    places, tally = _survey(atlas, release, text, found, progress)
    undecided = (*_doubts(found, Fraction(text)), *places)
    spent = time.perf_counter() - wall, time.process_time() - cpu
    return BrakeProof(decimals_of(fixed), release, text, atlas, found, undecided, *tally, *spent)


def _release(theta1: Any, theta1_deg: Any) -> tuple[Release, float]:
    at_most_one(theta1=theta1, theta1_deg=theta1_deg)
    if theta1_deg is None:
        angle = known_number("theta1", theta1, unit="rad")
        return Release(shortest(angle), "rad"), angle
    text = theta1_deg if isinstance(theta1_deg, str) else ""
    if not text:
        text = shortest(known_number("theta1_deg", theta1_deg, unit="deg"))
    try:
        return Release(text, "deg"), math.radians(parse_decimal(text))
    except ValueError:
        raise ValueError(
            f"theta1_deg must be a decimal number, got {text!r:.60}: give one like '40'"
        ) from None


def _question(orbit: PeriodicOrbit, release: Release, passes: int = 0) -> Question:
    """An orbit with what symmetry it has, or as a rest after so many passes."""
    centred = orbit.symmetry == "centred" and not passes
    turns = (int(orbit.turns[0]), int(orbit.turns[1])) if centred else None
    period = float(orbit.period) * (passes or 1)
    return Question(decimals_of(orbit.pendulum), release, float(orbit.theta2), period, turns)


def _doubts(found: tuple[Certificate, ...], longest: Fraction) -> list[Undecided]:
    """Orbits that are not proved, or not to be counted once."""
    out = []
    for one in found:
        if one.exists and one.minimal and one.period is not None:
            high = Fraction(one.period.midpoint) + Fraction(one.period.radius)
            if high <= longest:
                continue
            reason = "An orbit has the longest period, or nearly: choose another."
        else:
            reason = f"An orbit is not proved, or its period is not minimal. {one.reason}".strip()
        theta2, period = _middle(one.theta2_deg), _middle(one.period)
        out.append(Undecided((theta2, theta2), (period, period), reason))
    return out


def _survey(
    atlas: Atlas,
    release: Release,
    longest: str,
    found: tuple[Certificate, ...],
    progress: Callable[[float, float], None] | None,
) -> tuple[list[Undecided], tuple[int, int, int, float]]:
    """What stays open beside the proved orbits, and the tally of the march."""
    from flint import arb

    from dpend.proofs.balls import fraction_ball, precision, upper
    from dpend.proofs.march import AGAIN_CUTS, again, march, merge
    from dpend.proofs.march import release as front_of
    from dpend.proofs.proof import BITS
    from dpend.proofs.sheet import Sheet
    from dpend.proofs.squares import squares_of

    period = float(longest)
    problem = problem_of(Question(decimals_of(atlas.pendulum), release, 0.0, period, None))
    parameters = problem.pendulum
    with precision(BITS):
        exact, floats = parameters.balls(), parameters.floats()
        theta1, second = problem.start[0](), parameters.second()
        middle = float(theta1.mid())
        off = upper(theta1 - arb(middle))
        end = upper(fraction_ball(Fraction(longest)) / 2 / second)
        unit = float(second.mid())
    squares = squares_of(_rests(atlas, release, found, period), unit)
    sheet, fine = Sheet(exact, floats), Sheet(exact, floats, AGAIN_CUTS)
    left, tally = march(sheet, front_of(sheet, middle, off), squares, end, progress)
    left = merge(left)
    if left and sum(one.high - one.low for one in left) < WIDEST_AGAIN:
        left, more = march(fine, front_of(fine, middle, off, again(left)), squares, end)
        left, tally = merge(left), tally.add(more)
    return [_undecided(one, unit, period) for one in left], tally


def _rests(
    atlas: Atlas, release: Release, found: tuple[Certificate, ...], longest: float
) -> "list[Rest]":
    """All rests up to half of the longest period of the orbits that are proved."""
    from dpend.proofs.squares import Rest

    return [
        Rest(_question(orbit, release, passes), proof, passes)
        for orbit, proof in zip(atlas.orbits, found, strict=True)
        if proof.exists
        for passes in range(1, int(longest / float(orbit.period) * (1 + 1e-9)) + 1)
    ]


def _undecided(one: "Rectangle", unit: float, longest: float) -> Undecided:
    low, high = math.degrees(one.low), math.degrees(one.high)
    early, late = (min(2 * unit * x, longest) for x in (one.early, one.late))
    return Undecided((low, high), (early, late), one.reason)
