"""How far a motion at given steps is from the true one: two passes compared, rounding and its
growth included.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from dpend.checks import Scalar
from dpend.mechanics.linear import fast_frequency
from dpend.mechanics.pendulum import Pendulum, State, energy_scale, hamiltonian, vector_field
from dpend.methods.scheme import Scheme
from dpend.motion.integrate import Turns, march, without_turns

EPS = float(np.finfo(float).eps)
# Tangents go along a motion of this method, the only one that carries them at little more than its
# own cost.
_GUIDE = "rk8-circle"
# Estimates of so many roundings of the start may be of rounding alone.
_SEEN = 64.0
# So many passes, started such roundings apart, tell rounding errors within a factor of two (99 in
# 100, rods whose lengths and masses differ by up to a thousand).
_PASSES = 4
_AWAY = (
    np.random.default_rng(1).choice([-1.0, 1.0], (_PASSES, 8)) * (np.arange(_PASSES) > 0)[:, None]
)
# Errors of regular motions grow in proportion to time: at most by this much in 1/(fast mode's
# frequency).
SHEAR = 10.0
# In one step a rod may turn, and the fast mode advance, by this much [rad]: beyond it neither
# method resolves the motion, whatever the energy says.
LARGEST_TURN = 1.0
# An error of this many radians is no small error: the computed motion has parted from the true one.
PARTED = 0.1
# Errors of so many roundings of the start may be those of rounding, larger ones are not. Those of
# rounding are of some 30, but in one of ten cases of more than 100 to 300 (order 8, releases from
# the whole square, 2 to 10 s).
NEAR_ROUNDING = 1e4
# The share of a tolerance that the search for a step aims at: an estimate may itself be off by a
# tenth.
MARGIN = 0.8


def fastest_rod(pendulum: Pendulum, state: State) -> Scalar:
    """The largest angular velocity in the motion [rad/s] at this state."""
    rates = vector_field(pendulum, state)
    return jnp.maximum(jnp.abs(rates.theta1), jnp.abs(rates.theta2))


class Comparison(NamedTuple):
    """What a second pass tells of a motion, at the worst step."""

    estimate: Scalar  # of the error of the larger angle [rad]
    floor: Scalar  # what one rounding of the start has grown to [rad]
    rate: Scalar  # the fastest [rad/s]
    drift: Scalar  # of the energy, in units of its scale
    end: State  # the motion's own last state, its turns taken off


def compare_motions(
    pendulum: Pendulum, state: State, dt: Scalar, steps: Scalar, scheme: Scheme
) -> Comparison:
    """What second passes tell of a motion: one pass, or `_PASSES` of them where rounding may be
    what they see.

    Two sums of rounding errors may end close to each other by chance, far from the truth both; as
    many will not.
    """

    def goes(work: tuple[Scalar, Comparison]) -> Scalar:
        count, seen = work
        return (count < 1) | ((count < _PASSES) & (seen.estimate < _SEEN * seen.floor))

    def again(work: tuple[Scalar, Comparison]) -> tuple[Scalar, Comparison]:
        count, before = work
        seen = _one_comparison(pendulum, state, dt, steps, scheme, jnp.asarray(_AWAY)[count])
        return count + 1, seen._replace(estimate=jnp.maximum(before.estimate, seen.estimate))

    seen: Comparison = lax.while_loop(goes, again, (0, comparison_of(0.0)))[1]
    return seen


def comparison_of(value: float) -> Comparison:
    """One number everywhere: zero before a comparison, NaN without."""
    numbers = (jnp.asarray(value),) * 4
    return Comparison(*numbers, State(*numbers))


def _one_comparison(
    pendulum: Pendulum, state: State, dt: Scalar, steps: Scalar, scheme: Scheme, away: Scalar
) -> Comparison:
    """A motion beside one of half the step whose sums are compensated, and what its start's
    rounding grows to.

    The two passes differ by the truncation error (Richardson's estimate) and by the rounding errors
    of the first, those of the second being less. Rounding that both share, as that of the start, is
    seen by neither: hence the floor, from two tangents along the first.

    Arguments:
        away: where the second pass starts, in roundings of each number of the point.
    """
    whole, half = scheme.constants(pendulum, dt), scheme.constants(pendulum, dt / 2)
    guide = Scheme(_GUIDE, 1.0)
    known = guide.constants(pendulum, dt)
    state, turns = without_turns(state)
    start, energy = scheme.enter(pendulum, state), hamiltonian(pendulum, state)

    def step(carry: Any, time: Scalar, dt: Scalar) -> Any:
        coarse, along, fine, rest, (worst, growth, rate, drift) = carry
        if scheme.name == _GUIDE:
            coarse, tangents = scheme.move_tangents(whole, coarse, along)
            along = tangents
        else:
            coarse, along = scheme.move(whole, coarse), guide.move_tangents(known, *along)
            tangents = along[1]
        fine, rest = lax.fori_loop(
            0, 2, lambda i, pair: scheme.move_compensated(half, *pair), (fine, rest)
        )
        here = scheme.leave(whole, coarse)
        difference = angle_error(here, scheme.leave(half, fine))
        seen = (
            difference,
            growth_along(tangents),
            fastest_rod(pendulum, here),
            jnp.abs(hamiltonian(pendulum, here) - energy),
        )
        return coarse, along, fine, rest, tuple(map(jnp.fmax, (worst, growth, rate, drift), seen))

    leaves, tree = jax.tree.flatten(start)
    rest = jax.tree.unflatten(tree, [EPS * away[i] * leaf for i, leaf in enumerate(leaves)])
    along: Any = count_roundings(state)
    along = along if scheme.name == _GUIDE else (guide.enter(pendulum, state), along)
    carry = start, along, start, rest, (jnp.zeros_like(energy),) * 4
    coarse, _, _, _, (worst, growth, rate, drift) = march(step, carry, dt, steps)
    end = scheme.leave(whole, coarse)
    # A tangent grows for ever, an error to half a turn.
    floor = jnp.fmin(EPS * growth, jnp.pi)
    lost = ~jnp.isfinite(end.theta1 + end.theta2 + end.p1 + end.p2)
    estimate = jnp.hypot(worst / (1 - 2.0**-scheme.order), floor) + _last_place(turns)
    drift = drift / energy_scale(pendulum, state)
    return Comparison(jnp.where(lost, jnp.inf, estimate), floor, rate, drift, end)


def energy_drift(pendulum: Pendulum, states: State) -> Scalar:
    """The largest |H - H(0)| along saved states, in units of the energy scale."""
    energy = hamiltonian(pendulum, states)
    start = jax.tree.map(lambda leaf: leaf[0], states)
    return jnp.max(jnp.abs(energy - energy[0])) / energy_scale(pendulum, start)


def count_roundings(state: State) -> State:
    """Two tangents, each an angle's size and its momentum's: times `EPS` the roundings of a
    start.
    """
    first, second = jnp.eye(2)
    sizes = jnp.maximum(1.0, jnp.abs(state.theta1)), jnp.maximum(1.0, jnp.abs(state.theta2))
    return State(sizes[0] * first, sizes[1] * second, state.p1 * first, state.p2 * second)


compare = jax.jit(compare_motions, static_argnames="scheme")


def _last_place(turns: Turns) -> Scalar:
    """What an angle far from zero is rounded by when its turns are added [rad]."""
    return 0.5 * EPS * jnp.maximum(jnp.abs(turns.theta1[0]), jnp.abs(turns.theta2[0]))


def angle_error(a: State, b: State) -> Scalar:
    """The larger difference of the two angles [rad], at the worst of the saved times."""
    return jnp.max(jnp.maximum(jnp.abs(a.theta1 - b.theta1), jnp.abs(a.theta2 - b.theta2)))


@jax.jit
def fastest_of_all(pendulum: Pendulum, state: State) -> Scalar:
    """What a step has to resolve at the start [rad/s]."""
    return jnp.maximum(fast_frequency(pendulum), fastest_rod(pendulum, state))


def any_step(scheme: Scheme) -> Scheme:
    """The key of programs in which the step is traced: one for all steps."""
    return replace(scheme, step=1.0)


def growth_along(tangents: State | None) -> Scalar:
    """What two tangents along the last axis grow to: of the larger angle, at the worst time; one
    with none.
    """
    if tangents is None:
        return jnp.asarray(1.0)
    sizes = jnp.maximum(
        jnp.linalg.norm(tangents.theta1, axis=-1), jnp.linalg.norm(tangents.theta2, axis=-1)
    )
    return jnp.max(sizes)
