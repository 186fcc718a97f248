"""What comes out of measured angles: `Fit`."""

from dataclasses import dataclass, field
from typing import Annotated, Any

import jax
import numpy as np

from dpend.checks import Scalar
from dpend.mechanics.pendulum import Pendulum, State
from dpend.records import outcome, quantities, record, span, units_of, variables

# The units of what is estimated.
_ESTIMATED = units_of(Pendulum) | units_of(State)
_ESTIMATED |= {"l2/l1": "", "m2/m1": "", "g/l1": "1/s^2", "omega1": "rad/s", "omega2": "rad/s"}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Fit:
    """A pendulum fitted to measured angles.

    Attributes:
        pendulum: with the estimated values of the free fields.
        state: at the first time.
        estimates: of the free fields [SI], of the ratios `l2/l1`, `m2/m1` and `g/l1` [1/s^2], and
            of the state at the first time, `theta1`, `theta2` [rad], `omega1`, `omega2` [rad/s].
        standard_errors: of the same, from the Jacobian of the constrained problem and the noise; 0
            for what was held, infinity for what the data do not determine, NaN where there was
            nothing to compute them from.
        covariance: of the free fields, then of theta1, theta2, omega1, omega2, in this order, shape
            (n, n).
        time: the times [s], shape (m,).
        theta1, theta2: the fitted motion there [rad], continuous.
        residual1, residual2: measured minus fitted, modulo full turns [rad]; NaN where nothing was
            measured.
        noise: standard deviation of the measured angles about the fit [rad].
        expected_noise: as given, or as local cubics through the data leave it [rad].
        gap: the largest miss at a joint of two windows [rad, rad/s].
        windows: how many there were.
        iterations: how often the motion was linearised.
        error_estimate: the largest change of a free field, relative, on going on at half the
            integration step.
        status: a value of `Status`: `MISFIT` where the residuals are far above the expected noise
            or correlated, `SINGULAR` where something asked for is not determined.
        free: the names of the free fields.
    """

    pendulum: Pendulum
    state: State
    estimates: Annotated[dict[str, Scalar], _ESTIMATED]
    standard_errors: Annotated[dict[str, Scalar], _ESTIMATED]
    covariance: Scalar
    time: Annotated[Scalar, "s"]
    theta1: Annotated[Scalar, "rad"]
    theta2: Annotated[Scalar, "rad"]
    residual1: Annotated[Scalar, "rad"]
    residual2: Annotated[Scalar, "rad"]
    noise: Annotated[Scalar, "rad"]
    expected_noise: Annotated[Scalar, "rad"]
    gap: Scalar
    windows: Scalar
    iterations: Scalar
    error_estimate: Scalar
    status: Scalar
    free: tuple[str, ...] = field(metadata={"static": True})

    def to_dataframe(self) -> Any:
        """The estimates and their standard errors, a row each, with the names and the units of
        files: angles in degrees.
        """
        import pandas

        return pandas.DataFrame(record(self, "estimates standard_errors"))

    def to_xarray(self) -> Any:
        """The fitted motion and the residuals as an `xarray.Dataset` over `time`, the estimates and
        their standard errors over `parameter`: radians and SI units, the angles in degrees as
        coordinates.
        """
        import xarray

        data, degrees = variables(quantities(self, "theta1 theta2 residual1 residual2"), "time")
        time = variables(quantities(self, "time"), "time")[0]
        for name in ("estimates", "standard_errors"):
            values = np.array([*getattr(self, name).values()])
            data[name.removesuffix("s")] = ("parameter", values)
        told = {"noise_rad": float(self.noise), "status": outcome(self.status)}
        return xarray.Dataset(data, time | degrees | {"parameter": [*self.estimates]}, told)

    def __repr__(self) -> str:
        estimates = ", ".join(
            f"{span(name, self.estimates[name])} +- {self.standard_errors[name]:.1e}"
            for name in self.free
        )
        return f"<Fit: {estimates}, {span('noise', self.noise, 'rad')}, {outcome(self.status)}>"
