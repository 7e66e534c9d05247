"""The file of a scene that moves, `motion.npz` of a run: all parameters, by name.

Positions are relative to the ``origin`` in the file, in the units of the dataset.
"""

import io
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import USUAL_EXTENT
from gsjax.errors import InputError
from gsjax.runs.checkpoint import archived_arrays
from gsjax.runtime.files import write_file
from gsjax.train.config import TrainConfig
from gsjax.train.initialisation import blank_gaussians
from gsjax.train.models import ModelParams, SceneParams, init_model
from gsjax.train.motion.scene import MovingScene
from gsjax.train.state import model_of, state_arrays, state_from_arrays

_ORIGIN, _ACTIVE = "origin", ".gaussians.active"


def save_moving(path: Path, scene: MovingScene, origin: np.ndarray) -> None:
    """Write the active Gaussians of a scene and their motion; replaces a file.

    Raises:
      InputError: if the file cannot be written.
    """
    active = np.asarray(scene.params.gaussians.active)
    keep = np.flatnonzero(active)

    def rows(tree: Any) -> Any:
        return jax.tree.map(lambda a: np.asarray(a)[keep], tree)

    model = scene.params.model
    model = ModelParams(rows(model.slots), model.shared, rows(model.buffers))
    kept = SceneParams(rows(scene.params.gaussians), model)
    buffer = io.BytesIO()
    arrays = state_arrays(kept) | {_ORIGIN: np.asarray(origin, np.float64)}
    np.savez(buffer, **arrays)  # pyright: ignore
    write_file(path, buffer.getvalue())


def load_moving(path: Path, config: TrainConfig, origin: np.ndarray) -> MovingScene:
    """Read the scene of a run, in coordinates relative to ``origin`` [3].

    Args:
      path, config: the file, and the settings of its run.
      origin: subtracted from the coordinates of the dataset's files.

    Raises:
      InputError: if the file is missing or damaged, or of other settings.
    """
    arrays = archived_arrays(path, "the motion of a run")
    own = arrays.pop(_ORIGIN, np.zeros(0))
    if own.shape != (3,) or own.dtype != np.float64 or _ACTIVE not in arrays:
        fault = f"{_ORIGIN} or {_ACTIVE} is missing"
        raise InputError(f"{path}: damaged: {fault}; resume the run to write it again")
    count = int(arrays[_ACTIVE].size)
    model = model_of(config, USUAL_EXTENT)

    def template() -> SceneParams:
        gaussians = blank_gaussians(count, config.sh_degree)
        return SceneParams(gaussians, init_model(model, gaussians))

    like = jax.eval_shape(template)
    params = state_from_arrays(str(path), arrays, like)
    bad = [k for k, a in arrays.items() if a.dtype.kind == "f" and not _finite(a)]
    if bad:
        remedy = "resume the run to write it again"
        raise InputError(f"{path}: damaged: {bad[0]} is not finite; {remedy}")
    offset = own - np.asarray(origin, np.float64)
    return MovingScene(config.motion, _shifted(params, offset))


def _finite(array: np.ndarray) -> bool:
    return bool(np.isfinite(array).all())


def _shifted(params: SceneParams, offset: np.ndarray) -> SceneParams:
    """Add an offset [3] to all positions, in float64."""
    if not np.any(offset):
        return params

    def moved(positions: jax.Array) -> jax.Array:
        wide = np.asarray(positions, np.float64) + offset
        return jnp.asarray(wide, positions.dtype)

    gaussians, model = params.gaussians, params.model
    still = gaussians.params.replace(means=moved(gaussians.params.means))  # pyright: ignore
    if isinstance(model.shared, dict) and "box" in model.shared:
        shared = {**model.shared, "box": moved(model.shared["box"])}
        model = model._replace(shared=shared)
    return params._replace(
        gaussians=gaussians.replace(params=still),  # pyright: ignore
        model=model,
    )
