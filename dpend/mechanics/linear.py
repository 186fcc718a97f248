"""Linear motion: normal modes, equilibria with their exponents, the rates that decide a step."""

from dataclasses import dataclass
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np

from dpend.checks import Scalar, known_value, single
from dpend.mechanics.pendulum import Pendulum, State, check_pendulum, vector_field
from dpend.mechanics.trig import sincos


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NormalMode:
    """A small oscillation theta2 = ratio theta1 about the hanging state.

    Attributes:
        frequency: angular frequency [rad/s].
        ratio: theta2/theta1, positive in the slow (in-phase) and negative in the fast (anti-phase)
            mode.
        period: 2 pi/frequency [s].
    """

    frequency: Annotated[Scalar, "rad/s"]
    ratio: Scalar
    period: Annotated[Scalar, "s"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Equilibria:
    """The four equilibria, theta in {0, pi}^2, in the order (0, 0), (0, pi), (pi, 0), (pi, pi).

    Attributes:
        state: the states, leaves of shape (4,).
        energy: H there [J], shape (4,).
        exponents: of the linear flow [1/s], complex, shape (4, 2): each row lists the two that,
            taken with both signs, make the four; real ones are rates of escape, imaginary ones
            frequencies.
    """

    state: State
    energy: Scalar
    exponents: Scalar


def normal_modes(pendulum: Pendulum | Any) -> tuple[NormalMode, NormalMode]:
    """The two small oscillations about the hanging state, slow (in-phase) first.

    A mode swings like a simple pendulum of length L with (L - l1)(L - l2) = kappa l1 l2, kappa =
    m2/(m1 + m2), so omega^2 = g/L and theta2/theta1 = l1/(L - l2). Both roots are written without
    cancellation, for any mass ratio.

    Raises:
        ValueError: g is a number that is not positive: nothing swings.
    """
    check_pendulum(pendulum)
    gravity = None if np.ndim(pendulum.g) else known_value(pendulum.g)
    if gravity is not None and not gravity > 0:
        raise ValueError(
            f"g must be positive for normal modes, got {gravity}: nothing swings without gravity"
        )
    return _modes(pendulum, pendulum.g)


def _modes(pendulum: Pendulum, gravity: Scalar) -> tuple[NormalMode, NormalMode]:
    """The normal modes under another gravity, which is not looked at."""
    l1, l2 = pendulum.l1, pendulum.l2
    share = pendulum.m2 / (pendulum.m1 + pendulum.m2)
    difference = l1 - l2
    root = jnp.sqrt(difference**2 + 4 * share * l1 * l2)
    # root + |difference| never cancels, and (root + difference)(root - difference) = 4 share l1 l2.
    larger = root + jnp.abs(difference)
    smaller = 4 * share * l1 * l2 / larger
    plus, minus = (
        jnp.where(difference > 0, larger, smaller),
        jnp.where(difference > 0, smaller, larger),
    )
    long = 0.5 * (l1 + l2 + root)
    short = pendulum.m1 / (pendulum.m1 + pendulum.m2) * l1 * l2 / long

    def mode(length: Scalar, ratio: Scalar) -> NormalMode:
        frequency = jnp.sqrt(gravity / length)
        return NormalMode(frequency, ratio, 2 * jnp.pi / frequency)

    return mode(long, 2 * l1 / plus), mode(short, -2 * l1 / minus)


def fast_frequency(pendulum: Pendulum) -> Scalar:
    """The fast mode's angular frequency [rad/s] for |g|: where gravity pulls upwards, the fastest
    rate of escape.
    """
    return _modes(pendulum, jnp.abs(pendulum.g))[1].frequency


def equilibria(pendulum: Pendulum | Any) -> Equilibria:
    """The four equilibria with the exponents of the linear flow about them.

    About (s1, s2) = (cos theta1, cos theta2) = (+-1, +-1) a solution exp(lambda t) has lambda^2 =
    g/q with (q + s1 l1)(q + s2 l2) s1 s2 = kappa l1 l2 s1 s2, kappa = m2/(m1 + m2); both q are
    real.

    Raises:
        ValueError: leaves that are arrays: `jax.vmap` maps over many.
    """
    check_pendulum(pendulum)
    for name, leaf in vars(pendulum).items():
        single(name, leaf)
    angles = np.array([[0.0, 0.0], [0.0, np.pi], [np.pi, 0.0], [np.pi, np.pi]]).T
    signs = jnp.array([[1.0, 1.0, -1.0, -1.0], [1.0, -1.0, 1.0, -1.0]])
    l1, l2, m1, m2, g = (jnp.asarray(value, jnp.float64) for value in jax.tree.leaves(pendulum))
    share = m2 / (m1 + m2)
    mixed = signs[0] * signs[1]
    half = 0.5 * (signs[0] * l1 + signs[1] * l2)  # q^2 + 2 half q + mixed (1 - share) l1 l2 = 0
    root = jnp.sqrt(0.25 * (l1 - l2) ** 2 + jnp.where(mixed > 0, share, 1 - share) * l1 * l2)
    far = -(half + jnp.where(half < 0, -root, root))
    near = mixed * (1 - share) * l1 * l2 / far
    exponents = jnp.sqrt((g / jnp.stack([far, near], axis=-1)).astype(jnp.complex128))
    energy = -(m1 + m2) * g * l1 * signs[0] - m2 * g * l2 * signs[1]
    zero = jnp.zeros(4)
    return Equilibria(
        State(jnp.asarray(angles[0]), jnp.asarray(angles[1]), zero, zero), energy, exponents
    )


def fastest(pendulum: Pendulum, state: State) -> Scalar:
    """The rate that decides the step [rad/s]: of the linear motion, of the rods, and of the inertia
    they share.

    The last is 1/(1 + mu sin^2 delta), which a heavy lower bob makes narrow: it changes when the
    angle delta between the rods does by sqrt(sin^2 delta + 1/mu). Near no equilibrium do motions
    part faster than the linear share.
    """
    rates = vector_field(pendulum, state)
    mu = pendulum.m2 / pendulum.m1
    sin_delta, _ = sincos(state.theta1 - state.theta2)
    narrow = (1 + mu) / (1 + mu * sin_delta**2)
    spin = rates.theta1**2 + rates.theta2**2 + narrow * (rates.theta1 - rates.theta2) ** 2
    return jnp.sqrt(fast_frequency(pendulum) ** 2 + spin)
