"""The whole square: linear theory at the families' ends, single angles, an interruption, and the table's rows."""

import jax
import numpy as np
import pytest
from test_families import monodromy

import dpend
from dpend import Pendulum, survey

LONGEST = 1.25
# All but the first, which the quick suite has.
slow = pytest.mark.slow


class Stop(Exception):
    """Somebody pulls the plug."""


@pytest.fixture(scope="module")
def square(paper):
    return dpend.find_brake_families(paper, max_period=LONGEST)


def test_the_only_family_below_the_period_of_every_other_mode(paper):
    """Up to 0.6 s there is the fast mode's, every slice has one return, and the periods rise with the energy."""
    found = dpend.find_brake_families(paper, max_period=0.6)
    (only,) = found.families
    assert (only["family"], only["ends"]) == ("C1", ["normal mode", "longest period"])
    assert (found.coverage.suspicious_cells, found.coverage.slices) == (0, 31)
    assert found.coverage.degree == found.coverage.winding
    _, fast = dpend.normal_modes(paper)
    np.testing.assert_allclose(only["shortest_period_s"], fast.period, rtol=1e-7)
    assert np.all(np.diff(found.table["period"]) > 0)
    assert np.all(np.diff(found.table["energy"]) > 0)


@slow
def test_families_that_begin_in_equilibrium_have_its_period(square, paper):
    """C1 and C4 the modes of the hanging pendulum; C2 and C3 the one oscillation of each saddle with a rod upright."""
    slow, fast = dpend.normal_modes(paper)
    lower_up, upper_up = (np.max(np.imag(rates)) for rates in dpend.equilibria(paper).exponents[1:3])
    periods = {"C1": fast.period, "C4": slow.period, "C2": 2 * np.pi / lower_up, "C3": 2 * np.pi / upper_up}
    families = {one["family"]: one for one in square.families}
    assert set(families) == {"C1", "C2", "C3", "C4", "B1"}
    for name, period in periods.items():
        assert families[name]["ends"][0] == "normal mode"
        np.testing.assert_allclose(families[name]["shortest_period_s"], period, rtol=1e-7)
    assert families["B1"]["ends"][0] == "branch point"
    assert [one["ends"][1] for one in families.values()] == ["longest period"] * 5


@slow
def test_the_catalogue_accounts_for_itself(square):
    seen = square.coverage
    assert (seen.suspicious_cells, seen.degree) == (0, seen.winding)
    assert seen.slices >= 31
    assert np.all(square.table["period"] <= LONGEST * (1 + 1e-12))
    for one in square.families:
        rows = square.where(family=one["family"]).table
        assert np.all(np.diff(rows["arclength"]) > 0)
        assert one["shortest_period_s"] <= rows["period"].min() < one["shortest_period_s"] * (1 + 1e-4)
        assert rows["period"].max() == one["longest_period_s"]
        np.testing.assert_allclose(rows["period"].max(), LONGEST, rtol=1e-12)
        assert set(rows["symmetry"].tolist()) == {one["symmetry"]}


@slow
def test_rows_are_orbits(square, paper):
    """One in twenty: by diffrax; kappa by the monodromy matrix over the period in one piece."""
    for orbit in square.orbits[::20]:
        growth = max(1.0, abs(2 * orbit.kappa))
        assert orbit.residual < 1e-12 * growth
        assert max(orbit.error_estimate) < 1e-9
        end = dpend.reference(paper, orbit.state, [orbit.period / 2], error=False).state
        states = np.stack(jax.tree.leaves(end))[:, 0]
        np.testing.assert_allclose(states[:2], [orbit.dual.theta1, orbit.dual.theta2], atol=1e-11 * growth)
        np.testing.assert_allclose(states[2:], 0, atol=1e-12 * growth)
        np.testing.assert_allclose((np.trace(monodromy(orbit, 1.0)) - 2) / 2, orbit.kappa, rtol=1e-6, atol=1e-6)


@slow
@pytest.mark.parametrize("theta1", [23.0, 77.7, -111.0, 166.0])
def test_orbits_of_one_angle_lie_on_families(square, paper, theta1):
    """Between the rows of a family, its dual curve or their mirror images, none of which are far apart."""
    table = square.table
    found = dpend.find_brake_orbits(paper, theta1=np.radians(theta1), max_period=LONGEST)
    assert len(found) > 0
    for theta2, period in zip(found.table["theta2"], found.table["period"], strict=True):
        away = []
        for sign in (1, -1):
            for rest in ("", "dual_"):
                apart = np.stack(
                    [sign * table[f"{rest}theta{i}"] - x for i, x in ((1, np.radians(theta1)), (2, theta2))]
                )
                apart -= 2 * np.pi * np.round(apart / (2 * np.pi))
                away.append(np.min(np.hypot(np.hypot(*apart), np.log(table["period"] / period))))
        assert min(away) < 0.04


@slow
def test_a_search_that_was_stopped_goes_on(square, paper, tmp_path):
    """Killed after the fifth slice, which the store has: the same atlas, and no slice scanned twice."""
    store, calls = tmp_path / "search.json", []

    def stop(done, planned, families):
        calls.append(done)
        if done == 5:
            raise Stop

    with pytest.raises(Stop):
        dpend.find_brake_families(paper, max_period=LONGEST, store=store, progress=stop)
    looked = []
    with pytest.MonkeyPatch.context() as patch:
        look = survey._Survey.look_at
        patch.setattr(survey._Survey, "look_at", lambda *a: (looked.append(a[1]), look(*a)))
        again = dpend.find_brake_families(paper, max_period=LONGEST, store=store)
    assert len(looked) == again.coverage.slices - 5
    assert again.coverage == square.coverage
    for key, column in square.table.items():
        np.testing.assert_array_equal(again.table[key], column)
    with pytest.raises(ValueError, match="store must have been made with the same settings"):
        dpend.find_brake_families(paper, max_period=1.1, store=store)
    store.write_text("{}")
    with pytest.raises(ValueError, match="store must be a file that find_brake_families wrote"):
        dpend.find_brake_families(paper, max_period=LONGEST, store=store)


@slow
def test_names_do_not_depend_on_the_longest_period(square, paper):
    shorter = dpend.find_brake_families(paper, max_period=1.18)
    names = [one["family"] for one in shorter.families]
    assert names == [one["family"] for one in square.families]
    for one, other in zip(shorter.families, square.families, strict=True):
        np.testing.assert_allclose(one["shortest_period_s"], other["shortest_period_s"], rtol=1e-7)


@slow
def test_thirteen_families_within_two_seconds(paper):
    found = dpend.find_brake_families(paper, max_period=2.0)
    assert [one["family"] for one in found.families if one["symmetry"] == "centred"] == [f"C{i}" for i in range(1, 8)]
    assert len(found.families) == 13
    assert (found.coverage.suspicious_cells, found.coverage.degree) == (0, found.coverage.winding)


@slow
def test_another_pendulum(paper):
    """Half the length and a third of the mass below: again nothing in doubt."""
    found = dpend.find_brake_families(Pendulum(1.0, 0.5, 3.0, 1.0, 9.81), max_period=3.0)
    assert (found.coverage.suspicious_cells, found.coverage.degree) == (0, found.coverage.winding)
    assert len(found.families) >= 5
