"""Balls, Taylor series and tubes against motions that are known."""

import math
from fractions import Fraction

import numpy as np
import pytest

flint = pytest.importorskip("flint")

from flint import arb, arb_mat  # noqa: E402

import dpend  # noqa: E402
from dpend.proofs.balls import (  # noqa: E402
    Parameters,
    ball_of,
    enclosure_of,
    field,
    field_and_jacobian,
    gamma,
    precision,
    upper,
)
from dpend.proofs.chain import release  # noqa: E402
from dpend.proofs.decimals import Enclosure, below  # noqa: E402
from dpend.proofs.digits import refine  # noqa: E402
from dpend.proofs.flow import Discs, Tubes, enclose  # noqa: E402
from dpend.proofs.proof import prove  # noqa: E402
from dpend.proofs.taylor import jacobian_series, motion_series, tangent_series  # noqa: E402

PAPER = Parameters("0.2", "0.2", "0.1", "0.1", "9.8")
UNEQUAL = Parameters("0.2", "0.34", "0.1", "0.07", "9.8")
TERMS = 30


class Uncoupled(Parameters):
    """lambda to infinity and mu to zero: a'' = -sin a is a simple pendulum, b stays where it is."""

    def exact(self):
        return tuple(map(Fraction, (0, 0, 1, 0, 1)))


SIMPLE = Uncoupled("1", "1", "1", "1", "1")


def discs_of(parameters, states, half):
    """Discs of duration 1 about states."""
    ratios, half = parameters.floats(), np.asarray(half, float)
    series = motion_series(ratios, np.asarray(states, float), half, 20)
    tangents = tangent_series(jacobian_series(ratios, series), half)
    return Discs(series, tangents, half, 1.0)


def tubes_of(parameters, states, half, width, time_radius=0.0) -> tuple[Discs, Tubes]:
    with precision(64, TERMS):
        discs = discs_of(parameters, states, half)
        known = np.zeros((len(discs.half), 4))
        tube = np.full(len(discs.half), width)
        return discs, enclose(parameters.balls(), discs, tube, time_radius, known, TERMS)


def test_upper_is_not_below():
    x = arb(1) / 3 + arb(0, 1e-5)
    assert arb(upper(x)) >= abs(x)
    assert upper(x) < 1 / 3 + 1.1e-5
    assert Fraction(gamma(100)) > Fraction(100, 2**53) / (1 - Fraction(100, 2**53))


@pytest.mark.parametrize("text", ["[0.1 +/- 1e-20]", "[-3.25 +/- 0.01]", "1.5", "[+/- 1e-9]"])
def test_printed_intervals_hold_their_ball_and_are_read_back(text):
    with precision(100):
        ball = arb(text)
        printed = enclosure_of(ball)
        assert ball_of(printed).contains(ball)
        assert Fraction(printed.radius) <= Fraction(str(float(ball.rad()) * 1.2 + 1e-25))


def test_below_is_below():
    assert [below(1.0), below(1e-7)] == ["9.990e-01", "9.990e-08"]
    assert all(0 < float(below(x)) < x for x in np.geomspace(1e-12, 1e3, 1000))


def test_interval_says_what_it_holds():
    third = Enclosure("0.3333", "0.0001")
    assert third.contains(Fraction(1, 3)) is True
    assert third.contains(Fraction(1, 4)) is False


@pytest.mark.parametrize("parameters", [PAPER, UNEQUAL])
def test_field_is_that_of_the_package(parameters):
    rng = np.random.default_rng(7)
    lam = float(Fraction(parameters.l2) / Fraction(parameters.l1))
    mu = float(Fraction(parameters.m2) / Fraction(parameters.m1))
    pendulum = dpend.Pendulum(1.0, lam, 1.0, mu, 1.0)
    for state in rng.uniform(-3, 3, (20, 4)):
        truth = dpend.vector_field(pendulum, dpend.State(*map(float, state)))
        with precision(64):
            found = field(parameters.balls(), [arb(x) for x in state])
            _, entries = field_and_jacobian(parameters.balls(), [arb(x) for x in state])
        expected = [float(getattr(truth, name)) for name in ("theta1", "theta2", "p1", "p2")]
        assert [float(x) for x in found] == pytest.approx(expected, rel=1e-12, abs=1e-12)
        series = jacobian_series(parameters.floats(), state[None, None])[0, 0]
        named = [series[0, 0], series[1, 0], series[0, 2], series[0, 3], series[1, 3]]
        named += [series[2, 0], series[2, 1], series[3, 1]]
        assert [float(x) for x in entries] == pytest.approx(named, rel=1e-12, abs=1e-12)


