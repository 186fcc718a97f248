"""Multiple shooting: a symmetric orbit in segments, and the step from one orbit of a family to the
next.

A quarter (centred), a half (brake, odd, passing) or the whole of the period (none) is cut into
segments that are integrated side by side, each from its own initial state, the node; Newton's
method makes their ends meet. No segment is long enough for the motion to forget where it began, so
that orbits can be followed to where kappa is 1e40 and shooting in one piece would see noise.

The duration of a segment is Delta/rate(node): every segment is given the same share Delta of the
fastest motion, and that makes the mesh follow the orbit smoothly, without ever being laid anew.
Delta is the last unknown: it takes the place of the period, and grows only like its logarithm does
where a motion lingers at an equilibrium.

Everything here is in natural units, l1 = m1 = g = 1: a pendulum is then (l2/l1, m2/m1), and the
scaling laws hold to the last digit.
"""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from dpend.checks import Scalar, is_traced
from dpend.mechanics.linear import fast_frequency, fastest
from dpend.mechanics.pendulum import Pendulum, State, vector_field
from dpend.methods.scheme import Scheme
from dpend.motion.integrate import advance_state, step_size
from dpend.orbits.stability import transition

# Two AVX-512 registers of lanes; the linear algebra grows with the third power of this number.
SEGMENTS = 16
UNKNOWNS = 4 * SEGMENTS + 2
# The conditions at the ends of the arc, by symmetry; the index is what compiled code is told.
SYMMETRIES = ("centred", "brake", "odd", "passing", "none")
RELEASED_SYMMETRIES = ("centred", "brake")
# What part of the period the arc is.
PARTS = {"centred": 4, "brake": 2, "odd": 2, "passing": 2, "none": 1}

# Only its method is used: the number of steps is settled arc by arc. With its stages as a loop it
# takes twice the time, and a tenth of it to compile.
METHOD = Scheme("rk8-circle", 1.0, written_out=False)
# The fastest motion may advance by this in one step [rad]: leaves little but rounding in the angles
# and the period.
TURN = 0.14
MOST_SEGMENT_STEPS = 5_000

# Where the unknowns are: the nodes one after the other, log Delta, and the unfolding parameter of
# odd orbits and of those without symmetry, which is zero on every orbit.
LOG_DELTA, UNFOLDING = 4 * SEGMENTS, 4 * SEGMENTS + 1


class Arc(NamedTuple):
    """What is asked of an arc: the index of its symmetry, and the turns of its end (theta/pi if
    centred or passing; in units of 2 pi theta(0) + theta(T/2) if odd, theta(T) - theta(0) if none).
    """

    symmetry: Any
    turns: Any


def arc_of(symmetry: str, turns: Any = (0.0, 0.0)) -> Arc:
    """An arc of this symmetry, as compiled code is told of it."""
    return Arc(np.asarray(SYMMETRIES.index(symmetry)), jnp.asarray(turns))


class _Segments(NamedTuple):
    """All segments side by side."""

    end: Float[Array, "S 4"]
    matrix: Float[Array, "S 4 4"]  # derivative of the flow over the segment's time
    slope: Float[Array, "S 4"]  # at its end
    time: Float[Array, " S"]
    stretch: Float[Array, "S 4"]  # derivative of its time with respect to the node
    turn: Float[
        Array, " S"
    ]  # the larger of the advances that the rates at both ends make of it [rad]


def stack_state(state: State) -> Array:
    return jnp.stack(jax.tree.leaves(state))


def _field(pendulum: Pendulum, state: State) -> Array:
    return stack_state(vector_field(pendulum, state))


def _segments(pendulum: Pendulum, nodes: Array, delta: Scalar, steps: Scalar) -> _Segments:
    # States have leaves of shape (S,): the last axis, which is contiguous, is the one that is
    # vectorised.
    states = State(*nodes.T)
    rate, pull = jax.vjp(lambda states: fastest(pendulum, states), states)
    (gradient,) = pull(jnp.ones(SEGMENTS))
    time = delta / rate
    end, matrix = transition(pendulum, states, step_size(time, steps), steps, METHOD)
    return _Segments(
        end=stack_state(end).T,
        matrix=jnp.moveaxis(matrix, -1, 0),
        slope=_field(pendulum, end).T,
        time=time,
        stretch=(-time / rate * stack_state(gradient)).T,
        turn=jnp.maximum(delta, fastest(pendulum, end) * time),
    )


def arc_times(pendulum: Pendulum, point: Array) -> tuple[Array, Array]:
    """The durations of a point's segments and the rates at its nodes."""
    rates = fastest(pendulum, State(*point[:LOG_DELTA].reshape(SEGMENTS, 4).T))
    return jnp.exp(point[LOG_DELTA]) / rates, rates


class Equations(NamedTuple):
    value: Float[Array, " E"]
    jacobian: Float[Array, "E D"]
    segments: _Segments


