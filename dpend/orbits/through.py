"""Periodic orbits from any state: with or without rests, with or without symmetry.

The motion from a state is looked at over a period for the place where the arc of its symmetry may
begin: at rest, in {0, pi}^2, at an extreme of theta1 or of the potential energy. From there it is
cut into segments, and Newton's method for the points of families (`newton`) does the rest: first
onto the family, then along it to the energy or the period that is kept.
"""

import math
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from dpend.checks import Scalar, integer, known_value, number, one_of, several, shown, single
from dpend.mechanics.linear import fast_frequency
from dpend.mechanics.pendulum import Pendulum, State, check_state, hamiltonian, vector_field
from dpend.mechanics.units import natural
from dpend.motion.integrate import advance_state, step_size
from dpend.orbits.arc import (
    LOG_DELTA,
    METHOD,
    MOST_SEGMENT_STEPS,
    PARTS,
    RELEASED_SYMMETRIES,
    SYMMETRIES,
    TURN,
    UNKNOWNS,
    stack_state,
    states_on_arc,
)
from dpend.orbits.follow import MANY_STEPS, FamilyProblem, guess_arc
from dpend.orbits.newton import METRIC, Solved
from dpend.orbits.orbit import Held, PeriodicOrbit, orbits_of
from dpend.orbits.passages import LEVELS, onto_level
from dpend.status import Status

# Samples of a period, in which the arc's beginning is looked for; every fourth is a known state of
# the arc. A multiple of sixteen, for a quarter of the period.
_SAMPLES, _THINNED = 1024, 4
# An orbit without a symmetry misses it by more than this share of what it reaches: the samples of
# one with it are within pi/1024 of every phase.
_NEAR = 0.1
# Two solves of one orbit: periods and energies, relative.
_SAME_ORBIT = 1e-8
# The largest multiple of the minimal period that is seen, and how near to itself an orbit is there,
# angles and momenta over the largest.
_COVERS, _RETURNED = 16, 1e-6
# Sines of the angles and momenta [natural units] of a root that is an equilibrium.
_STILL = 1e-6
# Newton's method is of points close to a family: from further away it is tried again where it gave
# up. About an orbit without symmetry (T = 5.9) starts 0.3 and 0.4 off need two tries.
_TRIES = 3
# A step along the family to the energy that is kept [arclength], at most.
_ROOM = 0.5
# Turns of one sense are counted below zero, as far as floats count.
_LEAST_TURNS = -(2**53)


class Request(NamedTuple):
    """What is asked of an orbit through a state.

    Attributes:
        state, period: of the motion it is near; may carry derivatives.
        symmetry: None if it is to be found out.
        turns: full ones of a period; None for those of the motion.
        keep: `energy` or `period`.
    """

    state: State
    period: Scalar
    symmetry: str | None
    turns: tuple[int, int] | None
    keep: str


def request_of(state: Any, period: Any, symmetry: Any, turns: Any, keep: Any) -> Request:
    """What is asked, once it is known to be sound.

    Raises:
        ValueError: no state or no period; an array or a traced value among them; a period not
            positive; another symmetry or `keep`; turns that are no two integers, or of an orbit
            whose turns its symmetry settles.
    """
    check_state(state)
    for name, value in {"period": period, **vars(state)}.items():
        value = number(name, value, positive=name == "period")
        single(name, value)
        if known_value(value) is None:
            raise ValueError(
                f"{name} must be known, got one traced by jit: find orbits outside jit"
            )
    if symmetry is not None:
        one_of("symmetry", symmetry, SYMMETRIES)
    if turns is not None:
        if symmetry not in ("passing", "none"):
            raise ValueError(
                f"turns go with symmetry passing or none, got symmetry {shown(symmetry)}: leave "
                f"them out"
            )
        pair = several("turns", turns, "a pair (turns of theta1, turns of theta2)", 2)
        turns = tuple(integer("turns", turn, least=_LEAST_TURNS) for turn in pair)
    return Request(state, period, symmetry, turns, one_of("keep", keep, ("energy", "period")))


