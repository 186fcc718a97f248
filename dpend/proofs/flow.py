"""What is true of the flow near Taylor polynomials: errors, derivatives and slopes, proved.

An arc of duration tau is covered by discs. Disc i has a centre and a half width w_i (a fraction of
the arc), local time s in [-1, 1], and a polynomial P_i(s) of order N with float64 coefficients,
which count as exact numbers. For a state z near P_i(0) and a duration tau near the float tau0 let
phi_i(z, tau, s) be the solution of x' = tau w_i f(x), x(0) = z. `enclose` bounds it, in five steps.
Norms are largest components, d = tau0 w_i.

1. *Defect.* eta >= |P(0) + d int_0^s f(P) - P(s)| for |s| <= 1. The first K Taylor coefficients of
   f(P(s)) come from power series of balls. The rest is at most M q^-n each (Cauchy), where M bounds
   |f| on the complex discs about P(0) that hold P(s) for |s| <= q; complex balls bound M.
2. *Jacobian.* For every e in a box of half width eps the entries of J(P(s) + e) have series whose
   coefficients lie in balls (the same arithmetic with a ball added to P), and tails by Cauchy.
3. *Growth.* L >= d (1 + r/tau0) |J| on that tube, hence (Gronwall) |phi - P| is at most
   e^L (|z - P(0)| + eta + time error) as long as phi is in the tube; by continuity it stays there
   on all of [-1, 1] if the bound itself is below eps. `room` says how large |z - P(0)| may be.
4. *Derivative.* V = d phi/d z solves V' = tau w J(phi) V, V(0) = 1. The polynomial W(s) has the
   defect 1 + tau w int J W - W, bounded by the sum of its coefficients' sizes, and |V - W| is at
   most that times e^L, column by column.
5. *Slopes.* d phi/d tau at s = +-1 is +-w_i f(phi), with f on the box about P(+-1).

Sources: Moore, Kearfott and Cloud, "Introduction to Interval Analysis" (2009), chapter 9;
Zgliczynski, "C1-Lohner algorithm", Found. Comput. Math. 2 (2002), for derivatives of flows;
Tucker, "Validated Numerics" (2011), sections 5 and 6, for Taylor models by hand.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from flint import arb, arb_poly, arb_series

from dpend.proofs.balls import (
    ENTRIES,
    SIGNS,
    TINY,
    Coefficients,
    disc,
    field,
    field_and_jacobian,
    gamma,
    power_bound,
    upper,
)

# Covers the rounding of float64 sums and products of numbers that are not negative, up to 4000
# roundings each (`gamma(4000)` is 4.5e-13). The longest sum here has some hundred terms.
COVER = 1 + 1e-12
# Radii of the complex discs that are tried for Cauchy's bounds, in half widths of the disc. More
# radii shortened no proof of the atlas by a hundredth.
RADII = (2.0, 2.4, 2.8, 3.2, 3.7, 4.3, 5.0)


class Discs(NamedTuple):
    """A chain of S discs: what a proof is about.

    Attributes:
        series: coefficients of P, shape (N + 1, S, 4).
        tangents: coefficients of W, W(0) = 1, shape (N + 1, S, 4, 4).
        half: half widths w as fractions of the arc, shape (S,).
        duration: tau0, natural units.
    """

    series: Any
    tangents: Any
    half: Any
    duration: float

    def signs(self) -> Any:
        """(-1)^n: a series at s = -1."""
        return (-1.0) ** np.arange(len(self.series))


class Tubes(NamedTuple):
    """What is proved of all solutions in the tubes of half width eps about the polynomials.

    Attributes:
        growth: e^L, shape (S,).
        defect: eta, the error of the known parts of the states included, shape (S, 4).
        plus, minus: W at s = 1 and -1, shape (S, 4, 4); spread: what they are off by at most.
        slopes: middles of f at s = 1 and -1, shape (2, S, 4); slope_spread: their radii, (S, 4).
        excursion: bounds |P(s) - P(0)| + eta, shape (S,).
    """

    growth: Any
    defect: Any
    plus: Any
    minus: Any
    spread: Any
    slopes: Any
    slope_spread: Any
    excursion: Any

    def room(self, tube: Any, duration: float) -> float:
        """How far states and duration may be off, all alike, without leaving the tubes."""
        # Rounded down: one COVER for each operation that might round up.
        space = tube / self.growth / COVER - self.defect.max(-1) * COVER
        return float((space / (1 + self.excursion / duration)).min()) / COVER**2

    def holds(self, offsets: Any, time_offset: float, duration: float, tube: Any) -> bool:
        """Whether states off by `offsets` (S, 4) and a duration off by that much stay inside."""
        off = offsets.max(-1) + self.defect.max(-1) + self.excursion * (time_offset / duration)
        return bool((off * self.growth * COVER < tube).all())


class _Disc(NamedTuple):
    """Bounds of one disc: eta (4,), and of the Jacobian's eight entries (K, 8), (K, 8), (8,)."""

    defect: Any
    middle: Any
    spread: Any
    tail: Any


