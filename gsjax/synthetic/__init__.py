"""Generated scenes: a ray-cast still life, a torus knot, and stress scenes.

`raycaster` makes photographs and points to train on, from the solids of `shapes` with
the colours of `albedo`; it does not use Gaussians. `torus_knot` and `stress_scenes`
make Gaussians directly.
"""
