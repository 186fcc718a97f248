"""What the public functions refuse, and in which words: every argument of every function, before
anything is computed.

The tests' run-time type checker would refuse some of it first, in words of its own, and users do
not have it: the table is gone through once with it and once in a process of its own without.
"""

import inspect
import math
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import ExitStack, suppress
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray

import dpend
import dpend.animate
import dpend.chaos
import dpend.plots
from dpend import Pendulum, Scheme, State
from dpend.catalogue.table import stack_tables

HUGE = 10**400
PAPER, RELEASE, FINE = Pendulum(), dpend.released(0.5, 0.7), Scheme("rk8", 1e-2)
MANY = dpend.released(np.array([0.1, 0.2]), 0.3)
TIMES = np.linspace(0.0, 1.0, 31)
ANGLES = 0.5 * np.cos(5 * TIMES)


# fmt: off --- hostile values, by what an argument is
# ---------------------------------------------------------------------------

NO_REALS = [
    None,
    True,
    np.True_,
    "1",
    b"1",
    "",
    1j,
    np.complex128(1),
    [],
    [1.0, 2.0],
    (1.0,),
    {},
    {"a": 1.0},
    set(),
    object(),
    float,
    PAPER,
    FINE,
    np.array("1"),
    np.array([1.0, 2.0], object),
    np.datetime64("2020-01-01"),
    np.timedelta64(1, "s"),
    np.array([True, False]),
    np.array(1j),
    jnp.asarray(True),
    jnp.asarray(1j),
    math.sin,
    HUGE,
    -HUGE,
    Decimal("1e400"),
    Decimal("sNaN"),
]
NO_NUMBERS = [
    *NO_REALS,
    math.nan,
    np.float64("nan"),
    np.array(np.nan),
    math.inf,
    -math.inf,
    np.float32("inf"),
]
NO_ARRAYS = [np.array([1.0, 2.0]), np.ones((1,)), np.ones((2, 2)), jnp.ones(2), np.array([1, 2])]
NOT_POSITIVE = [
    0,
    -1,
    -1.5,
    0.0,
    -0.0,
    np.float32(-1),
    np.int64(-1),
    np.array(-1.0),
    np.array(0),
    jnp.asarray(-1.0),
]
NOT_POSITIVE += [Fraction(-1, 2), Decimal(-1)]
NO_INTEGERS = [
    *NO_NUMBERS,
    *NO_ARRAYS,
    1.0,
    1.5,
    np.float64(2.0),
    jnp.asarray(1.0),
    np.array(2.0),
    Fraction(1, 2),
    Decimal(1),
    2**60,
]
NO_FLAGS = [
    None,
    "yes",
    "",
    b"no",
    0,
    1,
    1.5,
    math.nan,
    1j,
    [],
    [True],
    {},
    object(),
    np.array([True, False]),
    np.int64(1),
]
NO_CHOICES = [
    "sideways",
    "",
    b"in-phase",
    1.5,
    1j,
    [],
    ["in-phase"],
    {},
    object(),
    np.array([1.0, 2.0]),
    np.array(["a"]),
    True,
    math.nan,
    HUGE,
    np.float64(1.0),
    np.datetime64("2020-01-01"),
]
NO_TEXT = ["", b"name", 0, 1, 1.5, True, [], {}, object(), np.array([1.0, 2.0])]
NO_OBJECTS = [True, 0, 1.0, 1j, "rk8", "", b"x", [], {}, object(), math.nan, Pendulum, State]
NO_FUNCTIONS = [
    0,
    1.5,
    "print",
    "",
    b"x",
    [],
    {},
    object(),
    np.array([1.0, 2.0]),
    PAPER,
    math.nan,
    True,
]
NO_PATHS = [
    b"F.json",
    "",
    0,
    1,
    1.5,
    True,
    [],
    {},
    object(),
    np.array([1.0, 2.0]),
    "a\0b.json",
    ["F.json"],
    math.nan,
]
NO_COLUMNS = [
    True,
    "1",
    b"1",
    "angles",
    1j,
    {},
    set(),
    object(),
    [[1.0], [2.0, 3.0]],
    ["1", "2"],
    np.array(["1"]),
    [True, False],
    [1j, 2j],
    np.array([1j]),
    np.array(["2020-01-01"], "M8"),
    np.array([1, 2], "m8[s]"),
    [1.0, "2"],
    [1.0, object()],
    [HUGE, 1],
    PAPER,
    jnp.asarray([True, False]),
    math.sin,
]


def kind(hostile: list, valid: list | None = None, *, none: bool = False) -> tuple[list, list]:
    """What is refused and what is taken; `none` says that None is taken for what was not given."""
    refused = [value for value in hostile if not (none and value is None)]
    return refused, [*(valid or []), *([None] if none else [])]


HALVES = [
    0.5,
    np.float32(0.5),
    np.float64(0.5),
    np.array(0.5),
    Fraction(1, 2),
    Decimal("0.5"),
    jnp.asarray(0.5),
]
ONES = [1, np.int64(1), np.uint8(1), np.int32(1), np.array(1), jnp.asarray(1)]
NUMBER = kind(NO_NUMBERS + NO_ARRAYS, [*HALVES, *ONES, -1])
POSITIVE = kind(NO_NUMBERS + NO_ARRAYS + NOT_POSITIVE, HALVES)
MAYBE_POSITIVE = kind(NO_NUMBERS + NO_ARRAYS + NOT_POSITIVE, HALVES, none=True)
FIELD = kind(NO_NUMBERS, [*HALVES, *ONES, np.array([1.0, 2.0]), jnp.ones(2), np.array([1, 2])])
POSITIVE_FIELD = kind(
    [*NO_NUMBERS, *NOT_POSITIVE, np.array([0.1, 0.0]), jnp.asarray([0.1, -0.2])], FIELD[1]
)
COUNT = kind([*NO_INTEGERS, 0, -1, np.int64(0), np.array(-2), jnp.asarray(0)], ONES)
BUDGET = kind(COUNT[0], [10**6, np.int64(10**6), jnp.asarray(10**6)])
FLAG = kind(NO_FLAGS, [True, False, np.True_, np.False_])
PAIRS = [(0.5, 0.7), np.array([1.0, 2.0])]
PENDULUM = kind([None, RELEASE, FINE, *PAIRS, *NO_OBJECTS], [PAPER])
ONE_PENDULUM = kind(
    [*PENDULUM[0], Pendulum(l1=np.array([0.1, 0.2])), Pendulum(g=jnp.ones(2))], [PAPER]
)
STATE = kind([None, PAPER, FINE, *PAIRS, *NO_OBJECTS], [RELEASE])
ONE_STATE = kind([*STATE[0], MANY], [RELEASE])
SCHEME = kind([None, PAPER, RELEASE, "rk4", *NO_OBJECTS], [FINE])
PATH = kind([None, *NO_PATHS])
PROGRESS = kind(NO_FUNCTIONS, [len], none=True)
ANY: tuple[list, list] = ([], [])


