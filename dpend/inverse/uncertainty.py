"""How well a fit is known: covariances, and whether what is left of the data is noise."""

import math
from typing import NamedTuple

import numpy as np

from dpend.inverse.gauss_newton import ROUNDED, Found, close_joints
from dpend.inverse.windows import Point, Settings, WindowedData
from dpend.status import Status

# Doubles round an angle of a radian by this much [rad]; no motion in doubles is known better.
LEAST_NOISE = 1e-15
# The residuals may be this many times the expected noise, and three standard errors of that more.
_MORE_THAN_NOISE = 1.5
# The correlation of neighbouring residuals may be this large, and three standard errors of it more.
_CORRELATED = 0.5
# Residuals below this [rad] are what integration and rounding leave.
_NO_NOISE = 1e-6
# A mode that is not excited is fitted to the noise, and its frequency gets a small formal error. So
# an axis is tested if its error is worth more than this phase over the data [rad].
_PHASE = 0.3
# The test goes this many standard errors along the axis, and at most a factor of e ...
_FAR_OFF = 10.0
# ... where the sum of squares must have grown by this many variances of the noise. No frequency in
# pure noise stands out by as much.
_GROWN = 30.0


class Uncertainty(NamedTuple):
    """How well a fit is known.

    Attributes:
        covariance: of the fields' logarithms, then of the first node; infinite where nothing is
            known.
        ratios: standard errors of the logarithms of the ratios, shape (3,).
        determined: whether the data determine all that was asked for.
    """

    covariance: np.ndarray
    ratios: np.ndarray
    determined: bool


def find_uncertainty(
    problem: WindowedData, found: Found, settings: Settings, noise: float
) -> Uncertainty:
    """Covariances at the solution. What depends on an axis of the fields that the data do not
    determine is infinite.
    """
    free, step = problem.by_free.shape[1], found.step
    if step is None:
        return Uncertainty(np.full((free + 4, free + 4), np.nan), np.full(3, np.nan), False)
    weights, axes = np.linalg.eigh(step.information)
    known = weights > max(settings.noise**2, ROUNDED * float(np.max(np.abs(weights), initial=0.0)))
    errors = np.where(known, noise / np.sqrt(np.where(known, weights, 1.0)), np.inf)
    loose = settings.rate * (problem.times[-1] - problem.times[0]) * errors > _PHASE
    for j in np.flatnonzero(known & loose).tolist():
        known[j] = _grows_away(
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
    return Uncertainty(covariance, np.where(lost, np.inf, ratios), not np.any(unknown))


def _grows_away(
    problem: WindowedData,
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
        aside = close_joints(shifted, Point(nodes, np.zeros(others.shape[1])), settings)
        grown = (aside.misses.squares - found.misses.squares) / max(noise, LEAST_NOISE) ** 2
        if aside.step is not None and grown < _GROWN:
            return False
    return True


def is_noise(residuals: np.ndarray, noise: float, expected: float, freedom: int) -> bool:
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


def fit_status(
    problem: WindowedData, found: Found, determined: bool, noisy: bool, expected: float
) -> Status:
    """The verdict; also what keeps the iteration from closing the joints is a misfit where it was
    one before.
    """
    if found.status != Status.CONVERGED:
        far = found.misses.squares > problem.observations * (_MORE_THAN_NOISE * expected) ** 2
        return Status.MISFIT if far and found.status == Status.MAX_ITERATIONS else found.status
    return Status.MISFIT if not noisy else Status.CONVERGED if determined else Status.SINGULAR
