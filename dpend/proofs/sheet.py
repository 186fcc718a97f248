"""All motions released from one angle, as polynomials in time and in the other angle.

The circle of theta2 is cut into boxes c + r z, z in [-1, 1]. Each box marches through time by
itself, in steps of half width w. Over a step the motions are

    x(t0 + w (1 + s); c + r z) = P(s, z) + e(s, z),  |e|_S <= epsilon,  s, z in [-1, 1],

with a polynomial P (`chebyshev`) whose float64 coefficients count as exact numbers, and the norm
|e|_S = |S e|_2 in which the equations near the hanging pendulum are close to a rotation. A step
takes five bounds, on all boxes at once.

1. *Defect.* D = P' - w f(P) at the roots, with the rounding errors of `Lanes`, plus the tails of
   interpolation from |D| on the ellipses, where |P - c_00| is bounded by its coefficients.
2. *Growth.* The largest eigenvalue m of the symmetric part of S J S^-1 on the box that holds P and
   the tube of width epsilon about it. e' = w (f(P + e) - f(P)) - D then gives (Dahlquist 1958;
   Hairer, Norsett, Wanner, "Solving Ordinary Differential Equations I" (1993), section I.10)
   |e(s)| <= exp(2 w m) (|e(-1)| + 2 max |D|) as long as e is in the tube; it stays there if this
   is below epsilon.
3. *Start.* |e(-1)| is at most that of the step before at s = 1, plus how far the polynomials of
   both steps are apart there.
4. *Eigenvalue.* With a float64 matrix Q, near the eigenvectors, |Q^T Q - 1| <= h: the largest
   eigenvalue of B is at most the largest of the row sums of Q^T B Q, over 1 - h (Gershgorin).
5. *Rates*, for the first step alone: x' = P' + (w (f(P + e) - f(P)) - D).

A box whose polynomials do not decay in z is halved; one whose tails in s are too large takes a
shorter step. No box is carried from step to step but the number epsilon, which is small because
P follows the motions to rounding.
"""

from typing import Any, NamedTuple

import numpy as np

from dpend.proofs import chebyshev
from dpend.proofs.balls import (
    ENTRIES,
    SIGNS,
    TINY,
    UNIT,
    Coefficients,
    Ratios,
    field,
    field_and_jacobian,
    gamma,
    upper,
)
from dpend.proofs.lanes import UP, Lanes, exp_above
from dpend.proofs.taylor import motion_series, value

# Roots in time and in theta2.
TIMES, ANGLES = 16, 10
# Order of the Taylor series that the polynomials are made of, and the share of its radius of
# convergence that a step goes.
ORDER, SHARE = 24, 0.15
# Ellipses that are tried.
TIME_RADII, ANGLE_RADII = (4.0, 6.0, 8.0, 11.0, 15.0), (4.0, 6.0, 9.0, 14.0, 21.0, 32.0, 50.0, 90.0)
# A defect larger than this is made smaller by halving the box or the step.
DEFECT = 1e-13
# epsilon that is tried, over what is known before the growth is.
TUBE = 4.0
# Steps are multiples of this, so that times are sums without rounding.
GRAIN = 2.0**-24


class Front(NamedTuple):
    """Boxes at one time each, L of them.

    Attributes:
        middle, half: c and r [rad], dyadic numbers; time: natural units; shape (L,).
        edge: coefficients in z of P at this time, shape (4, L, m); error: |e|_S, shape (L,).
        longest: the next step is no longer, shape (L,).
    """

    middle: Any
    half: Any
    time: Any
    edge: Any
    error: Any
    longest: Any

    def take(self, keep: Any) -> "Front":
        return Front(*(x[:, keep] if x.ndim > 1 else x[keep] for x in self))


class Step(NamedTuple):
    """What is proved over one step of each box.

    Attributes:
        start: the front that it starts from; half: w, shape (L,).
        series: coefficients of P, shape (4, L, n, m); error: epsilon, shape (L,), infinite where
            nothing is proved; rates: bounds the last terms of x' by component, shape (4, L).
        narrow: whether a narrower box is what would help, shape (L,); else a shorter step.
    """

    start: Front
    half: Any
    series: Any
    error: Any
    rates: Any
    narrow: Any

    def take(self, keep: Any) -> "Step":
        parts = (x[:, keep] if x.ndim > 1 else x[keep] for x in self[1:])
        return Step(self.start.take(keep), *parts)


