"""The command line: exactly one JSON object, one line for bad input, and files that are whole."""

import dataclasses
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.main import get_command

import dpend
import dpend.catalogue.release
import dpend.catalogue.scan
from dpend import cli, report, terminal, writing


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
        "theta1_deg theta2_deg period_s energy_J residual iterations status symmetry kappa "
        "stability dual turns"
        " error_estimate".split()
    )
    assert inner["error_estimate"].keys() == {"theta2_deg", "period_s"}
    assert (inner["status"], inner["symmetry"], inner["stability"]) == (
        "converged",
        "centred",
        "elliptic",
    )
    # H of the release itself.
    expected = -0.2 * 9.8 * 0.2 * np.cos(np.radians(40)) - 0.1 * 9.8 * 0.2 * np.cos(
        np.radians(49.066544773743)
    )
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
    assert "no_solution: Nothing within the bounds satisfies the equations" in out
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
        (
            ("--branch", "in-phase", "--kappa", "0", "--free", "l1,x"),
            "free must name one or more of",
        ),
        (
            ("--branch", "in-phase", "--kappa", 0, "--period", 1, "--free", "g"),
            "free must name as many parameters",
        ),
        (("--ratio", 2, "--bounds", "l1=1"), "bounds must be NAME=A:B, got 'l1=1'"),
        (
            ("--ratio", 2, "--bounds", "l1=.1:.3", "--bounds", "l1=.1:.4"),
            "bounds must be given once a name",
        ),
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
        (("figure", "here.gif"), "figure must end in .png"),
        (
            ("figure", "/proc/m.png"),
            "figure must be a file in a directory that can be written to, got /proc/m.png",
        ),
        (
            ("out", "/proc/m.zarr"),
            "out must be a new name in a directory that can be written to, got /proc/m.zarr",
        ),
        (
            ("out", "/no/such/place/m.zarr"),
            "out must be a new name in a directory that can be written to",
        ),
        (
            ("out", f"{'m' * 300}.zarr"),
            "out must be a new name in a directory that can be written to",
        ),
        (("out", "."), "out must be a Zarr store of a sweep or a new name, got .:"),
        (("method", "rk4"), "step must be given with method"),
        (("error", "all"), "error must be None or"),
        (("duration", "1e6"), "duration and step must leave at most 1e+06 steps to one motion"),
        (("l1", "1e-300"), "duration and step must leave at most 1e+06 steps to one motion"),
        (
            ("most-steps", "1e3"),
            "duration and step must leave at most 0.001 steps to one motion and 1e+03 to all",
        ),
    ],
)
def test_bad_maps_are_refused_in_one_line(capsys, tmp_path, change, text):
    options = {"size": "8", "duration": "1", "out": tmp_path / "m.zarr"} | dict([change])
    words = [word for key, value in options.items() for word in (f"--{key}", value)]
    status, out, err = run(capsys, "map", "flip", *words)
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert text in err
    assert not (tmp_path / "m.zarr").exists()


def test_a_damaged_map_is_mended_and_a_long_one_told(capsys, tmp_path, monkeypatch):
    """One line each on standard error; the result is what it was."""
    monkeypatch.setattr(terminal, "_LONG", 0.0)
    command = ("map", "flip", "--size", "8", "--duration", "1", "--out", tmp_path / "m.zarr")
    status, _, err = run(capsys, *command)
    assert (status, err.count("\n")) == (0, 1)
    assert err.startswith(
        "dpend: about 1.5e+03 time steps, which may take 1 minutes, for 32 cells; "
    )
    chunk = tmp_path / "m.zarr" / "flip_time" / "c" / "0" / "0"
    right = chunk.read_bytes()
    chunk.write_bytes(right[:-1])
    monkeypatch.setattr(terminal, "_LONG", 60.0)
    status, _, err = run(capsys, *command)
    assert (status, chunk.read_bytes()) == (0, right)
    assert err == (
        f"dpend: store {tmp_path / 'm.zarr'} is damaged: flip_time/c/0/0 has other bytes than were "
        f"written; "
        "what is damaged is made again, 1 of 4 tiles\n"
    )


