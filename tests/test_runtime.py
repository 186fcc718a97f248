"""What importing dpend does to JAX, seen from fresh processes."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpend
from dpend import _runtime


def run(code, **environment):
    """The JSON that `code` prints, in a fresh interpreter whose JAX variables are those given."""
    clean = {
        key: value
        for key, value in os.environ.items()
        if not key.startswith(("JAX_", "XLA_", "DPEND_"))
    }
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        capture_output=True,
        text=True,
        env=clean | environment,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


REPORT = """
import json, os, jax
import dpend
x64, devices = jax.config.jax_enable_x64, len(jax.devices("cpu"))
try:
    dpend.Pendulum()
    error = None
except RuntimeError as refused:
    error = str(refused)
print(json.dumps([x64, devices, os.environ.get("XLA_FLAGS"), error]))
"""


def test_import_sets_up_float64_and_no_more():
    assert run(REPORT) == [True, 1, None, None]


DEVICES = """
import json, jax, numpy as np
import dpend
{before}
motion = dpend.simulate(dpend.Pendulum(), dpend.released(1.0, 0.4), times=[1.0])
print(json.dumps([jax.local_device_count(), float(motion.state.theta1[0])]))
"""


def test_computing_takes_all_cores_unless_told_otherwise():
    """And the numbers do not change with them."""
    cores, first = run(DEVICES.format(before=""))
    three, second = run(DEVICES.format(before="dpend.configure(devices=3, async_dispatch=False)"))
    running = "jax.numpy.zeros(1).block_until_ready()"
    one, third = run(DEVICES.format(before=running))
    assert (cores, three, one) == (_runtime.count_cores(), 3, 1)
    assert first == second == third


def test_what_comes_too_late_is_refused():
    """Here JAX runs long since."""
    count = jax.local_device_count()
    jax.numpy.zeros(1).block_until_ready()
    dpend.configure(devices=count)
    with pytest.raises(RuntimeError, match="devices must be chosen before JAX computes anything"):
        dpend.configure(devices=count + 1)
    with pytest.raises(RuntimeError, match="async_dispatch must be chosen before JAX"):
        dpend.configure(devices=count, async_dispatch=False)


@pytest.mark.slow
def test_plain_jax_is_left_alone():
    x64, devices, flags, error = run(REPORT, DPEND_PLAIN_JAX="1")
    assert (x64, devices, flags) == (False, 1, None)
    assert "float64 is off" in error
    assert run(REPORT, DPEND_PLAIN_JAX="1", JAX_ENABLE_X64="1") == [True, 1, None, None]


def test_a_running_jax_is_left_alone():
    x64, devices, _, error = run("import jax; jax.numpy.zeros(1).block_until_ready()" + REPORT)
    assert (x64, devices) == (False, 1)
    assert "import dpend before JAX" in error


@pytest.mark.slow
def test_the_users_own_settings_stand():
    flags = "--xla_cpu_enable_fast_min_max=false"
    assert run(REPORT, JAX_NUM_CPU_DEVICES="3", XLA_FLAGS=flags) == [True, 3, flags, None]
    x64, *_, error = run(REPORT, JAX_ENABLE_X64="0")
    assert x64 is False
    assert "float64 is off" in error


def test_options_are_added_only_where_the_user_is_silent():
    mine = "--xla_backend_extra_options=xla_cpu_use_multi_output_fusion=false"
    together = _runtime._extended_flags(mine)
    assert together.startswith(mine)
    assert together.count("xla_cpu_use_multi_output_fusion") == 1


def test_unknown_options_are_found_out():
    assert _runtime.known_to_xla("xla_backend_extra_options")
    assert not _runtime.known_to_xla("xla_cpu_no_such_option_as_this")


def test_xla_takes_the_options():
    """A sine that three results share stands once in what XLA makes of them, not three times."""

    def shared(x, y):
        sine, cosine = jnp.sin(x), jnp.cos(x)
        turned = sine * y + cosine
        return turned / (1 + cosine * cosine), turned * sine, y + turned

    lanes = jnp.ones(1000)
    assert jax.jit(shared).lower(lanes, lanes).compile().as_text().count(" sine(") == 1


@pytest.mark.slow
def test_results_agree_to_rounding_with_and_without_the_options():
    code = """
