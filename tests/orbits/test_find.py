"""Orbits against independently computed numbers, other integrators, scaling laws and finite
differences.
"""

import itertools
from functools import partial

import extended
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import root

import dpend
from dpend import Pendulum, Status
from dpend.mechanics.units import natural
from dpend.orbits import search
from dpend.orbits.arc import MOST_SEGMENT_STEPS

# The eight orbits of the paper's pendulum: request, theta2 [deg], period [s]; of the last two,
# theta1 = +-theta2.
PAPER = [
    ({"theta1": 40, "branch": "in-phase"}, 49.066544773743, 1.2127563331460),
    ({"theta1": 10, "branch": "in-phase"}, 14.036368411360, 1.1757686075828),
    ({"theta1": 40, "branch": "anti-phase"}, -51.139513966294, 0.7544188658525),
    ({"theta1": 10, "branch": "anti-phase"}, -14.080998145069, 0.5119227306883),
    ({"theta1": 64.3, "branch": "in-phase"}, 64.323444982221, 1.2553491280938),
    ({"theta1": 63.95, "branch": "anti-phase"}, -63.923212027994, 0.9203724612198),
    ({"theta1": 64.3, "ratio": 1}, 64.342841896400, 1.2554337069383),
    ({"theta1": 63.95, "ratio": -1}, -63.917323040280, 0.9201962468273),
]
# m = l = g = 1: theta1, theta2, T, kappa.
UNIT = [
    ("in-phase", 0.3, 0.4145903934, 8.2701040150, -0.93693692785),
    ("in-phase", 1.5, 1.2651907163, 9.1563354486, -0.85091323136),
    ("in-phase", 2.4, 1.9340243889, 11.6874860507, 118.65548805),
    ("anti-phase", 0.3, -0.4186391707, 3.8998166875, -0.99101252677),
    ("anti-phase", 1.5, -1.1180563973, 7.1758496508, 6.5959253218),
    ("anti-phase", 2.7, -2.6470210045, 11.3914942129, 414.94007723),
]
# At 40 deg: theta2 [deg] and period [s] of the eight brake orbits below 2 s.
FORTY = [
    (-51.139513966, 0.754418866, "centred"),
    (-157.229758666, 0.789605931, "centred"),
    (-4.570287296, 1.174420237, None),
    (49.066544774, 1.212756333, "centred"),
    (119.491215917, 1.283263044, None),
    (177.345987867, 1.451903639, "centred"),
    (-151.107616659, 1.923779041, None),
    (-152.332774219, 1.970160641, None),
]


def find(pendulum, theta1, **request):
    """`find_orbit` with the angle in degrees, converged."""
    orbit = dpend.find_orbit(pendulum, np.radians(theta1), **request)
    assert orbit.status == Status.CONVERGED, dpend.message(orbit.status)
    return orbit


@pytest.mark.parametrize(("request_", "theta2", "period"), PAPER)
def test_the_papers_orbits(paper, request_, theta2, period):
    orbit = find(paper, **request_)
    assert abs(np.degrees(orbit.theta2) - theta2) < 1e-11
    assert abs(orbit.period - period) < 1e-12
    angle_error, period_error = orbit.error_estimate
    assert np.degrees(angle_error) < 1e-11
    assert period_error < 1e-12
    assert 3 <= orbit.iterations <= 8
    np.testing.assert_allclose(
        [orbit.dual.theta1, orbit.dual.theta2], [-orbit.theta1, -orbit.theta2], rtol=1e-15
    )


@pytest.mark.parametrize(("branch", "theta1", "theta2", "period", "kappa"), UNIT)
def test_reference_values_in_natural_units(unit, branch, theta1, theta2, period, kappa):
    orbit = dpend.find_orbit(unit, theta1, branch=branch)
    np.testing.assert_allclose([orbit.theta2, orbit.period], [theta2, period], rtol=0, atol=6e-11)
    np.testing.assert_allclose(orbit.kappa, kappa, rtol=5e-11)
    np.testing.assert_allclose(orbit.log_abs_kappa, np.log(abs(kappa)), rtol=1e-9)


