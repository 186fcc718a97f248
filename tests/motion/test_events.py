"""Crossings against closed forms, another integrator, and the method's own order."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ellipk

import dpend
from dpend import Pendulum, Scheme


def lower(pendulum, state):
    return state.theta1


def both(pendulum, state):
    return state.theta1, state.theta2


@pytest.mark.parametrize("name", [pytest.param("rk8", marks=pytest.mark.slow), "rk8-circle-rescaled"])
def test_a_simple_pendulum_passes_the_bottom_at_a_quarter_of_its_period(name):
    """m2 -> 0: 4 K(sin^2(a/2)) sqrt(l/g) is the period."""
    pendulum = Pendulum(1.0, 0.7, 1.0, 1e-9, 1.0)
    crossing = dpend.first_crossing(lower, pendulum, dpend.released(2.0, 0.3), 5.0, Scheme(name, 1e-2))
    assert abs(crossing.time - ellipk(math.sin(1.0) ** 2)) < 1e-8
    assert abs(crossing.state.theta1) < 1e-12
    assert crossing.which == 0


@pytest.mark.slow
def test_the_crossing_is_exact_to_the_method(paper):
    """The error in time falls with the method's order; an interpolant would end it at its own."""
    start = dpend.released(1.2, 0.4)
    exact = dpend.first_crossing(lower, paper, start, 0.6, Scheme("rk8", 5e-4)).time
    steps = np.array([3e-3, 4.5e-3, 6e-3])
    errors = [abs(dpend.first_crossing(lower, paper, start, 0.6, Scheme("rk4", h)).time - exact) for h in steps]
    assert abs(np.polyfit(np.log(steps), np.log(errors), 1)[0] - 4) < 0.5


@pytest.mark.slow
def test_the_first_of_two_and_its_direction(paper):
    start, scheme = dpend.released(1.2, -0.4), Scheme("rk8", 4e-3)
    earliest = dpend.first_crossing(both, paper, start, 2.0, scheme)
    alone = dpend.first_crossing(lower, paper, start, 2.0, scheme)
    assert earliest.which == 1
    assert earliest.time < alone.time
    rising = dpend.first_crossing(lower, paper, start, 2.0, scheme, direction=1)
    falling = dpend.first_crossing(lower, paper, start, 2.0, scheme, direction=-1)
    assert falling.time == alone.time < rising.time
    motion = dpend.reference(paper, start, [float(rising.time)])
    assert abs(motion.state.theta1[-1]) < 1e-9
    assert dpend.vector_field(paper, rising.state).theta1 > 0


def test_backwards_and_never(paper):
    scheme = Scheme("rk8", 4e-3)
    start = dpend.flow(paper, dpend.released(0.5, 0.2), 0.1, scheme)
    there = dpend.first_crossing(lower, paper, start, -1.0, scheme)
    assert there.time < 0
    assert abs(dpend.flow(paper, start, float(there.time), scheme).theta1) < 1e-10
    never = dpend.first_crossing(lower, paper, dpend.released(0.5, 0.2), 0.05, scheme)
    assert never.time == jnp.inf
    assert never.which == -1


def test_direction_is_checked(paper):
    with pytest.raises(ValueError, match="direction must be -1, 0 or 1, got 2"):
        dpend.first_crossing(lower, paper, dpend.released(0.5, 0.2), 1.0, Scheme("rk8", 1e-2), direction=2)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rk8-circle-rescaled", "rk4"])
def test_what_does_not_count_is_passed_by(paper, name):
    """In one step a falling function, which does not count, and a rising one: over many releases, always the latter."""
    release = jnp.linspace(0.9, 1.1, 101)
    scheme = Scheme(name, 0.02 if name != "rk4" else 5e-3)

    def find(functions, direction):
        def one(angle):
            start = dpend.released(angle, angle)
            return dpend.first_crossing(functions, paper, start, 0.5, scheme, direction=direction)

        return jax.vmap(one)(release)

    def two(pendulum, state):
        return state.theta1 - 0.5, 0.49 - state.theta1

    def touching(pendulum, state):
        return (state.theta1 - 0.5) ** 2, state.theta1 - 0.49

    alone = find(lambda pendulum, state: 0.49 - state.theta1, 1)
    for functions, direction in ((two, 1), (touching, 0)):
        found = find(functions, direction)
        np.testing.assert_array_equal(found.which, 1)
        np.testing.assert_allclose(found.time, alone.time, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_tiny_values_cross_where_they_cross(paper):
    """The product of two values below 1e-162 is zero, and no change of sign."""
    found = dpend.first_crossing(
        lambda pendulum, state: 1e-170 * state.theta1, paper, dpend.released(0.5, 0.5), 1.0, Scheme("rk8-circle", 0.02)
    )
    plain = dpend.first_crossing(lower, paper, dpend.released(0.5, 0.5), 1.0, Scheme("rk8-circle", 0.02))
    assert abs(found.time - plain.time) < 1e-12


FORTY = math.radians(40.0)


def turn_of(pendulum, start, scheme):
    """Where theta1 turns back first, and when."""
    crossing = dpend.first_crossing(rate1, pendulum, start, 1.0, scheme)
    return float(crossing.state.theta1), float(crossing.time)


def rate1(pendulum, state):
    return dpend.velocities(pendulum, state)[0]


@pytest.mark.parametrize(
    "name",
    [
        "rk8-circle",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("rk4", "rk8", "rk8-circle-rescaled", "gauss")),
    ],
)
def test_two_crossings_about_a_turn_inside_one_step(paper, name):
    """Of theta1 = lowest + d, whose two crossings lie sqrt(2 d/acceleration) before and behind the turn: both are roots
    to the last digits, in order, also in directions, and with nothing between them and the next swing.
    """
    scheme, start = Scheme(name, 1e-3 if name == "rk4" else 4e-3), dpend.released(FORTY, 0.85)
    lowest, turn = turn_of(paper, start, scheme)
    swing = dpend.first_crossing(rate1, paper, start, 1.0, scheme).state
    bend = float(jax.jvp(lambda x: rate1(paper, x), (swing,), (dpend.vector_field(paper, swing),))[1])

    @partial(jax.jit, static_argnames="direction")
    def find(start, level, direction=0):
        return dpend.first_crossing(lambda p, s: s.theta1 - level, paper, start, 0.9, scheme, direction=direction)

    for depth in (1e-5, 1e-7, 1e-9):
        level, apart = lowest + depth, math.sqrt(2 * depth / bend)
        first = find(start, level)
        assert abs(first.time - (turn - apart)) < 0.02 * apart
        second = find(first.state, level)
        assert abs(first.time + second.time - (turn + apart)) < 0.02 * apart
        assert max(abs(first.state.theta1 - level), abs(second.state.theta1 - level)) < 4e-16
        assert abs(find(start, level, -1).time - first.time) < 1e-12
        assert abs(find(start, level, 1).time - first.time - second.time) < 1e-6 * apart
        third = find(second.state, level)
        assert third.time > 0.3
    assert find(start, lowest - 1e-9).time == jnp.inf
