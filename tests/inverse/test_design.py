"""Designs against scaling laws, exact ratios, brute force, the full monodromy matrix and
diffrax.
"""

import itertools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq, minimize_scalar

import dpend
from dpend import Pendulum, Status
from dpend.inverse.problem import PARAMETERS
from dpend.orbits.derivatives import slopes
from dpend.orbits.stability import transition

SIXTY = np.radians(60)


def one_second(orbit):
    return orbit.period - 1.0


def kappa(orbit):
    return orbit.kappa


def second_and_kappa(orbit):
    return jnp.stack([orbit.period - 1.0, orbit.kappa])


def two_to_one(slow, fast):
    return slow.period / fast.period - 2.0


def mode_ratio(orbit):
    slow, fast = dpend.normal_modes(orbit.pendulum)
    return slow.period - 2 * fast.period


def find(pendulum, branch="in-phase", theta1=SIXTY):
    return dpend.find_orbit(pendulum, theta1, branch=branch)


def design(loss, pendulum, *free, branch="in-phase", theta1=SIXTY, **settings):
    """`design_pendulum`, converged, and every orbit brought back by diffrax."""
    found = dpend.design_pendulum(loss, pendulum, free, branch=branch, theta1=theta1, **settings)
    assert found.status == Status.CONVERGED, found.message
    for orbit in found.orbits:
        back = dpend.reference(
            found.pendulum, orbit.state, [float(orbit.period)], error=False
        ).state
        missed = max(abs(back.theta1[0] - orbit.theta1), abs(back.theta2[0] - orbit.theta2))
        assert missed < 1e-10 * max(1.0, abs(orbit.kappa))
    return found


@jax.jit
def around(pendulum, state, period):
    """The monodromy matrix over the whole period, with no use of any symmetry."""
    return transition(pendulum, state, period / 512, 512, dpend.Scheme("rk8", 1.0))[1]


def full_kappa(found):
    whole = around(found.pendulum, found.orbit.state, found.orbit.period)
    return float(np.trace(whole) - 2) / 2


def logs(found, start):
    """ln(found/start) of the pendulum's parameters."""
    return {
        name: float(np.log(getattr(found.pendulum, name) / getattr(start, name)))
        for name in PARAMETERS[:-1]
    }


def test_gravity_for_a_second_scales_exactly(paper):
    before = find(paper)
    found = design(one_second, paper, "g")
    np.testing.assert_allclose(found.pendulum.g, 9.8 * before.period**2, rtol=1e-13)
    np.testing.assert_allclose(found.distance, 2 * np.log(before.period), rtol=1e-12)
    assert abs(found.loss) < 1e-14
    np.testing.assert_allclose(
        [found.orbit.theta2, found.orbit.kappa], [before.theta2, before.kappa], rtol=1e-11
    )
    rates = found.sensitivities["period"]
    sums = [rates["l1"] + rates["l2"], rates["g"], rates["m1"] + rates["m2"]]
    np.testing.assert_allclose(sums, [0.5, -0.5, 0.0], atol=1e-12)


def test_the_nearest_lengths_for_a_second(paper):
    """T = sqrt(l1/g) tau(l2/l1): the distance as a function of one ratio, minimised by scipy."""
    found = design(one_second, paper, "l1", "l2")

    def distance(ratio):
        tau = float(find(replace(paper, l2=0.2 * np.exp(ratio))).period)
        change = -2 * np.log(tau)
        return np.hypot(change, change + ratio)

    brute = minimize_scalar(distance, bracket=(-0.1, 0.1), tol=1e-10)
    np.testing.assert_allclose(found.distance, brute.fun, rtol=1e-12)
    change, rates = logs(found, paper), found.sensitivities["loss"]
    np.testing.assert_allclose(change["l1"] * rates["l2"], change["l2"] * rates["l1"], rtol=1e-8)
    assert 5 <= found.iterations <= 8


def test_more_freedom_is_never_further_away(paper):
    """And a scale that does not matter stays: the product of the masses."""
    names = ("l1", "l2", "g", "m1", "m2")
    distances = [float(design(one_second, paper, *names[:n]).distance) for n in (2, 3, 5)]
    assert distances == sorted(distances, reverse=True)
    found = design(one_second, paper, *names)
    np.testing.assert_allclose(found.pendulum.m1 * found.pendulum.m2, 0.01, rtol=1e-12)
    change, rates = logs(found, paper), found.sensitivities["loss"]
    multipliers = [change[name] / float(rates[name]) for name in names]
    np.testing.assert_allclose(multipliers, multipliers[0], rtol=1e-6)


