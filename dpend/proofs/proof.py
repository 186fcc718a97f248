"""A periodic orbit proved: Krawczyk's operator on a chain of discs.

The problem, in natural units. An orbit is released from rest at (theta1, theta2) and reaches the
end condition after tau: p = 0 after half a period (`brake`), or theta = pi (k1, k2) after a quarter
(`centred`). Both make a periodic orbit: the motion before the release is the motion after it with
the velocity turned round, and at the end the same holds for that symmetry (numerics.md, section 2).

The unknowns are theta2, tau, and the states at the centres of the discs as far as the end
conditions leave them free, 4 n numbers for n + 1 discs. The equations are that neighbouring discs
agree where they meet,

    F_i = phi_i(z_i, tau, 1) - phi_(i+1)(z_(i+1), tau, -1) = 0,  i = 0 .. n - 1.

A zero is an orbit, and no box is carried along it, so that instability does no harm. Let x be the
float64 approximation, A an approximate inverse of the derivative, Y >= |A F(x)| and
Z >= |1 - A F'| on the box x +- r. If Y + Z r < r in every component, then the box holds exactly one
zero (Krawczyk 1969; Moore 1977; Neumaier, "Interval Methods for Systems of Equations" (1990),
section 5.1; Rump, Acta Numerica 19 (2010), section 13). It needs F and F' on the whole box, and so
all solutions from the box stay in the tubes on which `flow.enclose` bounds them; `Tubes.holds`
checks it.

A F(x) and A F' are computed in float64. Their rounding errors are at most gamma_m |A| |F| and
gamma_m |A| |F'| (Higham 2002, section 3.5), whichever order the products are summed in.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from flint import arb

from dpend.proofs.balls import TINY, UNIT, Parameters, gamma, precision, upper
from dpend.proofs.flow import COVER, Discs, Tubes, enclose, end_states
from dpend.proofs.taylor import jacobian_series, mesh, motion_series, tangent_series

# Order of the discs' polynomials, terms of the Jacobian's series, and what the mesh aims at. Orders
# 16 to 24 prove the atlas in the same time within a tenth; these are the prototype's.
ORDER, TERMS, MESH_TOLERANCE = 20, 30, 1e-16
# Bits of the balls: one machine word.
BITS = 64
# Half widths of the tubes that are tried for existence: the narrower, the better kappa.
TUBES = (1e-12, 3e-11, 1e-9)
# And for uniqueness: the wider, the larger the box in which there is one orbit.
WIDE_TUBES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
# Newton's method stops below this, or after so many iterations; it starts from an orbit.
NEWTON_TOLERANCE, NEWTON_STEPS = 3e-15, 8
# The box is enlarged by this until the operator maps it into itself.
SLACK, TRIES = 1.05, 30


@dataclass(frozen=True)
class Problem:
    """What is to be proved.

    Attributes:
        pendulum: exact decimals.
        theta1: gives a ball around the release angle [rad] at the working precision.
        turns: (k1, k2) of a centred orbit, `None` for a brake orbit.
        ratio: 1 or -1 where the release is on the line theta1 = ratio theta2 instead; `theta1` is
            then not used.
    """

    pendulum: Parameters
    theta1: Callable[[], Any]
    turns: tuple[int, int] | None
    ratio: int | None = None

    @property
    def parts(self) -> int:
        """The arc is the period over this."""
        return 2 if self.turns is None else 4

    def first(self, theta2: float) -> float:
        """theta1 as a float."""
        return float(self.theta1().mid()) if self.ratio is None else self.ratio * theta2


class Chain:
    """Discs along an arc, where their unknowns are, and Newton's method in float64."""

    def __init__(self, problem: Problem, theta2: float, duration: float) -> None:
        self.problem, self.duration = problem, duration
        self.ratios = problem.pendulum.floats()
        start = np.array([problem.first(theta2), theta2, 0.0, 0.0])
        edges, self.states = mesh(self.ratios, start, duration, ORDER, (TERMS, MESH_TOLERANCE))
        self.half = np.concatenate([edges[:1], np.diff(edges) / 2, 1 - edges[-1:]])
        self.joints = len(edges)
        fixed = np.zeros((self.joints + 1, 4), bool)
        fixed[0] = True, False, True, True
        if problem.turns is None:
            fixed[-1, 2:] = True
            self.states[-1, 2:] = 0.0
        else:
            fixed[-1, :2] = True
            self.states[-1, :2] = math.pi * np.array(problem.turns)
        # Unknown 0 is theta2, unknown 1 the duration.
        self.index = np.full(fixed.shape, -1)
        order = np.arange(np.count_nonzero(~fixed))
        self.index[~fixed] = order + (order > 0)
        self.size = 4 * self.joints
        self.start_tangent = np.array([problem.ratio or 0.0, 1.0, 0.0, 0.0])

    def assemble(self, plus: Any, minus: Any, by_time: Any, size: bool = False) -> Any:
        """The matrix F' from the discs' derivatives, or with `size` the bound of its errors.

        Arguments:
            by_time: the column of the duration, shape (n, 4).
        """
        out = np.zeros((self.size, self.size))
        first = np.abs(self.start_tangent) if size else self.start_tangent
        for i in range(self.joints):
            rows = slice(4 * i, 4 * i + 4)
            for k in range(4):
                if self.index[i, k] >= 0:
                    out[rows, self.index[i, k]] = plus[i][:, k] if i else plus[0] @ first
                if self.index[i + 1, k] >= 0:
                    out[rows, self.index[i + 1, k]] = minus[i + 1][:, k] * (1 if size else -1)
            out[rows, 1] = by_time[i]
        return out

    def discs(self) -> Discs:
        """The polynomials that belong to the present unknowns."""
        step = self.half * self.duration
        series = motion_series(self.ratios, self.states, step, ORDER)
        tangents = tangent_series(jacobian_series(self.ratios, series), step)
        return Discs(series, tangents, self.half, self.duration)

    def move(self, change: Any) -> None:
        """Adds a change of the unknowns."""
        free = self.index >= 0
        self.states[free] += change[self.index[free]]
        self.duration += change[1]
        if self.problem.ratio is not None:
            self.states[0, 0] = self.problem.ratio * self.states[0, 1]

    def newton_matrix(self, discs: Discs) -> Any:
        """F' in float64: a proposal."""
        signs = discs.signs()[:, None, None]
        rates = discs.series * np.arange(len(signs))[:, None, None] / discs.duration
        by_time = rates.sum(0)[:-1] - (rates * signs).sum(0)[1:]
        minus = (discs.tangents * signs[..., None]).sum(0)
        return self.assemble(discs.tangents.sum(0), minus, by_time)

    def newton(self) -> Discs:
        """Newton's method, until rounding is all that is left.

        Raises:
            ArithmeticError: it leaves the numbers.
        """
        for _ in range(NEWTON_STEPS):
            discs = self.discs()
            gap = (
                discs.series.sum(0)[:-1] - (discs.series * discs.signs()[:, None, None]).sum(0)[1:]
            )
            if not np.isfinite(gap).all():
                raise ArithmeticError("Newton's method diverged")
            change = np.linalg.solve(self.newton_matrix(discs), -gap.ravel())
            self.move(change)
            if np.abs(change).max() < NEWTON_TOLERANCE:
                break
        return self.discs()

    def known_errors(self, discs: Discs) -> Any:
        """How far the exact release angle and the exact multiples of pi are from P(0)."""
        off = np.zeros((self.joints + 1, 4))
        if self.problem.ratio is None:
            off[0, 0] = upper(self.problem.theta1() - arb(float(discs.series[0, 0, 0])))
        if self.problem.turns is not None:
            for k, turns in enumerate(self.problem.turns):
                off[-1, k] = upper(arb.pi() * turns - arb(float(discs.series[0, -1, k])))
        return off

    def by_unknown(self, radii: Any) -> Any:
        """The radii of the unknowns as those of the states, shape (S, 4)."""
        out = np.zeros(self.index.shape)
        free = self.index >= 0
        out[free] = radii[self.index[free]]
        # With a ratio, theta1 moves with theta2.
        out[0, 0] = abs(self.start_tangent[0]) * radii[0]
        return out

    def derivative(self, tubes: Tubes) -> tuple[Any, Any]:
        """F' on the tubes: its middle, and a bound of what it is off by."""
        half = self.half[:, None]
        plus, minus = half * tubes.slopes[0], half * tubes.slopes[1]
        by_time = plus[:-1] + minus[1:]
        spread = half * tubes.slope_spread
        # Two products and a sum, relative to the sizes of the products.
        rounding = (np.abs(plus)[:-1] + np.abs(minus)[1:]) * 4 * UNIT
        wide = (spread[:-1] + spread[1:] + rounding) * COVER
        middle = self.assemble(tubes.plus, tubes.minus, by_time)
        errors = self.assemble(tubes.spread, tubes.spread, wide, size=True)
        if self.problem.ratio is not None:
            errors[:4, 0] += gamma(6) * (np.abs(tubes.plus[0]) @ np.abs(self.start_tangent))
        return middle, errors * COVER


