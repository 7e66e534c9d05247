"""UTF-8 text files as bytes, split into lines or blocks of bounded size.

Bytes take a fraction of the memory of Python's strings.
"""

import codecs
from collections.abc import Iterator
from pathlib import Path

from gsjax.errors import InputError
from gsjax.io.common import warn
from gsjax.io.numerals import BLOCK
from gsjax.runtime.files import read_bytes


def read_text(path: Path, expected: str) -> bytes:
    """Return the UTF-8 text of a file, without byte order mark and carriage returns.

    Raises:
      InputError: if the file, ``expected`` in the message, cannot be read or decoded.
    """
    data = read_bytes(path, expected).removeprefix(codecs.BOM_UTF8)
    decoder = codecs.getincrementaldecoder("utf-8")()
    for start in range(0, len(data), BLOCK):
        try:
            decoder.decode(data[start : start + BLOCK], start + BLOCK >= len(data))
        except UnicodeDecodeError as error:
            line = data.count(b"\n", 0, start + error.start)
            raise InputError(
                f"{path}: after line {line}: not UTF-8 text; the file is damaged, or "
                "binary with the wrong suffix: export or copy it again"
            ) from error
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return data


def lines(path: Path, data: bytes) -> Iterator[tuple[str, bytes]]:
    """Yield the place of each line, for messages, and its bytes without the end.

    Warns if the last line has no end.
    """
    start = number = 0
    while start < len(data):
        number, end = number + 1, data.find(b"\n", start)
        end = len(data) if end < 0 else end
        yield f"{path}: line {number}", data[start:end]
        start = end + 1
    _warn_if_unterminated(path, data)


def blocks(path: Path, data: bytes, most: int) -> Iterator[tuple[int, bytes]]:
    """Yield blocks of whole lines, each with the number of lines before it.

    Warns if the last line has no end.

    Raises:
      InputError: if a line has more than ``most`` bytes.
    """
    start = number = 0
    while start < len(data):
        end = data.rfind(b"\n", start, start + BLOCK) + 1
        end = end or data.find(b"\n", start, start + most) + 1
        if not end and len(data) - start > most:
            raise too_long(f"{path}: line {number + 1}", most)
        block = data[start : end or len(data)]
        yield number, block
        start, number = start + len(block), number + block.count(b"\n")
    _warn_if_unterminated(path, data)


def _warn_if_unterminated(path: Path, data: bytes) -> None:
    if data and not data.endswith(b"\n"):
        what = "the last line has no end; the file may be truncated"
        warn(f"{path}: {what}: export or copy it again")


def too_long(where: str, most: int) -> InputError:
    """Return the error for a line that is longer than any record."""
    what = "the file is damaged or of another kind: export or copy it again"
    return InputError(f"{where}: expected a line of at most {most} bytes; {what}")
