"""Structure from motion with COLMAP: photographs or a video to a dataset with cameras.

`reconstruction.run_sfm` runs the steps: `photos` (decode, scale, masks) → `mapping`
(features, matching, incremental mapping; COLMAP itself runs through `engine`) →
`output` (undistort and write the dataset).
"""
