"""A periodic orbit of Lagrange's equations proved in segments: Krawczyk's operator on balls, what
check_certificates.py is made of. It imports nothing of dpend.

The unknowns are theta2, the states where segments meet, and the duration of the arc; the equations
are that each segment ends where the next begins, and the condition at the end. With an approximate
inverse A, F at the middle x and F' on the box x +- r, the box holds exactly one orbit if
|A F| + |1 - A F'| r < r (Krawczyk 1969).
"""

from typing import Any, NamedTuple

from flint import arb, arb_mat
from lagrange import (
    NoProof,
    Pendulum,
    Step,
    field,
    horner,
    horner_matrix,
    middle_of,
    motion,
    plan_steps,
    sure_step,
    transition_terms,
    unit_matrix,
)

# Digits of the working precision beyond the box's size.
SPARE_DIGITS = 14
# Order of the Taylor steps for so many digits of the box. 1.3 fails on the unstable orbits: the
# remainder on an a-priori box grows with the order faster than the steps do.
ORDER_A_DIGIT = 0.9
# Steps in a segment: intervals grow by some hundred in as many. Newton's method ends after PASSES.
SEGMENT, PASSES = 4, 12


class Release(NamedTuple):
    """What a certificate says of the start: theta1 or the line, and how the arc ends."""

    pendulum: Pendulum
    theta1: Any
    ratio: int
    turns: tuple[int, int] | None

    def state(self, theta2: Any) -> list[Any]:
        zero = arb(0)
        return [theta2 * self.ratio if self.ratio else self.theta1, theta2, zero, zero]

    def miss(self, end: list[Any]) -> list[Any]:
        """What must vanish at the end of the arc."""
        if self.turns is None:
            return end[2:]
        return [end[k] - arb.pi() * self.turns[k] for k in (0, 1)]

    def rows(self) -> tuple[int, int]:
        return (2, 3) if self.turns is None else (0, 1)


class Unknowns(NamedTuple):
    """theta2, the states where segments meet, and the duration of the arc."""

    theta2: Any
    nodes: list[list[Any]]
    duration: Any

    def plus(self, change: Any) -> "Unknowns":
        """Moved by a list of numbers or balls, in the order theta2, nodes, duration."""
        nodes = [
            [y + change[1 + 4 * i + k] for k, y in enumerate(x)] for i, x in enumerate(self.nodes)
        ]
        return Unknowns(self.theta2 + change[0], nodes, self.duration + change[-1])

    def middle(self) -> "Unknowns":
        nodes = [middle_of(x) for x in self.nodes]
        return Unknowns(self.theta2.mid(), nodes, self.duration.mid())


class Chain(NamedTuple):
    """The arc in segments.

    Attributes:
        lengths: of the steps, a list for each segment; the last step's is missing.
    """

    release: Release
    lengths: list[list[float]]
    order: int

    def starts(self, unknowns: Unknowns) -> list[list[Any]]:
        return [self.release.state(unknowns.theta2), *unknowns.nodes]

    def steps(self, unknowns: Unknowns) -> list[list[Any]]:
        steps = [[arb(h) for h in part] for part in self.lengths]
        rest = unknowns.duration - sum((h for part in steps for h in part), arb(0))
        return [*steps[:-1], [*steps[-1], rest]]

    def misses(self, unknowns: Unknowns, ends: list[list[Any]]) -> list[Any]:
        """F: zero on an orbit."""
        inner = [
            y - z
            for e, x in zip(ends, unknowns.nodes, strict=False)
            for y, z in zip(e, x, strict=True)
        ]
        return [*inner, *self.release.miss(ends[-1])]

    def derivative(self, ends: list[list[Any]], transitions: list[Any]) -> Any:
        """F' from the derivative of the flow along each segment."""
        last, ratio = len(ends) - 1, self.release.ratio
        size = 4 * last + 2
        out = arb_mat(size, size)
        rate = field(self.release.pendulum, ends[-1])
        for i, transition in enumerate(transitions):
            rows = range(4) if i < last else self.release.rows()
            for r, k in enumerate(rows):
                if i == 0:
                    out[r, 0] = transition[k, 1] + transition[k, 0] * ratio
                else:
                    for j in range(4):
                        out[4 * i + r, 4 * i - 3 + j] = transition[k, j]
                if i < last:
                    out[4 * i + r, 4 * i + 1 + k] = arb(-1)
                else:
                    out[4 * i + r, size - 1] = rate[k]
        return out


