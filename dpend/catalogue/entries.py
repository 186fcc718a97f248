"""Families as entries of an atlas: rows and a record in a standard form, in order of period."""

import math
from collections.abc import Sequence
from typing import Any, TypeAlias

import jax
import numpy as np

from dpend.catalogue.table import table_of
from dpend.orbits.family import Family
from dpend.orbits.special import SpecialPoint
from dpend.status import Status

# Families are tied if their shortest periods are this near, relative, as the oscillations about
# both saddles of equal rods and masses are. The energy of the shortest orbit then orders them.
_TIE = 1e-6
# What a special point is called from the family's other end.
_REVERSE = {"stability_lost": "stability_gained", "stability_gained": "stability_lost"}

Entry: TypeAlias = tuple[dict[str, np.ndarray], dict[str, Any]]


def in_order(entries: list[Entry]) -> list[Entry]:
    ordered: list[list[Entry]] = []
    for entry in sorted(entries, key=lambda entry: entry[1]["shortest_period_s"]):
        period = entry[1]["shortest_period_s"]
        if ordered and period < ordered[-1][0][1]["shortest_period_s"] * (1 + _TIE):
            ordered[-1].append(entry)
        else:
            ordered.append([entry])

    def energy(entry: Entry) -> float:
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


def entry_of(family: Family, max_period: float) -> Entry:
    """The rows of a family within the longest period, and its record, both in a standard form: from
    the end with the shorter period, with the shortest orbit's release in the square and theta1 of
    it positive.
    """
    period = np.asarray(family.orbits.period)
    back = bool(period[0] > period[-1])
    order = slice(None, None, -1) if back else slice(None)
    arclength = np.asarray(family.arclength)
    start = arclength[-1] if back else arclength[0]
    orbits = jax.tree.map(np.asarray, family.orbits)
    whole = {k: v[order] for k, v in table_of(orbits, "", np.abs(arclength - start)).items()}
    table, sign, turns = _in_the_square(whole, family.symmetry)
    inside = table["period"] <= max_period * (1 + 1e-12)
    table = {key: column[inside] for key, column in table.items()}
    ends = list(family.ends[::-1] if back else family.ends)
    points = [p for p in family.special_points[order] if float(p.orbit.period) <= max_period]
    record = {
        "symmetry": family.symmetry,
        "ends": ends,
        "status": Status(int(family.status)).name.lower(),
        "shortest_period_s": _shortest(table, ends),
        "longest_period_s": float(table["period"].max()),
        "special_points": [_special_record(p, back, float(start), sign, turns) for p in points],
    }
    return table, record


def _in_the_square(
    table: dict[str, np.ndarray], symmetry: str
) -> tuple[dict[str, np.ndarray], int, np.ndarray]:
    """A table mirrored and turned into the square; the sign of the mirror, and the turns taken off
    each rod.
    """
    least = int(np.argmin(table["period"]))
    sign = -1 if math.remainder(table["theta1"][least], 2 * math.pi) < 0 else 1
    angles = np.array([table["theta1"][least], table["theta2"][least]])
    turns = np.round(sign * angles / (2 * np.pi))
    table = dict(table)
    for rod, shift in zip(("1", "2"), turns, strict=True):
        for key in (f"theta{rod}", f"dual_theta{rod}"):
            table[key] = sign * table[key] - 2 * np.pi * shift
        half_turns = 2 * int(shift) if symmetry == "centred" else 0
        table[f"turns{rod}"] = sign * table[f"turns{rod}"] - half_turns
    return table, sign, turns


def _special_record(
    point: SpecialPoint, back: bool, start: float, sign: int, turns: np.ndarray
) -> dict[str, Any]:
    """A special point's record; `back`: whether the family is listed from its other end."""
    theta1, theta2 = float(point.orbit.theta1), float(point.orbit.theta2)
    return {
        "kind": _REVERSE.get(point.kind, point.kind) if back else point.kind,
        "arclength": abs(float(point.arclength - start)),
        "theta1_deg": math.degrees(sign * theta1 - 2 * math.pi * turns[0]),
        "theta2_deg": math.degrees(sign * theta2 - 2 * math.pi * turns[1]),
        "period_s": float(point.orbit.period),
        "kappa": float(point.orbit.kappa),
    }