@pytest.mark.parametrize(("request_", "theta2", "period"), PAPER)
def test_diffrax_solves_for_the_same_roots(paper, request_, theta2, period):
    """The same two equations with Dopri8 as the flow and scipy's hybrid method instead of
    Newton's.
    """
    theta1, ratio = np.radians(request_["theta1"]), request_.get("ratio")

    def equations(unknown):
        x, time = unknown
        release = dpend.released(x, ratio * x) if ratio else dpend.released(theta1, x)
        end = dpend.reference(paper, release, [time / 4], error=False).state
        return [float(end.theta1[0]), float(end.theta2[0])]

    start = [np.radians(theta2 * (ratio or 1)) + 1e-4, period + 1e-4]
    solved = root(equations, start, tol=1e-14)
    x = np.radians(theta2) * (ratio or 1)
    assert abs(np.degrees(solved.x[0] - x)) < 1e-9
    assert abs(solved.x[1] - period) < 1e-11


@pytest.mark.parametrize(
    ("theta2", "period", "symmetry"),
    [
        FORTY[0],
        FORTY[2],
        *(pytest.param(*orbit, marks=pytest.mark.slow) for orbit in (FORTY[1], *FORTY[3:])),
    ],
)
def test_orbits_from_guesses_at_forty_degrees(paper, theta2, period, symmetry):
    """From guesses a tenth of a degree and milliseconds off, centred orbits told apart from other
    brake orbits.
    """
    orbit = find(paper, 40, guess=(np.radians(theta2 + 0.1), period * 1.003))
    assert abs(np.degrees(orbit.theta2) - theta2) < 2e-9
    assert abs(orbit.period - period) < 1e-9
    assert orbit.symmetry == (symmetry or "brake")
    back = dpend.find_orbit(
        paper,
        orbit.dual.theta1,
        guess=(orbit.dual.theta2, orbit.period),
        symmetry=orbit.symmetry,
        error=False,
    )
    np.testing.assert_allclose([back.period, back.kappa], [orbit.period, orbit.kappa], rtol=1e-7)
    np.testing.assert_allclose(back.dual.theta2, orbit.theta2, atol=1e-9)


@pytest.mark.parametrize("k", [2, 3, 5, 6])
def test_covers_are_reduced_to_the_minimal_period(paper, k):
    orbit = find(paper, 40, guess=(np.radians(-51.1395), k * 0.754419))
    assert abs(orbit.period - 0.7544188658525) < 1e-11
    assert orbit.symmetry == "centred"
    brake = find(paper, 40, guess=(np.radians(119.4912), k * 1.283263), symmetry="brake")
    assert abs(brake.period - 1.283263044) < 1e-8


def test_newton_squares_its_residual(paper):
    """Three consecutive r(k+1)/r(k)^2 within a factor of ten, until rounding."""
    for theta2, period, symmetry in ((51.0, 1.2, "centred"), (119.9, 1.29, "brake")):
        residuals = [
            float(
                dpend.find_orbit(
                    paper, np.radians(40), guess=(np.radians(theta2), period), symmetry=symmetry,
                    max_iterations=k, error=False,
                ).residual
            )
            for k in (1, 2, 3, 4)
        ]  # fmt: skip
        rates = [
            after / before**2 for before, after in itertools.pairwise(residuals) if after > 1e-14
        ]
        assert len(rates) == 3 or residuals[-1] < 1e-14
        assert max(rates) < 10 * min(rates)
        final = find(paper, 40, guess=(np.radians(theta2), period), symmetry=symmetry)
        assert 3 <= final.iterations <= 8


