"""Every passing orbit of an energy, against a scan made elsewhere and a count that knows nothing of
cells.
"""

import jax
import numpy as np
import pytest
from elsewhere import PASSAGES

import dpend
from dpend import Status
from dpend.catalogue.rows import Passages
from dpend.catalogue.scan import Budget, scan_circle


def test_the_passages_that_a_scan_found_and_no_others(unit):
    """At E = 0 up to T = 10: fourteen passages, which are nine orbits; a centred orbit passes once,
    for both its passages are each other's images.
    """
    census = dpend.find_orbits(unit, energy=0.0, max_period=10.0, symmetry="passing")
    coverage = census.coverage
    assert (coverage.suspicious_cells, coverage.exhausted, coverage.slices) == (0, False, 2)
    assert coverage.winding == coverage.degree
    passed = np.repeat(
        [orbit.period for orbit in census.orbits],
        [1 if orbit.symmetry == "centred" else 2 for orbit in census.orbits],
    )
    np.testing.assert_allclose(passed, [period for period, *_ in PASSAGES], atol=1e-7)
    for orbit in census.orbits:
        assert orbit.status == Status.CONVERGED
        np.testing.assert_allclose(orbit.energy, 0, atol=1e-12)
        passing = orbit.symmetry == "passing"
        assert np.max(np.abs(np.sin([orbit.theta1, orbit.theta2]))) < 1e-9 or not passing
        half = [
            np.abs(each) for period, _, _, each in PASSAGES if abs(period - orbit.period) < 1e-7
        ]
        assert not passing or all(np.array_equal(np.abs(orbit.turns), each) for each in half)


@pytest.mark.parametrize(
    ("place", "kinetic"),
    [
        ((0, 0), 3.0),
        ((0, 1), 1.0),
        ((1, 0), 0.5),
        pytest.param((1, 1), 2.0, marks=pytest.mark.slow),
    ],
)
def test_signs_add_up_to_the_winding_number(place, kinetic):
    """For a pendulum of unequal rods, through each place, from different intervals."""
    pendulum = dpend.Pendulum(1.0, 0.7, 1.0, 1.6, 1.0)
    scaled = jax.tree.map(float, pendulum)
    counts = set()
    for intervals in (256, 400):
        result = scan_circle(Passages(scaled, place, kinetic, 1.0), 4.0, intervals, Budget(10**9))
        assert result.degree == result.winding
        assert not result.open_cells
        counts.add(len(result.zeros))
    assert len(counts) == 1
    assert counts != {0}


@pytest.mark.slow
def test_fast_motions_are_looked_at_more_often(unit):
    """At E = 30 a scan as coarse as one of releases never decides some cells, whose zeros lie on
    slopes that are flat along the angle.
    """
    census = dpend.find_orbits(unit, energy=30.0, max_period=3.0, symmetry="passing")
    assert census.coverage.suspicious_cells == 0
    assert census.coverage.winding == census.coverage.degree
    with pytest.raises(ValueError, match="max_period must be at most 47"):
        dpend.find_orbits(unit, energy=30.0, max_period=50.0, symmetry="passing")


@pytest.mark.slow
def test_orbits_of_more_energy(unit):
    """At E = 10 all four places are reached, and orbits rotate in many ways; turns by diffrax."""
    census = dpend.find_orbits(unit, energy=10.0, max_period=4.0, symmetry="passing")
    assert (census.coverage.suspicious_cells, census.coverage.slices) == (0, 4)
    assert census.coverage.winding == census.coverage.degree
    assert len({orbit.turns for orbit in census.orbits}) > 10
    for orbit in census.orbits[::5]:
        start = dpend.State(*(float(leaf) for leaf in jax.tree.leaves(orbit.state)))
        end = dpend.reference(unit, start, [float(orbit.period)], error=False).state
        turned = np.array([end.theta1[0] - start.theta1, end.theta2[0] - start.theta2])
        np.testing.assert_allclose(turned, 2 * np.pi * np.array(orbit.turns), atol=1e-7)
