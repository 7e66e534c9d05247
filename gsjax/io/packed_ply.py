"""Gaussians in compressed (packed) PLY files of PlayCanvas, 16 bytes each without
harmonics (https://github.com/playcanvas/splat-transform).

Every 256 Gaussians are a chunk, whose row holds the least and greatest mean, log scale
and colour. A Gaussian is four words: its mean and log scales as 11, 10 and 11 bits
between those bounds, its rotation as `gsjax.io.packed_quats`, and 8 bits each of red,
green, blue and opacity. Harmonics, if any, are 8 bits of -4 to 4. The axes are those of
plain PLY files. Axis legend: N Gaussians, C chunks, K spherical-harmonic bases.
"""

from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from typing import BinaryIO

import numpy as np

from gsjax.errors import InputError
from gsjax.gaussians import Gaussians
from gsjax.io import common
from gsjax.io.morton import morton_order
from gsjax.io.packed_quats import join_words, pack_quats, split_words, unpack_quats
from gsjax.io.ply_header import Element, Header, check_size
from gsjax.io.ply_rows import CHUNK_ROWS
from gsjax.math.sh import C0, num_bases
from gsjax.runtime.files import replacing
from gsjax.runtime.memory import Estimate, require

_CHUNK = 256  # Gaussians that share bounds
_BOUNDS = [
    [f"{end}_{axis}" for end in ("min", "max") for axis in axes]
    for axes in ("xyz", ("scale_x", "scale_y", "scale_z"), "rgb")
]
_WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_REST_COUNTS = [3 * (num_bases(degree) - 1) for degree in range(4)]
_MAX_DEGREE = 3
# Lowest bit and greatest number of each part of a word of means or scales.
_SHIFTS, _LEVELS = np.asarray([21, 11, 0], np.uint32), np.asarray([2047, 1023, 2047])
_COLOR_SHIFTS = np.asarray([24, 16, 8], np.uint32)
_QUAT_LEVELS = 1023
_MAX_LOG_SCALE = 20.0
# Value of each byte of a harmonic: the middle of a step, and the ends of the range.
_HARMONICS = np.asarray([0, *np.arange(1.5, 255), 256], np.float32) / 32 - 4
_REMEDY = "export or download it again"


def is_packed(header: Header) -> bool:
    """Return True if the vertices of a PLY file are packed Gaussians."""
    return "packed_position" in header.vertex.types


