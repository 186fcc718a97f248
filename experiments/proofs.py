"""The theorem of the paper's six motions, of the eight brake orbits at 40 degrees, and of three
that never rest, in one page.

It proves each to fifty digits (`dpend.certify`), prints what is proved in words and in how long,
and writes the certificates to certificates.json. `--rows N` proves N rows of the atlas instead,
spread evenly over it (`dpend certify` proves all), and prints the table only.

Why we trust it: check_certificates.py proves each certificate again by other means.
"""

import argparse
import collections
import json
import math
import statistics
import textwrap
from pathlib import Path

import numpy as np

import dpend
from dpend.proofs.certificate import Certificate, Passage, Question, Release
from dpend.proofs.certify import answer, require_flint
from dpend.proofs.ledger import questions_of

HERE = Path(__file__).parent
ATLAS = HERE / "atlas" / "brake_orbits.csv"
CERTIFICATES = HERE / "certificates.json"
UNIT = ("1", "1", "1", "1", "1")
PAPER = ("0.2", "0.2", "0.1", "0.1", "9.8")
# The digits of the page, and its width.
DIGITS, WIDTH = 50, 100
# Release [deg], partner [deg], period [s] of the paper's six motions as `dpend.find_orbit` solves
# them.
SIX = {
    "A": ("64.3", 64.323444982221, 1.2553491280938),
    "B": ("40", 49.066544773743, 1.2127563331460),
    "C": ("10", 14.036368411360, 1.1757686075828),
    "D": ("63.95", -63.923212027994, 0.9203724612198),
    "E": ("40", -51.139513966294, 0.7544188658525),
    "F": ("10", -14.080998145069, 0.5119227306883),
}
# theta2 [deg], period [s] and turns of the eight at 40 degrees with a period up to 2 s, as
# `dpend.find_brake_orbits` finds them; `None` for those that are not centred.
EIGHT = (
    (-51.139513966, 0.754418866, (0, 0)),
    (-157.229758666, 0.789605931, (0, -1)),
    (-4.570287296, 1.174420237, None),
    (49.066544774, 1.212756333, (0, 0)),
    (119.491215917, 1.283263044, None),
    (177.345987867, 1.451903639, (0, 0)),
    (-151.107616659, 1.923779041, None),
    (-152.332774219, 1.970160641, None),
)
# State, period and full turns of three orbits that never rest and their energy, m = l = g = 1: the
# shortest that passes (0, 180) deg with the energy 0, in which the lower rod turns over; one of the
# odd branch that leaves the anti-phase family; one without symmetry.
MOVING = {
    "passing": (
        (0.0, math.pi, 0.02685251818266686, 0.9864836046298022),
        2.953489010394937, (0, 1), "0",
    ),
    "odd": (
        (1.5502560054844974, -0.35074247538486014, -0.4539732766385053, 1.4001397178570352),
        5.854632672821845, (0, 0), "0",
    ),
    "none": (
        (0.5320590079412049, 1.2054121937279694, -1.891711193942938, 0.5007097555400518),
        5.900046149852152, (0, 0), "-0.07891219248209452",
    ),
}  # fmt: skip


def six() -> list[Question]:
    return [
        Question(PAPER, Release(text, "deg"), math.radians(theta2), period, (0, 0))
        for text, theta2, period in SIX.values()
    ]


def eight() -> list[Question]:
    return [
        Question(PAPER, Release("40", "deg"), math.radians(theta2), period, turns)
        for theta2, period, turns in EIGHT
    ]


def moving(symmetry: str) -> Question:
    """Passing at (0, 180) deg, or with theta2 given exactly."""
    state, period, turns, energy = MOVING[symmetry]
    angles = ("0", "180") if symmetry == "passing" else ("", repr(math.degrees(state[1])))
    return Question(UNIT, Passage(symmetry, energy, *angles), state[1], period, turns, state)


def distinct(questions: list[Question]) -> list[Question]:
    """Without those that are there already: B and E are released at 40 degrees too."""
    found = {(one.release, round(one.theta2, 6)): one for one in reversed(questions)}
    return list(found.values())[::-1]


def sample(count: int) -> list[Question]:
    questions = questions_of(dpend.load_atlas(ATLAS))
    chosen = np.linspace(0, len(questions) - 1, min(count, len(questions))).round().astype(int)
    return [questions[i] for i in chosen]


def print_table(found: list[Certificate]) -> None:
    seconds = [certificate.seconds for certificate in found]
    kinds = collections.Counter(one.stability for one in found if one.exists)
    print(
        f"{sum(one.status == dpend.Status.PROVED for one in found)} of {len(found)} proved, "
        f"{sum(one.minimal for one in found)} periods minimal, "
        f"{sum(bool(one.unique_period) for one in found)} the only orbit nearby; "
        + ", ".join(f"{count} {kind}" for kind, count in kinds.most_common())
    )
    print(
        f"CPU {sum(seconds):.1f} s, {statistics.median(seconds):.2f} s in the median, "
        f"{max(seconds):.2f} s at most; {max(one.discs for one in found)} discs at most"
    )
    for one in found:
        if one.status != dpend.Status.PROVED or one.stability == "not decided":
            print("-", one.statement())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", type=int, help="so many rows of the atlas instead")
    parser.add_argument("--quick", action="store_true", help="two orbits, and no file")
    options = parser.parse_args()
    try:
        require_flint()
    except RuntimeError as error:
        parser.exit(2, f"{parser.prog}: {error}\n")
    if options.rows:
        print_table([answer(question) for question in sample(options.rows)])
        return
    questions = six()[:2] if options.quick else distinct([*six(), *eight()])
    if not options.quick:
        questions += [moving(symmetry) for symmetry in MOVING]
    found = [answer(question, DIGITS) for question in questions]
    for number, certificate in enumerate(found, 1):
        print(f"{number}.", textwrap.fill(certificate.statement(), WIDTH), end="\n\n")
    print_table(found)
    if not options.quick:
        CERTIFICATES.write_text(json.dumps([one.record() for one in found], indent=1) + "\n")


if __name__ == "__main__":
    main()
