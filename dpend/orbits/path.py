"""The motion of an orbit at any times, without a seam where it closes.

An orbit is known at its start and half a period later. A quarter of the period is integrated from
both, forwards and backwards: what errors grow by is that of a quarter, and the pieces meet as well
as the orbit is known.
"""

from typing import Any

import jax
import numpy as np

from dpend.checks import known_number, numbers, shown
from dpend.mechanics.pendulum import Pendulum, State, energy_scale, hamiltonian
from dpend.motion.simulate import simulate
from dpend.motion.trajectory import Trajectory
from dpend.status import Status

# Times of a period, if nobody asks for others: five seconds of film.
_TIMES = 301


def unfold(
    pendulum: Pendulum,
    starts: tuple[State, State],
    period: float,
    turns: Any,
    times: Any | None,
    tolerance: float | Any,
) -> Trajectory:
    """The motion at `times` of the orbit with these states at t = 0 and half a period later.

    Arguments:
        turns: the full turns of both rods in a period.
    Raises:
        ValueError: times not finite; tolerance not positive.
    """
    tolerance = known_number("tolerance", tolerance, positive=True, unit="rad")
    grid = np.linspace(0.0, period, _TIMES) if times is None else numbers("times", times, unit="s")
    grid = np.atleast_1d(grid)
    if grid.ndim != 1 or not grid.size or not np.all(np.isfinite(grid)):
        raise ValueError(f"times must be finite, shape (n,), got {shown(grid)}: give others")
    halves = np.round(2 * grid / period)
    since = grid - halves * (period / 2)
    odd = halves % 2 != 0
    states, error = np.empty((4, grid.size)), np.empty(grid.size)
    steps, status = 0, int(Status.CONVERGED)
    for later, start in enumerate(starts):
        for way in (1, -1):
            (here,) = np.nonzero((odd == later) & ((since >= 0) == (way > 0)))
            if not here.size:
                continue
            ahead, back = np.unique(since[here], return_inverse=True)
            there = back if way > 0 else ahead.size - 1 - back
            piece = simulate(pendulum, start, times=ahead[::way], tolerance=tolerance)
            states[:, here] = np.stack(jax.tree.leaves(piece.state))[:, there]
            error[here] = np.asarray(piece.error)[there]
            steps += int(piece.steps)
            status = status or int(piece.status)
    states[:2] += 2 * np.pi * np.outer(turns, np.floor(halves / 2))
    moved = State(*states)
    change = np.abs(hamiltonian(pendulum, moved) - hamiltonian(pendulum, starts[0]))
    drift = np.max(change) / energy_scale(pendulum, starts[0])
    return Trajectory(
        grid, moved, float(drift), float(np.max(error)), steps, status,
        tolerance=tolerance, error=error, method="collocation",
    )  # fmt: skip
