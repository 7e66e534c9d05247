"""Quality of a scene on held-out pictures.

Axis legend: V pictures, H W image.
"""

import time
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.compression.types import HeldOut, Quality
from gsjax.gaussians import Gaussians, capacity_bucket, grow, with_sh_degree
from gsjax.raster.exact import exact_config, render_exact
from gsjax.raster.types import RasterConfig
from gsjax.runtime.devices import replicate
from gsjax.train.metrics import psnr, ssim

_FEW = 4  # pictures from which estimates are corrected
_MARGIN = 1.2  # spare room for pairs, so that few programs are compiled


def squared_error(pictures: list[np.ndarray], others: list[np.ndarray]) -> float:
    """Return the mean squared difference of pictures."""
    return float(np.mean([np.mean(np.square(a - b)) for a, b in zip(pictures, others)]))


_psnr, _ssim = jax.jit(psnr), jax.jit(ssim)


class Judge:
    """Renders scenes from held-out cameras and compares the pictures.

    All scenes are drawn by one program, with the slots and harmonics of the first.

    Attributes:
      pictures: [H, W, 3] of the scene before compression.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        held_out: HeldOut,
        config: RasterConfig,
        background: Sequence[float],
    ):
        self.held_out = held_out
        self.slots, self.degree = gaussians.capacity, gaussians.sh_degree
        self.behind = jnp.asarray(background, gaussians.params.means.dtype)
        config = config.replace(outputs=("rgb",), absgrad=False)
        fitted = [exact_config(gaussians, c, config) for c in held_out.cameras]
        needed = max(one.pair_capacity or 1 for one in fitted)
        self.config = config.replace(
            pair_capacity=capacity_bucket(int(_MARGIN * needed)),
            visible_capacity=self.slots,
        )
        self.pictures = self.draw(gaussians)

    def few(self, gaussians: Gaussians | None = None) -> list[np.ndarray]:
        """Return some pictures of a scene; None for that before compression."""
        count = len(self.pictures)
        places = np.unique(np.linspace(0, count - 1, _FEW).astype(int))
        if gaussians is None:
            return [self.pictures[place] for place in places]
        return self.draw(gaussians, places)

    def draw(self, gaussians: Gaussians, places=None) -> list[np.ndarray]:
        """Return the pictures of a scene, or those at ``places``, clipped to [0, 1]."""
        gaussians = with_sh_degree(gaussians, self.degree)
        if gaussians.capacity < self.slots:
            gaussians = grow(gaussians, self.slots)
        gaussians = replicate(gaussians)
        cameras = self.held_out.cameras
        places = range(len(cameras)) if places is None else places
        return [self._picture(gaussians, cameras[place]) for place in places]

    def _picture(self, gaussians: Gaussians, camera: Camera) -> np.ndarray:
        drawn = render_exact(gaussians, camera, self.config, self.behind)
        return np.clip(np.asarray(drawn.rgb, np.float32), 0, 1)

    def judge(self, gaussians: Gaussians, *, timed: bool = False) -> Quality:
        """Return the quality of a scene; ``timed`` draws each picture once more."""
        pictures = self.draw(gaussians)
        start = time.perf_counter()
        if timed:
            self.draw(gaussians)
        seconds = (time.perf_counter() - start) / max(len(pictures), 1)
        before = self._scores(pictures, self.pictures)
        photos = self.held_out.photos
        scores = (None, None) if photos is None else self._scores(pictures, photos)
        largest = [np.abs(a - b).max() for a, b in zip(pictures, self.pictures)]
        return Quality(
            psnr=scores[0],
            ssim=scores[1],
            psnr_before=before[0],
            ssim_before=before[1],
            largest_error=float(max(largest)),
            seconds=seconds if timed else float("nan"),
        )

    def _scores(self, pictures, truths) -> tuple[float, float]:
        """Return mean PSNR and SSIM over the pictures with pixels that count."""
        valid = self.held_out.valid or [None] * len(pictures)
        scores = []
        for picture, truth, mask in zip(pictures, truths, valid):
            weight = None if mask is None else np.asarray(mask, np.float32)
            if weight is None or weight.any():
                truth = np.asarray(truth, np.float32)
                both = _psnr(picture, truth, weight), _ssim(picture, truth, weight)
                scores.append([float(one) for one in both])
        if not scores:
            return float("nan"), float("nan")
        quality, similarity = np.mean(scores, 0)
        return float(quality), float(similarity)
