"""The paper, reproduced: its figures 1 to 49, and a table of every number printed in it.

Iwao Yamaguchi, "On the periodical behavior of a double pendulum" (in Japanese). Each figure stands
twice, as printed on the left and true on the right (paper_numbers.py says what that means), in
figures/paper/ as PNG and, in the paper's order with captions, in paper.pdf there. The numbers go to
paper_claims.csv. `--quick` draws five figures, for tests.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from paper_numbers import (
    CASES,
    CONFIRMED,
    DEGREE,
    DIFFERS,
    MODES,
    ONLY_PRINTED,
    PAPER,
    Motion,
    chaos_of,
    lower_somersaults,
    motion_of,
    orbit_of,
    parting_time,
    rough_slope,
    separation,
    upper_somersaults,
    write_claims,
)

import dpend
from dpend.plots import LOWER, NEUTRAL, UPPER

HERE = Path(__file__).parent
STYLE = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 1.0,
    "savefig.dpi": 110,
}
NAMES = {
    "theta1": "theta1 (rad)", "theta2": "theta2 (rad)",
    "kinetic1": "kinetic energy of bob 1 (J)", "potential1": "potential energy of bob 1 (J)",
    "kinetic2": "kinetic energy of bob 2 (J)", "potential2": "potential energy of bob 2 (J)",
}  # fmt: skip


class Plan(NamedTuple):
    """A figure: its number, what it shows, and how it is drawn into one axes for one mode."""

    number: int
    title: str
    draw: Callable


# --- one panel ------------------------------------------------------------------------------------


def path(name: str, points: bool = False) -> Callable:
    """theta1 to the right, theta2 upwards; over one period, or in figure 2 every tenth step of 3 s,
    joined.
    """

    def draw(ax, mode):
        motion = motion_of(name, mode)
        part = motion.until(2.9905).every(0.01) if points else motion.until(period(name, mode))
        ax.plot(
            part.theta1,
            part.theta2,
            ".-" if points else "-",
            color=NEUTRAL,
            markersize=2,
            linewidth=0.7,
        )
        ax.plot(part.theta1[0], part.theta2[0], "o", color="black", markersize=4)
        ax.set(xlabel=NAMES["theta1"], ylabel=NAMES["theta2"])

    return draw


def phase(name: str, bob: int) -> Callable:
    """Kinetic energy to the right, potential energy upwards, a point each ms: of 3 s, from B on of
    a period.
    """

    def draw(ax, mode):
        motion = motion_of(name, mode)
        part = motion if name == "A" else motion.until(period(name, mode))
        x, y = f"kinetic{bob}", f"potential{bob}"
        ax.plot(getattr(part, x), getattr(part, y), ".", color=_colour(bob), markersize=1.5)
        ax.set(xlabel=NAMES[x], ylabel=NAMES[y])
        ax.locator_params(axis="x", nbins=5)

    return draw


def curve(name: str, value: str) -> Callable:
    """A value against time over exactly one period."""

    def draw(ax, mode):
        part = motion_of(name, mode).until(period(name, mode))
        ax.plot(part.time, getattr(part, value), color=_colour(int(value[-1])))
        ax.axhline(0, color=NEUTRAL, linewidth=0.4)
        ax.set(xlabel="time (s)", ylabel=NAMES[value])

    return draw


def strobe(name: str, step: float, share: float = 0.5, bobs: tuple = (1, 2)) -> Callable:
    """The rods every `step` seconds over a share of the period; with bob 2 alone, its way without
    the rods.
    """

    def draw(ax, mode):
        part = motion_of(name, mode).until(share * period(name, mode)).every(step)
        _rods(ax, part, bobs)

    return draw


def _colour(bob: int) -> str:
    return UPPER if bob == 1 else LOWER


def _rods(ax, motion: Motion, bobs: tuple = (1, 2), width: float = 0.8) -> None:
    state = dpend.State(motion.theta1, motion.theta2, motion.p1, motion.p2)
    x1, y1, x2, y2 = (np.asarray(value) for value in dpend.positions(PAPER, state))
    still = np.zeros_like(x1)
    if 1 in bobs:
        ax.plot(
            np.stack([still, x1]), np.stack([still, y1]), color=UPPER, linewidth=width, alpha=0.6
        )
        ax.plot(np.stack([x1, x2]), np.stack([y1, y2]), color=LOWER, linewidth=width, alpha=0.6)
        ax.plot(x1, y1, "o", color=UPPER, markersize=3)
    ax.plot(x2, y2, "o", color=LOWER, markersize=3)
    ax.plot(0, 0, "s", color="black", markersize=3)
    ax.set(xlabel="x (m)", ylabel="y (m)")
    ax.set_aspect("equal", adjustable="datalim")


def period(name: str, mode: str) -> float:
    """One period [s] of the orbit that belongs to the printed theta1."""
    return float(orbit_of(name, mode).period)


def chaotic_path(ax, mode) -> None:
    motion = chaos_of(mode)
    ax.plot(motion.theta1, motion.theta2, color=NEUTRAL, linewidth=0.7)
    ax.plot(motion.theta1[0], motion.theta2[0], "o", color="black", markersize=4)
    ax.plot(
        motion.at("theta1", parting_time()),
        motion.at("theta2", parting_time()),
        "x",
        color=LOWER,
        markersize=7,
    )
    ax.set(xlabel=NAMES["theta1"], ylabel=NAMES["theta2"])


def chaotic_curve(value: str) -> Callable:
    """A value over 5 s; the other mode's in grey behind it, and a line where they part."""

    def draw(ax, mode):
        other = chaos_of(MODES[1 - MODES.index(mode)])
        motion = chaos_of(mode)
        ax.plot(
            other.time, getattr(other, value), color="0.75", label=f"{MODES[1 - MODES.index(mode)]}"
        )
        ax.plot(motion.time, getattr(motion, value), color=_colour(int(value[-1])), label=mode)
        ax.axvline(
            parting_time(), color="black", linewidth=0.7, linestyle=":", label="0.1 rad apart"
        )
        if value.startswith("potential"):
            times = (
                upper_somersaults(motion) if value == "potential1" else lower_somersaults(motion)
            )
            heights = np.interp(times, motion.time, getattr(motion, value))
            ax.plot(
                times,
                heights,
                "v",
                color="black",
                markersize=5,
                label="somersaults, as the paper counts them",
            )
        ax.set(xlabel="time (s)", ylabel=NAMES[value])
        ax.margins(y=0.22)
        ax.legend(frameon=False, fontsize=7, ncols=2, loc="upper left", columnspacing=1.0)

    return draw


