"""What follows from a proof: rests, the minimal period, kappa, and where no other orbit is.

All of it is about the true orbit, which lies in the tubes of the proof.

*Rests and the minimal period.* `moves` proves that the momenta do not both vanish strictly between
the release and the end of the arc (for a centred orbit also not at its end). Suppose that the
period were T/k for some k >= 2. The orbit would be at rest after T/(2k) too, because
x(-t) = (theta, -p)(t); but T/(2k) <= T/4 is on the arc. So T is the minimal period, and by the same
symmetries the orbit rests at 0 and T/2 only.

*kappa.* Half the sum of the two Floquet multipliers that are not the trivial pair 1, 1. Let
Q = [[A, B], [C, D]] be the derivative of the flow along the arc in (theta, p),
R = diag(1, 1, -1, -1) and t = tr(B^T C). The derivative along twice the arc is R Q^-1 R Q, its
trace is 2 tr(A^T D + B^T C), and A^T D - C^T B = 1 (Q is symplectic), so that this trace is
4 + 4 t. A brake orbit's arc is half the period: 2 + 2 kappa = 4 + 4 t. A centred orbit's arc is a
quarter; its half period followed by x -> -x is a map with the derivative -R Q^-1 R Q, whose trace
is 2 + 2 c, so that c = -3 - 2 t, and kappa = 2 c^2 - 1. A centred orbit is elliptic for |c| < 1 and
hyperbolic for |c| > 1. Q is the product of the discs' derivatives; a backward one is inverted as a
symplectic matrix.

*Uniqueness.* With wide tubes the operator maps a box of half width rho into itself: there is no
other orbit whose states at the centres are that near. `unique_release` turns it into a statement
on (theta2, tau) alone: on the tubes the derivatives of the centres' states with respect to theta2
and tau are bounded by D_i, so that a release within delta stays within D_i delta < rho at all
centres (it cannot leave first, by continuity).
"""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from flint import arb, arb_mat

from dpend.proofs.balls import BITS_OF_PRODUCTS, TINY, field, precision, upper
from dpend.proofs.flow import COVER, Tubes, enclose, end_states, polynomials
from dpend.proofs.proof import BITS, TERMS, WIDE_TUBES, Proof, gap_of, operator_of

# Pieces of a disc that are cut finer than this and still may rest are given up. The atlas needs
# no piece below 1/32.
FINEST = 1e-3
# Tubes are this much wider than what the box needs.
NARROW = 1.01


class Stability(NamedTuple):
    """kappa, c of a centred orbit (else `None`), both balls, and the class."""

    kappa: Any
    c: Any
    name: str


def stability_of(proof: Proof) -> Stability:
    """Encloses kappa; the class is "not decided" where the ball of kappa reaches 1 or -1.

    The tubes of the proof are wider than its box needs. If they do not decide, the tubes that just
    hold the orbit are bounded too, and kappa is some ten times more precise.
    """
    found = _stability(proof)
    return _stability(narrow(proof)) if found.name == "not decided" else found


def narrow(proof: Proof) -> Proof:
    """The same proof with tubes that hold little more than the orbit."""
    chain, discs, tubes = proof.chain, proof.discs, proof.tubes
    offsets = chain.by_unknown(proof.radii).max(-1) + tubes.defect.max(-1)
    offsets = offsets + tubes.excursion * (float(proof.radii[1]) / discs.duration)
    width = min(proof.width, float((offsets * tubes.growth).max()) * NARROW)
    tube, late = np.full(len(discs.half), width), float(proof.radii[1]) * COVER
    with precision(BITS, TERMS):
        known, pendulum = chain.known_errors(discs), chain.problem.pendulum.balls()
        tight = enclose(pendulum, discs, tube, late, known, TERMS)
    inside = tight.holds(chain.by_unknown(proof.radii), late, discs.duration, tube)
    return replace(proof, tubes=tight, width=width) if inside else proof


def _stability(proof: Proof) -> Stability:
    with precision(BITS_OF_PRODUCTS):
        q = _transition(proof)
        t = sum((q[a, 2 + b] * q[2 + a, b] for a in range(2) for b in range(2)), arb(0))
        c = None if proof.chain.problem.turns is None else -3 - 2 * t
        kappa = 1 + 2 * t if c is None else 2 * c * c - 1
        decisive = kappa if c is None else c
        names = (
            (bool(abs(decisive) < 1), "elliptic"),
            (bool(kappa > 1), "hyperbolic"),
            (bool(kappa < -1), "inverse hyperbolic"),
        )
        return Stability(kappa, c, next((name for holds, name in names if holds), "not decided"))


def _matrix(middle: Any, radius: Any) -> Any:
    return arb_mat(
        4, 4, [arb(float(x), float(r)) for x, r in zip(middle.flat, radius.flat, strict=True)]
    )


