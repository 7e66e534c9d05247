"""Settings of a training run, and its presets."""

import math
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from itertools import pairwise

from gsjax.cameras.shutter import SHUTTERS
from gsjax.densify.adaptive import AdaptiveSettings, adaptive
from gsjax.densify.mcmc import McmcSettings, mcmc
from gsjax.densify.schedule import EditSchedule
from gsjax.densify.types import Strategy
from gsjax.errors import InputError
from gsjax.raster.types import PRIMITIVES, RasterConfig
from gsjax.runtime.settings import as_float, convert_fields, require_ranges
from gsjax.train.motion.settings import MOTIONS, FieldSettings, TrajectorySettings
from gsjax.train.optimiser import Rates

STRATEGIES = ("adaptive", "mcmc")
_CHOICES = {
    "shutter": tuple(SHUTTERS),
    "strategy": STRATEGIES,
    "background": ("auto", "black", "white", "random"),
    "initial": ("auto", "points", "dense", "random"),
    "primitive": (None, *PRIMITIVES),
    "motion": MOTIONS,
}


@dataclass(frozen=True)
class Level:
    """Resolution of the photographs from a point of the run on.

    Attributes:
      start: fraction of all steps, 0 to 1.
      divisor: divisor of width and height.

    Raises:
      InputError: if a value is not a number.
    """

    start: float
    divisor: int

    def __post_init__(self):
        convert_fields(self)


# Compile faster: a run grows its capacities itself, so one size suffices; and few
# Gaussians are hidden in views of photographs, so occlusion culling does not pay. A
# config holds these very objects unless the user passes one.
_RASTER = RasterConfig(num_size_buckets=1, occlusion=False)
_ACCURATE = RasterConfig.accurate(num_size_buckets=1, occlusion=False)
_DEFAULTS = {
    (primitive, precise): raster.replace(primitive=primitive) if primitive else raster
    for primitive in (None, *PRIMITIVES)
    for precise, raster in ((False, _RASTER), (True, _ACCURATE))
}
# The 2D filter of Mip-Splatting: σ² of a box of one pixel is 1/12; the paper takes 0.1.
_MIP = {"dilation": 0.1, "antialias": True}
_MIP_DEFAULTS = {key: raster.replace(**_MIP) for key, raster in _DEFAULTS.items()}


def mip_raster(raster: RasterConfig) -> RasterConfig:
    """Return render settings with the 2D filter of Mip-Splatting.

    It replaces the dilation: 0.1 px² with compensated opacities (Yu et al. 2024).
    """
    return raster.replace(**_MIP)


def is_mip_raster(raster: RasterConfig) -> bool:
    """Return whether render settings have the 2D filter of Mip-Splatting."""
    return not raster.draws_surfels and mip_raster(raster) == raster


