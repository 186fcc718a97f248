"""One step of each integration method, and `Scheme`, the static pair of method and step that names a computation.

A step is traceable in the pendulum, the point and the step itself; forward and reverse derivatives go through it. The
point that a step moves is not always a `State`. There are two forms:

- canonical: the `State` itself, (theta, p);
- circle: sine and cosine of both angles are carried as state, s' = c omega and c' = -s omega, and the angles are two
  more sums that nothing depends on. No step computes a sine, which is half of the canonical form's work. Another
  discretisation of the same equations: s^2 + c^2 = 1 holds to the method's error, no better.

`gauss` is implicit, of order 6 and symplectic: the energy error does not grow with time, but for a part that vanishes
exponentially with the step (the paper's orbit at 40 degrees loses 2e-14 of its energy a period with 40 steps in it,
1e-17 with 60), and one of 2e-18 to 1e-17 a period whose cause is not known. Its point is a canonical state with the
rounding errors of all sums so far, which the next sum takes back.

The rescaled method takes equal steps in a time s of its own, dt/ds = u^(-5/8) with u = 1 + 0.85 q/omega_f^2,
q = omega1^2 + omega2^2 + (omega1 - omega2)^2 and omega_f the fast normal mode's frequency: short in t where the rods
fly. Each motion gets the steps that it needs, without a rejected one and without a branch. The step's length is fixed
before it is taken, so that its stages cost what those of an even step cost.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeAlias, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree

from dpend.checks import flag, instance, known_number, one_of
from dpend.pendulum import (
    Pendulum,
    Scalar,
    State,
    fast_frequency,
    hamiltonian,
    known_pendulum,
    vector_field,
)
from dpend.trig import sincos

# What a step moves: a pytree of scalars, the form's own.
Point: TypeAlias = Any


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

# The 15-stage method of order 10 of Stepanov, On Runge-Kutta methods of order 10, arXiv 2504.17329 (2025); coefficients
# as in rklib's rks10.
# fmt: off
RK10 = Tableau(
    a=(
        (),
        (0.13333333333333333,),
        (0.0, 0.26666666666666666),
        (0.1, 0.0, 0.3),
        (0.13411078717201166, 0.0, 0.08746355685131195, 0.3498542274052478),
        (0.32865893899779125, 0.0, -0.8431230447116361, 1.2303830647211609, 0.0628218025289758),
        (0.13018699084453347, 0.0, 0.0, 0.5807389729173741, -0.13206101704292822, 0.06375081152134318),
        (0.11696914466403235, 0.0, 0.0, 0.804791321585223, -1.0324424073033935, 0.14123750757742515,
         0.8519720954414453),
        (0.07230137681531805, 0.0, 0.0, 0.27844935379385793, -0.7203557425293995, 0.07147830972300757,
         0.48054612710039024, -0.06494708686790669),
        (-0.0336045800754256, 0.0, 0.0, -0.8576693886686749, 2.054105395119576, -0.20990904266184918,
         -1.3339722359516115, 0.18080634838458134, 0.31771584188867136),
        (0.03781005386193373, 0.0, 0.0, 0.04559155864157964, 0.37485824729474737, -0.018981904165238088,
         -0.3360388626375594, 0.04220771637555915, 0.05190036098369083, 0.1600370714049642),
        (0.025378474265434523, 0.0, 0.0, 0.3623063275434741, -2.13002206625995, 0.1672715948594377,
         1.5827509418646633, -0.20472018513908158, 0.3192653281448061, -0.19948525625469693, 0.43463908273559),
        (0.02102955512349265, 0.0, 0.0, -0.20853138834469356, 0.32686349865476766, -0.04029159506346634,
         -0.06216857011008511, 0.019401511635634607, 0.0336189343221497, 0.184057539066669, 0.12671904245006307,
         0.2419172305057909),
        (0.05901543960114423, 0.0, 0.0, 0.34675352940043946, -0.5435204392509414, 0.06699832051343939,
         -0.2091059262738907, 0.03419681921537739, 0.656808691640117, -0.5300230864912716, 0.6823707136215755,
         -0.5243167946491541, 0.8433503946378972),
        (-0.04044086632866268, 0.0, 0.0, -0.9361744121603922, 1.4674109549590162, -0.18088384977898705,
         1.1675891022744105, -0.28011360481035336, -1.8716683763485165, 2.2415881161250515, -1.5725720826914185,
         2.151700399601059, -1.8133404509027644, 0.6669050700615575),
    ),
    b=(0.03333333333333333, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.13516962724923107, 0.054067850899692425,
       0.21577825773602247, 0.06165093078172071, 0.2774291885177432, 0.1892374781489235, 0.03333333333333333),
    order=10,
)
# fmt: on

# Up to this many stages are written out, the zeros of the tableau left out with them. Beyond it the stages run as a
# loop unless a scheme says otherwise: order 8 written out takes XLA six times as long to compile and runs 1.5 times as
# fast for one trajectory, but several times as fast for many at once.
_WRITTEN_OUT = 4


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
            slopes.append(increment(_displaced(point, row, slopes)))
        return _displaced(base, tableau.b, slopes)
    # Rows, one for each number that a leaf holds for each lane, so that a stage is one pass over contiguous lanes.
    leaves, structure = jax.tree.flatten(point)
    lanes = min((jnp.shape(leaf) for leaf in leaves), key=len)
    ends = np.cumsum([math.prod(jnp.shape(leaf)) // math.prod(lanes) for leaf in leaves])

    def rows(tree: Point) -> jax.Array:
        return jnp.concatenate([jnp.reshape(leaf, (-1, *lanes)) for leaf in jax.tree.leaves(tree)])

    def tree(table: jax.Array) -> Point:
        parts = zip(leaves, jnp.split(table, ends[:-1]), strict=True)
        return jax.tree.unflatten(structure, [jnp.reshape(part, jnp.shape(leaf)) for leaf, part in parts])

    start, stages = rows(point), len(tableau.b)
    weights = jnp.asarray(_square(tableau))

    def stage(index: Scalar, slopes: jax.Array) -> jax.Array:
        row = lax.dynamic_index_in_dim(weights, index, keepdims=False)  # `.at` and [] would check the index
        here = sum((row[j] * slopes[j] for j in range(stages - 1)), start=start)
        return lax.dynamic_update_index_in_dim(slopes, rows(increment(tree(here))), index, 0)

    slopes_table = lax.fori_loop(0, stages, stage, jnp.zeros((stages, *start.shape)))
    return tree(sum((b * slopes_table[j] for j, b in enumerate(tableau.b) if b != 0.0), start=rows(base)))


def _displaced(point: Point, row: tuple[float, ...], slopes: list[Point]) -> Point:
    """point + sum_j row_j slopes_j, without the terms whose weight is zero."""
    used = [(weight, slope) for weight, slope in zip(row, slopes, strict=True) if weight != 0.0]
    if not used:
        return point
    weights = [weight for weight, _ in used]
    return jax.tree.map(
        lambda x, *ks: sum((w * k for w, k in zip(weights, ks, strict=True)), start=x), point, *(k for _, k in used)
    )


def _square(tableau: Tableau) -> list[list[float]]:
    stages = len(tableau.b)
    return [[*row, *[0.0] * (stages - len(row))] for row in tableau.a]


# --- the two forms ---------------------------------------------------------------------------------------------------


class _Circle(NamedTuple):
    """A state without trigonometry, in units that leave the field four constants.

    sin1 and cos1 lie on a circle of radius sqrt(mu), mu = m2/m1, so that their products with sin2 and cos2 are
    sqrt(mu) times the sine and cosine of delta = theta1 - theta2; rate1 = p1/(m1 l1^2) and
    rate2 = p2/(sqrt(mu) m1 l1 l2) are momenta [1/s].
    """

    theta1: Scalar
    theta2: Scalar
    sin1: Scalar
    cos1: Scalar
    sin2: Scalar
    cos2: Scalar
    rate1: Scalar
    rate2: Scalar


def _root_mu(pendulum: Pendulum) -> Scalar:
    return jnp.sqrt(pendulum.m2 / pendulum.m1)


def _rate_units(pendulum: Pendulum) -> tuple[Scalar, Scalar]:
    """The momenta that belong to rate1 = rate2 = 1/s."""
    unit1 = pendulum.m1 * pendulum.l1 * pendulum.l1
    return unit1, _root_mu(pendulum) * pendulum.m1 * pendulum.l1 * pendulum.l2


def _to_circle(pendulum: Pendulum, state: State) -> _Circle:
    sin1, cos1 = sincos(state.theta1)
    sin2, cos2 = sincos(state.theta2)
    root = _root_mu(pendulum)
    unit1, unit2 = _rate_units(pendulum)
    return _Circle(state.theta1, state.theta2, root * sin1, root * cos1, sin2, cos2, state.p1 / unit1, state.p2 / unit2)


class _Constants(NamedTuple):
    """What a circle's slopes need of the pendulum and the step; the pendulum's share is computed once, outside the loop
    over steps.
    """

    step: Scalar  # dt [s]
    unit1: Scalar  # the momenta that belong to rate1 = rate2 = 1/s
    unit2: Scalar
    per_unit1: Scalar  # their inverses: a division costs as much as a dozen multiplications
    per_unit2: Scalar
    mass_ratio: Scalar  # 1 + mu
    ratio: Scalar  # l1/(l2 sqrt(mu))
    back: Scalar  # its inverse
    weight1: Scalar  # of gravity, times the step
    weight2: Scalar
    rescaling: Scalar  # 0.85/omega_f^2, zero without gravity: nothing but the motion itself then sets a time


# The weight of q in u. With it and the power -5/8 of u an error of 6e-6 and of 8e-9 rad, on releases over the whole
# square, takes the fewest steps: 10 % fewer than with a weight of 1 and the power -1/2.
_SPIN_WEIGHT = 0.85


def _circle_constants(pendulum: Pendulum) -> _Constants:
    """The constants of a step of 1 s."""
    root = _root_mu(pendulum)
    mass_ratio = 1.0 + pendulum.m2 / pendulum.m1
    frequency = fast_frequency(pendulum)
    swings = frequency > 0
    unit1, unit2 = _rate_units(pendulum)
    return _Constants(
        jnp.ones_like(root),
        unit1,
        unit2,
        1.0 / unit1,
        1.0 / unit2,
        mass_ratio,
        pendulum.l1 / (root * pendulum.l2),
        root * pendulum.l2 / pendulum.l1,
        mass_ratio * pendulum.g / (pendulum.l1 * root),
        pendulum.g * root / pendulum.l1,
        jnp.where(swings, _SPIN_WEIGHT / jnp.where(swings, frequency, 1.0) ** 2, 0.0),
    )


class _Tangent(NamedTuple):
    """A displacement of the angles and the rates."""

    angle1: Scalar
    angle2: Scalar
    rate1: Scalar
    rate2: Scalar


class _Motion(NamedTuple):
    """What slopes and tangents of a circle are made of."""

    sin_delta: Scalar  # times sqrt(mu), as cos_delta
    cos_delta: Scalar
    inverse: Scalar  # 1/(1 + mu sin^2 delta)
    omega1: Scalar  # [1/s]
    omega2: Scalar


def _motion(constants: _Constants, x: _Circle) -> _Motion:
    sin_delta = x.sin1 * x.cos2 - x.cos1 * x.sin2
    cos_delta = x.cos1 * x.cos2 + x.sin1 * x.sin2
    inverse = 1.0 / (1.0 + sin_delta * sin_delta)
    omega1 = inverse * (x.rate1 - cos_delta * x.rate2)
    omega2 = inverse * (constants.ratio * (constants.mass_ratio * x.rate2 - cos_delta * x.rate1))
    return _Motion(sin_delta, cos_delta, inverse, omega1, omega2)


def _circle_increment(constants: _Constants, x: _Circle) -> _Circle:
    """Hamilton's equations times dt; s' = c omega, c' = -s omega."""
    motion = _motion(constants, x)
    turn1, turn2 = constants.step * motion.omega1, constants.step * motion.omega2
    pull = turn1 * motion.sin_delta * motion.omega2
    rate1 = -(constants.back * pull) - constants.weight1 * x.sin1
    rate2 = pull - constants.weight2 * x.sin2
    return _Circle(turn1, turn2, x.cos1 * turn1, -x.sin1 * turn1, x.cos2 * turn2, -x.sin2 * turn2, rate1, rate2)


