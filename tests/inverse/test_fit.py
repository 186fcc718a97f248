"""Fits against the pendulum that made the data, against scipy on other equations, and against what
cannot be known.
"""

import json
from dataclasses import replace

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import dpend
from dpend import Pendulum, Status, cli, fit_parameters, plots

RATIOS = ("l2/l1", "m2/m1", "g/l1")
HALF = np.radians(0.5)
FRAMES = np.arange(1201) / 60


FINE = 16  # saved states from frame to frame


def motion(pendulum, theta1, theta2):
    """Both angles [rad] of a release [deg] from rest over 20 s, at 960 times a second; one compiled
    program for all.
    """
    release = dpend.released(*np.radians([theta1, theta2]))
    found = dpend.simulate(pendulum, release, 20.0, step=1 / (60 * FINE), error=False)
    return np.stack([found.state.theta1, found.state.theta2])


def noisy(angles, seed, noise=HALF):
    return angles + noise * np.random.default_rng(seed).normal(size=angles.shape)


def off(pendulum, l2=1.25, m2=0.8, g=1.2):
    """A guess that is off by so much."""
    return replace(
        pendulum, l2=float(pendulum.l2 * l2), m2=float(pendulum.m2 * m2), g=float(pendulum.g * g)
    )


def scores(fit, pendulum):
    """The errors of the three ratios over their standard errors."""
    true = (pendulum.l2 / pendulum.l1, pendulum.m2 / pendulum.m1, pendulum.g / pendulum.l1)
    return np.array(
        [(fit.estimates[k] - t) / fit.standard_errors[k] for k, t in zip(RATIOS, true, strict=True)]
    )


@pytest.fixture(scope="module")
def chaos(paper):
    """20 s at 60 frames a second from (170, 180) degrees, without noise."""
    return motion(paper, 170, 180)[:, ::FINE]


def trial(paper, chaos, seed):
    factors = np.exp(np.random.default_rng(10_000 + seed).uniform(-0.3, 0.3, 3))
    return fit_parameters(FRAMES, *noisy(chaos, seed), pendulum=off(paper, *map(float, factors)))


def test_a_chaotic_motion_gives_the_pendulum_back(paper, chaos):
    fits = [trial(paper, chaos, seed) for seed in range(2)]
    for fit in fits:
        assert fit.status == Status.CONVERGED, dpend.message(fit.status)
        assert np.max(np.abs(scores(fit, paper))) < 3
        assert fit.gap < 1e-9
        assert 0 < fit.error_estimate < 0.1 * min(fit.standard_errors[name] for name in RATIOS)
        np.testing.assert_allclose(fit.noise, HALF, rtol=0.05)
        assert fit.standard_errors["m2/m1"] < 2e-4
        np.testing.assert_allclose(fit.estimates["g"], fit.estimates["g/l1"] * 0.2, rtol=1e-14)
        drift = (np.asarray([fit.state.theta1, fit.state.theta2]) - np.radians([170, 180])).ravel()
        assert np.all(
            np.abs(drift) < 4 * np.array([fit.standard_errors[k] for k in ("theta1", "theta2")])
        )


@pytest.mark.slow
def test_a_hundred_trials(paper, chaos):
    """95 of 100 within three standard errors, which scatter by one, and the noise as it was
    made.
    """
    fits = [trial(paper, chaos, seed) for seed in range(100)]
    assert all(fit.status == Status.CONVERGED for fit in fits)
    z = np.array([scores(fit, paper) for fit in fits])
    assert np.sum(np.all(np.abs(z) < 3, axis=1)) >= 95
    assert np.all(np.abs(np.sqrt(np.mean(z**2, axis=0)) - 1) < 0.25)
    spread = np.array([fit.noise for fit in fits]) / HALF
    assert abs(np.mean(spread) - 1) < 0.005
    assert abs(np.std(spread) * np.sqrt(2 * 2 * FRAMES.size) - 1) < 0.3


