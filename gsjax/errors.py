"""Typed errors; messages say what was expected, what was found and what to do."""


class GsjaxError(Exception):
    """Base class of the errors that the command line reports without a traceback."""

    exit_code = 1


class InputError(GsjaxError, ValueError):
    """Bad or missing input; names the file or argument, the field and the remedy."""

    exit_code = 3


class CapacityError(GsjaxError, RuntimeError):
    """A fixed-size stage, or memory, is too small; says how much is needed."""

    exit_code = 3


class SfmError(GsjaxError, RuntimeError):
    """Structure from motion found no cameras, or too few."""

    exit_code = 4


class DivergedError(GsjaxError, RuntimeError):
    """Training diverged: values are not finite, nothing is in view, or PSNR is below 0.

    Says when, and what to try.
    """

    exit_code = 5


class MissingExtraError(GsjaxError, ImportError):
    """An optional package is missing; names the command that installs it."""

    exit_code = 6
