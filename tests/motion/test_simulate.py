"""Motions against other integrators and invariants; what a result says of itself."""

import extended
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dpend
from dpend import Pendulum, Scheme, State, Status
from dpend.checks import known_value

RELEASE = dpend.released(np.radians(100), np.radians(-30))
RK8 = Scheme("rk8", 4e-3)


def leaves(state):
    return np.array([float(leaf) for leaf in jax.tree.leaves(state)])


def test_scipy_and_diffrax_agree_with_flow(paper):
    """Three integrators, two of them not ours, over 2 s of large swings."""
    field = jax.jit(lambda x: jnp.stack(jax.tree.leaves(dpend.vector_field(paper, State(*x)))))
    scipy = solve_ivp(
        lambda t, x: np.array(field(x)),
        (0, 2),
        leaves(RELEASE),
        method="DOP853",
        rtol=1e-13,
        atol=1e-15,
    )
    ours = dpend.flow(paper, RELEASE, 2.0, Scheme("rk8", 2e-3))
    diffrax = dpend.reference(paper, RELEASE, [2.0])
    np.testing.assert_allclose(leaves(ours), scipy.y[:, -1], rtol=0, atol=2e-10)
    np.testing.assert_allclose(
        leaves(ours)[:2], [diffrax.state.theta1[-1], diffrax.state.theta2[-1]], atol=2e-10
    )


def test_time_reversal(paper):
    there = dpend.flow(paper, RELEASE, 1.5, RK8)
    np.testing.assert_allclose(
        leaves(dpend.flow(paper, there, -1.5, RK8)), leaves(RELEASE), rtol=0, atol=1e-9
    )
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
    np.testing.assert_allclose(
        [jax.grad(end)(0.7), jax.jit(jax.jacfwd(end))(0.7)], slope, rtol=1e-9
    )


def test_traced_durations_give_the_same_motion(paper):
    known = dpend.flow(paper, RELEASE, 0.7, RK8)
    traced = jax.jit(lambda duration: dpend.flow(paper, RELEASE, duration, RK8))(0.7)
    np.testing.assert_allclose(leaves(traced), leaves(known), rtol=1e-12)
    many = jax.vmap(lambda duration: dpend.flow(paper, RELEASE, duration, RK8).theta1)(
        jnp.array([0.3, 0.7])
    )
    np.testing.assert_allclose(many[1], known.theta1, rtol=1e-13)


