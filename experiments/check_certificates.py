"""Certificates of periodic orbits, each proved again from the file alone.

It imports nothing of dpend and shares no formula with its proofs: angles and angular velocities
with sines and cosines (Lagrange's equations, solved for the accelerations by hand), Taylor steps of
another order in twice the bits, Moore's a-priori boxes and Lagrange's remainder in place of
Cauchy's bounds, and balls throughout in place of float64 with bounds of its rounding.

The arc is cut into segments of a few steps. Krawczyk's operator works on theta2, the duration and
the states where segments meet; the equations are that each segment ends where the next begins, and
the condition at the end of the arc. No box is carried further than a segment, so that unstable
orbits cost no more than others. Newton's method first finds the unknowns to more digits than the
certificate claims, and a box of that size is proved to hold exactly one orbit.

Of each certificate this is proved: the release and the period in the printed intervals, the
symmetry and the turns, kappa and the energy in theirs, the class of stability, that the period is
the minimal one and where the orbit rests. Not proved again is how far it is the only one. The
identifier is compared too. The exit status is 1 if any certificate fails.

The argument is a file of `dpend certify --json`, a store of `dpend certify ATLAS`, or a list of
certificates, as certificates.json is, which proofs.py wrote.
"""

import argparse
import hashlib
import json
import math
import sys
import time
from fractions import Fraction
from pathlib import Path
from typing import Any

from flint import arb, ctx
from lagrange import NoProof, Pendulum, Step, accelerations, exact, fraction
from segments import SPARE_DIGITS, Orbit, Release, prove

# Digits of the box's size beyond those of the certificate, and the share of the longest step, that
# are tried. With 0.85 orbits with kappa = 94 and 424 failed at fifty digits: the remainder on an
# a-priori box is much larger there than at the orbit.
TRIES = ((6, 0.6), (15, 0.45))
CERTIFICATES = Path(__file__).parent / "certificates.json"
NAMES = ("l1_m", "l2_m", "m1_kg", "m2_kg", "g_m_s2")
# Pieces of a step shorter than this share, on which a rest cannot be excluded, fail.
FINEST = 2.0**-12


def interval(record: dict[str, str]) -> Any:
    """Lower and upper end of a printed interval, balls."""
    middle, radius = Fraction(record["midpoint"]), Fraction(record["radius"])
    return exact(middle - radius), exact(middle + radius)


def inside(x: Any, record: dict[str, str]) -> bool:
    low, high = interval(record)
    return bool(low <= x) and bool(x <= high)


def kappa_of(release: Release, orbit: Orbit) -> Any:
    """Half the sum of the non-trivial multipliers: the arc there and back is R Q^-1 R Q."""
    q, back = orbit.transition, orbit.transition.inv()
    signs = (1, 1, -1, -1)
    trace = sum(
        (back[i, j] * q[j, i] * (signs[i] * signs[j]) for i in range(4) for j in range(4)), arb(0)
    )
    if release.turns is None:
        return (trace - 2) / 2
    half = (-trace - 2) / 2
    return 2 * half * half - 1


def never_rests(step: Step, low: Any, high: Any) -> bool:
    """Whether a velocity is proved not to vanish at each time between two times of a step."""
    pieces = [(low, high)]
    finest = (high - low) * FINEST
    while pieces:
        a, b = pieces.pop()
        state = step.at(a.union(b))
        if state[2].contains(0) and state[3].contains(0):
            if bool(b - a < finest):
                return False
            pieces += [(a, ((a + b) / 2).mid()), (((a + b) / 2).mid(), b)]
    return True


def departure(pendulum: Pendulum, step: Step, start: Any, end: Any) -> Any:
    """A time up to which, from a rest at `start`, an acceleration keeps its sign."""
    for _ in range(12):
        rates = accelerations(pendulum, step.at(start.union(end)))
        if not all(y.contains(0) for y in rates):
            return end
        end = ((start + end) / 2).mid()
    raise NoProof("the orbit may stay at rest")


def check_rests(release: Release, orbit: Orbit) -> None:
    """The orbit rests at its release, at the end of a brake orbit's arc, and nowhere else."""
    first, last = orbit.steps[0], orbit.steps[-1]
    low = departure(release.pendulum, first, arb(0), first.length)
    high = last.length
    if release.turns is None:
        middle = (last.length / 2).mid() if last is not first else low
        high = departure(release.pendulum, last, last.length, middle)
    for step in orbit.steps:
        a = low if step is first else arb(0)
        b = high if step is last else step.length
        if bool(a < b) and not never_rests(step, a, b):
            raise NoProof("the orbit may rest in between")


def class_of(kappa: Any) -> str:
    if bool(abs(kappa) < 1):
        return "elliptic"
    return "hyperbolic" if bool(kappa > 1) else "inverse hyperbolic" if bool(kappa < -1) else ""


