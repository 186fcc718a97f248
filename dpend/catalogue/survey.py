"""The whole square: every family of brake orbits up to a period.

Slices theta1 = const are scanned for all returns to rest (see `scan`), and what belongs to no known
family starts a new one, followed both ways by continuation. Each return is held against the
families' curves in (theta1, theta2, period), and each passage of a family through a slice against
the returns: neither side may have more than the other. Slices are doubled until two doublings have
shown no new family: one that was missed turns back twice between neighbouring slices, with both its
rests.
"""

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dpend._runtime import require_float64
from dpend.catalogue.atlas import Atlas, Coverage
from dpend.catalogue.entries import entry_of, in_order
from dpend.catalogue.progress import (
    MOST_LEVELS,
    Slice,
    no_store,
    read_store,
    slice_angles,
    write_store,
)
from dpend.catalogue.release import (
    COUNTABLE,
    MOST_SEARCH_STEPS,
    STEPS_PER_ORBIT,
    check_period,
    foresee_returns,
    is_return,
    make_budget,
    returns,
)
from dpend.catalogue.scan import MOTIONS_PER_WAVE, Budget, Zero
from dpend.catalogue.table import stack_tables
from dpend.catalogue.track import NEAR, STEP, STEPS_PER_POINT, Track, partnerless, without_pairs
from dpend.checks import function, known_number
from dpend.mechanics.pendulum import Pendulum
from dpend.orbits.continuation import follow_family
from dpend.orbits.find import find_orbit, swinging_pendulum
from dpend.orbits.orbit import PeriodicOrbit
from dpend.places import check_place, file_path
from dpend.status import Status

# Doublings of the slices before the search may end.
_FIRST_LEVELS = 5
# The search ends after this many doublings without a new family.
_LEVELS_WITHOUT_NEWS = 2
# Intervals of theta2 that a slice's scan begins with.
_INTERVALS = 128
# Intervals of a second scan, where the first leaves a doubt.
_MORE_INTERVALS = 1024
# Points that a family usually has, for the cost of a search.
_USUAL_POINTS = 150
# Slices that a search usually takes: seven levels.
_USUAL_SLICES = 127
# Families to a wave of p: 13 for 5.7 waves of the paper's pendulum at 2 s.
_FAMILIES_PER_WAVE = 2
# The most points on one side of where a family was met. The longest family of the published
# catalogue has 188 on both sides.
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
    max_period = check_period(fixed, max_period)
    path = None if store is None else file_path("store", store)
    if progress is not None:
        function("progress", progress, "(slices done, slices planned, families)", "print")
    if path is not None:
        check_place("store", path, (".json",))
    survey = _Survey(fixed, max_period)
    record = None
    if path is not None and path.exists():
        record = read_store(path, survey.settings)
    survey.budget = make_budget(most_steps, foresee_steps(fixed, max_period), max_period)
    if path is not None and record is not None:
        _resume(survey, record, path)
    for level in range(MOST_LEVELS):
        _search_level(survey, level, path, progress)
        if survey.budget.exhausted or survey.has_ended(level):
            break
    return survey.atlas(level)


def _search_level(
    survey: "_Survey",
    level: int,
    path: Path | None,
    progress: Callable[[int, int, int], None] | None,
) -> None:
    """Looks at the slices of a level, and keeps and tells what was found after each."""
    budget, planned = survey.budget, 2 ** (max(level + 1, _FIRST_LEVELS)) - 1
    if progress is not None:
        budget.tell = lambda _: progress(len(survey.slices), planned, len(survey.tracks))
        budget.spend(0)
    for angle in slice_angles(level):
        if angle in survey.slices or budget.exhausted:
            continue
        survey.look_at(angle, level)
        if path is not None and angle in survey.slices:
            write_store(path, survey.settings, survey.slices, survey.tracks)
        budget.spend(0)


