"""Binary glTF files (Khronos, "glTF 2.0 Specification", 2021): their JSON and arrays.

Only what lies in the file itself is read: buffers with a URI are rejected. Axis legend:
N elements of an accessor.
"""

import json
import os
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from gsjax.errors import InputError
from gsjax.runtime.files import opened, shown
from gsjax.runtime.memory import Estimate, require

REMEDY = "export or download it again"
_MAGIC, _VERSION = b"glTF", 2
_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
_JSON, _BIN = b"JSON", b"BIN\0"
_PARSED = 24  # memory of Python's parser relative to the text, for many small objects
# Types of components by number, and their greatest value if normalised.
_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
NAMES = {5120: "int8", 5121: "uint8", 5122: "int16", 5123: "uint16", 5126: "float"}
FLOAT, BYTE = 5126, 5121
_ARRAY_BUFFER = 34962  # target of a view: attributes of vertices
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_MAX_COUNT = 1 << 32


class Gltf(NamedTuple):
    """Contents of a file.

    Attributes:
      path: the file, for messages.
      data: the parsed JSON.
      body: bytes of the binary chunk.
      size: bytes of the file.
    """

    path: Path
    data: dict[str, Any]
    body: bytes
    size: int

    def fault(self, place: str, expected: str, got: Any) -> InputError:
        """Return the error for a value at a place such as "nodes[3].mesh"."""
        shape = f"{place}: expected {expected}, got {shown(got)}"
        return InputError(f"{self.path}: {shape}; {REMEDY}")

    def item(self, kind: str, index: Any) -> dict[str, Any]:
        """Return an object of a list at the top: ``item("nodes", 3)``."""
        listed = self.data.get(kind)
        listed = listed if isinstance(listed, list) else []
        if type(index) is not int or not 0 <= index < len(listed):
            expected = f"an index below {len(listed)}, the number of {kind}"
            raise self.fault(kind, expected, index)
        if not isinstance(listed[index], dict):
            raise self.fault(f"{kind}[{index}]", "an object", listed[index])
        return listed[index]


def read_gltf(path: Path) -> Gltf:
    """Read the chunks of a binary glTF file of version 2.

    Raises:
      InputError: if it cannot be read, is not such a file, or is truncated.
      CapacityError: if memory is too small for its JSON; raised before parsing.
    """
    with opened(path, "a .glb file") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(0)
        head = file.read(_HEADER.size)
        if len(head) < _HEADER.size or head[:4] != _MAGIC:
            expected = f"a binary glTF file, which starts with {_MAGIC!r}"
            got = f"{head[:8]!r}; export the scene as .glb"
            raise InputError(f"{path}: byte 0: expected {expected}, got {got}")
        _, version, declared = _HEADER.unpack(head)
        if version != _VERSION:
            expected = f"version {_VERSION}, got {version}"
            raise InputError(f"{path}: expected glTF of {expected}; export it again")
        if declared != size:
            expected = f"expected {declared:,} bytes as its header declares"
            raise InputError(f"{path}: {expected}, got {size:,}; {REMEDY}")
        text = _chunk(path, file, size, _JSON)
        body = _chunk(path, file, size, _BIN) if file.tell() < size else b""
    return Gltf(path, _parse(path, text), body, size)


def _chunk(path: Path, file: BinaryIO, size: int, kind: bytes) -> bytes:
    """Return the content of the chunk at the position of the file."""
    start = file.tell()
    head = file.read(_CHUNK.size)
    length, found = _CHUNK.unpack(head) if len(head) == _CHUNK.size else (0, head)
    if found != kind:
        expected = f"byte {start}: expected a chunk {kind!r}, got {found!r}"
        raise InputError(f"{path}: {expected}; {REMEDY}")
    rest = size - file.tell()
    if length > rest:
        expected = f"byte {start}: expected a chunk of {length:,} bytes"
        raise InputError(f"{path}: {expected}, got {rest:,}; {REMEDY}")
    return file.read(length)


def _parse(path: Path, text: bytes) -> dict[str, Any]:
    estimate = Estimate({"objects and numbers": _PARSED * len(text)})
    require(estimate, f"{path}: {len(text):,} bytes of JSON", "leave out a part of it")
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as error:
        what = f"its JSON is damaged: {str(error)[:120]}"
        raise InputError(f"{path}: {what}; {REMEDY}") from error
    if not isinstance(data, dict):
        got = f"expected an object as JSON, got {shown(data)}"
        raise InputError(f"{path}: {got}; {REMEDY}")
    return data


