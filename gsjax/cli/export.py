"""`gsjax export`: a scene as a file for other programs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from gsjax.cli.common import HeavyCommand, UsageError, start_jax
from gsjax.cli.options import integer, real
from gsjax.cli.page import PAGE_SUFFIXES, write_scene_page
from gsjax.runtime.console import say
from gsjax.runtime.files import reject_existing


@dataclass(kw_only=True)
class ExportCommand(HeavyCommand):
    """Write a scene for other programs, in the coordinates of its dataset."""

    scene: Annotated[Positional[Path], arg(metavar="RUN|PLY")]
    """Folder of a run, or a file of Gaussians: .ply, .sog, .spz, .glb and others."""
    out: Annotated[Positional[Path], arg(metavar="OUT.ply")]
    """File to write: .ply; .compressed.ply; .sog, or meta.json for a SOG folder; .spz;
    .glb; .splat, without spherical harmonics; or .html, the page of gsjax view --html.
    Its folder is created if missing."""
    sh_degree: Literal[0, 1, 2, 3, 4] | None = None
    """SH degree to write: higher bands are dropped, missing ones are zero. Some viewers
    read degree 3 only. A page has degree 0."""
    min_opacity: Annotated[float, real(0, 1)] = 0.0
    """Leave out Gaussians below this opacity; 0.005 is hardly visible."""
    time: Annotated[float, real(0, 1.0000001)] = 0.0
    """Moment of a scene that moves, from 0 to 1."""
    frames: Annotated[int | None, integer(2, 100_000)] = None
    """Write this many moments of a scene that moves as OUT_0000.ply and so on, with the
    Gaussians in the same order, and a manifest OUT.json."""
    overwrite: bool = False
    """Replace an existing file."""

    def run(self) -> int:
        if self.out.suffix.lower() in PAGE_SUFFIXES:
            return self._write_page()
        start_jax()
        if self.frames is not None:
            return self._write_frames()
        from gsjax.io.formats import stored_bytes
        from gsjax.runs.export import export_scene

        written, found = export_scene(
            self.scene,
            self.out,
            sh_degree=self.sh_degree,
            min_opacity=self.min_opacity,
            time=self.time,
            overwrite=self.overwrite,
        )
        of_all = f" of {found:,}" if written < found else ""
        size = stored_bytes(self.out) / 2**20
        say(f"{self.out}  {written:,}{of_all} Gaussians, {size:.2f} MiB")
        return 0

    def _write_frames(self) -> int:
        """Write a sequence of moments."""
        given = {
            "--time": self.time,
            "--sh-degree": self.sh_degree,
            "--min-opacity": self.min_opacity,
        }
        for option, value in given.items():
            if value:
                raise UsageError(f"--frames and {option} exclude each other")
        from gsjax.runs.export import export_frames

        assert self.frames is not None
        files = export_frames(
            self.scene, self.out, self.frames, overwrite=self.overwrite
        )
        size = sum(path.stat().st_size for path in files) / 2**20
        say(f"{files[0]} … {files[-2].name}, {self.frames} moments, {size:.2f} MiB")
        say(str(files[-1]))
        return 0

    def _write_page(self) -> int:
        """Write what `gsjax view --html` writes."""
        if self.sh_degree:
            fault = "a page has one colour for all directions, SH degree 0"
            raise UsageError(f"--sh-degree {self.sh_degree}: {fault}; leave it out")
        from gsjax.viewer.viser_server import require_viser

        require_viser()
        reject_existing([self.out], self.overwrite)
        start_jax()
        from gsjax.viewer.opening import load_content

        shown = load_content(self.scene, min_opacity=self.min_opacity)
        write_scene_page(shown, self.out, title=self.scene.stem)
        return 0
