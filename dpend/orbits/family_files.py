"""A family in a file, F.json: what `dpend family --out` writes and `load_family` reads.

The file is one object. `format` is 1 and `dpend_version` tells who wrote it. `points` is a list of
its orbits and `bifurcations` of its special points, for people and other programs: angles in
degrees, everything else in SI units, as the names say. `curve` is what the family is read from, in
natural units (l1, m1 and sqrt(l1/g) are one): `turns`, which close the arcs; for each orbit
`nodes`, its 66 unknowns: the states at the cuts of its arc one after another, log Delta and the
unfolding parameter, see `dpend.orbits.arc`; and `steps`, how many a segment is given; `mode` is the
same of the normal mode that the family begins in, with its tangent, or null.
"""

import os
from typing import Any

import jax
import numpy as np

from dpend._version import __version__
from dpend.checks import instance, is_traced, number, one_of, several
from dpend.mechanics.pendulum import Pendulum
from dpend.mechanics.units import natural
from dpend.orbits.arc import RELEASED_SYMMETRIES, SYMMETRIES, UNKNOWNS
from dpend.orbits.curve import Curve, curve_of
from dpend.orbits.family import Family, family_of
from dpend.orbits.follow import FamilyProblem
from dpend.orbits.newton import METRIC
from dpend.places import check_place, file_path, read_text, replacing
from dpend.records import columns, file_name, json_text, parse_json, record, units_of

# Raised when a file of before could be read wrongly.
FORMAT = 1
# How far a point of a file may be from the orbit that is found there: Newton's method moves what
# was written by rounding alone, 1e-9 at most near the upright state.
_SAME_POINT = 1e-6
# What the ends of a family are called, see `Family`.
_ENDS = (
    "normal mode", "homoclinic", "closed", "branch point", "fast rotation", "longest period",
    "lost", "unfinished",
)  # fmt: skip


def family_record(family: Family, branch: str | None) -> dict[str, Any]:
    """A family as plain numbers and text; momenta only where they are not zero."""
    rests = family.symmetry in RELEASED_SYMMETRIES
    table = columns(family, "arclength")
    table |= columns(family.orbits.state, "theta1 theta2")
    table |= columns(family.orbits, "period energy kappa log_abs_kappa error_estimate")
    table |= {} if rests else columns(family.orbits.state, "p1 p2")
    points = [dict(zip(table, row, strict=True)) for row in zip(*table.values(), strict=True)]
    return {
        "branch": branch,
        "symmetry": family.symmetry,
        "points": [point | {"symmetry": family.symmetry} for point in points],
        "bifurcations": [
            {
                **record(point, "kind arclength"),
                **record(point.orbit.state, "theta1 theta2"),
                **record(point.orbit, "period energy kappa"),
                **({} if rests else record(point.orbit.state, "p1 p2")),
            }
            for point in family.special_points
        ],
        **record(family, "ends status message"),
        "pendulum": record(jax.tree.map(lambda leaf: leaf[0], family.orbits.pendulum)),
    }


def file_record(family: Family, branch: str | None = None) -> dict[str, Any]:
    """What a file holds of a family: its record, and what it is read from."""
    head = {"format": FORMAT, "dpend_version": __version__}
    rows, curve = family._rows, family._curve
    mode = None
    if len(curve.points) > len(rows.point):
        point, tangent, steps = curve.points[0], curve.tangents[0], int(curve.steps[0])
        mode = {"nodes": point.tolist(), "tangent": tangent.tolist(), "steps": steps}
    nodes, steps = rows.point.tolist(), rows.steps.astype(int).tolist()
    turns = list(family._problem.turns)
    own = {"turns": turns, "mode": mode, "nodes": nodes, "steps": steps}
    return head | family_record(family, branch) | {"curve": own}


def save_family(family: Family | Any, path: str | os.PathLike[str] | Any) -> None:
    """Writes a family to F.json, for `load_family`, as `dpend family --out` does.

    The docstring of `dpend.orbits.family_files` has the format.

    Raises:
        ValueError: no family, or one traced by `jit`; another ending; no directory to write in.
    """
    instance("family", family, Family, "what dpend.follow_family returns")
    path = file_path("path", path)
    check_place("path", path, (".json",))
    if any(is_traced(leaf) for leaf in jax.tree.leaves(family)):
        raise ValueError("family must be known, not traced by jit: save it outside")
    with replacing(path) as draft:
        draft.write_text(json_text(file_record(family), indent=None) + "\n")


