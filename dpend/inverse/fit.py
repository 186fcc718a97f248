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
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dpend._runtime import require_float64
from dpend.checks import known_number, several, shown
from dpend.inverse.estimates import Fit
from dpend.inverse.gauss_newton import Found, close_joints, refine
from dpend.inverse.measurements import FEWEST, Angles, check_angles, wrap
from dpend.inverse.search import FIRST, MOSTLY, all_at_once, smooth_start, window_by_window
from dpend.inverse.uncertainty import (
    LEAST_NOISE,
    Uncertainty,
    find_uncertainty,
    fit_status,
    is_noise,
)
from dpend.inverse.windows import (
    Settings,
    WindowedData,
    angles_at_samples,
    check_fast_mode,
    lay_windows,
    settings_for,
    time_rate,
)
from dpend.mechanics.pendulum import (
    Pendulum,
    State,
    known_pendulum,
    momenta,
)
from dpend.status import Status

# How a free field moves the logarithms of l2/l1, m2/m1 and g/l1.
_BY_FIELD = {"l1": (-1, 0, -1), "l2": (1, 0, 0), "m1": (0, -1, 0), "m2": (0, 1, 0), "g": (0, 0, 1)}
RATIOS = ("l2/l1", "m2/m1", "g/l1")
INITIAL = ("theta1", "theta2", "omega1", "omega2")
# Of two lengths or masses: beyond this ratio rounding hides what the lighter or shorter one does.
_MOST_UNEQUAL = 1e9


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
    names = _check_free(free)
    if "g" in names and numbers.g == 0:
        raise ValueError(
            "g must not start at 0 where it is free, got 0: give its sign and size by a start "
            "above or below"
        )
    held = _check_initial(initial)
    sigma = None if noise is None else _check_noise(noise)
    _check_shape(numbers)
    series = check_angles(times, theta1, theta2)
    unknowns = len(names) + held.count(None)
    count = int(np.sum(np.isfinite(series.values)))
    if count < unknowns + FEWEST:
        raise ValueError(
            f"times must be more for {unknowns} unknowns, got {count} angles: give "
            f"{unknowns + FEWEST}"
        )
    with np.errstate(all="ignore"):  # what overflows is told by the status
        return _fit(series, numbers, names, held, sigma)


def _check_free(free: Any) -> tuple[str, ...]:
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


def _check_noise(noise: Any) -> float:
    sigma = float(known_number("noise", noise, positive=True, unit="rad"))
    if not LEAST_NOISE <= sigma <= math.pi:
        raise ValueError(
            f"noise must be from {LEAST_NOISE:g} rad, where doubles round, to pi rad, half a "
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


def _check_initial(initial: Any) -> tuple[float | None, ...]:
    values = several("initial", initial, f"{', '.join(INITIAL)}", len(INITIAL))
    return tuple(
        None if value is None else known_number(f"initial {name}", value)
        for name, value in zip(INITIAL, values, strict=True)
    )


def _fit(
    series: Angles,
    pendulum: Pendulum,
    free: tuple[str, ...],
    initial: tuple[float | None, ...],
    sigma: float | None,
) -> Fit:
    rate = time_rate(series, pendulum)
    by_free = np.array([_BY_FIELD[name] for name in free], float).reshape(-1, 3).T
    problem = lay_windows(
        series, pendulum, by_free, np.array([value is not None for value in initial]), rate
    )
    check_fast_mode(pendulum, float(np.max(problem.dts)))
    start = smooth_start(problem, *series, initial, rate)
    expected = sigma or max(start.noise, LEAST_NOISE)
    seen_at_first = bool(np.all(start.known[:, 0]))
    searches = [(window_by_window, first) for first in (FIRST[:1] if seen_at_first else FIRST)]
    if np.mean(np.all(start.known, axis=0)) > MOSTLY:
        searches.insert(0, (all_at_once, 0))
    task = _Task(series, pendulum, free, sigma, problem)
    total, fits = 0, []
    for search, first in searches:
        settings = settings_for(
            problem, start.nodes, start.known, rate, expected, np.zeros(len(free))
        )
        point, count = search(problem, start, settings, first)
        settings = settings_for(
            problem, point.nodes, np.ones_like(start.known), rate, expected, point.fields
        )
        found, settings, change = refine(problem, close_joints(problem, point, settings), settings)
        total += count + found.iterations
        fits.append(_result(task, found, settings, change, total))
        if found.step is not None and fits[-1].status in (Status.CONVERGED, Status.SINGULAR):
            return fits[-1]
    return min(
        fits, key=lambda fit: (fit.status != Status.MISFIT, np.nan_to_num(fit.noise, nan=np.inf))
    )


class _Task(NamedTuple):
    """What is asked, and the data in windows."""

    series: Angles
    pendulum: Pendulum
    free: tuple[str, ...]
    sigma: float | None
    problem: WindowedData


class _Quantity(NamedTuple):
    """An estimate and its standard error."""

    value: np.float64
    error: np.float64


def _result(task: _Task, found: Found, settings: Settings, change: float, iterations: int) -> Fit:
    series, pendulum, free, sigma, problem = task
    fitted = angles_at_samples(problem, found.point, settings.steps[1], series)
    residuals = wrap(series.values - fitted)
    noise = math.sqrt(found.misses.squares / problem.freedom)
    known = find_uncertainty(problem, found, settings, sigma or noise)
    noisy = is_noise(residuals, noise, settings.noise, problem.freedom)
    factors = dict(zip(free, np.exp(found.point.fields), strict=True))
    values = {
        name: np.float64(getattr(pendulum, name) * factors.get(name, 1.0)) for name in _BY_FIELD
    }
    node = found.point.nodes[:, 0]
    # A fit that failed may hold NaN, which no constructor takes: the status says so.
    shape = jax.tree.structure(pendulum)
    best = jax.tree.unflatten(shape, [jnp.asarray(value) for value in values.values()])
    state = momenta(best, *(jnp.asarray(component) for component in node))
    quantities, covariance = _quantities(values, free, node, known)
    return Fit(
        pendulum=best,
        state=State(*(jnp.asarray(leaf) for leaf in jax.tree.leaves(state))),
        estimates={name: quantity.value for name, quantity in quantities.items()},
        standard_errors={name: quantity.error for name, quantity in quantities.items()},
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
        status=np.asarray(int(fit_status(problem, found, known.determined, noisy, settings.noise))),
        free=free,
    )


def _quantities(
    values: dict[str, np.float64], free: tuple[str, ...], node: np.ndarray, known: Uncertainty
) -> tuple[dict[str, _Quantity], np.ndarray]:
    """All estimates by name, and the covariance of the fields and the first node in their units."""
    scale = np.append([values[name] for name in free], np.ones(len(INITIAL)))
    covariance = known.covariance * np.outer(scale, scale)
    errors = np.sqrt(np.diag(covariance))
    ratios = [
        values[over] / values[under] for over, under in (ratio.split("/") for ratio in RATIOS)
    ]
    names = (*free, *RATIOS, *INITIAL)
    estimates = (*scale[: len(free)], *ratios, *node)
    deviations = (*errors[: len(free)], *known.ratios * np.abs(ratios), *errors[len(free) :])
    return dict(zip(names, map(_Quantity, estimates, deviations), strict=True)), covariance
