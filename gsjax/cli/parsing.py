"""Arguments of the command line to a command; errors of tyro as one line."""

import contextlib
import io
import re
from collections.abc import Sequence
from importlib import import_module
from typing import Annotated, Any, Union

import tyro

from gsjax.cli.common import Command, UsageError
from gsjax.cli.options import REGISTRY, suggestion
from gsjax.runtime.console import one_line

# Command: its module in gsjax.cli and its dataclass, in the order of the help text.
COMMANDS = {
    "demo": ("demo", "DemoCommand"),
    "sfm": ("sfm", "SfmCommand"),
    "train": ("train", "TrainCommand"),
    "eval": ("evaluate", "EvalCommand"),
    "render": ("render", "RenderCommand"),
    "view": ("view", "ViewCommand"),
    "export": ("export", "ExportCommand"),
    "compress": ("compress", "CompressCommand"),
    "mesh": ("mesh", "MeshCommand"),
    "info": ("info", "InfoCommand"),
    "bench": ("bench", "BenchCommand"),
    "doctor": ("doctor", "DoctorCommand"),
    "stress": ("stress", "StressCommand"),
}
_NO_ADVICE = ("For full helptext", "Argument helptext", "Perhaps you meant")


def parse(argv: Sequence[str]) -> Command:
    """Return the command that the arguments specify.

    Raises:
      UsageError: if they are invalid.
      SystemExit: after printing a help text.
    """
    words = list(argv) or ["--help"]
    if words[0] not in (*COMMANDS, "--help", "-h"):
        hint = suggestion(words[0], [*COMMANDS, "--help", "--version"])
        hint = "use it alone" if words[0] == "--version" else hint
        raise UsageError(f"unknown command {words[0]!r} ({hint}); see gsjax --help")
    kinds = [
        Annotated[
            getattr(import_module(f"gsjax.cli.{module}"), kind),
            tyro.conf.subcommand(name),
        ]
        for name, (module, kind) in COMMANDS.items()
    ]
    any_command: Any = Union[tuple(kinds)]  # noqa: UP007
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            return tyro.cli(
                any_command,
                prog="gsjax",
                description="3D Gaussian splatting in pure JAX. "
                "gsjax --version prints the version.",
                args=words,
                config=(tyro.conf.FlagCreatePairsOff, tyro.conf.DisallowNone),
                registry=REGISTRY,
            )
    except SystemExit as exit_:
        if exit_.code in (0, None):
            raise
        text = f"{explanation(box.getvalue())}; see gsjax {words[0]} --help"
        raise UsageError(text) from None


def explanation(box: str) -> str:
    """Return the box that tyro prints about an error as one line."""
    box = re.sub(r"\x1b\[[0-9;]*m", "", box)
    sections: list[list[str]] = [[]]
    for line in box.splitlines():
        if re.match(r"[\s│|]*([╭╰+]|─{3}|-{6})", line):  # a rule between sections
            sections.append([])
        else:
            sections[-1].append(line[2:].rstrip(" │|"))
    parts = []
    for section in sections[1:]:  # the first is the title, if any
        # Help texts of options are indented by 8, remarks follow an empty line.
        shown = [line.strip() for line in section if not line.startswith(" " * 8)]
        text = one_line("\n".join(shown).partition("\n\n")[0])
        text = re.sub(r" \(applied to [^)]*\)", "", text)
        text = re.sub(r"^Error parsing (\S+):", r"\1:", text).rstrip(".")
        if text and not text.startswith(_NO_ADVICE):
            parts.append(text[0].lower() + text[1:])
        elif text.startswith("Perhaps you meant") and "--" in shown[1]:
            place = re.search(r"in (gsjax \w+) --help", " ".join(section))
            name = re.findall(r"--[\w-]+", shown[1])[-1]
            parts.append(f"did you mean {name} of {place[1] if place else 'gsjax'}?")
    return "; ".join(parts) or "invalid arguments"
