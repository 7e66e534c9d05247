"""`gsjax demo`: synthetic photographs, a scene trained on them, and a turntable."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from gsjax.cli.common import (
    HeavyCommand,
    UsageError,
    command_line,
    say_result,
    start_jax,
    view_hint,
)
from gsjax.cli.options import Size, integer
from gsjax.runtime.console import note, say


@dataclass(kw_only=True)
class DemoCommand(HeavyCommand):
    """Render photographs of a synthetic still life, train a scene on them, and render
    a turntable."""

    out: Annotated[Path, arg(aliases=["-o"], metavar="DIR")] = Path("gsjax-demo")
    """Folder for dataset/, run/ and turntable.webp; created if missing."""
    steps: Annotated[int, integer(1)] = 600
    """Number of training steps."""
    size: Size = (256, 192)
    """Size of the photographs."""
    photos: Annotated[int, integer(2, 1000)] = 40
    """Number of photographs; every 8th is held out for evaluation."""
    seed: Annotated[int, integer(0)] = 0
    """Seed of the initial points and of the training."""
    overwrite: bool = False
    """Replace an existing demo."""

    def run(self) -> int:
        width, height = self.size
        if min(width, height) < 16:
            raise UsageError(f"--size {width}x{height}: expected at least 16x16")
        start_jax()
        from gsjax.runs.demo import DemoSettings, run_demo

        settings = DemoSettings(self.photos, width, height, self.steps, self.seed)
        files, result = run_demo(self.out, settings, overwrite=self.overwrite)
        if not result.finished:
            again = command_line("train", files.dataset, "-o", files.run, "--resume")
            note(f"stopped after step {result.step}; resume with {again}")
            return 130
        written = result.files
        for path in (written.splat, written.preview, written.curves, files.turntable):
            say(str(path))
        say_result(result)
        views = ("--path", "test", "-o", self.out / "views")
        opaque = (self.out / "scene.ply", "--min-opacity", "0.01")
        note("done; next, try")
        note(f"  {view_hint(files.run)}")
        note(f"  {command_line('info', files.run)}")
        note(f"  {command_line('render', files.run, *views)}")
        note(f"  {command_line('export', files.run, *opaque)}")
        note("and with your own photographs")
        note("  gsjax sfm PHOTOS -o DATASET")
        note("  gsjax train DATASET -o RUN --preset fast")
        return 0
