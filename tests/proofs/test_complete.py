"""Enclosures in float64 against exact numbers and known motions, and lists proved complete.

That a list is complete is trusted because rests are never excluded where there is one: each known
orbit, hidden from the proof, stays open.
"""

import json
import math
from fractions import Fraction

import numpy as np
import pytest
from scipy.special import ellipj, ellipk

flint = pytest.importorskip("flint")

from flint import acb, arb, arb_series  # noqa: E402

import dpend  # noqa: E402
from dpend import cli  # noqa: E402
from dpend.proofs import chebyshev, march  # noqa: E402
from dpend.proofs.balls import UNIT, Parameters, field, precision, upper  # noqa: E402
from dpend.proofs.certificate import Question, Release  # noqa: E402
from dpend.proofs.certify import answer  # noqa: E402
from dpend.proofs.lanes import SIN_COS_ERROR, Lanes, exp_above, sin_cos  # noqa: E402
from dpend.proofs.rests import Cells, Known, empty  # noqa: E402
from dpend.proofs.sheet import ANGLES, TIMES, Sheet, eigenvalue_above  # noqa: E402
from dpend.proofs.squares import Rest, squares_of  # noqa: E402

TEXTS = ("0.2", "0.2", "0.1", "0.1", "9.8")
PAPER = Parameters(*TEXTS)
SECOND = math.sqrt(0.2 / 9.8)
FORTY = Release("40", "deg")
NOTHING = Known(np.zeros(0), np.zeros(0), np.zeros(0))
# theta2 [deg], period [s] and turns of the brake orbits at 40 degrees, as `find_brake_orbits` has
# them.
EIGHT = (
    (-51.139513966, 0.754418866, (0, 0)),
    (-157.229758666, 0.789605931, (0, -1)),
    (-4.570287296, 1.174420237, None),
    (49.066544774, 1.212756333, (0, 0)),
    (119.491215917, 1.283263044, None),
    (177.345987867, 1.451903639, (0, 0)),
    (-151.107616659, 1.923779041, None),
    (-152.332774219, 1.970160641, None),
)


def sheet_of(parameters=PAPER, cuts=2):
    with precision(64):
        return Sheet(parameters.balls(), parameters.floats(), cuts)


def forty():
    """40 degrees as a float64 number of radians, and how far it is from them."""
    with precision(64):
        exact = arb.pi() * 40 / 180
        return float(exact.mid()), upper(exact - arb(float(exact.mid())))


def steps_of(sheet, front, end):
    """The steps of boxes that need no halving."""
    steps = []
    while front.time.min() < end:
        steps.append(sheet.step(front))
        assert np.isfinite(steps[-1].error).all()
        front = march.arrive(sheet, steps[-1])
    return steps


def values_of(step, lane, s, z):
    """P at (s, z), and the bounds of its components' errors."""
    series = step.series[:, lane]
    t, u = (np.polynomial.chebyshev.chebvander(x, n - 1) for x, n in ((s, TIMES), (z, ANGLES)))
    return np.einsum("in,knm,im->ki", t, series, u)


def test_sines_and_exponentials_keep_their_bounds():
    rng = np.random.default_rng(1)
    near = np.pi / 4 * np.arange(-40, 41)
    x = np.concatenate([rng.uniform(-10, 10, 3000), rng.uniform(-1e3, 1e3, 1000), near])
    with precision(120):
        for number, s, c in zip(x, *sin_cos(x), strict=True):
            sine, cosine = arb(float(number)).sin_cos()
            assert upper(sine - arb(float(s))) < SIN_COS_ERROR / 3
            assert upper(cosine - arb(float(c))) < SIN_COS_ERROR / 3
        for number in rng.uniform(0, 30, 1000):
            bound = float(exp_above(np.array(number)))
            assert arb(float(number)).exp() < bound < 1.00001 * math.exp(number)
    assert np.isnan(sin_cos(np.array([1.1e3, np.nan]))[0]).all()
    assert np.isinf(exp_above(np.array([31.0, np.nan, np.inf]))).all()


