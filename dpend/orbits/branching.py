"""Where families branch off: the arcs of their first orbits, made of those they leave."""

from collections.abc import Iterator
from dataclasses import replace

import jax
import numpy as np

from dpend.mechanics.pendulum import State, vector_field
from dpend.orbits.arc import PARTS, SEGMENTS
from dpend.orbits.follow import FamilyProblem, guess_arc
from dpend.orbits.newton import Solved
from dpend.orbits.samples import Place


def _unroll(problem: FamilyProblem, rows: Solved) -> tuple[np.ndarray, np.ndarray]:
    """Times and states known on half a period of an orbit: its nodes and, if it is centred, their
    images about T/4.
    """
    states = rows.point[0, : 4 * SEGMENTS].reshape(SEGMENTS, 4)
    times = np.concatenate([[0.0], np.cumsum(rows.times[0])])
    if problem.symmetry != "centred":
        return times[:-1], states
    images = states[:0:-1] * [-1, -1, 1, 1] + 2 * np.pi * np.append(problem.turns, [0, 0])
    centre = rows.end[0]
    return np.append(times, 2 * times[-1] - times[-2:0:-1]), np.vstack([states, centre, images])


def repeat_arc(problem: FamilyProblem, rows: Solved, halves: int) -> tuple[np.ndarray, np.ndarray]:
    """Times and states known on so many halves of an orbit's period."""
    times, states = _unroll(problem, rows)
    half = rows.times[0].sum() * PARTS[problem.symmetry] / 2
    all_times, all_states = [times], [states]
    for i in range(1, halves):
        if problem.symmetry in ("brake", "passing"):
            # Each rest or passage reflects time: the second half is the first, backwards, with the
            # momenta or the angles turned round.
            back = half - np.append(half, times[:0:-1])
            ends = np.vstack([rows.end[0], states[:0:-1]])
            passing = problem.symmetry == "passing"
            centre = np.pi * np.append(problem.turns, [0, 0]) if passing else np.zeros(4)
            turned = ends * [-1, -1, 1, 1] + 2 * centre if passing else ends * [1, 1, -1, -1]
            around = 2 * (centre - states[0] * [1, 1, 0, 0]) if passing else centre
            later = (back, turned) if i % 2 else (times, states)
            later = later[0], later[1] + (i // 2) * around
        else:
            opposite = 2 * np.pi * np.append(problem.turns, [0, 0]) - states
            later = (times, opposite if i % 2 else states)
        all_times.append(i * half + later[0])
        all_states.append(later[1])
    return np.concatenate(all_times), np.concatenate(all_states)


def branches_at(
    base: Place, symmetry: str, k: int
) -> Iterator[tuple[FamilyProblem, np.ndarray, np.ndarray]]:
    """The problems of the orbits of k times the period that branch off at a place, each with a
    point on the orbit there, and with how that point's first state moves along the base's family.

    Where centred orbits become less symmetric, at c = -1, there are two of them: of brake orbits
    and, from a quarter of the period later, of passing ones.
    """
    half = float(base.rows.times[0].sum()) * PARTS[base.problem.symmetry] / 2
    duration = k * half * 2 / PARTS[symmetry]
    turns = np.zeros(2) if symmetry == "brake" else np.asarray(base.problem.turns)
    if symmetry == "passing":
        centre = np.round(base.rows.point[0, :2] / np.pi)
        turns = centre + k * (turns - centre)

    def problem(symmetry: str, turns: np.ndarray) -> FamilyProblem:
        of = float(turns[0]), float(turns[1])
        return replace(base.problem, symmetry=symmetry, turns=of)

    first, moving = problem(symmetry, turns), base.rows.tangent[0, :4]
    yield first, guess_arc(first, *repeat_arc(base.problem, base.rows, k), duration), moving
    if (base.problem.symmetry, symmetry, k) == ("centred", "brake", 1):
        later = problem("passing", np.asarray(base.problem.turns))
        times, states = repeat_arc(base.problem, base.rows, 2)
        known = times[SEGMENTS:] - times[SEGMENTS], states[SEGMENTS:]
        yield later, guess_arc(later, *known, duration), _end_moves(base.problem, base.rows)


_slope = jax.jit(vector_field)


def _end_moves(problem: FamilyProblem, rows: Solved) -> np.ndarray:
    """How the state at the arc's end moves along the family."""
    moving = rows.tangent[0, :4]
    for matrix in rows.matrices[0]:
        moving = matrix @ moving
    slope = jax.tree.leaves(_slope(problem.natural, State(*rows.end[0])))
    return np.asarray(moving + np.array(slope, np.float64) * rows.time_slope[0])
