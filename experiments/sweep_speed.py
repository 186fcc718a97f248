"""Speed of many trajectories beside its error: this package's methods, and what people would use instead.

Everything in one run on the same lanes, warm, peers in turn, medians; errors are the 99th percentile over lanes of the
larger angle's, against order 8 in rescaled time at a step whose own error is 1e-11. Peers that are not installed, and
the C kernels without a compiler, are left out by name. `--quick` runs a few lanes for a test.
"""

import argparse
import csv
import ctypes
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

HERE = Path(__file__).parent


def plain_jax(count: int) -> None:
    """The rate of jit(vmap) of RK4 over jnp.sin with JAX's defaults, in a process that never imports dpend."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import jax.numpy as jnp
    import numpy as np

    def slope(x):
        theta1, theta2, p1, p2 = x
        s, c = jnp.sin(theta1 - theta2), jnp.cos(theta1 - theta2)
        m1 = m2 = 0.1
        l1 = l2 = 0.2
        depth = m1 + m2 * s**2
        w1 = (p1 / l1**2 - p2 * c / (l1 * l2)) / depth
        w2 = (p2 * (1 + m1 / m2) / l2**2 - p1 * c / (l1 * l2)) / depth
        pull = m2 * l1 * l2 * w1 * w2 * s
        return jnp.array(
            [w1, w2, -pull - (m1 + m2) * 9.8 * l1 * jnp.sin(theta1), pull - m2 * 9.8 * l2 * jnp.sin(theta2)]
        )

    def step(_, x, h=1e-3):
        k1 = slope(x)
        k2 = slope(x + h / 2 * k1)
        k3 = slope(x + h / 2 * k2)
        return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(x + h * k3))

    lanes = jnp.stack([jnp.linspace(1.0, 2.6, count), jnp.full(count, 1.1), jnp.zeros(count), jnp.zeros(count)], 1)
    run = jax.jit(jax.vmap(lambda x: jax.lax.fori_loop(0, 1000, step, x)))
    run(lanes).block_until_ready()
    seconds = []
    for _ in range(3):
        start = time.perf_counter()
        run(lanes).block_until_ready()
        seconds.append(time.perf_counter() - start)
    print(count * 1000 / np.median(seconds))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--plain-jax", type=int)
    options = parser.parse_args()
    if options.plain_jax:
        plain_jax(options.plain_jax)
        return
    rows = [*order_four(options.quick), *quantities(options.quick), *work_precision(options.quick)]
    if not options.quick:
        with (HERE / "sweep_speed.csv").open("w", newline="") as file:
            table = csv.writer(file)
            table.writerow(["workload", "what", "error_99_rad", "rate", "unit", "first_call_s"])
            table.writerows(rows)


def timed(jobs: dict, repeats: int) -> dict:
    """First call, and median seconds of the calls after it, taken in turn so that all see the same machine.

    A short job is repeated within its turn until a quarter of a second has passed: a script that sweeps finds its
    threads awake and its memory mapped.
    """
    first, later = {}, {name: [] for name in jobs}
    for name, job in jobs.items():
        start = time.perf_counter()
        job()
        first[name] = time.perf_counter() - start
    for _ in range(repeats):
        for name, job in jobs.items():
            start, calls = time.perf_counter(), 0
            while calls == 0 or time.perf_counter() - start < 0.25:
                job()
                calls += 1
            later[name].append((time.perf_counter() - start) / calls)
    return {name: (sorted(times)[len(times) // 2], first[name]) for name, times in later.items()}


def report(workload: str, rate_unit: str, rows: list) -> list:
    print(f"\n{workload}")
    for what, error, rate, first in rows:
        print(f"  {what:34s} error {error:8.1e}   {rate:10.4g} {rate_unit}   first call {first:5.1f} s")
    return [
        [workload, what, f"{error:.3g}", f"{rate:.6g}", rate_unit, f"{first:.3g}"] for what, error, rate, first in rows
    ]


def end(pendulum, state, scheme, *, duration):
    import dpend

    last = dpend.flow(pendulum, state, duration, scheme)
    return {"theta1": last.theta1, "theta2": last.theta2}


@dataclass(frozen=True)
class At:
    """A quantity at a scheme, as lanes take it: a value, so that equal ones share compiled code."""

    quantity: Callable
    scheme: object
    duration: float

    def __call__(self, pendulum, state):
        return self.quantity(pendulum, state, self.scheme, duration=self.duration)


def c_kernel(name: str, fields: int, theta1, theta2):
    """A job that runs the C kernel over copies of the lanes, or None where it cannot be compiled."""
    import numpy as np

    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None or not Path("/proc/cpuinfo").exists() or "avx512f" not in Path("/proc/cpuinfo").read_text():
        print(f"no C kernel {name}: no compiler, or no AVX-512")
        return None
    library = Path(tempfile.mkdtemp()) / f"{name}.so"
    flags = (
        "-O3 -march=native -ffp-contract=fast -fno-math-errno -mprefer-vector-width=512 -fopenmp -shared -fPIC".split()
    )
    subprocess.run([compiler, *flags, str(HERE / "peers" / f"{name}.c"), "-o", str(library)], check=True)
    run = ctypes.CDLL(str(library)).run
    m1 = m2 = 0.1
    l1 = l2 = 0.2
    g = 9.8
    inertia = m2 * l2 * l2 * l1 * l1
    constants = np.array(
        [(m1 + m2) * l1 * l1, m2 * l2 * l2, m2 * l1 * l2, (m1 + m2) * g * l1, m2 * g * l2, inertia * m1, inertia * m2]
    )
    zero = np.zeros_like(theta1)
    circle = [np.sin(theta1), np.cos(theta1), np.sin(theta2), np.cos(theta2)] if fields == 8 else []
    start = np.stack([theta1, theta2, *circle, zero, zero])
    raw = np.empty(start.size + 8)
    data = raw[(-raw.ctypes.data // 8) % 8 :][: start.size].reshape(start.shape)
    pointers = constants.ctypes.data_as(ctypes.c_void_p), data.ctypes.data_as(ctypes.c_void_p)

    def job():
        data[:] = start
        run(*pointers, ctypes.c_long(theta1.size), ctypes.c_long(1000), ctypes.c_double(1e-3))
        return data

    return job


def numba_kernel(theta1, theta2):
    try:
        import numba
    except ImportError:
        print("no numba: not installed")
        return None
    import math

    import numpy as np

    @numba.njit(fastmath=True, inline="always")
    def slope(t1, t2, p1, p2):
        s, c = math.sin(t1 - t2), math.cos(t1 - t2)
        inverse = 1.0 / (0.1 + 0.1 * s * s)
        w1 = (p1 * 25.0 - p2 * c * 25.0) * inverse
        w2 = (p2 * 50.0 - p1 * c * 25.0) * inverse
        pull = 0.004 * w1 * w2 * s
        return w1, w2, -pull - 0.392 * math.sin(t1), pull - 0.196 * math.sin(t2)

    @numba.njit(fastmath=True, parallel=True)
    def run(theta1, theta2, out, steps, h):
        for i in numba.prange(theta1.size):
            a, b, p, q = theta1[i], theta2[i], 0.0, 0.0
            for _ in range(steps):
                a1, b1, p1, q1 = slope(a, b, p, q)
                a2, b2, p2, q2 = slope(a + h / 2 * a1, b + h / 2 * b1, p + h / 2 * p1, q + h / 2 * q1)
                a3, b3, p3, q3 = slope(a + h / 2 * a2, b + h / 2 * b2, p + h / 2 * p2, q + h / 2 * q2)
                a4, b4, p4, q4 = slope(a + h * a3, b + h * b3, p + h * p3, q + h * q3)
                a += h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
                b += h / 6 * (b1 + 2 * b2 + 2 * b3 + b4)
                p += h / 6 * (p1 + 2 * p2 + 2 * p3 + p4)
                q += h / 6 * (q1 + 2 * q2 + 2 * q3 + q4)
            out[0, i], out[1, i] = a, b

    out = np.empty((2, theta1.size))

    def job():
        run(theta1, theta2, out, 1000, 1e-3)
        return out

    return job


def easy(count: int):
    import numpy as np

    return np.random.default_rng(0).uniform(1.0, 2.6, count), np.full(count, 1.1)


def order_four(quick: bool) -> list:
    """End states after 1000 steps of 1 ms, order 4: rates in steps per second."""
    import numpy as np

    import dpend
    from dpend.lanes import over_lanes

    count = 2048 if quick else 65536
    theta1, theta2 = easy(count)
    state, pendulum = dpend.released(theta1, theta2), dpend.Pendulum()

    def ours(name):
        function = At(end, dpend.Scheme(name, 1e-3), 1.0)
        return lambda: np.stack(list(over_lanes(function, pendulum, state).values()))

    jobs = {
        "rk4-circle": ours("rk4-circle"),
        "rk4": ours("rk4"),
        "C without trigonometry": c_kernel("circle", 8, theta1, theta2),
        "C with polynomial sincos": c_kernel("plain", 4, theta1, theta2),
        "numba, parallel, fastmath": numba_kernel(theta1, theta2),
    }
    jobs = {name: job for name, job in jobs.items() if job is not None}
    times = timed(jobs, 1 if quick else 7)
    truth = over_lanes(At(end, dpend.Scheme("rk8-circle-rescaled", 5e-3), 1.0), pendulum, state)
    truth = np.stack(list(truth.values()))
    rows = []
    for name, (seconds, first) in times.items():
        error = np.quantile(np.abs(np.asarray(jobs[name]())[:2] - truth).max(axis=0), 0.99)
        rows.append((name, error, count * 1000 / seconds, first))
    environment = {key: value for key, value in os.environ.items() if key != "XLA_FLAGS"}
    command = [sys.executable, __file__, "--plain-jax", str(count // 16)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    rows.append(("jit(vmap) of RK4, jnp.sin, defaults", rows[1][1], float(done.stdout), 0.0))
    out = report(f"order 4, {count} lanes, 1 ms", "steps/s", rows)
    rate = {what: rate for what, _, rate, _ in rows}
    for what in rate:
        print(
            f"    rk4-circle is {rate['rk4-circle'] / rate[what]:.2f}, rk4 {rate['rk4'] / rate[what]:.2f} times {what}"
        )
    return out


def quantities(quick: bool) -> list:
    """What a quantity costs over the plain end state of the same scheme: rates in trajectory-seconds per second."""
    import dpend
    from dpend.lanes import over_lanes

    count, duration = (1024, 0.5) if quick else (32768, 10.0)
    theta1, theta2 = easy(count)
    state, pendulum = dpend.released(theta1, theta2), dpend.Pendulum()
    rows = []
    schemes = [("rk4-circle", 1e-3)] if quick else [("rk4", 1e-3), ("rk4-circle", 1e-3), ("rk8-circle", 5e-3)]
    for scheme in [*(dpend.Scheme(*each) for each in schemes), dpend.scheme_for(pendulum, 1e-6)]:
        jobs = {
            name: partial(over_lanes, At(quantity, scheme, duration), pendulum, state)
            for name, quantity in (("end", end), ("lyapunov", dpend.chaos.lyapunov), ("flip", dpend.chaos.flip))
        }
        times = timed(jobs, 1 if quick else 3)
        for name, (seconds, first) in times.items():
            share = times["end"][0] / seconds
            rows.append(
                (f"{scheme.name}: {name}, {share:.2f} of plain", float("nan"), count * duration / seconds, first)
            )
    return report(f"quantities, {count} lanes, {duration:g} s", "s/s", rows)


def work_precision(quick: bool) -> list:
    """Rate against error on the hard grid and on easy lanes: trajectory-seconds per second."""
    import numpy as np

    import dpend
    from dpend.lanes import over_lanes

    side = 16 if quick else 64
    angles = -np.pi + (np.arange(side) + 0.5) * 2 * np.pi / side
    square = tuple(mesh.ravel() for mesh in np.meshgrid(angles, angles, indexing="ij"))
    pendulum, out = dpend.Pendulum(), []
    for workload, (theta1, theta2), duration in (
        (f"hard grid, {side} x {side}, 2 s", square, 2.0),
        ("easy lanes, 1 s", easy(256 if quick else 16384), 1.0),
    ):
        # In the order in which a sweep gives cells to lanes: by energy.
        order = np.argsort(-2 * np.cos(theta1) - np.cos(theta2), kind="stable")
        theta1, theta2 = theta1[order], theta2[order]
        state = dpend.released(theta1, theta2)

        def ours(scheme, state=state, duration=duration):
            function = At(end, scheme, duration)
            return lambda: np.stack(list(over_lanes(function, pendulum, state).values()))

        tolerances = (1e-6,) if quick else (1e-3, 1e-6, 1e-8, 1e-10, 1e-11)
        jobs = {f"dpend, tolerance {each:g}": ours(dpend.scheme_for(pendulum, each)) for each in tolerances}
        jobs |= heyoka_jobs(
            theta1, theta2, duration, (1e-9,) if quick else (1e-6, 3e-7, 1e-7, 1e-9, 1e-10, 1e-11, 1e-12, 1e-13, 1e-15)
        )
        jobs |= diffrax_jobs(theta1, theta2, duration, (1e-6,) if quick else (1e-4, 1e-8, 1e-11))
        times = timed(jobs, 1 if quick else 5)
        truth = ours(dpend.Scheme("rk8-circle-rescaled", 4.5e-3))()
        rows = []
        for name, (seconds, first) in times.items():
            found = np.asarray(jobs[name]())
            chosen = truth[:, :: theta1.size // found.shape[1]]  # the slowest peer runs every n-th lane
            error = np.quantile(np.abs(found - chosen).max(axis=0), 0.99)
            rows.append((name, error, found.shape[1] * duration / seconds, first))
        out += report(workload, "s/s", rows)
        compare(rows)
    return out


def compare(rows: list) -> None:
    """Our rate over heyoka's and diffrax's at our own error, theirs interpolated in logarithms."""
    import numpy as np

    for peer in ("heyoka", "diffrax"):
        theirs = sorted((error, rate) for what, error, rate, _ in rows if what.startswith(peer) and error > 0)
        for what, error, rate, _ in rows:
            if what.startswith("dpend") and len(theirs) > 1:
                errors, rates = np.log(np.array(theirs)).T
                ratio = rate / np.exp(np.interp(np.log(error), errors, rates))
                print(f"    {what}: {ratio:.2f} times {peer} at {error:.1e}")


def heyoka_jobs(theta1, theta2, duration: float, tolerances: tuple) -> dict:
    """Batches of the machine's SIMD width, shared out over as many threads as there are cores."""
    try:
        import heyoka
    except ImportError:
        print("no heyoka: not installed")
        return {}
    from concurrent.futures import ThreadPoolExecutor

    import numpy as np

    t1, t2, p1, p2 = heyoka.make_vars("t1", "t2", "p1", "p2")
    s, c = heyoka.sin(t1 - t2), heyoka.cos(t1 - t2)
    inverse = 1.0 / (0.1 + 0.1 * s**2)
    w1, w2 = (25.0 * p1 - 25.0 * p2 * c) * inverse, (50.0 * p2 - 25.0 * p1 * c) * inverse
    pull = 0.004 * w1 * w2 * s
    system = [(t1, w1), (t2, w2), (p1, -pull - 0.392 * heyoka.sin(t1)), (p2, pull - 0.196 * heyoka.sin(t2))]
    width, threads = heyoka.recommended_simd_size(), len(os.sched_getaffinity(0))
    jobs = {}
    for tolerance in tolerances:
        workers = [heyoka.taylor_adaptive_batch(system, np.zeros((4, width)), tol=tolerance) for _ in range(threads)]
        out = np.empty((2, theta1.size))

        def share(index, workers=workers, out=out):
            integrator = workers[index]
            for i in range(index * width, theta1.size, width * threads):
                integrator.set_time(0.0)
                integrator.state[:] = 0.0
                integrator.state[0], integrator.state[1] = theta1[i : i + width], theta2[i : i + width]
                integrator.propagate_until(duration)
                out[:, i : i + width] = integrator.state[:2]

        def job(share=share, out=out):
            with ThreadPoolExecutor(threads) as pool:
                list(pool.map(share, range(threads)))
            return out

        jobs[f"heyoka batch, tolerance {tolerance:g}"] = job
    return jobs


def diffrax_jobs(theta1, theta2, duration: float, tolerances: tuple) -> dict:
    """jit(vmap(Dopri8)) on our own vector field, vectorising sines included."""
    import diffrax
    import jax
    import jax.numpy as jnp
    import numpy as np

    import dpend

    pendulum = dpend.Pendulum()
    every = max(1, theta1.size // 2048)
    theta1, theta2 = jnp.asarray(theta1[::every]), jnp.asarray(theta2[::every])

    def job(tolerance):
        def one(theta1, theta2):
            solution = diffrax.diffeqsolve(
                diffrax.ODETerm(lambda t, x, args: dpend.vector_field(pendulum, x)),
                diffrax.Dopri8(), 0.0, duration, None, dpend.released(theta1, theta2),
                stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance * 1e-2), max_steps=100_000,
            )  # fmt: skip
            return solution.ys.theta1[0], solution.ys.theta2[0]

        run = jax.jit(jax.vmap(one))
        return lambda: np.stack(run(theta1, theta2))

    return {f"diffrax vmap, tolerance {each:g}": job(each) for each in tolerances}


if __name__ == "__main__":
    main()
