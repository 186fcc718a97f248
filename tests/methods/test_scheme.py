"""Each step against its order, an independent loop and the definition of a tangent."""

import math

import jax
import numpy as np
import pytest

import dpend
from dpend import Scheme, State
from dpend.methods.runge_kutta import RK4, RK8, RK10

STATE = State(1.0, -0.7, 0.01, 0.004)


@pytest.mark.parametrize(
    ("name", "order", "steps"),
    [
        ("rk4", 4, (100, 200, 400)),
        ("rk8", 8, (20, 24, 32)),
        ("rk4-circle", 4, (100, 200, 400)),
        ("rk8-circle", 8, (20, 24, 32)),
        ("gauss", 6, (14, 20, 28)),
    ],
)
def test_order(paper, name, order, steps):
    start = dpend.released(0.6, 0.4)
    exact = dpend.flow(paper, start, 0.4, Scheme("rk8", 0.4 / 400))
    ends = [dpend.flow(paper, start, 0.4, Scheme(name, 0.4 / n)) for n in steps]
    errors = [max(abs(end.theta1 - exact.theta1), abs(end.theta2 - exact.theta2)) for end in ends]
    measured = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert Scheme(name, 0.1).order == order
    assert abs(measured - order) < 0.15


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "order", "steps"),
    [
        ("rk8-circle-rescaled", 8, (14, 16, 18, 20, 24)),
        ("rk10-circle-rescaled", 10, (10, 11, 12, 13, 14)),
    ],
)
def test_order_in_rescaled_time(paper, name, order, steps):
    """Over 64 releases: on one alone, errors of opposite sign meet at some step and feign any
    order.
    """
    theta1, theta2 = np.meshgrid(np.linspace(1.0, 2.6, 8), np.linspace(-2.5, 2.5, 8))
    start = dpend.released(theta1.ravel(), theta2.ravel())

    def ends(scheme):
        end = jax.vmap(lambda state: dpend.flow(paper, state, 1.0, scheme))(start)
        return np.stack([end.theta1, end.theta2])

    exact = ends(Scheme("rk8", 1 / 3000))
    errors = [np.abs(ends(Scheme(name, 0.4 / n)) - exact).max(axis=0) for n in steps]
    measured = -np.polyfit(np.log(steps), np.log(errors).mean(axis=1), 1)[0]
    assert Scheme(name, 0.1).order == order
    assert order - 0.15 < measured < order + 1


@pytest.mark.parametrize("tableau", [RK4, RK8, RK10])
def test_tableaus_satisfy_their_order_conditions(tableau):
    """Quadrature to the order, and the bushy and tall trees: sum b_i c_i^k = 1/(k + 1), b A^(k-1) 1
    = 1/k!.
    """
    stages = len(tableau.b)
    a = np.array([[*row, *[0.0] * (stages - len(row))] for row in tableau.a])
    b, c = np.array(tableau.b), a.sum(axis=1)
    tall = np.ones(stages)
    for k in range(tableau.order):
        assert abs(b @ c**k - 1 / (k + 1)) < 1e-14
        assert abs(b @ tall - 1 / math.factorial(k + 1)) < 1e-14
        assert abs(b @ (a @ c**k) - 1 / ((k + 1) * (k + 2))) < 1e-14 or k + 2 > tableau.order
        tall = a @ tall
    assert abs(b @ c**tableau.order - 1 / (tableau.order + 1)) > 1e-7


@pytest.mark.parametrize("pendulum", [dpend.Pendulum(), dpend.Pendulum(0.3, 0.1, 0.05, 0.4)])
def test_the_circles_tangents_are_those_of_the_canonical_step(pendulum):
    """Its variational equations are written by hand; those of (theta, p) come from `jax.jvp`."""
    state, tangents = dpend.momenta(pendulum, 1.0, -0.7, 3.0, -5.0), State(*np.eye(4))

    def moved(name):
        scheme = Scheme(name, 1e-3)
        constants = scheme.constants(pendulum, 1e-3)
        _, moved = jax.jit(scheme.move_tangents)(constants, scheme.enter(pendulum, state), tangents)
        return np.stack(jax.tree.leaves(moved))

    np.testing.assert_allclose(moved("rk8-circle"), moved("rk8"), rtol=1e-11, atol=1e-15)


