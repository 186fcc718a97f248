"""How long it takes to follow the in-phase family from 0.02 to 3.1 rad: this package beside
AUTO-07p, and their errors.

The pendulum is l1 = l2 = m1 = m2 = g = 1. AUTO solves the boundary value problem over a quarter of
the period by collocation, with derivatives written out and nothing detected on the way, the least
that it can be asked for. dpend's time, with which AUTO's is compared, is that of the whole family,
on to the homoclinic end, with an error estimate and the stability of each orbit, and the special
points; cut short by `most_points` where AUTO stops, it is told too. All are run in turn, medians
beside the fastest and the slowest: the fastest tell more where other programs run. AUTO's time is
that of its process, compiled before; dpend's is a warm call, and the first call in a new process is
told beside it.

Errors are the largest over all points up to 3.1 rad, against shooting from the same angles on
Lagrange's equations by extrapolation in extended precision, which shares nothing with either.
AUTO's table has 11 digits, so that its numbers are printed in two parts. Its first point is left
out: that is the linear motion that it was given. Without AUTO-07p or a Fortran compiler only dpend
is measured. `--quick` runs less for a test.
"""

import argparse
import csv
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import extended

HERE = Path(__file__).parent
FIRST, LAST = 0.02, 3.1  # [rad]
ANGLES = 150  # of `Family.at`

# Hamilton's equations in a time that is 1 after a quarter of the period, par(2). What is printed of
# a solution are theta1(0), the period and theta2(0), first to six decimals and then what that
# leaves.
EQUATIONS = """
subroutine func(ndim, u, icp, par, ijac, f, dfdu, dfdp)
  implicit none
  integer, intent(in) :: ndim, icp(*), ijac
  double precision, intent(in) :: u(ndim), par(*)
  double precision, intent(out) :: f(ndim)
  double precision, intent(inout) :: dfdu(ndim, ndim), dfdp(ndim, *)
  double precision :: s, c, det, w(2), by_delta(2), by_p(2, 2), pull, pull_delta, pull_p(2)
  s = sin(u(1) - u(2))
  c = cos(u(1) - u(2))
  det = 1 + s*s
  w = [u(3) - c*u(4), 2*u(4) - c*u(3)]/det
  pull = w(1)*w(2)*s
  f = par(2)*[w(1), w(2), -pull - 2*sin(u(1)), pull - sin(u(2))]
  if (ijac == 0) return
  by_delta = s/det*[w(2) - c*w(1), 2*w(1) - c*w(2)]
  by_p = reshape([1d0, -c, -c, 2d0], [2, 2])/det
  pull_delta = (by_delta(1)*w(2) + w(1)*by_delta(2))*s + w(1)*w(2)*c
  pull_p = (by_p(1, :)*w(2) + w(1)*by_p(2, :))*s
  dfdu(1:2, 1) = by_delta
  dfdu(1:2, 2) = -by_delta
  dfdu(1:2, 3:4) = by_p
  dfdu(3, :) = [-pull_delta - 2*cos(u(1)), pull_delta, -pull_p]
  dfdu(4, :) = [pull_delta, -pull_delta - cos(u(2)), pull_p]
  dfdu = par(2)*dfdu
  if (ijac == 1) return
  dfdp(:, 1) = 0
  dfdp(:, 2) = f/par(2)
end subroutine

subroutine stpnt(ndim, u, par, t)
  implicit none
  integer, intent(in) :: ndim
  double precision, intent(inout) :: u(ndim), par(*)
  double precision, intent(in) :: t
  double precision, parameter :: a = 0.02d0, ratio = sqrt(2d0)
  double precision, parameter :: w = sqrt(2 - ratio), quarter = 2*atan(1d0)
  par(1:2) = [a, quarter/w]
  u(1:2) = a*cos(quarter*t)*[1d0, ratio]
  u(3:4) = -a*w*sin(quarter*t)*[2 + ratio, 1 + ratio]
end subroutine

subroutine bcnd(ndim, par, icp, nbc, u0, u1, fb, ijac, dbc)
  implicit none
  integer, intent(in) :: ndim, icp(*), nbc, ijac
  double precision, intent(in) :: par(*), u0(ndim), u1(ndim)
  double precision, intent(out) :: fb(nbc)
  double precision, intent(inout) :: dbc(nbc, *)
  fb = [u0(3), u0(4), u1(1), u1(2), u0(1) - par(1)]
  if (ijac == 0) return
  dbc(:, 1:8) = 0
  dbc(1, 3) = 1
  dbc(2, 4) = 1
  dbc(3, 5) = 1
  dbc(4, 6) = 1
  dbc(5, 1) = 1
  if (ijac == 1) return
  dbc(:, 9:10) = 0
  dbc(5, 9) = -1
end subroutine

subroutine pvls(ndim, u, par)
  implicit none
  integer, intent(in) :: ndim
  double precision, intent(in) :: u(ndim)
  double precision, intent(inout) :: par(*)
  double precision, external :: getp
  double precision :: x(3)
  x = [par(1), 4*par(2), getp('BV0', 2, u)]
  par(3:5) = anint(1d6*x)/1d6
  par(6:8) = x - par(3:5)
end subroutine

subroutine icnd
end subroutine

subroutine fopt
end subroutine
"""

