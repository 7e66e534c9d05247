"""The header of a PLY file: parsed, and checked against the size of the file."""

import os
import re
from collections.abc import Collection
from pathlib import Path
from typing import BinaryIO, NamedTuple

from gsjax.errors import InputError
from gsjax.io.common import warn
from gsjax.math.sh import MAX_DEGREE, num_bases

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2"},
    **{"int": "i4", "uint": "u4", "float": "f4", "double": "f8"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"},
}
# Byte order of each body; ascii has none.
_FORMATS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_F_REST_COUNTS = [3 * (num_bases(d) - 1) for d in range(MAX_DEGREE + 1)]
_MAX_HEADER = 1 << 20
# Of several programs, and Postshot's, whose words these are.
_RENDER_MODE = re.compile(
    r"comment\s+(?:SplatRenderMode\s*:\s*(\w+)|antialiased\s*:?\s*([01])\b)", re.I
)
_ANTIALIASED = {"0": "default", "1": "mip"}


class Element(NamedTuple):
    """An element of the header; a list property has the type None."""

    name: str
    rows: int
    types: dict[str, str | None]

    @property
    def has_list(self) -> bool:
        return None in self.types.values()

    def min_bytes(self, order: str) -> int:
        """Return the size of a row: exact if binary, a lower bound in ascii."""
        if not order:
            return max(1, 2 * len(self.types))  # "0 0 0\n"
        return sum(int(kind[1]) for kind in self.types.values() if kind)


class Header(NamedTuple):
    """Contents of a header.

    Attributes:
      path: the file, for messages.
      order: byte order of the body, "<", ">", or "" for ascii.
      before, vertex, after: the elements, in the order of the body.
      body, size: byte at which the body starts, and bytes of the file.
      render_mode: lower-case value of the last "comment SplatRenderMode:", or "mip" or
        "default" for "comment antialiased 1" or 0; None without such a comment.
    """

    path: Path
    order: str
    before: list[Element]
    vertex: Element
    after: list[Element]
    body: int
    size: int
    render_mode: str | None = None


def read_header(file: BinaryIO, path: Path) -> Header:
    """Parse the header of a file that is positioned at its start."""
    head = file.read(_MAX_HEADER)
    size = os.fstat(file.fileno()).st_size
    magic = re.match(rb"ply[ \t]*(\r\n|\n|\r)", head)
    if magic is None:
        expected = "a PLY file, which starts with the line 'ply'"
        got = f"{head[:16]!r}; export the file again"
        raise InputError(f"{path}: byte 0: expected {expected}, got {got}")
    eol = magic[1]
    pattern = re.compile(re.escape(eol) + rb"end_header[ \t]*" + re.escape(eol))
    end = pattern.search(head, magic.end() - len(eol))
    if end is None:
        raise InputError(
            f"{path}: no line 'end_header' in the first {len(head)} of {size} bytes; "
            "the file is truncated or damaged: export or download it again"
        )
    text = head[magic.end() : max(end.start(), magic.end())]
    lines = text.split(eol) if text else []
    order, elements = _parse_header(path, lines, eol)
    names = [element.name for element in elements]
    if "vertex" not in names:
        found = f"found {names[:8]}; export the scene as a 3DGS PLY"
        raise InputError(f"{path}: the header has no 'element vertex'; {found}")
    at = names.index("vertex")
    before, after = elements[:at], elements[at + 1 :]
    mode = _render_mode(lines)
    return Header(path, order, before, elements[at], after, end.end(), size, mode)


def _render_mode(lines: list[bytes]) -> str | None:
    """Return the render mode of the last comment that has one."""
    found = (_RENDER_MODE.match(line.decode("ascii", "replace")) for line in lines)
    modes = [(match[1] or _ANTIALIASED[match[2]]).lower() for match in found if match]
    return modes[-1] if modes else None