import json, numpy as np
import dpend
paper = dpend.Pendulum()
orbits = [dpend.find_orbit(paper, np.radians(40.0), branch=b) for b in ("in-phase", "anti-phase")]
end = dpend.flow(paper, dpend.released(2.0, 1.0), 2.0, dpend.Scheme("rk8", 5e-3))
found = [[float(o.theta2), float(o.period)] for o in orbits]
print(json.dumps(found + [[float(end.theta1), float(end.theta2)]]))
"""
    with_options, without = run(code), run(code, DPEND_PLAIN_JAX="1", JAX_ENABLE_X64="1")
    np.testing.assert_allclose(with_options, without, rtol=1e-12)


@pytest.mark.parametrize(
    "flags", ["--xla_no_such_flag=1", "--xla_cpu_enable_fast_math=perhaps", "no such file"]
)
def test_flags_that_would_end_the_process_are_refused(monkeypatch, flags):
    """XLA itself says so, in a process of its own."""
    monkeypatch.setenv("XLA_FLAGS", flags)
    with pytest.raises(
        RuntimeError, match=re.escape(f"that the installed XLA knows, got '{flags}'")
    ):
        _runtime._check_flags()


def test_flags_that_xla_knows_pass(monkeypatch):
    for flags in (
        "",
        "--xla_force_host_platform_device_count=2 --xla_cpu_enable_fast_min_max=false",
    ):
        monkeypatch.setenv("XLA_FLAGS", flags)
        _runtime._check_flags()


SIMULATE = "simulate --theta1 40 --theta2 10 --duration 1 --step 0.05"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("environment", "command", "status", "line"),
    [
        ({"XLA_FLAGS": "--xla_no_such_flag=1"}, SIMULATE, 1, "got '--xla_no_such_flag=1'"),
        ({"JAX_ENABLE_X64": "0"}, SIMULATE, 1, "float64 is off in JAX"),
        ({"JAX_ENABLE_X64": "perhaps"}, SIMULATE, 1, "invalid truth value 'perhaps'"),
        ({"JAX_PLATFORMS": "abacus"}, SIMULATE, 1, "'abacus'"),
        ({"JAX_COMPILATION_CACHE_DIR": "/proc/nowhere"}, SIMULATE, 0, ""),
        ({"XDG_CACHE_HOME": "not/absolute"}, SIMULATE, 0, ""),
        (
            {"MPLBACKEND": "nonsense"},
            "animate --theta1 1 --theta2 1 --duration 0.1 --out f.gif",
            0,
            "",
        ),
        ({"COLUMNS": "1", "TERM": "dumb", "NO_COLOR": "1"}, SIMULATE, 0, ""),
        ({"COLUMNS": "0"}, "orbit --help", 0, ""),
        ({"PYTHONWARNINGS": "error"}, SIMULATE, 0, ""),
        ({"PYTHONOPTIMIZE": "2"}, SIMULATE, 0, ""),
        (
            {"LC_ALL": "C", "PYTHONIOENCODING": "ascii"},
            "orbit --theta1 40 --branch in-phase",
            0,
            "",
        ),
    ],
    ids=str,
)
def test_the_program_in_a_strange_environment(tmp_path, environment, command, status, line):
    house = str(Path(_runtime.__file__).parents[1])
    clean = {
        key: value
        for key, value in os.environ.items()
        if not key.startswith(("JAX_", "XLA_", "DPEND_"))
    }
    clean |= {"PYTHONPATH": house, "HOME": str(tmp_path)}
    program = [sys.executable, "-m", "dpend.cli", *command.split()]
    done = subprocess.run(
        program, cwd=tmp_path, capture_output=True, text=True, env=clean | environment
    )
    assert done.returncode == status, done.stderr
    assert done.stderr.count("\n") == (status != 0)
    assert line in done.stderr
    assert not (tmp_path / "not").exists()


@pytest.mark.slow
def test_output_that_nobody_takes(tmp_path):
    """A full disk is told in a line; a reader that has gone, and Ctrl-C while everything is
    imported, in none.
    """
    house = str(Path(_runtime.__file__).parents[1])
    program = {
        "args": [sys.executable, "-m", "dpend.cli", "--help"],
        "env": os.environ | {"PYTHONPATH": house},
    }
    with open("/dev/full", "w") as full:
        done = subprocess.run(**program, stdout=full, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "standard output cannot be written" in done.stderr
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(**program, stdout=writer, stderr=subprocess.PIPE, text=True)
    os.close(writer)
    assert (done.returncode, done.stderr) == (141, "")
    code = (
        "import os, signal, sys; sys.argv = ['dpend']; import dpend; os.kill(os.getpid(), "
        "signal.SIGINT)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=program["env"], capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (130, "")
