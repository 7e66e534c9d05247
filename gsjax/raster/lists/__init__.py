"""Lists: footprints → depth order → sorted tile lists. No derivative is taken here.

`occlusion_culling` and `depth_order` decide which Gaussians are drawn, front to back.
`binning` finds the tiles that each footprint meets, `tile_lists` builds one sorted list
per tile. Everything here sees bounds and footprints only, never Gaussians or cameras.
"""
