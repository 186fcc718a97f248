"""The nearest pendulum that solves a loss, and the least loss, within bounds."""

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dpend.checks import Scalar
from dpend.mechanics.pendulum import Pendulum, hamiltonian, released
from dpend.orbits.find import find_orbit
from dpend.orbits.orbit import PeriodicOrbit, slopes
from dpend.status import Status

Loss = Callable[..., Any]

# What may be free; the index is the place in every vector of unknowns.
PARAMETERS = ("l1", "l2", "m1", "m2", "g", "theta1")
_THETA1 = PARAMETERS.index("theta1")

# The longest step [of a logarithm], and the one below which steps are Newton's own and need no
# search.
_LONGEST, _LOCAL = 0.5, 1e-5
# Steps this short end the iteration: an error of the equations is its square.
_SMALL, _SMALL_STEP_DOWN = 1e-9, 1e-8
# An iteration that stalls at steps as short as this was stopped by rounding.
_STALLED = 1e-6
_LEAST_DAMPING = 2.0**-12
# Equations that are down to this share of where they began have a solution there.
_SOLVED = 1e-8
# Places at which one equation for one unknown is looked at on either side of the start for a change
# of sign.
_PIECES = 16


class Look(NamedTuple):
    """What is known at one point; if an orbit is not to be had, its status and no more that
    counts.
    """

    x: np.ndarray  # (6,)
    value: np.ndarray  # (k,)
    jacobian: np.ndarray  # (k, 6), with respect to x
    orbits: tuple[PeriodicOrbit, ...]
    slopes: tuple[Any, ...]
    status: int

    @property
    def sound(self) -> bool:
        return self.status == Status.CONVERGED


@dataclass
class Problem:
    """What is asked; counts the looks."""

    loss: Loss
    start: Pendulum
    branches: tuple[str, ...]
    angles: tuple[float, ...]
    low: np.ndarray  # bounds of x, both zero where it is not free
    high: np.ndarray
    equation: int | None = None  # the only one that is asked, if not all
    looks: int = 0

    @property
    def free(self) -> np.ndarray:
        return np.flatnonzero(self.low < self.high)

    def at(self, x: np.ndarray) -> Look:
        """The orbits at x, the loss there and its derivatives."""
        self.looks += 1
        values = np.array(jax.tree.leaves(self.start)) * np.exp(x[:_THETA1])
        pendulum, growth = Pendulum(*map(float, values)), math.exp(x[_THETA1])
        orbits = tuple(
            find_orbit(pendulum, angle * growth, branch=branch)
            for branch, angle in zip(self.branches, self.angles, strict=True)
        )
        lost = [int(orbit.status) for orbit in orbits if int(orbit.status) != Status.CONVERGED]
        rates = tuple(slopes(orbit) for orbit in orbits)
        value, jacobian = (np.asarray(part) for part in _judged(self.loss, orbits, rates))
        if self.equation is not None:
            value, jacobian = value[[self.equation]], jacobian[[self.equation]]
        finite = np.all(np.isfinite(value)) and np.all(np.isfinite(jacobian))
        status = lost[0] if lost else int(Status.CONVERGED if finite else Status.NONFINITE)
        return Look(x, value, jacobian, orbits, rates, status)


@partial(jax.jit, static_argnames="loss")
def _judged(
    loss: Loss, orbits: tuple[PeriodicOrbit, ...], rates: tuple[Any, ...]
) -> tuple[Scalar, Scalar]:
    """The loss as a vector, and its derivatives with respect to the logarithms of `PARAMETERS`."""

    def at(logs: Scalar) -> Scalar:
        moved = (_moved(orbit, rate, logs) for orbit, rate in zip(orbits, rates, strict=True))
        return jnp.ravel(jnp.asarray(loss(*moved), jnp.float64))

    here = jnp.zeros(len(PARAMETERS))
    return at(here), jax.jacfwd(at)(here)


def _moved(orbit: PeriodicOrbit, rate: Scalar, logs: Scalar) -> PeriodicOrbit:
    """A centred orbit after a small change of ln parameters, to the first order, which is all that
    is asked of it.
    """
    parameters = jnp.stack([*jax.tree.leaves(orbit.pendulum), orbit.theta1])
    theta2, log_time, kappa, log_abs_kappa = rate @ (parameters * logs)
    theta1, *fields = (parameters * jnp.exp(logs))[jnp.array([_THETA1, 0, 1, 2, 3, 4])]
    pendulum, state = Pendulum(*fields), released(theta1, orbit.theta2 + theta2)
    turns = 2 * jnp.pi * jnp.asarray(orbit.turns, jnp.float64)
    return replace(
        orbit,
        pendulum=pendulum,
        state=state,
        period=orbit.period * jnp.exp(log_time),
        energy=hamiltonian(pendulum, state),
        kappa=orbit.kappa + kappa,
        log_abs_kappa=orbit.log_abs_kappa + log_abs_kappa,
        dual=released(turns[0] - state.theta1, turns[1] - state.theta2),
    )


