"""Maps against a loop over their cells, their symmetry to the last bit, and stores that survive
anything.
"""

import math
import os
import signal
import subprocess
import sys
import time
from functools import partial

import numpy as np
import pytest
from scipy.stats import ks_2samp

import dpend
from dpend import Pendulum, Status, chaos
from dpend.maps import disk, grid
from dpend.maps import store as stores

FLIP = partial(chaos.flip, duration=3.0)
LYAPUNOV = partial(chaos.lyapunov, duration=2.0)
SIDE = np.pi * (np.arange(24) + 0.5 - 12) / 12


def last(pendulum, state, scheme, *, duration):
    end = dpend.flow(pendulum, state, duration, scheme)
    return {"end1": end.theta1, "end2": end.theta2}


LAST = partial(last, duration=1.0)


@pytest.fixture(scope="module")
def flips(paper):
    return dpend.sweep(FLIP, paper, {"theta1": SIDE, "theta2": SIDE})


@pytest.fixture(scope="module")
def ends(paper):
    return dpend.sweep(
        LAST, paper, {"theta1": SIDE, "theta2": SIDE}, tolerance=1e-6, error="half-step"
    )


def test_a_map_is_the_loop_over_its_cells(paper, ends):
    """Against diffrax, cell by cell; the error estimate covers what is seen."""
    for i, j in ((0, 0), (3, 20), (11, 12), (17, 5), (23, 1)):
        truth = dpend.reference(paper, dpend.released(SIDE[i], SIDE[j]), [1.0], error=False)
        for key, angle in (("end1", truth.state.theta1), ("end2", truth.state.theta2)):
            missed = abs(float(ends[key][i, j]) - float(angle[-1]))
            assert missed < 1e-6
            assert missed < 2 * float(ends[f"{key}_error"][i, j]) + 1e-9


def test_symmetry_is_exact_and_saves_half(paper, ends):
    """Angles change sign, errors do not; computing every cell gives the same bits."""
    counted = []
    whole = dpend.sweep(
        LAST,
        paper,
        {"theta1": SIDE, "theta2": SIDE},
        tolerance=1e-6,
        error="half-step",
        mirror=False,
        progress=lambda done, cells, steps: counted.append((done, cells)),
    )
    for key in ends.data_vars:
        np.testing.assert_array_equal(ends[key], whole[key])
    np.testing.assert_array_equal(ends.end1.values, -ends.end1.values[::-1, ::-1])
    np.testing.assert_array_equal(ends.end1_error.values, ends.end1_error.values[::-1, ::-1])
    assert counted[-1] == (24 * 24, 24 * 24)


def test_a_quantity_without_the_symmetry_is_computed_everywhere(paper):
    def tilted(pendulum, state, scheme):
        return {"sum": state.theta1 + 2 * state.theta2 + 1.0}

    field = dpend.sweep(tilted, paper, {"theta1": SIDE, "theta2": SIDE})
    np.testing.assert_array_equal(field["sum"], SIDE[:, None] + 2 * SIDE[None, :] + 1.0)


def test_no_cell_flips_that_lacks_the_energy(flips):
    able = 2 * np.cos(SIDE)[:, None] + np.cos(SIDE)[None, :] <= 1
    flipped = np.isfinite(flips.flip_time.values)
    assert not np.any(flipped & ~able)
    assert np.sum(flipped) > 100
    assert np.all((flips.bob.values > 0) == flipped)
    assert np.all(flips.status == Status.CONVERGED)


def test_tiles_and_axes_do_not_change_a_bit(paper, flips, monkeypatch):
    monkeypatch.setattr(grid, "_TILE", 7)
    tiled = dpend.sweep(FLIP, paper, {"theta1": SIDE, "theta2": SIDE})
    turned = dpend.sweep(FLIP, paper, {"theta2": SIDE, "theta1": SIDE})
    for key in flips.data_vars:
        np.testing.assert_array_equal(flips[key], tiled[key])
        np.testing.assert_array_equal(flips[key], turned[key].T)


