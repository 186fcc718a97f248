"""The command line: its entry point. Angles are in degrees here, and nowhere else but in CSV and
JSON.

Exit status 0: done. 1: ran, but some solve failed, or the environment is wrong. 2: bad input, one
line on standard error. 130: interrupted. 141: nobody reads standard output any more.
"""

import io
import os
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
import typer

from dpend import (
    design_commands,
    orbit_commands,
    proof_commands,
    section_commands,
    simulation_commands,
)
from dpend._runtime import (
    catch_interrupts,
    collect_garbage_from_here,
    leave_quietly,
    take_all_cores,
)
from dpend.executables import keep_executables
from dpend.options import app
from dpend.terminal import tell_error

# The files of the commands, which put them into `app` as they are imported, in the order of --help.
COMMANDS = (orbit_commands, design_commands, proof_commands, simulation_commands, section_commands)


def _keep_compiled_code() -> None:
    """Has JAX keep compiled code in the user's cache directory, or where the user chose: later runs
    start warm.
    """
    if jax.config.jax_compilation_cache_dir is not None:  # type: ignore[attr-defined]
        return
    chosen = os.environ.get("XDG_CACHE_HOME", "")
    try:
        # A relative path is no place at all: the XDG specification has it ignored.
        base = Path(chosen if os.path.isabs(chosen) else Path.home() / ".cache") / "dpend"
        base.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # nowhere to write, or a user without a home
        return
    if os.access(base, os.W_OK):
        jax.config.update("jax_compilation_cache_dir", str(base))
        keep_executables(base / "executables")
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


def main(arguments: Sequence[str] | None = None) -> None:
    """The entry point: runs one command and exits with its status."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(
                errors="backslashreplace"
            )  # names of files may be no text in the terminal's encoding
    os.environ.pop("MPLBACKEND", None)  # for windows, of which the program opens none
    warnings.filterwarnings(
        "ignore", message=".*persistent compilation cache"
    )  # a cache only saves time
    catch_interrupts()
    collect_garbage_from_here()
    status = _run(sys.argv[1:] if arguments is None else list(arguments))
    leave_quietly()
    if _flush() is not None:  # Python would try once more when it ends, and say so with a traceback
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(status)


def _flush() -> OSError | None:
    """Writes what was printed; why it could not be, if so."""
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError as error:
        return error
    return None


def _run(arguments: list[str]) -> int:
    try:
        # The process is this program's own, so that float64 is ours to switch on even where JAX is
        # to be left plain.
        if "JAX_ENABLE_X64" not in os.environ:
            jax.config.update("jax_enable_x64", True)
        take_all_cores()
        _keep_compiled_code()
        with np.errstate(
            all="ignore"
        ):  # what overflows is told by the status or by the line that refuses it
            status = int(app(arguments or ["--help"], standalone_mode=False) or 0)
        lost = _flush()
        if isinstance(lost, BrokenPipeError):
            return 141
        if lost is not None:
            return tell_error(lost)
        return status
    except (KeyboardInterrupt, typer.Abort):
        return 130
    except (
        BrokenPipeError,
        SystemExit,
    ):  # the latter is typer's answer to a closed pipe, and to nothing else here
        return 141
    except typer.Exit as stop:
        return stop.exit_code
    except Exception as error:
        return tell_error(error)


if __name__ == "__main__":
    main()
