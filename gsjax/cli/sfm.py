"""`gsjax sfm`: a dataset with cameras from photographs or a video."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from gsjax.cli.common import Command, UsageError
from gsjax.cli.options import integer
from gsjax.runtime.console import note, say


@dataclass(kw_only=True)
class SfmCommand(Command):
    """Estimate the cameras of photographs or of a video with COLMAP."""

    source: Annotated[Positional[Path], arg(metavar="PHOTOS|VIDEO")]
    """Folder of photographs, or a video."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="DATASET")]
    """Folder for images/, sparse/0/, masks/ and the report sfm.json."""
    matcher: Literal["auto", "exhaustive", "sequential"] = "auto"
    """Match all pairs (exhaustive) or neighbours in order of their names (sequential).
    auto: exhaustive for up to 60 photographs, sequential for more and for video."""
    camera: Literal["auto", "single", "per-image"] = "auto"
    """Which photographs share intrinsics. auto: those of the same size, camera and
    focal length (EXIF)."""
    camera_model: str = "SIMPLE_RADIAL"
    """Camera model of COLMAP that is estimated, such as OPENCV or OPENCV_FISHEYE."""
    undistort: bool = False
    """Resample the photographs to ideal pinholes, which loses some of their border. By
    default they keep their pixels, and gsjax train renders through their lens."""
    max_size: Annotated[int, arg(metavar="PX"), integer(0)] = 1600
    """Longest side in px, to which larger photographs are scaled down, for features and
    in the dataset; 0 for no limit."""
    frames: Annotated[int | None, integer(2)] = None
    """Number of frames to take from a video, evenly spaced, the sharpest of each
    interval; default: 100."""
    moving: bool = False
    """The scene of the video moves: keep the times of the frames, for gsjax train
    --motion. COLMAP leaves out what moves by its geometric verification; it helps to
    cover it with --masks, which are then used for matching only."""
    masks: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder of masks, black where a photograph is ignored: IMG.png or IMG.jpg.png for
    IMG.jpg, of the size of the upright photograph. Transparent pixels are ignored,
    too. Of a video, with --moving: frame_000012.png, of the size in the dataset."""
    seed: Annotated[int, integer(0)] = 0
    """Seed of the random numbers."""
    overwrite: bool = False
    """Replace a dataset that this command wrote."""

    def run(self) -> int:
        if 0 < self.max_size < 64:
            fault = f"expected 0 or at least 64, got {self.max_size}"
            raise UsageError(f"--max-size: {fault}")
        if self.moving and self.source.is_dir():
            fault = f"--moving goes with a video; {self.source} is a folder"
            raise UsageError(f"{fault}, whose photographs have no times")
        if self.frames is not None and self.source.is_dir():
            raise UsageError(f"--frames goes with a video; {self.source} is a folder")
        from gsjax.errors import SfmError
        from gsjax.sfm.reconstruction import SfmSettings, run_sfm

        settings = SfmSettings(
            matcher=self.matcher,
            camera=self.camera,
            camera_model=self.camera_model.upper(),
            max_size=self.max_size,
            frames=self.frames or SfmSettings.frames,
            masks=self.masks,
            seed=self.seed,
            undistort=self.undistort,
            moving=self.moving,
        )
        report = run_sfm(
            self.source, self.out, settings, overwrite=self.overwrite, progress=note
        )
        lines = {n: f"registered, {m} points" for n, m in report.registered.items()}
        for folder, names in report.scenes.items():
            lines |= dict.fromkeys(names, f"in {folder}")
        lines |= {n: f"not registered: {why}" for n, why in report.unregistered.items()}
        for name in sorted(lines):
            say(f"{name}  {lines[name]}")
        say(
            f"{len(report.registered)} of {len(lines)} images registered, "
            f"{report.points} points, reprojection error "
            f"{report.mean_reprojection_error:.2f} px, track length "
            f"{report.mean_track_length:.1f} images"
        )
        for line in report.told_scenes():
            say(line)
        if len(report.tried) > 1:
            note(f"tried {'; '.join(report.tried)}")
        if report.times is not None:
            say(report.times)
        note(", ".join(f"{stage} {s:.1f} s" for stage, s in report.seconds.items()))
        if report.problem is not None:
            raise SfmError(report.problem)
        return 0
