"""A pendulum for a wanted orbit: parameters found by the derivatives of the orbits that they have.

The unknowns are x = ln(parameter/its start), one for each that is free, so that a factor counts alike up or down and
for lengths, masses and gravity. Every look at x follows the branches from their normal modes anew (`find_orbit`), and
the implicit function theorem at the root gives what is known of the orbits as functions of x: no iteration is
differentiated, and one compiled program serves all branches, losses and free parameters.

- goal `zero`: of the solutions of loss = 0 within the bounds the nearest one, the least |x|^2/2. Newton's method on the
  Lagrange conditions (sequential quadratic programming): each step is the nearest solution of the linearised equations
  within the bounds. As many equations as unknowns leave plain Newton.
- goal `minimum`: optax's L-BFGS, projected onto the bounds. Its steps are combinations of gradients, so that x stays
  at right angles to whatever the loss does not depend on: of a scale that does not matter the nearest value is kept.

Both step back where an orbit is not to be had, and say so if that is where they are stopped.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dpend._runtime import require_float64
from dpend.checks import function, integer, is_traced, known_number, one_of, several, shown
from dpend.orbits import BRANCHES, PeriodicOrbit, find_orbit, slopes, swinging_pendulum
from dpend.pendulum import Pendulum, Scalar, check_pendulum, hamiltonian, released
from dpend.trajectory import Status, message

Loss = Callable[..., Any]
GOALS = ("zero", "minimum")
# What may be free; the index is the place in every vector of unknowns.
PARAMETERS = ("l1", "l2", "m1", "m2", "g", "theta1")
_THETA1 = PARAMETERS.index("theta1")

# Without bounds a parameter may grow and shrink by this factor: as far as branches are known to be followed.
_FACTOR = 10.0
# Below pi [rad] by more than rounding, and where theta1 may get by itself: the branches end at the former.
_LARGEST_ANGLE, _LARGEST_WITHOUT_BOUNDS = math.pi * (1 - 1e-12), 0.999 * math.pi
# The longest step [of a logarithm], and the one below which steps are Newton's own and need no search.
_LONGEST, _LOCAL = 0.5, 1e-5
# Steps this short end the iteration: an error of the equations is its square.
_SMALL, _SMALL_STEP_DOWN = 1e-9, 1e-8
# An iteration that stalls at steps as short as this was stopped by rounding.
_STALLED = 1e-6
_LEAST_DAMPING = 2.0**-12
# Equations that are down to this share of where they began have a solution there.
_SOLVED = 1e-8
# Places at which one equation for one unknown is looked at on either side of the start for a change of sign.
_PIECES = 16


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Design:
    """A pendulum found by `design_pendulum`.

    Attributes:
        pendulum: the one found; if `status` is not `CONVERGED`, the best so far.
        orbits: its orbits, one a branch, with their error estimates.
        theta1: their release angles [rad].
        loss: its value, a scalar or as many as there are equations.
        distance: root of the sum of squares of ln(parameter/start).
        sensitivities: derivatives with respect to the logarithm of each of l1, l2, m1, m2, g and theta1, free or not:
            `sensitivities["loss"]["l1"]` is d loss/d ln l1; beside `loss` there are `theta2` [rad], `period` [s] and
            `kappa`, of one orbit scalars, of several one a branch.
        iterations: steps taken, of all searches that were begun.
        looks: how often the orbits were solved for.
        status: a value of `Status`.
        at_bounds: the parameters that ended at one of their bounds.
    """

    pendulum: Pendulum
    orbits: tuple[PeriodicOrbit, ...]
    theta1: tuple[Scalar, ...]
    loss: Scalar
    distance: Scalar
    sensitivities: dict[str, dict[str, Scalar]]
    iterations: Scalar
    looks: Scalar
    status: Scalar
    at_bounds: tuple[str, ...] = field(metadata={"static": True})

    @property
    def orbit(self) -> PeriodicOrbit:
        """The orbit, of several the first."""
        return self.orbits[0]

    @property
    def message(self) -> str:
        """The sentence that says what its status means."""
        return _MESSAGES.get(Status(int(self.status)), message(self.status))


_MESSAGES = {
    Status.CONVERGED: "Found.",
    Status.MAX_ITERATIONS: "The search did not converge in the allowed iterations, or stalled: start from the pendulum "
    "it came to.",
    Status.LEFT_BRANCH: "The search was stopped where the branch cannot be followed to this release: change the start, "
    "or the bounds.",
    Status.NO_SUCH_ORBIT: "The search was stopped where the branch ends without reaching this release: change the "
    "start, or the bounds.",
    Status.NO_SOLUTION: "No solution was found within the bounds: the least sum of squares near the start is returned.",
}


# --- a look at the orbits --------------------------------------------------------------------------------------------


class _Look(NamedTuple):
    """What is known at one point; if an orbit is not to be had, its status and no more that counts."""

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
class _Problem:
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

    def at(self, x: np.ndarray) -> _Look:
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
        return _Look(x, value, jacobian, orbits, rates, status)


@partial(jax.jit, static_argnames="loss")
def _judged(loss: Loss, orbits: tuple[PeriodicOrbit, ...], rates: tuple[Any, ...]) -> tuple[Scalar, Scalar]:
    """The loss as a vector, and its derivatives with respect to the logarithms of `PARAMETERS`."""

    def at(logs: Scalar) -> Scalar:
        moved = (_moved(orbit, rate, logs) for orbit, rate in zip(orbits, rates, strict=True))
        return jnp.ravel(jnp.asarray(loss(*moved), jnp.float64))

    here = jnp.zeros(len(PARAMETERS))
    return at(here), jax.jacfwd(at)(here)


def _moved(orbit: PeriodicOrbit, rate: Scalar, logs: Scalar) -> PeriodicOrbit:
    """A centred orbit after a small change of ln parameters, to the first order, which is all that is asked of it."""
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


# --- equations: the nearest solution ---------------------------------------------------------------------------------


class _Step(NamedTuple):
    """A step of the free unknowns, and the multipliers of the equations."""

    step: np.ndarray
    multipliers: np.ndarray


def _quadratic(
    hessian: np.ndarray, slope: np.ndarray, value: np.ndarray, jacobian: np.ndarray, low: np.ndarray, high: np.ndarray,
    slack: float = 0.0,
) -> _Step | None:  # fmt: skip
    """The step d that minimises slope.d + d.hessian.d/2 with value + jacobian d = 0 and low <= d <= high; None if the
    bounds leave no such step. With `slack` the equations cost their squares over twice of it instead.

    The bounds that hold are tried, none first: the first choice that satisfies the conditions of Karush, Kuhn and
    Tucker is the solution, there being one. Of six unknowns 729 small solves at worst.
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


