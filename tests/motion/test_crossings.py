"""All crossings of a section, against another integrator, closed forms and each other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dpend
from dpend import Plane, Scheme

FINE = Scheme("rk8-circle-rescaled", 8e-3)


def lagrange(time, x, xp=np, pull=9.8 / 0.2):
    """theta1, theta2 and their rates of the paper's pendulum: Lagrange's equations, written out."""
    theta1, theta2, omega1, omega2 = x
    sine, cosine = xp.sin(theta1 - theta2), xp.cos(theta1 - theta2)
    first = -(omega2 * omega2) * sine - 2.0 * pull * xp.sin(theta1)
    second = omega1 * omega1 * sine - pull * xp.sin(theta2)
    determinant = 2.0 - cosine * cosine
    return [
        omega1,
        omega2,
        (first - cosine * second) / determinant,
        (2.0 * second - cosine * first) / determinant,
    ]


def hits_of(pendulum, start, duration):
    """Times and states at which DOP853 finds theta1 on a full turn."""
    x0 = np.array([start.theta1, start.theta2, *dpend.velocities(pendulum, start)], float)
    found = solve_ivp(
        lagrange, (0.0, duration), x0, "DOP853", rtol=3e-14, atol=1e-15,
        events=lambda time, x: np.sin(x[0] / 2),
    )  # fmt: skip
    return found.t_events[0], found.y_events[0]


def found_at(pendulum, start, count=12, direction=0):
    return dpend.crossings(Plane(), pendulum, start, count, FINE, direction=direction)


@pytest.mark.parametrize("angles", [(1.0, 0.3), (1.6, 1.2), (2.0, -0.5)])
def test_times_and_places_are_those_of_another_integrator(paper, angles):
    found = found_at(paper, dpend.released(*angles))
    times, states = hits_of(paper, dpend.released(*angles), float(found.time[-1]) + 1e-3)
    assert times.size == 12
    early = times < 3.2  # then chaos multiplies the errors of both by 1e5
    np.testing.assert_allclose(found.time[early], times[early], rtol=0, atol=1e-10)
    np.testing.assert_allclose(found.state.theta2[early], states[early, 1], rtol=0, atol=1e-10)
    np.testing.assert_allclose(np.sin(found.state.theta1 / 2), 0, rtol=0, atol=1e-15)
    rates = np.cos(found.state.theta1 / 2) * states[:, 2]
    np.testing.assert_array_equal(found.side, np.sign(rates))


@pytest.mark.slow
def test_all_are_those_of_a_taylor_series_in_extended_precision(paper):
    """heyoka's events of the last start above, in 64 bits of mantissa: there only this package's
    own errors grow, by 1e5 until the last.
    """
    hy, wide = pytest.importorskip("heyoka"), np.longdouble
    a, b, u, v = hy.make_vars("a", "b", "u", "v")
    derivatives = lagrange(None, (a, b, u, v), hy, hy.par[0])
    start = [wide(x) for x in (2.0, -0.5, 0.0, 0.0)]
    hits = []
    event = hy.nt_event(hy.sin(0.5 * a), lambda series, time, sign: hits.append(time), fp_type=wide)
    system, pull = list(zip((a, b, u, v), derivatives, strict=True)), [wide(9.8) / wide(0.2)]
    series = hy.taylor_adaptive(system, start, pars=pull, nt_events=[event], fp_type=wide)
    series.propagate_until(wide(4.6))
    again = hy.taylor_adaptive(system, start, pars=pull, fp_type=wide)
    places = []
    for time in hits:
        again.propagate_until(time)
        places.append(again.state[1])
    finest = dpend.scheme_for(paper, 2e-11)
    found = dpend.crossings(Plane(), paper, dpend.released(2.0, -0.5), len(hits), finest)
    assert len(hits) == 11
    np.testing.assert_allclose(found.time, np.array(hits, float), rtol=0, atol=2e-11)
    np.testing.assert_allclose(found.state.theta2, np.array(places, float), rtol=0, atol=1e-10)


def test_a_start_that_nearly_touches_the_section_comes_back_at_once(paper):
    """theta1 rises at 4e-5 rad/s, the difference of terms that are 3e5 as large, and falls back
    within 14 microseconds.
    """
    edge = float(Plane().largest_momentum(paper, 0.1, -3.080298))
    start = dpend.on_energy(paper, 0.1, 0.0, -3.080298, p2=-edge * (1 - 6e-12))
    omega = dpend.velocities(paper, start)
    bend = lagrange(0.0, np.array([0.0, -3.080298, *omega], float))[2]
    found = found_at(paper, start)
    np.testing.assert_allclose(found.time[0], -2 * omega[0] / bend, rtol=1e-3)
    times, _ = hits_of(paper, start, 1.0)  # which has no event beside its start
    np.testing.assert_allclose(found.time[1:4], times[-3:], rtol=0, atol=1e-10)
    assert 0.015 < times[-3] < 0.016


def test_each_is_the_first_after_the_one_before(paper):
    start = dpend.released(1.6, 1.2)
    found = found_at(paper, start)
    at = jax.tree.map(lambda leaf: leaf[3], found.state)
    first = dpend.first_crossing(Plane(), paper, at, 1.0, FINE)
    assert abs(found.time[4] - found.time[3] - first.time) < 1e-12
    rising = found_at(paper, start, direction=1)
    np.testing.assert_allclose(rising.time[:6], found.time[found.side == 1], rtol=0, atol=1e-12)


def test_backwards_through_the_same_places(paper):
    found = found_at(paper, dpend.released(1.0, 0.3))
    last = jax.tree.map(lambda leaf: leaf[-1], found.state)
    back = found_at(paper, last, count=-11)
    np.testing.assert_allclose(back.time + found.time[-1], found.time[-2::-1], rtol=0, atol=1e-11)
    np.testing.assert_array_equal(back.side, -found.side[-2::-1])


def level(pendulum, state):
    return state.theta1 - pendulum.l2  # the level in the place of a parameter


@pytest.mark.slow
def test_two_crossings_near_a_touching_place_are_two_or_none(unit):
    """A turning point of theta1 lies above the level by 1e-5 to 1e-13, in one step: two crossings
    where a parabola has them; below it none, and never one.
    """
    start, scheme = dpend.State(-0.5, 0.2, 1.5, 0.4), Scheme("rk8-circle", 0.02)
    turn = dpend.first_crossing(
        lambda pendulum, state: dpend.velocities(pendulum, state)[0], unit, start, 3.0, scheme
    )
    top = float(turn.state.theta1)
    _, slope = jax.jvp(
        lambda state: dpend.velocities(unit, state)[0],
        (turn.state,),
        (dpend.vector_field(unit, turn.state),),
    )
    bend = -float(slope)
    depths = 10.0 ** np.arange(-5, -14, -1)

    @jax.jit
    @jax.vmap
    def times(height):
        def shifted(pendulum, state):
            return state.theta1 - height

        return dpend.crossings(shifted, unit, start, 2, scheme).time - turn.time

    above = np.asarray(times(top - depths))
    half = np.sqrt(2 * depths / bend)
    expected = np.stack([-half, half], axis=1)
    # theta1 rounds at some 1e-16, of which the square root counts.
    near = np.maximum(0.5 * depths, 1e-15 / half)[:, None]
    assert np.all(np.abs(above - expected) < 3 * near)
    assert np.all(times(top + depths)[:, 0] > 1.0)


@pytest.mark.slow
def test_derivatives_are_those_of_the_implicit_function_theorem(paper):
    def last(theta1):
        found = found_at(paper, dpend.released(theta1, 0.3), count=4)
        return jnp.stack([found.time[3], found.state.theta2[3], found.state.p2[3]])

    slope, h = jax.jacfwd(last)(1.0), 1e-4
    both = [last(1.0 + k * h) for k in (-2, -1, 1, 2)]
    difference = (both[0] - 8 * both[1] + 8 * both[2] - both[3]) / (12 * h)
    np.testing.assert_allclose(slope, difference, rtol=1e-8, atol=1e-11)


def test_what_never_crosses_again_ends(paper):
    found = dpend.crossings(level, paper, dpend.released(0.1, 0.1), 2, FINE, most_steps=500)
    assert np.all(np.isinf(found.time))
    assert np.all(found.side == 0)
    assert np.all(np.isnan(found.state.p1))


def test_count_is_checked(paper):
    with pytest.raises(ValueError, match="count must be an integer of at least 1, got 0"):
        dpend.crossings(level, paper, dpend.released(0.1, 0.1), 0, FINE)
