"""Families against numbers computed elsewhere, linear theory, single shooting, other integrators
and scaling laws.
"""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elsewhere import monodromy

import dpend
from dpend import Pendulum, Status
from dpend.orbits.arc import arc_times
from dpend.orbits.stability import growth_of, stability_of

# m = l = g = 1: where c - 1 and c change sign, theta1, theta2, T (None where only theta1 is known).
SPECIAL = {
    "in-phase": [
        ("resonance_2:1", 0.625419141, None, None),
        ("resonance_2:1", 0.962371694, None, None),
        ("resonance_2:1", 1.895413002, None, None),
        ("stability_lost", 2.1111615771, 1.5812628623, 10.4167732820),
    ],
    "anti-phase": [
        ("resonance_2:1", 0.351555337, None, None),
        ("stability_lost", 0.9890865027, -1.0811559833, 6.1475153497),
    ],
}
# theta1, theta2, T, kappa
REFERENCE = {
    "in-phase": [
        (0.3, 0.4145903934, 8.2701040150, -0.93693692785),
        (1.5, 1.2651907163, 9.1563354486, -0.85091323136),
        (2.4, 1.9340243889, 11.6874860507, 118.65548805),
    ],
    "anti-phase": [
        (0.3, -0.4186391707, 3.8998166875, -0.99101252677),
        (1.5, -1.1180563973, 7.1758496508, 6.5959253218),
        (2.7, -2.6470210045, 11.3914942129, 414.94007723),
    ],
}
BOTH = ("in-phase", "anti-phase")


@pytest.fixture(scope="module")
def families(unit):
    """Both families of the pendulum with l = m = g = 1."""
    return {branch: dpend.follow_family(unit, branch) for branch in BOTH}


def single(orbits, i):
    return jax.tree.map(lambda leaf: leaf[i], orbits)


def motion(orbit):
    """The states at sixtieths of the period, by diffrax, angles and momenta as rows."""
    state = dpend.State(*(float(leaf) for leaf in jax.tree.leaves(orbit.state)))
    times = np.arange(1, 61) / 60 * float(orbit.period)
    return np.stack(
        jax.tree.leaves(dpend.reference(orbit.pendulum, state, times, error=False).state)
    )


@pytest.mark.parametrize("branch", BOTH)
def test_reference_values_and_special_points(families, branch):
    family = families[branch]
    assert family.status == Status.CONVERGED
    assert family.ends == ("normal mode", "homoclinic")
    for theta1, theta2, period, kappa in REFERENCE[branch]:
        orbit = family.at(theta1)
        np.testing.assert_allclose(
            [orbit.theta2, orbit.period], [theta2, period], rtol=0, atol=6e-11
        )
        np.testing.assert_allclose(orbit.kappa, kappa, rtol=5e-11)
    found = [
        point
        for point in family.special_points
        if point.kind in ("resonance_2:1", "stability_lost")
    ]
    assert [point.kind for point in found] == [kind for kind, *_ in SPECIAL[branch]]
    for point, (_, theta1, theta2, period) in zip(found, SPECIAL[branch], strict=True):
        assert abs(point.orbit.theta1 - theta1) < 6e-10
        if period is not None:
            np.testing.assert_allclose(
                [point.orbit.theta2, point.orbit.period], [theta2, period], atol=2e-10, rtol=0
            )
    # Every resonance k:n that is crossed once in each direction of c, up to k = 6, and none beyond.
    kinds = {point.kind for point in family.special_points}
    assert kinds == {f"resonance_{k}" for k in ("2:1", "3:1", "4:1", "5:1", "6:1", "5:2")} | {
        "stability_lost"
    }
    for point in family.special_points:
        kappa = 1.0
        if point.kind != "stability_lost":
            k, n = (int(text) for text in point.kind.removeprefix("resonance_").split(":"))
            kappa = np.cos(2 * np.pi * n / k)
        assert abs(point.orbit.kappa - kappa) < 1e-10


def says(kind):
    """The kappa that a kind of special point stands for; None where it stands for none."""
    if kind.startswith("stability"):
        return 1.0
    if not kind.startswith("resonance"):
        return None
    k, n = (int(text) for text in kind.removeprefix("resonance_").split(":"))
    return np.cos(2 * np.pi * n / k)


