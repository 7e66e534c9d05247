"""`gsjax export`: a scene to a file that viewers read."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from gsjax.cli.common import HeavyCommand, UsageError, start_jax
from gsjax.runtime.console import say


@dataclass(kw_only=True)
class ExportCommand(HeavyCommand):
    """Write a scene as a standard PLY, or as a smaller .spz or .splat, in the
    coordinates of its dataset."""

    scene: Annotated[Positional[Path], arg(metavar="RUN|PLY")]
    """The Gaussians: a .ply or .spz file, or the folder of a run."""
    out: Annotated[Positional[Path], arg(metavar="OUT.ply")]
    """The file to write: .ply, .spz, about a fifth as large, or .splat, without
    harmonics; folders above it are created."""
    sh_degree: Literal[0, 1, 2, 3, 4] | None = None
    """Degree of the spherical harmonics: higher ones are cut, lower ones filled up
    with zeros (some viewers read degree 3 only)."""
    min_opacity: float = 0.0
    """Leave out Gaussians of a lower opacity; 0.005 is hardly seen."""
    overwrite: bool = False
    """Replace a file that exists."""

    def run(self) -> int:
        if not 0 <= self.min_opacity < 1:
            raise UsageError(f"--min-opacity {self.min_opacity:g}: from 0 to below 1")
        start_jax()
        from gsjax.runs.export import export_scene

        written, found = export_scene(
            self.scene,
            self.out,
            sh_degree=self.sh_degree,
            min_opacity=self.min_opacity,
            overwrite=self.overwrite,
        )
        less = f" of {found:,}" if written < found else ""
        size = self.out.stat().st_size / 2**20
        say(f"{self.out}  {written:,}{less} Gaussians, {size:.2f} MiB")
        return 0
