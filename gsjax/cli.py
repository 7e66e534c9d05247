"""The command line: `gsjax demo`, `sfm`, `train`, `eval`, `render`, `export`, …

Exit codes: 0 done, 1 not well, 2 usage, 3 bad or missing input, 4 structure from
motion failed, 5 training diverged, 6 a package is missing, 130 interrupted. Results
go to stdout, all else to stderr; an error is one line, unless --debug asks for the
traceback.
"""

import contextlib
import io
import os
import re
import sys
import traceback
from collections.abc import Sequence
from typing import Annotated

import tyro
from tyro.conf import FlagCreatePairsOff, subcommand

from gsjax.commands.bench import BenchCommand
from gsjax.commands.common import UsageError
from gsjax.commands.demo import DemoCommand
from gsjax.commands.doctor import DoctorCommand
from gsjax.commands.evaluate import EvalCommand
from gsjax.commands.export import ExportCommand
from gsjax.commands.info import InfoCommand
from gsjax.commands.render import RenderCommand
from gsjax.commands.sfm import SfmCommand
from gsjax.commands.stress import StressCommand
from gsjax.commands.train import TrainCommand
from gsjax.commands.view import ViewCommand
from gsjax.console import one_line, warnings_as_lines
from gsjax.errors import CapacityError, GsjaxError, InputError
from gsjax.memory import unlimited

_COMMANDS = (
    Annotated[DemoCommand, subcommand("demo")]
    | Annotated[SfmCommand, subcommand("sfm")]
    | Annotated[TrainCommand, subcommand("train")]
    | Annotated[EvalCommand, subcommand("eval")]
    | Annotated[RenderCommand, subcommand("render")]
    | Annotated[ViewCommand, subcommand("view")]
    | Annotated[ExportCommand, subcommand("export")]
    | Annotated[InfoCommand, subcommand("info")]
    | Annotated[BenchCommand, subcommand("bench")]
    | Annotated[DoctorCommand, subcommand("doctor")]
    | Annotated[StressCommand, subcommand("stress")]
)

_EXHAUSTED = "RESOURCE_EXHAUSTED"  # as XLA tells it


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    argv = list(sys.argv[1:] if argv is None else argv)
    if argv == ["--version"]:
        from gsjax.doctor import version

        print(f"gsjax {version('gsjax')}")
        return 0
    debug = "--debug" in argv
    # OpenCV tells of bad photographs on its own, on top of our one line.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    try:
        with warnings_as_lines():
            command = _parse(argv)
            with unlimited(getattr(command, "ignore_memory", False)):
                return command.run()
    except KeyboardInterrupt:
        return _report("interrupted", 130, debug)
    except GsjaxError as error:
        return _report(one_line(error), error.exit_code, debug)
    except OSError as error:
        return _report(one_line(error), InputError.exit_code, debug)
    except Exception as error:
        if isinstance(error, MemoryError) or _EXHAUSTED in str(error):
            text = "the memory of this machine does not hold what this takes; make it "
            text += "smaller: fewer Gaussians, smaller photographs or pictures"
            return _report(text, CapacityError.exit_code, debug)
        # Not foreseen: still one line, which says how to see more.
        text = f"{type(error).__name__}: {one_line(error)[:300]}"
        return _report(f"{text} (--debug shows where)", 1, debug)
    except SystemExit as exit_:  # --help, or a usage error told already
        return exit_.code if isinstance(exit_.code, int) else 1


def _report(message: str, code: int, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    print(f"gsjax: error: {message}", file=sys.stderr)
    return code


def _parse(argv: list[str]):
    """The command of a line.

    Raises:
      UsageError: with tyro's box of explanations made one line.
      SystemExit: after --help.
    """
    told = io.StringIO()
    try:
        with contextlib.redirect_stderr(told):
            return tyro.cli(
                _COMMANDS,
                prog="gsjax",
                description="3D Gaussian splatting in pure JAX. "
                "gsjax --version prints the version.",
                args=argv or ["--help"],
                config=(FlagCreatePairsOff,),
            )
    except SystemExit as exit_:
        if exit_.code in (0, None):
            raise
        raise UsageError(_unboxed(told.getvalue())) from None


def _unboxed(text: str) -> str:
    """The messages in tyro's boxes, without frames, colours and advice."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", text)
    lines = [line.strip(" │|") for line in text.splitlines()]
    lines = ["" if re.match("[╭╰─]|[+-]{3}", line) else line for line in lines]
    parts = [one_line(part) for part in "\n".join(lines).split("\n\n")]
    advice = ("For full helptext", "Argument helptext")
    parts = [part for part in parts if part and not part.startswith(advice)]
    return f"{'; '.join(parts) or 'wrong usage'}; see gsjax --help"


if __name__ == "__main__":
    sys.exit(main())
