"""Gaussians in `.splat` files, the format of the first web viewers (Kwok 2023,
https://github.com/antimatter15/splat): 32 bytes a Gaussian and no header.

Each holds float32 of mean [3] and σ [3], then a byte each of red, green, blue, opacity
and the quaternion wxyz, 128 (1 + q). The largest come first, as viewers draw while they
load. Nothing in a file tells whether it is complete: one that is cut between two
Gaussians is a valid shorter file.
"""

from os import PathLike
from pathlib import Path

import numpy as np

from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, make_gaussians
from gsjax.io import common
from gsjax.math.sh import C0
from gsjax.runtime.files import opened, replacing
from gsjax.runtime.memory import Estimate, require

_FLOATS = [("means", "<f4", 3), ("scales", "<f4", 3)]
_ROW = np.dtype([*_FLOATS, ("rgba", "u1", 4), ("quats", "u1", 4)])
_NEARER = "move the scene nearer to the origin, or write a .ply"


def read_splat(path: str | PathLike[str]) -> Gaussians:
    """Read a `.splat` file; its Gaussians have SH degree 0.

    Quaternions are decoded as (byte - 128) / 128, as the first viewer does
    (https://github.com/antimatter15/splat), and not normalised. Some programs read
    byte / 127.5 - 1, which differs by up to 0.006.

    Returns:
      Gaussians in the order of the file.

    Raises:
      InputError: if the file cannot be read, is empty, is not a whole number of rows of
        32 bytes, or has a row with a mean that is not finite, a negative scale or a
        zero quaternion.
      CapacityError: if memory is too small; raised before the file is read.
    """
    path = Path(path)
    with opened(path, "a .splat file") as file:
        size = file.seek(0, 2)
        if not size or size % _ROW.itemsize:
            raise InputError(
                f"{path}: expected one or more rows of {_ROW.itemsize} bytes, got "
                f"{size:,} bytes; the file is truncated or has another layout: export "
                "or download it again"
            )
        count = size // _ROW.itemsize
        remedy = "reduce the file with the tool that made it"
        estimate = Estimate({"values as read": 200 * count})
        require(estimate, f"{path}: {count:,} Gaussians", remedy)
        file.seek(0)
        table = np.frombuffer(common.read_exactly(file, size, path, "rows"), _ROW)
    fields = {
        "means": table["means"],
        "quats": (table["quats"].astype(np.float32) - 128) / 128,
        "log_scales": common.scale_logs(table["scales"]),
        "logit_opacities": common.byte_logits(table["rgba"][:, 3]),
        "sh": common.byte_colors(table["rgba"][:, None, :3]),
    }
    common.check_rows(path, fields)
    return make_gaussians(**fields, capacity=None)


def write_splat(
    path: str | PathLike[str], gaussians: Gaussians, *, overwrite: bool = False
) -> None:
    """Write the active Gaussians as a `.splat` file, largest first.

    Colours are clipped and rounded to 8 bits, and harmonics above degree 0 are left
    out, each with a warning.
    Arguments as `gsjax.io.formats.save`.

    Raises:
      InputError: as `write_ply`; if a value is NaN, or infinite and not a logit, if a
        mean exceeds float32, or if nothing would be drawn.
    """
    path = Path(path)
    common.require_new(path, overwrite)
    rows = common.visible_rows(path, gaussians)
    table = np.zeros(len(rows["means"]), _ROW)
    logs = rows["log_scales"].astype(np.float64)
    table["scales"] = np.exp(np.clip(logs, -80, 80))
    with np.errstate(over="ignore"):
        table["means"] = rows["means"]
    far = np.any(~np.isfinite(table["means"]), axis=1)
    if far.any():
        raise InputError(
            f"{path}: {far.sum()} of {len(far)} means exceed float32, which .splat "
            f"stores; {_NEARER}"
        )
    colors = 0.5 + C0 * rows["sh"][:, 0].astype(np.float64)
    _warn_of_losses(path, gaussians.sh_degree, colors, rows["means"], table)
    table["rgba"][:, :3] = common.to_bytes(255 * colors)
    table["rgba"][:, 3] = common.opacity_bytes(rows["logit_opacities"])
    table["quats"] = common.to_bytes(128 + 128 * rows["quats"])
    logits = rows["logit_opacities"].astype(np.float64)
    covered = logs.sum(1) - np.logaddexp(0, -logits)
    with replacing(path, durable=True) as file:
        file.write(table[np.argsort(-covered, kind="stable")].tobytes())


def _warn_of_losses(
    path: Path, degree: int, colors: np.ndarray, means: np.ndarray, table: np.ndarray
) -> None:
    if degree:
        lost = f"harmonics of degree 1 to {degree} are left out"
        common.warn(f"{path}: .splat stores one colour for all directions; {lost}")
    clipped = np.any(np.abs(colors - 0.5) > 0.5 + 0.5 / 255, axis=1)
    if clipped.any():
        lost = f"{clipped.sum()} of {len(clipped)} colours"
        common.warn(f"{path}: {lost} are out of [0, 1] and clipped")
    shift = np.abs(table["means"] - means.astype(np.float64)).max(1, initial=0)
    moved = shift > common.MAX_SHIFT * table["scales"].max(1, initial=0)
    if moved.any():
        common.warn(
            f"{path}: {moved.sum():,} of {len(moved):,} Gaussians have means rounded "
            f"by a tenth of their size or more; {_NEARER}"
        )


FORMAT = common.Format("splat", (".splat",), read_splat, write_splat)
