"""Captured photographs, their cameras and points, from the formats of other programs.

`dataset.load_dataset` picks a `Reader` (`readers.READERS`: COLMAP, transforms.json,
LLFF), which lists the views; `photos.load_photos` then decodes, undistorts and scales
the images. `arrays.make_dataset` makes the same from arrays in memory. Everything here
runs on the host in float64; cameras are world → camera in OpenCV axes.
"""
