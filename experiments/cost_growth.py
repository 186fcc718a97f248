"""What time and memory grow with: lanes from 1 to ten million, duration, tangents, and a store.

A straight line in each, or an explanation: times are medians of warm calls, memory is the peak of a
process that does nothing else. Writes `cost_growth.csv` and the figure; `--quick` takes small sizes
and writes nothing; `--draw` draws the figure again from the table.
"""

import argparse
import csv
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
SIDES = (1, 3, 10, 32, 100, 316, 1000, 3163)
DURATIONS = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
TANGENTS = (0, 1, 2, 4)


def end(pendulum, state, scheme, *, duration):
    import dpend

    last = dpend.flow(pendulum, state, duration, scheme)
    return {"end1": last.theta1, "end2": last.theta2}


def with_tangents(pendulum, state, scheme, *, duration, count):
    """The end with that many tangent vectors carried along."""
    import jax.numpy as jnp

    import dpend

    vectors = dpend.State(*(jnp.asarray(np.eye(4)[row, :count]) for row in range(4)))
    last, tangents = dpend.fold(keep, state, pendulum, state, duration, scheme, tangents=vectors)
    return {"end1": last.theta1, "growth": tangents.theta1.sum()}


def keep(carry, time, dt, state, tangents):
    return state, tangents


def grid(side: int) -> dict[str, np.ndarray]:
    # Not symmetric: no half of it is the other's mirror image.
    angles = -np.pi + (np.arange(side) + 0.4) * 2 * np.pi / side
    return {"theta1": angles, "theta2": angles}


def seconds(job, least: float = 0.5) -> tuple[float, float]:
    """Median of warm calls, and the first call, which compiles and runs once."""
    start = time.perf_counter()
    job()
    first, times = time.perf_counter() - start, []
    while len(times) < 3 or sum(times) < least:
        start = time.perf_counter()
        job()
        times.append(time.perf_counter() - start)
    return float(np.median(times)), first


def swept(side: int, duration: float = 0.5, **options):
    import dpend

    return dpend.sweep(
        partial(end, duration=duration),
        dpend.Pendulum(),
        grid(side),
        **({"tolerance": 1e-6} | options),
    )