def test_mirror_image(paper):
    orbit, mirrored = find(paper, 75, branch="anti-phase"), find(paper, -75, branch="anti-phase")
    np.testing.assert_allclose(
        [mirrored.theta1, mirrored.theta2, mirrored.dual.theta2, mirrored.period],
        [-orbit.theta1, -orbit.theta2, -orbit.dual.theta2, orbit.period],
        rtol=1e-15,
    )


def test_small_swings_are_the_normal_modes(paper):
    for branch, mode in zip(("in-phase", "anti-phase"), dpend.normal_modes(paper), strict=True):
        orbit = dpend.find_orbit(paper, 1e-7, branch=branch)
        assert orbit.status == Status.CONVERGED
        np.testing.assert_allclose(
            [orbit.theta2 / 1e-7, orbit.period], [mode.ratio, mode.period], rtol=1e-12
        )


@pytest.mark.parametrize(
    ("pendulum", "angles"),
    [
        # l2/l1, m2/m1 and where the in-phase branch turns back, and turns again [deg].
        pytest.param((1.0, 0.1), (17.77, 5.43), marks=pytest.mark.slow),
        pytest.param((1.0, 0.01), (3.07, 0.60), marks=pytest.mark.slow),
        pytest.param((10.0, 1.0), (46.57, 24.30), marks=pytest.mark.slow),
    ],
)
def test_a_branch_that_turns_is_followed_through_its_turns(pendulum, angles):
    length, mass = pendulum
    pendulum = Pendulum(1.0, length, 1.0, mass, 1.0)
    middle = sum(angles) / 2
    crossings = [find(pendulum, middle, branch="in-phase", crossing=k) for k in (1, 2, 3)]
    thetas = [float(orbit.theta2) for orbit in crossings]
    assert thetas == sorted(thetas)
    assert thetas[1] - thetas[0] > 0.05
    # Just inside the turn there are three passages, just outside one.
    for inside, outside in ((angles[0] - 0.3, angles[0] + 0.3), (angles[1] + 0.1, angles[1] - 0.1)):
        assert find(pendulum, inside, branch="in-phase", crossing=3).theta2 > thetas[1]
        beyond = dpend.find_orbit(
            pendulum, np.radians(outside), branch="in-phase", crossing=2, error=False
        )
        assert beyond.status in (Status.NO_SUCH_ORBIT, Status.LEFT_BRANCH)


@pytest.mark.slow
def test_no_such_orbit_says_how_far_the_branch_reaches(paper):
    orbit = dpend.find_orbit(paper, np.radians(181), branch="in-phase", error=False)
    assert orbit.status == Status.NO_SUCH_ORBIT
    assert 179.9 < np.degrees(orbit.theta1) < 180
    line = dpend.find_orbit(Pendulum(l2=0.6), np.radians(60), ratio=-1, error=False)
    assert line.status == Status.NO_SUCH_ORBIT


def test_failures_are_statuses(paper):
    few = dpend.find_orbit(paper, 0.7, guess=(1.2, 1.1), symmetry="centred", max_iterations=2)
    assert few.status == Status.MAX_ITERATIONS
    poisoned = jax.jit(partial(dpend.find_orbit, branch="in-phase"))(paper, jnp.nan)
    assert poisoned.status == Status.NONFINITE
    # From next to rest at an equilibrium the guess leads into it.
    for symmetry in ("brake", "centred"):
        trivial = dpend.find_orbit(paper, np.pi, guess=(3.1, 0.4), symmetry=symmetry, error=False)
        assert trivial.status == Status.TRIVIAL_ROOT
        assert abs(trivial.theta2 - np.pi) < 1e-6


@pytest.mark.slow
def test_everything_traces(paper):
    angles = jnp.radians(jnp.array([20.0, -90.0, 150.0]))
    many = jax.jit(jax.vmap(partial(dpend.find_orbit, paper, branch="anti-phase", error=False)))(
        angles
    )
    for i, angle in enumerate(angles):
        single = dpend.find_orbit(paper, angle, branch="anti-phase", error=False)
        np.testing.assert_allclose(many.theta2[i], single.theta2, rtol=1e-11)
        np.testing.assert_allclose(many.period[i], single.period, rtol=1e-11)