def test_rk4_is_the_papers_step(paper):
    """3000 steps of 1 ms against a plain numpy loop of the classical method on the paper's own
    equations.
    """
    l1, l2, m1, m2, g = (float(value) for value in jax.tree.leaves(paper))
    mu = m2 / m1

    def slope(x):
        theta1, theta2, p1, p2 = x
        s, c = np.sin(theta1 - theta2), np.cos(theta1 - theta2)
        depth = 1 + mu * s**2
        square = p1**2 / (m1 * l1**2) + p2**2 * (1 + mu) / (m2 * l2**2)
        force = (square * mu * c - p1 * p2 * (1 + mu + mu * c**2) / (m1 * l1 * l2)) * s / depth**2
        return np.array(
            [
                (p1 / (m1 * l1**2) - p2 * c / (m1 * l1 * l2)) / depth,
                (p2 * (1 + mu) / (m2 * l2**2) - p1 * c / (m1 * l1 * l2)) / depth,
                force - (m1 + m2) * g * l1 * np.sin(theta1),
                -force - m2 * g * l2 * np.sin(theta2),
            ]
        )

    x, h = np.array([np.radians(40), np.radians(49.1), 0.0, 0.0]), 1e-3
    for _ in range(3000):
        k1 = slope(x)
        k2 = slope(x + h / 2 * k1)
        k3 = slope(x + h / 2 * k2)
        k4 = slope(x + h * k3)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    end = dpend.flow(
        paper, dpend.released(np.radians(40), np.radians(49.1)), 3.0, Scheme("rk4", 1e-3)
    )
    np.testing.assert_allclose(jax.tree.leaves(end), x, rtol=0, atol=2e-13)


@pytest.mark.parametrize("name", ["rk4", "rk8"])
def test_tangents_are_derivatives_and_leave_the_motion_alone(paper, name):
    scheme = Scheme(name, 0.01)
    tangents = State(*np.eye(4))
    state, moved = jax.jit(scheme.advance_tangents)(paper, STATE, tangents, 0.01)
    alone = jax.jit(scheme.advance)(paper, STATE, 0.01)
    assert [float(x) for x in jax.tree.leaves(state)] == [float(x) for x in jax.tree.leaves(alone)]
    nudge = 1e-6
    ahead = jax.jit(scheme.advance)(paper, State(1.0 + nudge, -0.7, 0.01, 0.004), 0.01)
    behind = jax.jit(scheme.advance)(paper, State(1.0 - nudge, -0.7, 0.01, 0.004), 0.01)
    difference = [
        (a - b) / (2 * nudge)
        for a, b in zip(jax.tree.leaves(ahead), jax.tree.leaves(behind), strict=True)
    ]
    np.testing.assert_allclose([leaf[0] for leaf in jax.tree.leaves(moved)], difference, atol=2e-10)


def test_schemes_refuse_what_they_cannot_be():
    with pytest.raises(ValueError, match="method must be one of rk4, rk8, .*, got 'euler'"):
        Scheme("euler", 0.1)
    for step in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match="step must be a finite positive number"):
            Scheme("rk8", step)
    with pytest.raises(ValueError, match="step must not be longer than the motion of 1 s, got 1.5"):
        Scheme("rk8", 1.5).steps(1.0)


def test_number_of_steps():
    assert [Scheme("rk8", 0.1).steps(t) for t in (0.0, 0.1, 1.0, 1.01, -0.3)] == [0, 1, 10, 11, 3]


def test_the_circle_drifts_like_the_methods_error(paper):
    """s^2 + c^2 = 1 is no invariant of the circle form: it is off by an error of the method's
    order.
    """
    drifts = []
    for n in (200, 400):
        scheme = Scheme("rk4-circle", 1.0 / n)
        constants = scheme.constants(paper, 1.0 / n)
        move, point = jax.jit(scheme.move), scheme.enter(paper, dpend.released(2.0, 1.0))
        for _ in range(n):
            point = move(constants, point)
        drifts.append(abs(point.sin2**2 + point.cos2**2 - 1))
    assert 1e-12 < drifts[1] < 1e-7
    assert abs(np.log2(drifts[0] / drifts[1]) - 4) < 1.5


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("rk8-circle", marks=pytest.mark.slow),
        "rk8-circle-rescaled",
        "rk10-circle-rescaled",
        "gauss",
    ],
)
@pytest.mark.parametrize(
    "pendulum", [dpend.Pendulum(0.3, 0.1, 0.05, 0.4), dpend.Pendulum(1.0, 2.0, 3.0, 0.1, 0.0)]
)
def test_the_forms_move_other_pendulums_alike(name, pendulum):
    """Momenta, other masses and lengths, no gravity, backwards too: the same motion as in (theta,
    p).
    """
    start = dpend.momenta(pendulum, 0.4, -2.0, 3.0, -5.0)
    for duration in (0.5, -0.5):
        plain = dpend.flow(pendulum, start, duration, Scheme("rk8", 5e-4))
        other = dpend.flow(pendulum, start, duration, Scheme(name, 5e-4))
        np.testing.assert_allclose(
            jax.tree.leaves(other), jax.tree.leaves(plain), rtol=1e-9, atol=1e-9
        )


