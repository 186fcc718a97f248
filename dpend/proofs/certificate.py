"""`Certificate`: what is proved of a periodic orbit, as numbers, words and JSON.

A certificate says, of a pendulum without friction whose parameters are exactly the decimals given:
released from rest at theta1, exactly the number given, and at a theta2 in the interval given, the
motion is periodic, its period is in the interval given, and so on. It assumes that python-flint,
NumPy's float64 sums and products (round to nearest, any order of summation, no Strassen) and this
code do what they say; `experiments/check_certificates.py` proves the same again by other means, but
not how far the orbit is the only one. Elliptic and hyperbolic are said of the linear equations
about the orbit. A certificate speaks of one orbit, not of whether others are missing from a list.
"""

import hashlib
from dataclasses import dataclass
from typing import Any, NamedTuple

from dpend.proofs.decimals import Enclosure
from dpend.records import json_text
from dpend.status import Status

# Of the JSON record; a change of its keys or their meaning raises it.
FORMAT = 1


# Keys of the record, and the fields that they are: the pendulum's, decimal intervals, and the rest.
_PENDULUM = ("l1_m", "l2_m", "m1_kg", "m2_kg", "g_m_s2")
_INTERVALS = {
    "theta2_deg": "theta2_deg",
    "period_s": "period",
    "energy_J": "energy",
    "kappa": "kappa",
}
_PLAIN = {
    "stability": "stability",
    "minimal": "minimal",
    "unique_theta2_deg": "unique_theta2_deg",
    "unique_period_s": "unique_period",
    "digits": "digits",
}


class Release(NamedTuple):
    """The release angle of the upper rod, exactly.

    Attributes:
        text: a decimal number.
        unit: `deg`: the decimal times pi/180. `rad`: the float64 number nearest to the decimal.
        ratio: 1 or -1 on the line theta1 = ratio theta2, where theta1 is an unknown; else 0.
    """

    text: str
    unit: str
    ratio: int = 0


class Question(NamedTuple):
    """An orbit to be proved: decimals of l1, l2, m1, m2, g, and what is known in float64."""

    pendulum: tuple[str, str, str, str, str]
    release: Release
    theta2: float
    period: float
    turns: tuple[int, int] | None


