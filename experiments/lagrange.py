"""The flow of the double pendulum on balls, by Lagrange's equations: what check_certificates.py is
made of. It imports nothing of dpend.

The state is (theta1, theta2, omega1, omega2) in units of l1, m1 and g, and sines and cosines have
their own recurrences. A step is a Taylor polynomial with Lagrange's remainder, taken on an a-priori
box that is proved to hold the motion (Moore, "Interval Analysis", 1966, chapter 10): if
x + [0, h] f(B) lies inside B, then the motion from x stays in x + [0, h] f(B) over [0, h]. The
derivative of the flow has a box of its own, by the same argument.
"""

import math
from fractions import Fraction
from typing import Any, NamedTuple

from flint import arb, arb_mat, arb_series, ctx, fmpq

# The longest step [sqrt(l1/g)].
LONGEST_STEP = 0.25
# A step is shorter than what its last two terms allow, and again by SHORTER until an a-priori box
# is found and narrower than WIDEST.
SHORTER, WIDEST = 0.8, 0.3


class NoProof(ArithmeticError):
    """What was not proved."""


def exact(x: Fraction) -> Any:
    return arb(fmpq(x.numerator, x.denominator))


def fraction(text: str) -> Any:
    return exact(Fraction(text))


class Pendulum(NamedTuple):
    """lambda = l2/l1 and mu = m2/m1, balls."""

    lam: Any
    mu: Any


def accelerations(pendulum: Pendulum, x: Any) -> tuple[Any, Any]:
    """Of the angles of (theta1, theta2, omega1, omega2), in units of l1, m1 and g."""
    lam, mu = pendulum
    s, c, w1, w2 = (x[0] - x[1]).sin(), (x[0] - x[1]).cos(), x[2], x[3]
    pull = s * w1 * w1 - x[1].sin()
    below = 1 + mu * s * s
    first = (-mu * lam * s * w2 * w2 - (1 + mu) * x[0].sin() - mu * c * pull) / below
    return first, (pull - c * first) / lam


def momenta(pendulum: Pendulum, x: Any) -> tuple[Any, Any]:
    """The derivatives of the kinetic energy by the angular velocities."""
    lam, mu = pendulum
    cross = mu * lam * (x[0] - x[1]).cos()
    return (1 + mu) * x[2] + cross * x[3], mu * lam * lam * x[3] + cross * x[2]


def energy_of(pendulum: Pendulum, x: Any) -> Any:
    """In units of m1 g l1."""
    lam, mu = pendulum
    p1, p2 = momenta(pendulum, x)
    return (p1 * x[2] + p2 * x[3]) / 2 - (1 + mu) * x[0].cos() - mu * lam * x[1].cos()


def energy_slopes(pendulum: Pendulum, x: Any) -> tuple[Any, Any, Any, Any]:
    """The derivatives of the energy by the state."""
    lam, mu = pendulum
    turn = mu * lam * (x[0] - x[1]).sin() * x[2] * x[3]
    by_angles = (1 + mu) * x[0].sin() - turn, mu * lam * x[1].sin() + turn
    return *by_angles, *momenta(pendulum, x)


def field(pendulum: Pendulum, x: Any) -> list[Any]:
    return [x[2], x[3], *accelerations(pendulum, x)]


def dot(x: list[Any], y: list[Any], n: int) -> Any:
    """Term n of the product of two series."""
    total = x[0] * y[n]
    for j in range(1, n + 1):
        total += x[j] * y[n - j]
    return total


class Series(NamedTuple):
    """Taylor coefficients of the state, and of all that the accelerations are made of."""

    state: list[list[Any]]
    cos1: list[Any]
    sin2: list[Any]
    cos2: list[Any]
    s: list[Any]
    c: list[Any]
    first: list[Any]  # the acceleration of theta1


