"""Entry point of the command line: exit codes, errors, Ctrl-C and broken pipes.

Exit codes: 0 success, 1 a check failed, 2 usage, 3 bad or missing input, 4 structure
from motion failed, 5 training diverged, 6 a package is missing, 130 interrupted, 141
broken pipe. Results go to stdout, everything else to stderr. An error is one line;
--debug shows the traceback.
"""

import contextlib
import io
import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence
from importlib import import_module

from gsjax.errors import CapacityError, GsjaxError, InputError
from gsjax.runtime.console import one_line, warnings_as_lines
from gsjax.runtime.memory import unlimited
from gsjax.runtime.setup import restart_with_large_pages

_MAX_CHARACTERS = 2000  # of an error, whose end states the remedy
_XLA_OUT_OF_MEMORY = "RESOURCE_EXHAUSTED"


def program() -> int:
    """Run `main` in a process of its own, with large memory pages."""
    restart_with_large_pages()
    return main()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line with ``argv``, or `sys.argv`, and return the exit code."""
    argv = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in argv
    try:
        return _run(argv)
    except KeyboardInterrupt:
        return _report("interrupted", 130, debug)
    except GsjaxError as error:
        return _report(one_line(error, _MAX_CHARACTERS), error.exit_code, debug)
    except BrokenPipeError:
        return _discard_output()
    except OSError as error:
        name = "" if error.filename is None else f"{str(error.filename)[:200]!r}: "
        text = f"{name}{error.strerror or error}; check the path and its permissions"
        return _report(one_line(text, _MAX_CHARACTERS), InputError.exit_code, debug)
    except Exception as error:
        if isinstance(error, MemoryError) or _XLA_OUT_OF_MEMORY in str(error):
            text = "out of memory; use fewer Gaussians or smaller images"
            return _report(text, CapacityError.exit_code, debug)
        text = f"{type(error).__name__}: {one_line(error)[:300]}"
        return _report(f"{text} (--debug shows the traceback)", 1, debug)


def _run(argv: list[str]) -> int:
    # `gsjax.data.decode` reports the warnings of OpenCV that matter.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")
    # Lines reach a pipe at once, and characters that its encoding lacks become "?".
    if isinstance(sys.stdout, io.TextIOWrapper):
        errors = "replace" if sys.stdout.errors == "strict" else sys.stdout.errors
        sys.stdout.reconfigure(errors=errors, line_buffering=True)
    try:
        with warnings_as_lines():
            code = _result(argv)
    except SystemExit as exit_:  # --help
        code = exit_.code if isinstance(exit_.code, int) else 1
    print(end="", flush=True)  # at interpreter exit, an error would be a traceback
    return code


def _result(argv: list[str]) -> int:
    with _exit_on_ctrl_c():
        if argv == ["--version"]:
            from gsjax.cli.doctor import version

            print(f"gsjax {version('gsjax')}")
            return 0
        # Imports tyro, and so after Ctrl-C is handled.
        from gsjax.cli.parsing import parse

        command = parse(argv)
        import_module("gsjax.raster.render")  # and so JAX
    with unlimited(getattr(command, "ignore_memory", False)):
        return command.run()


def _exit(*_) -> None:
    os.write(2, b"gsjax: error: interrupted\n")  # sys.stderr may be replaced by now
    os._exit(130)


@contextlib.contextmanager
def _exit_on_ctrl_c() -> Iterator[None]:
    """End the process at Ctrl-C inside the context, in which no work has begun.

    A `KeyboardInterrupt` while JAX is imported would be lost, or crash it. Nothing
    changes if JAX is imported already, or Ctrl-C is handled in another way.
    """
    usual = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    is_main = threading.current_thread() is threading.main_thread()
    if "jax" in sys.modules or not usual or not is_main:
        yield
        return
    signal.signal(signal.SIGINT, _exit)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _discard_output() -> int:
    """Discard further output: its reader has gone, as `head` does."""
    with contextlib.suppress(OSError):  # stdout is not a file of the system
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 141  # 128 + SIGPIPE, as in a shell


def _report(message: str, code: int, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    print(f"gsjax: error: {message}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(program())
