"""A periodic orbit proved: Krawczyk's operator on a chain of discs (`chain`).

A zero of the chain's equations is an orbit, and no box is carried along it, so that instability
does no harm. Let x be the float64 approximation, A an approximate inverse of the derivative,
Y >= |A F(x)| and Z >= |1 - A F'| on the box x +- r. If Y + Z r < r in every component, then the box
holds exactly one zero (Krawczyk 1969; Moore 1977; Neumaier, "Interval Methods for Systems of
Equations" (1990), section 5.1; Rump, Acta Numerica 19 (2010), section 13). It needs F and F' on the
whole box, and so all solutions from the box stay in the tubes on which `flow.enclose` bounds them;
`Tubes.holds` checks it.

A F(x) and A F' are computed in float64. Their rounding errors are at most gamma_m |A| |F| and
gamma_m |A| |F'| (Higham 2002, section 3.5), whichever order the products are summed in.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from flint import arb

from dpend.proofs.balls import TINY, gamma, precision, upper
from dpend.proofs.chain import TERMS, Chain, Problem
from dpend.proofs.flow import COVER, Discs, Tubes, enclose, end_states

# Bits of the balls: one machine word.
BITS = 64
# Half widths of the tubes that are tried for existence: the narrower, the better kappa.
TUBES = (1e-12, 3e-11, 1e-9)
# And for uniqueness: the wider, the larger the box in which there is one orbit.
WIDE_TUBES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
# The box is enlarged by this until the operator maps it into itself.
SLACK, TRIES = 1.05, 30


class Gap(NamedTuple):
    """F at the approximation: middles and radii, shape (m,)."""

    middle: Any
    radius: Any


def gap_of(chain: Chain, ends: list[tuple[Any, Any]], tubes: Tubes, energy: Any) -> Gap:
    """F from the polynomials' ends, what the true solutions are off by there, and H - E."""
    off = tubes.defect.max(-1) * tubes.growth
    middle, radius = [], []
    for i in range(len(ends) - 1):
        for x, y in zip(ends[i][0], ends[i + 1][1], strict=True):
            difference = x - y
            middle.append(float(difference.mid()))
            radius.append(upper(difference - arb(middle[-1])) + off[i] + off[i + 1])
    rest = np.array(float(energy.mid()))
    off_rest = np.array(upper(energy - arb(float(rest))))
    middles, radii = np.array(middle), np.array(radius) * COVER
    return Gap(chain.rows(middles, rest), chain.rows(radii, off_rest))


class Operator(NamedTuple):
    """Bounds of Krawczyk's operator: Y, shape (m,), and Z, shape (m, m)."""

    shift: Any
    stretch: Any

    def maps_inside(self, radii: Any) -> bool:
        """Y + Z r < r."""
        return bool(((self.shift + self.stretch @ radii) * COVER < radii).all())


def operator_of(inverse: Any, gap: Gap, middle: Any, errors: Any) -> Operator:
    size, count = np.abs(inverse), len(inverse)
    shift = np.abs(inverse @ gap.middle)
    shift = shift + size @ (gap.radius + np.abs(gap.middle) * gamma(count + 4))
    stretch = np.abs(np.eye(count) - inverse @ middle)
    stretch = stretch + gamma(count + 4) * (size @ np.abs(middle)) + size @ errors
    return Operator(shift * COVER + TINY, stretch * COVER + TINY)


def contraction_box(operator: Operator) -> Any:
    """A narrow box that the operator maps into its inside, or `None`."""
    radii = operator.shift * SLACK
    for _ in range(TRIES):
        if operator.maps_inside(radii):
            return radii
        radii = (operator.shift + operator.stretch @ radii) * SLACK
    return None


@dataclass(frozen=True)
class Proof:
    """A proof, and all that follows from its tubes.

    Attributes:
        chain, discs: what it is about.
        tubes: the bounds; width: eps of all tubes.
        radii: of the box of the unknowns, about the discs' values, shape (m,).
        inverse: A.
    """

    chain: Chain
    discs: Discs
    tubes: Tubes
    width: float
    radii: Any
    inverse: Any


class NoProof(ArithmeticError):
    """A proof that did not succeed, with its reason. It never means that there is no orbit."""


def prove(problem: Problem, start: Any, duration: float) -> Proof:
    """The orbit near this start, shape (4,), and duration of the arc, proved to exist.

    Arguments:
        start, duration: natural units.

    Raises:
        NoProof: with the reason.
    """
    try:
        with precision(BITS, TERMS):
            chain = Chain(problem, np.asarray(start, float), duration)
            return prove_discs(chain, chain.newton())
    except NoProof:
        raise
    except (ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
        raise NoProof(str(error)) from error


def prove_discs(chain: Chain, discs: Discs) -> Proof:
    """Krawczyk's test on given discs; inside `balls.precision`.

    Raises:
        NoProof: with the reason.
    """
    reason = ""
    for width in TUBES:
        try:
            found = _attempt(chain, discs, width)
        except ArithmeticError as error:
            reason = str(error)
            continue
        if isinstance(found, Proof):
            return found
        reason = found
    raise NoProof(reason)


def _attempt(chain: Chain, discs: Discs, width: float) -> Proof | str:
    known, tube = chain.known_errors(discs), np.full(len(discs.half), width)
    tubes = enclose(chain.problem.pendulum.balls(), discs, tube, width, known, TERMS)
    middle, errors = chain.derivative(discs, tubes, width)
    inverse = np.linalg.inv(middle)
    gap = gap_of(chain, end_states(discs), tubes, energy_gap(chain, discs))
    radii = contraction_box(operator_of(inverse, gap, middle, errors))
    if radii is None:
        return "the operator does not map any box about the approximation into itself"
    inside = tubes.holds(chain.offsets(radii), float(radii[0]), discs.duration, tube)
    if not inside or radii[0] >= width:
        return "the solutions from the box leave the tubes"
    if not chain.closes(discs, width):
        return "where the motion closes, the energy does not tell the last component"
    return Proof(chain, discs, tubes, width, radii, inverse)


def energy_gap(chain: Chain, discs: Discs) -> Any:
    """H - E at the first centre."""
    return chain.energy_gap([arb(float(x)) for x in discs.series[0, 0]])
