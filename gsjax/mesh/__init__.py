"""Meshes: depth images of a scene → a truncated distance field → triangles.

`fuse` averages the distances that depth images give in a grid of voxels. `surface_of`
runs marching cubes through the field; `largest` keeps the large parts, `filled` closes
holes, and `simplified` reduces the triangles. `write_mesh` writes a file for printing
or viewing.
"""

from gsjax.mesh.fusion import (
    DepthImage,
    Field,
    Grid,
    fuse,
    make_grid,
    make_unbounded_grid,
)
from gsjax.mesh.surface import (
    Mesh,
    filled,
    is_watertight,
    largest,
    read_mesh,
    simplified,
    surface_of,
    write_mesh,
)

__all__ = [
    "DepthImage",
    "Field",
    "Grid",
    "Mesh",
    "filled",
    "fuse",
    "is_watertight",
    "largest",
    "make_grid",
    "make_unbounded_grid",
    "read_mesh",
    "simplified",
    "surface_of",
    "write_mesh",
]