def test_normal_modes_two_to_one(paper):
    """Equal lengths: (1 + s)/(1 - s) = 4 with s^2 = m2/(m1 + m2), hence m2/m1 = 9/16."""
    found = design(mode_ratio, paper, "m2")
    np.testing.assert_allclose(found.pendulum.m2, 0.1 * 9 / 16, rtol=1e-13)


def test_both_modes_two_to_one_at_sixty_degrees(paper):
    found = design(two_to_one, paper, "l1", "l2", branch=("in-phase", "anti-phase"))
    slow, fast = (find(found.pendulum, branch) for branch in ("in-phase", "anti-phase"))
    np.testing.assert_allclose(slow.period / fast.period, 2.0, rtol=1e-13)

    def ratio(log):
        here = replace(paper, l2=0.2 * np.exp(log))
        return float(find(here).period / find(here, "anti-phase").period) - 2

    # Only l2/l1 matters: half of its logarithm goes to either.
    nearest = brentq(ratio, 0.5, 1.2, xtol=1e-12)
    np.testing.assert_allclose(found.distance, nearest / np.sqrt(2), rtol=1e-10)


@pytest.mark.parametrize(
    ("free", "branch"),
    [
        (("m1", "m2"), "in-phase"),
        (("l1", "l2"), "anti-phase"),
        # Newton's method finds these only from elsewhere.
        pytest.param(("l1", "l2"), "in-phase", marks=pytest.mark.slow),
        pytest.param(("theta1", "l1"), "in-phase", marks=pytest.mark.slow),
    ],
)
def test_as_stable_as_can_be(paper, free, branch):
    found = design(kappa, paper, *free, branch=branch)
    assert abs(full_kappa(found)) < 1e-8
    assert found.orbit.stability == "elliptic"


@pytest.mark.slow
def test_the_nearest_of_several_by_brute_force(paper):
    """kappa = 0 on a grid of lengths and masses, and on one of release angles and lengths."""

    def roots(function, low, high, pieces):
        places = np.linspace(low, high, pieces)
        values = [function(place) for place in places]
        pairs = itertools.pairwise(zip(places, values, strict=True))
        return [brentq(function, a, b, xtol=1e-12) for (a, u), (b, v) in pairs if u * v < 0]

    for one, other in (("l1", "l2"), ("m1", "m2")):
        found = design(kappa, paper, one, other)
        start = getattr(paper, one)
        ratios = roots(
            lambda x, n=one, s=start: float(find(replace(paper, **{n: s * np.exp(x)})).kappa),
            -2,
            2,
            41,
        )
        np.testing.assert_allclose(found.distance, min(np.abs(ratios)) / np.sqrt(2), rtol=1e-9)
    found = design(kappa, paper, "theta1", "l1")
    assert abs(found.distance - 0.630705) < 1e-6
    nearest = np.inf
    for log in np.arange(-0.6, 0.65, 0.05):
        angle = SIXTY * np.exp(log)
        for x in roots(
            lambda x, a=angle: float(find(replace(paper, l1=0.2 * np.exp(x)), theta1=a).kappa),
            -0.9,
            0.9,
            13,
        ):
            nearest = min(nearest, float(np.hypot(x, log)))
    assert 0 <= nearest - found.distance < 2e-3


def test_two_equations(paper):
    found = design(second_and_kappa, paper, "l1", "l2", "m2")
    np.testing.assert_allclose(found.loss, 0, atol=1e-12)
    assert abs(full_kappa(found)) < 1e-8
    assert abs(found.orbit.period - 1) < 1e-13
    # On the normal of the solutions: a combination of both gradients.
    change = np.array([logs(found, paper)[name] for name in ("l1", "l2", "m2")])
    rows = np.array([np.asarray(found.sensitivities["loss"][name]) for name in ("l1", "l2", "m2")])
    multipliers = np.linalg.lstsq(rows, change, rcond=None)[0]
    np.testing.assert_allclose(rows @ multipliers, change, atol=1e-8)


