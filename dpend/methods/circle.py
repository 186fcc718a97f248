"""The circle form of a step, without trigonometry.

Sine and cosine of both angles are carried as state, s' = c omega and c' = -s omega, and the angles
are two more sums that nothing depends on. No step computes a sine, which is half of the canonical
form's work. It is another discretisation of the same equations: s^2 + c^2 = 1 holds to the method's
error, no better.
"""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp

from dpend.checks import Scalar
from dpend.mechanics.linear import fast_frequency
from dpend.mechanics.pendulum import Pendulum, State
from dpend.mechanics.trig import sincos
from dpend.methods.runge_kutta import Form, Step

# The weight of q in u. With it and the power -5/8 of u an error of 6e-6 and of 8e-9 rad, on
# releases over the whole square, takes the fewest steps: 10 % fewer than with a weight of 1 and the
# power -1/2.
_SPIN_WEIGHT = 0.85


class _Circle(NamedTuple):
    """A state without trigonometry, in units that leave the field four constants.

    sin1 and cos1 lie on a circle of radius sqrt(mu), mu = m2/m1, so that their products with sin2
    and cos2 are sqrt(mu) times the sine and cosine of delta = theta1 - theta2; rate1 = p1/(m1 l1^2)
    and rate2 = p2/(sqrt(mu) m1 l1 l2) are momenta [1/s].
    """

    theta1: Scalar
    theta2: Scalar
    sin1: Scalar
    cos1: Scalar
    sin2: Scalar
    cos2: Scalar
    rate1: Scalar
    rate2: Scalar


def _root_mu(pendulum: Pendulum) -> Scalar:
    return jnp.sqrt(pendulum.m2 / pendulum.m1)


def _rate_units(pendulum: Pendulum) -> tuple[Scalar, Scalar]:
    """The momenta that belong to rate1 = rate2 = 1/s."""
    unit1 = pendulum.m1 * pendulum.l1 * pendulum.l1
    return unit1, _root_mu(pendulum) * pendulum.m1 * pendulum.l1 * pendulum.l2


class _Constants(NamedTuple):
    """What a circle's slopes need of the pendulum and the step; the pendulum's share is computed
    once, outside the loop over steps.
    """

    step: Scalar  # dt [s]
    unit1: Scalar  # the momenta that belong to rate1 = rate2 = 1/s
    unit2: Scalar
    per_unit1: Scalar  # their inverses: a division costs as much as a dozen multiplications
    per_unit2: Scalar
    mass_ratio: Scalar  # 1 + mu
    ratio: Scalar  # l1/(l2 sqrt(mu))
    back: Scalar  # its inverse
    weight1: Scalar  # of gravity, times the step
    weight2: Scalar
    # 0.85/omega_f^2, zero without gravity: nothing but the motion itself then sets a time
    rescaling: Scalar


class _Tangent(NamedTuple):
    """A displacement of the angles and the rates."""

    angle1: Scalar
    angle2: Scalar
    rate1: Scalar
    rate2: Scalar


class _Motion(NamedTuple):
    """What slopes and tangents of a circle are made of."""

    sin_delta: Scalar  # times sqrt(mu), as cos_delta
    cos_delta: Scalar
    inverse: Scalar  # 1/(1 + mu sin^2 delta)
    omega1: Scalar  # [1/s]
    omega2: Scalar


def _motion(constants: _Constants, x: _Circle) -> _Motion:
    sin_delta = x.sin1 * x.cos2 - x.cos1 * x.sin2
    cos_delta = x.cos1 * x.cos2 + x.sin1 * x.sin2
    inverse = 1.0 / (1.0 + sin_delta * sin_delta)
    omega1 = inverse * (x.rate1 - cos_delta * x.rate2)
    omega2 = inverse * (constants.ratio * (constants.mass_ratio * x.rate2 - cos_delta * x.rate1))
    return _Motion(sin_delta, cos_delta, inverse, omega1, omega2)


def _circle_increment(constants: _Constants, x: _Circle) -> _Circle:
    """Hamilton's equations times dt; s' = c omega, c' = -s omega."""
    motion = _motion(constants, x)
    turn1, turn2 = constants.step * motion.omega1, constants.step * motion.omega2
    pull = turn1 * motion.sin_delta * motion.omega2
    rate1 = -(constants.back * pull) - constants.weight1 * x.sin1
    rate2 = pull - constants.weight2 * x.sin2
    return _Circle(
        turn1, turn2, x.cos1 * turn1, -x.sin1 * turn1, x.cos2 * turn2, -x.sin2 * turn2, rate1, rate2
    )


