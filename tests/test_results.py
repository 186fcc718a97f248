"""Results that leave: tables, datasets, short reprs, arrays of orbits; against the numbers that
they are made of.
"""

import json
from pathlib import Path

import jax
import numpy as np
import pytest

import dpend
from dpend.orbits.orbit import orbit_quantities

ANGLES = np.radians([10.0, 20.0, 200.0])


@pytest.fixture(scope="module")
def family(paper):
    return dpend.follow_family(paper, "in-phase")


@pytest.fixture(scope="module")
def orbits(family):
    """The last one does not exist: the family ends at the upright pendulum."""
    return family.at(ANGLES)


CATALOGUE = Path(__file__).parent.parent / "experiments" / "atlas" / "brake_orbits.csv"


@pytest.fixture(scope="module")
def atlas():
    return dpend.load_atlas(CATALOGUE)


def test_a_batch_of_motions_comes_back_from_netcdf(paper, tmp_path):
    """A status goes up to 255, which no type of NetCDF 3 for one byte holds."""
    import xarray

    batch = dpend.released(np.array([0.1, 0.2]), np.array([0.2, 0.3]))
    data = dpend.simulate(paper, batch, times=[0.0, 0.1], tolerance=1e-9).to_xarray()
    data.to_netcdf(tmp_path / "m.nc", engine="scipy")
    with xarray.open_dataset(tmp_path / "m.nc", engine="scipy") as back:
        np.testing.assert_array_equal(back.theta1, data.theta1)
        assert back.status.attrs["flag_values"].max() == dpend.Status.NOT_COMPUTED == 255


def test_a_notebook_shows_a_table(orbits, family, atlas):
    """The first and last rows under the repr; of what is traced the repr alone."""
    for result in (orbits, family, atlas):
        shown = result._repr_html_()
        assert shown.startswith(f"<p><code>&lt;{type(result).__name__}: ")
        rows = min(len(result.to_dataframe()), 11)  # ten, and one that stands for the others
        assert shown.count("<tr") == 1 + rows
        assert "theta2_deg" in shown
    told = []
    jax.jit(lambda one: told.append(one._repr_html_()))(orbits)
    assert "PeriodicOrbit" in told[0]
    assert "<table" not in told[0]


def test_an_array_of_orbits_is_one(orbits):
    assert len(orbits) == 3
    each = [*orbits]
    np.testing.assert_array_equal([one.theta2 for one in each], orbits.theta2)
    assert [one.stability for one in each] == orbits.stability.tolist()
    assert orbits.stability.tolist() == ["elliptic", "elliptic", "unknown"]
    assert float(orbits[1].period) == float(orbits.period[1])
    assert float(orbits[-2:].dual.theta1[0]) == -ANGLES[1]
    for use in (len, iter, lambda one: one[0]):
        with pytest.raises(TypeError, match="a single orbit"):
            list(use(orbits[0]))
    assert bool(orbits[0])
    with pytest.raises(IndexError):
        orbits.__class__.__getitem__(jax.tree.map(np.asarray, orbits), 3)


def test_a_table_of_orbits_is_in_degrees_and_a_dataset_in_radians(orbits):
    table, data = orbits.to_dataframe(), orbits.to_xarray()
    np.testing.assert_allclose(table.theta1_deg[:2], [10, 20], rtol=1e-15)
    np.testing.assert_allclose(np.radians(table.theta2_deg), data.theta2, rtol=1e-15)
    np.testing.assert_array_equal(table.period_s, data.period)
    assert data.period.units == "s"
    assert table.status.tolist() == ["converged", "converged", "no_such_orbit"]
    names = data.status.flag_meanings.split()
    assert [names[i] for i in data.status.values] == table.status.tolist()
    # A centred orbit's other rest is its mirror image.
    np.testing.assert_array_equal(table.dual_theta2_deg[:2], -table.theta2_deg[:2])
    one = orbits[0].to_dataframe()
    assert one.shape == (1, table.shape[1])
    assert one.equals(table.iloc[:1])


def test_a_family_is_a_table_along_its_arc(family):
    table, data = family.to_dataframe(), family.to_xarray()
    assert (np.diff(table.arclength) > 0).all()
    assert len(table) == len(family.orbits)
    np.testing.assert_array_equal(data.arclength, family.arclength)
    # The energy of a release is that of the table's own angles.
    potential = -0.1 * 9.8 * 0.2 * (2 * np.cos(data.theta1) + np.cos(data.theta2))
    np.testing.assert_allclose(data.energy, potential, atol=1e-14)


def test_a_motion_is_a_row_a_time_and_a_lane(paper):
    """As `simulate` hands two motions back; then one that it made."""
    leaf = np.arange(6.0).reshape(2, 3)
    two = np.array([1e-9, 2e-9])
    state = dpend.State(leaf, 2 * leaf, 3 * leaf, 4 * leaf)
    status = np.array([0, int(dpend.Status.BEYOND_HORIZON)])
    motion = dpend.Trajectory(
        np.array([0.0, 0.5, 1.0]), state, two, two, np.array([30, 43]), status, error=1e-9 * leaf
    )
    assert "steps 30 to 43" in repr(motion)
    assert repr(motion).endswith("1 converged, 1 beyond_horizon>")
    table = motion.to_dataframe()
    assert table.lane.tolist() == [0, 0, 0, 1, 1, 1]
    assert table.time_s.tolist() == [0.0, 0.5, 1.0] * 2
    np.testing.assert_allclose(
        np.radians(table.theta2_deg), np.ravel(motion.state.theta2), rtol=1e-15
    )
    np.testing.assert_allclose(np.radians(table.error_deg), np.ravel(motion.error), rtol=1e-14)
    single = dpend.simulate(paper, dpend.released(1.0, 0.5), 0.1, step=0.01).to_dataframe()
    assert "lane" not in single
    assert len(single) == 11


