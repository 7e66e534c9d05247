"""Triangles of a distance field, cleaned, and written to files.

Axis legend: V vertices, F triangles.
"""

from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from gsjax.errors import InputError, MissingExtraError
from gsjax.mesh.fusion import Field
from gsjax.runtime.files import replacing

SUFFIXES = (".ply", ".glb", ".obj", ".stl")


class Mesh(NamedTuple):
    """A triangle mesh.

    Attributes:
      vertices: [V, 3] world coordinates.
      faces: [F, 3] int32 indices, counter-clockwise seen from outside.
      colors: [V, 3] in 0 … 1, or None.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray | None = None


def surface_of(field: Field, *, least: int = 1, closed: bool = False) -> Mesh:
    """Return the surface where the distance is 0, by marching cubes.

    Args:
      field: from `gsjax.mesh.fusion.fuse`.
      least: images that must have seen all voxels around a triangle; others are left
        out. Ignored if ``closed``.
      closed: make a solid: what lies behind a surface in the images is inside, and all
        else that no image has seen is outside. The surface is then watertight, and
        closes where nothing was seen.

    Raises:
      InputError: if there is no surface.
      MissingExtraError: if PyMCubes is not installed.
    """
    mcubes = _package("mcubes", "PyMCubes")
    distance = np.asarray(field.distance, np.float32)
    if closed:
        distance = np.where(field.inside, np.float32(-1), distance)
    padded = np.pad(distance, 1, constant_values=1)
    vertices, faces = mcubes.marching_cubes(padded, 0.0)
    vertices, faces = vertices - 1, faces.astype(np.int32)[:, ::-1]
    if len(faces) and not closed:
        seen = np.asarray(field.weight) >= least
        faces = faces[_observed(seen, vertices)[faces].all(1)]
    if not len(faces):
        raise InputError(
            "field: no surface in the box; check that the box holds the object, and "
            "that the depth images agree"
        )
    colors = None
    if field.colors is not None:
        channels = np.moveaxis(np.asarray(field.colors), -1, 0)
        colors = np.stack(
            [map_coordinates(c, vertices.T, order=1, mode="nearest") for c in channels],
            -1,
        )
    return _used(Mesh(field.grid.places(vertices), faces, colors))


def _observed(seen: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Return which vertices [V] lie between voxels that were seen."""
    low = np.floor(vertices).astype(int)
    good = np.ones(len(vertices), bool)
    for step in range(2):
        corner = np.where(vertices > low, low + step, low)
        inside = ((corner >= 0) & (corner < seen.shape)).all(1)
        corner = np.clip(corner, 0, np.array(seen.shape) - 1)
        good &= inside & seen[tuple(corner.T)]
    return good


def _used(mesh: Mesh) -> Mesh:
    """Leave out vertices of no triangle."""
    used, faces = np.unique(mesh.faces, return_inverse=True)
    colors = None if mesh.colors is None else mesh.colors[used]
    return Mesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32), colors)


def components(mesh: Mesh) -> np.ndarray:
    """Return the number of the connected part of each triangle [F], largest first."""
    count, (a, b, c) = len(mesh.vertices), mesh.faces.T
    rows, columns = np.concatenate([a, b]), np.concatenate([b, c])
    links = coo_matrix((np.ones(len(rows), bool), (rows, columns)), (count, count))
    _, labels = connected_components(links, directed=False)
    of_faces = labels[a]
    order = np.argsort(-np.bincount(of_faces, minlength=labels.max() + 1))
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return rank[of_faces]


def largest(mesh: Mesh, count: int) -> Mesh:
    """Return the ``count`` parts with the most triangles."""
    return _used(mesh._replace(faces=mesh.faces[components(mesh) < count]))


def filled(mesh: Mesh) -> Mesh:
    """Close each hole by triangles about the mean of its border.

    Flat or bowl-shaped holes close well; of a border that winds, triangles may cross.

    Raises:
      MissingExtraError: if trimesh is not installed.
    """
    repair = _package("trimesh", "trimesh").repair
    if is_watertight(mesh):
        return mesh
    solid = as_trimesh(mesh._replace(colors=None))
    fans, centres = repair.stitch(solid, insert_vertices=True)
    vertices = np.concatenate([mesh.vertices, centres])
    faces = np.concatenate([mesh.faces, fans]).astype(np.int32)
    colors = mesh.colors
    if colors is not None:
        near = KDTree(mesh.vertices).query(centres)[1]
        colors = np.concatenate([colors, colors[near]])
    return Mesh(vertices, faces, colors)


