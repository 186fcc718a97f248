"""What a sweep costs, told before it is spent."""

import math
from dataclasses import dataclass
from functools import partial
from numbers import Real

import jax
import numpy as np

from dpend.checks import Scalar
from dpend.maps.grid import Task, place
from dpend.maps.lanes import WIDTH
from dpend.mechanics.pendulum import Pendulum
from dpend.methods.scheme import Scheme

# A sweep is refused beyond so many steps of all cells, or beyond this share of them in one motion.
# A map of 4096 x 4096 cells takes 1e10 steps for 10 s at the default tolerance; 1e12 take a day on
# two cores. The steps of one motion follow one another on one core: a million take some five
# seconds.
MOST_SWEEP_STEPS, SHARE = 1e12, 1e-6
# What a user may ask for at most: JAX counts a loop's turns in 64 bits.
COUNTABLE = 1e15
# Steps of methods with uneven steps, for each step that fits into the duration: the mean over the
# square of releases, 0.9 to 1.9 for four pendulums.
_UNEVEN = 1.4
# A motion whose steps would be so much shorter than the scheme's is given up as NaN at once.
_LOST = 1e5
# Steps that a core takes in a second, at order 8 with a tangent, for a first guess at how long a
# sweep takes.
_RATE = 5e6


@dataclass(frozen=True)
class Cost:
    """About what a sweep takes.

    Attributes:
        cells: to be computed, not mirrored.
        each: steps of one motion, both passes; the mean where steps are uneven, of which one motion
            may take five times as many; None where nothing is known of the motion.
        bytes: of the values of all cells, before they are compressed.
    """

    cells: int
    each: float | None
    bytes: int

    @property
    def steps(self) -> float:
        """Of all cells."""
        return self.cells * (self.each or 0.0)

    @property
    def seconds(self) -> float:
        """A first guess, at the speed of one machine's cores."""
        cores = jax.local_device_count()
        lanes = max(self.cells, WIDTH * cores) if self.cells else 0
        return lanes * (self.each or 0.0) / (cores * _RATE)


def motion_steps(task: Task) -> float | None:
    """About how many steps a motion takes, from the quantity's setting `duration`."""
    duration = dict(task.quantity.keywords).get("duration")
    if not isinstance(duration, Real) or isinstance(duration, bool) or not math.isfinite(duration):
        return None
    steps = max(1.0, abs(float(duration)) / task.scheme.step) * (3 if task.twice else 1)
    if not task.scheme.even:
        steps *= _UNEVEN
    momenta = any(key in task.grid.axes or task.grid.at.get(key) for key in ("p1", "p2"))
    # A release from rest gets hardly faster than the fast mode; a motion under way may start with
    # short steps.
    return steps if task.scheme.even or not momenta else steps * _shortening(task)


def _shortening(task: Task) -> float:
    """By how much the scheme's step is cut at the start of the fastest of some cells."""
    ends = [
        array[np.linspace(0, array.size - 1, 8).astype(int)] for array in task.grid.axes.values()
    ]
    cells = {
        key: mesh.ravel() for key, mesh in zip(task.grid.axes, np.meshgrid(*ends), strict=True)
    }
    shorter = np.asarray(_shorten_at_start(task.scheme, *task.shared, cells))
    return float(np.max(shorter[shorter < _LOST], initial=1.0))


@partial(jax.jit, static_argnums=0)
def _shorten_at_start(
    scheme: Scheme, pendulum: Pendulum, at: dict[str, Scalar], cells: dict[str, Scalar]
) -> Scalar:
    def one(cell: dict[str, Scalar]) -> Scalar:
        here, state = place(pendulum, at, cell)
        spin = scheme.spin(scheme.constants(here), scheme.enter(here, state))
        return jax.numpy.maximum(spin, 1.0) ** 0.75

    return jax.vmap(one)(cells)
