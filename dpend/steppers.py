"""One step of each integration method, and `Scheme`, the static pair of method and step that names a computation.

A step is traceable in the pendulum, the state and the step itself; forward and reverse derivatives go through it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import lax

from dpend.pendulum import Pendulum, Scalar, State, number, vector_field


@dataclass(frozen=True)
class Tableau:
    """An explicit Runge-Kutta method: stage weights `a` (row i has i entries), step weights `b`, and its order."""

    a: tuple[tuple[float, ...], ...]
    b: tuple[float, ...]
    order: int


RK4 = Tableau(
    a=((), (0.5,), (0.0, 0.5), (0.0, 0.0, 1.0)),
    b=(1 / 6, 1 / 3, 1 / 3, 1 / 6),
    order=4,
)

# The 12-stage propagator of DOP853 (Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I), without its
# error estimators; coefficients as in SciPy's dop853_coefficients.py.
# fmt: off
RK8 = Tableau(
    a=(
        (),
        (0.05260015195876773,),
        (0.0197250569845379, 0.0591751709536137),
        (0.02958758547680685, 0.0, 0.08876275643042054),
        (0.2413651341592667, 0.0, -0.8845494793282861, 0.924834003261792),
        (0.037037037037037035, 0.0, 0.0, 0.17082860872947386, 0.12546768756682242),
        (0.037109375, 0.0, 0.0, 0.17025221101954405, 0.06021653898045596, -0.017578125),
        (0.03709200011850479, 0.0, 0.0, 0.17038392571223998, 0.10726203044637328, -0.015319437748624402,
         0.008273789163814023),
        (0.6241109587160757, 0.0, 0.0, -3.3608926294469414, -0.868219346841726, 27.59209969944671,
         20.154067550477894, -43.48988418106996),
        (0.47766253643826434, 0.0, 0.0, -2.4881146199716677, -0.590290826836843, 21.230051448181193,
         15.279233632882423, -33.28821096898486, -0.020331201708508627),
        (-0.9371424300859873, 0.0, 0.0, 5.186372428844064, 1.0914373489967295, -8.149787010746927,
         -18.52006565999696, 22.739487099350505, 2.4936055526796523, -3.0467644718982196),
        (2.273310147516538, 0.0, 0.0, -10.53449546673725, -2.0008720582248625, -17.9589318631188, 27.94888452941996,
         -2.8589982771350235, -8.87285693353063, 12.360567175794303, 0.6433927460157636),
    ),
    b=(0.054293734116568765, 0.0, 0.0, 0.0, 0.0, 4.450312892752409, 1.8915178993145003, -5.801203960010585,
         0.3111643669578199, -0.1521609496625161, 0.20136540080403034, 0.04471061572777259),
    order=8,
)
# fmt: on

# Up to this many stages are written out, the zeros of the tableau left out with them. Beyond it the stages run as a
# loop: order 8 written out takes XLA six times as long to compile and runs 1.3 times as fast for one trajectory.
_WRITTEN_OUT = 4


def explicit_step(tableau: Tableau, field: Callable[[State], State], state: State, dt: Scalar) -> State:
    """One step of size `dt` [s] of an explicit Runge-Kutta method for state' = field(state)."""
    stages = len(tableau.b)
    if stages <= _WRITTEN_OUT:
        slopes: list[State] = []
        for row in tableau.a:
            slopes.append(field(_displaced(state, dt, row, slopes)))
        return _displaced(state, dt, tableau.b, slopes)
    weights, final = jnp.asarray(_square(tableau)), jnp.asarray(tableau.b)
    leaves, structure = jax.tree.flatten(state)
    start = jnp.stack(leaves)

    def stage(index: Scalar, slopes: jax.Array) -> jax.Array:
        here = start + dt * jnp.tensordot(weights[index], slopes, 1)
        slope = field(jax.tree.unflatten(structure, list(here)))
        return slopes.at[index].set(jnp.stack(jax.tree.leaves(slope)))

    slopes_array = lax.fori_loop(0, stages, stage, jnp.zeros((stages, *start.shape)))
    return jax.tree.unflatten(structure, list(start + dt * jnp.tensordot(final, slopes_array, 1)))


def _displaced(state: State, dt: Scalar, row: tuple[float, ...], slopes: list[State]) -> State:
    """state + dt sum_j row_j slopes_j, without the terms whose weight is zero."""
    used = [(weight, slope) for weight, slope in zip(row, slopes, strict=True) if weight != 0.0]
    if not used:
        return state
    return jax.tree.map(
        lambda x, *ks: x + dt * sum(w * k for (w, _), k in zip(used, ks, strict=True)), state, *(k for _, k in used)
    )


def _square(tableau: Tableau) -> list[list[float]]:
    stages = len(tableau.b)
    return [[*row, *[0.0] * (stages - len(row))] for row in tableau.a]


_TABLEAUS = {"rk4": RK4, "rk8": RK8}


@dataclass(frozen=True)
class Scheme:
    """A method and its step: static and hashable, so that compiled functions are keyed by it.

    Attributes:
        name: `rk4` (the classical method of order 4) or `rk8` (the 12-stage order-8 propagator of DOP853).
        step: the largest step [s]; a motion of length t takes n = ceil(t/step) steps of t/n each.
    Raises:
        ValueError: an unknown name; a step that is not finite and positive.
    """

    name: str
    step: float

    def __post_init__(self) -> None:
        if self.name not in _TABLEAUS:
            raise ValueError(f"method must be one of {', '.join(_TABLEAUS)}, got {self.name!r}")
        object.__setattr__(self, "step", float(number("step", self.step, positive=True, unit="s")))

    @property
    def order(self) -> int:
        """The order p: the error of a motion falls like step^p."""
        return _TABLEAUS[self.name].order

    def advance(self, pendulum: Pendulum, state: State, dt: Scalar) -> State:
        """The state one step of `dt` [s] later; `dt` may be negative."""
        return explicit_step(_TABLEAUS[self.name], lambda x: vector_field(pendulum, x), state, dt)

    def advance_tangents(self, pendulum: Pendulum, state: State, tangents: State, dt: Scalar) -> tuple[State, State]:
        """One step of the state together with tangent vectors, by forward differentiation of the step itself.

        Arguments:
            tangents: as many vectors as wanted, leaves of shape (k,).
        Returns:
            The state, to the last bit that of `advance`, and the tangents.
        """

        def along(tangent: State) -> tuple[State, State]:
            return jax.jvp(lambda x: self.advance(pendulum, x, dt), (state,), (tangent,))

        return jax.vmap(along, out_axes=(None, 0))(tangents)

    def steps(self, duration: float) -> int:
        """The number of steps that a motion of `duration` [s] takes: ceil(|duration|/step - 1e-9).

        Raises:
            ValueError: the step is longer than the motion.
        """
        count = abs(duration) / self.step
        if 0.0 < count < 1.0 - 1e-9:
            raise ValueError(
                f"step must not be longer than the motion of {abs(duration):g} s, got {self.step:g}: "
                "give a smaller step"
            )
        return math.ceil(count - 1e-9)
