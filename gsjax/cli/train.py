"""`gsjax train`: a scene from photographs with known cameras."""

from contextlib import closing
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from gsjax.cli.common import (
    HeavyCommand,
    UsageError,
    command_line,
    say_result,
    start_jax,
    view_hint,
)
from gsjax.cli.options import integer
from gsjax.runtime.console import note, say

# Options that do not change the settings of a run.
_NOT_SETTINGS = {
    "dataset", "out", "resume", "overwrite", "viewer", "viewer_port", "debug",
    "ignore_memory",
}  # fmt: skip
_POINTS = ("points", "dense", "random")


@dataclass(kw_only=True)
class TrainCommand(HeavyCommand):
    """Train a scene on a COLMAP, nerfstudio, NeRF or LLFF dataset."""

    dataset: Positional[Path]
    """Folder of the dataset, e.g. from `gsjax sfm`, or its .json or .npy file."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="RUN")]
    """Folder for the run; created if missing."""
    preset: Literal["fast", "default", "quality"] = "default"
    """fast: about two minutes on two cores; default: twenty and more; quality: 30,000
    steps as in the papers."""
    strategy: Literal["adaptive", "mcmc"] | None = None
    """Strategy that adds and removes Gaussians; default: that of the preset."""
    steps: Annotated[int | None, integer(1)] = None
    """Number of steps, to which all schedules are scaled; default: that of the
    preset."""
    max_size: Annotated[int | None, integer(8)] = None
    """Longest side in px, to which larger photographs are scaled down; default: that of
    the preset."""
    max_gaussians: Annotated[int | None, integer(1)] = None
    """Maximum number of Gaussians; default: that of the preset."""
    sh_degree: Literal[0, 1, 2, 3, 4] | None = None
    """Degree of the spherical harmonics; 0 for view-independent colours; default: that
    of the preset."""
    background: Literal["auto", "black", "white", "random"] | None = None
    """Background colour. Default: auto, which is random if photographs are transparent,
    else black."""
    initial: Annotated[str | None, arg(metavar="points|dense|random|SCENE")] = None
    """Initialise from the points of the dataset (points), from those and points matched
    between photographs (dense, the default), from random points in view (random), or
    from a scene of this dataset: the folder of a run, or a file of Gaussians."""
    antialias: bool = False
    """Compensate the opacity of splats smaller than a pixel, for renders at other
    sizes."""
    order: Literal["center", "window"] = "center"
    """Order in which a pixel blends, see `gsjax render`: a window costs about twice the
    time."""
    mip: bool = False
    """Train with the filters of Mip-Splatting, for renders at other sizes and
    distances: a 3D filter by the resolution of the photographs, and a smaller filter of
    the image that keeps the brightness."""
    motion: Literal["none", "field", "trajectories"] = "none"
    """Train a scene that moves, from views with times: a field in space and time that
    moves all Gaussians, for motions that resemble those nearby; or a trajectory and a
    lifetime for each Gaussian, which is faster and suits several cameras."""
    absgrad: bool = False
    """Split by absolute gradients in the adaptive strategy: sharper, with more
    Gaussians."""
    primitive: Literal["ellipsoid", "surfel", "surfel_area"] = "ellipsoid"
    """Kind of Gaussian: ellipsoids, or surfels (2D Gaussian splatting) with the filter
    of the paper (surfel) or one that keeps the area (surfel_area)."""
    normal_weight: float | None = None
    """Weight of the loss of normals that disagree with those of the depth. Default:
    0.05 for surfels, else 0."""
    distortion_weight: float = 0.0
    """Weight of the loss of depth distortion, which draws the surfels of a pixel
    together. Default: 0."""
    refine_poses: bool = False
    """Optimise the camera poses together with the scene, with accurate render
    thresholds."""
    refine_intrinsics: bool = False
    """Optimise focal length, principal point and lens distortion together with the
    scene."""
    shutter: Literal[
        "global", "top_to_bottom", "bottom_to_top", "left_to_right", "right_to_left"
    ] = "global"
    """Direction in which the rolling shutter of all cameras exposes the image."""
    refine_shutter: bool = False
    """Optimise the motion of each camera during the exposure of its rolling
    --shutter."""
    undistort: bool = False
    """Resample the photographs to ideal pinholes, in place of rendering through their
    lenses."""
    exposure: bool = False
    """Optimise an exposure for each photograph."""
    keep_unseen: bool = False
    """Keep Gaussians that no training photograph shows at the end."""
    seed: Annotated[int, integer(0)] = 0
    """Seed of the random numbers. On CPUs, a seed reproduces the result bit by bit with
    the same number of cores."""
    images: str | None = None
    """Folder of the photographs; default: that of the dataset's format."""
    factor: Annotated[int | None, integer(1)] = None
    """Use photographs scaled down by 2, 4 or 8, in images_2, images_4 or images_8."""
    skip_missing: bool = False
    """Skip photographs that the dataset lists but that do not exist."""
    test_every: Annotated[int | None, integer(0)] = None
    """Hold out every Nth view for evaluation, 0 for none; default: the test views that
    the dataset declares, or else an eighth, spread over the capture and away from its
    ends."""
    test_images: tuple[str, ...] | None = None
    """Hold out these views instead."""
    checkpoint_every: Annotated[int | None, integer(0)] = None
    """Steps between checkpoints, 0 for one at the end; default: that of the preset."""
    eval_every: Annotated[int | None, integer(0)] = None
    """Steps between evaluations of the held-out views; default: 0, only at the end."""
    viewer: bool = False
    """Show the scene in the browser while it trains. Requires gsjax[viewer]."""
    viewer_port: Annotated[int | None, integer(1, 65535)] = None
    """Port of the viewer, or the next free one; default: 8080."""
    resume: bool = False
    """Resume the run in RUN with its settings, or start it if there is none. The result
    is bit-equal to an uninterrupted run with the same number of cores."""
    overwrite: bool = False
    """Replace an existing run."""

    def run(self) -> int:
        if self.resume and self.overwrite:
            raise UsageError("--resume and --overwrite exclude each other")
        if self.test_images is not None and not self.test_images:
            raise UsageError("--test-images: expected the name of at least one view")
        if self.test_images and self.test_every is not None:
            raise UsageError("--test-every and --test-images exclude each other")
        if self.mip and (self.antialias or self.primitive != "ellipsoid"):
            other = "--antialias" if self.antialias else "--primitive"
            raise UsageError(f"--mip and {other} exclude each other")
        if self.mip and self.motion != "none":
            raise UsageError("--mip and --motion exclude each other")
        if self.viewer_port is not None and not self.viewer:
            raise UsageError("--viewer-port goes with --viewer")
        start_jax()
        try:
            return self._train_with_viewer() if self.viewer else self._train(None)
        except KeyboardInterrupt:
            from gsjax.runs.folder import run_files
            from gsjax.runs.session import resume_hint

            note(resume_hint(run_files(self.out)))
            raise

    def _train_with_viewer(self) -> int:
        from gsjax.viewer.server import LiveViewer

        with closing(LiveViewer(port=self.viewer_port or 8080)) as viewer:
            code = self._train(viewer.begin)
            if code == 0:
                viewer.wait_for_browsers()
            return code

    def _train(self, watch) -> int:
        result = self._start_or_resume(watch)
        if not result.finished:
            note(f"stopped after step {result.step}; resume with --resume")
            return 130
        say(str(result.files.splat))
        say_result(result)
        say(str(result.files.preview))
        movie = ("--path", "interpolate", "-o", self.out / "flight.webm")
        note("next: view it, render a movie, see its statistics")
        note(f"  {view_hint(self.out)}")
        note(f"  {command_line('render', self.out, *movie)}")
        note(f"  {command_line('info', self.out)}")
        return 0

    def _start_or_resume(self, watch):
        from gsjax.runs.folder import load_settings, run_files
        from gsjax.runs.run import resume_run, start_run

        if self.resume and run_files(self.out).config.exists():
            settings = load_settings(self.out)
            self._check_same_settings(settings)
            moved = settings.dataset != self.dataset.resolve()
            if moved and settings.dataset.exists():
                fault = f"was trained on {settings.dataset}; pass that to --resume it"
                raise UsageError(f"{self.out} {fault}")
            dataset = self.dataset.resolve() if moved else None
            return resume_run(self.out, dataset=dataset, watch=watch)
        if self.resume:
            note(f"{self.out} is not a run yet; starting one")
        mine = self._settings(self._initial_scene())
        return start_run(mine, self.out, overwrite=self.overwrite, watch=watch)

    def _check_same_settings(self, settings) -> None:
        """Raise if options contradict the settings of the run to resume."""
        from gsjax.runs.folder import run_files

        given = [
            f"--{field.name.replace('_', '-')}"
            for field in fields(self)
            if field.name not in _NOT_SETTINGS
            and getattr(self, field.name) != field.default
        ]
        # --initial may name the file or its run, existing or not.
        initial = Path(self.initial or "")
        named = (initial.resolve(), run_files(initial).splat.resolve())
        # Defaults were resolved when the run started.
        if self.initial is None or settings.start in named:
            mine = self._settings(settings.start)
            initial = settings.config.initial
            mine = replace(mine, config=mine.config.replace(initial=initial))
        else:
            mine = self._settings(self._initial_scene())
        if self.test_every is None:
            mine = replace(mine, every=settings.every)
        same = {"dataset": None, "trained": (), "held_out": ()}
        if given and replace(mine, **same) != replace(settings, **same):
            raise UsageError(
                f"--resume uses the settings of {self.out}, which differ; leave out "
                f"{', '.join(given)}"
            )

    def _initial_scene(self) -> Path | None:
        """Return the file of the scene that --initial names, if any and suitable."""
        from gsjax.runs.folder import load_settings, run_files
        from gsjax.runs.scene_source import is_run, splat_file

        if self.initial is None or self.initial in _POINTS:
            return None
        given = Path(self.initial)
        if not given.suffix and not given.exists():
            raise UsageError(
                f"--initial: expected {', '.join(_POINTS)}, the folder of a run, or a "
                f"file of Gaussians, got {self.initial!r}"
            )
        splat = splat_file(given).resolve()
        if splat == run_files(self.out).splat.resolve():
            fault = (
                f"is the scene of the run in {self.out}; pass another folder with -o"
            )
            raise UsageError(f"--initial {given}: {fault}")
        if not is_run(given):
            return splat
        self._check_same_filter(given, load_settings(given).config)
        if run_files(given).cameras.exists():
            text = "has refined cameras; this run starts from those of the dataset"
            note(f"warning: {given} {text}")
        return splat

    def _check_same_filter(self, given: Path, config) -> None:
        """Raise if the scene that --initial names was trained for other filters."""
        for name, trained in (
            ("mip", config.mip),
            ("antialias", config.raster.antialias and not config.mip),
        ):
            if trained != getattr(self, name):
                change = f"{'pass' if trained else 'leave out'} --{name}"
                fault = f"--{name} differs from that run; {change}"
                raise UsageError(f"--initial {given}: {fault}")

    def _settings(self, start: Path | None):
        from gsjax.runs.folder import RunSettings

        return RunSettings(
            dataset=self.dataset,
            config=self._config(continued=start is not None),
            images=self.images,
            factor=self.factor,
            skip_missing=self.skip_missing,
            every=self.test_every,
            test_images=self.test_images or (),
            start=start,
        )

    def _geometry(self) -> dict:
        """Return the settings of the primitive and of the losses of geometry."""
        flat, normals = self.primitive != "ellipsoid", self.normal_weight
        if normals is None:
            normals = 0.05 if flat else 0.0
        return {
            "primitive": self.primitive if flat else None,
            "normal_weight": normals,
            "distortion_weight": self.distortion_weight,
        }

    def _config(self, *, continued: bool):
        """Return the preset changed by the options."""
        from gsjax.train.config import continuation_config, preset, scaled

        config = preset(self.preset)
        if self.steps is not None:
            config = scaled(config, self.steps)
        if continued:
            config = continuation_config(config)
        changes = {
            "strategy": self.strategy,
            "max_size": self.max_size,
            "sh_degree": self.sh_degree,
            "background": self.background,
            "initial": None if continued else self.initial,
            "every_checkpoint": self.checkpoint_every,
            "every_eval": self.eval_every,
        }
        changes = {name: value for name, value in changes.items() if value is not None}
        config = config.replace(
            **changes,
            seed=self.seed,
            refine_poses=self.refine_poses,
            refine_intrinsics=self.refine_intrinsics,
            shutter=self.shutter,
            refine_shutter=self.refine_shutter,
            undistort=self.undistort,
            exposure=self.exposure,
            mip=self.mip,
            motion=self.motion,
            **self._geometry(),
            prune_invisible=not self.keep_unseen,
        )
        if self.antialias:  # after refine_poses, which chooses the default
            config = config.replace(raster=config.raster.replace(antialias=True))
        if self.order != "center":
            config = config.replace(raster=config.raster.replace(order=self.order))
        if self.max_gaussians is not None:
            config = config.replace(max_gaussians=self.max_gaussians)
        if self.absgrad:
            if config.strategy != "adaptive":
                raise UsageError("--absgrad goes with --strategy adaptive")
            adaptive = replace(config.adaptive, absgrad=True)
            if config.adaptive.threshold == 2e-4:
                adaptive = replace(adaptive, threshold=8e-4)
            config = config.replace(adaptive=adaptive)
        return config
