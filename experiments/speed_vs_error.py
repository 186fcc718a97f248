"""Speed against error: every method here beside what people would use instead, on the same motions
in one run.

Four workloads: single trajectories one after the other, calm and chaotic, many easy ones at a time,
and the hard grid of all releases from rest. `dpend.simulate` saves 100 states with their error
estimates, its peers the end alone. Jobs take turns, warm, as many threads as cores; the table has
medians with the range of the turns, the first call (which compiles, and runs once) in its own
column, and the peak memory of a process that does nothing else. Errors are the larger angle's at
the end: against heyoka's Taylor series in long double on 256 lanes drawn at random, and against our
own finest run on all. A second measurement follows the energy through 10 000 s.

Writes `speed_vs_error.csv`, `energy_error.csv`, the figure and, from the first file alone,
README.md's table; peers that are not installed are left out by name. `--quick` runs a few lanes and
writes nothing, `--table` writes only the README's table.
"""

import argparse
import csv
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path

import numpy as np
import peers

HERE = Path(__file__).parent
README = HERE.parent / "README.md"
RANDOM_LANES = 256
SINGLE, CHAOTIC = "one trajectory, 10 s", "one chaotic trajectory, 3 s"
EASY, HARD = "16384 easy lanes, 1 s", "hard grid, 64 x 64, 2 s"


@dataclass(frozen=True)
class Row:
    """A method at one setting on one workload; errors in rad, rates in trajectory-seconds per
    second.
    """

    workload: str
    method: str
    setting: float  # step [s], or tolerance
    lanes: int
    rate: float
    rate_low: float
    rate_high: float
    first_call_s: float
    peak_memory_MB: float
    error_median: float
    error_99: float
    error_worst: float
    error_99_all_lanes: float
    error_worst_all_lanes: float


# --- motions --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Workload:
    """Releases from rest for a time [s], in the order in which a sweep deals them to lanes: by
    energy.
    """

    name: str
    theta1: np.ndarray
    theta2: np.ndarray
    duration: float


def workloads(quick: bool) -> list[Workload]:
    single = np.linspace(0.2, 1.2, 8)
    count, side = (512, 16) if quick else (16384, 64)
    angles = -np.pi + (np.arange(side) + 0.5) * 2 * np.pi / side
    square = [mesh.ravel() for mesh in np.meshgrid(angles, angles, indexing="ij")]
    easy = [np.linspace(1.0, 2.6, count), np.full(count, 1.1)]
    found = [
        Workload(SINGLE, single, np.full(8, 0.5), 10.0),
        Workload(CHAOTIC, np.array([2.9, 2.5, -2.8, 2.2]), np.array([3.0, 2.9, 2.6, -3.0]), 3.0),
    ]
    for name, (theta1, theta2), duration in ((EASY, easy, 1.0), (HARD, square, 2.0)):
        order = np.argsort(-2 * np.cos(theta1) - np.cos(theta2), kind="stable")
        found.append(Workload(name, theta1[order], theta2[order], duration))
    return found


@dataclass(frozen=True)
class End:
    """The angles at the end of a motion: a value, so that equal ones share compiled code."""

    scheme: object
    duration: float

    def __call__(self, pendulum, state):
        import dpend

        end = dpend.flow(pendulum, state, self.duration, self.scheme)
        return end.theta1, end.theta2


Jobs = dict[tuple[str, float], tuple[Callable[[], np.ndarray], np.ndarray]]


def our_lanes(work: Workload, schemes: dict) -> Jobs:
    import dpend
    from dpend.maps.lanes import over_lanes

    state, every = dpend.released(work.theta1, work.theta2), np.arange(work.theta1.size)

    def job(scheme):
        function = End(scheme, work.duration)
        return lambda: np.stack(over_lanes(function, dpend.Pendulum(), state))

    return {key: (job(scheme), every) for key, scheme in schemes.items()}