def test_numbers_are_known_also_while_tracing():
    known = []

    @jax.jit
    def look(x):
        known.extend(
            known_value(value)
            for value in (2, 0.5, np.float64(0.5), np.float32(0.5), np.int64(2), x)
        )
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
    np.testing.assert_allclose(
        [leaf[-1] for leaf in jax.tree.leaves(motion.state)], leaves(end), rtol=1e-13
    )
    np.testing.assert_allclose([leaf[0] for leaf in jax.tree.leaves(motion.state)], leaves(RELEASE))
    backwards = dpend.simulate(paper, end, -1.0, step=1e-2, method="rk4", save_every=100)
    np.testing.assert_allclose(backwards.state.theta1[-1], RELEASE.theta1, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("options", [{"step": 1e-3, "method": "rk4"}, {"step": 5e-3}])
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
    assert (
        status(paper, State(jnp.nan * jnp.ones(()), 0.0, 0.0, 0.0), 1.0, step=0.01)
        == Status.NONFINITE
    )
    assert status(paper, State(jnp.nan * jnp.ones(()), 0.0, 0.0, 0.0), 1.0) == Status.NONFINITE
    chaotic = dpend.released(np.radians(170), np.pi)
    assert status(paper, chaotic, 20.0, tolerance=1e-6) == Status.BEYOND_HORIZON
    assert (
        status(paper, dpend.released(0.3, 0.2), 2.0, tolerance=1e-15)
        == Status.TOLERANCE_NOT_REACHED
    )
    assert status(paper, RELEASE, 1.0, step=5e-3, error=False) == Status.CONVERGED
    assert len({dpend.message(member) for member in Status}) == len(Status)


def test_the_sentence_tells_the_estimate_and_the_wish(paper):
    """What is refused at an estimate of 5e-9 rad is so because 1e-9 is the default."""
    hard = dpend.released(np.radians(170), np.pi)
    motion = dpend.simulate(paper, hard, 7.5)
    assert motion.status == Status.BEYOND_HORIZON
    estimate = f"{float(motion.error_estimate):.1e} rad"
    assert motion.message.startswith(
        f"The error estimate, {estimate}, is above the tolerance of 1e-09 rad, which is the "
        f"default: "
        "the motion is chaotic, and errors of rounding have grown so far; shorten it or ask for a "
        "tolerance of "
    )
    enough = float(motion.message.split("tolerance of ")[-1].split(" rad")[0])
    assert dpend.simulate(paper, hard, 7.5, tolerance=enough).message == "Converged."
    tame = dpend.simulate(paper, dpend.released(0.3, 0.2), 2.0, tolerance=1e-15)
    assert (
        "is above the tolerance of 1e-15 rad: no step that was tried brings it lower; ask for a "
        "tolerance of" in tame.message
    )
    drifted = dpend.simulate(paper, hard, 20.0, step=2e-3)
    assert "is above 0.1 rad, where it has parted from the true motion" in drifted.message
    assert drifted.message.endswith("; shorten it.")


def error_of(motion, pendulum, state):
    """The larger angle's by diffrax, at ten of the saved times, and by how much that may be off
    [rad].
    """
    rows = np.linspace(motion.time.size // 10, motion.time.size - 1, 10).astype(
        int
    )  # one shape, one program
    exact = dpend.reference(pendulum, state, np.asarray(motion.time)[rows])
    angles = (motion.state.theta1, exact.state.theta1), (motion.state.theta2, exact.state.theta2)
    off = max(
        float(np.max(np.abs(np.asarray(ours)[rows] - np.asarray(theirs))))
        for ours, theirs in angles
    )
    return off, float(exact.error_estimate)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("duration", "tolerance"), [(2.0, 1e-3), (2.0, 1e-6), (2.0, 1e-9), (5.0, 1e-6), (5.0, 1e-9)]
)
def test_a_tolerance_holds_on_the_whole_square(paper, duration, tolerance):
    """Of the releases that are passed as right 99 in 100 are; hardly any are given up."""
    angles = np.random.default_rng(1).uniform(-np.pi, np.pi, (100, 2))
    passed, right = 0, 0
    for theta1, theta2 in angles:
        release = dpend.released(theta1, theta2)
        motion = dpend.simulate(paper, release, duration, tolerance=tolerance)
        assert motion.status in (
            Status.CONVERGED,
            Status.BEYOND_HORIZON,
            Status.TOLERANCE_NOT_REACHED,
        )
        if motion.status == Status.CONVERGED:
            assert motion.error_estimate <= tolerance
            error, unknown = error_of(motion, paper, release)
            passed, right = passed + 1, right + bool(error <= tolerance + unknown)
    assert right >= 0.99 * passed
    assert passed >= {(5.0, 1e-6): 90, (5.0, 1e-9): 65}.get((duration, tolerance), 99)


@pytest.mark.slow
@pytest.mark.parametrize(("mass", "length"), [(1e4, 1.0), (1e-6, 1e-6), (1.0, 1e-6)])
def test_growth_of_too_long_a_step_ends_no_search(mass, length):
    """A step that does not resolve a light rod makes its tangents grow: these can be computed to
    1e-9 rad.
    """
    pendulum = Pendulum(m2=0.1 * mass, l2=0.2 * length)
    slow, fast = (float(mode.frequency) for mode in dpend.normal_modes(pendulum))
    release, duration = dpend.released(1.0, 0.4), min(np.pi / slow, 2000 / fast)
    motion = dpend.simulate(pendulum, release, duration, tolerance=1e-9)
    assert motion.message == "Converged."
    error, unknown = error_of(motion, pendulum, release)
    assert error < 1e-9 + unknown