def no_equations() -> Equations:
    """Zeros in the shapes of `shooting_equations`, for a loop to begin with: tracing the equations
    for their shapes alone takes as long as tracing them.
    """
    rows, matrix, share = (SEGMENTS, 4), (SEGMENTS, 4, 4), (SEGMENTS,)
    segments = _Segments(*map(jnp.zeros, (rows, matrix, rows, share, rows, share)))
    return Equations(jnp.zeros(UNKNOWNS - 1), jnp.zeros((UNKNOWNS - 1, UNKNOWNS)), segments)


def shooting_equations(pendulum: Pendulum, point: Array, steps: Scalar, arc: Arc) -> Equations:
    """4 S + 1 equations: each segment ends where the next begins, and five conditions on the first
    node and the end.
    """
    nodes = point[:LOG_DELTA].reshape(SEGMENTS, 4)
    s = _segments(pendulum, nodes, jnp.exp(point[LOG_DELTA]), steps)
    by_node = s.matrix + s.slope[:, :, None] * s.stretch[:, None, :]
    by_delta = s.slope * s.time[:, None]
    ends, by_ends = end_conditions(pendulum, nodes[0], s.end[-1], point[UNFOLDING], arc)
    value = jnp.concatenate([(s.end[:-1] - nodes[1:]).ravel(), ends])
    # Written without indexed updates, which XLA makes loops of.
    inner = (by_node[:, :, None, :] * _DIAGONAL - _NEXT).reshape(4 * SEGMENTS, 4 * SEGMENTS)
    gap = jnp.zeros((5, 4 * SEGMENTS - 8))
    last = jnp.concatenate([by_ends[:, :4], gap, by_ends[:, 4:8] @ by_node[-1]], axis=1)
    delta = jnp.append(by_delta[:-1].ravel(), by_ends[:, 4:8] @ by_delta[-1])
    unfolding = jnp.append(jnp.zeros(4 * SEGMENTS - 4), by_ends[:, 8])
    columns = jnp.concatenate([inner[:-4], last]), delta[:, None], unfolding[:, None]
    return Equations(value, jnp.concatenate(columns, axis=1), s)


# Where blocks (i, i) and (i, i + 1) of the Jacobian are.
_DIAGONAL = np.eye(SEGMENTS)[:, None, :, None]
_NEXT = np.einsum("ij,ab->iajb", np.eye(SEGMENTS, k=1), np.eye(4))


def end_conditions(
    pendulum: Pendulum, start: Array, end: Array, unfolding: Scalar, arc: Arc
) -> tuple[Array, Array]:
    """Five conditions on (start, end, unfolding), and their derivative, shape (5, 9).

    - centred: p(0) = 0, theta(T/4) = pi turns;
    - brake: p(0) = 0, p(T/2) = 0;
    - odd: x(T/2) = -x(0) up to full turns, where the upper rod is at its extreme, theta1' = 0.
      Energy is conserved, so that these are one too many for the period and the state; the
      unfolding parameter times grad H, added to them, is zero at every solution (Munoz-Almaraz et
      al., Physica D 181 (2003));
    - passing: theta(0) = 0 modulo pi, theta(T/2) = pi turns;
    - none: x(T) = x(0) but for full turns, unfolded as odd orbits are, where the potential energy V
      is at an extreme, theta' . grad V = 0: every periodic orbit has such a place.
    """
    full_turns = jnp.append(2 * jnp.pi * arc.turns, jnp.zeros(2))
    at_centre = end[:2] - jnp.pi * arc.turns

    def linear(name: str, *conditions: Array) -> tuple[Array, Array]:
        return jnp.concatenate([*conditions, unfolding[None]]), jnp.asarray(_LINEAR[name])

    @cache  # once for the two of them
    def gradients() -> tuple[Array, Array]:
        around = partial(_gradients, pendulum)
        return around(start), jax.jacfwd(around)(start)

    def unfolded(sign: float, difference: Array, phase: int) -> tuple[Array, Array]:
        """end + sign start + unfolding grad H, and a phase condition: one of `_gradients`."""
        values, changes = gradients()
        gradient, curvature = values[:4], changes[:4]
        rows = jnp.column_stack([
            sign * jnp.eye(4) + unfolding * curvature, jnp.eye(4), gradient
        ])  # fmt: skip
        last = jnp.append(changes[phase], jnp.zeros(5))[None]
        closing = difference - full_turns + unfolding * gradient
        return jnp.append(closing, values[phase]), jnp.concatenate([rows, last])

    return by_symmetry(
        arc,
        centred=lambda: linear("centred", start[2:], at_centre),
        brake=lambda: linear("brake", start[2:], end[2:]),
        odd=lambda: unfolded(1.0, end + start, _SWING),
        passing=lambda: linear("passing", _from_centre(start), at_centre),
        none=lambda: unfolded(-1.0, end - start, _POWER),
    )


def by_symmetry(
    arc: Arc, otherwise: Callable[[], Any] | None = None, **cases: Callable[[], Any]
) -> Any:
    """What belongs to an arc's symmetry: that case alone where the symmetry is known before
    tracing; elsewhere all of them are computed, and one is chosen.
    """
    if not is_traced(arc.symmetry):
        return cases.get(SYMMETRIES[int(arc.symmetry)], otherwise)()  # type: ignore[misc]
    values = [cases.get(name, otherwise)() for name in SYMMETRIES]  # type: ignore[misc]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves)[arc.symmetry], *values)