def test_wrapped_and_mirrored_angles_give_the_same(paper, chaos):
    times, data, guess = FRAMES[:400], noisy(chaos, 0)[:, :400], off(paper)
    plain = fit_parameters(times, *data, pendulum=guess)
    wrapped = fit_parameters(times, *((data + np.pi) % (2 * np.pi) - np.pi), pendulum=guess)
    mirrored = fit_parameters(times, *-data, pendulum=guess)
    for other in (wrapped, mirrored):
        for name in RATIOS:
            assert (
                abs(other.estimates[name] - plain.estimates[name])
                < 1e-3 * plain.standard_errors[name]
            )
    np.testing.assert_allclose(mirrored.theta2, -plain.theta2, atol=1e-4)
    # The fitted motion tumbles on, whatever turn the data are in.
    assert np.ptp(np.asarray(wrapped.theta2)) > 10
    assert np.max(np.abs(np.diff(wrapped.theta2))) < 1


def test_data_without_noise_give_every_digit(paper, chaos):
    fit = fit_parameters(FRAMES[:121], *chaos[:, :121], pendulum=off(paper))
    assert fit.status == Status.CONVERGED
    np.testing.assert_allclose([fit.estimates[k] for k in RATIOS], [1, 1, 49], rtol=1e-10)
    np.testing.assert_allclose(
        [fit.state.theta1, fit.state.theta2], np.radians([170, 180]), atol=1e-10
    )
    assert max(abs(float(fit.state.p1)), abs(float(fit.state.p2))) < 1e-10


@pytest.mark.slow
def test_other_pendulums_at_irregular_times():
    pendulum = Pendulum(0.3, 0.15, 0.2, 0.05, 9.81)
    places = np.cumsum(np.random.default_rng(1).integers(2, 30, 301))
    times, angles = places / (60 * FINE), motion(pendulum, 100, -40)[:, places]
    fit = fit_parameters(times, *noisy(angles, 2), pendulum=off(pendulum, 0.8, 1.25, 0.85))
    assert fit.status == Status.CONVERGED
    assert np.max(np.abs(scores(fit, pendulum))) < 3
    # The same data, other fields free: the ratios are what is measured.
    other = fit_parameters(
        times,
        *noisy(angles, 2),
        pendulum=replace(pendulum, l1=0.26, m1=0.25),
        free=("l1", "l2", "m1"),
    )
    for name in RATIOS:
        assert abs(other.estimates[name] - fit.estimates[name]) < 1e-2 * fit.standard_errors[name]
        np.testing.assert_allclose(
            other.standard_errors[name], fit.standard_errors[name], rtol=1e-3
        )


def test_a_release_from_rest_tells_more(paper, chaos):
    data = noisy(chaos, 0)[:, :300]
    plain = fit_parameters(FRAMES[:300], *data, pendulum=off(paper))
    fit = fit_parameters(FRAMES[:300], *data, pendulum=off(paper), initial=(None, None, 0, 0))
    assert np.max(np.abs(scores(fit, paper))) < 3
    assert fit.standard_errors["omega1"] == fit.standard_errors["omega2"] == 0
    assert float(fit.state.p1) == float(fit.state.p2) == 0
    assert fit.standard_errors["theta2"] < 0.1 * plain.standard_errors["theta2"]


@pytest.mark.slow
def test_least_squares_by_scipy_agree():
    """Swings of 1 s, shot at in one piece with DOP853 and the equations of motion written by
    hand.
    """
    pendulum, times = Pendulum(), np.linspace(0.0, 1.0, 61)
    data = noisy(motion(pendulum, 50, 20)[:, : 61 * FINE : FINE], 5)
    fit = fit_parameters(times, *data, pendulum=off(pendulum), noise=HALF)

    def residuals(x):
        length, mass, gravity = np.exp(x[:3])

        def slope(_, y):
            s, c = np.sin(y[0] - y[1]), np.cos(y[0] - y[1])
            inertia = np.array(
                [[1 + mass, mass * length * c], [mass * length * c, mass * length**2]]
            )
            force = [
                -mass * length * s * y[3] ** 2 - (1 + mass) * gravity * np.sin(y[0]),
                mass * length * s * y[2] ** 2 - mass * length * gravity * np.sin(y[1]),
            ]
            return np.concatenate([y[2:], np.linalg.solve(inertia, force)])

        y = solve_ivp(slope, (0, 1), x[3:], method="DOP853", t_eval=times, rtol=1e-9, atol=1e-11).y
        return ((y[:2] - data) / HALF).ravel()

    start = np.concatenate([np.log([1.0, 1.0, 49.0]), np.radians([50, 20]), [0, 0]])
    best = least_squares(
        residuals, start, method="lm", x_scale=[0.1, 0.1, 0.1, 0.1, 0.1, 1, 1], xtol=1e-12
    )
    moves = 1e-3 * np.eye(7)
    jacobian = (
        np.array([residuals(best.x + move) - residuals(best.x - move) for move in moves]).T / 2e-3
    )
    units = np.concatenate([[0.2, 0.1, 0.2] * np.exp(best.x[:3]), np.ones(4)])
    covariance = np.linalg.inv(jacobian.T @ jacobian) * np.outer(units, units)
    ours = [fit.estimates[k] for k in ("l2", "m2", "g", "theta1", "theta2", "omega1", "omega2")]
    errors = np.sqrt(np.diag(covariance))
    assert np.max(np.abs(np.append(units[:3], best.x[3:]) - ours) / errors) < 5e-3
    np.testing.assert_allclose(
        fit.covariance / np.outer(errors, errors), covariance / np.outer(errors, errors), atol=2e-3
    )


