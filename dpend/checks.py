"""What is refused at the door: bad arguments, with one error text for each kind."""

import math
import reprlib
from collections.abc import Sequence
from decimal import Decimal
from numbers import Integral, Number, Real
from typing import Any, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from dpend._runtime import require_float64

# A float64 scalar, or an array where a class holds many at once; transformations also pass tracers
# and placeholders.
Scalar: TypeAlias = Any
Choice = TypeVar("Choice", str, int)

# Beyond it float64, in which lanes are counted, has no neighbouring integers.
_LARGEST_INTEGER = 2**53
# Characters of a value that an error shows.
_LONGEST = 80
_SHORTENED = reprlib.Repr()
_SHORTENED.maxstring = _SHORTENED.maxother = _LONGEST


def shown(value: Any) -> str:
    """A value as errors show it: short, on one line, whatever it is."""
    if isinstance(value, (float, np.generic, np.ndarray, jax.Array)) and not is_traced(value):
        text = str(value)
        if np.ndim(value):
            text = np.array2string(np.asarray(value), threshold=6, edgeitems=2)
    else:
        try:
            text = _SHORTENED.repr(value)
        except ValueError:  # an integer of more digits than Python writes
            text = f"a value of type {type(value).__name__}"
    text = " ".join(text.split())
    return text if len(text) <= _LONGEST else text[: _LONGEST - 3] + "..."


def is_traced(value: Any) -> bool:
    """Whether a value is traced by a transformation of JAX."""
    return isinstance(value, jax.core.Tracer)


def real(name: str, value: Any, *, wanted: str = "a real number") -> Any:
    """A number as float64, NaN and infinity as they are; an array, also a traced one, as an array
    of float64.

    Raises:
        ValueError: anything else: text, complex numbers, booleans, None, lists, integers beyond the
            range of float64.
    """
    if isinstance(value, float):  # the usual one, NumPy's float64 among them
        return np.float64(value)
    if isinstance(value, (Real, Decimal)) and not isinstance(value, (bool, np.timedelta64)):
        return _to_float64(name, value, wanted)
    if not isinstance(value, (np.ndarray, jax.Array, jax.ShapeDtypeStruct)) and hasattr(
        value, "__array__"
    ):
        value = np.asarray(value)  # of another library
    kind = getattr(value, "dtype", None)
    if not _is_real_type(kind):
        raise ValueError(f"{name} must be {wanted}, got {shown(value)}: give a number")
    if isinstance(value, np.ndarray):
        return value.astype(np.float64, copy=False) if value.ndim else np.float64(value)
    if kind != np.float64 and isinstance(value, jax.Array):
        require_float64()
        return value.astype(np.float64)
    return value


def _is_real_type(kind: Any) -> bool:
    """Whether a type of arrays holds real numbers, also floats of JAX that NumPy does not have."""
    return kind is not None and (
        bool(jnp.issubdtype(kind, np.floating)) or np.dtype(kind).kind in "iu"
    )


def _to_float64(name: str, value: Any, wanted: str) -> np.float64:
    """An integer, a fraction or a decimal number as float64."""
    try:
        known = float(value)
        beyond = math.isinf(known) and value != known
    except (OverflowError, ValueError):  # the latter for a NaN that decimal arithmetic signals
        beyond = True
    if beyond:
        raise ValueError(f"{name} must be {wanted}, got {shown(value)}: give one below 1.8e308")
    return np.float64(known)


def number(name: str, value: Any, *, positive: bool = False, unit: str = "") -> Any:
    """A finite number as float64; an array, also a traced one, as an array of float64.

    Single numbers are checked wherever they are known; arrays only for being positive. In an array
    a NaN may stand for a value that is not known.

    Raises:
        ValueError: as `real`; NaN or an infinity; with `positive` what is not above zero.
    """
    wanted = f"a finite {'positive ' if positive else ''}number" + (f" [{unit}]" if unit else "")
    value = real(name, value, wanted=wanted)
    unknown = isinstance(value, jax.ShapeDtypeStruct) or is_traced(value)
    if unknown or (value.ndim and not positive):
        return value
    if value.ndim:
        wrong = bool(np.any(np.asarray(value) <= 0))
    else:
        wrong = not math.isfinite(value) or (positive and float(value) <= 0)
    if wrong:
        raise ValueError(f"{name} must be {wanted}, got {shown(value)}: give another {name}")
    return value