@pytest.mark.slow
def test_axes_of_the_pendulum(paper):
    """The Hamiltonian's own scaling: period and all times go with sqrt(l) when both lengths
    grow.
    """
    gravity = np.array([9.8, 4.9])
    field = dpend.sweep(
        LAST,
        paper,
        {"g": gravity, "theta1": np.array([0.4, 1.0])},
        at={"theta2": 0.3},
        method="rk8-circle",
        step=4e-3,
    )
    assert field.end1.dims == ("g", "theta1")
    alone = dpend.flow(Pendulum(g=4.9), dpend.released(1.0, 0.3), 1.0, dpend.Scheme("rk8", 4e-3))
    assert field.attrs["method"] == "rk8-circle"
    np.testing.assert_allclose(field.end2[1, 1], alone.theta2, atol=1e-10)


def test_failure_is_data(paper):
    """A start beyond what sine can reduce: that cell is NaN and says so, the others are as they
    were.
    """
    theta = np.array([0.5, 1e9, 1.5])
    field = dpend.sweep(LYAPUNOV, paper, {"theta2": theta}, method="rk4-circle", step=1e-2)
    assert list(field.status.values) == [Status.CONVERGED, Status.NONFINITE, Status.CONVERGED]
    clean = dpend.sweep(
        LYAPUNOV, paper, {"theta2": np.array([0.5, 0.7, 1.5])}, method="rk4-circle", step=1e-2
    )
    np.testing.assert_array_equal(field.lyapunov.values[[0, 2]], clean.lyapunov.values[[0, 2]])


@pytest.mark.slow
def test_the_tolerance_is_kept_for_other_pendulums():
    """99 in 100 releases over the square, after two periods of the slow mode, against a tenth of
    the step.
    """
    for pendulum in (Pendulum(), Pendulum(0.3, 0.2, 0.1, 0.4), Pendulum(1.0, 1.0, 1.0, 0.1, 1.0)):
        duration = 26.0 / float(dpend.normal_modes(pendulum)[1].frequency)
        scheme = dpend.scheme_for(pendulum, 1e-6)
        axes = {"theta1": SIDE, "theta2": SIDE}
        settings = {"method": scheme.name, "step": scheme.step, "error": "half-step"}
        field = dpend.sweep(partial(last, duration=duration), pendulum, axes, **settings)
        worst = np.maximum(field.end1_error, field.end2_error)
        assert np.quantile(worst, 0.99) < 3e-6


def test_a_store_holds_the_map(paper, flips, tmp_path):
    import xarray

    axes, store = {"theta1": SIDE, "theta2": SIDE}, tmp_path / "map.zarr"
    field = dpend.sweep(FLIP, paper, axes, store=store)
    again = dpend.sweep(FLIP, paper, axes, store=store)
    opened = xarray.open_zarr(store, consolidated=False, chunks=None)
    for each in (field, again, opened):
        for key in flips.data_vars:
            np.testing.assert_array_equal(each[key], flips[key])
        np.testing.assert_allclose(each.theta1_deg, np.degrees(SIDE))
    assert opened.flip_time.attrs["units"] == "s"
    assert opened.attrs["quantity"] == "dpend.chaos.flip"
    with pytest.raises(ValueError, match="holds another sweep, its g is 9.8, not 9.7"):
        dpend.sweep(FLIP, Pendulum(g=9.7), axes, store=store)
    with pytest.raises(ValueError, match=r"its quantity_settings is .*3.0.*, not .*4.0"):
        dpend.sweep(partial(chaos.flip, duration=4.0), paper, axes, store=store)
    with pytest.raises(ValueError, match="its axes_sha256 is"):
        dpend.sweep(FLIP, paper, {"theta1": SIDE, "theta2": SIDE / 2}, store=store)
    with pytest.raises(ValueError, match="must be a Zarr store of a sweep or a new name"):
        dpend.sweep(FLIP, paper, axes, store=tmp_path)
    with pytest.raises(
        ValueError, match=r"store must be a new name in a directory .* got /no/such/place/m\.zarr"
    ):
        dpend.sweep(FLIP, paper, axes, store="/no/such/place/m.zarr")
    with pytest.raises(ValueError, match="name must be given to store a lambda or a closure"):
        dpend.sweep(lambda p, x, s: {"a": x.theta1}, paper, axes, store=tmp_path / "b.zarr")