def expression(x, y):
    """All operations of the equations of motion."""
    return (x * y + x.sin() * 3 - (y - x).cos()) * (1 / (x.sin() * x.sin() + 1)) + 2


def test_discs_hold_complex_points():
    rng = np.random.default_rng(2)
    centres = rng.uniform(-3, 3, (2, 300))
    radii = 10.0 ** rng.uniform(-17, -0.5, (2, 300))
    found = expression(
        *(Lanes(c[:, None], r[:, None]) for c, r in zip(centres, radii, strict=True))
    )
    with precision(100):
        for i in range(300):
            for _ in range(5):
                angles = rng.uniform(0, 2 * math.pi, 2)
                point = [
                    acb(arb(float(c)) + arb(float(r)) * math.cos(a), arb(float(r)) * math.sin(a))
                    for c, r, a in zip(centres[:, i], radii[:, i] * (1 - 1e-9), angles, strict=True)
                ]
                off = abs(expression(*point) - float(found.value[i, 0]))
                assert off < float(found.error[i, 0])


def test_wider_discs_give_wider_bounds():
    centre = np.linspace(-2, 2, 50)[:, None]
    errors = [
        expression(Lanes(centre, r + 0 * centre), Lanes(centre + 1, r + 0 * centre)).error
        for r in (0.0, 1e-12, 1e-6, 1e-2, 0.1)
    ]
    assert (np.diff(errors, axis=0) > 0).all()


@pytest.mark.parametrize("n", [TIMES, ANGLES])
def test_chebyshev_polynomials(n):
    rng = np.random.default_rng(3)
    with precision(100):
        for k, x in enumerate(chebyshev.nodes(n)):
            exact = (arb.pi() * (2 * k + 1 - n) / (2 * n)).sin()
            assert upper(exact - arb(float(x))) < UNIT
    c, y = rng.normal(size=n), rng.uniform(-1, 1, 100)
    chebval = np.polynomial.chebyshev.chebval
    for half, side in zip(chebyshev.halves(n), (-0.5, 0.5), strict=True):
        off = np.abs(chebval(y, half @ c) - chebval(side + y / 2, c)).max()
        assert off < chebyshev.halving_error(n) * np.abs(c).sum()
    # 1/(a - s) is at most 1/(a - (rho + 1/rho)/2) on the ellipse.
    values, slopes = chebyshev.values_matrix(n)
    a = 4.0
    fitted = np.linalg.solve(values, 1 / (a - chebyshev.nodes(n)))
    off = np.abs(chebval(y, fitted) - 1 / (a - y)).max()
    bound = min(chebyshev.tail(n, rho) / (a - (rho + 1 / rho) / 2) for rho in (2.0, 4.0, 6.0, 7.0))
    assert off < bound < 1000 * off + 1e-13
    derivative = np.polynomial.chebyshev.chebder(fitted)
    assert slopes @ fitted == pytest.approx(chebval(chebyshev.nodes(n), derivative), rel=1e-9)


def test_eigenvalues_are_bounded():
    rng = np.random.default_rng(4)
    matrix = rng.normal(size=(500, 4, 4)) * 10.0 ** rng.uniform(-3, 3, (500, 1, 1))
    matrix = matrix + matrix.transpose(0, 2, 1)
    exact = np.maximum(np.linalg.eigvalsh(matrix)[:, -1], 0)
    found = eigenvalue_above(matrix)
    assert (found >= exact).all()
    assert (found < exact + 1e-12 * np.abs(matrix).max((1, 2))).all()
    assert np.isinf(eigenvalue_above(np.full((1, 4, 4), np.nan))).all()


def exact_motion(theta1, theta2, times, step=0.05, terms=40):
    """The motion from rest with 40 terms of its Taylor series, 1e-25 or better."""
    state, now, out = [theta1, theta2, arb(0), arb(0)], 0.0, []
    for time in times:
        while True:
            series = [arb_series([x], prec=1) for x in state]
            for n in range(1, terms):
                slopes = field(PAPER.balls(), series)
                series = [
                    arb_series(
                        [x, *(c / (k + 1) for k, c in enumerate(slope.coeffs()))], prec=n + 1
                    )
                    for x, slope in zip(state, slopes, strict=True)
                ]
            last = min(step, time - now)
            polynomials = [flint.arb_poly(x.coeffs()) for x in series]
            values = [p(arb(last)) for p in polynomials]
            if time - now <= step:
                out.append(values)
                break
            state, now = values, now + step
    return out


