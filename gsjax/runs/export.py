"""Export of a scene to another file, optionally pruned or with another SH degree."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, num_active, select, with_sh_degree
from gsjax.io.formats import keeps_every_bit, load, render_mode, save
from gsjax.runs.folder import load_settings
from gsjax.runs.scene_source import is_run, splat_file
from gsjax.runtime.files import make_folder, reject_existing
from gsjax.train.config import render_mode_of


def export_scene(
    source: Path,
    out: Path,
    *,
    sh_degree: int | None = None,
    min_opacity: float = 0.0,
    overwrite: bool = False,
) -> tuple[int, int]:
    """Write the Gaussians of a file or run to ``out``, in their own coordinates.

    Args:
      source: a file of Gaussians, or the folder of a run.
      out: the file; its folder is created if missing.
      sh_degree: SH degree to write: higher bands are dropped, missing ones zero.
      min_opacity: Gaussians below this opacity are left out.
      overwrite: replace an existing file.

    Returns:
      The numbers of Gaussians written and read.

    Raises:
      InputError: if a file cannot be read or written, or exists without ``overwrite``,
        or no Gaussian reaches ``min_opacity``.
    """
    reject_existing([out], overwrite)
    path = splat_file(source)
    with jax.enable_x64(True):  # keeps float64 files exact
        gaussians, found = _load_opaque(path, min_opacity)
        if sh_degree is not None:
            gaussians = with_sh_degree(gaussians, sh_degree)
        if not keeps_every_bit(out):  # such formats cannot hold zero quaternions
            rotated = np.any(np.asarray(gaussians.params.quats) != 0, axis=1)
            gaussians = select(gaussians, jnp.asarray(rotated))
        make_folder(out.parent)
        save(out, gaussians, overwrite=True, mode=scene_mode(source))
        return int(num_active(gaussians)), found


def scene_mode(source: Path) -> str | None:
    """Return the render mode of a run or file."""
    if is_run(source):
        return render_mode_of(load_settings(source).config.raster)
    return render_mode(source)  # also a word that is not ours


def _load_opaque(path: Path, min_opacity: float) -> tuple[Gaussians, int]:
    """Return the Gaussians of at least this opacity, and the number in the file."""
    gaussians = load(path)
    found = int(num_active(gaussians))
    logits = np.asarray(gaussians.params.logit_opacities, np.float64)
    with np.errstate(over="ignore"):
        opacities = 1 / (1 + np.exp(-logits))
    gaussians = select(gaussians, jnp.asarray(opacities >= min_opacity))
    if found and not int(num_active(gaussians)):
        fault = f"none of {found:,} Gaussians has an opacity of {min_opacity:g}"
        most = f"the greatest is {opacities.max():.3g}; lower --min-opacity"
        raise InputError(f"{path}: {fault}; {most}")
    return gaussians, found
