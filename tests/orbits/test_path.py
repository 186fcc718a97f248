"""The motion of an orbit at any times."""

import jax
import numpy as np
import pytest

import dpend


def angles(motion):
    return np.stack([motion.state.theta1, motion.state.theta2])


@pytest.fixture(scope="module")
def gentle(paper):
    return dpend.find_orbit(paper, np.radians(40.0), branch="in-phase")


def test_it_is_the_motion_of_the_state(paper, gentle):
    """Three periods on and one back, in any order, against one integration from the state."""
    times = float(gentle.period) * np.array([2.9, 0.1, 1.6, 0.75, 2.25])
    motion = gentle.trajectory(times)
    order = np.argsort(times)
    straight = dpend.simulate(paper, gentle.state, times=times[order], tolerance=1e-11)
    np.testing.assert_allclose(angles(motion)[:, order], angles(straight), rtol=0, atol=1e-11)
    back = gentle.trajectory(-times)
    np.testing.assert_allclose(angles(back), angles(motion), rtol=0, atol=1e-11)
    assert motion.message == "Converged."
    assert motion.energy_drift < 1e-12


def test_it_does_not_part_from_an_unstable_orbit(paper):
    """kappa is 2e8: from one state, the motion has parted after two periods."""
    orbit = dpend.find_orbit(paper, np.radians(170.0), branch="in-phase")
    period = float(orbit.period)
    times = period * np.linspace(0.0, 1.0, 9)
    once, later = orbit.trajectory(times), orbit.trajectory(times + 40 * period)
    np.testing.assert_allclose(angles(later), angles(once), rtol=0, atol=1e-10)
    # A brake orbit goes back the way that it came.
    np.testing.assert_allclose(angles(once), angles(once)[:, ::-1], rtol=0, atol=1e-10)
    lost = dpend.simulate(paper, orbit.state, times=times[1:] + period)
    assert np.max(np.abs(angles(lost) - angles(once)[:, 1:])) > 1e-6


def test_a_rotating_orbit_turns_on(paper):
    start = dpend.State(0.0, 0.0, -0.0141, 0.0409)
    orbit = dpend.find_orbit(paper, state=start, period=0.42)
    motion = orbit.trajectory()
    first, last = angles(motion)[:, 0], angles(motion)[:, -1]
    np.testing.assert_allclose(last - first, [0.0, 2 * np.pi], rtol=0, atol=1e-12)
    assert np.max(np.abs(np.diff(motion.state.theta2))) < 0.1
    straight = dpend.simulate(paper, orbit.state, times=motion.time[1:], tolerance=1e-11)
    np.testing.assert_allclose(angles(motion)[:, 1:], angles(straight), rtol=0, atol=1e-9)


def test_what_is_no_single_orbit_is_refused(paper, gentle):
    many = jax.tree.map(lambda leaf: np.array([leaf, leaf]), gentle)
    with pytest.raises(ValueError, match="orbit must be a single one"):
        many.trajectory()
    with pytest.raises(ValueError, match="times must be finite"):
        gentle.trajectory([0.0, np.inf])
    with pytest.raises(ValueError, match="tolerance must be"):
        gentle.trajectory(tolerance=0)
