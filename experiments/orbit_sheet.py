"""The picture at the top of the README: both orbits released from rest at theta1 = 40 deg.

python experiments/orbit_sheet.py [--quick] [--out FILE.png]
"""

import argparse
from pathlib import Path

import numpy as np

import dpend
from dpend import plots


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="at half the resolution")
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "figures" / "orbit_sheet.png"
    )
    options = parser.parse_args()
    import matplotlib

    matplotlib.use("Agg")
    pendulum = dpend.Pendulum()
    orbits = {
        name: dpend.find_orbit(pendulum, np.radians(40), branch=name)
        for name in ("in-phase", "anti-phase")
    }
    figure = plots.orbit_sheet(orbits)
    figure.savefig(options.out, dpi=50 if options.quick else 100)
    for name, orbit in orbits.items():
        # Right because an independent adaptive integrator, started from the printed release, comes
        # back to it.
        back = dpend.reference(pendulum, orbit.state, [float(orbit.period)])
        missed = np.degrees(
            max(
                abs(back.state.theta1[-1] - orbit.theta1), abs(back.state.theta2[-1] - orbit.theta2)
            )
        )
        print(f"{name}: diffrax misses the release by {missed:.1e} deg after one period")


if __name__ == "__main__":
    main()