def motion(pendulum: Pendulum, x: Any, order: int) -> Series:
    lam, mu = pendulum
    a, b, v, w = ([y] for y in x)
    sin1, cos1, sin2, cos2 = [x[0].sin()], [x[0].cos()], [x[1].sin()], [x[1].cos()]
    s, c = [(x[0] - x[1]).sin()], [(x[0] - x[1]).cos()]
    square1: list[Any] = []
    square2, turn, below, first, pull = (list(square1) for _ in range(5))
    for n in range(order):
        square1.append(dot(v, v, n))
        square2.append(dot(w, w, n))
        pull.append(dot(s, square1, n) - sin2[n])
        below.append(dot(s, s, n) * mu + (0 if n else 1))
        top = -mu * lam * dot(s, square2, n) - (1 + mu) * sin1[n] - mu * dot(c, pull, n)
        for j in range(1, n + 1):
            top -= below[j] * first[n - j]
        first.append(top / below[0])
        second = (pull[n] - dot(c, first, n)) / lam
        k = n + 1
        turn.append(v[n] - w[n])
        a.append(v[n] / k)
        b.append(w[n] / k)
        for sine, cosine, rate in ((sin1, cos1, v), (sin2, cos2, w), (s, c, turn)):
            up, down = dot(cosine, rate, n) / k, -dot(sine, rate, n) / k
            sine.append(up)
            cosine.append(down)
        v.append(first[n] / k)
        w.append(second / k)
    return Series([a, b, v, w], cos1, sin2, cos2, s, c, first)


def partials(pendulum: Pendulum, parts: tuple[Any, ...]) -> list[list[Any]]:
    """Derivatives of both accelerations with respect to the state; balls or power series.

    Arguments:
        parts: omega1, omega2, cos theta1, sin theta2, cos theta2, sine and cosine of
            theta1 - theta2, the acceleration of theta1.
    """
    lam, mu = pendulum
    w1, w2, cos1, sin2, cos2, s, c, first = parts
    zero = w1 * 0
    squared, pull = w1 * w1, s * w1 * w1 - sin2
    of_pull = [c * squared, -(c * squared) - cos2, s * w1 * 2, zero]
    far = c * w2 * w2 * (mu * lam)
    of_top = [
        -far - cos1 * (1 + mu) + (s * pull - c * of_pull[0]) * mu,
        far - (s * pull + c * of_pull[1]) * mu,
        -(c * of_pull[2]) * mu,
        -(s * w2) * (mu * lam * 2),
    ]
    bend = s * c * (mu * 2)
    of_below, of_cosine = [bend, -bend, zero, zero], [-s, s, zero, zero]
    inverse = 1 / (s * s * mu + 1)
    row1 = [(t - first * d) * inverse for t, d in zip(of_top, of_below, strict=True)]
    inner = zip(of_pull, of_cosine, row1, strict=True)
    return [row1, [(p - first * d - c * r) * (1 / lam) for p, d, r in inner]]


def blocks_of(pendulum: Pendulum, series: Series, order: int) -> list[Any]:
    """Taylor coefficients of the accelerations' derivatives along a motion, 2 x 4 each."""
    before, ctx.cap = ctx.cap, order
    lists = (*series.state[2:], *series[1:])
    rows = partials(pendulum, tuple(arb_series(y[:order], order) for y in lists))
    ctx.cap = before
    flat = [y for row in rows for y in row]
    if any(y.prec < order for y in flat):
        raise NoProof("a power series lost terms")
    terms = [[*y.coeffs(), *[arb(0)] * order][:order] for y in flat]
    return [arb_mat(2, 4, [y[n] for y in terms]) for n in range(order)]


def transition_terms(pendulum: Pendulum, series: Series, start: Any, order: int) -> list[Any]:
    """Taylor coefficients 0 .. order of the derivative of the flow, 4 x 4, from `start`."""
    blocks, out = blocks_of(pendulum, series, order), [start]
    for n in range(order):
        total = blocks[0] * out[n]
        for j in range(1, n + 1):
            total += blocks[j] * out[n - j]
        velocities = [out[n][i, j] for i in (2, 3) for j in range(4)]
        out.append(arb_mat(4, 4, [y / (n + 1) for y in velocities + total.entries()]))
    return out


def unit_matrix() -> Any:
    return arb_mat(4, 4, [1 if i == j else 0 for i in range(4) for j in range(4)])


def widen(x: Any, share: float, more: float) -> Any:
    """A ball about the same middle with a larger radius."""
    return arb(x.mid(), float(x.rad()) * (1 + share) + more)


def rough_box(pendulum: Pendulum, x: Any, h: float, guess: float = 1e-4) -> Any:
    """Moore's a-priori enclosure of the motion over [0, h], or `None`."""
    time_ball = arb(h / 2, h / 2 * (1 + 1e-12))
    box = [widen(u + time_ball * f, 0.1, guess) for u, f in zip(x, field(pendulum, x), strict=True)]
    for _ in range(15):
        image = [u + time_ball * f for u, f in zip(x, field(pendulum, box), strict=True)]
        if not all(y.is_finite() for y in image):
            return None
        if all(u.contains_interior(y) for u, y in zip(box, image, strict=True)):
            return image
        box = [widen(u.union(y), 0.1, 1e-30) for u, y in zip(box, image, strict=True)]
    return None