def assert_special_points_are_what_they_say(family):
    """Of a centred family: kappa by shooting over the quarter period in one piece, signs between
    the neighbouring orbits, and no point twice.
    """
    points, names = family.special_points, {point.kind for point in family.special_points}
    for point in points:
        where, error = (float(number) for number in point.error_estimate)
        assert 0 < where < (0.1 if says(point.kind) is None else 1e-3), point.kind
        if says(point.kind) is None:
            continue
        kappa, unsure = in_one_piece(point.orbit)
        told = point.kind, where, error, float(point.orbit.kappa), kappa, unsure
        assert error < 1e-2, told
        assert abs(point.orbit.kappa - says(point.kind)) <= error, told
        assert abs(kappa - says(point.kind)) <= error + unsure, told
    for kind in names:
        mine = [point for point in points if point.kind == kind]
        for one, next_one in itertools.pairwise(mine):
            apart = next_one.arclength - one.arclength
            assert apart > one.error_estimate[0] + next_one.error_estimate[0], (kind, one.arclength)
    for kind, slope in (
        ("fold_theta1", family.slopes.theta1),
        ("fold_energy", family.slopes.energy),
    ):
        assert_signs_change(
            family, [p for p in points if p.kind == kind], slope / np.max(np.abs(slope)), 1e-12
        )
    changes = [point for point in points if point.kind.startswith("stability")]
    kinds = [point.kind for point in changes]
    assert all(kind != other for kind, other in itertools.pairwise(kinds)), kinds
    assert_signs_change(family, changes, 1 - np.asarray(family.orbits.kappa), 1e-9)
    for first in changes[:1]:  # the others alternate
        before = np.asarray(family.orbits.kappa)[
            family.arclength < first.arclength - first.error_estimate[0]
        ]
        assert np.all((before < 1 + 1e-9) == (first.kind == "stability_lost"))


def assert_signs_change(family, points, values, tolerance):
    """An odd number of points lies between two orbits if and only if the values there have opposite
    signs.
    """
    places = np.array([float(point.arclength) for point in points])
    errors = np.array([float(point.error_estimate[0]) for point in points])
    where, values = np.asarray(family.arclength), np.asarray(values)
    near = (
        np.any(np.abs(where[:, None] - places) <= errors, axis=1)
        if len(points)
        else np.zeros(len(where), bool)
    )
    sure = np.flatnonzero((np.abs(values) > tolerance) & ~near)
    passed = np.searchsorted(places, where[sure])
    odd = np.diff(passed) % 2 == 1
    np.testing.assert_array_equal(odd, np.sign(values[sure[1:]]) != np.sign(values[sure[:-1]]))


def in_one_piece(orbit):
    """kappa of a centred orbit from Phi(T/4), and what rounding leaves of it: ten times the scatter
    of four numbers of steps and releases 1e-14 apart.
    """

    def kappa(steps, shift):
        moved = dataclasses.replace(orbit.state, theta2=orbit.theta2 + shift)
        quarter = np.asarray(monodromy(dataclasses.replace(orbit, state=moved), 0.25, steps))
        growths.append(float(growth_of(quarter[None], "centred")))
        return 2 * (1 - 2 * np.sum(quarter[:2, :2] * quarter[2:, 2:])) ** 2 - 1

    growths = []
    here, *others = (
        kappa(*how) for how in ((1600, 0.0), (1200, 1e-14), (2000, -1e-14), (2400, 0.0))
    )
    return here, 10 * np.max(np.abs(np.array(others) - here)) + 4e-13 * growths[0]


def test_a_touch_a_fold_and_a_crossing_close_together():
    """m2/m1 = 2: the in-phase family runs through the curve of threefold anti-phase orbits at
    theta1 = -0.1312, where c touches 1, and gains its stability 0.0017 further on, where its energy
    turns back: c - 1 changes sign just there.
    """
    family = dpend.follow_family(Pendulum(1.0, 1.0, 1.0, 2.0, 1.0), "in-phase")
    assert_special_points_are_what_they_say(family)
    crossing, fold, gained = (p for p in family.special_points if abs(p.arclength - 2.0425) < 0.01)
    assert [crossing.kind, fold.kind, gained.kind] == [
        "crossing",
        "fold_energy",
        "stability_gained",
    ]
    np.testing.assert_allclose(
        [fold.arclength - crossing.arclength, gained.arclength - fold.arclength],
        [1.665e-3, 0],
        atol=2e-6,
    )
    # There the anti-phase family has c = cos(2 pi/3), at a third of the period.
    other = dpend.follow_family(Pendulum(1.0, 1.0, 1.0, 2.0, 1.0), "anti-phase")
    third = next(p for p in other.special_points if p.kind == "resonance_3:2")
    np.testing.assert_allclose(abs(third.orbit.theta1), abs(crossing.orbit.theta1), atol=2e-6)
    np.testing.assert_allclose(3 * third.orbit.period, crossing.orbit.period, rtol=1e-6)
    kinds = [p.kind for p in family.special_points if p.kind.startswith("stability")]
    assert kinds == ["stability_lost", "stability_gained", "stability_lost"]


