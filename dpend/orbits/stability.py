"""Floquet stability of a symmetric periodic orbit from a half or a quarter of its period.

A state is (theta, p); Phi(t) = [[A, B], [C, D]] is the derivative of the flow over t. The four
multipliers are 1, 1 and a pair whose half sum is kappa: elliptic for |kappa| < 1, hyperbolic above
1, inverse hyperbolic below -1. Stability is read from kappa alone: the trivial pair is a Jordan
block, which splits like the square root of the error.

Time reversal R (theta, p) -> (theta, -p) and reflection (theta, p) -> (-theta, -p) do the rest:

- brake orbit, at rest at 0 and T/2: monodromy R Phi^-1 R Phi with Phi = Phi(T/2), hence
  kappa = 1 + 2 tr(B^T C); of a passing orbit, theta in {0, pi}^2 at 0 and T/2, with N = -R in the
  place of R, which is the same;
- x(T/2) = -x(0): monodromy Phi(T/2)^2; with c = (tr(-Phi(T/2)) - 2)/2, kappa = 2 c^2 - 1 >= -1, so
  that such orbits never double their period (Frauenfelder and Moreno, arXiv:2301.01803);
- centred (also theta(T/4) in {0, pi}^2): Phi(T/2) = N Q^-1 N Q with Q = Phi(T/4) = [[a, b], [c',
  d]], N = -R, and c = 1 - 2 tr(a^T d).
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float

from dpend.checks import Scalar, known_number, known_real, known_value, real, single
from dpend.mechanics.pendulum import Pendulum, State, check_motion
from dpend.methods.runge_kutta import Point
from dpend.methods.scheme import Scheme, check_scheme
from dpend.motion.integrate import march, step_size

# Orbits with x(T/2) = -x(0) up to full turns: their monodromy is a square, and c tells more.
OPPOSITE = ("centred", "odd")


def transition(
    pendulum: Pendulum, state: State, dt: Scalar, steps: Scalar, scheme: Scheme
) -> tuple[State, Float[Array, "4 4 ..."]]:
    """The state after `steps` steps of `dt` [s] and the derivative of that map,
    Phi[i, j] = d x_i / d x_j(0).

    Rows and columns are in the order theta1, theta2, p1, p2 and in SI units; of a state with leaves
    of some shape that shape follows them.
    """
    constants = scheme.constants(pendulum, dt)
    shape = jnp.shape(state.theta1)
    unit = jnp.broadcast_to(jnp.eye(4).reshape(4, 4, *(1 for _ in shape)), (4, 4, *shape))

    def step(pair: tuple[Point, State], time: Scalar, dt: Scalar) -> tuple[Point, State]:
        return scheme.move_tangents(constants, *pair)

    end, tangents = march(step, (scheme.enter(pendulum, state), State(*unit)), dt, steps)
    return scheme.leave(constants, end), jnp.stack(jax.tree.leaves(tangents))


def monodromy(
    pendulum: Pendulum | Any, state: State | Any, period: float | Any, scheme: Scheme | Any
) -> Float[Array, "4 4"]:
    """The derivative of the flow over a whole period: needs no symmetry, and is noise once kappa
    exceeds 1e12.

    Arguments:
        period: the time [s], known before tracing.
    Raises:
        ValueError: the step is longer than the period; arguments of other classes, arrays, a traced
            period.
    """
    check_motion(pendulum, state)
    check_scheme(scheme)
    period = known_number("period", period, unit="s")
    steps = scheme.steps(period)
    return transition(pendulum, state, step_size(period, steps), steps, scheme)[1]


def stability_of(matrices: Any, symmetry: str, xp: Any = np) -> tuple[Any, Any, Any]:
    """c (NaN but for `OPPOSITE` orbits), kappa and log |kappa| from Phi over the shooting time,
    given as a product.

    With Phi = [[A, B], [C, D]] the product: kappa = 1 + 2 tr(B^T C) of brake orbits; of the others
    kappa = 2 c^2 - 1, with c = (tr(-Phi) - 2)/2 of odd ones and c = 1 - 2 tr(A^T D) of centred
    ones. The product is scaled as it grows: no kappa is too large for its logarithm.

    Arguments:
        matrices: of the consecutive segments of a quarter (centred), half (brake, odd, passing) or
            the whole (none) of the period, shape (..., S, 4, 4).
        symmetry: of `SYMMETRIES`.
        xp: numpy, or jax.numpy under differentiation.
    """
    product, scale = _product(matrices, xp)
    if symmetry in ("odd", "none"):
        sign = -0.5 if symmetry == "odd" else 0.5
        offset, trace = -1.0, sign * product.trace(axis1=-2, axis2=-1)
    elif symmetry == "centred":
        offset, trace, scale = (
            1.0,
            -2 * (product[..., :2, :2] * product[..., 2:, 2:]).sum(axis=(-2, -1)),
            2 * scale,
        )
    else:
        offset, trace, scale = (
            1.0,
            2 * (product[..., :2, 2:] * product[..., 2:, :2]).sum(axis=(-2, -1)),
            2 * scale,
        )
    value = offset + trace * xp.exp(xp.minimum(scale, _LARGEST_EXPONENT))
    beyond = scale > _MANY_DIGITS
    logarithm = xp.where(beyond, scale, 0.0) + _log_abs(xp.where(beyond, trace, value), xp)
    if symmetry not in OPPOSITE:
        return xp.full_like(value, xp.nan), value, logarithm
    kappa = 2 * xp.where(abs(value) < LARGEST_C, value, LARGEST_C) ** 2 - 1
    inner = logarithm > _MANY_DIGITS
    twice = math.log(2.0) + 2 * logarithm
    return value, kappa, xp.where(inner, twice, _log_abs(xp.where(inner, 1.0, kappa), xp))


def _product(matrices: Any, xp: Any) -> tuple[Any, Any]:
    """The product of consecutive matrices, its largest entry made 1, and the logarithm of what it
    was divided by.
    """
    product, scale = xp.eye(4), xp.zeros(matrices.shape[:-3])
    for i in range(matrices.shape[-3]):
        product = matrices[..., i, :, :] @ product
        size = (
            lax.stop_gradient(abs(product).max(axis=(-2, -1)))
            if xp is jnp
            else abs(product).max(axis=(-2, -1))
        )
        product, scale = product / size[..., None, None], scale + xp.log(size)
    return product, scale


def growth_of(matrices: np.ndarray, symmetry: str) -> np.ndarray:
    """What rounding is multiplied by in the c, or kappa of other than `OPPOSITE` orbits, that
    `stability_of` makes of Phi.

    Both are sums of products of entries of Phi, of `odd` and `none` orbits of entries, that may
    cancel. The blocks are measured so that the unit of momentum does not count.
    """
    product, scale = _product(matrices, np)
    blocks = product[..., :2, :2], product[..., 2:, 2:], product[..., :2, 2:], product[..., 2:, :2]
    a, d, b, c = (abs(block).max(axis=(-2, -1)) for block in blocks)
    logarithm = scale + np.log(np.maximum(np.maximum(a, d), np.sqrt(b * c)))
    factors = 1 if symmetry in ("odd", "none") else 2
    return np.asarray(np.exp(np.minimum(factors * logarithm, _LARGEST_EXPONENT)))


def _log_abs(value: Any, xp: Any) -> Any:
    zero = value == 0
    return xp.where(zero, -xp.inf, xp.log(abs(xp.where(zero, 1.0, value))))


# exp of the first is still finite; beyond exp of the second the 1 that is added does not show.
_LARGEST_EXPONENT, _MANY_DIGITS, LARGEST_C = 700.0, 20.0, 1e150


def multipliers(kappa: Scalar) -> Complex[Array, "4 ..."]:
    """The Floquet multipliers 1, 1, m, 1/m with m + 1/m = 2 kappa and |m| >= 1, NaN where kappa is.

    Raises:
        ValueError: kappa is neither a real number nor an array of them.
    """
    kappa = jnp.asarray(real("kappa", kappa), jnp.complex128)
    large = kappa + jnp.sqrt(kappa - 1) * jnp.sqrt(
        kappa + 1
    )  # the two principal roots never cancel against kappa
    one = jnp.ones_like(large)
    return jnp.stack([one, one, large, 1 / large])


def stability_class(kappa: float | Any) -> str:
    """`elliptic`, `hyperbolic`, `inverse hyperbolic`; `parabolic` at exactly +-1; `unknown` where
    kappa is NaN.

    Raises:
        ValueError: kappa is no single real number, or traced by `jit`.
    """
    single("kappa", real("kappa", kappa))
    known = known_value(kappa)
    kappa = known_real("kappa", kappa) if known is None else known
    if kappa != kappa:
        return "unknown"
    if abs(kappa) == 1:
        return "parabolic"
    if abs(kappa) < 1:
        return "elliptic"
    return "hyperbolic" if kappa > 1 else "inverse hyperbolic"
