"""How long a first answer takes: `dpend` commands in processes of their own, with nothing kept from
before and with their compiled programs in the cache, beside a bare `import jax`.

All take turns; the table has medians with the fastest and the slowest. Each cold run has a cache of
its own, empty; the cached ones come after it. Writes `start_up.csv`; `--quick` takes one turn of
the first command and writes nothing.
"""

import argparse
import csv
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).parent
COMMANDS = (
    "orbit --theta1 40",
    "simulate --theta1 40 --theta2 49 --duration 3",
    "family --branch in-phase",
    "atlas --theta1 40 --max-period 1",
)
TURNS = 7


def timed(arguments: list[str], cache: str) -> float:
    """Seconds of a process."""
    environment = {**os.environ, "XDG_CACHE_HOME": cache}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    begun = time.perf_counter()
    subprocess.run(
        [sys.executable, *arguments], env=environment, check=True, stdout=subprocess.DEVNULL
    )
    return time.perf_counter() - begun


def one_turn(commands: tuple[str, ...]) -> dict[tuple[str, str], float]:
    times = {}
    for command in commands:
        with tempfile.TemporaryDirectory() as cache:
            for state in ("cold", "cached"):
                times[command, state] = timed(["-m", "dpend.cli", *command.split()], cache)
            times["import jax", ""] = timed(["-c", "import jax"], cache)
    return times


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    quick = parser.parse_args().quick
    turns = [one_turn(COMMANDS[:1] if quick else COMMANDS) for _ in range(1 if quick else TURNS)]
    rows = []
    for command, state in turns[0]:
        times = sorted(turn[command, state] for turn in turns)
        rows.append(
            [command, state, *(f"{t:.2f}" for t in (statistics.median(times), times[0], times[-1]))]
        )
    for command, state, middle, least, most in rows:
        name = command if command.startswith("import") else f"dpend {command}"
        print(f"{name:55s} {state:7s} {middle} s ({least} to {most})")
    if not quick:
        with (HERE / "start_up.csv").open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["command", "cache", "median_s", "fastest_s", "slowest_s"])
            writer.writerows(rows)


if __name__ == "__main__":
    main()