def our_singles(work: Workload, quick: bool) -> Jobs:
    import jax

    import dpend

    pendulum, every = dpend.Pendulum(), np.arange(work.theta1.size)
    states = [dpend.released(*pair) for pair in zip(work.theta1, work.theta2, strict=True)]

    def stepped(name, step):
        run = jax.jit(
            lambda state: dpend.flow(pendulum, state, work.duration, dpend.Scheme(name, step))
        )

        def once():
            ends = [run(state) for state in states]
            return np.array([(float(end.theta1), float(end.theta2)) for end in ends]).T

        return once

    times = np.linspace(0.0, work.duration, 101)[1:]

    def simulated(tolerance):
        def once():
            motions = [
                dpend.simulate(pendulum, state, times=times, tolerance=tolerance)
                for state in states
            ]
            return np.array(
                [(motion.state.theta1[-1], motion.state.theta2[-1]) for motion in motions]
            ).T

        return once

    steps = {
        "rk4": (4e-3, 1e-3, 2.5e-4), "rk4-circle": (4e-3, 1e-3, 2.5e-4), "rk8": (2e-2, 1e-2, 5e-3),
        "rk8-circle": (2e-2, 1e-2, 5e-3), "gauss": (1e-2, 5e-3, 2.5e-3),
    }  # fmt: skip
    jobs = {
        (name, step): stepped(name, step)
        for name, each in steps.items()
        for step in each[: 1 if quick else None]
    }
    jobs |= {
        ("dpend.simulate", each): simulated(each)
        for each in ((1e-6,) if quick else (1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-12))
    }
    return {key: (job, every) for key, job in jobs.items()}


def jobs_of(work: Workload, quick: bool, only: str | None = None) -> Jobs:
    """All methods on a workload, or only one; slow ones run a share of the lanes, drawn at
    random.
    """
    import dpend

    lanes = work.theta1.size
    shuffled = np.random.default_rng(0).permutation(lanes)
    few = slice(0, 1 if quick else None)
    jobs: Jobs = {}

    def add(name: str, make: Callable, settings: tuple, share: int) -> None:
        if only is not None and not only.startswith(name):
            return
        index = np.arange(lanes) if share >= lanes else shuffled[:share]
        made = make(work.theta1[index], work.theta2[index], work.duration, settings[few])
        jobs.update({key: (job, index) for key, job in made.items()})

    if work.name in (SINGLE, CHAOTIC):
        jobs |= our_singles(work, quick)
        add(
            "numba", peers.numba_kernels, (4e-3, 1e-3, 2.5e-4), lanes
        )  # the C kernels take eight at a time
        add("heyoka", peers.heyoka_singles, (1e-4, 1e-6, 1e-9, 1e-12, 1e-15), lanes)
        add("diffrax", peers.diffrax_vmapped, (1e-5, 1e-8, 1e-11), lanes)
        add("scipy", peers.scipy_one_by_one, (1e-5, 1e-8, 1e-11), lanes)
        return jobs
    pendulum = dpend.Pendulum()
    steps = {
        "rk4": (4e-3, 1e-3),
        "rk4-circle": (4e-3, 1e-3),
        "rk8": (1e-2, 5e-3),
        "rk8-circle": (1e-2, 5e-3),
        "gauss": (1e-2,),
    }
    schemes = {
        (name, step): dpend.Scheme(name, step) for name, each in steps.items() for step in each[few]
    }
    tolerances = (1e-3, 1e-6, 1e-8, 1e-10, 1e-11)[few]
    schemes |= {
        ("dpend, for a tolerance", each): dpend.scheme_for(pendulum, each) for each in tolerances
    }
    jobs |= our_lanes(work, schemes)
    add("C, ", peers.c_kernels, (4e-3, 1e-3), lanes)
    add("numba", peers.numba_kernels, (1e-3,), lanes)
    add(
        "heyoka",
        peers.heyoka_batches,
        (1e-6, 3e-7, 1e-7, 1e-9, 1e-10, 1e-11, 1e-12, 1e-13, 1e-15),
        lanes,
    )
    add("diffrax", peers.diffrax_vmapped, (1e-4, 1e-8, 1e-11), 2048)
    add("scipy", peers.scipy_one_by_one, (1e-6,), 64)
    return jobs


# --- measurements ---------------------------------------------------------------------------------


