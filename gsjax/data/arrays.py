"""Datasets from images, cameras and points in memory."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from gsjax.cameras.camera import Camera
from gsjax.cameras.lenses import PINHOLE
from gsjax.data.dataset import finish_dataset
from gsjax.data.types import Dataset, Photo, View
from gsjax.errors import InputError


def make_dataset(
    images: Sequence[ArrayLike] | np.ndarray,
    cameras: Camera | Sequence[Camera],
    points: ArrayLike | None = None,
    colors: ArrayLike | None = None,
    *,
    names: Sequence[str] | None = None,
    valid: Sequence[ArrayLike] | np.ndarray | None = None,
) -> tuple[Dataset, list[Photo]]:
    """Return a dataset and its photos from arrays, the first two arguments of `fit`.

    ``gsjax.fit(*gsjax.make_dataset(images, cameras, points), config)`` trains on them.
    As in `load_dataset`, near planes are chosen by the extent of the cameras, and
    coordinates far from 0 are translated (`Dataset.origin`).

    Args:
      images: V images [H, W, 3] or [H, W, 4] (RGB or straight RGBA), uint8 or floats in
        [0, 1], without distortion. Their sizes may differ.
      cameras: a batch of V pinhole cameras, or a sequence of single ones, of the size
        of the images.
      points: [M, 3] known points of the scene, in world units; None for no points.
      colors: [M, 3] colours of the points, uint8 or floats in [0, 1]; default grey.
      names: V unique names of the views, by which both results are sorted; the default
        keeps the order.
      valid: V masks [H, W] bool, False where a pixel is excluded.

    Returns:
      The dataset, and one photo per view.

    Raises:
      InputError: if a shape, type or number does not match.
    """
    images = list(images)
    singles = _single_cameras(cameras)
    names = [f"{i:06d}" for i in range(len(images))] if names is None else list(names)
    masks = [None] * len(images) if valid is None else list(valid)
    counts = {"cameras": len(singles), "names": len(names), "valid": len(masks)}
    for what, count in counts.items():
        if count != len(images):
            raise InputError(
                f"{what}: expected {len(images)}, one per image, got {count}; pass as "
                "many"
            )
    views, photos = [], {}
    for name, image, camera, mask in zip(names, images, singles, masks):
        photo = _photo(name, np.asarray(image), camera, mask)
        pose = np.asarray(camera.viewmat, np.float64)
        size = camera.width, camera.height
        views.append(View(name, Path(name), pose, photo.K, *size))
        photos[name] = photo
    xyz, rgb = _points(points, colors)
    dataset = Dataset(Path("arrays"), "arrays", tuple(views), xyz, rgb)
    dataset = finish_dataset(dataset)
    return dataset, [photos[view.name] for view in dataset.views]


def _single_cameras(cameras: Camera | Sequence[Camera]) -> list[Camera]:
    if not isinstance(cameras, Camera):
        singles = list(cameras)
    elif cameras.batched:
        K = np.broadcast_to(cameras.K, (len(cameras.viewmat), 3, 3))
        pairs = zip(cameras.viewmat, K)
        singles = [cameras.replace(viewmat=pose, K=k) for pose, k in pairs]
    else:
        singles = [cameras]
    for index, camera in enumerate(singles):
        if not isinstance(camera, Camera) or camera.batched:
            raise InputError(
                f"cameras[{index}]: expected a single Camera, got {camera!r}; use "
                "make_camera"
            )
        if camera.lens is not PINHOLE:
            raise InputError(
                f"cameras[{index}]: expected a pinhole, got {camera.lens.name}; "
                "undistort the images first"
            )
    return singles


def _photo(name: str, image: np.ndarray, camera: Camera, mask) -> Photo:
    height, width = camera.height, camera.width
    if image.shape not in ((height, width, 3), (height, width, 4)):
        raise InputError(
            f"image {name!r}: expected shape [{height}, {width}, 3 or 4] as its camera "
            f"has, got {image.shape}; resize the image or the camera"
        )
    pixels = _to_uint8(f"image {name!r}", image)
    alpha = pixels[..., 3] if pixels.shape[2] == 4 else None
    K = np.asarray(camera.K, np.float64)
    photo = Photo(
        pixels=np.ascontiguousarray(pixels[..., :3]),
        alpha=None if alpha is None or (alpha == 255).all() else alpha.copy(),
        valid=None if mask is None else np.asarray(mask),
        K=K,
    )
    photo.require(f"image {name!r}")
    return photo


def _points(
    points: ArrayLike | None, colors: ArrayLike | None
) -> tuple[np.ndarray, np.ndarray]:
    xyz = np.zeros((0, 3)) if points is None else np.asarray(points)
    if xyz.ndim != 2 or xyz.shape[1] != 3 or xyz.dtype.kind not in "fiu":
        raise InputError(
            f"points: expected numbers of shape [M, 3], got {xyz.dtype} of shape "
            f"{xyz.shape}; pass one row per point"
        )
    grey = np.full(xyz.shape, 128, np.uint8)
    rgb = _to_uint8("colors", grey if colors is None else np.asarray(colors))
    if rgb.shape != xyz.shape:
        raise InputError(
            f"colors: expected shape {xyz.shape} as the points have, got {rgb.shape}; "
            "pass one row per point"
        )
    return xyz.astype(np.float64), rgb


def _to_uint8(what: str, values: np.ndarray) -> np.ndarray:
    """Return uint8 colours as they are, and floats in [0, 1] rounded."""
    if values.dtype == np.uint8:
        return values
    if values.dtype.kind != "f":
        raise InputError(
            f"{what}: expected uint8 or floats in [0, 1], got {values.dtype}; cast it"
        )
    if not ((values >= 0) & (values <= 1)).all():
        low, high = float(np.min(values)), float(np.max(values))
        raise InputError(
            f"{what}: expected floats in [0, 1], got {low:g} to {high:g}; divide by "
            "the largest value, or pass uint8"
        )
    return np.rint(np.asarray(values, np.float64) * 255).astype(np.uint8)