def test_one_unknown_is_looked_for_everywhere(paper):
    """kappa falls to -1 before it rises to 0: Newton's method goes the wrong way."""
    found = design(kappa, paper, "theta1", theta1=np.radians(30))
    from_above = design(kappa, paper, "theta1", theta1=np.radians(100))
    np.testing.assert_allclose(found.theta1, from_above.theta1, rtol=1e-10)
    assert abs(np.degrees(found.theta1[0]) - 118.615595) < 1e-6


@pytest.mark.slow
def test_equal_periods_at_two_angles(paper):
    def isochronous(wide, small):
        return wide.period - small.period

    found = design(
        isochronous,
        paper,
        "l1",
        "l2",
        "m2",
        branch=("in-phase", "in-phase"),
        theta1=(SIXTY, np.radians(6)),
    )
    assert found.orbits[0].theta1 == SIXTY
    periods = [find(found.pendulum, theta1=np.radians(angle)).period for angle in (60, 6)]
    np.testing.assert_allclose(periods[0], periods[1], rtol=1e-12)


def test_bounds_hold(paper):
    found = design(one_second, paper, "l1", "l2", bounds={"l1": (0.15, 0.25)})
    assert found.at_bounds == ("l1",)
    np.testing.assert_allclose(found.pendulum.l1, 0.15, rtol=1e-15)
    length = brentq(
        lambda l2: float(find(replace(paper, l1=0.15, l2=l2)).period) - 1, 0.05, 0.2, xtol=1e-14
    )
    np.testing.assert_allclose(found.pendulum.l2, length, rtol=1e-11)


def test_bounds_without_a_solution(paper):
    box = {"l1": (0.18, 0.25), "l2": (0.18, 0.25)}
    found = dpend.design_pendulum(one_second, paper, branch="in-phase", theta1=SIXTY, bounds=box)
    assert found.status == Status.NO_SOLUTION
    assert found.at_bounds == ("l1", "l2")
    np.testing.assert_allclose(found.loss, np.sqrt(0.9) * find(paper).period - 1, rtol=1e-12)
    assert "within the bounds" in found.message


@pytest.mark.slow
def test_equations_without_a_solution(paper):
    never = dpend.design_pendulum(
        lambda orbit: orbit.kappa + 2,
        paper,
        "m2",
        branch="in-phase",
        theta1=SIXTY,
        bounds={"m2": (0.05, 0.2)},
    )
    assert never.status == Status.NO_SOLUTION  # of a centred orbit kappa is never below -1
    np.testing.assert_allclose(never.loss, 1.0, atol=1e-9)


def test_a_minimum_is_found_and_stopped_by_bounds(paper):
    """A bowl in the logarithms, whose lowest point is known, with and without a bound on the
    way.
    """

    def bowl(orbit):
        x, y = jnp.log(orbit.pendulum.l1 / 0.3), jnp.log(orbit.pendulum.l2 / 0.1)
        return 7 + x**2 + 3 * y**2 + x * y

    found = design(bowl, paper, "l1", "l2", goal="minimum")
    np.testing.assert_allclose([found.pendulum.l1, found.pendulum.l2], [0.3, 0.1], rtol=1e-7)
    np.testing.assert_allclose(found.loss, 7.0, rtol=1e-14)
    held = design(bowl, paper, "l1", "l2", goal="minimum", bounds={"l1": (0.1, 0.25)})
    assert held.at_bounds == ("l1",)
    np.testing.assert_allclose(held.pendulum.l2, 0.1 * np.exp(-np.log(0.25 / 0.3) / 6), rtol=1e-7)


def test_a_minimum_of_many_leaves_scales_that_do_not_matter(paper):
    found = design(lambda orbit: orbit.kappa**2, paper, "l1", "l2", "m1", "m2", goal="minimum")
    assert abs(found.orbit.kappa) < 1e-7
    products = found.pendulum.m1 * found.pendulum.m2, found.pendulum.l1 * found.pendulum.l2
    np.testing.assert_allclose(products, (0.01, 0.04), rtol=1e-9)


