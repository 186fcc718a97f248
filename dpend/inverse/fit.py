"""A pendulum from measured angles: lengths, masses, gravity and the state at the first time, with
their errors.

A chaotic motion forgets where it began after a second or so, and the sum of squares as a function
of the initial state then has a minimum at every turn. So the motion is cut into short windows
(`windows`), whose initial states all start from the data, as local cubics through them, whatever
the parameters are. Their ends are first allowed to miss the next window at a price, which three
rounds of Levenberg and Marquardt's iteration raise, and then made to meet by Gauss and Newton's.
Where a rod is not seen, the windows are added a few at a time, each beginning where the motion
fitted so far leads; for the first of them a grid of states of the hidden rod is tried.

Only l2/l1, m2/m1 and g/l1 enter the angles, which is why one of l1, l2, g and one of m1, m2 are
held.
"""

import math
from dataclasses import dataclass, field
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dpend._runtime import require_float64
from dpend.checks import Scalar, known_number, several, shown
from dpend.inverse.gauss_newton import ROUNDED, Found, refined, solved
from dpend.inverse.measurements import FEWEST, Angles, checked, wrapped
from dpend.inverse.search import FIRST, MOSTLY, all_at_once, smoothed, window_by_window
from dpend.inverse.windows import (
    MOST_TURN,
    Point,
    Problem,
    Settings,
    fitted_angles,
    laid_out,
    settings_for,
)
from dpend.mechanics.pendulum import (
    Pendulum,
    State,
    fast_frequency,
    known_pendulum,
    momenta,
    normal_modes,
)
from dpend.records import units_of
from dpend.status import Status

# How a free field moves the logarithms of l2/l1, m2/m1 and g/l1.
_BY_FIELD = {"l1": (-1, 0, -1), "l2": (1, 0, 0), "m1": (0, -1, 0), "m2": (0, 1, 0), "g": (0, 0, 1)}
RATIOS = ("l2/l1", "m2/m1", "g/l1")
INITIAL = ("theta1", "theta2", "omega1", "omega2")

# The fitted misses may be this many times what was expected, and as much more as chance makes of
# few; neighbouring ones may be correlated so much; below so many radians they are what integration
# and rounding leave.
_MORE_THAN_NOISE, _CORRELATED, _NO_NOISE = 1.5, 0.5, 1e-6


class _Knowledge(NamedTuple):
    covariance: (
        np.ndarray
    )  # of the fields' logarithms, then of the first node; infinite where nothing is known
    ratios: np.ndarray  # (3,), standard errors of the logarithms of the ratios
    determined: bool


def _knowledge(problem: Problem, found: Found, settings: Settings, noise: float) -> _Knowledge:
    """Covariances at the solution; what depends on an axis of the fields that the data do not
    determine is infinite.
    """
    free, step = problem.by_free.shape[1], found.step
    if step is None:
        return _Knowledge(np.full((free + 4, free + 4), np.nan), np.full(3, np.nan), False)
    weights, axes = np.linalg.eigh(step.information)
    known = weights > max(settings.noise**2, ROUNDED * float(np.max(np.abs(weights), initial=0.0)))
    errors = np.where(known, noise / np.sqrt(np.where(known, weights, 1.0)), np.inf)
    loose = settings.rate * (problem.times[-1] - problem.times[0]) * errors > _PHASE
    for j in np.flatnonzero(known & loose).tolist():
        known[j] = _is_bounded(
            problem, found, settings, noise, min(_FAR_OFF * float(errors[j]), 1.0), axes, j
        )
    inverse = (axes[:, known] / weights[known]) @ axes[:, known].T
    moves = np.vstack([np.eye(free), step.response[:, :, 0].T])
    covariance = moves @ inverse @ moves.T
    covariance[free:, free:] += step.alone
    covariance *= noise**2
    deviations = np.sqrt(np.diag(covariance))
    unknown = np.any(np.abs(moves @ axes[:, ~known]) > deviations[:, None], axis=1)
    unknown[free : free + 2] |= deviations[free : free + 2] > 1.0
    covariance[unknown], covariance[:, unknown] = np.nan, np.nan
    covariance[unknown, unknown] = np.inf
    ratios = np.sqrt(np.diag(problem.by_free @ inverse @ problem.by_free.T)) * noise
    lost = np.any(np.abs(problem.by_free @ axes[:, ~known]) > ratios[:, None], axis=1)
    return _Knowledge(covariance, np.where(lost, np.inf, ratios), not np.any(unknown))


