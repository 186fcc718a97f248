"""Numbers that are known to lie in an interval: exact decimals, balls, and the pendulum on balls.

A ball is a midpoint and a radius (Johansson, "Arb: efficient arbitrary-precision midpoint-radius
interval arithmetic", IEEE Trans. Computers 66 (2017)), computed by python-flint. Every operation on
balls returns a ball that holds all results, rounding included.

The units are natural, l1 = m1 = g = 1. A pendulum is then lambda = l2/l1 and mu = m2/m1, two
rational numbers, because each parameter is the decimal that a person wrote. With
delta = a - b, I = 1/(1 + mu sin^2 delta), k = (1 + mu)/(mu lambda^2) and nu = mu lambda the
equations of motion of angles a, b and momenta p, q are

    a' = u = (p - q cos(delta)/lambda) I        p' = -nu u v sin(delta) - (1 + mu) sin(a)
    b' = v = (k q - p cos(delta)/lambda) I      q' =  nu u v sin(delta) - nu sin(b)

which are `dpend.mechanics.pendulum.vector_field` in these units.

Floats enter proofs in two ways. A float is an exact number, and any float may be a midpoint. A
float that bounds something from above comes from `upper`, or from float64 sums and products of
numbers that are not negative, multiplied by a factor that covers their rounding (`gamma`; Higham,
"Accuracy and Stability of Numerical Algorithms", 2002, section 3.1).
"""

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
from flint import acb, arb, arb_series, ctx, fmpq

from dpend.proofs.decimals import Enclosure

# The rounding unit of float64, round to nearest.
UNIT = 2.0**-53
# Bits of products of many matrices: what grows along an orbit with kappa = 1e8 costs 60.
BITS_OF_PRODUCTS = 128
# What is added to bounds so that products below the least normal number do no harm.
TINY = 1e-290
# log10 of 2.
DIGITS_A_BIT = 0.30103
# What one rounding of `float(x)`, which may go either way, is covered by.
_ONE_ULP = 1 + 2.0**-50


def gamma(count: int) -> float:
    """Bounds the relative error of `count` roundings: n u/(1 - n u), inflated.

    It holds for sums of products in any order, with or without fused operations.
    """
    return count * UNIT / (1 - count * UNIT) * _ONE_ULP


def upper(x: Any) -> float:
    """A float that is not below |x| for any number of the ball x; infinite for what is no number,
    which comparisons and `max` would lose.
    """
    return float(x.abs_upper()) * _ONE_ULP + 5e-324 if x.is_finite() else math.inf


def fraction_ball(x: Fraction) -> Any:
    """A ball around a rational number, as narrow as the working precision allows."""
    return arb(fmpq(x.numerator, x.denominator))


@contextlib.contextmanager
def precision(bits: int, terms: int = 10) -> Iterator[None]:
    """Balls carry `bits` bits and series `terms` terms inside; what was set before returns.

    python-flint has one setting for the whole process, hence proofs do not run in threads.
    """
    before = ctx.prec, ctx.cap
    try:
        ctx.prec, ctx.cap = bits, terms
        yield
    finally:
        ctx.prec, ctx.cap = before


class Coefficients(NamedTuple):
    """The five numbers in the equations of motion, as balls of the working precision."""

    mu: Any
    inverse: Any  # 1/lambda
    k: Any
    nu: Any
    weight: Any  # 1 + mu


class Ratios(NamedTuple):
    """The same numbers as floats, for proposals."""

    mu: float
    inverse: float
    k: float
    nu: float
    weight: float


@dataclass(frozen=True)
class Parameters:
    """A pendulum whose parameters are exact decimals.

    Attributes:
        l1, l2: lengths [m]; m1, m2: masses [kg]; g: gravity [m/s^2], positive; as decimal text.
    """

    l1: str
    l2: str
    m1: str
    m2: str
    g: str

    def exact(self) -> tuple[Fraction, ...]:
        """mu, 1/lambda, k, nu and 1 + mu."""
        lam = Fraction(self.l2) / Fraction(self.l1)
        mu = Fraction(self.m2) / Fraction(self.m1)
        return mu, 1 / lam, (1 + mu) / (mu * lam**2), mu * lam, 1 + mu

    def balls(self) -> Coefficients:
        return Coefficients(*map(fraction_ball, self.exact()))

    def floats(self) -> Ratios:
        return Ratios(*map(float, self.exact()))

    def second(self) -> Any:
        """The natural unit of time sqrt(l1/g) [s]."""
        return fraction_ball(Fraction(self.l1) / Fraction(self.g)).sqrt()

    def momentum(self) -> Any:
        """The natural unit of momentum m1 l1 sqrt(g l1) [kg m^2/s]."""
        length, gravity = Fraction(self.l1), Fraction(self.g)
        return fraction_ball(Fraction(self.m1) * length) * fraction_ball(gravity * length).sqrt()

    def joule(self) -> Any:
        """The natural unit of energy m1 g l1 [J]."""
        return fraction_ball(Fraction(self.m1) * Fraction(self.g) * Fraction(self.l1))