def test_map_names_are_checked(capsys, tmp_path):
    status, _, err = run(
        capsys, "map", "entropy", "--size", 4, "--duration", 1, "--out", tmp_path / "m.zarr"
    )
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
    status, motion = run_json(
        capsys, "simulate", "--theta1", 170, "--theta2", 180, "--duration", 20, "--step", 0.002
    )
    assert (status, motion["status"], motion["tolerance"]) == (1, "beyond_horizon", None)
    assert f"{motion['error_estimate']:.1e} rad, is above 0.1 rad" in motion["message"]


def test_nan_and_infinity_are_null(capsys):
    report.print_json({"a": float("nan"), "b": [float("inf"), 1.0]})
    assert json.loads(capsys.readouterr().out) == {"a": None, "b": [None, 1.0]}


def test_simulate(capsys, paper):
    status, motion = run_json(
        capsys,
        "simulate",
        "--theta1",
        40,
        "--theta2",
        49.1,
        "--duration",
        3,
        "--method",
        "rk4",
        "--step",
        0.001,
    )
    end = dpend.flow(
        paper, dpend.released(np.radians(40), np.radians(49.1)), 3.0, dpend.Scheme("rk4", 1e-3)
    )
    assert status == 0
    assert motion["steps"] == 3000
    assert abs(motion["final"]["theta1_deg"] - np.degrees(end.theta1)) < 1e-9
    assert motion["final"].keys() == {"theta1_deg", "theta2_deg", "p1", "p2"}
    assert motion["error_estimate"] < 1e-8
    assert motion["energy_drift"] < 1e-10


def test_a_motion_by_its_angular_velocities(capsys, paper, tmp_path):
    """The same state in momenta gives the same motion; and the picture is there."""
    figure = tmp_path / "motion.svg"
    rates = ("--omega1", 90, "--omega2", -30)
    status, found = run_json(capsys, *SIMULATE, *rates, "--figure", figure)
    assert status == 0
    assert "<svg" in figure.read_text()
    state = dpend.momenta(paper, *np.radians([40, 10, 90, -30]))
    given = ("--p1", repr(float(state.p1)), "--p2", repr(float(state.p2)))
    _, same = run_json(capsys, *SIMULATE, *given)
    for name in ("theta1_deg", "theta2_deg", "p1", "p2"):
        assert abs(found["final"][name] - same["final"][name]) < 1e-8
    status, out, err = run(capsys, *SIMULATE, "--omega1", 1, "--p2", 1)
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert "omega1 and omega2 exclude p1 and p2, got p2 and omega1" in err


def test_an_orbit_in_a_picture_and_a_film(capsys, tmp_path):
    figure, film = tmp_path / "orbit.png", tmp_path / "orbit.gif"
    words = ("orbit", "--theta1", 40, "--branch", "anti-phase")
    status, out, err = run(capsys, *words, "--figure", figure, "--film", film)
    assert (status, err) == (0, "")
    assert [line for line in out.splitlines() if line.startswith("written")] == [
        f"written to {figure}", f"written to {film}"
    ]  # fmt: skip
    with Image.open(film) as pictures:
        # T = 0.754418866 s at 25 pictures a second; the next one would be the first again.
        assert pictures.n_frames == 19
    with Image.open(figure) as picture:
        assert picture.width > 1000
    for words, line in (
        (("--theta1", 40, "--film", film), "film must be of one orbit, .* give --branch"),
        (("--theta1", 40, "--branch", "in-phase", "--film", "f.png"), "film must end in .gif or"),
        (("--theta1", 40, "--figure", "f.gif"), "figure must end in .png or .pdf or .svg"),
        (
            ("--theta1", 0, "--theta2", 0, "--omega1", 9, "--period", 1),
            "omega2 must be given with an angular velocity",
        ),
    ):
        status, out, err = run(capsys, "orbit", *words)
        assert (status, out, err.count("\n")) == (2, "", 1)
        assert re.search(line, err), err


