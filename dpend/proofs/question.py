"""An orbit as a question to a proof: what is given exactly, as decimals, and what is known."""

import math
from typing import Any

from dpend.checks import at_most_one, known_number, one_of
from dpend.mechanics.pendulum import Pendulum, vector_field
from dpend.orbits.orbit import PeriodicOrbit
from dpend.proofs.certificate import Passage, Question, Release
from dpend.proofs.decimals import shortest
from dpend.records import parse_decimal

# The release angle in degrees and the orbit's theta1 [rad] may differ by rounding of both.
SAME_ANGLE = 1e-12
# And the energies, by the largest potential energy. Energies of solved orbits are off by 1e-14.
SAME_ENERGY = 1e-11


def decimals_of(pendulum: Pendulum) -> tuple[str, str, str, str, str]:
    """The shortest decimals that read back as the pendulum's numbers."""
    l1, l2, m1, m2, g = (shortest(float(leaf)) for leaf in vars(pendulum).values())
    return l1, l2, m1, m2, g


def release_question(orbit: PeriodicOrbit, theta1_deg: Any, ratio: Any) -> Question:
    theta2, turns = float(orbit.theta2), None
    if orbit.symmetry == "centred":
        turns = int(orbit.turns[0]), int(orbit.turns[1])
    release = _release(float(orbit.theta1), theta2, theta1_deg, ratio)
    return Question(decimals_of(orbit.pendulum), release, theta2, float(orbit.period), turns)


def passage_question(orbit: PeriodicOrbit, energy: Any) -> Question:
    """The angles of a passing orbit are given at its start; of another the one that moves faster,
    the other follows."""
    a, b, p, q = (float(x) for x in vars(orbit.state).values())
    texts = [shortest(math.degrees(x)) for x in (a, b)]
    turns = int(orbit.turns[0]), int(orbit.turns[1])
    if orbit.symmetry == "passing":
        texts = [str(180 * round(x / math.pi)) for x in (a, b) if math.isfinite(x)] or texts
    else:
        rates = vector_field(orbit.pendulum, orbit.state)
        texts[int(abs(float(rates.theta1)) > abs(float(rates.theta2)))] = ""
    if orbit.symmetry == "odd":
        half = zip((a, b), (float(orbit.dual.theta1), float(orbit.dual.theta2)), strict=True)
        n1, n2 = (round((x + y) / (2 * math.pi)) for x, y in half)
        turns = n1, n2
    start = Passage(orbit.symmetry, _energy_text(orbit, energy), texts[0], texts[1])
    return Question(decimals_of(orbit.pendulum), start, b, float(orbit.period), turns, (a, b, p, q))


def _energy_text(orbit: PeriodicOrbit, energy: Any) -> str:
    """The energy as a decimal of joules."""
    own = float(orbit.energy)
    if energy is None:
        return shortest(own)
    text = energy if isinstance(energy, str) else shortest(known_number("energy", energy, unit="J"))
    l1, l2, m1, m2, g = (abs(float(leaf)) for leaf in vars(orbit.pendulum).values())
    try:
        off = abs(parse_decimal(text) - own)
    except ValueError:
        off = math.inf
    if not off <= SAME_ENERGY * (abs(own) + g * ((m1 + m2) * l1 + m2 * l2)):
        raise ValueError(
            f"energy must be the orbit's, {own!r} J, got {text!r:.60}: give what the orbit was "
            "solved for"
        )
    return text


def _release(theta1: float, theta2: float, theta1_deg: Any, ratio: Any) -> Release:
    at_most_one(theta1_deg=theta1_deg, ratio=ratio)
    if ratio is not None:
        sign = one_of("ratio", ratio, (1, -1))
        if abs(theta1 - sign * theta2) > SAME_ANGLE * max(1, abs(theta1)):
            raise ValueError(
                f"ratio must be theta1/theta2 of the orbit, got {sign} for theta1 = {theta1} and "
                f"theta2 = {theta2} rad: solve for it with dpend.find_orbit(..., ratio={sign})"
            )
        return Release(shortest(theta1), "rad", sign)
    if theta1_deg is None:
        return Release(shortest(theta1), "rad")
    text = theta1_deg if isinstance(theta1_deg, str) else ""
    if not text:
        text = shortest(known_number("theta1_deg", theta1_deg, unit="deg"))
    try:
        off = abs(math.radians(parse_decimal(text)) - theta1)
    except ValueError:
        off = math.inf
    if not off <= SAME_ANGLE * max(1, abs(theta1)):
        raise ValueError(
            f"theta1_deg must be the orbit's release angle, {math.degrees(theta1)!r} deg, got "
            f"{text!r:.60}: give what the orbit was solved for"
        )
    return Release(text, "deg")
