"""What is drawn is what was computed."""

from functools import partial

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray

import dpend
from dpend import plots


@pytest.fixture(scope="module")
def motion(paper):
    return dpend.simulate(paper, dpend.released(1.0, 0.5), 1.0, step=0.01)


@pytest.fixture(autouse=True)
def _close():
    yield
    plt.close("all")


def test_path_and_angles_are_in_degrees(motion):
    curve = plots.path(motion).lines[0]
    np.testing.assert_allclose(np.radians(curve.get_xdata()), motion.state.theta1, rtol=1e-14)
    np.testing.assert_allclose(np.radians(curve.get_ydata()), motion.state.theta2, rtol=1e-14)
    ax = plots.angles(motion)
    np.testing.assert_allclose(ax.lines[1].get_ydata(), curve.get_ydata())
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("time (s)", "angle (deg)")


def test_energies_add_up_to_a_constant(paper, motion):
    ax = plots.energy(paper, motion)
    total = sum(line.get_ydata() for line in ax.lines)
    np.testing.assert_allclose(total, total[0], rtol=1e-9)
    assert ax.get_legend().get_texts()[0].get_text() == "kinetic, upper bob"


def test_strobe_draws_rods_of_the_right_length(paper, motion):
    ax = plots.strobe(paper, motion, every=10)
    lengths = [np.hypot(np.diff(line.get_xdata()), np.diff(line.get_ydata())) for line in ax.lines]
    rods = [length[0] for length in lengths if length.size == 1]
    assert len(rods) == 2 * 11
    np.testing.assert_allclose(rods, 0.2, rtol=1e-14)
    assert len(plots.strobe(paper, motion, lw=3).lines) == 4 * 15 + 1


