"""An atlas: many orbits in a table, with what was done to find them, and its file.

The atlas of one release angle comes from `release`, that of the whole square from `survey`.
"""

import csv
import io
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from dpend.catalogue.files import read_catalogue
from dpend.catalogue.table import MAY_MISS, UNITS, column_name, column_values, orbit_of
from dpend.checks import known_real, one_of, several, shown
from dpend.mechanics.pendulum import Pendulum
from dpend.orbits.arc import RELEASED_SYMMETRIES
from dpend.orbits.orbit import PeriodicOrbit
from dpend.places import check_place, file_path, replacing
from dpend.records import Quantities, frame, html, json_text, outcome, record, span, variables


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
            `theta2_error`, `period_error`; `certificate`, the identifier of the row's proof (see
            `certify_atlas`), or empty.
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

    def __repr__(self) -> str:
        families = f"{len(self.families)} families, " if self.families else ""
        told = f"{span('period', self.table['period'], 's')}, {outcome(self.table['status'])}"
        suspicious = f"{self.coverage.suspicious_cells} suspicious cells"
        return f"<Atlas: {len(self)} orbits, {families}{told}, {suspicious}>"

    _repr_html_ = html

    def to_dataframe(self) -> Any:
        """The table with the names and the units of files: angles in degrees."""
        return frame(self._quantities())

    def to_xarray(self) -> Any:
        """The table as an `xarray.Dataset` over `orbit`: radians and SI units, the angles in
        degrees as coordinates.
        """
        import xarray

        data, degrees = variables(self._quantities(), "orbit")
        return xarray.Dataset(data, degrees, {"max_period_s": self.max_period})

    def _quantities(self) -> Quantities:
        units = {name: "rad" if unit == "deg" else unit for name, unit in UNITS.items()}
        return {name: (column, units.get(name, "")) for name, column in self.table.items()}

    @property
    def orbits(self) -> tuple[PeriodicOrbit, ...]:
        """The rows as orbits."""
        return tuple(orbit_of(self.pendulum, self.table, i) for i in range(len(self)))

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
        """The table as files have it, without what may be missing and says nothing."""
        return {
            column_name(key): column_values(key, column)
            for key, column in self.table.items()
            if key not in MAY_MISS or np.any(column != MAY_MISS[key])
        }

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
