"""A motion in extended precision, to hold others against: shares nothing with dpend and needs NumPy
alone.

Lagrange's equations in angles and angular velocities, in long double (80 bits on x86), by Gragg's
midpoint rule with Richardson extrapolation until the columns come no closer. Released at (2.9, 3.1)
rad, a chaotic motion, it is 1e-14 rad from mpmath's Taylor series with 30 digits after 2 s.
"""

import itertools
from functools import partial

import numpy as np

_EPS = np.finfo(np.longdouble).eps
# Midpoint steps 2, 4, 6, ... in each column; so many columns make the order 2, 4, 6, ....
_GOOD_COLUMNS, _MOST_COLUMNS = 10, 16
# The columns agree as well as they will where they are within so many units in the last place and
# come no closer.
_ROUNDING = 256


def is_extended() -> bool:
    """Whether long double is more than double on this machine."""
    return bool(_EPS < 1e-18)


def accelerations(pendulum, state, numpy=np):
    """The slope of (theta1, theta2, omega1, omega2), in NumPy or in what stands in for it:
    Lagrange's two equations, by Cramer's rule.

    (m1 + m2) l1 a1 + m2 l2 c a2 = -m2 l2 s omega2^2 - (m1 + m2) g sin theta1
              l1 c a1 +    l2 a2 =     l1 s omega1^2 -           g sin theta2,
    c, s of theta1 - theta2
    """
    l1, l2, m1, m2, g = pendulum
    theta1, theta2, omega1, omega2 = state
    c, s = numpy.cos(theta1 - theta2), numpy.sin(theta1 - theta2)
    right1 = -m2 * l2 * s * omega2**2 - (m1 + m2) * g * numpy.sin(theta1)
    right2 = l1 * s * omega1**2 - g * numpy.sin(theta2)
    size = m1 + m2 * s * s
    a1 = (right1 - m2 * c * right2) / (l1 * size)
    a2 = ((m1 + m2) * right2 - c * right1) / (l2 * size)
    return numpy.stack([omega1, omega2, a1, a2])


def motion(pendulum, state, times, longest=0.005):
    """The states (theta1, theta2, omega1, omega2) at increasing times from zero, in long double,
    shape (n, 4).

    Arguments:
        pendulum: (l1, l2, m1, m2, g).
        state: at t = 0; doubles are taken for the numbers that they are.
        longest: no step is longer [s].
    """
    pendulum = [np.longdouble(value) for value in pendulum]
    state, time, step, rows = (
        np.array(state, np.longdouble),
        np.longdouble(0),
        np.longdouble(longest),
        [],
    )
    for end in np.array(times, np.longdouble):
        while time < end:
            taken = min(step, end - time)
            found, columns = _converged(pendulum, state, taken)
            if columns > _MOST_COLUMNS:
                step = taken / 2
                continue
            state = found
            time = end if taken == end - time else time + taken
            if columns < _GOOD_COLUMNS:
                step = min(np.longdouble(longest), max(step, taken * np.longdouble(1.5)))
        rows.append(state)
    return np.array(rows)


def extrapolated(slope, state, step):
    """The state a step later, better with every column: the midpoint rule with 2, 4, 6, ...
    substeps, extrapolated.
    """
    first, row = slope(state), []
    for column in itertools.count(1):
        part = step / (2 * column)
        before, here = state, state + part * first
        for _ in range(2 * column - 1):
            before, here = here, before + 2 * part * slope(here)
        last, row = row, [(before + here + part * slope(here)) / 2]
        for j, coarser in enumerate(last):
            ratio = (np.longdouble(column) / (column - 1 - j)) ** 2
            row.append(row[j] + (row[j] - coarser) / (ratio - 1))
        yield row[-1]


def _converged(pendulum, state, step):
    """The state a step later and the number of columns that it took, one above the most where they
    do not agree.
    """
    before, change = state, np.inf
    columns = itertools.islice(
        extrapolated(partial(accelerations, pendulum), state, step), _MOST_COLUMNS
    )
    for column, here in enumerate(columns, 1):
        if column > 1:
            change, last = np.max(np.abs(here - before) / (1 + np.abs(state))), change
            if change < _ROUNDING * _EPS and not change < last / 2:  # rounding is all that is left
                return before, column
        before = here
    return state, _MOST_COLUMNS + 1