@pytest.mark.slow
def test_windows_narrower_than_rounding_are_not_told():
    """l2/l1 = 18.13, m2/m1 = 6.64, anti-phase: within 3e-8 of arclength c passes from -1 to 1, and
    rounding leaves 0.04 of it unknown: there is no saying where which resonance is.
    """
    family = dpend.follow_family(Pendulum(1.0, 18.13, 1.0, 6.640, 1.0), "anti-phase")
    assert_special_points_are_what_they_say(family)
    assert not [p.kind for p in family.special_points if 4.0 < p.arclength < 4.2]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lengths", "masses"), [(9.4, 2.64), (0.817, 12.176), (0.2302, 0.7196), (19.468, 5.775)]
)
def test_stability_that_changes_at_a_crossing(lengths, masses):
    """Where a family runs through fivefold (or more) orbits c - 1 vanishes with its derivatives,
    and the energy turns back: one change of stability, there.
    """
    family = dpend.follow_family(Pendulum(1.0, lengths, 1.0, masses, 1.0), "in-phase")
    assert_special_points_are_what_they_say(family)
    crossings = [p for p in family.special_points if p.kind == "crossing"]
    assert crossings
    for crossing in crossings:
        near = [
            p
            for p in family.special_points
            if abs(p.arclength - crossing.arclength) < 3e-4 and p is not crossing
        ]
        assert sorted(p.kind for p in near) == ["fold_energy", "stability_gained"]
        assert near[0].arclength == near[1].arclength


# Pendulums with l2/l1 and m2/m1 from 1/20 to 20.
RANDOM = np.exp(np.random.default_rng(7).uniform(-np.log(20), np.log(20), (60, 2)))


@pytest.mark.slow
@pytest.mark.parametrize("some", range(6))
@pytest.mark.parametrize("branch", BOTH)
def test_special_points_of_random_pendulums(branch, some):
    for lengths, masses in RANDOM[some::6]:
        family = dpend.follow_family(Pendulum(1.0, lengths, 1.0, masses, 1.0), branch)
        assert_special_points_are_what_they_say(family)


@pytest.mark.parametrize("branch", BOTH)
def test_both_ends(unit, families, branch):
    """At zero amplitude the normal mode; at the other end the upright pendulum, and T = const -
    (2/lambda) ln gap with the slow exponent lambda = sqrt(2 - sqrt 2) of its equilibrium.
    """
    family, slow = families[branch], branch == "in-phase"
    mode = dpend.normal_modes(unit)[0 if slow else 1]
    tiny = family.at(1e-6)
    np.testing.assert_allclose(
        [tiny.theta2 / tiny.theta1, tiny.period], [mode.ratio, mode.period], rtol=1e-11
    )
    last = single(family.orbits, -1)
    gap = 1 - family.orbits.energy / 3
    assert 0 < gap[-1] < 1e-8
    np.testing.assert_allclose(
        [last.theta1, last.theta2], [np.pi, np.pi if slow else -np.pi], atol=2e-4
    )
    late = gap < 1e-6
    assert np.sum(late) > 3
    slope = np.polyfit(np.log(gap[late]), family.orbits.period[late], 1)[0]
    slowest = np.min(np.abs(dpend.equilibria(unit).exponents[3].real))
    np.testing.assert_allclose(slowest, np.sqrt(2 - np.sqrt(2)), rtol=1e-14)
    np.testing.assert_allclose(-slope * slowest / 2, 1.0, rtol=5e-3)


@pytest.mark.parametrize("branch", BOTH)
def test_every_point_is_right_to_twelve_digits(unit, families, branch):
    """Against shooting over the quarter period in one piece, which still carries up to kappa =
    1e8.
    """
    family = families[branch]
    assert np.max(family.orbits.error_estimate[0]) < 1e-12
    # At its theta1 the period of an orbit near the upright state changes by the inverse distance
    # from there.
    relative = family.orbits.error_estimate[1] / family.orbits.period
    assert np.max(relative[family.orbits.theta1 < 3.14]) < 1e-12
    assert np.max(relative) < 1e-11
    angles = np.linspace(0.05, 2.9, 9)
    one_by_one = [dpend.find_orbit(unit, theta1, branch=branch) for theta1 in angles]
    found, orbits = jax.tree.map(lambda *leaves: np.stack(leaves), *one_by_one), family.at(angles)
    np.testing.assert_allclose(orbits.theta2, found.theta2, atol=1e-12, rtol=0)
    np.testing.assert_allclose(orbits.period, found.period, rtol=1e-12)
    np.testing.assert_allclose(orbits.log_abs_kappa, found.log_abs_kappa, atol=1e-7)
    np.testing.assert_array_equal(orbits.status, Status.CONVERGED)


