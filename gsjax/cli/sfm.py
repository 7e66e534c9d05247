"""`gsjax sfm`: photographs or a video to a dataset with cameras."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from gsjax.cli.common import Command, UsageError
from gsjax.runtime.console import note, say


@dataclass(kw_only=True)
class SfmCommand(Command):
    """Find the cameras of photos or of a video (COLMAP), for training on them."""

    source: Annotated[Positional[Path], arg(metavar="PHOTOS|VIDEO")]
    """A folder of photos, or a video."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="DATASET")]
    """Folder for images/, sparse/0/, masks/ and the report sfm.json."""
    matcher: Literal["auto", "exhaustive", "sequential"] = "auto"
    """Match all pairs, or neighbours in order of the names; auto: all pairs of at most
    60 photos, neighbours of more and of video."""
    camera: Literal["auto", "single", "per-image"] = "auto"
    """Which photos share intrinsics; auto: those of the same size, camera and focal
    length (EXIF)."""
    max_size: Annotated[int, arg(metavar="PX")] = 1600
    """Longer side: larger photos are scaled down to it, for the features and in the
    dataset; 0 leaves them as they are."""
    frames: int | None = None
    """How many frames of a video to take, the sharpest of each stretch; default:
    100."""
    masks: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder of masks, black where a photo is to be ignored: for IMG.jpg, IMG.png or
    IMG.jpg.png, as large as the photo seen upright. Where a photo is transparent it is
    ignored too."""
    seed: int = 0
    """Of the random numbers."""
    overwrite: bool = False
    """Replace a dataset that this command wrote."""

    def run(self) -> int:
        if self.max_size < 64 and self.max_size != 0:
            raise UsageError(f"--max-size {self.max_size}: 64 or more, or 0, is wanted")
        if self.frames is not None and self.frames < 2:
            raise UsageError(f"--frames {self.frames}: 2 or more are wanted")
        if self.frames is not None and self.source.is_dir():
            raise UsageError(f"--frames are of a video, and {self.source} is a folder")
        if not 0 <= self.seed < 2**31:
            raise UsageError(f"--seed {self.seed}: from 0 to {2**31 - 1} is wanted")
        from gsjax.errors import SfmError
        from gsjax.sfm.reconstruction import SfmSettings, run_sfm

        settings = SfmSettings(
            matcher=self.matcher,
            camera=self.camera,
            max_size=self.max_size,
            frames=self.frames or SfmSettings.frames,
            masks=self.masks,
            seed=self.seed,
        )
        report = run_sfm(
            self.source, self.out, settings, overwrite=self.overwrite, tell=note
        )
        lines = {
            name: f"registered, {n} points" for name, n in report.registered.items()
        }
        lines |= {n: f"not registered: {why}" for n, why in report.unregistered.items()}
        for name in sorted(lines):
            say(f"{name}  {lines[name]}")
        say(
            f"{len(report.registered)} of {len(lines)} images registered, "
            f"{report.points} points, reprojection error "
            f"{report.mean_reprojection_error:.2f} px, each point in "
            f"{report.mean_track_length:.1f} images"
        )
        note(", ".join(f"{what} {s:.1f} s" for what, s in report.seconds.items()))
        if report.problem is not None:
            raise SfmError(report.problem)
        return 0
