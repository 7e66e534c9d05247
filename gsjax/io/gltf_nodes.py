"""The scene graph of a glTF file: meshes, and the matrices that place them."""

import math
from typing import Any

import numpy as np

from gsjax.io.gltf_container import Gltf

_LAST_ROW = (0.0, 0.0, 0.0, 1.0)
_TOLERANCE = 1e-6
_MAX_VALUE = 1e30  # of a transform


def placed_meshes(gltf: Gltf) -> list[tuple[int, np.ndarray]]:
    """Return the meshes of the scene, in the order of its nodes.

    The scene is that of ``scene``, or the first, or in a file without scenes all nodes.

    Returns:
      The index of each mesh, and the matrix [4, 4] float64 that maps its points to the
      scene.

    Raises:
      InputError: if a node does not exist, is reached twice, or has no valid transform.
    """
    roots = _roots(gltf)
    pending = [(node, np.eye(4)) for node in reversed(roots)]
    seen: set[int] = set()
    found = []
    while pending:
        index, parent = pending.pop()
        node = gltf.item("nodes", index)
        if index in seen:
            expected = "nodes that form a tree"
            raise gltf.fault(f"nodes[{index}]", expected, "a cycle, or two parents")
        seen.add(index)
        with np.errstate(over="ignore", invalid="ignore"):
            matrix = parent @ _local(gltf, index, node)
        if not np.isfinite(matrix).all():
            raise gltf.fault(f"nodes[{index}]", "a finite transform", matrix.tolist())
        if "mesh" in node:
            gltf.item("meshes", node["mesh"])
            found.append((node["mesh"], matrix))
        children = _list(gltf, f"nodes[{index}].children", node.get("children", []))
        pending += [(child, matrix) for child in reversed(children)]
    return found


def _roots(gltf: Gltf) -> list[Any]:
    if gltf.data.get("scenes"):
        number = gltf.data.get("scene", 0)
        scene = gltf.item("scenes", number)
        return _list(gltf, f"scenes[{number}].nodes", scene.get("nodes", []))
    nodes = _list(gltf, "nodes", gltf.data.get("nodes", []))
    inner = set()
    for index in range(len(nodes)):
        children = gltf.item("nodes", index).get("children", [])
        listed = _list(gltf, f"nodes[{index}].children", children)
        inner.update(child for child in listed if type(child) is int)
    return [index for index in range(len(nodes)) if index not in inner]


def _list(gltf: Gltf, place: str, value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise gltf.fault(place, "a list", value)
    return value


def _local(gltf: Gltf, index: int, node: dict[str, Any]) -> np.ndarray:
    """Return the matrix [4, 4] of a node relative to its parent."""

    def numbers(key: str, count: int) -> np.ndarray:
        value = node[key]
        numeric = isinstance(value, list) and {*map(type, value)} <= {int, float}
        listed = value if numeric else []
        found = [float(v) if abs(v) < _MAX_VALUE else math.nan for v in listed]
        if len(found) != count or any(map(math.isnan, found)):
            expected = f"{count} finite numbers"
            raise gltf.fault(f"nodes[{index}].{key}", expected, value)
        return np.asarray(found)

    if "matrix" in node:
        matrix = numbers("matrix", 16).reshape(4, 4).T  # by columns
        if np.abs(matrix[3] - _LAST_ROW).max() > _TOLERANCE:
            expected = "a last row of 0, 0, 0, 1"
            raise gltf.fault(f"nodes[{index}].matrix", expected, matrix[3].tolist())
        return matrix
    matrix = np.eye(4)
    if "rotation" in node:
        matrix[:3, :3] = _rotation(gltf, index, numbers("rotation", 4))
    if "scale" in node:
        matrix[:3, :3] *= numbers("scale", 3)
    if "translation" in node:
        matrix[:3, 3] = numbers("translation", 3)
    return matrix


def _rotation(gltf: Gltf, index: int, xyzw: np.ndarray) -> np.ndarray:
    """Return the rotation [3, 3] of a quaternion, which need not have unit norm."""
    norm = np.linalg.norm(xyzw)
    if norm == 0:
        place = f"nodes[{index}].rotation"
        raise gltf.fault(place, "a quaternion that is not zero", xyzw.tolist())
    x, y, z, w = xyzw / norm
    cross = np.asarray([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross
