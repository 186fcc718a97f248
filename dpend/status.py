"""How a computation went: `Status`, the one vocabulary of all results."""

from enum import IntEnum

from dpend.checks import Scalar, integer, one_of


class Status(IntEnum):
    """How a computation went: an int leaf of every result, whose `sentence` says what it means."""

    sentence: str

    def __new__(cls, value: int, sentence: str = "") -> "Status":
        """A member is its number; the sentence is an attribute."""
        member = int.__new__(cls, value)
        member._value_, member.sentence = value, sentence
        return member

    CONVERGED = 0, "Converged."
    MAX_ITERATIONS = (
        1,
        "Newton's method or a search did not converge in the allowed iterations, or a motion or a "
        "family did not come to its end in the allowed steps or points; try a closer guess or a "
        "shorter motion, start from the best so far, or allow more.",
    )
    SINGULAR = (
        2,
        "The equations are singular here, as at a fold of the family, or where data do not "
        "determine what is asked; try another release angle, or hold what has no finite standard "
        "error.",
    )
    LEFT_BRANCH = (
        3,
        "The branch could not be followed to this release or to its end: no step was short enough "
        "to stay on it, or the orbit found is not on it; the best so far is returned.",
    )
    NO_SUCH_ORBIT = (
        4,
        "The branch ends without reaching this release; its largest |theta1| is returned, or the "
        "best design so far.",
    )
    TRIVIAL_ROOT = (
        5,
        "Newton's method fell into an equilibrium or a period of zero; try another guess.",
    )
    STEP_TOO_LARGE = (
        6,
        "In one step a rod turned, or the fast mode advanced, by more than 1 rad; use a smaller "
        "step.",
    )
    DRIFT_ABOVE_TOLERANCE = (
        7,
        "The energy drifted by more than the tolerance; use a smaller step.",
    )
    NONFINITE = 8, "A value is not finite."
    BEYOND_HORIZON = (
        9,
        "The motion is chaotic, and errors of rounding have grown above the error that was asked "
        "for, or above 0.1 rad; shorten it, or ask for less.",
    )
    MISFIT = (
        10,
        "What is left of the data is far above their noise, or not noise: the fit is not to be "
        "believed; check units, times and what is held, or try a closer guess.",
    )
    NO_SOLUTION = (
        11,
        "Nothing within the bounds satisfies the equations; what comes nearest is returned.",
    )
    DISAGREEMENT = (
        12,
        "A derivative differs from the finite difference by more than the tolerance and their "
        "errors explain: it is wrong, or the loss is not smooth or chaotic here.",
    )
    TOLERANCE_NOT_REACHED = (
        13,
        "The error estimate is above the error that was asked for, or above 0.1 rad, though errors "
        "of rounding alone have not grown so far; ask for less, or use a smaller step while that "
        "still helps.",
    )
    PROVED = 20, "Proved."
    NOT_PROVED = 21, "No proof was found; the orbit may exist all the same."
    ANOTHER_ORBIT = (
        22,
        "An orbit was proved, but it is not the one that was asked about; solve for it again.",
    )
    NOT_COVERED = (
        23,
        "Orbits of this kind cannot be proved yet: those released from rest can, with gravity "
        "downwards.",
    )
    DIGITS_NOT_PROVED = (
        24,
        "The orbit is proved, but not to as many digits as were asked for; ask for fewer.",
    )
    NOT_COMPUTED = 255, "Not computed."


def message(status: Scalar) -> str:
    """The sentence that says what `status`, a value of `Status`, means.

    Raises:
        ValueError: no such value, or an array of them.
    """
    value = one_of("status", integer("status", status, least=0), tuple(Status))
    return Status(value).sentence