@pytest.mark.slow
def test_hardly_any_that_is_refused_is_right(paper):
    """Of the first ten refused over 5 s at each tolerance at most one in five, by long double."""
    if not extended.is_extended():
        pytest.skip("long double is double here")
    times, right = np.linspace(0.5, 5.0, 10), 0
    for tolerance in (1e-12, 1e-11, 1e-10):
        refused = 0
        for theta1, theta2 in np.random.default_rng(1).uniform(-np.pi, np.pi, (100, 2)):
            release = dpend.released(theta1, theta2)
            motion = dpend.simulate(paper, release, times=times, tolerance=tolerance)
            if motion.status != Status.CONVERGED and refused < 10:
                start = theta1, theta2, 0.0, 0.0
                exact = extended.motion((0.2, 0.2, 0.1, 0.1, 9.8), start, times)
                ours = np.stack([motion.state.theta1, motion.state.theta2], axis=1)
                refused += 1
                right += bool(np.max(np.abs(ours - exact[:, :2])) <= tolerance)
        assert refused == 10
    assert right <= 6


# Each was passed as right by version 0.1.0 or on the way from it, 2.5 to 7 times the tolerance or
# estimate off.
SHORT_AND_LIGHT = Pendulum(0.2, 0.0034391523589411225, 0.1, 0.0011697266598131191)
HIDDEN = [
    (Pendulum(), (2.4800729058617197, -0.4855839947738212), 2.0, 1e-11),
    (Pendulum(), (1.8431335863742246, -1.1399816116213168), 5.0, 1e-10),
    (
        SHORT_AND_LIGHT,
        (-0.9589484415305338, 1.7714192154162474),
        2.297582076291769,
        2.3129797700696147e-09,
    ),
]


@pytest.mark.slow
@pytest.mark.parametrize(("pendulum", "release", "duration", "tolerance"), HIDDEN)
def test_errors_do_not_hide(pendulum, release, duration, tolerance):
    """A truncation error may cancel a displaced start's, and two sums of rounding errors may come
    close by chance.
    """
    if not extended.is_extended():
        pytest.skip("long double is double here")
    motion = dpend.simulate(pendulum, dpend.released(*release), duration, tolerance=tolerance)
    rows = np.linspace(1, motion.time.size - 1, 20).astype(int)
    numbers = [float(leaf) for leaf in jax.tree.leaves(pendulum)]
    exact = extended.motion(
        numbers, (*release, 0.0, 0.0), np.asarray(motion.time)[rows], longest=2e-3
    )
    ours = np.stack(
        [np.asarray(motion.state.theta1)[rows], np.asarray(motion.state.theta2)[rows]], axis=1
    )
    error = float(np.max(np.abs(ours - exact[:, :2])))
    assert motion.status != Status.CONVERGED or error <= tolerance
    # One estimate in a hundred is less than a fifth of the error.
    assert error < 10 * motion.error_estimate


def random_pendulum(random):
    """Lengths and masses as different as a thousand to one, a release or a start in motion, two
    slow periods.
    """
    pendulum = Pendulum(
        0.2, 0.2 * 10 ** random.uniform(-3, 3), 0.1, 0.1 * 10 ** random.uniform(-3, 3)
    )
    slow, fast = (float(mode.frequency) for mode in dpend.normal_modes(pendulum))
    rates = slow * random.normal(size=2) * random.integers(2)
    state = dpend.momenta(pendulum, *random.uniform(-np.pi, np.pi, 2), *rates)
    return pendulum, state, min(4 * np.pi / slow, 100 / fast)