@pytest.mark.slow
def test_rescaled_derivatives_are_those_of_the_flow(paper):
    """Forward mode through rescaled time, in the start, the parameters and the duration."""

    def end(theta1, duration, pendulum, scheme):
        return dpend.flow(pendulum, dpend.released(theta1, 0.4), duration, scheme).theta2

    ours = jax.jacfwd(end, (0, 1, 2))(2.0, 0.6, paper, Scheme("rk8-circle-rescaled", 5e-3))
    plain = jax.jacfwd(end, (0, 1, 2))(2.0, 0.6, paper, Scheme("rk8", 2e-3))
    np.testing.assert_allclose(jax.tree.leaves(ours), jax.tree.leaves(plain), rtol=1e-8, atol=1e-9)


def test_scheme_for_a_tolerance(paper):
    """Finer for less error, in the pendulum's own time: lengths four times as long, steps twice."""
    steps = [dpend.scheme_for(paper, tolerance).step for tolerance in (1e-3, 1e-6, 1e-9)]
    assert steps[0] > steps[1] > steps[2]
    longer = dpend.scheme_for(dpend.Pendulum(0.8, 0.8), 1e-6)
    assert abs(longer.step / steps[1] - 2) < 1e-12
    with pytest.raises(ValueError, match="tolerance must be a finite positive number"):
        dpend.scheme_for(paper, 0.0)


@pytest.mark.slow
def test_gauss_is_symplectic_and_its_own_inverse(paper):
    """Whatever the step: M^T J M = J for the derivative of the step's map, which no explicit method
    here satisfies, and a step back returns to the last bits.
    """
    zero, one = np.zeros((2, 2)), np.eye(2)
    form = np.block([[zero, one], [-one, zero]])

    def defect(name, step):
        matrix = np.asarray(dpend.monodromy(paper, STATE, 0.4, Scheme(name, step)))
        return np.max(np.abs(matrix.T @ form @ matrix - form))

    assert defect("gauss", 0.04) < 1e-12
    assert defect("rk8", 0.04) > 1e-10
    there = dpend.flow(paper, STATE, 0.4, Scheme("gauss", 0.04))
    back = dpend.flow(
        paper, there, -0.4, Scheme("gauss", 0.04)
    )  # the momenta are iterated to the end backwards, too
    np.testing.assert_allclose(jax.tree.leaves(back), jax.tree.leaves(STATE), rtol=0, atol=1e-14)


@pytest.mark.slow
def test_gauss_keeps_the_energy(paper):
    """Over 2000 periods of 80 steps no more than rounding, and 30 times less than order 8 loses
    with as much work.
    """
    orbit = dpend.find_orbit(paper, np.radians(40.0), branch="in-phase")
    period, energy = float(orbit.period), float(orbit.energy)
    drifts = []
    for name, steps in (("gauss", 80), ("rk8", 80)):
        state, off = orbit.state, []
        for _ in range(4):
            state = dpend.flow(paper, state, 500 * period, Scheme(name, period / steps))
            off.append(abs(float(dpend.hamiltonian(paper, state)) / energy - 1))
        drifts.append(max(off))
    assert drifts[0] < 5e-15
    assert drifts[1] > 30 * drifts[0]


@pytest.mark.slow
def test_gauss_derivatives(paper):
    """Forward and reverse, of one lane and of many, by the implicit function theorem: against order
    8.
    """

    def end(theta1, pendulum, scheme):
        return dpend.flow(pendulum, dpend.released(theta1, 0.4), 0.4, scheme).theta2

    gauss, fine = Scheme("gauss", 2e-3), Scheme("rk8", 2e-3)
    for derivative in (jax.grad, jax.jacfwd):
        ours = derivative(end, (0, 1))(0.6, paper, gauss)
        np.testing.assert_allclose(
            jax.tree.leaves(ours),
            jax.tree.leaves(jax.grad(end, (0, 1))(0.6, paper, fine)),
            rtol=1e-8,
        )
    angles = np.array([0.3, 0.6, 2.9])
    many = jax.vmap(jax.grad(end), (0, None, None))(angles, paper, gauss)
    np.testing.assert_allclose(
        many, [jax.grad(end)(angle, paper, fine) for angle in angles], rtol=1e-8
    )


def test_gauss_says_where_its_step_has_no_solution(paper):
    """Rods at 300 and -400 rad/s and a step of 0.1 s: NaN, and no endless iteration."""
    fast = dpend.momenta(paper, 1.0, 2.0, 300.0, -400.0)
    assert np.all(np.isnan(jax.tree.leaves(dpend.flow(paper, fast, 0.2, Scheme("gauss", 0.1)))))
    motion = dpend.simulate(paper, fast, 0.2, step=0.1, method="gauss")
    assert motion.status != dpend.Status.CONVERGED