def _parse_header(
    path: Path, lines: list[bytes], eol: bytes
) -> tuple[str, list[Element]]:
    order: str | None = None
    elements: dict[str, Element] = {}
    last: Element | None = None
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
                raise InputError(f"{where}: expected one format 1.0 of {[*_FORMATS]}")
            case ["element", name, count] if re.fullmatch("[0-9]{1,20}", count):
                if name in elements:
                    raise InputError(f"{where}: this element is declared twice")
                last = elements[name] = Element(name, int(count), {})
            case ["property", *kinds, name] if last and len(kinds) in (1, 3):
                if name in last.types:
                    raise InputError(f"{where}: this property is declared twice")
                last.types[name] = _property_type(where, kinds)
            case _:
                raise InputError(
                    f"{where}: expected 'element NAME COUNT', or after one 'property "
                    "TYPE NAME'; the header is damaged: export the file again"
                )
    if order is None:
        raise InputError(
            f"{path}: no 'format' in the header; pass one of {[*_FORMATS]}"
        )
    return order, list(elements.values())


def _property_type(where: str, kinds: list[str]) -> str | None:
    is_list = len(kinds) == 3 and kinds[0] == "list"
    scalars = kinds[1:] if is_list else kinds
    if (len(kinds) == 3 and not is_list) or not all(k in _TYPES for k in scalars):
        raise InputError(f"{where}: unknown type; expected one of {', '.join(_TYPES)}")
    return None if is_list else _TYPES[scalars[0]]


def check_properties(header: Header, required: Collection[str]) -> int:
    """Return the number K of SH bases, after a check that the vertices are Gaussians.

    Raises:
      InputError: if one of the ``required`` properties, those of degree 0, is missing,
        or f_rest is not a whole degree.
    """
    path, found = header.path, header.vertex.types
    lists = [name for name, kind in found.items() if kind is None]
    rest = sum(re.fullmatch("f_rest_[0-9]+", name) is not None for name in found)
    missing = [name for name in required if name not in found]
    cloud = "f_dc_0" in missing and {"red", "green", "blue"} <= found.keys()
    if rest in _F_REST_COUNTS:
        missing += [f"f_rest_{i}" for i in range(rest) if f"f_rest_{i}" not in found]
    names, export = ", ".join(missing), "export the scene as a 3DGS PLY"
    fault = ""
    if lists:
        fault = f"element vertex has the list properties {lists[:8]}; {export}"
    elif cloud:
        fault = "this is a point cloud (red, green, blue), not a Gaussian PLY "
        fault += f"(missing: {names}); train a scene from the points first"
    elif missing:
        fault = f"element vertex lacks the properties {names}; found {len(found)}: "
        fault += f"{', '.join([*found][:20])}; {export}"
    elif rest not in _F_REST_COUNTS:
        fault = f"expected {_F_REST_COUNTS} properties f_rest_* (SH degree 0 to "
        fault += f"{MAX_DEGREE}), got {rest}; {export}"
    if fault:
        raise InputError(f"{path}: {fault}")
    return 1 + rest // 3


def check_size(header: Header) -> None:
    """Compare the size that the header declares with the size of the file.

    Raises:
      InputError: if the file is smaller, or the place of the vertices is unknown.
    """
    path, order = header.path, header.order
    for element in header.before:
        if element.has_list:
            what = (
                f"element {element.name} has a list property and stands before vertex"
            )
            raise InputError(
                f"{path}: {what}, so its size is unknown; put vertex first"
            )
    elements = [*header.before, header.vertex]
    open_end = not order or any(element.has_list for element in header.after)
    if not open_end:
        elements += header.after
    expected = sum(e.rows * e.min_bytes(order) for e in elements)
    if not order:
        expected = max(0, expected - 1)  # the last line may lack its newline
    actual = header.size - header.body
    if actual < expected:
        parts = [f"{e.rows} {e.name} × {e.min_bytes(order)} bytes" for e in elements]
        raise InputError(
            f"{path}: the body (from byte {header.body}) is truncated: expected "
            f"{'' if order else 'at least '}{expected} bytes ({', '.join(parts)}), got "
            f"{actual}; export or download the file again"
        )
    if actual > expected and not open_end:
        warn(
            f"{path}: {actual - expected} bytes after the last element (from byte "
            f"{header.body + expected}) are ignored; the header may be wrong"
        )