@pytest.mark.parametrize(
    "request_",
    [
        pytest.param({"branch": "in-phase"}, marks=pytest.mark.slow),
        pytest.param({"guess": (2.0855, 1.2833), "symmetry": "brake"}, marks=pytest.mark.slow),
    ],
)
def test_derivatives_are_those_of_the_root(paper, request_):
    """Implicit derivatives of theta2, the period, the energy and kappa against re-solved orbits."""
    theta1 = np.radians(40.0)

    def properties(theta1, pendulum):
        orbit = dpend.find_orbit(pendulum, theta1, error=False, **request_)
        return jnp.stack([orbit.theta2, orbit.period, orbit.energy, orbit.kappa])

    by_angle, by_pendulum = jax.jacfwd(properties, (0, 1))(theta1, paper)
    by_reverse = jax.jacrev(properties)(theta1, paper)
    np.testing.assert_allclose(by_reverse, by_angle, rtol=1e-10)
    nudge = 1e-5

    def difference(along):
        return (along(nudge) - along(-nudge)) / (2 * nudge)

    np.testing.assert_allclose(
        by_angle, difference(lambda h: properties(theta1 + h, paper)), rtol=1e-6, atol=1e-7
    )
    for name in ("l2", "m1"):
        exact = getattr(by_pendulum, name)
        base = getattr(paper, name)
        numeric = (
            difference(lambda h, n=name, b=base: properties(theta1, Pendulum(**{n: b * (1 + h)})))
            / base
        )
        np.testing.assert_allclose(exact, numeric, rtol=2e-6, atol=1e-6)
    # Scaling: lengths together stretch time like sqrt(l), masses together and gravity do nothing to
    # angles and kappa.
    _, period, _, kappa = properties(theta1, paper)
    by_length = by_pendulum.l1 * paper.l1 + by_pendulum.l2 * paper.l2
    np.testing.assert_allclose(by_length[jnp.array([0, 1, 3])], [0, period / 2, 0], atol=1e-9)
    np.testing.assert_allclose(
        by_pendulum.g[jnp.array([0, 1, 3])] * paper.g, [0, -period / 2, 0], atol=1e-9
    )
    by_mass = by_pendulum.m1 * paper.m1 + by_pendulum.m2 * paper.m2
    np.testing.assert_allclose(by_mass[jnp.array([0, 1, 3])], 0, atol=1e-9)
    assert abs(kappa) > 0.1


@pytest.mark.slow
def test_second_derivatives(paper):
    def period(theta1):
        return dpend.find_orbit(paper, theta1, branch="in-phase", error=False).period

    first, nudge = jax.jacfwd(period), 1e-4
    numeric = (first(0.7 + nudge) - first(0.7 - nudge)) / (2 * nudge)
    np.testing.assert_allclose(jax.jacfwd(first)(0.7), numeric, rtol=1e-6)


def test_orbits_come_back(paper):
    """A whole period by diffrax ends where it began, to the error that the multipliers allow."""
    for branch, angle in (("in-phase", 120), ("anti-phase", 30)):
        orbit = find(paper, angle, branch=branch)
        back = dpend.reference(paper, orbit.state, [float(orbit.period)])
        missed = max(
            abs(back.state.theta1[0] - orbit.theta1), abs(back.state.theta2[0] - orbit.theta2)
        )
        assert missed < 1e-10 * max(1.0, abs(orbit.kappa))


