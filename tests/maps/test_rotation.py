"""Rotation numbers of invariant curves."""

import numpy as np
import pytest
import xarray

import dpend

GOLDEN = (3 - 5**0.5) / 2


def section_of(points):
    """A section with one motion through these points, all on side 1."""
    data = {
        "angle": (("start", "crossing"), points[None, :, 0]),
        "momentum": (("start", "crossing"), points[None, :, 1]),
        "side": (("start", "crossing"), np.ones((1, len(points)), np.int8)),
    }
    return xarray.Dataset(data, {"start_angle": ("start", [0.0]), "start_momentum": ("start", [0])})


@pytest.mark.parametrize("rotation", [GOLDEN, 1 - GOLDEN, np.sqrt(2) / 30, np.pi / 6.4])
def test_a_bent_and_slanted_curve_turned_by_a_known_share(rotation):
    """A rotation by a known share of a turn, in coordinates that make the curve no circle."""
    turn = 2 * np.pi * rotation * np.arange(1000) + 0.3
    x, y = np.cos(turn), np.sin(turn)
    points = np.stack([3.0 + 0.4 * x + 0.05 * y**2, 0.01 * y + 0.008 * x + 0.002 * x * y], axis=1)
    points[:, 0] = np.remainder(points[:, 0] + np.pi, 2 * np.pi) - np.pi  # across the half turn
    found = dpend.rotation_numbers(section_of(points), (3.0, 0.0))
    np.testing.assert_allclose(found.rotation, rotation, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.frequency, rotation, rtol=0, atol=1e-9)


def test_a_few_returns_and_random_ones_have_no_number():
    points = np.random.default_rng(1).normal(size=(500, 2))
    assert dpend.rotation_numbers(section_of(points), (0.0, 0.0)).difference > 1e-4
    assert np.isnan(dpend.rotation_numbers(section_of(points[:15]), (0.0, 0.0)).rotation)


@pytest.mark.slow
def test_curves_near_a_fixed_point_turn_as_its_derivative_does(paper):
    """cos(2 pi rho) = kappa at the fixed point, and rho - rho_0 falls like the square of the size;
    both methods agree to 1e-8.
    """
    orbit = dpend.periodic_points(paper, -0.48, near=[(0.0, -0.0097)])
    centre = float(orbit.angle[0, 0]), float(orbit.momentum[0, 0])
    size = 4e-4 * np.array([1.0, 2.0])
    starts = np.column_stack([np.zeros(2), centre[1] + size])
    found = dpend.rotation_numbers(dpend.section(paper, -0.48, points=starts, count=2000), centre)
    assert np.all(found.difference < 1e-8)
    exact = np.arccos(float(orbit.kappa[0])) / (2 * np.pi)
    away = found.rotation.values - exact
    np.testing.assert_allclose(away[1] / away[0], 4.0, rtol=0.1)
    assert 0 < away[0] < 1e-3