def load_family(path: str | os.PathLike[str] | Any) -> Family:
    """The family that `save_family` or `dpend family --out` wrote to F.json.

    Every orbit is solved for again, by a Newton step or two from what the file says, and the
    special points are found again: so that a file that was damaged is refused, and the family can
    do what it could when it was followed. Numbers agree to rounding.

    Raises:
        ValueError: no such file, or one that holds no family.
        RuntimeError: float64 is switched off in JAX.
    """
    path = file_path("path", path)
    if path.suffix != ".json":
        raise ValueError(f"path must end in .json, got {path}: save_family writes no others")
    try:
        return _family_in(parse_json(read_text(path)))
    except OSError as error:
        raise ValueError(
            f"path must be a file that can be read, got {path} ({error.strerror}): give another "
            f"file"
        ) from None
    except ValueError as error:
        raise ValueError(
            f"path must be a file that save_family or dpend family --out wrote, got {path} "
            f"({error}): give another file"
        ) from None


def _family_in(found: Any) -> Family:
    if not isinstance(found, dict) or not isinstance(found.get("curve"), dict):
        raise ValueError("it has no curve")
    if found.get("format") != FORMAT:
        raise ValueError(f"its format is {found.get('format')!r:.60}, this version reads {FORMAT}")
    curve, pendulum = found["curve"], _pendulum_in(found.get("pendulum"))
    turns = several("turns", curve.get("turns"), "a pair of numbers", 2)
    ends = several("ends", found.get("ends"), "a pair of names", 2)
    problem = FamilyProblem(
        pendulum=pendulum,
        natural=jax.tree.map(np.float64, natural(pendulum)),
        symmetry=one_of("symmetry", found.get("symmetry"), SYMMETRIES),
        turns=(float(number("turns", turns[0])), float(number("turns", turns[1]))),
    )
    points, steps = _numbers(curve, "nodes"), _numbers(curve, "steps")
    if points.ndim != 2 or points.shape[1] != UNKNOWNS or steps.shape != points.shape[:1]:
        raise ValueError(f"its nodes must be rows of {UNKNOWNS} numbers, with steps for each")
    rows = problem.correct(points, METRIC * _directions(points), steps)
    away = np.max(np.abs(rows.point - points) / (1 + np.abs(points)))
    if not np.all(rows.converged) or not away < _SAME_POINT:
        raise ValueError("its nodes are no orbits of its pendulum")
    whole = _from_mode(curve_of(rows), curve.get("mode"))
    first, last = (one_of("ends", end, _ENDS) for end in ends)
    return family_of(problem, rows, whole, (first, last))


def _directions(points: np.ndarray) -> np.ndarray:
    """Along the curve, from each point's neighbours: the tangent is sought on this side."""
    if len(points) < 2:
        raise ValueError("it has fewer than two orbits")
    ways = np.diff(points, axis=0)
    return np.concatenate([ways[:1], ways[:-1] + ways[1:], ways[-1:]])


def _from_mode(curve: Curve, mode: Any) -> Curve:
    """The curve with the normal mode that it begins in."""
    if not isinstance(mode, dict):
        return curve
    point, tangent = _numbers(mode, "nodes"), _numbers(mode, "tangent")
    if point.shape != (UNKNOWNS,) or tangent.shape != (UNKNOWNS,):
        raise ValueError(f"its mode must be {UNKNOWNS} numbers and a tangent of as many")
    steps = np.append(float(number("steps", mode.get("steps"))), curve.steps)
    points, tangents = np.vstack([point, curve.points]), np.vstack([tangent, curve.tangents])
    return Curve(points, tangents, steps)


def _numbers(found: dict[str, Any], key: str) -> np.ndarray:
    try:
        values = np.array(found.get(key), np.float64)
    except (TypeError, ValueError):
        values = np.array(np.nan)
    if not np.all(np.isfinite(values)):
        raise ValueError(f"{key} must be finite numbers")
    return values


def _pendulum_in(found: Any) -> Pendulum:
    if not isinstance(found, dict):
        raise ValueError("pendulum must be an object")
    names = {name: file_name(name, unit) for name, unit in units_of(Pendulum).items()}
    return Pendulum(**{name: float(number(key, found.get(key))) for name, key in names.items()})
