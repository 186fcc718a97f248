"""How JAX is set up: float64 and XLA options that make time loops fast when dpend is imported, and
one CPU device a core when it first computes.

All of it happens only while JAX has not started a backend: a program that has used JAX before keeps
its devices. `dpend.configure` chooses them. With `DPEND_PLAIN_JAX=1` in the environment nothing is
touched: everything works, more slowly, and float64 is then the caller's to switch on.

The options are undocumented, and XLA ends the process over a flag it does not know, so each name is
looked up in the installed jaxlib first. What they are worth was measured: one order-8 trajectory
with tangents runs six times as fast. The user's own `XLA_FLAGS` are tried in a process of their own
first, which takes 0.2 s where there are any.
"""

import contextlib
import functools
import gc
import itertools
import mmap
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType, TracebackType


def _is_program() -> bool:
    """Whether this process is the command line: its script, or `python -m dpend.cli`."""
    started = getattr(sys, "orig_argv", [])
    as_module = any(pair == ("-m", "dpend.cli") for pair in itertools.pairwise(started))
    return as_module or os.path.basename(sys.argv[0] if sys.argv else "") in ("dpend", "dpend.exe")


def leave_quietly() -> None:
    """Has Ctrl-C end the process at once with status 130, and what is not caught be one line.

    The program uses it while it imports and while it ends: there is nothing to save then, and no
    one to catch it.
    """
    _on_interrupt(signal.default_int_handler, _leave)
    sys.excepthook = _tell_in_one_line


def catch_interrupts() -> None:
    """Has Ctrl-C raise KeyboardInterrupt again."""
    _on_interrupt(_leave, signal.default_int_handler)
    sys.excepthook = sys.__excepthook__


def collect_garbage_from_here() -> None:
    """Ends the program's pause in collecting garbage, and leaves alone what was made before."""
    if not gc.isenabled():
        gc.freeze()
        gc.enable()


def _on_interrupt(before: Callable[..., object], after: Callable[..., object]) -> None:
    # A handler of somebody else stays: a shell, say, has what it starts in the background ignore
    # Ctrl-C.
    if (
        threading.current_thread() is threading.main_thread()
        and signal.getsignal(signal.SIGINT) is before
    ):
        signal.signal(signal.SIGINT, after)


def _leave(number: int, frame: FrameType | None) -> None:
    os._exit(130)


