"""Photographs on the device, and which of them a step looks at.

Axis legend: V views, H W image, B views of a step.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import numpy as np

from gsjax.cameras.camera import Camera, make_camera
from gsjax.data.types import Photo, View
from gsjax.io.images import opencv
from gsjax.math.numerics import to_device

Array = jax.Array


@partial(
    jax.tree_util.register_dataclass,
    data_fields=("pixels", "valid", "camera", "size"),
    meta_fields=(),
)
@dataclass(frozen=True)
class Frames:
    """All views of one resolution.

    Attributes:
      pixels: [V, H, W, 3 or 4] uint8; the fourth is the photograph's opacity.
      valid: [V, H, W] bool, False where there is nothing to learn from; or None.
      camera: batch of V.
      size: [V, 2] int32, width and height of each photograph, which stands in the upper
        left corner; None if all are as large as the frame.
    """

    pixels: Array
    valid: Array | None
    camera: Camera
    size: Array | None = None

    @property
    def count(self) -> int:
        """V."""
        return self.pixels.shape[0]


class Batch(NamedTuple):
    """What one step sees.

    Attributes:
      pixels: [B, H, W, 3 or 4] uint8.
      valid: [B, H, W] bool or None.
      camera: batch of B.
      view: [B] int32, which of the V views these are.
      size: [B, 2] int32 or None, see `Frames`.
    """

    pixels: Array
    valid: Array | None
    camera: Camera
    view: Array
    size: Array | None = None


def make_frames(
    views: Sequence[View], photos: Sequence[Photo], divisor: int = 1
) -> Frames:
    """Photographs, ``divisor`` times smaller, in arrays of one size.

    Smaller ones are padded on the right and below; those pixels are not valid.
    """
    small = [_shrunk(photo, divisor) for photo in photos]
    height = max(p.pixels.shape[0] for p in small)
    width = max(p.pixels.shape[1] for p in small)
    with_alpha = any(p.alpha is not None for p in small)
    pixels = np.zeros((len(small), height, width, 3 + with_alpha), np.uint8)
    valid = np.zeros(pixels.shape[:3], bool)
    size = np.asarray([p.pixels.shape[1::-1] for p in small], np.int32)
    for index, photo in enumerate(small):
        h, w = photo.pixels.shape[:2]
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
    )
    frames = Frames(
        pixels,  # pyright: ignore
        None if valid.all() else valid,  # pyright: ignore
        camera,
        None if (size == (width, height)).all() else size,  # pyright: ignore
    )
    return to_device(frames)


def _shrunk(photo: Photo, divisor: int) -> Photo:
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
        return Photo(area(photo.pixels), None, valid, scale @ photo.K)
    # Colours count as much as they are seen: what is transparent has none.
    weight = photo.alpha.astype(np.float32)[..., None]
    alpha = area(weight)
    colors = area(photo.pixels * weight) / np.where(alpha > 0, alpha, 1)[..., None]
    pixels = np.clip(np.rint(colors), 0, 255).astype(np.uint8)
    return Photo(pixels, np.rint(alpha).astype(np.uint8), valid, scale @ photo.K)


def views_of_step(seed: int, step: int, batch: int, views: int) -> np.ndarray:
    """Which views [B] a step looks at: each once an epoch, in an order of its own.

    Depends on nothing but its arguments, so that a run that is resumed sees what it
    would have seen. On the host: a permutation takes XLA half a second to compile.
    """

    def one(number: int) -> int:
        epoch, place = divmod(number, views)
        return np.random.default_rng((seed, epoch)).permutation(views)[place]

    first = int(step) * batch  # `TrainState.step` is an array
    return np.asarray([one(first + i) for i in range(batch)], np.int32)


def draw(frames: Frames, view: Array) -> Batch:
    """The views [B] of one step."""
    drawn = jax.tree.map(lambda a: a[view], frames)
    return Batch(drawn.pixels, drawn.valid, drawn.camera, view, drawn.size)