def _tangent_increment(constants: _Constants, pair: tuple[_Circle, _Tangent]) -> tuple[_Circle, _Tangent]:
    """Increments of a circle and of a tangent of it: the variational equations in the angles, written out.

    Four components where the circle has eight, and two thirds of the operations of `jax.jvp`, which tests hold it to.
    """
    x, d = pair
    sin_delta, cos_delta, inverse, omega1, omega2 = _motion(constants, x)
    between = d.angle1 - d.angle2
    shear = sin_delta * between  # -d cos(delta)
    deepening = 2.0 * cos_delta * shear  # d (1 + mu sin^2 delta)
    step = constants.step * inverse
    turn1 = step * (d.rate1 - cos_delta * d.rate2 + shear * x.rate2 - deepening * omega1)
    turn2 = step * (
        constants.ratio * (constants.mass_ratio * d.rate2 - cos_delta * d.rate1 + shear * x.rate1) - deepening * omega2
    )
    pull = sin_delta * (turn1 * omega2 + omega1 * turn2) + constants.step * (omega1 * omega2) * (cos_delta * between)
    rate1 = -(constants.back * pull) - constants.weight1 * (x.cos1 * d.angle1)
    rate2 = pull - constants.weight2 * (x.cos2 * d.angle2)
    return _circle_increment(constants, x), _Tangent(turn1, turn2, rate1, rate2)