def test_files_hold_the_motion(capsys, tmp_path):
    import xarray

    common = (
        "simulate",
        "--theta1",
        40,
        "--theta2",
        10,
        "--p1",
        0.01,
        "--duration",
        1,
        "--step",
        0.01,
    )
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

    monkeypatch.setattr(writing, "_write_csv", fails)
    arguments = (
        "simulate",
        "--theta1",
        40,
        "--theta2",
        10,
        "--duration",
        1,
        "--step",
        0.01,
        "--out",
        target,
    )
    status, _, err = run(capsys, *arguments)
    assert (status, err) == (2, "dpend: disk full\n")
    assert [path.name for path in tmp_path.iterdir()] == ["motion.csv"]
    assert target.read_text() == "old"


ANIMATE = ("animate", "--theta1", "10", "--theta2", "20", "--duration", "0.4")
MAP = ("map", "flip", "--size", "4", "--duration", "0.5")


@pytest.mark.parametrize(
    ("command", "option", "name"),
    [(ANIMATE, "out", "old.gif"), (MAP, "out", "old.zarr"), (MAP, "figure", "old.png")],
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
        (
            ("orbit", "--theta1", "180", "--branch", "in-phase"),
            "theta1 .*multiple of 180 degrees .* got 180",
        ),
        (("orbit", "--theta1", "0"), "theta1 .*multiple of 180"),
        (("orbit", "--theta1", "180", "--theta2", "0", "--period", "1"), "equilibrium"),
        (
            ("orbit", "--theta1", "40", "--branch", "sideways"),
            "branch .*in-phase, anti-phase.* 'sideways'",
        ),
        (
            (
                "orbit",
                "--theta1",
                "40",
                "--branch",
                "in-phase",
                "--theta2",
                "49",
                "--period",
                "1.2",
            ),
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
        (
            (*SIMULATE[:-1], "1e9", "--step", "1e-3"),
            "step must make at most 2,000,000 steps, got 0.001 s, .*most_steps",
        ),
        ((*SIMULATE, "--step", "5e-324"), "step must make at most 1e.12 steps"),
        ((*SIMULATE, "--step", "1e-9"), "step must make at most 2,000,000 steps"),
        ((*SIMULATE, "--g", "1e300"), "duration must be at most some .* give a shorter one"),
        ((*SIMULATE[:-1], "1e9"), "duration must be at most"),
        ((*SIMULATE, "--method", "euler"), "method must be one of rk4, rk8"),
        ((*SIMULATE[:-1], "0"), "duration"),
        ((*SIMULATE, "--p1", "nan"), "p1 .*finite"),
        ((*SIMULATE, "--out", "motion.xls"), "out must end in .csv or .nc"),
        ((*SIMULATE, "--out", "/no/such/place/motion.csv"), "out must be a file in a directory"),
        (
            (*ANIMATE, "--theta1", "nan", "--theta2", "1", "--out", "f.gif"),
            "theta1 .*finite number .* nan",
        ),
        ((*ANIMATE, "--m1", "0", "--out", "f.gif"), "m1 .*positive .* 0"),
        ((*ANIMATE, "--l2", "-0.2", "--out", "f.gif"), "l2 .*positive .* -0.2"),
        ((*ANIMATE, "--speed", "fast", "--out", "f.gif"), "--speed.*fast"),
        (
            (*ANIMATE, "--out", "/proc/z.gif"),
            "out must be a file in a directory .* got /proc/z.gif .*another place",
        ),
        ((*ANIMATE, "--out", f"{'z' * 300}.gif"), "out must be a file in a directory .* got zzz"),
        (
            (*ANIMATE, "--out", "."),
            "out must end in .gif or .mp4 or .png, got .: give another name",
        ),
    ],
)
def test_bad_input_is_one_line_and_status_two(capsys, arguments, words):
    status, out, err = run(capsys, *arguments)
    assert (status, out) == (2, "")
    assert re.search(words, err), err
    assert err.count("\n") == 1
    assert "Traceback" not in err


