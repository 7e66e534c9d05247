"""3D Gaussian splatting in pure JAX: exact, differentiable, tiled."""

from gsjax.cameras import (
    Camera as Camera,
)
from gsjax.cameras import (
    make_camera as make_camera,
)
from gsjax.gaussians import (
    Gaussians as Gaussians,
)
from gsjax.gaussians import (
    make_gaussians as make_gaussians,
)
from gsjax.raster.reference import reference_render as reference_render
from gsjax.raster.render import render as render
from gsjax.raster.render import render_exact as render_exact
from gsjax.raster.types import RasterConfig as RasterConfig
