"""`Scheme`, the static pair of method and step that names a computation, and the scheme that a
tolerance needs.

A step is traceable in the pendulum, the point and the step itself; forward and reverse derivatives
go through it. The point that a step moves is not always a `State`: each method has a `Form`, which
is the canonical one (runge_kutta), the circle (circle), or canonical with compensated sums (gauss).

The rescaled method takes equal steps in a time s of its own, dt/ds = u^(-5/8) with u = 1 + 0.85
q/omega_f^2, q = omega1^2 + omega2^2 + (omega1 - omega2)^2 and omega_f the fast normal mode's
frequency: short in t where the rods fly. Each motion gets the steps that it needs, without a
rejected one and without a branch. The step's length is fixed before it is taken, so that its stages
cost what those of an even step cost.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from dpend.checks import Scalar, flag, instance, known_number, one_of
from dpend.mechanics.linear import fast_frequency
from dpend.mechanics.pendulum import Pendulum, State, hamiltonian, known_pendulum
from dpend.methods.circle import CIRCLE, spin_of
from dpend.methods.gauss import GAUSS, SUMMED
from dpend.methods.runge_kutta import (
    CANONICAL,
    RK4,
    RK8,
    RK10,
    WRITTEN_OUT,
    Constants,
    Form,
    Point,
    Step,
    Tableau,
    explicit_step,
)


class _Method(NamedTuple):
    tableau: Tableau
    form: Form
    even: bool = True  # steps equally long in time


# Every method by name.
METHODS = {
    "rk4": _Method(RK4, CANONICAL),
    "rk8": _Method(RK8, CANONICAL),
    "rk4-circle": _Method(RK4, CIRCLE),
    "rk8-circle": _Method(RK8, CIRCLE),
    "rk8-circle-rescaled": _Method(RK8, CIRCLE, even=False),
    "rk10-circle-rescaled": _Method(RK10, CIRCLE, even=False),
    "gauss": _Method(GAUSS, SUMMED),
}
# A release near the bottom swings slowly and evenly: it is given longer steps, in proportion to
# (energy above the bottom)^-0.2, at most these times as long. Measured on releases over the whole
# square.
_PACE_POWER, _LONGEST_PACE = -0.2, 1.9
# A week of one motion at two million steps a second: what takes longer does not end.
_MOST_STEPS = 1e12
# The step in units of 1/(fast mode's frequency) against the error of the larger angle [rad]: 99th
# percentile over 64 x 64 releases from rest on the whole square, after 2 s of the paper's pendulum,
# nearly two periods of its slow mode (experiments/speed_vs_error.py). At no error was another
# method faster.
_ERROR_OF_STEP = {
    "rk8-circle-rescaled": (
        (0.17, 1.3e-9),
        (0.20, 5.1e-9),
        (0.23, 1.8e-8),
        (0.26, 5.0e-8),
        (0.30, 1.6e-7),
        (0.35, 5.9e-7),
        (0.40, 1.7e-6),
        (0.47, 6.6e-6),
        (0.55, 2.1e-5),
        (0.65, 1.5e-4),
        (0.80, 1.7e-3),
        (1.00, 3.1e-2),
    ),
    "rk10-circle-rescaled": (
        (0.15, 2.0e-11),
        (0.16, 2.6e-11),
        (0.18, 3.8e-11),
        (0.20, 8.8e-11),
        (0.225, 2.8e-10),
        (0.25, 8.1e-10),
        (0.28, 2.6e-9),
        (0.31, 7.3e-9),
        (0.35, 2.9e-8),
        (0.40, 1.2e-7),
    ),
}
# Below this error [rad] order 10 is the faster, by 1.2 at 3e-11; above it they are alike, and order
# 8 compiles sooner.
_ORDER_10_BELOW = 2e-8
# How much shorter the step has to be for other pendulums than the paper's, whose masses are equal:
# against m2/m1, from the error at one step on the same releases; and at lengths l2/l1 = 0.25 to 4
# at most by (l2/l1)^0.15.
_SHORTER_FOR_MASSES = (
    (0.01, 0.60),
    (0.03, 0.68),
    (0.1, 0.77),
    (0.3, 0.91),
    (1.0, 1.0),
    (3.0, 0.73),
    (10.0, 0.46),
    (30.0, 0.28),
    (100.0, 0.17),
)


@dataclass(frozen=True)
class Scheme:
    """A method and its step: static and hashable, so that compiled functions are keyed by it.

    Attributes:
        name: `rk4` (the classical method of order 4) or `rk8` (the 12-stage order-8 propagator of
            DOP853), both in (theta, p); `rk4-circle` and `rk8-circle`, the same without
            trigonometry; `rk8-circle-rescaled` and `rk10-circle-rescaled` (15 stages, order 10, by
            Stepanov), in rescaled time; `gauss` (Gauss-Legendre, three stages, order 6) in (theta,
            p), symplectic, for motions over very many periods: a step takes as long as two of `rk8`
            written out.
        step: the step [s]. Even methods take n = ceil(t/step) steps of t/n each over a motion of
            length t; the rescaled one takes steps of at most `step`, near the bottom 1.9 `step`,
            much shorter where it flies.
        written_out: whether all stages of a step are written out, or run as a loop: slower to
            compile, faster for many lanes. By default the circle forms are, and order 8 in (theta,
            p) is not.
    Raises:
        ValueError: an unknown name; a step that is not finite and positive, or traced; written_out
            not a boolean.
    """

    name: str | Any
    step: float | Any
    written_out: bool | Any | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", one_of("method", self.name, tuple(METHODS)))
        object.__setattr__(self, "step", known_number("step", self.step, positive=True, unit="s"))
        if self.written_out is not None:
            object.__setattr__(self, "written_out", flag("written_out", self.written_out))

    @property
    def order(self) -> int:
        """The order p: the error of a motion falls like step^p."""
        return METHODS[self.name].tableau.order

    @property
    def even(self) -> bool:
        """Whether all steps are equally long in time."""
        return METHODS[self.name].even

    @property
    def _form(self) -> Form:
        return METHODS[self.name].form

    @property
    def _step(self) -> Step:
        tableau, written_out = METHODS[self.name].tableau, self.written_out
        if written_out is None:
            written_out = self._form.written_out or len(tableau.b) <= WRITTEN_OUT
        return partial(explicit_step, tableau, written_out=written_out)

    def enter(self, pendulum: Pendulum, state: State) -> Point:
        """The point that stands for a state; `State` itself for explicit methods in (theta, p)."""
        return self._form.enter(pendulum, state)

    def leave(self, constants: Constants, point: Point) -> State:
        """The state that a point stands for."""
        return self._form.leave(constants, point)

    def constants(self, pendulum: Pendulum, dt: Scalar = 1.0) -> Constants:
        """What steps of `dt` [s] need, computed once; dt may be negative."""
        return self.with_step(self._form.constants(pendulum), dt)

    def with_step(self, constants: Constants, dt: Scalar) -> Constants:
        """The constants of steps of `dt` [s], from those of steps of 1 s."""
        return self._form.with_step(constants, dt)

    def move(self, constants: Constants, point: Point) -> Point:
        """The point one step later."""
        return self._form.move(self._step, constants, point)

    def move_compensated(
        self, constants: Constants, point: Point, rest: Point
    ) -> tuple[Point, Point]:
        """The point one step later, the rounding errors of its sums kept (compensated summation).

        Arguments:
            rest: what rounding has taken from the sums so far, zeros at the start; the same tree as
                the point.
        Returns:
            The point and the rest, which together are the motion.
        """
        return self._form.move_compensated(self._step, constants, point, rest)

    def move_tangents(
        self, constants: Constants, point: Point, tangents: State
    ) -> tuple[Point, State]:
        """One step of a point together with tangent vectors of it, which do not change the point.

        Arguments:
            tangents: (d theta1, d theta2, d p1, d p2) as a `State`: one vector, with leaves of the
                point's shape, or as many as wanted along a new leading axis.
        Returns:
            The point and the tangents.
        """
        return self._form.move_tangents(self._step, constants, point, tangents)

    def advance(self, pendulum: Pendulum, point: Point, dt: Scalar) -> Point:
        """The point one step of `dt` [s] later; `dt` may be negative."""
        return self.move(self.constants(pendulum, dt), point)

    def advance_tangents(
        self, pendulum: Pendulum, point: Point, tangents: State, dt: Scalar
    ) -> tuple[Point, State]:
        """The point and its tangents one step of `dt` [s] later."""
        return self.move_tangents(self.constants(pendulum, dt), point, tangents)

    def spin(self, constants: Any, point: Point) -> Scalar:
        """The u >= 1 by which the rescaled method goes: u = 1 + 0.85 q/omega_f^2."""
        return lax.stop_gradient(spin_of(constants, point))

    def pace(self, pendulum: Pendulum, state: State) -> Scalar:
        """The longest step of this motion in units of `step`: 1, but for rescaled time near the
        bottom.
        """
        bottom = (pendulum.m1 + pendulum.m2) * pendulum.l1 + pendulum.m2 * pendulum.l2
        height = 0.5 * (hamiltonian(pendulum, state) / (jnp.abs(pendulum.g) * bottom) + 1.0)
        height = jnp.where(jnp.isfinite(height), height, 1.0)  # no gravity, no bottom
        longest = _LONGEST_PACE ** (1 / _PACE_POWER)
        return lax.stop_gradient(jnp.clip(height, longest, 1.0) ** _PACE_POWER)

    def steps(self, duration: float | Any) -> int:
        """The number of even steps that a motion of `duration` [s] takes: ceil(|duration|/step -
        1e-9).

        Raises:
            ValueError: the step is longer than the motion, or so short that they would never end;
                the duration is no known finite number.
        """
        duration = known_number("duration", duration, unit="s")
        count = abs(duration) / self.step
        if count > _MOST_STEPS:
            raise ValueError(
                f"step must make at most {_MOST_STEPS:.0e} steps, got {self.step:g} s, which makes "
                f"{count:.3g}: "
                "give a larger step, or a shorter duration"
            )
        if 0.0 < count < 1.0 - 1e-9:
            raise ValueError(
                f"step must not be longer than the motion of {abs(duration):g} s, got "
                f"{self.step:g}: "
                "give a smaller step"
            )
        return math.ceil(count - 1e-9)


def check_scheme(scheme: Any) -> None:
    """Refuses what is no `Scheme`.

    Raises:
        ValueError: another class, a method's name among them.
    """
    instance(
        "scheme", scheme, Scheme, 'dpend.Scheme("rk8", 1e-3) or dpend.scheme_for(pendulum, 1e-9)'
    )


def scheme_for(pendulum: Pendulum | Any, tolerance: float | Any) -> Scheme:
    """The fastest scheme for many motions whose angles are to be right to `tolerance`, 99 in 100 of
    them.

    "Right" is measured on releases from rest over the whole square of angles, after about two
    periods of the slow mode, chaotic motions among them; `sweep(..., error="half-step")` tells cell
    by cell how it went.

    Arguments:
        pendulum: its fields are numbers.
        tolerance: of the larger angle [rad]; below 2e-11 the step is that of 2e-11, where rounding
            takes over, above 3e-2 that of 3e-2. Measured for mass ratios m2/m1 of 0.01 to 100 and
            lengths l2/l1 of 0.25 to 4.
    Raises:
        ValueError: tolerance not positive; gravity zero, which sets no time; a traced argument.
    """
    pendulum = known_pendulum(pendulum)
    tolerance = known_number("tolerance", tolerance, positive=True, unit="rad")
    frequency = float(fast_frequency(pendulum))
    if not frequency > 0:
        raise ValueError(
            f"g must not be zero for a tolerance, got {float(pendulum.g)}: give a method and a step"
        )
    name = "rk10-circle-rescaled" if tolerance < _ORDER_10_BELOW else "rk8-circle-rescaled"
    turns, errors = zip(*_ERROR_OF_STEP[name], strict=True)
    turn = math.exp(np.interp(math.log(tolerance), np.log(errors), np.log(turns)))
    ratios, factors = zip(*_SHORTER_FOR_MASSES, strict=True)
    turn *= math.exp(
        np.interp(math.log(pendulum.m2 / pendulum.m1), np.log(ratios), np.log(factors))
    )
    turn *= min(1.0, float(pendulum.l2 / pendulum.l1)) ** 0.15
    return Scheme(name, turn / frequency)