# Boundary values (IPS), pseudo-arclength (ISW) with nothing looked for (ILP, ISP) nor printed of
# the solutions (NPR) nor of the iterations (IID), until par(1) passes RL1. The period does not
# count in the arclength (THL). A step is lengthened by half or by a tenth after two or three Newton
# iterations (ITNW); the tolerances leave no more than that.
CONSTANTS = """
NDIM=4, IPS=4, IRS=0, ISW=1, ILP=0, ISP=0, IPLT=0, NBC=5, NINT=0, NPAR=8
ICP=[1,2,3,4,5,6,7,8], THL={{2: 0.0}}, THU={{}}
NTST={intervals}, NCOL=4, IAD=3, JAC=1, ITMX=8, ITNW=7, NWTN=3, EPSL=1e-10, EPSU=1e-10, EPSS=1e-8
NMX=1000, NPR=0, IID=0, MXBF=0, RL0=0.0, RL1={last}, A0=0.0, A1=1e6
DS={first_step}, DSMIN=1e-4, DSMAX={longest_step}, IADS=1
"""


@dataclass(frozen=True)
class Followed:
    """What one of the two found: points of the family, and what it took to be able to start [s]."""

    theta1: Any
    theta2: Any
    period: Any
    first: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--cold", type=float)
    options = parser.parse_args()
    if options.cold:  # the script's own new processes
        cold(options.cold)
        return
    with tempfile.TemporaryDirectory() as directory:
        rows = compared(Path(directory), options.quick)
    if not options.quick:
        with (HERE / "family_speed.csv").open("w", newline="") as file:
            table = csv.DictWriter(file, list(rows[0]))
            table.writeheader()
            table.writerows(rows)


def cold(longest_step: float) -> None:
    """Prints the seconds of the import, of the first walk and of the first `at`, in a process that
    did nothing else.
    """
    import numpy as np

    start = time.perf_counter()
    import dpend

    imported = time.perf_counter()
    family = dpend.follow_family(
        dpend.Pendulum(1.0, 1.0, 1.0, 1.0, 1.0), "in-phase", longest_step=longest_step
    )
    followed = time.perf_counter()
    np.asarray(family.at(np.linspace(FIRST, LAST, ANGLES)).theta2)
    print(json.dumps([imported - start, followed - imported, time.perf_counter() - followed]))


def compared(directory: Path, quick: bool) -> list[dict]:
    """All timings and errors, one row for each job."""
    import numpy as np

    import dpend

    pendulum = dpend.Pendulum(1.0, 1.0, 1.0, 1.0, 1.0)
    longest_step = 0.1 if quick else 0.0266
    family = dpend.follow_family(pendulum, "in-phase", longest_step=longest_step)
    angles = np.linspace(FIRST, LAST, 10 if quick else ANGLES)
    imports, firsts, firsts_at = np.median(
        [in_new_process(longest_step) for _ in range(1 if quick else 3)], axis=0
    )
    most = int(np.argmax(np.asarray(family.orbits.theta1) > LAST)) + 1
    whole, short, at = (
        "follow_family to its end",
        "follow_family to 3.1 rad",
        f"family.at of {len(angles)} angles",
    )
    found = {f"dpend, {name}": of_orbits(family.orbits, firsts) for name in (whole, short)}
    found[f"dpend, {at}"] = of_orbits(family.at(angles), firsts_at)
    follow = partial(dpend.follow_family, pendulum, "in-phase", longest_step=longest_step)
    jobs: dict[str, Callable[[], float]] = {
        f"dpend, {whole}": lambda: np.asarray(follow().orbits.theta2).size,
        f"dpend, {short}": lambda: np.asarray(follow(most_points=most).orbits.theta2).size,
        f"dpend, {at}": lambda: np.asarray(family.at(angles).theta2).size,
    }
    program, compiling = compiled_auto(directory)
    for intervals in (60,) if quick else (60, 100, 200):
        for threads in sorted({1, cores()}):
            if program is None:
                continue
            name = f"AUTO-07p, {intervals} x 4, {threads} thread{'s' if threads > 1 else ''}"
            folder = prepared(directory, intervals, longest_step=0.2 if quick else 0.047)
            jobs[name] = partial(run_auto, program, folder, threads)
            jobs[name]()
            found[name] = of_table(folder / "fort.7", compiling)
    seconds, own = timed(jobs, 1 if quick else 15)
    errors = errors_of(found)
    rows, base = [], seconds[f"dpend, {whole}"]
    for name, times in seconds.items():
        is_auto = name.startswith("AUTO")
        rows.append({
            "what": name,
            "points": len(found[name].theta1),
            "seconds": np.median(times),
            "fastest": min(times),
            "slowest": max(times),
            "auto_total_time": np.median(own[name]) if is_auto else np.nan,
            "compile_or_first_call": found[name].first,
            "error_theta2_rad": errors[name][0],
            "error_period_relative": errors[name][1],
            "auto_over_dpend": np.median(times) / np.median(base) if is_auto else np.nan,
            "auto_over_dpend_fastest": min(times) / min(base) if is_auto else np.nan,
        })  # fmt: skip
    print(f"import of dpend {imports:.2f} s, not part of its first call\n{HEADER}")
    return [report(row) for row in rows]