# A mode that is not excited is fitted to the noise, and its frequency comes out with a small formal
# error: a phase of more than this [rad] over the data is worth a look. There, the sum of squares
# this many standard errors away, at most a factor of e, must have grown by so many variances of the
# noise; no frequency in pure noise stands out by as much.
_PHASE, _FAR_OFF, _GROWN = 0.3, 10.0, 30.0


def _is_bounded(
    problem: Problem,
    found: Found,
    settings: Settings,
    noise: float,
    far: float,
    axes: np.ndarray,
    j: int,
) -> bool:
    """Whether the sum of squares has grown much `far` along an axis, to either side, where all else
    is fitted again.
    """
    assert found.step is not None
    others = np.delete(axes, j, axis=1)
    for way in (far * axes[:, j], -far * axes[:, j]):
        shifted = problem._replace(
            logs=problem.logs + problem.by_free @ (found.point.fields + way),
            by_free=problem.by_free @ others,
        )
        nodes = found.point.nodes + np.tensordot(way, found.step.response, 1)
        aside = solved(shifted, Point(nodes, np.zeros(others.shape[1])), settings)
        grown = (aside.misses.squares - found.misses.squares) / max(noise, _LEAST_NOISE) ** 2
        if aside.step is not None and grown < _GROWN:
            return False
    return True


def _is_noise(residuals: np.ndarray, noise: float, expected: float, freedom: int) -> bool:
    """Whether what is left of the data is as large as was expected, and not the same from sample to
    sample.
    """
    if noise < _NO_NOISE:
        return True
    if noise > expected * (_MORE_THAN_NOISE + 3 / math.sqrt(freedom)):
        return False
    pairs = residuals[:, 1:] * residuals[:, :-1]
    there = np.isfinite(pairs)
    count = int(np.sum(there))
    return float(np.sum(pairs[there])) <= (_CORRELATED * count + 3 * math.sqrt(count)) * noise**2


def _status(
    problem: Problem, found: Found, determined: bool, noisy: bool, expected: float
) -> Status:
    """The verdict; also what keeps the iteration from closing the joints is a misfit where it was
    one before.
    """
    if found.status != Status.CONVERGED:
        far = found.misses.squares > problem.observations * (_MORE_THAN_NOISE * expected) ** 2
        return Status.MISFIT if far and found.status == Status.MAX_ITERATIONS else found.status
    return Status.MISFIT if not noisy else Status.CONVERGED if determined else Status.SINGULAR


# The units of what is estimated.
_ESTIMATED = units_of(Pendulum) | units_of(State)
_ESTIMATED |= {"l2/l1": "", "m2/m1": "", "g/l1": "1/s^2", "omega1": "rad/s", "omega2": "rad/s"}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Fit:
    """A pendulum fitted to measured angles.

    Attributes:
        pendulum: with the estimated values of the free fields.
        state: at the first time.
        estimates: of the free fields [SI], of the ratios `l2/l1`, `m2/m1` and `g/l1` [1/s^2], and
            of the state at the first time, `theta1`, `theta2` [rad], `omega1`, `omega2` [rad/s].
        standard_errors: of the same, from the Jacobian of the constrained problem and the noise; 0
            for what was held, infinity for what the data do not determine, NaN where there was
            nothing to compute them from.
        covariance: of the free fields, then of theta1, theta2, omega1, omega2, in this order, shape
            (n, n).
        time: the times [s], shape (m,).
        theta1, theta2: the fitted motion there [rad], continuous.
        residual1, residual2: measured minus fitted, modulo full turns [rad]; NaN where nothing was
            measured.
        noise: standard deviation of the measured angles about the fit [rad].
        expected_noise: as given, or as local cubics through the data leave it [rad].
        gap: the largest miss at a joint of two windows [rad, rad/s].
        windows: how many there were.
        iterations: how often the motion was linearised.
        error_estimate: the largest change of a free field, relative, on going on at half the
            integration step.
        status: a value of `Status`: `MISFIT` where the residuals are far above the expected noise
            or correlated, `SINGULAR` where something asked for is not determined.
        free: the names of the free fields.
    """

    pendulum: Pendulum
    state: State
    estimates: Annotated[dict[str, Scalar], _ESTIMATED]
    standard_errors: Annotated[dict[str, Scalar], _ESTIMATED]
    covariance: Scalar
    time: Scalar
    theta1: Scalar
    theta2: Scalar
    residual1: Scalar
    residual2: Scalar
    noise: Annotated[Scalar, "rad"]
    expected_noise: Annotated[Scalar, "rad"]
    gap: Scalar
    windows: Scalar
    iterations: Scalar
    error_estimate: Scalar
    status: Scalar
    free: tuple[str, ...] = field(metadata={"static": True})


