"""What a caller passes: to `render`, its shape checked, and with the leading axis of a
batch; and to whoever decides by numbers, that they are known. Each raises InputError
if a shape does not fit, or a number is complex, or not known.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import jax
import jax.numpy as jnp

from gsjax.cameras.camera import Camera
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians
from gsjax.math.sh import degree_of
from gsjax.raster.types import Array, RasterConfig

_UNKNOWN = jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError


@contextmanager
def requires_concrete_values() -> Iterator[None]:
    """Within, or of a function that this decorates: InputError says what to do under a
    transformation that leaves numbers open.
    """
    try:
        yield
    except _UNKNOWN as error:
        raise InputError(
            "render_exact, exact_config and plan decide by numbers, which are not "
            "known under jax.jit, vmap or scan: call them before, and inside render "
            "with the config that exact_config or plan gave"
        ) from error


def check_gaussians(gaussians: Gaussians) -> None:
    """A row of every parameter for each slot: JAX takes the last for what is beyond."""
    active, params = gaussians.active, gaussians.params
    if active.ndim != 1 or active.dtype != bool:
        raise InputError(
            f"active has shape {active.shape} of {active.dtype}; (N,) of bool is "
            "wanted: jax.vmap goes over several scenes"
        )
    slots = gaussians.capacity
    if slots < 1:
        raise InputError("there are no slots: at least one is wanted")
    bases = params.sh.shape[1] if params.sh.ndim == 3 else "K"
    wanted = {
        "means": (slots, 3),
        "quats": (slots, 4),
        "log_scales": (slots, 3),
        "logit_opacities": (slots,),
        "sh": (slots, bases, 3),
    }
    for name, shape in wanted.items():
        array = getattr(params, name)
        if array.shape != shape:
            raise InputError(
                f"{name} has shape {array.shape}; {shape} is wanted, of {slots} slots"
            )
        check_real(name, array)
    degree_of(params.sh.shape[1])


def check_camera(camera: Camera) -> None:
    batch = camera.viewmat.shape[:-2]
    wanted = {"viewmat": (*batch, 4, 4), "K": (*batch, 3, 3), "near": batch}
    for name, shape in {**wanted, "far": batch}.items():
        array = getattr(camera, name)
        if jnp.shape(array) != shape or len(batch) > 1:
            raise InputError(
                f"{name} of the camera has shape {jnp.shape(array)}; one camera, or a "
                "batch with a leading axis on every array, is wanted: see make_camera"
            )
        check_real(name, array)
    if 0 in batch:
        raise InputError("there are no cameras: at least one is wanted")


def check_config(config: RasterConfig) -> None:
    if not isinstance(config, RasterConfig):
        raise InputError(
            f"config is of {type(config).__name__}; a RasterConfig is wanted, and the "
            "background after it"
        )


def check_real(name: str, array) -> None:
    if jnp.issubdtype(jnp.result_type(array), jnp.complexfloating):
        raise InputError(f"{name} is complex; pass real numbers")


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
    check_real("features", features)
