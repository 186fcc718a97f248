"""The command line: exactly one JSON object, one line for bad input, and files that are whole."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import dpend.atlas
import dpend.scan
from dpend import cli


@pytest.fixture(autouse=True)
def _no_cache(monkeypatch):
    """In these tests the process is pytest's own: its compiled code is not to be kept."""
    monkeypatch.setattr(cli, "_keep_compiled_code", lambda: None)


def run(capsys, *arguments):
    status = cli._run([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def run_json(capsys, *arguments):
    status, out, err = run(capsys, *arguments, "--json")
    assert err == ""
    return status, json.loads(out)


def test_both_partners_of_forty_degrees(capsys):
    status, found = run_json(capsys, "orbit", "--theta1", 40)
    assert status == 0
    inner, outer = found["orbits"]
    assert abs(inner["theta2_deg"] - 49.066544773743) < 1e-9
    assert abs(outer["theta2_deg"] + 51.139513966294) < 1e-9
    assert [inner["branch"], outer["branch"]] == ["in-phase", "anti-phase"]
    assert inner.keys() >= set(
        "theta1_deg theta2_deg period_s energy_J residual iterations status symmetry kappa stability dual turns"
        " error_estimate".split()
    )
    assert inner["error_estimate"].keys() == {"theta2_deg", "period_s"}
    assert (inner["status"], inner["symmetry"], inner["stability"]) == ("converged", "centred", "elliptic")
    # H of the release itself.
    expected = -0.2 * 9.8 * 0.2 * np.cos(np.radians(40)) - 0.1 * 9.8 * 0.2 * np.cos(np.radians(49.066544773743))
    assert abs(inner["energy_J"] - expected) < 1e-12


@pytest.mark.slow
def test_a_design(capsys):
    command = ("design", "--branch", "in-phase", "--theta1", 60, "--period", 1.0, "--free", "l1,l2")
    status, found = run_json(capsys, *command)
    assert (status, found["status"], found["at_bounds"]) == (0, "converged", [])
    orbit, pendulum = found["orbits"][0], found["pendulum"]
    assert abs(orbit["period_s"] - 1) < 1e-13
    assert abs(found["missed"]["period_s"]) < 1e-13
    assert (pendulum["m1_kg"], found["start"]["l1_m"]) == (0.1, 0.2)
    changes = [np.log(pendulum[key] / 0.2) for key in ("l1_m", "l2_m")]
    assert abs(np.hypot(*changes) - found["distance"]) < 1e-12
    # T goes as the root of a length: no less can be known of the sensitivities.
    rates = orbit["sensitivities"]["period_s"]
    assert abs(rates["l1"] + rates["l2"] - 0.5) < 1e-10
    status, out, _ = run(capsys, *command, "--bounds", "l1=0.15:0.25", "--bounds", "l2=0.15:0.25")
    assert status == 1
    assert "at bounds: l1, l2" in out
    assert "no_solution: No solution was found within the bounds" in out
    status, both = run_json(capsys, "design", "--theta1", 60, "--ratio", 2, "--free", "l1,l2")
    slow, fast = both["orbits"]
    assert (status, slow["branch"], fast["branch"]) == (0, "in-phase", "anti-phase")
    assert abs(slow["period_s"] / fast["period_s"] - 2) < 1e-12


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ((), "period, kappa or ratio must be given"),
        (("--period", 1), "branch must be given with period and kappa"),
        (("--branch", "x", "--period", 1), "branch must be one of in-phase, anti-phase, got 'x'"),
        (("--branch", "in-phase", "--period", -1), "period must be a finite positive number"),
        (("--branch", "in-phase", "--kappa", "0", "--free", "l1,x"), "free must name one or more of"),
        (("--branch", "in-phase", "--kappa", 0, "--period", 1, "--free", "g"), "free must name as many parameters"),
        (("--ratio", 2, "--bounds", "l1=1"), "bounds must be NAME=A:B, got 'l1=1'"),
        (("--ratio", 2, "--bounds", "l1=.1:.3", "--bounds", "l1=.1:.4"), "bounds must be given once a name"),
        (("--ratio", 2, "--bounds", "l1=.3:.4"), "bounds of l1 must be two numbers with the start"),
    ],
)
def test_bad_designs_are_refused_in_one_line(capsys, options, text):
    status, out, err = run(capsys, "design", "--theta1", 60, *options)
    assert (status, out) == (2, "")
    assert err.startswith("dpend: " + text)
    assert err.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize(("quantity", "value"), [("flip", "flip_time"), ("lyapunov", "lyapunov")])
