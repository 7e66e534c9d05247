"""Initialisation: points of a dataset, found points or random points → Gaussians.

`plane_sweep` finds the depth map of one view; `dense` sweeps many views and keeps the
points that several of them confirm; `gaussians` turns points into Gaussians.
"""
