"""Compiled programs in files, loaded without tracing: the command line's first answer.

JAX's compilation cache saves what XLA does; tracing and lowering a program of four thousand
equations are 1.2 s that it does not save. An executable in a file saves those too. Its name is a
digest of all that its code depends on: this package's sources, the versions of JAX and Python, the
processor, XLA's flags, the devices, the shapes and types of the arguments. What is not as it was
written is ignored, and the program is traced as ever.
"""

import contextlib
import hashlib
import os
import pickle
import platform
import stat
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import jaxlib
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache import compilation_cache

from dpend.checks import is_traced

_HEAD = b"dpend executable 1\n"
# Two thirds of XLA's time go into these, and a program that runs once gains little by them: a
# search for an orbit takes 1 s to compile in place of 3 s, and then 10 ms in place of 4 ms.
_Options: TypeAlias = dict[str, str | bool]
_QUICKLY: _Options = {
    "xla_backend_optimization_level": "0",
    "xla_cpu_use_fusion_emitters": False,
    "xla_disable_hlo_passes": "while-loop-invariant-code-motion",
}
_folder: Path | None = None
_loaded: dict[str, Callable[..., Any]] = {}


def keep_executables(folder: Path | None) -> None:
    """Has programs kept in `folder`, which nobody else may write to, or in none."""
    global _folder
    _folder = folder


def run_kept(function: Any, arguments: tuple, static: tuple = ()) -> Any:
    """function(*arguments, *static), jitted with the last ones static, from its file where that is
    there.
    """
    # Elsewhere than on a CPU, and in the midst of a trace, JAX's own way is the only one.
    leaves = jax.tree.leaves(arguments)
    if _folder is None or any(map(is_traced, leaves)) or jax.default_backend() != "cpu":
        return function(*arguments, *static)
    key = _key(function.__qualname__, arguments, static)
    if key not in _loaded:
        path = _folder / f"{key}.executable"
        program = _read(path, key)
        if program is None or not _runs(program, arguments):
            program = _compile(function, arguments, static)
            _write(path, key, program)
        _loaded[key] = program
    return _loaded[key](*arguments)


def _runs(program: Callable[..., Any], arguments: tuple) -> bool:
    """Whether a loaded program runs: XLA looks for some of its parts only then."""
    try:
        jax.block_until_ready(program(*arguments))
    except Exception:
        return False
    return True


def _compile(function: Any, arguments: tuple, static: tuple) -> Callable[..., Any]:
    """Past JAX's compilation cache: a program that came from there cannot be written again, its
    parts are then not found when it is loaded.
    """
    kept = jax.config.jax_enable_compilation_cache  # type: ignore[attr-defined]
    _use_cache(False)
    try:
        lowered = function.lower(*arguments, *static)
        compiled: Callable[..., Any] = lowered.compile(compiler_options=_options())
    finally:
        _use_cache(kept)
    return compiled


def _options() -> _Options:
    """Those of `_QUICKLY` that the installed XLA knows: it refuses to compile with any other."""
    program = jax.jit(lambda: 0).lower()
    known: _Options = {}
    for name, value in _QUICKLY.items():
        with contextlib.suppress(jax.errors.JaxRuntimeError):
            program.compile(compiler_options={name: value})
            known[name] = value
    return known


def _use_cache(wanted: bool) -> None:
    """Switches JAX's compilation cache, about which JAX asks once in a process unless it is
    reset.
    """
    jax.config.update("jax_enable_compilation_cache", wanted)
    compilation_cache.reset_cache()


def _key(name: str, arguments: tuple, static: tuple) -> str:
    leaves, structure = jax.tree.flatten(arguments)
    kinds = [(type(leaf).__name__, str(jax.typeof(leaf))) for leaf in leaves]
    return _digest(repr((_surroundings(), name, static, str(structure), kinds)).encode())


@cache
def _surroundings() -> tuple:
    """All that a program's code depends on besides its arguments."""
    house = Path(__file__).parent
    sources = b"".join(path.read_bytes() for path in sorted(house.rglob("*.py")))
    settings = sorted((key, repr(value)) for key, value in jax.config.values.items())
    settings = [pair for pair in settings if "cache" not in pair[0]]
    flags = [os.environ.get(name, "") for name in ("XLA_FLAGS", "DPEND_PLAIN_JAX")]
    versions = jax.__version__, jaxlib.__version__, sys.version, platform.platform()
    return (_digest(sources), versions, processor(), settings, flags, jax.device_count())


def processor() -> str:
    """The processor's model and abilities, on which compiled code depends."""
    with contextlib.suppress(OSError):
        text = Path("/proc/cpuinfo").read_text().split("\n\n")[0].splitlines()
        return "".join(line for line in text if line.startswith(("model", "flags", "Feat")))
    return platform.processor()


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _is_ours(path: Path) -> bool:
    """Whether only this user may have written it: unpickling a file runs what is in it."""
    status = path.lstat()
    shared = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return not stat.S_ISLNK(status.st_mode) and status.st_uid == os.getuid() and not shared


def _read(path: Path, key: str) -> Callable[..., Any] | None:
    """The program in a file; None where it is not there or not what was written."""
    try:
        if not (_is_ours(path.parent) and _is_ours(path)):
            return None
        data = path.read_bytes()
        size = len(_HEAD) + 64
        head, body = data[:size], data[size:]
        if head != _HEAD + _digest(key.encode() + body).encode():
            return None
        # Lowering any factorisation has JAX register LAPACK with XLA; without it a loaded program
        # that calls LAPACK ends the process.
        jax.jit(jax.lax.linalg.lu).lower(jnp.zeros((1, 1)))
        code, given, found = pickle.loads(body)
        return serialize_executable.deserialize_and_load(
            code, given, found, execution_devices=[jax.devices()[0]]
        )
    except Exception:  # another layout of JAX's own: the program is traced as ever
        return None


def _write(path: Path, key: str, program: Any) -> None:
    """Writes a program under another name first: nobody sees half a file."""
    try:
        path.parent.mkdir(mode=0o700, exist_ok=True)
        body = pickle.dumps(serialize_executable.serialize(program))
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
            file.write(_HEAD + _digest(key.encode() + body).encode() + body)
        os.replace(file.name, path)
    except Exception:  # no room, or a program that JAX cannot write: a cache only saves time
        return