class _Motion(NamedTuple):
    """A motion over a period in natural units.

    Attributes:
        states: `_SAMPLES` + 1 in equal steps of time, columns theta1, theta2, p1, p2.
        rates: of the angles.
        power: theta' . grad V, the slope of the potential energy.
    """

    period: float
    states: np.ndarray
    rates: np.ndarray
    power: np.ndarray


class _Root(NamedTuple):
    """Where Newton's method ended, how many minimal periods its guess was long, and whether it has
    what is kept.
    """

    problem: FamilyProblem
    rows: Solved
    covers: int
    arrived: bool

    @property
    def period(self) -> float:
        return float(self.problem.period(self.rows)[0])

    @property
    def status(self) -> Status:
        nodes = self.rows.point[0, :LOG_DELTA].reshape(-1, 4)
        if not np.all(np.isfinite(nodes)):
            return Status.NONFINITE
        if max(np.max(np.abs(np.sin(nodes[:, :2]))), np.max(np.abs(nodes[:, 2:]))) < _STILL:
            return Status.TRIVIAL_ROOT
        solved = self.rows.converged[0] and self.arrived
        return Status.CONVERGED if solved else Status.MAX_ITERATIONS


class _Search(NamedTuple):
    """What is sought: orbits of this energy or period (natural units)."""

    problem: FamilyProblem
    request: Request
    energy: float
    period: float


def orbit_through(pendulum: Pendulum, fixed: Pendulum, request: Request) -> PeriodicOrbit:
    """The periodic orbit that Newton's method finds from a state and a period; see `find_orbit`.

    Arguments:
        pendulum, fixed: as it was given, which may carry derivatives, and as numbers.
    """
    state, period = request.state, request.period
    scaled = jax.tree.map(np.float64, natural(fixed))
    second = math.sqrt(fixed.l1 / fixed.g)
    momentum = fixed.m1 * fixed.l1**2 / second
    known = [float(known_value(leaf) or 0.0) for leaf in (*jax.tree.leaves(state), period)]
    x, time = np.array(known[:4]) / [1.0, 1.0, momentum, momentum], known[4] / second
    problem = FamilyProblem(pendulum, scaled, request.symmetry or "none", (0.0, 0.0))
    search = _Search(problem, request, float(_hamiltonian(scaled, State(*x))), time)
    root = _minimal(search, _solve(search, _move(scaled, x, time)))
    if request.symmetry is None and root.status == Status.CONVERGED:
        root = _more_symmetric(search, root)
    held = None
    leaves = jax.tree.leaves((pendulum, state, period))
    if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        kept = hamiltonian(pendulum, state) if request.keep == "energy" else period / root.covers
        target = LEVELS[request.keep].natural(jnp.asarray(kept)[None], root.problem)
        held = Held(request.keep, target, np.zeros((1, UNKNOWNS)))
    orbit = jax.tree.map(lambda leaf: leaf[0], orbits_of(root.problem, root.rows, held))
    return replace(orbit, status=np.asarray(int(root.status)))


_hamiltonian, _field = jax.jit(hamiltonian), jax.jit(vector_field)


@jax.jit
def _sample(pendulum: Pendulum, state: Array, period: Scalar) -> Array:
    """The states at the samples of a period, integrated as arcs are that will be corrected."""
    span = period / _SAMPLES
    rate = 4 * fast_frequency(pendulum) * jnp.sqrt(1 + pendulum.m2)
    steps = jnp.clip(jnp.ceil(span * rate / TURN), 1, MOST_SEGMENT_STEPS).astype(int)

    def step(x: Array, _: None) -> tuple[Array, Array]:
        move = advance_state(METHOD, pendulum, State(*x), step_size(span, steps), steps)
        return stack_state(move), x

    end, states = lax.scan(step, state, None, length=_SAMPLES)
    return jnp.concatenate([states, end[None]])