def tell_memory(side: int) -> None:
    swept(side)
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    print(
        next(
            (int(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith("VmHWM")),
            float("nan"),
        )
    )


def measured(quick: bool) -> list[tuple[str, str, float, float, float, float]]:
    """(what grows, of what, size, seconds, first call, peak memory [MB])."""
    import dpend

    pendulum, rows = dpend.Pendulum(), []

    def add(what: str, of: str, size: float, job, memory: float = float("nan")) -> None:
        median, first = seconds(job, 0.1 if quick else 0.5)
        rows.append((what, of, size, median, first, memory))
        print(
            f"{what:10s} {of:34s} {size:10g}  {median:10.4g} s   first call {first:6.2f} "
            f"s   {memory:7.0f} MB",
            flush=True,
        )

    for side in SIDES[:4] if quick else SIDES:
        command = [sys.executable, __file__, "--memory", str(side)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        add("lanes", "sweep to 1e-6 rad, 0.5 s", side**2, partial(swept, side), float(done.stdout))
    for duration in DURATIONS[:3] if quick else DURATIONS:
        for options in (
            {"tolerance": 1e-6},
            {"tolerance": None, "method": "rk8-circle", "step": 5e-3},
        ):
            name = options.get("method") or "for a tolerance"
            add("duration", f"64 x 64, {name}", duration, partial(swept, 64, duration, **options))
    side = 32 if quick else 128
    for method, step in (("rk4-circle", 1e-3), ("rk8-circle", 5e-3), ("rk8-circle-rescaled", 0.03)):
        options = {"method": method, "step": step}
        for count in TANGENTS:
            quantity = (
                partial(with_tangents, duration=1.0, count=count)
                if count
                else partial(end, duration=1.0)
            )
            add(
                "tangents",
                f"{side} x {side}, {method}",
                count,
                partial(dpend.sweep, quantity, pendulum, grid(side), **options),
            )
        for name in ("lyapunov", "flip"):
            quantity = partial(getattr(dpend.chaos, name), duration=1.0)
            job = partial(dpend.sweep, quantity, pendulum, grid(side), **options)
            add(name, f"{side} x {side}, {method}", float("nan"), job)
    for side in (64,) if quick else (100, 316, 1000):
        for store in (False, True):
            with tempfile.TemporaryDirectory() as folder:
                places = (f"{folder}/{i}.zarr" for i in range(1000))
                job = (
                    (lambda side=side, places=places: swept(side, store=next(places)))
                    if store
                    else partial(swept, side)
                )
                add("store", "into Zarr" if store else "in memory", side**2, job)
    return rows


def exponent(sizes: list[float], values: list[float]) -> float:
    """Of the power law through the larger half."""
    half = len(sizes) // 2
    return float(np.polyfit(np.log(sizes[half:]), np.log(values[half:]), 1)[0])


def draw(rows: list) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")
    lanes = [row for row in rows if row[0] == "lanes"]
    sizes = [row[2] for row in lanes]
    power = exponent(sizes, [row[3] for row in lanes])
    (time_line,) = left.plot(
        sizes,
        [row[3] for row in lanes],
        "o-",
        color="#0072B2",
        label=f"time, power {power:.2f} at the end",
    )
    memory = left.twinx()
    (memory_line,) = memory.plot(
        sizes, [row[5] / 1e3 for row in lanes], "s--", color="#D55E00", label="peak memory"
    )
    memory.set(ylim=(0, 1), ylabel="peak memory of the process (GB)")
    left.set(
        xscale="log", yscale="log", xlabel="lanes (motions swept together)", ylabel="time (s)",
        title="a sweep of 0.5 s to 1e-6 rad",
    )  # fmt: skip
    for name, colour, marker in (
        ("64 x 64, for a tolerance", "#0072B2", "o"),
        ("64 x 64, rk8-circle", "#E69F00", "D"),
    ):
        points = [(row[2], row[3]) for row in rows if row[:2] == ("duration", name)]
        power = exponent(*map(list, zip(*points, strict=True)))
        middle.plot(
            *zip(*points, strict=True),
            marker + "-",
            color=colour,
            label=f"{name}, power {power:.2f}",
        )
    middle.set(
        xscale="log",
        yscale="log",
        xlabel="duration of each motion (s)",
        ylabel="time (s)",
        title="a sweep of 64 x 64 releases",
    )
    for name, colour, marker in (
        ("rk4-circle", "#0072B2", "s"),
        ("rk8-circle", "#E69F00", "D"),
        ("rk8-circle-rescaled", "#D55E00", "o"),
    ):
        points = [
            (row[2], row[3])
            for row in rows
            if row[0] == "tangents" and row[1].endswith(", " + name)
        ]
        plain = points[0][1]
        right.plot(
            [x for x, _ in points],
            [y / plain for _, y in points],
            marker + "-",
            color=colour,
            label=name,
        )
    right.set(
        xlabel="tangent vectors carried along",
        ylabel="time, in units of that without",
        title="128 x 128 releases over 1 s",
        ylim=(0, None),
    )
    for axis in (left, middle, right):
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    left.legend(handles=[time_line, memory_line], fontsize=8)
    figure.savefig(HERE / "figures" / "cost_growth.png", dpi=85)


def read_rows() -> list:
    """The table, as `measured` returns it."""
    with (HERE / "cost_growth.csv").open(newline="") as file:
        _, *rows = csv.reader(file)
    return [(what, of, *map(float, values)) for what, of, *values in rows]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--draw", action="store_true", help="the figure, from the table")
    parser.add_argument("--memory", type=int)
    options = parser.parse_args()
    if options.memory:
        tell_memory(options.memory)
        return
    if options.draw:
        draw(read_rows())
        return
    rows = measured(options.quick)
    if options.quick:
        return
    with (HERE / "cost_growth.csv").open("w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["grows", "of", "size", "seconds", "first_call_s", "peak_memory_MB"])
        table.writerows(
            (what, of, *(f"{value:.4g}" for value in values)) for what, of, *values in rows
        )
    draw(rows)


if __name__ == "__main__":
    main()