def rough_matrix(pendulum: Pendulum, box: Any, h: float) -> Any:
    """The same of the derivative of the flow, which begins with the unit matrix."""
    parts = (
        *box[2:], box[0].cos(), box[1].sin(), box[1].cos(), (box[0] - box[1]).sin(),
        (box[0] - box[1]).cos(), accelerations(pendulum, box)[0],
    )  # fmt: skip
    rows = partials(pendulum, parts)
    one, zero = arb(1), arb(0)
    slope = arb_mat(4, 4, [zero, zero, one, zero, zero, zero, zero, one, *rows[0], *rows[1]])
    time_ball = arb(h / 2, h / 2 * (1 + 1e-12))
    unit = unit_matrix()
    guess = unit + slope * time_ball
    for _ in range(15):
        guess = arb_mat(4, 4, [widen(y, 0.1, 1e-4) for y in guess.entries()])
        image = unit + slope * guess * time_ball
        pairs = zip(guess.entries(), image.entries(), strict=True)
        if all(u.contains_interior(y) for u, y in pairs):
            return image
        pairs = zip(guess.entries(), image.entries(), strict=True)
        guess = arb_mat(4, 4, [u.union(y) for u, y in pairs])
    raise NoProof("no a-priori bound of the derivative")


def horner(terms: Any, h: Any) -> Any:
    out = terms[-1]
    for y in terms[-2::-1]:
        out = out * h + y
    return out


def horner_matrix(terms: Any, h: Any) -> Any:
    out = terms[-1]
    for y in terms[-2::-1]:
        out = out * h + y
    return out


class Step(NamedTuple):
    """One proved step: Taylor coefficients, the remainder's coefficient, the derivative."""

    terms: list[list[Any]]
    remainder: list[Any]
    matrix: Any
    length: Any

    def at(self, s: Any) -> list[Any]:
        """The state at a time s of the step, a ball."""
        last = s ** (len(self.terms[0]))
        return [horner(y, s) + r * last for y, r in zip(self.terms, self.remainder, strict=True)]


def sure_step(pendulum: Pendulum, x: Any, h: Any, order: int, derivative: bool) -> Step:
    if not bool(h > 0):
        raise NoProof("a step does not go forwards")
    reach = float(h.upper()) * (1 + 1e-12)
    box = rough_box(pendulum, x, reach)
    if box is None:
        raise NoProof("no a-priori box of the motion")
    here, around = motion(pendulum, x, order), motion(pendulum, box, order + 1)
    terms = [y[: order + 1] for y in here.state]
    remainder = [y[order + 1] for y in around.state]
    if not derivative:
        return Step(terms, remainder, None, h)
    rough = rough_matrix(pendulum, box, reach)
    inner = transition_terms(pendulum, here, unit_matrix(), order)
    outer = transition_terms(pendulum, around, rough, order + 1)[-1]
    return Step(terms, remainder, horner_matrix(inner, h) + outer * h ** (order + 1), h)


def middle_of(x: Any) -> list[Any]:
    return [y.mid() for y in x]


def plan_steps(
    pendulum: Pendulum, x: Any, duration: float, order: int, wish: tuple[float, float]
) -> tuple[list[float], list[Any]]:
    """A march without proof: exact lengths of all steps but the last, and where the steps begin;
    the last terms are below 10^exponent.

    Arguments:
        wish: the exponent, and the share of the step that it allows which is gone.
    """
    exponent, share = wish
    lengths: list[float] = []
    states, t = [x], 0.0
    while True:
        state = motion(pendulum, x, order).state
        h = LONGEST_STEP
        for n in (order - 1, order):
            size = max(float(abs(y[n]).mid()) for y in state)
            h = min(h, share * 10 ** ((exponent - math.log10(size + 1e-300)) / n))
        while True:
            box = rough_box(pendulum, x, h)
            if box is not None and max(float(y.rad()) for y in box) < WIDEST:
                break
            h *= SHORTER
            if h < 1e-6:
                raise NoProof("no step is short enough")
        h = max(round(h * 2**20), 1) / 2**20
        if t + 1.02 * h >= duration:
            return lengths, states
        lengths.append(h)
        t += h
        x = middle_of([horner(y, arb(h)) for y in state])
        states.append(x)
