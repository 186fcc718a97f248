"""`certify`: the friendly call that proves a periodic orbit.

The steps are existence (`proof`), the minimal period, stability and uniqueness (`facts`), and many
digits where they are wanted (`digits`). python-flint is imported when a proof begins.
"""

import math
import time
from dataclasses import replace
from fractions import Fraction
from functools import partial
from typing import TYPE_CHECKING, Any

from dpend.checks import instance, integer, single
from dpend.mechanics.pendulum import known_pendulum
from dpend.orbits.arc import RELEASED_SYMMETRIES
from dpend.orbits.orbit import PeriodicOrbit
from dpend.proofs.certificate import Certificate, Passage, Question, Release
from dpend.proofs.decimals import below
from dpend.proofs.question import passage_question, release_question
from dpend.status import Status

if TYPE_CHECKING:
    from dpend.proofs.chain import Problem
    from dpend.proofs.digits import Digits
    from dpend.proofs.proof import Proof

# A proved orbit whose start (natural units) or period (relative) is further than this from the one
# asked about is another orbit. Solved orbits of the atlas are within 1e-11.
FAR = 1e-8
# Digits that are proved without `digits`, and the most that are printed of kappa: as many as
# check_certificates.py proves again, whose kappa has two fifths of the digits of its box.
USUAL_DIGITS, KAPPA_DIGITS = 16, 20
# Digits with which kappa is enclosed again where float64 does not tell it from 1 or -1.
DECIDING_DIGITS = 40


def certify(
    orbit: PeriodicOrbit | Any,
    *,
    theta1_deg: str | float | Any | None = None,
    ratio: int | Any | None = None,
    energy: str | float | Any | None = None,
    digits: int | Any | None = None,
) -> Certificate:
    """Proves a periodic orbit: released from rest, or never at rest, whatever its symmetry.

    The pendulum's parameters count as the shortest decimals that read back as its float64 numbers:
    0.2 is 1/5. A proof that does not succeed is a `status` with its reason, no exception.

    Arguments:
        orbit: a single one, as `find_orbit`, `find_orbits` and families return it.
        theta1_deg: the release angle as the exact decimal of degrees that was meant. By default
            theta1 is exactly the float64 number of radians in `orbit`.
        ratio: 1 or -1, to prove an orbit on the line theta1 = ratio theta2 instead of one at a
            release angle.
        energy: of an orbit that never rests, the energy as the exact decimal of joules that was
            meant. By default the shortest decimal that reads back as the orbit's energy.
        digits: prove as many decimals of the start and the period; 50 take half a second.
    Raises:
        ValueError: no single orbit; a theta1_deg or energy that is not the orbit's, or does not go
            with its symmetry; digits out of range.
        RuntimeError: python-flint is missing.
    """
    instance("orbit", orbit, PeriodicOrbit, "dpend.find_orbit(pendulum, theta1, branch=...)")
    for name in ("theta1", "theta2", "period"):
        single(name, getattr(orbit, name))
    wanted = None if digits is None else integer("digits", digits, least=1)
    known_pendulum(orbit.pendulum)
    if orbit.symmetry in RELEASED_SYMMETRIES:
        _refuse(orbit, energy=energy)
        question = release_question(orbit, theta1_deg, ratio)
    else:
        _refuse(orbit, theta1_deg=theta1_deg, ratio=ratio)
        question = passage_question(orbit, energy)
    require_flint()
    return answer(question, wanted)


def _refuse(orbit: PeriodicOrbit, **options: Any) -> None:
    for name, value in options.items():
        if value is not None:
            raise ValueError(
                f"{name} does not go with {orbit.symmetry} orbits, got {value!r:.60}: leave it out"
            )


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


def _empty(question: Question, status: Status, reason: str) -> Certificate:
    symmetry, turns = question.symmetry, question.turns or (0, 0)
    return Certificate(question.pendulum, question.release, symmetry, turns, status, reason)


def problem_of(question: Question) -> "Problem":
    """The question as the proof takes it."""
    from flint import arb

    from dpend.proofs.balls import Parameters, fraction_ball
    from dpend.proofs.chain import Problem, at_turns, release

    pendulum, start = Parameters(*question.pendulum), question.release

    def angle(text: str) -> Any:
        return arb.pi() * fraction_ball(Fraction(text)) / 180

    if isinstance(start, Release):
        text, unit, ratio = start

        def theta1() -> Any:
            return angle(text) if unit == "deg" else fraction_ball(Fraction(float(text)))

        return release(pendulum, theta1, question.turns, ratio or None)

    def energy() -> Any:
        return fraction_ball(Fraction(start.energy)) / pendulum.joule()

    given = {k: partial(angle, text) for k, text in enumerate((start.theta1, start.theta2)) if text}
    n1, n2 = question.turns or (0, 0)
    if start.symmetry == "passing":
        end = int(start.theta1) // 180 + n1, int(start.theta2) // 180 + n2
        return Problem(pendulum, "passing", given, at_turns(end), energy=energy)
    return Problem(pendulum, start.symmetry, given, turns=(n1, n2), energy=energy)


def start_of(question: Question, problem: "Problem") -> list[float]:
    """The start in natural units."""
    if question.state is None:
        theta1 = problem.ratio * question.theta2 if problem.ratio else problem.start[0]().mid()
        return [float(theta1), question.theta2, 0.0, 0.0]
    unit = float(problem.pendulum.momentum().mid())
    a, b, p, q = question.state
    return [a, b, p / unit, q / unit]