def cauchy_bounds(
    pendulum: Coefficients, series: Any, tube: float, terms: int
) -> tuple[list[float], list[float]]:
    """Tails beyond `terms` terms of f and of the Jacobian's entries, at |s| <= 1.

    Raises:
        ArithmeticError: no disc is known on which the field is analytic.
    """
    least, best = math.inf, None
    for q in RADII:
        radius = np.zeros(4)
        for row in np.abs(series[:0:-1]):
            radius = (radius + row) * q
        radius = (radius + tube) * (1 + gamma(2 * len(series) + 8)) + TINY
        state = [disc(float(x), float(r)) for x, r in zip(series[0], radius, strict=True)]
        value, entries = field_and_jacobian(pendulum, state)
        bounds = [upper(x) for x in value], [upper(x) for x in entries]
        if not all(map(math.isfinite, bounds[0] + bounds[1])):
            continue
        share = power_bound(q, terms) * COVER
        if max(bounds[1]) * share < least:
            least = max(bounds[1]) * share
            best = [x * share for x in bounds[0]], [x * share for x in bounds[1]]
    if best is None:
        raise ArithmeticError("no disc of analyticity is wide enough")
    return best


def polynomial_defects(slopes: Any, rows: Any, step: Any, tails: list[float], terms: int) -> Any:
    """eta of the four components: the coefficients' defects, summed, and the tail.

    Arguments:
        slopes: four series of f(P), `terms` terms each; rows: P's coefficients as balls, four
            lists; step: d as a ball.
    """
    out = np.zeros(4)
    for k in range(4):
        if slopes[k].prec < terms:
            raise ArithmeticError("a power series lost terms")
        known = slopes[k].coeffs()
        total = upper(step) * tails[k] / (terms + 1)
        for n in range(max(len(known), len(rows[k]) - 1)):
            x = step * known[n] / (n + 1) if n < len(known) else arb(0)
            total += upper(x - rows[k][n + 1] if n + 1 < len(rows[k]) else x)
        out[k] = total * COVER
    return out


def _disc_bounds(pendulum: Coefficients, series: Any, step: Any, tube: float, terms: int) -> _Disc:
    rows = [[arb(float(x)) for x in column] for column in series.T]
    slope_tails, tails = cauchy_bounds(pendulum, series, tube, terms)
    power_series = [arb_series(row) for row in rows]
    slopes = field(pendulum, power_series)
    defect = polynomial_defects(slopes, rows, step, slope_tails, terms)
    ball = arb(0, tube)
    _, entries = field_and_jacobian(pendulum, [x + ball for x in power_series])
    middle, spread = np.zeros((terms, 8)), np.zeros((terms, 8))
    for k, entry in enumerate(entries):
        if entry.prec < terms:
            raise ArithmeticError("a power series lost terms")
        for n, x in enumerate(entry.coeffs()):
            middle[n, k] = float(x.mid())
            spread[n, k] = upper(x - arb(middle[n, k]))
    return _Disc(defect, middle, spread, np.array(tails))