def fit_parameters(
    times: Any,
    theta1: Any,
    theta2: Any,
    *,
    pendulum: Any = None,
    free: Any = ("l2", "m2", "g"),
    initial: Any = (None, None, None, None),
    noise: Any = None,
) -> Fit:
    """The pendulum, and the state at the first time, whose motion is nearest to measured angles.

    Minimises the sum of squares of theta_model - theta_measured, modulo full turns, over both rods
    and all times; the noise is taken to be independent, Gaussian and as large for both. Chaotic
    motions are no harder than calm ones: the docstring of this module tells how. Angles may be
    wrapped or not. Where one rod is not measured at all, its first angle and velocity are sought on
    a grid.

    Arguments:
        times: increasing [s], shape (m,), in any spacing that shows the swings.
        theta1, theta2: absolute angles [rad], shape (m,), NaN where nothing was measured; None for
            a rod never seen. One of them is measured at the first time.
        pendulum: the values of what is held, and where the search for the rest starts; the default
            `Pendulum()`. Factors of two off are no trouble where both rods are seen, a third where
            only one is.
        free: which of `l1`, `l2`, `m1`, `m2`, `g` to estimate. As only ratios enter, one of l1, l2,
            g and one of m1, m2 are held.
        initial: theta1, theta2 [rad], omega1, omega2 [rad/s] at the first time, None where it is
            estimated; (None, None, 0, 0) is a release from rest.
        noise: standard deviation of the angles [rad], if it is known; the standard errors then rest
            on it, and otherwise on the residuals.
    Returns:
        Fit; its `status` says whether it may be believed.
    Raises:
        ValueError: a free set with the overall length or mass in it, an unknown or repeated name;
            times that do not increase or are too far apart; arrays of other lengths, infinite, with
            fewer than 7 angles of a rod, or with fewer than there are unknowns; angles that look
            like degrees; nothing measured at the first time; initial values that are no such
            numbers; noise below 1e-15 or above pi rad; a pendulum with l2/l1 or m2/m1 beyond 1e9 or
            below 1e-9, or whose fast mode is too fast for the samples; g zero and free.
        RuntimeError: float64 is switched off in JAX.
    """
    require_float64()
    numbers = known_pendulum(Pendulum() if pendulum is None else pendulum)
    names = _checked_free(free)
    if "g" in names and numbers.g == 0:
        raise ValueError(
            "g must not start at 0 where it is free, got 0: give its sign and size by a start "
            "above or below"
        )
    held = _checked_initial(initial)
    sigma = None if noise is None else _checked_noise(noise)
    _check_shape(numbers)
    series = checked(times, theta1, theta2)
    unknowns = len(names) + held.count(None)
    count = int(np.sum(np.isfinite(series.values)))
    if count < unknowns + FEWEST:
        raise ValueError(
            f"times must be more for {unknowns} unknowns, got {count} angles: give "
            f"{unknowns + FEWEST}"
        )
    with np.errstate(all="ignore"):  # what overflows is told by the status
        return _fitted(series, numbers, names, held, sigma)


def _checked_free(free: Any) -> tuple[str, ...]:
    names = (free,) if isinstance(free, str) or not hasattr(free, "__iter__") else tuple(free)
    for name in names:
        if not isinstance(name, str) or name not in _BY_FIELD or names.count(name) > 1:
            listed = ", ".join(name if isinstance(name, str) else shown(name) for name in names)
            raise ValueError(
                f"free must hold each of {', '.join(_BY_FIELD)} once at most, got {listed}: give "
                f"names like ('l2', 'g')"
            )
    if {"l1", "l2", "g"} <= set(names):
        raise ValueError(
            "free must not hold l1, l2 and g: only l2/l1 and g/l1 enter the angles: fix one of l1, "
            "l2, g"
        )
    if {"m1", "m2"} <= set(names):
        raise ValueError(
            "free must not hold m1 and m2: only m2/m1 enters the angles: fix one of m1, m2"
        )
    return names


