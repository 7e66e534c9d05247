"""Base classes of the commands, and what their output has in common.

A command is a dataclass of its options with a method `run`, which returns the exit
code. Heavy imports belong there.
"""

import contextlib
import shlex
from dataclasses import dataclass
from importlib.util import find_spec
from inspect import get_annotations
from pathlib import Path
from typing import Annotated

from gsjax.cli.options import WITH_DEFAULT
from gsjax.errors import GsjaxError
from gsjax.runtime.console import decibels, say
from gsjax.runtime.files import reject_existing


class UsageError(GsjaxError):
    """Invalid arguments of a command."""

    exit_code = 2


@dataclass(kw_only=True)
class Command:
    """A command and its options."""

    debug: Annotated[bool, WITH_DEFAULT] = False
    """Show the traceback of an error."""

    def __init_subclass__(cls) -> None:
        """Format the defaults of all options alike."""
        for name, kind in get_annotations(cls).items():
            cls.__annotations__[name] = Annotated[kind, WITH_DEFAULT]

    def run(self) -> int:
        """Run the command and return its exit code."""
        raise NotImplementedError


@dataclass(kw_only=True)
class HeavyCommand(Command):
    """A command that may exceed the memory of the machine."""

    ignore_memory: bool = False
    """Continue even if the estimated memory exceeds what is available."""


def check_output(
    option: str, path: Path | None, overwrite: bool, *suffixes: str
) -> None:
    """Check the name of an output file, if it is given; no ``suffixes`` allow all.

    Raises:
      UsageError: if its suffix is not one of ``suffixes``.
      InputError: if it exists and ``overwrite`` is not set.
    """
    if path is None:
        return
    if suffixes and path.suffix.lower() not in suffixes:
        raise UsageError(f"{option} {path}: expected a name ending in {suffixes[0]}")
    reject_existing([path], overwrite, f"another name with {option}")


def say_result(result) -> None:
    """Print size, time and quality of a finished run, a `RunResult`."""
    line = f"{result.gaussians:,} Gaussians, {result.seconds:.0f} s"
    if (summary := result.summary) is not None:
        quality = f"PSNR {decibels(summary.psnr)}, SSIM {summary.ssim:.4f}"
        line += f"; {summary.views} held-out views: {quality}"
        if result.training_psnr is not None:
            line += f"; training views: PSNR {decibels(result.training_psnr)}"
    say(line)


def view_hint(run: Path) -> str:
    """Return the command to view a run, and its requirement if not installed."""
    needs = "" if find_spec("viser") else "  # needs pip install 'gsjax[viewer]'"
    return command_line("view", run) + needs


def command_line(*words: str | Path) -> str:
    """Return a call of this program, quoted for a shell."""
    return shlex.join(["gsjax", *map(str, words)])


def start_jax() -> None:
    """Configure JAX: one device per core, and a cache of compiled programs."""
    from gsjax.runtime import devices, setup

    setup.keep_programs()
    # If the calling program has started JAX, its devices are used.
    with contextlib.suppress(RuntimeError):
        devices.use_all_cores(queued=False)  # every result is blocked on
