"""`gsjax render`: images and movies of a scene."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from gsjax.cli.common import HeavyCommand, UsageError, start_jax
from gsjax.cli.options import Budget, Color, Kinds, OptionalSize, Times, integer, real
from gsjax.runtime.console import note, say

_MOVIES = (".mp4", ".webm", ".webp", ".gif")
_REJECTED = (".mov", ".m4v", ".avi", ".mkv", ".png", ".jpg", ".jpeg")


@dataclass(kw_only=True)
class RenderCommand(HeavyCommand):
    """Render a scene from given cameras or along a path, as images or a movie."""

    scene: Annotated[Positional[Path], arg(metavar="RUN|PLY")]
    """Folder of a run, or a file of Gaussians: .ply, .sog, .spz, .glb and others."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="DIR|MOVIE")]
    """Folder for the images, created if missing; or a movie: .mp4 (requires
    gsjax[movies]), .webm, .webp or .gif."""
    cameras: Path | None = None
    """Cameras: a transforms.json (NeRF, instant-ngp, nerfstudio), or the folder of a
    dataset, whose photographs need not exist. With a dataset, --path selects its views
    or a path through them."""
    path: Literal["test", "train", "orbit", "spiral", "interpolate"] | None = None
    """Held-out or training views; an orbit around what they look at; a spiral in front
    of it; or interpolation between all views. Default: orbit for a run; train, which is
    all views, for a dataset, whose test views are those it declares."""
    frames: Annotated[int | None, integer(1, 100_000)] = None
    """Number of frames of orbit, spiral and interpolate; default: 120."""
    fps: Annotated[float | None, real(0.1, 1000)] = None
    """Frames per second of a movie; default: 24."""
    time: Times = None
    """Time of a scene that moves, from 0 to 1; or of the first and last frame, such as
    0:1. Default: that of each view, and 0:1 along a path."""
    freeze_time: bool = False
    """Stop the time at the first of --time: only the camera moves."""
    freeze_camera: bool = False
    """Stop the camera at its first place: only the time runs."""
    npy: bool = False
    """Also write each image as a float32 .npy, linear and unclipped."""
    preset: Literal["compat", "accurate", "fast"] | None = None
    """Render settings, see RasterConfig; default: those of the run, or compat for a
    file."""
    order: Literal["center", "window", "pixel"] | None = None
    """Order in which a pixel blends: center pops when the camera turns; pixel sorts
    exactly by the depth along each ray, and takes 10 to 20 times as long; window sorts
    a few at a time. Default: that of the run, or center for a file."""
    budget: Budget = None
    """Maximum error of a colour, e.g. 1/255. Settings are chosen for it by measuring
    some of the cameras, and reported. Worth it for many frames; excludes --preset."""
    size: OptionalSize = None
    """Size of the images, e.g. 800x600; default: as in the camera file, or as in
    training."""
    lens: Literal["equirectangular", "fisheye"] | None = None
    """Render through another lens: equirectangular is a 360° panorama, twice as wide as
    it is high, and fisheye shows 180° across the shorter side. Default: the lens of the
    cameras."""
    what: Kinds = ("rgb",)
    """rgb, alpha or depth, or for images several with commas. The first is written as
    NAME.png, others as e.g. NAME.depth.png."""
    background: Color = None
    """Background colour, each from 0 to 1; default: that of the run, or black for a
    file."""
    overwrite: bool = False
    """Replace existing files."""

    def run(self) -> int:
        if self.budget is not None and self.preset is not None:
            raise UsageError("--budget and --preset exclude each other")
        movie = self._is_movie()
        path = self._resolve_path()
        start_jax()
        from gsjax.io.movies import played_rate
        from gsjax.runs.scene_source import RASTER_PRESETS, open_scene_source
        from gsjax.runs.trajectories import render_movie, through_lens
        from gsjax.runs.views import render_images

        entries, origin = self._entries(path)
        if self.lens is not None:
            entries = [through_lens(entry, self.lens) for entry in entries]
        raster = RASTER_PRESETS[self.preset]() if self.preset else None
        source = open_scene_source(
            self.scene, origin=origin, raster=raster, background=self.background
        )._replace(budget=self.budget)
        entries = self._timed(entries, moving=source.moving is not None)
        if self.order is not None:
            ordered = source.config.replace(order=self.order, occlusion=False)
            source = source._replace(config=ordered)
        if movie:
            rate = self.fps or 24.0
            count = render_movie(
                source, entries, self.out, kind=self.what[0], fps=rate,
                overwrite=self.overwrite,
            )  # fmt: skip
            rate = played_rate(self.out.suffix.lower(), rate)
            note(f"{count} frames, a movie of {count / rate:.1f} s")
            say(str(self.out))
        else:
            render_images(
                source, entries, self.out, kinds=self.what, npy=self.npy,
                overwrite=self.overwrite,
            )  # fmt: skip
        return 0

    def _timed(self, entries: list, *, moving: bool) -> list:
        """Return the cameras with their times; reject options for still scenes."""
        from gsjax.runs.trajectories import with_times

        asked = {
            "--time": self.time is not None,
            "--freeze-time": self.freeze_time,
            "--freeze-camera": self.freeze_camera,
        }
        option = next((name for name, given in asked.items() if given), None)
        if option is not None and not moving:
            fault = f"{option} goes with a scene that moves (gsjax train --motion)"
            raise UsageError(f"{self.scene}: {fault}")
        if not moving:
            return entries
        if self.freeze_time and self.freeze_camera:
            raise UsageError("--freeze-time and --freeze-camera exclude each other")
        return with_times(
            entries,
            self.time,
            freeze_time=self.freeze_time,
            freeze_camera=self.freeze_camera,
        )

    def _entries(self, path: str):
        """Return the cameras with their names, and the origin of their coordinates."""
        from gsjax.cameras.camera import resize_camera
        from gsjax.data.dataset import load_dataset
        from gsjax.data.transforms import load_near_transforms
        from gsjax.runs import folder as run_folder
        from gsjax.runs.folder import SplitDataset
        from gsjax.runs.trajectories import CAMERA_PATHS, path_entries, view_entries

        max_size, undistort, shutter = None, False, "global"
        if self.cameras is None:
            settings = run_folder.load_settings(self.scene)
            files = run_folder.run_files(self.scene)
            split = run_folder.with_refined_cameras(
                run_folder.load_split(settings), files
            )
            max_size, shutter = settings.config.max_size, settings.config.shutter
            # Refined cameras are those of the pictures that were trained on.
            undistort = settings.config.undistort and not files.cameras.exists()
        elif self.cameras.is_dir():
            dataset = load_dataset(self.cameras, poses_only=True)
            test = [i for i, view in enumerate(dataset.views) if view.split == "test"]
            split = SplitDataset(dataset, list(range(len(dataset.views))), test)
        else:
            return load_near_transforms(self.cameras, size=self.size)
        dataset = split.dataset
        if path in CAMERA_PATHS:
            frames, follow = self.frames or 120, CAMERA_PATHS[path]
            entries = path_entries(dataset, follow, frames=frames, max_size=max_size)
        else:
            entries = view_entries(
                split.views(path),
                max_size=max_size,
                undistort=undistort,
                shutter=shutter,
            )
        if not entries:
            raise UsageError(f"--path {path}: there are no {path} views; pass another")
        if self.size is not None:
            entries = [
                entry.replace(camera=resize_camera(entry.camera, *self.size))
                for entry in entries
            ]
        return entries, dataset.origin

    def _resolve_path(self) -> str:
        """Return --path or its default; reject options that exclude each other."""
        from gsjax.runs.scene_source import is_run

        from_file = self.cameras is not None and not self.cameras.is_dir()
        if from_file and self.path is not None:
            raise UsageError("--cameras FILE and --path exclude each other")
        if not is_run(self.scene) and self.cameras is None:
            remedy = "pass --cameras with a transforms.json or the folder of a dataset"
            raise UsageError(f"{self.scene}: a file has no cameras; {remedy}")
        path = self.path or ("orbit" if self.cameras is None else "train")
        if self.frames is not None and (from_file or path in ("test", "train")):
            raise UsageError("--frames goes with orbit, spiral and interpolate")
        return path

    def _is_movie(self) -> bool:
        """Return whether the output is a movie; reject options that do not fit it."""
        movie = (suffix := self.out.suffix.lower()) in _MOVIES
        if suffix in _REJECTED:
            fault = f"expected a folder for images, or a movie: {', '.join(_MOVIES)}"
            raise UsageError(f"-o {self.out}: {fault}")
        if movie and (len(self.what) > 1 or self.npy):
            fault = "a movie shows one kind of --what, without --npy; pass a folder"
            raise UsageError(f"-o {self.out}: {fault}")
        if self.fps is not None and not movie:
            raise UsageError("--fps goes with a movie")
        return movie