HEADER = "\n".join(
    [
        "",
        f"{'':36s}points  seconds (fastest to slowest)   compiling or   largest errors"
        "           over dpend's time",
        f"{'':78s}first call   theta2 [rad]  T, share   medians  fastest",
    ]
)


def report(row: dict) -> dict:
    """The row as it goes into the file, printed."""
    ratios = (
        f"{row[key]:9.2f}" for key in ("auto_over_dpend", "auto_over_dpend_fastest") if row[key] > 0
    )
    print(
        f"{row['what']:38s}{row['points']:4d}  {row['seconds']:7.3f} ({row['fastest']:.3f} to "
        f"{row['slowest']:.3f})"
        f"{row['compile_or_first_call']:14.2f} "
        f"s{row['error_theta2_rad']:14.1e}{row['error_period_relative']:12.1e}" + "".join(ratios)
    )
    return {
        key: f"{value:.3g}" if isinstance(value, float) else value for key, value in row.items()
    }


def cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def timed(
    jobs: dict[str, Callable[[], float]], repeats: int
) -> tuple[dict[str, list], dict[str, list]]:
    """The seconds of all calls, made in turn so that all see the same machine, and what the jobs
    returned.
    """
    seconds: dict[str, list] = {name: [] for name in jobs}
    returned: dict[str, list] = {name: [] for name in jobs}
    for _ in range(repeats):
        for name, job in jobs.items():
            start = time.perf_counter()
            result = job()
            seconds[name].append(time.perf_counter() - start)
            returned[name].append(result)
    return seconds, returned


# --- dpend ----------------------------------------------------------------------------------------


def in_new_process(longest_step: float) -> list[float]:
    """What `cold` prints, without a cache of compiled code."""
    environment = {
        key: value for key, value in os.environ.items() if key != "JAX_COMPILATION_CACHE_DIR"
    }
    command = [sys.executable, __file__, "--cold", str(longest_step)]
    return json.loads(
        subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
    )


def of_orbits(orbits: Any, first: float) -> Followed:
    """Those between the two angles."""
    import numpy as np

    theta1 = np.asarray(orbits.theta1)
    inside = (theta1 >= FIRST) & (theta1 <= LAST)
    return Followed(
        theta1[inside], np.asarray(orbits.theta2)[inside], np.asarray(orbits.period)[inside], first
    )


# --- AUTO -----------------------------------------------------------------------------------------


def compiled_auto(directory: Path) -> tuple[Path | None, float]:
    """AUTO with the equations as one program, None where it cannot be had, and the seconds that
    compiling took.
    """
    command, compiler = shutil.which("auto-07p") or shutil.which("auto"), shutil.which("gfortran")
    places = [Path(os.environ["AUTO_DIR"])] if "AUTO_DIR" in os.environ else []
    if command:
        prefix = Path(command).resolve().parents[1]
        places += [prefix / "lib" / "auto-07p", prefix]  # as Debian has it, and as its authors
    libraries = [place / "lib" for place in places if (place / "lib" / "solvebv.o").exists()]
    if not libraries or compiler is None:
        print(
            "no AUTO-07p: not installed"
            if not libraries
            else "no AUTO-07p: no gfortran to compile its equations"
        )
        return None, 0.0
    objects = [str(file) for file in sorted(libraries[0].glob("*.o"))]
    source, program = directory / "pendulum.f90", directory / "pendulum"
    source.write_text(EQUATIONS)
    start = time.perf_counter()
    subprocess.run(
        [compiler, "-O3", "-fopenmp", str(source), *objects, "-o", str(program)], check=True
    )
    return program, time.perf_counter() - start


