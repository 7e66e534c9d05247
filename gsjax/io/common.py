"""What the formats of Gaussians have in common."""

import warnings
from pathlib import Path

import numpy as np

from gsjax.errors import InputError
from gsjax.gaussians import Gaussians

MAX_SHIFT = 0.1  # of a Gaussian's size by rounding, before it is told
_TINY = np.finfo(np.float64).tiny


def warn(message: str) -> None:
    """Warn on behalf of the caller of the calling function."""
    warnings.warn(message, UserWarning, stacklevel=3)


def require_new(path: Path, overwrite: bool) -> None:
    """See that a file may be written.

    Raises:
      InputError: if it exists and ``overwrite`` is not set, or is a folder, or its
        folder is missing.
    """
    if path.is_dir():
        raise InputError(f"{path}: is a folder; pass the name of a file")
    if path.exists() and not overwrite:
        raise InputError(f"{path}: exists; pass overwrite=True or another name")
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} is missing; create it")


def to_bytes(values: np.ndarray) -> np.ndarray:
    """The nearest whole numbers from 0 to 255."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def opacity_bytes(logits: np.ndarray) -> np.ndarray:
    """[N] logits as opacities, 255 for 1."""
    with np.errstate(over="ignore"):
        return to_bytes(255 / (1 + np.exp(-logits.astype(np.float64))))


def drawn_rows(path: Path, gaussians: Gaussians) -> dict[str, np.ndarray]:
    """The arrays of the active Gaussians, for a format that holds only what is drawn:
    quaternions of norm 1, and no zero ones; of these it is warned.

    Raises:
      InputError: if a value is NaN, or infinite and no logit, or none is drawn.
    """
    params = gaussians.params.__dict__
    arrays = {name: np.asarray(array) for name, array in params.items()}
    slots = np.flatnonzero(np.asarray(gaussians.active))
    rows = {name: array[slots] for name, array in arrays.items()}
    bad = np.zeros(len(slots), bool)
    for name, array in rows.items():
        wrong = np.isnan(array) if name == "logit_opacities" else ~np.isfinite(array)
        bad |= wrong.any(axis=tuple(range(1, array.ndim)))
    if bad.any():
        raise InputError(
            f"{path}: {bad.sum()} of {len(bad)} Gaussians are NaN or infinite, which "
            f"{path.suffix} has no numbers for; write a .ply, or leave them out "
            "(gsjax.select)"
        )
    quats = rows["quats"].astype(np.float64)
    quats /= np.maximum(np.abs(quats).max(1, initial=0), _TINY)[:, None]
    norms = np.linalg.norm(quats, axis=1)
    drawn = norms > 0
    rows["quats"] = quats / np.where(drawn, norms, 1)[:, None]
    if drawn.all():
        return rows
    if not drawn.any():
        raise InputError(
            f"{path}: the quaternions of all {len(drawn)} Gaussians are zero, which "
            "draws nothing; is the scene damaged?"
        )
    warn(
        f"{path}: {(~drawn).sum()} of {len(drawn)} quaternions are zero; such "
        "Gaussians are not drawn, and left out"
    )
    return {name: array[drawn] for name, array in rows.items()}