def release_of(record: dict[str, Any]) -> Release:
    l1, l2, m1, m2, _ = (Fraction(record["pendulum"][name]) for name in NAMES)
    text, unit = record["theta1"]["text"], record["theta1"]["unit"]
    if unit not in ("deg", "rad") or record["symmetry"] not in ("centred", "brake"):
        raise NoProof("neither degrees nor radians, or an unknown symmetry")
    theta1 = fraction(text) * arb.pi() / 180 if unit == "deg" else exact(Fraction(float(text)))
    turns = None
    if record["symmetry"] == "centred":
        turns = int(record["turns"][0]), int(record["turns"][1])
    pendulum = Pendulum(exact(l2 / l1), exact(m2 / m1))
    return Release(pendulum, theta1, int(record["theta1"]["ratio"]), turns)


def identifier_of(record: dict[str, Any]) -> str:
    claim = {key: record[key] for key in record if key not in ("identifier", "discs")}
    return hashlib.sha256(json.dumps(claim).encode()).hexdigest()[:16]


def compare(record: dict[str, Any], release: Release, orbit: Orbit) -> None:
    """Holds the printed intervals to what was proved here."""
    l1, _, m1, _, g = (Fraction(record["pendulum"][name]) for name in NAMES)
    parts = 2 if release.turns is None else 4
    second, theta1 = exact(l1 / g).sqrt(), release.state(orbit.theta2)[0]
    lam, mu = release.pendulum
    energy = -(1 + mu) * theta1.cos() - mu * lam * orbit.theta2.cos()
    kappa = kappa_of(release, orbit)
    found = {
        "theta2_deg": orbit.theta2 * 180 / arb.pi(),
        "period_s": orbit.duration * parts * second,
        "energy_J": energy * exact(m1 * g * l1),
        "kappa": kappa,
    }
    for key, value in found.items():
        if not inside(value, record[key]):
            raise NoProof(f"{key} is {value.str(25)}, which the printed interval does not hold")
    name = class_of(kappa)
    if record["stability"] not in (name, "not decided"):
        raise NoProof(f"it is {name or 'not decided'}, kappa = {kappa.str(15)}")
    if record["minimal"]:
        check_rests(release, orbit)


def check(record: dict[str, Any]) -> str:
    """Empty if the certificate is proved again, else why not."""
    if record.get("identifier") != identifier_of(record):
        return "the identifier is not that of the content"
    reason = "it claims nothing"
    if record["status"] not in ("proved", "digits_not_proved"):
        return reason
    radii = [Fraction(record[key]["radius"]) for key in ("theta2_deg", "period_s")]
    digits = max(math.ceil(-math.log10(min(map(float, radii)))) + 1, 16)
    for extra, share in TRIES:
        ctx.prec = int(3.33 * (digits + extra + SPARE_DIGITS)) + 30
        try:
            release = release_of(record)
            parts = 2 if release.turns is None else 4
            length, gravity = (record["pendulum"][name] for name in ("l1_m", "g_m_s2"))
            second = exact(Fraction(length) / Fraction(gravity)).sqrt()
            theta2 = fraction(record["theta2_deg"]["midpoint"]) * arb.pi() / 180
            duration = fraction(record["period_s"]["midpoint"]) / parts / second
            orbit = prove(release, theta2.mid(), duration.mid(), digits + extra, share)
            compare(record, release, orbit)
            return ""
        except (ArithmeticError, ValueError) as error:
            reason = str(error)
            if "printed interval" in reason or "it is " in reason:
                break
    return reason


def records_of(path: Path) -> list[dict[str, Any]]:
    if path.suffix == ".jsonl":
        return [json.loads(line)["certificate"] for line in path.read_text().splitlines()]
    content = json.loads(path.read_text())
    return content if isinstance(content, list) else content["certificates"]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path, metavar="FILE", nargs="?", default=CERTIFICATES)
    parser.add_argument("--every", type=int, default=1, help="only every n-th certificate")
    parser.add_argument("--quick", action="store_const", dest="every", const=6, help="every sixth")
    options = parser.parse_args()
    records, failed, started = records_of(options.file)[:: options.every], 0, time.process_time()
    for record in records:
        begun = time.process_time()
        reason = check(record)
        failed += bool(reason)
        name = f"{record['theta1']['text']} {record['theta1']['unit']} {record['identifier']}"
        spent = f"{time.process_time() - begun:.1f} s, {ctx.prec} bits"
        print(f"{'FAILED' if reason else 'proved'} {name}: {reason or spent}", flush=True)
    print(f"{len(records) - failed} of {len(records)} proved again, {failed} failed; "
          f"{time.process_time() - started:.0f} s of CPU")  # fmt: skip
    return int(failed > 0 or not records)


if __name__ == "__main__":
    sys.exit(main())
