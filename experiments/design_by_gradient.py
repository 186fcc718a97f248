"""Pendulums designed by gradient: a family whose modes are two to one at every release angle, and
what gradients cost.

For each release angle the lengths and masses nearest to the paper's are sought with which the
in-phase orbit takes exactly twice as long as the anti-phase orbit. Every pendulum is then simulated
by diffrax alone, in angles and angular velocities (Lagrange's equations, nothing of dpend in it),
over both periods. Below, the memory that reverse mode takes through `dpend.flow` against the number
of steps, with its checkpoints and without, and how long the gradient of the chaotic release (170,
180) deg means anything: the error that `gradient_horizon` tells beside what the tangents of another
method at a fifth of the step differ by.
"""

import argparse
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from extended import accelerations
from jax import lax

import dpend
from dpend import plots

HERE = Path(__file__).parent
BRANCHES = ("in-phase", "anti-phase")
GREEN, PURPLE = "#009E73", "#CC79A7"
CHAOTIC = np.radians((170.0, 180.0))


def two_to_one(slow: dpend.PeriodicOrbit, fast: dpend.PeriodicOrbit) -> jax.Array:
    return slow.period / fast.period - 2.0


def designs(start: dpend.Pendulum, angles: np.ndarray) -> list[dpend.Design]:
    """One a release angle, each from the paper's pendulum."""
    free = ("l1", "l2", "m1", "m2")
    found = [
        dpend.design_pendulum(two_to_one, start, free, branch=BRANCHES, theta1=np.radians(angle))
        for angle in angles
    ]
    for angle, one in zip(angles, found, strict=True):
        if one.status != dpend.Status.CONVERGED:
            raise RuntimeError(f"no design at {angle:g} deg: {one.message}")
    return found


# --- the check: diffrax and Lagrange's equations --------------------------------------------------


@jax.jit
def missed(parameters: jax.Array, angles: jax.Array, period: jax.Array) -> jax.Array:
    """By how much a release is not back at rest after the period [rad, and rad per radian of the
    fast mode].
    """
    import diffrax

    start = jnp.concatenate([angles, jnp.zeros(2)])
    end = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, x, pendulum: accelerations(pendulum, x, jnp)),
        diffrax.Dopri8(),
        t0=0.0,
        t1=period,
        dt0=None,
        y0=start,
        args=parameters,
        stepsize_controller=diffrax.PIDController(rtol=1e-13, atol=1e-13),
        max_steps=100_000,
    ).ys[-1]
    return jnp.max(jnp.abs(end - start) * jnp.array([1.0, 1.0, period / 6.28, period / 6.28]))


def checked(design: dpend.Design) -> list[float]:
    """What diffrax misses of both orbits."""
    parameters = jnp.stack(jax.tree.leaves(design.pendulum))
    return [
        float(missed(parameters, jnp.stack([orbit.theta1, orbit.theta2]), orbit.period))
        for orbit in design.orbits
    ]


# --- what reverse mode costs ----------------------------------------------------------------------


def memory(counts: list[int], step: float = 1e-3) -> tuple[list[int], list[int]]:
    """Bytes that the compiled gradient of a motion of so many steps needs, by `flow` and by a scan
    that keeps all.
    """
    pendulum, scheme = dpend.Pendulum(), dpend.Scheme("rk8", step)
    start = jax.tree.map(jnp.asarray, dpend.released(0.3, 0.4))

    def kept(state: dpend.State, count: int) -> jax.Array:
        constants = scheme.constants(pendulum, step)
        first = scheme.enter(pendulum, state)
        end, _ = lax.scan(
            lambda point, _: (scheme.move(constants, point), None), first, None, length=count
        )
        return scheme.leave(constants, end).theta1

    def flown(state: dpend.State, count: int) -> jax.Array:
        return dpend.flow(pendulum, state, count * step, scheme).theta1

    def bytes_of(function, count: int) -> int:  # type: ignore[no-untyped-def]
        compiled = jax.jit(jax.grad(partial(function, count=count))).lower(start).compile()
        return int(compiled.memory_analysis().temp_size_in_bytes)

    return [bytes_of(flown, n) for n in counts], [bytes_of(kept, n) for n in counts]


def parted(times: np.ndarray, step: float) -> list[float]:
    """How much tangents of the chaotic motion differ, relatively, from those of another method at a
    fifth the step.
    """
    pendulum, state = dpend.Pendulum(), dpend.released(*CHAOTIC)
    basis = dpend.State(*jnp.eye(4)[:, :2])

    def angles(time: float, scheme: dpend.Scheme) -> np.ndarray:
        _, ends = dpend.fold(seen, 0.0, pendulum, state, time, scheme, tangents=basis)
        return np.stack([ends.theta1, ends.theta2])

    def one(time: float) -> float:
        rough, fine = (
            angles(time, dpend.Scheme(name, h, False))
            for name, h in (("rk8", step), ("rk8-circle", step / 5))
        )
        return float(np.linalg.norm(rough - fine) / np.linalg.norm(fine))

    return [one(float(time)) for time in times]


def seen(carry, time, dt, state, tangents):  # type: ignore[no-untyped-def]
    return carry, tangents


# --- the figure -----------------------------------------------------------------------------------


