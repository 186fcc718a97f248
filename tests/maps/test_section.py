"""Sections of an energy surface: as a whole, and as a store."""

import numpy as np
import pytest
import xarray

import dpend
from dpend import Plane


def test_a_section_is_the_crossings_of_its_starts(paper, tmp_path):
    scheme = dpend.Scheme("rk8-circle-rescaled", 8e-3)
    seen = []
    found = dpend.section(
        paper, -0.2, starts=70, count=23, scheme=scheme, store=tmp_path / "S.zarr",
        progress=lambda *counts: seen.append(counts),
    )  # fmt: skip
    assert seen[-1][:2] == (70 * 23, 70 * 23)
    assert np.all(found.status == dpend.Status.CONVERGED)
    assert np.all(found.energy_error < 1e-9)
    for i in (0, 69):
        angle, momentum = float(found.start_angle[i]), float(found.start_momentum[i])
        start = dpend.on_energy(paper, -0.2, 0.0, angle, p2=momentum)
        one = dpend.crossings(Plane(), paper, start, 12, scheme)
        np.testing.assert_allclose(found.time[i, :12], one.time, rtol=0, atol=1e-12)
        turned = np.remainder(found.angle[i, :12] - one.state.theta2, 2 * np.pi)
        np.testing.assert_allclose(np.minimum(turned, 2 * np.pi - turned), 0, rtol=0, atol=1e-11)
        np.testing.assert_allclose(found.momentum[i, :12], one.state.p2, rtol=0, atol=1e-12)
    kept = xarray.open_zarr(tmp_path / "S.zarr", consolidated=False)
    xarray.testing.assert_identical(kept.load(), found)
    with pytest.raises(ValueError, match="store must be a new name .*it is there already"):
        dpend.section(paper, -0.2, store=tmp_path / "S.zarr")


def test_starts_fill_what_is_allowed_evenly(paper):
    """Quarters of the area hold quarters of the starts."""
    from dpend.maps.section import fill

    starts = fill(paper, -0.3, Plane(), 4000)
    edge = np.asarray(Plane().largest_momentum(paper, -0.3, starts[:, 0]))
    assert np.all(np.abs(starts[:, 1]) < edge)
    quarters = 2 * (starts[:, 0] > 0) + (starts[:, 1] > 0)
    np.testing.assert_allclose(np.bincount(quarters) / 4000, 0.25, rtol=0, atol=0.004)


def test_an_energy_below_all_is_refused_and_a_start_beyond_is_told(paper):
    with pytest.raises(ValueError, match="energy must be above the lowest one"):
        dpend.section(paper, -0.6)
    scheme = dpend.Scheme("rk8-circle-rescaled", 8e-3)
    found = dpend.section(paper, -0.2, points=[(0.1, 0.0), (0.1, 9.0)], count=6, scheme=scheme)
    assert found.status.values.tolist() == [dpend.Status.CONVERGED, dpend.Status.NONFINITE]
