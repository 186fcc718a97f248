"""How many digits of a number a table shows: those that every processor agrees on, and no more than
its error leaves.

Error bounds go up to one digit. A number is shown to the place of its bound's digit, which is so
far above the differences between processors that the same file comes out on each.
"""

import math


def round_up(error: float) -> float:
    """A bound with one significant digit, at or above `error`; zero stays."""
    if not (math.isfinite(error) and error > 0):
        return error
    place = math.floor(math.log10(error))
    # A bound that has one digit already keeps it, however its double is rounded.
    digit = math.ceil(error / 10.0**place * (1 - 1e-9))
    return float(f"{digit}e{place}")


def show(value: float, error: float) -> str:
    """`value` down to the decimal place of the one digit of `round_up(error)`; as it is where that
    is zero.
    """
    bound = round_up(error)
    if not (math.isfinite(bound) and bound > 0) or not math.isfinite(value):
        return f"{value:.12g}"
    decimals = -math.floor(math.log10(bound) + 1e-9)
    text = f"{round(value, decimals):.{max(decimals, 0)}f}"
    return text.removeprefix("-") if float(text) == 0 else text
