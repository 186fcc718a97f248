"""Certificates of periodic orbits, each proved again from the file alone.

It imports nothing of dpend and shares no formula with its proofs: angles and angular velocities
with sines and cosines (Lagrange's equations, solved for the accelerations by hand), Taylor steps of
another order in twice the bits, Moore's a-priori boxes and Lagrange's remainder in place of
Cauchy's bounds, and balls throughout in place of float64 with bounds of its rounding.

The arc is cut into segments of a few steps. Krawczyk's operator works on what is not given of the
start, the duration and the states where segments meet; the equations are that each segment ends
where the next begins, the condition at the end of the arc, and the energy of an orbit that never
rests. No box is carried further than a segment, so that unstable
orbits cost no more than others. Newton's method first finds the unknowns to more digits than the
certificate claims, and a box of that size is proved to hold exactly one orbit.

Of each certificate this is proved: the start and the period in the printed intervals, the
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
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

from flint import arb, ctx
from lagrange import NoProof, Pendulum, Step, energy_of, exact, field, fraction, momenta
from segments import SPARE_DIGITS, Orbit, Start, prove

# Digits of the box's size beyond those of the certificate, and the share of the longest step, that
# are tried. With 0.85 orbits with kappa = 94 and 424 failed at fifty digits: the remainder on an
# a-priori box is much larger there than at the orbit.
TRIES = ((6, 0.6), (15, 0.45))
# Digits of the box's size for one of kappa: at fifty and sixty digits kappa comes with 24.
DIGITS_FOR_KAPPA = 2.6
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


def apart(x: Any, record: dict[str, str]) -> bool:
    low, high = interval(record)
    return bool(x < low) or bool(x > high)


def kappa_of(start: Start, orbit: Orbit) -> Any:
    """Half the sum of the non-trivial multipliers: the arc there and back is R Q^-1 R Q; an odd
    orbit's half period followed by x -> -x has the derivative -Q.
    """
    q, back = orbit.transition, orbit.transition.inv()
    trace = sum((q[i, i] for i in range(4)), arb(0))
    if start.symmetry == "none":
        return (trace - 2) / 2
    if start.symmetry == "odd":
        half = (-trace - 2) / 2
        return 2 * half * half - 1
    signs = (1, 1, -1, -1)
    trace = sum(
        (back[i, j] * q[j, i] * (signs[i] * signs[j]) for i in range(4) for j in range(4)), arb(0)
    )
    if start.symmetry != "centred":
        return (trace - 2) / 2
    half = (-trace - 2) / 2
    return 2 * half * half - 1


class FalseClaim(NoProof):
    """What is proved not to be so: more digits would not help."""


Meets = Callable[[list[Any]], bool]


def rests(state: list[Any]) -> bool:
    return bool(state[2].contains(0) and state[3].contains(0))


def upright(state: list[Any]) -> bool:
    """Whether both angles may be multiples of pi."""
    return all((x / arb.pi()).contains_integer() for x in state[:2])


def same_as(start: list[Any]) -> Meets:
    """Whether a state may be the start, up to full turns."""

    def meets(state: list[Any]) -> bool:
        off = [x - y for x, y in zip(state, start, strict=True)]
        turns = [(x / (2 * arb.pi())).contains_integer() for x in off[:2]]
        return all(turns) and all(x.contains(0) for x in off[2:])

    return meets


def nowhere(step: Step, low: Any, high: Any, meets: Meets) -> bool:
    """Whether a thing is proved not to happen at each time between two times of a step."""
    pieces = [(low, high)]
    finest = (high - low) * FINEST
    while pieces:
        a, b = pieces.pop()
        if meets(step.at(a.union(b))):
            if bool(b - a < finest):
                return False
            pieces += [(a, ((a + b) / 2).mid()), (((a + b) / 2).mid(), b)]
    return True


def departure(pendulum: Pendulum, step: Step, span: tuple[Any, Any], part: int) -> Any:
    """A time up to which, from the first of two times on, one of two components of the state keeps
    moving the same way, an angle by less than a half turn: the angles (part 0) or the angular
    velocities (part 2).
    """
    start, end = span
    for _ in range(12):
        state = step.at(start.union(end))
        rates = field(pendulum, state)
        near = part == 2 or all(bool(x.rad() < 1.5) for x in state[:2])
        if near and not all(y.contains(0) for y in rates[part : part + 2]):
            return end
        end = ((start + end) / 2).mid()
    raise NoProof("the orbit may stay where it is")


def check_never(
    start: Start, orbit: Orbit, meets: Meets, leaves: tuple[tuple[int, ...], int]
) -> None:
    """That a thing does not happen within the arc, but at the ends that `leaves` names (0 and 1),
    from where `part` of the state moves away.
    """
    ends, part = leaves
    first, last, low = orbit.steps[0], orbit.steps[-1], arb(0)
    high = last.length
    if 0 in ends:
        low = departure(start.pendulum, first, (low, first.length), part)
    if 1 in ends:
        middle = (last.length / 2).mid() if last is not first else low
        high = departure(start.pendulum, last, (last.length, middle), part)
    for step in orbit.steps:
        a = low if step is first else arb(0)
        b = high if step is last else step.length
        if bool(a < b) and not nowhere(step, a, b, meets):
            raise NoProof("the period may be shorter, or the orbit rests in between")


def check_minimal(start: Start, orbit: Orbit) -> None:
    """An orbit released from rest rests at its release, at the end of a brake orbit's arc, and
    nowhere else on the arc. Others rest nowhere; a passing one is upright at both ends of the arc
    only, an odd one is where it started at the start only, another one at 0 and T only.
    """
    if start.energy is None:
        check_never(start, orbit, rests, ((0, 1) if start.symmetry == "brake" else (0,), 2))
        return
    check_never(start, orbit, rests, ((), 2))
    if start.symmetry == "passing":
        check_never(start, orbit, upright, ((0, 1), 0))
    else:
        ends = (0,) if start.symmetry == "odd" else (0, 1)
        check_never(start, orbit, same_as(orbit.state), (ends, 0))


def class_of(kappa: Any) -> str:
    if bool(abs(kappa) < 1):
        return "elliptic"
    return "hyperbolic" if bool(kappa > 1) else "inverse hyperbolic" if bool(kappa < -1) else ""


def angle_of(text: str) -> Any:
    return fraction(text) * arb.pi() / 180


def start_of(record: dict[str, Any]) -> Start:
    l1, l2, m1, m2, g = (Fraction(record["pendulum"][name]) for name in NAMES)
    pendulum, symmetry = Pendulum(exact(l2 / l1), exact(m2 / m1)), record["symmetry"]
    turns = int(record["turns"][0]), int(record["turns"][1])
    if "start" in record:
        given = record["start"]
        texts = given["theta1"], given["theta2"]
        passing = symmetry == "passing"
        if symmetry not in ("passing", "odd", "none") or (not passing and "" not in texts):
            raise NoProof("an unknown symmetry, or both angles are given")
        if passing:
            # In T the rods make `turns` full turns, and half of them on the arc.
            places = [Fraction(x) / 180 for x in texts]
            if any(x.denominator != 1 for x in places):
                raise NoProof("it does not start at multiples of 180 deg")
            turns = int(places[0]) + turns[0], int(places[1]) + turns[1]
        angles = tuple(angle_of(x) if x else None for x in texts)
        energy = exact(Fraction(given["energy"]) / (m1 * g * l1))
        return Start(pendulum, symmetry, angles, 0, turns, energy)  # type: ignore[arg-type]
    text, unit = record["theta1"]["text"], record["theta1"]["unit"]
    if unit not in ("deg", "rad") or symmetry not in ("centred", "brake"):
        raise NoProof("neither degrees nor radians, or an unknown symmetry")
    theta1 = angle_of(text) if unit == "deg" else exact(Fraction(float(text)))
    ratio = int(record["theta1"]["ratio"])
    return Start(pendulum, symmetry, (theta1, None), ratio, turns, None)


def identifier_of(record: dict[str, Any]) -> str:
    claim = {key: record[key] for key in record if key not in ("identifier", "discs")}
    return hashlib.sha256(json.dumps(claim).encode()).hexdigest()[:16]


class Units(NamedTuple):
    """Of time [s], momentum [kg m^2/s] and energy [J]."""

    second: Any
    momentum: Any
    joule: Any


def units_of(record: dict[str, Any]) -> Units:
    l1, _, m1, _, g = (Fraction(record["pendulum"][name]) for name in NAMES)
    return Units(exact(l1 / g).sqrt(), exact(m1 * l1) * exact(g * l1).sqrt(), exact(m1 * g * l1))


def guesses_of(record: dict[str, Any], start: Start, units: Units) -> list[Any]:
    """What the certificate says of the unknowns of the start: momenta as angular velocities."""
    keys = ("theta1_deg", "theta2_deg")
    angles = [
        x if x is not None or start.ratio else angle_of(record[key]["midpoint"])
        for x, key in zip(start.angles, keys, strict=True)
    ]
    if start.energy is None:
        return [angle_of(record["theta2_deg"]["midpoint"])]
    p1, p2 = (fraction(record[f"p{k}_kg_m2_s"]["midpoint"]) / units.momentum for k in (1, 2))
    lam, mu = start.pendulum
    c = (angles[0] - angles[1]).cos()
    share = mu * lam * lam * (1 + mu * (1 - c * c))
    velocities = (
        (mu * lam * lam * p1 - mu * lam * c * p2) / share,
        ((1 + mu) * p2 - mu * lam * c * p1) / share,
    )
    whole = [*angles, *velocities]
    return [whole[k] for k in start.unknown]


def compare(record: dict[str, Any], start: Start, orbit: Orbit) -> None:
    """Holds the printed intervals to what was proved here."""
    units, state, kappa = units_of(record), orbit.state, kappa_of(start, orbit)
    found = {f"theta{k + 1}_deg": state[k] * 180 / arb.pi() for k in (0, 1) if k in start.unknown}
    found |= {"period_s": orbit.duration * start.parts * units.second, "kappa": kappa}
    if start.energy is None:
        found["energy_J"] = energy_of(start.pendulum, state) * units.joule
    else:
        for k, p in enumerate(momenta(start.pendulum, state), 1):
            found[f"p{k}_kg_m2_s"] = p * units.momentum
    for key, value in found.items():
        if not inside(value, record[key]):
            reason = f"{key} is {value.str(25)}, which the printed interval does not hold"
            raise (FalseClaim if apart(value, record[key]) else NoProof)(reason)
    name = class_of(kappa)
    if record["stability"] not in (name, "not decided"):
        raise NoProof(f"it is {name or 'not decided'}, kappa = {kappa.str(15)}")
    if record["minimal"]:
        check_minimal(start, orbit)


def check(record: dict[str, Any]) -> str:
    """Empty if the certificate is proved again, else why not."""
    if record.get("identifier") != identifier_of(record):
        return "the identifier is not that of the content"
    reason = "it claims nothing"
    if record["status"] not in ("proved", "digits_not_proved"):
        return reason
    keys = ("period_s", "p1_kg_m2_s", "p2_kg_m2_s", "theta1_deg", "theta2_deg")
    radii = [Fraction(record[key]["radius"]) for key in keys if record.get(key)]
    sharp = max(float(Fraction(record["kappa"]["radius"])), 1e-300)
    of_kappa = -math.log10(sharp) * DIGITS_FOR_KAPPA - TRIES[0][0]
    digits = max(math.ceil(max(-math.log10(min(map(float, radii))), of_kappa)) + 1, 16)
    for extra, share in TRIES:
        ctx.prec = int(3.33 * (digits + extra + SPARE_DIGITS)) + 30
        try:
            start, units = start_of(record), units_of(record)
            free = [x.mid() for x in guesses_of(record, start, units)]
            duration = fraction(record["period_s"]["midpoint"]) / start.parts / units.second
            orbit = prove(start, free, duration.mid(), digits + extra, share)
            compare(record, start, orbit)
            return ""
        except (ArithmeticError, ValueError) as error:
            reason = str(error)
            if isinstance(error, FalseClaim):
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
        given = record.get("start") or record["theta1"]
        name = f"{record['symmetry']}, {' '.join(map(str, given.values()))} {record['identifier']}"
        spent = f"{time.process_time() - begun:.1f} s, {ctx.prec} bits"
        print(f"{'FAILED' if reason else 'proved'} {name}: {reason or spent}", flush=True)
    print(f"{len(records) - failed} of {len(records)} proved again, {failed} failed; "
          f"{time.process_time() - started:.0f} s of CPU")  # fmt: skip
    return int(failed > 0 or not records)


if __name__ == "__main__":
    sys.exit(main())
