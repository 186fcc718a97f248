"""The atlas: every brake orbit of one release angle up to a period, and the table and file of many
orbits.

`scan` finds all returns to rest, `find_orbit` solves them to rounding. An `Atlas` is a table with
what was done to find its rows; those of families over the whole square come from `survey`.
"""

import csv
import io
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import jax
import numpy as np

from dpend._runtime import require_float64
from dpend.catalogue.files import (
    COLUMNS,
    UNITS,
    column_name,
    column_values,
    read_catalogue,
)
from dpend.catalogue.scan import (
    MOTIONS_PER_WAVE,
    RETURNS_PER_WAVE,
    Budget,
    Outlook,
    Scan,
    Zero,
    foresee,
    longest,
    scanned,
)
from dpend.checks import (
    check_place,
    file_path,
    function,
    known_number,
    known_real,
    one_of,
    several,
    shown,
)
from dpend.mechanics.pendulum import Pendulum, released
from dpend.mechanics.trig import LARGEST_ANGLE
from dpend.mechanics.units import natural
from dpend.orbits.find import find_orbit, swinging_pendulum
from dpend.orbits.orbit import RELEASED_SYMMETRIES, PeriodicOrbit
from dpend.records import json_text, record, replacing
from dpend.status import Status

# Intervals of theta2 that a scan begins with, and how often they are doubled at most.
_INTERVALS, _MOST_REFINEMENTS = 128, 6
# What a search may take if nothing else is said [time steps]: twenty minutes. Solving a return by
# `find_orbit` takes about as long as so many steps.
MOST_SEARCH_STEPS, STEPS_PER_ORBIT, SECONDS_PER_STEP = 300_000_000, 10_000, 4e-6
# Larger numbers are not counted.
COUNTABLE = 10**18
# Powers of ten. A lower bob of 1e-200 of the upper one's mass takes products of momenta below what
# float64 holds; with a lower rod of 1e-28 of the upper one its own momentum is lost in what the
# upper one adds to it.
_FARTHEST_MASSES, _FARTHEST_LENGTHS, _FARTHEST_UNIT = 30, 12, 90
# A scan looks this share further than asked, so that an orbit of just the longest period lies
# inside.
BEYOND = 1e-3


@dataclass(frozen=True)
class Coverage:
    """How a search was made, and what speaks for its being complete.

    Attributes:
        theta2_points: motions that were integrated by the last scan, or by those of all slices.
        time_points: rows in time at which each was looked at.
        refinements: how often the intervals of theta2 were doubled; of the whole square how often
            the slices were.
        suspicious_cells: places where something may be missing: intervals of theta2 too narrow to
            halve; returns to rest that Newton's method did not confirm; by how much `winding` and
            `degree` differ, slice by slice; returns or families that the last refinements still
            changed; of the whole square also passages of families that no return answers to, and
            returns that no passage does.
        winding, degree: how often p at the last time goes round zero as theta2 goes round, and the
            sum of the signs of all returns found, those of orbits run through several times
            included: unequal if one is missing. Of several slices their sums.
        slices: release angles that were scanned.
        exhausted: whether the search was broken off because it would have taken more than was
            allowed: what was found is right, and more is likely to be missing.
    """

    theta2_points: int
    time_points: int
    refinements: int
    suspicious_cells: int
    winding: int
    degree: int
    slices: int = 1
    exhausted: bool = False


