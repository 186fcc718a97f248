"""Certificates: what is proved, what is refused, and what the checker catches."""

import json
import math
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

flint = pytest.importorskip("flint")

import check_certificates  # noqa: E402
import proofs  # noqa: E402

import dpend  # noqa: E402
import dpend.proofs.flow as flow  # noqa: E402
from dpend.proofs.balls import precision  # noqa: E402
from dpend.proofs.certificate import (  # noqa: E402
    Passage,
    Question,
    Release,
    identifier_of,
    read_certificate,
)
from dpend.proofs.certify import answer, certify, problem_of  # noqa: E402
from dpend.proofs.chain import TERMS, Chain  # noqa: E402
from dpend.proofs.proof import BITS, NoProof, prove, prove_discs  # noqa: E402
from dpend.status import Status  # noqa: E402

PAPER = dpend.Pendulum()
# theta2 [deg] and T [s] of B to 50 digits: from the prototype, and from its checker.
B_THETA2 = "49.066544773742673101522710891626102796472477492242421"
B_PERIOD = "1.2127563331460165950112883642098361505468934117044192"
# kappa of the six (paper.md), and of three orbits at m = l = g = 1 (numerics.md, section 3).
KAPPAS = {"A": -0.98679, "B": -0.99895, "C": -0.89014, "D": 1.8963, "E": -0.39809, "F": -0.92378}
UNIT = ("1", "1", "1", "1", "1")
REFERENCE = {
    "1.5": (1.2651907163, 9.1563354486, -0.85091323136),
    "2.4": (1.9340243889, 11.6874860507, 118.65548805),
    "2.7": (-2.6470210045, 11.3914942129, 414.94007723),
}


def start_of(question):
    """The start of a release in degrees, natural units."""
    theta1 = math.radians(float(question.release.text))
    return np.array([theta1, question.theta2, 0.0, 0.0])


@pytest.fixture(scope="module")
def six():
    return dict(zip(proofs.SIX, (answer(question) for question in proofs.six()), strict=True))


def test_six_motions_of_the_paper_are_proved(six):
    assert [c.status for c in six.values()] == [Status.PROVED] * 6
    assert [c.minimal for c in six.values()] == [True] * 6
    assert {name: c.stability for name, c in six.items()} == dict.fromkeys("ABCEF", "elliptic") | {
        "D": "hyperbolic"
    }
    for name, certificate in six.items():
        assert float(certificate.kappa) == pytest.approx(KAPPAS[name], abs=6e-3)
        assert float(certificate.theta2_deg.radius) < 2e-12
        assert float(certificate.unique_angle_deg) > 1e-3


def test_held_digits_lie_in_the_intervals(six):
    assert six["B"].theta2_deg.contains(Fraction(B_THETA2))
    assert six["B"].period.contains(Fraction(B_PERIOD))
    assert "49.0665447737" in six["B"].statement()
    assert "elliptic" in six["B"].statement()


def test_fifty_digits_are_the_same_from_two_precisions():
    question = proofs.six()[1]
    fifty, eighty = answer(question, 50), answer(question, 80)
    for name, text in (("theta2_deg", B_THETA2), ("period", B_PERIOD)):
        coarse, fine = getattr(fifty, name), getattr(eighty, name)
        assert abs(Fraction(coarse.midpoint) - Fraction(text)) < Fraction(1, 10**48)
        assert coarse.contains(Fraction(fine.midpoint))
        assert Fraction(coarse.radius) < Fraction(1, 10**50)
        assert Fraction(fine.radius) < Fraction(1, 10**80)
    rough = answer(question).kappa
    assert rough.contains(Fraction(fifty.kappa.midpoint))
    assert abs(Fraction(fifty.kappa.midpoint) - Fraction(eighty.kappa.midpoint)) < 1e-19
    assert Fraction(fifty.kappa.radius) < Fraction(1, 10**19)


@pytest.mark.parametrize("theta1", REFERENCE)
def test_reference_values_at_unit_parameters(theta1):
    theta2, period, kappa = REFERENCE[theta1]
    problem = problem_of(Question(UNIT, Release(theta1, "rad"), 0, 0, (0, 0)))
    proof = prove(problem, [float(theta1), theta2, 0.0, 0.0], period / 4)
    exact = Question(UNIT, Release(theta1, "rad"), float(proof.discs.series[0, 0, 1]),
                     4 * proof.discs.duration, (0, 0))  # fmt: skip
    certificate = answer(exact)
    assert certificate.status == Status.PROVED
    assert float(certificate.theta2_deg) == pytest.approx(math.degrees(theta2), abs=6e-8)
    assert float(certificate.period) == pytest.approx(period, abs=1e-9)
    off = abs(float(certificate.kappa) - kappa)
    assert off <= float(certificate.kappa.radius) + 1e-9 * abs(kappa)
    assert float(certificate.kappa.radius) < 1e-7 * abs(kappa)