def test_kappa_agrees_from_the_quarter_the_half_and_the_whole_period(families):
    """The segments of a quarter against monodromy matrices over half and over all of the period, up
    to 1e12.
    """
    for family in families.values():
        orbits = family.orbits
        assert np.all(orbits.kappa > -1 - 1e-10)
        for i in range(2, len(orbits.period), 6):
            orbit = single(orbits, i)
            if not orbit.log_abs_kappa < np.log(1e12):
                continue
            half, whole = monodromy(orbit, 0.5), monodromy(orbit, 1.0)
            # What rounding in products of this size leaves.
            grown = np.sqrt(2 * np.exp(max(float(orbit.log_abs_kappa), 0.0)))
            c = (np.trace(-half) - 2) / 2
            np.testing.assert_allclose(orbit.kappa, 2 * c**2 - 1, rtol=1e-11 * grown, atol=1e-10)
            np.testing.assert_allclose(
                orbit.kappa, (np.trace(whole) - 2) / 2, rtol=1e-11 * grown**2, atol=1e-8
            )


def test_log_kappa_beyond_any_float():
    """Segments that stretch by 1e20 each: kappa overflows, its logarithm does not, and c has a
    sign.
    """
    stretch = np.diag([1e20, 1.0, 1e-20, 1.0])
    turn = np.array(
        [[0.8, 0, 0.6, 0], [0, 1, 0, 0], [-0.6, 0, 0.8, 0], [0, 0, 0, 1.0]]
    )  # symplectic
    matrices = np.stack([stretch @ turn] * 16)
    c, kappa, logarithm = stability_of(matrices, "centred")
    # tr(a^T d) of the product is -(its largest entries, 1e320 (0.8^15)^2 0.8 0.6 ... in size): by
    # exact integers.
    product = np.eye(4, dtype=object)
    for _ in range(16):
        step = np.array(
            [[8 * 10**40, 0, 6 * 10**40, 0], [0, 10**21, 0, 0], [-6, 0, 8, 0], [0, 0, 0, 10**21]],
            object,
        )
        product = step.dot(product)
    trace = 2 * (product[0, 0] * product[2, 2] + product[1, 1] * product[3, 3])
    expected = float(len(str(abs(trace))) - 1) * np.log(10) + np.log(
        int(str(abs(trace))[:17]) / 1e16
    )
    expected -= 2 * 16 * 21 * np.log(10)  # the scale of the integers
    assert np.isinf(kappa) or kappa > 1e290
    np.testing.assert_allclose(logarithm, np.log(2) + 2 * expected, rtol=1e-12)
    assert (c < 0) == (trace > 0)


@pytest.mark.slow
def test_derivatives_of_orbits(unit):
    """Against differences of families followed anew, and the scaling laws to rounding."""
    base = np.array([0.2, 0.25, 0.1, 0.07, 9.8, 0.7])

    def quantities(x):
        orbit = dpend.follow_family(Pendulum(*x[:5]), "in-phase").at(x[5])
        return jnp.stack([orbit.theta2, orbit.period, orbit.energy, orbit.kappa])

    jacobian = jax.jacrev(quantities)(jnp.asarray(base))
    for i in range(6):
        step = np.eye(6)[i] * 2e-4 * base[i]
        near = [quantities(base + k * step) for k in (-2, -1, 1, 2)]
        difference = (8 * (near[2] - near[1]) - (near[3] - near[0])) / (12 * step[i])
        np.testing.assert_allclose(jacobian[:, i], difference, rtol=1e-8, atol=1e-9)
    _, period, energy, kappa = jacobian
    value = quantities(base)
    np.testing.assert_allclose(period[0] * base[0] + period[1] * base[1], value[1] / 2, rtol=1e-14)
    np.testing.assert_allclose(period[4] * base[4], -value[1] / 2, rtol=1e-14)
    np.testing.assert_allclose(energy[2] * base[2] + energy[3] * base[3], value[2], rtol=1e-13)
    for row in (period, kappa):
        assert abs(row[2] * base[2] + row[3] * base[3]) < 1e-13
    assert abs(kappa[0] * base[0] + kappa[1] * base[1]) < 1e-13


