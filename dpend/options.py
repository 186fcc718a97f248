"""The options of the command line: their types, those that all share, and what their texts mean."""

import functools
import inspect
import math
import re
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import numpy as np
import typer

from dpend._version import __version__
from dpend.checks import number
from dpend.mechanics.pendulum import Pendulum, State, momenta
from dpend.orbits.orbit import BRANCHES, PeriodicOrbit
from dpend.records import parse_decimal
from dpend.report import print_json

# What a count fits in, here and in the compiled programs.
_LARGEST_INTEGER = 2**63 - 1
# Along a map's side: sixteen times what a large map has; beyond it lies a slip of the finger.
_MOST_CELLS = 65536


class _Command(typer.core.TyperCommand):
    """A command that refuses what no option can mean: one given twice, an empty text, a number that
    is not finite.
    """

    # Any: each version of typer has its own class of contexts.
    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        given, _, order = self.make_parser(ctx).parse_args(args=list(args))
        for option in self.params:
            _check_given(option, given.get(option.name or ""), sum(option is one for one in order))
        rest = super().parse_args(ctx, args)
        for option in self.params:
            _check_finite(option, ctx.params.get(option.name or ""))
        return rest


def _check_given(option: Any, value: object, times: int) -> None:
    name = max(option.opts, key=len)
    if times > 1 and not option.multiple and option.nargs == 1:
        raise ValueError(
            f"{name} must be given once at most, got it {times} times: leave out all but one"
        )
    if "" in _several(value):
        raise ValueError(f"{name} must not be empty, got '': give a value, or leave {name} out")


def _check_finite(option: Any, value: object) -> None:
    unit = re.search(r"( \[[^]]+\]|)[^]]*$", getattr(option, "help", None) or "")
    for one in _several(value):
        if isinstance(one, float) and not math.isfinite(one):
            raise ValueError(
                f"{option.name} must be a finite number{unit[1] if unit else ''}, got {one}: "
                f"give another {option.name}"
            )


def _several(value: object) -> Sequence[object]:
    return value if isinstance(value, (list, tuple)) else (value,)


def _number(text: str | float | int) -> float:  # defaults come as what they are
    if not isinstance(text, str):
        return float(text)
    if text.lower().lstrip("+-") in ("nan", "inf", "infinity"):
        return float(text)  # the command refuses it by the name of its option
    try:
        return parse_decimal(text)
    except ValueError:
        raise typer.BadParameter(
            f"{text!r:.60} is not a number: give one like 40 or 1e-3"
        ) from None


def _integer(text: str | int) -> int:
    if not isinstance(text, str):
        return text
    if not re.fullmatch(r"[+-]?\d+", text, re.ASCII):
        raise typer.BadParameter(f"{text!r:.60} is not an integer: give one like 1")
    if len(text) > 20 or abs(int(text)) > _LARGEST_INTEGER:
        raise typer.BadParameter(f"{text!r:.60} is beyond {_LARGEST_INTEGER}: give a smaller one")
    return int(text)


def numeric(*names: str, help: str) -> Any:
    return typer.Option(*names, help=help, parser=_number, metavar="NUMBER")


def counted(help: str) -> Any:
    return typer.Option(parser=_integer, metavar="INTEGER", help=help)


app = typer.Typer(
    name="dpend",
    help="The motions of a double pendulum that come back. Angles in degrees, everything else in "
    "SI units.",
    add_completion=False,
    rich_markup_mode=None,  # square brackets are units here
    pretty_exceptions_enable=False,
)


def _tell_version(asked: bool | None) -> None:
    if asked:
        typer.echo(f"dpend {__version__}")
        raise typer.Exit


_VERSION = typer.Option("--version", callback=_tell_version, is_eager=True, help="Its version.")


@app.callback()
def _commands(version: Annotated[bool | None, _VERSION] = None) -> None:
    """Keeps `dpend orbit` a subcommand."""


