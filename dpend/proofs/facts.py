"""What follows from a proof: rests, the minimal period, kappa, and where no other orbit is.

All of it is about the true orbit, which lies in the tubes of the proof.

*Rests and the minimal period.* Suppose that the period were T/k for some k >= 2; states count up to
full turns of the rods. `moves` excludes it on the arc.
- Released from rest: the orbit would be at rest after T/(2k) too, because x(-t) = (theta, -p)(t);
  but T/(2k) <= T/4 is on the arc, on which the momenta do not both vanish strictly between the
  release and the end (for a centred orbit also not at its end). By the same symmetries it rests at
  0 and T/2 only.
- Passing: theta would be in {0, pi}^2 after T/(2k) too, because x(-t) = (-theta, p)(t); but that is
  not so strictly between 0 and T/2.
- Odd: for an even k, x(T/2) = x(0), so that x(t) = -x(t) for all t, and the orbit would be at rest.
  For an odd k, x(T/k) = x(0) with T/k <= T/3; but x(t) is not x(0) for 0 < t <= T/2.
- Without symmetry: x(T/k) = x(0); but x(t) is not x(0) for 0 < t < T.
The last three never rest: the momenta vanish together nowhere on the arc, which tells of the whole
orbit by its symmetry.

*kappa.* Half the sum of the two Floquet multipliers that are not the trivial pair 1, 1. Let
Q = [[A, B], [C, D]] be the derivative of the flow along the arc in (theta, p),
R = diag(1, 1, -1, -1) and t = tr(B^T C). The derivative along twice the arc of an orbit that turns
back at the arc's end is R Q^-1 R Q (-R in place of R for passing orbits, which is the same), its
trace is 2 tr(A^T D + B^T C), and A^T D - C^T B = 1 (Q is symplectic), so that this trace is
4 + 4 t. The arc of a brake and of a passing orbit is half the period: 2 + 2 kappa = 4 + 4 t. A
centred orbit's is a quarter; its half period followed by x -> -x is a map with the derivative
-R Q^-1 R Q, whose trace is 2 + 2 c, so that c = -3 - 2 t, and kappa = 2 c^2 - 1. An odd orbit's
half period followed by x -> -x has the derivative -Q: 2 + 2 c = -tr Q, and kappa = 2 c^2 - 1. With
c the orbit is elliptic for |c| < 1 and hyperbolic for |c| > 1. Without symmetry 2 + 2 kappa = tr Q.
Q is the product of the discs' derivatives; a backward one is inverted as a symplectic matrix.

*Uniqueness.* With wide tubes the operator maps a box of half width rho into itself: there is no
other orbit whose states at the centres are that near. `unique_start` turns it into a statement on
the unknowns of the start and tau alone: on the tubes the derivatives of the centres' states with
respect to these are bounded by D_i, so that a start within delta stays within D_i delta < rho at
all centres (it cannot leave first, by continuity).
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from flint import arb, arb_mat

from dpend.orbits.arc import RELEASED_SYMMETRIES
from dpend.proofs.balls import BITS_OF_PRODUCTS, TINY, field, precision, upper
from dpend.proofs.chain import TERMS
from dpend.proofs.flow import COVER, Tubes, enclose, end_states, polynomials
from dpend.proofs.proof import BITS, WIDE_TUBES, Proof, energy_gap, gap_of, operator_of

# Pieces of a disc that are cut finer than this and still may rest are given up. The atlas needs
# no piece below 1/32.
FINEST = 1e-3
# Tubes are this much wider than what the box needs.
NARROW = 1.01


class Stability(NamedTuple):
    """kappa, c of a centred or odd orbit (else `None`), both balls, and the class."""

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
    offsets = chain.offsets(proof.radii).max(-1) + tubes.defect.max(-1)
    offsets = offsets + tubes.excursion * (float(proof.radii[0]) / discs.duration)
    width = min(proof.width, float((offsets * tubes.growth).max()) * NARROW)
    tube, late = np.full(len(discs.half), width), float(proof.radii[0]) * COVER
    with precision(BITS, TERMS):
        known, pendulum = chain.known_errors(discs), chain.problem.pendulum.balls()
        tight = enclose(pendulum, discs, tube, late, known, TERMS)
    inside = tight.holds(chain.offsets(proof.radii), late, discs.duration, tube)
    return replace(proof, tubes=tight, width=width) if inside else proof


def _stability(proof: Proof) -> Stability:
    tubes, symmetry = proof.tubes, proof.chain.problem.symmetry
    with precision(BITS_OF_PRODUCTS):
        pairs = zip(tubes.plus, tubes.minus, tubes.spread, strict=True)
        ends = [(_matrix(plus, spread), _matrix(minus, spread)) for plus, minus, spread in pairs]
        return stability_along(ends, symmetry)


def stability_along(ends: list[tuple[Any, Any]], symmetry: str) -> Stability:
    """Encloses kappa from the derivatives of the flow over the discs' halves, forth and back."""
    kappa, c = _half_traces(_transition(ends), symmetry)
    decisive = kappa if c is None else c
    names = (
        (bool(abs(decisive) < 1), "elliptic"),
        (bool(kappa > 1), "hyperbolic"),
        (bool(kappa < -1), "inverse hyperbolic"),
    )
    return Stability(kappa, c, next((name for holds, name in names if holds), "not decided"))


