"""Motions against other integrators and invariants; what a result says of itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dpend
from dpend import Pendulum, Scheme, State, Status
from dpend.trajectory import known_value

RELEASE = dpend.released(np.radians(100), np.radians(-30))
RK8 = Scheme("rk8", 4e-3)


def leaves(state):
    return np.array([float(leaf) for leaf in jax.tree.leaves(state)])


def test_scipy_and_diffrax_agree_with_flow(paper):
    """Three integrators, two of them not ours, over 2 s of large swings."""
    field = jax.jit(lambda x: jnp.stack(jax.tree.leaves(dpend.vector_field(paper, State(*x)))))
    scipy = solve_ivp(lambda t, x: np.array(field(x)), (0, 2), leaves(RELEASE), method="DOP853", rtol=1e-13, atol=1e-15)
    ours = dpend.flow(paper, RELEASE, 2.0, Scheme("rk8", 2e-3))
    diffrax = dpend.reference(paper, RELEASE, [2.0])
    np.testing.assert_allclose(leaves(ours), scipy.y[:, -1], rtol=0, atol=2e-10)
    np.testing.assert_allclose(leaves(ours)[:2], [diffrax.state.theta1[-1], diffrax.state.theta2[-1]], atol=2e-10)


def test_time_reversal(paper):
    there = dpend.flow(paper, RELEASE, 1.5, RK8)
    np.testing.assert_allclose(leaves(dpend.flow(paper, there, -1.5, RK8)), leaves(RELEASE), rtol=0, atol=1e-9)
    turned = dpend.flow(paper, State(there.theta1, there.theta2, -there.p1, -there.p2), 1.5, RK8)
    np.testing.assert_allclose(leaves(turned), leaves(RELEASE), rtol=0, atol=1e-9)


def test_angular_momentum_is_kept_without_gravity():
    pendulum = Pendulum(0.3, 0.2, 0.1, 0.4, 0.0)
    start = dpend.momenta(pendulum, 0.4, -1.0, 5.0, -9.0)
    end = dpend.flow(pendulum, start, 3.0, RK8)
    np.testing.assert_allclose(end.p1 + end.p2, start.p1 + start.p2, rtol=1e-13)
    assert abs(end.p1 - start.p1) > 1e-2  # neither is kept alone


def test_a_light_lower_bob_leaves_a_simple_pendulum():
    """m2 -> 0: period 4 K(sin^2(a/2)) sqrt(l/g)."""
    from scipy.special import ellipk

    amplitude = 2.0
    pendulum = Pendulum(1.0, 0.7, 1.0, 1e-9, 1.0)
    quarter = float(ellipk(np.sin(amplitude / 2) ** 2))
    end = dpend.flow(pendulum, dpend.released(amplitude, 0.3), quarter, Scheme("rk8", 2e-3))
    assert abs(end.theta1) < 1e-8


@pytest.mark.parametrize("steps", [100, pytest.param(1500, marks=pytest.mark.slow)])
def test_reverse_mode_agrees_with_forward_mode(paper, steps):
    """Short motions, and long ones that are checkpointed."""
    scheme = Scheme("rk8", 1.0 / steps)

    def end(theta1, theta2, pendulum):
        return dpend.flow(pendulum, dpend.released(theta1, theta2), 1.0, scheme).theta2

    forward = jax.jacfwd(end, (0, 1, 2))(1.1, 0.4, paper)
    reverse = jax.grad(end, (0, 1, 2))(1.1, 0.4, paper)
    np.testing.assert_allclose(jax.tree.leaves(reverse), jax.tree.leaves(forward), rtol=1e-10)
    nudge = 1e-6
    difference = (end(1.1 + nudge, 0.4, paper) - end(1.1 - nudge, 0.4, paper)) / (2 * nudge)
    np.testing.assert_allclose(forward[0], difference, rtol=1e-8)


def test_the_derivative_by_time_is_the_vector_field(paper):
    def end(duration):
        return dpend.flow(paper, RELEASE, duration, RK8).theta1

    slope = dpend.vector_field(paper, dpend.flow(paper, RELEASE, 0.7, RK8)).theta1
    np.testing.assert_allclose([jax.grad(end)(0.7), jax.jit(jax.jacfwd(end))(0.7)], slope, rtol=1e-9)


def test_traced_durations_give_the_same_motion(paper):
    known = dpend.flow(paper, RELEASE, 0.7, RK8)
    traced = jax.jit(lambda duration: dpend.flow(paper, RELEASE, duration, RK8))(0.7)
    np.testing.assert_allclose(leaves(traced), leaves(known), rtol=1e-12)
    many = jax.vmap(lambda duration: dpend.flow(paper, RELEASE, duration, RK8).theta1)(jnp.array([0.3, 0.7]))
    np.testing.assert_allclose(many[1], known.theta1, rtol=1e-13)


def test_numbers_are_known_also_while_tracing():
    known = []

    @jax.jit
    def look(x):
        known.extend(known_value(value) for value in (2, 0.5, np.float64(0.5), np.float32(0.5), np.int64(2), x))
        return x

    look(1.0)
    assert known == [2.0, 0.5, 0.5, 0.5, 2.0, None]
    jax.grad(lambda x: known.append(known_value(x)) or x)(0.25)
    assert known[-1] == 0.25


def test_fold_sees_every_step_once(paper):
    def count(carry, time, dt, state):
        steps, path, _ = carry
        return steps + 1, path + dt * dpend.velocities(paper, state)[0], time

    steps, path, latest = dpend.fold(count, (0, 0.0, 0.0), paper, RELEASE, 1.0, Scheme("rk8", 3e-4))
    end = dpend.flow(paper, RELEASE, 1.0, Scheme("rk8", 3e-4))
    assert steps == 3334
    np.testing.assert_allclose(latest, 1.0, rtol=1e-14)
    # The rectangle rule over the velocity, which ends off by half a step of it.
    half = 0.5 / 3334 * dpend.velocities(paper, end)[0]
    np.testing.assert_allclose(path - half, end.theta1 - RELEASE.theta1, atol=1e-5)


def test_simulate_saves_what_was_asked(paper):
    motion = dpend.simulate(paper, RELEASE, 1.0, step=1e-2, method="rk4", save_every=7)
    np.testing.assert_allclose(motion.time, np.append(np.arange(0, 100, 7), 100) * 1e-2, rtol=1e-14)
    end = dpend.flow(paper, RELEASE, 1.0, Scheme("rk4", 1e-2))
    np.testing.assert_allclose([leaf[-1] for leaf in jax.tree.leaves(motion.state)], leaves(end), rtol=1e-13)
    np.testing.assert_allclose([leaf[0] for leaf in jax.tree.leaves(motion.state)], leaves(RELEASE))
    backwards = dpend.simulate(paper, end, -1.0, step=1e-2, method="rk4", save_every=100)
    np.testing.assert_allclose(backwards.state.theta1[-1], RELEASE.theta1, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("options", [{"step": 1e-3, "method": "rk4"}, {"step": 5e-3}, {"tolerance": 1e-8}])
def test_error_estimate_is_the_error(paper, options):
    motion = dpend.simulate(paper, RELEASE, 2.0, **options)
    exact = dpend.reference(paper, RELEASE, motion.time[1:])
    error = max(
        np.abs(np.array(motion.state.theta1[1:]) - np.array(exact.state.theta1)).max(),
        np.abs(np.array(motion.state.theta2[1:]) - np.array(exact.state.theta2)).max(),
    )
    assert motion.status == Status.CONVERGED
    assert 0.8 < motion.error_estimate / error < 1.25
    assert error < options.get("tolerance", 1.0)


def test_what_went_wrong_is_a_status(paper):
    def status(pendulum, state, duration, **options):
        return Status(int(dpend.simulate(pendulum, state, duration, **options).status))

    fast = dpend.momenta(paper, 0.3, 0.1, 500.0, -500.0)
    assert status(paper, RELEASE, 1.0, step=0.2) == Status.STEP_TOO_LARGE
    assert status(paper, fast, 1.0, step=0.01) == Status.STEP_TOO_LARGE
    assert status(paper, RELEASE, 3.0, step=0.02, method="rk4") == Status.DRIFT_ABOVE_TOLERANCE
    assert status(paper, State(jnp.nan * jnp.ones(()), 0.0, 0.0, 0.0), 1.0, step=0.01) == Status.NONFINITE
    assert status(paper, State(jnp.nan * jnp.ones(()), 0.0, 0.0, 0.0), 1.0) == Status.NONFINITE
    chaotic = dpend.released(np.radians(170), np.pi)
    assert status(paper, chaotic, 20.0, tolerance=1e-6) == Status.BEYOND_HORIZON
    assert status(paper, RELEASE, 1.0, step=5e-3, error=False) == Status.CONVERGED
    assert len({dpend.message(member) for member in Status}) == len(Status)


@pytest.mark.slow
@pytest.mark.parametrize(("duration", "tolerance"), [(2.0, 1e-3), (2.0, 1e-6), (2.0, 1e-9), (5.0, 1e-6)])
def test_a_tolerance_holds_on_the_whole_square(paper, duration, tolerance):
    """Of the releases that are passed as right 99 in 100 are; not many are given up, and those were hard."""
    angles = np.random.default_rng(1).uniform(-np.pi, np.pi, (100, 2))
    passed, right = 0, 0
    for theta1, theta2 in angles:
        release = dpend.released(theta1, theta2)
        motion = dpend.simulate(paper, release, duration, tolerance=tolerance)
        assert motion.status in (Status.CONVERGED, Status.BEYOND_HORIZON)
        exact = dpend.reference(paper, release, [duration])
        if motion.status == Status.CONVERGED and exact.error_estimate < tolerance / 4:
            error = max(
                abs(motion.state.theta1[-1] - exact.state.theta1), abs(motion.state.theta2[-1] - exact.state.theta2)
            )
            passed, right = passed + 1, right + bool(error <= tolerance + exact.error_estimate)
            assert motion.error_estimate <= tolerance
    assert right >= 0.99 * passed
    assert passed >= (85 if duration == 2.0 else 60)


@pytest.mark.slow
def test_a_tolerance_of_a_thousandth_is_met(paper):
    """Energy may drift more than a fixed step is allowed to; the estimate knows the error."""
    release = dpend.released(2.0, -1.0)
    motion = dpend.simulate(paper, release, 2.0, tolerance=1e-3)
    exact = dpend.reference(paper, release, motion.time[1:])
    error = np.max(np.abs(np.array(motion.state.theta2[1:]) - np.array(exact.state.theta2)))
    assert motion.status == Status.CONVERGED
    assert error <= 1e-3
    assert motion.scheme.name == "rk8-circle"


def test_rounding_is_in_the_estimate(paper):
    """The double next to pi stays upright for ever, and the truth is that it falls within 3 s."""
    motion = dpend.simulate(paper, dpend.released(np.pi, np.pi), 4.0, step=1e-2)
    assert float(motion.state.theta1[-1]) == np.pi
    assert motion.status == Status.BEYOND_HORIZON


@pytest.mark.parametrize("method", ["rk4", "rk8-circle"])
def test_a_million_turns_away(paper, method):
    """The same motion to the last place of 6e6 rad; exactly so the reduced start has more digits than the turned."""
    far = 1.0 + 2 * np.pi * 1_000_000
    pi = 4 * np.arctan(np.longdouble(1))
    near = float(np.longdouble(far) - 2_000_000 * pi)
    scheme = Scheme(method, 5e-3)
    turned, reduced = (dpend.flow(paper, dpend.released(angle, 0.4), 1.0, scheme) for angle in (far, near))
    back = float(np.longdouble(float(turned.theta1)) - 2_000_000 * pi)
    assert abs(back - float(reduced.theta1)) < 1e-9
    np.testing.assert_allclose(leaves(turned)[1:], leaves(reduced)[1:], rtol=1e-12)


def test_fast_spin_with_a_step_small_enough():
    """500 rad/s without gravity: the energy and the sum of the momenta stay."""
    pendulum = Pendulum(g=0.0)
    motion = dpend.simulate(pendulum, dpend.momenta(pendulum, 0.3, 0.1, 500.0, 480.0), 0.2, tolerance=1e-9)
    assert motion.status == Status.CONVERGED
    assert motion.energy_drift < 1e-10


def test_reference_takes_as_many_steps_as_it_needs(paper):
    """diffrax stops at 4096 by default."""
    swing = dpend.find_orbit(paper, np.radians(20), branch="in-phase")
    times = float(swing.period) * np.array([1.0, 80.0])
    motion = dpend.reference(paper, swing.state, times)
    assert motion.steps > 4096
    assert motion.status == Status.CONVERGED
    np.testing.assert_allclose(motion.state.theta1, swing.theta1, atol=1e-8)


def test_reference_gives_up_on_what_is_not_finite(paper):
    lost = dpend.reference(paper, State(jnp.asarray(jnp.nan), 0.0, 0.0, 0.0), [1.0])
    assert lost.status == Status.NONFINITE
    backwards = dpend.reference(paper, RELEASE, [-0.5, -1.0])
    np.testing.assert_allclose(backwards.state.theta1[1], dpend.flow(paper, RELEASE, -1.0, RK8).theta1, atol=1e-9)


def test_bad_input_is_refused(paper):
    for options, text in (
        ({"duration": 0.0}, "duration must be a finite number .* other than zero"),
        ({"duration": float("nan")}, "duration must be a finite number"),
        ({"step": 2.0}, "step must not be longer than the motion of 1 s, got 2"),
        ({"step": 0.0}, "step must be a finite positive number"),
        ({"step": 0.1, "tolerance": 1e-6}, "step and tolerance exclude each other"),
        ({"tolerance": -1.0}, "tolerance must be a finite positive number"),
        ({"method": "euler"}, "method must be one of"),
        ({"step": 0.1, "save_every": 0}, "save_every must be an integer of at least 1, got 0"),
    ):
        with pytest.raises(ValueError, match=text):
            dpend.simulate(paper, RELEASE, **({"duration": 1.0} | options))
    with pytest.raises(ValueError, match="tolerance needs a state and a pendulum that are known"):
        jax.grad(lambda x: dpend.simulate(paper, dpend.released(x, 0.1), 1.0, tolerance=1e-6).state.theta1[-1])(1.0)
    for times in ([], [1.0, 0.5], [-1.0, 1.0], [float("nan")]):
        with pytest.raises(ValueError, match="times must be finite and move away from zero"):
            dpend.reference(paper, RELEASE, times)


def test_dataset_has_units_and_degrees(paper):
    data = dpend.simulate(paper, RELEASE, 0.5, step=0.01).to_xarray()
    assert {name: data[name].units for name in ("theta1", "p2", "time", "theta1_deg")} == {
        "theta1": "rad", "p2": "kg m^2/s", "time": "s", "theta1_deg": "degree"
    }  # fmt: skip
    np.testing.assert_allclose(np.radians(data.theta2_deg), data.theta2, rtol=1e-15)


@pytest.mark.parametrize("name", ["rk8", "rk8-circle-rescaled"])
@pytest.mark.parametrize("duration", [np.nan, np.inf])
def test_a_traced_duration_that_is_not_finite_leaves_nothing(paper, name, duration):
    end = jax.jit(lambda time: dpend.flow(paper, RELEASE, time, Scheme(name, 1e-2)))(duration)
    assert np.all(np.isnan(leaves(end)))


def test_reverse_mode_under_jit(paper):
    def angle(theta1):
        return dpend.flow(paper, dpend.released(theta1, 2.0), 0.5, Scheme("rk4", 1e-2)).theta1

    assert abs(jax.jit(jax.grad(angle))(1.0) - jax.jacfwd(angle)(1.0)) < 1e-12


def test_a_reference_that_could_not_end_is_refused_or_says_so(paper):
    with pytest.raises(
        ValueError, match="tolerance must be at least 1e-13, which rounding leaves room for, got 1e-300"
    ):
        dpend.reference(paper, RELEASE, [1.0], tolerance=1e-300)
    with pytest.raises(ValueError, match="most_steps must be an integer of at least 1, got 0"):
        dpend.reference(paper, RELEASE, [1.0], most_steps=0)


@pytest.mark.slow
def test_a_reference_stops_after_the_steps_that_are_allowed(paper):
    motion = dpend.reference(paper, RELEASE, [5.0], most_steps=100, error=False)
    assert (int(motion.status), int(motion.steps)) == (Status.MAX_ITERATIONS, 100)


def test_steps_are_counted_before_they_are_taken(paper):
    with pytest.raises(ValueError, match="step must make at most 9 steps, got 0.1 s, which makes 10: .*most_steps"):
        dpend.simulate(paper, RELEASE, 1.0, step=0.1, most_steps=9)
    with pytest.raises(ValueError, match="step must make at most 1e.12 steps, got 4.94066e-324 s, which makes inf"):
        dpend.flow(paper, RELEASE, 1.0, dpend.Scheme("rk8", 5e-324))
    with pytest.raises(ValueError, match="method must be one of rk4, .* got ''"):
        dpend.simulate(paper, RELEASE, 1.0, step=0.1, method="")
