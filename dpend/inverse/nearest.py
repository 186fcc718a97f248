"""The nearest pendulum that solves a loss, and the least loss, within bounds."""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import numpy as np

from dpend.inverse.problem import PARAMETERS, DesignProblem, Look
from dpend.status import Status

# SLSQP stops when |x|^2/2 changes by less than this, which rounding seldom allows ...
_FLAT = 1e-18
# ... or when a step [of a logarithm] is this short: the error of the equations is its square.
_SMALL = 1e-9
# The status with which SLSQP says that it made all its steps.
_OUT_OF_STEPS = 9
# The equations' value where there is no orbit, over that at the start: SLSQP's line search then
# makes a tenth of the step.
_STEEP = 1e3
# Near a nearest solution Newton's step, and the slope of |x|^2/2 along the solutions, are so small.
_NEAR = 1e-6
# A solution found after more steps may not be the nearest one. Direct ways took 2 to 17; the one of
# 24 ended at 1.09 times the least distance.
_MANY = 20
# Brent's method gives a zero to this [of a logarithm], or to rounding.
_ROUNDING = 1e-15
# Equations that are down to this share of where they began have a solution there.
_SOLVED = 1e-8
# One equation for one unknown is looked at in so many places on either side of the start.
_PIECES = 16
# The longest step of a descent [of a logarithm], the step that ends it, and the least share of a
# step that is tried.
_LONGEST, _SMALL_STEP_DOWN, _LEAST_DAMPING = 0.5, 1e-8, 2.0**-12


def _with(x: np.ndarray, free: np.ndarray, values: np.ndarray) -> np.ndarray:
    x = x.copy()
    x[free] = values
    return x


class _Stop(Exception):
    """Ends SciPy's search: the last step was short, or SciPy goes on from where no orbit is."""


class _Route:
    """What SLSQP asks for: the equations and their derivatives; each place is solved for once."""

    def __init__(self, problem: DesignProblem, start: Look) -> None:
        self.problem, self.free, self.here, self.latest = problem, problem.free, start, start
        self.steps, self.failure = 0, int(Status.NO_SOLUTION)
        self.steep = np.full(start.value.shape, _STEEP * max(1.0, np.max(np.abs(start.value))))

    def at(self, values: np.ndarray) -> Look:
        x = _with(self.here.x, self.free, values)
        x = np.clip(x, self.problem.low, self.problem.high)
        if not np.array_equal(x, self.latest.x):
            self.latest = self.here if np.array_equal(x, self.here.x) else self.problem.at(x)
            if not self.latest.sound:
                self.failure = self.latest.status
        return self.latest

    def equations(self, values: np.ndarray) -> np.ndarray:
        look = self.at(values)
        return look.value if look.sound else self.steep

    def derivatives(self, values: np.ndarray) -> np.ndarray:
        look = self.at(values)
        if not look.sound:
            raise _Stop
        return look.jacobian[:, self.free]

    def accept(self, values: np.ndarray) -> None:
        look = self.at(values)
        if not look.sound:
            raise _Stop
        size = np.max(np.abs(look.x - self.here.x))
        self.here, self.steps = look, self.steps + 1
        if size <= _SMALL:
            raise _Stop


def _nearest(problem: DesignProblem, look: Look, most: int) -> tuple[Look, int, int]:
    """The nearest solution of loss = 0 that the way from a look leads to, the steps taken, and a
    status: SLSQP (Kraft 1988), and a last Newton step.
    """
    from scipy.optimize import minimize

    route, finished = _Route(problem, look), True
    try:
        result = minimize(
            lambda x: 0.5 * x @ x,
            look.x[route.free],
            jac=np.array,
            method="SLSQP",
            bounds=np.stack([problem.low, problem.high], axis=1)[route.free],
            constraints={"type": "eq", "fun": route.equations, "jac": route.derivatives},
            callback=route.accept,
            options={"maxiter": most, "ftol": _FLAT},
        )
        finished = result.status != _OUT_OF_STEPS
    except _Stop:
        pass
    if not finished:
        return route.here, route.steps, int(Status.MAX_ITERATIONS)
    last = _polish(problem, route.here)
    if last is None:
        return route.here, route.steps, route.failure
    return last, route.steps + 1, int(Status.CONVERGED)


def _polish(problem: DesignProblem, look: Look) -> Look | None:
    """The look after Newton's shortest step, or the one before if rounding makes it worse; None if
    this is not near a nearest solution: bounds keep the step from one, the step is long, or |x|
    falls along the solutions.
    """
    inside = (look.x > problem.low) & (look.x < problem.high)
    jacobian, step = look.jacobian[:, inside], np.zeros_like(look.x)
    step[inside] = np.linalg.lstsq(jacobian, -look.value, rcond=None)[0]
    x = look.x[inside]
    slope = x - jacobian.T @ np.linalg.lstsq(jacobian.T, x, rcond=None)[0]
    scale = np.sum(np.abs(look.jacobian[:, problem.free]), axis=1)
    if not np.all(np.abs(look.value + look.jacobian @ step) <= _NEAR * scale):
        return None
    if not max(np.max(np.abs(step)), np.max(np.abs(slope), initial=0.0)) <= _NEAR:
        return None
    last = problem.at(np.clip(look.x + step, problem.low, problem.high))
    better = last.sound and np.sum(np.abs(last.value)) <= np.sum(np.abs(look.value))
    return last if better else look


