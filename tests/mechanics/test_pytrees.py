"""States and pendulums as trees: any leaf passes, and other libraries differentiate and fit
them.
"""

import copy
import pickle
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpend
from dpend import Pendulum, Scheme

DURATION, STEPS = 0.3, 60
START = dpend.released(0.7, -0.4)


def end(pendulum, start):
    """An angle at the end of a motion by dpend's own integrator."""
    return dpend.flow(pendulum, start, DURATION, Scheme("rk4", DURATION / STEPS)).theta2


DERIVATIVE = jax.jit(jax.grad(end, argnums=(0, 1)))


@pytest.mark.parametrize("tree", [Pendulum(), dpend.released(0.1, 0.2)])
@pytest.mark.parametrize(
    "leaf",
    [None, object(), True, "text", 0.0, -1.0, float("nan"), np.zeros((), jax.dtypes.float0)],
    ids=["None", "object", "bool", "text", "zero", "negative", "nan", "float0"],
)
def test_any_leaf_passes(tree, leaf):
    """Unflattening checks nothing, whatever comes."""
    filled = jax.tree.unflatten(jax.tree.structure(tree), [leaf] * len(jax.tree.leaves(tree)))
    assert type(filled) is type(tree)
    assert all(value is leaf for value in vars(filled).values())


def test_differences_shapes_and_keys():
    tree = Pendulum()
    zero = jax.tree.map(jnp.subtract, tree, tree)
    np.testing.assert_array_equal(jax.tree.leaves(zero), np.zeros(5))
    assert jax.eval_shape(lambda x: x, tree).l2 == jax.ShapeDtypeStruct((), jnp.float64)
    keys = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(START)]
    assert keys == [".theta1", ".theta2", ".p1", ".p2"]
    assert pickle.loads(pickle.dumps(tree)) == copy.deepcopy(tree) == tree
    with pytest.raises(ValueError, match="l1 must be a finite positive number .* got 0.0"):
        Pendulum(*jax.tree.leaves(jax.tree.map(float, zero)))


def solution(adjoint, pendulum, start):
    """The same motion by diffrax with the vector field as it stands."""
    import diffrax

    term = diffrax.ODETerm(lambda t, state, pendulum: dpend.vector_field(pendulum, state))
    return diffrax.diffeqsolve(
        term,
        diffrax.Dopri8(),
        0.0,
        DURATION,
        DURATION / STEPS,
        start,
        pendulum,
        adjoint=adjoint,
        max_steps=STEPS + 4,
    ).ys.theta2[-1]


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["ForwardMode", "RecursiveCheckpointAdjoint", "DirectAdjoint", "BacksolveAdjoint"]
)
def test_diffrax_takes_the_vector_field_and_its_adjoints_agree(name):
    import diffrax

    pendulum, start = Pendulum(), jax.tree.map(jnp.asarray, START)
    pendulum = jax.tree.map(jnp.asarray, pendulum)
    transform = jax.jacfwd if name == "ForwardMode" else jax.grad
    found = transform(lambda p, s: solution(getattr(diffrax, name)(), p, s), argnums=(0, 1))(
        pendulum, start
    )
    expected = DERIVATIVE(pendulum, start)
    # rk4 at 60 steps is right to 1e-6 of each derivative.
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7)


PERIOD = jax.jit(lambda pendulum: dpend.normal_modes(pendulum)[0].period)
WANTED = Pendulum(l2=0.31)


def misfit(pendulum):
    return (PERIOD(pendulum) - PERIOD(WANTED)) ** 2


def test_optax_recovers_a_length():
    import optax

    pendulum = jax.tree.map(jnp.asarray, Pendulum())
    mask = [jnp.asarray(name == "l2", jnp.float64) for name in ("l1", "l2", "m1", "m2", "g")]
    only_l2 = jax.tree.unflatten(
        jax.tree.structure(pendulum), mask
    )  # by hand no length may be zero
    method = optax.chain(optax.sgd(0.5), optax.scale(0.1))
    state = method.init(pendulum)

    def once(carry, _):
        pendulum, state = carry
        slope = jax.tree.map(jnp.multiply, jax.grad(misfit)(pendulum), only_l2)
        updates, state = method.update(slope, state, pendulum)
        return (optax.apply_updates(pendulum, updates), state), None

    (pendulum, _), _ = jax.jit(lambda carry: jax.lax.scan(once, carry, None, length=400))(
        (pendulum, state)
    )
    assert abs(pendulum.l2 - WANTED.l2) < 1e-6
    assert pendulum.l1 == 0.2


def test_equinox_takes_them_apart_and_together():
    import equinox as eqx

    pendulum = Pendulum()
    slope = eqx.filter_grad(misfit)(pendulum)
    np.testing.assert_allclose(
        jax.tree.leaves(slope), jax.tree.leaves(jax.grad(misfit)(pendulum)), rtol=1e-14
    )
    moved = eqx.apply_updates(pendulum, jax.tree.map(lambda x: -0.01 * x, slope))
    assert misfit(moved) < misfit(pendulum)
    mask = eqx.tree_at(lambda p: p.l2, jax.tree.map(lambda _: False, pendulum), True)
    free, held = eqx.partition(pendulum, mask)
    assert (free.l1, free.l2, held.l1, held.l2) == (None, 0.2, 0.2, None)
    assert eqx.combine(free, held) == pendulum
    assert eqx.tree_at(lambda p: p.l2, pendulum, None).l2 is None


@pytest.mark.slow
def test_optimistix_finds_a_pendulum():
    """The second length and the second mass from the periods of both modes; the rest is held."""
    import optimistix as optx

    wanted = Pendulum(l2=0.25, m2=0.13)
    modes = dpend.normal_modes(wanted)

    def residuals(pendulum, _):
        periods = [
            a.period / b.period - 1
            for a, b in zip(dpend.normal_modes(pendulum), modes, strict=True)
        ]
        return periods, [
            getattr(pendulum, name) - getattr(wanted, name) for name in ("l1", "m1", "g")
        ]

    start = jax.tree.map(jnp.asarray, Pendulum())
    with jax.numpy_dtype_promotion("standard"):
        found = optx.least_squares(
            residuals, optx.LevenbergMarquardt(1e-12, 1e-12), start, max_steps=100
        )
    np.testing.assert_allclose(jax.tree.leaves(found.value), jax.tree.leaves(wanted), rtol=1e-8)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_numpyro_samples_a_pendulum():
    """A pendulum as an argument and as a site of a model; numpyro is no dependency of the tests."""
    numpyro = pytest.importorskip("numpyro")

    def model(pendulum, period):
        factor = numpyro.sample("factor", numpyro.distributions.LogNormal(0.0, 0.1))
        longer = replace(pendulum, l2=pendulum.l2 * factor)
        numpyro.deterministic("pendulum", longer)
        numpyro.sample("period", numpyro.distributions.Normal(PERIOD(longer), 1e-3), obs=period)

    pendulum = Pendulum()
    kernel = numpyro.infer.NUTS(model)
    chain = numpyro.infer.MCMC(kernel, num_warmup=200, num_samples=200, progress_bar=False)
    with jax.numpy_dtype_promotion("standard"):
        chain.run(jax.random.key(0), pendulum, PERIOD(Pendulum(l2=0.22)))
    lengths = chain.get_samples()["pendulum"].l2
    assert abs(jnp.mean(lengths) - 0.22) < 4 * jnp.std(lengths) / 10
    assert 0 < jnp.std(lengths) < 0.01