def _nearest(problem: _Problem, look: _Look, most: int) -> tuple[_Look, int, int]:
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


def _nearest_of_one(problem: _Problem, look: _Look, most: int) -> tuple[_Look, int, int]:
    """One equation for one unknown: where Newton's method leads, unless the loss changes sign nearer to the start.

    Looked at are places on both sides at even distances, up to the solution, or up to the bounds if there is none.
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
            trial = problem.at(_with(look.x, problem.free, np.clip([place], problem.low[i], problem.high[i])))
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
    closest, more, how = _least(problem, best, most, _square)
    return closest, steps + more, _without_solution(how)


def _without_solution(how: int) -> int:
    """The status of equations of which the least sum of squares has been sought, which ended with `how`."""
    return int(Status.NO_SOLUTION) if how == Status.CONVERGED else how


def _nearest_of_many(problem: _Problem, look: _Look, most: int) -> tuple[_Look, int, int]:
    """The nearest solution near the start; where Newton's method finds none, the nearest of those that it finds from
    the least sum of squares, and from where one parameter alone makes one of the equations true.
    """
    found, steps, status = _nearest(problem, look, most)
    if status == Status.CONVERGED:
        return found, steps, status
    closest, more, how = _least(problem, found, most, _square)
    steps += more
    found, more, status = _nearest(problem, closest, most)
    steps += more
    if status != Status.CONVERGED and np.max(np.abs(closest.value)) <= _SOLVED * np.max(np.abs(look.value)):
        return closest, steps, int(Status.MAX_ITERATIONS)  # a solution, but on the way to the nearest one it stalled
    solutions = [found] if status == Status.CONVERGED else []
    for begin in _beginnings(problem, look, most):
        found, more, status = _nearest(problem, begin, most)
        steps += more
        if status == Status.CONVERGED:
            solutions.append(found)
    if not solutions:
        return closest, steps, _without_solution(how)
    return min(solutions, key=lambda one: float(np.linalg.norm(one.x))), steps, int(Status.CONVERGED)


def _beginnings(problem: _Problem, look: _Look, most: int) -> Iterator[_Look]:
    """Looks where one parameter alone makes one of the equations true, the others being as at the start."""
    for i, equation in itertools.product(problem.free, range(look.value.size)):
        only = np.arange(len(PARAMETERS)) == i
        alone = replace(problem, low=problem.low * only, high=problem.high * only, equation=equation, looks=0)
        start = look._replace(value=look.value[[equation]], jacobian=look.jacobian[[equation]])
        one, _, status = _nearest_of_one(alone, start, most)
        problem.looks += alone.looks
        if status == Status.CONVERGED:
            yield problem.at(one.x)


def _bracketed(problem: _Problem, one: _Look, other: _Look, most: int) -> tuple[_Look, int, int]:
    """The zero between two looks of different sign: Newton's method, halving where it would leave them."""
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