def contents(store):
    return {
        path.relative_to(store): path.read_bytes()
        for path in sorted(store.rglob("*"))
        if path.is_file()
    }


def test_a_store_that_cannot_be_written_to_is_read_if_it_is_finished(paper, tmp_path, monkeypatch):
    monkeypatch.setattr(grid, "_TILE", 7)
    axes, store = {"theta1": SIDE, "theta2": SIDE}, tmp_path / "map.zarr"
    field = dpend.sweep(FLIP, paper, axes, store=store)
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert dpend.sweep(FLIP, paper, axes, store=store).equals(field)
    (store / "status" / "c" / "0" / "0").unlink()
    before = contents(store)
    with pytest.raises(ValueError, match="store must be finished or one that can be written to"):
        dpend.sweep(FLIP, paper, axes, store=store)
    assert contents(store) == before


def test_an_unfinished_store_is_finished_with_the_same_bytes(paper, tmp_path, monkeypatch):
    """Stopped at every tile in turn, one of them between its values and its status."""
    monkeypatch.setattr(grid, "_TILE", 7)
    monkeypatch.setattr(disk, "sync", lambda place: None)
    axes = {"theta1": SIDE, "theta2": SIDE}
    dpend.sweep(FLIP, paper, axes, store=tmp_path / "whole.zarr")
    write, stopped, tries = stores.Store._write_chunk, tmp_path / "stopped.zarr", 0

    def breaks(*arguments):
        nonlocal tries
        tries += 1
        if tries % 6 == 0:
            raise KeyboardInterrupt
        return write(*arguments)

    monkeypatch.setattr(stores.Store, "_write_chunk", breaks)
    for _ in range(200):
        try:
            dpend.sweep(FLIP, paper, axes, store=stopped)
            break
        except KeyboardInterrupt:
            (stopped / "status" / "left.partial").write_bytes(b"half a chunk")
    assert tries > 60
    assert contents(stopped) == contents(tmp_path / "whole.zarr")


@pytest.mark.slow
def test_killed_at_any_moment(tmp_path):
    """kill -9 once a few chunks are there, several times over, then to the end."""
    command = [
        sys.executable,
        "-m",
        "dpend.cli",
        "map",
        "lyapunov",
        "--size",
        "600x520",
        "--duration",
        "4",
        "--json",
    ]
    subprocess.run(
        [*command, "--out", str(tmp_path / "whole.zarr")], check=True, stdout=subprocess.DEVNULL
    )
    store, seen = tmp_path / "killed.zarr", 0
    for _ in range(3):
        process = subprocess.Popen([*command, "--out", str(store)], stdout=subprocess.DEVNULL)
        while process.poll() is None and len(list(store.glob("status/c/*/*"))) <= seen:
            time.sleep(0.002)
        seen = len(list(store.glob("status/c/*/*")))
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    assert 0 < seen < 9
    subprocess.run([*command, "--out", str(store)], check=True, stdout=subprocess.DEVNULL)
    assert contents(store) == contents(tmp_path / "whole.zarr")


