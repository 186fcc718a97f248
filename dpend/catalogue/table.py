"""The table of an atlas: its columns and units, and what every row of a true one satisfies.

The columns depend on each other, and that tells most damages: the energy is that of either rest,
`log_abs_kappa` is the logarithm of kappa, the dual of a centred orbit follows from its release, and
neighbours on a family lie no further apart than arclength allows.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from dpend.mechanics.pendulum import Pendulum, released
from dpend.orbits.arc import RELEASED_SYMMETRIES, SEGMENTS
from dpend.orbits.orbit import PeriodicOrbit
from dpend.status import Status

# The energy of the release against the orbit's, in units of the weights' torques. The difference is
# rounding: 4e-16 in the published catalogue.
_ENERGY = 1e-12
# The same of the dual, which is the end of an integration: 4e-13 in the catalogue.
_ENERGY_OF_DUAL = 1e-9
# What an error of integration may gain for each unit of the root of kappa, with which it grows.
_GROWTH = 1e-13
# What a degree loses on its way to radians and back, relative to the angle.
_DEGREES = 1e-15
# 2 pi turns - release against the dual of centred orbits [rad]: 4e-15 in the catalogue.
_HALF_TURNS = 1e-9
# kappa against its logarithm, and below -1: both are rounding, and zero in the catalogue.
_KAPPA = 1e-8
# Above it kappa is held to the largest number that float64 can square.
_CAPPED = 1e290
# The logarithm of a kappa above `_CAPPED` is above this.
_LOGARITHM_OF_CAPPED = 600.0
# Newton's methods stop at this residual at the latest; it grows like the root of kappa.
_RESIDUAL = 1e-6
# The longest period itself lies inside, to this share.
LONGEST = 1e-11
# Periods between two rows may be shorter than both by this share, and so may the extrapolated limit
# of shrinking orbits.
SHORTEST = 1e-3
# Along a family either rest moves no faster than the root of the number of nodes, whose mean square
# is arclength: 2.1 in the catalogue.
_REST = math.sqrt(SEGMENTS)
# The logarithm of the period moves not much faster than arclength: 0.9 in the catalogue.
_LOG_PERIOD = 3.0
# Arclength itself is rounded to this.
_ARCLENGTH = 1e-9

Table: TypeAlias = dict[str, np.ndarray]
Families: TypeAlias = Mapping[str, dict[str, Any]]

UNITS = {
    "theta1": "deg",
    "theta2": "deg",
    "dual_theta1": "deg",
    "dual_theta2": "deg",
    "theta2_error": "deg",
    "period": "s",
    "period_error": "s",
    "energy": "J",
}
# Columns and their types; those without a unit here are as in `PeriodicOrbit` and `Family`.
COLUMNS: dict[str, type] = {
    "family": str,
    "arclength": float,
    "theta1": float,
    "theta2": float,
    "period": float,
    "energy": float,
    "kappa": float,
    "log_abs_kappa": float,
    "symmetry": str,
    "dual_theta1": float,
    "dual_theta2": float,
    "turns1": int,
    "turns2": int,
    "residual": float,
    "theta2_error": float,
    "period_error": float,
    "iterations": int,
    "status": int,
}


def column_name(column: str) -> str:
    """A column's name in a file."""
    return f"{column}_{UNITS[column]}" if column in UNITS else column


def column_values(column: str, values: np.ndarray) -> list[Any]:
    """A column as a file has it: angles in degrees, the status by its name."""
    if column == "status":
        return [Status(value).name.lower() for value in values.tolist()]
    converted: list[Any] = (np.degrees(values) if UNITS.get(column) == "deg" else values).tolist()
    return converted


def table_of(orbits: PeriodicOrbit, family: str, arclength: Any) -> Table:
    """The rows of some orbits with a leading axis."""
    count = len(np.asarray(orbits.period))
    columns = {
        "family": np.full(count, family),
        "arclength": arclength,
        "theta1": orbits.theta1,
        "theta2": orbits.theta2,
        "symmetry": np.full(count, orbits.symmetry),
        "dual_theta1": orbits.dual.theta1,
        "dual_theta2": orbits.dual.theta2,
        "turns1": orbits.turns[0],
        "turns2": orbits.turns[1],
        "theta2_error": orbits.error_estimate[0],
        "period_error": orbits.error_estimate[1],
    }
    return {
        key: np.asarray(columns[key] if key in columns else getattr(orbits, key), kind)
        for key, kind in COLUMNS.items()
    }