def _spin(constants: _Constants, x: _Circle) -> Scalar:
    """u = 1 + 0.85 (omega1^2 + omega2^2 + (omega1 - omega2)^2)/omega_f^2."""
    motion = _motion(constants, x)
    between = motion.omega1 - motion.omega2
    return 1.0 + constants.rescaling * (
        motion.omega1 * motion.omega1 + motion.omega2 * motion.omega2 + between * between
    )


def _canonical_increment(constants: tuple[Pendulum, Scalar], state: State) -> State:
    pendulum, dt = constants
    return jax.tree.map(lambda slope: dt * slope, vector_field(pendulum, state))


# --- methods ---------------------------------------------------------------------------------------------------------


# Collocation at the three Gauss-Legendre nodes (Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I):
# rows of `a` have as many entries as there are stages.
_ROOT15 = math.sqrt(15.0)
GAUSS = Tableau(
    a=(
        (5 / 36, 2 / 9 - _ROOT15 / 15, 5 / 36 - _ROOT15 / 30),
        (5 / 36 + _ROOT15 / 24, 2 / 9, 5 / 36 - _ROOT15 / 24),
        (5 / 36 + _ROOT15 / 30, 2 / 9 + _ROOT15 / 15, 5 / 36),
    ),
    b=(5 / 18, 4 / 9, 5 / 18),
    order=6,
)
# a_ij/b_j. The method is symplectic where b_i a_ij + b_j a_ji = b_i b_j, that is where the shares of ij and of ji add
# up to 1, and symmetric in time where those of ij and of (4 - i)(4 - j) do. These doubles do both to the last bit; a_ij
# themselves are off by 1e-17, and so would the energy be, in one direction, period by period.
_NEAR, _FAR = 0.5 + 0.15 * _ROOT15, 0.5 + 0.12 * _ROOT15
_SHARES = ((0.5, 1.0 - _NEAR, 1.0 - _FAR), (_NEAR, 0.5, 1.0 - _NEAR), (_FAR, _NEAR, 0.5))
# An iteration that has come this near [rad] and gets no nearer has met rounding; one that has not in so many rounds
# finds no solution.
_NEARLY, _MOST_ROUNDS = 1e-9, 100


