"""The atlas of one release angle: known orbits, other integrators, invariances, and its file."""

import json
from pathlib import Path

import jax
import numpy as np
import pytest
from elsewhere import FORTY, monodromy

import dpend
from dpend import Pendulum, Status
from dpend.catalogue import release

CATALOGUE = Path(__file__).parents[2] / "experiments" / "atlas"


@pytest.fixture(scope="module")
def forty_and_steps(paper):
    """The orbits of forty degrees, and what the search told on its way."""
    told = []
    found = dpend.find_brake_orbits(
        paper, theta1=np.radians(40.0), max_period=2.0, progress=lambda *steps: told.append(steps)
    )
    return found, told


@pytest.fixture(scope="module")
def forty(forty_and_steps):
    return forty_and_steps[0]


def test_the_eight_orbits_of_forty_degrees(forty):
    """All of them, no others, none of the two second returns, and nothing in doubt."""
    known = sorted(
        (period, theta2) for theta2, period in FORTY if period not in (1.579211862, 1.508837732)
    )
    np.testing.assert_allclose(forty.table["period"], [period for period, _ in known], atol=1e-9)
    np.testing.assert_allclose(
        np.degrees(forty.table["theta2"]), [theta2 for _, theta2 in known], atol=2e-9
    )
    assert (
        forty.table["symmetry"].tolist()
        == ["centred"] * 2 + ["brake", "centred", "brake", "centred"] + ["brake"] * 2
    )
    assert np.all(forty.table["status"] == Status.CONVERGED)
    seen = forty.coverage
    assert (seen.suspicious_cells, seen.slices, seen.refinements, seen.degree) == (
        0,
        1,
        2,
        seen.winding,
    )


@pytest.mark.slow
def test_every_row_is_an_orbit(forty, paper):
    """At rest at its dual after half the period and back after the whole, by diffrax; kappa by the
    whole monodromy; all as well as kappa allows.
    """
    for orbit in forty.orbits:
        growth = max(1.0, abs(2 * orbit.kappa))
        half, whole = (orbit.period / 2, orbit.period)
        end = dpend.reference(paper, orbit.state, [half, whole], error=False).state
        states = np.stack(jax.tree.leaves(end))
        np.testing.assert_allclose(
            states[:2, 0], [orbit.dual.theta1, orbit.dual.theta2], atol=1e-11 * growth
        )
        np.testing.assert_allclose(states[:2, 1], [orbit.theta1, orbit.theta2], atol=1e-11 * growth)
        np.testing.assert_allclose(states[2:], 0, atol=1e-12 * growth)
        assert orbit.residual < 1e-12 * growth
        assert max(orbit.error_estimate) < 1e-9
        np.testing.assert_allclose(
            (np.trace(monodromy(orbit, 1.0)) - 2) / 2, orbit.kappa, rtol=1e-7, atol=1e-7
        )
        np.testing.assert_allclose(dpend.hamiltonian(paper, orbit.state), orbit.energy, rtol=1e-14)


def test_a_longer_list_holds_the_shorter(forty, paper):
    shorter = dpend.find_brake_orbits(paper, theta1=np.radians(40.0), max_period=1.3)
    assert len(shorter) == 5
    np.testing.assert_allclose(shorter.table["theta2"], forty.table["theta2"][:5], atol=1e-13)
    last = dpend.find_brake_orbits(
        paper, theta1=np.radians(40.0), max_period=float(forty.table["period"][4])
    )
    assert len(last) == 5  # the longest period itself is in


def test_mirror_turns_and_units(forty):
    """theta -> -theta; full turns; lengths and gravity scale the period alone."""
    other = Pendulum(0.05, 0.05, 3.0, 3.0, 1.6)
    scale = np.sqrt(0.05 / 1.6 / (0.2 / 9.8))
    mirrored = dpend.find_brake_orbits(
        other, theta1=np.radians(-40.0 - 360.0), max_period=2.0 * scale
    )
    np.testing.assert_allclose(mirrored.table["theta2"], -forty.table["theta2"], atol=1e-12)
    np.testing.assert_allclose(mirrored.table["period"], scale * forty.table["period"], rtol=1e-13)


