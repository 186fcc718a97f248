"""The whole square: linear theory at the families' ends, single angles, an interruption, and the
table's rows.
"""

import json

import jax
import numpy as np
import pytest
from elsewhere import monodromy

import dpend
from dpend import Pendulum
from dpend.catalogue import progress, survey

LONGEST = 1.25
# All but the first, which the quick suite has.
slow = pytest.mark.slow


class Stop(Exception):
    """Somebody pulls the plug."""


@pytest.fixture(scope="module")
def square(paper):
    return dpend.find_brake_families(paper, max_period=LONGEST)


def test_the_only_family_below_the_period_of_every_other_mode(paper):
    """Up to 0.6 s there is the fast mode's, every slice has one return, and the periods rise with
    the energy.
    """
    found = dpend.find_brake_families(paper, max_period=0.6)
    (only,) = found.families
    assert (only["family"], only["ends"]) == ("C1", ["normal mode", "longest period"])
    assert (found.coverage.suspicious_cells, found.coverage.slices) == (0, 31)
    assert found.coverage.degree == found.coverage.winding
    _, fast = dpend.normal_modes(paper)
    np.testing.assert_allclose(only["shortest_period_s"], fast.period, rtol=1e-7)
    assert np.all(np.diff(found.table["period"]) > 0)
    assert np.all(np.diff(found.table["energy"]) > 0)


@pytest.fixture(scope="module")
def kept(paper, tmp_path_factory):
    """A store with three slices, and the search that left it."""
    store = tmp_path_factory.mktemp("search") / "search.json"

    def stop(done, planned, families):
        if done == 3:
            raise Stop

    with pytest.raises(Stop):
        dpend.find_brake_families(paper, max_period=0.9, store=store, progress=stop)
    return store.read_text()


def changed(*path, value):
    """A store with something set, or deleted, its checksum as it was."""

    def damage(text):
        record = part = json.loads(text)
        for key in path[:-1]:
            part = part[key]
        if value is Ellipsis:
            del part[path[-1]]
        else:
            part[path[-1]] = value
        return json.dumps(record)

    return damage


def forged(*path, value):
    """The same with a checksum that fits."""

    def damage(text):
        record = json.loads(changed(*path, value=value)(text))
        return json.dumps(record | {"checksum": progress.checksum(record)})

    return damage


WROTE = "store must be a file that find_brake_families wrote, got .*"
SETTINGS = "store must have been made with the same settings, got .*"


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda text: "", WROTE + "Expecting value"),
        (lambda text: "{}", WROTE + "the store has no settings"),
        (lambda text: "[]", WROTE + "the store must be an object"),
        (lambda text: "[" * 10**6, WROTE + "nested too deeply"),
        (lambda text: text[:-30], WROTE + "line"),
        (lambda text: text.replace('"lost": 0', '"lost": NaN', 1), WROTE + "NaN is no JSON number"),
        (
            lambda text: text.replace('"lost"', '"lost": 0, "lost"', 1),
            WROTE + "'lost' stands twice",
        ),
        (changed("slices", 1, value=...), WROTE + "it was changed since, or damaged"),
        (changed("slices", 1, "returns", 0, 1, value=0.75), WROTE + "it was changed since"),
        (changed("slices", 1, "degree", value=7), WROTE + "it was changed since"),
        (
            changed("slices", 1, "degree", value=True),
            WROTE + r"slices\[1\].degree must be an integer, is True",
        ),
        (
            changed("slices", 1, "degree", value="1"),
            WROTE + r"slices\[1\].degree must be an integer",
        ),
        (changed("slices", 1, "theta1", value=...), WROTE + r"slices\[1\] has no theta1"),
        (
            changed("slices", 1, "returns", 0, value=[1.0]),
            WROTE + r"returns\[0\] must have 2 numbers",
        ),
        (changed("slices", value={}), WROTE + "slices must be a list"),
        (changed("families", value=[]), WROTE + "it was changed since"),
        (changed("families", 0, "level", value=3), WROTE + "it was changed since"),
        (changed("families", 0, "seed", value=None), WROTE + r"families\[0\].seed must be a list"),
        (changed("checksum", value=...), WROTE + "the store has no checksum"),
        (changed("settings", "max_period", value=0.8), WROTE + "it was changed since"),
        (forged("settings", "max_period", value=0.8), SETTINGS + "with max_period 0.8"),
        (forged("settings", "pendulum", "l1", value=0.3), SETTINGS + "with pendulum"),
        (forged("settings", value={}), SETTINGS + "with dpend_version None"),
        (forged("settings", "more", value=1), SETTINGS + "with more 1"),
        (forged("slices", 0, value=...), WROTE + r"slices\[0\].theta1 is 0.78"),
        (
            forged("slices", 1, "theta1", value=0.1),
            WROTE + r"slices\[1\].theta1 is 0.1, which is not the next one",
        ),
        (
            forged("slices", 1, "motions", value=-1),
            WROTE + r"slices\[1\].motions must be at least 0",
        ),
        (
            forged("slices", 1, "returns", 0, value=[0.1, 9.0]),
            WROTE + r"slices\[1\].returns has \(0.1, 9\)",
        ),
        (
            forged("families", 0, "seed", value=[1.0, 1.0, 0.5]),
            WROTE + r"families\[0\] begins at none",
        ),
        (forged("families", 0, "level", value=99), WROTE + r"families\[0\] begins at none"),
    ],
)
def test_a_damaged_store_is_refused(paper, kept, tmp_path, damage, said):
    store = tmp_path / "damaged.json"
    store.write_text(damage(kept))
    with pytest.raises(ValueError, match=said) as refusal:
        dpend.find_brake_families(paper, max_period=0.9, store=store)
    assert "\n" not in str(refusal.value)
    assert store.read_text() == damage(kept)