def answer(question: Question, digits: int | None = None) -> Certificate:
    """`certify` on plain numbers: what a catalogue's rows go through."""
    from dpend.proofs.proof import NoProof, prove

    started = time.process_time()
    if not float(question.pendulum[4]) > 0:
        return _empty(question, Status.NOT_COVERED, "Gravity must point downwards.")
    numbers = (question.theta2, question.period, *(question.state or ()))
    if not (all(map(math.isfinite, numbers)) and question.period > 0):
        return _empty(question, Status.NOT_PROVED, "There is no orbit to begin with.")
    try:
        problem = problem_of(question)
        second = math.sqrt(float(question.pendulum[0]) / float(question.pendulum[4]))
        start = start_of(question, problem)
        duration = question.period / problem.parts / second
        proof = prove(problem, start, duration)
        if reason := _another(proof, start, duration):
            found = _empty(question, Status.ANOTHER_ORBIT, reason)
        else:
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
    exact = proof.chain.exact_start([arb(float(x)) for x in proof.discs.series[0, 0]])
    off = proof.chain.offsets(proof.radii)[0]
    start = [x + arb(0, float(r)) for x, r in zip(exact, off, strict=True)]
    duration = arb(proof.discs.duration, float(proof.radii[0]))
    return Digits(start, duration, BITS_OF_PRODUCTS), status, reason


def _conclude(
    question: Question, problem: "Problem", proof: "Proof", digits: int | None
) -> Certificate:
    """The facts of a proof, in SI units."""
    from dpend.proofs.balls import enclosure_of, precision
    from dpend.proofs.facts import moves, stability_of

    best, status, reason = _digits(proof, digits)
    stability = best.stability or _decide(proof, stability_of(proof))
    with precision(best.bits):
        period = best.duration * problem.pendulum.second() * problem.parts
        printed = (digits or USUAL_DIGITS) + 5
        found = replace(
            _empty(question, status, reason),
            **_start_intervals(question, problem, best.start, printed),
            period=enclosure_of(period, printed),
            kappa=enclosure_of(stability.kappa, KAPPA_DIGITS),
            stability=stability.name,
            minimal=moves(proof),
            digits=0 if digits is None or reason else digits,
            discs=len(proof.discs.half),
        )
    return replace(found, **_unique_radii(question, problem, proof, best))


def _decide(proof: "Proof", found: Any) -> Any:
    """Where kappa is not told from 1 or -1, many digits are asked."""
    from dpend.proofs.digits import refine
    from dpend.proofs.proof import NoProof

    if found.name != "not decided":
        return found
    try:
        return refine(proof, DECIDING_DIGITS).stability
    except NoProof:
        return found


def _start_intervals(
    question: Question, problem: "Problem", start: Any, printed: int
) -> dict[str, Any]:
    """What is not given of the start: of a release theta2 and the energy, else what moves."""
    from flint import arb

    from dpend.proofs.balls import enclosure_of, total_energy

    degrees = [x * 180 / arb.pi() for x in start[:2]]
    if isinstance(question.release, Release):
        energy = total_energy(problem.pendulum.balls(), start) * problem.pendulum.joule()
        return {
            "theta2_deg": enclosure_of(degrees[1], printed),
            "energy": enclosure_of(energy, printed),
        }
    unit = problem.pendulum.momentum()
    angles = {f"theta{k + 1}_deg": degrees[k] for k in (0, 1) if k not in problem.start}
    balls = angles | {"p1": start[2] * unit, "p2": start[3] * unit}
    return {name: enclosure_of(ball, printed) for name, ball in balls.items()}


def _unique_radii(
    question: Question, problem: "Problem", proof: "Proof", best: "Digits"
) -> dict[str, Any]:
    """How far the orbit is proved to be the only one; rounded down."""
    from dpend.proofs.balls import upper
    from dpend.proofs.facts import uniqueness_of

    own = max(upper(x - x.mid()) for x in (*best.start, best.duration))
    radius = uniqueness_of(proof, own).start
    if not radius > 0:
        return {}
    second = float(problem.pendulum.second().mid()) * problem.parts * (1 - 1e-9)
    found: dict[str, Any] = {"unique_period": below(radius * second)}
    if isinstance(question.release, Release) or len(problem.start) < 2:
        found["unique_angle_deg"] = below(math.degrees(radius))
    if isinstance(question.release, Passage):
        unit = float(problem.pendulum.momentum().mid()) * (1 - 1e-9)
        found["unique_momentum"] = below(radius * unit)
    return found


def _another(proof: "Proof", start: list[float], duration: float) -> str:
    """Says so if Newton's method went to an orbit in another place; else empty. Natural units."""
    problem, own = proof.chain.problem, proof.discs.series[0, 0]
    far = max(abs(float(x) - y) for x, y in zip(own, start, strict=True))
    if far <= FAR and abs(proof.discs.duration - duration) <= FAR * duration:
        return ""
    period = proof.discs.duration * problem.parts * float(problem.pendulum.second().mid())
    angles = f"theta1 = {math.degrees(own[0]):.15g} deg, theta2 = {math.degrees(own[1]):.15g} deg"
    return f"The orbit that was proved nearby has {angles} and the period {period:.15g} s."
