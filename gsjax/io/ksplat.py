"""Gaussians in `.ksplat` files, version 0.1, of SH degree 0 to 2 (GaussianSplats3D,
https://github.com/mkkellogg/GaussianSplats3D). They are read only.

A header of 4096 bytes and one of 1024 for each section are followed by the sections:
the lengths of partly filled buckets, the centres of all buckets, and a record for each
Gaussian. At level 0 records are float32 and means absolute; at levels 1 and 2 means are
whole numbers relative to the bucket, scales and rotations float16, and harmonics
float16 (level 1) or bytes (level 2). Axis legend: N Gaussians, K harmonic bases.
"""

from os import PathLike
from pathlib import Path
from struct import Struct
from typing import BinaryIO, NamedTuple

import numpy as np

from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, make_gaussians
from gsjax.io import common
from gsjax.math.sh import num_bases
from gsjax.runtime.files import opened
from gsjax.runtime.memory import Estimate, require

_HEADER_SIZE, _SECTION_SIZE = 4096, 1024
_HEADER = Struct("<BB2xIIIIH14x2f")
_SECTION = Struct("<IIIIfH2xIIIIH")
_VERSION = (0, 1)
_MAX_DEGREE = 2
# Types of means, scales and rotations, and harmonics by level.
_TYPES = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))
_CENTER_BYTES, _LENGTH_BYTES = 12, 4  # of a bucket
_RANGE, _SH_RANGE = 32767, 1.5  # where the file has 0
_REMEDY = "export it again, or convert it to a .ply with SuperSplat"


class _Header(NamedTuple):
    """Header of a file, in the order of its fields."""

    major: int
    minor: int
    max_sections: int
    sections: int
    max_rows: int
    rows: int
    level: int
    sh_min: float
    sh_max: float


class _Section(NamedTuple):
    """Header of a section, in the order of its fields."""

    rows: int
    max_rows: int
    bucket_size: int
    buckets: int
    block: float
    bucket_bytes: int
    levels: int
    storage: int
    full: int
    partial: int
    degree: int


def read_ksplat(path: str | PathLike[str]) -> Gaussians:
    """Read a complete `.ksplat` file of version 0.1 and compression level 0, 1 or 2.

    Returns:
      Gaussians in the order of the file, of the highest SH degree of its sections.

    Raises:
      InputError: if the file cannot be read, is of another version, is incomplete,
        truncated or damaged, or has a row with a mean or colour that is not finite, a
        negative scale or a zero quaternion.
      CapacityError: if memory is too small; raised before the sections are read.
    """
    path = Path(path)
    with opened(path, "a .ksplat file") as file:
        size = file.seek(0, 2)
        file.seek(0)
        header, sections = _read_headers(file, path, size)
        bases = num_bases(max((s.degree for s in sections), default=0))
        estimate = Estimate({"values as read": header.rows * (300 + 24 * bases)})
        remedy = "reduce the file with the tool that made it"
        require(estimate, f"{path}: {header.rows:,} Gaussians", remedy)
        parts = [_read_section(file, path, header, section) for section in sections]
    for part in parts:
        missing = bases - part["sh"].shape[1]
        part["sh"] = np.pad(part["sh"], ((0, 0), (0, missing), (0, 0)))
    fields = {
        name: np.concatenate([part[name] for part in parts], axis=0)
        for name in ("means", "quats", "log_scales", "logit_opacities", "sh")
    }
    common.check_rows(path, fields)
    return make_gaussians(**fields, capacity=None)


def _read_headers(
    file: BinaryIO, path: Path, size: int
) -> tuple[_Header, list[_Section]]:
    """Return the headers of the file and of its sections, checked by its size."""
    raw = common.read_exactly(file, _HEADER_SIZE, path, "the header")
    header = _Header(*_HEADER.unpack_from(raw))
    if (header.major, header.minor) != _VERSION or header.level >= len(_TYPES):
        _reject(
            path,
            "version 0.1 and compression level 0 to 2",
            f"version {header.major}.{header.minor} and level {header.level}",
        )
    end = _HEADER_SIZE + header.max_sections * _SECTION_SIZE
    if not 1 <= header.sections <= header.max_sections or end > size:
        _reject(
            path,
            f"headers of 1 to {(size - _HEADER_SIZE) // _SECTION_SIZE} sections",
            f"{header.sections:,} sections of {header.max_sections:,}",
        )
    sections = []
    for index in range(header.max_sections):
        raw = common.read_exactly(file, _SECTION_SIZE, path, f"section header {index}")
        if index < header.sections:
            sections.append(_Section(*_SECTION.unpack_from(raw)))
            _check_section(path, header.level, index, sections[-1])
    rows = sum(section.rows for section in sections)
    if rows != header.rows or not rows:
        _reject(path, f"sections of {header.rows:,} Gaussians, at least 1", f"{rows:,}")
    end += sum(section.storage for section in sections)
    if end > size:
        _reject(path, f"{end:,} bytes", f"{size:,}: the file is truncated")
    if end < size:
        common.warn(f"{path}: {size - end:,} bytes after the last section are ignored")
    return header, sections