def test_motions_are_where_the_bounds_say():
    sheet, (theta1, off) = sheet_of(), forty()
    rng = np.random.default_rng(5)
    middles = np.round(rng.uniform(-3, 3, 2) * 2**9) / 2**9
    boxes = np.stack([middles, np.full(2, 2.0**-8)])
    steps = steps_of(sheet, march.release(sheet, theta1, off, boxes), 1.2)
    looked = 0
    with precision(120, 45):
        for lane, middle in enumerate(middles):
            for z in rng.uniform(-1, 1, 2):
                z = float(np.round(z * 2**20) / 2**20)
                theta2 = arb(float(middle)) + arb(z) / 256
                places = []
                for i, step in enumerate(steps):
                    for s in np.sort(rng.uniform(-1, 1, 12)):
                        time = step.start.time[lane] + step.half[lane] * (1 + s)
                        places.append((float(time), i, s))
                truth = exact_motion(arb.pi() * 40 / 180, theta2, [t for t, _, _ in places])
                for state, (_, i, s) in zip(truth, places, strict=True):
                    found = values_of(steps[i], lane, np.array([s]), np.array([z]))[:, 0]
                    bound = sheet.components(steps[i].error)[:, lane] + 2e-15
                    for x, y, e in zip(state, found, bound, strict=True):
                        assert upper(x - arb(float(y))) < e
                        looked += 1
    assert looked > 500
    assert steps[-1].error.max() < 1e-9


class Uncoupled(Parameters):
    """Without the lower bob: a'' = -sin a is a simple pendulum."""

    def exact(self):
        return tuple(map(Fraction, (0, 0, 1, 0, 1)))


def test_a_simple_pendulum_from_all_angles():
    sheet = sheet_of(Uncoupled("1", "1", "1", "1", "1"))
    sheet.scale = np.ones(4)
    boxes = np.array([[-1.0, 0.25, 2.0], [2.0**-8] * 3])
    front = march.release(sheet, 0.0, 0.0, boxes)
    # theta1 takes the place of theta2.
    front = front._replace(edge=front.edge[[1, 0, 2, 3]])
    rng = np.random.default_rng(6)
    for step in steps_of(sheet, front, 4.0):
        for lane in range(3):
            s, z = rng.uniform(-1, 1, (2, 30))
            amplitude = boxes[0, lane] + boxes[1, lane] * z
            m = np.sin(amplitude / 2) ** 2
            time = step.start.time[lane] + step.half[lane] * (1 + s)
            sn, cn, dn, _ = ellipj(ellipk(m) - time, m)
            k = np.sin(amplitude / 2)
            truth = 2 * np.arcsin(k * sn), -2 * k * cn * dn / np.sqrt(1 - m * sn**2)
            found = values_of(step, lane, s, z)
            for x, y in zip(truth, found[[0, 2]], strict=True):
                assert np.abs(x - y).max() < step.error[lane] + 1e-13


def test_a_spoiled_polynomial_is_noticed():
    sheet, (theta1, off) = sheet_of(), forty()
    boxes = np.array([[0.5], [2.0**-8]])
    step = sheet.step(march.release(sheet, theta1, off, boxes))
    clean = sheet.defect(step.half, step.series)[0]
    assert clean.max() < 1e-13
    for place in ((0, 0, 1, 0), (1, 0, 3, 2), (2, 0, 2, 0), (3, 0, 1, 1)):
        spoiled = step.series.copy()
        spoiled[place] += 1e-11
        assert sheet.defect(step.half, spoiled)[0].max() > 5e-12


