"""A pendulum for a wanted orbit: parameters found by the derivatives of the orbits that they have.

The unknowns are x = ln(parameter/its start), one for each that is free, so that a factor counts
alike up or down and for lengths, masses and gravity. Every look at x follows the branches from
their normal modes anew (`find_orbit`), and the implicit function theorem at the root gives what is
known of the orbits as functions of x: no iteration is differentiated, and one compiled program
serves all branches, losses and free parameters.

- goal `zero`: of the solutions of loss = 0 within the bounds the nearest one, the least |x|^2/2.
  SciPy's SLSQP (sequential quadratic programming): each step is the nearest solution of the
  linearised equations within the bounds. A last Newton step gives the digits.
- goal `minimum`: optax's L-BFGS, projected onto the bounds. Its steps are combinations of
  gradients, so that x stays at right angles to whatever the loss does not depend on: of a scale
  that does not matter the nearest value is kept.

Both step back where an orbit is not to be had, and say so if that is where they are stopped.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dpend._runtime import require_float64
from dpend.checks import Scalar, function, integer, is_traced, known_number, one_of, several, shown
from dpend.inverse.nearest import least_on_bounds, loss_itself, nearest_of_many, nearest_of_one
from dpend.inverse.problem import PARAMETERS, DesignProblem, Look
from dpend.mechanics.pendulum import Pendulum, check_pendulum
from dpend.orbits.find import swinging_pendulum
from dpend.orbits.orbit import BRANCHES, PeriodicOrbit
from dpend.records import outcome, span
from dpend.status import message

GOALS = ("zero", "minimum")

# Without bounds of its own, a parameter may grow and shrink by this factor. Branches are known to
# be followed as far.
_FACTOR = 10.0
# Branches end at theta1 = pi; theta1 stays below this.
_LARGEST_ANGLE = math.pi * (1 - 1e-12)
# Without bounds of its own, theta1 does not exceed this.
_LARGEST_WITHOUT_BOUNDS = 0.999 * math.pi


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
        sensitivities: derivatives with respect to the logarithm of each of l1, l2, m1, m2, g and
            theta1, free or not: `sensitivities["loss"]["l1"]` is d loss/d ln l1; beside `loss`
            there are `theta2` [rad], `period` [s] and `kappa`, of one orbit scalars, of several one
            a branch.
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
        return message(self.status)

    def to_dataframe(self) -> Any:
        """A row for each of its orbits, see `PeriodicOrbit.to_dataframe`."""
        return self._stacked().to_dataframe()

    def to_xarray(self) -> Any:
        """Its orbits, see `PeriodicOrbit.to_xarray`, with their sensitivities over `orbit` and
        `parameter`.
        """
        found = self._stacked().to_xarray()
        for of in ("theta2", "period", "kappa"):
            rows = np.array([np.atleast_1d(row) for row in self.sensitivities[of].values()])
            found[f"{of}_sensitivity"] = (("parameter", "orbit"), rows)
        return found.assign_coords(parameter=list(self.sensitivities["period"]))

    def _stacked(self) -> PeriodicOrbit:
        return jax.tree.map(lambda *leaves: np.stack(leaves), *self.orbits)

    def __repr__(self) -> str:
        told = ", ".join(span(name, of) for name, of in vars(self.pendulum).items())
        loss = f"{span('loss', self.loss)}, {span('iterations', self.iterations)}"
        return f"<Design: {told}, {loss}, {outcome(self.status)}>"


# The public signature asks for more than seven parameters.
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

    `goal="zero"` solves loss = 0; where there are more free parameters than equations it takes the
    solution with the least sum of squares of ln(parameter/start), by the Lagrange conditions, which
    hold at the nearest solution, and at others only if the solutions are strongly bent.
    `goal="minimum"` makes the loss as small as it gets near the start. Both find what Newton's
    method and descent lead to: where there are several, not always the best. For instance

        lambda orbit: orbit.period - 1.0                          # 1 s
        lambda orbit: orbit.kappa                            # in the middle of the stable range
        lambda slow, fast: slow.period - 2 * fast.period     # branch=("in-phase", "anti-phase")
        lambda wide, small: wide.period - small.period       # two of "in-phase", theta1=(1.0, 0.1)

    Arguments:
        loss: of one orbit, or of as many as there are branches, traceable: a scalar or, of goal
            `zero`, a vector of as many equations; the orbit's `pendulum` carries derivatives too,
            so that `normal_modes(orbit.pendulum)` and its like may be asked. It is compiled once
            for each function: define it once, not in a loop.
        pendulum: to start from.
        free: names among l1, l2, m1, m2, g and theta1. Scales that do not matter (both masses) may
            be free: the nearest solution leaves them as they are.
        branch: `in-phase` or `anti-phase`, or a sequence of them, one for each orbit that the loss
            is told.
        theta1: release angle [rad], between 0 and pi, or one for each branch; the start, if it is
            free, which only one angle can be.
        goal: `zero` or `minimum`.
        bounds: {name: (low, high)} in the parameter's unit; a tenth and ten times the start where
            none are given, and for theta1 no more than pi.
        max_iterations: steps at most.
    Returns:
        Design. If its status is not `Status.CONVERGED` it holds the best so far: `NO_SOLUTION` if
        the bounds hold none near the start (the least sum of squares is returned), `LEFT_BRANCH` or
        `NO_SUCH_ORBIT` if it was stopped where a branch does not get to its release.
    Raises:
        ValueError: an unknown or repeated name in free; more equations than free parameters; goal
            `minimum` of a vector; bounds not positive, of a parameter that is not free, or without
            the start; an unknown branch or goal; theta1 out of range; g not positive; values traced
            by `jit`.
        RuntimeError: float64 is switched off in JAX.
    """
    require_float64()
    function("loss", loss, "an orbit", "lambda orbit: orbit.kappa")
    check_pendulum(pendulum)
    if any(is_traced(leaf) for leaf in jax.tree.leaves((pendulum, theta1))):
        raise ValueError(
            "pendulum and theta1 must be numbers, not traced by jit or a derivative: design "
            "outside of it"
        )
    start = swinging_pendulum(pendulum)
    branches, angles = _read_orbits(branch, theta1)
    names = _names(free)
    if "theta1" in names and not np.isscalar(theta1) and len(angles) > 1:
        raise ValueError(
            f"theta1 can be free only if it is one angle, got {len(angles)}: leave it out of free"
        )
    goal, max_iterations = one_of("goal", goal, GOALS), integer("max_iterations", max_iterations)
    values = dict(zip(PARAMETERS, [*jax.tree.leaves(start), angles[0]], strict=True))
    low, high = _box(values, names, bounds)
    problem = DesignProblem(loss, start, branches, angles, low, high)
    first = problem.at(np.zeros(len(PARAMETERS)))
    _check_equations(goal, first.value.size, len(names))
    if not first.sound:
        return _result(problem, first, 0, first.status)
    if goal == "minimum":
        return _result(problem, *least_on_bounds(problem, first, max_iterations, loss_itself))
    solve = nearest_of_one if len(names) == 1 else nearest_of_many
    return _result(problem, *solve(problem, first, max_iterations))


