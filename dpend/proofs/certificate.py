"""`Certificate`: what is proved of a periodic orbit, as numbers, words and JSON.

A certificate says, of a pendulum without friction whose parameters are exactly the decimals given:
released from rest at theta1, exactly the number given, and at a theta2 in the interval given, the
motion is periodic, its period is in the interval given, and so on. Of an orbit that never rests it
says the same of a start with exactly the energy and angles given. It assumes that python-flint,
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


# Keys of the record, and the fields that they are: the pendulum's, decimal intervals, and the rest;
# of a release from rest, and of an orbit that never rests.
_PENDULUM = ("l1_m", "l2_m", "m1_kg", "m2_kg", "g_m_s2")
_INTERVALS = {
    "theta2_deg": "theta2_deg",
    "period_s": "period",
    "energy_J": "energy",
    "kappa": "kappa",
}
_MOVING_INTERVALS = {
    "theta1_deg": "theta1_deg",
    "theta2_deg": "theta2_deg",
    "p1_kg_m2_s": "p1",
    "p2_kg_m2_s": "p2",
    "period_s": "period",
    "kappa": "kappa",
}
_PLAIN = {
    "stability": "stability",
    "minimal": "minimal",
    "unique_theta2_deg": "unique_angle_deg",
    "unique_period_s": "unique_period",
    "digits": "digits",
}
_MOVING_PLAIN = {
    "stability": "stability",
    "minimal": "minimal",
    "unique_angle_deg": "unique_angle_deg",
    "unique_momentum_kg_m2_s": "unique_momentum",
    "unique_period_s": "unique_period",
    "digits": "digits",
}


# By whether the orbit never rests.
_KEYS = (_INTERVALS, _PLAIN), (_MOVING_INTERVALS, _MOVING_PLAIN)


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


class Passage(NamedTuple):
    """What is given exactly of the start of an orbit that never rests.

    Attributes:
        symmetry: `passing`, `odd` or `none`.
        energy: a decimal number [J].
        theta1, theta2: decimal numbers [deg], multiples of 180 if passing; else one is empty, the
            angle that is an unknown.
    """

    symmetry: str
    energy: str
    theta1: str
    theta2: str


class Question(NamedTuple):
    """An orbit to be proved: decimals of l1, l2, m1, m2, g, and what is known in float64.

    Attributes:
        turns: as in `Certificate`; `None` for a brake orbit.
        state: the start of an orbit that never rests, SI units.
    """

    pendulum: tuple[str, str, str, str, str]
    release: Release | Passage
    theta2: float
    period: float
    turns: tuple[int, int] | None
    state: tuple[float, float, float, float] | None = None

    @property
    def symmetry(self) -> str:
        """`centred`, `brake`, `passing`, `odd` or `none`."""
        if isinstance(self.release, Passage):
            return self.release.symmetry
        return "brake" if self.turns is None else "centred"


@dataclass(frozen=True)
class Certificate:
    """What is proved of a periodic orbit.

    Attributes:
        pendulum: l1, l2 [m], m1, m2 [kg], g [m/s^2] as exact decimals.
        release: what is given exactly of the start: `Release` from rest, or `Passage`.
        symmetry: `centred`, `brake`, `passing`, `odd` or `none`.
        turns: theta(T/4)/pi of a centred orbit; (theta(T) - theta(0))/(2 pi) if passing or without
            symmetry; (theta(0) + theta(T/2))/(2 pi) if odd; else zeros.
        status: `PROVED`, or another value of `Status`; reason: why, else empty.
        theta1_deg, theta2_deg, p1, p2 [kg m^2/s]: of the start, where they are not given; period
            [s], energy [J], kappa: decimal intervals that hold the true values; `None` where
            nothing is proved.
        stability: `elliptic`, `hyperbolic`, `inverse hyperbolic` or `not decided`.
        minimal: whether it is proved that the period is the minimal one and that the orbit rests
            at its two rests only, or never.
        unique_angle_deg, unique_momentum, unique_period: there is no other orbit with the same
            given start, symmetry and turns, with the start's other angle, its momenta and the
            period all within these radii [deg, kg m^2/s, s]; empty if not proved or not unknown.
        digits: decimals of the start [rad and natural units] and of the arc in units of
            sqrt(l1/g) proved right.
        discs: how many the proof needed; seconds: its CPU time.
    """

    pendulum: tuple[str, str, str, str, str]
    release: Release | Passage
    symmetry: str
    turns: tuple[int, int]
    status: Status
    reason: str = ""
    theta1_deg: Enclosure | None = None
    theta2_deg: Enclosure | None = None
    p1: Enclosure | None = None
    p2: Enclosure | None = None
    period: Enclosure | None = None
    energy: Enclosure | None = None
    kappa: Enclosure | None = None
    stability: str = "not decided"
    minimal: bool = False
    unique_angle_deg: str = ""
    unique_momentum: str = ""
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
        moving = isinstance(self.release, Passage)
        claim: dict[str, Any] = {
            "format": FORMAT,
            "pendulum": dict(zip(_PENDULUM, self.pendulum, strict=True)),
            "start" if moving else "theta1": self.release._asdict(),
            "symmetry": self.symmetry,
            "turns": list(self.turns),
            "status": self.status.name.lower(),
            "reason": self.reason,
        }
        intervals, plain = _KEYS[moving]
        for key, name in intervals.items():
            value = getattr(self, name)
            claim[key] = None if value is None else value._asdict()
        claim |= {key: getattr(self, name) for key, name in plain.items()}
        return claim | {"identifier": identifier_of(claim), "discs": self.discs}

    @property
    def identifier(self) -> str:
        """Of the claim, as `record` and the rows of an atlas have it."""
        return str(self.record()["identifier"])

    def statement(self) -> str:
        """What is proved, in words."""
        if not self.exists:
            return f"{self.status.sentence} {self.reason}".strip()
        sentences = [
            f"Proved: {self._start()}, a pendulum with exactly {_values(self.pendulum)} moves "
            f"periodically with a period in {self.period} s.",
            _TURNS[self.symmetry].format(*self.turns),
        ]
        moving = isinstance(self.release, Passage)
        if self.minimal:
            rests = "never rests" if moving else "rests only at 0 and T/2"
            sentences.append(f"This period is minimal, and the motion {rests}.")
        if self.unique_period:
            sentences.append(f"There is no other such orbit with {self._nearby()}.")
        energy = "Its" if moving else f"Its energy is in {self.energy} J, its"
        verb = " is" if moving else ""
        sentences.append(f"{energy} kappa{verb} in {self.kappa}: {self.stability}.")
        return " ".join(sentences)

    def place(self) -> str:
        """The angles that are given."""
        start = self.release
        if isinstance(start, Release):
            if start.ratio:
                return "theta1 = " + ("theta2" if start.ratio == 1 else "-theta2")
            unit = "deg" if start.unit == "deg" else "rad (the float64 number)"
            return f"theta1 = {start.text} {unit}"
        given = {"theta1": start.theta1, "theta2": start.theta2}
        return " and ".join(f"{name} = {text} deg" for name, text in given.items() if text)

    def _start(self) -> str:
        start = self.release
        if isinstance(start, Release):
            return f"released from rest at {self.place()} and a theta2 in {self.theta2_deg} deg"
        names = ("theta1", "theta2")
        free = [
            f"a {name} in {getattr(self, name + '_deg')} deg, "
            for name in names
            if not getattr(start, name)
        ]
        return (
            f"with an energy of exactly {start.energy} J, started at {self.place()} with "
            f"{''.join(free)}a p1 in {self.p1} and a p2 in {self.p2} kg m^2/s"
        )

    def _nearby(self) -> str:
        if isinstance(self.release, Release):
            parts = [f"theta2 within {self.unique_angle_deg} deg of it"]
        else:
            parts = [f"momenta within {self.unique_momentum} kg m^2/s of these"]
            if self.unique_angle_deg:
                name = "theta2" if self.release.theta1 else "theta1"
                parts.append(f"{name} within {self.unique_angle_deg} deg")
        return f"{', '.join(parts)} and the period within {self.unique_period} s"


_TURNS = {
    "centred": "At T/4 the angles are pi times {} and {}.",
    "brake": "At T/2 it is at rest again.",
    "passing": "At T/2 both angles are multiples of 180 deg again; in T the rods make {} and {} "
    "full turns.",
    "odd": "At T/2 angles and momenta are minus those at the start, up to {} and {} full turns.",
    "none": "After T angles and momenta are those at the start, up to {} and {} full turns.",
}


def _values(pendulum: tuple[str, ...]) -> str:
    units = ("m", "m", "kg", "kg", "m/s^2")
    names = ("l1", "l2", "m1", "m2", "g")
    return ", ".join(f"{n} = {x} {u}" for n, x, u in zip(names, pendulum, units, strict=True))


def identifier_of(claim: dict[str, Any]) -> str:
    """The first 16 hexadecimal digits of SHA-256 of the claim: a changed digit is noticed."""
    return hashlib.sha256(json_text(claim, None).encode()).hexdigest()[:16]


def _read_start(record: Any) -> Release | Passage:
    return Passage(**record["start"]) if "start" in record else Release(**record["theta1"])


def read_certificate(record: Any) -> Certificate:
    """The certificate that a record says.

    Raises:
        ValueError: it is no such record, or was changed since it was written.
    """
    try:
        claim = {key: record[key] for key in record if key not in ("identifier", "discs")}
        if record["format"] != FORMAT or record["identifier"] != identifier_of(claim):
            raise ValueError("its identifier is not that of its content")
        names, plain = _KEYS["start" in record]
        intervals: dict[str, Any] = {
            name: None if record[key] is None else Enclosure(**record[key])
            for key, name in names.items()
        }
        return Certificate(
            pendulum=tuple(record["pendulum"][name] for name in _PENDULUM),
            release=_read_start(record),
            symmetry=record["symmetry"],
            turns=(record["turns"][0], record["turns"][1]),
            status=Status[record["status"].upper()],
            reason=record["reason"],
            discs=record["discs"],
            **intervals,
            **{name: record[key] for key, name in plain.items()},
        )
    except (AttributeError, IndexError, KeyError, TypeError) as error:
        raise ValueError(f"it is no certificate ({error})") from None
