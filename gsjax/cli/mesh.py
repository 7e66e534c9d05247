"""`gsjax mesh`: a run as a triangle mesh."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from gsjax.cli.common import HeavyCommand, UsageError, start_jax
from gsjax.cli.options import integer, real
from gsjax.runtime.console import say


@dataclass(kw_only=True)
class MeshCommand(HeavyCommand):
    """Make a triangle mesh of a scene, to print, measure or view."""

    scene: Annotated[Positional[Path], arg(metavar="RUN|PLY")]
    """Folder of a run, or a file of Gaussians (with --sphere); surfels give the best
    meshes (gsjax train --primitive surfel)."""
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="MESH")] = None
    """File to write: .ply, .glb, .obj or .stl (without colours). Default: mesh.ply in
    the folder of the run, where gsjax view --mesh finds it."""
    resolution: Annotated[int, integer(8, 4096)] = 256
    """Voxels along the longest side of the box."""
    box: Annotated[str | None, arg(metavar="X,Y,Z,X,Y,Z")] = None
    """Corners of the box in the coordinates of the dataset. Default: a box that holds
    the opaque Gaussians but for 2 % on each side."""
    unbounded: bool = False
    """Mesh all that the views show; voxels grow with the distance from the box, which
    takes half of the voxels of each axis."""
    sphere: Annotated[int, integer(0, 10_000)] = 0
    """Take depth from this many views on a sphere about the box, not from the training
    views."""
    depth: Literal["median", "expected"] | None = None
    """Depth of a pixel: where half of the light has been blocked, or the mean. Default:
    median, or expected with --unbounded."""
    truncation: Annotated[float, real(1, 100)] = 4.0
    """Depth behind the surface, in voxels, to which an image counts: more for noisy
    depth, less for thin objects."""
    parts: Annotated[int | None, integer(0)] = None
    """Number of connected parts to keep, the largest; 0 keeps all. Default: those with
    at least 1 % of the triangles."""
    closed: bool = False
    """Make a watertight solid for printing: what no view has seen behind a surface is
    filled, down to the sides of the box."""
    fill_holes: bool = False
    """Close each hole by triangles about its middle."""
    triangles: Annotated[int | None, integer(4)] = None
    """Reduce the mesh to about this many triangles."""
    overwrite: bool = False
    """Replace an existing file."""

    def run(self) -> int:
        start_jax()
        from gsjax.mesh.surface import SUFFIXES
        from gsjax.runs.mesh import MeshSettings, default_mesh, mesh_of_run

        out = self.out or default_mesh(self.scene)
        if out.suffix.lower() not in SUFFIXES:
            expected = ", ".join(SUFFIXES)
            raise UsageError(f"-o {out}: expected a suffix of {expected}")
        settings = MeshSettings(
            resolution=self.resolution,
            box=self._corners(),
            unbounded=self.unbounded,
            sphere=self.sphere,
            depth=self.depth,
            truncation=self.truncation,
            parts=self.parts,
            closed=self.closed,
            fill_holes=self.fill_holes,
            triangles=self.triangles,
        )
        report = mesh_of_run(self.scene, out, settings, overwrite=self.overwrite)
        triangles, shape = len(report.mesh.faces), "open"
        if report.watertight:
            shape = "watertight"
        kept, found = report.parts
        parts = f"{kept} of {found} part{'s' * (found != 1)}"
        text = f"{triangles:,} triangles, {shape}, {parts}, voxels {report.voxel:.4g}"
        say(f"{out}  {text}, {report.seconds:.1f} s")
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
