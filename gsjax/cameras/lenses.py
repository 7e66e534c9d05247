"""Lenses: how points in camera coordinates fall onto the image.

A lens is a set of pure functions over components of any one shape; see
`gsjax.cameras.lens.Lens`. The renderer, the undistortion of photographs and the
projection on the host use the same functions. The EWA Jacobian is the derivative of
`Lens.project`, so a new lens needs no other code.
"""

from gsjax.cameras.lens import (
    Array,
    Length,
    Lens,
    Pixel,
    Point,
    everywhere,
    from_pixel,
    limit_to_image,
    linearise_in_place,
    range_depth,
    to_pixel,
    z_depth,
)
from gsjax.cameras.radial_lenses import (
    DIVISION,
    FISHEYE,
    FOV,
    FTHETA,
    FTHETA_INVERSE,
    OPENCV,
    RAD_TAN_THIN_PRISM_FISHEYE,
    THIN_PRISM_FISHEYE,
)
from gsjax.cameras.spherical_lenses import (
    EQUIRECTANGULAR,
    EUCM,
    lidar_coefficients,
    lidar_lens,
    panorama_intrinsics,
)
from gsjax.errors import InputError


def _pinhole_project(K: Array, c: Array, point: Point) -> Pixel:
    del c
    x, y, z = point
    return K[0, 0] * (x / z) + K[0, 2], K[1, 1] * (y / z) + K[1, 2]


def _pinhole_unproject(K: Array, c: Array, pixel: Pixel) -> Point:
    del c
    x, y = from_pixel(K, pixel)
    return x, y, 1 + 0 * x


def _orthographic_project(K: Array, c: Array, point: Point) -> Pixel:
    del c
    return to_pixel(K, point[0], point[1])


PINHOLE = Lens(
    name="pinhole",
    counts=(0,),
    project=_pinhole_project,
    unproject=_pinhole_unproject,
    valid=everywhere,
    depth=z_depth,
    linearise=limit_to_image,
)
ORTHOGRAPHIC = PINHOLE._replace(
    name="orthographic", project=_orthographic_project, linearise=linearise_in_place
)

LENSES = {
    lens.name: lens
    for lens in (
        *(PINHOLE, ORTHOGRAPHIC, OPENCV, FISHEYE, THIN_PRISM_FISHEYE),
        *(RAD_TAN_THIN_PRISM_FISHEYE, FOV, DIVISION, EUCM, FTHETA, FTHETA_INVERSE),
        EQUIRECTANGULAR,
    )
}


def find_lens(lens: str | Lens) -> Lens:
    """Return the lens of a name; a `Lens` is returned unchanged.

    Raises:
      InputError: if the name is unknown, or ``lens`` is of another type.
    """
    if isinstance(lens, Lens):
        return lens
    if isinstance(lens, str) and lens in LENSES:
        return LENSES[lens]
    raise InputError(
        f"lens: expected a gsjax.cameras.lenses.Lens or one of {sorted(LENSES)}, got "
        f"{lens!r}"
    )


__all__ = [
    "DIVISION",
    "EQUIRECTANGULAR",
    "EUCM",
    "FISHEYE",
    "FOV",
    "FTHETA",
    "FTHETA_INVERSE",
    "LENSES",
    "OPENCV",
    "ORTHOGRAPHIC",
    "PINHOLE",
    "RAD_TAN_THIN_PRISM_FISHEYE",
    "THIN_PRISM_FISHEYE",
    "Length",
    "Lens",
    "Point",
    "everywhere",
    "find_lens",
    "lidar_coefficients",
    "lidar_lens",
    "limit_to_image",
    "linearise_in_place",
    "panorama_intrinsics",
    "range_depth",
    "z_depth",
]
