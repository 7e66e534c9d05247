"""Settings of a training run, and its presets."""

import math
from dataclasses import dataclass, field, replace
from itertools import pairwise

from gsjax.densify.adaptive import AdaptiveSettings, adaptive
from gsjax.densify.mcmc import McmcSettings, mcmc
from gsjax.densify.types import Densifier
from gsjax.errors import InputError
from gsjax.raster.types import RasterConfig
from gsjax.runtime.settings import number, require_ranges, settle
from gsjax.train.optimiser import Rates

STRATEGIES = ("adaptive", "mcmc")
BACKGROUNDS = ("auto", "black", "white", "random")
INITIALS = ("auto", "points", "dense", "random")


@dataclass(frozen=True)
class Level:
    """From ``start`` on, images are ``divisor`` times smaller.

    Attributes:
      start: share of all steps, 0 to 1.
      divisor: of width and height.

    Raises:
      InputError: if one is no number.
    """

    start: float
    divisor: int

    def __post_init__(self):
        settle(self)


@dataclass(frozen=True)
class TrainConfig:
    """All that a run depends on besides its photographs; the defaults are the field's.

    Attributes:
      steps: how many, of ``batch`` views each.
      seed: of all that is random.
      strategy: "adaptive" or "mcmc", with the settings of that name; no slot is
        edited behind the last step.
      max_size: px, longest side that photographs are scaled down to; None: as is.
      levels: coarse to fine.
      sh_degree: of the scene; bands join one by one, every ``sh_every`` steps.
      ssim_weight: share of 1 − SSIM in the loss.
      background: behind the scene while training; "random" is a new colour at each
        step, so that nothing hides in it. "auto" is random where photographs are
        transparent, which tells what is nothing, else black. But for "white", views
        and files have it black.
      initial: "points" of the dataset; "dense": those, and more on which the
        photographs agree (`gsjax.train.initialisation.add_dense_points`); or "random" ones in view.
        "auto" is points where there are any, else random; so is "dense" where next to
        nothing is found.
      initial_count: how many random ones.
      dense_count: how many more points than those of the dataset, at most.
      max_initial: of more points than that, that many are drawn.
      rates: of Adam.
      refine_poses, refine_intrinsics: learn small corrections of the cameras.
      exposure: learn an affine correction of the colours of each photograph.
      pose_rate, intrinsics_rate, exposure_rate: of Adam, for those.
      skip_masked: leave out the tiles of a view whose pixels are all masked;
        changes nothing beyond rounding.
      prune_invisible: at the end, remove the Gaussians that are in none of the views that
        were trained on; changes no bit of those. (The count of the last step is the
        one before.)
      every_eval: in steps, measure the held-out views; 0 only at the end.
      every_checkpoint: in steps; 0 only at the end.
      raster: how to render; sizes in it are set by the run.

    Raises:
      InputError: if a setting is out of its range.
    """

    steps: int = 30_000
    batch: int = 1
    seed: int = 0
    strategy: str = "adaptive"
    adaptive: AdaptiveSettings = field(default_factory=AdaptiveSettings)
    mcmc: McmcSettings = field(default_factory=McmcSettings)
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
    rates: Rates = field(default_factory=Rates)
    refine_poses: bool = False
    refine_intrinsics: bool = False
    exposure: bool = False
    pose_rate: float = 1e-5
    intrinsics_rate: float = 1e-5
    exposure_rate: float = 1e-3
    skip_masked: bool = True
    prune_invisible: bool = True
    every_eval: int = 0
    every_checkpoint: int = 1000
    # What compiles faster: one size of the work, as a run grows its capacities itself;
    # no search for what is hidden, of which views of photographs hold next to nothing.
    raster: RasterConfig = field(
        default_factory=lambda: RasterConfig(num_size_buckets=1, occlusion=False)
    )

    def __post_init__(self):
        settle(self)
        if self.strategy not in STRATEGIES:  # which others depend on
            require_ranges(self, {"strategy": False})
        rates = _settled(self.rates)
        object.__setattr__(self, "rates", rates)
        first, last = rates.means
        checks = {
            "steps": 1 <= self.steps < 2**31 - 1,
            "seed": 0 <= self.seed < 2**31,
            "batch": self.batch >= 1,
            "max_size": self.max_size is None or self.max_size >= 8,
            "levels": bool(self.levels)
            and self.levels[0].start == 0
            and all(a.start < b.start for a, b in pairwise(self.levels))
            and all(level.divisor >= 1 for level in self.levels),
            "sh_degree": 0 <= self.sh_degree <= 4,
            "sh_every": self.sh_every >= 1,
            "ssim_weight": 0 <= self.ssim_weight <= 1,
            "rates' means": first == last >= 0 or min(first, last) > 0,
            "rates' cooling": 0 < rates.cooling <= 1,
            "rates' cooling_from": 0 <= rates.cooling_from < 1,
            "rates": all(0 <= rate < math.inf for rate in (first, last, *rates[1:])),
            "pose_rate": 0 <= self.pose_rate < math.inf,
            "intrinsics_rate": 0 <= self.intrinsics_rate < math.inf,
            "exposure_rate": 0 <= self.exposure_rate < math.inf,
            "background": self.background in BACKGROUNDS,
            "initial": self.initial in INITIALS,
            "initial_count": self.initial_count >= 1,
            "dense_count": self.dense_count >= 0,
            f"{self.strategy}'s initial_opacity": 0 < self.chosen.initial_opacity < 1,
            f"{self.strategy}'s initial_scale": self.chosen.initial_scale > 0,
            "max_initial": self.max_initial >= 1,
            "every_eval": self.every_eval >= 0,
            "every_checkpoint": self.every_checkpoint >= 0,
        }
        require_ranges(self, checks)

    def replace(self, **changes) -> "TrainConfig":
        """A copy with some settings changed."""
        return replace(self, **changes)

    def densifier(self, extent: float) -> Densifier:
        """The strategy, for a scene of this extent."""
        settings = self.chosen
        if isinstance(settings, McmcSettings):
            return mcmc(settings, extent)
        return adaptive(settings, extent)

    @property
    def chosen(self) -> AdaptiveSettings | McmcSettings:
        """The settings of the strategy, which edits nothing behind the last step:
        that would not be learnt any more."""
        settings = self.mcmc if self.strategy == "mcmc" else self.adaptive
        return replace(settings, stop=min(settings.stop, self.steps - 1))

    @property
    def max_gaussians(self) -> int:
        """The most that the strategy may make."""
        return self.chosen.max_gaussians

    def divisor(self, step: int) -> int:
        """How much smaller the images are at ``step`` (from 0)."""
        share = step / self.steps
        return next(lv.divisor for lv in reversed(self.levels) if share >= lv.start)


