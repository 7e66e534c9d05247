"""`gsjax render`: images of a scene from a list of cameras."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from gsjax.commands.common import (
    Command,
    parse_background,
    parse_kinds,
    parse_size,
    use_all_cores,
)


@dataclass(kw_only=True)
class RenderCommand(Command):
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

        size = None if self.size is None else parse_size(self.size)
        kinds, background = parse_kinds(self.what), parse_background(self.background)
        use_all_cores()
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
