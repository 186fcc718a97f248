"""Crossings against closed forms, another integrator, and the method's own order."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.special import ellipk

import dpend
from dpend import Pendulum, Scheme


def lower(pendulum, state):
    return state.theta1


def both(pendulum, state):
    return state.theta1, state.theta2


@pytest.mark.parametrize(
    "name", [pytest.param("rk8", marks=pytest.mark.slow), "rk8-circle-rescaled"]
)
def test_a_simple_pendulum_passes_the_bottom_at_a_quarter_of_its_period(name):
    """m2 -> 0: 4 K(sin^2(a/2)) sqrt(l/g) is the period."""
    pendulum = Pendulum(1.0, 0.7, 1.0, 1e-9, 1.0)
    crossing = dpend.first_crossing(
        lower, pendulum, dpend.released(2.0, 0.3), 5.0, Scheme(name, 1e-2)
    )
    assert abs(crossing.time - ellipk(math.sin(1.0) ** 2)) < 1e-8
    assert abs(crossing.state.theta1) < 1e-12
    assert crossing.which == 0


@pytest.mark.slow
def test_the_crossing_is_exact_to_the_method(paper):
    """The error in time falls with the method's order; an interpolant would end it at its own."""
    start = dpend.released(1.2, 0.4)
    exact = dpend.first_crossing(lower, paper, start, 0.6, Scheme("rk8", 5e-4)).time
    steps = np.array([3e-3, 4.5e-3, 6e-3])
    errors = [
        abs(dpend.first_crossing(lower, paper, start, 0.6, Scheme("rk4", h)).time - exact)
        for h in steps
    ]
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
        dpend.first_crossing(
            lower, paper, dpend.released(0.5, 0.2), 1.0, Scheme("rk8", 1e-2), direction=2
        )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rk8-circle-rescaled", "rk4"])
def test_what_does_not_count_is_passed_by(paper, name):
    """In one step a falling function, which does not count, and a rising one: over many releases,
    always the latter.
    """
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
        lambda pendulum, state: 1e-170 * state.theta1,
        paper,
        dpend.released(0.5, 0.5),
        1.0,
        Scheme("rk8-circle", 0.02),
    )
    plain = dpend.first_crossing(
        lower, paper, dpend.released(0.5, 0.5), 1.0, Scheme("rk8-circle", 0.02)
    )
    assert abs(found.time - plain.time) < 1e-12


FORTY = math.radians(40.0)


def turn_of(pendulum, start, scheme):
    """Where theta1 turns back first, and when."""
    crossing = dpend.first_crossing(rate1, pendulum, start, 1.0, scheme)
    return float(crossing.state.theta1), float(crossing.time)


def rate1(pendulum, state):
    return dpend.velocities(pendulum, state)[0]


KINDS = "level rate jump pole nowhere nothing energy touch cube".split()


@partial(jax.jit, static_argnames=("duration", "direction"))
def find(start, kind, level=0.0, *, duration=0.9, direction=0):
    """A function by its name: compiled once for all of them."""
    pendulum = Pendulum()

    def watched(pendulum, state):
        off = state.theta1 - level
        energy = dpend.hamiltonian(pendulum, state) - dpend.hamiltonian(pendulum, start)
        gap = jnp.where(jnp.abs(off) < 0.05, jnp.nan, off)
        values = (
            off,
            rate1(pendulum, state),
            jnp.sign(off),
            1 / off,
            gap,
            0.0 * off,
            energy,
            off**2,
            off**3,
        )
        return jnp.stack(values)[kind]

    return dpend.first_crossing(
        watched, pendulum, start, duration, Scheme("rk8-circle-rescaled", 4e-3), direction=direction
    )


def test_what_turns_jumps_and_touches():
    """Two crossings about a turn inside one step, in order; and functions that change sign and
    cross nowhere.
    """
    start = dpend.released(FORTY, 0.85)
    turn = find(start, KINDS.index("rate"))  # released at rest: that zero does not count
    level = float(turn.state.theta1) + 1e-9
    first = find(start, KINDS.index("level"), level)
    second = find(first.state, KINDS.index("level"), level)
    assert 1e-6 < turn.time - first.time < 1e-5
    assert abs(first.time + second.time / 2 - turn.time) < 1e-8
    assert max(abs(first.state.theta1 - level), abs(second.state.theta1 - level)) < 4e-16
    assert find(second.state, KINDS.index("level"), level).time == jnp.inf
    assert find(start, KINDS.index("level"), level - 2e-9).time == jnp.inf
    falling = find(start, KINDS.index("level"), 0.2)
    assert abs(find(start, KINDS.index("cube"), 0.2).time - falling.time) < 1e-12
    for kind in "jump pole nowhere nothing energy touch".split():
        assert find(start, KINDS.index(kind), 0.2).time == jnp.inf, kind