# The options of every command: a pendulum, and how its result is printed.
_PENDULUM = {
    "l1": (0.2, "Length of the upper rod [m]."),
    "l2": (0.2, "Length of the lower rod [m]."),
    "m1": (0.1, "Mass of the upper bob [kg]."),
    "m2": (0.1, "Mass of the lower bob [kg]."),
    "g": (9.8, "Acceleration of gravity [m/s^2]."),
}
Theta1 = Annotated[float, numeric("--theta1", help="Release angle of the upper rod [deg].")]
Omega1 = Annotated[
    float | None,
    numeric("--omega1", help="In the place of momenta: angular velocity of the upper rod [deg/s]."),
]
Omega2 = Annotated[
    float | None, numeric("--omega2", help="Of the lower rod [deg/s], with --omega1.")
]
_JSON = Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")]

# What a command hands back: its record for --json, how to print it for people, and whether all its
# solves succeeded.
Report = tuple[dict[str, Any], Callable[[], None], bool]


def _keyword(name: str, default: Any, annotation: Any) -> inspect.Parameter:
    kind = inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(name, kind, default=default, annotation=annotation)


_SHARED = [
    _keyword(name, default, Annotated[float, numeric(f"--{name}", help=text)])
    for name, (default, text) in _PENDULUM.items()
]
_SHARED.append(_keyword("as_json", False, _JSON))


def command(name: str | None = None) -> Callable[[Callable[..., Report]], Callable[..., int]]:
    """Makes a function of a pendulum and options a command, which takes the shared options too,
    prints its report, and has an exit status.
    """

    def decorate(call: Callable[..., Report]) -> Callable[..., int]:
        @functools.wraps(call)
        def run(*, as_json: bool, **given: Any) -> int:
            pendulum = Pendulum(**{key: given.pop(key) for key in _PENDULUM})
            record, show, solved = call(pendulum, **given)
            print_json(record) if as_json else show()
            return 0 if solved else 1

        own = list(inspect.signature(call).parameters.values())[1:]
        own = [option.replace(kind=inspect.Parameter.KEYWORD_ONLY) for option in own]
        run.__signature__ = inspect.Signature([*own, *_SHARED])  # type: ignore[attr-defined]
        return app.command(name=name, cls=_Command)(run)

    return decorate


def radians(name: str, degrees: float) -> float:
    return math.radians(number(name, degrees, unit="deg"))


def moving_state(
    pendulum: Pendulum,
    angles: tuple[float, float],
    of_momenta: tuple[float | None, float | None],
    rates: tuple[float | None, float | None],
) -> State:
    """The state with angles [rad] and momenta [kg m^2/s] or angular velocities [deg/s]; what is not
    given is zero.
    """
    names = ("p1", "p2", "omega1", "omega2")
    given = {
        name: value
        for name, value in zip(names, (*of_momenta, *rates), strict=True)
        if value is not None
    }
    if rates == (None, None):
        p1, p2 = (number(name, given.get(name, 0.0)) for name in names[:2])
        return State(*angles, p1, p2)
    if of_momenta != (None, None):
        raise ValueError(
            f"omega1 and omega2 exclude p1 and p2, got {' and '.join(given)}: give either"
        )
    return momenta(pendulum, *angles, *(radians(name, given.get(name, 0.0)) for name in names[2:]))


def guess_in(theta2: float | None, period: float | None) -> tuple[float, float] | None:
    """What the two options say together [rad, s]."""
    if theta2 is None and period is None:
        return None
    if theta2 is None or period is None:
        given, missing = ("theta2", "period") if period is None else ("period", "theta2")
        raise ValueError(
            f"{missing} must be given with {given}, got {given} alone: a guess is both"
        )
    return radians("theta2", theta2), number("period", period, positive=True, unit="s")


