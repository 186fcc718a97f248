"""How a computation went: `Status`, the one vocabulary of all results, and the sentence of each
member.
"""

from enum import IntEnum

from dpend.checks import Scalar, integer, one_of


class Status(IntEnum):
    """How a computation went: an int leaf of every result. `message` gives the sentence."""

    CONVERGED = 0
    MAX_ITERATIONS = 1
    SINGULAR = 2
    LEFT_BRANCH = 3
    NO_SUCH_ORBIT = 4
    TRIVIAL_ROOT = 5
    STEP_TOO_LARGE = 6
    DRIFT_ABOVE_TOLERANCE = 7
    NONFINITE = 8
    BEYOND_HORIZON = 9
    MISFIT = 10
    NO_SOLUTION = 11
    DISAGREEMENT = 12
    TOLERANCE_NOT_REACHED = 13
    NOT_COMPUTED = 255


_MESSAGES = {
    Status.CONVERGED: "Converged.",
    Status.MAX_ITERATIONS: "Newton's method did not converge in the allowed iterations, or a "
    "motion did not come to "
    "its end in the allowed steps; try a closer guess, or a shorter motion.",
    Status.SINGULAR: "The equations are singular here, as at a fold of the family, or where data "
    "do not determine what "
    "is asked; try another release angle, or hold what has no finite standard error.",
    Status.LEFT_BRANCH: "The branch could not be followed to this release: no step was short "
    "enough to stay on it, or "
    "the orbit found is not on it; the best so far is returned.",
    Status.NO_SUCH_ORBIT: "The branch ends without reaching this release; its largest |theta1| is "
    "returned.",
    Status.TRIVIAL_ROOT: "Newton's method fell into an equilibrium or a period of zero; try "
    "another guess.",
    Status.STEP_TOO_LARGE: "In one step a rod turned, or the fast mode advanced, by more than 1 "
    "rad; use a smaller "
    "step.",
    Status.DRIFT_ABOVE_TOLERANCE: "The energy drifted by more than the tolerance; use a smaller "
    "step.",
    Status.NONFINITE: "A value is not finite.",
    Status.BEYOND_HORIZON: "The motion is chaotic, and errors of rounding have grown above the "
    "error that was asked "
    "for, or above 0.1 rad; shorten it, or ask for less.",
    Status.TOLERANCE_NOT_REACHED: "The error estimate is above the error that was asked for, or "
    "above 0.1 rad, though "
    "errors of rounding alone have not grown so far; ask for less, or use a smaller step while "
    "that still helps.",
    Status.NO_SOLUTION: "Nothing within the bounds satisfies the equations; what comes nearest is "
    "returned.",
    Status.DISAGREEMENT: "A derivative differs from the finite difference by more than their "
    "errors explain.",
    Status.MISFIT: "What is left of the data is far above their noise, or not noise: the fit is "
    "not to be believed; "
    "check units, times and what is held, or try a closer guess.",
    Status.NOT_COMPUTED: "Not computed.",
}


def message(status: Scalar) -> str:
    """The sentence that says what `status`, a value of `Status`, means.

    Raises:
        ValueError: no such value, or an array of them.
    """
    return _MESSAGES[Status(one_of("status", integer("status", status, least=0), tuple(Status)))]