@pytest.mark.slow
def test_the_program_itself(tmp_path):
    """A process of its own: entry point, cache directory, and the compile options switched off."""
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), "DPEND_PLAIN_JAX": "1"}
    command = [
        Path(sys.executable).parent / "dpend",
        "orbit",
        "--theta1",
        "40",
        "--branch",
        "in-phase",
        "--json",
    ]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert (done.returncode, done.stderr) == (0, "")
    assert abs(json.loads(done.stdout)["theta2_deg"] - 49.066544773743) < 1e-9
    assert list((tmp_path / "dpend").iterdir())
    refused = subprocess.run(
        [*command[:2], "--theta1", "nan"], capture_output=True, text=True, env=environment
    )
    assert refused.returncode == 2
    assert refused.stderr.startswith("dpend: theta1 must be a finite number")
    assert refused.stderr.count("\n") == 1


@pytest.mark.slow
def test_a_family_as_json_and_csv(capsys, tmp_path):
    status, found = run_json(capsys, "family", "--branch", "anti-phase")
    assert (status, found["status"], found["ends"]) == (
        0,
        "converged",
        ["normal mode", "homoclinic"],
    )
    assert found["points"][0].keys() >= set(
        "theta1_deg theta2_deg period_s energy_J kappa symmetry".split()
    )
    assert {point["symmetry"] for point in found["points"]} == {"centred"}
    lost = found["bifurcations"][-1]
    assert lost["kind"] == "stability_lost"
    # 0.9890865027 rad and 6.1475153497 sqrt(l/g).
    assert abs(lost["theta1_deg"] - np.degrees(0.9890865027)) < 1e-8
    assert abs(lost["period_s"] - 6.1475153497 * np.sqrt(0.2 / 9.8)) < 1e-10
    out = tmp_path / "f.csv"
    picture = tmp_path / "f.pdf"
    words = ("family", "--branch", "anti-phase", "--out", out, "--figure", picture)
    status, text, err = run(capsys, *words)
    assert picture.read_bytes().startswith(b"%PDF")
    assert (status, err) == (0, "")
    assert "stability_lost" in text
    table = np.genfromtxt(out, delimiter=",", names=True, usecols=range(9))
    np.testing.assert_allclose(
        table["theta2_deg"], [point["theta2_deg"] for point in found["points"]], rtol=1e-15
    )
    run(capsys, "family", "--branch", "anti-phase", "--out", tmp_path / "f.json")
    written = json.loads((tmp_path / "f.json").read_text())
    assert {key: written[key] for key in found} == found
    assert dpend.load_family(tmp_path / "f.json").ends == ("normal mode", "homoclinic")
    for bad in (
        ("--branch", "sideways"),
        ("--branch", "in-phase", "--out", "f.txt"),
        ("--branch", "in-phase", "--g", 0),
    ):
        status, text, err = run(capsys, "family", *bad)
        assert (status, text, err.count("\n")) == (2, "", 1)


# A motion of the paper's pendulum whose lower rod turns over once a period.
ROTATING = "--theta1 0 --theta2 0 --p1 -0.0141 --p2 0.0409 --period 0.42".split()


@pytest.mark.slow
def test_families_of_an_orbit_a_saddle_and_a_special_point(capsys, tmp_path):
    out = tmp_path / "rotating.json"
    status, text, err = run(capsys, "orbit", *ROTATING, "--out", out)
    assert (status, err) == (0, "")
    assert "never at rest" in text
    orbit = json.loads(out.read_text())
    assert (orbit["symmetry"], orbit["turns"], orbit["status"]) == ("passing", [0, 1], "converged")
    status, found = run_json(capsys, "family", "--orbit", out)
    assert (status, found["branch"], found["symmetry"]) == (0, None, "passing")
    assert found["ends"] == ["homoclinic", "fast rotation"]
    nearest = min(found["points"], key=lambda one: abs(one["period_s"] - orbit["period_s"]))
    assert abs(nearest["energy_J"] - orbit["energy_J"]) < 1e-12
    assert abs(nearest["p2_kg_m2_s"] - orbit["p2_kg_m2_s"]) < 1e-12
    for branch in ("down-up", "up-down"):
        status, found = run_json(capsys, "family", "--from", branch)
        assert (status, found["branch"], found["symmetry"]) == (0, branch, "centred")
        # 5.2835080 sqrt(l/g) is the linear period.
        assert abs(found["points"][0]["period_s"] * 7 / 5.2835080 - 1) < 1e-3
    status, text, _ = run(capsys, "family", "--from", "anti-phase", "--special", 7)
    assert status == 0
    assert "odd orbits from branch point to homoclinic" in text
    for bad, words in (
        (("--from", "up-down", "--special", 1), "special must be where a branch"),
        (("--from", "anti-phase", "--special", 99), "special must be the number"),
        (("--orbit", out, "--g", 1), "orbit must be one of this pendulum"),
    ):
        status, text, err = run(capsys, "family", *bad)
        assert (status, text, err.count("\n")) == (2, "", 1)
        assert words in err