def _tangent_errors(discs: Discs, bounds: _Disc, share: float) -> tuple[Any, Any]:
    """e^L, and the bounds of |V - W| before it is multiplied by e^L, per column, shape (S, 4).

    The coefficients of 1 + d int J W - W are float64 sums of at most N + 1 products, each with four
    terms, one factor and one divisor: gamma(2 N + 20) covers them, together with d itself.

    Arguments:
        bounds: of all discs, stacked along the second axis (the first where there is one only).
        share: the radius of the duration over the duration.
    """
    order, terms = len(discs.series) - 1, len(bounds.middle)
    middle = bounds.middle[..., ENTRIES] * SIGNS
    largest = np.abs(middle).sum(0)
    spread = bounds.spread[..., ENTRIES].sum(0) + bounds.tail[..., ENTRIES]
    step = discs.half * discs.duration
    lengths = (largest + spread).sum(-1).max(-1) * step * (1 + share) * COVER**2
    growth = np.array([upper(arb(float(x)).exp()) for x in lengths])
    scale = step[:, None, None]
    error = np.zeros((order + terms + 1, *discs.tangents.shape[1:]))
    for j, row in enumerate(discs.tangents):
        parts = np.einsum("nsab,sbc->nsac", middle, row) * scale
        error[j + 1 : j + 1 + terms] += parts / np.arange(j + 1, j + 1 + terms)[:, None, None, None]
    error[0] += np.eye(4)
    error[: order + 1] -= discs.tangents
    sizes = np.abs(discs.tangents).sum(0)
    known, unknown = largest @ sizes, spread @ sizes
    total = np.abs(error).sum(0) + sizes * gamma(8)
    total += scale * (known * gamma(2 * order + 20) + unknown + (known + unknown) * share)
    return growth, total.max(1) * COVER + TINY


def _end_slopes(pendulum: Coefficients, discs: Discs, tube: Any) -> tuple[Any, Any]:
    """f at both ends of each disc, on all states within the tube: middles and radii."""
    slopes, radii = np.zeros((2, *discs.series.shape[1:])), np.zeros(discs.series.shape[1:])
    for i, rows in enumerate(end_states(discs)):
        for side, ends in enumerate(rows):
            for k, x in enumerate(field(pendulum, [end + arb(0, float(tube[i])) for end in ends])):
                slopes[side, i, k] = float(x.mid())
                radii[i, k] = max(radii[i, k], upper(x - arb(slopes[side, i, k])))
    return slopes, radii


def polynomials(discs: Discs, i: int) -> list[Any]:
    """The four polynomials of a disc, exactly."""
    return [arb_poly([float(x) for x in column]) for column in discs.series[:, i].T]


def end_states(discs: Discs) -> list[tuple[list[Any], list[Any]]]:
    """P(1) and P(-1) of each disc, as balls."""
    rows = [polynomials(discs, i) for i in range(len(discs.half))]
    return [([p(arb(1)) for p in row], [p(arb(-1)) for p in row]) for row in rows]


def enclose(
    pendulum: Coefficients, discs: Discs, tube: Any, time_radius: float, known: Any, terms: int
) -> Tubes:
    """Bounds all solutions within the tubes, see the five steps above.

    To be called inside `balls.precision(bits, terms)`.

    Arguments:
        tube: eps of each disc, shape (S,).
        time_radius: how far the duration may be from `discs.duration`.
        known: how far the parts of the states that the problem fixes are from P(0), shape (S, 4).
        terms: K, the number of terms of the series of f and J.
    Raises:
        ArithmeticError: no bound is found; the tubes are too wide, or the discs too long.
    """
    if not ((discs.half > 0).all() and discs.duration > 0):
        # Gronwall's bound below is one for steps that are positive.
        raise ArithmeticError("the discs do not lie in order")
    found = []
    for i, half in enumerate(discs.half):
        step = arb(discs.duration) * arb(float(half))
        found.append(_disc_bounds(pendulum, discs.series[:, i], step, float(tube[i]), terms))
    bounds = _Disc(
        np.stack([x.defect for x in found]),
        np.stack([x.middle for x in found], 1),
        np.stack([x.spread for x in found], 1),
        np.stack([x.tail for x in found]),
    )
    with np.errstate(all="ignore"):
        growth, errors = _tangent_errors(discs, bounds, time_radius / discs.duration * COVER)
        signs = discs.signs()[:, None, None, None]
        sizes = np.abs(discs.tangents).sum(0)
        # W(+-1) is a float64 sum of N + 1 terms.
        spread = (errors * growth[:, None])[:, None, :] + sizes * gamma(len(signs) + 2)
        defect = (bounds.defect + known) * COVER
        excursion = np.abs(discs.series[1:]).sum(0).max(-1) + defect.max(-1)
    slopes, slope_spread = _end_slopes(pendulum, discs, tube)
    tubes = Tubes(
        growth,
        defect,
        discs.tangents.sum(0),
        (discs.tangents * signs).sum(0),
        spread * COVER + TINY,
        slopes,
        slope_spread,
        excursion * COVER,
    )
    if not all(np.isfinite(part).all() for part in tubes):
        raise ArithmeticError("a bound is not finite")
    return tubes