class _Step(NamedTuple):
    """A step of the free unknowns, and the multipliers of the equations."""

    step: np.ndarray
    multipliers: np.ndarray


def _quadratic(
    hessian: np.ndarray,
    slope: np.ndarray,
    value: np.ndarray,
    jacobian: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    slack: float = 0.0,
) -> _Step | None:
    """The step d that minimises slope.d + d.hessian.d/2 with value + jacobian d = 0 and low <= d <=
    high; None if the bounds leave no such step. With `slack` the equations cost their squares over
    twice of it instead.

    The bounds that hold are tried, none first: the first choice that satisfies the conditions of
    Karush, Kuhn and Tucker is the solution, there being one. Of six unknowns 729 small solves at
    worst.
    """
    n, k = len(slope), len(value)
    for sides in sorted(itertools.product((0, -1, 1), repeat=n), key=np.count_nonzero):
        side = np.array(sides)
        move = side == 0
        if np.sum(move) < (1 if slack else k) and not (slack and not np.any(move)):
            continue
        held = np.where(move, 0.0, np.where(side < 0, low, high))
        some = np.sum(move)
        matrix = np.zeros((some + k, some + k))
        matrix[:some, :some] = hessian[np.ix_(move, move)]
        matrix[:some, some:], matrix[some:, :some] = jacobian[:, move].T, jacobian[:, move]
        matrix[some:, some:] = -slack * np.eye(k)
        right = -np.append((slope + hessian @ held)[move], value + jacobian @ held)
        try:
            solution = np.linalg.solve(matrix, right)
        except np.linalg.LinAlgError:
            continue
        step, multipliers = held.copy(), solution[some:]
        step[move] = solution[:some]
        pull = slope + hessian @ step + jacobian.T @ multipliers
        tolerance = 1e-12 * (1 + np.max(np.abs(pull)))
        inside = np.all(step >= low - 1e-14) and np.all(step <= high + 1e-14)
        if inside and np.all(side * pull <= tolerance) and np.all(np.isfinite(solution)):
            return _Step(np.clip(step, low, high), multipliers)
    return None


def _nearest(problem: Problem, look: Look, most: int) -> tuple[Look, int, int]:
    """The nearest solution of loss = 0, the steps taken, and a status."""
    free = problem.free
    hessian, weight, before = np.eye(free.size), 0.0, math.inf
    for count in range(most):
        x, jacobian = look.x[free], look.jacobian[:, free]
        room = problem.low[free] - x, problem.high[free] - x
        newton = _quadratic(hessian, x, look.value, jacobian, *room)
        if newton is None:
            return look, count, int(Status.NO_SOLUTION)
        step, multipliers = newton
        size = float(np.max(np.abs(step)))
        if size <= _SMALL or (before <= _STALLED and size >= before):
            last = problem.at(_with(look.x, free, x + step))
            better = last.sound and np.sum(np.abs(last.value)) <= np.sum(np.abs(look.value))
            return last if better else look, count + 1, int(Status.CONVERGED)
        largest = 1.5 * float(np.max(np.abs(multipliers)))
        weight = max(largest, 0.5 * (weight + largest))
        after = _searched(problem, look, step, weight)
        if not after.sound:
            return look, count, after.status
        hessian = _updated(hessian, look, after, free, multipliers)
        look, before = after, size
    return look, most, int(Status.MAX_ITERATIONS)


def nearest_of_one(problem: Problem, look: Look, most: int) -> tuple[Look, int, int]:
    """One equation for one unknown: where Newton's method leads, unless the loss changes sign
    nearer to the start.

    Looked at are places on both sides at even distances, up to the solution, or up to the bounds if
    there is none.
    """
    (i,) = problem.free
    found, steps, status = _nearest(problem, look, most)
    reach = max(-problem.low[i], problem.high[i])
    if status == Status.CONVERGED:
        reach = min(reach, abs(float(found.x[i])) * (1 - 1e-6))
    last, best = {1: look, -1: look}, found
    for share in np.arange(1, _PIECES + 1) / _PIECES:
        changes = []
        for side in tuple(last):
            place = side * share * reach
            trial = problem.at(
                _with(look.x, problem.free, np.clip([place], problem.low[i], problem.high[i]))
            )
            if not trial.sound:
                del last[side]
                continue
            if trial.value[0] * last[side].value[0] < 0:
                changes.append(_bracketed(problem, last[side], trial, most))
            best = min(best, trial, key=lambda one: abs(float(one.value[0])))
            last[side] = trial
            if not problem.low[i] < place < problem.high[i]:
                del last[side]
        if changes:
            nearest, more, how = min(changes, key=lambda change: abs(float(change[0].x[i])))
            return nearest, steps + more, how
    if status == Status.CONVERGED:
        return found, steps, status
    closest, more, how = least_on_bounds(problem, best, most, _square)
    return closest, steps + more, _without_solution(how)