def orbit_of(pendulum: Pendulum, table: Table, i: int) -> PeriodicOrbit:
    """The orbit in row `i`."""
    row = {key: kind(table[key][i]) for key, kind in COLUMNS.items()}
    same = ("period", "energy", "residual", "iterations", "kappa", "log_abs_kappa")
    return PeriodicOrbit(
        pendulum=pendulum,
        state=released(row["theta1"], row["theta2"]),
        dual=released(row["dual_theta1"], row["dual_theta2"]),
        turns=(row["turns1"], row["turns2"]),
        error_estimate=(row["theta2_error"], row["period_error"]),
        **{key: row[key] for key in (*same, "status", "symmetry")},
    )


def stack_tables(tables: Sequence[Table]) -> Table:
    """One table below the other."""
    return {
        key: np.concatenate([table[key] for table in tables]) if tables else np.zeros(0, kind)
        for key, kind in COLUMNS.items()
    }


class TableCheck(NamedTuple):
    """A table to be checked; `place` says where a row stands in its file."""

    table: Table
    place: Callable[[int], str]

    def refuse(
        self, wrong: np.ndarray, column: str, says: str, other: np.ndarray | None = None
    ) -> None:
        """Refuses the first wrong row, with its value in `column` and what it contradicts."""
        if not np.any(wrong):
            return
        i = int(np.argmax(wrong))
        value = self.table[column][i]
        if COLUMNS[column] is float:
            shown = f"{np.degrees(value) if UNITS.get(column) == 'deg' else value:.10g}"
        else:
            shown = repr(value.item())
        against = says if other is None else f"{says} {other[i]:.10g}"
        raise ValueError(f"{self.place(i)}: {column_name(column)} is {shown}, {against}")

    def run(self, pendulum: Pendulum, max_period: float, families: Families) -> None:
        """Refuses the first row that no orbit has. Where a solve failed, numbers may be missing,
        and need not agree.
        """
        table = self.table
        for column, kind in COLUMNS.items():
            if kind is float and column not in ("arclength", "log_abs_kappa"):
                self.refuse(~np.isfinite(table[column]) & self.sound, column, "and must be finite")
        zero = self.sound & (table["kappa"] == 0)
        table["log_abs_kappa"][zero] = -math.inf  # which JSON cannot say
        with np.errstate(all="ignore"):
            self.check_words(families)
            self.check_sizes(max_period)
            self.check_energies(pendulum)
            self.check_stability()
            self.check_centred()
            if families:
                self.check_families(families)
            else:
                self.check_releases()

    @property
    def sound(self) -> np.ndarray:
        """The rows that converged."""
        return np.asarray(self.table["status"] == Status.CONVERGED)

    def check_words(self, families: Families) -> None:
        """Symmetries and families are known ones, and belong together."""
        table = self.table
        self.refuse(
            ~np.isin(table["symmetry"], RELEASED_SYMMETRIES),
            "symmetry",
            "and must be centred or brake",
        )
        known = (
            f"the families are {', '.join(families)}" if families else "and there are no families"
        )
        self.refuse(~np.isin(table["family"], list(families) or [""]), "family", known)
        for name, family in families.items():
            wrong = (table["family"] == name) & (table["symmetry"] != family["symmetry"])
            self.refuse(wrong, "symmetry", f"its family {name} is {family['symmetry']}")

    def check_sizes(self, max_period: float) -> None:
        """Each number by itself."""
        table, sound = self.table, self.sound
        self.refuse(sound & ~(table["period"] > 0), "period", "and must be positive")
        most = max_period * (1 + LONGEST)
        self.refuse(
            sound & ~(table["period"] <= most), "period", f"max_period_s is {max_period:.10g}"
        )
        for column in ("residual", "theta2_error", "period_error", "iterations"):
            self.refuse(table[column] < 0, column, "and must not be negative")
        most_left = _RESIDUAL + _GROWTH * np.sqrt(np.abs(table["kappa"]))
        wrong = sound & ~(table["residual"] <= most_left)
        self.refuse(wrong, "residual", "of a converged orbit it is at most", most_left)

    def check_energies(self, pendulum: Pendulum) -> None:
        """Both rests have the orbit's energy."""
        table = self.table
        upper = float((pendulum.m1 + pendulum.m2) * pendulum.g * pendulum.l1)
        lower = float(pendulum.m2 * pendulum.g * pendulum.l2)
        of_dual = _ENERGY_OF_DUAL + _GROWTH * np.sqrt(np.abs(table["kappa"]))
        for rest, whose, share in (("", "release", _ENERGY), ("dual_", "dual", of_dual)):
            theta1, theta2 = table[f"{rest}theta1"], table[f"{rest}theta2"]
            energy = -upper * np.cos(theta1) - lower * np.cos(theta2)
            most = (upper + lower) * (share + _DEGREES * (np.abs(theta1) + np.abs(theta2)))
            wrong = self.sound & ~(np.abs(energy - table["energy"]) <= most)
            self.refuse(wrong, "energy", f"its {whose} has", energy)

    def check_stability(self) -> None:
        """kappa and its logarithm, which is that of kappa - 1 where much has cancelled."""
        kappa, logarithm = self.table["kappa"], self.table["log_abs_kappa"]
        size = np.abs(kappa)
        near = np.minimum(
            np.abs(np.exp(logarithm) - size), np.abs(np.exp(logarithm) - np.abs(kappa - 1))
        )
        agree = (near <= _KAPPA * (1 + size)) | (
            (size > 1) & (np.abs(logarithm - np.log(size)) <= _KAPPA)
        )
        agree |= (size > _CAPPED) & (logarithm > _LOGARITHM_OF_CAPPED)
        self.refuse(self.sound & ~agree, "log_abs_kappa", "kappa is", kappa)

    def check_centred(self) -> None:
        """A centred orbit is its own image, and never doubles its period; others have no turns."""
        table = self.table
        centred = self.sound & (table["symmetry"] == "centred")
        self.refuse(
            centred & ~(table["kappa"] >= -1 - _KAPPA), "kappa", "below -1 on a centred orbit"
        )
        for rod in "12":
            release, dual, turns = (
                table[f"{name}{rod}"] for name in ("theta", "dual_theta", "turns")
            )
            image = 2 * np.pi * turns - release
            wrong = centred & ~(
                np.abs(dual - image) <= _HALF_TURNS + _DEGREES * (np.abs(dual) + np.abs(release))
            )
            self.refuse(
                wrong, f"dual_theta{rod}", f"turns{rod} and its release say", np.degrees(image)
            )
            self.refuse(
                (table["symmetry"] == "brake") & (turns != 0),
                f"turns{rod}",
                "of an orbit that is not centred",
            )

    def check_releases(self) -> None:
        """Orbits of one release angle stand there once each, and have no arclength."""
        self.refuse(~np.isnan(self.table["arclength"]), "arclength", "and there are no families")
        whole = np.column_stack([self.table[key] for key in ("theta1", "theta2", "period")])
        _, first, which = np.unique(whole, axis=0, return_index=True, return_inverse=True)
        again = self.sound & (first[which.ravel()] != np.arange(len(whole)))
        self.refuse(again, "theta2", "and another row has the same orbit")

    def check_families(self, families: Families) -> None:
        """A family's rows lie in its range of periods, and neighbours close together."""
        table = self.table
        self.refuse(~(table["arclength"] >= 0), "arclength", "and must be a number of at least 0")
        for name, family in families.items():
            own = table["family"] == name
            shortest, longest = family["shortest_period_s"], family["longest_period_s"]
            low = own & self.sound & (table["period"] < shortest * (1 - SHORTEST))
            self.refuse(low, "period", f"the shortest of its family is {shortest:.10g}")
            high = own & self.sound & (table["period"] > longest * (1 + LONGEST))
            self.refuse(high, "period", f"the longest of its family is {longest:.10g}")
            self.refuse_neighbours(np.flatnonzero(own), "arclength", lambda way, step: way <= 0)
            rows = np.flatnonzero(own & self.sound)
            self.refuse_neighbours(
                rows, "log_period", lambda way, step: np.abs(way) > _LOG_PERIOD * step
            )
            for column in ("theta1", "theta2", "dual_theta1", "dual_theta2"):
                self.refuse_neighbours(rows, column, lambda way, step: np.abs(way) > _REST * step)

    def refuse_neighbours(
        self, rows: np.ndarray, column: str, leaps: Callable[..., np.ndarray]
    ) -> None:
        """Refuses a row too far from the row before on its family."""
        values = np.log(self.table["period"]) if column == "log_period" else self.table[column]
        step = np.diff(self.table["arclength"][rows]) + _ARCLENGTH
        wrong = np.zeros(len(values), bool)
        wrong[rows[1:]] = leaps(np.diff(values[rows]), step)
        before = np.append(np.nan, values[:-1])
        before[rows[1:]] = values[rows[:-1]]
        shown = np.exp(before) if column == "log_period" else before
        shown = np.degrees(shown) if UNITS.get(column) == "deg" else shown
        column = "period" if column == "log_period" else column
        self.refuse(wrong, column, "which does not follow on", shown)
