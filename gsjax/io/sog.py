"""Gaussians in SOG scenes (PlayCanvas, "Spatially Ordered Gaussians",
https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog/).

A scene is a meta.json and lossless WebP textures, of a texel a Gaussian, in a ZIP
archive or in a folder. Scales, colours and harmonics are indices into codebooks of 256
values; harmonics of degree 1 and above are indices into a palette, whose entries are
such indices. Axes are those of the PLY. Versions 1 and 2 are read, 2 is written.
"""

from os import PathLike
from pathlib import Path

from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, make_gaussians
from gsjax.io import common
from gsjax.io.sog_decode import decode_scene, dequantise_means
from gsjax.io.sog_encode import encode_scene, quantise_means
from gsjax.io.sog_files import META, REMEDY, SogFiles, opened_scene, write_files
from gsjax.io.sog_meta import MAX_DEGREE, MODELS, Meta, read_meta
from gsjax.math.sh import num_bases
from gsjax.runtime.memory import Estimate, require

# Gaussians per byte of a file beyond the first many; equal ones compress without limit.
_MAX_RATIO, _MANY = 8, 1 << 16


def read_sog(path: str | PathLike[str]) -> Gaussians:
    """Read a SOG scene of version 1 or 2.

    Args:
      path: a .sog file, the folder of an unbundled scene, or its meta.json.

    Returns:
      Gaussians with capacity max(N, 1), in the order of the file.

    Raises:
      InputError: if a file cannot be read, is damaged or truncated, has another version
        or size than meta.json declares, or has values that are not finite; or if a name
        in meta.json leads out of the archive or folder.
      CapacityError: if memory is too small; raised before textures are decoded.
    """
    with opened_scene(Path(path)) as files:
        meta = read_meta(files)
        _check_count(files, meta)
        fields = decode_scene(files, meta)
    return make_gaussians(**fields, capacity=None)


def render_mode(path: str | PathLike[str]) -> str | None:
    """Return "mip" or "2dgs" if a SOG scene says that it is drawn so, or None.

    Raises:
      InputError: as `read_sog`, from meta.json alone.
    """
    with opened_scene(Path(path)) as files:
        return read_meta(files).mode


def scene_bytes(path: Path) -> int:
    """Return the size of a SOG scene on the disk, in bytes, with its textures.

    Raises:
      InputError: as `read_sog`, from meta.json and the sizes of the files.
    """
    with opened_scene(path) as files:
        return files.size([META, *read_meta(files).names()])


def write_sog(
    path: str | PathLike[str],
    gaussians: Gaussians,
    *,
    overwrite: bool = False,
    mode: str | None = None,
) -> None:
    """Write the active Gaussians as a SOG scene of version 2, in Morton order.

    Means are rounded to 16 bits an axis of sign(x) ln(1 + |x|), quaternions to 26 bits,
    and opacities to 8. Scales and colours become indices into codebooks of 256 values,
    and harmonics into a palette of up to 65,536 entries with such a codebook. Codebooks
    and palette are exact where the scene has no more distinct values.

    Args:
      path: a .sog file; or a meta.json, whose folder then holds the textures.
      gaussians, overwrite: as `gsjax.io.formats.save`; SH degree 0 to 3.
      mode: "mip" or "2dgs" is recorded, see `render_mode`.

    Raises:
      InputError: as `write_ply`; if a value is NaN, or infinite and not a logit, if a
        mean exceeds float32, if the degree is 4, or if nothing would be drawn.
      CapacityError: if memory is too small.
      MissingExtraError: if OpenCV does not load.
    """
    path = Path(path)
    common.require_new(path, overwrite)
    slots, degree = gaussians.capacity, gaussians.sh_degree
    common.require_degree(path, degree, MAX_DEGREE)
    each = 500 + 32 * num_bases(degree)
    remedy = "leave some out (export --min-opacity), or write a .ply"
    estimate = Estimate({"values to be written": slots * each})
    require(estimate, f"{path}: {slots:,} Gaussians", remedy)
    rows = common.visible_rows(path, gaussians)
    if not len(rows["means"]):
        expected = "expected at least one active Gaussian, got none"
        raise InputError(f"{path}: {expected}: SOG has no empty textures; write a .ply")
    codes = quantise_means(common.float32_means(path, rows))
    common.warn_of_moves(path, dequantise_means(*codes), rows)
    write_files(path, encode_scene(rows, codes, mode), overwrite=overwrite)


def _check_count(files: SogFiles, meta: Meta) -> None:
    size, count = files.size(meta.names()), meta.gaussians
    if count > max(_MANY, _MAX_RATIO * size):
        raise InputError(
            f"{files.where(META)}: declares {count:,} Gaussians, which {size:,} bytes "
            f"cannot hold; the file is truncated or damaged: {REMEDY}"
        )
    bases = 16 if meta.harmonics else 1
    require(
        Estimate({"values as read": count * (200 + 8 * 3 * bases)}),
        f"{files.path}: {count:,} Gaussians",
        "reduce the scene with the tool that made it",
    )


FORMAT = common.Format(
    "SOG", (".sog", META), read_sog, write_sog, render_mode, tuple(MODELS)
)