def chaotic_separation(ax, mode) -> None:
    time, logs, start = separation(mode)
    ax.semilogy(time, start * np.exp(logs), color=NEUTRAL)
    for slope, style, label in (
        (rough_slope(time, logs), "-", "rough, through t = 0"),
        (float(time @ logs / (time @ time)), "--", "least squares, through t = 0"),
    ):
        ax.semilogy(
            time, start * np.exp(slope * time), style, color=LOWER, label=f"{label}: {slope:.2f}/s"
        )
    ax.set(xlabel="time (s)", ylabel="separation (rad and SI momenta)")
    ax.legend(frameon=False, fontsize=8)


def chaotic_strobe(ax, mode) -> None:
    _rods(ax, chaos_of(mode).every(0.01), width=0.3)


def sketch(ax, mode) -> None:
    """Figure 1: the pendulum and its angles."""
    theta1, theta2 = 0.5, 0.9
    x1, y1 = np.sin(theta1), -np.cos(theta1)
    x2, y2 = x1 + np.sin(theta2), y1 - np.cos(theta2)
    for (x, y), angle, name in (((0, 0), theta1, "theta1"), ((x1, y1), theta2, "theta2")):
        ax.plot([x, x], [y, y - 0.9], "--", color=NEUTRAL, linewidth=0.7)
        arc = np.linspace(0, angle)
        ax.plot(x + 0.4 * np.sin(arc), y - 0.4 * np.cos(arc), color=NEUTRAL, linewidth=0.8)
        ax.text(x - 0.04, y - 0.45, name, ha="right")
    ax.plot([0, x1], [0, y1], color=UPPER, linewidth=2)
    ax.plot([x1, x2], [y1, y2], color=LOWER, linewidth=2)
    ax.plot(x1, y1, "o", color=UPPER, markersize=14)
    ax.plot(x2, y2, "o", color=LOWER, markersize=14)
    ax.plot(0, 0, "s", color="black")
    for x, y, text in (
        (x1 + 0.12, y1 + 0.05, "m1"),
        (x2 + 0.12, y2 + 0.05, "m2"),
        (x1 / 2 + 0.06, y1 / 2 + 0.05, "l1"),
        ((x1 + x2) / 2 + 0.1, (y1 + y2) / 2 + 0.05, "l2"),
    ):
        ax.text(x, y, text)
    ax.set(xlim=(-0.6, 2.0), ylim=(-2.1, 0.2))
    ax.set_aspect("equal")
    ax.axis("off")


# --- all of them ----------------------------------------------------------------------------------


