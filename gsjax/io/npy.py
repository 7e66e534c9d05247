"""Arrays from the bytes of .npy files, checked against the size of the file.

NumPy's reader allocates what a header declares and evaluates the header as Python. This
one accepts plain numbers only, and the array is a view of the bytes.
"""

import math
import re
import struct

import numpy as np

from gsjax.errors import InputError

_MAGIC = b"\x93NUMPY"
_FIELDS = {
    "descr": r"'([<>|](?:f[248]|[iu][1248]|b1))'",
    "fortran_order": "(True|False)",
    "shape": r"\(((?: *[0-9]{1,18} *,)* *(?:[0-9]{1,18})? *)\)",
}
_MAX_AXES = 32
_REMEDY = "the file is truncated or damaged: export or copy it again"


def read_npy(where: str, data: bytes) -> np.ndarray:
    """Return the array of a file, read-only.

    Args:
      where: name of the file, for messages.
      data: its contents.

    Raises:
      InputError: if it is not a .npy file, is truncated, is longer than its header
        declares, or holds anything but numbers.
    """
    form, start = ("<I", 12) if data[6:7] in (b"\2", b"\3") else ("<H", 10)
    if not data.startswith(_MAGIC) or len(data) < start:
        raise InputError(
            f"{where}: expected a .npy file, which starts with {_MAGIC!r}, got "
            f"{data[:8]!r}; export or copy it again"
        )
    (length,) = struct.unpack_from(form, data, 8)
    text = data[start : start + min(length, 10_000)].decode("latin-1")
    found = [re.search(f"'{key}': *{value}", text) for key, value in _FIELDS.items()]
    wrong = [key for key, match in zip(_FIELDS, found) if match is None]
    if start + length > len(data) or wrong:
        raise InputError(
            f"{where}: expected the header of an array of numbers, got {text[:120]!r} "
            f"(byte {start}; invalid: {', '.join(wrong) or 'its length'}); {_REMEDY}"
        )
    descr, order, axes = (match[1] for match in found if match)
    shape = tuple(int(size) for size in re.findall("[0-9]+", axes))
    kind, start = np.dtype(descr), start + length
    expected = math.prod(shape) * kind.itemsize
    if len(data) - start != expected or len(shape) > _MAX_AXES:
        raise InputError(
            f"{where}: expected {expected} bytes after the header for {descr} {shape}, "
            f"got {len(data) - start}; {_REMEDY}"
        )
    return np.ndarray(shape, kind, data, start, order="F" if order == "True" else "C")
