"""Cameras: where a pixel looks.

`camera` holds the pytree: pose, intrinsics, lens coefficients and depth range. `lenses`
holds one function set per lens, used by the renderer and by undistortion. `shutter`
says which pose a point is seen from. `distortion` resamples photographs to a pinhole.
"""
