"""The frames of a film, and the files they are written to."""

import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from dpend.motion_picture import COLORS, draw_pivot, draw_strobe, pick_poses

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Called after each frame with how many are drawn, and of how many.
Progress: TypeAlias = Callable[[int, int], None]

# GIFs tell time in hundredths of a second, and 25 a second is the fastest rate in whole ones that
# players keep.
FRAMES_PER_SECOND = 25
# Saved times in a frame: the trail is then a curve, not a polygon.
SAVED = 4
# How much of the lower bob's way trails behind it [s].
_TRAIL = 0.6
# The sides are multiples of so many pixels, as video codecs want it.
_BLOCK = 16
# Room around the motion, of its longer side; the least width, in which the clock and two names fit;
# a line of the head, and a letter [pixels].
_ROOM, _LEAST_WIDTH, _HEAD, _LETTER = 0.07, 256, 32, 8.5


@dataclass(frozen=True)
class Film:
    """What a film shows.

    Attributes:
        times: [s], shape (n,).
        joints: of each motion [m], shape (n, 3, 2).
        names: of the motions, for the legend; empty without one.
        closed: whether the last time is followed by the first.
        size: pixels along the longer side.
    """

    times: np.ndarray
    joints: list[np.ndarray]
    names: list[str]
    closed: bool
    size: int

    @property
    def count(self) -> int:
        """Its frames."""
        return (self.times.size - 1) // SAVED + 1


def find_encoder() -> Any:
    try:
        import imageio_ffmpeg
    except ImportError:
        raise RuntimeError(
            "MP4 needs the encoder of imageio-ffmpeg: pip install 'dpend[video]', or write a .gif"
        ) from None
    return imageio_ffmpeg


def box_of(film: Film) -> tuple[np.ndarray, float, tuple[int, int]]:
    """The middle of what is seen [m], the pixels of a metre, and both sides in pixels."""
    every = np.concatenate([joints.reshape(-1, 2) for joints in film.joints])
    low, high = every.min(axis=0), every.max(axis=0)
    longest = max(float(np.max(high - low)), np.finfo(float).tiny)
    sides = high - low + 2 * _ROOM * longest
    scale = film.size / float(np.max(sides))
    width = max(scale * sides[0], min(_LEAST_WIDTH, film.size))
    across, up = (_BLOCK * math.ceil(side / _BLOCK - 1e-9) for side in (width, scale * sides[1]))
    return (low + high) / 2, scale, (across, up)


def _lay_names(film: Film, width: int) -> list[tuple[float, int]]:
    """Where the names begin [pixels], and in which line of the head: after the clock, as many in a
    line as fit.
    """
    places, x, line = [], 12 * _LETTER, 0
    for name in film.names:
        needed = (len(name) + 3) * _LETTER
        if x + needed > width and x > _LETTER:
            x, line = _LETTER, line + 1
        places.append((x, line))
        x += needed
    return places


def _canvas(film: Film) -> "tuple[Figure, Any, Any]":
    """A figure with axes for the motion, and the clock in a head above them with the legend."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    middle, scale, (across, up) = box_of(film)
    places = _lay_names(film, across)
    head = _HEAD * (1 + max((line for _, line in places), default=0))
    figure = Figure(figsize=(across / 100, (up + head) / 100), dpi=100)
    FigureCanvasAgg(figure)
    ax = figure.add_axes((0.0, 0.0, 1.0, up / (up + head)))
    reach = np.array([across, up]) / (2 * scale)
    ax.set(
        xlim=middle[0] + reach[0] * np.array([-1, 1]), ylim=middle[1] + reach[1] * np.array([-1, 1])
    )
    ax.axis("off")
    above = figure.add_axes((0.0, up / (up + head), 1.0, head / (up + head)))
    above.set(xlim=(0, across), ylim=(head, 0))
    above.axis("off")
    for i, ((x, line), name) in enumerate(zip(places, film.names, strict=True)):
        y = _HEAD * (line + 0.6)
        above.plot(x + 6, y, "o", color=COLORS[i % len(COLORS)], markersize=8)
        above.text(x + 16, y, name, fontsize=10, va="center")
    return figure, ax, above.text(_LETTER, 0.6 * _HEAD, "", fontsize=11, va="center")


def frames_of(film: Film) -> Iterator[np.ndarray]:
    """Pictures of one saved time after another, RGB bytes of shape (rows, columns, 3)."""
    figure, ax, clock = _canvas(film)
    canvas: Any = figure.canvas
    times = film.times
    tail = math.ceil(_TRAIL / abs(times[1] - times[0]))
    artists = []
    for index in range(len(film.joints)):
        color = COLORS[index % len(COLORS)]
        (trail,) = ax.plot([], [], color=color, alpha=0.35, linewidth=1.5)
        (rods,) = ax.plot([], [], "o-", color=color, linewidth=2, markersize=8, markevery=[1, 2])
        artists.append((trail, rods))
    draw_pivot(ax, 8.0)
    for i in range(0, times.size, SAVED):
        first = i - min(tail, times.size) if film.closed else max(0, i - tail)
        behind = np.arange(first, i + 1) % times.size
        for (trail, rods), where in zip(artists, film.joints, strict=True):
            trail.set_data(*where[behind, 2].T)
            rods.set_data(*where[i].T)
        clock.set_text(f"{times[i]:.2f} s")
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _write_gif(film: Film, path: Path, progress: Progress) -> int:
    from PIL import Image

    def pictures() -> Iterator[Any]:
        for done, frame in enumerate(frames_of(film), 1):
            yield Image.fromarray(frame).quantize(64, dither=Image.Dither.NONE)
            progress(done, film.count)

    frames = pictures()
    with path.open("wb") as file:
        timing = {"duration": 1000 // FRAMES_PER_SECOND, "loop": 0}
        next(frames).save(file, format="GIF", save_all=True, append_images=frames, **timing)
    return film.count


def _write_mp4(film: Film, path: Path, progress: Progress) -> int:
    encoder, writer = find_encoder(), None
    for done, frame in enumerate(frames_of(film), 1):
        if writer is None:
            sides = frame.shape[1], frame.shape[0]
            writer = encoder.write_frames(
                str(path), sides, fps=FRAMES_PER_SECOND, macro_block_size=_BLOCK
            )
            _start(writer)
        writer.send(np.ascontiguousarray(frame))
        progress(done, film.count)
    if writer is not None:
        writer.close()
    return film.count


def _start(writer: Any) -> None:
    """Starts the encoder by a fork that becomes another program at once: no thread of JAX is
    missed.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", message=r"os\.fork\(\) was called", category=RuntimeWarning
        )
        writer.send(None)


def _write_png(film: Film, path: Path, progress: Progress) -> int:
    figure, ax, clock = _canvas(film)
    clock.set_text(f"{film.times[-1]:.2f} s" if not film.names else "")
    frames = pick_poses(film.count) * SAVED
    limits = ax.axis()
    for index, joints in enumerate(film.joints):
        color = COLORS[index % len(COLORS)]
        draw_strobe(ax, joints, frames, (color, color), {})
        progress(index + 1, len(film.joints))
    ax.axis(limits)
    ax.axis("off")
    figure.savefig(path, dpi=200)
    return len(frames)


WRITERS = {".gif": _write_gif, ".mp4": _write_mp4, ".png": _write_png}
