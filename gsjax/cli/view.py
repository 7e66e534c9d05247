"""`gsjax view`: a scene in the browser, or as a page."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from gsjax.cli.common import HeavyCommand, UsageError, start_jax
from gsjax.runtime.console import note, say

_LARGE_PAGE = 32 * 2**20
_PHOTO_OF_PAGE = 160  # px, longest side


@dataclass(kw_only=True)
class ViewCommand(HeavyCommand):
    """Look at a scene in the browser; needs the extra gsjax[viewer]."""

    scene: Annotated[Positional[Path], arg(metavar="RUN|PLY")]
    """The Gaussians: a .ply or .spz file, or the folder of a run."""
    html: Annotated[Path | None, arg(metavar="OUT.html")] = None
    """Write one page that opens offline instead of serving."""
    min_opacity: float = 0.0
    """Leave out fainter Gaussians; those below 0.01 the browser never draws anyway."""
    max_gaussians: int | None = None
    """At most that many in the browser, the largest and most opaque first."""
    no_photos: bool = False
    """Of a run: the cameras without their photographs."""
    up: Literal["+x", "-x", "+y", "-y", "+z", "-z"] | None = None
    """Which way is up; default: as the cameras of a run are held, of a .ply -y."""
    preset: Literal["compat", "accurate", "fast"] | None = None
    """Constants of the exact picture, see RasterConfig; default: those of the run, of
    a .ply compat."""
    host: str = "127.0.0.1"
    """Where to serve; 0.0.0.0 lets other machines look."""
    port: int = 8080
    """The next free one if it is taken."""
    overwrite: bool = False
    """Replace a page that exists."""

    def run(self) -> int:
        if not 0 <= self.min_opacity < 1:
            raise UsageError(f"--min-opacity {self.min_opacity:g}: from 0 to below 1")
        if self.max_gaussians is not None and self.max_gaussians < 1:
            raise UsageError("--max-gaussians from 1")
        if not 1 <= self.port < 2**16:
            raise UsageError(f"--port {self.port}: from 1 to 65535 is wanted")
        from gsjax.runtime import files
        from gsjax.viewer.stage import require_viser

        require_viser()
        if self.html is not None:
            if self.html.suffix.lower() not in (".html", ".htm"):
                raise UsageError(f"--html {self.html}: a name in .html is wanted")
            files.refuse_existing(
                [self.html], self.overwrite, "another name with --html"
            )
        start_jax()
        from gsjax.viewer.opening import open_exhibit

        shown = open_exhibit(
            self.scene,
            up=self.up,
            preset=self.preset,
            min_opacity=self.min_opacity,
            max_gaussians=self.max_gaussians,
        )
        views = () if self.no_photos else shown.views
        if self.html is not None:
            return self._write(self.html, shown.exhibit, views)
        return self._serve(shown.exhibit, views)

    def _write(self, path: Path, exhibit, views) -> int:
        from gsjax.viewer.opening import photographed
        from gsjax.viewer.page import write_page
        from gsjax.viewer.splats import LEAST_OPACITY

        if views:
            exhibit.frusta = photographed(views, _PHOTO_OF_PAGE)
        page = write_page(exhibit, path, title=self.scene.stem)
        less = f" of {page.found:,}" if page.drawn < page.found else ""
        faint = max(self.min_opacity, LEAST_OPACITY)
        if less and self.max_gaussians is None:
            gone = f"{page.found - page.drawn:,} of {page.found:,} Gaussians left out"
            note(f"{gone}: too faint (opacity below {faint:g}), or not finite")
        count = len(exhibit.frusta)
        cameras = f", {count} camera{'s' * (count != 1)}" if count else ""
        say(
            f"{path}  {page.drawn:,}{less} Gaussians{cameras}, "
            f"{page.size / 2**20:.2f} MiB"
        )
        if page.size > _LARGE_PAGE:
            note("a page this large opens slowly; --max-gaussians N makes it smaller")
        return 0

    def _serve(self, exhibit, views) -> int:
        from gsjax.viewer.opening import photographed
        from gsjax.viewer.window import Window

        window = Window(exhibit, host=self.host, port=self.port)
        try:
            say(window.url)
            note("open it in a browser; Ctrl-C ends")
            if views:
                window.show_cameras(photographed(views))
            while True:
                time.sleep(1)
        except KeyboardInterrupt:
            return 0  # how a server is meant to end
        finally:
            window.close()
