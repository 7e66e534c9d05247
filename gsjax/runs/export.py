"""A scene to a file for others: thinned out, of another degree."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, num_active, select, with_sh_degree
from gsjax.io import load, save
from gsjax.io.spz import write_spz
from gsjax.runs.folder import load_settings
from gsjax.runs.scene_source import is_run, splat_file
from gsjax.runtime.files import make_folder


def export_scene(
    source: Path,
    out: Path,
    *,
    sh_degree: int | None = None,
    min_opacity: float = 0.0,
    overwrite: bool = False,
) -> tuple[int, int]:
    """Write the Gaussians of a file or run to ``out``, in the coordinates they have.

    Args:
      source: a .ply or .spz file, or the folder of a run.
      out: the file; its folder is created if missing.
      sh_degree: of what is written; bands are cut, or added as zeros.
      min_opacity: what is less opaque is left out.
      overwrite: whether a file that exists may be replaced.

    Returns:
      How many were written, and how many there were.

    Raises:
      InputError: if a file cannot be read or written, exists and ``overwrite`` is not
        set, or nothing would be left.
    """
    if out.exists() and not overwrite:
        raise InputError(f"{out}: exists; pass --overwrite, or another name")
    path = splat_file(source)
    with jax.enable_x64(True):  # what is stored in float64 stays so
        gaussians, found = _thinned(path, min_opacity)
        if sh_degree is not None:
            gaussians = with_sh_degree(gaussians, sh_degree)
        if out.suffix.lower() != ".ply":  # which others do not hold
            turned = np.any(np.asarray(gaussians.params.quats) != 0, axis=1)
            gaussians = select(gaussians, jnp.asarray(turned))
        make_folder(out.parent)
        if out.suffix.lower() == ".spz":
            antialias = is_run(source) and load_settings(source).config.raster.antialias
            write_spz(out, gaussians, overwrite=True, antialias=antialias)
        else:
            save(out, gaussians, overwrite=True)
        return int(num_active(gaussians)), found


def _thinned(path: Path, min_opacity: float) -> tuple[Gaussians, int]:
    """Those of a file that are so opaque, and how many there were."""
    gaussians = load(path)
    found = int(num_active(gaussians))
    logits = np.asarray(gaussians.params.logit_opacities, np.float64)
    with np.errstate(over="ignore"):
        opacities = 1 / (1 + np.exp(-logits))
    gaussians = select(gaussians, jnp.asarray(opacities >= min_opacity))
    written = int(num_active(gaussians))
    if found and not written:
        raise InputError(
            f"{path}: none of {found:,} Gaussians has an opacity of {min_opacity:g}; "
            f"the greatest is {opacities.max():.3g}"
        )
    return gaussians, found