def test_sensitivities_are_those_of_orbits_solved_again(paper):
    found = design(second_and_kappa, paper, "l1", "l2", "m2")
    values = dict(vars(found.pendulum)) | {"theta1": SIXTY}

    def known(name, factor):
        here = values | {name: float(values[name]) * factor}
        orbit = find(
            Pendulum(*(float(here[key]) for key in PARAMETERS[:-1])), theta1=here["theta1"]
        )
        return np.array([orbit.theta2, orbit.period, orbit.kappa, orbit.period - 1.0])

    for name in PARAMETERS:
        numeric = (known(name, np.exp(1e-4)) - known(name, np.exp(-1e-4))) / 2e-4
        table = found.sensitivities
        exact = [
            *(table[key][name] for key in ("theta2", "period", "kappa")),
            table["loss"][name][0],
        ]
        np.testing.assert_allclose(exact, numeric, rtol=1e-6, atol=1e-7)


def test_one_program_serves_all_branches_and_freedoms(paper):
    design(one_second, paper, "g")
    programs = slopes._cache_size()
    design(kappa, paper, "l1", "l2", branch="anti-phase", bounds={"l2": (0.1, 2.0)})
    assert slopes._cache_size() == programs


def test_failures_are_statuses(paper):
    few = dpend.design_pendulum(
        second_and_kappa, paper, branch="in-phase", theta1=SIXTY, max_iterations=1
    )
    assert few.status == Status.MAX_ITERATIONS
    assert "start from" in few.message
    poisoned = dpend.design_pendulum(
        lambda orbit: jnp.sqrt(orbit.period - 2.0), paper, "g", branch="in-phase", theta1=SIXTY
    )
    assert poisoned.status == Status.NONFINITE
    beyond = dpend.design_pendulum(one_second, paper, "g", branch="in-phase", theta1=3.14159)
    assert beyond.status == Status.NO_SUCH_ORBIT
    assert "The branch ends" in beyond.message


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"free": ("l1", "l9")}, "free must name one or more of l1, l2, m1, m2, g, theta1, got"),
        ({"free": ()}, "free must name one or more"),
        ({"free": ("l1", "l1")}, "free must name each parameter once"),
        (
            {"loss": second_and_kappa, "free": "l1"},
            "free must name as many parameters as there are equations or more",
        ),
        (
            {"loss": second_and_kappa, "goal": "minimum"},
            "loss must be a scalar for a minimum, got 2 values",
        ),
        ({"loss": 1.0}, "loss must be a function of an orbit"),
        ({"goal": "least"}, "goal must be one of zero, minimum, got 'least'"),
        (
            {"bounds": {"l1": (0.3, 0.5)}},
            "bounds of l1 must be two numbers with the start, 0.2, between them",
        ),
        ({"bounds": {"l1": (0.5, 0.1)}}, "bounds of l1 must be two numbers with the start"),
        ({"bounds": {"l1": (-0.1, 0.5)}}, "bounds of l1 must be a finite positive number"),
        ({"bounds": {"l1": 0.5}}, r"bounds of l1 must be a pair \(low, high\), got 0.5"),
        ({"bounds": {"m1": (0.05, 0.5)}}, "bounds must be of parameters that are free, got 'm1'"),
        ({"bounds": (0.1, 0.3)}, "bounds must be a dictionary"),
        ({"free": "theta1", "bounds": {"theta1": (1, 4)}}, "bounds of theta1 must be below pi"),
        ({"branch": "middle"}, "branch must be one of in-phase, anti-phase"),
        ({"theta1": 3.2}, r"theta1 must be between 0 and pi \[rad\], got 3.2"),
        ({"theta1": -1.0}, "theta1 must be between 0 and pi"),
        ({"theta1": "60"}, "theta1 must be a finite number"),
        ({"theta1": (0.5, 0.6)}, "theta1 must be one angle, or one a branch, got 2 for 1"),
        (
            {"branch": ("in-phase",) * 2, "theta1": (0.5, 0.6), "free": "theta1"},
            "theta1 can be free only if",
        ),
        ({"pendulum": Pendulum(g=-9.8)}, "g must be positive"),
        ({"pendulum": 0.2}, "pendulum must be a Pendulum"),
        ({"max_iterations": 0}, "max_iterations must be an integer of at least 1"),
    ],
)
def test_bad_requests_are_refused(paper, settings, text):
    request = {
        "loss": one_second,
        "pendulum": paper,
        "branch": "in-phase",
        "theta1": SIXTY,
    } | settings
    with pytest.raises(ValueError, match=text):
        dpend.design_pendulum(**request)