def test_what_would_never_end_is_refused_before_it_begins(paper):
    """The number of motions grows exponentially: told from a few of them, within a second."""
    with pytest.raises(
        ValueError,
        match="max_period must be so short that most_steps, 3e.08, are enough, got 15.8 s",
    ):
        dpend.find_brake_families(paper, max_period=15.8)
    with pytest.raises(ValueError, match="most_steps must be a finite positive number"):
        dpend.find_brake_families(paper, max_period=0.6, most_steps=0)
    with pytest.raises(
        ValueError,
        match=r"m1 and m2 must be within a factor of 1e30 of each other.* got 1e\+300 and 0.1",
    ):
        dpend.find_brake_families(Pendulum(m1=1e300), max_period=1.0)


@slow
def test_a_search_that_ran_out_of_steps_says_so_and_goes_on(paper, tmp_path):
    """What it took is at least what it was allowed; the whole follows from the store."""
    store = tmp_path / "search.json"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(survey, "foresee_steps", lambda *_: 1)
        some = dpend.find_brake_families(paper, max_period=0.6, store=store, most_steps=600_000)
    assert some.coverage.exhausted
    assert 0 < some.coverage.slices < 31
    for ending in ("csv", "json"):
        some.save(tmp_path / f"some.{ending}")
        assert dpend.load_atlas(tmp_path / f"some.{ending}").coverage == some.coverage
    whole = dpend.find_brake_families(paper, max_period=0.6, store=store)
    assert (whole.coverage.exhausted, whole.coverage.slices, whole.coverage.suspicious_cells) == (
        False,
        31,
        0,
    )


@slow
def test_two_searches_with_one_store(paper, tmp_path):
    """Each slice of one is followed by one of the other: both are whole, and so is the store at any
    time.
    """
    store, turns = tmp_path / "search.json", []

    def other(done, planned, families):
        if done in (2, 9) and done not in turns:
            turns.append(done)
            turns.append(dpend.find_brake_families(paper, max_period=0.6, store=store))

    one = dpend.find_brake_families(paper, max_period=0.6, store=store, progress=other)
    for found in [one, *turns[1::2]]:
        assert (found.coverage.slices, found.coverage.suspicious_cells, len(found)) == (
            31,
            0,
            len(one),
        )
    again = dpend.find_brake_families(paper, max_period=0.6, store=store)
    np.testing.assert_array_equal(again.table["theta2"], one.table["theta2"])


@slow
def test_families_that_begin_in_equilibrium_have_its_period(square, paper):
    """C1 and C4 the modes of the hanging pendulum; C2 and C3 the one oscillation of each saddle
    with a rod upright.
    """
    slow, fast = dpend.normal_modes(paper)
    lower_up, upper_up = (
        np.max(np.imag(rates)) for rates in dpend.equilibria(paper).exponents[1:3]
    )
    periods = {
        "C1": fast.period,
        "C4": slow.period,
        "C2": 2 * np.pi / lower_up,
        "C3": 2 * np.pi / upper_up,
    }
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
        assert (
            one["shortest_period_s"] <= rows["period"].min() < one["shortest_period_s"] * (1 + 1e-4)
        )
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
        np.testing.assert_allclose(
            states[:2], [orbit.dual.theta1, orbit.dual.theta2], atol=1e-11 * growth
        )
        np.testing.assert_allclose(states[2:], 0, atol=1e-12 * growth)
        np.testing.assert_allclose(
            (np.trace(monodromy(orbit, 1.0)) - 2) / 2, orbit.kappa, rtol=1e-6, atol=1e-6
        )


@slow
@pytest.mark.parametrize("theta1", [23.0, 77.7, -111.0, 166.0])
def test_orbits_of_one_angle_lie_on_families(square, paper, theta1):
    """Between the rows of a family, its dual curve or their mirror images, none of which are far
    apart.
    """
    table = square.table
    found = dpend.find_brake_orbits(paper, theta1=np.radians(theta1), max_period=LONGEST)
    assert len(found) > 0
    for theta2, period in zip(found.table["theta2"], found.table["period"], strict=True):
        away = []
        for sign in (1, -1):
            for rest in ("", "dual_"):
                apart = np.stack(
                    [
                        sign * table[f"{rest}theta{i}"] - x
                        for i, x in ((1, np.radians(theta1)), (2, theta2))
                    ]
                )
                apart -= 2 * np.pi * np.round(apart / (2 * np.pi))
                away.append(np.min(np.hypot(np.hypot(*apart), np.log(table["period"] / period))))
        assert min(away) < 0.04


@slow
def test_a_search_that_was_stopped_goes_on(square, paper, tmp_path):
    """Killed after the fifth slice, which the store has: the same atlas, and no slice scanned
    twice.
    """
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
    assert [one["family"] for one in found.families if one["symmetry"] == "centred"] == [
        f"C{i}" for i in range(1, 8)
    ]
    assert len(found.families) == 13
    assert (found.coverage.suspicious_cells, found.coverage.degree) == (0, found.coverage.winding)


@slow
def test_another_pendulum(paper):
    """Half the length and a third of the mass below: again nothing in doubt."""
    found = dpend.find_brake_families(Pendulum(1.0, 0.5, 3.0, 1.0, 9.81), max_period=3.0)
    assert (found.coverage.suspicious_cells, found.coverage.degree) == (0, found.coverage.winding)
    assert len(found.families) >= 5