def timed(jobs: Jobs, repeats: int) -> dict:
    """First call, and median, least and most seconds of the calls after it, in turn so that all see
    the same machine.

    A short job is repeated within its turn until a quarter of a second has passed: a script that
    sweeps finds its threads awake and its memory mapped.
    """
    first, later = {}, {name: [] for name in jobs}
    for name, (job, _) in jobs.items():
        start = time.perf_counter()
        job()
        first[name] = time.perf_counter() - start
    for _ in range(repeats):
        for name, (job, _) in jobs.items():
            start, calls = time.perf_counter(), 0
            while calls == 0 or time.perf_counter() - start < 0.25:
                job()
                calls += 1
            later[name].append((time.perf_counter() - start) / calls)
    return {
        name: (np.median(times), min(times), max(times), first[name])
        for name, times in later.items()
    }


def extended_ends(work: Workload, index: np.ndarray) -> np.ndarray | None:
    """heyoka in long double, whose own error is a thousandth of any double's; None without it."""
    jobs = peers.heyoka_singles(
        work.theta1[index], work.theta2[index], work.duration, (1e-18,), np.longdouble
    )
    return next(iter(jobs.values()))() if jobs else None


def finest(work: Workload) -> np.ndarray:
    import dpend

    if work.name in (SINGLE, CHAOTIC):
        scheme = dpend.Scheme("rk8-circle", 1e-3)
    else:
        scheme = dpend.Scheme(
            "rk10-circle-rescaled", 0.13 / float(dpend.normal_modes(dpend.Pendulum())[1].frequency)
        )
    job, _ = our_lanes(work, {"finest": scheme})["finest"]
    return job()