@pytest.mark.slow
def test_a_tolerance_holds_for_other_pendulums():
    """By diffrax, as far as it knows its own error: none off by more than twice the tolerance, one
    in 100 above it.
    """
    random = np.random.default_rng(3)
    passed, right, most = 0, 0, 100
    for _ in range(most):
        pendulum, state, duration = random_pendulum(random)
        tolerance = 10 ** random.uniform(-9, -3)
        motion = dpend.simulate(pendulum, state, duration, tolerance=tolerance)
        assert motion.status in (
            Status.CONVERGED,
            Status.BEYOND_HORIZON,
            Status.TOLERANCE_NOT_REACHED,
        )
        if motion.status != Status.CONVERGED:
            continue
        error, unknown = error_of(motion, pendulum, state)
        if unknown < tolerance / 2:
            assert error < 2 * tolerance + unknown
            passed, right = passed + 1, right + bool(error <= tolerance + unknown)
    assert right >= 0.99 * passed
    assert passed > 0.7 * most


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", [1e-7, 1e-10, 1e-13])
def test_reference_knows_its_error(paper, tolerance):
    """By long double: none above the estimate, which is at most some hundred times larger."""
    if not extended.is_extended():
        pytest.skip("long double is double here")
    random = np.random.default_rng(4)
    for theta1, theta2 in random.uniform(-np.pi, np.pi, (20, 2)):
        found = dpend.reference(
            paper, dpend.released(theta1, theta2), [0.5, 1.0, 2.0], tolerance=tolerance
        )
        exact = extended.motion(
            (0.2, 0.2, 0.1, 0.1, 9.8), (theta1, theta2, 0.0, 0.0), [0.5, 1.0, 2.0]
        )
        ours = np.stack([np.asarray(found.state.theta1), np.asarray(found.state.theta2)], axis=1)
        assert float(np.max(np.abs(ours - exact[:, :2]))) < found.error_estimate < 2e-3


@pytest.mark.slow
@pytest.mark.parametrize("make", ["step", "reference"])
def test_an_estimate_is_never_below_rounding_times_growth(paper, make):
    for theta1, theta2 in np.random.default_rng(5).uniform(-np.pi, np.pi, (10, 2)):
        release = dpend.released(theta1, theta2)
        if make == "reference":
            motion = dpend.reference(paper, release, [3.0])
        else:
            motion = dpend.simulate(paper, release, 3.0, step=1e-3)
        tangents = State(*np.eye(4)[:, :2])
        _, moved = dpend.fold(
            _untouched, 0.0, paper, release, 3.0, Scheme("rk8-circle", 1e-3), tangents=tangents
        )
        growth = max(np.linalg.norm(moved.theta1), np.linalg.norm(moved.theta2))
        assert motion.error_estimate > 0.99 * min(np.pi, np.finfo(float).eps * growth)


def _untouched(carry, time, dt, state, tangents):
    return carry, tangents


@pytest.mark.slow
def test_a_tolerance_of_a_thousandth_is_met(paper):
    """Energy may drift more than a fixed step is allowed to; the estimate knows the error."""
    release = dpend.released(2.0, -1.0)
    motion = dpend.simulate(paper, release, 2.0, tolerance=1e-3)
    exact = dpend.reference(paper, release, motion.time[1:])
    error = np.max(np.abs(np.array(motion.state.theta2[1:]) - np.array(exact.state.theta2)))
    assert motion.status == Status.CONVERGED
    assert error <= 1e-3
    assert motion.method == "collocation"


def test_rounding_is_in_the_estimate(paper):
    """The double next to pi stays upright for ever, and the truth is that it falls within 3 s."""
    motion = dpend.simulate(paper, dpend.released(np.pi, np.pi), 4.0, step=1e-2)
    assert float(motion.state.theta1[-1]) == np.pi
    assert motion.status == Status.BEYOND_HORIZON


