"""Motions as moving pictures: GIF by Pillow, MP4 by the encoder of imageio-ffmpeg, PNG as a
stroboscope sees it.

Several releases are drawn into one picture, each in a colour of its own, so that one sees when they
part.
"""

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from dpend.checks import function, instance, known_number, shown
from dpend.mechanics.linear import fast_frequency
from dpend.mechanics.pendulum import (
    Pendulum,
    State,
    check_motion,
    check_pendulum,
    check_state,
    positions,
)
from dpend.motion.simulate import simulate
from dpend.motion.trajectory import Trajectory
from dpend.places import check_place, file_path, replacing
from dpend.plots import LOWER, UPPER

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Called after each frame with how many are drawn, and of how many.
Progress: TypeAlias = Callable[[int, int], None]

# Okabe and Ito's palette, told apart by the colour-blind; its yellow is too pale for a line on
# white.
COLOURS = (UPPER, LOWER, "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
# GIFs tell time in hundredths of a second, and 25 a second is the fastest rate in whole ones that
# players keep.
FRAMES_PER_SECOND = 25
# The fast mode advances by this in a step [rad]. Order 8 is then right far below a pixel, for as
# long as the motion can be known at all, and all releases share one compiled program.
_TURN = 0.05
# Saved times in a frame: the trail is then a curve, not a polygon.
_SAVED = 4
# How much of the lower bob's way trails behind it [s].
_TRAIL = 0.6
# Pixels along a side: a multiple of 16, as video codecs want it.
_PIXELS = 480
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
    substeps = interval * float(fast_frequency(pendulum)) / (_TURN * _SAVED)
    steps = frames * _SAVED * (substeps + 1)
    if not steps <= _MOST_STEPS:
        raise ValueError(
            f"duration must take at most {_MOST_STEPS:.0e} steps with this pendulum, got "
            f"{duration:g} s, which takes {steps:.3g}: give a shorter one, or another pendulum"
        )
    every = max(1, math.ceil(substeps))
    step = interval / (_SAVED * every)
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


def film(
    pendulum: Pendulum | Any,
    motions: Sequence[Trajectory] | Any,
    out: Path | Any,
    *,
    progress: Progress | Any | None = None,
) -> int:
    """Draws motions with common, equally spaced times into `out`; returns the number of frames.

    A .gif or .mp4 shows every fourth saved time, 25 in a second; a .png all of these at once,
    fading into the past.

    Arguments:
        progress: called after each frame with how many are drawn, and of how many.
    Raises:
        ValueError: another suffix, no such directory, no motions, or motions with different times.
        RuntimeError: .mp4 without imageio-ffmpeg.
    """
    out = file_path("out", out)
    check_out(out)
    check_pendulum(pendulum)
    if not isinstance(motions, Sequence):
        raise ValueError(
            f"motions must be a sequence of trajectories, got {shown(motions)}: see motions_for"
        )
    for motion in motions:
        instance("motions", motion, Trajectory, "a list of them, see motions_for")
    if progress is not None:
        function("progress", progress, "(frames done, frames in all)", "print")
    if not motions or not all(np.array_equal(motion.time, motions[0].time) for motion in motions):
        raise ValueError(
            f"motions must be at least one, saved at the same times, got {len(motions)}: see "
            f"motions_for"
        )
    with replacing(out) as draft:
        return _WRITERS[out.suffix](
            pendulum, motions, draft, progress or (lambda done, total: None)
        )


def check_out(out: Path | Any) -> None:
    """Refuses, before anything is computed, what `film` could not write; raises as it does."""
    out = file_path("out", out)
    check_place("out", out, tuple(_WRITERS))
    if out.suffix == ".mp4":
        _encoder()


def _encoder() -> Any:
    try:
        import imageio_ffmpeg
    except ImportError:
        raise RuntimeError(
            "MP4 needs the encoder of imageio-ffmpeg: pip install 'dpend[video]', or write a .gif"
        ) from None
    return imageio_ffmpeg


def _joints(pendulum: Pendulum, motion: Trajectory) -> np.ndarray:
    """Pivot and both bobs [m], shape (times, 3, 2)."""
    x1, y1, x2, y2 = (np.asarray(leaf) for leaf in positions(pendulum, motion.state))
    still = np.zeros_like(x1)
    return np.stack([np.stack([still, x1, x2], 1), np.stack([still, y1, y2], 1)], 2)


def _count(motions: Sequence[Trajectory]) -> int:
    """Frames of a film."""
    return (motions[0].time.size - 1) // _SAVED + 1


def _canvas(pendulum: Pendulum) -> "tuple[Figure, Any]":
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_PIXELS / 100, _PIXELS / 100), dpi=100)
    FigureCanvasAgg(figure)
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    reach = 1.1 * float(pendulum.l1 + pendulum.l2)
    ax.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
    ax.axis("off")
    ax.plot(0, 0, "s", color="black", markersize=4)
    return figure, ax


