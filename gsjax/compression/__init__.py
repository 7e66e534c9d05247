"""Compression: fewer Gaussians and coarser numbers, for a stated loss or size.

`compress` is the door. `importance` measures how much each Gaussian and each of its
numbers changes the pictures of some cameras. `lattices` holds the numbers that a file
format can store. `quantise` leaves out Gaussians and rounds numbers wherever that saves
more bits than it costs in error, by one price of a bit. `search` finds the price that
meets the loss or the size, measured on the file read back (`measure`).
"""