def _check_section(path: Path, level: int, index: int, section: _Section) -> None:
    """Reject a section whose sizes do not agree."""
    where = f"in section {index} "
    if section.degree > _MAX_DEGREE:
        expected = f"{where}SH degree 0 to {_MAX_DEGREE}"
        _reject(path, expected, f"{section.degree}")
    if section.rows != section.max_rows:
        expected = f"{where}all {section.max_rows:,} Gaussians"
        _reject(path, expected, f"{section.rows:,}: the file is incomplete")
    storage = section.partial * _LENGTH_BYTES + section.buckets * _CENTER_BYTES
    storage += section.rows * _record(level, section.degree).itemsize
    if storage != section.storage:
        _reject(path, f"{where}{storage:,} bytes", f"{section.storage:,}")
    buckets = section.full + section.partial
    if level and (
        buckets != section.buckets
        or section.bucket_bytes != _CENTER_BYTES
        or not 0 <= section.block < np.inf
    ):
        expected = (
            f"{where}{buckets:,} buckets of {_CENTER_BYTES} bytes and finite size"
        )
        got = f"{section.buckets:,} of {section.bucket_bytes} and size {section.block}"
        _reject(path, expected, got)


def _record(level: int, degree: int) -> np.dtype:
    """Return the layout of a Gaussian."""
    mean, scale, harmonic = _TYPES[level]
    return np.dtype(
        [
            ("means", mean, 3),
            ("scales", scale, 3),
            ("quats", scale, 4),
            ("rgba", "u1", 4),
            ("sh", harmonic, 3 * (num_bases(degree) - 1)),
        ]
    )


def _read_section(
    file: BinaryIO, path: Path, header: _Header, section: _Section
) -> dict[str, np.ndarray]:
    """Return arrays by their names in `GaussianParams`."""
    sizes = section.partial * _LENGTH_BYTES, section.buckets * _CENTER_BYTES
    lengths, centers = (
        np.frombuffer(common.read_exactly(file, size, path, "buckets"), kind)
        for size, kind in zip(sizes, ("<u4", "<f4"))
    )
    layout = _record(header.level, section.degree)
    size = section.rows * layout.itemsize
    table = np.frombuffer(common.read_exactly(file, size, path, "records"), layout)
    means = table["means"].astype(np.float32)
    if header.level:
        lengths = [*[section.bucket_size] * section.full, *lengths.tolist()]
        if sum(lengths) != section.rows:
            expected = f"buckets that hold {section.rows:,} Gaussians"
            _reject(path, expected, f"{sum(lengths):,}")
        levels = section.levels or _RANGE
        steps = (table["means"] - np.float64(levels)) * (section.block / 2 / levels)
        centers = np.repeat(centers.reshape(-1, 3), lengths, axis=0)
        with np.errstate(over="ignore"):  # `check_rows` reports infinite means
            means = (steps + centers).astype(np.float32)
    sh = np.zeros((section.rows, num_bases(section.degree), 3), np.float32)
    sh[:, 0] = common.byte_colors(table["rgba"][:, :3])
    rest = table["sh"].astype(np.float32)
    if header.level == 2:
        least, most = header.sh_min or -_SH_RANGE, header.sh_max or _SH_RANGE
        with np.errstate(invalid="ignore"):  # and colours
            rest = least + rest / 255 * (most - least)
    for degree in range(1, section.degree + 1):  # red, green, blue of each degree
        begin, end = num_bases(degree - 1), num_bases(degree)
        band = rest[:, 3 * (begin - 1) : 3 * (end - 1)].reshape(-1, 3, end - begin)
        sh[:, begin:end] = band.swapaxes(1, 2)
    return {
        "means": means,
        "quats": table["quats"].astype(np.float32),
        "log_scales": common.scale_logs(table["scales"].astype(np.float32)),
        "logit_opacities": common.byte_logits(table["rgba"][:, 3]),
        "sh": sh,
    }


def _reject(path: Path, expected: str, got: str) -> None:
    raise InputError(f"{path}: expected {expected}, got {got}; {_REMEDY}")


FORMAT = common.Format("ksplat", (".ksplat",), read_ksplat, None)
