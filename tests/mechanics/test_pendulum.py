"""The mechanics against the gradient of H, the Lagrangian, dense eigenvalues and limits known by
hand.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dpend
from dpend import Pendulum, State

parameter = st.floats(-1.5, 1.5).map(lambda exponent: 10.0**exponent)
pendulums = st.builds(Pendulum, parameter, parameter, parameter, parameter, parameter)
angle = st.floats(-10.0, 10.0)

# Compiled once for all examples.
FIELD = jax.jit(dpend.vector_field)
HAMILTONIAN = jax.jit(dpend.hamiltonian)
GRADIENT = jax.jit(jax.grad(dpend.hamiltonian, argnums=1))
ENERGIES = jax.jit(dpend.energies)
VELOCITIES = jax.jit(dpend.velocities)
MOMENTA = jax.jit(dpend.momenta)
EQUILIBRIA = jax.jit(dpend.equilibria)
MODES = jax.jit(dpend.normal_modes)


@jax.jit
def linearised(pendulum, state):
    """The matrix of the linear flow about a state."""
    rows = jax.jacfwd(lambda x: dpend.vector_field(pendulum, x))(state)
    return jnp.array([jax.tree.leaves(row) for row in (rows.theta1, rows.theta2, rows.p1, rows.p2)])


def scaled_state(pendulum, theta1, theta2, omega1, omega2):
    """A state whose kinetic and potential energies are of one size, whatever the pendulum."""
    rate = np.sqrt(pendulum.g / (pendulum.l1 + pendulum.l2))
    return MOMENTA(pendulum, theta1, theta2, omega1 * rate, omega2 * rate)


@settings(max_examples=60, deadline=None)
@given(pendulums, angle, angle, st.floats(-3, 3), st.floats(-3, 3))
def test_vector_field_is_the_gradient_of_the_hamiltonian(pendulum, theta1, theta2, omega1, omega2):
    state = scaled_state(pendulum, theta1, theta2, omega1, omega2)
    slope, gradient = FIELD(pendulum, state), GRADIENT(pendulum, state)
    # The largest terms that each equation adds up.
    turning = (np.abs(slope.theta1) + np.abs(slope.theta2)) * (1 + pendulum.m2 / pendulum.m1)
    torque = (
        (pendulum.m1 + pendulum.m2) * pendulum.l1 * (pendulum.g + pendulum.l1 * slope.theta1**2)
        + pendulum.m2 * pendulum.l2 * (pendulum.g + pendulum.l2 * slope.theta2**2)
    ) * (1 + pendulum.m2 / pendulum.m1)
    assert abs(slope.theta1 - gradient.p1) <= 1e-13 * turning
    assert abs(slope.theta2 - gradient.p2) <= 1e-13 * turning
    assert abs(slope.p1 + gradient.theta1) <= 1e-13 * torque
    assert abs(slope.p2 + gradient.theta2) <= 1e-13 * torque


def lagrangian(pendulum, angles, rates):
    (theta1, theta2), (omega1, omega2) = angles, rates
    v1, v2 = pendulum.l1 * omega1, pendulum.l2 * omega2
    kinetic = 0.5 * pendulum.m1 * v1**2 + 0.5 * pendulum.m2 * (
        v1**2 + v2**2 + 2 * v1 * v2 * jnp.cos(theta1 - theta2)
    )
    height1 = -pendulum.l1 * jnp.cos(theta1)
    height2 = height1 - pendulum.l2 * jnp.cos(theta2)
    return kinetic - pendulum.g * (pendulum.m1 * height1 + pendulum.m2 * height2)


@pytest.mark.parametrize("pendulum", [Pendulum(), Pendulum(0.3, 0.1, 0.05, 0.4, 3.0)])
def test_vector_field_is_the_euler_lagrange_equation(pendulum):
    angles, rates = jnp.array([0.9, -2.1]), jnp.array([3.0, -7.0])
    momentum = jax.grad(lagrangian, 2)(pendulum, angles, rates)
    force = jax.grad(lagrangian, 1)(pendulum, angles, rates)
    state = dpend.momenta(pendulum, *angles, *rates)
    np.testing.assert_allclose([state.p1, state.p2], momentum, rtol=1e-14)
    slope = dpend.vector_field(pendulum, state)
    np.testing.assert_allclose([slope.theta1, slope.theta2], rates, rtol=1e-13)
    np.testing.assert_allclose([slope.p1, slope.p2], force, rtol=1e-13)


def test_vector_field_is_the_papers():
    """Yamaguchi's canonical equations (section 2, with the sign that its listing has), term by
    term.
    """
    pendulum, state = Pendulum(0.3, 0.17, 0.05, 0.4, 3.0), State(0.9, -2.1, 0.02, -0.03)
    l1, l2, m1, m2, g = jax.tree.leaves(pendulum)
    mu, s, c = m2 / m1, np.sin(0.9 + 2.1), np.cos(0.9 + 2.1)
    p1, p2, depth = state.p1, state.p2, 1 + m2 / m1 * s**2
    square = p1**2 / (m1 * l1**2) + p2**2 * (1 + mu) / (m2 * l2**2)
    force = (square * mu * c - p1 * p2 * (1 + mu + mu * c**2) / (m1 * l1 * l2)) * s / depth**2
    expected = [
        (p1 / (m1 * l1**2) - p2 * c / (m1 * l1 * l2)) / depth,
        (p2 * (1 + mu) / (m2 * l2**2) - p1 * c / (m1 * l1 * l2)) / depth,
        force - (m1 + m2) * g * l1 * np.sin(0.9),
        -force - m2 * g * l2 * np.sin(-2.1),
    ]
    np.testing.assert_allclose(
        jax.tree.leaves(dpend.vector_field(pendulum, state)), expected, rtol=1e-13
    )


@settings(max_examples=40, deadline=None)
@given(pendulums, angle, angle, st.floats(-3, 3), st.floats(-3, 3))
def test_velocities_undo_momenta(pendulum, theta1, theta2, omega1, omega2):
    state = MOMENTA(pendulum, theta1, theta2, omega1, omega2)
    scale = (
        (abs(omega1) + abs(omega2))
        * (1 + pendulum.m2 / pendulum.m1)
        * (1 + pendulum.l1 / pendulum.l2)
    )
    scale *= 1 + pendulum.l2 / pendulum.l1
    np.testing.assert_allclose(
        VELOCITIES(pendulum, state), (omega1, omega2), rtol=0, atol=1e-15 + 1e-14 * scale
    )


def test_bob_energies_have_the_papers_zero_levels(paper):
    """Section 4, case A: (0, 0.11) and (0, 0.22) J at the release, and all of them zero hanging at
    rest.
    """
    at_release = dpend.energies(paper, dpend.released(np.radians(64.3), np.radians(64.3)))
    np.testing.assert_allclose(at_release, (0, 0.11, 0, 0.22), atol=0.005)
    rise = 1 - np.cos(np.radians(64.3))
    np.testing.assert_allclose(at_release, (0, 0.196 * rise, 0, 0.392 * rise), rtol=1e-15)
    np.testing.assert_allclose(dpend.energies(paper, dpend.released(0.0, 0.0)), 0.0)


@settings(max_examples=40, deadline=None)
@given(pendulums, angle, angle, st.floats(-3, 3), st.floats(-3, 3))
def test_bob_energies_add_up_to_the_hamiltonian(pendulum, theta1, theta2, omega1, omega2):
    state = scaled_state(pendulum, theta1, theta2, omega1, omega2)
    hanging = HAMILTONIAN(pendulum, dpend.released(0.0, 0.0))
    total = sum(ENERGIES(pendulum, state))
    assert abs(HAMILTONIAN(pendulum, state) - hanging - total) <= 1e-13 * (abs(hanging) + total)


def test_positions_are_the_rods():
    at = dpend.positions(Pendulum(0.3, 0.2), dpend.released(np.pi / 2, np.pi))
    np.testing.assert_allclose(at, (0.3, 0.0, 0.3, 0.2), atol=1e-16)


@settings(max_examples=40, deadline=None)
@given(pendulums)
def test_exponents_are_the_eigenvalues_of_the_linear_flow(pendulum):
    found = EQUILIBRIA(pendulum)
    for i in range(4):
        state = jax.tree.map(lambda leaf, i=i: leaf[i], found.state)
        squares = np.sort(
            np.linalg.eigvals(np.array(linearised(pendulum, state))).astype(complex) ** 2
        )
        ours = np.sort(np.repeat(np.real(found.exponents[i] ** 2), 2))
        np.testing.assert_allclose(ours, squares.real, atol=1e-6 * np.abs(squares).max())


def test_exponents_of_the_upright_state(unit):
    """lambda^2 = 2 -+ sqrt 2 in units of g/l."""
    upright = np.sort(np.real(dpend.equilibria(unit).exponents[3]))
    np.testing.assert_allclose(upright, np.sqrt([2 - np.sqrt(2), 2 + np.sqrt(2)]), rtol=1e-15)


def test_normal_modes_of_the_paper(paper):
    """Section 4: omega^2 = (2 -+ sqrt 2) g/l, 5.36 and 12.93 rad/s, theta2 = +-sqrt(2) theta1."""
    slow, fast = dpend.normal_modes(paper)
    expected = np.sqrt((2 + np.array([-1, 1]) * np.sqrt(2)) * 9.8 / 0.2)
    np.testing.assert_allclose([slow.frequency, fast.frequency], expected, rtol=1e-15)
    np.testing.assert_allclose([slow.ratio, fast.ratio], [np.sqrt(2), -np.sqrt(2)], rtol=1e-15)
    np.testing.assert_allclose(slow.period, 2 * np.pi / expected[0], rtol=1e-15)


@pytest.mark.parametrize("mass_ratio", [1e-12, 1e-6, 1e-3, 1.0, 1e3, 1e6])
@pytest.mark.parametrize("length_ratio", [1e-3, 0.999, 1.0, 1.001, 1e3])
def test_normal_modes_keep_their_digits(mass_ratio, length_ratio):
    """(1 + mu)(L - l1)(L - l2) = mu l1 l2 for the length of the equivalent simple pendulum, in 50
    digits.
    """
    import mpmath

    slow, fast = MODES(Pendulum(1.0, length_ratio, 1.0, mass_ratio, 1.0))
    with mpmath.workdps(50):
        mu, l2 = mpmath.mpf(mass_ratio), mpmath.mpf(length_ratio)
        root = mpmath.sqrt((1 - l2) ** 2 + 4 * mu / (1 + mu) * l2)
        for mode, length in ((slow, (1 + l2 + root) / 2), (fast, (1 + l2 - root) / 2)):
            assert abs(float(float(mode.frequency) * mpmath.sqrt(length)) - 1) < 1e-15
            assert abs(float(float(mode.ratio) * (length - l2)) - 1) < 1e-14


@pytest.mark.parametrize("name", ["l1", "l2", "m1", "m2"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf, 0])
def test_bad_parameters_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} must be a finite positive number .* got {value}"):
        Pendulum(**{name: value})


def test_bad_numbers_are_refused():
    with pytest.raises(ValueError, match="g must be a finite number .* got nan"):
        Pendulum(g=float("nan"))
    with pytest.raises(ValueError, match="l1 must be .* got '0.2'"):
        Pendulum(l1="0.2")
    with pytest.raises(ValueError, match="theta2 must be .* got inf"):
        dpend.released(0.1, float("inf"))
    with pytest.raises(ValueError, match="g must be positive"):
        dpend.normal_modes(Pendulum(g=-9.8))


def test_arrays_are_numbers_too():
    """Signs are looked at in arrays as well, integers and single precision become float64, NaN may
    stand for a cell.
    """
    for lengths in (
        np.array([0.2, -0.2]),
        jnp.array([0.2, 0.0]),
        np.array(-0.2),
        jnp.asarray(-0.2),
        jnp.asarray(jnp.nan),
    ):
        with pytest.raises(ValueError, match="l1 must be a finite positive number .*, got"):
            Pendulum(l1=lengths)
    pendulum = Pendulum(
        l1=np.array([1, 2]), l2=jnp.asarray([0.5, np.nan], jnp.float32), m1=np.float32(0.5), g=-1
    )
    assert {leaf.dtype for leaf in jax.tree.leaves(pendulum)} == {np.dtype(float)}
    assert np.isnan(pendulum.l2[1])
    with pytest.raises(
        ValueError,
        match=r"theta1, theta2, p1, p2 must have one shape, got \(3,\), \(2,\), \(\), \(\)",
    ):
        State(np.zeros(3), np.zeros(2), 0.0, 0.0)
    assert State(np.zeros((3, 1)), np.zeros(2), 0.0, 0.0).theta1.shape == (3, 1)
    lost = State(jnp.asarray(jnp.nan), 0.0, 0.0, 0.0)  # the end of a motion that was lost is data
    assert np.isnan(dpend.hamiltonian(Pendulum(), lost))
    with pytest.raises(ValueError, match="theta1 must be a finite number .* got nan"):
        State(np.array(np.nan), 0.0, 0.0, 0.0)


def test_transformations_pass_through_the_data_classes(paper):
    """Tracers, masks and `None` are not numbers to be checked."""
    lengths = jnp.array([0.1, 0.2, 0.4])
    periods = jax.vmap(lambda l2: dpend.normal_modes(Pendulum(l2=l2))[0].period)(lengths)
    np.testing.assert_allclose(periods[1], dpend.normal_modes(paper)[0].period, rtol=1e-15)
    mask = jax.tree.map(lambda _: True, paper)
    assert mask.l1 is True
    slope = jax.grad(lambda p: dpend.normal_modes(p)[0].period)(paper)
    np.testing.assert_allclose(
        slope.g, -0.5 * dpend.normal_modes(paper)[0].period / paper.g, rtol=1e-14
    )
