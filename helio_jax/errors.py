"""Errors a user may meet, each with the exit code the command line ends with.

Every message names the quantity, the value, the limit and the remedy. Exit code 1 is kept for bugs:
anything that is not a `HelioError`. This module imports nothing of the package.
"""


class HelioError(Exception):
    """Base of all expected errors; `exit_code` is what `helio` returns to the shell."""

    exit_code = 1


class SceneError(HelioError):
    """A scene, a setting or a command-line argument is wrong."""

    exit_code = 2


class InputFileError(HelioError):
    """A data file is missing, corrupt, of an unknown kind, or lacks something that is needed."""

    exit_code = 3


class GuardError(HelioError):
    """A numerical or ray-counting guard failed: the result would not be trustworthy."""

    exit_code = 4


class PredictionError(GuardError):
    """Masking or multiple scattering cannot be computed for this surface."""


class MissingDependencyError(HelioError):
    """An optional package is not installed."""

    exit_code = 5


class ResumeError(HelioError):
    """A run cannot be continued from what is on disk."""

    exit_code = 6


class StoppedRun(HelioError):
    """The run was stopped from outside (SIGTERM, a batch system's time limit, lost workers); it can go on."""

    exit_code = 75


class InterruptedRun(HelioError):
    """The user stopped the run; what was finished has been saved."""

    exit_code = 130
