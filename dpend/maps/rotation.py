"""Rotation numbers of the invariant curves of a section, by two methods that share nothing but the
points.

On an invariant curve around a fixed point the return map is a rotation in the right coordinates:
the rotation number is the mean turn around the point, in full turns a return. It is measured

- as the mean of the turns with the smooth weights exp(-1/(t (1 - t))), 0 < t < 1, whose error falls
  faster than any power of the number of returns if the number is irrational enough (Das, Saiki,
  Sander and Yorke, Quantitative Quasiperiodicity, arXiv:1508.00062);
- as the frequency at which the spectrum of the points, taken as complex numbers under the same
  weights, is largest.

They differ on a chaotic motion and on one that does not surround the point.
"""

from typing import Any

import numpy as np

from dpend.checks import instance
from dpend.maps.section import points_in

# The spectrum is looked at on a grid so many times as fine as its resolution; Newton's method, a
# few iterations, starts from the largest of these.
_FINER, _ITERATIONS = 8, 12
# Fewer returns tell no rotation number: their weighted mean is right to 1e-3.
_FEWEST = 16


def rotation_numbers(dataset: Any, centre: Any) -> Any:
    """The rotation number of each motion of a section around a point of the plane.

    Arguments:
        dataset: what `section` returned.
        centre: the point (angle [rad], momentum [kg m^2/s]) that the curves surround, such as a
            fixed point of `periodic_points`; angles count within half a turn of it.
    Returns:
        xarray.Dataset over `start`: `rotation`, full turns a return, in [0, 1), anticlockwise in
        the plane of angle and momentum; `frequency`, the same from the spectrum; `difference` of
        both. On 1000 returns of a smooth curve that is 1e-9 or less, where a motion is chaotic or
        does not surround the centre it is 1e-3 to 0.5. NaN where a motion has less than 16 returns.
    Raises:
        ValueError: another dataset; a centre that is no pair of finite numbers.
    """
    import xarray

    instance("dataset", dataset, xarray.Dataset, "what dpend.section returns")
    (middle,) = points_in("centre", [centre])
    found = np.array([_rotation_of(points, middle) for points in _returns(dataset)])
    apart = np.remainder(found[:, 0] - found[:, 1] + 0.5, 1.0) - 0.5
    data = {
        "rotation": ("start", found[:, 0]),
        "frequency": ("start", found[:, 1]),
        "difference": ("start", np.abs(apart)),
    }
    kept = {key: dataset.coords[key] for key in ("start_angle", "start_momentum")}
    return xarray.Dataset(data, kept, dataset.attrs)


def _returns(dataset: Any) -> list[np.ndarray]:
    """The points of side 1 of each motion, arrays of shape (returns, 2)."""
    points = np.stack([dataset.angle.values, dataset.momentum.values], axis=-1)
    sides = dataset.side.values
    return [one[side == 1] for one, side in zip(points, sides, strict=True)]


def _rotation_of(points: np.ndarray, middle: np.ndarray) -> tuple[float, float]:
    """The mean turn, and the frequency of the largest spectral line."""
    if len(points) < _FEWEST:
        return np.nan, np.nan
    ahead = points - middle
    ahead[:, 0] = np.remainder(ahead[:, 0] + np.pi, 2 * np.pi) - np.pi
    # In units in which the curve is as wide as it is high and not slanted, turns are most even.
    lengths, axes = np.linalg.eigh(ahead.T @ ahead)
    if not lengths[0] > 0:
        return np.nan, np.nan
    z = (ahead @ (axes * lengths**-0.5) @ axes.T) @ np.array([1.0, 1.0j])
    time = (np.arange(len(z)) + 1.0) / (len(z) + 1.0)
    turns = np.remainder(np.angle(z[1:] / z[:-1]) / (2 * np.pi), 1.0)
    between = (np.arange(len(turns)) + 1.0) / (len(turns) + 1.0)
    weights = np.exp(-1.0 / (between * (1.0 - between)))
    mean = float(np.sum(weights * turns) / np.sum(weights))
    return mean % 1.0, _line(z * np.exp(-1.0 / (time * (1.0 - time))))


def _line(z: np.ndarray) -> float:
    """The frequency at which the spectrum of a weighted signal is largest, in [0, 1)."""
    size = _FINER * len(z)
    frequency = float(np.argmax(np.abs(np.fft.fft(z, size)))) / size
    time = np.arange(len(z)) - 0.5 * (len(z) - 1)
    for _ in range(_ITERATIONS):
        turned = z * np.exp(-2j * np.pi * frequency * time)
        f, df, ddf = (np.sum(turned * (-2j * np.pi * time) ** k) for k in range(3))
        slope = (df * np.conj(f)).real
        bend = (ddf * np.conj(f)).real + abs(df) ** 2
        frequency -= float(slope / bend)
    return frequency % 1.0