class _Summed(NamedTuple):
    """A state, and what rounding has taken from its sums: the two together are the motion (compensated summation)."""

    state: State
    rest: State


class _Round(NamedTuple):
    """Slopes at all stages, the size of their last change and of the one before, and the number of rounds."""

    slopes: tuple[State, ...]
    size: Scalar
    last: Scalar
    count: Scalar


def _gauss_slopes(pendulum: Pendulum, dt: Scalar, state: State) -> tuple[State, ...]:
    """The slopes at the stages of the step of `dt` [s], k_i = f(x + dt sum_j a_ij k_j), by fixed-point iteration.

    Until the changes stop falling, which is the last bit: ended at a tolerance it would leave an error of one sign in
    every step, and the energy would drift (Hairer, McLachlan and Razakarivony, Achieving Brouwer's law with implicit
    Runge-Kutta methods, 2007). NaN where there is no solution, the step being too large.
    """
    # Momenta as the rates of rods of that inertia, so that all changes are angles.
    length = jnp.abs(dt)  # steps may go backwards
    inverse1 = length / ((pendulum.m1 + pendulum.m2) * pendulum.l1**2)
    inverse2 = length / (pendulum.m2 * pendulum.l2**2)

    def size_of(old: State, new: State) -> Scalar:
        change = jax.tree.map(lambda a, b: jnp.abs(a - b), old, new)
        angles = jnp.maximum(change.theta1, change.theta2)
        return length * jnp.maximum(angles, jnp.maximum(change.p1 * inverse1, change.p2 * inverse2))

    def again(r: _Round) -> _Round:
        slopes = _at_stages(pendulum, dt, state, r.slopes)
        sizes = [size_of(old, new) for old, new in zip(r.slopes, slopes, strict=True)]
        return _Round(slopes, jnp.maximum(sizes[0], jnp.maximum(sizes[1], sizes[2])), r.size, r.count + 1)

    def goes_on(r: _Round) -> Scalar:
        return jnp.any((r.size > 0) & ((r.size < r.last) | (r.size > _NEARLY))) & (r.count < _MOST_ROUNDS)

    start = vector_field(pendulum, state)
    far = jnp.full_like(start.theta1, jnp.inf)
    end = lax.while_loop(goes_on, again, _Round((start,) * 3, far, far, jnp.asarray(0)))
    return jax.tree.map(lambda leaf: jnp.where(end.size <= _NEARLY, leaf, jnp.nan), end.slopes)


