"""Taylor series of the motion in float64, and where the discs of a proof are to lie.

Everything here is a proposal. A proof takes the numbers as they are and bounds their defects, so
that an error here can spoil a proof, and cannot make a false one.
"""

from typing import Any

import numpy as np

from dpend.proofs.balls import Ratios

# Order of the series that the mesh is measured with; its radius of convergence is the least over
# the last terms. 24 was the order from which the number of discs did not change any more.
DENSE_ORDER = 24
LAST_TERMS = 5
# Share of the radius of convergence that a step of the rough march goes, and its output points.
MARCH, POINTS = 0.2, 8
# Arcs with more output points are refused: the longest of the atlas have 400, and 93 discs.
MOST_POINTS = 10_000
# Radii that are tried for Cauchy's bounds: 0.95 of the radius of convergence, 24 times shorter by
# 0.88. Finer ladders saved no disc on the atlas.
LADDER = 0.95 * 0.88 ** np.arange(24)
# A bound above this is worth nothing; a divisor below this is as good as zero.
LARGEST_BOUND, LEAST_DIVISOR = 1e8, 0.02
# How many digits of centres and edges count: fractions of the arc are multiples of this.
GRAIN = 2.0**-40


def product(x: Any, y: Any) -> Any:
    """The product of two series, cut at their common order; the terms are along the first axis."""
    out = np.zeros(np.broadcast_shapes(x.shape, y.shape))
    for j in range(len(x)):
        out[j:] += x[j] * y[: len(x) - j]
    return out


def _sin_cos(x: Any) -> tuple[Any, Any]:
    s, c = np.zeros_like(x), np.zeros_like(x)
    s[0], c[0] = np.sin(x[0]), np.cos(x[0])
    for n in range(1, len(x)):
        slope = np.arange(1, n + 1)[:, None] * x[1 : n + 1] / n
        s[n], c[n] = (slope * c[n - 1 :: -1]).sum(0), -(slope * s[n - 1 :: -1]).sum(0)
    return s, c


def _reciprocal(x: Any) -> Any:
    out = np.zeros_like(x)
    out[0] = 1 / x[0]
    for n in range(1, len(x)):
        out[n] = -(x[1 : n + 1] * out[n - 1 :: -1]).sum(0) * out[0]
    return out


def _at(x: Any, y: Any, n: int) -> Any:
    """Term n of a product."""
    return np.einsum("js,js->s", x[: n + 1], y[n::-1])


def motion_series(ratios: Ratios, start: Any, step: Any, order: int) -> Any:
    """Taylor coefficients of the state in s = t/step, shape (order + 1, S, 4)."""
    mu, inverse, k, nu, weight = ratios
    x = np.zeros((order + 1, len(start), 4))
    x[0] = start
    sin1, cos1, sin2, cos2, s, c, below, share, up, vp, u, v, uv = np.zeros((13, *x.shape[:2]))
    turns = (sin1, cos1), (sin2, cos2), (s, c)
    a, b, p, q = (x[..., j] for j in range(4))
    angles = np.zeros((3, *x.shape[:2]))
    for n in range(order):
        angles[:, n] = a[n], b[n], a[n] - b[n]
        for (sine, cosine), angle in zip(turns, angles, strict=True):
            if n == 0:
                sine[0], cosine[0] = np.sin(angle[0]), np.cos(angle[0])
                continue
            slope = np.arange(1, n + 1)[:, None] * angle[1 : n + 1] / n
            sine[n] = np.einsum("js,js->s", slope, cosine[n - 1 :: -1])
            cosine[n] = -np.einsum("js,js->s", slope, sine[n - 1 :: -1])
        below[n] = mu * _at(s, s, n) + (n == 0)
        rest = np.einsum("js,js->s", below[1 : n + 1], share[n - 1 :: -1]) if n else -1.0
        share[n] = -rest / below[0]
        up[n] = p[n] - inverse * _at(q, c, n)
        vp[n] = k * q[n] - inverse * _at(p, c, n)
        u[n], v[n] = _at(up, share, n), _at(vp, share, n)
        uv[n] = _at(u, v, n)
        pull = nu * _at(uv, s, n)
        slopes = u[n], v[n], -pull - weight * sin1[n], pull - nu * sin2[n]
        x[n + 1] = np.stack(slopes, -1) * (step / (n + 1))[:, None]
    return x