def test_a_map_and_its_resumption(capsys, tmp_path, quantity, value):
    out, figure = tmp_path / "m.zarr", tmp_path / "m.png"
    command = ("map", quantity, "--size", "12x10", "--duration", 0.5, "--out", out)
    status, first = run_json(capsys, *command, "--figure", figure)
    assert (status, first["cells"], first["done"], first["failed"]) == (0, 120, 120, 0)
    assert first["steps_per_second"] > 0
    assert first["scheme"]["method"] == "rk8-circle-rescaled"
    assert figure.stat().st_size > 10_000
    import xarray

    field = xarray.open_zarr(out, consolidated=False, chunks=None)
    assert field[value].dims == ("theta1", "theta2")
    np.testing.assert_allclose(field.theta1_deg, np.arange(-165, 166, 30))
    np.testing.assert_array_equal(field[value].values, field[value].values[::-1, ::-1])
    status, again = run_json(capsys, *command)
    assert (status, again["done"], again["steps_per_second"]) == (0, 120, 0)
    status, out_text, err = run(capsys, *command, "--g", 9.7)
    assert (status, out_text, err.count("\n")) == (2, "", 1)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (("size", "0"), "size must be N or NxM"),
        (("size", "12y3"), "size must be N or NxM"),
        (("size", "999999999999"), "size must be at most 65536 along a side"),
        (("theta1", "10:-10"), "theta1 must be a range A:B with A below B"),
        (("theta2", "10"), "theta2 must be a range A:B in degrees"),
        (("duration", "-1"), "duration must be a finite positive number"),
        (("figure", "here.pdf"), "figure must end in .png"),
        (("figure", "/proc/m.png"), "figure must be a file in a directory that can be written to, got /proc/m.png"),
        (("out", "/proc/m.zarr"), "out must be a new name in a directory that can be written to, got /proc/m.zarr"),
        (("out", "/no/such/place/m.zarr"), "out must be a new name in a directory that can be written to"),
        (("out", f"{'m' * 300}.zarr"), "out must be a new name in a directory that can be written to"),
        (("out", "."), "out must be a Zarr store of a sweep or a new name, got .:"),
        (("method", "rk4"), "step must be given with method"),
        (("error", "all"), "error must be None or"),
    ],
)
def test_bad_maps_are_refused_in_one_line(capsys, tmp_path, change, text):
    options = {"size": "8", "duration": "1", "out": tmp_path / "m.zarr"} | dict([change])
    words = [word for key, value in options.items() for word in (f"--{key}", value)]
    status, out, err = run(capsys, "map", "flip", *words)
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert text in err
    assert not (tmp_path / "m.zarr").exists()


def test_map_names_are_checked(capsys, tmp_path):
    status, _, err = run(capsys, "map", "entropy", "--size", 4, "--duration", 1, "--out", tmp_path / "m.zarr")
    assert status == 2
    assert "map must be one of lyapunov, megno, flip, drift, got 'entropy'" in err


def test_the_table_names_both_partners(capsys):
    status, out, err = run(capsys, "orbit", "--theta1", "-40")
    assert (status, err) == (0, "")
    assert "-49.066544774" in out
    assert "51.139513966" in out
    assert "theta2 (deg)" in out


def test_guess_and_ratio(capsys):
    status, brake = run_json(capsys, "orbit", "--theta1", 40, "--theta2", 119.4, "--period", 1.28)
    assert (status, brake["symmetry"]) == (0, "brake")
    assert abs(brake["theta2_deg"] - 119.491215917) < 1e-8
    status, line = run_json(capsys, "orbit", "--theta1", 64.3, "--ratio", 1)
    assert abs(line["theta1_deg"] - 64.342841896400) < 1e-9


def test_what_did_not_converge_says_why(capsys):
    status, orbit = run_json(capsys, "orbit", "--theta1", 181, "--branch", "in-phase")
    assert (status, orbit["status"]) == (1, "no_such_orbit")
    assert "largest" in orbit["message"]
    status, motion = run_json(capsys, "simulate", "--theta1", 170, "--theta2", 180, "--duration", 20, "--step", 0.002)
    assert (status, motion["status"], motion["tolerance"]) == (1, "beyond_horizon", None)
    assert f"{motion['error_estimate']:.1e} rad, is above 0.1 rad" in motion["message"]