@dataclass(frozen=True, eq=False)
class Atlas:
    """Brake orbits in a table, a row each.

    Attributes:
        pendulum: theirs.
        max_period: how far was looked [s].
        table: columns by name, shape (n,), in radians and SI units: `family` (empty for a single
            release angle) and `arclength` along it; `theta1`, `theta2`, `period`, `energy`,
            `kappa`, `log_abs_kappa`, `symmetry`, `residual`, `iterations` and `status` as in
            `PeriodicOrbit`, and from there `dual_theta1`, `dual_theta2`, `turns1`, `turns2`,
            `theta2_error`, `period_error`.
        families: a record for each, see `find_brake_families`; none for a single release angle.
        coverage: how they were found.
    """

    pendulum: Pendulum
    max_period: float
    table: dict[str, np.ndarray]
    families: tuple[dict[str, Any], ...]
    coverage: Coverage

    def __len__(self) -> int:
        return len(self.table["period"])

    @property
    def orbits(self) -> tuple[PeriodicOrbit, ...]:
        """The rows as orbits."""
        rows = ({key: column[i] for key, column in self.table.items()} for i in range(len(self)))
        return tuple(_orbit(self.pendulum, row) for row in rows)

    def where(
        self,
        *,
        period: Sequence[Any] | Any | None = None,
        energy: Sequence[Any] | Any | None = None,
        kappa: Sequence[Any] | Any | None = None,
        symmetry: Any = None,
        family: Any = None,
    ) -> "Atlas":
        """The rows with period [s], energy [J] and kappa in closed ranges, of a symmetry, of one
        family or of several.

        Raises:
            ValueError: a range that is none; an unknown symmetry, or a family that the atlas does
                not have.
        """
        keep = np.ones(len(self), bool)
        for name, bounds in (("period", period), ("energy", energy), ("kappa", kappa)):
            if bounds is not None:
                low, high = _range(name, bounds)
                keep &= (self.table[name] >= low) & (self.table[name] <= high)
        names = [one["family"] for one in self.families]
        for name, wanted, known in (
            ("symmetry", symmetry, list(RELEASED_SYMMETRIES)),
            ("family", family, names),
        ):
            if wanted is not None:
                given = list(wanted) if isinstance(wanted, (list, tuple, set)) else [wanted]
                chosen = [one_of(name, one, sorted(known)) for one in given]
                keep &= np.isin(self.table[name], chosen)
        return replace(self, table={key: column[keep] for key, column in self.table.items()})

    def record(self) -> dict[str, Any]:
        """All of it as plain numbers and text, angles in degrees: what `save` writes and `--json`
        prints.
        """
        columns = self._columns()
        rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        for row in rows:
            row["dual"] = {key: row.pop(f"dual_{key}") for key in ("theta1_deg", "theta2_deg")}
            row["turns"] = [row.pop("turns1"), row.pop("turns2")]
        return {**self._about(), "orbits": rows}

    def save(self, path: str | os.PathLike[str] | Any) -> None:
        """Writes F.json, or F.csv whose first line is a comment with all but the table, to be read
        by `load_atlas`.

        Angles in degrees, which may cost their last bit, everything else as it is. How many digits
        of theta2 and the period are to be trusted, the columns with their errors say.

        Raises:
            ValueError: another ending; no directory to write in.
        """
        path = file_path("path", path)
        check_place("path", path, (".csv", ".json"))
        with replacing(path) as draft:
            draft.write_text(self._json() if path.suffix == ".json" else self._csv())

    def _columns(self) -> dict[str, list[Any]]:
        """The table as files have it."""
        return {column_name(key): column_values(key, column) for key, column in self.table.items()}

    def _about(self) -> dict[str, Any]:
        from dpend._version import __version__

        return {
            "dpend_version": __version__,
            "pendulum": record(self.pendulum),
            "max_period_s": self.max_period,
            "units": dict(UNITS),
            "coverage": asdict(self.coverage),
            "families": list(self.families),
            "rows": len(self),
        }

    def _json(self) -> str:
        """An orbit a line: files are read by people and compared by lines, too."""
        record = self.record()
        lines = (json_text(orbit, indent=None) for orbit in record.pop("orbits"))
        return (
            json_text(record).removesuffix("\n}")
            + ',\n  "orbits": [\n    '
            + ",\n    ".join(lines)
            + "\n  ]\n}\n"
        )

    def _csv(self) -> str:
        text = io.StringIO()
        text.write("# " + json_text(self._about(), indent=None) + "\n")
        writer = csv.writer(text, lineterminator="\n")
        columns = self._columns()
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))
        return text.getvalue()


def load_atlas(path: str | os.PathLike[str] | Any) -> Atlas:
    """The atlas that `Atlas.save` wrote to F.json or F.csv, every row held to what is true of
    orbits.

    Energies, kappa and its logarithm, both rests of a centred orbit and neighbours on a family have
    to agree, so that a file that was damaged on its way is refused; a row whose status is another
    than `converged` need not agree.

    Raises:
        ValueError: no such file, or one that holds no atlas: with the row, the column and what is
            wrong.
    """
    path = file_path("path", path)
    if path.suffix not in (".csv", ".json"):
        raise ValueError(f"path must end in .csv or .json, got {path}: Atlas.save writes no others")
    try:
        pendulum, max_period, table, families, coverage = read_catalogue(path)
    except OSError as error:
        raise ValueError(
            f"path must be a file that can be read, got {path} ({error.strerror}): give another "
            f"file"
        ) from None
    except ValueError as error:
        raise ValueError(
            f"path must be a file that Atlas.save wrote, got {path} ({error}): give another file"
        ) from None
    return Atlas(pendulum, max_period, table, families, Coverage(**coverage))


