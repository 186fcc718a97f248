"""`certify`: the friendly call that proves a periodic orbit.

The steps are existence (`proof`), the minimal period, stability and uniqueness (`facts`), and many
digits where they are wanted (`digits`). python-flint is imported when a proof begins.
"""

import math
import time
from dataclasses import replace
from fractions import Fraction
from typing import TYPE_CHECKING, Any

from dpend.checks import at_most_one, instance, integer, known_number, one_of, single
from dpend.mechanics.pendulum import Pendulum, known_pendulum
from dpend.orbits.arc import RELEASED_SYMMETRIES
from dpend.orbits.orbit import PeriodicOrbit
from dpend.proofs.certificate import Certificate, Question, Release
from dpend.proofs.decimals import below, shortest
from dpend.records import parse_decimal
from dpend.status import Status

if TYPE_CHECKING:
    from dpend.proofs.proof import Problem, Proof

# A proved orbit whose theta2 [rad] or period (relative) is further than this from the one asked
# about is another orbit. Solved orbits of the atlas are within 1e-11.
FAR = 1e-8
# The release angle in degrees and the orbit's theta1 [rad] may differ by rounding of both.
SAME_ANGLE = 1e-12
# Digits that are proved without `digits`, and more than are printed of energies and kappa.
USUAL_DIGITS, KAPPA_DIGITS = 16, 30


def certify(
    orbit: PeriodicOrbit | Any,
    *,
    theta1_deg: str | float | Any | None = None,
    ratio: int | Any | None = None,
    digits: int | Any | None = None,
) -> Certificate:
    """Proves a periodic orbit that is released from rest.

    The pendulum's parameters count as the shortest decimals that read back as its float64 numbers:
    0.2 is 1/5. A proof that does not succeed is a `status` with its reason, no exception.

    Arguments:
        orbit: a single centred or brake orbit, as `find_orbit` returns it.
        theta1_deg: the release angle as the exact decimal of degrees that was meant. By default
            theta1 is exactly the float64 number of radians in `orbit`.
        ratio: 1 or -1, to prove an orbit on the line theta1 = ratio theta2 instead of one at a
            release angle.
        digits: prove as many decimals of theta2 and the period; 50 take half a second.
    Raises:
        ValueError: no single orbit; a theta1_deg that is not the orbit's; digits out of range.
        RuntimeError: python-flint is missing.
    """
    instance("orbit", orbit, PeriodicOrbit, "dpend.find_orbit(pendulum, theta1, branch=...)")
    for name in ("theta1", "theta2", "period"):
        single(name, getattr(orbit, name))
    wanted = None if digits is None else integer("digits", digits, least=1)
    pendulum = known_pendulum(orbit.pendulum)
    decimals = decimals_of(pendulum)
    centred = orbit.symmetry == "centred"
    turns = (int(orbit.turns[0]), int(orbit.turns[1])) if centred else None
    release = _release(float(orbit.theta1), float(orbit.theta2), theta1_deg, ratio)
    theta2, period = float(orbit.theta2), float(orbit.period)
    question = Question(decimals, release, theta2, period, turns)
    if orbit.symmetry not in RELEASED_SYMMETRIES:
        reason = (
            f"It is {orbit.symmetry}; only {' and '.join(RELEASED_SYMMETRIES)} orbits are covered."
        )
        return replace(_empty(question, Status.NOT_COVERED, reason), symmetry=orbit.symmetry)
    require_flint()
    return answer(question, wanted)


def decimals_of(pendulum: Pendulum) -> tuple[str, str, str, str, str]:
    """The shortest decimals that read back as the pendulum's numbers."""
    l1, l2, m1, m2, g = (shortest(float(leaf)) for leaf in vars(pendulum).values())
    return l1, l2, m1, m2, g


def require_flint() -> None:
    """Refuses to prove anything without ball arithmetic.

    Raises:
        RuntimeError: python-flint is missing.
    """
    try:
        import flint  # noqa: F401
    except ImportError:
        raise RuntimeError(
            "proofs need python-flint: run `pip install dpend[proof]` or `pip install python-flint`"
        ) from None


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


def _empty(question: Question, status: Status, reason: str) -> Certificate:
    symmetry = "brake" if question.turns is None else "centred"
    turns = question.turns or (0, 0)
    return Certificate(question.pendulum, question.release, symmetry, turns, status, reason)


