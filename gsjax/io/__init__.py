"""Gaussians, images and movies from and to files.

`formats` loads and saves Gaussians. Each format is one module (`ply`, `spz`, `splat`,
…) and one entry of `formats.FORMATS`. `point_cloud` reads coloured points, `images` and
`movies` encode the images of a render, and `npy` and `numerals` parse arrays. Readers
compare the sizes that a file declares with its real size before they allocate memory.
"""
