"""Gradients known exactly, a wrong one, and how long those of a chaotic motion hold."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpend
from dpend import Scheme, State, Status

CHAOTIC = np.radians((170.0, 180.0))


def test_a_tree_of_parameters_with_a_known_gradient():
    parameters = {"x": 0.0, "y": np.array([0.5, -2.0]), "z": 3}

    @jax.jit
    def loss(p):
        return jnp.sin(p["x"]) + jnp.sum(p["y"] ** 3) + 5 * p["z"]

    check = dpend.check_gradient(loss, parameters, tolerance=1e-9)
    assert check.status == Status.CONVERGED, check.message
    for tree, close in ((check.forward, 1e-15), (check.reverse, 1e-15), (check.difference, 1e-10)):
        np.testing.assert_allclose(tree["x"], 1, rtol=close)
        np.testing.assert_allclose(tree["y"], [0.75, 12], rtol=close)
        np.testing.assert_allclose(tree["z"], 5, rtol=close)
    # The estimates hold, and are no excuses.
    missed = np.abs(check.difference["y"] - np.array([0.75, 12]))
    assert np.all(missed <= check.difference_error["y"])
    assert check.difference_noise < 1e-11
    flat = dpend.check_gradient(lambda x: 0 * x + 3.0, 0.7)
    assert (flat.status, flat.disagreement) == (Status.CONVERGED, 0)


def test_a_wrong_rule_is_told_with_its_size():
    @jax.custom_jvp
    def sine(x):
        return jnp.sin(x)

    sine.defjvp(
        lambda primals, tangents: (sine(*primals), 1.0001 * jnp.cos(primals[0]) * tangents[0])
    )
    check = dpend.check_gradient(sine, 0.7)
    assert check.status == Status.DISAGREEMENT
    np.testing.assert_allclose(check.disagreement, 1e-4, rtol=1e-3)
    assert dpend.check_gradient(sine, 0.7, tolerance=1e-3).status == Status.CONVERGED


def test_a_pole():
    assert dpend.check_gradient(jnp.sqrt, 0.0).status == Status.NONFINITE


@pytest.mark.slow
def test_forward_only(paper):
    """Through a loop of unknown length there is no reverse mode."""

    state, scheme = dpend.released(0.3, 0.4), Scheme("rk4", 1e-2)
    end = jax.jit(lambda duration: dpend.flow(paper, state, duration, scheme))

    def loss(duration):
        return end(duration).theta1

    check = dpend.check_gradient(loss, 0.505, reverse=False)
    assert np.isnan(check.reverse)
    rate, _ = dpend.velocities(paper, end(0.505))
    np.testing.assert_allclose(check.forward, rate, rtol=1e-5)
    with pytest.raises(ValueError, match="Reverse-mode"):
        dpend.check_gradient(loss, 0.505)


def end_angle(paper, duration, scheme, state):
    return dpend.flow(paper, state, duration, scheme).theta1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("duration", "status"), [(1.0, Status.CONVERGED), (10.0, Status.BEYOND_HORIZON)]
)
def test_a_chaotic_motion_is_believed_up_to_its_horizon(paper, duration, status):
    scheme, state = Scheme("rk4", 2e-3), dpend.released(*CHAOTIC)
    loss = jax.jit(partial(end_angle, paper, duration, scheme))
    check = dpend.check_gradient(
        loss, state, motion=(paper, state, duration, scheme), reverse=False
    )
    assert check.status == status, check.message
    assert (check.disagreement < 1e-6) == (status == Status.CONVERGED)
    assert (check.horizon.horizon < duration) == (status == Status.BEYOND_HORIZON)


@pytest.mark.slow
def test_the_horizon_of_the_papers_chaotic_motion(paper):
    """A coarse step loses; the growth is the motion's own, whatever the step."""
    state = dpend.released(*CHAOTIC)
    found = {
        step: dpend.gradient_horizon(paper, state, 12.8, Scheme("rk8", step))
        for step in (5e-3, 2e-3)
    }
    assert 5 < found[5e-3].horizon < 8 < found[2e-3].horizon < 10
    for one in found.values():
        assert one.status == Status.BEYOND_HORIZON
        here = np.searchsorted(one.time, one.horizon)
        assert one.error[here] <= 1e-3 < one.error[here + 1]
    early = found[2e-3].time < 5
    np.testing.assert_allclose(found[5e-3].growth[early], found[2e-3].growth[early], rtol=1e-3)


