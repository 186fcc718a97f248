"""sincos against mpmath, and its derivatives against the only ones there are."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from dpend.mechanics import trig

SINCOS = jax.jit(trig.sincos)


def errors(x: np.ndarray) -> np.ndarray:
    """Errors of both functions in units in the last place, the worse of the two for each angle."""
    computed = np.array(SINCOS(x))
    with mpmath.workdps(50):
        worst = []
        for angle, sine, cosine in zip(x, *computed, strict=True):
            exact = mpmath.sin(mpmath.mpf(angle)), mpmath.cos(mpmath.mpf(angle))
            ulps = [
                abs(mpmath.mpf(got) - want) / float(np.spacing(abs(float(want))))
                for got, want in zip((sine, cosine), exact, strict=True)
            ]
            worst.append(float(max(ulps)))
    return np.array(worst)


@pytest.mark.parametrize("reach", [1.0, 10.0, 1e5, 1e7])
def test_error_below_two_ulp(reach):
    x = np.random.default_rng(1).uniform(-reach, reach, 3000)
    assert errors(x).max() < 2.0


def test_error_below_two_ulp_near_multiples_of_half_pi():
    rng = np.random.default_rng(2)
    nearest = rng.integers(-63661, 63661, 800) * (np.pi / 2)
    nearest = np.append(
        nearest, -60130 * (np.pi / 2)
    )  # where three pieces of pi/2 leave thirteen units
    x = np.concatenate(
        [nearest, np.nextafter(nearest, np.inf), nearest + rng.normal(size=nearest.size) * 1e-9]
    )
    assert errors(x).max() < 2.0


def test_absolute_error_up_to_1e7():
    x = np.random.default_rng(3).uniform(-1e7, 1e7, 200_000)
    sine, cosine = (np.array(value) for value in SINCOS(x))
    wide = x.astype(np.longdouble)
    worst = np.maximum(abs(sine - np.sin(wide)), abs(cosine - np.cos(wide))) / np.abs(x)
    assert worst.max() < 4e-16


def test_nan_beyond_what_can_be_reduced():
    beyond = np.array(
        [np.nextafter(trig.LARGEST_ANGLE, np.inf), -2e7, 1e300, np.inf, -np.inf, np.nan]
    )
    assert np.isnan(np.array(SINCOS(beyond))).all()
    assert errors(np.array([trig.LARGEST_ANGLE, -trig.LARGEST_ANGLE])).max() < 2.0


@pytest.mark.slow
def test_derivatives_of_all_orders():
    def both(x):
        return jnp.stack(trig.sincos(x))

    x = 0.7
    expected = [
        (np.sin(x), np.cos(x)),
        (np.cos(x), -np.sin(x)),
        (-np.sin(x), -np.cos(x)),
        (-np.cos(x), np.sin(x)),
    ]
    derivative = both
    for order in range(5):
        np.testing.assert_allclose(derivative(x), expected[order % 4], rtol=4e-16)
        derivative = jax.jacfwd(derivative)
    np.testing.assert_allclose(jax.jacrev(jax.jacrev(both))(x), expected[2], rtol=4e-16)


def test_agrees_inside_any_compilation():
    x = np.linspace(-20.0, 20.0, 1001)
    np.testing.assert_allclose(
        SINCOS(x), jax.vmap(trig.sincos)(jnp.asarray(x)), rtol=0, atol=2.3e-16
    )
