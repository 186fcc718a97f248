"""Films: the frames show the motion at their times, and a file is whole or not there."""

import json
import sys

import numpy as np
import pytest
from PIL import Image

import dpend
from dpend import animate, cli
from dpend.film_picture import Film, box_of, frames_of
from dpend.motion_picture import COLORS, joints_of


@pytest.fixture(scope="module")
def pair():
    pendulum = dpend.Pendulum()
    return pendulum, animate.motions_for(
        pendulum, [dpend.released(2.0, 1.0), dpend.released(2.9, -2.0)], 0.4
    )


def test_a_film_lasts_as_long_as_the_motion(pair, tmp_path):
    told = []
    count = animate.film(
        *pair, tmp_path / "f.gif", progress=lambda done, total: told.append((done, total))
    )
    with Image.open(tmp_path / "f.gif") as film:
        assert film.n_frames == count == 11  # both ends shown
        assert film.info["duration"] * (count - 1) == 400
    assert told == [(i, 11) for i in range(1, 12)]
    assert abs(float(pair[1][0].time[-1]) - 0.4) < 1e-12


def film_of(pendulum, motions, names=(), closed=False):
    joints = [joints_of(pendulum, motion.state) for motion in motions]
    return Film(np.asarray(motions[0].time), joints, list(names), closed, 480)


def pixel(film, picture, x, y):
    """Of a point of the plane [m], in a picture of any resolution with the film's clock above."""
    middle, scale, (across, up) = box_of(film)
    head = picture.shape[0] * across / picture.shape[1] - up
    column = across / 2 + scale * (x - middle[0])
    row = head + up / 2 - scale * (y - middle[1])
    return (int(v * picture.shape[1] / across) for v in (row, column))


def test_a_frame_shows_both_bobs_where_they_are(pair):
    """The lower bobs' colours at their positions by diffrax, in the picture of the last frame."""
    pendulum, motions = pair
    film = film_of(pendulum, motions, ["one", "two"])
    *_, last = frames_of(film)
    for motion, color in zip(motions, COLORS, strict=False):
        start = dpend.released(motion.state.theta1[0], motion.state.theta2[0])
        where = dpend.positions(pendulum, dpend.reference(pendulum, start, [0.4]).state)
        row, column = pixel(film, last, float(where.x2[-1]), float(where.y2[-1]))
        expected = [int(color[i : i + 2], 16) for i in (1, 3, 5)]
        assert np.abs(last[row, column].astype(int) - expected).max() < 12


def test_a_strobe_darkens_towards_the_end(pair, tmp_path):
    pendulum, motions = pair
    assert animate.film(pendulum, motions[:1], tmp_path / "s.png") == 11
    with Image.open(tmp_path / "s.png") as file:
        picture = np.asarray(file.convert("L"))
    film = film_of(pendulum, motions[:1])

    def darkness(index):
        row, column = pixel(film, picture, *film.joints[0][index, 2])
        return 255 - int(picture[row, column])

    assert darkness(-1) > darkness(-13) > darkness(-25) > 0


def test_the_film_of_an_orbit_has_no_seam(paper, tmp_path):
    """One period in evenly spaced frames: from the last to the first it is as far as between
    others, and the frame after the last one would be the first.
    """
    orbit = dpend.find_orbit(paper, np.radians(40), branch="anti-phase")
    out = tmp_path / "o.gif"
    period = float(orbit.period)
    count = animate.film_orbit(orbit, str(out), size=200)
    assert count == round(25 * period)
    with Image.open(out) as film:
        assert (film.n_frames, film.info["loop"]) == (count, 0)
        assert max(film.size) <= 200 + 16 + 32
        frames = []
        for i in range(count):
            film.seek(i)
            frames.append(np.asarray(film.convert("L"), float))
    below = [frame[34:] for frame in frames]  # without the clock

    def change(i, j):
        return np.mean(np.abs(below[i] - below[j]))

    # The motion is symmetric in time about t = 0, so that its neighbours there are pictures of one
    # pose; only their trails differ.
    assert change(-1, 0) < 2 * change(0, 1)
    assert change(1, 0) == pytest.approx(change(0, -1), rel=0.5)
    slow = animate.film_orbit(orbit, tmp_path / "slow.png", speed=0.5)
    assert slow == 15
    with pytest.raises(ValueError, match="size must be from 64 to 4096 pixels, got 9"):
        animate.film_orbit(orbit, out, size=9)
    with pytest.raises(ValueError, match="speed must show the motion"):
        animate.film_orbit(orbit, out, speed=50)


