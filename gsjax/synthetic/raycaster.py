"""Photographs of a still life by ray casting: a dataset that needs no download.

Intersections are in closed form (a torus is sphere traced). Light is a sun with a soft
shadow and a sky; all surfaces are diffuse. Right-handed, z up, floor at z = 0.

Axis legend: R rays or points ([3, R] arrays), H W image, M points, F cameras.
"""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsjax.cameras.camera import look_at, make_camera
from gsjax.data.transforms import CameraEntry, transforms_json
from gsjax.errors import InputError
from gsjax.io import images
from gsjax.runtime.files import make_folder, reject_existing, write_file
from gsjax.synthetic.optics import PINHOLE, Optics, exposures, local_rays
from gsjax.synthetic.shapes import Solid, dot
from gsjax.synthetic.still_life import solids

BACKGROUND = (0.0, 0.0, 0.0)
TARGET = np.asarray([0.0, 0.0, 0.10])

_SUN = np.asarray([0.52, -0.40, 0.76]) / np.linalg.norm([0.52, -0.40, 0.76])
_PENUMBRA = 0.12  # tangent of the apparent diameter of the sun
_SHADOW_STEPS, _LEAST_STEP, _MOST_STEP = 24, 0.025, 0.5
_CHUNK = 1 << 16  # rays at a time, to stay in the CPU cache


class DemoDatasetSettings(NamedTuple):
    """Settings of `write_demo_dataset`.

    Attributes:
      photos: number of photographs.
      width, height: image size, px.
      samples: a pixel is the mean of samples × samples rays.
      points: number of points in the point cloud.
      seed: seed of the points.
      background: RGB in [0, 1] of pixels without a surface.
    """

    photos: int = 40
    width: int = 320
    height: int = 240
    samples: int = 2
    points: int = 4000
    seed: int = 0
    background: tuple[float, float, float] = BACKGROUND