def test_cells_are_empty_only_without_zeros():
    rng = np.random.default_rng(7)
    count = 3000
    series = rng.normal(size=(2, count, TIMES, ANGLES))
    series *= 0.4 ** np.add.outer(np.arange(TIMES), np.arange(ANGLES))
    series[..., 0, 0] *= 3
    s, z = rng.uniform(-1, 1, (2, count))
    t, u = (np.polynomial.chebyshev.chebvander(x, n - 1) for x, n in ((s, TIMES), (z, ANGLES)))
    planted = np.arange(count) < count // 2
    zeroed = series.copy()
    zeroed[..., 0, 0] -= np.einsum("in,kinm,im->ki", t, series, u)
    error = np.full((2, count), 1e-12)
    place = np.zeros((4, count))
    assert not empty(Cells(*place, zeroed, error)).any()
    found = empty(Cells(*place, series, error))
    assert found[planted].mean() > 0.3
    # A zero within the error counts as one.
    zeroed[..., 0, 0] += rng.choice([-1, 1], (2, count)) * 1e-3
    assert not empty(Cells(*place, zeroed, error + 1.01e-3)).any()


def march_near(theta2, end, known, half=2.0**-16, cuts=4):
    """What stays open in two boxes about theta2 [deg]."""
    sheet, (theta1, off) = sheet_of(cuts=cuts), forty()
    middle = math.floor(math.radians(theta2) / (2 * half)) * 2 * half
    boxes = np.array([[middle - half, middle + half, middle + 3 * half], [half] * 3])
    found, tally = march.march(sheet, march.release(sheet, theta1, off, boxes), known, end)
    assert tally.boxes >= 3
    return march.merge(found)


def rest_of(theta2, period, turns):
    angle = math.radians(theta2)
    certificate = answer(Question(TEXTS, FORTY, angle, period, turns))
    return Rest(Question(TEXTS, FORTY, angle, period, None), certificate, 1)


def check_hidden(theta2, period, turns):
    end = period / 2 / SECOND + 0.05
    left = march_near(theta2, end, NOTHING)
    angle, time = math.radians(theta2), period / 2 / SECOND
    near = [one for one in left if one.early - 1e-7 < time < one.late + 1e-7]
    assert len(near) >= 1
    low, high = min(one.low for one in near), max(one.high for one in near)
    assert low - 1e-8 < angle < high + 1e-8
    known = squares_of([rest_of(theta2, period, turns)], SECOND)
    assert known.radius.shape == (1,)
    assert march_near(theta2, end, known) == []


def test_a_hidden_orbit_stays_open_and_a_proved_one_is_the_only_one():
    check_hidden(*EIGHT[0])


@pytest.mark.slow
@pytest.mark.parametrize("orbit", EIGHT[1:], ids=lambda one: f"{one[1]:.2f}")
def test_every_hidden_orbit_stays_open(orbit):
    check_hidden(*orbit)


def test_overlapping_squares_prove_nothing_twice():
    rest = rest_of(*EIGHT[0])
    assert (squares_of([rest, rest], SECOND).radius < 1e-12).all()


@pytest.mark.slow
def test_all_orbits_at_forty_degrees_with_a_short_period():
    proof = dpend.prove_brake_orbits(dpend.Pendulum(), theta1_deg="40", max_period=0.8)
    assert proof.complete
    assert [one.stability for one in proof.certificates] == ["elliptic", "hyperbolic"]
    assert proof.statement().startswith("Proved: there are exactly 2 values of theta2")
    table = proof.to_dataframe()
    assert table["theta2_deg"].to_numpy() == pytest.approx([-51.139513966, -157.229758666])
    assert proof.record()["complete"] is True


def test_the_command_says_how_many(capsys, monkeypatch):
    monkeypatch.setattr(cli, "_keep_compiled_code", lambda: None)
    # No orbit is so short; the paper's shortest at 40 degrees takes 0.75 s.
    assert cli._run(["certify", "--theta1", "40", "--max-period", "0.2", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["complete"] is True
    assert record["pendulum"]["l1_m"] == "0.2"
    assert (record["certificates"], record["undecided"]) == ([], [])
    assert cli._run(["certify", "--theta1", "40", "--max-period", "1", "--digits", "9"]) == 2
    assert capsys.readouterr().err == (
        "dpend: digits does not go with max_period, got 9: leave it out\n"
    )