def test_a_file_that_holds_no_orbit_is_refused(capsys, tmp_path):
    names = {"l1_m": 0.2, "l2_m": 0.2, "m1_kg": 0.1, "m2_kg": 0.1, "g_m_s2": 9.8}
    state = {"theta1_deg": 0, "theta2_deg": 0.0, "p1_kg_m2_s": -0.0141, "p2_kg_m2_s": 0.0409}
    right = {**state, "period_s": 0.42, "status": "converged", "symmetry": "passing",
             "turns": [0, 1], "dual": state, "pendulum": names, "energy_J": -0.5, "residual": 0.0,
             "iterations": 3, "kappa": 2.0, "log_abs_kappa": 0.7,
             "error_estimate": {"theta2_deg": 0.0, "period_s": 0.0}}  # fmt: skip
    file = tmp_path / "o.json"
    wrong = [
        ("period_s", -1, "period_s must be"),
        ("symmetry", "round", "symmetry must be one of"),
        ("turns", [0, 0.5], "turns must be integers"),
        ("turns", 3, "turns must be a pair"),
        ("dual", None, "dual must be an object"),
        ("p1_kg_m2_s", "x", "p1_kg_m2_s must be"),
        ("theta1_deg", True, "theta1_deg must be"),
        ("status", "max_iterations", "its status is not converged"),
        ("pendulum", names | {"m1_kg": 0}, "m1 must be"),
        ("pendulum", names | {"m1_kg": 0.3}, "orbit must be one of this pendulum.* --m1 0.3"),
        ("orbits", [right, right], "it must hold one orbit"),
    ]
    for key, value, words in wrong:
        file.write_text(json.dumps(right | {key: value}))
        status, out, err = run(capsys, "family", "--orbit", file)
        assert (status, out, err.count("\n")) == (2, "", 1), err
        assert re.search(f"orbit must be .*{words}|{words}", err), err
    for text in ("", "[]", "{}", "{", "NaN"):
        file.write_text(text)
        status, out, err = run(capsys, "family", "--orbit", file)
        assert (status, out, err.count("\n")) == (2, "", 1), err
    file.unlink()
    for bad in (("family", "--orbit", file), ("family",), ("family", "--from", "x"),
                ("family", "--orbit", file, "--from", "in-phase"),
                ("orbit", "--theta1", 0, "--p1", 1), ("orbit", *ROTATING[:8]),
                ("orbit", *ROTATING, "--branch", "in-phase"),
                ("orbit", *ROTATING, "--symmetry", "round"),
                ("orbit", *ROTATING, "--out", "f.csv")):  # fmt: skip
        status, out, err = run(capsys, *bad)
        assert (status, out, err.count("\n")) == (2, "", 1), err


def test_the_atlas_of_an_angle(capsys, tmp_path):
    status, found = run_json(capsys, "atlas", "--theta1", 40, "--max-period", 1.3)
    assert status == 0
    periods = [orbit["period_s"] for orbit in found["orbits"]]
    np.testing.assert_allclose(
        periods, [0.754418866, 0.789605931, 1.174420237, 1.212756333, 1.283263044], atol=1e-9
    )
    keys = set("theta1_deg theta2_deg period_s energy_J kappa symmetry dual residual".split())
    assert keys <= found["orbits"][0].keys()
    assert (
        set("theta2_points time_points refinements suspicious_cells".split())
        <= found["coverage"].keys()
    )
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
        result = dpend.catalogue.scan.scan_circle(*arguments)
        return dataclasses.replace(result, zeros=result.zeros[1:])

    monkeypatch.setattr(dpend.catalogue.release, "scan_circle", forgetful)
    status, found = run_json(capsys, "atlas", "--theta1", 40, "--max-period", 1.3)
    assert (status, len(found["orbits"]), found["coverage"]["suspicious_cells"]) == (1, 4, 1)


