"""The pendulum: two point masses on massless rods in a plane, without friction or drive.

Angles are absolute, from the downward vertical, positive anticlockwise; p1 and p2 are the canonical
momenta. With delta = theta1 - theta2 and mu = m2/m1 the Hamiltonian is (Yamaguchi, section 2)

    H = [p1^2/(2 m1 l1^2) + p2^2 (1 + mu)/(2 m2 l2^2) - p1 p2 cos(delta)/(m1 l1 l2)]
        / (1 + mu sin^2 delta)
        - (m1 + m2) g l1 cos theta1 - m2 g l2 cos theta2.

Every function takes leaves of any one shape, so grids of states and of pendulums need no `vmap`;
what is no `Pendulum` or no `State` raises a ValueError. SI units throughout.
"""

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Annotated, Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from dpend._runtime import require_float64
from dpend.checks import (
    Scalar,
    coordinate,
    instance,
    known_number,
    number,
    one_shape,
    single,
)
from dpend.mechanics.trig import sincos
from dpend.records import units_of

Tree = TypeVar("Tree")


def _register(cls: type[Tree]) -> type[Tree]:
    """Make a dataclass whose constructor checks its numbers a JAX tree of its fields.

    Libraries rebuild trees from leaves that are no numbers: masks, `None`, text, shapes,
    differences of lengths. So unflattening fills the fields and never runs a check: any leaf
    passes. `register_dataclass` calls the constructor.
    """
    names = [field.name for field in fields(cls)]  # type: ignore[arg-type]
    keys = [jax.tree_util.GetAttrKey(name) for name in names]

    def flatten(tree: Tree) -> tuple[list[Any], None]:
        return [getattr(tree, name) for name in names], None

    def flatten_with_keys(tree: Tree) -> tuple[list[tuple[Any, Any]], None]:
        return list(zip(keys, flatten(tree)[0], strict=True)), None

    def unflatten(_: None, leaves: Iterable[Any]) -> Tree:
        tree = object.__new__(cls)
        for name, leaf in zip(names, leaves, strict=True):
            object.__setattr__(tree, name, leaf)
        return tree

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    return cls


@_register
@dataclass(frozen=True)
class Pendulum:
    """The parameters of a double pendulum; bob 1 hangs from the pivot, bob 2 from bob 1.

    The defaults are those of Yamaguchi's paper. Whoever constructs one has its numbers checked and
    made float64, of arrays the sign; tracers pass, and so does everything that libraries put into
    the tree by unflattening.

    Attributes:
        l1, l2: lengths of the rods [m], positive.
        m1, m2: masses of the bobs [kg], positive.
        g: acceleration of gravity [m/s^2], downwards; any finite number, but orbits and modes need
            g > 0.
    Raises:
        ValueError: a parameter is no finite number, or a length or mass not positive; arrays that
            do not broadcast.
        RuntimeError: float64 is switched off in JAX.
    """

    l1: Annotated[Scalar, "m"] = 0.2
    l2: Annotated[Scalar, "m"] = 0.2
    m1: Annotated[Scalar, "kg"] = 0.1
    m2: Annotated[Scalar, "kg"] = 0.1
    g: Annotated[Scalar, "m/s^2"] = 9.8

    def __post_init__(self) -> None:
        require_float64()
        for name, of in units_of(type(self)).items():
            value = number(name, getattr(self, name), positive=name != "g", unit=of)
            object.__setattr__(self, name, value)
        one_shape(**vars(self))


@_register
@dataclass(frozen=True)
class State:
    """A point of phase space, or many of one shape.

    Attributes:
        theta1, theta2: absolute angles from the downward vertical [rad], never wrapped.
        p1, p2: canonical momenta [kg m^2/s].
    Raises:
        ValueError: a coordinate is no finite number; arrays that do not broadcast. An array, also a
            single number that JAX has computed, may hold NaN: a motion that was lost.
    """

    theta1: Annotated[Scalar, "rad"]
    theta2: Annotated[Scalar, "rad"]
    p1: Annotated[Scalar, "kg m^2/s"]
    p2: Annotated[Scalar, "kg m^2/s"]

    def __post_init__(self) -> None:
        for name, of in units_of(type(self)).items():
            object.__setattr__(self, name, coordinate(name, getattr(self, name), unit=of))
        one_shape(**vars(self))


def check_pendulum(pendulum: Any) -> None:
    """Refuses what is no `Pendulum`.

    Raises:
        ValueError: another class.
    """
    instance("pendulum", pendulum, Pendulum, "dpend.Pendulum(l1=...)")