@dataclass(frozen=True)
class Certificate:
    """What is proved of a periodic orbit.

    Attributes:
        pendulum: l1, l2 [m], m1, m2 [kg], g [m/s^2] as exact decimals.
        release: theta1, exactly.
        symmetry: `centred` or `brake`; turns: theta(T/4)/pi of a centred orbit, else zeros.
        status: `PROVED`, or another value of `Status`; reason: why, else empty.
        theta2_deg, period [s], energy [J], kappa: decimal intervals that hold the true values;
            `None` where nothing is proved.
        stability: `elliptic`, `hyperbolic`, `inverse hyperbolic` or `not decided`.
        minimal: whether it is proved that the period is the minimal one and that the orbit rests
            at its two rests only.
        unique_theta2_deg, unique_period: there is no other orbit of this symmetry and these turns,
            released at theta1, with theta2 and the period both within these radii [deg, s];
            empty if not proved.
        digits: decimals of theta2 [rad] and of the arc in units of sqrt(l1/g) proved right.
        discs: how many the proof needed; seconds: its CPU time.
    """

    pendulum: tuple[str, str, str, str, str]
    release: Release
    symmetry: str
    turns: tuple[int, int]
    status: Status
    reason: str = ""
    theta2_deg: Enclosure | None = None
    period: Enclosure | None = None
    energy: Enclosure | None = None
    kappa: Enclosure | None = None
    stability: str = "not decided"
    minimal: bool = False
    unique_theta2_deg: str = ""
    unique_period: str = ""
    digits: int = 0
    discs: int = 0
    seconds: float = 0.0

    @property
    def exists(self) -> bool:
        """Whether an orbit is proved to exist."""
        return self.status in (Status.PROVED, Status.DIGITS_NOT_PROVED)

    def record(self) -> dict[str, Any]:
        """One JSON object, degrees and seconds; numbers that are exact or proved are text."""
        claim: dict[str, Any] = {
            "format": FORMAT,
            "pendulum": dict(zip(_PENDULUM, self.pendulum, strict=True)),
            "theta1": self.release._asdict(),
            "symmetry": self.symmetry,
            "turns": list(self.turns),
            "status": self.status.name.lower(),
            "reason": self.reason,
        }
        for key, name in _INTERVALS.items():
            value = getattr(self, name)
            claim[key] = None if value is None else value._asdict()
        claim |= {key: getattr(self, name) for key, name in _PLAIN.items()}
        return claim | {"identifier": identifier_of(claim), "discs": self.discs}

    @property
    def identifier(self) -> str:
        """Of the claim, as `record` and the rows of an atlas have it."""
        return str(self.record()["identifier"])

    def statement(self) -> str:
        """What is proved, in words."""
        if not self.exists:
            return f"{self.status.sentence} {self.reason}".strip()
        unit = "deg" if self.release.unit == "deg" else "rad (the float64 number)"
        start = f"theta1 = {self.release.text} {unit}"
        if self.release.ratio:
            start = "theta1 = " + ("theta2" if self.release.ratio == 1 else "-theta2")
        sentences = [
            f"Proved: released from rest at {start} and a theta2 in {self.theta2_deg} deg, a "
            f"pendulum with exactly {_values(self.pendulum)} moves periodically with a period in "
            f"{self.period} s.",
            _TURNS[self.symmetry].format(*self.turns),
        ]
        if self.minimal:
            sentences.append("This period is minimal, and the motion rests only at 0 and T/2.")
        if self.unique_period:
            sentences.append(
                "There is no other such orbit with theta2 within "
                f"{self.unique_theta2_deg} deg of it and the period within {self.unique_period} s."
            )
        return " ".join(
            [
                *sentences,
                f"Its energy is in {self.energy} J, its kappa in {self.kappa}: {self.stability}.",
            ]
        )


_TURNS = {
    "centred": "At T/4 the angles are pi times {} and {}.",
    "brake": "At T/2 it is at rest again.",
}


def _values(pendulum: tuple[str, ...]) -> str:
    units = ("m", "m", "kg", "kg", "m/s^2")
    names = ("l1", "l2", "m1", "m2", "g")
    return ", ".join(f"{n} = {x} {u}" for n, x, u in zip(names, pendulum, units, strict=True))


def identifier_of(claim: dict[str, Any]) -> str:
    """The first 16 hexadecimal digits of SHA-256 of the claim: a changed digit is noticed."""
    return hashlib.sha256(json_text(claim, None).encode()).hexdigest()[:16]


def read_certificate(record: Any) -> Certificate:
    """The certificate that a record says.

    Raises:
        ValueError: it is no such record, or was changed since it was written.
    """
    try:
        claim = {key: record[key] for key in record if key not in ("identifier", "discs")}
        if record["format"] != FORMAT or record["identifier"] != identifier_of(claim):
            raise ValueError("its identifier is not that of its content")
        intervals: dict[str, Any] = {
            name: None if record[key] is None else Enclosure(**record[key])
            for key, name in _INTERVALS.items()
        }
        return Certificate(
            pendulum=tuple(record["pendulum"][name] for name in _PENDULUM),
            release=Release(**record["theta1"]),
            symmetry=record["symmetry"],
            turns=(record["turns"][0], record["turns"][1]),
            status=Status[record["status"].upper()],
            reason=record["reason"],
            discs=record["discs"],
            **intervals,
            **{name: record[key] for key, name in _PLAIN.items()},
        )
    except (AttributeError, IndexError, KeyError, TypeError) as error:
        raise ValueError(f"it is no certificate ({error})") from None
