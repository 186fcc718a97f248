"""Tables of collocation at eight nodes: Gauss's, and Lobatto's for a companion with other errors.

A polynomial of degree seven goes through the values f_j of a second derivative at the nodes c_j of
a step [0, 1]. The tables integrate it, once and twice, up to each node and over the whole step, and
they turn the values into coefficients of powers of x = t - 1, which continue the polynomial beyond
the step. Everything is computed in long double, from Legendre polynomials, and rounded once; where
long double is double the last digit suffers.
"""

import math
from typing import NamedTuple

import numpy as np

NODES = 8


class Tables(NamedTuple):
    """Row 0 of each array belongs to Gauss's nodes, row 1 to Lobatto's."""

    nodes: np.ndarray  # c, shape (2, 8)
    node_powers: np.ndarray  # c^k, shape (8, 2, 8)
    first: np.ndarray  # from values to integrals up to node i, columns (j, row, i): shape (8, 2, 8)
    second: np.ndarray  # the same, integrated twice
    ends: np.ndarray  # over the step, once and twice: shape (2, 2, 8)
    powers: np.ndarray  # from values to coefficients of x^k, columns (j, row, k): shape (8, 2, 8)
    lacking: (
        np.ndarray
    )  # coefficients of q and of (x + 1/2) q, q monic with Gauss's nodes as zeros, shape (2, 10)
    apart: (
        np.ndarray
    )  # by how much (x + 1/2)^8 and ^9 change Lobatto's sixth and seventh coefficients more


def _legendre(x: np.ndarray) -> np.ndarray:
    """P_0 ... P_8 at x, shape (9, n)."""
    p = [np.ones_like(x), x]
    for k in range(1, NODES):
        p.append(((2 * k + 1) * x * p[k] - k * p[k - 1]) / (k + 1))
    return np.array(p)


def _gauss() -> tuple[np.ndarray, np.ndarray]:
    """Zeros of P_8 on [-1, 1] and their weights, by Newton's method."""
    x = np.polynomial.legendre.leggauss(NODES)[0].astype(np.longdouble)
    for _ in range(3):
        p = _legendre(x)
        slope = NODES * (x * p[NODES] - p[NODES - 1]) / (x * x - 1)
        x = x - p[NODES] / slope
    return x, 2 / ((1 - x * x) * slope**2)


def _lobatto() -> tuple[np.ndarray, np.ndarray]:
    """-1, the zeros of P_7', 1 and their weights: zeros of P_6 - x P_7, whose slope is -8 P_7."""
    n = NODES - 1
    # All roots are real; NumPy calls them complex from 2.5 on.
    inner = np.polynomial.legendre.legroots(np.polynomial.legendre.legder(np.eye(NODES)[n])).real
    x = np.concatenate([[-1.0], inner, [1.0]]).astype(np.longdouble)
    for _ in range(3):
        p = _legendre(x)
        x = x + (p[n - 1] - x * p[n]) / (NODES * p[n])
    return x, 2 / (n * NODES * _legendre(x)[n] ** 2)


def _row(x: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, ...]:
    """One row of every table."""
    p = _legendre(x)[:NODES]
    # Values to Legendre coefficients: exact for both kinds of nodes, by their discrete
    # orthogonality.
    fit = weights * p / (weights * p**2).sum(axis=1)[:, None]
    gauss_x, gauss_weights = _gauss()

    def integral(end: np.longdouble, order: int) -> np.ndarray:
        at = end * (gauss_x + 1) / 2
        return (end * gauss_weights / 2 * (end - at) ** (order - 1)) @ (
            _legendre(2 * at - 1)[:NODES].T @ fit
        )

    c, k = (x + 1) / 2, np.arange(NODES)
    first, second = (np.array([integral(end, order) for end in c]) for order in (1, 2))
    # P_j(2 t - 1) = sum_i comb(j, i) comb(j + i, i) (t - 1)^i.
    shifted = [[math.comb(j, i) * math.comb(j + i, i) for j in k] for i in k]
    powers = np.array(shifted, np.longdouble) @ fit
    ends = np.stack([integral(np.longdouble(1), order) for order in (1, 2)])
    return c, first, second, ends, powers


def _tables() -> Tables:
    rows = _row(*_gauss()), _row(*_lobatto())
    q = np.polynomial.polynomial.polyfromroots(rows[0][0] - 1)
    lacking = np.stack([np.append(q, 0.0), np.append(q / 2, 0.0) + np.append(0.0, q)])
    fits = [row[4] @ np.stack([(row[0] - 0.5) ** k for k in (8, 9)], axis=1) for row in rows]
    apart = np.diagonal((fits[1] - fits[0])[6:])
    nodes, first, second, ends, powers = (np.stack(pair) for pair in zip(*rows, strict=True))
    first, second, powers = (table.transpose(2, 0, 1) for table in (first, second, powers))
    ends, node_powers = ends.transpose(1, 0, 2), nodes ** np.arange(NODES)[:, None, None]
    tables = nodes, node_powers, first, second, ends, powers, lacking, apart
    return Tables(*(table.astype(np.float64) for table in tables))


TABLES = _tables()