def _move(pendulum: Pendulum, x: np.ndarray, period: float) -> _Motion:
    return _describe(pendulum, period, np.asarray(_sample(pendulum, x, np.float64(period))))


def _describe(pendulum: Pendulum, period: float, states: np.ndarray) -> _Motion:
    slopes = _field(pendulum, State(*states.T))
    rates = np.stack([slopes.theta1, slopes.theta2], axis=1)
    weights = np.array([1 + pendulum.m2, pendulum.m2 * pendulum.l2])
    power = np.sum(weights * np.sin(states[:, :2]) * rates, axis=1)
    return _Motion(period, states, rates, power)


def _place(motion: _Motion, symmetry: str) -> tuple[int, float]:
    """The sample at which an arc of this symmetry begins, and by what share of what it reaches the
    motion misses the symmetry there.
    """
    x, half = motion.states[:-1], _SAMPLES // 2
    if symmetry == "none":
        return _first_change(motion.power), 0.0
    if symmetry == "odd":
        gap = x[half] + x[0]
        gap[:2] -= 2 * np.pi * np.round(gap[:2] / (2 * np.pi))
        share = np.abs(gap) / np.maximum(np.max(np.abs(x), axis=0), np.finfo(float).tiny)
        return _first_change(motion.rates[: half + 1, 0]), float(np.max(share))
    if symmetry == "passing":
        miss, largest = np.sum(np.sin(x[:, :2]) ** 2, axis=1), 1.0
    else:  # twice the kinetic energy
        miss = np.sum(x[:, 2:] * motion.rates[:-1], axis=1)
        largest = max(float(np.max(miss)), np.finfo(float).tiny)
    both = np.maximum(miss[:half] + miss[half:], 0.0)
    at = int(np.argmin(both))
    return at, math.sqrt(both[at] / largest)


def _first_change(values: np.ndarray) -> int:
    """The sample nearest to the first change of sign; the first sample where there is none."""
    changes = np.flatnonzero(values[:-1] * values[1:] <= 0)
    if not changes.size:
        return 0
    first = int(changes[0])
    return (first + int(abs(values[first + 1]) < abs(values[first]))) % (len(values) - 1)


def _turns(
    symmetry: str, start: np.ndarray, end: np.ndarray, wanted: tuple[int, int] | None
) -> tuple[tuple[float, float], np.ndarray]:
    """The turns at the arc's end as `Arc` has them, and the full turns by which its angles are
    moved: a passing orbit starts in {0, pi}^2 itself.
    """
    if symmetry == "passing":
        centre = np.round(start / np.pi)
        shift = np.floor(centre / 2)
        own = np.round(end / np.pi) - centre
        turns = centre - 2 * shift + (own if wanted is None else np.array(wanted))
    else:
        shift, turns = np.zeros(2), np.zeros(2)
        if symmetry == "none":
            own = np.round((end - start) / (2 * np.pi))
            turns = own if wanted is None else np.array(wanted, np.float64)
        elif symmetry != "brake":
            turns = np.round((start + end) / (2 * np.pi) if symmetry == "odd" else end / np.pi)
    return (float(turns[0]), float(turns[1])), shift


