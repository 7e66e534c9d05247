"""Datasets from images, cameras and points in memory."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from gsjax.cameras.camera import Camera
from gsjax.cameras.distortion import distortion_of
from gsjax.cameras.lenses import LENSES, ORTHOGRAPHIC
from gsjax.data.dataset import finish_dataset
from gsjax.data.types import Dataset, Photo, View, unexpected
from gsjax.runtime.settings import as_float


def make_dataset(
    images: Sequence[ArrayLike] | np.ndarray,
    cameras: Camera | Sequence[Camera],
    points: ArrayLike | None = None,
    colors: ArrayLike | None = None,
    *,
    names: Sequence[str] | None = None,
    valid: Sequence[ArrayLike] | np.ndarray | None = None,
    times: Sequence[float] | np.ndarray | None = None,
) -> tuple[Dataset, list[Photo]]:
    """Return a dataset and its photos from arrays, the first two arguments of `fit`.

    ``gsjax.fit(*gsjax.make_dataset(images, cameras, points), config)`` trains on them.
    As in `load_dataset`, near planes are chosen by the extent of the cameras, and
    coordinates far from 0 are translated (`Dataset.origin`).

    Args:
      images: V images [H, W, 3] or [H, W, 4] (RGB or straight RGBA), uint8 or floats in
        [0, 1]. Their sizes may differ.
      cameras: a batch of V cameras, or a sequence of single ones, of the size of the
        images. Lenses are those of `gsjax.cameras.lenses.LENSES` but orthographic.
      points: [M, 3] known points of the scene, in world units; None for no points.
      colors: [M, 3] colours of the points, uint8 or floats in [0, 1]; default grey.
      names: V unique names of the views, by which both results are sorted; the default
        keeps the order.
      valid: V masks [H, W] bool, False where a pixel is excluded.
      times: V times of exposure, for scenes that move (`TrainConfig.motion`).

    Returns:
      The dataset, and one photo per view.

    Raises:
      InputError: if a shape, type or number does not match.
    """
    images = list(images)
    singles = _single_cameras(cameras)
    names = [f"{i:06d}" for i in range(len(images))] if names is None else list(names)
    masks = [None] * len(images) if valid is None else list(valid)
    clock = [None] * len(images) if times is None else list(times)
    each = {"cameras": singles, "names": names, "valid": masks, "times": clock}
    for what, given in each.items():
        if len(given) != len(images):
            expected = f"{len(images)}, one per image"
            raise unexpected(what, expected, len(given), "pass as many")
    views, photos = [], {}
    for name, image, camera, mask, time in zip(names, images, singles, masks, clock):
        photo = photos[name] = _photo(name, np.asarray(image), camera, mask)
        pose = np.asarray(camera.viewmat, np.float64)
        size = camera.width, camera.height
        view = View(name, Path(name), pose, photo.K, *size, photo.lens)
        moment = None if time is None else as_float(f"time of {name!r}", time)
        views.append(replace(view, time=moment))
    xyz, rgb = _points(points, colors)
    dataset = finish_dataset(Dataset(Path("arrays"), "arrays", tuple(views), xyz, rgb))
    return dataset, [photos[view.name] for view in dataset.views]


def _single_cameras(cameras: Camera | Sequence[Camera]) -> list[Camera]:
    if isinstance(cameras, Camera):
        poses = np.reshape(cameras.viewmat, (-1, 4, 4))
        K = np.broadcast_to(cameras.K, (len(poses), 3, 3))
        c = cameras.coefficients
        if c is not None:
            c = np.broadcast_to(c, (len(poses), np.shape(c)[-1]))
        cameras = [
            cameras.replace(viewmat=p, K=k, coefficients=None if c is None else c[i])
            for i, (p, k) in enumerate(zip(poses, K))
        ]
    for index, camera in enumerate(cameras):
        where = f"cameras[{index}]"
        if not isinstance(camera, Camera) or camera.batched:
            raise unexpected(where, "a single Camera", repr(camera), "use make_camera")
        if camera.lens not in LENSES.values() or camera.lens is ORTHOGRAPHIC:
            remedy = "undistort the images first"
            raise unexpected(
                where, f"one of {sorted(LENSES)}", camera.lens.name, remedy
            )
    return list(cameras)


def _photo(name: str, image: np.ndarray, camera: Camera, mask) -> Photo:
    where, size = f"image {name!r}", (camera.height, camera.width)
    if image.ndim != 3 or image.shape[:2] != size or image.shape[2] not in (3, 4):
        shape = f"shape [{size[0]}, {size[1]}, 3 or 4] as its camera has"
        raise unexpected(where, shape, image.shape, "resize the image or the camera")
    pixels = _to_uint8(where, image)
    opaque = pixels.shape[2] == 3 or (pixels[..., 3] == 255).all()
    alpha = None if opaque else pixels[..., 3].copy()
    valid, K = None if mask is None else np.asarray(mask), np.asarray(camera.K, float)
    lens, rgb = distortion_of(camera), np.ascontiguousarray(pixels[..., :3])
    photo = Photo(rgb, alpha, valid, K, lens)
    photo.require(where)
    return photo


def _points(
    points: ArrayLike | None, colors: ArrayLike | None
) -> tuple[np.ndarray, np.ndarray]:
    xyz = np.zeros((0, 3)) if points is None else np.asarray(points)
    remedy = "pass one row per point"
    if xyz.ndim != 2 or xyz.shape[1] != 3 or xyz.dtype.kind not in "fiu":
        got = f"{xyz.dtype} of shape {xyz.shape}"
        raise unexpected("points", "numbers of shape [M, 3]", got, remedy)
    grey = np.full(xyz.shape, 128, np.uint8)
    rgb = _to_uint8("colors", grey if colors is None else np.asarray(colors))
    if rgb.shape != xyz.shape:
        raise unexpected("colors", f"shape {xyz.shape}", rgb.shape, remedy)
    return xyz.astype(np.float64), rgb


def _to_uint8(where: str, values: np.ndarray) -> np.ndarray:
    """Return uint8 colours as they are, and floats in [0, 1] rounded."""
    if values.dtype == np.uint8:
        return values
    expected = "uint8 or floats in [0, 1]"
    if values.dtype.kind != "f":
        raise unexpected(where, expected, values.dtype, "convert it")
    low, high = np.min(values, initial=0), np.max(values, initial=1)
    if not (low >= 0 and high <= 1):  # also if NaN
        raise unexpected(where, expected, f"{low:g} to {high:g}", "scale it")
    return np.rint(np.asarray(values, np.float64) * 255).astype(np.uint8)
