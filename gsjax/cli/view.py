"""`gsjax view`: a scene in the browser, or as an HTML page."""

import time
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from gsjax.cli.common import HeavyCommand, UsageError, check_output, start_jax
from gsjax.cli.options import integer, real
from gsjax.cli.page import PAGE_SUFFIXES, write_scene_page
from gsjax.runtime.console import note, say


@dataclass(kw_only=True)
class ViewCommand(HeavyCommand):
    """View a scene in the browser. Requires gsjax[viewer]."""

    scene: Annotated[Positional[Path], arg(metavar="RUN|PLY")]
    """Folder of a run, or a file of Gaussians: .ply, .sog, .spz, .glb and others."""
    html: Annotated[Path | None, arg(metavar="OUT.html")] = None
    """Write a page that opens offline, instead of serving."""
    mesh: bool = False
    """Show the mesh that gsjax mesh wrote beside the scene; the browser shows the
    splats too, a page the mesh alone."""
    min_opacity: Annotated[float, real(0, 1)] = 0.0
    """Leave out Gaussians below this opacity; the browser never draws those below
    0.01."""
    max_gaussians: Annotated[int | None, integer(1)] = None
    """Maximum number of Gaussians in the browser; the largest and most opaque are
    kept."""
    ordered: bool = False
    """The file lists Gaussians by importance, which decides what is kept and what
    appears first; default: opacity times area decides."""
    parts: Annotated[int | None, integer(1, 8)] = None
    """Number of parts in which the Gaussians of a page appear while it loads, the most
    important first; default: two from 100,000 Gaussians on."""
    no_photos: bool = False
    """Show the cameras of a run without their photographs."""
    up: Literal["+x", "-x", "+y", "-y", "+z", "-z"] | None = None
    """Up direction; default: that of the cameras of a run, or -y for a file."""
    preset: Literal["compat", "accurate", "fast"] | None = None
    """Settings of the exact render, see RasterConfig; default: those of the run, or
    compat for a file."""
    host: str = "127.0.0.1"
    """Address to serve at; 0.0.0.0 for access from other machines."""
    port: Annotated[int, integer(1, 65535)] = 8080
    """Port to serve at, or the next free one."""
    overwrite: bool = False
    """Replace an existing page."""

    def run(self) -> int:
        from gsjax.viewer.viser_server import require_viser

        require_viser()
        check_output("--html", self.html, self.overwrite, *PAGE_SUFFIXES)
        if self.parts is not None and self.html is None:
            raise UsageError("--parts goes with --html")
        start_jax()
        from gsjax.runs.scene_source import RASTER_PRESETS
        from gsjax.viewer.opening import load_content

        shown = load_content(
            self.scene,
            up=self.up,
            raster=RASTER_PRESETS[self.preset]() if self.preset else None,
            min_opacity=self.min_opacity,
            max_gaussians=self.max_gaussians,
            with_mesh=self.mesh,
        )
        shown.content.ordered = self.ordered
        with_photos = not self.no_photos
        if self.html is None:
            return self._serve(shown.content, shown.views if with_photos else ())
        write_scene_page(
            shown,
            self.html,
            title=self.scene.stem,
            with_photos=with_photos,
            parts=self.parts,
        )
        return 0

    def _serve(self, content, views) -> int:
        from gsjax.viewer.opening import frusta_with_photos
        from gsjax.viewer.server import ViewerServer

        server = ViewerServer(content, host=self.host, port=self.port)
        with closing(server), suppress(KeyboardInterrupt):  # the usual way to stop it
            say(server.url)
            note("open it in a browser; Ctrl-C stops serving")
            if views:
                server.show_cameras(frusta_with_photos(views))
            while True:
                time.sleep(1)
        return 0