def peak_memory(workload: str, method: str, quick: bool) -> float:
    """The peak resident memory [MB] of a process that runs one method on one workload; NaN where it
    cannot be read.
    """
    command = [
        sys.executable,
        __file__,
        "--memory",
        workload,
        method,
        *(["--quick"] if quick else []),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


def tell_memory(workload: str, method: str, quick: bool) -> None:
    work = next(one for one in workloads(quick) if one.name == workload)
    job = next(job for (name, _), (job, _) in jobs_of(work, True, method).items() if name == method)
    job()
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    peak = [int(line.split()[1]) for line in lines if line.startswith("VmHWM")]
    print(peak[0] * 1024 / 1e6 if peak else float("nan"))


def plain_jax(count: int) -> None:
    """Prints the rate of jit(vmap) of RK4 over jnp.sin with JAX's defaults: in a process that never
    imports dpend.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    import jax.numpy as jnp

    def slope(x):
        theta1, theta2, p1, p2 = x
        s, c = jnp.sin(theta1 - theta2), jnp.cos(theta1 - theta2)
        depth = 0.1 + 0.1 * s**2
        w1 = (p1 * 25.0 - p2 * c * 25.0) / depth
        w2 = (p2 * 50.0 - p1 * c * 25.0) / depth
        pull = 0.004 * w1 * w2 * s
        return jnp.array([w1, w2, -pull - 0.392 * jnp.sin(theta1), pull - 0.196 * jnp.sin(theta2)])

    def step(_, x, h=1e-3):
        k1 = slope(x)
        k2 = slope(x + h / 2 * k1)
        k3 = slope(x + h / 2 * k2)
        return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(x + h * k3))

    lanes = jnp.stack(
        [jnp.linspace(1.0, 2.6, count), jnp.full(count, 1.1), jnp.zeros(count), jnp.zeros(count)], 1
    )
    run = jax.jit(jax.vmap(lambda x: jax.lax.fori_loop(0, 1000, step, x)))
    ends = run(lanes).block_until_ready()
    seconds = []
    for _ in range(3):
        start = time.perf_counter()
        run(lanes).block_until_ready()
        seconds.append(time.perf_counter() - start)
    print(count / np.median(seconds), np.asarray(ends[:, :2]).sum())


def measured(quick: bool) -> list[Row]:
    rows = []
    for work in workloads(quick):
        print(f"\n{work.name}")
        jobs = jobs_of(work, quick)
        lanes = work.theta1.size
        drawn = np.random.default_rng(1).permutation(lanes)[:RANDOM_LANES]
        if work.name not in (SINGLE, CHAOTIC):  # the slow peers' lanes among them
            drawn = np.random.default_rng(0).permutation(lanes)[:RANDOM_LANES]
        exact, fine = extended_ends(work, drawn), finest(work)
        if exact is not None:
            print(
                f"  our finest run against long double: "
                f"{np.abs(fine[:, drawn] - exact).max(axis=0).max():.1e} rad"
            )
        times = timed(jobs, 1 if quick else 5)
        memory = {}
        for (method, setting), (job, index) in jobs.items():
            ends = np.array(job())
            if method not in memory:
                memory[method] = float("nan") if quick else peak_memory(work.name, method, quick)
            place = {lane: i for i, lane in enumerate(index.tolist())}
            both = [i for i, lane in enumerate(drawn.tolist()) if lane in place]
            mine = [place[drawn[i]] for i in both]
            errors = np.full(1, np.nan)
            if exact is not None:
                errors = np.abs(ends[:, mine] - exact[:, both]).max(axis=0).astype(float)
            all_errors = np.abs(ends - fine[:, index]).max(axis=0)
            median, least, most, first = times[method, setting]
            seconds = index.size * work.duration
            rows.append(
                Row(
                    work.name,
                    method,
                    setting,
                    index.size,
                    seconds / median,
                    seconds / most,
                    seconds / least,
                    first,
                    memory[method],
                    *np.quantile(errors, [0.5, 0.99, 1.0]),
                    *np.quantile(all_errors, [0.99, 1.0]),
                )
            )
            row = rows[-1]
            print(
                f"  {method:26s} {setting:8.1e}  error {row.error_99:8.1e} "
                f"({row.error_99_all_lanes:8.1e})  "
                f"{row.rate:10.4g} s/s  first call {row.first_call_s:6.2f} "
                f"s  {row.peak_memory_MB:6.0f} MB",
                flush=True,
            )
    environment = {key: value for key, value in os.environ.items() if key != "XLA_FLAGS"}
    command = [sys.executable, __file__, "--plain-jax", "64" if quick else "2048"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    like = next(row for row in rows if (row.workload, row.method) == (EASY, "rk4"))
    rate, unknown = float(done.stdout.split()[0]), float("nan")
    rows.append(
        Row(
            EASY,
            "jit(vmap) of RK4, jnp.sin",
            1e-3,
            2048,
            rate,
            unknown,
            unknown,
            unknown,
            unknown,
            like.error_median,
            *(unknown,) * 4,
        )
    )
    return rows


# --- energy over a long time ----------------------------------------------------------------------


def energies(quick: bool) -> list[tuple[str, float, float, float]]:
    """(method, step, time, largest energy error until then): the in-phase orbit of 40 degrees, at
    about equal cost; of `dpend.simulate` the tolerance stands for the step, and it costs a fifth.
    """
    import jax
    import jax.numpy as jnp

    import dpend

    pendulum = dpend.Pendulum()
    start = dpend.find_orbit(pendulum, np.radians(40.0), branch="in-phase").state
    level = dpend.hamiltonian(pendulum, start)
    swing = level - dpend.hamiltonian(pendulum, dpend.released(0.0, 0.0))

    def update(carry, time, dt, state):
        return jnp.maximum(carry[0], jnp.abs(dpend.hamiltonian(pendulum, state) - level)), state

    def follow(scheme, carry, duration):
        return dpend.fold(update, carry, pendulum, carry[1], duration, scheme)

    rows = []
    times = np.logspace(0, 1 if quick else 4, 5 if quick else 33)
    for name, step in (("rk4", 2e-3), ("rk8", 1e-2), ("rk8-circle", 1e-2), ("gauss", 1e-2)):
        onward = jax.jit(partial(follow, dpend.Scheme(name, step)))
        carry, now = (jnp.asarray(0.0), jax.tree.map(jnp.asarray, start)), 0.0
        for end in times:
            carry, now = onward(carry, end - now), end
            rows.append((name, step, float(end), float(carry[0] / swing)))
    saved = np.linspace(0.0, times[-1], 20_001)[1:]
    motion = dpend.simulate(pendulum, start, times=saved, tolerance=1e-6)
    drift = np.maximum.accumulate(abs(dpend.hamiltonian(pendulum, motion.state) - level) / swing)
    method, tolerance = "dpend.simulate", 1e-6
    rows += [(method, tolerance, float(end), float(np.interp(end, saved, drift))) for end in times]
    return rows


# --- the figure -----------------------------------------------------------------------------------

# Okabe and Ito's colours; ours are filled and solid, peers open and dashed.
LOOKS = {
    "dpend, for a tolerance": ("#D55E00", "o", "-"),
    "dpend.simulate": ("#D55E00", "o", "-"),
    "rk4": ("#56B4E9", "s", "-"),
    "rk4-circle": ("#0072B2", "s", "-"),
    "rk8": ("#E69F00", "D", "-"),
    "rk8-circle": ("#CC79A7", "D", "-"),
    "gauss": ("#009E73", "^", "-"),
    "heyoka, SIMD batch": ("#000000", "o", "--"),
    "heyoka, adaptive": ("#000000", "o", "--"),
    "diffrax, vmap of Dopri8": ("#666666", "v", "--"),
    "diffrax, Dopri8": ("#666666", "v", "--"),
    "scipy, DOP853": ("#999999", "P", "--"),
    "numba, RK4": ("#999999", "X", "--"),
    "C, RK4": ("#444444", "s", "--"),
    "C, RK4 without sines": ("#444444", "d", "--"),
}


def draw(rows: list[Row], energy: list[tuple[str, float, float, float]]) -> None:
    """Rates against errors for each workload, energies, and in the last cell the names of all."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(3, 2, figsize=(12, 13.5), layout="constrained")
    for axis, workload in zip(axes.flat, (SINGLE, CHAOTIC, EASY, HARD), strict=False):
        here = [row for row in rows if row.workload == workload]
        for method in LOOKS:
            points = sorted((row.error_99, row.rate) for row in here if row.method == method)
            if points:
                axis.plot(*zip(*points, strict=True), **look(method))
        axis.set(xscale="log", yscale="log", title=workload)
        axis.set_xlabel(
            "error of the larger angle, 99th percentile (rad): more exact $\\rightarrow$"
        )
        axis.set_ylabel("trajectory-seconds per second: faster $\\rightarrow$")
        axis.invert_xaxis()
        axis.grid(alpha=0.3)
    axis = axes.flat[4]
    steps = {method: step for method, step, _, _ in energy}
    for method in steps:
        mine = [row for row in energy if row[0] == method]
        drift = [max(row[3], 1e-17) for row in mine]
        axis.plot([row[2] for row in mine], drift, **look(method))
    told = ", ".join(
        f"{name} {step * 1e3:g} ms" for name, step in steps.items() if name != "dpend.simulate"
    )
    axis.set(xscale="log", yscale="log", title=f"in-phase orbit of 40 deg; {told}")
    axis.title.set_fontsize(10)
    axis.set(xlabel="time (s)", ylabel="largest energy error so far, of the swing's")
    axis.grid(alpha=0.3)
    names = axes.flat[5]
    names.set_axis_off()
    seen = {line.get_label(): line for each in axes.flat for line in each.get_lines()}
    lines = [seen[name] for name in LOOKS if name in seen]
    names.legend(handles=lines, loc="center", fontsize=11, title="filled: dpend; open: its peers")
    figure.savefig(HERE / "figures" / "speed_vs_error.png", dpi=80)


def look(method: str) -> dict:
    colour, marker, line = LOOKS[method]
    face = colour if line == "-" else "white"
    return {
        "color": colour, "marker": marker, "linestyle": line, "mfc": face, "label": method,
        "lw": 1.6, "ms": 6,
    }  # fmt: skip


# --- the table in README.md -----------------------------------------------------------------------

START, END = "<!-- written by experiments/speed_vs_error.py -->\n", "\n<!-- end -->"


def times(rows: list[Row], peer: str, row: Row) -> str:
    """A rate over a peer's at the same error, the peer's interpolated in logarithms; at errors
    below all of the peer's, that it is more than over its most exact.
    """
    points = sorted(
        (row.error_99, row.rate) for row in rows if row.method == peer and row.error_99 > 0
    )
    if len(points) < 2 or row.error_99 > 1.1 * points[-1][0]:
        return "-"
    errors, rates = np.log(np.array(points)).T
    ratio = row.rate / float(np.exp(np.interp(np.log(row.error_99), errors, rates)))
    return ("> " if row.error_99 < points[0][0] else "") + short(ratio)


def short(value: float) -> str:
    return f"{value:.2g}" if value < 10 else f"{value:.0f}"


def table(rows: list[Row]) -> str:
    """What README.md shows, from the rows of the CSV file alone."""
    lines = [
        "| workload | asked | error, 99 % | worst | rate (s/s) | times heyoka | times diffrax | "
        "first call |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for workload, method, heyoka, diffrax in (
        (HARD, "dpend, for a tolerance", "heyoka, SIMD batch", "diffrax, vmap of Dopri8"),
        (EASY, "dpend, for a tolerance", "heyoka, SIMD batch", "diffrax, vmap of Dopri8"),
        (SINGLE, "dpend.simulate", "heyoka, adaptive", "diffrax, Dopri8"),
        (CHAOTIC, "dpend.simulate", "heyoka, adaptive", "diffrax, Dopri8"),
    ):
        here = [row for row in rows if row.workload == workload]
        for row in (row for row in here if row.method == method):
            ratios = [times(here, peer, row) for peer in (heyoka, diffrax)]
            asked = f"{row.setting:g} rad"
            rate = f"{float(f'{row.rate:.3g}'):,.0f}".replace(",", " ")
            cells = [
                workload,
                asked,
                f"{row.error_99:.1e}",
                f"{row.error_worst:.1e}",
                rate,
                *ratios,
                f"{row.first_call_s:.1f} s",
            ]
            lines.append("| " + " | ".join(cells) + " |")
    easy = {(row.method, row.setting): row.rate for row in rows if row.workload == EASY}
    ours, sines = easy["rk4-circle", 1e-3], easy["rk4", 1e-3]
    others = {
        "an AVX-512 kernel in C of the same arithmetic": ours
        / easy.get(("C, RK4 without sines", 1e-3), np.nan),
        "one with sines": ours / easy.get(("C, RK4", 1e-3), np.nan),
        "numba": ours / easy.get(("numba, RK4", 1e-3), np.nan),
        "`jit(vmap)` over `jnp.sin`": ours / easy.get(("jit(vmap) of RK4, jnp.sin", 1e-3), np.nan),
    }
    ratios = ", ".join(
        f"{short(value)} times {name}" for name, value in others.items() if np.isfinite(value)
    )
    text = (
        f"At order 4 and 1 ms on the easy lanes `rk4-circle` takes {ours / 1e3:.0f} million "
        f"steps a second: {ratios}"
    )
    c_with = sines / easy.get(("C, RK4", 1e-3), np.nan)
    text += (
        f"; `rk4` {sines / 1e3:.0f} million, {short(c_with)} times the kernel with sines."
        if np.isfinite(c_with)
        else "."
    )
    return "\n".join([*lines, "", text])


def read_rows() -> list[Row]:
    with (HERE / "speed_vs_error.csv").open(newline="") as file:
        return [
            Row(*(kind.type(row[kind.name]) for kind in fields(Row)))
            for row in csv.DictReader(file)
        ]


def write_table() -> None:
    before, rest = README.read_text().split(START)
    README.write_text(before + START + table(read_rows()) + END + rest.split(END, 1)[1])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--memory", nargs=2, metavar=("WORKLOAD", "METHOD"))
    parser.add_argument("--plain-jax", type=int)
    options = parser.parse_args()
    if options.plain_jax:
        plain_jax(options.plain_jax)
        return
    if options.memory:
        tell_memory(*options.memory, options.quick)
        return
    if not options.table:
        rows, energy = measured(options.quick), energies(options.quick)
        if options.quick:
            return
        with (HERE / "speed_vs_error.csv").open("w", newline="") as file:
            out = csv.DictWriter(file, [kind.name for kind in fields(Row)], lineterminator="\n")
            out.writeheader()
            for row in rows:
                out.writerow(
                    {
                        key: f"{value:.6g}" if isinstance(value, float) else value
                        for key, value in asdict(row).items()
                    }
                )
        with (HERE / "energy_error.csv").open("w", newline="") as file:
            out_energy = csv.writer(file, lineterminator="\n")
            out_energy.writerow(
                ["method", "step_s_or_tolerance_rad", "time_s", "largest_energy_error_of_the_swing"]
            )
            out_energy.writerows(
                (name, step, f"{at:.6g}", f"{error:.3g}") for name, step, at, error in energy
            )
        draw(rows, energy)
    write_table()


if __name__ == "__main__":
    main()
