"""How JAX is set up when dpend is imported: float64, one CPU device a core, and XLA options that make time loops fast.

This is the package's one effect at import, and it happens only while JAX has not started a backend. With
`DPEND_PLAIN_JAX=1` in the environment nothing is touched: everything works, more slowly, and float64 is then the
caller's to switch on.

The options are undocumented, and XLA ends the process over a flag it does not know, so each name is looked up in the
installed jaxlib first. What they are worth was measured: one order-8 trajectory with tangents runs six times as fast.
"""

import contextlib
import mmap
import os
import re
from pathlib import Path

import jax
import jaxlib

PLAIN = "DPEND_PLAIN_JAX"

# A step has several outputs; by default XLA fuses the step once for each and computes its stages again in every one.
_SHARE_OUTPUTS = ("xla_cpu_use_multi_output_fusion", "true")
# Loops whose state is below this many bytes become one kernel, without a dispatch for each operation of each turn.
_LOOP_IN_ONE_KERNEL = ("xla_cpu_small_while_loop_byte_threshold", "1000000")
# XLA stays at 256 bits even where the processor has 512.
_VECTOR_WIDTH = ("xla_cpu_prefer_vector_width", "512")


def _known_to_xla(*names: str) -> bool:
    """Whether the installed XLA mentions every one of `names` (a search of its shared library, a few milliseconds)."""
    library = Path(jaxlib.__file__).parent / "libjax_common.so"
    try:
        with library.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text:
            return all(text.find(name.encode()) >= 0 for name in names)
    except (OSError, ValueError):
        return False


def _has_avx512() -> bool:
    try:
        return "avx512f" in Path("/proc/cpuinfo").read_text()
    except OSError:
        return False


def _extended_flags(flags: str) -> str:
    """`flags` (the user's `XLA_FLAGS`) with our options added where the user has not spoken of them."""

    def spoken_of(name: str) -> bool:
        return re.search(rf"\b{name}\b", flags) is not None

    added = []
    name, width = _VECTOR_WIDTH
    if not spoken_of(name) and _has_avx512() and _known_to_xla(name):
        added.append(f"--{name}={width}")
    extra = [option for option in (_SHARE_OUTPUTS, _LOOP_IN_ONE_KERNEL) if not spoken_of(option[0])]
    if extra and _known_to_xla("xla_backend_extra_options", *(name for name, _ in extra)):
        added.append("--xla_backend_extra_options=" + ",".join(f"{name}={value}" for name, value in extra))
    return " ".join([flags, *added]).strip()


def _add_compile_options() -> None:
    """Has XLA parse its options with ours among them, then restores `XLA_FLAGS`, which child processes inherit."""
    before = os.environ.get("XLA_FLAGS")
    os.environ["XLA_FLAGS"] = _extended_flags(before or "")
    try:
        # XLA parses the variable once, at the first compile options made in the process; no backend starts for that.
        from jaxlib.xla_client import CompileOptions

        _ = CompileOptions().executable_build_options.debug_options
    except (ImportError, AttributeError):  # another jaxlib: it parses when the backend starts, so the variable stays
        return
    if before is None:
        del os.environ["XLA_FLAGS"]
    else:
        os.environ["XLA_FLAGS"] = before


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def configure() -> None:
    """Sets JAX up for this package, unless it runs already or `DPEND_PLAIN_JAX=1` asks to leave it alone."""
    if os.environ.get(PLAIN, "") not in ("", "0"):
        return
    devices = jax.config.jax_num_cpu_devices  # type: ignore[attr-defined]
    forced = "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", "")
    wanted = _cores() if devices < 0 and not forced else devices
    try:
        jax.config.update("jax_num_cpu_devices", wanted)  # refused once a backend runs: the public test for that
    except RuntimeError:
        return
    if "JAX_ENABLE_X64" not in os.environ:  # the user's own word stands; `require_float64` then says what is missing
        jax.config.update("jax_enable_x64", True)
    with contextlib.suppress(OSError):
        _add_compile_options()


def require_float64() -> None:
    """Refuses to compute in single precision.

    Raises:
        RuntimeError: `jax_enable_x64` is off.
    """
    if not jax.config.jax_enable_x64:  # type: ignore[attr-defined]
        raise RuntimeError(
            "float64 is off in JAX, and dpend's digits need it: import dpend before JAX runs anything, "
            'or call jax.config.update("jax_enable_x64", True), or set JAX_ENABLE_X64=1'
        )


configure()
