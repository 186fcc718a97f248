"""Sine and cosine together, in arithmetic that vectorises.

XLA's own float64 `sin` and `cos` call a scalar routine for every element on a CPU; this form is a
few dozen fused multiply-adds in the lane's own registers, and the pair costs one argument
reduction.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from dpend._runtime import require_float64

# pi/2 in four pieces (Cody and Waite's reduction): the first three have 30 bits, so n times each is
# exact for n < 2^23; the fourth is the rest rounded to 53 bits, and what it leaves out is below
# 2^-145 n. Three pieces in all would leave thirteen units in the last place at the double nearest
# to -60130 pi/2.
_PI_2 = (
    float.fromhex("0x1.921fb54p+0"),
    float.fromhex("0x1.10b46118p-30"),
    float.fromhex("0x1.313198ap-61"),
)
_PI_2_REST = float.fromhex("0x1.701b839a25205p-92")
_TWO_OVER_PI = float.fromhex("0x1.45f306dc9c883p-1")
# Beyond n = 2^23 quarter turns the products are rounded and digits would be wrong: NaN instead.
LARGEST_ANGLE = 2.0**23 * 1.57079632679489661923

# Minimax polynomials on [-pi/4, pi/4] from fdlibm's k_sin.c and k_cos.c (Sun Microsystems, 1993),
# errors below 2^-58: sin r = r + r^3 S(r^2), cos r = 1 - r^2/2 + r^4 C(r^2); highest power first.
_SIN = (
    1.58969099521155010221e-10,
    -2.50507602534068634195e-08,
    2.75573137070700676789e-06,
    -1.98412698298579493134e-04,
    8.33333333332248946124e-03,
    -1.66666666666666324348e-01,
)
_COS = (
    -1.13596475577881948265e-11,
    2.08757232129817482790e-09,
    -2.75573143513906633035e-07,
    2.48015872894767294178e-05,
    -1.38888888888741095749e-03,
    4.16666666666666019037e-02,
)


def _polynomial(coefficients: tuple[float, ...], z: Array) -> Array:
    value = jnp.full_like(z, coefficients[0])
    for coefficient in coefficients[1:]:
        value = value * z + coefficient
    return value


def sincos(x: ArrayLike) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
    """sin x and cos x.

    The error stays below 1.6 units in the last place wherever |x| is below 2^23 pi/2 = 1.3e7, near
    multiples of pi/2 too; NaN beyond, and at infinities. Derivatives of all orders are exact: d sin
    x = cos x dx, d cos x = -sin x dx.

    Arguments:
        x: angles [rad], any shape; converted to float64.
    Returns:
        The sines and the cosines, of the shape of `x`.
    Raises:
        RuntimeError: float64 is switched off in JAX.
    """
    require_float64()
    return _sincos(jnp.asarray(x, jnp.float64))


@jax.custom_jvp
@jax.jit
def _sincos(x: Float[Array, "*shape"]) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
    turns = lax.round(x * _TWO_OVER_PI, lax.RoundingMethod.TO_NEAREST_EVEN)
    high, middle, low = (turns * piece for piece in _PI_2)  # exact products
    rough = (x - high) - middle
    r = rough - low
    # What the last subtraction rounded away, exactly (Dekker's fast two-sum), less what three
    # pieces leave out. It joins the small term of the sine, so that only one rounding of the
    # argument reaches the result.
    correction = ((rough - r) - low) - turns * _PI_2_REST
    z = r * r
    sin_r = r + (r * z * _polynomial(_SIN, z) + correction)
    cos_r = 1.0 - (0.5 * z - z * z * _polynomial(_COS, z))
    quadrant = turns.astype(jnp.int32)
    odd = (quadrant & 1) == 1
    sine = jnp.where(odd, cos_r, sin_r)
    cosine = jnp.where(odd, sin_r, cos_r)
    sine = jnp.where((quadrant & 2) == 2, -sine, sine)
    cosine = jnp.where(((quadrant + 1) & 2) == 2, -cosine, cosine)
    reducible = jnp.abs(x) <= LARGEST_ANGLE
    return jnp.where(reducible, sine, jnp.nan), jnp.where(reducible, cosine, jnp.nan)


@_sincos.defjvp
def _sincos_jvp(
    primals: tuple[Array], tangents: tuple[Array]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    (x,), (dx,) = primals, tangents
    sine, cosine = _sincos(x)
    return (sine, cosine), (cosine * dx, -sine * dx)


# Angles within this many radians stay as they are: their last place is finer than what a motion
# rounds anyway.
_FAR = 100.0


def unwound(angle: Float[Array, "*shape"]) -> tuple[Float[Array, "*shape"], tuple[Array, Array]]:
    """An angle without its full turns if it is far from zero, and the turns [rad] as two numbers
    for `wound`.

    The digits of what is left are all there are: sums of small steps round as sums of small numbers
    do.
    """
    turns = lax.round(angle * (0.25 * _TWO_OVER_PI), lax.RoundingMethod.TO_NEAREST_EVEN)
    size = lax.stop_gradient(jnp.abs(angle))
    quarters = jnp.where(
        (size > _FAR) & (size <= LARGEST_ANGLE), lax.stop_gradient(4.0 * turns), 0.0
    )
    high, middle, low = (quarters * piece for piece in _PI_2)
    rest = middle + low
    return (angle - high) - rest, (high, rest)


def wound(angle: Float[Array, "*shape"], turns: tuple[Array, Array]) -> Float[Array, "*shape"]:
    """The angle with its turns again, rounded once."""
    high, rest = turns
    return (angle + rest) + high
