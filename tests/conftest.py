"""A strict climate: float64, warnings are errors (pyproject.toml), strict promotion, and shapes
checked at run time.
"""

import os

# The suite runs in one process: keep its compiled code out of the user's cache.
os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)

from jaxtyping import install_import_hook

with install_import_hook("dpend", "beartype.beartype"):
    import dpend
    import dpend.cli
    import dpend.plots

import jax
import pytest

jax.config.update("jax_numpy_dtype_promotion", "strict")
dpend.configure()


@pytest.fixture(scope="session")
def paper() -> dpend.Pendulum:
    """The paper's pendulum."""
    return dpend.Pendulum()


@pytest.fixture(scope="session")
def unit() -> dpend.Pendulum:
    """m = l = g = 1, the units of the reference values."""
    return dpend.Pendulum(1.0, 1.0, 1.0, 1.0, 1.0)
