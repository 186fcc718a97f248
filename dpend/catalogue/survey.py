"""The whole square: every family of brake orbits up to a period.

Slices theta1 = const are scanned for all returns to rest (see `scan`), and what belongs to no known
family starts a new one, followed both ways by continuation. Each return is held against the
families' curves in (theta1, theta2, period), and each passage of a family through a slice against
the returns: neither side may have more than the other. Slices are doubled until two doublings have
shown no new family: one that was missed turns back twice between neighbouring slices, with both its
rests.
"""

import hashlib
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

import jax
import numpy as np

from dpend._runtime import require_float64
from dpend.catalogue.atlas import (
    BEYOND,
    COUNTABLE,
    MOST_SEARCH_STEPS,
    STEPS_PER_ORBIT,
    Atlas,
    Coverage,
    foresee_returns,
    is_return,
    known_budget,
    known_period,
    returns,
    stacked,
    table_of,
)
from dpend.catalogue.files import check_least, check_record, check_type
from dpend.catalogue.scan import MOTIONS_PER_WAVE, Budget, Zero
from dpend.catalogue.track import NEAR, STEP, STEPS_PER_POINT, Track, left_over, without_pairs
from dpend.checks import check_place, file_path, function, known_number
from dpend.mechanics.pendulum import Pendulum
from dpend.orbits.family import Family, follow_family
from dpend.orbits.find import find_orbit, swinging_pendulum
from dpend.orbits.orbit import PeriodicOrbit
from dpend.records import json_text, parse_json, read_text, replacing
from dpend.status import Status

# Doublings of the slices: this many to begin with, and at most so many. Slices are odd multiples of
# pi/2^(level + 1).
_FIRST_LEVELS, _MOST_LEVELS, _LEVELS_WITHOUT_NEWS = 5, 10, 2
# Intervals of theta2 that a slice's scan begins with; more where it leaves a doubt.
_INTERVALS, _MORE_INTERVALS = 128, 1024

# Families have about so many points, slices are about so many, and there are so many families to a
# wave of p: 13 for 5.7 waves of the paper's pendulum at 2 s.
_USUAL_POINTS, _USUAL_SLICES, _FAMILIES_PER_WAVE = 150, 127, 2
# Points on one side of where a family was met: the longest of the published catalogue has 188 in
# all.
_MOST_POINTS = 2000


def find_brake_families(
    pendulum: Pendulum | Any,
    *,
    max_period: Any,
    store: str | os.PathLike[str] | Any | None = None,
    most_steps: Any = MOST_SEARCH_STEPS,
    progress: Callable[[int, int, int], None] | Any | None = None,
) -> Atlas:
    """Every family of orbits released from rest with a period of at most `max_period`, on the whole
    square of angles.

    An orbit and its dual, and their mirror images, are one entry: a family is one curve of
    releases, and its dual curve, their images under theta -> -theta, and runs through an orbit
    several times are the same family.

    Arguments:
        pendulum: its fields are numbers; g positive.
        max_period: [s]. The number of families, and the time it takes, grows exponentially with it.
        store: F.json, written after every slice; a search that was stopped goes on from there.
        most_steps: time steps of all motions, 2 to 8 microseconds each on one core. A search that
            will take more is refused before it begins; one that takes more after all ends there,
            its coverage says `exhausted`, and with a store it can be taken up again.
        progress: called with slices done, slices planned so far, and families found, after every
            slice and family.
    Returns:
        Atlas, family by family, in order of arclength from the end with the shorter period.
        Families are called C1, C2 (centred) and B1, B2 (brake) in order of their shortest period,
        so that a name does not depend on how a family was found, nor on `max_period`. Their
        records: `family`, `symmetry`, `ends` as in `Family` (`longest period` where it goes on
        beyond max_period), `shortest_period_s` on it (the limit where it shrinks onto a normal
        mode) and `longest_period_s`, `special_points` with kind, arclength, release in degrees,
        period and kappa.
    Raises:
        ValueError: max_period not positive, or so long that the fast normal mode would swing 32
            times; g not positive; a traced argument; most_steps not enough; lengths, masses or g
            whose products leave the range of float64; a store made with other settings, damaged, or
            no file.
        RuntimeError: float64 is switched off in JAX.
    """
    require_float64()
    fixed = swinging_pendulum(pendulum)
    most_steps = known_number("most_steps", most_steps, positive=True)
    max_period = known_period(fixed, max_period)
    path = None if store is None else file_path("store", store)
    if progress is not None:
        function("progress", progress, "(slices done, slices planned, families)", "print")
    if path is not None:
        check_place("store", path, (".json",))
    survey = _Survey(fixed, max_period)
    record = _read_store(survey, path) if path is not None and path.exists() else None
    survey.budget = budget = known_budget(most_steps, expected_steps(fixed, max_period), max_period)
    if path is not None and record is not None:
        _resume(survey, record, path)
    for level in range(_MOST_LEVELS):
        planned = 2 ** (max(level + 1, _FIRST_LEVELS)) - 1
        if progress is not None:
            budget.tell = lambda _, planned=planned: progress(
                len(survey.slices), planned, len(survey.tracks)
            )
            budget.spend(0)
        for angle in _angles(level):
            if angle not in survey.slices and not budget.exhausted:
                survey.look_at(angle, level)
                if path is not None and angle in survey.slices:
                    _keep(survey, path)
                budget.spend(0)
        newest = max((track.level for track in survey.tracks), default=0)
        settled = level + 1 >= _FIRST_LEVELS and level - newest >= _LEVELS_WITHOUT_NEWS
        if settled or budget.exhausted:
            break
    return survey.atlas(level)