def test_gaps(paper, chaos):
    data = noisy(chaos, 3)
    data[:, 100:130] = np.nan  # half a second of nothing
    data[0, 300:330] = np.nan
    data[np.random.default_rng(4).random(data.shape) < 0.05] = np.nan
    data[0, 0] = 3.0
    fit = fit_parameters(FRAMES[:400], *data[:, :400], pendulum=off(paper))
    assert fit.status == Status.CONVERGED
    assert np.max(np.abs(scores(fit, paper))) < 3
    np.testing.assert_array_equal(np.isnan(fit.residual1), np.isnan(data[0, :400]))
    truth = chaos[:, 100:130] - 2 * np.pi * np.round(
        (chaos[:, 100:130] - [fit.theta1[100:130], fit.theta2[100:130]]) / (2 * np.pi)
    )
    assert np.max(np.abs(truth - [fit.theta1[100:130], fit.theta2[100:130]])) < 0.05


@pytest.mark.parametrize(
    ("seen", "frames"),
    [
        pytest.param(1, 300, marks=pytest.mark.slow),
        pytest.param(0, 600, marks=pytest.mark.slow),
        pytest.param(1, 1201, marks=pytest.mark.slow),
    ],
)
def test_one_rod_is_enough(paper, chaos, seen, frames):
    """The other is found from nothing: its motion, and with it the pendulum."""
    data = [
        column if rod == seen else None for rod, column in enumerate(noisy(chaos, 1)[:, :frames])
    ]
    fit = fit_parameters(FRAMES[:frames], *data, pendulum=off(paper, 1.2, 0.85, 1.15))
    assert fit.status == Status.CONVERGED
    assert np.max(np.abs(scores(fit, paper))) < 3
    hidden = (fit.theta1, fit.theta2)[1 - seen]
    missed = (hidden - chaos[1 - seen][:frames] + np.pi) % (2 * np.pi) - np.pi
    assert np.max(np.abs(missed)) < 0.1
    assert np.all(np.isnan((fit.residual1, fit.residual2)[1 - seen]))


@pytest.mark.slow
@pytest.mark.parametrize(
    "factors", [(0.5, 2.0, 0.5), (2.0, 0.5, 2.0), (0.5, 0.5, 2.0), (2.0, 2.0, 0.5)]
)
def test_guesses_off_by_two(paper, chaos, factors):
    fit = fit_parameters(FRAMES, *noisy(chaos, 7), pendulum=off(paper, *factors))
    assert fit.status == Status.CONVERGED
    assert np.max(np.abs(scores(fit, paper))) < 3


@pytest.mark.slow
def test_calm_swings_have_honest_errors(paper):
    angles = motion(paper, 30, 10)[:, ::FINE]
    fits = [fit_parameters(FRAMES, *noisy(angles, seed), pendulum=off(paper)) for seed in range(20)]
    assert all(fit.status == Status.CONVERGED for fit in fits)
    z = np.array([scores(fit, paper) for fit in fits])
    assert np.all(np.abs(np.sqrt(np.mean(z**2, axis=0)) - 1) < 0.4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pendulum", "release", "every", "noise"),
    [
        (Pendulum(m2=1.0), (120, 60), 1, 0.5),
        (Pendulum(m2=0.01), (120, 60), 1, 0.5),
        (Pendulum(l1=1.0, l2=0.5), (150, 60), 2, 1.0),
        (Pendulum(), (170, 180), 4, 0.5),
        (Pendulum(), (170, 180), 1, 5.0),
        (Pendulum(), (170, 180), 1, 0.01),
    ],
)
def test_masses_lengths_frames_and_noise(pendulum, release, every, noise):
    """Fifteen frames a second, five degrees of noise, a hundredth: all the same."""
    times, angles = FRAMES[::every], motion(pendulum, *release)[:, ::FINE][:, ::every]
    fit = fit_parameters(times, *noisy(angles, 0, np.radians(noise)), pendulum=off(pendulum))
    assert fit.status == Status.CONVERGED
    assert np.max(np.abs(scores(fit, pendulum))) < 3.5
    np.testing.assert_allclose(np.degrees(fit.noise), noise, rtol=0.1)


