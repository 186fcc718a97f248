"""Polynomials in Chebyshev's basis on a square, and how far a function is from them.

A polynomial of two variables is an array c of shape (..., n, m): sum_jk c_jk T_j(s) T_k(z), s and z
in [-1, 1]. |T_j| <= 1 there, so that its size is at most the sum of |c_jk|. On the ellipse E_rho
with the foci -1, 1 and the half axes (rho +- 1/rho)/2, |T_j| <= (rho^j + rho^-j)/2.

Let g be analytic on E_rho with |g| <= M. Its coefficients a_k are at most 2 M rho^-k (Bernstein;
Trefethen, "Approximation Theory and Approximation Practice" (2013), theorem 8.1). The polynomial
that agrees with g at the n roots of T_n takes each T_k, k >= n, for +-T_j with a j < n or for 0,
because T_n is zero there and T_(n+i) = -T_(n-i). Hence on [-1, 1] it is off by at most

    2 sum_(k >= n) |a_k| <= 4 M rho^-n/(1 - 1/rho),

and the polynomial is at most Lambda times as large as its values at the roots,
Lambda = 1 + (2/pi) log(n + 1) (the same book, theorem 15.2). In two variables one follows the
other: |g| <= Lambda_n Lambda_m max |g(roots)| + tail in s + Lambda_n tail in z, where the tail in s
needs g for complex s and real z only, and the other way round.

The roots are float64 numbers here, off by less than u. Between a root and its float64 number g
changes by at most u M/d, d = (rho + 1/rho)/2 - 1 being the distance from [-1, 1] to E_rho.
"""

import functools
import math
from fractions import Fraction
from typing import Any

import numpy as np
from flint import arb

from dpend.proofs.balls import UNIT, gamma, precision
from dpend.proofs.lanes import UP

# Bits with which the roots are computed before they are rounded.
ROOT_BITS = 100
# Covers some hundred roundings of positive numbers, and those of a logarithm.
COVER = 1 + 1e-12


@functools.lru_cache
def nodes(n: int) -> Any:
    """The roots of T_n in float64, each within u of the true one."""
    with precision(ROOT_BITS):
        return np.array([float((arb.pi() * (2 * k + 1 - n) / (2 * n)).sin()) for k in range(n)])


def _rows(n: int, x: Fraction) -> tuple[list[Fraction], list[Fraction]]:
    """T_j(x) and T_j'(x), j < n, exactly."""
    t, slope = [Fraction(1), x], [Fraction(0), Fraction(1)]
    for j in range(2, n):
        t.append(2 * x * t[-1] - t[-2])
        slope.append(2 * t[j - 1] + 2 * x * slope[-1] - slope[-2])
    return t[:n], slope[:n]


@functools.lru_cache
def values_matrix(n: int) -> tuple[Any, Any]:
    """T_j and T_j' at `nodes`, shape (n, n) each: exact numbers rounded once."""
    rows = [_rows(n, Fraction(float(x))) for x in nodes(n)]
    values, slopes = (np.array([[float(x) for x in row[i]] for row in rows]) for i in (0, 1))
    return values, slopes


@functools.lru_cache
def fit_matrix(n: int) -> Any:
    """From values at `nodes` to coefficients: a proposal, its rounding is not bounded."""
    return np.linalg.inv(values_matrix(n)[0])


def integral(c: Any) -> Any:
    """Coefficients of an integral over s, the first ones left zero: a proposal."""
    out = np.zeros_like(c)
    for j in range(c.shape[-2]):
        if j + 1 < c.shape[-2]:
            out[..., j + 1, :] += c[..., j, :] / (2 * (j + 1) if j else 1)
        if j > 1:
            out[..., j - 1, :] -= c[..., j, :] / (2 * (j - 1))
    return out


@functools.lru_cache
def halves(n: int) -> tuple[Any, Any]:
    """From coefficients on [-1, 1] to those on its lower and its upper half, shape (n, n) each.

    Their entries are dyadic numbers, here rounded once.
    """
    out = []
    for shift in (Fraction(-1, 2), Fraction(1, 2)):
        columns = [[Fraction(int(i == 0)) for i in range(n)]]
        columns.append([shift, Fraction(1, 2), *[Fraction(0)] * n][:n])
        for _ in range(2, n):
            # T_j+1(y) = 2 y T_j(y) - T_j-1(y), y = shift + x/2, and 2 x T_i = T_i+1 + T_|i-1|.
            last, before = columns[-1], columns[-2]
            new = [2 * shift * a - b for a, b in zip(last, before, strict=True)]
            for i, a in enumerate(last):
                if a:
                    for k in (i + 1, abs(i - 1)):
                        new[k] += a / 2
            columns.append(new)
        out.append(np.array([[float(x) for x in column] for column in columns[:n]]).T)
    return out[0], out[1]


def halving_error(n: int) -> float:
    """What halving along one axis is off by at most, relative to the sum of the sizes."""
    largest = max(float(np.abs(one).sum(0).max()) for one in halves(n))
    return gamma(n + 2) * largest * UP


def lebesgue(n: int) -> float:
    """Lambda of n roots, rounded up."""
    return (1 + 2 / math.pi * math.log(n + 1)) * COVER


def weights(n: int, rho: float) -> Any:
    """Bounds |T_j| on E_rho, j < n."""
    powers = np.cumprod([1.0, *[rho] * (n - 1)])
    return (powers + 1 / powers) / 2 * COVER


def tail(n: int, rho: float) -> float:
    """What a bound M on E_rho is multiplied by for the error of interpolation at `nodes`."""
    distance = (rho + 1 / rho) / 2 - 1
    return (4 * rho**-n / (1 - 1 / rho) + lebesgue(n) ** 2 * UNIT / distance) * COVER


def total(c: Any) -> Any:
    """Bounds |P| on the square: the sum of the coefficients' sizes."""
    return np.abs(c).sum((-2, -1)) * (1 + gamma(c.shape[-1] * c.shape[-2]))


def beside_first(c: Any) -> Any:
    """Bounds |P - c_00| on the square."""
    sizes = np.abs(c)
    sizes[..., 0, 0] = 0
    return sizes.sum((-2, -1)) * (1 + gamma(c.shape[-1] * c.shape[-2]))
