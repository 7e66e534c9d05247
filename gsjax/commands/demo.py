"""`gsjax demo`: a made-up scene, rendered, and files to try the others on."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from gsjax.commands.common import Command, UsageError, parse_size, use_all_cores
from gsjax.console import note, say


@dataclass(kw_only=True)
class DemoCommand(Command):
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
        width, height = parse_size(self.size)
        if min(self.gaussians, self.frames, width // 2, height // 2) < 1:
            raise UsageError("--gaussians and --frames from 1, --size from 2x2")
        use_all_cores()
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