def _check_wish(branch: str | None, of_one: bool, of_both: bool) -> None:
    """Refuses a wish for no branch, and a branch without a wish for it."""
    names = f"{' or '.join(BRANCHES)}"
    if not of_one and not of_both:
        raise ValueError(
            "period, kappa or ratio must be given, got none of them: say what is wanted"
        )
    if branch is None and of_one:
        raise ValueError(f"branch must be given with period and kappa, got none: give {names}")
    if branch is not None and branch not in BRANCHES:
        raise ValueError(f"branch must be one of {', '.join(BRANCHES)}, got {branch!r}")
    if branch is not None and not of_one:
        raise ValueError(
            f"branch must go with period or kappa, got {branch!r} with ratio alone, which is of "
            f"both: leave it out"
        )


def equations_of(
    branch: str | None, period: float | None, kappa: float | None, ratio: float | None
) -> tuple[dict[str, Callable[[dict[str, PeriodicOrbit]], Any]], tuple[str, ...]]:
    """The equations of a design, each a function of the orbits by branch, and the branches whose
    orbits it takes.
    """
    _check_wish(branch, period is not None or kappa is not None, ratio is not None)
    equations: dict[str, Callable[[dict[str, PeriodicOrbit]], Any]] = {}
    if period is not None:
        seconds = float(number("period", period, positive=True, unit="s"))
        equations["period_s"] = lambda orbits: orbits[str(branch)].period - seconds
    if kappa is not None:
        middle = float(number("kappa", kappa))
        equations["kappa"] = lambda orbits: orbits[str(branch)].kappa - middle
    if ratio is not None:
        wanted = float(number("ratio", ratio, positive=True))
        equations["ratio"] = lambda orbits: (
            orbits["in-phase"].period / orbits["anti-phase"].period - wanted
        )
    return equations, BRANCHES if ratio is not None else (str(branch),)


def names_in(text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(","))
    if "" in names:
        raise ValueError(
            f"free must be names with commas between them, got {text!r}: give them like l2,m2"
        )
    return names


def bounds_in(texts: list[str]) -> dict[str, tuple[float, float]]:
    """Bounds by name, of theta1 in radians."""
    bounds = {}
    for text in texts:
        name, _, span = text.partition("=")
        refusal = f"bounds must be NAME=A:B, got {text!r}: give one like l1=0.1:0.5"
        low, high = _span_in(span, refusal)
        if name in bounds:
            raise ValueError(f"bounds must be given once a name, got {name} twice: leave one out")
        bounds[name] = (math.radians(low), math.radians(high)) if name == "theta1" else (low, high)
    return bounds


def _span_in(text: str, refusal: str) -> tuple[float, float]:
    """The two numbers of A:B."""
    try:
        low, high = (parse_decimal(part) for part in text.split(":"))
    except ValueError:
        raise ValueError(refusal) from None
    return low, high


def size_in(text: str) -> tuple[int, int]:
    sides = text.lower().split("x")
    if len(sides) > 2 or not all(
        re.fullmatch(r"[0-9]{1,99}", side) and int(side) for side in sides
    ):
        raise ValueError(
            f"size must be N or NxM with whole numbers above zero, got {text!r}: give one like "
            f"512x256"
        )
    cells = int(sides[0]), int(sides[-1])
    if max(cells) > _MOST_CELLS:
        raise ValueError(
            f"size must be at most {_MOST_CELLS} along a side, got {text!r}: map a smaller range"
        )
    return cells


def cells_in(name: str, text: str, count: int) -> np.ndarray:
    """The centres [rad] of `count` cells of a range A:B [deg]; a symmetric range is one half and
    its mirror image.
    """
    refusal = f"{name} must be a range A:B in degrees, got {text!r}: give one like -180:180"
    start, end = _span_in(text, refusal)
    if not (math.isfinite(start) and math.isfinite(end) and start < end):
        raise ValueError(
            f"{name} must be a range A:B with A below B, got {text!r}: give one like -180:180"
        )
    centres = np.radians(start + (np.arange(count) + 0.5) * ((end - start) / count))
    return 0.5 * (centres - centres[::-1]) if start == -end else centres