# Where the phase conditions are among `_gradients`: theta1', and theta' . grad V.
_SWING, _POWER = 2, 4


def _gradients(pendulum: Pendulum, state: Array) -> Array:
    """grad H, which is (-p', theta'), and the power -theta' . grad V."""
    slope = _field(pendulum, State(*state))
    pull = _field(pendulum, State(*state[:2], *jnp.zeros(2)))[2:]  # -grad V
    return jnp.concatenate([-slope[2:], slope[:2], -(slope[:2] @ pull)[None]])


def _from_centre(start: Array) -> Array:
    """theta from the nearest place of {0, pi}^2 up to full turns: a passing orbit's start stays
    there all along its family, so that the nearest is known.
    """
    return start[:2] - jnp.pi * jnp.round(start[:2] / jnp.pi)


def _rows(*columns: int) -> np.ndarray:
    return np.eye(9)[list(columns)]


# The derivatives of the conditions that are linear: of p(0) or theta(0), of theta or p at the end,
# of the unfolding.
_LINEAR = {
    "centred": _rows(2, 3, 4, 5, 8),
    "brake": _rows(2, 3, 6, 7, 8),
    "passing": _rows(0, 1, 4, 5, 8),
}

# L and U in one matrix, and the order of the rows: what `lax.linalg.lu` has found already, and
# `lu_solve` finds anew.
Factors = tuple[Array, Array]


def solve(factors: Factors, right: Array) -> Array:
    lu, order = factors
    half = lax.linalg.triangular_solve(
        lu, right[order], left_side=True, lower=True, unit_diagonal=True
    )
    return lax.linalg.triangular_solve(lu, half, left_side=True)


def solve_transposed(factors: Factors, right: Array) -> Array:
    lu, order = factors
    half = lax.linalg.triangular_solve(lu, right, left_side=True, transpose_a=True)
    whole = lax.linalg.triangular_solve(
        lu, half, left_side=True, lower=True, unit_diagonal=True, transpose_a=True
    )
    return jnp.zeros_like(right).at[order].set(whole)


def _state_at(pendulum: Pendulum, times: Array, states: Array, time: Scalar) -> Array:
    """The state of a motion at a time from the last one before it that is known."""
    # As many steps as rates of four times the linear motion's need: an arc will be corrected.
    rate = 4 * fast_frequency(pendulum) * jnp.sqrt(1 + pendulum.m2)
    nearest = jnp.searchsorted(times, time, side="right") - 1
    rest = time - times[nearest]
    steps = jnp.clip(jnp.ceil(rest * rate / TURN), 1, 100 * MOST_SEGMENT_STEPS).astype(int)
    return stack_state(
        advance_state(METHOD, pendulum, State(*states[nearest]), step_size(rest, steps), steps)
    )


def state_halfway(pendulum: Pendulum, point: Array) -> Array:
    """The state at half of the arc's time, from a point's nodes."""
    times, _ = arc_times(pendulum, point)
    starts = jnp.append(0.0, jnp.cumsum(times)[:-1])
    return _state_at(pendulum, starts, point[:LOG_DELTA].reshape(SEGMENTS, 4), 0.5 * jnp.sum(times))


@jax.jit
def states_on_arc(pendulum: Pendulum, times: Array, states: Array, wanted: Array) -> Array:
    """The states at wanted times, rows of four, of a motion of which some are known."""
    return jax.vmap(partial(_state_at, pendulum, times, states))(wanted)


@jax.jit
def lay_arc(pendulum: Pendulum, times: Array, states: Array, duration: Scalar) -> Array:
    """Nodes and log Delta of an arc of `duration` on an orbit of which some states are known.

    Arguments:
        times, states: known ones in order of time, beginning with (0, x(0)).
    """

    def state_at(time: Scalar) -> Array:
        return _state_at(pendulum, times, states, jnp.clip(time, 0.0, duration))

    def nodes(delta: Scalar) -> tuple[Scalar, Array]:
        def step(time: Scalar, _: None) -> tuple[Scalar, Array]:
            x = state_at(time)
            return time + delta / fastest(pendulum, State(*x)), x

        return lax.scan(step, jnp.zeros(()), None, length=SEGMENTS)

    def halved(_: Scalar, bounds: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
        low, high = bounds
        middle = 0.5 * (low + high)
        short = nodes(jnp.exp(middle))[0] < duration
        return jnp.where(short, middle, low), jnp.where(short, high, middle)

    # The segments fill the arc the later, the larger Delta is.
    least = jnp.log(fast_frequency(pendulum) * duration / SEGMENTS)
    bounds = lax.fori_loop(0, _HALVINGS, halved, (least - 1.0, least + 5.0))
    middle = 0.5 * (bounds[0] + bounds[1])
    return jnp.concatenate([nodes(jnp.exp(middle))[1].ravel(), jnp.stack([middle, 0.0])])


# Newton's method does the rest.
_HALVINGS = 45
