"""Cameras: world → camera matrix, intrinsics, near and far; one function per lens.

OpenCV axes: x right, y down, z forward; pixel centres at + 0.5. A batch of cameras
has a leading axis on every array. A lens is a `Lens`: how a point in camera
coordinates falls onto the image, and where that may be linearised. The EWA Jacobian
is the derivative of that function, so a new lens touches nothing else.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike

from gsjax.errors import InputError
from gsjax.math.numerics import real_floats, to_device
from gsjax.runtime.settings import whole

# What is nearer to the camera is not drawn, where nothing else is said; world units.
NEAR = 0.01
# Nor is what is nearer than that, whatever is said: 1 / z³, of which derivatives are
# made, is to stay within float32.
NEAREST = 1e-12
# COLMAP scales a reconstruction so that the box around the middle eight tenths of the
# cameras has a diagonal of 10 units. Published constants in world units assume that.
USUAL_EXTENT = 5.0
# px, of focal lengths; the principal point lies within. Nothing is drawn beyond.
LENS_RANGE = (1e-15, 1e15)
# Rounding of K, per focal length: 1e-3 px, the bar of the projection, at 1000 px.
_K_ROUNDING = 1e-6
Array = jax.Array
Point = tuple[Array, Array, Array]
Length = int | Array  # px


class Lens(NamedTuple):
    """A lens, as functions over components of any one shape.

    Attributes:
      name: what files and messages call it.
      project: (K, (x, y, z)) → (u, v) in pixels; K is [3, 3].
      linearise: (K, width, height, (x, y, z)) → the point at which the
        EWA Jacobian is taken, kept away from where the linearisation is wild. Width
        and height are arrays [] where `gsjax.render` is given a ``size``.
    """

    name: str
    project: Callable[[Array, Point], tuple[Array, Array]]
    linearise: Callable[[Array, Length, Length, Point], Point]


def _pinhole_project(K: Array, point: Point) -> tuple[Array, Array]:
    x, y, z = point
    return K[0, 0] * (x / z) + K[0, 2], K[1, 1] * (y / z) + K[1, 2]


def _pinhole_linearise(K: Array, width: Length, height: Length, point: Point) -> Point:
    # Limits of gsplat: 30 % of half the field of view beyond each *side* of the
    # image, so that a principal point off the centre is treated evenly.
    x, y, z = point

    def limit(ratio, focal, centre, size):
        margin = 0.3 * 0.5 * size / focal
        low = -(centre / focal + margin)
        high = (size - centre) / focal + margin
        # `where` rather than `clip`: a tie has the derivative of the inside.
        return jnp.where(ratio < low, low, jnp.where(ratio > high, high, ratio))

    return (
        z * limit(x / z, K[0, 0], K[0, 2], width),
        z * limit(y / z, K[1, 1], K[1, 2], height),
        z,
    )


def _orthographic_project(K: Array, point: Point) -> tuple[Array, Array]:
    x, y, _ = point
    return K[0, 0] * x + K[0, 2], K[1, 1] * y + K[1, 2]


def _linear_everywhere(K: Array, width: Length, height: Length, point: Point) -> Point:
    del K, width, height
    return point


PINHOLE = Lens("pinhole", _pinhole_project, _pinhole_linearise)
ORTHOGRAPHIC = Lens("orthographic", _orthographic_project, _linear_everywhere)
LENSES = {model.name: model for model in (PINHOLE, ORTHOGRAPHIC)}


# Not a chex dataclass: those have no static fields, and sizes must be static.
@partial(
    jax.tree_util.register_dataclass,
    data_fields=("viewmat", "K", "near", "far"),
    meta_fields=("width", "height", "model"),
)
@dataclass(frozen=True)
class Camera:
    """One camera, or a batch with a leading axis B on every array.

    Attributes:
      viewmat: [4, 4] or [B, 4, 4], world → camera.
      K: [3, 3] or [B, 3, 3] intrinsics in pixels; there is no skew.
      near, far: [] or [B], range of camera z that is drawn, in world units.
      width, height: image size in pixels, static.
      model: the lens, static.
    """

    viewmat: Array
    K: Array
    near: Array
    far: Array
    width: int
    height: int
    model: Lens = PINHOLE

    @property
    def batched(self) -> bool:
        """Whether the arrays have a leading camera axis."""
        return self.viewmat.ndim == 3

    @property
    def shown(self) -> tuple[Length, Length]:
        """Width and height, px, of what is looked at of the image."""
        return self.width, self.height


def make_camera(
    *,
    viewmat,
    K,
    width: int,
    height: int,
    near: ArrayLike = NEAR,
    far: ArrayLike = 1e10,
    model: str | Lens = PINHOLE,
) -> Camera:
    """A camera (or batch) from arrays; traceable in ``viewmat``, ``K``, near and far.

    Args:
      viewmat: [4, 4] or [B, 4, 4] world → camera, OpenCV axes (see
        `gsjax.data.transforms` for files in OpenGL axes).
      K: [3, 3] (shared) or [B, 3, 3] intrinsics in pixels, fx 0 cx, 0 fy cy, 0 0 1.
      width, height: image size in pixels, at least 1.
      near, far: range of z that is drawn, scalars or [B]; near > 0. Nearer than 1e-12
        nothing is drawn.
      model: "pinhole", "orthographic", or a `Lens`.

    Raises:
      InputError: on wrong shapes or sizes, no camera, an unknown model, values not
        finite, a focal length of zero or below, skew, a rotation part that scales or
        shears by more than a hundredth or that mirrors, or a last row other than
        0 0 0 1, of K 0 0 1. Of tracers only shapes are known.
    """
    if isinstance(model, str):
        if model not in LENSES:
            raise InputError(f"unknown camera model {model!r}; known: {sorted(LENSES)}")
        model = LENSES[model]
    if not isinstance(model, Lens):
        raise InputError(f"model is {model!r}; a name or a Lens is wanted")
    width, height = _whole_size(width, height)
    named = {"viewmat": viewmat, "K": K, "near": near, "far": far}
    viewmat, K, near, far = (real_floats(name, v) for name, v in named.items())
    if viewmat.ndim not in (2, 3) or viewmat.shape[-2:] != (4, 4):
        raise InputError(f"viewmat has shape {viewmat.shape}; [4, 4] or [B, 4, 4]")
    if not viewmat.size:
        raise InputError(
            f"viewmat has shape {viewmat.shape}: at least one camera is wanted"
        )
    batch = viewmat.shape[:-2]
    if K.shape[-2:] != (3, 3) or K.shape[:-2] not in ((), batch):
        raise InputError(f"K has shape {K.shape}; [3, 3] or {(*batch, 3, 3)} is wanted")
    for name, value in (("near", near), ("far", far)):
        if value.shape not in ((), batch):
            raise InputError(f"{name} has shape {value.shape}; () or {batch} is wanted")
    _check_values(viewmat, K, near, far)
    camera = Camera(
        viewmat=viewmat,  # pyright: ignore
        K=_spread(K, (*batch, 3, 3)),  # pyright: ignore
        near=_spread(near, batch),  # pyright: ignore
        far=_spread(far, batch),  # pyright: ignore
        width=width,
        height=height,
        model=model,
    )
    return to_device(camera)


def _spread(value: Array | np.ndarray, shape: tuple[int, ...]):
    library = np if isinstance(value, np.ndarray) else jnp
    return library.broadcast_to(value, shape)


def _whole_size(width, height) -> tuple[int, int]:
    told = f"image size {width} × {height}: width and height must be whole and ≥ 1"
    try:
        size = whole("width", width), whole("height", height)
    except InputError as error:
        raise InputError(told) from error
    if min(size) < 1:
        raise InputError(told)
    return size


def _check_values(viewmat, K, near, far) -> None:
    """Host-side checks; tracers pass (their values are not known yet)."""
    values = {"viewmat": viewmat, "K": K, "near": near, "far": far}
    if any(isinstance(v, Tracer) for v in values.values()):
        return
    host = {name: np.asarray(value) for name, value in values.items()}
    for name in ("viewmat", "K", "near"):
        if not np.isfinite(host[name]).all():
            raise InputError(f"{name} has a value that is not finite: {host[name]}")
    _check_intrinsics(host["K"])
    if not ((host["near"] > 0) & (host["far"] > host["near"])).all():
        raise InputError(
            f"near {host['near']} and far {host['far']}: 0 < near < far is wanted"
        )
    if not (host["viewmat"][..., 3, :] == (0, 0, 0, 1)).all():
        raise InputError(
            "the last row of viewmat must be 0 0 0 1 (is it transposed?): "
            f"{host['viewmat'][..., 3, :]}"
        )
    rotation = host["viewmat"][..., :3, :3].astype(np.float64)
    gram = rotation @ np.swapaxes(rotation, -1, -2)
    if np.abs(gram - np.eye(3)).max() > 0.02:
        lengths = np.sqrt(np.diagonal(gram, axis1=-2, axis2=-1))
        raise InputError(
            "the rotation part of viewmat is no rotation: its rows have lengths "
            f"{lengths}; divide out a scale (from the translation too), or scale the "
            "scene instead"
        )
    if (np.linalg.det(rotation) < 0).any():
        raise InputError(
            "the rotation part of viewmat mirrors (determinant -1); a rotation is "
            "wanted: flip one axis"
        )


def _check_intrinsics(K: np.ndarray) -> None:
    """Of [3, 3] or [B, 3, 3] finite numbers."""
    if not (K[..., (0, 1), (0, 1)] > 0).all():
        raise InputError("K[0, 0] and K[1, 1], the focal lengths, must be above 0")
    if not (np.abs(K[..., 2, :] - (0, 0, 1)) <= _K_ROUNDING).all():
        raise InputError(
            f"the last row of K must be 0 0 1: {K[..., 2, :]}; transpose a K that has "
            "the principal point there, divide one with another number than 1 by it"
        )
    focal, centre = K[..., (0, 1), (0, 1)], K[..., :2, 2]
    skew = np.abs(K[..., (0, 1), (1, 0)])
    if not (skew <= _K_ROUNDING * focal.max(-1, keepdims=True)).all():
        raise InputError(
            f"K[0, 1] and K[1, 0] are {K[..., (0, 1), (1, 0)]}: skew is not rendered; "
            "0 is wanted: undistort the photographs to square axes, or leave it out "
            "where it is small"
        )
    low, high = LENS_RANGE
    if not ((focal > low) & (focal < high) & (np.abs(centre) < high)).all():
        raise InputError(
            f"K has a focal length of {focal.ravel()} px and a principal point at "
            f"{centre.ravel()} px: within {low:g} and {high:g} is wanted, or nothing "
            "could be drawn"
        )


def camera_centre(viewmat: Array) -> Array:
    """World position [..., 3] of cameras [..., 4, 4] with a rigid rotation part."""
    rotation, translation = viewmat[..., :3, :3], viewmat[..., :3, 3]
    return -jnp.sum(rotation * translation[..., :, None], axis=-2)


def resize_camera(camera: Camera, width: int, height: int) -> Camera:
    """The same view at another resolution: intrinsics scale with the pixels.

    Args:
      camera: one, or a batch.
      width, height: new image size in px; another aspect ratio stretches the image.

    Raises:
      InputError: if the size is not whole, or below 1.
    """
    width, height = _whole_size(width, height)
    sx, sy = width / camera.width, height / camera.height
    scale = jnp.asarray([[sx, 1, sx], [1, sy, sy], [1, 1, 1]], camera.K.dtype)
    return replace(camera, K=camera.K * scale, width=width, height=height)


def stack_cameras(cameras: list[Camera]) -> Camera:
    """A batch from single cameras of one size and model.

    Args:
      cameras: B of them, arrays [4, 4], [3, 3], [] each; [B, …] in the batch.

    Raises:
      InputError: if there are none, or their sizes or models differ.
    """
    kinds = {(c.width, c.height, c.model) for c in cameras}
    if len(kinds) != 1:
        raise InputError(
            f"a batch needs one image size and model; found {len(kinds)} of them: "
            f"{sorted((w, h, m.name) for w, h, m in kinds)}"
        )
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)


def look_at(eye, target, up=(0.0, 0.0, 1.0)) -> np.ndarray:
    """World → camera [4, 4] (float64, on the host) of a camera at ``eye``.

    Args:
      eye, target: [3] world positions; they must differ.
      up: [3] world direction that points to the top of the image, of any length; where
        it is along the view, any other is taken.

    Raises:
      InputError: if ``eye`` is ``target``, ``up`` is zero, or a value is not finite.
    """
    eye, target, up = (np.asarray(v, np.float64) for v in (eye, target, up))
    forward = target - eye
    for name, value in (("target − eye", forward), ("up", up)):
        if not 0 < np.linalg.norm(value) < np.inf:
            raise InputError(f"look_at: {name} is {value}: it gives no direction")
    forward, up = forward / np.linalg.norm(forward), up / np.linalg.norm(up)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-9:
        right = np.cross(forward, np.roll(up, 1) + (0.1, 0.2, 0.3))
    right = right / np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ eye
    return viewmat