# Angles of a radian are rounded by this much [rad], and no motion in doubles is known to less.
_LEAST_NOISE = 1e-15
# Of two lengths or masses: beyond this ratio what the lighter or shorter does is lost in rounding,
# or it overflows.
_MOST_UNEQUAL = 1e9


def _checked_noise(noise: Any) -> float:
    sigma = float(known_number("noise", noise, positive=True, unit="rad"))
    if not _LEAST_NOISE <= sigma <= math.pi:
        raise ValueError(
            f"noise must be from {_LEAST_NOISE:g} rad, where doubles round, to pi rad, half a "
            f"turn, "
            f"got {sigma:.3g} rad ({math.degrees(sigma):.3g} deg): give that of one angle, or none"
        )
    return sigma


def _check_shape(pendulum: Pendulum) -> None:
    """Refuses a start from which no search can go on: ratios that doubles cannot hold beside 1."""
    for over, under in (("l2", "l1"), ("m2", "m1")):
        ratio = float(getattr(pendulum, over)) / float(getattr(pendulum, under))
        if not 1 / _MOST_UNEQUAL <= ratio <= _MOST_UNEQUAL:
            raise ValueError(
                f"pendulum must have {over}/{under} from {1 / _MOST_UNEQUAL:g} to "
                f"{_MOST_UNEQUAL:g}, got {ratio:.3g}: "
                f"give another {over} or {under}"
            )


def _checked_initial(initial: Any) -> tuple[float | None, ...]:
    values = several("initial", initial, f"{', '.join(INITIAL)}", len(INITIAL))
    return tuple(
        None if value is None else known_number(f"initial {name}", value)
        for name, value in zip(INITIAL, values, strict=True)
    )


def _fitted(
    series: Angles,
    pendulum: Pendulum,
    free: tuple[str, ...],
    initial: tuple[float | None, ...],
    sigma: float | None,
) -> Fit:
    rate = _rate(series, pendulum)
    by_free = np.array([_BY_FIELD[name] for name in free], float).reshape(-1, 3).T
    problem = laid_out(
        series, pendulum, by_free, np.array([value is not None for value in initial]), rate
    )
    _check_fast_mode(pendulum, float(np.max(problem.dts)))
    start = smoothed(problem, *series, initial, rate)
    expected = sigma or max(start.noise, _LEAST_NOISE)
    seen_at_first = bool(np.all(start.known[:, 0]))
    searches = [(window_by_window, first) for first in (FIRST[:1] if seen_at_first else FIRST)]
    if np.mean(np.all(start.known, axis=0)) > MOSTLY:
        searches.insert(0, (all_at_once, 0))
    total, fits = 0, []
    for search, first in searches:
        settings = settings_for(
            problem, start.nodes, start.known, rate, expected, np.zeros(len(free))
        )
        point, count = search(problem, start, settings, first)
        settings = settings_for(
            problem, point.nodes, np.ones_like(start.known), rate, expected, point.fields
        )
        found, settings, change = refined(problem, solved(problem, point, settings), settings)
        total += count + found.iterations
        fits.append(_result(series, pendulum, free, problem, found, settings, sigma, change, total))
        if found.step is not None and fits[-1].status in (Status.CONVERGED, Status.SINGULAR):
            return fits[-1]
    return min(
        fits, key=lambda fit: (fit.status != Status.MISFIT, np.nan_to_num(fit.noise, nan=np.inf))
    )