def _at_stages(pendulum: Pendulum, dt: Scalar, state: State, slopes: tuple[State, ...]) -> tuple[State, ...]:
    steps = [jax.tree.map(partial(jnp.multiply, dt * b), slope) for b, slope in zip(GAUSS.b, slopes, strict=True)]
    return tuple(vector_field(pendulum, _displaced(state, row, steps)) for row in _SHARES)


# Leaves alone: JAX describes trees under custom rules with text in the place of their leaves, which `State` refuses.
@jax.custom_jvp
def _gauss_leaves(pendulum: list[Scalar], dt: Scalar, state: list[Scalar]) -> list[Scalar]:
    return jax.tree.leaves(_gauss_slopes(Pendulum(*pendulum), dt, State(*state)))


@_gauss_leaves.defjvp
def _gauss_leaves_jvp(primals, tangents):  # type: ignore[no-untyped-def]
    """By the implicit function theorem: one linear system in place of the iteration."""
    leaves = _gauss_leaves(*primals)
    flat, tree = ravel_pytree(leaves)

    def again(leaves: list[Scalar], pendulum: list[Scalar], dt: Scalar, state: list[Scalar]) -> jax.Array:
        slopes = tuple(State(*leaves[i : i + 4]) for i in (0, 4, 8))
        return ravel_pytree(_at_stages(Pendulum(*pendulum), dt, State(*state), slopes))[0]

    _, forcing = jax.jvp(partial(again, leaves), primals, tangents)
    matrix = jax.jacfwd(lambda vector: vector - again(tree(vector), *primals))(flat)
    return leaves, tree(jnp.linalg.solve(matrix, forcing))