class Gap(NamedTuple):
    """F at the approximation: middles and radii, shape (4 n,)."""

    middle: Any
    radius: Any


def gap_of(ends: list[tuple[Any, Any]], tubes: Tubes) -> Gap:
    """F from the polynomials' ends and what the true solutions are off by there."""
    off = tubes.defect.max(-1) * tubes.growth
    middle, radius = [], []
    for i in range(len(ends) - 1):
        for x, y in zip(ends[i][0], ends[i + 1][1], strict=True):
            difference = x - y
            middle.append(float(difference.mid()))
            radius.append(upper(difference - arb(middle[-1])) + off[i] + off[i + 1])
    return Gap(np.array(middle), np.array(radius) * COVER)


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
        radii: of the box of the unknowns, about the discs' values, shape (4 n,).
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


def prove(problem: Problem, theta2: float, duration: float) -> Proof:
    """The orbit near this release and duration of the arc (natural units), proved to exist.

    Raises:
        NoProof: with the reason.
    """
    try:
        with precision(BITS, TERMS):
            chain = Chain(problem, theta2, duration)
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
    middle, errors = chain.derivative(tubes)
    inverse = np.linalg.inv(middle)
    radii = contraction_box(operator_of(inverse, gap_of(end_states(discs), tubes), middle, errors))
    if radii is None:
        return "the operator does not map any box about the approximation into itself"
    inside = tubes.holds(chain.by_unknown(radii), float(radii[1]), discs.duration, tube)
    if not inside or radii[1] >= width:
        return "the solutions from the box leave the tubes"
    return Proof(chain, discs, tubes, width, radii, inverse)
