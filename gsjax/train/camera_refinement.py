"""Small corrections of the cameras and of the exposures, learnt along with the scene.

Axis legend: V views, B views of a step, H W image.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import optax

from gsjax.cameras.camera import Camera
from gsjax.math.rotations import quaternion_to_matrix
from gsjax.train.config import TrainConfig

Array = jax.Array
_ADAM = optax.scale_by_adam(eps=1e-15)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CameraRefinement:
    """Corrections; those that are not learnt are None, all others start at nothing.

    Attributes:
      turns: [V, 3] rotation of the camera, as half the vector part of a quaternion.
      shifts: [V, 3] of the camera, in camera axes and in extents of the scene.
      intrinsics: [4] logarithm of the factor on each focal length, and shift of the
        principal point in focal lengths, as given; one for all views. (Not in sizes of
        the image, which is padded in a batch of photographs of several sizes.)
      exposures: [V, 3, 4] affine map of the colours, minus the identity.
    """

    turns: Array | None = None
    shifts: Array | None = None
    intrinsics: Array | None = None
    exposures: Array | None = None


def init_refinement(config: TrainConfig, views: int) -> CameraRefinement:
    """Nothing corrected yet; of the kinds that the settings ask for."""
    # Each its own array: a step that is donated takes none twice.
    return CameraRefinement(
        turns=jnp.zeros((views, 3)) if config.refine_poses else None,
        shifts=jnp.zeros((views, 3)) if config.refine_poses else None,
        intrinsics=jnp.zeros(4) if config.refine_intrinsics else None,
        exposures=jnp.zeros((views, 3, 4)) if config.exposure else None,
    )


def init_refinement_moments(refinement: CameraRefinement) -> optax.ScaleByAdamState:
    """Zero moments."""
    return _ADAM.init(refinement)  # pyright: ignore


def refinement_step(
    refinement: CameraRefinement, grads: CameraRefinement, moments, config: TrainConfig
):
    """One step of Adam; returns (refinement, moments)."""
    updates, moments = _ADAM.update(grads, moments)  # pyright: ignore
    rates = {
        "turns": config.pose_rate,
        "shifts": config.pose_rate,
        "intrinsics": config.intrinsics_rate,
        "exposures": config.exposure_rate,
    }
    moved = {
        name: None if value is None else value - rates[name] * getattr(updates, name)
        for name, value in vars(refinement).items()
    }
    return CameraRefinement(**moved), moments


def refine_camera(
    camera: Camera, refinement: CameraRefinement, index: Array, extent: float
) -> Camera:
    """The cameras of a batch, corrected; ``index`` [B] says which views they are."""
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
    return Camera(viewmat, K, camera.near, camera.far, camera.width, camera.height,
                  camera.model)  # fmt: skip


def exposed(
    images: Array,
    refinement: CameraRefinement,
    index: Array,
    alphas: Array | None = None,
) -> Array:
    """Renders as the photographs' exposures would show them.

    Args:
      images: [B, H, W, 3].
      refinement: with the exposures.
      index: [B], which views they are.
      alphas: [B, H, W] opacities of images over black; None where nothing shows
        through.
    """
    if refinement.exposures is None:
        return images
    affine = refinement.exposures[index]
    colour = jnp.einsum("bij,bhwj->bhwi", affine[:, :, :3], images, precision="highest")
    added = affine[:, None, None, :, 3]
    return images + colour + (added if alphas is None else alphas[..., None] * added)
