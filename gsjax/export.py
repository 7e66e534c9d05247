"""A scene to a file for others: thinned out, of another degree."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.errors import InputError
from gsjax.files import make_folder
from gsjax.gaussians import num_active, select, with_sh_degree
from gsjax.io import load, save
from gsjax.subjects import splat_file


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
        return _thinned(path, out, sh_degree, min_opacity)


def _thinned(
    path: Path, out: Path, sh_degree: int | None, min_opacity: float
) -> tuple[int, int]:
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
    if sh_degree is not None:
        gaussians = with_sh_degree(gaussians, sh_degree)
    make_folder(out.parent)
    save(out, gaussians, overwrite=True)
    return written, found
