"""Every error that samii-rig raises on purpose, as one tree.

Each carries one line for the person at the bench: what, where, the value that was
wrong, and what would be right. The command line prints that line and exits with the
class's `exit_code`; anything else that escapes is a defect of ours.
"""

from collections.abc import Iterable
from difflib import get_close_matches

NO_MEMORY = "there is no memory left"
MAX_SHOWN = 80  # characters of a wrong value that fit on the line beside the rest


def one_of(value: object, names: Iterable[object]) -> str:
    """What would be right in place of a name that is not known: `one of a, b, c; did you mean b?`.

    A phrase that follows "expected".
    """
    known = [str(name) for name in names]
    # Upper and lower case are the mistake that is made most.
    by_lower = {name.lower(): name for name in reversed(known)}
    near = get_close_matches(str(value).lower(), by_lower, n=1)
    meant = f"; did you mean {by_lower[near[0]]}?" if near else ""
    return f"one of {', '.join(known) or 'none'}{meant}"


class SamiiRigError(Exception):
    """Root of the tree; `str(error)` is the line for the person."""

    exit_code = 1


class InputError(SamiiRigError):
    """Something that a person gave is wrong.

    Parameters
    ----------
    where : the file (or command line option) that holds it.
    field : the field in it, dotted, `""` when the whole is meant.
    value : what stands there.
    expected : what would be right, as a phrase that follows "expected".
    """

    exit_code = 2

    def __init__(self, where: str, field: str, value: object, expected: str) -> None:
        shown = repr(value)
        if len(shown) > MAX_SHOWN:
            shown = shown[: MAX_SHOWN - 3] + "..."
        place = f"{where}: {field}" if field else where
        super().__init__(f"{place} is {shown}; expected {expected}")

    @classmethod
    def saying(cls, where: str, field: str, statement: str) -> "InputError":
        """An error whose statement already holds the value and what would be right."""
        error = cls.__new__(cls)
        Exception.__init__(error, ": ".join(part for part in (where, field, statement) if part))
        return error


class RecordingError(SamiiRigError):
    """A recording is damaged, incomplete or not one of ours."""

    exit_code = 2


class DiskError(RecordingError):
    """The disk refused what was to be recorded: it is full, broken, or the folder went away."""

    exit_code = 6


class RecordedError(RecordingError):
    """The run is over and its recording is closed and whole; what follows did not go.

    path : of the recording. exit_code : that of a run that did not go through, if it did not.
    """

    exit_code = 7

    def __init__(self, path: object, status: str, why: str) -> None:
        super().__init__(
            f"the run is over ({status}) and its recording is whole: {path}; it was not evaluated: "
            f"{why}; samii-rig report makes it up"
        )
        self.exit_code = {"stopped": 130, "tripped": 5, "failed": 6}.get(status, 7)


class EstimateError(SamiiRigError):
    """The data do not allow the estimate that was asked for; the line says what is missing."""

    exit_code = 2


class RepeatsDifferError(EstimateError):
    """Two repeats differ, and not by noise: of one state or of two, each can be estimated alone."""


class LimitError(SamiiRigError):
    """A plan would break a limit; the line names the number and the amplitude that would not."""

    exit_code = 4


class GateError(SamiiRigError):
    """The safety gate refused: wrong state, no deadman, or a command outside its limits."""

    exit_code = 5


class DeviceError(SamiiRigError):
    """A device did not do what its Protocol promises."""

    exit_code = 6