@pytest.mark.slow
def test_the_atlas_of_the_square(capsys, tmp_path, monkeypatch):
    # A slow machine would tell how far it is.
    monkeypatch.setattr(terminal, "_BETWEEN_LINES", float("inf"))
    store = tmp_path / "s.json"
    status, found = run_json(capsys, "atlas", "--max-period", 1.0, "--store", store)
    assert (status, [one["family"] for one in found["families"]]) == (0, ["C1", "C2", "C3"])
    status, text, _ = run(capsys, "atlas", "--max-period", 1.0, "--store", store)
    assert status == 0
    assert "3 families" in text


# A command, words that make it whole, and its options; every command has those of the pendulum,
# too.
FUZZED = {
    "orbit": (("--theta1", "40", "--branch", "in-phase"), "theta1 theta2 period branch symmetry "
                                                          "p1 p2 omega1 omega2 ratio crossing "
                                                          "out figure film"),
    "family": (("--branch", "in-phase"), "branch orbit special out figure"),
    "atlas": (("--theta1", "40", "--max-period", "1"), "theta1 max-period out store figure"),
    "design": (
        ("--theta1", "60", "--branch", "in-phase", "--period", "1"), "theta1 branch period kappa "
                                                                     "ratio free bounds"
    ),
    "simulate": (SIMULATE[1:], "theta1 theta2 duration p1 p2 omega1 omega2 method step "
                               "tolerance most-steps out figure"),
    "map": (
        ("flip", "--size", "4", "--duration", "1", "--out", "m.zarr"),
        "size duration theta1 theta2 tolerance method step error figure",
    ),
    "animate": ((*ANIMATE[1:], "--out", "f.gif"), "theta1 theta2 duration speed size out"),
    "fit": (("data.csv",), "free noise figure"),
}  # fmt: skip
HOSTILE = ("", "nan", "1e999", "1_000", "٤٠", "abc", "9" * 5000)
MORE_HOSTILE = (
    "-inf",
    "0x10",
    "1e",
    "=3",
    "-",
    " ",
    "1,5",
    "40 50",
    "\x1b[31m",
    "é" * 200,
    "None",
    "[]",
    "1:2:3",
    ",",
    "no/such/place",
)


@pytest.mark.parametrize(
    "values", [HOSTILE, pytest.param(MORE_HOSTILE, marks=pytest.mark.slow)], ids=["some", "more"]
)
@pytest.mark.parametrize("command", FUZZED)
def test_what_no_option_can_mean_is_refused_by_its_name(
    capsys, monkeypatch, tmp_path, command, values
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        cli, "app", get_command(cli.app)
    )  # made once, not for each of two thousand calls
    data = tmp_path / "data.csv"
    data.write_text(
        "time_s,theta1_deg,theta2_deg\n" + "\n".join(f"0.{i:02d},{i},{i}" for i in range(20))
    )
    words, names = FUZZED[command]
    wrong = []
    for name in [*names.split(), "l1", "l2", "m1", "m2", "g"]:
        for value in values:
            others = [word for pair in _pairs(words, name) for word in pair]
            status, out, err = run(capsys, command, *others, f"--{name}", value)
            named = name in err.replace("_", "-")
            told = (
                value[:20].split(",")[0].strip() in err
                or repr(value)[1:20] in err
                or "got inf" in err
            )
            if (status, out, err.count("\n"), named, told) != (2, "", 1, True, True):
                wrong.append((name, value[:30], status, out[:100], err[:200]))
    assert wrong == []
    assert list(tmp_path.iterdir()) == [data]


