"""A periodic orbit of Lagrange's equations proved in segments: Krawczyk's operator on balls, what
check_certificates.py is made of. It imports nothing of dpend.

The unknowns are what is not given of the start, the states where segments meet, and the duration of
the arc; the equations are that each segment ends where the next begins, the condition at the end,
and the energy of an orbit that never rests. With an approximate
inverse A, F at the middle x and F' on the box x +- r, the box holds exactly one orbit if
|A F| + |1 - A F'| r < r (Krawczyk 1969).
"""

from typing import Any, NamedTuple

from flint import arb, arb_mat
from lagrange import (
    NoProof,
    Pendulum,
    Step,
    energy_of,
    energy_slopes,
    field,
    horner,
    horner_matrix,
    middle_of,
    momenta,
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


class Start(NamedTuple):
    """What a certificate says of the start, and how the arc ends.

    Attributes:
        angles: balls, `None` for an unknown one.
        ratio: theta1 = ratio theta2, or 0.
        turns: theta/pi at the end of the arc if centred or passing; else theta at the end is in
            units of 2 pi that much more than plus (`none`) or minus (`odd`) theta at the start.
        energy: `None` for a release from rest.
    """

    pendulum: Pendulum
    symmetry: str
    angles: tuple[Any, Any]
    ratio: int
    turns: tuple[int, int]
    energy: Any

    @property
    def parts(self) -> int:
        return {"centred": 4, "none": 1}.get(self.symmetry, 2)

    @property
    def tie(self) -> int:
        return {"odd": -1, "none": 1}.get(self.symmetry, 0)

    @property
    def unknown(self) -> list[int]:
        """Which parts of the state at the start are unknowns."""
        if self.ratio:
            return [1]
        angles = [k for k in (0, 1) if self.angles[k] is None]
        return angles if self.energy is None else [*angles, 2, 3]

    def state(self, free: list[Any]) -> list[Any]:
        out = [*self.angles, arb(0), arb(0)]
        for k, x in zip(self.unknown, free, strict=True):
            out[k] = x
        if self.ratio:
            out[0] = out[1] * self.ratio
        return out

    def rows(self, end: list[Any]) -> list[int]:
        """Which parts of the end are compared. Where it is tied to the start, the energy implies
        one velocity, the one with the larger momentum.
        """
        if self.tie:
            p1, p2 = momenta(self.pendulum, middle_of(end))
            return [0, 1, 3 if bool(abs(p1) > abs(p2)) else 2]
        return [2, 3] if self.symmetry == "brake" else [0, 1]

    def target(self, start: list[Any]) -> list[Any]:
        """What the end must be."""
        if self.tie:
            turn = [2 * n * arb.pi() for n in self.turns] + [arb(0), arb(0)]
            return [x * self.tie + y for x, y in zip(start, turn, strict=True)]
        return [*(arb.pi() * k for k in self.turns), arb(0), arb(0)]

    def implies(self, start: list[Any], end: list[Any], compared: list[int]) -> bool:
        """Whether the velocity that is not compared follows from the energy: by the mean value
        theorem, if its momentum vanishes nowhere between the two.
        """
        box = [x.union(y) for x, y in zip(self.target(start), end, strict=True)]
        left = ({2, 3} - set(compared)).pop()
        return not momenta(self.pendulum, box)[left - 2].contains(0)


class Unknowns(NamedTuple):
    """Of the start, the states where segments meet, and the duration of the arc."""

    free: list[Any]
    nodes: list[list[Any]]
    duration: Any

    def plus(self, change: Any) -> "Unknowns":
        """Moved by a list of numbers or balls, in the order start, nodes, duration."""
        count = len(self.free)
        nodes = [
            [y + change[count + 4 * i + k] for k, y in enumerate(x)]
            for i, x in enumerate(self.nodes)
        ]
        free = [x + y for x, y in zip(self.free, change[:count], strict=True)]
        return Unknowns(free, nodes, self.duration + change[-1])

    def middle(self) -> "Unknowns":
        nodes = [middle_of(x) for x in self.nodes]
        return Unknowns(middle_of(self.free), nodes, self.duration.mid())


class Chain(NamedTuple):
    """The arc in segments.

    Attributes:
        lengths: of the steps, a list for each segment; the last step's is missing.
        compared: see `Start.rows`.
    """

    start: Start
    lengths: list[list[float]]
    order: int
    compared: list[int]

    def starts(self, unknowns: Unknowns) -> list[list[Any]]:
        return [self.start.state(unknowns.free), *unknowns.nodes]

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
        first, end, start = self.start.state(unknowns.free), ends[-1], self.start
        target = start.target(first)
        misses = [*inner, *(end[k] - target[k] for k in self.compared)]
        if start.energy is None:
            return misses
        return [*misses, energy_of(start.pendulum, first) - start.energy]

    def derivative(self, unknowns: Unknowns, ends: list[list[Any]], transitions: list[Any]) -> Any:
        """F' from the derivative of the flow along each segment."""
        start, last = self.start, len(ends) - 1
        columns = start.unknown
        count = len(columns)
        size = 4 * last + count + 1
        out, compared = arb_mat(size, size), self.compared
        rate = field(start.pendulum, ends[-1])
        for i, transition in enumerate(transitions):
            for r, k in enumerate(range(4) if i < last else compared):
                if i == 0:
                    for j, column in enumerate(columns):
                        out[r, j] = transition[k, column]
                    out[r, 0] += transition[k, 0] * start.ratio
                else:
                    for j in range(4):
                        out[4 * i + r, count + 4 * (i - 1) + j] = transition[k, j]
                if i < last:
                    out[4 * i + r, count + 4 * i + k] = arb(-1)
                else:
                    out[4 * i + r, size - 1] = rate[k]
        for j, column in enumerate(columns):
            if start.tie and column in compared:
                out[4 * last + compared.index(column), j] -= start.tie
            if start.energy is not None:
                slope = energy_slopes(start.pendulum, start.state(unknowns.free))
                out[size - 1, j] = slope[column]
        return out


def march(chain: Chain, unknowns: Unknowns, derivative: bool) -> tuple[list[Any], list[Any]]:
    """Ends and derivatives of all segments without proof: middles only."""
    ends, transitions = [], []
    for x, lengths in zip(chain.starts(unknowns), chain.steps(unknowns), strict=True):
        x, transition = middle_of(x), unit_matrix()
        for h in lengths:
            series = motion(chain.start.pendulum, x, chain.order)
            if derivative:
                terms = transition_terms(chain.start.pendulum, series, unit_matrix(), chain.order)
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
            step = sure_step(chain.start.pendulum, x, h, chain.order, derivative)
            x = step.at(h)
            if derivative:
                transition = step.matrix * transition
            steps.append(step)
        ends.append(x)
        transitions.append(transition)
    return steps, ends, transitions


class Orbit(NamedTuple):
    """What was proved of the orbit: the box, its steps and the derivative of the flow."""

    state: list[Any]
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
            inverse = chain.derivative(unknowns, ends, transitions).inv()
            count = inverse.nrows()
            inverse = arb_mat(count, count, middle_of(inverse.entries()))
        misses = chain.misses(unknowns, ends)
        change = [-y.mid() for y in (inverse * arb_mat(count, 1, misses)).entries()]
        unknowns = unknowns.plus(change).middle()
        if all(bool(abs(y) < size / 10) for y in change):
            break
    return unknowns, inverse


def prove(start: Start, free: list[Any], duration: Any, goal: int, share: float) -> Orbit:
    """Krawczyk's operator on a box of half width 10^-goal; `share` as in `plan_steps`."""
    size, finest = arb(10) ** -goal, goal + SPARE_DIGITS - 4
    order = int(ORDER_A_DIGIT * goal)
    first = middle_of(start.state(free))
    lengths, states = plan_steps(start.pendulum, first, float(duration), order, (-finest, share))
    cuts = range(0, len(states), SEGMENT)
    compared = start.rows(start.target(first))
    chain = Chain(start, [lengths[i : i + SEGMENT] for i in cuts], order, compared)
    unknowns = Unknowns(free, [states[i] for i in cuts][1:], duration)
    unknowns, inverse = newton(chain, unknowns, size)
    count = inverse.nrows()
    _, ends, _ = sure_arc(chain, unknowns, False)
    box = unknowns.plus([arb(0, 1) * size] * count)
    steps, wide, transitions = sure_arc(chain, box, True)
    shift = inverse * arb_mat(count, 1, chain.misses(unknowns, ends))
    slopes = inverse * chain.derivative(box, wide, transitions)
    for k in range(count):
        stretch = abs(slopes[k, k] - 1) + sum(
            (abs(slopes[k, j]) for j in range(count) if j != k), arb(0)
        )
        if not bool(abs(shift[k, 0]) + stretch * size < size):
            raise NoProof("Krawczyk's operator does not map the box into itself")
    whole = unit_matrix()
    for transition in transitions:
        whole = transition * whole
    state = start.state(box.free)
    if start.tie and not start.implies(state, wide[-1], compared):
        raise NoProof("the energy does not tell the velocity that is left out")
    return Orbit(state, box.duration, steps, whole)