class Sheet:
    """The motions of one pendulum.

    Arguments:
        exact: the coefficients as balls; floats: the same as float64 numbers.
        cuts: how often a step is halved for its growth: the finer, the less is overestimated.
    """

    def __init__(self, exact: Coefficients, floats: Ratios, cuts: int = 2) -> None:
        self.floats, self.cuts = floats, cuts
        pairs = zip(exact, floats, strict=True)
        self.lanes: Any = Coefficients(
            *(Lanes(np.full((1, 1), x), np.full((1, 1), upper(ball - x))) for ball, x in pairs)
        )
        # Half of the inverse inertia: the mean over the angle between the rods is near it.
        self.scale = np.sqrt(np.array([floats.weight, floats.nu, 0.5, 0.5 * floats.k]))

    def norm(self, bounds: Any) -> Any:
        """|.|_S of what is bounded by component, shape (4, ...)."""
        squares = sum((s * x) ** 2 for s, x in zip(self.scale, bounds, strict=True))
        return np.sqrt(squares) * UP

    def components(self, error: Any) -> Any:
        """Bounds by component, shape (4, L), of what is bounded in |.|_S."""
        return error / self.scale[:, None] * UP

    def propose(self, front: Front) -> tuple[Any, Any]:
        """w and P, in float64: no step is longer than `front.longest`."""
        boxes, count = front.edge.shape[1:]
        fit, table = chebyshev.fit_matrix(count), chebyshev.values_matrix(count)[0]
        start = np.einsum("klj,ij->lik", front.edge, table).reshape(-1, 4)
        series = motion_series(self.floats, start, np.ones(len(start)), ORDER)
        powers = np.arange(ORDER - 3, ORDER + 1)[:, None]
        sizes = np.maximum(np.abs(series[-4:]).max(-1), 1e-300)
        radius = (sizes ** (-1.0 / powers)).min(0).reshape(boxes, count).min(1)
        half = np.minimum(SHARE * radius, front.longest) / 2
        half = np.maximum(np.ceil(half / GRAIN), 1) * GRAIN
        series = series.reshape(ORDER + 1, boxes, count, 4)
        series = series * (2 * half[:, None, None]) ** np.arange(ORDER + 1)[:, None, None, None]
        s = (1 + chebyshev.nodes(TIMES)) / 2
        # The rates are fitted and integrated: a fit of the states would have rates that are n^2
        # times as rough.
        rates = series[1:] * np.arange(1, ORDER + 1)[:, None, None, None] / 2
        rates = np.stack([value(rates, x) for x in s])
        slopes = np.einsum("ai,ilbk,cb->klac", chebyshev.fit_matrix(TIMES), rates, fit)
        out = chebyshev.integral(slopes)
        signs = (-1.0) ** np.arange(TIMES)
        out[:, :, 0] = front.edge - np.einsum("klnm,n->klm", out, signs)
        return half, out

    def step(self, front: Front) -> Step:
        """One step of each box, with its bounds."""
        with np.errstate(all="ignore"):
            half, series = self.propose(front)
            defect, in_time, in_angle = self.defect(half, series)
            start = self.start(front, series)
            known = start + 2 * self.norm(defect)
            tube = known * TUBE + TINY
            growth, stretch = self.growth(series, tube)
            error = exp_above(2 * half * growth * UP) * known * UP
            proved = (error < tube) & (np.maximum(in_time, in_angle) < DEFECT)
            error = np.where(proved, error, np.inf)
            rates = defect + self.components(half * stretch * error * UP)
        narrow = (in_angle > in_time) & ~(in_angle < DEFECT)
        return Step(front, half, series, error, rates * UP, narrow)

    def defect(self, half: Any, series: Any) -> tuple[Any, Any, Any]:
        """Bounds |D| by component, shape (4, L), and the sizes of its tails in s and z, (L,)."""
        w = Lanes(half[:, None], 0.0)
        at_roots = self._defect_at_roots(w, series)
        in_time = self._tail(w, series, TIME_RADII, True)
        in_angle = self._tail(w, series, ANGLE_RADII, False) * chebyshev.lebesgue(TIMES)
        bound = chebyshev.lebesgue(TIMES) * chebyshev.lebesgue(ANGLES) * at_roots
        bound = (bound + in_time + in_angle) * UP
        return bound, self.norm(in_time), self.norm(in_angle)

    def _defect_at_roots(self, w: Lanes, series: Any) -> Any:
        (table, slope), other = (
            chebyshev.values_matrix(TIMES),
            chebyshev.values_matrix(ANGLES)[0],
        )
        first = series[..., 0, 0]
        rest = series.copy()
        rest[..., 0, 0] = 0
        shape = (4, series.shape[1], TIMES * ANGLES)
        states = (table @ rest @ other.T).reshape(shape)
        rates = (slope @ rest @ other.T).reshape(shape)
        rounding = gamma(TIMES + ANGLES + 6)
        off = chebyshev.total(rest) * rounding * UP
        squares = np.arange(TIMES, dtype=float)[:, None] ** 2
        rate_off = chebyshev.total(rest * squares) * rounding * UP
        zero = np.zeros((series.shape[1], 1))
        state = [
            Lanes(x, e[:, None]) + Lanes(c[:, None], zero)
            for x, e, c in zip(states, off, first, strict=True)
        ]
        slopes = field(self.lanes, state)
        return np.stack(
            [
                (Lanes(x, e[:, None]) - v * w).bound()
                for x, e, v in zip(rates, rate_off, slopes, strict=True)
            ]
        )

    def _tail(self, w: Lanes, series: Any, radii: tuple[float, ...], in_time: bool) -> Any:
        """Bounds the tails of interpolation in one variable, shape (4, L): the least over radii."""
        best = np.full(series.shape[:2], np.inf)
        sizes = np.abs(series)
        sizes[..., 0, 0] = 0
        centre = series[..., 0, 0]
        for rho in radii:
            count = TIMES if in_time else ANGLES
            weight = chebyshev.weights(count, rho)
            grown = sizes * (weight[:, None] if in_time else weight)
            spread = grown.sum((-2, -1)) * (1 + gamma(TIMES * ANGLES + 4))
            state = [Lanes(c[:, None], r[:, None]) for c, r in zip(centre, spread, strict=True)]
            slope = _slope_bound(grown)
            bound = np.stack(
                [(v * w).bound() + x for v, x in zip(field(self.lanes, state), slope, strict=True)]
            )
            # Too wide a spread bounds nothing, and comes out infinite or as no number.
            best = np.minimum(
                best, np.where(np.isnan(bound), np.inf, bound) * chebyshev.tail(count, rho)
            )
        return best * UP

    def start(self, front: Front, series: Any) -> Any:
        """|e|_S at s = -1, shape (L,)."""
        signs = (-1.0) ** np.arange(TIMES)
        first = series[:, :, 0] - front.edge
        later = series[:, :, 1:]
        apart = np.abs(first + np.einsum("klnm,n->klm", later, signs[1:])).sum(-1)
        rounding = gamma(TIMES + 4) * (np.abs(first).sum(-1) + np.abs(later).sum((-2, -1)))
        return (front.error + self.norm((apart + rounding) * UP)) * UP

    def growth(self, series: Any, tube: Any) -> tuple[Any, Any]:
        """Bounds of the mean over s of m, not negative, and of |S J S^-1|_2; shape (L,) each."""
        pieces, extra = [series], self.components(tube)
        for _ in range(self.cuts):
            largest = np.max([chebyshev.total(piece) for piece in pieces], 0)
            extra = (extra + chebyshev.halving_error(TIMES) * largest) * UP
            pieces = [half @ piece for piece in pieces for half in chebyshev.halves(TIMES)]
        found = [self._growth(piece, extra) for piece in pieces]
        mean = sum(x for x, _ in found) / len(found) * UP
        return mean, np.max([x for _, x in found], 0)

    def _growth(self, series: Any, extra: Any) -> tuple[Any, Any]:
        spread = (chebyshev.beside_first(series) + extra) * UP
        pairs = zip(series[..., 0, 0], spread, strict=True)
        state = [Lanes(c[:, None], r[:, None]) for c, r in pairs]
        entries = field_and_jacobian(self.lanes, state)[1]
        shape = (series.shape[1], 1)
        middle, radius = (
            np.concatenate([np.broadcast_to(x, shape) for x in parts], -1)
            for parts in ([x.value for x in entries], [x.error for x in entries])
        )
        ratio = self.scale[:, None] / self.scale
        matrix = middle[:, ENTRIES] * SIGNS * ratio
        errors = (radius[:, ENTRIES] + 4 * UNIT * np.abs(middle[:, ENTRIES])) * ratio * UP
        stretch = np.sqrt(((np.abs(matrix) + errors) ** 2).sum((1, 2))) * UP
        matrix = (matrix + matrix.transpose(0, 2, 1)) / 2
        errors = (errors + errors.transpose(0, 2, 1)) / 2 + 2 * UNIT * np.abs(matrix)
        return (eigenvalue_above(matrix) + errors.sum(-1).max(-1)) * UP, stretch