def _solve(search: _Search, motion: _Motion) -> _Root:
    """The orbit near a motion with the symmetry of the search's problem."""
    problem, keep = search.problem, search.request.keep
    at, _ = _place(motion, problem.symmetry)
    index = np.arange(at, at + _SAMPLES // PARTS[problem.symmetry] + 1, _THINNED)
    around, where = np.divmod(index, _SAMPLES)
    x, angles = motion.states, np.array([1.0, 1.0, 0.0, 0.0])
    full = np.round((x[-1] - x[0]) / (2 * np.pi)) * angles
    states = x[where] + 2 * np.pi * around[:, None] * full
    turns, shift = _turns(problem.symmetry, states[0, :2], states[-1, :2], search.request.turns)
    states = states - 2 * np.pi * np.append(shift, [0.0, 0.0])
    problem = replace(problem, turns=turns)
    times = (index - at) * (motion.period / _SAMPLES)
    point = guess_arc(problem, times[:-1], states[:-1], times[-1])
    row = np.zeros(UNKNOWNS)
    if keep == "energy":  # its gradient
        slope = jax.tree.leaves(_field(problem.natural, State(*states[0])))
        row[:4] = -slope[2], -slope[3], slope[0], slope[1]
    else:
        row[LOG_DELTA] = 1.0
    rows = problem.correct(point[None], row[None], np.array([MANY_STEPS]))
    for _ in range(_TRIES - 1):
        if not rows.converged[0]:
            rows = problem.correct(rows.point, row[None], rows.steps)
    if not rows.converged[0]:
        return _Root(problem, rows, 1, False)
    rows = problem.correct(rows.point, METRIC * rows.tangent, rows.steps)
    target = (
        search.energy if keep == "energy" else math.log(search.period / PARTS[problem.symmetry])
    )
    rows, arrived = onto_level(problem, keep, np.array([target]), rows, np.array([_ROOM]))
    return _Root(problem, rows, 1, bool(arrived[0]))


def _known_states(root: _Root, times: np.ndarray) -> np.ndarray:
    """States of the orbit at so many times on its arc as there are samples."""
    nodes = root.rows.point[0, :LOG_DELTA].reshape(-1, 4)
    known = np.append(0.0, np.cumsum(root.rows.times[0])[:-1])
    return np.asarray(states_on_arc(root.problem.natural, known, nodes, times))


def _minimal(search: _Search, root: _Root) -> _Root:
    """The orbit with its minimal period."""
    if root.status != Status.CONVERGED:
        return root
    released = root.problem.symmetry in RELEASED_SYMMETRIES
    covers = np.arange(2, _COVERS + 1)
    times = np.zeros(_SAMPLES + 1)  # as many as are compiled for
    # A release is at rest after half the minimal period, and not before.
    times[: len(covers)] = root.period / (2 * covers if released else covers)
    nodes = root.rows.point[0, :LOG_DELTA].reshape(-1, 4)
    gap = _known_states(root, times)[: len(covers)] - (0.0 if released else nodes[0])
    gap[:, :2] -= (gap if released else 2 * np.pi * np.round(gap / (2 * np.pi)))[:, :2]
    share = np.abs(gap) / np.maximum(np.max(np.abs(nodes), axis=0), np.finfo(float).tiny)
    back = np.max(share, axis=1) < _RETURNED
    if not np.any(back):
        return root
    k = int(covers[back][-1])
    again = search._replace(period=search.period / k, request=search.request._replace(turns=None))
    motion = _move(root.problem.natural, nodes[0], root.period / k)
    return _solve(again, motion)._replace(covers=k)


def _more_symmetric(search: _Search, root: _Root) -> _Root:
    """The same orbit as one of the symmetry that it has; itself if it has none."""
    times = np.linspace(0.0, root.period, _SAMPLES + 1)
    motion = _describe(root.problem.natural, root.period, _known_states(root, times))
    for symmetry in ("centred", "brake", "passing", "odd"):
        if _place(motion, symmetry)[1] > _NEAR:
            continue
        as_such = search._replace(
            problem=replace(search.problem, symmetry=symmetry),
            request=search.request._replace(turns=None),
            period=root.period,
        )
        other = _solve(as_such, motion)._replace(covers=root.covers)
        same = abs(other.period / root.period - 1) < _SAME_ORBIT and abs(
            other.rows.energy[0] - root.rows.energy[0]
        ) < _SAME_ORBIT * abs(root.problem.levels[3])
        if other.status == Status.CONVERGED and same:
            return other
    return root
