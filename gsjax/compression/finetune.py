"""Train a quantised scene on photographs, with its quantisation in the loop.

The forward pass draws what the file would hold; derivatives go through the rounding as
if it were the identity (the straight-through estimator of Bengio, Léonard and
Courville, "Estimating or propagating gradients through stochastic neurons", 2013). The
steps of all numbers and the labels of the palette are fixed; its entries are trained.

Axis legend: N Gaussians, S slots, K spherical-harmonic bases, C entries of the palette.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from gsjax.compression.lattices import Lattice, snap, snap_quats
from gsjax.compression.palettes import Palette, with_table
from gsjax.compression.quantise import Quantised, as_gaussians, rows_of
from gsjax.data.extent import extent_of
from gsjax.data.types import Dataset, Photo
from gsjax.densify.fixed import FIXED
from gsjax.gaussians import GaussianParams, Gaussians
from gsjax.runtime.console import progress
from gsjax.train.config import Level, TrainConfig
from gsjax.train.initialisation import initial_state
from gsjax.train.loop import Hooks, Progress, fit
from gsjax.train.models import IDENTITY, Model, ModelParams, SceneParams
from gsjax.train.optimiser import Rates
from gsjax.train.state import make_setup

Array = jax.Array

# Those of Kerbl et al. 2023, but for the means, which start where a run ends.
_RATES = Rates(means=(1.6e-5, 1.6e-6), cooling=0.05, cooling_from=0.2)
_PALETTE_RATE = 1e-3


class Finetuning(NamedTuple):
    """Settings for training a scene further while it is compressed.

    Attributes:
      dataset: training views.
      photos: one for each view, from `gsjax.data.photos.load_photos`.
      config: settings of the run, such as those of the loss and of the render. Density
        control and learning rates are those of the fine-tuning.
      steps: number of steps of each trial.
    """

    dataset: Dataset
    photos: Sequence[Photo]
    config: TrainConfig
    steps: int = 500


def finetune(scene: Quantised, finetuning: Finetuning) -> Quantised:
    """Return the scene with its numbers trained on photographs.

    Raises:
      InputError, CapacityError, DivergedError: as `gsjax.fit`.
    """
    coding, rows = scene.coding, dict(scene.rows)
    model = IDENTITY
    if coding.lattice is not None and coding.palette is not None:
        rows["sh"] = rows["sh"][:, :1]
        model = quantised_model(scene, coding.lattice, coding.palette)
    start = as_gaussians(rows)
    config = finetuning.config
    config = config.replace(
        steps=finetuning.steps,
        levels=(Level(0.0, config.levels[-1].divisor),),
        sh_degree=start.sh_degree,
        sh_every=1,
        rates=_RATES,
        # The scene holds what a filter or refined cameras have made of it.
        mip=False,
        refine_poses=False,
        refine_intrinsics=False,
        refine_shutter=False,
        normal_weight=0.0,
        distortion_weight=0.0,
        entropy_weight=0.0,
        prune_invisible=False,
        raster=config.raster.replace(),  # a copy: not the default of other settings
    )
    dataset = finetuning.dataset
    parts = {"strategy": FIXED, "model": model}
    setup = make_setup(config, extent_of(dataset), **parts)
    state = initial_state(dataset, config, start, setup)
    bar = progress(range(config.steps), "fine-tuning")
    next(bar)

    def step(_: Progress) -> None:
        next(bar, None)

    found = fit(
        dataset, finetuning.photos, config, state=state, hooks=Hooks(step), **parts
    )
    return _with_rows(scene, rows_of(found.gaussians))


def _with_rows(scene: Quantised, rows: dict[str, np.ndarray]) -> Quantised:
    """Return a quantised scene with trained numbers; the palette gets a short table."""
    palette = scene.coding.palette
    if palette is None or not palette.used:
        return scene._replace(rows=rows, harmonics=rows["sh"])
    entries = np.array(palette.entries)
    entries[palette.labels] = rows["sh"][:, 1:]
    shares = np.bincount(palette.labels, minlength=len(entries))
    palette = palette._replace(entries=with_table(entries, shares))
    rest = palette.entries[palette.labels]
    rows["sh"] = np.concatenate([rows["sh"][:, :1], rest], 1)
    coding = scene.coding._replace(palette=palette)
    return scene._replace(rows=rows, harmonics=rows["sh"], coding=coding)


def quantised_model(scene: Quantised, lattice: Lattice, palette: Palette) -> Model:
    """Return a scene model of Gaussians of degree 0 that draws them as files hold them.

    Its shared parameter ``palette`` [C, K - 1, 3] are the harmonics above degree 0, of
    which zeros stay zero. Means at the limits of a file are not moved, since its
    lattice follows from the limits.

    Args:
      scene: N Gaussians, which are the first slots in training.
      lattice, palette: of their coding.
    """
    like = {"labels": jnp.int32, "fixed": jnp.bool_}
    start = {
        "labels": palette.labels,
        "fixed": _at_limits(scene.rows["means"], scene.part),
        **scene.coding.steps,
    }

    def init(gaussians: Gaussians) -> ModelParams:
        slots, dtype = gaussians.capacity, gaussians.params.means.dtype
        buffers = {}
        for name, array in start.items():
            rest = ((0, slots - len(array)), *((0, 0),) * (array.ndim - 1))
            padded = np.pad(array, rest, mode="edge")
            buffers[name] = jnp.asarray(padded, like.get(name, dtype))
        entries = jnp.asarray(palette.entries, dtype)
        return ModelParams(shared={"palette": entries}, buffers=buffers)

    def draw(params: SceneParams) -> Gaussians:
        buffers, gaussians = params.model.buffers, params.gaussians
        drawn = _through(gaussians.params, lattice, buffers, len(scene.part))
        entries = jnp.where(palette.entries == 0, 0, params.model.shared["palette"])
        sh = jnp.concatenate([drawn.sh, entries[buffers["labels"]]], 1)
        return gaussians.replace(params=drawn.replace(sh=sh))  # pyright: ignore

    return Model(
        init=init,
        apply=lambda params, _: draw(params),
        rates={"palette": _PALETTE_RATE},
        scene=draw,
    )


def _at_limits(means: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Return which means [N] lie on a side of the box of their file."""
    found = np.zeros(len(means), bool)
    for one in np.unique(part):
        inside = means[part == one]
        sides = (inside == inside.min(0)) | (inside == inside.max(0))
        found[part == one] = sides.any(1)
    return found


def _through(
    params: GaussianParams, lattice: Lattice, buffers: dict[str, Array], count: int
) -> GaussianParams:
    """Return rounded numbers with the derivative of those that are not rounded."""
    fixed = buffers["fixed"][:, None]
    means = jnp.where(fixed, lax.stop_gradient(params.means), params.means)
    length = jnp.linalg.norm(params.quats, axis=-1, keepdims=True)
    quats = params.quats / jnp.maximum(length, 1e-12)

    def straight(name: str, values: Array, way: Callable = snap) -> Array:
        given = lax.stop_gradient(values[:count])
        rounded = way(getattr(lattice, name), given, buffers[name][:count])
        return values.at[:count].add(lax.stop_gradient(rounded - given))

    return params.replace(  # pyright: ignore
        means=straight("means", means),
        quats=straight("quats", quats, snap_quats),
        log_scales=straight("log_scales", params.log_scales),
        logit_opacities=straight("logit_opacities", params.logit_opacities),
        sh=straight("colors", params.sh[:, 0])[:, None],
    )
