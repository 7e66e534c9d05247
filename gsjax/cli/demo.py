"""`gsjax demo`: photographs from nothing, a scene trained on them, and a turntable."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from gsjax.cli.common import (
    HeavyCommand,
    UsageError,
    command_line,
    parse_size,
    start_jax,
    view_hint,
)
from gsjax.runtime.console import decibels, note, say


@dataclass(kw_only=True)
class DemoCommand(HeavyCommand):
    """Take photographs of a made-up still life, train a scene on them, and show it."""

    out: Annotated[Path, arg(aliases=["-o"], metavar="DIR")] = Path("gsjax-demo")
    """Folder for dataset/, run/ and turntable.webp; created if missing."""
    steps: int = 600
    """Steps of training."""
    size: Annotated[str, arg(metavar="WxH")] = "256x192"
    """Size of the photographs."""
    photos: int = 40
    """How many; every 8th is held out to measure with."""
    seed: int = 0
    """Of the points to start from, and of the training."""
    overwrite: bool = False
    """Replace a demonstration that exists."""

    def run(self) -> int:
        width, height = parse_size(self.size)
        if min(width, height) < 16:
            raise UsageError(f"--size {self.size}: from 16x16")
        if not 1 <= self.steps < 2**31 - 1:
            raise UsageError(f"--steps {self.steps}: from 1 to {2**31 - 2} is wanted")
        if not 2 <= self.photos <= 1000:
            raise UsageError(f"--photos {self.photos}: from 2 to 1000 is wanted")
        if not 0 <= self.seed < 2**31:
            raise UsageError(f"--seed {self.seed}: from 0 to {2**31 - 1} is wanted")
        start_jax()
        from gsjax.runs.demo import DemoSettings, run_demo

        settings = DemoSettings(self.photos, width, height, self.steps, self.seed)
        files, result = run_demo(self.out, settings, overwrite=self.overwrite)
        if not result.finished:
            again = command_line("train", files.dataset, "-o", files.run, "--resume")
            note(f"stopped after step {result.step}; go on with {again}")
            return 130
        summary = result.summary
        assert summary is not None, "some views are held out"
        for path in (
            result.files.splat,
            result.files.preview,
            result.files.curves,
            files.turntable,
        ):
            say(str(path))
        say(
            f"{result.gaussians:,} Gaussians, {result.seconds:.0f} s; "
            f"{summary.views} held-out views: PSNR {decibels(summary.psnr)}, "
            f"SSIM {summary.ssim:.4f}"
        )
        note("done; next, try")
        note(f"  {view_hint(files.run)}")
        views, small = ("--path", "test", "-o", self.out / "views"), "--min-opacity"
        ply = self.out / "scene.ply"
        note(f"  {command_line('info', files.run)}")
        note(f"  {command_line('render', files.run, *views)}")
        note(f"  {command_line('export', files.run, ply, small, '0.01')}")
        note("and with photographs of your own")
        note("  gsjax sfm PHOTOS -o DATASET")
        note("  gsjax train DATASET -o RUN --preset fast")
        return 0
