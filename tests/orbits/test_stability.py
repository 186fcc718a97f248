"""Floquet stability: structure of the matrices, agreement of three routes, and reference values."""

import jax
import numpy as np
import pytest

import dpend
from dpend.methods.scheme import Scheme
from dpend.orbits import stability

SCHEME = Scheme("rk8", 2e-3)
J = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.eye(2), np.zeros((2, 2))]])
TRANSITION = jax.jit(stability.transition, static_argnames="scheme")


def half_from_quarter(quarter):
    """Phi(T/2) of a centred orbit from Q = Phi(T/4): N Q^-1 N Q, with the symplectic inverse."""
    a, b, c, d = quarter[:2, :2], quarter[:2, 2:], quarter[2:, :2], quarter[2:, 2:]
    return np.block([[d.T, b.T], [c.T, a.T]]) @ quarter


def kappa_of_centred(quarter):
    return 2 * (1 - 2 * np.sum(quarter[:2, :2] * quarter[2:, 2:])) ** 2 - 1


def kappa_of_brake(half):
    return 1 + 2 * np.sum(half[:2, 2:] * half[2:, :2])


def kappa_of_odd(half):
    return 2 * ((-np.trace(half) - 2) / 2) ** 2 - 1


def matrix_over(orbit, share):
    duration = float(orbit.period) * share
    steps = SCHEME.steps(duration)
    return TRANSITION(orbit.pendulum, orbit.state, duration / steps, steps, SCHEME)[1]


@pytest.fixture(scope="module")
def orbits(paper):
    return [
        dpend.find_orbit(paper, np.radians(angle), branch=branch)
        for angle, branch in (
            (40, "in-phase"),
            (40, "anti-phase"),
            (90, "anti-phase"),
            (140, "in-phase"),
        )
    ]


def test_transition_matrices_are_symplectic(orbits):
    for orbit in orbits:
        matrix = np.array(matrix_over(orbit, 1.0))
        scale = np.abs(matrix).max() ** 2
        np.testing.assert_allclose(matrix.T @ J @ matrix, J, atol=1e-12 * scale)
        assert abs(np.linalg.det(matrix) - 1) < 1e-11 * scale


def test_quarter_half_and_whole_period_agree(orbits):
    for orbit in orbits:
        quarter, half, whole = (np.array(matrix_over(orbit, share)) for share in (0.25, 0.5, 1.0))
        np.testing.assert_allclose(
            half_from_quarter(quarter), half, atol=1e-10 * np.abs(half).max()
        )
        routes = [
            kappa_of_centred(quarter),
            kappa_of_brake(half),
            kappa_of_odd(half),
            (np.trace(whole) - 2) / 2,
            stability.stability_of(quarter[None], "centred")[1],
            stability.stability_of(half[None], "brake")[1],
            stability.stability_of(half[None], "odd")[1],
            orbit.kappa,
        ]
        np.testing.assert_allclose(routes, routes[0], rtol=1e-8, atol=1e-10)


@pytest.mark.slow
def test_monodromy_has_the_flow_as_an_eigenvector_and_powers_for_covers(orbits):
    for orbit in orbits[:2]:
        period = float(orbit.period)
        once = np.array(dpend.monodromy(orbit.pendulum, orbit.state, period, SCHEME))
        twice = np.array(dpend.monodromy(orbit.pendulum, orbit.state, 2 * period, SCHEME))
        np.testing.assert_allclose(twice, once @ once, atol=1e-10 * np.abs(twice).max())
        field = np.array(jax.tree.leaves(dpend.vector_field(orbit.pendulum, orbit.state)))
        np.testing.assert_allclose(once @ field, field, atol=1e-10 * np.abs(once).max())
        apart = np.abs(
            np.array(dpend.multipliers(orbit.kappa))[:, None] - np.linalg.eigvals(once)[None, :]
        )
        # The trivial pair is a Jordan block: it splits like the square root of the error.
        assert apart.min(axis=1).max() < 1e-4
        assert apart.min(axis=0).max() < 1e-4


def test_multipliers_come_in_pairs():
    for kappa in (-1e9, -3.0, -1.0, -0.3, 0.0, 1.0, 7.0, 1e15):
        one, _, large, small = np.array(dpend.multipliers(kappa))
        assert one == 1
        assert abs(large * small - 1) < 1e-15
        assert abs(large) >= 1 - 1e-15
        assert abs((large + small) / 2 - kappa) < 1e-15 * max(1, abs(kappa))


def test_classes():
    classes = [dpend.stability_class(kappa) for kappa in (0.99, 1.01, -1.01, 1.0, float("nan"))]
    assert classes == ["elliptic", "hyperbolic", "inverse hyperbolic", "parabolic", "unknown"]


def test_small_swings_have_the_multipliers_of_the_other_mode(paper):
    """The limit of small amplitude: kappa = cos(omega_other T)."""
    slow, fast = dpend.normal_modes(paper)
    for branch, mode, other in (("in-phase", slow, fast), ("anti-phase", fast, slow)):
        orbit = dpend.find_orbit(paper, 1e-6, branch=branch)
        assert abs(orbit.kappa - np.cos(other.frequency * mode.period)) < 1e-10