class Door(NamedTuple):
    """A public function, a request that is right, what each argument is, and where its work
    begins.
    """

    call: Callable[..., Any]
    right: dict[str, Any]
    kinds: dict[str, tuple[list, list]]
    work: str = ""  # reached only by what passed the door; empty where the work is nothing


def watched(pendulum: Pendulum, state: State) -> Any:
    return state.theta2


def last(carry: Any, time: Any, dt: Any, state: State) -> Any:
    return state.theta2


def reach(pendulum: Pendulum, state: State, scheme: Scheme) -> dict[str, Any]:
    return {"reach": pendulum.l1 * state.theta1}


def period(orbit: Any) -> Any:
    return orbit.period - 1.0


MOTION = {"pendulum": ONE_PENDULUM, "state": ONE_STATE, "scheme": SCHEME}
QUANTITY = {"pendulum": PAPER, "state": RELEASE, "scheme": FINE, "duration": 1.0}
SAVED = dpend.Trajectory(TIMES, State(ANGLES, ANGLES, 0 * TIMES, 0 * TIMES), 0.0, 0.0, 30, 0, FINE)
ORBIT = dpend.PeriodicOrbit(
    PAPER, RELEASE, 1.0, -1.0, 0.0, 3, 0.5, -0.7, RELEASE, (0, 0), (0.0, 0.0), 0, "brake"
)
SECTION = xarray.Dataset()  # nobody computes one for this
FAMILY = object.__new__(dpend.Family)  # nobody follows one for this
for field in ("_problem", "_curve"):
    object.__setattr__(FAMILY, field, None)
