"""What `find_orbit` refuses before it solves anything, as far as the values are known."""

import math
import sys
from typing import Any

from dpend.checks import (
    Scalar,
    at_most_one,
    known_value,
    number,
    one_of,
    several,
    shown,
    single,
)
from dpend.mechanics.pendulum import Pendulum, check_pendulum
from dpend.orbits.arc import RELEASED_SYMMETRIES
from dpend.orbits.orbit import BRANCHES


def leave_out(when: str, given: dict[str, Any], defaults: dict[str, Any]) -> None:
    """Refuses arguments that mean nothing here; None where there is no default."""
    for name, value in given.items():
        default = defaults.get(name)
        plain = isinstance(value, (bool, int, float, str))
        if value is not default and not (plain and value == default):
            raise ValueError(f"{name} must not be given {when}, got {shown(value)}: leave it out")


def check_request(
    pendulum: Pendulum | Any,
    theta1: Scalar,
    branch: Any,
    guess: Any,
    symmetry: Any,
    ratio: Any,
    crossing: int,
) -> None:
    """Refuses what cannot be asked, as far as the values are known before tracing."""
    check_pendulum(pendulum)
    _check_words(branch, guess, symmetry, ratio, crossing)
    _check_release(pendulum, theta1)
    angle1 = known_value(theta1)
    if guess is not None:
        _check_guess(guess, angle1)
    elif angle1 is not None and _multiple_of_pi(angle1):
        raise ValueError(
            f"theta1 must not be a multiple of 180 degrees on a branch, got "
            f"{math.degrees(angle1):g} degrees: "
            "the branches pass there only in equilibrium"
        )


def _check_words(branch: Any, guess: Any, symmetry: Any, ratio: Any, crossing: int) -> None:
    """Refuses unknown words, and arguments that do not go together."""
    words = ("branch", branch, BRANCHES), ("symmetry", symmetry, RELEASED_SYMMETRIES)
    for name, value, known in words:
        if value is not None:
            one_of(name, value, known)
    if ratio is not None:
        one_of("ratio", ratio, (1, -1))
    at_most_one(branch=branch, guess=guess)
    if branch is None and guess is None and ratio is None:
        raise ValueError(
            "branch must be given, or guess=(theta2, period), or ratio=1 or -1; got none of them"
        )
    if symmetry is not None and guess is None:
        raise ValueError(
            f"symmetry goes with guess, got {symmetry!r} alone: orbits on a branch are centred"
        )
    if crossing > 1 and (branch is None or ratio is not None):
        raise ValueError(f"crossing must be 1 but with branch alone, got {crossing}: leave it out")


def _check_release(pendulum: Pendulum, theta1: Scalar) -> None:
    """Refuses an angle that is none, and a pendulum that does not swing."""
    for name, value in {"theta1": theta1, **vars(pendulum)}.items():
        single(name, value)
    gravity, angle1 = known_value(pendulum.g), known_value(theta1)
    if angle1 is not None and not math.isfinite(angle1):
        raise ValueError(f"theta1 must be a finite number [rad], got {angle1}: give another theta1")
    if gravity is not None and not gravity > 0:
        raise ValueError(
            f"g must be positive for an orbit, got {gravity:g}: nothing swings back without gravity"
        )


def _check_guess(guess: Any, angle1: float | None) -> None:
    """Refuses a guess that is an equilibrium or has no period."""
    theta2, period = (known_value(value) for value in guess_of(guess))
    if period is not None and not period > 0:
        raise ValueError(f"period must be positive [s], got {period:g}: give another guess")
    if angle1 is None or theta2 is None:
        return
    if _multiple_of_pi(angle1) and _multiple_of_pi(theta2):
        raise ValueError(
            f"theta2 must not be a multiple of 180 degrees with theta1 at {math.degrees(angle1):g} "
            f"degrees, "
            f"got {math.degrees(theta2):g} degrees: that is an equilibrium"
        )


def guess_of(guess: Any) -> tuple[Scalar, Scalar]:
    """theta2 [rad] and the period [s] of a guess, checked."""
    theta2, period = several("guess", guess, "a pair (theta2, period)", 2)
    for name, value in (("theta2", theta2), ("period", period)):
        single(f"guess of {name}", value)
    return number("guess of theta2", theta2, unit="rad"), number(
        "guess of period", period, unit="s"
    )


def _multiple_of_pi(angle: float) -> bool:
    nearest = math.pi * round(angle / math.pi)
    # Below 1e-100 the products of two amplitudes leave the range of float64: that is zero, too.
    return abs(angle - nearest) <= max(4 * sys.float_info.epsilon * abs(nearest), 1e-100)
