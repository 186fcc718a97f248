"""The scan: numbers known from elsewhere, an independent integrator, and a count that knows nothing
of cells.
"""

import jax
import numpy as np
import pytest
from elsewhere import FORTY

import dpend
from dpend.catalogue.bicubic import Cells as _Cells
from dpend.catalogue.rows import Releases
from dpend.catalogue.scan import Budget, scan_circle
from dpend.mechanics.units import natural


def scan(pendulum, theta1_deg, max_period, intervals=128):
    """Returns to rest, times in seconds."""
    second = float(np.sqrt(pendulum.l1 / pendulum.g))
    scaled = jax.tree.map(float, natural(pendulum))
    circle = Releases(scaled, float(np.radians(theta1_deg)))
    result = scan_circle(circle, 0.5 * max_period / second, intervals, Budget(10**9))
    return result, np.array([(zero.angle, zero.time * second) for zero in result.zeros]).reshape(
        -1, 2
    )


def test_the_returns_of_forty_degrees(paper):
    """To what the bicubics are good for; `find_orbit` gives the other digits."""
    for intervals in (64, 512):
        result, found = scan(paper, 40, 2.0, intervals)
        np.testing.assert_allclose(
            np.degrees(found[:, 0]), [theta2 for theta2, _ in FORTY], atol=2e-4
        )
        np.testing.assert_allclose(2 * found[:, 1], [period for _, period in FORTY], atol=1e-5)
        assert (result.open_cells, result.winding, result.degree) == ((), 2, 2)


@pytest.mark.parametrize(
    ("theta1", "max_period"),
    [
        (0, 2.0),
        (1e-3, 2.0),
        (65, 2.0),
        pytest.param(100, 3.0, marks=pytest.mark.slow),
        pytest.param(142.03125, 3.0, marks=pytest.mark.slow),
        (175.78125, 2.0),
        (180, 2.0),
    ],
)
def test_signs_add_up_to_the_winding_number(paper, theta1, max_period):
    """A topological identity that a missed or invented return would break, for any number of
    intervals. At 175.78 deg one return lies 20 microseconds within the last time.
    """
    counts = set()
    for intervals in (64, 200):
        result, found = scan(paper, theta1, max_period, intervals)
        assert result.degree == result.winding
        assert not result.open_cells
        counts.add(len(found))
    assert len(counts) == 1


def test_momenta_vanish_at_every_return(paper):
    """By diffrax."""
    _, found = scan(paper, 150, 2.0)
    assert len(found) == 8
    unit = float(paper.m2 * paper.l2 * np.sqrt(paper.g * paper.l2))
    for theta2, time in found:
        last = dpend.reference(
            paper, dpend.released(np.radians(150.0), theta2), [time], error=False
        ).state
        np.testing.assert_allclose([last.p1[0] / unit, last.p2[0] / unit], 0, atol=2e-2)


@pytest.mark.slow
def test_two_returns_meet_where_a_family_turns_back(paper):
    """A family's fold in theta1: two returns on one side of it, at a distance like the root of the
    angle, none on the other. Near it cells are long in time, and intervals alone could be halved
    for ever.
    """
    orbit = dpend.find_orbit(
        paper, np.radians(40.0), guess=(np.radians(-151.107616659), 1.923779041)
    )
    family = dpend.follow_family(paper, orbit, longest_period=2.0)
    fold = min(float(p.orbit.theta1) for p in family.special_points if p.kind == "fold_theta1")
    theta2 = next(
        float(p.orbit.theta2) for p in family.special_points if float(p.orbit.theta1) == fold
    )
    counts, gaps = [], []
    for beyond in (-1e-5, 1e-5, 1e-7):
        _, found = scan(paper, np.degrees(fold + beyond), 2.0)
        near = found[np.abs(found[:, 0] - theta2) < 0.05]
        counts.append((len(near), len(found)))
        gaps.append(np.ptp(near[:, 0]) if len(near) else 0.0)
    (none, fewer), *both = counts
    assert none == 0
    assert both == [(2, fewer + 2)] * 2
    np.testing.assert_allclose(gaps[1] / gaps[2], 10.0, rtol=0.02)


def test_cells_halved_in_time_are_the_same_bicubic():
    net = np.random.default_rng(0).normal(size=(4, 4, 2, 3))
    cells = _Cells(net, np.zeros(3), np.arange(3), np.zeros(3)).halve(np.array([0, 2]), 0)

    def value(net, x, y):
        weights = [
            np.array([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3]) for t in (x, y)
        ]
        return np.einsum("i,j,ijcn->cn", *weights, net)

    first, second = cells.net[..., :2], cells.net[..., 2:]
    np.testing.assert_allclose(value(first, 0.3, 0.6), value(net, 0.3, 0.3)[:, [0, 2]], atol=1e-14)
    np.testing.assert_allclose(value(second, 0.3, 0.6), value(net, 0.3, 0.8)[:, [0, 2]], atol=1e-14)
    np.testing.assert_array_equal(cells.start, [0, 0, 0.5, 0.5])
