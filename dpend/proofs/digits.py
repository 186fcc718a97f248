"""Many proved digits: Newton's method in ball arithmetic on the same chain of discs.

The polynomials of the discs get a higher order and coefficients of many bits. Each pass evaluates
the defects of the differential equation and of the matches exactly enough, and solves for the
corrections in float64 with the derivatives at hand, so that a pass gains ten digits or more. None
of this needs to be right.

The proof is that of `proof`, with the defects bounded at high precision and the derivatives on
narrow tubes about the polynomials rounded to float64: Y is then as small as the defects, and Z is
what it was.

kappa gets as many digits by the derivative of the flow along the same polynomials, step 4 of `flow`
with coefficients of many bits.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from flint import arb, arb_mat, arb_poly, arb_series, ctx

from dpend.proofs.balls import (
    ENTRIES,
    SIGNS,
    TINY,
    field,
    field_and_jacobian,
    precision,
    upper,
)
from dpend.proofs.chain import ORDER, TERMS
from dpend.proofs.facts import Stability, stability_along
from dpend.proofs.flow import COVER, Discs, cauchy_bounds, enclose, polynomial_defects
from dpend.proofs.proof import (
    BITS,
    NoProof,
    Proof,
    contraction_box,
    gap_of,
    operator_of,
)
from dpend.proofs.taylor import jacobian_series, motion_series, tangent_series

# Digits beyond those wanted that Newton's method aims at; digits that a term of a series brings
# (discs are as long as 16 digits need 30 terms); bits of a decimal digit, and some to spare.
EXTRA, DIGITS_A_TERM, BITS_A_DIGIT, SPARE_BITS = 10, 16 / 30, 3.33, 40
# Half width of the tubes about the rounded polynomials, and the most digits and passes: bounds are
# float64 numbers, which end at 1e-308.
TUBE, MOST_DIGITS, PASSES = 1e-11, 250, 120
# A pass that gains less than this factor is the last.
LEAST_GAIN = 0.1


class Digits(NamedTuple):
    """The state at the start and the duration of the arc [natural] as balls of `bits` bits.

    `stability` is what many bits tell of it, `None` without them.
    """

    start: list[Any]
    duration: Any
    bits: int
    stability: Stability | None = None


class _Fine:
    """Polynomials with coefficients of many bits: rows[i][k][n], and the duration."""

    def __init__(self, proof: Proof, order: int) -> None:
        self.chain, self.order = proof.chain, order
        problem, discs = proof.chain.problem, proof.discs
        step = discs.half * discs.duration
        self.series = motion_series(self.chain.ratios, discs.series[0], step, order)
        self.jacobian = jacobian_series(self.chain.ratios, self.series)
        self.tangents = tangent_series(self.jacobian, step)
        self.pendulum = problem.pendulum.balls()
        self.duration = arb(discs.duration)
        self.half = [arb(float(w)) for w in discs.half]
        columns = np.moveaxis(self.series, 0, -1)
        self.rows = [[[arb(float(x)) for x in row] for row in disc] for disc in columns]
        for i, known in ((0, problem.start), (-1, problem.end)):
            for k, ball in known.items():
                self.rows[i][k][0] = ball().mid()
        self._tie()
        start = Discs(self.series, self.tangents, discs.half, discs.duration)
        self.inverse = np.linalg.inv(self.chain.newton_matrix(start))
        self.signs = start.signs()[:, None, None]
        self.rates = self.series * np.arange(order + 1)[:, None, None] / discs.duration

    def _tie(self) -> None:
        """Sets the starts that follow from others, up to rounding."""
        problem = self.chain.problem
        if problem.ratio is not None:
            self.rows[0][0][0] = self.rows[0][1][0] * problem.ratio
        if problem.tie:
            for row, x in zip(self.rows[-1], self.chain.tied_end(self.start()), strict=True):
                row[0] = x.mid()

    def start(self) -> list[Any]:
        """The state at the first centre, its given parts exactly."""
        return self.chain.exact_start([row[0] for row in self.rows[0]])

    def residuals(self) -> Any:
        """Term by term d f(P) - P', in float64."""
        out = np.zeros_like(self.series)
        for i, rows in enumerate(self.rows):
            step = self.duration * self.half[i]
            slopes = field(self.pendulum, [arb_series(row) for row in rows])
            for k in range(4):
                known = slopes[k].coeffs()
                for n in range(self.order):
                    slope = step * known[n] if n < len(known) else arb(0)
                    out[n, i, k] = float((slope - rows[k][n + 1] * (n + 1)).mid())
        return out

    def ends(self) -> list[tuple[Any, Any]]:
        """The polynomials at s = 1 and s = -1."""
        whole = [[arb_poly(row) for row in rows] for rows in self.rows]
        return [([p(arb(1)) for p in row], [p(arb(-1)) for p in row]) for row in whole]

    def correct(self) -> float:
        """One pass; returns the size of the largest correction."""
        left, chain = self.residuals(), self.chain
        step = (chain.half * float(self.duration))[:, None]
        local = np.zeros_like(left)
        for n in range(self.order):
            slope = np.einsum("jsab,jsb->sa", self.jacobian[: n + 1], local[n::-1])
            local[n + 1] = (slope * step + left[n]) / (n + 1)
        ends = self.ends()
        gap = np.array(
            [
                [float((x - y).mid()) for x, y in zip(ends[i][0], ends[i + 1][1], strict=True)]
                for i in range(chain.joints)
            ]
        )
        gap += local.sum(0)[:-1] - (local * self.signs).sum(0)[1:]
        off = np.array(float(chain.energy_gap(self.start()).mid()))
        change = -self.inverse @ chain.rows(gap.ravel(), off)
        states = chain.by_unknown(change)
        moved = local + np.einsum("jsab,sb->jsa", self.tangents, states) + self.rates * change[0]
        self.add(moved, float(change[0]))
        return float(max(np.abs(change).max(), np.abs(local).max()))

    def add(self, change: Any, duration: float) -> None:
        for i, rows in enumerate(self.rows):
            for k, row in enumerate(rows):
                for n in range(self.order + 1):
                    row[n] = (row[n] + arb(float(change[n, i, k]))).mid()
        self._tie()
        self.duration = (self.duration + arb(duration)).mid()

    def sizes(self, i: int) -> Any:
        """The sizes of a disc's coefficients in float64, shape (N + 1, 4), enlarged by more than
        their rounding and what is lost below the least normal number; the rounding of P(0) is
        inside the tube.
        """
        floats = np.array([[float(x) for x in row] for row in self.rows[i]]).T
        floats[1:] = np.abs(floats[1:]) * (1 + 1e-15) + TINY
        return floats

    def defects(self, terms: int) -> Any:
        """eta of every disc, the errors of the fixed parts of the states included."""
        problem, out = self.chain.problem, np.zeros(self.chain.index.shape)
        for i, rows in enumerate(self.rows):
            tails, _ = cauchy_bounds(self.pendulum, self.sizes(i), TUBE, terms)
            slopes = field(self.pendulum, [arb_series(row) for row in rows])
            step = self.duration * self.half[i]
            out[i] = polynomial_defects(slopes, rows, step, tails, terms)
        for i, known in ((0, problem.start), (-1, problem.end)):
            for k, ball in known.items():
                out[i, k] += upper(ball() - self.rows[i][k][0])
        if problem.tie:
            for k, x in enumerate(self.chain.tied_end(self.start())):
                out[-1, k] += upper(x - self.rows[-1][k][0])
        return out * COVER

    def rounded(self) -> tuple[Discs, Any]:
        """Discs of the proof's own order, rounded to float64, and how far from these they are."""
        series = np.zeros((ORDER + 1, len(self.rows), 4))
        distance = np.zeros(len(self.rows))
        for i, rows in enumerate(self.rows):
            for k, row in enumerate(rows):
                series[:, i, k] = [float(x) for x in row[: ORDER + 1]]
                near = (upper(x - arb(series[n, i, k])) for n, x in enumerate(row[: ORDER + 1]))
                total = sum(near) + sum(upper(x) for x in row[ORDER + 1 :])
                distance[i] = max(distance[i], total * COVER)
        half, duration = self.chain.half, float(self.duration)
        tangents = tangent_series(jacobian_series(self.chain.ratios, series), half * duration)
        return Discs(series, tangents, half, duration), distance


