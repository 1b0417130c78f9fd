"""Expected errors, each with the exit code of the command line. Exit code 1 is reserved for bugs.

Every message names the quantity, the value, the limit and the remedy.
"""


class HelioError(Exception):
    """Base of all expected errors.

    Example:
        >>> try:
        ...     hx.read("nowhere.h5")
        ... except hx.HelioError as e:
        ...     print(e, e.exit_code)
    """

    exit_code = 1


class SceneError(HelioError):
    """A scene, a setting or a command-line argument is wrong."""

    exit_code = 2


class WrongType(SceneError, TypeError):
    """An argument of a public function is of another type than it takes."""


class InputFileError(HelioError):
    """A data file is missing, corrupt, incomplete or of an unknown kind."""

    exit_code = 3


class GuardError(HelioError):
    """A numerical or ray-counting check failed: the result would not be reliable."""

    exit_code = 4


class PredictionError(GuardError):
    """Masking or multiple scattering cannot be computed for this surface."""


class MissingDependencyError(HelioError):
    """An optional package is not installed."""

    exit_code = 5


class ResumeError(HelioError):
    """The files on disk do not allow the run to be resumed."""

    exit_code = 6


class StoppedRun(HelioError):
    """The run was stopped from outside (SIGTERM, time limit of a batch system, lost workers) and can be resumed."""

    exit_code = 75


class InterruptedRun(HelioError):
    """The user stopped the run; finished work has been saved."""

    exit_code = 130
