"""States of a given energy, and the coordinates on a plane."""

import numpy as np
import pytest

import dpend
from dpend import Pendulum, Plane

UNEVEN = Pendulum(0.3, 0.5, 0.2, 0.7, 9.8)


@pytest.mark.parametrize("given", [{"p1": 0.4}, {"p2": -0.3}, {"phi": 2.0}])
@pytest.mark.parametrize("side", [1, -1])
def test_the_state_has_the_energy_and_what_was_given(given, side):
    state = dpend.on_energy(UNEVEN, 1.5, 0.7, -2.0, **given, side=side)
    assert abs(dpend.hamiltonian(UNEVEN, state) - 1.5) < 1e-14
    omega = dpend.velocities(UNEVEN, state)
    if "p1" in given:
        assert state.p1 == 0.4
        assert np.sign(omega[1]) == side
    if "p2" in given:
        assert state.p2 == -0.3
        assert np.sign(omega[0]) == side


def test_phi_goes_once_around_the_ellipse_of_momenta():
    """The area of {p: p^T M^-1 p = 2 K} is 2 pi K sqrt(det M); at phi = 0 the lower rod rests."""
    phi = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    state = dpend.on_energy(UNEVEN, 1.5, 0.7, -2.0, phi=phi)
    p1, p2 = np.asarray(state.p1), np.asarray(state.p2)
    area = 0.5 * np.sum(p1 * np.roll(p2, -1) - np.roll(p1, -1) * p2)
    area *= (2 * np.pi / 400) / np.sin(2 * np.pi / 400)  # of the polygon
    kinetic = 1.5 - float(dpend.hamiltonian(UNEVEN, dpend.released(0.7, -2.0)))
    determinant = 0.7 * 0.3**2 * 0.5**2 * (0.2 + 0.7 * np.sin(2.7) ** 2)
    np.testing.assert_allclose(area, 2 * np.pi * kinetic * np.sqrt(determinant), rtol=1e-12)
    assert abs(dpend.velocities(UNEVEN, state)[1][0]) < 1e-14


@pytest.mark.parametrize("plane", [Plane("theta1"), Plane("theta2", 0.4)])
def test_the_edge_of_a_plane_is_where_the_angle_stands_still(plane):
    edge = plane.largest_momentum(UNEVEN, 1.5, 0.8)
    inside = plane.state(UNEVEN, 1.5, 0.8, edge * (1 - 1e-12))
    omega = dpend.velocities(UNEVEN, inside)[plane.angle == "theta2"]
    assert 0 < omega < 1e-4
    assert np.isnan(plane.state(UNEVEN, 1.5, 0.8, edge * (1 + 1e-12)).p1)
    assert plane.point(inside) == (0.8, edge * (1 - 1e-12))


def test_exactly_one_is_given():
    with pytest.raises(ValueError, match="p1, p2 or phi must be given, one of them, got p1, p2"):
        dpend.on_energy(UNEVEN, 1.0, 0.0, 0.0, p1=0.1, p2=0.1)