def test_eight_at_forty_degrees_are_proved():
    found = [answer(question) for question in proofs.eight()]
    assert [c.status for c in found] == [Status.PROVED] * 8
    assert [c.minimal for c in found] == [True] * 8
    assert "not decided" not in [c.stability for c in found]


@pytest.mark.slow
def test_atlas_of_forty_degrees_is_certified():
    atlas = dpend.find_brake_orbits(PAPER, theta1=math.radians(40), max_period=2.0)
    found = [certify(orbit, theta1_deg="40") for orbit in atlas.orbits]
    assert [c.status for c in found] == [Status.PROVED] * 8
    assert sorted(float(c.theta2_deg) for c in found) == pytest.approx(
        sorted(x for x, *_ in proofs.EIGHT), abs=1e-8
    )
    assert [c.minimal for c in found] == [True] * 8


def test_solved_orbit_is_certified_in_degrees_and_in_radians():
    orbit = dpend.find_orbit(PAPER, math.radians(40), branch="in-phase")
    degrees, radians = certify(orbit, theta1_deg="40"), certify(orbit)
    assert degrees.release == Release("40", "deg")
    assert radians.release == Release(repr(math.radians(40)), "rad")
    assert math.radians(float(degrees.theta2_deg)) == pytest.approx(float(orbit.theta2), abs=1e-12)
    assert float(radians.period) == pytest.approx(float(orbit.period), abs=1e-12)
    assert degrees.pendulum == ("0.2", "0.2", "0.1", "0.1", "9.8")


def test_orbit_on_a_line_is_certified():
    guess = math.radians(64.3), 1.25
    orbit = dpend.find_orbit(PAPER, math.radians(64.3), guess=guess, ratio=1)
    certificate = certify(orbit, ratio=1)
    assert float(certificate.theta2_deg) == pytest.approx(64.342841896400, abs=1e-11)
    assert "theta1 = theta2" in certificate.statement()


def test_orbit_near_the_one_asked_about_is_refused():
    orbit = dpend.find_orbit(PAPER, math.radians(40), branch="in-phase")
    state = dpend.released(orbit.theta1, float(orbit.theta2) + 1e-6)
    refused = certify(replace(orbit, state=state), theta1_deg="40")
    assert refused.status == Status.ANOTHER_ORBIT
    assert "49.06654477374" in refused.reason
    assert refused.theta2_deg is None


@pytest.mark.parametrize("off", [1e-4, 1e-7, 1e-9])
def test_non_orbit_near_an_orbit_is_refused(off):
    """Without Newton's method the discs are those of a motion that misses the vertical by 1e-9."""
    question = proofs.six()[1]
    problem = problem_of(question)
    with precision(BITS, TERMS):
        chain = Chain(problem, start_of(question), question.period / 4 / math.sqrt(0.2 / 9.8))
        chain.newton()
        chain.states[0, 1] += off
        with pytest.raises(NoProof):
            prove_discs(chain, chain.discs())


def test_motion_that_is_no_orbit_is_not_proved():
    question = proofs.six()[1]._replace(theta2=2.9, period=1.0)
    refused = answer(question)
    assert refused.status in (Status.NOT_PROVED, Status.ANOTHER_ORBIT)
    assert refused.exists is False
    assert len(refused.reason) > 10


def test_what_is_not_covered_is_a_status():
    question = proofs.six()[0]
    upwards = question._replace(pendulum=("0.2", "0.2", "0.1", "0.1", "-9.8"))
    assert answer(upwards).status == Status.NOT_COVERED
    orbit = dpend.find_orbit(PAPER, math.radians(40), branch="in-phase")
    assert not certify(replace(orbit, symmetry="odd")).exists
    for key, value in (("theta2", math.nan), ("period", math.nan), ("period", 0.0)):
        assert answer(question._replace(**{key: value})).status == Status.NOT_PROVED
    assert answer(question._replace(period=1e6)).status == Status.NOT_PROVED
    assert answer(question, 10_000).status == Status.DIGITS_NOT_PROVED


# kappa of the three orbits that never rest, as `find_orbit` has it.
MOVING = {"passing": -1.904328184206, "odd": 1.556712396625, "none": 0.793738471866}


