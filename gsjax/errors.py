"""Typed errors: what is wrong, where, what was found, and what to do about it."""


class GsjaxError(Exception):
    """Base of the errors that the command line reports without a traceback."""

    exit_code = 1


class InputError(GsjaxError, ValueError):
    """Bad or missing input: names the file or argument, the field and the remedy."""

    exit_code = 3


class CapacityError(GsjaxError, RuntimeError):
    """A fixed-size stage, or the memory, does not hold what is wanted; says how much
    that is. See `gsjax.runtime.memory`."""

    exit_code = 3


class SfmError(GsjaxError, RuntimeError):
    """Structure from motion found no cameras, or too few; says how many and why."""

    exit_code = 4


class DivergedError(GsjaxError, RuntimeError):
    """Training no longer learns: numbers are not finite, pictures worse than any can
    be, or nothing is in view; says when, and what to try."""

    exit_code = 5


class MissingExtraError(GsjaxError, ImportError):
    """An optional package is absent; carries the line that installs it."""

    exit_code = 6