def _rate(series: Angles, pendulum: Pendulum) -> float:
    """What time is measured by [rad/s]: the slow mode, or rods that turn much faster."""
    times, values = series
    swing = (
        float(normal_modes(pendulum)[0].frequency)
        if pendulum.g > 0
        else math.sqrt(-float(pendulum.g / pendulum.l1))
    )
    turning = [
        np.median(np.abs(wrapped(np.diff(column[there]))) / np.diff(times[there]))
        for column in values
        if np.any(there := np.isfinite(column))
    ]
    rate = max(swing, float(np.max(turning)) / _FASTER, 1 / (times[-1] - times[0]))
    if not math.isfinite(rate):
        raise ValueError(
            f"times and pendulum must give finite rates, got l1 = {pendulum.l1:g} m, "
            f"g = {pendulum.g:g} m/s^2 and times {times[-1] - times[0]:.3g} s long: give SI units"
        )
    spacing = float(np.median(np.diff(times)))
    if spacing * rate > _COARSEST:
        raise ValueError(
            f"times must be at most {_COARSEST / rate:.2g} s apart in the median to follow this "
            f"pendulum, "
            f"got {spacing:.3g} s: give seconds, more samples, or a pendulum nearer to it"
        )
    if (times[-1] - times[0]) * rate > _LONGEST:
        raise ValueError(
            f"times must last at most {_LONGEST / rate:.2g} s with this pendulum, got "
            f"{times[-1] - times[0]:.3g} s: "
            "give seconds, or fewer of them"
        )
    return rate


# A chaotic motion's rods turn some times as fast as the slow mode, in the median: faster ones
# shorten the windows.
_FASTER = 4.0
# A quarter of a period between samples shows nothing of a swing; a million radians are a slip of
# the unit.
_COARSEST, _LONGEST = math.pi / 2, 1e6


def _check_fast_mode(pendulum: Pendulum, interval: float) -> None:
    """Refuses a start whose fast mode takes more integration steps from sample to sample than are
    ever made.
    """
    rate = float(fast_frequency(pendulum))
    if not rate * interval <= MOST_TURN:
        raise ValueError(
            f"pendulum must have a fast mode of at most {MOST_TURN / interval:.3g} rad/s to be "
            f"followed in intervals "
            f"of {interval:.3g} s, got {rate:.3g} rad/s: start nearer to what was measured, or "
            f"give more samples"
        )


def _result(
    series: Angles,
    pendulum: Pendulum,
    free: tuple[str, ...],
    problem: Problem,
    found: Found,
    settings: Settings,
    sigma: float | None,
    change: float,
    iterations: int,
) -> Fit:
    fitted = fitted_angles(problem, found.point, settings.steps[1], series)
    residuals = wrapped(series.values - fitted)
    noise = math.sqrt(found.misses.squares / problem.freedom)
    known = _knowledge(problem, found, settings, sigma or noise)
    noisy = _is_noise(residuals, noise, settings.noise, problem.freedom)
    factors = dict(zip(free, np.exp(found.point.fields), strict=True))
    values = {
        name: np.float64(getattr(pendulum, name) * factors.get(name, 1.0)) for name in _BY_FIELD
    }
    # Where nothing was fitted these are NaN, which no constructor takes: the status tells.
    best = jax.tree.unflatten(
        jax.tree.structure(pendulum), [jnp.asarray(value) for value in values.values()]
    )
    node = found.point.nodes[:, 0]
    ratios = np.array(
        [values["l2"] / values["l1"], values["m2"] / values["m1"], values["g"] / values["l1"]]
    )
    scale = np.append([values[name] for name in free], np.ones(4))
    covariance = known.covariance * np.outer(scale, scale)
    errors = np.sqrt(np.diag(covariance))
    names = (*free, *RATIOS, *INITIAL)
    estimates = np.concatenate([scale[: len(free)], ratios, node])
    deviations = np.concatenate(
        [errors[: len(free)], known.ratios * np.abs(ratios), errors[len(free) :]]
    )
    return Fit(
        pendulum=best,
        state=State(
            *(
                jnp.asarray(leaf)
                for leaf in jax.tree.leaves(momenta(best, *(jnp.asarray(x) for x in node)))
            )
        ),
        estimates=dict(zip(names, estimates, strict=True)),
        standard_errors=dict(zip(names, deviations, strict=True)),
        covariance=covariance,
        time=series.times,
        theta1=fitted[0],
        theta2=fitted[1],
        residual1=residuals[0],
        residual2=residuals[1],
        noise=np.float64(noise),
        expected_noise=np.float64(settings.noise),
        gap=np.float64(np.max(np.abs(found.misses.joints), initial=0.0)),
        windows=np.asarray(problem.times.size),
        iterations=np.asarray(iterations),
        error_estimate=np.float64(change),
        status=np.asarray(int(_status(problem, found, known.determined, noisy, settings.noise))),
        free=free,
    )