@pytest.mark.parametrize("symmetry", MOVING)
def test_orbits_that_never_rest_are_proved(symmetry):
    question, kappa = proofs.moving(symmetry), MOVING[symmetry]
    certificate = answer(question)
    assert (certificate.status, certificate.minimal) == (Status.PROVED, True)
    state, period = question.state, question.period
    for name, value in (("p1", state[2]), ("p2", state[3]), ("period", period)):
        found = getattr(certificate, name)
        assert float(found) == pytest.approx(value, abs=2e-12)
        assert float(found.radius) < 1e-12
    assert abs(float(certificate.kappa) - kappa) <= float(certificate.kappa.radius) + 1e-9
    assert float(certificate.unique_momentum) > 0
    assert "never rests" in certificate.statement()
    record = json.loads(json.dumps(certificate.record()))
    assert read_certificate(record).identifier == certificate.identifier


@pytest.mark.slow
@pytest.mark.parametrize("symmetry", MOVING)
def test_fifty_digits_of_an_orbit_that_never_rests(symmetry):
    coarse, fine = answer(proofs.moving(symmetry)), answer(proofs.moving(symmetry), 50)
    for name in ("p1", "p2", "period"):
        assert getattr(coarse, name).contains(Fraction(getattr(fine, name).midpoint))
        assert Fraction(getattr(fine, name).radius) < Fraction(1, 10**50)
    assert coarse.kappa.contains(Fraction(fine.kappa.midpoint))
    assert Fraction(fine.kappa.radius) < Fraction(1, 10**18)


@pytest.mark.slow
def test_orbits_between_hyperbolic_and_elliptic_are_decided():
    """kappa is 1 to 4e-10 here: float64 does not tell, forty digits do."""
    question = Question(proofs.PAPER, Release("20.306301528593956", "deg"),
                        math.radians(-27.714549575066354), 1.159874793382541, None)  # fmt: skip
    certificate = answer(question)
    assert (certificate.status, certificate.stability) == (Status.PROVED, "hyperbolic")
    assert check_certificates.check(json.loads(json.dumps(certificate.record()))) == ""
    assert float(certificate.kappa) - 1 == pytest.approx(3.894e-10, rel=1e-3)


def test_strongly_unstable_orbit_is_the_only_one_nearby():
    """kappa is 4.9e27: how far, takes more digits of the release than float64 has."""
    orbit = dpend.find_orbit(PAPER, math.radians(179.9), branch="in-phase")
    certificate = certify(orbit, theta1_deg="179.9", digits=30)
    assert (certificate.status, certificate.stability) == (Status.PROVED, "hyperbolic")
    assert float(certificate.kappa) == pytest.approx(float(orbit.kappa), rel=1e-3)
    assert 0 < float(certificate.unique_angle_deg) < 1e-12


def test_three_periods_are_not_proved_minimal():
    """An odd orbit gone round three times is odd again."""
    question = proofs.moving("odd")
    odd = answer(question._replace(period=3 * question.period))
    assert (odd.status, odd.minimal) == (Status.PROVED, False)


def test_solved_passing_orbit_is_certified(unit):
    question = proofs.moving("passing")
    start = dpend.State(*question.state)
    orbit = dpend.find_orbit(unit, state=start, period=question.period, symmetry="passing")
    certificate = certify(orbit, energy="0")
    assert (certificate.status, certificate.turns) == (Status.PROVED, (0, 1))
    assert certificate.release == Passage("passing", "0", "0", "180")
    with pytest.raises(ValueError, match="energy must be the orbit's"):
        certify(orbit, energy=0.1)
    with pytest.raises(ValueError, match="theta1_deg does not go with passing orbits"):
        certify(orbit, theta1_deg="0")


def test_bad_input_is_refused_at_the_door():
    orbit = dpend.find_orbit(PAPER, math.radians(40), branch="in-phase")
    with pytest.raises(ValueError, match="theta1_deg must be the orbit's release angle, 40"):
        certify(orbit, theta1_deg="41")
    with pytest.raises(ValueError, match="ratio must be theta1/theta2 of the orbit, got 1"):
        certify(orbit, ratio=1)
    with pytest.raises(ValueError, match="orbit must be"):
        certify(3)
    with pytest.raises(ValueError, match="digits"):
        certify(orbit, digits=0)


# --- the checker ----------------------------------------------------------------------------------


def with_identifier(record):
    claim = {key: record[key] for key in record if key not in ("identifier", "discs")}
    return claim | {"identifier": identifier_of(claim), "discs": record["discs"]}


