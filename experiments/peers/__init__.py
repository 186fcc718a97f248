"""What people would integrate many or single double pendulums with instead, as jobs to be timed and
held to the truth.

Each function takes releases theta1 and theta2 [rad] of the paper's pendulum and a duration [s], and
gives jobs by name: functions of nothing that return the angles at the end, shape (2, n). A peer
that is not installed, or not for this machine, is left out and named.
"""

import ctypes
import math
import os
import shutil
import subprocess
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
L1 = L2 = 0.2
M1 = M2 = 0.1
G = 9.8


def missing(name: str, why: str = "not installed") -> dict:
    print(f"  without {name}: {why}")
    return {}


# --- C --------------------------------------------------------------------------------------------


def c_kernels(theta1, theta2, duration: float, steps: tuple) -> dict:
    """RK4 in C with AVX-512 and OpenMP, with sines and without; lanes filled up to a multiple of
    32.
    """
    compiler = shutil.which("cc") or shutil.which("gcc")
    if (
        compiler is None
        or not Path("/proc/cpuinfo").exists()
        or "avx512f" not in Path("/proc/cpuinfo").read_text()
    ):
        return missing("C kernels", "no compiler, or no AVX-512")
    folder, jobs = Path(tempfile.mkdtemp()), {}
    for name, what in (("plain", "C, RK4"), ("circle", "C, RK4 without sines")):
        library = folder / f"{name}.so"
        flags = (
            "-O3 -march=native -ffp-contract=fast -fno-math-errno -mprefer-vector-width=512 "
            "-fopenmp".split()
        )
        subprocess.run(
            [compiler, *flags, "-shared", "-fPIC", HERE / f"{name}.c", "-o", library], check=True
        )
        run = ctypes.CDLL(str(library)).run
        for step in steps:
            jobs[what, step] = c_job(
                run, name == "circle", theta1, theta2, round(duration / step), step
            )
    return jobs


