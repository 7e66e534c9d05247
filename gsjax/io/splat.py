"""Gaussians in `.splat` files, the 32 bytes a Gaussian of the first web viewers.

Three float32 of mean, three of σ, red, green, blue and opacity in a byte each, and the
quaternion, wxyz, in a byte each: 128 (1 + q). No header, no harmonics, axes as they
are; those come first that cover most, as viewers draw while they load (Kwok 2023,
https://github.com/antimatter15/splat). They are written and not read: nothing in such a
file tells whether it is whole.
"""

from os import PathLike
from pathlib import Path

import numpy as np

from gsjax.errors import InputError
from gsjax.gaussians import Gaussians
from gsjax.io.common import (
    MAX_SHIFT,
    drawn_rows,
    opacity_bytes,
    require_new,
    to_bytes,
    warn,
)
from gsjax.math.sh import C0
from gsjax.runtime.files import replacing

_ROW = np.dtype(
    [("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)]
)


def write_splat(
    path: str | PathLike[str], gaussians: Gaussians, *, overwrite: bool = False
) -> None:
    """Write the active Gaussians as a `.splat` file, those that cover most first.

    Colours are rounded to 8 bits and clipped to what they hold; harmonics above degree
    0 have no place and are left out. Of both it is warned.

    Args:
      path: the file to write; it appears complete or not at all.
      gaussians: the scene; inactive slots are left out.
      overwrite: whether an existing file may be replaced.

    Raises:
      InputError: as `write_ply`; if a value is NaN, or infinite and no opacity, or a
        mean is beyond float32, or none of the Gaussians is drawn.
    """
    path = Path(path)
    require_new(path, overwrite)
    rows = drawn_rows(path, gaussians)
    if gaussians.sh_degree:
        warn(
            f"{path}: .splat has one colour for all directions; harmonics of degree 1 "
            f"to {gaussians.sh_degree} are left out"
        )
    colors = 0.5 + C0 * rows["sh"][:, 0].astype(np.float64)
    beyond = np.any(np.abs(colors - 0.5) > 0.5 + 0.5 / 255, axis=1)
    if beyond.any():
        warn(
            f"{path}: {beyond.sum()} of {len(beyond)} colours are darker than black or "
            "brighter than white, and clipped"
        )
    table = np.zeros(len(colors), _ROW)
    sizes = np.exp(np.clip(rows["log_scales"].astype(np.float64), -80, 80))
    table["scales"] = sizes
    with np.errstate(over="ignore"):
        table["means"] = rows["means"]
    far = np.any(~np.isfinite(table["means"]), axis=1)
    if far.any():
        raise InputError(
            f"{path}: {far.sum()} of {len(far)} means are beyond float32, which .splat "
            "stores; move the scene nearer to the origin, or write a .ply"
        )
    shift = np.abs(table["means"] - rows["means"].astype(np.float64)).max(1, initial=0)
    moved = shift > MAX_SHIFT * sizes.max(1, initial=0)
    if moved.any():
        warn(
            f"{path}: {moved.sum():,} of {len(moved):,} Gaussians have "
            "means rounded by a tenth of their size; move the scene nearer to the "
            "origin, or write a .ply"
        )
    table["rgba"][:, :3] = to_bytes(255 * colors)
    table["rgba"][:, 3] = opacity_bytes(rows["logit_opacities"])
    table["quats"] = to_bytes(128 + 128 * rows["quats"])
    logs = rows["log_scales"].astype(np.float64).sum(1)
    covered = logs - np.logaddexp(0, -rows["logit_opacities"].astype(np.float64))
    with replacing(path, durable=True) as file:
        file.write(table[np.argsort(-covered, kind="stable")].tobytes())
