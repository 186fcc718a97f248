"""How far a computed motion is from the true one: two passes compared, rounding and its growth
included; and the step that reaches a tolerance (`find_scheme`).
"""

import math
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
from dpend.motion.integrate import Turns, march, step_size, without_turns

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
# The first step that is tried when one is sought [rad of the fastest motion at the start].
_FIRST_TURN = 0.5
# The next trial takes at least, and at most, so many times as many steps.
_LEAST_MORE, _MOST_MORE = 1.2, 4.0
# Below (rate dt)^p of this the truncation of a step is lost in rounding: a smaller step only adds
# to that.
_ONLY_ROUNDING = 1e-18
# A motion that keeps its energy this well, in units of its scale, has steps that resolve it.
_RESOLVED = 1e-10
# What a rounding grows to is believed where two steps tell it within this factor: too long a step
# makes growth of its own.
_ALIKE = 10.0


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


class _Trial(NamedTuple):
    """What a trial of a step tells: the estimate of the error and the floor that rounding sets
    [rad], the turn in a step [rad], and the drift of the energy.
    """

    error: float
    floor: float
    turn: float
    drift: float

    def settles(self, before: tuple[float, float], tolerance: float) -> bool:
        """Whether no shorter step is worth a trial: the tolerance is reached, or rounding sets the
        error.

        Arguments:
            before: the floor of the trial before, and the error that this one should have come
                below.
        """
        near = self.error < PARTED  # to the true motion all along, or else at least to its energy
        alike = before[0] / _ALIKE < self.floor < _ALIKE * before[0]
        lost = alike and self.floor > tolerance and (near or self.drift < _RESOLVED)
        steady = alike and near and self.error < NEAR_ROUNDING * self.floor
        steady = steady and self.error > before[1]
        return self.turn <= LARGEST_TURN and (self.error <= MARGIN * tolerance or lost or steady)


def find_scheme(
    pendulum: Pendulum,
    state: State,
    duration: float,
    method: str,
    tolerance: float,
    most_steps: int,
) -> tuple[Scheme, Comparison]:
    """The method with a step at which the error of this motion is below `tolerance`, or as small as
    rounding or `most_steps` allow, and what a second pass told of it.
    """
    rate = float(np.nan_to_num(fastest_of_all(pendulum, state), posinf=0.0))  # a status tells of it
    steps = max(1, math.ceil(abs(duration) * rate / _FIRST_TURN))
    if steps > most_steps:
        raise ValueError(
            f"duration must be at most some {_FIRST_TURN * most_steps / rate:.1e} s for a "
            f"tolerance, got {duration:g}, "
            f"which takes {steps:.3g} steps or more: give a shorter one, a step, or more most_steps"
        )
    order, best, before = Scheme(method, 1.0).order, None, (math.inf, math.inf)
    while True:
        scheme = Scheme(method, abs(duration) / steps)
        dt, count = step_size(duration, steps), jnp.asarray(steps)
        compared = compare(pendulum, state, dt, count, any_step(scheme))
        error, floor, fastest, drift = (float(value) for value in compared[:4])
        trial = _Trial(error, floor, float(scheme.step * np.fmax(rate, fastest)), drift)
        if trial.turn <= LARGEST_TURN and not (best and best[0] < error):
            best = error, scheme, compared
        missing = (2 * error / tolerance) ** (1 / order) if math.isfinite(error) else _MOST_MORE
        more = min(max(missing, trial.turn, _LEAST_MORE), _MOST_MORE)
        steps = math.ceil(steps * more)
        settled = trial.settles(before, tolerance)
        if settled or trial.turn < _ONLY_ROUNDING ** (1 / order) or steps > most_steps:
            return (best or (error, scheme, compared))[1:]
        before = floor, error * more ** (-order / 2)