def eigenvalue_above(matrix: Any) -> Any:
    """Numbers not below the eigenvalues of symmetric matrices, nor below 0; shape (L, k, k)."""
    fine = np.isfinite(matrix).all((1, 2))
    matrix = np.where(fine[:, None, None], matrix, 0.0)
    q = np.linalg.eigh(matrix)[1]
    t, size, k = q.transpose(0, 2, 1), np.abs(q), matrix.shape[-1]
    turned = t @ matrix @ q
    rounding = gamma(2 * k + 4) * (size.transpose(0, 2, 1) @ np.abs(matrix) @ size)
    diagonal = np.arange(k)
    sums = np.abs(turned)
    sums[:, diagonal, diagonal] = turned[:, diagonal, diagonal]
    largest = np.maximum((sums.sum(-1) + rounding.sum(-1) * UP), 0).max(-1)
    skew = np.abs(t @ q - np.eye(k)) + gamma(k + 4) * (size.transpose(0, 2, 1) @ size + 1)
    skew = skew.sum(-1).max(-1) * UP
    return np.where(fine & (skew < 0.5), largest / (1 - skew) * UP, np.inf)


def _slope_bound(grown: Any) -> Any:
    """Bounds |P'| where |T_j| is bounded by the weights in `grown`.

    T_j' = j (z^(j-1) + z^(j-3) + ... + z^(1-j)) with s = (z + 1/z)/2: on the ellipse |z| = rho
    it is at most j^2 times the bound of T_j, and on [-1, 1] at most j^2.
    """
    j = np.arange(TIMES, dtype=float)[:, None]
    return (grown * j * j).sum((-2, -1)) * (1 + gamma(TIMES * ANGLES + 4))