def _inverse(m: Any) -> Any:
    """Of a symplectic matrix [[A, B], [C, D]]: [[D^T, -B^T], [-C^T, A^T]]."""
    out = arb_mat(4, 4)
    for i in range(4):
        for j in range(4):
            sign = 1 if (i < 2) == (j < 2) else -1
            out[i, j] = m[(j + 2) % 4, (i + 2) % 4] * sign
    return out


def _transition(proof: Proof) -> Any:
    """The derivative of the flow along the arc."""
    tubes, last = proof.tubes, len(proof.discs.half) - 1
    out = _matrix(tubes.plus[0], tubes.spread[0])
    for i in range(1, last + 1):
        out = _inverse(_matrix(tubes.minus[i], tubes.spread[i])) * out
        if i < last:
            out = _matrix(tubes.plus[i], tubes.spread[i]) * out
    return out


def moves(proof: Proof) -> bool:
    """Whether it is proved that the orbit rests nowhere on the arc but at its rests."""
    with precision(BITS):
        pendulum, last = proof.chain.problem.pendulum.balls(), len(proof.discs.half) - 1
        ends = [last] if proof.chain.problem.turns is None else []
        for i in range(last + 1):
            rows, around = polynomials(proof.discs, i), arb(0, proof.width)
            low, high = (0.0 if i == 0 else -1.0), (0.0 if i == last else 1.0)
            if i == 0 or i in ends:
                reach = _departure(pendulum, rows, around, 1.0 if i == 0 else -1.0)
                if reach == 0.0:
                    return False
                low, high = (reach, high) if i == 0 else (low, -reach)
            if not _no_rest(rows[2:], around, low, high):
                return False
        return True


def _departure(pendulum: Any, rows: Any, around: Any, sign: float) -> float:
    """How far from a rest at s = 0 a momentum's derivative keeps its sign; 0 if not far enough."""
    reach = 1.0
    while reach >= FINEST:
        s = arb(sign * reach / 2, reach / 2)
        slopes = field(pendulum, [p(s) + around for p in rows])
        if not (slopes[2].contains(0) and slopes[3].contains(0)):
            return reach
        reach /= 2
    return 0.0


def _no_rest(momenta: Any, around: Any, low: float, high: float) -> bool:
    pieces = [(low, high)] if high > low else []
    while pieces:
        a, b = pieces.pop()
        s = arb((a + b) / 2, (b - a) / 2 * COVER)
        if all((p(s) + around).contains(0) for p in momenta):
            if b - a < FINEST:
                return False
            pieces += [(a, (a + b) / 2), ((a + b) / 2, b)]
    return True


class Uniqueness(NamedTuple):
    """Where there is no other orbit of the same end condition.

    Attributes:
        states: rho, natural units: no other within rho of all the centres' states and of tau.
        release: delta, no other with theta2 [rad] and tau [natural] within delta; 0 if not proved.
    """

    states: float
    release: float


def uniqueness_of(proof: Proof) -> Uniqueness:
    """The largest box of those tried in which the orbit is the only one; zeros if none is."""
    with precision(BITS, TERMS):
        for width in WIDE_TUBES:
            try:
                found = _unique_within(proof, width)
            except ArithmeticError:
                continue
            if found is not None:
                return found
    return Uniqueness(0.0, 0.0)


def _unique_within(proof: Proof, width: float) -> Uniqueness | None:
    chain, discs = proof.chain, proof.discs
    tube = np.full(len(discs.half), width)
    known, pendulum = chain.known_errors(discs), chain.problem.pendulum.balls()
    tubes = enclose(pendulum, discs, tube, width, known, TERMS)
    rho = min(tubes.room(tube, discs.duration), width / COVER)
    if not rho > 0:
        return None
    gap = gap_of(end_states(discs), tubes)
    operator = operator_of(proof.inverse, gap, *chain.derivative(tubes))
    box = np.full(chain.size, rho)
    if not operator.maps_inside(box):
        return None
    return Uniqueness(rho, unique_release(proof, tubes, rho))


def unique_release(proof: Proof, tubes: Tubes, rho: float) -> float:
    """delta, see the module's page; rounded down, and 0 if it is lost in the box of the proof."""
    half, first = proof.discs.half, proof.chain.start_tangent
    with precision(BITS_OF_PRODUCTS):
        column = arb_mat(4, 2, [x for k in range(4) for x in (float(first[k]), 0.0)])
        largest = 1.0
        for i in range(len(half) - 1):
            column = _matrix(tubes.plus[i], tubes.spread[i]) * column
            for k in range(4):
                for side, j in ((0, i), (1, i + 1)):
                    slope = arb(float(tubes.slopes[side, j, k]), float(tubes.slope_spread[j, k]))
                    column[k, 1] += slope * float(half[j])
            column = _inverse(_matrix(tubes.minus[i + 1], tubes.spread[i + 1])) * column
            sizes = (upper(abs(column[k, 0]) + abs(column[k, 1])) for k in range(4))
            largest = max(largest, *sizes)
    delta = (rho - float(proof.radii.max()) - TINY) / largest - 2 * float(proof.radii[:2].max())
    return max(delta / COVER**2, 0.0) if np.isfinite(largest) else 0.0
