"""Motions as moving pictures: GIF by Pillow, MP4 by the encoder of imageio-ffmpeg, PNG as a
stroboscope sees it.

Several releases are drawn into one picture, each in a colour of its own, so that one sees when they
part. The film of an orbit lasts a period, and its end runs into its beginning without a seam.
"""

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dpend.checks import function, instance, integer, known_number, shown, single
from dpend.film_picture import FRAMES_PER_SECOND, SAVED, WRITERS, Film, Progress, find_encoder
from dpend.mechanics.linear import fast_frequency
from dpend.mechanics.pendulum import (
    Pendulum,
    State,
    check_motion,
    check_pendulum,
    check_state,
)
from dpend.motion.simulate import simulate
from dpend.motion.trajectory import Trajectory
from dpend.motion_picture import joints_of
from dpend.orbits.orbit import PeriodicOrbit
from dpend.places import check_place, file_path, replacing

# The fast mode advances by this in a step [rad]. Order 8 is then right far below a pixel, for as
# long as the motion can be known at all, and all releases share one compiled program.
_TURN = 0.05
# Pixels of the longer side of what is seen.
PIXELS, _LEAST_PIXELS, _MOST_PIXELS = 480, 64, 4096
# Beyond this a GIF is hundreds of megabytes, and no one waits for it.
_MOST_FRAMES = 10_000
# Half a minute of computing for each release; only a few of its states are saved.
_MOST_STEPS = 10_000_000


def motions_for(
    pendulum: Pendulum | Any,
    releases: Sequence[State] | Any,
    duration: float | Any,
    *,
    speed: float | Any = 1.0,
) -> list[Trajectory]:
    """The motions from `releases`, saved four times a frame.

    Arguments:
        duration: of the motion [s], positive; rounded up to whole frames.
        speed: seconds of the motion in a second of the film; 1 is real time.
    Returns:
        Trajectories with equal times. Their status says whether their end may be believed.
    Raises:
        ValueError: duration or speed not positive; a speed at which the motion does not last for a
            frame; more than 10 000 frames, or 1e7 steps; rates that overflow.
    """
    if not isinstance(releases, Sequence) or isinstance(releases, (str, bytes)):
        raise ValueError(
            f"releases must be a sequence of states, got {shown(releases)}: give one like [state]"
        )
    for release in releases:
        check_state(release, "releases")
        check_motion(pendulum, release)
    check_pendulum(pendulum)
    interval = known_number("speed", speed, positive=True) / FRAMES_PER_SECOND
    duration = known_number("duration", duration, positive=True, unit="s")
    frames = _count_frames(duration, interval, speed)
    substeps = interval * float(fast_frequency(pendulum)) / (_TURN * SAVED)
    steps = frames * SAVED * (substeps + 1)
    if not steps <= _MOST_STEPS:
        raise ValueError(
            f"duration must take at most {_MOST_STEPS:.0e} steps with this pendulum, got "
            f"{duration:g} s, which takes {steps:.3g}: give a shorter one, or another pendulum"
        )
    every = max(1, math.ceil(substeps))
    step = interval / (SAVED * every)
    end, most = frames * interval, 2 * _MOST_STEPS
    return [
        simulate(pendulum, one, end, step=step, save_every=every, most_steps=most)
        for one in releases
    ]


def _count_frames(duration: float, interval: float, speed: float) -> int:
    """The frames of a film, `interval` apart in the motion [s]; refuses none and too many."""
    if not interval <= duration:
        raise ValueError(
            f"speed must show the motion of {duration:g} s for a frame at least, got {speed:g}: "
            f"lower it"
        )
    count = duration / interval if interval > 0 else math.inf
    if count > _MOST_FRAMES:
        raise ValueError(
            f"duration must give at most {_MOST_FRAMES} frames, got {count:.3g}: give a shorter "
            f"one, or a higher speed"
        )
    return math.ceil(count - 1e-9)


def _count_loop(period: float, interval: float, speed: float) -> int:
    """The frames of a loop: two at least, the number nearest to `speed`."""
    _count_frames(period, 2 * interval, speed)
    return round(period / interval)


