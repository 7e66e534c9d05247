"""The command line: `gsjax demo`, `sfm`, `train`, `eval`, `render`, `export`, …

Exit codes: 0 done, 1 not well, 2 usage, 3 bad or missing input, 4 structure from
motion failed, 5 training diverged, 6 a package is missing, 130 interrupted, 141 nobody
reads the results any more. Results go to stdout, all else to stderr; an error is one
line, unless --debug asks for the traceback.
"""

import contextlib
import io
import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence
from functools import reduce
from importlib import import_module
from operator import or_
from typing import Annotated, Any

from gsjax.errors import CapacityError, GsjaxError, InputError
from gsjax.runtime.console import one_line, warnings_as_lines
from gsjax.runtime.machine import restart_with_large_pages
from gsjax.runtime.memory import unlimited

_LONGEST = 2000  # characters of an error, whose remedy stands at its end
_EXHAUSTED = "RESOURCE_EXHAUSTED"  # as XLA tells it


def program() -> int:
    """`main` as a program of its own."""
    restart_with_large_pages()
    return main()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    argv = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in argv
    try:
        return _run(argv)
    except KeyboardInterrupt:
        return _report("interrupted", 130, debug)
    except GsjaxError as error:
        return _report(one_line(error, _LONGEST), error.exit_code, debug)
    except BrokenPipeError:
        return _hung_up()
    except OSError as error:
        what = "" if error.filename is None else f"{str(error.filename)[:200]!r}: "
        text = f"{what}{error.strerror or error}; check the path and its permissions"
        return _report(one_line(text, _LONGEST), InputError.exit_code, debug)
    except Exception as error:
        if isinstance(error, MemoryError) or _EXHAUSTED in str(error):
            text = "the memory of this machine does not hold what this takes; make it "
            text += "smaller: fewer Gaussians, smaller photographs or pictures"
            return _report(text, CapacityError.exit_code, debug)
        # Not foreseen: still one line, which says how to see more.
        text = f"{type(error).__name__}: {one_line(error)[:300]}"
        return _report(f"{text} (--debug shows where)", 1, debug)


def _run(argv: list[str]) -> int:
    # OpenCV warns of what is no harm; of what is, `scene.decode` hears and tells.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")
    # Each line as it is said, into a file too: a server's address, say. Where there is
    # no ∞, a ?; stderr has a way of its own, and so may stdout.
    if isinstance(sys.stdout, io.TextIOWrapper):
        errors = "replace" if sys.stdout.errors == "strict" else sys.stdout.errors
        sys.stdout.reconfigure(errors=errors, line_buffering=True)
    try:
        with warnings_as_lines():
            code = _result(argv)
    except SystemExit as exit_:  # --help, or a usage error told already
        code = exit_.code if isinstance(exit_.code, int) else 1
    print(end="", flush=True)  # not at the very end, where an error is a traceback
    return code


def _result(argv: list[str]) -> int:
    with _leaving_on_ctrl_c():
        if argv == ["--version"]:
            from gsjax.cli.doctor_checks import version

            print(f"gsjax {version('gsjax')}")
            return 0
        command = _parse(argv)
        import_module("gsjax.public")  # and so JAX
    with unlimited(getattr(command, "ignore_memory", False)):
        return command.run()


def _leave(*_) -> None:
    os.write(2, b"gsjax: error: interrupted\n")  # sys.stderr may be any by now
    os._exit(130)


@contextlib.contextmanager
def _leaving_on_ctrl_c() -> Iterator[None]:
    """Within, Ctrl-C ends the process on the spot: nothing has begun.

    Where JAX is being imported, `KeyboardInterrupt` is lost, or crashes it. What has
    JAX already, or another way with Ctrl-C, keeps that.
    """
    usual = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    mine = threading.current_thread() is threading.main_thread()
    if "jax" in sys.modules or not usual or not mine:
        yield
        return
    signal.signal(signal.SIGINT, _leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _hung_up() -> int:
    """Who read our lines has gone, as `head` does: nothing is left to be said."""
    with contextlib.suppress(OSError):  # not a stream of the system
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 141  # as a shell calls the death by SIGPIPE


def _report(message: str, code: int, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    print(f"gsjax: error: {message}", file=sys.stderr)
    return code


def _commands() -> dict[str, type]:
    """By their names; not imported before Ctrl-C is told in one line."""
    from gsjax.cli.bench import BenchCommand
    from gsjax.cli.demo import DemoCommand
    from gsjax.cli.doctor import DoctorCommand
    from gsjax.cli.evaluate import EvalCommand
    from gsjax.cli.export import ExportCommand
    from gsjax.cli.info import InfoCommand
    from gsjax.cli.render import RenderCommand
    from gsjax.cli.sfm import SfmCommand
    from gsjax.cli.stress import StressCommand
    from gsjax.cli.train import TrainCommand
    from gsjax.cli.view import ViewCommand

    return {
        "demo": DemoCommand,
        "sfm": SfmCommand,
        "train": TrainCommand,
        "eval": EvalCommand,
        "render": RenderCommand,
        "view": ViewCommand,
        "export": ExportCommand,
        "info": InfoCommand,
        "bench": BenchCommand,
        "doctor": DoctorCommand,
        "stress": StressCommand,
    }


def _parse(argv: list[str]):
    """The command of a line.

    Raises:
      UsageError: with tyro's box of explanations made one line.
      SystemExit: after --help.
    """
    import tyro

    from gsjax.cli.common import UsageError
    from gsjax.cli.options import OPTIONAL
    from gsjax.cli.usage import explained

    commands, told = _commands(), io.StringIO()
    named = [
        Annotated[kind, tyro.conf.subcommand(name)] for name, kind in commands.items()
    ]
    any_of_them: Any = reduce(or_, named)
    try:
        with contextlib.redirect_stderr(told):
            return tyro.cli(
                any_of_them,
                prog="gsjax",
                description="3D Gaussian splatting in pure JAX. "
                "gsjax --version prints the version.",
                args=argv or ["--help"],
                config=(tyro.conf.FlagCreatePairsOff,),
                registry=OPTIONAL,
            )
    except SystemExit as exit_:
        if exit_.code in (0, None):
            raise
        raise UsageError(explained(told.getvalue(), argv, commands)) from None


if __name__ == "__main__":
    sys.exit(program())
