"""Writer of Gaussians as binary glTF with KHR_gaussian_splatting; see `gsjax.io.gltf`.

Axis legend: N Gaussians, K spherical-harmonic bases.
"""

from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from gsjax.errors import InputError
from gsjax.gaussians import Gaussians
from gsjax.io import common
from gsjax.io.gltf_container import BYTE, FLOAT, write_gltf
from gsjax.math.sh import C0, num_bases
from gsjax.math.sh_rotation import rotate_sh
from gsjax.runtime.files import replacing
from gsjax.runtime.memory import Estimate, require

EXTENSION = "KHR_gaussian_splatting"
HALF_TURN = np.diag(
    [-1.0, -1.0, 1.0]
)  # about z, from the axes of a PLY to those of glTF
MAX_DEGREE = 3
_SETTINGS = {
    **{"kernel": "ellipse", "colorSpace": "srgb_rec709_display"},
    **{"projection": "perspective", "sortingMethod": "cameraDistance"},
}
_SHAPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_MAX_LOG = 87.0  # of a scale within float32
_MAX_BYTES = 2**32 - 2**20  # sizes have 32 bits


def write_glb(
    path: str | PathLike[str], gaussians: Gaussians, *, overwrite: bool = False
) -> None:
    """Write the active Gaussians as a binary glTF file, in their order, in float32.

    The points have a colour, COLOR_0, for programs that do not know the extension.

    Args:
      path, gaussians, overwrite: as `gsjax.io.formats.save`; SH degree 0 to 3.

    Raises:
      InputError: as `write_ply`; if a value is NaN, or infinite and not a logit, if a
        mean exceeds float32, if the degree is 4, or if nothing would be drawn.
      CapacityError: if memory is too small.
    """
    path = Path(path)
    common.require_new(path, overwrite)
    degree, slots = gaussians.sh_degree, gaussians.capacity
    common.require_degree(path, degree, MAX_DEGREE)
    estimate = Estimate(
        {"values to be written": slots * (300 + 32 * num_bases(degree))}
    )
    remedy = "leave some out (export --min-opacity)"
    require(estimate, f"{path}: {slots:,} Gaussians", remedy)
    rows = common.visible_rows(path, gaussians)
    if not len(rows["means"]):
        expected = "expected at least one active Gaussian, got none"
        raise InputError(f"{path}: {expected}: glTF has no empty arrays; write a .ply")
    attributes = _attributes(path, rows)
    size = sum(array.nbytes for array in attributes.values())
    if size > _MAX_BYTES:
        got = f"got {size:,}; write a .ply, or several files"
        raise InputError(f"{path}: expected at most {_MAX_BYTES:,} bytes, {got}")
    with replacing(path, durable=True) as file:
        write_gltf(file, _document(attributes), [*attributes.values()])


def _attributes(path: Path, rows: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the arrays of a primitive by their names."""
    means = common.float32_means(path, rows)
    common.warn_of_moves(path, means, rows)
    w, x, y, z = rows["quats"].T
    with np.errstate(over="ignore"):
        opacities = 1 / (1 + np.exp(-rows["logit_opacities"].astype(np.float64)))
    scales = np.exp(rows["log_scales"].astype(np.float64).clip(-_MAX_LOG, _MAX_LOG))
    sh = rotate_sh(rows["sh"].astype(np.float32), HALF_TURN)
    found = {
        "POSITION": means @ HALF_TURN.astype(np.float32),
        "COLOR_0": _fallback_colors(rows["sh"][:, 0], opacities),
        # The product with the half turn -k; as xyzw.
        f"{EXTENSION}:ROTATION": np.stack([y, -x, -w, z], axis=-1),
        f"{EXTENSION}:SCALE": scales,
        f"{EXTENSION}:OPACITY": opacities[:, None],
    }
    for l in range(MAX_DEGREE + 1):
        for n in range((2 * l + 1) * (l * l < sh.shape[1])):
            found[f"{EXTENSION}:SH_DEGREE_{l}_COEF_{n}"] = sh[:, l * l + n]
    return {
        name: np.ascontiguousarray(v, None if v.dtype == np.uint8 else "<f4")
        for name, v in found.items()
    }


def _fallback_colors(dc: np.ndarray, opacities: np.ndarray) -> np.ndarray:
    """Return linear colours and opacities [N, 4] uint8 of SH degree 0, [N, 3]."""
    srgb = np.clip(0.5 + C0 * dc.astype(np.float64), 0, 1)
    # IEC 61966-2-1; glTF asks for linear values in COLOR_0.
    linear = np.where(srgb > 0.04045, ((srgb + 0.055) / 1.055) ** 2.4, srgb / 12.92)
    return common.to_bytes(255 * np.column_stack([linear, opacities]))


def _document(attributes: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return the JSON of a scene with one node; accessor i is attribute i."""
    accessors = []
    for view, (name, array) in enumerate(attributes.items()):
        small = array.dtype == np.uint8
        accessor: dict[str, Any] = {
            "bufferView": view,
            "componentType": BYTE if small else FLOAT,
            "count": len(array),
            "type": _SHAPES[array.shape[1]],
        }
        if small:
            accessor["normalized"] = True
        if name == "POSITION":
            accessor["min"] = array.min(axis=0).tolist()
            accessor["max"] = array.max(axis=0).tolist()
        accessors.append(accessor)
    primitive = {
        "mode": 0,
        "attributes": {name: index for index, name in enumerate(attributes)},
        "extensions": {EXTENSION: _SETTINGS},
    }
    return {
        "asset": {"version": "2.0", "generator": "gsjax"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
    }