def _sin_cos(x: Any) -> tuple[Any, Any]:
    return arb_series.sin_cos(x) if isinstance(x, arb_series) else (x.sin(), x.cos())


def field(pendulum: Coefficients, state: Any) -> tuple[Any, ...]:
    """The time derivative of (a, b, p, q): balls, complex balls and power series alike."""
    return _field_parts(pendulum, state)[0]


def _field_parts(pendulum: Coefficients, state: Any) -> tuple[Any, ...]:
    mu, inverse, k, nu, weight = pendulum
    a, b, p, q = state
    s, c = _sin_cos(a - b)
    (sin1, cos1), (sin2, cos2) = _sin_cos(a), _sin_cos(b)
    share = 1 / (s * s * mu + 1)
    u, v = (p - q * c * inverse) * share, (q * k - p * c * inverse) * share
    pull = u * v * s * nu
    value = u, v, -pull - sin1 * weight, pull - sin2 * nu
    return value, (p, q, s, c, cos1, cos2, share, u, v)


# Where the eight different entries of the Jacobian stand in its four rows, and with which sign.
ENTRIES = np.array([[0, 0, 2, 3], [1, 1, 3, 4], [5, 6, 0, 1], [6, 7, 0, 1]])
SIGNS = np.array([[1.0, -1, 1, 1], [1, -1, 1, 1], [1, 1, -1, -1], [1, 1, 1, 1]])


def field_and_jacobian(pendulum: Coefficients, state: Any) -> tuple[Any, Any]:
    """`field`, and the eight numbers of which its Jacobian is made (`ENTRIES`, `SIGNS`)."""
    mu, inverse, k, nu, weight = pendulum
    value, (p, q, s, c, cos1, cos2, share, u, v) = _field_parts(pendulum, state)
    by_a = s * share
    u_a = by_a * (q * inverse - c * u * (mu * 2))
    v_a = by_a * (p * inverse - c * v * (mu * 2))
    pull_a = -((u_a * v + v_a * u) * s + u * v * c) * nu
    entries = (u_a, v_a, share, -(c * share) * inverse, share * k)
    return value, (*entries, pull_a - cos1 * weight, -pull_a, pull_a - cos2 * nu)


def total_energy(pendulum: Coefficients, state: Any) -> Any:
    """H of a state [m1 g l1]; the kinetic energy is (a' p + b' q)/2."""
    a, b, p, q = state
    u, v, *_ = field(pendulum, state)
    return (u * p + v * q) / 2 - a.cos() * pendulum.weight - b.cos() * pendulum.nu


def energy_gradient(pendulum: Coefficients, state: Any) -> tuple[Any, ...]:
    """The derivatives of H by a, b, p and q: Hamilton's equations the other way round."""
    u, v, force1, force2 = field(pendulum, state)
    return -force1, -force2, u, v


def disc(middle: float, radius: float) -> Any:
    """A square of the complex plane that holds the disc about a real middle."""
    return acb(arb(middle, radius), arb(0, radius))


def power_bound(base: float, terms: int) -> float:
    """Bounds the sum of base^-n over n >= terms, base above 1."""
    q = arb(base)
    return upper(1 / (q**terms * (1 - 1 / q)))


def ball_of(enclosure: Enclosure) -> Any:
    """A ball of the working precision that holds a decimal interval."""
    radius = upper(fraction_ball(Fraction(enclosure.radius)))
    return fraction_ball(Fraction(enclosure.midpoint)) + arb(0, radius)


def enclosure_of(ball: Any, digits: int = 25) -> Enclosure:
    """A decimal interval that holds the ball: two digits more than are known, `digits` at most.

    What the midpoint loses by rounding is part of the printed radius.
    """
    known = int(ball.rel_accuracy_bits() * DIGITS_A_BIT) + 3
    text = ball.str(max(1, min(digits, known)), radius=True, more=True).strip("[]")
    middle, mark, radius = text.partition("+/-")
    # Without the mark it is an exact number that was short enough.
    return Enclosure(middle.strip() or "0", radius.strip() if mark else "0")
