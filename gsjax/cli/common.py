"""What the commands share: their base, and the values of their options.

A command is a dataclass of its options with `run`, which returns the exit code. What
is heavy to import is imported there.
"""

import contextlib
import re
import shlex
from dataclasses import dataclass
from importlib.util import find_spec
from inspect import get_annotations
from pathlib import Path
from typing import Annotated

from gsjax.cli.options import TOLD
from gsjax.errors import GsjaxError

_KINDS = ("rgb", "alpha", "depth")


class UsageError(GsjaxError):
    """An option has a value that it cannot have."""

    exit_code = 2


@dataclass(kw_only=True)
class Command:
    debug: Annotated[bool, TOLD] = False
    """Show the whole traceback of an error."""

    def __init_subclass__(cls) -> None:
        """All options of commands are told of alike in their help."""
        for name, kind in get_annotations(cls).items():
            cls.__annotations__[name] = Annotated[kind, TOLD]


@dataclass(kw_only=True)
class HeavyCommand(Command):
    """A command that may take more memory than there is."""

    ignore_memory: bool = False
    """Go on even where the memory of this machine looks too small."""


def parse_size(text: str) -> tuple[int, int]:
    """Width and height of ``800x600``.

    Raises:
      UsageError: if it is not that.
    """
    match = re.fullmatch(r"([0-9]{1,6})[x×X]([0-9]{1,6})", text)
    if match is None or min(int(match[1]), int(match[2])) < 1:
        raise UsageError(
            f"--size {text!r}: WIDTHxHEIGHT in pixels is wanted, 1 to 999999 each: "
            "800x600"
        )
    return int(match[1]), int(match[2])


def parse_kinds(text: str) -> tuple[str, ...]:
    """The kinds of image in ``rgb,depth``, each once.

    Raises:
      UsageError: if one is unknown.
    """
    kinds = tuple(dict.fromkeys(text.split(",")))
    if not set(kinds) <= set(_KINDS):
        raise UsageError(
            f"--what {text!r}: of {', '.join(_KINDS)}, one or several with commas"
        )
    return kinds


def parse_background(text: str) -> tuple[float, ...]:
    """The colour ``R,G,B``.

    Raises:
      UsageError: if it is not three numbers.
    """
    number = r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,2})?"
    if not re.fullmatch(rf"{number}(,{number}){{2}}", text):
        raise UsageError(f"--background {text!r}: R,G,B is wanted, e.g. 1,1,1")
    return tuple(float(value) for value in text.split(","))


def parse_budget(text: str) -> float:
    """The error ``1/255`` or ``0.004``.

    Raises:
      UsageError: if it is neither, or not above 0 and below 1.
    """
    number = r"(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,2})?"
    match = re.fullmatch(rf"({number})(?:/({number}))?", text)
    parts = [float(part or 1) for part in match.groups()] if match else [0.0]
    if min(parts) <= 0 or parts[0] >= parts[1]:
        raise UsageError(
            f"--budget {text!r}: an error above 0 and below 1, e.g. 1/255 or 0.004"
        )
    return parts[0] / parts[1]


def view_hint(run: Path) -> str:
    """How to look at a run, and what that needs if it is not installed."""
    needs = "" if find_spec("viser") else "  # needs pip install 'gsjax[viewer]'"
    return command_line("view", run) + needs


def command_line(*words: str | Path) -> str:
    """A call of this program, as a shell takes it whatever the names of files are."""
    return shlex.join(["gsjax", *map(str, words)])


def start_jax() -> None:
    """Give JAX a device for each core, and a place for what it compiles."""
    from gsjax.runtime import devices

    devices.keep_programs()
    # Called from a program in which JAX has started, its devices are used.
    with contextlib.suppress(RuntimeError):
        devices.use_all_cores(queued=False)  # every result is waited for
