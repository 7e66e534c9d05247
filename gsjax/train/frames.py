"""Photographs on the device, and the views of each step.

Axis legend: V views, H W image, B views of a step.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np

from gsjax.cameras.camera import Camera, make_camera, with_shutter
from gsjax.cameras.distortion import lens_fields
from gsjax.cameras.shutter import SHUTTERS
from gsjax.data.types import Photo, View
from gsjax.io.images import opencv
from gsjax.math.numerics import to_device

Array = jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Frames:
    """Photographs of all views at one resolution.

    Attributes:
      pixels: [V, H, W, 3 or 4] uint8; the fourth channel is opacity.
      valid: [V, H, W] bool, False for excluded pixels; None if all are valid.
      camera: batch of V cameras.
      size: [V, 2] int32, width and height of each photograph, which occupies the upper
        left corner; None if all photographs have the size of the frame.
      time: [V] `gsjax.data.types.View.time`; 0 where it is unknown.
    """

    pixels: Array
    valid: Array | None
    camera: Camera
    size: Array | None = None
    time: Array | None = None

    @property
    def count(self) -> int:
        """Number of views V."""
        return self.pixels.shape[0]


class Batch(NamedTuple):
    """Photographs of one step.

    Attributes:
      pixels, valid, camera, size, time: as in `Frames`, with B for V.
      view: [B] int32, indices of the views.
      background: [3] colour behind the scene and transparent photographs; None is
        black. The training step sets it.
    """

    pixels: Array
    valid: Array | None
    camera: Camera
    view: Array
    size: Array | None = None
    time: Array | None = None
    background: Array | None = None

    @property
    def transparent(self) -> bool:
        """True if the photographs have an opacity channel."""
        return self.pixels.shape[-1] == 4


def make_frames(
    views: Sequence[View],
    photos: Sequence[Photo],
    divisor: int = 1,
    *,
    shutter: str = "global",
    distorting: bool = False,
) -> Frames:
    """Return photographs, downscaled by ``divisor``, padded to one size.

    Padding is on the right and bottom, and is not valid.

    Args:
      views, photos: V each.
      divisor: factor by which both sides shrink.
      shutter: name of the shutter of all cameras.
      distorting: give pinholes a distortion of 0, to be optimised.

    Raises:
      InputError: if the photographs have lenses of different kinds.
    """
    small = [_downscale(photo, divisor) for photo in photos]
    size = np.asarray([p.pixels.shape[1::-1] for p in small], np.int32)
    width, height = size.max(0).tolist()
    with_alpha = any(p.alpha is not None for p in small)
    pixels = np.zeros((len(small), height, width, 3 + with_alpha), np.uint8)
    valid = np.zeros(pixels.shape[:3], bool)
    for index, (photo, (w, h)) in enumerate(zip(small, size)):
        pixels[index, :h, :w, :3] = photo.pixels
        if with_alpha:
            pixels[index, :h, :w, 3] = 255 if photo.alpha is None else photo.alpha
        valid[index, :h, :w] = True if photo.valid is None else photo.valid
    camera = make_camera(
        viewmat=np.stack([view.viewmat for view in views]),
        K=np.stack([photo.K for photo in small]),
        width=width,
        height=height,
        near=np.asarray([view.near for view in views]),
        **lens_fields([photo.lens for photo in small], distorting),
    )
    camera = with_shutter_of(views, shutter, camera)
    fields: Any = {
        "pixels": pixels,
        "valid": None if valid.all() else valid,
        "size": None if (size == (width, height)).all() else size,
        "time": np.asarray([view.time or 0.0 for view in views], np.float32),
    }
    return to_device(Frames(camera=camera, **fields))


def with_shutter_of(views: Sequence[View], shutter: str, camera: Camera) -> Camera:
    """Return a batch of the cameras of views with a shutter and their motions."""
    if not SHUTTERS[shutter].rolling:
        return camera
    return with_shutter(camera, shutter, twist=twists_of(views))


def twists_of(views: Sequence[View]) -> np.ndarray:
    """Return the motions of views [V, 6]; those without one stand still."""
    return np.stack([np.zeros(6) if v.twist is None else v.twist for v in views])


def _downscale(photo: Photo, divisor: int) -> Photo:
    if divisor == 1:
        return photo
    cv2 = opencv()
    height, width = photo.pixels.shape[:2]
    size = max(1, round(width / divisor)), max(1, round(height / divisor))

    def area(image):
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA)

    valid = photo.valid
    if valid is not None:
        valid = area(valid.astype(np.uint8) * 255) == 255
    scale = np.diag([size[0] / width, size[1] / height, 1.0])
    if photo.alpha is None:
        return Photo(area(photo.pixels), None, valid, scale @ photo.K, photo.lens)
    # Premultiplied: the colour of transparent pixels is undefined.
    weight = photo.alpha.astype(np.float32)[..., None]
    alpha = area(weight)
    colors = area(photo.pixels * weight) / np.where(alpha > 0, alpha, 1)[..., None]
    pixels = np.clip(np.rint(colors), 0, 255).astype(np.uint8)
    alpha = np.rint(alpha).astype(np.uint8)
    return Photo(pixels, alpha, valid, scale @ photo.K, photo.lens)


def views_of_step(seed: int, step: int, batch: int, views: int) -> np.ndarray:
    """Return the views [B] int32 of a step: random order, each view once per epoch.

    The result depends on the arguments only, so that a resumed run sees the same views.
    It is computed on the host because XLA compiles a permutation slowly.

    Args:
      seed, step: of the run; number of completed steps.
      batch, views: numbers B and V.
    """

    def one(number: int) -> int:
        epoch, place = divmod(number, views)
        return np.random.default_rng((seed, epoch)).permutation(views)[place]

    first = int(step) * batch  # step may be an array
    return np.asarray([one(first + i) for i in range(batch)], np.int32)


def views_until(
    seed: int, step: int, batch: int, times: np.ndarray, last: float
) -> np.ndarray:
    """Return random views [B] int32 of a step from those up to a time.

    Like `views_of_step`, it depends on the arguments only.

    Args:
      seed, step, batch: as `views_of_step`.
      times: [V] of all views.
      last: latest time; the views of the first time are always drawn from.
    """
    allowed = np.flatnonzero(times <= max(last, times.min()))
    rng = np.random.default_rng((seed, int(step), len(times)))
    return rng.choice(allowed, batch).astype(np.int32)


def draw(frames: Frames, view: Array) -> Batch:
    """Return the photographs of the views [B]."""
    drawn = jax.tree.map(lambda a: a[view], frames)
    return Batch(drawn.pixels, drawn.valid, drawn.camera, view, drawn.size, drawn.time)


def targets(batch: Batch, dtype) -> tuple[Array, Array | None]:
    """Return the photographs over the background of a step, and pixel weights.

    Args:
      batch: of B views.
      dtype: of the result.

    Returns:
      Images [B, H, W, 3] in [0, 1]; weights [B, H, W], 0 for excluded pixels, or None.
    """
    values = batch.pixels.astype(dtype) / 255
    rgb = values[..., :3]
    if batch.transparent:
        alpha = values[..., 3:]
        behind = 0 if batch.background is None else batch.background
        rgb = rgb * alpha + behind * (1 - alpha)
    return rgb, None if batch.valid is None else batch.valid.astype(dtype)