def problem_of(question: Question) -> "Problem":
    """The question as the proof takes it."""
    from flint import arb

    from dpend.proofs.balls import Parameters, fraction_ball
    from dpend.proofs.proof import Problem

    text, unit, ratio = question.release

    def theta1() -> Any:
        if unit == "deg":
            return arb.pi() * fraction_ball(Fraction(text)) / 180
        return fraction_ball(Fraction(float(text)))

    return Problem(Parameters(*question.pendulum), theta1, question.turns, ratio or None)


def answer(question: Question, digits: int | None = None) -> Certificate:
    """`certify` on plain numbers: what a catalogue's rows go through."""
    from dpend.proofs.proof import NoProof, prove

    started = time.process_time()
    if not float(question.pendulum[4]) > 0:
        return _empty(question, Status.NOT_COVERED, "Gravity must point downwards.")
    if not (math.isfinite(question.theta2) and 0 < question.period < math.inf):
        return _empty(question, Status.NOT_PROVED, "There is no orbit to begin with.")
    try:
        problem = problem_of(question)
        second = math.sqrt(float(question.pendulum[0]) / float(question.pendulum[4]))
        proof = prove(problem, question.theta2, question.period / problem.parts / second)
        found = _conclude(question, problem, proof, digits)
    except NoProof as error:
        found = _empty(question, Status.NOT_PROVED, str(error) + ".")
    return replace(found, seconds=time.process_time() - started)


def _digits(proof: "Proof", digits: int | None) -> tuple[Any, Status, str]:
    """`Digits` as many as are proved, and how that went."""
    from flint import arb

    from dpend.proofs.balls import BITS_OF_PRODUCTS
    from dpend.proofs.digits import Digits, refine
    from dpend.proofs.proof import NoProof

    if digits is not None:
        try:
            return refine(proof, digits), Status.PROVED, ""
        except NoProof as error:
            status, reason = Status.DIGITS_NOT_PROVED, f"{error}."
    else:
        status, reason = Status.PROVED, ""
    theta2 = arb(float(proof.discs.series[0, 0, 1]), float(proof.radii[0]))
    duration = arb(proof.discs.duration, float(proof.radii[1]))
    return Digits(theta2, duration, BITS_OF_PRODUCTS), status, reason


def _conclude(
    question: Question, problem: "Problem", proof: "Proof", digits: int | None
) -> Certificate:
    """The facts of a proof, in SI units."""
    from flint import arb

    from dpend.proofs.balls import enclosure_of, energy_ball, precision
    from dpend.proofs.facts import moves, stability_of, uniqueness_of

    best, status, reason = _digits(proof, digits)
    stability, unique = stability_of(proof), uniqueness_of(proof)
    with precision(best.bits):
        theta1 = best.theta2 * problem.ratio if problem.ratio else problem.theta1()
        energy = energy_ball(problem.pendulum.balls(), theta1, best.theta2)
        second = problem.pendulum.second() * problem.parts
        period, printed = best.duration * second, (digits or USUAL_DIGITS) + 5
        found = replace(
            _empty(question, status, reason),
            theta2_deg=enclosure_of(best.theta2 * 180 / arb.pi(), printed),
            period=enclosure_of(period, printed),
            energy=enclosure_of(energy * problem.pendulum.joule(), printed),
            kappa=enclosure_of(stability.kappa, KAPPA_DIGITS),
            stability=stability.name,
            minimal=moves(proof),
            digits=0 if digits is None or reason else digits,
            discs=len(proof.discs.half),
        )
    if unique.release > 0:
        scale = float(second) * (1 - 1e-9)
        degrees = below(math.degrees(unique.release))
        found = replace(
            found, unique_theta2_deg=degrees, unique_period=below(unique.release * scale)
        )
    return _same_orbit(question, found)


def _same_orbit(question: Question, found: Certificate) -> Certificate:
    """Refuses an orbit that Newton's method went to from another place."""
    theta2, period = math.radians(float(found.theta2_deg or 0)), float(found.period or 0)
    if (
        abs(theta2 - question.theta2) <= FAR
        and abs(period - question.period) <= FAR * question.period
    ):
        return found
    reason = (
        f"The orbit that was proved nearby has theta2 = {found.theta2_deg} deg and the period "
        f"{found.period} s."
    )
    return _empty(question, Status.ANOTHER_ORBIT, reason)
