"""Gaussians in the PLY files of the field: read by property name, written in order.

Axis legend: N Gaussians, K spherical-harmonic bases.

Values stand in the file as in `GaussianParams` (log scales, logit opacities, wxyz);
only f_rest is laid out otherwise: all of red, then all of green, then all of blue.
Nothing is allocated before the sizes that the header declares are checked against
the size of the file, and the body is read in pieces, so that reading holds no more
than the arrays it returns (and once more on the way to the device).
"""

import math
import os
import re
import secrets
import stat
import warnings
from collections.abc import Iterator, Mapping
from itertools import islice
from os import PathLike
from pathlib import Path
from typing import BinaryIO, NamedTuple

import jax.numpy as jnp
import numpy as np

from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, make_gaussians
from gsjax.sh import MAX_DEGREE, num_bases

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2"},
    **{"int": "i4", "uint": "u4", "float": "f4", "double": "f8"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"},
}
# Byte order of each body; ascii has none.
_FORMATS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_NORMALS = ("nx", "ny", "nz")
_F_REST_COUNTS = [3 * (num_bases(d) - 1) for d in range(MAX_DEGREE + 1)]
_MAX_HEADER = 1 << 20
_CHUNK_ROWS = 1 << 14
# Exporters write ±inf for opacities of exactly 0 and 1; the range of `logit`.
_MAX_LOGIT = math.log((1 - 2.0**-24) / 2.0**-24)


class _Element(NamedTuple):
    """One element of the header; a list property has the type None."""

    name: str
    rows: int
    types: dict[str, str | None]

    @property
    def has_list(self) -> bool:
        return None in self.types.values()

    def least_bytes(self, order: str) -> int:
        """Size of a row: exact if binary, at least this in ascii ("0 0 0\\n")."""
        if not order:
            return max(1, 2 * len(self.types))
        return sum(int(kind[1]) for kind in self.types.values() if kind)


class _Header(NamedTuple):
    path: Path
    order: str
    before: list[_Element]
    vertex: _Element
    after: list[_Element]
    body: int
    size: int


def read_ply(path: str | PathLike[str], *, drop_nonfinite: bool = False) -> Gaussians:
    """Gaussians of a 3DGS PLY file, binary or ascii, of any SH degree up to 4.

    Properties are found by name, in any order and of any scalar type; those that
    are not needed (normals too) are skipped. Opacities of ±inf are clamped to the
    logit of [2^-24, 1 - 2^-24] with a warning. Zero quaternions, values that look
    activated and trailing bytes are warned of.

    Args:
      path: the file.
      drop_nonfinite: leave out Gaussians with NaN or infinite values, with a
        warning, instead of raising.

    Returns:
      Gaussians with capacity max(N, 1), in the order of the file.

    Raises:
      InputError: if the file cannot be read, is no PLY, is truncated, lacks
        properties, has an f_rest of no SH degree, or has values that are not
        finite; the message names what was found and what was wanted.
    """
    path = Path(path)
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise InputError(f"{path}: not a regular file; pass a .ply file")
        with path.open("rb") as file:
            header = _read_header(file, path)
            bases = _check_properties(header)
            _check_size(header)
            fields = _read_body(file, header, bases)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read: {error.strerror or error}; check path and "
            "permissions"
        ) from error
    _check_values(path, fields, drop_nonfinite)
    return make_gaussians(**fields, capacity=None)


def _warn(message: str) -> None:
    warnings.warn(message, UserWarning, stacklevel=3)


def _read_header(file: BinaryIO, path: Path) -> _Header:
    head = file.read(_MAX_HEADER)
    size = os.fstat(file.fileno()).st_size
    magic = re.match(rb"ply[ \t]*(\r\n|\n|\r)", head)
    if magic is None:
        raise InputError(
            f"{path}: byte 0: found {head[:16]!r} where a PLY file has the line "
            "'ply'; the file is empty, damaged or of another format"
        )
    eol = magic[1]
    pattern = re.compile(re.escape(eol) + rb"end_header[ \t]*" + re.escape(eol))
    end = pattern.search(head, magic.end() - len(eol))
    if end is None:
        raise InputError(
            f"{path}: no line 'end_header' in the first {len(head)} of {size} bytes; "
            "the file is truncated or damaged: export or download it again"
        )
    text = head[magic.end() : max(end.start(), magic.end())]
    order, elements = _parse_header(path, text.split(eol) if text else [], eol)
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise InputError(
            f"{path}: the header has no 'element vertex'; found {names[:8]}; export "
            "the scene as a 3DGS PLY"
        )
    at = names.index("vertex")
    before, after = elements[:at], elements[at + 1 :]
    return _Header(path, order, before, elements[at], after, end.end(), size)