def march(chain: Chain, unknowns: Unknowns, derivative: bool) -> tuple[list[Any], list[Any]]:
    """Ends and derivatives of all segments without proof: middles only."""
    ends, transitions = [], []
    for x, lengths in zip(chain.starts(unknowns), chain.steps(unknowns), strict=True):
        x, transition = middle_of(x), unit_matrix()
        for h in lengths:
            series = motion(chain.release.pendulum, x, chain.order)
            if derivative:
                terms = transition_terms(chain.release.pendulum, series, unit_matrix(), chain.order)
                transition = horner_matrix(terms, h.mid()) * transition
            x = middle_of([horner(y, h.mid()) for y in series.state])
        ends.append(x)
        transitions.append(transition)
    return ends, transitions


def sure_arc(
    chain: Chain, unknowns: Unknowns, derivative: bool
) -> tuple[list[Step], list[Any], list[Any]]:
    """All steps, and the ends and derivatives of all segments, for balls of unknowns."""
    steps, ends, transitions = [], [], []
    for x, lengths in zip(chain.starts(unknowns), chain.steps(unknowns), strict=True):
        transition = unit_matrix()
        for h in lengths:
            step = sure_step(chain.release.pendulum, x, h, chain.order, derivative)
            x = step.at(h)
            if derivative:
                transition = step.matrix * transition
            steps.append(step)
        ends.append(x)
        transitions.append(transition)
    return steps, ends, transitions


class Orbit(NamedTuple):
    """What was proved of the orbit: the box, its steps and the derivative of the flow."""

    theta2: Any
    duration: Any
    steps: list[Step]
    transition: Any


def newton(chain: Chain, unknowns: Unknowns, size: Any) -> tuple[Unknowns, Any]:
    """Newton's method with one derivative, until a correction is below a tenth of the box; the
    unknowns and the approximate inverse.
    """
    inverse = None
    for _ in range(PASSES):
        ends, transitions = march(chain, unknowns, inverse is None)
        if inverse is None:
            inverse = chain.derivative(ends, transitions).inv()
            count = inverse.nrows()
            inverse = arb_mat(count, count, middle_of(inverse.entries()))
        misses = chain.misses(unknowns, ends)
        change = [-y.mid() for y in (inverse * arb_mat(count, 1, misses)).entries()]
        unknowns = unknowns.plus(change).middle()
        if all(bool(abs(y) < size / 10) for y in change):
            break
    return unknowns, inverse


def prove(release: Release, theta2: Any, duration: Any, goal: int, share: float) -> Orbit:
    """Krawczyk's operator on a box of half width 10^-goal; `share` as in `plan_steps`."""
    size, finest = arb(10) ** -goal, goal + SPARE_DIGITS - 4
    order = int(ORDER_A_DIGIT * goal)
    start = middle_of(release.state(theta2))
    lengths, states = plan_steps(release.pendulum, start, float(duration), order, (-finest, share))
    cuts = range(0, len(states), SEGMENT)
    chain = Chain(release, [lengths[i : i + SEGMENT] for i in cuts], order)
    unknowns = Unknowns(theta2, [states[i] for i in cuts][1:], duration)
    unknowns, inverse = newton(chain, unknowns, size)
    count = inverse.nrows()
    _, ends, _ = sure_arc(chain, unknowns, False)
    box = unknowns.plus([arb(0, 1) * size] * count)
    steps, wide, transitions = sure_arc(chain, box, True)
    shift = inverse * arb_mat(count, 1, chain.misses(unknowns, ends))
    slopes = inverse * chain.derivative(wide, transitions)
    for k in range(count):
        stretch = abs(slopes[k, k] - 1) + sum(
            (abs(slopes[k, j]) for j in range(count) if j != k), arb(0)
        )
        if not bool(abs(shift[k, 0]) + stretch * size < size):
            raise NoProof("Krawczyk's operator does not map the box into itself")
    whole = unit_matrix()
    for transition in transitions:
        whole = transition * whole
    return Orbit(box.theta2, box.duration, steps, whole)