def test_nan_and_infinity_are_null(capsys):
    cli._print_json({"a": float("nan"), "b": [float("inf"), 1.0]})
    assert json.loads(capsys.readouterr().out) == {"a": None, "b": [None, 1.0]}


def test_simulate(capsys, paper):
    status, motion = run_json(
        capsys, "simulate", "--theta1", 40, "--theta2", 49.1, "--duration", 3, "--method", "rk4", "--step", 0.001
    )
    end = dpend.flow(paper, dpend.released(np.radians(40), np.radians(49.1)), 3.0, dpend.Scheme("rk4", 1e-3))
    assert status == 0
    assert motion["steps"] == 3000
    assert abs(motion["final"]["theta1_deg"] - np.degrees(end.theta1)) < 1e-9
    assert motion["final"].keys() == {"theta1_deg", "theta2_deg", "p1", "p2"}
    assert motion["error_estimate"] < 1e-8
    assert motion["energy_drift"] < 1e-10


def test_files_hold_the_motion(capsys, tmp_path):
    import xarray

    common = ("simulate", "--theta1", 40, "--theta2", 10, "--p1", 0.01, "--duration", 1, "--step", 0.01)
    for name in ("motion.csv", "motion.nc"):
        assert run(capsys, *common, "--out", tmp_path / name)[0] == 0
    table = np.genfromtxt(tmp_path / "motion.csv", delimiter=",", names=True)
    assert table.dtype.names == ("time_s", "theta1_deg", "theta2_deg", "p1_kg_m2_s", "p2_kg_m2_s")
    with xarray.open_dataset(tmp_path / "motion.nc", engine="scipy") as data:
        np.testing.assert_allclose(np.radians(table["theta1_deg"]), data.theta1, rtol=1e-15)
        np.testing.assert_allclose(table["p1_kg_m2_s"][0], 0.01)
        assert data.theta1.units == "rad"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["motion.csv", "motion.nc"]


def test_a_failed_write_leaves_the_old_file(capsys, tmp_path, monkeypatch):
    target = tmp_path / "motion.csv"
    target.write_text("old")

    def fails(motion, path):
        path.write_text("half")
        raise OSError("disk full")

    monkeypatch.setattr(cli, "_write_csv", fails)
    arguments = ("simulate", "--theta1", 40, "--theta2", 10, "--duration", 1, "--step", 0.01, "--out", target)
    status, _, err = run(capsys, *arguments)
    assert (status, err) == (2, "dpend: disk full\n")
    assert [path.name for path in tmp_path.iterdir()] == ["motion.csv"]
    assert target.read_text() == "old"


ANIMATE = ("animate", "--theta1", "10", "--theta2", "20", "--duration", "0.4")
MAP = ("map", "flip", "--size", "4", "--duration", "0.5")


@pytest.mark.parametrize(
    ("command", "option", "name"), [(ANIMATE, "out", "old.gif"), (MAP, "out", "old.zarr"), (MAP, "figure", "old.png")]
)
def test_where_nothing_can_be_written_the_old_file_stays(capsys, tmp_path, command, option, name):
    place = tmp_path / "locked"
    place.mkdir()
    (place / name).write_text("old")
    place.chmod(0o555)
    if os.access(place, os.W_OK):
        pytest.skip("this user may write anywhere")
    other = ("--out", tmp_path / "m.zarr") if option == "figure" else ()
    for file in (name, f"new{Path(name).suffix}"):
        status, out, err = run(capsys, *command, *other, f"--{option}", place / file)
        assert (status, out, err.count("\n")) == (2, "", 1)
        assert f"{option} must be" in err
        assert f"got {place / file}" in err
    assert [path.name for path in place.iterdir()] == [name]
    assert (place / name).read_text() == "old"
    assert not (tmp_path / "m.zarr").exists()


def test_numbers_that_overflow_bring_no_line_of_their_own(capsys, tmp_path):
    status, _, err = run(capsys, *ANIMATE, "--l1", "1e300", "--out", tmp_path / "f.gif")
    assert (status, err.count("\n")) == (2, 1)


