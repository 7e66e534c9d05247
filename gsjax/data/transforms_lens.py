"""The lens of a frame of a `transforms.json`, read and written."""

import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.cameras.distortion import Distortion, distortion_of
from gsjax.cameras.lenses import panorama_intrinsics
from gsjax.data.transforms_fields import Frame, shown
from gsjax.data.types import intrinsic_matrix
from gsjax.errors import InputError

_PERSPECTIVE = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
_FISHEYE = ("OPENCV_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_RADIAL_FISHEYE")
_PANORAMA = "EQUIRECTANGULAR"
# In the order of nerfstudio's distortion_params.
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")


def lens_of_frame(frame: Frame) -> Distortion | None:
    """Return the lens of a frame; None for a pinhole.

    Raises:
      InputError: if the camera model or one of its coefficients is not supported.
    """
    model, supported = frame.model(), (*_PERSPECTIVE, *_FISHEYE, _PANORAMA)
    if model not in supported:
        raise InputError(
            f"{frame.where}: camera_model {shown(model)} is not supported; undistort "
            f"the photographs to a pinhole first; supported: {', '.join(supported)}"
        )
    if model == _PANORAMA:
        return Distortion("equirectangular", ())
    k1, k2, k3, k4, p1, p2 = _coefficients(frame)
    if model in _FISHEYE:
        if p1 or p2:
            what = f"{frame.where}: a fisheye has no p1, p2, got {p1}, {p2}"
            raise InputError(f"{what}; undistort the photographs first")
        return Distortion("fisheye", (k1, k2, k3, k4))
    if not any((k1, k2, k3, k4, p1, p2)):
        return None
    # nerfstudio and instant-ngp read no rational denominator either.
    higher = {key: frame.number(key) for key in ("k5", "k6")} | {"k4": k4}
    if any(higher.values()):
        raise InputError(
            f"{frame.where}: {', '.join(k for k, v in higher.items() if v)} of a "
            "perspective lens is not supported; undistort the photographs first"
        )
    return Distortion("opencv", (k1, k2, p1, p2, k3))


def _coefficients(frame: Frame) -> list[float]:
    """Return k1 k2 k3 k4 p1 p2; missing ones are 0."""
    given = frame.sources[0].get("distortion_params")
    if given is None:
        return [frame.number(key) or 0.0 for key in _COEFFICIENTS]
    if not isinstance(given, list) or len(given) != len(_COEFFICIENTS):
        expected = f"the numbers {' '.join(_COEFFICIENTS)}"
        raise frame.unexpected("distortion_params", expected, given)
    named = Frame(frame.where, (dict(zip(_COEFFICIENTS, given)), {}))
    return [named.number(key) or 0.0 for key in _COEFFICIENTS]


def intrinsics_of_frame(
    frame: Frame, size: tuple[int, int], lens: Distortion | None
) -> np.ndarray:
    """Return K [3, 3] of a frame whose image has the given width and height."""
    if lens is not None and lens.model == "equirectangular":
        return panorama_intrinsics(*size)
    model = "fisheye" if lens is not None and lens.model == "fisheye" else "pinhole"
    fx, fy, cx, cy = frame.intrinsics(*size, model)
    return intrinsic_matrix(frame.where, (fx, fy), (cx, cy))


def lens_keys(camera: Camera) -> dict[str, str | float]:
    """Return the keys of a frame that describe the lens of a single camera.

    Raises:
      InputError: if the format has no model for the lens.
    """
    lens = distortion_of(camera)
    if lens is None or lens.model == "orthographic":
        return {"camera_model": camera.lens.name.upper()}
    if lens.model == "equirectangular":
        return {"camera_model": _PANORAMA}
    c = lens.coefficients
    if lens.model == "fisheye":
        return {"camera_model": "OPENCV_FISHEYE", **dict(zip(_COEFFICIENTS, c))}
    if lens.model == "opencv" and not any(c[5:]):
        names = ("k1", "k2", "p1", "p2", "k3")
        return {"camera_model": "OPENCV", **dict(zip(names, c))}
    raise InputError(
        f"transforms.json: no camera_model for the lens {lens.model} with {len(c)} "
        "coefficients; pass pinhole, opencv with up to 5, fisheye or equirectangular"
    )
