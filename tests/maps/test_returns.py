"""The return map of a section, and the orbits that are its periodic points."""

from functools import partial

import jax
import numpy as np
import pytest

import dpend
from dpend import Plane
from dpend.maps.section import fill


@partial(jax.jit, static_argnames=("returns", "plane"))
def back(pendulum, energy, point, returns=1, plane=None):
    found = dpend.return_map(
        pendulum, energy, *point, dpend.Scheme("rk8", 4e-3), returns=returns, plane=plane
    )
    return jax.numpy.stack([found.angle, found.momentum])


@pytest.mark.slow
def test_there_and_back_is_where_it_was(paper):
    """A rotating motion, whose angle crosses the plane once in every turn, in the same sense."""
    start = np.array([0.4, 0.05])
    there = back(paper, 0.9, start)
    np.testing.assert_allclose(back(paper, 0.9, there, returns=-1), start, rtol=0, atol=1e-9)
    state = dpend.on_energy(paper, 0.9, 0.0, 0.4, p2=0.05)
    both = dpend.crossings(Plane(), paper, state, 2, dpend.Scheme("rk8", 4e-3))
    turn = np.round(np.asarray(both.state.theta1) / (2 * np.pi))
    rising = dpend.velocities(paper, both.state)[0] > 0
    assert rising[0]
    assert turn[0] == 1
    assert both.side[0] == -1  # of sin(theta1/2), which falls at a full turn
    np.testing.assert_allclose(there[0], both.state.theta2[0], rtol=0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("plane", [Plane(), Plane("theta2", 0.3)])
def test_it_preserves_area(paper, plane):
    points = fill(paper, -0.3, plane, 24)
    slope = jax.vmap(jax.jacfwd(lambda point: back(paper, -0.3, point, plane=plane)))(points)
    size = np.max(np.abs(np.asarray(slope)), axis=(1, 2))
    assert size.max() > 10 * size.min()  # it shears some places much more than others
    np.testing.assert_allclose(np.linalg.det(slope), 1.0, rtol=0, atol=1e-10)


def point_of(pendulum, state, duration):
    """The first point after a time at which theta1 rises through zero."""
    there = dpend.flow(pendulum, state, duration, dpend.scheme_for(pendulum, 2e-11))
    found = dpend.crossings(
        Plane(), pendulum, there, 1, dpend.scheme_for(pendulum, 2e-11), direction=1
    )
    return np.array([found.state.theta2[0], found.state.p2[0]])


@pytest.mark.slow
def test_fixed_points_are_the_orbits_of_both_modes(paper):
    """What shooting from rest finds, with its period and its stability."""
    for branch in ("in-phase", "anti-phase"):
        orbit = dpend.find_orbit(paper, np.radians(40), branch=branch)
        exact = point_of(paper, orbit.state, 1e-3)
        near = [exact + np.array([0.03, 0.0]), exact * 0.97]
        found = dpend.periodic_points(paper, float(orbit.energy), near=near)
        assert np.all(found.status == dpend.Status.CONVERGED)
        np.testing.assert_allclose(found.angle.values, exact[0], rtol=0, atol=1e-10)
        np.testing.assert_allclose(found.momentum.values, exact[1], rtol=0, atol=1e-10)
        np.testing.assert_allclose(found.period, orbit.period, rtol=0, atol=1e-11)
        np.testing.assert_allclose(found.kappa, orbit.kappa, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_an_orbit_that_meets_the_plane_twice_is_a_relative_of_order_two(paper):
    """The third release of 40 degrees, which is neither mode; and one point allowed by nothing."""
    orbit = dpend.find_orbit(paper, np.radians(40), guess=(np.radians(-4.57), 1.1744))
    exact = point_of(paper, orbit.state, 1e-3)
    near = [exact + 1e-3, (0.1, 9.0)]
    found = dpend.periodic_points(paper, float(orbit.energy), returns=2, near=near)
    assert found.status.values.tolist() == [dpend.Status.CONVERGED, dpend.Status.NONFINITE]
    np.testing.assert_allclose(found.angle[0, 0], exact[0], rtol=0, atol=1e-10)
    twice = 2 / int(found["returns"][0])  # of its period
    np.testing.assert_allclose(found.period[0], twice * orbit.period, rtol=0, atol=1e-11)


@pytest.mark.slow
def test_a_search_finds_each_orbit_once_with_its_mirror_image(paper):
    found = {k: dpend.periodic_points(paper, -0.42, returns=k) for k in (1, 2, 3)}
    for k, orbits in found.items():
        assert np.all(orbits["returns"] == k)
        points = np.stack([orbits.angle.values, orbits.momentum.values], axis=-1)
        mirror = points * np.array([-1.0, 1.0])
        for each in mirror[:, 0]:
            gap = np.abs(points - each).max(axis=2)
            assert np.sum(gap.min(axis=1) < 1e-8) == 1
    # Each chain of three has as many orbits that are saddles as that are centres (Poincare and
    # Birkhoff), and there are two.
    kappa = found[3].kappa.values
    assert np.sum(np.abs(kappa) < 1) == np.sum((kappa > 1) & (kappa < 1.01)) == 2