def _searched(problem: _Problem, look: _Look, step: np.ndarray, weight: float) -> _Look:
    """The look after as much of the step as lowers |x|^2/2 + weight |loss|; one with a failed status if none does.

    Where a step does not, the curvature of the equations is made good before it is halved: a merit as this one would
    otherwise refuse Newton's steps along a curved solution (Maratos).
    """
    free = problem.free
    x, jacobian = look.x[free], look.jacobian[:, free]

    def merit(here: _Look) -> float:
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
            back = np.linalg.lstsq(jacobian, (1 - damping) * look.value - trial.value, rcond=None)[0]
            bent = problem.at(_with(look.x, free, np.clip(trial.x[free] + back, low, high)))
            if bent.sound and merit(bent) <= merit(look) + 1e-4 * damping * rate:
                return bent
        failure = int(Status.NO_SOLUTION) if trial.sound else trial.status
        damping /= 2
    return look._replace(status=failure)


def _updated(hessian: np.ndarray, old: _Look, new: _Look, free: np.ndarray, multipliers: np.ndarray) -> np.ndarray:
    """The Hessian of |x|^2/2 + multipliers . loss after a step: BFGS, damped to stay positive definite (Powell)."""
    step = (new.x - old.x)[free]
    change = step + (new.jacobian - old.jacobian)[:, free].T @ multipliers
    pushed = hessian @ step
    curvature, has = float(step @ change), float(step @ pushed)
    if curvature < 0.2 * has:
        share = 0.8 * has / (has - curvature)
        change = share * change + (1 - share) * pushed
    return hessian - np.outer(pushed, pushed) / has + np.outer(change, change) / float(step @ change)


# --- a minimum -------------------------------------------------------------------------------------------------------


class _Scalar(NamedTuple):
    """A number to be made small, and its gradient."""

    value: float
    gradient: np.ndarray


def _itself(look: _Look) -> _Scalar:
    return _Scalar(float(look.value[0]), look.jacobian[0])


def _square(look: _Look) -> _Scalar:
    return _Scalar(0.5 * float(look.value @ look.value), look.jacobian.T @ look.value)


def _least(problem: _Problem, look: _Look, most: int, of: Callable[[_Look], _Scalar]) -> tuple[_Look, int, int]:
    """The least value near the start, the steps taken, and a status: L-BFGS on what the bounds leave free.

    A parameter at a bound that the gradient pushes it against is held; whenever others are held than before, L-BFGS
    begins anew.
    """
    begin, update = _lbfgs()
    state, held, fresh = begin(look.x), None, True
    for count in range(most):
        value, gradient = of(look)
        outwards = ((look.x <= problem.low) & (gradient > 0)) | ((look.x >= problem.high) & (gradient < 0))
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
    problem: _Problem, look: _Look, direction: np.ndarray, gradient: np.ndarray, of: Callable[[_Look], _Scalar]
) -> _Look:
    """The look after as much of the direction, bent along the bounds, as lowers the value; else a failed one."""
    damping = min(1.0, _LONGEST / float(np.max(np.abs(direction))))
    value, failure = of(look).value, int(Status.MAX_ITERATIONS)
    while damping >= _LEAST_DAMPING:
        trial = problem.at(np.clip(look.x + damping * direction, problem.low, problem.high))
        if trial.sound and of(trial).value <= value + 1e-4 * float(gradient @ (trial.x - look.x)):
            return trial
        failure = int(Status.MAX_ITERATIONS) if trial.sound else trial.status
        damping /= 2
    return look._replace(status=failure)


# --- the friendly call -----------------------------------------------------------------------------------------------