def simplified(mesh: Mesh, triangles: int) -> Mesh:
    """Return a mesh with about that many triangles, by edge collapses.

    Quadric error metrics (Garland and Heckbert 1997); a vertex takes the colour of the
    nearest one. A mesh with fewer triangles is returned as it is.

    Raises:
      MissingExtraError: if fast-simplification is not installed.
    """
    if len(mesh.faces) <= triangles:
        return mesh
    simplify = _package("fast_simplification", "fast-simplification").simplify
    low = mesh.vertices.mean(0)  # float32 below
    points, faces = simplify(
        (mesh.vertices - low).astype(np.float32), mesh.faces, target_count=triangles
    )
    vertices, colors = points + low, mesh.colors
    if colors is not None:
        colors = colors[KDTree(mesh.vertices).query(vertices)[1]]
    return _used(Mesh(vertices, faces.astype(np.int32), colors))


def is_watertight(mesh: Mesh) -> bool:
    """Return whether triangles meet at each edge as often in either direction.

    Then nothing is open. Sheets may touch at an edge, as after edge collapses.
    """
    forward = np.concatenate([mesh.faces[:, [i, (i + 1) % 3]] for i in range(3)])
    low, high = forward.min(1), forward.max(1)
    way = np.where(forward[:, 0] == low, 1, -1)
    _, edge = np.unique(low * np.int64(len(mesh.vertices)) + high, return_inverse=True)
    return not np.bincount(edge, way).any()


def write_mesh(
    path: str | PathLike[str], mesh: Mesh, *, overwrite: bool = False
) -> None:
    """Write a mesh as .ply, .glb, .obj or .stl; .stl has no colours.

    Raises:
      InputError: if the suffix is another, or the file exists without ``overwrite``.
      MissingExtraError: if trimesh is not installed.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(
            f"{path}: expected a suffix of {', '.join(SUFFIXES)}, got {path.suffix!r}"
        )
    if path.exists() and not overwrite:
        raise InputError(f"{path}: exists; pass overwrite=True or another name")
    content = as_trimesh(mesh).export(file_type=path.suffix.lower()[1:])
    with replacing(path, durable=True) as file:
        file.write(content if isinstance(content, bytes) else content.encode())


def read_mesh(path: str | PathLike[str]) -> Mesh:
    """Read a mesh that `write_mesh` wrote, or another of these formats.

    Raises:
      InputError: if there is no such file, or it is not a triangle mesh.
      MissingExtraError: if trimesh is not installed.
    """
    trimesh = _package("trimesh", "trimesh")
    try:
        read = trimesh.load_mesh(Path(path), process=False)
        vertices, faces = np.asarray(read.vertices), np.asarray(read.faces, np.int32)
    except (OSError, ValueError, KeyError, AttributeError, IndexError) as error:
        raise InputError(f"{path}: not read as a mesh: {error}") from error
    if not len(faces):
        raise InputError(f"{path}: has no triangles")
    colors = None
    if read.visual.kind == "vertex":
        colors = np.asarray(read.visual.vertex_colors)[:, :3] / 255
    return Mesh(vertices, faces, colors)


def as_trimesh(mesh: Mesh):
    """Return a `trimesh.Trimesh` with the same vertices, triangles and colours.

    Raises:
      MissingExtraError: if trimesh is not installed.
    """
    trimesh = _package("trimesh", "trimesh")
    colors = None if mesh.colors is None else _bytes(mesh.colors)
    return trimesh.Trimesh(
        mesh.vertices, mesh.faces, vertex_colors=colors, process=False
    )


def _bytes(colors: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(255 * colors), 0, 255).astype(np.uint8)


def _package(module: str, name: str):
    """Import an optional package.

    Raises:
      MissingExtraError: if it is not installed.
    """
    try:
        return __import__(module)
    except ImportError as error:
        raise MissingExtraError(
            f"meshes need {name}; pip install 'gsjax[mesh]'"
        ) from error