def nearest_of_one(problem: DesignProblem, look: Look, most: int) -> tuple[Look, int, int]:
    """One equation for one unknown: where Newton's method leads, unless the loss changes sign
    nearer to the start.

    The places between are `_PIECES` on either side at even distances, up to the solution, or up to
    the bounds if there is none.
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
            place = np.clip(side * share * reach, problem.low[i], problem.high[i])
            trial = problem.at(_with(look.x, problem.free, np.array([place])))
            before = last.pop(side)
            if not trial.sound:
                continue
            if trial.value[0] * before.value[0] < 0:
                changes.append(_between(problem, before, trial, most))
            best = min(best, trial, key=lambda one: abs(float(one.value[0])))
            if problem.low[i] < place < problem.high[i]:
                last[side] = trial
        if changes:
            nearest, more, how = min(changes, key=lambda change: abs(float(change[0].x[i])))
            return nearest, steps + more, how
    if status == Status.CONVERGED:
        return found, steps, status
    closest, more, how = least_on_bounds(problem, best, most, _square)
    return closest, steps + more, _without_solution(how)


def _between(problem: DesignProblem, one: Look, other: Look, most: int) -> tuple[Look, int, int]:
    """The zero between two looks of different sign, by Brent's method."""
    from scipy.optimize import brentq

    (i,) = problem.free
    looks = {float(look.x[i]): look for look in (one, other)}

    def value(place: float) -> float:
        if place not in looks:
            looks[place] = problem.at(_with(one.x, problem.free, np.array([place])))
        if not looks[place].sound:
            raise _Stop
        return float(looks[place].value[0])

    settings = {"xtol": _ROUNDING, "maxiter": 2 * most, "full_output": True, "disp": False}
    try:
        place, result = brentq(value, float(one.x[i]), float(other.x[i]), **settings)
    except _Stop:
        return one, len(looks) - 2, next(x.status for x in looks.values() if not x.sound)
    status = Status.CONVERGED if result.converged else Status.MAX_ITERATIONS
    return looks[place], result.iterations, int(status)


def _without_solution(how: int) -> int:
    """The status of equations of which the least sum of squares has been sought, which ended with
    `how`.
    """
    return int(Status.NO_SOLUTION) if how == Status.CONVERGED else how


def nearest_of_many(problem: DesignProblem, look: Look, most: int) -> tuple[Look, int, int]:
    """The nearest solution near the start.

    Where the search finds none, or only after many steps, it begins anew from the least sum of
    squares, and from where one parameter alone makes one of the equations true. The nearest of all
    that is found is the answer.
    """
    found, steps, status = _nearest(problem, look, most)
    if status == Status.CONVERGED and steps <= _MANY:
        return found, steps, status
    solutions = [found] if status == Status.CONVERGED else []
    closest, how = found, status
    if not solutions:
        start = min(look, found, key=lambda one: float(one.value @ one.value))
        closest, more, how = least_on_bounds(problem, start, most, _square)
        found, again, status = _nearest(problem, closest, most)
        steps += more + again
        if status == Status.CONVERGED:
            solutions.append(found)
        elif np.max(np.abs(closest.value)) <= _SOLVED * np.max(np.abs(look.value)):
            # A solution, but the way from it to the nearest one stalled.
            return closest, steps, int(Status.MAX_ITERATIONS)
    for begin in _beginnings(problem, look, most):
        found, more, status = _nearest(problem, begin, most)
        steps += more
        if status == Status.CONVERGED:
            solutions.append(found)
    if not solutions:
        return closest, steps, _without_solution(how)
    nearest = min(solutions, key=lambda one: float(np.linalg.norm(one.x)))
    return nearest, steps, int(Status.CONVERGED)


def _beginnings(problem: DesignProblem, look: Look, most: int) -> Iterator[Look]:
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


class _Scalar(NamedTuple):
    """A number to be made small, and its gradient."""

    value: float
    gradient: np.ndarray


def loss_itself(look: Look) -> _Scalar:
    return _Scalar(float(look.value[0]), look.jacobian[0])


def _square(look: Look) -> _Scalar:
    return _Scalar(0.5 * float(look.value @ look.value), look.jacobian.T @ look.value)


def least_on_bounds(
    problem: DesignProblem, look: Look, most: int, of: Callable[[Look], _Scalar]
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
        after = _step_down(problem, look, direction, gradient, of)
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


def _step_down(
    problem: DesignProblem,
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