def test_an_atlas_is_its_file(atlas):
    """The columns of the table are those of the CSV file, with the same numbers; that file is older
    than certificates.
    """
    import pandas

    written = pandas.read_csv(CATALOGUE, comment="#")
    table = atlas.to_dataframe()
    assert [name for name in table if name != "certificate"] == list(written)
    np.testing.assert_allclose(table.theta2_deg, written.theta2_deg, rtol=1e-15)
    assert table.status.tolist() == written.status.tolist()
    data = atlas.to_xarray()
    np.testing.assert_array_equal(data.theta2, atlas.table["theta2"])
    assert data.theta2_error.units == "rad"


@pytest.mark.slow
def test_a_fit_and_a_design_leave_too(paper, tmp_path):
    import xarray

    times = np.linspace(0, 2, 121)
    motion = dpend.simulate(paper, dpend.released(1.0, 2.0), times=times, tolerance=1e-10)
    noise = 1e-3 * np.random.default_rng(7).normal(size=(2, 121))
    fit = dpend.fit_parameters(
        times, motion.state.theta1 + noise[0], motion.state.theta2 + noise[1]
    )
    table = fit.to_dataframe()
    assert abs(table.estimates["l2_m"] - 0.2) < 4 * table.standard_errors["l2_m"]
    fit.to_xarray().to_netcdf(tmp_path / "fit.nc", engine="scipy")
    back = xarray.load_dataset(tmp_path / "fit.nc", engine="scipy")
    np.testing.assert_array_equal(back.residual1, fit.residual1)
    assert float(back.estimate.sel(parameter="l2/l1")) == float(fit.estimates["l2/l1"])
    assert len(repr(fit)) < 300
    found = dpend.design_pendulum(
        lambda orbit: orbit.period - 1, paper, ("l1", "l2"), branch="in-phase", theta1=1.0
    )
    assert abs(found.to_dataframe().period_s[0] - 1) < 1e-12
    slope = found.to_xarray().period_sensitivity.sel(parameter="l1").item()
    assert slope == float(found.sensitivities["period"]["l1"])
    assert repr(found).startswith("<Design: l1 0.12")


def test_reprs_are_short_and_true(family, orbits, atlas):
    assert repr(orbits[0]).startswith(
        "<PeriodicOrbit: centred, theta1 0.174533 rad, theta2 0.24498"
    )
    assert repr(orbits).endswith("2 converged, 1 no_such_orbit>")
    assert repr(family).startswith(f"<Family: {len(family.orbits)} centred orbits, normal mode to")
    assert repr(atlas).startswith("<Atlas: 1394 orbits, 13 families, period 0.485815 to 2 s, ")
    assert max(len(repr(one)) for one in (orbits[0], orbits, family, atlas)) < 250


def test_reprs_pass_where_numbers_do_not(orbits):
    """JAX prints trees of tracers and placeholders."""
    shown = []
    jax.jit(lambda orbit: shown.append(repr(orbit)) or orbit.period)(orbits[0])
    assert shown == ["<PeriodicOrbit: centred, theta1, theta2, period, kappa, status>"]
    repr(jax.tree.map(lambda leaf: object(), orbits))


def test_columns_of_orbits_have_one_length(family):
    assert {len(of) for of, _ in orbit_quantities(family.orbits).values()} == {54}


def test_saved_orbits_come_back(orbits, tmp_path):
    """To the last bit but for angles, which a degree may cost it; what was not found stays so."""
    path = tmp_path / "F.json"
    dpend.save_orbits(orbits, path)
    back = dpend.load_orbits(path)
    assert (back.symmetry, len(back)) == ("centred", 3)
    ours, theirs = orbit_quantities(back), orbit_quantities(orbits)
    for name, (value, unit) in theirs.items():
        if value.dtype.kind == "f":
            rtol = 3e-16 if unit == "rad" else 0
            np.testing.assert_allclose(ours[name][0], value, rtol=rtol, err_msg=name)
        else:
            assert ours[name][0].tolist() == value.tolist()
    dpend.save_orbits(orbits[0], path)
    single = dpend.load_orbits(path)
    assert np.shape(single.period) == ()
    assert single.period == float(orbits.period[0])
    follows = dpend.reference(single.pendulum, single.state, [single.period])
    assert abs(follows.state.theta2[0] - single.theta2) < 1e-10


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"format": 2}, "its format is 2, this version reads 1"),
        ({"period_s": "1"}, "period_s must be"),
        ({"dual": None}, "dual must be an object"),
        ({"status": "fine"}, "status must be one of"),
        ({"turns": [0.5, 0]}, "turns must be integers"),
        ({"orbits": []}, "orbits must be a list"),
    ],
)
def test_what_is_no_file_of_orbits_is_refused(orbits, tmp_path, change, text):
    path = tmp_path / "F.json"
    dpend.save_orbits(orbits[0], path)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(ValueError, match=f"path must be a file that save_orbits .*{text}"):
        dpend.load_orbits(path)
