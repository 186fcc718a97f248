"""The surface of one energy, and the planes that motions cross on it.

At the angles theta the momenta of energy E lie on the ellipse p^T M^-1 p = 2 K, K = E - V(theta),
M the inertia matrix. On a plane where one angle is given, the other angle and its momentum (q, p)
are canonical coordinates of the surface: the flow's return map preserves the area dq dp. They name
a state up to the `side`, the sign of the first angle's velocity.
"""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from dpend.checks import Scalar, coordinate, known_number, one_of, shown
from dpend.mechanics.pendulum import (
    Pendulum,
    State,
    check_mechanics,
    check_pendulum,
    hamiltonian,
    released,
    velocities,
)
from dpend.mechanics.trig import sincos


def on_energy(
    pendulum: Pendulum | Any,
    energy: Scalar,
    theta1: Scalar,
    theta2: Scalar,
    *,
    p1: Scalar | None = None,
    p2: Scalar | None = None,
    phi: Scalar | None = None,
    side: int | Any = 1,
) -> State:
    """The state of this energy with these angles and one momentum, or one direction of momentum.

    With p2 given, p1 is the root of H = E at which theta1' has the sign of `side`; with p1 given,
    p2 is the one at which theta2' has. With phi given, p = sqrt(2 K) L (cos phi, sin phi), L L^T =
    M with L lower triangular: all states of this energy at these angles, once each. At phi = 0 the
    lower rod does not turn.

    Arguments:
        energy: H [J], zero for both bobs at rest at the pivot's height; like the angles and momenta
            a number or an array, shapes that broadcast.
        theta1, theta2: angles [rad].
        p1, p2: canonical momentum [kg m^2/s].
        phi: direction [rad].
        side: 1 or -1; the other state through the same point of the plane. Not used with phi.
    Returns:
        State; its momenta are NaN where the energy does not suffice for what is given.
    Raises:
        ValueError: not exactly one of p1, p2 and phi; side neither 1 nor -1; a value is no finite
            number.
    """
    check_pendulum(pendulum)
    energy = coordinate("energy", energy, unit="J")
    rest = released(theta1, theta2)
    side = one_of("side", side, (-1, 1))
    given = {"p1": p1, "p2": p2, "phi": phi}
    given = {name: value for name, value in given.items() if value is not None}
    if len(given) != 1:
        raise ValueError(
            f"p1, p2 or phi must be given, one of them, got {', '.join(given) or 'none'}: "
            f"give one like p2=0.0"
        )
    ((name, value),) = given.items()
    value = coordinate(name, value, unit="rad" if name == "phi" else "kg m^2/s")
    p1, p2 = _momenta_of(pendulum, energy, rest, name, value, side)
    return State(*jnp.broadcast_arrays(rest.theta1, rest.theta2, p1, p2))


def _momenta_of(
    pendulum: Pendulum, energy: Scalar, rest: State, name: str, value: Scalar, side: int
) -> tuple[Scalar, Scalar]:
    """The momenta of `on_energy`, where `name` has this value."""
    inertia1 = (pendulum.m1 + pendulum.m2) * pendulum.l1 * pendulum.l1
    inertia2 = pendulum.m2 * pendulum.l2 * pendulum.l2
    sin_delta, cos_delta = sincos(rest.theta1 - rest.theta2)
    coupling = pendulum.m2 * pendulum.l1 * pendulum.l2 * cos_delta
    # det M = inertia1 inertia2 - coupling^2, without the difference.
    determinant = inertia2 * pendulum.l1**2 * (pendulum.m1 + pendulum.m2 * sin_delta**2)
    twice = 2.0 * (energy - hamiltonian(pendulum, rest))  # the kinetic energy
    if name == "phi":
        sine, cosine = sincos(value)
        size, edge = jnp.sqrt(twice), jnp.sqrt(inertia1)
        return size * edge * cosine, size * (
            coupling * cosine + jnp.sqrt(determinant) * sine
        ) / edge
    own = inertia2 if name == "p2" else inertia1
    # (det M) omega^2 = 2 K own - p^2 for the velocity whose momentum is sought.
    root = jnp.sqrt(determinant * (twice * own - value * value))
    other = (coupling * value + side * root) / own
    value = value + 0.0 * root  # of the same shape, and NaN where the other is
    return (other, value) if name == "p2" else (value, other)


@dataclass(frozen=True)
class Plane:
    """The states whose `angle` is `at` up to full turns: a function for `crossings`, and the
    coordinates on it.

    Attributes:
        angle: `theta1` or `theta2`; the other angle and its momentum are the coordinates.
        at: its value [rad]. Reflection maps the planes at 0 and pi to themselves, and their side 1
            to their side -1.
    Raises:
        ValueError: another angle; `at` no known finite number.
    """

    angle: str | Any = "theta1"
    at: float | Any = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "angle", one_of("angle", self.angle, ("theta1", "theta2")))
        object.__setattr__(self, "at", known_number("at", self.at, unit="rad"))

    @property
    def coordinates(self) -> tuple[str, str]:
        """The names of the coordinates on it."""
        return ("theta2", "p2") if self.angle == "theta1" else ("theta1", "p1")

    def __call__(self, pendulum: Pendulum | Any, state: State | Any) -> Scalar:
        """sin((theta - at)/2), zero on the plane and nowhere else.

        After an odd number of full turns it falls where the angle rises: `side` does not ask for
        turns.
        """
        check_mechanics(pendulum, state)
        return sincos(0.5 * (getattr(state, self.angle) - self.at))[0]

    def point(self, state: State) -> tuple[Scalar, Scalar]:
        """The coordinates of a state: the other angle [rad], never wrapped, and its momentum
        [kg m^2/s].
        """
        angle, momentum = self.coordinates
        return getattr(state, angle), getattr(state, momentum)

    def side(self, pendulum: Pendulum, state: State) -> Scalar:
        """The sign of the velocity of `angle`."""
        omega1, omega2 = velocities(pendulum, state)
        return jnp.sign(omega1 if self.angle == "theta1" else omega2)

    def state(
        self, pendulum: Pendulum, energy: Scalar, angle: Scalar, momentum: Scalar, side: int = 1
    ) -> State:
        """The state of this energy with these coordinates; momenta are NaN where there is none."""
        if self.angle == "theta1":
            return on_energy(pendulum, energy, self.at, angle, p2=momentum, side=side)
        return on_energy(pendulum, energy, angle, self.at, p1=momentum, side=side)

    def largest_momentum(self, pendulum: Pendulum, energy: Scalar, angle: Scalar) -> Scalar:
        """The edge |p| of what the energy allows on it at an angle [kg m^2/s], NaN beyond: there
        motions touch the plane.
        """
        upper = self.angle == "theta2"
        rest = released(angle, self.at) if upper else released(self.at, angle)
        inertia = (
            (pendulum.m1 + pendulum.m2) * pendulum.l1**2 if upper else pendulum.m2 * pendulum.l2**2
        )
        return jnp.sqrt(2.0 * inertia * (energy - hamiltonian(pendulum, rest)))


def check_plane(plane: Any) -> None:
    """Refuses what is no `Plane`.

    Raises:
        ValueError: another class.
    """
    if not isinstance(plane, Plane):
        raise ValueError(
            f'plane must be a Plane, got {shown(plane)}: give dpend.Plane("theta1") or '
            f'dpend.Plane("theta2")'
        )