def _gauss_step(constants: tuple[Pendulum, Scalar], point: _Summed) -> _Summed:
    pendulum, dt = constants
    leaves = _gauss_leaves(jax.tree.leaves(pendulum), dt, jax.tree.leaves(point.state))
    slopes = [State(*leaves[i : i + 4]) for i in (0, 4, 8)]
    steps = [jax.tree.map(partial(jnp.multiply, dt * b), slope) for b, slope in zip(GAUSS.b, slopes, strict=True)]
    change = _displaced(point.rest, (1.0,) * 3, steps)
    state = jax.tree.map(jnp.add, point.state, change)
    rest = jax.tree.map(lambda old, new, change: (old - new) + change, point.state, state, change)
    return _Summed(state, rest)


class _Method(NamedTuple):
    tableau: Tableau
    circle: bool  # or canonical
    even: bool = True  # steps equally long in time
    implicit: bool = False


# Every method by name.
METHODS = {
    "rk4": _Method(RK4, False),
    "rk8": _Method(RK8, False),
    "rk4-circle": _Method(RK4, True),
    "rk8-circle": _Method(RK8, True),
    "rk8-circle-rescaled": _Method(RK8, True, even=False),
    "rk10-circle-rescaled": _Method(RK10, True, even=False),
    "gauss": _Method(GAUSS, False, implicit=True),
}
# A release near the bottom swings slowly and evenly: it is given longer steps, in proportion to (energy above the
# bottom)^-0.2, at most these times as long. Measured on releases over the whole square.
_PACE_POWER, _LONGEST_PACE = -0.2, 1.9