def table_of(orbits: PeriodicOrbit, family: str, arclength: Any) -> dict[str, np.ndarray]:
    """The rows of some orbits with a leading axis."""
    columns = {
        "theta1": orbits.theta1,
        "theta2": orbits.theta2,
        "dual_theta1": orbits.dual.theta1,
        "dual_theta2": orbits.dual.theta2,
        "turns1": orbits.turns[0],
        "turns2": orbits.turns[1],
        "theta2_error": orbits.error_estimate[0],
        "period_error": orbits.error_estimate[1],
    }
    columns |= {
        key: getattr(orbits, key)
        for key in ("period", "energy", "kappa", "log_abs_kappa", "residual")
    }
    columns |= {"iterations": orbits.iterations, "status": orbits.status, "arclength": arclength}
    count = len(np.asarray(orbits.period))
    columns |= {"family": np.full(count, family), "symmetry": np.full(count, orbits.symmetry)}
    return {key: np.asarray(columns[key], kind) for key, kind in COLUMNS.items()}


def stacked(tables: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """One table below the other."""
    return {
        key: np.concatenate([table[key] for table in tables]) if tables else np.zeros(0, kind)
        for key, kind in COLUMNS.items()
    }


def _orbit(pendulum: Pendulum, row: dict[str, Any]) -> PeriodicOrbit:
    return PeriodicOrbit(
        pendulum=pendulum,
        state=released(float(row["theta1"]), float(row["theta2"])),
        period=float(row["period"]),
        energy=float(row["energy"]),
        residual=float(row["residual"]),
        iterations=int(row["iterations"]),
        kappa=float(row["kappa"]),
        log_abs_kappa=float(row["log_abs_kappa"]),
        dual=released(float(row["dual_theta1"]), float(row["dual_theta2"])),
        turns=(int(row["turns1"]), int(row["turns2"])),
        error_estimate=(float(row["theta2_error"]), float(row["period_error"])),
        status=int(row["status"]),
        symmetry=str(row["symmetry"]),
    )


def _range(name: str, bounds: Any) -> tuple[float, float]:
    pair = several(name, bounds, "a pair (low, high)", 2)
    try:
        low, high = (known_real(name, bound) for bound in pair)
    except ValueError:
        raise ValueError(
            f"{name} must be a pair (low, high) of numbers, got {shown(bounds)}: give two"
        ) from None
    if not low <= high:
        raise ValueError(
            f"{name} must be a pair (low, high) with low at most high, got {shown(bounds)}: give "
            f"them in order"
        )
    return low, high


def find_brake_orbits(
    pendulum: Pendulum | Any,
    *,
    theta1: Any,
    max_period: Any,
    most_steps: Any = MOST_SEARCH_STEPS,
    progress: Callable[[int, int], None] | Any | None = None,
) -> Atlas:
    """Every orbit released from rest at `theta1` with a period of at most `max_period`: all its
    partners theta2.

    The returns to rest are all zeros of (p1, p2) in (theta2, t), found cell by cell (see `scan`).
    The scan is repeated from twice as many intervals of theta2 until the number of returns has
    stood through two repetitions; then each return is solved by `find_orbit`. An orbit run through
    several times is listed once with its minimal period; where theta1 is 0 or 180 degrees, so is
    one of each pair of mirror images (theta1, theta2) and (theta1, -theta2). Where both rests of an
    orbit, or one and the mirror image of the other, have theta1, both are listed, being two
    releases.

    Arguments:
        pendulum: its fields are numbers; g positive.
        theta1: release angle of the upper rod [rad].
        max_period: [s]. The number of orbits, and the time it takes, grows exponentially with it.
        most_steps: time steps of all motions, 2 to 8 microseconds each on one core. A search that
            will take more is refused before it begins; one that takes more after all ends there,
            and its coverage says `exhausted`.
        progress: called with the time steps so far, and with those that are expected in all.
    Returns:
        Atlas, in order of the period; theta2 in (-pi, pi].
    Raises:
        ValueError: theta1 not finite, or beyond 1.3e7 rad; max_period not positive, or so long that
            the fast normal mode would swing 32 times, or that most_steps are not enough; g not
            positive; a traced argument; lengths, masses or g whose products leave the range of
            float64.
        RuntimeError: float64 is switched off in JAX.
    """
    require_float64()
    fixed = swinging_pendulum(pendulum)
    theta1, most_steps = _known_angle(theta1), known_number("most_steps", most_steps, positive=True)
    if progress is not None:
        function("progress", progress, "(steps taken, steps expected)", "print")
    max_period = known_period(fixed, max_period)
    expected = expected_steps(fixed, max_period, theta1)
    budget = known_budget(most_steps, expected, max_period)
    if progress is not None:
        progress(0, expected)
        budget.tell = lambda spent: progress(spent, max(spent, expected))
    counts: list[int] = []
    for refinement in range(_MOST_REFINEMENTS + 1):
        result = returns(fixed, theta1, max_period, _INTERVALS << refinement, budget)
        counts.append(len(result.zeros))
        unsettled = max(counts[-3:]) - min(counts[-3:])
        if (len(counts) > 2 and not unsettled) or budget.exhausted:
            break
    found, lost = _solved(fixed, theta1, max_period, result, budget)
    coverage = Coverage(
        theta2_points=result.motions,
        time_points=result.rows,
        refinements=refinement,
        suspicious_cells=len(result.open_cells)
        + lost
        + abs(result.winding - result.degree)
        + unsettled,
        winding=result.winding,
        degree=result.degree,
        exhausted=budget.exhausted,
    )
    return Atlas(fixed, max_period, stacked([_row(orbit) for orbit in found]), (), coverage)


def _known_angle(theta1: Any) -> float:
    value = known_number("theta1", theta1, unit="rad")
    if abs(value) > LARGEST_ANGLE:
        raise ValueError(
            f"theta1 must be at most {LARGEST_ANGLE:.2g} rad, beyond which its sine has no digits "
            f"left, got {value:g}: "
            "take off full turns"
        )
    return value


def known_period(pendulum: Pendulum, max_period: Any) -> float:
    """`max_period`, refused where no scan reaches, and pendulums that float64 cannot hold."""
    value = known_number("max_period", max_period, positive=True, unit="s")
    _check_scales(pendulum)
    most = 2 * longest(jax.tree.map(float, natural(pendulum))) * math.sqrt(pendulum.l1 / pendulum.g)
    if value > most:
        raise ValueError(
            f"max_period must be at most {most:.4g} s for this pendulum, got {value:g}: ask for "
            f"less"
        )
    return value


def _check_scales(pendulum: Pendulum) -> None:
    """Refuses a pendulum whose numbers are so far apart that their products leave the range of
    float64.
    """
    l1, l2, m1, m2, g = (
        math.log10(float(getattr(pendulum, name))) for name in ("l1", "l2", "m1", "m2", "g")
    )
    for names, ratio, most in (
        ("l1 and l2", l2 - l1, _FARTHEST_LENGTHS),
        ("m1 and m2", m2 - m1, _FARTHEST_MASSES),
    ):
        if abs(ratio) > most:
            values = " and ".join(
                f"{float(getattr(pendulum, name)):g}" for name in names.split(" and ")
            )
            raise ValueError(
                f"{names} must be within a factor of 1e{most} of each other, beyond which float64 "
                f"loses the momenta, "
                f"got {values}: give others"
            )
    units = {
        "sqrt(l1/g)": 0.5 * (l1 - g),
        "m1 g l1": m1 + g + l1,
        "m1 l1 sqrt(g l1)": m1 + 1.5 * l1 + 0.5 * g,
    }
    for name, size in units.items():
        if abs(size) > _FARTHEST_UNIT:
            raise ValueError(
                f"{name} must be within 1e-{_FARTHEST_UNIT} and 1e{_FARTHEST_UNIT} in SI units, "
                f"beyond which products "
                f"leave the range of float64, got 1e{size:.0f}: use other units"
            )


def expected_steps(pendulum: Pendulum, max_period: float, theta1: float) -> int:
    """The time steps that `find_brake_orbits` will take, roughly: three scans, and the returns
    solved.
    """
    seen = foresee_returns(pendulum, theta1, max_period)
    motions = 2 * (_INTERVALS << 3) + 3 * MOTIONS_PER_WAVE * seen.waves
    return int(
        min(motions * seen.rows + RETURNS_PER_WAVE * seen.waves * STEPS_PER_ORBIT, COUNTABLE)
    )


def foresee_returns(pendulum: Pendulum, theta1: float, max_period: float) -> Outlook:
    """What `returns` has before it."""
    scaled, half, _ = _in_natural_units(pendulum, max_period)
    return foresee(scaled, math.remainder(theta1, 2 * math.pi), half)


def known_budget(most_steps: float, expected: int, max_period: float) -> Budget:
    """`most_steps`, refused if the search is expected to take more."""
    if most_steps < expected:
        raise ValueError(
            f"max_period must be so short that most_steps, {most_steps:g}, are enough, got "
            f"{max_period:g} s, which "
            f"takes about {expected:.1g}, {expected * SECONDS_PER_STEP:.1g} s of time: ask for "
            f"less, or raise "
            "most_steps"
        )
    return Budget(int(min(most_steps, COUNTABLE)))


def _in_natural_units(pendulum: Pendulum, max_period: float) -> tuple[Pendulum, float, float]:
    """The pendulum, the longest half period with a margin, and the second."""
    second = math.sqrt(pendulum.l1 / pendulum.g)
    return jax.tree.map(float, natural(pendulum)), 0.5 * max_period / second * (1 + BEYOND), second


def returns(
    pendulum: Pendulum, theta1: float, max_period: float, intervals: int, budget: Budget
) -> Scan:
    """All returns to rest within half of `max_period`, times in seconds."""
    scaled, half, second = _in_natural_units(pendulum, max_period)
    result = scanned(scaled, math.remainder(theta1, 2 * math.pi), half, intervals, budget)
    zeros = tuple(
        zero._replace(time=zero.time * second, row=zero.row * second) for zero in result.zeros
    )
    return replace(result, zeros=zeros)


def _solved(
    pendulum: Pendulum, theta1: float, max_period: float, result: Scan, budget: Budget
) -> tuple[list[PeriodicOrbit], int]:
    """The orbits to which the returns belong, in order of the period, and the number that Newton's
    method lost.
    """
    found: list[PeriodicOrbit] = []
    known = np.zeros((0, 2))
    lost = 0
    own_mirror = abs(math.sin(theta1)) < 1e-12
    for zero in sorted(result.zeros, key=lambda zero: zero.time):
        if (own_mirror and zero.theta2 < 0) or np.any(are_returns(known, zero)):
            continue
        if budget.exhausted:
            lost += 1
            continue
        orbit = find_orbit(pendulum, theta1, guess=(zero.theta2, 2 * zero.time))
        budget.spend(STEPS_PER_ORBIT)
        if int(orbit.status) != Status.CONVERGED or not is_return(orbit, zero):
            lost += 1
        elif float(orbit.period) <= max_period * (1 + 1e-12):
            found.append(orbit)
            known = np.vstack([known, _place_of(orbit)])
    return sorted(found, key=lambda orbit: float(orbit.period)), lost


# A return is known to this share of its cell.
_LOCATED = 0.2


def is_return(orbit: PeriodicOrbit, zero: Zero) -> bool:
    """Whether a return to rest is that of an orbit, maybe run through several times."""
    return bool(are_returns(_place_of(orbit), zero)[0])


def _place_of(orbit: PeriodicOrbit) -> np.ndarray:
    return np.array([[float(orbit.theta2), 0.5 * float(orbit.period)]])


def are_returns(places: np.ndarray, zero: Zero) -> np.ndarray:
    """The same of many orbits' theta2 and half periods, shape (n, 2)."""
    apart = np.abs(places[:, 0] - zero.theta2)
    apart = np.abs(apart - 2 * np.pi * np.round(apart / (2 * np.pi)))
    half = places[:, 1]
    late = np.abs(zero.time - half * np.maximum(1, np.round(zero.time / half)))
    near: np.ndarray = (apart < max(_LOCATED * zero.width, 1e-12)) & (late < _LOCATED * zero.row)
    return near


def _row(orbit: PeriodicOrbit) -> dict[str, np.ndarray]:
    return table_of(
        jax.tree.map(lambda leaf: np.asarray(leaf)[None], orbit), "", np.full(1, np.nan)
    )