def film(
    pendulum: Pendulum | Any,
    motions: Sequence[Trajectory] | Any,
    out: str | os.PathLike[str] | Any,
    *,
    size: int | Any = PIXELS,
    progress: Progress | Any | None = None,
) -> int:
    """Draws motions with common, equally spaced times into `out`; returns the number of frames.

    A .gif or .mp4 shows every fourth saved time, 25 in a second, and as much of the plane as the
    motions need; a .png some fifteen of these at once over the path of the lower bob, fading into
    the past. Several motions have a legend with the angles that they begin with.

    Arguments:
        out: text or a path.
        size: pixels along the longer side, without the line for the clock.
        progress: called after each frame with how many are drawn, and of how many.
    Raises:
        ValueError: another suffix, no such directory, no motions, or motions with different times;
            a size that is no integer from 64 to 4096.
        RuntimeError: .mp4 without imageio-ffmpeg.
    """
    out = check_request(out, size)
    if progress is not None:
        function("progress", progress, "(frames done, frames in all)", "print")
    check_pendulum(pendulum)
    if not isinstance(motions, Sequence):
        raise ValueError(
            f"motions must be a sequence of trajectories, got {shown(motions)}: see motions_for"
        )
    for motion in motions:
        instance("motions", motion, Trajectory, "a list of them, see motions_for")
    if not motions or not all(np.array_equal(motion.time, motions[0].time) for motion in motions):
        raise ValueError(
            f"motions must be at least one, saved at the same times, got {len(motions)}: see "
            f"motions_for"
        )
    joints = [joints_of(pendulum, motion.state) for motion in motions]
    starts = [np.degrees([motion.state.theta1[0], motion.state.theta2[0]]) for motion in motions]
    names = [f"({one:.5g}, {two:.5g})°" for one, two in starts] if len(motions) > 1 else []
    return _write(Film(np.asarray(motions[0].time), joints, names, False, int(size)), out, progress)


def film_orbit(
    orbit: PeriodicOrbit | Any,
    out: str | os.PathLike[str] | Any,
    *,
    speed: float | Any = 1.0,
    size: int | Any = PIXELS,
    progress: Progress | Any | None = None,
) -> int:
    """Draws one period of an orbit into `out`; returns the number of frames.

    Shown in a loop, the film has no seam: the last frame is followed by the first at the distance
    of all others, in time and in the plane, and what trails behind the bob goes on, too. To that
    end the frames are evenly spaced over the period, and `speed` is kept to the nearest frame.

    Arguments:
        orbit: a single one that was found.
        out, size, progress: see `film`.
        speed: seconds of the motion in a second of the film.
    Raises:
        ValueError: as `film`; many orbits, or one that was not found; a speed that leaves fewer
            than two frames, or more than 10 000.
        RuntimeError: .mp4 without imageio-ffmpeg.
    """
    out = check_request(out, size)
    if progress is not None:
        function("progress", progress, "(frames done, frames in all)", "print")
    instance("orbit", orbit, PeriodicOrbit, "what dpend.find_orbit returns")
    single("orbit", orbit.period)
    rate = known_number("speed", speed, positive=True) / FRAMES_PER_SECOND
    period = float(orbit.period)
    if not math.isfinite(period):
        raise ValueError(f"orbit must be one that was found, got a period of {period}: see status")
    count = _count_loop(period, rate, speed)
    motion = orbit.trajectory(np.arange(SAVED * count) * (period / (SAVED * count)))
    joints = [joints_of(orbit.pendulum, motion.state)]
    return _write(Film(motion.time, joints, [], True, int(size)), out, progress)


def check_request(out: Any, size: Any = PIXELS) -> Path:
    """The path of a film, once it is known that it can be written; raises as `film` does."""
    out = file_path("out", out)
    check_out(out)
    if not _LEAST_PIXELS <= integer("size", size) <= _MOST_PIXELS:
        raise ValueError(
            f"size must be from {_LEAST_PIXELS} to {_MOST_PIXELS} pixels, got {size}: give "
            f"another one"
        )
    return out


def _write(film: Film, out: Path, progress: Progress | None) -> int:
    with replacing(out) as draft:
        return WRITERS[out.suffix](film, draft, progress or (lambda done, total: None))


def check_out(out: str | os.PathLike[str] | Any) -> None:
    """Refuses, before anything is computed, what `film` could not write; raises as it does."""
    out = file_path("out", out)
    check_place("out", out, tuple(WRITERS))
    if out.suffix == ".mp4":
        find_encoder()
