"""Checks of the arguments of `render` and of functions that need concrete values."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp

from gsjax.cameras.camera import Camera
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians
from gsjax.math.sh import degree_of
from gsjax.raster.types import Array, Inputs, RasterConfig

_UNKNOWN = jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError


@contextmanager
def requires_concrete_values() -> Iterator[None]:
    """Turn errors about traced values into an InputError that names the remedy."""
    try:
        yield
    except _UNKNOWN as error:
        raise InputError(
            "render_exact, exact_config and plan need concrete values; call them "
            "outside jit, vmap and scan, and pass the config that exact_config or plan "
            "returns to render"
        ) from error


def check_types(gaussians: Any, camera: Any, config: Any) -> None:
    """Check the classes of the arguments of `render`.

    Raises:
      InputError: if one is of another class, with the likely remedy.
    """
    if not isinstance(gaussians, Gaussians):
        raise InputError(
            f"gaussians: expected gsjax.Gaussians, got {_told(gaussians)}; build them "
            "with gsjax.make_gaussians or gsjax.load"
        )
    if not isinstance(camera, Camera):
        several = isinstance(camera, (list, tuple))
        remedy = "stack them with gsjax.stack_cameras" if several else (
            "build it with gsjax.make_camera"
        )  # fmt: skip
        raise InputError(
            f"camera: expected gsjax.Camera, got {_told(camera)}; {remedy}"
        )
    if not isinstance(config, RasterConfig):
        raise InputError(
            f"config: expected gsjax.RasterConfig, got {_told(config)}; the background "
            "is the argument behind it"
        )


def _told(value: Any) -> str:
    if isinstance(value, (list, tuple)) and value:
        return f"a {type(value).__name__} of {type(value[0]).__name__}"
    return type(value).__name__


def check_gaussians(gaussians: Gaussians) -> None:
    """Check that every parameter has one row per slot.

    JAX reads the last row for indices beyond the end, so a short array would pass.
    """
    active, params = gaussians.active, gaussians.params
    if active.ndim != 1 or active.dtype != bool:
        raise InputError(
            f"active: expected bool of shape (N,), got {active.dtype} of shape "
            f"{active.shape}; use jax.vmap for several scenes"
        )
    slots = gaussians.capacity
    if slots < 1:
        raise InputError("gaussians: expected at least one slot, got none")
    bases = params.sh.shape[1] if params.sh.ndim == 3 else "K"
    shapes = {
        "means": (slots, 3),
        "quats": (slots, 4),
        "log_scales": (slots, 3),
        "logit_opacities": (slots,),
        "sh": (slots, bases, 3),
    }
    for name, shape in shapes.items():
        array = getattr(params, name)
        if array.shape != shape:
            raise InputError(f"{name}: expected shape {shape}, got {array.shape}")
        check_real(name, array)
    degree_of(params.sh.shape[1])


def check_camera(camera: Camera) -> None:
    """Check the shapes of a camera, which may not come from `make_camera`."""
    batch = camera.viewmat.shape[:-2]
    shapes = {"viewmat": (*batch, 4, 4), "K": (*batch, 3, 3), "near": batch}
    for name, shape in {**shapes, "far": batch}.items():
        array = getattr(camera, name)
        if jnp.shape(array) != shape or len(batch) > 1:
            raise InputError(
                f"camera: expected one camera or a batch with a leading axis on every "
                f"array, got {name} of shape {jnp.shape(array)}; see make_camera"
            )
        check_real(name, array)
    if 0 in batch:
        raise InputError("camera: expected at least one camera, got an empty batch")
    visible = camera.visible_size
    if visible is not None and jnp.shape(visible) != (*batch, 2):
        raise InputError(
            f"visible_size: expected shape {(*batch, 2)}, got {jnp.shape(visible)}"
        )


def check_real(name: str, array) -> None:
    """Check that an array is not complex."""
    if jnp.issubdtype(jnp.result_type(array), jnp.complexfloating):
        raise InputError(f"{name}: expected real numbers, got complex ones")


def batched_inputs(inputs: Inputs) -> Inputs:
    """Return checked inputs; those that differ by camera gain a leading axis B.

    Raises:
      InputError: if a shape does not match.
    """
    gaussians, camera = inputs.gaussians, inputs.camera
    check_camera(camera)
    check_gaussians(gaussians)
    batch = camera.viewmat.shape[:-2]
    probe, mask, features = inputs.probe, inputs.mask, inputs.features
    if probe is not None:
        _require_shape("probe", probe, (*batch, gaussians.capacity, 2))
    if mask is not None:
        _require_shape("mask", mask, (*batch, camera.height, camera.width))
        if mask.dtype != bool:
            raise InputError(f"mask: expected bool, got {mask.dtype}")
    if features is not None:
        shape = features.shape
        if len(shape) != 2 or shape[0] != gaussians.capacity or shape[1] < 1:
            raise InputError(
                f"features: expected shape ({gaussians.capacity}, C), got {shape}"
            )
        check_real("features", features)
    if camera.visible_size is not None:
        size = jnp.asarray(camera.visible_size).astype(camera.K.dtype)
        camera = camera.replace(visible_size=size)
    by_camera = (camera, probe, mask)
    if not camera.batched:
        by_camera = jax.tree.map(lambda a: a[None], by_camera)
    camera, probe, mask = by_camera
    return inputs._replace(camera=camera, probe=probe, mask=mask)


def _require_shape(name: str, array: Array, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise InputError(f"{name}: expected shape {shape}, got {array.shape}")