# --- what cannot be known, and what is not so -----------------------------------------------------


@pytest.mark.slow
def test_a_pendulum_at_rest_tells_nothing():
    data = noisy(np.zeros((2, 151)), 0, noise=1e-3)
    fit = fit_parameters(FRAMES[:151], *data, pendulum=off(Pendulum()))
    assert fit.status == Status.SINGULAR
    assert all(fit.standard_errors[name] == np.inf for name in RATIOS)
    still = fit_parameters(FRAMES[:61], np.zeros(61), np.zeros(61))
    assert still.status == Status.SINGULAR
    assert all(still.standard_errors[name] == np.inf for name in ("l2", "m2", "g"))


@pytest.mark.slow
def test_one_mode_does_not_tell_all_three(paper):
    """Small swings of one mode have a frequency and a ratio of angles: two numbers for three."""
    slow = dpend.normal_modes(paper)[0]
    swing = 0.01 * np.cos(float(slow.frequency) * FRAMES[:600])
    data = noisy(np.stack([swing, float(slow.ratio) * swing]), 0, noise=1e-3)
    fit = fit_parameters(FRAMES[:600], *data, pendulum=off(paper))
    assert fit.status == Status.SINGULAR
    assert fit.standard_errors["l2/l1"] == np.inf
    held = fit_parameters(FRAMES[:600], *data, pendulum=paper, free=("g",))
    assert held.status == Status.CONVERGED
    assert abs(held.estimates["g"] - 9.8) < 3 * held.standard_errors["g"] < 0.05


@pytest.mark.slow
def test_a_wrong_pendulum_is_not_believed(paper, chaos):
    """Gravity held 8 % off."""
    data = noisy(chaos, 0)[:, :240]
    fit = fit_parameters(FRAMES[:240], *data, pendulum=replace(paper, g=9.0), free=("l2", "m2"))
    assert fit.status == Status.MISFIT
    assert "not to be believed" in dpend.message(fit.status)


@pytest.mark.slow
def test_a_wrong_clock_is_not_believed(paper, chaos):
    times = FRAMES[:400] + 0.02 * FRAMES[:400] ** 2
    assert fit_parameters(times, *noisy(chaos, 0)[:, :400]).status == Status.MISFIT


GOOD = (
    np.linspace(0, 1, 31),
    0.5 * np.cos(np.linspace(0, 5, 31)),
    0.7 * np.cos(np.linspace(0, 5, 31)),
)


def changed(column, index, value):
    data = [np.array(c) for c in GOOD]
    data[column][index] = value
    return data