@dataclass(frozen=True)
class Scheme:
    """A method and its step: static and hashable, so that compiled functions are keyed by it.

    Attributes:
        name: `rk4` (the classical method of order 4) or `rk8` (the 12-stage order-8 propagator of DOP853), both in
            (theta, p); `rk4-circle` and `rk8-circle`, the same without trigonometry; `rk8-circle-rescaled` and
            `rk10-circle-rescaled` (15 stages, order 10, by Stepanov), in rescaled time; `gauss` (Gauss-Legendre, three
            stages, order 6) in (theta, p), symplectic, for motions over very many periods: a step takes as long as two
            of `rk8` written out.
        step: the step [s]. Even methods take n = ceil(t/step) steps of t/n each over a motion of length t; the
            rescaled one takes steps of at most `step`, near the bottom 1.9 `step`, much shorter where it flies.
        written_out: whether all stages of a step are written out, or run as a loop: slower to compile, faster for many
            lanes. By default the circle forms are, and order 8 in (theta, p) is not.
    Raises:
        ValueError: an unknown name; a step that is not finite and positive, or traced; written_out not a boolean.
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
    def _circle(self) -> bool:
        return METHODS[self.name].circle

    @property
    def _implicit(self) -> bool:
        return METHODS[self.name].implicit

    @property
    def _rolled(self) -> bool:
        if self.written_out is None:
            return not self._circle and len(METHODS[self.name].tableau.b) > _WRITTEN_OUT
        return not self.written_out

    def enter(self, pendulum: Pendulum, state: State) -> Point:
        """The method's own form of a state; `State` itself for methods in (theta, p)."""
        if self._implicit:
            return _Summed(state, jax.tree.map(jnp.zeros_like, state))
        return _to_circle(pendulum, state) if self._circle else state

    def leave(self, constants: Any, point: Point) -> State:
        """The state that a point stands for."""
        if self._implicit:
            return cast(State, point.state)
        if not self._circle:
            return cast(State, point)
        return State(point.theta1, point.theta2, constants.unit1 * point.rate1, constants.unit2 * point.rate2)

    def constants(self, pendulum: Pendulum, dt: Scalar = 1.0) -> Any:
        """What steps of `dt` [s] need, computed once; dt may be negative."""
        return self.lasting(_circle_constants(pendulum) if self._circle else (pendulum, dt), dt)

    def lasting(self, constants: Any, dt: Scalar) -> Any:
        """The constants of steps of `dt` [s], from those of steps of 1 s."""
        if not self._circle:
            return constants[0], dt
        return constants._replace(
            step=constants.step * dt, weight1=constants.weight1 * dt, weight2=constants.weight2 * dt
        )

    def move(self, constants: Any, point: Point) -> Point:
        """The point one step later."""
        if self._implicit:
            return _gauss_step(constants, point)
        increment = _circle_increment if self._circle else _canonical_increment
        tableau = METHODS[self.name].tableau
        return explicit_step(tableau, partial(increment, constants), point, written_out=not self._rolled)

    def move_compensated(self, constants: Any, point: Point, rest: Point) -> tuple[Point, Point]:
        """The point one step later, the rounding errors of its sums kept (compensated summation).

        Arguments:
            rest: what rounding has taken from the sums so far, zeros at the start; the same tree as the point.
        Returns:
            The point and the rest, which together are the motion.
        """
        if self._implicit:
            return self.move(constants, point), rest  # its points hold a rest of their own
        increment = partial(_circle_increment if self._circle else _canonical_increment, constants)
        tableau = METHODS[self.name].tableau
        change = explicit_step(tableau, increment, point, written_out=not self._rolled, onto=rest)
        ahead = jax.tree.map(jnp.add, point, change)
        return ahead, jax.tree.map(lambda old, new, change: (old - new) + change, point, ahead, change)

    def move_tangents(self, constants: Any, point: Point, tangents: State) -> tuple[Point, State]:
        """One step of a point together with tangent vectors of it.

        In (theta, p) the step itself is differentiated; the circle forms apply the method to the variational equations
        along its own stages, which is the same but for the circle's drift, and leaves four components of six. Neither
        changes the point.

        Arguments:
            tangents: (d theta1, d theta2, d p1, d p2) as a `State`: one vector, with leaves of the point's shape, or
                as many as wanted along a new leading axis.
        Returns:
            The point and the tangents.
        """
        if self._implicit:
            return self._gauss_tangents(constants, point, tangents)
        if not self._circle:
            one = partial(jax.jvp, partial(self.move, constants), (point,))
            many = jnp.ndim(tangents.theta1) > jnp.ndim(point.theta1)
            return jax.vmap(lambda d: one((d,)), out_axes=(None, 0))(tangents) if many else one((tangents,))
        rates = constants.per_unit1 * tangents.p1, constants.per_unit2 * tangents.p2
        tangent = _Tangent(tangents.theta1, tangents.theta2, *rates)
        increment = partial(_tangent_increment, constants)
        tableau = METHODS[self.name].tableau
        point, tangent = explicit_step(tableau, increment, (point, tangent), written_out=not self._rolled)
        return point, State(
            tangent.angle1, tangent.angle2, constants.unit1 * tangent.rate1, constants.unit2 * tangent.rate2
        )

    def _gauss_tangents(self, constants: Any, point: _Summed, tangents: State) -> tuple[_Summed, State]:
        def one(tangent: State) -> tuple[_Summed, State]:
            nothing = jax.tree.map(jnp.zeros_like, tangent)
            moved, change = jax.jvp(partial(_gauss_step, constants), (point,), (_Summed(tangent, nothing),))
            return moved, jax.tree.map(jnp.add, change.state, change.rest)

        many = jnp.ndim(tangents.theta1) > jnp.ndim(point.state.theta1)
        return jax.vmap(one, out_axes=(None, 0))(tangents) if many else one(tangents)

    def advance(self, pendulum: Pendulum, point: Point, dt: Scalar) -> Point:
        """The point one step of `dt` [s] later; `dt` may be negative."""
        return self.move(self.constants(pendulum, dt), point)

    def advance_tangents(self, pendulum: Pendulum, point: Point, tangents: State, dt: Scalar) -> tuple[Point, State]:
        """The point and its tangents one step of `dt` [s] later."""
        return self.move_tangents(self.constants(pendulum, dt), point, tangents)

    def spin(self, constants: Any, point: Point) -> Scalar:
        """The u >= 1 by which the rescaled method goes: u = 1 + 0.85 q/omega_f^2."""
        return lax.stop_gradient(_spin(constants, point))

    def pace(self, pendulum: Pendulum, state: State) -> Scalar:
        """The longest step of this motion in units of `step`: 1, but for rescaled time near the bottom."""
        bottom = (pendulum.m1 + pendulum.m2) * pendulum.l1 + pendulum.m2 * pendulum.l2
        height = 0.5 * (hamiltonian(pendulum, state) / (jnp.abs(pendulum.g) * bottom) + 1.0)
        height = jnp.where(jnp.isfinite(height), height, 1.0)  # no gravity, no bottom
        longest = _LONGEST_PACE ** (1 / _PACE_POWER)
        return lax.stop_gradient(jnp.clip(height, longest, 1.0) ** _PACE_POWER)

    def steps(self, duration: float | Any) -> int:
        """The number of even steps that a motion of `duration` [s] takes: ceil(|duration|/step - 1e-9).

        Raises:
            ValueError: the step is longer than the motion, or so short that they would never end; the duration is no
                known finite number.
        """
        duration = known_number("duration", duration, unit="s")
        count = abs(duration) / self.step
        if count > _MOST_STEPS:
            raise ValueError(
                f"step must make at most {_MOST_STEPS:.0e} steps, got {self.step:g} s, which makes {count:.3g}: "
                "give a larger step, or a shorter duration"
            )
        if 0.0 < count < 1.0 - 1e-9:
            raise ValueError(
                f"step must not be longer than the motion of {abs(duration):g} s, got {self.step:g}: "
                "give a smaller step"
            )
        return math.ceil(count - 1e-9)


