"""`gsjax train`: from photographs with known cameras to a scene."""

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from gsjax.cli.common import (
    HeavyCommand,
    UsageError,
    command_line,
    start_jax,
    view_hint,
)
from gsjax.runtime.console import decibels, note, say

# What does not change the run itself.
_OF_A_SITTING = {
    "dataset", "out", "resume", "overwrite", "viewer", "viewer_port", "debug",
    "ignore_memory",
}  # fmt: skip
# The least that options may be.
_LEAST = {
    "steps": 1, "max_size": 8, "max_gaussians": 1, "seed": 0, "factor": 1,
    "test_every": 0, "checkpoint_every": 0, "eval_every": 0,
}  # fmt: skip


@dataclass(kw_only=True)
class TrainCommand(HeavyCommand):
    """Train a scene on a dataset: COLMAP, nerfstudio, NeRF or LLFF."""

    dataset: Positional[Path]
    """Folder of the dataset, as `gsjax sfm` makes it, or its .json or .npy file."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="RUN")]
    """Folder for the run; created if missing."""
    preset: Literal["fast", "default", "quality"] = "default"
    """fast: about two minutes on two cores; default: twenty and more; quality: 30 000
    steps as in the papers."""
    strategy: Literal["adaptive", "mcmc"] | None = None
    """How Gaussians are added and removed; default: the preset's."""
    steps: int | None = None
    """How many, default: the preset's; its schedules are stretched to them."""
    max_size: int | None = None
    """Longest side of the photographs in px, to which larger ones are scaled down;
    default: the preset's."""
    max_gaussians: int | None = None
    """Never more than that; default: the preset's."""
    sh_degree: Literal[0, 1, 2, 3, 4] | None = None
    """Degree of the spherical harmonics; 0 is one colour from all sides; default: the
    preset's."""
    background: Literal["auto", "black", "white", "random"] | None = None
    """Behind the scene; default: auto, which is random where photographs are
    transparent, else black."""
    initial: Annotated[str | None, arg(metavar="points|dense|random|SCENE")] = None
    """Start from the dataset's points; from those and many more on which the
    photographs agree (the default); from anywhere in view; or from a scene of this
    dataset, by the folder of its run or its .ply or .spz."""
    antialias: bool = False
    """Compensate thin splats for the blur of a pixel, to look right at other sizes."""
    absgrad: bool = False
    """Adaptive strategy: split by absolute gradients; sharper, with more Gaussians."""
    refine_poses: bool = False
    """Correct the cameras' poses along with the scene."""
    refine_intrinsics: bool = False
    """Correct focal length and principal point along with the scene."""
    exposure: bool = False
    """Learn an exposure for each photograph."""
    keep_unseen: bool = False
    """Keep the Gaussians that, in the end, no photograph trained on shows."""
    seed: int = 0
    """The same seed gives the same bits on a CPU, with as many cores."""
    images: str | None = None
    """Folder of the photographs, if not as usual."""
    factor: int | None = None
    """2, 4, 8: use the smaller copies in images_2, images_4, images_8."""
    skip_missing: bool = False
    """Leave out photographs that are listed but not there."""
    test_every: int | None = None
    """Hold out every so many-th view to measure with, 0 for none; default: the test
    views that the dataset names, or every 8th where it names none."""
    test_images: tuple[str, ...] | None = None
    """Hold out these views instead."""
    checkpoint_every: int | None = None
    """Steps between checkpoints, 0 only at the end; default: the preset's."""
    eval_every: int | None = None
    """Steps between measurements on the held-out views; default: 0, only at the end."""
    viewer: bool = False
    """Show the scene in the browser as it grows; needs the extra gsjax[viewer]."""
    viewer_port: int | None = None
    """Where, default: 8080; the next free port if it is taken."""
    resume: bool = False
    """Go on where the run in RUN stopped, with the settings that it has; to the same
    bits, with as many cores. Where there is none yet, start one."""
    overwrite: bool = False
    """Replace a run that exists."""

    def run(self) -> int:
        if self.resume and self.overwrite:
            raise UsageError("--resume and --overwrite exclude each other")
        if self.test_images is not None and not self.test_images:
            raise UsageError("--test-images wants the name of one view at least")
        if self.test_images and self.test_every is not None:
            raise UsageError("--test-every and --test-images exclude each other")
        if self.viewer_port is not None and not self.viewer:
            raise UsageError("--viewer-port goes with --viewer")
        if self.viewer_port is not None and not 1 <= self.viewer_port < 2**16:
            raise UsageError(f"--viewer-port {self.viewer_port}: from 1 to 65535")
        start_jax()
        try:
            return self._watched() if self.viewer else self._train(None)
        except KeyboardInterrupt:
            from gsjax.runs.folder import run_files
            from gsjax.runs.session import saved_text

            note(saved_text(run_files(self.out)))
            raise

    def _watched(self) -> int:
        from gsjax.viewer.live import LiveViewer

        viewer = LiveViewer(port=self.viewer_port or 8080)
        try:
            code = self._train(viewer.begin)
            if code == 0:
                viewer.stay()
            return code
        finally:
            viewer.close()

    def _train(self, watch) -> int:
        from gsjax.runs.folder import load_settings, run_files
        from gsjax.runs.run import resume_run, start_run

        if self.resume and run_files(self.out).config.exists():
            settings = load_settings(self.out)
            self._refuse_other(settings)
            moved = settings.dataset != self.dataset.resolve()
            if moved and settings.dataset.exists():
                raise UsageError(
                    f"{self.out} was trained on {settings.dataset}; --resume goes on "
                    "with that"
                )
            dataset = self.dataset.resolve() if moved else None
            result = resume_run(self.out, dataset=dataset, watch=watch)
        else:
            if self.resume:  # after a kill before there was anything, too
                note(f"{self.out} is no run yet; one is started there")
            result = start_run(
                self._settings(self._start()),
                self.out,
                overwrite=self.overwrite,
                watch=watch,
            )
        if not result.finished:
            note(f"stopped after step {result.step}; go on with --resume")
            return 130
        say(str(result.files.splat))
        line = f"{result.gaussians:,} Gaussians, {result.seconds:.0f} s"
        if result.summary is not None:
            line += (
                f"; {result.summary.views} held-out views: "
                f"PSNR {decibels(result.summary.psnr)}, SSIM {result.summary.ssim:.4f}"
            )
        say(line)
        say(str(result.files.preview))
        note("next: look at it, fly through it, see how it went")
        note(f"  {view_hint(self.out)}")
        flight = ("--path", "interpolate", "-o", self.out / "flight.webm")
        note(f"  {command_line('render', self.out, *flight)}")
        note(f"  {command_line('info', self.out)}")
        return 0

    def _refuse_other(self, settings) -> None:
        """Refuse options of a run that is gone on with where they differ from its."""
        given = [
            f"--{field.name.replace('_', '-')}"
            for field in fields(self)
            if field.name not in _OF_A_SITTING
            and getattr(self, field.name) != field.default
        ]
        # What is left open was decided when the run began.
        if self.initial is None or self._is_start(settings.start):
            mine = self._settings(settings.start)
            config = mine.config.replace(initial=settings.config.initial)
            mine = replace(mine, config=config)
        else:
            mine = self._settings(self._start())
        if self.test_every is None:
            mine = replace(mine, every=settings.every)
        same = {"dataset": None, "trained": (), "held_out": ()}
        if given and replace(mine, **same) != replace(settings, **same):
            raise UsageError(
                f"--resume goes on with the settings that {self.out} has, and they are "
                f"others; leave out {', '.join(given)}"
            )

    def _check_ranges(self) -> None:
        for name, least in _LEAST.items():
            value = getattr(self, name)
            if value is not None and not least <= value < 2**31 - 1:
                raise UsageError(
                    f"--{name.replace('_', '-')} {value}: {least} to {2**31 - 2:,}"
                )

    def _is_start(self, start: Path | None) -> bool:
        """Whether ``--initial`` names that file or its run, be they there or not."""
        from gsjax.runs.folder import run_files

        given = Path(self.initial or "")
        return start in (given.resolve(), run_files(given).splat.resolve())

    def _start(self) -> Path | None:
        """The file of the scene to start from, if that is what is wanted."""
        from gsjax.runs.folder import load_settings, run_files
        from gsjax.runs.scene_source import is_run, splat_file

        if self.initial in (None, "points", "dense", "random"):
            return None
        given = Path(self.initial)
        if not given.suffix and not given.exists():
            raise UsageError(
                f"--initial {given}: points, dense, random, the folder of a run, or a "
                ".ply or .spz is wanted"
            )
        splat = splat_file(given).resolve()
        if splat == run_files(self.out).splat.resolve():
            raise UsageError(
                f"--initial {given}: is what the run in {self.out} makes; give the new "
                "one another folder with -o"
            )
        if not is_run(given):
            return splat
        if load_settings(given).config.raster.antialias != self.antialias:
            told = "without" if self.antialias else "with"
            raise UsageError(
                f"{given} was trained {told} --antialias, as a run from it must be"
            )
        if run_files(given).cameras.exists():
            note(
                f"warning: {given} has refined cameras; this run starts from those of "
                "the dataset"
            )
        return splat

    def _settings(self, start: Path | None):
        from gsjax.runs.folder import RunSettings
        from gsjax.train.config import continuation_config, preset, scaled

        self._check_ranges()
        config = preset(self.preset)
        if self.steps is not None:
            config = scaled(config, self.steps)
        if start is not None:
            config = continuation_config(config)
        changes = {
            "strategy": self.strategy,
            "max_size": self.max_size,
            "sh_degree": self.sh_degree,
            "background": self.background,
            "initial": self.initial if start is None else None,
            "every_checkpoint": self.checkpoint_every,
            "every_eval": self.eval_every,
        }
        changes = {name: value for name, value in changes.items() if value is not None}
        config = config.replace(
            **changes,
            seed=self.seed,
            refine_poses=self.refine_poses,
            refine_intrinsics=self.refine_intrinsics,
            exposure=self.exposure,
            prune_invisible=not self.keep_unseen,
            raster=config.raster.replace(antialias=self.antialias),
        )
        if self.max_gaussians is not None:
            config = config.replace(
                adaptive=replace(config.adaptive, max_gaussians=self.max_gaussians),
                mcmc=replace(config.mcmc, max_gaussians=self.max_gaussians),
            )
        if self.absgrad:
            if config.strategy != "adaptive":
                raise UsageError("--absgrad goes with --strategy adaptive")
            adaptive = replace(config.adaptive, absgrad=True)
            if config.adaptive.threshold == 2e-4:
                adaptive = replace(adaptive, threshold=8e-4)
            config = config.replace(adaptive=adaptive)
        return RunSettings(
            dataset=self.dataset,
            config=config,
            images=self.images,
            factor=self.factor,
            skip_missing=self.skip_missing,
            every=self.test_every,
            test_images=self.test_images or (),
            start=start,
        )