def read_packed(file: BinaryIO, header: Header) -> dict[str, np.ndarray]:
    """Read the body of a compressed PLY file, of SH degree 0 to 3.

    Files without bounds of colours, as older programs write them, are read too.

    Args:
      file: the file, at any position.
      header: its header, for which `is_packed` is true.

    Returns:
      Arrays by their names in `GaussianParams`, in the order of the file.

    Raises:
      InputError: if the file is text, truncated, lacks properties, has another number
        of chunks or harmonics than its Gaussians need, or bounds that are not finite.
      CapacityError: if memory is too small; raised before the body is read.
    """
    tables = _read_tables(file, header)
    chunks, words, rest = (tables.get(name) for name in ("chunk", "vertex", "sh"))
    assert chunks is not None
    assert words is not None
    count, width = len(words), 0 if rest is None else len(rest.dtype.names or ())
    fields = {
        "means": np.empty((count, 3)),
        "quats": np.empty((count, 4), np.float32),
        "log_scales": np.empty((count, 3), np.float32),
        "logit_opacities": np.empty(count, np.float32),
        "sh": np.empty((count, 1 + width // 3, 3), np.float32),
    }
    for start in range(0, count, CHUNK_ROWS):
        rows = slice(start, start + CHUNK_ROWS)
        some = chunks[start // _CHUNK : (start + CHUNK_ROWS) // _CHUNK]
        for name, values in _decoded(some, words[rows]).items():
            fields[name][rows] = values
        if rest is not None:
            table = np.stack([rest[f"f_rest_{i}"][rows] for i in range(width)], axis=1)
            values = _HARMONICS[table].reshape(-1, 3, width // 3)
            fields["sh"][rows, 1:] = values.swapaxes(1, 2)
    common.check_rows(header.path, fields)
    return fields


def _decoded(chunks: np.ndarray, words: np.ndarray) -> dict[str, np.ndarray]:
    """Return values by name of some rows, without harmonics above degree 0."""
    position, rotation, scale, color = (words[name][:, None] for name in _WORDS)
    bytes_of = color >> _COLOR_SHIFTS & 255
    means, scales = (
        _between(chunks, names, (word >> _SHIFTS & _LEVELS) / _LEVELS)
        for names, word in zip(_BOUNDS, (position, scale))
    )
    colors = bytes_of / 255
    if _BOUNDS[2][0] in (chunks.dtype.names or ()):
        colors = _between(chunks, _BOUNDS[2], colors)
    return {
        "means": means,
        "quats": unpack_quats(split_words(rotation[:, 0]), _QUAT_LEVELS),
        "log_scales": scales,
        "logit_opacities": common.byte_logits(color[:, 0] & 255),
        "sh": ((colors - 0.5) / C0)[:, None],
    }


def _between(chunks: np.ndarray, names: list[str], shares: np.ndarray) -> np.ndarray:
    """Return values [N, 3] at shares between the bounds of their chunks, float64."""
    bounds = np.stack([chunks[name] for name in names], axis=1, dtype=np.float64)
    bounds = np.repeat(bounds, _CHUNK, axis=0)[: len(shares)]
    with np.errstate(invalid="ignore"):  # `check_rows` reports bounds like these
        return bounds[:, :3] * (1 - shares) + bounds[:, 3:] * shares


def _read_tables(file: BinaryIO, header: Header) -> dict[str, np.ndarray]:
    """Return the rows of the chunks, vertices and harmonics."""
    elements = [*header.before, header.vertex, *header.after]
    path, count = header.path, header.vertex.rows
    _check_elements(path, header.order, {e.name: e for e in elements}, count)
    check_size(header)
    bases = 1 + max((len(e.types) for e in elements if e.name == "sh"), default=0) // 3
    require(
        Estimate({"values as read": count * (300 + 20 * 3 * bases)}),
        f"{path}: {count:,} Gaussians",
        "reduce the file with the tool that made it",
    )
    tables, at = {}, header.body
    for element in elements:
        kinds = [(n, f"{header.order}{kind}") for n, kind in element.types.items()]
        size = element.rows * element.min_bytes(header.order)
        if element.name in ("chunk", "vertex", "sh"):
            file.seek(at)
            raw = common.read_exactly(file, size, path, f"element {element.name}")
            tables[element.name] = np.frombuffer(raw, np.dtype(kinds))
        at += size
    return tables


def _check_elements(
    path: Path, order: str, elements: dict[str, Element], count: int
) -> None:
    """Reject a header that does not describe packed Gaussians."""
    chunks = elements.get("chunk", Element("chunk", 0, {}))
    rest = elements.get("sh", Element("sh", count, {}))
    names = [f"f_rest_{i}" for i in range(len(rest.types))]
    words = elements["vertex"].types
    needed = -(-count // _CHUNK)
    colors = [name for name in _BOUNDS[2] if name in chunks.types]
    missing = [f"vertex {name}" for name in _WORDS if words.get(name) != "u4"]
    bounds = _BOUNDS[0] + _BOUNDS[1] + (_BOUNDS[2] if colors else [])
    kinds = ("f4", "f8")
    missing += [
        f"chunk {name}" for name in bounds if chunks.types.get(name) not in kinds
    ]
    missing += [f"sh {name}" for name in names if rest.types.get(name) != "u1"]
    fault = ""
    if not order or any(element.has_list for element in elements.values()):
        fault = "expected a binary body without lists, got text or list properties"
    elif missing:
        fault = "expected a compressed PLY, got one whose header lacks the properties "
        fault += f"{', '.join(missing[:12])}, or with other types"
    elif chunks.rows != needed:
        fault = (
            f"expected {needed:,} chunks for {count:,} Gaussians, got {chunks.rows:,}"
        )
    elif rest.rows != count or len(names) not in _REST_COUNTS:
        fault = f"expected {count:,} rows of {_REST_COUNTS} harmonics, "
        fault += f"got {rest.rows:,} of {len(names)}"
    if fault:
        raise InputError(f"{path}: {fault}; the file is damaged: {_REMEDY}")


def write_packed_ply(
    path: str | PathLike[str],
    gaussians: Gaussians,
    *,
    overwrite: bool = False,
    mode: str | None = None,
) -> None:
    """Write the active Gaussians as a compressed PLY, in Morton order.

    Means, log scales and colours are rounded to 2047, 1023, or 255 steps between the
    least and the greatest of 256 neighbours; rotations to 10 bits a component;
    opacities to 8 bits; harmonics to steps of 1/32. Log scales beyond ±20 and harmonics
    beyond ±4 are clipped with a warning.

    Args:
      path, gaussians, overwrite: as `gsjax.io.formats.save`; SH degree 0 to 3.
      mode: written as "comment SplatRenderMode", see `gsjax.io.ply.render_mode`.

    Raises:
      InputError: as `write_ply`; if a value is NaN, or infinite and not a logit, if a
        mean exceeds float32, if the degree is 4, or if nothing would be drawn.
      CapacityError: if memory is too small.
    """
    path = Path(path)
    common.require_new(path, overwrite)
    degree = gaussians.sh_degree
    common.require_degree(path, degree, _MAX_DEGREE)
    slots, bases = gaussians.capacity, num_bases(degree)
    estimate = Estimate({"values to be written": slots * (500 + 60 * bases)})
    remedy = "leave some out (export --min-opacity), or write a .ply"
    require(estimate, f"{path}: {slots:,} Gaussians", remedy)
    rows = common.visible_rows(path, gaussians)
    order = morton_order(rows["means"])
    rows = {name: array[order] for name, array in rows.items()}
    chunks, table = _packed(path, rows)
    with replacing(path, durable=True) as file:
        file.write(_header(chunks, table, 3 * (bases - 1), mode))
        file.write(chunks.tobytes())
        file.write(table.tobytes())
        for piece in _harmonics(rows["sh"]):
            file.write(piece)


def _packed(path: Path, rows: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of the chunks [C] and of the vertices [N]."""
    logs, opacities = rows["log_scales"], rows["logit_opacities"]
    colors = 0.5 + C0 * rows["sh"][:, 0].astype(np.float64)
    clipped = np.clip(logs.astype(np.float64), -_MAX_LOG_SCALE, _MAX_LOG_SCALE)
    bounds, codes = [], []
    kinds = (rows["means"], _LEVELS), (clipped, _LEVELS), (colors, 255)
    for values, levels in kinds:
        ends, shares = _shares(values)
        bounds.append(ends)
        codes.append(np.rint(shares * levels).astype(np.uint32))
    far = ~np.isfinite(bounds[0])
    if far.any():
        raise InputError(
            f"{path}: {far.any(axis=1).sum()} of {len(far)} chunks have means that "
            "exceed float32, which a compressed PLY stores; move the scene nearer to "
            "the origin, or write a .ply"
        )
    kinds = [(name, "<f4") for names in _BOUNDS for name in names]
    chunks = np.zeros(len(far), kinds)
    for names, ends in zip(_BOUNDS, bounds):
        for name, column in zip(names, ends.T):
            chunks[name] = column
    table = np.zeros(len(logs), [(name, "<u4") for name in _WORDS])
    table["packed_position"] = np.bitwise_or.reduce(codes[0] << _SHIFTS, axis=1)
    table["packed_scale"] = np.bitwise_or.reduce(codes[1] << _SHIFTS, axis=1)
    table["packed_color"] = np.bitwise_or.reduce(codes[2] << _COLOR_SHIFTS, axis=1)
    table["packed_color"] |= common.opacity_bytes(opacities)
    table["packed_rotation"] = join_words(pack_quats(rows["quats"], _QUAT_LEVELS))
    found = _between(chunks, _BOUNDS[0], codes[0] / _LEVELS)
    _warn_of_losses(path, rows, np.abs(found - rows["means"]).max(1, initial=0))
    return chunks, table


def _shares(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds [C, 6] float32 of chunks, and shares [N, 3] between them."""
    count = len(values)
    pad = -count % _CHUNK  # with the last row
    padded = np.concatenate([values, np.repeat(values[-1:], pad, axis=0)])
    groups = padded.reshape(-1, _CHUNK, 3).astype(np.float64)
    with np.errstate(over="ignore"):
        ends = np.stack([groups.min(axis=1), groups.max(axis=1)], axis=1)
        ends = ends.astype(np.float32)
    low, high = (ends[:, k, None].astype(np.float64) for k in range(2))
    with np.errstate(invalid="ignore"):  # the caller rejects infinite bounds
        shares = (groups - low) / np.where(high > low, high - low, 1)
    shares = np.nan_to_num(np.clip(shares, 0, 1))
    return ends.reshape(-1, 6), shares.reshape(-1, 3)[:count]


def _header(
    chunks: np.ndarray, table: np.ndarray, width: int, mode: str | None
) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment SplatRenderMode: {mode}"] if mode else []
    lines += [f"element chunk {len(chunks)}"]
    lines += [f"property float {name}" for name in chunks.dtype.names or ()]
    lines += [f"element vertex {len(table)}"]
    lines += [f"property uint {name}" for name in _WORDS]
    if width:
        lines += [f"element sh {len(table)}"]
        lines += [f"property uchar f_rest_{i}" for i in range(width)]
    return "\n".join([*lines, "end_header", ""]).encode()


def _harmonics(sh: np.ndarray) -> Iterator[bytes]:
    """Yield the bytes of harmonics [N, K, 3], channel by channel."""
    middles = (_HARMONICS[1:] + _HARMONICS[:-1]) / 2  # between neighbouring values
    for start in range(0, len(sh), CHUNK_ROWS):
        some = sh[start : start + CHUNK_ROWS, 1:].swapaxes(1, 2)
        yield np.searchsorted(middles, some, "right").astype(np.uint8).tobytes()


def _warn_of_losses(path: Path, rows: dict[str, np.ndarray], shift: np.ndarray) -> None:
    scales, rest = rows["log_scales"], rows["sh"][:, 1:]
    sizes = np.exp(np.minimum(scales.max(1, initial=-np.inf), 80).astype(np.float64))
    losses = {
        "log scales beyond -20 to 20": (np.abs(scales) > _MAX_LOG_SCALE).any(axis=1),
        "harmonics beyond -4 to 4": (np.abs(rest) > 4 + 1 / 32).any(axis=(1, 2)),
        "means rounded by a tenth of their size": shift > common.MAX_SHIFT * sizes,
    }
    for what, lost in losses.items():
        if lost.any():
            common.warn(
                f"{path}: {lost.sum():,} of {len(lost):,} Gaussians have {what}"
            )