def _check_equations(goal: str, equations: int, unknowns: int) -> None:
    if goal == "minimum" and equations != 1:
        raise ValueError(
            f"loss must be a scalar for a minimum, got {equations} values: add them up"
        )
    if goal == "zero" and not 1 <= equations <= unknowns:
        raise ValueError(
            f"free must name as many parameters as there are equations or more, got {unknowns} for "
            f"{equations}: name others too, or ask for the minimum of a scalar"
        )


def _read_orbits(branch: Any, theta1: Any) -> tuple[tuple[str, ...], tuple[float, ...]]:
    """Branches and angles, one each for every orbit."""
    branches = (branch,) if isinstance(branch, str) else branch
    if not isinstance(branches, Sequence) or not branches:
        raise ValueError(
            f"branch must be one of {', '.join(BRANCHES)}, or a sequence of them, got "
            f"{shown(branch)}: give such"
        )
    branches = tuple(one_of("branch", one, BRANCHES) for one in branches)
    listed = isinstance(theta1, (list, tuple)) or (
        isinstance(theta1, (np.ndarray, jax.Array)) and theta1.ndim > 0
    )
    angles = tuple(theta1) if listed else (theta1,) * len(branches)
    if len(angles) != len(branches):
        raise ValueError(
            f"theta1 must be one angle, or one a branch, got {len(angles)} for {len(branches)}: "
            f"give {len(branches)}"
        )
    known = tuple(known_number("theta1", angle, unit="rad") for angle in angles)
    for angle in known:
        if not 0 < angle < _LARGEST_ANGLE:
            raise ValueError(
                f"theta1 must be between 0 and pi [rad], got {angle:g}: give another theta1"
            )
    return branches, known