def check_state(state: Any, name: str = "state") -> None:
    """Refuses what is no `State`.

    Raises:
        ValueError: another class.
    """
    instance(
        name, state, State, "dpend.released(theta1, theta2) or dpend.State(theta1, theta2, p1, p2)"
    )


def check_mechanics(pendulum: Any, state: Any) -> None:
    """Refuses what are no pendulum and no state, of any shape.

    Raises:
        ValueError: another class.
    """
    check_pendulum(pendulum)
    check_state(state)


def check_motion(pendulum: Any, state: Any) -> None:
    """Refuses what are not one pendulum and one state; `jax.vmap` maps over many.

    Raises:
        ValueError: another class, or a leaf that is an array.
    """
    check_mechanics(pendulum, state)
    for name, leaf in (*vars(pendulum).items(), *vars(state).items()):
        single(name, leaf)


def known_pendulum(pendulum: Any) -> Pendulum:
    """A pendulum whose fields are plain numbers, for what no derivative goes through.

    Raises:
        ValueError: another class; a field that is an array, or traced by `jit` or a derivative.
    """
    check_pendulum(pendulum)
    return Pendulum(**{name: known_number(name, leaf) for name, leaf in vars(pendulum).items()})


class BobEnergies(NamedTuple):
    """Energies of each bob [J], potential energies measured from that bob's place in the hanging
    equilibrium.
    """

    kinetic1: Scalar
    potential1: Scalar
    kinetic2: Scalar
    potential2: Scalar


class Positions(NamedTuple):
    """Where the bobs are [m]: x to the right, y upwards, the pivot at the origin."""

    x1: Scalar
    y1: Scalar
    x2: Scalar
    y2: Scalar


def released(theta1: Scalar, theta2: Scalar) -> State:
    """The state at rest with these angles [rad].

    Raises:
        ValueError: an angle is no finite number, as for `State`.
    """
    theta1, theta2 = (
        coordinate("theta1", theta1, unit="rad"),
        coordinate("theta2", theta2, unit="rad"),
    )
    at_rest = jnp.zeros(jnp.broadcast_shapes(jnp.shape(theta1), jnp.shape(theta2)))
    return State(theta1, theta2, at_rest, at_rest)


def _relative_angle(state: State) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """sin theta1, sin theta2, and sine and cosine of delta = theta1 - theta2, from two calls."""
    sin1, cos1 = sincos(state.theta1)
    sin2, cos2 = sincos(state.theta2)
    return sin1, sin2, sin1 * cos2 - cos1 * sin2, cos1 * cos2 + sin1 * sin2


def _rates(
    pendulum: Pendulum, state: State, sin_delta: Scalar, cos_delta: Scalar
) -> tuple[Scalar, Scalar]:
    """The angular velocities M^-1 p, with the inertia matrix's determinant m2 l1^2 l2^2 (m1 + m2
    sin^2 delta).
    """
    inertia1 = (pendulum.m1 + pendulum.m2) * pendulum.l1 * pendulum.l1
    inertia2 = pendulum.m2 * pendulum.l2 * pendulum.l2
    coupling = pendulum.m2 * pendulum.l1 * pendulum.l2 * cos_delta
    scale = inertia2 * pendulum.l1 * pendulum.l1
    inverse = 1.0 / (scale * pendulum.m1 + scale * pendulum.m2 * (sin_delta * sin_delta))
    omega1 = (inertia2 * state.p1 - coupling * state.p2) * inverse
    omega2 = (inertia1 * state.p2 - coupling * state.p1) * inverse
    return omega1, omega2


def hamiltonian(pendulum: Pendulum | Any, state: State | Any) -> Scalar:
    """The energy H [J], zero for both bobs at rest at the pivot's height."""
    check_mechanics(pendulum, state)
    _, _, sin_delta, cos_delta = _relative_angle(state)
    omega1, omega2 = _rates(pendulum, state, sin_delta, cos_delta)
    _, cos1 = sincos(state.theta1)
    _, cos2 = sincos(state.theta2)
    weight1 = (pendulum.m1 + pendulum.m2) * pendulum.g * pendulum.l1
    weight2 = pendulum.m2 * pendulum.g * pendulum.l2
    return 0.5 * (state.p1 * omega1 + state.p2 * omega2) - weight1 * cos1 - weight2 * cos2


