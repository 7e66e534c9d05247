"""Cameras as a pytree: world → camera pose, intrinsics, lens and depth range.

OpenCV axes: x right, y down, z forward; pixel centres at + 0.5. A batch of cameras
has a leading axis on every array.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike

from gsjax.cameras.lenses import PINHOLE, Length, Lens, find_lens
from gsjax.cameras.shutter import GLOBAL, Shutter, find_shutter, twist_between
from gsjax.errors import InputError
from gsjax.math.numerics import real_floats
from gsjax.runtime.devices import place
from gsjax.runtime.settings import as_int

# Default near plane, in world units.
NEAR = 0.01
# Smallest depth that is drawn: 1 / z³, which derivatives contain, must fit float32.
NEAREST = 1e-12
# COLMAP scales a reconstruction so that the box around the middle eight tenths of the
# cameras has a diagonal of 10 units. Published constants in world units assume that.
USUAL_EXTENT = 5.0
# Range of focal lengths in px, and of the principal point; nothing is drawn beyond.
LENS_RANGE = (1e-15, 1e15)
# Rounding of K allowed per focal length: 1e-3 px at 1000 px.
_K_ROUNDING = 1e-6
Array = jax.Array


# Not a chex dataclass: those have no static fields, and sizes must be static.
@partial(
    jax.tree_util.register_dataclass,
    data_fields=(
        "viewmat",
        "K",
        "near",
        "far",
        "coefficients",
        "visible_size",
        "twist",
    ),
    meta_fields=("width", "height", "lens", "shutter"),
)
@dataclass(frozen=True, repr=False)
class Camera:
    """One camera, or a batch with a leading axis B on every array.

    Attributes:
      viewmat: [4, 4] or [B, 4, 4], world → camera.
      K: [3, 3] or [B, 3, 3] intrinsics in px, without skew.
      near, far: [] or [B], range of the lens's depth that is drawn, in world units.
      width, height: image size in px, static.
      lens: the lens functions, static.
      coefficients: [M] or [B, M] coefficients of the lens, or None if it has none.
      visible_size: [2] or [B, 2], width and height in px of the upper left part of the
        image that is drawn; None for the whole image.
      shutter: when each place of the image is exposed, static.
      twist: [6] or [B, 6], rotation vector and translation of the view matrix over the
        exposure, see `gsjax.cameras.shutter`; None unless the shutter is rolling.
    """

    viewmat: Array
    K: Array
    near: Array
    far: Array
    width: int
    height: int
    lens: Lens = PINHOLE
    coefficients: Array | None = None
    visible_size: Array | None = None
    shutter: Shutter = GLOBAL
    twist: Array | None = None

    @property
    def batched(self) -> bool:
        """Return whether the arrays have a leading camera axis."""
        return self.viewmat.ndim == 3

    @property
    def visible(self) -> tuple[Length, Length]:
        """Width and height in px of the part of the image that is drawn."""
        if self.visible_size is None:
            return self.width, self.height
        return self.visible_size[0], self.visible_size[1]

    def replace(self, **changes) -> "Camera":
        """Return a copy with some fields changed."""
        return replace(self, **changes)

    def project(self, point) -> tuple[Any, Any]:
        """Return pixel coordinates (u, v) of a point in camera coordinates."""
        return self.lens.project(self.K, self.coefficients, point)

    def linearise(self, point):
        """Return the point at which the EWA Jacobian of ``point`` is evaluated."""
        return self.lens.linearise(self.K, self.coefficients, self.visible, point)

    def __repr__(self) -> str:
        shape = getattr(self.viewmat, "shape", ())
        count = f", batch of {shape[0]}" if len(shape) == 3 else ""
        return f"Camera({self.width} × {self.height} px, {self.lens.name}{count})"


def make_camera(
    *,
    viewmat,
    K,
    width: int,
    height: int,
    near: ArrayLike = NEAR,
    far: ArrayLike = 1e10,
    lens: str | Lens = PINHOLE,
    coefficients=None,
) -> Camera:
    """Return a camera, or a batch, from arrays.

    Traceable in all arrays.

    Args:
      viewmat: [4, 4] or [B, 4, 4] world → camera, OpenCV axes.
        `gsjax.data.transforms` converts files in OpenGL axes.
      K: [3, 3] (shared) or [B, 3, 3] intrinsics in px: fx 0 cx, 0 fy cy, 0 0 1.
      width, height: image size in px, at least 1.
      near, far: range of z that is drawn, scalars or [B]; near > 0. Nothing nearer than
        1e-12 is drawn.
      lens: a name of `gsjax.cameras.lenses.LENSES`, or a `Lens`.
      coefficients: [M] (shared) or [B, M] coefficients of the lens, or None.

    Raises:
      InputError: on wrong shapes or sizes, an empty batch, an unknown lens, a wrong
        number of coefficients, coefficients outside the range of the lens, non-finite
        values, a focal length that is not positive,
        skew, a rotation part that scales or shears by more than 1 % or mirrors, or a
        last row other than 0 0 0 1 (of K: 0 0 1). Only shapes of tracers are checked.
    """
    lens = find_lens(lens)
    width, height = _whole_size(width, height)
    named = {"viewmat": viewmat, "K": K, "near": near, "far": far}
    viewmat, K, near, far = (real_floats(name, v) for name, v in named.items())
    if viewmat.ndim not in (2, 3) or viewmat.shape[-2:] != (4, 4):
        raise InputError(
            f"viewmat: expected shape [4, 4] or [B, 4, 4], got {viewmat.shape}"
        )
    if not viewmat.size:
        raise InputError(f"viewmat: expected at least one camera, got {viewmat.shape}")
    batch = viewmat.shape[:-2]
    if K.shape[-2:] != (3, 3) or K.shape[:-2] not in ((), batch):
        raise InputError(f"K: expected shape [3, 3] or {(*batch, 3, 3)}, got {K.shape}")
    for name, value in (("near", near), ("far", far)):
        if value.shape not in ((), batch):
            raise InputError(f"{name}: expected shape () or {batch}, got {value.shape}")
    _check_values(viewmat, K, near, far)
    camera = Camera(
        viewmat=viewmat,  # pyright: ignore
        K=_broadcast(K, (*batch, 3, 3)),  # pyright: ignore
        near=_broadcast(near, batch),  # pyright: ignore
        far=_broadcast(far, batch),  # pyright: ignore
        width=width,
        height=height,
        lens=lens,
        coefficients=_coefficients(lens, coefficients, batch),  # pyright: ignore
    )
    return place(camera)


def _coefficients(lens: Lens, values, batch: tuple[int, ...]):
    """Return the checked coefficients [*batch, M], or None."""
    count = 0
    if values is not None:
        values = real_floats("coefficients", values)
        count = values.shape[-1] if values.ndim else -1
        if values.shape[:-1] not in ((), batch):
            raise InputError(
                f"coefficients: expected shape [M] or {(*batch, 'M')}, got "
                f"{values.shape}"
            )
    if count not in lens.counts:
        raise InputError(
            f"coefficients: expected {' or '.join(map(str, lens.counts))} for the "
            f"{lens.name} lens, got {max(count, 0)}"
        )
    if values is None:
        return None
    if not isinstance(values, Tracer):
        _check_coefficients(lens, np.asarray(values))
    return _broadcast(values, (*batch, count))


def _check_coefficients(lens: Lens, values: np.ndarray) -> None:
    """Check concrete coefficients [..., M]."""
    if not np.isfinite(values).all():
        raise InputError(
            f"coefficients: expected finite values for the {lens.name} lens, got "
            f"{values}; calibrate the camera again, or use the pinhole lens"
        )
    fault = None if lens.fault is None else lens.fault(values)
    if fault is not None:
        raise InputError(f"coefficients: {lens.name} lens: {fault}")


def with_shutter(
    camera: Camera, shutter: str | Shutter, *, twist=None, viewmat_end=None
) -> Camera:
    """Return a camera that exposes its image while it moves.

    ``camera.viewmat`` is the pose at the start of the exposure.

    Args:
      camera: one camera, or a batch B.
      shutter: a name of `gsjax.cameras.shutter.SHUTTERS`, or a `Shutter`.
      twist: [6] or [B, 6] motion over the exposure, see `gsjax.cameras.shutter`; may be
        traced.
      viewmat_end: [4, 4] or [B, 4, 4] pose at the end, in place of ``twist``.

    Raises:
      InputError: if the shutter is unknown, a rolling one has not exactly one of
        ``twist`` and ``viewmat_end``, another one has any, or their shapes or values
        are not valid.
    """
    shutter, viewmat = find_shutter(shutter), camera.viewmat
    if (twist is not None) + (viewmat_end is not None) != int(shutter.rolling):
        expected = "one of twist and viewmat_end" if shutter.rolling else "neither"
        raise InputError(
            f"twist and viewmat_end: expected {expected} for the {shutter.name} shutter"
        )
    if viewmat_end is not None:
        if any(isinstance(v, Tracer) for v in (viewmat, viewmat_end)):
            raise InputError("viewmat_end: needs concrete values; pass twist instead")
        end = np.asarray(viewmat_end, np.float64)
        if end.shape != viewmat.shape:
            raise InputError(
                f"viewmat_end: expected shape {viewmat.shape}, got {end.shape}"
            )
        _check_values(end, np.eye(3), np.ones(()), 2 * np.ones(()))
        twist = twist_between(viewmat, end)
    if twist is None:
        return camera.replace(shutter=shutter, twist=None)
    twist, shape = real_floats("twist", twist), (*viewmat.shape[:-2], 6)
    if twist.shape not in ((6,), shape):
        raise InputError(f"twist: expected shape {shape}, got {twist.shape}")
    if not isinstance(twist, Tracer) and not np.isfinite(np.asarray(twist)).all():
        raise InputError(f"twist: expected finite values, got {np.asarray(twist)}")
    moving = place(_broadcast(twist, shape))
    return camera.replace(shutter=shutter, twist=moving)


def _broadcast(value: Array | np.ndarray, shape: tuple[int, ...]):
    library = np if isinstance(value, np.ndarray) else jnp
    return library.broadcast_to(value, shape)


def _whole_size(width, height) -> tuple[int, int]:
    message = f"image size: expected whole numbers ≥ 1, got {width} × {height}"
    try:
        size = as_int("width", width), as_int("height", height)
    except InputError as error:
        raise InputError(message) from error
    if min(size) < 1:
        raise InputError(message)
    return size


def _check_values(viewmat, K, near, far) -> None:
    """Check concrete values; tracers pass."""
    values = {"viewmat": viewmat, "K": K, "near": near, "far": far}
    if any(isinstance(v, Tracer) for v in values.values()):
        return
    host = {name: np.asarray(value) for name, value in values.items()}
    for name in ("viewmat", "K", "near"):
        if not np.isfinite(host[name]).all():
            raise InputError(f"{name}: expected finite values, got {host[name]}")
    _check_intrinsics(host["K"])
    if not ((host["near"] > 0) & (host["far"] > host["near"])).all():
        raise InputError(
            f"near and far: expected 0 < near < far, got {host['near']}, {host['far']}"
        )
    if not (host["viewmat"][..., 3, :] == (0, 0, 0, 1)).all():
        raise InputError(
            "viewmat: expected 0 0 0 1 as the last row, got "
            f"{host['viewmat'][..., 3, :]}; transpose the matrix if that is the reason"
        )
    rotation = host["viewmat"][..., :3, :3].astype(np.float64)
    gram = rotation @ np.swapaxes(rotation, -1, -2)
    if np.abs(gram - np.eye(3)).max() > 0.02:
        lengths = np.sqrt(np.diagonal(gram, axis1=-2, axis2=-1))
        raise InputError(
            "viewmat: expected a rotation with rows of length 1, got rows of length "
            f"{lengths}; divide the scale out of rotation and translation, or scale "
            "the scene instead"
        )
    if (np.linalg.det(rotation) < 0).any():
        raise InputError(
            "viewmat: expected a rotation, got a mirror image (determinant -1); flip "
            "one axis"
        )


def _check_intrinsics(K: np.ndarray) -> None:
    """Check [3, 3] or [B, 3, 3] finite intrinsics."""
    if not (K[..., (0, 1), (0, 1)] > 0).all():
        raise InputError("K: expected focal lengths K[0, 0] and K[1, 1] above 0")
    if not (np.abs(K[..., 2, :] - (0, 0, 1)) <= _K_ROUNDING).all():
        raise InputError(
            f"K: expected 0 0 1 as the last row, got {K[..., 2, :]}; transpose K if "
            "the principal point stands there; divide K by K[2, 2] if that is not 1"
        )
    focal, centre = K[..., (0, 1), (0, 1)], K[..., :2, 2]
    skew = np.abs(K[..., (0, 1), (1, 0)])
    if not (skew <= _K_ROUNDING * focal.max(-1, keepdims=True)).all():
        raise InputError(
            f"K: expected no skew, got K[0, 1] and K[1, 0] = {K[..., (0, 1), (1, 0)]}; "
            "undistort the photographs to square axes, or drop a small skew"
        )
    low, high = LENS_RANGE
    if not ((focal > low) & (focal < high) & (np.abs(centre) < high)).all():
        raise InputError(
            f"K: expected focal lengths and a principal point within {low:g} and "
            f"{high:g} px, got {focal.ravel()} and {centre.ravel()}"
        )


def camera_centre(viewmat: Array) -> Array:
    """Return the world position [..., 3] of cameras [..., 4, 4]."""
    rotation, translation = viewmat[..., :3, :3], viewmat[..., :3, 3]
    return -jnp.sum(rotation * translation[..., :, None], axis=-2)


def resize_camera(camera: Camera, width: int, height: int) -> Camera:
    """Return the same view at another resolution; intrinsics scale with the pixels.

    Args:
      camera: one, or a batch.
      width, height: new image size in px; another aspect ratio stretches the image.

    Raises:
      InputError: if a size is not a whole number of at least 1.
    """
    width, height = _whole_size(width, height)
    sx, sy = width / camera.width, height / camera.height
    scale = jnp.asarray([[sx, 1, sx], [1, sy, sy], [1, 1, 1]], camera.K.dtype)
    return replace(camera, K=camera.K * scale, width=width, height=height)


def stack_cameras(cameras: list[Camera]) -> Camera:
    """Return a batch of single cameras with one image size, lens and shutter.

    Args:
      cameras: B of them, arrays [4, 4], [3, 3], [] each; [B, …] in the batch.

    Raises:
      InputError: if the list is empty, or sizes, lenses or shutters differ.
    """
    kinds = {(c.width, c.height, c.lens, c.shutter) for c in cameras}
    if len(kinds) != 1:
        found = sorted((w, h, lens.name, roll.name) for w, h, lens, roll in kinds)
        raise InputError(
            "stack_cameras: expected cameras of one size, lens and shutter, got "
            f"{found}"
        )
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)


def look_at(eye, target, up=(0.0, 0.0, 1.0)) -> np.ndarray:
    """Return the world → camera matrix [4, 4] of a camera at ``eye``, on the host.

    Args:
      eye, target: [3] world positions; they must differ.
      up: [3] world direction towards the top of the image, of any length. Another
        direction is chosen if ``up`` is parallel to the view.

    Raises:
      InputError: if ``eye`` is ``target``, ``up`` is zero, or a value is not finite.
    """
    eye, target, up = (np.asarray(v, np.float64) for v in (eye, target, up))
    forward = target - eye
    for name, value in (("target − eye", forward), ("up", up)):
        if not 0 < np.linalg.norm(value) < np.inf:
            raise InputError(f"look_at: expected a direction {name}, got {value}")
    forward, up = forward / np.linalg.norm(forward), up / np.linalg.norm(up)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-9:
        right = np.cross(forward, np.roll(up, 1) + (0.1, 0.2, 0.3))
    right = right / np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ eye
    return viewmat
