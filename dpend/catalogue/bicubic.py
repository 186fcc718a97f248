"""Cells of a rectangle with their bicubics: empty ones, ones with one zero, and ones to halve."""

from typing import Any, NamedTuple

import numpy as np

# An error counts for this many rows on either side, nearly a radian of the fast mode.
_NEARBY = 16
# A cell that is bent in time more than in theta2, as near a fold, is halved in time: at most so
# often.
SPLITS = 12
# A cell is simple if its derivative, preconditioned, is nearer than this to the unit matrix.
_DOMINANCE = 0.9
# Newton's iterations for the zero of a simple cell.
_NEWTON = 12
# Chords along a cell's last edge. A zero between an edge and its chords would be on the wrong side.
_CHORDS = 32


class Intervals(NamedTuple):
    """Intervals of theta2 and G at their ends: value, slopes in time and theta2, and mixed, shape
    (4, 2, rows, n).
    """

    left: np.ndarray
    right: np.ndarray
    at_left: np.ndarray
    at_right: np.ndarray

    def some(self, which: Any) -> "Intervals":
        return Intervals(
            self.left[which], self.right[which], self.at_left[..., which], self.at_right[..., which]
        )


class Half(NamedTuple):
    intervals: Intervals
    error: np.ndarray  # of the cells' values, shape (rows, n)


def largest_nearby(error: np.ndarray) -> np.ndarray:
    """The largest error at any row near each cell: one that is small in a few rows alone is so by
    accident.
    """
    far = 1
    while far < _NEARBY:
        padded = np.pad(error, ((far, far), (0, 0)), mode="edge")
        error = np.maximum(np.maximum(padded[: -2 * far], padded[2 * far :]), error)
        far *= 2
    return np.asarray(np.maximum(error[:-1], error[1:]))


def bernstein_net(some: Intervals, row: np.ndarray, lane: np.ndarray, dt: float) -> np.ndarray:
    """Bernstein coefficients of the bicubics over cells, axes (theta2, time, component, cell)."""
    width = (some.right - some.left)[lane] / 3
    net = np.empty((4, 4, 2, row.size))
    for end, i, inner_i, right in ((some.at_left, 0, 1, width), (some.at_right, 3, 2, -width)):
        for at, j, inner_j, up in ((row, 0, 1, dt / 3), (row + 1, 3, 2, -dt / 3)):
            value, by_time, by_angle, mixed = end[:, :, at, lane]
            net[i, j] = value
            net[inner_i, j] = value + right * by_angle
            net[i, inner_j] = value + up * by_time
            net[inner_i, inner_j] = value + right * by_angle + up * by_time + right * up * mixed
    return net


def error_in_time(some: Intervals, row: np.ndarray, lane: np.ndarray, dt: float) -> np.ndarray:
    """What the cubics along time miss, from every other row."""
    missed = np.zeros(row.size)
    for middle in (row, row + 1):
        middle = np.clip(middle, 1, some.at_left.shape[2] - 2)
        for end in (some.at_left, some.at_right):
            before, here, after = (end[:2, :, middle + k, lane] for k in (-1, 0, 1))
            foretold = 0.5 * (before[0] + after[0]) + dt / 4 * (before[1] - after[1])
            missed = np.maximum(missed, np.max(np.abs(foretold - here[0]), axis=0))
    return missed / 16