def test_orbit_sheet_shows_whole_orbits(paper):
    orbit = dpend.find_orbit(paper, np.radians(40), branch="in-phase")
    figure = plots.orbit_sheet({"in-phase": orbit})
    _, path, angles = figure.axes
    x = path.lines[0].get_xdata()
    np.testing.assert_allclose([x[0], x[-1]], 40, atol=1e-9)
    np.testing.assert_allclose(x[len(x) // 2], -40, atol=1e-9)
    assert "elliptic" in angles.get_title()


@pytest.mark.slow
def test_a_map_shows_its_cells_and_the_line_no_flip_crosses(paper):
    side = np.pi * (np.arange(10) + 0.5 - 5) / 5
    field = dpend.sweep(
        partial(dpend.chaos.flip, duration=1.0), paper, {"theta1": side, "theta2": side}
    )
    ax = plots.map_of(field)
    mesh, line = ax.collections[0], ax.collections[1]
    shown = np.ma.filled(mesh.get_array(), np.nan).reshape(10, 10)
    expected = np.where(np.isfinite(field.flip_time.values), field.flip_time.values, np.nan).T
    np.testing.assert_array_equal(shown, expected)
    on_line = np.radians(np.concatenate([path.vertices for path in line.get_paths()]))
    assert (
        np.max(np.abs(2 * np.cos(on_line[:, 0]) + np.cos(on_line[:, 1]) - 1)) < 0.15
    )  # of a coarse grid
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("theta1 (deg)", "theta2 (deg)")
    with pytest.raises(
        ValueError, match="name must be one of bob, flip_time, steps, status, got 'flips'"
    ):
        plots.map_of(field, "flips")


def test_a_family_is_solid_where_it_is_stable(paper):
    """The solid line ends at the last stable orbit before stability is lost, and every special
    point has its mark.
    """
    family = dpend.follow_family(paper, "anti-phase")
    ax = plots.family(family, plane="period")
    whole, solid, *marks = ax.lines
    assert len(whole.get_xdata()) == len(family.arclength)
    lost = family.special_points[-1].orbit.energy
    energies = np.asarray(solid.get_xdata())
    reach = np.nanmax(energies)
    assert reach < lost
    assert np.sum((family.orbits.energy > reach) & (family.orbits.energy < lost)) == 0
    assert sum(len(mark.get_xdata()) for mark in marks) == len(family.special_points)
    with pytest.raises(ValueError, match="plane must be one of angles, period, upright, got 'mom"):
        plots.family(family, plane="momenta")
    # Several in one: a colour and a name each; near the upright state the period grows like
    # 2/lambda times minus the logarithm of the distance, a straight line here.
    ax = plots.families({"fast": family, "again": family}, plane="upright", lw=3)
    whole, solid = ax.lines[:2]
    assert (solid.get_label(), solid.get_linewidth(), ax.get_xscale()) == ("fast", 3, "log")
    assert ax.xaxis_inverted()
    slow = np.min(np.abs(dpend.equilibria(paper).exponents[3].real))
    gap, period = np.asarray(whole.get_xdata()), np.asarray(whole.get_ydata())
    late = gap < 1e-6
    slope = np.polyfit(np.log(gap[late]), period[late], 1)[0]
    np.testing.assert_allclose(-slope, 2 / float(slow), rtol=1e-3)
    names = [text.get_text() for text in ax.get_legend().get_texts()]
    assert names[:3] == ["fast", "again", "stability changes"]
    assert len({line.get_color() for line in ax.lines}) == 2


def test_an_atlas_shows_every_orbit():
    """Drawn from the file of the paper's pendulum: filled where |kappa| <= 1."""
    found = dpend.load_atlas("experiments/atlas/brake_orbits.csv")
    ax = plots.atlas(found)
    assert sum(len(line.get_xdata()) for line in ax.lines) == len(found)
    stable = [line for line in ax.lines if line.get_label() in found.table["family"]]
    calm = np.abs(found.table["kappa"]) <= 1 + 1e-9
    assert sum(len(line.get_xdata()) for line in stable) == np.sum(calm)
    assert len(ax.get_legend().get_texts()) == len(found.families)


def test_a_map_by_hand_has_a_bar_as_high_as_itself_and_says_what_it_is():
    side = np.radians(np.linspace(-90, 90, 4))
    made = xarray.Dataset(
        {"lyapunov": (("theta1", "theta2"), np.arange(16.0).reshape(4, 4))},
        {"theta1": side, "theta2": side},
        {"l1": 0.2, "l2": 0.3, "g": 9.8, "quantity_settings": '[[], {"duration": 2.5}]'},
    )
    ax = plots.map_of(made, cmap="magma", vmin=1.0)
    mesh = ax.collections[0]
    assert (mesh.get_cmap().name, mesh.norm.vmin) == ("magma", 1.0)
    assert ax.get_title(loc="left") == "2.5 s, l1 = 0.2 m, l2 = 0.3 m, g = 9.8 m/s$^2$"
    ax.figure.canvas.draw()
    heights = [one.get_window_extent().height for one in (ax, ax.child_axes[0])]
    assert abs(heights[0] - 1.06 * heights[1]) < 0.5  # with the arrows at both ends


def test_a_section_shows_the_mirror_of_what_falls_and_its_periodic_points():
    """Drawn from a dataset made by hand: crossings of side -1 are turned into those of side 1."""
    both = ("start", "crossing")
    data = {
        "angle": (both, [[0.1, -0.2], [0.3, np.nan]]),
        "momentum": (both, [[0.01, -0.02], [0.03, np.nan]]),
        "side": (both, np.array([[1, -1], [1, 0]], np.int8)),
    }
    attributes = {"l1": 0.2, "l2": 0.2, "m1": 0.1, "m2": 0.1, "g": 9.8, "energy": -0.3}
    found = xarray.Dataset(data, attrs=attributes | {"plane": "theta1", "plane_at": 0.0})
    orbits = xarray.Dataset(
        {
            "angle": (("orbit", "return"), [[0.0], [0.5]]),
            "momentum": (("orbit", "return"), [[0.02], [0.01]]),
            "kappa": ("orbit", [0.3, 2.0]),
        }
    )
    ax = plots.section(found, periodic=orbits)
    dots, stable, unstable = (item.get_offsets().data for item in ax.collections)
    expected = [[np.degrees(0.1), 0.01], [np.degrees(0.2), 0.02], [np.degrees(0.3), 0.03]]
    np.testing.assert_allclose(dots, expected)
    np.testing.assert_allclose(stable, [[0.0, 0.02]])
    np.testing.assert_allclose(unstable, [[np.degrees(0.5), 0.01]])
    assert (ax.get_xlabel(), ax.get_title()) == ("theta2 (deg)", "theta1 = 0 deg, E = -0.3 J")
    with pytest.raises(ValueError, match="dataset must hold .* got one without angle"):
        plots.section(orbits.drop_vars("angle"))
