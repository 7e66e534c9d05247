"""Corrections of cameras and exposures, optimised with the scene.

Axis legend: V views, B views of a step, H W image.
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp

from gsjax.cameras.camera import Camera
from gsjax.math.rotations import quaternion_to_matrix
from gsjax.train.config import TrainConfig

Array = jax.Array
_COEFFICIENTS = 12  # the largest number of any lens that is optimised


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CameraRefinement:
    """Corrections; zero is no correction, None is not optimised.

    Attributes:
      turns: [V, 3] rotation of the camera, as half the vector part of a quaternion.
      shifts: [V, 3] translation in camera axes, in scene extents.
      intrinsics: [4] log factors of both focal lengths, and shift of the principal
        point in focal lengths; shared by all views. Focal lengths are the unit because
        images of several sizes are padded to one.
      distortion: [12] added to the coefficients of the lens, as many as it has; shared
        by all views.
      twists: [V, 6] added to the motion during the exposure; the translations are in
        scene extents.
      exposures: [V, 3, 4] affine map of the colours, minus the identity.
    """

    turns: Array | None = None
    shifts: Array | None = None
    intrinsics: Array | None = None
    distortion: Array | None = None
    twists: Array | None = None
    exposures: Array | None = None


def init_refinement(config: TrainConfig, views: int) -> CameraRefinement:
    """Return zero corrections of the kinds that ``config`` enables."""
    poses, intrinsics = config.refine_poses, config.refine_intrinsics
    # Distinct arrays: a buffer can be donated only once.
    return CameraRefinement(
        turns=jnp.zeros((views, 3)) if poses else None,
        shifts=jnp.zeros((views, 3)) if poses else None,
        intrinsics=jnp.zeros(4) if intrinsics else None,
        distortion=jnp.zeros(_COEFFICIENTS) if intrinsics else None,
        twists=jnp.zeros((views, 6)) if config.refine_shutter else None,
        exposures=jnp.zeros((views, 3, 4)) if config.exposure else None,
    )


def refine_camera(
    camera: Camera, refinement: CameraRefinement, index: Array, extent: float
) -> Camera:
    """Return B cameras, corrected as the views ``index`` [B] int32.

    The scene extent is in world units.
    """
    viewmat, K = camera.viewmat, camera.K
    if refinement.turns is not None and refinement.shifts is not None:
        turns = refinement.turns[index]
        quats = jnp.concatenate([jnp.ones_like(turns[:, :1]), turns], -1)
        rotation = quaternion_to_matrix(quats)
        top = jnp.einsum("bij,bjk->bik", rotation, viewmat[:, :3], precision="highest")
        top = top.at[:, :, 3].add(extent * refinement.shifts[index])
        viewmat = jnp.concatenate([top, viewmat[:, 3:]], 1)
    if refinement.intrinsics is not None:
        factor = jnp.exp(refinement.intrinsics[:2])
        focal = jnp.stack([K[:, 0, 0], K[:, 1, 1]], -1)
        K = K.at[:, 0, 0].multiply(factor[0]).at[:, 1, 1].multiply(factor[1])
        K = K.at[:, :2, 2].add(focal * refinement.intrinsics[2:])
    c, twist = camera.coefficients, camera.twist
    if refinement.distortion is not None and c is not None:
        c = c + refinement.distortion[: c.shape[-1]]
    if refinement.twists is not None and twist is not None:
        scale = jnp.asarray([1.0, 1, 1, extent, extent, extent], twist.dtype)
        twist = twist + scale * refinement.twists[index]
    return replace(camera, viewmat=viewmat, K=K, coefficients=c, twist=twist)


def apply_exposure(
    images: Array, refinement: CameraRefinement, index: Array, alphas: Array | None
) -> Array:
    """Return renders with the exposure corrections of their photographs.

    Args:
      images: [B, H, W, 3].
      refinement: corrections of V views.
      index: [B] int32, the view of each image.
      alphas: [B, H, W] opacities if the images are over black; None if they are
        opaque.
    """
    if refinement.exposures is None:
        return images
    affine = refinement.exposures[index]
    colour = jnp.einsum("bij,bhwj->bhwi", affine[:, :, :3], images, precision="highest")
    added = affine[:, None, None, :, 3]
    return images + colour + (added if alphas is None else alphas[..., None] * added)
