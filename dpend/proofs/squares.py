"""Squares of (theta2, t) in which exactly one rest is, and that of a known orbit.

Krawczyk's test on a chain of discs gives, for each pass of an orbit, a rest at (theta2, k T/2) and
a radius within which it is the only one. The square about the float64 middle of the proof is
smaller by how far that middle may be from the rest. The square is kept if it holds theta2 of the
orbit's certificate and k times half of its period: the orbit run through k times rests there, and
nothing else does.
"""

import math
from typing import NamedTuple

import numpy as np

from dpend.proofs.certificate import Certificate, Question
from dpend.proofs.certify import problem_of, start_of
from dpend.proofs.facts import uniqueness_of
from dpend.proofs.march import distances
from dpend.proofs.proof import NoProof, prove
from dpend.proofs.rests import Known

# Two squares that overlap are made smaller than this share of their distance.
APART = 0.4
# Covers the rounding of a few operations on float64 numbers below 1000.
INWARD, ROUNDING = 1 - 1e-12, 1e-12


class Rest(NamedTuple):
    """An orbit after so many passes: the brake orbit to be proved, and the orbit's certificate."""

    question: Question
    certificate: Certificate
    passes: int


def squares_of(rests: list[Rest], second: float) -> Known:
    """The squares about rests, no two of which overlap; one that is not proved is left out.

    Arguments:
        second: the natural unit of time [s].
    """
    rows = [row for rest in rests if (row := _square(rest, second)) is not None]
    table = np.array(rows).reshape(-1, 3)
    known = Known(table[:, 0], table[:, 1], table[:, 2])
    nearest = distances(known).min(1, initial=np.inf)
    return known._replace(radius=np.minimum(known.radius, nearest * APART))


def _square(rest: Rest, second: float) -> tuple[float, float, float] | None:
    """theta2 [rad], time in natural units, and radius."""
    question, certificate, passes = rest
    problem = problem_of(question)
    try:
        start, duration = start_of(question, problem), question.period / problem.parts / second
        proof = prove(problem, start, duration)
    except NoProof:
        return None
    # The rest is within this of the square's middle, which the radius takes off.
    own = max(float(proof.radii[0]), float(proof.chain.offsets(proof.radii)[0].max()))
    radius = uniqueness_of(proof, own).start * INWARD
    theta2, time = float(proof.discs.series[0, 0, 1]), proof.discs.duration
    angle, period = certificate.theta2_deg, certificate.period
    if angle is None or period is None:
        return None
    apart = abs(math.radians(float(angle)) - theta2) + math.radians(float(angle.radius))
    late = abs(passes * float(period) / 2 / second - time)
    late += passes * float(period.radius) / second
    return (theta2, time, radius) if max(apart, late) + ROUNDING < radius else None