@pytest.mark.slow
def test_mirror_images_are_listed_once_where_the_upper_rod_hangs(paper):
    """Released with the upper rod straight down or up, theta2 and -theta2 are one orbit; and the
    equilibria none.
    """
    down = dpend.find_brake_orbits(paper, theta1=0.0, max_period=2.0)
    up = dpend.find_brake_orbits(paper, theta1=np.pi, max_period=2.0)
    assert (len(down), len(up)) == (1, 6)
    for found in (down, up):
        assert np.all(found.table["theta2"] > 0)
        assert found.coverage.suspicious_cells == 0


def test_near_the_bottom_there_are_the_normal_modes(paper):
    """At 1e-3 rad: theta2/theta1 and the period of both modes."""
    found = dpend.find_brake_orbits(paper, theta1=1e-3, max_period=1.2).where(symmetry="centred")
    small = np.abs(found.table["theta2"]) < 0.1
    modes = dpend.normal_modes(paper)[::-1]
    np.testing.assert_allclose(
        found.table["theta2"][small] / 1e-3, [mode.ratio for mode in modes], rtol=1e-5
    )
    np.testing.assert_allclose(
        found.table["period"][small], [mode.period for mode in modes], rtol=1e-5
    )


@pytest.mark.parametrize("ending", ["json", "csv"])
def test_files_hold_every_bit(forty, tmp_path, ending):
    path = tmp_path / f"forty.{ending}"
    forty.save(path)
    again = dpend.load_atlas(path)
    assert again.coverage == forty.coverage
    assert jax.tree.leaves(again.pendulum) == jax.tree.leaves(forty.pendulum)
    for key, column in forty.table.items():
        if column.dtype.kind == "f":  # degrees and back: a bit may be lost
            np.testing.assert_allclose(again.table[key], column, rtol=3e-16)
        else:
            np.testing.assert_array_equal(again.table[key], column)
    assert [o.symmetry for o in again.orbits] == [o.symmetry for o in forty.orbits]


def test_the_record_names_its_units(forty):
    record = json.loads(json.dumps(forty.record()["orbits"][0]))
    np.testing.assert_allclose(record["theta1_deg"], 40.0, rtol=1e-15)
    assert {"theta2_deg", "period_s", "energy_J", "kappa", "symmetry", "dual", "residual"} <= set(
        record
    )
    np.testing.assert_allclose(record["dual"]["theta1_deg"], -40.0, rtol=1e-14)


def test_filters(forty):
    assert len(forty.where(symmetry="brake", period=(1.0, 1.5))) == 2
    assert np.all(np.abs(forty.where(kappa=(-1, 1)).table["kappa"]) <= 1)
    assert len(forty.where(energy=(-1.0, np.median(forty.table["energy"])))) == 4
    assert len(forty.where(kappa=(-np.inf, np.inf))) == len(forty)
    nothing = forty.where(period=(3, 4))
    assert (len(nothing), nothing.orbits) == (0, ())
    assert len(nothing.where(symmetry="brake")) == 0
    for wrong, text in (
        ({"period": (1, 2, 3)}, "period must be a pair"),
        ({"kappa": (1, -1)}, "kappa must be a pair"),
        ({"symmetry": "odd"}, "symmetry must be one of brake, centred"),
        ({"family": ["C1"]}, "family must be one of none"),
        ({"symmetry": 3}, "symmetry must be one of"),
        ({"symmetry": [["brake"]]}, "symmetry must be one of"),
        ({"period": (np.nan, 2)}, "period must be a pair"),
        ({"period": (1, np.nan)}, "period must be a pair"),
        ({"period": "12"}, "period must be a pair"),
        ({"energy": (None, 1)}, "energy must be a pair"),
    ):
        with pytest.raises(ValueError, match=text):
            forty.where(**wrong)