def _tangent_increment(
    constants: _Constants, pair: tuple[_Circle, _Tangent]
) -> tuple[_Circle, _Tangent]:
    """Increments of a circle and of a tangent of it: the variational equations in the angles,
    written out.

    Four components where the circle has eight, and two thirds of the operations of `jax.jvp`, which
    tests hold it to.
    """
    x, d = pair
    sin_delta, cos_delta, inverse, omega1, omega2 = _motion(constants, x)
    between = d.angle1 - d.angle2
    shear = sin_delta * between  # -d cos(delta)
    deepening = 2.0 * cos_delta * shear  # d (1 + mu sin^2 delta)
    step = constants.step * inverse
    turn1 = step * (d.rate1 - cos_delta * d.rate2 + shear * x.rate2 - deepening * omega1)
    turn2 = step * (
        constants.ratio * (constants.mass_ratio * d.rate2 - cos_delta * d.rate1 + shear * x.rate1)
        - deepening * omega2
    )
    pull = sin_delta * (turn1 * omega2 + omega1 * turn2) + constants.step * (omega1 * omega2) * (
        cos_delta * between
    )
    rate1 = -(constants.back * pull) - constants.weight1 * (x.cos1 * d.angle1)
    rate2 = pull - constants.weight2 * (x.cos2 * d.angle2)
    return _circle_increment(constants, x), _Tangent(turn1, turn2, rate1, rate2)


def spin_of(constants: _Constants, x: _Circle) -> Scalar:
    """u = 1 + 0.85 (omega1^2 + omega2^2 + (omega1 - omega2)^2)/omega_f^2."""
    motion = _motion(constants, x)
    between = motion.omega1 - motion.omega2
    return 1.0 + constants.rescaling * (
        motion.omega1 * motion.omega1 + motion.omega2 * motion.omega2 + between * between
    )


class _CircleForm(Form):
    """Points on two circles."""

    written_out = True

    def enter(self, pendulum: Pendulum, state: State) -> _Circle:
        sin1, cos1 = sincos(state.theta1)
        sin2, cos2 = sincos(state.theta2)
        root = _root_mu(pendulum)
        unit1, unit2 = _rate_units(pendulum)
        on_circles = root * sin1, root * cos1, sin2, cos2
        rates = state.p1 / unit1, state.p2 / unit2
        return _Circle(state.theta1, state.theta2, *on_circles, *rates)

    def leave(self, constants: _Constants, point: _Circle) -> State:
        momenta = constants.unit1 * point.rate1, constants.unit2 * point.rate2
        return State(point.theta1, point.theta2, *momenta)

    def constants(self, pendulum: Pendulum) -> _Constants:
        root = _root_mu(pendulum)
        mass_ratio = 1.0 + pendulum.m2 / pendulum.m1
        frequency = fast_frequency(pendulum)
        swings = frequency > 0
        unit1, unit2 = _rate_units(pendulum)
        return _Constants(
            jnp.ones_like(root),
            unit1,
            unit2,
            1.0 / unit1,
            1.0 / unit2,
            mass_ratio,
            pendulum.l1 / (root * pendulum.l2),
            root * pendulum.l2 / pendulum.l1,
            mass_ratio * pendulum.g / (pendulum.l1 * root),
            pendulum.g * root / pendulum.l1,
            jnp.where(swings, _SPIN_WEIGHT / jnp.where(swings, frequency, 1.0) ** 2, 0.0),
        )

    def with_step(self, constants: _Constants, dt: Scalar) -> _Constants:
        return constants._replace(
            step=constants.step * dt, weight1=constants.weight1 * dt, weight2=constants.weight2 * dt
        )

    def increment(self, constants: _Constants, point: _Circle) -> _Circle:
        return _circle_increment(constants, point)

    def move_tangents(
        self, step: Step, constants: _Constants, point: _Circle, tangents: State
    ) -> tuple[_Circle, State]:
        """The method on the variational equations along its own stages.

        This is the derivative of the step but for the circle's drift, and moves four components
        instead of six.
        """
        rates = constants.per_unit1 * tangents.p1, constants.per_unit2 * tangents.p2
        tangent = _Tangent(tangents.theta1, tangents.theta2, *rates)
        point, tangent = step(partial(_tangent_increment, constants), (point, tangent))
        momenta = constants.unit1 * tangent.rate1, constants.unit2 * tangent.rate2
        return point, State(tangent.angle1, tangent.angle2, *momenta)


CIRCLE = _CircleForm()