def test_checker_imports_nothing_of_the_package():
    text = Path(check_certificates.__file__).read_text()
    assert [line for line in text.splitlines() if "import" in line and "dpend" in line.split("#")[0]
            and not line.startswith(("It imports", '"""'))] == []  # fmt: skip


@pytest.mark.parametrize("name", ["C", "F"])
def test_checker_proves_certificates_again(six, name):
    record = json.loads(json.dumps(six[name].record()))
    assert check_certificates.check(record) == ""
    assert len(json.dumps(record)) < 1200


@pytest.mark.parametrize(
    "symmetry",
    ["passing", *(pytest.param(name, marks=pytest.mark.slow) for name in ("odd", "none"))],
)
def test_checker_proves_orbits_that_never_rest(symmetry):
    record = json.loads(json.dumps(answer(proofs.moving(symmetry)).record()))
    assert check_certificates.check(record) == ""


@pytest.mark.slow
@pytest.mark.parametrize(
    "change", [{"turns": [0, 2]}, {"start": {"energy": "1e-10"}}, {"start": {"theta1": "180"}}]
)
def test_checker_catches_a_false_word_about_a_start(change):
    record = json.loads(json.dumps(answer(proofs.moving("passing")).record()))
    for key, value in change.items():
        record[key] = record[key] | value if isinstance(value, dict) else value
    assert check_certificates.check(with_identifier(record)) != ""


def test_checker_catches_a_shifted_interval_and_a_radius_cut_in_half(six):
    """The interval is first moved by 0.7 of its radius, which it survives; half of it does not."""
    record = json.loads(json.dumps(six["F"].record()))
    fine = answer(proofs.six()[5], 40)
    truth, radius = Fraction(fine.period.midpoint), Fraction(1, 10**14)
    moved = record | {"period_s": {"midpoint": str(_decimal(truth + radius * Fraction(7, 10))),
                                   "radius": "1e-14"}}  # fmt: skip
    assert check_certificates.check(with_identifier(moved)) == ""
    half = moved | {"period_s": moved["period_s"] | {"radius": "5e-15"}}
    assert "period_s" in check_certificates.check(with_identifier(half))
    assert "identifier" in check_certificates.check(half)


def _decimal(x: Fraction) -> str:
    return f"{x.numerator * 10**40 // x.denominator}e-40"


def test_checker_catches_a_wrong_coefficient(monkeypatch):
    """The prover's gravity on the lower bob is off by 1e-12: its proof is of another pendulum."""
    from dpend.proofs import balls

    true = balls.Parameters.exact

    def off(self):
        mu, inverse, k, nu, weight = true(self)
        return mu, inverse, k, nu * (1 + Fraction(1, 10**12)), weight

    monkeypatch.setattr(balls.Parameters, "exact", off)
    wrong = answer(proofs.six()[5])
    monkeypatch.undo()
    assert wrong.status == Status.PROVED
    reason = check_certificates.check(json.loads(json.dumps(wrong.record())))
    assert "printed interval does not hold" in reason


def test_checker_catches_a_defect_that_was_left_out(monkeypatch):
    """One disc's polynomial is off by 1e-12 in a coefficient, and its defect is not counted."""
    true = flow.polynomial_defects

    def blind(slopes, rows, step, tails, terms):
        return np.minimum(true(slopes, rows, step, tails, terms), 1e-17)

    question = proofs.six()[5]
    problem = problem_of(question)
    with precision(BITS, TERMS):
        chain = Chain(problem, start_of(question), question.period / 4 / math.sqrt(0.2 / 9.8))
        chain.newton()
        series = Chain.discs

        def off(self):
            discs = series(self)
            discs.series[3, 2, 2] += 1e-12
            return discs

        monkeypatch.setattr(Chain, "discs", off)
        honest = prove_discs(chain, chain.newton())
        monkeypatch.setattr(flow, "polynomial_defects", blind)
    wrong = answer(question)
    monkeypatch.undo()
    right = answer(question)
    assert honest.radii[0] > 1e-12
    assert right.status == Status.PROVED
    assert wrong.status == Status.PROVED
    reason = check_certificates.check(json.loads(json.dumps(wrong.record())))
    assert "theta2_deg is -14.0809" in reason.replace("[", "")
    assert "printed interval does not hold" in reason


@pytest.mark.parametrize(
    ("key", "value"),
    [("stability", "hyperbolic"), ("turns", [1, 0])],
)
def test_checker_catches_a_false_word(six, key, value):
    record = json.loads(json.dumps(six["F"].record())) | {key: value}
    assert check_certificates.check(with_identifier(record)) != ""