def test_bad_sweeps_are_refused(paper):
    axes = {"theta1": SIDE}
    for settings, text in (
        ({"axes": {}}, "axes must be one or two, got 0"),
        ({"axes": {"angle": SIDE}}, "must be fields of State or Pendulum, got 'angle'"),
        (
            {"axes": {"theta1": [0.0, math.nan]}},
            "axis theta1 must be a one-dimensional array of finite numbers",
        ),
        ({"axes": {"l1": [0.1, -1.0]}}, "axis l1 must be positive, got -1"),
        ({"at": {"theta1": 1.0}}, "at must name fields of State that are no axis, got 'theta1'"),
        ({"tolerance": -1.0}, "tolerance must be a finite positive number"),
        ({"tolerance": 1e-6, "method": "rk4", "step": 1e-3}, "tolerance excludes method and step"),
        ({"method": "rk4"}, "step must be given with method"),
        ({"method": "euler", "step": 0.1}, "method must be one of rk4"),
        (
            {"quantity": lambda p, x, s: {"theta1": x.p1}},
            "must not bear the name of a coordinate, got 'theta1'",
        ),
        ({"error": "richardson"}, 'error must be None or "half-step"'),
    ):
        with pytest.raises(ValueError, match=text):
            dpend.sweep(**({"quantity": LYAPUNOV, "pendulum": paper, "axes": axes} | settings))
    with pytest.raises(ValueError, match="g must not be zero for a tolerance"):
        dpend.sweep(LYAPUNOV, Pendulum(g=0.0), axes)
    with pytest.raises(ValueError, match="quantity must have settings that can be hashed"):
        dpend.sweep(partial(cheap, factors=[1.0]), paper, axes)


def test_no_gravity_at_an_end_of_the_axis(paper):
    """The step is that of the pendulums that have one, as where zero lies inside."""
    ends, inside = ({"g": np.array(values)} for values in ([0.0, 9.8], [-9.8, 0.0, 9.8]))
    steps = [
        dpend.sweep(cheap, paper, axes, at={"theta1": 1.0}).attrs["step"] for axes in (ends, inside)
    ]
    assert steps == [dpend.scheme_for(paper, 1e-6).step] * 2


def cheap(pendulum, state, scheme, *, factors=(1.0, 2.0), duration=1.0):
    return {"sum": factors[0] * state.theta1 + factors[1] * state.theta2}


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        (
            {"duration": 1e6},
            "at most 1e.06 steps to one motion and 1e.12 to all, got duration 1e.06 s, step 0.0289 "
            "s",
        ),
        ({"duration": 1e300}, "got duration 1e.300 s"),
        (
            {"step": 1e-9, "method": "rk4"},
            "step 1e-09 s, which make 1e.09 and 1.2e.10: give a shorter duration, a larger",
        ),
        ({"pendulum": Pendulum(g=1e300)}, "got duration 1 s, step 9.05e-152 s"),
        ({"pendulum": Pendulum(l1=1e-300)}, "got duration 1 s"),
        ({"pendulum": Pendulum(m2=1e300)}, "got duration 1 s"),
        (
            {"at": {"p2": 10.0}, "duration": 100.0},
            "steps to one motion",
        ),  # turns fast: short steps all the way
        ({"most_steps": 100.0}, "at most 0.0001 steps to one motion and 100 to all"),
        ({"most_steps": 1e16}, r"most_steps must be at most 1e\+15, got 1e\+16"),
        ({"most_steps": math.nan}, "most_steps must be a finite positive number"),
    ],
)
def test_what_would_never_end_is_refused(paper, tmp_path, settings, text):
    """Before anything is computed or written, and before JAX traces a loop that it cannot count."""
    duration = settings.pop("duration", 1.0)
    quantity = partial(chaos.flip, duration=duration)
    settings = {
        "pendulum": paper,
        "axes": {"theta1": SIDE},
        "store": tmp_path / "m.zarr",
    } | settings
    with pytest.raises(ValueError, match=text):
        dpend.sweep(quantity, **settings)
    assert list(tmp_path.iterdir()) == []


