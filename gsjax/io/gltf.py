"""Gaussians in binary glTF files (.glb) with KHR_gaussian_splatting (Khronos, release
candidate of 2026).

Scales and opacities are activated, quaternions xyzw. In glTF y is up: files are turned
by 180° about z against the PLY, as @playcanvas/splat-transform writes them. They are
not compressed, and do not record how the scene is to be drawn.
"""

import re
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, make_gaussians
from gsjax.io import common
from gsjax.io.affine import transform_gaussians
from gsjax.io.gltf_container import FLOAT, Gltf, read_accessor, read_gltf
from gsjax.io.gltf_nodes import placed_meshes
from gsjax.io.gltf_writer import EXTENSION, HALF_TURN, MAX_DEGREE, write_glb
from gsjax.runtime.files import shown
from gsjax.runtime.memory import Estimate, require

_POINTS = 0  # mode of a primitive; the default is 4
_COLOR_SPACES = ("srgb_rec709_display", "lin_rec709_display")
_DEFAULTS = {"projection": "perspective", "sortingMethod": "cameraDistance"}
_U8, _I8, _U16, _I16 = 5121, 5120, 5123, 5122
# Shape, and types of components: see `read_accessor`.
_ATTRIBUTES: dict[str, tuple[str, dict[int, str]]] = {
    "POSITION": ("VEC3", {FLOAT: ""}),
    "ROTATION": ("VEC4", {FLOAT: "", _I8: "n", _I16: "n"}),
    "SCALE": ("VEC3", {FLOAT: "", _U8: "n?", _U16: "n?"}),
    "OPACITY": ("SCALAR", {FLOAT: "", _U8: "n", _U16: "n"}),
    "SH_DEGREE_0_COEF_0": ("VEC3", {FLOAT: ""}),
}
_HARMONIC = re.compile(rf"{EXTENSION}:SH_DEGREE_(\d+)_COEF_(\d+)")
_FLAT = 1e-9  # ratio of the scales of a node below which it has no thickness
_MAX_PLACED = 1000
_ROUNDING = 1e-6  # of opacities
_MAX_OPACITY = 1 - 2.0**-25  # rounds to 1


def read_glb(path: str | PathLike[str]) -> Gaussians:
    """Read the Gaussians of a binary glTF file, with the transforms of its nodes.

    All primitives with the extension in the meshes of the scene are joined, in the
    order of the nodes; fewer SH degrees are filled with zeros. Rotations need not be
    normalised. Colours of a linear colour space are read as they are, with a warning.

    Returns:
      Gaussians in the axes of a PLY, with capacity max(N, 1).

    Raises:
      InputError: if the file cannot be read, is damaged or truncated, requires another
        extension, has no Gaussians, an unknown kernel or colour space, an incomplete SH
        degree, sparse or compressed arrays, values that are not finite, negative
        scales, or opacities beyond [0, 1].
      CapacityError: if memory is too small; raised before arrays are read.
    """
    gltf = read_gltf(Path(path))
    _check_required(gltf)
    placed = _placed_primitives(gltf)
    _check_count(gltf, [(where, primitive) for where, primitive, _ in placed])
    found: dict[str, dict[str, np.ndarray]] = {}
    parts = []
    for where, primitive, matrix in placed:
        if where not in found:
            found[where] = _read_primitive(gltf, where, primitive)
        full = _invertible(gltf, where, matrix)
        parts.append(transform_gaussians(found[where], full))
    return make_gaussians(**_joined(parts), capacity=None)


def _placed_primitives(gltf: Gltf) -> list[tuple[str, dict[str, Any], np.ndarray]]:
    """Return the primitives of the scene that hold Gaussians, and their matrices."""
    known: dict[int, list[tuple[str, dict[str, Any]]]] = {}
    placed = []
    for mesh, matrix in placed_meshes(gltf):
        if mesh not in known:  # nodes may share a mesh
            known[mesh] = _primitives(gltf, mesh)
        placed += [(where, primitive, matrix) for where, primitive in known[mesh]]
        if len(placed) > _MAX_PLACED:
            expected = f"at most {_MAX_PLACED:,} primitives with {EXTENSION}, counted "
            expected += "for each of their nodes"
            raise gltf.fault("nodes", expected, "more")
    if not placed:
        expected = f"a mesh with {EXTENSION} in the scene"
        raise gltf.fault("meshes", expected, gltf.data.get("extensionsUsed"))
    return placed