def test_bad_requests_are_refused(paper):
    for theta1, request_, text in (
        (np.nan, {"branch": "in-phase"}, "theta1 must be a finite number"),
        ("forty", {"branch": "in-phase"}, "theta1 must be a finite number .* got 'forty'"),
        (0.7, {}, "branch must be given"),
        (0.7, {"branch": "sideways"}, "branch must be one of in-phase, anti-phase, got 'sideways'"),
        (0.7, {"branch": "in-phase", "guess": (0.8, 1.2)}, "branch and guess exclude each other"),
        (0.7, {"branch": "in-phase", "symmetry": "brake"}, "symmetry goes with guess"),
        (0.7, {"guess": (0.8, 1.2), "symmetry": "odd"}, "symmetry must be one of"),
        (0.7, {"guess": (0.8, -1.2)}, "period must be positive"),
        (0.7, {"guess": (np.inf, 1.2)}, "theta2 must be a finite number"),
        (0.7, {"ratio": 2}, "ratio must be 1 or -1, got 2"),
        (0.7, {"branch": "in-phase", "crossing": 0}, "crossing must be an integer of at least 1"),
        (np.pi, {"branch": "in-phase"}, "theta1 must not be a multiple of 180 degrees"),
        (0.0, {"branch": "anti-phase"}, "theta1 must not be a multiple of 180 degrees"),
        (np.pi, {"guess": (-np.pi, 1.0)}, "that is an equilibrium"),
        (np.array([0.7, 0.8]), {"branch": "in-phase"}, "theta1 must be a scalar, .* jax.vmap"),
    ):
        with pytest.raises(ValueError, match=text):
            dpend.find_orbit(paper, theta1, **request_)
    for g in (0.0, -9.8):
        with pytest.raises(ValueError, match="g must be positive for an orbit"):
            dpend.find_orbit(Pendulum(g=g), 0.7, branch="in-phase")


FIVE = [(1.0, 1.0), (0.5, 1.0), (2.0, 0.3), (1.0, 0.1), (1.0, 10.0)]


@pytest.mark.slow
@pytest.mark.parametrize("branch", ["in-phase", "anti-phase"])
@pytest.mark.parametrize("ratios", FIVE)
def test_every_degree_of_five_pendulums(ratios, branch):
    """1 to 175 deg: the same orbit at half the integration step, and an error estimate that says
    so.
    """
    pendulum = Pendulum(1.0, ratios[0], 1.0, ratios[1], 1.0)
    worst = 0.0
    for degree in range(1, 176):
        orbit = find(pendulum, degree, branch=branch)
        finer = find(pendulum, degree, branch=branch, turn=0.03, error=False)
        error, period_error = (float(value) for value in orbit.error_estimate)
        moved = abs(float(finer.theta2 - orbit.theta2))
        worst = max(worst, moved, abs(float(finer.period / orbit.period) - 1))
        assert moved < 1e-10 + 3 * error, degree
        assert abs(float(finer.period - orbit.period)) < 1e-10 + 3 * period_error, degree
    assert worst < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("mass", [1e-3, 1e3])
def test_extreme_mass_ratios(mass):
    """They run, or say why not: small swings always, and no orbit that is not one."""
    pendulum = Pendulum(1.0, 1.0, 1.0, mass, 1.0)
    for branch, degree in itertools.product(
        ("in-phase", "anti-phase"), (1e-4, 0.01, 1.0, 10.0, 45.0)
    ):
        orbit = dpend.find_orbit(pendulum, np.radians(degree), branch=branch)
        assert orbit.status in (Status.CONVERGED, Status.LEFT_BRANCH), (branch, degree)
        if orbit.status == Status.CONVERGED:
            assert orbit.error_estimate[0] < 1e-9
            back = dpend.reference(pendulum, orbit.state, [float(orbit.period) / 4])
            missed = max(abs(back.state.theta1[0]), abs(back.state.theta2[0]))
            # Both integrations' own errors, grown as the motion grows.
            assert missed < 1e-9 + 10 * back.error_estimate + 1e-10 * abs(orbit.kappa) ** 0.5


