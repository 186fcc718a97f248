"""Proofs of the paper's six motions, the eight brake orbits at 40 degrees, and rows of the atlas.

`--rows N` proves N rows of the atlas spread evenly over it (0: all), `--out F.json` writes the
certificates, and a second run goes on where the first one stopped. The table says what was proved,
in how long, and what was not and why.

Why we trust it: check_certificates.py proves each certificate again by other means.
"""

import argparse
import collections
import csv
import json
import math
import statistics
import time
from pathlib import Path

import numpy as np

from dpend.proofs.certificate import Certificate, Question, Release
from dpend.proofs.certify import answer

HERE = Path(__file__).parent
ATLAS = HERE / "atlas" / "brake_orbits.csv"
PAPER = ("0.2", "0.2", "0.1", "0.1", "9.8")
# Release [deg], partner [deg], period [s] as float64 solves them (numerics.md, paper.md).
SIX = {
    "A": ("64.3", 64.323444982221, 1.2553491280938),
    "B": ("40", 49.066544773743, 1.2127563331460),
    "C": ("10", 14.036368411360, 1.1757686075828),
    "D": ("63.95", -63.923212027994, 0.9203724612198),
    "E": ("40", -51.139513966294, 0.7544188658525),
    "F": ("10", -14.080998145069, 0.5119227306883),
}
# theta2 [deg], period [s] and turns of the eight at 40 degrees with a period up to 2 s (numerics.md
# section 4); `None` for those that are not centred.
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


def question_of(row: dict[str, str], pendulum: tuple[str, ...]) -> Question:
    """A row of the atlas: its release angle is the decimal of degrees that is printed."""
    turns = (int(row["turns1"]), int(row["turns2"])) if row["symmetry"] == "centred" else None
    theta2, period = math.radians(float(row["theta2_deg"])), float(row["period_s"])
    return Question(pendulum, Release(row["theta1_deg"], "deg"), theta2, period, turns)


def rows_of(path: Path, count: int) -> list[Question]:
    with path.open(newline="") as file:
        about = json.loads(file.readline().removeprefix("#"))["pendulum"]
        rows = list(csv.DictReader(file))
    pendulum = tuple(repr(about[key]) for key in ("l1_m", "l2_m", "m1_kg", "m2_kg", "g_m_s2"))
    chosen = np.linspace(0, len(rows) - 1, count or len(rows)).round().astype(int)
    return [question_of(rows[i], pendulum) for i in chosen]


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


def name_of(question: Question) -> str:
    return f"{question.release.text} {math.degrees(question.theta2):.9f} {question.period:.9f}"


def prove_all(questions: list[Question], digits: int | None, out: Path | None) -> list[Certificate]:
    """Certificates in order; those in the file `out` already are not proved again."""
    done = json.loads(out.read_text()) if out is not None and out.exists() else {}
    found = []
    for number, question in enumerate(questions):
        if name_of(question) in done:
            continue
        certificate = answer(question, digits)
        found.append(certificate)
        done[name_of(question)] = certificate.record()
        if not certificate.exists or not certificate.minimal:
            print(name_of(question), certificate.statement(), flush=True)
        if out is not None and (number % 50 == 49 or number == len(questions) - 1):
            out.write_text(json.dumps(done, indent=0))
    return found


def report(found: list[Certificate], wall: float) -> None:
    seconds = [certificate.seconds for certificate in found]
    print(dict(collections.Counter(c.status.name.lower() for c in found)), end=" ")
    print(dict(collections.Counter(c.stability for c in found)), end=" ")
    print(f"minimal {sum(c.minimal for c in found)}", end=" ")
    print(f"unique {sum(bool(c.unique_period) for c in found)} of {len(found)}")
    print(
        f"CPU {sum(seconds):.1f} s, median {statistics.median(seconds):.3f}, at most "
        f"{max(seconds):.3f}; wall {wall:.1f} s; discs at most {max(c.discs for c in found)}"
    )
    for certificate in found:
        if certificate.stability == "not decided":
            print("not decided:", certificate.release.text, certificate.kappa)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--atlas", type=Path, default=ATLAS, metavar="F.csv")
    parser.add_argument("--rows", type=int, default=50)
    parser.add_argument("--set", choices=("six", "eight", "rows"), default="six")
    parser.add_argument("--digits", type=int)
    parser.add_argument("--out", type=Path, metavar="F.json")
    options = parser.parse_args()
    sets = {"six": six, "eight": eight, "rows": lambda: rows_of(options.atlas, options.rows)}
    questions = sets[options.set]()
    started = time.perf_counter()
    found = prove_all(questions, options.digits, options.out)
    if not found:
        print("all proved already")
        return
    if options.set != "rows":
        for certificate in found:
            print(certificate.statement())
    report(found, time.perf_counter() - started)


if __name__ == "__main__":
    main()