def coordinate(name: str, value: Any, *, unit: str) -> Any:
    """A coordinate of a state as float64: a finite number, or an array that JAX has computed.

    Such an array may hold NaN: where a motion was lost, its end is NaN, and the status of what
    starts there says so.

    Raises:
        ValueError: as `number`.
    """
    return real(name, value) if isinstance(value, jax.Array) else number(name, value, unit=unit)


def single(name: str, value: Any) -> None:
    """Refuses an array where one number is meant.

    Raises:
        ValueError: the value has a shape.
    """
    if np.ndim(value):
        raise ValueError(
            f"{name} must be a scalar, got shape {np.shape(value)}: map over many with jax.vmap"
        )


def one_shape(**values: Any) -> None:
    """Refuses arrays that do not go together.

    Raises:
        ValueError: shapes that differ and do not broadcast.
    """
    shapes = [np.shape(value) for value in values.values()]
    if not any(shapes):
        return
    try:
        np.broadcast_shapes(*shapes)
    except ValueError:
        names, each = ", ".join(values), ", ".join(map(str, shapes))
        raise ValueError(
            f"{names} must have one shape, got {each}: give numbers or arrays of one shape"
        ) from None


def known_value(value: Any) -> float | None:
    """The number behind `value`, also under eager differentiation; None where it is traced."""
    if not is_traced(value):
        return float(value)
    try:
        return float(lax.stop_gradient(value))
    except jax.errors.ConcretizationTypeError:
        return None


def known_real(name: str, value: Any, *, unit: str = "") -> float:
    """The number of an argument that decides what is computed, NaN and infinity as they are.

    Raises:
        ValueError: as `real`; an array, or a value traced by `jit` or a derivative.
    """
    value = real(name, value, wanted="a number" + (f" [{unit}]" if unit else ""))
    single(name, value)
    if is_traced(value):
        raise ValueError(
            f"{name} must be a number here, not traced by jit or a derivative, got {shown(value)}: "
            f"give a number"
        )
    return float(value)


def known_number(name: str, value: Any, *, positive: bool = False, unit: str = "") -> float:
    """The finite number of an argument that decides what is computed; it has no derivative.

    Raises:
        ValueError: as `number`; an array, or a value traced by `jit` or a derivative.
    """
    return known_real(name, number(name, value, positive=positive, unit=unit), unit=unit)


def integer(name: str, value: Any, *, least: int = 1) -> int:
    """An integer of at least `least`: Python's, NumPy's, or an array of a single one.

    Raises:
        ValueError: anything else, also floats, booleans, traced values and what no loop counts to.
    """
    given = value
    if isinstance(value, (np.ndarray, jax.Array)) and not is_traced(value) and np.ndim(value) == 0:
        value = np.asarray(value)[()]
    whole = _is_whole(value)
    if not whole or not least <= value <= _LARGEST_INTEGER:
        span = f"of at least {least}" + (" and at most 2^53" if whole and value > least else "")
        raise ValueError(
            f"{name} must be an integer {span}, got {shown(given)}: give one like {least}"
        )
    return int(value)


def _is_whole(value: Any) -> bool:
    """Whether a value is an integer; Python counts booleans among them, NumPy spans of time."""
    return isinstance(value, Integral) and not isinstance(value, (bool, np.timedelta64))


