"""`gsjax demo`: synthetic photographs, a scene trained on them, and a turntable."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

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
    a movie."""

    out: Annotated[Path, arg(aliases=["-o"], metavar="DIR")] = Path("gsjax-demo")
    """Folder for dataset/, run/ and the movie turntable.webp; created if missing."""
    steps: Annotated[int | None, integer(1)] = None
    """Number of training steps; default: 600, or 3000 with --moving."""
    size: Size = (256, 192)
    """Size of the photographs."""
    photos: Annotated[int | None, integer(2, 1000)] = None
    """Number of photographs, of which an eighth is held out for evaluation; default:
    40. With --moving, those of the camera that travels; default: 32, or 96 if
    --monocular."""
    moving: bool = False
    """Animate the still life, photograph it with eight fixed cameras and one that
    travels, and train a scene that moves."""
    motion: Literal["field", "trajectories"] = "trajectories"
    """With --moving: how the scene moves, see gsjax train."""
    monocular: bool = False
    """With --moving: without the fixed cameras, so one photograph at each time."""
    seed: Annotated[int, integer(0)] = 0
    """Seed of the initial points and of the training."""
    overwrite: bool = False
    """Replace an existing demo."""

    def run(self) -> int:
        width, height = self.size
        if min(width, height) < 16:
            raise UsageError(f"--size {width}x{height}: expected at least 16x16")
        if self.monocular and not self.moving:
            raise UsageError("--monocular goes with --moving")
        if self.motion != "trajectories" and not self.moving:
            raise UsageError("--motion goes with --moving")
        start_jax()
        files, result = self._run(width, height)
        if not result.finished:
            again = command_line("train", files.dataset, "-o", files.run, "--resume")
            note(f"stopped after step {result.step}; resume with {again}")
            return 130
        written = result.files
        for path in (written.splat, written.preview, written.curves, files.movie):
            say(str(path))
        say_result(result)
        views = ("--path", "test", "-o", self.out / "views")
        opaque = (self.out / "scene.ply", "--min-opacity", "0.01")
        note("done; next, try")
        note(f"  {view_hint(files.run)}")
        note(f"  {command_line('info', files.run)}")
        note(f"  {command_line('render', files.run, *views)}")
        note(f"  {command_line('export', files.run, *opaque)}")
        if self.moving:
            note("and with your own video")
            note("  gsjax sfm VIDEO -o DATASET --moving")
            note(f"  gsjax train DATASET -o RUN --motion {self.motion} --preset fast")
            return 0
        note("and with your own photographs")
        note("  gsjax sfm PHOTOS -o DATASET")
        note("  gsjax train DATASET -o RUN --preset fast")
        return 0

    def _run(self, width: int, height: int):
        """Return the files and the result of the demo."""
        if not self.moving:
            from gsjax.runs.demo import STEPS, DemoSettings, run_demo

            steps, photos = self.steps or STEPS, self.photos or 40
            still = DemoSettings(photos, width, height, steps, self.seed)
            return run_demo(self.out, still, overwrite=self.overwrite)
        from gsjax.runs.moving_demo import STEPS, run_moving_demo
        from gsjax.synthetic.moving import MovingDemoSettings

        settings = MovingDemoSettings(width=width, height=height, seed=self.seed)
        photos = self.photos or settings.photos
        if self.monocular:
            settings = settings._replace(cameras=0)
            photos = self.photos or 96
        return run_moving_demo(
            self.out,
            settings._replace(photos=photos),
            motion=self.motion,
            steps=self.steps or STEPS,
            overwrite=self.overwrite,
        )
