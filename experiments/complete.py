"""Lists of brake orbits proved complete: how many there are, and what the proof costs.

For each release angle and longest period `dpend.prove_brake_orbits` proves every cell of
(theta2, t) free of a rest, or near an orbit that is the only one there. The numbers go to
complete.csv. `--quick` takes the first case alone, and writes no file.

Why we trust it: tests hide each of the eight orbits at 40 degrees from the proof, and its cell
stays open; motions in 120-bit balls lie within the bounds, and a spoiled coefficient is noticed.
"""

import argparse
import csv
from pathlib import Path

import dpend
from dpend.proofs.certify import require_flint

TABLE = Path(__file__).parent / "complete.csv"
PAPER = dpend.Pendulum()
# Unequal lengths and masses.
UNEQUAL = dpend.Pendulum(l1=0.2, l2=0.34, m1=0.1, m2=0.07)
# Pendulum, theta1 [deg], longest period [s].
CASES = (
    (PAPER, "120", 1.0),
    (PAPER, "10", 1.5),
    (UNEQUAL, "60", 1.2),
    (PAPER, "40", 2.0),
)
COLUMNS = (
    "l1_m l2_m m1_kg m2_kg theta1_deg max_period_s orbits undecided boxes steps cells error "
    "cpu_seconds"
).split()


def row_of(proof: dpend.BrakeProof) -> list[object]:
    return [
        *proof.pendulum[:4],
        proof.release.text,
        proof.max_period,
        len(proof),
        len(proof.undecided),
        proof.boxes,
        proof.steps,
        proof.cells,
        f"{proof.error:.1e}",
        round(proof.cpu_seconds, 1),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="the first case, and no file")
    options = parser.parse_args()
    try:
        require_flint()
    except RuntimeError as error:
        parser.exit(2, f"{parser.prog}: {error}\n")
    rows = []
    for pendulum, theta1, longest in CASES[:1] if options.quick else CASES:
        proof = dpend.prove_brake_orbits(pendulum, theta1_deg=theta1, max_period=longest)
        rows.append(row_of(proof))
        print(proof.statement(), f"({proof.cpu_seconds:.0f} s of CPU)", end="\n\n", flush=True)
    if not options.quick:
        with TABLE.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([COLUMNS, *rows])


if __name__ == "__main__":
    main()
