"""The rasteriser: Gaussians and a camera → images.

`render` is the door. Data flows one way: `primitives` project Gaussians to footprints,
splats and channels; `lists` order the footprints and list them per tile; `compositing`
blends splats and channels along the lists. `render_camera` chains the stages for one
camera, and `tile_render` spreads tiles over devices. `exact` fits capacities on the
host. `reference` is the dense float64 oracle.
"""