def draw_family(ax, misses_ax, angles, found, misses) -> None:  # type: ignore[no-untyped-def]
    pendulums = [one.pendulum for one in found]
    for label, values, colour in (
        ("l2/l1", [p.l2 / p.l1 for p in pendulums], plots.UPPER),
        ("m2/m1", [p.m2 / p.m1 for p in pendulums], plots.LOWER),
    ):
        ax.plot(angles, values, "o-", color=colour, markersize=4, label=label)
    ax.plot(
        0,
        9 / 16,
        "s",
        color="black",
        markersize=6,
        label="small swings: m2/m1 = 9/16, l2/l1 = 1",
        zorder=5,
    )
    ax.plot(0, 1, "s", color="black", markersize=6, zorder=5)
    ax.set(
        xlabel="release angle theta1 (deg)",
        ylabel="ratio",
        title="In-phase period = 2 anti-phase periods",
    )
    ax.legend(frameon=False, fontsize="small")
    for branch, row, colour, mark in zip(
        BRANCHES, np.transpose(misses), (GREEN, PURPLE), "o^", strict=True
    ):
        misses_ax.semilogy(angles, row, mark + "-", color=colour, markersize=4, label=branch)
    misses_ax.set(
        xlabel="release angle theta1 (deg)", ylabel="missed after one period "
                                                    "(rad)", ylim=(1e-16, 1e-10),
        title="diffrax on Lagrange's equations",
    )  # fmt: skip
    misses_ax.legend(frameon=False, fontsize="small")


def draw_memory(ax, counts, flown, kept) -> None:  # type: ignore[no-untyped-def]
    ax.loglog(
        counts,
        np.array(kept) / 1e6,
        "^--",
        color=plots.LOWER,
        markersize=5,
        label="every step kept",
    )
    ax.loglog(
        counts,
        np.array(flown) / 1e6,
        "o-",
        color=plots.UPPER,
        markersize=5,
        label="dpend.flow, checkpoints",
    )
    ax.axvline(1024, color=plots.NEUTRAL, linewidth=0.8, linestyle=":")
    ax.annotate("checkpoints from\n1024 steps on", (1150, 300), fontsize=8)
    ax.set(xlabel="steps (order 8)", ylabel="memory of jax.grad (MB)", title="Reverse mode")
    ax.legend(frameon=False, fontsize="small", loc="center right")


def draw_horizon(ax, horizon, times, apart) -> None:  # type: ignore[no-untyped-def]
    ax.semilogy(horizon.time, horizon.growth, color=plots.LOWER, label="growth of tangents")
    ax.semilogy(
        horizon.time, horizon.error, color=plots.UPPER, label="error of the gradient, as told"
    )
    ax.semilogy(
        times, apart, "o", color="black", markersize=4, label="... as another integrator differs"
    )
    ax.axvline(horizon.horizon, color=plots.NEUTRAL, linewidth=0.8, linestyle=":")
    ax.annotate(
        f"1e-3 at {float(horizon.horizon):.2f} s",
        (float(horizon.horizon), 1e-15),
        fontsize=8,
        ha="right",
    )
    ax.set(
        xlabel="time (s)", ylabel="relative", ylim=(1e-16, 1e17), title="Gradients of the release "
                                                                        "(170, 180) deg"
    )  # fmt: skip
    ax.legend(frameon=False, fontsize="small", loc="upper left")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--quick", action="store_true", help="fewer release angles, motions and step counts"
    )
    parser.add_argument("--figure", type=Path, default=HERE / "figures" / "design_by_gradient.png")
    options = parser.parse_args()
    import matplotlib.pyplot as plt

    angles = np.array(
        [2, 30, 60, 90.0] if options.quick else [2, 5, *range(10, 121, 5)], np.float64
    )
    found = designs(dpend.Pendulum(), angles)
    misses = [checked(one) for one in found]
    for angle, one, row in zip(angles, found, misses, strict=True):
        p, (slow, fast) = one.pendulum, one.orbits
        print(
            f"{angle:5.0f} deg: l2/l1 = {p.l2 / p.l1:.9f}, m2/m1 = {p.m2 / p.m1:.9f}, T = "
            f"{slow.period:.9f} and "
            f"{fast.period:.9f} s, {slow.stability} and {fast.stability}; {one.iterations} steps; "
            f"missed {row[0]:.0e}, {row[1]:.0e} rad"
        )
    counts = (
        [100, 1000, 10_000]
        if options.quick
        else [100, 300, 1000, 3000, 10_000, 30_000, 100_000, 300_000, 1_000_000]
    )
    flown, kept = memory(counts)
    for n, small, large in zip(counts, flown, kept, strict=True):
        print(f"{n:8} steps: {small / 1e6:.3f} MB with checkpoints, {large / 1e6:.3f} MB without")
    step = 2e-3
    horizon = dpend.gradient_horizon(
        dpend.Pendulum(), dpend.released(*CHAOTIC), 14.0, dpend.Scheme("rk8", step)
    )
    times = np.arange(2.0, 14.0, 4.0 if options.quick else 1.0)
    apart = parted(times, step)
    told = np.interp(times, horizon.time, horizon.error)
    print(
        f"gradient of (170, 180) deg: within 1e-3 up to {horizon.horizon:.2f} s at a step of "
        f"{step:g} s"
    )
    print(
        "  another integrator differs by",
        ", ".join(f"{d / t:.2g}" for d, t in zip(apart, told, strict=True)),
        "of it",
    )
    fig, axes = plt.subplots(2, 2, figsize=(11, 7.6), layout="constrained")
    draw_family(axes[0, 0], axes[0, 1], angles, found, misses)
    draw_memory(axes[1, 0], counts, flown, kept)
    draw_horizon(axes[1, 1], horizon, times, apart)
    fig.savefig(options.figure, dpi=100)
    print(f"drawn in {options.figure.name}")
    worst = max(max(row) for row in misses)
    assert worst < 1e-9, f"diffrax misses a designed orbit by {worst:.0e} rad"


if __name__ == "__main__":
    main()