def expected_steps(pendulum: Pendulum, max_period: float) -> int:
    """The time steps that `find_brake_families` will take, roughly, from what three slices have
    before them.
    """
    seen = [
        foresee_returns(pendulum, angle, max_period)
        for level in range(2)
        for angle in _angles(level)
    ]
    waves = sum(one.waves for one in seen) / len(seen)
    motions = 2 * _INTERVALS + MOTIONS_PER_WAVE * waves
    slices = _USUAL_SLICES * motions * seen[0].rows
    families = _FAMILIES_PER_WAVE * waves * _USUAL_POINTS * STEPS_PER_POINT
    return int(min(slices + families, COUNTABLE))


def _angles(level: int) -> list[float]:
    """The slices of a level."""
    angles: list[float] = (np.pi * (2 * np.arange(2**level) + 1) / 2 ** (level + 1)).tolist()
    return angles


@dataclass
class _Slice:
    """What was found at one theta1."""

    motions: int
    rows: int
    open_cells: int
    winding: int
    degree: int
    returns: list[list[float]]
    lost: int = 0

    @property
    def doubts(self) -> int:
        return self.open_cells + self.lost + abs(self.winding - self.degree)


@dataclass
class _Survey:
    """The search so far."""

    pendulum: Pendulum
    max_period: float
    slices: dict[float, _Slice] = field(default_factory=dict)
    tracks: list[Track] = field(default_factory=list)
    budget: Budget = field(default_factory=lambda: Budget(MOST_SEARCH_STEPS))

    def look_at(self, theta1: float, level: int) -> None:
        """Scans a slice, and follows what belongs to no family yet; a slice that the budget cuts
        short is none.
        """
        result = returns(self.pendulum, theta1, self.max_period, _INTERVALS, self.budget)
        if result.open_cells or result.degree != result.winding:
            result = returns(self.pendulum, theta1, self.max_period, _MORE_INTERVALS, self.budget)
        zeros = sorted(result.zeros, key=lambda zero: zero.time)
        found = _Slice(
            result.motions, result.rows, len(result.open_cells), result.winding, result.degree,
            [[zero.theta2, 2 * zero.time] for zero in zeros],
        )  # fmt: skip
        for zero in zeros:
            if self.budget.exhausted:
                return
            if 2 * zero.time <= self.max_period and not self._known(
                theta1, zero.theta2, 2 * zero.time
            ):
                found.lost += not self._follow(theta1, zero, level)
        if not self.budget.exhausted:
            self.slices[theta1] = found

    def _known(self, theta1: float, theta2: float, period: float) -> bool:
        """Whether a return is that of a known family, run through once or several times."""
        for track in self.tracks:
            shortest = float(np.exp(np.min(track.chords[:, :, 2])))
            covers = int(period / shortest + 1e-3)
            self.budget.spend(covers * track.price)
            for cover in range(1, covers + 1):
                if track.holds(np.array([theta1, theta2, math.log(period / cover)])):
                    return True
        return False

    def _follow(self, theta1: float, zero: Zero, level: int) -> bool:
        """Follows the family of a return; whether that worked."""
        seed = theta1, zero.theta2, 2 * zero.time
        orbit = find_orbit(self.pendulum, theta1, guess=seed[1:])
        if int(orbit.status) != Status.CONVERGED or not is_return(orbit, zero):
            return False
        new = self.track(orbit, seed, level)
        self.budget.spend(STEPS_PER_ORBIT + len(new.family.arclength) * STEPS_PER_POINT)
        for i, track in enumerate(self.tracks):
            self.budget.spend(len(new.family.arclength) * track.price)
            if track.is_same(new):
                # Met where its chords were not near enough; the one that was followed further
                # stays.
                if len(new.chords) > len(track.chords):
                    self.tracks[i] = replace(new, level=track.level)
                return True
        self.tracks.append(new)
        return self._known(*seed)

    def track(self, orbit: PeriodicOrbit, seed: tuple[float, float, float], level: int) -> Track:
        longest = max(self.max_period, float(orbit.period))
        family = follow_family(
            self.pendulum,
            orbit,
            longest_step=STEP,
            longest_period=longest,
            most_points=_MOST_POINTS,
        )
        return Track.of(family, seed, level)

    def unmatched(self) -> list[tuple[float, float, float]]:
        """What is left when each slice's returns are given to the families' passages, one to one:
        the returns and the passages (theta1, theta2, period) that have no partner. Where a family
        turns back in a slice, its chords may have two passages more or less than the curve: pairs
        close together are let go.
        """
        return [
            (theta1, *one)
            for theta1, found in self.slices.items()
            for left in left_over(np.array(found.returns).reshape(-1, 2), self._passages(theta1))
            for one in without_pairs(left[left[:, 1] < self.max_period * (1 - NEAR)]).tolist()
        ]

    def _passages(self, theta1: float) -> np.ndarray:
        """(theta2, period) where families pass a slice, run through as often as the longest period
        allows.
        """
        points = [np.zeros((0, 2))]
        for track in self.tracks:
            passages = track.passages(theta1)
            if not len(passages):
                continue
            most = int(self.max_period * (1 + NEAR) / np.min(passages[:, 1]))
            points += [passages * [1, cover] for cover in range(1, most + 1)]
        every = np.concatenate(points)
        return every[every[:, 1] < self.max_period * (1 + NEAR)]

    def atlas(self, level: int) -> Atlas:
        entries = [_entry(track.family, self.max_period) for track in self.tracks]
        entries = _in_order(entries)
        numbers = {"centred": 0, "brake": 0}
        tables, records = [], []
        for table, record in entries:
            numbers[record["symmetry"]] += 1
            name = f"{record['symmetry'][0].upper()}{numbers[record['symmetry']]}"
            tables.append(table | {"family": np.full(len(table["period"]), name)})
            records.append({"family": name} | record)
        every = self.slices.values()
        unsettled = sum(level - track.level < _LEVELS_WITHOUT_NEWS for track in self.tracks)
        coverage = Coverage(
            theta2_points=sum(one.motions for one in every),
            time_points=max((one.rows for one in every), default=0),
            refinements=level,
            suspicious_cells=sum(one.doubts for one in every) + len(self.unmatched()) + unsettled,
            winding=sum(one.winding for one in every),
            degree=sum(one.degree for one in every),
            slices=len(self.slices),
            exhausted=self.budget.exhausted,
        )
        return Atlas(self.pendulum, self.max_period, stacked(tables), tuple(records), coverage)


