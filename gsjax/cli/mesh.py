"""`gsjax mesh`: a run as a triangle mesh."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from gsjax.cli.common import HeavyCommand, UsageError, start_jax
from gsjax.cli.options import integer
from gsjax.runtime.console import say


@dataclass(kw_only=True)
class MeshCommand(HeavyCommand):
    """Make a triangle mesh of a run, to print, measure or view."""

    run_folder: Annotated[Positional[Path], arg(metavar="RUN")]
    """Folder of a run; surfels give the best meshes (gsjax train --primitive
    surfel)."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="MESH")]
    """File to write: .ply, .glb, .obj or .stl (without colours)."""
    resolution: Annotated[int, integer(8, 4096)] = 256
    """Voxels along the longest side of the box."""
    box: Annotated[str | None, arg(metavar="X,Y,Z,X,Y,Z")] = None
    """Corners of the box in the coordinates of the dataset. Default: a box that holds
    the opaque Gaussians but for 2 % on each side."""
    depth: Literal["median", "expected"] = "median"
    """Depth of a pixel: where half of the light has been blocked, or the mean."""
    parts: Annotated[int, integer(0)] = 1
    """Number of connected parts to keep, the largest; 0 keeps all."""
    closed: bool = False
    """Close the mesh where no view has seen anything, so that it is watertight."""
    overwrite: bool = False
    """Replace an existing file."""

    def run(self) -> int:
        start_jax()
        from gsjax.mesh.surface import SUFFIXES
        from gsjax.runs.mesh import MeshSettings, mesh_of_run

        if self.out.suffix.lower() not in SUFFIXES:
            expected = ", ".join(SUFFIXES)
            raise UsageError(f"-o {self.out}: expected a suffix of {expected}")
        settings = MeshSettings(
            self.resolution, self._corners(), self.depth, self.parts, self.closed
        )
        report = mesh_of_run(
            self.run_folder, self.out, settings, overwrite=self.overwrite
        )
        triangles, shape = len(report.mesh.faces), "open"
        if report.watertight:
            shape = "watertight"
        of_all = f", {self.parts} of {report.parts} parts" if self.parts else ""
        text = f"{triangles:,} triangles, {shape}{of_all}, voxels {report.voxel:.4g}"
        say(f"{self.out}  {text}, {report.seconds:.1f} s")
        return 0

    def _corners(self):
        """Return the corners of --box."""
        if self.box is None:
            return None
        try:
            numbers = [float(word) for word in self.box.split(",")]
        except ValueError:
            numbers = []
        if len(numbers) != 6:
            raise UsageError(f"--box: expected six numbers, got {self.box!r}")
        return tuple(numbers[:3]), tuple(numbers[3:])
