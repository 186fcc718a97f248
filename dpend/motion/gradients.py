"""Is this gradient right, and does it mean anything? Derivatives checked against differences; how
far a motion's reach.

`check_gradient` sets what JAX makes of a loss, forwards and in reverse, beside central finite
differences extrapolated to step zero, which see nothing but the loss's values: for orbits, which
are solved again for every difference, it is their implicit derivatives that are checked so.

Of a chaotic motion derivatives grow like the tangents, e^(lambda t), and the errors of the motion
that they belong to grow with them. Differences see it first, since no step is both short enough for
the motion to stay close by and long enough for rounding; then the derivatives themselves go, which
`gradient_horizon` measures.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree

from dpend._runtime import require_float64
from dpend.checks import Scalar, flag, function, known_number, numbers, several, shown
from dpend.mechanics.pendulum import Pendulum, State, check_motion
from dpend.mechanics.units import Norm, norm
from dpend.methods.scheme import Scheme, check_scheme
from dpend.motion.integrate import march, step_size
from dpend.status import Status, message

# The largest step of the differences, in units of the parameter: four extrapolations from there
# make a smooth loss exact.
_LARGEST_STEP = 2.0**-5
# Each step is so many times shorter than the one before.
_RATIO = 4.0
# So many steps: at the last of them rounding is all there is.
_LEVELS = 15
# A derivative below this share of the loss itself counts as zero.
_NOTHING = 1e-7
_MOTION = "(pendulum, state, duration, scheme)"
# Times at which a horizon is looked for: a hundredth of it is known no better.
_TIMES = 256
# The disagreement that error estimates may hide, in units of them: they are good to a small factor.
_DOUBT = 10.0


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class GradientHorizon:
    """How far the derivatives of a motion can be believed.

    Attributes:
        time: from the start on [s], shape (n,).
        growth: of tangents by then, root mean square over all directions, measured as on the page
            of `chaos`. The derivative describes a change of the start [rad] only while that times
            the growth is well below 1.
        error: of the derivatives, relative to them: the change on halving the step, and at least
            the growth of rounding, growth times 2^-52; the largest so far.
        horizon: the last of the times at which the error is within the tolerance [s].
        status: `BEYOND_HORIZON` if that is before the end.
    """

    time: Scalar
    growth: Scalar
    error: Scalar
    horizon: Scalar
    status: Scalar


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class GradientCheck:
    """The derivatives of a loss in three ways; all trees are shaped like its parameters.

    Attributes:
        value: of the loss.
        forward: by `jax.jvp`.
        reverse: by `jax.vjp`; NaN if it was not asked for.
        difference: by central differences, extrapolated.
        difference_error: an estimate of their errors.
        disagreement: of the worst derivative, forward or reverse, from the differences. Here
            derivatives are multiplied by the size of their parameter (1 for zeros), and divided by
            the largest of them.
        difference_noise: the worst of the differences' errors, divided by the largest of the
            differences: no better agreement can be seen.
        horizon: of the motion that was given, or None.
        status: `CONVERGED` if they agree to the tolerance, `DISAGREEMENT` if they differ by more
            than that and ten times the noise, `BEYOND_HORIZON` if the noise is above the tolerance
            or the motion outlasts its horizon, `NONFINITE`.
    """

    value: Scalar
    forward: Any
    reverse: Any
    difference: Any
    difference_error: Any
    disagreement: Scalar
    difference_noise: Scalar
    horizon: GradientHorizon | None
    status: Scalar

    @property
    def message(self) -> str:
        """The sentence that says what its status means."""
        return message(self.status)


def check_gradient(
    loss: Any,
    parameters: Any,
    *,
    tolerance: Any = 1e-6,
    reverse: bool | Any = True,
    motion: tuple[Any, Any, Any, Any] | Any | None = None,
) -> GradientCheck:
    """The derivatives of `loss` at `parameters`, forwards, in reverse, and by finite differences.

    Each difference is (f(x + h) - f(x - h))/2h for 15 steps h from 1/32 of the parameter down to
    1e-10 of it, extrapolated by Romberg's scheme; of the whole table the entry is taken whose
    neighbours differ least, or whose rounding is less. It costs 30 evaluations for each number
    among the parameters. A kink of which JAX takes the mean slope is not seen.

    Arguments:
        loss: of the parameters, a scalar. It is called as it is: hand over `jax.jit` of it if that
            can be.
        parameters: a tree of numbers and arrays of them, such as `0.2`, a dictionary, a `Pendulum`
            or a `State`.
        tolerance: relative; 1e-6 leaves room for orbits, which are known to 1e-13.
        reverse: False for a loss of which only forward derivatives exist, such as motions of a
            traced duration.
        motion: (pendulum, state, duration, scheme) that the loss follows, for its
            `gradient_horizon`.
    Returns:
        GradientCheck.
    Raises:
        ValueError: a loss that is not a scalar; parameters that are not finite numbers; no
            parameters; tolerance not positive; as `gradient_horizon`.
        RuntimeError: float64 is switched off in JAX.
    """
    require_float64()
    function("loss", loss, "the parameters", "lambda x: x**2")
    tolerance = known_number("tolerance", tolerance, positive=True)
    reverse = flag("reverse", reverse)
    point, tree = _flat(parameters)
    horizon = None if motion is None else gradient_horizon(*several("motion", motion, _MOTION, 4))
    value = jnp.asarray(loss(tree(point)))
    if value.shape != () or not jnp.issubdtype(value.dtype, jnp.floating):
        raise ValueError(
            f"loss must give a real scalar, got {value.dtype} of shape {value.shape}: add it up"
        )

    def of(x: Scalar) -> Scalar:
        return jnp.asarray(loss(tree(x)), jnp.float64)

    forward = np.array([jax.jvp(of, (point,), (unit,))[1] for unit in jnp.eye(point.size)])
    backward = np.full(point.size, np.nan)
    if reverse:
        _, pull = jax.vjp(of, point)
        backward = np.asarray(pull(jnp.ones(()))[0])
    pairs = [_differentiate(of, np.asarray(point), i) for i in range(point.size)]
    difference, errors = np.array(pairs).T
    analytic = [forward, backward] if reverse else [forward]
    size = np.where(np.asarray(point) == 0, 1.0, np.abs(point))
    least = max(_NOTHING * abs(float(value)), np.finfo(float).tiny)
    own = max(float(np.max(np.abs(difference) * size)), least)
    unit = max(float(np.max(np.abs(forward) * size)), own)
    apart = max(float(np.max(np.abs(one - difference) * size)) / unit for one in analytic)
    noise = float(np.max(errors * size)) / own
    status = _verdict(apart, noise, tolerance, horizon, bool(np.all(np.isfinite(analytic))))
    return GradientCheck(
        value=value,
        forward=tree(jnp.asarray(forward)),
        reverse=tree(jnp.asarray(backward)),
        difference=tree(jnp.asarray(difference)),
        difference_error=tree(jnp.asarray(errors)),
        disagreement=jnp.asarray(apart),
        difference_noise=jnp.asarray(noise),
        horizon=horizon,
        status=jnp.asarray(int(status)),
    )


def _verdict(
    apart: float, noise: float, tolerance: float, horizon: GradientHorizon | None, finite: bool
) -> Status:
    if not finite:
        return Status.NONFINITE
    if horizon is not None and horizon.status != Status.CONVERGED:
        return Status.BEYOND_HORIZON
    if apart > tolerance + _DOUBT * noise:
        return Status.DISAGREEMENT
    return Status.CONVERGED if noise <= tolerance else Status.BEYOND_HORIZON


def _flat(parameters: Any) -> tuple[Any, Callable[[Any], Any]]:
    """The parameters as one vector, and the way back."""
    try:
        leaves = [numbers("parameters", leaf) for leaf in jax.tree.leaves(parameters)]
    except ValueError:
        raise ValueError(
            f"parameters must be finite numbers, not traced by jit, got {shown(parameters)}: give "
            f"numbers"
        ) from None
    finite = all(np.all(np.isfinite(leaf)) for leaf in leaves)
    if not sum(leaf.size for leaf in leaves) or not finite:
        raise ValueError(
            f"parameters must be one finite number or more, got {shown(parameters)}: give others"
        )
    arrays = [jnp.asarray(leaf) for leaf in leaves]
    return ravel_pytree(jax.tree.unflatten(jax.tree.structure(parameters), arrays))


def _differentiate(of: Callable[[Any], Any], point: np.ndarray, i: int) -> tuple[float, float]:
    """The derivative along coordinate i by extrapolated central differences, and an estimate of its
    error.
    """
    unit = abs(point[i]) or 1.0
    best, error, least = math.nan, math.inf, math.inf
    nothing = math.nan
    above: list[float] = []  # the row for the step before: D, and its extrapolations
    for level in range(_LEVELS):
        ends = point[i] + np.array([1.0, -1.0]) * (unit * _LARGEST_STEP / _RATIO**level)
        points = [np.where(np.arange(point.size) == i, end, point) for end in ends]
        values = [float(of(jnp.asarray(one))) for one in points]
        step, largest = ends[0] - ends[1], max(abs(value) for value in values)
        nothing = nothing if nothing > 0 else _NOTHING * largest / unit
        row = [(values[0] - values[1]) / step]
        rounding = np.finfo(float).eps * largest / step
        for order, coarse in enumerate(above, start=1):
            row.append(row[-1] + (row[-1] - coarse) / (_RATIO ** (2 * order) - 1))
            doubt = max(abs(row[-1] - row[-2]), abs(row[-1] - coarse)) + rounding
            # Relative to itself: of a chaotic loss the differences over large steps are small, and
            # so are their doubts.
            relative = doubt / (abs(row[-1]) + nothing + np.finfo(float).tiny)
            if relative < least:  # False where a value was not finite
                best, error, least = row[-1], doubt, relative
        above = row
    return best, error


def gradient_horizon(
    pendulum: Pendulum | Any,
    state: State | Any,
    duration: Any,
    scheme: Scheme | Any,
    *,
    tolerance: Any = 1e-3,
) -> GradientHorizon:
    """How long the derivatives of a motion with respect to its start and its pendulum are right to
    `tolerance`.

    The motion and its four tangents are integrated at the step and at half of it, side by side:
    what the derivatives change by is their error, of the method and of rounding alike. Both grow
    like the tangents do, so that in chaos the horizon grows only like the logarithm of the
    accuracy.

    Arguments:
        pendulum, state: leaves are numbers.
        duration: how far to look [s]; negative looks backwards.
        scheme: method and step, one of even steps.
        tolerance: of the derivatives, relative.
    Returns:
        GradientHorizon, at 256 even times or every step.
    Raises:
        ValueError: duration not a finite number or shorter than a step; tolerance not positive; a
            scheme of uneven steps.
        RuntimeError: float64 is switched off in JAX.
    """
    require_float64()
    check_motion(pendulum, state)
    check_scheme(scheme)
    known = known_number("duration", duration, unit="s")
    tolerance = known_number("tolerance", tolerance, positive=True)
    if not scheme.even:
        raise ValueError(
            f"scheme must take even steps, got {scheme.name!r}: give rk8-circle or rk8"
        )
    steps = scheme.steps(known)
    if not steps:
        raise ValueError("duration must not be zero, got 0 s: give a longer one")
    marks = np.unique(np.arange(_TIMES + 1) * steps // _TIMES)
    counts = np.pad(np.diff(marks), (0, _TIMES + 1 - len(marks)))
    method = Scheme(scheme.name, 1.0, written_out=False)  # one compiled program for all steps
    state = jax.tree.map(partial(jnp.asarray, dtype=jnp.float64), state)
    growth, error = (
        np.asarray(part)[: len(marks)]
        for part in _compare_tangents(
            pendulum, state, step_size(known, steps), jnp.asarray(counts), method
        )
    )
    error = np.maximum.accumulate(np.where(np.isfinite(error), error, np.inf))
    time = marks * (known / steps)
    good = int(np.sum(error <= tolerance))
    return GradientHorizon(
        time=jnp.asarray(time),
        growth=jnp.asarray(growth),
        error=jnp.asarray(error),
        horizon=jnp.asarray(time[max(good - 1, 0)]),
        status=jnp.asarray(int(Status.CONVERGED if good == len(time) else Status.BEYOND_HORIZON)),
    )


@partial(jax.jit, static_argnames="method")
def _compare_tangents(
    pendulum: Pendulum, state: State, dt: Scalar, counts: Scalar, method: Scheme
) -> tuple[Scalar, Scalar]:
    """Growth and relative error of the tangents at the start and after each of `counts` steps
    more.
    """
    size = norm(pendulum)
    whole, half = method.constants(pendulum, dt), method.constants(pendulum, dt / 2)

    def step(both: Any, time: Scalar, dt: Scalar) -> Any:
        coarse, fine = both
        fine = method.move_tangents(half, *method.move_tangents(half, *fine))
        return method.move_tangents(whole, *coarse), fine

    def look(both: Any, count: Scalar) -> tuple[Any, tuple[Scalar, Scalar]]:
        both = march(step, both, dt, count)
        (_, coarse), (_, fine) = both
        growth = _length(size, fine)
        error = _length(size, jax.tree.map(jnp.subtract, coarse, fine)) / growth
        return both, (growth, jnp.maximum(error, jnp.finfo(jnp.float64).eps * growth))

    basis = jnp.eye(4)
    tangents = State(basis[0], basis[1], basis[2] / size.per_unit1, basis[3] / size.per_unit2)
    start = method.enter(pendulum, state), tangents
    return lax.scan(look, (start, start), jnp.concatenate([jnp.zeros_like(counts[:1]), counts]))[1]


def _length(size: Norm, tangents: State) -> Scalar:
    """Root mean square of the sizes of four tangents."""
    return jnp.sqrt(jnp.mean(size.square(tangents)))
