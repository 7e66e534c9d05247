"""How well a scene shows the views that it was not trained on.

Axis legend: H W image.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import make_camera
from gsjax.data.types import Photo, View
from gsjax.gaussians import Gaussians
from gsjax.raster.render import render_exact
from gsjax.raster.types import RasterConfig
from gsjax.runtime.devices import replicate
from gsjax.train.metrics import psnr, ssim

LPIPS_NOTE = "unavailable: its weights are not part of gsjax"


class ViewResult(NamedTuple):
    """One view beside its photograph.

    Attributes:
      name: of the view.
      psnr: dB, of the render clipped to [0, 1]; NaN, as is ``ssim``, where no pixel
        counts.
      ssim: see `gsjax.train.metrics.ssim`.
      truth, render: [H, W, 3] float32; where the photograph is transparent it is over
        the background.
      depth: [H, W] expected camera z, 0 where nothing is.
      valid: [H, W] bool, or None where every pixel counts.
    """

    name: str
    psnr: float
    ssim: float
    truth: np.ndarray
    render: np.ndarray
    depth: np.ndarray
    valid: np.ndarray | None


class Summary(NamedTuple):
    """Means over the views of which any pixel counts.

    Attributes:
      views: how many.
      psnr: dB; NaN of no views.
      ssim: at most 1; NaN of no views.
      lpips: why there is none.
    """

    views: int
    psnr: float
    ssim: float
    lpips: str = LPIPS_NOTE


_scores = jax.jit(lambda image, target, weight: (
    psnr(image, target, weight), ssim(image, target, weight)
))  # fmt: skip


def evaluate(
    gaussians: Gaussians,
    views: Sequence[View],
    photos: Sequence[Photo],
    *,
    config: RasterConfig | None = None,
    background: Sequence[float] = (0.0, 0.0, 0.0),
) -> Iterator[ViewResult]:
    """Render each view at its photograph's size and compare.

    Photographs of other sizes than the largest are part of a larger picture while they
    are rendered: one program is compiled for all.

    Args:
      gaussians: the scene.
      views, photos: as many of one as of the other.
      config: how to render.
      background: [3] RGB behind the scene, and behind transparent photographs.

    Yields:
      One result for each view, as soon as it is there.

    Raises:
      ValueError: if there are more of one than of the other.
      InputError: as `Photo.require`.
      CapacityError: as `render_exact`.
    """
    config = config or RasterConfig()
    config = config.replace(outputs=("rgb", "depth"), absgrad=False)
    # One program for all that a training measures, however many are active by then.
    room = config.visible_capacity or gaussians.capacity
    config = config.replace(visible_capacity=room)
    behind = np.asarray(background, np.float32)
    gaussians = replicate(gaussians)
    for view, photo in zip(views, photos, strict=True):
        photo.require(view.name)
    sizes = {photo.pixels.shape[:2] for photo in photos}
    height, width = np.max([(1, 1), *sizes], axis=0)
    for view, photo in zip(views, photos, strict=True):
        camera = make_camera(
            viewmat=view.viewmat,
            K=photo.K,
            width=int(width),
            height=int(height),
            near=view.near,
        )
        rows, cols = photo.pixels.shape[:2]
        size = jnp.asarray([cols, rows]) if len(sizes) > 1 else None
        result = render_exact(gaussians, camera, config, jnp.asarray(behind), size=size)
        assert result.rgb is not None
        image = np.clip(np.asarray(result.rgb, np.float32)[:rows, :cols], 0, 1)
        truth, weight = _over(photo, behind), None
        if photo.valid is not None or len(sizes) > 1:
            weight = np.ones((rows, cols), np.float32)
            weight *= 1 if photo.valid is None else photo.valid
        quality = likeness = np.nan
        if weight is None or weight.any():
            room = (0, int(height) - rows), (0, int(width) - cols)
            given = np.pad(image, (*room, (0, 0))), np.pad(truth, (*room, (0, 0)))
            counted = None if weight is None else np.pad(weight, room)
            quality, likeness = _scores(*given, counted)
        yield ViewResult(
            name=view.name,
            psnr=float(quality),
            ssim=float(likeness),
            truth=truth,
            render=image,
            depth=np.asarray(result.depth, np.float32)[:rows, :cols],
            valid=photo.valid,
        )


def _over(photo: Photo, background: np.ndarray) -> np.ndarray:
    """The photograph in [0, 1], over the background where it is transparent."""
    truth = photo.pixels.astype(np.float32) / 255
    if photo.alpha is None:
        return truth
    alpha = photo.alpha[..., None].astype(np.float32) / 255
    return truth * alpha + background * (1 - alpha)


def summarise(results: Iterable[ViewResult]) -> Summary:
    """Means of PSNR (dB) and SSIM over what `evaluate` gives; of no views NaN."""
    results = list(results)
    scores = np.array([(r.psnr, r.ssim) for r in results]).reshape(-1, 2)
    scores = scores[~np.isnan(scores).any(1)]
    means = scores.mean(0) if len(scores) else np.full(2, np.nan)
    return Summary(len(scores), psnr=float(means[0]), ssim=float(means[1]))
