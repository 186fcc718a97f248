"""Lanes give each cell the same bits however many there are, and `jax.vmap`'s numbers."""

import os
import subprocess
import sys
from functools import partial

import jax
import numpy as np
import pytest

import dpend
from dpend import Scheme
from dpend.maps import lanes

CELLS = 200
SCHEME = Scheme("rk4-circle", 5e-3)


def end(scheme, pendulum, state):
    last = dpend.flow(pendulum, state, 1.0, scheme)
    return {"theta1": last.theta1, "theta2": last.theta2, "p1": last.p1}


END = partial(end, SCHEME)


def releases(cells=CELLS):
    angles = np.random.default_rng(1).uniform(-np.pi, np.pi, (2, cells))
    return dpend.released(*angles)


def test_lanes_are_the_vmap_of_the_function(paper):
    ours = lanes.over_lanes(END, paper, releases())
    mapped = jax.vmap(partial(END, paper))(releases())
    for key, values in mapped.items():
        np.testing.assert_allclose(ours[key], values, rtol=0, atol=1e-10)


def test_number_of_lanes_does_not_change_a_bit(paper):
    whole = lanes.over_lanes(END, paper, releases())
    state = releases()
    for cells in (1, 64, 65, 131):
        part = lanes.over_lanes(
            END, paper, jax.tree.map(lambda leaf, cells=cells: leaf[:cells], state)
        )
        for key in whole:
            np.testing.assert_array_equal(part[key], whole[key][:cells])


def test_a_poisoned_lane_leaves_the_rest_alone(paper):
    whole = lanes.over_lanes(END, paper, releases())
    angles = np.array(releases().theta1)
    angles[17] = np.nan
    poisoned = lanes.over_lanes(END, paper, dpend.State(angles, *jax.tree.leaves(releases())[1:]))
    assert np.isnan(poisoned["theta1"][17])
    others = np.arange(CELLS) != 17
    for key in whole:
        np.testing.assert_array_equal(poisoned[key][others], whole[key][others])


def test_several_launches_come_back_in_order(paper, monkeypatch):
    """Small launches, so that there are many: results in order, one trace for all."""
    monkeypatch.setattr(lanes, "_BLOCKS", 2)
    traces = []

    def index(pendulum, state):
        traces.append(1)
        return {
            "where": state.theta1,
            "number": state.theta2.astype(int),
            "even": state.theta2 % 2 == 0,
        }

    numbers = np.arange(1000.0)
    out = lanes.over_lanes(index, paper, dpend.State(numbers / 7, numbers, numbers, numbers))
    np.testing.assert_array_equal(out["where"], numbers / 7)
    np.testing.assert_array_equal(out["number"], np.arange(1000))
    np.testing.assert_array_equal(out["even"], np.arange(1000) % 2 == 0)
    before = len(traces)
    lanes.over_lanes(index, paper, dpend.State(numbers[:5], numbers[:5], numbers[:5], numbers[:5]))
    assert len(traces) == before <= 3


def test_long_motions_come_in_small_pieces(paper):
    """Of the same compiled program, with the same bits."""
    whole = lanes.over_lanes(END, paper, releases())
    pieces = list(lanes.launches(END, paper, releases(), 1e9))
    assert len(pieces) == -(-CELLS // (lanes.WIDTH * jax.local_device_count()))
    for key, values in whole.items():
        np.testing.assert_array_equal(np.concatenate([piece[key] for piece in pieces]), values)


def test_results_of_any_shape_come_lanes_last(paper):
    """A table for each lane, beside a scalar; launches are then smaller, so that there are
    several.
    """
    states = releases()

    def times_table(pendulum, x):
        return {
            "table": jax.numpy.outer(jax.numpy.arange(40.0), jax.numpy.stack([x.theta1, x.theta2])),
            "one": x.theta1,
        }

    out = lanes.over_lanes(times_table, paper, states)
    both = np.stack([states.theta1, states.theta2])
    np.testing.assert_array_equal(out["table"], np.arange(40.0)[:, None, None] * both)
    np.testing.assert_array_equal(out["one"], states.theta1)


@pytest.mark.slow
@pytest.mark.parametrize("devices", [1, 3])
def test_number_of_devices_does_not_change_a_bit(paper, devices, tmp_path):
    code = f"""
import sys; sys.path.insert(0, {os.path.dirname(__file__)!r})
import numpy as np, dpend, test_lanes
from dpend.maps import lanes
out = lanes.over_lanes(test_lanes.END, dpend.Pendulum(), test_lanes.releases())
np.save({str(tmp_path / "out.npy")!r}, np.stack(list(out.values())))
"""
    environment = os.environ | {"JAX_NUM_CPU_DEVICES": str(devices)}
    subprocess.run([sys.executable, "-c", code], check=True, env=environment)
    ours = lanes.over_lanes(END, paper, releases())
    np.testing.assert_array_equal(np.load(tmp_path / "out.npy"), np.stack(list(ours.values())))