EMPTY = dpend.Atlas(PAPER, 1.0, stack_tables([]), (), dpend.Coverage(0, 0, 0, 0, 0, 0))
PAIR = kind(
    [*NO_OBJECTS, (1, 2, 3), (2, 1), (math.nan, 1.0), ("1", "2"), (None, 1.0), (True, 2.0), "12"],
    [(1, 2), [0.5, math.inf], np.array([1.0, 2.0]), (-math.inf, HUGE // HUGE)],
    none=True,
)
ORBITS = kind(
    [None, RELEASE, PAPER, *NO_OBJECTS, [ORBIT], {"A": None}, {"A": RELEASE}], [{"A": ORBIT}]
)
PIXELS = kind([*COUNT[0], 63, 4097], [64, np.int64(4096)])
AXES = kind([*NO_OBJECTS, object()], none=True)
DRAWN = {
    "pendulum": PENDULUM,
    "motion": kind([None, RELEASE, PAPER, *NO_OBJECTS], [SAVED]),
    "ax": AXES,
}
BRANCH = kind(NO_CHOICES, ["in-phase", "anti-phase"], none=True)
BOTH = kind(
    [None, *NO_CHOICES[:6], *NO_CHOICES[7:], ("in-phase", "sideways"), (1,), (None,)],
    ["in-phase", ["in-phase", "anti-phase"]],
)
RELEASE_ANGLE = kind(
    [
        *(v for v in NO_NUMBERS if not isinstance(v, tuple)),
        *NOT_POSITIVE,
        4.0,
        ["1"],
        [True],
        [[1.0], [1.0, 2.0]],
    ],
    [*HALVES, [0.5], np.array([0.5])],
)
GRID = kind(
    [None, *NO_COLUMNS, [], [math.nan], [1.0, math.inf], [2.0, 1.0], [[1.0], [2.0]]],
    [
        1.0,
        [1, 2],
        np.array([1, 2]),
        jnp.asarray([0.5, 1.0]),
        (Fraction(1, 2), Decimal(1)),
        np.float32(0.5),
    ],
)
GAPS = kind(
    [*NO_COLUMNS, [], [[1.0], [2.0]], [1.0] * 31 + [2.0], TIMES + math.inf],
    [ANGLES, ANGLES.tolist(), np.float32(ANGLES), jnp.asarray(ANGLES), [*ANGLES[:-1], None]],
)

CHAOS = {**MOTION, "duration": kind([*POSITIVE[0]], HALVES)}
DOORS = {
    "Pendulum": Door(
        Pendulum, {}, dict.fromkeys(("l1", "l2", "m1", "m2"), POSITIVE_FIELD) | {"g": FIELD}
    ),
    "State": Door(
        State,
        dict.fromkeys(("theta1", "theta2", "p1", "p2"), 0.1),
        dict.fromkeys(("theta1", "theta2", "p1", "p2"), FIELD),
    ),
    "released": Door(
        dpend.released, {"theta1": 0.1, "theta2": 0.1}, {"theta1": FIELD, "theta2": FIELD}
    ),
    "momenta": Door(
        dpend.momenta,
        {"pendulum": PAPER, "theta1": 0.1, "theta2": 0.1, "omega1": 1.0, "omega2": 1.0},
        {"pendulum": PENDULUM, **dict.fromkeys(("theta1", "theta2", "omega1", "omega2"), FIELD)},
        "dpend.mechanics.pendulum.sincos",
    ),
    "energies": Door(
        dpend.energies,
        {"pendulum": PAPER, "state": RELEASE},
        {"pendulum": PENDULUM, "state": STATE},
        "dpend.mechanics.pendulum.sincos",
    ),
    "hamiltonian": Door(
        dpend.hamiltonian,
        {"pendulum": PAPER, "state": RELEASE},
        {"pendulum": PENDULUM, "state": STATE},
        "dpend.mechanics.pendulum.sincos",
    ),
    "positions": Door(
        dpend.positions,
        {"pendulum": PAPER, "state": RELEASE},
        {"pendulum": PENDULUM, "state": STATE},
        "dpend.mechanics.pendulum.sincos",
    ),
    "vector_field": Door(
        dpend.vector_field,
        {"pendulum": PAPER, "state": RELEASE},
        {"pendulum": PENDULUM, "state": STATE},
        "dpend.mechanics.pendulum.sincos",
    ),
    "velocities": Door(
        dpend.velocities,
        {"pendulum": PAPER, "state": RELEASE},
        {"pendulum": PENDULUM, "state": STATE},
        "dpend.mechanics.pendulum.sincos",
    ),
    "configure": Door(
        dpend.configure,
        {},
        {
            "devices": kind(COUNT[0], [jax.local_device_count()], none=True),
            "async_dispatch": kind(NO_FLAGS, none=True),
            "x64": kind(NO_FLAGS, [True, np.True_]),
        },
        "dpend.machine.is_running",
    ),
    "normal_modes": Door(
        dpend.normal_modes,
        {"pendulum": PAPER},
        {
            "pendulum": kind(
                [*PENDULUM[0], Pendulum(g=0.0), Pendulum(g=-1), Pendulum(g=jnp.asarray(-1.0))],
                [PAPER],
            )
        },
        "dpend.mechanics.linear._modes",
    ),
    "equilibria": Door(dpend.equilibria, {"pendulum": PAPER}, {"pendulum": kind(ONE_PENDULUM[0])}),
    "Scheme": Door(
        Scheme,
        {"name": "rk8", "step": 1e-2},
        {
            "name": kind([None, *NO_CHOICES], ["rk4", "gauss"]),
            "step": POSITIVE,
            "written_out": kind(NO_FLAGS, [True, np.False_], none=True),
        },
    ),
    "scheme_for": Door(
        dpend.scheme_for,
        {"pendulum": PAPER, "tolerance": 1e-6},
        {"pendulum": kind([*ONE_PENDULUM[0], Pendulum(g=0.0)], [PAPER]), "tolerance": POSITIVE},
    ),
    "message": Door(
        dpend.message,
        {"status": 0},
        {"status": kind([*NO_INTEGERS, -1, 99, 254], [*ONES, dpend.Status.NONFINITE, 255])},
    ),
    "flow": Door(
        dpend.flow,
        {"pendulum": PAPER, "state": RELEASE, "duration": 1.0, "scheme": FINE},
        {**MOTION, "duration": NUMBER},
        "dpend.motion.integrate._fold",
    ),
    "fold": Door(
        dpend.fold,
        {
            "update": last,
            "init": 0.0,
            "pendulum": PAPER,
            "state": RELEASE,
            "duration": 1.0,
            "scheme": FINE,
        },
        {
            **MOTION,
            "duration": NUMBER,
            "update": kind([None, *NO_FUNCTIONS], [last]),
            "init": kind(
                ["1", b"1", object(), [1.0, "2"], {"a": HUGE}, np.array(["1"]), math.sin],
                [None, 1, 1j, True, {"a": (1.0, jnp.ones(2))}, np.array([True])],
            ),
            "tangents": kind([PAPER, *NO_OBJECTS], [RELEASE], none=True),
        },
        "dpend.motion.integrate._fold",
    ),
    "simulate": Door(
        dpend.simulate,
        {"pendulum": PAPER, "state": RELEASE, "duration": 1.0, "step": 0.01},
        {
            "pendulum": ONE_PENDULUM,
            "state": ONE_STATE,
            "duration": kind([*NUMBER[0], 0, 0.0], HALVES),
            "step": kind([*POSITIVE[0][1:], 2.0, 1e-9], HALVES),
            "method": kind(
                [*NO_CHOICES, "rk8-circle-rescaled"], ["rk4", np.str_("rk8")], none=True
            ),
            "save_every": kind(COUNT[0], COUNT[1], none=True),
            "most_steps": BUDGET,
            "error": FLAG,
            "tolerance": kind(POSITIVE[0][1:]),
        },
        "dpend.motion.stepped._simulate",
    ),
    "simulate, for a tolerance": Door(
        dpend.simulate,
        {"pendulum": PAPER, "state": RELEASE, "duration": 1.0},
        {
            "pendulum": PENDULUM,
            "state": STATE,
            "duration": kind([*NUMBER[0], 0, 0.0], HALVES),
            "tolerance": MAYBE_POSITIVE,
            "most_steps": BUDGET,
        },
        "dpend.motion.simulate.one_motion",
    ),
    "simulate, at times": Door(
        dpend.simulate,
        {"pendulum": PAPER, "state": RELEASE, "times": [1.0]},
        {"times": kind(GRID[0][1:], GRID[1])},
        "dpend.motion.simulate.one_motion",
    ),
    "simulate, at ends of steps": Door(
        dpend.simulate,
        {"pendulum": PAPER, "state": RELEASE, "duration": 1.0, "save_every": 2},
        {"save_every": kind(COUNT[0][1:], COUNT[1]), "state": ONE_STATE},
        "dpend.motion.simulate.motion_at_steps",
    ),
    "reference": Door(
        dpend.reference,
        {"pendulum": PAPER, "state": RELEASE, "times": [1.0]},
        {
            "pendulum": ONE_PENDULUM,
            "state": ONE_STATE,
            "times": GRID,
            "tolerance": POSITIVE,
            "error": FLAG,
            "most_steps": BUDGET,
        },
        "dpend.motion.reference._dopri8",
    ),
    "first_crossing": Door(
        dpend.first_crossing,
        {"functions": watched, **QUANTITY},
        {
            **MOTION,
            "functions": kind([None, *NO_FUNCTIONS], [watched]),
            "duration": NUMBER,
            "direction": kind([*NO_INTEGERS, 2, -2], [-1, 0, np.int64(1)]),
        },
        "dpend.motion.events._first_crossing",
    ),
    "on_energy": Door(
        dpend.on_energy,
        {"pendulum": PAPER, "energy": 0.1, "theta1": 0.1, "theta2": 0.1, "p2": 0.0},
        {
            "pendulum": PENDULUM,
            **dict.fromkeys(("energy", "theta1", "theta2", "p2"), FIELD),
            **dict.fromkeys(("p1", "phi"), kind([0.1, "1", True], none=True)),
            "side": kind([None, *NO_CHOICES, 0, 2], [1, np.int64(-1)]),
        },
        "dpend.mechanics.surface.sincos",
    ),
    "Plane": Door(
        dpend.Plane,
        {},
        {"angle": kind([None, *NO_CHOICES], ["theta1", "theta2"]), "at": NUMBER},
    ),
    "crossings": Door(
        dpend.crossings,
        {"function": watched, "pendulum": PAPER, "state": RELEASE, "count": 2, "scheme": FINE},
        {
            **MOTION,
            "function": kind([None, *NO_FUNCTIONS], [watched]),
            "count": kind([*NO_INTEGERS, 0], [*ONES, -3, np.int64(-1)]),
            "direction": kind([*NO_INTEGERS, 2, -2], [-1, 0, np.int64(1)]),
            "most_steps": COUNT,
        },
        "dpend.motion.crossings._crossings",
    ),
    "section": Door(
        dpend.section,
        {"pendulum": PAPER, "energy": -0.2},
        {
            "pendulum": kind([*ONE_PENDULUM[0], Pendulum(g=0.0)], [PAPER]),
            "energy": kind([*NO_NUMBERS, *NO_ARRAYS, -0.6], HALVES),
            "plane": kind([PAPER, *NO_OBJECTS], [dpend.Plane("theta2")], none=True),
            "starts": COUNT,
            "count": COUNT,
            "points": kind(
                [*NO_OBJECTS, [(0.1, math.nan)], [0.1, 0.2], [(0.1, "1")]],
                [[(0.1, 0.0)], np.array([[0.1, 0.0], [0.2, 0.0]])],
                none=True,
            ),
            "scheme": kind(SCHEME[0][1:], [FINE], none=True),
            "store": kind([*NO_PATHS, "/no/such/place/s.zarr"], none=True),
            "progress": PROGRESS,
        },
        "dpend.maps.section.launches",
    ),
    "return_map": Door(
        dpend.return_map,
        {"pendulum": PAPER, "energy": -0.2, "angle": 0.1, "momentum": 0.0, "scheme": FINE},
        {
            "pendulum": ONE_PENDULUM,
            "scheme": SCHEME,
            **dict.fromkeys(("energy", "angle", "momentum"), NUMBER),
            "returns": kind([*NO_INTEGERS, 0], [*ONES, -3, np.int64(-1)]),
            "plane": kind([PAPER, *NO_OBJECTS], [dpend.Plane("theta2")], none=True),
            "side": kind([None, *NO_CHOICES, 0, 2], [1, np.int64(-1)]),
        },
        "dpend.maps.returns._come_back",
    ),
    "periodic_points": Door(
        dpend.periodic_points,
        {"pendulum": PAPER, "energy": -0.2},
        {
            "pendulum": kind([*ONE_PENDULUM[0], Pendulum(g=0.0)], [PAPER]),
            "energy": kind([*NO_NUMBERS, *NO_ARRAYS, -0.6], HALVES),
            "returns": COUNT,
            "plane": kind([PAPER, *NO_OBJECTS], [dpend.Plane("theta2")], none=True),
            "near": kind(
                [*NO_OBJECTS, [(0.1, math.nan)], [0.1, 0.2], [(0.1, "1")]],
                [[(0.1, 0.0)], np.array([[0.1, 0.0], [0.2, 0.0]])],
                none=True,
            ),
            "starts": COUNT,
            "scheme": kind(SCHEME[0][1:], [FINE], none=True),
            "progress": PROGRESS,
        },
        "dpend.maps.periodic.launches",
    ),
    "rotation_numbers": Door(
        dpend.rotation_numbers,
        {"dataset": SECTION, "centre": (0.0, 0.0)},
        {
            "dataset": kind([None, *NO_OBJECTS, SAVED]),
            "centre": kind([None, *NO_OBJECTS, (0.1, math.nan), (1.0, 2.0, 3.0), (0.1, "1")]),
        },
    ),
    "monodromy": Door(
        dpend.monodromy,
        {"pendulum": PAPER, "state": RELEASE, "period": 1.0, "scheme": FINE},
        {**MOTION, "period": NUMBER},
        "dpend.orbits.stability.transition",
    ),
    "multipliers": Door(
        dpend.multipliers,
        {"kappa": 0.5},
        {"kappa": kind(NO_REALS, [Fraction(1, 2), np.float32(0.5), jnp.asarray(0.5), math.nan])},
    ),
    "stability_class": Door(
        dpend.stability_class,
        {"kappa": 0.5},
        {"kappa": kind(NO_REALS + NO_ARRAYS, [*HALVES, math.nan, math.inf])},
    ),
    "find_orbit": Door(
        dpend.find_orbit,
        {"pendulum": PAPER, "theta1": 0.5, "branch": "in-phase"},
        {
            "pendulum": kind(
                [*ONE_PENDULUM[0], Pendulum(g=0.0), Pendulum(g=jnp.asarray(-1.0))], [PAPER]
            ),
            "theta1": kind([*NUMBER[0], 0.0, math.pi, 1e-200], [*HALVES, -1]),
            "branch": kind(NO_CHOICES),
            "symmetry": kind([*NO_CHOICES, "centred", "odd"]),
            "ratio": kind([*NO_INTEGERS[1:], 0, 2], [1, -1]),
            "crossing": COUNT,
            "turn": POSITIVE,
            "tolerance": POSITIVE,
            "max_iterations": COUNT,
            "error": FLAG,
            "guess": kind([(1.0, 1.0)]),
            "state": kind([RELEASE]),
            "period": kind([1.0]),
            "turns": kind([(0, 0)]),
            "keep": kind(["period", None]),
        },
        "dpend.orbits.find._on_branch",
    ),
    "find_orbit, from a guess": Door(
        dpend.find_orbit,
        {"pendulum": PAPER, "theta1": 0.5, "guess": (0.7, 1.0)},
        {
            "guess": kind(
                [
                    *NO_OBJECTS,
                    (1.0,),
                    (1.0, 1.0, 1.0),
                    (None, 1.0),
                    (1.0, None),
                    ("1", 1.0),
                    (1.0, -1.0),
                    (1.0, 0),
                    (math.nan, 1.0),
                    (1.0, math.inf),
                    (True, 1.0),
                    (1.0, [1.0]),
                    (MANY, 1.0),
                    (HUGE, 1.0),
                ],
                [
                    (np.float32(0.5), 1),
                    [0.5, Fraction(1)],
                    np.array([0.5, 1.0]),
                    jnp.asarray([0.5, 1.0]),
                ],
            ),
            "symmetry": kind([*NO_CHOICES, "odd"], ["brake", "centred"], none=True),
            "ratio": kind([0, 2, 1.5, True, "1"], [-1]),
        },
        "dpend.orbits.guess._near_guess",
    ),
    "find_orbit, from a state": Door(
        dpend.find_orbit,
        {"pendulum": PAPER, "state": RELEASE, "period": 1.0},
        {
            "pendulum": kind([*ONE_PENDULUM[0], Pendulum(g=0.0)], [PAPER]),
            "state": kind([*ONE_STATE[0], dpend.released(jnp.asarray(math.nan), 0.5)], [RELEASE]),
            "period": POSITIVE,
            "symmetry": kind(NO_CHOICES, ["centred", "brake", "odd", "passing", "none"], none=True),
            "turns": kind([(1, 0)]),
            "keep": kind([None, *NO_CHOICES], ["period", "energy"]),
            "theta1": kind([0.5]),
            "branch": kind(["in-phase"]),
            "guess": kind([(0.7, 1.0)]),
            "ratio": kind([1]),
            "crossing": kind([2, jnp.asarray(2), np.ones(2), "1"]),
            "turn": kind([0.2, None]),
            "tolerance": kind([1e-9]),
            "max_iterations": kind([3]),
            "error": kind([False]),
        },
        "dpend.orbits.find.orbit_through",
    ),
    "find_orbit, passing": Door(
        dpend.find_orbit,
        {"pendulum": PAPER, "state": RELEASE, "period": 1.0, "symmetry": "passing"},
        {
            "turns": kind(
                [*NO_OBJECTS, (1,), (1, 0, 0), (1, 0.5), (1, None), (1, 10**20), "10"],
                [(1, 0), [0, -2], np.array([0, 1])],
                none=True,
            ),
        },
        "dpend.orbits.find.orbit_through",
    ),
    "follow_family": Door(
        dpend.follow_family,
        {"pendulum": PAPER, "start": "in-phase"},
        {
            "pendulum": kind([*ONE_PENDULUM[0], Pendulum(g=-1.0)], [PAPER]),
            "start": kind([None, PAPER, *NO_CHOICES, *NO_OBJECTS], ["anti-phase"]),
            "longest_step": POSITIVE,
            "longest_period": kind(
                [v for v in POSITIVE[0] if v is not math.inf and str(v) != "inf"],
                [math.inf, np.float32("inf"), *HALVES],
            ),
            "most_points": kind([*COUNT[0], 1], [2, np.int64(100)]),
        },
        "dpend.orbits.continuation._from_mode",
    ),
    "Family.at": Door(
        FAMILY.at,
        {"theta1": 0.5},
        {
            "theta1": kind(
                [None, *NO_COLUMNS, [], math.nan, [0.5, math.inf], 0.0],
                [*HALVES, [0.1, 0.2], np.ones((2, 2))],
            ),
            "crossing": COUNT,
        },
        "dpend.orbits.family._points_at",
    ),
    "Family.at, an energy": Door(
        FAMILY.at,
        {"energy": -0.5},
        {
            "energy": kind(
                [*NO_COLUMNS, [], math.nan, [0.5, math.inf]],
                [*HALVES, -0.5, [0.1, 0.2], np.ones((2, 2))],
            ),
            "theta1": kind([0.5]),
        },
        "dpend.orbits.family._points_at",
    ),
    "Family.at, a period": Door(
        FAMILY.at,
        {"period": 1.0},
        {
            "period": kind(
                [*NO_COLUMNS, [], math.nan, [0.5, math.inf], 0.0, -1],
                [*HALVES, [0.9, 1.2], np.ones((2, 2))],
            ),
            "energy": kind([0.5]),
        },
        "dpend.orbits.family._points_at",
    ),
    "find_brake_orbits": Door(
        dpend.find_brake_orbits,
        {"pendulum": PAPER, "theta1": 1.0, "max_period": 1.0},
        {
            "pendulum": kind([*ONE_PENDULUM[0], Pendulum(g=0.0)], [PAPER]),
            "theta1": NUMBER,
            "max_period": kind([*POSITIVE[0], 1e3], HALVES),
            "most_steps": POSITIVE,
            "progress": PROGRESS,
        },
        "dpend.catalogue.release.foresee_steps",
    ),
    "find_orbits": Door(
        dpend.find_orbits,
        {"pendulum": PAPER, "energy": 0.0, "max_period": 0.5, "symmetry": "passing"},
        {
            "pendulum": kind([*ONE_PENDULUM[0], Pendulum(g=-1.0)], [PAPER]),
            "energy": kind([*NUMBER[0], -0.6, -1e9], [0.0, -0.5, np.float64(0.1)]),
            "max_period": kind([*POSITIVE[0], 1e9], [0.5, np.float32(0.5)]),
            "symmetry": kind([None, *NO_CHOICES, "brake"], ["passing"]),
            "most_steps": kind([*POSITIVE[0], 10], [1e9, 10**9]),
        },
        "dpend.catalogue.energy.scan_circle",
    ),
    "find_brake_families": Door(
        dpend.find_brake_families,
        {"pendulum": PAPER, "max_period": 1.0},
        {
            "pendulum": kind([*ONE_PENDULUM[0], Pendulum(g=0.0)], [PAPER]),
            "max_period": kind([*POSITIVE[0], 1e3], HALVES),
            "store": kind([*NO_PATHS, "no/such/place/F.json", "F.txt"], none=True),
            "most_steps": POSITIVE,
            "progress": PROGRESS,
        },
        "dpend.catalogue.survey.foresee_steps",
    ),
    "load_atlas": Door(
        dpend.load_atlas, {}, {"path": kind([*PATH[0], "F.txt", ".", "/no/such/F.json"])}
    ),
    "certify": Door(
        dpend.certify,
        {"orbit": ORBIT},
        {
            "orbit": kind([None, RELEASE, PAPER, *NO_OBJECTS], [ORBIT]),
            "theta1_deg": kind(
                [
                    "",
                    "x",
                    "41",
                    "1e999",
                    "28.64_7",
                    0.5,
                    True,
                    1j,
                    [],
                    {},
                    object(),
                    math.nan,
                    HUGE,
                ],
                [math.degrees(0.5), str(math.degrees(0.5))],
                none=True,
            ),
            "ratio": kind([*NO_INTEGERS, 0, 2, 1], none=True),
            "energy": kind(["", "x", "0", 0.5, True, math.nan, HUGE, [], object()], none=True),
            "digits": kind(COUNT[0], ONES, none=True),
        },
        "dpend.proofs.certify.require_flint",
    ),
    "certify_atlas": Door(
        dpend.certify_atlas,
        {"atlas": EMPTY, "store": str(Path(tempfile.gettempdir()) / "F.jsonl")},
        {
            "atlas": kind([None, ORBIT, *NO_OBJECTS], [EMPTY]),
            "store": kind([*PATH[0], "F.txt", ".", "no/such/place/F.jsonl"]),
            "digits": kind(COUNT[0], ONES, none=True),
            "processes": COUNT,
            "progress": PROGRESS,
        },
        "dpend.proofs.ledger.require_flint",
    ),
    "prove_brake_orbits": Door(
        dpend.prove_brake_orbits,
        {"pendulum": PAPER, "theta1": 1.0, "max_period": 1.0},
        {
            "pendulum": kind([*ONE_PENDULUM[0], Pendulum(g=0.0)], [PAPER]),
            "theta1": NUMBER,
            "theta1_deg": kind(["", "x", "28.64_7", 0.5, True, 1j, [], {}, object(), HUGE]),
            "max_period": kind([*POSITIVE[0], 1e3], HALVES),
            "progress": PROGRESS,
        },
        "dpend.proofs.complete.require_flint",
    ),
    "load_orbits": Door(
        dpend.load_orbits, {}, {"path": kind([*PATH[0], "F.txt", ".", "/no/such/F.json"])}
    ),
    "load_family": Door(
        dpend.load_family, {}, {"path": kind([*PATH[0], "F.txt", ".", "/no/such/F.json"])}
    ),
    "save_family": Door(
        dpend.save_family,
        {"family": FAMILY, "path": str(Path(tempfile.gettempdir()) / "F.json")},
        {
            "family": kind([None, ORBIT, *NO_OBJECTS]),
            "path": kind([*PATH[0], "F.txt", "/no/such/place/F.json"]),
        },
        "dpend.orbits.family_files.replacing",
    ),
    "save_orbits": Door(
        dpend.save_orbits,
        {"orbits": ORBIT, "path": "F.json"},
        {
            "orbits": kind([None, PAPER, *NO_CHOICES, *NO_OBJECTS]),
            "path": kind([*PATH[0], "F.txt", ".", "/no/such/F.json"]),
        },
    ),
    "load_angles": Door(dpend.load_angles, {}, {"path": PATH}),
    "Atlas.save": Door(EMPTY.save, {}, {"path": kind([*PATH[0], "F.txt", ".", "/no/such/F.json"])}),
    "Atlas.where": Door(
        EMPTY.where,
        {},
        {
            "period": PAIR,
            "energy": PAIR,
            "kappa": PAIR,
            "symmetry": kind([*NO_CHOICES[:5], *NO_CHOICES[6:]], ["brake", ["centred"]], none=True),
            "family": kind([*NO_CHOICES[:5], *NO_CHOICES[6:], "C1"], none=True),
        },
    ),
    "design_pendulum": Door(
        dpend.design_pendulum,
        {"loss": period, "pendulum": PAPER, "branch": "in-phase", "theta1": 1.0},
        {
            "loss": kind([None, *NO_FUNCTIONS], [period]),
            "pendulum": kind([*ONE_PENDULUM[0], Pendulum(g=0.0)], [PAPER]),
            "free": kind(
                [None, *NO_OBJECTS, ("l1", 1), ("l1", ["m1"]), "l9", ("l1", "l1")],
                ["l1", ["l1", "m2"], ("theta1",)],
            ),
            "branch": BOTH,
            "theta1": RELEASE_ANGLE,
            "goal": kind([None, *NO_CHOICES], ["zero", "minimum"]),
            "max_iterations": COUNT,
            "bounds": kind(
                [v for v in NO_OBJECTS if not isinstance(v, dict)]
                + [
                    {"m1": (0.1, 0.2)},
                    {"l1": 0.5},
                    {"l1": "12"},
                    {"l1": (0.1,)},
                    {"l1": (None, 1.0)},
                    {"l1": ("0.1", "1")},
                    {"l1": (True, 2.0)},
                    {"l1": (math.nan, 1.0)},
                    {"l1": (0.3, 0.4)},
                    {"l1": {0.1: 1, 0.3: 1}},
                ],
                [{"l1": (0.1, 0.5)}, {"l1": np.array([0.1, 1])}, {"l1": [Fraction(1, 10), 1]}],
                none=True,
            ),
        },
        "dpend.inverse.problem.find_orbit",
    ),
    "fit_parameters": Door(
        dpend.fit_parameters,
        {"times": TIMES, "theta1": ANGLES, "theta2": ANGLES},
        {
            "times": kind(
                [None, *NO_COLUMNS, [], TIMES[::-1], TIMES * math.nan, TIMES[:5], [TIMES]],
                [TIMES.tolist(), jnp.asarray(TIMES)],
            ),
            "theta1": GAPS,
            "theta2": GAPS,
            "pendulum": kind(ONE_PENDULUM[0][1:], [PAPER], none=True),
            "free": kind(
                [
                    None,
                    1,
                    1.5,
                    True,
                    "",
                    b"l1",
                    "l9",
                    ("l1", "l2", "g"),
                    ("m1", "m2"),
                    ("l2", "l2"),
                    [1],
                    [["l1"]],
                    np.array([1.0, 2.0]),
                    [None],
                    object(),
                    math.nan,
                ],
                ["l2", ["m2"], (), np.array(["l2"])],
            ),
            "initial": kind(
                [
                    None,
                    True,
                    1.0,
                    "1234",
                    [],
                    (None,),
                    (None,) * 5,
                    {},
                    object(),
                    {1, 2, 3, 4},
                    (None, None, "0", 0),
                    (True, None, 0, 0),
                    (None, math.inf, 0, 0),
                    (1j, 0, 0, 0),
                    (None, None, [0.0], 0),
                ],
                [(None, None, 0, np.float32(0)), [0.5, None, Fraction(1, 2), jnp.asarray(0.0)]],
            ),
            "noise": MAYBE_POSITIVE,
        },
        "dpend.inverse.fit._fit",
    ),
    "check_gradient": Door(
        dpend.check_gradient,
        {"loss": lambda x: x * x, "parameters": 0.5},
        {
            "loss": kind([None, *NO_FUNCTIONS]),
            "parameters": kind(
                [
                    None,
                    "1",
                    b"1",
                    1j,
                    True,
                    math.nan,
                    math.inf,
                    HUGE,
                    [],
                    {},
                    object(),
                    ["a"],
                    {"a": None},
                    [1.0, True],
                    np.array(["1"]),
                    np.datetime64("2020-01-01"),
                ]
            ),
            "tolerance": kind(POSITIVE[0]),
            "reverse": kind(NO_FLAGS),
            "motion": kind(
                [*NO_OBJECTS, (PAPER, RELEASE, 1.0), (None,) * 4, (PAPER, RELEASE, 1.0, "rk8")]
            ),
        },
    ),
    "gradient_horizon": Door(
        dpend.gradient_horizon,
        QUANTITY,
        {
            **MOTION,
            "scheme": kind([*SCHEME[0], Scheme("rk8-circle-rescaled", 0.01)], [FINE]),
            "duration": kind([*NUMBER[0], 0], HALVES),
            "tolerance": POSITIVE,
        },
        "dpend.motion.gradients._compare_tangents",
    ),
    "sweep": Door(
        dpend.sweep,
        {"quantity": reach, "pendulum": PAPER, "axes": {"theta1": [0.1, 0.2]}},
        {
            "client": AXES,
            "quantity": kind([None, *NO_FUNCTIONS], [reach]),
            "pendulum": ONE_PENDULUM,
            "axes": kind(
                [
                    None,
                    *NO_OBJECTS,
                    {"theta1": None},
                    {"theta1": []},
                    {"theta1": "12"},
                    {"theta1": 1.0},
                    {"theta1": [True, False]},
                    {"theta1": [1j]},
                    {"theta1": [[1.0]]},
                    {"theta1": [math.inf]},
                    {"angle": [1.0]},
                    {1: [1.0]},
                    {"l1": [-1.0]},
                    {"theta1": ["1"]},
                    {"theta1": [HUGE]},
                    {name: [1.0] for name in ("theta1", "theta2", "p1")},
                ],
                [{"theta1": np.float32([0.1])}, {"l1": [1, 2], "p1": jnp.ones(3)}],
            ),
            "at": kind(
                [v for v in NO_OBJECTS if not isinstance(v, dict)]
                + [
                    {"theta2": None},
                    {"theta2": "1"},
                    {"theta2": math.nan},
                    {"theta2": [1.0]},
                    {"theta2": True},
                    {"l1": 1.0},
                    {"theta1": 1.0},
                    {"angle": 1.0},
                ],
                [{}, {"p1": np.float32(1)}],
                none=True,
            ),
            "tolerance": MAYBE_POSITIVE,
            "mirror": FLAG,
            "error": kind(NO_CHOICES, ["half-step"], none=True),
            "name": kind(NO_TEXT, ["reach"], none=True),
            "store": kind([*NO_PATHS, "/no/such/place/m.zarr"], none=True),
            "progress": PROGRESS,
            "announce": PROGRESS,
            "most_steps": kind([*POSITIVE[0], 1e16], [1e9, np.int64(10**9), Fraction(10**9)]),
            "method": kind(["rk4"]),
            "step": kind([0.1]),
        },
        "dpend.maps.sweep.compute",
    ),
    "sweep, with a step": Door(
        dpend.sweep,
        {
            "quantity": reach,
            "pendulum": PAPER,
            "axes": {"theta1": [0.1]},
            "method": "rk4",
            "step": 0.1,
        },
        {
            "method": kind([None, *NO_CHOICES], ["rk8-circle"]),
            "step": POSITIVE,
            "tolerance": kind(POSITIVE[0][1:]),
        },
        "dpend.maps.sweep.compute",
    ),
    **{
        f"chaos.{name}": Door(getattr(dpend.chaos, name), QUANTITY, CHAOS, "dpend.chaos.fold")
        for name in ("lyapunov", "spectrum", "megno")
    },
    "chaos.flip": Door(dpend.chaos.flip, QUANTITY, CHAOS, "dpend.chaos.first_crossing"),
    "chaos.drift": Door(
        dpend.chaos.drift, QUANTITY, {**MOTION, "duration": NUMBER}, "dpend.chaos.fold"
    ),
    "chaos.maximal_lyapunov": Door(
        dpend.chaos.maximal_lyapunov,
        QUANTITY,
        {**CHAOS, "windows": kind([*COUNT[0], 2, 3, 5], [4, np.int64(20)])},
        "dpend.chaos.fold",
    ),
    "chaos.norm": Door(
        dpend.chaos.norm,
        {"pendulum": PAPER},
        {"pendulum": PENDULUM},
        "dpend.mechanics.units.fast_frequency",
    ),
    "plots.path": Door(
        dpend.plots.path,
        {"motion": SAVED},
        {"motion": DRAWN["motion"], "ax": AXES},
        "matplotlib.pyplot.subplots",
    ),
    "plots.angles": Door(
        dpend.plots.angles,
        {"motion": SAVED},
        {"motion": DRAWN["motion"], "ax": AXES},
        "matplotlib.pyplot.subplots",
    ),
    "plots.energy": Door(
        dpend.plots.energy,
        {"pendulum": PAPER, "motion": SAVED},
        DRAWN,
        "matplotlib.pyplot.subplots",
    ),
    "plots.strobe": Door(
        dpend.plots.strobe,
        {"pendulum": PAPER, "motion": SAVED},
        {**DRAWN, "every": kind(*COUNT, none=True)},
        "matplotlib.pyplot.subplots",
    ),
    "plots.orbit_sheet": Door(
        dpend.plots.orbit_sheet, {}, {"orbits": ORBITS}, "matplotlib.pyplot.subplots"
    ),
    "plots.family": Door(
        dpend.plots.family,
        {"curve": FAMILY},
        {
            "curve": kind([None, ORBIT, *NO_OBJECTS], [FAMILY]),
            "ax": AXES,
            "plane": kind([None, *NO_CHOICES], ["period"]),
        },
        "matplotlib.pyplot.subplots",
    ),
    "plots.families": Door(
        dpend.plots.families,
        {"curves": {"A": FAMILY}},
        {
            "curves": kind([None, FAMILY, *NO_OBJECTS, [FAMILY], {"A": ORBIT}], [{"A": FAMILY}]),
            "ax": AXES,
            "plane": kind([None, *NO_CHOICES], ["upright"]),
        },
        "matplotlib.pyplot.subplots",
    ),
    "plots.atlas": Door(
        dpend.plots.atlas,
        {"found": EMPTY},
        {"found": kind([None, ORBIT, *NO_OBJECTS], [EMPTY]), "ax": AXES},
        "matplotlib.pyplot.subplots",
    ),
    "plots.map_of": Door(
        dpend.plots.map_of,
        {},
        {"dataset": kind([None, *NO_OBJECTS, SAVED]), "name": ANY, "ax": ANY},
    ),
    "plots.section": Door(
        dpend.plots.section,
        {},
        {"dataset": kind([None, *NO_OBJECTS, SAVED]), "periodic": ANY, "ax": ANY},
    ),
    "plots.residuals": Door(dpend.plots.residuals, {}, {"fit": kind([None, SAVED, *NO_OBJECTS])}),
    "animate.motions_for": Door(
        dpend.animate.motions_for,
        {"pendulum": PAPER, "releases": [RELEASE], "duration": 1.0},
        {
            "pendulum": ONE_PENDULUM,
            "duration": POSITIVE,
            "speed": POSITIVE,
            "releases": kind(
                [None, RELEASE, *NO_OBJECTS[:7], *NO_OBJECTS[8:], [None], [MANY]],
                [[RELEASE], (RELEASE, RELEASE)],
            ),
        },
        "dpend.animate.simulate",
    ),
    "animate.film": Door(
        dpend.animate.film,
        {"pendulum": PAPER, "motions": [SAVED], "out": str(Path(tempfile.gettempdir()) / "F.gif")},
        {
            "pendulum": PENDULUM,
            "motions": kind([None, SAVED, *NO_OBJECTS, [None], [RELEASE]], [[SAVED]]),
            "out": kind([*PATH[0], "F.txt", "/no/such/place/F.gif"]),
            "size": PIXELS,
            "progress": PROGRESS,
        },
        "dpend.animate.joints_of",
    ),
    "animate.film_orbit": Door(
        dpend.animate.film_orbit,
        {"orbit": ORBIT, "out": str(Path(tempfile.gettempdir()) / "F.gif")},
        {
            "orbit": kind([None, RELEASE, *NO_OBJECTS], [ORBIT]),
            "out": kind([*PATH[0], "F.txt", "/no/such/place/F.gif"]),
            "speed": POSITIVE,
            "size": PIXELS,
            "progress": PROGRESS,
        },
        "dpend.animate.joints_of",
    ),
    "animate.check_request": Door(
        dpend.animate.check_request,
        {"out": str(Path(tempfile.gettempdir()) / "F.gif")},
        {"out": kind([*PATH[0], "F.txt", "/no/such/place/F.gif"]), "size": PIXELS},
    ),
    "animate.check_out": Door(
        dpend.animate.check_out, {}, {"out": kind([*PATH[0], "F.txt", "/no/such/place/F.gif"])}
    ),
}


# fmt: on --- the test
# -------------------------------------------------------------------------------------------------


class PassedError(Exception):
    """The work was reached."""


# What an error may name in the place of an argument that is made of several.
FIELDS = ("l1", "l2", "m1", "m2", "g", "theta1", "theta2", "p1", "p2")
ALSO = {
    "pendulum": FIELDS,
    "state": FIELDS,
    "releases": FIELDS,
    "axes": ("axis",),
    "at": FIELDS,
    "motion": ("pendulum", "state"),
}
ALSO_OF_A_DOOR = {("Scheme", "name"): ("method",)}


def stop(*arguments: Any, **settings: Any) -> None:
    raise PassedError


def attempt(door: Door, argument: str, value: Any) -> None:
    """The call with one argument changed, up to where its work begins."""
    request = {**door.right, argument: value}
    with ExitStack() as stack:
        if door.work:
            stack.enter_context(mock.patch(door.work, stop))
        door.call(**request)


def complaint(name: str, door: Door, argument: str, value: Any) -> str:
    """What is wrong with the way in which a value is refused; empty if nothing is."""
    case = f"{name}({argument}={type(value).__name__} {dpend.checks.shown(value)})"
    try:
        attempt(door, argument, value)
    except ValueError as error:
        text, names = (
            str(error),
            (argument, *ALSO.get(argument, ()), *ALSO_OF_A_DOOR.get((name, argument), ())),
        )
        named = any(re.search(rf"\b{re.escape(each)}\b", text) for each in names)
        mended = re.search(r"\b(got|must not hold)\b.*[:;] \w", text, re.DOTALL)
        sound = (
            type(error) is ValueError and named and mended and len(text) < 400 and "\n" not in text
        )
        return "" if sound else f"{case}: says {type(error).__name__} {text!r}"
    except PassedError:
        return f"{case}: passes"
    except Exception as error:
        return f"{case}: {type(error).__name__} {str(error)[:120]!r}"
    return f"{case}: is computed"


def resistance(name: str, door: Door, argument: str, value: Any) -> str:
    """Why a right value is not taken; empty if it is."""
    try:
        with suppress(PassedError):
            attempt(door, argument, value)
    except Exception as error:
        return f"{name}({argument}={value!r}): {type(error).__name__} {str(error)[:200]!r}"
    return ""


# One value in so many is tried where the tests are to be quick, others for each argument.
SHARE = 3


def complaints(name: str, share: int = 1) -> list[str]:
    door, found = DOORS[name], []
    for first, (argument, (refused, taken)) in enumerate(
        door.kinds.items(), start=list(DOORS).index(name)
    ):
        found += [
            complaint(name, door, argument, value) for value in refused[first % share :: share]
        ]
        found += [
            resistance(name, door, argument, value) for value in taken[first % share :: share]
        ]
    return [text for text in found if text]


def count() -> int:
    return sum(
        len(refused) + len(taken)
        for door in DOORS.values()
        for refused, taken in door.kinds.values()
    )


@pytest.mark.parametrize("name", DOORS)
@pytest.mark.parametrize("share", [SHARE, pytest.param(1, marks=pytest.mark.slow)])
def test_wrong_arguments_are_refused_in_words_and_right_ones_taken(name, share):
    assert complaints(name, share) == []


@pytest.mark.parametrize("share", [SHARE, pytest.param(1, marks=pytest.mark.slow)])
def test_without_the_type_checker(share):
    """The same table as a user meets it: in a process in which nothing else looks at arguments."""
    path = os.pathsep.join([str(Path(dpend.__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path, "MPLBACKEND": "Agg"}
    command = [sys.executable, "-W", "error", __file__, str(share)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    last_line = f"{count()} cases, 1 in {share} tried, 0 wrong\n"
    assert done.stdout == last_line, done.stdout + done.stderr
    assert count() > 5000


# Arguments that any transformation may trace, and those that derivatives may.
TRACEABLE = {
    *(("Pendulum", name) for name in ("l1", "l2", "m1", "m2", "g")),
    *((name, angle) for name in ("State", "released", "momenta") for angle in ("theta1", "theta2")),
    *(("State", momentum) for momentum in ("p1", "p2")),
    *(("momenta", rate) for rate in ("omega1", "omega2")),
    *((name, "duration") for name in ("flow", "fold")),
    ("fold", "init"),
    *(("on_energy", name) for name in ("energy", "theta1", "theta2", "p2")),
    *(("return_map", name) for name in ("energy", "angle", "momentum")),
    ("reference", "tolerance"),
    ("simulate, at times", "times"),
    ("multipliers", "kappa"),
    *(("find_orbit", name) for name in ("theta1", "turn", "tolerance", "max_iterations")),
}
DIFFERENTIABLE = TRACEABLE | {
    ("simulate", "duration"),
    ("simulate, for a tolerance", "duration"),
    ("Family.at", "theta1"),
    ("Family.at, an energy", "energy"),
    ("Family.at, a period", "period"),
    ("find_orbit, from a state", "period"),
    ("stability_class", "kappa"),
}
TRANSFORMATIONS = {
    "jit": (jax.eval_shape, TRACEABLE),
    "jvp": (lambda function, x: jax.jvp(function, (x,), (x,)), DIFFERENTIABLE),
    "vmap": (lambda function, x: jax.vmap(function)(x[None]), TRACEABLE),
}


@pytest.mark.parametrize("name", TRANSFORMATIONS)
def test_traced_arguments_pass_where_they_may_and_are_refused_in_words_elsewhere(name):
    transformed, passing = TRANSFORMATIONS[name]
    seen = set()
    for key, door in DOORS.items():
        for argument, (_, taken) in door.kinds.items():
            numbers = [value for value in taken if type(value) in (int, float)]
            if not numbers or (name == "jvp" and type(numbers[0]) is int):
                continue

            def call(x, door=door, argument=argument):
                attempt(door, argument, x)
                raise PassedError

            with pytest.raises((PassedError, ValueError)) as caught:
                transformed(call, jnp.asarray(numbers[0]))
            if caught.type is PassedError:
                seen.add((key, argument))
            else:
                caught.match(rf"\b{argument}\b.*(traced|tracing|Tracer)")
    integers = {("find_orbit", "max_iterations"), ("fold", "init")} if name == "jvp" else set()
    assert seen == passing - integers


def test_every_public_function_is_in_the_table():
    """With every argument; what the doors of a module are is what it defines without an
    underscore.
    """
    given: dict[Any, set[str]] = {}
    for door in DOORS.values():
        given.setdefault(door.call, set()).update(door.kinds)
    own = [value for value in vars(dpend).values() if inspect.isfunction(value)]
    for module in (dpend.chaos, dpend.plots, dpend.animate):
        functions = (value for value in vars(module).values() if inspect.isfunction(value))
        own += [value for value in functions if value.__module__ == module.__name__]
    public = [value for value in own if not value.__name__.startswith("_")]
    assert len(public) > 40
    for function in [*public, Pendulum, State, Scheme]:
        # Further keywords are matplotlib's, which refuses what it does not know.
        own = inspect.signature(function).parameters.values()
        names = {one.name for one in own if one.kind is not one.VAR_KEYWORD}
        unseen = names - given.get(function, set())
        assert unseen == set(), function


if __name__ == "__main__":
    share = int(sys.argv[1])
    wrong = [text for name in DOORS for text in complaints(name, share)]
    print(*wrong, f"{count()} cases, 1 in {share} tried, {len(wrong)} wrong", sep="\n")
    sys.exit(bool(wrong))
