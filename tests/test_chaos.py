"""Exponents that are known, laws that all spectra keep, and tangents that leave the motion
alone.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpend
from dpend import Scheme, chaos
from dpend.mechanics.linear import equilibria

FAST = Scheme("rk8-circle-rescaled", 0.2)


def test_an_equilibrium_has_its_linear_exponent(unit):
    """At the upright state the flow is linear: the largest exponent of the two pairs."""
    largest = float(np.max(np.real(equilibria(unit).exponents[3])))
    # The state itself stays for some 20/s before rounding lets it fall.
    found = chaos.lyapunov(
        unit, dpend.released(math.pi, math.pi), Scheme("rk8", 1e-2), duration=12.0
    )
    again = chaos.lyapunov(
        unit, dpend.released(math.pi, math.pi), Scheme("rk8", 1e-2), duration=8.0
    )
    assert abs((12 * found["lyapunov"] - 8 * again["lyapunov"]) / 4 - largest) < 1e-4


def test_small_swings_are_a_linear_system(unit):
    """No growth beyond a constant: the exponent falls like 1/T, below 2 ln(T)/T."""
    for amplitude in (1e-6, 0.3):
        found = chaos.lyapunov(
            unit, dpend.released(amplitude, 0.4 * amplitude), FAST, duration=500.0
        )
        assert abs(found["lyapunov"]) < 2 * math.log(500) / 500


def test_the_spectrum_is_plus_zero_zero_minus(unit):
    found = chaos.spectrum(unit, dpend.released(2.9, 2.8), FAST, duration=200.0)
    exponents = np.array([found[f"exponent{i}"] for i in range(1, 5)])
    assert abs(exponents.sum()) < 1e-8
    assert exponents[0] > 0.3
    np.testing.assert_allclose(exponents[0], -exponents[3], atol=2 * math.log(200) / 200)
    assert np.all(np.abs(exponents[1:3]) < 2 * math.log(200) / 200)


@pytest.mark.slow
def test_one_tangent_and_four_agree(unit):
    """The first exponent of the spectrum is that of any tangent, up to a constant over the time."""
    start = dpend.released(2.9, 2.8)
    one = chaos.lyapunov(unit, start, Scheme("rk8", 2e-2), duration=30.0)["lyapunov"]
    four = chaos.spectrum(unit, start, Scheme("rk8", 2e-2), duration=30.0)["exponent1"]
    assert abs(one - four) < 3 / 30


@pytest.mark.slow
def test_megno_tells_order_from_chaos(unit):
    regular = chaos.megno(unit, dpend.released(1.2, 1.3), FAST, duration=5000.0)["megno"]
    assert abs(regular - 2) < 0.2
    chaotic = dpend.released(2.9, 2.8)
    found = chaos.maximal_lyapunov(unit, chaotic, FAST, duration=1000.0)
    assert (
        abs(
            chaos.megno(unit, chaotic, FAST, duration=1000.0)["megno"] / (500 * found["exponent"])
            - 1
        )
        < 0.2
    )
    longer = chaos.maximal_lyapunov(unit, chaotic, FAST, duration=1000.0, windows=40)
    # Other windows cut other steps, and what is chaotic is then another motion: two independent
    # estimates.
    assert abs(longer["exponent"] - found["exponent"]) < 2 * (
        found["uncertainty"] + longer["uncertainty"]
    )


@pytest.mark.parametrize(
    "name", ["rk4", pytest.param("rk4-circle", marks=pytest.mark.slow), "rk8-circle-rescaled"]
)
def test_tangents_leave_the_motion_alone_and_are_derivatives(paper, name):
    scheme, start = Scheme(name, 1e-3), dpend.released(2.5, -1.0)

    def last(carry, time, dt, state, tangent):
        return state, tangent

    tangent = dpend.State(1.0, 0.5, 0.01, -0.02)
    state, moved = dpend.fold(last, start, paper, start, 0.7, scheme, tangents=tangent)
    alone = dpend.flow(paper, start, 0.7, scheme)
    np.testing.assert_allclose(jax.tree.leaves(state), jax.tree.leaves(alone), rtol=0, atol=1e-13)
    nudge = 1e-6

    def nudged(sign):
        shifted = jax.tree.map(lambda x, d: x + sign * nudge * d, start, tangent)
        return dpend.flow(paper, shifted, 0.7, Scheme("rk8", 2e-3))

    difference = jax.tree.map(lambda a, b: (a - b) / (2 * nudge), nudged(1), nudged(-1))
    np.testing.assert_allclose(jax.tree.leaves(moved), jax.tree.leaves(difference), rtol=3e-6)


def test_flip_times(paper):
    """Against the crossing of theta2 = pi found by hand on diffrax's solution; none below the
    saddle.
    """
    found = chaos.flip(paper, dpend.released(2.0, 2.6), Scheme("rk8", 2e-3), duration=2.0)
    motion = dpend.reference(paper, dpend.released(2.0, 2.6), [float(found["flip_time"])])
    angle = motion.state.theta1[-1] if found["bob"] == 1 else motion.state.theta2[-1]
    assert abs(abs(angle) - math.pi) < 1e-8
    calm = chaos.flip(paper, dpend.released(1.0, 1.0), Scheme("rk8", 2e-3), duration=2.0)
    assert calm["flip_time"] == jnp.inf
    assert calm["bob"] == 0
    above = chaos.flip(paper, dpend.released(math.pi, 0.3), Scheme("rk8", 2e-3), duration=2.0)
    assert above["flip_time"] > 0.1  # where it starts does not count


def test_drift_is_that_of_the_saved_motion(paper):
    start, scheme = dpend.released(2.5, -1.0), Scheme("rk4", 1e-2)
    motion = dpend.simulate(paper, start, 2.0, step=1e-2, method="rk4", error=False)
    assert (
        abs(
            chaos.drift(paper, start, scheme, duration=2.0)["energy_drift"] / motion.energy_drift
            - 1
        )
        < 1e-6
    )


def test_windows_are_checked(paper):
    with pytest.raises(ValueError, match="windows must be an even number of at least 4, got 5"):
        chaos.maximal_lyapunov(paper, dpend.released(1.0, 1.0), FAST, duration=1.0, windows=5)
