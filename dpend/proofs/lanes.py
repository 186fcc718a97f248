"""Float64 numbers on many lanes, each lane with a bound of what its numbers are off by.

NumPy's sums, products, quotients and square roots of float64 arrays are single operations, rounded
to nearest as IEEE 754 says: the result z is off by at most u |z|, u = 2^-53, whichever vector
instructions are used. A `Lanes` carries, with L rows of N numbers, one bound a row that covers how
far each of the N numbers is from the true one. The bound grows by the rules below, and each rule
computes it with a few sums and products of numbers that are not negative, multiplied by `UP`.

The bound may also stand for a set. With N = 1 a row is a disc of the complex plane about a real
number c: the same rules hold, because with |z| <= r

    |(c + z)(d + w) - c d| <= |c| |w| + |d| |z| + |z| |w|,   |1/(c + z) - 1/c| <= r/(|c| (|c| - r)),
    |sin(c + z) - sin c| <= |sin c| (cosh r - 1) + |cos c| sinh r,   and the same with cos and sin,

and cosh r - 1 <= r^2/2 exp(r^2/2), sinh r <= r exp(r^2/6). So one formula of the equations of
motion gives values at points, intervals over cells, and bounds on complex neighbourhoods.

`np.sin` and `np.cos` have no proved bound. `sin_cos` has: it takes off k pi/2 in two parts, the
first exactly, and sums Taylor polynomials of degree 17 and 18 on |r| < 0.79, which are off by
0.79^19/19! < 1e-19. The remainder r is off by at most 2 u, and Horner's rule by at most 3 u of
numbers that are at most 1, below `SIN_COS_ERROR` = 9 u in all.
"""

import math
from typing import Any

import numpy as np

from dpend.proofs.balls import TINY, UNIT

# Covers sixteen roundings of sums and products of numbers that are not negative.
UP = 1 + 2.0**-48
# Bounds the error of `sin_cos` for arguments up to LARGEST; see above.
SIN_COS_ERROR = 1e-15
LARGEST = 1e3
# pi/2 as a float64 number of 33 bits, and the rest of it.
QUARTER = 1.5707963267341256
QUARTER_REST = 6.077100506506192e-11
# Coefficients of Horner's rule: sin r = r + r z S(z), cos r = 1 + z C(z), z = r^2.
SINE = [(-1) ** n / math.factorial(2 * n + 1) for n in range(8, 0, -1)]
COSINE = [(-1) ** n / math.factorial(2 * n) for n in range(9, 0, -1)]
# `exp_above` divides by 2^6, sums to the 13th power and squares six times.
SQUARINGS, POWERS, LARGEST_EXPONENT = 6, 13, 30.0


def sin_cos(x: Any) -> tuple[Any, Any]:
    """sin and cos of float64 numbers, off by at most `SIN_COS_ERROR`; NaN beyond `LARGEST`."""
    x = np.where(np.abs(x) <= LARGEST, x, np.nan)
    k = np.rint(x * (2 / math.pi))
    r = (x - k * QUARTER) - k * QUARTER_REST
    z = r * r
    s, c = np.full_like(z, SINE[0]), np.full_like(z, COSINE[0])
    for coefficient in SINE[1:]:
        s = s * z + coefficient
    for coefficient in COSINE[1:]:
        c = c * z + coefficient
    s, c = r + r * z * s, 1 + z * c
    turn = np.nan_to_num(k).astype(np.int64) & 3
    odd = (turn & 1).astype(bool)
    sine = np.where(odd, c, s) * np.where(turn >= 2, -1.0, 1.0)
    cosine = np.where(odd, s, c) * np.where((turn == 1) | (turn == 2), -1.0, 1.0)
    return sine, cosine


def exp_above(x: Any) -> Any:
    """Numbers not below exp(x), x >= 0; infinite where x is large or no number."""
    y = np.where(x <= LARGEST_EXPONENT, x, 0.0) / 2**SQUARINGS
    # The tail after the last power is less than that power with twice its coefficient.
    out = np.full_like(y, 2 / math.factorial(POWERS))
    for n in range(POWERS - 1, -1, -1):
        out = out * y + 1 / math.factorial(n)
    for _ in range(SQUARINGS):
        out = out * out
    # 2^6 times some 30 roundings of positive numbers.
    return np.where(x <= LARGEST_EXPONENT, out * (1 + 1e-12), np.inf)


class Lanes:
    """L rows of N numbers, each row with a bound of its errors.

    Attributes:
        value: shape (L, N); error: shape (L, 1), infinite where nothing is known.
    """

    __slots__ = ("_size", "_turn", "error", "value")

    def __init__(self, value: Any, error: Any) -> None:
        self.value, self.error = value, error
        self._size: Any = None
        self._turn: Any = None

    @property
    def size(self) -> Any:
        """The largest |value| of each row, shape (L, 1)."""
        if self._size is None:
            self._size = np.abs(self.value).max(-1, keepdims=True)
        return self._size

    def bound(self) -> Any:
        """Bounds the true numbers of each row, shape (L,); infinite where nothing is known."""
        out = ((self.size + self.error) * UP)[:, 0]
        return np.where(np.isnan(out), np.inf, out)

    def __add__(self, other: "Lanes | int") -> "Lanes":
        value, error = (other.value, other.error) if isinstance(other, Lanes) else (other, 0.0)
        out = Lanes(self.value + value, None)
        out.error = (self.error + error + UNIT * out.size) * UP
        return out

    def __neg__(self) -> "Lanes":
        return Lanes(-self.value, self.error)

    def __sub__(self, other: "Lanes") -> "Lanes":
        return self + -other

    def __mul__(self, other: "Lanes | int") -> "Lanes":
        if not isinstance(other, Lanes):
            return self * Lanes(np.full((1, 1), float(other)), 0.0)
        a, b = self.size, other.size
        error = a * other.error + b * self.error + self.error * other.error + UNIT * a * b
        return Lanes(self.value * other.value, error * UP + TINY)

    def __rtruediv__(self, one: int) -> "Lanes":
        least = np.abs(self.value).min(-1, keepdims=True)
        room = least - self.error
        safe = room > 0
        out = Lanes(one / np.where(self.value == 0, np.nan, self.value), None)
        spread = one * self.error / np.where(safe, least * room, 1.0)
        out.error = np.where(safe, (spread + UNIT * out.size) * UP, np.inf)
        return out

    def _sin_cos(self) -> "tuple[Lanes, Lanes]":
        if self._turn is None:
            s, c = (Lanes(value, None) for value in sin_cos(self.value))
            r = self.error
            straight = r * exp_above(r * r / 6 * UP)
            round_ = r * r / 2 * exp_above(r * r / 2 * UP)
            for one, other in ((s, c), (c, s)):
                first, second = one.size + SIN_COS_ERROR, other.size + SIN_COS_ERROR
                one.error = (first * round_ + second * straight + SIN_COS_ERROR) * UP
            self._turn = s, c
        return self._turn

    def sin(self) -> "Lanes":
        return self._sin_cos()[0]

    def cos(self) -> "Lanes":
        return self._sin_cos()[1]
