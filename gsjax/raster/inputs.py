"""What a caller passes to `render` beside scene and camera: its shape checked, and with
the leading axis of a batch. Each raises InputError if a shape does not fit.
"""

from gsjax.cameras import Camera
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians
from gsjax.raster.types import Array


def with_batch(name: str, probe, gaussians: Gaussians, camera: Camera):
    """``probe`` as [B, N, 2], or None."""
    if probe is None:
        return None
    wanted = (*camera.viewmat.shape[:-2], gaussians.capacity, 2)
    if probe.shape != wanted:
        raise InputError(f"{name} has shape {probe.shape}; {wanted} is wanted")
    return probe if camera.batched else probe[None]


def checked_mask(mask: Array | None, camera: Camera) -> Array | None:
    """``mask`` as [B, H, W], or None."""
    if mask is None:
        return None
    wanted = (*camera.viewmat.shape[:-2], camera.height, camera.width)
    if mask.shape != wanted or mask.dtype != bool:
        raise InputError(
            f"mask has shape {mask.shape} of {mask.dtype}; {wanted} of bool is wanted"
        )
    return mask if camera.batched else mask[None]


def checked_size(size: Array | None, camera: Camera) -> Array | None:
    """``size`` as [B, 2], or None."""
    if size is None:
        return None
    wanted = (*camera.viewmat.shape[:-2], 2)
    if size.shape != wanted:
        raise InputError(f"size has shape {size.shape}; {wanted} is wanted")
    return size if camera.batched else size[None]


def check_features(features, gaussians: Gaussians) -> None:
    if features is None:
        return
    shape = features.shape
    if len(shape) != 2 or shape[0] != gaussians.capacity or shape[1] < 1:
        raise InputError(
            f"features has shape {shape}; ({gaussians.capacity}, C) is wanted, C ≥ 1"
        )
