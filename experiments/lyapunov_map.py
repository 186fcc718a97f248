"""The Lyapunov map of all releases from rest, with the map of its own error.

Finite-time exponents over 10 s of the paper's pendulum, 1024 x 1024 cells in a resumable store; a
second pass at half the step says for each cell whether it may be believed. Where the motion is
regular the error is that of the method; where it is chaotic the two passes part before the end, and
only the distribution of exponents means something. The script prints the distributions of both
passes there, and compares ten regular cells with diffrax's variational equations.
"""

import argparse
import time
from functools import partial
from pathlib import Path

import jax
import numpy as np

import dpend
from dpend import chaos, plots

HERE = Path(__file__).parent
DURATION = 10.0


def by_diffrax(pendulum: dpend.Pendulum, theta1: float, theta2: float) -> float:
    """The same exponent from the variational equations, integrated by diffrax's Dopri8 at 1e-12."""
    import diffrax

    size = chaos.norm(pendulum)

    def slope(t, pair, args):
        state, tangent = pair
        return jax.jvp(partial(dpend.vector_field, pendulum), (state,), (tangent,))

    tangent = size.vector(*chaos.GENERIC)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(slope),
        diffrax.Dopri8(),
        0.0,
        DURATION,
        1e-3,
        (dpend.released(theta1, theta2), tangent),
        stepsize_controller=diffrax.PIDController(rtol=1e-12, atol=1e-14),
        max_steps=100_000,
    )
    end = jax.tree.map(lambda leaf: leaf[0], solution.ys[1])
    return float(0.5 * np.log(size.square(end)) / DURATION)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--quick", action="store_true", help="a coarse map, written nowhere but to --out"
    )
    parser.add_argument("--out", type=Path, default=HERE / "lyapunov_map.zarr")
    parser.add_argument("--figure", type=Path, default=HERE / "figures" / "lyapunov_map.png")
    options = parser.parse_args()
    cells = 32 if options.quick else 1024
    angles = np.pi * (np.arange(cells) + 0.5 - cells / 2) / (cells / 2)
    pendulum = dpend.Pendulum()
    started = time.perf_counter()
    field = dpend.sweep(
        partial(chaos.lyapunov, duration=DURATION), pendulum, {"theta1": angles, "theta2": angles},
        tolerance=1e-6, error="half-step", store=options.out,
    )  # fmt: skip
    print(f"{cells} x {cells} cells in {time.perf_counter() - started:.0f} s")
    exponent, error = field.lyapunov.values, field.lyapunov_error.values
    believed = error < 1e-3
    print(
        f"{np.mean(believed):.1%} of the cells keep their exponent to 1e-3/s when the step is "
        f"halved"
    )
    quantiles = np.quantile(exponent[~believed], [0.1, 0.5, 0.9])
    print(f"exponents of the others, 10, 50 and 90 %: {quantiles.round(3)} 1/s")
    picked = np.flatnonzero((error < 1e-6).ravel())
    worst = 0.0
    for cell in picked[:: max(1, picked.size // 10)][:10]:
        i, j = np.unravel_index(cell, exponent.shape)
        worst = max(worst, abs(by_diffrax(pendulum, angles[i], angles[j]) - exponent[i, j]))
    print(f"ten cells with an error below 1e-6/s against diffrax: at worst {worst:.1e} 1/s apart")

    import matplotlib.pyplot as plt
    from PIL import Image

    fig, axes = plt.subplots(1, 2, figsize=(10.4, 4.6), layout="constrained")
    plots.map_of(field, "lyapunov", axes[0])
    plots.map_of(field, "lyapunov_error", axes[1])
    fig.savefig(options.figure, dpi=95)
    # The picture is committed: a palette keeps it under 300 kB.
    Image.open(options.figure).convert("RGB").quantize(256).save(options.figure, optimize=True)
    print(f"drawn in {options.figure.name}")


if __name__ == "__main__":
    main()