def _invertible(gltf: Gltf, where: str, matrix: np.ndarray) -> np.ndarray:
    """Return the map [4, 4] from a primitive to the axes of a PLY.

    Args:
      gltf: the file.
      where: the primitive.
      matrix: [4, 4] map to the axes of glTF.
    """
    axes = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    if not axes[2] > _FLAT * axes[0]:
        raise gltf.fault(where, "a node with scales that are not 0", matrix.tolist())
    turn = np.eye(4)
    turn[:3, :3] = HALF_TURN  # its own inverse
    return turn @ matrix


def _check_required(gltf: Gltf) -> None:
    required = gltf.data.get("extensionsRequired", [])
    unknown = required
    if isinstance(required, list):
        unknown = [name for name in required if name != EXTENSION]
    if unknown:
        remedy = "export it without them, for example uncompressed"
        raise InputError(
            f"{gltf.path}: expected no required extensions but {EXTENSION}, got "
            f"{shown(unknown)}; {remedy}"
        )


def _primitives(gltf: Gltf, mesh: int) -> list[tuple[str, dict[str, Any]]]:
    """Return the primitives of a mesh that hold Gaussians, and their places."""
    listed = gltf.item("meshes", mesh).get("primitives")
    found = []
    for number, primitive in enumerate(listed if isinstance(listed, list) else []):
        where = f"meshes[{mesh}].primitives[{number}]"
        if not isinstance(primitive, dict):
            raise gltf.fault(where, "an object", primitive)
        extensions = primitive.get("extensions", {})
        if isinstance(extensions, dict) and EXTENSION in extensions:
            _check_extension(gltf, where, primitive)
            found.append((where, primitive))
    return found


def _check_extension(gltf: Gltf, where: str, primitive: dict[str, Any]) -> None:
    """Check the settings of a primitive and the names of its attributes."""
    settings, attributes = (
        primitive["extensions"][EXTENSION],
        primitive.get("attributes"),
    )
    if not isinstance(settings, dict) or not isinstance(attributes, dict):
        raise gltf.fault(where, "attributes and an extension as objects", primitive)
    mode = primitive.get("mode", 4)
    if mode != _POINTS or isinstance(mode, bool):
        raise gltf.fault(f"{where}.mode", f"{_POINTS}, points", mode)
    if settings.get("kernel") != "ellipse":
        raise gltf.fault(f"{where}: kernel", "'ellipse'", settings.get("kernel"))
    space = settings.get("colorSpace")
    if space not in _COLOR_SPACES:
        raise gltf.fault(f"{where}: colorSpace", " or ".join(_COLOR_SPACES), space)
    if space == _COLOR_SPACES[1]:
        common.warn(
            f"{gltf.path}: {where}: its colours are linear and are read as they are, "
            "which looks too dark; harmonics cannot be converted"
        )
    for key, known in _DEFAULTS.items():
        if settings.get(key, known) != known:
            what = f"{key} {shown(settings[key])} is ignored"
            common.warn(f"{gltf.path}: {where}: {what}")
    missing = [name for name in map(_full, _ATTRIBUTES) if name not in attributes]
    if missing:
        nested = settings.get("extensions")
        packed = f", compressed by {shown([*nested])}" if nested else ""
        expected = f"the attributes {', '.join(missing)}"
        raise gltf.fault(where, expected, f"{[*attributes]}{packed}")


def _full(name: str) -> str:
    return name if name == "POSITION" else f"{EXTENSION}:{name}"


def _check_count(gltf: Gltf, placed: list[tuple[str, dict[str, Any]]]) -> None:
    """Bound the number of Gaussians: nodes may share meshes, and meshes arrays."""
    count = 0
    for where, primitive in placed:
        accessor = gltf.item("accessors", primitive["attributes"]["POSITION"])
        number = accessor.get("count")
        if type(number) is not int or number < 1:
            raise gltf.fault(f"{where}: count", "a whole number of at least 1", number)
        count += number
    if count > gltf.size:
        got = f"got {count:,} in {gltf.size:,} bytes"
        expected = "expected at most one Gaussian for each byte of the file"
        raise InputError(f"{gltf.path}: {expected}, {got}; save each part of it alone")
    require(
        Estimate({"values as read": count * 1000}),
        f"{gltf.path}: {count:,} Gaussians",
        "reduce the file with the tool that made it",
    )


