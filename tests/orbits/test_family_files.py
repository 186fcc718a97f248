"""A family that comes back from a file is the one that was followed."""

import json

import jax
import numpy as np
import pytest

import dpend


@pytest.fixture(scope="module")
def saved(paper, tmp_path_factory):
    family = dpend.follow_family(paper, "anti-phase")
    path = tmp_path_factory.mktemp("family") / "family.json"
    dpend.save_family(family, str(path))
    return family, path


def test_a_family_comes_back_as_it_was(saved):
    """Every number to rounding, the special points, and what it can do: orbits in between, their
    derivatives, and a branch.
    """
    family, path = saved
    back = dpend.load_family(path)
    assert (back.ends, back.symmetry, int(back.status)) == (family.ends, family.symmetry, 0)
    for name in ("theta1", "theta2", "period", "energy"):
        ours, theirs = (np.asarray(getattr(x.orbits, name)) for x in (back, family))
        np.testing.assert_allclose(ours, theirs, rtol=1e-11)
    np.testing.assert_allclose(back.orbits.log_abs_kappa[30:], family.orbits.log_abs_kappa[30:])
    np.testing.assert_allclose(back.arclength, family.arclength, rtol=1e-12)
    kinds = [[point.kind for point in one.special_points] for one in (back, family)]
    assert kinds[0] == kinds[1]
    # 0.9890865027 rad, where the anti-phase family loses its stability.
    np.testing.assert_allclose(back.special_points[-1].orbit.theta1, 0.9890865027, rtol=1e-9)
    slope = jax.grad(lambda theta1: back.at(theta1).period)
    np.testing.assert_allclose(slope(0.7), jax.grad(lambda x: family.at(x).period)(0.7), rtol=1e-9)
    # Below its first orbit lies the normal mode, which the file has, too.
    np.testing.assert_allclose(back.at(0.001).period, family.at(0.001).period, rtol=1e-12)
    assert dpend.follow_family(dpend.Pendulum(), back.special_points[-1]).symmetry == "odd"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"format": 2}, "its format is 2, this version reads 1"),
        ({"curve": None}, "it has no curve"),
        ({"ends": ["normal mode", "nowhere"]}, "ends must be one of"),
        ({"symmetry": "odd"}, "its nodes are no orbits of its pendulum"),
        ({"pendulum": {"l1_m": 0.3}}, "l2_m must be"),
        ({"nodes": [[1.0, 2.0]]}, "its nodes must be rows of 66 numbers"),
        ({"nodes": "x"}, "nodes must be finite numbers"),
        ({"shift": 1e-3}, "its nodes are no orbits of its pendulum"),
        ({"mode": {"nodes": [1], "tangent": [1]}}, "its mode must be 66 numbers"),
    ],
)
def test_a_file_that_holds_no_family_is_refused(saved, tmp_path, change, words):
    found = json.loads(saved[1].read_text())
    if "shift" in change:
        found["curve"]["nodes"][20][7] += change["shift"]
    else:
        place = found["curve"] if set(change) & {"nodes", "mode"} else found
        place.update(change)
    path = tmp_path / "family.json"
    path.write_text(json.dumps(found))
    with pytest.raises(ValueError, match=f"path must be a file that save_family .*{words}"):
        dpend.load_family(path)