class Cells(NamedTuple):
    """Bicubics over cells, or over parts of cells that were halved in time.

    Attributes:
        net: Bernstein coefficients, axes (theta2, time, component, part).
        error: of the values.
        whole: the cell that a part belongs to.
        start: where in time it begins, as a share of the cell.
    """

    net: np.ndarray
    error: np.ndarray
    whole: np.ndarray
    start: np.ndarray

    def classify(self) -> "_Kinds":
        """Which parts are empty, which simple with a zero where, and which open."""
        by_angle, by_time = (
            3 * (self.net[1:] - self.net[:-1]),
            3 * (self.net[:, 1:] - self.net[:, :-1]),
        )
        across, along = by_angle.mean(axis=(0, 1)), by_time.mean(axis=(0, 1))
        determinant = across[0] * along[1] - across[1] * along[0]
        inverse = np.array([[along[1], -along[0]], [-across[1], across[0]]]) / determinant
        error = np.abs(inverse).sum(axis=1) * self.error
        value = _product(inverse, self.net)
        below, above = (
            np.max(value, axis=(0, 1)) + error < 0,
            np.min(value, axis=(0, 1)) - error > 0,
        )
        (left,) = np.nonzero(~np.any(below | above, axis=0))
        by_angle, by_time = (
            _product(inverse[..., left], net[..., left]) for net in (by_angle, by_time)
        )

        def worst(net: np.ndarray) -> np.ndarray:
            return np.max(np.abs(net), axis=(0, 1))

        apart = np.maximum(
            worst(by_angle[:, :, 0] - 1) + worst(by_time[:, :, 0]),
            worst(by_angle[:, :, 1]) + worst(by_time[:, :, 1] - 1),
        )
        # A cubic's slope is wrong by up to four times its value's error, at either end.
        near = apart + 8 * np.max(error[:, left], axis=0) < _DOMINANCE
        simple = left[near]
        return _Kinds(
            left[~near], simple, _find_zero(value[..., simple]), np.sign(determinant[simple])
        )

    def bent_in_time(self, which: np.ndarray) -> np.ndarray:
        """Whether parts are further from linear in time than in theta2."""
        net = self.net[..., which]
        bent = (np.max(np.abs(np.diff(net, 2, axis=axis)), axis=(0, 1, 2)) for axis in (0, 1))
        across, along = bent
        return np.asarray(along > across)

    def halve(self, which: np.ndarray, split: int) -> "Cells":
        """Both halves in time, by de Casteljau's construction, of parts halved `split` times
        before.
        """
        a, b, c, d = np.moveaxis(self.net[..., which], 1, 0)
        ab, bc, cd = (a + b) / 2, (b + c) / 2, (c + d) / 2
        abc, bcd = (ab + bc) / 2, (bc + cd) / 2
        middle = (abc + bcd) / 2
        halves = np.stack([a, ab, abc, middle], axis=1), np.stack([middle, bcd, cd, d], axis=1)
        start = self.start[which]
        return Cells(
            np.concatenate(halves, axis=-1),
            np.tile(self.error[which], 2),
            np.tile(self.whole[which], 2),
            np.concatenate([start, start + 0.5 ** (split + 1)]),
        )


class _Kinds(NamedTuple):
    """Which parts are open, neither empty nor simple, and which are simple; where these have their
    zero, in units of their sides, and its sign.
    """

    open: np.ndarray
    simple: np.ndarray
    where: np.ndarray
    sign: np.ndarray


def _product(matrix: np.ndarray, net: np.ndarray) -> np.ndarray:
    """A matrix for each cell times the components of a net."""
    return np.stack([row[0] * net[:, :, 0] + row[1] * net[:, :, 1] for row in matrix], axis=2)


def _find_zero(net: np.ndarray) -> np.ndarray:
    """Newton's method for the zero of bicubics that are near the identity plus a shift, shape (2,
    cells).
    """
    x = np.full((2, net.shape[-1]), 0.5)
    for _ in range(_NEWTON):
        (a, slope_a), (b, slope_b) = (_bernstein(each) for each in x)
        rows, slopes = np.sum(net * b[:, None], axis=1), np.sum(net * slope_b[:, None], axis=1)
        value, across = np.sum(a[:, None] * rows, axis=0), np.sum(slope_a[:, None] * rows, axis=0)
        along = np.sum(a[:, None] * slopes, axis=0)
        determinant = across[0] * along[1] - across[1] * along[0]
        x[0] -= (along[1] * value[0] - along[0] * value[1]) / determinant
        x[1] -= (across[0] * value[1] - across[1] * value[0]) / determinant
        np.clip(x, -1.0, 2.0, out=x)
    return x


def _bernstein(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The cubic Bernstein polynomials and their derivatives, shape (4, n) each."""
    y = 1 - x
    values = np.array([y**3, 3 * x * y**2, 3 * x**2 * y, x**3])
    return values, 3 * np.array([-(y**2), y**2 - 2 * x * y, 2 * x * y - x**2, x**2])


def turn_along(some: Intervals) -> float:
    """How far p at the last time turns clockwise about zero over these intervals, along their
    cubics.
    """
    start, end = some.at_left[:, :, -1], some.at_right[:, :, -1]
    width = (some.right - some.left) / 3
    net = np.stack([start[0], start[0] + width * start[2], end[0] - width * end[2], end[0]])
    weights, _ = _bernstein(np.linspace(0, 1, _CHORDS + 1))
    along = np.einsum("ik,icn->kcn", weights, net)
    (x0, y0), (x1, y1) = np.moveaxis(along[:-1], 1, 0), np.moveaxis(along[1:], 1, 0)
    return -float(np.sum(np.arctan2(x0 * y1 - y0 * x1, x0 * x1 + y0 * y1)))