@pytest.mark.parametrize(
    ("data", "options", "text"),
    [
        (GOOD, {"free": ("l1", "l2", "g")}, "free must not hold l1, l2 and g: .* fix one of l1, "
                                            "l2, g"),
        (GOOD, {"free": ("m1", "m2")}, "free must not hold m1 and m2: .* fix one of m1, m2"),
        (GOOD, {"pendulum": 0.2}, "pendulum must be a Pendulum, got 0.2"),
        (GOOD, {"free": 5}, "free must hold each of l1, l2, m1, m2, g once at most, got 5"),
        (GOOD, {"free": ("l3",)}, "free must hold each of l1, l2, m1, m2, g once at most, got l3"),
        (GOOD, {"pendulum": Pendulum(g=0.0)}, "g must not start at 0 where it is free"),
        (GOOD, {"initial": (None, None)}, "initial must be theta1, theta2, omega1, omega2, got 2"),
        (GOOD, {"initial": (None, None, np.inf, 0)}, "initial omega1 must be a finite number"),
        (GOOD, {"noise": 0.0}, "noise must be a finite positive number"),
        (changed(0, 7, 0.1), {}, r"times\[7\] must be later than the one before it, 0.2 s, got 0.1 "
                                 r"s: sort"),
        (changed(0, 7, 0.2), {}, r"times\[7\] must be later"),
        (changed(0, 7, np.nan), {}, r"times\[7\] must be finite"),
        (changed(1, 7, np.inf), {}, r"theta1\[7\] must be finite \[rad\], got inf: give NaN"),
        ((GOOD[0], None, None), {}, "theta1 or theta2 must be given, got None for both"),
        ((GOOD[0], GOOD[1][:-1], None), {}, "theta1 must be as long as times, got 30 and 31"),
        ((GOOD[0], "angles", None), {}, "theta1 must be numbers"),
        ([column[:5] for column in GOOD], {}, "times must be at least 7, got 5"),
        ((GOOD[0][:9], GOOD[1][:9], None), {}, "times must be more for 7 unknowns, got 9 angles"),
        ((GOOD[0], GOOD[1], np.where(GOOD[0] < 0.1, GOOD[2], np.nan)), {}, "theta2 must be "
                                                                           "measured at least 7 "
                                                                           "times"),
        ((GOOD[0], np.where(GOOD[0] > 0, GOOD[1], np.nan), None), {}, r"theta1\[0\] and "
                                                                      r"theta2\[0\] are both "
                                                                      r"missing"),
        ((1000 * GOOD[0], GOOD[1], GOOD[2]), {}, "times must be at most .* s apart .* give "
                                                 "seconds"),
        ((GOOD[0], 60 * GOOD[1], None), {}, r"theta1\[\d+\] must be in radians and sampled often "
                                            r"enough"),
    ],
)  # fmt: skip
def test_refusals(data, options, text):
    with pytest.raises(ValueError, match=text):
        fit_parameters(*data, **options)


def test_units_are_told_apart_by_the_equations(paper, chaos):
    slow = motion(paper, 3, 4)[:, ::FINE]  # slow enough for steps below a radian even in degrees
    with pytest.raises(
        ValueError, match="must be in radians, got angles that obey .* only if they are in degrees"
    ):
        fit_parameters(FRAMES[:300], *np.degrees(slow[:, :300]))
    with pytest.raises(
        ValueError, match="must be in radians, got angles that obey .* converted twice"
    ):
        fit_parameters(FRAMES[:300], *np.radians(noisy(chaos, 0)[:, :300]))


# --- the command line -----------------------------------------------------------------------------