# Families with shortest periods this near to each other, relative, as the oscillations about both
# saddles of equal rods and masses have, go by their energies there.
_TIE = 1e-6

_Entry: TypeAlias = tuple[dict[str, np.ndarray], dict[str, Any]]


def _in_order(entries: list[_Entry]) -> list[_Entry]:
    ordered: list[list[_Entry]] = []
    for entry in sorted(entries, key=lambda entry: entry[1]["shortest_period_s"]):
        period = entry[1]["shortest_period_s"]
        if ordered and period < ordered[-1][0][1]["shortest_period_s"] * (1 + _TIE):
            ordered[-1].append(entry)
        else:
            ordered.append([entry])

    def energy(entry: _Entry) -> float:
        return float(entry[0]["energy"][np.argmin(entry[0]["period"])])

    return [entry for tied in ordered for entry in sorted(tied, key=energy)]


def _shortest(table: dict[str, np.ndarray], ends: Sequence[str]) -> float:
    """The shortest period on a family, whatever its points: a parabola's between points, and where
    it shrinks onto a normal mode the limit, from which the period parts with the square of the
    swing.
    """
    period, where = table["period"], table["arclength"]
    i, last = int(np.argmin(period)), len(period) - 1
    if 0 < i < last:
        fit = np.polynomial.Polynomial.fit(where[i - 1 : i + 2], period[i - 1 : i + 2], 2)
        return float(fit(fit.deriv().roots()[0].real))
    if last > 0 and ends[0 if i == 0 else -1] == "normal mode":
        two = [i, i + 1] if i == 0 else [i, i - 1]
        angles = np.stack([table["theta1"][two], table["theta2"][two]])
        first, second = np.sum((angles - np.pi * np.round(angles / np.pi)) ** 2, axis=0)
        return float(period[i] - (period[two[1]] - period[i]) * first / (second - first))
    return float(period[i])