def design_pendulum(
    loss: Any,
    pendulum: Any,
    free: Any = ("l1", "l2"),
    *,
    branch: Any,
    theta1: Any,
    goal: Any = "zero",
    bounds: Any = None,
    max_iterations: Any = 60,
) -> Design:
    """The pendulum whose orbit has a wanted property, nearest to `pendulum`.

    `goal="zero"` solves loss = 0; where there are more free parameters than equations it takes the solution with the
    least sum of squares of ln(parameter/start), by the Lagrange conditions, which hold at the nearest solution, and at
    others only if the solutions are strongly bent. `goal="minimum"` makes the loss as small as it gets near the start.
    Both find what Newton's method and descent lead to: where there are several, not always the best. For instance

        lambda orbit: orbit.period - 1.0                          # 1 s
        lambda orbit: orbit.kappa                                 # in the middle of the stable range
        lambda slow, fast: slow.period - 2 * fast.period          # branch=("in-phase", "anti-phase")
        lambda wide, small: wide.period - small.period            # branch=("in-phase",) * 2, theta1=(1.0, 0.1)

    Arguments:
        loss: of one orbit, or of as many as there are branches, traceable: a scalar or, of goal `zero`, a vector of as
            many equations; the orbit's `pendulum` carries derivatives too, so that `normal_modes(orbit.pendulum)` and
            its like may be asked. It is compiled once for each function: define it once, not in a loop.
        pendulum: to start from.
        free: names among l1, l2, m1, m2, g and theta1. Scales that do not matter (both masses) may be free: the nearest
            solution leaves them as they are.
        branch: `in-phase` or `anti-phase`, or a sequence of them, one for each orbit that the loss is told.
        theta1: release angle [rad], between 0 and pi, or one for each branch; the start, if it is free, which only one
            angle can be.
        goal: `zero` or `minimum`.
        bounds: {name: (low, high)} in the parameter's unit; a tenth and ten times the start where none are given, and
            for theta1 no more than pi.
        max_iterations: steps at most.
    Returns:
        Design. If its status is not `Status.CONVERGED` it holds the best so far: `NO_SOLUTION` if the bounds hold none
        near the start (the least sum of squares is returned), `LEFT_BRANCH` or `NO_SUCH_ORBIT` if it was stopped where
        a branch does not get to its release.
    Raises:
        ValueError: an unknown or repeated name in free; more equations than free parameters; goal `minimum` of a
            vector; bounds not positive, of a parameter that is not free, or without the start; an unknown branch or
            goal; theta1 out of range; g not positive; values traced by `jit`.
        RuntimeError: float64 is switched off in JAX.
    """
    require_float64()
    function("loss", loss, "an orbit", "lambda orbit: orbit.kappa")
    check_pendulum(pendulum)
    if any(is_traced(leaf) for leaf in jax.tree.leaves((pendulum, theta1))):
        raise ValueError("pendulum and theta1 must be numbers, not traced by jit or a derivative: design outside of it")
    start = swinging_pendulum(pendulum)
    branches, angles = _orbits_asked(branch, theta1)
    names = _names(free)
    if "theta1" in names and not np.isscalar(theta1) and len(angles) > 1:
        raise ValueError(f"theta1 can be free only if it is one angle, got {len(angles)}: leave it out of free")
    goal, max_iterations = one_of("goal", goal, GOALS), integer("max_iterations", max_iterations)
    values = dict(zip(PARAMETERS, [*jax.tree.leaves(start), angles[0]], strict=True))
    low, high = _box(values, names, bounds)
    problem = _Problem(loss, start, branches, angles, low, high)
    first = problem.at(np.zeros(len(PARAMETERS)))
    equations = first.value.size
    if goal == "minimum" and equations != 1:
        raise ValueError(f"loss must be a scalar for a minimum, got {equations} values: add them up")
    if goal == "zero" and not 1 <= equations <= len(names):
        raise ValueError(
            f"free must name as many parameters as there are equations or more, got {len(names)} for {equations}: name "
            "others too, or ask for the minimum of a scalar"
        )
    if not first.sound:
        return _result(problem, first, 0, first.status)
    if goal == "minimum":
        return _result(problem, *_least(problem, first, max_iterations, _itself))
    solve = _nearest_of_one if len(names) == 1 else _nearest_of_many
    return _result(problem, *solve(problem, first, max_iterations))