@pytest.mark.slow
def test_the_error_is_what_another_integrator_differs_by(paper):
    """Tangents by another method at a fifth of the step: what they differ by is the error that was
    told.
    """
    state, scheme = dpend.released(*CHAOTIC), Scheme("rk8", 2e-3)
    found = dpend.gradient_horizon(paper, state, 12.0, scheme)
    basis = State(*jnp.eye(4)[:, :2])  # released a little elsewhere

    def angles(duration, scheme):
        _, ends = dpend.fold(_kept, 0.0, paper, state, duration, scheme, tangents=basis)
        return np.stack([ends.theta1, ends.theta2])

    for index in (100, 140, 180):
        duration = float(found.time[index])
        one, other = (
            angles(duration, Scheme(name, step, False))
            for name, step in (("rk8", 2e-3), ("rk8-circle", 4e-4))
        )
        parted = np.linalg.norm(one - other) / np.linalg.norm(other)
        assert 0.02 < parted / float(found.error[index]) < 20


def _kept(carry, time, dt, state, tangents):
    return carry, tangents


def test_a_regular_motion_has_no_horizon(paper):
    found = dpend.gradient_horizon(paper, dpend.released(0.3, 0.4), 12.0, Scheme("rk8", 2e-3))
    assert found.status == Status.CONVERGED
    assert found.horizon == 12.0
    assert found.error[-1] < 1e-12
    coarse = dpend.gradient_horizon(
        paper, dpend.released(0.3, 0.4), 12.0, Scheme("rk8", 4e-2), tolerance=1e-9
    )
    assert coarse.horizon < 12.0


@pytest.mark.slow
def test_implicit_derivatives_of_orbits_and_families(paper):
    """The root's derivatives against orbits solved again; along a family in reverse, too."""

    def period(pendulum):
        return dpend.find_orbit(pendulum, 1.0, branch="in-phase", error=False).period

    orbit = dpend.check_gradient(period, paper, tolerance=1e-9, reverse=False)
    assert orbit.status == Status.CONVERGED, orbit.message
    family = dpend.follow_family(paper, "in-phase")
    along = dpend.check_gradient(lambda theta1: family.at(theta1).kappa, 0.7, tolerance=1e-8)
    assert along.status == Status.CONVERGED, along.message


@pytest.mark.parametrize(
    ("request_", "text"),
    [
        (
            {"loss": lambda x: jnp.stack([x, x])},
            "loss must give a real scalar, got float64 of shape",
        ),
        ({"parameters": np.nan}, "parameters must be one finite number or more"),
        ({"parameters": {}}, "parameters must be one finite number or more"),
        ({"parameters": "x"}, "parameters must be finite numbers"),
        ({"tolerance": 0.0}, "tolerance must be a finite positive number"),
    ],
)
def test_bad_requests_are_refused(request_, text):
    with pytest.raises(ValueError, match=text):
        dpend.check_gradient(**({"loss": jnp.sin, "parameters": 0.7} | request_))


def test_bad_motions_are_refused(paper):
    state = dpend.released(0.3, 0.4)
    for duration, scheme, text in (
        (np.inf, Scheme("rk8", 1e-2), "duration must be a finite number"),
        (0.0, Scheme("rk8", 1e-2), "duration must not be zero"),
        (0.001, Scheme("rk8", 1e-2), "step must not be longer than the motion"),
        (1.0, Scheme("rk8-circle-rescaled", 1e-2), "scheme must take even steps"),
    ):
        with pytest.raises(ValueError, match=text):
            dpend.gradient_horizon(paper, state, duration, scheme)