def test_harmonic_oscillator_is_enclosed():
    """About the hanging state the derivative of the flow is that of two harmonic oscillators."""
    half = [0.05, 0.1, 0.2, 0.3]
    discs, tubes = tubes_of(PAPER, np.zeros((4, 4)), half, 1e-9)
    with precision(100):
        _, inverse, k, nu, weight = PAPER.balls()
        rows = [0, 0, 1, -inverse, 0, 0, -inverse, k, -weight, 0, 0, 0, 0, -nu, 0, 0]
        for i, w in enumerate(half):
            for sign, found in ((1, tubes.plus), (-1, tubes.minus)):
                truth = (arb_mat(4, 4, rows) * arb(sign * w)).exp()
                for a in range(4):
                    for b in range(4):
                        ball = arb(found[i, a, b], tubes.spread[i, a, b])
                        assert ball.contains(truth[a, b])
        assert tubes.spread.max() < 2e-8
    assert discs.series[1:].max() == 0.0


@pytest.mark.parametrize("degrees", ["1", "40", "120", "179"])
def test_simple_pendulum_is_enclosed_to_a_hundred_digits(degrees):
    """The period of a simple pendulum is 4 K(sin^2(theta/2)), a mean of Gauss: 2 pi/agm."""

    def theta1():
        return arb.pi() * int(degrees) / 180

    with precision(500):
        quarter = arb.pi() / 2 / (theta1() / 2).cos().agm(arb(1))
    start = [math.radians(float(degrees)), 1e-9, 0.0, 0.0]
    proof = prove(release(SIMPLE, theta1, (0, 0)), start, float(quarter) * (1 + 1e-9))
    assert abs(proof.discs.series[0, 0, 1]) <= proof.radii[1]
    with precision(64):
        assert arb(proof.discs.duration, float(proof.radii[0])).overlaps(quarter)
    fine = refine(proof, 100)
    with precision(500):
        assert fine.duration.contains(quarter)
        assert fine.start[1].contains(0)
        assert upper(fine.duration - quarter) < 1e-100


def test_enclosures_grow_with_their_boxes():
    """A wider tube holds what a narrower one holds."""
    states, half = [[1.0, -0.5, 0.3, 0.2], [2.0, 2.5, -1.0, 0.4]], [0.1, 0.08]
    before = None
    for width in (1e-12, 1e-10, 1e-8, 1e-6, 1e-4):
        _, tubes = tubes_of(PAPER, states, half, width, width)
        if before is not None:
            assert (tubes.growth >= before.growth).all()
            assert (tubes.spread >= before.spread).all()
            assert (tubes.slope_spread >= before.slope_spread).all()
            assert (tubes.defect >= before.defect * (1 - 1e-9)).all()
            for side in (0, 1):
                gap = np.abs(tubes.slopes[side] - before.slopes[side])
                assert (gap <= tubes.slope_spread - before.slope_spread + 1e-12).all()
        before = tubes


@pytest.mark.parametrize("parameters", [PAPER, UNEQUAL])
def test_random_points_stay_inside(parameters):
    """A thousand releases near the centres: their motions, by Taylor series of order 40 in steps a
    quarter as long, end within the bound; so do differences of motions against the derivative.
    """
    rng = np.random.default_rng(5)
    states, half, width = rng.uniform(-1.5, 1.5, (5, 4)), np.full(5, 0.04), 1e-5
    discs, tubes = tubes_of(parameters, states, half, width)
    room = tubes.room(np.full(5, width), 1.0)
    assert room > 0.1 * width
    for i in range(5):
        starts = states[i] + room * rng.uniform(-1, 1, (200, 4))
        for sign, ends in ((1, tubes.plus), (-1, tubes.minus)):
            x = starts
            for _ in range(4):
                step = np.full(200, sign * half[i] / 4)
                x = motion_series(parameters.floats(), x, step, 40).sum(0)
            signs = np.ones(21) if sign == 1 else (-1.0) ** np.arange(21)
            polynomial = (discs.series[:, i] * signs[:, None]).sum(0)
            off = np.abs(starts - states[i]).max(1)
            bound = (off + tubes.defect[i].max()) * tubes.growth[i] + 1e-15
            assert (np.abs(x - polynomial).max(1) <= bound).all()
            moved = (x[1:] - x[:-1]) - (starts[1:] - starts[:-1]) @ ends[i].T
            slack = np.abs(starts[1:] - starts[:-1]) @ tubes.spread[i].T + 1e-14
            assert (np.abs(moved) <= slack).all()


def test_tube_that_is_too_wide_is_refused():
    with pytest.raises(ArithmeticError, match="analyticity"):
        tubes_of(PAPER, [[1.0, -0.5, 3.0, 2.0]], [2.0], 1.0)


def test_discs_out_of_order_and_bounds_that_are_no_numbers_are_refused():
    """A bound that is NaN would be lost in a maximum; Gronwall's bound asks for steps forwards."""
    assert upper(arb("nan")) == upper(1 / arb(0)) == math.inf
    for half in ([-0.1], [0.0]):
        with pytest.raises(ArithmeticError, match="order"):
            tubes_of(PAPER, [[1.0, -0.5, 0.3, 0.2]], half, 1e-9)


def test_precision_returns():
    before = flint.ctx.prec, flint.ctx.cap
    with precision(777, 33):
        assert (flint.ctx.prec, flint.ctx.cap) == (777, 33)
    assert (flint.ctx.prec, flint.ctx.cap) == before
    assert math.isfinite(gamma(1))