def _frames(pendulum: Pendulum, motions: Sequence[Trajectory]) -> Iterator[np.ndarray]:
    """Pictures of one saved time after another, RGB bytes of shape (480, 480, 3)."""
    figure, ax = _canvas(pendulum)
    canvas: Any = figure.canvas
    joints = [_joints(pendulum, motion) for motion in motions]
    times = np.asarray(motions[0].time)
    tail = math.ceil(_TRAIL / abs(times[1] - times[0]))
    artists = []
    for index in range(len(motions)):
        colour = COLOURS[index % len(COLOURS)]
        (trail,) = ax.plot([], [], color=colour, alpha=0.35, linewidth=1.5)
        (rods,) = ax.plot([], [], "o-", color=colour, linewidth=2, markersize=8)
        artists.append((trail, rods))
    clock = ax.text(0.03, 0.95, "", transform=ax.transAxes, fontsize=11)
    for i in range(0, times.size, _SAVED):
        for (trail, rods), where in zip(artists, joints, strict=True):
            trail.set_data(*where[max(0, i - tail) : i + 1, 2].T)
            rods.set_data(*where[i].T)
        clock.set_text(f"{times[i]:.2f} s")
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _write_gif(
    pendulum: Pendulum, motions: Sequence[Trajectory], path: Path, progress: Progress
) -> int:
    from PIL import Image

    total = _count(motions)

    def pictures() -> Iterator[Any]:
        for done, frame in enumerate(_frames(pendulum, motions), 1):
            yield Image.fromarray(frame).quantize(64, dither=Image.Dither.NONE)
            progress(done, total)

    frames = pictures()
    with path.open("wb") as file:
        timing = {"duration": 1000 // FRAMES_PER_SECOND, "loop": 0}
        next(frames).save(file, format="GIF", save_all=True, append_images=frames, **timing)
    return total


def _write_mp4(
    pendulum: Pendulum, motions: Sequence[Trajectory], path: Path, progress: Progress
) -> int:
    total = _count(motions)
    writer = _encoder().write_frames(
        str(path), (_PIXELS, _PIXELS), fps=FRAMES_PER_SECOND, macro_block_size=16
    )
    with warnings.catch_warnings():
        # The encoder is started by a fork that becomes another program at once: no thread of JAX is
        # missed.
        warnings.filterwarnings(
            "ignore", message=r"os\.fork\(\) was called", category=RuntimeWarning
        )
        writer.send(None)
    for done, frame in enumerate(_frames(pendulum, motions), 1):
        writer.send(np.ascontiguousarray(frame))
        progress(done, total)
    writer.close()
    return total


def _write_png(
    pendulum: Pendulum, motions: Sequence[Trajectory], path: Path, progress: Progress
) -> int:
    figure, ax = _canvas(pendulum)
    total = _count(motions)
    for index, motion in enumerate(motions):
        colour = COLOURS[index % len(COLOURS)]
        for i, where in enumerate(_joints(pendulum, motion)[::_SAVED]):
            fade = 0.1 + 0.9 * ((i + 1) / total) ** 2
            ax.plot(*where.T, "o-", color=colour, alpha=fade, linewidth=1, markersize=4)
            progress(i + 1, total)
    figure.savefig(path, dpi=200)
    return total


_WRITERS = {".gif": _write_gif, ".mp4": _write_mp4, ".png": _write_png}