def _without_solution(how: int) -> int:
    """The status of equations of which the least sum of squares has been sought, which ended with
    `how`.
    """
    return int(Status.NO_SOLUTION) if how == Status.CONVERGED else how


def nearest_of_many(problem: Problem, look: Look, most: int) -> tuple[Look, int, int]:
    """The nearest solution near the start; where Newton's method finds none, the nearest of those
    that it finds from the least sum of squares, and from where one parameter alone makes one of the
    equations true.
    """
    found, steps, status = _nearest(problem, look, most)
    if status == Status.CONVERGED:
        return found, steps, status
    closest, more, how = least_on_bounds(problem, found, most, _square)
    steps += more
    found, more, status = _nearest(problem, closest, most)
    steps += more
    if status != Status.CONVERGED and np.max(np.abs(closest.value)) <= _SOLVED * np.max(
        np.abs(look.value)
    ):
        return (
            closest,
            steps,
            int(Status.MAX_ITERATIONS),
        )  # a solution, but on the way to the nearest one it stalled
    solutions = [found] if status == Status.CONVERGED else []
    for begin in _beginnings(problem, look, most):
        found, more, status = _nearest(problem, begin, most)
        steps += more
        if status == Status.CONVERGED:
            solutions.append(found)
    if not solutions:
        return closest, steps, _without_solution(how)
    return (
        min(solutions, key=lambda one: float(np.linalg.norm(one.x))),
        steps,
        int(Status.CONVERGED),
    )


def _beginnings(problem: Problem, look: Look, most: int) -> Iterator[Look]:
    """Looks where one parameter alone makes one of the equations true, the others being as at the
    start.
    """
    for i, equation in itertools.product(problem.free, range(look.value.size)):
        only = np.arange(len(PARAMETERS)) == i
        alone = replace(
            problem, low=problem.low * only, high=problem.high * only, equation=equation, looks=0
        )
        start = look._replace(value=look.value[[equation]], jacobian=look.jacobian[[equation]])
        one, _, status = nearest_of_one(alone, start, most)
        problem.looks += alone.looks
        if status == Status.CONVERGED:
            yield problem.at(one.x)


def _bracketed(problem: Problem, one: Look, other: Look, most: int) -> tuple[Look, int, int]:
    """The zero between two looks of different sign: Newton's method, halving where it would leave
    them.
    """
    (i,) = problem.free
    look = min(one, other, key=lambda side: abs(float(side.value[0])))
    ends = {math.copysign(1.0, float(side.value[0])): float(side.x[i]) for side in (one, other)}
    for count in range(2 * most):
        ends[math.copysign(1.0, float(look.value[0]))] = float(look.x[i])
        low, high = sorted(ends.values())
        with np.errstate(divide="ignore"):
            place = float(look.x[i] - look.value[0] / look.jacobian[0, i])
        last = abs(place - look.x[i]) <= _SMALL
        place = place if low < place < high else 0.5 * (low + high)
        after = problem.at(_with(look.x, problem.free, np.array([place])))
        if last:
            better = after.sound and abs(after.value[0]) <= abs(look.value[0])
            return after if better else look, count + 1, int(Status.CONVERGED)
        if not after.sound:
            return look, count, after.status
        look = after
    return look, 2 * most, int(Status.MAX_ITERATIONS)


def _with(x: np.ndarray, free: np.ndarray, values: np.ndarray) -> np.ndarray:
    x = x.copy()
    x[free] = values
    return x


def _searched(problem: Problem, look: Look, step: np.ndarray, weight: float) -> Look:
    """The look after as much of the step as lowers |x|^2/2 + weight |loss|; one with a failed
    status if none does.

    Where a step does not, the curvature of the equations is made good before it is halved: a merit
    as this one would otherwise refuse Newton's steps along a curved solution (Maratos).
    """
    free = problem.free
    x, jacobian = look.x[free], look.jacobian[:, free]

    def merit(here: Look) -> float:
        return 0.5 * float(here.x @ here.x) + weight * float(np.sum(np.abs(here.value)))

    rate = float(x @ step) - weight * float(np.sum(np.abs(look.value)))
    size = float(np.max(np.abs(step)))
    damping, failure = min(1.0, _LONGEST / size), int(Status.NO_SOLUTION)
    low, high = problem.low[free], problem.high[free]
    while damping >= _LEAST_DAMPING:
        trial = problem.at(_with(look.x, free, np.clip(x + damping * step, low, high)))
        if trial.sound and size <= _LOCAL:
            return trial
        if trial.sound and merit(trial) <= merit(look) + 1e-4 * damping * rate:
            return trial
        if trial.sound:
            back = np.linalg.lstsq(jacobian, (1 - damping) * look.value - trial.value, rcond=None)[
                0
            ]
            bent = problem.at(_with(look.x, free, np.clip(trial.x[free] + back, low, high)))
            if bent.sound and merit(bent) <= merit(look) + 1e-4 * damping * rate:
                return bent
        failure = int(Status.NO_SOLUTION) if trial.sound else trial.status
        damping /= 2
    return look._replace(status=failure)


