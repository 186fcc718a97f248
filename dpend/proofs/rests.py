"""Where motions rest: cells of (theta2, time) proved free of it.

On a cell the momenta p, q are polynomials within known errors (`sheet`). A cell is empty if some
combination u p + v q, u and v fixed, keeps away from zero: |c_00| of the combination is larger than
the sum of its other |c_jk| and its error. Five are tried: p, q, the direction of (p, q) in the
middle, and the two that the linear parts make nearly s and z alone. At the time 0 all p vanish; on
the first step the same is asked of the rates p', q', because then u p + v q grows with time.

What is not empty is cut into two, and so on, until it is empty, lies where an orbit is proved to be
the only one, or the momenta vary over it by less than their errors, and it is left open.
"""

from typing import Any, NamedTuple

import numpy as np

from dpend.proofs import chebyshev
from dpend.proofs.balls import TINY, UNIT, gamma
from dpend.proofs.lanes import UP
from dpend.proofs.sheet import ANGLES, TIMES, Step

# More cells than this at once stay open: a proof needs a few a box.
MOST_CELLS = 100_000
# Covers the rounding of times, and of distances of angles, full turns taken off.
ROUNDING = 1e-12


class Cells(NamedTuple):
    """K cells.

    Attributes:
        middle, half: of theta2 [rad]; time, span: of the time, half width; shape (K,).
        series: coefficients of p and q, shape (2, K, n, m); error: their bounds, shape (2, K).
    """

    middle: Any
    half: Any
    time: Any
    span: Any
    series: Any
    error: Any

    def take(self, keep: Any) -> "Cells":
        return Cells(*(x[:, keep] if x.ndim > 1 else x[keep] for x in self))

    def edges(self) -> list[tuple[float, float, float, float]]:
        """Least and largest theta2, and time, of each."""
        sides = (self.middle, self.half), (self.time, self.span)
        columns = [x + sign * r for x, r in sides for sign in (-1, 1)]
        return list(zip(*(column.tolist() for column in columns), strict=True))

    def halves(self) -> "Cells":
        """Each cut into two, across time or across theta2, whichever the momenta vary more with."""
        sizes = np.abs(self.series)
        by_time = sizes[:, :, 1:].sum((0, 2, 3)) > sizes[:, :, 0, 1:].sum((0, 2))
        parts = []
        for in_time, keep in ((True, by_time), (False, ~by_time)):
            cells, count = self.take(keep), TIMES if in_time else ANGLES
            rounding = chebyshev.halving_error(count) * chebyshev.total(cells.series)
            error = (cells.error + rounding) * UP
            for half, side in zip(chebyshev.halves(count), (-0.5, 0.5), strict=True):
                middle, r, time, span = cells[:4]
                if in_time:
                    place = middle, r, time + side * span, span / 2
                    series = half @ cells.series
                else:
                    place = middle + side * r, r / 2, time, span
                    series = cells.series @ half.T
                parts.append(Cells(*place, series, error))
        return join(parts)


def join(parts: list[Cells]) -> Cells:
    return Cells(*(np.concatenate(x, 1 if x[0].ndim > 1 else 0) for x in zip(*parts, strict=True)))


def cells_of(step: Step, errors: Any) -> Cells:
    """The cells of a step.

    Arguments:
        errors: of the momenta, shape (2, L).
    """
    front = step.start
    time = front.time + step.half
    return Cells(front.middle, front.half, time, step.half, step.series[2:], errors)


def rates_of(step: Step) -> Cells:
    """The same cells with the rates of the momenta by s instead."""
    slope = np.zeros((TIMES, TIMES))
    for j in range(TIMES):
        # T_j' = 2 j (T_j-1 + T_j-3 + ...), the last term halved if it is T_0.
        for i in range(j - 1, -1, -2):
            slope[i, j] = 2 * j if i else j
    cells = cells_of(step, step.rates[2:])
    squares = np.arange(TIMES, dtype=float)[:, None] ** 2
    rounding = gamma(TIMES + 2) * TIMES * chebyshev.total(cells.series * squares)
    error = (cells.error + rounding) * UP
    return cells._replace(series=slope @ cells.series, error=error)


def empty(cells: Cells) -> Any:
    """Which cells are proved to hold no rest, shape (K,)."""
    p, q = cells.series
    centre = cells.series[:, :, 0, 0]
    # Rows (u, v) of the five combinations; any floats are right.
    with np.errstate(all="ignore"):
        by_time, by_angle = cells.series[:, :, 1, 0], cells.series[:, :, 0, 1]
        one, nought = np.ones_like(centre[0]), np.zeros_like(centre[0])
        pairs = (
            (one, nought),
            (nought, one),
            tuple(centre),
            (by_angle[1], -by_angle[0]),
            (by_time[1], -by_time[0]),
        )
        out = np.zeros(len(cells.middle), bool)
        for u, v in pairs:
            series = u[:, None, None] * p + v[:, None, None] * q
            # Two products and a sum a coefficient, and the sum over all.
            size = np.abs(u) * chebyshev.total(p) + np.abs(v) * chebyshev.total(q)
            off = np.abs(u) * cells.error[0] + np.abs(v) * cells.error[1] + 4 * UNIT * size + TINY
            out |= np.abs(series[:, 0, 0]) > (chebyshev.beside_first(series) + off) * UP
    return out


class Known(NamedTuple):
    """Releases near which one orbit is proved the only one, J of them.

    Attributes:
        theta2 [rad], time: natural units; radius: of the square about both; shape (J,).
    """

    theta2: Any
    time: Any
    radius: Any

    def holds(self, cells: Cells) -> Any:
        """Which cells lie in one of the squares, shape (K,)."""
        apart = cells.middle[:, None] - self.theta2
        apart = np.abs(apart - 2 * np.pi * np.rint(apart / (2 * np.pi))) + cells.half[:, None]
        late = np.abs(cells.time[:, None] - self.time) + cells.span[:, None]
        inside: Any = (np.maximum(apart, late) + ROUNDING < self.radius).any(1)
        return inside


def sift(cells: Cells, known: Known, end: float) -> tuple[Cells, int]:
    """The cells that stay open before the time `end`, and how many were looked at."""
    open_cells, looked = [], 0
    while len(cells.middle):
        looked += len(cells.middle)
        cells = cells.take(~empty(cells))
        early = cells.time - cells.span <= end + ROUNDING
        cells = cells.take(early & ~known.holds(cells))
        # A cell over which the momenta change by less than their errors stays open for ever.
        small = (chebyshev.beside_first(cells.series) < cells.error).all(0)
        small |= len(cells.middle) > MOST_CELLS
        open_cells.append(cells.take(small))
        cells = cells.take(~small).halves()
    return join([*open_cells, cells]), looked
