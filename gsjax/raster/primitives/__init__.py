"""Primitives: Gaussians and a camera → footprints, splats and channels.

One file per kind of thing that can be drawn. Each offers a
`gsjax.raster.types.Primitive`, which `RasterConfig.primitive` selects; `ellipsoid` is
the default. Lists see only the footprints that a primitive returns, compositing only
its splats and channels.
"""