@pytest.mark.slow
def test_derivatives_that_do_not_exist():
    """At a fold in theta1 the slopes in arclength are finite, and the derivative with respect to
    theta1 is refused.
    """
    heavy_below = Pendulum(1.0, 1.0, 1.0, 0.1, 1.0)
    family = dpend.follow_family(heavy_below, "in-phase")
    folds = [point for point in family.special_points if point.kind == "fold_theta1"]
    # Between these angles single shooting finds the family three times, beyond them once.
    outer, inner = (float(fold.orbit.theta1) for fold in folds[:2])
    np.testing.assert_allclose(np.degrees([outer, inner]), [17.77, 5.42], atol=1e-2)
    for theta1, there in (
        (outer - 1e-3, True),
        (outer + 1e-3, False),
        (inner + 1e-3, True),
        (inner - 1e-3, False),
    ):
        again = dpend.find_orbit(heavy_below, theta1, branch="in-phase", crossing=2)
        assert (again.status == Status.CONVERGED and again.theta1 < 0.4) == there
    # A fold is known to its own error [arclength], over which the slope changes by some tens of
    # that.
    assert all(
        abs(fold.slopes.theta1) < max(1e-10, fold.error_estimate[0]) < abs(fold.slopes.theta2)
        for fold in folds
    )
    near = float(folds[0].orbit.theta1) * (1 - 1e-14)
    with pytest.raises(ValueError, match=r"theta1 must not be a fold .* got 0\.31.*slopes"):
        jax.grad(lambda theta1: family.at(theta1).period)(near)
    first, second, third = (family.at(0.2, crossing=k) for k in (1, 2, 3))
    assert first.theta2 < second.theta2 < third.theta2 or first.period < second.period
    assert family.at(0.2, crossing=4).status == Status.NO_SUCH_ORBIT
    with pytest.raises(ValueError, match="traced by jit"):
        jax.jit(lambda theta1: family.at(theta1).period)(0.1)