def test_the_limit_that_is_told_is_enough(paper):
    """Of what is refused, the line says which limit lets it pass, and no less does."""
    settings = {"pendulum": paper, "axes": {"theta1": SIDE}, "method": "rk4", "step": 1e-2}
    with pytest.raises(ValueError, match="or most_steps=1.01e.08") as refused:
        dpend.sweep(partial(cheap, duration=1.0), **settings, most_steps=1e6)
    enough = float(str(refused.value).rpartition("=")[2])
    told = []
    dpend.sweep(partial(cheap, duration=1.0), **settings, most_steps=enough, announce=told.append)
    assert (told[0].cells, told[0].each, told[0].steps) == (
        12,
        100.0,
        1200.0,
    )  # the other 12 are images
    assert told[0].bytes == 24 * 9
    with pytest.raises(ValueError, match="steps to one motion"):
        dpend.sweep(partial(cheap, duration=1.0), **settings, most_steps=0.97 * enough)


def counted(pendulum, state, scheme):
    return {"angle": state.theta1, "steps": (1e7 + 0.0 * state.theta1).astype(int)}


def test_the_first_cells_tell_what_no_setting_does(paper):
    with pytest.raises(ValueError, match=r"got step 0.0289 s, which make 1e\+07 and 1.2e\+08"):
        dpend.sweep(counted, paper, {"theta1": SIDE})
    assert dpend.sweep(counted, paper, {"theta1": SIDE}, most_steps=1e14).angle.shape == (24,)


def test_more_than_the_memory_is_refused(paper):
    axes = {"theta1": np.linspace(0.0, 1.0, 3_000_000), "theta2": np.linspace(0.0, 1.0, 3_000_000)}
    with pytest.raises(
        ValueError,
        match="axes must leave values that the memory holds, got .* GB for .*: give a store",
    ):
        dpend.sweep(cheap, paper, axes)


class Scaled:
    """A quantity with a state of its own."""

    def __init__(self, factor):
        self.factor = factor

    def __call__(self, pendulum, state, scheme):
        return {"angle": self.factor * state.theta1}

    def scaled(self, pendulum, state, scheme):
        return self(pendulum, state, scheme)


def test_quantities_that_look_alike_need_a_name(paper, tmp_path):
    """Two objects of a class, and what was typed at a prompt, have nothing to be told apart by."""
    typed = {}
    exec("def typed(pendulum, state, scheme): return {'angle': state.theta1}", typed)
    for quantity in (Scaled(2.0), Scaled(2.0).scaled, typed["typed"]):
        with pytest.raises(
            ValueError, match="name must be given to store a quantity that is no function in a file"
        ):
            dpend.sweep(quantity, paper, {"theta1": SIDE}, store=tmp_path / "m.zarr")
    store = tmp_path / "m.zarr"
    dpend.sweep(Scaled(2.0), paper, {"theta1": SIDE}, store=store, name="twice the angle")
    with pytest.raises(
        ValueError, match="its quantity is 'twice the angle', not 'thrice the angle'"
    ):
        dpend.sweep(Scaled(3.0), paper, {"theta1": SIDE}, store=store, name="thrice the angle")


@pytest.mark.slow
def test_chaotic_exponents_agree_in_distribution(paper):
    """Where two passes part, cells differ, and the exponents are drawn from one distribution all
    the same.
    """
    side = np.pi * (np.arange(64) + 0.5 - 32) / 32
    quantity = partial(chaos.lyapunov, duration=8.0)
    coarse, fine = (
        dpend.sweep(
            quantity, paper, {"theta1": side, "theta2": side}, tolerance=tolerance
        ).lyapunov.values.ravel()
        for tolerance in (1e-4, 1e-8)
    )
    chaotic = np.abs(coarse - fine) > 0.05
    assert np.sum(chaotic) > 1000
    # Half the cells are the others' mirror images.
    half = chaotic.copy()
    half[half.size // 2 :] = False
    assert ks_2samp(coarse[half], fine[half]).pvalue > 0.01