SIMULATE = ("simulate", "--theta1", "40", "--theta2", "10", "--duration", "1")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("orbit", "--theta1", "nan"), "theta1 .*finite number .* nan"),
        (("orbit", "--theta1", "inf"), "theta1 .*finite number .* inf"),
        (("orbit", "--theta1", "forty"), "--theta1.*forty"),
        (("orbit",), "--theta1"),
        (("orbit", "--theta1", "40", "--m1", "0"), "m1 .*positive .* 0"),
        (("orbit", "--theta1", "40", "--l2", "-0.2"), "l2 .*positive .* -0.2"),
        (("orbit", "--theta1", "40", "--g", "0"), "g must be positive for an orbit, got 0"),
        (("orbit", "--theta1", "40", "--g", "-9.8"), "g must be positive for an orbit, got -9.8"),
        (("orbit", "--theta1", "180", "--branch", "in-phase"), "theta1 .*multiple of 180 degrees .* got 180"),
        (("orbit", "--theta1", "0"), "theta1 .*multiple of 180"),
        (("orbit", "--theta1", "180", "--theta2", "0", "--period", "1"), "equilibrium"),
        (("orbit", "--theta1", "40", "--branch", "sideways"), "branch .*in-phase, anti-phase.* 'sideways'"),
        (
            ("orbit", "--theta1", "40", "--branch", "in-phase", "--theta2", "49", "--period", "1.2"),
            "branch and guess exclude",
        ),
        (("orbit", "--theta1", "40", "--theta2", "49"), "period must be given with theta2"),
        (("orbit", "--theta1", "40", "--period", "1.2"), "theta2 must be given with period"),
        (("orbit", "--theta1", "40", "--theta2", "49", "--period", "0"), "period .*positive"),
        (("orbit", "--theta1", "40", "--ratio", "3"), "ratio must be 1 or -1, got 3"),
        (("orbit", "--theta1", "40", "--colour", "red"), "--colour"),
        (("orbits", "--theta1", "40"), "orbits"),
        ((*SIMULATE, "--step", "0"), "step .*positive .* 0"),
        ((*SIMULATE, "--step", "2"), "step must not be longer than the motion"),
        ((*SIMULATE, "--step", "0.1", "--tolerance", "1e-6"), "step and tolerance exclude"),
        ((*SIMULATE[:-1], "1e9", "--step", "1e-3"), "step must leave at most 100,000,000 states"),
        ((*SIMULATE[:-1], "1e9"), "duration must be at most"),
        ((*SIMULATE, "--method", "euler"), "method must be one of rk4, rk8"),
        ((*SIMULATE[:-1], "0"), "duration"),
        ((*SIMULATE, "--p1", "nan"), "p1 .*finite"),
        ((*SIMULATE, "--out", "motion.xls"), "out must end in .csv or .nc"),
        ((*SIMULATE, "--out", "/no/such/place/motion.csv"), "out must be a file in a directory"),
        ((*ANIMATE, "--theta1", "nan", "--theta2", "1", "--out", "f.gif"), "theta1 .*finite number .* nan"),
        ((*ANIMATE, "--m1", "0", "--out", "f.gif"), "m1 .*positive .* 0"),
        ((*ANIMATE, "--l2", "-0.2", "--out", "f.gif"), "l2 .*positive .* -0.2"),
        ((*ANIMATE, "--speed", "fast", "--out", "f.gif"), "--speed.*fast"),
        ((*ANIMATE, "--out", "/proc/z.gif"), "out must be a file in a directory .* got /proc/z.gif .*another place"),
        ((*ANIMATE, "--out", f"{'z' * 300}.gif"), "out must be a file in a directory .* got zzz"),
        ((*ANIMATE, "--out", "."), "out must end in .gif or .mp4 or .png, got .: give another name"),
    ],
)
def test_bad_input_is_one_line_and_status_two(capsys, arguments, words):
    import re

    status, out, err = run(capsys, *arguments)
    assert (status, out) == (2, "")
    assert re.search(words, err), err
    assert err.count("\n") == 1
    assert "Traceback" not in err


