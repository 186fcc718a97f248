"""Decimal intervals: how a proved number is printed, and what is read back."""

from fractions import Fraction
from typing import NamedTuple


class Enclosure(NamedTuple):
    """A decimal interval, midpoint +- radius; both are exact as printed."""

    midpoint: str
    radius: str

    def __str__(self) -> str:
        return f"{self.midpoint} +/- {self.radius}"

    def __float__(self) -> float:
        return float(self.midpoint)

    def contains(self, x: Fraction) -> bool:
        """Whether a rational number lies in the interval."""
        return abs(x - Fraction(self.midpoint)) <= Fraction(self.radius)


def below(x: float) -> str:
    """A short decimal that is positive and below x > 0: four digits of x less a thousandth."""
    return f"{x * (1 - 1e-3):.3e}"


def shortest(x: float) -> str:
    """The shortest decimal that reads back as a float64 number: 0.2, 40, 1e-09."""
    return repr(x).removesuffix(".0")