def _resume(survey: "_Survey", record: dict[str, Any], path: Path) -> None:
    """Takes up the search as a store left it: families are followed again, from the same
    returns.
    """
    for i, family in enumerate(record["families"]):
        theta1, theta2, period = map(float, family["seed"])
        orbit = find_orbit(survey.pendulum, theta1, guess=(theta2, period))
        if int(orbit.status) != Status.CONVERGED:
            raise no_store(path, f"families[{i}].seed is no orbit")
        survey.tracks.append(survey.track(orbit, (theta1, theta2, period), family["level"]))
    survey.slices |= {one.pop("theta1"): Slice(**one) for one in record["slices"]}


def foresee_steps(pendulum: Pendulum, max_period: float) -> int:
    """The time steps that `find_brake_families` will take, roughly, from what three slices have
    before them.
    """
    seen = [
        foresee_returns(pendulum, angle, max_period)
        for level in range(2)
        for angle in slice_angles(level)
    ]
    waves = sum(one.waves for one in seen) / len(seen)
    motions = 2 * _INTERVALS + MOTIONS_PER_WAVE * waves
    slices = _USUAL_SLICES * motions * seen[0].rows
    families = _FAMILIES_PER_WAVE * waves * _USUAL_POINTS * STEPS_PER_POINT
    return int(min(slices + families, COUNTABLE))


@dataclass
class _Survey:
    """The search so far."""

    pendulum: Pendulum
    max_period: float
    slices: dict[float, Slice] = field(default_factory=dict)
    tracks: list[Track] = field(default_factory=list)
    budget: Budget = field(default_factory=lambda: Budget(MOST_SEARCH_STEPS))

    @property
    def settings(self) -> dict[str, Any]:
        """What a store must agree with."""
        from dpend._version import __version__

        return {
            "dpend_version": __version__,
            "pendulum": {name: float(value) for name, value in vars(self.pendulum).items()},
            "max_period": self.max_period,
        }

    def has_ended(self, level: int) -> bool:
        """Whether enough doublings have shown no new family."""
        newest = max((track.level for track in self.tracks), default=0)
        return level + 1 >= _FIRST_LEVELS and level - newest >= _LEVELS_WITHOUT_NEWS

    def look_at(self, theta1: float, level: int) -> None:
        """Scans a slice, and follows what belongs to no family yet; a slice that the budget cuts
        short is none.
        """
        result = returns(self.pendulum, theta1, self.max_period, _INTERVALS, self.budget)
        if result.open_cells or result.degree != result.winding:
            result = returns(self.pendulum, theta1, self.max_period, _MORE_INTERVALS, self.budget)
        zeros = sorted(result.zeros, key=lambda zero: zero.time)
        found = Slice(
            result.motions, result.rows, len(result.open_cells), result.winding, result.degree,
            [[zero.angle, 2 * zero.time] for zero in zeros],
        )  # fmt: skip
        for zero in zeros:
            if self.budget.exhausted:
                return
            if 2 * zero.time <= self.max_period and not self._belongs(
                theta1, zero.angle, 2 * zero.time
            ):
                found.lost += not self._follow(theta1, zero, level)
        if not self.budget.exhausted:
            self.slices[theta1] = found

    def _belongs(self, theta1: float, theta2: float, period: float) -> bool:
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
        seed = theta1, zero.angle, 2 * zero.time
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
        return self._belongs(*seed)

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

    def leftovers(self) -> list[tuple[float, float, float]]:
        """What is left when each slice's returns are given to the families' passages, one to one:
        the returns and the passages (theta1, theta2, period) that have no partner. Where a family
        turns back in a slice, its chords may have two passages more or less than the curve: pairs
        close together are let go.
        """
        return [
            (theta1, *one)
            for theta1, found in self.slices.items()
            for left in partnerless(np.array(found.returns).reshape(-1, 2), self._passages(theta1))
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
        entries = [entry_of(track.family, self.max_period) for track in self.tracks]
        entries = in_order(entries)
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
            suspicious_cells=sum(one.doubts for one in every) + len(self.leftovers()) + unsettled,
            winding=sum(one.winding for one in every),
            degree=sum(one.degree for one in every),
            slices=len(self.slices),
            exhausted=self.budget.exhausted,
        )
        return Atlas(self.pendulum, self.max_period, stack_tables(tables), tuple(records), coverage)
