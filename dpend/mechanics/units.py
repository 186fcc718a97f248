"""Natural units: l1 = m1 = g = 1, so that a pendulum is (l2/l1, m2/m1), and sizes of small
displacements.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp

from dpend.checks import Scalar
from dpend.mechanics.linear import fast_frequency
from dpend.mechanics.pendulum import Pendulum, State, check_pendulum


class Norm(NamedTuple):
    """The size of a tangent; momenta are measured in units of 1/per_unit [kg m^2/s]. See the
    module's page.
    """

    per_unit1: Scalar
    per_unit2: Scalar

    def square(self, tangent: State) -> Scalar:
        """|d|^2, without dimension."""
        rate1, rate2 = self.per_unit1 * tangent.p1, self.per_unit2 * tangent.p2
        return tangent.theta1**2 + tangent.theta2**2 + rate1**2 + rate2**2

    def vector(self, *components: float) -> State:
        """The tangent with these components without dimension."""
        theta1, theta2, rate1, rate2 = components
        return State(
            theta1 + 0.0 * self.per_unit1,
            theta2 + 0.0 * self.per_unit2,
            rate1 / self.per_unit1,
            rate2 / self.per_unit2,
        )


def norm(pendulum: Pendulum | Any) -> Norm:
    """The norm in which this page measures tangents of `pendulum`."""
    check_pendulum(pendulum)
    frequency = fast_frequency(pendulum)
    rate = jnp.where(frequency > 0, frequency, 1.0)
    unit1 = (pendulum.m1 + pendulum.m2) * pendulum.l1 * pendulum.l1 * rate
    return Norm(1.0 / unit1, 1.0 / (pendulum.m2 * pendulum.l2 * pendulum.l2 * rate))


def natural(pendulum: Pendulum) -> Pendulum:
    """The pendulum in units of l1, m1 and sqrt(l1/g)."""
    return Pendulum(1.0, pendulum.l2 / pendulum.l1, 1.0, pendulum.m2 / pendulum.m1, 1.0)