def plans() -> list[Plan]:
    """Figures 1 to 49 in the paper's order."""
    found = [
        Plan(1, "The double pendulum: point masses on massless rods", sketch),
        Plan(2, "A: path, every 10th step of 3 s", path("A", points=True)),
        Plan(3, "A: energies of bob 1", phase("A", 1)),
        Plan(4, "A: energies of bob 2", phase("A", 2)),
    ]
    values = [f"{kind}{bob}" for bob in (1, 2) for kind in ("theta", "kinetic", "potential")]
    found += [
        Plan(5 + i, f"A: {_said(value)} over one period", curve("A", value))
        for i, value in enumerate(values)
    ]
    found += [Plan(11, "A: every 0.03 s of half a period", strobe("A", 0.03))]
    for first, name in ((12, "B"), (18, "C"), (24, "D"), (31, "E"), (37, "F")):
        step = CASES[name].strobe
        found += [
            Plan(first, f"{name}: path over one period", path(name)),
            Plan(first + 1, f"{name}: energies of bob 1", phase(name, 1)),
            Plan(first + 2, f"{name}: energies of bob 2", phase(name, 2)),
            Plan(first + 3, f"{name}: theta1 over one period", curve(name, "theta1")),
            Plan(first + 4, f"{name}: theta2 over one period", curve(name, "theta2")),
            Plan(first + 5, f"{name}: every {step} s of half a period", strobe(name, step)),
        ]
        if name == "D":
            found.append(
                Plan(
                    30, "D: bob 2 every 0.015 s of a quarter period", strobe("D", 0.015, 0.25, (2,))
                )
            )
    found.append(
        Plan(
            43,
            f"Chaotic: path over 5 s; the cross marks t = {parting_time():.2f} s, where both modes "
            f"part",
            chaotic_path,
        )
    )
    chaotic = ("theta1", "theta2", "potential1", "potential2")
    found += [
        Plan(44 + i, f"Chaotic: {_said(key)} over 5 s", chaotic_curve(key))
        for i, key in enumerate(chaotic)
    ]
    found += [Plan(48, "Chaotic: separation from a release 1e-6 deg away", chaotic_separation),
              Plan(49, "Chaotic: every 0.01 s of 5 s", chaotic_strobe)]  # fmt: skip
    return found


def _said(value: str) -> str:
    return NAMES[value].partition(" (")[0]


def drawn(plan: Plan) -> Figure:
    """The figure with both modes side by side, and its caption below."""
    alone = plan.draw is sketch
    fig, axes = plt.subplots(1, 1 if alone else 2, figsize=(8.6, 4.3), squeeze=False)
    fig.subplots_adjust(left=0.09, right=0.98, top=0.91, bottom=0.22, wspace=0.26)
    for ax, mode in zip(axes[0], MODES, strict=False):
        plan.draw(ax, mode)
        if not alone:
            ax.set_title(_subtitle(plan, mode))
    fig.text(0.5, 0.05, f"Figure {plan.number}. {plan.title}.", ha="center", fontsize=10)
    return fig


def _subtitle(plan: Plan, mode: str) -> str:
    name = plan.title[0]
    if name not in CASES or plan.title[1] != ":":
        return f"{mode}: (170, 180) deg, {'3.14, RK4' if mode == 'as printed' else 'pi, converged'}"
    theta1 = CASES[name].theta1
    if mode == "as printed":
        return f"as printed: ({theta1}, {CASES[name].theta2}) deg by 3.14, RK4"
    orbit = orbit_of(name, mode)
    theta2 = float(orbit.theta2) / DEGREE["true"]
    return f"true: ({theta1}, {theta2:.4f}) deg, T = {float(orbit.period):.4f} s"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="five figures instead of 49")
    parser.add_argument(
        "--out", type=Path, default=HERE / "figures" / "paper", help="where the figures go"
    )
    parser.add_argument(
        "--claims", type=Path, default=HERE / "paper_claims.csv", help="where the table goes"
    )
    options = parser.parse_args()
    started = time.perf_counter()
    options.out.mkdir(parents=True, exist_ok=True)
    wanted = [plan for plan in plans() if not options.quick or plan.number in (1, 2, 11, 46, 48)]
    with plt.rc_context(STYLE), PdfPages(options.out / "paper.pdf") as book:
        for plan in wanted:
            figure = drawn(plan)
            figure.savefig(options.out / f"figure_{plan.number:02d}.png")
            book.savefig(figure)
            plt.close(figure)
    print(
        f"{len(wanted)} figures in {options.out}, all in paper.pdf there, "
        f"{time.perf_counter() - started:.0f} s"
    )
    found = write_claims(options.claims)
    verdicts = [claim.verdict.partition(":")[0] for claim in found]
    counts = ", ".join(
        f"{verdicts.count(verdict)} {verdict}" for verdict in (CONFIRMED, ONLY_PRINTED, DIFFERS)
    )
    print(f"{len(found)} claims: {counts}; {time.perf_counter() - started:.0f} s in all")


if __name__ == "__main__":
    main()