def _names(free: Any) -> tuple[str, ...]:
    names = (free,) if isinstance(free, str) else free
    sound = isinstance(names, Sequence) and all(
        isinstance(name, str) and name in PARAMETERS for name in names
    )
    if not sound or not names:
        raise ValueError(
            f"free must name one or more of {', '.join(PARAMETERS)}, got {shown(free)}: give names "
            f"like ('l1', 'l2')"
        )
    if len(set(names)) < len(names):
        raise ValueError(f"free must name each parameter once, got {shown(free)}: leave one out")
    return tuple(names)


def _box(
    values: dict[str, float], names: tuple[str, ...], bounds: Any
) -> tuple[np.ndarray, np.ndarray]:
    """The bounds of x."""
    given = {} if bounds is None else bounds
    if not isinstance(given, Mapping):
        raise ValueError(
            f"bounds must be a dictionary like {{'l1': (0.1, 0.5)}}, got {shown(bounds)}: give one"
        )
    low, high = np.zeros(len(PARAMETERS)), np.zeros(len(PARAMETERS))
    for name in given:
        if name not in names:
            raise ValueError(
                f"bounds must be of parameters that are free, got {name!r}: free are "
                f"{', '.join(names)}"
            )
    for name in names:
        i, start = PARAMETERS.index(name), values[name]
        least, most = _bounds_of(name, start, given)
        low[i], high[i] = math.log(least / start), math.log(most / start)
    return low, high


def _bounds_of(name: str, start: float, given: Mapping[str, Any]) -> tuple[float, float]:
    """The bounds of a parameter in its unit."""
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
        raise ValueError(
            f"bounds of theta1 must be below pi [rad], got {most:g}: give another upper bound"
        )
    return least, most


def _result(problem: DesignProblem, look: Look, steps: int, status: int) -> Design:
    free = problem.free
    at = (look.x[free] <= problem.low[free]) | (look.x[free] >= problem.high[free])
    return Design(
        pendulum=look.orbits[0].pendulum,
        orbits=look.orbits,
        theta1=tuple(orbit.theta1 for orbit in look.orbits),
        loss=jnp.asarray(look.value[0] if look.value.size == 1 else look.value),
        distance=jnp.asarray(np.linalg.norm(look.x)),
        sensitivities=_sensitivities(look),
        iterations=jnp.asarray(steps),
        looks=jnp.asarray(problem.looks),
        status=jnp.asarray(int(status)),
        at_bounds=tuple(PARAMETERS[i] for i in free[at]),
    )


def _sensitivities(look: Look) -> dict[str, dict[str, Scalar]]:
    """Derivatives of the loss and of the orbits with respect to the logarithms of `PARAMETERS`."""
    rows = []
    for orbit, slope in zip(look.orbits, look.slopes, strict=True):
        rate = np.asarray(slope) * np.array([*jax.tree.leaves(orbit.pendulum), orbit.theta1])
        rows.append([rate[0], rate[1] * float(orbit.period), rate[2]])
    by_orbit = np.swapaxes(np.array(rows), 0, 1)
    table = {"loss": look.jacobian[0] if look.value.size == 1 else look.jacobian}
    for name, each in zip(("theta2", "period", "kappa"), by_orbit, strict=True):
        table[name] = each[0] if len(rows) == 1 else each
    return {
        name: {key: jnp.asarray(each[..., i]) for i, key in enumerate(PARAMETERS)}
        for name, each in table.items()
    }