def c_job(run, circle: bool, theta1, theta2, count: int, step: float):
    inertia = M2 * L2 * L2 * L1 * L1
    constants = np.array(
        [
            (M1 + M2) * L1 * L1,
            M2 * L2 * L2,
            M2 * L1 * L2,
            (M1 + M2) * G * L1,
            M2 * G * L2,
            inertia * M1,
            inertia * M2,
        ]
    )
    kept = theta1.size
    lanes = -(-kept // 32) * 32
    theta1, theta2 = (
        np.concatenate([x, np.repeat(x[-1:], lanes - kept)]) for x in (theta1, theta2)
    )
    zero = np.zeros(lanes)
    trigonometry = (
        [np.sin(theta1), np.cos(theta1), np.sin(theta2), np.cos(theta2)] if circle else []
    )
    start = np.stack([theta1, theta2, *trigonometry, zero, zero])
    raw = np.empty(start.size + 8)
    data = raw[(-raw.ctypes.data // 8) % 8 :][: start.size].reshape(start.shape)
    pointers = constants.ctypes.data_as(ctypes.c_void_p), data.ctypes.data_as(ctypes.c_void_p)

    def job():
        data[:] = start
        run(*pointers, ctypes.c_long(lanes), ctypes.c_long(count), ctypes.c_double(step))
        return data[:2, :kept]

    return job


# --- numba ----------------------------------------------------------------------------------------


def numba_kernels(theta1, theta2, duration: float, steps: tuple) -> dict:
    """RK4, many lanes shared out over threads."""
    try:
        import numba
    except ImportError:
        return missing("numba")

    @numba.njit(fastmath=True, inline="always")
    def slope(t1, t2, p1, p2):
        s, c = math.sin(t1 - t2), math.cos(t1 - t2)
        inverse = 1.0 / (0.1 + 0.1 * s * s)
        w1 = (p1 * 25.0 - p2 * c * 25.0) * inverse
        w2 = (p2 * 50.0 - p1 * c * 25.0) * inverse
        pull = 0.004 * w1 * w2 * s
        return w1, w2, -pull - 0.392 * math.sin(t1), pull - 0.196 * math.sin(t2)

    @numba.njit(fastmath=True, parallel=theta1.size > 16)
    def run(theta1, theta2, out, steps, h):
        for i in numba.prange(theta1.size):
            a, b, p, q = theta1[i], theta2[i], 0.0, 0.0
            for _ in range(steps):
                a1, b1, p1, q1 = slope(a, b, p, q)
                a2, b2, p2, q2 = slope(
                    a + h / 2 * a1, b + h / 2 * b1, p + h / 2 * p1, q + h / 2 * q1
                )
                a3, b3, p3, q3 = slope(
                    a + h / 2 * a2, b + h / 2 * b2, p + h / 2 * p2, q + h / 2 * q2
                )
                a4, b4, p4, q4 = slope(a + h * a3, b + h * b3, p + h * p3, q + h * q3)
                a += h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
                b += h / 6 * (b1 + 2 * b2 + 2 * b3 + b4)
                p += h / 6 * (p1 + 2 * p2 + 2 * p3 + p4)
                q += h / 6 * (q1 + 2 * q2 + 2 * q3 + q4)
            out[0, i], out[1, i] = a, b

    def job(step):
        out = np.empty((2, theta1.size))

        def once():
            run(theta1, theta2, out, round(duration / step), step)
            return out

        return once

    return {("numba, RK4", step): job(step) for step in steps}


# --- heyoka ---------------------------------------------------------------------------------------


def heyoka_system(kind=float):
    import heyoka

    t1, t2, p1, p2 = heyoka.make_vars("t1", "t2", "p1", "p2")
    l1, l2, m1, m2, g = (kind(value) for value in (L1, L2, M1, M2, G))

    def number(value):
        return heyoka.expression(value)

    s, c = heyoka.sin(t1 - t2), heyoka.cos(t1 - t2)
    inverse = number(kind(1)) / (number(m1) + number(m2) * s**2)
    w1 = (number(1 / (l1 * l1)) * p1 - number(1 / (l1 * l2)) * p2 * c) * inverse
    w2 = (number((m1 + m2) / (m2 * l2 * l2)) * p2 - number(1 / (l1 * l2)) * p1 * c) * inverse
    pull = number(m2 * l1 * l2) * w1 * w2 * s
    return [
        (t1, w1),
        (t2, w2),
        (p1, -pull - number((m1 + m2) * g * l1) * heyoka.sin(t1)),
        (p2, pull - number(m2 * g * l2) * heyoka.sin(t2)),
    ]


def heyoka_batches(theta1, theta2, duration: float, tolerances: tuple) -> dict:
    """Batches of the machine's SIMD width, shared out over as many threads as there are cores."""
    try:
        import heyoka
    except ImportError:
        return missing("heyoka")
    width, threads = heyoka.recommended_simd_size(), len(os.sched_getaffinity(0))
    kept = theta1.size
    lanes = -(-kept // width) * width
    theta1, theta2 = (
        np.concatenate([x, np.repeat(x[-1:], lanes - kept)]) for x in (theta1, theta2)
    )

    def job(tolerance):
        workers = []  # made by the first call, as that compiles
        out = np.empty((2, lanes))

        def share(index):
            integrator = workers[index]
            for i in range(index * width, lanes, width * threads):
                integrator.set_time(0.0)
                integrator.state[:] = 0.0
                integrator.state[0], integrator.state[1] = (
                    theta1[i : i + width],
                    theta2[i : i + width],
                )
                integrator.propagate_until(duration)
                out[:, i : i + width] = integrator.state[:2]

        def once():
            while len(workers) < threads:
                workers.append(
                    heyoka.taylor_adaptive_batch(
                        heyoka_system(), np.zeros((4, width)), tol=tolerance
                    )
                )
            with ThreadPoolExecutor(threads) as pool:
                list(pool.map(share, range(threads)))
            return out[:, :kept]

        return once

    return {("heyoka, SIMD batch", tolerance): job(tolerance) for tolerance in tolerances}


def heyoka_singles(theta1, theta2, duration: float, tolerances: tuple, kind=float) -> dict:
    """One adaptive Taylor integration after the other; with `kind` np.longdouble in extended
    precision.
    """
    try:
        import heyoka
    except ImportError:
        return missing("heyoka")

    def job(tolerance):
        made = []
        out = np.empty((2, theta1.size), kind)

        def once():
            if not made:
                made.append(
                    heyoka.taylor_adaptive(
                        heyoka_system(kind), [kind(0)] * 4, fp_type=kind, tol=kind(tolerance)
                    )
                )
            integrator = made[0]
            for i in range(theta1.size):
                integrator.time = kind(0)
                integrator.state[:] = np.array([theta1[i], theta2[i], 0, 0], kind)
                integrator.propagate_until(kind(duration))
                out[:, i] = integrator.state[:2]
            return out

        return once

    return {("heyoka, adaptive", tolerance): job(tolerance) for tolerance in tolerances}


# --- diffrax and SciPy ----------------------------------------------------------------------------


def diffrax_vmapped(theta1, theta2, duration: float, tolerances: tuple) -> dict:
    """jit(vmap(Dopri8)) on dpend's own vector field, vectorising sines included."""
    import diffrax
    import jax
    import jax.numpy as jnp

    import dpend

    pendulum = dpend.Pendulum()
    lanes = jnp.asarray(theta1), jnp.asarray(theta2)

    def job(tolerance):
        def one(theta1, theta2):
            solution = diffrax.diffeqsolve(
                diffrax.ODETerm(lambda t, x, args: dpend.vector_field(pendulum, x)),
                diffrax.Dopri8(),
                0.0,
                duration,
                None,
                dpend.released(theta1, theta2),
                stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance * 1e-2),
                max_steps=100_000,
            )
            return solution.ys.theta1[0], solution.ys.theta2[0]

        if theta1.size > 16:
            run = jax.jit(jax.vmap(one))
            return lambda: np.stack(run(*lanes))
        run = jax.jit(one)
        return lambda: np.array([run(*pair) for pair in zip(*lanes, strict=True)]).T

    name = "diffrax, vmap of Dopri8" if theta1.size > 16 else "diffrax, Dopri8"
    return {(name, tolerance): job(tolerance) for tolerance in tolerances}


def scipy_one_by_one(theta1, theta2, duration: float, tolerances: tuple) -> dict:
    """solve_ivp with DOP853, the slope in Python."""
    try:
        from scipy.integrate import solve_ivp
    except ImportError:
        return missing("scipy")

    def slope(t, x):
        t1, t2, p1, p2 = x
        s, c = math.sin(t1 - t2), math.cos(t1 - t2)
        inverse = 1.0 / (0.1 + 0.1 * s * s)
        w1, w2 = (25.0 * p1 - 25.0 * p2 * c) * inverse, (50.0 * p2 - 25.0 * p1 * c) * inverse
        pull = 0.004 * w1 * w2 * s
        return w1, w2, -pull - 0.392 * math.sin(t1), pull - 0.196 * math.sin(t2)

    def job(tolerance):
        def once():
            ends = [
                solve_ivp(
                    slope,
                    (0, duration),
                    (a, b, 0.0, 0.0),
                    "DOP853",
                    rtol=tolerance,
                    atol=tolerance * 1e-2,
                ).y
                for a, b in zip(theta1, theta2, strict=True)
            ]
            return np.array([end[:2, -1] for end in ends]).T

        return once

    return {("scipy, DOP853", tolerance): job(tolerance) for tolerance in tolerances}
