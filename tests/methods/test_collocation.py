"""Tables and field of the collocation method."""

import extended
import jax
import numpy as np

from dpend import Pendulum
from dpend.methods.collocation import Field, accelerations
from dpend.methods.nodes import NODES, TABLES


def test_tables_integrate_polynomials():
    """Powers up to the seventh at the nodes, up to the fifteenth and the thirteenth over a step."""
    c = TABLES.nodes
    for row in range(2):
        for k in range(NODES):
            values = c[row] ** k
            first, second = (t[:, row].T @ values for t in (TABLES.first, TABLES.second))
            np.testing.assert_allclose(first, c[row] ** (k + 1) / (k + 1), atol=2e-16)
            np.testing.assert_allclose(second, c[row] ** (k + 2) / ((k + 1) * (k + 2)), atol=2e-16)
        for k in range((16, 14)[row]):
            np.testing.assert_allclose(TABLES.ends[0, row] @ c[row] ** k, 1 / (k + 1), rtol=1e-14)


def test_accelerations_are_the_lagrangians():
    pendulum, state = Pendulum(0.3, 0.7, 0.2, 0.5, 9.0), (0.4, -1.2, 3.0, -2.0)
    field = Field(0.5 / 0.2, 0.3 / 0.7, 9.0 / 0.3)
    rods = [(np.sin(a), np.cos(a), w) for a, w in ((0.4, 3.0), (-1.2, -2.0))]
    exact = extended.accelerations(jax.tree.leaves(pendulum), np.array(state, np.longdouble))[2:]
    np.testing.assert_allclose(accelerations(field, *rods), exact.astype(float), rtol=1e-14)
