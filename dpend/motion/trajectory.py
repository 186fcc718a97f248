"""What a motion is when it is computed: `Trajectory`."""

import math
from dataclasses import dataclass, field
from typing import Annotated, Any

import jax
import numpy as np

from dpend.checks import Scalar, numbers, shown
from dpend.mechanics.pendulum import State
from dpend.methods.scheme import Scheme
from dpend.motion.estimate import MARGIN, PARTED
from dpend.records import frame, outcome, quantities, span, variables
from dpend.status import Status, message

# The error that is asked for by default [rad].
TOLERANCE = 1e-9


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Trajectory:
    """A motion at its saved times, or many motions at the same times.

    Attributes:
        time: times [s], shape (n,).
        state: the states, leaves of shape (n,); of m motions (m, n).
        energy_drift: the largest |H - H(0)| at a saved time, in units of `energy_scale`; of many
            motions (m,), as all that follows.
        error_estimate: of the larger angle, at the worst step [rad]; NaN where no second pass was
            made, infinite where the motion did not come to its end. For `reference` at the worst
            of its times.
        steps: the number of steps taken.
        status: a value of `Status`.
        scheme: method and step; None where the steps were chosen as the motion went.
        tolerance: the error that was asked for [rad]; NaN where a step was given.
        error: the estimate at each saved time [rad], of the shape of the state's leaves; NaN
            where only the worst is known.
        method: the method's name.
    """

    time: Annotated[Scalar, "s"]
    state: State
    energy_drift: Scalar
    error_estimate: Scalar
    steps: Scalar
    status: Scalar
    scheme: Scheme | None = field(default=None, metadata={"static": True})
    tolerance: Scalar = math.nan
    error: Annotated[Scalar, "rad"] = math.nan
    method: str = field(default="", metadata={"static": True})

    @property
    def message(self) -> str:
        """The sentence that says how this motion went, with its error estimate and the one asked
        for; of many motions, how many went how.
        """
        if np.ndim(self.status):
            return _count_statuses(np.asarray(self.status))
        status = Status(int(self.status))
        if status not in (Status.BEYOND_HORIZON, Status.TOLERANCE_NOT_REACHED):
            return message(status)
        chaotic = status == Status.BEYOND_HORIZON
        estimate, tolerance = float(self.error_estimate), float(self.tolerance)
        mends = ["shorten it"] if chaotic else []
        if math.isnan(tolerance):
            wish = f"{PARTED:g} rad, where it has parted from the true motion"
            mends += [] if chaotic else ["use a smaller step"]
        else:
            wish = f"the tolerance of {tolerance:.2g} rad"
            wish += ", which is the default" if tolerance == TOLERANCE else ""
            if estimate < PARTED:
                mends += [f"ask for a tolerance of {1.05 * estimate / MARGIN:.1e} rad or more"]
        why = "the motion is chaotic, and errors of rounding have grown so far" if chaotic else ""
        why = why or (
            "the step is too large"
            if math.isnan(tolerance)
            else "no step that was tried brings it lower"
        )
        mend = " or ".join(mends or ["shorten it"])
        return f"The error estimate, {estimate:.1e} rad, is above {wish}: {why}; {mend}."

    def to_xarray(self) -> Any:
        """The motion as an `xarray.Dataset` over `time`, many motions over `lane` and `time`:
        radians and SI units, the angles in degrees as coordinates.
        """
        import xarray

        lanes = ("lane",) if np.ndim(self.status) else ()
        saved = quantities(self.state)
        if np.ndim(self.error):
            saved |= quantities(self, "error")
        data, degrees = variables(saved, (*lanes, "time"))
        told = {
            "energy_drift": np.asarray(self.energy_drift, float),
            "error_estimate_rad": np.asarray(self.error_estimate, float),
            "steps": np.asarray(self.steps, int),
        }
        attributes: dict[str, Any] = {"tolerance_rad": float(self.tolerance), "method": self.method}
        if lanes:
            data |= {name: (lanes, value) for name, value in told.items()}
            data |= variables(quantities(self, "status"), lanes)[0]
        else:
            attributes |= {name: value.item() for name, value in told.items()}
            attributes["status"] = Status(int(self.status)).name.lower()
        time = ("time", np.asarray(self.time), {"units": "s"})
        return xarray.Dataset(data, {"time": time, **degrees}, attributes)

    def to_dataframe(self) -> Any:
        """A row for each saved time, of many motions also for each `lane`, with the names and the
        units of files: angles in degrees. `error_deg` is the estimate at this time.
        """
        table = quantities(self.state)
        shape = table["theta1"][0].shape
        if np.ndim(self.error):
            table |= quantities(self, "error")
        table = quantities(self, "time") | table
        if len(shape) > 1:
            table = {"lane": (np.arange(shape[0])[:, None], "")} | table
        flat = {name: (np.broadcast_to(of, shape).ravel(), u) for name, (of, u) in table.items()}
        return frame(flat)

    def __repr__(self) -> str:
        many = f"{np.size(self.status)} motions, " if np.ndim(self.status) else ""
        saved = f"{np.size(self.time)} saved states, {span('time', self.time, 's')}"
        steps, error = span("steps", self.steps), span("error", self.error_estimate, "rad")
        return f"<Trajectory: {many}{saved}, {steps}, {error}, {outcome(self.status)}>"


def _count_statuses(status: np.ndarray) -> str:
    """How many motions went how, the most frequent first."""
    values, counts = np.unique(status, return_counts=True)
    told = sorted(zip(counts.tolist(), values.tolist(), strict=True), reverse=True)
    return " ".join(f"{count} of {status.size}: {message(value)}" for count, value in told)


def check_times(times: Any) -> np.ndarray:
    """The times [s], if they move away from zero in one direction."""
    grid = np.atleast_1d(numbers("times", times, unit="s"))
    if grid.ndim != 1:
        raise ValueError(
            f"times must have one dimension, got shape {grid.shape}: give one number for each time"
        )
    way = np.sign(grid[-1:])
    moves = way * (grid[1:] - grid[:-1])
    ordered = grid.size and (way * grid[0]).item() >= 0 and moves.min(initial=np.inf) > 0
    if not ordered or not np.isfinite(grid).all():
        raise ValueError(
            f"times must be finite and move away from zero in one direction, got {shown(grid)}: "
            f"sort them"
        )
    return grid
