"""PSNR and SSIM of a scene on held-out views.

Axis legend: H W image.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import make_camera
from gsjax.cameras.distortion import lens_fields
from gsjax.data.types import Photo, View
from gsjax.gaussians import Gaussians
from gsjax.raster.exact import render_exact
from gsjax.raster.types import RasterConfig
from gsjax.runtime.devices import replicate
from gsjax.train.frames import with_shutter_of
from gsjax.train.metrics import psnr, ssim
from gsjax.train.motion.scene import Scene, gaussians_at

LPIPS_NOTE = "unavailable: its weights are not part of gsjax"


class ViewResult(NamedTuple):
    """Comparison of a render with its photograph.

    Attributes:
      name: name of the view.
      psnr: PSNR in dB of the render, clipped to [0, 1]; NaN if all pixels are excluded.
      ssim: see `gsjax.train.metrics.ssim`; NaN if all pixels are excluded.
      truth: [H, W, 3] float32, the photograph over the background.
      render: [H, W, 3] float32.
      depth: [H, W] expected camera z, 0 in empty pixels.
      valid: [H, W] bool, False for excluded pixels; None if all are valid.
    """

    name: str
    psnr: float
    ssim: float
    truth: np.ndarray
    render: np.ndarray
    depth: np.ndarray
    valid: np.ndarray | None


class Summary(NamedTuple):
    """Means over the views that have valid pixels.

    Attributes:
      views: number of views.
      psnr: mean PSNR in dB; NaN without views.
      ssim: mean SSIM, at most 1; NaN without views.
      lpips: reason why LPIPS is unavailable.
    """

    views: int
    psnr: float
    ssim: float
    lpips: str = LPIPS_NOTE


_scores = jax.jit(lambda *arrays: (psnr(*arrays), ssim(*arrays)))


def evaluate(
    scene: Scene,
    views: Sequence[View],
    photos: Sequence[Photo],
    *,
    config: RasterConfig | None = None,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    shutter: str = "global",
) -> Iterator[ViewResult]:
    """Render each view at the size of its photograph and compare them.

    Photographs of different sizes are padded to the largest, so that one program is
    compiled for all.

    Args:
      scene: Gaussians, or a scene that moves, which is shown at the time of each view.
      views: V views.
      photos: V photographs, in the order of the views.
      config: render settings.
      background: [3] RGB behind the scene and behind transparent photographs.
      shutter: name of the shutter of all cameras.

    Yields:
      The result of each view, as soon as it is computed.

    Raises:
      ValueError: if the numbers of views and photographs differ.
      InputError: as `Photo.require`.
      CapacityError: as `render_exact`.
    """
    config = config or RasterConfig()
    # Independent of the number of active Gaussians, so that a run compiles once.
    visible = config.visible_capacity or scene.capacity
    changes = {"outputs": ("rgb", "depth"), "absgrad": False}
    config = config.replace(**changes, visible_capacity=visible)
    behind = np.asarray(background, np.float32)
    still = replicate(scene) if isinstance(scene, Gaussians) else None
    for view, photo in zip(views, photos, strict=True):
        photo.require(view.name)
    sizes = {photo.pixels.shape[:2] for photo in photos}
    height, width = np.max([(1, 1), *sizes], axis=0)
    if not photos:
        return
    cameras = make_camera(
        viewmat=np.stack([view.viewmat for view in views]),
        K=np.stack([photo.K for photo in photos]),
        width=int(width),
        height=int(height),
        near=np.asarray([view.near for view in views]),
        **lens_fields([photo.lens for photo in photos]),
    )
    cameras = with_shutter_of(views, shutter, cameras)
    for index, (view, photo) in enumerate(zip(views, photos, strict=True)):
        rows, cols = photo.pixels.shape[:2]
        camera = jax.tree.map(lambda a, i=index: a[i], cameras)
        size = jnp.asarray([cols, rows]) if len(sizes) > 1 else None
        camera = camera.replace(visible_size=size)
        gaussians = still or replicate(gaussians_at(scene, view.time))
        result = render_exact(gaussians, camera, config, jnp.asarray(behind))
        assert result.rgb is not None
        image = np.clip(np.asarray(result.rgb, np.float32)[:rows, :cols], 0, 1)
        truth, weight = photo.over(behind), None
        if photo.valid is not None or len(sizes) > 1:
            weight = np.ones((rows, cols), np.float32)
            weight *= 1 if photo.valid is None else photo.valid
        quality = similarity = np.nan
        if weight is None or weight.any():
            padding = (0, int(height) - rows), (0, int(width) - cols)
            images = [np.pad(a, (*padding, (0, 0))) for a in (image, truth)]
            counted = None if weight is None else np.pad(weight, padding)
            quality, similarity = _scores(*images, counted)
        yield ViewResult(
            name=view.name,
            psnr=float(quality),
            ssim=float(similarity),
            truth=truth,
            render=image,
            depth=np.asarray(result.depth, np.float32)[:rows, :cols],
            valid=photo.valid,
        )


def summarise(results: Iterable[ViewResult]) -> Summary:
    """Return the means of PSNR (dB) and SSIM over the results of `evaluate`."""
    results = list(results)
    scores = np.array([(r.psnr, r.ssim) for r in results]).reshape(-1, 2)
    scores = scores[~np.isnan(scores).any(1)]
    means = scores.mean(0) if len(scores) else np.full(2, np.nan)
    return Summary(len(scores), psnr=float(means[0]), ssim=float(means[1]))