def test_an_atlas_without_orbits(paper, tmp_path):
    nothing = dpend.find_brake_orbits(paper, theta1=1.0, max_period=0.1)
    assert len(nothing) == 0
    for ending in ("json", "csv"):
        nothing.save(tmp_path / f"nothing.{ending}")
        assert len(dpend.load_atlas(tmp_path / f"nothing.{ending}")) == 0


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"theta1": np.nan}, "theta1 must be a finite number"),
        ({"max_period": 0.0}, "max_period must be"),
        ({"max_period": np.inf}, "max_period must be"),
        ({"max_period": 16.0}, "max_period must be at most 15.83 s"),
        ({"pendulum": Pendulum(g=0.0)}, "g must be positive"),
    ],
)
def test_bad_requests_are_refused(paper, change, text):
    request = {"pendulum": paper, "theta1": 1.0, "max_period": 1.0} | change
    with pytest.raises(ValueError, match=text):
        dpend.find_brake_orbits(request.pop("pendulum"), **request)


@pytest.mark.parametrize("wrong", [None, np.array([1.0, 2.0]), True, "1", 1j])
def test_what_is_no_number_is_refused(paper, wrong):
    with pytest.raises(ValueError, match="theta1 must be"):
        dpend.find_brake_orbits(paper, theta1=wrong, max_period=1.0)
    with pytest.raises(ValueError, match="max_period must be"):
        dpend.find_brake_orbits(paper, theta1=1.0, max_period=wrong)


def test_traced_requests_are_refused(paper):
    with pytest.raises(ValueError, match="theta1 must be a number here, not traced"):
        jax.jit(
            lambda x: dpend.find_brake_orbits(paper, theta1=x, max_period=1.0).table["period"][0]
        )(1.0)


@pytest.mark.parametrize(
    ("pendulum", "request_", "said"),
    [
        (Pendulum(), {"theta1": 1e300}, r"theta1 must be at most 1.3e\+07 rad"),
        (
            Pendulum(),
            {"max_period": 15.8},
            "max_period must be so short that most_steps, 3e.08, are enough",
        ),
        (
            Pendulum(),
            {"most_steps": 1000},
            "max_period must be so short that most_steps, 1000, are enough",
        ),
        (Pendulum(), {"most_steps": np.nan}, "most_steps must be a finite positive number"),
        (Pendulum(), {"most_steps": True}, "most_steps must be a finite positive number, got True"),
        (Pendulum(m1=1e300), {}, "m1 and m2 must be within a factor of 1e30"),
        (Pendulum(m2=1e-300), {}, "m1 and m2 must be within a factor of 1e30"),
        (Pendulum(l2=1e-300), {}, "l1 and l2 must be within a factor of 1e12"),
        (Pendulum(l1=1e-300), {"max_period": 1e9}, "l1 and l2 must be within a factor of 1e12"),
        (Pendulum(g=1e300), {}, r"sqrt\(l1/g\) must be within 1e-90 and 1e90"),
        (Pendulum(1e-200, 1e-200, 1.0, 1.0, 1e-200), {}, "m1 g l1 must be within"),
        (Pendulum(m2=1e6), {}, "max_period must be at most 0.006542 s"),
        (Pendulum(l2=1e-6), {}, "max_period must be at most 0.04626 s"),
    ],
)
def test_what_would_never_end_is_refused(pendulum, request_, said):
    with pytest.raises(ValueError, match=said):
        dpend.find_brake_orbits(pendulum, **{"theta1": 1.0, "max_period": 1.0} | request_)


