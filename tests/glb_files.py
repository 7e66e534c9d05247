"""Binary glTF files, taken apart and put together without the code of the package."""

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

NAME = "KHR_gaussian_splatting"
TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def taken_apart(raw: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the JSON and the binary chunk of a file."""
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", raw)
    assert (magic, version, length, kind) == (b"glTF", 2, len(raw), b"JSON")
    start = 20 + size
    rest, kind = struct.unpack_from("<I4s", raw, start)
    assert (kind, start + 8 + rest) == (b"BIN\0", len(raw))
    assert size % 4 == rest % 4 == 0
    return json.loads(raw[20:start]), raw[start + 8 :]


def put_together(data: dict[str, Any], body: bytes) -> bytes:
    """Return the file of a JSON and a binary chunk."""
    text = json.dumps(data).encode()
    text += b" " * (-len(text) % 4)
    body += bytes(-len(body) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(body))
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    return head + chunks + struct.pack("<I4s", len(body), b"BIN\0") + body


def edited(edit: Callable[[dict[str, Any]], object]) -> Callable[[bytes], bytes]:
    """Return a change of a file that edits its JSON in place."""

    def change(raw: bytes) -> bytes:
        data, body = taken_apart(raw)
        edit(data)
        return put_together(data, body)

    return change


def primitive(data: dict[str, Any]) -> dict[str, Any]:
    """Return the first primitive of the first mesh."""
    return data["meshes"][0]["primitives"][0]


def arrays_of(path: Path) -> dict[str, np.ndarray]:
    """Return the attributes of the first primitive, [N, width], as stored."""
    data, body = taken_apart(path.read_bytes())
    found = {}
    for name, index in primitive(data)["attributes"].items():
        accessor = data["accessors"][index]
        view = data["bufferViews"][accessor["bufferView"]]
        width, kind = WIDTHS[accessor["type"]], TYPES[accessor["componentType"]]
        at = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        count = accessor["count"]
        assert at % 4 == 0
        assert count * width * np.dtype(kind).itemsize <= view["byteLength"]
        values = np.frombuffer(body, kind, count * width, at).reshape(count, width)
        found[name.removeprefix(f"{NAME}:")] = values
    return found


def with_array(raw: bytes, name: str, array: np.ndarray, **accessor) -> bytes:
    """Return a file with other values of an attribute, in a new buffer view."""
    data, body = taken_apart(raw)
    start, kinds = len(body), {np.dtype(kind): code for code, kind in TYPES.items()}
    body += np.ascontiguousarray(array).tobytes()
    body += bytes(-len(body) % 4)
    view = {"buffer": 0, "byteOffset": start, "byteLength": array.nbytes}
    data["bufferViews"].append(view)
    data["buffers"][0]["byteLength"] = len(body)
    data["accessors"].append(
        {
            "bufferView": len(data["bufferViews"]) - 1,
            "componentType": kinds[array.dtype],
            "count": len(array),
            "type": {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[array.shape[1]],
            **accessor,
        }
    )
    full = name if name == "POSITION" else f"{NAME}:{name}"
    primitive(data)["attributes"][full] = len(data["accessors"]) - 1
    return put_together(data, body)