def jacobian_series(ratios: Ratios, x: Any) -> Any:
    """The series of the field's Jacobian along a series of states, shape (order + 1, S, 4, 4)."""
    mu, inverse, k, nu, weight = ratios
    a, b, p, q = (x[..., j] for j in range(4))
    s, c = _sin_cos(a - b)
    cos1, cos2 = _sin_cos(a)[1], _sin_cos(b)[1]
    below = mu * product(s, s)
    below[0] += 1
    share = _reciprocal(below)
    u = product(p - inverse * product(q, c), share)
    v = product(k * q - inverse * product(p, c), share)
    by_a, cross = product(s, share), -inverse * product(c, share)
    u_a = product(by_a, inverse * q - 2 * mu * product(c, u))
    v_a = product(by_a, inverse * p - 2 * mu * product(c, v))
    moving = product(product(u_a, v) + product(v_a, u), s) + product(product(u, v), c)
    pull_a = -nu * moving
    rows = [
        [u_a, -u_a, share, cross],
        [v_a, -v_a, cross, k * share],
        [pull_a - weight * cos1, -pull_a, -u_a, -v_a],
        [-pull_a, pull_a - nu * cos2, u_a, v_a],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def tangent_series(jacobian: Any, step: Any) -> Any:
    """The series of the derivative with respect to the state at s = 0, from the Jacobian's."""
    w = np.zeros_like(jacobian)
    w[0] = np.eye(4)
    for n in range(len(w) - 1):
        slope = np.einsum("jsab,jsbc->sac", jacobian[: n + 1], w[n::-1])
        w[n + 1] = slope * (step / (n + 1))[:, None, None]
    return w


def value(x: Any, s: Any) -> Any:
    """A series at s, by Horner's rule."""
    out = x[-1]
    for row in x[-2::-1]:
        out = out * s + row
    return out


def _convergence(x: Any) -> Any:
    """The radius of convergence, as the last terms tell it."""
    sizes = np.maximum(np.abs(x[-LAST_TERMS:]).max(-1), 1e-300)
    powers = np.arange(len(x) - LAST_TERMS, len(x))[:, None]
    return (sizes ** (-1.0 / powers)).min(0)


def _dense(ratios: Ratios, start: Any, duration: float) -> tuple[Any, Any]:
    """Times and states along the arc, about forty to a radius of convergence."""
    times: list[float] = []
    states: list[Any] = []
    t, x = 0.0, np.asarray(start, float)
    while True:
        series = motion_series(ratios, x[None], np.ones(1), DENSE_ORDER)[:, 0]
        step = min(MARCH * float(_convergence(series[:, None])[0]), duration - t)
        if not step > 0 or len(times) > MOST_POINTS:
            raise ArithmeticError("the motion cannot be followed, or is too long")
        for j in range(POINTS):
            times.append(t + step * j / POINTS)
            states.append(value(series, step * j / POINTS))
        x, t = value(series, step), t + step
        if duration - t < 1e-14 * duration:
            break
    return np.array([*times, duration]), np.array([*states, x])


def _reaches(ratios: Ratios, states: Any, series: Any, order: int, wish: tuple[int, float]) -> Any:
    """How far a disc about each state may go until its tail is above the wished tolerance.

    Arguments:
        wish: the number of terms of the Jacobian's series, and the tolerance.
    """
    terms, tolerance = wish
    powers = np.arange(1, DENSE_ORDER + 1)[:, None, None]
    whole = _convergence(series)
    sizes = np.abs(series[1:])
    delta = states[:, 0] - states[:, 1]
    s, c = np.abs(np.sin(delta)), np.abs(np.cos(delta))
    best = np.zeros(len(states))
    for share in LADDER:
        radius = share * whole
        r = (sizes * radius[None, :, None] ** powers).sum(0)
        turn = np.minimum(r[:, 0] + r[:, 1], 50)
        high, low = np.cosh(turn), np.sinh(turn)
        ds = c * low + s * (high - 1)
        below = 1 + ratios.mu * (s**2 - 1.3 * (2 * s * ds + ds**2))
        with np.errstate(all="ignore"):
            inverse = np.where(below > LEAST_DIVISOR, 1 / below, np.inf)
            speed = np.abs(states[:, 2:]).max(-1) + r[:, 2:].max(-1)
            bound = (4 * speed * high * inverse) ** 2 * high * np.maximum(inverse, 1) * 4
            bound = bound + 10 * np.exp(np.minimum(r[:, :2].max(-1), 50))
            good = bound < LARGEST_BOUND
            reach = radius * (tolerance / np.where(good, bound, 1)) ** (1.0 / terms)
        best = np.maximum(best, np.where(good, reach, 0))
    return np.minimum(best, whole * tolerance ** (1.0 / (order + 1)))


def _edges(times: Any, reaches: Any, duration: float) -> list[float]:
    """Where neighbouring discs meet: the first begins at its centre, the last ends at its."""

    def at(t: float) -> float:
        return float(np.interp(t, times, reaches))

    edges = [min(at(0.0), duration / 2)]
    while True:
        t, h = edges[-1], at(edges[-1])
        for _ in range(8):
            h = min(h, at(t + h), at(t + h / 2), at(t + 2 * h))
        if not h > 0:
            raise ArithmeticError("no disc is short enough")
        if t + 2 * h >= duration:
            break
        edges.append(t + 2 * h)
    last = at(duration)
    if duration - edges[-1] > last:
        end = duration - 0.9 * last
        if end - edges[-1] > 2 * h:
            edges.append((edges[-1] + end) / 2)
        edges.append(end)
    return edges


def mesh(
    ratios: Ratios, start: Any, duration: float, order: int, wish: tuple[int, float]
) -> tuple[Any, Any]:
    """Edges of the discs as fractions of the arc, and the states at their centres.

    Raises:
        ArithmeticError: the motion cannot be followed.
    """
    times, states = _dense(ratios, start, duration)
    series = motion_series(ratios, states, np.ones(len(states)), DENSE_ORDER)
    reaches = _reaches(ratios, states, series, order, wish)
    if not np.isfinite(states).all() or not (reaches > 0).all():
        raise ArithmeticError("the motion cannot be followed")
    edges = np.round(np.array(_edges(times, reaches, duration)) / duration / GRAIN) * GRAIN
    centres = np.concatenate([[0.0], (edges[1:] + edges[:-1]) / 2, [1.0]]) * duration
    nearest = np.abs(times[:, None] - centres).argmin(0)
    offsets = (centres - times[nearest])[:, None]
    return edges, value(series[:, nearest], offsets)