def _pairs(words, name):
    """The options among `words`, and what stands before them, without those called `name`."""
    first = next((i for i, word in enumerate(words) if word.startswith("--")), len(words))
    yield words[:first]
    yield from (
        pair
        for pair in zip(words[first::2], words[first + 1 :: 2], strict=True)
        if pair[0] != f"--{name}"
    )


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ("orbit --theta1 40 --theta1 50", "--theta1 must be given once at most, got it 2 times"),
        ("orbit --theta1 40 --json --json", "--json must be given once at most, got it 2 times"),
        ("orbit --theta1 40 --crossing 2", "crossing must go with branch, got 2 alone"),
        ("orbit --theta1 40 --branch in-phase --crossing 0", "crossing must be an integer of at "
                                                             "least 1"),
        ("orbit --theta1 40 --branch in-phase --crossing 9223372036854775808", "--crossing.* is "
                                                                               "beyond "
                                                                               "92233720368547"),
        ("orbit --theta1 40 --branch in-phase --crossing 1.0", "--crossing.*'1.0' is not an "
                                                               "integer"),
        ("orbit --theta1 40 --symmetry brake", "symmetry goes with guess"),
        ("design --theta1 60 --branch in-phase --ratio 2", "branch must go with period or kappa, "
                                                           "got 'in-phase'"),
        ("design --theta1 60 --ratio 2 --free l1,,l2", "free must be names with commas between "
                                                       "them, got 'l1,,l2'"),
        ("design --theta1 60 --ratio 2 --bounds l1=1_0:2_0", "bounds must be NAME=A:B, got "
                                                             "'l1=1_0:2_0'"),
        ("fit data.csv --free ,", "free must be names with commas between them, got ','"),
        ("fit data.csv", "data must be a CSV file that can be read, got data.csv"),
        ("fit data.png --figure data.png", "figure must be another file than data"),
        ("fit data.png --figure ./data.png", "figure must be another file than data"),
        ("atlas --max-period 1 --out s.json --store s.json", "out must be another file than store"),
        ("simulate --theta1 40 --theta2 10 --duration 1 --most-steps 0", "most_steps must be an "
                                                                         "integer of at least 1"),
        ("simulate --theta1 40 --theta2 10 --duration 1 --step 0.1 --most-steps 5", "step must "
                                                                                    "make at most "
                                                                                    "5 steps"),
        ("animate --theta1 9 --theta2 9 --duration 1 --out f.gif --l1 1e300 --l2 1e300", "duration "
                                                                                         "must "
                                                                                         "take at "
                                                                                         "most"),
    ],
)  # fmt: skip
def test_what_has_no_effect_or_two_meanings_is_refused(
    capsys, monkeypatch, tmp_path, arguments, line
):
    monkeypatch.chdir(tmp_path)
    status, out, err = run(capsys, *arguments.split())
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert re.search(line, err), err
    assert list(tmp_path.iterdir()) == []


# Pendulums at the ends of what is asked for, and beyond them.
EXTREMES = [
    f"--{name} {value}"
    for name in ("l2", "m2", "g")
    for value in ("1e-300", "1e-6", "1e6", "1e300")
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [*EXTREMES, "--g 0", "--g -9.8", "--l1 1e-300 --l2 1e-300", "--m1 1e300"]
)
@pytest.mark.parametrize(
    "command",
    [
        "simulate --theta1 90 --theta2 90 --duration 1",
        "simulate --theta1 90 --theta2 90 --duration 1 --step 0.01",
        "animate --theta1 90 --theta2 90 --duration 0.2 --out f.gif",
        "animate --theta1 90 --theta2 90 --duration 0.2 --out f.png",
        "fit data.csv",
        "fit one.csv",
    ],
)
def test_an_extreme_pendulum_is_computed_or_told(capsys, monkeypatch, tmp_path, command, options):
    monkeypatch.chdir(tmp_path)
    if command.startswith("fit"):
        _write_data(tmp_path)
    status, out, err = run(capsys, *command.split(), *options.split())
    assert status in (0, 1, 2)
    assert err.count("\n") == (status == 2)
    assert bool(out) == (status != 2)
    if status == 1:
        assert ": " in out.splitlines()[-1]


