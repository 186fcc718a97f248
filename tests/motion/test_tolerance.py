"""Motions for a tolerance: saved times, derivatives, batches, what they say of themselves."""

import extended
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpend
from dpend import Pendulum, Scheme, State, Status

RELEASE = dpend.released(2.0, 1.0)
# One shape for the tests of derivatives.
LATER = np.array([0.5, 1.0])


def leaves(state):
    return np.stack([np.asarray(leaf) for leaf in jax.tree.leaves(state)])


@pytest.mark.parametrize("tolerance", [1e-4, 1e-8, 1e-11])
def test_states_within_steps_are_as_right_as_the_estimate_says(paper, tolerance):
    if not extended.is_extended():
        pytest.skip("long double is double here")
    times = np.linspace(0, 2, 38)
    found = dpend.simulate(paper, RELEASE, times=times, tolerance=tolerance)
    exact = extended.motion((0.2, 0.2, 0.1, 0.1, 9.8), (2.0, 1.0, 0.0, 0.0), times[1:])
    error = np.abs(leaves(found.state)[:2, 1:].T - exact[:, :2]).max(axis=1)
    assert np.all(error < 3 * found.error[1:])
    assert error.max() < tolerance
    assert found.error_estimate <= tolerance
    assert np.all(leaves(found.state)[:, 0] == leaves(RELEASE))


def test_there_and_back(paper):
    there = dpend.simulate(paper, RELEASE, times=[1.5], tolerance=1e-12)
    end = jax.tree.map(lambda leaf: leaf[-1], there.state)
    back = dpend.simulate(paper, end, -1.5, times=[-0.5, -1.5], tolerance=1e-12)
    np.testing.assert_allclose(leaves(back.state)[:, -1], leaves(RELEASE), rtol=0, atol=1e-10)