def vector_field(pendulum: Pendulum | Any, state: State | Any) -> State:
    """The time derivative of the state, Hamilton's equations of `hamiltonian`.

    The force between the bobs is written with the velocities, m2 l1 l2 omega1 omega2 sin(delta),
    which is what the derivative of the kinetic energy with respect to delta comes to: a third of
    the operations of the paper's form.

    Returns:
        State whose leaves are theta1' , theta2' [rad/s], p1', p2' [N m].
    """
    check_mechanics(pendulum, state)
    sin1, sin2, sin_delta, cos_delta = _relative_angle(state)
    omega1, omega2 = _rates(pendulum, state, sin_delta, cos_delta)
    pull = (pendulum.m2 * pendulum.l1 * pendulum.l2) * (omega1 * omega2) * sin_delta
    torque1 = ((pendulum.m1 + pendulum.m2) * pendulum.g * pendulum.l1) * sin1
    torque2 = (pendulum.m2 * pendulum.g * pendulum.l2) * sin2
    return State(omega1, omega2, -pull - torque1, pull - torque2)


def velocities(pendulum: Pendulum | Any, state: State | Any) -> tuple[Scalar, Scalar]:
    """The angular velocities theta1', theta2' [rad/s] that belong to the momenta."""
    check_mechanics(pendulum, state)
    _, _, sin_delta, cos_delta = _relative_angle(state)
    return _rates(pendulum, state, sin_delta, cos_delta)


def momenta(
    pendulum: Pendulum | Any, theta1: Scalar, theta2: Scalar, omega1: Scalar, omega2: Scalar
) -> State:
    """The state with these angles [rad] and angular velocities [rad/s]: p = M(delta) omega.

    Raises:
        ValueError: an angle or a velocity is no finite number, as for `State`.
    """
    check_pendulum(pendulum)
    theta1, theta2 = (
        coordinate("theta1", theta1, unit="rad"),
        coordinate("theta2", theta2, unit="rad"),
    )
    omega1, omega2 = (
        coordinate("omega1", omega1, unit="rad/s"),
        coordinate("omega2", omega2, unit="rad/s"),
    )
    _, cos_delta = sincos(theta1 - theta2)
    coupling = pendulum.m2 * pendulum.l1 * pendulum.l2 * cos_delta
    p1 = (pendulum.m1 + pendulum.m2) * pendulum.l1**2 * omega1 + coupling * omega2
    p2 = pendulum.m2 * pendulum.l2**2 * omega2 + coupling * omega1
    return State(theta1, theta2, p1, p2)


def energies(pendulum: Pendulum | Any, state: State | Any) -> BobEnergies:
    """Kinetic and potential energy of each bob [J], the latter zero where that bob hangs at rest.

    Their sum is H - H(hanging at rest). 1 - cos theta is computed as 2 sin^2(theta/2), exact for
    small angles too.
    """
    check_mechanics(pendulum, state)
    omega1, omega2 = velocities(pendulum, state)
    _, cos_delta = sincos(state.theta1 - state.theta2)
    v1, v2 = pendulum.l1 * omega1, pendulum.l2 * omega2
    rise1 = 2 * pendulum.l1 * sincos(0.5 * state.theta1)[0] ** 2
    rise2 = rise1 + 2 * pendulum.l2 * sincos(0.5 * state.theta2)[0] ** 2
    return BobEnergies(
        kinetic1=0.5 * pendulum.m1 * v1**2,
        potential1=pendulum.m1 * pendulum.g * rise1,
        kinetic2=0.5 * pendulum.m2 * (v1**2 + v2**2 + 2 * v1 * v2 * cos_delta),
        potential2=pendulum.m2 * pendulum.g * rise2,
    )


def energy_scale(pendulum: Pendulum, state: State) -> Scalar:
    """What an energy error is measured against [J]: the weights' torques plus the kinetic energy of
    `state`.

    Half the range of the potential energy for a pendulum that moves under gravity; the kinetic
    energy where g = 0.
    """
    weights = (pendulum.m1 + pendulum.m2) * pendulum.l1 + pendulum.m2 * pendulum.l2
    kinetic = energies(pendulum, state)
    return weights * jnp.abs(pendulum.g) + kinetic.kinetic1 + kinetic.kinetic2


def positions(pendulum: Pendulum | Any, state: State | Any) -> Positions:
    """Where the bobs are [m]: x to the right, y upwards, the pivot at the origin."""
    check_mechanics(pendulum, state)
    sin1, cos1 = sincos(state.theta1)
    sin2, cos2 = sincos(state.theta2)
    x1, y1 = pendulum.l1 * sin1, -pendulum.l1 * cos1
    return Positions(x1, y1, x1 + pendulum.l2 * sin2, y1 - pendulum.l2 * cos2)