def _orbits_asked(branch: Any, theta1: Any) -> tuple[tuple[str, ...], tuple[float, ...]]:
    """Branches and angles, one each for every orbit."""
    branches = (branch,) if isinstance(branch, str) else branch
    if not isinstance(branches, Sequence) or not branches:
        raise ValueError(
            f"branch must be one of {', '.join(BRANCHES)}, or a sequence of them, got {shown(branch)}: give such"
        )
    branches = tuple(one_of("branch", one, BRANCHES) for one in branches)
    listed = isinstance(theta1, (list, tuple)) or (isinstance(theta1, (np.ndarray, jax.Array)) and theta1.ndim > 0)
    angles = tuple(theta1) if listed else (theta1,) * len(branches)
    if len(angles) != len(branches):
        raise ValueError(
            f"theta1 must be one angle, or one a branch, got {len(angles)} for {len(branches)}: give {len(branches)}"
        )
    known = tuple(known_number("theta1", angle, unit="rad") for angle in angles)
    for angle in known:
        if not 0 < angle < _LARGEST_ANGLE:
            raise ValueError(f"theta1 must be between 0 and pi [rad], got {angle:g}: give another theta1")
    return branches, known


def _names(free: Any) -> tuple[str, ...]:
    names = (free,) if isinstance(free, str) else free
    sound = isinstance(names, Sequence) and all(isinstance(name, str) and name in PARAMETERS for name in names)
    if not sound or not names:
        raise ValueError(
            f"free must name one or more of {', '.join(PARAMETERS)}, got {shown(free)}: give names like ('l1', 'l2')"
        )
    if len(set(names)) < len(names):
        raise ValueError(f"free must name each parameter once, got {shown(free)}: leave one out")
    return tuple(names)


def _box(values: dict[str, float], names: tuple[str, ...], bounds: Any) -> tuple[np.ndarray, np.ndarray]:
    """The bounds of x."""
    given = {} if bounds is None else bounds
    if not isinstance(given, Mapping):
        raise ValueError(f"bounds must be a dictionary like {{'l1': (0.1, 0.5)}}, got {shown(bounds)}: give one")
    low, high = np.zeros(len(PARAMETERS)), np.zeros(len(PARAMETERS))
    for name in given:
        if name not in names:
            raise ValueError(f"bounds must be of parameters that are free, got {name!r}: free are {', '.join(names)}")
    for name in names:
        start, i = values[name], PARAMETERS.index(name)
        pair = given.get(name, (start / _FACTOR, start * _FACTOR))
        if name == "theta1" and name not in given:
            pair = (start / _FACTOR, max(start, min(start * _FACTOR, _LARGEST_WITHOUT_BOUNDS)))
        pair = several(f"bounds of {name}", pair, "a pair (low, high)", 2)
        least, most = (known_number(f"bounds of {name}", bound, positive=True) for bound in pair)
        if not least < most or not least <= start <= most:
            raise ValueError(
                f"bounds of {name} must be two numbers with the start, {start:g}, between them, got "
                f"({least:g}, {most:g}): give others, or another start"
            )
        if name == "theta1" and not most < _LARGEST_ANGLE:
            raise ValueError(f"bounds of theta1 must be below pi [rad], got {most:g}: give another upper bound")
        low[i], high[i] = math.log(least / start), math.log(most / start)
    return low, high


def _result(problem: _Problem, look: _Look, steps: int, status: int) -> Design:
    parameters = [np.array([*jax.tree.leaves(orbit.pendulum), orbit.theta1]) for orbit in look.orbits]
    rates = [np.asarray(rate) * row for rate, row in zip(look.slopes, parameters, strict=True)]
    single = len(rates) == 1
    periods = np.array([float(orbit.period) for orbit in look.orbits])
    by_orbit = {
        "theta2": np.array([rate[0] for rate in rates]),
        "period": np.array([rate[1] for rate in rates]) * periods[:, None],
        "kappa": np.array([rate[2] for rate in rates]),
    }
    table = {"loss": look.jacobian[0] if look.value.size == 1 else look.jacobian}
    table |= {name: rows[0] if single else rows for name, rows in by_orbit.items()}
    free = problem.free
    at = (look.x[free] <= problem.low[free]) | (look.x[free] >= problem.high[free])
    return Design(
        pendulum=look.orbits[0].pendulum,
        orbits=look.orbits,
        theta1=tuple(orbit.theta1 for orbit in look.orbits),
        loss=jnp.asarray(look.value[0] if look.value.size == 1 else look.value),
        distance=jnp.asarray(np.linalg.norm(look.x)),
        sensitivities={
            name: {key: jnp.asarray(rows[..., i]) for i, key in enumerate(PARAMETERS)} for name, rows in table.items()
        },
        iterations=jnp.asarray(steps),
        looks=jnp.asarray(problem.looks),
        status=jnp.asarray(int(status)),
        at_bounds=tuple(PARAMETERS[i] for i in free[at]),
    )