def _parse_header(
    path: Path, lines: list[bytes], eol: bytes
) -> tuple[str, list[_Element]]:
    order: str | None = None
    elements: dict[str, _Element] = {}
    last: _Element | None = None
    offset = len(b"ply" + eol)
    for number, raw in enumerate(lines, 2):
        line = raw.decode("ascii", "replace")
        where = f"{path}: header line {number} (byte {offset}), {line[:80]!r}"
        offset += len(raw) + len(eol)
        match line.split():
            case ["comment" | "obj_info", *_]:
                continue
            case ["format", kind, "1.0"] if kind in _FORMATS and order is None:
                order = _FORMATS[kind]
            case ["format", *_]:
                raise InputError(f"{where}: one format, 1.0, of {[*_FORMATS]} is known")
            case ["element", name, count] if re.fullmatch("[0-9]{1,20}", count):
                if name in elements:
                    raise InputError(f"{where}: this element is declared twice")
                last = elements[name] = _Element(name, int(count), {})
            case ["property", *kinds, name] if last and len(kinds) in (1, 3):
                if name in last.types:
                    raise InputError(f"{where}: this property is declared twice")
                last.types[name] = _property_type(where, kinds)
            case _:
                raise InputError(
                    f"{where}: 'element NAME COUNT', or after one 'property TYPE "
                    "NAME', is wanted; the header is damaged: export the file again"
                )
    if order is None:
        raise InputError(f"{path}: the header has no 'format'; wanted: {[*_FORMATS]}")
    return order, list(elements.values())


def _property_type(where: str, kinds: list[str]) -> str | None:
    is_list = len(kinds) == 3 and kinds[0] == "list"
    scalars = kinds[1:] if is_list else kinds
    if (len(kinds) == 3 and not is_list) or not all(k in _TYPES for k in scalars):
        raise InputError(f"{where}: unknown type; known: {', '.join(_TYPES)}")
    return None if is_list else _TYPES[scalars[0]]


def _check_properties(header: _Header) -> int:
    """Number K of SH bases; raises unless all that a Gaussian needs is there."""
    path, found = header.path, header.vertex.types
    lists = [name for name, kind in found.items() if kind is None]
    if lists:
        raise InputError(
            f"{path}: element vertex has the list properties {lists[:8]}; Gaussians "
            "have scalar properties only: export the scene as a 3DGS PLY"
        )
    rest = sum(re.fullmatch("f_rest_[0-9]+", name) is not None for name in found)
    missing = [n for n in _views(_allocate(0, 1, np.float32)) if n not in found]
    if "f_dc_0" in missing and {"red", "green", "blue"} <= found.keys():
        raise InputError(
            f"{path}: this is a point cloud (red, green, blue), not a Gaussian PLY "
            f"(missing: {', '.join(missing)}); train a scene from the points first"
        )
    if "packed_position" in found:
        raise InputError(
            f"{path}: this is a compressed (packed) Gaussian PLY, which is not read; "
            "convert it to the standard, uncompressed PLY"
        )
    if rest in _F_REST_COUNTS:
        missing += [f"f_rest_{i}" for i in range(rest) if f"f_rest_{i}" not in found]
    if missing:
        raise InputError(
            f"{path}: element vertex lacks the properties {', '.join(missing)}; found "
            f"{len(found)}: {', '.join([*found][:20])}; export the scene as a 3DGS PLY"
        )
    if rest not in _F_REST_COUNTS:
        raise InputError(
            f"{path}: {rest} properties f_rest_* are no whole SH degree; degrees 0 to "
            f"{MAX_DEGREE} have {_F_REST_COUNTS}"
        )
    return 1 + rest // 3


def _check_size(header: _Header) -> None:
    """Compare the bytes that the header promises with those that are there."""
    path, order = header.path, header.order
    for element in header.before:
        if element.has_list:
            raise InputError(
                f"{path}: element {element.name} has a list property and stands before "
                "vertex, so that its size is unknown; put vertex first"
            )
    elements = [*header.before, header.vertex]
    open_end = not order or any(element.has_list for element in header.after)
    if not open_end:
        elements += header.after
    wanted = sum(e.rows * e.least_bytes(order) for e in elements)
    if not order:
        wanted = max(0, wanted - 1)  # the last line may lack its end
    actual = header.size - header.body
    if actual < wanted:
        sizes = ", ".join(
            f"{e.rows} {e.name} × {e.least_bytes(order)} bytes" for e in elements
        )
        raise InputError(
            f"{path}: the body (from byte {header.body}) is truncated: the header "
            f"declares {'' if order else 'at least '}{wanted} bytes ({sizes}), "
            f"{actual} are there; export or download the file again"
        )
    if actual > wanted and not open_end:
        _warn(
            f"{path}: {actual - wanted} bytes after the last element (from byte "
            f"{header.body + wanted}) are ignored; the header may be wrong"
        )