def _entry(family: Family, max_period: float) -> _Entry:
    """The rows of a family within the longest period, and its record; turned and mirrored into a
    standard form.
    """
    orbits = jax.tree.map(np.asarray, family.orbits)
    period = np.asarray(orbits.period)
    back = period[0] > period[-1]
    order = slice(None, None, -1) if back else slice(None)
    arclength = np.asarray(family.arclength)
    start = arclength[-1] if back else arclength[0]
    table = {
        key: column[order]
        for key, column in table_of(orbits, "", np.abs(arclength - start)).items()
    }
    least = int(np.argmin(table["period"]))
    sign = -1 if math.remainder(table["theta1"][least], 2 * math.pi) < 0 else 1
    turns = (
        np.round(sign * table["theta1"][least] / (2 * np.pi)),
        np.round(sign * table["theta2"][least] / (2 * np.pi)),
    )
    for rod, shift in zip(("1", "2"), turns, strict=True):
        for key in (f"theta{rod}", f"dual_theta{rod}"):
            table[key] = sign * table[key] - 2 * np.pi * shift
        centred = family.symmetry == "centred"
        table[f"turns{rod}"] = sign * table[f"turns{rod}"] - (2 * int(shift) if centred else 0)
    inside = table["period"] <= max_period * (1 + 1e-12)
    kept = {key: column[inside] for key, column in table.items()}
    ends = list(family.ends[::-1] if back else family.ends)
    record = {
        "symmetry": family.symmetry,
        "ends": ends,
        "status": Status(int(family.status)).name.lower(),
        "shortest_period_s": _shortest(kept, ends),
        "longest_period_s": float(kept["period"].max()),
        "special_points": [
            {
                "kind": _seen_from_the_other_end(point.kind) if back else point.kind,
                "arclength": abs(float(point.arclength - start)),
                "theta1_deg": math.degrees(
                    sign * float(point.orbit.theta1) - 2 * math.pi * turns[0]
                ),
                "theta2_deg": math.degrees(
                    sign * float(point.orbit.theta2) - 2 * math.pi * turns[1]
                ),
                "period_s": float(point.orbit.period),
                "kappa": float(point.orbit.kappa),
            }
            for point in family.special_points[order]
            if float(point.orbit.period) <= max_period
        ],
    }
    return kept, record


def _seen_from_the_other_end(kind: str) -> str:
    return {"stability_lost": "stability_gained", "stability_gained": "stability_lost"}.get(
        kind, kind
    )


# What a store says, and of what types.
_STORE = {"settings": dict, "slices": list, "families": list, "checksum": str}
_SLICE = {
    "theta1": float,
    "motions": int,
    "rows": int,
    "open_cells": int,
    "winding": int,
    "degree": int,
    "returns": list,
    "lost": int,
}
_SEED = {"seed": list, "level": int}


def _settings(survey: _Survey) -> dict[str, Any]:
    from dpend._version import __version__

    return {
        "dpend_version": __version__,
        "pendulum": {name: float(value) for name, value in vars(survey.pendulum).items()},
        "max_period": survey.max_period,
    }


def _checksum(record: dict[str, Any]) -> str:
    """Of all else in a store: a search that went on from other numbers would be wrong and not show
    it.
    """
    rest = {key: value for key, value in record.items() if key != "checksum"}
    return hashlib.sha256(json_text(rest, indent=None).encode()).hexdigest()