def cast(
    viewmat,
    K,
    width: int,
    height: int,
    samples: int = 3,
    *,
    background=BACKGROUND,
    optics: Optics = PINHOLE,
    scene: Sequence[Solid] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return a photograph of the still life and its depth.

    Args:
      viewmat: [4, 4] world → camera; above the floor and outside the solids.
      K: [3, 3] intrinsics in px, with pixel centres at + 0.5.
      width, height: image size, px.
      samples: a pixel is the mean of samples × samples rays on a regular grid.
      background: RGB in [0, 1] of pixels without a surface.
      optics: lens and shutter.
      scene: solids, the floor first; default `solids`, the still life.

    Returns:
      rgb [H, W, 3] float32 in [0, 1], and depth [H, W] float64: camera z at the
      centre of each pixel, at its time of exposure; 0 for background.

    Raises:
      InputError: if ``samples`` is below 1, or the optics are not valid.
    """
    size, scene = (width, height), scene or solids()
    rgb = _image(viewmat, K, size, samples, background, optics, scene)
    u, v = (a.ravel() + 0.5 for a in np.meshgrid(np.arange(width), np.arange(height)))
    depth, _, _ = _hits(scene, viewmat, K, size, (u, v), optics)
    return rgb, np.where(np.isfinite(depth), depth, 0).reshape(height, width)


def surface_points(
    count: int, seed: int = 0, scene: Sequence[Solid] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return noisy surface points that the cameras see, as from structure from motion.

    Args:
      count: M.
      seed: of the random numbers.
      scene: as in `cast`.

    Returns:
      points [M, 3] float64 with noise of σ = 0.004 in each coordinate, and their
      shaded colours [M, 3] uint8.
    """
    rng, scene = np.random.default_rng(seed), scene or solids()
    viewmats, K = demo_cameras(24, 1, 1)
    points, colors = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    while len(points) < count:
        share = -(-count // len(viewmats))
        for viewmat in viewmats:
            pixels = rng.uniform(size=(2, share))
            t, which, places = _hits(scene, viewmat, K, (1, 1), pixels)
            hit = np.isfinite(t)
            points = np.concatenate([points, places[:, hit].T])
            shaded = images.to_8_bit(_shade(scene, places[:, hit], which[hit]).T)
            colors = np.concatenate([colors, shaded])
    chosen = rng.permutation(len(points))[:count]
    points = points[chosen] + rng.normal(0, 0.004, (count, 3))
    return points, colors[chosen]


def demo_cameras(
    count: int, width: int, height: int
) -> tuple[list[np.ndarray], np.ndarray]:
    """Return cameras on two rings about the still life, the lower ring first.

    Args:
      count: number of cameras; the lower ring has half of them, rounded up.
      width, height: image size, px.

    Returns:
      viewmats [4, 4] (world → camera), and their common K [3, 3].
    """
    focal = 0.5 * min(width, height) / np.tan(np.radians(41) / 2)
    K = np.asarray([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    lower = -(-count // 2)
    viewmats = []
    for index in range(count):
        ring, size = (0, lower) if index < lower else (1, count - lower)
        turn = 2 * np.pi * ((index - ring * lower + 0.5 * ring) / size) - 0.9
        elevation, radius = np.radians((23.0, 46.0)[ring]), (5.2, 5.8)[ring]
        flat = np.cos(elevation)
        direction = flat * np.cos(turn), flat * np.sin(turn), np.sin(elevation)
        viewmats.append(look_at(TARGET + radius * np.asarray(direction), TARGET))
    return viewmats, K


def write_demo_dataset(
    folder: str | PathLike[str],
    settings: DemoDatasetSettings | None = None,
    *,
    overwrite: bool = False,
) -> None:
    """Write `images/photo_000.png` …, `transforms.json` and `points.ply`.

    Raises:
      InputError: if a file exists and ``overwrite`` is not set, or cannot be written.
      MissingExtraError: if OpenCV is absent.
    """
    folder, settings = Path(folder), settings or DemoDatasetSettings()
    size = settings.width, settings.height
    viewmats, K = demo_cameras(settings.photos, *size)
    names = [f"images/photo_{index:03d}" for index in range(len(viewmats))]
    photos = [folder / f"{name}.png" for name in names]
    cameras, points = folder / "transforms.json", folder / "points.ply"
    reject_existing([*photos, cameras, points], overwrite)
    images.opencv()
    make_folder(folder / "images")
    entries = []
    for name, photo, viewmat in zip(names, photos, viewmats):
        samples, background = settings.samples, settings.background
        rgb = _image(viewmat, K, size, samples, background, PINHOLE, solids())
        write_file(photo, images.encode_png(images.to_8_bit(rgb)))
        camera = make_camera(viewmat=viewmat, K=K, width=size[0], height=size[1])
        entries.append(CameraEntry(name, camera))
    cloud = surface_points(settings.points, settings.seed)
    write_file(points, points_ply(*cloud))
    text = transforms_json(entries, ply_file_path=points.name)
    write_file(cameras, text.encode())


def _image(
    viewmat,
    K,
    size: tuple[int, int],
    samples: int,
    background,
    optics: Optics,
    scene: Sequence[Solid],
) -> np.ndarray:
    """Return an image [H, W, 3] float32, the mean over samples² rays a pixel."""
    if samples < 1:
        raise InputError(f"samples: expected at least 1 ray a pixel, got {samples}")
    width, height = size
    u = (np.arange(width * samples) + 0.5) / samples
    rows = max(1, _CHUNK // (width * samples * samples))
    image = np.empty((height, width, 3), np.float32)
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        v = (np.arange(top * samples, bottom * samples) + 0.5) / samples
        grid = [a.ravel() for a in np.meshgrid(u, v)]
        # float32 takes half the time and is exact to 1e-6 of the scene.
        t, which, places = _hits(scene, viewmat, K, size, grid, optics, np.float32)
        rgb = np.tile(np.asarray(background, np.float32)[:, None], len(t))
        hit = np.flatnonzero(np.isfinite(t))
        rgb[:, hit] = _shade(scene, places.take(hit, axis=1), which[hit])
        rgb = rgb.reshape(3, bottom - top, samples, width, samples).mean(axis=(2, 4))
        image[top:bottom] = np.moveaxis(rgb, 0, -1)
    return image


def _hits(
    scene: Sequence[Solid],
    viewmat,
    K,
    size: tuple[int, int],
    pixels,
    optics: Optics = PINHOLE,
    dtype: type = np.float64,
):
    """Return depth [R], solid [R] and place [3, R] of what pixels (u, v) show.

    The depth is camera z, and infinite, with an arbitrary place, for background.
    """
    local = local_rays(optics, K, *pixels)
    t, which = np.empty(local.shape[1], dtype), np.empty(local.shape[1], int)
    places = np.empty(local.shape, dtype)
    for pose, rays in exposures(optics, viewmat, size, *pixels):
        rotation = pose[:3, :3]
        origin = (-rotation.T @ pose[:3, 3]).astype(dtype)
        directions = (rotation.T @ local[:, rays]).astype(dtype)
        t[rays], which[rays] = found = _first_hits(scene, origin, directions)
        finite = np.where(np.isfinite(found[0]), found[0], 0)
        places[:, rays] = origin[:, None] + finite * directions
    return t, which, places


def _first_hits(scene: Sequence[Solid], origin: np.ndarray, directions: np.ndarray):
    """Return (t [R], index [R]) of the first solid on each ray; t is inf if none."""
    first = np.full(directions.shape[1], np.inf, directions.dtype)
    which = np.zeros(directions.shape[1], int)
    square = dot(directions, directions)
    for index, solid in enumerate(scene):
        centre, axes = (a.astype(origin.dtype) for a in (solid.centre, solid.axes))
        offset, reach = origin - centre, solid.shape.reach
        beyond = offset @ offset - reach * reach
        middle = offset @ directions
        rays = np.flatnonzero((middle * middle >= square * beyond) & (middle < 0))
        t = solid.shape.hit(axes.T @ offset, axes.T @ directions.take(rays, axis=1))
        nearer = t < first[rays]
        first[rays[nearer]], which[rays[nearer]] = t[nearer], index
    return first, which


def _shade(scene: Sequence[Solid], points: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Return colours [3, R] in [0, 1] of points on the solids ``which`` [R]."""
    base, normals = np.empty_like(points), np.empty_like(points)
    for index, solid in enumerate(scene):
        mine = np.flatnonzero(which == index)
        local = solid.local(points.take(mine, axis=1))
        base[:, mine] = solid.albedo(local)
        normals[:, mine] = solid.axes.astype(local.dtype) @ solid.shape.normal(local)
    facing = np.maximum(_SUN.astype(normals.dtype) @ normals, 0)
    sun, sky = facing, 0.66 + 0.34 * normals[2]
    for index, solid in enumerate(scene[1:], start=1):
        other = which != index
        asked = (facing > 0) & (other if solid.shape.convex else True)
        sun = sun * _sun_visibility(solid, points, normals, asked)
        sky = sky * _sky_visibility(solid, points, normals, other)
    # The floor hides the sky from what stands on it.
    sky *= np.where(which > 0, 0.55 + 0.45 * np.minimum(2 * points[2], 1), 1)
    warm, cool = np.asarray([(0.82, 0.79, 0.72), (0.50, 0.54, 0.59)], sun.dtype)
    light = np.outer(warm, sun) + np.outer(cool, sky)
    return np.minimum(base * light, 1)


def _sun_visibility(solid: Solid, points, normals, asked: np.ndarray) -> np.ndarray:
    """Return [R] in [0, 1]: share of the sun that ``solid`` leaves visible.

    It follows from the smallest angle by which a ray to the sun clears the solid: the
    ray is marched, and the closest approach between two steps estimated (S. Aaltonen,
    GDC 2018). Points outside of ``asked`` [R] get 1.
    """
    lit = np.ones_like(points[0])
    offset = points - solid.centre.astype(points.dtype)[:, None]
    ahead = -(_SUN.astype(points.dtype) @ offset)  # to the point nearest the centre
    reach = solid.shape.reach
    wide = reach + _PENUMBRA * np.maximum(ahead + reach, 0)
    aside = dot(offset, offset) - ahead * ahead
    rays = np.flatnonzero(asked & (ahead > -reach) & (aside < wide * wide))
    sun = (solid.axes.T @ _SUN).astype(points.dtype)[:, None]
    start = solid.local((points + 1e-3 * normals).take(rays, axis=1))
    end = ahead[rays] + reach
    t = np.maximum(ahead[rays] - 1.5 * reach, 0.02)
    least, step = np.ones_like(t), np.zeros_like(t)
    for _ in range(_SHADOW_STEPS):
        gap = solid.shape.distance(start + t * sun)
        # If the last step was as long as the gap there, two balls are free, and the
        # nearest point of the ray is where they meet, ``back`` from here.
        back = np.minimum(gap * gap / (2 * np.maximum(step, 1e-9)), gap)
        back = back * ((back < step) & (step > _LEAST_STEP) & (step < _MOST_STEP))
        closest = np.sqrt(gap * gap - back * back) * (gap > 0)
        least = np.minimum(least, closest / (_PENUMBRA * (t - back)))
        lit[rays] = least * least * (3 - 2 * least)
        step = np.minimum(np.maximum(gap, _LEAST_STEP), _MOST_STEP)
        t = t + step
        going = np.flatnonzero((least > 1e-3) & (t < end))
        if len(going) < 0.7 * len(rays):  # otherwise copying costs more than it saves
            rays, start, end = rays[going], start.take(going, axis=1), end[going]
            step, t, least = step[going], t[going], least[going]
    return lit


def _sky_visibility(solid: Solid, points, normals, other: np.ndarray) -> np.ndarray:
    """Return [R] in [0, 1]: share of the sky left by ``solid``, from its distance."""
    height = 0.45
    above = points + height * normals
    offset = above - solid.centre.astype(points.dtype)[:, None]
    wide = solid.shape.reach + height
    near = np.flatnonzero(other & (dot(offset, offset) < wide * wide))
    gap = solid.shape.distance(solid.local(above.take(near, axis=1)))
    sky = np.ones_like(points[0])
    sky[near] = 1 - 0.6 * np.clip(1 - gap / height, 0, 1)
    return sky


def points_ply(points: np.ndarray, colors: np.ndarray) -> bytes:
    """Return a PLY point cloud as nerfstudio writes it: xyz, red, green, blue."""
    kinds = [(name, "<f4") for name in "xyz"]
    kinds += [(name, "u1") for name in ("red", "green", "blue")]
    rows = np.rec.fromarrays([*points.T, *colors.T], dtype=kinds)
    names = {"<f4": "float", "u1": "uchar"}
    properties = [f"property {names[kind]} {name}" for name, kind in kinds]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [*properties, "end_header", ""]
    return "\n".join(header).encode() + rows.tobytes()