@pytest.mark.slow
def test_a_crossing_at_the_end_and_where_it_starts():
    """Within rounding of the end it counts, within rounding of the start it does not, on either
    side of zero.
    """
    start, kind = dpend.released(FORTY, 0.85), KINDS.index("level")
    whole = find(start, kind, 0.2)
    ends = find(start, kind, 0.2, duration=float(whole.time))
    assert abs(ends.time - whole.time) < 1e-15
    assert ends.which == 0
    slope = jax.jacfwd(lambda level: find(start, kind, level, duration=float(whole.time)).time)(0.2)
    assert abs(slope * dpend.vector_field(Pendulum(), whole.state).theta1 - 1) < 1e-12
    assert find(start, kind, 0.2, duration=0.999999 * float(whole.time)).time == jnp.inf
    back = find(whole.state, kind, 0.2, duration=-0.9)
    for shift in (-1e-16, -1e-17, 0.0, 1e-17, 1e-16):
        shifted = dpend.State(
            whole.state.theta1 + shift, whole.state.theta2, whole.state.p1, whole.state.p2
        )
        assert abs(find(shifted, kind, 0.2).time - find(whole.state, kind, 0.2).time) < 1e-14
        assert abs(find(shifted, kind, 0.2, duration=-0.9).time - back.time) < 1e-14
    # A release at rest is symmetric in time.
    assert abs(back.time + 2 * whole.time) < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("direction", [0, 1, -1])
def test_continued_crossings_are_those_of_a_dense_solution(direction):
    """Other pendulums, releases and levels, half of the levels within 1e-8 to 1e-3 rad of a turn:
    none is missed, none comes twice, each is of its function and direction, at rounding level, and
    at SciPy's time.
    """
    draw, duration = np.random.default_rng(3), 2.0
    field = jax.jit(dpend.vector_field)

    @jax.jit
    @jax.vmap
    def step(pendulum, state, levels):
        def angles(pendulum, state):
            return state.theta1 - levels[0], state.theta2 - levels[1]

        scheme = Scheme("rk8-circle-rescaled", 8e-3)
        return dpend.first_crossing(angles, pendulum, state, duration, scheme, direction=direction)

    pendulums, starts, levels, expected = [], [], [], []
    for _ in range(8):
        pendulum = Pendulum(*draw.uniform(0.15, 0.4, 2), *draw.uniform(0.05, 0.2, 2))
        start = [*draw.uniform(-1.5, 1.5, 2), 0.0, 0.0]

        def slope(t, y, pendulum=pendulum):
            return np.array(jax.tree.leaves(field(pendulum, dpend.State(*y))))

        dense = solve_ivp(
            slope, (0, duration), start, method="DOP853", rtol=1e-12, atol=1e-13, dense_output=True
        ).sol
        times = np.linspace(0, duration, 1001)
        turns = [passages(lambda t, i=i, s=slope, d=dense: s(t, d(t))[i], times) for i in (0, 1)]
        offset = 10 ** draw.uniform(-8, -3) * (1 if draw.random() < 0.5 else -1)
        near = (
            dense(turns[0][0])[0] + offset
            if len(levels) % 2 and len(turns[0])
            else draw.uniform(-1, 1)
        )
        level = [near, draw.uniform(-2, 2)]
        events = []
        for i in (0, 1):
            nodes = np.sort([*times, *turns[i]])
            for t in passages(lambda t, i=i, d=dense, level=level: d(t)[i] - level[i], nodes):
                sense = np.sign(slope(t, dense(t))[i])
                events += [(t, i, sense)] if direction in (0, sense) else []
        pendulums.append(pendulum), starts.append(dpend.State(*start))
        levels.append(level), expected.append(sorted(events))
    pendulums, states = (
        jax.tree.map(lambda *x: jnp.stack(x), *trees) for trees in (pendulums, starts)
    )
    levels, now = jnp.array(levels), np.zeros(len(expected))
    for turn in range(max(map(len, expected)) + 1):
        found = step(pendulums, states, levels)
        states, now = found.state, now + np.asarray(found.time)
        slopes = field(pendulums, states)
        for lane, events in enumerate(expected):
            if turn >= len(events):
                assert now[lane] > duration
                continue
            time, which, sense = events[turn]
            rate = [slopes.theta1, slopes.theta2][which][lane]
            assert found.which[lane] == which
            assert np.sign(rate) == sense
            assert abs([states.theta1, states.theta2][which][lane] - levels[lane, which]) < 1e-15
            assert abs(now[lane] - time) * min(1.0, abs(rate)) < 1e-8


def passages(function, nodes):
    values = np.array([function(t) for t in nodes])
    signs = np.flatnonzero(np.sign(values[1:]) * np.sign(values[:-1]) < 0)
    return [brentq(function, nodes[i], nodes[i + 1], xtol=1e-15) for i in signs]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rk4", "rk8", "rk8-circle", "rk8-circle-rescaled", "gauss"])
def test_two_crossings_about_a_turn_inside_one_step(paper, name):
    """Of theta1 = lowest + d, whose two crossings lie sqrt(2 d/acceleration) before and behind the
    turn: both are roots to the last digits, in order, also in directions, and with nothing between
    them and the next swing.
    """
    scheme, start = Scheme(name, 1e-3 if name == "rk4" else 4e-3), dpend.released(FORTY, 0.85)
    lowest, turn = turn_of(paper, start, scheme)
    swing = dpend.first_crossing(rate1, paper, start, 1.0, scheme).state
    bend = float(
        jax.jvp(lambda x: rate1(paper, x), (swing,), (dpend.vector_field(paper, swing),))[1]
    )

    @partial(jax.jit, static_argnames="direction")
    def find(start, level, direction=0):
        return dpend.first_crossing(
            lambda p, s: s.theta1 - level, paper, start, 0.9, scheme, direction=direction
        )

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