def test_what_is_seen_is_what_the_motion_needs(paper):
    """Every joint is within the picture, and small swings are not lost in an empty one."""
    small = dpend.simulate(paper, dpend.released(0.1, 0.14), times=np.linspace(0, 2, 201))
    film = film_of(paper, [small])
    middle, scale, (across, up) = box_of(film)
    away = np.abs(film.joints[0].reshape(-1, 2) - middle) * scale
    assert np.all(away < np.array([across, up]) / 2)
    assert away[:, 1].max() > 0.8 * up / 2
    assert (across, up) == (256, 480)


def test_mp4_needs_its_encoder(pair, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(RuntimeError, match=r"imageio-ffmpeg: pip install 'dpend\[video\]'"):
        animate.film(*pair, tmp_path / "f.mp4")
    assert list(tmp_path.iterdir()) == []


def test_mp4(pair, tmp_path):
    encoder = pytest.importorskip("imageio_ffmpeg")
    count = animate.film(*pair, tmp_path / "f.mp4")
    frames, seconds = encoder.count_frames_and_secs(str(tmp_path / "f.mp4"))
    assert frames == count
    assert abs(seconds - count / 25) < 0.02


def test_an_interrupted_film_leaves_the_old_one(pair, tmp_path):
    out = tmp_path / "f.gif"
    out.write_bytes(b"old")

    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        animate.film(*pair, out, progress=stop)
    assert [path.name for path in tmp_path.iterdir()] == ["f.gif"]
    assert out.read_bytes() == b"old"


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ("--theta1 1 --theta1 2 --theta2 1 --duration 1 --out f.gif", "must be given equally "
                                                                      "often, got 2 and 1"),
        ("--theta1 1 --theta2 1 --duration 1 --out f.avi", "out must end in .gif or .mp4 or .png"),
        ("--theta1 1 --theta2 1 --duration 1e9 --out f.gif", "duration must give at most 10000 "
                                                             "frames"),
        ("--theta1 1 --theta2 1 --duration 0 --out f.gif", "duration must be a finite positive "
                                                           "number"),
        ("--theta1 1 --theta2 1 --duration 1 --speed 0 --out f.gif", "speed must be a finite "
                                                                     "positive number"),
        ("--theta1 1 --theta2 1 --duration 1 --speed 1e12 --out f.gif", "speed must show the "
                                                                        "motion of 1 s"),
        ("--theta1 1 --theta2 1 --duration 1e300 --speed 1e-300 --out f.gif", "must give at most "
                                                                              "10000 frames"),
        ("--theta1 1 --theta2 1 --duration 1 --g 1e30 --out f.gif", "duration must take at most "
                                                                    "1e+07 steps"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line(capsys, monkeypatch, tmp_path, arguments, line):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli, "_keep_compiled_code", lambda: None)
    assert cli._run(["animate", *arguments.split()]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert line in err


def test_the_command(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(cli, "_keep_compiled_code", lambda: None)
    out = tmp_path / "f.gif"
    command = f"animate --theta1 166 --theta2 177 --duration 0.4 --out {out} --json"
    assert cli._run(command.split()) == 0
    found = json.loads(capsys.readouterr().out)
    with Image.open(out) as film:
        assert found["frames"] == film.n_frames == 11
    assert found["motions"][0]["status"] == "converged"
