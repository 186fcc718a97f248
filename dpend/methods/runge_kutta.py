"""Explicit Runge-Kutta methods of order 4, 8 and 10, and `Form`: the variables in which a method
steps.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from dpend.checks import Scalar
from dpend.mechanics.pendulum import Pendulum, State, vector_field

# What a step moves: a pytree of scalars, the form's own.
Point: TypeAlias = Any
# What steps need of the pendulum and of their length: a pytree, the form's own.
Constants: TypeAlias = Any
# `explicit_step` of a tableau: (increment, point) -> the point one step later.
Step: TypeAlias = Callable[..., Point]

# Up to this many stages are written out in every form, without the zeros of the tableau. Beyond it
# the canonical form runs them as a loop, unless a scheme says otherwise: order 8 written out takes
# XLA six times as long to compile, and runs 1.5 times as fast for one trajectory but several times
# as fast for many at once.
WRITTEN_OUT = 4


@dataclass(frozen=True)
class Tableau:
    """An explicit Runge-Kutta method: stage weights `a` (row i has i entries), step weights `b`,
    and its order.
    """

    a: tuple[tuple[float, ...], ...]
    b: tuple[float, ...]
    order: int


RK4 = Tableau(
    a=((), (0.5,), (0.0, 0.5), (0.0, 0.0, 1.0)),
    b=(1 / 6, 1 / 3, 1 / 3, 1 / 6),
    order=4,
)

# The 12-stage propagator of DOP853 (Hairer, Norsett and Wanner, Solving Ordinary Differential
# Equations I), without its error estimators; coefficients as in SciPy's dop853_coefficients.py.
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
        (0.03709200011850479, 0.0, 0.0, 0.17038392571223998, 0.10726203044637328,
         -0.015319437748624402,
         0.008273789163814023),
        (0.6241109587160757, 0.0, 0.0, -3.3608926294469414, -0.868219346841726, 27.59209969944671,
         20.154067550477894, -43.48988418106996),
        (0.47766253643826434, 0.0, 0.0, -2.4881146199716677, -0.590290826836843, 21.230051448181193,
         15.279233632882423, -33.28821096898486, -0.020331201708508627),
        (-0.9371424300859873, 0.0, 0.0, 5.186372428844064, 1.0914373489967295, -8.149787010746927,
         -18.52006565999696, 22.739487099350505, 2.4936055526796523, -3.0467644718982196),
        (2.273310147516538, 0.0, 0.0, -10.53449546673725, -2.0008720582248625, -17.9589318631188,
         27.94888452941996,
         -2.8589982771350235, -8.87285693353063, 12.360567175794303, 0.6433927460157636),
    ),
    b=(0.054293734116568765, 0.0, 0.0, 0.0, 0.0, 4.450312892752409, 1.8915178993145003,
    -5.801203960010585,
         0.3111643669578199, -0.1521609496625161, 0.20136540080403034, 0.04471061572777259),
    order=8,
)
# fmt: on

# The 15-stage method of order 10 of Stepanov, On Runge-Kutta methods of order 10, arXiv 2504.17329
# (2025); coefficients as in rklib's rks10.
# fmt: off
RK10 = Tableau(
    a=(
        (),
        (0.13333333333333333,),
        (0.0, 0.26666666666666666),
        (0.1, 0.0, 0.3),
        (0.13411078717201166, 0.0, 0.08746355685131195, 0.3498542274052478),
        (0.32865893899779125, 0.0, -0.8431230447116361, 1.2303830647211609, 0.0628218025289758),
        (0.13018699084453347, 0.0, 0.0, 0.5807389729173741, -0.13206101704292822,
         0.06375081152134318),
        (0.11696914466403235, 0.0, 0.0, 0.804791321585223, -1.0324424073033935, 0.14123750757742515,
         0.8519720954414453),
        (0.07230137681531805, 0.0, 0.0, 0.27844935379385793, -0.7203557425293995,
         0.07147830972300757,
         0.48054612710039024, -0.06494708686790669),
        (-0.0336045800754256, 0.0, 0.0, -0.8576693886686749, 2.054105395119576,
         -0.20990904266184918,
         -1.3339722359516115, 0.18080634838458134, 0.31771584188867136),
        (0.03781005386193373, 0.0, 0.0, 0.04559155864157964, 0.37485824729474737,
         -0.018981904165238088,
         -0.3360388626375594, 0.04220771637555915, 0.05190036098369083, 0.1600370714049642),
        (0.025378474265434523, 0.0, 0.0, 0.3623063275434741, -2.13002206625995, 0.1672715948594377,
         1.5827509418646633, -0.20472018513908158, 0.3192653281448061, -0.19948525625469693,
         0.43463908273559),
        (0.02102955512349265, 0.0, 0.0, -0.20853138834469356, 0.32686349865476766,
         -0.04029159506346634,
         -0.06216857011008511, 0.019401511635634607, 0.0336189343221497, 0.184057539066669,
         0.12671904245006307,
         0.2419172305057909),
        (0.05901543960114423, 0.0, 0.0, 0.34675352940043946, -0.5435204392509414,
         0.06699832051343939,
         -0.2091059262738907, 0.03419681921537739, 0.656808691640117, -0.5300230864912716,
         0.6823707136215755,
         -0.5243167946491541, 0.8433503946378972),
        (-0.04044086632866268, 0.0, 0.0, -0.9361744121603922, 1.4674109549590162,
         -0.18088384977898705,
         1.1675891022744105, -0.28011360481035336, -1.8716683763485165, 2.2415881161250515,
         -1.5725720826914185,
         2.151700399601059, -1.8133404509027644, 0.6669050700615575),
    ),
    b=(0.03333333333333333, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.13516962724923107,
    0.054067850899692425,
       0.21577825773602247, 0.06165093078172071, 0.2774291885177432, 0.1892374781489235,
       0.03333333333333333),
    order=10,
)
# fmt: on


def explicit_step(
    tableau: Tableau,
    increment: Callable[[Point], Point],
    point: Point,
    *,
    written_out: bool = True,
    onto: Point | None = None,
) -> Point:
    """One step of an explicit Runge-Kutta method.

    Arguments:
        increment: increment(point) is the slope at a point times the step.
        onto: what the step is added to, by default the point itself.
    """
    base = point if onto is None else onto
    if written_out:
        slopes: list[Point] = []
        for row in tableau.a:
            slopes.append(increment(displace(point, row, slopes)))
        return displace(base, tableau.b, slopes)
    # Rows, one for each number that a leaf holds for each lane, so that a stage is one pass over
    # contiguous lanes.
    leaves, structure = jax.tree.flatten(point)
    lanes = min((jnp.shape(leaf) for leaf in leaves), key=len)
    ends = np.cumsum([math.prod(jnp.shape(leaf)) // math.prod(lanes) for leaf in leaves])

    def rows(tree: Point) -> jax.Array:
        return jnp.concatenate([jnp.reshape(leaf, (-1, *lanes)) for leaf in jax.tree.leaves(tree)])

    def tree(table: jax.Array) -> Point:
        parts = zip(leaves, jnp.split(table, ends[:-1]), strict=True)
        return jax.tree.unflatten(
            structure, [jnp.reshape(part, jnp.shape(leaf)) for leaf, part in parts]
        )

    start, stages = rows(point), len(tableau.b)
    weights = jnp.asarray(_square(tableau))

    def stage(index: Scalar, slopes: jax.Array) -> jax.Array:
        row = lax.dynamic_index_in_dim(
            weights, index, keepdims=False
        )  # `.at` and [] would check the index
        here = sum((row[j] * slopes[j] for j in range(stages - 1)), start=start)
        return lax.dynamic_update_index_in_dim(slopes, rows(increment(tree(here))), index, 0)

    slopes_table = lax.fori_loop(0, stages, stage, jnp.zeros((stages, *start.shape)))
    return tree(
        sum((b * slopes_table[j] for j, b in enumerate(tableau.b) if b != 0.0), start=rows(base))
    )


def displace(point: Point, row: tuple[float, ...], slopes: list[Point]) -> Point:
    """point + sum_j row_j slopes_j, without the terms whose weight is zero."""
    used = [(weight, slope) for weight, slope in zip(row, slopes, strict=True) if weight != 0.0]
    if not used:
        return point
    weights = [weight for weight, _ in used]
    return jax.tree.map(
        lambda x, *ks: sum((w * k for w, k in zip(weights, ks, strict=True)), start=x),
        point,
        *(k for _, k in used),
    )


def _square(tableau: Tableau) -> list[list[float]]:
    stages = len(tableau.b)
    return [[*row, *[0.0] * (stages - len(row))] for row in tableau.a]


def add_compensated(point: Point, change: Point) -> tuple[Point, Point]:
    """point + change, and what rounding takes from that sum (compensated summation)."""
    ahead = jax.tree.map(jnp.add, point, change)
    return ahead, jax.tree.map(lambda old, new, change: (old - new) + change, point, ahead, change)


class Form:
    """The variables in which a method steps: here the canonical ones, where a point is a `State`.

    Attributes:
        written_out: whether the stages of a step are written out whatever their number.
    """

    written_out = False

    def enter(self, pendulum: Pendulum, state: State) -> Point:
        """The point that stands for a state."""
        return state

    def leave(self, constants: Constants, point: Point) -> State:
        """The state that a point stands for."""
        state: State = point
        return state

    def constants(self, pendulum: Pendulum) -> Constants:
        """What steps of 1 s need."""
        return pendulum, 1.0

    def with_step(self, constants: Constants, dt: Scalar) -> Constants:
        """What steps of `dt` [s] need, from what those of 1 s need."""
        return constants[0], dt

    def increment(self, constants: Constants, point: Point) -> Point:
        """The slope at a point times the step."""
        pendulum, dt = constants
        return jax.tree.map(lambda slope: dt * slope, vector_field(pendulum, point))

    def move(self, step: Step, constants: Constants, point: Point) -> Point:
        """The point one step later."""
        return step(partial(self.increment, constants), point)

    def move_compensated(
        self, step: Step, constants: Constants, point: Point, rest: Point
    ) -> tuple[Point, Point]:
        """The point one step later, and what rounding has taken from its sums so far."""
        change = step(partial(self.increment, constants), point, onto=rest)
        return add_compensated(point, change)

    def move_tangents(
        self, step: Step, constants: Constants, point: Point, tangents: State
    ) -> tuple[Point, State]:
        """The point one step later, and its tangents: the step itself is differentiated."""

        def move_tangent(tangent: State) -> tuple[State, State]:
            return jax.jvp(partial(self.move, step, constants), (point,), (tangent,))

        return for_each_tangent(move_tangent, tangents, point)


def for_each_tangent(
    move_tangent: Callable[[State], tuple[Point, State]], tangents: State, state: State
) -> tuple[Point, State]:
    """`move_tangent` of one tangent, or of all along the axis that `tangents` have before those of
    `state`.
    """
    many = jnp.ndim(tangents.theta1) > jnp.ndim(state.theta1)
    return jax.vmap(move_tangent, out_axes=(None, 0))(tangents) if many else move_tangent(tangents)


CANONICAL = Form()