def refine(proof: Proof, digits: int) -> Digits:
    """The start and the duration with errors below 10^-digits, proved anew.

    Raises:
        NoProof: with the reason.
    """
    goal = digits + EXTRA
    order = int(goal / DIGITS_A_TERM) + 4
    bits, terms = int(goal * BITS_A_DIGIT) + SPARE_BITS, order + 2
    if digits > MOST_DIGITS:
        raise NoProof(f"more than {MOST_DIGITS} digits are not tried")
    try:
        with precision(bits, terms):
            fine = _Fine(proof, order)
            _polish(fine, 10.0 ** (2 - goal))
            return _prove_fine(proof, fine, terms, digits)
    except NoProof:
        raise
    except (ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
        raise NoProof(str(error)) from error


def _polish(fine: _Fine, enough: float) -> None:
    last = math.inf
    for _ in range(PASSES):
        size = fine.correct()
        if size < enough or size > last * LEAST_GAIN:
            break
        last = size


def _prove_fine(proof: Proof, fine: _Fine, terms: int, digits: int) -> Digits:
    chain, defects, ends = fine.chain, fine.defects(terms), fine.ends()
    discs, distance = fine.rounded()
    tube = np.full(len(discs.half), TUBE)
    with precision(BITS, TERMS):
        pendulum = chain.problem.pendulum.balls()
        tubes = enclose(pendulum, discs, tube, TUBE, np.zeros_like(defects), TERMS)
        middle, errors = chain.derivative(discs, tubes, TUBE)
        closes = chain.closes(discs, TUBE)
        inverse = np.linalg.inv(middle)
    exact = tubes._replace(defect=defects)
    radii = contraction_box(
        operator_of(
            inverse, gap_of(chain, ends, exact, chain.energy_gap(fine.start())), middle, errors
        )
    )
    if radii is None:
        raise NoProof("the operator does not map any box at high precision into itself")
    late = upper(fine.duration - arb(discs.duration)) + float(radii[0])
    # Once for the rounding itself, twice for the excursion, which was bounded without it.
    share = 2 * tubes.growth * (late / discs.duration) * COVER
    space = tube - distance * (1 + share) * COVER
    if not exact.holds(chain.offsets(radii), late, discs.duration, space) or late >= TUBE:
        raise NoProof("the solutions from the box leave the tubes")
    if not _same_orbit(fine, proof, radii):
        raise NoProof("it may be another orbit that has these digits")
    if not closes:
        raise NoProof("where the motion closes, the energy does not tell the last component")
    off = chain.offsets(radii)[0]
    start = [x + arb(0, float(r)) for x, r in zip(fine.start(), off, strict=True)]
    if not (largest := max(radii[: chain.starts.stop])) < 10.0**-digits:
        raise NoProof(f"the error is {largest:.1e}, not below 1e-{digits}")
    duration = fine.duration + arb(0, float(radii[0]))
    far = chain.offsets(radii).max(-1) + defects.max(-1)
    far = far + 2 * tubes.excursion * (float(radii[0]) / discs.duration)
    ends = _fine_tangents(fine, duration, float((far * tubes.growth).max() * COVER), tubes.growth)
    return Digits(start, duration, ctx.prec, stability_along(ends, chain.problem.symmetry))


def _same_orbit(fine: _Fine, proof: Proof, radii: Any) -> bool:
    """Whether the box lies in that of the proof, which holds one orbit only."""
    chain, centres = proof.chain, proof.discs.series[0]
    wide, narrow = chain.offsets(proof.radii), chain.offsets(radii)
    off = np.array(
        [
            [upper(row[0] - arb(float(x))) for row, x in zip(rows, states, strict=True)]
            for rows, states in zip(fine.rows, centres, strict=True)
        ]
    )
    inside = ((off + narrow) * COVER < wide) | (chain.index < 0)
    late = upper(fine.duration - arb(proof.discs.duration)) + float(radii[0])
    return bool(inside.all() and late * COVER < proof.radii[0])


def _fine_tangents(fine: _Fine, duration: Any, tube: float, growth: Any) -> list[tuple[Any, Any]]:
    """The derivative of the flow from each centre to s = 1 and to s = -1."""
    out = []
    for i in range(len(fine.rows)):
        blocks, tail = _jacobian_blocks(fine, i, tube)
        step, terms = duration * fine.half[i], len(blocks)
        middles = [_middle(block) for block in blocks]
        tangents, error = _tangents(middles, step, fine.order)
        sizes = np.array([_sizes(w) for w in tangents])
        largest = np.array([_sizes(block) for block in blocks])
        spread = sum(_sizes(x - y) for x, y in zip(blocks, middles, strict=True)) + tail
        # What products of terms beyond the order of W bring, their divisors left out.
        beyond = np.cumsum(largest[::-1], 0)[::-1]
        for k, size in enumerate(sizes):
            if (first := max(fine.order - k, 0)) < terms:
                error += upper(step) * (beyond[first] @ size)
        error += upper(step) * (spread @ sizes.sum(0))
        off = (error.max(0) * growth[i] * COVER**2 + TINY).tolist()
        around = arb_mat([[arb(0, off[b]) for b in range(4)] for _ in range(4)])
        even = sum(tangents[2::2], tangents[0])
        uneven = sum(tangents[3::2], tangents[1])
        out.append((even + uneven + around, even - uneven + around))
    return out


def _tangents(middles: list[Any], step: Any, order: int) -> tuple[list[Any], Any]:
    """Coefficients of W, exact numbers, and how far they are from those of 1 + d int J W."""
    tangents = [arb_mat([[int(a == b) for b in range(4)] for a in range(4)])]
    error = np.zeros((4, 4))
    for n in range(order):
        total = arb_mat(4, 4)
        for j in range(min(n + 1, len(middles))):
            total += middles[j] * tangents[n - j]
        slope = total * (step / (n + 1))
        tangents.append(_middle(slope))
        error += _sizes(slope - tangents[-1])
    return tangents, error


def _jacobian_blocks(fine: _Fine, i: int, tube: float) -> tuple[list[Any], Any]:
    """Coefficients of the field's Jacobian within the tube of a disc, 4 x 4 balls, and the tail."""
    rows, around = fine.rows[i], arb(0, tube)
    state = [arb_series([row[0] + around, *row[1:]]) for row in rows]
    _, entries = field_and_jacobian(fine.pendulum, state)
    terms = fine.order + 2
    if any(entry.prec < terms for entry in entries):
        raise ArithmeticError("a power series lost terms")
    known = [[*entry.coeffs(), *[arb(0)] * terms][:terms] for entry in entries]
    signs = SIGNS.astype(int).tolist()
    blocks = [
        arb_mat([[known[ENTRIES[a, b]][n] * signs[a][b] for b in range(4)] for a in range(4)])
        for n in range(terms)
    ]
    _, tails = cauchy_bounds(fine.pendulum, fine.sizes(i), TUBE, terms)
    return blocks, np.array(tails)[ENTRIES]


def _middle(m: Any) -> Any:
    return arb_mat(4, 4, [x.mid() for x in m.entries()])


def _sizes(m: Any) -> Any:
    return np.array([upper(x) for x in m.entries()]).reshape(4, 4)