def _settled(rates: Rates) -> Rates:
    """Their numbers as Python's.

    Raises:
      InputError: if one is none.
    """
    first, last = rates.means
    means = number("Rates.means", first), number("Rates.means", last)
    rest = rates._asdict()
    del rest["means"]
    return Rates(means, **{k: number(f"Rates.{k}", v) for k, v in rest.items()})


def scaled(config: TrainConfig, steps: int) -> TrainConfig:
    """The same run in another number of steps: its schedules keep their shares."""
    ratio = steps / config.steps

    def some(count: int, least: int = 1) -> int:
        return max(least, round(count * ratio)) if count else count

    old = config.adaptive
    return config.replace(
        steps=steps,
        sh_every=some(config.sh_every),
        adaptive=replace(
            old,
            start=some(old.start),
            stop=some(old.stop),
            every=some(old.every, 20),
            reset_every=some(old.reset_every, 20),
        ),
        mcmc=replace(
            config.mcmc,
            start=some(config.mcmc.start),
            stop=some(config.mcmc.stop),
            every=some(config.mcmc.every, 20),
        ),
    )


def continuation_config(config: TrainConfig) -> TrainConfig:
    """The same run for a scene that was trained before: what such a scene has of
    harmonics and of detail is used from the first steps on."""
    finest = Level(0.0, config.levels[-1].divisor)
    return config.replace(sh_every=1, levels=(finest,))


def preset(name: str) -> TrainConfig:
    """Settings by name.

    Args:
      name: "fast" is minutes on two cores; "default" 4000 steps on photographs of up
        to 800 px; "quality" the 30 000 steps of the papers, for bigger machines.

    Raises:
      InputError: if there is none of that name.
    """
    if name not in _PRESETS:
        raise InputError(f"no preset is called {name!r}; known: {sorted(_PRESETS)}")
    return _PRESETS[name]()


_HALF = (Rates().means[0] / 2, Rates().means[1] / 2)  # the papers'


def _fast() -> TrainConfig:
    return TrainConfig(
        steps=1200,
        strategy="mcmc",
        max_size=400,
        # One size of the photographs: a program more to compile is no faster in so few
        # steps, and what dense points begin with is sharp.
        initial="dense",
        dense_count=20_000,
        sh_degree=1,
        sh_every=375,
        # Those of the papers are for 30 000 steps. So many times more than here, 25,
        # are a walk √25 times as long, and rates of about that make up for it. What
        # is held out swings with such rates, the more the more views there are, and so
        # they fall early: from 60 % of the run on, a room of 120 views was 0.5 dB
        # worse, and the demo 0.1 dB better. Dense
        # points begin where they belong, half of it for the means, but with gaps
        # between them, twice as much for the scales: bananas are at 25.5 dB after 100
        # steps for 23.1. At the end that is 0.5 dB more on kermit and on the demo, and
        # 0.2 dB less on bananas (benchmarks/training.py).
        rates=Rates(_HALF, log_scales=0.01, cooling=0.1, cooling_from=0.35).times(4.0),
        # Edits set a run back for a while: few, and early enough to settle after.
        adaptive=AdaptiveSettings(
            start=75,
            stop=600,
            every=75,
            reset_every=0,
            # Without resets nothing else frees what hangs as fog before a few views.
            scale_penalty=0.01,
            max_gaussians=30_000,
            initial_opacity=0.5,
            initial_scale=0.5,
        ),
        mcmc=McmcSettings(
            start=75,
            stop=975,
            every=50,
            growth=1.2,
            max_gaussians=30_000,
            initial_scale=0.5,
        ),
    )


def _default() -> TrainConfig:
    return TrainConfig(
        steps=4000,
        strategy="mcmc",
        max_size=800,
        # No more: what is coarse costs by the Gaussian, not by the pixel.
        initial="dense",
        dense_count=20_000,
        levels=(Level(0.0, 2), Level(0.3, 1)),
        sh_degree=2,
        sh_every=600,
        # As in `_fast`, for fewer steps than the papers'.
        rates=Rates(means=_HALF, cooling=0.1).times(2.0),
        adaptive=AdaptiveSettings(
            start=200, stop=2600, every=100, reset_every=0, max_gaussians=300_000
        ),
        mcmc=McmcSettings(
            start=200,
            stop=3100,
            every=100,
            growth=1.05,
            max_gaussians=150_000,
            initial_scale=0.5,
        ),
    )


def _quality() -> TrainConfig:
    return TrainConfig(
        initial="dense", levels=(Level(0.0, 4), Level(0.03, 2), Level(0.1, 1))
    )


_PRESETS = {"fast": _fast, "default": _default, "quality": _quality}