def _write_data(place):
    """Three seconds of a motion with noise of half a degree: of both rods, and of the upper one
    alone.
    """
    motion = dpend.simulate(dpend.Pendulum(), dpend.released(1.0, 0.5), 3.0, step=0.02, error=False)
    noise = np.random.default_rng(0).normal(scale=0.5, size=(2, motion.time.size))
    angles = np.degrees([motion.state.theta1, motion.state.theta2]) + noise
    rows = list(zip(np.asarray(motion.time), *angles, strict=True))
    both = "\n".join(f"{t:.3f},{a:.4f},{b:.4f}" for t, a, b in rows)
    (place / "data.csv").write_text("time_s,theta1_deg,theta2_deg\n" + both)
    (place / "one.csv").write_text(
        "time_s,theta1_deg\n" + "\n".join(f"{t:.3f},{a:.4f}" for t, a, _ in rows)
    )
    changed = "\n".join(f"{t:.3f},{a * (1 if t < 1.5 else 0.0175):.4f},{b:.4f}" for t, a, b in rows)
    (place / "changed.csv").write_text("time_s,theta1_deg,theta2_deg\n" + changed)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", ["--noise 1e-12", "--noise 90", "--l2 1e-6 --m2 1e6", "--g -9.8 --at-rest"]
)
@pytest.mark.parametrize("data", ["data.csv", "one.csv", "changed.csv"])
def test_a_fit_of_what_cannot_be_says_so(capsys, monkeypatch, tmp_path, data, options):
    monkeypatch.chdir(tmp_path)
    _write_data(tmp_path)
    status, out, err = run(capsys, "fit", data, *options.split())
    assert status in (1, 2)
    assert (err.count("\n"), bool(out)) == ((1, False) if status == 2 else (0, True))


def test_a_noise_that_no_angle_has_is_refused(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    times = np.arange(40) / 20
    rows = "\n".join(f"{t:.3f},{30 * np.cos(6 * t):.4f},{40 * np.cos(6 * t):.4f}" for t in times)
    (tmp_path / "data.csv").write_text("time_s,theta1_deg,theta2_deg\n" + rows)
    for noise in ("1e-300", "1e300"):
        status, out, err = run(capsys, "fit", "data.csv", "--noise", noise)
        assert (status, out, err.count("\n")) == (2, "", 1)
        assert "noise must be from 1e-15 rad" in err
        assert noise.replace("1e3", "1e+3") in err
    (tmp_path / "data.csv").write_text(
        "time_s,theta1_deg,theta2_deg,theta2_deg\n" + rows.replace("\n", ",0\n") + ",0"
    )
    status, _, err = run(capsys, "fit", "data.csv")
    assert (status, err) == (
        2,
        "dpend: data.csv must have one column theta2_deg, got 2: keep one of them\n",
    )


@pytest.mark.slow
def test_a_section_with_its_store_its_picture_and_its_orbits(capsys, tmp_path):
    out, figure = tmp_path / "S.zarr", tmp_path / "S.png"
    status, found = run_json(
        capsys, "section", "--energy", -0.42, "--starts", 5, "--count", 12, "--periodic", 2,
        "--out", out, "--figure", figure,
    )  # fmt: skip
    assert (status, found["failed"], found["crossings"]) == (0, 0, 60)
    assert found["largest_energy_error_J"] < 1e-9
    kappa = {row["returns"]: row["kappa"] for row in found["periodic_orbits"]}
    assert kappa.keys() == {1, 2}
    in_phase = found["periodic_orbits"][3]  # the longest of one return
    assert abs(in_phase["period_s"] - 1.21) < 0.01
    assert in_phase["stability"] == "elliptic"
    assert figure.stat().st_size > 10_000
    assert (out / "zarr.json").is_file()


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("--energy", -9), "energy must be above the lowest one on .*, got -9 J: give a higher"),
        (("--energy", 0, "--angle", "x"), "angle must be one of theta1, theta2, got 'x'"),
        (("--energy", 0, "--count", 0), "count must be an integer of at least 1, got 0"),
        (("--energy", 0, "--out", "."), "out must be a new name in a directory .*already"),
    ],
)
def test_bad_sections_are_refused_in_one_line(capsys, words, line):
    status, out, err = run(capsys, "section", *words)
    assert (status, out) == (2, "")
    assert re.fullmatch(f"dpend: {line}.*\n", err), err