def read_accessor(
    gltf: Gltf, name: str, index: Any, shape: str, allowed: Mapping[int, str]
) -> np.ndarray:
    """Return the elements of an accessor, normalised ones divided.

    Args:
      gltf: the file.
      name: the attribute, for messages.
      index: number of the accessor.
      shape: "SCALAR", "VEC3" or "VEC4".
      allowed: types of components by number: "n" if they must be normalised, "" if
        they must not be, "n?" if either is allowed.

    Returns:
      [N, width] float32.

    Raises:
      InputError: if it does not exist, has another shape or type, is sparse or
        compressed, or exceeds its buffer.
    """
    accessor = gltf.item("accessors", index)
    where = f"accessors[{index}] ({name})"
    kind, normalised = accessor.get("componentType"), accessor.get("normalized", False)
    kind = kind if type(kind) is int and kind in allowed else 0
    rule = allowed.get(kind)
    suited = rule == "n?" or (rule is not None and (rule == "n") == normalised)
    if accessor.get("type") != shape or not suited:
        kinds = [f"{NAMES[k]}{' normalised' * (r == 'n')}" for k, r in allowed.items()]
        keys = ("type", "componentType", "normalized")
        told = {key: accessor.get(key) for key in keys}
        raise gltf.fault(where, f"{shape} of {' or '.join(kinds)}", told)
    if "sparse" in accessor or "bufferView" not in accessor:
        raise gltf.fault(where, "a bufferView without 'sparse'", accessor)
    dtype = np.dtype(_COMPONENTS[kind])
    raw = _strided(gltf, where, accessor, dtype, _WIDTHS[shape])
    values = raw.astype(np.float32)
    if normalised:
        values = np.maximum(values / np.float32(np.iinfo(dtype).max), -1)
    return values


def _strided(
    gltf: Gltf, where: str, accessor: Mapping, dtype: np.dtype, width: int
) -> np.ndarray:
    """Return the raw elements [N, width], a view of the binary chunk."""
    view = gltf.item("bufferViews", accessor["bufferView"])
    if view.get("extensions"):
        raise gltf.fault(f"{where}: its bufferView", "no extension", view["extensions"])
    buffer = gltf.item("buffers", view.get("buffer"))
    if view["buffer"] != 0 or "uri" in buffer:
        expected = "buffer 0 without a URI, the binary chunk"
        raise gltf.fault(f"{where}: its bufferView", expected, view)
    element = dtype.itemsize * width
    count, at, start, length, stride, held = (
        _whole(gltf, where, owner, key, default)
        for owner, key, default in (
            *((accessor, "count", None), (accessor, "byteOffset", 0)),
            *((view, "byteOffset", 0), (view, "byteLength", None)),
            *((view, "byteStride", element), (buffer, "byteLength", None)),
        )
    )
    end = at + stride * (count - 1) + element
    inside = end <= length and start + length <= held <= len(gltf.body)
    if count < 1 or stride < element or not inside:
        got = (
            f"{count} elements every {stride} bytes from {at} in {length} from {start}"
        )
        expected = f"elements of {element} bytes within {len(gltf.body)} bytes"
        raise gltf.fault(where, expected, got)
    strides = (stride, dtype.itemsize)
    return np.ndarray((count, width), dtype, gltf.body, start + at, strides)


def _whole(gltf: Gltf, where: str, owner: Mapping, key: str, default) -> int:
    value = owner.get(key, default)
    if type(value) is not int or not 0 <= value < _MAX_COUNT:
        raise gltf.fault(f"{where}: {key}", "a whole number", value)
    return value


def write_gltf(file: BinaryIO, data: dict[str, Any], arrays: list[np.ndarray]) -> None:
    """Write a file whose buffer 0 is the arrays one after another, each padded to 4.

    Its ``buffers`` and ``bufferViews`` are filled in: view i is array i.
    """
    views, total = [], 0
    for array in arrays:
        views.append(
            {
                "buffer": 0,
                "byteOffset": total,
                "byteLength": array.nbytes,
                "target": _ARRAY_BUFFER,
            }
        )
        total += -(-array.nbytes // 4) * 4
    buffers = [{"byteLength": total}]
    text = json.dumps({**data, "buffers": buffers, "bufferViews": views}).encode()
    text += b" " * (-len(text) % 4)
    whole = _HEADER.size + 2 * _CHUNK.size + len(text) + total
    file.write(_HEADER.pack(_MAGIC, _VERSION, whole))
    file.write(_CHUNK.pack(len(text), _JSON) + text)
    file.write(_CHUNK.pack(total, _BIN))
    for array in arrays:
        file.write(array.tobytes() + bytes(-array.nbytes % 4))
