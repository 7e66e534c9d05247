"""Scale sweep: a view at other resolutions, against the picture that pixels average.

The truth of a pixel is the mean, over its square, of the composited Gaussians as they
are: without dilation or compensation. It is rendered at 8 times the resolution, and
blocks of 8 × 8 pixels are averaged. Each of these small pixels is itself averaged
nearly exactly, by a Gaussian filter of the variance of its square, 1/12, with
compensated opacities. Sampled at points instead, Gaussians much smaller than a small
pixel would be missed. Against quadrature, this truth is within 96 dB where the smallest
Gaussians have σ = 0.12 px, and 74 dB at 1/8 of that resolution.

Below the resolution of the camera the whole view is drawn; above it, its middle, so
that the size of the image stays the same.
"""

from __future__ import annotations

import typing
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.plots.figures import figure_pixels, new_chart, plain
from gsjax.raster.exact import render_exact
from gsjax.raster.types import RasterConfig
from gsjax.synthetic.stress_scenes import StressScene
from gsjax.train.config import mip_raster

if typing.TYPE_CHECKING:
    from matplotlib.figure import Figure

SCALES = (1 / 8, 1 / 4, 1 / 2, 1.0, 2.0, 4.0, 8.0)
_SAMPLES = 8  # of the truth, along each side of a pixel
# The cutoffs of `RasterConfig.compat` would hide the errors of the filters.
_BASE = RasterConfig.accurate(outputs=("rgb",))
_BOX = _BASE.replace(dilation=1 / 12, antialias=True)
FILTERS = {
    "dilation 0.3": _BASE,
    "compensated 0.3": _BASE.replace(antialias=True),
    "mip 0.1": mip_raster(_BASE),
}


class ScaleRow(NamedTuple):
    """Error of a filter at a resolution.

    Attributes:
      scale: resolution in that of the camera.
      filter: a key of `FILTERS`.
      psnr: dB, of rgb against the truth.
      max: largest error of rgb.
      brightness: mean of rgb, relative to that of the truth.
      truth: PSNR in dB of the truth with half the samples against the truth.
    """

    scale: float
    filter: str
    psnr: float
    max: float
    brightness: float
    truth: float


def scaled_camera(camera: Camera, scale: float, samples: int = 1) -> Camera:
    """Return a camera at another resolution, of images of one size.

    Args:
      camera: a single camera.
      scale: factor on its resolution. Below 1 the view fills the upper left corner,
        `Camera.visible_size`; above 1 the middle of the view fills the image.
      samples: number of samples along each side of a pixel: the image is larger.
    """
    size = np.asarray([camera.width, camera.height])
    K = np.diag([scale, scale, 1.0]) @ np.asarray(camera.K, np.float64)
    drawn = size
    if scale < 1:
        drawn = np.maximum(1, np.floor(size * scale + 1e-9)).astype(int)
    else:
        K[:2, 2] -= np.floor((scale - 1) * size / 2)
    K = np.diag([samples, samples, 1.0]) @ K
    width, height = (size * samples).tolist()
    return camera.replace(
        K=K.astype(np.asarray(camera.K).dtype),
        width=width,
        height=height,
        visible_size=(drawn * samples).astype(np.int32),
    )


def _image(scene: StressScene, camera: Camera, config: RasterConfig) -> np.ndarray:
    """Return the part of an image that is drawn, [h, w, 3]."""
    behind = jnp.asarray(scene.background, jnp.float32)
    view = render_exact(scene.gaussians, camera, config, behind)
    width, height = (int(n) for n in np.asarray(camera.visible_size))
    return np.asarray(view.rgb, np.float64)[:height, :width]