def _read_primitive(
    gltf: Gltf, where: str, primitive: dict[str, Any]
) -> dict[str, np.ndarray]:
    """Return the fields of `gsjax.make_gaussians` in the frame of the node."""
    attributes = primitive["attributes"]
    kinds = {_full(name): kind for name, kind in _ATTRIBUTES.items()}
    kinds |= dict.fromkeys(_harmonics(gltf, where, attributes), ("VEC3", {FLOAT: ""}))
    found: dict[str, np.ndarray] = {}
    for name, (shape, allowed) in kinds.items():
        values = read_accessor(gltf, name, attributes[name], shape, allowed)
        wrong = np.any(~np.isfinite(values), axis=1)
        if wrong.any():
            got = f"{wrong.sum():,} of {len(wrong):,} are not, the first "
            got += f"{np.flatnonzero(wrong)[0]}"
            raise gltf.fault(f"{where}: {name}", "finite values", got)
        found[name] = values
    counts = {name: len(values) for name, values in found.items()}
    if len({*counts.values()}) > 1:
        raise gltf.fault(where, "attributes of equal length", counts)
    means, quats, scales, opacities, *harmonics = found.values()
    return {
        "means": means,
        "quats": quats[:, [3, 0, 1, 2]],
        "log_scales": _log_scales(gltf, where, scales.astype(np.float64)),
        "logit_opacities": _logits(gltf, where, opacities[:, 0].astype(np.float64)),
        "sh": np.stack(harmonics, axis=1),
    }


def _harmonics(gltf: Gltf, where: str, attributes: Mapping[str, Any]) -> list[str]:
    """Return the names of the attributes of degree 1 and above, in order."""
    matches = [match for match in map(_HARMONIC.fullmatch, attributes) if match]
    degree = max(int(match[1]) for match in matches)
    names = [
        f"{EXTENSION}:SH_DEGREE_{l}_COEF_{n}"
        for l in range(min(degree, MAX_DEGREE) + 1)
        for n in range(2 * l + 1)
    ]
    if {*names} != {match[0] for match in matches}:
        got = sorted(match[0].removeprefix(f"{EXTENSION}:") for match in matches)
        expected = f"whole SH degrees, of up to {MAX_DEGREE}"
        raise gltf.fault(where, expected, f"{len(got)} attributes, the last {got[-1]}")
    return names[1:]


def _log_scales(gltf: Gltf, where: str, scales: np.ndarray) -> np.ndarray:
    negative = np.any(scales < 0, axis=1)
    if negative.any():
        got = f"{negative.sum():,} of {len(negative):,} below; earlier drafts of the "
        got += "extension stored logarithms"
        raise gltf.fault(f"{where}: SCALE", "scales of at least 0", got)
    return common.scale_logs(scales)


def _logits(gltf: Gltf, where: str, opacities: np.ndarray) -> np.ndarray:
    beyond = np.abs(opacities - 0.5) > 0.5 + _ROUNDING
    if beyond.any():
        got = f"{beyond.sum():,} of {len(beyond):,} beyond"
        raise gltf.fault(f"{where}: OPACITY", "opacities from 0 to 1", got)
    shares = opacities.clip(np.finfo(np.float32).tiny, _MAX_OPACITY)
    return np.log(shares) - np.log1p(-shares)


def _joined(parts: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Join the fields of all primitives; missing harmonics are zero."""
    bases = max(part["sh"].shape[1] for part in parts)
    for part in parts:
        missing = bases - part["sh"].shape[1]
        part["sh"] = np.pad(part["sh"], ((0, 0), (0, missing), (0, 0)))
    return {
        name: np.concatenate([part[name] for part in parts]).astype(np.float32)
        for name in parts[0]
    }


FORMAT = common.Format("glTF", (".glb",), read_glb, write_glb)