def _half_traces(q: Any, symmetry: str) -> tuple[Any, Any]:
    """kappa and c from the derivative along the arc."""
    trace = sum((q[a, a] for a in range(4)), arb(0))
    if symmetry == "none":
        return trace / 2 - 1, None
    t = sum((q[a, 2 + b] * q[2 + a, b] for a in range(2) for b in range(2)), arb(0))
    if symmetry in ("brake", "passing"):
        return 1 + 2 * t, None
    c = -3 - 2 * t if symmetry == "centred" else -trace / 2 - 1
    return 2 * c * c - 1, c


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


def _transition(ends: list[tuple[Any, Any]]) -> Any:
    """The derivative of the flow along the arc."""
    out, last = ends[0][0], len(ends) - 1
    for i, (plus, minus) in enumerate(ends[1:], 1):
        out = _inverse(minus) * out
        if i < last:
            out = plus * out
    return out


class _Return(NamedTuple):
    """What the orbit must not do strictly within the arc.

    Attributes:
        hits: whether the states of a ball may do it; states are compared with `start`.
        parts: which components leave it at an end of the arc.
        ends: at which ends of the arc it does it: 0 and -1.
    """

    hits: Callable[[list[Any]], bool]
    parts: tuple[int, ...]
    ends: tuple[int, ...]


def _rests(state: list[Any]) -> bool:
    return bool(state[2].contains(0) and state[3].contains(0))


def _upright(state: list[Any]) -> bool:
    """Whether both angles may be multiples of pi."""
    return all((x / arb.pi()).contains_integer() for x in state[:2])


def _returns_of(proof: Proof) -> list[_Return]:
    symmetry = proof.chain.problem.symmetry
    if symmetry in RELEASED_SYMMETRIES:
        return [_Return(_rests, (2, 3), (0, -1) if symmetry == "brake" else (0,))]
    never = _Return(_rests, (), ())
    if symmetry == "passing":
        return [never, _Return(_upright, (0, 1), (0, -1))]
    start = [arb(float(x), proof.width) for x in proof.discs.series[0, 0]]

    def closes(state: list[Any]) -> bool:
        off = [x - y for x, y in zip(state, start, strict=True)]
        whole = [(x / (2 * arb.pi())).contains_integer() for x in off[:2]]
        return all(whole) and all(x.contains(0) for x in off[2:])

    ends = (0, -1) if symmetry == "none" else (0,)
    return [never, _Return(closes, (0, 1, 2, 3), ends)]


def moves(proof: Proof) -> bool:
    """Whether it is proved that the period is minimal, and where the orbit rests."""
    with precision(BITS):
        return all(_never(proof, which) for which in _returns_of(proof))


def _never(proof: Proof, which: _Return) -> bool:
    """Whether an orbit does not do it strictly within the arc, nor at an end not in `which`."""
    pendulum, last = proof.chain.problem.pendulum.balls(), len(proof.discs.half) - 1
    for i in range(last + 1):
        rows, around = polynomials(proof.discs, i), arb(0, proof.width)
        low, high = (0.0 if i == 0 else -1.0), (0.0 if i == last else 1.0)
        if (i == 0 and 0 in which.ends) or (i == last and -1 in which.ends):
            reach = _departure(pendulum, rows, around, (1.0 if i == 0 else -1.0, which.parts))
            if reach == 0.0:
                return False
            low, high = (reach, high) if i == 0 else (low, -reach)
        if not _nowhere(rows, around, (low, high), which.hits):
            return False
    return True