def prepared(directory: Path, intervals: int, longest_step: float) -> Path:
    """A folder with AUTO's constants for so many mesh intervals."""
    folder = directory / str(intervals)
    folder.mkdir(exist_ok=True)
    constants = CONSTANTS.format(
        intervals=intervals, last=LAST, first_step=0.05, longest_step=longest_step
    )
    (folder / "fort.2").write_text(constants)
    return folder


def run_auto(program: Path, folder: Path, threads: int) -> float:
    """One run; the time that AUTO itself prints.

    Its threads wait by spinning: where another process takes a core, several are many times slower
    than one.
    """
    environment = os.environ | {"OMP_NUM_THREADS": str(threads)}
    done = subprocess.run(
        [program], cwd=folder, env=environment, capture_output=True, text=True, check=True
    )
    return float(done.stdout.split("Total Time")[1].split()[0])


def of_table(file: Path, first: float) -> Followed:
    """AUTO's points up to the last angle, but for the first, which is only the linear motion."""
    import numpy as np

    rows = [line.split() for line in file.read_text().splitlines()]
    values = np.array(
        [row[4:] for row in rows if row[0] != "0"], np.float64
    )  # par(1), norm, par(2), par(3), ...
    theta1, period, theta2 = (values[:, 3:6] + values[:, 6:9]).T
    inside = (np.arange(len(values)) > 0) & (theta1 <= LAST)
    return Followed(theta1[inside], theta2[inside], period[inside], first)


# --- errors ---------------------------------------------------------------------------------------


def errors_of(found: dict[str, Followed]) -> dict[str, tuple[float, float]]:
    """The largest errors of theta2 [rad] and of the period, relative, each at its own angles."""
    import numpy as np

    columns = [
        np.concatenate([getattr(f, name) for f in found.values()])
        for name in ("theta1", "theta2", "period")
    ]
    theta1, first, where = np.unique(columns[0], return_index=True, return_inverse=True)
    theta2, period, change = solved(theta1, columns[1][first], columns[2][first])
    print(f"errors are known to {change:.0e}")
    bounds = np.cumsum([len(each.theta1) for each in found.values()])[:-1]
    errors = np.abs(columns[1] - theta2[where]), np.abs(columns[2] / period[where] - 1)
    largest = [[float(np.max(part)) for part in np.split(column, bounds)] for column in errors]
    return dict(zip(found, zip(*largest, strict=True), strict=True))


def solved(theta1: Any, theta2: Any, period: Any) -> tuple[Any, Any, float]:
    """Partner angles and periods by Newton's method on theta(T/4) = 0, and their change in its last
    iteration.

    That takes shorter steps than the one before: the change is also the error that these had made.
    """
    import numpy as np

    theta1, theta2, quarter = (np.asarray(x, np.longdouble) for x in (theta1, theta2, period / 4))
    small = np.longdouble(1e-9)
    for steps in (48, 48, 64):
        end, aside = (shot(theta1, angle, quarter, steps) for angle in (theta2, theta2 + small))
        by_angle, by_time = (aside - end)[:2] / small, end[2:]
        determinant = by_angle[0] * by_time[1] - by_angle[1] * by_time[0]
        angle_change = (end[1] * by_time[0] - end[0] * by_time[1]) / determinant
        time_change = (end[0] * by_angle[1] - end[1] * by_angle[0]) / determinant
        theta2, quarter = theta2 + angle_change, quarter + time_change
    change = max(np.max(np.abs(angle_change)), np.max(np.abs(time_change / quarter)))
    return theta2, 4 * quarter, float(change)


def shot(theta1: Any, theta2: Any, time: Any, steps: int, columns: int = 8) -> Any:
    """Angles and velocities after `time` from rest: the midpoint rule with 2, 4, ... 16 substeps,
    extrapolated.
    """
    import numpy as np

    x, step = np.stack([theta1, theta2, 0 * theta1, 0 * theta1]), time / steps
    slope = partial(extended.accelerations, np.ones(5, np.longdouble))
    for _ in range(steps):
        x = next(islice(extended.extrapolated(slope, x, step), columns - 1, None))
    return x


if __name__ == "__main__":
    main()