@pytest.mark.parametrize("method", ["rk4", "rk8-circle"])
def test_a_million_turns_away(paper, method):
    """The same motion to the last place of 6e6 rad; exactly so the reduced start has more digits
    than the turned.
    """
    far = 1.0 + 2 * np.pi * 1_000_000
    pi = 4 * np.arctan(np.longdouble(1))
    near = float(np.longdouble(far) - 2_000_000 * pi)
    scheme = Scheme(method, 5e-3)
    turned, reduced = (
        dpend.flow(paper, dpend.released(angle, 0.4), 1.0, scheme) for angle in (far, near)
    )
    back = float(np.longdouble(float(turned.theta1)) - 2_000_000 * pi)
    assert abs(back - float(reduced.theta1)) < 1e-9
    np.testing.assert_allclose(leaves(turned)[1:], leaves(reduced)[1:], rtol=1e-12)


def test_fast_spin_with_a_step_small_enough():
    """500 rad/s without gravity: the energy and the sum of the momenta stay."""
    pendulum = Pendulum(g=0.0)
    motion = dpend.simulate(
        pendulum, dpend.momenta(pendulum, 0.3, 0.1, 500.0, 480.0), 0.2, tolerance=1e-9
    )
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
    np.testing.assert_allclose(
        backwards.state.theta1[1], dpend.flow(paper, RELEASE, -1.0, RK8).theta1, atol=1e-9
    )


def test_bad_input_is_refused(paper):
    for options, text in (
        ({"duration": 0.0}, "duration must be a finite number .* other than zero"),
        ({"duration": float("nan")}, "duration must be a finite number"),
        ({"step": 2.0}, "step must not be longer than the motion of 1 s, got 2"),
        ({"step": 0.0}, "step must be a finite positive number"),
        ({"step": 0.1, "tolerance": 1e-6}, "step and tolerance exclude each other"),
        ({"tolerance": -1.0}, "tolerance must be a finite positive number"),
        ({"step": 0.1, "method": "euler"}, "method must be one of"),
        ({"step": 0.1, "save_every": 0}, "save_every must be an integer of at least 1, got 0"),
        ({"method": "rk4"}, "method must come with a step, got 'rk4' without one"),
        ({"times": [1.0, 0.5]}, "times must be finite and move away from zero"),
        ({"times": [0.5, 1.5]}, "times must lie between zero and the duration of 1 s"),
        ({"times": [1.0], "save_every": 2}, "times and save_every exclude each other"),
        ({"times": [1.0], "step": 0.1}, "times and step exclude each other"),
        ({"duration": None}, "duration must be given where times are not"),
    ):
        with pytest.raises(ValueError, match=text):
            dpend.simulate(paper, RELEASE, **({"duration": 1.0} | options))
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
        ValueError,
        match="tolerance must be at least 1e-13, which rounding leaves room for, got 1e-300",
    ):
        dpend.reference(paper, RELEASE, [1.0], tolerance=1e-300)
    with pytest.raises(ValueError, match="most_steps must be an integer of at least 1, got 0"):
        dpend.reference(paper, RELEASE, [1.0], most_steps=0)


@pytest.mark.slow
def test_a_reference_stops_after_the_steps_that_are_allowed(paper):
    motion = dpend.reference(paper, RELEASE, [5.0], most_steps=100, error=False)
    assert (int(motion.status), int(motion.steps)) == (Status.MAX_ITERATIONS, 100)


def test_steps_are_counted_before_they_are_taken(paper):
    with pytest.raises(
        ValueError, match="step must make at most 9 steps, got 0.1 s, which makes 10: .*most_steps"
    ):
        dpend.simulate(paper, RELEASE, 1.0, step=0.1, most_steps=9)
    with pytest.raises(
        ValueError, match="step must make at most 1e.12 steps, got 4.94066e-324 s, which makes inf"
    ):
        dpend.flow(paper, RELEASE, 1.0, dpend.Scheme("rk8", 5e-324))
    with pytest.raises(ValueError, match="method must be one of rk4, .* got ''"):
        dpend.simulate(paper, RELEASE, 1.0, step=0.1, method="")