def test_ends_of_steps_are_the_motion(paper):
    """The same motion whichever states of it are saved."""
    steps = dpend.simulate(paper, RELEASE, 2.0, save_every=3)
    assert (steps.time[0], steps.time[-1]) == (0.0, 2.0)
    assert steps.time.size == 1 + -(-steps.steps // 3)
    assert np.all(leaves(steps.state)[:, 0] == leaves(RELEASE))
    again = dpend.simulate(paper, RELEASE, times=steps.time)
    np.testing.assert_allclose(leaves(again.state), leaves(steps.state), rtol=0, atol=1e-12)


def test_default_times_make_a_smooth_curve(paper):
    motion = dpend.simulate(paper, RELEASE, -1.5)
    assert (motion.time[0], motion.time[-1]) == (0.0, -1.5)
    assert np.max(np.abs(np.diff(motion.state.theta2))) < 0.15


def test_derivatives_of_saved_states(paper):
    """Forward and reverse mode agree with each other and with those of a fixed step."""

    def angles(theta1, theta2, pendulum):
        release = dpend.released(theta1, theta2)
        return dpend.simulate(pendulum, release, times=LATER, tolerance=1e-11).state.theta2

    def stepped(theta1, theta2, pendulum):
        return dpend.flow(pendulum, dpend.released(theta1, theta2), 1.0, Scheme("rk8", 2e-3)).theta2

    arguments = 1.1, 0.4, paper
    forward = jax.tree.leaves(jax.jacfwd(angles, (0, 1, 2))(*arguments))
    reverse = jax.tree.leaves(jax.jacrev(angles, (0, 1, 2))(*arguments))
    exact = jax.tree.leaves(jax.jacfwd(stepped, (0, 1, 2))(*arguments))
    for one, other, end in zip(forward, reverse, exact, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(one[-1], end, rtol=1e-8, atol=1e-9)


def test_the_derivative_by_a_time_is_the_velocity(paper):
    slope = jax.jacfwd(lambda times: dpend.simulate(paper, RELEASE, times=times).state.theta1)(
        jnp.asarray(LATER)
    )
    states = dpend.simulate(paper, RELEASE, times=LATER).state
    np.testing.assert_allclose(np.diag(slope), dpend.velocities(paper, states)[0], rtol=1e-8)
    assert slope[0, 1] == 0.0


def test_second_derivatives_are_refused(paper):
    def angle(theta1):
        motion = dpend.simulate(paper, dpend.released(theta1, 0.4), times=LATER)
        return motion.state.theta1[-1]

    with pytest.raises(ValueError, match="tolerance must not be given where second derivatives"):
        jax.hessian(angle)(1.0)


def test_a_batch_is_its_motions_one_by_one(paper):
    theta1 = np.linspace(0.1, 3.0, 70)
    times = np.linspace(0, 1.0, 11)
    many = dpend.simulate(paper, dpend.released(theta1, 0.3), times=times)
    assert many.state.theta1.shape == many.error.shape == (70, 11)
    assert many.status.shape == many.error_estimate.shape == (70,)
    for lane in (0, 63, 69):
        one = dpend.simulate(paper, dpend.released(theta1[lane], 0.3), times=times)
        np.testing.assert_allclose(
            leaves(many.state)[:, lane], leaves(one.state), rtol=0, atol=2e-9
        )
    assert many.message == "70 of 70: Converged."
    data = many.to_xarray()
    assert data.theta1.dims == ("lane", "time")
    assert data.attrs["method"] == "collocation"


def test_it_traces(paper):
    def ends(theta1):
        return dpend.simulate(paper, dpend.released(theta1, 0.3), times=LATER).state.theta1[-1]

    many = jax.jit(jax.vmap(ends))(jnp.array([1.0, 2.0]))
    np.testing.assert_allclose(many, [ends(1.0), ends(2.0)], rtol=0, atol=2e-9)


def test_what_does_not_come_to_its_end_says_so(paper):
    short = dpend.simulate(paper, RELEASE, times=[0.05, 2.0], most_steps=5)
    assert short.status == Status.MAX_ITERATIONS
    assert np.isinf(short.error_estimate)
    assert np.isfinite(short.state.theta1[0])
    assert np.isnan(short.state.theta1[1])
    with pytest.raises(ValueError, match="state must have one dimension at most"):
        dpend.simulate(paper, State(*np.zeros((4, 2, 2))), 1.0)
    with pytest.raises(
        ValueError, match="duration must be at most some .* give a shorter one, or times"
    ):
        dpend.simulate(paper, RELEASE, 1e9)


def test_an_equilibrium_stays(paper):
    """Also where the fast mode turns a thousand times: neither row may grow."""
    hanging = dpend.simulate(paper, dpend.released(0.0, 0.0), 100.0, tolerance=1e-6)
    assert np.max(np.abs(leaves(hanging.state))) < 1e-30
    assert hanging.error_estimate < 5e-14
    free = Pendulum(g=0.0)
    still = dpend.simulate(free, dpend.released(1.0, 2.0), 5.0)
    assert still.message == "Converged."
    assert np.all(still.state.theta2 == 2.0)


@pytest.mark.parametrize("amplitude", [1e-10, 1e-5, 1e-2])
def test_small_swings_are_as_right_as_large_ones(paper, amplitude):
    """The in-phase mode, against its linear motion: its steps are bounded though nothing bends."""
    slow, _ = dpend.normal_modes(paper)
    angle = amplitude * slow.ratio
    times = np.linspace(0.0, 50.0, 101)
    motion = dpend.simulate(paper, dpend.released(amplitude, angle), times=times, tolerance=1e-8)
    swing = amplitude * np.cos(slow.frequency * times)
    # The frequency falls by an amount of the order of the amplitude squared.
    bound = 1e-8 + 200 * amplitude**3
    assert motion.message == "Converged."
    assert np.max(np.abs(motion.state.theta1 - swing)) < bound


def test_a_motion_of_no_duration_is_its_beginning(paper):
    """Found by an orbit asked for at half its period alone, where a piece begins: it was NaN."""
    release = dpend.released(0.5, 0.2)
    motion = dpend.simulate(paper, release, times=[0.0], tolerance=1e-9)
    assert float(motion.state.theta1[0]) == 0.5
    assert 0 < float(motion.error[0]) < 1e-14
    orbit = dpend.find_orbit(paper, np.radians(40), branch="anti-phase")
    half = orbit.trajectory([float(orbit.period) / 2]).state
    np.testing.assert_allclose(half.theta2, -orbit.theta2, rtol=1e-12)


def test_an_estimate_grows_with_the_motion(paper):
    """The start counts as exact and the sums are compensated: what errors grow from is less than a
    rounding of the start, and not a hundred times.
    """
    end = jax.jit(
        jax.jacfwd(
            lambda a, b: dpend.flow(paper, dpend.released(a, b), 3.0, Scheme("rk8", 2e-3)), (0, 1)
        )
    )
    ratios = []
    for theta1, theta2 in np.random.default_rng(5).uniform(-np.pi, np.pi, (20, 2)):
        release = dpend.released(theta1, theta2)
        motion = dpend.simulate(paper, release, times=[3.0], tolerance=1e-12)
        slopes = end(theta1, theta2)
        growth = max(np.hypot(*slopes.theta1), np.hypot(*slopes.theta2))
        ratios.append(motion.error_estimate / (np.finfo(float).eps * growth))
    assert min(ratios) > 0.02
    assert np.median(ratios) > 0.5
