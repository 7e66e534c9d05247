"""Meshes: depth images of a scene → a truncated distance field → triangles.

`fuse` averages the distances that depth images give in a grid of voxels. `surface_of`
runs marching cubes through the field, and `cleaned` keeps the large parts, fills holes
and reduces the triangles. `write_mesh` writes a file for printing or viewing.
"""