def test_a_search_out_of_steps_ends_and_says_so(paper, forty_and_steps):
    """It lists what it has: no other orbits than the whole search, and not without a doubt."""
    whole, told = forty_and_steps
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(release, "foresee_steps", lambda *_: 1)
        request = {"theta1": np.radians(40.0), "max_period": 2.0, "most_steps": told[-1][0] // 4}
        some = dpend.find_brake_orbits(paper, **request)
    assert (whole.coverage.exhausted, some.coverage.exhausted) == (False, True)
    assert some.coverage.suspicious_cells > 0
    assert set(some.table["theta2"].tolist()) <= set(whole.table["theta2"].tolist())


def test_the_cost_is_told_before_it_is_spent(forty_and_steps):
    """To a factor of two, and every step on the way."""
    done, planned = np.array(forty_and_steps[1]).T
    assert done[0] == 0
    assert done[-1] / 2 < planned[0] < 2 * done[-1]
    assert np.all(np.diff(done) >= 0)
    assert np.all(done <= planned)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pendulum", "theta1", "max_period"),
    [((0.2, 0.2, 0.1, 0.1, 9.8), 1.0, 3.0), ((1.0, 0.5, 3.0, 1.0, 9.81), 1.57, 6.0)],
)
def test_other_costs_are_told_before_they_are_spent(pendulum, theta1, max_period):
    """To a factor of three."""
    told = []
    dpend.find_brake_orbits(
        Pendulum(*pendulum),
        theta1=theta1,
        max_period=max_period,
        progress=lambda *steps: told.append(steps),
    )
    first, last = told[0], told[-1]
    assert first[0] == 0
    assert last[0] / 3 < first[1] < 3 * last[0]


@pytest.mark.slow
@pytest.mark.parametrize("theta1", [1e-9, -1e-6])
def test_tiny_swings(paper, theta1):
    """The fast mode, and the oscillation about the state with the lower rod upright, however
    small.
    """
    found = dpend.find_brake_orbits(paper, theta1=theta1, max_period=0.85)
    _, fast = dpend.normal_modes(paper)
    upright = 2 * np.pi / np.max(np.imag(dpend.equilibria(paper).exponents[1]))
    np.testing.assert_allclose(found.table["period"], [fast.period, upright], rtol=1e-6)
    np.testing.assert_allclose(found.table["theta2"][0] / theta1, fast.ratio, rtol=1e-6)
    assert found.coverage.suspicious_cells == 0


def test_files_that_are_no_atlas(forty, tmp_path):
    with pytest.raises(ValueError, match="path must end in .csv or .json"):
        forty.save(tmp_path / "a.txt")
    with pytest.raises(ValueError, match="path must be a file that can be read"):
        dpend.load_atlas(tmp_path / "none.json")
    for name, text in (
        ("a.json", "{}"),
        ("b.json", "[1]"),
        ("c.csv", "theta1,theta2\n1,2\n"),
        ("d.json", "\x00"),
    ):
        (tmp_path / name).write_text(text)
        with pytest.raises(ValueError, match="path must be a file that Atlas.save wrote"):
            dpend.load_atlas(tmp_path / name)


def test_the_published_catalogue(paper):
    """Both files hold the same orbits; a few of each family are solved again from their digits."""
    published, same = (
        dpend.load_atlas(CATALOGUE / f"brake_orbits.{ending}") for ending in ("csv", "json")
    )
    assert [one["family"] for one in published.families if one["symmetry"] == "brake"] == [
        f"B{i}" for i in range(1, 7)
    ]
    assert (published.coverage.suspicious_cells, published.coverage.degree) == (
        0,
        published.coverage.winding,
    )
    for key, column in published.table.items():
        np.testing.assert_array_equal(column, same.table[key])
    for one in published.families:
        for orbit in published.where(family=one["family"]).orbits[5::45]:
            again = dpend.find_orbit(paper, orbit.theta1, guess=(orbit.theta2, orbit.period))
            found = [again.theta2, again.period, again.dual.theta1, again.dual.theta2, again.energy]
            known = [orbit.theta2, orbit.period, orbit.dual.theta1, orbit.dual.theta2, orbit.energy]
            np.testing.assert_allclose(found, known, rtol=0, atol=1e-9)
            np.testing.assert_allclose(again.kappa, orbit.kappa, rtol=1e-6, atol=1e-6)
            assert again.symmetry == orbit.symmetry
