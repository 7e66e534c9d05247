"""Run time against error of a renderer's settings, behind `gsjax bench`.

`scenes` opens a scene with a camera, `pareto` times settings and measures their errors
against the exact image, `pixelwise` computes the error that theory allows at a pixel,
and `report` prints and draws the rows.
"""