@pytest.mark.slow
def test_the_program_itself(tmp_path):
    """A process of its own: entry point, cache directory, and the compile options switched off."""
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), "DPEND_PLAIN_JAX": "1"}
    command = [Path(sys.executable).parent / "dpend", "orbit", "--theta1", "40", "--branch", "in-phase", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert (done.returncode, done.stderr) == (0, "")
    assert abs(json.loads(done.stdout)["theta2_deg"] - 49.066544773743) < 1e-9
    assert list((tmp_path / "dpend").iterdir())
    refused = subprocess.run([*command[:2], "--theta1", "nan"], capture_output=True, text=True, env=environment)
    assert refused.returncode == 2
    assert refused.stderr.startswith("dpend: theta1 must be a finite number")
    assert refused.stderr.count("\n") == 1


@pytest.mark.slow
def test_a_family_as_json_and_csv(capsys, tmp_path):
    status, found = run_json(capsys, "family", "--branch", "anti-phase")
    assert (status, found["status"], found["ends"]) == (0, "converged", ["normal mode", "homoclinic"])
    assert found["points"][0].keys() >= set("theta1_deg theta2_deg period_s energy_J kappa symmetry".split())
    assert {point["symmetry"] for point in found["points"]} == {"centred"}
    lost = found["bifurcations"][-1]
    assert lost["kind"] == "stability_lost"
    # 0.9890865027 rad and 6.1475153497 sqrt(l/g).
    assert abs(lost["theta1_deg"] - np.degrees(0.9890865027)) < 1e-8
    assert abs(lost["period_s"] - 6.1475153497 * np.sqrt(0.2 / 9.8)) < 1e-10
    out = tmp_path / "f.csv"
    status, text, err = run(capsys, "family", "--branch", "anti-phase", "--out", out)
    assert (status, err) == (0, "")
    assert "stability_lost" in text
    table = np.genfromtxt(out, delimiter=",", names=True, usecols=range(9))
    np.testing.assert_allclose(table["theta2_deg"], [point["theta2_deg"] for point in found["points"]], rtol=1e-15)
    run(capsys, "family", "--branch", "anti-phase", "--out", tmp_path / "f.json")
    assert json.loads((tmp_path / "f.json").read_text()) == found
    for bad in (
        ("--branch", "sideways"),
        ("--branch", "in-phase", "--out", "f.txt"),
        ("--branch", "in-phase", "--g", 0),
    ):
        status, text, err = run(capsys, "family", *bad)
        assert (status, text, err.count("\n")) == (2, "", 1)


def test_the_atlas_of_an_angle(capsys, tmp_path):
    status, found = run_json(capsys, "atlas", "--theta1", 40, "--max-period", 1.3)
    assert status == 0
    periods = [orbit["period_s"] for orbit in found["orbits"]]
    np.testing.assert_allclose(periods, [0.754418866, 0.789605931, 1.174420237, 1.212756333, 1.283263044], atol=1e-9)
    keys = set("theta1_deg theta2_deg period_s energy_J kappa symmetry dual residual".split())
    assert keys <= found["orbits"][0].keys()
    assert set("theta2_points time_points refinements suspicious_cells".split()) <= found["coverage"].keys()
    out = tmp_path / "forty.csv"
    status, text, err = run(capsys, "atlas", "--theta1", 40, "--max-period", 1.3, "--out", out)
    assert (status, err) == (0, "")
    assert "5 orbits with theta1 = 40 deg" in text
    assert "the winding number agree" in text
    np.testing.assert_allclose(dpend.load_atlas(out).table["period"], periods, rtol=1e-14)
    for bad in (
        ("--theta1", "nan", "--max-period", 1),
        ("--theta1", 40, "--max-period", 0),
        ("--theta1", 40, "--max-period", 1e9),
        ("--theta1", 40),
        ("--theta1", 40, "--max-period", 1, "--out", "f.txt"),
        ("--theta1", 40, "--max-period", 1, "--store", "s.json"),
        ("--max-period", 1, "--store", "s.zarr"),
        ("--max-period", 1, "--g", 0),
    ):
        status, text, err = run(capsys, "atlas", *bad)
        assert (status, text, err.count("\n")) == (2, "", 1)


def test_a_search_that_missed_something_says_so(capsys, monkeypatch):
    def forgetful(*arguments):
        result = dpend.scan.scanned(*arguments)
        return dataclasses.replace(result, zeros=result.zeros[1:])

    monkeypatch.setattr(dpend.atlas, "scanned", forgetful)
    status, found = run_json(capsys, "atlas", "--theta1", 40, "--max-period", 1.3)
    assert (status, len(found["orbits"]), found["coverage"]["suspicious_cells"]) == (1, 4, 1)


@pytest.mark.slow
def test_the_atlas_of_the_square(capsys, tmp_path):
    store = tmp_path / "s.json"
    status, found = run_json(capsys, "atlas", "--max-period", 1.0, "--store", store)
    assert (status, [one["family"] for one in found["families"]]) == (0, ["C1", "C2", "C3"])
    status, text, _ = run(capsys, "atlas", "--max-period", 1.0, "--store", store)
    assert status == 0
    assert "3 families" in text