def render_mode_of(raster: RasterConfig) -> str | None:
    """Return the render mode that files of a scene record.

    See `gsjax.io.formats.render_mode`.
    """
    if raster.draws_surfels:
        return "2dgs"
    return "mip" if is_mip_raster(raster) else None


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a training run; the defaults are those of Kerbl et al. 2023.

    Attributes:
      steps: number of steps, of ``batch`` views each.
      seed: seed of all random numbers.
      strategy: density control, "adaptive" or "mcmc", with the settings of that name.
        There is no edit after the last step.
      max_size: longest side, px, that photographs are downscaled to; None keeps them.
      levels: resolutions, coarse to fine.
      sh_degree: degree of the spherical harmonics. Each degree is enabled ``sh_every``
        steps after the one below.
      ssim_weight: weight of 1 − SSIM in the loss; that of L1 is the rest.
      background: colour behind the scene in training: "black", "white", "random" (a new
        colour in each step, which prevents holes), or "auto": random if photographs are
        transparent, else black. Evaluation and files use black unless it is "white".
      initial: initial Gaussians: "points" of the dataset; "dense", those and points
        matched between photographs (`gsjax.train.initialisation.add_dense_points`), or
        random points if hardly any are found; "random" points in view; or "auto": the
        points if there are any, else random ones.
      initial_count: number of random points.
      dense_count: maximum number of matched points.
      max_initial: maximum number of initial points; a random subset is kept.
      rates: learning rates of the Gaussians.
      undistort: resample the photographs to ideal pinholes when they are loaded, in
        place of rendering through their lenses.
      shutter: name of the shutter of all cameras, see `gsjax.cameras.shutter`.
      refine_poses: optimise small corrections of the poses.
      refine_intrinsics: optimise focal length, principal point and distortion, which
        all views share. Pinholes get OpenCV's k1 k2 p1 p2.
      refine_shutter: optimise the motion of each camera during the exposure of a
        rolling ``shutter``.
      primitive: kind of Gaussian, see `RasterConfig.primitive`; None for that of
        ``raster``. Surfels start in the planes of neighbouring points.
      mip: train with the filters of Mip-Splatting against aliasing: the 3D filter of
        `gsjax.train.mip`, and `mip_raster` in place of the dilation. For ellipsoids.
      motion: "none" for a scene that stands still; "field" or "trajectories" for one
        that moves, see `gsjax.train.motion`, with the settings of that name. The views
        need times.
      normal_weight, distortion_weight, entropy_weight: weights of
        `gsjax.train.geometry_loss`: of `normal_consistency`, of `distortion_term`, and
        of `opacity_entropy`; 0 leaves a term out.
      normal_from, distortion_from, entropy_from: share of the steps from which each
        counts.
      exposure: optimise an affine correction of the colours of each photograph.
      pose_rate, intrinsics_rate, shutter_rate, exposure_rate: learning rates of these
        corrections; that of distortion is 10 × ``intrinsics_rate``. Those of intrinsics
        and shutter fall to a hundredth, log-linearly in the second half of the run.
      skip_masked: skip tiles in which all pixels are masked; equal up to rounding.
      prune_invisible: after the last step, remove the Gaussians that no training view
        shows; the views stay bit-equal. (Metrics of the last step count them.)
      every_eval: interval in steps at which held-out views are evaluated; 0 only at the
        end.
      every_checkpoint: interval in steps between checkpoints; 0 only at the end.
      raster: render settings; the run chooses the capacities. With ``refine_poses`` the
        default has the thresholds of `RasterConfig.accurate`, because those of the
        default change pose gradients by up to a half; a value of your own is kept.

    Raises:
      InputError: if a setting is out of range.
    """

    steps: int = 30_000
    batch: int = 1
    seed: int = 0
    strategy: str = "adaptive"
    adaptive: AdaptiveSettings = dataclass_field(default_factory=AdaptiveSettings)
    mcmc: McmcSettings = dataclass_field(default_factory=McmcSettings)
    max_size: int | None = 1600
    levels: tuple[Level, ...] = (Level(0.0, 1),)
    sh_degree: int = 3
    sh_every: int = 1000
    ssim_weight: float = 0.2
    background: str = "auto"
    initial: str = "auto"
    initial_count: int = 100_000
    dense_count: int = 100_000
    max_initial: int = 1_000_000
    rates: Rates = dataclass_field(default_factory=Rates)
    undistort: bool = False
    shutter: str = "global"
    refine_poses: bool = False
    refine_intrinsics: bool = False
    refine_shutter: bool = False
    exposure: bool = False
    primitive: str | None = None
    mip: bool = False
    motion: str = "none"
    field: FieldSettings = dataclass_field(default_factory=FieldSettings)
    trajectories: TrajectorySettings = dataclass_field(
        default_factory=TrajectorySettings
    )
    normal_weight: float = 0.0
    normal_from: float = 0.25
    distortion_weight: float = 0.0
    distortion_from: float = 0.1
    entropy_weight: float = 0.0
    entropy_from: float = 0.5
    pose_rate: float = 1e-5
    intrinsics_rate: float = 1e-3
    shutter_rate: float = 1e-3
    exposure_rate: float = 1e-3
    skip_masked: bool = True
    prune_invisible: bool = True
    every_eval: int = 0
    every_checkpoint: int = 1000
    raster: RasterConfig = _RASTER

    def __post_init__(self):
        convert_fields(self)
        require_ranges(self, _CHOICES)
        object.__setattr__(self, "raster", self._own_raster())
        rates = _as_floats(self.rates)
        object.__setattr__(self, "rates", rates)
        first, last = rates.means
        settings = self.strategy_settings
        levels = bool(self.levels) and self.levels[0].start == 0
        levels &= all(a.start < b.start for a, b in pairwise(self.levels))
        levels &= all(level.divisor >= 1 for level in self.levels)
        means = first == last >= 0 or min(first, last) > 0
        positive = all(0 <= rate < math.inf for rate in (first, last, *rates[1:]))
        cooling_from = 0 <= rates.cooling_from < 1
        positive_fields = "batch", "sh_every", "initial_count", "max_initial"
        non_negative_fields = (
            "pose_rate", "intrinsics_rate", "shutter_rate", "exposure_rate",
            "dense_count", "every_eval", "every_checkpoint",
            "normal_weight", "distortion_weight", "entropy_weight",
        )  # fmt: skip
        rolling = not self.refine_shutter or SHUTTERS[self.shutter].rolling
        surfels = self.mip and self.raster.draws_surfels
        opacity, scale = 0 < settings.initial_opacity < 1, settings.initial_scale > 0
        checks = {
            "steps": f"[1, {2**31 - 1})",
            "seed": f"[0, {2**31})",
            "max_size": "[8, inf)",
            "levels": (levels, "increasing starts from 0 and divisors ≥ 1"),
            "sh_degree": "[0, 4]",
            "refine_shutter": (rolling, "False for a global shutter"),
            "mip": (not surfels, "False for surfels"),
            "motion": (self.motion == "none" or not self.mip, "none with mip"),
            "ssim_weight": "[0, 1]",
            "rates' means": (means, "two positive numbers, or equal ones"),
            "rates' cooling": (0 < rates.cooling <= 1, "cooling in (0, 1]"),
            "rates' cooling_from": (cooling_from, "cooling_from in [0, 1)"),
            "rates": (positive, "numbers ≥ 0"),
            f"{self.strategy}'s initial_opacity": (opacity, "a number in (0, 1)"),
            f"{self.strategy}'s initial_scale": (scale, "a number in (0, inf)"),
            **dict.fromkeys(("normal_from", "distortion_from"), "[0, 1]"),
            "entropy_from": "[0, 1]",
            **dict.fromkeys(positive_fields, "[1, inf)"),
            **dict.fromkeys(non_negative_fields, "[0, inf)"),
        }
        require_ranges(self, checks)

    def _own_raster(self) -> RasterConfig:
        """Return the render settings: the default, or those of the user."""
        raster = self.raster
        defaults = (*_DEFAULTS.values(), *_MIP_DEFAULTS.values())
        if any(raster is some for some in defaults):
            precise = self.refine_poses or self.refine_shutter
            return (_MIP_DEFAULTS if self.mip else _DEFAULTS)[self.primitive, precise]
        if self.primitive is not None:
            raster = raster.replace(primitive=self.primitive)
        return mip_raster(raster) if self.mip else raster

    def replace(self, **changes) -> "TrainConfig":
        """Return a copy with some settings changed.

        Args:
          **changes: settings by name; also ``max_gaussians``, which sets the maximum
            number of Gaussians of both strategies.
        """
        most = changes.pop("max_gaussians", None)
        if most is not None:
            for name in STRATEGIES:
                settings = changes.get(name, getattr(self, name))
                changes[name] = replace(settings, max_gaussians=most)
        return replace(self, **changes)

    def make_strategy(self, extent: float) -> Strategy:
        """Return the density control for a scene of this extent, in world units."""
        settings = self.strategy_settings
        if isinstance(settings, McmcSettings):
            return mcmc(settings, extent)
        return adaptive(settings, extent)

    @property
    def strategy_settings(self) -> AdaptiveSettings | McmcSettings:
        """Settings of the strategy, without an edit after the last step."""
        settings = self.mcmc if self.strategy == "mcmc" else self.adaptive
        return replace(settings, stop=min(settings.stop, self.steps - 1))

    @property
    def max_gaussians(self) -> int:
        """Maximum number of Gaussians."""
        return self.strategy_settings.max_gaussians

    @property
    def schedule(self) -> EditSchedule:
        """Steps at which the strategy edits, and the growth to expect."""
        return self.strategy_settings.schedule

    def divisor(self, step: int) -> int:
        """Return the divisor of the image size at ``step``, counted from 0."""
        done = step / self.steps
        return next(lv.divisor for lv in reversed(self.levels) if done >= lv.start)


def _as_floats(rates: Rates) -> Rates:
    """Return the rates as Python floats."""
    first, last = rates.means
    means = as_float("Rates.means", first), as_float("Rates.means", last)
    rest = rates._asdict()
    del rest["means"]
    return Rates(means, **{k: as_float(f"Rates.{k}", v) for k, v in rest.items()})


def scaled(config: TrainConfig, steps: int) -> TrainConfig:
    """Return the settings with another number of steps and schedules in proportion."""
    ratio = steps / config.steps

    def some(count: int, least: int = 1) -> int:
        return max(least, round(count * ratio)) if count else count

    def edits(settings) -> dict[str, int]:
        every = some(settings.every, 20)
        return {
            "start": some(settings.start), "stop": some(settings.stop), "every": every
        }  # fmt: skip

    reset_every = some(config.adaptive.reset_every, 20)
    return config.replace(
        steps=steps,
        sh_every=some(config.sh_every),
        adaptive=replace(
            config.adaptive, **edits(config.adaptive), reset_every=reset_every
        ),
        mcmc=replace(config.mcmc, **edits(config.mcmc)),
    )


def continuation_config(config: TrainConfig) -> TrainConfig:
    """Return the settings for training that starts from a trained scene.

    All harmonics and the finest resolution are used from the first step.
    """
    finest = Level(0.0, config.levels[-1].divisor)
    return config.replace(sh_every=1, levels=(finest,))


def preset(name: str, **changes) -> TrainConfig:
    """Return the settings of a preset.

    Args:
      name: "fast" (1200 steps, photographs of up to 400 px), "default" (4000 steps, up
        to 800 px) or "quality" (the 30 000 steps of Kerbl et al., up to 1600 px).
      **changes: settings to change, as `TrainConfig.replace` takes them, such as
        ``max_gaussians=50_000``.

    Raises:
      InputError: if the preset is unknown or a setting is out of range.
    """
    if name not in _PRESETS:
        known = ", ".join(_PRESETS)
        raise InputError(f"preset: expected one of {known}, got {name!r}")
    return _PRESETS[name]().replace(**changes)


_HALF = (Rates().means[0] / 2, Rates().means[1] / 2)


def _fast() -> TrainConfig:
    return TrainConfig(
        steps=1200,
        strategy="mcmc",
        max_size=400,
        # One resolution: a second program does not pay off in so few steps.
        initial="dense",
        dense_count=20_000,
        sh_degree=1,
        sh_every=375,
        # The rates of the papers are for 30 000 steps. In a random walk, 25 times fewer
        # steps need √25 times the rates. Such rates make the result fluctuate, so they
        # fall early. Dense points are well placed (half the rate for the means) but
        # leave gaps (twice the rate for the scales).
        rates=Rates(_HALF, log_scales=0.01, cooling=0.1, cooling_from=0.35).times(4.0),
        # Each edit raises the loss for a while: few edits, none towards the end.
        # Without opacity resets, only the scale penalty removes fog before few views.
        adaptive=AdaptiveSettings(
            start=75, stop=600, every=75, reset_every=0, scale_penalty=0.01,
            max_gaussians=30_000, initial_opacity=0.5, initial_scale=0.5,
        ),
        mcmc=McmcSettings(
            start=75, stop=975, every=50, growth=1.2, max_gaussians=30_000,
            initial_scale=0.5,
        ),
    )  # fmt: skip


def _default() -> TrainConfig:
    return TrainConfig(
        steps=4000,
        strategy="mcmc",
        max_size=800,
        # At coarse levels the cost grows with the Gaussians, not with the pixels.
        initial="dense",
        dense_count=20_000,
        levels=(Level(0.0, 2), Level(0.3, 1)),
        sh_degree=2,
        sh_every=600,
        # Higher rates for fewer steps, as in `_fast`.
        rates=Rates(means=_HALF, cooling=0.1).times(2.0),
        adaptive=AdaptiveSettings(
            start=200, stop=2600, every=100, reset_every=0, max_gaussians=300_000
        ),
        mcmc=McmcSettings(
            start=200, stop=3100, every=100, growth=1.05, max_gaussians=150_000,
            initial_scale=0.5,
        ),
    )  # fmt: skip


def _quality() -> TrainConfig:
    return TrainConfig(
        initial="dense", levels=(Level(0.0, 4), Level(0.03, 2), Level(0.1, 1))
    )


_PRESETS = {"fast": _fast, "default": _default, "quality": _quality}