@pytest.mark.parametrize("theta1", [3.0, pytest.param(3.14, marks=pytest.mark.slow)])
def test_a_branch_is_reached_as_far_as_its_family(theta1):
    """Where kappa is beyond 1e30, and shooting in one piece sees noise."""
    pendulum = Pendulum(1.0, 1.0, 1.0, 1e-3, 1.0)
    orbit = dpend.find_orbit(pendulum, theta1, branch="in-phase")
    assert orbit.status == Status.CONVERGED
    assert orbit.log_abs_kappa > (90 if theta1 > 3.1 else 40)
    same = dpend.follow_family(pendulum, "in-phase").at(theta1)
    for name in ("theta2", "period"):
        error = sum(x.error_estimate[name == "period"] for x in (orbit, same))
        assert abs(getattr(orbit, name) - getattr(same, name)) < 3 * error
    np.testing.assert_allclose(orbit.log_abs_kappa, same.log_abs_kappa, rtol=1e-9)


@pytest.mark.slow
def test_a_search_without_end_gives_up():
    """At m2/m1 = 1e7 no step is long enough to get anywhere: the search says so, and its work, in
    steps of a segment, ends where it is to end (the last attempt may go beyond).
    """
    wish = search.Wish(np.radians(40), 1, 0.0)
    found = jax.jit(search.search)(
        natural(Pendulum(m2=1e6)), True, wish, search.last_aim(0.1, 1e-13, 40)
    )
    assert found.status == Status.LEFT_BRANCH
    assert found.work < 2_000_000 + 8 * MOST_SEGMENT_STEPS


@pytest.mark.parametrize(
    ("which", "k"), [(0, 17), (0, 18), (0, 50), (3, 18), (2, 18), (4, 17), (4, 18)]
)
def test_no_multiple_of_the_period_is_too_large(paper, which, k):
    """Centred and brake orbits, stable and not, guessed with many times their period."""
    theta2, period, symmetry = FORTY[which]
    once = find(paper, 40, guess=(np.radians(theta2), period), error=False)
    orbit = find(paper, 40, guess=(float(once.theta2), k * float(once.period)), error=False)
    assert orbit.symmetry == (symmetry or "brake")
    np.testing.assert_allclose(orbit.theta2, once.theta2, atol=1e-11)
    np.testing.assert_allclose([orbit.period, orbit.kappa], [once.period, once.kappa], rtol=1e-9)


def test_a_guess_too_long_to_be_integrated_says_so(paper):
    orbit = dpend.find_orbit(
        paper, np.radians(40), guess=(np.radians(-51.139513966), 1e6 * 0.754418866), error=False
    )
    assert orbit.status == Status.BEYOND_HORIZON
    assert np.isnan(orbit.kappa)


@pytest.mark.slow
def test_no_error_is_above_ten_times_its_estimate():
    """Random pendulums and releases against Newton's method in long double, by another
    integrator.
    """
    pytest.importorskip("heyoka")
    if not extended.is_extended():
        pytest.skip("long double is double here")
    import orbit_errors

    rows, _ = orbit_errors.measure(12, seed=5, most_points=60)
    ratios = orbit_errors.ratios_of(rows)
    assert len(rows) > 60
    assert np.min(ratios) > 0.1
    assert np.all((np.median(ratios, axis=0) > 2) & (np.median(ratios, axis=0) < 20))


@pytest.mark.slow
def test_gradients_of_gradients_are_hessians():
    def theta2(theta1):
        return dpend.find_orbit(dpend.Pendulum(), theta1, branch="in-phase").theta2

    gradient = jax.grad(theta2)
    twice = float(jax.grad(gradient)(0.7))
    assert twice == pytest.approx(float(jax.hessian(theta2)(0.7)), rel=1e-12)
    central = (gradient(0.7 + 1e-4) - gradient(0.7 - 1e-4)) / 2e-4
    assert twice == pytest.approx(float(central), rel=1e-6)
