"""Arrays from the bytes of .npy files, held against their size first.

NumPy's own reader allocates what a header declares and evaluates its text; this one
takes plain numbers only, and the array is a view of the bytes.
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


def read_npy(where: str, data: bytes) -> np.ndarray:
    """The array of a file, read-only.

    Args:
      where: name of the file, for messages.
      data: all of it.

    Raises:
      InputError: if it is no .npy file, is truncated or longer than its header says,
        or holds other things than numbers.
    """
    form, start = ("<I", 12) if data[6:7] in (b"\2", b"\3") else ("<H", 10)
    if not data.startswith(_MAGIC) or len(data) < start:
        raise InputError(
            f"{where}: starts with {data[:8]!r}, which is no .npy file; an array of "
            "numbers is wanted: export or copy it again"
        )
    (length,) = struct.unpack_from(form, data, 8)
    text = data[start : start + min(length, 10_000)].decode("latin-1")
    found = [re.search(f"'{key}': *{value}", text) for key, value in _FIELDS.items()]
    wrong = [key for key, match in zip(_FIELDS, found) if match is None]
    if start + length > len(data) or wrong:
        raise InputError(
            f"{where}: the header (byte {start}) {text[:120]!r} is not that of an "
            f"array of numbers ({', '.join(wrong) or 'its length'}); the file is "
            "truncated, damaged or another one: export or copy it again"
        )
    descr, order, axes = (match[1] for match in found if match)
    shape = tuple(int(size) for size in re.findall("[0-9]+", axes))
    kind, start = np.dtype(descr), start + length
    wanted = math.prod(shape) * kind.itemsize
    if len(data) - start != wanted or len(shape) > _MAX_AXES:
        raise InputError(
            f"{where}: {len(data) - start} bytes follow the header, {descr} of shape "
            f"{shape} takes {wanted}; the file is truncated or damaged: export or copy "
            "it again"
        )
    return np.ndarray(shape, kind, data, start, order="F" if order == "True" else "C")