def check_scheme(scheme: Any) -> None:
    """Refuses what is no `Scheme`.

    Raises:
        ValueError: another class, a method's name among them.
    """
    instance("scheme", scheme, Scheme, 'dpend.Scheme("rk8", 1e-3) or dpend.scheme_for(pendulum, 1e-9)')


# A week of one motion at two million steps a second: what takes longer does not end.
_MOST_STEPS = 1e12


# The step in units of 1/(fast mode's frequency) against the error of the larger angle [rad]: 99th percentile over
# 64 x 64 releases from rest on the whole square, after 2 s of the paper's pendulum, nearly two periods of its slow mode
# (experiments/speed_vs_error.py). At no error was another method faster.
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
# Below this error [rad] order 10 is the faster, by 1.2 at 3e-11; above it they are alike, and order 8 compiles sooner.
_ORDER_10_BELOW = 2e-8

# How much shorter the step has to be for other pendulums than the paper's, whose masses are equal: against m2/m1, from
# the error at one step on the same releases; and at lengths l2/l1 = 0.25 to 4 at most by (l2/l1)^0.15.
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


def scheme_for(pendulum: Pendulum | Any, tolerance: float | Any) -> Scheme:
    """The fastest scheme for many motions whose angles are to be right to `tolerance`, 99 in 100 of them.

    "Right" is measured on releases from rest over the whole square of angles, after about two periods of the slow
    mode, chaotic motions among them; `sweep(..., error="half-step")` tells cell by cell how it went.

    Arguments:
        pendulum: its fields are numbers.
        tolerance: of the larger angle [rad]; below 2e-11 the step is that of 2e-11, where rounding takes over, above
            3e-2 that of 3e-2. Measured for mass ratios m2/m1 of 0.01 to 100 and lengths l2/l1 of 0.25 to 4.
    Raises:
        ValueError: tolerance not positive; gravity zero, which sets no time; a traced argument.
    """
    pendulum = known_pendulum(pendulum)
    tolerance = known_number("tolerance", tolerance, positive=True, unit="rad")
    frequency = float(fast_frequency(pendulum))
    if not frequency > 0:
        raise ValueError(f"g must not be zero for a tolerance, got {float(pendulum.g)}: give a method and a step")
    name = "rk10-circle-rescaled" if tolerance < _ORDER_10_BELOW else "rk8-circle-rescaled"
    turns, errors = zip(*_ERROR_OF_STEP[name], strict=True)
    turn = math.exp(np.interp(math.log(tolerance), np.log(errors), np.log(turns)))
    ratios, factors = zip(*_SHORTER_FOR_MASSES, strict=True)
    turn *= math.exp(np.interp(math.log(pendulum.m2 / pendulum.m1), np.log(ratios), np.log(factors)))
    turn *= min(1.0, float(pendulum.l2 / pendulum.l1)) ** 0.15
    return Scheme(name, turn / frequency)