def _departure(pendulum: Any, rows: Any, around: Any, side: tuple[float, tuple[int, ...]]) -> float:
    """How far from s = 0 the derivative of one of the components keeps its sign, so that it does
    not come back to its value there, nor goes by a multiple of pi; 0 if not far enough.
    """
    sign, parts = side
    reach = 1.0
    while reach >= FINEST:
        s = arb(sign * reach / 2, reach / 2)
        state = [p(s) + around for p in rows]
        slopes = field(pendulum, state)
        for k in parts:
            near = k > 1 or bool(state[k].rad() < 1.5)
            if near and not slopes[k].contains(0):
                return reach
        reach /= 2
    return 0.0


def _nowhere(rows: Any, around: Any, span: tuple[float, float], hits: Any) -> bool:
    low, high = span
    pieces = [(low, high)] if high > low else []
    while pieces:
        a, b = pieces.pop()
        s = arb((a + b) / 2, (b - a) / 2 * COVER)
        if hits([p(s) + around for p in rows]):
            if b - a < FINEST:
                return False
            pieces += [(a, (a + b) / 2), ((a + b) / 2, b)]
    return True


class Uniqueness(NamedTuple):
    """Where there is no other orbit of the same end condition.

    Attributes:
        states: rho, natural units: no other within rho of all the centres' states and of tau.
        start: delta, no other with the unknowns of the start [natural] and tau [natural] within
            delta; 0 if not proved.
    """

    states: float
    start: float


def uniqueness_of(proof: Proof, own: float) -> Uniqueness:
    """The largest box of those tried in which the orbit is the only one; zeros if none is.

    Arguments:
        own: how precisely the start and the duration are known.
    """
    with precision(BITS, TERMS):
        for width in WIDE_TUBES:
            try:
                found = _unique_within(proof, width, own)
            except ArithmeticError:
                continue
            if found is not None:
                return found
    return Uniqueness(0.0, 0.0)


def _unique_within(proof: Proof, width: float, own: float) -> Uniqueness | None:
    chain, discs = proof.chain, proof.discs
    tube = np.full(len(discs.half), width)
    known, pendulum = chain.known_errors(discs), chain.problem.pendulum.balls()
    tubes = enclose(pendulum, discs, tube, width, known, TERMS)
    rho = min(tubes.room(tube, discs.duration), width / COVER)
    if not rho > 0:
        return None
    gap = gap_of(chain, end_states(discs), tubes, energy_gap(chain, discs))
    operator = operator_of(proof.inverse, gap, *chain.derivative(discs, tubes, width))
    box = np.full(chain.size, rho)
    if not operator.maps_inside(box):
        return None
    return Uniqueness(rho, unique_start(proof, tubes, rho, own))


def unique_start(proof: Proof, tubes: Tubes, rho: float, own: float) -> float:
    """delta, see the module's page; rounded down, and 0 if it is lost in the box of the start."""
    chain, half = proof.chain, proof.discs.half
    count = int(chain.starts.stop) - 1
    with precision(BITS_OF_PRODUCTS):
        column, largest = arb_mat(4, count + 1), 1.0
        for k in range(4):
            if chain.index[0, k] >= 0:
                column[k, int(chain.index[0, k]) - 1] = arb(float(chain.weights[0, k]))
        for i in range(len(half) - 1):
            column = _matrix(tubes.plus[i], tubes.spread[i]) * column
            for k in range(4):
                for side, j in ((0, i), (1, i + 1)):
                    slope = arb(float(tubes.slopes[side, j, k]), float(tubes.slope_spread[j, k]))
                    column[k, count] += slope * float(half[j])
            column = _inverse(_matrix(tubes.minus[i + 1], tubes.spread[i + 1])) * column
            for k in range(4):
                row = (abs(column[k, j]) for j in range(count + 1))
                largest = max(largest, upper(sum(row, arb(0))))
    delta = (rho - float(proof.radii.max()) - TINY) / largest - 2 * own
    return max(delta / COVER**2, 0.0) if np.isfinite(largest) else 0.0