@pytest.fixture
def run(monkeypatch, capsys):
    monkeypatch.setattr(cli, "_keep_compiled_code", lambda: None)

    def call(*arguments):
        status = cli._run([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return call


@pytest.mark.slow
def test_what_simulate_wrote_is_fitted(run, tmp_path):
    data = tmp_path / "motion.csv"
    run(
        "simulate", "--theta1", 100, "--theta2", 60, "--duration", 2, "--step", 0.005, "--out", data
    )
    status, out, err = run("fit", data, "--l2", 0.25, "--m2", 0.08, "--json")
    assert (status, err) == (0, "")
    found = json.loads(out)
    assert abs(found["estimates"]["l2_m"] - 0.2) < 1e-8
    assert abs(found["estimates"]["theta2_deg"] - 60) < 1e-6


def test_the_command(run, tmp_path, chaos):
    data, figure = tmp_path / "data.csv", tmp_path / "fit.png"
    rows = zip(FRAMES[:240], *np.degrees(noisy(chaos, 0)[:, :240]), strict=True)
    data.write_text(
        HEADER + "".join(f"{t},{a},{'' if i % 9 == 5 else b}\n" for i, (t, a, b) in enumerate(rows))
    )
    command = (
        "fit",
        data,
        "--l2",
        0.25,
        "--m2",
        0.08,
        "--free",
        "l2, m2,g",
        "--at-rest",
        "--noise",
        0.5,
    )
    status, out, err = run(*command, "--json", "--figure", figure)
    assert (status, err) == (0, "")
    found = json.loads(out)
    for name, true in (
        ("l2_m", 0.2),
        ("m2_kg", 0.1),
        ("g_m_s2", 9.8),
        ("theta1_deg", 170),
        ("theta2_deg", 180),
    ):
        assert (
            abs(found["estimates"][name] - true) < 3 * found["standard_errors"][name] < 0.03 * true
        )
    assert (found["status"], found["free"], found["estimates"]["omega1_deg_s"]) == (
        "converged",
        ["l2", "m2", "g"],
        0.0,
    )
    assert figure.stat().st_size > 10_000
    status, out, _ = run(*command)
    assert status == 0
    shown = next(line.split() for line in out.splitlines() if line.startswith("l2/l1"))
    assert abs(float(shown[1]) - found["estimates"]["l2/l1"]) < found["standard_errors"]["l2/l1"]


HEADER = "time_s,theta1_deg,theta2_deg\n"
ROWS = [f"{t:.4f},{np.degrees(a):.4f},{np.degrees(b):.4f}\n" for t, a, b in zip(*GOOD, strict=True)]


def altered(row, text):
    return HEADER + "".join(text if i == row - 2 else line for i, line in enumerate(ROWS))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must have a header and rows, got an empty file"),
        (
            "time_s,theta1_rad\n0,1\n",
            "must have a column theta1_deg or theta2_deg, got time_s, theta1_rad",
        ),
        (
            HEADER.replace("time_s", "t") + "".join(ROWS),
            "must have a column time_s, got t, theta1_deg, theta2_deg",
        ),
        (altered(5, "0.1,forty,3\n"), "theta1_deg in row 5 of"),
        (altered(5, "0.1,3,nan\n"), "theta2_deg in row 5 of"),
        (altered(5, "0.1,inf,3\n"), "must be a finite number, got 'inf': leave the cell empty"),
        (altered(5, ",1,3\n"), "time_s in row 5 of"),
        (altered(5, "0.1,3\n"), "row 5 of"),
        (altered(6, ROWS[3]), "time_s in row 6 of"),
        (
            altered(6, "0.05,1,2\n"),
            "must be later than the one before it, 0.1 s, got 0.05 s: sort the samples",
        ),
        (HEADER + "".join(ROWS[:4]), "times must be at least 7, got 4"),
        (
            HEADER + "".join(f"{t},{60 * np.degrees(a)},\n" for t, a, _ in zip(*GOOD, strict=True)),
            "theta1_deg in row ",
        ),
    ],
)
def test_bad_files_are_refused_in_one_line(run, tmp_path, text, message):
    data = tmp_path / "data.csv"
    data.write_text(text)
    status, out, err = run("fit", data)
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert message in err


def test_a_file_in_radians_is_refused(run, tmp_path, chaos):
    data = tmp_path / "data.csv"
    rows = zip(FRAMES[:300], *noisy(chaos, 0)[:, :300], strict=True)
    data.write_text(HEADER + "".join(f"{t},{a},{b}\n" for t, a, b in rows))
    status, _, err = run("fit", data)
    assert status == 2
    assert (
        "must be in degrees, got angles that obey the equations of a double pendulum only if they "
        "are in radians" in err
    )
    status, _, err = run("fit", tmp_path / "none.csv")
    assert (status, err.count("\n")) == (2, 1)
    assert "No such file" in err


def test_load_angles_leaves_out_what_is_not_there(tmp_path):
    data = tmp_path / "data.csv"
    data.write_text(
        "theta2_deg,other,time_s\n"
        + "".join(f"{'' if i == 3 else i},x,{i / 10}\n" for i in range(9))
    )
    times, theta1, theta2 = dpend.load_angles(data)
    np.testing.assert_allclose(times, np.arange(9) / 10)
    assert theta1 is None
    np.testing.assert_allclose(np.degrees(theta2), [0, 1, 2, np.nan, 4, 5, 6, 7, 8])


def test_residuals_are_drawn_as_they_are(paper, chaos):
    fit = fit_parameters(FRAMES[:300], *noisy(chaos, 0)[:, :300], pendulum=off(paper))
    figure = plots.residuals(fit)
    above, *below = figure.axes
    fitted, measured = above.lines[0].get_ydata(), above.lines[1].get_ydata()
    np.testing.assert_allclose(np.radians(measured - fitted), fit.residual1, atol=1e-12)
    np.testing.assert_allclose(np.radians(below[1].lines[1].get_ydata()), fit.residual2, atol=1e-12)
    inside = np.mean(np.abs(below[0].lines[1].get_ydata()) < 1.0)
    assert 0.9 < inside < 0.99  # 95 in 100 in the band of twice the noise
    plt.close(figure)
