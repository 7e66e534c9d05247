"""Content of a COLMAP model, and the checks that both file forms share.

Poses are world → camera, quaternions wxyz, pixel centres at + 0.5. Camera models and
their numbers are those of COLMAP's `src/colmap/sensor/models.h`.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from gsjax.cameras.distortion import Distortion
from gsjax.cameras.lenses import panorama_intrinsics
from gsjax.data.types import intrinsic_matrix, unexpected
from gsjax.errors import InputError

T = TypeVar("T")
MAX_NAME_BYTES = 1024
MAX_SIDE = 1 << 20
# Keeps products of coordinates finite, and their results within float32.
MAX_COORDINATE = 1e30


class CameraKind(NamedTuple):
    """A camera model of COLMAP.

    Attributes:
      name, number: as in cameras.txt, and in cameras.bin.
      size: number of parameters.
      focals: how many of them are focal lengths (1: fx = fy); cx and cy follow.
      lens: model of the `Distortion` that the remaining parameters describe, "" if
        there is none.
      order: index of each remaining parameter in the distortion's coefficients.
    """

    name: str
    number: int
    size: int
    focals: int = 2
    lens: str = ""
    order: tuple[int, ...] = ()


_RADIAL, _FISHEYE = "opencv", "fisheye"
_ALL = tuple(range(12))
CAMERA_KINDS = (
    CameraKind("SIMPLE_PINHOLE", 0, 3, 1, ""),
    CameraKind("PINHOLE", 1, 4, 2, ""),
    CameraKind("SIMPLE_RADIAL", 2, 4, 1, _RADIAL, (0,)),
    CameraKind("RADIAL", 3, 5, 1, _RADIAL, (0, 1)),
    CameraKind("OPENCV", 4, 8, 2, _RADIAL, (0, 1, 2, 3)),
    CameraKind("OPENCV_FISHEYE", 5, 8, 2, _FISHEYE, (0, 1, 2, 3)),
    CameraKind("FULL_OPENCV", 6, 12, 2, _RADIAL, (0, 1, 2, 3, 4, 5, 6, 7)),
    CameraKind("FOV", 7, 5, 2, "fov", (0,)),
    CameraKind("SIMPLE_RADIAL_FISHEYE", 8, 4, 1, _FISHEYE, (0,)),
    CameraKind("RADIAL_FISHEYE", 9, 5, 1, _FISHEYE, (0, 1)),
    CameraKind("THIN_PRISM_FISHEYE", 10, 12, 2, "thin_prism_fisheye", _ALL[:8]),
    CameraKind(
        "RAD_TAN_THIN_PRISM_FISHEYE", 11, 16, 2, "rad_tan_thin_prism_fisheye", _ALL
    ),
    CameraKind("SIMPLE_DIVISION", 12, 4, 1, "division", (0,)),
    CameraKind("DIVISION", 13, 5, 2, "division", (0,)),
    CameraKind("SIMPLE_FISHEYE", 14, 3, 1, _FISHEYE),
    CameraKind("FISHEYE", 15, 4, 2, _FISHEYE),
    CameraKind("EUCM", 16, 6, 2, "eucm", (0, 1)),
    CameraKind("EQUIRECTANGULAR", 17, 2, 0, "equirectangular"),
)
KIND_OF_NUMBER = {kind.number: kind for kind in CAMERA_KINDS}
KIND_OF_NAME = {kind.name: kind for kind in CAMERA_KINDS}
_SUPPORTED = ", ".join(kind.name for kind in CAMERA_KINDS)


class ColmapCamera(NamedTuple):
    """Intrinsics [3, 3] in px of an image of width × height, and the distortion."""

    width: int
    height: int
    K: np.ndarray
    lens: Distortion | None


class ColmapImage(NamedTuple):
    """A registered image: world → camera as [4] unit quaternion wxyz and [3]."""

    name: str
    camera: int
    quat: np.ndarray
    translation: np.ndarray


class ColmapPoints(NamedTuple):
    """Points sorted by id.

    Attributes:
      ids: [M] uint64.
      xyz: [M, 3] float64.
      colors: [M, 3] uint8.
      errors: [M] mean reprojection error, px; negative or NaN if unknown.
      track_lengths: [M] int64, number of images that observed each point.
    """

    ids: np.ndarray
    xyz: np.ndarray
    colors: np.ndarray
    errors: np.ndarray
    track_lengths: np.ndarray


NO_POINTS = ColmapPoints(
    *(np.zeros(0, np.uint64), np.zeros((0, 3)), np.zeros((0, 3), np.uint8)),
    *(np.zeros(0), np.zeros(0, np.int64)),
)


def kind_of(where: str, key: int | str) -> CameraKind:
    """Return the camera model of a number or name."""
    kind = KIND_OF_NUMBER.get(key) if isinstance(key, int) else KIND_OF_NAME.get(key)
    if kind is None:
        raise InputError(
            f"{where}: unknown camera model {key!r}; the file is damaged or newer than "
            f"this reader: export it again, with one of {_SUPPORTED}"
        )
    return kind


def make_colmap_camera(
    where: str, kind: CameraKind, size: Sequence[int], params: Sequence[float]
) -> ColmapCamera:
    """Check the values of a camera and convert them to K and distortion."""
    if not all(1 <= side <= MAX_SIDE for side in size):
        expected = f"an image size of 1 to {MAX_SIDE} px a side"
        raise unexpected(where, expected, f"{size[0]} × {size[1]}")
    if not all(abs(p) < MAX_COORDINATE for p in params):  # not even NaN
        remedy = "estimate the camera again"
        raise unexpected(where, "finite parameters", params, remedy)
    if not kind.focals:  # a panorama has the size of the image as its parameters
        K = panorama_intrinsics(*size)
        return ColmapCamera(size[0], size[1], K, Distortion(kind.lens, ()))
    cx, cy = params[kind.focals : kind.focals + 2]
    K = intrinsic_matrix(where, (params[0], params[kind.focals - 1]), (cx, cy))
    return ColmapCamera(
        size[0], size[1], K, _distortion(kind, params[kind.focals + 2 :])
    )


def _distortion(kind: CameraKind, rest: Sequence[float]) -> Distortion | None:
    # A fisheye of zero coefficients is equidistant, not a pinhole.
    if not kind.lens or (kind.lens == _RADIAL and not any(rest)):
        return None
    least = 4 if kind.lens in (_RADIAL, _FISHEYE) else 0
    coefficients = [0.0] * max(least, len(rest))
    for at, value in zip(kind.order, rest):
        coefficients[at] = value
    return Distortion(kind.lens, tuple(coefficients))


def make_colmap_image(
    where: str, name: str, camera: int, pose: Sequence[float]
) -> ColmapImage:
    """Check a pose (qw, qx, qy, qz, tx, ty, tz) and normalise its quaternion."""
    values, remedy = np.asarray(pose, np.float64), "remove it from the model"
    if not (np.abs(values) < MAX_COORDINATE).all():
        expected = f"a pose of finite numbers for {name!r}"
        raise unexpected(where, expected, values.tolist(), remedy)
    quat = values[:4]
    if np.abs(quat).max() < 1e-30:
        raise InputError(f"{where}: the quaternion of {name!r} is zero; {remedy}")
    if not name:
        raise InputError(f"{where}: the name of the image is empty; {remedy}")
    norm = np.linalg.norm(quat)
    # Keeps the bits of the file if the norm is 1 up to rounding.
    quat = quat if abs(norm - 1) < 1e-12 else quat / norm
    return ColmapImage(name, camera, quat, values[4:])


def by_id(records: Iterable[tuple[str, int, T]], what: str) -> dict[int, T]:
    """Return records, given as (place, id, record), by their ids, which must differ."""
    found: dict[int, T] = {}
    for where, identity, record in records:
        if identity in found:
            raise InputError(
                f"{where}: the id {identity} is that of another {what}; the file is "
                "damaged: export or copy it again"
            )
        found[identity] = record
    return found


def sorted_points(where: str, points: ColmapPoints) -> ColmapPoints:
    """Return points sorted by id, after a check of ids and coordinates.

    The arrays are sorted in place, one at a time, to bound the memory.
    """
    if (points.ids[1:] < points.ids[:-1]).any():
        order = np.argsort(points.ids, kind="stable")
        for values in points:
            values[:] = values[order]
    again = np.flatnonzero(points.ids[1:] == points.ids[:-1])
    if len(again):
        raise InputError(
            f"{where}: {len(again)} points have the id of another point, the first: "
            f"{points.ids[again[:5]].tolist()}; export or copy the file again"
        )
    wild = np.logical_not((np.abs(points.xyz) < MAX_COORDINATE).all(axis=1))
    if wild.any():
        raise InputError(
            f"{where}: {wild.sum()} of {len(wild)} points have coordinates that are "
            f"not finite, the first: point {points.ids[wild][:5].tolist()}; remove them"
        )
    return points


def viewmat_of(quat: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Return the [4, 4] world → camera matrix of a unit quaternion wxyz and [3]."""
    w, x, y, z = quat
    viewmat = np.eye(4)
    viewmat[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    viewmat[:3, 3] = translation
    return viewmat
