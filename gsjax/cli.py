"""The command line: `gsjax render`, `info`, `demo`, `doctor`.

Exit codes: 0 done, 1 not well, 2 usage, 3 bad or missing input, 6 a package is
missing, 130 interrupted. Results go to stdout, all else to stderr; an error is one
line, unless --debug asks for the traceback.
"""

import contextlib
import io
import json
import re
import sys
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import FlagCreatePairsOff, Positional, arg, subcommand

from gsjax.console import note, one_line, say, warnings_as_lines
from gsjax.errors import GsjaxError, InputError

_KINDS = ("rgb", "alpha", "depth")


class UsageError(GsjaxError):
    """An option has a value that it cannot have."""

    exit_code = 2


@dataclass(kw_only=True)
class _Command:
    debug: bool = False
    """Show the whole traceback of an error."""


@dataclass(kw_only=True)
class RenderCommand(_Command):
    """Render a scene from a list of cameras, one image each."""

    scene: Positional[Path]
    """The Gaussians: a .ply file."""
    cameras: Path
    """The cameras: a transforms.json (NeRF, instant-ngp, nerfstudio)."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="DIR")]
    """Folder for the images; created if missing."""
    npy: bool = False
    """Also write each image as .npy of linear float32."""
    preset: Literal["compat", "accurate", "fast"] = "compat"
    """Which constants to render with; see RasterConfig."""
    size: Annotated[str | None, arg(metavar="WxH")] = None
    """Size of the images, e.g. 800x600; default: as in the file."""
    what: Annotated[str, arg(metavar="KINDS")] = "rgb"
    """rgb, alpha or depth, or several with commas; the first is NAME.png, a further
    one e.g. NAME.depth.png."""
    background: Annotated[str, arg(metavar="R,G,B")] = "0,0,0"
    """Colour behind the scene, each usually 0 to 1."""
    overwrite: bool = False
    """Replace images that exist."""

    def run(self) -> int:
        from gsjax.views import render_views

        size = None if self.size is None else _size(self.size)
        kinds, background = _kinds(self.what), _background(self.background)
        _use_all_cores()
        render_views(
            self.scene,
            self.cameras,
            self.out,
            preset=self.preset,
            size=size,
            kinds=kinds,
            background=background,
            npy=self.npy,
            overwrite=self.overwrite,
        )
        return 0


@dataclass(kw_only=True)
class InfoCommand(_Command):
    """Say what a scene consists of."""

    scene: Positional[Path]
    """The Gaussians: a .ply file."""
    json: bool = False
    """Print JSON."""

    def run(self) -> int:
        _use_all_cores()
        from gsjax.info import describe, info_text
        from gsjax.io import load

        facts = describe(load(self.scene))
        facts["file_bytes"] = self.scene.stat().st_size
        if self.json:
            say(json.dumps({"path": str(self.scene), **facts}, indent=2))
        else:
            say(info_text(str(self.scene), facts))
        return 0


@dataclass(kw_only=True)
class DemoCommand(_Command):
    """Make up a scene, render it, and write files to try the other commands on."""

    out: Annotated[Path, arg(aliases=["-o"], metavar="DIR")] = Path("gsjax-demo")
    """Folder for the files; created if missing."""
    gaussians: int = 20_000
    """How many the knot consists of; the floor takes half as many more."""
    frames: int = 48
    """Views of the turntable."""
    size: Annotated[str, arg(metavar="WxH")] = "640x480"
    """Size of the still image; the turntable has half of it."""
    overwrite: bool = False
    """Replace files that exist."""

    def run(self) -> int:
        width, height = _size(self.size)
        if min(self.gaussians, self.frames, width // 2, height // 2) < 1:
            raise UsageError("--gaussians and --frames from 1, --size from 2x2")
        _use_all_cores()
        from gsjax.demo import DemoSettings, run_demo
        from gsjax.scene.synthetic import BACKGROUND

        settings = DemoSettings(self.gaussians, self.frames, width, height)
        files = run_demo(self.out, settings, overwrite=self.overwrite)
        for path in files:
            say(str(path))
        background = ",".join(f"{value:g}" for value in BACKGROUND)
        note("done; next, try")
        note(f"  gsjax info {files.scene}")
        note(
            f"  gsjax render {files.scene} --cameras {files.cameras} "
            f"-o {self.out / 'views'} --what rgb,depth --background {background}"
        )
        return 0


@dataclass(kw_only=True)
class DoctorCommand(_Command):
    """Check the installation: versions, devices, and a tiny render."""

    def run(self) -> int:
        _use_all_cores()
        from gsjax.doctor import doctor_lines

        lines, good = doctor_lines()
        for line in lines:
            say(line)
        return 0 if good else 1


_COMMANDS = (
    Annotated[RenderCommand, subcommand("render")]
    | Annotated[InfoCommand, subcommand("info")]
    | Annotated[DemoCommand, subcommand("demo")]
    | Annotated[DoctorCommand, subcommand("doctor")]
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    argv = list(sys.argv[1:] if argv is None else argv)
    if argv == ["--version"]:
        from gsjax.doctor import version

        print(f"gsjax {version('gsjax')}")
        return 0
    debug = "--debug" in argv
    try:
        with warnings_as_lines():
            return _parse(argv).run()
    except KeyboardInterrupt:
        return _report("interrupted", 130, debug)
    except GsjaxError as error:
        return _report(one_line(error), error.exit_code, debug)
    except OSError as error:
        return _report(one_line(error), InputError.exit_code, debug)
    except Exception as error:
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


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([0-9]{1,6})[x×X]([0-9]{1,6})", text)
    if match is None or min(int(match[1]), int(match[2])) < 1:
        raise UsageError(f"--size {text!r}: WIDTHxHEIGHT in pixels is wanted: 800x600")
    return int(match[1]), int(match[2])


def _kinds(text: str) -> tuple[str, ...]:
    kinds = tuple(dict.fromkeys(text.split(",")))
    if not set(kinds) <= set(_KINDS):
        raise UsageError(
            f"--what {text!r}: of {', '.join(_KINDS)}, one or several with commas"
        )
    return kinds


def _background(text: str) -> tuple[float, ...]:
    number = r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,2})?"
    if not re.fullmatch(rf"{number}(,{number}){{2}}", text):
        raise UsageError(f"--background {text!r}: R,G,B is wanted, e.g. 1,1,1")
    return tuple(float(value) for value in text.split(","))


def _use_all_cores() -> None:
    from gsjax.devices import use_all_cores

    # Called from a program in which JAX has started, its devices are used.
    with contextlib.suppress(RuntimeError):
        use_all_cores()


if __name__ == "__main__":
    sys.exit(main())
