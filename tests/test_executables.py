"""Programs in files: the same bits as traced ones, and nothing that is not as it was written."""

import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

from dpend import executables
from dpend.executables import keep_executables, run_kept


class Bomb:
    """What must never be unpickled."""

    def __reduce__(self):
        return pytest.fail, ("a file was unpickled that is not ours",)


@jax.jit
def solve(matrix, b):
    return jnp.linalg.solve(matrix, b), jnp.sin(b)


GIVEN = np.array([[2.0, 0.3], [0.1, 1.0]]), np.array([1.0, 0.7])


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "kept"
    keep_executables(folder)
    yield folder
    keep_executables(None)
    executables._loaded.clear()


def answer():
    executables._loaded.clear()
    return [np.asarray(part).tobytes() for part in run_kept(solve, GIVEN)]


def test_a_loaded_program_gives_the_bits_of_the_traced_one(folder, monkeypatch):
    traced = answer()
    (path,) = folder.iterdir()
    assert (folder.stat().st_mode & 0o777, path.stat().st_mode & 0o777) == (0o700, 0o600)
    monkeypatch.setattr(executables, "_compile", lambda *_: pytest.fail("it was traced"))
    assert answer() == traced == [np.asarray(part).tobytes() for part in solve(*GIVEN)]


def test_programs_are_kept_beside_a_compilation_cache_that_knows_them(folder, tmp_path):
    """A program that XLA took from JAX's cache cannot be written: JAX has to be kept from it."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "cache"))
    try:
        compilation_cache.reset_cache()
        traced = answer()
        for path in folder.iterdir():
            path.unlink()
        assert answer() == traced
        (path,) = folder.iterdir()
        assert executables._read(path, path.stem) is not None
        assert executables._runs(executables._read(path, path.stem), GIVEN)
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
        compilation_cache.reset_cache()


def test_what_is_not_as_it_was_written_is_ignored_and_written_anew(folder):
    traced = answer()
    (path,) = folder.iterdir()
    whole = path.read_bytes()
    bomb = pickle.dumps(Bomb())
    for wrong in (
        b"",
        whole[:-1],
        whole[:100],
        whole[:5000] + bytes([whole[5000] ^ 1]) + whole[5001:],
        bomb,
        executables._HEAD + executables._digest(bomb).encode() + bomb,  # of another key
    ):
        path.write_bytes(wrong)
        assert executables._read(path, path.stem) is None
        assert answer() == traced
        assert executables._read(path, path.stem) is not None


def test_options_that_this_xla_does_not_know_are_left_out(folder, monkeypatch):
    known = executables._options()
    monkeypatch.setattr(executables, "_QUICKLY", {**known, "xla_cpu_no_such_option": True})
    assert executables._options() == known
    assert answer() == [np.asarray(part).tobytes() for part in solve(*GIVEN)]


def test_a_file_that_others_may_write_is_not_read(folder):
    answer()
    (path,) = folder.iterdir()
    for shared in (path, folder):
        before = shared.stat().st_mode
        shared.chmod(before | 0o020)
        assert executables._read(path, path.stem) is None
        shared.chmod(before)
    assert executables._read(path, path.stem) is not None


def test_other_shapes_sources_and_flags_are_other_programs(folder, monkeypatch):
    keys = {executables._key("f", GIVEN, ()), executables._key("f", GIVEN, (True,))}
    keys.add(executables._key("f", (GIVEN[0][None], GIVEN[1]), ()))
    keys.add(executables._key("f", (GIVEN[0].astype(int), GIVEN[1]), ()))
    monkeypatch.setattr(executables, "_surroundings", lambda: "another machine")
    keys.add(executables._key("f", GIVEN, ()))
    assert len(keys) == 5
