"""`gsjax render`: pictures and movies of a scene."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from gsjax.cli.common import (
    HeavyCommand,
    UsageError,
    parse_background,
    parse_budget,
    parse_kinds,
    parse_size,
    start_jax,
)
from gsjax.runtime.console import note, say

_OTHER_MOVIES = (".mp4", ".mov", ".m4v", ".avi", ".mkv")
_PICTURES = (".png", ".jpg", ".jpeg")


@dataclass(kw_only=True)
class RenderCommand(HeavyCommand):
    """Render a scene from a list of cameras or along a path: images or a movie."""

    scene: Annotated[Positional[Path], arg(metavar="RUN|PLY")]
    """The Gaussians: a .ply or .spz file, or the folder of a run."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="DIR|MOVIE")]
    """Folder for the images, created if missing; or a movie: .gif, .webp or .webm."""
    cameras: Path | None = None
    """The cameras: a transforms.json (NeRF, instant-ngp, nerfstudio), or the folder of
    a dataset, whose views they are, or what --path makes of them; its photographs
    need not be there."""
    path: Literal["test", "train", "orbit", "spiral", "interpolate"] | None = None
    """Of a run: its held-out or its training views; once around what they look at; a
    spiral before it; or a flight through all of them. Default of a run: orbit, of a
    dataset: train, which is all its views; test are those that it names so."""
    frames: int | None = None
    """Of orbit, spiral and interpolate; default 120."""
    fps: float | None = None
    """Of a movie; default 24."""
    npy: bool = False
    """Also write each image as .npy of linear float32."""
    preset: Literal["compat", "accurate", "fast"] | None = None
    """Which constants to render with, see RasterConfig; default: those of the run, of
    a .ply compat."""
    budget: Annotated[str | None, arg(metavar="ERROR")] = None
    """Largest error of a colour, e.g. 1/255: the settings are chosen for it, measured
    on some of the cameras, and said why. Pays for many frames; not with --preset."""
    size: Annotated[str | None, arg(metavar="WxH")] = None
    """Size of the images, e.g. 800x600; default: as in the file, or as in training."""
    what: Annotated[str, arg(metavar="KINDS")] = "rgb"
    """rgb, alpha or depth, or for images several with commas; the first is NAME.png, a
    further one e.g. NAME.depth.png."""
    background: Annotated[str | None, arg(metavar="R,G,B")] = None
    """Colour behind the scene, each from 0 to 1; default: that of the run, of a .ply
    black."""
    overwrite: bool = False
    """Replace what exists."""

    def run(self) -> int:
        size = None if self.size is None else parse_size(self.size)
        kinds = parse_kinds(self.what)
        background = None
        if self.background is not None:
            background = parse_background(self.background)
            if not all(0 <= value <= 1 for value in background):
                raise UsageError(f"--background {self.background}: each from 0 to 1")
        budget = self._budget()
        movie = self._is_movie(kinds)
        path = self._path()
        start_jax()
        from gsjax.data.dataset import load_dataset
        from gsjax.data.transforms import load_near_transforms
        from gsjax.io.movies import played_rate
        from gsjax.runs.folder import (
            Data,
            load_data,
            load_settings,
            refined_data,
            run_files,
        )
        from gsjax.runs.scene_source import open_scene_source
        from gsjax.runs.trajectories import path_entries, write_flight
        from gsjax.runs.views import write_views

        data = largest = None
        if self.cameras is None:
            settings = load_settings(self.scene)
            data = refined_data(load_data(settings), run_files(self.scene))
            largest = settings.config.max_size
        elif self.cameras.is_dir():
            scene = load_dataset(self.cameras, poses_only=True)
            named = [i for i, view in enumerate(scene.views) if view.split == "test"]
            data = Data(scene, train=list(range(len(scene.views))), test=named)
        if data is None:
            assert self.cameras is not None, "else it is a run's"
            entries, origin = load_near_transforms(self.cameras, size=size)
        else:
            frames = self.frames or 120
            entries = path_entries(
                data, path, frames=frames, max_size=largest, size=size
            )
            origin = data.scene.origin
        if not entries:
            none = f"{self.cameras} names none; train has all of its views"
            if self.cameras is None:
                none = "this run holds none out"
            raise UsageError(f"--path {path}: there are no such views: {none}")
        subject = open_scene_source(
            self.scene, origin=origin, preset=self.preset, background=background
        )
        subject = subject._replace(budget=budget)
        if movie:
            rate = 24.0 if self.fps is None else self.fps
            count = write_flight(
                subject, entries, self.out, kind=kinds[0], fps=rate,
                overwrite=self.overwrite,
            )  # fmt: skip
            rate = played_rate(self.out.suffix.lower(), rate)
            note(f"{count} frames, a movie of {count / rate:.1f} s")
            say(str(self.out))
        else:
            write_views(
                subject, entries, self.out, kinds=kinds, npy=self.npy,
                overwrite=self.overwrite,
            )  # fmt: skip
        return 0

    def _budget(self) -> float | None:
        if self.budget is None:
            return None
        if self.preset is not None:
            raise UsageError("--budget and --preset exclude each other")
        return parse_budget(self.budget)

    def _path(self) -> str:
        """The path to fly, if it is one.

        Raises:
          UsageError: if what is asked for does not go together.
        """
        from gsjax.runs.scene_source import is_run

        listed = self.cameras is not None and not self.cameras.is_dir()
        if listed and self.path is not None:
            raise UsageError("--cameras FILE and --path exclude each other")
        if not is_run(self.scene) and self.cameras is None:
            raise UsageError(
                f"{self.scene}: --cameras is wanted for a file, a transforms.json or "
                "the folder of a dataset; only a run has views of its own"
            )
        path = self.path or ("orbit" if self.cameras is None else "train")
        if self.frames is not None:
            if listed or path in ("test", "train"):
                raise UsageError("--frames goes with orbit, spiral and interpolate")
            if not 1 <= self.frames <= 100_000:
                raise UsageError(f"--frames {self.frames}: from 1 to 100000 is wanted")
        return path

    def _is_movie(self, kinds: tuple[str, ...]) -> bool:
        from gsjax.runs.trajectories import MOVIE_SUFFIXES

        suffix = self.out.suffix.lower()
        movie = suffix in MOVIE_SUFFIXES
        if suffix in _OTHER_MOVIES:
            raise UsageError(f"-o {self.out}: {', '.join(MOVIE_SUFFIXES)} are written")
        if suffix in _PICTURES:
            raise UsageError(
                f"-o {self.out}: a folder is wanted, for a PNG of each view, or a "
                f"movie ({', '.join(MOVIE_SUFFIXES)})"
            )
        if movie and (len(kinds) > 1 or self.npy):
            raise UsageError(
                f"-o {self.out}: a movie shows one of --what, and has no --npy; a "
                "folder takes more"
            )
        if self.fps is not None and not (movie and 0.1 <= self.fps <= 1000):
            raise UsageError(f"--fps {self.fps:g}: of a movie, from 0.1 to 1000")
        return movie