@pytest.mark.slow
@pytest.mark.parametrize("branch", BOTH)
def test_orbits_with_no_rest_branch_off_where_stability_is_lost(unit, families, branch):
    """x(T/2) = -x(0) by diffrax, momenta that are not zero, and the stability that the old family
    gave away.
    """
    lost = families[branch].special_points[-1]
    assert lost.kind == "stability_lost"
    odd = dpend.follow_family(unit, lost)
    assert (odd.symmetry, odd.ends[0], int(odd.status)) == ("odd", "branch point", Status.CONVERGED)
    first = single(odd.orbits, 0)
    np.testing.assert_allclose(
        [first.theta1, first.period], [lost.orbit.theta1, lost.orbit.period], rtol=2e-3
    )
    assert abs(first.kappa) < 1
    for i in (3, 10):
        orbit = single(odd.orbits, i)
        states = motion(orbit)
        np.testing.assert_allclose(
            states[:, 29], -np.stack(jax.tree.leaves(orbit.state)), atol=1e-9
        )
        np.testing.assert_allclose(states[:, 29], np.stack(jax.tree.leaves(orbit.dual)), atol=1e-9)
        bobs = dpend.energies(unit, dpend.State(*states))
        assert np.min(bobs.kinetic1 + bobs.kinetic2) > 1e-3  # never at rest
        kappa = (np.trace(monodromy(orbit, 1.0)) - 2) / 2
        np.testing.assert_allclose(orbit.kappa, kappa, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_orbits_of_twice_and_three_times_the_period(unit, families):
    """Brake orbits branch off at c = 0 and c = 1/2; those of twice the period run from one c = 0 to
    the next.
    """
    first, second = (point for point in families["in-phase"].special_points[:2])
    doubled = dpend.follow_family(unit, first)
    assert (doubled.symmetry, doubled.ends) == ("brake", ("branch point", "branch point"))
    np.testing.assert_allclose(doubled.orbits.period[-1], 2 * second.orbit.period, rtol=1e-6)
    tripled = dpend.follow_family(
        unit, next(p for p in families["anti-phase"].special_points if p.kind == "resonance_3:1")
    )
    for family, k in ((doubled, 2), (tripled, 3)):
        orbit = single(family.orbits, 5)
        np.testing.assert_array_equal([orbit.state.p1, orbit.state.p2], 0)
        states = motion(orbit)
        np.testing.assert_allclose(
            states[:, 29], [orbit.dual.theta1, orbit.dual.theta2, 0, 0], atol=1e-8
        )
        covered = states[:2, 60 // k - 1] - [orbit.theta1, orbit.theta2]
        assert np.max(np.abs(covered)) > 1e-3  # it is not the old orbit, k times


@pytest.mark.slow
def test_a_family_from_one_of_its_orbits(paper):
    """In both directions: the same curve as from the mode; and the brake orbit at (40, 119.49) deg
    belongs to those of twice the period that leave the anti-phase family where its c = 0.
    """
    whole = dpend.follow_family(paper, "anti-phase")
    again = dpend.follow_family(paper, whole.at(0.9))
    assert again.ends == ("normal mode", "homoclinic")
    angles = np.array([0.1, 0.5, 2.0, 3.0])
    np.testing.assert_allclose(again.at(angles).theta2, whole.at(angles).theta2, atol=1e-12, rtol=0)
    assert [p.kind for p in again.special_points] == [p.kind for p in whole.special_points]
    orbit = dpend.find_orbit(paper, np.radians(40), guess=(np.radians(119.491215917), 1.283263044))
    brake = dpend.follow_family(paper, orbit)
    assert brake.ends == ("branch point", "homoclinic")
    origin = whole.special_points[0].orbit
    np.testing.assert_allclose(brake.orbits.period[0], 2 * origin.period, rtol=1e-6)
    np.testing.assert_allclose(brake.at(np.radians(40)).theta2, orbit.theta2, atol=1e-10)


def test_bad_starts_are_refused(unit, paper, families):
    with pytest.raises(ValueError, match="start must be one of in-phase"):
        dpend.follow_family(unit, "sideways")
    with pytest.raises(ValueError, match="g must be positive"):
        dpend.follow_family(Pendulum(g=-9.8), "in-phase")
    with pytest.raises(ValueError, match="longest_step must be a finite positive number"):
        dpend.follow_family(unit, "in-phase", longest_step=0.0)
    with pytest.raises(ValueError, match="start must be a single orbit"):
        dpend.follow_family(unit, families["in-phase"].orbits)
    with pytest.raises(ValueError, match="start must be an orbit of this pendulum"):
        dpend.follow_family(paper, families["in-phase"].at(1.0))
    with pytest.raises(ValueError, match="start must have converged"):
        dpend.follow_family(unit, families["in-phase"].at(3.5))
    assert dpend.follow_family(unit, "in-phase", most_points=40).status == Status.MAX_ITERATIONS
    for angles in ("a", [], 1e-200, np.inf):
        with pytest.raises(ValueError, match="theta1 must be"):
            families["in-phase"].at(angles)


def test_changes_within_one_step_are_found():
    """A window of instability shorter than a step: where |kappa| exceeds 1, by shooting over the
    whole period.
    """
    family = dpend.follow_family(
        Pendulum(1.0, 0.1807758472087658, 1.0, 0.9966799572101486, 9.81), "in-phase"
    )
    kinds = [point for point in family.special_points if point.kind.startswith("stability")]
    assert [point.kind for point in kinds] == [
        "stability_lost",
        "stability_gained",
        "stability_lost",
    ]
    lost, gained, _ = (float(point.orbit.theta1) for point in kinds)
    assert 0.77 < lost < gained < 0.8
    for theta1, stable in (
        (lost - 1e-3, True),
        (0.5 * (lost + gained), False),
        (gained + 1e-3, True),
    ):
        kappa = (np.trace(monodromy(family.at(theta1), 1.0)) - 2) / 2
        assert (abs(kappa) < 1) == stable


@pytest.mark.slow
def test_orbits_are_not_held_twice(paper):
    """Through a point where a brake orbit becomes more symmetric its family goes on with the same
    orbits at their other rests: from an orbit on it, it ends there. The energies are then all
    different.
    """
    orbit = dpend.find_orbit(paper, np.radians(90.0), guess=(np.radians(-7.85), 2.5454))
    family = dpend.follow_family(paper, orbit, longest_period=2.6)
    assert family.ends == ("branch point", "longest period")
    np.testing.assert_allclose(family.orbits.period[-1], 2.6, rtol=1e-12)
    assert np.all(np.diff(family.orbits.period) > 0)


@pytest.mark.slow
def test_a_dip_between_two_orbits_is_looked_into(paper):
    """Brake orbits with kappa = 63, 17 and 234 one after the other: between them it falls below -1
    and comes back.
    """
    orbit = dpend.find_orbit(
        paper, np.radians(81.55118), guess=(np.radians(-113.608201545), 1.647422305)
    )
    family = dpend.follow_family(paper, orbit, longest_period=2.0)
    kinds = [p.kind for p in family.special_points if p.kind.startswith("stability")]
    assert np.min(family.orbits.kappa) > 10
    assert (
        kinds == ["stability_gained", "stability_lost"] * 2
        or kinds == ["stability_lost", "stability_gained"] * 2
    )
    for p in family.special_points:
        if p.kind.startswith("stability"):
            np.testing.assert_allclose(
                abs((np.trace(monodromy(p.orbit, 1.0)) - 2) / 2), 1, atol=1e-6
            )


def test_families_up_to_a_period(unit):
    family = dpend.follow_family(unit, "anti-phase", longest_period=6.0)
    assert (family.ends, int(family.status)) == (
        ("normal mode", "longest period"),
        Status.CONVERGED,
    )
    np.testing.assert_allclose(family.orbits.period[-1], 6.0, rtol=1e-13)
    orbit = single(family.orbits, -1)
    found = dpend.find_orbit(unit, float(orbit.theta1), branch="anti-phase")
    np.testing.assert_allclose(
        [orbit.theta2, orbit.period], [found.theta2, found.period], rtol=1e-12
    )
    for start in ("anti-phase", found):
        with pytest.raises(ValueError, match="longest_period must be longer"):
            dpend.follow_family(unit, start, longest_period=3.0)


@pytest.mark.slow
def test_what_branches_off_at_c_of_minus_one():
    """With Phi(T/2) = [[A, B], [C, D]]: where C vanishes on a release, brake orbits that are not
    centred, at rest after half a period by diffrax; where B vanishes the displacement is of the
    momenta alone, and there is no rest: orbits pass the bottom twice a period, by diffrax too, and
    their family leads from one of these places to the other.
    """
    pendulum = Pendulum(1.0, 3.0, 1.0, 0.3, 1.0)
    family = dpend.follow_family(pendulum, "in-phase")
    kinds, passing = [], []
    for point in family.special_points:
        half = monodromy(point.orbit, 0.5) if point.kind.startswith("stability") else np.eye(4)
        if abs(np.trace(half)) > 1e-3:
            continue
        at_rest = bool(np.max(np.abs(half[:2, 2:])) > 1e-3)
        kinds.append(at_rest)
        if not at_rest:
            passing.append(dpend.follow_family(pendulum, point))
            continue
        branch = dpend.follow_family(pendulum, point, most_points=20)
        assert branch.symmetry == "brake"
        orbit = single(branch.orbits, 8)
        np.testing.assert_allclose(branch.orbits.period[0], point.orbit.period, rtol=1e-3)
        states = motion(orbit)
        np.testing.assert_allclose(states[2:, 29], 0, atol=1e-9)
        assert np.max(np.abs(np.sin(states[:2, 14]))) > 1e-3  # not centred
    assert sorted(kinds) == [False, False, True, True]
    one, other = passing
    assert {family.ends for family in passing} == {("branch point", "branch point")}
    np.testing.assert_allclose(one.orbits.period[0], other.orbits.period[-1], rtol=1e-3)
    np.testing.assert_allclose(other.orbits.period[0], one.orbits.period[-1], rtol=1e-3)
    for i in (0, 9, 18):
        orbit = single(one.orbits, i)
        states = motion(orbit)
        np.testing.assert_allclose(states[:2, 29], 0, atol=1e-9)
        np.testing.assert_allclose(states[:, 59], jax.tree.leaves(orbit.state), atol=1e-9)
        matrix = monodromy(orbit, 1.0)
        np.testing.assert_allclose(orbit.kappa, (np.trace(matrix) - 2) / 2, rtol=1e-9)
        assert np.max(np.abs(states[2:, 29] + states[2:, 59])) > 1e-3  # not centred


@pytest.mark.slow
def test_a_family_that_shrinks_onto_a_saddle(paper):
    """The orbit at (40, -157.23) deg belongs to the oscillation about (0, 180) deg: its period
    stays finite there, 2 pi over the imaginary exponent.
    """
    orbit = dpend.find_orbit(paper, np.radians(40), guess=(np.radians(-157.229758666), 0.789605931))
    family = dpend.follow_family(paper, orbit)
    assert family.ends == ("normal mode", "homoclinic")
    frequency = np.max(dpend.equilibria(paper).exponents[1].imag)
    np.testing.assert_allclose(family.orbits.period[0], 2 * np.pi / frequency, rtol=1e-4)


@pytest.mark.slow
def test_derivatives_reach_a_start_that_carries_them():
    def period(g):
        pendulum = Pendulum(g=g)
        orbit = dpend.find_orbit(pendulum, 0.698, guess=(2.0855, 1.2833))
        return dpend.follow_family(pendulum, orbit).at(0.698).period

    np.testing.assert_allclose(jax.jacfwd(period)(9.8), -period(9.8) / 19.6, rtol=1e-12)


# l2/l1 and m2/m1; the in-phase families of the third and fourth pass folds, and run through curves
# of covered orbits.
OTHERS = [(0.3, 1.0), (3.0, 0.3), (1.0, 0.1), (0.1, 3.0), (3.0, 3.0), (0.3, 10.0)]


@pytest.mark.slow
@pytest.mark.parametrize(("lengths", "masses"), OTHERS)
@pytest.mark.parametrize("branch", BOTH)
def test_families_of_other_pendulums(lengths, masses, branch):
    """To the homoclinic end without help, where T grows by a whole multiple of (2/lambda) ln
    1/gap.
    """
    pendulum = Pendulum(1.0, lengths, 1.0, masses, 1.0)
    family = dpend.follow_family(pendulum, branch)
    assert (family.ends[1], int(family.status)) == ("homoclinic", Status.CONVERGED)
    orbits = family.orbits
    top = 1 + masses * (1 + lengths)
    upright = 2 * (
        (1 + masses) * np.cos(orbits.theta1 / 2) ** 2
        + masses * lengths * np.cos(orbits.theta2 / 2) ** 2
    )
    gap = upright / top
    assert gap[-1] < 1e-8
    np.testing.assert_allclose(np.cos([orbits.theta1[-1], orbits.theta2[-1]]), -1, atol=1e-6)
    late = np.arange(len(gap)) >= np.max(np.flatnonzero(gap > 1e-6)) + 1
    slope = np.polyfit(np.log(gap[late]), orbits.period[late], 1)[0]
    slowest = np.min(np.abs(dpend.equilibria(pendulum).exponents[3].real))
    passages = -slope * slowest / 2
    assert abs(passages - max(round(passages), 1)) < 0.02
    # Four points against diffrax: at the centre after a quarter of the period.
    for i in np.linspace(0, len(gap) - 1, 30).astype(int)[[1, 5, 9, 13]]:
        orbit = single(orbits, i)
        if orbit.log_abs_kappa < 15:
            np.testing.assert_allclose(np.sin(motion(orbit)[:2, 14]), 0, atol=1e-6)


@pytest.mark.slow
def test_second_derivatives_on_a_family(paper):
    """The same as those of `find_orbit`, which differences confirm."""
    family = dpend.follow_family(paper, "in-phase")
    bend = jax.hessian(lambda theta1: family.at(theta1).period)(0.7)
    first, nudge = jax.grad(lambda theta1: family.at(theta1).period), 1e-4
    numeric = (first(0.7 + nudge) - first(0.7 - nudge)) / (2 * nudge)
    np.testing.assert_allclose(bend, numeric, rtol=1e-6)


# What the linear motion about a saddle is, and the folds in theta1, m = l = g = 1.
@pytest.mark.parametrize(("branch", "centre", "folds"), [
    ("down-up", (0.0, np.pi), []),
    ("up-down", (np.pi, 0.0), [2.877713, 3.19445]),
])  # fmt: skip
def test_families_of_the_saddles(unit, branch, centre, folds):
    """From 2 pi/2^(1/4) to the upright pendulum; diffrax sees the orbit pass the saddle's place a
    quarter of its period after the release.
    """
    family = dpend.follow_family(unit, branch)
    assert (family.ends, int(family.status)) == (("normal mode", "homoclinic"), Status.CONVERGED)
    mode = jnp.asarray(family._curve.points[0])
    np.testing.assert_allclose(4 * arc_times(unit, mode)[0].sum(), 2 * np.pi / 2**0.25, rtol=1e-14)
    np.testing.assert_allclose(mode[:2], centre)
    found = [float(p.orbit.theta1) for p in family.special_points if p.kind == "fold_theta1"]
    np.testing.assert_allclose(found, folds, atol=5e-6)
    np.testing.assert_allclose(family.orbits.energy[-1], 3.0, atol=1e-7)
    states = motion(single(family.orbits, 12))
    np.testing.assert_allclose(states[:2, 14], centre, atol=1e-9)


def test_orbits_of_an_energy_or_a_period(families):
    """The same orbits as by the release angle; derivatives are those of neighbours on the curve."""
    family, angles = families["anti-phase"], np.array([0.3, 1.5, 2.7])
    orbits = family.at(angles)
    for name in ("energy", "period"):
        again = family.at(**{name: getattr(orbits, name)})
        np.testing.assert_array_equal(again.status, Status.CONVERGED)
        np.testing.assert_allclose(again.theta1, angles, rtol=1e-11)
        np.testing.assert_allclose(getattr(again, name), getattr(orbits, name), rtol=1e-14)
    assert family.at(energy=3.1).status == family.at(period=3.0).status == Status.NO_SUCH_ORBIT


@pytest.mark.slow
@pytest.mark.parametrize(("name", "value"), [("energy", -1.5), ("period", 6.0)])
def test_derivatives_of_orbits_of_an_energy_or_a_period(name, value):
    """By central differences, whose own errors are some 1e-8 and 1e-6 here."""
    other = "period" if name == "energy" else "energy"

    def found(value, mass):
        family = dpend.follow_family(Pendulum(1.0, 1.0, 1.0, mass, 1.0), "anti-phase")
        return getattr(family.at(**{name: value}), other)

    slopes, h = jax.grad(found, (0, 1))(value, 1.0), 1e-4
    by_value = (found(value + h, 1.0) - found(value - h, 1.0)) / (2 * h)
    by_mass = (found(value, 1.0 + h) - found(value, 1.0 - h)) / (2 * h)
    np.testing.assert_allclose(slopes, [by_value, by_mass], rtol=1e-6)
    second = (found(value + h, 1.0) - 2 * found(value, 1.0) + found(value - h, 1.0)) / h**2
    np.testing.assert_allclose(jax.hessian(found)(value, 1.0), second, rtol=1e-4)