def _updated(
    hessian: np.ndarray, old: Look, new: Look, free: np.ndarray, multipliers: np.ndarray
) -> np.ndarray:
    """The Hessian of |x|^2/2 + multipliers . loss after a step: BFGS, damped to stay positive
    definite (Powell).
    """
    step = (new.x - old.x)[free]
    change = step + (new.jacobian - old.jacobian)[:, free].T @ multipliers
    pushed = hessian @ step
    curvature, has = float(step @ change), float(step @ pushed)
    if curvature < 0.2 * has:
        share = 0.8 * has / (has - curvature)
        change = share * change + (1 - share) * pushed
    return (
        hessian - np.outer(pushed, pushed) / has + np.outer(change, change) / float(step @ change)
    )


class _Scalar(NamedTuple):
    """A number to be made small, and its gradient."""

    value: float
    gradient: np.ndarray


def loss_itself(look: Look) -> _Scalar:
    return _Scalar(float(look.value[0]), look.jacobian[0])


def _square(look: Look) -> _Scalar:
    return _Scalar(0.5 * float(look.value @ look.value), look.jacobian.T @ look.value)


def least_on_bounds(
    problem: Problem, look: Look, most: int, of: Callable[[Look], _Scalar]
) -> tuple[Look, int, int]:
    """The least value near the start, the steps taken, and a status: L-BFGS on what the bounds
    leave free.

    A parameter at a bound that the gradient pushes it against is held; whenever others are held
    than before, L-BFGS begins anew.
    """
    begin, update = _lbfgs()
    state, held, fresh = begin(look.x), None, True
    for count in range(most):
        value, gradient = of(look)
        outwards = ((look.x <= problem.low) & (gradient > 0)) | (
            (look.x >= problem.high) & (gradient < 0)
        )
        now = outwards | (problem.low == problem.high)
        if held is None or np.any(now != held):
            state, held, fresh = begin(look.x), now, True
        gradient = np.where(held, 0.0, gradient)
        if np.max(np.abs(gradient)) <= 1e-12 * abs(value):
            return look, count, int(Status.CONVERGED)
        direction, state = update(gradient, state, look.x)
        direction = np.where(held, 0.0, -np.asarray(direction))
        if not gradient @ direction < 0:
            state, fresh = begin(look.x), True
            direction = -gradient / max(1.0, float(np.max(np.abs(gradient))))
        if not fresh and np.max(np.abs(direction)) <= _SMALL_STEP_DOWN:
            return look, count, int(Status.CONVERGED)
        after = _lower(problem, look, direction, gradient, of)
        if not after.sound:
            rounding = abs(gradient @ direction) <= 1e-10 * abs(value)
            return look, count, int(Status.CONVERGED) if rounding else after.status
        look, fresh = after, False
    return look, most, int(Status.MAX_ITERATIONS)


@cache
def _lbfgs() -> tuple[Callable[..., Any], Callable[..., Any]]:
    """The beginning and the direction of optax's L-BFGS, compiled once."""
    import optax

    method = optax.scale_by_lbfgs(memory_size=len(PARAMETERS))
    begin, update = jax.jit(method.init), jax.jit(method.update)

    def freely(function: Callable[..., Any], *arguments: Any) -> Any:
        with jax.numpy_dtype_promotion("standard"):  # it counts in integers of two kinds
            return function(*arguments)

    return partial(freely, begin), partial(freely, update)


def _lower(
    problem: Problem,
    look: Look,
    direction: np.ndarray,
    gradient: np.ndarray,
    of: Callable[[Look], _Scalar],
) -> Look:
    """The look after as much of the direction, bent along the bounds, as lowers the value; else a
    failed one.
    """
    damping = min(1.0, _LONGEST / float(np.max(np.abs(direction))))
    value, failure = of(look).value, int(Status.MAX_ITERATIONS)
    while damping >= _LEAST_DAMPING:
        trial = problem.at(np.clip(look.x + damping * direction, problem.low, problem.high))
        if trial.sound and of(trial).value <= value + 1e-4 * float(gradient @ (trial.x - look.x)):
            return trial
        failure = int(Status.MAX_ITERATIONS) if trial.sound else trial.status
        damping /= 2
    return look._replace(status=failure)