def _keep(survey: _Survey, path: Path) -> None:
    record: dict[str, Any] = {
        "settings": _settings(survey),
        "slices": [{"theta1": theta1} | asdict(found) for theta1, found in survey.slices.items()],
        "families": [{"seed": list(track.seed), "level": track.level} for track in survey.tracks],
    }
    with replacing(path) as draft:
        draft.write_text(json_text(record | {"checksum": _checksum(record)}) + "\n")


def _read_store(survey: _Survey, path: Path) -> dict[str, Any]:
    """What a store holds, refused unless it is of the same search and as it was written."""
    try:
        record: dict[str, Any] = parse_json(read_text(path))
        _check_store(record)
    except (OSError, ValueError) as error:
        raise _no_store(path, getattr(error, "strerror", None) or str(error)) from None
    settings, kept = _settings(survey), record["settings"]
    if kept != settings:
        wrong = next(key for key in (*settings, *kept) if kept.get(key) != settings.get(key))
        raise ValueError(
            f"store must have been made with the same settings, got {path} with {wrong} "
            f"{kept.get(wrong)!r:.200}: "
            "give another name"
        )
    try:
        _check_search(record, survey.max_period)
    except ValueError as error:
        raise _no_store(path, str(error)) from None
    return record


def _no_store(path: Path, reason: str) -> ValueError:
    return ValueError(
        f"store must be a file that find_brake_families wrote, got {path} ({reason}): give another "
        f"name"
    )


def _resume(survey: _Survey, record: dict[str, Any], path: Path) -> None:
    """Takes up the search as a store left it: families are followed again, from the same
    returns.
    """
    for i, family in enumerate(record["families"]):
        theta1, theta2, period = map(float, family["seed"])
        orbit = find_orbit(survey.pendulum, theta1, guess=(theta2, period))
        if int(orbit.status) != Status.CONVERGED:
            raise _no_store(path, f"families[{i}].seed is no orbit")
        survey.tracks.append(survey.track(orbit, (theta1, theta2, period), family["level"]))
    survey.slices |= {one.pop("theta1"): _Slice(**one) for one in record["slices"]}


def _check_store(record: Any) -> None:
    """Refuses what has not the form of a store, or was changed since it was written."""
    check_record("the store", record, _STORE)
    for i, one in enumerate(record["slices"]):
        check_record(f"slices[{i}]", one, _SLICE)
        for k, pair in enumerate(one["returns"]):
            _check_numbers(f"slices[{i}].returns[{k}]", pair, 2)
    for i, one in enumerate(record["families"]):
        check_record(f"families[{i}]", one, _SEED)
        _check_numbers(f"families[{i}].seed", one["seed"], 3)
    if record["checksum"] != _checksum(record):
        raise ValueError("it was changed since, or damaged: its checksum is another")


def _check_numbers(place: str, value: Any, count: int) -> None:
    check_type(place, value, list)
    if len(value) != count:
        raise ValueError(f"{place} must have {count} numbers, has {len(value)}")
    for number in value:
        check_type(place, number, float)


def _check_search(record: dict[str, Any], max_period: float) -> None:
    """Refuses slices that this search would not look at first, and families that none of their
    returns begins.
    """
    wanted = [angle for level in range(_MOST_LEVELS) for angle in _angles(level)]
    returns = set()
    for i, one in enumerate(record["slices"]):
        if i >= len(wanted) or one["theta1"] != wanted[i]:
            raise ValueError(
                f"slices[{i}].theta1 is {one['theta1']:.10g}, which is not the next one"
            )
        for name in ("motions", "rows", "open_cells", "lost"):
            check_least(f"slices[{i}].{name}", one[name], 0)
        for theta2, period in one["returns"]:
            if not (0 < period <= max_period * (1 + 2 * BEYOND) and abs(theta2) < 1.001 * math.pi):
                raise ValueError(
                    f"slices[{i}].returns has ({theta2:.10g}, {period:.10g}), outside of the search"
                )
            returns.add((one["theta1"], theta2, period))
    for i, one in enumerate(record["families"]):
        if tuple(one["seed"]) not in returns or not 0 <= one["level"] < _MOST_LEVELS:
            raise ValueError(f"families[{i}] begins at none of the returns")
