"""The rasteriser: project, bin, composite. Its door is `gsjax.raster.render`."""