def true_image(scene: StressScene, scale: float, samples: int = _SAMPLES) -> np.ndarray:
    """Return the picture [h, w, 3] that pixels average, see the module's docstring."""
    found = _image(scene, scaled_camera(scene.camera, scale, samples), _BOX)
    height, width = (n // samples for n in found.shape[:2])
    blocks = found.reshape(height, samples, width, samples, 3)
    return blocks.mean((1, 3))


def _decibels(image: np.ndarray, truth: np.ndarray) -> float:
    return float(-10 * np.log10(max(np.mean((image - truth) ** 2), 1e-30)))


def measure_scales(
    scene: StressScene, scales: Sequence[float] = SCALES
) -> list[ScaleRow]:
    """Compare the filters with the truth at each resolution; compiles five programs.

    Args:
      scene: Gaussians, camera and background.
      scales: resolutions in that of the camera.

    Raises:
      CapacityError: if an image of 8 times the size of the camera does not fit.
    """
    rows = []
    for scale in scales:
        truth = true_image(scene, scale)
        apart = _decibels(true_image(scene, scale, _SAMPLES // 2), truth)
        camera = scaled_camera(scene.camera, scale)
        for name, config in FILTERS.items():
            found = _image(scene, camera, config)
            row = ScaleRow(
                scale=scale,
                filter=name,
                psnr=_decibels(found, truth),
                max=float(np.abs(found - truth).max()),
                brightness=float(found.mean() / max(truth.mean(), 1e-9)),
                truth=apart,
            )
            rows.append(row)
    return rows


def scale_text(scale: float) -> str:
    """Return a resolution as people write it, such as "1/4" or "4"."""
    return f"1/{1 / scale:g}" if scale < 1 else f"{scale:g}"


def scales_table(rows: Sequence[ScaleRow]) -> str:
    """Return lines of PSNR and brightness by resolution and filter."""
    names = list(dict.fromkeys(row.filter for row in rows))
    wide = [f"{name:>18}" for name in names]
    lines = [f"  {'scale':>6}" + "".join(wide) + f"{'half samples':>15}"]
    for scale in dict.fromkeys(row.scale for row in rows):
        some = {row.filter: row for row in rows if row.scale == scale}
        cells = [f"{r.psnr:9.1f} ({r.brightness:5.3f})" for r in some.values()]
        truth = next(iter(some.values())).truth
        text = "  ".join([f"{scale_text(scale):>6}", *cells])
        lines.append(f"  {text}{truth:13.1f}")
    lines += [
        "  PSNR in dB against the mean over each pixel (and relative brightness)",
        "  half samples: PSNR of that mean from half the samples along each side",
    ]
    return "\n".join(lines)


def scales_picture(rows: Sequence[ScaleRow], name: str) -> np.ndarray:
    """Return the pixels [H, W, 3] uint8 of `scales_figure`."""
    return figure_pixels(scales_figure(rows, name))


def scales_figure(rows: Sequence[ScaleRow], name: str) -> Figure:
    """Draw PSNR and brightness over the resolution, a line for each filter.

    Args:
      rows: of `measure_scales`.
      name: of the scene.
    """
    figure, axes = new_chart((860, 760), rows=2)
    scales = sorted({row.scale for row in rows})
    for index, kind in enumerate(dict.fromkeys(row.filter for row in rows)):
        some = sorted(row for row in rows if row.filter == kind)
        at = [row.scale for row in some]
        options: Any = {"marker": "os^Dv"[index % 5], "color": f"C{index % 10}"}
        axes[0].plot(at, [row.psnr for row in some], label=plain(kind), **options)
        axes[1].plot(at, [row.brightness for row in some], **options)
    for each, label in zip(axes, ("PSNR, dB", "brightness, relative")):
        each.set_xscale("log", base=2)
        each.set_xticks(scales, [scale_text(scale) for scale in scales])
        each.set(xlabel="resolution, in that of the camera", ylabel=label)
    axes[0].set_title(f"{plain(name)}: against the mean over each pixel")
    axes[1].axhline(1, color="gray", zorder=1)
    figure.legend(loc="outside lower center", ncols=4, frameon=False)
    return figure