def numbers(name: str, values: Any, *, unit: str = "", gaps: bool = False) -> np.ndarray:
    """An array of known numbers as float64, of any shape; NaN passes. With `gaps` None does too,
    and becomes NaN.

    Raises:
        ValueError: text, complex numbers, booleans or dates among them; rows of different lengths;
            a traced array.
    """
    wanted = "numbers" + (f" [{unit}]" if unit else "")
    try:
        array = np.asarray(values)
        if array.dtype == object:  # integers beyond 64 bits, fractions, gaps
            cells = (math.nan if gaps and x is None else real(name, x) for x in array.ravel())
            array = np.array([*cells], np.float64).reshape(array.shape)
    except (TypeError, ValueError):
        array = np.empty(0, object)
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{name} must be {wanted}, got {shown(values)}: give an array of numbers")
    return array.astype(np.float64)


def arrays(name: str, tree: Any) -> None:
    """Refuses a tree with a leaf that is no number and no array of numbers. Complex numbers and
    booleans count as numbers.

    Raises:
        ValueError: text, objects, or integers beyond the range of float64 among its leaves.
    """
    for leaf in jax.tree.leaves(tree):
        kind = getattr(leaf, "dtype", None)
        good = isinstance(leaf, Number) or (kind is not None and np.dtype(kind).kind not in "OSUMm")
        if not good:
            raise ValueError(
                f"{name} must be a tree of numbers and arrays, got {shown(leaf)} in it: give "
                f"numbers"
            )
        if kind is None and not isinstance(leaf, (complex, bool)):
            real(name, leaf)


def flag(name: str, value: Any) -> bool:
    """True or False.

    Raises:
        ValueError: anything else: text such as "no" would count as true.
    """
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name} must be True or False, got {shown(value)}: give one of them")
    return bool(value)


def one_of(name: str, value: Any, allowed: Sequence[Choice]) -> Choice:
    """One of some names or integers.

    Raises:
        ValueError: anything else.
    """
    for choice in allowed:
        if (_is_whole(value) or isinstance(value, str)) and value == choice:
            return choice
    words = [str(choice) for choice in allowed]
    if allowed and not isinstance(allowed[0], str):
        listed = ", ".join(words[:-1]) + f" or {words[-1]}"
    else:
        listed = f"one of {', '.join(words) or 'none'}"
    raise ValueError(f"{name} must be {listed}, got {shown(value)}: give one of them")


def at_most_one(**given: Any) -> None:
    """Refuses arguments that exclude each other; None is one that was not given.

    Raises:
        ValueError: more than one was given.
    """
    names = [name for name, value in given.items() if value is not None]
    if len(names) > 1:
        both, values = " and ".join(names), " and ".join(shown(given[name]) for name in names)
        raise ValueError(f"{both} exclude each other, got {values}: give one of them")


def text(name: str, value: Any) -> str:
    """Text that is not empty.

    Raises:
        ValueError: anything else.
    """
    if not isinstance(value, str) or not value:
        raise ValueError(f'{name} must be text, got {shown(value)}: give one like "reach"')
    return value


def several(name: str, value: Any, form: str, count: int) -> tuple[Any, ...]:
    """So many values in order: a tuple, a list or an array, also a traced one.

    Raises:
        ValueError: another number of them, or something without an order; `form` shows what is
            meant.
    """
    if isinstance(value, (np.ndarray, jax.Array)):
        ordered = value.ndim > 0
    else:
        ordered = isinstance(value, Sequence) and not isinstance(value, (str, bytes))
    if not ordered or len(value) != count:
        got = f"{len(value)} values, {shown(value)}" if ordered else shown(value)
        raise ValueError(f"{name} must be {form}, got {got}: give {count} values")
    return tuple(value)


def instance(name: str, value: Any, kind: type, fix: str) -> None:
    """Refuses what is not of a class.

    Raises:
        ValueError: another class; `fix` tells how to make one.
    """
    if not isinstance(value, kind):
        article = "an" if kind.__name__[0] in "AEIOU" else "a"
        raise ValueError(
            f"{name} must be {article} {kind.__name__}, got {shown(value)}: give {fix}"
        )


def function(name: str, value: Any, of: str, like: str) -> None:
    """Refuses what cannot be called; `of` tells its arguments, `like` is an example.

    Raises:
        ValueError: no function.
    """
    if not callable(value):
        raise ValueError(
            f"{name} must be a function of {of}, got {shown(value)}: give one like {like}"
        )
