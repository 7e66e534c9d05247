"""The primitives that `RasterConfig.primitive` names."""

from gsjax.raster.config import PRIMITIVES, RasterConfig
from gsjax.raster.primitives.ellipsoid import ELLIPSOID
from gsjax.raster.primitives.surfel import SURFEL, SURFEL_AREA
from gsjax.raster.types import Primitive

_NAMED: dict[str, Primitive] = {
    primitive.name: primitive for primitive in (ELLIPSOID, SURFEL, SURFEL_AREA)
}
assert tuple(_NAMED) == PRIMITIVES


def with_primitive(config: RasterConfig) -> RasterConfig:
    """Return ``config`` with the `Primitive` in place of its name."""
    primitive = config.primitive
    if isinstance(primitive, Primitive):
        return config
    plain = primitive in (None, ELLIPSOID.name)
    plain &= not config.blends_ray_depth and not config.sorts_pixels
    named = None if plain else _NAMED[primitive or ELLIPSOID.name]
    return config.replace(primitive=named)