def _tell_in_one_line(
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    if issubclass(kind, (RuntimeError, ValueError, OSError)):
        sys.stderr.write("dpend: " + " ".join(str(error).split()) + "\n")
    else:
        sys.__excepthook__(kind, error, trace)


if _is_program():
    leave_quietly()
    # What is imported lives until the end. Looking through it for garbage again and again takes
    # 0.2 s; `collect_garbage_from_here` ends the pause.
    gc.disable()

import jax  # noqa: E402
import jaxlib  # noqa: E402

PLAIN = "DPEND_PLAIN_JAX"

# A step has several outputs; by default XLA fuses the step once for each and computes its stages
# again in every one.
_SHARE_OUTPUTS = ("xla_cpu_use_multi_output_fusion", "true")
# Loops whose state is below this many bytes become one kernel, without a dispatch for each
# operation of each turn.
_LOOP_IN_ONE_KERNEL = ("xla_cpu_small_while_loop_byte_threshold", "1000000")
# XLA stays at 256 bits even where the processor has 512.
_VECTOR_WIDTH = ("xla_cpu_prefer_vector_width", "512")


def known_to_xla(*names: str) -> bool:
    """Whether the installed XLA has flags of all these names: a search of its shared library, a few
    milliseconds, for whole words. A flag that was taken out leaves its name within longer text.
    """
    library = Path(jaxlib.__file__).parent / "libjax_common.so"
    try:
        with (
            library.open("rb") as file,
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text,
        ):
            return all(text.find(b"\0" + name.encode() + b"\0") >= 0 for name in names)
    except (OSError, ValueError):
        return False


def _has_avx512() -> bool:
    try:
        return "avx512f" in Path("/proc/cpuinfo").read_text()
    except OSError:
        return False


def _extended_flags(flags: str) -> str:
    """`flags` (the user's `XLA_FLAGS`) with our options added where the user has not spoken of
    them.
    """

    def spoken_of(name: str) -> bool:
        return re.search(rf"\b{name}\b", flags) is not None

    added = []
    name, width = _VECTOR_WIDTH
    if not spoken_of(name) and _has_avx512() and known_to_xla(name):
        added.append(f"--{name}={width}")
    # This flag takes any name; XLA passes over those that it does not know.
    extra = [option for option in (_SHARE_OUTPUTS, _LOOP_IN_ONE_KERNEL) if not spoken_of(option[0])]
    if extra and known_to_xla("xla_backend_extra_options"):
        added.append(
            "--xla_backend_extra_options=" + ",".join(f"{name}={value}" for name, value in extra)
        )
    return " ".join([flags, *added]).strip()


# What has XLA parse its flags, once in a process; no backend starts for that.
_PARSE = (
    "from jaxlib.xla_client import CompileOptions; "
    "CompileOptions().executable_build_options.debug_options"
)
# It takes 0.2 s; on a machine that is this busy the flags go untried.
_PATIENCE = 60.0


def _check_flags() -> None:
    """Refuses the user's `XLA_FLAGS` where the installed XLA would end the process over them.

    XLA itself is asked, in a process of its own: it alone knows its flags, and which values they
    take.

    Raises:
        RuntimeError: a flag that it does not know, a value that it cannot read, or a file of flags
            that is not there.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if not flags.strip() or not sys.executable:
        return
    paths = os.pathsep.join(path for path in sys.path if path)
    command, environment = (
        [sys.executable, "-c", _PARSE],
        {**os.environ, "PYTHONPATH": paths, "PYTHONWARNINGS": ""},
    )
    try:
        asked = subprocess.run(
            command,
            env=environment,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_PATIENCE,
        )
    except (OSError, subprocess.SubprocessError):
        return
    said = re.search(r"^F.*parse_flags_from_env[^]]*\] *(.*)", asked.stderr, re.MULTILINE)
    if asked.returncode != 0 and said:
        unknown = re.search(r"Unknown flags? in XLA_FLAGS: (.*)", said[1])
        wrong = unknown[1].strip() if unknown else flags.strip()
        raise RuntimeError(
            f"XLA_FLAGS must hold flags and values that the installed XLA knows, got "
            f"{wrong!r:.200}: "
            "take them out of the environment"
        )


def _add_compile_options() -> None:
    """Has XLA parse its options with ours among them, then restores `XLA_FLAGS`, which child
    processes inherit.
    """
    before = os.environ.get("XLA_FLAGS")
    os.environ["XLA_FLAGS"] = _extended_flags(before or "")
    try:
        # XLA parses the variable once, at the first compile options made in the process; no backend
        # starts for that.
        from jaxlib.xla_client import CompileOptions

        _ = CompileOptions().executable_build_options.debug_options
    except (
        ImportError,
        AttributeError,
    ):  # another jaxlib: it parses when the backend starts, so the variable stays
        return
    if before is None:
        del os.environ["XLA_FLAGS"]
    else:
        os.environ["XLA_FLAGS"] = before


def _is_plain() -> bool:
    return os.environ.get(PLAIN, "") not in ("", "0")


def _set_up() -> None:
    """Sets JAX up for this package, unless it runs already or `DPEND_PLAIN_JAX=1` asks to leave it
    alone.

    Raises:
        RuntimeError: `XLA_FLAGS` that XLA would end the process over.
    """
    if _is_plain() or is_running():
        return
    # The user's own word stands; `require_float64` then says what is missing.
    if "JAX_ENABLE_X64" not in os.environ:
        jax.config.update("jax_enable_x64", True)
    _check_flags()
    with contextlib.suppress(OSError):
        _add_compile_options()


def is_running() -> bool:
    """Whether JAX has started a backend."""
    chosen = jax.config.jax_num_cpu_devices  # type: ignore[attr-defined]
    if not choose_devices(2 if chosen == 1 else 1):
        return True
    choose_devices(chosen)
    return False


def choose_devices(count: int) -> bool:
    """Whether JAX could be given so many CPU devices: it refuses once a backend runs, which is its
    public test for that.
    """
    try:
        jax.config.update("jax_num_cpu_devices", count)
    except RuntimeError:
        return False
    return True


def count_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@functools.cache
def take_all_cores() -> None:
    """Gives JAX one CPU device a core, once, unless it runs or somebody has chosen their number."""
    chosen = jax.config.jax_num_cpu_devices >= 0  # type: ignore[attr-defined]
    forced = "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", "")
    if not (_is_plain() or chosen or forced):
        choose_devices(count_cores())


def require_float64() -> None:
    """Refuses to compute in single precision; at the first computation, takes all cores.

    Raises:
        RuntimeError: `jax_enable_x64` is off.
    """
    if not jax.config.jax_enable_x64:  # type: ignore[attr-defined]
        raise RuntimeError(
            "float64 is off in JAX, and dpend's digits need it: import dpend before JAX runs "
            "anything, "
            'or call jax.config.update("jax_enable_x64", True), or set JAX_ENABLE_X64=1'
        )
    take_all_cores()


_set_up()
