"""The READMEs' code runs as printed, and prints what they say it prints."""

import ast
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import speed_vs_error
from typer.main import get_command

from dpend import cli

HOUSE = Path(__file__).parent.parent
README = HOUSE / "README.md"
# Fences in order: the language, what is in it, and where a block of text follows at once, that:
# what it prints.
BLOCKS = re.findall(
    r"^```(\w+)\n(.*?)^```\n(?:\n?```text\n(.*?)^```\n)?",
    README.read_text(),
    re.DOTALL | re.MULTILINE,
)
# A line of a shell block; comments are for people.
COMMANDS = [
    (shlex.split(line.split("dpend ", 1)[1], comments=True), printed)
    for language, code, printed in BLOCKS
    if language == "sh"
    for line in code.splitlines()
    if re.search(r"(^|/)dpend ", line)
]
# In running text: `dpend family --branch in-phase`; not `dpend map lyapunov|megno`, which stands
# for four.
SPANS = [shlex.split(span) for span in re.findall(r"`dpend (\w+ --[^`|]+)`", README.read_text())]
SCRIPTS = re.findall(
    r"`python experiments/(\w+\.py)", (HOUSE / "experiments" / "README.md").read_text()
)


def run(capsys, arguments):
    status = cli._run(arguments)
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def test_printed_output_is_true(capsys):
    _, code, printed = next(block for block in BLOCKS if block[0] == "python")
    exec(compile(code, "README.md", "exec"), {})
    assert capsys.readouterr().out == printed


def test_no_code_hides_in_a_block_of_text():
    """Only what runs is called code, and all that runs is."""
    for language, text, _ in BLOCKS:
        if language == "text":
            assert not re.search(r"^(dpend|python) |dpend\.\w+\(", text, re.MULTILINE), text
        elif language == "python":
            ast.parse(text)
    assert {language for language, *_ in BLOCKS} <= {"sh", "python", "text"}


@pytest.mark.slow
def test_all_python_runs_in_order(capsys, tmp_path, monkeypatch):
    """In one namespace, with the files that the shell blocks before it write."""
    monkeypatch.chdir(tmp_path)
    names = {}
    for language, code, _ in BLOCKS:
        if language == "sh" and "--out data.csv" in code:
            line = next(line for line in code.splitlines() if "--out data.csv" in line)
            assert cli._run(shlex.split(line, comments=True)[1:]) == 0
        elif language == "python":
            exec(
                compile(code, "<README>", "exec"), names
            )  # no file of that name: quantities have no source
    assert names["atlas"].table["period"].size > 1000
    assert {orbit.stability for orbit in names["stable"].orbits} == {"elliptic"}
    assert int(names["found"].status) == 0
    assert names["field"]["reach"].shape == (512, 512)
    assert int(names["fit"].status) == 0


@pytest.mark.parametrize("arguments", [*(command for command, _ in COMMANDS), *SPANS], ids=" ".join)
def test_every_command_line_is_understood(arguments):
    name, *options = arguments
    assert get_command(cli.app).commands[name].make_context(name, options).params


@pytest.mark.slow
@pytest.mark.parametrize(("arguments", "printed"), COMMANDS, ids=lambda value: " ".join(value[:2]))
def test_every_command_line_runs(capsys, tmp_path, monkeypatch, arguments, printed):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli, "_keep_compiled_code", lambda: None)
    if arguments[0] == "certify":
        pytest.importorskip("flint")
    if "data.csv" in arguments and "fit" in arguments:
        simulated = next(command for command, _ in COMMANDS if command[-1] == "data.csv")
        assert run(capsys, simulated)[0] == 0
    # A map of a million cells takes a minute on two free cores.
    arguments = ["48" if word == "1024" else word for word in arguments]
    if arguments[0] == "certify" and "--max-period" in arguments:
        # A minute for two seconds, with its progress told.
        arguments = [*arguments[:-1], "0.5"]
    status, out, err = run(capsys, arguments)
    err = "".join(
        line for line in err.splitlines(True) if " rad of theta2 times time, " not in line
    )
    assert (status, err) == (0, "")
    assert_shown(printed, out)
    for option in ("--out", "--figure"):
        if option in arguments:
            assert (tmp_path / arguments[arguments.index(option) + 1]).exists()


NUMBER = r"[+-]?\d+\.?\d*(?:e[+-]?\d+)?"


def assert_shown(shown, out):
    """The shown lines begin the output: words as they are, numbers to their last place, errors of
    rounding as such.
    """
    for ours, theirs in zip(shown.splitlines(), out.splitlines(), strict=False):
        assert re.sub(NUMBER, "#", ours.rstrip()) == re.sub(NUMBER, "#", theirs.rstrip())
        for a, b in zip(re.findall(NUMBER, ours), re.findall(NUMBER, theirs), strict=True):
            place = 10.0 ** -len(a.partition("e")[0].partition(".")[2])
            assert abs(float(a) - float(b)) <= 2 * place if "e-" not in a else float(b) < 1e-9
    assert len(shown.splitlines()) <= len(out.splitlines())


def test_a_shown_digit_that_is_wrong_is_seen():
    assert_shown("theta2 = 49.0665 deg, 4e-13", "theta2 = 49.0665 deg, 2e-12\nmore")
    for wrong in (
        "theta2 = 49.0675 deg, 4e-13",
        "theta2 = 49.0665 rad, 4e-13",
        "theta2 = 49.0665 deg, 4e-3",
    ):
        with pytest.raises(AssertionError):
            assert_shown("theta2 = 49.0665 deg, 4e-13", wrong)


def test_every_file_it_names_is_there():
    names = re.findall(r"\]\(([^):#]+)(?:#[^)]*)?\)", README.read_text())
    assert names
    assert [name for name in names if not (README.parent / name).is_file()] == []


def test_the_table_of_speeds_is_made_of_the_measured_rows():
    shown = README.read_text().split(speed_vs_error.START)[1].split(speed_vs_error.END)[0]
    rows = speed_vs_error.read_rows()
    assert shown == speed_vs_error.table(rows)
    assert all(row.error_99 > 0 for row in rows if row.method.startswith("dpend"))


@pytest.mark.slow
@pytest.mark.parametrize("script", sorted(set(SCRIPTS)))
def test_every_experiment_runs(tmp_path, script):
    """In a copy, as what they write lies beside them. No row of the hard cases fails but the one
    whose page says so.
    """
    place = tmp_path / "experiments"
    shutil.copytree(
        HOUSE / "experiments", place, ignore=shutil.ignore_patterns("__pycache__", "paper")
    )
    shutil.copy(README, tmp_path)
    if re.search(r"^import heyoka", (place / script).read_text(), re.MULTILINE):
        pytest.importorskip("heyoka")
    if re.search(r"^from (flint|dpend\.proofs)", (place / script).read_text(), re.MULTILINE):
        pytest.importorskip("flint")
    command = [sys.executable, place / script, "--quick"]
    environment = {"PYTHONPATH": str(HOUSE), "MPLBACKEND": "Agg"}
    done = subprocess.run(
        command, cwd=tmp_path, env={**os.environ, **environment}, capture_output=True, text=True
    )
    failed = re.findall(r"^ *\d+  fails .*$", done.stdout, re.MULTILINE)
    assert all("gauss" in row and "trend of the energy" in row for row in failed), failed
    assert done.returncode == bool(failed), done.stderr
