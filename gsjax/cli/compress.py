"""`gsjax compress`: a scene as a small file, for a stated loss or size."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from gsjax.cli.common import HeavyCommand, UsageError, start_jax
from gsjax.cli.options import OptionSpec, integer, option
from gsjax.runtime.console import say

_UNITS = {"": 1, "b": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9}


def _decibels() -> OptionSpec[float | None]:
    def parse(text: str) -> float:
        found = re.fullmatch(r"([0-9.]+) ?(dB)?", text, re.I)
        try:
            value = float(found[1]) if found else 0.0
        except ValueError:
            value = 0.0
        if not 0 < value < 100:
            raise ValueError(f"expected a loss in dB such as 0.3dB, got {text!r}")
        return value

    return option("LOSS", parse)


def _size() -> OptionSpec[int | None]:
    def parse(text: str) -> int:
        found = re.fullmatch(r"([0-9.]+) ?([kMG]?B)?", text, re.I)
        try:
            size = float(found[1]) * _UNITS[(found[2] or "").lower()] if found else 0
        except ValueError:
            size = 0
        if not 1 <= size < 2**53:
            raise ValueError(f"expected a size such as 5MB or 800kB, got {text!r}")
        return int(size)

    return option("SIZE", parse)


def _budget() -> OptionSpec[float | None]:
    def parse(text: str) -> float:
        above, _, below = text.partition("/")
        try:
            value = float(above) / float(below or 1)
        except (ValueError, ZeroDivisionError):
            value = 0.0
        if not 0 < value < 1:
            raise ValueError(f"expected an error such as 2/255, got {text!r}")
        return value

    return option("ERROR", parse)


@dataclass(kw_only=True)
class CompressCommand(HeavyCommand):
    """Write a scene as a small file that meets a loss or a size."""

    scene: Annotated[Positional[Path], arg(metavar="RUN|FILE")]
    """Folder of a run, or a file of Gaussians. Held-out views of the run measure the
    loss; a file is measured against its own pictures."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="OUT.sog")]
    """File to write: .sog is the smallest, .spz the next; .compressed.ply, .glb and
    .ply only get fewer Gaussians and harmonics. Its folder is created if missing."""
    max_loss: Annotated[float | None, _decibels()] = None
    """Largest loss of PSNR on the held-out views, such as 0.3dB, which is the default.
    Without photographs it is an estimate for a scene that matches them at 30 dB."""
    max_size: Annotated[int | None, _size()] = None
    """Largest size of the file, such as 5MB or 800kB."""
    budget: Annotated[float | None, _budget()] = None
    """Largest error of a colour against the scene before, such as 4/255."""
    cameras: Annotated[Path | None, arg(metavar="FILE.json")] = None
    """Cameras of a file of Gaussians, a transforms.json. Default: a sphere about it."""
    finetune: Annotated[int | None, integer(1)] = None
    """Train what is kept for this many steps on the photographs of a run, with the
    rounding in the loop, in each of up to four trials: smaller files, more time."""
    lod: Annotated[int, integer(1, 8)] = 1
    """Level of detail: number of files, OUT-1.sog, OUT-2.sog, …. The first holds the
    most important tenth of the Gaussians, which already shows the scene; the limits are
    those of all files together."""
    overwrite: bool = False
    """Replace an existing file."""

    def run(self) -> int:
        start_jax()
        from gsjax.compression.parts import part_path
        from gsjax.compression.types import Goal
        from gsjax.runs.compression import compress_scene

        goals = {
            "max_loss": self.max_loss,
            "max_size": self.max_size,
            "max_error": self.budget,
        }
        given = {name: value for name, value in goals.items() if value is not None}
        if len(given) > 1:
            raise UsageError("pass one of --max-loss, --max-size and --budget")
        goal = Goal(**(given or {"max_loss": 0.3}), parts=self.lod)
        result = compress_scene(
            self.scene,
            self.out,
            goal,
            cameras=self.cameras,
            finetune_steps=self.finetune or 0,
            overwrite=self.overwrite,
        )
        for line in result.lines():
            say(line)
        for part, data in enumerate(result.files, 1):
            path = part_path(self.out, part, len(result.files))
            say(f"{path}  {len(data) / 1e6:.2f} MB")
        return 0
