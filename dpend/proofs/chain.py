"""A periodic orbit as a chain of Taylor discs: the unknowns, the equations, Newton's method.

The problem, in natural units, is an arc of duration tau and what holds at its two ends:

    symmetry   at the start                   at the end                      arc
    centred    at rest, theta1 given          theta = pi (k1, k2)             T/4
    brake      at rest, theta1 given          at rest                         T/2
    passing    theta = pi (k1, k2)            theta = pi (m1, m2)             T/2
    odd        one angle given                x(tau) = -x(0) + 2 pi (n1, n2)  T/2
    none       one angle given                x(tau) = x(0) + 2 pi (n1, n2)   T

Each makes a periodic orbit, up to full turns of the rods: at rest the motion before is the motion
after with the velocity turned round, theta = pi k does the same with the angles, and x -> -x is a
symmetry (numerics.md, section 2). Orbits that never rest have a given energy too, H(x(0)) = E.

The unknowns are tau and the states at the centres of the n + 1 discs, as far as the ends leave them
free. The equations are that neighbouring discs agree where they meet,

    F_i = phi_i(z_i, tau, 1) - phi_(i+1)(z_(i+1), tau, -1) = 0,  i = 0 .. n - 1,

4 n numbers, and the energy's. Where the end is tied to the start that is one equation too many for
the 4 n unknowns, because the energy is the same on both sides of the last joint: the equation of
one component is left out there. The other three and the energy imply it where the derivative of H
by that component does not vanish (`closes`), by the mean value theorem.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from flint import arb

from dpend.orbits.arc import PARTS
from dpend.proofs.balls import (
    UNIT,
    Parameters,
    energy_gradient,
    gamma,
    total_energy,
    upper,
)
from dpend.proofs.flow import COVER, Discs, Tubes, end_states
from dpend.proofs.taylor import jacobian_series, mesh, motion_series, tangent_series

# Order of the discs' polynomials, terms of the Jacobian's series, and what the mesh aims at. Orders
# 16 to 24 prove the atlas in the same time within a tenth; these are the prototype's.
ORDER, TERMS, MESH_TOLERANCE = 20, 30, 1e-16
# Newton's method stops below this, or after so many iterations; it starts from an orbit.
NEWTON_TOLERANCE, NEWTON_STEPS = 3e-15, 8


def _zero() -> Any:
    return arb(0)


# What is known of a state: balls of the working precision by component, theta1 theta2 p1 p2.
Known = Mapping[int, Callable[[], Any]]
AT_REST: Known = {2: _zero, 3: _zero}


def at_turns(turns: tuple[int, int]) -> Known:
    """theta = pi (k1, k2)."""

    def multiple(half: int) -> Any:
        return arb.pi() * half

    return {k: partial(multiple, half) for k, half in enumerate(turns)}


@dataclass(frozen=True)
class Problem:
    """What is to be proved, see the table above.

    Attributes:
        pendulum: exact decimals.
        symmetry: one of the table's.
        start, end: what is given of the states at both ends.
        ratio: 1 or -1 where theta1 = ratio theta2 is given at the start instead of theta1.
        turns: (n1, n2) where the end is tied to the start.
        energy: gives a ball around the energy [m1 g l1]; `None` for a release from rest.
    """

    pendulum: Parameters
    symmetry: str
    start: Known
    end: Known = field(default_factory=dict)
    ratio: int | None = None
    turns: tuple[int, int] = (0, 0)
    energy: Callable[[], Any] | None = None

    @property
    def parts(self) -> int:
        """The arc is the period over this."""
        return PARTS[self.symmetry]

    @property
    def tie(self) -> int:
        """The end is this times the start, up to full turns; 0 if it is free of it."""
        return {"odd": -1, "none": 1}.get(self.symmetry, 0)

    def energy_of(self, state: Any) -> Any:
        """H(x) - E."""
        if self.energy is None:
            raise ArithmeticError("the energy is not given")
        return total_energy(self.pendulum.balls(), state) - self.energy()


def release(
    pendulum: Parameters,
    theta1: Callable[[], Any],
    turns: tuple[int, int] | None,
    ratio: int | None = None,
) -> Problem:
    """A release from rest: centred with theta = pi turns at the end, or brake."""
    start = AT_REST if ratio is not None else {0: theta1, **AT_REST}
    if turns is None:
        return Problem(pendulum, "brake", start, AT_REST, ratio)
    return Problem(pendulum, "centred", start, at_turns(turns), ratio)


class Chain:
    """Discs along an arc, where their unknowns are, and Newton's method in float64.

    Unknown 0 is the duration, the next are those of the start (`starts`), then those of the other
    centres. `index` says which unknown a component of a centre is, -1 for none, and `weights` times
    how much.
    """

    def __init__(self, problem: Problem, start: Any, duration: float) -> None:
        self.problem, self.duration = problem, duration
        self.ratios = problem.pendulum.floats()
        edges, self.states = mesh(self.ratios, start, duration, ORDER, (TERMS, MESH_TOLERANCE))
        self.half = np.concatenate([edges[:1], np.diff(edges) / 2, 1 - edges[-1:]])
        self.joints = len(edges)
        free = np.ones((self.joints + 1, 4), bool)
        for i, known in ((0, problem.start), (-1, problem.end)):
            for k, ball in known.items():
                free[i, k], self.states[i, k] = False, float(ball().mid())
        free[0, 0] &= problem.ratio is None
        free[-1] &= problem.tie == 0
        self.index = np.full(free.shape, -1)
        self.index[free] = np.arange(1, np.count_nonzero(free) + 1)
        self.starts = slice(1, 1 + np.count_nonzero(free[0]))
        self.size = 1 + np.count_nonzero(free)
        self.weights = np.ones(free.shape)
        self.left_out: int | None = None
        if problem.ratio is not None:
            self.index[0, 0], self.weights[0, 0] = self.index[0, 1], problem.ratio
        if problem.tie:
            self.index[-1], self.weights[-1] = self.index[0], problem.tie
            # Of the equations at the last joint, the one that the energy implies.
            slopes = energy_gradient(problem.pendulum.balls(), list(map(arb, self.states[-1])))
            self.left_out = int(np.argmax([float(abs(x).mid()) for x in slopes]))
        self._tie()

    def _tie(self) -> None:
        """Sets what follows from the other unknowns."""
        if self.problem.ratio is not None:
            self.states[0, 0] = self.problem.ratio * self.states[0, 1]
        if self.problem.tie:
            self.states[-1] = self.problem.tie * self.states[0]
            self.states[-1, :2] += 2 * math.pi * np.array(self.problem.turns)

    def rows(self, joints: Any, energy: Any) -> Any:
        """One row for each equation: of the joints, shape (4 n, ...), and of the energy (...)."""
        if self.left_out is not None:
            joints = np.delete(joints, len(joints) - 4 + self.left_out, 0)
        return joints if self.problem.energy is None else np.concatenate([joints, energy[None]])

    def assemble(
        self, plus: Any, minus: Any, by_time: Any, gradient: Any, size: bool = False
    ) -> Any:
        """The matrix F' from the discs' derivatives, or with `size` the bound of its errors.

        Arguments:
            by_time: the column of the duration, shape (n, 4).
            gradient: of H at the start, shape (4,).
        """
        out, energy = np.zeros((4 * self.joints, self.size)), np.zeros(self.size)
        weights = np.abs(self.weights) if size else self.weights
        for i in range(self.joints):
            rows = slice(4 * i, 4 * i + 4)
            for k in range(4):
                if (j := self.index[i, k]) >= 0:
                    out[rows, j] += plus[i][:, k] * weights[i, k]
                if (j := self.index[i + 1, k]) >= 0:
                    out[rows, j] += minus[i + 1][:, k] * weights[i + 1, k] * (1 if size else -1)
            out[rows, 0] = by_time[i]
        for k in range(4):
            if (j := self.index[0, k]) >= 0:
                energy[j] += gradient[k] * weights[0, k]
        return self.rows(out, energy)

    def discs(self) -> Discs:
        """The polynomials that belong to the present unknowns."""
        step = self.half * self.duration
        series = motion_series(self.ratios, self.states, step, ORDER)
        tangents = tangent_series(jacobian_series(self.ratios, series), step)
        return Discs(series, tangents, self.half, self.duration)

    def by_unknown(self, values: Any) -> Any:
        """A change of the unknowns as one of the states at the centres, shape (S, 4)."""
        return np.where(self.index >= 0, values[self.index], 0.0) * self.weights

    def offsets(self, radii: Any) -> Any:
        """How far the states at the centres move within radii of the unknowns, shape (S, 4)."""
        return np.abs(self.by_unknown(radii))

    def newton_matrix(self, discs: Discs) -> Any:
        """F' in float64: a proposal."""
        signs = discs.signs()[:, None, None]
        rates = discs.series * np.arange(len(signs))[:, None, None] / discs.duration
        by_time = rates.sum(0)[:-1] - (rates * signs).sum(0)[1:]
        minus = (discs.tangents * signs[..., None]).sum(0)
        slopes = energy_gradient(self.problem.pendulum.balls(), list(map(arb, discs.series[0, 0])))
        gradient = np.array([float(x.mid()) for x in slopes])
        return self.assemble(discs.tangents.sum(0), minus, by_time, gradient)

    def energy_gap(self, start: Any) -> Any:
        """H - E at a start whose given parts are taken exactly, a ball; 0 if no energy is given."""
        if self.problem.energy is None:
            return arb(0)
        return self.problem.energy_of(self.exact_start(start))

    def exact_start(self, start: Any) -> list[Any]:
        """A state at the first centre, its given parts as they are given."""
        known = self.problem.start
        return [known[k]() if k in known else x for k, x in enumerate(start)]

    def newton(self) -> Discs:
        """Newton's method, until rounding is all that is left.

        Raises:
            ArithmeticError: it leaves the numbers.
        """
        for _ in range(NEWTON_STEPS):
            discs = self.discs()
            signs = discs.signs()[:, None, None]
            gap = discs.series.sum(0)[:-1] - (discs.series * signs).sum(0)[1:]
            off = np.array(float(self.energy_gap(list(map(arb, self.states[0]))).mid()))
            if not (np.isfinite(gap).all() and np.isfinite(off)):
                raise ArithmeticError("Newton's method diverged")
            change = np.linalg.solve(self.newton_matrix(discs), -self.rows(gap.ravel(), off))
            self.states += self.by_unknown(change)
            self.duration += change[0]
            self._tie()
            if np.abs(change).max() < NEWTON_TOLERANCE:
                break
        return self.discs()

    def known_errors(self, discs: Discs) -> Any:
        """How far P(0) of both ends is from what is given there, or from what it is tied to."""
        off = np.zeros((self.joints + 1, 4))
        start, end = discs.series[0, 0], discs.series[0, -1]
        for i, state, known in ((0, start, self.problem.start), (-1, end, self.problem.end)):
            for k, ball in known.items():
                off[i, k] = upper(ball() - arb(float(state[k])))
        if self.problem.tie:
            exact = self.tied_end(self.exact_start(map(arb, map(float, start))))
            off[-1] = [upper(x - arb(float(y))) for x, y in zip(exact, end, strict=True)]
        return off

    def tied_end(self, start: Any) -> list[Any]:
        """The end that is tied to a start, as balls."""
        turns = (*self.problem.turns, 0, 0)
        return [
            x * self.problem.tie + arb.pi() * (2 * n) for x, n in zip(start, turns, strict=True)
        ]

    def derivative(self, discs: Discs, tubes: Tubes, width: float) -> tuple[Any, Any]:
        """F' on the tubes: its middle, and a bound of what it is off by."""
        half = self.half[:, None]
        plus, minus = half * tubes.slopes[0], half * tubes.slopes[1]
        by_time = plus[:-1] + minus[1:]
        spread = half * tubes.slope_spread
        # Two products and a sum, relative to the sizes of the products.
        rounding = (np.abs(plus)[:-1] + np.abs(minus)[1:]) * 4 * UNIT
        wide = (spread[:-1] + spread[1:] + rounding) * COVER
        around = [arb(float(x), width) for x in discs.series[0, 0]]
        slopes = energy_gradient(self.problem.pendulum.balls(), around)
        gradient = np.array([float(x.mid()) for x in slopes])
        off = [upper(x - arb(float(y))) for x, y in zip(slopes, gradient, strict=True)]
        # An entry of F' may be a sum of up to four of these.
        plus_off, minus_off = (
            tubes.spread + gamma(6) * np.abs(part) for part in (tubes.plus, tubes.minus)
        )
        middle = self.assemble(tubes.plus, tubes.minus, by_time, gradient)
        sizes = np.array(off) + gamma(6) * np.abs(gradient)
        errors = self.assemble(plus_off, minus_off, wide, sizes, size=True)
        return middle, errors * COVER

    def closes(self, discs: Discs, width: float) -> bool:
        """Whether the equation that is left out follows from the others, on tubes of this width."""
        if self.left_out is None:
            return True
        ends, around = end_states(discs), arb(0, width)
        both = zip(ends[-2][0], ends[-1][1], strict=True)
        box = [(x + around).union(y + around) for x, y in both]
        slope = energy_gradient(self.problem.pendulum.balls(), box)[self.left_out]
        return not slope.contains(0)