def _allocate(count: int, bases: int, dtype) -> dict[str, np.ndarray]:
    """Uninitialised arrays by their names in `GaussianParams`."""
    return {
        "means": np.empty((count, 3), dtype),
        "quats": np.empty((count, 4), dtype),
        "log_scales": np.empty((count, 3), dtype),
        "logit_opacities": np.empty(count, dtype),
        "sh": np.empty((count, bases, 3), dtype),
    }


def _views(fields: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Each property of the file, in the standard order, as a view [N] of ``fields``."""
    sh = fields["sh"]
    rest = sh.shape[1] - 1
    views = dict(zip("xyz", fields["means"].T))
    views |= {f"f_dc_{c}": sh[:, 0, c] for c in range(3)}
    views |= {f"f_rest_{i}": sh[:, 1 + i % rest, i // rest] for i in range(3 * rest)}
    views["opacity"] = fields["logit_opacities"]
    views |= {f"scale_{i}": fields["log_scales"][:, i] for i in range(3)}
    views |= {f"rot_{i}": fields["quats"][:, i] for i in range(4)}
    return views


def _read_body(file: BinaryIO, header: _Header, bases: int) -> dict[str, np.ndarray]:
    # float64 only if the file holds more than float32 can and jax would keep it.
    wide = not {"f8", "i4", "u4"}.isdisjoint(header.vertex.types.values())
    dtype = np.dtype(jnp.result_type(float)) if wide else np.dtype(np.float32)
    fields = _allocate(header.vertex.rows, bases, dtype)
    views = _views(fields)
    file.seek(header.body)
    read_rows = _binary_rows if header.order else _ascii_rows
    start = 0
    with np.errstate(over="ignore", invalid="ignore"):  # _check_values finds them
        for size, columns in read_rows(file, header):
            for name, view in views.items():
                view[start : start + size] = columns[name]
            start += size
    return fields


def _binary_rows(file: BinaryIO, header: _Header) -> Iterator[tuple[int, np.ndarray]]:
    """(rows, columns by name) in pieces; ``file`` stands at the body."""
    vertex, order = header.vertex, header.order
    dtype = np.dtype([(name, f"{order}{kind}") for name, kind in vertex.types.items()])
    file.seek(sum(e.rows * e.least_bytes(order) for e in header.before), os.SEEK_CUR)
    for start in range(0, vertex.rows, _CHUNK_ROWS):
        size = min(_CHUNK_ROWS, vertex.rows - start)
        data = file.read(size * dtype.itemsize)
        if len(data) < size * dtype.itemsize:
            raise InputError(
                f"{header.path}: the file became shorter while it was read, at vertex "
                f"{start}; wait until it is complete"
            )
        yield size, np.frombuffer(data, dtype)


def _ascii_rows(
    file: BinaryIO, header: _Header
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """(rows, columns by name) in pieces; ``file`` stands at the body."""
    path, vertex = header.path, header.vertex
    offset, line = header.body, b"\n"
    for line in islice(file, sum(element.rows for element in header.before)):
        offset += len(line)
    for start in range(0, vertex.rows, _CHUNK_ROWS):
        size = min(_CHUNK_ROWS, vertex.rows - start)
        table = np.empty((size, len(vertex.types)))
        for row in range(size):
            line = file.readline()
            words = line.split()
            where = f"{path}: vertex {start + row} (byte {offset})"
            if len(words) != len(vertex.types):
                raise InputError(
                    f"{where}: found {len(words)} values, {len(vertex.types)} are "
                    "wanted; the file is truncated or damaged"
                )
            try:
                table[row] = [float(word) for word in words]
            except ValueError as error:
                raise InputError(f"{where}: {str(error)[:80]}; pass numbers") from error
            offset += len(line)
        yield size, dict(zip(vertex.types, table.T))
    if not line.endswith((b"\n", b"\r")):
        _warn(f"{path}: the last line has no end; its last value may be truncated")
    if not header.after and any(extra.strip() for extra in file):
        _warn(f"{path}: text after the last element (byte {offset}) is ignored")


def _check_values(
    path: Path, fields: dict[str, np.ndarray], drop_nonfinite: bool
) -> None:
    """Mend, drop, refuse or warn of values, in place."""
    opacities = fields["logit_opacities"]
    infinite = np.isinf(opacities)
    if infinite.any():
        opacities[infinite] = np.copysign(_MAX_LOGIT, opacities[infinite])
        _warn(f"{path}: {infinite.sum()} opacities of ±inf set to ±{_MAX_LOGIT:.4f}")
    bad = {
        name: ~np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
        for name, array in fields.items()
    }
    rows = np.logical_or.reduce([*bad.values()])
    if rows.any():
        which = ", ".join(f"{k}: {v.sum()}" for k, v in bad.items() if v.any())
        message = (
            f"{path}: {rows.sum()} of {len(rows)} Gaussians have NaN or infinite "
            f"values ({which}); the first: {np.flatnonzero(rows)[:5].tolist()}"
        )
        if not drop_nonfinite:
            raise InputError(
                f"{message}; finite values are wanted: repair the file, or "
                "gsjax.io.ply.read_ply(path, drop_nonfinite=True) drops them"
            )
        _warn(f"{message}; dropped")
        for name in fields:
            fields[name] = fields[name][~rows]
    _warn_of_values(path, fields)


def _warn_of_values(path: Path, fields: Mapping[str, np.ndarray]) -> None:
    quats, opacities = fields["quats"], fields["logit_opacities"]
    zero = np.abs(quats).max(axis=1, initial=0) < np.finfo(quats.dtype).tiny
    if zero.any():
        _warn(
            f"{path}: {zero.sum()} of {len(zero)} quaternions are zero, the first: "
            f"{np.flatnonzero(zero)[:5].tolist()}; such Gaussians are culled"
        )
    # A heuristic: trained scenes have logits outside [0, 1] and scales below 1.
    probabilities = ((opacities >= 0) & (opacities <= 1)).all()
    if len(opacities) and probabilities and (fields["log_scales"] > 0).all():
        _warn(
            f"{path}: all opacities lie in [0, 1] and all scales are positive, which "
            "looks like activated values; a 3DGS PLY stores logit(opacity) and "
            "log(scale), and they are read as such: check how the file was exported"
        )


def write_ply(
    path: str | PathLike[str], gaussians: Gaussians, *, overwrite: bool = False
) -> None:
    """Write the active Gaussians, in their order, as a standard 3DGS PLY.

    Binary, little-endian, float32; x y z nx ny nz f_dc f_rest opacity scale rot,
    normals zero. Written beside ``path`` and then renamed: it appears complete or
    not at all. Values that are not finite are written, with a warning.

    Args:
      path: the file to write.
      gaussians: the scene; inactive slots are left out.
      overwrite: whether an existing file may be replaced.

    Raises:
      InputError: if the file exists and ``overwrite`` is not set, if its folder is
        missing, or if it cannot be written.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path}: is a folder; pass the name of a file")
    if path.exists() and not overwrite:
        raise InputError(f"{path}: exists; pass overwrite=True or another name")
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} is missing; create it")
    temporary = path.parent / f".gsjax-{secrets.token_hex(6)}.tmp"
    try:
        with temporary.open("xb") as file:
            nonfinite = _write_body(file, gaussians)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written: {error.strerror or error}; check permissions "
            "and space"
        ) from error
    finally:
        temporary.unlink(missing_ok=True)
    if nonfinite:
        _warn(f"{path}: {nonfinite} of the Gaussians written are NaN or infinite")


def _write_body(file: BinaryIO, gaussians: Gaussians) -> int:
    """Write header and rows; the number of rows with values that are not finite."""
    params = gaussians.params
    views = _views({k: np.asarray(v) for k, v in params.__dict__.items()})
    names = [*"xyz", *_NORMALS, *(name for name in views if name not in "xyz")]
    slots = np.flatnonzero(np.asarray(gaussians.active))
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(slots)}"]
    lines += [f"property float {name}" for name in names]
    file.write("\n".join([*lines, "end_header", ""]).encode())
    nonfinite = 0
    for start in range(0, len(slots), _CHUNK_ROWS):
        chosen = slots[start : start + _CHUNK_ROWS]
        table = np.zeros((len(chosen), len(names)), "<f4")
        with np.errstate(over="ignore"):
            for column, name in enumerate(names):
                if name in views:
                    table[:, column] = views[name][chosen]
        nonfinite += int((~np.isfinite(table).all(axis=1)).sum())
        file.write(table.tobytes())
    return nonfinite
